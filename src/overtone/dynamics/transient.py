"""Motion in time: states that the tip settles in, their stability, and slow sweeps of the base.

The equation of motion is integrated as it stands (`overtone.dynamics.integrate`), for any force law of gap,
velocity and one flag of hysteresis, any number of modes and any drive. It needs no assumption about the
motion, and is what the faster methods are checked against.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import xarray as xr

from overtone import provenance
from overtone.blocks import run_blocks
from overtone.contact.sample import Sample
from overtone.dynamics import integrate
from overtone.dynamics.integrate import Contacts, Lever
from overtone.dynamics.system import Excitation, Laws, excitation, laws, phase_offset, static_remainder
from overtone.errors import OvertoneError
from overtone.harmonics import read_receptance
from overtone.probe import DYNAMIC, SLOPE, STATIC, Probe, format_probe
from overtone.quantities import named_array

SHOOTING, RELAX = "shooting", "relax"
STATE_FLAGS = {
    "flag_values": [
        integrate.DONE,
        integrate.NOT_SETTLED,
        integrate.TOO_MANY_STEPS,
        integrate.STEP_TOO_SMALL,
        integrate.NOT_FINITE,
        integrate.CHATTER,
    ],
    "flag_meanings": "settled not_settled too_many_steps step_too_small not_finite chatter",
}

_MEMORIES = 60.0  # of the lever: how long it may take to settle; half of it is lost in a rough start
_SETTLED = 12.0  # memories after which a start is forgotten to a part in 10^5
_BLOCK = 4

_Floats = npt.NDArray[np.float64]
_Complex = npt.NDArray[np.complex128]
_Bytes = npt.NDArray[np.int8]


class Motion(NamedTuple):
    """States at the start of a period of the drive, as its equivalent force is largest (`Excitation`)."""

    deflection: _Floats
    """(..., mode): of the modes [m]."""
    velocity: _Floats
    """(..., mode): their derivative by theta = w t [m]."""
    held: npt.NDArray[np.bool_]
    """(...): whether a contact with hysteresis is held."""
    filtered: _Complex | None = None
    """(..., stage, 2 harmonic): the stages of a lock-in, [m] and [N]."""


def lever_of(probe: Probe) -> Lever:
    """Return the lever of a probe for compiled code, in units of the free amplitude."""
    cantilever, drive = probe.cantilever, probe.drive
    driven = excitation(probe)
    length = drive.free_amplitude
    r = np.array([mode.frequency for mode in cantilever.modes]) / drive.frequency
    Q = np.array([mode.quality_factor for mode in cantilever.modes])
    k = np.array([mode.stiffness for mode in cantilever.modes])
    push = r**2 * driven.modal / length
    slopes = [mode.slope_ratio if probe.detector.kind == SLOPE else 1.0 for mode in cantilever.modes]
    columns = [r**2, r / Q, r**2 / (k * length), push.real, push.imag, np.array(slopes)]
    compliance, reading = static_remainder(probe)
    return Lever(
        np.ascontiguousarray(np.stack(columns, axis=-1)),
        complex(driven.direct / length),
        complex(driven.direct_reading / length),
        float(compliance / length),
        float(reading / length),
        float(length),
        float(2.0 * math.pi * drive.frequency * length),
    )


def contacts_of(laws: Laws, length: float) -> Contacts:
    """Return force laws for compiled code, gaps in units of ``length`` [m]."""
    marks = np.full((laws.kinks.size, 4), -1, np.int64)
    marks[:, 0] = laws.kinks
    for column, gap in ((1, np.zeros(laws.kinks.size)), (2, laws.made), (3, laws.lost)):
        found = (laws.levels == gap[:, None]) & np.isfinite(gap)[:, None]
        marks[:, column] = np.where(found.any(axis=1), found.argmax(axis=1), -1)
    return Contacts(laws.table, laws.levels / length, marks)


def free_motion(probe: Probe, shape: tuple[int, ...] = ()) -> Motion:
    """Return the state far from the sample."""
    return motion_under(probe, np.zeros((*shape, 2), complex))


def motion_under(probe: Probe, force: _Complex, held: Any = False) -> Motion:
    """Return the periodic state of the lever under a periodic force.

    Parameters
    ----------
    probe : Probe
        The lever and its drive.
    force : complex array (..., harmonic)
        ``F = Re sum_n force_n exp(i n w t)`` [N], in the time of `Excitation`, n = 0, 1, ...
    held : bool or array (...)
        Whether a contact with hysteresis is held at the start of the period.
    """
    modes = probe.cantilever.modes
    force = np.asarray(force, complex)
    n = np.arange(force.shape[-1])
    r = np.array([mode.frequency for mode in modes])[:, None] / probe.drive.frequency
    Q = np.array([mode.quality_factor for mode in modes])[:, None]
    k = np.array([mode.stiffness for mode in modes])[:, None]
    source = force[..., None, :] / k
    if force.shape[-1] > 1:
        source[..., 1] += excitation(probe).modal
    q = source / (1.0 - (n / r) ** 2 + 1j * n / (r * Q))
    shape = force.shape[:-1]
    return Motion(
        q.sum(axis=-1).real,
        (1j * n * q).sum(axis=-1).real,
        np.broadcast_to(np.asarray(held, bool), shape).copy(),
    )


def motion_of(states: xr.Dataset) -> Motion:
    """Return the raw states that a dataset of `settle` holds, to start from."""
    parts = [states[name].transpose(..., "mode").values for name in ("q", "v")]
    return Motion(parts[0], parts[1], states["held"].values.astype(bool))


# --- arguments --------------------------------------------------------------------------------------------------


class _Points(NamedTuple):
    """Heights and force laws, one a point, flat."""

    Z: _Floats
    contacts: Contacts
    dims: tuple[str, ...]
    shape: tuple[int, ...]
    coords: dict[str, Any]


def _points(probe: Probe, sample: Sample, Z: Any) -> _Points:
    """Return heights against materials, broadcast.

    Raises
    ------
    OvertoneError
        If the shapes do not fit.
    """
    heights = np.asarray(Z, dtype=float)
    if not np.isfinite(heights).all():
        raise OvertoneError("heights of the base are not numbers", expected="finite Z in metres")
    try:
        shape = np.broadcast_shapes(heights.shape, sample.shape)
    except ValueError as error:
        raise OvertoneError(
            "heights and materials do not fit",
            expected=f"Z that broadcasts against the shape {sample.shape} of the sample",
            got=str(heights.shape),
        ) from error
    if isinstance(Z, xr.DataArray) and shape == heights.shape:
        dims = tuple(str(name) for name in Z.dims)
        coords = {str(name): values for name, values in Z.coords.items()}
    else:
        dims = {0: (), 1: ("Z",), 2: ("y", "x")}.get(len(shape), tuple(f"dim_{i}" for i in range(len(shape))))
        coords = {}
    records = laws(probe, sample)
    count = int(np.prod(sample.shape, dtype=int))
    index = np.broadcast_to(np.arange(count).reshape(sample.shape), shape).ravel()
    all_of = contacts_of(records, probe.drive.free_amplitude)
    chosen = _some(all_of, index)
    flat = np.ascontiguousarray(np.broadcast_to(heights, shape).ravel())
    return _Points(flat, chosen, dims, shape, coords)


def _some(contacts: Contacts, points: Any) -> Contacts:
    """Return the force laws of some points."""
    return Contacts(contacts.law[points], contacts.levels[points], contacts.marks[points])


def _raw(probe: Probe, start: Motion | None, shape: tuple[int, ...], length: float) -> tuple[_Floats, Any]:
    """Return states (point, 2 mode) and modes (point, 2) for compiled code.

    Raises
    ------
    OvertoneError
        If the start is of another lever or has another shape.
    """
    modes = len(probe.cantilever.modes)
    start = start if start is not None else free_motion(probe)
    try:
        q = np.broadcast_to(start.deflection, (*shape, modes))
        v = np.broadcast_to(start.velocity, (*shape, modes))
        held = np.broadcast_to(start.held, shape)
    except ValueError as error:
        raise OvertoneError(
            "the start does not fit",
            expected=f"states of {modes} modes that broadcast to the points {shape}",
            got=f"deflections of shape {np.shape(start.deflection)}",
        ) from error
    state = np.concatenate([q.reshape(-1, modes), v.reshape(-1, modes)], axis=1) / length
    mode = np.stack([np.full(held.size, -1), held.ravel().astype(np.int64)], axis=1)
    return np.ascontiguousarray(state), np.ascontiguousarray(mode)


def _motion(state: _Floats, mode: Any, shape: tuple[int, ...], length: float) -> Motion:
    """Return what compiled code left as states [m]."""
    q, v = (part.reshape(*shape, -1) * length for part in np.split(state, 2, axis=1))
    return Motion(q, v, (mode[:, 1] > 0).reshape(shape))


def _check_tolerance(tolerance: float) -> None:
    if not 1e-14 <= tolerance <= 1e-2:
        raise OvertoneError(
            "the tolerance is out of range",
            expected="1e-14 to 1e-2, the error of a step in units of the free amplitude",
            got=str(tolerance),
        )


# --- states -----------------------------------------------------------------------------------------------------


def settle(
    probe: Probe,
    sample: Sample,
    *,
    Z: Any,
    start: Motion | None = None,
    method: str = SHOOTING,
    tolerance: float = 1e-10,
    goal: float | None = None,
    n_max: int = 3,
    max_periods: int | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> xr.Dataset:
    """Return the periodic state that the tip settles in, with the base at rest.

    Parameters
    ----------
    probe : Probe
        Any number of modes, any drive.
    sample : Sample
        A material, or arrays of them against which Z broadcasts.
    Z : float or array
        Height of the base [m]; each is a case of its own.
    start : Motion, optional
        Where to start, for all points or for each; the free motion unless given. Where several states
        coexist it decides which one is found.
    method : str
        ``shooting`` follows the motion until Newton's method on the map of one period takes over, and follows
        it further where that leads far away or to a state that is not stable; ``relax`` only follows it.
    tolerance : float
        Error of a step of the integration, in units of the free amplitude.
    goal : float, optional
        How near to the periodic state is settled, in units of the free amplitude; the tolerance
        times the memory of the lever ``Q/pi`` unless given, which is what errors of steps may add up to.
    n_max : int
        Highest harmonic of the result.
    max_periods : int, optional
        After how many periods to give up; sixty memories ``Q/pi`` of the lever unless given.
    progress : callable, optional
        Called with (states done, states in all).

    Returns
    -------
    Dataset
        ``A0 .. A<n_max>`` and phases as the detector reads them, ``F_cons`` and ``F_diss`` [N] of the force
        counted from the phase of what is read, ``indentation`` [m], ``peak_force`` and ``pull_force`` [N],
        ``contact_time``, ``dissipation`` [J], ``virial`` [J], ``Z`` [m], ``periods`` that were integrated, and
        ``state``: settled, not_settled (the values are those of the last period: the motion is slow, irregular,
        or repeats only after several periods) or why the integration stopped (NaN). ``q``, ``v`` [m] and
        ``held`` are the raw state, for `motion_of`.

    Raises
    ------
    OvertoneError
        If method, tolerance or shapes do not fit.
    ContactModelError
        If the force of the model depends on more than gap, velocity and whether a contact is held.
    ProbeError
        If the model needs a tip radius and the probe has none.

    Examples
    --------
    >>> from overtone.contact.sample import sample
    >>> probe = Probe.simple(stiffness=26.0, frequency=303e3, quality_factor=456.0, radius=10e-9,
    ...                      drive_frequency=303e3, free_amplitude=85e-9)
    >>> material = sample("hertz", modulus=1e9, poisson_ratio=0.3)
    >>> state = settle(probe, material, Z=45e-9)
    >>> print(f"{float(state['A1']) * 1e9:.4f} nm")
    48.3913 nm
    """
    if method not in (SHOOTING, RELAX):
        raise OvertoneError("unknown method", expected=f"{SHOOTING!r} or {RELAX!r}", got=repr(method))
    _check_tolerance(tolerance)
    points = _points(probe, sample, Z)
    lever = lever_of(probe)
    state, mode = _raw(probe, start, points.shape, lever.length)
    memory = memory_of(probe)
    goal = goal if goal is not None else max(tolerance * memory, 1e-11)
    limit = max_periods if max_periods is not None else math.ceil(_MEMORIES * memory) + 100
    count = points.Z.size
    phasors = np.zeros((3, count, n_max + 1), complex)
    numbers = np.empty((count, integrate.NUMBERS))
    spent, status = np.zeros(count, np.int64), np.zeros(count, np.int8)

    def run(block: slice) -> None:
        integrate.settle_block(
            lever,
            _some(points.contacts, block),
            points.Z[block] / lever.length,
            state[block],
            mode[block],
            tolerance,
            goal,
            limit,
            method == SHOOTING,
            phasors[0, block],
            phasors[1, block],
            phasors[2, block],
            numbers[block],
            spent[block],
            status[block],
        )

    run_blocks(run, count, _BLOCK, progress)
    broken = status > integrate.NOT_SETTLED
    phasors[:, broken], numbers[broken] = math.nan, math.nan
    reading = phasors[0].reshape(*points.shape, n_max + 1) * lever.length
    force = phasors[2].reshape(*points.shape, n_max + 1)
    result = _observed(probe, reading, force, points.dims, points.coords)
    numbers = numbers.reshape(*points.shape, integrate.NUMBERS)
    result = result.assign(_extras(numbers, lever, points.dims, points.coords))
    result["Z"] = named_array("Z", points.Z.reshape(points.shape), points.dims, points.coords)
    moved = _motion(state, mode, points.shape, lever.length)
    result["q"] = (
        (*points.dims, "mode"),
        moved.deflection,
        {"units": "m", "long_name": "deflection of the modes as the drive is largest"},
    )
    result["v"] = (
        (*points.dims, "mode"),
        moved.velocity,
        {"units": "m", "long_name": "derivative of the deflection by the phase of the drive"},
    )
    result["held"] = (points.dims, moved.held, {"long_name": "whether a contact with hysteresis is held"})
    result["periods"] = (
        points.dims,
        spent.reshape(points.shape),
        {"units": "1", "long_name": "periods integrated"},
    )
    result["state"] = (
        points.dims,
        status.reshape(points.shape),
        {"long_name": "how it ended", **STATE_FLAGS},
    )
    return provenance.record(
        result,
        "settle",
        probe=format_probe(probe),
        model=sample.model.key,
        method=method,
        tolerance=tolerance,
        goal=goal,
    )


def memory_of(probe: Probe) -> float:
    """Return after how many periods of the drive the slowest mode has lost a factor e, ``Q/(pi r)``."""
    drive = probe.drive.frequency
    return max(mode.quality_factor * drive / mode.frequency for mode in probe.cantilever.modes) / math.pi


def _observed(
    probe: Probe,
    reading: _Complex,
    force: _Complex,
    dims: tuple[str, ...],
    coords: Mapping[str, Any],
) -> xr.Dataset:
    """Return observables and force harmonics from phasors in the time of the drive, last axis n [m, N]."""
    drive: Excitation = excitation(probe)
    offset = phase_offset(probe, drive)
    orders = np.arange(reading.shape[-1])
    frame = np.angle(reading[..., 1]) if reading.shape[-1] > 1 else np.zeros(reading.shape[:-1])
    mean = reading[..., 0].real
    if probe.detector.mean_sensitivity == STATIC:  # the lever's slope at rest, read as what the tip does
        slope = replace(probe, detector=replace(probe.detector, mean_sensitivity=DYNAMIC))
        mean = mean * float((read_receptance(probe, 0.0) / read_receptance(slope, 0.0)).real)
    variables = {"A0": named_array("A0", mean, dims, coords)}
    for n in orders[1:]:
        variables[f"A{n}"] = named_array(f"A{n}", np.abs(reading[..., n]), dims, coords)
        lag = (n * offset - np.angle(reading[..., n])) % (2.0 * math.pi)
        variables[f"phi{n}"] = named_array(f"phi{n}", lag, dims, coords)
    turned = np.moveaxis(force * np.exp(-1j * orders * frame[..., None]), -1, 0)
    along = {**coords, "harmonic": ("harmonic", orders)}
    for name, part in (("F_cons", turned.real), ("F_diss", -turned.imag)):
        variables[name] = named_array(name, part, ("harmonic", *dims), along)
    if orders.size > 1:
        virial = 0.5 * np.abs(reading[..., 1]) * turned[1].real
        variables["virial"] = named_array("virial", virial, dims, coords)
    return xr.Dataset(variables, attrs={"detector": probe.detector.kind})


def _extras(
    numbers: _Floats, lever: Lever, dims: tuple[str, ...], coords: Mapping[str, Any]
) -> dict[str, xr.DataArray]:
    """Return what was noted over a period, last axis of the numbers (`Record`)."""
    values = {
        "indentation": -numbers[..., integrate.CLOSEST] * lever.length,
        "peak_force": numbers[..., integrate.PEAK],
        "pull_force": numbers[..., integrate.PULL],
        "contact_time": numbers[..., integrate.CONTACT] / integrate.PERIOD,
        "dissipation": -numbers[..., integrate.WORK] * lever.length,
    }
    return {name: named_array(name, value, dims, coords) for name, value in values.items()}


# --- stability --------------------------------------------------------------------------------------------------


def floquet_multipliers(
    probe: Probe,
    sample: Sample,
    *,
    Z: Any,
    motion: Motion,
    tolerance: float = 1e-11,
    progress: Callable[[int, int], None] | None = None,
) -> tuple[_Complex, _Bytes]:
    """Return by what a small disturbance of a periodic state is multiplied in a period.

    Parameters
    ----------
    probe, sample, Z
        As for `settle`.
    motion : Motion
        The states, for all points or for each (`motion_of`, `motion_under`).
    tolerance : float
        Error of a step, in units of the free amplitude.
    progress : callable, optional
        Called with (states done, states in all).

    Returns
    -------
    multipliers : complex array (..., 2 mode)
        Largest first; a state persists where all are smaller than 1. NaN where the integration stopped.
    status : array (...)
        0, or why it stopped: a value of ``STATE_FLAGS``.

    Notes
    -----
    The derivative of the map of one period by differences, accurate to about 1e-6; a state that just grazes a
    gap where the force jumps or has a kink has none.

    Raises
    ------
    OvertoneError
        If tolerance or shapes do not fit.
    """
    _check_tolerance(tolerance)
    points = _points(probe, sample, Z)
    lever = lever_of(probe)
    state, mode = _raw(probe, motion, points.shape, lever.length)
    count, size = state.shape
    jacobian = np.zeros((count, size, size))
    status = np.zeros(count, np.int8)

    def run(block: slice) -> None:
        integrate.tangent_block(
            lever,
            _some(points.contacts, block),
            points.Z[block] / lever.length,
            state[block],
            mode[block],
            tolerance,
            jacobian[block],
            status[block],
        )

    run_blocks(run, count, _BLOCK, progress)
    broken = status != integrate.DONE
    jacobian[broken] = 0.0
    multipliers = np.linalg.eigvals(jacobian).astype(complex)
    multipliers = np.take_along_axis(multipliers, np.argsort(-np.abs(multipliers), axis=-1), axis=-1)
    multipliers[broken] = math.nan
    return multipliers.reshape(*points.shape, size), status.reshape(points.shape)


# --- sweeps -----------------------------------------------------------------------------------------------------


def sweep(
    probe: Probe,
    sample: Sample,
    *,
    z: Any,
    speed: float,
    bandwidth: float,
    order: int = 4,
    start: Motion | None = None,
    settle_periods: int | None = None,
    n_max: int = 3,
    tolerance: float = 1e-8,
    progress: Callable[[int, int], None] | None = None,
) -> tuple[xr.Dataset, Motion]:
    """Move the base at a constant speed and return what a lock-in reads as it passes the heights.

    Parameters
    ----------
    probe : Probe
        Any number of modes, any drive.
    sample : Sample
        A material, or arrays of them, each swept on its own.
    z : array, one dimension
        Heights of the base [m], rising or falling. The motion starts at the first.
    speed : float
        Of the base [m/s], positive.
    bandwidth : float
        Of the lock-in [Hz], where its answer has fallen by 3 dB.
    order : int
        Number of stages of its filter.
    start : Motion, optional
        Where to start: the free motion unless given, or the end of another sweep, with its filter.
    settle_periods : int, optional
        For how many periods the base rests at the first height; twelve memories ``Q/pi`` of the lever
        without a start, none with one.
    n_max : int
        Highest harmonic that is read.
    tolerance : float
        Error of a step of the integration, in units of the free amplitude.
    progress : callable, optional
        Called with (sweeps done, sweeps in all).

    Returns
    -------
    readings : Dataset
        Along ``z``, after the dimensions of the sample: as `settle`, but filtered; ``indentation``,
        ``peak_force``, ``pull_force``, ``contact_time`` and ``dissipation`` of the period that passes the
        height. Attributes ``speed`` [m/s], ``bandwidth`` [Hz], and ``travel_per_memory`` [m]: how far the base
        moves while the lever forgets, over which jumps are smeared.
    end : Motion
        The state at the end, with that of the filter.

    Raises
    ------
    OvertoneError
        If z, speed, bandwidth, order, tolerance or shapes do not fit.
    ContactModelError
        If the force of the model depends on more than gap, velocity and whether a contact is held.

    Notes
    -----
    The lock-in averages over each period of the drive, and passes the averages through ``order`` equal
    low-pass filters of the first order, one behind the other. Between the ends of periods its output is a
    straight line. It lags behind the base by ``order`` time constants: not corrected, as in a microscope.
    """
    heights = np.asarray(z, dtype=float)
    _check_sweep(heights, speed, bandwidth, order)
    _check_tolerance(tolerance)
    lever = lever_of(probe)
    points = _points(probe, sample, np.zeros(()))
    state, mode = _raw(probe, start, points.shape, lever.length)
    rest = settle_periods if settle_periods is not None else _rest(probe, start)
    slope = speed / lever.speed * (1.0 if heights[-1] > heights[0] else -1.0)
    count = state.shape[0]
    filtered: _Complex = np.full((count, heights.size, order, 2 * (n_max + 1)), complex(math.nan, math.nan))
    if start is not None and start.filtered is not None:
        filtered[:, -1] = _filter_start(start.filtered, filtered.shape, lever.length)
    numbers = np.full((count, heights.size, integrate.NUMBERS), math.nan)
    status = np.zeros(count, np.int8)
    decay = filter_decay(bandwidth, order, probe.drive.frequency)

    def run(block: slice) -> None:
        integrate.sweep_block(
            lever,
            _some(points.contacts, block),
            heights / lever.length,
            slope,
            rest,
            decay,
            state[block],
            mode[block],
            tolerance,
            filtered[block],
            numbers[block],
            status[block],
        )

    run_blocks(run, count, 1, progress)
    dims = (*points.dims, "z")
    coords = {"z": ("z", heights, {"units": "m", "long_name": "height of the base"})}
    shape = (*points.shape, heights.size)
    output: _Complex = filtered[:, :, -1].reshape(*shape, -1)
    reading, force = output[..., : n_max + 1] * lever.length, output[..., n_max + 1 :]
    result = _observed(probe, reading, force, dims, coords)
    result = result.assign(_extras(numbers.reshape(*shape, integrate.NUMBERS), lever, dims, coords))
    result["state"] = (
        points.dims,
        status.reshape(points.shape),
        {"long_name": "how it ended", **STATE_FLAGS},
    )
    travel = speed * memory_of(probe) / probe.drive.frequency
    result = result.assign_attrs(speed=speed, bandwidth=bandwidth, travel_per_memory=travel)
    final = filtered[:, -1].copy()
    final[..., : n_max + 1] *= lever.length
    end = _motion(state, mode, points.shape, lever.length)
    end = end._replace(filtered=final.reshape(*points.shape, *final.shape[1:]))
    result = provenance.record(
        result,
        "sweep",
        probe=format_probe(probe),
        model=sample.model.key,
        speed=speed,
        bandwidth=bandwidth,
        order=order,
        settle_periods=rest,
        tolerance=tolerance,
    )
    return result, end


def filter_decay(bandwidth: float, order: int, frequency: float) -> float:
    """Return what is left after a period of a step into a stage of the filter.

    Stages of time constant ``tau`` in a row fall by 3 dB at ``sqrt(2^(1/order) - 1) / (2 pi tau)``.
    """
    tau = math.sqrt(2.0 ** (1.0 / order) - 1.0) / (2.0 * math.pi * bandwidth)
    return math.exp(-1.0 / (frequency * tau))


def _rest(probe: Probe, start: Motion | None) -> int:
    """Return for how many periods to let the motion settle."""
    return math.ceil(_SETTLED * memory_of(probe)) if start is None else 0


def _filter_start(filtered: _Complex, shape: tuple[int, ...], length: float) -> _Complex:
    """Return the state of a filter to start from, for compiled code.

    Raises
    ------
    OvertoneError
        If it is that of another filter.
    """
    count, _, order, width = shape
    if filtered.shape[-2:] != (order, width):
        raise OvertoneError(
            "the start is that of another lock-in",
            expected=f"{order} stages and harmonics up to {width // 2 - 1}",
            got=f"{filtered.shape[-2]} stages and harmonics up to {filtered.shape[-1] // 2 - 1}",
            hint="start._replace(filtered=None)",
        )
    scaled = np.broadcast_to(filtered.reshape(-1, order, width), (count, order, width)).copy()
    scaled[..., : width // 2] /= length
    return scaled


def _check_sweep(heights: _Floats, speed: float, bandwidth: float, order: int) -> None:
    steps = np.diff(heights)
    if heights.ndim != 1 or heights.size < 2 or not ((steps > 0).all() or (steps < 0).all()):
        raise OvertoneError(
            "the heights of a sweep do not go one way",
            expected="two or more heights, all rising or all falling",
            got=f"an array of shape {heights.shape}",
            hint="one sweep down and one up, which starts from the end of the first",
        )
    for name, value in (("speed", speed), ("bandwidth", bandwidth)):
        if not (math.isfinite(value) and value > 0.0):
            raise OvertoneError(f"the {name} is not positive", expected="a positive number", got=str(value))
    if order < 1:
        raise OvertoneError("the filter has no stages", expected="order >= 1", got=str(order))
