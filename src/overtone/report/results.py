"""What a result of `map_properties` holds, whichever method made it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import xarray as xr

from overtone.inversion.result import WIDEST_DETERMINED
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


def is_pooled(result: xr.Dataset) -> bool:
    """Tell whether a result has phases and their materials, as method ``population`` makes them."""
    return "phase" in result and "material" in result.dims


def alone(result: xr.Dataset) -> xr.Dataset:
    """Return what the pixels of a pooled result say without their phases, as the posterior of each by itself.

    A pixel counts as determined here where its interval spans less than a factor of ten, which is what its status
    was, but for a model that does not fit.
    """
    arrays = {}
    for name in properties_in(result):
        for of_it, in_it in (
            ("_unpooled", "_unscreened"),
            ("_unpooled_lower", "_lower"),
            ("_unpooled_upper", "_upper"),
        ):
            if f"{name}{of_it}" in result:
                arrays[f"{name}{in_it}"] = result[f"{name}{of_it}"].rename(f"{name}{in_it}")
    status = result["status"].copy()
    codes = {meaning: flag for flag, meaning in flags(status).items()}
    leading = next(iter(properties_in(result)), "")
    if f"{leading}_lower" in arrays and "determined" in codes:
        low, high = (arrays[f"{leading}_{end}"].transpose(*status.dims).values for end in ("lower", "upper"))
        with np.errstate(divide="ignore", invalid="ignore"):
            narrow = np.log(high / low) <= WIDEST_DETERMINED
        pooled = result["phase"].transpose(*status.dims).values >= 0
        other = codes.get("not determined by these data", codes["determined"])
        status.values = np.where(pooled, np.where(narrow, codes["determined"], other), status.values)
    attributes = {**result.attrs, "method": POSTERIOR}
    return xr.Dataset({**arrays, "misfit": result["misfit"], "status": status}, attrs=attributes)


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
    # where the data say next to nothing the interval is open and reaches infinity
    with np.errstate(over="ignore"):
        factor = np.exp(_DEVIATIONS_90 * result["uncertainty"].transpose(*estimate.dims))
    return Interval(estimate / factor, estimate * factor)
