"""Marginal distributions of a posterior: Gaussians between bounds, added to histograms, and quantiles of these."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from overtone.kernels import inlined, inner

_Floats = npt.NDArray[np.float64]

LEVELS = np.array([0.05, 0.5, 0.95])

_PIECES = 8  # of a Gaussian that a bound cuts
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
def spread_over(histogram: _Floats, low: float, width: float, left: float, right: float, mass: float) -> None:
    """Add a mass, even between two values, to bins that begin at ``low``."""
    last = histogram.shape[0] - 1
    x0, x1 = (left - low) / width, (right - low) / width
    k0, k1 = int(min(max(x0, 0.0), last)), int(min(max(x1, 0.0), last))
    if k0 == k1 or not x1 > x0:
        histogram[k0] += mass
        return
    even = mass / (x1 - x0)
    histogram[k0] += even * (k0 + 1 - x0)
    for k in range(k0 + 1, k1):
        histogram[k] += even
    histogram[k1] += even * (x1 - k1)


@inner
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


@inner
def smear(histogram: _Floats, sigma: float, work: _Floats) -> None:
    """Fold a histogram with a Gaussian of a width in bins."""
    reach = int(4.0 * sigma) + 1
    size = histogram.shape[0]
    for k in range(size):
        work[k] = 0.0
    norm = 0.0
    for j in range(-reach, reach + 1):
        norm += math.exp(-0.5 * (j / sigma) ** 2)
    for j in range(-reach, reach + 1):
        share = math.exp(-0.5 * (j / sigma) ** 2) / norm
        for k in range(max(0, -j), min(size, size - j)):
            work[k + j] += share * histogram[k]
    for k in range(size):
        histogram[k] = work[k]


@inlined
def _add_even(
    histogram: _Floats, low: float, width: float, left: float, right: float, logarithmic: bool, mass: float
) -> None:
    if logarithmic:
        right = max(right, 1e-300)
        left = max(left, 1e-3 * right)
        spread_over(histogram, low, width, math.log(left), math.log(right), mass)
    else:
        spread_over(histogram, low, width, left, right, mass)


@inner
def add_gaussian(
    histogram: _Floats,
    low: float,
    width: float,
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
        piece = (right - left) / _PIECES
        total = 0.0
        # relative to the largest of them: far beyond a bound all are small
        nearest = min(max(middle, left), right) - middle
        for j in range(_PIECES):
            off = left + (j + 0.5) * piece - middle
            total += math.exp(-0.5 * (off * off - nearest * nearest) / (sigma * sigma))
        for j in range(_PIECES):
            off = left + (j + 0.5) * piece - middle
            part = mass / total * math.exp(-0.5 * (off * off - nearest * nearest) / (sigma * sigma))
            _add_even(histogram, low, width, left + j * piece, left + (j + 1) * piece, logarithmic, part)
        return
    scale = max(abs(middle), 1e-300) if logarithmic else 1.0
    if sigma <= 0.3 * half or sigma <= 0.3 * width * scale:
        reach = math.sqrt(half * half + 3.0 * sigma * sigma)
        _add_even(
            histogram, low, width, max(middle - reach, least), min(middle + reach, most), logarithmic, mass
        )
        return
    # three even pieces that together have the variance and nearly the 90 % interval of a Gaussian
    wide = math.sqrt((0.65 * sigma) ** 2 + half * half)
    for way in (-1.0, 0.0, 1.0):
        there = middle + way * 1.3 * sigma
        part = mass * (0.5 if way == 0.0 else 0.25)
        _add_even(
            histogram,
            low,
            width,
            max(there - wide, least),
            max(min(there + wide, most), least),
            logarithmic,
            part,
        )
