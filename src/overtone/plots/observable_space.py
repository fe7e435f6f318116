"""Pixels in the space of what was measured, coloured by phase: what the data tell apart before any contact model."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from overtone.plots.phases import codes_of, phase_colour, phase_legend
from overtone.plots.scales import Array
from overtone.plots.sheet import Sheet
from overtone.plots.text import LABEL_SIZE, TICK_SIZE, draw_empty, set_title, with_unit
from overtone.plots.ticks import linear_ticks, room_for_ticks
from overtone.units import display_unit

_COLUMNS = 2
_COLUMN_WIDTH = 5.0
_RATIO = 0.8
_OUTSIDE = 0.1  # percent on either side that may lie beyond the frame
_MARGIN = 0.06
_MOST_VECTORS = 2000  # beyond, points are a picture within the vector files
_INK = 6.0e4  # square points of all markers together

_Codes = npt.NDArray[np.int_]


@dataclass(frozen=True)
class Axis:
    """What one axis of a scatter shows: values of the pixels in SI units, with symbol and unit."""

    name: str
    symbol: str
    unit: str
    values: Array


@dataclass(frozen=True)
class Scatter:
    """One panel: what it shows in words, its abscissa and its ordinate."""

    title: str
    across: Axis
    up: Axis


def space_figure(scatters: Sequence[Scatter], phase: xr.DataArray, heading: str = "") -> Figure:
    """Return scatters of pairs of observables or force harmonics, each pixel in the colour of its phase.

    Parameters
    ----------
    scatters : sequence of Scatter
        On the pixels of the phase.
    phase : DataArray
        Numbers of the phases, -1 for none, with ``flag_values`` and ``flag_meanings``.
    heading : str, optional
        What stands above the panels.
    """
    codes = codes_of(phase)
    # mixed, so that no phase hides another; those of none below all others
    order = np.random.default_rng(0).permutation(codes.size)
    order = order[np.argsort(codes[order] >= 0, kind="stable")]
    sheet = Sheet.new(max(len(scatters), 1), _COLUMNS, _COLUMN_WIDTH, _RATIO)
    for axes, scatter in zip(sheet.cells, scatters, strict=False):
        _draw(axes, scatter, codes, order)
    if not scatters:
        draw_empty(sheet.cells[0])
        return sheet.lay_out(heading)
    return sheet.lay_out(heading, phase_legend(sheet.figure, phase))


def _draw(axes: Axes, scatter: Scatter, codes: _Codes, order: _Codes) -> None:
    across, up = scatter.across, scatter.up
    set_title(axes, scatter.title)
    usable = np.isfinite(across.values[order]) & np.isfinite(up.values[order])
    chosen = order[usable]
    if not chosen.size:
        draw_empty(axes)
        return
    ends = []
    scaled = []
    for axis in (across, up):
        values = axis.values[chosen]
        low, high = (float(v) for v in np.percentile(values, [_OUTSIDE, 100.0 - _OUTSIDE]))
        side = _MARGIN * (high - low) or 0.05 * abs(high) or 1.0
        unit = display_unit(max(abs(low), abs(high)), axis.unit)
        scaled.append(values * unit.factor)
        ends.append(((low - side) * unit.factor, (high + side) * unit.factor, unit.label))
    axes.scatter(
        scaled[0],
        scaled[1],
        s=float(np.clip(_INK / chosen.size, 1.5, 14.0)),
        c=[phase_colour(int(code)) for code in codes[chosen]],
        alpha=0.55,
        linewidths=0.0,
        rasterized=chosen.size > _MOST_VECTORS,
    )
    (left, right, x_unit), (bottom, top, y_unit) = ends
    axes.set_xlim(left, right)
    axes.set_ylim(bottom, top)
    x_room, y_room = room_for_ticks(axes, None)
    linear_ticks(left, right, min(x_room, 6)).put_on(axes.xaxis)
    linear_ticks(bottom, top, min(y_room, 6)).put_on(axes.yaxis)
    axes.set_xlabel(with_unit(across.symbol, x_unit), fontsize=LABEL_SIZE)
    axes.set_ylabel(with_unit(up.symbol, y_unit), fontsize=LABEL_SIZE)
    axes.tick_params(labelsize=TICK_SIZE)
