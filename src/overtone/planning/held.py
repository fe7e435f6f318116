"""States that a feedback would hold, and whether it could: stable, with an amplitude that rises with the height."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import xarray as xr

from overtone.contact.sample import Sample
from overtone.dynamics.balance import FOUND, MANY_TOUCHES, NO_STATE
from overtone.dynamics.hold import hold_amplitude
from overtone.dynamics.steady import steady_states
from overtone.probe import Probe

_Floats = npt.NDArray[np.float64]
_Flags = npt.NDArray[np.bool_]

USABLE, NO_REPULSIVE, LOST, TOUCHES, UNSTABLE, FALLING, UNTOLD = range(7)
REASONS = {
    USABLE: "none",
    NO_REPULSIVE: "no_repulsive_state",
    LOST: "state_not_found",
    TOUCHES: "touches_more_than_once",
    UNSTABLE: "not_stable",
    FALLING: "amplitude_falls_with_height",
    UNTOLD: "stability_not_told",
}
"""Why a feedback cannot hold a repulsive state at a set-point; the first three leave no state at all."""

_ORDERS = 10  # harmonics of the motion that act back on the force
_SAME = 1e-4  # of the free amplitude: two states nearer than this are one
_STEP = 1e-3  # of the set-point or what is left of 1


def held_states(probe: Probe, sample: Sample, setpoints: _Floats, keep: int) -> xr.Dataset:
    """Return the repulsive state at every set-point, with what a feedback makes of it.

    Parameters
    ----------
    probe : Probe
        At its free amplitude.
    sample : Sample
        One material.
    setpoints : array (setpoint,)
        A1 / A1far, rising.
    keep : int
        Harmonics in the result.

    Returns
    -------
    Dataset
        As `overtone.hold_amplitude` has it, with ``stable``, ``bistable`` (a stable attractive state has the same
        set-point) and ``reason``, a key of `REASONS`.

    Raises
    ------
    OvertoneError, ContactModelError, ProbeError
        As `overtone.hold_amplitude` raises them.
    """
    orders = max(_ORDERS, keep)
    arguments: dict[str, Any] = {"n_max": orders, "keep": keep}
    held = hold_amplitude(probe, sample, setpoint=setpoints, **arguments)
    outer = hold_amplitude(probe, sample, setpoint=setpoints, regime="attractive", **arguments)
    Z = np.concatenate([held["Z"].values, outer["Z"].values])
    heights = np.unique(Z[np.isfinite(Z)])
    told = stable = np.zeros((2, setpoints.size), bool)
    if heights.size:
        states = steady_states(probe, sample, z=heights, **arguments)
        free = probe.drive.free_amplitude
        told, stable = np.swapaxes([_matched(states, one, free) for one in (held, outer)], 0, 1)
    reason = np.full(setpoints.size, USABLE, np.int8)
    reason[~stable[0]] = UNSTABLE
    reason[~told[0]] = UNTOLD
    reason[(reason == USABLE) & ~_rises(probe, sample, setpoints, orders)] = FALLING
    state = held["state"].values
    reason[state != FOUND] = LOST
    reason[state == MANY_TOUCHES] = TOUCHES
    reason[state == NO_STATE] = NO_REPULSIVE
    flags = {"flag_values": np.array(list(REASONS), np.int8), "flag_meanings": " ".join(REASONS.values())}
    usable = reason == USABLE
    return held.assign(
        stable=(
            "setpoint",
            usable,
            _attributes("whether a feedback holds it: stable, with an amplitude that rises with the height"),
        ),
        bistable=(
            "setpoint",
            usable & stable[1],
            _attributes("whether a stable attractive state has the same set-point"),
        ),
        reason=("setpoint", reason, _attributes("why a feedback cannot hold a repulsive state") | flags),
    )


def _attributes(meaning: str) -> dict[str, Any]:
    return {"units": "1", "long_name": meaning}


def _matched(states: xr.Dataset, held: xr.Dataset, free: float) -> tuple[_Flags, _Flags]:
    """Return for each held state whether it is among the states at its height, and whether it is stable."""
    size = held.sizes["setpoint"]
    told, stable = np.zeros(size, bool), np.zeros(size, bool)
    found = np.flatnonzero(np.isfinite(held["Z"].values))
    rows = np.searchsorted(states["z"].values, held["Z"].values[found])
    at = states[["A1", "indentation", "stable"]].transpose("z", "branch")
    off = np.zeros((found.size, states.sizes["branch"]))
    for name in ("A1", "indentation"):
        off = np.maximum(off, np.abs(at[name].values[rows] - held[name].values[found, None]))
    off = np.where(np.isfinite(off), off, np.inf)
    nearest = np.argmin(off, axis=1)
    here = np.arange(found.size)
    told[found] = off[here, nearest] < _SAME * free
    stable[found] = told[found] & at["stable"].values[rows][here, nearest]
    return told, stable


def _rises(probe: Probe, sample: Sample, setpoints: _Floats, orders: int) -> _Flags:
    """Return where the height rises with the amplitude along the branch: a feedback has the right sign there only."""
    step = _STEP * np.minimum(setpoints, 1.0 - setpoints)
    around = np.concatenate([setpoints - step, setpoints, setpoints + step])
    Z = hold_amplitude(probe, sample, setpoint=around, n_max=orders)["Z"].values.reshape(3, -1)
    with np.errstate(invalid="ignore"):
        step = np.diff(Z, axis=0)
        # next to an end of the branch one side is enough
        return np.asarray((step > 0.0).any(axis=0) & ~(step < 0.0).any(axis=0))
