"""Numbers of many pixels in the cells of a table."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import xarray as xr

from overtone.quantities import quantity
from overtone.units import display_unit, format_quantity


def range_of(values: npt.NDArray[np.float64], unit: str, low: float, high: float) -> str:
    """Return two percentiles with one unit between them."""
    values = values[np.isfinite(values)]
    if values.size == 0:
        return "-"
    ends = np.percentile(values, [low, high])
    display = display_unit(float(np.abs(ends).max()), unit)
    return f"{ends[0] * display.factor:.3g} .. {ends[1] * display.factor:.3g} {display.label}".strip()


def median_of(values: npt.NDArray[np.float64], unit: str) -> str:
    """Return the median with its unit, a dash where there are no numbers."""
    values = values[np.isfinite(values)]
    return format_quantity(float(np.median(values)), unit) if values.size else "-"


def percent(share: float) -> str:
    """Write a share in percent, with a digit more below one percent."""
    return f"{100 * share:.0f} %" if share == 0.0 or share >= 0.01 else f"{100 * share:.1f} %"


def unit_of(array: xr.DataArray) -> str:
    """Return the unit of an array: what it says itself, or else what its name says."""
    record = quantity(str(array.name))
    return str(array.attrs.get("units", record.unit if record else "1"))


def flat(array: xr.DataArray, result: xr.Dataset) -> npt.NDArray[np.float64]:
    """Return the values of an array as a row, in the order of the pixels of the status."""
    return np.asarray(array.transpose(*result["status"].dims).values, dtype=float).ravel()


def spread_text(value: float) -> str:
    """Write a standard deviation of a logarithm, a dash where there is none."""
    return f"{value:.2g}" if np.isfinite(value) else "-"


def typical(values: npt.NDArray[np.float64]) -> float:
    """Return the median of the finite values, NaN where there are none."""
    values = values[np.isfinite(values)]
    return float(np.median(values)) if values.size else float("nan")


def interval_text(lower: npt.NDArray[np.float64], upper: npt.NDArray[np.float64], unit: str) -> str:
    """Write how wide the typical interval is: a factor from end to end, or a width where an end is not positive.

    Examples
    --------
    >>> interval_text(np.array([1e9]), np.array([2e9]), "Pa"), interval_text(np.array([0.0]), np.array([2e-9]), "m")
    ('x 2', '2 nm wide')
    """
    factor, width = typical(upper / np.where(lower > 0.0, lower, np.nan)), typical(upper - lower)
    if np.isfinite(factor) and typical(lower) > 0.0:
        return f"x {factor:.3g}" if factor < 999.5 else f"x {factor:.0f}"
    return f"{format_quantity(width, unit)} wide" if np.isfinite(width) else "-"
