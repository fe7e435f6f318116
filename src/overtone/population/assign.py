"""Which pixel belongs to which phase: by what it reads and by what its neighbours are, and none where that is open."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

_Floats = npt.NDArray[np.float64]
_Mask = npt.NDArray[np.bool_]

SURE = 0.9
"""Probability that a pixel of a phase must have."""
_OUTLIER = 1e-4  # share of the pixels of a phase that lie beyond its edge in the space of features
_BORDER_OUTLIER = 0.01  # the same where two phases meet
_BODY = 0.98  # share of a cloud whose reach says how bent it is
_BORDER = 3.0  # pixels on either side
_BONDS = 0.6  # ln of the odds that a neighbour of the phase is worth
_PASSES = 5
_WIDE = 5  # pixels across: less may be a border
_MIXED = np.linspace(0.1, 0.9, 9)
_APART = 6.0  # standard deviations between phases from which a mixture can be told from either


class Cloud(NamedTuple):
    """A phase in the space of features, in units of the noise."""

    mean: _Floats
    covariance: _Floats
    edge: float
    """Squared Mahalanobis distance beyond which a pixel belongs to something else,"""
    border_edge: float
    """and beyond which one does that lies where two phases meet."""


def cloud_of(points: _Floats) -> Cloud:
    """Return the cloud of the pixels of a phase.

    Parameters
    ----------
    points : array (pixel, feature)
        In units of the noise: no direction varies less.
    """
    from scipy.stats import chi2

    features = points.shape[1]
    mean, covariance = points.mean(axis=0), covariance_of(points)
    for _ in range(2):
        square = _square(points, mean, covariance)
        inside = square <= chi2.ppf(0.999, features) * max(1.0, np.median(square) / chi2.median(features))
        if inside.sum() <= 2 * features:
            break
        mean, covariance = points[inside].mean(axis=0), covariance_of(points[inside])
    square = _square(points, mean, covariance)
    # clouds that a curved map has bent reach farther than Gaussian ones, but not as far as a few odd pixels
    body = max(1.0, float(np.quantile(square, _BODY)) / float(chi2.ppf(_BODY, features)))
    edge, border = (float(chi2.isf(share, features)) for share in (_OUTLIER, _BORDER_OUTLIER))
    reach = 3.0 * body**2
    far, less_far = (float(q) for q in np.quantile(square, [0.998, 1.0 - _BORDER_OUTLIER]))
    return Cloud(
        mean, covariance, max(edge, min(1.3 * far, reach * edge)), max(border, min(less_far, reach * border))
    )


def covariance_of(points: _Floats) -> _Floats:
    """Return the covariance of points (point, feature) in units of the noise, nowhere smaller than that noise."""
    features = points.shape[1]
    if len(points) < 2:
        return np.eye(features)
    values, vectors = np.linalg.eigh(np.cov(points.T).reshape(features, features))
    return np.asarray((vectors * np.maximum(values, 1.0)) @ vectors.T)


def _square(points: _Floats, mean: _Floats, covariance: _Floats) -> _Floats:
    """Return squared Mahalanobis distances."""
    root = np.linalg.cholesky(covariance)
    white = (points - mean) @ np.linalg.inv(root).T
    return np.asarray(np.einsum("...i,...i->...", white, white))


def _log_density(square: _Floats, covariance: _Floats) -> _Floats:
    """Return ln of a Gaussian density, up to a constant of the space."""
    return np.asarray(-0.5 * (square + np.linalg.slogdet(covariance)[1]))


def assign(
    z: _Floats, known: _Mask, cores: Sequence[_Mask], clouds: Sequence[Cloud]
) -> tuple[npt.NDArray[np.int8], _Floats]:
    """Return the phase of every pixel, -1 for none, and its probability.

    Parameters
    ----------
    z : array (y, x, feature)
        In units of the noise.
    known : array (y, x)
        Pixels with all features.
    cores : sequence of array (y, x)
        Pixels of each phase away from its borders.
    clouds : sequence of Cloud
        The phases.

    Returns
    -------
    label : array (y, x)
        -1 where a pixel is not known, lies outside of every cloud, may be of two phases, or lies between two phases and
        reads like a mixture.
    probability : array (y, x)
        Of the likeliest phase; 0 where a pixel is not known.

    Notes
    -----
    A field of Potts in the mean-field approximation: each neighbour of a phase, of eight, adds to its odds.
    """
    from scipy.ndimage import distance_transform_edt, uniform_filter

    squares = [_square(z, c.mean, c.covariance) for c in clouds]
    if len(clouds) == 1:
        label = np.where(known & (squares[0] <= clouds[0].edge), 0, -1).astype(np.int8)
        return label, known.astype(float)
    density = np.stack([_log_density(s, c.covariance) for s, c in zip(squares, clouds, strict=True)])
    start = np.full(known.shape, -1)
    for k, core in enumerate(cores):
        start[core] = k
    _, nearest = distance_transform_edt(start < 0, return_indices=True)
    start = start[tuple(nearest)]
    share = np.array([max((start == k).mean(), 1e-6) for k in range(len(clouds))])
    belief = np.where(start == np.arange(len(clouds))[:, None, None], 0.9, 0.1 / (len(clouds) - 1)) * known
    for _ in range(_PASSES):
        around = np.stack([9.0 * uniform_filter(b, 3, mode="nearest") - b for b in belief])
        odds = density + np.log(share)[:, None, None] + _BONDS * around
        belief = np.exp(odds - odds.max(axis=0))
        belief *= known / belief.sum(axis=0)
    label = np.argmax(belief, axis=0)
    probability = belief.max(axis=0)
    border = _borders(label, len(clouds))
    own = np.take_along_axis(np.stack(squares), label[None], axis=0)[0]
    edge = np.where(
        border.any(axis=0),
        np.array([c.border_edge for c in clouds])[label],
        np.array([c.edge for c in clouds])[label],
    )
    doubtful = ~known | (probability < SURE) | (own > edge)
    doubtful |= _mixtures(z, label, border, density, clouds) | _thin(label, border)
    return np.where(doubtful, -1, label).astype(np.int8), probability


def _borders(label: npt.NDArray[np.intp], count: int) -> _Mask:
    """Return for every phase which pixels of another one lie near it."""
    from scipy.ndimage import distance_transform_edt

    near = np.zeros((count, *label.shape), bool)
    for k in range(count):
        mine = label == k
        if mine.any() and not mine.all():
            near[k] = (distance_transform_edt(~mine) <= _BORDER) & ~mine
    return near


def _thin(label: npt.NDArray[np.intp], border: _Mask) -> _Mask:
    """Return bands along two other phases: what runs from the one to the other may read like a third on its way."""
    from scipy.ndimage import binary_dilation, binary_opening

    thin = np.zeros(label.shape, bool)
    between = border.sum(axis=0) >= 2
    for k in range(len(border)):
        mine = label == k
        if (mine & between).any():
            wide = binary_dilation(
                binary_opening(mine, np.ones((_WIDE, _WIDE))), np.ones((3, 3)), iterations=2
            )
            thin |= mine & between & ~wide
    return thin


def _mixtures(
    z: _Floats, label: npt.NDArray[np.intp], border: _Mask, density: _Floats, clouds: Sequence[Cloud]
) -> _Mask:
    """Return which pixels near another phase read more like a mixture with it than like their own."""
    mixed = np.zeros(label.shape, bool)
    for k, one in enumerate(clouds):
        for j, two in enumerate(clouds):
            if j == k:
                continue
            apart = max(
                _square(two.mean, one.mean, one.covariance), _square(one.mean, two.mean, two.covariance)
            )
            here = border[j] & (label == k)
            if apart < _APART**2 or not here.any():
                continue
            points = z[here]
            total = np.full(len(points), -np.inf)
            for part in _MIXED:
                mean = (1.0 - part) * one.mean + part * two.mean
                covariance = (1.0 - part) * one.covariance + part * two.covariance
                total = np.logaddexp(total, _log_density(_square(points, mean, covariance), covariance))
            mixed[here] |= total - np.log(len(_MIXED)) > density[k][here]
    return mixed
