"""What is known of how a result was made, from the attributes and the history that its datasets carry."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import PurePath
from typing import Any

import numpy as np
import xarray as xr

from overtone import provenance
from overtone._version import __version__
from overtone.instrument.calibration import Calibration
from overtone.instrument.correct import calibration_of
from overtone.instrument.unknowns import LEVER, UNKNOWNS
from overtone.probe import Probe, parse_probe
from overtone.quantities import harmonic_orders, quantity
from overtone.readings import reading_of
from overtone.report.content import Table
from overtone.units import format_quantity

_UNIT = {unknown.name: unknown.unit for unknown in UNKNOWNS}
_MEANING = {unknown.name: unknown.meaning for unknown in UNKNOWNS}
_ERROR_LEFT = "error left"
_KNOWN = ("probe", "noise", "noise_stated", "priors", "shared_priors", "harmonics", "dissipative_harmonics")


@dataclass(frozen=True)
class Facts:
    """How a result was made, as far as it says.

    Parameters
    ----------
    pixels : tuple of int
        (y, x).
    area : tuple of float or None
        Width and height of the scan [m].
    orders : tuple of int
        Harmonics that were recorded, 0 for the mean deflection.
    probe : Probe or None
        Lever, drive, tip.
    setpoint : float
        Median of A1 over the free amplitude, NaN where that is not known.
    arguments : mapping
        What `overtone.map_properties` was called with, from the history.
    version : str
        The overtone that inverted.
    calibration : Calibration or None
        What the scan was corrected with, and the covariance that is left.
    sources : tuple of str
        Names of the files that were read.
    attributes : mapping
        Attributes of the result.
    """

    pixels: tuple[int, int]
    area: tuple[float, float] | None
    orders: tuple[int, ...]
    probe: Probe | None
    setpoint: float
    arguments: Mapping[str, Any]
    version: str
    calibration: Calibration | None
    sources: tuple[str, ...]
    attributes: Mapping[str, Any] = field(default_factory=dict)

    def argument(self, name: str) -> Any:
        """Return what the inversion was called with, or what the result says of it, None where neither is known."""
        return self.arguments.get(name, self.attributes.get(name))

    @property
    def priors(self) -> list[str]:
        """What was known of each property of a material before: of one that pixels share, where they do."""
        text = self.argument("shared_priors") or self.argument("priors") or ""
        return [part.strip() for part in str(text).split(";") if part.strip()]


def facts_of(observables: xr.Dataset, result: xr.Dataset) -> Facts:
    """Return what observables and result say of how they were made.

    Raises
    ------
    OvertoneError
        If a probe or a calibration among the attributes is damaged.
    """
    entries = [entry for entry in provenance.history(result) if isinstance(entry, dict)]
    last = next((e for e in reversed(entries) if e.get("operation") == "map_properties"), {})
    arguments = last.get("arguments", {})
    arguments = arguments if isinstance(arguments, dict) else {}
    reading = reading_of(observables)
    probe = reading.probe if reading is not None else None
    if probe is None and isinstance(arguments.get("probe"), str):
        probe = parse_probe(arguments["probe"], "the probe in the history of the result")
    status = result["status"]
    amplitude = observables["A1"].values
    known = amplitude[np.isfinite(amplitude)]
    return Facts(
        pixels=(status.sizes["y"], status.sizes["x"]),
        area=_area(status),
        orders=harmonic_orders(observables),
        probe=probe,
        setpoint=float(np.median(known)) / probe.drive.free_amplitude
        if probe is not None and known.size
        else math.nan,
        arguments=arguments,
        version=str(last.get("overtone", __version__)),
        calibration=calibration_of(observables) or calibration_of(result),
        sources=_sources(entries or provenance.history(observables)),
        attributes=dict(result.attrs),
    )


def _area(array: xr.DataArray) -> tuple[float, float] | None:
    sides = []
    for dim in ("x", "y"):
        if dim not in array.coords or array.sizes[dim] < 2:
            return None
        values = np.asarray(array.coords[dim].values, dtype=float)
        sides.append(abs(float(values[-1] - values[0])) * values.size / (values.size - 1))
    return sides[0], sides[1]


def _sources(entries: list[dict[str, Any]]) -> tuple[str, ...]:
    """Return the names of the files of a history, without the folders they lay in."""
    paths = [
        str(entry["arguments"]["path"])
        for entry in entries
        if isinstance(entry.get("arguments"), dict) and "path" in entry["arguments"]
    ]
    return tuple(dict.fromkeys(PurePath(path.replace("\\", "/")).name for path in paths))


# --- as tables ------------------------------------------------------------------------------------


Row = tuple[str, float | str, str]
"""What it is, its value, and its SI unit; a text has none."""


def metadata_rows(facts: Facts) -> tuple[Row, ...]:
    """Return everything that is known of how a result was made, numbers in SI units."""
    rows: list[Row] = [("file", name, "") for name in facts.sources]
    rows += [("pixels along x", facts.pixels[1], "1"), ("pixels along y", facts.pixels[0], "1")]
    if facts.area is not None:
        rows += [("width of the scan", facts.area[0], "m"), ("height of the scan", facts.area[1], "m")]
    rows.append(("harmonics recorded", _listed(facts.orders), ""))
    rows += _of_the_probe(facts)
    rows += _of_the_inversion(facts)
    rows += _of_the_calibration(facts.calibration)
    for name in ("phase_note", "verdict", "verdict_reason", "cannot_conclude"):
        if facts.attributes.get(name):
            rows.append((name.replace("_", " "), str(facts.attributes[name]), ""))
    rows.append(("overtone", facts.version, ""))
    return tuple(rows)


def metadata_table(rows: tuple[Row, ...]) -> Table:
    """Return the same for people, with readable units, without the errors that the table of the instrument tells."""
    cells = tuple(
        (name, value if isinstance(value, str) else format_quantity(float(value), unit, 6))
        for name, value, unit in rows
        if not name.startswith(_ERROR_LEFT)
    )
    return Table("How the results were made", ("what", "value"), cells)


def metadata_cells(rows: tuple[Row, ...]) -> Table:
    """Return the same for programs: numbers in SI units that read back as the same ones."""
    cells = tuple(
        (name, value if isinstance(value, str) else repr(value), unit or "") for name, value, unit in rows
    )
    return Table("", ("what", "value", "unit"), cells)


def _of_the_probe(facts: Facts) -> list[Row]:
    probe = facts.probe
    if probe is None:
        return [("probe", "not recorded", "")]
    rows: list[Row] = []
    for n, mode in enumerate(probe.cantilever.modes, start=1):
        rows += [
            (f"stiffness of mode {n}", mode.stiffness, "N/m"),
            (f"resonance of mode {n}", mode.frequency, "Hz"),
            (f"quality factor of mode {n}", mode.quality_factor, "1"),
        ]
    tip = probe.tip
    rows.append(
        ("tip radius", tip.radius if tip.radius is not None else "not recorded", "m" if tip.radius else "")
    )
    rows += [
        ("modulus of the tip", tip.modulus, "Pa"),
        ("Poisson's ratio of the tip", tip.poisson_ratio, "1"),
        ("drive frequency", probe.drive.frequency, "Hz"),
        ("free amplitude", probe.drive.free_amplitude, "m"),
    ]
    if math.isfinite(facts.setpoint):
        rows.append(("set-point A1/A1far, median", facts.setpoint, "1"))
    return rows


def _of_the_inversion(facts: Facts) -> list[Row]:
    rows: list[Row] = []
    for name in ("model", "method"):
        value = facts.argument(name)
        rows.append((name, "not recorded" if value is None else str(value), ""))
    for name in ("harmonics", "dissipative_harmonics"):
        if facts.argument(name):
            rows.append((f"{name.replace('_', ' ')} inverted", _listed(facts.argument(name)), ""))
    noise = facts.argument("noise")
    if isinstance(noise, Mapping):
        for name, value in noise.items():
            record = quantity(str(name))
            rows.append((f"noise of {name}", float(value), record.unit if record else "1"))
    rows += [("prior", part, "") for part in facts.priors]
    for name, value in facts.arguments.items():
        if name in _KNOWN or name in ("model", "method") or value is None:
            continue
        unit = {"intermolecular_distance": "m", "half_angle": "rad", "thickness": "m"}.get(name, "1")
        what = "Poisson's ratio of the sample" if name == "poisson_ratio" else name.replace("_", " ")
        if isinstance(value, int | float) and not isinstance(value, bool):
            rows.append((what, value, unit))
        else:
            rows.append((what, value if isinstance(value, str) else json.dumps(value, default=str), ""))
    return rows


def _of_the_calibration(calibration: Calibration | None) -> list[Row]:
    if calibration is None:
        return [("calibration", "none: the scan was not corrected", "")]
    rows: list[Row] = [("calibration", calibration.source or "not named", "")]
    known = calibration.reference
    if known is not None:
        rows.append(("reference of the calibration", known.name, ""))
        rows.append(("Poisson's ratio of the reference", known.poisson_ratio, "1"))
        for name, (median, error) in known.properties.items():
            record = quantity(name)
            rows.append((f"{name} of the reference", median, record.unit if record else "1"))
            rows.append((f"error of ln of {name} of the reference", error, "1"))
    rows += [(f"{_ERROR_LEFT}, {meaning}", error, unit) for meaning, error, unit in errors_left(calibration)]
    return rows


def errors_left(calibration: Calibration) -> list[tuple[str, float, str]]:
    """Return meaning, standard deviation and unit of every unknown that a calibration leaves uncertain."""
    return [
        (_MEANING[name], calibration.error(name), _UNIT[name])
        for name in sorted(calibration.names, key=lambda name: (name in LEVER, calibration.names.index(name)))
        if calibration.error(name) > 0.0
    ]


def _listed(values: Any) -> str:
    return ", ".join(str(value) for value in (values if isinstance(values, list | tuple) else (values,)))
