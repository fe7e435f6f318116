"""What a microscope adds to the signals, as a short list of numbers shared by a whole scan, and its removal.

    what is read                       where it comes from
    A0  = g0 A0' + offset + slopes     zero of the detector, virtual deflection that follows Z, x and y
        + distortion0(|a1|^2)          a photodiode that is not linear
    a_n = g_n exp(-i psi_n) a_n'       gain and latency of the electronics at n times the drive
        + distortion_n a1^n + d_n      photodiode; crosstalk, and the drive's own harmonics
    all of it turned by exp(-i n eps)  zero of the phase

``'`` marks what a detector without memory makes of the motion: next to what it adds to each harmonic, it weakens
all of them by the amplitude of the first, and mixes them. With ``u = |a1|^2/A_ref^2`` and the loss ``chi`` of the
first harmonic at ``A_ref``, to leading order of the response ``s + c2 s^2 + c3 s^3`` (``c3 = -4 chi/(3 A_ref^2)``),

    a1' = a1 (1 - chi u)               A0' = A0 (1 - 2 chi u) - chi Re(a1^2 conj a2)/A_ref^2
    a2' = a2 (1 - 2 chi u) - 2 chi A0 a1^2/A_ref^2 + c2 a3 conj a1
    a3' = a3 (1 - 2 chi u) + c2 a1 a2

where A0 holds whatever moves the spot, virtual deflection too, and is counted from the mean deflection at which the
distortion was measured: a spot that has moved distorts otherwise. Lengths are calibrated at ``A_ref``, so everything is
divided by ``1 - chi`` once more. Distortions are kept as what they make at ``A_ref`` [m], so that every number has the
size of a signal.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from overtone.harmonics import far_phase
from overtone.instrument.signals import Signals
from overtone.probe import Cantilever, Probe

_Floats = npt.NDArray[np.float64]
_Complex = npt.NDArray[np.complex128]

HIGHER = (2, 3)
"""Harmonics that a calibration covers beside the mean and the first."""
_NUDGE = 1e-6  # of a factor, for differences
TERMS = 3
"""Powers of |a1|^2 in the distortion of a harmonic."""


@dataclass(frozen=True)
class Unknown:
    """One number that a whole scan shares.

    Parameters
    ----------
    name, unit, meaning : str
        What it is called, its SI unit (``"1"`` for plain numbers) and what it is.
    neutral : float
        Its value in a microscope that adds nothing.
    """

    name: str
    unit: str
    meaning: str
    neutral: float = 0.0


def _of_a_harmonic(n: int) -> list[Unknown]:
    parts = (("re", "real"), ("im", "imaginary"))
    terms = [
        Unknown(
            f"distortion{n}_{j}_{short}",
            "m",
            f"{part} part of what the detector adds to a{n} at A_ref, |a1|^{2 * j}",
        )
        for j in range(TERMS)
        for short, part in parts
    ]
    return [
        *terms,
        *(
            Unknown(f"crosstalk{n}_{short}", "m", f"{part} part of a{n} without motion")
            for short, part in parts
        ),
        Unknown(f"gain{n}", "1", f"what is read of a{n} over what there is", 1.0),
        Unknown(f"latency{n}", "rad", f"lag of the electronics at harmonic {n} beyond that of a pure delay"),
    ]


UNKNOWNS: tuple[Unknown, ...] = (
    Unknown("A0_offset", "m", "mean deflection read without a force"),
    Unknown("A0_slope_z", "1", "mean deflection read per height of the base"),
    Unknown("A0_slope_x", "1", "mean deflection read per way along the fast axis"),
    Unknown("A0_slope_y", "1", "mean deflection read per way along the slow axis"),
    Unknown("distortion0_0", "m", "what the detector adds to A0 at A_ref, |a1|^2"),
    Unknown("distortion0_1", "m", "what the detector adds to A0 at A_ref, |a1|^4"),
    Unknown("gain0", "1", "what is read of A0 over what there is", 1.0),
    Unknown("phi1_offset", "rad", "what is read of phi1 beyond the lag of the lever"),
    Unknown("compression", "1", "share of the first harmonic that the detector loses at A_ref"),
    *(unknown for n in HIGHER for unknown in _of_a_harmonic(n)),
    Unknown("stiffness", "1", "stiffness over the one of the probe", 1.0),
    Unknown("quality_factor", "1", "quality factor over the one of the probe", 1.0),
    Unknown("resonance", "1", "resonance over the one of the probe", 1.0),
    Unknown("free_amplitude", "1", "free amplitude over the one of the probe", 1.0),
    Unknown("radius", "1", "tip radius over the one of the probe", 1.0),
)
NAMES: tuple[str, ...] = tuple(unknown.name for unknown in UNKNOWNS)
NEUTRAL: Mapping[str, float] = {unknown.name: unknown.neutral for unknown in UNKNOWNS}
LEVER = ("stiffness", "quality_factor", "resonance", "free_amplitude", "radius")
"""Unknowns of the probe; the others are of the signals."""


def distortion_basis(first: _Complex, n: int, reference: float) -> _Complex:
    """Return what each term of the distortion of a harmonic adds per unit of its coefficient.

    Parameters
    ----------
    first : complex array, any shape
        a_1 as it is read [m].
    n : int
        Harmonic, 0 for the mean, which has one term less and is real.
    reference : float
        A_ref [m].

    Returns
    -------
    array, shape of ``first`` and a last axis of terms
        ``(a_1/A_ref)^n u^j``, for the mean ``u^(j+1)``, with ``u = |a_1|^2/A_ref^2``.
    """
    scaled = first / reference
    u = np.abs(scaled) ** 2
    if n == 0:
        return np.stack([u ** (j + 1) + 0j for j in range(TERMS - 1)], axis=-1)
    return np.stack([scaled**n * u**j for j in range(TERMS)], axis=-1)


def distortion_of(values: Mapping[str, float], n: int) -> _Complex:
    """Return the coefficients of the distortion of a harmonic, as `distortion_basis` orders them [m]."""
    if n == 0:
        return np.array([values[f"distortion0_{j}"] for j in range(TERMS - 1)], dtype=complex)
    return np.array(
        [complex(values[f"distortion{n}_{j}_re"], values[f"distortion{n}_{j}_im"]) for j in range(TERMS)]
    )


def distortion(first: _Complex, n: int, reference: float, values: Mapping[str, float]) -> _Complex:
    """Return what the distortion adds to a harmonic [m]; arguments as of `distortion_basis` and `distortion_of`."""
    scaled = first / reference
    u = np.abs(scaled) ** 2
    total = np.zeros_like(scaled)
    for coefficient in distortion_of(values, n)[::-1]:
        total = total * u + coefficient
    return np.asarray(total * (scaled**n if n else u))


def crosstalk_of(values: Mapping[str, float], n: int) -> complex:
    """Return d_n [m]."""
    return complex(values[f"crosstalk{n}_re"], values[f"crosstalk{n}_im"])


@np.errstate(invalid="ignore")  # lost pixels stay lost
def undo(
    read: Signals,
    values: Mapping[str, float],
    reference: float,
    *,
    height: Any = 0.0,
    x: Any = 0.0,
    y: Any = 0.0,
) -> Signals:
    """Return signals freed of what the instrument added.

    Parameters
    ----------
    read : Signals
        As the microscope stored them.
    values : mapping
        Every unknown of `UNKNOWNS`; those of the lever do not count here (`probe_with`).
    reference : float
        A_ref [m].
    height, x, y : float or array
        Where each reading was taken [m], for the slopes of the mean deflection.

    Notes
    -----
    The terms that mix harmonics are taken to first order of the detector's curvature; what is left is of the order
    of ``chi^2`` times the signal, and of ``c2`` times the square of what moved the spot. Harmonics beyond the third
    are turned and otherwise left alone.
    """
    first = read.phasor[1]
    square = (first / reference) ** 2
    u = np.abs(square)
    chi, gain = values["compression"], values["gain0"]
    weakened = (1.0 - 2.0 * chi * u) / (1.0 - chi)
    higher: dict[int, _Complex] = {}
    for n, a in read.phasor.items():
        if n in HIGHER:
            added = distortion(first, n, reference, values) + crosstalk_of(values, n)
            higher[n] = (a - added) * np.exp(1j * values[f"latency{n}"]) / values[f"gain{n}"]
    mean = moved = None
    if read.mean is not None:
        slopes = values["A0_slope_z"] * np.asarray(height)
        slopes = slopes + values["A0_slope_x"] * np.asarray(x) + values["A0_slope_y"] * np.asarray(y)
        bowed = distortion(first, 0, reference, values).real
        # all that moved the spot; the electronics come behind the detector
        moved = (read.mean - values["A0_offset"] - bowed) / weakened / gain
        # slopes are quoted as read at A_ref, where they were measured
        mean = moved - slopes * (1.0 - chi) / (1.0 - 2.0 * chi) / gain
        if 2 in higher:
            mean = mean + chi * (square * np.conj(higher[2])).real / weakened
    if 2 in higher:
        second = higher[2]
        if moved is not None:
            second = second + 2.0 * chi * moved * weakened * square
        curvature = 2.0 * distortion_of(values, 2)[0] / reference**2  # c2, as it was before the electronics
        curvature = (curvature * np.exp(1j * values["latency2"]) / values["gain2"]).real
        if 3 in higher:
            third = higher[3]
            higher[3] = third - curvature * second * first
            second = second - curvature * third * np.conj(first)
        higher[2] = second / weakened
    if 3 in higher:
        higher[3] = higher[3] / weakened
    rest = {n: a for n, a in read.phasor.items() if n > 1}
    turned = {1: first * (1.0 - chi) / (1.0 - chi * u)} | rest | higher
    eps = values["phi1_offset"]
    return Signals(mean, {n: a * np.exp(1j * n * eps) for n, a in sorted(turned.items())})


def probe_with(probe: Probe, values: Mapping[str, float]) -> Probe:
    """Return a probe with its factors: of stiffness, free amplitude, radius, and Q and resonance of the first mode."""
    factor = values["stiffness"]
    first, *others = probe.cantilever.modes
    modes = (
        replace(
            first,
            stiffness=first.stiffness * factor,
            quality_factor=first.quality_factor * values["quality_factor"],
            frequency=first.frequency * values["resonance"],
        ),
        *(replace(mode, stiffness=mode.stiffness * factor) for mode in others),
    )
    static = probe.cantilever.static_stiffness
    lever = Cantilever(
        modes, static * factor if static is not None else None, probe.cantilever.static_slope_ratio
    )
    radius = probe.tip.radius
    return replace(
        probe,
        cantilever=lever,
        drive=replace(probe.drive, free_amplitude=probe.drive.free_amplitude * values["free_amplitude"]),
        tip=replace(probe.tip, radius=radius * values["radius"] if radius is not None else None),
    )


def far_phase_slope(probe: Probe, values: Mapping[str, float], name: str) -> float:
    """Return by how much the lag of the free lever turns per unit of one of its factors, at given values [rad]."""
    moved = probe_with(probe, {**values, name: values[name] + _NUDGE})
    return float(wrapped(far_phase(moved) - far_phase(probe_with(probe, values)))) / _NUDGE


def wrapped(angle: Any) -> Any:
    """Return an angle between -pi and pi."""
    return (np.asarray(angle) + math.pi) % (2.0 * math.pi) - math.pi
