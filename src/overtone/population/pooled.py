"""Pixels that know of their phase: the posterior of each, with what the whole scan says of its material.

Given the median material of a phase, the spread within it and what the scan shares, a pixel is a small linear
problem: its own data pull its properties off the median, the spread pulls them back. Draws of what is given make a
mixture of such answers, and quantiles of that mixture are the interval of the pixel.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.special import ndtr

from overtone.kernels import inlined, kernel

_Floats = npt.NDArray[np.float64]

QUANTILES = (0.05, 0.5, 0.95)
_REACH, _FINENESS = 8.0, 256
_NORMAL = np.asarray(ndtr(np.arange(-_REACH * _FINENESS, _REACH * _FINENESS + 2) / _FINENESS), dtype=float)
_HALVINGS = 60
_BENDS = 3  # times that the bend is taken off
_FARTHEST = 2.0  # of ln of a property from the median of its phase
_CLOSE = 1e-4  # of the spread of a mixture


class Mixture(NamedTuple):
    """What turns the harmonics of a pixel into a mixture of its properties; draw by draw.

    Properties are ln E, ln F_ad, ln tan(delta) about those of the phase, and behind them t of each scan.
    """

    f: _Floats
    """(draw, datum): what its phase reads [unit]."""
    tilt: _Floats
    """(draw, 3, datum): and by how much more per height, x and y [unit/m]."""
    curvature: _Floats
    """(draw, datum, 3, 3): second derivatives by the first three properties [unit]."""
    gain: _Floats
    """(draw, property, datum): change of a property per harmonic."""
    along: _Floats
    """(draw, quantity, property): change of ln of a quantity with each property."""
    base: _Floats
    """(draw, quantity): of the median material."""
    spread: _Floats
    """(draw, quantity): standard deviation that is left."""


@inlined
def _below(x: float) -> tuple[float, float]:
    """Return the normal distribution, from a table, and its slope."""
    place = (x + _REACH) * _FINENESS
    if place <= 0.0:
        return 0.0, 0.0
    k = int(place)
    if k >= _NORMAL.shape[0] - 1:
        return 1.0, 0.0
    step = _NORMAL[k + 1] - _NORMAL[k]
    return _NORMAL[k] + (place - k) * step, _FINENESS * step


@kernel
def pool(
    y: _Floats, place: _Floats, mixture: Mixture, levels: _Floats, quantiles: _Floats, spreads: _Floats
) -> None:
    """Fill quantiles of every quantity of every pixel.

    Parameters
    ----------
    y : array (pixel, datum)
        Force harmonics at the mean amplitude of the phase [unit].
    place : array (pixel, 3)
        Height, x and y about those of the phase [m].
    mixture : Mixture
        Of the phase.
    levels : array (level,)
        Of the quantiles.
    quantiles : array (pixel, quantity, level)
        Filled.
    spreads : array (pixel, quantity)
        Filled: standard deviation of the mixture.
    """
    draws, data = mixture.f.shape
    quantities = mixture.base.shape[1]
    properties = mixture.gain.shape[1]
    middles, per_spread = np.empty((quantities, draws)), 1.0 / mixture.spread.T
    of_one = np.searchsorted(_NORMAL, levels) / _FINENESS - _REACH  # quantiles of a normal distribution
    rest, straight, theta = np.empty(data), np.empty(properties), np.empty(properties)
    # what the squares of the properties, and the products of two, take off each of them
    bent, products = np.zeros((draws, properties, 6)), np.empty(6)
    for s in range(draws):
        for a in range(properties):
            for r in range(data):
                pair = 0
                for b in range(3):
                    for c in range(b + 1):
                        share = 0.5 if b == c else 1.0
                        bent[s, a, pair] += share * mixture.gain[s, a, r] * mixture.curvature[s, r, b, c]
                        pair += 1
    for i in range(y.shape[0]):
        for s in range(draws):
            for r in range(data):
                off = y[i, r] - mixture.f[s, r]
                for j in range(3):
                    off -= place[i, j] * mixture.tilt[s, j, r]
                rest[r] = off
            for a in range(properties):
                value = 0.0
                for r in range(data):
                    value += mixture.gain[s, a, r] * rest[r]
                straight[a] = value
                theta[a] = min(max(value, -_FARTHEST), _FARTHEST)
            for _ in range(_BENDS):
                pair = 0
                for b in range(3):
                    for c in range(b + 1):
                        products[pair] = theta[b] * theta[c]
                        pair += 1
                for a in range(properties):
                    value = straight[a]
                    for pair in range(6):
                        value -= bent[s, a, pair] * products[pair]
                    theta[a] = min(max(value, -_FARTHEST), _FARTHEST)
            for q in range(quantities):
                m = mixture.base[s, q]
                for a in range(properties):
                    m += mixture.along[s, q, a] * theta[a]
                middles[q, s] = m
        for q in range(quantities):
            middle = middles[q]
            mean, square = 0.0, 0.0
            for s in range(draws):
                mean += middle[s] / draws
            for s in range(draws):
                square += ((middle[s] - mean) ** 2 + mixture.spread[s, q] ** 2) / draws
            sd = math.sqrt(square)
            spreads[i, q] = sd
            if not sd > 0.0:
                for level in range(levels.shape[0]):
                    quantiles[i, q, level] = mean
                continue
            for level in range(levels.shape[0]):
                low, high = mean - 6.0 * sd, mean + 6.0 * sd
                if level > 0:
                    low = quantiles[i, q, level - 1]
                # Newton's method from where a normal distribution has it, and bisection where that leads out
                x = mean + of_one[level] * sd
                for _ in range(_HALVINGS):
                    if not low < x < high:
                        x = 0.5 * (low + high)
                    below, slope = 0.0, 0.0
                    for s in range(draws):
                        part, rise = _below((x - middle[s]) * per_spread[q, s])
                        below += part
                        slope += rise * per_spread[q, s]
                    off = below / draws - levels[level]
                    if off < 0.0:
                        low = x
                    else:
                        high = x
                    if abs(off) < _CLOSE or high - low < _CLOSE * sd:
                        break
                    x = x - off * draws / slope if slope > 0.0 else math.nan
                quantiles[i, q, level] = x
