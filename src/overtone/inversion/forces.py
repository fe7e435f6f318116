"""What is measured of a pixel, as an inversion needs it: force harmonics in rows, and the covariance of their errors.

The same force harmonics as `overtone.to_force_harmonics` has them, for blocks of pixels, with the change of each by
every independent error. They are counted from the phase of the tip, which under a shaken base is not quite that of the
reading; conservative harmonics and, where asked for, dissipative ones are the rows.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import xarray as xr

from overtone.dynamics.system import setup
from overtone.harmonics import far_phase
from overtone.kernels import kernel
from overtone.probe import Probe

_Floats = npt.NDArray[np.float64]
_Complex = npt.NDArray[np.complex128]

_LEAST_SHARE = 1e-10  # of the variances, and
_LEAST_FORCE = 1e-9  # of each force: observables stated as free of noise cannot make the covariance singular


class Rows(NamedTuple):
    """Which force harmonics an inversion uses."""

    orders: npt.NDArray[np.int64]
    """(row,)."""
    lossy: npt.NDArray[np.bool_]
    """(row,): True for DISS_n, False for CONS_n."""
    harmonics: npt.NDArray[np.int64]
    """(row,): where the order stands among the harmonics that were measured."""


class Reader(NamedTuple):
    """What turns readings of a probe into forces."""

    orders: npt.NDArray[np.int64]
    """(harmonic,)."""
    stiffness: _Complex
    """(harmonic,): 1/G_read [N/m]."""
    free: complex
    """A1far exp(-i phi_far) [m]."""
    reading: _Complex
    """(2,): reading of the first harmonic per motion of the tip, and what the drive adds to it per A1far [m]."""
    sigma: _Floats
    """(2, harmonic): standard deviations of amplitude and phase; a phase of NaN follows from the amplitude."""


def rows_of(cons: tuple[int, ...], diss: tuple[int, ...]) -> tuple[Rows, tuple[int, ...]]:
    """Return the rows of conservative and dissipative harmonics, and the orders that they need measured."""
    orders = tuple(sorted({*cons, *diss, 1}))
    chosen = [*cons, *diss]
    return (
        Rows(
            np.array(chosen, np.int64),
            np.array([False] * len(cons) + [True] * len(diss)),
            np.array([orders.index(n) for n in chosen], np.int64),
        ),
        orders,
    )


def reader_of(probe: Probe, orders: tuple[int, ...], sigma: Mapping[str, float]) -> Reader:
    """Return what turns readings of these harmonics into forces."""
    device = setup(probe, max(orders))
    free = probe.drive.free_amplitude * np.exp(-1j * far_phase(probe))
    amplitude = [sigma[f"A{n}"] for n in orders]
    phase = [sigma["phi1"] if n == 1 else sigma.get(f"phi{n}", math.nan) for n in orders]
    # the drive of a state with free reading free exp(i phi1) is that share of the one that `Lever` counts with
    share = device.lever.reading[1] / device.drive.reading
    return Reader(
        np.array(orders, np.int64),
        1.0 / device.receptance.read[list(orders)],
        complex(free),
        np.array([device.lever.reading[0], share]),
        np.array([amplitude, phase]),
    )


def readings_of(observables: xr.Dataset, orders: tuple[int, ...]) -> tuple[list[_Floats], list[_Floats]]:
    """Return amplitudes and phases of harmonics, flat on the dimensions of A1; zeros for the phase of the mean."""
    like = observables["A1"]

    def flat(name: str) -> _Floats:
        array = observables[name]
        if array.dims != like.dims:
            array = array.broadcast_like(like).transpose(*like.dims)
        return np.asarray(array.values).reshape(-1)

    amplitudes = [flat(f"A{n}") for n in orders]
    phases = [flat(f"phi{n}") if n else np.broadcast_to(0.0, like.size) for n in orders]
    return amplitudes, phases


@kernel
def force_block(
    amplitude: _Floats,
    phase: _Floats,
    reader: Reader,
    f: _Complex,
    errors: _Complex,
    tip_amplitude: _Floats,
    turn: _Complex,
) -> None:
    """Fill force harmonics and their errors for every pixel.

    Parameters
    ----------
    amplitude, phase : array (pixel, harmonic)
        Readings [m, rad].
    reader : Reader
        Of the probe.
    f : array (pixel, harmonic)
        Filled: CONS_n - i DISS_n in the phase of the tip [N].
    errors : array (pixel, harmonic, source)
        Filled: change of f_n by one standard deviation of each independent error: phi1, every amplitude, every other
        phase. The phase of the first harmonic is one source for all of them, because it turns every one.
    tip_amplitude : array (pixel,)
        Filled: amplitude of the tip [m].
    turn : array (pixel,)
        Filled: what turns f_1 from the phase of the reading into that of the tip.
    """
    count = reader.orders.shape[0]
    errors[:] = 0.0
    for i in range(amplitude.shape[0]):
        first = 0.0
        angle = 0.0
        for h in range(count):
            if reader.orders[h] == 1:
                first, angle = amplitude[i, h], phase[i, h]
        free = reader.free * complex(math.cos(angle), math.sin(angle))
        motion = (first - reader.reading[1] * free) / reader.reading[0]
        tip_amplitude[i] = abs(motion)
        turn[i] = motion.conjugate() / abs(motion) if abs(motion) > 0.0 else complex(1.0, 0.0)
        for h in range(count):
            n, k = reader.orders[h], reader.stiffness[h]
            sigma = reader.sigma[0, h]
            frame = k
            for _ in range(n):
                frame *= turn[i]
            if n == 0:
                f[i, h] = amplitude[i, h] * k
                errors[i, h, 1 + h] = sigma * k
            elif n == 1:
                f[i, h] = (first - free) * frame
                errors[i, h, 1 + h] = sigma * frame
                errors[i, h, 0] = reader.sigma[1, h] * (-1j) * free * frame
            else:
                lag = n * angle - phase[i, h]
                unit = complex(math.cos(lag), math.sin(lag)) * frame
                f[i, h] = amplitude[i, h] * unit
                errors[i, h, 1 + h] = sigma * unit
                across = reader.sigma[1, h] * amplitude[i, h]
                if not across >= 0.0:
                    across = sigma
                errors[i, h, 1 + count + h] = -1j * across * unit
    for h in range(count):
        if reader.orders[h] == 1:
            scale = reader.sigma[1, h]
            for g in range(count):
                if reader.orders[g] > 1:
                    for i in range(amplitude.shape[0]):
                        errors[i, g, 0] = scale * 1j * reader.orders[g] * f[i, g]


@kernel
def row_block(
    f: _Complex,
    errors: _Complex,
    rows: Rows,
    y: _Floats,
    whitening: _Floats,
    usable: npt.NDArray[np.bool_],
) -> None:
    """Fill the rows of every pixel, and the matrix that turns their errors into independent ones of variance 1.

    Parameters
    ----------
    f, errors : array (pixel, harmonic), (pixel, harmonic, source)
        Force harmonics and their errors.
    rows : Rows
        Which of them.
    y : array (pixel, row)
        Filled [N].
    whitening : array (pixel, row, row)
        Filled: inverse of the lower Cholesky factor of the covariance [1/N].
    usable : array (pixel,)
        Filled: False where a force is not a number or all of them vanish.
    """
    count, sources = rows.orders.shape[0], errors.shape[2]
    part = np.empty((count, sources))
    L, C = np.empty((count, count)), np.empty((count, count))
    for i in range(f.shape[0]):
        usable[i] = True
        size = 0.0
        for r in range(count):
            h = rows.harmonics[r]
            y[i, r] = -f[i, h].imag if rows.lossy[r] else f[i, h].real
            size += abs(y[i, r])
            for s in range(sources):
                part[r, s] = -errors[i, h, s].imag if rows.lossy[r] else errors[i, h, s].real
        trace = 0.0
        for r in range(count):
            for q in range(r + 1):
                total = 0.0
                for s in range(sources):
                    total += part[r, s] * part[q, s]
                C[r, q] = total
            trace += C[r, r]
        usable[i] = math.isfinite(size) and size > 0.0 and math.isfinite(trace)
        if not usable[i]:
            continue
        for r in range(count):
            C[r, r] += (
                _LEAST_SHARE * trace + (_LEAST_FORCE * y[i, r]) ** 2 + (1e-3 * _LEAST_FORCE * size) ** 2
            )
            for q in range(r + 1):
                total = C[r, q]
                for k in range(q):
                    total -= L[r, k] * L[q, k]
                L[r, q] = math.sqrt(max(total, 1e-300)) if r == q else total / L[q, q]
        for r in range(count):
            for q in range(count):
                whitening[i, r, q] = 0.0
            whitening[i, r, r] = 1.0 / L[r, r]
            for q in range(r):
                total = 0.0
                for k in range(q, r):
                    total += L[r, k] * whitening[i, k, q]
                whitening[i, r, q] = -total / L[r, r]
