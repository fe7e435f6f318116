"""Integrals over curves between points: half-integrals with their singularity, and cycles of a motion.

Between points every quantity is a cubic, and each integral is taken segment by segment in a variable in which it
is smooth. Neither the inverse square root of the inversion nor a kink of the force at a point costs accuracy.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from overtone.kernels import inner, kernel

_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(4)

_Floats = npt.NDArray[np.float64]


def cubics(t: _Floats, y: _Floats, hole: npt.NDArray[np.bool_]) -> _Floats:
    """Return cubics through all points, a row of coefficients of ``t - t_j`` for each of the segments.

    Slopes are those of the parabola through three points; a hole is crossed on a straight line, and the slopes
    on its two sides know nothing of each other.
    """
    h = np.diff(t)
    secant = np.diff(y) / h
    slope = np.empty_like(y)
    weight = h[:-1] / (h[:-1] + h[1:])
    slope[1:-1] = (1.0 - weight) * secant[:-1] + weight * secant[1:]
    slope[0], slope[-1] = secant[0], secant[-1]
    alone = np.concatenate([[True], hole, [True]])  # no neighbour on the far side of a hole
    left, right = alone[:-2], alone[2:]
    # the parabola of the neighbour goes on to the end: m_0 = 2 secant - m_1
    start, end = slope[:-1].copy(), slope[1:].copy()
    start[left & ~right] = (2.0 * secant - slope[1:])[left & ~right]
    end[right & ~left] = (2.0 * secant - slope[:-1])[right & ~left]
    single = (left & right) | hole
    start[single], end[single] = secant[single], secant[single]
    return np.stack(
        [y[:-1], start, (3.0 * secant - 2.0 * start - end) / h, (start + end - 2.0 * secant) / h**2], axis=1
    )


@kernel
def half_integrals(t: _Floats, W: _Floats, u: _Floats, y: _Floats, result: _Floats) -> None:
    """Fill ``int [W + u / (8 sqrt(pi (t - t_i))) - y' / sqrt(2 (t - t_i))] dt`` from each point to the last.

    With ``t - t_i = v^2`` the integrand on a segment is a polynomial of degree 7 in v, which four nodes of
    Gauss integrate exactly: the singularity costs nothing.
    """
    last = t.shape[0] - 1
    for i in range(t.shape[0]):
        total, v_low = 0.0, 0.0
        for j in range(i, last):
            v_high = math.sqrt(t[j + 1] - t[i])
            width = (t[j + 1] - t[j]) / (v_high + v_low)
            part = 0.0
            for k in range(_NODES.shape[0]):
                step = 0.5 * width * (1.0 + _NODES[k])
                v = v_low + step
                x = step * (v_low + v)
                value = (W[j, 0] + x * (W[j, 1] + x * (W[j, 2] + x * W[j, 3]))) * v
                value += (u[j, 0] + x * (u[j, 1] + x * (u[j, 2] + x * u[j, 3]))) / (8.0 * math.sqrt(math.pi))
                value -= (y[j, 1] + x * (2.0 * y[j, 2] + x * 3.0 * y[j, 3])) / math.sqrt(2.0)
                part += _WEIGHTS[k] * value
            total += width * part
            v_low = v_high
        result[i] = total


@inner
def _place(psi: float, base: float, amplitude: float, b: _Floats) -> tuple[float, float]:
    """Return the gap and its slope at ``psi = theta - pi``: ``base - A cos psi + sum b_n cos n psi``."""
    c = math.cos(psi)
    s = math.sin(psi)
    d, slope = base - amplitude * c, amplitude * s
    cn, sn = c, s
    for n in range(2, b.shape[0]):
        cn, sn = cn * c - sn * s, sn * c + cn * s
        d += b[n] * cn
        slope -= n * b[n] * sn
    return d, slope


@inner
def _reached(level: float, low: float, guess: float, base: float, amplitude: float, b: _Floats) -> float:
    """Return the psi between ``low`` and pi at which the gap reaches a level, pi where it does not."""
    high = math.pi
    if _place(high, base, amplitude, b)[0] <= level:
        return high
    psi = min(max(guess, low), high)
    for _ in range(50):
        d, slope = _place(psi, base, amplitude, b)
        if d < level:
            low = psi
        else:
            high = psi
        following = psi - (d - level) / slope if slope > 0.0 else high + 1.0
        if not low <= following <= high:
            following = 0.5 * (low + high)
        if abs(following - psi) < 1e-9:
            return following
        psi = following
    return psi


@kernel
def on_motion(
    t: _Floats,
    law: _Floats,
    damping: _Floats,
    speed: float,
    amplitude: _Floats,
    motion: _Floats,
    first: int,
    end: int,
    cons: _Floats,
    diss: _Floats,
) -> None:
    """Fill what a force ``law(d) - damping(d) d'`` makes of the motions that come as close as some of the points.

    ``d = t_i + A (1 - cos psi) + sum_n b_n (cos n psi - 1)``, b a row of ``motion``; beyond the last point there is
    no force. ``cons`` takes the harmonics over ``theta = psi + pi`` and ``diss`` the energy lost per cycle over pi A.
    Pieces end where the gap passes a point, because the law has a kink there.
    """
    last, orders = t.shape[0] - 1, cons.shape[1]
    for i in range(first, end):
        A, b = amplitude[i], motion[i]
        cons[i] = 0.0
        lost, low, ratio = 0.0, 0.0, 1.0
        base = t[i] + A - b[2:].sum()
        for j in range(i, last):
            if low >= math.pi:
                break
            guess = 2.0 * math.asin(min(math.sqrt((t[j + 1] - t[i]) / (2.0 * A)), 1.0))
            high = _reached(t[j + 1], low, guess * ratio, base, A, b)
            ratio = high / guess
            pieces = 1 + int((high - low) * orders / 2.0)
            width = (high - low) / pieces
            for piece in range(pieces):
                for k in range(_NODES.shape[0]):
                    psi = low + width * (piece + 0.5 * (1.0 + _NODES[k]))
                    d, slope = _place(psi, base, A, b)
                    x = d - t[j]
                    weight = width * _WEIGHTS[k] / math.pi
                    force = law[j, 0] + x * (law[j, 1] + x * (law[j, 2] + x * law[j, 3]))
                    loss = damping[j, 0] + x * (damping[j, 1] + x * (damping[j, 2] + x * damping[j, 3]))
                    lost += weight * loss * slope**2
                    force *= weight
                    cons[i, 0] += 0.5 * force
                    c, s = math.cos(psi), math.sin(psi)
                    cn, sn = -c, -s
                    for n in range(1, orders):
                        cons[i, n] += force * cn
                        cn, sn = sn * s - cn * c, -sn * c - cn * s
            low = high
        diss[i] = lost * speed / A
