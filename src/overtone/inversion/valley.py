"""Given the indentation a pixel is a linear problem: its answer, and how the misfit runs along the indentation.

In rows whitened by the noise the harmonics of a pixel are ``y = S a + F_ad b + c v`` with columns that depend on the
indentation alone: a elastic, b adhesive, v dissipative, ``c = S tan(delta)``. Taking v, then b, then a off the data one
after the other leaves everything known in closed form: chi-squared as a function of S with the others at their best,
and the best F_ad and c at each S. No product of columns is formed: those are so nearly parallel that it would square a
condition of 1e5.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from overtone.inversion.columns import Columns, fill_columns
from overtone.inversion.table import Table, interpolate
from overtone.kernels import inlined, inner, lean

_Floats = npt.NDArray[np.float64]


class Box(NamedTuple):
    """Bounds of the linear parameters."""

    softest: float
    """Of S."""
    stiffest: float
    weakest: float
    """Of F_ad [N]."""
    strongest: float


class Reduced(NamedTuple):
    """The linear problem at one indentation, solved."""

    rest: float
    """chi-squared with every parameter at its best, whatever its sign."""
    S: float
    """The best S, and"""
    alpha2: float
    """what chi-squared gains per squared distance of S from it."""
    F0: float
    """The best force of adhesion at S is F0 + F1 S, and"""
    F1: float
    beta2: float
    """what chi-squared gains per squared distance from it."""
    c0: float
    """The best c is c0 + c1 S + c2 F_ad, and"""
    c1: float
    c2: float
    gamma2: float
    """what chi-squared gains per squared distance from it; 0 without loss."""


class Scratch(NamedTuple):
    """Rows that every pixel writes anew."""

    a: _Floats
    b: _Floats
    v: _Floats
    wa: _Floats
    wb: _Floats
    wv: _Floats
    wy: _Floats
    work: _Floats
    first: _Floats
    """(row,): the data, whitened; ``wy`` is what is left of them at an indentation."""
    places: _Floats
    """(place,): t at which the difference that the harmonics of the motion make was found; may be empty."""
    poles: _Floats
    """(place,): barycentric weights of the polynomial between them."""
    shifts: _Floats
    """(place, row): that difference, whitened."""


@inner
def new_scratch(rows: int, n_max: int, places: int) -> Scratch:
    """Return scratch for pixels of so many rows, and differences of the motion at so many places."""
    return Scratch(
        np.zeros(rows),
        np.zeros(rows),
        np.zeros(rows),
        np.zeros(rows),
        np.zeros(rows),
        np.zeros(rows),
        np.zeros(rows),
        np.empty((6, n_max + 1)),
        np.zeros(rows),
        np.zeros(places),
        np.zeros(places),
        np.zeros((places, rows)),
    )


@lean
def set_places(s: Scratch, low: float, high: float) -> None:
    """Set the places between two t: Chebyshev points, between which a polynomial interpolates without waves."""
    count = s.places.shape[0]
    for j in range(count):
        angle = (2.0 * j + 1.0) * math.pi / (2.0 * count)
        s.places[j] = 0.5 * (low + high) - 0.5 * (high - low) * math.cos(angle)
        s.poles[j] = math.sin(angle) * (1.0 if j % 2 == 0 else -1.0)


@inlined
def set_data(s: Scratch, t: float) -> None:
    """Fill the whitened data at t: those measured, less what the harmonics of the motion make there."""
    count = s.places.shape[0]
    rows = s.first.shape[0]
    for i in range(rows):
        s.wy[i] = s.first[i]
    if count == 0:
        return
    t = min(max(t, s.places[0]), s.places[count - 1])
    total = 0.0
    for j in range(count):
        off = t - s.places[j]
        if off == 0.0:
            for i in range(rows):
                s.wy[i] = s.first[i] - s.shifts[j, i]
            return
        total += s.poles[j] / off
    for j in range(count):
        part = s.poles[j] / (t - s.places[j]) / total
        for i in range(rows):
            s.wy[i] -= part * s.shifts[j, i]


@inlined
def _part(orders: npt.NDArray[np.int64], lossy: npt.NDArray[np.bool_], s: Scratch) -> None:
    """Turn a_n and b_n of every row into its columns: dissipative rows know v alone, conservative ones not v."""
    for i in range(orders.shape[0]):
        if lossy[i]:
            s.v[i] = -orders[i] * s.a[i]
            s.a[i], s.b[i] = 0.0, 0.0
        else:
            s.v[i] = 0.0


@inlined
def whiten(W: _Floats, x: _Floats, out: _Floats) -> None:
    """Fill ``W x`` for a lower triangle W."""
    for i in range(W.shape[0]):
        total = 0.0
        for j in range(i + 1):
            total += W[i, j] * x[j]
        out[i] = total


@inlined
def tabulated_columns(
    table: Table,
    slot: int,
    share: float,
    scale: float,
    t: float,
    orders: npt.NDArray[np.int64],
    lossy: npt.NDArray[np.bool_],
    W: _Floats,
    s: Scratch,
) -> float:
    """Fill the whitened columns and data at t from the table; return Delta."""
    Delta = interpolate(table, slot, share, scale, t, orders, s.a, s.b)
    set_data(s, t)
    _part(orders, lossy, s)
    whiten(W, s.a, s.wa)
    whiten(W, s.b, s.wb)
    whiten(W, s.v, s.wv)
    return Delta


@lean
def exact_columns(
    columns: Columns,
    amplitude: float,
    t: float,
    orders: npt.NDArray[np.int64],
    lossy: npt.NDArray[np.bool_],
    W: _Floats,
    s: Scratch,
) -> float:
    """Fill the whitened columns and data at t, from the closed forms themselves; return Delta."""
    Delta = 1.0 / (1.0 + math.exp(-t))
    set_data(s, t)
    fill_columns(columns, amplitude, Delta, s.work.shape[1] - 1, s.work)
    for i in range(orders.shape[0]):
        s.a[i], s.b[i] = s.work[0, orders[i]], s.work[2, orders[i]]
    _part(orders, lossy, s)
    whiten(W, s.a, s.wa)
    whiten(W, s.b, s.wb)
    whiten(W, s.v, s.wv)
    return Delta


@inlined
def _dot(x: _Floats, y: _Floats) -> float:
    total = 0.0
    for i in range(x.shape[0]):
        total += x[i] * y[i]
    return total


@inlined
def reduce(s: Scratch, sticky: bool, lossy: bool) -> Reduced:
    """Solve the linear problem of the whitened columns and data; scratch rows a, b, v are overwritten.

    ``sticky`` and ``lossy`` say whether the columns b and v take part.
    """
    count = s.wy.shape[0]
    r, p, q = s.a, s.b, s.v  # what is left of the data, of a, and of b
    for i in range(count):
        r[i], p[i], q[i] = s.wy[i], s.wa[i], s.wb[i]
    c0, c1, c2, gamma2 = 0.0, 0.0, 0.0, 0.0
    if lossy:
        gamma2 = _dot(s.wv, s.wv)
        if gamma2 > 0.0:
            c0, c1, c2 = _dot(s.wv, r) / gamma2, -_dot(s.wv, p) / gamma2, -_dot(s.wv, q) / gamma2
            for i in range(count):
                r[i] -= c0 * s.wv[i]
                p[i] += c1 * s.wv[i]
                q[i] += c2 * s.wv[i]
    F0, F1, beta2 = 0.0, 0.0, 0.0
    if sticky:
        beta2 = _dot(q, q)
        if beta2 > 0.0:
            F0, F1 = _dot(q, r) / beta2, -_dot(q, p) / beta2
            for i in range(count):
                r[i] -= F0 * q[i]
                p[i] += F1 * q[i]
    alpha2 = _dot(p, p)
    S = _dot(p, r) / alpha2 if alpha2 > 0.0 else 0.0
    rest = 0.0
    for i in range(count):
        left = r[i] - S * p[i]
        rest += left * left
    return Reduced(rest, S, alpha2, F0, F1, beta2, c0, c1, c2, gamma2)


@inlined
def _off(value: float, low: float, high: float) -> float:
    return low - value if value < low else (value - high if value > high else 0.0)


@inlined
def chi2_at(m: Reduced, S: float, box: Box) -> float:
    """Return chi-squared at S with the force of adhesion at its best within bounds, c at its best of any sign."""
    away = S - m.S
    off = _off(m.F0 + m.F1 * S, box.weakest, box.strongest)
    return m.rest + m.alpha2 * away * away + m.beta2 * off * off


@inlined
def best_S(m: Reduced, box: Box) -> float:
    """Return the S within bounds at which `chi2_at` is least."""
    S = m.S
    F = m.F0 + m.F1 * S
    edge = box.weakest if box.weakest > F else box.strongest
    if m.beta2 > 0.0 and (box.weakest > F or box.strongest < F):
        stiff = m.alpha2 + m.beta2 * m.F1 * m.F1
        S = (m.alpha2 * m.S + m.beta2 * m.F1 * (edge - m.F0)) / stiff
    return min(max(S, box.softest), box.stiffest)


@inlined
def edge_of_S(m: Reduced, box: Box, target: float, way: float) -> float:
    """Return the S above (way = 1) or below (-1) the best one at which `chi2_at` reaches a target, bounds apart."""
    reach = math.sqrt(max(target - m.rest, 0.0) / m.alpha2)
    S = m.S + way * reach
    F = m.F0 + m.F1 * S
    if m.beta2 > 0.0 and (box.weakest > F or box.strongest < F):
        edge = box.weakest if box.weakest > F else box.strongest
        stiff = m.alpha2 + m.beta2 * m.F1 * m.F1
        middle = (m.alpha2 * m.S + m.beta2 * m.F1 * (edge - m.F0)) / stiff
        off = m.F0 + m.F1 * middle - edge
        away = middle - m.S
        least = m.rest + m.alpha2 * away * away + m.beta2 * off * off
        S = middle + way * math.sqrt(max(target - least, 0.0) / stiff)
    return S


@inlined
def best_F(m: Reduced, S: float, box: Box) -> float:
    """Return the best force of adhesion at S within bounds."""
    return min(max(m.F0 + m.F1 * S, box.weakest), box.strongest) if m.beta2 > 0.0 else 0.0


@inlined
def solved(m: Reduced, s: Scratch, sticky: bool, box: Box) -> tuple[float, Reduced, float]:
    """Return the least chi-squared within bounds and with loss of either no or positive size, its problem and S."""
    S = best_S(m, box)
    F = best_F(m, S, box)
    if m.gamma2 > 0.0 and m.c0 + m.c1 * S + m.c2 * F < 0.0:
        m = reduce(s, sticky, False)
        S = best_S(m, box)
    return chi2_at(m, S, box), m, S


@lean
def physical(m: Reduced) -> bool:
    """Return whether the solution without bounds is one that a sample can have."""
    F = m.F0 + m.F1 * m.S
    return bool(m.S > 0.0 and F >= 0.0 and (m.gamma2 == 0.0 or m.c0 + m.c1 * m.S + m.c2 * F >= 0.0))
