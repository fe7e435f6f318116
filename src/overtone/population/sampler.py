"""Draws from the posterior of all materials of a scan together.

What a scan measures of its phases is sharp in most directions and open in a few, along which the unknowns bend: a
step that is straight in them leaves the floor of that valley at once. So a step is straight in the force harmonics
instead. It is drawn in the tangent plane of what the model can make of them, uphill as Langevin has it, with the local
metric; the unknowns then follow by Newton's method to where the harmonics have gone as far within that plane.
Metropolis and Hastings' rule, with the density of a step that this gives, makes the draws those of the posterior.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from overtone.inversion.posterior import Prior
from overtone.kernels import inner, kernel, lean
from overtone.population.forward import (
    Desk,
    Scene,
    add_priors,
    all_rows,
    cholesky,
    correct_slopes,
    inside,
    log_prior,
    misfit,
    new_desk,
    settle_materials,
)

_Floats = npt.NDArray[np.float64]
_Complex = npt.NDArray[np.complex128]

MOST_NODES = 240
"""Places of a profile along ln E, in each direction."""
_DOWN = 14.0  # of ln of the density below its largest, where a profile ends
_FIRST_STEP, _LONGEST_STEP, _SHORTEST_STEP = 0.02, 0.4, 1e-3
_RETRACT = 12
_SETTLING = 10  # passes of the motion at the start of a chain
_ARRIVED, _LOST = 1e-8, 1e8  # squared length of what is left of a step, in the local metric
_SAME = 1e-3  # squared distance, in the local metric, within which a step back ends where it began
_TOO_FAR, _TOO_NEAR = 1.5, 0.4  # change of ln of the density between two places


@kernel
def profile(
    scene: Scene,
    prior: Prior,
    sticky: bool,
    loss: bool,
    x0: float,
    v0: _Floats,
    x: _Floats,
    log_mass: _Floats,
    v: _Floats,
) -> int:
    """Fill places of ln E, up and down from a start, with the mass of the posterior there; return how many.

    Parameters
    ----------
    scene : Scene
        Of one material.
    prior : Prior
        As `overtone.inversion.posterior` has it.
    x0, v0 : float, array (unknown,)
        Where to begin.
    x, log_mass, v : array (node,), (node,), (node, unknown)
        Filled; `MOST_NODES` nodes for each direction.
    """
    desk = new_desk(scene)
    here, at = np.zeros(1), np.zeros((1, v0.shape[0]))
    count = 0
    best = -math.inf
    for way in range(2):
        sign = 1.0 if way == 0 else -1.0
        here[0], at[0] = x0, v0
        step, last = _FIRST_STEP, -math.inf
        x_last, v_last = x0, at.copy()
        for k in range(MOST_NODES):
            value = settle_materials(scene, prior, sticky, loss, here, at, desk)
            if value > -math.inf:
                correct_slopes(scene, 0, here[0], at[0], desk)
                value = settle_materials(scene, prior, sticky, loss, here, at, desk)
            if k > 0 and step > _SHORTEST_STEP and not abs(value - last) < _TOO_FAR and value > -math.inf:
                step *= 0.5
                here[0] = x_last + sign * step
                at[:] = v_last
                continue
            if value == -math.inf:
                if step <= _SHORTEST_STEP or k == 0:
                    break
                step *= 0.5
                here[0] = x_last + sign * step
                at[:] = v_last
                continue
            if not (way == 1 and k == 0):
                x[count], log_mass[count], v[count] = here[0], value, at[0]
                count += 1
            best = max(best, value)
            if value < best - _DOWN:
                break
            if k > 0 and abs(value - last) < _TOO_NEAR:
                step = min(1.5 * step, _LONGEST_STEP)
            x_last, v_last[:] = here[0], at
            last = value
            there = min(max(here[0] + sign * step, prior.log_low), prior.log_high)
            if there == here[0]:
                break
            here[0] = there
    return count


class State(NamedTuple):
    """A point of a chain, with what a step from it takes."""

    u: _Floats
    """(unknown,): v of all materials, then their ln E."""
    f: _Floats
    """(datum,)."""
    J: _Floats
    """(datum, unknown)."""
    L: _Floats
    """(unknown, unknown): lower factor of the metric."""
    g: _Floats
    """(unknown,): slope of ln of the density."""
    added: _Complex
    """(material, scan, harmonic)."""


@inner
def _new_state(scene: Scene, desk: Desk) -> State:
    m, materials = desk.J.shape[1], scene.amplitude.shape[0]
    size = desk.f.shape[0]
    return State(
        np.zeros(m + materials),
        np.zeros(size),
        np.zeros((size, m + materials)),
        np.zeros((m + materials, m + materials)),
        np.zeros(m + materials),
        desk.added.copy(),
    )


@inner
def _copy(state: State, other: State) -> None:
    other.u[:], other.f[:], other.J[:] = state.u, state.f, state.J
    other.L[:], other.g[:], other.added[:] = state.L, state.g, state.added


@lean
def _spread_out(u: _Floats, x: _Floats, v: _Floats) -> None:
    """Fill ln E and v from the unknowns in one row."""
    materials, each = v.shape
    for k in range(materials):
        x[k] = u[materials * each + k]
        for a in range(each):
            v[k, a] = u[k * each + a]


@inner
def _look(
    scene: Scene,
    prior: Prior,
    sticky: bool,
    loss: bool,
    state: State,
    desk: Desk,
    x: _Floats,
    v: _Floats,
    P: _Floats,
) -> float:
    """Fill a state from its unknowns; return ln of the density there, minus infinity where there is none."""
    materials, each = v.shape
    m = materials * each
    _spread_out(state.u, x, v)
    desk.added[:] = state.added
    for k in range(materials):
        correct_slopes(scene, k, x[k], v[k], desk)
    all_rows(scene, x, v, desk)
    state.added[:] = desk.added
    state.f[:] = desk.f
    state.J[:, :m], state.J[:, m:] = desk.J, desk.J_x
    if not inside(scene, prior, sticky, loss, x, v):
        return -math.inf
    value = log_prior(scene, prior, sticky, loss, x, v) - misfit(scene, desk.f)
    if not math.isfinite(value):
        return -math.inf
    state.L[:] = state.J.T @ (scene.precision @ state.J)
    state.g[:] = state.J.T @ (scene.precision @ (scene.centre - state.f))
    add_priors(scene, prior, sticky, loss, x, v, state.g, P)
    for a in range(P.shape[0]):
        state.L[a, a] += P[a]
    if not cholesky(state.L):
        return -math.inf
    return value


@lean
def _solve(L: _Floats, b: _Floats, out: _Floats) -> None:
    """Fill the solution of L L' out = b."""
    n = b.shape[0]
    for a in range(n):
        total = b[a]
        for c in range(a):
            total -= L[a, c] * out[c]
        out[a] = total / L[a, a]
    for a in range(n - 1, -1, -1):
        total = out[a]
        for c in range(a + 1, n):
            total -= L[c, a] * out[c]
        out[a] = total / L[a, a]


@lean
def _squared(L: _Floats, step: _Floats) -> float:
    """Return the squared length of a step in the metric L L'."""
    n = step.shape[0]
    length = 0.0
    for a in range(n):
        along = 0.0
        for c in range(a, n):
            along += L[c, a] * step[c]
        length += along * along
    return length


@inner
def _log_det(A: _Floats) -> float:
    """Return ln of the size of the determinant of a matrix of wild rows."""
    scale = np.sqrt(np.abs(np.diag(A)) + 1e-300)
    sign, value = np.linalg.slogdet(A / np.outer(scale, scale))
    return value + 2.0 * np.log(scale).sum() if sign != 0.0 else -math.inf


@inner
def _log_step(
    scene: Scene, start: State, end: State, stride: float, P: _Floats, work: _Floats, step: _Floats
) -> float:
    """Return ln of the density with which a step from one state ends at another, but for a constant."""
    n = start.u.shape[0]
    away = end.u - start.u
    # the step in the tangent plane that leads there
    work[:] = start.J.T @ (scene.precision @ (end.f - start.f))
    for a in range(n):
        work[a] += P[a] * away[a]
    _solve(start.L, work, step)
    _solve(start.L, start.g, work)
    for a in range(n):
        step[a] -= 0.5 * stride * stride * work[a]
    length, log_L = _squared(start.L, step), 0.0
    for a in range(n):
        log_L += math.log(start.L[a, a])
    M = start.J.T @ (scene.precision @ end.J)
    for a in range(n):
        M[a, a] += P[a]
    return -0.5 * length / (stride * stride) - log_L + _log_det(M)


@inner
def _follow(
    scene: Scene,
    prior: Prior,
    sticky: bool,
    loss: bool,
    start: State,
    P: _Floats,
    goal: _Floats,
    end: State,
    desk: Desk,
    x: _Floats,
    v: _Floats,
    work: _Floats,
    off: _Floats,
) -> bool:
    """Move the end of a step to where the harmonics have gone as far as is its goal; return whether that was found."""
    n = end.u.shape[0]
    J, M, scale = np.zeros(start.J.shape), np.zeros((n, n)), np.zeros(n)
    for _ in range(_RETRACT):
        finite = True
        for a in range(n):
            finite &= math.isfinite(end.u[a])
        if not finite:
            return False
        _spread_out(end.u, x, v)
        if not inside(scene, prior, sticky, loss, x, v):
            return False
        desk.added[:] = end.added
        all_rows(scene, x, v, desk)
        end.added[:] = desk.added
        off[:] = goal - start.J.T @ (scene.precision @ (desk.f - start.f))
        for a in range(n):
            off[a] -= P[a] * (end.u[a] - start.u[a])
        # Newton's method, with the slopes of where it is
        m = desk.J.shape[1]
        J[:, :m], J[:, m:] = desk.J, desk.J_x
        M[:] = start.J.T @ (scene.precision @ J)
        for a in range(n):
            M[a, a] += P[a]
            scale[a] = 0.0
            for c in range(a + 1):
                scale[a] += start.L[a, c] ** 2
            scale[a] = math.sqrt(scale[a])
        if not math.isfinite(M.sum()):
            return False
        work[:] = np.linalg.solve(M / np.outer(scale, scale), off / scale) / scale
        end.u[:] += work
        length = _squared(start.L, work)
        if not length < _LOST:
            return False
        if length < _ARRIVED:
            return True
    return False


@inner
def _leads_back(
    scene: Scene,
    prior: Prior,
    sticky: bool,
    loss: bool,
    here: State,
    there: State,
    P: _Floats,
    again: State,
    desk: Desk,
    x: _Floats,
    v: _Floats,
    work: _Floats,
    off: _Floats,
    goal: _Floats,
) -> bool:
    """Return whether the step from there that should end here does."""
    n = here.u.shape[0]
    goal[:] = there.J.T @ (scene.precision @ (here.f - there.f))
    for a in range(n):
        goal[a] += P[a] * (here.u[a] - there.u[a])
    _solve(there.L, goal, work)
    again.u[:] = there.u + work
    again.added[:] = there.added
    if not _follow(scene, prior, sticky, loss, there, P, goal, again, desk, x, v, work, off):
        return False
    return _squared(here.L, again.u - here.u) < _SAME


@kernel
def walk(
    scene: Scene,
    prior: Prior,
    sticky: bool,
    loss: bool,
    stride: float,
    x0: _Floats,
    v0: _Floats,
    normals: _Floats,
    uniforms: _Floats,
    x: _Floats,
    v: _Floats,
    f: _Floats,
) -> float:
    """Fill a chain of draws; return the share of the steps that were accepted.

    Parameters
    ----------
    scene, prior, sticky, loss
        All materials.
    stride : float
        Length of a step in the local metric.
    x0, v0 : array (material,), (material, unknown)
        Where the chain begins; replaced by where it ends.
    normals, uniforms : array (step, unknown of all), (step,)
        Random numbers.
    x, v, f : array (step, material), (step, material, unknown), (step, datum)
        Filled.
    """
    materials, each = v.shape[1], v.shape[2]
    m = materials * each
    n = m + materials
    desk = new_desk(scene)
    here, there, again = _new_state(scene, desk), _new_state(scene, desk), _new_state(scene, desk)
    P, P_there, work, step, goal, off = (
        np.zeros(n),
        np.zeros(n),
        np.zeros(n),
        np.zeros(n),
        np.zeros(n),
        np.zeros(n),
    )
    x_now, v_now = x0.copy(), v0.copy()
    for k in range(materials):
        here.u[m + k] = x0[k]
        for a in range(each):
            here.u[k * each + a] = v0[k, a]
    for _ in range(_SETTLING):
        all_rows(scene, x_now, v_now, desk)
    here.added[:] = desk.added
    value = _look(scene, prior, sticky, loss, here, desk, x_now, v_now, P)
    accepted = 0
    for i in range(x.shape[0]):
        # uphill and at random, in the tangent plane
        _solve(here.L, here.g, step)
        for a in range(n - 1, -1, -1):
            total = normals[i, a]
            for c in range(a + 1, n):
                total -= here.L[c, a] * work[c]
            work[a] = total / here.L[a, a]
        for a in range(n):
            step[a] = 0.5 * stride * stride * step[a] + stride * work[a]
        # L L' step: how far the harmonics have to go within that plane
        for a in range(n):
            total = 0.0
            for c in range(a, n):
                total += here.L[c, a] * step[c]
            work[a] = total
        for a in range(n):
            total = 0.0
            for c in range(a + 1):
                total += here.L[a, c] * work[c]
            goal[a] = total
        there.u[:] = here.u + step
        there.added[:] = here.added
        candidate = -math.inf
        if _follow(scene, prior, sticky, loss, here, P, goal, there, desk, x_now, v_now, work, off):
            candidate = _look(scene, prior, sticky, loss, there, desk, x_now, v_now, P_there)
        if candidate > -math.inf:
            forward = _log_step(scene, here, there, stride, P, work, step)
            back = _log_step(scene, there, here, stride, P_there, work, step)
            wanted = math.log(max(uniforms[i], 1e-300)) < candidate - value + back - forward
            # a step that does not lead back the same way would be taken too often
            if wanted and _leads_back(
                scene, prior, sticky, loss, here, there, P_there, again, desk, x_now, v_now, work, off, goal
            ):
                _copy(there, here)
                P[:] = P_there
                value = candidate
                accepted += 1
        _spread_out(here.u, x[i], v[i])
        f[i] = here.f
    x0[:], v0[:] = x[-1], v[-1]
    return float(accepted / x.shape[0])
