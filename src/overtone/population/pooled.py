"""Pixels that know of their phase: the posterior of each, with what the whole scan says of its material.

Given the median material of a phase, the spread within it and what the scan shares, a pixel is a small problem: its own
data pull its properties off the median, the spread pulls them back. About one material it was solved to all orders (see
`overtone.population.deviation`), about others what is straight of it is. Draws of what is given make a mixture of such
answers, and quantiles of that mixture are the interval of the pixel.
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
    gain: _Floats
    """(draw, property, datum): change of a property per harmonic."""
    along: _Floats
    """(draw, quantity, property): change of ln of a quantity with each property."""
    base: _Floats
    """(draw, quantity): of the median material."""
    spread: _Floats
    """(draw, quantity): standard deviation that is left."""
    centre: int
    """Draw about which pixels were solved for."""


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
    y: _Floats,
    place: _Floats,
    solved: _Floats,
    wider: _Floats,
    mixture: Mixture,
    levels: _Floats,
    quantiles: _Floats,
    spreads: _Floats,
) -> None:
    """Fill quantiles of every quantity of every pixel.

    Parameters
    ----------
    y : array (pixel, datum)
        Force harmonics at the mean amplitude of the phase [unit].
    place : array (pixel, 3)
        Height, x and y about those of the phase [m].
    solved : array (pixel, property)
        Properties about the material in the centre.
    wider : array (pixel, quantity)
        Standard deviation that is left of each quantity there, over that of the mixture.
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
    rest, theta = np.empty(data), np.empty((draws, properties))
    centre = mixture.centre
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
                theta[s, a] = value
        for a in range(properties):
            # what is not straight, about the centre, is so about the others
            bent = solved[i, a] - theta[centre, a]
            for s in range(draws):
                theta[s, a] = min(max(theta[s, a] + bent, -_FARTHEST), _FARTHEST)
        for s in range(draws):
            for q in range(quantities):
                m = mixture.base[s, q]
                for a in range(properties):
                    m += mixture.along[s, q, a] * theta[s, a]
                middles[q, s] = m
        for q in range(quantities):
            middle, factor = middles[q], wider[i, q]
            mean, square = 0.0, 0.0
            for s in range(draws):
                mean += middle[s] / draws
            for s in range(draws):
                square += ((middle[s] - mean) ** 2 + (factor * mixture.spread[s, q]) ** 2) / draws
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
                        part, rise = _below((x - middle[s]) * per_spread[q, s] / factor)
                        below += part
                        slope += rise * per_spread[q, s] / factor
                    off = below / draws - levels[level]
                    if off < 0.0:
                        low = x
                    else:
                        high = x
                    if abs(off) < _CLOSE or high - low < _CLOSE * sd:
                        break
                    x = x - off * draws / slope if slope > 0.0 else math.nan
                quantiles[i, q, level] = x
