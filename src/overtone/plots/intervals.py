"""Intervals of properties: median, lower and upper end in one row on one scale, and how certain each pixel is."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from overtone.plots.maps import draw_map
from overtone.plots.panels import Panel, flags_panel, panels_figure, words_panel
from overtone.plots.planes import plane_of, ratio_of
from overtone.plots.results import width_of
from overtone.plots.scales import Limits, Scale, positive_limits
from overtone.plots.steps import beyond, interval_scale
from overtone.report.results import (
    PROPERTIES,
    estimate_of,
    interval_of,
    linearised_interval,
    properties_in,
    undetermined,
)
from overtone.units import format_quantity

_WORDS = 0.3  # height over width of a cell with words alone
NOWHERE = "not determined at any pixel"
_UNCERTAINTIES = {
    "uncertainty_statistical": "uncertainty of ln E, noise",
    "uncertainty_systematic": "uncertainty of ln E, shared",
}


def interval_figure(label: str, properties: xr.Dataset) -> Figure:
    """Return median, lower and upper end of every property, a row and a scale for each.

    Parameters
    ----------
    label : str
        What the result was inverted from.
    properties : Dataset
        Result of `overtone.map_properties` with intervals.

    Notes
    -----
    A curve has its intervals as bars, one panel for each property.
    """
    panels = [panel for name in properties_in(properties) for panel in _row(properties, name)]
    nothing = bool(undetermined(properties).all())
    return panels_figure(panels, label, _WORDS if nothing else ratio_of(properties["status"]))


def certainty_figure(label: str, properties: xr.Dataset) -> Figure:
    """Return the width of the interval, what it comes from, and what each pixel can be trusted for.

    Parameters
    ----------
    label : str
        What the result was inverted from.
    properties : Dataset
        Result of `overtone.map_properties` with intervals.
    """
    return panels_figure(list(_certainty(properties)), label, ratio_of(properties["status"]))


def stepped_scale(properties: xr.Dataset, name: str, within: Limits | None = None) -> Scale | None:
    """Return the scale of a property whose steps are its typical interval, None where nothing is determined."""
    estimate, interval = estimate_of(properties, name), linearised_interval(properties, name)
    if estimate is None or interval is None:
        return None
    median, lower, upper = (np.asarray(array.values, dtype=float) for array in (estimate, *interval))
    unit, veil = str(estimate.attrs.get("units", "")), undetermined(properties).values
    return interval_scale(name, unit, median, lower, upper, veil, within)


def _row(properties: xr.Dataset, name: str) -> Iterator[Panel]:
    estimate, interval = estimate_of(properties, name), interval_of(properties, name)
    if estimate is None:
        return
    title, veil = PROPERTIES[name], undetermined(properties)
    if plane_of(estimate)[0].ndim < 2:
        yield Panel(
            partial(draw_map, array=estimate, title=f"{title}, 90 %", undetermined=veil, interval=interval)
        )
        return
    titles = (f"{title}, median", "lower end (90 %)", "upper end (90 %)")
    if interval is None:
        yield Panel(partial(draw_map, array=estimate, title=titles[0], undetermined=veil))
        yield words_panel(titles[1], "no interval")
        yield words_panel(titles[2], "no interval")
        return
    scale = stepped_scale(properties, name)
    if scale is None:
        yield words_panel(titles[0], NOWHERE)
        for end, heading in zip(interval, titles[1:], strict=True):
            yield words_panel(heading, _in_words(end))
        return
    scale = beyond(scale, np.where(veil.values, np.nan, estimate.values), *(end.values for end in interval))
    yield Panel(partial(draw_map, array=estimate, title=titles[0], undetermined=veil, scale=scale, bar=False))
    yield Panel(partial(draw_map, array=interval.lower, title=titles[1], scale=scale, bar=False))
    yield Panel(partial(draw_map, array=interval.upper, title=titles[2], scale=scale))


def _in_words(end: xr.DataArray) -> str:
    """Say between what an end lies at most pixels, where a map of it would look like an answer."""
    values = np.asarray(end.values, dtype=float)
    values = values[np.isfinite(values)]
    if not values.size:
        return "no data"
    low, high = (float(value) for value in np.percentile(values, [5.0, 95.0]))
    unit = str(end.attrs.get("units", "1"))
    return f"{format_quantity(low, unit, 3)} to {format_quantity(high, unit, 3)} at 90 % of pixels"


def _certainty(properties: xr.Dataset) -> Iterator[Panel]:
    name = next(iter(properties_in(properties)), "modulus")
    width = width_of(properties, name)
    if width is not None:
        yield Panel(partial(draw_map, array=width, title="width of the 90 % range"))
    yield from _parts(properties)
    for flagged, title, share, share_title in (
        ("status", "status", "contact_probability", "probability of contact"),
        ("model", "contact model chosen", "model_probability", "probability of that model"),
    ):
        if flagged in properties:
            yield flags_panel(properties[flagged], title)
            if share in properties:
                array = properties[share]
                yield Panel(partial(draw_map, array=array, title=share_title, limits=(0.0, 1.0)))


def _parts(properties: xr.Dataset) -> Iterator[Panel]:
    """Yield what noise and what shared errors do to the modulus, on one scale."""
    found = {name: properties[name] for name in _UNCERTAINTIES if name in properties}
    if not found:
        return
    limits = positive_limits(np.concatenate([array.values.ravel() for array in found.values()]))
    for name, array in found.items():
        if bool((array > 0.0).any()):
            yield Panel(partial(draw_map, array=array, title=_UNCERTAINTIES[name], limits=limits))
        else:
            yield words_panel(_UNCERTAINTIES[name], "not in these intervals: the scan was not calibrated")


def draw_estimate(
    axes: Axes, properties: xr.Dataset, name: str, title: str, within: Limits | None = None
) -> None:
    """Draw a property in steps of its interval under its veil, or say that it is determined nowhere."""
    estimate = estimate_of(properties, name)
    assert estimate is not None
    veil, scale = undetermined(properties), stepped_scale(properties, name, within)
    if linearised_interval(properties, name) is not None and scale is None:
        words_panel(title, NOWHERE).draw(axes)
        return
    if scale is not None:
        scale = beyond(scale, np.where(veil.values, np.nan, estimate.values))
    draw_map(axes, estimate, title=title, undetermined=veil, scale=scale)
