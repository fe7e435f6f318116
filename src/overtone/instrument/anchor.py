"""A scan anchored to its reference material, whose pixels should lie on the approach curve and show what drifted."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import xarray as xr

from overtone.contact.sample import sample
from overtone.dynamics.hold import hold_amplitude
from overtone.errors import CalibrationError
from overtone.instrument.calibration import Calibration
from overtone.instrument.curve_parts import taken
from overtone.instrument.drift import smooth_lines
from overtone.instrument.lift import levelled, with_slopes
from overtone.instrument.reference import find_reference, reference_pixels
from overtone.instrument.signals import Positions, Signals, in_the_frame_of_the_first, signals_of
from overtone.instrument.state import State
from overtone.instrument.unknowns import HIGHER, probe_with, undo, wrapped
from overtone.units import format_quantity

_Floats = npt.NDArray[np.float64]
_Mask = npt.NDArray[np.bool_]

_PREDICTED = 0.005  # relative error of what the fitted curve says of the reference: a curve is a model, too
_FEWEST = 25  # pixels on the curve
_ENOUGH = 500  # pixels for a derivative
_ALIKE = 25.0  # neighbours that count as one: they are not independent of each other
_DRIFTING = {"free_amplitude": 1e-3, "quality_factor": 1e-3, "resonance": 1e-6}  # steps, relative


def reference_mask(
    scan: xr.Dataset,
    read: Signals,
    where: Positions,
    state: State,
    calibration: Calibration,
    reference: str | xr.DataArray | Sequence[float],
    findings: list[str],
) -> _Mask:
    """Return the pixels of the reference: those marked, or those that look like the curve in all but A0, which drifts.

    Raises
    ------
    CalibrationError
        If there are none, or the scan was taken at amplitudes that the curve does not have.
    """
    marked = None if isinstance(reference, str) else reference_pixels(scan, reference)
    if isinstance(reference, str) and reference != "auto":
        raise CalibrationError(
            "unknown choice of the reference", expected="auto, a mask or a rectangle", got=repr(reference)
        )
    # the zero of A0 drifts; what moved the spot has to be known all the same, for the second harmonic
    off = off_the_curve(read, where, state, calibration)
    off.pop("A0", None)
    on_curve = np.isfinite(off["phi1"]) & (True if marked is None else marked)
    if int(on_curve.sum()) < _FEWEST:
        A = calibration.curve["A1"]
        level = np.abs(read.phasor[1])[np.isfinite(read.phasor[1]) & (True if marked is None else marked)]
        raise CalibrationError(
            "the scan was taken at amplitudes that the approach curve does not have",
            expected=f"A1 from {format_quantity(float(A.min()), 'm')} to {format_quantity(float(A.max()), 'm')}",
            got=format_quantity(float(np.median(level)), "m"),
            hint="a curve that goes deeper than the set-point of the scan",
        )
    if marked is not None:
        return marked
    tolerance = _drift_error(read, where, state, calibration, tuple(off))
    # the phase may have drifted during the scan as far as since the calibration
    return find_reference(off, tolerance, {"phi1": tolerance["phi1"]}, findings)


def level_lines(
    read: Signals,
    where: Positions,
    state: State,
    calibration: Calibration,
    mask: _Mask,
    dims: tuple[Any, ...],
    findings: list[str],
) -> tuple[Signals, State]:
    """Take slopes and the drift along the slow axis off A0, as the reference pixels show them."""
    off = off_the_curve(read, where, state, calibration).get("A0")
    if off is None or read.mean is None:
        return read, state
    if dims != ("y", "x"):
        findings.append("the scan has no lines, so neither slopes nor a drift of A0 were looked for")
        return read, state
    usable = mask & np.isfinite(off)
    weights = usable.sum(axis=1)
    if not weights.any():
        return read, state

    def as_read(off: _Floats) -> _Floats:  # slopes are quoted as read at A_ref
        chi = state.values["compression"]
        return off * state.values["gain0"] * (1.0 - 2.0 * chi) / (1.0 - chi)

    # what is left of the present slopes comes on top of them
    present = state.values["A0_slope_z"] * where.height + state.values["A0_slope_x"] * where.x
    state = with_slopes(as_read(off) + present, usable, where, state)
    off = off_the_curve(read, where, state, calibration)["A0"]
    drift, error = smooth_lines(as_read(off), usable)
    drift = drift - float(np.average(drift, weights=weights))
    read, state, rest = levelled(read, drift, error, where, state, calibration.amplitude)
    findings.append(
        "drift of A0 along the slow axis, from the reference in each line: "
        f"{format_quantity(float(np.ptp(rest)), 'm')}; taken out"
    )
    return read, state


def anchored(
    read: Signals,
    where: Positions,
    state: State,
    calibration: Calibration,
    mask: _Mask,
    findings: list[str],
) -> State:
    """Let the pixels of the reference measure what has drifted since the calibration."""
    pixels = taken(read, mask)
    there = Positions(*(part[mask] for part in where))
    prior, start = state, calibration.values
    for _ in range(2):  # the second pass starts where the first has led
        off = off_the_curve(pixels, there, state, calibration)
        spread = {name: _scatter(values) for name, values in off.items()}
        names = tuple(name for name in off if math.isfinite(spread[name]))
        if "phi1" not in names:
            raise CalibrationError(
                "the reference pixels do not lie on the approach curve", expected="amplitudes that it has"
            )
        J = _jacobian(pixels, there, state, calibration, names)
        P = _of_the_lever(pixels, calibration, state.names, names)
        variance = [spread[name] ** 2 + (_PREDICTED * _size(calibration, name)) ** 2 for name in names]
        centre = np.array([float(np.nanmedian(off[name])) for name in names])
        # off = J (believed - now) + B (calibrated - start) + P (now - calibrated), linear about what is believed
        B = _on_the_curve(J, state.names)
        at, begun, known = (_vector(v, state.names) for v in (state.values, start, prior.calibrated))
        off_prior = (
            J @ at - B @ begun - centre - (J - P) @ _vector(prior.values, state.names) + (B - P) @ known
        )
        state = prior.compared(off_prior, J - P, B - P, np.array(variance))
    share = 100.0 * float(mask.mean())
    name = calibration.reference.name if calibration.reference else "reference"
    findings.append(
        f"{name}: {int(mask.sum())} pixels ({share:.3g} %) anchor A0, phase and higher harmonics to the approach curve"
    )
    return state


def off_the_curve(
    read: Signals, where: Positions, state: State, calibration: Calibration
) -> dict[str, _Floats]:
    """Return how far corrected readings are from what the approach curve says at their amplitude.

    NaN where the curve has no such amplitude.
    """
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
    read: Signals, where: Positions, state: State, calibration: Calibration, names: tuple[str, ...]
) -> _Floats:
    """Return d(median off)/d(unknown) of the correction, one row a reading, from some of the pixels."""
    known = np.flatnonzero(np.isfinite(read.phasor[1]))
    some = known[:: max(1, known.size // _ENOUGH)]
    flat = Signals(
        read.mean.ravel() if read.mean is not None else None, {n: a.ravel() for n, a in read.phasor.items()}
    )
    read, where = taken(flat, some), Positions(*(part.ravel()[some] for part in where))
    here = off_the_curve(read, where, state, calibration)
    J = np.zeros((len(names), len(state.names)))
    for j, name in enumerate(state.names):
        step = max(1e-3 * state.error(name), 1e-18)
        moved = state._replace(values={**state.values, name: state.values[name] + step})
        there = off_the_curve(read, where, moved, calibration)
        for i, reading in enumerate(names):
            change = (there[reading] - here[reading])[np.isfinite(here[reading])]
            J[i, j] = float(np.median(change)) / step if change.size else 0.0
    return J


def _vector(values: Mapping[str, float], names: tuple[str, ...]) -> _Floats:
    return np.array([values[name] for name in names])


def _on_the_curve(J: _Floats, names: tuple[str, ...]) -> _Floats:
    """Return the same derivatives for the approach curve, which was taken at one place of the sample.

    Its height counts from where contact begins; over a curve the error of that slope is nothing.
    """
    B: _Floats = J * np.array([0.0 if name.startswith("A0_slope") else 1.0 for name in names])
    return B


def _of_the_lever(
    read: Signals, calibration: Calibration, unknowns: tuple[str, ...], names: tuple[str, ...]
) -> _Floats:
    """Return by how much the reference itself reads otherwise at its amplitude, per drift of drive and Q.

    Zeros where the material of the calibration has no state at this amplitude.
    """
    P = np.zeros((len(names), len(unknowns)))
    if calibration.reference is None:
        return P
    known = calibration.reference
    properties = {name: value for name, (value, _) in known.properties.items()}
    material = sample(known.model, poisson_ratio=known.poisson_ratio, **properties)
    first = undo(Signals(None, {1: read.phasor[1]}), calibration.values, calibration.amplitude).phasor[1]
    A = float(np.nanmedian(np.abs(first)))
    for name in set(_DRIFTING) & set(unknowns):
        sides = []
        for sign in (1.0, -1.0):
            value = calibration.values[name] * (1.0 + sign * _DRIFTING[name])
            probe = probe_with(calibration.probe, {**calibration.values, name: value})
            setpoint = A / probe.drive.free_amplitude
            sides.append(_held(hold_amplitude(probe, material, setpoint=setpoint)) if setpoint < 1.0 else {})
        step = 2.0 * _DRIFTING[name] * calibration.values[name]
        for i, reading in enumerate(names):
            slope = (sides[0].get(reading, math.nan) - sides[1].get(reading, math.nan)) / step
            P[i, unknowns.index(name)] = slope if math.isfinite(slope) else 0.0
    return P


def _held(state: xr.Dataset) -> dict[str, float]:
    """Return what a steady state reads, named as a curve is."""
    names = [
        n for k in range(max(HIGHER) + 1) for n in ((f"A{k}", f"phi{k}") if k else ("A0",)) if n in state
    ]
    signals = signals_of(state[names])
    held = {"phi1": float(-np.angle(signals.phasor[1]))}
    if signals.mean is not None:
        held["A0"] = float(signals.mean)
    for n, e in in_the_frame_of_the_first(signals).items():
        held |= {f"e{n}_re": float(e.real), f"e{n}_im": float(e.imag)}
    return held


def _drift_error(
    read: Signals, where: Positions, state: State, calibration: Calibration, names: tuple[str, ...]
) -> dict[str, float]:
    """Return the standard deviation of each offset from the curve that all pixels share: what may have drifted."""
    J = _jacobian(read, where, state, calibration, names)
    P = _of_the_lever(read, calibration, state.names, names)
    both = np.concatenate([P - _on_the_curve(J, state.names), J - P], axis=1)
    variance = np.einsum("ij,jk,ik->i", both, state.covariance, both)
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
    """Return the standard error of a median over pixels, infinite where none is known."""
    known = values[np.isfinite(values)]
    if known.size == 0:
        return math.inf
    spread = 1.4826 * float(np.median(np.abs(known - np.median(known))))
    return 1.2533 * spread / math.sqrt(max(known.size / _ALIKE, 1.0))
