"""What varies smoothly within one phase, and whether it looks like more than one material all the same."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from overtone.population.divide import TILE, averaged, odd_tiles
from overtone.population.mixture import clouds_along, density_along

_Floats = npt.NDArray[np.float64]
_Mask = npt.NDArray[np.bool_]

_FULL = 0.25  # share of the pixels of a tile that must be of the phase
_FEWEST_TILES = 12
_CLOUDS = (2, 3)
_SAMPLE = 4000
_BY_CHANCE = 3.0  # in ln of the density of all: numbers that a second cloud adds


class Coherence(NamedTuple):
    """What neighbours of a phase have in common beyond the phase itself."""

    share: float
    """Share of the variance that is smooth, in the direction where that is largest."""
    size: float
    """Standard deviation of the smooth part, in standard deviations of the noise of a pixel."""
    trend: float
    """Share of the smooth part that is one even surface across the scan, of second order."""
    gain: float
    """What several clouds gain over one in ln of the density of averages of few pixels, in tiles held out, less what
    they may gain by chance where no more tiles than there are here are independent."""


def coherence_of(z: _Floats, mask: _Mask) -> Coherence:
    """Return what varies smoothly within a phase.

    Parameters
    ----------
    z : array (y, x, feature)
        In units of the noise, 0 where it is not known.
    mask : array (y, x)
        Pixels of the phase.

    Notes
    -----
    Smooth is what tiles of 8 pixels differ by, less what their mean would scatter by if pixels were independent.
    """
    from scipy.linalg import eigh

    features = z.shape[-1]
    rows, columns = (np.arange(size) // TILE for size in mask.shape)
    tile = rows[:, None] * (int(columns[-1]) + 1) + columns
    pixels = np.bincount(tile[mask], minlength=int(tile[-1, -1]) + 1)
    inside = z[mask]
    full = pixels >= _FULL * TILE**2
    if full.sum() < _FEWEST_TILES:
        return Coherence(0.0, 0.0, 0.0, 0.0)
    sums = np.stack([np.bincount(tile[mask], inside[:, i], len(pixels)) for i in range(features)], -1)
    means, weight = sums[full] / pixels[full, None], pixels[full] / pixels[full].sum()
    about = means - weight @ means
    total = np.cov(inside.T).reshape(features, features) + 1e-9 * np.eye(features)
    between = (about * weight[:, None]).T @ about
    expected = full.sum() / pixels[full].sum()
    smooth = (between - expected * total) / (1.0 - expected)
    shares, directions = eigh(smooth, total)
    direction = directions[:, -1]
    if shares[-1] <= 0.0:
        return Coherence(0.0, 0.0, 0.0, 0.0)
    size = float(np.sqrt(direction @ smooth @ direction / (direction @ direction)))
    y, x = (place / TILE for place in np.divmod(np.flatnonzero(full), int(columns[-1]) + 1))
    place = [np.ones(len(y)), x, y, x * x, x * y, y * y]
    design = np.stack(place, -1) * np.sqrt(weight)[:, None]
    level = (about @ direction) * np.sqrt(weight)
    rest = level - design @ np.linalg.lstsq(design, level, rcond=None)[0]
    trend = 1.0 - float(rest @ rest) / float(level @ level) * (len(y) - 1.0) / (len(y) - len(place))
    gain = _gain((z @ direction)[..., None], mask) - _BY_CHANCE / len(y)
    return Coherence(min(float(shares[-1]), 1.0), size, max(trend, 0.0), gain)


def _gain(y: _Floats, mask: _Mask) -> float:
    """Return what two or three clouds gain over one, per pixel."""
    u = averaged(y, mask, 5)[0][..., 0]
    known, odd = np.isfinite(u), odd_tiles(mask.shape)
    found, held = u[known & ~odd], u[known & odd]
    if min(len(found), len(held)) < _SAMPLE // 20:
        return 0.0
    found, held = found[:: max(1, len(found) // _SAMPLE)], held[:: max(1, len(held) // _SAMPLE)]
    low, high = np.quantile(found, [0.001, 0.999])
    found, held = np.clip(found, low, high), np.clip(held, low, high)
    one, *more = (density_along(held, *clouds_along(found, count)).mean() for count in (1, *_CLOUDS))
    return float(max(more) - one)
