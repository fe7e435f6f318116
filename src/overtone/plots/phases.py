"""Phases of a scan: their colours in every figure, where they are, and how much they decide at each pixel."""

from __future__ import annotations

from functools import partial

import numpy as np
import numpy.typing as npt
import xarray as xr
from matplotlib.figure import Figure
from matplotlib.legend import Legend
from matplotlib.lines import Line2D

from overtone.plots.categories import PALETTE, draw_flags
from overtone.plots.legends import legend_below
from overtone.plots.maps import draw_map
from overtone.plots.panels import Panel, flags_panel, panels_figure
from overtone.plots.planes import plane_of, ratio_of
from overtone.report.shares import flag_shares, flags, format_share

NONE = "none"
NONE_COLOUR = "#b5b5b5"
MARKERS = "osD^vP"
_COLOURS = PALETTE[:-1]  # without grey, which is no phase
_SHARES = {"phase_probability": "probability of that phase", "shrinkage": "shrinkage"}


def phase_names(result: xr.Dataset) -> dict[int, str]:
    """Return the names of the phases of a result by their numbers; what belongs to none is not among them."""
    return {flag: name for flag, name in flags(result["phase"]).items() if flag >= 0}


def phase_colour(index: int) -> str:
    """Return the colour that a phase has in every figure."""
    return _COLOURS[index % len(_COLOURS)] if index >= 0 else NONE_COLOUR


def as_text(name: str) -> str:
    """Return a name of a sample so that nothing in it is a formula, and a legend does not drop it."""
    return str(name).replace("_", " ").strip().replace("$", r"\$")


def phases_figure(result: xr.Dataset, heading: str = "") -> Figure:
    """Return where the phases are, how sure that is, and how much of ln E a pixel has from its phase.

    Parameters
    ----------
    result : Dataset
        Result of `overtone.map_properties` by ``population``.
    heading : str, optional
        What stands above the maps.
    """
    colours = {name: phase_colour(flag) for flag, name in flags(result["phase"]).items()}

    panels = [Panel(partial(draw_flags, array=result["phase"], title="phase", colours=colours))]
    panels += [
        Panel(partial(draw_map, array=result[name], title=title, limits=(0.0, 1.0)))
        for name, title in _SHARES.items()
        if name in result
    ]
    panels.append(flags_panel(result["status"], "status"))
    return panels_figure(panels, heading, ratio_of(result["status"]))


def phase_legend(figure: Figure, phase: xr.DataArray) -> Legend:
    """Return a legend of a figure with the colour and the share of pixels of every phase, and of what is none."""
    shares = flag_shares(phase)
    handles = [
        Line2D(
            [],
            [],
            linestyle="",
            marker="o",
            markersize=5.0,
            color=phase_colour(flag),
            label=f"{as_text(name)}, {format_share(shares[name])}",
        )
        for flag, name in sorted(flags(phase).items(), key=lambda item: (item[0] < 0, item[0]))
        if shares[name] > 0.0
    ]
    return legend_below(figure, handles)


def codes_of(phase: xr.DataArray) -> npt.NDArray[np.int_]:
    """Return the numbers of the phases as a row, line by line."""
    return np.asarray(plane_of(phase)[0].values, dtype=int).ravel()
