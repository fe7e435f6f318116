"""Make the figure and the tables of the page on instruments: random ones, applied to simulated curves and removed.

Run by hand, ``python docs/instruments.py``; a quarter of an hour on two cores. Every instrument is seeded by its
number, so that each comes out again by itself: ``python docs/instruments.py 17`` prints what became of it.

Half of the instruments are formulas (`overtone.Instrument`). The other half work in time: a spot of a size on a
split diode, moved by the lever and by drift, sampled by an ADC, and a digital lock-in. The calibration is the same.
"""

from __future__ import annotations

import csv
import math
import os
import sys
import warnings
from collections.abc import Iterable, Mapping
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import xarray as xr

import overtone as ot
from overtone.harmonics import far_phase
from overtone.instrument.curve_parts import split_curve
from overtone.instrument.instrument import Instrument, free_response, noise_of, readings
from overtone.instrument.lockin import NOISE_WIDTH
from overtone.instrument.photodiode import SplitDiode, observables_of, read_through
from overtone.instrument.signals import Signals, signals_of, with_signals
from overtone.instrument.trace import lock_in, sample_trace
from overtone.instrument.unknowns import undo
from overtone.quantities import named_array

Floats = npt.NDArray[np.float64]
Complex = npt.NDArray[np.complex128]

FOLDER = Path(__file__).parent
SEED, COUNT = 2024, 200
ANALYTIC, IN_TIME = "formula", "time"
LADDER, WIDE, DRIVES, NONE = "frequencies", "frequencies, wide", "drives", "none"
FAR_FIELDS = {LADDER: 1.5, WIDE: 3.0, DRIVES: 0.0, NONE: 0.0}
"""Far-field data beside the curve's own, and for a ladder of frequencies its half width in linewidths."""
HEIGHTS, POINTS = 300, 15
CURVE_TIME, LADDER_TIME = 60.0, 15.0
HEIGHT_NOISE = 0.1e-9
LARGEST_FAKE, LARGEST_LOSS = 0.9e-9, 0.02
LEVERS = ("HQ:NSC14", "HQ:NSC15", "HQ:NSC18", "Multi75Al-G", "PPP-NCHR", "PPP-NCLR", "RTESPA-150", "RTESPA-300")
NINETY = 1.6448536269514722
UNKNOWNS = ("distortion", "crosstalk2", "gain0", "gain2", "latency2")
SIGNALS = ("A0", "a2", "a3")


@dataclass(frozen=True)
class Case:
    """A lever, a reference and an instrument.

    Parameters
    ----------
    number : int
        Seed.
    kind : str
        ``formula`` or ``time``.
    probe, sample
        What there is.
    stated : Probe
        What the calibration is told, off by as much as it allows for.
    modulus : float
        What it is told of the reference [Pa].
    instrument : Instrument
        Electronics and noise; for ``formula`` the detector too.
    diode : SplitDiode or None
        For ``time``.
    drift : float
        Of the spot [m/s].
    sampling, duration : float
        Samples a period of the drive, and time that the lock-in averages over [s]; for ``time``.
    """

    number: int
    kind: str
    probe: ot.Probe
    sample: ot.Sample
    stated: ot.Probe
    modulus: float
    instrument: Instrument
    diode: SplitDiode | None
    drift: float
    sampling: float
    duration: float


# --- what is drawn ----------------------------------------------------------------------------------------------


def even_log(random: np.random.Generator, low: float, high: float) -> float:
    """Return a number whose logarithm is evenly spread."""
    return float(np.exp(random.uniform(math.log(low), math.log(high))))


def drawn(number: int) -> Case:
    """Return a case; odd ones work in time."""
    random = np.random.default_rng([SEED, number])
    while True:
        probe, sample = lever(random), reference(random)
        if repulsive(motion(probe, sample)):
            break
    kind = IN_TIME if number % 2 else ANALYTIC
    amplitude = probe.drive.free_amplitude
    diode = aligned(random, amplitude) if kind == IN_TIME else None
    first, *others = probe.cantilever.modes
    k, Q, R, E = (float(np.exp(s * random.normal())) for s in (0.05, 0.02, 0.15, 0.1))
    modes = (replace(first, stiffness=first.stiffness * k, quality_factor=first.quality_factor * Q),)
    modes += tuple(replace(mode, stiffness=mode.stiffness * k) for mode in others)
    static = probe.cantilever.static_stiffness
    cantilever = replace(
        probe.cantilever, modes=modes, static_stiffness=static * k if static is not None else None
    )
    radius = float(probe.tip.radius or 0.0) * R
    stated = replace(probe, cantilever=cantilever, tip=replace(probe.tip, radius=radius))
    return Case(
        number,
        kind,
        probe,
        sample,
        stated,
        float(sample.values["modulus"]) * E,
        instrument(random, amplitude, kind),
        diode,
        float(random.choice([-1.0, 1.0])) * even_log(random, 10e-12, 100e-12) / 60.0,
        16.382 + random.uniform(-0.05, 0.05),
        even_log(random, 1e-3, 10e-3),
    )


def lever(random: np.random.Generator) -> ot.Probe:
    """Return a lever: one mode read as displacement, or the three modes of a beam read by their slope."""
    stiffness, quality = even_log(random, 1.0, 40.0), even_log(random, 100.0, 500.0)
    frequency, amplitude = even_log(random, 50e3, 350e3), random.uniform(20e-9, 100e-9)
    radius, detuning = random.uniform(5e-9, 20e-9), random.uniform(-0.3, 0.3)
    own = {"stiffness": stiffness, "frequency": frequency, "quality_factor": quality, "radius": radius}
    drive = {"drive_frequency": frequency * (1.0 + detuning / quality), "free_amplitude": amplitude}
    if random.random() < 0.5:
        return ot.Probe.simple(**own, **drive)
    return ot.preset(str(random.choice(LEVERS)), **own, **drive)


def reference(random: np.random.Generator) -> ot.Sample:
    """Return the material of the reference."""
    return ot.sample(
        "dmt",
        modulus=even_log(random, 0.3e9, 5e9),
        poisson_ratio=0.35,
        adhesion=even_log(random, 1e-9, 20e-9),
    )


def aligned(random: np.random.Generator, amplitude: float) -> SplitDiode:
    """Return a diode that fakes at most 0.9 nm of A2 and loses at most 2 % of A1."""
    while True:
        spot = even_log(random, 300e-9, 3e-6)
        diode = SplitDiode(
            spot=spot,
            shape=str(random.choice(["round", "gaussian", "square"], p=[0.45, 0.45, 0.1])),
            offset=spot * random.uniform(-0.1, 0.1),
            gap=spot * random.uniform(0.0, 0.05),
        )
        alone = read_through(free(amplitude), diode, samples=256, zeroed=True, orders=range(4))
        if alone["A2"] < LARGEST_FAKE and alone["A1"] > (1.0 - LARGEST_LOSS) * amplitude:
            return diode


def instrument(random: np.random.Generator, amplitude: float, kind: str) -> Instrument:
    """Return electronics and noise, and for a formula the detector."""

    def complex_normal(scale: float) -> complex:
        return complex(random.normal(0.0, scale), random.normal(0.0, scale))

    bent = {
        2: random.normal(0.0, 0.3e-9) / amplitude**2,
        3: -random.uniform(0.0, LARGEST_LOSS) / 3.0 / amplitude**2,  # 3 kappa_3 A^2 is the loss
    }
    share = 0.1e-9 / math.sqrt(2.0)  # of the crosstalk, half of it with the drive and half with its square
    return Instrument(
        mean_offset=random.normal(0.0, 1e-9),
        mean_slope_z=random.uniform(-0.01, 0.01),
        distortion=bent if kind == ANALYTIC else {},
        crosstalk={n: complex_normal(share) for n in (2, 3)},
        drive_distortion={n: complex_normal(share) for n in (2, 3)},
        gains={n: random.uniform(0.8, 1.2) for n in (0, 2, 3)},
        latency={n: random.uniform(-0.5, 0.5) for n in (2, 3)},
        phase_offset=random.uniform(-math.pi, math.pi),
        bandwidth=even_log(random, 100.0, 1000.0),
        detector_noise=even_log(random, 25e-15, 100e-15),
    )


# --- what is measured -------------------------------------------------------------------------------------------


def motion(probe: ot.Probe, sample: ot.Sample) -> xr.Dataset:
    """Return an approach curve as a perfect detector reads it, with six harmonics; z falls."""
    A = probe.drive.free_amplitude
    z = np.linspace(0.15 * A, A + 200e-9, HEIGHTS)
    return ot.approach_curve(probe, sample, z=z, keep=6).isel(direction=0, drop=True)


def repulsive(curve: xr.Dataset) -> bool:
    """Return whether half of the curve in contact, and 20 points or more, push."""
    force, inside = curve["F_cons"].sel(harmonic=1).values, in_contact(curve)
    if not np.isfinite(curve["A1"].values).all():
        return False
    return bool((force[inside] < 0.0).sum() >= max(20, 0.5 * inside.sum()))


def in_contact(curve: xr.Dataset) -> npt.NDArray[np.bool_]:
    """Return which points are compared: from the first percents of loss down to a sixth of the free amplitude."""
    A, level = curve["A1"].values, float(curve["A1"].values[0])
    return np.asarray((A < 0.97 * level) & (A > 0.15 * level))


def free(first: Any) -> xr.Dataset:
    """Return the motion of a free lever, whose first harmonic [m] is given, over ``point`` where it is an array."""
    a = np.asarray(first, dtype=complex)
    dims = ("point",) if a.ndim else ()
    names = {"A0": np.zeros(a.shape), "A1": np.abs(a), "phi1": np.mod(-np.angle(a), 2.0 * np.pi)}
    names |= {f"{letter}{n}": np.zeros(a.shape) for n in (2, 3) for letter in ("A", "phi")}
    return xr.Dataset({name: named_array(name, values, dims) for name, values in names.items()})


def ladder(case: Case, far_field: str) -> tuple[Floats, Floats]:
    """Return frequencies and drives of far-field data."""
    drive, mode = case.probe.drive, case.probe.cantilever.modes[0]
    if far_field == DRIVES:
        return np.full(POINTS, drive.frequency), np.linspace(0.2, 1.0, POINTS)
    width = FAR_FIELDS[far_field] * mode.frequency / mode.quality_factor
    return mode.frequency + np.linspace(-width, width, POINTS), np.ones(POINTS)


def far_data(case: Case, far_field: str) -> xr.Dataset | None:
    """Return readings of the free lever, taken before the curve; the spot drifts meanwhile."""
    if far_field == NONE:
        return None
    frequency, drive = ladder(case, far_field)
    probe = case.probe
    own, there = (free_response(probe, f) for f in (probe.drive.frequency, frequency))
    first = probe.drive.free_amplitude * np.exp(-1j * far_phase(probe)) * there / own * drive
    z = probe.drive.free_amplitude + 200e-9
    time = np.linspace(-LADDER_TIME - 5.0, -5.0, POINTS)
    places = {"frequency": ("point", frequency), "drive": ("point", drive), "z": ("point", np.full(POINTS, z))}
    read = measured(case, free(first), z, time, frequency=frequency, drive=drive, stream=1)
    return read.assign_coords(places)


def curve_data(case: Case, truth: xr.Dataset) -> xr.Dataset:
    """Return readings along the curve, at heights that the file knows to 0.1 nm."""
    z = truth["z"].values
    read = measured(case, truth, z, np.linspace(0.0, CURVE_TIME, z.size), stream=0)
    off = np.random.default_rng([SEED, case.number, 2]).normal(0.0, HEIGHT_NOISE, z.size)
    return read.assign_coords(z=("z", z + off, truth["z"].attrs))


def measured(
    case: Case,
    truth: xr.Dataset,
    height: Any,
    time: Floats,
    *,
    frequency: Any = None,
    drive: Any = 1.0,
    stream: int,
    noise: bool = True,
) -> xr.Dataset:
    """Return what the microscope stores of a motion over one dimension."""
    names = [f"{letter}{n}" for n in range(7) for letter in ("A", "phi") if f"{letter}{n}" in truth]
    truth = truth[names]
    random = np.random.default_rng([SEED, case.number, 3, stream])
    shift = case.instrument.mean_slope_z * np.asarray(height) + case.drift * time
    if case.diode is None:
        return readings(
            truth,
            case.instrument,
            case.probe,
            shift=shift,
            drive=drive,
            generator=random if noise else None,
        )
    seen = through_the_diode(case, truth, shift, frequency, random if noise else None)
    return with_signals(seen, electronics(case, signals_of(seen), drive))


def electronics(case: Case, signals: Signals, drive: Any) -> Signals:
    """Return what gains, latency, crosstalk and a phase that has its zero elsewhere make of signals."""
    i = case.instrument
    phasor = {}
    for n, a in signals.phasor.items():
        a = a * np.exp(-1j * n * i.phase_offset)
        if n in (2, 3):
            a = a * i.gains[n] * np.exp(-1j * i.latency[n])
            a = a + i.crosstalk[n] * drive + i.drive_distortion[n] * np.asarray(drive) ** 2
        phasor[n] = a
    mean = None if signals.mean is None else signals.mean * i.gains[0] + i.mean_offset
    return Signals(mean, phasor)


def through_the_diode(
    case: Case, truth: xr.Dataset, shift: Floats, frequency: Any, random: np.random.Generator | None
) -> xr.Dataset:
    """Return phasors of a lock-in behind a diode and an ADC, point by point, of a lever that is warm."""
    signals, count = signals_of(truth), truth["A1"].size
    mean = signals.mean if signals.mean is not None else np.zeros(count)
    mean, phasor = mean + shift, dict(signals.phasor)
    if random is not None:
        sigma = thermal(case)
        mean = mean + random.normal(0.0, sigma["A0"], count)
        for n in (1, 2, 3):
            phasor[n] = phasor[n] + random.normal(0.0, sigma[f"A{n}"], (2, count)).T @ np.array([1.0, 1.0j])
    moving = with_signals(truth, Signals(mean, phasor))
    f = np.broadcast_to(case.probe.drive.frequency if frequency is None else frequency, count)
    axis = moving["A1"].dims[0]
    # points at one frequency are recorded together, some at a time for the memory
    size = max(1, int(2e6 / (case.sampling * f[0] * case.duration))) if frequency is None else 1
    seen = [
        recorded(case, moving.isel({axis: slice(at, at + size)}), float(f[at]), random)
        for at in range(0, count, size)
    ]
    scale = case.probe.drive.free_amplitude / abs(complex(alone(case).phasor[1][0]))
    read = signals_of(xr.concat(seen, dim=axis))
    true_length = Signals(read.mean * scale, {n: a * scale for n, a in read.phasor.items()})
    kept = truth[[name for name in truth.data_vars if name in ("A0", *(f"{p}{n}" for p in ("A", "phi") for n in (1, 2, 3)))]]
    return with_signals(kept, true_length)


def recorded(
    case: Case, moving: xr.Dataset, frequency: float, random: np.random.Generator | None
) -> xr.Dataset:
    """Return observables of a trace behind the diode; the ADC has 16 bits."""
    assert case.diode is not None
    trace = sample_trace(
        moving,
        case.diode,
        drive_frequency=frequency,
        sampling_rate=case.sampling * case.probe.drive.frequency,
        duration=case.duration,
        seed=int(random.integers(2**32)) if random is not None else 0,
        drift_rate=case.drift,
        noise_density=case.instrument.detector_noise if random is not None else 0.0,
        bits=16 if random is not None else None,
        range=1.5 * case.probe.drive.free_amplitude if random is not None else None,
        zeroed=True,
    )
    return observables_of(lock_in(trace, frequency)[0])


def alone(case: Case) -> Signals:
    """Return what a lock-in without noise reads of the free lever behind the diode, where lengths are calibrated."""
    still = replace(case, drift=0.0)
    seen = recorded(still, free(np.array([case.probe.drive.free_amplitude + 0j])), case.probe.drive.frequency, None)
    return signals_of(seen)


def bandwidth(case: Case) -> float:
    """Return the noise bandwidth of the lock-in [Hz]."""
    return case.instrument.bandwidth if case.diode is None else NOISE_WIDTH / case.duration


def thermal(case: Case) -> dict[str, float]:
    """Return the standard deviations of the lever's own motion."""
    quiet = replace(case.instrument, detector_noise=0.0, bandwidth=bandwidth(case))
    return noise_of(quiet, case.probe)


def injected(case: Case) -> dict[str, float]:
    """Return the standard deviation of noise in the mean and each quadrature, as it is once gains are taken out [m]."""
    sigma = noise_of(replace(case.instrument, bandwidth=bandwidth(case)), case.probe)
    # behind a formula noise is added last; a diode's own goes through the electronics as the signal does
    gains = case.instrument.gains if case.diode is None else {}
    return {name: sigma[f"A{name[1]}"] / gains.get(int(name[1]), 1.0) for name in SIGNALS}


# --- what is learnt ---------------------------------------------------------------------------------------------


class Outcome(NamedTuple):
    """What became of a case with some far-field data."""

    number: int
    kind: str
    far_field: str
    points: int
    size: dict[str, float]
    """rms of each true signal per quadrature [m]."""
    noise: dict[str, float]
    """Injected, per quadrature [m]."""
    residual: dict[str, float]
    """rms of corrected less true, per quadrature [m]."""
    covered: dict[str, float]
    """Share of points and quadratures within their 90 % interval; of unknowns of the instrument 1 or 0."""
    off: dict[str, float]
    """Error over stated error: rms of the signals; of the unknowns with its sign."""
    error: dict[str, float]
    """Stated errors [SI] of unknowns; of signals rms over the curve, without noise."""
    findings: tuple[str, ...]


def outcome(case: Case, truth: xr.Dataset, raw: xr.Dataset, far_field: str) -> Outcome:
    """Calibrate, correct and compare."""
    given = ot.Reference(poisson_ratio=0.35, modulus=case.modulus, modulus_error=0.1)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # what stays open is told in the findings
        calibration = ot.calibrate(raw, case.stated, reference=given, far_field=far_data(case, far_field))
        clean = ot.correct(raw, calibration)
    inside = in_contact(truth)
    there, found = (compared(data, inside) for data in (truth, clean))
    noise = injected(case)
    spread = propagated(raw, calibration, clean, inside)
    residual, covered, off, error, size = {}, {}, {}, {}, {}
    for name in SIGNALS:
        miss = found[name] - there[name]
        total = np.hypot(spread[name], noise[name])
        residual[name], size[name] = rms(miss), rms(there[name])
        covered[name], off[name] = float((np.abs(miss) < NINETY * total).mean()), rms(miss / total)
        error[name] = rms(spread[name])
    for name, (miss, stated) in unknowns(case, raw, calibration).items():
        off[name], error[name] = miss / stated, stated
        covered[name] = float(abs(miss) < NINETY * stated)
    return Outcome(
        case.number, case.kind, far_field, int(inside.sum()), size, noise, residual, covered, off, error,
        calibration.findings,
    )  # fmt: skip


def rms(values: Floats) -> float:
    """Return the root of the mean square."""
    return float(np.sqrt(np.mean(np.square(values))))


def compared(observables: xr.Dataset, inside: npt.NDArray[np.bool_]) -> dict[str, Floats]:
    """Return A0 (point,) and both quadratures of a2, a3 (quadrature, point) of the points in contact."""
    signals = signals_of(observables)
    return parts(signals, inside)


def parts(signals: Signals, inside: npt.NDArray[np.bool_]) -> dict[str, Floats]:
    """Return signals as real numbers."""
    assert signals.mean is not None
    pairs = {f"a{n}": np.stack([signals.phasor[n].real, signals.phasor[n].imag])[:, inside] for n in (2, 3)}
    return {"A0": signals.mean[inside], **pairs}


def propagated(
    raw: xr.Dataset, calibration: ot.Calibration, clean: xr.Dataset, inside: npt.NDArray[np.bool_]
) -> dict[str, Floats]:
    """Return the standard deviation that the calibration's covariance gives each corrected signal."""
    applied = ot.calibration_of(clean)
    assert applied is not None
    values = dict(applied.values)
    height = raw["z"].values - centre(raw)
    read = signals_of(raw)

    def at(moved: Mapping[str, float]) -> dict[str, Floats]:
        return parts(undo(read, moved, applied.amplitude, height=height), inside)

    here = at(values)
    scale = np.sqrt(np.diag(calibration.covariance))
    scale = np.where(scale > 0.0, scale, 1.0)
    size, vectors = np.linalg.eigh(calibration.covariance / np.outer(scale, scale))
    root = scale[:, None] * vectors * np.sqrt(np.maximum(size, 0.0))
    variance = {name: np.zeros(part.shape) for name, part in here.items()}
    for column in root.T:
        step = {n: values[n] + 1e-2 * float(d) for n, d in zip(calibration.names, column, strict=True)}
        there = at({**values, **step})
        for name in variance:
            variance[name] += ((there[name] - here[name]) / 1e-2) ** 2
    return {name: np.sqrt(part) for name, part in variance.items()}


def centre(raw: xr.Dataset) -> float:
    """Return the height about which the correction of a curve counts: that of the onset."""
    return split_curve(raw).onset


def unknowns(case: Case, raw: xr.Dataset, calibration: ot.Calibration) -> dict[str, tuple[float, float]]:
    """Return how far unknowns are off, and how far they should be; complex ones turned to their first quadrature."""
    i, values = case.instrument, calibration.values

    def error(weights: Mapping[str, float]) -> float:
        w = np.array([weights.get(name, 0.0) for name in calibration.names])
        return math.sqrt(float(w @ calibration.covariance @ w))

    crosstalk = i.crosstalk[2] + i.drive_distortion[2]
    terms = [f"distortion2_{j}_re" for j in range(3)]
    angle = values["latency2"] - i.latency[2]
    scale = (calibration.amplitude / case.probe.drive.free_amplitude) ** 2  # as it is quoted
    return {
        "distortion": (
            sum(values[name] for name in terms) - (faked(case, raw) * scale).real,
            error(dict.fromkeys(terms, 1.0)),
        ),
        "crosstalk2": (values["crosstalk2_re"] - crosstalk.real, error({"crosstalk2_re": 1.0})),
        "gain0": (values["gain0"] - i.gains[0], error({"gain0": 1.0})),
        "gain2": (values["gain2"] - i.gains[2], error({"gain2": 1.0})),
        "latency2": ((angle + math.pi) % (2.0 * math.pi) - math.pi, error({"latency2": 1.0})),
    }


def faked(case: Case, raw: xr.Dataset) -> complex:
    """Return what the detector adds to a2 at the free amplitude, in the phase of a1^2, from a reading without noise.

    The spot is where it was at the onset, from which the calibration counts.
    """
    first = free(np.array([case.probe.drive.free_amplitude + 0j]))
    height = centre(raw)
    time = np.interp(height, raw["z"].values[::-1], np.linspace(0.0, CURVE_TIME, HEIGHTS)[::-1])
    read = signals_of(measured(case, first, height, np.array([time]), drive=0.0, stream=9, noise=False)).phasor
    return complex(read[2][0] * (np.conj(read[1][0]) / abs(read[1][0])) ** 2)
