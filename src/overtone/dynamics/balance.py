"""Harmonic balance: the periodic motion under the exact force, with its higher harmonics and its constraint.

The gap moves as ``d(theta) = g + A cos theta + Re sum_{n>=2} b_n exp(i n theta)``; the origin of theta is that
of the tip's first harmonic. The force on that motion has harmonics f_n, and the lever answers:

    g - G(0) f_0 = Z,    A/G(w) - f_1 = F_dr exp(i phi),    b_n = G(n w) f_n   (n >= 2)

Newton's method on g, A, phi, Z and the first b_n, with one more equation that says what is held: the height,
the amplitude that is read, or a line across both. The b_n beyond follow by substitution, which converges fast
because the lever is stiff there. The force is sampled by Gauss-Legendre pieces that end where it is not smooth
and grow away from there, because the attraction decays over a0 while the motion spans hundreds of it.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from overtone.contact.law import Law, has_tail, has_viscosity, law_force, law_slopes, tail_range
from overtone.kernels import inner, kernel, lean

FOUND, NO_STATE, NOT_CONVERGED, MANY_TOUCHES = 0, 1, 2, 3

HOLD_HEIGHT, HOLD_AMPLITUDE, HOLD_LINE = 0.0, 1.0, 2.0

STEERED = 10  # harmonics that Newton's method moves; those above follow by substitution

_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(10)
_EDGE_NODES, _EDGE_WEIGHTS = np.polynomial.legendre.leggauss(24)
_NARROWEST = 1e-9  # piece [rad]: none is narrower, whatever an iteration has run away to
_WIDEST_PIECE = 6.0  # phase of the highest harmonic that one piece of ten nodes spans [rad]
_WIDEST_EDGE = 15.0  # and one of 24 nodes
_ITERATIONS = 25
_TOLERANCE = 1e-10  # of what is left of the balance, relative to the drive
_LOST = 1e6
_CLOSE = 1e-4
_LONGEST_STEP = 0.3  # of the amplitude
_WIDEST_TURN = 0.5  # of the phase [rad]
_STALLED = 1e-9  # accepted where rounding ends the way down

_Floats = npt.NDArray[np.float64]
_Complex = npt.NDArray[np.complex128]


class Lever(NamedTuple):
    """What the balance needs to know of a probe."""

    tip: _Complex
    """G_tip at the harmonics [m/N]."""
    force: float
    """Equivalent drive force F_dr [N]."""
    reading: _Complex
    """What reads the first harmonic: ``a_1 = reading[0] A + reading[1] exp(i phi)`` beside a tip motion A."""
    omega: float
    """Angular drive frequency [rad/s]."""


class Motion(NamedTuple):
    """``d(theta) = g + A cos theta + Re sum_{n>=2} b_n exp(i n theta)``."""

    g: float
    amplitude: float
    b: _Complex
    """(n,); members 0 and 1 are not used."""


class Sums(NamedTuple):
    """What is summed over a period of a motion."""

    f: _Complex
    """(n,): harmonics of the force [N]."""
    P: _Complex
    """(n,), or empty: those of its derivative by the gap, without the half at n = 0 [N/m]."""
    S: _Complex
    """(n,), or empty: those of its derivative by the velocity [N s/m]."""
    extras: _Floats
    """(EXTRAS,): lowest gap, peak force, strongest pull, share of contact, energy lost, extra touches."""
    turns: _Complex
    """Scratch for exp(i n theta), as many as the longest of the others and the motion."""


# --- the motion -------------------------------------------------------------------------------------------------


@lean
def gap_at(theta: float, motion: Motion) -> tuple[float, float]:
    """Return the gap and its derivative by theta."""
    g, amplitude, b = motion
    turn = complex(math.cos(theta), math.sin(theta))
    d, slope, power = g + amplitude * turn.real, -amplitude * turn.imag, turn
    for n in range(2, b.shape[0]):
        power *= turn
        d += b[n].real * power.real - b[n].imag * power.imag
        slope -= n * (b[n].real * power.imag + b[n].imag * power.real)
    return d, slope


@inner
def _crossing(level: float, inside: float, outside: float, motion: Motion) -> float:
    """Return the phase between ``inside`` (gap below the level) and ``outside`` where the gap meets it."""
    if gap_at(outside, motion)[0] <= level:
        return outside
    low, high = inside, outside
    x = 0.5 * (low + high)
    for _ in range(80):
        d, slope = gap_at(x, motion)
        if d < level:
            low = x
        else:
            high = x
        step = (d - level) / slope if slope != 0.0 else math.inf
        guess = x - step
        if not min(low, high) < guess < max(low, high):
            guess = 0.5 * (low + high)
        if abs(guess - x) < 1e-15:
            return guess
        x = guess
    return x


@lean
def bottom(motion: Motion) -> float:
    """Return the phase of the closest gap, next to pi."""
    _, amplitude, b = motion
    theta = math.pi
    for _ in range(20):
        turn = complex(math.cos(theta), math.sin(theta))
        slope, bend, power = -amplitude * turn.imag, -amplitude * turn.real, turn
        for n in range(2, b.shape[0]):
            power *= turn
            slope -= n * (b[n].real * power.imag + b[n].imag * power.real)
            bend -= n * n * (b[n].real * power.real - b[n].imag * power.imag)
        if not bend > 0.0:
            break
        step = min(max(slope / bend, -0.3), 0.3)
        theta -= step
        if abs(step) < 1e-15:
            break
    return theta


# --- the force on it --------------------------------------------------------------------------------------------

# what a sum over the motion collects beside the harmonics
LOWEST, PEAK, PULL, CONTACT, WORK, TOUCHES = 0, 1, 2, 3, 4, 5
EXTRAS = 6


@inner
def _sample(
    theta: float,
    weight: float,
    motion: Motion,
    omega: float,
    table: _Floats,
    inside: bool,
    held: bool,
    side: float,
    sums: Sums,
) -> None:
    """Add one phase to the harmonics of the force (f) and of its derivatives by gap (P) and velocity (S)."""
    g, amplitude, b = motion
    f, P, S, extras, turns = sums
    turn = complex(math.cos(theta), math.sin(theta))
    d, slope = g + amplitude * turn.real, -amplitude * turn.imag
    turns[0], turns[1] = 1.0, turn
    for n in range(2, turns.shape[0]):
        turns[n] = turns[n - 1] * turn
    for n in range(2, b.shape[0]):
        d += b[n].real * turns[n].real - b[n].imag * turns[n].imag
        slope -= n * (b[n].real * turns[n].imag + b[n].imag * turns[n].real)
    v = omega * slope
    force = law_force(table, d, v, inside, held)
    scaled = weight / math.pi
    share = force * scaled
    f[0] += 0.5 * share
    for n in range(1, f.shape[0]):
        f[n] += share * turns[n].conjugate()
    extras[PEAK] = max(extras[PEAK], force)
    extras[PULL] = min(extras[PULL], force)
    extras[WORK] -= force * slope * weight  # per cycle
    if d < g and side * slope < -1e-9 * amplitude:  # back towards the surface before the far turning point
        extras[TOUCHES] += 1.0
    if P.shape[0]:
        by_gap, by_velocity = law_slopes(table, d, v, inside, held)
        by_gap *= scaled
        for n in range(P.shape[0]):
            P[n] += by_gap * turns[n].conjugate()
        by_velocity *= scaled
        if by_velocity != 0.0:
            for n in range(S.shape[0]):
                S[n] += by_velocity * turns[n].conjugate()


@inner
def _piece(
    left: float,
    right: float,
    coarse: bool,
    motion: Motion,
    omega: float,
    table: _Floats,
    inside: bool,
    held: bool,
    side: float,
    sums: Sums,
) -> None:
    """Add a stretch of phase on which the force is smooth."""
    half, middle = 0.5 * (right - left), 0.5 * (right + left)
    nodes, weights = (_NODES, _WEIGHTS) if coarse else (_EDGE_NODES, _EDGE_WEIGHTS)
    for j in range(nodes.shape[0]):
        theta, weight = middle + half * nodes[j], abs(half) * weights[j]
        _sample(theta, weight, motion, omega, table, inside, held, side, sums)


@inner
def _last_piece(
    left: float,
    end: float,
    motion: Motion,
    omega: float,
    table: _Floats,
    inside: bool,
    held: bool,
    side: float,
    sums: Sums,
) -> None:
    """Add the stretch up to a level: theta = end - span s^2 turns the onset of contact into a smooth power of s."""
    span = end - left
    for j in range(_EDGE_NODES.shape[0]):
        s = 0.5 * (1.0 + _EDGE_NODES[j])
        theta, weight = end - span * s * s, _EDGE_WEIGHTS[j] * abs(span) * s
        _sample(theta, weight, motion, omega, table, inside, held, side, sums)


@inner
def _add_jump(theta: float, outwards: float, motion: Motion, P: _Complex) -> None:
    """Add what a jump of the force at a level does to its derivative by the gap: the level is met earlier or later.

    ``outwards`` is the change of the force with rising gap, so that the jump is ``outwards delta(d - level)``.
    """
    slope = abs(gap_at(theta, motion)[1])
    if outwards == 0.0 or slope == 0.0:
        return
    back = complex(math.cos(theta), -math.sin(theta))
    power = complex(outwards / (slope * math.pi), 0.0)
    for n in range(P.shape[0]):
        P[n] += power
        power *= back


@inner
def force_on_motion(
    motion: Motion,
    omega: float,
    law: Law,
    sums: Sums,
) -> None:
    """Fill the harmonics of the force on a motion, those of its derivatives, and what else a cycle has.

    ``P`` and ``S`` may be empty. Assumes one approach and one retraction a period.
    """
    f, P, S, extras, _ = sums
    levels, kinks = law.levels, law.kinks
    f[:] = 0.0
    P[:] = 0.0
    S[:] = 0.0
    extras[:] = 0.0
    lowest = bottom(motion)
    closest, _ = gap_at(lowest, motion)
    farthest, _ = gap_at(lowest + math.pi, motion)
    extras[LOWEST] = closest
    if not (math.isfinite(closest) and math.isfinite(farthest)):
        f[:] = math.nan
        return
    touched = closest < law.made
    kept = touched and farthest <= law.lost  # a contact that the motion never breaks
    tail = has_tail(law.table)
    reach = tail_range(law.table)
    orders = max(f.shape[0] - 1, 10)
    for way in range(2):
        side = 1.0 if way else -1.0
        far = lowest + side * math.pi
        start = lowest
        for k in range(kinks + 1):
            level = levels[k] if k < kinks else math.inf
            if level <= closest:
                continue
            end = far if k == kinks else _crossing(level, lowest, far, motion)
            inside = level <= 0.0
            held = kept or (touched and level <= (law.lost if way else law.made))
            if start != end and (inside or held or tail or k < kinks):
                graded = tail and not inside
                width = _WIDEST_EDGE / orders
                if graded:
                    # where the gap has grown by about a0, linearly from contact or quadratically from the bottom
                    width = math.sqrt(2.0 * (reach + max(closest, 0.0)) / motion.amplitude)
                    if start != lowest:
                        width = min(width, reach / max(abs(gap_at(start, motion)[1]), 1e-300))
                if not width > _NARROWEST:
                    width = _NARROWEST
                left = start
                while True:
                    width = min(width, (_WIDEST_PIECE if graded else _WIDEST_EDGE) / orders)
                    if abs(end - left) <= 1.5 * width:
                        break
                    right = left + side * width
                    _piece(left, right, graded, motion, omega, law.table, inside, held, side, sums)
                    left = right
                    if graded:
                        width *= 2.0
                if end == far:
                    _piece(left, end, graded, motion, omega, law.table, inside, held, side, sums)
                else:
                    _last_piece(left, end, motion, omega, law.table, inside, held, side, sums)
            if inside:
                extras[CONTACT] += abs(end - start) / (2.0 * math.pi)
            if end == far:
                break
            if P.shape[0]:
                level_beyond = levels[k + 1] if k + 1 < kinks else math.inf
                held_beyond = kept or (touched and level_beyond <= (law.lost if way else law.made))
                v = omega * gap_at(end, motion)[1]
                near = law_force(law.table, level, v, inside, held)
                away = law_force(law.table, level, v, level_beyond <= 0.0, held_beyond)
                _add_jump(end, away - near, motion, P)
            start = end


# --- the balance ------------------------------------------------------------------------------------------------


@inner
def solve_in_place(matrix: _Floats, right: _Floats) -> float:
    """Solve by elimination with pivots, the answer in ``right``; return the sign of the determinant, 0 if singular."""
    size, sign = right.shape[0], 1.0
    for k in range(size):
        pivot = k
        for i in range(k + 1, size):
            if abs(matrix[i, k]) > abs(matrix[pivot, k]):
                pivot = i
        if not abs(matrix[pivot, k]) > 0.0:
            return 0.0
        if pivot != k:
            sign = -sign
            for j in range(k, size):
                matrix[k, j], matrix[pivot, j] = matrix[pivot, j], matrix[k, j]
            right[k], right[pivot] = right[pivot], right[k]
        if matrix[k, k] < 0.0:
            sign = -sign
        for i in range(k + 1, size):
            factor = matrix[i, k] / matrix[k, k]
            if factor != 0.0:
                for j in range(k + 1, size):
                    matrix[i, j] -= factor * matrix[k, j]
                right[i] -= factor * right[k]
    for k in range(size - 1, -1, -1):
        total = right[k]
        for j in range(k + 1, size):
            total -= matrix[k, j] * right[j]
        right[k] = total / matrix[k, k]
    return sign


@inner
def _response(n: int, m: int, omega: float, P: _Complex, S: _Complex) -> tuple[complex, complex]:
    """Return df_n by b_m, as the factors of b_m and of its conjugate."""
    plain, mirrored = P[n + m], 0.0j
    plain_v, mirrored_v = S[n + m], 0.0j
    if n >= m:
        mirrored, mirrored_v = P[n - m], S[n - m]
    else:
        mirrored, mirrored_v = P[m - n].conjugate(), S[m - n].conjugate()
    half = 0.25 if n == 0 else 0.5  # the mean has half the weight of a harmonic
    turn = 1j * omega * m
    return half * (mirrored + turn * mirrored_v), half * (plain - turn * plain_v)


@inner
def _fill_matrix(
    matrix: _Floats,
    x: _Floats,
    held: _Floats,
    lever: Lever,
    P: _Complex,
    S: _Complex,
    steered: int,
    unit: float,
) -> None:
    """Fill the derivatives of what is left of the balance.

    Columns: g, A, phi, Z, then real and imaginary part of b_2, b_3, ...; rows: the mean, the first harmonic, what
    is held, then the others. Lengths are in units of the free amplitude.
    """
    tip = lever.tip
    matrix[:] = 0.0
    matrix[0, 0], matrix[0, 3] = 1.0 - 0.5 * tip[0].real * P[0].real, -1.0
    ahead = complex(math.cos(x[2]), math.sin(x[2]))
    toward = -1j * tip[1] * lever.force * ahead / unit
    matrix[1, 2], matrix[2, 2] = toward.real, toward.imag
    if held[0] == HOLD_HEIGHT:
        matrix[3, 3] = 1.0
    elif held[0] == HOLD_AMPLITUDE:
        read = lever.reading[0] * x[1] + lever.reading[1] * ahead
        back = read.conjugate() / abs(read)
        matrix[3, 1] = (back * lever.reading[0]).real
        matrix[3, 2] = (back * 1j * lever.reading[1] * ahead).real / unit
    else:
        matrix[3, 0], matrix[3, 1] = held[1], held[2]
    for n in range(1, steered + 1):
        row = 1 if n == 1 else 2 * n
        by_gap = -tip[n] * P[n]
        matrix[row, 0], matrix[row + 1, 0] = by_gap.real, by_gap.imag
    for m in range(1, steered + 1):
        column = 1 if m == 1 else 2 * m
        for n in range(steered + 1):
            row = n if n < 2 else 2 * n
            factor, mirror = _response(n, m, lever.omega, P, S)
            by_real, by_imag = -tip[n] * (factor + mirror), -1j * tip[n] * (factor - mirror)
            if n == m:
                by_real += 1.0
                by_imag += 1j
            matrix[row, column] = by_real.real
            if n:
                matrix[row + 1, column] = by_real.imag
            if m > 1:
                matrix[row, column + 1] = by_imag.real
                if n:
                    matrix[row + 1, column + 1] = by_imag.imag


@inner
def _fill_right(
    right: _Floats,
    x: _Floats,
    b: _Complex,
    held: _Floats,
    lever: Lever,
    f: _Complex,
    steered: int,
    unit: float,
) -> float:
    """Fill what is left of the balance, negative, and return its size relative to the drive."""
    tip = lever.tip
    ahead = complex(math.cos(x[2]), math.sin(x[2]))
    mean = x[0] - tip[0].real * f[0].real - x[3]
    first = x[1] - tip[1] * (f[1] + lever.force * ahead)
    if held[0] == HOLD_HEIGHT:
        last = x[3] - held[1]
    elif held[0] == HOLD_AMPLITUDE:
        last = abs(lever.reading[0] * x[1] + lever.reading[1] * ahead) - held[1]
    else:
        last = held[1] * x[0] + held[2] * x[1] - held[3]
    left = max(abs(mean / tip[0]), abs(first / tip[1])) / lever.force
    right[0], right[1], right[2], right[3] = (
        -mean / unit,
        -first.real / unit,
        -first.imag / unit,
        -last / unit,
    )
    for n in range(2, steered + 1):
        rest = b[n] - tip[n] * f[n]
        left = max(left, abs(rest / tip[n]) / lever.force)
        right[2 * n], right[2 * n + 1] = -rest.real / unit, -rest.imag / unit
    return float(max(left, abs(last) / unit))


@inner
def _even_rows(matrix: _Floats, right: _Floats) -> None:
    """Bring rows to like size, so that pivots are compared fairly."""
    for i in range(right.shape[0]):
        largest = 0.0
        for j in range(right.shape[0]):
            largest = max(largest, abs(matrix[i, j]))
        if largest > 0.0:
            right[i] /= largest
            for j in range(right.shape[0]):
                matrix[i, j] /= largest


@inner
def _iterate(
    x: _Floats,
    b: _Complex,
    held: _Floats,
    lever: Lever,
    law: Law,
    f: _Complex,
    extras: _Floats,
    steered: int,
) -> tuple[int, float, float]:
    """Solve the balance in place, so many harmonics by Newton's method and the others by substitution."""
    orders = b.shape[0]
    size = max(4, 2 * steered + 2)
    P, S = np.empty(2 * steered + 1, np.complex128), np.zeros(2 * steered + 1, np.complex128)
    # where nothing depends on velocity its derivatives stay zero and are not summed
    turns = np.empty(max(orders, 2 * steered + 1), np.complex128)
    full = Sums(f, P, S if has_viscosity(law.table) else S[:0], extras, turns)
    plain = Sums(f, P[:0], S[:0], extras, turns)
    matrix, factors, right = np.empty((size, size)), np.empty((size, size)), np.empty(size)
    unit = abs(lever.tip[1]) * lever.force
    sign, older, before, left = 0.0, math.inf, math.inf, math.inf
    for _ in range(_ITERATIONS):
        if not x[1] > 0.0:
            return NOT_CONVERGED, 0.0, math.inf
        # close to the end the derivatives of the step before serve as well, and cost nothing
        steer = sign == 0.0 or left > _CLOSE or left > 0.1 * older
        force_on_motion(Motion(x[0], x[1], b), lever.omega, law, full if steer else plain)
        left = _fill_right(right, x, b, held, lever, f, steered, unit)
        for n in range(steered + 1, orders):
            left = max(left, abs(b[n] / lever.tip[n] - f[n]) / lever.force)
            b[n] = lever.tip[n] * f[n]
        if not left < _LOST:
            return NOT_CONVERGED, 0.0, math.inf
        if sign != 0.0 and (left < _TOLERANCE or (left < _STALLED and left >= 0.5 * before)):
            return (FOUND if extras[TOUCHES] == 0.0 else MANY_TOUCHES), sign, left
        if steer:
            _fill_matrix(matrix, x, held, lever, P, S, steered, unit)
        factors[:] = matrix
        _even_rows(factors, right)
        sign = solve_in_place(factors, right)
        if sign == 0.0:
            return NOT_CONVERGED, 0.0, left
        older, before = before, left
        # no further in one step than the force keeps its shape
        step = max(abs(right[0]), abs(right[1])) * unit
        shrink = min(1.0, _LONGEST_STEP * x[1] / step) if step > 0.0 else 1.0
        if abs(right[2]) * shrink > _WIDEST_TURN:
            shrink = _WIDEST_TURN / abs(right[2])
        x[0] += shrink * right[0] * unit
        x[1] += shrink * right[1] * unit
        x[2] += shrink * right[2]
        x[3] += shrink * right[3] * unit
        for n in range(2, steered + 1):
            b[n] += shrink * unit * complex(right[2 * n], right[2 * n + 1])
    return NOT_CONVERGED, sign, left


@kernel
def balance(
    x: _Floats, b: _Complex, held: _Floats, lever: Lever, law: Law, f: _Complex, extras: _Floats
) -> tuple[int, float, float]:
    """Solve the balance from a guess, in place.

    Parameters
    ----------
    x : array (4,)
        Mean gap g [m], tip amplitude A [m], phase phi of the equivalent force before the tip [rad], height Z [m].
    b : array (n,)
        Harmonics of the motion [m]; members 0 and 1 are not used.
    held : array (4,)
        What the last equation holds: `HOLD_HEIGHT` and Z, `HOLD_AMPLITUDE` and the amplitude that is read, or
        `HOLD_LINE` and p, q, s of ``p g + q A = s``.
    lever, law
        Probe and sample.
    f : array (n,)
        Filled with the harmonics of the force [N], CONS_n - i DISS_n.
    extras : array (EXTRAS,)
        Filled as `Sums` says.

    Returns
    -------
    status : int
        FOUND, NOT_CONVERGED or MANY_TOUCHES.
    sign : float
        Of the determinant of the Jacobian at the end: it changes at a fold.
    left : float
        What is left of the balance relative to the drive, largest of all harmonics.
    """
    orders = b.shape[0]
    if orders - 1 <= STEERED:
        return _iterate(x, b, held, lever, law, f, extras, orders - 1)
    # where an attraction is steep against a soft lever, substitution runs away: then all by Newton's method
    start, motion = x.copy(), b.copy()
    for steered in (STEERED, orders - 1):
        status, sign, left = _iterate(x, b, held, lever, law, f, extras, steered)
        if status != NOT_CONVERGED:
            break
        if steered == STEERED:
            x[:], b[:] = start, motion
    return status, sign, left


@kernel
def balance_block(
    x: _Floats,
    b: _Complex,
    held: _Floats,
    lever: Lever,
    law: Law,
    f: _Complex,
    extras: _Floats,
    status: npt.NDArray[np.int8],
    sign: _Floats,
) -> None:
    """Solve the balance for every state under one law."""
    for i in range(x.shape[0]):
        status[i], sign[i], _ = balance(x[i], b[i], held[i], lever, law, f[i], extras[i])
