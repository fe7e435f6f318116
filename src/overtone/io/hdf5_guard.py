"""Read a foreign HDF5 file in another process first: the library crashes or never returns on some damage.

A wrong number in what HDF5 calls a global heap, where texts of any length and references lie, ends the whole process
or keeps it busy for ever, and no Python code can step in. Whoever reads such files lets another process do the same
before.
"""

from __future__ import annotations

import struct
import subprocess
import sys
from pathlib import Path

from overtone.errors import FileFormatError

MAGIC = b"\x89HDF\r\n\x1a\n"
# With what Python needs to begin, a file of ordinary size that HDF5 never returns from is refused within five seconds.
_SECONDS, _BYTES_PER_SECOND = 3.0, 20e6
_START = 60.0  # for Python to begin on a busy machine
# The clock starts once everything is imported, and ends the process with 1 from a thread that no library can hold up.
_CODE = """
import faulthandler, pathlib, sys
import {module}
faulthandler.dump_traceback_later({limit}, exit=True)
try:
    {module}.{name}(pathlib.Path(sys.argv[1]))
except Exception:
    pass
faulthandler.cancel_dump_traceback_later()
"""


def check(path: Path, function: str) -> None:
    """Refuse a file that ends too early, or that a function does not return from.

    Parameters
    ----------
    path : Path
        The HDF5 file.
    function : str
        Module and name, ``overtone.io.nsid:parts_of``, of what is called with the path in the other process. It may
        raise whatever it wants.

    Raises
    ------
    FileFormatError
        If the file is shorter than it says, or the function crashed or took more than three seconds and what the
        size of the file needs.
    """
    size = path.stat().st_size
    with path.open("rb") as stream:
        stated = _stated_size(stream.read(48))
    if stated is not None and stated > size:
        raise _damaged(path, f"{stated} bytes as its header says", f"{size}")
    if not sys.executable:  # Python inside another program
        return
    module, _, name = function.partition(":")
    limit = _SECONDS + size / _BYTES_PER_SECOND
    code = _CODE.format(module=module, name=name, limit=limit)
    try:
        # -P: a folder of data is no place to import from.
        status = subprocess.run(
            [sys.executable, "-P", "-W", "ignore", "-c", code, str(path.resolve())],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            timeout=limit + _START,
            check=False,
        ).returncode
    except subprocess.TimeoutExpired as error:
        raise _damaged(path, "a file that HDF5 reads", "no answer from the library") from error
    if status != 0:
        what = "no answer from the library" if status == 1 else f"a crash of the library (status {status})"
        raise _damaged(path, "a file that HDF5 reads", what)


def _stated_size(head: bytes) -> int | None:
    """Return how long the file is by its superblock, None where that is of an unusual kind."""
    if len(head) < 48 or not head.startswith(MAGIC):
        return None
    version = head[8]
    at, width = {0: (40, head[13]), 1: (44, head[13]), 2: (28, head[9]), 3: (28, head[9])}.get(
        version, (0, 0)
    )
    if width != 8 or at + 8 > len(head):
        return None
    stated = int(struct.unpack_from("<Q", head, at)[0])
    return stated if stated < 2**63 else None


def _damaged(path: Path, expected: str, got: str) -> FileFormatError:
    return FileFormatError(f"{path.name} is damaged", expected=expected, got=got, hint="copy the file again")
