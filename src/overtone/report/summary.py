"""Tables that sum a result up: energies and calibrations here, properties by their method in modules of their own."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import xarray as xr

from overtone.harmonics import ATTRACTIVE, REPULSIVE, UNDETERMINED
from overtone.instrument.calibration import Calibration, summary_rows
from overtone.instrument.correct import calibration_of
from overtone.instrument.gates import GATE, Gate
from overtone.instrument.unknowns import UNKNOWNS
from overtone.report.content import Report, Table
from overtone.report.materials import materials_table
from overtone.report.numbers import median_of, percent, range_of
from overtone.report.property_tables import property_table
from overtone.report.results import is_pooled
from overtone.report.truth_tables import truth_materials_table, truth_properties_table, truth_table
from overtone.report.validity import validity_tables
from overtone.units import format_quantity

__all__ = [
    "calibration_tables",
    "energy_table",
    "gate_table",
    "property_table",
    "regime_shares",
    "result_tables",
    "truth_materials_table",
    "truth_properties_table",
    "truth_table",
    "unknown_table",
    "validity_tables",
]

_TIGHTEST = 3
_UNITS = {unknown.name: unknown.unit for unknown in UNKNOWNS}


def result_tables(label: str, result: xr.Dataset) -> list[Table]:
    """Return the tables of one inversion: its materials where it has some, and its pixels."""
    return [*([materials_table(result)] if is_pooled(result) else []), property_table(label, result)]


def energy_table(energies: xr.Dataset, others: Sequence[xr.Dataset] = ()) -> Table:
    """Return forces, energies and regime of a scan in numbers, with their means in other readings of it."""
    first = energies.sel(harmonic=1)
    rows = []
    arrays = [
        ("F1_cons", first["F_cons"], "N"),
        ("F1_diss", first["F_diss"], "N"),
        ("energy dissipated per cycle", energies["dissipation"], "J"),
        ("virial", energies["virial"], "J"),
    ]
    for label, array, unit in arrays:
        values = np.asarray(array.values).ravel()
        finite = values[np.isfinite(values)]
        mean = format_quantity(float(finite.mean()), unit) if finite.size else "-"
        row = [label, mean, median_of(values, unit), range_of(values, unit, 5, 95)]
        if others:
            row.append(range_of(np.array([_mean(other, label) for other in others]), unit, 0, 100))
        rows.append(tuple(row))
    shares = regime_shares(energies)
    attractive = float((first["F_cons"] > 0).mean())
    return Table(
        "Forces, energy and regime",
        (
            "quantity",
            "mean",
            "median",
            "5 .. 95 % of pixels",
            *(["mean in other readings"] if others else []),
        ),
        tuple(rows),
        note="Regime by the sign of F1_cons: "
        + ", ".join(f"{name} {percent(share)}" for name, share in shares.items())
        + f". With the probe in use alone {percent(attractive)} would be attractive; undetermined is what noise "
        "or another reading of the same file turns round.",
    )


def _mean(energies: xr.Dataset, label: str) -> float:
    first = energies.sel(harmonic=1)
    arrays = {"F1_cons": first["F_cons"], "F1_diss": first["F_diss"], "virial": energies["virial"]}
    return float(arrays.get(label, energies["dissipation"]).mean())


def regime_shares(energies: xr.Dataset) -> dict[str, float]:
    """Return the share of pixels in each regime."""
    codes = {"attractive": ATTRACTIVE, "undetermined": UNDETERMINED, "repulsive": REPULSIVE}
    return {name: float((energies["regime"] == code).mean()) for name, code in codes.items()}


def calibration_tables(report: Report) -> tuple[Table, ...]:
    """Return the unknowns of the calibration of a report and what it supports; nothing where it has none."""
    if report.calibration is None:
        return ()
    left = calibration_of(report.observables)
    tables = [unknown_table(report.calibration.calibration, left)]
    if report.calibration.gates:
        tables.append(gate_table(report.calibration.gates, left or report.calibration.calibration))
    return tuple(tables)


def unknown_table(calibration: Calibration, left: Calibration | None = None) -> Table:
    """Return what was learnt of an instrument, and what of it was applied to a scan.

    Parameters
    ----------
    calibration : Calibration
        As it was made.
    left : Calibration, optional
        That of the corrected scan (`overtone.calibration_of`), which has drifted, and was anchored.
    """
    material = calibration.reference.name if calibration.reference is not None else ""
    note = (
        f"A_ref is {format_quantity(calibration.amplitude, 'm', 4)}. Errors are standard deviations, correlated with "
        "each other: the whole covariance is in the calibration."
    )
    if not material:
        note += " Without a reference gains and latency are not known."
    columns: tuple[str, ...] = ("unknown", f"calibrated on {material}" if material else "calibrated", "error")
    rows: tuple[tuple[str, ...], ...] = tuple(summary_rows(calibration))
    if left is not None:
        columns = (*columns, "applied to the scan", "error left")
        applied = {label: (value, error) for label, value, error in summary_rows(left)}
        known = {label: (value, error) for label, value, error in summary_rows(calibration)}
        rows = tuple(
            (label, *known.get(label, ("-", "-")), *applied.get(label, ("-", "-")))
            for label in dict.fromkeys([*known, *applied])
        )
        note += (
            " Between calibration and scan zeros, phase and drive drift, which widens their errors; reference and lift "
            "pass narrow them again. Stiffness, Q, free amplitude and radius were put into the probe of the scan, from "
            "which their rest is counted."
        )
    return Table("The instrument", columns, rows, note)


def gate_table(gates: Sequence[Gate], calibration: Calibration) -> Table:
    """Return what a calibration supports, material by material, and which unknowns stand in the way.

    Parameters
    ----------
    gates : sequence of Gate
        From `overtone.gates`.
    calibration : Calibration
        The one they were asked of: its errors say which tolerance is the tightest.
    """
    rows = []
    for gate in gates:
        worst = sorted(gate.tolerance, key=lambda name: -calibration.error(name) / gate.tolerance[name])
        limits = (
            f"{name.replace('_', ' ')} to {_amount(gate.tolerance[name], name)} "
            f"(is {_amount(calibration.error(name), name)})"
            for name in worst[:_TIGHTEST]
            if math.isfinite(gate.tolerance[name])
        )
        rows.append(
            (
                gate.material,
                format_quantity(gate.modulus, "Pa"),
                f"{gate.setpoint:.3g}",
                gate.verdict,
                _log_error(gate.absolute_error),
                _log_error(gate.relative_error),
                "; ".join(limits),
            )
        )
    return Table(
        "What the calibration supports",
        (
            "material",
            "modulus",
            "A1/A1far",
            "supported",
            "error of ln E",
            "of its ratio",
            "tightest tolerances",
        ),
        tuple(rows),
        note="absolute: a modulus. relative: its ratio to the reference in the scan. contrast: neither. The limit is "
        f"an error of ln E of {GATE:g} from what all pixels share, which no averaging lessens; far beyond 1 its size "
        "says only that nothing is determined. Tolerances: what an unknown alone would have to be known to for a "
        "modulus, and is known to, in the three that are worst.",
    )


def _amount(value: float, name: str) -> str:
    """Write an amount of an unknown; gains and factors in percent."""
    unit = _UNITS[name]
    if unit != "1" or name.startswith("A0_slope"):
        return format_quantity(value, unit, 3)
    return f"{100.0 * value:.3g} %"


def _log_error(error: float) -> str:
    """Write an error of ln E, which may be absent, or beyond all meaning."""
    if math.isnan(error):
        return "-"
    return f"{error:.2g}" if error < 10.0 else f"{error:.0f}"
