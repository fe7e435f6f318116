"""The figures of a paper with captions and numbers, as far as there are data for them."""

from __future__ import annotations

from collections.abc import Iterator

import xarray as xr

from overtone import plots
from overtone.plots.before_after import before_after_figure
from overtone.plots.observable_space import space_figure
from overtone.plots.phases import phases_figure
from overtone.plots.prediction import prediction_figure
from overtone.plots.profiles import profile_figure
from overtone.plots.property_maps import property_maps_figure
from overtone.plots.setpoints import setpoint_figure
from overtone.report import captions
from overtone.report.paper_content import Paper, PaperFigure
from overtone.report.paper_data import (
    check_data,
    force_data,
    phase_data,
    profile_data,
    property_data,
    readings_data,
    scatters_of,
    setpoint_data,
    space_data,
)
from overtone.report.results import properties_in, undetermined

NAMES = (
    "figure_observables",
    "figure_properties",
    "figure_phases",
    "figure_space",
    "figure_profiles",
    "figure_check",
    "figure_setpoints",
    "figure_forces",
    "figure_energy",
    "figure_calibration",
)
"""What the files of the figures are called, in the order in which they are shown."""


def paper_figures(paper: Paper) -> Iterator[PaperFigure | str]:
    """Yield every figure there are data for, and a sentence for each that is left out.

    Parameters
    ----------
    paper : Paper
        What to show.
    """
    yield _observables(paper)
    if paper.before is None:
        yield "Observables before correction: the scan as it was read was not given."
    yield _properties(paper)
    if paper.height is None:
        yield "Shaded relief: the topography was not recorded."
    yield _phases(paper)
    yield from _space(paper)
    yield from _profiles(paper)
    yield from _check(paper)
    yield from _setpoints(paper)
    yield from _forces(paper)
    yield from _calibration(paper)


def _observables(paper: Paper) -> PaperFigure:
    if paper.before is None:
        figure = plots.observables_figure(paper.observables)
        title, caption = "Observables", "Colours run from the 2nd to the 98th percentile of every map."
    else:
        figure = before_after_figure(paper.before, paper.observables)
        title, caption = (
            "Observables before and after correction",
            "Both colour scales of a signal are equally wide, each about its own map, so that the same step of colour "
            "is the same difference; where drift makes the map as read more than four times as wide, each has its own. "
            "Phases of higher harmonics are counted from that of the first.",
        )
    return PaperFigure("figure_observables", title, caption, figure, {"": readings_data(paper)})


def _properties(paper: Paper) -> PaperFigure:
    nowhere = f"{captions.NOWHERE} " if bool(undetermined(paper.result).all()) else ""
    relief = " Shades are the topography, lit from the upper left." if paper.height is not None else ""
    caption = f"{nowhere}{captions.INTERVALS}{relief} Values are pooled over the pixels of a phase."
    figure = property_maps_figure(paper.result, paper.height)
    return PaperFigure("figure_properties", "Properties", caption, figure, {"": property_data(paper)})


def _phases(paper: Paper) -> PaperFigure:
    return PaperFigure(
        "figure_phases",
        "Phases and shrinkage",
        captions.PHASES,
        phases_figure(paper.result),
        {"": phase_data(paper)},
    )


def _space(paper: Paper) -> Iterator[PaperFigure | str]:
    scatters = scatters_of(paper)
    if not scatters:
        yield "Scatter of the observables: neither A0 nor A2 was recorded."
        return
    caption = (
        "Every pixel in the colour of its phase, grey for those of none. The outermost 0.1 % on each side may lie "
        "beyond the frames; the table holds all."
    )
    figure = space_figure(scatters, paper.result["phase"])
    yield PaperFigure(
        "figure_space", "Phases in the space of the observables", caption, figure, {"": space_data(paper)}
    )


def _profiles(paper: Paper) -> Iterator[PaperFigure | str]:
    names = tuple(name for name in properties_in(paper.result) if f"{name}_lower" in paper.result)
    if not names:
        yield "Line profiles: the result has no intervals."
        return
    profile, which = profile_data(paper)
    truth = any(f"{name}_truth" in profile for name in names)
    caption = (
        f"Along the line that crosses most phases ({which}). Blue: median and 90 % interval of the pixels pooled with "
        "their phase, dots where determined. Grey: the same of each pixel alone, as far as it fits. "
        + ("Dashed: the truth of the simulation. " if truth else "")
        + "Colours along the foot are the phases."
    )
    yield PaperFigure(
        "figure_profiles", "Line profiles", caption, profile_figure(profile, names, which), {"": profile}
    )
    if paper.truth is None:
        yield "Truth along the profiles: not known."


def _check(paper: Paper) -> Iterator[PaperFigure | str]:
    data = check_data(paper.result)
    if data is None or not paper.result.sizes["material"]:
        yield (
            "Predictive check: there are no phases to check."
            if data is not None
            else "Predictive check: the result holds none."
        )
        return
    yield PaperFigure(
        "figure_check", "Predictive check", captions.CHECK, prediction_figure(paper.result), {"": data}
    )


def _setpoints(paper: Paper) -> Iterator[PaperFigure | str]:
    if not paper.others:
        yield "Dependence on the set-point: no results at further set-points were given."
        return
    data, names = setpoint_data(paper)
    if not names or not data.sizes["material"]:
        yield "Dependence on the set-point: there are no materials to follow."
        return
    caption = (
        "Medians of the materials at each set-point. Thin bars: 90 % intervals; thick: the part of noise and scatter. "
        "Modulus and adhesion of a material do not depend on the set-point, its indentation does."
    )
    yield PaperFigure(
        "figure_setpoints", "Dependence on the set-point", caption, setpoint_figure(data, names), {"": data}
    )


def _forces(paper: Paper) -> Iterator[PaperFigure | str]:
    if paper.energies is None:
        yield "Forces and energies: not given."
        return
    data = force_data(paper.energies)
    forces = [name for name in data.data_vars if str(name).startswith("F_")]
    rest = [name for name in data.data_vars if name not in forces]
    if forces:
        caption = (
            "Fourier coefficients of the force on the tip, conservative (cosine) and dissipative (sine)."
        )
        figure = plots.forces_figure(paper.energies)
        yield PaperFigure("figure_forces", "Force harmonics", caption, figure, {"": data[forces]})
    if rest:
        caption = "Energy lost per cycle and virial, which follow from amplitude and phase alone."
        figure = plots.energy_figure(paper.energies)
        yield PaperFigure("figure_energy", "Energy", caption, figure, {"": data[rest]})


def _calibration(paper: Paper) -> Iterator[PaperFigure | str]:
    known = paper.curves
    if known is None or known.raw is None or known.corrected is None:
        yield "Approach curve of the calibration: not given."
        return
    figure = plots.calibration_figure(known.raw, known.corrected, known.calibration, known.far_field)
    both = {
        f"{name}_{word}": curve[name].reset_coords(drop=True)
        for word, curve in (("read", known.raw), ("corrected", known.corrected))
        for name in curve.data_vars
        if curve[name].dims == ("z",)
    }
    data = {"": xr.Dataset(both)}
    if known.calibration.curve:
        units = {"phi1": "rad"}
        data["_fit"] = xr.Dataset(
            {
                name: ("point", values, {"units": units.get(name, "m")})
                for name, values in known.calibration.curve.items()
            }
        )
    yield PaperFigure("figure_calibration", "Approach curve before and after", captions.CURVE, figure, data)
