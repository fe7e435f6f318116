"""How much the properties of a phase differ from pixel to pixel, from the scatter of its pixels beyond the noise."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from overtone.population.held import PROPERTIES

_Floats = npt.NDArray[np.float64]

TYPICAL, FACTOR = 0.12, 2.0
"""Prior of the standard deviation of ln of a property within a phase: its median, and the factor of one deviation."""
_LEAST, _MOST = 1e-3, 1.5
_SLOPES = 0.03
"""Relative accuracy of slopes at a median material that is itself not known."""
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
    within: _Floats,
    noise: _Floats,
    J: _Floats,
    H: _Floats,
    free: npt.NDArray[np.bool_],
    pixels: int,
    loose: _Floats,
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
    H : array (datum, PROPERTIES, PROPERTIES)
        And its change with them. Where two properties do nearly the same, what their squares add to the scatter would
        otherwise be taken for a difference of the two, which would have to be many times as large.
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
    H = H * scale[:, None, None]
    names = np.flatnonzero(free)
    J, H = J[:, names], H[:, names[:, None], names]
    steep = [np.diag((_SLOPES * column) ** 2) for column in J.T]
    if loose.shape[1]:
        keep = null_space((loose * scale[:, None]).T)
        R, N, J, H = keep.T @ R @ keep, keep.T @ N @ keep, keep.T @ J, np.tensordot(keep.T, H, 1)
        steep = [keep.T @ of_one @ keep for of_one in steep]
    n = max(pixels * _FREEDOM_LOST, min(pixels, 20))
    centre, width = math.log(TYPICAL), math.log(FACTOR)

    def cost(log_s: _Floats) -> tuple[float, _Floats]:
        """Return minus ln of the density, and its slope."""
        s2 = np.exp(2.0 * log_s)
        bent = np.einsum("rij,j,sij->irs", H, s2, H)
        V = N + (J * s2) @ J.T + 0.5 * np.tensordot(s2, bent, 1) + np.tensordot(s2, steep, 1)
        _, log_det = np.linalg.slogdet(V)
        P = np.linalg.inv(V)
        PR = P @ R
        # dV/ds2 of each property
        rise = np.einsum("ri,si->irs", J, J) + bent + np.stack(steep)
        away = (log_s - centre) / width
        value = 0.5 * n * (log_det + np.trace(PR)) + 0.5 * (away**2).sum()
        slope = n * s2 * np.einsum("rs,isr->i", P - PR @ P, rise) + away / width
        return float(value), slope

    bounds = [(math.log(_LEAST), math.log(_MOST))] * names.size
    # a method that needs no library of linear algebra, whose threads would wait for the cores that kernels hold
    found = minimize(cost, np.full(names.size, centre), method="TNC", bounds=bounds, jac=True)
    log_s = found.x
    hessian = _hessian(cost, log_s)
    values, vectors = np.linalg.eigh(hessian)
    covariance = (vectors / np.maximum(values, 0.3 / width**2)) @ vectors.T
    full = np.zeros((PROPERTIES, PROPERTIES))
    full[np.ix_(names, names)] = np.linalg.cholesky(covariance)
    value, error = np.zeros(PROPERTIES), np.zeros(PROPERTIES)
    value[names], error[names] = np.exp(log_s), np.sqrt(np.diag(covariance))
    return Spread(value, error, full)


def _hessian(cost: Callable[[_Floats], tuple[float, _Floats]], at: _Floats, step: float = 0.05) -> _Floats:
    steps = step * np.eye(at.size)
    H = np.stack([(cost(at + one)[1] - cost(at - one)[1]) / (2.0 * step) for one in steps])
    return np.asarray(0.5 * (H + H.T))
