"""Pooled pixels against mixtures of normal distributions by scipy, and pixels that were made by a known map."""

import numpy as np
import pytest
from scipy.optimize import brentq
from scipy.stats import norm

from overtone.population.pooled import QUANTILES, Mixture, pool

DRAWS, DATA, PROPERTIES, QUANTITIES, PIXELS = 9, 5, 4, 3, 6
LEVELS = np.array(QUANTILES)
NOWHERE = np.zeros((PIXELS, 3))


def mixture_of_numbers(seed, draws=DRAWS):
    """Return a mixture of any numbers."""
    random = np.random.default_rng(seed)
    return Mixture(
        random.standard_normal((draws, DATA)),
        random.standard_normal((draws, 3, DATA)),
        0.1 * random.standard_normal((draws, PROPERTIES, DATA)),
        random.standard_normal((draws, QUANTITIES, PROPERTIES)),
        20.0 + 0.3 * random.standard_normal((draws, QUANTITIES)),
        random.uniform(0.02, 0.3, (draws, QUANTITIES)),
        draws // 2,
    )


def straight(y, place, mixture):
    """Return the properties about every draw (pixel, draw, property) were all of them straight."""
    rest = y[:, None] - mixture.f - np.einsum("pj,djr->pdr", place, mixture.tilt)
    return np.einsum("dar,pdr->pda", mixture.gain, rest)


def pooled(y, mixture, place=None, bent=0.0, wider=1.0):
    """Return quantiles and spreads of pixels that are bent by so much off what is straight about the centre."""
    quantiles = np.empty((len(y), mixture.base.shape[1], LEVELS.size))
    spreads = np.empty((len(y), mixture.base.shape[1]))
    place = np.zeros((len(y), 3)) if place is None else place
    solved = straight(y, place, mixture)[:, mixture.centre] + bent
    pool(y, place, solved, np.full(spreads.shape, wider), mixture, LEVELS, quantiles, spreads)
    return quantiles, spreads


@pytest.mark.parametrize(("bent", "wider"), [(0.0, 1.0), (0.2, 1.5), (-0.3, 0.4)])
def test_quantiles_are_those_of_the_mixture_of_normals(bent, wider):
    mixture, random = mixture_of_numbers(1), np.random.default_rng(2)
    y, place = random.standard_normal((PIXELS, DATA)), random.standard_normal((PIXELS, 3))
    quantiles, spreads = pooled(y, mixture, place, bent, wider)
    theta = straight(y, place, mixture) + bent
    assert np.abs(theta).max() < 2.0  # beyond that a pixel is none of the phase
    middles = mixture.base + np.einsum("dqa,pda->pdq", mixture.along, theta)
    for i in range(PIXELS):
        for q in range(QUANTITIES):
            m, s = middles[i, :, q], wider * mixture.spread[:, q]
            sd = np.sqrt((s**2).mean() + m.var())
            assert spreads[i, q] == pytest.approx(sd, rel=1e-9, abs=0)
            for level, got in zip(LEVELS, quantiles[i, q], strict=True):
                below = brentq(
                    lambda x, m=m, s=s, p=level: norm.cdf((x - m) / s).mean() - p, m.min() - 3, m.max() + 3
                )
                assert abs(got - below) < 3e-3 * sd


def test_a_phase_is_the_answer_where_a_pixel_says_nothing():
    mixture = mixture_of_numbers(3, draws=1)._replace(gain=np.zeros((1, PROPERTIES, DATA)))
    quantiles, spreads = pooled(np.random.default_rng(4).standard_normal((PIXELS, DATA)), mixture)
    want = mixture.base[0][:, None] + mixture.spread[0][:, None] * norm.ppf(LEVELS)
    np.testing.assert_allclose(
        quantiles, np.broadcast_to(want, quantiles.shape), atol=3e-3 * mixture.spread.min()
    )
    np.testing.assert_allclose(spreads, np.broadcast_to(mixture.spread, spreads.shape), rtol=1e-12)


def test_the_answer_about_the_centre_is_the_one_that_was_solved_for():
    mixture, random = mixture_of_numbers(5, draws=1), np.random.default_rng(6)
    y, place = random.standard_normal((PIXELS, DATA)), random.standard_normal((PIXELS, 3))
    solved = random.uniform(-1.5, 1.5, (PIXELS, PROPERTIES))
    quantiles, spreads = np.empty((PIXELS, QUANTITIES, 3)), np.empty((PIXELS, QUANTITIES))
    pool(y, place, solved, np.ones(spreads.shape), mixture, LEVELS, quantiles, spreads)
    want = mixture.base[0] + solved @ mixture.along[0].T
    np.testing.assert_allclose(quantiles[..., 1], want, atol=1e-3)


def test_no_pixel_is_farther_from_its_phase_than_two_in_ln():
    along = np.zeros((1, QUANTITIES, PROPERTIES))
    along[0, :, :QUANTITIES] = np.eye(QUANTITIES)
    mixture = mixture_of_numbers(7, draws=1)._replace(along=along)
    quantiles, _ = pooled(np.random.default_rng(8).standard_normal((PIXELS, DATA)) + 1e4, mixture)
    assert np.isfinite(quantiles).all()
    off = np.abs(quantiles[..., 1] - mixture.base[0])
    np.testing.assert_allclose(off, 2.0, rtol=1e-3)
