"""Optical detection in the time domain: a laser spot on a split photodiode, sampled and demodulated.

The diode tells how much more light falls on one half than on the other. The harmonics it fakes come out of
the shape of the spot here, not out of a polynomial, so that a correction that fits polynomials is tested
against something it was not built on. Deflections and spot sizes share one scale, metres of deflection.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import xarray as xr

from overtone import provenance
from overtone.errors import DistortionWarning, ObservablesError, OvertoneError
from overtone.quantities import harmonic_orders, named_array, quantity, validate_observables

ROUND = "round"
SQUARE = "square"
GAUSSIAN = "gaussian"

_Floats = npt.NDArray[np.float64]
_FAINTEST_SLOPE = 1e-2  # of the centred spot's: beyond, nobody would call the laser aligned
_ALIASING = 1e-6  # of the stroke: the highest harmonics of the reading must have died down to this
_LINE_SPACING = 20.0  # bins of the record: there the lock-in's window has fallen to 4e-7
_BLOCK = 2**20  # samples in memory at a time


@dataclass(frozen=True)
class SplitDiode:
    """A spot of light on a photodiode of two halves.

    Parameters
    ----------
    spot : float
        Full width of the spot [m of deflection]: diameter of a round one, side of a square one, four
        standard deviations (the 1/e^2 diameter) of a Gaussian one.
    shape : str
        ``round`` or ``square`` (evenly lit) or ``gaussian``.
    offset : float
        Where the spot's centre rests, from the middle of the diode [m of deflection].
    gap : float
        Width of the dead zone between the halves [m of deflection].

    Raises
    ------
    OvertoneError
        If a number is unphysical, or at rest the spot is so far on one half or so deep in the gap that its
        motion hardly changes the reading.
    """

    spot: float
    shape: str = ROUND
    offset: float = 0.0
    gap: float = 0.0

    def __post_init__(self) -> None:
        if self.shape not in _RESPONSES:
            raise OvertoneError(
                "unknown shape of a laser spot", expected=" or ".join(_RESPONSES), got=repr(self.shape)
            )
        if not (0.0 < self.spot < math.inf and math.isfinite(self.offset) and 0.0 <= self.gap < math.inf):
            raise OvertoneError(
                "unphysical photodiode",
                expected="a finite spot > 0, a finite offset and a finite gap >= 0",
                got=f"spot = {self.spot!r}, offset = {self.offset!r}, gap = {self.gap!r}",
            )
        centred = _RESPONSES[self.shape](np.zeros(1))[1].item() * 2.0 / self.spot
        slope = _difference(self, np.array([self.offset]))[1].item()
        if not slope >= _FAINTEST_SLOPE * centred:
            raise OvertoneError(
                "the laser is not aligned",
                expected=f"a slope at rest of at least {_FAINTEST_SLOPE:.0%} of the centred spot's without gap",
                got=f"{slope / centred:.2g} of it",
                hint="an offset below half the spot and a gap below the spot",
            )


def _round(x: _Floats) -> tuple[_Floats, _Floats]:
    """Return difference of light over total light and its derivative; x = centre over half width."""
    x = np.clip(x, -1.0, 1.0)  # beyond, the spot has left one half
    chord = np.sqrt(1.0 - x * x)
    return (x * chord + np.arcsin(x)) * (2.0 / np.pi), chord * (4.0 / np.pi)


def _square(x: _Floats) -> tuple[_Floats, _Floats]:
    return np.clip(x, -1.0, 1.0), np.where(np.abs(x) < 1.0, 1.0, 0.0)


def _gaussian(x: _Floats) -> tuple[_Floats, _Floats]:
    from scipy.special import erf

    # half width = 2 sigma: centre over sqrt(2) sigma is sqrt(2) x
    u = math.sqrt(2.0) * x
    return np.asarray(erf(u)), np.exp(-u * u) * math.sqrt(8.0 / np.pi)


_RESPONSES = {ROUND: _round, SQUARE: _square, GAUSSIAN: _gaussian}


def _difference(diode: SplitDiode, centre: _Floats) -> tuple[_Floats, _Floats]:
    """Return difference of light over all light of the spot, and its derivative [1/m], by the spot's centre."""
    shape, half = _RESPONSES[diode.shape], diode.spot / 2.0
    if diode.gap == 0.0:
        value, slope = shape(centre / half)
        return value, slope / half
    # With H(u) the share of light beyond an edge at distance u, halves with a gap see H(c - gap/2) and
    # 1 - H(c + gap/2): the difference is the mean of two diodes without gap.
    left, right = shape((centre + diode.gap / 2.0) / half), shape((centre - diode.gap / 2.0) / half)
    return (left[0] + right[0]) / 2.0, (left[1] + right[1]) / (2.0 * half)


def response(diode: SplitDiode, deflection: Any, *, zeroed: bool = False) -> _Floats:
    """Return what the diode reads, calibrated so that small deflections about rest read true.

    Parameters
    ----------
    diode : SplitDiode
        The detector.
    deflection : array, any shape
        Deflection from rest [m].
    zeroed : bool
        Whether the reading at rest is subtracted. It is about the offset of the spot otherwise.

    Returns
    -------
    array, shape of ``deflection``
        Reading [m]. Constant where the spot has left one half.

    Notes
    -----
    Assumes the difference signal at constant laser power: what falls into a gap is not made up for by
    dividing by the sum of both halves.

    Examples
    --------
    >>> diode = SplitDiode(spot=500e-9, offset=25e-9)
    >>> (response(diode, [-94e-9, 1e-12, 94e-9], zeroed=True) * 1e9).round(4)
    array([-9.35408e+01,  1.00000e-03,  8.98316e+01])
    """
    rest, slope = (part.item() for part in _difference(diode, np.array([diode.offset])))
    reading = _difference(diode, diode.offset + np.asarray(deflection, dtype=float))[0]
    return np.asarray((reading - rest if zeroed else reading) / slope)


def waveform(observables: xr.Dataset, phase: Any) -> xr.DataArray:
    """Return the deflection over a period, ``q(theta) = A0 + sum A_n cos(n theta - phi_n)``.

    Parameters
    ----------
    observables : Dataset
        A1, phi1 and any of A0, A2, phi2, ... [m, rad], any dimensions.
    phase : array (theta,)
        theta = w t [rad].

    Returns
    -------
    DataArray
        Deflection [m], dimensions of the observables and ``theta`` last.

    Raises
    ------
    ObservablesError
        If the dataset does not keep the contract of observables.
    OvertoneError
        If ``phase`` is not one-dimensional.
    """
    theta = np.atleast_1d(np.asarray(phase, dtype=float))
    if theta.ndim != 1:
        raise OvertoneError("phases of a waveform lie on one axis", got=f"an array of shape {theta.shape}")
    phasors = _phasors(observables)
    coords = {"theta": ("theta", theta, {"units": "rad", "long_name": "phase of the drive"})}
    values = _sum_of_harmonics(phasors.values, phasors["harmonic"].values, theta)
    return _deflection(values, phasors, "theta", coords, "deflection")


def read_through(
    observables: xr.Dataset,
    diode: SplitDiode,
    *,
    offset: Any = 0.0,
    orders: Sequence[int] | None = None,
    samples: int = 64,
    zeroed: bool = False,
) -> xr.Dataset:
    """Return the observables that a lock-in without noise reads from the diode in the steady state.

    Parameters
    ----------
    observables : Dataset
        True motion: A1, phi1 and any of A0, A2, phi2, ... [m, rad], any dimensions. Harmonics that are
        absent do not move the spot.
    diode : SplitDiode
        The detector, calibrated at rest.
    offset : float, array or DataArray
        Drift of the spot from rest [m]: one number, an array that broadcasts against A1, or a named array,
        whose new dimensions the result takes too.
    orders : sequence of int, optional
        Harmonics to return; those that are present unless given.
    samples : int
        Samples a period.
    zeroed : bool
        As in `response`.

    Returns
    -------
    Dataset
        A0, A1, phi1, ... as read; phases in [0, 2 pi). Everything else in the dataset is kept.

    Raises
    ------
    ObservablesError
        If the dataset does not keep the contract of observables, or the offset does not fit it.
    OvertoneError
        If ``samples`` are too few: the highest harmonics of the reading must be below 1e-6 of the stroke.
    """
    phasors, shift = _with_shift(_phasors(observables), offset)
    present = phasors["harmonic"].values
    wanted = np.array(sorted(present if orders is None else set(orders)), dtype=int)
    first_of_tail = 3 * samples // 8  # the top quarter of the spectrum shows whether it has died down
    if wanted.size == 0 or wanted.min() < 0 or max(present.max(), wanted.max()) >= first_of_tail:
        raise OvertoneError(
            "these harmonics cannot be had from these samples",
            expected="orders from 0 to below 3/8 of the samples a period",
            got=f"orders {wanted.tolist()} of a motion with {present.tolist()}, {samples} samples",
        )
    theta = 2.0 * np.pi * np.arange(samples) / samples
    rows, shifts = phasors.values.reshape(-1, present.size), shift.values.ravel()
    read, unresolved = np.empty((len(rows), wanted.size), complex), 0
    size = max(1, _BLOCK // samples)
    for block in (slice(start, start + size) for start in range(0, len(rows), size)):
        motion = _sum_of_harmonics(rows[block], present, theta) + shifts[block, None]
        reading = response(diode, motion, zeroed=zeroed)
        spectrum = np.fft.rfft(reading) * (2.0 / samples)
        spectrum[:, 0] /= 2.0
        read[block] = spectrum[:, wanted]
        stroke = np.abs(rows[block][:, present > 0]).sum(axis=1)
        rounding = 1e-14 * np.abs(reading).max(axis=1)
        tail = np.abs(spectrum[:, first_of_tail:]).max(axis=1)
        unresolved += int((tail > _ALIASING * stroke + rounding).sum())
    if unresolved:
        raise OvertoneError(
            f"{samples} samples a period do not resolve the reading at {unresolved} of {len(rows)} points",
            expected=f"harmonics that fall below {_ALIASING:g} of the stroke",
            hint=f"samples={4 * samples}: where the spot leaves one half, harmonics fall slowly",
        )
    result = _observables(read.reshape(*shift.shape, wanted.size), wanted, shift.dims, phasors.coords)
    kept = [name for name in observables.data_vars if not _is_harmonic(str(name))]
    result = result.assign({name: observables[name] for name in kept}).assign_attrs(observables.attrs)
    drift = float(shift.values.flat[0]) if np.ndim(offset) == 0 else f"array of {shift.sizes}"
    return provenance.record(
        result, "read_through", diode=asdict(diode), offset=drift, samples=samples, zeroed=zeroed
    )


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
    phasors = _phasors(observables)
    orders = phasors["harmonic"].values
    if orders.max() * drive_frequency >= sampling_rate / 2.0:
        raise OvertoneError(
            f"harmonic {orders.max()} lies above half the sampling rate",
            expected=f"a sampling rate above {2.0 * orders.max() * drive_frequency:.4g} Hz",
            got=f"{sampling_rate:.4g} Hz",
            hint="a higher rate, or a motion without that harmonic",
        )
    time = np.arange(round(duration * sampling_rate)) / sampling_rate
    motion = _sum_of_harmonics(phasors.values, orders, 2.0 * np.pi * drive_frequency * time)
    reading = response(diode, motion + drift_rate * time, zeroed=zeroed)
    if noise_density > 0.0:
        # a one-sided density S up to half the rate: sigma^2 = S fs / 2
        sigma = noise_density * math.sqrt(sampling_rate / 2.0)
        reading = reading + np.random.default_rng(seed).normal(0.0, sigma, reading.shape)
    if adc is not None:
        reading = _quantise(reading, *adc)
    coords = {"time": ("time", time, {"units": "s", "long_name": "time"})}
    return _deflection(reading, phasors, "time", coords, "deflection as the photodiode reads it")


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
    """Return the phasors ``a_n = A_n exp(-i phi_n)`` of a trace by a plain digital lock-in.

    Multiplies by ``exp(-i n w t)``, t being the time of the trace, and averages under a squared Hann window,
    in which another harmonic k bins of the record away counts as ``4/(pi k^5)``.

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
        coordinate ``time`` is its middle), and ``harmonic`` last; see `observables_of`.
    bandwidth : float
        B [Hz]: white noise of one-sided power density S gives each of Re a_n and Im a_n a standard
        deviation of sqrt(2 S B), the mean A0 one of sqrt(S B).

    Raises
    ------
    OvertoneError
        If the trace has no even time, or is too short or too coarse to keep the harmonics apart.
    """
    orders = np.array(sorted(set(harmonics)), dtype=int)
    time = trace["time"].values.astype(float) if "time" in trace.coords else np.zeros(0)
    if trace.dims.count("time") != 1 or time.size < 2 or not _even(time):
        raise OvertoneError(
            "the trace has no even time",
            expected="a dimension time with a coordinate in seconds at even steps",
            got=f"dimensions {trace.dims}, {time.size} times",
        )
    rate = (time.size - 1) / (time[-1] - time[0])
    count = time.size if duration is None else max(round(duration * rate), 1)
    if orders.size == 0 or orders.min() < 0 or count > time.size:
        raise OvertoneError(
            "this demodulation cannot be done",
            expected=f"harmonics >= 0 and at most {time.size / rate:.4g} s",
            got=f"harmonics {orders.tolist()}, {count / rate:.4g} s",
        )
    _require_resolved(orders, drive_frequency, rate, count)

    values = np.moveaxis(trace.values, trace.dims.index("time"), -1)
    windows = time.size // count
    values = values[..., : windows * count].reshape(*values.shape[:-1], windows, count)
    weight = np.sin(np.pi * (np.arange(count) + 0.5) / count) ** 4
    weight /= weight.sum()
    theta = 2.0 * np.pi * drive_frequency * (time[:count] - time[0])
    turn = orders[:, None] * theta
    # one product of real matrices: cosines and sines side by side
    sums = values @ np.concatenate([weight * np.cos(turn), -weight * np.sin(turn)]).T
    phasors = sums[..., : orders.size] + 1j * sums[..., orders.size :]
    phasors *= np.where(orders > 0, 2.0, 1.0)
    start = time[: windows * count : count]
    phasors *= np.exp(-2j * np.pi * drive_frequency * start[:, None] * orders)
    middle = start + (count - 1) / (2.0 * rate)

    dims = [name for name in trace.dims if name != "time"]
    coords = {name: value for name, value in trace.coords.items() if "time" not in value.dims}
    coords["harmonic"] = xr.DataArray(orders, dims="harmonic")
    if duration is None:
        phasors = phasors[..., 0, :]
    else:
        dims.append("window")
        coords["time"] = xr.DataArray(middle, dims="window", attrs=dict(trace["time"].attrs))
    attrs = {"units": "m", "long_name": "phasors A_n exp(-i phi_n)"}
    result = xr.DataArray(phasors, coords, [*dims, "harmonic"], name="phasor", attrs=attrs)
    return result, float(rate * (weight**2).sum() / 2.0)


def observables_of(phasors: xr.DataArray) -> xr.Dataset:
    """Return A0, A1, phi1, ... of phasors over ``harmonic``, phases in [0, 2 pi)."""
    phasors = phasors.transpose(..., "harmonic")
    return _observables(phasors.values, phasors["harmonic"].values, phasors.dims[:-1], phasors.coords)


def _even(time: _Floats) -> bool:
    steps = np.diff(time)
    return bool(steps[0] > 0.0 and np.abs(steps - steps.mean()).max() < 1e-6 * steps.mean())


def _require_resolved(orders: npt.NDArray[np.int_], frequency: float, rate: float, count: int) -> None:
    """Refuse where two lines of a real signal, n f and -m f, or their images by the sampling, come too close."""
    highest = int(max(orders.max(), 1))
    lines = np.arange(-highest, highest + 1) * frequency
    distance = np.abs(orders[:, None] * frequency - lines)
    distance = np.abs(distance - rate * np.round(distance / rate)) * count / rate
    other = orders[:, None] != np.arange(-highest, highest + 1)
    closest = float(distance[other].min()) if frequency > 0.0 else 0.0
    if not (closest >= _LINE_SPACING and highest * frequency < rate / 2.0):
        raise OvertoneError(
            "the record does not keep the harmonics apart",
            expected=f"{_LINE_SPACING:g} periods at least, and harmonics below half of the sampling rate",
            got=f"{frequency * count / rate:.4g} periods at {rate:.4g} Hz, harmonic {highest} "
            f"at {highest * frequency:.4g} Hz, lines {closest:.3g} periods apart",
            hint="a longer or faster record, or fewer harmonics",
        )


def _is_harmonic(name: str) -> bool:
    record = quantity(name)
    return record is not None and record.symbol.startswith(("A_", "phi_"))


def _phasors(observables: xr.Dataset) -> xr.DataArray:
    """Return a_n over the dimensions of the observables, those of A1 first, and ``harmonic``."""
    orders = harmonic_orders(validate_observables(observables))
    with np.errstate(invalid="ignore"):  # an infinite phase is a lost pixel, as NaN is
        parts = [
            observables["A0"] + 0j if n == 0 else observables[f"A{n}"] * np.exp(-1j * observables[f"phi{n}"])
            for n in orders
        ]
    _, *parts = xr.broadcast(observables["A1"], *parts)
    harmonic = xr.DataArray(list(orders), dims="harmonic", name="harmonic")
    return xr.concat(parts, dim=harmonic, coords="minimal", compat="override").transpose(..., "harmonic")


def _with_shift(phasors: xr.DataArray, offset: Any) -> tuple[xr.DataArray, xr.DataArray]:
    """Return phasors and offset on the same dimensions, but for ``harmonic`` at the end of the first."""
    own = phasors.isel(harmonic=0, drop=True)
    try:
        if not isinstance(offset, xr.DataArray):
            values = np.broadcast_to(np.asarray(offset, dtype=float), own.shape)
            offset = xr.DataArray(values, own.coords, own.dims)
        xr.align(own, offset, join="exact")
        spread, shift = xr.broadcast(phasors, offset, exclude=["harmonic"])
    except (ValueError, TypeError) as error:
        raise ObservablesError(
            "the offset of the spot does not fit the observables",
            expected=f"a number, or an array over some of {dict(own.sizes)}",
            got=str(error).splitlines()[0],
        ) from error
    if not bool(np.isfinite(shift).all()):
        raise ObservablesError("the offset of the spot is not finite", expected="metres of deflection")
    dims = [*own.dims, *(name for name in offset.dims if name not in own.dims)]
    return spread.assign_coords(offset.coords).transpose(*dims, "harmonic"), shift.transpose(*dims)


def _sum_of_harmonics(
    phasors: npt.NDArray[np.complex128], orders: npt.NDArray[Any], theta: _Floats
) -> _Floats:
    """Return Re sum a_n exp(i n theta) with theta on a new last axis."""
    turn = orders[:, None] * theta
    with np.errstate(invalid="ignore"):
        return np.asarray(phasors.real @ np.cos(turn) - phasors.imag @ np.sin(turn))


def _observables(phasors: npt.NDArray[np.complex128], orders: Any, dims: Any, coords: Any) -> xr.Dataset:
    arrays: dict[str, xr.DataArray] = {}
    for k, n in enumerate(int(n) for n in orders):
        phasor = phasors[..., k]
        if n == 0:
            arrays["A0"] = named_array("A0", phasor.real, dims, coords)
        else:
            arrays[f"A{n}"] = named_array(f"A{n}", np.abs(phasor), dims, coords)
            arrays[f"phi{n}"] = named_array(f"phi{n}", -np.angle(phasor) % (2.0 * np.pi), dims, coords)
    return xr.Dataset(arrays)


def _deflection(
    values: _Floats, phasors: xr.DataArray, axis: str, coords: dict[str, Any], meaning: str
) -> xr.DataArray:
    own = {name: value for name, value in phasors.coords.items() if "harmonic" not in value.dims}
    dims = [*(name for name in phasors.dims if name != "harmonic"), axis]
    attrs = {"units": "m", "long_name": meaning}
    return xr.DataArray(values, {**own, **coords}, dims, name="deflection", attrs=attrs)
