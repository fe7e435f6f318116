"""Time integration of the tip over a sample, with every contact transition located: kernels.

The modes of the lever obey, in the phase ``theta = w t`` of the drive and with ``r_j = w_j / w``,

    q_j'' = -r_j^2 q_j - (r_j / Q_j) q_j' + r_j^2 [F(d, w d') / k_j + Re(modal_j exp(i theta))]
    d = Z + sum_j q_j + Re(direct exp(i theta)) + C F

with the gap d, the force law F and, where modes were left out, their compliance C. They give way to the
elastic part of F only: a spring without mass has no motion of its own under a dashpot that begins and ends.
Lengths are in units of the free amplitude, forces in newton.

A force law is smooth between certain gaps only. The integrator freezes the side it is on, of each of them,
and whether contact is held; a step that would pass one of these gaps is shortened until it ends there, and
the side is changed before the next one. So every step sees a smooth force, and the order of the method
holds. The harmonics of the motion are not summed over steps, which would have to be short for that: the
equation of motion gives them from those of the force, to which free flight adds next to nothing, and from
how much the state has changed over the period.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from overtone.contact.law import has_tail, has_viscosity, law_force, law_slopes, tail_range
from overtone.dynamics.dop853 import E3, E5, STAGES, A, B, C
from overtone.kernels import inner, kernel

DONE, NOT_SETTLED, TOO_MANY_STEPS, STEP_TOO_SMALL, NOT_FINITE, CHATTER = range(6)

PERIOD = 2.0 * math.pi
NUMBERS = 5  # of a record, in these columns
WORK, CLOSEST, PEAK, PULL, CONTACT = range(NUMBERS)
# columns of the modes of a lever: r_j^2, r_j / Q_j, r_j^2 / k_j [length/N], the real and imaginary part of
# r_j^2 times the static deflection under the drive, and what the detector reads of the mode
SQUARE, DAMPING, MOBILITY, PUSH, PUSH_ACROSS, WEIGHT = range(6)
# lines of a workspace; the last three, deflection, velocity and acceleration, for every mode
_COSINE, _SINE, _POINT, _RATE, _BEND, _GAP, _FORCE, _Q, _V, _A = range(10)

_WIDEST = PERIOD / 8.0  # of a step: the quintic of the gap then misses no passage
WIDEST_MODE = PERIOD / 4.0  # in the phase of the fastest mode
_FINE_MODE = PERIOD / 10.0  # where a small disturbance of it shall be followed to many digits
_WIDEST_HARMONIC = 2.0  # in the phase of the highest harmonic that is summed
_FIRST = 0.1
_TAIL_RATIO = 3.0  # by which the distance to the singularity of a tail may change in a step
_DIFFERENCE = 1e-6  # of a state, for derivatives
_NEWTON_STEPS = 12
_TRUST = 0.05  # how far a step of Newton's method may lead
_STRETCH = 0.25  # of the lever's memory, to follow the motion before Newton's method is tried again
_SQUARINGS = 24
_SMALLEST = 1e-14
_STEPS_A_PERIOD = 20_000
_FLIPS = 64  # at one instant
_LANDING_TRIES = 24
_YIELDING_TRIES = 60
_LANDING_STEPS = 2  # about what it takes
_LANDING = 1e-3  # how near to a level is on it, in units of the tolerance
_SHRINK, _GROW, _SAFETY = 0.2, 6.0, 0.9

_END = STAGES  # row of the end of a step
_AFTER = STAGES + 1  # where it is kept while the step is probed
# where in the step a row is: the stages, and the end of the step
_WHERE = np.append(C, 1.0)
_WHERE.setflags(write=False)
_WEIGHTS = np.vstack([A, B])
_WEIGHTS.setflags(write=False)

# cos x and sin(x)/x in powers of x^2, to rounding for the steps made here
_TERMS = 9
_COSINE_SERIES = np.array([(-1.0) ** k / math.factorial(2 * k) for k in range(_TERMS)])
_SINE_SERIES = np.array([(-1.0) ** k / math.factorial(2 * k + 1) for k in range(_TERMS)])
_COSINE_SERIES.setflags(write=False)
_SINE_SERIES.setflags(write=False)

_Floats = npt.NDArray[np.float64]
_Complex = npt.NDArray[np.complex128]
_Integers = npt.NDArray[np.int64]


class Lever(NamedTuple):
    """The cantilever and its drive, lengths in units of ``length``."""

    modes: _Floats
    """(mode, column), see `SQUARE` and the names after it."""
    direct: complex
    """Motion of the gap without any mode."""
    direct_reading: complex
    """What of that the detector reads."""
    compliance: float
    """Of the modes left out, at the tip [length/N]."""
    compliance_reading: float
    """As it is read [length/N]."""
    length: float
    """Unit of length [m]."""
    speed: float
    """Unit of velocity, w times that of length [m/s]."""


class Contact(NamedTuple):
    """The force law of a point, and where it is not smooth; gaps in the lever's unit of length."""

    law: _Floats
    """(term, column), see `overtone.contact.law`."""
    levels: _Floats
    """(level,): gaps at which it is not smooth, rising, the first ``kinks`` of them."""
    kinks: int
    zero: int
    """Which of them is gap 0; -1 for none."""
    made: int
    """Which of them makes a contact that holds; -1 for none."""
    lost: int
    """Which of them lets go of it; -1 for none."""


class Record(NamedTuple):
    """What is summed over an interval."""

    moments: _Complex
    """(harmonic,): integrals of the force times exp(-i n theta) [N]."""
    numbers: _Floats
    """(5,): work of the force on the gap [N length], smallest gap, largest force and smallest, if they push and
    pull [N], and phase in contact, by the side of gap 0."""


@inner
def workspace(modes: int) -> _Floats:
    """Return scratch for a lever of so many modes: columns for the stages of a step, its end, and a spare one.

    Its lines are cosine and sine of theta, the ``point`` d - C F and its first two derivatives by theta, the
    gap, the force [N], and deflections, velocities and accelerations of the modes.
    """
    return np.empty((_Q + 3 * modes, STAGES + 2))


@inner
def new_record(n_max: int) -> Record:
    """Return a record for the harmonics 0 to n_max of the force."""
    return Record(np.empty(n_max + 1, np.complex128), np.empty(NUMBERS))


@inner
def clear(record: Record) -> None:
    """Begin a record anew."""
    record.moments[:] = 0.0
    record.numbers[:] = 0.0
    record.numbers[CLOSEST] = math.inf


# --- the right side ---------------------------------------------------------------------------------------------


@inner
def _yielding_gap(
    lever: Lever, contact: Contact, point: float, rate: float, inside: bool, held: bool
) -> tuple[float, float]:
    """Return the gap and the force [N] where the modes hold the tip at ``point`` and others give way.

    ``d = point + C F(d)`` for a tip at rest, by secants in a bracket: a contact may be far stiffer than 1/C.
    """
    gap, force = point, law_force(contact.law, point * lever.length, 0.0, inside, held)
    miss = -lever.compliance * force
    before, miss_before = gap, miss
    low, high = (gap, math.inf) if miss < 0.0 else (-math.inf, gap)
    gap -= miss
    for _ in range(_YIELDING_TRIES):
        if miss == 0.0:
            break
        force = law_force(contact.law, gap * lever.length, 0.0, inside, held)
        miss = gap - point - lever.compliance * force
        if miss < 0.0:
            low = gap
        else:
            high = gap
        if abs(miss) <= 1e-16 * (1.0 + abs(point)) or high - low <= 1e-16 * (1.0 + abs(point)):
            break
        step = miss * (gap - before) / (miss - miss_before) if miss != miss_before else math.inf
        before, miss_before = gap, miss
        gap -= step
        if not low < gap < high:
            # without a bracket attraction grows faster than the lever pulls back, and the root is farther out
            gap = 0.5 * (low + high) if math.isfinite(high - low) else before - 2.0 * miss
    if has_viscosity(contact.law):
        stiffness, _ = law_slopes(contact.law, gap * lever.length, 0.0, inside, held)
        velocity = rate * lever.speed / (1.0 - lever.compliance * lever.length * stiffness)
        force = law_force(contact.law, gap * lever.length, velocity, inside, held)
    return gap, force


@inner
def _evaluate(
    lever: Lever,
    contact: Contact,
    Z: float,
    slope: float,
    length: float,
    inside: bool,
    held: bool,
    work: _Floats,
    first: int,
    last: int,
) -> None:
    """Fill gap, force and accelerations of rows of a step, and the deflections and velocities of all but row 0.

    All rows in one call: at some ten nanoseconds a row, passing the arguments would be what costs.
    """
    modes = lever.modes.shape[0]
    for row in range(first, last + 1):
        if row > 0:
            for j in range(modes):
                dq, dv = 0.0, 0.0
                for k in range(row):
                    dq += _WEIGHTS[row, k] * work[_V + 3 * j, k]
                    dv += _WEIGHTS[row, k] * work[_A + 3 * j, k]
                work[_Q + 3 * j, row] = work[_Q + 3 * j, 0] + length * dq
                work[_V + 3 * j, row] = work[_V + 3 * j, 0] + length * dv
        cosine, sine = work[_COSINE, row], work[_SINE, row]
        point = Z + slope * _WHERE[row] * length + lever.direct.real * cosine - lever.direct.imag * sine
        rate = slope - lever.direct.real * sine - lever.direct.imag * cosine
        for j in range(modes):
            point += work[_Q + 3 * j, row]
            rate += work[_V + 3 * j, row]
        if lever.compliance == 0.0:
            gap = point
            force = law_force(contact.law, gap * lever.length, rate * lever.speed, inside, held)
        else:
            gap, force = _yielding_gap(lever, contact, point, rate, inside, held)
        bend = lever.direct.imag * sine - lever.direct.real * cosine
        for j in range(modes):
            a = (
                lever.modes[j, MOBILITY] * force
                + (lever.modes[j, PUSH] * cosine - lever.modes[j, PUSH_ACROSS] * sine)
                - lever.modes[j, SQUARE] * work[_Q + 3 * j, row]
                - lever.modes[j, DAMPING] * work[_V + 3 * j, row]
            )
            work[_A + 3 * j, row] = a
            bend += a
        work[_POINT, row], work[_RATE, row], work[_BEND, row] = point, rate, bend
        work[_GAP, row], work[_FORCE, row] = gap, force


@inner
def _turn_rows(length: float, work: _Floats) -> None:
    """Fill cosine and sine of theta of every row but the first, by series: steps are short."""
    c0, s0 = work[_COSINE, 0], work[_SINE, 0]
    for row in range(1, STAGES + 1):
        x = _WHERE[row] * length
        y = x * x
        c, s = _COSINE_SERIES[_TERMS - 1], _SINE_SERIES[_TERMS - 1]
        for k in range(2, _TERMS + 1):
            c = c * y + _COSINE_SERIES[_TERMS - k]
            s = s * y + _SINE_SERIES[_TERMS - k]
        s *= x
        work[_COSINE, row] = c0 * c - s0 * s
        work[_SINE, row] = s0 * c + c0 * s


@inner
def _step(
    lever: Lever,
    contact: Contact,
    Z: float,
    slope: float,
    length: float,
    inside: bool,
    held: bool,
    tolerance: float,
    work: _Floats,
) -> float:
    """Make a step from the first row to the end row; return its error in units of the tolerance."""
    modes = lever.modes.shape[0]
    _turn_rows(length, work)
    _evaluate(lever, contact, Z, slope, length, inside, held, work, 1, _END)
    fifth, third = 0.0, 0.0
    for j in range(modes):
        q5, v5, q3, v3 = 0.0, 0.0, 0.0, 0.0
        for k in range(STAGES):
            q5 += E5[k] * work[_V + 3 * j, k]
            v5 += E5[k] * work[_A + 3 * j, k]
            q3 += E3[k] * work[_V + 3 * j, k]
            v3 += E3[k] * work[_A + 3 * j, k]
        # a fast mode moves at a speed r_j times its deflection
        scale = 1.0 / max(1.0, lever.modes[j, SQUARE])
        fifth += q5 * q5 + v5 * v5 * scale
        third += q3 * q3 + v3 * v3 * scale
    if fifth == 0.0:
        return 0.0
    return length * fifth / (tolerance * math.sqrt(2.0 * modes * (fifth + 0.01 * third)))


@inner
def _copy_row(work: _Floats, source: int, target: int) -> None:
    """Copy the state and what was evaluated from it."""
    for k in range(work.shape[0]):
        work[k, target] = work[k, source]


# --- where a step meets a gap -----------------------------------------------------------------------------------


@inner
def _quintic(x: float, c: tuple[float, float, float, float, float, float]) -> tuple[float, float, float]:
    """Return a polynomial of degree 5 and its first two derivatives."""
    value = c[0] + x * (c[1] + x * (c[2] + x * (c[3] + x * (c[4] + x * c[5]))))
    slope = c[1] + x * (2.0 * c[2] + x * (3.0 * c[3] + x * (4.0 * c[4] + x * 5.0 * c[5])))
    bend = 2.0 * c[2] + x * (6.0 * c[3] + x * (12.0 * c[4] + x * 20.0 * c[5]))
    return value, slope, bend


@inner
def _hermite(work: _Floats, length: float) -> tuple[float, float, float, float, float, float]:
    """Return the quintic through point, slope and bend at both ends of a step, in the fraction of the step."""
    p0, v0, b0 = work[_POINT, 0], work[_RATE, 0] * length, 0.5 * work[_BEND, 0] * length * length
    p1, v1 = work[_POINT, _END], work[_RATE, _END] * length
    b1 = 0.5 * work[_BEND, _END] * length * length
    rise = p1 - p0 - v0 - b0
    turn = v1 - v0 - 2.0 * b0
    curl = b1 - b0
    return (
        p0,
        v0,
        b0,
        10.0 * rise - 4.0 * turn + curl,
        -15.0 * rise + 7.0 * turn - 2.0 * curl,
        6.0 * rise - 3.0 * turn + curl,
    )


@inner
def _root(
    c: tuple[float, float, float, float, float, float],
    order: int,
    level: float,
    low: float,
    high: float,
    sign: float,
) -> float:
    """Return where a quintic (order 0) or its slope (order 1) meets a level, rising with ``sign`` 1."""
    x = 0.5 * (low + high)
    for _ in range(60):
        value, slope, bend = _quintic(x, c)
        miss, change = (value - level, slope) if order == 0 else (slope - level, bend)
        if miss * sign < 0.0:
            low = x
        else:
            high = x
        guess = x - miss / change if change != 0.0 else low
        if not low < guess < high:
            guess = 0.5 * (low + high)
        if abs(guess - x) < 1e-13:
            return guess
        x = guess
    return x


class _Passage(NamedTuple):
    """Where a step first meets a level, as a fraction of it."""

    direction: int
    """1 upwards, -1 downwards, 0 for no level met."""
    guess: float
    before: float
    """The level is met after this."""
    behind: float
    """The level is met before this."""
    bottom: float
    """Where the gap is smallest, if that is inside the step; else negative."""


@inner
def _first_passage(low: float, high: float, length: float, work: _Floats) -> _Passage:
    """Return where a step leaves the region between two points."""
    start, end, point = work[_RATE, 0], work[_RATE, _END], work[_POINT, _END]
    turns = start * end < 0.0
    below, above = point < low, point > high
    if not (turns or below or above):
        return _Passage(0, 0.0, 0.0, 0.0, -1.0)
    c = _hermite(work, length)
    turning, bottom = 0.0, -1.0
    if turns:
        turning = _root(c, 1, 0.0, 0.0, 1.0, 1.0 if end > 0.0 else -1.0)
        farthest = _quintic(turning, c)[0]
        if end > 0.0:
            bottom = turning
            if farthest < low:
                return _Passage(-1, _root(c, 0, low, 0.0, turning, -1.0), 0.0, turning, bottom)
        elif farthest > high:
            return _Passage(1, _root(c, 0, high, 0.0, turning, 1.0), 0.0, turning, bottom)
    if below:
        return _Passage(-1, _root(c, 0, low, turning, 1.0, -1.0), turning, 1.0, bottom)
    if above:
        return _Passage(1, _root(c, 0, high, turning, 1.0, 1.0), turning, 1.0, bottom)
    return _Passage(0, 0.0, 0.0, 0.0, bottom)


@inner
def _land(
    lever: Lever,
    contact: Contact,
    Z: float,
    slope: float,
    length: float,
    passage: _Passage,
    level: float,
    inside: bool,
    held: bool,
    tolerance: float,
    landing: float,
    work: _Floats,
) -> tuple[float, float]:
    """Shorten a step until it ends on a level; return its length and its error.

    Where the step only seemed to meet the level, it ends at the gap nearest to it.
    """
    before, behind, x = passage.before, passage.behind, passage.guess
    error = 0.0
    for _ in range(_LANDING_TRIES):
        error = _step(lever, contact, Z, slope, x * length, inside, held, tolerance, work)
        miss = work[_POINT, _END] - level
        if abs(miss) <= landing or not math.isfinite(error):
            break
        if miss * passage.direction < 0.0:
            before = x
        else:
            behind = x
        rate, bend = work[_RATE, _END] * length, work[_BEND, _END] * length * length
        x -= 2.0 * miss / (rate + math.copysign(math.sqrt(max(rate * rate - 2.0 * miss * bend, 0.0)), rate))
        if not before < x < behind:
            x = 0.5 * (before + behind)
    return x * length, error


# --- sides ------------------------------------------------------------------------------------------------------


@inner
def _cross(contact: Contact, mode: _Integers, direction: int) -> None:
    """Go to the next region; a contact is made or lost on the way."""
    if direction > 0:
        if mode[0] == contact.lost:
            mode[1] = 0
        mode[0] += 1
    else:
        mode[0] -= 1
        if mode[0] == contact.made:
            mode[1] = 1


@inner
def _inside(contact: Contact, mode: _Integers) -> bool:
    """Return whether the tip is on the lower side of gap 0."""
    return contact.zero >= 0 and mode[0] <= contact.zero


@inner
def _bounds(lever: Lever, contact: Contact, mode: _Integers) -> tuple[float, float]:
    """Return between which points the tip is in its region: where the gap is at its levels."""
    inside, held = _inside(contact, mode), mode[1] > 0
    low, high = -math.inf, math.inf
    if mode[0] > 0:
        low = contact.levels[mode[0] - 1]
    if mode[0] < contact.kinks:
        high = contact.levels[mode[0]]
    if lever.compliance != 0.0:
        if mode[0] > 0:
            low -= lever.compliance * law_force(contact.law, low * lever.length, 0.0, inside, held)
        if mode[0] < contact.kinks:
            high -= lever.compliance * law_force(contact.law, high * lever.length, 0.0, inside, held)
    return low, high


@inner
def _place(lever: Lever, contact: Contact, mode: _Integers, work: _Floats) -> None:
    """Find the region of the first row; ``held`` is kept where the gap allows both."""
    point = work[_POINT, 0]
    for _ in range(2):
        for region in range(contact.kinks + 1):
            mode[0] = region
            _, high = _bounds(lever, contact, mode)
            if point < high or (point == high and work[_RATE, 0] < 0.0):
                break
        if contact.made < 0 or contact.lost < 0 or mode[0] > contact.lost:
            mode[1] = 0
        elif mode[0] <= contact.made:
            mode[1] = 1


@inner
def _wrong_side(low: float, high: float, landing: float, work: _Floats) -> int:
    """Return to which side of its region the first row must go before a step, 0 if it is where it belongs.

    On a bound the velocity decides, and where it vanishes the acceleration.
    """
    point = work[_POINT, 0]
    motion = work[_RATE, 0] if work[_RATE, 0] != 0.0 else work[_BEND, 0]
    if point < low - landing or (point <= low + landing and motion < 0.0):
        return -1
    if point > high + landing or (point >= high - landing and motion > 0.0):
        return 1
    return 0


@inner
def _reach(distance: float, rate: float, bend: float) -> float:
    """Return when a motion covers a distance for the first time, infinity for never."""
    square = rate * rate + 2.0 * bend * distance
    if square < 0.0:
        return math.inf
    if rate > 0.0:
        return 2.0 * distance / (rate + math.sqrt(square))
    return (math.sqrt(square) - rate) / bend if bend > 0.0 else math.inf


@inner
def _tail_limit(tail: float, work: _Floats) -> float:
    """Return how long a step in the tail of an attraction may be, whose singularity is its range behind gap 0.

    A step that goes most of the way there, or starts there, is outside the circle in which the force is a
    power series of time, and its estimate of the error means nothing.
    """
    span = max(work[_GAP, 0], 0.0) + tail
    rate = work[_RATE, 0]
    if rate < 0.0:
        return float(-(1.0 - 1.0 / _TAIL_RATIO) * span / rate)
    return (_TAIL_RATIO - 1.0) * span / rate if rate > 0.0 else math.inf


@inner
def _aim(low: float, high: float, work: _Floats) -> float:
    """Return about how long a step is that ends on a bound of its region.

    A step well beyond it would see the force of the wrong side, which is not smooth there, and be refused.
    """
    point, rate, bend = work[_POINT, 0], work[_RATE, 0], work[_BEND, 0]
    length = math.inf
    if low > -math.inf:
        length = _reach(point - low, -rate, -bend)
    if high < math.inf:
        length = min(length, _reach(high - point, rate, bend))
    return length


# --- what is summed ---------------------------------------------------------------------------------------------


@inner
def _note(row: int, work: _Floats, record: Record) -> None:
    """Note the gap and the force of a row where they are extreme."""
    numbers = record.numbers
    numbers[CLOSEST] = min(numbers[CLOSEST], work[_GAP, row])
    numbers[PEAK] = max(numbers[PEAK], work[_FORCE, row])
    numbers[PULL] = min(numbers[PULL], work[_FORCE, row])


@inner
def _sum_step(length: float, touching: bool, work: _Floats, record: Record) -> None:
    """Add a step to the record, with the weights of the method itself."""
    orders = record.moments.shape[0]
    total = 0.0
    for row in range(STAGES):
        if B[row] == 0.0:
            continue
        part = length * B[row] * work[_FORCE, row]
        total += part * work[_RATE, row]
        if part == 0.0:
            continue
        c, s = work[_COSINE, row], work[_SINE, row]
        x, y = part, 0.0
        for n in range(orders):
            record.moments[n] += complex(x, y)
            x, y = x * c + y * s, y * c - x * s
    record.numbers[WORK] += total
    if touching:
        record.numbers[CONTACT] += length
    _note(0, work, record)
    _note(_END, work, record)


@inner
def _trend(lever: Lever, contact: Contact, inside: bool, held: bool, work: _Floats, row: int) -> float:
    """Return the derivative of the force by theta [N]."""
    by_gap, by_velocity = law_slopes(
        contact.law, work[_GAP, row] * lever.length, work[_RATE, row] * lever.speed, inside, held
    )
    return float(by_gap * work[_RATE, row] * lever.length + by_velocity * work[_BEND, row] * lever.speed)


@inner
def _probe_step(
    lever: Lever,
    contact: Contact,
    Z: float,
    slope: float,
    length: float,
    bottom: float,
    inside: bool,
    held: bool,
    work: _Floats,
    record: Record,
) -> None:
    """Note the smallest gap and the largest force inside a step, by shorter steps to where they are."""
    summit = -1.0
    if inside:
        first = _trend(lever, contact, inside, held, work, 0) * length
        last = _trend(lever, contact, inside, held, work, _END) * length
        if first > 0.0 > last:
            # the summit of the cubic through force and trend at both ends
            rise = work[_FORCE, _END] - work[_FORCE, 0]
            cubic, square = first + last - 2.0 * rise, 3.0 * rise - 2.0 * first - last
            root = math.sqrt(max(square * square - 3.0 * cubic * first, 0.0))
            summit = first / (root - square) if root > square else 0.5
    if bottom < 0.0 and not 0.0 < summit < 1.0:
        return
    _copy_row(work, _END, _AFTER)
    for where in (bottom, summit):
        if 0.0 < where < 1.0:
            _step(lever, contact, Z, slope, where * length, inside, held, 1.0, work)
            _note(_END, work, record)
    _copy_row(work, _AFTER, _END)


@inner
def _eighth_root(x: float) -> float:
    """Return ``x^(1/8)``, the power by which the error of this order asks for another length."""
    return math.sqrt(math.sqrt(math.sqrt(x)))


# --- an interval ------------------------------------------------------------------------------------------------


@inner
def _widest(lever: Lever, orders: int, measure: bool, widest_mode: float) -> float:
    """Return how long a step may be."""
    widest = _WIDEST
    for j in range(lever.modes.shape[0]):
        widest = min(widest, widest_mode / math.sqrt(lever.modes[j, SQUARE]))
    if measure and orders > 1:
        widest = min(widest, _WIDEST_HARMONIC / (orders - 1))
    return widest


@inner
def _load(
    lever: Lever,
    contact: Contact,
    Z: float,
    slope: float,
    theta: float,
    state: _Floats,
    mode: _Integers,
    work: _Floats,
) -> None:
    """Begin with a state; a region below zero is one to be found."""
    modes = lever.modes.shape[0]
    for j in range(modes):
        work[_Q + 3 * j, 0], work[_V + 3 * j, 0] = state[j], state[modes + j]
    work[_COSINE, 0], work[_SINE, 0] = math.cos(theta), math.sin(theta)
    _evaluate(lever, contact, Z, slope, 0.0, _inside(contact, mode), mode[1] > 0, work, 0, 0)
    if mode[0] < 0:
        _place(lever, contact, mode, work)
        _evaluate(lever, contact, Z, slope, 0.0, _inside(contact, mode), mode[1] > 0, work, 0, 0)


@inner
def advance(
    lever: Lever,
    contact: Contact,
    Z: float,
    slope: float,
    start: float,
    end: float,
    state: _Floats,
    mode: _Integers,
    tolerance: float,
    widest_mode: float,
    measure: bool,
    record: Record,
    work: _Floats,
) -> tuple[int, int]:
    """Follow the motion from one phase of the drive to a later one; return a status and the number of steps.

    Parameters
    ----------
    lever, contact : Lever, Contact
        The equation of motion.
    Z, slope : float
        Height of the base at ``start`` and its derivative by theta, in the lever's length.
    start, end : float
        Phases [rad].
    state : array (2 mode,)
        Deflections, then their derivatives by theta; replaced by those at ``end``.
    mode : integer array (2,)
        Region between levels, -1 for one to be found, and whether contact is held; replaced.
    tolerance : float
        Of the error of one step, in the lever's length.
    widest_mode : float
        Longest step, in the phase of the fastest mode.
    measure : bool
        Whether to add to the record.
    """
    modes = lever.modes.shape[0]
    _load(lever, contact, Z, slope, start, state, mode, work)
    widest = _widest(lever, record.moments.shape[0], measure, widest_mode)
    landing = max(_LANDING * tolerance, 4e-15 * (1.0 + abs(Z)))
    limit = int(_STEPS_A_PERIOD * (1.0 + (end - start) / PERIOD))
    theta, h, steps, flips = start, min(_FIRST, widest), 0, 0
    tail = tail_range(contact.law) / lever.length if has_tail(contact.law) else 0.0
    low, high = _bounds(lever, contact, mode)
    cautious = False
    status = DONE
    while end - theta > 1e-14 * (1.0 + abs(end)):
        side = _wrong_side(low, high, landing, work)
        if side != 0:
            flips += 1
            if flips > _FLIPS:
                status = CHATTER
                break
            _cross(contact, mode, side)
            low, high = _bounds(lever, contact, mode)
            _evaluate(lever, contact, Z, slope, 0.0, _inside(contact, mode), mode[1] > 0, work, 0, 0)
            continue
        if steps >= limit:
            status = TOO_MANY_STEPS
            break
        steps += 1
        inside, held = _inside(contact, mode), mode[1] > 0
        last = h >= end - theta
        length = end - theta if last else h
        if tail > 0.0 and not inside:
            length = min(length, _tail_limit(tail, work))
            last = length == end - theta
        aim = _aim(low, high, work)
        if 0.0 < aim < length:
            length, last = aim, False
        error = _step(lever, contact, Z, slope, length, inside, held, tolerance, work)
        bottom = -1.0
        suggested = widest
        if error <= 1.0:
            if error > 0.0:
                suggested = min(
                    length * min(_SAFETY * _eighth_root(1.0 / error), 1.0 if cautious else _GROW), widest
                )
            passage = _first_passage(low, high, length, work)
            bottom = passage.bottom
            if passage.direction != 0:
                level, full = high if passage.direction > 0 else low, length
                length, error = _land(
                    lever, contact, Z, slope, length, passage, level, inside, held, tolerance, landing, work
                )
                last = False
                steps += _LANDING_STEPS
                # a contact shorter than the step: its bottom comes before the end of it
                bottom *= full / length if length > 0.0 else 0.0
        if not error <= 1.0:
            if length < _SMALLEST:
                status = STEP_TOO_SMALL if math.isfinite(error) else NOT_FINITE
                break
            h = length * (max(_SAFETY * _eighth_root(1.0 / error), _SHRINK) if math.isfinite(error) else 0.1)
            cautious = True
            continue
        if measure:
            touching = mode[0] < contact.kinks and contact.levels[mode[0]] <= 0.0
            _sum_step(length, touching, work, record)
            _probe_step(lever, contact, Z, slope, length, bottom, inside, held, work, record)
        theta = end if last else theta + length
        Z += slope * length
        _copy_row(work, _END, 0)
        h, cautious, flips = suggested, False, 0
    for j in range(modes):
        state[j], state[modes + j] = work[_Q + 3 * j, 0], work[_V + 3 * j, 0]
        if not (math.isfinite(state[j]) and math.isfinite(state[modes + j])):
            status = NOT_FINITE
    return status, steps


@inner
def phasors(
    lever: Lever,
    Z: float,
    slope: float,
    before: _Floats,
    after: _Floats,
    record: Record,
    reading: _Complex,
    gap: _Complex,
    force: _Complex,
) -> None:
    """Fill the phasors of a period that began at theta = 0 from the record of its force.

    ``x = sum_n Re(x_n exp(i n theta))``, ``x_n = (1 or 2)/(2 pi) int x exp(-i n theta) dtheta``. Multiplied by
    exp(-i n theta) and integrated over the period, the equation of motion is linear in the phasors; the ends
    of the period enter with what the state has changed.
    """
    modes = lever.modes.shape[0]
    for n in range(record.moments.shape[0]):
        share = 1.0 / PERIOD if n == 0 else 1.0 / math.pi
        force[n] = share * record.moments[n]
        reading[n] = lever.compliance_reading * force[n]
        gap[n] = lever.compliance * force[n]
        if n == 0:
            gap[n] += Z + slope * math.pi
        else:
            gap[n] += complex(0.0, 2.0 * slope / n)
        if n == 1:
            reading[n] += lever.direct_reading
            gap[n] += lever.direct
        for j in range(modes):
            dq, dv = after[j] - before[j], after[modes + j] - before[modes + j]
            source = lever.modes[j, MOBILITY] * force[n] - share * (
                dv + complex(lever.modes[j, DAMPING], n) * dq
            )
            if n == 1:
                source += complex(lever.modes[j, PUSH], lever.modes[j, PUSH_ACROSS])
            q = source / complex(lever.modes[j, SQUARE] - n * n, n * lever.modes[j, DAMPING])
            reading[n] += lever.modes[j, WEIGHT] * q
            gap[n] += q


# --- the map of one period --------------------------------------------------------------------------------------


@inner
def _scale(lever: Lever, i: int) -> float:
    """Return how large a change of a component of the state is, against one of the first deflection."""
    modes = lever.modes.shape[0]
    return 1.0 if i < modes else max(1.0, math.sqrt(lever.modes[i - modes, SQUARE]))


@inner
def tangent(
    lever: Lever,
    contact: Contact,
    Z: float,
    state: _Floats,
    mode: _Integers,
    tolerance: float,
    jacobian: _Floats,
    record: Record,
    work: _Floats,
) -> int:
    """Fill the derivative of the state a period later by the state, by differences; return a status."""
    size = state.shape[0]
    side = np.empty(2, np.int64)
    trial = np.empty((2, size))
    for i in range(size):
        step = _DIFFERENCE * _scale(lever, i)
        for k in range(2):
            trial[k] = state
            trial[k, i] += step if k == 0 else -step
            side[0], side[1] = -1, mode[1]
            status, _ = advance(
                lever,
                contact,
                Z,
                0.0,
                0.0,
                PERIOD,
                trial[k],
                side,
                tolerance,
                _FINE_MODE,
                False,
                record,
                work,
            )
            if status != DONE:
                return status
        for k in range(size):
            jacobian[k, i] = (trial[0, k] - trial[1, k]) / (2.0 * step)
    return DONE


@inner
def _solve(matrix: _Floats, right: _Floats) -> bool:
    """Replace the right side by the solution of a small linear system; the matrix is used up."""
    size = right.shape[0]
    for i in range(size):
        pivot = i
        for k in range(i + 1, size):
            if abs(matrix[k, i]) > abs(matrix[pivot, i]):
                pivot = k
        if matrix[pivot, i] == 0.0:
            return False
        for k in range(size):
            matrix[i, k], matrix[pivot, k] = matrix[pivot, k], matrix[i, k]
        right[i], right[pivot] = right[pivot], right[i]
        for k in range(i + 1, size):
            factor = matrix[k, i] / matrix[i, i]
            for n in range(i, size):
                matrix[k, n] -= factor * matrix[i, n]
            right[k] -= factor * right[i]
    for i in range(size - 1, -1, -1):
        for k in range(i + 1, size):
            right[i] -= matrix[i, k] * right[k]
        right[i] /= matrix[i, i]
    return True


@inner
def _distance(lever: Lever, before: _Floats, after: _Floats) -> float:
    """Return how far two states are apart, in the lever's length; NaN where one of them is."""
    total = 0.0
    for i in range(before.shape[0]):
        part = (after[i] - before[i]) / _scale(lever, i)
        total += part * part
    return math.sqrt(total)


@inner
def _memory(lever: Lever) -> float:
    """Return after how many periods the slowest free mode has lost a factor e."""
    slowest = 0.0
    for j in range(lever.modes.shape[0]):
        slowest = max(slowest, 1.0 / (math.pi * lever.modes[j, DAMPING]))
    return slowest


@inner
def _period(
    lever: Lever,
    contact: Contact,
    Z: float,
    state: _Floats,
    mode: _Integers,
    tolerance: float,
    record: Record,
    work: _Floats,
) -> int:
    """Follow the motion over one period at rest of the base; return a status."""
    status, _ = advance(
        lever, contact, Z, 0.0, 0.0, PERIOD, state, mode, tolerance, WIDEST_MODE, False, record, work
    )
    return status


@inner
def _newton(
    lever: Lever,
    contact: Contact,
    Z: float,
    state: _Floats,
    mode: _Integers,
    tolerance: float,
    goal: float,
    record: Record,
    work: _Floats,
) -> tuple[int, int]:
    """Look for the periodic state near a state; return a status and how many periods it took.

    Given up as `NOT_SETTLED` where a step would lead far away, where it does not come nearer, or where the
    state that was found is unstable; the state is then where it was.
    """
    size = state.shape[0]
    here, there, change = state.copy(), np.empty(size), np.empty(size)
    side = np.empty(2, np.int64)
    jacobian = np.empty((size, size))
    off, count = math.inf, 0
    for _ in range(_NEWTON_STEPS):
        there[:] = here
        side[0], side[1] = -1, mode[1]
        status = _period(lever, contact, Z, there, side, tolerance, record, work)
        count += 1
        if status != DONE:
            return status, count
        now = _distance(lever, here, there)
        if not now < 0.5 * off and now > goal:
            return NOT_SETTLED, count
        off = now
        status = tangent(lever, contact, Z, here, side, tolerance, jacobian, record, work)
        count += 2 * size
        if status != DONE:
            return status, count
        if not _contracts(jacobian):
            return NOT_SETTLED, count
        for i in range(size):
            change[i] = there[i] - here[i]
            for k in range(size):
                jacobian[i, k] = (1.0 if i == k else 0.0) - jacobian[i, k]
        if not _solve(jacobian, change):
            return NOT_SETTLED, count
        for i in range(size):
            there[i] = here[i] + change[i]
        step = _distance(lever, here, there)
        if not step < _TRUST:
            return NOT_SETTLED, count
        here[:] = there
        if step < goal:
            state[:] = here
            mode[0], mode[1] = -1, side[1]
            return DONE, count
    return NOT_SETTLED, count


@inner
def _contracts(matrix: _Floats) -> bool:
    """Return whether every eigenvalue of a small matrix is less than 1: its high powers vanish.

    Squared until they do, scaled so that nothing overflows.
    """
    size = matrix.shape[0]
    power, square = matrix.copy(), np.empty((size, size))
    logarithm = 0.0  # of what has been divided out
    for _ in range(_SQUARINGS):
        largest = 0.0
        for i in range(size):
            for k in range(size):
                total = 0.0
                for n in range(size):
                    total += power[i, n] * power[n, k]
                square[i, k] = total
                largest = max(largest, abs(total))
        logarithm *= 2.0
        if largest == 0.0:
            return True
        logarithm += math.log(largest)
        for i in range(size):
            for k in range(size):
                power[i, k] = square[i, k] / largest
    return logarithm < 0.0


@inner
def settle(
    lever: Lever,
    contact: Contact,
    Z: float,
    state: _Floats,
    mode: _Integers,
    tolerance: float,
    goal: float,
    limit: int,
    shooting: bool,
    record: Record,
    work: _Floats,
) -> tuple[int, int]:
    """Follow the motion until it repeats itself; return a status and how many periods it took.

    Settled is a state as near as ``goal`` to the periodic one, by Newton's step or, when only followed, by
    its change in a period times how many periods the lever remembers. With ``shooting`` it is followed in
    stretches, until the periodic state is near enough for Newton's method.
    """
    memory = _memory(lever)
    before = np.empty(state.shape[0])
    stretch = max(4, int(_STRETCH * memory)) if shooting else limit
    done, spent = 0, 0
    while done < limit:
        if shooting:
            status, used = _newton(lever, contact, Z, state, mode, tolerance, goal, record, work)
            spent += used
            if status != NOT_SETTLED:
                return status, spent
        for _ in range(min(stretch, limit - done)):
            before[:] = state
            status = _period(lever, contact, Z, state, mode, tolerance, record, work)
            done, spent = done + 1, spent + 1
            if status != DONE:
                return status, spent
            if _distance(lever, before, state) * memory < goal:
                return DONE, spent
    return NOT_SETTLED, spent


@inner
def _watch(
    lever: Lever,
    contact: Contact,
    Z: float,
    slope: float,
    state: _Floats,
    mode: _Integers,
    tolerance: float,
    record: Record,
    reading: _Complex,
    gap: _Complex,
    force: _Complex,
    work: _Floats,
) -> int:
    """Follow the motion over one period and fill its phasors; return a status."""
    before = state.copy()
    clear(record)
    status, _ = advance(
        lever, contact, Z, slope, 0.0, PERIOD, state, mode, tolerance, WIDEST_MODE, True, record, work
    )
    phasors(lever, Z, slope, before, state, record, reading, gap, force)
    return status


# --- blocks -----------------------------------------------------------------------------------------------------


class Contacts(NamedTuple):
    """The force laws of many points, see `Contact`."""

    law: _Floats
    levels: _Floats
    marks: _Integers
    """(point, 4): kinks, zero, made and lost of `Contact`."""


@inner
def contact_of(contacts: Contacts, point: int) -> Contact:
    """Return the force law of one point."""
    marks = contacts.marks[point]
    return Contact(contacts.law[point], contacts.levels[point], marks[0], marks[1], marks[2], marks[3])


@kernel
def follow_block(
    lever: Lever,
    contacts: Contacts,
    Z: _Floats,
    count: int,
    state: _Floats,
    mode: _Integers,
    tolerance: float,
    status: npt.NDArray[np.int8],
    steps: _Integers,
) -> None:
    """Replace every state (point, 2 mode) by that ``count`` periods later."""
    work, record = workspace(lever.modes.shape[0]), new_record(0)
    for i in range(Z.shape[0]):
        contact = contact_of(contacts, i)
        steps[i] = 0
        for _ in range(count):
            status[i], used = advance(
                lever,
                contact,
                Z[i],
                0.0,
                0.0,
                PERIOD,
                state[i],
                mode[i],
                tolerance,
                WIDEST_MODE,
                False,
                record,
                work,
            )
            steps[i] += used
            if status[i] != DONE:
                break


@kernel
def tangent_block(
    lever: Lever,
    contacts: Contacts,
    Z: _Floats,
    state: _Floats,
    mode: _Integers,
    tolerance: float,
    jacobian: _Floats,
    status: npt.NDArray[np.int8],
) -> None:
    """Fill the derivative (point, 2 mode, 2 mode) of every state a period later by the state."""
    work, record = workspace(lever.modes.shape[0]), new_record(0)
    for i in range(Z.shape[0]):
        status[i] = tangent(
            lever, contact_of(contacts, i), Z[i], state[i], mode[i], tolerance, jacobian[i], record, work
        )


@kernel
def settle_block(
    lever: Lever,
    contacts: Contacts,
    Z: _Floats,
    state: _Floats,
    mode: _Integers,
    tolerance: float,
    goal: float,
    limit: int,
    shooting: bool,
    reading: _Complex,
    gap: _Complex,
    force: _Complex,
    numbers: _Floats,
    spent: _Integers,
    status: npt.NDArray[np.int8],
) -> None:
    """Follow every state until it repeats itself, and fill the phasors of one period then."""
    work, record = workspace(lever.modes.shape[0]), new_record(reading.shape[1] - 1)
    for i in range(Z.shape[0]):
        contact = contact_of(contacts, i)
        status[i], spent[i] = settle(
            lever, contact, Z[i], state[i], mode[i], tolerance, goal, limit, shooting, record, work
        )
        last = _watch(
            lever,
            contact,
            Z[i],
            0.0,
            state[i],
            mode[i],
            tolerance,
            record,
            reading[i],
            gap[i],
            force[i],
            work,
        )
        numbers[i] = record.numbers
        if status[i] == DONE:
            status[i] = last


@kernel
def sweep_block(
    lever: Lever,
    contacts: Contacts,
    Z: _Floats,
    slope: float,
    settle_periods: int,
    decay: float,
    state: _Floats,
    mode: _Integers,
    tolerance: float,
    filtered: _Complex,
    numbers: _Floats,
    status: npt.NDArray[np.int8],
) -> None:
    """Move the base of every point along the heights Z and fill what a lock-in reads as it passes them.

    Parameters
    ----------
    Z : array (height,)
        Monotonic; the base rests at the first for ``settle_periods`` and then moves at ``slope`` [length a
        radian] to the last.
    decay : float
        What is left after a period of the difference of a stage of the filter to its input.
    filtered : complex array (point, height, stage, 2 harmonic)
        Output of each stage of the filter, for the harmonics of the reading, then of the force; the state of
        the filter at the start is taken from the last height, where it is finite.
    numbers : array (point, height, 5)
        Those of the record of the period that passes the height.
    """
    orders = filtered.shape[3] // 2
    stages = filtered.shape[2]
    work, record = workspace(lever.modes.shape[0]), new_record(orders - 1)
    reading, gap = np.empty(orders, np.complex128), np.empty(orders, np.complex128)
    force = np.empty(orders, np.complex128)
    now, last = np.empty((stages, 2 * orders), np.complex128), np.empty((stages, 2 * orders), np.complex128)
    heights = Z.shape[0]
    for i in range(contacts.law.shape[0]):
        contact = contact_of(contacts, i)
        now[:] = filtered[i, heights - 1]
        fresh = not math.isfinite(now[0, 0].real)
        filtered[i] = math.nan
        k = 0
        period = 0
        while k < heights:
            resting = period < settle_periods
            base = Z[0] if resting else Z[0] + slope * PERIOD * (period - settle_periods)
            move = 0.0 if resting else slope
            status[i] = _watch(
                lever, contact, base, move, state[i], mode[i], tolerance, record, reading, gap, force, work
            )
            if status[i] != DONE:
                break
            last[:] = now
            for n in range(2 * orders):
                value = reading[n] if n < orders else force[n - orders]
                for stage in range(stages):
                    now[stage, n] = value if fresh else value + decay * (now[stage, n] - value)
                    value = now[stage, n]
            if fresh:
                last[:] = now
                fresh = False
            period += 1
            if resting and period < settle_periods:
                continue
            end = base + move * PERIOD
            while k < heights and (k == 0 or (Z[k] - end) * slope <= 0.0):
                # between the ends of two periods the output of the filter is a straight line
                part = (Z[k] - base) / (end - base) if end != base else 1.0
                for stage in range(stages):
                    for n in range(2 * orders):
                        filtered[i, k, stage, n] = last[stage, n] + part * (now[stage, n] - last[stage, n])
                numbers[i, k] = record.numbers
                k += 1
