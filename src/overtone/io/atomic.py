"""Write a file or a folder whole or not at all."""

from __future__ import annotations

import secrets
import shutil
from collections.abc import Callable, Iterator
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
    _check_parent(target)
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
        raise _not_written(target, error) from error
    finally:
        temporary.unlink(missing_ok=True)


@contextmanager
def atomic_folder(path: str | Path, is_replaceable: Callable[[Path], bool]) -> Iterator[Path]:
    """Give a temporary folder beside the target and move it there, as one, once the block has ended well.

    A folder cannot replace another in one step. The old one is moved aside, the new one moved in and the old one
    removed; where the second move fails the old one is moved back. Killed between the two moves, a run leaves no
    target, and the old folder whole beside it under the name of the target with ``.old`` behind it.

    Parameters
    ----------
    path : str or Path
        Where the folder is to be.
    is_replaceable : callable
        Tells of an existing folder there whether it may be replaced: never remove what somebody else put there.

    Yields
    ------
    Path
        Where to write; does not exist yet.

    Raises
    ------
    FileFormatError
        If the folder above does not exist, something else is in the way, or the folder cannot be written.
    """
    target = Path(path)
    _check_parent(target)
    if target.is_symlink() or (target.exists() and not (target.is_dir() and is_replaceable(target))):
        raise FileFormatError(
            f"cannot write {str(target)!r}",
            expected="a new name, or a folder that overtone may replace",
            got="a folder with other content" if target.is_dir() else "a file or a link",
            hint="another name",
        )
    token = secrets.token_hex(8)
    temporary = target.parent / f".{token}.partial{target.suffix}"
    aside = target.parent / f"{target.name}.{token}.old"
    try:
        yield temporary
        if target.exists():
            target.rename(aside)
        try:
            temporary.rename(target)
        except BaseException:
            if aside.exists():
                aside.rename(target)
            raise
    except OSError as error:
        raise _not_written(target, error) from error
    finally:
        shutil.rmtree(temporary, ignore_errors=True)
    shutil.rmtree(aside, ignore_errors=True)


def _check_parent(target: Path) -> None:
    if not target.parent.is_dir():
        raise FileFormatError(
            f"cannot write {str(target)!r}",
            expected="an existing folder",
            got=f"{str(target.parent)!r}, which is none",
            hint="create the folder first, or check the path",
        )


def _not_written(target: Path, error: OSError) -> FileFormatError:
    return FileFormatError(
        f"cannot write {str(target)!r}",
        expected="a folder that can be written to, with space left",
        got=f"{type(error).__name__} ({error.strerror or error})",
        hint="another folder",
    )
