"""NanoScope images of Bruker, Veeco and Digital Instruments (.spm, .000, .001, ..., .di), from version 4.3 on.

A pixel is a count of two or four bytes; its value is count x ``Z scale`` / 2^(8 bytes) x sensitivity. The hard scale in
parentheses (volts a count) is the same thing only until somebody changes the image in the offline software, which
fits it to the range of the counts again; what the file calls ``Z offset`` is not part of the value.
The bottom line comes first, whatever the direction of the frame, and a retrace is stored from left to right.
``Realtime Planefit`` is what the screen showed during the scan and does not touch the data; ``Offline Planefit`` does.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from overtone.errors import FileFormatError
from overtone.io.ciao import (
    MOST_LISTS,
    Header,
    Parameters,
    number_of,
    parse_header,
    parse_selected,
    parse_value,
    raw_metadata,
    spelled,
    split_header,
)
from overtone.io.gsf import centres
from overtone.io.recording import Channel, Fact, Recording
from overtone.io.si import to_si

_MAGIC = (b"\\*File list", b"\\*Force file list", b"\\*EC File list")
_IMAGE = "Ciao image list"
_FORCE_IMAGE = "Ciao force image list"
_LARGEST_HEADER = 1 << 21
_ITEM_SIZES = (2, 4)
_DIRECTIONS = {"trace": "trace", "retrace": "retrace"}
# What tapping mode calls the amplitude; where its own sensitivity has no unit, that of all amplitudes applies.
_AMPLITUDES = ("AmplitudeActual", "Amplitude", "Amplitude1", "AmplitudeError")
_DIFFERENCE = "AmplitudeError"
_SETPOINT = "TMSetAmplitude"
_DRIVE_FREQUENCY = ("CantFrequency", "Drive frequency")
_DRIVE_AMPLITUDE = ("CantDrive", "Drive amplitude")
_DRIVE_PHASE = ("CantPhase", "Drive phase")
_AMPLITUDE_SENSITIVITIES = ("Sens. AmplSens", "Sens. Amplitude")
_DEFLECTION_SENSITIVITIES = ("Sens. DeflSens", "Sens. Deflection")
_SAME = 0.01

Floats = npt.NDArray[np.float64]


@dataclass(frozen=True)
class _Image:
    """Where an image lies in the file and how it is stored, its sizes checked against the file."""

    number: int
    own: Parameters
    start: int
    lines: int
    samples: int
    item_size: int
    """Bytes a pixel takes in the file."""
    scale_size: int
    """Bytes a pixel has for its scale; 4-byte files may state 2."""


def sniff(path: Path, head: bytes) -> bool:
    """Tell whether the file begins with the first list of a NanoScope header."""
    return head.startswith(_MAGIC)


def read(path: Path) -> Recording:
    """Read the images of a NanoScope file.

    Channels bear the software's internal names, such as ``AmplitudeError`` or ``ZSensor``; ``Nap`` stands before the
    name of an interleaved or lifted pass. Lengths are in metres where the sensitivity has a unit, in volts where it
    has none; phases become radians. The pixels of a line that was never scanned are NaN.

    Parameters
    ----------
    path : Path
        The file.

    Raises
    ------
    FileFormatError
        If the file is damaged, older than version 4.3, or holds force curves and no image.
    """
    size = path.stat().st_size
    with path.open("rb") as stream:
        text = split_header(stream.read(_LARGEST_HEADER))
        if text is None:
            raise _damaged(path, "a header that ends with Ctrl-Z or '*File list end'", "none")
        header = parse_header(text)
        if len(header.lists) > MOST_LISTS:
            raise _damaged(path, f"at most {MOST_LISTS} lists in its header", "more")
        images = _images(path, header, size)
        notes: list[str] = []
        channels: list[Channel] = []
        facts: dict[str, Fact] = {}
        first = images[0]
        for image in images:
            if (image.lines, image.samples) != (first.lines, first.samples):
                notes.append(
                    f"image {image.number}: left out, {image.lines} x {image.samples} pixels where the first has "
                    f"{first.lines} x {first.samples}"
                )
                continue
            stream.seek(image.start)
            content = stream.read(image.lines * image.samples * image.item_size)
            counts = np.frombuffer(content, f"<i{image.item_size}").reshape(image.lines, image.samples)[::-1]
            channels.append(_channel(path, header, image, counts, facts, notes))
    if header.titled(_FORCE_IMAGE):
        notes.append("the force curves in the file were left out: only its images are read")
    return Recording(
        path=path,
        format="nanoscope",
        vendor="bruker",
        dims=("y", "x"),
        coords=_coordinates(header, first, notes),
        channels=tuple(channels),
        facts=_facts(header, channels, notes) | facts,
        metadata=raw_metadata(header, _IMAGE),
        notes=tuple(notes),
    )


# --- the file -------------------------------------------------------------------------------------


def _images(path: Path, header: Header, size: int) -> list[_Image]:
    """Check the place of every image against the file before memory is asked for."""
    lists = header.titled(_IMAGE)
    if not lists:
        curves = bool(header.titled(_FORCE_IMAGE)) or header.lists[0].title.lower().startswith("force")
        version = header.text("Version")
        raise FileFormatError(
            f"{path.name} holds no image that overtone reads",
            expected=f"a NanoScope file of version 4.3 or later with a list named {_IMAGE!r}",
            got="force curves" if curves else f"none, version {version[:20] if version else 'not stated'}",
            hint="export the curve as a table (CSV) with units in its header"
            if curves
            else "save the image again in NanoScope Analysis",
        )
    images = [_image(path, number, own, size) for number, own in enumerate(lists, start=1)]
    total = sum(image.lines * image.samples * image.item_size for image in images)
    if total > size:
        raise _damaged(path, f"images of at most {size} bytes, as long as the file", f"{total} stated")
    return images


def _image(path: Path, number: int, own: Parameters, size: int) -> _Image:
    where = f"image {number}"
    start, length = _count(path, own, "Data offset", where), _count(path, own, "Data length", where)
    samples, lines = _count(path, own, "Samps/line", where), _count(path, own, "Number of lines", where)
    stated = _count(path, own, "Bytes/pixel", where) if own.text("Bytes/pixel") is not None else 2
    if start + length > size:
        raise _damaged(
            path, f"{start + length} bytes for {where} as its header says", f"{size}: it was cut off"
        )
    item_size = length // (samples * lines)
    if item_size not in _ITEM_SIZES or item_size * samples * lines != length:
        raise _damaged(
            path, f"{stated * samples * lines} bytes for {lines} x {samples} pixels of {where}", f"{length}"
        )
    if stated != item_size and not (stated == 2 and _counts_are_short(own)):
        raise _damaged(path, f"{stated} bytes a pixel in {where}", f"{item_size} by the length of its data")
    return _Image(number, own, start, lines, samples, item_size, stated)


def _counts_are_short(own: Parameters) -> bool:
    """Tell whether the value of one count says that the scale spans 2^16 counts."""
    found = own.find("Z scale")
    value = parse_value(found[1]) if found else None
    return value is not None and value.count is not None and _agree(value.count * 2.0**16, value.number)


def _agree(one: float, other: float) -> bool:
    return math.isclose(one, other, rel_tol=_SAME)


def _count(path: Path, own: Parameters, key: str, where: str) -> int:
    text = (own.text(key) or "").strip()
    if not (text.isascii() and text.isdigit() and len(text) < 13 and int(text) > 0):
        raise _damaged(
            path, f"{key} of {where} as a positive whole number", repr(text[:24]) if text else "none"
        )
    return int(text)


def _damaged(path: Path, expected: str, got: str) -> FileFormatError:
    return FileFormatError(
        f"{path.name} is not a whole NanoScope file", expected=expected, got=got, hint="copy the file again"
    )


# --- channels -------------------------------------------------------------------------------------


def _channel(
    path: Path,
    header: Header,
    image: _Image,
    counts: npt.NDArray[np.integer],
    facts: dict[str, Fact],
    notes: list[str],
) -> Channel:
    """Return a channel in SI units; add what has to be added to it to the facts."""
    own = image.own
    name, nap = _name(image)
    found = own.find("Z scale", ("2", "3", "4", "1", ""))
    scale = parse_value(found[1]) if found else None
    if scale is None or scale.number == 0.0:
        got = repr(found[1][:60]) if found else "none"
        raise _damaged(path, f"@2:Z scale of image {image.number} ({name}) as a value with its unit", got)
    scaling = header.scaling(scale.unit, scale.sensitivity)
    factor = scale.number / 2.0 ** (8 * image.scale_size) * scaling.factor
    if not (math.isfinite(factor) and factor != 0.0):
        raise _damaged(path, f"a scale of {name} above zero", f"{factor:g}")
    if scale.sensitivity and header.text(f"@{scale.sensitivity}") is None:
        notes.append(
            f"{name}: its sensitivity ({scale.sensitivity}) is not in the file, so it stays in {scale.unit}"
        )
    if scaling.unit is None:
        notes.append(f"{name}: its unit is not known; values are as in the file")
    values = counts.astype(np.float64) * factor
    lost = _unscanned(own, counts)
    if lost.any():
        values[lost] = np.nan
        notes.append(f"{name}: {int(lost.sum())} of {image.lines} lines were not scanned and have no value")
    setpoint = header.value(_SETPOINT)
    if name == _DIFFERENCE and setpoint is not None and _amplitude_is_kept(header):
        key, value = setpoint
        of_setpoint = header.scaling(value.unit, scale.sensitivity)
        if of_setpoint.unit == scaling.unit and scaling.unit is not None:
            key = f"{key} x {of_setpoint.key}" if of_setpoint.key else key
            facts[f"offset:{name}"] = Fact(value.number * of_setpoint.factor, scaling.unit, key)
    return Channel(
        name=name,
        values=values,
        unit=scaling.unit,
        direction=_DIRECTIONS.get((own.text("Line direction") or "").lower()),
        nap=nap,
        flattened=_flattened(own, name, counts, notes),
    )


def _name(image: _Image) -> tuple[str, bool]:
    found = image.own.find("Image Data", ("2", "3", "4", "1", ""))
    inner, label = parse_selected(found[1]) if found else ("", "")
    nap = (image.own.text("Scan line") or "main").lower() not in ("main", "")
    name = inner or label or f"image {image.number}"
    return (f"Nap{name}" if nap else name), nap


def _unscanned(own: Parameters, counts: npt.NDArray[np.integer]) -> npt.NDArray[np.bool_]:
    """Return the lines that hold one value throughout, at the end of the range or where no data are valid."""
    limits = np.iinfo(counts.dtype)
    still = counts.min(axis=1) == counts.max(axis=1)
    lost = (counts[:, 0] == limits.min) | (counts[:, 0] == limits.max)
    start, length = (number_of(own.text(f"Valid data {what} Y") or "") for what in ("start", "len"))
    if start is not None and length is not None and length > 0.0:
        from_below = np.arange(len(counts))[::-1]
        lost = lost | (from_below < start) | (from_below >= start + length)
    unscanned: npt.NDArray[np.bool_] = still & lost
    return unscanned


def _flattened(own: Parameters, name: str, counts: npt.NDArray[np.integer], notes: list[str]) -> bool | None:
    stated = own.text("Offline planefit")
    if stated is not None and stated.lower() not in ("none", ""):
        return True
    # A line fit by other means shows as well: every line averages to zero within one count. An error
    # signal does so by itself.
    if not name.endswith("Error") and counts.any() and (abs(counts.mean(axis=1)) <= 1.0).all():
        notes.append(f"{name}: every line averages to zero, so a fit of each line was subtracted from it")
        return True
    return None if stated is None else False


def _coordinates(header: Header, image: _Image, notes: list[str]) -> dict[str, Floats]:
    """Return the pixel centres in metres.

    The image list holds width and height, but where the scan is not square either of them may stand there twice;
    then the scan list and the aspect ratio tell.
    """
    own = image.own
    sizes = (own.text("Scan size") or "").split()
    known = to_si(spelled(sizes[-1])) if len(sizes) > 1 else None
    numbers = [number_of(text) for text in sizes[:-1]]
    if known is None or known[1] != "m" or not all(number is not None and number > 0.0 for number in numbers):
        notes.append("the file states no usable image size, so there are no coordinates")
        return {}
    width, height = ((number or 0.0) * known[0] for number in (numbers[0], numbers[-1]))
    ratio = _aspect_ratio(own)
    if width == height and ratio != 1.0:
        scan = next((text for one in header.titled("Ciao scan list") if (text := one.text("Scan size"))), "")
        whole = _length(scan)
        if whole is not None and _agree(width, whole / ratio):
            width = whole
        else:
            height = width / ratio
        notes.append(
            f"the file states the same width and height and an aspect ratio of {own.text('Aspect ratio')}; the image "
            f"was taken to be {width * 1e9:g} nm wide and {height * 1e9:g} nm high"
        )
    return centres((image.lines, image.samples), width, height)


def _aspect_ratio(own: Parameters) -> float:
    """Return width over height as the file states it, 1 where it does not."""
    across, colon, down = (own.text("Aspect ratio") or "").partition(":")
    numbers = number_of(across), number_of(down)
    if not colon or numbers[0] is None or numbers[1] is None or min(numbers[0], numbers[1]) <= 0.0:
        return 1.0
    return numbers[0] / numbers[1]


def _length(text: str) -> float | None:
    number, _, unit = text.partition(" ")
    value, known = number_of(number), to_si(spelled(unit))
    return value * known[0] if value is not None and known is not None and known[1] == "m" else None


# --- what it says ---------------------------------------------------------------------------------


def _facts(header: Header, channels: Sequence[Channel], notes: list[str]) -> dict[str, Fact]:
    facts: dict[str, Fact] = {}

    def add(name: str, keys: Sequence[str], unit: str, group: str = "2") -> None:
        found = header.value(*keys, group=group)
        scaling = header.scaling(found[1].unit, found[1].sensitivity) if found else None
        if found and scaling and scaling.unit == unit and not found[1].linked and found[1].number != 0.0:
            key = f"{found[0]} x {scaling.key}" if scaling.key else found[0]
            facts[name] = Fact(found[1].number * scaling.factor, unit, key)

    stiffness = number_of((header.text("Spring constant") or "").split(" ")[0])
    if stiffness is not None and stiffness > 0.0:
        facts["stiffness"] = Fact(stiffness, "N/m", "Spring Constant")
    for name, keys in (
        ("amplitude_sensitivity", _AMPLITUDE_SENSITIVITIES),
        ("deflection_sensitivity", _DEFLECTION_SENSITIVITIES),
    ):
        for key in keys:
            scaling = header.scaling("V", key)
            if name not in facts and scaling.key and scaling.unit == "m":
                facts[name] = Fact(scaling.factor, "m/V", scaling.key)
    sensitivity = facts.get("amplitude_sensitivity")
    amplitudes = [channel for channel in channels if channel.name.removeprefix("Nap") in _AMPLITUDES]
    in_volts = [channel.name for channel in amplitudes if channel.unit == "V"]
    if sensitivity is not None:
        facts |= {f"scale:{name}": sensitivity for name in in_volts}
    elif in_volts:
        notes.append(
            f"{', '.join(dict.fromkeys(in_volts))}: the file holds no calibration of amplitudes "
            f"(@{_AMPLITUDE_SENSITIVITIES[0]} with a unit), so they are in volts"
        )
    if not _is_tapping(header):
        return facts
    add("drive_frequency", _DRIVE_FREQUENCY, "Hz")
    add("drive_amplitude", _DRIVE_AMPLITUDE, "V")
    add("drive_phase", _DRIVE_PHASE, "rad")
    setpoint = header.value(_SETPOINT)
    plain = header.scaling(setpoint[1].unit, "") if setpoint else None
    if setpoint and plain and plain.unit == "V" and setpoint[1].number > 0.0 and _amplitude_is_kept(header):
        volts = setpoint[1].number * plain.factor
        facts["setpoint_volts"] = Fact(volts, "V", setpoint[0])
        if sensitivity is not None:
            key = f"{setpoint[0]} x {sensitivity.key}"
            facts["setpoint_amplitude"] = Fact(volts * sensitivity.value, "m", key)
    if any(channel.nap for channel in channels):
        add("lift_height", ("Lift scan height",), "m", group="")
        add("lift_drive_frequency", _DRIVE_FREQUENCY, "Hz", group="3")
        add("lift_drive_amplitude", _DRIVE_AMPLITUDE, "V", group="3")
    return facts


def _is_tapping(header: Header) -> bool:
    mode = parse_selected(header.text("@MicroscopeList") or "")
    return mode[0] in ("TMMode", "") or mode[1] == "Tapping"


def _amplitude_is_kept(header: Header) -> bool:
    """Tell whether the amplitude is what the feedback holds at its set-point, as far as the file says."""
    found = header.text("@2:SPMFeedbackList")
    return found is None or parse_selected(found)[1] in ("Amplitude", "")
