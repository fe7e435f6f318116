"""The folder of results while a batch is at work: one batch at a time, and nothing half finished among the results."""

from __future__ import annotations

import errno
import os
import shutil
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

from overtone.errors import OvertoneError

WORK = ".overtone"
"""Folder of what is not finished; whatever is in it is overtone's own."""
_LOCK = "lock"


@contextmanager
def working_folder(out_dir: Path) -> Iterator[Path]:
    """Give a folder for what is not finished, beside the results; what a killed run left in it is gone.

    Parameters
    ----------
    out_dir : Path
        Folder of the results, made where it is not there.

    Raises
    ------
    OvertoneError
        If it cannot be written to, or another batch is at work there.

    Notes
    -----
    Zarr folders stay from one run to the next, because a map that is written block by block goes on where it was;
    whoever finishes one moves it away.
    """
    if out_dir.exists() and not out_dir.is_dir():
        raise OvertoneError(
            f"{out_dir} is no folder", expected="a folder for results", got="a file", hint="another name"
        )
    work = out_dir / WORK
    try:
        lock = _locked(work)
    except OSError as error:
        raise OvertoneError(
            f"cannot write to the folder {out_dir}", got=error.strerror or str(error), hint="another folder"
        ) from error
    if lock is None:
        raise OvertoneError(
            f"another batch is writing to {out_dir}",
            expected="one at a time",
            hint="wait for it, stop it, or use another folder",
        )
    try:
        _clean(work, keep=(".zarr",))
        yield work
    finally:
        _clean(work, keep=(".zarr",))
        lock.close()
        if not any(part.suffix == ".zarr" for part in work.iterdir()):
            shutil.rmtree(work, ignore_errors=True)


def _clean(work: Path, keep: tuple[str, ...] = ()) -> None:
    for part in work.iterdir():
        if part.name == _LOCK or part.suffix in keep:
            continue
        if part.is_dir():
            shutil.rmtree(part, ignore_errors=True)
            continue
        try:
            part.unlink(missing_ok=True)
        except OSError:  # Windows: a worker of a stopped cluster still has it open
            continue


def _locked(work: Path) -> IO[bytes] | None:
    """Return an open file that no other process can lock until it is closed or this one ends; None where one has."""
    while True:
        work.mkdir(parents=True, exist_ok=True)
        stream = (work / _LOCK).open("ab")
        try:
            _lock(stream)
        except OSError as error:
            if error.errno in (errno.EAGAIN, errno.EACCES, errno.EDEADLK):
                stream.close()
                return None
            return stream  # a file system without locks
        try:
            if os.path.samestat(os.fstat(stream.fileno()), (work / _LOCK).stat()):
                return stream
        except FileNotFoundError:
            pass
        stream.close()  # the batch before took it away in between


def _lock(stream: IO[bytes]) -> None:
    if sys.platform == "win32":
        import msvcrt

        msvcrt.locking(stream.fileno(), msvcrt.LK_NBLCK, 1)
    else:
        import fcntl

        fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
