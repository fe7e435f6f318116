"""Make the figures and the numbers of the page on what three harmonics tell, and on figs 7 and 10 of the paper.

Run by hand, ``python docs/identifiability.py``; a minute. Everything is seeded, so that the numbers come out
again. The words of the page are in ``docs/identifiability_words.txt``, with ``${name}`` for each number.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from string import Template
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy.optimize import least_squares as scipy_least_squares

import overtone as ot
from overtone.contact import terms
from overtone.instrument.noise import add_noise
from overtone.inversion import least_squares
from overtone.inversion.linear import Contact, stiffness, term_harmonics
from overtone.inversion.result import STATUS_MEANINGS
from overtone.io.atomic import atomic_path
from overtone.plots import png_bytes
from overtone.plots.canvas import new_figure
from overtone.plots.categories import PALETTE
from overtone.plots.text import LABEL_SIZE, TICK_SIZE, TITLE_SIZE
from overtone.units import format_quantity

Array = npt.NDArray[np.float64]

FOLDER = Path(__file__).parent
SEED = 2020
RADIUS, POISSON_RATIO, TIP_MODULUS, A0 = 10e-9, 0.3, 130e9, 0.2e-9
SETS = {"(0, 1, 2)": (0, 1, 2), "(1, 2, 3)": (1, 2, 3), "(0, 1, 2, 3)": (0, 1, 2, 3)}
ACCEPTED = 0.1  # N_r that the paper accepts
LIMITS = least_squares.MIN_INDENTATION, 1e12  # [m], and of the modulus [Pa]
ADHESION_BOUND = 1e-12
BANDWIDTH = 250.0  # [Hz]: 256 pixels in half a second
LOWER, UPPER = np.log([1e4, ADHESION_BOUND, LIMITS[0]]), np.log([LIMITS[1], 1e-6, 1.0])
CONTACT = Contact(
    terms.LINEAR_TAIL, A0, 0.91 / TIP_MODULUS, 1.0 - POISSON_RATIO**2, 4.0 / 3.0 * math.sqrt(RADIUS)
)
SETPOINT = 0.42
STARTS = (
    (2e9, 2e-9, 2.5e-9),
    (0.5e9, 2e-9, 2.5e-9),
    (8e9, 2e-9, 2.5e-9),
    (2e9, 20e-9, 2.5e-9),
    (1e9, 10e-9, 5e-9),
    (0.1e9, 10e-9, 10e-9),
)
"""Modulus [Pa], adhesion [N] and indentation [m] from which least squares sets out; the first near the truth of PS."""
PIXELS = (32, 32)
OF_THE_MAP = 256 * 256
SEARCHED = 64  # pixels of the slower search
SHARED = {
    "none": {},
    "+1 pm of A0": {"A0": 1e-12},
    "-1 pm of A0": {"A0": -1e-12},
    "+1 degree of phi1": {"phi1": math.radians(1.0)},
    "-1 degree of phi1": {"phi1": -math.radians(1.0)},
}
SEEN = ("A0", "A1", "phi1", "A2", "phi2")


class Material(NamedTuple):
    """A line of the paper's table."""

    modulus: float
    adhesion: float
    indentation: float


PS = Material(1.93e9, 1.91e-9, 2.42e-9)
LDPE = Material(93.78e6, 16.24e-9, 17.54e-9)
MATERIALS = {"PS": PS, "LDPE": LDPE}
MAP_AMPLITUDE = 39.1e-9


def probe_of_the_maps() -> ot.Probe:
    """Return the lever of sections 4.1 and 4.2 of the paper."""
    return ot.Probe.simple(
        stiffness=16.4,
        frequency=161.8e3,
        quality_factor=287.0,
        radius=RADIUS,
        drive_frequency=161.8e3,
        free_amplitude=94e-9,
    )


def probe_of_section_3() -> ot.Probe:
    """Return the lever of section 3 of the paper."""
    return ot.Probe.simple(
        stiffness=26.0,
        frequency=303e3,
        quality_factor=456.0,
        radius=RADIUS,
        drive_frequency=303e3,
        free_amplitude=85e-9,
    )


def cons(model: str, modulus: Any, adhesion: Any, indentation: Any, amplitude: Any) -> Array:
    """Return CONS_n, n = 0..3, of a contact [N], harmonics last."""
    found = ot.force_harmonics(
        model,
        modulus=modulus,
        adhesion=adhesion,
        indentation=indentation,
        amplitude=amplitude,
        radius=RADIUS,
        poisson_ratio=POISSON_RATIO,
        n_max=3,
    )
    return np.asarray(found.real)


# --- 1. how far harmonics tell modulus from adhesion ------------------------------------------------------------


def amplification(Delta: float, orders: Sequence[int], known: str = "") -> float:
    """Return the error of ln E per independent relative error of each harmonic.

    Contact alone, without attraction outside, ``F_ad/(Lambda delta^1.5) = 0.3``.

    Parameters
    ----------
    Delta : float
        delta_max/(2 A1).
    orders : sequence of int
        Conservative harmonics.
    known : str
        ``adhesion`` or ``indentation``, where it need not be found.
    """
    A, E = 40e-9, 1e8
    depth = 2.0 * A * Delta
    Lambda = 4.0 / 3.0 * math.sqrt(RADIUS) / (0.91 / TIP_MODULUS + (1.0 - POISSON_RATIO**2) / E)
    at = np.log([E, 0.3 * Lambda * depth**1.5, depth])
    step, columns = 1e-4, []
    for i, name in enumerate(("modulus", "adhesion", "indentation")):
        if name == known:
            continue
        up, down = at.copy(), at.copy()
        up[i] += step
        down[i] -= step
        columns.append(
            (cons("dmt-contact", *np.exp(up), A) - cons("dmt-contact", *np.exp(down), A)) / (2.0 * step)
        )
    here = cons("dmt-contact", *np.exp(at), A)
    J = (np.stack(columns, axis=1) / np.abs(here)[:, None])[list(orders)]
    return float(np.linalg.norm(np.linalg.pinv(J, rcond=1e-12)[0]))


def least_residual(material: Material, orders: Sequence[int], moduli: Array) -> Array:
    """Return the smallest N_r that any adhesion and indentation leave at given moduli, for harmonics without noise."""
    rows = list(orders)
    data = cons("dmt-linear", *material, MAP_AMPLITUDE)[rows]
    deepest = 2.0 * MAP_AMPLITUDE * (1.0 - 1e-6)

    def at(modulus: float, depth: Array) -> Array:
        a = cons("dmt-linear", modulus, 0.0, depth, MAP_AMPLITUDE)
        b = (cons("dmt-linear", modulus, 1e-9, depth, MAP_AMPLITUDE) - a) / 1e-9
        a, b = a[:, rows] / data, b[:, rows] / data
        adhesion = np.maximum(((1.0 - a) * b).sum(axis=1) / (b * b).sum(axis=1), 0.0)
        return np.asarray(np.linalg.norm(a + adhesion[:, None] * b - 1.0, axis=1))

    found = np.empty(moduli.size)
    for i, modulus in enumerate(moduli):
        depth = np.geomspace(LIMITS[0], deepest, 400)
        for _ in range(3):  # finer around the best
            best = int(at(modulus, depth).argmin())
            depth = np.geomspace(depth[max(best - 1, 0)], depth[min(best + 1, depth.size - 1)], 60)
        found[i] = at(modulus, depth).min()
    return found


def accepted(material: Material, orders: Sequence[int]) -> tuple[float, float]:
    """Return the least and the largest modulus that N_r below 0.1 accepts [Pa], up to 1 TPa."""
    moduli = np.geomspace(1e6, LIMITS[1], 361)
    fine = moduli[least_residual(material, orders, moduli) < ACCEPTED]
    return float(fine.min()), float(fine.max())


def held(
    material: Material,
    shape: tuple[int, ...] = (),
    *,
    setpoint: float = SETPOINT,
    probe: ot.Probe | None = None,
) -> xr.Dataset:
    """Return observables of a lossless DMT contact, under the lever of the maps unless stated, by the simulator."""
    sample = ot.sample(
        "dmt",
        modulus=np.full(shape, material.modulus) if shape else material.modulus,
        poisson_ratio=POISSON_RATIO,
        adhesion=material.adhesion,
    )
    return ot.hold_amplitude(probe or probe_of_the_maps(), sample, setpoint=setpoint)


def interval(
    material: Material,
    orders: Sequence[int],
    *,
    probe: ot.Probe | None = None,
    setpoint: float = SETPOINT,
    noise: Mapping[str, float] | None = None,
    priors: Mapping[str, ot.Prior] | None = None,
) -> xr.Dataset:
    """Return the posterior of a pixel that reads what it should, at ordinary noise unless stated."""
    return ot.map_properties(
        held(material, setpoint=setpoint, probe=probe),
        probe or probe_of_the_maps(),
        model="dmt",
        poisson_ratio=POISSON_RATIO,
        harmonics=orders,
        noise=noise,
        priors=priors,
    )


def measures() -> dict[str, xr.Dataset]:
    """Return what each of several measures makes of the interval of PS."""
    probe = probe_of_the_maps()
    lower = {A: replace(probe, drive=replace(probe.drive, free_amplitude=A)) for A in (40e-9, 20e-9)}
    softer = ot.Probe.simple(
        stiffness=3.0,
        frequency=75e3,
        quality_factor=150.0,
        radius=RADIUS,
        drive_frequency=75e3,
        free_amplitude=94e-9,
    )
    few, every = (0, 1, 2), (0, 1, 2, 3)
    known = {"adhesion": ot.Prior("normal", PS.adhesion, 0.1 * PS.adhesion)}
    return {
        "harmonics 0 to 2": interval(PS, few),
        "harmonics 0 to 3; the lines below change one thing of this": interval(PS, every),
        "noise of A0 1 pm instead of 5 pm": interval(PS, every, noise={"A0": 1e-12}),
        "noise of A2 and A3 0.2 pm instead of 1 pm": interval(
            PS, every, noise={"A2": 0.2e-12, "A3": 0.2e-12}
        ),
        "adhesion known to 10 %": interval(PS, every, priors=known),
        "set-point 0.2 instead of 0.42": interval(PS, every, setpoint=0.2),
        "free amplitude 40 nm instead of 94 nm": interval(PS, every, probe=lower[40e-9]),
        "free amplitude 20 nm": interval(PS, every, probe=lower[20e-9]),
        "softer lever: 3 N/m, 75 kHz, Q = 150": interval(PS, every, probe=softer),
    }


# --- 2. least squares from one start ----------------------------------------------------------------------------


def noisy_scan(material: Material, shared: Mapping[str, float], seed: int = SEED) -> xr.Dataset:
    """Return a scan of one material at ordinary noise, with errors that every pixel shares."""
    scan = add_noise(held(material, PIXELS), seed=seed)
    return scan.assign({name: scan[name] + off for name, off in shared.items()})


def forces_of(scan: xr.Dataset) -> tuple[Array, Array]:
    """Return CONS_n, n = 0..2, of every pixel [N] and its amplitude [m]."""
    f = ot.to_force_harmonics(scan[[*SEEN]], probe_of_the_maps())["F_cons"]
    f = f.sel(harmonic=[0, 1, 2]).transpose(..., "harmonic")
    return np.ascontiguousarray(f.values.reshape(-1, 3)), scan["A1"].values.ravel().copy()


class Fitted(NamedTuple):
    """Answers of a scan, one a pixel."""

    modulus: Array
    adhesion: Array
    indentation: Array
    residual: Array


def converged(force: Array, amplitude: Array, start: Sequence[float]) -> Fitted:
    """Return what the published estimator ends in from one start, followed to the minimum."""
    size = amplitude.size
    x, norm = np.empty((size, 3)), np.empty(size)
    least_squares.fit_pixels(
        force,
        np.arange(3),
        amplitude,
        CONTACT,
        LOWER,
        UPPER,
        np.log(start),
        x,
        norm,
        np.empty((size, 3)),
        np.empty(size, np.int8),
    )
    return Fitted(*np.exp(x.T), norm)


def searched(force: Array, amplitude: Array, start: Sequence[float], most: int = 300) -> Fitted:
    """Return the way there of an ordinary solver with its own settings: the best point so far (evaluation, pixel).

    ``scipy.optimize.least_squares`` on the logarithms of the unknowns and the relative residuals of the harmonics, with
    their derivatives.
    """
    work, orders = np.empty((4, 3)), np.arange(3)
    ways = []
    for observed, A in zip(force, amplitude, strict=True):
        way: list[Array] = []

        def harmonics(x: Array, A: float = A) -> tuple[float, float]:
            term_harmonics(CONTACT, A, math.exp(x[2]) / (2.0 * A), orders, work)
            return stiffness(CONTACT, math.exp(x[0]))

        def residual(x: Array, observed: Array = observed, way: list[Array] = way) -> Array:
            Lambda, _ = harmonics(x)
            r = (Lambda * work[0] + math.exp(x[1]) * work[2] - observed) / np.abs(observed)
            norm = float(np.linalg.norm(r))
            way.append(way[-1] if way and way[-1][3] < norm else np.append(x, norm))
            return np.asarray(r)

        def slopes(x: Array, observed: Array = observed, A: float = A) -> Array:
            Lambda, share = harmonics(x)
            adhesion, Delta = math.exp(x[1]), math.exp(x[2]) / (2.0 * A)
            columns = [
                Lambda * share * work[0],
                adhesion * work[2],
                Delta * (Lambda * work[1] + adhesion * work[3]),
            ]
            return np.asarray(np.stack(columns, axis=1) / np.abs(observed)[:, None])

        top = math.log(2.0 * A * least_squares.MAX_DELTA)
        bounds = LOWER, np.array([UPPER[0], UPPER[1], top])
        scipy_least_squares(residual, np.log(start), jac=slopes, bounds=bounds, max_nfev=most)
        ways.append(np.array(way))
    longest = max(map(len, ways))
    x = np.stack([np.pad(way, ((0, longest - len(way)), (0, 0)), "edge") for way in ways], axis=1)
    return Fitted(*np.exp(np.moveaxis(x[..., :3], 2, 0)), x[..., 3])


def stopped(way: Fitted, below: float) -> Fitted:
    """Return where each pixel stood when N_r was first below a limit; NaN where it never was."""
    first = np.argmax(way.residual < below, axis=0)
    never = ~(way.residual < below).any(axis=0)
    return Fitted(*(np.where(never, np.nan, np.take_along_axis(part, first[None], 0)[0]) for part in way))


# --- 3, 4. figs 7 and 10 of the paper ---------------------------------------------------------------------------


class Curve(NamedTuple):
    """Truth and estimates along the set-point."""

    setpoint: Array
    read: xr.Dataset
    """Observables with noise."""
    truth: xr.Dataset
    """modulus, adhesion, indentation."""
    published: xr.Dataset
    exact: xr.Dataset
    posterior: xr.Dataset


def curve_of(probe: ot.Probe, modulus: float, adhesion: float, setpoint: Array, *, noisy: bool) -> Curve:
    """Return estimates along set-points of one material.

    Parameters
    ----------
    probe : Probe
        The lever.
    modulus, adhesion : float
        Of the sample [Pa, N]; a DMT contact without loss.
    setpoint : array (setpoint,)
        A1/A1far.
    noisy : bool
        Whether the published method sees the noise that the posterior sees, or none. The exact solution sees none.
    """
    sample = ot.sample("dmt", modulus=modulus, poisson_ratio=POISSON_RATIO, adhesion=adhesion)
    clean = ot.hold_amplitude(probe, sample, setpoint=setpoint, n_max=40)
    read = add_noise(clean, seed=SEED)
    truth = xr.Dataset({"indentation": clean["indentation"]})
    truth = truth.assign(
        modulus=xr.full_like(truth["indentation"], modulus),
        adhesion=xr.full_like(truth["indentation"], adhesion),
    )
    return Curve(
        setpoint,
        read,
        truth,
        ot.map_properties(
            read if noisy else clean,
            probe,
            model="dmt-linear",
            method="least-squares",
            harmonics=(0, 1, 2),
            poisson_ratio=POISSON_RATIO,
        ),
        ot.map_properties(
            clean, probe, model="dmt", method="exact", harmonics=(0, 1, 2), poisson_ratio=POISSON_RATIO
        ),
        ot.map_properties(read, probe, model="dmt", poisson_ratio=POISSON_RATIO),
    )


def fig_7(setpoint: Array) -> Curve:
    """Return the case of fig 7: 1 GPa, 20 nN."""
    return curve_of(probe_of_section_3(), 1e9, 20e-9, setpoint, noisy=False)


def fig_10(setpoint: Array) -> Curve:
    """Return the case of fig 10: polystyrene as the paper's table has it."""
    return curve_of(probe_of_the_maps(), PS.modulus, PS.adhesion, setpoint, noisy=True)


def early_10(curve: Curve) -> Fitted:
    """Return what the ordinary solver has for fig 10 when N_r is first below 0.1."""
    return stopped(searched(*forces_of(curve.read), STARTS[0]), ACCEPTED)


# --- figures ----------------------------------------------------------------------------------------------------

TRUTH, OURS, PAPER, EARLY = "#000000", PALETTE[0], PALETTE[5], PALETTE[1]
LINES = dict(zip(SETS, ((PALETTE[0], "-"), (PALETTE[5], "--"), (PALETTE[2], "-.")), strict=True))


def _figure(width: float, height: float) -> Figure:
    figure = new_figure(width, height)
    figure.set_dpi(150)
    return figure


def _dress(axes: Axes, x: str, y: str, title: str = "") -> None:
    axes.set_xlabel(x, fontsize=LABEL_SIZE)
    axes.set_ylabel(y, fontsize=LABEL_SIZE)
    axes.set_title(title, fontsize=TITLE_SIZE, loc="left")
    axes.tick_params(labelsize=TICK_SIZE)
    axes.grid(color="0.9", linewidth=0.6)
    axes.set_axisbelow(True)


def residual_figure(intervals: Mapping[str, Mapping[str, xr.Dataset]]) -> Figure:
    """Return the least residual at every modulus, and below it what the posterior leaves of the moduli."""
    figure = _figure(9.0, 5.0)
    panels = figure.subplots(2, 2, sharex=True, sharey="row", height_ratios=(5, 1))
    moduli = np.geomspace(1e6, LIMITS[1], 300)
    for (axes, strip), (name, material), letter in zip(panels.T, MATERIALS.items(), "ab", strict=True):
        for row, (title, orders) in enumerate(SETS.items()):
            colour, line = LINES[title]
            axes.loglog(
                moduli / 1e9,
                np.maximum(least_residual(material, orders, moduli), 1e-6),
                line,
                color=colour,
                linewidth=1.5,
                label=f"harmonics {title.strip('()')}",
            )
            left = intervals[name][title]
            ends = [float(left[f"modulus_{end}"]) / 1e9 for end in ("lower", "upper")]
            strip.plot(ends, [-row, -row], "-", color=colour, linewidth=4.0, solid_capstyle="butt")
        axes.axhline(ACCEPTED, color="0.4", linewidth=1.0, linestyle=":")
        for one in (axes, strip):
            one.axvline(material.modulus / 1e9, color=TRUTH, linewidth=0.8)
        axes.set_ylim(1e-4, 3.0)
        axes.set_xlim(1e-3, 1e3)
        strip.set_ylim(-2.7, 0.7)
        y = "least $N_r$ at this modulus" if letter == "a" else ""
        _dress(axes, "", y, f"({letter}) {name}, {_pa(material.modulus, 3)}")
        _dress(strip, "modulus of the sample [GPa]", "")
        strip.set_yticks([])
    panels[0, 0].text(900.0, 0.11, "accepted below", fontsize=TICK_SIZE, color="0.4", ha="right", va="bottom")
    panels[1, 0].set_ylabel("90 %\nintervals", fontsize=LABEL_SIZE)
    handles, labels = panels[0, 0].get_legend_handles_labels()
    figure.tight_layout(rect=(0.0, 0.05, 1.0, 1.0))
    figure.legend(handles, labels, fontsize=LABEL_SIZE, ncols=3, frameon=False, loc="lower center")
    return figure


def start_figure(ways: Sequence[Fitted]) -> Figure:
    """Return modulus and residual on the way of the search on PS, from every start."""
    figure = _figure(9.0, 5.0)
    left, right = figure.subplots(1, 2, sharex=True)
    for i, (start, way) in enumerate(zip(STARTS, ways, strict=True)):
        count = np.arange(1, way.modulus.shape[0] + 1)
        low, middle, high = np.quantile(way.modulus, [0.05, 0.5, 0.95], axis=1) / 1e9
        residual, colour = np.median(way.residual, axis=1), PALETTE[i]
        if i == 0:
            left.fill_between(count, low, high, color=colour, alpha=0.15, linewidth=0)
        left.loglog(count, middle, "-", color=colour, linewidth=1.5, label=_start(start))
        right.loglog(count, residual, "-", color=colour, linewidth=1.5)
        first = int(np.argmax(residual < ACCEPTED))
        left.plot(count[first], middle[first], "o", color=colour, markersize=6)
        right.plot(count[first], residual[first], "o", color=colour, markersize=6)
    left.axhline(PS.modulus / 1e9, color=TRUTH, linewidth=1.0, label="truth")
    right.axhline(ACCEPTED, color="0.4", linewidth=1.0, linestyle=":")
    right.text(290, 0.11, "accepted below", fontsize=TICK_SIZE, color="0.4", ha="right", va="bottom")
    left.set_xlim(1, 300)
    left.set_ylim(1e-2, 3e1)
    right.set_ylim(1e-4, 1e1)
    _dress(left, "evaluations", "modulus [GPa]", "(a) answer, median of the pixels")
    _dress(right, "evaluations", "$N_r$, median of the pixels", "(b) residual")
    handles, labels = left.get_legend_handles_labels()
    figure.tight_layout(rect=(0.0, 0.1, 1.0, 1.0))
    figure.legend(handles, labels, fontsize=LABEL_SIZE, ncols=4, frameon=False, loc="lower center")
    return figure


def _start(start: Sequence[float]) -> str:
    units = zip(start, ("Pa", "N", "m"), strict=True)
    return ", ".join(_quantity(value, unit) for value, unit in units)


QUANTITIES = {
    "modulus": ("modulus [GPa]", 1e9),
    "adhesion": ("adhesion [nN]", 1e-9),
    "indentation": ("indentation [nm]", 1e-9),
}


def _draw_curve(axes: Axes, curve: Curve, name: str, *, connected: bool) -> None:
    _, unit = QUANTITIES[name]
    x, found = curve.setpoint, curve.posterior
    middle, low, high = (found[f"{name}{end}"].values / unit for end in ("_unscreened", "_lower", "_upper"))
    axes.plot(x, curve.truth[name] / unit, "-", color=TRUTH, linewidth=1.2, label="truth")
    axes.vlines(x, low, high, color=OURS, linewidth=2.2, alpha=0.55, label="ours, posterior: median, 90 %")
    axes.plot(x, middle, "_", color=OURS, markersize=7, markeredgewidth=1.6)
    axes.plot(
        x,
        curve.exact[f"{name}_unscreened"] / unit,
        "x",
        color=OURS,
        markersize=5,
        label="ours, exact, no noise",
    )
    axes.plot(
        x,
        curve.published[f"{name}_unscreened"] / unit,
        "o-" if connected else "o",
        color=PAPER,
        markersize=4.5,
        mfc="none",
        linewidth=1.0,
        label="least squares, eqs 19" + (", no noise" if connected else ", followed to its minimum"),
    )


def fig_7_figure(curve: Curve) -> Figure:
    """Return fig 7 of the paper on simulated data: modulus, adhesion and indentation along the set-point."""
    figure = _figure(9.0, 4.3)
    panels = figure.subplots(1, 3, sharex=True)
    limits = {"modulus": (1e-2, 1e3), "adhesion": (0.0, None), "indentation": (0.0, None)}
    for axes, (name, (label, unit)), letter in zip(panels, QUANTITIES.items(), "abc", strict=True):
        truth = curve.truth[name].values / unit
        if name != "indentation":
            axes.fill_between(
                curve.setpoint, 0.9 * truth, 1.1 * truth, color="0.85", linewidth=0, label="10 %"
            )
        _draw_curve(axes, curve, name, connected=True)
        axes.set_ylim(*limits[name])
        _dress(axes, "set-point ratio", label, f"({letter})")
    panels[0].set_yscale("log")
    handles, labels = panels[0].get_legend_handles_labels()
    figure.tight_layout(rect=(0.0, 0.12, 1.0, 1.0), w_pad=1.5)
    figure.legend(handles, labels, fontsize=LABEL_SIZE, ncols=3, frameon=False, loc="lower center")
    return figure


def fig_10_figure(curve: Curve, early: Fitted) -> Figure:
    """Return fig 10 of the paper on simulated data: the same with N_r, for polystyrene."""
    figure = _figure(9.0, 6.8)
    panels = figure.subplots(2, 2, sharex=True)
    for axes, (name, (label, unit)), letter in zip(panels.flat, QUANTITIES.items(), "abc", strict=False):
        _draw_curve(axes, curve, name, connected=False)
        axes.plot(
            curve.setpoint,
            getattr(early, name) / unit,
            "^-",
            color=EARLY,
            markersize=5,
            linewidth=1.0,
            label=f"least squares from {_start(STARTS[0])}, stopped",
        )
        axes.set_yscale("log")
        _dress(axes, "", label, f"({letter})")
    handles, labels = panels[0, 0].get_legend_handles_labels()
    last = panels[1, 1]
    last.semilogy(
        curve.setpoint,
        np.maximum(curve.published["residual"], 1e-16),
        "o",
        color=PAPER,
        markersize=4.5,
        mfc="none",
    )
    last.semilogy(curve.setpoint, early.residual, "^-", color=EARLY, markersize=5, linewidth=1.0)
    last.axhline(ACCEPTED, color="0.4", linewidth=1.0, linestyle=":")
    last.text(0.9, 0.15, "accepted below", fontsize=TICK_SIZE, color="0.4", ha="right", va="bottom")
    last.set_ylim(1e-17, 10.0)
    _dress(last, "set-point ratio", "$N_r$", "(d)")
    panels[1, 0].set_xlabel("set-point ratio", fontsize=LABEL_SIZE)
    panels[0, 0].set_ylim(2e-3, 1e3)
    panels[0, 1].text(
        0.9, 1.25e-3, "bound of the fit", fontsize=TICK_SIZE, color="0.4", ha="right", va="bottom"
    )
    figure.tight_layout(rect=(0.0, 0.09, 1.0, 1.0))
    figure.legend(handles, labels, fontsize=LABEL_SIZE, ncols=2, frameon=False, loc="lower center")
    return figure


# --- the page ---------------------------------------------------------------------------------------------------

DELTAS = (0.01, 0.03, 0.1, 0.2, 0.5)
KNOWN = {"F_ad known": "adhesion", "indentation known": "indentation"}


def amplification_table() -> str:
    """Return the amplification by Delta as a table."""
    lines = [f"| Delta | {' | '.join([*SETS, *KNOWN])} |", "|---" * (1 + len(SETS) + len(KNOWN)) + "|"]
    for Delta in DELTAS:
        cells = [amplification(Delta, orders) for orders in SETS.values()]
        cells += [amplification(Delta, (0, 1, 2), known) for known in KNOWN.values()]
        lines.append(f"| {Delta} | {' | '.join(_short(cell) for cell in cells)} |")
    return "\n".join(lines)


def _short(value: float) -> str:
    return f"{float(f'{value:.2g}'):g}" if value < 9950 else f"{value:.0e}".replace("e+0", "e")


def _quantity(value: float, unit: str, digits: int = 2) -> str:
    return format_quantity(float(f"{value:.{digits}g}"), unit, 6)


def _pa(value: float, digits: int = 2) -> str:
    return _quantity(value, "Pa", digits)


def _range(low: float, high: float, unit: str = "Pa") -> str:
    return f"{_quantity(low, unit)} to {_quantity(high, unit)}"


def ratio_table() -> str:
    """Return the ratios of the harmonics of both materials as a table."""
    lines = ["| | Delta | F0 | F1 | F2 | F3 |", "|---|---|---|---|---|---|"]
    lines.append("| any force, shortest contact | 0 | 1 | -2 | 2 | -2 |")
    for name, material in MATERIALS.items():
        f = cons("dmt-linear", *material, MAP_AMPLITUDE)
        Delta = material.indentation / (2.0 * MAP_AMPLITUDE)
        lines.append(f"| {name} | {Delta:.3f} | {' | '.join(f'{value:.2f}' for value in f / f[0])} |")
    return "\n".join(lines)


def accepted_table(intervals: Mapping[str, Mapping[str, xr.Dataset]]) -> str:
    """Return what N_r accepts and what the posterior leaves as a table."""
    lines = [
        "| | harmonics | N_r below 0.1 | 90 % interval, ordinary noise | adhesion | indentation | status |",
        "|---|---|---|---|---|---|---|",
    ]
    for name, material in MATERIALS.items():
        for title, orders in SETS.items():
            low, high = accepted(material, orders)
            left = intervals[name][title]
            cells = [_range(low, high), _range(float(left["modulus_lower"]), float(left["modulus_upper"]))]
            for quantity, unit in (("adhesion", "N"), ("indentation", "m")):
                ends = [float(left[f"{quantity}_{end}"]) for end in ("lower", "upper")]
                cells.append(_range(ends[0], ends[1], unit))
            meaning = STATUS_MEANINGS[int(left["status"])].replace("_", " ")
            lines.append(f"| {name} | {title} | {' | '.join(cells)} | {meaning} |")
    return "\n".join(lines)


def measures_table(found: Mapping[str, xr.Dataset]) -> str:
    """Return what measures do as a table."""
    lines = ["| PS, 1.93 GPa | 90 % interval | upper over lower | status |", "|---|---|---|---|"]
    for title, one in found.items():
        low, high = float(one["modulus_lower"]), float(one["modulus_upper"])
        meaning = STATUS_MEANINGS[int(one["status"])].replace("_", " ")
        lines.append(f"| {title} | {_range(low, high)} | {_plain(high / low)} | {meaning} |")
    return "\n".join(lines)


def _plain(value: float) -> str:
    return f"{float(f'{value:.2g}'):g}"


def start_table(stops: Mapping[str, Sequence[Fitted]]) -> str:
    """Return what a search from each start says where it is stopped, as a table."""
    lines = [
        "| start | PS: modulus | adhesion | indentation | worst N_r | LDPE: modulus | worst N_r |",
        "|---|---|---|---|---|---|---|",
    ]
    for i, start in enumerate(STARTS):
        hard, soft = stops["PS"][i], stops["LDPE"][i]
        cells = [_spread(hard.modulus, "Pa"), _spread(hard.adhesion, "N"), _spread(hard.indentation, "m")]
        cells += [f"{hard.residual.max():.2f}", _spread(soft.modulus, "Pa"), f"{soft.residual.max():.2f}"]
        lines.append(f"| {_start(start)} | {' | '.join(cells)} |")
    return "\n".join(lines)


def _spread(values: Array, unit: str) -> str:
    """Write mean +- scatter in one unit, to two digits of the scatter."""
    mean, scatter = float(values.mean()), float(values.std())
    scale, name = next(
        (10.0**p, n) for p, n in ((9, "G"), (6, "M"), (-9, "n"), (-12, "p")) if mean >= 10.0**p
    )
    digits = max(1 - math.floor(math.log10(scatter / scale)), 0)
    return f"{mean / scale:.{digits}f} +- {scatter / scale:.{digits}f} {name}{unit}"


def minimum_table(ends: Mapping[str, Fitted]) -> str:
    """Return what the minimum says of a scan of each material, as a table."""
    lines = [
        "| | truth | mean | scatter | scatter/sqrt(N) | median | middle 90 % | worst N_r |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for name, found in ends.items():
        E, size = found.modulus, found.modulus.size
        low, middle, high = np.quantile(E, [0.05, 0.5, 0.95])
        cells = [
            _pa(MATERIALS[name].modulus, 3),
            _pa(E.mean(), 3),
            _pa(E.std()),
            _pa(E.std() / math.sqrt(size)),
        ]
        cells += [_pa(middle), _range(low, high), f"{found.residual.max():.0e}".replace("e-0", "e-")]
        lines.append(f"| {name} | {' | '.join(cells)} |")
    return "\n".join(lines)


def shared_table(ends: Mapping[str, Mapping[str, Fitted]], stops: Mapping[str, Mapping[str, Fitted]]) -> str:
    """Return how answers move with errors that the whole scan shares, as a table."""
    lines = [
        "| shared by the scan | PS, stopped: mean | PS, minimum: median | LDPE, minimum: median | its standard error |",
        "|---|---|---|---|---|",
    ]
    for title in SHARED:
        early, soft = stops["PS"][title].modulus, ends["LDPE"][title].modulus
        drawn = np.random.default_rng(SEED).choice(
            soft, (200, soft.size)
        )  # pixels, drawn again with replacement
        error = float(np.median(drawn, axis=1).std())
        cells = [
            _pa(early.mean(), 3),
            _pa(float(np.median(ends["PS"][title].modulus))),
            _pa(float(np.median(soft)), 3),
            _pa(error),
        ]
        lines.append(f"| {title} | {' | '.join(cells)} |")
    return "\n".join(lines)


def curve_numbers(curve: Curve, prefix: str) -> dict[str, str]:
    """Return how far the estimates of a curve are from the truth."""
    E, truth = curve.published["modulus_unscreened"].values, curve.truth["modulus"].values
    low, high = (curve.posterior[f"modulus_{end}"].values for end in ("lower", "upper"))
    width = np.log10(high / low)
    exact = np.abs(curve.exact["modulus_unscreened"].values / truth - 1.0).max()
    inside = (low <= truth) & (truth <= high)
    return {
        f"{prefix}_count": str(truth.size),
        f"{prefix}_low": _pa(E.min()),
        f"{prefix}_high": _pa(E.max()),
        f"{prefix}_within": f"{curve.setpoint[np.abs(E / truth - 1.0) < 0.1].max():.2f}",
        f"{prefix}_exact": f"{100 * exact:.1g} %",
        f"{prefix}_inside": str(int(inside.sum())),
        f"{prefix}_narrowest": f"{10 ** width.min():.1f}",
        f"{prefix}_at": f"{curve.setpoint[width.argmin()]:.2f}",
        f"{prefix}_median_width": f"{np.median(width):.1f}",
        f"{prefix}_decades": f"{math.log10(E.max() / E.min()):.1f}",
        f"{prefix}_accepted": str(int((curve.published["residual"].values < ACCEPTED).sum())),
    }


def gains(intervals: Mapping[str, Mapping[str, xr.Dataset]]) -> dict[str, str]:
    """Return what section 1 says of its tables."""
    base = amplification(0.03, (0, 1, 2))
    width = {
        (name, title): math.log10(float(one["modulus_upper"] / one["modulus_lower"]))
        for name, of in intervals.items()
        for title, one in of.items()
    }
    few, *_, every = SETS
    touching = [math.acos(1.0 - m.indentation / MAP_AMPLITUDE) / math.pi for m in MATERIALS.values()]
    return {
        "touch_PS": f"{100 * touching[0]:.0f} %",
        "touch_LDPE": f"{100 * touching[1]:.0f} %",
        "times_1_percent": _plain(0.01 * base),
        "gain_fourth": _plain(base / amplification(0.03, (0, 1, 2, 3))),
        "gain_adhesion": _plain(base / amplification(0.03, (0, 1, 2), "adhesion")),
        "gain_depth": _plain(base / amplification(0.03, (0, 1, 2), "indentation")),
        "gain_Delta": _plain(base / amplification(0.06, (0, 1, 2))),
        "plateau": _plain(float(least_residual(PS, (0, 1, 2), np.array([LIMITS[1]]))[0])),
        "width_few": f"{width['PS', few]:.1f}",
        "width_every": f"{width['PS', every]:.1f}",
    }


def moves(
    stops: Mapping[str, Sequence[Fitted]],
    ends: Mapping[str, Mapping[str, Fitted]],
    shared: Mapping[str, Mapping[str, Fitted]],
    ways: Mapping[str, Sequence[Fitted]],
) -> dict[str, str]:
    """Return what section 2 says of its tables."""
    soft = np.array([np.median(found.modulus) for found in ends["LDPE"].values()])
    moved = np.abs(soft[1:] / soft[0] - 1.0)
    early = np.array([found.modulus.mean() for found in shared["PS"].values()])
    first = stops["PS"][0]
    held_adhesion = [np.median(way.modulus[29]) for way in ways["PS"][:3]]
    LDPE_stops = [found.modulus.mean() for found in stops["LDPE"]]
    return {
        "moved_low": f"{100 * moved.min():.0f} %",
        "moved_high": f"{100 * moved.max():.0f} %",
        "early_moved": f"{100 * np.abs(early / early[0] - 1.0).max():.2g} %",
        "first_scatter": f"{100 * first.modulus.std() / first.modulus.mean():.1g} %",
        "fewer": _plain(math.sqrt(OF_THE_MAP / ends["LDPE"]["none"].modulus.size)),
        "plateau_low": _pa(min(held_adhesion)),
        "plateau_high": _pa(max(held_adhesion)),
        "LDPE_least": _pa(min(LDPE_stops[:-1])),
        "LDPE_soft": _pa(LDPE_stops[-1]),
    }


def noise_numbers() -> dict[str, str]:
    """Return how small the noise would have to be for a scatter of 0.01 GPa on PS, and what the lever itself has."""
    F = cons("dmt-linear", *PS, MAP_AMPLITUDE)[None, :3].copy()
    gain = np.empty((1, 3))
    x, norm, outcome = np.empty((1, 3)), np.empty(1), np.empty(1, np.int8)
    amplitude = np.array([MAP_AMPLITUDE])
    least_squares.fit_pixels(
        F, np.arange(3), amplitude, CONTACT, LOWER, UPPER, np.log(PS), x, norm, gain, outcome
    )
    probe = probe_of_the_maps()
    of_mean = abs(float(gain[0, 0]))  # d ln E per relative error of F0
    mean = float(F[0, 0]) / probe.cantilever.modes[0].stiffness
    thermal = float(ot.thermal_noise_density(probe, 0.0)) * math.sqrt(BANDWIDTH)
    return {
        "gain_F0": _short(of_mean),
        "mean": _quantity(mean, "m"),
        "stated_E": f"{100 * 0.01 / 1.93:.1f} %",  # the paper's own numbers
        "stated_depth": f"{100 * 0.07 / 2.42:.1f} %",
        "stated_valley": f"{0.01 / 1.93 / (0.07 / 2.42):.1f}",
        "allowed": _quantity(0.01e9 / PS.modulus / of_mean * mean, "m", 1),
        "thermal": _quantity(thermal, "m", 1),
        "bandwidth": _quantity(BANDWIDTH, "Hz"),
    }


def main() -> None:
    """Write the figures and the page."""
    intervals = {
        name: {title: interval(material, orders) for title, orders in SETS.items()}
        for name, material in MATERIALS.items()
    }
    ways: dict[str, list[Fitted]] = {}
    ends: dict[str, dict[str, Fitted]] = {}
    shared: dict[str, dict[str, Fitted]] = {}
    differ = {}
    for name, material in MATERIALS.items():
        force, amplitude = forces_of(noisy_scan(material, {}))
        ways[name] = [searched(force[:SEARCHED], amplitude[:SEARCHED], start) for start in STARTS]
        found = np.array([converged(force, amplitude, start).modulus for start in STARTS])
        differ[name] = float((np.ptp(np.log(found), axis=0) > 1e-3).mean())
        ends[name], shared[name] = {}, {}
        for title, errors in SHARED.items():
            force, amplitude = forces_of(noisy_scan(material, errors))
            ends[name][title] = converged(force, amplitude, STARTS[0])
            way = searched(force[:SEARCHED], amplitude[:SEARCHED], STARTS[0], most=40)
            shared[name][title] = stopped(way, ACCEPTED)
    stops = {name: [stopped(way, ACCEPTED) for way in of] for name, of in ways.items()}
    of_fig_7 = fig_7(np.round(np.linspace(0.2, 0.9, 15), 3))
    of_fig_10 = fig_10(np.round(np.linspace(0.2, 0.9, 22), 4))
    early = early_10(of_fig_10)
    pictures = {
        "residual": residual_figure(intervals),
        "start": start_figure(ways["PS"]),
        "fig-7": fig_7_figure(of_fig_7),
        "fig-10": fig_10_figure(of_fig_10, early),
    }
    for name, figure in pictures.items():
        with atomic_path(FOLDER / "images" / f"identifiability-{name}.png") as temporary:
            temporary.write_bytes(png_bytes(figure))
    hard, stop = ends["PS"]["none"], stops["PS"][0]
    means = [float(found.modulus.mean()) for found in stops["PS"]]
    scatters = [float(found.modulus.std()) for found in stops["PS"]]
    flat = of_fig_10.setpoint < 0.7
    numbers = {
        "amplification": amplification_table(),
        "ratios": ratio_table(),
        "accepted": accepted_table(intervals),
        "starts": start_table(stops),
        "measures": measures_table(measures()),
        **gains(intervals),
        **moves(stops, ends, shared, ways),
        "minimum": minimum_table({name: of["none"] for name, of in ends.items()}),
        "shared": shared_table(ends, shared),
        "searched": str(SEARCHED),
        "pixels": str(hard.modulus.size),
        "differ": f"{100 * max(differ.values()):.2g} %",
        "at_bound": f"{100 * (hard.adhesion < 1.01 * ADHESION_BOUND).mean():.0f} %",
        "of_the_map": _pa(float(hard.modulus.std()) / math.sqrt(OF_THE_MAP)),
        "valley": f"{np.log(hard.modulus).std() / np.log(hard.indentation).std():.1f}",
        "stop_valley": f"{np.log(stop.modulus).std() / np.log(stop.indentation).std():.1f}",
        "means_low": _pa(min(means)),
        "means_high": _pa(max(means)),
        "scatters_low": _pa(min(scatters), 1),
        "scatters_high": _pa(max(scatters), 1),
        "early_low": _pa(early.modulus[flat].min(), 3),
        "early_high": _pa(early.modulus[flat].max(), 3),
        **noise_numbers(),
        **curve_numbers(of_fig_7, "f7"),
        **curve_numbers(of_fig_10, "f10"),
    }
    words = (FOLDER / "identifiability_words.txt").read_text(encoding="utf-8")
    (FOLDER / "identifiability.md").write_text(Template(words).substitute(numbers), encoding="utf-8")


if __name__ == "__main__":
    main()
