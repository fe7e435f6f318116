"""Whether a contact keeps to what its model supposes: pressure, depth, adhesion, time in contact."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
import numpy.typing as npt
import xarray as xr

from overtone.report.content import Table
from overtone.report.numbers import flat, median_of, range_of, unit_of
from overtone.report.results import estimate_of, undetermined
from overtone.report.shares import format_share

VALIDITY = {
    "peak_force": "peak force",
    "contact_radius": "contact radius",
    "mean_pressure": "mean pressure",
    "relative_indentation": "indentation over tip radius",
    "tabor": "Tabor parameter",
    "contact_time": "share of a cycle in contact",
    "modulus_jkr": "modulus by JKR",
    "adhesion_jkr": "adhesion by JKR",
    "model_difference": "ln of JKR over DMT modulus",
}
PRESSURE_LIMIT = 0.1  # of the modulus: about where polymers yield
DEPTH_LIMIT = 0.5  # of the tip radius: its sphere and its paraboloid part there
TIME_LIMIT = 0.5  # of a cycle

_Values = npt.NDArray[np.float64]


def validity_in(result: xr.Dataset) -> tuple[str, ...]:
    """Return the names of what a result holds of the validity of its contact."""
    return tuple(name for name in VALIDITY if name in result)


def validity_tables(properties: Mapping[str, xr.Dataset]) -> tuple[Table, ...]:
    """Return a table for each result that says something of its validity."""
    found = (validity_table(label, result) for label, result in properties.items())
    return tuple(table for table in found if table is not None)


def validity_table(label: str, result: xr.Dataset) -> Table | None:
    """Return medians and ranges of the determined pixels with what they mean for the model, None without any.

    Parameters
    ----------
    label : str
        What the result was inverted from.
    result : Dataset
        Result of `overtone.map_properties`, with any of the names of `VALIDITY`.
    """
    names = validity_in(result)
    if not names:
        return None
    sure = ~undetermined(result).values.ravel()
    rows = []
    for name in names:
        values, unit = flat(result[name], result)[sure], unit_of(result[name])
        remark = _REMARKS[name](values, result, sure) if name in _REMARKS and sure.any() else ""
        rows.append((VALIDITY[name], median_of(values, unit), range_of(values, unit, 5, 95), remark))
    return Table(
        f"Validity ({label})",
        ("quantity", "median, determined", "5 .. 95 %, determined", "remark"),
        tuple(rows),
        note="Of the determined pixels. A modulus is that of the frequency of the drive, not of a slow test."
        if sure.any()
        else "No pixel is determined.",
    )


def _share(passed: npt.NDArray[np.bool_], values: _Values) -> float:
    known = np.isfinite(values)
    return float(passed[known].mean()) if known.any() else 0.0


def _pressure(values: _Values, result: xr.Dataset, sure: npt.NDArray[np.bool_]) -> str:
    modulus = estimate_of(result, "modulus")
    if modulus is None:
        return ""
    relative = values / flat(modulus, result)[sure]
    share = _share(relative > PRESSURE_LIMIT, relative)
    if share == 0.0:
        return ""
    return (
        f"above {100 * PRESSURE_LIMIT:.0f} % of the modulus at {format_share(share)} of them: strains are not small, "
        "and a glassy polymer yields near there"
    )


def _depth(values: _Values, _result: xr.Dataset, _sure: npt.NDArray[np.bool_]) -> str:
    share = _share(values > DEPTH_LIMIT, values)
    if share == 0.0:
        return ""
    return f"above {DEPTH_LIMIT:g} at {format_share(share)} of them: a paraboloid no longer describes the tip"


def _tabor(values: _Values, _result: xr.Dataset, _sure: npt.NDArray[np.bool_]) -> str:
    from overtone.contact.validity import DMT_LIMIT, JKR_LIMIT  # brings the contact models with it

    between = (values >= DMT_LIMIT) & (values <= JKR_LIMIT)
    parts = []
    if (share := _share(between, values)) > 0.0:
        parts.append(
            f"between {DMT_LIMIT:g} and {JKR_LIMIT:g} at {format_share(share)} of them: neither DMT nor JKR, "
            "both are to be given"
        )
    if (share := _share(values > JKR_LIMIT, values)) > 0.0:
        parts.append(f"above {JKR_LIMIT:g} at {format_share(share)} of them: JKR, a DMT modulus is biased")
    return "; ".join(parts)


def _time(values: _Values, _result: xr.Dataset, _sure: npt.NDArray[np.bool_]) -> str:
    share = _share(values > TIME_LIMIT, values)
    if share == 0.0:
        return ""
    return f"above a half at {format_share(share)} of them: the tip is in contact for most of a cycle"


def _difference(values: _Values, result: xr.Dataset, sure: npt.NDArray[np.bool_]) -> str:
    if "uncertainty" not in result:
        return ""
    known = flat(result["uncertainty"], result)[sure]
    share = _share(np.abs(values) > known, values - known)
    if share == 0.0:
        return ""
    return (
        f"larger than the standard deviation of ln E at {format_share(share)} of them: an error of the model, which "
        "the intervals do not hold"
    )


_REMARKS: Mapping[str, Callable[[_Values, xr.Dataset, npt.NDArray[np.bool_]], str]] = {
    "mean_pressure": _pressure,
    "relative_indentation": _depth,
    "tabor": _tabor,
    "contact_time": _time,
    "model_difference": _difference,
}
