"""Harmonics of a force on a motion that is no bare cosine: by quadrature of the law along the motion.

The tip also moves in its second and third harmonic, which are measured; eq 10 leaves them out. On

    d(theta) = g + A1 cos theta + Re sum_{n>=2} b_n exp(i n theta),   b_n = A_n exp(i (n phi1 - phi_n))

the law is sampled by Gauss-Legendre pieces that end where the gap crosses zero, smoothed there, and that
grow away from it, since attractions decay over a distance far below the amplitude.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import numpy.typing as npt

_Floats = npt.NDArray[np.float64]
_Complex = npt.NDArray[np.complex128]
Law = Callable[[_Floats, _Floats], _Floats]
"""Force [N] of gap [m] and velocity [m/s], elementwise."""

_CONTACT_NODES, _CONTACT_WEIGHTS = np.polynomial.legendre.leggauss(32)
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(16)
_HALVINGS = 34  # from half a turn down to a gap of 1e-10 of it
_BISECTIONS = 60


def gap_at(theta: _Floats, mean: _Floats, amplitude: _Floats, higher: _Complex) -> tuple[_Floats, _Floats]:
    """Return the gap and its derivative by theta.

    Parameters
    ----------
    theta : array (point, node)
        Phases.
    mean, amplitude : array (point,)
        Mean gap and A1 [m].
    higher : array (point, n - 2)
        b_n of n = 2, 3, ... [m], complex.
    """
    d = mean[:, None] + amplitude[:, None] * np.cos(theta)
    slope = -amplitude[:, None] * np.sin(theta)
    for k in range(higher.shape[1]):
        n = k + 2
        turn = higher[:, k, None] * np.exp(1j * n * theta)
        d, slope = d + turn.real, slope - n * turn.imag
    return d, slope


def harmonics_on_motion(
    law: Law,
    amplitude: _Floats,
    indentation: _Floats,
    higher: _Complex,
    n_max: int,
    frequency: float,
    kinks: tuple[float, ...] = (),
) -> _Complex:
    """Return CONS_n - i DISS_n of a law on a motion with higher harmonics.

    Parameters
    ----------
    law : callable
        Force of gap and velocity, arrays (point, node).
    amplitude, indentation : array (point,)
        A1 and the indentation at theta = pi [m].
    higher : array (point, n - 2)
        b_n of n = 2, 3, ... [m], complex; small against A1.
    n_max : int
        Highest harmonic of the force.
    frequency : float
        Of the motion [Hz], for the velocity.
    kinks : tuple of float
        Gaps other than zero at which the law is not smooth [m].

    Returns
    -------
    array (point, n)
        Harmonics [N].

    Notes
    -----
    Assumes one approach and one retraction a period, the turning point next to theta = pi.
    """
    signs = (-1.0) ** np.arange(2, 2 + higher.shape[1])
    mean = amplitude - indentation - (signs * higher.real).sum(axis=1)
    bottom = np.full(amplitude.shape, math.pi)
    for _ in range(4):
        step = 1e-5
        left = gap_at(bottom[:, None] - step, mean, amplitude, higher)[1][:, 0]
        right = gap_at(bottom[:, None] + step, mean, amplitude, higher)[1][:, 0]
        bottom = bottom - (left + right) * step / np.where(right > left, right - left, np.inf)
    result = np.zeros((amplitude.size, n_max + 1), complex)
    for side in (-1.0, 1.0):
        edges = [bottom]
        far = bottom + side * math.pi
        for level in sorted({0.0, *kinks}):
            edges.append(_crossing(level, edges[-1], far, mean, amplitude, higher))
        contact = edges[1]
        marks = [*edges, far]
        # graded pieces from contact outwards, cut at the kinks
        graded = [contact + (far - contact) * 0.5**k for k in range(_HALVINGS, -1, -1)]
        outside = np.sort(side * np.stack([*marks[1:], *graded], axis=1), axis=1) * side
        ends = np.concatenate([bottom[:, None], outside], axis=1)
        for k in range(ends.shape[1] - 1):
            nodes = (_CONTACT_NODES, _CONTACT_WEIGHTS) if k == 0 else (_NODES, _WEIGHTS)
            result += _piece(
                law, ends[:, k], ends[:, k + 1], nodes, mean, amplitude, higher, n_max, frequency
            )
    result[:, 0] *= 0.5
    return result


def _crossing(
    level: float, inside: _Floats, far: _Floats, mean: _Floats, amplitude: _Floats, higher: _Complex
) -> _Floats:
    """Return the phase between two others where the gap passes a level; an end where it does not."""
    low, high = inside.copy(), far.copy()
    for _ in range(_BISECTIONS):
        middle = 0.5 * (low + high)
        below = gap_at(middle[:, None], mean, amplitude, higher)[0][:, 0] < level
        low, high = np.where(below, middle, low), np.where(below, high, middle)
    return 0.5 * (low + high)


def _piece(
    law: Law,
    start: _Floats,
    stop: _Floats,
    rule: tuple[_Floats, _Floats],
    mean: _Floats,
    amplitude: _Floats,
    higher: _Complex,
    n_max: int,
    frequency: float,
) -> _Complex:
    """Integrate over one piece; theta = end -+ reach s^2 makes both ends smooth."""
    nodes, weights = rule
    s, w = 0.5 * (1.0 + nodes), 0.5 * weights
    reach = 0.5 * (stop - start)[:, None]
    theta = np.concatenate([start[:, None] + reach * s**2, stop[:, None] - reach * s**2], axis=1)
    weight = np.abs(np.concatenate([reach * 2.0 * s * w] * 2, axis=1)) / math.pi
    gap, slope = gap_at(theta, mean, amplitude, higher)
    values = law(gap, 2.0 * math.pi * frequency * slope) * weight
    turn = np.exp(-1j * theta)
    out = np.empty((amplitude.size, n_max + 1), complex)
    power = values.astype(complex)
    for n in range(n_max + 1):
        out[:, n] = power.sum(axis=1)
        power = power * turn
    return out
