"""Datasets tell their own history: operation, arguments and version, in the order they were applied."""

from __future__ import annotations

import json
from typing import Any

import xarray as xr

from overtone._version import __version__

_ATTRIBUTE = "history"
_FINDINGS = "findings"


def record(dataset: xr.Dataset, operation: str, **arguments: Any) -> xr.Dataset:
    """Return the dataset with one more entry in its history.

    Parameters
    ----------
    dataset : Dataset
        Left unchanged; a shallow copy is returned.
    operation : str
        Public name of what was done.
    **arguments
        What it was done with; anything JSON cannot hold is kept as text.

    Examples
    --------
    >>> history(record(xr.Dataset(), "open_scan", path="a.ibw"))[0]["operation"]
    'open_scan'
    """
    entry = {"operation": operation, "arguments": arguments, "overtone": __version__}
    text = json.dumps([*history(dataset), entry], default=str)
    return dataset.assign_attrs({_ATTRIBUTE: text})


def history(dataset: xr.Dataset) -> list[dict[str, Any]]:
    """Return the entries of a dataset's history, oldest first."""
    return _entries(dataset, _ATTRIBUTE)


def add_finding(dataset: xr.Dataset, *sentences: str) -> xr.Dataset:
    """Return the dataset with sentences for its reader: what was assumed, rejected or cannot be concluded.

    Examples
    --------
    >>> findings(add_finding(xr.Dataset(), "A0 has no unit."))
    ['A0 has no unit.']
    """
    return dataset.assign_attrs({_FINDINGS: json.dumps([*findings(dataset), *sentences])})


def findings(dataset: xr.Dataset) -> list[str]:
    """Return the sentences a dataset carries for its reader."""
    return [str(sentence) for sentence in _entries(dataset, _FINDINGS)]


def _entries(dataset: xr.Dataset, attribute: str) -> list[Any]:
    try:
        entries = json.loads(dataset.attrs.get(attribute, "[]"))
    except (TypeError, ValueError):
        return []
    return entries if isinstance(entries, list) else []
