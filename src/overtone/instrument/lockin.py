"""A lock-in over recorded samples: turn them back by n times a phase, and average under a Kaiser window.

The window has ``beta`` 18: symmetric, so it delays nothing; positive, so it does not overshoot; and below 1.2e-7
beyond its main lobe, which ends at 4.9 times its noise bandwidth. Everything runs over blocks, so that memory does
not grow with the length of the record.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from overtone.instrument.samples import BLOCK, Trace, blocks

_Floats = npt.NDArray[np.float64]
_Complex = npt.NDArray[np.complex128]

BETA = 18.0
NOISE_WIDTH = 1.2186098
"""One-sided noise bandwidth of the window, times its length."""
HALF_LOBE = math.sqrt(1.0 + (BETA / math.pi) ** 2)
"""Where the main lobe ends, times the length of the window."""
MAIN_LOBE = HALF_LOBE / NOISE_WIDTH
"""The same in units of the noise bandwidth."""
LONGEST_PIECE = 1 << 20
"""Samples of which a spectrum is taken at most."""


class LowPass(NamedTuple):
    """The window that averages."""

    length: int
    step: int
    """Samples from one output to the next."""
    scale: float
    """One over the sum of the window."""
    bandwidth: float
    """Equivalent noise bandwidth, one-sided [Hz]."""


class Phase(NamedTuple):
    """Phase of the drive [rad] over the index k of a sample: a polynomial in ``k - middle``, and a rest."""

    middle: float
    coefficients: tuple[float, float, float]
    rest: Any = None
    """Function of k, None where the polynomial is all."""
    error: float = 0.0
    """Largest standard error over the record, relative to where phi1 was taken as steady [rad]."""

    def at(self, start: int, stop: int) -> _Floats:
        """Return the phase [rad] of the samples from start to stop."""
        index = np.arange(start, stop, dtype=np.float64)
        k = index - self.middle
        c0, c1, c2 = self.coefficients
        theta: _Floats = (c2 * k + c1) * k + c0
        return theta if self.rest is None else theta + self.rest(index)


# --- the window -----------------------------------------------------------------------------------


def kaiser(length: int, start: int = 0, stop: int | None = None) -> _Floats:
    """Return samples start to stop of the window, all unless given: 1 at its middle and 0 outside."""
    x = (2.0 * np.arange(start, length if stop is None else stop) - (length - 1)) / length
    inside = np.abs(x) < 1.0
    return np.where(inside, np.i0(BETA * np.sqrt(np.where(inside, 1.0 - x**2, 0.0))) / np.i0(BETA), 0.0)


def response(offset: float) -> float:
    """Return the response at an offset in units of the noise bandwidth; beyond the main lobe its envelope."""
    square = BETA**2 - (math.pi * NOISE_WIDTH * offset) ** 2
    root = math.sqrt(abs(square))
    wave = 1.0 if offset >= MAIN_LOBE else math.sinh(root) if square > 0.0 else math.sin(root)
    return wave / max(root, 1e-9) * BETA / math.sinh(BETA)


def length_for(rate: float, bandwidth: float) -> int:
    """Return how many samples the window needs for a noise bandwidth [Hz]: an odd number, 3 at least."""
    return 2 * max(round((NOISE_WIDTH * rate / bandwidth - 1.0) / 2.0), 1) + 1


def low_pass(rate: float, length: int, step: int) -> LowPass:
    """Return the window of so many samples, moved on by ``step`` from one output to the next."""
    total = squares = 0.0
    for start, stop in blocks(0, length):
        window = kaiser(length, start, stop)
        total, squares = total + float(window.sum()), squares + float((window**2).sum())
    return LowPass(length, step, 1.0 / total, 0.5 * rate * squares / total**2)


# --- the average ----------------------------------------------------------------------------------


def averages(
    trace: Trace,
    phase: Phase,
    orders: Sequence[int],
    window: LowPass,
    first: int,
    last: int,
    progress: Callable[[int, int], None] | None = None,
) -> tuple[_Complex, _Floats]:
    """Return ``<q exp(-i n theta)>`` over the samples from first to last.

    Parameters
    ----------
    trace : Trace
        One signal, or several along leading dimensions.
    phase : Phase
        theta [rad].
    orders : sequence of int
        n, in rising order.
    window : LowPass
        What averages.
    first, last : int
        No output reaches beyond these samples.
    progress : callable, optional
        Called with (samples done, samples in all).

    Returns
    -------
    averages : complex array (order, ..., output)
        In the unit of the trace.
    centres : array (output,)
        Middle of each window, in samples.

    Notes
    -----
    The trace is cut into segments of ``step`` samples. A window covers a few of them, so each segment is weighted
    with the window as far as it reaches into it, once for every window it lies in: one product of matrices.
    """
    length, step = window.length, window.step
    leading = trace.values.shape[:-1]
    count = (last - first - length) // step + 1 if last - first >= length else 0
    out: _Complex = np.zeros((len(orders), *leading, count), dtype=np.complex128)
    segments = count + -(-length // step) - 1 if count else 0
    block = max(BLOCK // max(math.prod(leading), 1), 1)
    # few enough segments for the products, one for each window that a segment lies in, to stay small as well
    rows, done = max(1, min(block // step, 8 * block * step // length)), 0
    for part in range(0, step, block):  # one part, unless a segment is longer than a block
        stop = min(part + block, step)
        weights = _weights(window, part, stop)
        for segment in range(0, segments, rows):
            height = min(rows, segments - segment)
            start = first + segment * step + part
            size = height * (stop - part)
            q = np.zeros((*leading, size))
            recorded = trace.values[..., start : start + size]  # beyond the last output it has no weight
            q[..., : recorded.shape[-1]] = recorded
            _add_products(out, q, phase.at(start, start + size), orders, weights, segment, height)
            done += size
            if progress is not None:
                progress(min(done, last - first), last - first)
    centres: _Floats = np.arange(count, dtype=np.float64) * step + (first + 0.5 * (length - 1))
    return out, centres


def _weights(window: LowPass, start: int, stop: int) -> _Floats:
    """Return the window over samples start to stop of each segment (sample, segment of the window)."""
    begins = range(0, window.length, window.step)
    return np.stack([kaiser(window.length, k + start, k + stop) for k in begins], axis=1) * window.scale


def _add_products(
    out: _Complex,
    q: _Floats,
    theta: _Floats,
    orders: Sequence[int],
    weights: _Floats,
    segment: int,
    height: int,
) -> None:
    """Add what ``height`` segments, from one on, give to the outputs whose windows they lie in."""
    shape = (*q.shape[:-1], height, weights.shape[0])
    cosine, sine = np.cos(theta), np.sin(theta)
    c, s = np.ones_like(theta), np.zeros_like(theta)
    reached = 0
    for i, n in enumerate(orders):
        for _ in range(n - reached):
            c, s = c * cosine - s * sine, s * cosine + c * sine
        reached = n
        products = (q * c).reshape(shape) @ weights
        if n:
            products = products - 1j * ((q * s).reshape(shape) @ weights)
        for k in range(weights.shape[1]):
            low, high = max(segment - k, 0), min(segment + height - k, out.shape[-1])
            if high > low:
                out[i, ..., low:high] += products[..., low + k - segment : high + k - segment, k]


# --- noise ----------------------------------------------------------------------------------------


def noise_beside(
    trace: Trace,
    phase: Phase,
    orders: Sequence[int],
    frequency: float,
    window: LowPass,
    samples: tuple[int, int],
    *,
    followed: bool,
) -> dict[int, float]:
    """Return the standard deviation of each A_n that the floor beside its line makes in the bandwidth.

    Parameters
    ----------
    trace : Trace
        One signal.
    phase : Phase
        theta [rad].
    orders : sequence of int
        n.
    frequency : float
        Of the drive [Hz]: half of it is as far as "beside" goes.
    window : LowPass
        What averages.
    samples : (first, last)
        Samples that count.
    followed : bool
        Whether the phase is that of the first harmonic itself, which takes the noise out of one of its directions.

    Notes
    -----
    A median over pieces of the trace, then over frequencies beside the harmonic, so that neither moments in which
    the motion changes count nor lines of other origin.
    """
    rate, bandwidth = trace.rate, window.bandwidth
    first, last = samples
    length = min(last - first, LONGEST_PIECE, max(4 * window.length, math.ceil(64.0 * rate / frequency)))
    taper = kaiser(length)
    edge = HALF_LOBE * rate / length  # of a line, with this window
    high = 0.5 * frequency
    low = min(max(3.0 * bandwidth, bandwidth + 1.2 * edge), 0.6 * high)
    high = min(high, max(5.0 * low, low + 20.0 * rate / length))
    offset = np.fft.fftfreq(length, 1.0 / rate)
    one_side = (offset >= low) & (offset <= high)
    both_sides = (np.abs(offset) >= low) & (np.abs(offset) <= high)
    # an odd number of pieces: their median has no bias
    pieces = (max(1, min(48, (last - first) // length)) - 1) // 2 * 2 + 1
    power: dict[int, list[_Floats]] = {n: [] for n in orders}
    for start in np.linspace(first, last - length, pieces).astype(int):
        q = np.asarray(trace.values[start : start + length], dtype=np.float64) * taper
        theta = phase.at(int(start), int(start) + length)
        for n in orders:
            turned = q * np.exp(-1j * n * theta)
            if n == 1 and followed:
                turned = turned.real * math.sqrt(2.0)
            power[n].append(np.abs(np.fft.fft(turned)[both_sides if n else one_side]) ** 2)
    sigma: dict[int, float] = {}
    for n in orders:
        # such powers are distributed exponentially, whose median is ln 2 of the mean
        floor = float(np.median(np.median(power[n], axis=0))) / math.log(2.0)
        density = 2.0 * floor / (rate * float((taper**2).sum()))  # one-sided
        sigma[n] = math.sqrt((2.0 if n else 1.0) * density * bandwidth)
    return sigma
