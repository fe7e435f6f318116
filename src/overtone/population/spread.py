"""How much the properties of a phase differ from pixel to pixel, from the scatter of its pixels beyond the noise."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from overtone.population.held import PROPERTIES

_Floats = npt.NDArray[np.float64]

TYPICAL, FACTOR = 0.12, 2.0
"""Prior of the standard deviation of ln of a property within a phase: its median, and the factor of one deviation."""
_LEAST, _MOST = 1e-3, 1.5
_FREEDOM_LOST = 0.02  # share of the pixels that count: neighbours are alike


class Spread(NamedTuple):
    """Standard deviations of ln of the properties of a phase, and of their own logarithms."""

    value: _Floats
    """(PROPERTIES,); 0 for a property that the model lacks."""
    error: _Floats
    """(PROPERTIES,): of ln of it."""
    root: _Floats
    """(PROPERTIES, PROPERTIES): lower factor of the covariance of the logarithms."""


def spread_of(
    within: _Floats, noise: _Floats, J: _Floats, free: npt.NDArray[np.bool_], pixels: int, loose: _Floats
) -> Spread:
    """Return the spread that makes the scatter of the pixels of a phase likeliest.

    Parameters
    ----------
    within : array (datum, datum)
        Covariance of its pixels.
    noise : array (datum, datum)
        Of the noise alone.
    J : array (datum, PROPERTIES)
        Change of the rows with ln of each property.
    free : array (PROPERTIES,)
        Properties that the model has.
    pixels : int
        How many.
    loose : array (datum, direction)
        Directions that say nothing: what pixels differ by in them has other reasons.
    """
    from scipy.linalg import null_space
    from scipy.optimize import minimize

    scale = 1.0 / np.sqrt(np.diag(noise))
    R, N, J = within * np.outer(scale, scale), noise * np.outer(scale, scale), J * scale[:, None]
    if loose.shape[1]:
        keep = null_space((loose * scale[:, None]).T)
        R, N, J = keep.T @ R @ keep, keep.T @ N @ keep, keep.T @ J
    names = np.flatnonzero(free)
    J = J[:, names]
    n = max(pixels * _FREEDOM_LOST, min(pixels, 20))
    centre, width = math.log(TYPICAL), math.log(FACTOR)

    def cost(log_s: _Floats) -> float:
        V = N + (J * np.exp(2.0 * log_s)) @ J.T
        _, log_det = np.linalg.slogdet(V)
        return float(
            0.5 * n * (log_det + np.trace(np.linalg.solve(V, R)))
            + 0.5 * (((log_s - centre) / width) ** 2).sum()
        )

    bounds = [(math.log(_LEAST), math.log(_MOST))] * names.size
    found = minimize(cost, np.full(names.size, centre), method="L-BFGS-B", bounds=bounds)
    log_s = found.x
    hessian = _hessian(cost, log_s)
    values, vectors = np.linalg.eigh(hessian)
    covariance = (vectors / np.maximum(values, 0.3 / width**2)) @ vectors.T
    full = np.zeros((PROPERTIES, PROPERTIES))
    full[np.ix_(names, names)] = np.linalg.cholesky(covariance)
    value, error = np.zeros(PROPERTIES), np.zeros(PROPERTIES)
    value[names], error[names] = np.exp(log_s), np.sqrt(np.diag(covariance))
    return Spread(value, error, full)


def _hessian(cost, at: _Floats, step: float = 0.05) -> _Floats:  # type: ignore[no-untyped-def]
    size = at.size
    H = np.empty((size, size))
    steps = step * np.eye(size)
    for i in range(size):
        for j in range(i + 1):
            H[i, j] = H[j, i] = (
                cost(at + steps[i] + steps[j])
                - cost(at + steps[i] - steps[j])
                - cost(at - steps[i] + steps[j])
                + cost(at - steps[i] - steps[j])
            ) / (4.0 * step**2)
    return H
