"""An instrument as TOML text whose quantities carry units, in both directions."""

from __future__ import annotations

import cmath
import dataclasses
import re
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import tomli_w

from overtone.errors import OvertoneError, UnitError
from overtone.instrument.instrument import Instrument, NearSurface
from overtone.instrument.photodiode import SplitDiode
from overtone.units import display_unit, parse_quantity

_DENSITY = "m/rtHz"
_ROOT = re.compile(r"\s*/\s*(?:rt|sqrt|√)\s*\(?\s*Hz\s*\)?\s*$")
_RATES = {_DENSITY: ("m", "/rtHz"), "m/s": ("m", "/s"), "Hz/s": ("Hz", "/s")}
_UNITS = {
    "mean_offset": "m",
    "mean_slope_z": "1",
    "mean_slope_x": "1",
    "mean_slope_y": "1",
    "mean_drift": "m/s",
    "flicker": _DENSITY,
    "phase_offset": "rad",
    "frequency_drift": "Hz/s",
    "quality_drift": "1/s",
    "drive_drift": "1/s",
    "bandwidth": "Hz",
    "line_time": "s",
    "feedback_error": "1",
    "detector_noise": _DENSITY,
    "temperature": "K",
}
_BY_HARMONIC: Mapping[str, Any] = {
    "distortion": lambda n: "1/m" if n == 2 else f"1/m^{n - 1}",
    "gains": lambda n: "1",
    "latency": lambda n: "rad",
}
_PHASORS = ("crosstalk", "drive_distortion")
_PARTS: Mapping[str, tuple[Any, Mapping[str, str | None]]] = {
    "near_surface": (NearSurface, {"damping": "1", "softening": "1", "decay": "m"}),
    "diode": (SplitDiode, {"spot": "m", "shape": None, "offset": "m", "gap": "m"}),
}


def load_instrument(path: str | Path) -> Instrument:
    """Read an instrument from a TOML file whose quantities carry units.

    Raises
    ------
    OvertoneError
        If the file cannot be read, is not TOML, or misstates a quantity. Every fault is named.
    """
    path = Path(path)
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise OvertoneError(
            f"cannot read the instrument file {path}", got=str(error), hint="check the path"
        ) from error
    return parse_instrument(text, source=path.name)


def parse_instrument(text: str, source: str = "instrument") -> Instrument:
    """Read an instrument from TOML text; what is not named adds nothing.

    Phasors are in the lag convention, ``amplitude exp(-i phase)``; amplitude densities are in m/rtHz.

    Raises
    ------
    OvertoneError
        If the text is not TOML or misstates a quantity. Every fault is named.

    Examples
    --------
    >>> instrument = parse_instrument('''
    ... mean_offset = "25 pm"
    ... mean_slope_z = "2 nm/um"
    ... detector_noise = "40 fm/rtHz"
    ... latency = {2 = "17 deg"}
    ... crosstalk = {2 = {amplitude = "50 pm", phase = "90 deg"}}
    ... near_surface = {damping = "3 %", decay = "5 um"}
    ... ''')
    >>> instrument.mean_slope_z, instrument.detector_noise, instrument.near_surface.damping
    (0.002, 4e-14, 0.03)
    """
    try:
        table = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise OvertoneError(f"{source} is not TOML", got=str(error)) from error
    faults: list[str] = []
    values: dict[str, Any] = {}
    for name, entry in table.items():
        if name in _UNITS:
            values[name] = _number(entry, _UNITS[name], name, faults)
        elif name in _BY_HARMONIC or name in _PHASORS:
            values[name] = _harmonics(entry, name, faults)
        elif name in _PARTS:
            values[name] = _part(entry, name, faults)
        else:
            faults.append(f"an instrument has no {name}")
    if not faults:
        try:
            return Instrument(**values)
        except OvertoneError as error:
            faults.append(str(error))
    raise OvertoneError(
        f"{source} does not describe an instrument",
        got="; ".join(faults),
        hint='quantities with units, as in mean_offset = "25 pm"; of harmonics as in latency = {2 = "0.3 rad"}',
    )


def _number(entry: Any, unit: str, name: str, faults: list[str]) -> float:
    """Return the SI value of a text with a unit; on failure 0, with the fault in the list."""
    try:
        if isinstance(entry, bool) or not isinstance(entry, str | int | float):
            faults.append(f"{name} is no quantity")
            return 0.0
        if unit != _DENSITY:
            return parse_quantity(entry, unit, name)
        length = _ROOT.sub("", str(entry))
        if length == str(entry):
            faults.append(f'{name} is no amplitude density such as "30 fm/rtHz", but {entry!r}')
            return 0.0
        return parse_quantity(length, "m", name)
    except UnitError as error:
        faults.append(str(error).rstrip("."))
        return 0.0


def _harmonics(entry: Any, name: str, faults: list[str]) -> dict[int, Any]:
    """Return what a table says of each harmonic."""
    if not isinstance(entry, Mapping):
        faults.append(f"{name} is no table of harmonics such as {{2 = ...}}")
        return {}
    result: dict[int, Any] = {}
    for key, value in entry.items():
        label = f"{name}.{key}"
        if key not in ("2", "3") and (key, name) != ("0", "gains"):
            faults.append(f"{label}: harmonics of an instrument are 2 and 3, and 0 for a gain")
        elif name in _PHASORS:
            result[int(key)] = _phasor(value, label, faults)
        else:
            result[int(key)] = _number(value, _BY_HARMONIC[name](int(key)), label, faults)
    return result


def _phasor(entry: Any, label: str, faults: list[str]) -> complex:
    if not isinstance(entry, Mapping) or set(entry) != {"amplitude", "phase"}:
        faults.append(f'{label} is no phasor such as {{amplitude = "50 pm", phase = "57 deg"}}')
        return 0j
    amplitude = _number(entry["amplitude"], "m", f"{label}.amplitude", faults)
    return amplitude * cmath.exp(-1j * _number(entry["phase"], "rad", f"{label}.phase", faults))


def _part(entry: Any, name: str, faults: list[str]) -> Any:
    """Return the air film or the photodiode that a table describes."""
    kind, units = _PARTS[name]
    if not isinstance(entry, Mapping):
        faults.append(f"[{name}] is not a table")
        return None
    before = len(faults)
    faults += [f"[{name}] has no quantity {key!r}" for key in entry if key not in units]
    needed = [f.name for f in dataclasses.fields(kind) if f.default is dataclasses.MISSING]
    faults += [f"[{name}] lacks {key}" for key in needed if key not in entry]
    values: dict[str, Any] = {}
    for key, unit in units.items():
        if key in entry:
            values[key] = entry[key] if unit is None else _number(entry[key], unit, f"{name}.{key}", faults)
    if len(faults) > before:
        return None
    try:
        return kind(**values)
    except OvertoneError as error:
        faults.append(str(error).rstrip("."))
        return None


# --- writing ---------------------------------------------------------------------------------------


def format_instrument(instrument: Instrument) -> str:
    """Write an instrument as TOML text that `parse_instrument` reads back; what adds nothing is left out.

    Numbers come back as the same floats, phasors to rounding.
    """
    neutral = Instrument()
    table: dict[str, Any] = {}
    for name, unit in _UNITS.items():
        value = getattr(instrument, name)
        if value != getattr(neutral, name):
            table[name] = _with_unit(value, unit)
    for name in (*_BY_HARMONIC, *_PHASORS):
        entries: dict[str, Any] = {}
        for n, value in sorted(getattr(instrument, name).items()):
            if name in _PHASORS:
                amplitude, phase = abs(value), -cmath.phase(value)
                entries[str(n)] = {"amplitude": _with_unit(amplitude, "m"), "phase": _with_unit(phase, "rad")}
            else:
                entries[str(n)] = _with_unit(value, _BY_HARMONIC[name](n))
        if entries:
            table[name] = entries
    for name, (_, units) in _PARTS.items():
        part = getattr(instrument, name)
        if part != getattr(neutral, name):
            table[name] = {
                key: getattr(part, key) if unit is None else _with_unit(getattr(part, key), unit)
                for key, unit in units.items()
            }
    return tomli_w.dumps(table)


def save_instrument(instrument: Instrument, path: str | Path) -> None:
    """Write an instrument to a TOML file, quantities with units."""
    Path(path).write_text(format_instrument(instrument), encoding="utf-8")


def _with_unit(value: float, unit: str) -> str | float:
    """Write a value so that reading it back gives the same float, in a readable unit if it can be."""
    value = float(value)
    if unit == "1":
        return value
    base, rate = _RATES.get(unit, (unit, ""))
    display = display_unit(value, base)
    for digits in range(1, 18):
        text = f"{float(f'{value * display.factor:.{digits}g}')!r} {display.label}{rate}"
        if _number(text, unit, unit, []) == value:
            return text
    return f"{value!r} {unit}"
