"""Every solution of a pixel: separable least squares in the indentation alone.

Given the indentation the harmonics are linear in the material (`overtone.inversion.valley`), so the only search is
over ``t = ln(Delta/(1 - Delta))``. Three conservative harmonics and two linear unknowns leave a determinant
``y . (a x b)``, whose changes of sign are the solutions: no starting point, and none is missed that is wider than a
step of the table. Any other set of harmonics has least squares, whose minima are. Where no sample could give the
harmonics the closest one within bounds is reported as such. Out of contact the attraction alone is left, and the search
is over the gap.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from overtone.inversion.apart import closest_apart, has_reach
from overtone.inversion.columns import Columns, fill_columns
from overtone.inversion.search import Pixel, lowest_between, pixel_at, scan_valley
from overtone.inversion.table import (
    DEEPEST,
    NODES,
    SHALLOWEST,
    STEP,
    Table,
    elastic_scale,
    interpolate,
    locate,
)
from overtone.inversion.valley import (
    Box,
    Reduced,
    Scratch,
    best_F,
    exact_columns,
    new_scratch,
    physical,
    reduce,
    set_places,
    solved,
    whiten,
)
from overtone.kernels import inlined, inner, kernel

_Floats = npt.NDArray[np.float64]
_Orders = npt.NDArray[np.int64]
_Flags = npt.NDArray[np.bool_]

MOST = 4
"""Solutions that are kept of a pixel."""
S_, F_, C_, DELTA_ = 0, 1, 2, 3
"""Columns of a solution: S, F_ad, S tan(delta), and the indentation, negative out of contact."""
AS_GOOD = 9.0
"""Minima of chi-squared so far above the least one still count as solutions."""
OUTSIDE = -1
"""Count of a pixel whose amplitude has no place in the table."""

PLACES = 5
"""Places along t at which the difference that the harmonics of the motion make is found, for every solution."""

_STRIDE = 2
_POLISHED = 3e-5  # a step of Newton's method this short leaves its square
_CLEARLY = 1e-3  # share of the forces by which adhesion may be negative before a root is polished
_NEARLY = 0.05  # a minimum this close to zero, beside its neighbour, may be two roots
_STEPS = 25
_WINDOW = 2.5  # steps of the table that a root may lie from where it is looked for
_CANDIDATES = 16
_COARSE = 4  # stride where only the closest one within bounds is wanted
_APART_999 = 10.827566170662733


@inner
def _slope_row(
    m: Reduced,
    S: float,
    F: float,
    c: float,
    orders: _Orders,
    lossy: _Flags,
    W: _Floats,
    by_t: float,
    s: Scratch,
    out: _Floats,
) -> None:
    """Fill the whitened derivative of the model by t; uses the rows a of the scratch."""
    for i in range(orders.shape[0]):
        n = orders[i]
        s.a[i] = by_t * (-n * c * s.work[1, n] if lossy[i] else S * s.work[1, n] + F * s.work[3, n])
    whiten(W, s.a, out)


@inner
def polish(
    columns: Columns,
    amplitude: float,
    t: float,
    low: float,
    high: float,
    orders: _Orders,
    lossy: _Flags,
    W: _Floats,
    sticky: bool,
    steps: int,
    s: Scratch,
    slope: _Floats,
) -> tuple[float, Reduced, float]:
    """Move t to the minimum of chi-squared next to it by Gauss-Newton steps of the projected problem.

    Returns t, the linear problem there, and the standard deviation of S when the indentation is free as well.
    """
    lossy_model = columns.loss > 0.0
    spread = math.inf
    m = Reduced(math.inf, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    for _ in range(steps):
        Delta = exact_columns(columns, amplitude, t, orders, lossy, W, s)
        m = reduce(s, sticky, lossy_model)
        F = m.F0 + m.F1 * m.S
        c = m.c0 + m.c1 * m.S + m.c2 * F
        _slope_row(m, m.S, F, c, orders, lossy, W, Delta * (1.0 - Delta), s, slope)
        # off every column, and the elastic column off it: first the residual and both directions
        count = orders.shape[0]
        dot_dd, dot_dr, size = 0.0, 0.0, 0.0
        p, q = s.a, s.b
        for i in range(count):
            p[i], q[i] = s.wa[i], s.wb[i]
            size += slope[i] * slope[i]
        if m.gamma2 > 0.0:
            along = 0.0
            for i in range(count):
                along += s.wv[i] * slope[i]
            for i in range(count):
                p[i] += m.c1 * s.wv[i]
                q[i] += m.c2 * s.wv[i]
                slope[i] -= along / m.gamma2 * s.wv[i]
        if m.beta2 > 0.0:
            along = 0.0
            for i in range(count):
                along += q[i] * slope[i]
            for i in range(count):
                p[i] += m.F1 * q[i]
                slope[i] -= along / m.beta2 * q[i]
        along = 0.0
        for i in range(count):
            along += p[i] * slope[i]
        for i in range(count):
            d = slope[i] - along / m.alpha2 * p[i]
            # what the model leaves of the data
            r = s.wy[i] - m.S * s.wa[i] - F * s.wb[i] - c * s.wv[i]
            dot_dd += d * d
            dot_dr += d * r
        free = dot_dd + along * along / m.alpha2
        # variance of S: of the elastic column, the part that neither the others nor the indentation mimic
        left = m.alpha2 * dot_dd / free if free > 0.0 else 0.0
        spread = 1.0 / math.sqrt(left) if left > 0.0 else math.inf
        if not dot_dd > 1e-30 * size:
            break
        step = min(max(dot_dr / dot_dd, -0.5), 0.5)
        there = min(max(t + step, low), high)
        moved = there - t
        t = there
        if abs(moved) < 1e-9:
            break
    return t, m, spread


@kernel
def fill_cross(table: Table, orders: _Orders, cross: _Floats) -> None:
    """Fill a x b (amplitude, component, node) of three conservative rows."""
    for i in range(cross.shape[0]):
        for k in range(NODES):
            a, b = table.elastic[i, k], table.adhesion[i, k]
            n0, n1, n2 = orders[0], orders[1], orders[2]
            cross[i, 0, k] = a[n1, 0] * b[n2, 0] - a[n2, 0] * b[n1, 0]
            cross[i, 1, k] = a[n2, 0] * b[n0, 0] - a[n0, 0] * b[n2, 0]
            cross[i, 2, k] = a[n0, 0] * b[n1, 0] - a[n1, 0] * b[n0, 0]


@inlined
def _cross(x: _Floats, y: _Floats, out: _Floats) -> None:
    out[0], out[1], out[2] = x[1] * y[2] - x[2] * y[1], x[2] * y[0] - x[0] * y[2], x[0] * y[1] - x[1] * y[0]


@inlined
def _linear(y: _Floats, s: Scratch) -> tuple[float, float]:
    """Return S and F_ad of three rows ``y = S a + F_ad b`` that agree."""
    a, b, c, d = s.a, s.b, s.wa, s.wb
    _cross(a, b, c)
    square = c[0] * c[0] + c[1] * c[1] + c[2] * c[2]
    _cross(y, b, d)
    S = (d[0] * c[0] + d[1] * c[1] + d[2] * c[2]) / square
    _cross(a, y, d)
    return S, (d[0] * c[0] + d[1] * c[1] + d[2] * c[2]) / square


@inlined
def _between(g: _Floats, k: int) -> float:
    """Return where the cubic through four nodes vanishes between nodes k and k + 1, as a share of the step."""
    x = g[k] / (g[k] - g[k + 1])
    if k == 0 or k == NODES - 2:
        return x
    left, right = g[k - 1], g[k + 2]
    # in powers of the share, from differences
    cubic = (right - left + 3.0 * (g[k] - g[k + 1])) / 6.0
    square = 0.5 * (left + g[k + 1]) - g[k]
    line = g[k + 1] - g[k] - square - cubic
    for _ in range(3):
        slope = line + x * (2.0 * square + 3.0 * cubic * x)
        if slope == 0.0:
            break
        x -= (g[k] + x * (line + x * (square + x * cubic))) / slope
        x = min(max(x, 0.0), 1.0)
    return x


@inlined
def _keep(solutions: _Floats, count: int, S: float, F: float, c: float, delta: float) -> int:
    """Add a solution, deepest last, unless it is there already; return how many there are."""
    if count == MOST:
        return count
    for k in range(count):
        if abs(solutions[k, DELTA_] - delta) < 1e-6 * delta:
            return count  # the same one, met from two sides
    solutions[count, S_], solutions[count, F_] = S, F
    solutions[count, C_], solutions[count, DELTA_] = c, delta
    return count + 1


@inlined
def _root(
    t: float,
    bracketed: bool,
    y: _Floats,
    amplitude: float,
    columns: Columns,
    table: Table,
    slot: int,
    share: float,
    scale: float,
    orders: _Orders,
    W: _Floats,
    s: Scratch,
    solutions: _Floats,
    spreads: _Floats,
    count: int,
) -> int:
    """Add the solution next to t, where there is one that a sample can have; return how many there are.

    Newton's method on the determinant of the closed forms. No whitening: three rows are met exactly.
    """
    low, high = t - _WINDOW * STEP, min(t + _WINDOW * STEP, DEEPEST)
    if bracketed:  # the columns there tell already what no sample can have
        interpolate(table, slot, share, scale, t, orders, s.a, s.b)
        S, F = _linear(y, s)
        size = abs(y[0]) + abs(y[1]) + abs(y[2])
        if S < 0.0 or F * (abs(s.b[0]) + abs(s.b[1]) + abs(s.b[2])) < -_CLEARLY * size:
            return count
    a, b, slope, ahead = s.a, s.b, s.wa, s.wb
    before = math.inf
    for _ in range(_STEPS):
        Delta = 1.0 / (1.0 + math.exp(-t))
        fill_columns(columns, amplitude, Delta, s.work.shape[1] - 1, s.work)
        by_t = Delta * (1.0 - Delta)
        for i in range(3):
            a[i], b[i] = s.work[0, orders[i]], s.work[2, orders[i]]
        _cross(a, b, slope)
        value = y[0] * slope[0] + y[1] * slope[1] + y[2] * slope[2]
        for i in range(3):
            ahead[i] = s.work[1, orders[i]]
        _cross(ahead, b, slope)
        rate = y[0] * slope[0] + y[1] * slope[1] + y[2] * slope[2]
        for i in range(3):
            ahead[i] = s.work[3, orders[i]]
        _cross(a, ahead, slope)
        rate += y[0] * slope[0] + y[1] * slope[1] + y[2] * slope[2]
        rate *= by_t
        # from outside a pair every step leaves a quarter of the determinant; a dip that has no root leaves more
        if rate == 0.0 or (not bracketed and abs(value) > 0.5 * before):
            return count
        before = abs(value)
        there = min(max(t - value / rate, low), high)
        step = there - t
        t = there
        if abs(step) < _POLISHED:
            # the columns follow to first order, the error of which is that of the next step
            for i in range(3):
                a[i] += step * by_t * s.work[1, orders[i]]
                b[i] += step * by_t * s.work[3, orders[i]]
            break
    S, F = _linear(y, s)
    if not (S > 0.0 and F >= 0.0):
        return count
    delta = 2.0 * amplitude / (1.0 + math.exp(-t))
    more = _keep(solutions, count, S, F, 0.0, delta)
    if more > count:
        # d S by each force: what is at right angles to the columns of F_ad and of the indentation
        Delta = 1.0 / (1.0 + math.exp(-t))
        for i in range(3):
            ahead[i] = Delta * (1.0 - Delta) * (S * s.work[1, orders[i]] + F * s.work[3, orders[i]])
        _cross(b, ahead, slope)
        scaled = a[0] * slope[0] + a[1] * slope[1] + a[2] * slope[2]
        total = 0.0
        for i in range(2, -1, -1):
            left = slope[i] / scaled
            for j in range(i + 1, 3):
                left -= W[j, i] * ahead[j]
            ahead[i] = left / W[i, i]
            total += ahead[i] * ahead[i]
        spreads[count] = math.sqrt(total)
    return more


@inlined
def _left(y: _Floats, shifts: _Floats, lagrange: _Floats, k: int, out: _Floats) -> None:
    """Fill what is left of three data at a node, less what the harmonics of the motion make there."""
    for r in range(3):
        out[r] = y[r]
        for j in range(shifts.shape[0]):
            out[r] -= lagrange[j, k] * shifts[j, r]


@inlined
def _roots(
    y: _Floats,
    amplitude: float,
    columns: Columns,
    table: Table,
    cross: _Floats,
    slot: int,
    share: float,
    scale: float,
    orders: _Orders,
    W: _Floats,
    shifts: _Floats,
    lagrange: _Floats,
    g: _Floats,
    marks: npt.NDArray[np.uint8],
    words: npt.NDArray[np.uint64],
    near: _Floats,
    nodes: _Orders,
    s: Scratch,
    there: _Floats,
    solutions: _Floats,
    spreads: _Floats,
) -> int:
    """Fill every physical solution of three conservative harmonics; return how many."""
    low, high = cross[slot], cross[slot + 1]
    u0, u1, u2 = (1.0 - share) * y[0], (1.0 - share) * y[1], (1.0 - share) * y[2]
    v0, v1, v2 = share * y[0], share * y[1], share * y[2]
    for k in range(NODES):
        g[k] = (
            u0 * low[0, k]
            + u1 * low[1, k]
            + u2 * low[2, k]
            + v0 * high[0, k]
            + v1 * high[1, k]
            + v2 * high[2, k]
        )
    for j in range(shifts.shape[0]):
        for r in range(3):
            first, second = (1.0 - share) * shifts[j, r], share * shifts[j, r]
            for k in range(NODES):
                g[k] -= lagrange[j, k] * (first * low[r, k] + second * high[r, k])
    # where the determinant changes sign, or turns back short of zero: few nodes, found eight at a time
    for k in range(1, NODES - 1):
        before, here, after = g[k - 1], g[k], g[k + 1]
        turned = (abs(here) < abs(before)) & (abs(here) <= abs(after)) & (before * here > 0.0)
        marks[k] = (here * after <= 0.0) | turned
    found = 0
    for word in range(words.shape[0]):
        if words[word] == 0:
            continue
        for k in range(8 * word, 8 * word + 8):
            if marks[k] == 0 or found > near.shape[0] - 2:
                continue
            if (g[k] > 0.0) != (g[k + 1] > 0.0):
                near[found], nodes[found] = SHALLOWEST + STEP * (k + _between(g, k)), k
                found += 1
                continue
            # a parabola through three nodes says whether it dips through zero between them, or nearly
            bend = g[k - 1] - 2.0 * g[k] + g[k + 1]
            tilt = 0.5 * (g[k + 1] - g[k - 1])
            if bend == 0.0:
                continue
            lowest = g[k] - 0.5 * tilt * tilt / bend
            if (lowest > 0.0) == (g[k] > 0.0) and abs(lowest) > _NEARLY * (abs(g[k]) + abs(bend)):
                continue
            # from the nodes beside it Newton's method comes to the nearer root of a pair, from either side
            for way in (-1, 1):
                near[found], nodes[found] = SHALLOWEST + STEP * (k + way), k
                found += 1
    count = 0
    for j in range(found):
        _left(y, shifts, lagrange, nodes[j], there)
        count = _root(
            near[j],
            (g[nodes[j]] > 0.0) != (g[nodes[j] + 1] > 0.0),
            there,
            amplitude,
            columns,
            table,
            slot,
            share,
            scale,
            orders,
            W,
            s,
            solutions,
            spreads,
            count,
        )
    return count


@inner
def _least_squares(
    pixel: Pixel,
    only_bounded: bool,
    bounded: _Floats,
    s: Scratch,
    slope: _Floats,
    solutions: _Floats,
    spreads: _Floats,
    best: _Floats,
) -> tuple[int, float, float]:
    """Fill minima of chi-squared that a sample can have, and the least one within bounds.

    Returns how many, the least chi-squared within bounds, and the spread of S there.
    """
    columns, amplitude, sticky = pixel.columns, pixel.amplitude, pixel.sticky
    orders, lossy, W = pixel.orders, pixel.lossy, pixel.W
    stride = _COARSE if only_bounded else _STRIDE
    nodes = (NODES - 1) // stride + 1
    least = scan_valley(pixel, stride, bounded, s)
    count = 0
    if not only_bounded:
        chi2 = np.empty(MOST)
        for k in range(1, nodes - 1):
            if not (bounded[k] <= bounded[k - 1] and bounded[k] < bounded[k + 1]):
                continue
            low, high = SHALLOWEST + STEP * stride * (k - 1), SHALLOWEST + STEP * stride * (k + 1)
            near, _ = lowest_between(pixel, low, high, 1e-3, s)
            t, m, spread = polish(
                columns, amplitude, near, near - 0.1, near + 0.1, orders, lossy, W, sticky, _STEPS, s, slope
            )
            if physical(m):
                F = m.F0 + m.F1 * m.S
                more = _keep(
                    solutions,
                    count,
                    m.S,
                    F,
                    m.c0 + m.c1 * m.S + m.c2 * F,
                    2.0 * amplitude / (1.0 + math.exp(-t)),
                )
                if more > count:
                    spreads[count], chi2[count] = spread, m.rest
                count = more
        # those that the data prefer; deepest last as they come
        lowest = math.inf
        for k in range(count):
            lowest = min(lowest, chi2[k])
        kept = 0
        for k in range(count):
            if chi2[k] <= lowest + AS_GOOD:
                solutions[kept], spreads[kept] = solutions[k], spreads[k]
                kept += 1
        for k in range(kept, count):
            solutions[k] = math.nan
        count = kept
        if count > 0:
            return count, lowest, spreads[count - 1]
    low = SHALLOWEST + STEP * stride * max(least - 1, 0)
    high = min(SHALLOWEST + STEP * stride * (least + 1), DEEPEST)
    near, _ = lowest_between(pixel, low, high, 1e-3, s)
    _, _, spread = polish(columns, amplitude, near, near, near, orders, lossy, W, sticky, 1, s, slope)
    chi2_least = _closest_at(pixel, near, s, best)
    return count, chi2_least, spread


@inner
def _closest_at(pixel: Pixel, t: float, s: Scratch, out: _Floats) -> float:
    """Return the least chi-squared within bounds at t, and fill the solution there."""
    Delta = exact_columns(pixel.columns, pixel.amplitude, t, pixel.orders, pixel.lossy, pixel.W, s)
    chi2, m, S = solved(reduce(s, pixel.sticky, pixel.loss), s, pixel.sticky, pixel.box)
    F = best_F(m, S, pixel.box)
    out[S_], out[F_], out[DELTA_] = S, F, 2.0 * pixel.amplitude * Delta
    out[C_] = m.c0 + m.c1 * S + m.c2 * F
    return chi2


@inner
def _fill_lagrange(s: Scratch, lagrange: _Floats) -> None:
    """Fill the polynomials through the places, each 1 at one of them, at the nodes of the table (place, node)."""
    count = s.places.shape[0]
    for k in range(NODES):
        t = min(max(SHALLOWEST + STEP * k, s.places[0]), s.places[count - 1])
        total, at = 0.0, -1
        for j in range(count):
            off = t - s.places[j]
            if off == 0.0:
                at = j
                off = 1.0
            lagrange[j, k] = s.poles[j] / off
            total += lagrange[j, k]
        for j in range(count):
            lagrange[j, k] = lagrange[j, k] / total if at < 0 else (1.0 if j == at else 0.0)


@kernel
def solve_pixels(
    y: _Floats,
    whitening: _Floats,
    amplitude: _Floats,
    usable: _Flags,
    columns: Columns,
    table: Table,
    cross: _Floats,
    orders: _Orders,
    lossy: _Flags,
    attraction: npt.NDArray[np.int64],
    box: Box,
    spans: _Floats,
    shifts: _Floats,
    solutions: _Floats,
    spreads: _Floats,
    best: _Floats,
    chi2: _Floats,
    count: npt.NDArray[np.int8],
) -> None:
    """Find every solution of every pixel.

    Parameters
    ----------
    y, whitening : array (pixel, row), (pixel or 1, row, row)
        Force harmonics [N] and what whitens their errors.
    amplitude, usable : array (pixel,)
        Of the tip [m]; False where there is nothing to invert.
    columns, table : Columns, Table
        The model, and its table for these amplitudes.
    cross : array (amplitude, 3, node)
        `fill_cross` for three conservative rows under adhesion; empty for anything else.
    orders, lossy : array (row,)
        As `overtone.inversion.forces.Rows` has them.
    attraction : array (1,)
        Row of CONS_1, whose sign says whether a search out of contact makes sense; -1 without.
    box : Box
        Bounds of the fallback where no sample could give the harmonics.
    spans, shifts : array (pixel, 2), (pixel, place, row)
        What the harmonics of the motion add to the force [N], at places between two t; for a bare cosine at none.
    solutions : array (pixel, MOST, 4)
        Filled: S, F_ad, S tan(delta), indentation; the one out of contact first, the deepest last; NaN beyond.
    spreads : array (pixel, MOST)
        Filled: standard deviation of S.
    best : array (pixel, 4)
        Filled: the closest one within bounds where there is no solution, else the deepest.
    chi2 : array (pixel,)
        Filled: chi-squared of ``best``.
    count : array (pixel,)
        Filled: how many solutions; `OUTSIDE` where the amplitude has no place in the table.
    """
    rows = orders.shape[0]
    n_max = table.elastic.shape[2] - 1
    places = shifts.shape[1]
    s = new_scratch(rows, n_max, places)
    lagrange = np.empty((places, NODES))
    there = np.empty(3)
    slope, g = np.empty(rows), np.empty(NODES)
    marks = np.zeros(8 * ((NODES + 7) // 8), np.uint8)
    words = marks.view(np.uint64)
    near, nodes_near = np.empty(_CANDIDATES), np.empty(_CANDIDATES, np.int64)
    nodes = (NODES - 1) // _STRIDE + 1
    bounded = np.empty(nodes)
    one = np.empty(4)
    square = cross.shape[0] > 0
    for i in range(y.shape[0]):
        solutions[i], spreads[i], best[i], chi2[i], count[i] = math.nan, math.nan, math.nan, math.nan, 0
        if not usable[i]:
            continue
        A = amplitude[i]
        slot, share = locate(table, A)
        if slot < 0:
            count[i] = OUTSIDE
            continue
        W = whitening[min(i, whitening.shape[0] - 1)]
        scale = elastic_scale(table, A)
        whiten(W, y[i], s.first)
        for j in range(places):
            whiten(W, shifts[i, j], s.shifts[j])
        if places > 0:
            set_places(s, spans[i, 0], spans[i, 1])
            if square:
                _fill_lagrange(s, lagrange)
        found = 0
        if square:
            found = _roots(
                y[i],
                A,
                columns,
                table,
                cross,
                slot,
                share,
                scale,
                orders,
                W,
                shifts[i],
                lagrange,
                g,
                marks,
                words,
                near,
                nodes_near,
                s,
                there,
                solutions[i],
                spreads[i],
            )
            chi2[i] = 0.0
        spread = math.inf
        if not square or found == 0:
            pixel = pixel_at(columns, A, table, slot, share, orders, lossy, W, box)
            found, chi2[i], spread = _least_squares(
                pixel, square, bounded, s, slope, solutions[i], spreads[i], best[i]
            )
        if found > 0:
            best[i] = solutions[i, found - 1]
            if not square:
                left = 0.0
                Delta = 0.5 * best[i, DELTA_] / A
                exact_columns(columns, A, math.log(Delta / (1.0 - Delta)), orders, lossy, W, s)
                for r in range(rows):
                    off = s.wy[r] - best[i, S_] * s.wa[r] - best[i, F_] * s.wb[r] - best[i, C_] * s.wv[r]
                    left += off * off
                chi2[i] = left
        else:
            spreads[i, 0] = spread
        if attraction[0] >= 0 and y[i, attraction[0]] > 0.0 and has_reach(columns):
            for r in range(rows):
                s.wy[r] = s.first[r]
            gap, F, misfit = closest_apart(A, columns, orders, lossy, W, s)
            limit = _APART_999 + rows - 2.0
            if F > 0.0 and misfit <= limit and found < MOST:
                for k in range(found, 0, -1):
                    solutions[i, k], spreads[i, k] = solutions[i, k - 1], spreads[i, k - 1]
                one[S_], one[F_], one[C_], one[DELTA_] = math.nan, F, math.nan, -gap
                solutions[i, 0], spreads[i, 0] = one, math.nan
                if found == 0:
                    best[i], chi2[i] = one, misfit
                found += 1
        count[i] = found
