"""Figures of observables, forces, energies and properties: pictures only, no science.

Figures are built without pyplot, so that they need no screen and may be drawn in threads. In every map row 0
is at the top, light grey is missing data, and a grey hatched veil covers what the data do not determine.
Where intervals are known, colours change in steps as wide as a typical one.
"""

from overtone.plots.calibration import calibration_figure
from overtone.plots.canvas import png_bytes
from overtone.plots.categories import draw_flags
from overtone.plots.correction import correction_figure
from overtone.plots.curve import curve_figure
from overtone.plots.figures import energy_figure, forces_figure, observables_figure, properties_figure
from overtone.plots.histograms import histogram_figure
from overtone.plots.intervals import certainty_figure
from overtone.plots.maps import draw_map
from overtone.plots.overview import overview_figure
from overtone.plots.plan import plan_figure
from overtone.plots.reconstruction import reconstruction_figure
from overtone.plots.thermal import thermal_figure
from overtone.plots.validity import validity_figure

__all__ = [
    "calibration_figure",
    "certainty_figure",
    "correction_figure",
    "curve_figure",
    "draw_flags",
    "draw_map",
    "energy_figure",
    "forces_figure",
    "histogram_figure",
    "observables_figure",
    "overview_figure",
    "plan_figure",
    "png_bytes",
    "properties_figure",
    "reconstruction_figure",
    "thermal_figure",
    "validity_figure",
]
