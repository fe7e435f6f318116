"""Modulus, adhesion and indentation of a JKR contact from three conservative force harmonics.

Each pixel looks for the two ratios (`overtone.inversion.jkr_moments`) that give its harmonics up to a common factor;
that factor is ``pi w R``. Geometrically: three moments are a vector, its direction is set by the two ratios, and
its length by the adhesion.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from overtone.blocks import run_blocks
from overtone.errors import InversionError
from overtone.inversion.jkr_moments import (
    FOLD,
    HIGHEST_ROW,
    LAST_COLUMN,
    LOWEST_ROW,
    MOMENTS,
    SPANS,
    column_of,
    depth_of,
    direction,
    moment_table,
    row_of,
    span_of,
)
from overtone.kernels import inner, kernel

_STEPS, _ROW_STEPS = 60, 6
_LONGEST = 1.0  # step of the search
_SMALLEST = 1e-3  # share of a step below which the search gives up
_EXACT = 1e-9  # of the coordinates
_MET = 1e-7  # distance of the directions
_BLOCK = 2048
_COARSE = (13, 24)  # rows and columns
_CLOSER = 24  # moves from the best node, or halvings of the step where no neighbour is nearer

_Floats = npt.NDArray[np.float64]


class _Aim(NamedTuple):
    """What a search looks for, and room to work."""

    table: _Floats
    basis: _Floats
    """(combination, moment): what of the moments the three numbers are."""
    y: _Floats
    """(3,): the direction to be met, of length 1."""
    scale: float
    """Divides h: combination i goes by ``scale^-i``, which keeps the three comparable."""
    work: _Floats
    v: _Floats
    """(3, combination): the combinations at the place last looked at, and their slopes by row and column."""


class JkrContact(NamedTuple):
    """A JKR contact of each pixel, NaN where there is none."""

    effective_modulus: _Floats
    """E* [Pa]."""
    adhesion: _Floats
    """Pull-off force 3/2 pi w R [N]."""
    indentation: _Floats
    """delta_max [m]."""


def jkr_of_harmonics(
    cons: Any,
    amplitude: Any,
    *,
    orders: Sequence[int],
    radius: float,
    indentation: Any,
    effective_modulus: Any,
    adhesion: Any,
) -> JkrContact:
    """Return the JKR contact whose conservative harmonics are the ones given.

    Parameters
    ----------
    cons : array (pixel, 4)
        CONS_0 to CONS_3 [N], of which those of ``orders`` count.
    amplitude : array (pixel,)
        A1 [m].
    orders : sequence of int
        Three different orders out of 0, 1, 2, 3.
    radius : float
        R [m].
    indentation, effective_modulus, adhesion : array (pixel,)
        delta_max [m], E* [Pa] and F_ad [N] of the same pixels after DMT: where the search begins.

    Returns
    -------
    JkrContact
        Arrays (pixel,); NaN where an argument is not finite or no contact is found.

    Raises
    ------
    InversionError
        If the orders are not three out of 0 to 3.

    Notes
    -----
    Assumes a tip that makes and breaks its contact once per cycle (span below 0.9, `SPANS`) and a depth between 0
    and 1000. Where the tip hardly touches (depth below about 0.1: all there is of the contact is its hysteresis) the
    same harmonics belong to a second, deeper contact. The answer is the deeper one, on the branch that becomes Hertz,
    and so DMT, when adhesion vanishes: on it the two ratios turn the direction of the harmonics in one sense, on the
    other in the opposite one. On 40,000 random contacts of depth 0.16 to 600, sought from a start wrong by a factor
    of 2, no second answer on that branch turned up.

    Harmonics of a known JKR contact give its modulus back to 1e-6 (the worst of 40,000 to 1e-4), its adhesion to
    1e-5 (1e-1 where the peak force is 10,000 times the adhesion): what the interpolated table leaves.
    """
    chosen = tuple(orders)
    if len(set(chosen)) != 3 or not set(chosen) <= {0, 1, 2, 3}:
        raise InversionError(
            "harmonics do not fit a JKR contact", expected="three orders out of 0 to 3", got=str(chosen)
        )
    F, A, delta, E_star, F_ad = (
        np.ascontiguousarray(a, dtype=float)
        for a in (cons, amplitude, indentation, effective_modulus, adhesion)
    )
    reduction, basis = _reduction(chosen)
    weighted = F[:, list(chosen)] @ reduction.T
    count = A.size
    found = np.full((count, 3), math.nan)
    usable = (
        np.isfinite(weighted).all(axis=1) & np.isfinite(delta) & (A > 0.0) & (E_star > 0.0) & (F_ad > 0.0)
    )
    usable &= (weighted != 0.0).any(axis=1)
    if not usable.any():
        return JkrContact(*found.T)
    length = np.cbrt((F_ad[usable] / (2.0 * np.sqrt(radius) * 4.0 / 3.0 * E_star[usable])) ** 2)
    weighted, A, delta = np.ascontiguousarray(weighted[usable]), A[usable], delta[usable]
    inside = np.full((A.size, 3), math.nan)
    table = moment_table()

    def run(block: slice) -> None:
        _solve(table, basis, weighted[block], A[block], delta[block], length[block], inside[block])

    run_blocks(run, A.size, _BLOCK)
    depth, span, force = inside.T
    unit = 2.0 * A * span / (depth + FOLD)
    # L^1.5 = pi w sqrt(R)/K
    found[usable, 0] = 0.75 * force / (math.sqrt(radius) * unit**1.5)
    found[usable, 1] = 1.5 * force
    found[usable, 2] = depth * unit
    return JkrContact(*found.T)


def _reduction(orders: tuple[int, ...]) -> tuple[_Floats, _Floats]:
    """Return what turns three CONS_n into combinations that begin with 1, h, h^2, and these in powers of h."""
    # cos(n psi) in powers of h = 1 - cos(psi)
    cosines = np.array(
        [[1.0, 0.0, 0.0, 0.0], [1.0, -1.0, 0.0, 0.0], [1.0, -4.0, 2.0, 0.0], [1.0, -9.0, 12.0, -4.0]]
    )[list(orders)]
    # CONS_n = (-1)^n (1 | 2) mean of F cos(n psi)
    weight = np.array([(-1.0) ** n / (1.0 if n == 0 else 2.0) for n in orders])
    leading = np.linalg.inv(cosines[:, :3])
    return np.ascontiguousarray(leading * weight), np.ascontiguousarray(leading @ cosines)


@kernel
def _solve(
    table: _Floats,
    basis: _Floats,
    weighted: _Floats,
    amplitude: _Floats,
    indentation: _Floats,
    length: _Floats,
    found: _Floats,
) -> None:
    """Fill depth, span and pi w R of each pixel (pixel, 3); what is not found is left as it is."""
    work, v, y = np.empty((3, MOMENTS)), np.empty((3, 3)), np.empty(3)
    for pixel in range(amplitude.size):
        reach = max(indentation[pixel], 0.0) + FOLD * length[pixel]
        first = min(max(0.5 * reach / amplitude[pixel], SPANS[0]), SPANS[1])
        square = 0.0
        for i in range(3):
            y[i] = weighted[pixel, i] / first**i
            square += y[i] ** 2
        size = math.sqrt(square)
        for i in range(3):
            y[i] /= size
        aim = _Aim(table, basis, y, first, work, v)
        # from the answer of DMT, from the best span at its depth, and from wherever the direction is nearest
        row = row_of(first)
        column = column_of(max(indentation[pixel] / length[pixel], 0.3))
        for attempt in range(3):
            if attempt == 1:
                row = _best_row(aim, row, column)
            elif attempt == 2:
                row, column = _nearest(aim)
            end_row, end_column, norm, met = _search(aim, row, column)
            if met and _turns(aim.v) > 0.0:
                found[pixel, 0], found[pixel, 1] = depth_of(end_column)[0], span_of(end_row)[0]
                found[pixel, 2] = size / norm
                break


@inner
def _search(aim: _Aim, row: float, column: float) -> tuple[float, float, float, bool]:
    """Return row, column and norm of the moments whose direction is aimed at, and whether they were found.

    Newton's method; a step counts as progress where it makes the next step of the same matrix shorter, not where it
    brings the directions closer: adhesion hardly turns the direction of a deep contact, and a search that minds the
    distance creeps along that valley. ``aim.v`` belongs to the answer.
    """
    row, column = min(max(row, LOWEST_ROW), HIGHEST_ROW), min(max(column, 0.0), LAST_COLUMN)
    norm = _look(aim, row, column)
    share = 1.0
    for _ in range(_STEPS):
        # inverse of the slopes of the direction, in the plane that touches the sphere
        j1, j2 = _slopes(aim.v, 1, norm), _slopes(aim.v, 2, norm)
        a11, a12, a22 = _inner_product(j1, j1), _inner_product(j1, j2), _inner_product(j2, j2)
        determinant = a11 * a22 - a12 * a12
        if not determinant > 0.0:
            break
        inverse = (a22 / determinant, -a12 / determinant, a11 / determinant)
        distance, step1, step2 = _step(aim, norm, j1, j2, inverse)
        length = math.hypot(step1, step2)
        if length < _EXACT:
            return row, column, norm, distance < _MET
        share = min(1.0, 4.0 * share, _LONGEST / length)
        while True:
            new_row = min(max(row + share * step1, LOWEST_ROW), HIGHEST_ROW)
            new_column = min(max(column + share * step2, 0.0), LAST_COLUMN)
            new_norm = _look(aim, new_row, new_column)
            _, next1, next2 = _step(aim, new_norm, j1, j2, inverse)
            if math.hypot(next1, next2) < (1.0 - 0.25 * share) * length:
                break
            share *= 0.5
            if share < _SMALLEST:
                return row, column, norm, False
        if new_row == row and new_column == column:
            break
        row, column, norm = new_row, new_column, new_norm
    return row, column, norm, False


@inner
def _inner_product(a: tuple[float, float, float], b: tuple[float, float, float]) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@inner
def _slopes(v: _Floats, line: int, norm: float) -> tuple[float, float, float]:
    """Return the slope of the direction of ``v``: what its line leaves at right angles to it, over the norm."""
    along = (v[0, 0] * v[line, 0] + v[0, 1] * v[line, 1] + v[0, 2] * v[line, 2]) / norm**2
    return (
        (v[line, 0] - along * v[0, 0]) / norm,
        (v[line, 1] - along * v[0, 1]) / norm,
        (v[line, 2] - along * v[0, 2]) / norm,
    )


@inner
def _look(aim: _Aim, row: float, column: float) -> float:
    """Fill ``aim.v`` at a place of the table and return the norm of its first line."""
    return direction(aim.table, aim.basis, row, column, aim.scale, aim.work, aim.v)


@inner
def _apart(aim: _Aim, norm: float) -> tuple[float, float, float]:
    """Return the direction last looked at less the one aimed at."""
    v, y = aim.v, aim.y
    return (v[0, 0] / norm - y[0], v[0, 1] / norm - y[1], v[0, 2] / norm - y[2])


@inner
def _step(
    aim: _Aim,
    norm: float,
    j1: tuple[float, float, float],
    j2: tuple[float, float, float],
    inverse: tuple[float, float, float],
) -> tuple[float, float, float]:
    """Return the distance of the direction of ``v`` from ``y``, and Newton's step after the slopes j1 and j2."""
    r = _apart(aim, norm)
    g1, g2 = _inner_product(j1, r), _inner_product(j2, r)
    return (
        math.sqrt(_inner_product(r, r)),
        -inverse[0] * g1 - inverse[1] * g2,
        -inverse[1] * g1 - inverse[2] * g2,
    )


@inner
def _turns(v: _Floats) -> float:
    """Return the determinant of the three lines: the sense in which the two ratios turn the direction."""
    return (
        v[0, 0] * (v[1, 1] * v[2, 2] - v[1, 2] * v[2, 1])
        - v[0, 1] * (v[1, 0] * v[2, 2] - v[1, 2] * v[2, 0])
        + v[0, 2] * (v[1, 0] * v[2, 1] - v[1, 1] * v[2, 0])
    )


@inner
def _best_row(aim: _Aim, row: float, column: float) -> float:
    """Return about the row where the direction is nearest at this column: the floor of the valley."""
    for _ in range(_ROW_STEPS):
        norm = _look(aim, row, column)
        slope = _slopes(aim.v, 1, norm)
        r = _apart(aim, norm)
        step = -_inner_product(slope, r) / _inner_product(slope, slope)
        row = min(max(row + min(max(step, -_LONGEST), _LONGEST), LOWEST_ROW), HIGHEST_ROW)
    return row


@inner
def _closeness(aim: _Aim, row: float, column: float) -> float:
    """Return the cosine between ``y`` and the direction at a place, -1 on the branch that is not looked for."""
    norm = _look(aim, row, column)
    v, y = aim.v, aim.y
    closeness = (v[0, 0] * y[0] + v[0, 1] * y[1] + v[0, 2] * y[2]) / norm
    return closeness if _turns(aim.v) > 0.0 else -1.0


@inner
def _nearest(aim: _Aim) -> tuple[float, float]:
    """Return row and column where the direction is about nearest: the best node of a coarse grid, then closer."""
    row_step, column_step = (HIGHEST_ROW - LOWEST_ROW) / (_COARSE[0] - 1), LAST_COLUMN / _COARSE[1]
    best, best_row, best_column = -math.inf, LOWEST_ROW, LAST_COLUMN
    for i in range(_COARSE[0]):
        for j in range(_COARSE[1]):
            row, column = LOWEST_ROW + row_step * i, column_step * (j + 1)
            closeness = _closeness(aim, row, column)
            if closeness > best:
                best, best_row, best_column = closeness, row, column
    for _ in range(_CLOSER):
        middle_row, middle_column = best_row, best_column
        for i in range(-1, 2):
            for j in range(-1, 2):
                row = min(max(middle_row + row_step * i, LOWEST_ROW), HIGHEST_ROW)
                column = min(max(middle_column + column_step * j, 0.0), LAST_COLUMN)
                closeness = _closeness(aim, row, column)
                if closeness > best:
                    best, best_row, best_column = closeness, row, column
        if best_row == middle_row and best_column == middle_column:
            row_step, column_step = 0.5 * row_step, 0.5 * column_step
    return best_row, best_column
