"""Noise of the observables: stated as one number an observable, added to simulations, carried to forces."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
import numpy.typing as npt
import xarray as xr

from overtone.errors import OvertoneError
from overtone.instrument.signals import in_the_frame_of_the_first, signals_of
from overtone.quantities import harmonic_orders, quantity, validate_observables

ORDINARY_NOISE: Mapping[str, float] = {
    "A0": 5e-12,
    "A1": 20e-12,
    "phi1": np.deg2rad(0.1),
    "A2": 1e-12,
    "A3": 1e-12,
}
"""Standard deviations of an ordinary scan [m, rad], used where none are stated; higher amplitudes as A3."""
_FEWEST_PAIRS = 100


def complete_noise(noise: Mapping[str, float] | None, orders: tuple[int, ...]) -> dict[str, float]:
    """Return the standard deviation of every observable of these harmonics.

    Parameters
    ----------
    noise : mapping, optional
        Observable to standard deviation [m or rad]. What is not named takes `ORDINARY_NOISE`. The phases
        of higher harmonics need none: a phasor's noise is the same in both directions.
    orders : tuple of int
        Harmonics in use.

    Raises
    ------
    OvertoneError
        If a name is not an observable or a value is negative.

    Examples
    --------
    >>> complete_noise({"A0": 1e-12}, (0, 1, 2))["A0"]
    1e-12
    """
    stated = dict(noise or {})
    for name, sigma in stated.items():
        record = quantity(name)
        if record is None or not record.symbol.startswith(("A_", "phi_")) or not 0.0 <= sigma < math.inf:
            raise OvertoneError(
                "noise is not stated in a usable way",
                expected="observables such as A0, A1, phi1, A2 with standard deviations >= 0",
                got=f"{name} = {sigma}",
                hint='noise={"A0": 5e-12, "phi1": 2e-3, "A2": 1e-12}',
            )
    names = [name for n in orders for name in ([f"A{n}", "phi1"] if n == 1 else [f"A{n}"])]
    return {name: stated.get(name, ORDINARY_NOISE.get(name, ORDINARY_NOISE["A3"])) for name in names} | {
        name: sigma for name, sigma in stated.items() if name.startswith("phi") and name != "phi1"
    }


def add_noise(observables: xr.Dataset, noise: Mapping[str, float] | None = None, *, seed: int) -> xr.Dataset:
    """Return observables with Gaussian noise, as a lock-in without drift would record them.

    Parameters
    ----------
    observables : Dataset
        Noise-free observables, any dimensions.
    noise : mapping, optional
        As in `complete_noise`.
    seed : int
        Seed of the generator.

    Returns
    -------
    Dataset
        A copy. A0, A1 and phi1 take independent errors; of higher harmonics the phasor does, in both
        directions, so that amplitude and phase stay consistent where the signal is lost in noise.
    """
    generator = np.random.default_rng(seed)
    orders = harmonic_orders(observables)
    sigma = complete_noise(noise, orders)
    noisy = observables.copy()

    def error(like: xr.DataArray, scale: float) -> npt.NDArray[np.float64]:
        return generator.normal(0.0, scale, like.shape)

    for n in orders:
        amplitude = observables[f"A{n}"]
        if n == 0:
            noisy["A0"] = amplitude + error(amplitude, sigma["A0"])
        elif n == 1:
            noisy["A1"] = amplitude + error(amplitude, sigma["A1"])
            noisy["phi1"] = observables["phi1"] + error(amplitude, sigma["phi1"])
        else:
            phasor = amplitude.values * np.exp(-1j * observables[f"phi{n}"].values)
            spread = sigma[f"A{n}"]
            phasor = phasor + error(amplitude, spread) + 1j * error(amplitude, spread)
            noisy[f"A{n}"] = amplitude.copy(data=np.abs(phasor))
            noisy[f"phi{n}"] = observables[f"phi{n}"].copy(data=np.mod(-np.angle(phasor), 2 * np.pi))
    for name in noisy.data_vars:
        noisy[name].attrs = dict(observables[name].attrs)
    return noisy


def noise_from_pair(trace: xr.Dataset, retrace: xr.Dataset) -> dict[str, float]:
    """Return the noise of a scan from how trace and retrace of the same lines differ.

    Parameters
    ----------
    trace, retrace : Dataset
        Observables of the same pixels, (y, x), in the same order along x.

    Returns
    -------
    dict
        Standard deviation of one reading of A0, A1, phi1 and of each quadrature of higher harmonics [m, rad], for
        `complete_noise`.

    Raises
    ------
    OvertoneError
        If one of them is no dataset of observables, the two have other pixels, or fewer than 100 are in both.

    Notes
    -----
    From medians, so that edges, where a lag of feedback or filter shows, do not count. What both ways share, drift from
    line to line and every calibration error, is not in it. A filter slower than a pixel makes neighbours alike, not the
    two ways.
    """
    for observables in (trace, retrace):
        validate_observables(observables)
    if trace["A1"].shape != retrace["A1"].shape:
        raise OvertoneError(
            "trace and retrace do not fit", expected=str(trace["A1"].shape), got=str(retrace["A1"].shape)
        )
    there, back = signals_of(trace), signals_of(retrace)

    def spread(difference: npt.NDArray[np.float64]) -> float:
        known = difference[np.isfinite(difference)]
        if known.size < _FEWEST_PAIRS:
            raise OvertoneError(
                "too few pixels in trace and retrace",
                expected=f"{_FEWEST_PAIRS} or more",
                got=str(known.size),
            )
        return float(1.4826 * np.median(np.abs(known - np.median(known))) / math.sqrt(2.0))

    noise = {"A1": spread(np.abs(there.phasor[1]) - np.abs(back.phasor[1]))}
    with np.errstate(invalid="ignore", divide="ignore"):  # lost pixels
        first = there.phasor[1] / back.phasor[1]
        first = first / np.abs(first)
    between = np.nanmean(first)  # the two ways may have another mean, anywhere on the circle
    noise["phi1"] = spread(np.angle(first * np.conj(between)))
    if there.mean is not None and back.mean is not None:
        noise["A0"] = spread(there.mean - back.mean)
    frames = in_the_frame_of_the_first(there), in_the_frame_of_the_first(back)
    for n in sorted(set(frames[0]) & set(frames[1])):
        off = frames[0][n] - frames[1][n]
        noise[f"A{n}"] = math.sqrt(0.5 * (spread(off.real) ** 2 + spread(off.imag) ** 2))
    return noise
