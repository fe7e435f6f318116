"""Averaged periodograms: their likelihood, what scatters in them, and what windows do to a resonance.

A bin of a spectrum that was averaged n times follows a gamma distribution of shape n about the mean S:
minus its log-likelihood is ``n (P/S + ln S)`` (Whittle), whatever the length of the trace. Windows make
neighbouring bins alike, which leaves the estimate where it is and widens its error.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import numpy.typing as npt

from overtone.errors import ObservablesError

_Array = npt.NDArray[np.float64]
_Model = Callable[[_Array], _Array]

_LAGS = 3  # bins over which windows correlate their neighbours


def _loss(model: _Array, P: _Array) -> float:
    """Return minus the log-likelihood of one average, without the terms that do not depend on the model."""
    if not (np.isfinite(model).all() and (model > 0.0).all()):
        return math.inf
    return float(np.sum(P / model + np.log(model)))


def log_slopes(model: _Model, theta: _Array, free: npt.NDArray[np.bool_] | None = None) -> _Array:
    """Return d ln S / d theta, shape (bins, parameters)."""
    columns = []
    for k in range(theta.size) if free is None else np.flatnonzero(free):
        # ln f1 is known far better than the width of the peak, so its step must be far smaller than 1/Q.
        step = 1e-4 * math.exp(-max(theta[1], 0.0)) if k == 0 and theta.size > 2 else 1e-4
        up, down = theta.copy(), theta.copy()
        up[k] += step
        down[k] -= step
        columns.append((np.log(model(up)) - np.log(model(down))) / (2.0 * step))
    return np.stack(columns, axis=-1)


def maximise(model: _Model, start: _Array, P: _Array) -> tuple[_Array, float]:
    """Return the parameters of the largest likelihood, by damped Fisher scoring, and their loss."""
    theta = np.array(start, dtype=float)
    theta[~np.isfinite(theta)] = -700.0
    loss, damping = _loss(model(theta), P), 1e-2
    for _ in range(100):
        slopes = log_slopes(model, theta)
        gradient = slopes.T @ (P / model(theta) - 1.0)
        fisher = slopes.T @ slopes
        diagonal = np.diag(fisher) + 1e-12 * np.trace(fisher) + 1e-300
        moved = False
        while damping < 1e8:
            change = np.linalg.solve(fisher + np.diag(damping * diagonal), gradient)
            change = np.clip(change, -1.5, 1.5)
            trial = theta + change
            if theta.size > 2:
                trial[1] = max(trial[1], math.log(0.51))  # an overdamped lever has no resonance
            trial[-1] = max(trial[-1], -600.0)
            with np.errstate(over="ignore"):
                lower = _loss(model(trial), P)
            if lower < loss:
                gained, theta, loss, damping, moved = (
                    loss - lower,
                    trial,
                    lower,
                    max(damping / 5.0, 1e-9),
                    True,
                )
                break
            damping *= 4.0
        if not moved or gained < 1e-9 * P.size**0.5:
            break
    return theta, loss


def covariance_of(slopes: _Array, averages: float, shared: _Array) -> _Array:
    """Return the covariance of the estimate: Fisher's, widened by the correlation of neighbouring bins."""
    fisher = averages * slopes.T @ slopes
    score = fisher.copy()
    for lag, correlation in enumerate(shared, start=1):
        both = averages * slopes[lag:].T @ slopes[:-lag]
        score += correlation * (both + both.T)
    inverse = np.linalg.pinv(fisher, hermitian=True)
    return np.asarray(inverse @ score @ inverse)


def correlation_of_bins(residual: _Array, window: str | None = None) -> _Array:
    """Return the correlation of bins 1, 2 and 3 apart: that of a known window, or else as the residuals have it.

    It is never negative, which no window makes it.
    """
    if window is not None:
        from scipy import fft

        squared = _taper(window, 256) ** 2
        return np.asarray(np.abs(fft.rfft(squared)[1 : _LAGS + 1] / squared.sum()) ** 2)
    power = float(np.mean(residual**2)) or 1.0
    return np.array(
        [max(float(np.mean(residual[lag:] * residual[:-lag])) / power, 0.0) for lag in range(1, _LAGS + 1)]
    )


def averages_of(ratio: _Array) -> float:
    """Return how many averages the scatter of bins over their model is worth.

    From differences of logarithms a few bins apart, which neither the correlation of neighbours nor a
    model that is smoothly wrong enters: their variance is twice the trigamma function of the number.
    """
    from scipy import optimize, special

    logarithm = np.log(ratio[ratio > 0.0])
    lag = _LAGS + 2
    if logarithm.size < 2 * lag:
        return 1.0
    variance = 0.5 * float(np.mean((logarithm[lag:] - logarithm[:-lag]) ** 2))
    low, high = 0.5, 1e7
    if variance >= float(special.polygamma(1, low)):
        return low
    if variance <= float(special.polygamma(1, high)):
        return high
    return float(optimize.brentq(lambda n: float(special.polygamma(1, n)) - variance, low, high))


def windowed_resonance(f: _Array, window: str, step: float) -> Callable[[float, float], _Array]:
    """Return what gives the mean periodogram of a resonance under a window, integral 1.

    It is the Fourier transform of the autocovariance of the motion times that of the window (the expected
    periodogram of Sykulski et al., Biometrika 106 (2019) 251), with segments of one over the width of a bin.
    """
    from scipy import fft

    bins = np.rint(f / step).astype(int)
    if np.abs(f / step - bins).max() > 0.01:
        raise ObservablesError(
            "the window cannot be allowed for",
            expected="bins at whole multiples of their width",
            got=f"{f[0]:.8g} Hz in steps of {step:.8g} Hz",
            hint='window="" fits without',
        )
    # Sampled well above the last bin, so that nothing folds back; the kernel does not depend on it.
    points = int(fft.next_fast_len(4 * int(bins[-1]) + 4, real=True))
    taper = _taper(window, points)
    overlap = fft.irfft(np.abs(fft.rfft(taper, 2 * points)) ** 2, 2 * points)[:points] / np.sum(taper**2)
    rate = points * step
    time = np.arange(points) / rate

    def shape(resonance: float, quality: float) -> _Array:
        omega = 2.0 * np.pi * resonance
        root = math.sqrt(max(1.0 - 0.25 / quality**2, 1e-9))
        phase = omega * root * time
        decay = np.exp(-0.5 * omega / quality * time)
        covariance = decay * (np.cos(phase) + np.sin(phase) / (2.0 * quality * root))
        two_sided = 2.0 * fft.rfft(covariance * overlap).real - 1.0
        # Folding may leave rounding below zero far out, where the floor is all there is.
        return np.asarray(np.maximum(2.0 / rate * two_sided[bins], 0.0))

    return shape


def _taper(window: str, points: int) -> _Array:
    from scipy import signal

    try:
        return np.asarray(signal.get_window(window, points), dtype=float)
    except (ValueError, TypeError) as error:
        raise ObservablesError(
            "unknown window", expected="a name such as hann or boxcar", got=repr(window)
        ) from error
