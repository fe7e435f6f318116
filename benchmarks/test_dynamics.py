"""The simulator against time integration of the same points, in the same run; read the ratios, not the seconds.

The accuracy that each side reached stands beside its time: the largest relative error of A2 over the curve,
against harmonic balance with 80 harmonics.
"""

import functools
from typing import Any

import numpy as np
import pytest

import overtone as ot
from overtone.contact.sample import Sample
from overtone.dynamics.transient import settle
from overtone.probe import Probe

HEIGHTS = np.linspace(12e-9, 72e-9, 100)


def lever() -> Probe:
    return Probe.simple(
        stiffness=26.0,
        frequency=303e3,
        quality_factor=456.0,
        radius=10e-9,
        drive_frequency=303e3,
        free_amplitude=85e-9,
    )


def polymer() -> Sample:
    return ot.sample("dmt", modulus=1e9, poisson_ratio=0.3, adhesion=20e-9)


@functools.cache
def reference() -> Any:
    curve = ot.approach_curve(lever(), polymer(), z=HEIGHTS, n_max=80)
    return curve["A2"].sel(direction="approach")


def error(A2: Any) -> float:
    return float(abs(A2 / reference() - 1.0).max())


@pytest.mark.benchmark(group="approach curve of 100 points, there and back, with stability")
@pytest.mark.parametrize("n_max", [10, 20])
def test_harmonic_balance(benchmark: Any, n_max: int) -> None:
    curve = benchmark(ot.approach_curve, lever(), polymer(), z=HEIGHTS, n_max=n_max)
    benchmark.extra_info["error of A2"] = error(curve["A2"].sel(direction="approach"))


@pytest.mark.benchmark(group="approach curve of 100 points, there and back, with stability")
@pytest.mark.parametrize("n_max", [10, 20])
def test_harmonic_balance_of_one_branch(benchmark: Any, n_max: int) -> None:
    """The hundred states alone, at their set-points: what the time integration below does too."""
    setpoints = np.linspace(0.2, 0.9, 100)
    exact = ot.hold_amplitude(lever(), polymer(), setpoint=setpoints, n_max=80)["A2"]
    states = benchmark(ot.hold_amplitude, lever(), polymer(), setpoint=setpoints, n_max=n_max)
    benchmark.extra_info["error of A2"] = float(abs(states["A2"] / exact - 1.0).max())


@pytest.mark.benchmark(group="approach curve of 100 points, there and back, with stability")
@pytest.mark.parametrize("method", ["relax", "shooting"])
def test_time_integration(benchmark: Any, method: str) -> None:
    """Each point from its neighbour's state is what a sweep does; here all start from the free motion, in parallel."""
    heights = np.sort(HEIGHTS)[::-1]

    def settled() -> Any:
        # tolerance and goal that reach the accuracy of the balance with ten harmonics, 1e-4 of A2
        return settle(lever(), polymer(), Z=heights, method=method, tolerance=1e-7, goal=3e-7)

    states = benchmark.pedantic(settled, rounds=1, iterations=1)
    A2 = states["A2"].rename({"Z": "z"}).assign_coords(z=heights)
    repulsive = states["F_cons"].sel(harmonic=1).values < 0.0
    benchmark.extra_info["error of A2"] = error(A2[repulsive])
    benchmark.extra_info["repulsive"] = float(repulsive.mean())


@pytest.mark.benchmark(group="states at fixed amplitude, 400,000 materials")
def test_first_harmonic_of_a_whole_scan(benchmark: Any) -> None:
    rng = np.random.default_rng(0)
    modulus = np.exp(rng.uniform(np.log(5e7), np.log(5e9), (400, 1000)))
    scan = ot.sample(
        "dmt", modulus=modulus, poisson_ratio=0.3, adhesion=rng.uniform(1e-9, 2e-8, modulus.shape)
    )
    ot.hold_amplitude(lever(), scan, setpoint=0.5, n_max=1)
    states = benchmark(ot.hold_amplitude, lever(), scan, setpoint=0.5, n_max=1)
    benchmark.extra_info["states per call"] = modulus.size
    benchmark.extra_info["found"] = float((states["state"] == 0).mean())
