"""Nanosurf images (.nid): settings as text in sections, a line that begins with ``#!``, then whole numbers.

The data sets follow each other in the order of their groups and channels. A number n of b bits stands for
``Dim2Min + Dim2Range (n + 2^(b-1)) / 2^b``. Lines are stored from the bottom of the image to its top whatever the
scan direction was, and the points of a backward line from left to right like those of a forward one; Nanosurf's
own examples and Gwyddion show them so.

The settings stand in the file twice: rounded to three digits among the infos that the software shows, and in full
among the parameters, where some are left over from another mode. A parameter counts where it agrees with the info.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from overtone.errors import FileFormatError
from overtone.io.gsf import centres
from overtone.io.nanosurf_settings import Settings, facts_of, notes_of, number, quantity_of, resonances_of
from overtone.io.recording import Channel, Recording
from overtone.io.si import to_si

_BEGINNING = b"[DataSet]"
_END_OF_HEADER = b"\n#!"
_BYTE_ORDER_MARK = b"\xef\xbb\xbf"
_REFERENCE = re.compile(r"Gr(\d{1,6})-Ch(\d{1,6})")
_MOST_DATA_SETS = 1000
_LARGEST_VALUE = 1e100
_LONGEST_ENTRY = 1000
# Direction of the lines, and whether they are of a second pass over each line.
_FRAMES = {
    "Scan forward": ("trace", False),
    "Scan backward": ("retrace", False),
    "2nd scan forward": ("trace", True),
    "2nd scan backward": ("retrace", True),
}
# A lock-in amplitude cannot be negative: what lies this far below zero, by the share of the range, is a marker.
_BELOW_ZERO = 0.01
_SAME_SIZE = 0.01


@dataclass(frozen=True)
class _DataSet:
    """One channel of one frame: what its section says and where its numbers lie."""

    frame: str
    name: str
    shape: tuple[int, int]
    item: str
    at: int
    unit: str
    minimum: float
    span: float
    size: tuple[tuple[float, str], tuple[float, str]]
    """Extent along x and y with its unit."""
    line: int
    """Line at which the scanner stood when the file was stored."""


def sniff(path: Path, head: bytes) -> bool:
    """Tell whether the file begins with the first section of a Nanosurf image."""
    return head.removeprefix(_BYTE_ORDER_MARK).lstrip().startswith(_BEGINNING)


def read(path: Path) -> Recording:
    """Read the images of a Nanosurf file.

    Forward lines are the trace, backward lines the retrace; a second scan of each line counts as another pass.
    Curves and spectra in the same file are left out, with a note. Where the electronics left a marker instead of a
    value the pixel is NaN.

    Parameters
    ----------
    path : Path
        The .nid file.

    Raises
    ------
    FileFormatError
        If the file is damaged or holds no image.
    """
    content = path.read_bytes()
    end = content.find(_END_OF_HEADER)
    if end < 0:
        raise _damaged(path, "a header that ends with a line '#!'", "none")
    sections = _sections(content[:end])
    data_sets = _data_sets(path, sections, start=end + len(_END_OF_HEADER), size=len(content))
    notes: list[str] = []
    images = _images(path, data_sets, notes)
    settings = Settings.of(sections)
    values: list[npt.NDArray[np.float64]] = []
    for frame in dict.fromkeys(image.frame for image in images):
        values += _values(content, [image for image in images if image.frame == frame], notes)
    channels = []
    for image, array in zip(images, values, strict=True):
        direction, second_pass = _FRAMES[image.frame]
        known = to_si(image.unit) if image.unit else None
        if known is None:
            notes.append(f"{image.name}: the unit {image.unit!r} is not known; values are as in the file")
        factor, unit = known if known is not None else (1.0, None)
        channels.append(Channel(image.name, array * factor, unit, direction, nap=second_pass))
    return Recording(
        path=path,
        format="nanosurf",
        vendor="nanosurf",
        dims=("y", "x"),
        coords=_coordinates(images[0], settings, notes),
        channels=tuple(channels),
        facts=facts_of(settings, channels),
        resonances=resonances_of(settings),
        metadata=_metadata(sections),
        notes=(*notes, *notes_of(settings, channels)),
    )


# --- the header -----------------------------------------------------------------------------------


def _sections(raw: bytes) -> dict[str, dict[str, str]]:
    try:
        text = raw.decode("utf-8-sig")
    except UnicodeDecodeError:
        text = raw.decode("latin-1")
    sections: dict[str, dict[str, str]] = {}
    entries: dict[str, str] = {}
    for line in text.splitlines():
        key, equals, value = line.partition("=")
        if not equals and line.startswith("[") and line.rstrip().endswith("]"):
            entries = sections.setdefault(line.strip()[1:-1], {})
        elif equals and not key.startswith("--"):  # "-- Scan --" is a heading
            entries.setdefault(key.strip(), value.strip())
    return sections


def _data_sets(
    path: Path, sections: Mapping[str, Mapping[str, str]], *, start: int, size: int
) -> list[_DataSet]:
    """Return every data set of the file; each lies behind the one before it, and the last ends with the file."""
    table = sections.get("DataSet", {})
    found = [(match, key) for name, key in table.items() if (match := _REFERENCE.fullmatch(name))]
    found.sort(key=lambda entry: (int(entry[0][1]), int(entry[0][2])))
    if not found:
        raise _damaged(path, "channels in its section [DataSet]", "none")
    if len(found) > _MOST_DATA_SETS:
        raise _damaged(path, f"at most {_MOST_DATA_SETS} data sets", f"{len(found)}")
    data_sets, taken, at = [], set(), start
    for match, key in found:
        section = sections.get(key)
        if section is None:
            raise _damaged(path, f"a section [{key[:40]}]", "none")
        group, channel = match.groups()
        one = _data_set(path, key, section, table.get(f"Gr{group}-Name", ""), at)
        at += one.shape[0] * one.shape[1] * int(one.item[2])
        name = one.name or f"channel {channel}"
        if (one.frame, name) in taken:
            name = f"{name} (Ch{channel})"  # the input of the z controller repeats a channel
        taken.add((one.frame, name))
        data_sets.append(_DataSet(**{**vars(one), "name": name}))
    if at != size:
        raise _damaged(path, f"{at - start} bytes of data for {len(data_sets)} data sets", f"{size - start}")
    return data_sets


def _data_set(path: Path, key: str, section: Mapping[str, str], group: str, at: int) -> _DataSet:
    stored = tuple(section.get(name, "") for name in ("SaveMode", "SaveBits", "SaveSign", "SaveOrder"))
    item = {"16": "<i2", "32": "<i4"}.get(stored[1], "")
    if not item or (stored[0], *stored[2:]) != ("Binary", "Signed", "Intel"):
        raise _damaged(
            path, "signed numbers of 16 or 32 bits in Intel order", " ".join(stored)[:60] or "no storage type"
        )
    minimum, span = (_scale(path, key, section, name) for name in ("Dim2Min", "Dim2Range"))
    sizes = [(number(section.get(f"Dim{i}Range", "")), section.get(f"Dim{i}Unit", "")) for i in (0, 1)]
    line = section.get("CurLine", "")
    return _DataSet(
        frame=section.get("Frame", group),
        name=section.get("Dim2Name", ""),
        shape=(_count(path, key, section, "Lines"), _count(path, key, section, "Points")),
        item=item,
        at=at,
        unit=section.get("Dim2Unit", ""),
        minimum=minimum,
        span=span,
        size=(sizes[0], sizes[1]),
        line=int(line) if _is_count(line) else 0,
    )


def _is_count(text: str) -> bool:
    # A handful of digits: more is damage, and Python refuses to convert thousands of them.
    return text.isascii() and text.isdigit() and len(text) < 10


def _count(path: Path, key: str, section: Mapping[str, str], name: str) -> int:
    text = section.get(name, "")
    if not (_is_count(text) and int(text) > 0):
        raise _damaged(path, f"{name} of [{key[:40]}] as a positive whole number", repr(text[:24]))
    return int(text)


def _scale(path: Path, key: str, section: Mapping[str, str], name: str) -> float:
    value = number(section.get(name, ""))
    if not abs(value) <= _LARGEST_VALUE:
        raise _damaged(path, f"{name} of [{key[:40]}] as a number", repr(section.get(name, "")[:24]))
    return value


def _metadata(sections: Mapping[str, Mapping[str, str]]) -> dict[str, str]:
    """Return the header without what it says twice, the points of curves and the settings of the camera."""
    shown = sections.get("DataSet-Info", {})
    metadata = dict(shown)
    for section, entries in sections.items():
        if section == "DataSet-Info" or (shown and section.startswith("DataSet\\DataSetInfos")):
            continue
        prefix = section.removeprefix("DataSet\\")
        for key, value in entries.items():
            if not key.startswith("LineDim") and len(value) <= _LONGEST_ENTRY:
                metadata.setdefault(f"{prefix}\\{key}", value)
    return metadata


# --- the images -----------------------------------------------------------------------------------


def _images(path: Path, data_sets: Sequence[_DataSet], notes: list[str]) -> list[_DataSet]:
    """Return the data sets that are images of one shape and size; say what is left out."""
    images = [one for one in data_sets if one.frame in _FRAMES]
    others = dict.fromkeys(one.frame for one in data_sets if one.frame not in _FRAMES)
    if not images:
        raise FileFormatError(
            f"{path.name} holds no image",
            expected="one of " + ", ".join(_FRAMES),
            got=", ".join(list(others)[:6])[:200],
            hint="export curves and spectra as one table (CSV) with units in its header",
        )
    if others:
        names = ", ".join(list(others)[:6]) + (", ..." if len(others) > 6 else "")
        notes.append(f"left out, because they are no images: {names}")
    first = images[0]
    alike = [one for one in images if (one.shape, one.size) == (first.shape, first.size)]
    for one in images:
        if one not in alike:
            notes.append(f"{one.frame} {one.name}: left out, its pixels are not those of {first.name}")
    if first.line not in (0, first.shape[0] - 1):
        notes.append(
            f"the file was stored at line {first.line + 1} of {first.shape[0]}: what the scanner had not reached yet "
            "is of the scan before"
        )
    return alike


def _values(content: bytes, images: Sequence[_DataSet], notes: list[str]) -> list[npt.NDArray[np.float64]]:
    """Return the values of the channels of one frame, row 0 at the top, without what is no value."""
    raw = [
        np.frombuffer(content, one.item, one.shape[0] * one.shape[1], one.at).reshape(one.shape)[::-1]
        for one in images
    ]
    values = []
    frame = images[0].frame
    lost = np.zeros(images[0].shape, dtype=bool)
    for one, numbers in zip(images, raw, strict=True):
        full = 2.0 ** (8 * numbers.itemsize)
        array = (numbers + full / 2.0) * (one.span / full) + one.minimum
        values.append(array)
        below = array < -_BELOW_ZERO * abs(one.span)
        if one.name == "Amplitude" and 0 < below.sum() <= 0.5 * below.size:
            notes.append(
                f"{frame}: {below.sum()} pixels have an amplitude below zero, where the electronics stopped; they "
                "are NaN in all channels"
            )
            lost |= below
    # A line that was never scanned holds one and the same number in every channel.
    blank = np.all([_at_rest(numbers) for numbers in raw], axis=0)
    if blank.any():
        notes.append(f"{frame}: {blank.sum()} of {blank.size} lines were not recorded; they are NaN")
    lost |= blank[:, np.newaxis]
    for one, numbers, array in zip(images, raw, values, strict=True):
        limits = np.iinfo(numbers.dtype)
        known = to_si(one.unit)
        # A phase passes through the ends of its range, everything else stops there.
        at_end = (numbers == limits.min) | (numbers == limits.max)
        at_end &= ~lost
        if at_end.any() and not (known is not None and known[1] == "rad"):
            notes.append(
                f"{frame}, {one.name}: {at_end.sum()} pixels sit at an end of the converter's range; they are NaN"
            )
            array[at_end] = np.nan
        array[lost] = np.nan
    return values


def _at_rest(numbers: npt.NDArray[np.signedinteger]) -> npt.NDArray[np.bool_]:
    limits = np.iinfo(numbers.dtype)
    first = numbers[:, :1]
    still: npt.NDArray[np.bool_] = (numbers == first).all(axis=1)
    return still & np.isin(first[:, 0], (0, limits.min, limits.max))


def _coordinates(image: _DataSet, settings: Settings, notes: list[str]) -> dict[str, npt.NDArray[np.float64]]:
    sizes = []
    for size, unit in image.size:
        known = to_si(unit) if unit else None
        if known is None or known[1] != "m" or not 0.0 < size * known[0] < 1.0:
            notes.append("the file states no usable image size, so there are no coordinates")
            return {}
        sizes.append(size * known[0])
    shown = quantity_of(settings.info.get("Image size", ""), "m")
    if shown is not None and not np.isclose(shown, sizes[0], rtol=_SAME_SIZE):
        notes.append(
            f"Image size {shown:g} m and the {sizes[0]:g} m of the data disagree; the data were believed"
        )
    return centres(image.shape, sizes[0], sizes[1])


def _damaged(path: Path, expected: str, got: str) -> FileFormatError:
    return FileFormatError(
        f"{path.name} is not a whole Nanosurf file",
        expected=expected,
        got=got,
        hint="copy or save the file again",
    )
