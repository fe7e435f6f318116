"""Shares of pixels by flag, such as the status of a result, in words."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import xarray as xr

from overtone.report.content import Table


def flags(array: xr.DataArray) -> dict[int, str]:
    """Return the values a flag array can take and what they mean, from its attributes.

    Examples
    --------
    >>> flags(xr.DataArray([0], attrs={"flag_values": [0, 4], "flag_meanings": "determined at_bound"}))
    {0: 'determined', 4: 'at bound'}
    """
    values = np.atleast_1d(array.attrs.get("flag_values", []))
    meanings = str(array.attrs.get("flag_meanings", "")).split()
    return {int(v): m.replace("_", " ") for v, m in zip(values, meanings, strict=False)}


def flag_shares(array: xr.DataArray) -> dict[str, float]:
    """Return the share of pixels of every flag, in the order of the flags.

    Examples
    --------
    >>> flag_shares(xr.DataArray([0, 4], attrs={"flag_values": [0, 4], "flag_meanings": "determined at_bound"}))
    {'determined': 0.5, 'at bound': 0.5}
    """
    values = np.asarray(array.values)
    total = max(values.size, 1)
    return {meaning: int(np.count_nonzero(values == flag)) / total for flag, meaning in flags(array).items()}


def format_share(share: float) -> str:
    """Write a share in percent without rounding a few pixels to none, or almost all to all.

    Examples
    --------
    >>> format_share(0.6137), format_share(1e-5), format_share(0.99999), format_share(0.0), format_share(1.0)
    ('61.4 %', '< 0.1 %', '> 99.9 %', '0 %', '100 %')
    """
    if share in (0.0, 1.0):
        return f"{100 * share:.0f} %"
    if share < 0.0005:
        return "< 0.1 %"
    if share > 0.9995:
        return "> 99.9 %"
    return f"{100 * share:.1f} %"


def status_shares(properties: Mapping[str, xr.Dataset]) -> Table:
    """Return the shares of status of several results side by side; what no pixel is stays out."""
    shares = {label: flag_shares(result["status"]) for label, result in properties.items()}
    meanings = dict.fromkeys(
        meaning
        for result in shares.values()
        for meaning, share in result.items()
        if share > 0.0 or meaning == "determined"
    )
    rows = (
        (meaning, *(format_share(result.get(meaning, 0.0)) for result in shares.values()))
        for meaning in meanings
    )
    return Table("Share of pixels", ("status", *shares), tuple(rows))
