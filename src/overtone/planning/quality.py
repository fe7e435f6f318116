"""How well an instrument may be known, as a few standard deviations: what a plan assumes of a calibration."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from overtone.errors import CalibrationError
from overtone.instrument.calibration import Calibration
from overtone.instrument.unknowns import LEVER, NAMES, NEUTRAL
from overtone.probe import Probe
from overtone.units import format_quantity

PERFECT = "perfect"
_SAME_DRIVE = 1e-3  # relative


def _quality(
    *,
    mean: float,
    phase: float,
    gains: tuple[float, float, float],
    added: float,
    stiffness: float,
    quality_factor: float,
    free_amplitude: float,
    radius: float,
) -> dict[str, float]:
    """Return standard deviations by the names of `overtone.instrument.unknowns`."""
    return {
        "A0_offset": mean,
        "phi1_offset": phase,
        **dict(zip(("gain0", "gain2", "gain3"), gains, strict=True)),
        **{f"crosstalk{n}_{part}": added for n in (2, 3) for part in ("re", "im")},
        "stiffness": stiffness,
        "quality_factor": quality_factor,
        "free_amplitude": free_amplitude,
        "radius": radius,
    }


QUALITIES: Mapping[str, Mapping[str, float]] = {
    "none": _quality(
        mean=300e-12,
        phase=math.radians(5.0),
        gains=(0.3, 0.3, 0.3),
        added=100e-12,
        stiffness=0.3,
        quality_factor=0.1,
        free_amplitude=0.05,
        radius=0.5,
    ),
    "ordinary": _quality(
        mean=10e-12,
        phase=math.radians(1.0),
        gains=(0.05, 0.05, 0.05),
        added=5e-12,
        stiffness=0.1,
        quality_factor=0.02,
        free_amplitude=0.01,
        radius=0.25,
    ),
    "careful": _quality(
        mean=1e-12,
        phase=math.radians(0.2),
        gains=(0.01, 0.01, 0.02),
        added=0.5e-12,
        stiffness=0.05,
        quality_factor=0.005,
        free_amplitude=0.003,
        radius=0.1,
    ),
    PERFECT: {},
}
"""Standard deviations [m, rad, 1] of what a whole scan shares, independent of each other.

none      a nominal lever, a zero as it comes, a detector that was never looked at
ordinary  thermal stiffness, zero and phase taken far from the surface, tip from an image
careful   approach curve on a reference and lift pass (`overtone.calibrate`, `overtone.correct`), tip measured
perfect   nothing is shared: what noise alone leaves

========================  =======  ========  =======
standard deviation of     none     ordinary  careful
========================  =======  ========  =======
zero of A0                300 pm   10 pm     1 pm
zero of phi1              5 deg    1 deg     0.2 deg
gain of A0                30 %     5 %       1 %
gain of A2                30 %     5 %       1 %
gain of A3                30 %     5 %       2 %
added to A2 and A3        100 pm   5 pm      0.5 pm
stiffness k               30 %     10 %      5 %
quality factor Q          10 %     2 %       0.5 %
free amplitude A1far      5 %      1 %       0.3 %
tip radius R              50 %     25 %      10 %
========================  =======  ========  =======

They are assumptions of a plan, not measurements. A calibration on a reference leaves larger errors that are tied to
each other and cancel in part; where there is one, plan with it instead of a word.
"""


def _check(quality: str) -> None:
    if quality not in QUALITIES:
        raise CalibrationError(
            "unknown quality of a calibration",
            expected=", ".join(QUALITIES),
            got=repr(quality),
            hint='calibration="ordinary", or what overtone.calibrate returned',
        )


def assumed_calibration(quality: str, probe: Probe) -> Calibration | None:
    """Return a calibration that has the errors of a quality, None for a perfect one.

    Parameters
    ----------
    quality : str
        A key of `QUALITIES`.
    probe : Probe
        The lever as it is planned with.

    Raises
    ------
    CalibrationError
        If the word is not known.
    """
    _check(quality)
    errors = QUALITIES[quality]
    if not errors:
        return None
    names = tuple(name for name in NAMES if name in errors)
    covariance = np.diag([errors[name] ** 2 for name in names])
    return Calibration(
        probe, probe.drive.free_amplitude, dict(NEUTRAL), names, covariance, source=f"assumed: {quality}"
    )


def calibration_for(calibration: Calibration | str | None, probe: Probe) -> Calibration | None:
    """Return the calibration that a scan with a probe is planned with, None without shared errors.

    Parameters
    ----------
    calibration : Calibration, str or None
        A calibration of this lever, a key of `QUALITIES`, or None for ``perfect``.
    probe : Probe
        The lever at one free amplitude.

    Raises
    ------
    CalibrationError
        If it is none of these, or belongs to another lever.

    Notes
    -----
    Of a calibration the covariance counts, as if the scan were anchored as well as the curve was: what drifts in
    between is not in it, while that of a corrected scan (`overtone.calibration_of`) holds it. Its errors are taken
    about the planned probe, what the detector adds at the amplitude at which it was calibrated.
    """
    if calibration is None or isinstance(calibration, str):
        return assumed_calibration(calibration or PERFECT, probe)
    if not isinstance(calibration, Calibration):
        raise CalibrationError(
            "a plan cannot use this calibration",
            expected=f"a Calibration, None, or one of {', '.join(QUALITIES)}",
            got=type(calibration).__name__,
            hint='calibration="ordinary", or overtone.load_calibration(path)',
        )
    ours, theirs = probe.drive.frequency, calibration.probe.drive.frequency
    if abs(ours / theirs - 1.0) > _SAME_DRIVE:
        raise CalibrationError(
            "the calibration is of another lever",
            expected=f"a drive at {format_quantity(ours, 'Hz', 6)}",
            got=format_quantity(theirs, "Hz", 6),
            hint='the lever that was calibrated, or a word for all levers: calibration="ordinary"',
        )
    # factors of the lever are in the planned probe
    scale = np.array([calibration.values[name] if name in LEVER else 1.0 for name in calibration.names])
    return replace(
        calibration,
        probe=probe,
        values={**calibration.values, **dict.fromkeys(LEVER, 1.0)},
        covariance=calibration.covariance / np.outer(scale, scale),
        curve={},
    )


def described(calibration: Calibration | str | None) -> str:
    """Return what was assumed of the calibration, in words.

    Raises
    ------
    CalibrationError
        If the word is not known.
    """
    if isinstance(calibration, Calibration):
        return f"calibration {calibration.source or 'given'}"
    word = calibration or PERFECT
    _check(word)
    return (
        "no error that the whole scan shares, noise only"
        if word == PERFECT
        else f"{word} calibration, assumed"
    )
