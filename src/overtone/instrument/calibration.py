"""What was learnt of an instrument: values with their joint covariance, kept as TOML or JSON."""

from __future__ import annotations

import json
import math
import tomllib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import tomli_w

from overtone._version import __version__
from overtone.errors import CalibrationError, OvertoneError
from overtone.instrument.unknowns import HIGHER, LEVER, NAMES, NEUTRAL, UNKNOWNS
from overtone.io.atomic import atomic_path
from overtone.probe import Probe, format_probe, parse_probe
from overtone.units import display_unit, format_quantity, parse_quantity

_Floats = npt.NDArray[np.float64]

_FORMAT = 1
_UNIT = {unknown.name: unknown.unit for unknown in UNKNOWNS}
_NOISE_UNIT = {"phi1": "rad"}
_COLUMNS = ("A1", "phi1", "A0", *(f"e{n}_{part}" for n in HIGHER for part in ("re", "im")))
_ROUNDING = 1e-6  # of a correlation: what decimals in a file may cost


@dataclass(frozen=True)
class ReferenceMaterial:
    """The reference as the approach curve and what was known before leave it.

    Parameters
    ----------
    name, model : str
        What it is called, and its contact model.
    poisson_ratio : float
        As stated.
    properties : mapping of str to (float, float)
        Property to its median [SI] and the standard deviation of its logarithm.
    stated : tuple of str
        Properties that were known beforehand.
    """

    name: str
    model: str
    poisson_ratio: float
    properties: Mapping[str, tuple[float, float]]
    stated: tuple[str, ...] = ()


@dataclass(frozen=True)
class Calibration:
    """What was learnt of an instrument, for the scans taken with it.

    Parameters
    ----------
    probe : Probe
        The lever near the surface, before the factors among the values.
    amplitude : float
        A_ref [m], at which distortions are quoted and lengths are true.
    values : mapping
        Every unknown of `overtone.instrument.unknowns.UNKNOWNS` [SI].
    names : tuple of str
        Unknowns in the covariance.
    covariance : array (name, name)
        Joint covariance [SI].
    noise : mapping
        Scatter of each observable in the data it came from [m, rad].
    reference : ReferenceMaterial, optional
        Without one gains and latency are not known.
    curve : mapping of str to array (point,)
        Corrected approach curve on it: ``A1``, ``phi1``, and in the frame of the first harmonic what the reference
        gives there, ``A0``, ``e2_re``, ``e2_im``, ``e3_re``, ``e3_im`` [m, rad].
    findings : tuple of str
        What was assumed, and what could not be told.
    source : str
        Where it came from.
    """

    probe: Probe
    amplitude: float
    values: Mapping[str, float]
    names: tuple[str, ...]
    covariance: _Floats
    noise: Mapping[str, float] = field(default_factory=dict)
    reference: ReferenceMaterial | None = None
    curve: Mapping[str, _Floats] = field(default_factory=dict)
    findings: tuple[str, ...] = ()
    source: str = ""

    def error(self, name: str) -> float:
        """Return the standard deviation of an unknown, 0 for one that is not in the covariance."""
        if name not in self.names:
            return 0.0
        index = self.names.index(name)
        return math.sqrt(float(self.covariance[index, index]))


def save_calibration(calibration: Calibration, path: str | Path) -> None:
    """Write a calibration, as TOML with units or, where the name ends in .json, as JSON of the same content.

    Raises
    ------
    FileFormatError
        If the file cannot be written.
    """
    table = _table(calibration)
    with atomic_path(path) as temporary:
        text = json.dumps(table, indent=1) if Path(path).suffix.lower() == ".json" else tomli_w.dumps(table)
        temporary.write_text(text, encoding="utf-8")


def load_calibration(path: str | Path) -> Calibration:
    """Read a calibration that `save_calibration` wrote.

    Raises
    ------
    CalibrationError
        If the file is missing or is no calibration; what is wrong is named.
    """
    source = Path(path)
    try:
        text = source.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise CalibrationError(
            f"cannot read the calibration {source}", got=str(error), hint="check the path"
        ) from error
    return parse_calibration(text, source.name)


def parse_calibration(text: str, source: str = "calibration") -> Calibration:
    """Read a calibration from text, TOML or JSON.

    Raises
    ------
    CalibrationError
        If it is no calibration; what is wrong is named.
    """
    try:
        table = json.loads(text) if text.lstrip().startswith("{") else tomllib.loads(text)
    except ValueError as error:
        raise CalibrationError(f"{source} is neither TOML nor JSON", got=str(error)) from error
    try:
        return _record(table)
    except (KeyError, TypeError, ValueError, AttributeError, OvertoneError) as error:
        got = f"no {error}" if isinstance(error, KeyError) else str(error)
        raise CalibrationError(
            f"{source} is no calibration, or damaged",
            expected="a file that overtone calibrate wrote",
            got=got,
            hint="overtone calibrate",
        ) from error


def format_calibration(calibration: Calibration) -> str:
    """Return a calibration as JSON in one line, as datasets carry it."""
    return json.dumps(_table(calibration))


def _quantity(value: float, unit: str) -> str | float:
    """Write a value with a unit that reads well and 9 digits, which is more than any of them means."""
    if unit == "1":
        return float(f"{value:.9g}")
    display = display_unit(value, unit)
    return f"{value * display.factor:.9g} {display.label}"


def _table(calibration: Calibration) -> dict[str, Any]:
    c = calibration
    spread = np.sqrt(np.diag(c.covariance))
    scale = np.where(spread > 0.0, spread, 1.0)
    correlation = c.covariance / np.outer(scale, scale)
    table: dict[str, Any] = {
        "calibration": {
            "format": _FORMAT,
            "overtone": __version__,
            "source": c.source,
            "amplitude": _quantity(c.amplitude, "m"),
            "findings": list(c.findings),
        },
        "probe": tomllib.loads(format_probe(c.probe)),
        "values": {name: _quantity(c.values[name], _UNIT[name]) for name in NAMES},
        "noise": {name: _quantity(value, _NOISE_UNIT.get(name, "m")) for name, value in c.noise.items()},
    }
    if c.reference is not None:
        r = c.reference
        table["reference"] = {
            "name": r.name,
            "model": r.model,
            "poisson_ratio": r.poisson_ratio,
            "stated": list(r.stated),
            "properties": {
                name: {"median": _quantity(value, _property_unit(name)), "log_error": float(f"{error:.6g}")}
                for name, (value, error) in r.properties.items()
            },
        }
    table["covariance"] = {
        "names": list(c.names),
        "errors": [_quantity(float(s), _UNIT[name]) for name, s in zip(c.names, spread, strict=True)],
        # one row a line of a triangle: the whole is symmetric
        "correlations": [[float(f"{v:.12g}") for v in row[: i + 1]] for i, row in enumerate(correlation)],
    }
    if c.curve:
        table["curve"] = {name: [float(f"{v:.9g}") for v in values] for name, values in c.curve.items()}
    return table


def _property_unit(name: str) -> str:
    return {"modulus": "Pa", "adhesion": "N", "viscosity": "Pa s", "stiffness": "N/m"}.get(name, "1")


def _record(table: Mapping[str, Any]) -> Calibration:
    for section in ("calibration", "probe", "values", "covariance"):
        if not isinstance(table.get(section), Mapping):
            raise ValueError(f"no section [{section}]")
    head = table["calibration"]
    if head["format"] != _FORMAT:
        raise ValueError(f"format {head['format']!r}, where this version reads {_FORMAT}")
    _refuse_strangers("values", table["values"], NAMES)
    values = {name: parse_quantity(table["values"][name], _UNIT[name], name) for name in NAMES}
    names, covariance = _covariance(table["covariance"])
    amplitude = parse_quantity(head["amplitude"], "m", "amplitude")
    noise = {n: parse_quantity(v, _NOISE_UNIT.get(n, "m"), n) for n, v in table.get("noise", {}).items()}
    curve = _curve(table.get("curve", {}))
    _require_finite("values", list(values.values()))
    _require_finite("noise", list(noise.values()))
    if not 0.0 < amplitude < math.inf or any(value < 0.0 for value in noise.values()):
        raise ValueError("an amplitude or a noise below zero")
    return Calibration(
        probe=parse_probe(tomli_w.dumps(table["probe"]), "the probe of the calibration"),
        amplitude=amplitude,
        values=values,
        names=names,
        covariance=covariance,
        noise=noise,
        reference=_reference(table["reference"]) if "reference" in table else None,
        curve=curve,
        findings=tuple(map(str, head["findings"])),
        source=str(head["source"]),
    )


def _refuse_strangers(part: str, found: Iterable[str], known: Iterable[str]) -> None:
    strangers = sorted(set(found) - set(known))
    if strangers:
        raise ValueError(f"unknown names in the {part}: {', '.join(strangers)}")


def _require_finite(part: str, numbers: Any) -> None:
    if not np.isfinite(np.asarray(numbers, dtype=float)).all():
        raise ValueError(f"numbers in the {part} that are not finite")


def _covariance(part: Mapping[str, Any]) -> tuple[tuple[str, ...], _Floats]:
    """Return names and covariance of a table of errors and correlations."""
    names = tuple(part["names"])
    _refuse_strangers("covariance", names, NAMES)
    if len(set(names)) < len(names):
        raise ValueError("a name that stands twice in the covariance")
    if len(part["errors"]) != len(names):
        raise ValueError("errors that are not one for each name in the covariance")
    errors = np.array([parse_quantity(e, _UNIT[n], n) for e, n in zip(part["errors"], names, strict=True)])
    rows = part["correlations"]
    if [len(row) for row in rows] != list(range(1, len(names) + 1)):
        raise ValueError("correlations that are not a triangle of all names")
    correlation = np.eye(len(names))
    for i, row in enumerate(rows):
        correlation[i, : i + 1] = correlation[: i + 1, i] = row
    _require_finite("covariance", np.concatenate([errors, correlation.ravel()]))
    if (errors < 0.0).any():
        raise ValueError("negative errors in the covariance")
    if (np.abs(np.diag(correlation) - 1.0)[errors > 0.0] > _ROUNDING).any():
        raise ValueError("an unknown whose correlation with itself is not 1")
    if names and np.linalg.eigvalsh(correlation)[0] < -_ROUNDING * len(names):
        raise ValueError("a covariance that is not one: it has a negative eigenvalue")
    return names, correlation * np.outer(errors, errors)


def _reference(r: Mapping[str, Any]) -> ReferenceMaterial:
    properties = {
        name: (parse_quantity(p["median"], _property_unit(name), name), float(p["log_error"]))
        for name, p in r["properties"].items()
    }
    _require_finite(
        "reference", [float(r["poisson_ratio"]), *(x for pair in properties.values() for x in pair)]
    )
    return ReferenceMaterial(
        str(r["name"]), str(r["model"]), float(r["poisson_ratio"]), properties, tuple(r["stated"])
    )


def _curve(table: Mapping[str, Any]) -> dict[str, _Floats]:
    """Return the columns of a corrected curve."""
    _refuse_strangers("curve", table, _COLUMNS)
    curve = {name: np.array(column, dtype=float) for name, column in table.items()}
    if curve and ({"A1", "phi1"} - set(curve) or len({column.shape for column in curve.values()}) > 1):
        raise ValueError("a curve without A1 or phi1, or with columns of other lengths")
    for name, column in curve.items():
        _require_finite(f"column {name} of the curve", column)
    return curve


def summary_rows(calibration: Calibration) -> list[tuple[str, str, str]]:
    """Return name, value and standard error of what was learnt, for people: phasors as amplitude and phase.

    Higher powers of a distortion, and unknowns that are as they were assumed, are left to the file.
    """
    c = calibration
    rows: list[tuple[str, str, str]] = []

    def scalar(name: str, label: str) -> None:
        error = c.error(name)
        if error > 0.0 or c.values[name] != NEUTRAL[name]:
            relative = _UNIT[name] == "1" and not name.startswith("A0_slope")
            value = (
                f"{c.values[name]:.4g}"
                if _UNIT[name] == "1"
                else format_quantity(c.values[name], _UNIT[name], 4)
            )
            spread = f"{100.0 * error:.2g} %" if relative else format_quantity(error, _UNIT[name], 3)
            rows.append((label, value, spread if _UNIT[name] != "1" or relative else f"{error:.2g}"))

    def phasor(prefix: str, label: str) -> None:
        value = complex(c.values[f"{prefix}_re"], c.values[f"{prefix}_im"])
        error = math.hypot(c.error(f"{prefix}_re"), c.error(f"{prefix}_im")) / math.sqrt(2.0)
        if value != 0.0 or error > 0.0:
            angle = math.degrees(math.atan2(value.imag, value.real))
            text = f"{format_quantity(abs(value), 'm', 3)} at {angle:.0f} deg"
            rows.append((label, text, format_quantity(error, "m", 3)))

    scalar("phi1_offset", "phi1: zero")
    scalar("A0_offset", "A0: zero")
    for axis in "zxy":
        scalar(f"A0_slope_{axis}", f"A0: slope along {axis}")
    scalar("distortion0_0", "A0: added by the detector at A_ref")
    scalar("gain0", "A0: gain")
    scalar("compression", "A1: lost in the detector at A_ref")
    for n in HIGHER:
        phasor(f"distortion{n}_0", f"A{n}: added by the detector at A_ref")
        phasor(f"crosstalk{n}", f"A{n}: crosstalk")
        if f"gain{n}" in c.names:
            scalar(f"gain{n}", f"A{n}: gain")
            scalar(f"latency{n}", f"A{n}: latency")
    for name in LEVER:
        scalar(name, f"{name.replace('_', ' ')}, over that of the probe")
    return rows


def joint(
    names: Sequence[str], blocks: Mapping[str, float], covariance: _Floats
) -> tuple[tuple[str, ...], _Floats]:
    """Return a covariance with further, independent unknowns (name to standard deviation) behind the others."""
    more = [name for name in blocks if name not in names]
    size = len(names) + len(more)
    result = np.zeros((size, size))
    result[: len(names), : len(names)] = covariance
    for i, name in enumerate(more):
        result[len(names) + i, len(names) + i] = blocks[name] ** 2
    return (*names, *more), result
