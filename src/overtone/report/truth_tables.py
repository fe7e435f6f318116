"""Results beside what a simulation started from."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import xarray as xr

from overtone.inversion.properties import DETERMINED, POOR_RESIDUAL
from overtone.quantities import quantity
from overtone.report.content import Table
from overtone.report.materials import interval
from overtone.report.numbers import flat, interval_text, median_of, percent, range_of, unit_of
from overtone.report.property_tables import FEW
from overtone.report.results import (
    LEAST_SQUARES,
    PROPERTIES,
    alone,
    estimate_of,
    interval_of,
    is_pooled,
    method_of,
    properties_in,
    undetermined,
)
from overtone.units import format_quantity

_MAJORITY = 0.5


def truth_table(properties: Mapping[str, xr.Dataset], truth: xr.Dataset, materials: tuple[str, ...]) -> Table:
    """Return moduli beside the truth of a simulation, by material.

    Parameters
    ----------
    properties : mapping of str to Dataset
        Results of `overtone.map_properties` by label, of any methods.
    truth : Dataset
        What the simulation started from, with ``material``.
    materials : tuple of str
        Names of the materials.
    """
    if all(method_of(result) == LEAST_SQUARES for result in properties.values()):
        return _estimator_table(properties, truth, materials)
    rows = []
    for i, material in enumerate(materials):
        for label, result in _with_pixels_alone(properties):
            leading = next(iter(properties_in(result)), "")
            if leading not in truth:
                continue
            found = _compared(result, truth, leading, i)
            share = float(found.sure.mean()) if found.sure.size else 0.0
            rows.append(
                (
                    material,
                    label,
                    str(result.attrs.get("method", method_of(result))),
                    median_of(found.true, found.unit),
                    *found.cells,
                    f"{percent(share)}: {'can tell' if share >= _MAJORITY else 'cannot tell'}",
                )
            )
    columns = ("material", "from", "method", "truth", *_COMPARED, "determined")
    return Table("Modulus beside the truth", columns, tuple(rows), note=_COMPARED_NOTE)


def truth_properties_table(
    properties: Mapping[str, xr.Dataset], truth: xr.Dataset, materials: tuple[str, ...]
) -> Table:
    """Return the other properties beside the truth of a simulation, by material.

    Parameters
    ----------
    properties : mapping of str to Dataset
        Results of `overtone.map_properties` by label, of any methods.
    truth : Dataset
        What the simulation started from, with ``material``.
    materials : tuple of str
        Names of the materials.
    """
    if all(method_of(result) == LEAST_SQUARES for result in properties.values()):
        return _estimator_properties_table(properties, truth, materials)
    rows = []
    for name in PROPERTIES:
        for i, material in enumerate(materials):
            for label, result in _with_pixels_alone(properties):
                if name not in properties_in(result)[1:] or name not in truth:
                    continue
                found = _compared(result, truth, name, i)
                rows.append(
                    (PROPERTIES[name], material, label, median_of(found.true, found.unit), *found.cells)
                )
    columns = ("property", "material", "from", "truth", *_COMPARED)
    return Table("Other properties beside the truth", columns, tuple(rows), note=_COMPARED_NOTE)


def truth_materials_table(
    properties: Mapping[str, xr.Dataset], truth: xr.Dataset, materials: tuple[str, ...]
) -> Table | None:
    """Return the medians of phases beside the truth, a line a material; None where no result has phases.

    Parameters
    ----------
    properties : mapping of str to Dataset
        Results of `overtone.map_properties` by label.
    truth : Dataset
        What the simulation started from, with ``material``.
    materials : tuple of str
        Names of the materials.
    """
    pooled = {label: result for label, result in properties.items() if is_pooled(result)}
    if not pooled:
        return None
    rows = [
        (material, label, *_of_its_phase(result, truth, i))
        for i, material in enumerate(materials)
        for label, result in pooled.items()
    ]
    return Table(
        "Materials beside the truth",
        ("material", "from", "phase", "truth", "median", "90 % interval", "pooled 90 % interval holds"),
        tuple(rows),
        note="The modulus of the median of a phase. The truth is the median of what the pixels of the phase started "
        "from.",
    )


def _of_its_phase(result: xr.Dataset, truth: xr.Dataset, material: int) -> tuple[str, str, str, str, str]:
    """Return phase, truth, median, interval, and whether it holds the truth, of the phase that is most a material."""
    nothing = ("none of its own", "-", "-", "-", "-")
    phase, kind = flat(result["phase"], result), flat(truth["material"], result)
    mine = phase[(kind == material) & (phase >= 0)].astype(int)
    if not mine.size:
        return nothing
    k = int(np.bincount(mine).argmax())
    leading = next(iter(properties_in(result)), "modulus")
    if float((kind[phase == k] == material).mean()) < _MAJORITY or leading not in truth:
        return nothing
    name = str(result["material"].values[k]).replace("_", " ")
    unit = unit_of(truth[leading])
    true = float(np.nanmedian(flat(truth[leading], result)[phase == k]))
    if f"material_{leading}" not in result:
        return (name, format_quantity(true, unit), "-", "-", "-")
    middle, low, high = (
        float(result[f"material_{leading}{end}"].values[k]) for end in ("", "_lower", "_upper")
    )
    if not np.isfinite([middle, low, high]).all():
        return (name, format_quantity(true, unit), "-", "-", "-")
    return (
        name,
        format_quantity(true, unit),
        format_quantity(middle, unit),
        interval(low, high, unit),
        "yes" if low <= true <= high else "no",
    )


def _with_pixels_alone(properties: Mapping[str, xr.Dataset]) -> Iterator[tuple[str, xr.Dataset]]:
    """Yield results by label, behind pooled ones what their pixels say by themselves."""
    for label, result in properties.items():
        yield label, result
        if is_pooled(result):
            yield "its pixels alone", alone(result)


# --- intervals ----------------------------------------------------------------------------------------------------

_COMPARED = ("median", "5 .. 95 % of pixels", "90 % interval of one pixel", "truth in it: all, determined")
_COMPARED_NOTE = (
    "Medians and ranges are of the determined pixels where these are a tenth or more, else of none. Truth in it: the "
    "share of pixels whose 90 % interval holds the truth, of all that have one and of the determined ones; where the "
    "intervals are right and pixels err independently it is about 90 %, and what the whole scan shares moves all "
    "pixels of a material together."
)


class _Found(NamedTuple):
    """The pixels of one material in one result."""

    unit: str
    true: npt.NDArray[np.float64]
    sure: npt.NDArray[np.bool_]
    cells: tuple[str, str, str, str]


def _compared(result: xr.Dataset, truth: xr.Dataset, name: str, material: int) -> _Found:
    mask = flat(truth["material"], result) == material
    true, sure = flat(truth[name], result)[mask], ~undetermined(result).values.ravel()[mask]
    estimate, interval = estimate_of(result, name), interval_of(result, name)
    assert estimate is not None
    unit = unit_of(estimate)
    quoted = sure.size > 0 and float(sure.mean()) >= FEW
    values = flat(estimate, result)[mask][sure] if quoted else np.empty(0)
    wide, inside = "-", "-"
    if interval is not None:
        lower, upper = (flat(end, result)[mask] for end in interval)
        wide = interval_text(lower[sure], upper[sure], unit) if quoted else interval_text(lower, upper, unit)
        inside = f"{_coverage(true, lower, upper)}, {_coverage(true[sure], lower[sure], upper[sure])}"
    cells = (median_of(values, unit), range_of(values, unit, 5, 95), wide, inside)
    return _Found(unit, true, sure, cells)


def _coverage(
    true: npt.NDArray[np.float64], lower: npt.NDArray[np.float64], upper: npt.NDArray[np.float64]
) -> str:
    """Return the share of intervals that hold the truth, of those that are known."""
    known = np.isfinite(true) & np.isfinite(lower) & np.isfinite(upper)
    if not known.any():
        return "-"
    return percent(float(((lower <= true) & (true <= upper))[known].mean()))


# --- the published estimator --------------------------------------------------------------------------------------


def _estimator_table(
    properties: Mapping[str, xr.Dataset], truth: xr.Dataset, materials: tuple[str, ...]
) -> Table:
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
                    median_of(truth["modulus"].values[mask], "Pa"),
                    median_of(estimate, "Pa"),
                    range_of(estimate, "Pa", 16, 84),
                    f"x {math.exp(spread):.3g}",
                    percent(float((residual < POOR_RESIDUAL).mean())),
                    f"{np.nanmedian(result['uncertainty'].values[mask]):.2g}",
                    f"{percent(share)}: {'can tell' if share >= _MAJORITY else 'cannot tell'}",
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


def _estimator_properties_table(
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
                        median_of(truth[name].values[mask], unit),
                        median_of(values, unit),
                        range_of(values, unit, 16, 84),
                    )
                )
    columns = ("property", "material", "from", "truth", "median", "16 .. 84 % of pixels")
    return Table("Adhesion and indentation by least squares", columns, tuple(rows))
