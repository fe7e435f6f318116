"""Igor binary waves (.ibw), as Asylum Research microscopes write them: images and curves.

Igor stores ``values[column, row, layer]`` with the row counted from the bottom; a map of overtone
is ``values[row, column]`` with row 0 at the top. Asylum keeps its settings as text behind the
data, where a key may come twice: once with the value at the start of the scan, and again with the
value and the line at which somebody changed it, or from another panel. The first one counts.
"""

from __future__ import annotations

import io
import math
import re
import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from overtone.errors import FileFormatError
from overtone.io.recording import Channel, Fact, Recording, Resonance
from overtone.io.si import to_si

_VERSIONS = (1, 2, 3, 5)
# Bytes of one real number by Igor's type code; text and complex waves are not maps.
_ITEM_SIZES = {0x02: 4, 0x04: 8, 0x08: 1, 0x10: 2, 0x20: 4, 0x48: 1, 0x50: 2, 0x60: 4}
_LABEL_SIZE = 32
_MOST_LAYERS = 1000
_LONGEST_NUMBER = 100
_ASYLUM_KEYS = ("springconstant", "thermalq", "imagingmode", "invols")

# What Asylum's software writes where nobody has calibrated.
_DEFAULT_STIFFNESS = 1.0
_DEFAULT_INVOLS = 1e-7
_DEFAULT_AMP_INVOLS = 1.09e-7
_DEFAULT_AMP2_INVOLS = 2e-8
_DEFAULT_THERMAL_Q = 20.0
_DEFAULT_THERMAL_FREQUENCY = 75000.0
# Found as the tune of levers that were never tuned, and as the second tune of several instruments.
_DEFAULT_TUNE_Q = 158.91

_LENGTHS = ("height", "zsensor", "zsnsr", "deflection", "defl", "amplitude", "amp", "raw", "lvdt")
_ANGLES = ("phase", "phas")
_FREQUENCIES = ("frequency", "freq")
_DIRECTION = re.compile(r"(.+?)(Retrace|Trace)(.*)")
_NUMBER = re.compile(r"\s*([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*(?:@.*)?")


@dataclass(frozen=True)
class _Layout:
    """Where the parts of a wave lie in its file."""

    dims: tuple[int, ...]
    labels: tuple[tuple[str, ...], ...]
    """Labels of the elements along each dimension, empty where there are none."""


@dataclass(frozen=True)
class _Wave:
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
    wave = _load(path)
    metadata = _note(wave.note)
    settings = _Settings(metadata)
    asylum = any(settings.text(key) is not None for key in _ASYLUM_KEYS)
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
        _channel(i, label, layer, wave.unit, asylum, settings)
        for i, (label, layer) in enumerate(zip(labels, layers, strict=True))
    )
    if not all(labels):
        notes.append(f"{labels.count('')} of {len(labels)} layers have no label in the file")
    without_unit = [channel.name for channel in channels if channel.unit is None]
    if without_unit:
        notes.append(f"no unit in the file: {', '.join(without_unit)}")
    facts = _facts(settings, {channel.name for channel in channels}) if asylum else {}
    if asylum:
        notes.extend(_changed_during_the_scan(wave.note))
    if dims == ("point",):
        facts |= _sampling_step(wave)
    return Recording(
        path=path,
        format="igor",
        vendor="asylum" if asylum else "igor",
        dims=dims,
        coords=coords,
        channels=channels,
        facts=facts,
        resonances=_resonances(settings, notes) if asylum else (),
        metadata=metadata,
        notes=tuple(notes),
    )


# --- the file -------------------------------------------------------------------------------------


def _load(path: Path) -> _Wave:
    content = path.read_bytes()
    layout = _layout(path, content)

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
    return _Wave(
        values=values,
        labels=layout.labels,
        unit=_text(header["dataUnits"]) or _text(wave.get("data_units", b"")),
        axis_units=tuple(axis_units[:rank]),
        steps=tuple(float(step) for step in steps[:rank]),
        starts=tuple(float(start) for start in starts[:rank]),
        note=_text(wave.get("note", b"")),
    )


def _layout(path: Path, content: bytes) -> _Layout:
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
    return _Layout(dims, labels)


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


# --- the note -------------------------------------------------------------------------------------


def _lines(note: str) -> list[tuple[str, str]]:
    pairs = (line.partition(":") for line in re.split(r"[\r\n]+", note))
    return [(key.strip(), value.strip()) for key, colon, value in pairs if colon and key.strip()]


def _note(note: str) -> dict[str, str]:
    entries: dict[str, str] = {}
    taken: set[str] = set()
    for key, value in _lines(note):
        if key.lower() not in taken:
            taken.add(key.lower())
            entries[key] = value
    return entries


def _changed_during_the_scan(note: str) -> list[str]:
    watched = {"drivefrequency", "driveamplitude", "amplitudesetpointvolts", "phaseoffset", "springconstant"}
    return [
        f"{key} was changed during the scan, to {value}"
        for key, value in _lines(note)
        if key.lower() in watched and "@Line" in value
    ]


class _Settings:
    """Asylum's settings by key; the case of a key varies between versions of the software."""

    def __init__(self, metadata: Mapping[str, str]) -> None:
        self._entries = {key.lower(): (key, value) for key, value in metadata.items()}

    def text(self, key: str) -> str | None:
        """Return the value of a key as text, None where the file has none."""
        return self._entries.get(key.lower(), ("", None))[1]

    def spelling(self, key: str) -> str:
        """Return the key as this file writes it."""
        return self._entries.get(key.lower(), (key, ""))[0]

    def number(self, key: str) -> float | None:
        """Return the value of a key as a number, None where there is none or it is NaN."""
        text = self.text(key) or ""
        match = _NUMBER.fullmatch(text) if len(text) <= _LONGEST_NUMBER else None
        value = float(match.group(1)) if match else math.nan
        return value if math.isfinite(value) else None

    def measured(self, key: str) -> float | None:
        """Return a number that a measurement left; zero stands for "never measured"."""
        return self.number(key) or None


# --- what it says ---------------------------------------------------------------------------------


def _facts(settings: _Settings, channels: set[str]) -> dict[str, Fact]:
    facts: dict[str, Fact] = {}

    def add(name: str, value: float | None, unit: str, key: str, default: bool = False) -> None:
        if value is not None:
            facts[name] = Fact(value, unit, key, default)

    stiffness = settings.measured("SpringConstant")
    add("stiffness", stiffness, "N/m", settings.spelling("SpringConstant"), stiffness == _DEFAULT_STIFFNESS)
    add("drive_frequency", settings.measured("DriveFrequency"), "Hz", settings.spelling("DriveFrequency"))
    add(
        "second_lockin_frequency",
        settings.measured("DriveFrequency1"),
        "Hz",
        settings.spelling("DriveFrequency1"),
    )

    sensitivity = settings.measured("AmpInvOLS")
    uncalibrated = sensitivity is not None and math.isclose(sensitivity, _DEFAULT_AMP_INVOLS, rel_tol=1e-4)
    sensitivity_key = settings.spelling("AmpInvOLS")
    add("amplitude_sensitivity", sensitivity, "m/V", sensitivity_key, uncalibrated)
    for channel, key, default in (
        ("Deflection", "InvOLS", _DEFAULT_INVOLS),
        ("Defl", "InvOLS", _DEFAULT_INVOLS),
        ("Amplitude2", "Amp2InvOLS", _DEFAULT_AMP2_INVOLS),
    ):
        if channel in channels:
            scale = settings.measured(key)
            is_default = scale is not None and math.isclose(scale, default, rel_tol=1e-4)
            add(f"scale:{channel}", scale, "m/V", settings.spelling(key), is_default)

    if any(channel.startswith("Nap") for channel in channels):
        for name, key, unit in (
            ("lift_height", "NapHeight", "m"),
            ("drive_amplitude", "DriveAmplitude", "V"),
            ("lift_drive_amplitude", "NapDriveAmplitude", "V"),
            ("lift_drive_frequency", "NapDriveFrequency", "Hz"),
        ):
            add(name, settings.measured(key), unit, settings.spelling(key))

    amplitudes = {"free_amplitude": "FreeAirAmplitude", "tune_amplitude": "TunePeakResult"}
    # The amplitude set-point governs the scan only where the amplitude is the feedback.
    if settings.text("ImagingMode") in (None, "AC Mode"):
        amplitudes["setpoint_amplitude"] = "AmplitudeSetpointVolts"
    for name, key in amplitudes.items():
        volts = settings.measured(key)
        if volts is not None and sensitivity is not None:
            add(name, volts * sensitivity, "m", f"{settings.spelling(key)} x {sensitivity_key}", uncalibrated)
    phase = settings.measured("FreeAirPhase")
    add(
        "free_phase", None if phase is None else math.radians(phase), "rad", settings.spelling("FreeAirPhase")
    )
    return facts


def _resonances(settings: _Settings, notes: list[str]) -> tuple[Resonance, ...]:
    resonances: list[Resonance] = []
    for source, frequency_key, quality_key, default_frequency, default_quality in (
        ("thermal", "ThermalFrequency", "ThermalQ", _DEFAULT_THERMAL_FREQUENCY, _DEFAULT_THERMAL_Q),
        ("tune", "TuneFreqResult", "TuneQResult", None, _DEFAULT_TUNE_Q),
    ):
        frequency, quality = settings.measured(frequency_key), settings.measured(quality_key)
        if frequency is None or quality is None:
            continue
        default = frequency == default_frequency or quality == default_quality
        # The note rounds to five digits; the resonance of the lever may stand there in full.
        full = settings.measured("ResFreq1")
        if full is not None and full != frequency and float(f"{full:.5g}") == frequency:
            notes.append(
                f"{settings.spelling(frequency_key)} {frequency:g} Hz is rounded; "
                f"{settings.spelling('ResFreq1')} gives it in full, {full:.2f} Hz"
            )
            frequency, frequency_key = full, "ResFreq1"
        # A thermal fit and a tune that agree to the last digit are one measurement written down twice.
        if not any((r.frequency, r.quality_factor) == (frequency, quality) for r in resonances):
            keys = (settings.spelling(frequency_key), settings.spelling(quality_key))
            resonances.append(Resonance(source, frequency, quality, keys, default))
    return tuple(resonances)


def _sampling_step(wave: _Wave) -> dict[str, Fact]:
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
    asylum: bool,
    settings: _Settings,
) -> Channel:
    name, direction = label, None
    match = _DIRECTION.fullmatch(label)
    if match:
        # What follows the direction marks a processed copy and keeps it apart from the original.
        name, direction = match.group(1) + match.group(3), match.group(2).lower()
    known = _unit_of_kind(name) if asylum and label else to_si(wave_unit) if wave_unit else None
    factor, unit = known if known is not None else (1.0, None)
    return Channel(
        name=name or f"layer {index + 1}",
        values=np.ascontiguousarray(values * factor),
        unit=unit,
        direction=direction,
        nap=name.startswith("Nap"),
        flattened=_flattened(index, settings),
    )


def _unit_of_kind(name: str) -> tuple[float, str] | None:
    kind = re.sub(r"(?:Mod)?\d*$", "", name.removeprefix("Nap")).lower()
    if kind in _LENGTHS:
        return 1.0, "m"
    if kind in _ANGLES:
        return math.pi / 180.0, "rad"
    if kind in _FREQUENCIES:
        return 1.0, "Hz"
    return None


def _flattened(index: int, settings: _Settings) -> bool | None:
    orders = [settings.number(f"{key} {index}") for key in ("FlattenOrder", "PlanefitOrder")]
    stated = [order for order in orders if order is not None]
    return any(order >= 0 for order in stated) if stated else None


def _coordinates(wave: _Wave, settings: _Settings, notes: list[str]) -> dict[str, npt.NDArray[np.float64]]:
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
