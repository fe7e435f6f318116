"""A scan of a Park microscope: one file, or the files of all channels and both line directions together."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import replace
from datetime import datetime
from pathlib import Path

from overtone.errors import FileFormatError
from overtone.io import park_image
from overtone.io.park_image import Image
from overtone.io.recording import Recording

_HEAD = 8
_SUFFIXES = (".tif", ".tiff")
_MOST_FILES = 2000
_DIRECTIONS = {"forward": "trace", "backward": "retrace"}
_SEPARATORS = re.compile(r"[\s_\-.,()]+")
_SAME_SCAN = (
    "width",
    "height",
    "scanRotation",
    "scanSizeWidth",
    "scanSizeHeight",
    "scanOffsetX",
    "scanOffsetY",
    "scanRate",
    "ncmFrequency",
)
# All channels of a scan are saved at its end, the next scan takes longer than half of this one.
_LONGEST_SAVING = 60.0


def sniff(path: Path, head: bytes) -> bool:
    """Tell whether the path is a Park image, or a folder that holds some."""
    if path.is_dir():
        return next(_park_files(path), None) is not None
    return park_image.is_park(path, head)


def read(path: Path) -> Recording:
    """Read a Park image, or all the images of one scan from their folder.

    Files are of one scan where their names agree but for channel, direction and number, and size, place,
    speed and time agree as well.

    Parameters
    ----------
    path : Path
        A .tiff file, which gives its own channel, or a folder, which gives all of them.

    Raises
    ------
    FileFormatError
        If a file is damaged, or the folder holds several scans.
    """
    if not path.is_dir():
        image = _by_name(park_image.read_image(path))
        return _recording(path, [image], _siblings(image))
    images = [_by_name(park_image.read_image(file)) for file in _park_files(path)]
    scans = _scans([image for image in images if not image.is_spectroscopy] or images)
    if len(scans) != 1:
        listed = [f"{scan[0].path.name} and {len(scan) - 1} more" for scan in scans[:4]]
        raise FileFormatError(
            f"{path.name} holds {len(scans)} scans",
            expected="a folder with the files of one scan",
            got="; ".join(listed) or "no image",
            hint="put the files of one scan into a folder of their own, or open a single file",
        )
    left_out = [image.path.name for image in images if image not in scans[0]]
    notes = [f"left out, because they hold spectra: {', '.join(left_out[:9])}"] if left_out else []
    return _recording(path, scans[0], notes)


def _recording(path: Path, images: Sequence[Image], notes: list[str]) -> Recording:
    header = images[0].header
    notes = [*(note for image in images for note in image.notes), *notes]
    coords = park_image.coordinates(header, notes)
    return Recording(
        path=path,
        format="park",
        vendor="park",
        dims=("y", "x"),
        coords=coords,
        channels=tuple(image.channel for image in images),
        facts=park_image.facts(header, notes),
        metadata={
            **{key: str(value) for key, value in header.items()},
            "time": images[0].time,
            "files": ", ".join(image.path.name for image in images),
        },
        notes=tuple(dict.fromkeys(notes)),
    )


# --- files of one scan ----------------------------------------------------------------------------


def _park_files(folder: Path) -> Iterator[Path]:
    files = sorted(file for file in folder.iterdir() if file.suffix.lower() in _SUFFIXES and file.is_file())
    for file in files[:_MOST_FILES]:
        with file.open("rb") as stream:
            head = stream.read(_HEAD)
        if park_image.is_park(file, head):
            yield file


def _siblings(image: Image) -> list[str]:
    """Return a note that names the files beside an image that belong to the same scan."""
    own = set(_stem(image))
    found = []
    for file in _park_files(image.path.parent):
        if file.name == image.path.name or not own <= set(_words(file)):
            continue
        try:
            other = _by_name(park_image.read_image(file))
        except FileFormatError:
            continue
        if _is_same_scan(image, other):
            found.append(file.name)
    if not found:
        return []
    more = f" and {len(found) - 9} more" if len(found) > 9 else ""
    return [
        f"other channels of this scan seem to be in {', '.join(found[:9])}{more}: put the files into a folder "
        "of their own and open that"
    ]


def _scans(images: Sequence[Image]) -> list[list[Image]]:
    scans: list[list[Image]] = []
    for image in images:
        own = next((scan for scan in scans if all(_is_same_scan(image, other) for other in scan)), None)
        if own is None:
            scans.append([image])
        else:
            own.append(image)
    return scans


def _is_same_scan(one: Image, other: Image) -> bool:
    first, second = one.channel, other.channel
    if (first.name, first.direction) == (second.name, second.direction) or _stem(one) != _stem(other):
        return False
    if not all(math.isclose(one.header[key], other.header[key], rel_tol=1e-9) for key in _SAME_SCAN):
        return False
    times = _time(one), _time(other)
    if times[0] is None or times[1] is None:
        return True
    rate = one.header["scanRate"]
    scan_time = one.header["height"] / rate if rate > 0.0 else math.inf
    return abs((times[0] - times[1]).total_seconds()) < min(_LONGEST_SAVING, 0.5 * scan_time)


def _time(image: Image) -> datetime | None:
    try:
        return datetime.strptime(image.time, "%Y:%m:%d %H:%M:%S")
    except ValueError:
        return None


# --- names ----------------------------------------------------------------------------------------


def _words(path: Path) -> list[str]:
    return [word for word in _SEPARATORS.split(path.stem.lower()) if word]


def _stem(image: Image) -> list[str]:
    """Return the words of a file's name without channel and direction, or without its number.

    Names are ``<sample>_<channel>_<direction>_<number>``, where the number counts scans, or ``<sample>_<number>``,
    where it counts files.
    """
    words = [word for word in _words(image.path) if word not in _DIRECTIONS]
    channel = [word for word in _SEPARATORS.split(image.header["channelName"].lower()) if word]
    for at in range(len(words) - len(channel) + 1):
        if channel and words[at : at + len(channel)] == channel:
            return words[:at] + words[at + len(channel) :]
    return words[:-1] if words and words[-1].isdigit() else words


def _by_name(image: Image) -> Image:
    """Return the image with the line direction of its name, where that one says another than its header."""
    stated = {_DIRECTIONS[word] for word in _words(image.path) if word in _DIRECTIONS}
    if len(stated) != 1 or image.channel.direction in stated:
        return image
    direction = stated.pop()
    note = f"{image.path.name}: taken as {direction} by its name; its header says {image.channel.direction}"
    return replace(image, channel=replace(image.channel, direction=direction), notes=(*image.notes, note))
