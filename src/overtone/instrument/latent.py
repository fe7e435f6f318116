"""Least squares where every point of a curve has a latent number of its own, by Levenberg and Marquardt's method.

The latent numbers follow any other unknown along a bent valley, in which an ordinary search creeps. Here they are set
right, point by point, after each step of the others, so that the search walks on the floor of the valley.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

_Floats = npt.NDArray[np.float64]

_INNER = 6  # steps that set latent numbers right
_INNER_SETTLED = 1e-6  # of chi-squared of a point
_LONGEST = 0.5  # of a step of a latent number
_DAMPED, _EASED, _STUCK = 4.0, 0.2, 1e8
_SETTLED = 0.01  # of half of chi-squared that a step may still gain
_ROUGH = 0.1  # the same where no step does


class Problem(NamedTuple):
    """A problem with rows of residuals, one of each row a point, and rows of priors behind them."""

    residuals: Callable[[_Floats], _Floats]
    """Of all parameters (parameter,): rows times points, then priors."""
    jacobian: Callable[[_Floats], _Floats]
    """(residual, parameter)."""
    points: int
    shared: int
    """Parameters of all points; the latent ones follow."""
    priors: int
    """Residuals at the end that do not belong to points."""
    step: float
    """Of a latent number, for differences."""


class Found(NamedTuple):
    """Where a search ended."""

    p: _Floats
    cost: float
    """Half of the sum of squares."""
    converged: bool


def search(problem: Problem, start: _Floats, steps: int) -> Found:
    """Return a minimum near a start.

    Parameters
    ----------
    problem : Problem
        Its shared parameters of about one prior width each.
    start : array (parameter,)
        Where to begin.
    steps : int
        Steps at most that are accepted.
    """
    p = _settled(problem, start)
    r = problem.residuals(p)
    cost, damping = 0.5 * float(r @ r), 1e-3
    for _ in range(steps):
        J = problem.jacobian(p)
        normal, gradient = J.T @ J, J.T @ r
        size = np.zeros(p.size)
        size[: problem.shared] = np.maximum(np.diag(normal)[: problem.shared], 1e-12)
        newton = np.linalg.solve(normal + 1e-12 * np.eye(p.size), gradient)
        promised = 0.5 * float(gradient @ newton)
        if promised < _SETTLED:
            return Found(p, cost, True)
        while True:
            change = -np.linalg.solve(normal + np.diag(damping * size + 1e-12), gradient)
            change[problem.shared :] = np.clip(change[problem.shared :], -_LONGEST, _LONGEST)
            trial = _settled(problem, p + change)
            there = problem.residuals(trial)
            gained = cost - 0.5 * float(there @ there)
            if gained > 0.0:
                break
            damping *= _DAMPED
            if damping > _STUCK:
                return Found(p, cost, promised < _ROUGH)  # differences promise what is not there
        p, r, cost = trial, there, cost - gained
        damping = max(damping * _EASED, 1e-9)
    return Found(p, cost, False)


def _settled(problem: Problem, p: _Floats) -> _Floats:
    """Return parameters whose latent numbers are the best for the shared ones, each on its own."""
    latent = slice(problem.shared, None)

    def by_point(q: _Floats) -> _Floats:
        r = problem.residuals(q)
        return r[: r.size - problem.priors].reshape(-1, problem.points)

    here = by_point(p)
    for _ in range(_INNER):
        moved = p.copy()
        moved[latent] += problem.step
        slope = (by_point(moved) - here) / problem.step
        change = -np.sum(slope * here, axis=0) / np.maximum(np.sum(slope**2, axis=0), 1e-30)
        trial = p.copy()
        trial[latent] += np.clip(change, -_LONGEST, _LONGEST)
        there = by_point(trial)
        better = np.sum(there**2, axis=0) < np.sum(here**2, axis=0)
        gained = np.where(better, np.sum(here**2 - there**2, axis=0), 0.0)
        p = np.concatenate([p[: problem.shared], np.where(better, trial[latent], p[latent])])
        here = np.where(better, there, here)
        if gained.max() < _INNER_SETTLED:
            break
    return p
