"""Properties with both ends of their intervals, over the relief of the topography."""

from __future__ import annotations

import xarray as xr
from matplotlib.figure import Figure

from overtone.plots.intervals import interval_figure
from overtone.plots.relief import draw_relief


def property_maps_figure(result: xr.Dataset, height: xr.DataArray | None = None, heading: str = "") -> Figure:
    """Return median, lower and upper end of every property, a row and a scale for each, over shaded relief.

    Parameters
    ----------
    result : Dataset
        Result of `overtone.map_properties` with intervals.
    height : DataArray, optional
        Topography [m] of the same pixels; flat maps without it.
    heading : str, optional
        What stands above the maps.
    """
    figure = interval_figure(heading, result)
    for axes in figure.axes:
        if height is not None and axes.images:
            draw_relief(axes, height)
    return figure
