"""Pixels per second of every method against a SciPy loop, and in evaluations of the bare model: read the ratios.

The bare model is one evaluation of the closed forms, three harmonics of both terms with their derivatives: what a
pixel costs in them is how far a method is from the least that could be asked of it. The truth of what is timed here is
tested elsewhere (tests/inversion, docs/posterior.md).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from scipy.optimize import least_squares as scipy_least_squares

from overtone.blocks import run_blocks
from overtone.contact.models import contact_model
from overtone.demo import demo_probe, virtual_scan
from overtone.instrument.noise import complete_noise
from overtone.inversion import exact
from overtone.inversion.columns import columns_of, fill_columns
from overtone.inversion.linear import stiffness
from overtone.inversion.marginal import Candidate
from overtone.inversion.motion import follow
from overtone.inversion.pixels import Setting
from overtone.inversion.posterior import QUANTITIES, SUMMARIES, posterior_pixels
from overtone.inversion.priors import complete_priors, for_kernel
from overtone.inversion.properties import map_properties
from overtone.inversion.table import NODES
from overtone.inversion.valley import Box
from overtone.kernels import kernel

ORDERS = (0, 1, 2)
GIVEN = {"poisson_ratio": 0.35}
REPEATS = 20


@kernel
def evaluate(columns: Any, amplitude: np.ndarray, Delta: np.ndarray, out: np.ndarray) -> None:
    """The bare model, once a pixel."""
    work = np.empty((6, 3))
    for i in range(amplitude.shape[0]):
        fill_columns(columns, amplitude[i], Delta[i], 2, work)
        out[i] = work[0, 0] + work[2, 0]


class Scan:
    """Pixels of a PS-LDPE blend with ordinary noise, many times over."""

    def __init__(self) -> None:
        self.observables, self.truth = virtual_scan(shape=(64, 64), seed=1)
        self.probe = demo_probe()
        record = contact_model("dmt")
        self.columns = columns_of(record, self.probe, GIVEN)
        self.setting = Setting.of(self.observables, self.probe, ORDERS, (), complete_noise(None, ORDERS))
        pixels = self.setting.pixels(slice(0, self.observables["A1"].size), 0.0)
        self.y, self.whitening = np.tile(pixels.y, (REPEATS, 1)), np.tile(pixels.whitening, (REPEATS, 1, 1))
        self.amplitude = np.tile(pixels.amplitude, REPEATS)
        self.known = np.tile(pixels.known, (REPEATS, 1))
        self.usable = np.ones(self.amplitude.size, np.bool_)
        self.candidate = Candidate.of(
            record, self.columns, self.setting, complete_priors(None, record, 10e-9), self.probe, GIVEN
        )
        Delta = self.truth["indentation"].values.ravel() / (2.0 * self.observables["A1"].values.ravel())
        self.Delta = np.tile(Delta, REPEATS)

    @property
    def size(self) -> int:
        return int(self.amplitude.size)


@pytest.fixture(scope="module")
def scan() -> Scan:
    return Scan()


def on_all_cores(benchmark: Any, work: Callable[[slice], None], size: int, block: int = 4096) -> None:
    run_blocks(work, min(size, block), block)
    benchmark(run_blocks, work, size, block)
    benchmark.extra_info["pixels per second"] = size / benchmark.stats["min"]
    benchmark.extra_info["pixels per call"] = size


@pytest.mark.benchmark(group="inversion of a pixel, all cores")
def test_bare_model(benchmark: Any, scan: Scan) -> None:
    out = np.empty(scan.size)

    def work(b: slice) -> None:
        evaluate(scan.columns, scan.amplitude[b], scan.Delta[b], out[b])

    on_all_cores(benchmark, work, scan.size)


def solver(scan: Scan, y: np.ndarray) -> Callable[[slice], None]:
    table = scan.candidate.table
    orders = np.array(ORDERS)
    cross = np.empty((table.elastic.shape[0], 3, NODES))
    exact.fill_cross(table, orders, cross)
    size = y.shape[0]
    solutions, spreads = np.empty((size, exact.MOST, 4)), np.empty((size, exact.MOST))
    best, chi2, count = np.empty((size, 4)), np.empty(size), np.empty(size, np.int8)
    contact = scan.columns.contact
    box = Box(stiffness(contact, 1e4)[0], stiffness(contact, 1e12)[0], 0.0, 1e-6)
    spans, shifts = np.zeros((size, 2)), np.zeros((size, 0, 3))

    def work(b: slice) -> None:
        exact.solve_pixels(
            y[b],
            scan.whitening[b],
            scan.amplitude[b],
            scan.usable[b],
            scan.columns,
            table,
            cross,
            orders,
            np.zeros(3, np.bool_),
            np.array([1]),
            box,
            spans[b],
            shifts[b],
            solutions[b],
            spreads[b],
            best[b],
            chi2[b],
            count[b],
        )

    return work


@pytest.mark.benchmark(group="inversion of a pixel, all cores")
def test_exact_where_there_is_a_solution(benchmark: Any, scan: Scan) -> None:
    """All roots of three harmonics on a bare cosine, on data without noise."""
    shape = (scan.size, 3)
    y = np.empty(shape)
    work = np.empty((6, 3))
    E, F = (np.tile(scan.truth[name].values.ravel(), REPEATS) for name in ("modulus", "adhesion"))
    for i in range(scan.size):
        fill_columns(scan.columns, scan.amplitude[i], scan.Delta[i], 2, work)
        y[i] = stiffness(scan.columns.contact, E[i])[0] * work[0] + F[i] * work[2]
    on_all_cores(benchmark, solver(scan, y), scan.size)


@pytest.mark.benchmark(group="inversion of a pixel, all cores")
def test_exact_with_noise(benchmark: Any, scan: Scan) -> None:
    """The same with ordinary noise: half of the stiff pixels have no solution, and the closest one is found."""
    on_all_cores(benchmark, solver(scan, scan.y), scan.size)


@pytest.mark.benchmark(group="inversion of a pixel, all cores")
@pytest.mark.parametrize("motion", ["cosine", "full"])
def test_posterior(benchmark: Any, scan: Scan, motion: str) -> None:
    """Medians and intervals of three properties, ordinary noise."""
    size = scan.size // 4
    quantiles, summary = np.empty((size, QUANTITIES, 3)), np.empty((size, SUMMARIES))
    followed = follow(scan.probe, (2,), 10 if motion == "full" else 0)
    prior = for_kernel(scan.candidate.priors, "modulus")
    none = np.zeros((1, 3)), np.zeros(1)

    def work(b: slice) -> None:
        posterior_pixels(
            scan.y[b],
            scan.whitening[b],
            scan.amplitude[b],
            scan.usable[b],
            scan.columns,
            scan.candidate.table,
            np.array(ORDERS),
            np.zeros(3, np.bool_),
            np.array([1]),
            prior,
            followed,
            scan.known[b],
            *none,
            True,
            quantiles[b],
            summary[b],
        )

    on_all_cores(benchmark, work, size, 1024)


@pytest.mark.benchmark(group="inversion of a pixel, all cores")
def test_scipy_loop(benchmark: Any, scan: Scan) -> None:
    """Sixteen pixels by scipy.optimize.least_squares on the same closed forms, one start, one core."""
    work = np.empty((6, 3))
    contact = scan.columns.contact
    size = 16

    def model(x: np.ndarray, A: float) -> np.ndarray:
        E, F, d = np.exp(x)
        fill_columns(scan.columns, A, d / (2.0 * A), 2, work)
        return stiffness(contact, E)[0] * work[0] + F * work[2]

    def fit() -> None:
        for y, A in zip(scan.y[:size], scan.amplitude[:size], strict=True):
            top = np.log([1e12, 1e-6, 2.0 * A * 0.999])
            scipy_least_squares(
                lambda x, y=y, A=A: (model(x, A) - y) / abs(y),
                np.log([1e9, 10e-9, 5e-9]),
                bounds=(np.log([1e4, 1e-12, 1e-12]), top),
                xtol=1e-10,
                ftol=1e-10,
                gtol=1e-10,
            )

    benchmark.pedantic(fit, rounds=1, iterations=1)
    benchmark.extra_info["pixels per second"] = size / benchmark.stats["min"]


@pytest.mark.benchmark(group="a whole scan, 64 x 64")
@pytest.mark.parametrize(
    ("method", "motion"),
    [("exact", "cosine"), ("exact", "full"), ("posterior", "cosine"), ("posterior", "full")],
)
def test_map(benchmark: Any, scan: Scan, method: str, motion: str) -> None:
    asked = {"model": "dmt", "poisson_ratio": 0.35, "method": method, "motion": motion}
    map_properties(scan.observables, scan.probe, **asked)
    benchmark(map_properties, scan.observables, scan.probe, **asked)
    benchmark.extra_info["pixels per second"] = scan.observables["A1"].size / benchmark.stats["min"]
