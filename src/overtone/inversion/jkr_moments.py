"""Moments of the JKR force over a cycle, tabulated over the two ratios that they depend on.

JKR has one length of its own, ``L = (pi w sqrt(R)/K)^(2/3)`` with ``K = 4/3 E*``, and one force, ``pi w R``. On the
bare cosine three numbers therefore say everything: the force, and two ratios,

    depth = delta_max/L          span = (delta_max + x_f L)/(2 A1),    x_f = 3/6^(2/3)

where ``-x_f L`` is the indentation at which the neck lets go: ``span`` is the share of the way down that the contact
lasts on retraction, between 0 and 1 for a tip that leaves it once per cycle.

Moments, not harmonics: with ``h = 1 - cos(psi)``, the height above the lowest point over A1, harmonics of a short
contact differ only at second order, while ``m_k``, the mean of ``F h^k``, are as many independent numbers.
"""

from __future__ import annotations

import functools
import math

import numpy as np
import numpy.typing as npt

from overtone.contact.adhesive import Curve, branch
from overtone.kernels import inner, kernel

FOLD = 3.0 * 6.0 ** (-2.0 / 3.0)
"""x_f: the stable branch of JKR ends at the indentation -x_f L."""
SPANS = (1e-4, 0.9)
"""Spans that the table covers; beyond the upper one the tip hardly leaves the contact any more."""
DEEPEST = 1000.0
"""Largest depth it covers: adhesion then is 5e-5 of the peak force."""
MOMENTS = 4

_ROWS, _COLUMNS = 61, 121
_PANELS = np.array([0.0, 0.01, 0.04, 0.15, 0.45, 1.0])  # finer towards the fold
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(16)
_CURVE = Curve(math.inf, -FOLD, FOLD, -math.inf, 0.0, 0.0)

_Floats = npt.NDArray[np.float64]


def _row(span: float) -> float:
    """Return ln tan(c/4) with ``span = sin(c/2)^2``: half the logarithm of a small span, smooth up to 1."""
    return math.log(math.tan(0.5 * math.asin(math.sqrt(span))))


def _column(depth: float) -> float:
    """Return ln(1 + sqrt(depth)), in which the moments are smooth down to a depth of zero."""
    return math.log(1.0 + math.sqrt(depth))


row_of, column_of = inner(_row), inner(_column)
LOWEST_ROW, HIGHEST_ROW, LAST_COLUMN = _row(SPANS[0]), _row(SPANS[1]), _column(DEEPEST)
_PER_ROW, _PER_COLUMN = (HIGHEST_ROW - LOWEST_ROW) / (_ROWS - 1), LAST_COLUMN / (_COLUMNS - 1)


@inner
def span_of(row: float) -> tuple[float, float]:
    """Return the span, and its slope."""
    half = 2.0 * math.atan(math.exp(row))
    s = math.sin(half)
    return s * s, 2.0 * s * s * math.cos(half)


@inner
def depth_of(column: float) -> tuple[float, float]:
    """Return the depth, and its slope."""
    root = math.expm1(column)
    return root * root, 2.0 * root * (root + 1.0)


@functools.cache
def moment_table() -> _Floats:
    """Return scaled moments over (row, column): value, slopes by row and column, and mixed slope, of four moments.

    Shape (row, column, moment, 4). Rows are evenly spaced in ``ln tan(c/4)`` with ``span = sin(c/2)^2``, columns in
    ``ln(1 + sqrt(depth))``. Slopes are per step, those of the cubic spline through the values; the moments are divided
    by ``span^(k + 1/2) (1 + depth^(3/2))``.
    """
    from scipy.interpolate import RectBivariateSpline

    rows, columns = np.linspace(LOWEST_ROW, HIGHEST_ROW, _ROWS), np.linspace(0.0, LAST_COLUMN, _COLUMNS)
    values = np.empty((_ROWS, _COLUMNS, MOMENTS))
    _fill_moments(rows, columns, values)
    i, j = np.arange(_ROWS, dtype=float), np.arange(_COLUMNS, dtype=float)
    table = np.empty((_ROWS, _COLUMNS, MOMENTS, 4))
    for k in range(MOMENTS):
        spline = RectBivariateSpline(i, j, values[..., k])
        for part, (by_row, by_column) in enumerate(((0, 0), (1, 0), (0, 1), (1, 1))):
            table[:, :, k, part] = spline(i, j, dx=by_row, dy=by_column)
    table.setflags(write=False)
    return table


@kernel
def _fill_moments(rows: _Floats, columns: _Floats, values: _Floats) -> None:
    """Fill scaled moments (row, column, moment) by Gauss-Legendre, the roots at fold and touch substituted away."""
    for i in range(rows.size):
        span, _ = span_of(rows[i])
        for j in range(columns.size):
            depth, _ = depth_of(columns[j])
            swing = (depth + FOLD) / span  # 2 A1/L
            for k in range(MOMENTS):
                values[i, j, k] = 0.0
            for way in range(2):  # on retraction down to the fold, on approach from a gap of zero on
                reach = depth + FOLD if way == 0 else depth
                above = 0.0 if way == 0 else FOLD  # excess over the fold where the way begins
                angle = 2.0 * math.asin(math.sqrt(reach / swing))
                for panel in range(_PANELS.size - 1):
                    middle = 0.5 * (_PANELS[panel] + _PANELS[panel + 1])
                    half = 0.5 * (_PANELS[panel + 1] - _PANELS[panel])
                    for node in range(_NODES.size):
                        s = middle + half * _NODES[node]
                        psi = angle * (1.0 - s * s)
                        rise = swing * math.sin(0.5 * (angle - psi)) * math.sin(0.5 * (angle + psi))
                        force, _ = branch(_CURVE, above + rise - FOLD, above + rise, 0.0)
                        height = math.sin(0.5 * psi) ** 2 / span  # half of h over the span
                        part = force * angle * s * half * _WEIGHTS[node] / math.pi
                        for k in range(MOMENTS):
                            values[i, j, k] += part
                            part *= 2.0 * height
            for k in range(MOMENTS):
                values[i, j, k] /= math.sqrt(span) * (1.0 + depth * math.sqrt(depth))


@inner
def _interpolate(table: _Floats, row: float, column: float, out: _Floats) -> None:
    """Fill scaled moments and their slopes by row and column (3, moment) at a place of the table, in steps."""
    i = min(max(int(row), 0), _ROWS - 2)
    j = min(max(int(column), 0), _COLUMNS - 2)
    t, u = row - i, column - j
    p = (1.0 - t * t * (3.0 - 2.0 * t), t * t * (3.0 - 2.0 * t), t * (1.0 - t) ** 2, t * t * (t - 1.0))
    q = (1.0 - u * u * (3.0 - 2.0 * u), u * u * (3.0 - 2.0 * u), u * (1.0 - u) ** 2, u * u * (u - 1.0))
    dp = (-6.0 * t * (1.0 - t), 6.0 * t * (1.0 - t), (1.0 - t) * (1.0 - 3.0 * t), t * (3.0 * t - 2.0))
    dq = (-6.0 * u * (1.0 - u), 6.0 * u * (1.0 - u), (1.0 - u) * (1.0 - 3.0 * u), u * (3.0 * u - 2.0))
    for k in range(MOMENTS):
        value, by_row, by_column = 0.0, 0.0, 0.0
        for a in range(2):
            for b in range(2):
                f = table[i + a, j + b, k]
                along = f[0] * q[b] + f[2] * q[b + 2]
                slope = f[1] * q[b] + f[3] * q[b + 2]
                value += p[a] * along + p[a + 2] * slope
                by_row += dp[a] * along + dp[a + 2] * slope
                by_column += p[a] * (f[0] * dq[b] + f[2] * dq[b + 2])
                by_column += p[a + 2] * (f[1] * dq[b] + f[3] * dq[b + 2])
        out[0, k], out[1, k], out[2, k] = value, by_row, by_column


@inner
def direction(
    table: _Floats, basis: _Floats, row: float, column: float, scale: float, work: _Floats, v: _Floats
) -> float:
    """Fill the combinations of moments over pi w R and their slopes by row and column (3, combination).

    ``scale`` divides h: combination i goes by ``scale^-i``, which keeps the three comparable. Returns the norm of the
    first line.
    """
    _interpolate(table, (row - LOWEST_ROW) / _PER_ROW, column / _PER_COLUMN, work)
    span, span_slope = span_of(row)
    depth, depth_slope = depth_of(column)
    size = 1.0 + depth * math.sqrt(depth)
    growth = 1.5 * math.sqrt(depth) * depth_slope / size
    square = 0.0
    for i in range(3):
        v[0, i] = v[1, i] = v[2, i] = 0.0
        for k in range(i, MOMENTS):
            weight = basis[i, k] * span ** (k + 0.5) * scale ** (-i) * size
            v[0, i] += weight * work[0, k]
            v[1, i] += weight * (work[1, k] / _PER_ROW + (k + 0.5) * span_slope / span * work[0, k])
            v[2, i] += weight * (work[2, k] / _PER_COLUMN + growth * work[0, k])
        square += v[0, i] ** 2
    return math.sqrt(square)
