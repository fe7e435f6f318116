"""Maps of what tells whether a contact keeps to what its model supposes."""

from __future__ import annotations

from functools import partial

import xarray as xr
from matplotlib.figure import Figure

from overtone.plots.maps import draw_map
from overtone.plots.panels import Panel, panels_figure
from overtone.plots.planes import ratio_of
from overtone.report.results import undetermined
from overtone.report.validity import VALIDITY, validity_in


def validity_figure(label: str, properties: xr.Dataset) -> Figure:
    """Return the maps of pressure, depth, adhesion and time in contact under the veil of the status.

    Parameters
    ----------
    label : str
        What the result was inverted from.
    properties : Dataset
        Result of `overtone.map_properties`, with any of the names of `overtone.report.validity.VALIDITY`.
    """
    veil = undetermined(properties)
    panels = [
        Panel(partial(draw_map, array=properties[name], title=VALIDITY[name], undetermined=veil))
        for name in validity_in(properties)
    ]
    return panels_figure(panels, label, ratio_of(properties["status"]))
