"""States at an amplitude that a feedback loop holds: one a material, for whole scans."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt
import xarray as xr

from overtone import provenance
from overtone.blocks import run_blocks
from overtone.contact.bare import bare_harmonics, has_closed_form
from overtone.contact.law import Law
from overtone.contact.sample import Sample
from overtone.dynamics.balance import (
    FOUND,
    HOLD_AMPLITUDE,
    LOWEST,
    NO_STATE,
    NOT_CONVERGED,
    Lever,
    Motion,
    Sums,
    balance,
    force_on_motion,
)
from overtone.dynamics.manifold import bare_force, sheet
from overtone.dynamics.states import Motions, sample_dims, states_dataset
from overtone.dynamics.steady import check_orders
from overtone.dynamics.system import Laws, law_at, laws, setup
from overtone.errors import OvertoneError
from overtone.kernels import inner, kernel
from overtone.probe import Probe, format_probe

_BLOCK = 256
_STEP = 0.5  # the search comes from deep in contact, or from far, in such steps
_OUTER_STEP = 0.85  # a finer one: attractive states come in pairs
_BOTTOMLESS = 1e4  # of the amplitude
_DEEPEST, _FARTHEST, _SHALLOWEST = 1.98, 2.0, 1e-6  # of the amplitude
_LEFT = 1e-6  # of the drive
_STEPS = 60
_REGIMES = ("repulsive", "attractive")

_Floats = npt.NDArray[np.float64]
_Complex = npt.NDArray[np.complex128]


@inner
def _off_sheet(
    law: Law,
    lever: Lever,
    amplitude: float,
    closest: float,
    way: float,
    f: _Complex,
    work: _Floats,
) -> float:
    """Return how far a bare cosine is from balance with the drive before (1) or behind (-1) the tip [N]."""
    bare_force(law, amplitude, closest, lever.omega, f, work)
    return sheet(amplitude, f, lever.tip[1], lever.force, way)[0]


@inner
def find_bare(
    law: Law,
    lever: Lever,
    amplitude: float,
    deepest: bool,
    f: _Complex,
    work: _Floats,
) -> tuple[float, int]:
    """Return the closest gap of a bare cosine in balance, the deepest or the outermost, and a status."""
    way = 1.0 if deepest else -1.0
    # from deep in contact upwards, or from far away through the first touch, until the balance turns
    low = (-_DEEPEST if deepest else _FARTHEST) * amplitude
    at_low = way * _off_sheet(law, lever, amplitude, low, way, f, work)
    while deepest and at_low <= 0.0 and low > -_BOTTOMLESS * amplitude:  # held in permanent contact
        low *= 2.0
        at_low = way * _off_sheet(law, lever, amplitude, low, way, f, work)
    step = _STEP if deepest else _OUTER_STEP
    high, at_high = low, at_low
    while (at_high > 0.0) == (at_low > 0.0):
        low, at_low = high, at_high
        if deepest or low > _SHALLOWEST * amplitude:
            high = step * low
        elif low > 0.0:
            high = -low
        else:
            high = low / step
        if abs(high) < _SHALLOWEST * amplitude * step or (not deepest and high < -_DEEPEST * amplitude):
            return math.nan, NO_STATE
        at_high = way * _off_sheet(law, lever, amplitude, high, way, f, work)
    side, middle = 0, 0.5 * (low + high)
    value = math.inf
    for k in range(_STEPS):
        middle = (low * at_high - high * at_low) / (at_high - at_low) if k % 5 != 4 else 0.5 * (low + high)
        value = way * _off_sheet(law, lever, amplitude, middle, way, f, work)
        if abs(value) < 1e-11 * lever.force or abs(high - low) < 1e-15 * amplitude:
            break
        if (value > 0.0) == (at_high > 0.0):
            high, at_high = middle, value
            if side == 1:
                at_low *= 0.5
            side = 1
        else:
            low, at_low = middle, value
            if side == -1:
                at_high *= 0.5
            side = -1
    if not abs(abs(amplitude / lever.tip[1] - f[1]) - lever.force) < _LEFT * lever.force:
        return math.nan, NO_STATE  # a jump of the force, or more loss than the drive can feed
    return middle, FOUND


@kernel
def hold_block(
    amplitude: _Floats,
    read: _Floats,
    deepest: bool,
    refine: bool,
    lever: Lever,
    laws: Laws,
    x: _Floats,
    f: _Complex,
    extras: _Floats,
    status: npt.NDArray[np.int8],
) -> None:
    """Fill the state of every point at its amplitude: bare, or with every harmonic where ``refine``."""
    first, work = np.empty(2, np.complex128), np.empty((4, f.shape[1]))
    b, held = np.empty(f.shape[1], np.complex128), np.array([HOLD_AMPLITUDE, 0.0, 0.0, 0.0])
    none, turns = np.empty(0, np.complex128), np.empty(f.shape[1], np.complex128)
    for i in range(amplitude.shape[0]):
        A, law = amplitude[i], law_at(laws, i)
        closest, status[i] = find_bare(law, lever, A, deepest, first, work)
        if status[i] != FOUND:
            continue
        needed = A / lever.tip[1] - first[1]
        x[i, 0], x[i, 1], x[i, 2] = closest + A, A, math.atan2(needed.imag, needed.real)
        x[i, 3] = x[i, 0] - lever.tip[0].real * first[0].real
        b[:] = 0.0
        if refine:
            held[1] = read[i]
            status[i], _, _ = balance(x[i], b, held, lever, law, f[i], extras[i])
            if status[i] == FOUND and (f[i, 1].real < 0.0) != deepest:
                status[i] = NOT_CONVERGED
        elif has_closed_form(law.table):
            bare_harmonics(law.table, A, -closest, lever.omega, f[i], work)
            extras[i, LOWEST] = closest
        else:
            force_on_motion(Motion(x[i, 0], A, b), lever.omega, law, Sums(f[i], none, none, extras[i], turns))


def hold_amplitude(
    probe: Probe,
    sample: Sample,
    *,
    setpoint: Any,
    regime: str = "repulsive",
    n_max: int = 10,
    keep: int = 3,
    dims: tuple[str, ...] | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> xr.Dataset:
    """Return the steady state at a fixed amplitude, as a feedback loop holds it.

    Parameters
    ----------
    probe : Probe
        Any number of modes, any drive frequency, driven at tip or base.
    sample : Sample
        A material of any model that can be simulated, or arrays of materials.
    setpoint : float, array (setpoint,) or DataArray
        A1 / A1far, between 0 and 1. An array adds a first dimension ``setpoint``; a DataArray over the dimensions
        of the sample (named by ``dims``) gives each point its own, as a feedback loop with an error does, and its
        coordinates.
    regime : str
        ``repulsive`` takes the state of largest indentation, ``attractive`` the outermost one.
    n_max : int
        Harmonics of the motion that act back on the force; 10 gives A2 to 5e-5, 20 to 2e-6. With 1 the motion
        is a bare cosine, as in eq 10: a few per cent off, and a hundred times faster.
    keep : int
        Harmonics in the result.
    dims : tuple of str, optional
        Dimension names of the sample's arrays; ``("y", "x")`` for two dimensions unless given.
    progress : callable, optional
        Called with (states done, states in all).

    Returns
    -------
    Dataset
        As `steady_states` has it, without ``stable``: observables as the detector reads them, ``F_cons`` and
        ``F_diss`` [N], ``Z`` and ``indentation`` [m], forces, energies and ``state``. A state that is not found
        is NaN. With ``n_max=1`` contact time, peak forces and ``dissipation`` are NaN for laws in closed form.

    Raises
    ------
    OvertoneError
        If a set-point is not between 0 and 1, set-points do not fit the sample, or n_max or keep are out of range.
    ContactModelError
        If the model's force cannot be followed (a relaxing solid).
    ProbeError
        If the probe has no tip radius.

    Notes
    -----
    Whether a feedback loop can stay in the state is not asked: see `steady_states` for all states at a height
    and their stability.
    """
    names = sample_dims(sample.shape, dims)
    each = isinstance(setpoint, xr.DataArray) and bool(names) and set(setpoint.dims) == set(names)
    if each:
        setpoint = setpoint.transpose(*names)
    try:
        setpoints = np.atleast_1d(np.asarray(setpoint, dtype=float))
    except (TypeError, ValueError) as error:
        raise OvertoneError(
            "the set-point is not a number", expected="A1/A1far", got=repr(setpoint)
        ) from error
    if setpoints.shape != sample.shape if each else setpoints.ndim != 1:
        raise OvertoneError(
            "set-points and sample do not fit",
            expected="a number, an array of one dimension, or a DataArray over "
            f"{dict(zip(names, sample.shape, strict=True))}",
            got=str(dict(setpoint.sizes) if isinstance(setpoint, xr.DataArray) else setpoints.shape),
        )
    usable = (setpoints > 0.0) & (setpoints < 1.0)
    if setpoints.size == 0 or not usable.all():
        bad = setpoints[~usable]
        raise OvertoneError(
            "the set-point is out of reach",
            expected="0 < A1/A1far < 1",
            got=", ".join(map(str, bad[:3])) or "none",
        )
    if regime not in _REGIMES:
        raise OvertoneError("unknown regime", expected=" or ".join(_REGIMES), got=repr(regime))
    check_orders(n_max, keep)
    all_laws = laws(probe, sample)
    device = setup(probe, max(n_max, keep))
    points = all_laws.table.shape[0]
    read = (setpoints.ravel() if each else np.repeat(setpoints, points)) * probe.drive.free_amplitude
    amplitude = read / abs(device.lever.reading[0])
    states = Motions.missing((read.size,), device.lever.tip.size)

    def block(part: slice) -> None:
        law = all_laws.only(np.arange(part.start, part.stop) % points)
        x, _, f, extras, status = states.at(part)
        where = amplitude[part], read[part]
        hold_block(*where, regime == "repulsive", n_max > 1, device.lever, law, x, f, extras, status)

    run_blocks(block, read.size, _BLOCK if n_max > 1 else 64 * _BLOCK, progress)
    if each:
        own = {str(name): c for name, c in setpoint.coords.items() if c.dims and set(c.dims) <= set(names)}
        result = states_dataset(device, states.reshaped(sample.shape), names, own, keep)
    else:
        coords = {"setpoint": ("setpoint", setpoints, {"units": "1", "long_name": "A1 / A1far"})}
        wide = states.reshaped((setpoints.size, *sample.shape))
        result = states_dataset(device, wide, ("setpoint", *names), coords, keep)
    if np.ndim(setpoint) == 0:
        result = result.isel(setpoint=0, drop=True)
    return provenance.record(
        result,
        "hold_amplitude",
        probe=format_probe(probe),
        model=sample.model.key,
        setpoint="one a point" if each else setpoints.tolist() if np.ndim(setpoint) else float(setpoint),
        n_max=n_max,
        regime=regime,
    )
