"""Along a branch of steady states: to where the height turns, and to a height."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from overtone.contact.law import Law
from overtone.dynamics.balance import FOUND, HOLD_HEIGHT, HOLD_LINE, NO_STATE, NOT_CONVERGED, Lever, balance
from overtone.kernels import inner, kernel

_SHORTEST = 1e-8  # step, of the free amplitude
_FLAT = 1e-8  # of the free amplitude: a height that changes by less is that of the fold

_Floats = npt.NDArray[np.float64]
_Complex = npt.NDArray[np.complex128]


@inner
def _step_along(
    x: _Floats,
    b: _Complex,
    along: _Floats,
    length: float,
    lever: Lever,
    law: Law,
    f: _Complex,
    extras: _Floats,
) -> int:
    """Move a state by a length [m] along a direction in (g, A), in place; return a status."""
    held = np.array([HOLD_LINE, along[0], along[1], along[0] * x[0] + along[1] * x[1] + length])
    x[0] += length * along[0]
    x[1] += length * along[1]
    status, _, _ = balance(x, b, held, lever, law, f, extras)
    return status


@inner
def _enclose_fold(
    states: _Floats,
    motions: _Complex,
    along: _Floats,
    step: float,
    way: float,
    lever: Lever,
    law: Law,
    f: _Complex,
    extras: _Floats,
) -> int:
    """Step along a branch from the first state until ``way Z`` rises again; leave the last three states."""
    unit = abs(lever.tip[1]) * lever.force
    known, last = 1, 0
    state, motion = states[0].copy(), motions[0].copy()
    for _ in range(80):
        state[:], motion[:] = states[last], motions[last]
        status = _step_along(state, motion, along, step, lever, law, f, extras)
        moved = math.hypot(state[0] - states[last, 0], state[1] - states[last, 1])
        if status != FOUND or moved > 2.0 * step:
            step *= 0.5
            if step < _SHORTEST * unit:
                return NOT_CONVERGED
            continue
        rises = way * (state[3] - states[last, 3]) > 0.0
        if rises and known == 1:  # beyond the fold at once: come nearer
            step *= 0.5
            if step < _SHORTEST * unit:
                return NOT_CONVERGED
            continue
        if rises:
            states[2], motions[2] = state, motion
            return FOUND
        if known == 2:
            states[0], motions[0] = states[1], motions[1]
        known, last = 2, 1
        states[1], motions[1] = state, motion
        along[0], along[1] = (states[1, 0] - states[0, 0]) / moved, (states[1, 1] - states[0, 1]) / moved
        step *= 1.3
    return NOT_CONVERGED


@kernel
def find_fold(
    x: _Floats,
    b: _Complex,
    along: _Floats,
    step: float,
    highest: bool,
    lever: Lever,
    law: Law,
    f: _Complex,
    extras: _Floats,
) -> int:
    """Move a state along its branch to where the height turns, in place; return a status.

    Parameters
    ----------
    x, b : arrays
        A state before the fold, as `balance` has it.
    along : array (2,)
        Direction towards it in (g, A), of length one.
    step : float
        First step along the branch [m].
    highest : bool
        Whether the fold is a highest or a lowest height.
    """
    unit = abs(lever.tip[1]) * lever.force
    way = -1.0 if highest else 1.0
    states, motions = np.empty((3, 4)), np.empty((3, b.shape[0]), np.complex128)
    states[0], motions[0] = x, b
    line = along.copy()
    status = _enclose_fold(states, motions, line, step, way, lever, law, f, extras)
    if status != FOUND:
        return status
    line[0], line[1] = states[2, 0] - states[0, 0], states[2, 1] - states[0, 1]
    line /= math.hypot(line[0], line[1])
    places, values = np.empty(3), np.empty(3)
    for i in range(3):
        places[i] = line[0] * states[i, 0] + line[1] * states[i, 1]
        values[i] = way * states[i, 3]
    for _ in range(60):
        left, right = places[1] - places[0], places[2] - places[1]
        if not (left > 0.0 and right > 0.0):
            return NOT_CONVERGED
        rise_left, rise_right = values[0] - values[1], values[2] - values[1]
        bend = rise_left * right + rise_right * left
        shift = 0.5 * (rise_left * right * right - rise_right * left * left) / bend if bend > 0.0 else 0.0
        nearest = 0.01 * min(left, right)
        if abs(shift) < nearest:  # a probe beside the minimum, on the longer side, closes it in
            shift = nearest if right > left else -nearest
        shift = min(max(shift, -0.9 * left), 0.9 * right)
        state, motion = states[1].copy(), motions[1].copy()
        status = _step_along(state, motion, line, shift, lever, law, f, extras)
        if status == NOT_CONVERGED:
            return status
        value, place = way * state[3], places[1] + shift
        settled = abs(value - values[1]) < _FLAT * unit
        side = 1
        if value <= values[1]:
            other = 0 if shift > 0.0 else 2
            states[other], motions[other] = states[1], motions[1]
            values[other], places[other] = values[1], places[1]
        else:
            side = 0 if shift < 0.0 else 2
        states[side], motions[side], values[side], places[side] = state, motion, value, place
        if settled:
            break
    x[:], b[:] = states[1], motions[1]
    return FOUND


@kernel
def walk_to_height(
    x: _Floats,
    b: _Complex,
    along: _Floats,
    length: float,
    height: float,
    lever: Lever,
    law: Law,
    f: _Complex,
    extras: _Floats,
) -> tuple[int, float]:
    """Move a state along its branch to a height, in place; return a status and the sign of the determinant.

    Parameters
    ----------
    along : array (2,)
        Direction in (g, A) to go, of length one.
    length : float
        How far the state is about to be [m].
    """
    held = np.array([HOLD_LINE, along[0], along[1], 0.0])
    place = along[0] * x[0] + along[1] * x[1]
    before, step = x[3] - height, length / 8.0
    state, motion = x.copy(), b.copy()
    start = place
    enclosed = before == 0.0
    for _ in range(80):
        held[3] = place + step
        state[:], motion[:] = x, b
        status, _, _ = balance(state, motion, held, lever, law, f, extras)
        if status != FOUND:
            step *= 0.5
            if abs(step) < 1e-6 * length:
                return NOT_CONVERGED, 0.0
            continue
        after = state[3] - height
        if (after > 0.0) != (before > 0.0):
            enclosed = True
            break
        x[:], b[:] = state, motion
        place, before = held[3], after
        if abs(place - start) > 3.0 * length:
            return NO_STATE, 0.0
    if not enclosed:
        return NO_STATE, 0.0
    # from both sides by the secant, halved where it creeps
    low, at_low, high, at_high = place, before, held[3], state[3] - height
    for k in range(60):
        middle = 0.5 * (low + high)
        if k % 3 and at_high != at_low:
            middle = (low * at_high - high * at_low) / (at_high - at_low)
        held[3] = middle
        state[:], motion[:] = x, b
        status, _, _ = balance(state, motion, held, lever, law, f, extras)
        if status != FOUND:
            return NOT_CONVERGED, 0.0
        value = state[3] - height
        if (value > 0.0) == (at_low > 0.0):
            low, at_low = middle, value
            x[:], b[:] = state, motion
        else:
            high, at_high = middle, value
        if abs(value) < 1e-6 * length or abs(high - low) < 1e-13 * length:
            break
    x[:], b[:] = state, motion
    held[0], held[1] = HOLD_HEIGHT, height
    status, sign, _ = balance(x, b, held, lever, law, f, extras)
    return status, sign
