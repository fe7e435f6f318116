"""Every solution of the force harmonics: estimates, how many there are, and how far they lie apart."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

import xarray as xr
from matplotlib.figure import Figure

from overtone.plots.intervals import draw_estimate
from overtone.plots.maps import draw_map
from overtone.plots.panels import Panel, flags_panel, panels_figure
from overtone.plots.planes import ratio_of
from overtone.plots.results import counted, spread_of_solutions
from overtone.report.results import PROPERTIES, properties_in


def solutions_figure(label: str, properties: xr.Dataset) -> Figure:
    """Return the maps of an exact inversion: estimates, number and distance of the solutions, and status.

    Parameters
    ----------
    label : str
        What the result was inverted from.
    properties : Dataset
        Result of `overtone.map_properties` with ``method="exact"``.
    """
    return panels_figure(list(_panels(properties)), label, ratio_of(properties["status"]))


def _panels(properties: xr.Dataset) -> Iterator[Panel]:
    names = properties_in(properties)
    for name in names:
        yield Panel(partial(draw_estimate, properties=properties, name=name, title=PROPERTIES[name]))
    if "solutions" in properties:
        yield flags_panel(counted(properties["solutions"]), "solutions")
    spread = spread_of_solutions(properties, names[0]) if names else None
    if spread is not None and bool(spread.notnull().any()):
        yield Panel(partial(draw_map, array=spread, title=f"{PROPERTIES[names[0]]}, between solutions"))
    yield flags_panel(properties["status"], "status")
    if "uncertainty" in properties:
        yield Panel(partial(draw_map, array=properties["uncertainty"], title="uncertainty of ln E"))
