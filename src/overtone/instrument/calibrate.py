"""From an approach curve on a reference and data far from the surface to a calibration (section 4.1 of the paper).

The order is fixed, because each step needs the one before: where the curve begins to feel the sample; the lever as it
is just above it; zero of the phase; offset, distortion and crosstalk from everything farther away; latency from the
phase of an elastic contact; and then all of it at once, with the material, in one fit.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import numpy.typing as npt
import xarray as xr

from overtone.errors import CalibrationError, CalibrationWarning
from overtone.harmonics import far_phase
from overtone.instrument.approach_fit import Reference
from overtone.instrument.calibration import Calibration, joint
from overtone.instrument.curve_parts import CurveParts, FreeLever, free_lever, split_curve, taken, wander
from overtone.instrument.far_field import PRIORS, FarField, FarPoints, joined, ladder_points
from overtone.instrument.far_field import far_field as regress_far_field
from overtone.instrument.near_lever import near_lever
from overtone.instrument.noise import complete_noise
from overtone.instrument.on_reference import Setting, calibrated_on, corrected_curve
from overtone.instrument.signals import Signals
from overtone.instrument.unknowns import HIGHER, NEUTRAL, wrapped
from overtone.io.selection import is_clipped
from overtone.probe import Probe
from overtone.provenance import history
from overtone.quantities import harmonic_orders, validate_observables
from overtone.readings import reading_of
from overtone.units import format_quantity

__all__ = ["ERRORS", "HEIGHT_NOISE", "CurveParts", "calibrate", "split_curve"]

_Floats = npt.NDArray[np.float64]

ERRORS: Mapping[str, float] = {
    "stiffness": 0.05,
    "quality_factor": 0.02,
    "free_amplitude": 0.003,
    "radius": 0.15,
    "resonance": 1e-5,
    "gain0": 0.1,
    "gain2": 0.3,
    "gain3": 0.3,
    "latency2": 0.5,
    "latency3": 0.5,
    "phi1_offset": math.radians(0.02),
    "A0_slope_x": 0.005,
    "A0_slope_y": 0.005,
}
"""Standard deviations before the curve is looked at: relative for lever, tip and gains, [rad] for phases, [m/m] for
slopes."""
HEIGHT_NOISE = 0.1e-9
"""Standard deviation of the height of the base [m] where none is stated."""
_SAME_DRIVE = 1e-3  # relative


def calibrate(
    approach: xr.Dataset,
    probe: Probe,
    *,
    reference: Reference | None = None,
    far_field: xr.Dataset | None = None,
    noise: Mapping[str, float] | None = None,
    priors: Mapping[str, float] | None = None,
    errors: Mapping[str, float] | None = None,
    height_noise: float = HEIGHT_NOISE,
) -> Calibration:
    """Calibrate an instrument from an approach curve and what was recorded far from the surface.

    Parameters
    ----------
    approach : Dataset
        Raw observables over ``z`` (m, any origin, growing away from the sample), as `overtone.open_curve` gives
        them: at least A1 and phi1; A0 for its offset, A2 (and A3) for distortion and gains.
    probe : Probe
        As calibrated: stiffness, resonance, Q, modes and detector, radius where there is a reference.
    reference : Reference, optional
        The material under the tip. Without it there are no gains and no latency.
    far_field : Dataset, optional
        More readings without a sample, at several drive frequencies at constant drive, or drives (variable ``drive``,
        relative to that of the scan). Without it distortion and crosstalk cannot be told apart, and are not.
    noise : mapping, optional
        Standard deviations of the readings [m, rad]; their own scatter where not stated.
    priors : mapping, optional
        Replaces entries of `overtone.instrument.far_field.PRIORS`.
    errors : mapping, optional
        Replaces entries of `ERRORS`.
    height_noise : float
        Standard deviation of the heights [m].

    Returns
    -------
    Calibration
        Values, covariance, the corrected curve, and what was assumed.

    Raises
    ------
    CalibrationError
        If the data were corrected before or belong to another drive, the curve has too few points, no far part or no
        contact, a signal is missing, or the curve does not follow the reference.
    ProbeError
        If there is a reference and the probe has no tip radius.

    Warns
    -----
    CalibrationWarning
        If something stays open, or the curve does not follow the model.

    Notes
    -----
    Assumes a detector without memory, electronics that are linear, a reference without loss unless its model has
    one, and a lever that between onset and contact does not change. The third harmonic is used where it was recorded.
    The far part of the curve gives the zero of A0; a drift later is for `overtone.correct`.
    """
    _check(approach, probe)
    width = _replaced(ERRORS, errors, "unknown of a calibration")
    _replaced(PRIORS, priors, "prior of far-field data")
    complete_noise(noise, harmonic_orders(approach))
    if not 0.0 < height_noise < math.inf:
        raise CalibrationError(
            "unphysical noise of the height", expected="a positive length", got=repr(height_noise)
        )
    findings = _saturated(approach)
    parts = split_curve(approach)
    free = free_lever(parts)
    amplitude, centre = abs(free.onset), parts.onset
    far = regress_far_field(
        _far_points(parts, far_field, findings),
        reference=amplitude,
        centre_height=centre,
        noise=noise,
        priors=priors,
    )
    far = _wandering(far, wander(parts))
    findings += far.findings
    near, quality_error = near_lever(free, probe, far_field, _compression(far), findings)
    if quality_error is not None and "quality_factor" not in (errors or {}):
        width["quality_factor"] = quality_error
    sigma = {**free.scatter, **far.noise, **dict(noise or {})}
    phase = float(wrapped(-np.angle(free.onset) - far_phase(near)))
    values = {**NEUTRAL, **far.values, "phi1_offset": phase}
    phase_error = math.hypot(width["phi1_offset"], _mean_error(sigma["phi1"], parts, free))
    prior = {**_unfitted(width, far), "phi1_offset": phase_error}
    if reference is None:
        findings.append("no reference was given: gains and latency of the harmonics are not known")
        names, covariance = joint(tuple(far.values), prior, far.covariance)
        curve = corrected_curve(parts, values, amplitude, centre)
        result = Calibration(near, amplitude, values, names, covariance, sigma, None, curve, tuple(findings))
    else:
        setting = Setting(near, far, values, prior, sigma, height_noise, centre)
        result = calibrated_on(parts, reference, setting, findings)
    for sentence in result.findings:
        warnings.warn(sentence, CalibrationWarning, stacklevel=2)
    return replace(result, source=str(approach.attrs.get("source", "")))


def _wandering(far: FarField, slow: float) -> FarField:
    """Return far-field results whose zero of A0 may be another one in contact, by 1/f noise [m]."""
    if "A0_offset" not in far.values:
        return far
    covariance, index = far.covariance.copy(), list(far.values).index("A0_offset")
    covariance[index, index] += slow**2
    return replace(far, covariance=covariance)


def _check(approach: xr.Dataset, probe: Probe) -> None:
    validate_observables(approach)
    done = [entry["operation"] for entry in history(approach)]
    reading = reading_of(approach)
    if "correct" in done or "calibration" in approach.attrs or (reading is not None and reading.corrected):
        raise CalibrationError(
            "the approach curve was corrected before",
            expected="readings as the microscope stored them",
            hint="calibrate first, then correct",
        )
    if approach["A1"].dims != ("z",):
        raise CalibrationError(
            "this is no approach curve",
            expected="observables over z",
            got=f"dimensions {', '.join(map(str, approach['A1'].dims)) or 'none'}",
            hint="open_curve for curves; one direction of two; a map is corrected, not calibrated",
        )
    if "z" not in approach.coords:
        raise CalibrationError("the approach curve has no heights", expected="a coordinate z [m]")
    if reading is not None:
        ours, theirs = reading.probe.drive.frequency, probe.drive.frequency
        if abs(ours / theirs - 1.0) > _SAME_DRIVE:
            raise CalibrationError(
                "curve and probe are of different drives",
                expected=f"{format_quantity(theirs, 'Hz', 6)} as in the probe",
                got=format_quantity(ours, "Hz", 6),
                hint="the probe as it was driven on this curve",
            )


def _replaced(
    defaults: Mapping[str, float], given: Mapping[str, float] | None, what: str
) -> dict[str, float]:
    """Return numbers with some replaced, after a look at those."""
    for name, value in (given or {}).items():
        if name not in defaults:
            raise CalibrationError(f"{name!r} is no {what}", expected=", ".join(defaults))
        if not 0.0 < value < math.inf:
            raise CalibrationError(
                f"the standard deviation of {name} makes no sense",
                expected="a positive number",
                got=repr(value),
            )
    return {**defaults, **(given or {})}


def _saturated(approach: xr.Dataset) -> list[str]:
    """Return a sentence for each signal that sticks to an end of its range."""
    names = [name for n in harmonic_orders(approach) for name in ((f"A{n}",) if n else ("A0",))]
    values = {name: np.asarray(approach[name].values, dtype=float) for name in names}
    sentences = []
    for name, array in values.items():
        others = [other for key, other in values.items() if key != name]
        finite = array[np.isfinite(array)]
        for end in {float(finite.min()), float(finite.max())} if finite.size else set():
            if is_clipped(array, end, others):
                share = 100.0 * float((array == end).sum()) / finite.size
                sentences.append(
                    f"{name} is saturated: {share:.3g} % of the curve sit exactly at {format_quantity(end, 'm', 4)}; "
                    "what lay beyond is lost, and no number here that rests on it can be trusted"
                )
    return sentences


def _far_points(parts: CurveParts, far_field: xr.Dataset | None, findings: list[str]) -> FarPoints:
    """Return the far part of the curve, with other far-field readings where there are some."""
    height = parts.height[parts.far]
    signals = taken(parts.signals, parts.far)
    # its noise would pass for a range of amplitudes, and what does not follow that noise for a distortion of nothing
    along = np.column_stack([np.ones(height.size), (height - parts.onset) * 1e6])
    line = along @ np.linalg.lstsq(along + 0j, signals.phasor[1], rcond=None)[0]
    signals = Signals(signals.mean, {**signals.phasor, 1: line})
    own = FarPoints(signals, np.ones(height.size), height, np.zeros(height.size, np.int64))
    if far_field is None:
        return own
    validate_observables(far_field)
    others = ladder_points(far_field)
    missing = sorted(set(signals.orders) - set(others.signals.orders))
    if missing:
        findings.append(
            f"the far-field data lack harmonic {', '.join(map(str, missing))}, so the far part of the curve stands "
            "alone for them"
        )
    # readings that are not there are as good as lost ones
    gone = np.full(others.drive.size, math.nan)
    filled = Signals(
        gone if 0 in missing else others.signals.mean,
        {**others.signals.phasor, **{n: gone + 0j for n in missing if n > 0}},
    )
    return joined([own, replace(others, signals=filled)])


def _compression(far: FarField) -> tuple[float, float]:
    index = list(far.values).index("compression")
    return far.values["compression"], math.sqrt(float(far.covariance[index, index]))


def _mean_error(sigma: float, parts: CurveParts, free: FreeLever) -> float:
    """Return the standard error of the phase of the free lever; twice that of a mean where a line led to it."""
    return sigma * (2.0 if free.changes else 1.0) / math.sqrt(parts.height[parts.far].size)


def _unfitted(width: Mapping[str, float], far: FarField) -> dict[str, float]:
    """Return prior standard deviations of what the far field does not tell, for the harmonics that are there."""
    kept = {
        "stiffness",
        "quality_factor",
        "resonance",
        "free_amplitude",
        "radius",
        "A0_slope_x",
        "A0_slope_y",
    }
    kept |= {"gain0"} if "A0_offset" in far.values else set()
    for n in HIGHER:
        if f"crosstalk{n}_re" in far.values:
            kept |= {f"gain{n}", f"latency{n}"}
    return {name: width[name] for name in width if name in kept}
