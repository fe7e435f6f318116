"""Posterior predictive check: each force harmonic of a phase against what the model predicts from the others."""

from __future__ import annotations

from typing import Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from overtone.plots.legends import legend_below
from overtone.plots.phases import as_text, phase_colour
from overtone.plots.scales import Array, Mask
from overtone.plots.sheet import Sheet
from overtone.plots.text import LABEL_SIZE, TICK_SIZE, draw_empty, draw_words, set_title
from overtone.plots.ticks import linear_ticks, room_for_ticks
from overtone.units import format_quantity

_COLUMNS = 2
_COLUMN_WIDTH = 5.0
_INCHES_A_ROW, _FRAME = 0.24, 0.35
_HALF = 1.645  # standard deviations from the middle to an end of a 90 % interval
_FARTHEST = 8.0  # of them; what lies beyond stands at the edge, as an arrow
_BAND, _OFF = "0.85", "#d55e00"
_SUBSCRIPTS = str.maketrans("0123456789", "₀₁₂₃₄₅₆₇₈₉")


def prediction_figure(result: xr.Dataset, heading: str = "") -> Figure:
    """Return what was observed of each material over the interval predicted for it, in standard deviations.

    Parameters
    ----------
    result : Dataset
        With ``check_observed``, ``check_lower`` and ``check_upper`` (material, row) [N].
    heading : str, optional
        What stands above the panels.
    """
    names = [str(name) for name in result["material"].values]
    rows = result.sizes["row"]
    ratio = (_INCHES_A_ROW * rows + _FRAME) / (0.68 * _COLUMN_WIDTH)
    sheet = Sheet.new(max(len(names), 1), _COLUMNS, _COLUMN_WIDTH, ratio)
    if not names:
        draw_empty(sheet.cells[0])
        return sheet.lay_out(heading)
    away: Array = np.abs(standardised(result).values)
    farthest = float(away[np.isfinite(away)].max(initial=0.0))
    reach = float(np.clip(1.15 * farthest, 3.0, _FARTHEST))  # one for all, so that they compare
    for k, (axes, name) in enumerate(zip(sheet.cells, names, strict=True)):
        _draw(axes, result.isel(material=k), as_text(name), phase_colour(k), reach)
    handles: list[Line2D | Patch] = [
        Patch(facecolor=_BAND, label="predicted from the other harmonics, 90 %"),
        Line2D([], [], linestyle="", marker="o", color="0.3", label="observed, within"),
        Line2D([], [], linestyle="", marker="D", color=_OFF, label="observed, outside"),
    ]
    legend = legend_below(sheet.figure, handles, 3)
    return sheet.lay_out(heading, legend)


def standardised(result: xr.Dataset) -> xr.DataArray:
    """Return how many standard deviations of its prediction each harmonic lies from the middle of it.

    NaN where nothing was predicted. The standard deviation is that of a normal with the same 90 % interval.
    """
    middle = 0.5 * (result["check_lower"] + result["check_upper"])
    deviation = (result["check_upper"] - result["check_lower"]) / (2.0 * _HALF)
    found = (result["check_observed"] - middle) / deviation.where(deviation > 0.0)
    return found.rename("check_standardised").assign_attrs(units="1")


def _draw(axes: Axes, material: xr.Dataset, name: str, colour: str, reach: float) -> None:
    away: Array = np.asarray(standardised(material).values, dtype=float)
    set_title(axes, f"{name}{_misfit(material)}")
    known = np.isfinite(away)
    if not known.any():
        draw_words(axes, "nothing was predicted")
        return
    height = np.arange(away.size)[::-1].astype(float)
    axes.barh(height[known], 2.0 * _HALF, left=-_HALF, height=0.62, color=_BAND, zorder=1)
    axes.axvline(0.0, color="0.45", linewidth=0.8, zorder=2)
    outside = np.abs(away) > _HALF
    styles: tuple[tuple[Mask, dict[str, Any]], ...] = (
        (known & ~outside, {"marker": "o", "color": colour, "markersize": 6.0}),
        (known & outside, {"marker": "D", "color": _OFF, "markersize": 6.0}),
    )
    for chosen, style in styles:
        inside = np.clip(away[chosen], -0.97 * reach, 0.97 * reach)
        axes.plot(inside, height[chosen], linestyle="", zorder=3, **style)
    for value, y in zip(away, height, strict=True):
        if abs(value) > reach:
            side = np.sign(value)
            axes.text(
                side * 0.9 * reach,
                y,
                f"{value:.0f}",
                ha="right" if side > 0 else "left",
                va="center",
                fontsize=TICK_SIZE,
                color=_OFF,
            )
    axes.set_xlim(-reach, reach)
    axes.set_ylim(-0.6, away.size - 0.4)
    x_room, _ = room_for_ticks(axes, None)
    linear_ticks(-reach, reach, min(x_room, 8)).put_on(axes.xaxis)
    axes.set_yticks(height, [_row_label(material, k) for k in range(away.size)])
    axes.set_xlabel("observed less predicted, in its standard deviations", fontsize=LABEL_SIZE)
    axes.tick_params(labelsize=TICK_SIZE)
    axes.tick_params(axis="y", length=0.0)


def _row_label(material: xr.Dataset, k: int) -> str:
    name = str(material["row"].values[k]).replace("_", "").translate(_SUBSCRIPTS)
    value = float(material["check_observed"].values[k])
    return f"{name}  {format_quantity(value, 'N')}".replace("-", "−") if np.isfinite(value) else name


def _misfit(material: xr.Dataset) -> str:
    if "material_misfit_probability" not in material:
        return ""
    chance = float(material["material_misfit_probability"])
    if not np.isfinite(chance):
        return ""
    misfit = float(material["material_misfit"]) if "material_misfit" in material else float("nan")
    first = f"χ² = {misfit:.3g}, " if np.isfinite(misfit) else ""
    return f": {first}p = {chance:.2g}"
