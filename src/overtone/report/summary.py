"""Tables that sum a result up."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np
import numpy.typing as npt
import xarray as xr

from overtone.harmonics import ATTRACTIVE, REPULSIVE, UNDETERMINED
from overtone.instrument.calibration import Calibration, summary_rows
from overtone.instrument.correct import calibration_of
from overtone.instrument.gates import GATE, Gate
from overtone.instrument.unknowns import UNKNOWNS
from overtone.inversion.properties import DETERMINED, POOR_RESIDUAL
from overtone.quantities import quantity
from overtone.report.content import Report, Table
from overtone.units import display_unit, format_quantity

_MAJORITY = 0.5
_FEW = 0.1  # share of determined pixels below which they are the outliers of the noise
_TIGHTEST = 3
_UNITS = {unknown.name: unknown.unit for unknown in UNKNOWNS}


def _range(values: npt.NDArray[np.float64], unit: str, low: float, high: float) -> str:
    """Return two percentiles with one unit between them."""
    values = values[np.isfinite(values)]
    if values.size == 0:
        return "-"
    ends = np.percentile(values, [low, high])
    display = display_unit(float(np.abs(ends).max()), unit)
    return f"{ends[0] * display.factor:.3g} .. {ends[1] * display.factor:.3g} {display.label}".strip()


def _median(values: npt.NDArray[np.float64], unit: str) -> str:
    values = values[np.isfinite(values)]
    return format_quantity(float(np.median(values)), unit) if values.size else "-"


def _percent(share: float) -> str:
    return f"{100 * share:.0f} %" if share == 0.0 or share >= 0.01 else f"{100 * share:.1f} %"


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
        row = [label, mean, _median(values, unit), _range(values, unit, 5, 95)]
        if others:
            row.append(_range(np.array([_mean(other, label) for other in others]), unit, 0, 100))
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
        + ", ".join(f"{name} {_percent(share)}" for name, share in shares.items())
        + f". With the probe in use alone {_percent(attractive)} would be attractive; undetermined is what noise "
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


def property_table(label: str, result: xr.Dataset) -> Table:
    """Return the properties of a scan where they are determined, and what the estimator gave elsewhere."""
    determined = float((result["status"] == DETERMINED).mean())
    quoted = determined >= _FEW
    rows = []
    for name in ("modulus", "adhesion", "indentation"):
        if name not in result:
            continue
        record = quantity(name)
        unit = record.unit if record else "1"
        kept = result[name].values.ravel() if quoted else np.empty(0)
        every = result[f"{name}_unscreened" if f"{name}_unscreened" in result else name].values.ravel()
        rows.append((name, _median(kept, unit), _range(kept, unit, 5, 95), _range(every, unit, 5, 95)))
    if 0.0 < determined < _FEW:
        count = int((result["status"] == DETERMINED).sum())
        note = f"{count} pixels pass as determined, so few that their noise selected them: not quoted."
    else:
        note = f"{_percent(determined)} of pixels are determined."
    reason = result.attrs.get("cannot_conclude", "")
    return Table(
        f"Properties ({label})",
        (
            "property",
            "median, determined",
            "5 .. 95 %, determined",
            "5 .. 95 %, every pixel (not to be quoted)",
        ),
        tuple(rows),
        note=f"{note} {_held(result)} {reason}".strip(),
    )


def _held(result: xr.Dataset) -> str:
    if "calibration" in result.attrs:
        return "Intervals hold noise and what the calibration leaves uncertain for the whole scan."
    return "Intervals hold noise only."


def truth_table(properties: Mapping[str, xr.Dataset], truth: xr.Dataset, materials: tuple[str, ...]) -> Table:
    """Return estimated moduli beside the truth of a simulation, by material."""
    rows = []
    for i, material in enumerate(materials):
        mask = truth["material"].values == i
        for label, result in properties.items():
            estimate = result["modulus_unscreened"].values[mask]
            residual, status = result["residual"].values[mask], result["status"].values[mask]
            spread = np.nanpercentile(result["start_spread"].values[mask], 95)
            share = float((status == DETERMINED).mean())
            rows.append(
                (
                    material,
                    label,
                    _median(truth["modulus"].values[mask], "Pa"),
                    _median(estimate, "Pa"),
                    _range(estimate, "Pa", 16, 84),
                    f"x {math.exp(spread):.3g}",
                    _percent(float((residual < POOR_RESIDUAL).mean())),
                    f"{np.nanmedian(result['uncertainty'].values[mask]):.2g}",
                    f"{_percent(share)}: {'can tell' if share >= _MAJORITY else 'cannot tell'}",
                )
            )
    return Table(
        "Modulus by least squares, the published estimator",
        (
            "material",
            "from",
            "truth",
            "median",
            "16 .. 84 % of pixels",
            "starts",
            "N_r < 0.1",
            "ampl. x noise",
            "determined",
        ),
        tuple(rows),
        note="starts: factor between the answers from three starting points (95 % of pixels). N_r < 0.1: what the "
        "method's paper takes for a good fit; it holds whether or not the answer is right. ampl. x noise: linearised "
        "error of ln E. determined: no modulus outside one decade fits the data.",
    )


def truth_properties_table(
    properties: Mapping[str, xr.Dataset], truth: xr.Dataset, materials: tuple[str, ...]
) -> Table:
    """Return estimated adhesion and indentation beside the truth of a simulation, by material."""
    rows = []
    for name in ("adhesion", "indentation"):
        record = quantity(name)
        unit = record.unit if record else "1"
        for i, material in enumerate(materials):
            mask = truth["material"].values == i
            for label, result in properties.items():
                values = result[f"{name}_unscreened"].values[mask]
                rows.append(
                    (
                        name,
                        material,
                        label,
                        _median(truth[name].values[mask], unit),
                        _median(values, unit),
                        _range(values, unit, 16, 84),
                    )
                )
    columns = ("property", "material", "from", "truth", "median", "16 .. 84 % of pixels")
    return Table("Adhesion and indentation by least squares", columns, tuple(rows))


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
