"""Common probes by name, with the nominal values of their makers.

A preset is a place to start, not a calibration: levers of one box differ by a factor of two in
stiffness, and the radius of a tip changes while it scans.
"""

from __future__ import annotations

import difflib
import functools
import tomllib
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib import resources
from typing import Any

from overtone.beam import beam_modes
from overtone.errors import ProbeError, UncalibratedWarning
from overtone.probe import SLOPE, Detector, Drive, Probe, Tip
from overtone.units import format_quantity, parse_quantity

# Every quantity of a file in `probes/`; what is nominal is from the maker, what is assumed is not.
_UNITS = {
    "stiffness": "N/m",
    "frequency": "Hz",
    "quality_factor": "1",
    "radius": "m",
    "length": "m",
    "width": "m",
    "thickness": "m",
    "tip_setback": "m",
    "tip_mass": "1",
}
_MEASURABLE = ("stiffness", "frequency", "quality_factor", "radius")


@dataclass(frozen=True)
class _Sheet:
    """What the file of one probe says, in SI units."""

    name: str
    rectangular: bool
    values: Mapping[str, float]
    stiffness_range: tuple[float, float]

    @classmethod
    def read(cls, text: str) -> _Sheet:
        table = tomllib.loads(text)
        given: dict[str, Any] = table["assumed"] | table["nominal"]
        low, high = (parse_quantity(end, "N/m") for end in given["stiffness_range"])
        return cls(
            name=table["name"],
            rectangular=table["shape"] == "rectangular",
            values={name: parse_quantity(given[name], unit, name) for name, unit in _UNITS.items()},
            stiffness_range=(low, high),
        )


def presets() -> tuple[str, ...]:
    """Return the names of the probes that `preset` knows.

    Examples
    --------
    >>> [name for name in presets() if name.startswith("PPP")]
    ['PPP-FMR', 'PPP-NCHR', 'PPP-NCLR']
    """
    return tuple(sorted(sheet.name for sheet in _sheets().values()))


def preset(
    name: str,
    *,
    free_amplitude: float,
    stiffness: float | None = None,
    frequency: float | None = None,
    quality_factor: float | None = None,
    radius: float | None = None,
    drive_frequency: float | None = None,
    tip_position: float | None = None,
    tip_mass: float | None = None,
    spot_position: float | None = None,
    higher_frequencies: Sequence[float] | None = None,
) -> Probe:
    """Return a common probe on an optical lever, with the modes of a beam.

    Parameters
    ----------
    name : str
        One of `presets`; case and punctuation do not matter.
    free_amplitude : float
        Amplitude far from the sample [m].
    stiffness, frequency, quality_factor, radius : float, optional
        What was measured: k_1 at the tip [N/m], f_1 [Hz], Q_1 and the radius of the tip [m]. What
        is not given is nominal, or typical of air, and a warning says so.
    drive_frequency : float, optional
        Drive frequency [Hz]; the resonance unless given.
    tip_position, tip_mass, spot_position, higher_frequencies : optional
        As in `overtone.beam.beam_modes`; the spot is at the tip unless given. With measured higher
        frequencies [Hz] the probe has those modes, and three of the beam without.

    Returns
    -------
    Probe
        With a detector of kind ``slope`` and a silicon tip.

    Warns
    -----
    UncalibratedWarning
        If a measurable value is nominal, or if the lever is not the beam its modes are taken from.
    ResonanceWarning
        If the second mode lies at six times the first.

    Raises
    ------
    ProbeError
        If there is no probe of this name, or if a value is out of range.

    Examples
    --------
    >>> probe = preset("PPP-NCHR", free_amplitude=40e-9, stiffness=36.1, frequency=312.4e3,
    ...                quality_factor=431, radius=8e-9)
    >>> probe.detector.kind, len(probe.cantilever.modes), probe.drive_ratio
    ('slope', 3, 1.0)
    """
    sheet = _find(name)
    measured = {
        "stiffness": stiffness,
        "frequency": frequency,
        "quality_factor": quality_factor,
        "radius": radius,
    }
    _warn_of_nominal_values(sheet, measured)
    value = dict(sheet.values) | {key: given for key, given in measured.items() if given is not None}
    lever = beam_modes(
        stiffness=value["stiffness"],
        frequency=value["frequency"],
        quality_factor=value["quality_factor"],
        tip_position=1.0 - value["tip_setback"] / value["length"] if tip_position is None else tip_position,
        tip_mass=value["tip_mass"] if tip_mass is None else tip_mass,
        spot_position=spot_position,
        count=3 if higher_frequencies is None else 1 + len(higher_frequencies),
        higher_frequencies=higher_frequencies,
    )
    return Probe(
        cantilever=lever,
        drive=Drive(value["frequency"] if drive_frequency is None else drive_frequency, free_amplitude),
        tip=Tip(value["radius"]),
        detector=Detector(SLOPE),
    )


@functools.cache
def _sheets() -> dict[str, _Sheet]:
    """Return every sheet by the letters and digits of its name."""
    folder = resources.files("overtone") / "probes"
    files = [file for file in folder.iterdir() if file.name.endswith(".toml")]
    sheets = [_Sheet.read(file.read_text(encoding="utf-8")) for file in files]
    return {_letters(sheet.name): sheet for sheet in sheets}


def _letters(name: str) -> str:
    return "".join(character for character in name.casefold() if character.isalnum())


def _find(name: str) -> _Sheet:
    sheet = _sheets().get(_letters(name))
    if sheet is None:
        near = difflib.get_close_matches(_letters(name), _sheets(), n=3)
        raise ProbeError(
            f"no preset {name!r}",
            expected=f"one of {', '.join(presets())}",
            hint=" or ".join(_sheets()[match].name for match in near) or "Probe.simple, or a probe file",
        )
    return sheet


def _warn_of_nominal_values(sheet: _Sheet, measured: Mapping[str, float | None]) -> None:
    low, high = (format_quantity(end, "N/m") for end in sheet.stiffness_range)
    notes = {"stiffness": f" (the maker allows {low} to {high})", "quality_factor": " (typical of air)"}
    nominal = [
        f"{name.replace('_', ' ')} {format_quantity(sheet.values[name], _UNITS[name])}{notes.get(name, '')}"
        for name in _MEASURABLE
        if measured[name] is None
    ]
    if nominal:
        warnings.warn(
            f"{sheet.name}: {', '.join(nominal)} {'is' if len(nominal) == 1 else 'are'} nominal, not of "
            f"your probe. Measure, and give preset() what you measured",
            UncalibratedWarning,
            stacklevel=3,
        )
    if not sheet.rectangular:
        warnings.warn(
            f"{sheet.name}: the lever narrows towards its tip, and its modes are taken from a uniform beam. "
            "Take the gains of A0 and of the higher harmonics from a reference sample: A2 may be off by a factor of 2",
            UncalibratedWarning,
            stacklevel=3,
        )
