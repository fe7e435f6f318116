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
    """Return a mixture of any numbers, without bends."""
    random = np.random.default_rng(seed)
    return Mixture(
        random.standard_normal((draws, DATA)),
        random.standard_normal((draws, 3, DATA)),
        np.zeros((draws, DATA, 3, 3)),
        0.1 * random.standard_normal((draws, PROPERTIES, DATA)),
        random.standard_normal((draws, QUANTITIES, PROPERTIES)),
        20.0 + 0.3 * random.standard_normal((draws, QUANTITIES)),
        random.uniform(0.02, 0.3, (draws, QUANTITIES)),
    )


def pooled(y, mixture, place=None):
    quantiles = np.empty((len(y), mixture.base.shape[1], LEVELS.size))
    spreads = np.empty((len(y), mixture.base.shape[1]))
    pool(y, np.zeros((len(y), 3)) if place is None else place, mixture, LEVELS, quantiles, spreads)
    return quantiles, spreads


def test_quantiles_are_those_of_the_mixture_of_normals():
    mixture, random = mixture_of_numbers(1), np.random.default_rng(2)
    y, place = random.standard_normal((PIXELS, DATA)), random.standard_normal((PIXELS, 3))
    quantiles, spreads = pooled(y, mixture, place)
    rest = y[:, None] - mixture.f - np.einsum("pj,djr->pdr", place, mixture.tilt)
    theta = np.einsum("dar,pdr->pda", mixture.gain, rest)
    assert np.abs(theta).max() < 2.0  # beyond that a pixel is none of the phase
    middles = mixture.base + np.einsum("dqa,pda->pdq", mixture.along, theta)
    for i in range(PIXELS):
        for q in range(QUANTITIES):
            m, s = middles[i, :, q], mixture.spread[:, q]
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


def made_by_a_map(bend, seed=5):
    """Return pixels of known properties under a map with a bend, and the mixture that knows that map.

    Perfect data: what is left of the spread within the phase is nothing to speak of.
    """
    random = np.random.default_rng(seed)
    J = 10.0 * np.linalg.qr(random.standard_normal((DATA, 3)))[0]
    H = bend * random.standard_normal((DATA, 3, 3))
    H = H + H.transpose(0, 2, 1)
    f, theta = random.standard_normal(DATA), 0.3 * random.standard_normal((PIXELS, 3))
    y = f + theta @ J.T + 0.5 * np.einsum("rab,pa,pb->pr", H, theta, theta)
    gain = np.zeros((1, PROPERTIES, DATA))
    gain[0, :3] = np.linalg.pinv(J)
    along = np.zeros((1, 3, PROPERTIES))
    along[0, :, :3] = np.eye(3)
    mixture = Mixture(
        f[None], np.zeros((1, 3, DATA)), H[None], gain, along, np.full((1, 3), 20.0), np.full((1, 3), 1e-6)
    )
    return y, theta, mixture


def test_a_pixel_is_the_answer_where_its_data_are_perfect():
    y, theta, mixture = made_by_a_map(0.0)
    quantiles, _ = pooled(y, mixture)
    np.testing.assert_allclose(quantiles[..., 1] - 20.0, theta, atol=1e-6)


def test_a_curved_map_is_undone():
    y, theta, mixture = made_by_a_map(0.8)
    quantiles, _ = pooled(y, mixture)
    np.testing.assert_allclose(quantiles[..., 1] - 20.0, theta, atol=2e-3)
    straight, _ = pooled(y, mixture._replace(curvature=np.zeros_like(mixture.curvature)))
    assert np.abs(straight[..., 1] - 20.0 - theta).max() > 2e-2


def test_what_the_instrument_adds_per_way_is_taken_off():
    y, theta, mixture = made_by_a_map(0.0)
    tilt = np.random.default_rng(6).standard_normal((1, 3, DATA))
    place = np.random.default_rng(7).standard_normal((PIXELS, 3))
    quantiles, _ = pooled(y + np.einsum("pj,jr->pr", place, tilt[0]), mixture._replace(tilt=tilt), place)
    np.testing.assert_allclose(quantiles[..., 1] - 20.0, theta, atol=1e-6)


def test_no_pixel_is_farther_from_its_phase_than_two_in_ln():
    y, _, mixture = made_by_a_map(0.0)
    quantiles, _ = pooled(y + 1e4, mixture)
    assert np.isfinite(quantiles).all()
    assert np.abs(quantiles[..., 1] - 20.0).max() == pytest.approx(2.0, rel=1e-3, abs=0)
