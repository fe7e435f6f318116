import math
from typing import Any

import numpy as np
import pytest
from scipy.optimize import least_squares as scipy_least_squares

from overtone.contact import terms
from overtone.inversion import least_squares
from overtone.inversion.linear import Contact, sample_modulus, stiffness
from overtone.inversion.profile import CHI2_90, modulus_range

RADIUS, POISSON, A0 = 10e-9, 0.3, 0.2e-9
LOWER, UPPER = np.log([1e4, 1e-12, 1e-12]), np.log([1e12, 1e-6, 1.0])


def contact(tail: int = terms.LINEAR_TAIL) -> Contact:
    return Contact(tail, A0, (1 - 0.09) / 130e9, 1 - POISSON**2, 4.0 / 3.0 * math.sqrt(RADIUS))


def fit(
    force: np.ndarray,
    amplitude: np.ndarray,
    orders: tuple[int, ...],
    start: Any,
    tail: int = terms.LINEAR_TAIL,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    use = slice(None) if tail else [0, 2]
    n, count = (3, len(amplitude)) if tail else (2, len(amplitude))
    x, norm, gain = np.empty((count, n)), np.empty(count), np.empty((count, 3))
    outcome = np.empty(count, np.int8)
    observed = np.ascontiguousarray(force)
    least_squares.fit_pixels(
        observed,
        np.array(orders),
        amplitude,
        contact(tail),
        LOWER[use].copy(),
        UPPER[use].copy(),
        np.log(np.array(start))[use].copy(),
        x,
        norm,
        gain,
        outcome,
    )
    return np.exp(x), norm, gain, outcome


def model(modulus: float, adhesion: float, depth: float, amplitude: float, n_max: int = 3) -> np.ndarray:
    """Return force harmonics of the model, by its terms [N]."""
    h, dh, g, dg = (np.empty(n_max + 1) for _ in range(4))
    terms.sphere_harmonics(amplitude, depth / (2 * amplitude), n_max, h, dh)
    terms.linear_adhesion_harmonics(amplitude, depth / (2 * amplitude), A0, n_max, g, dg)
    Lambda, _ = stiffness(contact(), modulus)
    return Lambda * h + adhesion * g


@pytest.mark.parametrize("start", least_squares.STARTS)
def test_fig_7_of_the_paper_from_every_documented_start(
    steady_states: list[dict[str, Any]], start: tuple[float, float, float]
) -> None:
    """Noise-free states of the exact DMT law, harmonics 0, 1, 2: the bias of the linear tail, and no other.

    Every state converges from every start.
    """
    force = np.array([row["F_eq6_nN"] for row in steady_states])[:, :3] * 1e-9
    amplitude = np.array([row["A_nm"][1] for row in steady_states]) * 1e-9
    x, norm, _, outcome = fit(force, amplitude, (0, 1, 2), start)
    assert (outcome == least_squares.CONVERGED).all()
    assert norm.max() < 1e-11
    at = [[row["setpoint_nominal"] for row in steady_states].index(s) for s in (0.2, 0.5, 0.7, 0.9)]
    np.testing.assert_allclose(x[at, 0] / 1e9, [0.961, 0.916, 0.889, 0.829], atol=1e-3)
    np.testing.assert_allclose(x[at, 1] / 1e-9, [19.5, 19.4, 19.2, 18.5], atol=0.06)


@pytest.mark.parametrize("orders", [(0, 1, 2), (1, 2, 3)])
def test_the_exact_tail_leaves_only_the_bias_of_the_bare_cosine(
    steady_states: list[dict[str, Any]], orders: tuple[int, ...]
) -> None:
    """The same states through `dmt`: what is left is eq 10, the same from either set of harmonics."""
    force = np.array([row["F_eq6_nN"] for row in steady_states])[:, list(orders)] * 1e-9
    amplitude = np.array([row["A_nm"][1] for row in steady_states]) * 1e-9
    x, _, _, outcome = fit(force, amplitude, orders, least_squares.STARTS[1], terms.VAN_DER_WAALS_TAIL)
    assert (outcome == least_squares.CONVERGED).all()
    at = [[row["setpoint_nominal"] for row in steady_states].index(s) for s in (0.2, 0.5, 0.7, 0.9)]
    np.testing.assert_allclose(x[at, 0] / 1e9, [1.063, 1.034, 1.024, 1.016], atol=2e-3)
    np.testing.assert_allclose(x[at, 1] / 1e-9, [20.3, 20.1, 20.1, 20.1], atol=0.06)


@pytest.mark.parametrize("orders", [(0, 1, 2), (1, 2, 3)])
@pytest.mark.parametrize("start", least_squares.STARTS)
def test_round_trip_recovers_the_parameters(
    orders: tuple[int, ...], start: tuple[float, float, float]
) -> None:
    """Data from the formula itself over the paper's ranges, Delta from 0.02 to 0.5, to 1e-6.

    Deeper, F_3 passes through zero, and relative residuals have minima at bounds that are no solution.
    """
    generator = np.random.default_rng(0)
    count = 300
    amplitude = generator.uniform(10e-9, 80e-9, count)
    depth = 2 * amplitude * np.exp(generator.uniform(math.log(0.02), math.log(0.5), count))
    modulus = np.exp(generator.uniform(math.log(1e7), math.log(1e10), count))
    Lambda = np.array([stiffness(contact(), E)[0] for E in modulus])
    adhesion = np.clip(Lambda * depth**1.5 * generator.uniform(0.05, 0.6, count), 1e-11, 9e-7)
    truth = np.stack([modulus, adhesion, depth], axis=1)
    force = np.array([model(*p, A)[list(orders)] for p, A in zip(truth, amplitude, strict=True)])
    x, norm, _, outcome = fit(force, amplitude, orders, start)
    same = (outcome == least_squares.CONVERGED) & (norm < 1e-10)
    # Three equations for three unknowns may have a second root; every answer solves them.
    right = np.abs(np.log(x / truth)).max(axis=1) < 1e-6
    assert same.mean() > 0.99
    assert right[same].mean() > 0.95
    again = np.array([model(*p, A)[list(orders)] for p, A in zip(x, amplitude, strict=True)])
    assert np.abs(again / force - 1)[same].max() < 1e-9


def test_scipy_from_the_answer_finds_nothing_better() -> None:
    """On noisy data the minimum is the one an independent least-squares code ends in."""
    generator = np.random.default_rng(1)
    orders, A = (0, 1, 2), 40e-9
    clean = model(0.3e9, 10e-9, 8e-9, A)[:3]
    force = clean * (1 + 0.01 * generator.standard_normal((12, 3)))
    x, norm, _, outcome = fit(force, np.full(12, A), orders, least_squares.STARTS[1])
    bounds = (LOWER, np.minimum(UPPER, [UPPER[0], UPPER[1], math.log(2 * A * least_squares.MAX_DELTA)]))
    for i in range(12):

        def residual(p: np.ndarray, i: int = i) -> np.ndarray:
            return (model(*np.exp(p), A)[:3] - force[i]) / abs(force[i])

        inside = np.clip(np.log(x[i]), bounds[0] + 1e-9, bounds[1] - 1e-9)
        other = scipy_least_squares(residual, inside, bounds=bounds, xtol=1e-15, ftol=1e-15, gtol=1e-15)
        assert norm[i] <= math.sqrt(2 * other.cost) * (1 + 1e-6) + 1e-9
    assert (outcome != least_squares.STALLED).all()


@pytest.mark.parametrize(
    ("Delta", "low", "high"),
    [(0.03, 1.6e4, 3.1e3), (0.1, 1.6e3, 280.0), (0.2, 348.0, 55.0), (0.5, 29.0, 2.5)],
)
def test_amplification_has_the_known_size(Delta: float, low: float, high: float) -> None:
    """Error of E per independent relative error of each force harmonic, F_ad/(Lambda delta^1.5) = 0.3.

    The numbers are those of a contact without attraction outside; the norm leaves a factor of 2.
    """
    A = 40e-9
    depth = 2 * A * Delta
    adhesion = 0.3 * stiffness(contact(), 1e8)[0] * depth**1.5
    for orders, expected in (((0, 1, 2), low), ((1, 2, 3), high)):
        force = model(1e8, adhesion, depth, A)[list(orders)][None]
        _, _, gain, _ = fit(force, np.array([A]), orders, (1e8, adhesion, depth))
        assert expected / 2.5 < np.linalg.norm(gain[0]) < expected * 2.5


def test_amplification_is_the_derivative_of_the_answer() -> None:
    """Nudge each harmonic by a millionth and see ln E move as the gain says."""
    A, orders = 40e-9, (0, 1, 2)
    force = model(0.3e9, 10e-9, 12e-9, A)[:3][None]
    start = (0.3e9, 10e-9, 12e-9)
    x, _, gain, _ = fit(force, np.array([A]), orders, start)
    for i in range(3):
        nudged = force.copy()
        nudged[0, i] += 1e-7 * abs(force[0, i])
        moved, _, _, _ = fit(nudged, np.array([A]), orders, start)
        assert math.log(moved[0, 0] / x[0, 0]) / 1e-7 == pytest.approx(gain[0, i], rel=1e-3, abs=0)


def test_hertz_has_two_unknowns_and_a_residual() -> None:
    A = 40e-9
    pure = model(1e9, 1e-30, 3e-9, A)[:3][None]
    x, norm, _, outcome = fit(pure, np.array([A]), (0, 1, 2), least_squares.STARTS[1], terms.NO_ADHESION)
    assert outcome[0] == least_squares.CONVERGED
    assert norm[0] < 1e-9
    np.testing.assert_allclose(x[0], [1e9, 3e-9], rtol=1e-6)
    sticky = model(1e8, 20e-9, 15e-9, A)[:3][None]
    _, norm, _, _ = fit(sticky, np.array([A]), (0, 1, 2), least_squares.STARTS[1], terms.NO_ADHESION)
    assert norm[0] > 0.05


def test_sample_modulus_inverts_stiffness() -> None:
    for modulus in (1e4, 1e8, 1e12):
        Lambda, share = stiffness(contact(), modulus)
        assert sample_modulus(contact(), Lambda) == pytest.approx(modulus, rel=1e-9, abs=0)
        step = 1e-5
        slope = (math.log(stiffness(contact(), modulus * math.exp(step))[0]) - math.log(Lambda)) / step
        assert share == pytest.approx(slope, rel=1e-4, abs=0)
    assert sample_modulus(contact(), 1e30) == math.inf


@pytest.mark.parametrize(("modulus", "adhesion", "depth"), [(94e6, 16e-9, 19.6e-9), (1.9e9, 1.9e-9, 2.7e-9)])
@pytest.mark.parametrize("orders", [(0, 1, 2), (1, 2, 3)])
def test_ranges_cover_the_truth_as_often_as_they_claim(
    modulus: float, adhesion: float, depth: float, orders: tuple[int, ...]
) -> None:
    """Gaussian noise on the force harmonics, 1500 draws: 90 % ranges hold the truth in 87 to 97 %.

    More than 90 % is due where bounds cut the noise off; a narrower range would be a false claim.
    """
    generator = np.random.default_rng(2)
    count, A = 1500, 39.5e-9
    clean = model(modulus, adhesion, depth, A)[list(orders)]
    sigma = np.array([8e-11, 4e-12, 5e-11, 1.3e-10])[list(orders)]
    force = clean + sigma * generator.standard_normal((count, 3))
    low, high = np.empty((count, 1)), np.empty((count, 1))
    whitening = np.broadcast_to(np.diag(1 / sigma), (count, 3, 3)).copy()
    modulus_range(
        force,
        whitening,
        np.array(orders),
        np.full(count, A),
        contact(),
        LOWER,
        UPPER,
        np.array([CHI2_90]),
        low,
        high,
        np.empty(count),
    )
    covered = (low[:, 0] <= math.log(modulus)) & (math.log(modulus) <= high[:, 0])
    assert 0.87 <= covered.mean() <= 0.97
