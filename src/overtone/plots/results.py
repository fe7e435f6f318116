"""What figures take from datasets: observables in order, estimates, and what is not determined."""

from __future__ import annotations

import xarray as xr

from overtone.quantities import harmonic_orders
from overtone.report.shares import flags


def measured(observables: xr.Dataset) -> list[str]:
    """Return the names of what was measured, height first and then by harmonic."""
    names = ["height"]
    for n in harmonic_orders(observables):
        names += ["A0"] if n == 0 else [f"A{n}", f"phi{n}"]
    return [name for name in names if name in observables]


def undetermined(properties: xr.Dataset) -> xr.DataArray:
    """Return True where the status is not the flag "determined"."""
    status = properties["status"]
    sure = [flag for flag, meaning in flags(status).items() if meaning == "determined"]
    return ~status.isin(sure)


def estimate_of(properties: xr.Dataset, name: str) -> xr.DataArray | None:
    """Return what the estimator gave at every pixel, or None where the result lacks it."""
    for candidate in (f"{name}_unscreened", name):
        if candidate in properties:
            return properties[candidate].transpose(*properties["status"].dims)
    return None
