"""Make the page on whether intervals hold what they say: simulation-based calibration of method ``posterior``.

Run by hand, ``python docs/posterior.py [--draws 2000] [--jobs 2]``; five minutes on two cores. Materials are drawn from
the priors that the inversion is told, states are simulated on the full motion, noise and an instrument are added, and
one pixel after the other is inverted. Draws are seeded by chunk, so that they come out again whatever the jobs.
"""

from __future__ import annotations

import argparse
import csv
import math
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

Array = npt.NDArray[np.float64]
Outcomes = dict[str, Array]
"""Columns, one number a draw."""

FOLDER = Path(__file__).parent
SEED, DRAWS, CHUNK = 1789, 2000, 100
N_MAX = 20  # harmonics of the simulated motion; the inversion follows ten
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
    state = indented_states(
        true, sample, amplitude=[A1], indentation=[truth["indentation"]], n_max=N_MAX
    )
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
    of_prior = {elastic: 12.0 / log_E**2, "adhesion": 1.0, "indentation": 12.0 / log_t**2, "loss_tangent": 3.0}
    information = white.T @ white + np.diag([of_prior[n] for n in names])
    return math.sqrt(float(np.linalg.inv(information)[0, 0]) + float(pixel.left[0]))


def inverted(model: str, run: str, level: float, number: int, size: int = CHUNK) -> Outcomes:
    """Return the outcomes of a chunk of draws: truth, medians, intervals, status."""
    calibrated = run == CALIBRATED
    random = np.random.default_rng([SEED, list(MODELS).index(model), int(1e12 * level), number])
    draws: list[Draw] = []
    tried = 0
    while len(draws) < size:
        draw = one_draw(model, random, calibrated=calibrated)
        tried += 1
        draws += [draw] if draw is not None else []
    noise = {**NOISE, "A0": level}
    read = observables_of(draw.reading for draw in draws)
    noisy = add_noise(read, noise, seed=int(random.integers(2**31)))
    rows = []
    for i, draw in enumerate(draws):
        probe, told = stated(run, draw.probe, noise)
        pixel = noisy.isel(draw=[i])
        data = with_calibration(pixel, probe) if calibrated else pixel
        row = posterior_row(model, data, probe, told)
        row |= {f"true_{name}": draw.truth[name] for name in MODELS[model]}
        if run in (NOISE_ONLY, CALIBRATED):
            row["limit"] = limit(model, draw, noise, calibrated=calibrated)
        if run == NOISE_ONLY and model in COMPARED:
            row |= others_row(model, pixel, probe, told)
        rows.append(row | {"level": level, "A1": draw.truth["A1"]})
    columns = {name: np.array([row[name] for row in rows]) for name in rows[0]}
    return columns | {"tried": np.full(size, tried / size)}


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


def others_row(
    model: str, data: xr.Dataset, probe: ot.Probe, noise: Mapping[str, float]
) -> dict[str, float]:
    """Return what the other methods say of the modulus of a pixel."""
    row = {}
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


# 90 % of the truths should be inside; of how many of 2000 they are, 0.7 % are chance


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
    return [Row(*line[:6], float(line[6]), int(line[7])) for line in lines]


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
                numbers.covered(model, run, name, noise=noise) if name else "" for name in names_in_columns(model)
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
    head = ["model", "wrong", *HEADS, "modulus or stiffness where determined", "poor fit [%]", "determined [%]"]
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
