"""The spread within a phase, from scatter that was simulated with a known one."""

import math

import numpy as np
import pytest

from overtone.population.spread import FACTOR, TYPICAL, spread_of

DATA, PIXELS = 7, 4000
NOISE = np.diag(np.array([3.0, 1.0, 2.0, 2.0, 1.0, 2.0, 2.0]) ** 2) + 0.2
J = np.array(
    [
        [9.0, 60.0, 0.0],
        [40.0, -80.0, 10.0],
        [-70.0, 20.0, 0.0],
        [50.0, 30.0, 5.0],
        [15.0, 10.0, 50.0],
        [-20.0, 0.0, 30.0],
        [10.0, 0.0, -20.0],
    ]
)
ALL = np.ones(3, bool)
STRAIGHT = np.zeros((DATA, 3, 3))
NOTHING = np.zeros((DATA, 0))


def scatter(spread, seed, *, slopes=J, curves=STRAIGHT, loose=None):
    """Return the covariance of the pixels of a phase whose properties scatter so much."""
    random = np.random.default_rng(seed)
    theta = np.asarray(spread) * random.standard_normal((PIXELS, 3))
    y = theta @ slopes.T + 0.5 * np.einsum("rij,pi,pj->pr", curves, theta, theta)
    y += random.multivariate_normal(np.zeros(DATA), NOISE, PIXELS)
    if loose is not None:
        y += random.standard_normal((PIXELS, 1)) @ loose.T
    return np.cov(y.T)


@pytest.mark.parametrize("truth", [(0.15, 0.3, 0.2), (0.3, 0.08, 0.5)])
def test_spreads_come_back(truth):
    found = spread_of(scatter(truth, 1), NOISE, J, STRAIGHT, ALL, PIXELS, NOTHING)
    np.testing.assert_allclose(found.value, truth, rtol=0.06)
    # neighbours are alike, so that a pixel counts for less than one: more than 1/sqrt(2 n), far less than the prior
    assert (found.error > 1.0 / math.sqrt(2.0 * PIXELS)).all()
    assert (found.error < 0.3 * math.log(FACTOR)).all()


def test_what_noise_hides_is_what_was_known_before():
    hidden = J * np.array([1.0, 1e-4, 1.0])
    found = spread_of(
        scatter((0.2, 0.9, 0.3), 2, slopes=hidden), NOISE, hidden, STRAIGHT, ALL, PIXELS, NOTHING
    )
    assert found.value[1] == pytest.approx(TYPICAL, rel=0.01, abs=0)
    assert found.error[1] == pytest.approx(math.log(FACTOR), rel=0.01, abs=0)
    np.testing.assert_allclose(found.value[[0, 2]], (0.2, 0.3), rtol=0.06)


def test_noise_alone_is_no_spread():
    found = spread_of(scatter((0.0, 0.0, 0.0), 3), NOISE, J, STRAIGHT, ALL, PIXELS, NOTHING)
    assert (found.value < 0.02).all()


def test_properties_that_the_model_lacks_have_none():
    free = np.array([True, False, True])
    found = spread_of(scatter((0.2, 0.0, 0.3), 4), NOISE, J, STRAIGHT, free, PIXELS, NOTHING)
    assert found.value[1] == found.error[1] == 0.0
    assert (found.root[1] == 0.0).all()
    assert (found.root[:, 1] == 0.0).all()
    np.testing.assert_allclose(found.value[free], (0.2, 0.3), rtol=0.06)


def test_scatter_in_a_loose_direction_says_nothing():
    loose = np.array([[30.0], [-60.0], [40.0], [10.0], [0.0], [5.0], [-20.0]])
    seen = scatter((0.15, 0.3, 0.2), 5, loose=loose)
    found = spread_of(seen, NOISE, J, STRAIGHT, ALL, PIXELS, loose)
    np.testing.assert_allclose(found.value, (0.15, 0.3, 0.2), rtol=0.08)
    # and would be taken for properties otherwise
    assert not np.allclose(
        spread_of(seen, NOISE, J, STRAIGHT, ALL, PIXELS, NOTHING).value, (0.15, 0.3, 0.2), rtol=0.3
    )


def test_the_root_is_that_of_the_covariance_of_the_errors():
    # two properties that move nearly the same harmonics: more of one is less of the other
    alike = np.column_stack([J[:, 0], J[:, 0] + 0.05 * J[:, 1], J[:, 2]])
    found = spread_of(scatter((0.2, 0.2, 0.3), 6, slopes=alike), NOISE, alike, STRAIGHT, ALL, 200, NOTHING)
    covariance = found.root @ found.root.T
    np.testing.assert_allclose(np.sqrt(np.diag(covariance)), found.error, rtol=1e-9)
    assert covariance[0, 1] < -0.3 * found.error[0] * found.error[1]
    assert np.array_equal(found.root, np.tril(found.root))


def test_squares_of_properties_are_not_taken_for_properties():
    # two properties that do nearly the same, and squares that do what they differ by
    alike = 4.0 * np.column_stack([J[:, 0], J[:, 0] + 0.1 * J[:, 1], J[:, 2]])
    curves = np.zeros((DATA, 3, 3))
    curves[:, 0, 0] = curves[:, 1, 1] = 10.0 * J[:, 1]
    truth = (0.15, 0.2, 0.1)
    seen = scatter(truth, 7, slopes=alike, curves=curves)
    found = spread_of(seen, NOISE, alike, curves, ALL, PIXELS, NOTHING)
    # slopes are believed to three per cent, of two that differ by ten
    np.testing.assert_allclose(found.value, truth, rtol=0.4)
    assert spread_of(seen, NOISE, alike, STRAIGHT, ALL, PIXELS, NOTHING).value.max() > 2.0 * max(truth)


def test_the_search_has_the_right_slope():
    # at the summit of the density a small step to either side leads down
    curves = 20.0 * np.random.default_rng(9).standard_normal((DATA, 3, 3))
    curves = curves + curves.transpose(0, 2, 1)
    truth = np.array([0.15, 0.3, 0.2])
    bent = 0.5 * np.einsum("rij,sij,i,j->rs", curves, curves, truth**2, truth**2)
    steep = np.diag((0.03 * J) ** 2 @ truth**2)
    exactly = NOISE + (J * truth**2) @ J.T + bent + steep
    found = spread_of(exactly, NOISE, J, curves, ALL, 10**7, NOTHING)
    np.testing.assert_allclose(found.value, truth, rtol=1e-3)
