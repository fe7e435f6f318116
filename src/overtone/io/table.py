"""Tables as text: columns with a name and a unit, separated by commas, semicolons or tabs.

    # instrument: lock-in 2
    x [nm], y [nm], A0 [pm], A1 [nm], phi1 [deg]
    0, 0, -12.5, 60.1, 85.2

Columns ``x`` and ``y`` that fill a rectangle make a map, a column ``z`` makes a curve, and anything
else is a list of points. Behind semicolons and tabs a comma may be the decimal mark.
"""

from __future__ import annotations

import csv
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from overtone.errors import FileFormatError
from overtone.io.recording import Channel, Recording
from overtone.io.si import to_si

_SUFFIXES = (".csv", ".tsv", ".txt", ".dat")
_BYTE_ORDER_MARKS = ((b"\xef\xbb\xbf", "utf-8-sig"), (b"\xff\xfe", "utf-16"), (b"\xfe\xff", "utf-16"))
_CONTROL = re.compile(rb"[\x00-\x08\x0e-\x1f]")
_BRACKETS = re.compile(r"(.*?)\s*[\[(]([^\[\]()]*)[\])]\s*")
_SLASH = re.compile(r"(.*?\S)\s*/\s*(\S.*)")
# Not splitlines, for which some characters of foreign encodings end a line as well.
_LINE_END = re.compile(r"\r\n|\r|\n")
_NO_UNIT = ("", "-", "a.u.", "a. u.", "arb. units")
_LONGEST_NAME = 200
_MISSING = ("", "nan", "na", "n/a", "null", "-", "--")


@dataclass(frozen=True)
class _Column:
    name: str
    unit: str | None
    """SI unit, None where the header gives none that is known."""
    values: npt.NDArray[np.float64]


def sniff(path: Path, head: bytes) -> bool:
    """Tell whether the file is text that begins like a table with a line of column names."""
    try:
        text = _decoded(head)
    except UnicodeDecodeError:
        return False
    if text is None:
        return False
    lines = _LINE_END.split(text)
    if len(lines) > 1 and path.stat().st_size > len(head):
        lines = lines[:-1]  # cut off in the middle
    comments, rows = _comments(lines)
    if not rows:
        return path.suffix.lower() in _SUFFIXES and bool(comments)
    if path.suffix.lower() in _SUFFIXES:
        return True
    separator = _separator(rows[0][1])
    cells = rows[0][1].split(separator) if separator else []
    return len(cells) > 1 and len(rows) > 1 and len(rows[1][1].split(separator)) == len(cells)


def read(path: Path) -> Recording:
    """Read a table of text with a unit in the header of each column.

    Units stand as ``A1 [nm]``, ``A1 (nm)`` or ``A1/nm``; values come out in SI units. Empty cells
    are NaN; a last line without an end that is shorter than all others was cut off. Lines that begin
    with ``#`` are comments, of which ``# key: value`` is kept as metadata.

    Parameters
    ----------
    path : Path
        The table.

    Raises
    ------
    FileFormatError
        If there is no header, no row, or a cell that is no number; the message names line and column.
    """
    content = path.read_bytes()
    try:
        text = _decoded(content)
    except UnicodeDecodeError as error:
        raise _unreadable(path, "text in UTF-8, UTF-16 or Latin-1", str(error)) from error
    if text is None:
        raise _unreadable(path, "text", "control characters")
    comments, rows = _comments(_LINE_END.split(text))
    notes: list[str] = []
    metadata: dict[str, str] = {}
    for comment in comments:
        key, colon, value = comment.partition(":")
        if colon and key.strip():
            metadata.setdefault(key.strip(), value.strip())
    ended = text.endswith(("\n", "\r"))
    if metadata.get("written by", "").startswith("overtone "):
        _check_rows(path, metadata, max(len(rows) - 1, 0), ended)
    columns = _columns(path, comments, rows, ended, notes)
    dims, coords, channels = _arranged(columns, notes)
    return Recording(
        path=path,
        format="table",
        vendor="overtone",
        dims=dims,
        coords=coords,
        channels=channels,
        metadata=metadata,
        notes=tuple(notes),
    )


# --- text -----------------------------------------------------------------------------------------


def _decoded(content: bytes) -> str | None:
    for mark, encoding in _BYTE_ORDER_MARKS:
        if content.startswith(mark):
            if encoding == "utf-16":
                content = content[: len(content) // 2 * 2]
            return content.decode(encoding)
    if _CONTROL.search(content):
        return None
    try:
        return content.decode("utf-8")
    except UnicodeDecodeError as error:
        if error.reason == "unexpected end of data":  # a head may end inside a character
            return content[: error.start].decode("utf-8")
        return content.decode("latin-1")


def _comments(lines: Sequence[str]) -> tuple[list[str], list[tuple[int, str]]]:
    """Part the lines into comments and rows, each row with its number in the file."""
    comments, rows = [], []
    for number, line in enumerate(lines, start=1):
        if line.lstrip().startswith("#"):
            comments.append(line.lstrip().lstrip("#").strip())
        elif line.strip(" \t\r\n,;"):
            rows.append((number, line))
    return comments, rows


def _separator(line: str) -> str:
    """Return what parts the columns of this header, an empty text where there is only one."""
    return next((separator for separator in ("\t", ";", ",") if separator in line), "")


def _unreadable(path: Path, expected: str, got: str, hint: str | None = None) -> FileFormatError:
    return FileFormatError(
        f"{path.name} is not a table that overtone reads",
        expected=expected,
        got=got,
        hint=hint or 'a header such as "x [nm], y [nm], A1 [nm], phi1 [deg]" above rows of numbers',
    )


def _check_rows(path: Path, metadata: Mapping[str, str], rows: int, ended: bool) -> None:
    """Refuse a table that overtone wrote where rows are missing, or the end of the last one."""
    stated = metadata.get("rows")
    if stated is not None and (stated != str(rows) or not ended):
        got = f"{rows}" if ended else f"{rows}, the last without its end"
        hint = "copy the file again, or take the line out that states them where rows were removed on purpose"
        raise _unreadable(path, f"{stated[:20]} rows as its first lines say", got, hint)


# --- columns --------------------------------------------------------------------------------------


def _columns(
    path: Path, comments: Sequence[str], rows: list[tuple[int, str]], ended: bool, notes: list[str]
) -> list[_Column]:
    if not rows:
        raise _unreadable(path, "a header and rows of numbers", "an empty table")
    header, body = rows[0][1], rows[1:]
    if _is_numeric(header):
        # NumPy writes its header as a comment.
        separator = _separator(header)
        if not comments or comments[-1].count(separator or ",") != header.count(separator or ","):
            raise _unreadable(path, "column names in the first line", repr(header[:60]))
        header, body = comments[-1], rows
    separator = _separator(header)
    names = _cells(path, [(rows[0][0], header)], separator)[0]
    while names and not names[-1]:
        names.pop()
    if max(map(len, names), default=0) > _LONGEST_NAME:
        raise _unreadable(path, "column names of ordinary length", f"{max(map(len, names))} characters")
    headings = [_heading(name or f"column {i + 1}", notes) for i, name in enumerate(names)]
    duplicates = {name for name, _, _ in headings if sum(other == name for other, _, _ in headings) > 1}
    if duplicates:
        raise _unreadable(path, "every column name once", f"{', '.join(sorted(duplicates))} twice")
    if not body:
        raise _unreadable(path, "rows of numbers below the header", "none")
    cells = _cells(path, body, separator)
    if not ended and len(cells[-1]) < len(names) and all(len(row) >= len(names) for row in cells[:-1]):
        got = f"{len(cells[-1])} and the end of the file"
        raise _unreadable(path, f"{len(names)} cells in line {body[-1][0]}", got, "copy or export it again")
    for (line, _), row in zip(body, cells, strict=True):
        if any(row[len(names) :]):
            raise _unreadable(path, f"{len(names)} cells in line {line}", f"{len(row)}")
    numbers = _numbers(path, cells, [line for line, _ in body], [name for name, _, _ in headings], separator)
    return [
        _Column(name, unit, numbers[:, i] * factor if factor != 1.0 else numbers[:, i])
        for i, (name, unit, factor) in enumerate(headings)
    ]


def _cells(path: Path, rows: Sequence[tuple[int, str]], separator: str) -> list[list[str]]:
    try:
        parsed = csv.reader((line for _, line in rows), delimiter=separator or ",", skipinitialspace=True)
        cells = [[cell.strip() for cell in row] for row in parsed]
    except csv.Error as error:
        raise _unreadable(path, "cells of text", str(error)) from error
    if len(cells) != len(rows):
        raise _unreadable(path, "one row a line", "quotation marks that span lines")
    return cells


def _is_numeric(line: str) -> bool:
    separator = _separator(line)
    cells = [cell.strip().strip('"') for cell in (line.split(separator) if separator else [line])]
    return all(cell.lower() in _MISSING or not math.isnan(_number(cell.replace(",", "."))) for cell in cells)


def _heading(text: str, notes: list[str]) -> tuple[str, str | None, float]:
    """Return name, SI unit and factor of a column's heading."""
    name, stated = text, None
    match = _BRACKETS.fullmatch(text)
    if match:
        name, stated = match.group(1) or text, match.group(2).strip()
    else:
        match = _SLASH.fullmatch(text)
        if match and to_si(match.group(2)) is not None:
            name, stated = match.group(1), match.group(2)
    if stated is None or stated.lower() in _NO_UNIT:
        notes.append(f"{name}: the header states no unit")
        return name, None, 1.0
    known = to_si(stated)
    if known is None:
        notes.append(f"{name}: the unit {stated!r} is not known; values are as in the file")
        return name, None, 1.0
    return name, known[1], known[0]


def _numbers(
    path: Path, cells: list[list[str]], lines: Sequence[int], names: Sequence[str], separator: str
) -> npt.NDArray[np.float64]:
    decimal_comma = separator in (";", "\t") and any("," in cell for row in cells for cell in row)
    numbers = np.full((len(cells), len(names)), math.nan)
    for i, row in enumerate(cells):
        for j, cell in enumerate(row[: len(names)]):
            mixed = decimal_comma and "." in cell
            value = _number(cell.replace(",", ".") if decimal_comma else cell)
            if mixed or (math.isnan(value) and cell.lower() not in _MISSING):
                raise _unreadable(
                    path,
                    f"a number in line {lines[i]}, column {names[j]!r}" + " with a decimal comma" * mixed,
                    repr(cell[:40]),
                    "correct the cell, or leave it empty where nothing was measured",
                )
            numbers[i, j] = value
    return numbers


def _number(text: str) -> float:
    try:
        return math.nan if "_" in text else float(text)
    except ValueError:
        return math.nan


# --- arrangement ----------------------------------------------------------------------------------


def _arranged(
    columns: list[_Column], notes: list[str]
) -> tuple[tuple[str, ...], dict[str, npt.NDArray[np.float64]], tuple[Channel, ...]]:
    by_name = {column.name: column for column in columns}
    x, y = (by_name.get(name, by_name.get(name.upper())) for name in ("x", "y"))
    z = by_name.get("z")
    if x is not None and y is not None:
        order = _grid(x.values, y.values)
        if order is not None:
            rest = [column for column in columns if column is not x and column is not y]
            channels = tuple(Channel(c.name, c.values[order], c.unit) for c in rest)
            if x.unit == "m" and y.unit == "m":
                return ("y", "x"), {"y": y.values[order[:, 0]], "x": x.values[order[0]]}, channels
            notes.append("x and y are no lengths, so there are no coordinates")
            return ("y", "x"), {}, channels
        notes.append("x and y do not fill a rectangle, so the rows are points")
    elif x is None and y is None and z is not None and z.unit == "m":
        rest = [column for column in columns if column is not z]
        return ("z",), {"z": z.values}, tuple(Channel(c.name, c.values, c.unit) for c in rest)
    return ("point",), {}, tuple(Channel(c.name, c.values, c.unit) for c in columns)


def _grid(x: npt.NDArray[np.float64], y: npt.NDArray[np.float64]) -> npt.NDArray[np.intp] | None:
    """Return which row of the table each pixel is, row 0 with the largest y; None without a full grid."""
    column, columns = _steps(x)
    row, rows = _steps(y)
    if rows * columns != x.size or x.size < 2:
        return None
    pixel = (rows - 1 - row) * columns + column
    order = np.full(x.size, -1, dtype=np.intp)
    order[pixel] = np.arange(x.size)
    return order.reshape(rows, columns) if (order >= 0).all() else None


def _steps(values: npt.NDArray[np.float64]) -> tuple[npt.NDArray[np.intp], int]:
    """Return the rank of each value among the different ones, and how many those are."""
    if not np.isfinite(values).all():
        return np.zeros(values.size, dtype=np.intp), 0
    order = np.argsort(values, kind="stable")
    ordered = values[order]
    # Values that differ by rounding alone are the same position.
    tolerance = 1e-9 * float(np.abs(values).max())
    rank = np.concatenate([[0], np.cumsum(np.diff(ordered) > tolerance)])
    steps = np.empty(values.size, dtype=np.intp)
    steps[order] = rank
    return steps, int(rank[-1]) + 1
