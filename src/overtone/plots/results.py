"""What figures take from datasets: observables in order, the width of an interval, and counts as categories."""

from __future__ import annotations

import numpy as np
import xarray as xr

from overtone.quantities import harmonic_orders
from overtone.report.results import interval_of

_COUNTS = ("none", "one", "two", "three_or_more")


def measured(observables: xr.Dataset) -> list[str]:
    """Return the names of what was measured, height first and then by harmonic."""
    names = ["height"]
    for n in harmonic_orders(observables):
        names += ["A0"] if n == 0 else [f"A{n}", f"phi{n}"]
    return [name for name in names if name in observables]


def width_of(properties: xr.Dataset, name: str) -> xr.DataArray | None:
    """Return how many decades the 90 % interval of a property is wide, None where there is none."""
    interval = interval_of(properties, name)
    if interval is None:
        return None
    lower, upper = (end.where(end > 0.0) for end in interval)
    return xr.DataArray(np.log10(upper / lower), name="range_width", attrs={"units": "decades"})


def counted(solutions: xr.DataArray) -> xr.DataArray:
    """Return a number of solutions as categories; what is no number stays outside of them."""
    values = np.asarray(solutions.values, dtype=float)
    codes = np.where(np.isfinite(values), np.clip(values, -1, len(_COUNTS) - 1), -1).astype(np.int8)
    found = solutions.copy(data=codes)
    found.attrs = {"flag_values": list(range(len(_COUNTS))), "flag_meanings": " ".join(_COUNTS)}
    return found


def spread_of_solutions(properties: xr.Dataset, name: str) -> xr.DataArray | None:
    """Return how many decades lie between the solutions of a pixel, NaN where there are not several."""
    if f"{name}_solutions" not in properties:
        return None
    every = properties[f"{name}_solutions"]
    every = every.where(every > 0.0)
    several = every.notnull().sum("solution") > 1
    factor = (every.max("solution") / every.min("solution")).where(several)
    return xr.DataArray(np.log10(factor), name="solution_spread", attrs={"units": "decades"})
