"""The force over the gap that a curve was turned into, and what was lost on the way."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from overtone.inversion.reconstruction import BEYOND_JUMP, RECONSTRUCTED
from overtone.plots.categories import PALETTE
from overtone.plots.scales import Array
from overtone.plots.sheet import Sheet
from overtone.plots.text import LABEL_SIZE, TICK_SIZE, set_title, with_unit
from overtone.plots.ticks import linear_ticks, room_for_ticks
from overtone.units import DisplayUnit, display_unit

_COLUMN_WIDTH = 4.6
_RATIO = 0.75
_MARGIN = 0.06
_THERMAL = 4e-21  # J, below which an energy per cycle is drawn as nothing
_FELT = 0.02  # share of the largest force below which there is nothing to see


def reconstruction_figure(reconstruction: xr.Dataset, truth: xr.DataArray | None = None) -> Figure:
    """Return the force over the gap and the energy lost on the way.

    Parameters
    ----------
    reconstruction : Dataset
        Result of `overtone.reconstruct_force`.
    truth : DataArray, optional
        The force [N] that a simulation started from, over the same ``gap``.
    """
    gap = np.asarray(reconstruction["gap"].values, dtype=float)
    view = _view(gap, reconstruction["force"].values)
    part = reconstruction.isel(gap=view)
    across = display_unit(float(np.abs(gap[view]).max()), "m")
    x = gap[view] * across.factor
    sheet = Sheet.new(2, 2, _COLUMN_WIDTH, _RATIO)
    forces, losses = sheet.cells

    set_title(forces, "force")
    force = part["force"].values
    unit = display_unit(float(np.abs(force).max()), "N")
    _draw(forces, x, force * unit.factor, part["status"].values, "from A1 and phi1")
    if "force_mean" in part:
        mean = part["force_mean"].values * unit.factor
        forces.plot(x, mean, "o", mfc="none", mec=PALETTE[1], markersize=6, label="from A0", zorder=1)
    if truth is not None:
        true = truth.isel(gap=view).values * unit.factor
        line = _broken(part["status"].values, x, true)
        forces.plot(*line, "--", color="0.2", linewidth=1.0, label="truth", zorder=3)
    # what comes from A0 may scatter widely: the other force sets the scale
    _set_limits(forces, force * unit.factor, 0.0)
    _set_labels(forces, with_unit("$F$", unit.label), across)

    set_title(losses, "energy lost per cycle")
    lost = part["dissipation"].values
    unit = display_unit(max(float(np.abs(lost).max()), _THERMAL), "J")
    _draw(losses, x, lost * unit.factor, part["status"].values, "")
    _set_limits(losses, lost * unit.factor, _THERMAL * unit.factor)
    _set_labels(losses, with_unit(r"$E_{\mathrm{dis}}$", unit.label), across)

    handles, labels = forces.get_legend_handles_labels()
    legend = sheet.figure.legend(
        handles,
        labels,
        loc="lower center",
        ncols=len(labels),
        frameon=False,
        borderaxespad=0.0,
        fontsize=LABEL_SIZE,
    )
    for text in legend.get_texts():
        text.set_parse_math(False)
    return sheet.lay_out("", legend)


def _view(gap: Array, force: Array) -> slice:
    """Return the part of a curve where there is a force, and half as much again beyond it."""
    felt = np.flatnonzero(np.abs(force) > _FELT * np.abs(force).max())
    end = gap[felt[-1]] if felt.size else gap[-1]
    return slice(0, max(int(np.searchsorted(gap, end + 0.5 * (end - gap[0]), side="right")), 2))


def _draw(axes: Axes, x: Array, y: Array, status: npt.NDArray[np.int8], label: str) -> None:
    """Draw a curve, open circles where it rests on more than the data, without a line across the hole of a jump."""
    axes.axhline(0.0, color="0.85", linewidth=0.8, zorder=0)
    axes.plot(*_broken(status, x, y), color=PALETTE[0], linewidth=0.8, zorder=2)
    sure = status == RECONSTRUCTED
    axes.plot(x[sure], y[sure], "o", color=PALETTE[0], markersize=3, label=label or None, zorder=4)
    if not sure.all():
        doubtful = f"{label}, beyond a jump or at the far end" if label else None
        axes.plot(
            x[~sure], y[~sure], "o", mfc="white", mec=PALETTE[0], markersize=3.5, label=doubtful, zorder=4
        )


def _broken(status: npt.NDArray[np.int8], x: Array, y: Array) -> tuple[Array, Array]:
    """Return a line that is broken where a jump left a hole."""
    holes = np.flatnonzero(np.diff((status == BEYOND_JUMP).astype(int))) + 1
    return np.insert(x, holes, np.nan), np.insert(y, holes, np.nan)


def _set_limits(axes: Axes, values: Array, least: float) -> None:
    """Set limits that hold zero and the values, and at least so much on both sides."""
    low, high = min(float(values.min()), -least), max(float(values.max()), least)
    margin = _MARGIN * (high - low) or 1.0
    axes.set_ylim(low - margin, high + margin)


def _set_labels(axes: Axes, label: str, across: DisplayUnit) -> None:
    x_room, y_room = room_for_ticks(axes, None)
    linear_ticks(*axes.get_xlim(), min(x_room, 6)).put_on(axes.xaxis)
    linear_ticks(*axes.get_ylim(), min(y_room, 6)).put_on(axes.yaxis)
    axes.set_xlabel(with_unit("closest gap", across.label), fontsize=LABEL_SIZE)
    axes.set_ylabel(label, fontsize=LABEL_SIZE)
    axes.tick_params(labelsize=TICK_SIZE)
