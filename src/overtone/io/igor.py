"""Igor binary waves (.ibw), as Asylum Research microscopes write them: images and curves.

Igor stores ``values[column, row, layer]`` with the row counted from the bottom; a map of overtone
is ``values[row, column]`` with row 0 at the top. Asylum keeps its settings as text behind the
data; `overtone.io.asylum` reads it.
"""

from __future__ import annotations

import io
import math
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from overtone.errors import FileFormatError
from overtone.io import asylum
from overtone.io.recording import Channel, Fact, Recording
from overtone.io.si import to_si

_VERSIONS = (1, 2, 3, 5)
# Bytes of one real number by Igor's type code; text and complex waves are not maps.
_ITEM_SIZES = {0x02: 4, 0x04: 8, 0x08: 1, 0x10: 2, 0x20: 4, 0x48: 1, 0x50: 2, 0x60: 4}
_LABEL_SIZE = 32
_MOST_LAYERS = 1000


@dataclass(frozen=True)
class Layout:
    """Where the parts of a wave lie in its file."""

    dims: tuple[int, ...]
    labels: tuple[tuple[str, ...], ...]
    """Labels of the elements along each dimension, empty where there are none."""


@dataclass(frozen=True)
class Wave:
    """The parts of a wave that a recording is made of."""

    values: npt.NDArray[np.float64]
    labels: tuple[tuple[str, ...], ...]
    unit: str
    axis_units: tuple[str, ...]
    steps: tuple[float, ...]
    starts: tuple[float, ...]
    note: str


def sniff(path: Path, head: bytes) -> bool:
    """Tell whether the file begins with the version number of an Igor wave, in either byte order."""
    return len(head) >= 2 and any(head[:2] in (struct.pack("<h", v), struct.pack(">h", v)) for v in _VERSIONS)


def read(path: Path) -> Recording:
    """Read an Igor binary wave.

    A wave of two dimensions with labelled columns is a curve with one channel a column, anything
    else of two or three dimensions is an image with one channel a layer. Values are in SI units;
    Asylum's phases, which are in degrees, become radians. Where Asylum gives no unit for a channel
    its kind does.

    Parameters
    ----------
    path : Path
        The .ibw file.

    Raises
    ------
    FileFormatError
        If the file is damaged, or holds text, complex numbers or more than three dimensions.
    """
    return recording_of(path, path.read_bytes())


def recording_of(path: Path, content: bytes) -> Recording:
    """Return the recording of a wave that is already in memory, as `read` does.

    Parameters
    ----------
    path : Path
        What the recording and messages call it.
    content : bytes
        The wave, as a whole .ibw.

    Raises
    ------
    FileFormatError
        As `read` does.
    """
    wave = wave_of(path, content)
    metadata = asylum.entries_of(wave.note)
    settings = asylum.Settings(metadata)
    is_asylum = asylum.is_asylum(settings)
    notes: list[str] = []
    coords: dict[str, npt.NDArray[np.float64]] = {}
    labels: Sequence[str] = ()
    column_labels, layer_labels = (*wave.labels, (), (), ())[1:3]
    dims: tuple[str, ...] = ("point",)
    if wave.values.ndim == 1:
        layers = [wave.values]
    elif wave.values.ndim == 2 and any(column_labels):
        layers, labels = list(wave.values.T), column_labels
        if wave.axis_units[0] and wave.steps[0] > 0.0:
            notes.append(f"one point every {wave.steps[0]:g} {wave.axis_units[0]}")
    else:
        dims, labels = ("y", "x"), layer_labels
        coords = _coordinates(wave, settings, notes)
        stack = wave.values.reshape(*wave.values.shape[:2], -1)
        layers = [stack[:, :, i].T[::-1] for i in range(stack.shape[2])]
    if len(layers) > _MOST_LAYERS:
        raise FileFormatError(
            f"{path.name} holds no map or curve that overtone reads",
            expected=f"at most {_MOST_LAYERS} layers",
            got=f"{len(layers)}",
            hint="take single layers out of it in Igor",
        )
    labels = [*labels[: len(layers)], *[""] * (len(layers) - len(labels))]
    channels = tuple(
        _channel(i, label, layer, wave.unit, settings if is_asylum else None)
        for i, (label, layer) in enumerate(zip(labels, layers, strict=True))
    )
    if not all(labels):
        notes.append(f"{labels.count('')} of {len(labels)} layers have no label in the file")
    without_unit = [channel.name for channel in channels if channel.unit is None]
    if without_unit:
        notes.append(f"no unit in the file: {', '.join(without_unit)}")
    facts = asylum.facts_of(settings, {channel.name for channel in channels}) if is_asylum else {}
    if is_asylum:
        notes.extend(asylum.changed_during_the_scan(asylum.lines_of(wave.note)))
    if dims == ("point",):
        facts |= _sampling_step(wave)
    return Recording(
        path=path,
        format="igor",
        vendor="asylum" if is_asylum else "igor",
        dims=dims,
        coords=coords,
        channels=channels,
        facts=facts,
        resonances=asylum.resonances_of(settings, notes) if is_asylum else (),
        metadata=metadata,
        notes=tuple(notes),
    )


# --- the file -------------------------------------------------------------------------------------


def wave_of(path: Path, content: bytes) -> Wave:
    """Return the parts of a wave; every size in its header is checked before anything is read."""
    layout = layout_of(path, content)

    from igor2 import binarywave

    try:
        wave = binarywave.load(io.BytesIO(content))["wave"]
    except Exception as error:  # the library states no exceptions; the sizes are right, so it is the content
        raise _damaged(path, "a readable wave", f"{type(error).__name__} ({str(error)[:80]})") from error
    header = wave["wave_header"]
    with np.errstate(invalid="ignore"):  # a signalling NaN is a NaN like any other
        values = np.asarray(wave["wData"]).astype(np.float64).reshape(layout.dims, order="F")
    if "sfA" in header:
        steps, starts = header["sfA"], header["sfB"]
        axis_units = [_text(unit) for unit in header["dimUnits"]]
    else:
        steps, starts, axis_units = [header["hsA"]], [header["hsB"]], [_text(header["xUnits"])]
    rank = len(layout.dims)
    return Wave(
        values=values,
        labels=layout.labels,
        unit=_text(header["dataUnits"]) or _text(wave.get("data_units", b"")),
        axis_units=tuple(axis_units[:rank]),
        steps=tuple(float(step) for step in steps[:rank]),
        starts=tuple(float(start) for start in starts[:rank]),
        note=_text(wave.get("note", b"")),
    )


def layout_of(path: Path, content: bytes) -> Layout:
    """Check every size in the header against the file before anything is read, and find the labels."""
    if len(content) < 8:
        raise _damaged(path, "a header", f"{len(content)} bytes")
    order = "<" if content[0] else ">"
    version = struct.unpack_from(order + "h", content)[0]
    # Offsets of Igor's technical note 3: total size, type, number of points, start of the data.
    at_size, at_type, at_points, start, padding = {
        1: (2, 8, 50, 118, 16),
        2: (2, 16, 58, 126, 16),
        3: (2, 20, 62, 130, 16),
        5: (4, 80, 76, 384, 0),
    }[version]
    if len(content) < start:
        raise _damaged(path, f"a header of {start} bytes", f"{len(content)} bytes in all")
    kind = struct.unpack_from(order + "h", content, at_type)[0]
    if kind not in _ITEM_SIZES:
        what = "a wave of text" if kind == 0 else "complex numbers" if kind & 1 else f"number type {kind}"
        raise FileFormatError(
            f"{path.name} holds no map or curve that overtone reads",
            expected="an Igor wave of real numbers",
            got=what,
            hint="the wave that holds the image or the curve",
        )
    points = struct.unpack_from(order + "i", content, at_points)[0]
    if points < 1:
        raise _damaged(path, "at least one point", f"{points} points")
    dims: tuple[int, ...] = (points,)
    labels: tuple[tuple[str, ...], ...] = ()
    size = points * _ITEM_SIZES[kind]
    header_size = start - (64 if version == 5 else at_type)
    stated = struct.unpack_from(order + "i", content, at_size)[0] - header_size - padding
    if stated != size:
        raise _damaged(path, f"{size} bytes of data for {points} points", f"{stated} stated in the header")
    if version == 5:
        dims = tuple(n for n in struct.unpack_from(order + "4i", content, 132) if n > 0)
        if math.prod(dims) != points:
            raise _damaged(path, f"dimensions of {points} points in all", f"dimensions {dims}")
        formula, note, unit, *rest = struct.unpack_from(order + "3i 4i 4i 3i", content, 8)
        sizes = [formula, note, unit, *rest[:4], *rest[4:8], rest[8]]
        label_sizes = rest[4:8]
    else:
        counts = {1: 0, 2: 1, 3: 2}[version]
        sizes, label_sizes = list(struct.unpack_from(f"{order}{counts}i", content, 6)), []
    if min(sizes, default=0) < 0 or start + size + padding * (version > 1) + sum(sizes) > len(content):
        needed = start + size + padding * (version > 1) + sum(sizes)
        raise _damaged(path, f"{needed} bytes as its header says", f"{len(content)}")
    if version == 5:
        labels = _labels(content, start + size + sum(sizes[:7]), label_sizes)
    while len(dims) > 2 and dims[-1] == 1:
        dims = dims[:-1]
    if len(dims) > 3:
        raise FileFormatError(
            f"{path.name} holds a wave of {len(dims)} dimensions",
            expected="an image with layers, a curve with columns or a plain wave",
            got=f"shape {dims}",
            hint="take single layers out of it in Igor",
        )
    return Layout(dims, labels)


def _labels(content: bytes, start: int, sizes: Sequence[int]) -> tuple[tuple[str, ...], ...]:
    # igor2 drops the zero that ends a label and so joins the memory junk behind it to the label;
    # the cells are read here instead. The first one names the dimension, not an element.
    labels = []
    for size in sizes:
        cells = [content[at : at + _LABEL_SIZE] for at in range(start, start + size, _LABEL_SIZE)]
        labels.append(tuple(cell.split(b"\0", 1)[0].decode("latin-1").strip() for cell in cells[1:]))
        start += size
    return tuple(labels)


def _text(raw: object) -> str:
    data = raw if isinstance(raw, bytes) else np.asarray(raw).tobytes()
    return data.split(b"\0", 1)[0].decode("latin-1")


def _damaged(path: Path, expected: str, got: str) -> FileFormatError:
    return FileFormatError(
        f"{path.name} is not a whole Igor binary wave",
        expected=expected,
        got=got,
        hint="copy or save the file again",
    )


# --- what it says ---------------------------------------------------------------------------------


def _sampling_step(wave: Wave) -> dict[str, Fact]:
    """Return the time between points, where the scaling of the wave is a time."""
    known = to_si(wave.axis_units[0]) if wave.axis_units[0] else None
    if known is None or known[1] != "s" or not (wave.steps[0] > 0.0 and math.isfinite(wave.steps[0])):
        return {}
    return {"sampling_step": Fact(wave.steps[0] * known[0], "s", "wave scaling")}


def _channel(
    index: int,
    label: str,
    values: npt.NDArray[np.float64],
    wave_unit: str,
    settings: asylum.Settings | None,
) -> Channel:
    """Return a layer as a channel; ``settings`` are Asylum's, None for other waves."""
    name, direction = asylum.split_label(label)
    known = to_si(wave_unit) if wave_unit else None
    if settings is not None and label:
        known = asylum.unit_of_kind(name)
    factor, unit = known if known is not None else (1.0, None)
    return Channel(
        name=name or f"layer {index + 1}",
        values=np.ascontiguousarray(values * factor),
        unit=unit,
        direction=direction,
        nap=asylum.is_nap(name),
        flattened=None if settings is None else asylum.is_flattened(index, settings),
    )


def _coordinates(
    wave: Wave, settings: asylum.Settings, notes: list[str]
) -> dict[str, npt.NDArray[np.float64]]:
    """Return coordinates in metres: point i lies at i steps, the step being size / (points - 1)."""
    axes = {}
    for name, axis, size_key in (("x", 0, "FastScanSize"), ("y", 1, "SlowScanSize")):
        points, step, start = wave.values.shape[axis], wave.steps[axis], wave.starts[axis]
        known = to_si(wave.axis_units[axis])
        last = start + step * (points - 1)
        if known is None or known[1] != "m" or not (0.0 < step < 1.0 and math.isfinite(last)):
            notes.append("the file states no usable image size, so there are no coordinates")
            return {}
        size = settings.measured(size_key)
        if (
            size is not None
            and points > 1
            and not math.isclose(size, (last - start) * known[0], rel_tol=0.01)
        ):
            notes.append(
                f"{settings.spelling(size_key)} {size:g} m and the {(last - start) * known[0]:g} m of the "
                "wave disagree; the wave was believed"
            )
        axes[name] = (start + step * np.arange(points)) * known[0]
    return {"y": np.ascontiguousarray(axes["y"][::-1]), "x": axes["x"]}
