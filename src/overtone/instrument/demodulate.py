"""A recorded deflection becomes observables: a lock-in for all harmonics at once, after the measurement.

The trace ``q(t)`` is turned back by n times the phase ``theta(t)`` of the drive and averaged,

    a_n(t) = 2 <q exp(-i n theta)> = A_n exp(-i phi_n)    (A_0 without the 2)

with a Kaiser window of ``beta`` 18 as the low-pass: symmetric, so it delays nothing; positive, so it does not
overshoot; and below 1.2e-7 beyond its main lobe, which ends at 4.9 times its noise bandwidth. Everything runs
over blocks of the trace, so that memory does not grow with its length.

The phase of the drive is recorded beside the deflection, or follows from the deflection itself, and then a change
of phi1 looks like a change of the drive. What `demodulate` calls ``track`` says how the two are told apart.
"""

from __future__ import annotations

import itertools
import json
import math
import warnings
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import xarray as xr

from overtone import provenance
from overtone.errors import (
    DistortionWarning,
    ObservablesError,
    OvertoneError,
    PhaseReferenceWarning,
    UnitError,
)
from overtone.quantities import named_array, validate_observables
from overtone.units import format_quantity

NONE, CONSTANT, LINEAR, FOLLOW, DRIVE = "none", "constant", "linear", "follow", "drive"
TRACKS = (NONE, CONSTANT, LINEAR, FOLLOW, DRIVE)

_Floats = npt.NDArray[np.float64]
_Complex = npt.NDArray[np.complex128]
Windows = tuple[float, float] | Sequence[tuple[float, float]]

_BETA = 18.0
_NOISE_WIDTH = 1.2186098
"""One-sided noise bandwidth of the window, times its length."""
_HALF_LOBE = math.sqrt(1.0 + (_BETA / math.pi) ** 2)
"""Where the main lobe ends, times the length of the window."""
_MAIN_LOBE = _HALF_LOBE / _NOISE_WIDTH
"""The same in units of the noise bandwidth."""
_CLEAN = 1e-6  # share of a neighbouring harmonic that may leak
_BLOCK = 1 << 17
_TABLE = 1 << 22  # longer filters are computed as they are used
_FEWEST_PERIODS = 20
_HIGHEST = 64
_JITTER = 0.1  # of a sampling interval: time labels farther off are no uniform sampling
# A line is so many times the noise beside it, in power; where the trace had to be cut into short pieces, because
# the drive drifts, a resonance that only noise drives might pass for a line, so it has to stand out farther.
_LINE, _SHORT_LINE = 200.0, 1e4
_SHARPER = (
    4.0  # times as far as in the longest pieces has it to stand out in shorter ones to be taken from them
)
_LONGEST_PIECE = 1 << 20
_STEADY = 5e-3  # rad: phi1 closer to its fit than that, or than five times its noise, is steady
_DROOP = 0.01  # loss of a harmonic that runs away from its frequency


class _Trace(NamedTuple):
    """Samples at a constant rate."""

    values: npt.NDArray[Any]
    rate: float
    """Samples a second [Hz]."""
    start: float
    """Time of the first sample [s]."""


class _LowPass(NamedTuple):
    """The window that averages."""

    length: int
    step: int
    """Samples from one output to the next."""
    scale: float
    """One over the sum of the window."""
    bandwidth: float
    """Equivalent noise bandwidth, one-sided [Hz]."""


class _Phase(NamedTuple):
    """Phase of the drive [rad] over the index k of a sample: a polynomial in ``k - middle``, and a rest."""

    middle: float
    coefficients: tuple[float, float, float]
    rest: Any = None
    """Function of k, None where the polynomial is all."""
    error: float = 0.0
    """Largest standard error over the record, relative to where phi1 was taken as steady [rad]."""


def demodulate(
    deflection: Any,
    *,
    bandwidth: float,
    sampling_rate: float | None = None,
    drive_frequency: float | None = None,
    drive: Any = None,
    harmonics: Sequence[int] = (0, 1, 2, 3),
    track: str | None = None,
    reference: Windows | None = None,
    reference_phase: float | None = None,
    output_rate: float | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> xr.Dataset:
    """Turn a recorded deflection into amplitudes and phases of harmonics over time.

    Parameters
    ----------
    deflection : DataArray (time) or array (n)
        Deflection [m], uniformly sampled; with a coordinate ``time`` [s], or with ``sampling_rate``.
    bandwidth : float
        Equivalent noise bandwidth of the low-pass [Hz]: white noise of one-sided density S leaves
        ``sqrt(S bandwidth)`` in A0 and ``sqrt(2 S bandwidth)`` in each A_n.
    sampling_rate : float, optional
        Samples a second [Hz]; needed without a coordinate, and more exact than rounded labels of time.
    drive_frequency : float, optional
        Where the drive is to be looked for, within 5 % [Hz]; with ``track="none"`` its exact value. Without it the
        strongest line counts.
    drive : DataArray or array, optional
        Recorded drive or reference signal, sampled with the deflection, any unit: phi1 is the lag behind it.
    harmonics : sequence of int
        Which harmonics; 1 is always one of them.
    track : str, optional
        How the phase of the drive is known. ``drive``, the default where a drive was recorded: from that, whatever it
        does. ``constant``, the default without: one frequency for the whole record, fitted to the phase of the
        first harmonic where that is steady. ``linear``: as well as a linear drift of the frequency. ``follow``: the
        phase of the first harmonic itself. ``none``: exactly ``drive_frequency``.
    reference : (start, stop) or sequence of them, optional
        Times [s] between which the lever is free, or phi1 is steady for other reasons: the frequency is fitted there.
    reference_phase : float, optional
        The lag phi1 in the reference [rad], `overtone.harmonics.far_phase` for a free lever. Without it, phi1 counts
        from the recorded drive, with ``none`` from ``cos(2 pi f t)``, else from the part that was fitted.
    output_rate : float, optional
        Outputs a second [Hz], about twice the bandwidth unless given.
    progress : callable, optional
        Called with (samples done, samples in all).

    Returns
    -------
    Dataset
        ``A0``, ``A1``, ``phi1``, ``A2``, ``phi2``, ... [m, rad] over ``time`` [s], lag convention, all phases in
        one time: where phi1 shifts by e, phi_n shifts by n e. Only outputs whose window lies in the trace.
        Attributes: ``drive_frequency`` in the middle of the record [Hz], ``frequency_drift`` [Hz/s],
        ``phase_error`` [rad], the standard error that the fit of the frequency leaves in phi1 far from where it was
        made, ``bandwidth``, ``filter``, ``leakage``, ``sampling_rate``, ``track`` and ``noise`` (see `noise_of`).

    Raises
    ------
    UnitError
        If the deflection is not in metres or the time not in seconds.
    ObservablesError
        If the trace is not uniform, has gaps, is too short, or has no line that stands above the noise.
    OvertoneError
        If an argument does not fit: a bandwidth of half the drive frequency or more, a harmonic beyond half the
        sampling rate, a window outside the record.

    Notes
    -----
    Without a recorded drive nothing tells a change of phi1 from a change of the phase of the drive. A generator
    that keeps its frequency is the one assumption that keeps slow changes of phi1, and it keeps them but for what
    a fit of the frequency takes away: with ``constant`` a linear trend, with ``linear`` a quadratic one as well.
    The fit leaves out parts in which the phase moves away, as in an approach, and a warning tells how much that
    was; where those are half the record or more, give a ``reference``. ``follow`` takes every change away: phi1
    is zero, and only A_n and ``phi_n - n phi1`` mean anything.
    Noise is told from the floor beside each harmonic. Slow drift, 1/f noise of A0 and jitter of the drive within the
    bandwidth come on top.

    Examples
    --------
    >>> t = np.arange(20_000) / 2e6
    >>> trace = 50e-9 * np.cos(2 * np.pi * 160e3 * t - 1.5) + 10e-12 * np.cos(4 * np.pi * 160e3 * t - 0.4)
    >>> seen = demodulate(trace, sampling_rate=2e6, drive_frequency=160e3, bandwidth=2e3, track="none")
    >>> print(f"{float(seen.A1[0]):.4g} m, {float(seen.phi1[0]):.4f}, {float(seen.A2[0]):.3g} m")
    5e-08 m, 1.5000, 1e-11 m
    """
    _check_numbers(bandwidth=bandwidth, drive_frequency=drive_frequency, output_rate=output_rate)
    orders = _orders(harmonics)
    chosen = _check_track(track, drive, drive_frequency, reference, reference_phase)
    trace = _trace(deflection, sampling_rate, "deflection", "m")
    source = trace if drive is None else _beside(_trace(drive, trace.rate, "drive", None), trace)
    spans = _spans(reference, trace)
    arguments = {
        "bandwidth": bandwidth,
        "drive_frequency": drive_frequency,
        "drive": drive is not None,
        "harmonics": list(orders),
        "track": chosen,
        "reference": reference,
        "reference_phase": reference_phase,
    }
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        result = _demodulate(
            trace,
            source,
            orders,
            chosen,
            drive_frequency,
            bandwidth,
            spans,
            reference_phase,
            output_rate,
            progress,
        )
    # A warning scrolls away; the dataset keeps what it said.
    for warning in caught:
        warnings.warn_explicit(warning.message, warning.category, warning.filename, warning.lineno)
    said = dict.fromkeys(f"{w.category.__name__}: {w.message}" for w in caught)
    result = provenance.add_finding(result, *(text if text.endswith(".") else text + "." for text in said))
    return provenance.record(result, "demodulate", **arguments)


def noise_of(observables: xr.Dataset) -> dict[str, float]:
    """Return the noise that `demodulate` found, as ``noise=`` of `map_properties` takes it.

    Parameters
    ----------
    observables : Dataset
        Result of `demodulate`, also after it was saved and loaded.

    Returns
    -------
    dict
        Standard deviations of A0, A1, phi1, A2, A3, ... [m, rad] in the bandwidth of the filter, from the noise
        beside each harmonic; of phi1 at the median of A1.

    Raises
    ------
    ObservablesError
        If the dataset carries none.
    """
    try:
        return {str(name): float(value) for name, value in json.loads(observables.attrs["noise"]).items()}
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise ObservablesError(
            "the observables carry no noise", expected="a result of demodulate", got=repr(error)
        ) from error


def _demodulate(
    trace: _Trace,
    source: _Trace,
    orders: tuple[int, ...],
    track: str,
    near: float | None,
    bandwidth: float,
    spans: list[tuple[float, float]],
    reference_phase: float | None,
    output_rate: float | None,
    progress: Callable[[int, int], None] | None,
) -> xr.Dataset:
    _check_values(trace, "deflection")
    if source is not trace:
        _check_values(source, "drive")
    if near is not None:
        _check_length(trace, near)
    frequency, contrast = _find_line(source, near)
    frequency = near if track == NONE and near is not None else frequency
    _check_rates(trace, frequency, bandwidth, orders)
    low_pass = _low_pass(trace.rate, bandwidth, output_rate or 2.0 * bandwidth)
    leakage = _response(frequency / low_pass.bandwidth)
    if leakage > _CLEAN:
        warnings.warn(
            f"a bandwidth of {format_quantity(bandwidth, 'Hz')} lets neighbouring harmonics through, at {leakage:.1g}: "
            f"for less than {_CLEAN:g} it has to stay below {format_quantity(frequency / _MAIN_LOBE, 'Hz')}",
            DistortionWarning,
            stacklevel=2,
        )
    phase, first, last = _track(source, track, frequency, bandwidth, contrast, spans, orders)
    if last - first < low_pass.length:
        raise ObservablesError(
            "the trace is shorter than the filter",
            expected=f"{low_pass.length / trace.rate:.3g} s for a bandwidth of {format_quantity(bandwidth, 'Hz')}",
            got=f"{(last - first) / trace.rate:.3g} s",
            hint="a larger bandwidth, or a longer trace",
        )
    averaged, centres = _lock_in(trace, phase, orders, low_pass, first, last, progress)
    time = trace.start + centres / trace.rate
    phasors = {n: averaged[i] * (2.0 if n else 1.0) for i, n in enumerate(orders)}
    if reference_phase is not None:
        inside = _inside(time, spans)
        if not inside.any():
            raise OvertoneError(
                "no output lies in the reference", hint="a longer window, or a larger bandwidth"
            )
        shift = reference_phase + float(np.angle(phasors[1][inside].sum()))
        phasors = {n: a * np.exp(-1j * n * shift) for n, a in phasors.items()}
    sigma = _noise(trace, phase, orders, frequency, low_pass, (first, last), track == FOLLOW)
    return _observables(trace, time, phasors, phase, sigma, low_pass, leakage, track)


def _observables(
    trace: _Trace,
    time: _Floats,
    phasors: dict[int, _Complex],
    phase: _Phase,
    sigma: dict[int, float],
    low_pass: _LowPass,
    leakage: float,
    track: str,
) -> xr.Dataset:
    coords = {"time": xr.DataArray(time, dims="time", attrs={"units": "s", "long_name": "time"})}
    arrays: dict[str, xr.DataArray] = {}
    noise: dict[str, float] = {}
    for n, a in phasors.items():
        noise[f"A{n}"] = sigma[n]
        if n == 0:
            arrays["A0"] = named_array("A0", a.real, ("time",), coords)
            continue
        amplitude, lag = np.abs(a), -np.angle(a)
        arrays[f"A{n}"] = named_array(f"A{n}", amplitude, ("time",), coords)
        arrays[f"phi{n}"] = named_array(f"phi{n}", lag if n == 1 else lag % (2 * np.pi), ("time",), coords)
        if n == 1:
            noise["phi1"] = sigma[1] / float(np.median(amplitude))
    _, slope, curvature = phase.coefficients
    ends = (np.array([0.0, trace.values.size]) - phase.middle) / trace.rate
    drift = 2.0 * curvature * trace.rate**2 / (2.0 * math.pi)
    attributes = {
        "drive_frequency": slope * trace.rate / (2.0 * math.pi) + drift * float(ends.mean()),
        "frequency_drift": drift,
        "phase_error": phase.error,
        "track": track,
        "bandwidth": low_pass.bandwidth,
        "sampling_rate": trace.rate,
        "filter": f"Kaiser window, beta {_BETA:g}, {low_pass.length} samples ({low_pass.length / trace.rate:.4g} s)",
        "leakage": leakage,
        "noise": json.dumps(noise),
    }
    return validate_observables(xr.Dataset(arrays, attrs=attributes))


# --- arguments ------------------------------------------------------------------------------------


def _check_numbers(**numbers: float | None) -> None:
    for name, value in numbers.items():
        if value is not None and not (math.isfinite(value) and value > 0.0):
            raise OvertoneError(f"{name} is not positive", expected="a positive number in Hz", got=str(value))


def _orders(harmonics: Sequence[int]) -> tuple[int, ...]:
    orders = tuple(sorted(set(harmonics)))
    whole = all(isinstance(n, int | np.integer) and 0 <= n <= _HIGHEST for n in orders)
    if 1 not in orders or not whole:
        raise OvertoneError(
            "the harmonics are not usable",
            expected=f"whole numbers from 0 to {_HIGHEST}, 1 among them: A1 and phi1 are what all others refer to",
            got=str(tuple(harmonics)),
        )
    return tuple(int(n) for n in orders)


def _check_track(
    track: str | None, drive: Any, frequency: float | None, reference: Any, reference_phase: float | None
) -> str:
    chosen = track if track is not None else CONSTANT if drive is None else DRIVE
    if chosen not in TRACKS:
        raise OvertoneError("unknown track", expected=" or ".join(map(repr, TRACKS)), got=repr(track))
    if (chosen == DRIVE) != (drive is not None):
        raise OvertoneError(
            f"track={chosen!r} does not fit",
            expected="a recorded drive" if drive is None else "track='drive', because a drive was recorded",
            hint="drive=..., or another track" if drive is None else "leave out one of the two",
        )
    if chosen == NONE and frequency is None:
        raise OvertoneError("track='none' needs the frequency", expected="drive_frequency, exactly")
    if reference_phase is not None and (reference is None or not math.isfinite(reference_phase)):
        raise OvertoneError(
            "reference_phase has nothing to hold for",
            expected="a finite angle, and the times in which phi1 has this value",
            hint="reference=(start, stop)",
        )
    return chosen


def _trace(signal: Any, rate: float | None, name: str, unit: str | None) -> _Trace:
    values = signal.values if isinstance(signal, xr.DataArray) else np.asarray(signal)
    if values.ndim != 1 or values.dtype.kind not in "fiu" or values.size < 2:
        raise ObservablesError(
            f"the {name} is no trace",
            expected="real numbers over one dimension, time",
            got=f"shape {values.shape} of {values.dtype}",
        )
    _check_numbers(sampling_rate=rate)
    time = None
    if isinstance(signal, xr.DataArray):
        stated = signal.attrs.get("units", unit)
        if unit is not None and stated != unit:
            raise UnitError(
                f"the unit of the {name} does not fit",
                expected=f"a DataArray in {unit}",
                got=repr(stated),
                hint="multiply by the sensitivity in m/V and set attrs['units'] = 'm'",
            )
        time = signal.coords.get("time")
    if time is None:
        if rate is None:
            raise ObservablesError(
                f"the {name} has no time", expected="a coordinate time in s, or sampling_rate in Hz"
            )
        return _Trace(values, float(rate), 0.0)
    labels = time.values
    if labels.shape != values.shape or labels.dtype.kind not in "fiu" or time.attrs.get("units", "s") != "s":
        got = f"{labels.dtype} in {time.attrs.get('units', 's')!r}"
        raise UnitError("the coordinate time does not fit", expected="numbers in s along the trace", got=got)
    step = float(labels[-1] - labels[0]) / (values.size - 1)
    stated_step = step if rate is None else 1.0 / rate
    off = max(
        float(np.abs(labels[start : start + _BLOCK] - labels[0] - stated_step * np.arange(start, stop)).max())
        for start, stop in _blocks(0, values.size)
    )
    # Labels are rounded, and a rate that was measured is not: then they only have to tell the same story.
    if not (stated_step > 0.0 and off <= stated_step * (_JITTER if rate is None else 1.0)):
        raise ObservablesError(
            f"the {name} is not sampled uniformly",
            expected=f"a sample every {stated_step:.6g} s",
            got=f"times that are up to {off / abs(stated_step or 1.0):.3g} intervals off",
            hint="resample the trace, or give sampling_rate and leave out the time if its labels are only rounded",
        )
    return _Trace(values, 1.0 / stated_step, float(labels[0]))


def _beside(drive: _Trace, trace: _Trace) -> _Trace:
    if drive.values.size != trace.values.size:
        raise ObservablesError(
            "drive and deflection differ in length",
            expected=f"{trace.values.size} samples",
            got=str(drive.values.size),
        )
    return drive


def _spans(reference: Windows | None, trace: _Trace) -> list[tuple[float, float]]:
    if reference is None:
        return []
    end = trace.start + trace.values.size / trace.rate
    try:
        pairs = np.atleast_2d(np.asarray(reference, dtype=float))
    except (TypeError, ValueError):
        pairs = np.empty((0, 0))
    good = pairs.ndim == 2 and pairs.shape[1] == 2 and bool((pairs[:, 0] < pairs[:, 1]).all())
    if not good or not ((pairs[:, 0] < end) & (pairs[:, 1] > trace.start)).all():
        raise OvertoneError(
            "the reference is no part of the record",
            expected=f"(start, stop) within {trace.start:.6g} s to {end:.6g} s, or a list of them",
            got=str(reference),
        )
    return [(float(start), float(stop)) for start, stop in pairs]


def _inside(time: _Floats, spans: Sequence[tuple[float, float]]) -> npt.NDArray[np.bool_]:
    inside = np.zeros(time.shape, dtype=bool)
    for start, stop in spans:
        inside |= (time >= start) & (time <= stop)
    return inside


def _check_length(trace: _Trace, frequency: float) -> None:
    periods = trace.values.size / trace.rate * frequency
    if periods < _FEWEST_PERIODS:
        raise ObservablesError(
            "the trace is too short",
            expected=f"{_FEWEST_PERIODS} periods of the drive at least",
            got=f"{periods:.3g} periods of {format_quantity(frequency, 'Hz', 5)}",
        )


def _check_rates(trace: _Trace, frequency: float, bandwidth: float, orders: tuple[int, ...]) -> None:
    _check_length(trace, frequency)
    if bandwidth >= frequency / 2.0:
        raise OvertoneError(
            "the bandwidth does not separate harmonics",
            expected=f"less than half the drive frequency, {format_quantity(frequency / 2.0, 'Hz')}",
            got=format_quantity(bandwidth, "Hz"),
        )
    # a harmonic within a bandwidth of the limit meets its own mirror image
    if max(orders) * frequency + _MAIN_LOBE * bandwidth >= trace.rate / 2.0:
        raise OvertoneError(
            f"harmonic {max(orders)} is beyond what the sampling resolves",
            expected=f"less than half the sampling rate, {format_quantity(trace.rate / 2.0, 'Hz')}, with its sidebands",
            got=f"{format_quantity(max(orders) * frequency, 'Hz')} with a filter that reaches "
            f"{format_quantity(_MAIN_LOBE * bandwidth, 'Hz')} to each side",
            hint="fewer harmonics, or a faster recording",
        )


# --- the trace ------------------------------------------------------------------------------------


def _blocks(first: int, last: int) -> Iterator[tuple[int, int]]:
    return ((start, min(start + _BLOCK, last)) for start in range(first, last, _BLOCK))


def _check_values(trace: _Trace, name: str) -> None:
    """Refuse gaps, and warn where the signal ran against a limit."""
    values, lost, low, high = trace.values, 0, math.inf, -math.inf
    for start, stop in _blocks(0, values.size):
        block = values[start:stop]
        lost += int(block.size - np.isfinite(block).sum())
        low, high = min(low, float(block.min())), max(high, float(block.max()))
    if lost:
        raise ObservablesError(
            f"the {name} has gaps",
            expected="a number at every sample: a filter cannot leave any out",
            got=f"{lost} of {values.size} samples are not finite",
            hint="cut the trace before or after them",
        )
    if name == "drive" or high <= low:
        return  # a drive may be a square wave; a constant has no line, which is said elsewhere
    clipped = max(_at_limit(values, high, 1.0, high - low), _at_limit(values, low, -1.0, high - low))
    if clipped:
        warnings.warn(
            f"the {name} stands at its extreme in {clipped} of {values.size} samples, as where a detector or a "
            "converter saturates: its harmonics are then those of the clipping",
            DistortionWarning,
            stacklevel=2,
        )


def _at_limit(values: npt.NDArray[Any], limit: float, sign: float, span: float) -> int:
    """Return how many samples stand at an extreme where no smooth motion would leave so many, else 0."""
    nearest, at_nearest, at_limit, close = -math.inf, 0, 0, 0
    for start, stop in _blocks(0, values.size):
        below = sign * (limit - np.asarray(values[start:stop], dtype=np.float64))  # >= 0
        at_limit += int((below <= 1e-9 * span).sum())
        apart = below[(below > 1e-9 * span) & (below < 0.02 * span)]
        close += apart.size
        if apart.size:
            level = -float(apart.min())
            if level > nearest + 1e-9 * span:
                nearest, at_nearest = level, 0
            at_nearest += int((np.abs(-apart - nearest) <= 1e-9 * span).sum())
    # A turning point is passed smoothly: of the steps of a converter the last holds some three times the one
    # before it, and of values without steps it holds as many as any. The hundredth next to it is never empty
    # but where a period is a whole number of samples.
    if at_limit >= max(20, 1e-3 * values.size) and close and at_limit > 5 * at_nearest:
        return at_limit
    return 0


def _find_line(trace: _Trace, near: float | None) -> tuple[float, float]:
    """Return the frequency of the drive [Hz], and A^2/(2 S) [Hz]: power over the density of noise beside it.

    Raises
    ------
    ObservablesError
        If no line stands above the noise.
    """
    size = trace.values.size
    longest = min(size, _LONGEST_PIECE)
    best = chosen = 0.0
    frequency, passed = 0.0, False
    # A drive that drifts over many lines of the longest pieces is sharper in shorter ones.
    for length in dict.fromkeys(max(longest // part, min(longest, 1024)) for part in (1, 4, 16, 64)):
        found = _line_in_pieces(trace, length, near)
        if found is None:
            continue
        position, contrast, noise_width = found
        best = max(best, contrast)
        passed = passed or contrast > (_LINE if length == longest else _SHORT_LINE)
        if contrast * noise_width > chosen * (_SHARPER if chosen else 1.0):
            frequency, chosen = position * trace.rate / length, contrast * noise_width
    if passed:
        return frequency, chosen
    where = "in the trace" if near is None else f"within 5 % of {format_quantity(near, 'Hz', 6)}"
    raise ObservablesError(
        f"no line stands above the noise {where}",
        expected=f"a drive at least {_LINE:g} times the noise beside it, in power",
        got=f"{best:.2g} times at most",
        hint="the drive_frequency, the sampling_rate and the channel may be others",
    )


def _line_in_pieces(trace: _Trace, length: int, near: float | None) -> tuple[float, float, float] | None:
    """Return bin and contrast of the strongest line in pieces of this length, and the noise width of a bin [Hz]."""
    size = trace.values.size
    window = _kaiser(length, 0, length)
    starts = np.unique(np.linspace(0, size - length, min(16, -(-size // length))).astype(int))
    pieces = (np.asarray(trace.values[s : s + length], dtype=np.float64) for s in starts)
    power = np.array([np.abs(np.fft.rfft((piece - piece.mean()) * window)) ** 2 for piece in pieces])
    margin = math.ceil(_HALF_LOBE) + 1  # bins of a line to one side
    low, high = margin + 1, power.shape[1] - 2
    if near is not None:
        low = max(low, math.floor(0.95 * near * length / trace.rate) - 1)
        high = min(high, math.ceil(1.05 * near * length / trace.rate) + 2)
    if high <= low:
        return None
    centre = low + int(power[:, low:high].mean(axis=0).argmax())
    reach = max(margin, centre // 50)
    found = [_peak(piece, max(low, centre - reach), min(high, centre + reach + 1), margin) for piece in power]
    position, contrast = (float(np.median(part)) for part in zip(*found, strict=True))
    return position, contrast, trace.rate * float((window**2).sum()) / float(window.sum()) ** 2


def _peak(power: _Floats, low: int, high: int, margin: int) -> tuple[float, float]:
    """Return the position of the highest bin, interpolated, and its power over that of the noise beside it."""
    top = low + int(power[low:high].argmax())
    below, above = (
        power[max(top - 4 * margin, 2) : max(top - margin, 2)],
        power[top + margin : top + 4 * margin],
    )
    around = np.concatenate([below, above])
    floor = float(np.median(around)) / math.log(2.0) if around.size else 0.0
    with np.errstate(divide="ignore"):
        left, middle, right = np.log(power[top - 1 : top + 2])
    bend = left - 2.0 * middle + right
    shift = 0.5 * (left - right) / bend if math.isfinite(bend) and bend < 0.0 else 0.0
    height = float(power[top])
    contrast = height / floor if floor > 0.0 else math.inf if height > 0.0 else 0.0
    return top + float(np.clip(shift, -0.5, 0.5)), contrast


# --- the phase of the drive -----------------------------------------------------------------------


def _track(
    source: _Trace,
    track: str,
    frequency: float,
    bandwidth: float,
    contrast: float,
    spans: list[tuple[float, float]],
    orders: tuple[int, ...],
) -> tuple[_Phase, int, int]:
    """Return the phase of the drive and the samples for which it is known."""
    size, rate = source.values.size, source.rate
    middle, turn = 0.5 * (size - 1), 2.0 * math.pi * frequency / rate
    # Wide, so that a drift is followed far, as long as the noise of the phase stays below 0.15 rad.
    most = min(frequency / 6.0, max(4.0 * bandwidth, (1 << 19) * rate / size))
    width = max(min(most, 0.02 * contrast), min(bandwidth, frequency / 6.0))
    if width > 0.25 * contrast:
        raise ObservablesError(
            "no line stands above the noise in this bandwidth",
            expected="a phase that can be followed, better than 0.5 rad",
            got=f"an error of {math.sqrt(width / contrast):.2g} rad",
            hint="a smaller bandwidth",
        )
    low_pass = _low_pass(rate, width, 2.0 * width)
    at_first = _Phase(middle, (0.0, turn, 0.0))
    slow, centres = _lock_in(source, at_first, (1,), low_pass, 0, size)
    angle = np.unwrap(np.angle(slow[0]))
    if track in (DRIVE, FOLLOW):
        return _followed(centres, angle, middle, turn, track)
    u, lag = _thinned(centres, angle, 0.5 * rate / bandwidth)
    time = source.start + u / rate
    x = (u - middle) / middle
    if track == NONE:
        start = turn * middle + 2.0 * math.pi * frequency * source.start
        phase = _Phase(middle, (math.remainder(start, 2.0 * math.pi), turn, 0.0))
        deviation = lag
    else:
        coefficients, error, deviation = _fitted(
            x, lag, 2 if track == LINEAR else 1, _inside(time, spans), bool(spans)
        )
        c0, c1, c2 = coefficients
        phase = _Phase(middle, (c0, turn + c1 / middle, c2 / middle**2), error=error)
    _check_droop(deviation, u / rate, bandwidth, max(orders))
    return phase, 0, size


def _followed(
    centres: _Floats, angle: _Floats, middle: float, turn: float, track: str
) -> tuple[_Phase, int, int]:
    """Return the phase as it was measured; it is known between the first and the last measurement only."""
    from scipy.interpolate import CubicSpline

    if track == FOLLOW:
        warnings.warn(
            "the phase of the first harmonic was taken for that of the drive: phi1 is zero by construction, and only "
            "amplitudes and phi_n - n phi1 mean anything",
            PhaseReferenceWarning,
            stacklevel=2,
        )
    x = (centres - middle) / middle
    design = np.stack([np.ones_like(x), x, x**2], axis=1)
    c0, c1, c2 = (float(c) for c in _least_squares(design, angle))
    rest = CubicSpline(centres, angle - design @ np.array([c0, c1, c2]))
    phase = _Phase(middle, (c0, turn + c1 / middle, c2 / middle**2), rest)
    return phase, math.ceil(float(centres[0])), math.floor(float(centres[-1])) + 1


def _thinned(centres: _Floats, angle: _Floats, spacing: float) -> tuple[_Floats, _Floats]:
    """Average phases over about ``spacing`` samples, to 32 points at least and some 20,000 at most."""
    apart = float(centres[1] - centres[0]) if centres.size > 1 else 1.0
    group = max(1, int(min(centres.size / 32, max(spacing / apart, centres.size / 20_000))))
    whole = centres.size // group * group
    return centres[:whole].reshape(-1, group).mean(axis=1), angle[:whole].reshape(-1, group).mean(axis=1)


def _fitted(
    x: _Floats, angle: _Floats, degree: int, inside: npt.NDArray[np.bool_], referred: bool
) -> tuple[tuple[float, float, float], float, _Floats]:
    """Return coefficients of the phase over x, its standard error far from the fit, and what it leaves.

    Without a reference the largest part of the record that one line describes decides.
    """
    design = np.stack([x**p for p in range(degree + 1)], axis=1)
    sigma = 1.4826 * float(np.median(np.abs(np.diff(angle, 2)))) / math.sqrt(6.0) if angle.size > 2 else 0.0
    limit = max(5.0 * sigma, _STEADY)
    if referred:
        used = inside
        if used.sum() < degree + 3:
            raise OvertoneError(
                "the reference is too short to tell a frequency",
                expected=f"{degree + 3} points of the phase at least",
                got=f"{int(used.sum())}, which are {2.0 / max(x.size, 1):.2g} of half the record apart",
                hint="a longer window, or a larger bandwidth",
            )
        solution = _least_squares(design[used], angle[used])
    else:
        solution = _consensus(design, angle, limit)
        for _ in range(10):
            used = np.abs(angle - design @ solution) <= limit
            if used.sum() < degree + 3:
                used = np.ones(angle.shape, dtype=bool)
            solution = _least_squares(design[used], angle[used])
    left = angle - design @ solution
    _say_what_moves(left, used, limit, degree, referred)
    spread = float(np.sqrt((left[used] ** 2).sum() / max(int(used.sum()) - degree - 1, 1)))
    away = design - design[used].mean(axis=0)
    covariance = np.linalg.pinv(design[used].T @ design[used])
    error = spread * math.sqrt(float(np.einsum("ij,jk,ik->i", away, covariance, away).max(initial=0.0)))
    padded = [float(c) for c in solution] + [0.0] * (2 - degree)
    return (padded[0], padded[1], padded[2]), error, left


def _consensus(design: _Floats, angle: _Floats, limit: float) -> _Floats:
    """Return the line, among those through a few of the points, that most of the points lie on.

    Least squares would be turned by an approach at the end of the record, and so would least absolute deviations.
    """
    terms = design.shape[1]
    few = np.linspace(0, angle.size - 1, min(angle.size, 48 if terms == 2 else 20)).astype(int)
    best = _least_squares(design, angle)
    most = -1
    for some in itertools.combinations(few, terms):
        line = _least_squares(design[list(some)], angle[list(some)])
        count = int((np.abs(angle - design @ line) <= limit).sum())
        if count > most:
            best, most = line, count
    return best


def _least_squares(design: _Floats, angle: _Floats) -> _Floats:
    return np.asarray(np.linalg.lstsq(design, angle, rcond=None)[0], dtype=np.float64)


def _say_what_moves(
    left: _Floats, used: npt.NDArray[np.bool_], limit: float, degree: int, referred: bool
) -> None:
    what = "one frequency" if degree == 1 else "a frequency with a linear drift"
    if referred:
        unsteady = float(np.sqrt(np.mean(left[used] ** 2)))
        if unsteady > limit:
            warnings.warn(
                f"phi1 is not steady in the reference: it scatters by {math.degrees(unsteady):.2g} deg about {what}",
                PhaseReferenceWarning,
                stacklevel=2,
            )
        return
    moved = np.abs(left) > limit
    if moved.mean() > 0.02:
        warnings.warn(
            f"the phase of the first harmonic leaves {what} in {100.0 * moved.mean():.0f} % of the record, by up to "
            f"{math.degrees(float(np.abs(left).max())):.3g} deg. That is taken for a change of phi1, and the "
            "rest for steady; if the drive drifts, or phi1 moves in most of the record, it is not: record the drive, "
            "or say where phi1 is steady (reference)",
            PhaseReferenceWarning,
            stacklevel=2,
        )


def _check_droop(deviation: _Floats, time: _Floats, bandwidth: float, highest: int) -> None:
    """Warn where the first harmonic runs away from the drive so fast that the filter takes of the highest one."""
    if deviation.size < 3:
        return
    speed = np.abs(np.diff(deviation)) / np.diff(time) / (2.0 * math.pi)
    fastest = highest * float(np.quantile(speed, 0.95))
    loss = 1.0 - _response(fastest / bandwidth)
    if loss > _DROOP:
        warnings.warn(
            f"harmonic {highest} is up to {format_quantity(fastest, 'Hz')} away from where it is looked for, and the "
            f"filter takes {100.0 * loss:.2g} % of it: a larger bandwidth, track='linear' or 'follow', or a "
            "recorded drive",
            DistortionWarning,
            stacklevel=2,
        )


# --- the lock-in ----------------------------------------------------------------------------------


def _kaiser(length: int, start: int, stop: int) -> _Floats:
    """Return samples start to stop of the window, 1 at its middle and 0 outside."""
    x = (2.0 * np.arange(start, stop) - (length - 1)) / length
    inside = np.abs(x) < 1.0
    return np.where(inside, np.i0(_BETA * np.sqrt(np.where(inside, 1.0 - x**2, 0.0))) / np.i0(_BETA), 0.0)


def _response(offset: float) -> float:
    """Return the response at an offset in units of the noise bandwidth; beyond the main lobe its envelope."""
    square = _BETA**2 - (math.pi * _NOISE_WIDTH * offset) ** 2
    root = math.sqrt(abs(square))
    wave = 1.0 if offset >= _MAIN_LOBE else math.sinh(root) if square > 0.0 else math.sin(root)
    return wave / max(root, 1e-9) * _BETA / math.sinh(_BETA)


def _low_pass(rate: float, bandwidth: float, output_rate: float) -> _LowPass:
    length = 2 * max(round((_NOISE_WIDTH * rate / bandwidth - 1.0) / 2.0), 1) + 1
    total = squares = 0.0
    for start, stop in _blocks(0, length):
        window = _kaiser(length, start, stop)
        total, squares = total + float(window.sum()), squares + float((window**2).sum())
    return _LowPass(length, max(round(rate / output_rate), 1), 1.0 / total, 0.5 * rate * squares / total**2)


def _phase_at(phase: _Phase, start: int, stop: int) -> _Floats:
    index = np.arange(start, stop, dtype=np.float64)
    k = index - phase.middle
    c0, c1, c2 = phase.coefficients
    theta: _Floats = (c2 * k + c1) * k + c0
    return theta if phase.rest is None else theta + phase.rest(index)


def _lock_in(
    trace: _Trace,
    phase: _Phase,
    orders: tuple[int, ...],
    low_pass: _LowPass,
    first: int,
    last: int,
    progress: Callable[[int, int], None] | None = None,
) -> tuple[_Complex, _Floats]:
    """Return ``<q exp(-i n theta)>`` (order, output) over samples first to last, and the middle of each window.

    The trace is cut into segments of ``step`` samples. A window covers a few of them, so each segment is weighted
    with the window as far as it reaches into it, once for every window it lies in: one product of matrices.
    """
    length, step = low_pass.length, low_pass.step
    columns = -(-length // step)
    count = (last - first - length) // step + 1 if last - first >= length else 0
    out: _Complex = np.zeros((len(orders), count), dtype=np.complex128)
    segments = count + columns - 1 if count else 0
    rows, width = max(1, _BLOCK // step), min(step, _BLOCK)
    table = _weights(low_pass, 0, step) if length <= _TABLE else None
    for segment in range(0, segments, rows):
        height = min(rows, segments - segment)
        for part in range(0, step, width):
            stop = min(part + width, step)
            weights = table[part:stop] if table is not None else _weights(low_pass, part, stop)
            start = first + segment * step + part
            q = np.zeros(height * (stop - part))
            real = trace.values[start : min(start + q.size, last)]
            q[: real.size] = real
            theta = _phase_at(phase, start, start + q.size)
            _add_products(out, q, theta, orders, weights, segment, height)
        if progress is not None:
            progress(min((segment + height) * step, last - first), last - first)
    centres: _Floats = np.arange(count, dtype=np.float64) * step + (first + 0.5 * (length - 1))
    return out, centres


def _weights(low_pass: _LowPass, start: int, stop: int) -> _Floats:
    """Return the window over samples start to stop of each segment (sample, segment of the window)."""
    columns = -(-low_pass.length // low_pass.step)
    parts = [
        _kaiser(low_pass.length, k * low_pass.step + start, k * low_pass.step + stop) for k in range(columns)
    ]
    return np.stack(parts, axis=1) * low_pass.scale


def _add_products(
    out: _Complex,
    q: _Floats,
    theta: _Floats,
    orders: tuple[int, ...],
    weights: _Floats,
    segment: int,
    height: int,
) -> None:
    cosine, sine = np.cos(theta), np.sin(theta)
    c, s = np.ones_like(q), np.zeros_like(q)
    done = 0
    for i, n in enumerate(orders):
        for _ in range(n - done):
            c, s = c * cosine - s * sine, s * cosine + c * sine
        done = n
        products = (q * c).reshape(height, -1) @ weights
        if n:
            products = products - 1j * ((q * s).reshape(height, -1) @ weights)
        for k in range(weights.shape[1]):
            low, high = max(segment - k, 0), min(segment + height - k, out.shape[1])
            if high > low:
                out[i, low:high] += products[low + k - segment : high + k - segment, k]


# --- noise ----------------------------------------------------------------------------------------


def _noise(
    trace: _Trace,
    phase: _Phase,
    orders: tuple[int, ...],
    frequency: float,
    low_pass: _LowPass,
    samples: tuple[int, int],
    followed: bool,
) -> dict[int, float]:
    """Return the standard deviation of each A_n [m] that the floor beside its line makes in the bandwidth.

    A median over pieces of the trace, then over frequencies beside the harmonic, so that neither moments in which the
    motion changes count nor lines of other origin. A phase that was followed has taken the noise of the first harmonic
    out of one of its directions.
    """
    rate, bandwidth = trace.rate, low_pass.bandwidth
    first, last = samples
    length = min(last - first, _LONGEST_PIECE, max(4 * low_pass.length, math.ceil(64.0 * rate / frequency)))
    window = _kaiser(length, 0, length)
    edge = _HALF_LOBE * rate / length  # of a line, with this window
    high = 0.5 * frequency
    low = min(max(3.0 * bandwidth, bandwidth + 1.2 * edge), 0.6 * high)
    high = min(high, max(5.0 * low, low + 20.0 * rate / length))
    offset = np.fft.fftfreq(length, 1.0 / rate)
    beside = (offset >= low) & (offset <= high)
    sides = beside | ((-offset >= low) & (-offset <= high))
    pieces = (
        max(1, min(48, (last - first) // length)) - 1
    ) // 2 * 2 + 1  # odd: the median of as many has no bias
    starts = np.linspace(first, last - length, pieces).astype(int)
    power: dict[int, list[_Floats]] = {n: [] for n in orders}
    for start in starts:
        q = np.asarray(trace.values[start : start + length], dtype=np.float64) * window
        theta = _phase_at(phase, int(start), int(start) + length)
        for n in orders:
            turned = q * np.exp(-1j * n * theta)
            if n == 1 and followed:
                turned = turned.real * math.sqrt(2.0)
            power[n].append(np.abs(np.fft.fft(turned)[sides if n else beside]) ** 2)
    sigma: dict[int, float] = {}
    for n in orders:
        floor = float(np.median(np.median(power[n], axis=0))) / math.log(
            2.0
        )  # such powers are distributed exponentially
        density = 2.0 * floor / (rate * float((window**2).sum()))  # one-sided
        sigma[n] = math.sqrt((2.0 if n else 1.0) * density * bandwidth)
    return sigma
