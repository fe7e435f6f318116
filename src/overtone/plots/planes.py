"""What of an array can be drawn on a plane, and where it lies there."""

from __future__ import annotations

from collections.abc import Hashable
from dataclasses import dataclass

import numpy as np
import xarray as xr

from overtone.plots.scales import Array
from overtone.plots.text import with_unit
from overtone.units import display_unit


def plane_of(array: xr.DataArray) -> tuple[xr.DataArray, str]:
    """Return what can be drawn on one plane, and a note where that is not all of it."""
    kept: list[Hashable] = ["y", "x"] if {"y", "x"} <= set(array.dims) else list(array.dims)[-2:]
    leading = [dim for dim in array.dims if dim not in kept]
    notes = [f", {dim} 1 of {array.sizes[dim]}" for dim in leading if array.sizes[dim] > 1]
    plane = array.isel(dict.fromkeys(leading, 0), drop=True).transpose(*kept)
    return plane, "".join(notes)


@dataclass(frozen=True)
class Frame:
    """Where an image lies: (left, right, bottom, top) of its outer edges, row 0 at the top."""

    extent: tuple[float, float, float, float]
    x_label: str
    y_label: str
    equal: bool
    pixels: bool = False

    @property
    def ratio(self) -> float | None:
        """Height over width, None where the image fills whatever room it gets."""
        left, right, bottom, top = self.extent
        return abs((top - bottom) / (right - left)) if self.equal else None


def frame_of(plane: xr.DataArray) -> Frame:
    """Return where the image of a plane lies: in units of length where it has coordinates, else in pixels."""
    rows, columns = plane.dims
    is_map = {rows, columns} == {"y", "x"}
    y, x = _coordinate(plane, rows), _coordinate(plane, columns)
    step_y, step_x = _step(y), _step(x)
    if is_map:  # a map of one row or column takes the pixel size of the other direction
        step_x, step_y = step_x or abs(step_y), step_y or -abs(step_x)
    if y is None or x is None or step_x == 0.0 or step_y == 0.0:
        height, width = plane.shape
        extent = (-0.5, width - 0.5, height - 0.5, -0.5)
        return Frame(
            extent, f"{columns} [pixel]", f"{rows} [pixel]", _is_drawable(is_map, height, width), pixels=True
        )
    left, right = x[0] - step_x / 2.0, x[-1] + step_x / 2.0
    top, bottom = y[0] - step_y / 2.0, y[-1] + step_y / 2.0
    across, along = abs(bottom - top), abs(right - left)
    common = max(across, along) if is_map else 0.0
    x_unit = display_unit(common or along, _coordinate_unit(plane, columns))
    y_unit = display_unit(common or across, _coordinate_unit(plane, rows))
    return Frame(
        (left * x_unit.factor, right * x_unit.factor, bottom * y_unit.factor, top * y_unit.factor),
        with_unit(str(columns), x_unit.label),
        with_unit(str(rows), y_unit.label),
        _is_drawable(is_map, across, along),
    )


def ratio_of(array: xr.DataArray | None) -> float:
    """Return height over width of a map as it will be drawn, within what fits a page."""
    if array is None:
        return 1.0
    plane, _ = plane_of(array)
    ratio = frame_of(plane).ratio if plane.ndim == 2 else None
    return 0.8 if ratio is None else min(max(ratio, 0.2), 1.6)


def abscissa(line: xr.DataArray) -> tuple[Array, str]:
    """Return what a curve is drawn against, in the unit that its label names."""
    if line.ndim == 0:
        return np.zeros(1), ""
    dim = line.dims[0]
    coordinate = _coordinate(line, dim)
    if coordinate is None:
        return np.arange(line.size, dtype=float), str(dim)
    unit = display_unit(float(np.abs(coordinate).max(initial=0.0)), _coordinate_unit(line, dim))
    return coordinate * unit.factor, with_unit(str(dim), unit.label)


def _is_drawable(is_map: bool, height: float, width: float) -> bool:
    """Return whether equal scales leave something to see: a single scan line would be a hairline."""
    return is_map and 0.05 < height / width < 20.0


def _coordinate(array: xr.DataArray, dim: Hashable) -> Array | None:
    if dim not in array.coords or not np.issubdtype(array.coords[dim].dtype, np.number):
        return None
    values = np.asarray(array.coords[dim].values, dtype=float)
    return values if values.shape == (array.sizes[dim],) and np.isfinite(values).all() else None


def _coordinate_unit(array: xr.DataArray, dim: Hashable) -> str:
    return str(array.coords[dim].attrs.get("units", "m" if dim in ("x", "y", "z") else "1"))


def _step(coordinate: Array | None) -> float:
    if coordinate is None or coordinate.size < 2:
        return 0.0
    return float(coordinate[-1] - coordinate[0]) / (coordinate.size - 1)
