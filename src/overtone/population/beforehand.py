"""What is known of the materials of a scan before it was measured: one prior for all of them."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from overtone.inversion.posterior import Prior
from overtone.inversion.table import DEEPEST, SHALLOWEST
from overtone.kernels import lean
from overtone.population.forward import ADHESION, FIRST_DEPTH, TANGENT, Scene

_Floats = npt.NDArray[np.float64]

_OPEN = 0.2
"""Curvature of ln of what may vanish, at least: no step is longer than a factor of e or two."""
_BESIDE = 1e-3  # of a bound


@lean
def log_prior(scene: Scene, prior: Prior, sticky: bool, loss: bool, x: _Floats, v: _Floats) -> float:
    """Return ln of the prior density of (ln E, v), but for a constant and for bounds."""
    total = 0.0
    for k in range(x.shape[0]):
        total -= 0.5 * prior.precision * (x[k] - prior.centre) ** 2
        if sticky and scene.even:
            away = v[k, ADHESION] + math.log(scene.unit) - prior.adhesion_mean
            total -= 0.5 * prior.adhesion_precision * away * away
        elif sticky:
            F = math.exp(v[k, ADHESION]) * scene.unit
            total += v[k, ADHESION] - 0.5 * prior.adhesion_precision * (F - prior.adhesion_mean) ** 2
        if loss:
            total += v[k, TANGENT]
        for s in range(v.shape[1] - FIRST_DEPTH):
            # every ratio of indentations alike
            total -= math.log1p(math.exp(v[k, FIRST_DEPTH + s]))
    return total


@lean
def inside(scene: Scene, prior: Prior, sticky: bool, loss: bool, x: _Floats, v: _Floats) -> bool:
    """Tell whether all unknowns are within the bounds of their priors."""
    fine = True
    for k in range(x.shape[0]):
        fine &= prior.log_low < x[k] < prior.log_high
        if sticky:
            F = math.exp(v[k, ADHESION]) * scene.unit
            fine &= prior.adhesion_low <= F <= prior.adhesion_high
        if loss:
            fine &= math.exp(v[k, TANGENT]) <= prior.tangent_high
        for s in range(v.shape[1] - FIRST_DEPTH):
            fine &= SHALLOWEST < v[k, FIRST_DEPTH + s] < DEEPEST
    return fine


@lean
def bounds(scene: Scene, prior: Prior, sticky: bool, loss: bool, low: _Floats, high: _Floats) -> None:
    """Fill where unknowns may lie, a little inside of the bounds of their priors; in the order of `add_priors`."""
    materials, scans = scene.amplitude.shape
    each = FIRST_DEPTH + scans
    low[:], high[:] = -math.inf, math.inf
    for k in range(materials):
        at = k * each
        if sticky:
            if prior.adhesion_low > 0.0:
                low[at + ADHESION] = math.log(prior.adhesion_low / scene.unit) + _BESIDE
            high[at + ADHESION] = math.log(prior.adhesion_high / scene.unit) - _BESIDE
        if loss:
            high[at + TANGENT] = math.log(prior.tangent_high) - _BESIDE
        for s in range(scans):
            low[at + FIRST_DEPTH + s], high[at + FIRST_DEPTH + s] = SHALLOWEST + _BESIDE, DEEPEST - _BESIDE
        low[materials * each + k] = prior.log_low + _BESIDE
        high[materials * each + k] = prior.log_high - _BESIDE


@lean
def add_priors(
    scene: Scene, prior: Prior, sticky: bool, loss: bool, x: _Floats, v: _Floats, g: _Floats, P: _Floats
) -> None:
    """Add the slope of ln of the priors to g, and fill P with what they add to the diagonal of the metric.

    Unknowns in the order v of all materials, then their ln E. P holds no step longer than the priors are wide.
    """
    materials, each = v.shape
    for k in range(materials):
        at = k * each
        if sticky:
            F = math.exp(v[k, ADHESION]) * scene.unit
            P[at + ADHESION] = _OPEN
            if scene.even:
                away = v[k, ADHESION] + math.log(scene.unit) - prior.adhesion_mean
                g[at + ADHESION] -= prior.adhesion_precision * away
                P[at + ADHESION] += prior.adhesion_precision
            else:
                g[at + ADHESION] += 1.0 - prior.adhesion_precision * (F - prior.adhesion_mean) * F
                P[at + ADHESION] += prior.adhesion_precision * F * F
        else:
            g[at + ADHESION], P[at + ADHESION] = 0.0, 1.0
        if loss:
            g[at + TANGENT] += 1.0
            P[at + TANGENT] = _OPEN
        else:
            g[at + TANGENT], P[at + TANGENT] = 0.0, 1.0
        for s in range(each - FIRST_DEPTH):
            Delta = 1.0 / (1.0 + math.exp(-v[k, FIRST_DEPTH + s]))
            g[at + FIRST_DEPTH + s] -= Delta
            P[at + FIRST_DEPTH + s] = Delta * (1.0 - Delta)
        g[materials * each + k] -= prior.precision * (x[k] - prior.centre)
        P[materials * each + k] = prior.precision + 12.0 / (prior.log_high - prior.log_low) ** 2
