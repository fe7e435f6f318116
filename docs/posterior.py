"""Make the page on whether intervals hold what they say: simulation-based calibration of method ``posterior``.

Run by hand, ``python docs/posterior.py [--draws 2000] [--jobs 2]``; a quarter of an hour on two cores. Materials are
drawn from the priors that the inversion is told, states are simulated on the full motion, noise and an instrument are
added, and one pixel after the other is inverted. Draws are seeded by chunk, so that they come out again whatever the
jobs.
"""

from __future__ import annotations

import argparse
import csv
import functools
import math
import textwrap
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from scipy.stats import chisquare

import overtone as ot
from overtone.contact.models import contact_model
from overtone.dynamics.balance import FOUND
from overtone.dynamics.indented import indented_states
from overtone.harmonics import far_phase, read_receptance
from overtone.instrument.calibration import Calibration, format_calibration
from overtone.instrument.noise import add_noise
from overtone.instrument.shared import redo
from overtone.instrument.signals import Signals
from overtone.instrument.unknowns import NEUTRAL, probe_with
from overtone.inversion.columns import columns_of
from overtone.inversion.linear import stiffness
from overtone.inversion.pixels import Setting, radius_exponent
from overtone.inversion.priors import Prior
from overtone.inversion.result import DETERMINED, NO_CONTACT, NOT_DETERMINED, POOR_FIT
from overtone.inversion.table import DEEPEST
from overtone.plots import png_bytes
from overtone.plots.canvas import new_figure
from overtone.plots.categories import PALETTE
from overtone.plots.text import LABEL_SIZE, TICK_SIZE, TITLE_SIZE
from overtone.quantities import named_array
from overtone.units import format_quantity

Array = npt.NDArray[np.float64]
Outcomes = dict[str, Array]
"""Columns, one number a draw."""

FOLDER = Path(__file__).parent
SEED, DRAWS, CHUNK = 1789, 2000, 100
N_MAX = 20  # harmonics of the simulated motion; the inversion follows sixteen
POISSON_RATIO = 0.35
PROBE = ot.Probe.simple(
    stiffness=16.4,
    frequency=161.8e3,
    quality_factor=287,
    radius=10e-9,
    drive_frequency=161.8e3,
    free_amplitude=1e-9,  # of no account: that of each draw replaces it
)
AMPLITUDE = (10e-9, 80e-9)
SETPOINT = (0.1, 0.99)
"""Of what is read of A1 over the free amplitude: states that anyone would record."""
PRIORS = {
    "modulus": Prior("log-range", 5e6, 50e9),
    "stiffness": Prior("log-range", 0.05, 100.0),
    "adhesion": Prior("normal", 0.0, 19e-9),
    "loss_tangent": Prior("range", 0.0, 2.0),
    "indentation": Prior("log-range", 0.05e-9, 1e-6),  # the upper end is 2 A1
}
LEVELS = (5e-12, 20e-12, 50e-12)
NOISE = {"phi1": math.radians(0.1), "A1": 20e-12, "A2": 1e-12, "A3": 1e-12}
INSTRUMENT = {
    "A0_offset": 2e-12,
    "phi1_offset": math.radians(0.2),
    "gain0": 0.02,
    "gain2": 0.02,
    "gain3": 0.03,
    "latency2": math.radians(0.5),
    "latency3": math.radians(1.0),
    "stiffness": 0.05,
    "quality_factor": 0.01,
    "free_amplitude": 0.005,
    "radius": 0.10,
}
"""Standard deviations of what a careful laboratory does not know of its instrument, independent [m, rad, 1]."""
REFERENCE_AMPLITUDE = 50e-9

MODELS = {
    "dmt": ("modulus", "adhesion", "indentation"),
    "dmt-viscous": ("modulus", "adhesion", "indentation", "viscosity", "loss_tangent"),
    "hertz": ("modulus", "indentation"),
    "kelvin-voigt-adhesion": ("stiffness", "adhesion", "indentation", "damping", "loss_tangent"),
}
"""Quantities of each model, the elastic one first."""
LOSSES = ("viscosity", "damping")
NOISE_ONLY, CALIBRATED = "noise", "noise and instrument"
QUIET, STIFF, BLUNT = "noise stated 1.5 times too small", "k stated 5 % too large", "R stated 20 % too large"
RUNS = (NOISE_ONLY, CALIBRATED, QUIET, STIFF, BLUNT)
BINS = (0.05, 0.45, 0.45, 0.05)
COMPARED = ("dmt", "hertz")
NARROW = 0.6  # width of the 90 % interval of ln E below which a posterior counts as Gaussian
NINETY = 1.6448536269514722
STEP = 1e-4


# --- draws ------------------------------------------------------------------------------------------------------


class Draw(NamedTuple):
    """A state: the material and what an instrument without noise reads of it."""

    truth: Mapping[str, float]
    probe: ot.Probe
    """As it is stated, with the free amplitude of this draw."""
    reading: Signals
    """Of one pixel."""


def drawn_from(prior: Prior, random: np.random.Generator) -> float:
    """Return a number drawn from a prior."""
    if prior.kind == "log-range":
        return float(np.exp(random.uniform(math.log(prior.first), math.log(prior.second))))
    if prior.kind == "range":
        return float(random.uniform(prior.first, prior.second))
    return float(prior.first + prior.second * abs(random.normal()))


def given(model: str) -> dict[str, float]:
    """Return what the model has to know beside the probe."""
    known = {"poisson_ratio": POISSON_RATIO, "intermolecular_distance": 0.2e-9}
    return {q.name: known[q.name] for q in contact_model(model).given if q.name in known}


def loss_of(model: str, probe: ot.Probe, elastic: float, tangent: float) -> float:
    """Return viscosity or damping of a loss tangent."""
    columns = columns_of(contact_model(model), probe, given(model))
    return float(tangent * stiffness(columns.contact, elastic)[0] / columns.loss)


def sample_of(model: str, probe: ot.Probe, rows: Sequence[Mapping[str, float]]) -> ot.Sample:
    """Return materials as the simulator takes them, one of each row."""
    names = [q.name for q in contact_model(model).unknowns]
    values = {name: np.array([row[name] for row in rows]) for name in names if name not in LOSSES}
    for name in set(names) & set(LOSSES):
        elastic = MODELS[model][0]
        values[name] = np.array([loss_of(model, probe, row[elastic], row["loss_tangent"]) for row in rows])
    return ot.sample(model, **values, **given(model))


def instrument(random: np.random.Generator, *, calibrated: bool) -> dict[str, float]:
    """Return the true instrument: the stated one, or one as far from it as the stated covariance has it."""
    values = dict(NEUTRAL)
    for name, error in INSTRUMENT.items():
        # drawn either way, so that both kinds of run begin with the same random numbers
        off = error * random.normal()
        values[name] += off if calibrated else 0.0
    return values


def one_draw(model: str, random: np.random.Generator, *, calibrated: bool) -> Draw | None:
    """Return a draw, or None where nobody would record the state or none was found."""
    names = MODELS[model]
    A1 = float(random.uniform(*AMPLITUDE))
    truth = {n: drawn_from(PRIORS[n], random) for n in names if n in PRIORS and n != "indentation"}
    deepest = 2.0 * A1 / (1.0 + math.exp(-DEEPEST))
    truth["indentation"] = drawn_from(Prior("log-range", PRIORS["indentation"].first, deepest), random)
    values = instrument(random, calibrated=calibrated)
    true = probe_with(PROBE, values)
    sample = sample_of(model, true, [truth])
    state = indented_states(true, sample, amplitude=[A1], indentation=[truth["indentation"]], n_max=N_MAX)
    free = complex(state.drive[0] * read_receptance(true, true.drive.frequency))
    stated = abs(free) / values["free_amplitude"]
    if state.status[0] != FOUND or not SETPOINT[0] * stated < A1 < SETPOINT[1] * stated:
        return None
    for name in set(names) & set(LOSSES):
        truth[name] = float(sample.values[name][0])
    phi1 = float(np.angle(free)) + far_phase(true)
    phasor = {n: state.reading[:, n] * np.exp(-1j * n * phi1) for n in (1, 2, 3)}
    clean = Signals(state.reading[:, 0].real, phasor)
    reading = redo(clean, values, REFERENCE_AMPLITUDE) if calibrated else clean
    probe = replace(PROBE, drive=replace(PROBE.drive, free_amplitude=stated))
    return Draw(truth | {"A1": A1}, probe, reading)


def observables_of(readings: Iterable[Signals]) -> xr.Dataset:
    """Return readings as observables, one after the other."""
    some = list(readings)
    arrays = {"A0": np.concatenate([r.mean for r in some if r.mean is not None])}
    for n in (1, 2, 3):
        a = np.concatenate([r.phasor[n] for r in some])
        arrays |= {f"A{n}": np.abs(a), f"phi{n}": -np.angle(a)}
    return xr.Dataset({name: named_array(name, values, ("draw",), {}) for name, values in arrays.items()})


def calibration_of(probe: ot.Probe) -> Calibration:
    """Return what is stated of the instrument."""
    covariance = np.diag(np.square(list(INSTRUMENT.values())))
    return Calibration(probe, REFERENCE_AMPLITUDE, dict(NEUTRAL), tuple(INSTRUMENT), covariance)


def with_calibration(observables: xr.Dataset, probe: ot.Probe) -> xr.Dataset:
    """Return observables as a scan that was corrected with what is stated of the instrument."""
    return observables.assign_attrs(calibration=format_calibration(calibration_of(probe)))


# --- inversions -------------------------------------------------------------------------------------------------


def stated(run: str, probe: ot.Probe, noise: Mapping[str, float]) -> tuple[ot.Probe, dict[str, float]]:
    """Return probe and noise as the inversion is told them."""
    factors = {STIFF: {"stiffness": 1.05}, BLUNT: {"radius": 1.2}}.get(run, {})
    told = {name: sigma / 1.5 if run == QUIET else sigma for name, sigma in noise.items()}
    return probe_with(probe, {**NEUTRAL, **factors}), told


def limit(model: str, draw: Draw, noise: Mapping[str, float], *, calibrated: bool) -> float:
    """Return the least standard deviation of ln of the elastic unknown: Cramer and Rao, with what the prior adds.

    By finite differences of the simulator at the truth, with the covariance that the inversion uses.
    """
    names = [n for n in MODELS[model] if n not in LOSSES]
    truth, A1 = draw.truth, draw.truth["A1"]
    elastic, record = names[0], contact_model(model)
    # adhesion and loss tangent may be next to nothing: their steps are absolute
    steps = {n: STEP * truth[n] for n in names} | {"adhesion": STEP * 19e-9, "loss_tangent": STEP}
    rows = [{**truth, n: truth[n] + side * steps[n]} for n in names for side in (0.5, -0.5)]
    state = indented_states(
        draw.probe,
        sample_of(model, draw.probe, rows),
        amplitude=np.full(len(rows), A1),
        indentation=[row["indentation"] for row in rows],
        n_max=N_MAX,
    )
    f = state.force
    lossy = set(names) & {"loss_tangent"}
    y = np.concatenate([f[:, :4].real, -f[:, 1:3].imag if lossy else f[:, :0].real], axis=1)
    slopes = np.array([(y[2 * i] - y[2 * i + 1]) / STEP for i in range(len(names))]).T
    data = observables_of([draw.reading])
    if calibrated:
        data = with_calibration(data, draw.probe)
    sigma = {**NOISE, **noise}
    setting = Setting.of(data, draw.probe, (0, 1, 2, 3), (1, 2) if lossy else (), sigma)
    pixel = setting.pixels(slice(0, 1), radius_exponent(record, draw.probe, given(model)))
    white = pixel.whitening[0] @ slopes
    # variances of the priors, in the units of the steps
    log_E = math.log(PRIORS[elastic].second / PRIORS[elastic].first)
    log_t = math.log(2.0 * A1 / PRIORS["indentation"].first)
    of_prior = {
        elastic: 12.0 / log_E**2,
        "adhesion": 1.0,
        "indentation": 12.0 / log_t**2,
        "loss_tangent": 3.0,
    }
    information = white.T @ white + np.diag([of_prior[n] for n in names])
    return math.sqrt(float(np.linalg.inv(information)[0, 0]) + float(pixel.left[0]))


class Chunk(NamedTuple):
    """Draws of one model and noise."""

    draws: list[Draw]
    observables: xr.Dataset
    """With noise."""
    tried: float
    """States drawn for each one that is kept."""


@functools.lru_cache(maxsize=2)  # the runs without errors of the instrument share theirs
def chunk(model: str, level: float, number: int, size: int, *, calibrated: bool) -> Chunk:
    """Return a chunk of draws, seeded by its number."""
    random = np.random.default_rng([SEED, list(MODELS).index(model), round(1e12 * level), number])
    draws: list[Draw] = []
    tried = 0
    while len(draws) < size:
        draw = one_draw(model, random, calibrated=calibrated)
        tried += 1
        draws += [draw] if draw is not None else []
    read = observables_of(draw.reading for draw in draws)
    noisy = add_noise(read, {**NOISE, "A0": level}, seed=int(random.integers(2**31)))
    return Chunk(draws, noisy, tried / size)


def inverted(model: str, run: str, level: float, number: int, size: int = CHUNK) -> Outcomes:
    """Return the outcomes of a chunk of draws: truth, medians, intervals, status."""
    calibrated, noise = run == CALIBRATED, {**NOISE, "A0": level}
    draws, noisy, tried = chunk(model, level, number, size, calibrated=calibrated)
    rows = []
    for i, draw in enumerate(draws):
        probe, told = stated(run, draw.probe, noise)
        pixel = noisy.isel(draw=[i])
        data = with_calibration(pixel, probe) if calibrated else pixel
        row = posterior_row(model, data, probe, told)
        row |= {f"true_{name}": draw.truth[name] for name in MODELS[model]}
        if run in (NOISE_ONLY, CALIBRATED):
            elastic = MODELS[model][0]
            near = math.log(row[f"{elastic}_upper"] / row[f"{elastic}_lower"]) < NARROW
            row["limit"] = limit(model, draw, noise, calibrated=calibrated) if near else math.nan
        if run == NOISE_ONLY and model in COMPARED:
            row |= others_row(model, pixel, probe, told)
        rows.append(row | {"level": level, "A1": draw.truth["A1"]})
    columns = {name: np.array([row[name] for row in rows]) for name in rows[0]}
    return columns | {"tried": np.full(size, tried)}


def posterior_row(
    model: str, data: xr.Dataset, probe: ot.Probe, noise: Mapping[str, float]
) -> dict[str, float]:
    """Return the posterior of a pixel as numbers."""
    result = ot.map_properties(
        data, probe, model=model, poisson_ratio=POISSON_RATIO, noise=noise, priors=PRIORS
    )
    names = ["status", "contact_probability", "misfit", "uncertainty"]
    for name in MODELS[model]:
        names += [name, f"{name}_lower", f"{name}_unscreened", f"{name}_upper"]
    return {name: float(result[name].values[0]) for name in names}


def others_row(model: str, data: xr.Dataset, probe: ot.Probe, noise: Mapping[str, float]) -> dict[str, float]:
    """Return what the other methods say of the modulus of a pixel."""
    row: dict[str, float] = {}
    for method, names in (
        ("least-squares", ("modulus_unscreened", "modulus_lower", "modulus_upper", "residual", "status")),
        ("exact", ("modulus_unscreened", "uncertainty", "status", "solutions")),
    ):
        result = ot.map_properties(
            data, probe, model=model, poisson_ratio=POISSON_RATIO, noise=noise, method=method
        )
        row |= {f"{method} {name}": float(result[name].values[0]) for name in names}
    return row


def together(parts: Sequence[Outcomes]) -> Outcomes:
    """Return outcomes of several chunks as one."""
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


# --- numbers ----------------------------------------------------------------------------------------------------


def bins_of(some: Outcomes, name: str) -> npt.NDArray[np.int64]:
    """Return in which of four bins, that the quantiles of 5, 50 and 95 % part, each truth lies; -1 without quantiles.

    Quantiles are of contact where contact is the more likely; where it is not, the answer is that of no contact.
    """
    edges = np.stack([some[f"{name}_{variant}"] for variant in ("lower", "unscreened", "upper")])
    found = (some[f"true_{name}"] > edges).sum(axis=0)
    return np.where(np.isfinite(edges).all(axis=0) & (some["contact_probability"] >= 0.5), found, -1)


def inside(some: Outcomes, name: str) -> npt.NDArray[np.bool_]:
    """Return of the draws with an interval, whether it holds the truth."""
    found = bins_of(some, name)
    return np.asarray((found[found >= 0] == 1) | (found[found >= 0] == 2))


class Row(NamedTuple):
    """A number of the page."""

    model: str
    run: str
    noise: str
    """Of A0 in pm, or all."""
    part: str
    """Which draws: all with an interval, determined, not determined."""
    quantity: str
    number: str
    value: float
    draws: int
    """That it was taken over."""


ALL, SURE, UNSURE = "all", "determined", "not determined"
SHARES = ("below 5 %", "5 to 50 %", "50 to 95 %", "above 95 %")


def rows_of(model: str, run: str, outcomes: Outcomes) -> list[Row]:
    """Return the numbers of a model and a run."""
    rows = []
    for noise, some in by_noise(outcomes).items():

        def add(part: str, quantity: str, number: str, values: Any, noise: str = noise) -> None:
            array = np.atleast_1d(np.asarray(values, dtype=float))
            value = float(f"{array.mean():.5g}") if array.size else math.nan
            rows.append(Row(model, run, noise, part, quantity, number, value, array.size))

        elastic, status = MODELS[model][0], some["status"]
        add(ALL, "", "states recorded", 1.0 / some["tried"])
        add(ALL, "", "contact the more likely", some["contact_probability"] >= 0.5)
        for number, code in (("poor fit", POOR_FIT), ("no contact", NO_CONTACT), (UNSURE, NOT_DETERMINED)):
            add(ALL, "", number, status == code)
        for name in MODELS[model]:
            bins, sure = bins_of(some, name), np.isfinite(some[name])
            add(ALL, name, SURE, sure)
            for part, which in ((ALL, bins >= 0), (SURE, (bins >= 0) & sure), (UNSURE, (bins >= 0) & ~sure)):
                add(part, name, "covered", (bins[which] == 1) | (bins[which] == 2))
            found = bins[bins >= 0]
            for k, share in enumerate(SHARES):
                add(ALL, name, share, found == k)
            counts = np.bincount(found, minlength=4)
            add(ALL, name, "p", chisquare(counts, np.array(BINS) * found.size).pvalue)
        for part, which in ((ALL, bins_of(some, elastic) >= 0), (SURE, status == DETERMINED)):
            off = np.abs(np.log(some[f"{elastic}_unscreened"] / some[f"true_{elastic}"]))[which]
            add(part, elastic, "median error", np.median(off) if off.size else [])
        if "limit" in some:
            width = np.log(some[f"{elastic}_upper"] / some[f"{elastic}_lower"])
            near = (bins_of(some, elastic) >= 0) & (width < NARROW)
            ratio = (width / (2.0 * NINETY * some["limit"]))[near]
            add(ALL, elastic, "width over limit", np.median(ratio) if ratio.size else [])
            add(ALL, elastic, "near a Gaussian", near)
        if "exact status" in some:
            _add_others(some, add)
    return rows


def by_noise(outcomes: Outcomes) -> dict[str, Outcomes]:
    """Return outcomes by noise of A0 [pm], and all of them."""
    parts = {
        f"{1e12 * level:.0f}": {name: column[outcomes["level"] == level] for name, column in outcomes.items()}
        for level in LEVELS
    }
    return {**parts, ALL: outcomes}


def _add_others(some: Outcomes, add: Any) -> None:
    """Add what other methods make of the modulus of the same draws."""
    truth, told = np.log(some["true_modulus"]), some["status"] == DETERMINED
    for method in ("least-squares", "exact"):
        value = np.log(some[f"{method} modulus_unscreened"])
        found, sure = np.isfinite(value), some[f"{method} status"] == DETERMINED
        name = f"modulus by {method}"
        add(ALL, name, "answer", found)
        add(ALL, name, SURE, sure)
        for part, which in ((ALL, found), (SURE, found & sure), ("determined by posterior", found & told)):
            off = np.abs(value - truth)[which]
            add(part, name, "median error", np.median(off) if off.size else [])
            if method == "exact":
                inside = off < NINETY * some["exact uncertainty"][which]
            else:
                low, high = (np.log(some[f"{method} modulus_{end}"])[which] for end in ("lower", "upper"))
                inside = (low <= truth[which]) & (truth[which] <= high)
            add(part, name, "covered", inside)
        if method == "least-squares":
            close = found & (some[f"{method} residual"] < 0.1)
            add(ALL, name, "N_r < 0.1", close)
            off = np.abs(value - truth)[close]
            add("N_r < 0.1", name, "median error", np.median(off) if off.size else [])
            add("N_r < 0.1", name, "off by more than 2", off > math.log(2.0))
    for part, which in ((ALL, bins_of(some, "modulus") >= 0), (SURE, told)):
        off = np.abs(np.log(some["modulus_unscreened"]) - truth)[which]
        add(part, "modulus", "off by more than 2", off > math.log(2.0))


def write_table(rows: Sequence[Row], path: Path) -> None:
    """Write the numbers as text that a spreadsheet can read."""
    with path.open("w", newline="", encoding="utf-8") as file:
        csv.writer(file, lineterminator="\n").writerows([Row._fields, *rows])


def read_table(path: Path) -> list[Row]:
    """Return what `write_table` wrote."""
    with path.open(newline="", encoding="utf-8") as file:
        lines = list(csv.reader(file))[1:]
    rows = []
    for model, run, noise, part, quantity, number, value, draws in lines:
        rows.append(Row(model, run, noise, part, quantity, number, float(value), int(draws)))
    return rows


# --- page -------------------------------------------------------------------------------------------------------

TITLES = {
    "modulus": "modulus",
    "stiffness": "stiffness",
    "adhesion": "adhesion",
    "indentation": "indentation",
    "viscosity": "viscosity",
    "damping": "damping",
    "loss_tangent": "loss tangent",
}
COLUMNS = (("modulus", "stiffness"), ("adhesion",), ("indentation",), LOSSES, ("loss_tangent",))
HEADS = ("modulus or stiffness", "adhesion", "indentation", "viscosity or damping", "loss tangent")


class Numbers:
    """Numbers of the page by what they are of."""

    def __init__(self, rows: Sequence[Row]) -> None:
        self.rows = {row[:6]: row for row in rows}

    def row(self, model: str, run: str, quantity: str, number: str, noise: str = ALL, part: str = ALL) -> Row:
        """Return one."""
        return self.rows[model, run, noise, part, quantity, number]

    def percent(self, *key: str, digits: int = 0, **where: str) -> str:
        """Return a share [%], a dash where there is none."""
        value = self.row(*key, **where).value
        return f"{100 * value:.{digits}f}" if math.isfinite(value) else "-"

    def covered(self, model: str, run: str, quantity: str, **where: str) -> str:
        """Return coverage and its binomial error [%], a dash of fewer than 20 draws."""
        row = self.row(model, run, quantity, "covered", **where)
        return f"{100 * row.value:.1f} +- {100 * binomial(row.draws):.1f}" if row.draws >= 20 else "-"


def binomial(draws: int) -> float:
    """Return the standard error of a coverage of 90 %."""
    return math.sqrt(0.09 / draws)


def names_in_columns(model: str) -> list[str | None]:
    """Return which quantity of a model stands in each column."""
    return [next((n for n in names if n in MODELS[model]), None) for names in COLUMNS]


def lines_of(head: Sequence[str], body: Iterable[Sequence[str]]) -> str:
    """Return a table in Markdown."""
    return "\n".join(f"| {' | '.join(cells)} |" for cells in (head, ["---"] * len(head), *body))


def coverage_table(numbers: Numbers, run: str) -> str:
    """Return what 90 % intervals hold, by model and noise."""
    body = []
    for model in MODELS:
        for noise in (*(f"{1e12 * level:.0f}" for level in LEVELS), ALL):
            draws = numbers.row(model, run, MODELS[model][0], "covered", noise=noise).draws
            cells = [
                numbers.covered(model, run, name, noise=noise) if name else ""
                for name in names_in_columns(model)
            ]
            body.append([model, noise, str(draws), *cells])
    return lines_of(["model", "noise of A0 [pm]", "draws", *HEADS], body)


def parts_table(numbers: Numbers, run: str) -> str:
    """Return what intervals hold of determined quantities and of the others."""
    body = []
    for model in MODELS:
        for part in (SURE, UNSURE):
            cells = []
            for name in names_in_columns(model):
                if name is None:
                    cells.append("")
                    continue
                row = numbers.row(model, run, name, "covered", part=part)
                cells.append(f"{numbers.covered(model, run, name, part=part)} ({row.draws})")
            body.append([model, part, *cells])
    return lines_of(["model", "draws that are", *HEADS], body)


def bins_table(numbers: Numbers) -> str:
    """Return shares of truths between the quantiles, and how likely chance makes them as uneven."""
    body = []
    for model, names in MODELS.items():
        for name in names:
            cells = [model, TITLES[name]]
            for run in (NOISE_ONLY, CALIBRATED):
                shares = [numbers.percent(model, run, name, share, digits=1) for share in SHARES]
                cells += [", ".join(shares), f"{numbers.row(model, run, name, 'p').value:.2g}"]
            body.append(cells)
    head = ["model", "quantity"]
    for run in (NOISE_ONLY, CALIBRATED):
        head += [f"{run}: truths in the four bins [%]", "p"]
    return lines_of(head, body)


def limit_table(numbers: Numbers) -> str:
    """Return widths over the information limit."""
    body = []
    for model, names in MODELS.items():
        cells = [model]
        for run in (NOISE_ONLY, CALIBRATED):
            row = numbers.row(model, run, names[0], "width over limit")
            near = numbers.row(model, run, names[0], "near a Gaussian")
            cells += [f"{row.value:.2f}", f"{round(near.value * near.draws)}"]
        body.append(cells)
    return lines_of(
        ["model", *(h for run in (NOISE_ONLY, CALIBRATED) for h in (f"{run}: ratio", "draws"))], body
    )


def misstated_table(numbers: Numbers) -> str:
    """Return what intervals hold where the inversion is told something wrong, and what warns of it."""
    body = []
    for model in MODELS:
        for run in (NOISE_ONLY, QUIET, STIFF, BLUNT):
            cells = [numbers.covered(model, run, name) if name else "" for name in names_in_columns(model)]
            sure = numbers.covered(model, run, MODELS[model][0], part=SURE)
            body.append(
                [
                    model,
                    "nothing" if run == NOISE_ONLY else run,
                    *cells,
                    sure,
                    numbers.percent(model, run, "", "poor fit", digits=1),
                    numbers.percent(model, run, MODELS[model][0], SURE, digits=1),
                ]
            )
    head = [
        "model",
        "wrong",
        *HEADS,
        "modulus or stiffness where determined",
        "poor fit [%]",
        "determined [%]",
    ]
    return lines_of(head, body)


def methods_table(numbers: Numbers) -> str:
    """Return medians, least squares and exact solutions on the same draws."""
    body = []
    for model in COMPARED:
        for method, name in (
            ("posterior", "modulus"),
            ("least-squares", "modulus by least-squares"),
            ("exact", "modulus by exact"),
        ):

            def error(part: str, name: str = name, model: str = model) -> str:
                row = numbers.row(model, NOISE_ONLY, name, "median error", part=part)
                return f"{row.value:.2f}" if math.isfinite(row.value) else "-"

            answers = (
                numbers.percent(model, NOISE_ONLY, "", "contact the more likely")
                if method == "posterior"
                else numbers.percent(model, NOISE_ONLY, name, "answer")
            )
            body.append(
                [
                    model,
                    method,
                    answers,
                    error(ALL),
                    numbers.percent(model, NOISE_ONLY, name, SURE),
                    error(SURE),
                    error(SURE if method == "posterior" else "determined by posterior"),
                    numbers.covered(model, NOISE_ONLY, name),
                    numbers.covered(model, NOISE_ONLY, name, part=SURE),
                ]
            )
    head = [
        "model",
        "method",
        "answers [%]",
        "median abs ln(E/E_true) of all",
        "determined by its own account [%]",
        "of these",
        "of those that the posterior determines",
        "its own 90 % range holds E, all [%]",
        "determined [%]",
    ]
    return lines_of(head, body)


PAGE = """# Do the intervals hold?

A 90 % interval of `map_properties(method="posterior")` should hold the truth in 90 of 100 pixels. This page draws
materials, simulates what a microscope would read of each, inverts it and counts. `python docs/posterior.py` makes the
page, its figures and `posterior.csv` again; every number here is from that run.

## 1. What is drawn

For each of four models and each noise {draws} states of contact, from the priors that the inversion is told, which were
fixed beforehand:

{priors}

and the amplitude A1 evenly from {low_A1} to {high_A1} nm, whatever the material. The lever has 16.4 N/m, 161.8 kHz, Q
287 and 10 nm, driven at resonance. `indented_states` gives the motion with 20 harmonics at that amplitude and
indentation; with the inversion it shares nothing but the force law. It also tells which drive the state needs, and so
the free amplitude A1far and phi1 of this draw, which is then inverted with a probe of its own. States with A1/A1far
outside {low_setpoint} to {high_setpoint} are left out, as nobody would record them: that is a choice by what is read,
and such choices leave calibration as it is. Of the states that were drawn it keeps {recorded_dmt} % (`dmt`),
{recorded_dmt_viscous} % (`dmt-viscous`), {recorded_hertz} % (`hertz`) and {recorded_kelvin_voigt_adhesion} %
(`kelvin-voigt-adhesion`).

**Why the amplitude can be drawn and the drive not.** In a microscope the drive is set and the surface brought nearer
until A1 is the set-point, so that A1 says nothing of the material. Given A1, material and indentation fix the motion
and with it every f_n = CONS_n - i DISS_n. The balance of the first harmonic, A1/G(w) - f_1 = F_drive, then gives the
complex drive: its size is A1far/|G(w)| and its angle phi1. So at a given A1 the pair (A1far, phi1) and the complex
number f_1 are the same thing in other words, with a Jacobian that depends on A1far alone, which is known; whatever the
drive says of the material is in y = (CONS_n, DISS_n). The likelihood of the readings is that of y, the prior of the
indentation at that A1 is the one drawn from, and the posterior from y is the one of all readings. Two things are left
out, and cost width at most: a model without loss does not use that DISS_n vanishes, and the force at the A1 that was
read is taken for that at the true A1, which is 20 pm off.

**Noise**: A0 {levels} pm, a third of the draws each; phi1 0.1 degrees; 20 pm of A1; 1 pm of A2 and A3 in each
direction. **Instrument**: in a second run the true instrument of each draw is not the stated one, but off by as much as
a careful laboratory leaves open (one standard deviation, independent): {instrument}. The inversion is given
the stated instrument with that covariance, as `overtone.correct` attaches it.

One draw by hand:

```python
>>> import numpy as np
>>> import xarray as xr
>>> import overtone as ot
>>> from overtone.dynamics.indented import indented_states
>>> from overtone.harmonics import far_phase, read_receptance
>>> from overtone.instrument.noise import add_noise
>>> lever = dict(stiffness=16.4, frequency=161.8e3, quality_factor=287, radius=10e-9, drive_frequency=161.8e3)
>>> probe = ot.Probe.simple(**lever, free_amplitude=1e-9)
>>> sample = ot.sample("dmt", modulus=1e9, poisson_ratio=0.35, adhesion=5e-9)
>>> state = indented_states(probe, sample, amplitude=[40e-9], indentation=[3e-9])
>>> free = complex(state.drive[0] * read_receptance(probe, 161.8e3))
>>> phi1 = np.angle(free) + far_phase(probe)
>>> read = {{"A0": state.reading[0, 0].real, "A1": 40e-9, "phi1": phi1}}
>>> for n in (2, 3):
...     read[f"A{{n}}"] = abs(state.reading[0, n])
...     read[f"phi{{n}}"] = n * phi1 - np.angle(state.reading[0, n])
>>> units = {{name: "m" if name.startswith("A") else "rad" for name in read}}
>>> pixel = xr.Dataset({{name: ("x", [value], {{"units": units[name]}}) for name, value in read.items()}})
>>> pixel = add_noise(pixel, seed=1)
>>> told = ot.Probe.simple(**lever, free_amplitude=abs(free))
>>> result = ot.map_properties(pixel, told, model="dmt", poisson_ratio=0.35)
>>> low, high = (float(result[f"modulus_{{end}}"][0]) for end in ("lower", "upper"))
>>> low < 1e9 < high
True

```

## 2. Coverage

Truths in 90 % intervals [%], with the binomial standard error. Quantiles are those of contact where contact is the more
likely, as it is for {contact_dmt} % of the draws (`dmt`), {contact_dmt_viscous} % (`dmt-viscous`), {contact_hertz} %
(`hertz`) and {contact_kelvin_voigt_adhesion} % (`kelvin-voigt-adhesion`); the others are answered as out of contact
and have none: a tip that adhesion holds for a moment reads like one that it pulls from nearby.

Noise only:

{coverage}

The {noise_count} coverages of all noises together lie from {noise_lowest} to {noise_highest} %.
{noise_outside}

Noise and instrument:

{coverage_instrument}

From {instrument_lowest} to {instrument_highest} %.
{instrument_outside}

![Coverage of the 90 % intervals by model and noise](images/posterior-coverage.png)

Among the quantities that the status calls determined (the map shows them) and among the others, noise only; the number
of draws in brackets:

{parts}

Noise and instrument:

{parts_instrument}

## 3. Ranks

A truth should be as likely in each part of its posterior: 5 % below the lower end, 45 % to the median, 45 % to the
upper end, 5 % above. p is how likely chance makes bins at least as uneven (chi-squared).

{bins}

Without errors of the instrument the least of {noise_count} is {noise_least_p} ({noise_small_p} below 0.01), with them
{instrument_least_p} ({instrument_small_p} below 0.01).

![Truths between the quantiles over how many are expected](images/posterior-bins.png)

## 4. Width

Where the 90 % interval of ln E is narrower than {narrow}, its width over 3.29 times the least standard deviation that
any unbiased estimate can have (Cramer and Rao, by finite differences of the simulator with the same covariance, with
what the prior adds); the median over these draws:

{limit}

## 5. Told something wrong

The same draws (noise only) with noise stated 1.5 times too small, a stiffness 5 % too large or a radius 20 % too large,
and none of that in a stated covariance. Nothing but a misfit can warn:

{misstated}

A wrong radius moves the modulus and the viscosity, and no misfit shows it, because every force is fitted as before
(`kelvin-voigt-adhesion` has no radius to get wrong). A wrong stiffness scales all forces alike and the material with
them, which no misfit shows either. Status cannot warn: what is called determined is hit hardest, because its
intervals are the narrowest. State the errors of k and R (`overtone.calibrate`); with them the intervals are those of
section 2. Noise that is stated too small shows in the share of poor fits.

## 6. Other methods on the same draws

`least-squares` is the published estimator (harmonics 0, 1, 2; the best of three starts, converged), `exact` the
solution of four harmonics with the least misfit. A median over what is determined is the smaller the fewer are called
so; the column beside it takes the pixels that the posterior determines for all three. Ranges of `exact` are 1.64 times
its uncertainty, those of `least-squares` the moduli that fit at 90 %.

{methods}

The residual that the paper accepts says little: of the least-squares answers with N_r < 0.1 ({close_dmt} % of `dmt`,
{close_hertz} % of `hertz`) {close_off_dmt} and {close_off_hertz} % are off by more than a factor of 2, median abs
ln(E/E_true) {close_error_dmt} and {close_error_hertz}. Of the medians of determined pixels {sure_off_dmt} and
{sure_off_hertz} % are.

![Truth against median and interval, beside least squares](images/posterior-truth.png)

Answers of least squares at 1000 GPa are at the bound of its search.
"""


def extremes(numbers: Numbers, runs: Sequence[str]) -> dict[str, str]:
    """Return what the page says of all coverages together."""
    rows = [numbers.row(m, run, n, "covered") for run in runs for m, names in MODELS.items() for n in names]
    ps = [numbers.row(m, run, n, "p").value for run in runs for m, names in MODELS.items() for n in names]
    low, high = min(rows, key=lambda r: r.value), max(rows, key=lambda r: r.value)
    outside = [r for r in rows if not 0.88 <= r.value <= 0.92]
    named = ", ".join(f"{TITLES[r.quantity]} of `{r.model}` {100 * r.value:.2f} %" for r in outside)
    return {
        "lowest": f"{100 * low.value:.1f}",
        "highest": f"{100 * high.value:.1f}",
        "count": str(len(rows)),
        "outside": textwrap.fill(
            f"Outside 88 to 92 %: {named}." if outside else "None is outside 88 to 92 %.", 115
        ),
        "least_p": f"{min(ps):.2g}",
        "small_p": str(sum(p < 0.01 for p in ps)),
    }


def page(rows: Sequence[Row]) -> str:
    """Return the whole page, every number of which comes from the rows."""
    numbers = Numbers(rows)
    percent = numbers.percent
    values = {f"noise_{k}": v for k, v in extremes(numbers, [NOISE_ONLY]).items()}
    values |= {f"instrument_{k}": v for k, v in extremes(numbers, [CALIBRATED]).items()}
    for model in MODELS:
        key = model.replace("-", "_")
        row = numbers.row(model, NOISE_ONLY, "", "states recorded")
        values |= {
            f"recorded_{key}": percent(model, NOISE_ONLY, "", "states recorded"),
            "draws": str(row.draws),
        }
        values[f"contact_{key}"] = percent(model, NOISE_ONLY, "", "contact the more likely")
    for model in COMPARED:
        name = "modulus by least-squares"
        values[f"close_{model}"] = percent(model, NOISE_ONLY, name, "N_r < 0.1")
        close = numbers.row(model, NOISE_ONLY, name, "median error", part="N_r < 0.1").value
        values[f"close_error_{model}"] = f"{close:.2f}"
        values[f"close_off_{model}"] = percent(
            model, NOISE_ONLY, name, "off by more than 2", part="N_r < 0.1"
        )
        values[f"sure_off_{model}"] = percent(model, NOISE_ONLY, "modulus", "off by more than 2", part=SURE)
    values |= {
        "coverage": coverage_table(numbers, NOISE_ONLY),
        "coverage_instrument": coverage_table(numbers, CALIBRATED),
        "parts": parts_table(numbers, NOISE_ONLY),
        "parts_instrument": parts_table(numbers, CALIBRATED),
        "bins": bins_table(numbers),
        "limit": limit_table(numbers),
        "misstated": misstated_table(numbers),
        "methods": methods_table(numbers),
        "priors": "\n".join(f"- {TITLES[name]}: {prior_text(name)}" for name in PRIORS),
        "instrument": instrument_text(),
        "low_A1": f"{1e9 * AMPLITUDE[0]:.0f}",
        "high_A1": f"{1e9 * AMPLITUDE[1]:.0f}",
        "low_setpoint": f"{SETPOINT[0]:g}",
        "high_setpoint": f"{SETPOINT[1]:g}",
        "levels": ", ".join(f"{1e12 * level:.0f}" for level in LEVELS),
        "narrow": f"{NARROW:g}",
    }
    return PAGE.format_map(values)


def prior_text(name: str) -> str:
    """Return a prior in words."""
    prior, unit = PRIORS[name], {"modulus": "Pa", "stiffness": "N/m", "adhesion": "N"}.get(name, "1")
    if name == "indentation":
        return f"logarithm even from {1e9 * prior.first:g} nm to 2 A1"

    def text(value: float) -> str:
        return format_quantity(value, unit) if unit != "1" else f"{value:g}"

    if prior.kind == "normal":
        return f"half of a normal distribution, standard deviation {text(prior.second)}"
    kind = "logarithm even" if prior.kind == "log-range" else "even"
    return f"{kind} from {text(prior.first)} to {text(prior.second)}"


def instrument_text() -> str:
    """Return the stated errors of the instrument in words."""
    names = {
        "A0_offset": ("zero of A0", 1e12, "pm"),
        "phi1_offset": ("zero of phi1", 180.0 / math.pi, "degrees"),
        "gain0": ("gain of A0", 100.0, "%"),
        "gain2": ("gain of A2", 100.0, "%"),
        "gain3": ("gain of A3", 100.0, "%"),
        "latency2": ("lag of A2", 180.0 / math.pi, "degrees"),
        "latency3": ("lag of A3", 180.0 / math.pi, "degrees"),
        "stiffness": ("k", 100.0, "%"),
        "quality_factor": ("Q", 100.0, "%"),
        "free_amplitude": ("A1far", 100.0, "%"),
        "radius": ("R", 100.0, "%"),
    }
    said = (
        f"{title} {INSTRUMENT[name] * factor:.2g} {unit}" for name, (title, factor, unit) in names.items()
    )
    return "\n".join(textwrap.wrap(", ".join(said), 110))


# --- figures ----------------------------------------------------------------------------------------------------

COLOURS = {
    "modulus": PALETTE[0],
    "stiffness": PALETTE[0],
    "adhesion": PALETTE[5],
    "indentation": PALETTE[2],
    "viscosity": PALETTE[1],
    "damping": PALETTE[1],
    "loss_tangent": PALETTE[3],
}
MARKS = dict(zip(COLOURS, "oosD^^v", strict=True))
LABELS = {"modulus": "modulus, stiffness", "viscosity": "viscosity, damping"} | {
    name: TITLES[name] for name in ("adhesion", "indentation", "loss_tangent")
}


def _dress(axes: Axes, x: str, y: str, title: str) -> None:
    axes.set_xlabel(x, fontsize=LABEL_SIZE)
    axes.set_ylabel(y, fontsize=LABEL_SIZE)
    axes.set_title(title, fontsize=TITLE_SIZE, loc="left")
    axes.tick_params(labelsize=TICK_SIZE)
    axes.grid(color="0.9", linewidth=0.6)
    axes.set_axisbelow(True)


def _legend(figure: Figure) -> None:
    """Put one legend of the quantities below all panels."""
    handles = [
        Line2D([], [], color=COLOURS[n], marker=MARKS[n], linestyle="", markersize=4, label=LABELS[n])
        for n in LABELS
    ]
    figure.legend(handles=handles, fontsize=TICK_SIZE, ncols=5, frameon=False, loc="lower center")


def coverage_figure(numbers: Numbers) -> Figure:
    """Return coverage by model, noise and quantity, with and without errors of the instrument."""
    figure = new_figure(10.0, 5.6)
    figure.set_dpi(150)
    panels = figure.subplots(2, 1, sharex=True)
    ticks: list[float] = []
    labels: list[str] = []
    for axes, run in zip(panels, (NOISE_ONLY, CALIBRATED), strict=True):
        axes.axhspan(88.0, 92.0, color="0.93", zorder=0)
        axes.axhline(90.0, color="0.5", linewidth=0.9)
        place = 0.0
        ticks, labels = [], []
        for model, names in MODELS.items():
            for noise in (*(f"{1e12 * level:.0f}" for level in LEVELS), ALL):
                for k, name in enumerate(names):
                    row = numbers.row(model, run, name, "covered", noise=noise)
                    x = place + 0.13 * (k - 0.5 * (len(names) - 1))
                    axes.errorbar(
                        x,
                        100.0 * row.value,
                        100.0 * binomial(row.draws),
                        fmt=MARKS[name],
                        color=COLOURS[name],
                        markersize=4,
                        markerfacecolor=COLOURS[name] if noise == ALL else "white",
                        linewidth=1.0,
                    )
                ticks.append(place)
                labels.append(f"{noise}\n{model}" if noise == f"{1e12 * LEVELS[1]:.0f}" else noise)
                place += 1.0
            place += 0.5
        _dress(axes, "", "truths inside [%]", f"({'ab'[run == CALIBRATED]}) {run}")
        axes.set_xticks(ticks, labels)
        axes.grid(visible=False, axis="x")
    panels[1].set_xlabel("noise of A0 [pm], all three (filled), and model", fontsize=LABEL_SIZE)
    figure.tight_layout(rect=(0.0, 0.05, 1.0, 1.0))
    _legend(figure)
    return figure


def bins_figure(numbers: Numbers) -> Figure:
    """Return how many truths lie between the quantiles over how many should."""
    figure = new_figure(10.0, 5.4)
    figure.set_dpi(150)
    panels = figure.subplots(2, len(MODELS), sharex=True, sharey=True)
    for line, run in zip(panels, (NOISE_ONLY, CALIBRATED), strict=True):
        for axes, (model, names) in zip(line, MODELS.items(), strict=True):
            axes.axhline(1.0, color="0.5", linewidth=0.9)
            for k, name in enumerate(names):
                rows = [numbers.row(model, run, name, share) for share in SHARES]
                expected = np.array(BINS)
                errors = np.sqrt(expected * (1.0 - expected) / rows[0].draws) / expected
                axes.errorbar(
                    np.arange(4) + 0.13 * (k - 0.5 * (len(names) - 1)),
                    np.array([row.value for row in rows]) / expected,
                    errors,
                    fmt=MARKS[name],
                    color=COLOURS[name],
                    markersize=4,
                    linewidth=1.0,
                )
            below = run == CALIBRATED
            _dress(axes, "quantiles [%]" if below else "", "", model)
            axes.set_xticks(range(4), ["0-5", "5-50", "50-95", "95-100"])
    for axes, run in zip(panels[:, 0], (NOISE_ONLY, CALIBRATED), strict=True):
        axes.set_ylabel(f"{run}:\ntruths over what is expected", fontsize=LABEL_SIZE)
    figure.tight_layout(rect=(0.0, 0.05, 1.0, 1.0))
    _legend(figure)
    return figure


def truth_figure(found: Mapping[str, Outcomes], shown: int = 150) -> Figure:
    """Return medians with their intervals against truths, beside least squares."""
    figure = new_figure(10.0, 8.4)
    figure.set_dpi(150)
    panels = figure.subplots(len(COMPARED), 2, sharex=True, sharey=True)
    for (left, right), model in zip(panels, COMPARED, strict=True):
        some = {name: column[:: max(column.size // shown, 1)] for name, column in found[model].items()}
        truth, told = 1e-9 * some["true_modulus"], some["status"] == DETERMINED
        middle, low, high = (1e-9 * some[f"modulus_{v}"] for v in ("unscreened", "lower", "upper"))
        has = some["contact_probability"] >= 0.5
        for which, colour, label in (
            (has & ~told, "0.7", "not determined"),
            (has & told, PALETTE[0], "determined"),
        ):
            bars = np.array([middle - low, high - middle])[:, which]
            left.errorbar(
                truth[which],
                middle[which],
                bars,
                fmt="o",
                color=colour,
                markersize=3,
                linewidth=0.8,
                label=label,
            )
        value, close = 1e-9 * some["least-squares modulus_unscreened"], some["least-squares residual"] < 0.1
        sure = some["least-squares status"] == DETERMINED
        for which, colour, mark, label in (
            (~close, "0.7", "x", "N_r > 0.1"),
            (close & ~sure, PALETTE[1], "o", "N_r < 0.1, not determined"),
            (close & sure, PALETTE[5], "s", "N_r < 0.1, determined"),
        ):
            right.plot(truth[which], value[which], mark, color=colour, markersize=3.5, label=label)
        for axes, title in ((left, "median, 90 % interval"), (right, "least-squares")):
            axes.plot([1e-3, 1e3], [1e-3, 1e3], color="#000000", linewidth=0.8)
            axes.set(xscale="log", yscale="log", xlim=(4e-3, 70.0), ylim=(3e-4, 1e5))
            axes.legend(fontsize=TICK_SIZE, frameon=False, loc="upper left")
            _dress(axes, "true modulus [GPa]", "modulus [GPa]", f"{model}: {title}")
    figure.tight_layout()
    return figure


def main() -> None:
    """Write table, page and figures."""
    parser = argparse.ArgumentParser(description="Simulation-based calibration of the posterior.")
    parser.add_argument("--draws", type=int, default=DRAWS, help="at least so many of each model and run")
    parser.add_argument("--jobs", type=int, default=2)
    options = parser.parse_args()
    chunks = range(math.ceil(options.draws / (CHUNK * len(LEVELS))))
    tasks = [(m, run, level, k) for m in MODELS for level in LEVELS for k in chunks for run in RUNS]
    with ProcessPoolExecutor(options.jobs) as pool:
        # all runs of a chunk in one process, which then draws it twice instead of five times
        parts = list(pool.map(inverted, *zip(*tasks, strict=True), chunksize=len(RUNS)))
    found = {
        (m, run): together([p for t, p in zip(tasks, parts, strict=True) if t[:2] == (m, run)])
        for m in MODELS
        for run in RUNS
    }
    rows = [row for (model, run), outcomes in found.items() for row in rows_of(model, run, outcomes)]
    write_table(rows, FOLDER / "posterior.csv")
    # what is on the page is what is in the file
    rows = read_table(FOLDER / "posterior.csv")
    (FOLDER / "posterior.md").write_text(page(rows), encoding="utf-8")
    figures = {
        "coverage": coverage_figure(Numbers(rows)),
        "bins": bins_figure(Numbers(rows)),
        "truth": truth_figure({model: found[model, NOISE_ONLY] for model in COMPARED}),
    }
    for name, figure in figures.items():
        (FOLDER / "images" / f"posterior-{name}.png").write_bytes(png_bytes(figure))
    print(coverage_table(Numbers(rows), NOISE_ONLY), coverage_table(Numbers(rows), CALIBRATED), sep="\n\n")  # noqa: T201


if __name__ == "__main__":
    main()
