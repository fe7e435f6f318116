"""A mixture of normal distributions along a line."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

_Floats = npt.NDArray[np.float64]

_ROUNDS = 40


def clouds_along(t: _Floats, count: int) -> tuple[_Floats, _Floats, _Floats]:
    """Return shares, means and variances of a mixture of normal distributions, by expectation and maximisation.

    Parameters
    ----------
    t : array (point,)
        A sample.
    count : int
        Of the distributions.
    """
    means = np.quantile(t, (np.arange(count) + 0.5) / count)
    whole = float(np.var(t)) or 1.0
    shares, variances = np.full(count, 1.0 / count), np.full(count, whole / count**2)
    for _ in range(_ROUNDS if count > 1 else 1):
        part = parts_along(t, shares, means, variances)
        part = np.exp(part - part.max(axis=0))
        part /= part.sum(axis=0)
        weight = part.sum(axis=1) + 1e-9
        shares, means = weight / weight.sum(), part @ t / weight
        variances = (part * (t - means[:, None]) ** 2).sum(axis=1) / weight + 1e-4 * whole
    return shares, means, variances


def density_along(t: _Floats, shares: _Floats, means: _Floats, variances: _Floats) -> _Floats:
    """Return ln of the density of a mixture of normal distributions."""
    return np.asarray(np.logaddexp.reduce(parts_along(t, shares, means, variances), axis=0))


def parts_along(t: _Floats, shares: _Floats, means: _Floats, variances: _Floats) -> _Floats:
    """Return ln of the density of each of them (part, point)."""
    square = (t - means[:, None]) ** 2 / variances[:, None]
    return np.asarray(np.log(shares / np.sqrt(2.0 * np.pi * variances))[:, None] - 0.5 * square)
