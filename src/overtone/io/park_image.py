"""One image of Park Systems (.tiff): one channel, a header of fixed layout and the numbers in private tags.

The picture in the file is a rendering for the eye; the numbers lie in a tag, rows from the bottom, and the
layout of the header is the one that Park published with its own reader. A scan is a set of files, one a
channel and line direction, which `overtone.io.park` puts together.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from overtone.errors import FileFormatError
from overtone.io.gsf import centres
from overtone.io.recording import Channel, Fact
from overtone.io.si import to_si
from overtone.io.tiff import damaged, first_tags, is_tiff, read_pages

_WHAT = "a Park image"
MAGIC, DATA, HEADER = 50432, 50434, 50435
_NUMBER_OF_PARK = 235082497
_DATE_TIME = 306
_HEADER_SIZE = 540
# Offset and type of what the header holds; texts are UTF-16 of so many bytes.
_LAYOUT: Mapping[str, tuple[int, str]] = {
    "dataCategory": (0, "i"),
    "channelName": (4, "64s"),
    "headMode": (68, "16s"),
    "lowPassStrength": (84, "d"),
    "isAutoFlatten": (92, "i"),
    "width": (100, "i"),
    "height": (104, "i"),
    "scanRotation": (108, "d"),
    "overScanRatio": (120, "d"),
    "isFastScanLeftToRight": (128, "i"),
    "isSlowScanBottomToTop": (132, "i"),
    "isXYSwapped": (136, "i"),
    "scanSizeWidth": (140, "d"),
    "scanSizeHeight": (148, "d"),
    "scanOffsetX": (156, "d"),
    "scanOffsetY": (164, "d"),
    "scanRate": (172, "d"),
    "setpoint": (180, "d"),
    "setpointUnit": (188, "16s"),
    "tipBias": (204, "d"),
    "sampleBias": (212, "d"),
    "dataGain": (220, "d"),
    "ZScale": (228, "d"),
    "ZOffset": (236, "d"),
    "unit": (244, "16s"),
    "compression": (272, "i"),
    "isLogScale": (276, "i"),
    "isSquared": (280, "i"),
    "zServoGain": (284, "d"),
    "dataType": (348, "i"),
    "ncmAmplitude": (360, "d"),
    "ncmFrequency": (368, "d"),
    "cantileverName": (384, "32s"),
    "ncmDrivePercent": (416, "d"),
    "isTapping": (480, "i"),
}
_DATA_TYPES = {0: "<i2", 1: "<i4", 2: "<f4"}
_SPECTROSCOPY = 2
_MOST_PIXELS = 1 << 28
# No lever taps further than this; headers state micrometres where they mean nanometres.
_LARGEST_AMPLITUDE = 1e-6


@dataclass(frozen=True)
class Image:
    """One file: its channel, what its header says, and when it was saved."""

    path: Path
    channel: Channel
    header: Mapping[str, Any]
    """By the names that Park gives to the entries: numbers, and texts without padding."""
    time: str
    notes: tuple[str, ...]

    @property
    def is_spectroscopy(self) -> bool:
        """Whether it only shows where spectra were taken."""
        return bool(self.header["dataCategory"] == _SPECTROSCOPY)


def is_park(path: Path, head: bytes) -> bool:
    """Tell whether a file is a TIFF with the private tags of Park."""
    return is_tiff(head) and {MAGIC, HEADER} <= first_tags(path)


def read_image(path: Path) -> Image:
    """Read one file of a scan.

    Parameters
    ----------
    path : Path
        The .tiff file.

    Raises
    ------
    FileFormatError
        If the file is damaged, compressed, or holds a line profile.
    """
    page = read_pages(path, _WHAT)[0]
    header = _header(path, page.tags)
    notes: list[str] = []
    if header["dataCategory"] == _SPECTROSCOPY:
        notes.append("the spectra of this file are not read, only the image that shows where they were taken")
    elif header["dataCategory"] != 0:
        raise FileFormatError(
            f"{path.name} holds a line profile, not an image",
            expected="an image of Park's software",
            got=f"data of category {header['dataCategory']}",
            hint="the file of the image itself",
        )
    raw = _numbers(path, header, page.tags.get(DATA))
    name = header["channelName"] or path.stem
    values, unit = _in_si(name, raw, header, notes)
    channel = Channel(
        name=name,
        values=values,
        unit=unit,
        direction="trace" if header["isFastScanLeftToRight"] else "retrace",
        # Without the mark an image may still have been flattened later on.
        flattened=True if header["isAutoFlatten"] else None,
    )
    return Image(path, channel, header, page.text(_DATE_TIME), tuple(notes))


def coordinates(header: Mapping[str, Any], notes: list[str]) -> dict[str, npt.NDArray[np.float64]]:
    """Return pixel centres [m] from the lower left corner of the scan; the header states micrometres."""
    width, height = (1e-6 * header[key] for key in ("scanSizeWidth", "scanSizeHeight"))
    if not (0.0 < width < 1.0 and 0.0 < height < 1.0):
        notes.append("the file states no usable image size, so there are no coordinates")
        return {}
    if header["scanRotation"]:
        notes.append(f"the scan was turned by {header['scanRotation']:g} deg: x runs along its lines")
    if header["isXYSwapped"]:
        notes.append("the axes of the scan were swapped: its lines run along y")
    return centres((header["height"], header["width"]), width, height)


def facts(header: Mapping[str, Any], notes: list[str]) -> dict[str, Fact]:
    """Return what the header says of the feedback; a set-point in a unit that cannot be is left out."""
    found: dict[str, Fact] = {}
    if header["ncmFrequency"] > 0.0:
        found["drive_frequency"] = Fact(header["ncmFrequency"], "Hz", "ncmFrequency")
    known = to_si(header["setpointUnit"]) if header["setpointUnit"] else None
    value = header["setpoint"] * known[0] if known is not None else math.nan
    unit = known[1] if known is not None else ""
    name = {"m": "setpoint_amplitude", "V": "setpoint_volts"}.get(unit)
    if name is not None and 0.0 < value < (_LARGEST_AMPLITUDE if unit == "m" else math.inf):
        found[name] = Fact(value, unit, "setpoint")
    elif header["setpoint"]:
        notes.append(
            f"not taken as amplitudes of the lever: a set-point of {header['setpoint']:.5g} "
            f"{header['setpointUnit']}, whose unit cannot be right, and an NCM amplitude of "
            f"{header['ncmAmplitude']:.5g}, which has none. Where you know them, give a probe file"
        )
    return found


# --- the file -------------------------------------------------------------------------------------


def _header(path: Path, tags: Mapping[int, Any]) -> dict[str, Any]:
    raw = tags.get(HEADER)
    if tags.get(MAGIC) != _NUMBER_OF_PARK or not isinstance(raw, bytes) or len(raw) < _HEADER_SIZE:
        got = f"{len(raw)} bytes" if isinstance(raw, bytes) else "none"
        raise damaged(path, _WHAT, f"the mark of Park and a header of {_HEADER_SIZE} bytes", got)
    header: dict[str, Any] = {}
    for name, (at, kind) in _LAYOUT.items():
        value = struct.unpack_from("<" + kind, raw, at)[0]
        if isinstance(value, bytes):
            value = value.decode("utf-16-le", "replace").split("\0", 1)[0].strip()
        elif not math.isfinite(value):
            raise damaged(path, _WHAT, f"a finite number as {name}", f"{value}")
        header[name] = value
    return header


def _numbers(path: Path, header: Mapping[str, Any], data: object) -> npt.NDArray[Any]:
    """Return the numbers of the image as stored, row 0 on top."""
    rows, columns = header["height"], header["width"]
    kind = _DATA_TYPES.get(header["dataType"])
    if kind is None or header["compression"]:
        raise FileFormatError(
            f"the numbers of {path.name} are stored in a way that overtone does not read",
            expected="integers of 16 or 32 bits or floats of 32, not compressed",
            got=f"data type {header['dataType']}, compression {header['compression']}",
            hint="save the image again in Park's software without compression",
        )
    if not (rows > 0 and columns > 0 and rows * columns <= _MOST_PIXELS):
        raise damaged(path, _WHAT, "a positive number of pixels", f"{columns} x {rows}")
    needed = rows * columns * np.dtype(kind).itemsize
    if not isinstance(data, bytes) or len(data) != needed:
        arrived = f"{len(data)}" if isinstance(data, bytes) else "none"
        raise damaged(path, _WHAT, f"{needed} bytes of data for {columns} x {rows} pixels", arrived)
    return np.frombuffer(data, kind).reshape(rows, columns)[::-1]


def _in_si(
    name: str, raw: npt.NDArray[Any], header: Mapping[str, Any], notes: list[str]
) -> tuple[npt.NDArray[np.float64], str | None]:
    with np.errstate(all="ignore"):  # a signalling NaN is a NaN like any other, and damage may overflow
        values = raw.astype(np.float64) * header["dataGain"]
    if raw.dtype.kind == "i":
        span = np.iinfo(raw.dtype)
        lost = (raw == span.min) | (raw == span.max)
        if lost.any():
            values[lost] = np.nan
            notes.append(f"{name}: {int(lost.sum())} invalid pixels, at an end of the range of the converter")
    if (header["ZScale"], header["ZOffset"]) != (1.0, 0.0):
        notes.append(
            f"{name}: the header states ZScale {header['ZScale']:g} and ZOffset {header['ZOffset']:g}, which "
            "readers use in different ways; the values are numbers times dataGain, without a unit"
        )
        return values, None
    if header["isLogScale"] or header["isSquared"]:
        how = "logarithms" if header["isLogScale"] else "squares"
        notes.append(f"{name}: the values are {how}, so they have no unit")
        return values, None
    known = to_si(header["unit"]) if header["unit"] else None
    if known is None:
        stated = f"the unit {header['unit']!r} is not known" if header["unit"] else "the file states no unit"
        notes.append(f"{name}: {stated}")
        return values, None
    with np.errstate(over="ignore"):
        return values * known[0], known[1]
