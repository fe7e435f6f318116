"""A thermal spectrum with the resonance that was fitted to it."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from overtone.instrument.thermal import ThermalFit
from overtone.plots.categories import PALETTE
from overtone.plots.scales import Array
from overtone.plots.sheet import Sheet
from overtone.plots.text import LABEL_SIZE, TICK_SIZE, set_title, with_unit
from overtone.plots.ticks import linear_ticks, log_ticks, room_for_ticks
from overtone.units import display_unit

_COLUMN_WIDTH = 4.6
_RATIO = 0.75
_WIDTHS = 8.0  # of the peak on either side in the close view
_POINTS = 2000
_DRAWN = 4000  # points beyond which a spectrum is drawn by its extremes
_MARGIN = 1.3


def thermal_figure(
    spectrum: xr.DataArray, fit: ThermalFit, scale: float = 1.0, unit: str | None = None
) -> Figure:
    """Return the amplitude density of a spectrum and the fit: as a whole, and about the first peak.

    Parameters
    ----------
    spectrum : DataArray
        One-sided power density [m^2/Hz or V^2/Hz] over ``frequency``.
    fit : ThermalFit
        Result of `overtone.instrument.thermal.fit_thermal` on it.
    scale : float, optional
        Sensitivity [m/V] to show a spectrum in volts in metres.
    unit : str, optional
        ``m`` or ``V`` after ``scale``; that of the spectrum unless given.
    """
    sheet = Sheet.new(2, 2, _COLUMN_WIDTH, _RATIO)
    f = spectrum["frequency"].values.astype(float)
    inside = (f > 0.0) & (spectrum.values > 0.0)
    f, root = f[inside], scale * np.sqrt(spectrum.values[inside].astype(float))
    unit = unit if unit is not None else fit.unit[0]
    for axes, title, low, high in (
        (sheet.cells[0], "thermal spectrum", f[0], f[-1]),
        (sheet.cells[1], "first mode", *_close(fit, f)),
    ):
        set_title(axes, title)
        _draw(axes, f, root, fit, scale, unit, float(low), float(high))
    handles, labels = sheet.cells[1].get_legend_handles_labels()
    legend = sheet.figure.legend(
        handles,
        labels,
        loc="lower center",
        ncols=len(labels),
        frameon=False,
        borderaxespad=0.0,
        fontsize=LABEL_SIZE,
    )
    return sheet.lay_out("", legend)


def _close(fit: ThermalFit, f: Array) -> tuple[float, float]:
    width = fit.frequency / fit.quality_factor
    side = width * max(_WIDTHS, 10.0 / fit.bins_per_width)  # ten bins at least
    return max(fit.frequency - side, float(f[0])), min(fit.frequency + side, float(f[-1]))


def _draw(
    axes: Axes, f: Array, root: Array, fit: ThermalFit, scale: float, unit: str, low: float, high: float
) -> None:
    seen = (f >= low) & (f <= high)
    x, y = _thinned(f[seen], root[seen])
    fitted = np.linspace(low, high, _POINTS)
    dense = np.unique(np.concatenate([fitted, _about_peaks(fit, low, high)]))
    in_fit = _in_fits(fit, dense)
    curve = np.where(in_fit, scale * np.sqrt(np.sum(_parts(fit, dense), axis=0)), np.nan)
    across, up = display_unit(high, "Hz"), display_unit(float(y.max()), unit)
    axes.plot(x * across.factor, y * up.factor, color="0.6", linewidth=0.7, label="measured", zorder=1)
    axes.plot(
        dense * across.factor, curve * up.factor, color=PALETTE[5], linewidth=1.4, label="fit", zorder=3
    )
    if fit.floor > 0.0:
        floor = scale * np.sqrt(fit.floor) * up.factor
        axes.axhline(floor, color=PALETTE[0], linewidth=0.9, linestyle="--", label="noise floor", zorder=2)
    axes.set_yscale("log")
    axes.set_xlim(low * across.factor, high * across.factor)
    bottom, top = float(np.quantile(y, 0.002)), float(max(y.max(), np.nanmax(curve)))
    axes.set_ylim(bottom / _MARGIN * up.factor, top * _MARGIN * up.factor)
    x_room, y_room = room_for_ticks(axes, None)
    linear_ticks(*axes.get_xlim(), min(x_room, 5)).put_on(axes.xaxis)
    log_ticks(*axes.get_ylim(), min(y_room, 6)).put_on(axes.yaxis)
    axes.set_xlabel(with_unit("frequency", across.label), fontsize=LABEL_SIZE)
    axes.set_ylabel(with_unit("amplitude density", f"{up.label}/√Hz"), fontsize=LABEL_SIZE)
    axes.tick_params(labelsize=TICK_SIZE)


def _parts(fit: ThermalFit, f: Array) -> list[Array]:
    """Return the power density of each fitted peak where it was fitted, with the floor there."""
    return [
        np.where((f >= one.between[0]) & (f <= one.between[1]), one.density(f), 0.0)
        for one in (fit, *fit.higher)
    ]


def _in_fits(fit: ThermalFit, f: Array) -> npt.NDArray[np.bool_]:
    inside = [(f >= one.between[0]) & (f <= one.between[1]) for one in (fit, *fit.higher)]
    return np.asarray(np.any(inside, axis=0))


def _about_peaks(fit: ThermalFit, low: float, high: float) -> Array:
    """Return frequencies close enough to each other to draw narrow peaks."""
    points = [
        one.frequency * (1.0 + np.linspace(-5.0, 5.0, 401) / one.quality_factor) for one in (fit, *fit.higher)
    ]
    dense = np.concatenate(points)
    return np.asarray(dense[(dense >= low) & (dense <= high)])


def _thinned(x: Array, y: Array) -> tuple[Array, Array]:
    """Return the extremes of groups of points where there are more of them than a picture shows."""
    size = int(np.ceil(2 * x.size / _DRAWN))
    if size <= 2:
        return x, y
    whole = x.size // size * size
    groups = y[:whole].reshape(-1, size)
    both = np.stack([groups.min(axis=1), groups.max(axis=1)], axis=-1).ravel()
    return np.repeat(x[:whole].reshape(-1, size).mean(axis=1), 2), both
