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

import numpy as np
import numpy.typing as npt
import xarray as xr

from overtone import provenance
from overtone.errors import CalibrationError, CalibrationWarning
from overtone.harmonics import far_phase
from overtone.instrument.anchor import anchored, level_lines, reference_mask
from overtone.instrument.calibration import Calibration, format_calibration, parse_calibration
from overtone.instrument.curve_parts import free_lever, split_curve
from overtone.instrument.lift import with_lift
from overtone.instrument.signals import positions, signals_of, with_signals
from overtone.instrument.state import State, drifting
from overtone.instrument.unknowns import (
    HIGHER,
    LEVER,
    distortion,
    probe_with,
    undo,
    wrapped,
)
from overtone.probe import SLOPE
from overtone.quantities import harmonic_orders, named_array, validate_observables
from overtone.readings import Reading, reading_of, with_reading
from overtone.units import format_quantity

_Mask = npt.NDArray[np.bool_]

DRIFT: Mapping[str, float] = {
    "A0_offset": 0.3e-9,
    "phi1_offset": math.radians(1.0),
    "free_amplitude": 0.01,
    "quality_factor": 0.01,
    "resonance": 3e-5,
    "crosstalk2_re": 3e-12,
    "crosstalk2_im": 3e-12,
    "crosstalk3_re": 3e-12,
    "crosstalk3_im": 3e-12,
    "gain2": 0.005,
    "gain3": 0.005,
}
"""Standard deviation of what changes between a calibration and its scan: minutes of an ordinary microscope."""
_SAME_DRIVE = 1e-3  # relative
_LEVER_DOUBT = "optical lever reads slope"
_UNKNOWN = "the calibration says nothing of harmonic {n}: what the instrument adds to it is not known, and still in it"
_WARNED = ("nothing in the scan", "passes for the reference", "the calibration says nothing")


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
        Which pixels are the reference material of the calibration: ``auto`` finds them by phase and higher harmonics; a
        mask (y, x); or a rectangle ``(x0, y0, x1, y1)`` [m]. None, and calibrations without a reference, anchor
        nothing.
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
    findings = _not_calibrated(scan, calibration)
    read, where = signals_of(scan), positions(scan)
    walk = {**DRIFT, **(drift or {})}
    state = drifting(calibration, walk)
    if lift is not None:
        read, state = with_lift(read, lift, scan, where, state, calibration, findings)
    mask: _Mask | None = None
    if reference is not None and calibration.reference is not None:
        mask = reference_mask(scan, read, where, state, calibration, reference, findings)
        read, state = level_lines(read, where, state, calibration, mask, like.dims, findings)
        state = anchored(read, where, state, calibration, mask, findings)
    elif reference is not None and not (isinstance(reference, str) and reference == "auto"):
        raise CalibrationError(
            "the calibration has no reference",
            expected="an approach curve on the material that was marked",
            hint="overtone calibrate --reference",
        )
    _say_what_is_left(state, mask, lift, findings)
    clean = undo(read, state.values, calibration.amplitude, **where._asdict())
    result = with_signals(scan, clean)
    if mask is not None:
        marked = named_array("reference", mask.astype(np.int8), like.dims, like.coords)
        result["reference"] = marked.assign_attrs(flag_values=[0, 1], flag_meanings="other reference")
    left = replace(calibration, values=state.values, names=state.names, covariance=state.left)
    result = provenance.add_finding(_as_corrected(result, scan, left), *findings)
    for sentence in findings:
        if any(sign in sentence for sign in _WARNED):
            warnings.warn(sentence, CalibrationWarning, stacklevel=2)
    return provenance.record(
        result,
        "correct",
        calibration=calibration.source,
        reference=reference if isinstance(reference, str | None) else "given",
        lift=lift is not None,
        drift=walk,
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
    """Correct an approach curve; its far part gives the zero of A0, that of the phase, and the drive."""
    parts = split_curve(curve)
    free = free_lever(parts)
    findings = _not_calibrated(curve, calibration)
    state = drifting(calibration, DRIFT)
    lever = probe_with(calibration.probe, calibration.values)
    lag = float(wrapped(-np.angle(free.onset) - far_phase(lever)))
    count = parts.height[parts.far].size
    strength = abs(free.onset) / calibration.amplitude
    for name, value, scatter in (
        ("phi1_offset", lag, free.scatter["phi1"]),
        (
            "free_amplitude",
            strength * calibration.values["free_amplitude"],
            free.scatter["A1"] / abs(free.onset),
        ),
    ):
        if name in state.names:
            sure = max(scatter**2 / count, calibration.error(name) ** 2, 1e-18)
            state = state.measured(
                np.array([value - state.values[name]]), state.row(**{name: 1.0})[None, :], np.array([sure])
            )
    values = {**state.values, "phi1_offset": lag}
    height = np.asarray(curve["z"].values, dtype=float) - parts.onset
    read = signals_of(curve)
    if parts.signals.mean is not None:
        first = parts.signals.phasor[1][parts.far]
        added = distortion(first, 0, calibration.amplitude, values).real
        slope = values["A0_slope_z"] * (parts.height[parts.far] - parts.onset)
        rest = parts.signals.mean[parts.far] - added - slope
        values["A0_offset"] = float(np.mean(rest))
        state = state.measured(
            np.array([values["A0_offset"] - state.values["A0_offset"]]),
            state.row(A0_offset=1.0)[None, :],
            np.array([max(float(np.var(rest)) / count, calibration.error("A0_offset") ** 2, 1e-30)]),
        )
    result = with_signals(curve, undo(read, values, calibration.amplitude, height=height))
    left = replace(calibration, values=values, covariance=state.left)
    result = provenance.add_finding(_as_corrected(result, curve, left), *findings)
    return provenance.record(result, "correct", calibration=calibration.source, far_phase=lag)


def _check(scan: xr.Dataset, calibration: Calibration) -> None:
    validate_observables(scan)
    if not isinstance(calibration, Calibration):
        raise CalibrationError(
            "a correction needs a calibration",
            expected="what overtone.calibrate returned or load_calibration read",
            got=type(calibration).__name__,
            hint="calibrate first, then correct",
        )
    if "calibration" in scan.attrs:
        raise CalibrationError(
            "the scan was corrected before",
            expected="readings as the microscope stored them",
            hint="the scan file itself",
        )
    if "direction" in scan["A1"].dims:
        raise CalibrationError(
            "the scan holds several directions",
            expected="one of them",
            got=f"dimensions {', '.join(map(str, scan['A1'].dims))}",
            hint='scan.sel(direction="trace")',
        )
    level = float(np.nanmean(scan["A1"].values))
    if scan["A1"].dims != ("z",) and not 0.05 * calibration.amplitude < level < 1.05 * calibration.amplitude:
        raise CalibrationError(
            "amplitudes of scan and calibration do not fit",
            expected=f"A1 below the free amplitude of {format_quantity(calibration.amplitude, 'm')}",
            got=format_quantity(level, "m"),
            hint="the amplitude sensitivity of both files",
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
    if abs(ours / theirs - 1.0) > _SAME_DRIVE:
        raise CalibrationError(
            "scan and calibration are of different drives",
            expected=f"{format_quantity(theirs, 'Hz', 6)} as in the calibration",
            got=f"{format_quantity(ours, 'Hz', 6)}",
            hint="calibrate with the lever and the drive of the scan",
        )


def _covers(calibration: Calibration, n: int) -> bool:
    """Tell whether a calibration holds what is read of a harmonic without a sample."""
    return ("A0_offset" if n == 0 else f"crosstalk{n}_re") in calibration.names


def _not_calibrated(scan: xr.Dataset, calibration: Calibration) -> list[str]:
    """Return a sentence for each harmonic of a scan that the calibration says nothing of."""
    return [
        _UNKNOWN.format(n=n)
        for n in harmonic_orders(scan)
        if n in (0, *HIGHER) and not _covers(calibration, n)
    ]


def _as_corrected(result: xr.Dataset, before: xr.Dataset, left: Calibration) -> xr.Dataset:
    """Return corrected observables with their reading and the calibration in their attributes.

    What the calibration settles is no doubt any more, neither in the reading nor among the findings.
    """
    reading = reading_of(before)
    probe = probe_with(left.probe, left.values)
    if reading is not None and probe.tip.radius is None and reading.probe.tip.radius is not None:
        probe = replace(probe, tip=reading.probe.tip)
    sentences = unsettled_findings(before, left)
    if "findings" in result.attrs:
        result = result.assign_attrs(findings="[]")
    if sentences:
        result = provenance.add_finding(result, *sentences)
    result = with_reading(result, Reading(probe, (), True, True, _doubts(before, left)))
    return result.assign_attrs(calibration=format_calibration(_applied(left)))


def _doubts(before: xr.Dataset, calibration: Calibration) -> dict[int, str]:
    """Return what is doubted of each harmonic once a calibration was applied."""
    reading, probe = reading_of(before), calibration.probe
    one_mode = probe.detector.kind != SLOPE or len(probe.cantilever.modes) == 1
    lines: dict[int, list[str]] = {}
    for n, text in (reading.doubts if reading is not None else {}).items():
        covered = _covers(calibration, n)
        lines[n] = [line for line in text.splitlines() if not covered or (_LEVER_DOUBT in line and one_mode)]
    for n in harmonic_orders(before):
        if n in (0, *HIGHER) and not _covers(calibration, n):
            lines.setdefault(n, []).append(_UNKNOWN.format(n=n))
    return {n: "\n".join(said) for n, said in lines.items() if said}


def unsettled_findings(before: xr.Dataset, calibration: Calibration) -> list[str]:
    """Return the findings of raw observables, but for those that repeat a doubt which a calibration settles.

    Parameters
    ----------
    before : Dataset
        Observables as the microscope stored them.
    calibration : Calibration
        Of the same instrument.
    """
    reading = reading_of(before)
    doubted = [
        line
        for text in (reading.doubts if reading is not None else {}).values()
        for line in text.splitlines()
    ]
    open_still = {line for text in _doubts(before, calibration).values() for line in text.splitlines()}
    settled = [line for line in doubted if line and line not in open_still]
    return [said for said in provenance.findings(before) if not any(line in said for line in settled)]


def _applied(calibration: Calibration) -> Calibration:
    """Return a calibration whose lever factors are in its probe, as the scan's reading has them."""
    scale = np.array([calibration.values[name] if name in LEVER else 1.0 for name in calibration.names])
    return replace(
        calibration,
        probe=probe_with(calibration.probe, calibration.values),
        values={**calibration.values, **dict.fromkeys(LEVER, 1.0)},
        covariance=calibration.covariance / np.outer(scale, scale),
    )


def _say_what_is_left(state: State, mask: _Mask | None, lift: xr.Dataset | None, findings: list[str]) -> None:
    """Add a sentence on the errors that are left, and one where nothing in the scan has made them smaller."""
    if mask is None and lift is None:
        findings.append(
            "nothing in the scan anchors A0 and phase: neither reference pixels nor a lift pass; the zero may have "
            f"drifted by {format_quantity(state.error('A0_offset'), 'm')} since the calibration"
        )
    parts = [f"phi1 +- {math.degrees(state.error('phi1_offset')):.2g} deg"]
    if "A0_offset" in state.names:
        parts.insert(0, f"A0 +- {format_quantity(state.error('A0_offset'), 'm', 2)}")
    parts.append(f"drive +- {100 * state.error('free_amplitude'):.2g} %")
    if "gain2" in state.names:
        parts.append(f"gain of A2 +- {100 * state.error('gain2') / state.values['gain2']:.2g} %")
    findings.append(f"left after correction: {', '.join(parts)}, correlated with each other")
