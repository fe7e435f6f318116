"""Make the page on figs 12 and 13 of the paper: a PS-LDPE blend under the virtual microscope, in two ways.

Run by hand, ``python docs/blend.py``; a few minutes. Everything is seeded, so that the numbers come out again.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

import overtone as ot
from overtone.demo import demo_instrument, demo_probe, record_session
from overtone.errors import CalibrationWarning
from overtone.instrument.phantom import POLYOLEFIN, POLYSTYRENE, blend
from overtone.instrument.scan import scan_with_truth
from overtone.inversion.properties import DETERMINED, WIDEST_DETERMINED
from overtone.io.atomic import atomic_path
from overtone.plots import draw_map, png_bytes
from overtone.plots.categories import PALETTE
from overtone.plots.legends import legend_below
from overtone.plots.scales import scale_of
from overtone.plots.sheet import Sheet
from overtone.plots.text import LABEL_SIZE, TICK_SIZE, label_of, set_title
from overtone.plots.ticks import Ticks, linear_ticks, log_ticks
from overtone.quantities import LIFT
from overtone.report.numbers import percent
from overtone.units import display_unit, format_quantity

Array = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]

FOLDER = Path(__file__).parent
SEED, SHAPE, POISSON_RATIO = 1, (96, 96), 0.35
SETPOINTS, SHOWN = (0.31, 0.42, 0.52), 0.42
BETWEEN = 300.0  # [s] from the start of one scan to that of the next
ACCEPTED = 0.1  # N_r that the paper accepts
MATERIALS = (POLYSTYRENE.name, POLYOLEFIN.name)
LIMITS = {"indentation": (1e-9, 30e-9), "modulus": (10e6, 100e9), "adhesion": (50e-12, 100e-9)}
"""Of the colours and of the histograms, in the order of the columns [SI]."""
WAYS = ("truth", "paper's method", "ours")
PAPER, OURS = PALETTE[5], PALETTE[0]


class Run(NamedTuple):
    """One scan: truth on (y, x), least squares by eqs 19 and by the force that made the data, population, noise."""

    setpoint: float
    truth: xr.Dataset
    paper: xr.Dataset
    full: xr.Dataset
    ours: xr.Dataset
    noise: dict[str, float]


def session() -> list[Run]:
    """Calibrate the microscope of the demonstration once, scan at every set-point and map each scan by itself."""
    probe, instrument = demo_probe(), demo_instrument()
    known = record_session(shape=(4, 4), seed=SEED)  # for its ladder and its approach curve on PS
    reference = ot.Reference(POISSON_RATIO, modulus=2e9, modulus_error=0.1, name=MATERIALS[0])
    runs = []
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", CalibrationWarning)
        calibration = ot.calibrate(known.curve, probe, reference=reference, far_field=known.ladder)
        for i, setpoint in enumerate(SETPOINTS):
            both, truth = scan_with_truth(
                probe,
                blend(shape=SHAPE, seed=SEED),
                instrument,
                setpoint=setpoint,
                poisson_ratio=POISSON_RATIO,
                lift=200e-9,
                time=60.0 + i * BETWEEN,
                seed=SEED + 2 + i,
            )
            lifted = [str(name) for name in both.data_vars if str(name).startswith(LIFT)]
            above = both[lifted].rename({name: name.removeprefix(LIFT) for name in lifted})
            both = both.drop_vars(lifted)
            trace, retrace = (both.sel(direction=way, drop=True) for way in ("trace", "retrace"))
            scan = ot.correct(trace, calibration, lift=above.sel(direction="trace", drop=True))
            runs.append(mapped(setpoint, scan, ot.noise_from_pair(trace, retrace), truth))
    return runs


def mapped(setpoint: float, scan: xr.Dataset, noise: dict[str, float], truth: xr.Dataset) -> Run:
    """Return what the paper's method and ours make of a corrected scan."""
    probe, few, every = ot.probe_of(scan), (0, 1, 2), (0, 1, 2, 3)
    of_all = partial(ot.map_properties, scan, probe, poisson_ratio=POISSON_RATIO, noise=noise)
    paper = of_all(model="dmt-linear", method="least-squares", harmonics=few)
    full = of_all(model="dmt", method="least-squares", harmonics=few)
    ours = of_all(model="dmt", method="population", harmonics=every)
    return Run(setpoint, truth, paper, full, ours, noise)


def pixels_of(run: Run, material: int) -> Mask:
    """Return which pixels truly are a material."""
    return np.asarray(run.truth["material"].values == material)


def true_median(run: Run, name: str, material: int) -> float:
    """Return the median of the truth over the pixels of a material."""
    return float(np.median(run.truth[name].values[pixels_of(run, material)]))


def published(run: Run, name: str, material: int) -> Array:
    """Return what the paper's method says at the pixels of a material, all of which it answers."""
    values = run.paper[f"{name}_unscreened"].values[pixels_of(run, material)]
    return np.asarray(values[np.isfinite(values)])


def phase_of(run: Run, material: int) -> xr.Dataset:
    """Return the phase of ours that most pixels of a material are in."""
    phase = run.ours["phase"].values[pixels_of(run, material)]
    return run.ours.isel(material=int(np.bincount(phase[phase >= 0]).argmax()))


def median_of(run: Run, name: str, material: int) -> tuple[float, float, float]:
    """Return the median of the phase of a material between the ends of its 90 % interval."""
    lower, median, upper = (f"material_{name}{end}" for end in ("_lower", "", "_upper"))
    phase = phase_of(run, material)
    return float(phase[lower]), float(phase[median]), float(phase[upper])


WINDOWS = {"modulus": (20e6, 1e12), "adhesion": (50e-12, 300e-9), "indentation": (0.9e-9, 50e-9)}
"""Of fig 13 [SI]."""
MARKERS = ("o", "s")  # PS, LDPE
APART = 0.007  # of the set-point, between the symbols of one


def veil_of(run: Run, name: str) -> xr.DataArray:
    """Return where ours does not determine a property: by its status, or as its interval spans more than tenfold."""
    span = np.log(run.ours[f"{name}_upper"] / run.ours[f"{name}_lower"])
    return (run.ours["status"] != DETERMINED) | ~(span <= WIDEST_DETERMINED)


def maps_figure(run: Run) -> Figure:
    """Return fig 12: a row of maps for the truth and each method, and how the pixels are distributed."""
    sheet = Sheet.new(4 * len(LIMITS), len(LIMITS), 3.3, 1.0)
    sheet.figure.set_dpi(130)
    for column, (name, limits) in enumerate(LIMITS.items()):
        scale = scale_of(name, "", np.array(limits), None, limits, logarithmic=True)
        refused = run.paper["residual"] >= ACCEPTED
        veils = (None, refused, veil_of(run, name))
        for row, (answer, veil) in enumerate(zip((run.truth, run.paper, run.ours), veils, strict=True)):
            array = answer[f"{name}_unscreened" if row else name].rename(name)
            cell = sheet.cells[3 * row + column]
            draw_map(cell, array, title=f"{WAYS[row]}: {name}", scale=scale, undetermined=veil)
        _draw_histogram(sheet.cells[9 + column], run, name)
    handles: list[Line2D | Patch] = [
        Patch(facecolor="0.75", label="truth"),
        Line2D([], [], color=PAPER, label="the paper's method"),
        Line2D([], [], color=OURS, linestyle="--", label="ours, pixel by itself"),
        Line2D([], [], color=OURS, label="ours, pooled"),
    ]
    return sheet.lay_out(legend=legend_below(sheet.figure, handles))


def _draw_histogram(axes: Axes, run: Run, name: str) -> None:
    low, high = LIMITS[name]
    bins, top = np.geomspace(low, high, 61), 40.0  # what is higher is cut
    answers = (
        (run.truth[name], "0.75", "-", True),
        (run.paper[f"{name}_unscreened"], PAPER, "-", False),
        (run.ours[f"{name}_unpooled"], OURS, "--", False),
        (run.ours[f"{name}_unscreened"], OURS, "-", False),
    )
    factor = _dress(axes, "x", run.truth[name], (low, high))
    for answer, colour, line, fill in answers:
        # What is beyond the ends is counted at the ends.
        inside = np.clip(answer.values[np.isfinite(answer.values)], low * (1.0 + 1e-9), high * (1.0 - 1e-9))
        shares = 100.0 * np.histogram(inside, bins)[0] / answer.size
        axes.stairs(shares, bins * factor, color=colour, linestyle=line, linewidth=1.3, fill=fill)
    axes.set_ylim(0.0, top)
    linear_ticks(0.0, top, 5).put_on(axes.yaxis)
    set_title(axes, f"histograms: {name}")
    axes.set_ylabel("share of the pixels [%]", fontsize=LABEL_SIZE)


def _dress(axes: Axes, which: str, array: xr.DataArray, window: tuple[float, float]) -> float:
    """Give an axis the logarithmic scale of a property, and return the factor from SI to its unit."""
    unit = display_unit(float(np.sqrt(window[0] * window[1])), str(array.attrs["units"]))
    low, high = (end * unit.factor for end in window)
    label = label_of(array, unit.label)
    axes.set(**{f"{which}scale": "log", f"{which}lim": (low, high), f"{which}label": label})
    axis = {"x": axes.xaxis, "y": axes.yaxis}[which]
    axis.label.set_fontsize(LABEL_SIZE)
    log_ticks(low, high, 8).put_on(axis)
    axes.tick_params(labelsize=TICK_SIZE)
    return unit.factor


def setpoints_figure(runs: Sequence[Run]) -> Figure:
    """Return fig 13: properties of both materials against the set-point, truth, the paper's method and ours."""
    sheet = Sheet.new(len(WINDOWS), len(WINDOWS), 3.6, 1.0)
    sheet.figure.set_dpi(130)
    x = np.array([run.setpoint for run in runs])
    for axes, (name, window) in zip(sheet.cells, WINDOWS.items(), strict=True):
        factor = _dress(axes, "y", runs[0].truth[name], window)
        for k, marker in enumerate(MARKERS):
            true = factor * np.array([true_median(run, name, k) for run in runs])
            axes.plot(x, true, "-", color="black", linewidth=1.2)
            axes.annotate(MATERIALS[k], (x[-1] + 0.04, true[-1]), fontsize=TICK_SIZE, va="center")
            fits = [published(run, name, k) for run in runs]
            ours = [median_of(run, name, k) for run in runs]
            paper = [(fit.mean() - fit.std(), fit.mean(), fit.mean() + fit.std()) for fit in fits]
            for ends, colour, place in ((paper, PAPER, k - 2.5), (ours, OURS, k + 1.5)):
                # A bar that reaches zero goes on below the window.
                low, middle, high = factor * np.maximum(np.array(ends).T, 0.01 * window[0])
                axes.vlines(x + place * APART, low, high, color=colour, linewidth=2.0, alpha=0.6)
                axes.plot(x + place * APART, middle, marker, color=colour, mfc="white", markersize=4)
        axes.set_xlim(x[0] - 0.04, x[-1] + 0.1)
        Ticks(tuple(x), tuple(f"{value:g}" for value in x)).put_on(axes.xaxis)
        set_title(axes, name)
        axes.set_xlabel(r"set-point $A_1/A_{1,\mathrm{far}}$", fontsize=LABEL_SIZE)
    handles = [
        Line2D([], [], color="black", label="truth, median"),
        Line2D([], [], color=PAPER, label="the paper's method: mean ± sd of the pixels"),
        Line2D([], [], color=OURS, label="ours: median of the phase, 90 % interval"),
    ]
    for marker, name in zip(MARKERS, MATERIALS, strict=True):
        handles.append(Line2D([], [], color="0.3", marker=marker, mfc="white", linestyle="", label=name))
    return sheet.lay_out(legend=legend_below(sheet.figure, handles))


UNITS = {"modulus": "Pa", "adhesion": "N", "indentation": "m"}


def _short(value: float, name: str = "modulus", digits: int = 2) -> str:
    return format_quantity(float(f"{value:.{digits}g}"), UNITS[name], 6)


def within(run: Run, answer: xr.Dataset, material: int) -> float:
    """Return the share of pixels of a material whose modulus is right to a factor of two."""
    ratio = (answer["modulus_unscreened"] / run.truth["modulus"]).values[pixels_of(run, material)]
    return float(((ratio > 0.5) & (ratio < 2.0)).mean())


def table(runs: Sequence[Run], names: Sequence[str]) -> str:
    """Return properties of both materials by the truth, the paper's method and ours."""
    titles = ("set-point", "", "truth, median", "paper's method: mean ± sd", "its 5, 50, 95 %")
    rows = [[*titles, "ours: median, 90 % interval", "N_r < 0.1"], ["---"] * 7]
    for run, k, name in [(run, k, name) for run in runs for k in range(len(MATERIALS)) for name in names]:
        fit, accepted = published(run, name, k), run.paper["residual"].values[pixels_of(run, k)] < ACCEPTED
        values = (true_median(run, name, k), fit.mean(), fit.std(), *np.quantile(fit, [0.05, 0.5, 0.95]))
        truth, mean, spread, *parts = (_short(float(value), name) for value in values)
        low, middle, high = (_short(value, name) for value in median_of(run, name, k))
        row = [f"{run.setpoint}", f"{MATERIALS[k]}, {name}", truth, f"{mean} ± {spread}", ", ".join(parts)]
        rows.append([*row, f"{middle}, {low} to {high}", percent(float(accepted.mean()))])
    return "\n".join(f"| {' | '.join(row)} |" for row in rows)


def page(runs: Sequence[Run]) -> str:
    """Return the page."""
    run, pairs = runs[SETPOINTS.index(SHOWN)], [(run, k) for run in runs for k in range(len(MATERIALS))]
    ours, hard, noise = run.ours, pixels_of(run, 0), f"{run.noise['A0'] * 1e12:.1f} pm"
    by = {"paper": run.paper, "full": run.full, "ours": ours}
    right = {way: [f"{100.0 * within(run, answer, k):.1f} %" for k in (0, 1)] for way, answer in by.items()}
    full = _short(float(run.full["modulus_unscreened"].where(run.truth["material"] == 1).mean()))
    alone = [_short(float(np.median(ours[f"modulus_unpooled_{e}"].values[hard]))) for e in ("lower", "upper")]
    known = (ours["modulus_lower"] < run.truth["modulus"]) & (run.truth["modulus"] < ours["modulus_upper"])
    held = percent(float(known.mean()))
    bound = percent(float((published(run, "adhesion", 0) < 2e-12).mean()))
    spans = [(median_of(one, name, k), true_median(one, name, k)) for one, k in pairs for name in UNITS]
    inside = sum(low < truth < high for (low, _, high), truth in spans)
    width = max(median_of(one, "modulus", 1)[2] / median_of(one, "modulus", 1)[0] for one in runs)
    accepted = percent(min(float((one.paper["residual"] < ACCEPTED).mean()) for one in runs))
    ratios = [published(one, "modulus", k).mean() / true_median(one, "modulus", k) for one, k in pairs]
    means = " to ".join(f"{float(f'{end:.2g}'):g}" for end in (min(ratios), max(ratios)))
    middles = [[_short(float(np.median(published(one, "modulus", k)))) for one in runs] for k in (0, 1)]
    grey = [percent(float(veil_of(run, name).values[hard].mean())) for name in ("modulus", "adhesion")]
    shrinkage = [f"{np.median(ours['shrinkage'].values[pixels_of(run, k)]):.2f}" for k in (0, 1)]
    (of_PS, of_LDPE), (full_PS, full_LDPE), (ours_PS, ours_LDPE) = right.values()
    return f"""# A polymer blend, mapped in two ways

Figs 12 and 13 of the method's paper (Shaik, Reifenberger and Raman, Nanotechnology 31 (2020) 455502), a PS-LDPE
blend, on the virtual microscope, where the truth is known. `python docs/blend.py` makes this page and its numbers.

**Data** as in `overtone demo`: the lever of the paper; moduli and adhesions of its table, which scatter by 10 % from
pixel to pixel; DMT without loss; {SHAPE[0]} x {SHAPE[1]} pixels; a microscope with drift, crosstalk, gains, air film,
noise ({noise} on A0). It is calibrated once, on PS known to be 2 GPa give or take 10 %. Each of three scans is
corrected by that, anchored to its PS and its lift pass, and mapped by itself. Both ways get the same corrected scans.

**The paper's method** is `least-squares`: eqs 19, harmonics 0 to 2, several starts, each followed to its minimum, the
best kept. **Ours** is [`population`](population.md), harmonics 0 to 3; it holds each pixel by itself (`posterior`) too.

## Fig 12: the maps at set-point {SHOWN}

![Maps and histograms of indentation, modulus and adhesion](images/blend-fig-12.png)

What is beyond a scale has the colour of its end, and counts in the last bar of the histogram; bars are cut at 40 %.
Striped: in the row of the paper's method N_r of 0.1 or more; in ours a status that is not "determined", or a 90 %
interval of the property that spans more than tenfold.

{table([run], tuple(UNITS))}

* **N_r says nothing of the error.** The paper has N_r < 0.1 at more than 90 % of its pixels, here it is {accepted} (in
  the worst scan). And {of_PS} of PS, {of_LDPE} of LDPE have a modulus within a factor of two of the truth, no more.
* At {bound} of the PS the adhesion is at the lower bound of the fit. Eqs 19 are not the reason: with the force that
  made the data {full_PS} and {full_LDPE} are within a factor of two, though the mean of LDPE is {full} then.
* **The paper's scatter is far smaller**, 1.93 ± 0.01 GPa on PS. Its maps may be less noisy; and a search that stops as
  soon as N_r is small scatters little, about a place that its start decides ([more](identifiability.md)).
* **Ours**: within a factor of two {ours_PS} of PS, whose modulus was told, and {ours_LDPE} of LDPE, whose was not. The
  90 % intervals of the moduli hold the truth at {held} of the pixels. Striped on PS: {grey[0]} of the moduli, {grey[1]}
  of the adhesions, which these data do not determine: their medians are the work of a broad prior.
* **Evenness is pooling.** A pixel of PS by itself has a modulus of {alone[0]} to {alone[1]} (medians of the ends).
  Shrinkage is {shrinkage[0]} on PS, {shrinkage[1]} on LDPE, where 0 is the pixel's own data and 1 its phase.
  The even PS of the map is its phase; it says nothing of how pixels of PS differ.

## Fig 13: the properties against the set-point

![Modulus, adhesion and indentation against the set-point](images/blend-fig-13.png)

The paper's method: mean ± standard deviation over the pixels that truly are of the material; bars that reach zero
leave the axis. Ours: the median of the phase; its interval holds what pixels share (zero of A0, phase, gains, tip).

{table(runs, ("modulus",))}

* **The paper's method**: means are {means} times the truth, for some pixels end at the upper bound of the fit.
  Medians: PS {", ".join(middles[0])}; LDPE {", ".join(middles[1])}.
* **Ours**: {inside} of {len(spans)} intervals (three properties, two materials, three set-points) hold the true median.
  That of the modulus of LDPE spans a factor of {width:.2g} at most. An error of the calibration is in all three scans.

Not shown: other forces, viscoelasticity (the paper's reason for its adhesion on LDPE), a changing tip, other seeds.
"""


def main() -> None:
    """Write the figures and the page."""
    runs = session()
    pictures = {"12": maps_figure(runs[SETPOINTS.index(SHOWN)]), "13": setpoints_figure(runs)}
    for name, figure in pictures.items():
        with atomic_path(FOLDER / "images" / f"blend-fig-{name}.png") as temporary:
            temporary.write_bytes(png_bytes(figure))
    (FOLDER / "blend.md").write_text(page(runs), encoding="utf-8")


if __name__ == "__main__":
    main()
