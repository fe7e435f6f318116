"""A plan of an experiment: how wide the interval of the modulus will be over set-point and free amplitude."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import xarray as xr
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm, Normalize
from matplotlib.figure import Figure
from matplotlib.legend import Legend
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Rectangle

from overtone.planning.choice import Choice, elastic_of
from overtone.plots.categories import PALETTE
from overtone.plots.scales import MISSING_COLOUR, Array
from overtone.plots.sheet import Sheet
from overtone.plots.text import LABEL_SIZE, TICK_SIZE, label_of, set_title, with_unit
from overtone.plots.ticks import linear_ticks, log_ticks, room_for_ticks
from overtone.units import DisplayUnit, display_unit

_WIDTH, _RATIO = 4.0, 0.8
_MOST_COLUMNS = 3
_FACTORS = (1.0, 100.0)  # of the colours: beyond a hundred nothing is known
_CONTOURS = {2.0: "a factor of 2", 10.0: "a factor of 10: determined inside"}
_STYLES: dict[float, Any] = {2.0: "-", 10.0: "--"}
_NOT_HELD: dict[str, Any] = {"facecolor": "0.92", "edgecolor": "0.3", "hatch": "/////", "linewidth": 0.0}
_BISTABLE: dict[str, Any] = {
    "marker": "o",
    "color": "0.35",
    "markerfacecolor": "white",
    "markersize": 3.5,
    "markeredgewidth": 0.7,
}
_BEST = "#d55e00"
_POINTS: dict[str, dict[str, Any]] = {
    "held": {"marker": "o", "color": PALETTE[0], "markersize": 4.0},
    "bistable": {"marker": "o", "color": PALETTE[0], "markersize": 4.5, "markerfacecolor": "white"},
    "not held": {"marker": "x", "color": "0.6", "markersize": 4.5},
}
_FEW = 2  # points along an axis below which a map would be a stripe


def plan_figure(plan: xr.Dataset, choice: Choice | None = None, heading: str = "") -> Figure:
    """Return what every set-point and free amplitude will tell, a column a lever.

    Parameters
    ----------
    plan : Dataset
        Result of `overtone.plan_experiment`.
    choice : Choice, optional
        Of `overtone.planning.choice.best_choice`; marked by a star.
    heading : str, optional
        What stands above the panels.

    Returns
    -------
    Figure
        Upper row: upper over lower end of the 90 % interval of the elastic unknown, in colours, with contours at 2 and
        10; hatched where no feedback holds a repulsive state, dotted where a stable attractive state has the same
        set-point. Lower row: peak force. With a single set-point or a single free amplitude both become curves, with
        the median beside the interval.

    Raises
    ------
    ObservablesError
        If the dataset is no plan.
    """
    first = elastic_of(plan)
    along = [dim for dim in ("free_amplitude", "setpoint") if plan.sizes[dim] >= _FEW]
    levers = [str(name) for name in plan["lever"].values]
    columns = min(len(levers), _MOST_COLUMNS)
    # a block of columns is two rows: the second begins where the first is full
    blocks = [levers[k : k + columns] for k in range(0, len(levers), columns)]
    sheet = Sheet.new(2 * columns * len(blocks), columns, _WIDTH if columns > 1 else 1.3 * _WIDTH, _RATIO)
    force = _force_scale(plan)
    for b, block in enumerate(blocks):
        for k in range(columns):
            upper, lower = (sheet.cells[(2 * b + row) * columns + k] for row in (0, 1))
            if k >= len(block):
                upper.set_axis_off()
                lower.set_axis_off()
                continue
            of_lever = plan.sel(lever=block[k])
            mine = choice if choice is not None and choice.lever == block[k] else None
            prefix = f"{block[k]}: " if len(levers) > 1 else ""
            set_title(upper, f"{prefix}{first}, 90 % interval")
            set_title(lower, f"{prefix}peak force")
            if len(along) == 2:
                norm = LogNorm(*_FACTORS)
                _draw_map(upper, of_lever, "interval_factor", 1.0, norm, "upper / lower end", "viridis_r")
                _draw_contours(upper, of_lever)
                label = with_unit(r"$F_{\mathrm{max}}$", force[0].label)
                _draw_map(lower, of_lever, "peak_force", force[0].factor, force[1], label, "cividis")
                for axes in (upper, lower):
                    _mark_states(axes, of_lever)
                    _mark_best(axes, of_lever, mine)
            else:
                dim = along[0] if along else "setpoint"
                _draw_interval(upper, of_lever, first, dim, mine)
                _draw_curve(lower, of_lever, dim, force[0], mine)
    return sheet.lay_out(heading, _legend(sheet.figure, plan, choice, maps=len(along) == 2))


# --- maps -----------------------------------------------------------------------------------------


def _force_scale(plan: xr.Dataset) -> tuple[DisplayUnit, Normalize]:
    """Return unit and colours of the peak force, one for all levers."""
    values = plan["peak_force"].values
    known = values[np.isfinite(values)]
    high = float(known.max(initial=0.0)) or 1e-9
    unit = display_unit(high, "N")
    return unit, Normalize(0.0, high * unit.factor)


def _edges(values: Array) -> Array:
    """Return the borders between points of a rising grid, and beyond its ends."""
    middle = 0.5 * (values[1:] + values[:-1])
    return np.concatenate([[2 * values[0] - middle[0]], middle, [2 * values[-1] - middle[-1]]])


def _grid(plan: xr.Dataset) -> tuple[Array, Array, DisplayUnit]:
    """Return set-points, free amplitudes in a readable unit, and that unit."""
    A = plan["free_amplitude"].values
    unit = display_unit(float(A.max()), "m")
    return plan["setpoint"].values, A * unit.factor, unit


def _draw_map(
    axes: Axes, plan: xr.Dataset, name: str, factor: float, norm: Normalize, label: str, colours: str
) -> None:
    setpoints, amplitudes, unit = _grid(plan)
    values = plan[name].transpose("setpoint", "free_amplitude").values * factor
    mesh = axes.pcolormesh(
        _edges(amplitudes),
        _edges(setpoints),
        np.ma.masked_invalid(values),
        cmap=colormaps[colours].with_extremes(bad=MISSING_COLOUR),
        norm=norm,
    )
    axes.set_xlabel(with_unit(r"$A_{1\mathrm{far}}$", unit.label), fontsize=LABEL_SIZE)
    axes.set_ylabel(r"set-point $A_1/A_{1\mathrm{far}}$", fontsize=LABEL_SIZE)
    _put_ticks(axes)
    low, high = float(norm.vmin or 0.0), float(norm.vmax or 1.0)
    logarithmic = isinstance(norm, LogNorm)
    _, room = room_for_ticks(axes, None)
    ticks = log_ticks(low, high, room) if logarithmic else linear_ticks(low, high, min(room, 6))
    inset = axes.inset_axes((1.04, 0.0, 0.055, 1.0))
    inset.tick_params(labelsize=TICK_SIZE)
    extend: Any = "max" if bool((values[np.isfinite(values)] > high * (1.0 + 1e-9)).any()) else "neither"
    bar = axes.figure.colorbar(mesh, cax=inset, extend=extend, ticks=ticks.locator, format=ticks.formatter)
    bar.minorticks_off()
    bar.set_label(label, fontsize=LABEL_SIZE)


def _put_ticks(axes: Axes) -> None:
    across, beside = room_for_ticks(axes, None)
    linear_ticks(*axes.get_xlim(), min(across, 6)).put_on(axes.xaxis)
    linear_ticks(*axes.get_ylim(), min(beside, 6)).put_on(axes.yaxis)
    axes.tick_params(labelsize=TICK_SIZE)


def _draw_contours(axes: Axes, plan: xr.Dataset) -> None:
    """Draw where the interval spans a factor of 2 and of 10."""
    setpoints, amplitudes, _ = _grid(plan)
    factor = plan["interval_factor"].where(plan["stable"]).transpose("setpoint", "free_amplitude").values
    known = np.isfinite(factor)
    for level, style in _STYLES.items():
        if (factor[known] < level).any() and (factor[known] > level).any():
            # beyond the colours all is one: far values would pull the lines
            logarithm = np.ma.masked_invalid(np.log(np.minimum(factor, _FACTORS[1])))
            drawn = axes.contour(
                amplitudes,
                setpoints,
                logarithm,
                levels=[math.log(level)],
                colors="black",
                linestyles=style,
                linewidths=1.3,
            )
            drawn.set_gid(f"factor {level:g}")


def _mark_states(axes: Axes, plan: xr.Dataset) -> None:
    """Hatch cells that no feedback holds in a repulsive state, mark those with an attractive one beside it."""
    setpoints, amplitudes, _ = _grid(plan)
    x, y = _edges(amplitudes), _edges(setpoints)
    held = plan["stable"].transpose("setpoint", "free_amplitude").values
    for i, j in np.argwhere(~held):
        cell = Rectangle((x[j], y[i]), x[j + 1] - x[j], y[i + 1] - y[i], **_NOT_HELD)
        cell.set_gid("not held")
        axes.add_patch(cell)
    rows, columns = np.nonzero(plan["bistable"].transpose("setpoint", "free_amplitude").values)
    if rows.size:
        axes.plot(amplitudes[columns], setpoints[rows], linestyle="", **_BISTABLE)[0].set_gid("bistable")


def _mark_best(axes: Axes, plan: xr.Dataset, choice: Choice | None) -> None:
    if choice is None:
        return
    _, _, unit = _grid(plan)
    _star(axes, choice.free_amplitude * unit.factor, choice.setpoint)


def _star(axes: Axes, x: float, y: float) -> None:
    star = axes.plot(
        x, y, "*", color=_BEST, markeredgecolor="white", markersize=14.0, zorder=6, clip_on=False
    )
    star[0].set_gid("best")


# --- curves ---------------------------------------------------------------------------------------


def _abscissa(plan: xr.Dataset, dim: str) -> tuple[Array, str, float]:
    if dim == "setpoint":
        return plan["setpoint"].values, r"set-point $A_1/A_{1\mathrm{far}}$", 1.0
    _, amplitudes, unit = _grid(plan)
    return amplitudes, with_unit(r"$A_{1\mathrm{far}}$", unit.label), unit.factor


def _line(plan: xr.Dataset, name: str, dim: str) -> Array:
    """Return a variable along the only dimension that has more than one point."""
    other = "free_amplitude" if dim == "setpoint" else "setpoint"
    return np.asarray(plan[name].isel({other: 0}).values)


def _draw_interval(axes: Axes, plan: xr.Dataset, first: str, dim: str, choice: Choice | None) -> None:
    """Draw median and interval of the elastic unknown."""
    x, label, factor = _abscissa(plan, dim)
    low, middle, high = (_line(plan, f"{first}{v}", dim) for v in ("_lower", "_unscreened", "_upper"))
    held, two = (_line(plan, name, dim).astype(bool) for name in ("stable", "bistable"))
    known = np.isfinite(middle)
    unit = display_unit(float(np.median(middle[known])) if known.any() else 1.0, plan[first].attrs["units"])
    axes.set_yscale("log")
    for gid, shown in (("held", held & ~two), ("bistable", held & two), ("not held", ~held)):
        rows = np.flatnonzero(shown & known)
        errors = np.stack([middle[rows] - low[rows], high[rows] - middle[rows]]) * unit.factor
        bars = axes.errorbar(
            x[rows],
            middle[rows] * unit.factor,
            yerr=errors,
            capsize=2.5,
            linewidth=1.2,
            linestyle="",
            **_POINTS[gid],
        )
        bars.lines[0].set_gid(gid)
    if choice is not None:
        at = (choice.setpoint if dim == "setpoint" else choice.free_amplitude) * factor
        _star(axes, at, choice.median * unit.factor)
    axes.set_xlabel(label, fontsize=LABEL_SIZE)
    axes.set_ylabel(label_of(plan[first], unit.label), fontsize=LABEL_SIZE)
    across, beside = room_for_ticks(axes, None)
    linear_ticks(*axes.get_xlim(), min(across, 6)).put_on(axes.xaxis)
    log_ticks(*axes.get_ylim(), beside).put_on(axes.yaxis)
    axes.tick_params(labelsize=TICK_SIZE)


def _draw_curve(axes: Axes, plan: xr.Dataset, dim: str, unit: DisplayUnit, choice: Choice | None) -> None:
    x, label, _ = _abscissa(plan, dim)
    axes.plot(x, _line(plan, "peak_force", dim) * unit.factor, "o-", color=PALETTE[0], markersize=4.0)
    axes.set_xlabel(label, fontsize=LABEL_SIZE)
    axes.set_ylabel(with_unit(r"$F_{\mathrm{max}}$", unit.label), fontsize=LABEL_SIZE)
    _put_ticks(axes)


def _point(gid: str, text: str) -> Line2D:
    return Line2D([], [], linestyle="", label=text, **_POINTS[gid])


def _legend(figure: Figure, plan: xr.Dataset, choice: Choice | None, *, maps: bool) -> Legend | None:
    handles: list[Any] = []
    factor = plan["interval_factor"].where(plan["stable"]).values
    known = factor[np.isfinite(factor)]
    if maps:
        handles += [
            Line2D([], [], color="black", linestyle=_STYLES[level], linewidth=1.3, label=text)
            for level, text in _CONTOURS.items()
            if (known < level).any() and (known > level).any()
        ]
    if not bool(plan["stable"].all()):
        text = "no stable repulsive state"
        handles.append(Patch(**_NOT_HELD, label=text) if maps else _point("not held", text))
    if bool(plan["bistable"].any()):
        text = "attractive state as well"
        handles.append(
            Line2D([], [], linestyle="", **_BISTABLE, label=text) if maps else _point("bistable", text)
        )
    if choice is not None:
        star: dict[str, Any] = {"color": _BEST, "marker": "*", "markeredgecolor": "white", "markersize": 12.0}
        handles.append(Line2D([], [], linestyle="", **star, label="best"))
    if not handles:
        return None
    return figure.legend(
        handles=handles,
        loc="lower center",
        ncols=min(len(handles), plan.sizes["lever"] + 1),
        frameon=False,
        borderaxespad=0.0,
        fontsize=LABEL_SIZE,
    )
