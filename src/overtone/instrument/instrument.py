"""What a microscope adds to the signals, as one record, and how readings come out of a motion.

The order is that of the light and the wires: the laser spot moves by the deflection and by what shifts it; the
photodiode turns that into a voltage, not quite linearly; the electronics delay and weaken every harmonic and let some
of the drive through; the lock-in filters; noise comes on top.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import numpy.typing as npt
import xarray as xr

from overtone.errors import OvertoneError
from overtone.harmonics import read_receptance
from overtone.instrument.photodiode import SplitDiode, read_through
from overtone.instrument.signals import Signals, signals_of, with_signals
from overtone.instrument.thermal_noise import ROOM_TEMPERATURE, thermal_noise_density
from overtone.probe import BASE, SLOPE, Probe
from overtone.quantities import named_array

_Floats = npt.NDArray[np.float64]

_SAMPLES = 32
_BLOCK = 2**14  # points in memory at a time
_SAFE = 1e-3  # Hz: below, 1/f noise is drift


@dataclass(frozen=True)
class NearSurface:
    """How the air between lever and sample changes the lever: a share at the surface that decays with height.

    Parameters
    ----------
    damping, softening : float
        Share of Q and of f_1 that is lost at the surface.
    decay : float
        Height over which that falls to 1/e [m].
    """

    damping: float = 0.0
    softening: float = 0.0
    decay: float = 5e-6


@dataclass(frozen=True)
class Instrument:
    """A microscope's own share in the signals. Every default adds nothing but noise.

    Parameters
    ----------
    mean_offset : float
        A0 read without a force [m], from the electronics.
    mean_slope_z, mean_slope_x, mean_slope_y : float
        Virtual deflection: mean deflection read per height and per way along the axes; it moves the spot.
    mean_drift : float
        Drift of the spot [m/s].
    flicker : float
        1/f noise of A0: amplitude density at 1 Hz [m/sqrt(Hz)].
    diode : SplitDiode, optional
        A photodiode with a spot of a size.
    distortion : mapping of int to float
        In place of a diode, the detector's curvature: ``{2: kappa_2 [1/m], 3: kappa_3 [1/m^2]}``, so that a first
        harmonic a1 alone makes ``kappa_n a1^n``. A detector without memory: the other harmonics follow from it.
    crosstalk : mapping of int to complex
        d_n [m]: what is read of harmonics 2, 3 without motion, at the drive of the scan.
    drive_distortion : mapping of int to complex
        Part of the same that grows as the drive squared [m], at the drive of the scan.
    gains, latency : mapping of int to float
        g_n, also for 0, and psi_n [rad] of the electronics.
    phase_offset : float
        What is read of phi1 beyond the lag [rad].
    near_surface : NearSurface
        Squeeze film.
    frequency_drift, quality_drift, drive_drift : float
        Of f_1 [Hz/s], and relative changes of Q and of the drive [1/s].
    bandwidth : float
        Noise bandwidth of the lock-in [Hz]; its time constant is ``1/(4 bandwidth)``.
    line_time : float
        Time of a line, trace and retrace [s].
    feedback_error : float
        Standard deviation of A1 about the set-point over the set-point.
    detector_noise : float
        Amplitude density of the white noise of the detector [m/sqrt(Hz)].
    temperature : float
        Of the lever [K].
    """

    mean_offset: float = 0.0
    mean_slope_z: float = 0.0
    mean_slope_x: float = 0.0
    mean_slope_y: float = 0.0
    mean_drift: float = 0.0
    flicker: float = 0.0
    diode: SplitDiode | None = None
    distortion: Mapping[int, float] = field(default_factory=dict)
    crosstalk: Mapping[int, complex] = field(default_factory=dict)
    drive_distortion: Mapping[int, complex] = field(default_factory=dict)
    gains: Mapping[int, float] = field(default_factory=dict)
    latency: Mapping[int, float] = field(default_factory=dict)
    phase_offset: float = 0.0
    near_surface: NearSurface = NearSurface()
    frequency_drift: float = 0.0
    quality_drift: float = 0.0
    drive_drift: float = 0.0
    bandwidth: float = 1e3
    line_time: float = 1.0
    feedback_error: float = 0.0
    detector_noise: float = 30e-15
    temperature: float = ROOM_TEMPERATURE

    def __post_init__(self) -> None:
        numbers = {
            "bandwidth": (self.bandwidth, 0.0, False),
            "line_time": (self.line_time, 0.0, False),
            "near_surface.decay": (self.near_surface.decay, 0.0, False),
            "temperature": (self.temperature, 0.0, False),
            "detector_noise": (self.detector_noise, 0.0, True),
            "flicker": (self.flicker, 0.0, True),
            "feedback_error": (self.feedback_error, 0.0, True),
            **{f"gain of harmonic {n}": (gain, 0.0, False) for n, gain in self.gains.items()},
        }
        bad = [
            f"{name} = {value!r}"
            for name, (value, low, equal) in numbers.items()
            if not (low <= value if equal else low < value) or not math.isfinite(value)
        ]
        if bad:
            raise OvertoneError(
                "unphysical instrument", expected="finite positive numbers", got="; ".join(bad)
            )
        if self.diode is not None and self.distortion:
            raise OvertoneError(
                "an instrument has a photodiode or a distortion, not both", hint="leave one of them out"
            )
        orders = {*self.distortion, *self.crosstalk, *self.drive_distortion, *self.latency} - {2, 3}
        if orders or set(self.gains) - {0, 2, 3}:
            raise OvertoneError(
                "harmonics of an instrument are 2 and 3, and 0 for a gain",
                got=str(sorted(orders | set(self.gains))),
            )


def lever_at(probe: Probe, instrument: Instrument, *, height: float = math.inf, time: float = 0.0) -> Probe:
    """Return the probe as it is at a height of its base [m] and a time [s]: same drive, other resonance.

    Its free amplitude is the one that this drive gives there.
    """
    near = instrument.near_surface
    share = math.exp(-max(height, 0.0) / near.decay)
    first, *others = probe.cantilever.modes
    there = replace(
        first,
        frequency=first.frequency * (1.0 - near.softening * share) + instrument.frequency_drift * time,
        quality_factor=first.quality_factor
        * (1.0 - near.damping * share)
        * (1.0 + instrument.quality_drift * time),
    )
    moved = replace(probe, cantilever=replace(probe.cantilever, modes=(there, *others)))
    before, after = (abs(complex(free_response(p, p.drive.frequency))) for p in (probe, moved))
    free = probe.drive.free_amplitude * (1.0 + instrument.drive_drift * time) * after / before
    return replace(moved, drive=replace(probe.drive, free_amplitude=free))


def free_response(probe: Probe, frequency: Any) -> npt.NDArray[np.complex128]:
    """Return what the detector reads of a free lever per drive, in a unit of its own.

    A drive at the tip is a force; one at the base is a motion, whose force on a mode grows as ``(f/f_j)^2``.
    """
    if probe.drive.acts_on != BASE:
        return read_receptance(probe, frequency)
    total = np.zeros(np.shape(frequency), complex)
    for mode in probe.cantilever.modes:
        x = np.asarray(frequency, dtype=float) / mode.frequency
        weight = mode.slope_ratio if probe.detector.kind == SLOPE else 1.0
        total = total + weight * mode.base_participation * x**2 / (1.0 - x**2 + 1j * x / mode.quality_factor)
    return total


def noise_of(instrument: Instrument, probe: Probe) -> dict[str, float]:
    """Return the standard deviations of white noise behind the lock-in: thermal motion and detector.

    Returns
    -------
    dict
        ``A0``, ``A1``, ``A2``, ``A3`` [m]; of a phasor it is that of each quadrature, ``sqrt(2 S B)``, of the mean
        ``sqrt(S B)``.
    """
    n = np.arange(4)
    thermal = thermal_noise_density(probe, n * probe.drive.frequency, instrument.temperature)
    density = np.hypot(thermal, instrument.detector_noise)
    sigma = density * np.sqrt(np.where(n == 0, 1.0, 2.0) * instrument.bandwidth)
    return {f"A{k}": float(sigma[k]) for k in n}


def readings(
    motion: xr.Dataset,
    instrument: Instrument,
    probe: Probe,
    *,
    shift: Any = 0.0,
    drive: Any = 1.0,
    generator: np.random.Generator | None = None,
) -> xr.Dataset:
    """Return what the lock-in reads of a motion.

    Parameters
    ----------
    motion : Dataset
        Observables of the motion as a perfect detector would read them; the more harmonics, the better the detector
        is followed.
    instrument : Instrument
        Detector, electronics and noise.
    probe : Probe
        Gives thermal noise, and the amplitude at which the detector's sensitivity was taken.
    shift : float or array
        What moves the spot beside the lever [m], on the dimensions of A1.
    drive : float or array
        Drive over the one of the scan, for the crosstalk.
    generator : Generator, optional
        Of the noise; without it there is none.

    Returns
    -------
    Dataset
        ``A0, A1, phi1, A2, phi2, A3, phi3`` as far as the motion has them.
    """
    signals = _detected(motion, instrument, probe, np.asarray(shift, dtype=float))
    orders = [n for n in signals.orders if n <= 3]
    sigma = noise_of(instrument, probe)

    def noise(scale: float) -> _Floats:
        shape = signals.phasor[1].shape
        return generator.normal(0.0, scale, shape) if generator is not None else np.zeros(shape)

    mean = None
    if signals.mean is not None:
        mean = signals.mean * instrument.gains.get(0, 1.0) + instrument.mean_offset + noise(sigma["A0"])
    phasors = {}
    for n in orders:
        if n == 0:
            continue
        a = signals.phasor[n] * np.exp(-1j * n * instrument.phase_offset)
        if n > 1:
            a = a * instrument.gains.get(n, 1.0) * np.exp(-1j * instrument.latency.get(n, 0.0))
            a = (
                a
                + instrument.crosstalk.get(n, 0.0) * drive
                + instrument.drive_distortion.get(n, 0.0) * drive**2
            )
        phasors[n] = a + noise(sigma[f"A{n}"]) + 1j * noise(sigma[f"A{n}"])
    kept = {f"{letter}{n}" for n in orders for letter in ("A", "phi")} | {"height"}
    return with_signals(
        motion[[str(name) for name in motion.data_vars if name in kept]], Signals(mean, phasors)
    )


def _detected(motion: xr.Dataset, instrument: Instrument, probe: Probe, shift: _Floats) -> Signals:
    """Return the harmonics behind the photodiode, its sensitivity taken at the free amplitude."""
    if instrument.diode is None and not instrument.distortion:
        signals = signals_of(motion)
        return Signals(signals.mean + shift if signals.mean is not None else None, signals.phasor)
    like = motion["A1"]
    moved = xr.DataArray(np.broadcast_to(shift, like.shape), dims=like.dims)
    free = xr.Dataset(
        {
            "A0": named_array("A0", 0.0, ()),
            "A1": named_array("A1", probe.drive.free_amplitude, ()),
            "phi1": named_array("phi1", 0.0, ()),
        }
    )
    if instrument.diode is not None:
        names = [name for n in signals_of(motion).orders for name in ((f"A{n}", f"phi{n}") if n else ("A0",))]
        behind = read_through(motion[names], instrument.diode, offset=moved, zeroed=True)
        alone = read_through(free, instrument.diode, zeroed=True)
        signals = signals_of(behind.transpose(*like.dims))
        loss = float(alone["A1"]) / probe.drive.free_amplitude
    else:
        signals = _bent(signals_of(motion), moved.values, instrument.distortion)
        alone_signals = _bent(signals_of(free), np.zeros(()), instrument.distortion)
        loss = abs(complex(alone_signals.phasor[1])) / probe.drive.free_amplitude
    mean = signals.mean / loss if signals.mean is not None else None
    return Signals(mean, {n: a / loss for n, a in signals.phasor.items()})


def _bent(signals: Signals, shift: _Floats, distortion: Mapping[int, float]) -> Signals:
    """Return harmonics behind a response ``s + 2 kappa_2 s^2 + 4 kappa_3 s^3``, sampled over a period."""
    theta = 2.0 * np.pi * np.arange(_SAMPLES) / _SAMPLES
    shape = signals.phasor[1].shape
    orders = sorted(signals.phasor)
    turns = np.exp(1j * np.outer(orders, theta))
    a = np.stack([np.broadcast_to(signals.phasor[n], shape).ravel() for n in orders], axis=-1)
    mean = np.broadcast_to(signals.mean if signals.mean is not None else 0.0, shape).ravel()
    mean = mean + np.broadcast_to(shift, shape).ravel()
    out = np.empty((a.shape[0], _SAMPLES // 2 + 1), complex)
    for start in range(0, a.shape[0], _BLOCK):
        part = slice(start, start + _BLOCK)
        s = (a[part] @ turns).real + mean[part, None]
        bent = s + 2.0 * distortion.get(2, 0.0) * s**2 + 4.0 * distortion.get(3, 0.0) * s**3
        out[part] = np.fft.rfft(bent, axis=-1) * (2.0 / _SAMPLES)
    return Signals(
        0.5 * out[:, 0].real.reshape(shape) if signals.mean is not None else None,
        {n: out[:, n].reshape(shape) for n in orders if n < _SAMPLES // 2},
    )


def flicker_noise(
    instrument: Instrument, count: int, interval: float, generator: np.random.Generator
) -> _Floats:
    """Return 1/f noise of the mean deflection in time [m].

    Parameters
    ----------
    instrument : Instrument
        Its ``flicker`` is the one-sided amplitude density at 1 Hz.
    count, interval : int and float
        Number of readings and the time between them [s].
    generator : Generator
        Of the noise.
    """
    if instrument.flicker == 0.0 or count < 2:
        return np.zeros(count)
    frequency = np.maximum(np.fft.rfftfreq(count, interval), _SAFE)
    # one-sided PSD flicker^2/f: each line of the spectrum carries S df
    amplitude = instrument.flicker * np.sqrt(1.0 / frequency / (2.0 * interval) * count)
    phase = generator.normal(size=frequency.size) + 1j * generator.normal(size=frequency.size)
    spectrum = amplitude * phase / math.sqrt(2.0)
    spectrum[0] = 0.0
    return np.asarray(np.fft.irfft(spectrum, count))
