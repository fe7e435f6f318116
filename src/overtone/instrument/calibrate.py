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
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import xarray as xr

from overtone.contact.models import contact_model
from overtone.errors import CalibrationError, CalibrationWarning
from overtone.harmonics import far_phase, read_receptance
from overtone.instrument.approach_fit import Curve, Fit, Reference, fit_approach
from overtone.instrument.calibration import Calibration, ReferenceMaterial, joint
from overtone.instrument.far_field import FarField, FarPoints, far_field as regress_far_field, joined, ladder_points
from overtone.instrument.signals import Signals, in_the_frame_of_the_first, signals_of
from overtone.instrument.surface import Ladder, lever_near_surface, resonance_from_ladder
from overtone.instrument.unknowns import HIGHER, NEUTRAL, probe_with, undo, wrapped
from overtone.probe import Probe, required_radius
from overtone.provenance import history
from overtone.quantities import validate_observables
from overtone.units import format_quantity

_Floats = npt.NDArray[np.float64]

ERRORS: Mapping[str, float] = {
    "stiffness": 0.05,
    "quality_factor": 0.02,
    "free_amplitude": 0.003,
    "radius": 0.15,
    "gain0": 0.1,
    "gain2": 0.3,
    "gain3": 0.3,
    "latency2": 0.5,
    "latency3": 0.5,
    "phi1_offset": math.radians(0.02),
    "A0_slope_x": 0.005,
    "A0_slope_y": 0.005,
}
"""Standard deviations before the curve is looked at: relative for lever, tip and gains, [rad] for phases, [m/m] for slopes."""
HEIGHT_NOISE = 0.1e-9
"""Standard deviation of the height of the base [m] where none is stated."""

_FEWEST = 20  # points of a curve
_FEWEST_FAR = 5
_FEWEST_CONTACT = 6
_BINS = 24
_TOUCHED = 0.02  # of the far amplitude: a loss of so much is contact
_FARTHEST = 0.1  # of the points: certainly far, or there is no far part
_RUN = 4  # points in a row
_CLEAR = 5e-9  # of the onset [m], and
_CLEAR_SHARE = 0.05  # of the free amplitude: attraction reaches that far
_LOWEST, _HIGHEST = 0.12, 0.96  # of the free amplitude: what the fit uses
_AFTER_JUMP = 2  # points that a jump may have spoilt
_LEAST_NOISE = 1e-15
_BAD_FIT = 1.5  # of chi-squared over its freedom
_FEWEST_FREQUENCIES = 5
_LEAST_QUALITY_ERROR = 0.003  # what a response that is not quite that of one mode leaves
_OFF = 0.03  # relative, between stated and measured free amplitude


class CurveParts(NamedTuple):
    """An approach curve, sorted from far to near, cut where it begins to feel the sample."""

    signals: Signals
    height: _Floats
    """(point,) [m]."""
    far: slice
    """Points that feel nothing."""
    contact: slice
    """Points from the first loss of amplitude on."""
    onset: float
    """Height of the first of them [m]."""


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
        If the data were corrected before, the curve has too few points, no far part or no contact, or a signal
        is missing.

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
    _check(approach)
    width = {**ERRORS, **(errors or {})}
    unknown = set(width) - set(ERRORS)
    if unknown:
        raise CalibrationError(
            f"{sorted(unknown)[0]!r} is no unknown of a calibration", expected=", ".join(ERRORS)
        )
    parts = split_curve(approach)
    findings: list[str] = []
    _, free, _, scatter = _free_reading(parts)
    amplitude = abs(free)
    centre = float(np.mean(parts.height[parts.far]))
    sets = [_points(parts, parts.far)]
    if far_field is not None:
        sets.append(_ladder(far_field, parts, findings))
    far = regress_far_field(
        joined(sets), reference=amplitude, centre_height=centre, noise=noise, priors=priors
    )
    findings += far.findings
    near, quality_error = _lever(parts, probe, far_field, far.values["compression"], findings)
    if quality_error is not None and "quality_factor" not in (errors or {}):
        width["quality_factor"] = quality_error
    sigma = {**scatter, **far.noise, **dict(noise or {})}
    phase = float(wrapped(-np.angle(free) - far_phase(near)))
    values = {**NEUTRAL, **far.values, "phi1_offset": phase}
    count = parts.height[parts.far].size
    start = _phase_error(width["phi1_offset"], sigma["phi1"], count)
    if reference is None:
        findings.append("no reference was given: gains and latency of the harmonics are not known")
        names, covariance = joint(tuple(far.values), {**_unfitted(width, far), "phi1_offset": start}, far.covariance)
        curve = _corrected(parts, values, amplitude, centre)
        result = Calibration(near, amplitude, values, names, covariance, sigma, None, curve, tuple(findings))
    else:
        result = _with_reference(parts, near, reference, far, values, width, start, sigma, height_noise, centre, findings)
    for sentence in result.findings:
        warnings.warn(sentence, CalibrationWarning, stacklevel=2)
    return replace(result, source=str(approach.attrs.get("source", "")))


# --- what the curve is made of ------------------------------------------------------------------------------------


def _check(approach: xr.Dataset) -> None:
    validate_observables(approach)
    done = [entry["operation"] for entry in history(approach)]
    if "correct" in done or approach.attrs.get("corrected") == "True":
        raise CalibrationError(
            "the approach curve was corrected before",
            expected="readings as the microscope stored them",
            hint="calibrate first, then correct",
        )
    if approach["A1"].dims != ("z",):
        raise CalibrationError(
            "this is no approach curve",
            expected="observables over z",
            got=f"dimensions {approach['A1'].dims}",
            hint="open_curve for curves; a map is corrected, not calibrated",
        )
    if "z" not in approach.coords:
        raise CalibrationError("the approach curve has no heights", expected="a coordinate z [m]")


def split_curve(approach: xr.Dataset) -> CurveParts:
    """Sort a curve from far to near and find where it begins to feel the sample.

    Raises
    ------
    CalibrationError
        If it is too short, begins in contact or never touches.
    """
    signals = signals_of(approach)
    height = np.asarray(approach["z"].values, dtype=float)
    good = np.isfinite(height) & np.isfinite(signals.phasor[1])
    for a in (*signals.phasor.values(), *((signals.mean,) if signals.mean is not None else ())):
        good &= np.isfinite(a)
    order = np.flatnonzero(good)[np.argsort(-height[good], kind="stable")]
    if order.size < _FEWEST:
        raise CalibrationError(
            "the approach curve is too short", expected=f"{_FEWEST} readings or more", got=str(order.size)
        )
    signals = Signals(
        signals.mean[order] if signals.mean is not None else None, {n: a[order] for n, a in signals.phasor.items()}
    )
    height, A = height[order], np.abs(signals.phasor[1])
    first = max(_FEWEST_FAR, round(_FARTHEST * order.size))
    level = float(np.median(A[:first]))
    scatter = 1.4826 * float(np.median(np.abs(np.diff(A[:first])))) / math.sqrt(2.0)
    limit = level - max(_TOUCHED * level, 6.0 * scatter)
    below = A < limit
    runs = np.convolve(below, np.ones(_RUN, int))[_RUN - 1 :] == _RUN
    if not runs.any():
        raise CalibrationError(
            "the curve never touches",
            expected=f"an amplitude that falls by more than {100 * _TOUCHED:g} % towards the sample",
            got=f"{format_quantity(float(A.min()), 'm')} at least, of {format_quantity(level, 'm')}",
            hint="a curve that goes on to half the free amplitude",
        )
    touch = int(np.argmax(runs))
    onset = float(height[touch])
    clear = height > onset + _CLEAR + _CLEAR_SHARE * level
    far = int(np.count_nonzero(clear[:touch]))
    drop = float(A[:first].max() - A[:first].min())
    if far < _FEWEST_FAR or drop > 2.0 * _TOUCHED * level + 12.0 * scatter:
        raise CalibrationError(
            "the curve has no far part",
            expected=f"{_FEWEST_FAR} readings or more, {format_quantity(_CLEAR + _CLEAR_SHARE * level, 'm')} or more before "
            "the amplitude begins to fall",
            got=f"{far}" if far < _FEWEST_FAR else f"an amplitude that falls by {format_quantity(drop, 'm')} among the first {first}",
            hint="a curve that begins farther away",
        )
    return CurveParts(signals, height, slice(0, far), slice(touch, order.size), onset)


def _take(signals: Signals, part: slice) -> Signals:
    return Signals(
        signals.mean[part] if signals.mean is not None else None, {n: a[part] for n, a in signals.phasor.items()}
    )


def _points(parts: CurveParts, part: slice) -> FarPoints:
    height = parts.height[part]
    return FarPoints(_take(parts.signals, part), np.ones(height.size), height, np.zeros(height.size, np.int64))


def _ladder(far_field: xr.Dataset, parts: CurveParts, findings: list[str]) -> FarPoints:
    """Return far-field readings; heights of another origin do not count."""
    validate_observables(far_field)
    points = ladder_points(far_field)
    missing = sorted(set(parts.signals.orders) - set(points.signals.orders))
    if missing:
        findings.append(
            f"the far-field data lack harmonic {', '.join(map(str, missing))}, so the far part of the curve stands alone for them"
        )
    return points


def _free_reading(parts: CurveParts) -> tuple[complex, complex, bool, dict[str, float]]:
    """Return a_1 of the free lever at the far end and at the onset, whether they differ, and scatter of A1 and phi1."""
    a, height = parts.signals.phasor[1][parts.far], parts.height[parts.far]
    middle = complex(np.exp(1j * np.angle(a.mean())))
    # a straight line to the onset: the film of air changes the lever over micrometres
    design = np.column_stack([np.ones(height.size), (height - parts.onset) * 1e6])
    line, _, _, _ = np.linalg.lstsq(design + 0j, a / middle, rcond=None)
    left = a / middle - design @ line
    freedom = max(height.size - 2, 1)
    radial, tangential = (
        max(math.sqrt(float(part @ part) / freedom), _LEAST_NOISE) for part in (left.real, left.imag)
    )
    slope_error = math.sqrt(float(np.linalg.inv(design.T @ design)[1, 1])) * math.hypot(radial, tangential)
    changes = bool(abs(line[1]) > 4.0 * slope_error and height.size >= 10)
    at_onset = complex(line[0] * middle) if changes else complex(a.mean())
    at_far_end = complex((line[0] + line[1] * design[0, 1]) * middle) if changes else complex(a.mean())
    return at_far_end, at_onset, changes, {"A1": radial, "phi1": tangential / abs(complex(a.mean()))}


def _lever(
    parts: CurveParts,
    probe: Probe,
    far_field: xr.Dataset | None,
    compression: float,
    findings: list[str],
) -> tuple[Probe, float | None]:
    """Return the lever just above the sample, and the relative error of Q where a frequency ladder told it."""
    far_end, free, changes, _ = _free_reading(parts)
    amplitude = abs(free)
    before, quality_error = replace(probe, drive=replace(probe.drive, free_amplitude=abs(far_end))), None
    ladder = _resonance(far_field, probe, compression, amplitude)
    if ladder is not None and ladder.probe is not None:
        mode, stated = ladder.probe.cantilever.modes[0], probe.cantilever.modes[0]
        quality_error = max(ladder.quality_factor_error / mode.quality_factor, _LEAST_QUALITY_ERROR)
        findings.append(
            f"resonance and Q from the frequency ladder: {mode.frequency / 1e3:.6g} kHz and {mode.quality_factor:.4g}, where the "
            f"probe says {stated.frequency / 1e3:.6g} kHz and {stated.quality_factor:.4g}"
        )
        before = ladder.probe
        far_end = ladder.probe.drive.free_amplitude * np.exp(-1j * (far_phase(before) + ladder.phase_offset))
        changes = True
    near = before
    if changes:
        near = lever_near_surface(
            before, free_amplitude=amplitude, phase=far_phase(before) - float(np.angle(free / far_end))
        ).probe
        mode = near.cantilever.modes[0]
        findings.append(
            f"just above the sample the free amplitude is {100 * (amplitude / abs(far_end) - 1):+.2g} % and the phase "
            f"{math.degrees(float(np.angle(far_end / free))):+.2g} deg off the ones far away: Q {mode.quality_factor:.4g} and "
            f"{mode.frequency / 1e3:.6g} kHz were used"
        )
    stated_amplitude = probe.drive.free_amplitude
    if abs(amplitude / stated_amplitude - 1.0) > _OFF:
        findings.append(
            f"the free amplitude on the curve is {format_quantity(amplitude, 'm')}, the probe says "
            f"{format_quantity(stated_amplitude, 'm')}; that of the curve was used"
        )
    return replace(near, drive=replace(near.drive, free_amplitude=amplitude)), quality_error


def _resonance(
    far_field: xr.Dataset | None, probe: Probe, compression: float, amplitude: float
) -> Ladder | None:
    """Return the resonance that a frequency ladder at constant drive shows, None without one."""
    if far_field is None or not ("frequency" in far_field or "frequency" in far_field.coords):
        return None
    points = ladder_points(far_field)
    frequency = np.asarray(far_field["frequency"].broadcast_like(far_field["A1"]).values, dtype=float).ravel()
    same = np.isclose(points.drive, 1.0, rtol=1e-6) & np.isfinite(frequency) & np.isfinite(points.signals.phasor[1])
    if np.unique(frequency[same]).size < _FEWEST_FREQUENCIES:
        return None
    values = {**NEUTRAL, "compression": compression}
    first = undo(Signals(None, {1: points.signals.phasor[1][same]}), values, amplitude).phasor[1]
    return resonance_from_ladder(frequency[same], np.abs(first), -np.angle(first), probe=probe)


def _phase_error(stated: float, sigma: float, count: int) -> float:
    return math.hypot(stated, sigma / math.sqrt(count))


def _unfitted(width: Mapping[str, float], far: FarField) -> dict[str, float]:
    """Return prior standard deviations of what the far field does not tell, for the harmonics that are there."""
    kept = {"stiffness", "quality_factor", "free_amplitude", "radius", "A0_slope_x", "A0_slope_y"}
    kept |= {"gain0"} if "A0_offset" in far.values else set()
    for n in HIGHER:
        if f"crosstalk{n}_re" in far.values:
            kept |= {f"gain{n}", f"latency{n}"}
    return {name: width[name] for name in width if name in kept}


def _corrected(
    parts: CurveParts, values: Mapping[str, float], amplitude: float, centre: float
) -> dict[str, _Floats]:
    """Return the corrected curve in contact, thinned."""
    signals, height, _ = _binned(parts, amplitude, _BINS)
    clean = undo(signals, values, amplitude, height=height - centre)
    frame = in_the_frame_of_the_first(clean)
    curve = {"A1": np.abs(clean.phasor[1]), "phi1": np.mod(-np.angle(clean.phasor[1]), 2.0 * math.pi)}
    if clean.mean is not None:
        curve["A0"] = clean.mean
    for n in HIGHER:
        if n in frame:
            curve |= {f"e{n}_re": frame[n].real, f"e{n}_im": frame[n].imag}
    return curve


def _binned(parts: CurveParts, amplitude: float, bins: int) -> tuple[Signals, _Floats, _Floats]:
    """Return the part in contact averaged over neighbours, with heights and how many went into each."""
    part = parts.contact
    A = np.abs(parts.signals.phasor[1][part])
    index = np.flatnonzero((A > _LOWEST * amplitude) & (A < _HIGHEST * amplitude))
    # a jump from one branch to another: what comes right after it is still on the way
    steps = np.abs(np.diff(A))
    usual = float(np.median(steps)) if steps.size else 0.0
    for jump in np.flatnonzero(steps > 10.0 * usual + 0.02 * amplitude):
        index = index[(index <= jump - 1) | (index > jump + _AFTER_JUMP)]
    groups = [group for group in np.array_split(index, min(bins, max(index.size, 1))) if group.size]
    signals = _take(parts.signals, part)

    def mean(values: npt.NDArray[np.generic]) -> npt.NDArray[np.generic]:
        return np.array([values[group].mean() for group in groups])

    turn = np.exp(1j * np.angle(signals.phasor[1]))
    # averaged in the frame of the first harmonic, whose phase changes along the curve
    phase = np.angle(np.array([turn[group].mean() for group in groups])) if groups else np.empty(0)
    phasor = {}
    for n, a in signals.phasor.items():
        phasor[n] = np.asarray(mean(a * turn ** (-n)), complex) * np.exp(1j * n * phase)
    averaged = Signals(np.asarray(mean(signals.mean), float) if signals.mean is not None else None, phasor)
    counts = np.array([group.size for group in groups], dtype=float)
    return averaged, np.asarray(mean(parts.height[part]), float), counts


# --- with a reference ---------------------------------------------------------------------------------------------


def _with_reference(
    parts: CurveParts,
    near: Probe,
    reference: Reference,
    far: FarField,
    values: dict[str, float],
    width: Mapping[str, float],
    phase_error: float,
    sigma: Mapping[str, float],
    height_noise: float,
    centre: float,
    findings: list[str],
) -> Calibration:
    required_radius(near)
    if not contact_model(reference.model).terms:
        raise CalibrationError(f"model {reference.model!r} has no force")
    amplitude = near.drive.free_amplitude
    signals, height, counts = _binned(parts, amplitude, _BINS)
    if not {0, 2} & set(signals.orders):
        raise CalibrationError(
            "a reference needs more than the first harmonic",
            expected="A0, or A2 and phi2, on the approach curve",
            got="A1 and phi1",
            hint="a calibration without --reference gives the zero of the phase",
        )
    repulsive = _repulsive(signals, near, values, amplitude)
    if np.count_nonzero(repulsive) < _FEWEST_CONTACT:
        raise CalibrationError(
            "the curve never touches in repulsion",
            expected=f"{_FEWEST_CONTACT} heights or more at which the first conservative harmonic is negative",
            got=str(int(np.count_nonzero(repulsive))),
            hint="a deeper curve, a larger amplitude, or another sign of the phase (phase_sign=-1)",
        )
    signals, height, counts = (
        Signals(
            signals.mean[repulsive] if signals.mean is not None else None,
            {n: a[repulsive] for n, a in signals.phasor.items()},
        ),
        height[repulsive],
        counts[repulsive],
    )
    values = values | _latency(signals, near, values, amplitude, height - centre)
    prior = {**_unfitted(width, far), "phi1_offset": phase_error}
    fitted = {name: error for name, error in prior.items() if name not in ("A0_slope_x", "A0_slope_y")}
    names, covariance = joint(tuple(far.values), fitted, far.covariance)
    share = np.sqrt(counts)
    noise = {name: value / share for name, value in sigma.items()}
    # what shakes the phase is a vector of a size, and turns a small amplitude farther
    noise["phi1"] = noise["phi1"] * amplitude / np.abs(signals.phasor[1])
    noise["height"] = np.full(height.size, height_noise)
    used = Signals(signals.mean, {n: a for n, a in signals.phasor.items() if n == 1 or f"gain{n}" in names})
    curve = Curve(used, height, noise)
    fit = fit_approach(
        curve,
        near,
        reference,
        amplitude=amplitude,
        names=names,
        mean=np.array([values[name] for name in names]),
        covariance=covariance,
        neutral=values,
        centre_height=centre,
    )
    values = values | dict(zip(fit.names, map(float, fit.values), strict=True))
    for n in HIGHER:
        if values[f"gain{n}"] < 0.0:  # the same as half a turn of the latency
            values |= {f"gain{n}": -values[f"gain{n}"], f"latency{n}": values[f"latency{n}"] + math.pi}
        values[f"latency{n}"] = float(wrapped(values[f"latency{n}"]))
    if values["gain0"] <= 0.0:
        raise CalibrationError(
            "the mean deflection has the wrong sign, or does not follow the force",
            expected="A0 that grows where the tip is pushed",
            got=f"a gain of {values['gain0']:.3g} against the reference",
            hint="the sign and the unit of the deflection channel, and set-point or feedback left in it",
        )
    covariance = _inflated(fit, findings)
    names, covariance = joint(fit.names, prior, covariance)
    material = ReferenceMaterial(
        reference.name,
        reference.model,
        reference.poisson_ratio,
        {name: (math.exp(m), s) for name, (m, s) in fit.material.items()},
        tuple(name for name in fit.material if getattr(reference, name, None) is not None),
    )
    if reference.modulus is None:
        findings.append(
            "the modulus of the reference was not stated: gains and modulus were fitted together, and share their error"
        )
    clean = undo(signals, values, amplitude, height=height - centre)
    table: dict[str, _Floats] = {
        "A1": np.abs(clean.phasor[1]),
        "phi1": np.mod(-np.angle(clean.phasor[1]), 2.0 * math.pi),
        "A0": fit.predicted["A0"],
    }
    for n in HIGHER:
        if f"e{n}" in fit.predicted:
            table |= {f"e{n}_re": fit.predicted[f"e{n}"].real, f"e{n}_im": fit.predicted[f"e{n}"].imag}
    return Calibration(near, amplitude, values, names, covariance, dict(sigma), material, table, tuple(findings))


def _repulsive(
    signals: Signals, probe: Probe, values: Mapping[str, float], amplitude: float
) -> npt.NDArray[np.bool_]:
    """Return where the first conservative harmonic pushes."""
    first = undo(Signals(None, {1: signals.phasor[1]}), values, amplitude).phasor[1]
    there = probe_with(probe, values)
    free = there.drive.free_amplitude * np.exp(1j * (-np.angle(first) - far_phase(there)))
    force = (np.abs(first) - free) / complex(read_receptance(there, there.drive.frequency))
    return np.asarray(force.real < 0.0)


def _latency(
    signals: Signals, probe: Probe, values: Mapping[str, float], amplitude: float, height: _Floats
) -> dict[str, float]:
    """Return the latency of each harmonic from the phase that an elastic contact gives it: the sign of CONS_n is (-1)^n."""
    frame = in_the_frame_of_the_first(undo(signals, values, amplitude, height=height))
    found = {}
    for n in HIGHER:
        if n in frame:
            G = complex(read_receptance(probe, n * probe.drive.frequency)) * (-1) ** n
            found[f"latency{n}"] = float(wrapped(np.angle(G) - np.angle(np.sum(frame[n] * np.abs(frame[n])))))
    return found


def _inflated(fit: Fit, findings: list[str]) -> _Floats:
    """Return the covariance of a fit, widened where the curve does not follow the model."""
    ratio = fit.chi2 / max(fit.freedom, 1)
    if ratio <= _BAD_FIT:
        return fit.covariance
    findings.append(
        f"the approach curve does not follow the model within its noise: chi-squared is {ratio:.3g} times its freedom, and errors "
        f"were widened by {math.sqrt(ratio):.3g}. Another contact model, drift during the curve, or a height that creeps may be behind it"
    )
    return fit.covariance * ratio
