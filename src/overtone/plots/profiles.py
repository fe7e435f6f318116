"""Properties along a line of a map: the pixel with its phase, the pixel alone, and the truth where it is known."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.legend import Legend
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from overtone.plots.legends import legend_below
from overtone.plots.phases import as_text, phase_colour
from overtone.plots.planes import abscissa
from overtone.plots.scales import Array, Limits
from overtone.plots.sheet import Sheet
from overtone.plots.text import LABEL_SIZE, TICK_SIZE, draw_empty, label_of, set_title
from overtone.plots.ticks import linear_ticks, log_ticks, room_for_ticks
from overtone.report.results import PROPERTIES
from overtone.report.shares import flags
from overtone.units import display_unit

_WIDTH, _RATIO = 8.0, 0.3
_LOGARITHMIC_FROM = 3.0  # between the ends of what is shown
_BEYOND = 30.0  # factor beyond the pooled intervals up to which those of single pixels are shown
_STRIP = 0.045  # of the height of a panel, for the colours of the phases
_MARGIN = 0.06
_DOT, _INK = 2.8, 200.0  # size of a dot [points] where there are few, and of all of them together
_STYLES: dict[str, dict[str, Any]] = {
    "pooled": {"color": "#0072b2", "linewidth": 1.2},
    "unpooled": {"color": "0.6", "linewidth": 0.9},
    "truth": {"color": "#d55e00", "linewidth": 1.3, "linestyle": "--"},
}
_BANDS: dict[str, dict[str, Any]] = {
    "pooled": {"color": "#56b4e9", "alpha": 0.6},
    "unpooled": {"color": "0.9"},
}


def profile_figure(profile: xr.Dataset, names: Sequence[str], heading: str = "") -> Figure:
    """Return every property along a line with its 90 % bands, a panel for each, over the phases of its pixels.

    Parameters
    ----------
    profile : Dataset
        On one dimension with coordinates [m]: ``phase``, for every name ``<name>`` (NaN unless determined),
        ``<name>_unscreened``, ``<name>_lower`` and ``<name>_upper``, and as far as known ``<name>_unpooled`` with its
        ends, ``<name>_truth`` and ``height``.
    names : sequence of str
        Properties, in the order of the panels.
    heading : str, optional
        What stands above the panels.
    """
    panels = [*(["height"] if "height" in profile else []), *names]
    sheet = Sheet.new(max(len(panels), 1), 1, _WIDTH, _RATIO)
    if not panels:
        draw_empty(sheet.cells[0])
        return sheet.lay_out(heading)
    for axes, name in zip(sheet.cells, panels, strict=True):
        if name == "height":
            _draw_height(axes, profile)
        else:
            _draw_property(axes, profile, name)
    return sheet.lay_out(heading, _legend(sheet.figure, profile, names))


def _draw_height(axes: Axes, profile: xr.Dataset) -> None:
    set_title(axes, "topography")
    values = np.asarray(profile["height"].values, dtype=float)
    if not np.isfinite(values).any():
        draw_empty(axes)
        return
    low, high = float(np.nanmin(values)), float(np.nanmax(values))
    unit = display_unit(max(abs(low), abs(high)), "m")
    axes.plot(_position(profile)[0], values * unit.factor, color="0.25", linewidth=1.2)
    _finish(axes, profile, (low * unit.factor, high * unit.factor), logarithmic=False)
    axes.set_ylabel(label_of(profile["height"], unit.label), fontsize=LABEL_SIZE)


def _draw_property(axes: Axes, profile: xr.Dataset, name: str) -> None:
    set_title(axes, PROPERTIES.get(name, name))
    pooled = _band(profile, name, "")
    alone = _band(profile, name, "_unpooled")
    true = _values(profile, f"{name}_truth")
    shown = np.concatenate([part for part in (*pooled.values(), true) if part is not None])
    if not np.isfinite(shown).any():
        draw_empty(axes)
        return
    limits, logarithmic = _limits(shown, [part for part in alone.values() if part is not None])
    unit = display_unit(float(np.nanmedian(np.abs(shown))), str(profile[f"{name}_lower"].attrs["units"]))
    position, _ = _position(profile)
    for order, (kind, band) in enumerate((("unpooled", alone), ("pooled", pooled))):
        lower, middle, upper = (band[part] for part in ("lower", "middle", "upper"))
        if lower is not None and upper is not None:
            axes.fill_between(
                position,
                lower * unit.factor,
                upper * unit.factor,
                step="mid",
                linewidth=0.0,
                zorder=order,
                **_BANDS[kind],
            )
        if middle is not None:
            axes.plot(position, middle * unit.factor, zorder=2 + order, **_STYLES[kind])
    sure = _values(profile, name)
    if sure is not None:
        size = float(np.clip(_INK / position.size, 0.9, _DOT))
        axes.plot(
            position, sure * unit.factor, linestyle="", marker="o", markersize=size, color="#0072b2", zorder=5
        )
    if true is not None:
        axes.plot(position, true * unit.factor, drawstyle="steps-mid", zorder=6, **_STYLES["truth"])
    low, high = limits
    _finish(axes, profile, (low * unit.factor, high * unit.factor), logarithmic=logarithmic)
    axes.set_ylabel(label_of(profile[f"{name}_lower"], unit.label), fontsize=LABEL_SIZE)


def _band(profile: xr.Dataset, name: str, kind: str) -> dict[str, Array | None]:
    middle = f"{name}{kind}" if kind else f"{name}_unscreened"
    return {
        "middle": _values(profile, middle),
        "lower": _values(profile, f"{name}{kind}_lower"),
        "upper": _values(profile, f"{name}{kind}_upper"),
    }


def _values(profile: xr.Dataset, name: str) -> Array | None:
    return np.asarray(profile[name].values, dtype=float) if name in profile else None


def _limits(shown: Array, alone: Sequence[Array]) -> tuple[Limits, bool]:
    """Return the limits of all that is pooled and of what fits of the rest, and whether their scale is logarithmic."""
    known = shown[np.isfinite(shown)]
    low, high = float(known.min()), float(known.max())
    rest = np.concatenate([part[np.isfinite(part)] for part in alone]) if alone else np.empty(0)
    logarithmic = low > 0.0 and (high > _LOGARITHMIC_FROM * low)
    if rest.size:
        inner = np.percentile(rest, [2.0, 98.0])
        reach = (low / _BEYOND, high * _BEYOND) if low > 0.0 else (low - 2 * (high - low), 3 * high - 2 * low)
        low, high = min(low, max(float(inner[0]), reach[0])), max(high, min(float(inner[1]), reach[1]))
        logarithmic = low > 0.0 and high > _LOGARITHMIC_FROM * low
    return (low, high), logarithmic


def _finish(axes: Axes, profile: xr.Dataset, limits: Limits, *, logarithmic: bool) -> None:
    """Set limits and ticks, and draw the phases of the pixels along the foot of the panel."""
    low, high = limits
    if logarithmic:
        axes.set_yscale("log", nonpositive="mask")
        factor = (high / low) ** _MARGIN
        low, high = low / factor ** (1.0 + 1.6 * _STRIP / _MARGIN), high * factor
    else:
        side = (_MARGIN * (high - low)) or 0.1 * abs(high) or 1.0
        low, high = low - side * (1.0 + 1.6 * _STRIP / _MARGIN), high + side
    axes.set_ylim(low, high)
    position, label = _position(profile)
    half = 0.5 * abs(float(position[-1] - position[0])) / max(position.size - 1, 1) or 0.5
    axes.set_xlim(float(position.min()) - half, float(position.max()) + half)
    _, codes = _phases(profile)
    edges = np.flatnonzero(np.diff(codes)) + 1
    for first, last in zip([0, *edges], [*edges, codes.size], strict=True):
        ends = sorted((float(position[first]), float(position[last - 1])))
        colour = phase_colour(int(codes[first]))
        axes.axvspan(ends[0] - half, ends[1] + half, 0.0, _STRIP, color=colour, linewidth=0.0, zorder=4)
    x_room, y_room = room_for_ticks(axes, None)
    linear_ticks(*axes.get_xlim(), min(x_room, 8)).put_on(axes.xaxis)
    ticks = log_ticks(low, high, y_room) if logarithmic else linear_ticks(low, high, max(2, min(y_room, 5)))
    ticks.put_on(axes.yaxis)
    axes.set_xlabel(label, fontsize=LABEL_SIZE)
    axes.tick_params(labelsize=TICK_SIZE)


def _position(profile: xr.Dataset) -> tuple[Array, str]:
    return abscissa(profile["phase"])


def _phases(profile: xr.Dataset) -> tuple[dict[int, str], np.ndarray]:
    return flags(profile["phase"]), np.asarray(profile["phase"].values, dtype=int)


def _legend(figure: Figure, profile: xr.Dataset, names: Sequence[str]) -> Legend:
    handles: list[Line2D | Patch] = [
        Line2D([], [], **_STYLES["pooled"], marker="o", markersize=_DOT, label="pooled, determined"),
        Line2D([], [], **_STYLES["pooled"], label="pooled, not determined"),
        Patch(**_BANDS["pooled"], label="90 %, pooled"),
    ]
    if any(f"{name}_unpooled" in profile for name in names):
        handles += [
            Line2D([], [], **_STYLES["unpooled"], label="pixel alone"),
            Patch(**_BANDS["unpooled"], label="90 %, pixel alone"),
        ]
    if any(f"{name}_truth" in profile for name in names):
        handles.append(Line2D([], [], **_STYLES["truth"], label="truth"))
    meanings, codes = _phases(profile)
    handles += [
        Patch(facecolor=phase_colour(flag), label=as_text(meaning))
        for flag, meaning in meanings.items()
        if (codes == flag).any()
    ]
    return legend_below(figure, handles)
