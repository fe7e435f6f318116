"""Datasets as tables of text, the counterpart of `overtone.io.table`: one row a pixel, one column a variable."""

from __future__ import annotations

import csv
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from overtone import provenance
from overtone._version import __version__
from overtone.errors import ChannelWarning
from overtone.io.atomic import atomic_path
from overtone.io.attributes import as_text
from overtone.io.layers import MAP, RAW, Layer, dims_of, layers_of

_AXIS_UNITS = {"x": "m", "y": "m", "z": "m", "time": "s"}
_LONGEST_COMMENT = 4000


def write(dataset: xr.Dataset, path: str | Path) -> None:
    """Write a dataset as a table: x and y, or z, and a column for each variable, all in SI units.

    The first line says how many rows there are. The header names every column with its unit, ``A1 [m]``, as
    `overtone.io.table` reads it. Floats have all their digits, so that they come back bit for bit; empty cells are NaN.
    A variable over a further dimension has a column for each of its places, ``F_cons harmonic 1 [N]``. Lines with ``#``
    above the header hold findings and attributes of one line; a probe takes several lines and has to be given again.

    Parameters
    ----------
    dataset : Dataset
        With maps over ``y`` and ``x``, or curves over one dimension.
    path : str or Path
        An existing file is replaced once the new one is complete.

    Raises
    ------
    ObservablesError
        If the dataset holds neither maps nor curves.
    FileFormatError
        If the file cannot be written.

    Warns
    -----
    ChannelWarning
        If variables are left out, because they are over other dimensions or no numbers.
    """
    dims = dims_of(dataset)
    layers, left_out = layers_of(dataset, dims)
    if left_out:
        warnings.warn(
            f"a table over {' and '.join(dims)} has no place for {', '.join(left_out)}: left out",
            ChannelWarning,
            stacklevel=3,
        )
    columns = [*_positions(dataset, dims), *((_heading(layer), layer.values.ravel()) for layer in layers)]
    with (
        atomic_path(path) as temporary,
        temporary.open("w", encoding="utf-8", newline="") as stream,
    ):
        stream.write(f"# rows: {len(columns[0][1])}\n")  # text shows no other way that it was cut off
        stream.writelines(f"# {line}\n" for line in _comments(dataset))
        table = csv.writer(stream, lineterminator="\n")
        table.writerow([heading for heading, _ in columns])
        table.writerows(zip(*(_cells(values) for _, values in columns), strict=True))


def _positions(dataset: xr.Dataset, dims: tuple[str, ...]) -> Iterator[tuple[str, np.ndarray[Any, Any]]]:
    """Yield heading and values of the columns that say where a row is."""
    sizes = [dataset.sizes[dim] for dim in dims]
    for k, dim in sorted(enumerate(dims), key=lambda pair: pair[1]):
        if dim in dataset.coords and dataset[dim].dtype.kind in "biuf":
            along = dataset[dim].values
            unit = dataset[dim].attrs.get("units", _AXIS_UNITS.get(dim))
            heading = f"{dim} [{unit}]" if unit else dim
        else:  # pixels, y counted from the bottom
            along = np.arange(sizes[k])[:: -1 if dims == MAP and dim == "y" else 1]
            heading = dim
        shape = [1] * len(dims)
        shape[k] = -1
        yield heading, np.broadcast_to(along.reshape(shape), sizes).ravel()


def _heading(layer: Layer) -> str:
    name = f"{layer.label} {layer.direction}" if layer.direction else layer.label
    unit = layer.unit
    return name if unit is None else f"{name} [{unit or '1'}]"


def _cells(values: np.ndarray[Any, Any]) -> list[str]:
    if values.dtype.kind == "f":
        # The shortest text that gives the same double again.
        return ["" if value != value else repr(value) for value in values.astype(np.float64).tolist()]
    return [str(int(value)) for value in values.tolist()]


def _comments(dataset: xr.Dataset) -> Iterator[str]:
    yield f"written by: overtone {__version__}"
    for k, sentence in enumerate(provenance.findings(dataset), start=1):
        yield f"finding {k}: {' '.join(sentence.split())}"
    for name, array in dataset.data_vars.items():
        meanings, values = (array.attrs.get(key) for key in ("flag_meanings", "flag_values"))
        if meanings is not None and values is not None:
            pairs = zip(np.atleast_1d(values).tolist(), str(meanings).split(), strict=False)
            yield f"values of {name}: {', '.join(f'{value} {meaning}' for value, meaning in pairs)}"
    # The header of a microscope's file has hundreds of lines, which say little without that file.
    kept = ("source", "vendor", "history") if dataset.attrs.get(RAW) else tuple(dataset.attrs)
    for key in kept:
        value = dataset.attrs.get(key, "")
        text = as_text(value)
        if key != "findings" and "\n" not in text and "\r" not in text and len(text) <= _LONGEST_COMMENT:
            yield f"{key}: {text}"
