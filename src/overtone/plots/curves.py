"""What has one dimension only: a curve, or points of categories along it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import xarray as xr
from matplotlib.axes import Axes

from overtone.plots.planes import abscissa
from overtone.plots.scales import Array, Mask
from overtone.plots.text import LABEL_SIZE, TICK_SIZE
from overtone.plots.ticks import linear_ticks, log_ticks, room_for_ticks


def draw_curve(
    axes: Axes,
    line: xr.DataArray,
    values: Array,
    veil: Mask | None,
    label: str,
    *,
    logarithmic: bool,
    ends: tuple[Array, Array] | None = None,
) -> None:
    """Draw values along their dimension, open circles where they are not determined, with intervals as bars."""
    position, position_label = abscissa(line)
    values = np.atleast_1d(values)
    sure = np.ones(values.shape, bool) if veil is None else ~np.atleast_1d(veil)
    axes.plot(position, values, "-", color="0.75", linewidth=0.8, zorder=1)
    if (~sure).any():
        points = axes.plot(
            position[~sure], values[~sure], "o", markersize=3.5, mfc="none", mec="0.6", zorder=2
        )
        points[0].set_gid("undetermined")
    axes.plot(position[sure], values[sure], "o", markersize=3, color="#0072b2", zorder=3)
    if ends is not None:
        lower, upper = map(np.atleast_1d, ends)
        axes.vlines(
            position, lower, upper, color=np.where(sure, "#56b4e9", "0.8"), linewidth=1.2, zorder=0
        ).set_gid("interval")
    if logarithmic:
        axes.set_yscale("log", nonpositive="mask")
    low, high = axes.get_ylim()
    _, room = room_for_ticks(axes, None)
    (log_ticks(low, high, room) if logarithmic else linear_ticks(low, high, min(room, 6))).put_on(axes.yaxis)
    axes.set_ylabel(label, fontsize=LABEL_SIZE)
    _draw_abscissa(axes, position_label)


def draw_flag_points(axes: Axes, line: xr.DataArray, codes: Array, colours: Sequence[str]) -> None:
    """Draw codes along their dimension as points, a height and a colour for each; NaN is left out."""
    position, label = abscissa(line)
    codes = np.atleast_1d(codes)
    known = np.isfinite(codes)
    axes.scatter(position[known], codes[known], s=12, c=[colours[int(code)] for code in codes[known]])
    axes.set_yticks([])
    _draw_abscissa(axes, label)


def _draw_abscissa(axes: Axes, label: str) -> None:
    across, _ = room_for_ticks(axes, None)
    linear_ticks(*axes.get_xlim(), min(across, 6)).put_on(axes.xaxis)
    axes.set_xlabel(label, fontsize=LABEL_SIZE)
    axes.tick_params(labelsize=TICK_SIZE)
