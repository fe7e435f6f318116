"""The container of Gwyddion's own files (.gwy): named values in objects within objects, read and written.

It is read here and not by a library because sizes must be checked before memory is asked for, because files of
Gwyddion 1 occur, and because it is short. A file is a magic number and one object. An object is its type as text that
ends with a zero, the number of bytes of its content, and the content: components, each a name that ends with a zero, a
letter for the type, and the value (https://gwyddion.net/documentation/user-guide-en/gwyfile-format.html). In files of
Gwyddion 1 a component of a container has the number of a GLib type before its name instead of the letter behind it.
All numbers are little-endian.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from overtone.errors import FileFormatError

MAGIC, OLD_MAGIC = b"GWYP", b"GWYO"
CONTAINER = "GwyContainer"
_DEEPEST = 16
_MOST_COMPONENTS = 200_000
_NUMBERS = {"i": "<i", "q": "<q", "d": "<d", "b": "<?"}
_ARRAYS = {"C": "u1", "I": "<i4", "Q": "<i8", "D": "<f8"}
# Numbers of GLib's fundamental types, shifted by two bits.
_GLIB_TYPES = {16: "c", 20: "b", 24: "i", 40: "q", 60: "d", 64: "s", 80: "o"}


@dataclass(frozen=True)
class GwyObject:
    """An object: the name of its type, and its components by name.

    Values are text, numbers, truth values, arrays, other objects, or lists of texts or objects.
    """

    type: str
    items: Mapping[str, Any] = field(default_factory=dict)


def parse(path: Path, content: bytes) -> GwyObject:
    """Return the outermost object of a file.

    Parameters
    ----------
    path : Path
        What messages call the file.
    content : bytes
        The whole file. Arrays of the result are views of it.

    Raises
    ------
    FileFormatError
        If a size in the file goes beyond its end, a type is not known, or there are too many levels or components.
    """
    if content[:4] not in (MAGIC, OLD_MAGIC):
        raise FileFormatError(
            f"{path.name} is no Gwyddion file",
            expected="GWYP or GWYO at its beginning",
            got=repr(content[:4]),
        )
    reader = _Reader(path, content, old=content.startswith(OLD_MAGIC))
    return reader.object(4, len(content), 0)[0]


def serialized(root: GwyObject) -> bytes:
    """Return the bytes of a file whose outermost object is given.

    Values may be str, bool, int of 32 bits, float, arrays of doubles, objects, and lists of texts. Texts end at a
    zero and doubles must be finite, says the format.
    """
    return MAGIC + b"".join(_object(root))


# --- reading --------------------------------------------------------------------------------------


class _Reader:
    """Reads objects and counts what it reads: a few bytes of damage could promise millions of components."""

    def __init__(self, path: Path, content: bytes, *, old: bool) -> None:
        self._path, self._content, self._old = path, content, old
        self._count = 0

    def object(self, at: int, end: int, depth: int) -> tuple[GwyObject, int]:
        """Return the object at a position and the position behind it."""
        if depth > _DEEPEST:
            raise self._damaged(f"at most {_DEEPEST} objects within each other", "more")
        name, at = self._text(at, end)
        size, at = self._number("<I", at, end)
        if size > end - at:
            raise self._damaged(f"{size} bytes of {name[:40]!r}", f"{end - at}")
        end = at + size
        items: dict[str, Any] = {}
        while at < end:
            self._tally(1)
            key, code, at = self._component(at, end, typed_first=self._old and name == CONTAINER)
            value, at = self._value(code, at, end, depth)
            items.setdefault(key, value)
        return GwyObject(name, items), end

    def _component(self, at: int, end: int, *, typed_first: bool) -> tuple[str, str, int]:
        """Return name and type of a component, and where its value begins."""
        if typed_first:
            number, at = self._number("<I", at, end)
            key, at = self._text(at, end)
            if number not in _GLIB_TYPES:
                raise self._damaged("a known type of component", f"number {number}")
            return key, _GLIB_TYPES[number], at
        key, at = self._text(at, end)
        if at >= end:
            raise self._damaged(f"a type behind {key[:40]!r}", "the end of the object")
        return key, chr(self._content[at]), at + 1

    def _value(self, code: str, at: int, end: int, depth: int) -> tuple[Any, int]:
        if code in _NUMBERS:
            return self._number(_NUMBERS[code], at, end)
        if code == "c":
            number, at = self._number("<B", at, end)
            return chr(number), at
        if code == "s":
            return self._text(at, end)
        if code == "o":
            return self.object(at, end, depth + 1)
        if code not in _ARRAYS and code not in ("S", "O"):
            raise self._damaged("a known type of component", repr(code))
        count, at = self._number("<I", at, end)
        if code in _ARRAYS:
            dtype = np.dtype(_ARRAYS[code])
            if count * dtype.itemsize > end - at:
                raise self._damaged(f"{count * dtype.itemsize} bytes of an array", f"{end - at}")
            return np.frombuffer(self._content, dtype, count, at), at + count * dtype.itemsize
        if count > end - at:  # each takes a byte at least
            raise self._damaged(f"{count} items", f"{end - at} bytes")
        self._tally(count)
        found: list[Any] = []
        for _ in range(count):
            value, at = self._text(at, end) if code == "S" else self.object(at, end, depth + 1)
            found.append(value)
        return found, at

    def _number(self, form: str, at: int, end: int) -> tuple[Any, int]:
        size = struct.calcsize(form)
        if size > end - at:
            raise self._damaged(f"a number of {size} bytes", f"{end - at}")
        return struct.unpack_from(form, self._content, at)[0], at + size

    def _text(self, at: int, end: int) -> tuple[str, int]:
        stop = self._content.find(b"\0", at, end)
        if stop < 0:
            raise self._damaged("text that ends with a zero", "none")
        raw = self._content[at:stop]
        try:
            return raw.decode("utf-8"), stop + 1
        except UnicodeDecodeError:  # as Gwyddion 1 wrote it
            return raw.decode("latin-1"), stop + 1

    def _tally(self, more: int) -> None:
        self._count += more
        if self._count > _MOST_COMPONENTS:
            raise self._damaged(f"at most {_MOST_COMPONENTS} components", "more")

    def _damaged(self, expected: str, got: str) -> FileFormatError:
        return FileFormatError(
            f"{self._path.name} is not a whole Gwyddion file",
            expected=expected,
            got=got,
            hint="copy or save the file again",
        )


# --- writing --------------------------------------------------------------------------------------


def _object(given: GwyObject) -> list[bytes]:
    parts = [part for key, value in given.items.items() for part in _component(key, value)]
    return [_zero_ended(given.type), struct.pack("<I", sum(map(len, parts))), *parts]


def _component(key: str, value: Any) -> list[bytes]:
    name = _zero_ended(key)
    if isinstance(value, GwyObject):
        return [name, b"o", *_object(value)]
    if isinstance(value, str):
        return [name, b"s", _zero_ended(value)]
    if isinstance(value, bool):
        return [name, b"b", struct.pack("<?", value)]
    if isinstance(value, int):
        return [name, b"i", struct.pack("<i", value)]
    if isinstance(value, float):
        return [name, b"d", struct.pack("<d", value)]
    if isinstance(value, list):
        return [name, b"S", struct.pack("<I", len(value)), *map(_zero_ended, value)]
    array = np.ascontiguousarray(value, dtype="<f8")
    return [name, b"D", struct.pack("<I", array.size), array.tobytes()]


def _zero_ended(text: str) -> bytes:
    return text.replace("\0", "").encode("utf-8", "replace") + b"\0"
