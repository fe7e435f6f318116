"""The maps or curves of a dataset as one picture, with units and colour bars."""

from __future__ import annotations

import re
import warnings
from pathlib import Path

import xarray as xr

from overtone.errors import ChannelWarning, ObservablesError
from overtone.io.atomic import atomic_path
from overtone.io.layers import Layer, dims_of, layers_of
from overtone.quantities import quantity

_COLUMNS, _COLUMN_WIDTH = 3, 3.4
_MOST = 24
_VARIANT = re.compile(r".+_(?:lower|upper|unscreened|unpooled|solutions|unpooled_lower|unpooled_upper)")


def write(dataset: xr.Dataset, path: str | Path) -> None:
    """Draw every map of a dataset on one sheet of 300 dots per inch; of curves, every curve.

    Flags such as ``status`` have their shares in a legend. Where there are more than two dozen, the variants of
    properties (ends of intervals, values before screening) and numbers about the inversion are left out.

    Parameters
    ----------
    dataset : Dataset
        With maps over ``y`` and ``x``, or curves over one dimension.
    path : str or Path
        An existing file is replaced once the new one is complete.

    Raises
    ------
    ObservablesError
        If the dataset holds neither maps nor curves, or too many for a sheet.
    FileFormatError
        If the file cannot be written.

    Warns
    -----
    ChannelWarning
        If variables are left out.
    """
    from overtone.plots.categories import draw_flags
    from overtone.plots.maps import draw_map
    from overtone.plots.planes import ratio_of
    from overtone.plots.sheet import Sheet
    from overtone.plots.text import title_of
    from overtone.report.pictures import picture_bytes

    dims = dims_of(dataset)
    layers, left_out = layers_of(dataset, dims)
    if len(layers) > _MOST:
        leading = [layer for layer in layers if _is_leading(layer)]
        left_out += dict.fromkeys(layer.name for layer in layers if layer not in leading)
        layers = leading
    if not 0 < len(layers) <= _MOST:
        raise ObservablesError(
            "the dataset does not fit on one picture",
            expected=f"at most {_MOST} maps or curves",
            got=f"{len(layers)} of {len(dataset.data_vars)} variables",
            hint="fewer variables, such as --variables A1,phi1",
        )
    if left_out:
        warnings.warn(f"left out of the picture: {', '.join(left_out)}", ChannelWarning, stacklevel=3)
    coords = {name: array for name, array in dataset.coords.items() if set(array.dims) <= set(dims)}
    panels = []
    for layer in layers:
        array = xr.DataArray(layer.values, coords, dims, layer.name, dict(layer.attributes))
        title = " ".join(part for part in (title_of(array), layer.place, layer.direction) if part)
        panels.append((array, title))
    sheet = Sheet.new(len(panels), _COLUMNS, _COLUMN_WIDTH, ratio_of(panels[0][0]))
    for axes, (array, title) in zip(sheet.cells, panels, strict=True):
        if "flag_values" in array.attrs and array.dtype.kind in "iu":
            draw_flags(axes, array, title=title)
        else:
            draw_map(axes, array.astype(float) if array.dtype.kind in "biu" else array, title=title)
    picture = picture_bytes(sheet.lay_out(), "png")
    with atomic_path(path) as temporary:
        temporary.write_bytes(picture)


def _is_leading(layer: Layer) -> bool:
    """Tell whether a layer is what was measured or found, and not what qualifies it."""
    record = quantity(layer.name)
    if layer.name in ("status", "phase"):
        return True
    return record is None or (record.kind != "quality" and not _VARIANT.fullmatch(layer.name))
