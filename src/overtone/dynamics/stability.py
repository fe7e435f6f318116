"""Whether a motion stays in a state: Floquet multipliers, from time integration beside it."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from overtone.blocks import run_blocks
from overtone.dynamics import integrate
from overtone.dynamics.balance import FOUND, LOWEST
from overtone.dynamics.states import Motions
from overtone.dynamics.system import Laws, Setup
from overtone.dynamics.transient import Motion, contacts_of, lever_of, motion_under

_BLOCK = 8
_TOLERANCE = 1e-10  # of the integration, in units of the free amplitude
_MARGIN = 1e-7  # a multiplier this near to one is one: a state on a fold

_Floats = npt.NDArray[np.float64]
_Complex = npt.NDArray[np.complex128]


def motion_in(device: Setup, laws: Laws, states: Motions, points: npt.NDArray[np.intp]) -> Motion:
    """Return states as they are where the drive is largest, deflection and velocity of every mode.

    Parameters
    ----------
    device, laws
        Probe and sample.
    states : Motions, flat
        As the balance found them.
    points : array (state,)
        Which law each of them is under.
    """
    n = np.arange(states.f.shape[-1])
    phi = states.x[:, 2]
    force = states.f * np.exp(-1j * phi[:, None] * n)
    # the gap there, to tell whether a contact that was made still holds
    higher = np.real(states.b[:, 2:] * np.exp(-1j * phi[:, None] * n[2:])).sum(axis=1)
    gap = states.x[:, 0] + states.x[:, 1] * np.cos(phi) + higher
    held = (states.extras[:, LOWEST] < laws.made[points]) & (gap < laws.lost[points])
    return motion_under(device.probe, force, held)


def floquet(device: Setup, laws: Laws, states: Motions) -> _Floats:
    """Return the size of the largest Floquet multiplier of every state, NaN where there is no state.

    Parameters
    ----------
    device, laws
        Probe and sample.
    states : Motions (point, ...)
        The law of each is that of its point.

    Returns
    -------
    array (point, ...)
        Below 1 a disturbance dies out.
    """
    largest = np.full(states.status.shape, np.nan)
    found = np.argwhere(states.status == FOUND)
    if not len(found):
        return largest
    where = tuple(found.T)
    some, points = states.at(where), where[0]
    lever = lever_of(device.probe)
    contacts = contacts_of(laws.only(points), lever.length)
    motion = motion_in(device, laws, some, points)
    state = np.ascontiguousarray(np.concatenate([motion.deflection, motion.velocity], axis=1) / lever.length)
    mode = np.stack([np.full(len(found), -1), motion.held.astype(np.int64)], axis=1)
    size = state.shape[1]
    jacobian, status = np.zeros((len(found), size, size)), np.zeros(len(found), np.int8)

    def block(part: slice) -> None:
        arrays: Any = (array[part] for array in contacts)
        here = integrate.Contacts(*arrays)
        heights = np.ascontiguousarray(some.x[part, 3] / lever.length)
        integrate.tangent_block(
            lever, here, heights, state[part], mode[part], _TOLERANCE, jacobian[part], status[part]
        )

    run_blocks(block, len(found), _BLOCK)
    size_of = np.abs(np.linalg.eigvals(jacobian)).max(axis=-1)
    largest[where] = np.where(status == integrate.DONE, size_of, np.nan)
    return largest


def is_stable(device: Setup, laws: Laws, states: Motions) -> npt.NDArray[np.bool_]:
    """Return whether a disturbance of a state dies out; False where there is no state."""
    with np.errstate(invalid="ignore"):
        return np.asarray(floquet(device, laws, states) < 1.0 - _MARGIN)
