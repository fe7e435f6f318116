"""Along a branch of steady states: to where the height turns, and to a height."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from overtone.contact.law import Law
from overtone.dynamics.balance import FOUND, HOLD_HEIGHT, HOLD_LINE, NO_STATE, NOT_CONVERGED, Lever, balance
from overtone.kernels import kernel

_Floats = npt.NDArray[np.float64]
_Complex = npt.NDArray[np.complex128]


@kernel
def find_fold(
    x: _Floats,
    b: _Complex,
    across: _Floats,
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
        A state next to the fold, as `balance` has it.
    across : array (2,)
        Direction of the branch in (g, A), of length one: what is held is the distance along it.
    step : float
        First step along the branch [m]; negative goes back.
    highest : bool
        Whether the fold is a highest or a lowest height.
    """
    held = np.array([HOLD_LINE, across[0], across[1], 0.0])
    way = -1.0 if highest else 1.0
    places, values = np.empty(3), np.empty(3)
    states, motions = np.empty((3, 4)), np.empty((3, b.shape[0]), np.complex128)
    place = across[0] * x[0] + across[1] * x[1]
    states[1], motions[1] = x, b
    size = abs(step)
    for k in range(3):  # the middle first, then both sides from it
        i = (1, 0, 2)[k]
        states[i], motions[i] = states[1], motions[1]
        places[i] = place + (i - 1) * size
        held[3] = places[i]
        status, _, _ = balance(states[i], motions[i], held, lever, law, f, extras)
        if status == NOT_CONVERGED:
            return status
        values[i] = way * states[i, 3]
    for _ in range(60):
        low = int(np.argmin(values))
        if low != 1:  # not enclosed yet: go on downhill
            outer, other = low, 2 - low
            states[other], motions[other], values[other], places[other] = (
                states[1], motions[1], values[1], places[1],
            )  # fmt: skip
            states[1], motions[1], values[1], places[1] = (
                states[outer], motions[outer], values[outer], places[outer],
            )  # fmt: skip
            target, slot = places[1] + (places[1] - places[other]) * 1.5, outer
        else:
            left, right = places[1] - places[0], places[2] - places[1]
            if max(left, right) < 1e-6 * size:
                break
            rise_left, rise_right = values[0] - values[1], values[2] - values[1]
            bend = rise_left * right + rise_right * left
            shift = 0.5 * (rise_left * right * right - rise_right * left * left) / bend if bend > 0.0 else 0.0
            nearest = 0.01 * min(left, right)
            if abs(shift) < nearest:  # a probe beside the minimum, on the longer side, closes it in
                shift = nearest if right > left else -nearest
            shift = min(max(shift, -0.9 * left), 0.9 * right)
            target, slot = places[1] + shift, -1
        held[3] = target
        state, motion = states[1].copy(), motions[1].copy()
        status, _, _ = balance(state, motion, held, lever, law, f, extras)
        if status == NOT_CONVERGED:
            return status
        value = way * state[3]
        if slot >= 0:
            states[slot], motions[slot], values[slot], places[slot] = state, motion, value, target
            continue
        if value <= values[1]:
            side = 0 if target > places[1] else 2
            states[side], motions[side], values[side], places[side] = (
                states[1], motions[1], values[1], places[1],
            )  # fmt: skip
            side = 1
        else:
            side = 0 if target < places[1] else 2
        settled = abs(value - values[1]) < 1e-9 * abs(value) * 1e-3 and side == 1
        states[side], motions[side], values[side], places[side] = state, motion, value, target
        if settled:
            break
    x[:], b[:] = states[1], motions[1]
    held[3] = places[1]
    status, _, _ = balance(x, b, held, lever, law, f, extras)
    return status


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
