"""Periods per second of the equation of motion against other integrators, at the accuracy each has reached.

Every side follows the same motion, the contact of section 3 of the method's paper for a few hundred periods,
or for as many as a slow one gets through; its error is that of the state at the end, against a run at the
tightest tolerance. Tolerances are swept, and the speed of the other side is read from its curve at the
accuracy of ours. Timed by turns, in the time of the process, so that other work on the machine falls on all
alike; read the ratios.
"""

import math
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from overtone.contact.sample import sample
from overtone.dynamics import integrate
from overtone.dynamics.system import laws
from overtone.dynamics.transient import contacts_of, lever_of, settle, sweep
from overtone.probe import Probe

Z, ADHESION, DISTANCE = 37.0e-9, 20e-9, 0.2e-9
START = np.array([36e-9, 20e-9])  # deflection and its derivative by the phase of the drive [m]
ROUNDS = 5
ADVANTAGE_OVER_SCIPY = 50.0


def probe() -> Probe:
    return Probe.simple(
        stiffness=26.0,
        frequency=303e3,
        quality_factor=456.0,
        radius=10e-9,
        drive_frequency=303e3,
        free_amplitude=85e-9,
    )


class Case(NamedTuple):
    """A contact with what a plain right side needs of it."""

    key: str
    lever: Any
    contacts: Any
    Lambda: float


def case(key: str) -> Case:
    of = sample(key, modulus=1e9, poisson_ratio=0.3, adhesion=ADHESION)
    lever = lever_of(probe())
    contacts = contacts_of(laws(probe(), of), lever.length)
    return Case(key, lever, contacts, float(contacts.law[0, 0, 1]))


def ours(of: Case, tolerance: float, periods: int) -> np.ndarray:
    state, mode = (START / of.lever.length)[None].copy(), np.array([[-1, 0]])
    status, steps = np.zeros(1, np.int8), np.zeros(1, np.int64)
    height = np.array([Z / of.lever.length])
    integrate.follow_block(of.lever, of.contacts, height, periods, state, mode, tolerance, status, steps)
    assert status[0] == integrate.DONE
    return state[0] * of.lever.length * 1e9


def plain(of: Case) -> Callable[[float, Any], tuple[float, float]]:
    """Return the right side in nanometres as one would write it for an integrator without events."""
    elastic, attraction = of.Lambda * 1e-9**1.5 / 26e-9, ADHESION / 26e-9
    gap, distance, push, loss = Z * 1e9, DISTANCE * 1e9, 85.0 / 456.0, 1.0 / 456.0
    tail = of.key == "dmt"

    def right_side(theta: float, y: Any) -> tuple[float, float]:
        q, v = y
        d = gap + q
        if d < 0.0:
            force = elastic * -d * math.sqrt(-d) - attraction
        else:
            force = -attraction * (distance / (distance + d)) ** 2 if tail else 0.0
        return v, force - q - loss * v + push * math.cos(theta)

    return right_side


def by_scipy(of: Case, method: str, tolerance: float, periods: int) -> np.ndarray:
    solution = solve_ivp(
        plain(of), (0.0, 2 * np.pi * periods), START * 1e9, method=method, rtol=tolerance, atol=tolerance
    )
    return solution.y[:, -1]


class Run(NamedTuple):
    """A speed [periods/s] and the error of the end [free amplitude]."""

    speed: float
    error: float


def race(
    runs: dict[Any, Callable[[], np.ndarray]], exact: np.ndarray, periods: int, rounds: int
) -> dict[Any, Run]:
    """Return the best of some rounds of each, by turns."""
    best = dict.fromkeys(runs, math.inf)
    error = {name: float(abs(run() - exact).max()) / 85.0 for name, run in runs.items()}
    for _ in range(rounds):
        for name, run in runs.items():
            begin = time.process_time()
            run()
            best[name] = min(best[name], time.process_time() - begin)
    return {name: Run(periods / best[name], error[name]) for name in runs}


def at_accuracy(runs: list[Run], error: float) -> float:
    """Return the best speed at which a side is no less accurate, between its own runs on a straight line."""
    fast = 0.0
    for one, other in zip(runs, [*runs[1:], None], strict=True):
        if one.error <= error:
            fast = max(fast, one.speed)
        elif other is not None and other.error < error:
            part = math.log(one.error / error) / math.log(one.error / other.error)
            fast = max(fast, one.speed * (other.speed / one.speed) ** part)
    return fast


OUR_TOLERANCES = (1e-5, 1e-6, 1e-7, 1e-8, 1e-9, 1e-10)
KEYS = ("dmt", "dmt-contact")


def told(benchmark: Any, ratios: dict[float, tuple[Run, float]]) -> None:
    for tolerance, (run, other) in ratios.items():
        benchmark.extra_info[f"tolerance {tolerance:g}"] = (
            f"{run.speed:.0f} periods/s at {run.error:.1e}, ratio {run.speed / other if other else math.inf:.2f}"
        )


@pytest.mark.benchmark(group="time integration")
@pytest.mark.parametrize("key", KEYS)
def test_against_scipy(benchmark: Any, key: str) -> None:
    of, periods, few = case(key), 200, 10
    exact, exact_few = ours(of, 1e-13, periods), ours(of, 1e-13, few)
    tolerances = (1e-7, 1e-8, 1e-9)
    mine = race({t: lambda t=t: ours(of, t, periods) for t in tolerances}, exact, periods, ROUNDS)
    # the error of ours over as few periods as the slow side gets through
    short = race({t: lambda t=t: ours(of, t, few) for t in tolerances}, exact_few, few, 1)
    slow: list[float] = []
    for method in ("RK45", "DOP853", "LSODA", "Radau"):
        steps = (1e-5, 1e-7, 1e-9, 1e-11) if method != "Radau" else (1e-5, 1e-7)
        runs = race({t: lambda t=t, m=method: by_scipy(of, m, t, few) for t in steps}, exact_few, few, 1)
        slow.append([at_accuracy(list(runs.values()), short[t].error) for t in tolerances])
    best = np.max(slow, axis=0)
    ratios = {t: (mine[t], best[i]) for i, t in enumerate(tolerances)}
    told(benchmark, ratios)
    benchmark.pedantic(ours, args=(of, 1e-8, periods), rounds=3)
    assert all(run.speed > ADVANTAGE_OVER_SCIPY * other for run, other in ratios.values())


@pytest.mark.benchmark(group="time integration")
@pytest.mark.parametrize("key", KEYS)
def test_against_cyrk(benchmark: Any, key: str) -> None:
    """CyRK's compiled integrators, which step over contact without noticing."""
    cyrk = pytest.importorskip("CyRK")
    numba = pytest.importorskip("numba")
    of, periods = case(key), 200
    exact = ours(of, 1e-13, periods)
    right_side = numba.njit(plain(of))

    def slopes(slope, theta, y, arguments):  # type: ignore[no-untyped-def]
        slope[0], slope[1] = right_side(theta, (y[0], y[1]))

    address = cyrk.nb_diffeq_addr(slopes)

    def theirs(method: str, tolerance: float) -> np.ndarray:
        end = 2 * np.pi * periods
        result = cyrk.nbsolve2_ivp(
            address, (0.0, end), START * 1e9, method=method, rtol=tolerance, atol=tolerance
        )
        return np.array([result.y[0, -1], result.y[1, -1]])

    runs: dict[Any, Callable[[], np.ndarray]] = {t: lambda t=t: ours(of, t, periods) for t in OUR_TOLERANCES}
    methods = ("DOP853", "RK45", "Vern7", "Vern8", "Tsit5")
    for method in methods:
        for t in (1e-5, 1e-6, 1e-7, 1e-8, 1e-9, 1e-10, 1e-11, 1e-12):
            runs[method, t] = lambda m=method, t=t: theirs(m, t)
    found = race(runs, exact, periods, ROUNDS)
    ratios = {}
    for t in OUR_TOLERANCES:
        curves = [[found[m, s] for s in (1e-5, 1e-6, 1e-7, 1e-8, 1e-9, 1e-10, 1e-11, 1e-12)] for m in methods]
        ratios[t] = (found[t], max(at_accuracy(curve, found[t].error) for curve in curves))
    told(benchmark, ratios)
    benchmark.pedantic(ours, args=(of, 1e-8, periods), rounds=3)


@pytest.mark.benchmark(group="states and sweeps in time")
@pytest.mark.parametrize("method", ["shooting", "relax"])
def test_settle(benchmark: Any, method: str) -> None:
    heights = np.linspace(20e-9, 70e-9, 8)
    of = sample("dmt", modulus=1e9, poisson_ratio=0.3, adhesion=ADHESION)
    settle(probe(), of, Z=heights[:1], method=method, max_periods=1)
    benchmark.pedantic(settle, args=(probe(), of), kwargs={"Z": heights, "method": method}, rounds=3)
    benchmark.extra_info["states per call"] = heights.size


@pytest.mark.benchmark(group="states and sweeps in time")
def test_sweep(benchmark: Any) -> None:
    of = sample("dmt", modulus=1e9, poisson_ratio=0.3, adhesion=ADHESION)
    arguments: dict[str, Any] = {"speed": 1e-6, "bandwidth": 2e4, "settle_periods": 0, "tolerance": 1e-7}
    sweep(probe(), of, z=[80e-9, 79.99e-9], **arguments)
    benchmark.pedantic(
        sweep, args=(probe(), of), kwargs={"z": np.linspace(80e-9, 50e-9, 100), **arguments}, rounds=2
    )
    benchmark.extra_info["periods per call"] = round(30e-9 / 1e-6 * 303e3)
