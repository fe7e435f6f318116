"""Medians of the materials at several set-points of one area: a property of a material does not depend on them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from overtone.plots.legends import legend_below
from overtone.plots.phases import MARKERS, as_text, phase_colour
from overtone.plots.sheet import Sheet
from overtone.plots.text import LABEL_SIZE, TICK_SIZE, draw_empty, label_of, set_title
from overtone.plots.ticks import linear_ticks, log_ticks, room_for_ticks
from overtone.report.results import PROPERTIES
from overtone.units import display_unit

_COLUMNS = 2
_COLUMN_WIDTH = 4.6
_RATIO = 0.75
_LOGARITHMIC_FROM = 3.0
_MARGIN = 0.08
_HALF = 1.645  # standard deviations from the middle to an end of a 90 % interval
_APART = 0.012  # of the width of a panel, between the bars of two materials


def setpoint_figure(medians: xr.Dataset, names: Sequence[str], heading: str = "") -> Figure:
    """Return the median of every material against the set-point, with its 90 % interval, a panel a property.

    Parameters
    ----------
    medians : Dataset
        On (setpoint, material), of every name ``<name>``, ``<name>_lower``, ``<name>_upper`` [SI] and the standard
        deviation ``<name>_statistical`` of its logarithm; NaN where a material was not found at a set-point.
    names : sequence of str
        Properties, in the order of the panels.
    heading : str, optional
        What stands above the panels.
    """
    sheet = Sheet.new(max(len(names), 1), _COLUMNS, _COLUMN_WIDTH, _RATIO)
    if not names or not medians.sizes["material"]:
        for axes in sheet.cells:
            draw_empty(axes)
        return sheet.lay_out(heading)
    for axes, name in zip(sheet.cells, names, strict=True):
        _draw(axes, medians, name)
    handles = [
        Line2D([], [], color=phase_colour(k), marker=MARKERS[k % len(MARKERS)], label=as_text(str(material)))
        for k, material in enumerate(medians["material"].values)
    ]
    handles += [
        Line2D([], [], color="0.3", linewidth=1.0, label="90 % interval"),
        Line2D([], [], color="0.3", linewidth=3.4, label="part of noise and scatter"),
    ]
    legend = legend_below(sheet.figure, handles, 4)
    return sheet.lay_out(heading, legend)


def _draw(axes: Axes, medians: xr.Dataset, name: str) -> None:
    set_title(axes, PROPERTIES.get(name, name))
    array = medians[name].transpose("setpoint", "material")
    middle, lower, upper = (
        np.asarray(medians[part].transpose("setpoint", "material").values, dtype=float)
        for part in (name, f"{name}_lower", f"{name}_upper")
    )
    known = np.isfinite(middle)
    if not known.any():
        draw_empty(axes)
        return
    every = np.concatenate([part[np.isfinite(part)] for part in (middle, lower, upper)])
    low, high = float(every.min()), float(every.max())
    unit = display_unit(float(np.median(middle[known])), str(array.attrs.get("units", "1")))
    setpoint = np.asarray(medians["setpoint"].values, dtype=float)
    left, right = float(setpoint.min()), float(setpoint.max())
    side = 0.12 * (right - left) or 0.1 * right
    part = medians.get(f"{name}_statistical")
    inner = None if part is None else np.exp(_HALF * part.transpose("setpoint", "material").values)
    count = array.sizes["material"]
    for k in range(count):
        at = setpoint + (k - 0.5 * (count - 1)) * _APART * (right - left + 2.0 * side)
        colour = phase_colour(k)
        m, a, b = (values[:, k] * unit.factor for values in (middle, lower, upper))
        axes.vlines(at, a, b, color=colour, linewidth=1.0, zorder=2)
        if inner is not None:
            axes.vlines(at, m / inner[:, k], m * inner[:, k], color=colour, linewidth=3.4, zorder=2)
        axes.plot(
            at,
            m,
            color=colour,
            marker=MARKERS[k % len(MARKERS)],
            markersize=5.5,
            markeredgecolor="white",
            markeredgewidth=0.7,
            linewidth=0.9,
            zorder=3,
        )
    low, high = low * unit.factor, high * unit.factor
    logarithmic = low > 0.0 and high > _LOGARITHMIC_FROM * low
    if logarithmic:
        axes.set_yscale("log", nonpositive="mask")
        factor = (high / low) ** _MARGIN
        low, high = low / factor, high * factor
    else:
        margin = _MARGIN * (high - low) or 0.1 * abs(high) or 1.0
        low, high = low - margin, high + margin
    axes.set_xlim(left - side, right + side)
    axes.set_ylim(low, high)
    x_room, y_room = room_for_ticks(axes, None)
    linear_ticks(left - side, right + side, min(x_room, 6)).put_on(axes.xaxis)
    ticks = log_ticks(low, high, y_room) if logarithmic else linear_ticks(low, high, min(y_room, 6))
    ticks.put_on(axes.yaxis)
    axes.set_xlabel(r"set-point $A_1/A_{1,\mathrm{far}}$", fontsize=LABEL_SIZE)
    axes.set_ylabel(label_of(array, unit.label), fontsize=LABEL_SIZE)
    axes.tick_params(labelsize=TICK_SIZE)
