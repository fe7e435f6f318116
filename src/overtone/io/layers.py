"""The arrays of a dataset as plain images or columns, which is all that most formats of other programs hold."""

from __future__ import annotations

import itertools
import re
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr

from overtone.errors import ObservablesError
from overtone.units import format_quantity

MAP = ("y", "x")
RAW = "raw channels"
"""Attribute of a dataset whose variables are the channels of a microscope's file as they are."""
_MOST = 1000
# What would end a cell, a line or a unit in a table, or a text in a binary file.
_AWKWARD = re.compile(r"[\x00-\x1f;\[\]()]+")


@dataclass(frozen=True)
class Layer:
    """One plane or column of a variable.

    Parameters
    ----------
    name : str
        The variable.
    place : str
        Which part of it, such as ``harmonic 1``; empty where it is the whole.
    direction : str or None
        ``trace``, ``retrace``, ``approach`` or ``retract`` where the variable or its dataset says so.
    values : array
        Numbers over the dimensions asked for.
    attributes : mapping
        Those of the variable.
    """

    name: str
    place: str
    direction: str | None
    values: np.ndarray[Any, Any]
    attributes: Mapping[str, Any]

    @property
    def unit(self) -> str | None:
        """SI unit, None where the variable states none."""
        stated = self.attributes.get("units")
        return str(stated) if stated is not None else None

    @property
    def label(self) -> str:
        """Name with its place, without line direction."""
        return _AWKWARD.sub(" ", f"{self.name} {self.place}".strip())


def dims_of(dataset: xr.Dataset) -> tuple[str, ...]:
    """Return what the rows of a table of this dataset run over: y and x of maps, or the one dimension of curves.

    Raises
    ------
    ObservablesError
        If there is neither.
    """
    numeric = [array for array in dataset.data_vars.values() if _is_numeric(array)]
    if any(set(MAP) <= set(array.dims) for array in numeric):
        return MAP
    own = ([str(dim) for dim in array.dims if dim != "direction"] for array in numeric)
    counts = Counter(dims[0] for dims in own if len(dims) == 1)
    if not counts:
        raise ObservablesError(
            "the dataset holds neither maps nor curves",
            expected="numbers over y and x, or over one dimension",
            got=", ".join(
                f"{n}({', '.join(map(str, a.dims))})" for n, a in list(dataset.data_vars.items())[:6]
            )
            or "no variables",
            hint="a name that ends in .nc or .zarr, which hold anything",
        )
    return (counts.most_common(1)[0][0],)


def layers_of(dataset: xr.Dataset, dims: tuple[str, ...]) -> tuple[list[Layer], list[str]]:
    """Return every plane over ``dims``, and the names of the variables that have none.

    A variable with further dimensions becomes one layer for each of their places.

    Raises
    ------
    ObservablesError
        If there are more than a thousand.
    """
    layers: list[Layer] = []
    left_out: list[str] = []
    for key, array in dataset.data_vars.items():
        if _is_numeric(array) and set(dims) <= set(array.dims):
            layers.extend(_split(str(key), array, dims, dataset.attrs.get("direction")))
        else:
            left_out.append(str(key))
        if len(layers) > _MOST:
            raise ObservablesError(
                f"the dataset would make more than {_MOST} channels",
                got=f"{key} over {', '.join(map(str, array.dims))}",
                hint="fewer variables, or a name that ends in .nc or .zarr",
            )
    return layers, left_out


def _split(name: str, array: xr.DataArray, dims: tuple[str, ...], stated: object) -> Iterator[Layer]:
    further = [str(dim) for dim in array.dims if dim not in dims]
    ordered = array.transpose(*further, *dims)
    whole = array.attrs.get("direction", stated)
    if "direction" in array.coords and array["direction"].ndim == 0:
        whole = array["direction"].values.item()
    for index in itertools.product(*(range(array.sizes[dim]) for dim in further)):
        places = {dim: _place(array, dim, i) for dim, i in zip(further, index, strict=True)}
        direction = places.pop("direction", None if whole is None else str(whole))
        yield Layer(
            name=name,
            place=" ".join(f"{dim} {place}" for dim, place in places.items()),
            direction=direction,
            values=np.asarray(ordered.values[index]),
            attributes=array.attrs,
        )


def _place(array: xr.DataArray, dim: str, index: int) -> str:
    if dim not in array.coords or array[dim].ndim != 1:
        return str(index + 1)
    value = array[dim].values[index]
    if isinstance(value, float | np.floating):
        return format_quantity(float(value), str(array[dim].attrs.get("units", "1")), 6)
    return str(value)


def _is_numeric(array: xr.DataArray) -> bool:
    return array.dtype.kind in "biuf" and array.size > 0
