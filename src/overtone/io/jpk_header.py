"""What the headers of JPK's files say, in TIFF and HDF5 alike: calibration slots, scan size, feedback, probe."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from overtone.errors import UnitError
from overtone.io.gsf import centres
from overtone.io.recording import Fact, Resonance
from overtone.io.si import to_si
from overtone.units import format_quantity, parse_quantity

_REFERENCE = "adjust-reference-amplitude-feedback-settings"
_SINE = "sine-generator-feedback-settings"
_SETPOINT = "setpoint-feedback-settings"
_PROBE = "cantilever-calibration-info"
_LONGEST_NUMBER = 100


@dataclass(frozen=True)
class Slot:
    """One way to turn a channel's numbers into a quantity: ``multiplier * raw + offset`` in ``unit``."""

    name: str
    unit: str
    multiplier: float
    offset: float


# --- channels -------------------------------------------------------------------------------------


def choose_slot(name: str, slots: Sequence[Slot], default: str, notes: list[str]) -> Slot | None:
    """Return the slot to use: the software's own choice, or a calibrated one in metres where that has none.

    Parameters
    ----------
    name : str
        Channel, for the notes.
    slots : sequence of Slot
        The calibrated slots, each built on those before it.
    default : str
        Name of the slot that the software had chosen.
    notes : list of str
        Gets a sentence where another slot is taken.
    """
    chosen = next((slot for slot in slots if slot.name == default), None)
    lengths = [slot for slot in slots if slot.unit == "m"]
    if lengths and (chosen is None or chosen.unit != "m"):
        notes.append(f"{name}: in metres by its calibration {lengths[-1].name!r}, not as {default!r}")
        return lengths[-1]
    if chosen is None and slots:
        notes.append(f"{name}: its calibration {default!r} is not in the file; {slots[-1].name!r} was taken")
        return slots[-1]
    return chosen


def with_sign(raw: npt.NDArray[Any], encoder: str) -> npt.NDArray[Any]:
    """Return integers with the sign that the encoder states, whatever the container says."""
    kind = encoder.lower()
    wanted = "u" if kind.startswith("unsigned") else "i" if kind.startswith("signed") else raw.dtype.kind
    if raw.dtype.kind in "iu" and wanted != raw.dtype.kind:
        return raw.view(raw.dtype.str.replace(raw.dtype.kind, wanted))
    return raw


def in_si(
    name: str, raw: npt.NDArray[Any], slot: Slot | None, notes: list[str]
) -> tuple[npt.NDArray[np.float64], str | None]:
    """Return a channel in SI units with the unit; NaN where the converter was at an end of its range."""
    with np.errstate(invalid="ignore"):  # a signalling NaN is a NaN like any other
        values = raw.astype(np.float64)
    if raw.dtype.kind == "i":
        span = np.iinfo(raw.dtype)
        lost = (raw == span.min) | (raw == span.max)
        if lost.any():
            values[lost] = np.nan
            notes.append(f"{name}: {int(lost.sum())} invalid pixels, at an end of the range of the converter")
    if slot is None:
        notes.append(f"{name}: the file states no calibration, so the numbers have no unit")
        return values, None
    known = to_si(slot.unit) if slot.unit else None
    factor, unit = known if known is not None else (1.0, None)
    if known is None:
        notes.append(f"{name}: the unit {slot.unit!r} is not known; values are as in the file")
    with np.errstate(over="ignore", invalid="ignore"):
        return (values * slot.multiplier + slot.offset) * factor, unit


def coordinates(
    shape: tuple[int, ...],
    grid: tuple[float | None, float | None],
    size: tuple[float | None, float | None, float | None],
    notes: list[str],
) -> dict[str, npt.NDArray[np.float64]]:
    """Return pixel centres [m] along the lines and across them, from the lower left corner of the scan.

    Parameters
    ----------
    shape : tuple of int
        Rows and columns of the channels.
    grid : tuple of float
        Rows and columns as the file states them, None where it does not.
    size : tuple of float
        Lengths of the scan along and across its lines [m], and its rotation [rad].
    notes : list of str
        Gets a sentence where the size cannot be used or the scan was turned.
    """
    length, width, angle = size
    if any(stated is not None and stated != there for stated, there in zip(grid, shape, strict=True)):
        notes.append(f"the file states {grid[0]:g} x {grid[1]:g} pixels and holds {shape[0]} x {shape[1]}")
        length = None
    if length is None or width is None or not (0.0 < length < 1.0 and 0.0 < width < 1.0):
        notes.append("the file states no usable image size, so there are no coordinates")
        return {}
    if angle:
        notes.append(f"the scan was turned by {math.degrees(angle):g} deg: x runs along its lines")
    return centres(shape, length, width)


# --- settings -------------------------------------------------------------------------------------


def find(settings: Mapping[str, str], ending: str) -> str:
    """Return the shortest key that ends so, whatever group it stands in; empty where there is none."""
    keys = [key for key in settings if key == ending or key.endswith(f".{ending}")]
    return min(keys, key=len, default="")


def _fact(settings: Mapping[str, str], ending: str, unit: str) -> Fact | None:
    """Return a positive setting in SI units; a number without a unit is in SI units already."""
    key = find(settings, ending)
    text = settings.get(key, "")[:_LONGEST_NUMBER]
    for stated in ("1", unit):
        try:
            value = parse_quantity(text, stated)
        except (UnitError, ArithmeticError):
            continue
        return Fact(value, unit, key) if 0.0 < value < math.inf else None
    return None


def _product(first: Fact, second: Fact, unit: str) -> Fact:
    # The groups that both stand in are said where each is listed by itself.
    keys = (one.key.rpartition(".")[2] for one in (first, second))
    return Fact(first.value * second.value, unit, " x ".join(keys))


def feedback_facts(
    settings: Mapping[str, str], amplitude: Sequence[Slot], notes: list[str]
) -> dict[str, Fact]:
    """Return drive, set-point and reference amplitude of an AC mode.

    The reference amplitude, which the set-point is a fraction of, is the free one that the software measured.

    Parameters
    ----------
    settings : mapping
        Settings of the scan, key to text.
    amplitude : sequence of Slot
        Calibrated slots of the amplitude channel; reference and set-point are in one of them.
    notes : list of str
        Gets what a person should know of these settings.
    """
    stated = {
        "drive_frequency": _fact(settings, f"{_SINE}.frequency", "Hz"),
        "drive_amplitude": _fact(settings, f"{_SINE}.amplitude", "V"),
        "setpoint_fraction": _fact(settings, f"{_SETPOINT}.relative-setpoint", "1"),
    }
    facts = {name: fact for name, fact in stated.items() if fact is not None}
    shift = find(settings, f"{_SINE}.phaseshift")
    if shift:
        notes.append(
            f"the lock-in had a phase shift of {settings[shift][:_LONGEST_NUMBER]} ({shift}); the file states "
            "no unit for it"
        )
    slot_name = settings.get(find(settings, f"{_SETPOINT}.setpoint-slot"), "voltsamplitude")
    slot = next((one for one in amplitude if one.name == slot_name), None)
    lengths = [one for one in amplitude if one.unit == "m" and one.offset == 0.0]
    if slot is not None and slot.unit == "V" and slot.offset == 0.0 and lengths:
        key = f"calibration {lengths[-1].name} / {slot.name}"
        facts["amplitude_sensitivity"] = Fact(lengths[-1].multiplier / slot.multiplier, "m/V", key)
    reference = _fact(settings, f"{_REFERENCE}.reference-amplitude", "V")
    if reference is None or slot is None or slot.unit not in ("V", "m"):
        return facts
    if settings.get(find(settings, f"{_REFERENCE}.enabled")) == "true":
        notes.append(
            f"the reference amplitude was readjusted during the scan; {reference.key} is the last one"
        )
    amplitudes = {"free": Fact(reference.value, slot.unit, reference.key)}
    if "setpoint_fraction" in facts:
        amplitudes["setpoint"] = _product(facts["setpoint_fraction"], reference, slot.unit)
    for name, one in amplitudes.items():
        if slot.unit == "m":
            facts[f"{name}_amplitude"] = one
            continue
        facts["free_amplitude_volts" if name == "free" else "setpoint_volts"] = one
        if "amplitude_sensitivity" in facts:
            facts[f"{name}_amplitude"] = _product(one, facts["amplitude_sensitivity"], "m")
    return facts


def probe_facts(settings: Mapping[str, str]) -> dict[str, Fact]:
    """Return stiffness and sensitivity of the lever, where the file holds its calibration."""
    if settings.get(find(settings, f"{_PROBE}.defined"), "true") != "true":
        return {}
    stated = {
        "stiffness": _fact(settings, f"{_PROBE}.spring-constant", "N/m"),
        "deflection_sensitivity": _fact(settings, f"{_PROBE}.sensitivity", "m/V"),
    }
    return {name: fact for name, fact in stated.items() if fact is not None}


def resonances(settings: Mapping[str, str], notes: list[str]) -> tuple[Resonance, ...]:
    """Return the resonance of the thermal noise, where the file holds frequency and quality factor."""
    if settings.get(find(settings, f"{_PROBE}.defined"), "true") != "true":
        return ()
    frequency = _fact(settings, f"{_PROBE}.frequency", "Hz")
    quality = _fact(settings, f"{_PROBE}.qFactor", "1")
    if frequency is None or quality is None:
        return ()
    medium = settings.get(find(settings, f"{_PROBE}.calibration-environment"), "")
    if medium:
        notes.append(
            f"the lever was calibrated in {medium}: {format_quantity(frequency.value, 'Hz', 4)}, "
            f"Q {quality.value:g}"
        )
    return (Resonance("thermal", frequency.value, quality.value, (frequency.key, quality.key)),)
