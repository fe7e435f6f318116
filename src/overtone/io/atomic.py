"""Write a file whole or not at all."""

from __future__ import annotations

import secrets
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from overtone.errors import FileFormatError


@contextmanager
def atomic_path(path: str | Path) -> Iterator[Path]:
    """Give a temporary path beside the target and move it there once the block has ended well.

    The temporary file lies in the folder of the target, so that the move is one step of the file
    system, and keeps its suffix, from which some writers learn the format. Whatever goes wrong
    inside the block, the target stays as it was and the temporary file is gone.

    Parameters
    ----------
    path : str or Path
        Where the file is to be; an existing file there is replaced.

    Yields
    ------
    Path
        Where to write.

    Raises
    ------
    FileFormatError
        If the folder does not exist, the target is a folder, or the file cannot be written.
    """
    target = Path(path)
    if not target.parent.is_dir():
        raise FileFormatError(
            f"cannot write {str(target)!r}",
            expected="an existing folder",
            got=f"{str(target.parent)!r}, which is none",
            hint="create the folder first, or check the path",
        )
    if target.is_dir():
        raise FileFormatError(
            f"cannot write {str(target)!r}",
            expected="the name of a file",
            got="a folder",
            hint="add a file name",
        )
    # Not tempfile: its files are readable by their owner alone, also after the move.
    temporary = target.parent / f".{secrets.token_hex(8)}.partial{target.suffix}"
    try:
        yield temporary
        temporary.replace(target)
    except OSError as error:
        raise FileFormatError(
            f"cannot write {str(target)!r}",
            expected="a folder that can be written to, with space left",
            got=f"{type(error).__name__} ({error.strerror or error})",
            hint="another folder",
        ) from error
    finally:
        temporary.unlink(missing_ok=True)
