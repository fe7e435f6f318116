"""TIFF as microscopes use it: private tags and raw numbers, with every size checked against the file."""

from __future__ import annotations

import logging
import math
import struct
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from overtone.errors import FileFormatError

_MAGIC = (b"II*\0", b"MM\0*")
_MOST_PAGES = 1000
# What the pages may take together as floats, and their tags as texts and as numbers: several may claim the same bytes.
_LARGEST_RATIO, _SLACK = 8, 100 << 20
_TAG_SLACK = 1 << 20
_MOST_NUMBERS = 1_000_000
_BYTES = (1, 2, 7)
# The date, and the tags that microscopes added.
_WANTED = (range(306, 307), range(32768, 37000), range(50432, 50442))


@dataclass(frozen=True)
class Page:
    """One page: its tags by number, and its raw numbers as the file holds them."""

    tags: Mapping[int, Any]
    values: npt.NDArray[Any] | None
    """Rows and columns, None where the page is a picture and no array of numbers."""

    def text(self, code: int) -> str:
        """Return a tag as text without what stands behind its zero, empty where there is none."""
        value = self.tags.get(code, "")
        if isinstance(value, bytes):
            value = value.decode("latin-1")
        return str(value).split("\0", 1)[0].strip() if isinstance(value, str | int | float) else ""

    def number(self, code: int) -> float | None:
        """Return a tag as a finite number, None where there is none."""
        value = self.tags.get(code)
        if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
            return None
        return float(value)


def is_tiff(head: bytes) -> bool:
    """Tell whether a file begins like a TIFF, of either byte order."""
    return head.startswith(_MAGIC)


def first_tags(path: Path) -> frozenset[int]:
    """Return the numbers of the tags on the first page, none where the file is no whole TIFF."""
    first = next(_directories(path), [])
    return frozenset(code for code, _, _ in first)


def read_pages(path: Path, what: str) -> list[Page]:
    """Read all pages of a TIFF: tags, and the numbers of those that hold one number a pixel.

    Parameters
    ----------
    path : Path
        The file.
    what : str
        What the file is meant to be, for messages: ``a JPK image``.

    Raises
    ------
    FileFormatError
        If a page lies beyond the end of the file, claims more than the file can hold or cannot be decoded.
    """
    import tifffile

    _check_tags(path, what)
    with _quiet("tifffile"), _damage(path, what), tifffile.TiffFile(path) as file:
        pages = [file.pages[index] for index in range(len(file.pages))]
        wanted = [page for page in pages if isinstance(page, tifffile.TiffPage) and _is_array(page)]
        size = path.stat().st_size
        claimed = sum(8 * math.prod(page.shape) for page in wanted)
        if claimed > _LARGEST_RATIO * size + _SLACK:
            raise damaged(path, what, f"images that fit into a file of {size} bytes", f"{claimed} claimed")
        for page in wanted:
            _check_strips(path, what, page, size)
        return [
            Page(
                {tag.code: tag.value for tag in page.tags if any(tag.code in codes for codes in _WANTED)},
                np.asarray(page.asarray()) if page in wanted else None,
            )
            for page in pages
            if isinstance(page, tifffile.TiffPage)
        ]


def damaged(path: Path, what: str, expected: str, got: str) -> FileFormatError:
    """Return the error for a file that is not whole."""
    return FileFormatError(
        f"{path.name} is not {what} that is whole",
        expected=expected,
        got=got,
        hint="copy or save the file again",
    )


def _directories(path: Path) -> Iterator[list[tuple[int, int, int]]]:
    """Yield the tags of each page as number, type and count, as far as they can be followed."""
    with path.open("rb") as stream:
        head = stream.read(8)
        order = "<" if head.startswith(b"II") else ">"
        if head[:4] not in _MAGIC or len(head) < 8:
            return
        start = struct.unpack(order + "I", head[4:])[0]
        seen: set[int] = set()
        while start and start not in seen and len(seen) <= _MOST_PAGES:
            seen.add(start)
            stream.seek(start)
            length = stream.read(2)
            count = struct.unpack(order + "H", length)[0] if len(length) == 2 else 0
            entries = stream.read(12 * count)
            if len(entries) < 12 * count or not count:
                return
            yield [struct.unpack_from(order + "HHI", entries, at) for at in range(0, 12 * count, 12)]
            following = stream.read(4)
            start = struct.unpack(order + "I", following)[0] if len(following) == 4 else 0


def _check_tags(path: Path, what: str) -> None:
    """Hold what the tags of all pages claim against the file: many may point at the same bytes."""
    pages, numbers, texts = 0, 0, 0
    for tags in _directories(path):
        pages += 1
        numbers += sum(count for _, kind, count in tags if kind not in _BYTES)
        texts += sum(count for _, kind, count in tags if kind in _BYTES)
    size = path.stat().st_size
    if pages > _MOST_PAGES or numbers > _MOST_NUMBERS or texts > size + _TAG_SLACK:
        got = f"{pages} pages with {numbers} numbers and {texts} bytes in tags"
        raise damaged(path, what, f"tags that fit into a file of {size} bytes", got)


def _is_array(page: Any) -> bool:
    return len(page.shape) == 2 and page.dtype is not None and int(page.photometric) in (0, 1)


def _check_strips(path: Path, what: str, page: Any, size: int) -> None:
    if int(page.compression) != 1:
        raise damaged(path, what, "numbers without compression", f"compression {int(page.compression)}")
    offsets, counts = page.dataoffsets, page.databytecounts
    end = max((at + count for at, count in zip(offsets, counts, strict=True)), default=0)
    if end > size:
        raise damaged(path, what, f"{end} bytes as its pages say", f"{size}")
    needed = math.prod(page.shape) * page.dtype.itemsize
    if sum(counts) != needed or min(offsets, default=0) < 8:
        raise damaged(path, what, f"{needed} bytes for {page.shape} pixels", f"{sum(counts)}")


@contextmanager
def _quiet(name: str) -> Iterator[None]:
    """Keep a library from writing about damage to the screen: the error says it."""
    log = logging.getLogger(name)
    before, log.disabled = log.disabled, True
    try:
        yield
    finally:
        log.disabled = before


@contextmanager
def _damage(path: Path, what: str) -> Iterator[None]:
    try:
        yield
    except (FileFormatError, ImportError):
        raise
    except Exception as error:  # the library states no exceptions
        raise damaged(
            path, what, "readable pages and tags", f"{type(error).__name__} ({str(error)[:120]})"
        ) from error
