"""Marginal distributions of a posterior: Gaussians between bounds, added to histograms, and quantiles of these."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from overtone.kernels import inlined, inner, lean

_Floats = npt.NDArray[np.float64]

LEVELS = np.array([0.05, 0.5, 0.95])
MASS_, STEP_ = 0, 1
"""Rows of bins (2, bin): the mass of each beside what steps add, and by how much it steps up from the one before."""

_PIECES = 8  # of a Gaussian that a bound cuts
_LEAST_SHARE = 1e-3  # of the upper end of a piece, at which it ends in bins of the logarithm
_ROOT_2 = math.sqrt(2.0)


@inlined
def gauss_mass(low: float, high: float, mean: float, sigma: float) -> tuple[float, float]:
    """Return what a Gaussian has between two bounds, as a mass and an exponent that multiply: ``mass e^exponent``."""
    a, b = (low - mean) / sigma, (high - mean) / sigma
    if a > 5.0 or b < -5.0:
        far = max(a, -b)
        tail = 1.0 / (far * far)
        return 0.3989422804014327 / far * (1.0 - tail * (1.0 - 3.0 * tail)), -0.5 * far * far
    above = 0.5 * math.erfc(a / _ROOT_2) if a > -6.0 else 1.0
    beyond = 0.5 * math.erfc(b / _ROOT_2) if b < 6.0 else 0.0
    return above - beyond, 0.0


@inlined
def gauss_moments(low: float, high: float, mean: float, sigma: float) -> tuple[float, float]:
    """Return mean and spread of a Gaussian between two bounds."""
    a, b = (low - mean) / sigma, (high - mean) / sigma
    if a < -6.0 and b > 6.0:
        return mean, sigma
    if a > 5.0:
        return low + sigma / a, sigma / a
    if b < -5.0:
        return high + sigma / b, -sigma / b
    mass, _ = gauss_mass(low, high, mean, sigma)
    if not mass > 0.0:
        return 0.5 * (low + high), 0.0
    at_a = 0.3989422804014327 * math.exp(-0.5 * a * a)
    at_b = 0.3989422804014327 * math.exp(-0.5 * b * b)
    shift = (at_a - at_b) / mass
    bend = (a * at_a if at_a > 0.0 else 0.0) - (b * at_b if at_b > 0.0 else 0.0)
    variance = 1.0 + bend / mass - shift * shift
    return mean + sigma * shift, sigma * math.sqrt(max(variance, 0.0))


@inlined
def _spread_between(bins: _Floats, x0: float, x1: float, mass: float) -> None:
    """Add a mass, even between two places in units of bins."""
    last = bins.shape[1] - 1
    k0, k1 = int(min(max(x0, 0.0), last)), int(min(max(x1, 0.0), last))
    if k0 == k1 or not x1 > x0:
        bins[MASS_, k0] += mass
        return
    even = mass / (x1 - x0)
    bins[MASS_, k0] += even * (k0 + 1 - x0)
    bins[MASS_, k1] += even * (x1 - k1)
    # between them every bin gains as much: where that begins and where it ends is all that is noted
    if k1 > k0 + 1:
        bins[STEP_, k0 + 1] += even
        bins[STEP_, k1] -= even


@inlined
def spread_over(bins: _Floats, low: float, fineness: float, left: float, right: float, mass: float) -> None:
    """Add a mass, even between two values, to so many bins a unit that begin at ``low``."""
    _spread_between(bins, (left - low) * fineness, (right - low) * fineness, mass)


@inner
def sum_steps(bins: _Floats) -> _Floats:
    """Return the histogram, when all masses are in."""
    each = 0.0
    for k in range(bins.shape[1]):
        each += bins[STEP_, k]
        bins[MASS_, k] += each
    return bins[MASS_]


@lean
def fill_quantiles(histogram: _Floats, low: float, width: float, out: _Floats) -> None:
    """Fill the quantiles of a histogram."""
    total = 0.0
    for k in range(histogram.shape[0]):
        total += histogram[k]
    level, below = 0, 0.0
    for k in range(histogram.shape[0]):
        above = below + histogram[k]
        while level < LEVELS.shape[0] and above >= LEVELS[level] * total and histogram[k] > 0.0:
            out[level] = low + width * (k + (LEVELS[level] * total - below) / histogram[k])
            level += 1
        below = above


@lean
def smear(histogram: _Floats, sigma: float, work: _Floats) -> None:
    """Fold a histogram with a Gaussian of a width in bins."""
    size, reach = histogram.shape[0], int(4.0 * sigma) + 1
    # from bin to bin a Gaussian falls by a factor, and that factor by a constant one
    first, bend = math.exp(-0.5 / (sigma * sigma)), math.exp(-1.0 / (sigma * sigma))
    norm, part, fall = 1.0, 1.0, first
    for _ in range(reach):
        part *= fall
        fall *= bend
        norm += 2.0 * part
    for k in range(size):
        work[k] = histogram[k] / norm
        histogram[k] = work[k]
    part, fall = 1.0, first
    for j in range(1, min(reach + 1, size)):
        part *= fall
        fall *= bend
        for k in range(size - j):
            histogram[k] += part * work[k + j]
        for k in range(size - j):
            histogram[k + j] += part * work[k]


@inlined
def _bin_of(value: float, low: float, fineness: float, logarithmic: bool) -> float:
    """Return where a value is, in units of bins."""
    return ((math.log(value) if logarithmic else value) - low) * fineness


@inlined
def _add_even(
    bins: _Floats, low: float, fineness: float, left: float, right: float, logarithmic: bool, mass: float
) -> None:
    if logarithmic:
        right = max(right, 1e-300)
        left = max(left, _LEAST_SHARE * right)
    x0, x1 = _bin_of(left, low, fineness, logarithmic), _bin_of(right, low, fineness, logarithmic)
    _spread_between(bins, x0, x1, mass)


@inlined
def _add_pieces(
    bins: _Floats,
    low: float,
    fineness: float,
    left: float,
    right: float,
    middle: float,
    sigma: float,
    logarithmic: bool,
    mass: float,
) -> None:
    """Add a Gaussian between two values in even pieces."""
    piece = (right - left) / _PIECES
    first = left + 0.5 * piece - middle
    # relative to the largest of them: far beyond a bound all are small
    nearest = min(max(middle, left), right) - middle
    per = 0.5 / (sigma * sigma)
    height = math.exp(-per * (first * first - nearest * nearest))
    # from piece to piece a Gaussian grows by a factor, and that factor by a constant one
    growth, bend = math.exp(-per * piece * (2.0 * first + piece)), math.exp(-2.0 * per * piece * piece)
    total, h, g = 0.0, height, growth
    for _ in range(_PIECES):
        total += h
        h *= g
        g *= bend
    start = max(left, _LEAST_SHARE * (left + piece), 1e-300) if logarithmic else left
    x0, h, g = _bin_of(start, low, fineness, logarithmic), mass / total * height, growth
    for j in range(_PIECES):
        x1 = _bin_of(left + (j + 1) * piece, low, fineness, logarithmic)
        _spread_between(bins, x0, x1, h)
        x0 = x1
        h *= g
        g *= bend


@lean
def add_gaussian(
    bins: _Floats,
    low: float,
    fineness: float,
    middle: float,
    half: float,
    sigma: float,
    least: float,
    most: float,
    logarithmic: bool,
    mass: float,
) -> None:
    """Add a mass around a value: Gaussian between two bounds, and even over the cell of its node beyond that.

    With ``logarithmic`` the bins are those of the logarithm.
    """
    if middle - 4.0 * sigma < least or middle + 4.0 * sigma > most:
        left, right = max(middle - 4.0 * sigma, least), min(middle + 4.0 * sigma, most)
        if left > most - 4.0 * sigma and not left < right:
            left = max(most - 4.0 * sigma, least)
        if not left < right:  # far beyond a bound: what is left falls off within a small part of sigma
            reach = sigma * sigma / max(abs(least - middle), abs(middle - most), sigma)
            if middle < least:
                left, right = least, min(least + 3.0 * reach, most)
            else:
                left, right = max(most - 3.0 * reach, least), most
        _add_pieces(bins, low, fineness, left, right, middle, sigma, logarithmic, mass)
        return
    scale = max(abs(middle), 1e-300) if logarithmic else 1.0
    if sigma <= 0.3 * half or sigma * fineness <= 0.3 * scale:
        reach = math.sqrt(half * half + 3.0 * sigma * sigma)
        _add_even(
            bins, low, fineness, max(middle - reach, least), min(middle + reach, most), logarithmic, mass
        )
        return
    # three even pieces that together have the variance and nearly the 90 % interval of a Gaussian
    wide = math.sqrt((0.65 * sigma) ** 2 + half * half)
    for way in (-1.0, 0.0, 1.0):
        there = middle + way * 1.3 * sigma
        part = mass * (0.5 if way == 0.0 else 0.25)
        _add_even(
            bins,
            low,
            fineness,
            max(there - wide, least),
            max(min(there + wide, most), least),
            logarithmic,
            part,
        )
