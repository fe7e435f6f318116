"""The standard linear solid against its limits, its energy balance and a direct evaluation of Lee-Radok and Ting."""

import math
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import quad
from scipy.optimize import brentq

from overtone.contact import terms
from overtone.contact.relaxation import sls_force_history, sls_harmonics, sls_residual
from overtone.errors import ContactModelError

N_MAX = 6
SAMPLE = {
    "amplitude": 50e-9,
    "indentation": 2e-9,
    "frequency": 70e3,
    "radius": 20e-9,
    "effective_modulus": 1e9,
    "instantaneous_modulus": 3e9,
    "relaxation_time": 3e-7,
}


def contact(**changes: Any) -> dict[str, Any]:
    return {**SAMPLE, **changes}


def reduced(Delta: float, rate: float, ratio: float) -> dict[str, Any]:
    """Describe a contact by ``delta/(2 A1)``, ``1/(w tau)`` and ``E_0/E_inf``."""
    A, f, E = SAMPLE["amplitude"], SAMPLE["frequency"], SAMPLE["effective_modulus"]
    return contact(
        indentation=2.0 * A * Delta,
        relaxation_time=1.0 / (2.0 * math.pi * f * rate),
        instantaneous_modulus=E * ratio,
    )


def harmonics(case: dict[str, Any]) -> np.ndarray:
    return sls_harmonics(n_max=N_MAX, **case)


def hertz(case: dict[str, Any], modulus: float) -> np.ndarray:
    h, dh = np.empty(N_MAX + 1), np.empty(N_MAX + 1)
    A = case["amplitude"]
    terms.sphere_harmonics(A, case["indentation"] / (2.0 * A), N_MAX, h, dh)
    return 4.0 / 3.0 * modulus * math.sqrt(case["radius"]) * h


def distance(f: np.ndarray, g: np.ndarray) -> float:
    return float(abs(f - g).max() / abs(g).max())


def half_contact(case: dict[str, Any]) -> float:
    """Return the phase from the undeformed surface to the turning point."""
    return math.acos(1.0 - case["indentation"] / case["amplitude"])


def loss_of_contact(case: dict[str, Any]) -> float:
    """Return theta where the force ends, by bisection."""
    low, high = math.pi, math.pi + half_contact(case)
    for _ in range(52):
        middle = 0.5 * (low + high)
        touches = sls_force_history(phases=middle, **case) > 0.0
        low, high = (middle, high) if touches else (low, middle)
    return low


def cycle(start: float, end: float, nodes: int, layer: float) -> tuple[np.ndarray, np.ndarray]:
    """Return theta and weights over the time in contact; pieces halve after the turning point.

    Both ends are smoothed by ``theta = end -+ s^2``, ``layer`` is the phase in which stress fades.
    """
    x, w = np.polynomial.legendre.leggauss(nodes)
    edges = [0.0]
    piece = end - math.pi
    while piece > layer:
        edges.insert(1, piece)
        piece *= 0.5
    if edges[-1] == 0.0:
        edges.append(end - math.pi)
    pieces = [(start, math.pi, 1.0)] + [(math.pi + a, math.pi + b, -1.0) for a, b in pairwise(edges)]
    theta, weights = [], []
    for a, b, sign in pieces:
        reach = math.sqrt(b - a)
        s = 0.5 * reach * (1.0 + x)
        theta.append(a + s * s if sign > 0.0 else b - s * s)
        weights.append(reach * w * s)
    return np.concatenate(theta), np.concatenate(weights)


class Direct:
    """Lee-Radok and Ting as written, in seconds: quadrature of the history, root finding for Ting's condition."""

    def __init__(self, case: dict[str, Any]) -> None:
        self.A, self.w = case["amplitude"], 2.0 * math.pi * case["frequency"]
        self.E, self.E0, self.tau = (
            case["effective_modulus"],
            case["instantaneous_modulus"],
            case["relaxation_time"],
        )
        self.R = case["radius"]
        self.start = -half_contact(case) / self.w  # the turning point is at t = 0

    def depth(self, t: float) -> float:
        return self.A * (math.cos(self.w * t) - math.cos(self.w * self.start))

    def speed(self, t: float) -> float:
        return -self.A * self.w * math.sin(self.w * t)

    def modulus(self, t: float) -> float:
        return self.E + (self.E0 - self.E) * math.exp(-t / self.tau)

    def integral(self, function: Any, a: float, b: float) -> float:
        """Integrate from a to b in pieces of the relaxation time at the recent end, ``t = a + x^2``."""
        if b <= a:
            return 0.0
        cuts = [b - k * self.tau for k in (32.0, 8.0, 2.0)]
        edges = [0.0, *(math.sqrt(cut - a) for cut in cuts if a < cut < b), math.sqrt(b - a)]
        return sum(
            quad(lambda x: function(a + x * x) * 2.0 * x, c, d, epsabs=0.0, epsrel=1e-11, limit=100)[0]
            for c, d in pairwise(edges)
        )

    def ting(self, s: float, t: float) -> float:
        # the turning point apart: the integrand changes sign there
        def integrand(q: float) -> float:
            return self.modulus(t - q) * self.speed(q)

        return self.integral(integrand, s, 0.0) + self.integral(integrand, 0.0, t)

    def end(self) -> float:
        return float(brentq(lambda t: self.ting(self.start, t), 1e-6 * -self.start, -self.start, xtol=1e-24))

    def force(self, t: float) -> float:
        s = t
        if t > 0.0:
            if self.ting(self.start, t) <= 0.0:
                return 0.0
            s = float(brentq(lambda q: self.ting(q, t), self.start, 0.0, xtol=1e-24, rtol=1e-13))

        def integrand(q: float) -> float:
            return self.modulus(t - q) * 1.5 * math.sqrt(max(0.0, self.depth(q))) * self.speed(q)

        return 4.0 / 3.0 * math.sqrt(self.R) * self.integral(integrand, self.start, s)


# Delta, 1/(w tau), E_0/E_inf
CASES = [(0.01, 8.0, 3.0), (0.02, 0.7, 2.0), (0.3, 2.0, 10.0), (0.8, 1.0, 1.5)]


@pytest.mark.filterwarnings("ignore::scipy.integrate.IntegrationWarning")
@pytest.mark.parametrize("values", CASES)
def test_force_is_that_of_lee_radok_and_ting(values: tuple[float, float, float]) -> None:
    case = reduced(*values)
    direct = Direct(case)
    reach = half_contact(case)
    psi = np.concatenate([np.linspace(-1.05, 1.05, 15) * reach, [1e-3 * reach]])
    expected = np.array([direct.force(p / direct.w) if abs(p) < reach else 0.0 for p in psi])
    force = sls_force_history(phases=math.pi + psi, **case)
    np.testing.assert_allclose(force, expected, rtol=0.0, atol=1e-9 * expected.max())
    assert loss_of_contact(case) - math.pi == pytest.approx(direct.w * direct.end(), rel=1e-9, abs=0)


@pytest.mark.filterwarnings("ignore::scipy.integrate.IntegrationWarning")
@pytest.mark.parametrize("values", [CASES[1], CASES[2]])
def test_harmonics_are_those_of_lee_radok_and_ting(values: tuple[float, float, float]) -> None:
    case = reduced(*values)
    direct = Direct(case)
    theta, weights = cycle(
        math.pi - half_contact(case), math.pi + direct.w * direct.end(), 14, half_contact(case)
    )
    force = np.array([direct.force((angle - math.pi) / direct.w) for angle in theta])
    n = np.arange(N_MAX + 1)[:, None]
    expected = (force * weights * np.exp(-1j * n * theta)).sum(axis=1) / math.pi
    expected[0] *= 0.5
    assert distance(harmonics(case), expected) < 1e-7


def springs(
    Delta: float, rate: float, ratio: float, cycles: int
) -> tuple[np.ndarray, np.ndarray, float, int]:
    """Step through taps on independent viscoelastic springs, to which a half-space reduces for round contacts.

    Spring x touches where its surface meets ``delta - x^2/R`` and lets go where its stress would pull; F is the
    sum over the springs (Popov and Hess, Method of Dimensionality Reduction, 2015). Nothing of Ting is in it.
    Returns psi and force of the first tap, the dent before the last, and how often a spring was touched in one.
    """
    steps, count = 4000, 400
    c1 = 2.0 * math.asin(math.sqrt(Delta))
    edge = math.sqrt(2.0 * Delta)
    x = edge * (np.arange(count) + 0.5) / count
    h = 2.0 * math.pi / steps
    decay = math.exp(-rate * h)
    u, z, held = np.zeros(count), np.zeros(count), np.zeros(count, dtype=bool)
    psi = -c1 + h * np.arange(1, steps + 1)
    force, touched, dent = np.zeros(steps), np.zeros(count, dtype=int), 0.0
    for tap in range(cycles):
        dent = float(u[0])
        for i, angle in enumerate(psi):
            wanted = math.cos(angle) - math.cos(c1) - x * x
            # stress u + (ratio - 1) z with z' = u' - rate z; free where it vanishes
            free = u * math.exp(-rate / ratio * h)
            stress = wanted + (ratio - 1.0) * (z * decay + (wanted - u) * math.exp(-0.5 * rate * h))
            now = np.where(held, stress > 0.0, wanted > free)
            z = np.where(now, (stress - wanted) / (ratio - 1.0), -free / (ratio - 1.0))
            u = np.where(now, wanted, free)
            if tap == 0:
                touched += now & ~held
                force[i] = 2.0 * edge / count * np.sum(stress[now])
            held = now
    return psi, force, dent, int(touched.max())


@pytest.mark.parametrize("values", [(0.1, 1.0, 3.0), (0.85, 0.3, 4.0)])
def test_force_is_that_of_independent_springs(values: tuple[float, float, float]) -> None:
    psi, force, _, touched = springs(*values, cycles=1)
    case = reduced(*values)
    scale = case["effective_modulus"] * math.sqrt(case["radius"]) * case["amplitude"] ** 1.5
    expected = sls_force_history(phases=math.pi + psi, **case) / scale
    assert touched == 1
    np.testing.assert_allclose(force, expected, rtol=0.0, atol=1e-5 * expected.max())


def test_dents_of_many_taps_are_estimated() -> None:
    _, _, dent, _ = springs(0.3, 2.0, 3.0, cycles=4)
    case = reduced(0.3, 2.0, 3.0)
    assert dent * case["amplitude"] == pytest.approx(float(sls_residual(**case)), rel=0.03, abs=0)


@settings(max_examples=40, deadline=None)
@given(
    log_Delta=st.floats(-4.0, -0.01),
    log_rate=st.floats(-3.0, 3.0),
    log_ratio=st.floats(0.001, 2.0),
)
def test_harmonics_are_coefficients_of_the_force_and_hold_the_energy(
    log_Delta: float, log_rate: float, log_ratio: float
) -> None:
    case = reduced(10.0**log_Delta, 10.0**log_rate, 10.0**log_ratio)
    start, end = math.pi - half_contact(case), loss_of_contact(case)
    assert math.pi < end < math.pi + half_contact(case)
    theta, weights = cycle(start, end, 60, 10.0**-log_rate)
    force = sls_force_history(phases=theta, **case)
    assert (force >= 0.0).all()
    n = np.arange(N_MAX + 1)[:, None]
    expected = (force * weights * np.exp(-1j * n * theta)).sum(axis=1) / math.pi
    expected[0] *= 0.5
    f = harmonics(case)
    assert f[0].imag == 0.0
    assert distance(f, expected) < 1e-8
    # what the tip loses is minus the work of the force on it, int F dd
    work = (force * weights * -case["amplitude"] * np.sin(theta)).sum()
    lost = -math.pi * case["amplitude"] * f[1].imag
    assert lost == pytest.approx(-work, abs=1e-8 * case["amplitude"] * abs(f[1]))
    assert lost > 0.0


@pytest.mark.parametrize("Delta", [1e-3, 0.02, 0.6])
def test_ladders_to_hertz(Delta: float) -> None:
    """Each rung is a tenth of the one before, in the harmonics and in the energy lost."""
    soft, hard = SAMPLE["effective_modulus"], SAMPLE["instantaneous_modulus"]
    fast = [reduced(Delta, 10.0**k, hard / soft) for k in range(4, 9)]
    slow = [reduced(Delta, 10.0**-k, hard / soft) for k in range(2, 7)]
    equal = [reduced(Delta, 5.0, 1.0 + 10.0**-k) for k in range(2, 7)]
    for ladder, modulus in ((fast, soft), (slow, hard), (equal, soft)):
        found = [harmonics(case) for case in ladder]
        limit = hertz(ladder[0], modulus)
        errors = [distance(f, limit) for f in found]
        losses = [-f[1].imag for f in found]
        assert errors[-1] < 1e-4
        for values in (errors, losses):
            np.testing.assert_allclose(np.array(values[1:]) / values[:-1], 0.1, rtol=0.2)


def test_equal_moduli_are_hertz() -> None:
    f = harmonics(contact(instantaneous_modulus=1e9))
    assert distance(f, hertz(SAMPLE, 1e9)) < 1e-13
    assert abs(f.imag).max() < 1e-15 * abs(f).max()


def test_fast_relaxation_is_the_kelvin_voigt_contact() -> None:
    """To first order the history is a viscosity: ``DISS_n = -n w tau (E_0/E_inf - 1) CONS_n``."""
    case = reduced(0.05, 1e6, 4.0)
    n = np.arange(1, N_MAX + 1)
    f = harmonics(case)[1:]
    np.testing.assert_allclose(-f.imag / f.real, -n * 1e-6 * 3.0, rtol=1e-4)


def test_loss_peaks_between_the_limits() -> None:
    losses = -sls_harmonics(**contact(relaxation_time=np.logspace(-10, -3, 29)), n_max=1)[:, 1].imag
    top = int(losses.argmax())
    assert 0 < top < 28
    assert (np.diff(losses[: top + 1]) > 0.0).all()
    assert (np.diff(losses[top:]) < 0.0).all()


@pytest.mark.parametrize("values", CASES)
def test_force_is_continuous_at_the_turning_point_and_at_the_ends(
    values: tuple[float, float, float],
) -> None:
    case = reduced(*values)
    top = float(sls_force_history(phases=math.pi, **case))
    steps = 10.0 ** -np.arange(3.0, 9.0)
    for side in (-1.0, 1.0):
        gaps = abs(sls_force_history(phases=math.pi + side * steps, **case) / top - 1.0)
        assert (np.diff(gaps) < 0.0).all()
        assert gaps[-1] < 1e-6
    start, end = math.pi - half_contact(case), loss_of_contact(case)
    assert sls_force_history(phases=[start + 1e-7, end - 1e-7], **case) == pytest.approx(
        [0.0, 0.0], abs=1e-7 * top
    )
    assert (
        sls_force_history(phases=np.linspace(end + 1e-7, 2.0 * math.pi + start - 1e-7, 50), **case) == 0
    ).all()


def test_dent_closes_with_the_creep_time() -> None:
    """After loss the stress-free surface keeps ``int E*(t - q) du = 0``; equal dents add up."""
    case = reduced(0.1, 0.3, 5.0)
    direct = Direct(case)
    end = loss_of_contact(case) / direct.w - math.pi / direct.w
    creep = 1.0 / (direct.tau * 5.0)
    depth = direct.depth(end)

    def after(q: float) -> float:
        return -depth * creep * math.exp(-creep * (q - end))

    t = direct.start + 2.0 * math.pi / direct.w
    stress = sum(
        quad(lambda q, u=rate: direct.modulus(t - q) * u(q), a, b, epsabs=0, epsrel=1e-10)[0]
        for rate, a, b in ((direct.speed, direct.start, 0.0), (direct.speed, 0.0, end), (after, end, t))
    )
    assert abs(stress) < 1e-8 * direct.E0 * direct.depth(0.0)
    once = depth * math.exp(-creep * (t - end))
    dents = sum(once * math.exp(-k * 2.0 * math.pi / direct.w * creep) for k in range(400))
    assert float(sls_residual(**case)) == pytest.approx(dents, rel=1e-9, abs=0)
    assert float(sls_residual(**reduced(0.1, 300.0, 5.0))) < 1e-12 * case["indentation"]


def test_no_contact_gives_no_force() -> None:
    case = contact(indentation=[-5e-9, 0.0, 2e-9])
    assert (abs(harmonics(case)) > 0).any(axis=1).tolist() == [False, False, True]
    assert (sls_force_history(phases=[math.pi], **case) > 0)[:, 0].tolist() == [False, False, True]
    assert (sls_residual(**case) > 0).tolist() == [False, False, True]


def test_parameters_broadcast() -> None:
    case = contact(indentation=np.array([[1e-9], [2e-9]]), relaxation_time=np.array([1e-7, 3e-7, 1e-6]))
    f = harmonics(case)
    assert f.shape == (2, 3, N_MAX + 1)
    np.testing.assert_array_equal(f[1, 1], harmonics(SAMPLE))
    phases = np.linspace(0.0, 6.0, 10).reshape(2, 5)
    force = sls_force_history(phases=phases, **case)
    assert force.shape == (2, 3, 2, 5)
    np.testing.assert_array_equal(force[1, 1], sls_force_history(phases=phases, **SAMPLE))
    np.testing.assert_array_equal(sls_harmonics(n_max=0, **case), f[..., :1])
    assert sls_residual(**case).shape == (2, 3)


def test_scales() -> None:
    """Force is linear in the moduli and in sqrt(R), and knows time only as the product of f and tau."""
    f = harmonics(SAMPLE)
    other = contact(
        radius=80e-9,
        effective_modulus=5e6,
        instantaneous_modulus=15e6,
        frequency=700.0,
        relaxation_time=3e-5,
    )
    np.testing.assert_allclose(harmonics(other), f * 2.0 * 5e-3, rtol=1e-12)


@pytest.mark.parametrize(
    ("changes", "word"),
    [
        ({"relaxation_time": -1e-6}, "relaxation_time"),
        ({"relaxation_time": 0.0}, "relaxation_time"),
        ({"relaxation_time": np.inf}, "relaxation_time"),
        ({"instantaneous_modulus": 0.5e9}, "instantaneous_modulus"),
        ({"effective_modulus": [1e9, np.nan]}, "effective_modulus"),
        ({"amplitude": 0.0}, "amplitude"),
        ({"frequency": np.nan}, "frequency"),
        ({"radius": -1e-9}, "radius"),
        ({"indentation": np.nan}, "indentation"),
        ({"indentation": 100e-9}, "permanent contact"),
        ({"indentation": [2e-9, 150e-9]}, "permanent contact"),
        ({"indentation": [1e-9] * 3, "radius": [1e-8] * 2}, "shapes do not fit"),
    ],
)
def test_wrong_parameters_are_named(changes: dict[str, Any], word: str) -> None:
    case = contact(**changes)
    for call in (
        lambda: sls_harmonics(n_max=2, **case),
        lambda: sls_force_history(phases=[3.0], **case),
        lambda: sls_residual(**case),
    ):
        with pytest.raises(ContactModelError, match=word):
            call()


def test_wrong_orders_and_phases_are_named() -> None:
    for n_max in (-1, 2.5):
        with pytest.raises(ContactModelError, match="n_max"):
            sls_harmonics(n_max=n_max, **SAMPLE)  # type: ignore[arg-type]
    with pytest.raises(ContactModelError, match="phases"):
        sls_force_history(phases=[3.0, np.nan], **SAMPLE)
