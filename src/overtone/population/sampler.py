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
from overtone.population.algebra import cholesky, eliminate, in_units, solve_factored, squared_length
from overtone.population.beforehand import add_priors, inside, log_prior
from overtone.population.forward import (
    FIRST_DEPTH,
    Desk,
    Scene,
    all_at_rest,
    all_rows,
    misfit,
    new_desk,
    one_at_rest,
)
from overtone.population.search import settle_materials

_Floats = npt.NDArray[np.float64]
_Complex = npt.NDArray[np.complex128]

MOST_NODES = 240
"""Places of a profile along ln E, in each direction."""
_DOWN = 14.0  # of ln of the density below its largest, where a profile ends
_FIRST_STEP, _LONGEST_STEP, _SHORTEST_STEP = 0.02, 0.4, 1e-3
_RETRACT = 20
_SETTLING = 10  # passes of the motion at the start of a chain
_ARRIVED, _LOST = 1e-6, 1e8  # squared length of Newton's last step, in the local metric
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
                one_at_rest(scene, 0, here[0], at[0], desk)
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
    B: _Floats
    """(unknown, datum): J' times the precision."""
    E: _Floats
    """(datum, 4): as the desk has it."""
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
        np.zeros((m + materials, size)),
        np.zeros((size, 4)),
        np.zeros((m + materials, m + materials)),
        np.zeros(m + materials),
        desk.added.copy(),
    )


@inner
def _copy(state: State, other: State) -> None:
    other.u[:], other.f[:], other.J[:], other.B[:], other.E[:] = state.u, state.f, state.J, state.B, state.E
    other.L[:], other.g[:], other.added[:] = state.L, state.g, state.added


@lean
def _spread_out(u: _Floats, x: _Floats, v: _Floats) -> None:
    """Fill ln E and v from the unknowns in one row."""
    materials, each = v.shape
    for k in range(materials):
        x[k] = u[materials * each + k]
        for a in range(each):
            v[k, a] = u[k * each + a]


@lean
def _times_slopes(scene: Scene, B: _Floats, J: _Floats, out: _Floats) -> None:
    """Fill B J, where J is zero but for the own rows of a material."""
    materials, scans = scene.amplitude.shape
    rows, m = scans * scene.orders.shape[0], materials * (FIRST_DEPTH + scans)
    for a in range(B.shape[0]):
        for c in range(J.shape[1]):
            k = c // (FIRST_DEPTH + scans) if c < m else c - m
            total = 0.0
            for i in range(k * rows, (k + 1) * rows):
                total += B[a, i] * J[i, c]
            if c >= m:
                for i in range(materials * rows, J.shape[0]):
                    total += B[a, i] * J[i, c]
            out[a, c] = total


@lean
def _times_difference(B: _Floats, f: _Floats, other: _Floats, out: _Floats) -> None:
    """Fill B (f - other)."""
    for a in range(B.shape[0]):
        total = 0.0
        for i in range(f.shape[0]):
            total += B[a, i] * (f[i] - other[i])
        out[a] = total


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
    all_at_rest(scene, x, v, desk)
    state.added[:] = desk.added
    state.f[:], state.E[:] = desk.f, desk.E
    state.J[:, :m], state.J[:, m:] = desk.J, desk.J_x
    if not inside(scene, prior, sticky, loss, x, v):
        return -math.inf
    value = log_prior(scene, prior, sticky, loss, x, v) - misfit(scene, desk.f)
    if not math.isfinite(value):
        return -math.inf
    # the precision is symmetric, and J small: B' first
    weighted = np.empty(state.J.shape)
    _times_slopes(scene, scene.precision, state.J, weighted)
    state.B[:] = weighted.T
    _times_slopes(scene, state.B, state.J, state.L)
    _times_difference(state.B, scene.centre, state.f, state.g)
    add_priors(scene, prior, sticky, loss, x, v, state.g, P)
    for a in range(P.shape[0]):
        state.L[a, a] += P[a]
    if not cholesky(state.L):
        return -math.inf
    return value


@inner
def _log_step(
    scene: Scene,
    start: State,
    end: State,
    stride: float,
    P: _Floats,
    work: _Floats,
    step: _Floats,
    M: _Floats,
) -> float:
    """Return ln of the density with which a step from one state ends at another, but for a constant."""
    n = start.u.shape[0]
    # the step in the tangent plane that leads there
    _times_difference(start.B, end.f, start.f, work)
    for a in range(n):
        work[a] += P[a] * (end.u[a] - start.u[a])
    solve_factored(start.L, work, step)
    solve_factored(start.L, start.g, work)
    for a in range(n):
        step[a] -= 0.5 * stride * stride * work[a]
    length, log_L = squared_length(start.L, step), 0.0
    for a in range(n):
        log_L += math.log(start.L[a, a])
    _times_slopes(scene, start.B, end.J, M)
    for a in range(n):
        M[a, a] += P[a]
    for a in range(n):
        step[a] = math.sqrt(abs(M[a, a]) + 1e-300)
        work[a] = 0.0
    of_units = in_units(M, step)
    return -0.5 * length / (stride * stride) - log_L + eliminate(M, work) + of_units


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
    off: _Floats,
    scale: _Floats,
    M: _Floats,
) -> bool:
    """Move the end of a step to where the harmonics have gone as far as is its goal; return whether that was found."""
    n, m = end.u.shape[0], desk.J.shape[1]
    for a in range(n):
        scale[a] = 0.0
        for c in range(a + 1):
            scale[a] += start.L[a, c] ** 2
        scale[a] = math.sqrt(scale[a])
    # of the start, whatever was looked at since: a way back is to end where the way there began
    desk.E[:] = start.E
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
        _times_difference(start.B, start.f, desk.f, off)
        for a in range(n):
            off[a] += goal[a] - P[a] * (end.u[a] - start.u[a])
        # Newton's method, with the slopes of where it is
        end.J[:, :m], end.J[:, m:] = desk.J, desk.J_x
        _times_slopes(scene, start.B, end.J, M)
        for a in range(n):
            M[a, a] += P[a]
            off[a] /= scale[a]
        in_units(M, scale)
        if eliminate(M, off) == -math.inf:
            return False
        for a in range(n):
            off[a] /= scale[a]
            end.u[a] += off[a]
        length = squared_length(start.L, off)
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
    M: _Floats,
) -> bool:
    """Return whether the step from there that should end here does."""
    n = here.u.shape[0]
    _times_difference(there.B, here.f, there.f, goal)
    for a in range(n):
        goal[a] += P[a] * (here.u[a] - there.u[a])
    solve_factored(there.L, goal, work)
    for a in range(n):
        again.u[a] = there.u[a] + work[a]
    again.added[:] = there.added
    if not _follow(scene, prior, sticky, loss, there, P, goal, again, desk, x, v, off, work, M):
        return False
    for a in range(n):
        off[a] = again.u[a] - here.u[a]
    return squared_length(here.L, off) < _SAME


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
    M = np.zeros((n, n))
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
        solve_factored(here.L, here.g, step)
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
        if _follow(scene, prior, sticky, loss, here, P, goal, there, desk, x_now, v_now, off, work, M):
            candidate = _look(scene, prior, sticky, loss, there, desk, x_now, v_now, P_there)
        if candidate > -math.inf:
            forward = _log_step(scene, here, there, stride, P, work, step, M)
            back = _log_step(scene, there, here, stride, P_there, work, step, M)
            wanted = math.log(max(uniforms[i], 1e-300)) < candidate - value + back - forward
            # a step that does not lead back the same way would be taken too often
            if wanted and _leads_back(
                scene,
                prior,
                sticky,
                loss,
                here,
                there,
                P_there,
                again,
                desk,
                x_now,
                v_now,
                work,
                off,
                goal,
                M,
            ):
                _copy(there, here)
                P[:] = P_there
                value = candidate
                accepted += 1
        _spread_out(here.u, x[i], v[i])
        f[i] = here.f
    x0[:], v0[:] = x[-1], v[-1]
    return float(accepted / x.shape[0])
