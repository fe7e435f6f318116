"""The one picture that stands for a whole report."""

from __future__ import annotations

import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from overtone.plots.categories import draw_flags
from overtone.plots.intervals import draw_estimate, stepped_scale
from overtone.plots.maps import draw_map
from overtone.plots.planes import ratio_of
from overtone.plots.results import counted, measured, width_of
from overtone.plots.scales import positive_limits, readable
from overtone.plots.sheet import Sheet
from overtone.report.content import Report
from overtone.report.results import (
    LEAST_SQUARES,
    PROPERTIES,
    estimate_of,
    method_of,
    properties_in,
    undetermined,
)
from overtone.report.shares import flag_shares

_COLUMNS = 4
_COLUMN_WIDTH = 3.5


def overview_figure(report: Report, label: str | None = None) -> Figure:
    """Return one wide picture: what was measured, what was concluded, and how far it can be trusted.

    Parameters
    ----------
    report : Report
        What to show.
    label : str, optional
        Which property result; the one with most determined pixels where not given.
    """
    observables = report.observables
    names = ["height" if "height" in observables else "A1", "A0" if "A0" in observables else "phi1", "A2"]
    top: list[xr.DataArray] = [observables[name] for name in names if name in observables]
    if report.truth is None or not report.properties:
        spare = [name for name in measured(observables) if name not in names]
        top += [observables[name] for name in spare[: _COLUMNS - len(top)]]
    sheet = Sheet.new(2 * _COLUMNS, _COLUMNS, _COLUMN_WIDTH, ratio_of(top[0] if top else None))
    for axes in sheet.cells:
        axes.set_axis_off()
    first, second = sheet.cells[:_COLUMNS], sheet.cells[_COLUMNS:]
    for axes, array in zip(first, top, strict=False):
        axes.set_axis_on()
        draw_map(axes, array)
    if report.properties:
        chosen = label or max(report.properties, key=lambda key: _determined_share(report.properties[key]))
        _draw_conclusions(first[-1], second, chosen, report.properties[chosen], report.truth)
    else:
        _draw_energies(second, report.energies)
    return sheet.lay_out()


def _draw_conclusions(
    last: Axes, cells: list[Axes], label: str, properties: xr.Dataset, truth: xr.Dataset | None
) -> None:
    name = next(iter(properties_in(properties)), "modulus")
    veil, estimate = undetermined(properties), estimate_of(properties, name)
    limits = None if estimate is None else positive_limits(readable(estimate.values, veil.values))
    within = None
    if truth is not None and name in truth:
        # One scale for truth and estimate, so that colours compare.
        within = positive_limits(truth[name].values)
        limits = within or limits
        steps = None if method_of(properties) == LEAST_SQUARES else stepped_scale(properties, name, within)
        last.set_axis_on()
        draw_map(last, truth[name], title=f"{PROPERTIES[name]}, truth", limits=limits, scale=steps)
    if estimate is not None:
        cells[0].set_axis_on()
        title = f"{PROPERTIES[name]}, {label}"
        if method_of(properties) == LEAST_SQUARES:
            draw_map(cells[0], estimate, title=title, undetermined=veil, limits=limits)
        else:
            draw_estimate(cells[0], properties, name, title, within)
    width = width_of(properties, name)
    if width is not None:
        cells[1].set_axis_on()
        draw_map(cells[1], width, title="width of the 90 % range")
    elif "solutions" in properties:
        cells[1].set_axis_on()
        draw_flags(cells[1], counted(properties["solutions"]), title="solutions")
    cells[2].set_axis_on()
    draw_flags(cells[2], properties["status"], title="status", legend_axes=cells[3])


def _draw_energies(cells: list[Axes], energies: xr.Dataset) -> None:
    for axes, name in zip(cells, ("dissipation", "virial"), strict=False):
        if name in energies:
            axes.set_axis_on()
            draw_map(axes, energies[name])
    if "regime" in energies:
        cells[2].set_axis_on()
        draw_flags(cells[2], energies["regime"], legend_axes=cells[3])


def _determined_share(properties: xr.Dataset) -> float:
    return flag_shares(properties["status"]).get("determined", 0.0)
