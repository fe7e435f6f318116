"""Where the noise of a scan comes from: its own scatter, or the lever, the detector and the lock-in before it.

The scatter is told from second differences along the fast axis,

    d = v(x - 1) - 2 v(x) + v(x + 1),    sigma = median|d| / (0.6745 sqrt(6))

for white noise, of which d has six times the variance. Slopes cancel, a boundary touches two differences, and the
median of many does not see the few. From lever and detector, a lock-in of noise bandwidth B leaves ``sqrt(2 S B)`` in
each quadrature of a harmonic and ``sqrt(S B)`` in the mean, S being the one-sided density where the harmonic is.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import xarray as xr

from overtone.errors import ObservablesError, OvertoneError
from overtone.instrument.signals import in_the_frame_of_the_first, signals_of
from overtone.instrument.thermal_noise import ROOM_TEMPERATURE, thermal_noise_density
from overtone.probe import Probe
from overtone.quantities import validate_observables

_Floats = npt.NDArray[np.float64]

FEWEST_PIXELS = 100
"""Pixels with both neighbours that a scatter needs; the standard error is then 14 % of it."""
_MEDIAN = 0.6744897501960817  # of |z|, z standard normal
_GAIN = math.sqrt(6.0)  # 1 + 4 + 1: of white noise in a second difference
_ROUNDING = 1e-12  # of a value: neighbours that differ by less are the same number


def noise_from_scan(observables: xr.Dataset, *, skip: Collection[str] = ()) -> dict[str, float]:
    """Return the noise of a scan from how each pixel differs from its neighbours along the fast axis x.

    Parameters
    ----------
    observables : Dataset
        Observables with a dimension ``x`` and any others.
    skip : collection of str
        Observables that need not be told, such as those whose noise is known otherwise.

    Returns
    -------
    dict
        Standard deviation of one reading of A1, phi1, A0 and of each quadrature of higher harmonics, in the frame of
        the first as in `overtone.noise_from_pair` [m, rad], for `overtone.instrument.noise.complete_noise`.

    Raises
    ------
    ObservablesError
        If the dataset does not keep the contract of observables, or has no dimension x.
    OvertoneError
        If fewer than 100 pixels have both neighbours, or more than half of them lie on the line between these to
        rounding, so that nothing can be told: a constant channel, or one in steps coarser than its noise.

    Notes
    -----
    For white noise. The standard error is ``1.4/sqrt(n)`` of it for n pixels: 1 % of a scan of 128 x 128.

    Too low: a lock-in slower than a pixel makes neighbours alike, and so does software that smooths. Behind a
    first-order low-pass, with ``r = exp(-4 B t)`` between pixels t apart, the result is ``sqrt((1 - r)(3 - r)/3)`` of
    the noise: 0.91 for r = 0.135, 0.65 for 0.5, 0.26 for 0.9. It is a lower bound there. Drift from line to line, 1/f
    noise slower than a line and every calibration error are not in it at all.

    Too high: what sample and feedback really do from one pixel to the next. Straight boundaries every 100 pixels add
    2 %, every 50 pixels 5 %, every 20 pixels 13 %; a wave of ten times the noise adds 4 % where it is 20 pixels long
    and 0.1 % where 50. Grains of a pixel and the error of a feedback count in full, though they are no noise: 0.3 % of
    A1, forgotten over three pixels, doubles the A1 of the demo's scan and adds 46 % to its A2, where trace and retrace
    and a lift pass come within 2 % of either. A channel stored in steps of half the noise to twice the noise is off by
    up to a fifth either way.
    """
    validate_observables(observables)
    if "x" not in observables["A1"].dims:
        raise ObservablesError(
            "no scatter along a line can be told",
            expected="a scan with a dimension x, the fast axis",
            got=f"dimensions {', '.join(map(str, observables['A1'].dims)) or 'none'}",
        )
    signals = signals_of(observables.transpose(..., "x"))
    first = signals.phasor[1]
    noise: dict[str, float] = {}
    if "A1" not in skip:
        size = np.abs(first)
        noise["A1"] = _scatter(_second_difference(size), _level(size), "A1")
    if "phi1" not in skip:
        with np.errstate(invalid="ignore", divide="ignore"):  # lost pixels
            turn = first / np.abs(first)
        # of an angle, so that one that passes 360 degrees is no jump
        bend = np.angle(turn[..., 2:] * turn[..., :-2] * np.conj(turn[..., 1:-1]) ** 2)
        noise["phi1"] = _scatter(bend, 1.0, "phi1")
    if signals.mean is not None and "A0" not in skip:
        noise["A0"] = _scatter(_second_difference(signals.mean), _level(signals.mean), "A0")
    for n, phasor in sorted(in_the_frame_of_the_first(signals).items()):
        if f"A{n}" not in skip:
            bend, level = _second_difference(phasor), _level(phasor)
            parts = [_scatter(part, level, f"A{n}") for part in (bend.real, bend.imag)]
            noise[f"A{n}"] = math.hypot(*parts) / math.sqrt(2.0)
    return noise


def _second_difference(values: npt.NDArray[Any]) -> npt.NDArray[Any]:
    with np.errstate(invalid="ignore"):  # infinities are lost pixels, as NaN is
        return np.asarray(values[..., 2:] - 2.0 * values[..., 1:-1] + values[..., :-2])


def _level(values: npt.NDArray[Any]) -> float:
    size = np.abs(values)
    known = size[np.isfinite(size)]
    return float(np.median(known)) if known.size else 0.0


def _scatter(differences: _Floats, level: float, name: str) -> float:
    """Return the standard deviation of white noise that has such second differences."""
    known = np.abs(differences[np.isfinite(differences)])
    if known.size < FEWEST_PIXELS:
        raise OvertoneError(
            f"too few pixels to tell the scatter of {name}",
            expected=f"{FEWEST_PIXELS} or more with both neighbours along x",
            got=str(known.size),
        )
    middle = float(np.median(known))
    if middle <= _ROUNDING * level:
        raise OvertoneError(
            f"the scatter of {name} cannot be told, because most neighbouring pixels do not differ",
            expected="a channel that was stored in finer steps than its noise",
            hint=f"another source, or the noise of {name} stated",
        )
    return middle / (_MEDIAN * _GAIN)


def noise_from_bandwidth(
    probe: Probe,
    *,
    bandwidth: float,
    detector_noise: float,
    amplitude: float,
    orders: Sequence[int],
    temperature: float = ROOM_TEMPERATURE,
) -> dict[str, float]:
    """Return the noise that lever and detector leave behind a lock-in.

    Parameters
    ----------
    probe : Probe
        Lever, drive frequency, and how the detector sees each mode.
    bandwidth : float
        Equivalent noise bandwidth B of the lock-in, one-sided [Hz]: pi/2 times the frequency at which a first-order
        low-pass is down by 3 dB, or one over four times its time constant.
    detector_noise : float
        Amplitude density of the white noise of the detector, in the metres that A1 is read in [m/sqrt(Hz)], 0 or more.
        No default: it is what differs between microscopes, and what most of A0 and A2 is made of.
    amplitude : float
        A1 at which phi1 is read [m]: ``sigma(phi1) = sigma(A1)/A1``.
    orders : sequence of int
        Harmonics in use, 0 for the mean.
    temperature : float
        Temperature of the lever [K].

    Returns
    -------
    dict
        Standard deviation of A_n, for n > 0 of each quadrature, and where 1 is among the orders of phi1 [m, rad].

    Raises
    ------
    OvertoneError
        If a number is not finite and positive (the detector's noise: 0 or more), or orders are none.
    ProbeError
        If the temperature makes no sense.

    Notes
    -----
    Source: the spectrum of a harmonic oscillator shaken by white noise, taken as flat over the band of the lock-in.
    Near a resonance that is an upper bound: the motion of a free lever there is ``1 + 2 Q 4 B/w1`` times less in
    variance behind a first-order low-pass, and never more than kB T/k: at 162 kHz and Q 287 the thermal
    part of A1 and phi1 is 1.1 times too large for B = 100 Hz, 1.5 times for 500 Hz. Not in it are drift and
    1/f noise, which A0 has beside, and the errors of feedback and calibration.

    Examples
    --------
    >>> probe = Probe.simple(stiffness=16.4, frequency=162e3, quality_factor=287, radius=10e-9,
    ...                      drive_frequency=162e3, free_amplitude=94e-9)
    >>> noise = noise_from_bandwidth(
    ...     probe, bandwidth=500.0, detector_noise=50e-15, amplitude=40e-9, orders=(0, 1, 2))
    >>> {name: f"{1e12 * sigma:.2f} pm" for name, sigma in noise.items() if name != "phi1"}
    {'A0': '1.12 pm', 'A1': '16.81 pm', 'A2': '1.58 pm'}
    """
    numbers = {"bandwidth": bandwidth, "amplitude": amplitude}
    bad = [f"{name} = {value!r}" for name, value in numbers.items() if not 0.0 < value < math.inf]
    bad += [] if 0.0 <= detector_noise < math.inf else [f"detector_noise = {detector_noise!r}"]
    harmonics = sorted(set(orders))
    bad += [] if harmonics and harmonics[0] >= 0 else [f"orders = {tuple(orders)}"]
    if bad:
        raise OvertoneError(
            "no noise follows from these numbers",
            expected="bandwidth and amplitude > 0, detector_noise >= 0, harmonics 0, 1, 2, ...",
            got=", ".join(bad),
        )
    n = np.array(harmonics)
    thermal = thermal_noise_density(probe, n * probe.drive.frequency, temperature)
    density = np.hypot(thermal, detector_noise)
    sigma = density * np.sqrt(np.where(n == 0, 1.0, 2.0) * bandwidth)
    noise: dict[str, float] = {}
    for order, value in zip(harmonics, sigma, strict=True):
        noise[f"A{order}"] = float(value)
        if order == 1:
            noise["phi1"] = float(value) / amplitude
    return noise
