"""JPK's videos and images in HDF5 (.h5-jpk): integers over pixels and frames, everything else in attributes.

Every channel lies in a group of its own, with the integers as ``(pixels, frames)``. Its attributes chain the
calibration: the encoder turns integers into a base quantity, and each conversion builds on another one.
Pixels run along the lines first, from the lowest line up; in a reflected scan from the highest one down.
"""

from __future__ import annotations

import math
import mmap
import re
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from overtone.errors import FileFormatError
from overtone.io import hdf5_guard, jpk_header, netcdf
from overtone.io.jpk_header import Slot
from overtone.io.recording import Channel, Recording

_HDF5 = b"\x89HDF\r\n\x1a\n"
_MARK = b"file-format-info"
_HEAP = b"GCOL"
_SUFFIX = ".h5-jpk"
_POSITIONS = b"position-pattern"
_GRID = "position-pattern.grid"
_MOST_ATTRIBUTES = 10_000
# What the channels may take as floats, and what deflate may blow a byte up to at most.
_LARGEST_RATIO, _SLACK = 8, 100 << 20
_LARGEST_DEFLATION = 1100
_DEFLATE, _SHUFFLE, _CHECKSUM = 1, 2, 3
_LONGEST_TEXT = 100_000


def sniff(path: Path, head: bytes) -> bool:
    """Tell whether the file is HDF5 that JPK's software wrote.

    HDF5 itself is not asked: damage can send it astray, and other readers first see whether a file is whole.
    """
    if not head.startswith(_HDF5):
        return False
    if netcdf.is_sealed(path):
        return False
    with path.open("rb") as stream, mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ) as content:
        if content.find(_MARK) >= 0 and content.find(b"JPK SCAN") >= 0:
            return True
        # The mark lies at the end: where it was cut off the name decides, so that the message speaks of JPK.
        return path.suffix.lower() == _SUFFIX and content.find(_POSITIONS) >= 0


def read(path: Path) -> Recording:
    """Read every channel of a .h5-jpk file, trace and retrace, with all frames.

    Several frames give the dimensions ``frame``, ``y`` and ``x``, one frame ``y`` and ``x``. A channel is in
    the quantity that the software had chosen for it, or in metres where only another calibration gives those.

    Parameters
    ----------
    path : Path
        The .h5-jpk file.

    Raises
    ------
    FileFormatError
        If the file is damaged, claims more than it can hold, or was not written to its end.
    """
    with path.open("rb") as stream, mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ) as content:
        has_heap = content.find(_HEAP) >= 0
    if has_heap:  # JPK's software writes none, but damage to one sends HDF5 astray
        hdf5_guard.check(path, f"{__name__}:{_unguarded.__name__}")
    return _unguarded(path)


def _unguarded(path: Path) -> Recording:
    import h5py

    notes: list[str] = []
    channels: list[Channel] = []
    amplitude: list[Slot] = []
    with _reading(path), h5py.File(path, "r") as file:
        names = sorted(name for name in file if re.fullmatch(r"Measurement_\d+", name))
        if not _attributes(file).get("file-format-info", "").startswith("JPK") or not names:
            raise _damaged(path, "the mark of JPK and a measurement", f"{len(names)} measurements")
        if len(names) > 1:
            notes.append(f"left out: {', '.join(names[1:9])}; only the first measurement is read")
        scan = _member(path, file, names[0])
        settings = _attributes(scan)
        columns, rows = (_count(path, settings, f"{_GRID}.{key}length") for key in "ij")
        datasets = list(_datasets(path, scan, rows * columns))
        _check_sizes(path, [dataset for _, dataset in datasets])
        reflected = settings.get(f"{_GRID}.reflect") == "true"
        for attributes, dataset in datasets:
            slots = _slots(attributes)
            if attributes.get("channel.name") == "amplitude":
                amplitude = amplitude or slots
            raw = np.asarray(dataset[()]).T.reshape(-1, rows, columns)
            raw = jpk_header.with_sign(raw if reflected else raw[:, ::-1], attributes.get("encoder.type", ""))
            channels.append(_channel(attributes, raw, slots, notes))
        if _changes(path, scan, "relative-setpoint"):
            notes.append(
                "the set-point was changed between frames; the facts hold the one of the file's header"
            )
    frames = channels[0].values.shape[0]
    if frames == 1:
        channels = [replace(channel, values=channel.values[0]) for channel in channels]
    length, width, angle = (_number(settings, f"{_GRID}.{key}") for key in ("ulength", "vlength", "theta"))
    return Recording(
        path=path,
        format="jpk_h5",
        vendor="jpk",
        dims=("y", "x") if frames == 1 else ("frame", "y", "x"),
        coords=jpk_header.coordinates((rows, columns), (None, None), (length, width, angle), notes),
        channels=tuple(channels),
        facts=jpk_header.probe_facts(settings) | jpk_header.feedback_facts(settings, amplitude, notes),
        resonances=jpk_header.resonances(settings, notes),
        metadata=settings,
        notes=tuple(dict.fromkeys(notes)),
    )


# --- channels -------------------------------------------------------------------------------------


def _datasets(path: Path, scan: Any, pixels: int) -> Iterator[tuple[dict[str, str], Any]]:
    """Yield the attributes and the integers of each channel, the thumbnails left out."""
    import h5py

    frames = None
    for name in sorted(name for name in scan if re.fullmatch(r"Channel_\d+", name)):
        group = _member(path, scan, name)
        members = [_member(path, group, inner) for inner in group if inner != "thumbnail"]
        arrays = [one for one in members if isinstance(one, h5py.Dataset) and one.ndim == 2]
        if len(arrays) != 1 or arrays[0].dtype.kind not in "iuf":
            raise _damaged(path, f"one array of numbers in {name}", f"{len(arrays)} arrays")
        frames = frames or arrays[0].shape[1]
        if not frames or arrays[0].shape != (pixels, frames):
            raise _damaged(path, f"{pixels} pixels by {frames} frames in {name}", f"{arrays[0].shape}")
        yield _attributes(group), arrays[0]
    if frames is None:
        raise _damaged(path, "at least one channel", "none")


def _channel(attributes: Mapping[str, str], raw: Any, slots: list[Slot], notes: list[str]) -> Channel:
    name = attributes.get("channel.fancy-name") or attributes.get("channel.name", "channel")
    slot = jpk_header.choose_slot(name, slots, attributes.get("conversions.default", ""), notes)
    values, unit = jpk_header.in_si(name, raw, slot, notes)
    retrace = {"true": "retrace", "false": "trace"}.get(attributes.get("retrace", ""))
    return Channel(name, values, unit, retrace)


def _slots(attributes: Mapping[str, str]) -> list[Slot]:
    """Return the calibrated slots of a channel, each with the numbers that turn integers into it."""
    base = _scaling(attributes, "encoder", attributes.get("conversions.base", ""))
    if base is None:
        return []
    slots = {base.name: base}
    for name in attributes.get("conversions.list", "").split():
        own = _scaling(attributes, f"conversion.{name}", name)
        parent = slots.get(attributes.get(f"conversion.{name}.base-calibration-slot", ""))
        if own is not None and parent is not None:
            offset = own.multiplier * parent.offset + own.offset
            slots[name] = Slot(name, own.unit, own.multiplier * parent.multiplier, offset)
    return list(slots.values())


def _scaling(attributes: Mapping[str, str], group: str, name: str) -> Slot | None:
    multiplier, offset = (_number(attributes, f"{group}.scaling.{key}") for key in ("multiplier", "offset"))
    linear = (attributes.get(f"{group}.scaling.type"), attributes.get(f"{group}.scaling.style"))
    if attributes.get(f"{group}.defined") == "false" or linear != ("linear", "offsetmultiplier"):
        return None
    if not multiplier or offset is None:
        return None
    return Slot(name, attributes.get(f"{group}.scaling.unit.unit", ""), multiplier, offset)


def _changes(path: Path, scan: Any, name: str) -> bool:
    """Tell whether a setting that is stored by frame differs between frames."""
    if "meta-data" not in scan or name not in (group := _member(path, scan, "meta-data")):
        return False
    values = _member(path, group, name)
    if not 0 < values.size <= _MOST_ATTRIBUTES or values.dtype.kind not in "iuf":
        return False
    _check_sizes(path, [values])
    by_frame = np.asarray(values[()])
    return bool((by_frame != by_frame.flat[0]).any())


# --- the file -------------------------------------------------------------------------------------


def _member(path: Path, group: Any, name: str) -> Any:
    """Return a member of a group that lies in this very file."""
    import h5py

    if not isinstance(group.get(name, getlink=True), h5py.HardLink):
        raise _damaged(path, f"{name} in the file itself", "a link to elsewhere")
    return group[name]


def _attributes(holder: Any) -> dict[str, str]:
    """Return the single texts and numbers among the attributes, as texts."""
    entries: dict[str, str] = {}
    for name in list(holder.attrs.keys())[:_MOST_ATTRIBUTES]:
        if not isinstance(name, str):  # damage: a name that is no text
            continue
        stored = holder.attrs.get_id(name)
        if stored.shape != () or stored.dtype.kind not in "SOiufb" or stored.dtype.itemsize > _LONGEST_TEXT:
            continue
        value = holder.attrs[name]
        if isinstance(value, bytes | str | int | float | np.generic):
            text = value.decode("utf-8", "replace") if isinstance(value, bytes) else str(value)
            entries[name] = text[:_LONGEST_TEXT]
    return entries


def _check_sizes(path: Path, datasets: list[Any]) -> None:
    """Hold what the arrays claim against the file before any of it is read."""
    size = path.stat().st_size
    most = _LARGEST_RATIO * size + _SLACK
    claimed = sum(8 * dataset.size for dataset in datasets)
    if claimed > most:
        raise _damaged(path, f"channels that fit into a file of {size} bytes", f"{claimed} claimed")
    for dataset in datasets:
        if dataset.is_virtual or dataset.external:
            raise _damaged(path, "arrays in the file itself", "an array in another file")
        if dataset.chunks is None:
            if dataset.id.get_storage_size() < dataset.nbytes:
                raise _damaged(path, f"{dataset.nbytes} bytes of data", f"{dataset.id.get_storage_size()}")
            continue
        plist = dataset.id.get_create_plist()
        filters = [plist.get_filter(index)[0] for index in range(plist.get_nfilters())]
        if not set(filters) <= {_DEFLATE, _SHUFFLE, _CHECKSUM}:
            raise _damaged(path, "data without compression or with deflate", f"filters {filters}")
        chunk = math.prod(dataset.chunks) * dataset.dtype.itemsize
        wanted = math.prod(-(-long // part) for long, part in zip(dataset.shape, dataset.chunks, strict=True))
        stored: list[Any] = []
        dataset.id.chunk_iter(stored.append)
        if chunk > most or len(stored) != wanted:
            raise _damaged(path, f"{wanted} blocks of data", f"{len(stored)} blocks of {chunk} bytes")
        for info in stored:
            # A block that could outgrow everything is unpacked here first, no further than it may go.
            if _DEFLATE in filters and info.size * _LARGEST_DEFLATION > most:
                packed = dataset.id.read_direct_chunk(info.chunk_offset)[1]
                if len(zlib.decompressobj().decompress(packed, chunk + 1)) > chunk:
                    raise _damaged(path, f"blocks of {chunk} bytes", "a larger one")


def _count(path: Path, settings: Mapping[str, str], key: str) -> int:
    text = settings.get(key, "")
    if not (text.isascii() and text.isdigit() and len(text) < 10 and int(text) > 0):
        raise _damaged(path, f"{key} as a positive whole number", repr(text[:24]) if text else "none")
    return int(text)


def _number(settings: Mapping[str, str], key: str) -> float | None:
    try:
        value = float(settings.get(key, "")[:_MOST_ATTRIBUTES])
    except ValueError:
        return None
    return value if math.isfinite(value) else None


def _damaged(path: Path, expected: str, got: str) -> FileFormatError:
    return FileFormatError(
        f"{path.name} is not a JPK file that is whole",
        expected=expected,
        got=got,
        hint="copy the file again",
    )


@contextmanager
def _reading(path: Path) -> Iterator[None]:
    try:
        yield
    except (FileFormatError, ImportError):
        raise
    except Exception as error:  # h5py raises nearly every kind there is
        raise _damaged(path, "readable HDF5", f"{type(error).__name__} ({str(error)[:120]})") from error
