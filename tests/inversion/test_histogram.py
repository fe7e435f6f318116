"""Marginal distributions: Gaussians between bounds against SciPy, and quantiles of mixtures of them."""

import math

import numpy as np
import pytest
from scipy.optimize import brentq
from scipy.special import log_ndtr
from scipy.stats import norm, truncnorm

from overtone.inversion.histogram import (
    LEVELS,
    Group,
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
def quantiles_of_groups(low, high, middles, sigmas, least, most, weights, out):  # type: ignore[no-untyped-def]
    bins = np.zeros((3, BINS))
    width = (high - low) / BINS
    group, count = Group(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0), 0
    for k in range(middles.shape[0]):
        if not joins(group, middles[k], sigmas[k]):
            add_group(bins, low, 1.0 / width, group, least, False)
            group = Group(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
        count += group.mass == 0.0
        group = joined(group, middles[k], 0.0, sigmas[k], most, weights[k])
    add_group(bins, low, 1.0 / width, group, least, False)
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


@pytest.mark.parametrize("at", [-6.0, -3.0, -2.4, -1.0, 0.0, 1.0, 2.4, 3.0, 40.0])
@pytest.mark.parametrize("sigma", [0.3, 1.0])
def test_one_gaussian_cut_or_not_has_its_interval(at: float, sigma: float) -> None:
    """Ends to 3 % of the width of the interval: a triangle stands for what no bound cuts."""
    least, middle = 0.0, at * sigma
    want = exact([middle], [sigma], least, 1e3, [1.0])
    low, high = max(middle - 4.0 * sigma, least), max(middle, 0.0) + 4.0 * sigma
    got = np.empty(3)
    mass = quantiles_of(
        low, high, np.array([middle]), np.zeros(1), np.array([sigma]), least, 1e3, False, np.array([2.5]), got
    )
    assert mass == pytest.approx(2.5, rel=0.02, abs=0)
    if at > -4.0:
        assert np.abs(got - want).max() < 0.03 * (want[2] - want[0])
    assert np.all(got >= least)


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
    sigmas = np.full(60, 0.8)
    weights = np.exp(-0.5 * ((middles - 2.5) / 1.5) ** 2)
    want = exact(middles, sigmas, least, 100.0, weights)
    got = np.empty(3)
    groups = quantiles_of_groups(
        -2.7 if least < 0.0 else 0.0, 9.2, middles, sigmas, least, 100.0, weights, got
    )
    assert groups < 12
    assert np.abs(got - want).max() < 0.02 * (want[2] - want[0])
    assert quantiles_of_groups(-3.0, 9.0, middles, np.full(60, 0.05), least, 100.0, weights, got) > 50


def test_even_steps_are_exact() -> None:
    edges = np.array([[0.0, 1.0], [1.0, 4.0], [0.5, 0.5]])
    got = np.empty(3)
    of_steps(-1.0, 5.0, edges, np.array([1.0, 1.0, 0.0]), got)
    np.testing.assert_allclose(got, [0.1, 1.0, 3.7], atol=0.04)
