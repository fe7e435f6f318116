"""The motion at a given amplitude and indentation, whatever drives it: the forward half of an inversion.

Harmonic balance without the balance of the first harmonic: with the amplitude and the closest gap held, the force
follows, and with it the higher harmonics of the motion and what drive the state would need. What is measured of the
drive then stands against that, instead of deciding the state.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from overtone.contact.sample import Sample
from overtone.dynamics.balance import (
    EXTRAS,
    FOUND,
    NOT_CONVERGED,
    Motion,
    Sums,
    bottom,
    force_on_motion,
    gap_at,
)
from overtone.dynamics.system import Laws, law_at, laws, setup
from overtone.kernels import kernel
from overtone.probe import Probe

_ITERATIONS = 60
_TOLERANCE = 1e-10  # of the amplitude
_PASSES = 30
_SEEN = 1e-10  # of the amplitude that is read

_Floats = npt.NDArray[np.float64]
_Complex = npt.NDArray[np.complex128]


class Indented(NamedTuple):
    """Motions at given amplitudes and indentations, flat."""

    force: _Complex
    """(point, harmonic): CONS_n - i DISS_n, counted from the phase of the first harmonic as it is read [N]."""
    reading: _Complex
    """(point, harmonic): what the detector reads in that frame [m]; of the first harmonic, the amplitude."""
    height: _Floats
    """(point,): Z of the base [m]."""
    drive: _Complex
    """(point,): equivalent drive force that the state needs, in the same frame [N]."""
    status: npt.NDArray[np.int8]
    """(point,): FOUND or NOT_CONVERGED, as `overtone.dynamics.balance` has them."""


@kernel
def indented_block(
    amplitude: _Floats,
    closest: _Floats,
    tip: _Complex,
    omega: float,
    laws: Laws,
    same_law: bool,
    f: _Complex,
    mean: _Floats,
    status: npt.NDArray[np.int8],
) -> None:
    """Fill the force on the motion of every point, by substitution of its higher harmonics."""
    orders = f.shape[1]
    none = np.empty(0, np.complex128)
    extras, turns, b = np.empty(EXTRAS), np.empty(orders, np.complex128), np.empty(orders, np.complex128)
    for i in range(amplitude.shape[0]):
        A, law = amplitude[i], law_at(laws, 0 if same_law else i)
        g = closest[i] + A
        b[:] = 0.0
        status[i] = NOT_CONVERGED
        share, before = 1.0, math.inf
        for _ in range(_ITERATIONS):
            force_on_motion(Motion(g, A, b), omega, law, Sums(f[i], none, none, extras, turns))
            change = 0.0
            for n in range(2, orders):
                step = tip[n] * f[i, n] - b[n]
                change = max(change, abs(step))
                b[n] += share * step
            # the closest gap is held, whatever the harmonics add to it
            g += closest[i] - gap_at(bottom(Motion(g, A, b)), Motion(g, A, b))[0]
            if not math.isfinite(change):
                break
            if change < _TOLERANCE * A:
                status[i] = FOUND
                break
            if change > 0.7 * before:
                share = max(0.5 * share, 0.05)
            before = change
        mean[i] = g


def indented_states(
    probe: Probe, sample: Sample, *, amplitude: Any, indentation: Any, n_max: int = 10
) -> Indented:
    """Return the motion at given amplitudes and indentations.

    Parameters
    ----------
    probe : Probe
        Any number of modes; its free amplitude does not count, its drive frequency does.
    sample : Sample
        One material, or one a point.
    amplitude : array (point,)
        A1 as the detector reads it [m].
    indentation : array (point,)
        delta_max on the full motion [m], negative out of contact.
    n_max : int
        Harmonics of the motion.

    Returns
    -------
    Indented
        Harmonics 0 .. n_max.

    Notes
    -----
    Under a drive that shakes the base, what is read differs from the motion of the tip by a share of the drive that
    the state needs. The amplitude of the tip follows from that by substitution: a pass or two at a high quality
    factor, more at a low one.
    """
    device, records = setup(probe, n_max), laws(probe, sample)
    A1, delta = (
        np.ascontiguousarray(v, dtype=float).ravel() for v in np.broadcast_arrays(amplitude, indentation)
    )
    lever, read = device.lever, device.receptance.read
    one = records.table.shape[0] == 1
    f = np.zeros((A1.size, n_max + 1), complex)
    mean, status = np.full(A1.size, math.nan), np.zeros(A1.size, np.int8)
    tip_amplitude = A1 / abs(lever.reading[0])
    for _ in range(_PASSES):
        indented_block(tip_amplitude, -delta, lever.tip, lever.omega, records, one, f, mean, status)
        needed = tip_amplitude / lever.tip[1] - f[:, 1]
        seen = lever.reading[0] * tip_amplitude + lever.reading[1] * needed / lever.force
        off = A1 / np.abs(seen)
        if not (np.abs(off - 1.0) > _SEEN).any():
            break
        tip_amplitude = tip_amplitude * off
    else:
        status[np.abs(off - 1.0) > _SEEN] = NOT_CONVERGED
    turn = np.exp(-1j * np.angle(seen)[:, None] * np.arange(n_max + 1))
    force = f * turn
    reading = read * force
    reading[:, 1] = A1
    return Indented(force, reading, mean - lever.tip[0].real * f[:, 0].real, needed * turn[:, 1], status)
