"""Probe and sample as compiled code needs them: receptances, the drive as phasors, the law as a table."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from overtone.beam import warn_of_internal_resonance
from overtone.contact import law
from overtone.contact.sample import Sample
from overtone.dynamics.balance import Lever
from overtone.errors import ContactModelError
from overtone.harmonics import far_phase, read_receptance, tip_receptance
from overtone.kernels import inner
from overtone.probe import BASE, SLOPE, Probe, required_radius

_Floats = npt.NDArray[np.float64]
_Complex = npt.NDArray[np.complex128]


class Excitation(NamedTuple):
    """The drive as phasors in its own time, ``x(t) = Re(phasor exp(i w t))``, scaled to the free amplitude.

    The origin of time is that of the equivalent force, which therefore is real. The free motion of the gap is
    ``G_tip(w) force``, whether the drive acts on the tip or on the base.
    """

    force: float
    """The force at the tip that would move the tip as much [N]."""
    reading: complex
    """What the detector reads far from the sample [m]."""
    modal: _Complex
    """Static deflection of each mode under its share of the drive [m]: q_j = modal/(1 - x^2 + i x/Q)."""
    direct: complex
    """What moves the gap without any mode [m]: the base itself, or modes left out."""
    direct_reading: complex
    """What of that the detector reads [m]."""


def excitation(probe: Probe) -> Excitation:
    """Return the drive of a probe as phasors."""
    cantilever, drive = probe.cantilever, probe.drive
    modes = cantilever.modes
    x = drive.frequency / np.array([mode.frequency for mode in modes])
    response = 1.0 / (1.0 - x**2 + 1j * x / np.array([mode.quality_factor for mode in modes]))
    weights = np.array([mode.slope_ratio if probe.detector.kind == SLOPE else 1.0 for mode in modes])
    if drive.acts_on == BASE:
        # a base that moves by y = 1 drives mode j by -Gamma_j y'' = Gamma_j w^2, and moves the gap with it
        modal = np.array([mode.base_participation for mode in modes]) * x**2 + 0j
        direct, direct_reading = 1.0 + 0j, 0.0 + 0j
    else:
        modal = 1.0 / np.array([mode.stiffness for mode in modes]) + 0j
        direct, direct_reading = (complex(c) for c in static_remainder(probe))
    gap = complex(modal @ response) + direct
    reading = complex((weights * modal) @ response) + direct_reading
    # turn the origin of time to that of the equivalent force, and scale to the amplitude that is read
    G = complex(tip_receptance(cantilever, drive.frequency))
    scale = drive.free_amplitude / abs(reading)
    turn = scale * np.exp(-1j * np.angle(gap / G))
    return Excitation(
        abs(gap / G) * scale, reading * turn, modal * turn, direct * turn, direct_reading * turn
    )


def static_remainder(probe: Probe) -> tuple[float, float]:
    """Return the compliance of the modes left out [m/N], of the tip and as it is read."""
    cantilever = probe.cantilever
    if cantilever.static_stiffness is None:
        return 0.0, 0.0
    slope = probe.detector.kind == SLOPE
    static = 1.0 / cantilever.static_stiffness
    tip = static - sum(1.0 / mode.stiffness for mode in cantilever.modes)
    read = static * (cantilever.static_slope_ratio if slope else 1.0)
    read -= sum((mode.slope_ratio if slope else 1.0) / mode.stiffness for mode in cantilever.modes)
    return tip, read


class Laws(NamedTuple):
    """The force laws of a sample, one a point of its arrays, flat."""

    table: _Floats
    """(point, term, column), see `overtone.contact.law`."""
    levels: _Floats
    """(point, level): gaps at which the law is not smooth [m], rising."""
    kinks: npt.NDArray[np.int64]
    """(point,): how many of them."""
    made: _Floats
    """(point,): gap below which a contact is held, -infinity without hysteresis [m]."""
    lost: _Floats
    """(point,): gap above which it lets go, infinity without hysteresis [m]."""
    pull: _Floats
    """(point,): a bound of the strongest attraction [N]."""

    def at(self, point: int) -> law.Law:
        """Return the law of one point, as kernels take it."""
        numbers = int(self.kinks[point]), float(self.made[point]), float(self.lost[point])
        return law.Law(self.table[point], self.levels[point], *numbers)

    def only(self, points: Any) -> Laws:
        """Return the laws of some points."""
        return Laws(*(array[points] for array in self))


@inner
def law_at(laws: Laws, point: int) -> law.Law:
    """Return the law of one point, inside a kernel."""
    return law.Law(
        laws.table[point], laws.levels[point], laws.kinks[point], laws.made[point], laws.lost[point]
    )


def laws(probe: Probe, sample: Sample) -> Laws:
    """Return the force laws of a sample under the tip of a probe.

    Raises
    ------
    ContactModelError
        If the model cannot be followed by gap, velocity and one flag.
    ProbeError
        If the model needs a tip radius and the probe has none.
    """
    names = {parameter.name for parameter in sample.model.parameters}
    given = {
        "tip_modulus": probe.tip.modulus,
        "tip_poisson_ratio": probe.tip.poisson_ratio,
        "frequency": probe.drive.frequency,
    }
    if "radius" in names:
        given["radius"] = required_radius(probe)
    own = {name: np.broadcast_to(value, sample.shape) for name, value in given.items() if name in names}
    table = sample.model.table({**sample.values, **own})
    # a copy, so that every law is of one type for compiled code
    table = np.array(np.broadcast_to(table, (*sample.shape, *table.shape[-2:]))).reshape(
        -1, *table.shape[-2:]
    )
    points = table.shape[0]
    if points == 0:
        raise ContactModelError(
            "the sample has no points", expected="one material or more", got=str(sample.shape)
        )
    levels, kinks = np.full((points, law.LEVELS), math.inf), np.empty(points, np.int64)
    made, lost = np.empty(points), np.empty(points)
    law.level_block(table, levels, kinks, made, lost)
    if (kinks < 0).any():
        raise ContactModelError(
            f"model {sample.model.key!r} has too many kinks",
            expected=f"at most {law.LEVELS} gaps at which the force is not smooth",
        )
    if (np.count_nonzero((table[:, :, 0] == law.NECK) | (table[:, :, 0] == law.CURVE), axis=1) > 1).any():
        raise ContactModelError(
            f"model {sample.model.key!r} has two terms with hysteresis", expected="one at most"
        )
    # adhesion and necks pull with their first coefficient; a JKR or Maugis contact with 2 pi w R at most
    kinds = table[:, :, 0]
    pulls = np.where((kinds == law.ADHESION) | (kinds == law.NECK), table[:, :, 1], 0.0)
    pulls += np.where(kinds == law.CURVE, 2.0 * table[:, :, 8], 0.0)
    return Laws(table, levels, kinks, made, lost, pulls.sum(axis=1))


class Receptances(NamedTuple):
    """Answer of the lever to a force at the tip at the harmonics of the drive, n = 0, 1, ... [m/N]."""

    tip: _Complex
    read: _Complex


def receptances(probe: Probe, n_max: int) -> Receptances:
    """Return the receptances at 0, w, 2 w, ... n_max w."""
    frequencies = np.arange(n_max + 1) * probe.drive.frequency
    return Receptances(tip_receptance(probe.cantilever, frequencies), read_receptance(probe, frequencies))


class Setup(NamedTuple):
    """A probe with what follows from it."""

    probe: Probe
    receptance: Receptances
    drive: Excitation
    lever: Lever

    @property
    def free(self) -> float:
        """Amplitude of the tip far from the sample [m]."""
        return float(abs(self.lever.tip[1]) * self.lever.force)


def setup(probe: Probe, n_max: int) -> Setup:
    """Return a probe as the dynamics need it, with n_max harmonics; warn where a mode meets the sixth."""
    warn_of_internal_resonance(probe.cantilever)
    receptance, drive = receptances(probe, n_max), excitation(probe)
    ratio = receptance.read[1] / receptance.tip[1]
    reading = np.array([ratio, drive.reading - ratio * receptance.tip[1] * drive.force])
    lever = Lever(receptance.tip, drive.force, reading, 2.0 * math.pi * probe.drive.frequency)
    return Setup(probe, receptance, drive, lever)


def phase_offset(probe: Probe, drive: Excitation) -> float:
    """Return what turns a phase in the time of the drive into a lag as it is reported [rad].

    Reported lags are such that the free motion has that of `far_phase`, however the lever is driven.
    """
    return float(far_phase(probe) + np.angle(drive.reading))
