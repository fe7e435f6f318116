"""States of motion as datasets: what the detector reads of them, and what the contact feels."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import xarray as xr

from overtone.dynamics.balance import (
    CONTACT,
    EXTRAS,
    FOUND,
    LOWEST,
    MANY_TOUCHES,
    NO_STATE,
    NOT_CONVERGED,
    PEAK,
    PULL,
    WORK,
)
from overtone.dynamics.system import Setup
from overtone.errors import OvertoneError
from overtone.harmonics import far_phase
from overtone.quantities import named_variable

_Floats = npt.NDArray[np.float64]
_Complex = npt.NDArray[np.complex128]

_TAKEN = ("z", "branch", "direction", "setpoint", "harmonic", "probe")

STATE_FLAGS = {
    "flag_values": [FOUND, NO_STATE, NOT_CONVERGED, MANY_TOUCHES],
    "flag_meanings": "found no_state not_converged touches_more_than_once",
}


class Motions(NamedTuple):
    """States as the balance leaves them, of any shape (..., own axis)."""

    x: _Floats
    """(..., 4): mean gap g [m], tip amplitude A [m], phase of the drive before the tip [rad], height Z [m]."""
    b: _Complex
    """(..., n): harmonics of the motion [m]; 0 and 1 are in x."""
    f: _Complex
    """(..., n): harmonics of the force, CONS_n - i DISS_n [N]."""
    extras: _Floats
    """(..., EXTRAS): see `overtone.dynamics.balance.balance`."""
    status: npt.NDArray[np.int8]
    """(...)."""

    @classmethod
    def missing(cls, shape: Sequence[int], orders: int) -> Motions:
        """Return states of a shape that are not there yet."""
        wide = tuple(shape)
        return cls(
            np.full((*wide, 4), np.nan),
            np.zeros((*wide, orders), complex),
            np.full((*wide, orders), np.nan, complex),
            np.full((*wide, EXTRAS), np.nan),
            np.full(wide, NO_STATE, np.int8),
        )

    def reshaped(self, shape: Sequence[int]) -> Motions:
        """Return the states in another shape."""
        axes = len(self.status.shape)
        arrays: Any = (array.reshape(*shape, *array.shape[axes:]) for array in self)
        return Motions(*arrays)

    def at(self, where: Any) -> Motions:
        """Return some of the states."""
        arrays: Any = (array[where] for array in self)
        return Motions(*arrays)

    def put(self, where: Any, states: Motions) -> None:
        """Set some of the states, in place."""
        self.x[where], self.b[where], self.f[where] = states.x, states.b, states.f
        self.extras[where], self.status[where] = states.extras, states.status


def sample_dims(shape: Sequence[int], dims: Sequence[str] | None) -> tuple[str, ...]:
    """Return names for the dimensions of a sample's arrays.

    Raises
    ------
    OvertoneError
        If there are not as many names as dimensions, or one is taken.
    """
    names = tuple(dims or (("y", "x") if len(shape) == 2 else (f"dim_{i}" for i in range(len(shape)))))
    if len(names) != len(shape) or len({*names, *_TAKEN}) != len(names) + len(_TAKEN):
        raise OvertoneError(
            "names of dimensions do not fit",
            expected=f"{len(shape)} different names, none of {', '.join(_TAKEN)}",
            got=str(names),
        )
    return names


def states_dataset(
    setup: Setup, states: Motions, dims: Sequence[str], coords: Mapping[str, Any], keep: int
) -> xr.Dataset:
    """Return states of the balance as a dataset.

    Parameters
    ----------
    setup : Setup
        The probe.
    states : Motions
        With the shape of ``dims``.
    dims, coords
        Names and coordinates of the dimensions.
    keep : int
        Highest harmonic of the observables.

    Returns
    -------
    Dataset
        NaN where ``state`` is not ``found``.
    """
    probe, receptance, drive, lever = setup
    x, _, f, extras, status = states
    lost = status != FOUND
    phi = x[..., 2]
    amplitude = x[..., 1]
    turn = np.exp(1j * phi)
    read = lever.reading[0] * amplitude + lever.reading[1] * turn
    frame = np.angle(read)
    phase = (far_phase(probe) + np.angle(drive.reading * turn) - frame) % (2.0 * math.pi)
    # harmonics counted from the phase of what is read, as they are measured
    orders = np.arange(f.shape[-1])
    forces = f * np.exp(-1j * frame[..., None] * orders)

    def named(name: str, values: Any) -> xr.Variable:
        return named_variable(name, np.where(lost, np.nan, values), dims)

    variables = {"A1": named("A1", np.abs(read)), "phi1": named("phi1", phase)}
    for n in range(min(keep, f.shape[-1] - 1) + 1):
        answer = receptance.read[n] * forces[..., n]
        if n == 0:
            variables["A0"] = named("A0", answer.real)
        elif n > 1:
            variables[f"A{n}"] = named(f"A{n}", np.abs(answer))
            variables[f"phi{n}"] = named(f"phi{n}", (n * phase - np.angle(answer)) % (2.0 * math.pi))
    kept = np.moveaxis(np.where(lost[..., None], np.nan, forces)[..., : keep + 1], -1, 0)
    for name, part in (("F_cons", kept.real), ("F_diss", -kept.imag)):
        variables[name] = named_variable(name, part, ("harmonic", *dims))
    variables["Z"] = named("Z", x[..., 3])
    variables["indentation"] = named("indentation", -extras[..., LOWEST])
    variables["contact_time"] = named("contact_time", extras[..., CONTACT])
    variables["peak_force"] = named("peak_force", extras[..., PEAK])
    variables["pull_force"] = named("pull_force", extras[..., PULL])
    variables["dissipation"] = named("dissipation", extras[..., WORK])
    variables["virial"] = named("virial", 0.5 * np.abs(read) * forces[..., 1].real)
    flags = {**STATE_FLAGS, "flag_values": np.array(STATE_FLAGS["flag_values"], np.int8)}
    variables["state"] = xr.Variable(dims, status, {"units": "1", "long_name": "what was found", **flags})
    along = {**coords, "harmonic": ("harmonic", orders[: len(kept)])}
    return xr.Dataset(variables, along, {"detector": probe.detector.kind})
