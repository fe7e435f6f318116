"""The force law of a whole model for compiled code: a table with a row a term.

A model is a sum of terms, so compiled code needs no model: a table of numbers says it all. Its columns are
the kind of the term and its coefficients. Two flags carry what the gap alone does not say: whether the tip is
``inside`` (the side of d = 0 it is on, which at d = 0 itself the number cannot tell) and whether the contact
is ``held`` (a neck or an adhesive contact was made and has not let go).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from overtone.contact import terms
from overtone.contact.adhesive import Curve, branch
from overtone.kernels import inlined, inner, kernel

COLUMNS = 9

POWER = 0  # coefficient, exponent: c (-d)^p in contact
VISCOUS = 1  # coefficient, exponent: -c (-d)^q d' in contact
ADHESION = 2  # force, range, tail: as `overtone.contact.terms` has it
NECK = 3  # force, reach: an attraction over 0 < d < reach while held
CURVE = 4  # six fields of a curve of `overtone.contact.adhesive`, length, force: the stable branch while held

LEVELS = 4  # at most so many gaps at which a law is not smooth

_Floats = npt.NDArray[np.float64]


class Law(NamedTuple):
    """A force law under one tip, as kernels take it."""

    table: _Floats
    """(term, column)."""
    levels: _Floats
    """(level,): gaps at which the law is not smooth [m], rising, the first ``kinks`` of them."""
    kinks: int
    made: float
    """Gap below which a contact is held, -infinity without hysteresis [m]."""
    lost: float
    """Gap above which it lets go, infinity without hysteresis [m]."""


@inlined
def _power(depth: float, exponent: float) -> float:
    """Return ``depth^p`` for depth >= 0."""
    if exponent == 1.5:
        return depth * math.sqrt(depth)
    if exponent == 1.0:
        return depth
    if exponent == 0.5:
        return math.sqrt(depth)
    if exponent == 2.0:
        return depth * depth
    if exponent == 0.0:
        return 1.0
    return float(depth**exponent)


@inner
def _curve_force(row: _Floats, d: float) -> float:
    """Return the force on the stable branch of JKR or Maugis [N]."""
    curve = Curve(row[1], row[2], row[3], row[4], row[5], row[6])
    indentation = -d / row[7]
    force, _ = branch(curve, indentation, indentation - curve.fold, 0.5 * curve.last)
    return row[8] * force


@inlined
def law_force(law: _Floats, d: float, v: float, inside: bool, held: bool) -> float:
    """Return the force of a law at a gap [m] and its velocity [m/s]."""
    total = 0.0
    depth = max(-d, 0.0) if inside else 0.0
    for k in range(law.shape[0]):
        kind = law[k, 0]
        if kind == POWER:
            if inside:
                total += law[k, 1] * _power(depth, law[k, 2])
        elif kind == ADHESION:
            if inside:
                total -= law[k, 1] if law[k, 3] != terms.NO_ADHESION else 0.0
            else:
                total -= law[k, 1] * terms.tail_shape(int(law[k, 3]), max(d, 0.0), law[k, 2])
        elif kind == VISCOUS:
            if inside:
                total -= law[k, 1] * _power(depth, law[k, 2]) * v
        elif kind == NECK:
            if held and not inside:
                total -= law[k, 1]
        elif held:
            total += _curve_force(law[k], d)
    return total


@inner
def law_slopes(law: _Floats, d: float, v: float, inside: bool, held: bool) -> tuple[float, float]:
    """Return the derivatives of the force by the gap [N/m] and by its velocity [N s/m]."""
    by_gap, by_velocity = 0.0, 0.0
    depth = max(-d, 0.0) if inside else 0.0
    for k in range(law.shape[0]):
        kind = law[k, 0]
        if kind == POWER:
            if inside and depth > 0.0:
                by_gap -= law[k, 1] * law[k, 2] * _power(depth, law[k, 2] - 1.0)
        elif kind == ADHESION:
            if not inside:
                by_gap -= law[k, 1] * terms.tail_slope(int(law[k, 3]), max(d, 0.0), law[k, 2])
        elif kind == VISCOUS:
            if inside and depth > 0.0:
                by_velocity -= law[k, 1] * _power(depth, law[k, 2])
                if law[k, 2] > 0.0:
                    by_gap += law[k, 1] * law[k, 2] * _power(depth, law[k, 2] - 1.0) * v
        elif kind == CURVE and held:
            # the slope only steers an iteration: a difference, one-sided at the fold
            step = 1e-6 * _stretch(law[k], d)
            by_gap += (_curve_force(law[k], d) - _curve_force(law[k], d - step)) / step
    return by_gap, by_velocity


@inner
def _stretch(row: _Floats, d: float) -> float:
    """Return the distance over which the stable branch changes [m]."""
    release = -row[2] * row[7]
    return max(min(abs(release - d), row[7]), 1e-6 * row[7])


@inner
def has_tail(law: _Floats) -> bool:
    """Return whether the force goes on outside contact, with no end."""
    for k in range(law.shape[0]):
        if law[k, 0] == ADHESION and law[k, 3] == terms.VAN_DER_WAALS_TAIL and law[k, 1] != 0.0:
            return True
    return False


@inner
def tail_range(law: _Floats) -> float:
    """Return the shortest range of an attraction [m], infinite without one."""
    shortest = math.inf
    for k in range(law.shape[0]):
        if law[k, 0] == ADHESION and law[k, 3] in (terms.VAN_DER_WAALS_TAIL, terms.LINEAR_TAIL):
            shortest = min(shortest, law[k, 2])
        elif law[k, 0] == CURVE:
            shortest = min(shortest, law[k, 7])
    return shortest


@inner
def has_viscosity(law: _Floats) -> bool:
    """Return whether the force depends on velocity."""
    viscous = False
    for k in range(law.shape[0]):
        viscous = viscous or law[k, 0] == VISCOUS
    return viscous


@kernel
def law_levels(law: _Floats, levels: _Floats) -> tuple[int, float, float]:
    """Fill the gaps at which a law is not smooth, rising; return how many, and where contact is made and lost.

    ``made`` is the gap below which the tip is held, ``lost`` the one above which it is free again; without
    hysteresis -infinity and infinity.
    """
    count, made, lost = 0, -math.inf, math.inf
    wanted = np.empty(3 * law.shape[0] + 1)
    for k in range(law.shape[0]):
        if law[k, 0] == CURVE:
            length = law[k, 7]
            made = -(law[k, 2] + law[k, 3]) * length
            lost = -law[k, 2] * length
            wanted[count], wanted[count + 1] = made, lost
            count += 2
            if math.isfinite(law[k, 4]):
                wanted[count] = -law[k, 4] * length
                count += 1
            continue
        wanted[count] = 0.0
        count += 1
        if law[k, 0] == NECK:
            made, lost = 0.0, law[k, 2]
            wanted[count] = lost
            count += 1
        elif law[k, 0] == ADHESION and law[k, 3] == terms.LINEAR_TAIL:
            wanted[count] = 2.0 * law[k, 2]
            count += 1
    ordered = np.sort(wanted[:count])
    distinct = 0
    for i in range(count):
        if distinct == 0 or ordered[i] > levels[distinct - 1]:
            if distinct == levels.shape[0]:
                return -1, made, lost
            levels[distinct] = ordered[i]
            distinct += 1
    return distinct, made, lost


@kernel
def force_block(
    table: _Floats,
    d: _Floats,
    v: _Floats,
    inside: npt.NDArray[np.bool_],
    held: npt.NDArray[np.bool_],
    out: _Floats,
) -> None:
    """Fill the force for every point, each with its own table (point, term, column)."""
    for i in range(d.shape[0]):
        out[i] = law_force(table[i], d[i], v[i], inside[i], held[i])


@kernel
def level_block(
    law: _Floats, levels: _Floats, count: npt.NDArray[np.int64], made: _Floats, lost: _Floats
) -> None:
    """Fill the answers of `law_levels` for every point."""
    for i in range(law.shape[0]):
        count[i], made[i], lost[i] = law_levels(law[i], levels[i])
