"""Pixels per second against what a user would write today, in the same run; read the ratios, not the seconds."""

import math
from typing import Any

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.optimize import least_squares as scipy_least_squares
from scipy.special import gamma, hyp2f1

from overtone.blocks import run_blocks
from overtone.contact import terms
from overtone.contact.sample import sample
from overtone.demo import demo_probe, virtual_scan
from overtone.dynamics.hold import hold_amplitude
from overtone.harmonics import to_force_harmonics
from overtone.inversion import least_squares
from overtone.inversion.linear import Contact, stiffness
from overtone.inversion.properties import map_properties

LOWER, UPPER = np.log([1e4, 1e-12, 1e-12]), np.log([1e12, 1e-6, 1.0])


@pytest.fixture(scope="module")
def scan() -> Any:
    return virtual_scan(shape=(64, 64), seed=1)[0]


@pytest.mark.benchmark(group="least squares, one start a pixel")
def test_our_kernel(benchmark: Any, scan: Any) -> None:
    force = np.ascontiguousarray(
        to_force_harmonics(scan, demo_probe())["F_cons"].sel(harmonic=[0, 1, 2]).values.reshape(3, -1).T
    )
    count = force.shape[0]
    contact = Contact(terms.LINEAR_TAIL, 0.2e-9, (1 - 0.09) / 130e9, 1 - 0.35**2, 4e-4 / 3)
    out = np.empty((count, 3)), np.empty(count), np.empty((count, 3)), np.empty(count, np.int8)
    start = np.log(np.array(least_squares.STARTS[1]))
    amplitude = scan["A1"].values.ravel()
    benchmark(
        least_squares.fit_pixels, force, np.array([0, 1, 2]), amplitude, contact, LOWER, UPPER, start, *out
    )
    benchmark.extra_info["pixels per call"] = count


@pytest.mark.benchmark(group="least squares, one start a pixel")
def test_scipy_loop(benchmark: Any, scan: Any) -> None:
    """Sixteen pixels by scipy.optimize.least_squares on the same harmonics, at tight tolerances."""
    force = (
        to_force_harmonics(scan, demo_probe())["F_cons"].sel(harmonic=[0, 1, 2]).values.reshape(3, -1).T[:16]
    )
    contact = Contact(terms.LINEAR_TAIL, 0.2e-9, (1 - 0.09) / 130e9, 1 - 0.35**2, 4e-4 / 3)
    h, dh, g, dg = (np.empty(3) for _ in range(4))

    def model(x: np.ndarray, A: float) -> np.ndarray:
        E, F, d = np.exp(x)
        terms.sphere_harmonics(A, d / (2 * A), 2, h, dh)
        terms.linear_adhesion_harmonics(A, d / (2 * A), 0.2e-9, 2, g, dg)
        return stiffness(contact, E)[0] * h + F * g

    def fit() -> None:
        for F, A in zip(force, scan["A1"].values.ravel(), strict=False):
            top = np.minimum(UPPER, [UPPER[0], UPPER[1], math.log(2 * A * least_squares.MAX_DELTA)])
            scipy_least_squares(
                lambda x, F=F, A=A: (model(x, A) - F) / abs(F),
                np.log(least_squares.STARTS[1]),
                bounds=(LOWER, top),
                xtol=1e-12,
                ftol=1e-12,
                gtol=1e-12,
                max_nfev=2000,
            )

    benchmark.pedantic(fit, rounds=1, iterations=1)
    benchmark.extra_info["pixels per call"] = 16


@pytest.mark.benchmark(group="whole map, three starts and the range of moduli")
@pytest.mark.parametrize("harmonics", [(0, 1, 2), (1, 2, 3)])
def test_map(benchmark: Any, scan: Any, harmonics: tuple[int, ...]) -> None:
    asked = {"method": "least-squares", "model": "dmt-linear", "poisson_ratio": 0.35, "harmonics": harmonics}
    benchmark(map_properties, scan, demo_probe(), **asked)
    benchmark.extra_info["pixels per call"] = scan["A1"].size


@pytest.mark.benchmark(group="harmonics 0 to 3 of one contact")
def test_closed_form(benchmark: Any) -> None:
    h, dh, g, dg = (np.empty(4) for _ in range(4))

    def both() -> None:
        terms.sphere_harmonics(39e-9, 0.1, 3, h, dh)
        terms.linear_adhesion_harmonics(39e-9, 0.1, 0.2e-9, 3, g, dg)

    benchmark(both)


@pytest.mark.benchmark(group="harmonics 0 to 3 of one contact")
def test_quadrature_by_scipy(benchmark: Any) -> None:
    A, u1 = 39e-9, 0.8

    def both() -> None:
        for n in range(4):
            quad(lambda t, n=n: terms.sphere_force(A * (u1 - math.cos(t)), 1.0) * math.cos(n * t), 0, math.pi)

    benchmark(both)


N_POINTS = 200_000


def _points() -> tuple[np.ndarray, np.ndarray]:
    generator = np.random.default_rng(0)
    return np.full(N_POINTS, 40e-9), 10.0 ** generator.uniform(-2.5, -0.1, N_POINTS)


@pytest.mark.benchmark(group="harmonics 0 to 3 of dmt with derivative, 200,000 points")
def test_dmt_kernels_on_two_threads(benchmark: Any) -> None:
    A, Delta = _points()
    power, a0 = np.full(N_POINTS, 1.5), np.full(N_POINTS, 0.2e-9)
    h, dh, g, dg = (np.empty((N_POINTS, 4)) for _ in range(4))

    def block(part: slice) -> None:
        terms.power_block(A[part], Delta[part], power[part], h[part], dh[part])
        terms.adhesion_block(terms.VAN_DER_WAALS_TAIL, A[part], Delta[part], a0[part], g[part], dg[part])

    benchmark(run_blocks, block, N_POINTS, 8192)


@pytest.mark.benchmark(group="harmonics 0 to 3 of dmt with derivative, 200,000 points")
def test_dmt_by_scipy_special(benchmark: Any) -> None:
    """Plain NumPy: the elastic part by hyp2f1, the tail by its recurrences; no derivative of the tail."""
    A, Delta = _points()

    def harmonics() -> list[np.ndarray]:
        u1, c1 = 1 - 2 * Delta, np.arccos(1 - 2 * Delta)
        out = []
        for p in (1.5, 0.5):
            front = math.sqrt(math.pi) * 2**p * gamma(p + 1) / gamma(p + 1.5) * Delta ** (p + 0.5)
            out += [front * hyp2f1(0.5 - n, 0.5 + n, p + 1.5, Delta) for n in range(4)]
        b = u1 + 0.2e-9 / A
        root = np.sqrt((1 - b**2).astype(complex))
        t1, kap = np.tan(c1 / 2), np.sqrt(((1 - b) / (1 + b)).astype(complex))
        J0 = (np.log((t1 + kap) / (t1 - kap)) / root).real
        J = [J0, b * J0 - (np.pi - c1)]
        I = [(-np.sin(c1) / (b - np.cos(c1)) + b * J0) / (b**2 - 1)]
        I.append(b * I[0] - J[0])
        for n in range(1, 3):
            J.append(2 * b * J[n] - J[n - 1] + 2 * np.sin(n * c1) / n)
            I.append(2 * b * I[n] - I[n - 1] - 2 * J[n])
        return out + I

    benchmark.pedantic(harmonics, rounds=3, iterations=1)


@pytest.mark.benchmark(group="steady states at fixed amplitude")
def test_hold_amplitude(benchmark: Any) -> None:
    modulus = np.full((32, 32), 1e9)
    material = sample("dmt", modulus=modulus, poisson_ratio=0.3, adhesion=5e-9)
    benchmark(hold_amplitude, demo_probe(), material, setpoint=0.42)
    benchmark.extra_info["states per call"] = modulus.size
