"""A recorded deflection becomes observables: a lock-in for all harmonics at once, after the measurement.

The trace ``q(t)`` is turned back by n times the phase ``theta(t)`` of the drive and averaged,

    a_n(t) = 2 <q exp(-i n theta)> = A_n exp(-i phi_n)    (A_0 without the 2)

with the window of `overtone.instrument.lockin`. What `demodulate` calls ``track`` says how the phase of the drive is
known, and how its changes are told from those of phi1; see `overtone.instrument.drive_phase`.
"""

from __future__ import annotations

import json
import math
import warnings
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import xarray as xr

from overtone import provenance
from overtone.errors import DistortionWarning, ObservablesError, OvertoneError
from overtone.instrument.drive_phase import (
    CONSTANT,
    DRIVE,
    FOLLOW,
    NONE,
    TRACKS,
    Spans,
    find_line,
    inside,
    phase_of_drive,
)
from overtone.instrument.lockin import (
    BETA,
    MAIN_LOBE,
    LowPass,
    Phase,
    averages,
    length_for,
    low_pass,
    noise_beside,
    response,
)
from overtone.instrument.samples import Trace, check_positive, check_values, sampled
from overtone.io.opening import kept_warnings
from overtone.quantities import named_array, validate_observables
from overtone.units import format_quantity

_Floats = npt.NDArray[np.float64]
_Complex = npt.NDArray[np.complex128]
Windows = tuple[float, float] | Sequence[tuple[float, float]]

_CLEAN = 1e-6  # share of a neighbouring harmonic that may leak
_FEWEST_PERIODS = 20
_HIGHEST = 64


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
    check_positive(bandwidth=bandwidth, drive_frequency=drive_frequency, output_rate=output_rate)
    orders = _orders(harmonics)
    chosen = _check_track(track, drive, drive_frequency, reference, reference_phase)
    trace = sampled(deflection, sampling_rate, "deflection", "m")
    source = trace if drive is None else _beside(sampled(drive, trace.rate, "drive"), trace)
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
    with kept_warnings() as said:
        result = _demodulated(
            trace,
            source,
            orders=orders,
            track=chosen,
            near=drive_frequency,
            bandwidth=bandwidth,
            output_rate=output_rate or 2.0 * bandwidth,
            spans=spans,
            reference_phase=reference_phase,
            progress=progress,
        )
    result = provenance.add_finding(result, *(text.rstrip(".") + "." for text in said))
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


def _demodulated(
    trace: Trace,
    source: Trace,
    *,
    orders: tuple[int, ...],
    track: str,
    near: float | None,
    bandwidth: float,
    output_rate: float,
    spans: Spans,
    reference_phase: float | None,
    progress: Callable[[int, int], None] | None,
) -> xr.Dataset:
    """Do what `demodulate` does, with arguments that have been checked; ``source`` is what tells the phase."""
    check_values(trace, "deflection")
    if source is not trace:
        check_values(source, "drive", may_clip=True)  # a reference signal may be a square wave
    if near is not None:
        _check_length(trace, near)
    frequency, contrast = find_line(source, near)
    frequency = near if track == NONE and near is not None else frequency
    _check_rates(trace, frequency, bandwidth, orders)
    length = length_for(trace.rate, bandwidth)
    _check_fits(trace.values.size, length, trace.rate, bandwidth)
    window = low_pass(trace.rate, length, max(round(trace.rate / output_rate), 1))
    leakage = response(frequency / window.bandwidth)
    if leakage > _CLEAN:
        warnings.warn(
            f"a bandwidth of {format_quantity(bandwidth, 'Hz')} lets neighbouring harmonics through, at {leakage:.1g}: "
            f"for less than {_CLEAN:g} it has to stay below {format_quantity(frequency / MAIN_LOBE, 'Hz')}",
            DistortionWarning,
            stacklevel=2,
        )
    phase, first, last = phase_of_drive(
        source, track, frequency, contrast, bandwidth=bandwidth, spans=spans, highest=max(orders)
    )
    _check_fits(last - first, length, trace.rate, bandwidth)
    means, centres = averages(trace, phase, orders, window, first, last, progress)
    time = trace.start + centres / trace.rate
    phasors = {n: means[i] * (2.0 if n else 1.0) for i, n in enumerate(orders)}
    if reference_phase is not None:
        referred = inside(time, spans)
        if not referred.any():
            raise OvertoneError(
                "no output lies in the reference", hint="a longer window, or a larger bandwidth"
            )
        shift = reference_phase + float(np.angle(phasors[1][referred].sum()))
        phasors = {n: a * np.exp(-1j * n * shift) for n, a in phasors.items()}
    sigma = noise_beside(trace, phase, orders, frequency, window, (first, last), followed=track == FOLLOW)
    return _observables(time, phasors, trace.rate, phase, sigma, window, leakage, track)


def _observables(
    time: _Floats,
    phasors: dict[int, _Complex],
    rate: float,
    phase: Phase,
    sigma: dict[int, float],
    window: LowPass,
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
    attributes = {
        "drive_frequency": slope * rate / (2.0 * math.pi),
        "frequency_drift": 2.0 * curvature * rate**2 / (2.0 * math.pi),
        "phase_error": phase.error,
        "track": track,
        "bandwidth": window.bandwidth,
        "sampling_rate": rate,
        "filter": f"Kaiser window, beta {BETA:g}, {window.length} samples ({window.length / rate:.4g} s)",
        "leakage": leakage,
        "noise": json.dumps(noise),
    }
    return validate_observables(xr.Dataset(arrays, attrs=attributes))


# --- arguments ------------------------------------------------------------------------------------


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


def _beside(drive: Trace, trace: Trace) -> Trace:
    if drive.values.size != trace.values.size:
        raise ObservablesError(
            "drive and deflection differ in length",
            expected=f"{trace.values.size} samples",
            got=str(drive.values.size),
        )
    return drive


def _spans(reference: Windows | None, trace: Trace) -> list[tuple[float, float]]:
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


def _check_length(trace: Trace, frequency: float) -> None:
    periods = trace.values.size / trace.rate * frequency
    if periods < _FEWEST_PERIODS:
        raise ObservablesError(
            "the trace is too short",
            expected=f"{_FEWEST_PERIODS} periods of the drive at least",
            got=f"{periods:.3g} periods of {format_quantity(frequency, 'Hz', 5)}",
        )


def _check_rates(trace: Trace, frequency: float, bandwidth: float, orders: tuple[int, ...]) -> None:
    _check_length(trace, frequency)
    if bandwidth >= frequency / 2.0:
        raise OvertoneError(
            "the bandwidth does not separate harmonics",
            expected=f"less than half the drive frequency, {format_quantity(frequency / 2.0, 'Hz')}",
            got=format_quantity(bandwidth, "Hz"),
        )
    # a harmonic within a bandwidth of the limit meets its own mirror image
    if max(orders) * frequency + MAIN_LOBE * bandwidth >= trace.rate / 2.0:
        raise OvertoneError(
            f"harmonic {max(orders)} is beyond what the sampling resolves",
            expected=f"less than half the sampling rate, {format_quantity(trace.rate / 2.0, 'Hz')}, with its sidebands",
            got=f"{format_quantity(max(orders) * frequency, 'Hz')} with a filter that reaches "
            f"{format_quantity(MAIN_LOBE * bandwidth, 'Hz')} to each side",
            hint="fewer harmonics, or a faster recording",
        )


def _check_fits(samples: int, length: int, rate: float, bandwidth: float) -> None:
    if samples < length:
        raise ObservablesError(
            "the trace is shorter than the filter",
            expected=f"{length / rate:.3g} s for a bandwidth of {format_quantity(bandwidth, 'Hz')}",
            got=f"{samples / rate:.3g} s",
            hint="a larger bandwidth, or a longer trace",
        )
