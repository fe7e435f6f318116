"""A simulated approach curve: the two sweeps, their jumps, and the branches that they run on."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.legend import Legend
from matplotlib.lines import Line2D

from overtone.plots.categories import PALETTE
from overtone.plots.scales import Array
from overtone.plots.sheet import Sheet
from overtone.plots.text import LABEL_SIZE, TICK_SIZE, label_of, set_title, with_unit
from overtone.plots.ticks import linear_ticks, room_for_ticks
from overtone.units import display_unit

_COLUMNS = 3
_COLUMN_WIDTH = 3.4
_RATIO = 0.75
_MARGIN = 0.06
_STRETCH = 0.6  # of the range of the sweeps: so far beyond it a panel goes for the branches
_GAP = 0.5
_SEEN = 0.02  # of the height of a panel: smaller jumps get no arrow
_SMALLEST = {"J": 4e-21, "rad": 1e-6, "m": 1e-15, "N": 1e-15, "1": 1e-6}  # what is drawn as nothing

# Retract below and wide, approach on it and narrow: both are seen where they are one.
_SWEEPS = {"approach": (PALETTE[0], 1.4, 4), "retract": (PALETTE[1], 3.6, 3)}
_BRANCH = "0.35"
_PANELS = {
    "A1": "amplitude",
    "phi1": "phase",
    "A0": "mean deflection",
    "A2": "amplitude of harmonic 2",
    "A3": "amplitude of harmonic 3",
    "indentation": "maximum indentation",
    "peak_force": "strongest repulsion",
    "contact_time": "time in contact",
    "dissipation": "energy lost per cycle",
}


def curve_figure(curve: xr.Dataset, states: xr.Dataset | None = None, heading: str = "") -> Figure:
    """Return amplitude, phase, harmonics and what the contact feels, over the height of the base.

    Parameters
    ----------
    curve : Dataset
        Result of `overtone.approach_curve`, of one material.
    states : Dataset, optional
        Result of `overtone.steady_states` for the same material.
    heading : str, optional
        What stands above the panels.
    """
    names = [name for name in _PANELS if name in curve and set(curve[name].dims) == {"direction", "z"}]
    sheet = Sheet.new(len(names), _COLUMNS, _COLUMN_WIDTH, _RATIO)
    across = display_unit(float(np.abs(curve["z"].values).max()), "m")
    for axes, name in zip(sheet.cells, names, strict=True):
        set_title(axes, _PANELS[name])
        _draw_panel(axes, name, curve, states, across.factor)
        axes.set_xlabel(with_unit("$Z$", across.label), fontsize=LABEL_SIZE)
    return sheet.lay_out(heading, _legend(sheet.figure, curve, states))


def jumps_of(sweep: xr.Dataset) -> list[tuple[int, int]]:
    """Return the rows before and after each jump of one sweep, in the order in which it came there."""
    rows = _in_time(sweep)
    found = np.isfinite(sweep["A1"].values[rows])
    jumped = sweep["jump"].values[rows]
    landings = np.flatnonzero(found[1:] & found[:-1] & jumped[1:]) + 1
    return [(int(rows[k - 1]), int(rows[k])) for k in landings]


def _in_time(sweep: xr.Dataset) -> npt.NDArray[np.intp]:
    """Return the rows of one sweep in the order in which it went through them."""
    rows = np.argsort(sweep["z"].values, kind="stable")
    return rows if str(sweep["direction"].values) == "retract" else rows[::-1]


def _draw_panel(axes: Axes, name: str, curve: xr.Dataset, states: xr.Dataset | None, across: float) -> None:
    array = curve[name].transpose("direction", "z")
    si = str(array.attrs["units"])
    values = _shown(name, array.values)
    finite = values[np.isfinite(values)]
    least = _SMALLEST.get(si, 0.0)
    unit = display_unit(max(float(np.abs(finite).max(initial=0.0)), least), si)
    low, high = _limits(finite * unit.factor, least * unit.factor)
    lowest = -math.inf
    if name == "indentation" and high > 0.0:
        lowest = -_GAP * high  # a gap is no indentation: some of it will do
    low = max(low, lowest)
    if states is not None and name in states:
        others = _shown(name, states[name].transpose("z", "branch").values) * unit.factor
        low, high = _stretched(low, high, others[np.isfinite(others)])
        low = max(low, lowest)
        _draw_branches(axes, states, others, across)
    margin = _MARGIN * (high - low)
    axes.set_ylim(low - margin, high + margin)
    for k in range(array.sizes["direction"]):
        _draw_sweep(axes, curve.isel(direction=k), values[k] * unit.factor, across)
        if name == "A1":
            _mark_lost(axes, curve.isel(direction=k), across)
    x = curve["z"].values * across
    room = _MARGIN * float(np.ptp(x)) or 1.0
    axes.set_xlim(float(x.min()) - room, float(x.max()) + room)
    x_room, y_room = room_for_ticks(axes, None)
    linear_ticks(*axes.get_xlim(), min(x_room, 6)).put_on(axes.xaxis)
    linear_ticks(*axes.get_ylim(), min(y_room, 6)).put_on(axes.yaxis)
    axes.tick_params(labelsize=TICK_SIZE)
    label = "share of a period" if name == "contact_time" else label_of(array, unit.label)
    axes.set_ylabel(label, fontsize=LABEL_SIZE)


def _draw_sweep(axes: Axes, sweep: xr.Dataset, values: Array, across: float) -> None:
    """Draw one sweep, broken at its jumps, which are arrows, and where there is no state."""
    direction = str(sweep["direction"].values)
    colour, width, order = _SWEEPS[direction]
    x, rows = sweep["z"].values * across, _in_time(sweep)
    jumps = jumps_of(sweep) if "jump" in sweep else []
    landings = [int(np.flatnonzero(rows == after)[0]) for _, after in jumps]
    line = axes.plot(
        np.insert(x[rows], landings, np.nan),
        np.insert(values[rows], landings, np.nan),
        color=colour,
        linewidth=width,
        zorder=order,
        solid_capstyle="round",
    )
    line[0].set_gid(direction)
    bottom, top = axes.get_ylim()
    for before, after in jumps:
        if abs(values[after] - values[before]) < _SEEN * (top - bottom):
            continue
        axes.annotate(
            "",
            (x[after], values[after]),
            (x[before], values[before]),
            arrowprops={
                "arrowstyle": "-|>",
                "linestyle": ":",
                "color": colour,
                "linewidth": 1.2,
                "mutation_scale": 9.0,
                "shrinkA": 0.0,
                "shrinkB": 0.0,
            },
            zorder=5,
        )


def _mark_lost(axes: Axes, sweep: xr.Dataset, across: float) -> None:
    """Mark the heights at which a sweep has no state, a row for each direction."""
    lost = ~np.isfinite(sweep["A1"].values)
    direction = str(sweep["direction"].values)
    axes.plot(
        sweep["z"].values[lost] * across,
        np.full(lost.sum(), 0.03 if direction == "approach" else 0.09),
        "x",
        color=_SWEEPS[direction][0],
        markersize=4.0,
        transform=axes.get_xaxis_transform(),
        zorder=5,
    )


def _draw_branches(axes: Axes, states: xr.Dataset, values: Array, across: float) -> None:
    """Draw every branch, dashed where it is not stable."""
    order = np.argsort(states["z"].values)
    x, values = states["z"].values[order] * across, values[order]
    stable = states["stable"].transpose("z", "branch").values[order]
    for k in range(values.shape[1]):
        unstable = np.isfinite(values[:, k]) & ~stable[:, k]
        touched = unstable.copy()  # up to the stable neighbours, so that there is no hole between
        touched[1:] |= unstable[:-1]
        touched[:-1] |= unstable[1:]
        for shown, style in ((~unstable, "-"), (touched, "--")):
            y = np.where(shown, values[:, k], np.nan)
            alone = int(np.isfinite(y).sum()) == 1
            line = axes.plot(
                x, y, "." if alone else style, color=_BRANCH, linewidth=1.0, markersize=3.0, zorder=2
            )
            line[0].set_gid("stable" if style == "-" else "unstable")


def _legend(figure: Figure, curve: xr.Dataset, states: xr.Dataset | None) -> Legend:
    handles = [
        Line2D([], [], color=colour, linewidth=width, label=direction)
        for direction, (colour, width, _) in _SWEEPS.items()
    ]
    sweeps = [curve.isel(direction=k) for k in range(curve.sizes["direction"])]
    if "jump" in curve and any(jumps_of(sweep) for sweep in sweeps):
        handles.append(Line2D([], [], color="0.2", linestyle=":", linewidth=1.2, label="jump"))
    if states is not None:
        handles.append(Line2D([], [], color=_BRANCH, linewidth=1.0, label="other stable states"))
        handles.append(Line2D([], [], color=_BRANCH, linewidth=1.0, linestyle="--", label="unstable states"))
    if not bool(np.isfinite(curve["A1"]).all()):
        handles.append(
            Line2D([], [], color="0.2", marker="x", linestyle="", markersize=4.0, label="no state found")
        )
    return figure.legend(
        handles=handles,
        loc="lower center",
        ncols=len(handles),
        frameon=False,
        borderaxespad=0.0,
        fontsize=LABEL_SIZE,
    )


def _shown(name: str, values: Array) -> Array:
    """Return values to draw: phases so that what scatters about zero does not wrap, noise of no loss as none."""
    if name.startswith("phi"):
        return np.asarray((values + 0.5 * math.pi) % (2.0 * math.pi) - 0.5 * math.pi)
    return values


def _limits(values: Array, least: float) -> tuple[float, float]:
    """Return limits that hold the values, and zero where it is not far away."""
    low, high = float(values.min(initial=math.inf)), float(values.max(initial=-math.inf))
    if low > high:
        return 0.0, 1.0
    if 0.0 < low < 0.5 * high:
        low = 0.0
    elif 0.5 * low < high < 0.0:
        high = 0.0
    short = 0.5 * (least - (high - low))
    return (low - short, high + short) if short > 0.0 else (low, high)


def _stretched(low: float, high: float, values: Array) -> tuple[float, float]:
    """Return limits that go beyond the sweeps for what else there is, but not so far that these look flat."""
    reach = _STRETCH * (high - low)
    return (
        max(low - reach, min(low, float(values.min(initial=low)))),
        min(high + reach, max(high, float(values.max(initial=high)))),
    )
