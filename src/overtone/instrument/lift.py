"""A lift pass, free of the sample, used for the scan below it: drift line by line, slopes, background of A2 and A3."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
import xarray as xr

from overtone.errors import CalibrationError
from overtone.harmonics import far_phase
from overtone.instrument.calibration import Calibration
from overtone.instrument.drift import smooth_lines
from overtone.instrument.signals import Positions, Signals, signals_of
from overtone.instrument.state import State
from overtone.instrument.unknowns import (
    HIGHER,
    TERMS,
    crosstalk_of,
    distortion_basis,
    distortion_of,
    undo,
    wrapped,
)
from overtone.quantities import validate_observables
from overtone.units import format_quantity

_Floats = npt.NDArray[np.float64]
_Mask = npt.NDArray[np.bool_]

_FREE = 0.1  # of the free amplitude: a lift pass that is farther off is none
_FREE_ERROR = (
    0.002  # of the free amplitude in a lift pass, and of its phase: the film of air changes with height
)
_FAST = 3.0  # of errors: neighbours share 1/f noise
_KEPT = 1e-9  # slope along the slow axis once lines were levelled [m/m]


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
    lag = wrapped(-np.angle(free.phasor[1]) - far_phase(calibration.probe) - state.values["phi1_offset"])
    phase, phase_error = smooth_lines(lag, known)
    error = math.hypot(_FREE_ERROR, float(np.sqrt(np.mean(phase_error**2))))
    level_phase = float(phase.mean())
    state = state.measured(np.array([level_phase]), state.row(phi1_offset=1.0)[None, :], np.array([error**2]))
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
        f"{100 * float(np.ptp(strength)) / mean_strength:.2g} % over the lines; the phase was taken out, the amplitude is "
        "carried as error"
    )
    if free.mean is not None and read.mean is not None:
        read, state = _mean_of_lift(read, free, where, state, amplitude, findings)
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
    read: Signals, free: Signals, where: Positions, state: State, amplitude: float, findings: list[str]
) -> tuple[Signals, State]:
    """Take the mean deflection of the lift pass off: its slopes from a plane in Z and x, its drift line by line."""
    if read.mean is None or free.mean is None:
        return read, state
    basis = distortion_basis(free.phasor[1], 0, amplitude).real
    data = free.mean - basis @ distortion_of(state.values, 0).real
    good = np.isfinite(data)
    state = with_slopes(data, good, where, state)
    plane = state.values["A0_slope_z"] * where.height + state.values["A0_slope_x"] * where.x
    offset, error = smooth_lines(data - plane, good)
    middle = float(offset.mean())
    read = Signals(read.mean - (offset - middle)[:, None], read.phasor)
    # offset and what the detector adds are both there, and only their sum is seen
    added = {f"distortion0_{j}": float(basis[..., j][good].mean()) for j in range(basis.shape[-1])}
    state = state.measured(
        np.array([middle - state.values["A0_offset"]]),
        state.row(A0_offset=1.0, **added)[None, :],
        np.array([np.mean(error**2)]),
    )
    state = levelled(state)
    findings.append(
        f"lift pass: A0 without the sample is {format_quantity(middle, 'm')}, drifts by "
        f"{format_quantity(float(np.ptp(offset)), 'm')} over the lines and follows the height by "
        f"{1e3 * state.values['A0_slope_z']:.3g} nm/um; taken out"
    )
    return read, state


def _background(free: Signals, where: Positions, state: State, amplitude: float) -> State:
    """Let the higher harmonics of the lift pass measure what the detector and the electronics add to them."""
    for n in HIGHER:
        if n not in free.phasor or f"crosstalk{n}_re" not in state.names:
            continue
        clean = undo(free, state.values, amplitude, **where._asdict()).phasor[n]
        back = state.values[f"gain{n}"] * np.exp(
            -1j * (state.values[f"latency{n}"] + n * state.values["phi1_offset"])
        )
        rest = clean * back  # should be nothing, in the frame of the readings
        good = np.isfinite(rest)
        if not good.any():
            continue
        basis = distortion_basis(free.phasor[1][good], n, amplitude).mean(axis=0)
        weights: list[dict[str, float]] = [{f"crosstalk{n}_re": 1.0}, {f"crosstalk{n}_im": 1.0}]
        for j in range(TERMS):
            re, im = f"distortion{n}_{j}_re", f"distortion{n}_{j}_im"
            weights[0] |= {re: float(basis[j].real), im: -float(basis[j].imag)}
            weights[1] |= {re: float(basis[j].imag), im: float(basis[j].real)}
        value = complex(rest[good].mean())
        variance = _FAST**2 * float(np.var(rest[good])) / good.sum() / 2.0
        state = state.measured(
            np.array([value.real, value.imag]),
            np.stack([state.row(**row) for row in weights]),
            np.full(2, max(variance, 1e-30)),
        )
    return state


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


def levelled(state: State) -> State:
    """Return the state of a scan whose lines have been levelled: nothing is left along the slow axis."""
    if "A0_slope_y" not in state.names:
        return state
    return state.measured(
        np.array([-state.values["A0_slope_y"]]), state.row(A0_slope_y=1.0)[None, :], np.array([_KEPT**2])
    )


def _line_mean(values: _Floats, good: _Mask) -> _Floats:
    count = np.maximum(good.sum(axis=1, keepdims=True), 1)
    mean: _Floats = np.where(good, values, 0.0).sum(axis=1, keepdims=True) / count
    return mean
