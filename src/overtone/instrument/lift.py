"""A lift pass, free of the sample, used for the scan below it: drift line by line, slopes, background of A2 and A3."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
import numpy.typing as npt
import xarray as xr

from overtone.errors import CalibrationError
from overtone.harmonics import far_phase
from overtone.instrument.calibration import Calibration
from overtone.instrument.curve_parts import taken
from overtone.instrument.drift import smooth_lines
from overtone.instrument.signals import Positions, Signals, signals_of
from overtone.instrument.state import State
from overtone.instrument.unknowns import (
    HIGHER,
    crosstalk_of,
    distortion_basis,
    distortion_of,
    far_phase_slope,
    probe_with,
    undo,
    wrapped,
)
from overtone.quantities import validate_observables
from overtone.units import format_quantity

_Floats = npt.NDArray[np.float64]
_Mask = npt.NDArray[np.bool_]

_FREE = 0.1  # of the free amplitude: a lift pass that is farther off is none
# of the free amplitude in a lift pass, and of its phase: the film of air changes with height
_FREE_ERROR = 0.002
_BACKGROUND = 1e-12  # [m] what a lift pass cannot tell of the background in contact
_ENOUGH = 4000  # pixels of a lift pass that are looked at
_FAST = 3.0  # of errors: neighbours share 1/f noise


def with_lift(
    read: Signals,
    lift: xr.Dataset,
    scan: xr.Dataset,
    where: Positions,
    state: State,
    calibration: Calibration,
    findings: list[str],
) -> tuple[Signals, State]:
    """Use a lift pass.

    Parameters
    ----------
    read : Signals
        The scan (y, x), as read.
    lift : Dataset
        Observables of the lift pass on the same pixels, the drive on.
    scan : Dataset
        The scan as a dataset, for its shape.
    where : Positions
        Of the pixels.
    state : State
        Of the instrument.
    calibration : Calibration
        Its lever and A_ref.
    findings : list of str
        Gets a sentence for what was taken out.

    Returns
    -------
    read : Signals
        Phase and mean deflection freed of their drift from line to line.
    state : State
        With what the lift pass measures of it.

    Raises
    ------
    CalibrationError
        If it has other pixels or is not free, or its drive was off.
    """
    validate_observables(lift)
    if lift["A1"].shape != scan["A1"].shape or lift["A1"].ndim != 2:
        raise CalibrationError(
            "scan and lift pass do not fit",
            expected=f"pixels {scan['A1'].shape}",
            got=f"{lift['A1'].shape}",
        )
    free = signals_of(lift)
    amplitude = calibration.amplitude
    known = np.isfinite(free.phasor[1])
    level = float(np.median(np.abs(free.phasor[1][known])))
    if not abs(level / amplitude - 1.0) < _FREE:
        raise CalibrationError(
            "the lift pass is not free of the sample, or its drive was off",
            expected=f"the free amplitude, {format_quantity(amplitude, 'm')}",
            got=format_quantity(level, "m"),
            hint="a higher lift (150 to 300 nm above the surface, drive on)",
        )
    here = {**calibration.values, "resonance": state.values["resonance"]}
    lever = probe_with(calibration.probe, here)
    lag = wrapped(-np.angle(free.phasor[1]) - far_phase(lever) - state.values["phi1_offset"])
    phase, phase_error = smooth_lines(lag, known)
    error = math.hypot(_FREE_ERROR, float(np.sqrt(np.mean(phase_error**2))))
    level_phase = float(phase.mean())
    # the lag of the free lever tells the zero of the phase and the resonance together; the reference tells them apart
    row = state.row(phi1_offset=1.0, resonance=far_phase_slope(calibration.probe, here, "resonance"))
    state = state.measured(np.array([level_phase]), row[None, :], np.array([error**2]))
    # drive: amplitudes of the lines follow it; what it drifts by is shared out as an error of one factor
    strength, strength_error = smooth_lines(np.abs(free.phasor[1]) / amplitude, known)
    mean_strength = float(strength.mean())
    error = math.hypot(_FREE_ERROR, float(np.sqrt(np.mean(strength_error**2))), float(strength.std()))
    state = state.measured(
        np.array([mean_strength - state.values["free_amplitude"]]),
        state.row(free_amplitude=1.0)[None, :],
        np.array([error**2]),
    )
    findings.append(
        f"lift pass: phi1 drifted by {math.degrees(float(np.ptp(phase))):.2g} deg and the free amplitude by "
        f"{100 * float(np.ptp(strength)) / mean_strength:.2g} % over the lines; the phase was taken out, the amplitude "
        "is carried as error"
    )
    if free.mean is not None and read.mean is not None:
        height = lift.attrs.get("lift_height")
        read, state = _mean_of_lift(read, free, where, state, amplitude, height, findings)
    state = _background(free, where, state, amplitude)
    return _turned(read, phase - level_phase, state), state


def _turned(read: Signals, phase: _Floats, state: State) -> Signals:
    """Take a phase (line,) out of a scan; crosstalk comes from the electronics and does not turn with the lever."""
    turn = np.exp(1j * phase)[:, None]
    phasor = {}
    for n, a in read.phasor.items():
        fixed = crosstalk_of(state.values, n) if n in HIGHER else 0.0
        phasor[n] = (a - fixed) * turn**n + fixed
    return Signals(read.mean, phasor)


def _mean_of_lift(
    read: Signals,
    free: Signals,
    where: Positions,
    state: State,
    amplitude: float,
    lift_height: float | None,
    findings: list[str],
) -> tuple[Signals, State]:
    """Take the mean deflection of the lift pass off: its slopes from a plane in Z and x, its drift line by line."""
    if read.mean is None or free.mean is None:
        return read, state
    basis = distortion_basis(free.phasor[1], 0, amplitude).real
    data = free.mean - basis @ distortion_of(state.values, 0).real
    good = np.isfinite(data)
    state = with_slopes(data, good, where, state)
    slopes = (state.values[f"A0_slope_{axis}"] for axis in "zxy")
    plane = sum((slope * way for slope, way in zip(slopes, where, strict=True)), np.zeros(data.shape))
    offset, error = smooth_lines(data - plane, good)
    middle = float(offset.mean())
    read, state, rest = levelled(read, offset - middle, error, where, state, amplitude)
    # offset and what the detector adds are both there, and only their sum is seen
    added = {f"distortion0_{j}": float(basis[..., j][good].mean()) for j in range(basis.shape[-1])}
    at = "at a height that is not stated, so that only its drift was used,"
    if lift_height is not None:  # up there the virtual deflection is another one
        rise = state.values["A0_slope_z"] * float(lift_height)
        row = state.row(A0_offset=1.0, A0_slope_z=float(lift_height), **added)
        off = middle - rise - state.values["A0_offset"]
        # a spot that has moved reads more where the lever swings less; electronics that have drifted do not
        chi, u = state.values["compression"], _share(read, amplitude)
        unsure = 0.5 * off * ((1.0 - 2.0 * chi * u) / (1.0 - 2.0 * chi) - 1.0)
        variance = float(np.mean(error**2)) + unsure**2
        state = state.measured(np.array([off + unsure]), row[None, :], np.array([variance]))
        at = f"is {format_quantity(middle - rise, 'm')} at the height of the scan,"
    findings.append(
        f"lift pass: A0 without the sample {at} drifts by "
        f"{format_quantity(float(np.ptp(rest)), 'm')} over the lines and follows the height by "
        f"{1e3 * state.values['A0_slope_z']:.3g} nm/um; taken out"
    )
    return read, state


def _share(read: Signals, amplitude: float) -> float:
    """Return the median of |a_1|^2/A_ref^2."""
    u = np.abs(read.phasor[1] / amplitude) ** 2
    return float(np.median(u[np.isfinite(u)]))


def _background(free: Signals, where: Positions, state: State, amplitude: float) -> State:
    """Let the higher harmonics of the lift pass, which are all background, measure everything that makes them."""
    orders = [n for n in HIGHER if n in free.phasor and f"crosstalk{n}_re" in state.names]
    step = max(1, free.phasor[1].size // _ENOUGH)
    every = np.zeros(free.phasor[1].shape, bool)
    every.ravel()[::step] = True
    pixels, there = taken(free, every), Positions(*(part[every] for part in where))

    def left(values: Mapping[str, float]) -> _Floats:  # (part, pixel)
        clean = undo(pixels, values, amplitude, **there._asdict())
        return np.array([part for n in orders for part in (clean.phasor[n].real, clean.phasor[n].imag)])

    here = left(state.values)
    if not orders or not np.isfinite(here).any(axis=1).all():
        return state
    H = np.zeros((len(here), len(state.names)))
    for j, name in enumerate(state.names):
        width = max(1e-3 * state.error(name), 1e-18)
        H[:, j] = np.nanmean(left({**state.values, name: state.values[name] + width}) - here, axis=1) / width
    count = np.isfinite(here).sum(axis=1)
    variance = _FAST**2 * np.nanvar(here, axis=1) / count + _BACKGROUND**2
    return state.measured(-np.nanmean(here, axis=1), H, variance)


def with_slopes(data: _Floats, good: _Mask, where: Positions, state: State) -> State:
    """Return the state after readings of A0 without a force have measured its slopes along Z and x.

    Within lines, so that drift from line to line does not enter; a slope along which the pixels hardly vary is left.
    """
    columns = {"A0_slope_z": where.height, "A0_slope_x": where.x}
    within = {name: (c - _line_mean(c, good))[good] for name, c in columns.items()}
    names = [
        name
        for name, c in within.items()
        if name in state.names and c.size > len(columns) and np.ptp(c) > 1e-12
    ]
    if not names:
        return state
    design = np.column_stack([within[name] for name in names])
    rest = (data - _line_mean(data, good))[good]
    if np.linalg.matrix_rank(design / np.abs(design).max(axis=0)) < len(names):
        return state
    fit, _, _, _ = np.linalg.lstsq(design, rest, rcond=None)
    left = rest - design @ fit
    scatter = float(left @ left) / max(left.size - len(names), 1)
    covariance = _FAST**2 * scatter * np.linalg.inv(design.T @ design)
    H = np.stack([state.row(**{name: 1.0}) for name in names])
    off = np.array([value - state.values[name] for name, value in zip(names, fit, strict=True)])
    root = np.linalg.cholesky(covariance + 1e-24 * np.eye(len(names)))
    return state.measured(np.linalg.solve(root, off), np.linalg.solve(root, H), np.ones(len(names)))


def levelled(
    read: Signals, drift: _Floats, error: _Floats, where: Positions, state: State, amplitude: float
) -> tuple[Signals, State, _Floats]:
    """Take the drift of the mean deflection from line to line out.

    Parameters
    ----------
    read : Signals
        The scan (y, x), as read.
    drift, error : array (line,)
        What its lines read too much at A_ref [m], beyond what the state says, and its standard deviation.
    where, state
        Of the pixels and of the instrument.
    amplitude : float
        A_ref [m].

    Returns
    -------
    read, state
        An even slope along y is in the state, because it moves the spot; what is left of the drift is out of the scan.
    rest : array (line,)
        What is left.
    """
    y = where.y.mean(axis=1)
    sure = np.isfinite(error) & (error > 0.0)
    if "A0_slope_y" in state.names and sure.sum() > 2 and np.ptp(y[sure]) > 0.0:
        weight = 1.0 / error[sure] ** 2
        centre = float(np.average(y[sure], weights=weight))
        middle = float(np.average(drift[sure], weights=weight))
        spread = float(weight @ (y[sure] - centre) ** 2)
        slope = float(weight @ ((y[sure] - centre) * (drift[sure] - middle))) / spread
        before = state.values["A0_slope_y"]
        state = state.measured(
            np.array([slope]), state.row(A0_slope_y=1.0)[None, :], np.array([1.0 / spread])
        )
        drift = drift - (state.values["A0_slope_y"] - before) * y
    if read.mean is None:
        return read, state, drift
    # the spot moves, and the detector turns that into less where the lever swings wide
    chi = state.values["compression"]
    weaker = (1.0 - 2.0 * chi * np.abs(read.phasor[1] / amplitude) ** 2) / (1.0 - 2.0 * chi)
    return Signals(read.mean - drift[:, None] * weaker, read.phasor), state, drift


def _line_mean(values: _Floats, good: _Mask) -> _Floats:
    count = np.maximum(good.sum(axis=1, keepdims=True), 1)
    mean: _Floats = np.where(good, values, 0.0).sum(axis=1, keepdims=True) / count
    return mean
