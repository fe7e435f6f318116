"""What a result of `map_properties` holds, whichever method made it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import xarray as xr

from overtone.report.shares import flags

LEAST_SQUARES, EXACT, POSTERIOR = "least-squares", "exact", "posterior"
PROPERTIES = {
    "modulus": "modulus",
    "adhesion": "adhesion",
    "indentation": "maximum indentation",
    "viscosity": "viscosity",
    "loss_tangent": "loss tangent",
    "stiffness": "stiffness",
    "damping": "damping",
    "prefactor": "prefactor",
}
_DEVIATIONS_90 = 1.645  # standard deviations from the middle to an end of a 90 % interval


class Interval(NamedTuple):
    """Both ends of what holds a property at 90 %, on the dimensions of the status."""

    lower: xr.DataArray
    upper: xr.DataArray


def method_of(result: xr.Dataset) -> str:
    """Return the method of a result, from what it says or else from what it holds.

    Examples
    --------
    >>> method_of(xr.Dataset({"solutions": 1})), method_of(xr.Dataset(attrs={"method": "posterior"}))
    ('exact', 'posterior')
    """
    stated = result.attrs.get("method")
    if stated in (LEAST_SQUARES, EXACT, POSTERIOR):
        return str(stated)
    if "solutions" in result:
        return EXACT
    return POSTERIOR if "misfit" in result or "log_evidence" in result else LEAST_SQUARES


def undetermined(result: xr.Dataset) -> xr.DataArray:
    """Return True where the status is not the flag "determined"."""
    status = result["status"]
    sure = [flag for flag, meaning in flags(status).items() if meaning == "determined"]
    return ~status.isin(sure)


def estimate_of(result: xr.Dataset, name: str) -> xr.DataArray | None:
    """Return what the method gave at every pixel, or None where the result lacks it."""
    for candidate in (f"{name}_unscreened", name):
        if candidate in result:
            return result[candidate].transpose(*result["status"].dims)
    return None


def properties_in(result: xr.Dataset) -> tuple[str, ...]:
    """Return the properties of a result, the leading one (a modulus, or a stiffness) first."""
    found = tuple(name for name in PROPERTIES if name in result or f"{name}_unscreened" in result)
    leading = [name for name in ("modulus", "stiffness") if name in found][:1]
    return (*leading, *(name for name in found if name not in leading))


def interval_of(result: xr.Dataset, name: str) -> Interval | None:
    """Return the 90 % interval of a property, or None where the method gives none."""
    ends = [result.get(f"{name}_{end}") for end in ("lower", "upper")]
    lower, upper = (None if end is None else end.transpose(*result["status"].dims) for end in ends)
    return None if lower is None or upper is None else Interval(lower, upper)


def linearised_interval(result: xr.Dataset, name: str) -> Interval | None:
    """Return the interval, or for a modulus without one, that from the standard deviation of its logarithm."""
    found, estimate = interval_of(result, name), estimate_of(result, name)
    if found is not None or name != "modulus" or "uncertainty" not in result or estimate is None:
        return found
    factor = np.exp(_DEVIATIONS_90 * result["uncertainty"].transpose(*estimate.dims))
    return Interval(estimate / factor, estimate * factor)
