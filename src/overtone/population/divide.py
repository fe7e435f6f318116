"""Is a region of a scan two phases? Only if a valley in density and a sharp edge in space say the same.

Noise makes no coherent region, a gradient and a smoothly varying material make no sharp edge, a wide or bent cloud of
one material has no valley. What passes all three tests is a boundary between two materials.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from overtone.population.mixture import clouds_along, density_along, parts_along
from overtone.population.modes import divisions, modes_of, valleys

_Floats = npt.NDArray[np.float64]
_Mask = npt.NDArray[np.bool_]

WINDOWS = (1, 3, 5)
"""Widths of the averages in which phases are looked for [pixel]."""
TILE = 8
"""Width of the tiles [pixel], half of which find a division and half of which judge it."""
_LAG = 3  # pixels beyond which two are neighbours no more, interphases included
_COHERENT = 0.05  # least variance shared by neighbours, of that of a pixel
_DIRECTIONS = 4
_SAMPLE = 2000
_TRIED = 5
_SHALLOW = 0.6  # density in a valley that is worth a try, of that of the lower summit
_NEAR, _FAR = 2.2, 4.0  # distance to the edge of what counts as beside it [pixel]

_VALLEY_BY_LASTING = 0.6  # small regions need a deeper valley: chance makes small ones
_STRAIGHT = 0.1  # of the smaller side
_ERRORS = 1.5  # standard errors by which neighbours may be alike by chance
_FEW_PAIRS = 20
_BELOW, _OVERSHOOT = 0.13, 0.2  # of the step beside the edge: small domains have rims


class Demand(NamedTuple):
    """What a division must show."""

    valley: float
    """Density in the valley, of that of the lower summit, at most."""
    foot: float
    """What may be missing of the step beside the edge on the larger side."""
    lasting: float
    """Of the step, what must be left beyond the window that found it, at least."""
    wander: tuple[float, float]
    """What neighbours have in common beyond their phase in the larger and the smaller side, of the step, at most."""
    size: float
    """Pixels of the smaller side, of those of the smallest phase, at least."""
    width: int
    """Of the window that found it, at most: a wide one makes edges of waves."""


DEMANDS = (
    Demand(valley=0.35, foot=0.09, lasting=0.12, wander=(0.04, 0.35), size=1.0, width=5),
    Demand(valley=0.15, foot=0.1, lasting=0.2, wander=(0.12, 0.25), size=10.0, width=3),
)
"""One of them must be met: a steady material makes no edges by chance, one that wanders might."""


class Division(NamedTuple):
    """A region in two."""

    side: _Mask
    """(y, x): the smaller of the two sides."""
    other: _Mask
    """(y, x): the other one."""
    ratio: float
    """Density in the valley, of that of the lower summit."""
    to_side: _Floats
    """(y, x): distance of each pixel to the smaller side [pixel]."""
    to_other: _Floats
    """(y, x): distance of each pixel to the other side."""


def pixel_covariance(z: _Floats, mask: _Mask) -> _Floats:
    """Return the covariance of a pixel about its neighbours, from differences, with edges and outliers trimmed.

    Parameters
    ----------
    z : array (y, x, feature)
        In units of the noise: nothing varies less.
    mask : array (y, x)
        The region.
    """
    from scipy.stats import chi2

    across, down = mask[:, 1:] & mask[:, :-1], mask[1:] & mask[:-1]
    d = np.concatenate([(z[:, 1:] - z[:, :-1])[across], (z[1:] - z[:-1])[down]])
    features = z.shape[-1]
    if len(d) < 4 * features:
        return np.eye(features)
    d = d[:: max(1, len(d) // 20000)]
    covariance = d.T @ d / len(d)
    kept = 0.8
    limit = chi2.ppf(kept, features)
    consistent = kept / chi2.cdf(limit, features + 2)
    for _ in range(6):
        covariance += np.eye(features) * 1e-6
        square = np.einsum("ij,ij->i", d @ np.linalg.inv(covariance), d)
        inner = d[square <= np.quantile(square, kept)]
        covariance = inner.T @ inner / len(inner) * consistent
    values, vectors = np.linalg.eigh(covariance / 2.0)
    return np.asarray((vectors * np.maximum(values, 1.0)) @ vectors.T)


def coherent_directions(z: _Floats, mask: _Mask) -> tuple[_Floats, _Floats]:
    """Return the directions in which neighbours are alike, and how much.

    Parameters
    ----------
    z : array (y, x, feature)
        In units of the noise, 0 where it is not known.
    mask : array (y, x)
        The region.

    Returns
    -------
    directions : array (feature, direction)
        Projected on one, a pixel has variance 1 about its neighbours; none where neighbours are not alike.
    strength : array (direction,)
        Covariance of pixels a few pixels apart, in that unit.
    """
    from scipy.linalg import eigh

    inside = z[mask]
    sample = inside[:: max(1, len(inside) // 10000)]
    low, high = np.quantile(sample, [0.0005, 0.9995], axis=0)
    v = np.clip(z, low, high)
    v = np.where(mask[..., None], v - np.clip(sample, low, high).mean(axis=0), 0.0)
    features = z.shape[-1]
    shared, pairs = np.zeros((features, features)), 0
    for a, b, both in (
        (v[:, _LAG:], v[:, :-_LAG], mask[:, _LAG:] & mask[:, :-_LAG]),
        (v[_LAG:], v[:-_LAG], mask[_LAG:] & mask[:-_LAG]),
    ):
        shared += a.reshape(-1, features).T @ b.reshape(-1, features)
        pairs += int(both.sum())
    shared = (shared + shared.T) / (2.0 * max(pairs, 1))
    strength, directions = eigh(shared, pixel_covariance(z, mask))
    best = np.argsort(-strength)[:_DIRECTIONS]
    best = best[strength[best] > max(_COHERENT, 6.0 / np.sqrt(max(pairs, 1)))]
    return directions[:, best], strength[best]


def averaged(y: _Floats, mask: _Mask, width: int) -> tuple[_Floats, npt.NDArray[np.intp]]:
    """Return averages over windows that do not reach across edges, NaN outside the region, and the windows.

    Of the nine windows that hold a pixel at their middle, a side or a corner, the one that varies least counts: so no
    average of two phases comes about; and how much noise varies says nothing of its sign, so no phase either (Kuwahara,
    Hachimura, Eiho and Kinoshita, 1976).
    """
    from scipy.ndimage import uniform_filter

    rows, columns, directions = y.shape
    if width == 1:
        return np.where(mask[..., None], y, np.nan), np.arange(mask.size).reshape(mask.shape)
    count = uniform_filter(mask.astype(float), width, mode="constant")
    inside = np.where(mask[..., None], y, 0.0)
    enough = count > 0.5 - 1e-9
    share = np.where(enough, count, 1.0)
    mean = np.stack(
        [uniform_filter(inside[..., i], width, mode="constant") / share for i in range(directions)], -1
    )
    square = uniform_filter((inside**2).sum(-1), width, mode="constant") / share
    pixels = share * width**2
    spread = np.where(enough, (square - (mean**2).sum(-1)) * pixels / (pixels - 1.0), np.inf)
    half = width // 2
    spread = np.pad(spread, half, constant_values=np.inf)
    mean = np.pad(mean, ((half, half), (half, half), (0, 0)))
    places = np.pad(np.arange(rows * columns).reshape(rows, columns), half, constant_values=-1)
    least, best = np.full((rows, columns), np.inf), np.full(y.shape, np.nan)
    taken = np.full((rows, columns), -1)
    for down in (half, 0, 2 * half):
        for right in (half, 0, 2 * half):
            window = np.s_[down : down + rows, right : right + columns]
            lower = spread[window] < least
            np.copyto(least, spread[window], where=lower)
            np.copyto(best, mean[window], where=lower[..., None])
            np.copyto(taken, places[window], where=lower)
    best[~mask] = np.nan
    return best, taken


def odd_tiles(shape: tuple[int, ...]) -> _Mask:
    """Return every other tile, like the black squares of a chessboard (y, x)."""
    rows, columns = shape
    return np.asarray((np.arange(rows)[:, None] // TILE + np.arange(columns) // TILE) % 2 == 1)


def divide(
    z: _Floats, mask: _Mask, fewest: int, generator: np.random.Generator
) -> tuple[Division | None, bool]:
    """Return a region in two phases, or None where nothing says that it is two; and whether only whole lines differ.

    Parameters
    ----------
    z : array (y, x, feature)
        In units of the noise, 0 where it is not known.
    mask : array (y, x)
        The region.
    fewest : int
        Pixels of a phase.
    generator : Generator
        Draws the pixels that the search looks at.
    """
    if mask.sum() < 4 * fewest:
        return None, False
    directions, _ = coherent_directions(z, mask)
    if not directions.shape[1]:
        return None, False
    y = z @ directions
    judges = odd_tiles(mask.shape)
    lines = False
    deepest = max(demand.valley for demand in DEMANDS)
    for width in WINDOWS:
        u, window = averaged(y, mask, width)
        known = np.isfinite(u[..., 0])
        candidates, held = _once(window, known & ~judges), _once(window, known & judges)
        if len(candidates) > _SAMPLE:
            candidates = generator.choice(candidates, _SAMPLE, replace=False)
        points = u.reshape(-1, u.shape[-1])[candidates]
        if len(points) < 60:
            break
        passed = []
        for one in _guesses(points):
            two = ~one
            direction = _between(points[one], points[two])
            along = u @ direction
            low, high = np.median(points[one] @ direction), np.median(points[two] @ direction)
            deep = [v for v in valleys(along.ravel()[held], low, high) if v[0] < deepest]
            for ratio, place in dict.fromkeys((*deep[:1], *sorted(deep)[:1])):
                division = by_edge(y @ direction, known, along > place, ratio, width, fewest)
                if division is not None:
                    passed.append(division)
        between = [d for d in passed if not along_lines(d.side, d.other)]
        lines |= len(passed) > len(between)
        if between:
            return min(between, key=lambda d: d.ratio), False
    return None, lines


def _guesses(points: _Floats) -> list[_Mask]:
    """Return ways to divide a cloud, across passes between modes and in valleys along axes: the larger part of each."""
    found = modes_of(points, max(12, len(points) // 300))
    guesses = [np.isin(found.label, list(group)) for group in divisions(found)[:_TRIED]]
    for axis in points.T:
        low, high = np.quantile(axis, [0.01, 0.99])
        deep = sorted(valleys(axis, low, high))[:1]
        guesses += [axis > place for ratio, place in deep if ratio < _SHALLOW]
    few = max(2, points.shape[1])
    sides = [guess if guess.mean() > 0.5 else ~guess for guess in guesses]
    return [side for side in sides if np.count_nonzero(~side) > few]


def along_lines(side: _Mask, other: _Mask) -> bool:
    """Return whether the sides of a division are whole scan lines (y): a change of the tip looks like that."""
    pixels = side.sum(axis=1) + other.sum(axis=1)
    share = side.sum(axis=1) / np.maximum(pixels, 1)
    rest = np.minimum(share, 1.0 - share) @ pixels
    return bool(rest < _STRAIGHT * min(side.sum(), other.sum()))


def _once(window: npt.NDArray[np.intp], mask: _Mask) -> npt.NDArray[np.intp]:
    """Return the pixels of a mask, one of those that share a window."""
    inside = np.flatnonzero(mask)
    return inside[np.unique(window.ravel()[inside], return_index=True)[1]]


def _between(one: _Floats, two: _Floats) -> _Floats:
    """Return the direction that separates two clouds best for their scatter (Fisher's), from one to two."""
    scatter = np.atleast_2d(np.cov(one.T) * len(one) + np.cov(two.T) * len(two)) / (len(one) + len(two))
    scatter += np.eye(len(scatter)) * 1e-6 * np.trace(scatter) / len(scatter)
    return np.asarray(np.linalg.solve(scatter, two.mean(axis=0) - one.mean(axis=0)))


def by_edge(
    score: _Floats, known: _Mask, above: _Mask, ratio: float, width: int, fewest: int
) -> Division | None:
    """Return the two sides of a cut, if the edge between them is one between phases.

    Parameters
    ----------
    score : array (y, x)
        Of single pixels, along the direction that separates the sides.
    known, above : array (y, x)
        Pixels of the region, and those on the upper side of the cut by the averages about them.
    ratio : float
        Density in the valley, of that of the lower summit.
    width : int
        Of the averages [pixel].
    fewest : int
        Pixels of a phase.
    """
    from scipy.ndimage import distance_transform_edt, median_filter

    high = median_filter((known & above).astype(np.uint8), 3).astype(bool) & known
    low = known & ~high
    if min(high.sum(), low.sum()) < fewest:
        return None
    to_high, to_low = distance_transform_edt(~high), distance_transform_edt(~low)
    inner = (low & (to_high > _NEAR), high & (to_low > _NEAR))
    beside = (inner[0] & (to_high < _FAR), inner[1] & (to_low < _FAR))
    if min(m.sum() for m in beside) < fewest / 3.0:
        return None  # a thin band
    middle = [float(np.median(score[m])) for m in inner]
    step = middle[1] - middle[0]
    if step <= 0.0:
        return None
    s = (score - middle[0]) / step
    foot, brow = (float(s[m].mean()) for m in beside)
    lasting = _neighbours(s, high, known, width + 1) - _neighbours(s, low, known, width + 1)
    smaller, larger = sorted((0, 1), key=lambda i: int((low, high)[i].sum()))
    wander = _wander(s, inner[larger]), _wander(s, inner[smaller])
    pixels = min(high.sum(), low.sum())
    if not any(
        ratio < min(demand.valley, _VALLEY_BY_LASTING * lasting)
        and abs(foot) < demand.foot
        and -_BELOW < brow - 1.0 < _OVERSHOOT
        and lasting > demand.lasting
        and wander[0] < demand.wander[0]
        and wander[1] < demand.wander[1]
        and pixels >= demand.size * fewest
        and width <= demand.width
        for demand in DEMANDS
    ):
        return None
    if high.sum() <= low.sum():
        return Division(high, low, ratio, to_high, to_low)
    return Division(low, high, ratio, to_low, to_high)


def _neighbours(s: _Floats, mask: _Mask, known: _Mask, lag: int) -> float:
    """Return the mean of pixels so far from those of a mask, along rows and columns."""
    total, count = 0.0, 0
    for a, b in ((np.s_[:, lag:], np.s_[:, :-lag]), (np.s_[lag:], np.s_[:-lag])):
        for here, there in ((a, b), (b, a)):
            both = mask[here] & known[there]
            total += float(s[there][both].sum())
            count += int(both.sum())
    return total / max(count, 1)


def _wander(s: _Floats, mask: _Mask) -> float:
    """Return the standard deviation of what neighbours of a mask have in common, less what noise may be."""
    low, high = np.quantile(s[mask], [0.01, 0.99])
    v = np.clip(s, low, high) - np.clip(s[mask], low, high).mean()
    total, count = 0.0, 0
    # along a line the filters of an instrument make the nearest ones alike
    for a, b in ((np.s_[:, 2:], np.s_[:, :-2]), (np.s_[1:], np.s_[:-1])):
        both = mask[a] & mask[b]
        total += float((v[a] * v[b])[both].sum())
        count += int(both.sum())
    variance = float(np.var(v[mask]))
    if count <= _FEW_PAIRS:
        return float(np.sqrt(variance))
    return float(np.sqrt(max(total / count - _ERRORS * variance / np.sqrt(count), 0.0)))


def halve(z: _Floats, mask: _Mask, fewest: int) -> tuple[Division, float] | None:
    """Return a region in two because it was asked for, along the direction in which neighbours are most alike.

    Parameters
    ----------
    z, mask, fewest
        As in `divide`.

    Returns
    -------
    division : Division
        Where two normal distributions of the averages of few pixels meet.
    gain : float
        What they gain over one in ln of density, over all pixels.
    """
    from scipy.ndimage import distance_transform_edt, median_filter

    directions, _ = coherent_directions(z, mask)
    if not directions.shape[1]:
        directions = np.linalg.eigh(np.cov(z[mask].T).reshape(2 * z.shape[-1:]))[1][:, ::-1]
    u = averaged(z @ directions[:, :1], mask, WINDOWS[-1])[0][..., 0]
    known = np.isfinite(u)
    points = u[known]
    one, two = clouds_along(points, 1), clouds_along(points, 2)
    upper = int(np.argmax(two[1]))
    likelier = np.zeros(known.shape, bool)
    part = parts_along(points, *two)
    likelier[known] = part[upper] > part[1 - upper]
    high = median_filter(likelier.astype(np.uint8), 3).astype(bool) & known
    low = known & ~high
    if min(high.sum(), low.sum()) < fewest:
        return None
    gain = float(density_along(points, *two).sum() - density_along(points, *one).sum())
    smaller, larger = sorted((high, low), key=lambda side: int(side.sum()))
    to_smaller, to_larger = distance_transform_edt(~smaller), distance_transform_edt(~larger)
    return Division(smaller, larger, np.inf, to_smaller, to_larger), gain
