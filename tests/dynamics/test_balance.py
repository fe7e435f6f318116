"""The force on a motion and its derivatives, as the balance uses them."""

import math
from typing import Any

import numba
import numpy as np
import pytest

import overtone as ot
from overtone.dynamics.balance import EXTRAS, PEAK, WORK, Motion, Sums, force_on_motion
from overtone.dynamics.system import laws
from overtone.probe import Probe

SAMPLES = {
    "hertz": {"modulus": 1e9, "poisson_ratio": 0.3},
    "hertz-viscous": {"modulus": 1e8, "poisson_ratio": 0.4, "viscosity": 50.0},
    "dmt-contact": {"modulus": 1e9, "poisson_ratio": 0.3, "adhesion": 8e-9},
    "dmt-linear": {"modulus": 1e9, "poisson_ratio": 0.3, "adhesion": 8e-9},
    "dmt": {"modulus": 1e9, "poisson_ratio": 0.3, "adhesion": 8e-9},
    "dmt-viscous": {"modulus": 2e8, "poisson_ratio": 0.3, "adhesion": 8e-9, "viscosity": 80.0},
    "kelvin-voigt-adhesion": {"stiffness": 5.0, "damping": 1e-7, "adhesion": 4e-9},
    "cone": {"modulus": 5e8, "poisson_ratio": 0.3, "half_angle": 0.35},
    "power": {"prefactor": 3.0, "exponent": 1.3},
    "thin-layer": {"modulus": 5e7, "poisson_ratio": 0.3, "thickness": 60e-9},
    "capillary": {"modulus": 1e9, "poisson_ratio": 0.3, "adhesion": 8e-9, "rupture_distance": 1.2e-9},
    "jkr": {"modulus": 5e8, "poisson_ratio": 0.4, "adhesion": 8e-9},
    "maugis": {"modulus": 5e8, "poisson_ratio": 0.4, "work_of_adhesion": 0.1},
}
HIGHER = np.array([0.0, 0.0, -0.08 + 0.02j, 0.03 - 0.01j, 0.004 + 0.003j]) * 1e-9


def lever() -> Probe:
    return Probe.simple(
        stiffness=26.0,
        frequency=303e3,
        quality_factor=456.0,
        radius=10e-9,
        drive_frequency=303e3,
        free_amplitude=85e-9,
    )


@numba.njit  # type: ignore[misc]
def summed(g, amplitude, b, omega, law, f, P, S, extras, turns):  # type: ignore[no-untyped-def]
    force_on_motion(Motion(g, amplitude, b), omega, law, Sums(f, P, S, extras, turns))


def force_sums(key: str, g: float, amplitude: float, b: np.ndarray, orders: int = 12) -> tuple[Any, ...]:
    law = laws(lever(), ot.sample(key, **SAMPLES[key])).at(0)
    f, P, S = np.empty(orders, complex), np.empty(orders, complex), np.empty(orders, complex)
    extras = np.empty(EXTRAS)
    summed(g, amplitude, b, 2.0 * math.pi * 303e3, law, f, P, S, extras, np.empty(orders, complex))
    return f, P, S, extras


HYSTERETIC = ("jkr", "maugis", "capillary")


def given(key: str) -> dict[str, Any]:
    """Return the parameters of a model that belong to the probe."""
    names = {q.name for q in ot.sample(key, **SAMPLES[key]).model.parameters}
    return {name: value for name, value in {"radius": 10e-9, "frequency": 303e3}.items() if name in names}


@pytest.mark.parametrize("key", list(SAMPLES))
@pytest.mark.parametrize("indentation", [20e-9, 3e-9, 0.4e-9, -0.15e-9, -1.5e-9])
def test_harmonics_of_the_force_on_a_bare_cosine(key: str, indentation: float) -> None:
    """Against the harmonics of the models, hysteresis with its memory of contact included."""
    amplitude = 30e-9
    expected = ot.force_harmonics(
        key, amplitude=amplitude, indentation=indentation, n_max=11, **SAMPLES[key], **given(key)
    )
    f, _, _, _ = force_sums(key, amplitude - indentation, amplitude, np.zeros(5, complex))
    np.testing.assert_allclose(f, expected, rtol=0, atol=1e-8 * abs(expected).max() + 1e-24)


@pytest.mark.parametrize("key", [key for key in SAMPLES if key not in HYSTERETIC])
@pytest.mark.parametrize("indentation", [3e-9, 0.4e-9, -0.15e-9])
def test_harmonics_of_the_force_on_a_motion(key: str, indentation: float) -> None:
    """Against the quadrature in arrays, which takes the law as it is given to Python."""
    amplitude, signs = 30e-9, (-1.0) ** np.arange(2, HIGHER.size)
    g = amplitude - indentation - float((signs * HIGHER[2:].real).sum())
    expected = ot.force_harmonics(
        key,
        amplitude=amplitude,
        indentation=indentation,
        higher=HIGHER[2:],
        n_max=11,
        **SAMPLES[key],
        **given(key),
    )
    f, _, _, extras = force_sums(key, g, amplitude, HIGHER)
    np.testing.assert_allclose(f, expected, rtol=0, atol=1e-8 * abs(expected).max() + 1e-24)
    if abs(f).max() == 0.0:
        return
    # the work over a cycle is that of all harmonics
    motion = HIGHER.copy()
    motion[1] = amplitude
    n = np.arange(1, motion.size)
    lost = -math.pi * float((n * (f[n] * motion[n].conj()).imag).sum())
    assert extras[WORK] == pytest.approx(lost, rel=1e-9, abs=1e-12 * abs(f[1]) * amplitude)
    assert extras[PEAK] >= 0.0


@pytest.mark.parametrize("key", list(SAMPLES))
def test_derivatives_by_every_part_of_the_motion(key: str) -> None:
    """Finite differences of f by g, A and the real and imaginary part of b_n, jumps at levels included."""
    g, amplitude, omega = 27.2e-9, 30e-9, 2.0 * math.pi * 303e3
    orders = 3
    _, P, S, _ = force_sums(key, g, amplitude, HIGHER)
    step = 1e-14

    def difference(dg: float, dA: float, db: np.ndarray) -> np.ndarray:
        ahead = force_sums(key, g + dg, amplitude + dA, HIGHER + db)[0]
        behind = force_sums(key, g - dg, amplitude - dA, HIGHER - db)[0]
        return np.asarray((ahead - behind)[:orders] / (2.0 * step))

    scale = abs(P).max()
    half = np.array([0.5, 1.0, 1.0])
    none = np.zeros(HIGHER.size, complex)
    np.testing.assert_allclose(difference(step, 0.0, none), half * P[:orders], rtol=0, atol=2e-5 * scale)

    def predicted(m: int, phase: complex) -> np.ndarray:
        """Return the change of f_n when Re(phase exp(i m theta)) is added to the motion."""
        result = np.empty(orders, complex)
        for n in range(orders):
            near, near_v = (P[n - m], S[n - m]) if n >= m else (P[m - n].conj(), S[m - n].conj())
            turn = 1j * omega * m
            up = (near + turn * near_v) * phase
            down = (P[n + m] - turn * S[n + m]) * phase.conjugate()
            result[n] = 0.5 * half[n] * (up + down)
        return result

    np.testing.assert_allclose(difference(0.0, step, none), predicted(1, 1.0 + 0j), rtol=0, atol=2e-5 * scale)
    for m in (2, 3):
        for phase in (1.0 + 0j, 1j):
            db = none.copy()
            db[m] = step * phase
            np.testing.assert_allclose(
                difference(0.0, 0.0, db), predicted(m, phase), rtol=0, atol=2e-5 * scale
            )
