"""The harmonics of a force on the motion that the tip makes, and how they go with the material.

A tip that meets another material moves otherwise in its higher harmonics, and the force is that on the new motion. To
first order that needs no second motion: the derivative of the force by gap and velocity, at the phases where the force
itself was summed, says what any small change of the motion does to it.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from overtone.contact.terms import NO_ADHESION, tail_shape, tail_slope
from overtone.dynamics.balance import Motion, bottom, gap_at
from overtone.inversion.columns import Columns, fill_columns
from overtone.inversion.exact import C_, DELTA_, F_, S_
from overtone.inversion.motion import SIDE_BY_SIDE, Followed, Room, force_harmonics_on, product
from overtone.kernels import inlined, inner, lean

_Floats = npt.NDArray[np.float64]
_Complex = npt.NDArray[np.complex128]

_EDGE_STEPS = 8
_ANSWERS = 2  # of the motion: to its own force on a cosine, and to what that adds


class Answer(NamedTuple):
    """Scratch: the force at the phases of a motion in parts, and how it goes with the motion; times its weights."""

    elastic: _Floats
    """(phase,)."""
    adhesion: _Floats
    loss: _Floats
    by_gap: _Floats
    """(phase,): derivative by the gap."""
    by_rate: _Floats
    """(phase,): by the derivative of the gap by theta."""
    gap: _Floats
    """(phase,): a change of the motion, and then of the force."""
    rate: _Floats
    change: _Complex
    """(harmonic,): of the force."""
    on_a_cosine: _Complex
    """(harmonic,): the same on a bare cosine."""
    turns: _Complex
    """(harmonic,): exp(i n theta) of the turning point."""


@inner
def new_answer(room: Room) -> Answer:
    """Return scratch that goes with a room."""
    most, size = room.samples.theta.shape[0], room.b.shape[0]
    return Answer(
        np.zeros(most),
        np.zeros(most),
        np.zeros(most),
        np.zeros(most),
        np.zeros(most),
        np.zeros(most),
        np.zeros(most),
        np.zeros(size, np.complex128),
        np.zeros(size, np.complex128),
        np.zeros(size, np.complex128),
    )


@lean
def renew(A: float, x: _Floats, columns: Columns, followed: Followed, room: Room) -> tuple[float, int]:
    """Renew f of the room: what the harmonics of the motion add to those of the force.

    Return the turning phase, and how many phases were summed.

    Beforehand f is that of the pass before, or of a material nearby: it changes much less than the force on a bare
    cosine does, which together with it gives the motion, b of the room. Zeros where nothing is known.
    """
    tip, omega, _, nodes = followed
    b, f, work = room.b, room.f, room.work
    S, F, c = x[S_], x[F_], x[C_]
    orders = b.shape[0]
    fill_columns(columns, A, 0.5 * x[DELTA_] / A, orders - 1, work)
    b[0], b[1] = 0.0, 0.0
    for n in range(2, orders):
        b[n] = tip[n] * (complex(S * work[0, n] + F * work[2, n], n * c * work[0, n]) + f[n])
    motion = Motion(A - x[DELTA_], A, b)
    # the closest gap is that of the material, whatever the harmonics add to it
    lowest = bottom(motion)
    motion = Motion(A - x[DELTA_] - (gap_at(lowest, motion)[0] + x[DELTA_]), A, b)
    damping = columns.powers[0] * c / omega
    count = force_harmonics_on(motion, lowest, columns, S, F, damping, omega, nodes, room.samples, f)
    for n in range(orders):
        f[n] -= complex(S * work[0, n] + F * work[2, n], n * c * work[0, n])
    return lowest, count


@lean
def differentiate(
    A: float,
    x: _Floats,
    columns: Columns,
    followed: Followed,
    lowest: float,
    count: int,
    room: Room,
    answer: Answer,
) -> int:
    """Fill how the force goes with the motion of the last pass; return how many phases that takes.

    ``lowest`` and ``count`` are those of `renew`.
    """
    samples, contact = room.samples, columns.contact
    S, F, damping_rate = x[S_], x[F_], columns.powers[0] * x[C_]
    p = columns.powers[0]
    sticks = contact.tail != NO_ADHESION
    # without those that fill up
    while count > 0 and samples.weight[count - 1] == 0.0:
        count -= 1
    first, last = math.inf, -math.inf
    for j in range(count):
        weight, d, rate = samples.weight[j] / math.pi, samples.gap[j], samples.rate[j]
        elastic, adhesion, loss, by_gap, by_rate = 0.0, 0.0, 0.0, 0.0, 0.0
        depth = -d
        if samples.inside[j]:
            first, last = min(first, samples.theta[j]), max(last, samples.theta[j])
            adhesion = -F if sticks else 0.0
            if depth > 0.0:
                low = math.sqrt(depth) if p == 1.5 else depth ** (p - 1.0)
                elastic, by_gap = S * low * depth, -S * p * low
                for k in range(1, columns.powers.shape[0]):
                    q = columns.powers[k]
                    more = S * columns.shares[k] * depth ** (q - 1.0)
                    elastic += more * depth
                    by_gap -= q * more
                by_rate = -damping_rate * low
                loss = by_rate * rate
                by_gap -= (p - 1.0) * loss / depth
        else:
            adhesion = -F * tail_shape(contact.tail, max(d, 0.0), contact.a0)
            by_gap = -F * tail_slope(contact.tail, max(d, 0.0), contact.a0)
        answer.elastic[j], answer.adhesion[j] = weight * elastic, weight * adhesion
        answer.loss[j] = weight * loss
        answer.by_gap[j], answer.by_rate[j] = weight * by_gap, weight * by_rate
    turn, power = complex(math.cos(lowest), math.sin(lowest)), complex(1.0, 0.0)
    for n in range(room.b.shape[0]):
        answer.turns[n] = power
        power *= turn
    # a force that jumps where contact begins goes with the phase of that
    jump = F * tail_shape(contact.tail, 0.0, contact.a0) - F if sticks else 0.0
    if first <= last and (jump != 0.0 or (p == 1.0 and damping_rate != 0.0)):
        wave = 0.0
        for n in range(2, room.b.shape[0]):
            wave += (room.b[n] * answer.turns[n]).real
        motion = Motion(-x[DELTA_] - A * turn.real - wave, A, room.b)
        for way in range(2):
            theta = last if way else first
            for _ in range(_EDGE_STEPS):
                d, rate = gap_at(theta, motion)
                theta -= d / rate
            d, rate = gap_at(theta, motion)
            # contact that never ends has no edge
            if not (abs(theta - lowest) < math.pi and abs(d) < 1e-6 * A) or count >= samples.weight.shape[0]:
                continue
            step = jump - damping_rate * rate if p == 1.0 else jump
            answer.elastic[count], answer.adhesion[count], answer.loss[count] = 0.0, 0.0, 0.0
            answer.by_gap[count], answer.by_rate[count] = -step / (math.pi * abs(rate)), 0.0
            turn, power = complex(math.cos(theta), math.sin(theta)), complex(1.0, 0.0)
            for n in range(room.b.shape[0]):
                samples.cosine[n, count], samples.sine[n, count] = power.real, power.imag
                power *= turn
            count += 1
    while count % SIDE_BY_SIDE:
        samples.cosine[:, count], samples.sine[:, count] = 0.0, 0.0
        answer.elastic[count], answer.adhesion[count], answer.loss[count] = 0.0, 0.0, 0.0
        answer.by_gap[count], answer.by_rate[count] = 0.0, 0.0
        count += 1
    return int(count)


@inlined
def _add_turn(
    by_cosine: float,
    by_sine: float,
    n: int,
    cosine: _Floats,
    sine: _Floats,
    gap: _Floats,
    rate: _Floats,
    count: int,
) -> None:
    """Add a harmonic to a change of the motion."""
    for j in range(count):
        gap[j] += by_cosine * cosine[j] + by_sine * sine[j]
        rate[j] += n * (by_sine * cosine[j] - by_cosine * sine[j])


@inlined
def _changed(
    elastic: float, adhesion: float, loss: float, closer: float, answer: Answer, gap: _Floats, count: int
) -> None:
    """Replace a change of the gap by that of the force."""
    for j in range(count):
        gap[j] = (
            elastic * answer.elastic[j]
            + adhesion * answer.adhesion[j]
            + loss * answer.loss[j]
            + answer.by_gap[j] * (gap[j] - closer)
            + answer.by_rate[j] * answer.rate[j]
        )


@lean
def add_changes(
    x: _Floats,
    elastic: float,
    adhesion: float,
    loss: float,
    deeper: float,
    amplitude: float,
    followed: Followed,
    orders: npt.NDArray[np.int64],
    lossy: npt.NDArray[np.bool_],
    count: int,
    room: Room,
    answer: Answer,
    out: _Floats,
) -> None:
    """Fill what the harmonics of the motion add to the change of rows [N].

    Parameters
    ----------
    x : array (4,)
        The material.
    elastic, adhesion, loss : float
        Relative changes of the three forces.
    deeper : float
        Change of Delta.
    amplitude : float
        [m].
    followed, orders, lossy, count, room, answer
        Lever, rows, phases, scratch as `differentiate` left it.
    out : array (row,)
        Filled.
    """
    work, samples, change = room.work, room.samples, answer.change
    S, F, c = x[S_], x[F_], x[C_]
    gap, rate = answer.gap, answer.rate
    size = room.b.shape[0]
    on_a_cosine = answer.on_a_cosine
    for n in range(size):
        on_a_cosine[n] = complex(
            S * (elastic * work[0, n] + deeper * work[1, n])
            + F * (adhesion * work[2, n] + deeper * work[3, n]),
            n * c * (loss * work[0, n] + deeper * work[1, n]),
        )
        change[n] = on_a_cosine[n]
    for k in range(_ANSWERS):
        gap[:count], rate[:count] = 0.0, 0.0
        closer = 2.0 * amplitude * deeper
        for n in range(2, size):
            moved = followed.tip[n] * change[n]
            # the closest gap stays
            closer += (moved * answer.turns[n]).real
            _add_turn(moved.real, -moved.imag, n, samples.cosine[n], samples.sine[n], gap, rate, count)
        _changed(elastic, adhesion, loss, closer, answer, gap, count)
        if k < _ANSWERS - 1:
            # the motion answers to that force, not to the one on a cosine
            for n in range(2, size):
                change[n] = complex(
                    product(gap, samples.cosine[n], count), -product(gap, samples.sine[n], count)
                )
    for r in range(orders.shape[0]):
        n = orders[r]
        if lossy[r]:
            out[r] = product(gap, samples.sine[n], count) + on_a_cosine[n].imag
        else:
            half = 0.5 if n == 0 else 1.0
            out[r] = half * product(gap, samples.cosine[n], count) - on_a_cosine[n].real
