"""What a Nanosurf file says of the instrument: lever, drive, set-point and sensitivity.

Properties of the lever have numbers instead of names in the file. ``Prop0`` is the stiffness, ``Prop1``, ``Prop5`` and
``Prop11`` are the resonance in air, liquid and vacuum, ``Prop4``, ``Prop6`` and ``Prop10`` the quality factors there
(units in the files, and the order of GetCantileverProperty in Nanosurf's Python library). They are the numbers of
a catalogue until somebody calibrates the lever, and nothing in the file says which they are, except their digits.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from overtone.io.recording import Channel, Fact, Resonance
from overtone.io.si import to_si
from overtone.units import format_quantity

_LONGEST_NUMBER = 40
_NUMBER = re.compile(r"\s*([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d{1,4})?)\s*(.*?)\s*")
_PARAMETER = re.compile(r"[A-Z]\[([^\[\]]*)\]\*\[([^\[\]]*)\]")
# Properties of the lever: resonance and quality factor by the environment of the measurement.
_RESONANCE = {"Air": ("Prop1", "Prop4"), "Liquid": ("Prop5", "Prop6"), "Vacuum": ("Prop11", "Prop10")}
# Infos have three digits; a parameter that differs by more is left over from another mode.
_AGREEMENT = 5e-3
_OFF_RESONANCE = 0.01
_SCALED = ("Amplitude", "Deflection")


@dataclass(frozen=True)
class Settings:
    """The sections of a header that describe the instrument, empty where the file has none."""

    info: Mapping[str, str]
    feedback: Mapping[str, str]
    lever: Mapping[str, str]
    inputs: Mapping[str, tuple[str, float]]
    """Unit and full scale by the name of an input of the scan head."""

    @classmethod
    def of(cls, sections: Mapping[str, Mapping[str, str]]) -> Settings:
        """Pick the settings out of the sections of a header."""
        info: dict[str, str] = dict(sections.get("DataSet-Info", {}))
        for name, entries in sections.items():
            if name.startswith("DataSet\\DataSetInfos\\"):
                info = {**entries, **info}
        inputs = {}
        for key, value in sections.get("DataSet\\Calibration\\Scanhead", {}).items():
            # Number, name, label, unit, full scale, offset.
            parts = value.split(",")
            if re.fullmatch(r"In\d{1,4}", key) and len(parts) == 6:
                inputs[parts[1]] = (parts[3], number(parts[4]))
        return cls(
            info,
            sections.get("DataSet\\Parameters\\ZFeedback", {}),
            sections.get("DataSet\\Calibration\\Cantilever", {}),
            inputs,
        )


def number(text: str) -> float:
    """Return the number in a text of the header, NaN where there is none or it is not finite."""
    match = _NUMBER.fullmatch(text) if len(text) <= _LONGEST_NUMBER else None
    value = float(match[1]) if match and not match[2] else math.nan
    return value if math.isfinite(value) else math.nan


def quantity_of(text: str, unit: str) -> float | None:
    """Return the SI value of a text such as ``250mV``, None where it is no quantity of this unit.

    Examples
    --------
    >>> quantity_of("172.823kHz", "Hz"), quantity_of("65 %", "1"), quantity_of("20nN", "1")
    (172823.0, 0.65, None)
    """
    match = _NUMBER.fullmatch(text) if len(text) <= _LONGEST_NUMBER else None
    known = to_si(match[2]) if match and match[2] else None
    if match is None or known is None or known[1] != unit:
        return None
    value = float(match[1]) * known[0]
    return value if math.isfinite(value) else None


def parameter(entries: Mapping[str, str], key: str, unit: str) -> float | None:
    """Return a value such as ``D[48]*[N/m]`` of a section in SI, None where there is none of this unit."""
    match = _PARAMETER.fullmatch(entries.get(key, "")[: 3 * _LONGEST_NUMBER])
    if match is None:
        return None
    if unit == "1" and not match[2]:
        value = number(match[1])
        return value if math.isfinite(value) else None
    return quantity_of(f"{match[1]} {match[2]}", unit)


def facts_of(settings: Settings, channels: Sequence[Channel]) -> dict[str, Fact]:
    """Return what the file says of lever, drive and detector, in SI units.

    Drive, free amplitude and set-point count only where the infos list them: among the parameters those of
    another mode remain.
    """
    facts: dict[str, Fact] = {}
    stiffness = parameter(settings.lever, "Prop0", "N/m")
    if stiffness is not None and stiffness > 0.0:
        facts["stiffness"] = Fact(stiffness, "N/m", "Prop0", _is_round(stiffness))
    for name, unit, shown, full in (
        ("drive_frequency", "Hz", "Vibration freq.", "RefFrq"),
        ("drive_amplitude", "V", "Excitation ampl.", "RefAmplitude"),
        ("free_amplitude_volts", "V", "Vibration ampl.", "DynamicAmp"),
    ):
        value, key = quantity_of(settings.info.get(shown, ""), unit), shown
        exact = parameter(settings.feedback, full, unit)
        if value is not None and exact is not None and math.isclose(value, exact, rel_tol=_AGREEMENT):
            value, key = exact, full
        if value is not None and value > 0.0:
            facts[name] = Fact(value, unit, key)
    for key in ("Setpoint", "Set point"):  # old software writes it in two words
        fraction = quantity_of(settings.info.get(key, ""), "1")
        if fraction is not None and fraction > 0.0:
            facts["setpoint_fraction"] = Fact(fraction, "1", key)
    sensitivity = _sensitivity(settings)
    if sensitivity is not None:
        facts["deflection_sensitivity"] = sensitivity
        for channel in channels:
            if channel.name in _SCALED and channel.unit == "V":
                facts[f"scale:{channel.name}"] = sensitivity
        free = facts.get("free_amplitude_volts")
        if free is not None:
            facts["free_amplitude"] = Fact(
                free.value * sensitivity.value,
                "m",
                f"{free.key} x {sensitivity.key}",
                sensitivity.factory_default,
            )
    return facts


def resonances_of(settings: Settings) -> tuple[Resonance, ...]:
    """Return the resonance of the lever in the environment of the measurement, where the file has its Q."""
    keys = _RESONANCE.get(settings.info.get("Measurement environment", "Air"))
    if keys is None:
        return ()
    frequency, quality = (
        parameter(settings.lever, key, unit) for key, unit in zip(keys, ("Hz", "1"), strict=True)
    )
    if frequency is None or quality is None or not (frequency > 0.0 and quality > 0.0):
        return ()
    return (Resonance("nominal", frequency, quality, keys, _is_round(frequency) or _is_round(quality)),)


def notes_of(settings: Settings, channels: Sequence[Channel]) -> list[str]:
    """Return in words what is doubtful about the settings."""
    notes = []
    facts, resonances = facts_of(settings, channels), resonances_of(settings)
    lever = (
        " ".join(filter(None, (settings.lever.get("Manufacturer"), settings.lever.get("Name"))))
        or "the lever"
    )
    stiffness = facts.get("stiffness")
    if stiffness is not None and stiffness.factory_default:
        notes.append(
            f"the stiffness of {stiffness.value:g} N/m ({stiffness.key}) is a round number as in the catalogue of "
            f"{lever[:60]}, not a measurement"
        )
    drive = facts.get("drive_frequency")
    for resonance in resonances:
        if resonance.factory_default:
            notes.append(
                f"the resonance of {format_quantity(resonance.frequency, 'Hz', 6)} with Q {resonance.quality_factor:g} "
                f"({', '.join(resonance.keys)}) is of the catalogue, not of this lever"
            )
        if drive is not None and abs(drive.value / resonance.frequency - 1.0) > _OFF_RESONANCE:
            notes.append(
                f"it was driven at {format_quantity(drive.value, 'Hz', 6)}, "
                f"{100.0 * abs(drive.value / resonance.frequency - 1.0):.2g} % off that resonance: the resonance and "
                "the Q of this lever are not in the file"
            )
    if not resonances:
        frequency = settings.lever.get("Prop1")
        said = f", only a resonance frequency, Prop1 {frequency[:40]}" if frequency else ""
        notes.append(f"the file holds no resonance with a quality factor{said}")
    sensitivity = facts.get("deflection_sensitivity")
    if sensitivity is not None and "scale:Amplitude" in facts:
        default = ", and that of a scan head that was never calibrated" if sensitivity.factory_default else ""
        notes.append(
            f"the sensitivity of {sensitivity.value * 1e9:.5g} nm/V is that of the static deflection{default}; that it "
            "holds for the amplitude as well is not in the file (an oscillating lever reads about 9 % "
            "differently)"
        )
    reference = parameter(settings.feedback, "RefPhase", "1")
    if reference is None:
        degrees = parameter(settings.feedback, "RefPhase", "rad")
        reference = None if degrees is None else math.degrees(degrees)
    if reference is not None and any(channel.unit == "rad" for channel in channels):
        notes.append(
            f"phases are counted from the reference phase of the lock-in, {reference:g} deg (RefPhase); what they read "
            "far from the surface is not in the file"
        )
    mode = settings.info.get("Op. mode", "")
    if mode and drive is None:
        notes.append(f"the file says {mode[:60]}, and nothing of a vibration")
    return notes


def _sensitivity(settings: Settings) -> Fact | None:
    """Return the sensitivity of the deflection: the same full scale once in metres and once in volts."""
    (unit, length), (other, volts) = (
        settings.inputs.get(name, ("", math.nan)) for name in ("TipSignalDC", "TipSignalDC1")
    )
    if unit != "m" or other != "V" or not (length > 0.0 and volts > 0.0):
        return None
    uncalibrated = settings.info.get("Scan head", "").lower().startswith("uncal")
    return Fact(length / volts, "m/V", "TipSignalDC / TipSignalDC1", uncalibrated)


def _is_round(value: float) -> bool:
    """Tell whether a number has at most three digits, as catalogues have and measurements have not."""
    return float(f"{value:.3g}") == value
