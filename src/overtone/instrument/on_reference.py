"""What an approach curve on a reference material adds to far-field data: gains, latency, and the material itself."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from overtone.contact.models import contact_model
from overtone.errors import CalibrationError
from overtone.harmonics import far_phase, read_receptance
from overtone.instrument.approach_fit import Curve, Fit, Reference, fit_approach
from overtone.instrument.calibration import Calibration, ReferenceMaterial, joint
from overtone.instrument.curve_parts import CurveParts, binned, taken
from overtone.instrument.far_field import FarField
from overtone.instrument.signals import Signals, in_the_frame_of_the_first
from overtone.instrument.unknowns import (
    HIGHER,
    NEUTRAL,
    distortion_of,
    far_phase_slope,
    probe_with,
    undo,
    wrapped,
)
from overtone.probe import Probe, required_radius

_Floats = npt.NDArray[np.float64]

BINS = 24
"""Groups of neighbours that a curve is averaged to."""
_FEWEST_CONTACT = 6
_BAD_FIT = 1.5  # of chi-squared over its freedom
_LEAST_GAIN = 0.2
_HOPELESS = 30.0
# of what the detector adds at the free amplitude: so closely is its bend followed down the curve
_FOLLOWED = 2e-3


class Setting(NamedTuple):
    """What is known of the instrument before the material is looked at."""

    probe: Probe
    """The lever just above the sample."""
    far: FarField
    values: Mapping[str, float]
    prior: Mapping[str, float]
    """Standard deviations of what the far field does not tell."""
    sigma: Mapping[str, float]
    """Scatter of one reading [m, rad]."""
    height_noise: float
    centre: float
    """Height at which the offset of A0 is quoted [m]."""


def calibrated_on(
    parts: CurveParts, reference: Reference, setting: Setting, findings: list[str]
) -> Calibration:
    """Return a calibration from a curve on a reference.

    Raises
    ------
    CalibrationError
        If the curve does not touch, has no more than the first harmonic, or does not follow the reference.
    ProbeError
        If the probe has no tip radius.
    """
    probe, far, centre = setting.probe, setting.far, setting.centre
    required_radius(probe)
    if not contact_model(reference.model).terms:
        raise CalibrationError(f"model {reference.model!r} has no force")
    amplitude = probe.drive.free_amplitude
    signals, height, counts = _repulsive_part(parts, setting)
    values = dict(setting.values)
    fitted = {
        name: error for name, error in setting.prior.items() if name not in ("A0_slope_x", "A0_slope_y")
    }
    names, covariance = joint(tuple(far.values), fitted, far.covariance)
    covariance = with_far_phase(names, covariance, probe)
    share = np.sqrt(counts)
    noise: dict[str, float | _Floats] = {name: value / share for name, value in setting.sigma.items()}
    # what shakes the phase is a vector of a size, and turns a small amplitude farther
    noise["phi1"] = noise["phi1"] * amplitude / np.abs(signals.phasor[1])
    noise["height"] = setting.height_noise
    for n in signals.orders:
        if n != 1 and f"A{n}" in noise:
            added = float(abs(distortion_of(values, n)[0]))
            noise[f"A{n}"] = np.hypot(noise[f"A{n}"], _FOLLOWED * added)
    kept = {n: a for n, a in signals.phasor.items() if n == 1 or f"gain{n}" in names}
    curve = Curve(Signals(signals.mean, kept), height, noise)
    fit = fit_approach(
        curve,
        probe,
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
        values[f"latency{n}"] = float(wrapped(values[f"latency{n}"]))
    covariance = _inflated(fit, findings)
    _check_gains(values, fit)
    names, covariance = joint(fit.names, setting.prior, covariance)
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
    table = _table(signals, values, amplitude, height - centre, fit)
    return Calibration(
        probe, amplitude, values, names, covariance, dict(setting.sigma), material, table, tuple(findings)
    )


def with_far_phase(names: Sequence[str], covariance: _Floats, probe: Probe) -> _Floats:
    """Return a covariance in which the zero of the phase follows the lever: what is known is the phase read far away.

    The lag of a free lever depends on its resonance, and off resonance on Q; the zero is what is read less that lag.
    """
    turn = np.eye(len(names))
    for name in ("quality_factor", "resonance"):
        if name in names:
            turn[names.index("phi1_offset"), names.index(name)] = -far_phase_slope(probe, NEUTRAL, name)
    return np.asarray(turn @ covariance @ turn.T)


def corrected_curve(
    parts: CurveParts, values: Mapping[str, float], amplitude: float, centre: float
) -> dict[str, _Floats]:
    """Return the corrected curve in contact, thinned, where no reference says what it should be."""
    signals, height, _ = binned(parts, amplitude, BINS)
    clean = undo(signals, values, amplitude, height=height - centre)
    frame = in_the_frame_of_the_first(clean)
    curve = _first(clean)
    if clean.mean is not None:
        curve["A0"] = clean.mean
    for n in HIGHER:
        if n in frame:
            curve |= {f"e{n}_re": frame[n].real, f"e{n}_im": frame[n].imag}
    return curve


def _table(
    signals: Signals, values: Mapping[str, float], amplitude: float, height: _Floats, fit: Fit
) -> dict[str, _Floats]:
    """Return the curve on the reference: amplitude and phase as corrected, the rest as the fit predicts it."""
    table = _first(undo(signals, values, amplitude, height=height))
    if signals.mean is not None:
        table["A0"] = fit.predicted["A0"]
    for n in HIGHER:
        if f"e{n}" in fit.predicted:
            table |= {f"e{n}_re": fit.predicted[f"e{n}"].real, f"e{n}_im": fit.predicted[f"e{n}"].imag}
    return table


def _first(clean: Signals) -> dict[str, _Floats]:
    first = clean.phasor[1]
    return {"A1": np.abs(first), "phi1": np.mod(-np.angle(first), 2.0 * math.pi)}


def _repulsive_part(parts: CurveParts, setting: Setting) -> tuple[Signals, _Floats, _Floats]:
    """Return signals, heights and counts where the first conservative harmonic pushes."""
    signals, height, counts = binned(parts, setting.probe.drive.free_amplitude, BINS)
    if not {0, 2} & set(signals.orders):
        raise CalibrationError(
            "a reference needs more than the first harmonic",
            expected="A0, or A2 and phi2, on the approach curve",
            got="A1 and phi1",
            hint="a calibration without --reference gives the zero of the phase",
        )
    first = Signals(None, {1: signals.phasor[1]})
    clean = undo(first, setting.values, setting.probe.drive.free_amplitude).phasor[1]
    there = probe_with(setting.probe, setting.values)
    free = there.drive.free_amplitude * np.exp(1j * (-np.angle(clean) - far_phase(there)))
    force = (np.abs(clean) - free) / complex(read_receptance(there, there.drive.frequency))
    pushes = np.asarray(force.real < 0.0)
    if np.count_nonzero(pushes) < _FEWEST_CONTACT:
        raise CalibrationError(
            "the curve never touches in repulsion",
            expected=f"{_FEWEST_CONTACT} heights or more at which the first conservative harmonic is negative",
            got=str(int(np.count_nonzero(pushes))),
            hint="a deeper curve, a larger amplitude, or another sign of the phase (phase_sign=-1)",
        )
    return taken(signals, pushes), height[pushes], counts[pushes]


def _check_gains(values: Mapping[str, float], fit: Fit) -> None:
    if "gain0" in fit.names and values["gain0"] < _LEAST_GAIN:
        raise CalibrationError(
            "the mean deflection does not follow the force",
            expected="A0 that grows where the tip is pushed, as the reference says",
            got=f"{100 * values['gain0']:.2g} % of that",
            hint="sign and unit of the deflection channel, a set-point or feedback left in it, or the reference",
        )


def _inflated(fit: Fit, findings: list[str]) -> _Floats:
    """Return the covariance of a fit, widened where the curve does not follow the model."""
    ratio = fit.chi2 / max(fit.freedom, 1)
    if not ratio <= _HOPELESS:
        raise CalibrationError(
            "the approach curve does not follow the reference",
            expected="a curve that the contact model explains within its noise, or nearly",
            got=f"chi-squared {ratio:.3g} times its freedom",
            hint="another contact model or reference, a curve in tapping and not in permanent contact, the right sign "
            "and unit of every channel; without a reference the zeros can be had",
        )
    if not fit.converged:
        findings.append(
            "the fit of the approach curve stopped before it had settled: its errors may be too small"
        )
    if ratio <= _BAD_FIT:
        return fit.covariance
    findings.append(
        f"the approach curve does not follow the model within its noise: chi-squared is {ratio:.3g} times its freedom,"
        f" and errors were widened by {math.sqrt(ratio):.3g}. Another contact model, drift during the curve, or a "
        "height that creeps may be behind it"
    )
    return fit.covariance * ratio
