"""The probe as a file describes it: which of its resonances agrees with its own free-air values."""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass

import numpy as np

from overtone.errors import ProbeError, ResonanceWarning, UncalibratedWarning
from overtone.harmonics import far_phase
from overtone.io.recording import Recording, Resonance
from overtone.probe import Probe
from overtone.units import format_quantity

PLAUSIBLE_PHASE = math.radians(10.0)
"""A free-air phase further than this from every prediction leaves the zero of the phase open [rad]."""
NOMINAL = "nominal"
"""Source of a resonance that stands where a catalogue's values stand until somebody measures it."""
_ORDER = {"tune": 0, "thermal": 1}


@dataclass(frozen=True)
class ResonanceTest:
    """A resonance held against the free-air values stored in the same file.

    Parameters
    ----------
    resonance : Resonance
        The pair of frequency and quality factor.
    probe : Probe
        The probe it makes.
    far_phase : float
        Phase lag it predicts far from the sample [rad].
    phase_error : float or None
        Stored free-air phase minus prediction [rad], in (-pi, pi]; None where the file stores none.
    amplitude_ratio : float or None
        Stored free amplitude over the one predicted from the height of the tune; None where unknown.
    """

    resonance: Resonance
    probe: Probe
    far_phase: float
    phase_error: float | None
    amplitude_ratio: float | None

    def sentence(self) -> str:
        """Return the test in words, with its numbers."""
        r = self.resonance
        text = (
            f"{r.source}: f1 = {r.frequency / 1e3:.2f} kHz, Q = {r.quality_factor:.1f} "
            f"predicts a free phase of {math.degrees(self.far_phase):.1f} deg"
        )
        if self.phase_error is not None:
            text += f" (stored: {math.degrees(self.far_phase + self.phase_error):.1f} deg)"
        if self.amplitude_ratio is not None:
            free = self.probe.drive.free_amplitude
            text += (
                f" and a free amplitude of {format_quantity(free / self.amplitude_ratio, 'm', 4)} "
                f"(stored: {format_quantity(free, 'm', 4)})"
            )
        return text


def rank_resonances(recording: Recording, *, referenced: bool = False) -> tuple[ResonanceTest, ...]:
    """Build a probe from each resonance of a file and rank them by their agreement with its free-air values.

    Parameters
    ----------
    recording : Recording
        With stiffness, drive frequency, free amplitude and at least one resonance among its facts.
    referenced : bool
        Whether the phase was referred to the free lever by hand: then nothing is said of its stored zero.

    Returns
    -------
    tuple of ResonanceTest
        The one to use first, of those that `usable_resonances` returns.

    Raises
    ------
    ProbeError
        If the file lacks what a probe needs; every missing quantity is named.

    Warns
    -----
    UncalibratedWarning
        If a quantity the probe needs is a factory default, or its resonance may be a catalogue's.
    ResonanceWarning
        If there are several resonances: the choice and its evidence; or if none fits.
    """
    facts = recording.facts
    needed = ("stiffness", "drive_frequency", "free_amplitude")
    missing = [name for name in needed if name not in facts]
    usable = usable_resonances(recording)
    if not usable:
        catalogue = "; ".join(map(why_not, recording.resonances))
        missing.append("resonance frequency and quality factor" + (f" ({catalogue})" if catalogue else ""))
    if missing:
        raise ProbeError(
            f"{recording.path.name} does not describe its probe",
            expected="stiffness, resonance, drive frequency and free amplitude",
            got="no " + ", no ".join(name.replace("_", " ") for name in missing),
            hint='a probe file: --probe probe.toml with [cantilever] stiffness = "16.4 N/m" ...',
        )
    defaults = [facts[name].key for name in needed if facts[name].factory_default]
    defaults += [
        key for r in recording.resonances if r.factory_default and r.source != NOMINAL for key in r.keys
    ]
    if defaults:
        warnings.warn(
            f"{recording.path.name} holds factory defaults for {', '.join(defaults)}: the probe was not "
            "calibrated, forces and energies have no absolute scale. Give a probe file.",
            UncalibratedWarning,
            stacklevel=2,
        )
    if usable[0].source == NOMINAL:
        pair = usable[0]
        warnings.warn(
            f"{recording.path.name}: {format_quantity(pair.frequency, 'Hz', 6)} with Q {pair.quality_factor:g} "
            f"({', '.join(pair.keys)}) stands where the catalogue's values stand until a lever is measured, and "
            "nothing says that it was. The drive lies within its width, so it was used; energies go as 1/Q. Give a "
            "probe file.",
            UncalibratedWarning,
            stacklevel=2,
        )
    tests = sorted(
        (_test(recording, resonance) for resonance in usable),
        key=lambda test: (
            abs(test.phase_error) if test.phase_error is not None else 0.0,
            _ORDER.get(test.resonance.source, 2),
        ),
    )
    if len(tests) > 1:
        rejected = "; ".join(test.sentence() for test in tests[1:])
        basis = "" if tests[0].phase_error is not None else " (no free-air phase stored to test them)"
        warnings.warn(
            f"the file holds {len(tests)} resonances{basis}. Used {tests[0].sentence()}. Rejected {rejected}.",
            ResonanceWarning,
            stacklevel=2,
        )
    error = tests[0].phase_error
    if error is not None and abs(error) > PLAUSIBLE_PHASE and not referenced:
        warnings.warn(
            f"no resonance of the file fits its stored free-air phase; the nearest is "
            f"{math.degrees(abs(error)):.0f} deg off ({tests[0].sentence()}). The zero of the phase is not "
            "established: give the phase read far from the surface.",
            ResonanceWarning,
            stacklevel=2,
        )
    return tuple(tests)


def usable_resonances(recording: Recording) -> tuple[Resonance, ...]:
    """Return the resonances of a file that may become its probe; empty where there is none.

    Measured ones, if there are any. The resonance of a lever is 10 to 20 % off its catalogue's and Q by a factor, so a
    nominal pair counts only where nothing was measured, its digits are no catalogue's, and the drive lies within its
    width, which a catalogue's frequency hits by rare chance alone. Factory defaults of a tune or a thermal fit come
    last.
    """
    others = tuple(r for r in recording.resonances if r.source != NOMINAL)
    measured = tuple(r for r in others if not r.factory_default)
    drive = recording.facts.get("drive_frequency")
    driven = tuple(
        r
        for r in recording.resonances
        if r.source == NOMINAL
        and not r.factory_default
        and drive is not None
        and abs(drive.value - r.frequency) <= 0.5 * r.frequency / r.quality_factor
    )
    return measured or driven or others


def why_not(pair: Resonance) -> str:
    """Return why a nominal resonance does not become the probe."""
    why = "is of the catalogue, not of this lever" if pair.factory_default else "is not what was driven"
    return f"{format_quantity(pair.frequency, 'Hz', 6)} with Q {pair.quality_factor:.4g}, {', '.join(pair.keys)}, {why}"


def free_phase_error(recording: Recording, probe: Probe) -> float | None:
    """Return the stored free-air phase minus the one a probe predicts [rad], None where none is stored."""
    if "free_phase" not in recording.facts:
        return None
    return float(np.angle(np.exp(1j * (recording.facts["free_phase"].value - far_phase(probe)))))


def _test(recording: Recording, resonance: Resonance) -> ResonanceTest:
    facts = recording.facts
    probe = Probe.simple(
        stiffness=facts["stiffness"].value,
        frequency=resonance.frequency,
        quality_factor=resonance.quality_factor,
        drive_frequency=facts["drive_frequency"].value,
        free_amplitude=facts["free_amplitude"].value,
    )
    predicted = far_phase(probe)
    phase_error, amplitude_ratio = free_phase_error(recording, probe), None
    if "tune_amplitude" in facts:
        # |G(r)| / |G(1)| = sin(phi_far) / r
        off_peak = math.sin(predicted) / probe.drive_ratio
        amplitude_ratio = facts["free_amplitude"].value / (facts["tune_amplitude"].value * off_peak)
    return ResonanceTest(resonance, probe, predicted, phase_error, amplitude_ratio)
