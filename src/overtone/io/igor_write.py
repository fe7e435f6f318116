"""Observables as an Igor binary wave in the layout of Asylum's microscopes, the counterpart of `overtone.io.igor`."""

from __future__ import annotations

import math
import re
import struct
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
import xarray as xr

from overtone.errors import ChannelWarning, ObservablesError
from overtone.harmonics import far_phase
from overtone.io.atomic import atomic_path
from overtone.io.curves import DIRECTIONS as WAYS
from overtone.io.selection import OBSERVABLES
from overtone.probe import Probe
from overtone.quantities import LIFT, validate_observables
from overtone.readings import reading_of

_VERSION, _FLOAT32 = 5, 0x02
_BIN_HEADER, _WAVE_HEADER = 64, 320
_LABEL_SIZE, _NAME_SIZE, _UNIT_SIZE = 32, 31, 4
_LARGEST = 2**31 - 1
_LINES = ("trace", "retrace")
_EVEN = 1e-6  # of a step: by so much the steps between pixels may differ
_PREFERRED = ("height", "A1", "A0", "phi1")
# Nominal, and none of those that Asylum's software writes where nobody has calibrated.
_INVOLS, _AMP_INVOLS = 50e-9, 54.5e-9

_Floats = npt.NDArray[np.float32]


@dataclass(frozen=True)
class _Content:
    """What a wave is made of."""

    values: _Floats
    """In the order of the file: column, row from the bottom, layer; or point, column."""
    labels: Sequence[str]
    """Of the last dimension."""
    steps: Sequence[float]
    starts: Sequence[float]
    axis_units: Sequence[str]
    note: Sequence[tuple[str, str]]


def write(dataset: xr.Dataset, path: str | Path) -> None:
    """Write observables as an Asylum .ibw: a scan with a layer, or a curve with a column, for each of them.

    Parameters
    ----------
    dataset : Dataset
        ``A1``, ``phi1`` and any of ``height``, ``A0``, ``A2``, ``phi2``, ... ``phi9`` over ``y`` and ``x`` or over
        ``z``, in SI units; of a scan also a lift pass as ``lift_A0``, ``lift_A1``, ... A dimension, a single
        value or an attribute ``direction`` is trace and retrace of a scan, approach and retract of a curve; a scan
        without is written as retrace, a curve without as approach. Evenly spaced ``y`` and ``x`` [m] are kept.
    path : str or Path
        An existing file is replaced once the new one is complete.

    Raises
    ------
    ObservablesError
        If the dataset does not keep the contract of observables, has other dimensions or directions, its pixels
        are not evenly spaced, a height is missing, or it is too large for the format.
    FileFormatError
        If the file cannot be written.

    Warns
    -----
    ChannelWarning
        If arrays of the dataset have no place in such a file; they are named.

    Notes
    -----
    Values are floats of 32 bits, as those of the instrument: rounded by up to 6e-8 of themselves, which is 0.4 fm of
    an A0 of 10 nm and 4e-6 deg of a phase of 90 deg. Phases are in degrees. The height of a curve is ``ZSnsr``, minus
    z as the sensor counts.

    From the probe come the keys of the note: stiffness, resonance and quality factor of the first mode (as thermal and
    as tune), drive frequency, free amplitude and phase. Volts stand in the note for lengths over nominal
    sensitivities, ``InvOLS`` 50 nm/V and ``AmpInvOLS`` 54.5 nm/V. Lost are the tip, further modes, static
    stiffness, kind of drive and detector, other readings of a file, history and findings, and that the observables
    were corrected: give a probe and ``corrected=True`` where the file is opened again. The zero of z is arbitrary
    then.
    """
    validate_observables(dataset)
    dims = tuple(name for name in dataset["A1"].dims if name != "direction")
    if set(dims) == {"y", "x"}:
        content = _scan(dataset)
    elif dims == ("z",):
        content = _curve(dataset)
    else:
        raise ObservablesError(
            "these observables make no Igor wave",
            expected="A1 over y and x, or over z; and over direction where there are two",
            got=f"A1 over {', '.join(map(str, dataset['A1'].dims)) or 'nothing'}",
            hint="one map or curve at a time, or a name that ends in .nc",
        )
    target = Path(path)
    data = _wave(content, target.stem)
    with atomic_path(target) as temporary:
        temporary.write_bytes(data)


# --- scans and curves -----------------------------------------------------------------------------


def _scan(dataset: xr.Dataset) -> _Content:
    x, y = _axis(dataset, "x"), _axis(dataset, "y")
    ordered = dataset.sortby([name for name in ("x", "y") if name in dataset.coords])
    if "y" not in dataset.coords:
        ordered = ordered.isel(y=slice(None, None, -1))  # the file counts rows from the bottom
    labels, layers = [], []
    names = _held(dataset, ("y", "x"), lift=True)
    for line, part in _directions(ordered, _LINES, "retrace"):
        for name in names:
            array = part[name].transpose("x", "y")
            label = _label(name, _long_name, str(array.attrs.get("channel", ""))) + line.capitalize()
            labels.append(label)
            layers.append(_stored(name, array.values))
    sizes = {
        axis: None if given is None else given[1] * (dataset.sizes[axis] - 1)
        for axis, given in (("x", x), ("y", y))
    }
    note = [("ImagingMode", "AC Mode")]
    if sizes["x"] and sizes["y"]:
        note += [("ScanSize", repr(max(sizes["x"], sizes["y"])))]
        note += [("FastScanSize", repr(sizes["x"])), ("SlowScanSize", repr(sizes["y"]))]
    note += _probe_note(dataset)
    note += _setpoint_note(dataset)
    known = x is not None and y is not None
    return _Content(
        values=np.stack(layers, axis=-1),
        labels=labels,
        starts=[x[0], y[0]] if x and y else [0.0, 0.0],
        steps=[x[1], y[1]] if x and y else [1.0, 1.0],
        axis_units=["m", "m"] if known else ["", ""],
        note=note,
    )


def _curve(dataset: xr.Dataset) -> _Content:
    if "z" not in dataset.coords or not np.isfinite(dataset["z"]).all():
        raise ObservablesError(
            "the curve has no height",
            expected="finite heights z [m]",
            hint='curve.assign_coords(z=("z", heights))',
        )
    names = _held(dataset, ("z",), lift=False)
    blocks, ends, signs = [], [0], []
    for way, part in _directions(dataset, WAYS, "approach"):
        # Down with the base, or up: the order of time.
        ordered = part.sortby("z", ascending=way == "retract")
        columns = [_stored(name, ordered[name].values) for name in names]
        blocks.append(np.stack([*columns, (-ordered["z"].values).astype(np.float32)], axis=-1))
        ends.append(sum(block.shape[0] for block in blocks) - 1)
        signs.append("1" if way == "approach" else "-1")
    note = [("ImagingMode", "AC Mode"), *_probe_note(dataset)]
    note += [("Indexes", ",".join(map(str, ends))), ("Direction", ",".join(["NaN", *signs, ""]))]
    return _Content(
        values=np.concatenate(blocks),
        labels=[*(_label(name, _short_name) for name in names), "ZSnsr"],
        starts=[0.0, 0.0],
        steps=[1.0, 1.0],
        axis_units=["", ""],
        note=note,
    )


def _directions(dataset: xr.Dataset, known: Sequence[str], default: str) -> Iterator[tuple[str, xr.Dataset]]:
    """Yield each direction with its observables, in the order of the file."""
    stated = dataset.attrs.get("direction")
    given = [str(stated) if stated in known else default]
    if "direction" in dataset.coords:
        given = [str(name) for name in np.atleast_1d(dataset["direction"].values)]
    elif "direction" in dataset.dims:
        given = ["no name"] * dataset.sizes["direction"]
    if len(set(given)) < len(given) or not set(given) <= set(known):
        raise ObservablesError(
            "directions of another kind", expected=" and ".join(known) + ", each once", got=", ".join(given)
        )
    for name in sorted(given, key=list(known).index):
        yield name, dataset.isel(direction=given.index(name)) if "direction" in dataset.dims else dataset


def _held(dataset: xr.Dataset, dims: tuple[str, ...], *, lift: bool) -> list[str]:
    """Return the arrays that the file holds, in its order, and warn of those that it does not."""
    order = [*_PREFERRED, *(name for name in OBSERVABLES if name not in _PREFERRED)]
    if dims == ("z",):
        order.remove("height")  # what the feedback recorded: there is none in a curve
    order += [LIFT + name for name in order] if lift else []
    allowed = {frozenset(dims), frozenset((*dims, "direction"))}
    held = [name for name in order if name in dataset and frozenset(dataset[name].dims) in allowed]
    lost = [str(name) for name in dataset.data_vars if name not in held]
    if lost:
        warnings.warn(
            f"an Igor wave in Asylum's layout has no place for {', '.join(lost)}: left out",
            ChannelWarning,
            stacklevel=4,
        )
    return held


def _axis(dataset: xr.Dataset, name: str) -> tuple[float, float] | None:
    """Return the first position and the step [m] of an axis, None where the dataset has none."""
    if name not in dataset.coords:
        return None
    values = np.sort(np.asarray(dataset[name].values, dtype=float))
    if values.size == 1:
        return float(values[0]), 1e-9  # a pixel has a place; its width says nothing
    step = float(values[-1] - values[0]) / (values.size - 1)
    if not (step > 0.0 and np.abs(np.diff(values) - step).max() <= _EVEN * step):
        raise ObservablesError(
            f"{name} is not evenly spaced",
            expected="pixels at equal distances, which is all an Igor wave can say",
            got=f"steps from {np.diff(values).min():.4g} to {np.diff(values).max():.4g} m",
            hint="a name that ends in .nc",
        )
    return float(values[0]), step


def _stored(name: str, values: npt.NDArray[np.float64]) -> _Floats:
    """Return values in the unit of the file: degrees for phases, metres for the rest."""
    return (np.degrees(values) if "phi" in name else values).astype(np.float32)


def _label(name: str, names: dict[str, str], channel: str = "") -> str:
    base = name.removeprefix(LIFT)
    nap = "Nap" if base != name else ""
    if base in names:
        # A height that came from the sensor goes back under its name.
        return nap + (channel if base == "height" and channel in ("ZSensor", "Height") else names[base])
    letters = re.fullmatch(r"(A|phi)(\d)", base)
    kind, order = letters.groups() if letters else ("A", "")
    return f"{nap}{names[kind]}{order}"


_long_name = {"height": "Height", "A0": "Deflection", "A1": "Amplitude", "phi1": "Phase"}
_long_name |= {"A": "Amplitude", "phi": "Phase"}
_short_name = {"A0": "Defl", "A1": "Amp", "phi1": "Phase", "A": "Amp", "phi": "Phas"}


# --- the note -------------------------------------------------------------------------------------


def _probe_note(dataset: xr.Dataset) -> list[tuple[str, str]]:
    """Return what the note says of the probe, nothing where the dataset carries none."""
    reading = reading_of(dataset)
    if reading is None:
        return []
    probe: Probe = reading.probe
    mode, drive = probe.cantilever.modes[0], probe.drive
    numbers = {
        "SpringConstant": mode.stiffness,
        "ThermalFrequency": mode.frequency,
        "ThermalQ": mode.quality_factor,
        "TuneFreqResult": mode.frequency,
        "TuneQResult": mode.quality_factor,
        "DriveFrequency": drive.frequency,
        "DriveFrequency1": 2.0 * drive.frequency,
        "InvOLS": _INVOLS,
        "AmpInvOLS": _AMP_INVOLS,
        "Amp2InvOLS": _AMP_INVOLS,
        "FreeAirAmplitude": drive.free_amplitude / _AMP_INVOLS,
        "FreeAirPhase": math.degrees(far_phase(probe)),
    }
    return [(key, repr(float(value))) for key, value in numbers.items()]


def _setpoint_note(dataset: xr.Dataset) -> list[tuple[str, str]]:
    """Return the set-point, which is what the feedback held, and the height of a lift pass."""
    amplitude = dataset["A1"].values
    note = [("AmplitudeSetpointVolts", repr(float(amplitude[np.isfinite(amplitude)].mean()) / _AMP_INVOLS))]
    height = dataset.attrs.get("lift_height")
    if isinstance(height, float | np.floating):
        note.append(("NapHeight", repr(float(height))))
    return note


# --- the file -------------------------------------------------------------------------------------


def _wave(content: _Content, name: str) -> bytes:
    """Return the file, after Igor's technical note 3 (version 5, little-endian)."""
    values = content.values
    data = values.astype("<f4").tobytes(order="F")
    text = "".join(f"{key}: {value}\r" for key, value in content.note).encode("latin-1")
    labels = b"".join(_cell(label) for label in ("", *content.labels))
    if len(data) + _WAVE_HEADER > _LARGEST:
        raise ObservablesError(
            "the dataset is too large for an Igor wave",
            expected="less than 2 GiB",
            got=f"{len(data) / 2**30:.1f} GiB",
            hint="a name that ends in .nc",
        )
    rank = values.ndim
    dims = [*values.shape, *[0] * (4 - rank)]
    label_sizes = [len(labels) if axis == rank - 1 else 0 for axis in range(4)]
    sizes = [_WAVE_HEADER + len(data), 0, len(text), 0, *[0] * 4, *label_sizes, 0, 0, 0]
    scaling = {
        which: [*given, *[fill] * (4 - len(given))]
        for which, given, fill in (("steps", content.steps, 1.0), ("starts", content.starts, 0.0))
    }
    units = [unit.encode("latin-1").ljust(_UNIT_SIZE, b"\0") for unit in (*content.axis_units, *[""] * 4)][:4]
    data_unit = b"m".ljust(_UNIT_SIZE, b"\0")
    wave = struct.pack(
        "<3I i 2h 6s h 32s 2i 4i 4d 4d 4s 16s",
        *(0, 0, 0),  # in memory: next wave, times of creation and change
        values.size,
        *(_FLOAT32, 0, b"", 1, _wave_name(name), 0, 0),
        *dims,
        *scaling["steps"],
        *scaling["starts"],
        data_unit,
        b"".join(units),
    ).ljust(_WAVE_HEADER, b"\0")
    header = struct.pack("<2h 15i", _VERSION, 0, *sizes)
    # Igor adds up the headers as numbers of 16 bits and wants nothing left.
    total = int(np.frombuffer(header + wave, "<u2").sum(dtype=np.uint64)) & 0xFFFF
    header = struct.pack("<hH 15i", _VERSION, (-total) & 0xFFFF, *sizes)
    return header + wave + data + text + labels


def _cell(label: str) -> bytes:
    """Return a label in its cell of 32 bytes, which ends with a zero."""
    return label.encode("latin-1")[: _LABEL_SIZE - 1].ljust(_LABEL_SIZE, b"\0")


def _wave_name(stem: str) -> bytes:
    """Return the name of the wave: letters, digits and underscores, beginning with a letter."""
    name = re.sub(r"[^A-Za-z0-9_]", "_", stem)
    return (name if name[:1].isalpha() else f"w{name}")[:_NAME_SIZE].encode("ascii")
