"""Attributes of datasets as files can hold them."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

import numpy as np
import xarray as xr


def storable_attributes(attributes: Mapping[Any, Any]) -> dict[str, Any]:
    """Return attributes as text, numbers and lists of numbers; what is neither becomes JSON text."""
    return {str(key): _attribute(value) for key, value in attributes.items()}


def with_storable_attributes(dataset: xr.Dataset) -> xr.Dataset:
    """Return a dataset without the encoding of the file it came from, its attributes and its variables' storable."""
    storable = dataset.drop_encoding().assign_attrs()
    storable.attrs = storable_attributes(dataset.attrs)
    for name in storable.variables:
        storable[name].attrs = storable_attributes(dataset[name].attrs)
    return storable


def _attribute(value: Any) -> Any:
    if isinstance(value, str):
        return value.replace("\0", "")  # HDF5 text ends at a zero byte
    if isinstance(value, bool | np.bool_):
        return json.dumps(bool(value))
    if isinstance(value, float | np.floating | np.integer):
        return value
    if isinstance(value, int) and -(2**63) <= value < 2**63:
        return value
    if isinstance(value, list | tuple) and all(type(item) in (int, float) for item in value):
        value = np.array(value)
    if isinstance(value, np.ndarray) and value.ndim == 1 and value.size and value.dtype.kind in "iuf":
        return value
    return as_text(value)


def as_text(value: Any) -> str:
    """Return a value of an attribute as text: itself, or JSON."""
    if isinstance(value, str):
        return value
    if isinstance(value, bytes):
        return value.decode("latin-1").replace("\0", "")
    if isinstance(value, np.ndarray | np.generic):
        value = value.tolist()
    return json.dumps(value, default=str)
