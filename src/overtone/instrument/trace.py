"""The deflection over time as a converter records it behind a photodiode, and a lock-in for such records.

What the harmonics of a steady motion become behind the diode, `overtone.instrument.photodiode` says; here the same
passes through time, with the noise of the detector, a drift and the steps of a converter.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
import xarray as xr

from overtone.errors import DistortionWarning, OvertoneError
from overtone.instrument.lockin import HALF_LOBE, Phase, averages, low_pass
from overtone.instrument.photodiode import SplitDiode, response, waveform
from overtone.instrument.samples import Trace
from overtone.quantities import harmonic_orders, validate_observables

_Floats = npt.NDArray[np.float64]


def sample_trace(
    observables: xr.Dataset,
    diode: SplitDiode,
    *,
    drive_frequency: float,
    sampling_rate: float,
    duration: float,
    seed: int,
    drift_rate: float = 0.0,
    noise_density: float = 0.0,
    bits: int | None = None,
    range: float | None = None,
    zeroed: bool = False,
) -> xr.DataArray:
    """Return the deflection trace that an ADC records behind the diode.

    ``q(t) = A0 + drift_rate t + sum A_n cos(n w t - phi_n)`` passes the diode; white noise is added; the sum
    is rounded to the codes of the ADC.

    Parameters
    ----------
    observables : Dataset
        True motion, as in `read_through`; one point or many, each recorded from its own time zero.
    diode : SplitDiode
        The detector.
    drive_frequency, sampling_rate : float
        [Hz]. Nothing filters the trace: what the diode adds above half the sampling rate folds back.
    duration : float
        [s].
    seed : int
        Seed of the generator of the noise.
    drift_rate : float
        Drift of the spot [m/s].
    noise_density : float
        One-sided amplitude density of the detector's noise [m/sqrt(Hz)].
    bits, range : int and float, optional
        Resolution of the ADC, 1 to 32, and its full scale from ``-range`` to ``range`` [m of reading].
    zeroed : bool
        As in `response`.

    Returns
    -------
    DataArray
        Reading [m], dimensions of the observables and ``time`` [s] last.

    Raises
    ------
    ObservablesError
        If the dataset does not keep the contract of observables.
    OvertoneError
        If a number makes no sense, or a harmonic of the motion lies above half the sampling rate.

    Warns
    -----
    DistortionWarning
        If samples lie outside the range of the ADC, where they stick to its ends.
    """
    positive = {"drive_frequency": drive_frequency, "sampling_rate": sampling_rate, "duration": duration}
    bad = [f"{name} = {value!r}" for name, value in positive.items() if not 0.0 < value < math.inf]
    bad += [] if math.isfinite(drift_rate) else [f"drift_rate = {drift_rate!r}"]
    bad += [] if 0.0 <= noise_density < math.inf else [f"noise_density = {noise_density!r}"]
    if not bad and round(duration * sampling_rate) < 1:
        bad += [f"duration = {duration!r}, shorter than a sample"]
    adc = None
    if bits is not None and range is not None and 1 <= bits <= 32 and 0.0 < range < math.inf:
        adc = (int(bits), float(range))
    elif bits is not None or range is not None:
        bad += [f"bits = {bits!r} with range = {range!r}"]
    if bad:
        raise OvertoneError(
            "such a trace cannot be recorded",
            expected="finite numbers > 0 (drift_rate any, noise_density >= 0), bits and range together",
            got=", ".join(bad),
        )
    highest = max(harmonic_orders(validate_observables(observables)))
    if highest * drive_frequency >= sampling_rate / 2.0:
        raise OvertoneError(
            f"harmonic {highest} lies above half the sampling rate",
            expected=f"a sampling rate above {2.0 * highest * drive_frequency:.4g} Hz",
            got=f"{sampling_rate:.4g} Hz",
            hint="a higher rate, or a motion without that harmonic",
        )
    time = np.arange(round(duration * sampling_rate)) / sampling_rate
    motion = waveform(observables, 2.0 * np.pi * drive_frequency * time)
    reading = response(diode, motion.values + drift_rate * time, zeroed=zeroed)
    if noise_density > 0.0:
        # a one-sided density S up to half the rate: sigma^2 = S fs / 2
        sigma = noise_density * math.sqrt(sampling_rate / 2.0)
        reading = reading + np.random.default_rng(seed).normal(0.0, sigma, reading.shape)
    if adc is not None:
        reading = _quantise(reading, *adc)
    axis = xr.DataArray(time, dims="time", attrs={"units": "s", "long_name": "time"})
    trace = motion.drop_vars("theta").rename(theta="time").assign_coords(time=axis).copy(data=reading)
    return trace.assign_attrs(long_name="deflection as the photodiode reads it")


def _quantise(reading: _Floats, bits: int, full_scale: float) -> _Floats:
    step = 2.0 * full_scale / 2**bits
    codes = np.round(reading / step)
    lowest, highest = -(2 ** (bits - 1)), 2 ** (bits - 1) - 1
    outside = int(((codes < lowest) | (codes > highest)).sum())
    if outside:
        warnings.warn(
            f"{outside} of {codes.size} samples lie outside the range of the ADC and stick to its ends",
            DistortionWarning,
            stacklevel=3,
        )
    return np.asarray(np.clip(codes, lowest, highest) * step)


def lock_in(
    trace: xr.DataArray,
    drive_frequency: float,
    harmonics: Sequence[int] = (0, 1, 2, 3),
    *,
    duration: float | None = None,
) -> tuple[xr.DataArray, float]:
    """Return the phasors ``a_n = A_n exp(-i phi_n)`` of traces whose drive is known exactly, many at a time.

    Multiplies by ``exp(-i n w t)``, t being the time of the trace, and averages under the window of
    `overtone.demodulate`, as long as the record or a part of it.

    Parameters
    ----------
    trace : DataArray
        Deflection [m] with an evenly sampled ``time`` [s]; any further dimensions.
    drive_frequency : float
        [Hz].
    harmonics : sequence of int
        Orders, 0 for the mean.
    duration : float, optional
        Split the record into windows of this length [s], each with its phasors; an incomplete last one is
        left out. The whole record unless given.

    Returns
    -------
    phasors : DataArray
        Complex [m], dimensions of the trace without time, ``window`` where the record is split (its
        coordinate ``time`` is its middle), and ``harmonic`` last; see `overtone.instrument.photodiode.observables_of`.
    bandwidth : float
        B [Hz]: white noise of one-sided power density S gives each of Re a_n and Im a_n a standard
        deviation of sqrt(2 S B), the mean A0 one of sqrt(S B).

    Raises
    ------
    OvertoneError
        If the trace has no even time, or is too short or too coarse to keep the harmonics apart.

    Notes
    -----
    Another line counts as `overtone.instrument.lockin.response` says: 1e-7 of itself where it is six periods of the
    record away, 1e-9 at 160.
    """
    orders = sorted(set(harmonics))
    time = trace["time"].values.astype(float) if "time" in trace.coords else np.zeros(0)
    if trace.dims.count("time") != 1 or time.size < 2 or not _even(time):
        raise OvertoneError(
            "the trace has no even time",
            expected="a dimension time with a coordinate in seconds at even steps",
            got=f"dimensions {trace.dims}, {time.size} times",
        )
    rate = float((time.size - 1) / (time[-1] - time[0]))
    count = time.size if duration is None else max(round(duration * rate), 1)
    if not orders or orders[0] < 0 or count > time.size:
        raise OvertoneError(
            "this demodulation cannot be done",
            expected=f"harmonics >= 0 and at most {time.size / rate:.4g} s",
            got=f"harmonics {orders}, {count / rate:.4g} s",
        )
    _require_resolved(orders, drive_frequency, rate, count)

    start = float(time[0])
    window = low_pass(rate, count, count)
    phase = Phase(-start * rate, (0.0, 2.0 * math.pi * drive_frequency / rate, 0.0))
    samples = Trace(trace.transpose(..., "time").values, rate, start)
    means, centres = averages(samples, phase, orders, window, 0, time.size)
    harmonic = xr.DataArray(orders, dims="harmonic")
    middle = xr.DataArray(start + centres / rate, dims="window", attrs=trace["time"].attrs)
    phasors = xr.DataArray(
        np.moveaxis(means, 0, -1) * np.where(np.array(orders) > 0, 2.0, 1.0),
        {name: value for name, value in trace.coords.items() if "time" not in value.dims},
        [*(name for name in trace.dims if name != "time"), "window", "harmonic"],
        name="phasor",
        attrs={"units": "m", "long_name": "phasors A_n exp(-i phi_n)"},
    ).assign_coords(harmonic=harmonic, time=middle)
    return phasors if duration is not None else phasors.isel(window=0, drop=True), window.bandwidth


def _even(time: _Floats) -> bool:
    steps = np.diff(time)
    return bool(steps[0] > 0.0 and np.abs(steps - steps.mean()).max() < 1e-6 * steps.mean())


def _require_resolved(orders: Sequence[int], frequency: float, rate: float, count: int) -> None:
    """Refuse where two lines of a real signal, n f and -m f, or their images by the sampling, come too close."""
    highest = max(*orders, 1)
    lines = np.arange(-highest, highest + 1)
    wanted = np.array(orders)[:, None]
    distance = np.abs(wanted - lines) * frequency
    distance = np.abs(distance - rate * np.round(distance / rate)) * count / rate
    closest = float(distance[wanted != lines].min()) if frequency > 0.0 else 0.0
    if not (closest >= HALF_LOBE and highest * frequency < rate / 2.0):
        raise OvertoneError(
            "the record does not keep the harmonics apart",
            expected=f"{HALF_LOBE:.2g} periods at least, and harmonics below half of the sampling rate",
            got=f"{frequency * count / rate:.4g} periods at {rate:.4g} Hz, harmonic {highest} "
            f"at {highest * frequency:.4g} Hz, lines {closest:.3g} periods apart",
            hint="a longer or faster record, or fewer harmonics",
        )
