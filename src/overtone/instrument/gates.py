"""What a calibration supports: a modulus, ratios to a reference, or contrast, and which number stands in the way.

Three harmonics determine modulus, adhesion and indentation of a pixel; what an error of the instrument does to the
modulus follows from the inverse of that map. A stiff sample multiplies it by hundreds, and no number of pixels
helps. So the question is asked of the model before anything is believed: by how much does every unknown move ln E, and
how large may it be?
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from overtone.contact.models import contact_model
from overtone.contact.sample import OF_THE_PROBE, Sample, sample
from overtone.dynamics.balance import FOUND
from overtone.dynamics.hold import hold_amplitude
from overtone.dynamics.indented import indented_states
from overtone.errors import CalibrationError
from overtone.instrument.calibration import Calibration
from overtone.instrument.shared import conservative, redo
from overtone.instrument.signals import signals_of
from overtone.instrument.unknowns import UNKNOWNS, probe_with, undo
from overtone.units import format_quantity

_Floats = npt.NDArray[np.float64]

ABSOLUTE, RELATIVE, CONTRAST = "absolute", "relative", "contrast"
GATE = 0.25
"""Standard deviation of ln E that a modulus may have from shared errors and still be called one."""
SOFTER = 20.0
"""The second material of a table is the reference made softer by so much, as the soft phase of many a blend."""

_STEP = 1e-3
_LEAST_LENGTH, _LEAST = 1e-15, 1e-6  # steps of an unknown whose error is none [m, 1 or rad]
_MEANINGLESS = 2.0  # standard deviation of ln E beyond which linear errors say only "not determined"
_UNITS = {unknown.name: unknown.unit for unknown in UNKNOWNS}


@dataclass(frozen=True)
class Gate:
    """What a calibration supports for one material at one set-point.

    Parameters
    ----------
    material : str
        What it is called.
    modulus : float
        The modulus at which the question was asked [Pa].
    setpoint : float
        A1 / A1far.
    sensitivity : mapping of str to float
        d ln E per SI unit of each unknown of the calibration.
    tolerance : mapping of str to float
        How large an unknown may be alone [SI]: it then moves ln E by `GATE`.
    absolute_error, relative_error : float
        Standard deviation of ln E from all shared errors together, and the same once a reference of known modulus in
        the scan has been used; NaN for the reference itself and without one.
    verdict : str
        ``absolute``, ``relative`` or ``contrast``.
    reason : str
        Why, in words.
    """

    material: str
    modulus: float
    setpoint: float
    sensitivity: Mapping[str, float]
    tolerance: Mapping[str, float]
    absolute_error: float
    relative_error: float
    verdict: str
    reason: str


def gates(
    calibration: Calibration,
    *,
    setpoint: float,
    materials: Mapping[str, Sample] | None = None,
    harmonics: Sequence[int] = (0, 1, 2),
) -> tuple[Gate, ...]:
    """Return what a calibration supports at a set-point, material by material.

    Parameters
    ----------
    calibration : Calibration
        Of a probe with a tip radius, with gains.
    setpoint : float
        A1 / A1far, between 0 and 1.
    materials : mapping of str to Sample, optional
        Materials to ask for; the reference, and one that is softer by `SOFTER`, unless given. One with the name of the
        reference is the reference as the calibration has it.
    harmonics : sequence of int
        The three harmonics that are inverted.

    Raises
    ------
    CalibrationError
        If the calibration has no reference and no materials are given, a material is an array of several, or no
        repulsive state exists.

    Notes
    -----
    To first order, at one pixel without noise: averaging pixels does nothing against shared errors. Where the answer
    is beyond 1 its size means nothing but "not determined". At the middle of the scan, where slopes of A0 do nothing.
    """
    known = calibration.reference
    if known is not None and "modulus" not in known.properties:
        known = None
    if known is None and not materials:
        raise CalibrationError(
            "no material to ask for",
            expected="a calibration with a reference that has a modulus, or materials",
        )
    wanted: dict[str, Sample] = dict(materials or {})
    several = [name for name, material in wanted.items() if material.shape]
    if several:
        raise CalibrationError(
            "a gate is for one material", expected="plain numbers", got=f"arrays for {several[0]}"
        )
    itself, reference_row = None, None
    if known is not None:
        own = {name: value for name, (value, _) in known.properties.items()}
        itself = sample(known.model, poisson_ratio=known.poisson_ratio, **own)
        reference_row = _sensitivity(calibration, itself, setpoint, harmonics)
        if not wanted:
            soft = {**own, "modulus": own["modulus"] / SOFTER}
            wanted = {
                known.name: itself,
                f"{SOFTER:g} times softer": sample(known.model, poisson_ratio=known.poisson_ratio, **soft),
            }
    result = []
    for name, material in wanted.items():
        relative = math.nan
        if known is not None and itself is not None and reference_row is not None:
            if name == known.name:
                result.append(_gate(calibration, name, itself, setpoint, reference_row, relative))
                continue
            row = _sensitivity(calibration, material, setpoint, harmonics)
            relative = _given_the_reference(calibration, row, reference_row, known.properties["modulus"][1])
        else:
            row = _sensitivity(calibration, material, setpoint, harmonics)
        result.append(_gate(calibration, name, material, setpoint, row, relative))
    return tuple(result)


def _sensitivity(
    calibration: Calibration, material: Sample, setpoint: float, harmonics: Sequence[int]
) -> _Floats:
    """Return d ln E per unit of each unknown in the covariance.

    Raises
    ------
    CalibrationError
        If there is no repulsive state, or the motion in it is not found.
    """
    probe = probe_with(calibration.probe, calibration.values)
    n_max = max(10, *harmonics)
    state = hold_amplitude(probe, material, setpoint=setpoint, n_max=n_max, keep=max(3, *harmonics))
    if not np.isfinite(float(state["A1"])):
        raise CalibrationError(
            "no repulsive state at this set-point",
            got=f"A1/A1far = {setpoint:g} on {format_quantity(float(material.values['modulus']), 'Pa')}",
            hint="a deeper set-point or a larger amplitude",
        )
    clean = signals_of(state.expand_dims("point"))
    A, delta = float(state["A1"]), float(state["indentation"])
    free = [q.name for q in material.model.parameters if q.name in ("modulus", "adhesion")]

    def model(changes: _Floats) -> _Floats:
        """Return CONS_n with each free property and the indentation changed by a share."""
        values = {name: float(value) for name, value in material.values.items()}
        for name, change in zip(free, changes, strict=False):
            values[name] *= math.exp(change)
        own = {q.name for q in contact_model(material.model.key).parameters} - set(OF_THE_PROBE)
        there = sample(material.model.key, **{n: v for n, v in values.items() if n in own})
        deeper = delta * math.exp(changes[-1])
        states = indented_states(probe, there, amplitude=[A], indentation=[deeper], n_max=n_max)
        if int(states.status[0]) != FOUND:
            raise CalibrationError(
                "the motion at this set-point is not found",
                got=f"A1/A1far = {setpoint:g} on {format_quantity(float(values['modulus']), 'Pa')}",
                hint="a shallower set-point or a stiffer lever",
            )
        return np.asarray(states.force[0, list(harmonics)].real)

    unknowns = len(free) + 1
    J = np.empty((len(harmonics), unknowns))
    for k in range(unknowns):
        step = np.zeros(unknowns)
        step[k] = _STEP
        J[:, k] = (model(step) - model(-step)) / (2.0 * _STEP)
    to_modulus = np.linalg.pinv(J)[0]
    read = redo(clean, calibration.values, calibration.amplitude)

    def forces(values: Mapping[str, float]) -> _Floats:
        signals = undo(read, values, calibration.amplitude)  # at the middle of the scan: no slopes
        return np.asarray(conservative(signals, probe_with(calibration.probe, values), harmonics)[0])

    row = []
    for name in calibration.names:
        width = max(1e-2 * calibration.error(name), _LEAST_LENGTH if _UNITS[name] == "m" else _LEAST)
        middle = calibration.values[name]
        up, down = ({**calibration.values, name: middle + w} for w in (width, -width))
        change = float(to_modulus @ (forces(up) - forces(down))) / (2.0 * width)
        # E* goes as 1/sqrt(R) at a given Lambda
        row.append(change - (0.5 / calibration.values["radius"] if name == "radius" else 0.0))
    return np.array(row)


def _given_the_reference(
    calibration: Calibration, row: _Floats, reference: _Floats, reference_error: float
) -> float:
    """Return the error of ln E once a reference in the scan, of known modulus, was inverted with the same errors."""
    C = calibration.covariance
    along = C @ reference
    left = C - np.outer(along, along) / (float(reference @ along) + reference_error**2)
    return math.sqrt(max(float(row @ left @ row), 0.0))


def _gate(
    calibration: Calibration, name: str, material: Sample, setpoint: float, row: _Floats, relative: float
) -> Gate:
    absolute = math.sqrt(max(float(row @ calibration.covariance @ row), 0.0))
    verdict = ABSOLUTE if absolute <= GATE else RELATIVE if relative <= GATE else CONTRAST
    share = {n: abs(float(r)) * calibration.error(n) for n, r in zip(calibration.names, row, strict=True)}
    worst = sorted(share, key=lambda n: -share[n])[:3]
    tolerance = {
        n: GATE / abs(float(r)) if r else math.inf for n, r in zip(calibration.names, row, strict=True)
    }
    limits = ", ".join(
        f"{n} is known to {_text(calibration.error(n), n)} where {_text(tolerance[n], n)} would do"
        for n in worst
        if n == worst[0] or share[n] > 0.5 * GATE
    )
    size = f"shared errors {_moved(absolute)}"
    if verdict == ABSOLUTE:
        reason = f"{size}, one standard deviation"
    elif verdict == RELATIVE:
        reason = f"{size}; they {_moved(relative, 'its ratio to the reference')}: {limits}"
    else:
        ratio = (
            "" if math.isnan(relative) else f"; for its ratio to the reference they {_moved(relative, 'it')}"
        )
        reason = f"{size}{ratio}: {limits}"
    return Gate(
        name,
        float(material.values["modulus"]),
        setpoint,
        dict(zip(calibration.names, map(float, row), strict=True)),
        tolerance,
        absolute,
        relative,
        verdict,
        reason,
    )


def _moved(error: float, what: str = "its modulus") -> str:
    """Say what an error of ln E means; far beyond 1 a factor means nothing."""
    return (
        f"move {what} by a factor of {math.exp(error):.3g}" if error < _MEANINGLESS else f"leave {what} open"
    )


def _text(value: float, name: str) -> str:
    unit = _UNITS[name]
    if unit != "1" or name.startswith("A0_slope"):
        return format_quantity(value, unit, 3)
    return f"{100.0 * value:.2g} %"
