"""What the protocol asks of one probe: widths, times, forces and noise, from its probe file."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from overtone.harmonics import far_phase, read_receptance
from overtone.instrument.thermal_noise import ROOM_TEMPERATURE, thermal_noise_density
from overtone.probe import Probe
from overtone.units import format_quantity

LADDER_POINTS = 13
"""Frequencies far from the surface, one of them at the resonance."""
LADDER_WIDTH = 3.0
"""Span of the ladder in linewidths f1/Q."""
SETTLING = 4.0
"""Ring-downs in a pixel: after as many a step has fallen to 2 %."""
LINE_POINTS = 256
"""Pixels of a line, for the line rate."""
APPROACH_LAG = 0.05e-9
"""How far the base may move [m] while amplitude and filter follow."""
CLEARANCE = 50e-9
"""Height of the lift pass beyond the free amplitude [m]."""

# What decides a modulus on the reference lever (`docs/protocol.md`): shared errors that move it by tens of per cent.
TOLERATED = {"A0": 1e-12, "phi1": math.radians(0.1), "gain": 0.01, "drive": 0.005}


def reference_probe() -> Probe:
    """Return the lever for which the tolerances were worked out: 16.4 N/m, 162 kHz, Q 287, 94 nm.

    Examples
    --------
    >>> reference_probe().drive.free_amplitude
    9.4e-08
    """
    return Probe.simple(
        stiffness=16.4,
        frequency=162e3,
        quality_factor=287,
        radius=10e-9,
        drive_frequency=162e3,
        free_amplitude=94e-9,
    )


@dataclass(frozen=True)
class LadderStep:
    """One frequency of the far-field ladder, and what the lever does there at constant drive.

    Parameters
    ----------
    frequency : float
        Drive frequency [Hz]; the second lock-in goes to exactly twice as much.
    amplitude, phase : float
        A1 [m] and its lag phi1 [rad] that the probe predicts.
    """

    frequency: float
    amplitude: float
    phase: float


@dataclass(frozen=True)
class ProbeNumbers:
    """The numbers of one probe, SI units and radians.

    Parameters
    ----------
    stiffness, frequency, quality_factor : float
        Of the first mode [N/m, Hz, 1].
    drive_frequency, free_amplitude : float
        [Hz, m].
    linewidth : float
        f1/Q [Hz], the full width of the power at half its peak.
    ring_down : float
        2Q/w1 [s], in which an amplitude falls to 1/e.
    pixel_time : float
        Shortest advisable pixel [s]: `SETTLING` ring-downs.
    line_rate : float
        Fastest advisable rate [Hz] of a line of `LINE_POINTS` pixels, trace and retrace.
    filter_corner, filter_bandwidth : float
        Corner of a first-order filter that rings down as the lever does, and its noise bandwidth [Hz].
    approach_speed : float
        Fastest advisable approach [m/s].
    lift_height : float
        Least height of the lift pass [m]: free amplitude and `CLEARANCE`, at least 150 nm.
    far_phase, phase_slope : float
        Lag of the free lever at the drive [rad], and how fast it turns with the drive frequency [rad/Hz].
    drive_force : float
        A1far / abs(G) at the drive [N].
    ladder : tuple of LadderStep
        Far-field frequencies.
    noise : tuple of float
        Thermal noise density at 0, w and 2w [m/sqrt(Hz)].
    tolerated_A0, tolerated_phase, tolerated_drive : float
        Errors of A0 [m], phi1 [rad] and drive that make the same force errors as 1 pm, 0.1 degree and 0.5 %
        on the reference lever.
    """

    stiffness: float
    frequency: float
    quality_factor: float
    drive_frequency: float
    free_amplitude: float
    linewidth: float
    ring_down: float
    pixel_time: float
    line_rate: float
    filter_corner: float
    filter_bandwidth: float
    approach_speed: float
    lift_height: float
    far_phase: float
    phase_slope: float
    drive_force: float
    ladder: tuple[LadderStep, ...]
    noise: tuple[float, float, float]
    tolerated_A0: float
    tolerated_phase: float
    tolerated_drive: float


def probe_numbers(probe: Probe, temperature: float = ROOM_TEMPERATURE) -> ProbeNumbers:
    """Return what the protocol asks of a probe.

    Parameters
    ----------
    probe : Probe
        Cantilever, drive and detector.
    temperature : float
        Temperature of the lever [K].

    Notes
    -----
    The ladder assumes a drive whose force does not depend on frequency over a few linewidths: that a real
    piezo differs is one of the things it shows.

    Examples
    --------
    >>> numbers = probe_numbers(reference_probe())
    >>> f"{numbers.linewidth:.0f} Hz, {1e3 * numbers.ring_down:.2f} ms, {1e9 * numbers.drive_force:.2f} nN"
    '564 Hz, 0.56 ms, 5.37 nN'
    """
    mode = probe.cantilever.modes[0]
    free = probe.drive.free_amplitude
    ring_down = mode.quality_factor / (math.pi * mode.frequency)
    pixel_time = SETTLING * ring_down
    force, static = _force_scales(probe)
    like, like_static = _force_scales(reference_probe())
    return ProbeNumbers(
        stiffness=mode.stiffness,
        frequency=mode.frequency,
        quality_factor=mode.quality_factor,
        drive_frequency=probe.drive.frequency,
        free_amplitude=free,
        linewidth=mode.frequency / mode.quality_factor,
        ring_down=ring_down,
        pixel_time=pixel_time,
        line_rate=1.0 / (2 * LINE_POINTS * pixel_time),
        filter_corner=1.0 / (2.0 * math.pi * ring_down),
        filter_bandwidth=1.0 / (4.0 * ring_down),
        approach_speed=APPROACH_LAG / (2.0 * ring_down),
        lift_height=max(150e-9, free + CLEARANCE),
        far_phase=far_phase(probe),
        phase_slope=_phase_slope(probe),
        drive_force=force,
        ladder=_ladder(probe),
        noise=tuple(thermal_noise_density(probe, np.arange(3) * probe.drive.frequency, temperature).tolist()),
        tolerated_A0=TOLERATED["A0"] * like_static / static,
        tolerated_phase=TOLERATED["phi1"] * like / force,
        tolerated_drive=TOLERATED["drive"] * like / force,
    )


def _force_scales(probe: Probe) -> tuple[float, float]:
    """Return the drive force [N], which is also the force per radian of phi1, and the force per A0 [N/m]."""
    at_drive, at_rest = np.abs(read_receptance(probe, [probe.drive.frequency, 0.0]))
    return probe.drive.free_amplitude / float(at_drive), 1.0 / float(at_rest)


def _phase_slope(probe: Probe) -> float:
    """Return how fast the lag of the first mode turns with the drive frequency [rad/Hz]."""
    mode, r = probe.cantilever.modes[0], probe.drive_ratio
    width = r / mode.quality_factor
    slope = (1.0 + r**2) / mode.quality_factor / ((1.0 - r**2) ** 2 + width**2)
    return slope / mode.frequency


def _ladder(probe: Probe) -> tuple[LadderStep, ...]:
    """Return frequencies evenly spaced around the resonance, and A1 and phi1 at a constant drive force."""
    mode, drive = probe.cantilever.modes[0], probe.drive
    half = 0.5 * LADDER_WIDTH * mode.frequency / mode.quality_factor
    frequencies = np.linspace(mode.frequency - half, mode.frequency + half, LADDER_POINTS)
    # Rounded here and not where it is printed: the second lock-in must stand at exactly twice what is set.
    frequencies = np.round(frequencies, ladder_decimals(mode.frequency / mode.quality_factor))
    receptance = read_receptance(probe, frequencies)
    force = drive.free_amplitude / float(abs(read_receptance(probe, drive.frequency)))
    return tuple(
        LadderStep(float(f), float(abs(force * G)), float(-np.angle(G)))
        for f, G in zip(frequencies, receptance, strict=True)
    )


def ladder_decimals(linewidth: float) -> int:
    """Return the decimals [Hz] of frequencies of the ladder: the last digit is below 1/500 of a linewidth [Hz].

    Examples
    --------
    >>> ladder_decimals(564.0), ladder_decimals(1.2)
    (0, 3)
    """
    return max(0, math.ceil(-math.log10(linewidth / 500.0)))


def texts(numbers: ProbeNumbers) -> dict[str, str]:
    """Return the numbers as texts, by the names that the steps use in braces."""
    quantities = {
        "stiffness": (numbers.stiffness, "N/m"),
        "free_amplitude": (numbers.free_amplitude, "m"),
        "linewidth": (numbers.linewidth, "Hz"),
        "ladder_span": (LADDER_WIDTH * numbers.linewidth, "Hz"),
        "ladder_step": (LADDER_WIDTH * numbers.linewidth / (LADDER_POINTS - 1), "Hz"),
        "ring_down": (numbers.ring_down, "s"),
        "pixel_time": (numbers.pixel_time, "s"),
        "filter_corner": (numbers.filter_corner, "Hz"),
        "lift_height": (numbers.lift_height, "m"),
        "far_phase": (numbers.far_phase, "rad"),
        "drive_force": (numbers.drive_force, "N"),
    }
    written = {name: format_quantity(value, unit) for name, (value, unit) in quantities.items()}
    # All digits of what is set on a generator, and units that a scan panel uses.
    written["frequency"] = f"{numbers.frequency / 1e3:.6g} kHz"
    written["drive_frequency"] = f"{numbers.drive_frequency / 1e3:.10g} kHz"
    written["second_frequency"] = f"{2.0 * numbers.drive_frequency / 1e3:.10g} kHz"
    written["line_rate"] = f"{numbers.line_rate:.2g} Hz"
    written["tenth_degree"] = f"{math.radians(0.1) / numbers.phase_slope:.2g} Hz"
    written["approach_speed"] = f"{1e9 * numbers.approach_speed:.2g} nm/s"
    written["ladder_points"] = str(LADDER_POINTS)
    written["line_points"] = str(LINE_POINTS)
    return written
