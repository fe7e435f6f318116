"""Datasets as tables of text: names with SI units in the first line, what categories stand for above it."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from typing import Any

import numpy as np
import xarray as xr

from overtone.report.content import Table
from overtone.report.numbers import unit_of
from overtone.report.shares import flags


def table_text(dataset: xr.Dataset, notes: Sequence[str] = ()) -> str:
    """Return a dataset as text, a row for each entry of its dimensions, a column for each coordinate and variable.

    Parameters
    ----------
    dataset : Dataset
        Numbers in SI units, or texts. Variables that lack a dimension are repeated along it.
    notes : sequence of str
        Lines above the table, such as ``title: what it shows``.

    Notes
    -----
    Numbers are written so that they read back as the same ones; what is not known is an empty cell. Maps are tables
    that `overtone.open_scan` can read.
    """
    dims = tuple(_order(dataset))
    # x before y, as in every table of a scan
    columns: dict[str, xr.DataArray] = {}
    grid = xr.Dataset(coords={dim: _coordinate(dataset, dim) for dim in dims})
    for dim in sorted(dims, key=lambda name: (name != "x", name != "y")):
        columns[str(dim)] = grid[dim].broadcast_like(grid).transpose(*dims) if dims else grid[dim]
    for name in dataset.data_vars:
        columns[str(name)] = _spread(dataset[name], grid, dims)
    lines = [f"# {note}" for note in notes]
    lines += [f"# {name}: {text}" for name, text in _categories(dataset)]
    heads = [_head(name, array) for name, array in columns.items()]
    cells = [_cells(array) for array in columns.values()]
    return "\n".join([*lines, _joined([heads]), _joined(zip(*cells, strict=True))]).rstrip("\n") + "\n"


def cells_text(table: Table) -> str:
    """Return a table of text cells as text, its headings first."""
    return _joined([table.columns, *table.rows]) + "\n"


def _order(dataset: xr.Dataset) -> list[Any]:
    """Return the dimensions in the order of the variable that has most of them."""
    arrays = sorted(dataset.data_vars.values(), key=lambda array: -array.ndim)
    return list(dict.fromkeys(dim for array in arrays for dim in array.dims))


def _coordinate(dataset: xr.Dataset, dim: Any) -> xr.DataArray:
    if dim in dataset.coords:
        found = dataset.coords[dim].variable.to_base_variable()
        if dim in ("x", "y", "z") and "units" not in found.attrs:
            found.attrs = {"units": "m"}
        return xr.DataArray(found.values, dims=(dim,), attrs=found.attrs, name=dim)
    return xr.DataArray(np.arange(dataset.sizes[dim]), dims=(dim,), attrs={"units": "1"}, name=dim)


def _spread(array: xr.DataArray, grid: xr.Dataset, dims: tuple[Any, ...]) -> xr.DataArray:
    """Return an array on all dimensions."""
    bare = array.drop_vars(list(array.coords))
    missing = {dim: grid.sizes[dim] for dim in dims if dim not in bare.dims}
    return bare.expand_dims(missing).transpose(*dims) if dims else bare


def _head(name: str, array: xr.DataArray) -> str:
    return name if array.dtype.kind in "UOS" else f"{name} [{unit_of(array.rename(name))}]"


def _cells(array: xr.DataArray) -> list[str]:
    values = np.asarray(array.values).ravel()
    if values.dtype.kind in "iub":
        return [str(int(value)) for value in values]
    if values.dtype.kind == "f":
        return ["" if value != value else repr(float(value)) for value in values.tolist()]
    return [str(value) for value in values.tolist()]


def _joined(rows: Any) -> str:
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows(rows)
    return text.getvalue().rstrip("\n")


def _categories(dataset: xr.Dataset) -> list[tuple[str, str]]:
    """Return of every array of categories what its numbers stand for."""
    found = []
    for name, array in dataset.data_vars.items():
        known = flags(array)
        if known:
            found.append((str(name), ", ".join(f"{value} = {meaning}" for value, meaning in known.items())))
    return found
