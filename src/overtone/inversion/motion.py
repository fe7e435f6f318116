"""From the motion that the tip makes to the bare cosine that the closed forms know.

The tip also moves in its higher harmonics, which bends the turning point under which it touches: forces on a bare cosine
of the same amplitude and indentation are 0.4 to 4.5 % too large, moduli 1 to 6 % (Shaik, Reifenberger and Raman 2020,
eq 10). Of those harmonics the measured ones are known and the others follow from the force itself. So the difference
that they make at a solution is taken off the data, and the solution found again, until neither moves: each pass leaves a
few per cent of the one before, because the difference hardly changes along the valley in which a solution moves.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from overtone.contact.terms import LINEAR_TAIL, NO_ADHESION, VAN_DER_WAALS_TAIL, tail_shape
from overtone.dynamics.balance import Motion, bottom, gap_at
from overtone.inversion.columns import Columns, adhesive, fill_columns
from overtone.inversion.exact import C_, DELTA_, F_, S_, closest_apart, polish
from overtone.inversion.table import DEEPEST, SHALLOWEST
from overtone.inversion.valley import new_scratch, physical, whiten
from overtone.kernels import inlined, inner, kernel

_Floats = npt.NDArray[np.float64]
_Complex = npt.NDArray[np.complex128]

HARMONICS = 10
"""Harmonics of the motion that are followed."""
COARSE, FINE = 12, 24
"""Nodes of a piece of the motion: forces to 1e-6, and to 1e-9."""
_RULES = {n: np.polynomial.legendre.leggauss(n) for n in (COARSE, FINE)}
_STILL = 1e-9  # relative change of a solution from one pass to the next
_FIRM = 0.5  # share of a step where steps grow


def rule(nodes: int) -> _Floats:
    """Return nodes and weights of a quadrature over 0..1, as an array (2, node)."""
    x, w = _RULES[nodes]
    return np.array([0.5 * (1.0 + x), 0.5 * w])


@inlined
def _add(
    theta: float, weight: float, motion: Motion, columns: Columns, S: float, F: float, damping: float, omega: float,
    inside: bool, f: _Complex,
) -> None:
    """Add the force at a phase to its harmonics."""
    turn = complex(math.cos(theta), math.sin(theta))
    d, slope = motion.g + motion.amplitude * turn.real, -motion.amplitude * turn.imag
    power = turn
    for n in range(2, motion.b.shape[0]):
        power *= turn
        b = motion.b[n]
        d += b.real * power.real - b.imag * power.imag
        slope -= n * (b.real * power.imag + b.imag * power.real)
    contact = columns.contact
    force = 0.0
    if inside:
        depth = max(-d, 0.0)
        p = columns.powers[0]
        if p == 1.5:
            root = math.sqrt(depth)
            force = S * depth * root - damping * root * omega * slope
        else:
            force = S * depth**p
            if damping != 0.0:
                force -= damping * depth ** (p - 1.0) * omega * slope
            for k in range(1, columns.powers.shape[0]):
                force += S * columns.shares[k] * depth ** columns.powers[k]
        if contact.tail != NO_ADHESION:
            force -= F
    else:
        force = -F * tail_shape(contact.tail, max(d, 0.0), contact.a0)
    back = complex(turn.real, -turn.imag)
    share = complex(force * weight / math.pi, 0.0)
    f[0] += 0.5 * share
    for n in range(1, f.shape[0]):
        share *= back
        f[n] += share


@inner
def _where(level: float, inside: float, outside: float, motion: Motion) -> float:
    """Return the phase between ``inside`` and ``outside`` where the gap meets a level; ``outside`` where it does not."""
    if gap_at(outside, motion)[0] <= level:
        return outside
    low, high, x = inside, outside, 0.5 * (inside + outside)
    # next to the turning point the gap is a parabola
    depth = level - gap_at(inside, motion)[0]
    guess = math.acos(min(max(1.0 - depth / motion.amplitude, -1.0), 1.0))
    x = inside + math.copysign(guess, outside - inside)
    for _ in range(60):
        d, slope = gap_at(x, motion)
        if d < level:
            low = x
        else:
            high = x
        step = (d - level) / slope if slope != 0.0 else math.inf
        there = x - step
        if not min(low, high) < there < max(low, high):
            there = 0.5 * (low + high)
        done = abs(there - x) < 1e-12
        x = there
        if done:
            break
    return x


@inner
def force_harmonics_on(
    motion: Motion, columns: Columns, S: float, F: float, damping: float, omega: float, nodes: _Floats, f: _Complex
) -> None:
    """Fill the harmonics of the force on a motion: pieces from the turning point outwards, graded where it decays."""
    f[:] = 0.0
    contact = columns.contact
    lowest = bottom(motion)
    closest = gap_at(lowest, motion)[0]
    count = nodes.shape[1]
    for way in range(2):
        side = 1.0 if way else -1.0
        far = lowest + side * math.pi
        start = lowest
        if closest < 0.0:
            edge = _where(0.0, lowest, far, motion)
            span = edge - lowest
            for j in range(count):
                s = nodes[0, j]
                _add(
                    edge - span * s * s, 2.0 * abs(span) * s * nodes[1, j], motion, columns, S, F, damping, omega,
                    True, f,
                )
            start = edge
        if start == far or (contact.tail != LINEAR_TAIL and contact.tail != VAN_DER_WAALS_TAIL):
            continue
        stop = far
        if contact.tail == LINEAR_TAIL:
            if 2.0 * contact.a0 <= closest:
                continue
            stop = _where(2.0 * contact.a0, lowest, far, motion)
        reach = abs(stop - start)
        if closest < 0.0:
            # the gap grows linearly: even steps of the logarithm of 1 + x/width
            width = contact.a0 / max(abs(gap_at(start, motion)[1]), contact.a0 / math.pi)
            length = math.log1p(reach / width)
            for j in range(count):
                grown = math.exp(length * nodes[0, j])
                x = width * (grown - 1.0)
                _add(
                    start + side * x, length * width * grown * nodes[1, j], motion, columns, S, F, damping, omega,
                    False, f,
                )
        else:
            # the gap grows as a parabola from the turning point
            width = math.sqrt(2.0 * (contact.a0 + closest) / motion.amplitude)
            length = math.asinh(reach / width)
            for j in range(count):
                v = length * nodes[0, j]
                _add(
                    start + side * width * math.sinh(v), length * width * math.cosh(v) * nodes[1, j], motion, columns,
                    S, F, damping, omega, False, f,
                )


@inner
def _difference(
    A: float, x: _Floats, columns: Columns, tip: _Complex, omega: float, known: npt.NDArray[np.int64], f_known: _Complex,
    nodes: _Floats, b: _Complex, f: _Complex, work: _Floats,
) -> None:
    """Fill f with what the harmonics of the motion add to those of the force at a solution, and renew b.

    b holds the harmonics of the motion of the pass before; those that were measured stay.
    """
    orders = b.shape[0]
    S = x[S_] if x[DELTA_] > 0.0 else 0.0
    c = x[C_] if x[DELTA_] > 0.0 else 0.0
    damping = columns.powers[0] * c / omega
    fill_columns(columns, A, 0.5 * x[DELTA_] / A, orders - 1, work)
    for n in range(2, orders):
        if b[n] == 0.0:  # the first pass: the force of the bare cosine drives them
            b[n] = tip[n] * complex(S * work[0, n] + x[F_] * work[2, n], n * c * work[0, n])
    for k in range(known.shape[0]):
        n = known[k]
        if 2 <= n < orders and math.isfinite(f_known[k].real):
            b[n] = tip[n] * f_known[k]
    b[0], b[1] = 0.0, 0.0
    motion = Motion(A - x[DELTA_], A, b)
    # the closest gap is that of the solution, whatever the harmonics add to it
    lower = gap_at(bottom(motion), motion)[0]
    motion = Motion(A - x[DELTA_] - (lower + x[DELTA_]), A, b)
    force_harmonics_on(motion, columns, S, x[F_], damping, omega, nodes, f)
    for n in range(2, orders):
        b[n] = tip[n] * f[n]
    for n in range(orders):
        f[n] -= complex(S * work[0, n] + x[F_] * work[2, n], n * c * work[0, n])


@kernel
def to_bare_cosine(
    y: _Floats,
    whitening: _Floats,
    amplitude: _Floats,
    solution: _Floats,
    columns: Columns,
    orders: npt.NDArray[np.int64],
    lossy: npt.NDArray[np.bool_],
    attraction: npt.NDArray[np.int64],
    tip: _Complex,
    omega: float,
    known: npt.NDArray[np.int64],
    f_known: _Complex,
    nodes: _Floats,
    passes: int,
    bare: _Floats,
    spread: _Floats,
) -> None:
    """Move solutions from the bare cosine to the motion that the tip makes.

    Parameters
    ----------
    y, whitening : array (pixel, row), (pixel or 1, row, row)
        Force harmonics [N] and what whitens their errors.
    amplitude : array (pixel,)
        Of the tip [m].
    solution : array (pixel, 4)
        Solutions of the bare cosine, as `overtone.inversion.exact` has them; replaced. NaN where there is none.
    columns : Columns
        The model.
    orders, lossy, attraction
        As there.
    tip : array (n,)
        Answer of the tip at harmonics 0, 1, ... [m/N].
    omega : float
        Angular drive frequency [rad/s].
    known : array (harmonic,)
        Harmonics that were measured, and
    f_known : array (pixel, harmonic)
        their force, complex [N].
    nodes : array (2, node)
        `rule`.
    passes : int
        At most so many.
    bare : array (pixel, row)
        Filled: the data that a bare cosine would have given [N].
    spread : array (pixel,)
        Replaced: standard deviation of S, where the solution moved.
    """
    size = tip.shape[0]
    b, f = np.zeros(size, np.complex128), np.zeros(size, np.complex128)
    work = np.empty((6, size))
    rows = orders.shape[0]
    n_max = 0
    for r in range(rows):
        n_max = max(n_max, orders[r])
    s = new_scratch(rows, n_max)
    slope = np.empty(rows)
    sticky = adhesive(columns)
    for i in range(y.shape[0]):
        for r in range(rows):
            bare[i, r] = y[i, r]
        x = solution[i]
        if not math.isfinite(x[DELTA_]) or not abs(x[DELTA_]) < 1.9 * amplitude[i]:
            continue
        A, W = amplitude[i], whitening[min(i, whitening.shape[0] - 1)]
        b[:] = 0.0
        before = math.inf
        for _ in range(passes):
            _difference(A, x, columns, tip, omega, known, f_known[i], nodes, b, f, work)
            finite = True
            for r in range(rows):
                off = -f[orders[r]].imag if lossy[r] else f[orders[r]].real
                finite = finite and math.isfinite(off)
                bare[i, r] = y[i, r] - off
            if not finite:
                for r in range(rows):
                    bare[i, r] = y[i, r]
                break
            whiten(W, bare[i], s.wy)
            if x[DELTA_] < 0.0:
                gap, F, _ = closest_apart(A, columns, orders, lossy, W, s)
                moved = abs(gap + x[DELTA_]) / gap
                x[F_], x[DELTA_] = F, -gap
            else:
                Delta = 0.5 * x[DELTA_] / A
                t = math.log(Delta / (1.0 - Delta))
                there, m, sigma = polish(
                    columns, A, t, max(t - 1.0, SHALLOWEST), min(t + 1.0, DEEPEST), orders, lossy, W, sticky, 6, s, slope
                )
                if not physical(m):
                    break  # held by a bound: the difference is known well enough where it stands
                moved = abs(there - t)
                share = _FIRM if moved > before else 1.0
                there = t + share * (there - t)
                F = m.F0 + m.F1 * m.S
                x[S_], x[F_], x[C_] = m.S, F, m.c0 + m.c1 * m.S + m.c2 * F
                x[DELTA_] = 2.0 * A / (1.0 + math.exp(-there))
                spread[i] = sigma
            if moved < _STILL:
                break
            before = moved
