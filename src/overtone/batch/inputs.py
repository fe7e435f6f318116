"""The files of a batch: found by their patterns, told apart by their content, and what their results are called."""

from __future__ import annotations

import glob
import hashlib
import os
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from overtone.errors import FileFormatError

_BLOCK = 1 << 20
_DIGEST_SIZE = 16


def find_files(patterns: Sequence[str | Path]) -> tuple[Path, ...]:
    """Return the files that names and patterns stand for, in their order.

    Patterns are resolved here as well as by a shell, because those of Windows leave them as they are. What is there
    under the very name is no pattern; a name that is not there is kept, so that its error belongs to that file.

    Parameters
    ----------
    patterns : sequence of str or Path
        Names, or patterns with ``*``, ``?``, ``[...]`` and ``**`` for any depth of folders.

    Raises
    ------
    FileFormatError
        If a pattern fits no file, or there is nothing to look for.
    """
    found: list[Path] = []
    for pattern in map(Path, patterns):
        if pattern.exists() or not glob.has_magic(str(pattern)):
            found.append(pattern)
            continue
        fitting = sorted(glob.glob(str(pattern), recursive=True))  # noqa: PTH207 - leaves hidden files out, as shells do
        if not fitting:
            raise FileFormatError(
                f"no file fits {str(pattern)!r}", expected="one or more", got="none", hint="check the folder"
            )
        found += map(Path, fitting)
    if not found:
        raise FileFormatError("there is no file to map", expected="one or more", got="none")
    return tuple(found)


def each_once(files: Sequence[Path]) -> tuple[Path, ...]:
    """Return files without those that are named again."""
    once: dict[Path, Path] = {}
    for path in files:
        once.setdefault(path.resolve(), path)
    return tuple(once.values())


@dataclass(frozen=True)
class Stamp:
    """What tells a file from another, and from what it was before.

    Parameters
    ----------
    size : int
        Bytes; of a folder those of all its files.
    time : int
        When it was written last [ns].
    digest : str
        Of its content, or empty where it was not asked for.
    """

    size: int
    time: int
    digest: str = ""

    @classmethod
    def of(cls, path: Path, *, digest: bool = True) -> Stamp:
        """Return that of a file, or of the files in a folder.

        Raises
        ------
        OSError
            If it cannot be read.
        """
        parts = [(part, part.stat()) for part in _parts(path)]
        size, time = sum(s.st_size for _, s in parts), max((s.st_mtime_ns for _, s in parts), default=0)
        return cls(size, time, _digest(path) if digest else "")

    def is_that_of(self, path: Path) -> bool:
        """Tell whether a file has this content: the same size and time, or the same bytes.

        Raises
        ------
        OSError
            If it cannot be read.
        """
        now = Stamp.of(path, digest=False)
        if now.size != self.size:
            return False
        return now.time == self.time or (self.digest != "" and _digest(path) == self.digest)


def _parts(path: Path) -> list[Path]:
    if not path.is_dir():
        return [path]
    return sorted(part for part in path.rglob("*") if part.is_file())


def _digest(path: Path) -> str:
    digest = hashlib.blake2b(digest_size=_DIGEST_SIZE)
    for part in _parts(path):
        if part != path:
            digest.update(part.relative_to(path).as_posix().encode() + b"\0")
        with part.open("rb") as stream:
            while block := stream.read(_BLOCK):
                digest.update(block)
    return digest.hexdigest()


def names_of(files: Sequence[Path]) -> list[list[str]]:
    """Return what the result of each file may be called, the likeliest first, without its ending.

    Files of one name in several folders, or of one name with several endings, get names that keep them apart. File
    systems that do not tell capitals from small letters are reckoned with.

    Parameters
    ----------
    files : sequence of Path
        Of one batch.

    Examples
    --------
    >>> from pathlib import Path
    >>> [names[0] for names in names_of([Path("a/scan.ibw"), Path("b/scan.ibw"), Path("b/other.ibw")])]
    ['a_scan', 'b_scan', 'other']
    """
    ladders = [list(_ladder(file)) for file in files]
    rungs = [0] * len(files)
    # whoever shares a name takes the next longer one, until nobody does; the last is the whole path
    while True:
        names = [ladder[min(rung, len(ladder) - 1)] for ladder, rung in zip(ladders, rungs, strict=True)]
        shared = Counter(name.casefold() for name in names)
        again = [i for i, name in enumerate(names) if shared[name.casefold()] > 1]
        if not any(rungs[i] < len(ladders[i]) - 1 for i in again):
            return [ladder[rung:] for ladder, rung in zip(ladders, rungs, strict=True)]
        for i in again:
            rungs[i] = min(rungs[i] + 1, len(ladders[i]) - 1)


def _ladder(file: Path) -> Iterator[str]:
    """Yield names of a file, from its own to one that holds a digest of its whole path."""
    whole = Path(os.path.normpath(file.absolute()))
    stem = whole.name if whole.is_dir() and whole.suffix.lower() != ".zarr" else whole.stem
    parents = [part for part in whole.parts[:-1] if part != whole.anchor]
    ending = "_" + whole.suffix[1:] if whole.suffix and stem != whole.name else ""
    for depth in range(3):
        before = "".join(f"{part}_" for part in parents[len(parents) - min(depth, len(parents)) :])
        yield before + stem
        if ending:
            yield before + stem + ending
    yield f"{stem}_{hashlib.blake2b(str(whole).encode(), digest_size=4).hexdigest()}"
