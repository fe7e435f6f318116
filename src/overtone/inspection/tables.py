"""Channels, settings and size of a recording in words and readable units."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from overtone.inspection.records import ChannelRow, SettingRow
from overtone.io.recording import Channel, Recording
from overtone.io.registry import FORMATS
from overtone.io.resonance import NOMINAL
from overtone.io.selection import is_clipped
from overtone.units import display_unit, format_quantity

_WORDS = {
    "stiffness": "stiffness k of the lever",
    "drive_frequency": "drive frequency",
    "drive_amplitude": "drive voltage",
    "drive_phase": "phase of the drive",
    "free_amplitude": "free amplitude",
    "free_amplitude_volts": "free amplitude in volts",
    "free_phase": "phase of the free lever",
    "setpoint_amplitude": "set-point",
    "setpoint_volts": "set-point in volts",
    "setpoint_fraction": "set-point over free amplitude",
    "tune_amplitude": "peak amplitude of the tune",
    "amplitude_sensitivity": "sensitivity of the amplitude",
    "deflection_sensitivity": "sensitivity of the deflection",
    "second_lockin_frequency": "second lock-in frequency",
    "sampling_step": "time between points",
    "lift_height": "height of the lift pass",
    "lift_drive_frequency": "drive frequency of the lift pass",
    "lift_drive_amplitude": "drive voltage of the lift pass",
}
_RESONANCES = {"tune": "of the tune", "thermal": "of the thermal spectrum", NOMINAL: "of the catalogue"}
_DEFAULT = "factory default"
_SECOND = ("2", "A2", "phi2")
_DIGITS = 4


def channel_rows(
    recording: Recording, used: Mapping[str, Channel], unused: Mapping[str, str]
) -> list[ChannelRow]:
    """Return a row for each channel.

    Parameters
    ----------
    recording : Recording
        As read.
    used : mapping of str to Channel
        Observable to the channel it is taken from.
    unused : mapping of str to str
        Observable to the reason why its channel cannot be used as it is.
    """
    roles = {_identity(channel): name for name, channel in used.items()}
    rows = []
    for channel in recording.channels:
        role = roles.get(_identity(channel), "")
        values = channel.values[np.isfinite(channel.values)]
        lost = channel.values.size - values.size
        remarks = ["Nap or lift pass"] if channel.nap else []
        remarks += ["flattened"] if channel.flattened else []
        remarks += (
            [f"{lost} invalid pixels" if len(recording.dims) > 1 else f"{lost} invalid points"]
            if lost
            else []
        )
        remarks += [unused[role]] if role in unused else []
        if role and f"offset:{channel.name}" in recording.facts:
            remarks.append("+ set-point")
        if role not in ("", "height") and _is_saturated(role, used):
            remarks.append("saturated")
        mean, low, high = (
            (float(values.mean()), float(values.min()), float(values.max()))
            if values.size
            else (math.nan,) * 3
        )
        rows.append(
            ChannelRow(
                channel.name, channel.unit, channel.direction, role, mean, low, high, ", ".join(remarks)
            )
        )
    return rows


def setting_rows(recording: Recording) -> list[SettingRow]:
    """Return a row for each number that the file states about the instrument."""
    second = any(channel.name.endswith(_SECOND) for channel in recording.channels)
    rows = []
    for name, fact in recording.facts.items():
        if name == "second_lockin_frequency" and not second:
            continue  # what is left in the software of a lock-in that nobody recorded
        rows.append(
            SettingRow(
                _words(name),
                quantity_text(fact.value, fact.unit),
                fact.key,
                _DEFAULT if fact.factory_default else "",
            )
        )
    for pair in recording.resonances:
        text = f"{format_quantity(pair.frequency, 'Hz', 6)}, Q {pair.quality_factor:.4g}"
        remark = _DEFAULT if pair.factory_default and pair.source != NOMINAL else ""
        if pair.source == NOMINAL:
            remark = "not measured" if pair.factory_default else "perhaps not measured"
        name = f"resonance f0 {_RESONANCES.get(pair.source, f'({pair.source})')}"
        rows.append(SettingRow(name, text, ", ".join(pair.keys), remark))
    return rows


def quantity_text(value: float, unit: str) -> str:
    """Write a setting for people.

    Examples
    --------
    >>> quantity_text(41.497e-9, "m/V"), quantity_text(0.65, "1"), quantity_text(1.5, "V")
    ('41.497 nm/V', '0.65', '1.5 V')
    """
    if unit == "m/V":
        return f"{value * 1e9:.5g} nm/V"
    return format_quantity(value, unit, 5)


def numbers_text(row: ChannelRow) -> tuple[str, str, str]:
    """Return the unit of a channel for people, its mean, and its range, in digits that the range makes sense of.

    Examples
    --------
    >>> numbers_text(ChannelRow("Height", "m", None, "height", -3e-17, -9e-9, 1.2e-8, ""))
    ('nm', '0', '-9 .. 12')
    """
    if not math.isfinite(row.mean):
        return row.unit or "none", "-", "-"
    largest = max(abs(row.low), abs(row.high))
    display = display_unit(largest, row.unit or "1")
    decimals = _DIGITS - 1 - math.floor(math.log10(largest * display.factor)) if largest > 0.0 else 0
    texts = [
        f"{round(value * display.factor, decimals) + 0.0:.{_DIGITS}g}"
        for value in (row.mean, row.low, row.high)
    ]
    unit = "none" if row.unit is None else display.label or "1"
    return unit, texts[0], texts[1] if row.low == row.high else f"{texts[1]} .. {texts[2]}"


def format_title(key: str) -> str:
    """Return the name of a format for people."""
    return next((known.title for known in FORMATS if known.key == key), key)


def size_text(recording: Recording) -> str:
    """Return how many pixels or points there are, and over what size."""
    if not recording.channels:
        return "no data"
    sizes = dict(zip(recording.dims, recording.channels[0].values.shape, strict=False))
    if "y" not in sizes or "x" not in sizes:
        count = f"{math.prod(sizes.values())} points"
        spans = [
            f"{format_quantity(float(np.ptp(z)), 'm')} of height"
            for d, z in recording.coords.items()
            if d == "z"
        ]
        return ", ".join([count, *spans])
    frames = f"{sizes['frame']} frames of " if "frame" in sizes else ""
    pixels = f"{frames}{sizes['x']} x {sizes['y']} pixels"
    lengths = [_length(recording.coords[dim]) for dim in ("x", "y") if dim in recording.coords]
    if len(lengths) < 2:
        return f"{pixels}, scan size not in the file"
    display = display_unit(max(lengths), "m")
    width, height = (f"{length * display.factor:.3g}" for length in lengths)
    return f"{pixels}, {width} x {height} {display.label}"


def _length(coordinate: np.ndarray) -> float:
    """Return the length of an axis: to the edges of its pixels, unless its ends are said to be the edges."""
    low, high = float(coordinate.min()), float(coordinate.max())
    if coordinate.size < 2 or low == 0.0:
        return high - low
    return (high - low) * coordinate.size / (coordinate.size - 1)


def _words(name: str) -> str:
    kind, _, channel = name.partition(":")
    if channel:
        return {"scale": f"sensitivity of {channel}", "offset": f"set-point to add to {channel}"}.get(
            kind, name
        )
    return _WORDS.get(name, name.replace("_", " "))


def _identity(channel: Channel) -> tuple[str, str | None, bool]:
    return channel.name, channel.direction, channel.nap


def _is_saturated(role: str, used: Mapping[str, Channel]) -> bool:
    array = used[role].values
    others = [channel.values for name, channel in used.items() if name not in (role, "height")]
    finite = array[np.isfinite(array)]
    return bool(finite.size) and any(is_clipped(array, end, others) for end in (finite.max(), finite.min()))
