"""A scan before and after its correction (figure 11 of the paper), the pixels that anchored it, and its drift."""

from __future__ import annotations

import math
from collections.abc import Hashable
from typing import NamedTuple

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from overtone.errors import ObservablesError
from overtone.instrument.unknowns import wrapped
from overtone.plots.categories import PALETTE, draw_flags
from overtone.plots.maps import draw_map
from overtone.plots.planes import abscissa, plane_of, ratio_of
from overtone.plots.scales import Array, Limits, Mask, robust_limits
from overtone.plots.sheet import Sheet
from overtone.plots.text import LABEL_SIZE, TICK_SIZE, set_title, typeset, with_unit
from overtone.plots.ticks import linear_ticks, room_for_ticks
from overtone.units import display_unit

_COLUMN_WIDTH = 3.4
_MARGIN = 0.08
_LEAST = {"m": 1e-13, "rad": 1e-3}  # half of a colour scale, at least: smaller is rounding
# before below and wide, after on it and narrow: both are seen where they are one
_STYLES = {"as read": ("0.65", 3.0), "corrected": (PALETTE[0], 1.2)}


class Pair(NamedTuple):
    """One signal before and after, on (y, x) in SI units."""

    title: str
    symbol: str
    unit: str
    before: xr.DataArray
    after: xr.DataArray


def correction_figure(scan: xr.Dataset, corrected: xr.Dataset) -> Figure:
    """Return mean deflection, second harmonic and phase before and after, the pixels that anchored them, and drift.

    Parameters
    ----------
    scan : Dataset
        Observables (y, x) as the microscope stored them.
    corrected : Dataset
        The same, out of `overtone.correct`; ``reference`` marks the pixels used where there were any.

    Raises
    ------
    ObservablesError
        If these are no maps, or not of the same pixels.

    Notes
    -----
    The two colour scales of a signal have one unit and are equally wide, so that the same step of colour is the same
    difference; each is centred on its own map. With the second harmonic its phase is counted from twice that of the
    first: an elastic contact gives 180 degrees or none to both halves of a blend.
    """
    check_pixels(scan, corrected)
    pairs = _pairs(scan, corrected)
    marked = plane_of(corrected["reference"])[0].values == 1 if "reference" in corrected else None
    strips = [pair for pair in (_mean(scan, corrected), _phase(scan, corrected)) if pair is not None]
    columns = max(len(pairs), len(strips) + (marked is not None))
    sheet = Sheet.new(3 * columns, columns, _COLUMN_WIDTH, ratio_of(scan["A1"]))
    for axes in sheet.cells:
        axes.set_axis_off()
    for k, pair in enumerate(pairs):
        draw_pair(sheet.cells[k], sheet.cells[columns + k], pair)
    last = iter(sheet.cells[2 * columns :])
    if marked is not None:
        axes = _used(next(last))
        draw_flags(axes, corrected["reference"], title="pixels taken as the reference")
    for pair in strips:
        _draw_strip(_used(next(last)), pair, marked)
    handles = [
        Line2D([], [], color=colour, linewidth=width, label=f"{word}, median of each line")
        for word, (colour, width) in _STYLES.items()
    ]
    legend = sheet.figure.legend(
        handles=handles,
        loc="lower center",
        ncols=min(columns, 2),
        frameon=False,
        borderaxespad=0.0,
        fontsize=LABEL_SIZE,
    )
    return sheet.lay_out("", legend)


def check_pixels(scan: xr.Dataset, corrected: xr.Dataset) -> None:
    """Refuse what are no maps, or not of the same pixels."""
    for what, dataset in (("scan", scan), ("corrected scan", corrected)):
        if not {"y", "x"} <= set(dataset["A1"].dims):
            raise ObservablesError(
                f"the {what} is no map",
                expected="observables (y, x)",
                got=f"dimensions {dataset['A1'].dims}",
                hint="calibration_figure shows curves",
            )
    if plane_of(scan["A1"])[0].shape != plane_of(corrected["A1"])[0].shape:
        raise ObservablesError(
            "scan and corrected scan do not fit",
            expected=f"pixels {plane_of(scan['A1'])[0].shape}",
            got=f"{plane_of(corrected['A1'])[0].shape}",
            hint="corrected = overtone.correct(scan, calibration)",
        )


def _used(axes: Axes) -> Axes:
    axes.set_axis_on()
    return axes


# --- what is drawn ------------------------------------------------------------------------------------------------


def _pairs(scan: xr.Dataset, corrected: xr.Dataset) -> list[Pair]:
    found = [_mean(scan, corrected)]
    if all({"A2", "phi2"} <= set(dataset) for dataset in (scan, corrected)):
        found.append(Pair("harmonic 2", typeset("A_2"), "m", *_planes("A2", scan, corrected)))
        lags = [
            plane_of(dataset["phi2"])[0] - 2.0 * plane_of(dataset["phi1"])[0] for dataset in (scan, corrected)
        ]
        found.append(Pair("phase of harmonic 2", r"$\phi_2 - 2\phi_1$", "rad", *map(continuous, lags)))
    else:
        found.append(_phase(scan, corrected))
    return [pair for pair in found if pair is not None]


def _mean(scan: xr.Dataset, corrected: xr.Dataset) -> Pair | None:
    if not ("A0" in scan and "A0" in corrected):
        return None
    return Pair("mean deflection", typeset("A_0"), "m", *_planes("A0", scan, corrected))


def _phase(scan: xr.Dataset, corrected: xr.Dataset) -> Pair:
    before, after = map(continuous, _planes("phi1", scan, corrected))
    return Pair("phase", typeset("phi_1"), "rad", before, after)


def _planes(name: str, scan: xr.Dataset, corrected: xr.Dataset) -> tuple[xr.DataArray, xr.DataArray]:
    return plane_of(scan[name])[0], plane_of(corrected[name])[0]


def continuous(phase: xr.DataArray) -> xr.DataArray:
    """Return a phase about its mean between 0 and a whole turn, so that scatter about 0 does not split a map in two."""
    values = np.asarray(phase.values, dtype=float)
    known = values[np.isfinite(values)]
    centre = float(np.angle(np.exp(1j * known).mean())) % (2.0 * math.pi) if known.size else 0.0
    return phase.copy(data=centre + wrapped(values - centre))


# --- how it is drawn ----------------------------------------------------------------------------------------------


def draw_pair(above: Axes, below: Axes, pair: Pair, widest: float = math.inf) -> None:
    """Draw a signal before and after on colour scales of one unit and, as a rule, one width.

    Parameters
    ----------
    above, below : Axes
        For the signal before and after.
    pair : Pair
        The signal.
    widest : float, optional
        How many times wider than the map after the one before may be: beyond, each has a scale of its own.
    """
    limits = [_limits(array) for array in (pair.before, pair.after)]
    halves = [
        max(0.5 * (ends[1] - ends[0]), _LEAST[pair.unit]) if ends is not None else _LEAST[pair.unit]
        for ends in limits
    ]
    if halves[0] <= widest * halves[1]:
        halves = [max(halves)] * 2
    middles = [0.5 * sum(ends) if ends is not None else 0.0 for ends in limits]
    # in the unit of what is left: an offset is read in many picometres, the picture in few nanometres is not
    unit = display_unit(abs(middles[1]) + halves[1], pair.unit)
    for axes, array, middle, half, word in zip(
        (above, below), (pair.before, pair.after), middles, halves, _STYLES, strict=True
    ):
        shown = array.copy(data=np.asarray(array.values, dtype=float) * unit.factor).rename("signal")
        shown.attrs = {"units": unit.label}
        ends = ((middle - half) * unit.factor, (middle + half) * unit.factor)
        draw_map(_used(axes), shown, title=f"{pair.title}, {word}", limits=ends)
        for bar in axes.child_axes:
            bar.set_ylabel(with_unit(pair.symbol, unit.label), fontsize=LABEL_SIZE)


def _limits(array: xr.DataArray) -> Limits | None:
    values = np.asarray(array.values, dtype=float)
    return robust_limits(values, positive=False) if np.isfinite(values).any() else None


def _draw_strip(axes: Axes, pair: Pair, marked: Mask | None) -> None:
    """Draw medians of the lines over the slow axis, each less the median of all lines."""
    set_title(axes, f"{pair.title}, line by line")
    slow: Hashable = pair.before.dims[0]
    position, below = abscissa(pair.before.isel({pair.before.dims[1]: 0}, drop=True))
    lines = [_medians(np.asarray(array.values, dtype=float), marked) for array in (pair.before, pair.after)]
    both = np.concatenate([*lines, np.array([-_LEAST[pair.unit], _LEAST[pair.unit]])])
    low, high = float(np.nanmin(both)), float(np.nanmax(both))
    unit = display_unit(max(-low, high), pair.unit)
    axes.axhline(0.0, color="0.85", linewidth=0.8, zorder=0)
    for line, (colour, width) in zip(lines, _STYLES.values(), strict=True):
        axes.plot(position, line * unit.factor, color=colour, linewidth=width)
    margin = _MARGIN * (high - low)
    axes.set_ylim((low - margin) * unit.factor, (high + margin) * unit.factor)
    axes.set_xlim(
        float(position.min()), float(position.max()) if position.size > 1 else float(position.min()) + 1.0
    )
    x_room, y_room = room_for_ticks(axes, None)
    linear_ticks(*axes.get_xlim(), min(x_room, 5)).put_on(axes.xaxis)
    linear_ticks(*axes.get_ylim(), max(3, min(y_room, 6))).put_on(axes.yaxis)  # one tick tells no scale
    axes.set_xlabel(below if below != str(slow) else f"{slow} [pixel]", fontsize=LABEL_SIZE)
    axes.set_ylabel(with_unit(f"Δ {pair.symbol}", unit.label), fontsize=LABEL_SIZE)
    axes.tick_params(labelsize=TICK_SIZE)


def _medians(values: Array, marked: Mask | None) -> Array:
    """Return the median of each line, over the reference pixels where there are some, less the median of all lines."""
    usable = np.isfinite(values) & (marked if marked is not None else True)
    lines = np.array(
        [
            float(np.median(row[good])) if good.any() else math.nan
            for row, good in zip(values, usable, strict=True)
        ]
    )
    known = lines[np.isfinite(lines)]
    return lines - float(np.median(known)) if known.size else lines
