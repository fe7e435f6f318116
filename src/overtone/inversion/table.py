"""The columns of a contact model in a table over indentation and amplitude, for scans of millions of pixels.

A search over the indentation asks for the same columns again and again, and within a scan the amplitude hardly
changes. So they are tabulated once: over ``t = ln(Delta/(1 - Delta))`` with their slopes, between which cubic Hermite
polynomials interpolate, and over ``ln A1`` in steps so fine that a straight line will do (relative errors below 2e-6;
with a linear tail next to permanent contact, where the far turning point enters it, 3e-4). The grids are the same for
every scan, so that no pixel's answer depends on its neighbours.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from overtone.inversion.columns import WORK_ROWS, Columns, fill_columns
from overtone.kernels import inlined, kernel, lean

_Floats = npt.NDArray[np.float64]

SHALLOWEST, DEEPEST = -11.5, 7.0
"""Range of t: Delta from 1e-5 to 0.9991."""
NODES = 149
STEP = (DEEPEST - SHALLOWEST) / (NODES - 1)
_FINENESS = 500.0  # steps of the amplitude in a factor of e
_MOST_STEPS = 4000


class Table(NamedTuple):
    """Columns of one model over t and ln A1."""

    elastic: _Floats
    """(amplitude, node, order, 2): a_n over A1^p Delta^(p + 1/2), and its derivative by t."""
    adhesion: _Floats
    """(amplitude, node, order, 2): b_n, and its derivative by t."""
    slots: npt.NDArray[np.int64]
    """(step,): where the steps of ln A1 stand, -1 for those that no pixel needs."""
    first: int
    """First step of ``slots``."""
    power: float
    """p of the first elastic term, p0."""


@kernel
def _fill(columns: Columns, amplitudes: _Floats, elastic: _Floats, adhesion: _Floats) -> None:
    n_max = elastic.shape[2] - 1
    work = np.empty((WORK_ROWS, n_max + 1))
    p = columns.powers[0]
    for i in range(amplitudes.shape[0]):
        A = amplitudes[i]
        for k in range(NODES):
            t = SHALLOWEST + STEP * k
            Delta = 1.0 / (1.0 + math.exp(-t))
            by_t = Delta * (1.0 - Delta)
            fill_columns(columns, A, Delta, n_max, work)
            scale = 1.0 / (A**p * Delta ** (p + 0.5))
            slope = -(p + 0.5) * (1.0 - Delta)
            for n in range(n_max + 1):
                elastic[i, k, n, 0] = scale * work[0, n]
                elastic[i, k, n, 1] = scale * (by_t * work[1, n] + slope * work[0, n])
                adhesion[i, k, n, 0] = work[2, n]
                adhesion[i, k, n, 1] = by_t * work[3, n]


def table_of(columns: Columns, amplitude: npt.NDArray[np.float64], n_max: int) -> Table:
    """Return the table that pixels of these amplitudes need.

    Parameters
    ----------
    columns : Columns
        The model.
    amplitude : array (pixel,)
        Amplitudes of the tip [m], positive where a pixel is to be inverted.
    n_max : int
        Highest harmonic.
    """
    steps = np.unique(np.floor(np.log(amplitude[amplitude > 0.0]) * _FINENESS).astype(np.int64))
    steps = np.unique(np.concatenate([steps, steps + 1])) if steps.size else np.zeros(1, np.int64)
    if steps.size > _MOST_STEPS:  # lost pixels, at any amplitude, must not cost the others their place
        typical = np.floor(np.log(np.median(amplitude[amplitude > 0.0])) * _FINENESS)
        steps = np.sort(steps[np.argsort(np.abs(steps - typical), kind="stable")[:_MOST_STEPS]])
    slots = np.full(steps[-1] - steps[0] + 1, -1, np.int64)
    slots[steps - steps[0]] = np.arange(steps.size)
    elastic, adhesion = (np.empty((steps.size, NODES, n_max + 1, 2)) for _ in range(2))
    _fill(columns, np.exp(steps / _FINENESS), elastic, adhesion)
    return Table(elastic, adhesion, slots, int(steps[0]), float(columns.powers[0]))


@lean
def locate(table: Table, amplitude: float) -> tuple[int, float]:
    """Return where an amplitude stands in a table, and how far it is to the next one; -1 where it does not."""
    if not amplitude > 0.0:
        return -1, 0.0
    place = math.log(amplitude) * _FINENESS
    step = math.floor(place)
    k = int(step) - table.first
    if k < 0 or k + 1 >= table.slots.shape[0] or table.slots[k] < 0 or table.slots[k + 1] < 0:
        return -1, 0.0
    return int(table.slots[k]), place - step


@inlined
def elastic_scale(table: Table, amplitude: float) -> float:
    """Return A1^p, which the elastic columns of a table want."""
    return amplitude * math.sqrt(amplitude) if table.power == 1.5 else float(amplitude**table.power)


@inlined
def interpolate(
    table: Table,
    slot: int,
    share: float,
    scale: float,
    t: float,
    orders: npt.NDArray[np.int64],
    a: _Floats,
    b: _Floats,
) -> float:
    """Fill a and b of the rows of a pixel at t; return Delta.

    ``scale`` is A1^p; ``orders`` are those of the rows.
    """
    place = (t - SHALLOWEST) / STEP
    k = min(max(int(place), 0), NODES - 2)
    s = place - k
    s2, s3 = s * s, s * s * s
    h01 = 3.0 * s2 - 2.0 * s3
    h00, h10, h11 = 1.0 - h01, (s - 2.0 * s2 + s3) * STEP, (s3 - s2) * STEP
    Delta = 1.0 / (1.0 + math.exp(-t))
    grow = scale * (Delta * Delta if table.power == 1.5 else Delta ** (table.power + 0.5))
    E0, E1 = table.elastic[slot], table.elastic[slot + 1]
    F0, F1 = table.adhesion[slot], table.adhesion[slot + 1]
    for i in range(orders.shape[0]):
        n = orders[i]
        low = h00 * E0[k, n, 0] + h10 * E0[k, n, 1] + h01 * E0[k + 1, n, 0] + h11 * E0[k + 1, n, 1]
        high = h00 * E1[k, n, 0] + h10 * E1[k, n, 1] + h01 * E1[k + 1, n, 0] + h11 * E1[k + 1, n, 1]
        a[i] = grow * (low + share * (high - low))
        low = h00 * F0[k, n, 0] + h10 * F0[k, n, 1] + h01 * F0[k + 1, n, 0] + h11 * F0[k + 1, n, 1]
        high = h00 * F1[k, n, 0] + h10 * F1[k, n, 1] + h01 * F1[k + 1, n, 0] + h11 * F1[k + 1, n, 1]
        b[i] = low + share * (high - low)
    return Delta


@kernel
def interpolate_block(
    table: Table, amplitude: _Floats, t: _Floats, orders: npt.NDArray[np.int64], a: _Floats, b: _Floats
) -> None:
    """Fill a and b (point, row) for every point; NaN where the table does not reach."""
    for i in range(t.shape[0]):
        slot, share = locate(table, amplitude[i])
        if slot < 0:
            a[i], b[i] = math.nan, math.nan
            continue
        interpolate(table, slot, share, elastic_scale(table, amplitude[i]), t[i], orders, a[i], b[i])
