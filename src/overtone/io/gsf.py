"""Gwyddion Simple Field: one channel, a text header and 32-bit floats."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from overtone.errors import FileFormatError
from overtone.io.recording import Channel, Recording
from overtone.io.si import to_si

_MAGIC = b"Gwyddion Simple Field 1."
_LONGEST_HEADER = 1 << 20


@dataclass(frozen=True)
class Field:
    """One field as the file holds it: values with row 0 at the top, and the header as text."""

    values: npt.NDArray[np.float64]
    header: Mapping[str, str]


def sniff(path: Path, head: bytes) -> bool:
    """Tell whether the file begins like a Gwyddion Simple Field."""
    return head.startswith(_MAGIC)


def read_field(path: Path) -> Field:
    """Read a Gwyddion Simple Field without interpreting its header.

    The header is read here and not by a library because its sizes must be checked before memory is
    asked for, and because headers with further equal signs or Latin-1 text occur.

    Parameters
    ----------
    path : Path
        The .gsf file.

    Raises
    ------
    FileFormatError
        If the file is no such field, or its length does not fit its header.
    """
    content = path.read_bytes()
    if not content.startswith(_MAGIC):
        raise _damaged(path, "the line 'Gwyddion Simple Field 1.0'", f"{content[:24]!r}")
    end = content.find(b"\0", 0, _LONGEST_HEADER)
    if end < 0:
        raise _damaged(path, "a header that ends with a zero byte", "none")
    header = _header(content[:end])
    width, height = _count(path, header, "XRes"), _count(path, header, "YRes")
    # One to four zero bytes bring the data to a multiple of four.
    start = end + 4 - end % 4
    expected, arrived = 4 * width * height, len(content) - start
    if arrived != expected:
        raise _damaged(path, f"{expected} bytes of data for {width} x {height} pixels", f"{max(arrived, 0)}")
    with np.errstate(invalid="ignore"):  # a signalling NaN is a NaN like any other
        values = np.frombuffer(content, dtype="<f4", offset=start).astype(np.float64)
    return Field(values.reshape(height, width), header)


def read(path: Path) -> Recording:
    """Read a lone Gwyddion Simple Field as a recording of one channel.

    The channel bears the title of the field, or the name of the file where there is none.

    Parameters
    ----------
    path : Path
        The .gsf file.

    Raises
    ------
    FileFormatError
        If the file is damaged.
    """
    field = read_field(path)
    notes: list[str] = []
    name = field.header.get("Title") or path.stem
    values, unit = in_si(field, name, notes)
    return Recording(
        path=path,
        format="gsf",
        vendor="gwyddion",
        dims=("y", "x"),
        coords=pixel_centres(field, notes),
        channels=(Channel(name, values, unit),),
        metadata=dict(field.header),
        notes=tuple(notes),
    )


def in_si(field: Field, name: str, notes: list[str]) -> tuple[npt.NDArray[np.float64], str | None]:
    """Return the values in SI units with the unit; None and a note where the header states no known one."""
    stated = field.header.get("ZUnits", "")
    if not stated:
        notes.append(f"{name}: the file states no unit")
        return field.values, None
    known = to_si(stated)
    if known is None:
        notes.append(f"{name}: the unit {stated!r} is not known; values are as in the file")
        return field.values, None
    return field.values * known[0], known[1]


def pixel_centres(field: Field, notes: list[str]) -> dict[str, npt.NDArray[np.float64]]:
    """Return the coordinates of the pixel centres in metres, row 0 with the largest y.

    The origin is the lower left corner of the image; the position on the scanner stays in the
    metadata. Without a usable size there are no coordinates, and a note says so.
    """
    size_x, size_y = number(field.header.get("XReal", "")), number(field.header.get("YReal", ""))
    known = to_si(field.header.get("XYUnits", ""))
    if known is None or known[1] != "m" or not (0.0 < size_x < math.inf and 0.0 < size_y < math.inf):
        notes.append("the file states no usable image size, so there are no coordinates")
        return {}
    return centres(field.values.shape, size_x * known[0], size_y * known[0])


def centres(shape: tuple[int, ...], size_x: float, size_y: float) -> dict[str, npt.NDArray[np.float64]]:
    """Return the pixel centres [m] of an image of this shape and size [m], row 0 with the largest y."""
    rows, columns = shape
    y: npt.NDArray[np.float64] = (np.arange(rows, dtype=np.float64)[::-1] + 0.5) * (size_y / rows)
    x: npt.NDArray[np.float64] = (np.arange(columns, dtype=np.float64) + 0.5) * (size_x / columns)
    return {"y": y, "x": x}


def number(text: str) -> float:
    """Return the number in a text of the header, NaN where there is none."""
    try:
        return float(text)
    except ValueError:
        return math.nan


def _header(content: bytes) -> dict[str, str]:
    try:
        text = content.decode("utf-8")
    except UnicodeDecodeError:
        text = content.decode("latin-1")
    entries: dict[str, str] = {}
    for line in text.split("\n")[1:]:
        key, equals, value = line.partition("=")
        if equals:
            entries.setdefault(key.strip(), value.strip())
    return entries


def _count(path: Path, header: Mapping[str, str], key: str) -> int:
    text = header.get(key, "")
    # A handful of digits: more is damage, and Python refuses to convert thousands of them.
    if not (text.isascii() and text.isdigit() and len(text) < 10 and int(text) > 0):
        raise _damaged(path, f"{key} as a positive whole number", repr(text[:24]) if text else "none")
    return int(text)


def _damaged(path: Path, expected: str, got: str) -> FileFormatError:
    return FileFormatError(
        f"{path.name} is not a whole Gwyddion Simple Field",
        expected=expected,
        got=got,
        hint="copy or export the file again",
    )
