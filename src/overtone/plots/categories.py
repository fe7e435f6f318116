"""A map of categories, such as the status of a result, and its legend with shares."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.patches import Patch
from matplotlib.transforms import ScaledTranslation

from overtone.plots.curves import draw_flag_points
from overtone.plots.maps import draw_image
from overtone.plots.planes import plane_of
from overtone.plots.scales import category_scale
from overtone.plots.text import LABEL_SIZE, draw_empty, set_title, title_of
from overtone.report.shares import flag_shares, flags, format_share

PALETTE = ("#0072b2", "#e69f00", "#009e73", "#cc79a7", "#56b4e9", "#d55e00", "#7f7f7f")
_FLAG_COLOURS = {
    "determined": "#0072b2",
    "not determined by these data": "#b5b5b5",
    "answer depends on start": "#f0e442",
    "model does not fit": "#d55e00",
    "at bound": "#cc79a7",
    "not converged": "#000000",
    "missing data": "#ededed",
    "several solutions": "#e69f00",
    "no physical solution": "#6a3d9a",
    "no contact": "#009e73",
    "none": "#6a3d9a",
    "one": "#0072b2",
    "two": "#e69f00",
    "three or more": "#d55e00",
    "attractive": "#0072b2",
    "undetermined": "#b5b5b5",
    "repulsive": "#d55e00",
}
_BELOW_LABELS = 0.45


def draw_flags(
    axes: Axes,
    array: xr.DataArray,
    *,
    title: str | None = None,
    legend_axes: Axes | None = None,
    colours: Mapping[str, str] | None = None,
) -> None:
    """Draw a categorical map with the share of pixels of each category in its legend.

    Parameters
    ----------
    axes : Axes
        Where to draw.
    array : DataArray
        Integers with ``flag_values`` and ``flag_meanings``, such as ``status`` and ``regime``.
    title : str, optional
        Short; the name of the quantity where not given.
    legend_axes : Axes, optional
        A cell that the legend has for itself; below the map where not given.
    colours : mapping of str to str, optional
        Colour of a meaning, where it is to have one of its own.
    """
    plane, note = plane_of(array)
    set_title(axes, (title_of(array) if title is None else title) + note)
    known = flags(array)
    own = {**_FLAG_COLOURS, **(colours or {})}
    shades = [own.get(meaning, PALETTE[i % len(PALETTE)]) for i, meaning in enumerate(known.values())]
    codes = np.full(plane.shape, math.nan)
    for i, flag in enumerate(known):
        codes[plane.values == flag] = i
    if not known or not np.isfinite(codes).any():
        draw_empty(axes)
        if legend_axes is not None:
            legend_axes.set_axis_off()
        return
    if plane.ndim < 2:
        draw_flag_points(axes, plane, codes, shades)
    else:
        draw_image(axes, plane, codes, category_scale(shades))
    _draw_legend(axes, array, shades, legend_axes)


def _draw_legend(axes: Axes, array: xr.DataArray, colours: list[str], legend_axes: Axes | None) -> None:
    shares = flag_shares(array)
    handles = [
        Patch(facecolor=colour, edgecolor="0.4", label=f"{format_share(share)}  {meaning}")
        for colour, (meaning, share) in zip(colours, shares.items(), strict=True)
        if share > 0.0 or meaning == "determined" or len(shares) <= 3
    ]
    if legend_axes is None:
        # In inches: the labels of the axis above the legend do not shrink with a flat map.
        below = ScaledTranslation(0.0, -_BELOW_LABELS, axes.figure.dpi_scale_trans)
        legend = axes.legend(
            handles=handles,
            loc="upper left",
            bbox_to_anchor=(0.0, 0.0),
            bbox_transform=axes.transAxes + below,
            borderaxespad=0.0,
            borderpad=0.0,
            frameon=False,
            fontsize=LABEL_SIZE,
        )
    else:
        legend_axes.set_axis_off()
        legend = legend_axes.legend(
            handles=handles, loc="center left", frameon=False, fontsize=LABEL_SIZE, borderaxespad=0
        )
    for text in legend.get_texts():
        text.set_parse_math(False)  # a name of a sample is no formula
