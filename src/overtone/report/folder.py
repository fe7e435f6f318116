"""Write a folder of files whole or not at all."""

from __future__ import annotations

import secrets
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from overtone.errors import FileFormatError


@dataclass
class Place:
    """Where the files of a folder are written before they are moved there."""

    target: Path
    temporary: Path
    names: list[str] = field(default_factory=list)

    def write(self, name: str, content: bytes) -> None:
        """Write one file."""
        (self.temporary / name).write_bytes(content)
        self.names.append(name)

    @property
    def files(self) -> tuple[Path, ...]:
        """The files where they are in the end, in the order in which they were written."""
        return tuple(self.target / name for name in self.names)


@contextmanager
def filled_folder(folder: str | Path, replaced: frozenset[str] = frozenset()) -> Iterator[Place]:
    """Give a place to write files into, and move them to the folder once the block has ended well.

    Parameters
    ----------
    folder : str or Path
        Created where it does not exist, in one step. Where it exists, the files move in one after the other.
    replaced : set of str
        Names of files that are removed from an existing folder unless they are written again.

    Yields
    ------
    Place
        With ``write(name, content)``; ``files`` afterwards.

    Raises
    ------
    FileFormatError
        If the folder above does not exist, the target is a file, or something cannot be written. The target stays as
        it was where this happens before all files are written.
    """
    target = Path(folder)
    if not target.parent.is_dir():
        raise _unwritable(
            target, "an existing folder above", f"{str(target.parent)!r}, which is none", "create it first"
        )
    if target.exists() and not target.is_dir():
        raise _unwritable(target, "a folder", "a file", "another name")
    blocked = sorted(name for name in replaced if (target / name).is_dir())
    if blocked:
        raise _unwritable(
            target, "files in it that can be replaced", f"a folder {blocked[0]!r}", "another folder"
        )
    temporary = target.parent / f".{secrets.token_hex(8)}.partial"
    try:
        temporary.mkdir()
        place = Place(target, temporary)
        yield place
        if target.exists():
            for name in place.names:
                (temporary / name).replace(target / name)
            for name in replaced - set(place.names):
                (target / name).unlink(missing_ok=True)
        else:
            temporary.replace(target)
    except OSError as error:
        raise _unwritable(
            target,
            "a folder that can be written to, with space left",
            f"{type(error).__name__} ({error.strerror or error})",
            "another folder",
        ) from error
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def _unwritable(target: Path, expected: str, got: str, hint: str) -> FileFormatError:
    return FileFormatError(f"cannot write the folder {str(target)!r}", expected=expected, got=got, hint=hint)
