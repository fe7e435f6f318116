"""Marginal distributions: Gaussians between bounds against SciPy, and quantiles of mixtures of them."""

import math

import numpy as np
import pytest
from scipy.optimize import brentq
from scipy.special import log_ndtr
from scipy.stats import norm, truncnorm

from overtone.inversion.histogram import (
    EMPTY,
    LEVELS,
    add_gaussian,
    add_group,
    fill_quantiles,
    gauss_between,
    joined,
    joins,
    spread_over,
    sum_steps,
)
from overtone.kernels import kernel

BINS = 160


@kernel
def between(low, high, mean, sigma):  # type: ignore[no-untyped-def]
    return gauss_between(low, high, mean, sigma)


@kernel
def quantiles_of(low, high, middles, halves, sigmas, least, most, logarithmic, weights, out):  # type: ignore[no-untyped-def]
    bins = np.zeros((3, BINS))
    width = (high - low) / BINS
    for k in range(middles.shape[0]):
        add_gaussian(
            bins, low, 1.0 / width, middles[k], halves[k], sigmas[k], least, most, logarithmic, weights[k]
        )
    histogram = sum_steps(bins)
    fill_quantiles(histogram, low, width, out)
    return histogram.sum()


@kernel
def quantiles_of_groups(low, high, middles, sigmas, least, limits, logarithmic, weights, out):  # type: ignore[no-untyped-def]
    bins = np.zeros((3, BINS))
    width = (high - low) / BINS
    group, count = EMPTY, 0
    for k in range(middles.shape[0]):
        if not joins(group, middles[k], sigmas[k], limits[k]):
            add_group(bins, low, 1.0 / width, group, least, logarithmic)
            group = EMPTY
        count += group.mass == 0.0
        group = joined(group, middles[k], 0.0, sigmas[k], limits[k], weights[k])
    add_group(bins, low, 1.0 / width, group, least, logarithmic)
    fill_quantiles(sum_steps(bins), low, width, out)
    return count


@kernel
def of_steps(low, high, edges, weights, out):  # type: ignore[no-untyped-def]
    bins = np.zeros((3, BINS))
    width = (high - low) / BINS
    for k in range(weights.shape[0]):
        spread_over(bins, low, 1.0 / width, edges[k, 0], edges[k, 1], weights[k])
    fill_quantiles(sum_steps(bins), low, width, out)


def exact(middles, sigmas, least, most, weights):  # type: ignore[no-untyped-def]
    """Quantiles of a mixture of Gaussians between bounds."""
    parts = [truncnorm((least - m) / s, (most - m) / s, m, s) for m, s in zip(middles, sigmas, strict=True)]
    weights = np.asarray(weights) / np.sum(weights)

    def off(x: float, level: float) -> float:
        return sum(w * p.cdf(x) for w, p in zip(weights, parts, strict=True)) - level

    low, high = min(p.ppf(1e-9) for p in parts), max(p.ppf(1.0 - 1e-9) for p in parts)
    return np.array([brentq(off, low, high, args=(level,)) for level in LEVELS])


@pytest.mark.parametrize("mean", [-12.0, -4.9, -1.0, 0.3, 2.0, 7.0, 11.0])
@pytest.mark.parametrize("sigma", [0.2, 1.0, 30.0])
def test_a_gaussian_between_bounds(mean: float, sigma: float) -> None:
    low, high = 0.0, 3.0
    mass, more, middle, spread = between(low, high, mean, sigma)
    a, b = (low - mean) / sigma, (high - mean) / sigma
    # both sides of what is far away differ by little: their logarithms do not
    near, far = (a, b) if a > -b else (-b, -a)
    log_mass = log_ndtr(-near) + math.log1p(-math.exp(log_ndtr(-far) - log_ndtr(-near)))
    assert math.log(mass) + more == pytest.approx(log_mass, abs=2e-3)
    want = truncnorm(a, b, mean, sigma)
    # in the far tail a decay of one length stands for it
    accuracy = 2e-3 if max(a, -b) < 4.0 else 0.15
    assert middle == pytest.approx(want.mean(), abs=accuracy * want.std())
    assert spread == pytest.approx(want.std(), rel=accuracy, abs=0)


@pytest.mark.parametrize("at", [-6.0, -3.0, -2.4, -1.0, 0.0, 1.0, 2.0, 2.4, 2.5, 3.0, 40.0])
@pytest.mark.parametrize("upper", [False, True], ids=["lower", "upper"])
def test_one_gaussian_cut_or_not_has_its_interval(at: float, upper: bool) -> None:
    """Ends to 4 % of the width of the interval, beside either bound; a triangle stands for what none cuts."""
    least, middle, sigma = 0.0, 0.3 * at, 0.3
    want = exact([middle], [sigma], least, 1e3, [1.0])
    low, high = max(middle - 4.0 * sigma, least), max(middle, 0.0) + 4.0 * sigma
    bounds = least, 1e3
    if upper:
        middle, low, high, bounds = -middle, -high, -low, (-1e3, least)
    got = np.empty(3)
    one = np.array([middle]), np.zeros(1), np.array([sigma])
    mass = quantiles_of(low, high, *one, *bounds, False, np.array([2.5]), got)
    assert mass == pytest.approx(2.5, rel=0.02, abs=0)
    if upper:
        got = -got[::-1]
    assert np.abs(got - want).max() < 0.04 * (want[2] - want[0])


@pytest.mark.parametrize("at", [0.5, 2.0, 3.0, 5.0, 8.5, 12.0, 20.0, 60.0])
def test_one_gaussian_in_bins_of_the_logarithm(at: float) -> None:
    want = exact([at], [1.0], 0.0, 1e3, [1.0])
    low, high = math.log(max(at - 4.0, 1e-3 * (at + 4.0))), math.log(at + 4.0)
    got = np.empty(3)
    mass = quantiles_of(
        low, high, np.array([at]), np.zeros(1), np.ones(1), 0.0, 1e3, True, np.array([2.5]), got
    )
    assert mass == pytest.approx(2.5, rel=0.02, abs=0)
    assert np.abs(np.exp(got) - want).max() < 0.05 * (want[2] - want[0])


@pytest.mark.parametrize("half", [0.0, 1.0, 2.0])
@pytest.mark.parametrize("logarithmic", [False, True], ids=["even", "logarithm"])
def test_nothing_lies_beyond_a_bound(half: float, logarithmic: bool) -> None:
    """However wide its cell is, and however far the bins reach."""
    got = np.empty(3)
    for most in (21.0, 22.5, 23.0, 24.0):
        low, high = (math.log(10.0), math.log(40.0)) if logarithmic else (10.0, 40.0)
        one = np.array([20.0]), np.array([half]), np.ones(1)
        quantiles_of(low, high, *one, 0.0, most, logarithmic, np.ones(1), got)
        assert (np.exp(got[2]) if logarithmic else got[2]) < most * 1.01


def test_what_is_no_number_is_not_added() -> None:
    """And writes nowhere: every index would be wrong."""
    got = np.empty(3)
    middles = np.array([1.0, math.nan, math.inf])
    args = np.zeros(3), np.full(3, 0.3), 0.0, 10.0, False, np.ones(3), got
    assert quantiles_of(-1.0, 3.0, middles, *args) == pytest.approx(1.0, rel=0.02)
    assert got[1] == pytest.approx(1.0, abs=0.02)


@pytest.mark.parametrize("logarithmic", [False, True], ids=["even", "logarithm"])
@pytest.mark.parametrize("seed", range(8))
def test_mixtures_have_their_quantiles(seed: int, logarithmic: bool) -> None:
    rng = np.random.default_rng(seed)
    count = 150
    middles = np.sort(rng.lognormal(0.5, 0.5, count))
    sigmas = rng.uniform(0.05, 0.4, count) * (1.0 if seed % 2 else 3.0)
    weights = rng.uniform(0.2, 1.0, count)
    want = exact(middles, sigmas, 0.0, 50.0, weights)
    high = (middles + 4.0 * sigmas).max()
    low = math.log(1e-6 * high) if logarithmic else 0.0
    high = math.log(high) if logarithmic else high
    got = np.empty(3)
    mass = quantiles_of(low, high, middles, np.zeros(count), sigmas, 0.0, 50.0, logarithmic, weights, got)
    assert mass == pytest.approx(weights.sum(), rel=2e-3, abs=0)
    if logarithmic:
        got = np.exp(got)
    assert np.abs(got - want).max() < 0.02 * (want[2] - want[0])


def test_cells_of_nodes_widen_a_gaussian() -> None:
    got = np.empty(3)
    wide = math.hypot(1.0, 2.0 / math.sqrt(3.0))
    quantiles_of(-10.0, 10.0, np.zeros(1), np.full(1, 2.0), np.ones(1), -100.0, 100.0, False, np.ones(1), got)
    assert got[2] == pytest.approx(norm.ppf(0.95) * wide, rel=0.03, abs=0)
    assert got[1] == pytest.approx(0.0, abs=0.01)


@pytest.mark.parametrize("least", [-100.0, 0.0])
def test_neighbours_may_be_added_as_one(least: float) -> None:
    """Many Gaussians that overlap are few groups, with the quantiles of all of them; those apart stay apart."""
    middles = np.linspace(0.5, 6.0, 60)
    sigmas, limits = np.full(60, 0.8), np.full(60, 100.0)
    weights = np.exp(-0.5 * ((middles - 2.5) / 1.5) ** 2)
    want = exact(middles, sigmas, least, 100.0, weights)
    got = np.empty(3)
    bottom = -2.7 if least < 0.0 else 0.0
    groups = quantiles_of_groups(bottom, 9.2, middles, sigmas, least, limits, False, weights, got)
    assert groups < 12
    assert np.abs(got - want).max() < 0.02 * (want[2] - want[0])
    narrow = np.full(60, 0.05)
    assert quantiles_of_groups(-3.0, 9.0, middles, narrow, least, limits, False, weights, got) > 50


def test_what_a_bound_cuts_differently_stays_apart() -> None:
    middles, sigmas = np.linspace(1.0, 1.4, 6), np.full(6, 0.5)
    limits = np.geomspace(0.5, 4.0, 6)
    parts = [
        truncnorm(-m / s, (most - m) / s, m, s) for m, s, most in zip(middles, sigmas, limits, strict=True)
    ]
    weights = np.array([norm.cdf((most - m) / 0.5) for m, most in zip(middles, limits, strict=True)])

    def off(x: float, level: float) -> float:
        return sum(w * p.cdf(x) for w, p in zip(weights, parts, strict=True)) / weights.sum() - level

    want = np.array([brentq(off, 1e-6, 4.0, args=(level,)) for level in LEVELS])
    got = np.empty(3)
    quantiles_of_groups(0.0, 4.0, middles, sigmas, 0.0, limits, False, weights, got)
    assert np.abs(got - want).max() < 0.03 * (want[2] - want[0])


def test_even_steps_are_exact() -> None:
    """As exact as bins of the edges of the steps can be."""
    edges = np.array([[0.0, 1.5], [1.5, 4.5]])
    got = np.empty(3)
    of_steps(-1.0, 5.0, edges, np.array([1.0, 2.0]), got)
    np.testing.assert_allclose(got, [0.225, 2.25, 4.275], atol=1e-9)
