"""From the motion that the tip makes to the bare cosine that the closed forms know.

The tip also moves in its higher harmonics, which bends the turning point under which it touches: forces on a bare
cosine of the same amplitude and indentation are 0.4 to 4.5 % too large, moduli 1 to 6 % (Shaik, Reifenberger and Raman
2020, eq 10). Of those harmonics the measured ones are known and the others follow from the force itself. So the
difference that they make at a solution is taken off the data, and the solution found again, until neither moves: each
pass leaves a few per cent of the one before, because the difference hardly changes along the valley in which a solution
moves. Where a soft lever meets a stiff sample the passes may come to no rest; such a solution is dropped.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from overtone.contact.terms import LINEAR_TAIL, NO_ADHESION, VAN_DER_WAALS_TAIL, tail_shape
from overtone.dynamics.balance import Motion, bottom, gap_at
from overtone.harmonics import tip_receptance
from overtone.inversion.apart import closest_apart
from overtone.inversion.columns import Columns, adhesive, fill_columns
from overtone.inversion.exact import C_, DELTA_, F_, S_, polish
from overtone.inversion.linear import Contact
from overtone.inversion.search import Pixel, columns_at, pixel_at, scan_valley
from overtone.inversion.table import DEEPEST, NODES, SHALLOWEST, STEP, Table, locate
from overtone.inversion.valley import (
    Box,
    Scratch,
    best_F,
    new_scratch,
    physical,
    reduce,
    set_places,
    solved,
    whiten,
)
from overtone.kernels import inlined, inner, kernel, lean
from overtone.probe import Probe

_Floats = npt.NDArray[np.float64]
_Complex = npt.NDArray[np.complex128]

FEW, MANY = 16, 20
"""Harmonics of the motion that are followed, along the valley and at a solution."""
COARSE, FINE = 12, 16
"""Nodes of a piece of the motion, with few harmonics and with many: forces to 1e-5, and to 1e-6."""
_STILL = 1e-7  # last step of t; the next would be a tenth of it
_NEARLY_STILL = 1e-4
_TURN_OF_A_PIECE = 12.0  # phase of the highest harmonic [rad]
SIDE_BY_SIDE = 4
"""Phases that are summed at a time."""
_MET = 1e-6  # last step of a phase: Newton's next would be of the size of its square
_SETTLING = 30
_STEADY = 6  # times that the material is found again at one t, where care is taken
_PATIENCE = 5  # steps after which they have to shrink
_LONGEST, _FARTHEST = 0.5, 3.0  # of one step of t, and of all together
_APART_PASSES = 3
_STRIDE = 3
_SHALLOW = 8  # node of that stride below which no place is: a contact so short that nothing changes any more
_NEAR = 0.1  # of the largest row, by which the model may miss the data where places are


def gauss_rule(nodes: int) -> _Floats:
    """Return nodes and weights of Gauss's quadrature over 0..1, as an array (2, node)."""
    x, w = np.polynomial.legendre.leggauss(nodes)
    return np.array([0.5 * (1.0 + x), 0.5 * w])


class Samples(NamedTuple):
    """Phases of a motion, all of them at a time: loops over them wait for nothing, those over harmonics would."""

    theta: _Floats
    """(phase,)."""
    weight: _Floats
    """(phase,): of the quadrature."""
    inside: npt.NDArray[np.bool_]
    """(phase,): whether it is in contact."""
    cosine: _Floats
    """(order, phase): of n theta."""
    sine: _Floats
    gap: _Floats
    """(phase,)."""
    rate: _Floats
    """(phase,): derivative of the gap by theta."""
    share: _Floats
    """(phase,): of the force in the harmonics."""


@inner
def new_samples(harmonics: int, nodes: int) -> Samples:
    """Return room for the phases of a motion of so many harmonics, with so many nodes a piece."""
    most = 2 * nodes * (2 + int(math.pi * harmonics / _TURN_OF_A_PIECE)) + SIDE_BY_SIDE
    return Samples(
        np.zeros(most),
        np.zeros(most),
        np.zeros(most, np.bool_),
        np.zeros((harmonics + 1, most)),
        np.zeros((harmonics + 1, most)),
        np.zeros(most),
        np.zeros(most),
        np.zeros(most),
    )


@lean
def _where(level: float, inside: float, outside: float, motion: Motion) -> float:
    """Return the phase between two others where the gap meets a level; ``outside`` where it does not."""
    if gap_at(outside, motion)[0] <= level:
        return outside
    low, high = inside, outside
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
        if abs(step) < _MET:
            return x - step
        x -= step
        if not min(low, high) < x < max(low, high):
            x = 0.5 * (low + high)
    return x


@inlined
def _put(theta: float, weight: float, inside: bool, count: int, samples: Samples) -> int:
    """Add a phase to the samples; return how many there are."""
    samples.theta[count], samples.weight[count], samples.inside[count] = theta, weight, inside
    return count + 1


@lean
def _place(motion: Motion, lowest: float, contact: Contact, nodes: _Floats, samples: Samples) -> int:
    """Fill phases and weights: pieces from the turning point outwards, graded where the force decays."""
    closest = gap_at(lowest, motion)[0]
    found, of_a_piece = 0, nodes.shape[1]
    for way in range(2):
        side = 1.0 if way else -1.0
        far = lowest + side * math.pi
        start = lowest
        if closest < 0.0:
            edge = _where(0.0, lowest, far, motion)
            span = edge - lowest
            # as many pieces as the highest harmonic needs
            pieces = 1 + int(abs(span) * (samples.cosine.shape[0] - 1) / _TURN_OF_A_PIECE)
            for k in range(pieces):
                for j in range(of_a_piece):
                    s = (k + nodes[0, j]) / pieces
                    weight = 2.0 * abs(span) * s * nodes[1, j] / pieces
                    found = _put(edge - span * s * s, weight, True, found, samples)
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
            for j in range(of_a_piece):
                grown = math.exp(length * nodes[0, j])
                weight = length * width * grown * nodes[1, j]
                found = _put(start + side * width * (grown - 1.0), weight, False, found, samples)
        else:
            # the gap grows as a parabola from the turning point
            width = math.sqrt(2.0 * (contact.a0 + closest) / motion.amplitude)
            length = math.asinh(reach / width)
            for j in range(of_a_piece):
                v = length * nodes[0, j]
                weight = length * width * math.cosh(v) * nodes[1, j]
                found = _put(start + side * width * math.sinh(v), weight, False, found, samples)
    # what is summed side by side is filled up with phases that have no weight
    while found % SIDE_BY_SIDE:
        found = _put(lowest, 0.0, False, found, samples)
    return found


@inlined
def _next_order(double: _Floats, last: _Floats, before: _Floats, out: _Floats, count: int) -> None:
    """Fill cos(n theta), or the sine, from those of the two orders below and 2 cos(theta)."""
    for j in range(count):
        out[j] = double[j] * last[j] - before[j]


@inlined
def _add_wave(
    by_cosine: float, by_sine: float, cosine: _Floats, sine: _Floats, out: _Floats, count: int
) -> None:
    """Add a wave to the samples."""
    for j in range(count):
        out[j] += by_cosine * cosine[j] + by_sine * sine[j]


@inlined
def product(x: _Floats, y: _Floats, count: int) -> float:
    """Return the sum of products, in four sums side by side: one alone would wait for itself at every step."""
    s0, s1, s2, s3 = 0.0, 0.0, 0.0, 0.0
    for j in range(0, count, SIDE_BY_SIDE):
        s0 += x[j] * y[j]
        s1 += x[j + 1] * y[j + 1]
        s2 += x[j + 2] * y[j + 2]
        s3 += x[j + 3] * y[j + 3]
    return (s0 + s1) + (s2 + s3)


@lean
def _move(motion: Motion, samples: Samples, count: int) -> None:
    """Fill what the motion is at the phases of the samples."""
    g, amplitude, b = motion
    cosine, sine, gap, rate = samples.cosine, samples.sine, samples.gap, samples.rate
    double = samples.share  # not in use yet
    for j in range(count):
        cosine[0, j], sine[0, j] = 1.0, 0.0
        cosine[1, j], sine[1, j] = math.cos(samples.theta[j]), math.sin(samples.theta[j])
        double[j] = 2.0 * cosine[1, j]
        gap[j], rate[j] = g + amplitude * cosine[1, j], -amplitude * sine[1, j]
    for n in range(2, cosine.shape[0]):
        _next_order(double, cosine[n - 1], cosine[n - 2], cosine[n], count)
        _next_order(double, sine[n - 1], sine[n - 2], sine[n], count)
    for n in range(2, b.shape[0]):
        _add_wave(b[n].real, -b[n].imag, cosine[n], sine[n], gap, count)
        _add_wave(-n * b[n].imag, -n * b[n].real, cosine[n], sine[n], rate, count)


@lean
def force_harmonics_on(
    motion: Motion,
    lowest: float,
    columns: Columns,
    S: float,
    F: float,
    damping: float,
    omega: float,
    nodes: _Floats,
    samples: Samples,
    f: _Complex,
) -> int:
    """Fill the harmonics of the force on a motion; return how many phases were summed.

    ``lowest`` is the phase of the closest gap.
    """
    contact = columns.contact
    count = _place(motion, lowest, contact, nodes, samples)
    _move(motion, samples, count)
    p = columns.powers[0]
    for j in range(count):
        d = samples.gap[j]
        force = 0.0
        if samples.inside[j]:
            depth = max(-d, 0.0)
            if p == 1.5:
                root = math.sqrt(depth)
                force = S * depth * root - damping * root * omega * samples.rate[j]
            else:
                force = S * depth**p
                if damping != 0.0:
                    force -= damping * depth ** (p - 1.0) * omega * samples.rate[j]
            for k in range(1, columns.powers.shape[0]):
                force += S * columns.shares[k] * depth ** columns.powers[k]
            if contact.tail != NO_ADHESION:
                force -= F
        else:
            force = -F * tail_shape(contact.tail, max(d, 0.0), contact.a0)
        samples.share[j] = force * samples.weight[j] / math.pi
    for n in range(f.shape[0]):
        f[n] = complex(
            product(samples.share, samples.cosine[n], count),
            -product(samples.share, samples.sine[n], count),
        )
    f[0] *= 0.5
    return count


@lean
def difference_of(
    A: float, x: _Floats, columns: Columns, followed: Followed, f_known: _Complex, room: Room
) -> None:
    """Fill f of the room with what the harmonics of the motion add to those of the force at a solution, and renew b.

    b holds the harmonics of the motion of the pass before; those that were measured stay.
    """
    tip, omega, known, nodes = followed
    b, f, work = room.b, room.f, room.work
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
    lowest = bottom(motion)
    motion = Motion(A - x[DELTA_] - (gap_at(lowest, motion)[0] + x[DELTA_]), A, b)
    force_harmonics_on(motion, lowest, columns, S, x[F_], damping, omega, nodes, room.samples, f)
    for n in range(2, orders):
        b[n] = tip[n] * f[n]
    for n in range(orders):
        f[n] -= complex(S * work[0, n] + x[F_] * work[2, n], n * c * work[0, n])


class Followed(NamedTuple):
    """What following the motion takes."""

    tip: _Complex
    """(n,): answer of the tip at harmonics 0, 1, ... [m/N]; empty for a bare cosine."""
    omega: float
    """Angular drive frequency [rad/s]."""
    known: npt.NDArray[np.int64]
    """(harmonic,): orders that were measured."""
    nodes: _Floats
    """(2, node): nodes and weights of a piece, over 0..1."""


class Room(NamedTuple):
    """Scratch for the harmonics of motion and force."""

    b: _Complex
    f: _Complex
    work: _Floats
    x: _Floats
    samples: Samples


@inner
def new_room(followed: Followed) -> Room:
    """Return scratch for one thread."""
    size = followed.tip.shape[0]
    return Room(
        np.zeros(size, np.complex128),
        np.zeros(size, np.complex128),
        np.zeros((6, size)),
        np.zeros(4),
        new_samples(max(size - 1, 0), followed.nodes.shape[1]),
    )


@inlined
def _row(room: Room, order: int, lossy: bool) -> float:
    """Return a row of the harmonics in the room: DISS_n where lossy, CONS_n else."""
    return -room.f[order].imag if lossy else room.f[order].real


@lean
def difference_at(
    t: float, pixel: Pixel, followed: Followed, f_known: _Complex, s: Scratch, room: Room, out: _Floats
) -> None:
    """Fill what the harmonics of the motion add to the rows at t, for the material that fits best there.

    ``out`` holds what they add nearby; zeros where that is not known.
    """
    A, orders = pixel.amplitude, pixel.orders
    Delta = columns_at(pixel, t, s)
    whiten(pixel.W, out, s.a)
    for r in range(orders.shape[0]):
        s.wy[r] = s.first[r] - s.a[r]
    _, m, S = solved(reduce(s, pixel.sticky, pixel.loss), s, pixel.sticky, pixel.box)
    x = room.x
    F = best_F(m, S, pixel.box)
    x[S_], x[F_], x[C_], x[DELTA_] = S, F, max(m.c0 + m.c1 * S + m.c2 * F, 0.0), 2.0 * A * Delta
    difference_of(A, x, pixel.columns, followed, f_known, room)
    for r in range(orders.shape[0]):
        off = _row(room, orders[r], pixel.lossy[r])
        out[r] = off if math.isfinite(off) else 0.0


def follow(probe: Probe, known: tuple[int, ...], harmonics: int) -> Followed:
    """Return what it takes to follow the motion of a probe; with 0 harmonics it is a bare cosine.

    Parameters
    ----------
    probe : Probe
        Any number of modes.
    known : tuple of int
        Harmonics above the first that were measured.
    harmonics : int
        `FEW`, `MANY` or 0.
    """
    frequency = probe.drive.frequency
    tip = (
        tip_receptance(probe.cantilever, np.arange(harmonics + 1) * frequency)
        if harmonics
        else np.empty(0, complex)
    )
    return Followed(
        tip,
        2.0 * math.pi * frequency,
        np.array(known, np.int64),
        gauss_rule(FINE if harmonics > FEW else COARSE),
    )


@kernel
def differences(
    y: _Floats,
    whitening: _Floats,
    amplitude: _Floats,
    usable: npt.NDArray[np.bool_],
    columns: Columns,
    table: Table,
    orders: npt.NDArray[np.int64],
    lossy: npt.NDArray[np.bool_],
    box: Box,
    followed: Followed,
    f_known: _Complex,
    spans: _Floats,
    shifts: _Floats,
) -> None:
    """Fill what the harmonics of the motion add to the rows of every pixel, at places along the valley.

    Parameters
    ----------
    y, whitening, amplitude, usable, columns, table, orders, lossy, box
        As `overtone.inversion.exact.solve_pixels` has them.
    followed : Followed
        The lever.
    f_known : array (pixel, harmonic)
        Forces of the harmonics that were measured, complex [N].
    spans : array (pixel, 2)
        Filled: stretch of t between which the places are.
    shifts : array (pixel, place, row)
        Filled [N].
    """
    rows = orders.shape[0]
    s, room = new_scratch(rows, table.elastic.shape[2] - 1, 0), new_room(followed)
    grid = new_scratch(rows, 0, shifts.shape[1])
    out, roughly = np.zeros(rows), np.zeros((rows, rows))
    nodes = (NODES - 1) // _STRIDE + 1
    bounded = np.empty(nodes)
    for i in range(y.shape[0]):
        shifts[i], spans[i, 0], spans[i, 1] = 0.0, 0.0, 1.0
        slot, share = locate(table, amplitude[i])
        if not usable[i] or slot < 0:
            continue
        # where the model comes near the data at all: elsewhere its motion says nothing of theirs
        size = 0.0
        for r in range(rows):
            size = max(size, abs(y[i, r]))
        for r in range(rows):
            roughly[r, r] = 1.0 / (_NEAR * size)
        whiten(roughly, y[i], s.first)
        rough = pixel_at(columns, amplitude[i], table, slot, share, orders, lossy, roughly, box)
        least = scan_valley(rough, _STRIDE, bounded, s)
        low, high = nodes, 0
        for k in range(nodes):
            if bounded[k] < 1.0 + bounded[least]:
                low, high = min(low, k), max(high, k)
        spans[i, 0] = SHALLOWEST + STEP * _STRIDE * max(low - 1, _SHALLOW)
        spans[i, 1] = SHALLOWEST + STEP * _STRIDE * max(min(high + 1, nodes - 1), _SHALLOW + 2)
        set_places(grid, spans[i, 0], spans[i, 1])
        W = whitening[min(i, whitening.shape[0] - 1)]
        pixel = pixel_at(columns, amplitude[i], table, slot, share, orders, lossy, W, box)
        whiten(W, y[i], s.first)
        out[:] = 0.0
        for j in range(shifts.shape[1]):
            room.b[:] = 0.0
            difference_at(grid.places[j], pixel, followed, f_known[i], s, room, out)
            for r in range(rows):
                shifts[i, j, r] = out[r]


@kernel
def settle(
    y: _Floats,
    whitening: _Floats,
    amplitude: _Floats,
    columns: Columns,
    orders: npt.NDArray[np.int64],
    lossy: npt.NDArray[np.bool_],
    followed: Followed,
    f_known: _Complex,
    solution: _Floats,
    spread: _Floats,
    chi2: _Floats,
) -> None:
    """Move solutions to where they agree with the motion that the tip makes; NaN where they come to no rest.

    Parameters
    ----------
    y, whitening, amplitude, columns, orders, lossy, followed, f_known
        As in `differences`.
    solution : array (pixel, 4)
        As `overtone.inversion.exact` has them; replaced. NaN where there is none.
    spread, chi2 : array (pixel,)
        Standard deviation of S, and what is left of the data; replaced.
    """
    rows = orders.shape[0]
    n_max = 0
    for r in range(rows):
        n_max = max(n_max, orders[r])
    s, room = new_scratch(rows, n_max, 0), new_room(followed)
    slope, left, at_start = np.empty(rows), np.empty(rows), np.empty(4)
    sticky = adhesive(columns)
    for i in range(y.shape[0]):
        x = solution[i]
        A, W = amplitude[i], whitening[min(i, whitening.shape[0] - 1)]
        if not math.isfinite(x[DELTA_]):
            continue
        room.b[:] = 0.0
        if x[DELTA_] < 0.0:
            for _ in range(_APART_PASSES):
                _rows_left(A, x, y[i], columns, followed, f_known[i], orders, lossy, room, left)
                whiten(W, left, s.wy)
                x[DELTA_], x[F_], chi2[i] = closest_apart(A, columns, orders, lossy, W, s)
                x[DELTA_] = -x[DELTA_]
            continue
        Delta = 0.5 * x[DELTA_] / A
        start = math.log(Delta / (1.0 - Delta))
        at_start[:] = x
        done = False
        for careful in range(2):
            # first step by step; where that comes to no rest, by the secant, with the material at rest at every t
            x[:] = at_start
            room.b[:] = 0.0
            t, rest, before, step_before = start, math.inf, start, 0.0
            for k in range(_SETTLING):
                x[DELTA_] = 2.0 * A / (1.0 + math.exp(-t))
                there = t
                for _ in range(_STEADY if careful else (2 if k == 0 else 1)):
                    _rows_left(A, x, y[i], columns, followed, f_known[i], orders, lossy, room, left)
                    whiten(W, left, s.first)
                    there, m, spread[i] = polish(
                        columns, A, t, SHALLOWEST, DEEPEST, orders, lossy, W, sticky, 1, s, slope
                    )
                    F = m.F0 + m.F1 * m.S
                    x[S_], x[F_], x[C_] = m.S, F, m.c0 + m.c1 * m.S + m.c2 * F
                    chi2[i] = m.rest
                step = there - t
                ahead = step
                if careful and k > 0 and step != step_before:
                    ahead = min(max(-step * (t - before) / (step - step_before), -_LONGEST), _LONGEST)
                worse = abs(step) > 0.8 * rest
                rest = abs(step)
                if rest < _STILL or not math.isfinite(step) or (k > _PATIENCE and worse):
                    break
                before, step_before = t, step
                t = min(max(t + ahead, SHALLOWEST), DEEPEST)
            done = rest < _NEARLY_STILL and physical(m) and abs(t - start) < _FARTHEST
            if done:
                break
        if not done:
            x[:] = math.nan
            spread[i], chi2[i] = math.nan, math.nan


@lean
def _rows_left(
    A: float,
    x: _Floats,
    y: _Floats,
    columns: Columns,
    followed: Followed,
    f_known: _Complex,
    orders: npt.NDArray[np.int64],
    lossy: npt.NDArray[np.bool_],
    room: Room,
    left: _Floats,
) -> None:
    """Fill the data less what the harmonics of the motion add at a solution."""
    difference_of(A, x, columns, followed, f_known, room)
    for r in range(orders.shape[0]):
        left[r] = y[r] - _row(room, orders[r], lossy[r])
