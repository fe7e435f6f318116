"""Make the figure and the tables of the page on instruments: random ones, applied to simulated curves and removed.

Run by hand, ``python docs/instruments.py``; a quarter of an hour on two cores. Every instrument is seeded by its
number, so that each comes out again by itself: ``python docs/instruments.py 17`` prints what becomes of it.

Half of the instruments are formulas (`overtone.Instrument`). The other half work in time: a spot of a size on a
split diode, moved by the lever and by drift, sampled by an ADC, and a digital lock-in. The calibration is the same.
"""

from __future__ import annotations

import csv
import math
import re
import sys
import warnings
from collections.abc import Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import NormalDist
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure

import overtone as ot
from overtone.errors import OvertoneError
from overtone.harmonics import far_phase
from overtone.instrument.curve_parts import split_curve
from overtone.instrument.instrument import Instrument, free_response, noise_of, readings
from overtone.instrument.lockin import NOISE_WIDTH
from overtone.instrument.photodiode import SplitDiode, observables_of, read_through
from overtone.instrument.signals import Signals, signals_of, with_signals
from overtone.instrument.trace import lock_in, sample_trace
from overtone.instrument.unknowns import undo
from overtone.plots import png_bytes
from overtone.plots.canvas import new_figure
from overtone.plots.categories import PALETTE
from overtone.plots.text import LABEL_SIZE, TICK_SIZE, TITLE_SIZE
from overtone.probe import Mode
from overtone.quantities import named_array

Array = npt.NDArray[np.float64]

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
LEVERS = (
    "HQ:NSC14",
    "HQ:NSC15",
    "HQ:NSC18",
    "Multi75Al-G",
    "PPP-NCHR",
    "PPP-NCLR",
    "RTESPA-150",
    "RTESPA-300",
)
EVERY = {LADDER: 1, WIDE: 4, DRIVES: 2, NONE: 1}
"""Each of so many pairs of instruments has these far-field data."""
EXAMPLE = 1
NINETY = NormalDist().inv_cdf(0.95)
STEP = 1e-2  # of a standard deviation, for derivatives
SIGNALS = ("A0", "a2", "a3")
UNKNOWNS = ("distortion2", "crosstalk2", "gain0", "gain2", "latency2")
TITLES = {
    "distortion2": "distortion of a2 [pm]",
    "crosstalk2": "crosstalk of a2 [pm]",
    "gain0": "gain of A0 [%]",
    "gain2": "gain of a2 [%]",
    "latency2": "latency of a2 [deg]",
}
SHOWN = {"distortion2": 1e12, "crosstalk2": 1e12, "gain0": 100.0, "gain2": 100.0, "latency2": 180.0 / math.pi}


@dataclass(frozen=True)
class Case:
    """A lever, a reference and an instrument.

    Parameters
    ----------
    number : int
        Seed.
    kind : str
        ``formula`` or ``time``.
    probe, sample, truth
        What there is, and what a perfect detector reads of an approach curve.
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
    truth: xr.Dataset
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
        truth = motion(probe, sample)
        if repulsive(truth):
            break
    kind = IN_TIME if number % 2 else ANALYTIC
    amplitude = probe.drive.free_amplitude
    diode = aligned(random, amplitude) if kind == IN_TIME else None
    first, *others = probe.cantilever.modes
    k, Q, f, R, E = (float(np.exp(s * random.normal())) for s in (0.05, 0.02, 1e-5, 0.15, 0.1))
    off = {"frequency": first.frequency * f, "quality_factor": first.quality_factor * Q}
    modes: tuple[Mode, ...] = (replace(first, stiffness=first.stiffness * k, **off),)
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
        truth,
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
    own: dict[str, Any] = {
        "stiffness": stiffness,
        "frequency": frequency,
        "quality_factor": quality,
        "radius": radius,
    }
    drive: dict[str, Any] = {
        "drive_frequency": frequency * (1.0 + detuning / quality),
        "free_amplitude": amplitude,
    }
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
    return np.asarray((0.97 * level > A) & (0.15 * level < A))


def free(first: Any) -> xr.Dataset:
    """Return the motion of a free lever, whose first harmonic [m] is given, over ``point`` where it is an array."""
    a = np.asarray(first, dtype=complex)
    dims = ("point",) if a.ndim else ()
    names = {"A0": np.zeros(a.shape), "A1": np.abs(a), "phi1": np.mod(-np.angle(a), 2.0 * np.pi)}
    names |= {f"{letter}{n}": np.zeros(a.shape) for n in (2, 3) for letter in ("A", "phi")}
    return xr.Dataset({name: named_array(name, values, dims) for name, values in names.items()})


def ladder(case: Case, far_field: str) -> tuple[Array, Array]:
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
    places = {
        "frequency": ("point", frequency),
        "drive": ("point", drive),
        "z": ("point", np.full(POINTS, z)),
    }
    read = measured(case, free(first), z, time, frequency=frequency, drive=drive, stream=1)
    return read.assign_coords(places)


def curve_data(case: Case) -> xr.Dataset:
    """Return readings along the curve, at heights that the file knows to 0.1 nm."""
    z = case.truth["z"].values
    read = measured(case, case.truth, z, np.linspace(0.0, CURVE_TIME, z.size), stream=0)
    off = np.random.default_rng([SEED, case.number, 2]).normal(0.0, HEIGHT_NOISE, z.size)
    return read.assign_coords(z=("z", z + off, case.truth["z"].attrs))


def measured(
    case: Case,
    truth: xr.Dataset,
    height: Any,
    time: Array,
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
    case: Case, truth: xr.Dataset, shift: Array, frequency: Any, random: np.random.Generator | None
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
    assert read.mean is not None
    true_length = Signals(read.mean * scale, {n: a * scale for n, a in read.phasor.items()})
    kept = ["A0", *(f"{letter}{n}" for n in (1, 2, 3) for letter in ("A", "phi"))]
    return with_signals(truth[[name for name in kept if name in truth]], true_length)


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
    seen = recorded(
        still, free(np.array([case.probe.drive.free_amplitude + 0j])), case.probe.drive.frequency, None
    )
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
    """What becomes of a case with some far-field data."""

    number: int
    kind: str
    far_field: str
    size: dict[str, float]
    """rms of each true signal per quadrature [m]."""
    noise: dict[str, float]
    """Injected, per quadrature [m]."""
    before: dict[str, float]
    """rms of what is read less what is true, but for the zeros of A0 and phase, per quadrature [m]."""
    residual: dict[str, float]
    """rms of corrected less true, per quadrature [m]; infinite where the calibration failed."""
    off: dict[str, Array]
    """Errors over stated errors: of a signal at every point, of an unknown one."""
    error: dict[str, float]
    """Stated errors [SI]: of signals rms over the curve, without noise."""
    findings: tuple[str, ...]


def outcome(case: Case, raw: xr.Dataset, far_field: str) -> Outcome:
    """Calibrate, correct and compare."""
    inside = in_contact(case.truth)
    there, noise = real_parts(signals_of(case.truth), inside), injected(case)
    uncorrected = real_parts(zeroed(case, signals_of(raw)), inside)
    before = {name: rms(uncorrected[name] - there[name]) for name in SIGNALS}
    size = {name: rms(there[name]) for name in SIGNALS}
    given = ot.Reference(poisson_ratio=0.35, modulus=case.modulus, modulus_error=0.1)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # what stays open is told in the findings
            calibration = ot.calibrate(
                raw,
                case.stated,
                reference=given,
                far_field=far_data(case, far_field),
                height_noise=HEIGHT_NOISE,
            )
            clean = ot.correct(raw, calibration)
    except OvertoneError as fault:
        lost = dict.fromkeys((*SIGNALS, *UNKNOWNS), math.inf)
        nowhere = {name: np.full(1, math.inf) for name in (*SIGNALS, *UNKNOWNS)}
        return Outcome(
            case.number, case.kind, far_field, size, noise, before, lost, nowhere, lost, (str(fault),)
        )
    found, spread = real_parts(signals_of(clean), inside), propagated(raw, calibration, clean, inside)
    residual: dict[str, float] = {}
    off: dict[str, Array] = {}
    error: dict[str, float] = {}
    for name in SIGNALS:
        miss = found[name] - there[name]
        residual[name], error[name] = rms(miss), rms(spread[name])
        off[name] = (miss / np.hypot(spread[name], noise[name])).ravel()
    for name, (deviation, stated) in unknowns(case, raw, calibration).items():
        off[name], error[name] = np.array([deviation / stated]), stated
    return Outcome(
        case.number, case.kind, far_field, size, noise, before, residual, off, error, calibration.findings
    )


def rms(values: Array) -> float:
    """Return the root of the mean square."""
    return float(np.sqrt(np.mean(np.square(values))))


def zeroed(case: Case, signals: Signals) -> Signals:
    """Return readings whose A0 is zero far away and whose phase has its zero: what everybody does."""
    far = slice(0, HEIGHTS // 3)
    assert signals.mean is not None
    turn = np.exp(1j * case.instrument.phase_offset)
    return Signals(
        signals.mean - signals.mean[far].mean(), {n: a * turn**n for n, a in signals.phasor.items()}
    )


def real_parts(signals: Signals, inside: npt.NDArray[np.bool_]) -> dict[str, Array]:
    """Return A0 (point,) and both quadratures of a2 and a3 (quadrature, point) of some points."""
    assert signals.mean is not None
    pairs = {f"a{n}": np.stack([signals.phasor[n].real, signals.phasor[n].imag])[:, inside] for n in (2, 3)}
    return {"A0": signals.mean[inside], **pairs}


def propagated(
    raw: xr.Dataset, calibration: ot.Calibration, clean: xr.Dataset, inside: npt.NDArray[np.bool_]
) -> dict[str, Array]:
    """Return the standard deviation that a calibration gives each signal of its own curve, without a drift since."""
    left = ot.calibration_of(clean)
    assert left is not None
    read, height = signals_of(raw), raw["z"].values - centre(raw)

    def at(values: Mapping[str, float]) -> dict[str, Array]:
        return real_parts(undo(read, values, left.amplitude, height=height), inside)

    here = at(left.values)
    scale = np.sqrt(np.diag(calibration.covariance))
    scale = np.where(scale > 0.0, scale, 1.0)
    size, vectors = np.linalg.eigh(calibration.covariance / np.outer(scale, scale))
    root = scale[:, None] * vectors * np.sqrt(np.maximum(size, 0.0))
    variance = {name: np.zeros(part.shape) for name, part in here.items()}
    for column in root.T:
        moved = {n: left.values[n] + STEP * float(d) for n, d in zip(calibration.names, column, strict=True)}
        there = at({**left.values, **moved})
        for name in variance:
            variance[name] += ((there[name] - here[name]) / STEP) ** 2
    return {name: np.sqrt(part) for name, part in variance.items()}


def centre(raw: xr.Dataset) -> float:
    """Return the height about which the correction of a curve counts: that of the onset."""
    return split_curve(raw).onset


def unknowns(case: Case, raw: xr.Dataset, calibration: ot.Calibration) -> dict[str, tuple[float, float]]:
    """Return how far unknowns are off, and how far that was said to be; of complex ones the real part."""
    i, values = case.instrument, calibration.values

    def error(*names: str) -> float:
        w = np.array([1.0 if name in names else 0.0 for name in calibration.names])
        return math.sqrt(float(w @ calibration.covariance @ w))

    terms = [f"distortion2_{j}_re" for j in range(3)]
    scale = (calibration.amplitude / case.probe.drive.free_amplitude) ** 2  # as it is quoted
    added = sum(values[name] for name in terms) - (faked(case, raw) * scale).real
    crosstalk = values["crosstalk2_re"] - (i.crosstalk[2] + i.drive_distortion[2]).real
    angle = values["latency2"] - i.latency[2]
    return {
        "distortion2": (added, error(*terms)),
        "crosstalk2": (crosstalk, error("crosstalk2_re")),
        "gain0": (values["gain0"] - i.gains[0], error("gain0")),
        "gain2": (values["gain2"] - i.gains[2], error("gain2")),
        "latency2": ((angle + math.pi) % (2.0 * math.pi) - math.pi, error("latency2")),
    }


def faked(case: Case, raw: xr.Dataset) -> complex:
    """Return what is read of a2 of the free lever beside crosstalk, in the phase of a1^2, without noise.

    The spot is where it was at the onset, from which the calibration counts.
    """
    height = centre(raw)
    time = np.interp(height, raw["z"].values[::-1], np.linspace(0.0, CURVE_TIME, HEIGHTS)[::-1])
    first = free(np.array([case.probe.drive.free_amplitude + 0j]))
    read = signals_of(
        measured(case, first, height, np.array([time]), drive=0.0, stream=9, noise=False)
    ).phasor
    return complex(read[2][0] * (np.conj(read[1][0]) / abs(read[1][0])) ** 2)


def round_trip(number: int, far_fields: Sequence[str] | None = None) -> list[Outcome]:
    """Return the outcomes of an instrument."""
    case = drawn(number)
    raw = curve_data(case)
    chosen = far_fields if far_fields is not None else [f for f in FAR_FIELDS if number // 2 % EVERY[f] == 0]
    return [outcome(case, raw, far_field) for far_field in chosen]


# --- tables -----------------------------------------------------------------------------------------------------


class Row(NamedTuple):
    """A line of the table: one signal or unknown, of one kind of instrument, with some far-field data."""

    kind: str
    far_field: str
    name: str
    instruments: int
    before: float
    """Median residual before a correction over injected noise; of unknowns NaN, as the next four."""
    median: float
    """Of the residual over injected noise."""
    worst: float
    within_2: float
    """Share of instruments with a residual of no more than twice the injected noise."""
    excess: float
    """Median of what the residual has beyond the noise, in quadrature [m]."""
    covered: float
    """Share of true values in their 90 % intervals."""
    spread: float
    """rms error over stated error."""
    error: float
    """Median stated error [SI]."""


def table(outcomes: Sequence[Outcome]) -> list[Row]:
    """Return numbers over all instruments, rounded to what is written."""
    rows = []
    for kind in (ANALYTIC, IN_TIME):
        for far_field in FAR_FIELDS:
            some = [o for o in outcomes if (o.kind, o.far_field) == (kind, far_field)]
            for name in (*SIGNALS, *UNKNOWNS) if some else ():
                rows.append(Row(kind, far_field, name, len(some), *map(rounded, _numbers(name, some))))
    return rows


def _numbers(name: str, some: Sequence[Outcome]) -> list[float]:
    off = [o.off[name] for o in some]
    kept = np.concatenate([z for z in off if np.isfinite(z).all()])
    # every instrument counts alike, however many points it has
    said = [float(np.mean([(np.abs(z) < NINETY).mean() for z in off])), rms(kept)]
    said.append(float(np.median([o.error.get(name, math.inf) for o in some])))
    if name in UNKNOWNS:
        return [math.nan] * 5 + said
    before, after = (
        np.array([getattr(o, w)[name] / o.noise[name] for o in some]) for w in ("before", "residual")
    )
    excess = [math.sqrt(max(o.residual[name] ** 2 - o.noise[name] ** 2, 0.0)) for o in some]
    ratios = [
        float(np.median(before)),
        float(np.median(after)),
        float(after.max()),
        float((after <= 2.0).mean()),
    ]
    return [*ratios, float(np.median(excess)), *said]


def rounded(value: float) -> float:
    """Return a number with three digits."""
    return float(f"{value:.3g}")


def write_table(rows: list[Row], path: Path) -> None:
    """Write the table as text that a spreadsheet can read."""
    with path.open("w", newline="", encoding="utf-8") as file:
        csv.writer(file, lineterminator="\n").writerows([Row._fields, *rows])


def read_table(path: Path) -> list[Row]:
    """Return what `write_table` wrote."""
    with path.open(newline="", encoding="utf-8") as file:
        lines = list(csv.reader(file))[1:]
    return [Row(*line[:3], int(line[3]), *map(float, line[4:])) for line in lines]


def markdown(rows: list[Row]) -> tuple[str, str]:
    """Return the two tables of the page: residuals over noise, and what 90 % intervals cover."""
    kept = {(row.kind, row.far_field, row.name): row for row in rows}
    groups = [(f, k) for f in FAR_FIELDS for k in (ANALYTIC, IN_TIME) if (k, f, "a2") in kept]
    first = ["| far-field data | kind | instruments | A0 | a2 | a3 |", "|---|---|---|---|---|---|"]
    second = [
        "| far-field data | kind | A0 | a2 | a3 | " + " | ".join(TITLES[name] for name in UNKNOWNS) + " |",
        "|---|---|" + "---|" * (len(SIGNALS) + len(UNKNOWNS)),
    ]
    for kind in (ANALYTIC, IN_TIME):
        cells = [f"{kept[kind, NONE, name].before:.3g}" for name in SIGNALS]
        first.append(
            f"| not corrected | {kind} | {kept[kind, NONE, 'a2'].instruments} | {' | '.join(cells)} |"
        )
    for far_field, kind in groups:
        row = {name: kept[kind, far_field, name] for name in (*SIGNALS, *UNKNOWNS)}
        cells = [
            f"{r.median:.3g} / {r.worst:.3g} ({100 * r.within_2:.0f})" for r in (row[n] for n in SIGNALS)
        ]
        first.append(f"| {far_field} | {kind} | {row['a2'].instruments} | {' | '.join(cells)} |")
        cells = [f"{100 * row[name].covered:.0f}" for name in SIGNALS]
        cells += [f"{100 * row[n].covered:.0f} ({row[n].error * SHOWN[n]:.2g})" for n in UNKNOWNS]
        second.append(f"| {far_field} | {kind} | {' | '.join(cells)} |")
    return "\n".join(first) + "\n", "\n".join(second) + "\n"


def write_page(tables: tuple[str, str], path: Path) -> None:
    """Put the tables where the page has had them: each begins with "far-field data" and ends before an empty line."""
    text = path.read_text(encoding="utf-8")
    old = re.findall(r"^\| far-field data \| .+?\n(?=\n)", text, re.M | re.S)
    for before, after in zip(old, tables, strict=True):
        text = text.replace(before, after)
    path.write_text(text, encoding="utf-8")


def told(o: Outcome) -> str:
    """Return an outcome in a few lines."""
    signals = ", ".join(
        f"{name} {o.residual[name] * 1e12:.2f} pm ({o.residual[name] / o.noise[name]:.2f} x noise, before "
        f"{o.before[name] / o.noise[name]:.0f} x), {rms(o.off[name]):.2f} sigma"
        for name in SIGNALS
    )
    others = ", ".join(f"{name} {o.off[name][0]:+.2f} sigma" for name in UNKNOWNS)
    findings = "".join(f"\n    {sentence}" for sentence in o.findings)
    return f"{o.number} ({o.kind}), far-field data: {o.far_field}\n  {signals}\n  {others}{findings}"


# --- figure -----------------------------------------------------------------------------------------------------


def figure(outcomes: Sequence[Outcome], example: int = EXAMPLE) -> Figure:
    """Return an example, how large residuals are, and what intervals cover."""
    result = new_figure(10.0, 3.8)
    result.set_dpi(150)
    left, middle, right = result.subplots(1, 3)
    _example(left, drawn(example))
    styles = {LADDER: PALETTE[0], WIDE: PALETTE[2], DRIVES: PALETTE[5], NONE: "#000000"}
    levels = np.linspace(0.02, 0.98, 49)
    bounds = [NormalDist().inv_cdf(0.5 + 0.5 * level) for level in levels]
    for far_field, colour in styles.items():
        for kind, line in ((ANALYTIC, "--"), (IN_TIME, "-")):
            some = [o for o in outcomes if (o.kind, o.far_field) == (kind, far_field)]
            ratio = np.sort([o.residual["a2"] / o.noise["a2"] for o in some])
            label = {"color": colour, "linestyle": line, "linewidth": 1.3, "label": f"{far_field} ({kind})"}
            middle.semilogx(ratio, 100 * np.arange(1, ratio.size + 1) / max(ratio.size, 1), **label)
            covers = [np.mean([(np.abs(o.off["a2"]) < b).mean() for o in some]) for b in bounds if some]
            right.plot(100 * levels[: len(covers)], 100 * np.array(covers), **label)
    middle.axvline(2.0, color="0.6", linewidth=0.8)
    middle.set_xlim(0.7, 20.0)
    middle.set_ylim(0.0, 100.0)
    right.plot([0, 100], [0, 100], color="0.6", linewidth=0.8)
    _dress(middle, "residual of a2 over injected noise", "share of instruments below [%]", "(b) residual")
    _dress(right, "stated [%]", "true values of a2 inside [%]", "(c) intervals")
    handles, labels = middle.get_legend_handles_labels()
    result.tight_layout(rect=(0.0, 0.13, 1.0, 1.0))
    result.legend(handles, labels, fontsize=TICK_SIZE, ncols=4, frameon=False, loc="lower center")
    return result


def _example(axes: Axes, case: Case) -> None:
    """Draw A2 of an instrument: as read, corrected and true."""
    raw = curve_data(case)
    given = ot.Reference(poisson_ratio=0.35, modulus=case.modulus, modulus_error=0.1)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        clean = ot.correct(
            raw, ot.calibrate(raw, case.stated, reference=given, far_field=far_data(case, LADDER))
        )
    z = 1e9 * case.truth["z"].values
    axes.plot(z, 1e12 * raw["A2"], color=PALETTE[5], linewidth=1.2, label="as read")
    axes.plot(z, 1e12 * clean["A2"], ".", color=PALETTE[0], markersize=2.5, label="corrected")
    axes.plot(z, 1e12 * case.truth["A2"], color="#000000", linewidth=1.0, label="true")
    axes.legend(fontsize=TICK_SIZE, frameon=False)
    _dress(axes, "Z [nm]", "A2 [pm]", f"(a) instrument {case.number}")


def _dress(axes: Axes, x: str, y: str, title: str) -> None:
    axes.set_xlabel(x, fontsize=LABEL_SIZE)
    axes.set_ylabel(y, fontsize=LABEL_SIZE)
    axes.set_title(title, fontsize=TITLE_SIZE, loc="left")
    axes.tick_params(labelsize=TICK_SIZE)
    axes.grid(color="0.9", linewidth=0.6)
    axes.set_axisbelow(True)


def main() -> None:
    """Write table and figure, or print what becomes of the instruments whose numbers are given."""
    if numbers := [int(text) for text in sys.argv[1:]]:
        for number in numbers:
            print(*map(told, round_trip(number, tuple(FAR_FIELDS))), sep="\n")  # noqa: T201
        return
    with ProcessPoolExecutor(2) as pool:
        outcomes = [o for some in pool.map(round_trip, range(COUNT)) for o in some]
    rows = table(outcomes)
    write_table(rows, FOLDER / "instruments.csv")
    tables = markdown(rows)
    write_page(tables, FOLDER / "instruments.md")
    (FOLDER / "images" / "instruments.png").write_bytes(png_bytes(figure(outcomes)))
    over = [o for o in outcomes if o.far_field in (LADDER, WIDE) and o.residual["a2"] > 2.0 * o.noise["a2"]]
    lost = [o for o in outcomes if not math.isfinite(o.residual["a2"])]
    print(*tables, sep="\n")  # noqa: T201
    print(f"{len(over)} above twice the noise though frequencies span, {len(lost)} lost")  # noqa: T201
    print(*map(told, [*over, *lost]), sep="\n")  # noqa: T201


if __name__ == "__main__":
    main()
