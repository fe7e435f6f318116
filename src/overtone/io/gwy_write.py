"""Maps as a file of Gwyddion, the counterpart of `overtone.io.gwy`."""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import xarray as xr

from overtone import provenance
from overtone._version import __version__
from overtone.errors import ChannelWarning, ObservablesError
from overtone.io.atomic import atomic_path
from overtone.io.attributes import as_text
from overtone.io.gwy import FIELD, OF_CHANNEL, RAW_KEY, UNIT, VERSION_KEY
from overtone.io.gwy_container import CONTAINER, GwyObject, serialized
from overtone.io.layers import MAP, RAW, Layer, layers_of
from overtone.io.si import to_si

_Floats = npt.NDArray[np.float64]

LAYER = "layer"
"""Attribute of a variable: number of the field it was, which some of a file's settings go by."""
_EVEN = 1e-6  # of a step: by so much the steps between pixels may differ
_LARGEST = 2**32 - 1
_WINDOWS = 8  # so many maps Gwyddion shows when it opens the file


def write(dataset: xr.Dataset, path: str | Path) -> None:
    """Write the maps of a dataset as data fields of a Gwyddion file.

    Values are doubles in SI units, bit for bit; flags such as ``status`` are numbers, and their meanings stand in
    the metadata. A field's title is the name of its variable with the line direction behind it (``A1Retrace``); a
    variable over a further dimension has a field for each of its places. Pixels without a value are masked, for
    Gwyddion's files hold no NaN, and filled with the mean of the others. Findings, history and all other attributes
    stand in the metadata of every field. Lost is where the image lies: a file of Gwyddion says how large it is.

    Parameters
    ----------
    dataset : Dataset
        With maps over ``y`` and ``x``; evenly spaced coordinates [m] give the size.
    path : str or Path
        An existing file is replaced once the new one is complete.

    Raises
    ------
    ObservablesError
        If the dataset holds no map, its pixels are not evenly spaced, or it is too large for the format.
    FileFormatError
        If the file cannot be written.

    Warns
    -----
    ChannelWarning
        If variables are left out, because they are no maps or no numbers.
    """
    layers, left_out = layers_of(dataset, MAP)
    if not layers:
        raise ObservablesError(
            "the dataset holds no map, which is what Gwyddion shows",
            expected="numbers over y and x",
            got=", ".join(left_out[:8]) or "no variables",
            hint="a name that ends in .csv or .nc",
        )
    if left_out:
        warnings.warn(
            f"a file of Gwyddion has no place for {', '.join(left_out)}: left out",
            ChannelWarning,
            stacklevel=3,
        )
    if sum(16 * layer.values.size for layer in layers) > _LARGEST:
        raise ObservablesError(
            "the dataset is too large for a file of Gwyddion",
            expected="less than 4 GiB with masks",
            got=f"{len(layers)} maps of {layers[0].values.size} pixels",
            hint="fewer variables, or a name that ends in .nc or .zarr",
        )
    size = _size(dataset)
    common = _metadata(dataset)
    items: dict[str, Any] = {}
    for place, (index, layer) in enumerate(_numbered(layers)):
        values, unit = _in_base_units(layer)
        known = np.isfinite(values)
        items[f"/{index}/data"] = _field(_filled(values, known), size, unit)
        items[f"/{index}/data/title"] = layer.label + (layer.direction or "").capitalize()
        if not known.all():
            items[f"/{index}/mask"] = _field((~known).astype(float), size, "")
        items[f"/{index}/meta"] = GwyObject(CONTAINER, {**common, **_own(layer)})
        items[f"/{index}/data/visible"] = place < _WINDOWS
    content = serialized(GwyObject(CONTAINER, items))
    with atomic_path(path) as temporary:
        temporary.write_bytes(content)


def _numbered(layers: list[Layer]) -> list[tuple[int, Layer]]:
    """Return layers with their numbers: those they had in another file, if all had one, else in order."""
    given = [layer.attributes.get(LAYER) for layer in layers]
    if all(isinstance(n, int | np.integer) and n >= 0 for n in given) and len(set(given)) == len(given):
        return [(int(n), layer) for n, layer in zip(given, layers, strict=True) if n is not None]
    return list(enumerate(layers))


def _size(dataset: xr.Dataset) -> tuple[float, float, str]:
    """Return width and height with their unit: metres, or pixels where there are no coordinates."""
    steps = {}
    for dim in MAP:
        count = dataset.sizes[dim]
        values = np.asarray(dataset[dim].values, dtype=float) if dim in dataset.coords else np.empty(0)
        unit = str(dataset[dim].attrs.get("units", "m")) if dim in dataset.coords else ""
        if values.size < 2 or unit != "m":
            continue
        step = (values[-1] - values[0]) / (count - 1)
        if not (abs(step) > 0.0 and np.abs(np.diff(values) - step).max() <= _EVEN * abs(step)):
            raise ObservablesError(
                f"{dim} is not evenly spaced",
                expected="pixels at equal distances, which is all a file of Gwyddion can say",
                got=f"steps from {np.diff(values).min():.4g} to {np.diff(values).max():.4g} m",
                hint="a name that ends in .nc or .csv",
            )
        steps[dim] = abs(float(step))
    if not steps:
        return float(dataset.sizes["x"]), float(dataset.sizes["y"]), ""
    # A single line is as high as its pixels are wide.
    across, down = (steps.get(dim, next(iter(steps.values()))) for dim in ("x", "y"))
    return across * dataset.sizes["x"], down * dataset.sizes["y"], "m"


def _in_base_units(layer: Layer) -> tuple[_Floats, str]:
    """Return values and unit without a prefix, which Gwyddion would ignore."""
    values = layer.values.astype(np.float64)
    known = to_si(layer.unit) if layer.unit else None
    if known is None:
        return values, layer.unit or ""
    factor, unit = known
    return values * factor if factor != 1.0 else values, "" if unit == "1" else unit


def _filled(values: _Floats, known: npt.NDArray[np.bool_]) -> _Floats:
    if known.all():
        return values
    mean = float(values[known].mean()) if known.any() else 0.0
    return np.where(known, values, mean if math.isfinite(mean) else 0.0)


def _field(values: _Floats, size: tuple[float, float, str], unit: str) -> GwyObject:
    rows, columns = values.shape
    width, height, length = size
    return GwyObject(
        FIELD,
        {
            "xres": columns,
            "yres": rows,
            "xreal": width,
            "yreal": height,
            "xoff": 0.0,
            "yoff": 0.0,
            "si_unit_xy": GwyObject(UNIT, {"unitstr": length}),
            "si_unit_z": GwyObject(UNIT, {"unitstr": unit}),
            "data": values,
        },
    )


def _metadata(dataset: xr.Dataset) -> dict[str, str]:
    """Return the attributes as text, with the findings once more for people."""
    found = {str(key): as_text(value) for key, value in dataset.attrs.items() if key != RAW}
    found[VERSION_KEY] = __version__
    if dataset.attrs.get(RAW):
        found[RAW_KEY] = "as in the file"
    for k, sentence in enumerate(provenance.findings(dataset), start=1):
        found[f"finding {k}"] = sentence
    return found


def _own(layer: Layer) -> Mapping[str, str]:
    """Return what the metadata say of one field: meaning, flags and so on."""
    return {
        f"{OF_CHANNEL}{key}": as_text(value)
        for key, value in {"name": layer.name, **layer.attributes}.items()
        if key != LAYER
    }
