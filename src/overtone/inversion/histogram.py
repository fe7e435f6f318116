"""Marginal distributions of a posterior: Gaussians between bounds, added to histograms, and quantiles of these."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from overtone.kernels import inlined, inner, lean

_Floats = npt.NDArray[np.float64]

LEVELS = np.array([0.05, 0.5, 0.95])
MASS_, STEP_, BEND_ = 0, 1, 2
"""Rows of bins (3, bin): the mass of each beside what steps add, by how much it steps up from the one before, and by
how much these steps grow."""

_PIECES = 6  # of a Gaussian that a bound cuts
_FAR = 3.3  # of them, beyond which nothing of one that is cut counts
_OCTAVES = (
    4  # in which the piece next to zero is told apart in bins of the logarithm: all but a sixteenth of it
)
_LEAST_SHARE = 1e-3  # of the upper end of a piece, at which it ends in bins of the logarithm
_NARROW = (
    4.0  # bins on each side of a triangle; of narrower ones the shape is not seen, and bins would not add up
)
_ROOT_2, _LOG_2 = math.sqrt(2.0), math.log(2.0)
_STRAIGHT = 0.3  # of a value, over which its logarithm is nearly a straight line
_SPAN = math.sqrt(
    6.0
)  # half of the base of a triangle of standard deviation 1; nearer to a bound a Gaussian is cut
_LEAN = 0.2  # of its relative size, by which a triangle of a logarithm is longer below its summit than above
_REACH, _FINENESS = 6.0, 256
_ABOVE = np.array(
    [0.5 * math.erfc((k / _FINENESS - _REACH) / math.sqrt(2.0)) for k in range(2 * 6 * 256 + 2)]
)
_CLOSE = 2.0  # standard deviations between two bounds, below which no table will do
_ALIKE = 1.0  # of its standard deviation, over which the middles of Gaussians reach that are added as one


class Group(NamedTuple):
    """Gaussians whose middles are so near each other that one stands for all of them."""

    mass: float
    first: float
    """Middle of the first, from which others are counted."""
    sum: float
    """Of mass times middle, of that squared, of variance and half of a cell."""
    square: float
    variance: float
    half: float
    limit: float
    """The least upper bound, and"""
    top: float
    """how far up any of them reaches."""
    reach: float
    """How far from the first a middle may lie."""


EMPTY = Group(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
"""A group without members."""


@inlined
def _above(x: float) -> float:
    """Return what a normal distribution has above a value between -6 and 6; to 1e-6, and to 1e-4 of it."""
    place = (x + _REACH) * _FINENESS
    k = int(place)
    return _ABOVE[k] + (place - k) * (_ABOVE[k + 1] - _ABOVE[k])


@inlined
def gauss_mass(low: float, high: float, mean: float, sigma: float) -> tuple[float, float]:
    """Return what a Gaussian has between two bounds, as a mass and an exponent that multiply: ``mass e^exponent``."""
    a, b = (low - mean) / sigma, (high - mean) / sigma
    if a > 5.0 or b < -5.0:
        far = max(a, -b)
        tail = 1.0 / (far * far)
        return 0.3989422804014327 / far * (1.0 - tail * (1.0 - 3.0 * tail)), -0.5 * far * far
    if b - a < _CLOSE:  # the difference of what is nearly the same
        return 0.5 * (math.erfc(a / _ROOT_2) - math.erfc(b / _ROOT_2)), 0.0
    return (_above(a) if a > -_REACH else 1.0) - (_above(b) if b < _REACH else 0.0), 0.0


@inlined
def gauss_between(low: float, high: float, mean: float, sigma: float) -> tuple[float, float, float, float]:
    """Return mass and exponent of `gauss_mass`, with mean and spread of the Gaussian between the bounds."""
    a, b = (low - mean) / sigma, (high - mean) / sigma
    if a < -_REACH and b > _REACH:
        return 1.0, 0.0, mean, sigma
    mass, more = gauss_mass(low, high, mean, sigma)
    if a > 5.0:
        return mass, more, low + sigma / a, sigma / a
    if b < -5.0:
        return mass, more, high + sigma / b, -sigma / b
    if not mass > 0.0:
        return mass, more, 0.5 * (low + high), 0.0
    at_a = 0.3989422804014327 * math.exp(-0.5 * a * a) if a > -_REACH else 0.0
    at_b = 0.3989422804014327 * math.exp(-0.5 * b * b) if b < _REACH else 0.0
    shift = (at_a - at_b) / mass
    bend = (a * at_a if at_a > 0.0 else 0.0) - (b * at_b if at_b > 0.0 else 0.0)
    variance = 1.0 + bend / mass - shift * shift
    return mass, more, mean + sigma * shift, sigma * math.sqrt(max(variance, 0.0))


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
    if not math.isfinite(left + right):
        return
    _spread_between(bins, (left - low) * fineness, (right - low) * fineness, mass)


@inlined
def _bend_at(bins: _Floats, x: float, by: float) -> None:
    """Let the slope of the mass grow at a place in units of bins."""
    # masses are those about the middle of a bin
    k = int(x - 0.5)
    share = x - 0.5 - k
    bins[BEND_, k] += by * (1.0 - share)
    bins[BEND_, k + 1] += by * share


@inner
def sum_steps(bins: _Floats) -> _Floats:
    """Return the histogram, when all masses are in."""
    each, slope = 0.0, 0.0
    for k in range(bins.shape[1]):
        each += bins[STEP_, k] + slope
        slope += bins[BEND_, k]
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
    h, g = mass / total * height, growth
    x0 = _bin_of(max(left, 1e-300), low, fineness, True) if logarithmic else (left - low) * fineness
    first_piece = 0
    if logarithmic and left < 0.25 * (left + piece):
        # even between zero and its end: half of it in the last octave, half of the rest in the one before
        x0 = _bin_of(left + piece, low, fineness, True)
        rest, x1 = h, x0
        for _ in range(_OCTAVES):
            rest *= 0.5
            _spread_between(bins, x1 - _LOG_2 * fineness, x1, rest)
            x1 -= _LOG_2 * fineness
        _spread_between(bins, x1 - _LOG_2 * fineness, x1, rest)
        h *= g
        g *= bend
        first_piece = 1
    for j in range(first_piece, _PIECES):
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
    """Add a mass around a value: Gaussian between two bounds, folded with the cell of its node where none cuts it.

    With ``logarithmic`` the bins are those of the logarithm.
    """
    if not math.isfinite(middle + half + sigma):
        return
    if middle - _SPAN * sigma < least or middle + _SPAN * sigma > most:
        left, right = max(middle - _FAR * sigma, least), min(middle + _FAR * sigma, most)
        # the farther a bound is beyond the middle, the faster falls off what it leaves: to half a per cent of it
        if middle < least:
            left, right = least, min(least + 6.5 * sigma / ((least - middle) / sigma + 1.9), most)
        elif middle > most:
            left, right = max(most - 6.5 * sigma / ((middle - most) / sigma + 1.9), least), most
        _add_pieces(bins, low, fineness, left, right, middle, sigma, logarithmic, mass)
        return
    scale = max(abs(middle), 1e-300) if logarithmic else 1.0
    if sigma <= 0.3 * half or sigma * fineness <= 0.3 * scale:
        reach = math.sqrt(half * half + 3.0 * sigma * sigma)
        _add_even(
            bins, low, fineness, max(middle - reach, least), min(middle + reach, most), logarithmic, mass
        )
        return
    span = _SPAN * math.sqrt(sigma * sigma + half * half / 3.0)
    if logarithmic and span > _STRAIGHT * middle:
        # three even pieces that together have the variance and nearly the 90 % interval of a Gaussian
        wide = math.sqrt((0.65 * sigma) ** 2 + half * half)
        for way in (-1.0, 0.0, 1.0):
            there = middle + way * 1.3 * sigma
            left, right = max(there - wide, least), max(min(there + wide, most), least)
            part = mass * (0.5 if way == 0.0 else 0.25)
            _add_even(bins, low, fineness, left, right, True, part)
        return
    # a triangle of the same variance, whose 90 % interval is 2 % wider
    x = _bin_of(middle, low, fineness, logarithmic)
    wide, lean = span * fineness, 0.0
    if logarithmic:
        wide, lean = wide / middle, _LEAN * span / middle
    below, above = wide * (1.0 + lean), wide * (1.0 - lean)
    inside = middle - span >= least and middle + span <= most
    if not (inside and x - below >= 1.0 and x + above <= bins.shape[1] - 2.0 and wide >= _NARROW):
        reach = math.sqrt(half * half + 3.0 * sigma * sigma)
        left, right = max(middle - reach, least), min(middle + reach, most)
        _add_even(bins, low, fineness, left, right, logarithmic, mass)
        return
    height = 2.0 * mass / (below + above)
    _bend_at(bins, x - below, height / below)
    _bend_at(bins, x, -height / below - height / above)
    _bend_at(bins, x + above, height / above)


@inlined
def joins(group: Group, middle: float, sigma: float, limit: float) -> bool:
    """Return whether a Gaussian may join a group: near it, and no upper bound cuts one of them and not the other."""
    near = abs(middle - group.first) <= min(group.reach, _ALIKE * sigma)
    uncut = max(group.top, middle + _SPAN * sigma) <= min(group.limit, limit)
    return group.mass == 0.0 or (near and (uncut or limit == group.limit))


@inlined
def joined(group: Group, middle: float, half: float, sigma: float, limit: float, mass: float) -> Group:
    """Return a group with one more Gaussian."""
    first, reach, top = group.first, group.reach, max(group.top, middle + _SPAN * sigma)
    limit = min(group.limit, limit) if group.mass > 0.0 else limit
    if group.mass == 0.0:
        first, reach, top = middle, _ALIKE * sigma, middle + _SPAN * sigma
    away = middle - first
    return Group(
        group.mass + mass,
        first,
        group.sum + mass * away,
        group.square + mass * away * away,
        group.variance + mass * sigma * sigma,
        group.half + mass * half,
        limit,
        top,
        reach,
    )


@inlined
def add_group(
    bins: _Floats, low: float, fineness: float, group: Group, least: float, logarithmic: bool
) -> None:
    """Add a group between its bounds: a Gaussian of its mean and variance."""
    if not group.mass > 0.0:
        return
    mean, per = group.sum / group.mass, 1.0 / group.mass
    sigma = math.sqrt(per * group.variance + max(per * group.square - mean * mean, 0.0))
    middle, half = group.first + mean, per * group.half
    add_gaussian(bins, low, fineness, middle, half, sigma, least, group.limit, logarithmic, group.mass)
