"""A calibration applied to a scan, and what the scan itself adds to it (section 4.2 of the paper, with its errors).

A scan is taken minutes after its approach curve: zero, phase and drive have drifted by amounts that decide a modulus.
So the calibration is a prior, widened by what may have drifted; a lift pass and the pixels of the reference material
are measurements of the same unknowns; and what comes out is a corrected scan with the covariance that is left.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import xarray as xr

from overtone import provenance
from overtone.errors import CalibrationError, CalibrationWarning
from overtone.harmonics import far_phase
from overtone.instrument.calibrate import split_curve
from overtone.instrument.calibration import Calibration, format_calibration, joint, parse_calibration
from overtone.instrument.drift import smooth_lines
from overtone.instrument.reference import find_reference, reference_pixels
from overtone.instrument.signals import Signals, in_the_frame_of_the_first, signals_of, with_signals
from overtone.instrument.unknowns import HIGHER, NAMES, distortion_basis, distortion_of, probe_with, undo, wrapped
from overtone.probe import Probe
from overtone.quantities import named_array, validate_observables
from overtone.readings import Reading, reading_of, with_reading
from overtone.units import format_quantity

_Floats = npt.NDArray[np.float64]
_Mask = npt.NDArray[np.bool_]

DRIFT: Mapping[str, float] = {
    "A0_offset": 0.3e-9,
    "phi1_offset": math.radians(1.0),
    "free_amplitude": 0.01,
    "quality_factor": 0.01,
    "crosstalk2_re": 3e-12,
    "crosstalk2_im": 3e-12,
    "crosstalk3_re": 3e-12,
    "crosstalk3_im": 3e-12,
    "gain2": 0.005,
    "gain3": 0.005,
}
"""Standard deviation of what changes between a calibration and its scan: minutes of an ordinary microscope."""
_PREDICTED = 0.005  # relative error of what the fitted curve says of the reference: a curve is a model, too
_ANCHORED = 1.0  # of an offset's error: smaller means that something in the scan has measured it
_FREE_ERROR = 0.002  # of the free amplitude in a lift pass: the film of air still changes with height


class _Where(NamedTuple):
    """Where pixels lie, about the middle of the scan [m]."""

    height: _Floats
    x: _Floats
    y: _Floats


def correct(
    scan: xr.Dataset,
    calibration: Calibration,
    *,
    reference: str | xr.DataArray | Sequence[float] | None = "auto",
    lift: xr.Dataset | None = None,
    drift: Mapping[str, float] | None = None,
) -> xr.Dataset:
    """Free a scan of what the instrument added, anchor it to a reference, and say what error is left.

    Parameters
    ----------
    scan : Dataset
        Observables (y, x) as the microscope stored them; or a curve over z, whose far part anchors it.
    calibration : Calibration
        From `overtone.calibrate`, of the same probe.
    reference : str, DataArray, sequence or None
        Which pixels are the reference material of the calibration: ``auto`` finds them by phase and second harmonic; a
        mask (y, x); or a rectangle ``(x0, y0, x1, y1)`` [m]. None, and calibrations without a reference, anchor nothing.
    lift : Dataset, optional
        A lift (Nap) pass with the drive on, on the same pixels: measures A0 without the sample, free A1 and phi1, and
        the background of A2, line by line.
    drift : mapping, optional
        Replaces entries of `DRIFT`.

    Returns
    -------
    Dataset
        Corrected observables. ``reference`` marks the pixels used. Attributes hold the calibration with the values
        applied and the covariance that is left (`calibration_of`), the probe near the surface, findings, history.

    Raises
    ------
    CalibrationError
        If the scan was corrected before, belongs to another drive frequency, lacks the reference, or does not fit
        the lift pass.

    Warns
    -----
    CalibrationWarning
        If nothing in the scan anchors A0, or another phase passes for the reference as well.

    Notes
    -----
    Matching the reference moves zero, phase, drive, crosstalk and gains by as much as their errors allow, not the one
    that happens to be named first; for the other materials that is the paper's correction, with the error it has.
    """
    _check(scan, calibration)
    if scan["A1"].dims == ("z",):
        return _correct_curve(scan, calibration)
    like = scan["A1"]
    findings: list[str] = []
    read, where = signals_of(scan), _positions(scan)
    sigma_drift = {**DRIFT, **(drift or {})}
    unknown = set(sigma_drift) - set(NAMES)
    if unknown:
        raise CalibrationError(f"{sorted(unknown)[0]!r} is no unknown", expected=", ".join(DRIFT))
    names, covariance = joint(calibration.names, {}, calibration.covariance)
    for name, width in sigma_drift.items():
        if name in names:
            covariance[names.index(name), names.index(name)] += width**2
    state = _State(dict(calibration.values), names, covariance)
    probe = calibration.probe
    if lift is not None:
        read, state = _with_lift(read, lift, scan, where, state, calibration, findings)
    mask: _Mask | None = None
    if reference is not None and calibration.reference is not None:
        mask = _reference_mask(scan, read, where, state, calibration, reference, findings)
        read, state = _level_lines(read, where, state, calibration, mask, like.dims, findings)
        state = _anchored(read, where, state, calibration, mask, findings)
    elif reference is not None and not (isinstance(reference, str) and reference == "auto"):
        raise CalibrationError(
            "the calibration has no reference",
            expected="an approach curve on the material that was marked",
            hint="overtone calibrate --reference",
        )
    _say_what_is_left(state, calibration, mask, lift, findings)
    clean = undo(read, state.values, calibration.amplitude, **where._asdict())
    result = with_signals(scan, clean)
    if mask is not None:
        marked = named_array("reference", mask.astype(np.int8), like.dims, like.coords)
        result["reference"] = marked.assign_attrs(flag_values=[0, 1], flag_meanings="other reference")
    left = replace(calibration, values=state.values, names=state.names, covariance=state.covariance)
    result = with_reading(result, _reading(scan, probe_with(probe, _lever_only(state.values)), findings))
    result = result.assign_attrs(calibration=format_calibration(_applied(left)))
    result = provenance.add_finding(result, *findings)
    for sentence in findings:
        if sentence.startswith("nothing in the scan") or "passes for the reference" in sentence:
            warnings.warn(sentence, CalibrationWarning, stacklevel=2)
    return provenance.record(
        result,
        "correct",
        calibration=calibration.source,
        reference=reference if isinstance(reference, str | None) else "given",
        lift=lift is not None,
        drift=sigma_drift,
        applied={name: state.values[name] for name in state.names},
    )


def calibration_of(observables: xr.Dataset) -> Calibration | None:
    """Return the calibration that a scan was corrected with, with the covariance that is left; None without one.

    Raises
    ------
    CalibrationError
        If its text was damaged.
    """
    text = observables.attrs.get("calibration")
    return None if text is None else parse_calibration(str(text), "the calibration of the scan")


def _correct_curve(curve: xr.Dataset, calibration: Calibration) -> xr.Dataset:
    """Correct an approach curve; its far part gives the zero of A0 and of the phase."""
    parts = split_curve(curve)
    centre = float(np.mean(parts.height[parts.far]))
    read, values = signals_of(curve), dict(calibration.values)
    first = parts.signals.phasor[1][parts.far]
    lag = float(wrapped(-np.angle(first.mean()) - far_phase(calibration.probe)))
    values["phi1_offset"] = lag
    if parts.signals.mean is not None:
        added = (distortion_basis(first, 0, calibration.amplitude) @ distortion_of(values, 0)).real
        values["A0_offset"] = float(np.mean(parts.signals.mean[parts.far] - added))
    height = np.asarray(curve["z"].values, dtype=float) - centre
    result = with_signals(curve, undo(read, values, calibration.amplitude, height=height))
    probe = probe_with(calibration.probe, _lever_only(values))
    result = with_reading(result, _reading(curve, probe, []))
    result = result.assign_attrs(calibration=format_calibration(_applied(replace(calibration, values=values))))
    return provenance.record(result, "correct", calibration=calibration.source, far_phase=lag)


class _State(NamedTuple):
    """Unknowns with their covariance."""

    values: dict[str, float]
    names: tuple[str, ...]
    covariance: _Floats

    def updated(self, off: _Floats, H: _Floats, noise: _Floats) -> _State:
        """Return the state after measurements that are ``off`` what it predicts, with derivatives H and variances."""
        C = self.covariance
        S = H @ C @ H.T + np.diag(noise)
        K = np.linalg.solve(S, H @ C).T
        change = K @ off
        # Joseph's form stays positive whatever rounding does
        left = np.eye(C.shape[0]) - K @ H
        covariance = left @ C @ left.T + (K * noise) @ K.T
        values = {**self.values, **{n: self.values[n] + float(d) for n, d in zip(self.names, change, strict=True)}}
        return _State(values, self.names, 0.5 * (covariance + covariance.T))

    def error(self, name: str) -> float:
        """Return the standard deviation of an unknown."""
        if name not in self.names:
            return 0.0
        index = self.names.index(name)
        return math.sqrt(max(float(self.covariance[index, index]), 0.0))


def _check(scan: xr.Dataset, calibration: Calibration) -> None:
    validate_observables(scan)
    if "calibration" in scan.attrs:
        raise CalibrationError(
            "the scan was corrected before", expected="readings as the microscope stored them", hint="the scan file itself"
        )
    reading = reading_of(scan)
    if reading is None:
        return
    if reading.corrected:
        raise CalibrationError(
            "the scan is stated to be corrected",
            expected="readings as the microscope stored them",
            hint="leave out --corrected, or --calibration",
        )
    ours, theirs = reading.probe.drive.frequency, calibration.probe.drive.frequency
    if abs(ours / theirs - 1.0) > 1e-3:
        raise CalibrationError(
            "scan and calibration are of different drives",
            expected=f"{format_quantity(theirs, 'Hz', 6)} as in the calibration",
            got=f"{format_quantity(ours, 'Hz', 6)}",
            hint="calibrate with the lever and the drive of the scan",
        )
    level = float(np.nanmean(scan["A1"].values))
    if scan["A1"].dims != ("z",) and not 0.05 * calibration.amplitude < level < 1.05 * calibration.amplitude:
        raise CalibrationError(
            "amplitudes of scan and calibration do not fit",
            expected=f"A1 below the free amplitude of {format_quantity(calibration.amplitude, 'm')}",
            got=format_quantity(level, "m"),
            hint="the amplitude sensitivity of both files",
        )


def _positions(scan: xr.Dataset) -> _Where:
    """Return heights and coordinates about their means, zeros where the scan has none."""
    like = scan["A1"]

    def about_mean(array: xr.DataArray | None) -> _Floats:
        if array is None:
            return np.zeros(like.shape)
        values = np.asarray(array.broadcast_like(like).transpose(*like.dims).values, dtype=float)
        known = np.isfinite(values)
        return np.where(known, values, 0.0) - (values[known].mean() if known.any() else 0.0)

    return _Where(
        about_mean(scan["height"] if "height" in scan else None),
        about_mean(scan["x"] if "x" in scan.coords else None),
        about_mean(scan["y"] if "y" in scan.coords else None),
    )


def _lever_only(values: Mapping[str, float]) -> dict[str, float]:
    return {name: values[name] for name in ("stiffness", "quality_factor", "free_amplitude", "radius")}


def _applied(calibration: Calibration) -> Calibration:
    """Return a calibration whose lever factors are in its probe, as the scan's reading has them."""
    values = {**calibration.values, **dict.fromkeys(("stiffness", "quality_factor", "free_amplitude", "radius"), 1.0)}
    probe = probe_with(calibration.probe, calibration.values)
    names, covariance = calibration.names, calibration.covariance.copy()
    for name in ("stiffness", "quality_factor", "free_amplitude", "radius"):
        if name in names:  # relative to what was applied
            index = names.index(name)
            covariance[index] /= calibration.values[name]
            covariance[:, index] /= calibration.values[name]
    return replace(calibration, probe=probe, values=values, covariance=covariance)


def _reading(scan: xr.Dataset, probe: Probe, findings: list[str]) -> Reading:
    """Return the reading of the corrected scan: what a calibration settles is no doubt any more."""
    before = reading_of(scan)
    doubts: dict[int, str] = {}
    if before is not None:
        lever = "optical lever reads slope"
        if probe.detector.kind == "displacement":
            for n, text in before.doubts.items():
                kept = [line for line in text.splitlines() if lever in line]
                if kept:
                    doubts[n] = "\n".join(kept)
        radius = before.probe.tip.radius
        if probe.tip.radius is None and radius is not None:
            probe = replace(probe, tip=before.probe.tip)
    return Reading(probe, (), True, True, doubts)


# --- the lift pass ------------------------------------------------------------------------------------------------


def _with_lift(
    read: Signals,
    lift: xr.Dataset,
    scan: xr.Dataset,
    where: _Where,
    state: _State,
    calibration: Calibration,
    findings: list[str],
) -> tuple[Signals, _State]:
    """Use a lift pass: drift of zero and phase line by line, slopes, free amplitude, background of A2."""
    validate_observables(lift)
    if lift["A1"].shape != scan["A1"].shape or lift["A1"].ndim != 2:
        raise CalibrationError(
            "scan and lift pass do not fit", expected=f"pixels {scan['A1'].shape}", got=f"{lift['A1'].shape}"
        )
    free = signals_of(lift)
    amplitude = calibration.amplitude
    level = float(np.nanmedian(np.abs(free.phasor[1])))
    if not 0.9 * amplitude < level < 1.1 * amplitude:
        raise CalibrationError(
            "the lift pass is not free of the sample, or its drive was off",
            expected=f"the free amplitude, {format_quantity(amplitude, 'm')}",
            got=format_quantity(level, "m"),
            hint="a higher lift (150 to 300 nm above the surface, drive on)",
        )
    # phase: its drift over the lines, and its zero
    lag = wrapped(-np.angle(free.phasor[1]) - far_phase(calibration.probe) - state.values["phi1_offset"])
    phase, phase_error = smooth_lines(lag, np.isfinite(lag))
    turn = np.exp(1j * phase)[:, None]
    read = Signals(read.mean, {n: a * turn**n for n, a in read.phasor.items()})
    free = Signals(free.mean, {n: a * turn**n for n, a in free.phasor.items()})
    state = _measured(state, "phi1_offset", 0.0, float(np.sqrt(np.mean(phase_error**2))))
    # drive: its drift is shared out as one factor; amplitudes of the lines follow it
    strength, strength_error = smooth_lines(np.abs(free.phasor[1]) / amplitude, np.isfinite(lag))
    mean_strength = float(strength.mean())
    error = math.hypot(_FREE_ERROR, float(np.sqrt(np.mean(strength_error**2))), float(strength.std()))
    state = _measured(state, "free_amplitude", mean_strength - state.values["free_amplitude"], error)
    findings.append(
        f"lift pass: phi1 drifted by {math.degrees(float(np.ptp(phase))):.2g} deg and the free amplitude by "
        f"{100 * float(np.ptp(strength)) / mean_strength:.2g} % over the lines; both were taken out or carried as error"
    )
    if free.mean is not None and read.mean is not None:
        read, state = _mean_of_lift(read, free, where, state, amplitude, findings)
    for n in HIGHER:
        if n in free.phasor and f"crosstalk{n}_re" in state.names:
            background = distortion_basis(free.phasor[1], n, amplitude) @ distortion_of(state.values, n)
            # turned back to where crosstalk is counted
            rest = (free.phasor[n] - background) / turn**n
            value, spread = complex(np.nanmean(rest)), float(np.nanstd(rest)) / math.sqrt(rest.size)
            for part, number in (("re", value.real), ("im", value.imag)):
                name = f"crosstalk{n}_{part}"
                H = _row(state, name)
                for j in range(distortion_of(state.values, n).size):  # both are there, only their sum is seen
                    H += _row(state, f"distortion{n}_{j}_{part}")
                state = state.updated(np.array([number - state.values[name]]), H[None, :], np.array([spread**2 + 1e-26]))
    return read, state


def _mean_of_lift(
    read: Signals, free: Signals, where: _Where, state: _State, amplitude: float, findings: list[str]
) -> tuple[Signals, _State]:
    """Take the mean deflection of the lift pass off: its slopes from a plane in Z, x, y, its drift line by line."""
    assert read.mean is not None and free.mean is not None
    added = (distortion_basis(free.phasor[1], 0, amplitude) @ distortion_of(state.values, 0)).real
    data = free.mean - added
    good = np.isfinite(data)
    state = _slopes(data, good, where, state)
    plane = sum(
        (state.values[name] * c for name, c in zip(("A0_slope_z", "A0_slope_x"), where[:2], strict=True)),
        start=np.zeros(data.shape),
    )
    offset, error = smooth_lines(data - plane, good)
    middle = float(offset.mean())
    read = Signals(read.mean - (offset - middle)[:, None], read.phasor)
    state = _measured(state, "A0_offset", middle - state.values["A0_offset"], float(np.sqrt(np.mean(error**2))))
    state = _measured(state, "A0_slope_y", -state.values["A0_slope_y"], 1e-9)  # is in the offsets of the lines
    findings.append(
        f"lift pass: A0 without the sample is {format_quantity(middle, 'm')}, drifts by {format_quantity(float(np.ptp(offset)), 'm')} over "
        "the lines and follows the height by "
        f"{1e3 * state.values['A0_slope_z']:.3g} nm/um; taken out"
    )
    return read, state


def _slopes(data: _Floats, good: _Mask, where: _Where, state: _State) -> _State:
    """Let readings of A0 without a force measure its slopes, within lines, so that drift from line to line does not enter."""
    columns = {"A0_slope_z": where.height, "A0_slope_x": where.x}
    within = {name: (c - _line_mean(c, good))[good] for name, c in columns.items()}
    # a slope along which the pixels hardly vary is left as it is
    names = [name for name, c in within.items() if c.size > len(columns) and np.ptp(c) > 1e-12]
    if not names:
        return state
    design = np.column_stack([within[name] for name in names])
    rest = (data - _line_mean(data, good))[good]
    if np.linalg.matrix_rank(design / np.abs(design).max(axis=0)) < len(names):
        return state
    fit, _, _, _ = np.linalg.lstsq(design, rest, rcond=None)
    left = rest - design @ fit
    scatter = float(left @ left) / max(left.size - len(names), 1)
    # neighbours share 1/f noise: errors are three times those of independent pixels
    covariance = 9.0 * scatter * np.linalg.inv(design.T @ design)
    H = np.stack([_row(state, name) for name in names])
    off = np.array([value - state.values[name] for name, value in zip(names, fit, strict=True)])
    root = np.linalg.cholesky(covariance)
    return state.updated(np.linalg.solve(root, off), np.linalg.solve(root, H), np.ones(len(names)))


def _line_mean(values: _Floats, good: _Mask) -> _Floats:
    count = np.maximum(good.sum(axis=1, keepdims=True), 1)
    return np.where(good, values, 0.0).sum(axis=1, keepdims=True) / count


def _row(state: _State, name: str) -> _Floats:
    return np.array([1.0 if other == name else 0.0 for other in state.names])


def _measured(state: _State, name: str, off: float, error: float) -> _State:
    """Return the state after a direct measurement of one unknown."""
    if name not in state.names:
        return state
    return state.updated(np.array([off]), _row(state, name)[None, :], np.array([error**2]))


# --- the reference ------------------------------------------------------------------------------------------------


def _reference_mask(
    scan: xr.Dataset,
    read: Signals,
    where: _Where,
    state: _State,
    calibration: Calibration,
    reference: str | xr.DataArray | Sequence[float],
    findings: list[str],
) -> _Mask:
    """Return the pixels of the reference: those marked, or those that look like the curve in all but A0, which drifts."""
    if not isinstance(reference, str):
        return reference_pixels(scan, reference)
    if reference != "auto":
        raise CalibrationError(
            "unknown choice of the reference", expected="auto, a mask or a rectangle", got=reference
        )
    without = Signals(None, read.phasor)
    off = _off_the_curve(without, where, state, calibration)
    return find_reference(off, _shared_error(without, where, state, calibration, tuple(off)), findings)


def _anchored(
    read: Signals,
    where: _Where,
    state: _State,
    calibration: Calibration,
    mask: _Mask,
    findings: list[str],
) -> _State:
    """Let the pixels of the reference measure the unknowns."""
    pixels = Signals(
        read.mean[mask] if read.mean is not None else None, {n: a[mask] for n, a in read.phasor.items()}
    )
    there = _Where(*(part[mask] for part in where))
    prior = state
    for _ in range(2):  # the second pass starts where the first has led
        off = _off_the_curve(pixels, there, state, calibration)
        names = tuple(off)
        H = -_jacobian(pixels, there, state, calibration, names)
        variance = [_scatter(off[name]) ** 2 + (_PREDICTED * _size(calibration, name)) ** 2 for name in names]
        centre = np.array([float(np.nanmedian(off[name])) for name in names])
        # counted from the prior: what the present values have moved already is given back
        moved = np.array([state.values[n] - prior.values[n] for n in state.names])
        state = prior.updated(centre + H @ moved, H, np.array(variance))
    share = 100.0 * float(mask.mean())
    findings.append(
        f"{calibration.reference.name if calibration.reference else 'reference'}: {int(mask.sum())} pixels ({share:.3g} %) anchor A0, "
        "phase and higher harmonics to the approach curve"
    )
    return state


def _off_the_curve(
    read: Signals, where: _Where, state: _State, calibration: Calibration
) -> dict[str, _Floats]:
    """Return how far corrected readings are from what the approach curve says at their amplitude."""
    clean = undo(read, state.values, calibration.amplitude, **where._asdict())
    curve = calibration.curve
    order = np.argsort(curve["A1"])
    A = np.abs(clean.phasor[1])

    def on_curve(name: str) -> _Floats:
        return np.interp(A, curve["A1"][order], curve[name][order], left=math.nan, right=math.nan)

    phi = np.mod(-np.angle(clean.phasor[1]), 2.0 * math.pi)
    off = {"phi1": wrapped(phi - on_curve("phi1"))}
    if clean.mean is not None and "A0" in curve:
        off["A0"] = clean.mean - on_curve("A0")
    frame = in_the_frame_of_the_first(clean)
    for n in HIGHER:
        if n in frame and f"e{n}_re" in curve:
            off[f"e{n}_re"] = frame[n].real - on_curve(f"e{n}_re")
            off[f"e{n}_im"] = frame[n].imag - on_curve(f"e{n}_im")
    return off


def _jacobian(
    read: Signals, where: _Where, state: _State, calibration: Calibration, names: tuple[str, ...]
) -> _Floats:
    """Return d(median off)/d(unknown), one row a reading."""
    here = _off_the_curve(read, where, state, calibration)
    J = np.zeros((len(names), len(state.names)))
    for j, name in enumerate(state.names):
        step = max(1e-3 * state.error(name), 1e-18)
        moved = state._replace(values={**state.values, name: state.values[name] + step})
        there = _off_the_curve(read, where, moved, calibration)
        J[:, j] = [float(np.nanmedian(there[k] - here[k])) / step for k in names]
    # the free amplitude turns the phase at which an amplitude is met: sin(phi1) = A1/A1far where nothing is lost
    if "free_amplitude" in state.names:
        A = float(np.nanmedian(np.abs(read.phasor[1]))) / calibration.amplitude
        j = state.names.index("free_amplitude")
        J[names.index("phi1"), j] = A / math.sqrt(max(1.0 - A**2, 0.05)) / state.values["free_amplitude"]
    return J


def _shared_error(
    read: Signals, where: _Where, state: _State, calibration: Calibration, names: tuple[str, ...]
) -> dict[str, float]:
    """Return the standard deviation of each offset from the curve that all pixels share."""
    J = _jacobian(read, where, state, calibration, names)
    variance = np.einsum("ij,jk,ik->i", J, state.covariance, J)
    return {
        name: math.hypot(math.sqrt(max(float(v), 0.0)), _PREDICTED * _size(calibration, name))
        for name, v in zip(names, variance, strict=True)
    }


def _size(calibration: Calibration, name: str) -> float:
    """Return the size of a signal on the curve, for a relative error of it."""
    if name.startswith("e"):
        n = name[1]
        return float(np.max(np.hypot(calibration.curve[f"e{n}_re"], calibration.curve[f"e{n}_im"])))
    return 0.2 if name == "phi1" else float(np.max(np.abs(calibration.curve[name])))


def _scatter(values: _Floats) -> float:
    """Return the standard error of a median over pixels that are not independent of each other."""
    known = values[np.isfinite(values)]
    if known.size == 0:
        return math.inf
    spread = 1.4826 * float(np.median(np.abs(known - np.median(known))))
    return 1.2533 * spread / math.sqrt(max(known.size / 25.0, 1.0))


def _level_lines(
    read: Signals,
    where: _Where,
    state: _State,
    calibration: Calibration,
    mask: _Mask,
    dims: tuple[Any, ...],
    findings: list[str],
) -> tuple[Signals, _State]:
    """Take slopes and the drift along the slow axis off A0, as the reference pixels show them."""
    off = _off_the_curve(read, where, state, calibration).get("A0")
    if off is None or read.mean is None or dims != ("y", "x"):
        return read, state
    usable, gain = mask & np.isfinite(off), state.values["gain0"]
    # what is left of the present slopes comes on top of them
    present = {name: state.values[name] for name in ("A0_slope_z", "A0_slope_x")}
    whole = gain * off + present["A0_slope_z"] * where.height + present["A0_slope_x"] * where.x
    state = _slopes(whole, usable, where, state)
    off = _off_the_curve(read, where, state, calibration)["A0"]
    drift, _ = smooth_lines(off, usable)
    drift = drift - float(np.average(drift, weights=np.maximum(mask.sum(axis=1), 1e-9)))
    state = _measured(state, "A0_slope_y", 0.0, 1e-9)  # its rest is in the drift
    findings.append(
        "drift of A0 along the slow axis, from the reference in each line: "
        f"{format_quantity(float(np.ptp(drift)), 'm')}; taken out"
    )
    return Signals(read.mean - (drift * gain)[:, None], read.phasor), state


def _say_what_is_left(
    state: _State, calibration: Calibration, mask: _Mask | None, lift: xr.Dataset | None, findings: list[str]
) -> None:
    if mask is None and lift is None:
        findings.append(
            "nothing in the scan anchors A0 and phase: neither reference pixels nor a lift pass; the zero may have drifted by "
            f"{format_quantity(state.error('A0_offset'), 'm')} since the calibration"
        )
    findings.append(
        f"left after correction: A0 +- {format_quantity(state.error('A0_offset'), 'm', 2)}, phi1 +- "
        f"{math.degrees(state.error('phi1_offset')):.2g} deg, drive +- {100 * state.error('free_amplitude'):.2g} %, "
        f"gain of A2 +- {100 * state.error('gain2') / state.values['gain2']:.2g} %, correlated with each other"
    )
