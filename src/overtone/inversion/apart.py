"""Out of contact the attraction alone is left: how well it fits at a gap, and at which gap best."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from overtone.contact.terms import LINEAR_TAIL, VAN_DER_WAALS_TAIL, adhesion_harmonics
from overtone.inversion.columns import Columns
from overtone.inversion.search import GOLDEN
from overtone.inversion.valley import Scratch, whiten
from overtone.kernels import lean

_Floats = npt.NDArray[np.float64]
_Orders = npt.NDArray[np.int64]
_Flags = npt.NDArray[np.bool_]

_GAPS = 60
_CLOSEST, _FARTHEST = 1e-4, 1e4
"""Range of the gap out of contact, in units of a0."""


@lean
def apart(
    amplitude: float, gap: float, columns: Columns, orders: _Orders, lossy: _Flags, W: _Floats, s: Scratch
) -> tuple[float, float, float]:
    """Return chi-squared, the force of adhesion and the norm of its column where the tip stays a gap away."""
    contact = columns.contact
    n_max = s.work.shape[1] - 1
    adhesion_harmonics(
        contact.tail, amplitude, -0.5 * gap / amplitude, contact.a0, n_max, s.work[2], s.work[3]
    )
    for i in range(orders.shape[0]):
        s.b[i] = 0.0 if lossy[i] else s.work[2, orders[i]]
    whiten(W, s.b, s.wb)
    yy, by, bb = 0.0, 0.0, 0.0
    for i in range(orders.shape[0]):
        bb += s.wb[i] * s.wb[i]
        by += s.wb[i] * s.wy[i]
    F = max(by / bb, 0.0) if bb > 0.0 else 0.0
    for i in range(orders.shape[0]):
        left = s.wy[i] - F * s.wb[i]
        yy += left * left
    return yy, F, bb


@lean
def has_reach(columns: Columns) -> bool:
    """Return whether the attraction is felt out of contact."""
    tail = columns.contact.tail
    return bool(tail in (LINEAR_TAIL, VAN_DER_WAALS_TAIL))


@lean
def gap_range(columns: Columns, amplitude: float) -> tuple[float, float]:
    """Return the logarithms of the smallest and the largest gap that are searched out of contact."""
    a0 = columns.contact.a0
    most = (
        2.0 * a0 * (1.0 - 1e-9)
        if columns.contact.tail == LINEAR_TAIL
        else min(_FARTHEST * a0, 2.0 * amplitude)
    )
    return math.log(_CLOSEST * a0), math.log(most)


@lean
def closest_apart(
    amplitude: float, columns: Columns, orders: _Orders, lossy: _Flags, W: _Floats, s: Scratch
) -> tuple[float, float, float]:
    """Return the gap that fits best, the force of adhesion and chi-squared there."""
    start, stop = gap_range(columns, amplitude)
    width = (stop - start) / (_GAPS - 1)
    best, where = math.inf, 0
    for k in range(_GAPS):
        chi2, _, _ = apart(amplitude, math.exp(start + width * k), columns, orders, lossy, W, s)
        if chi2 < best:
            best, where = chi2, k
    low, high = start + width * max(where - 1, 0), start + width * min(where + 1, _GAPS - 1)
    x1, x2 = low + GOLDEN * (high - low), high - GOLDEN * (high - low)
    f1 = apart(amplitude, math.exp(x1), columns, orders, lossy, W, s)[0]
    f2 = apart(amplitude, math.exp(x2), columns, orders, lossy, W, s)[0]
    while high - low > 1e-8:
        if f1 < f2:
            high, x2, f2 = x2, x1, f1
            x1 = low + GOLDEN * (high - low)
            f1 = apart(amplitude, math.exp(x1), columns, orders, lossy, W, s)[0]
        else:
            low, x1, f1 = x1, x2, f2
            x2 = high - GOLDEN * (high - low)
            f2 = apart(amplitude, math.exp(x2), columns, orders, lossy, W, s)[0]
    gap = math.exp(0.5 * (low + high))
    chi2, F, _ = apart(amplitude, gap, columns, orders, lossy, W, s)
    return gap, F, chi2
