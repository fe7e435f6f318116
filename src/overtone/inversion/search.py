"""Along the indentation: chi-squared within bounds at the nodes of the table, and where it is least between two."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from overtone.inversion.columns import Columns, adhesive
from overtone.inversion.table import NODES, SHALLOWEST, STEP, Table, elastic_scale
from overtone.inversion.valley import Box, Scratch, reduce, solved, tabulated_columns
from overtone.kernels import inlined, inner, lean

_Floats = npt.NDArray[np.float64]
_Orders = npt.NDArray[np.int64]
_Flags = npt.NDArray[np.bool_]

GOLDEN = 0.3819660112501051
"""Share of the golden section."""

_MOST_STEPS = 100
_EVEN = 0.02
_NARROWEST = 1e-10


class Pixel(NamedTuple):
    """What a search along the indentation of a pixel takes."""

    columns: Columns
    amplitude: float
    table: Table
    slot: int
    """Where the amplitude stands in the table, and"""
    share: float
    """how far it is to the next one."""
    scale: float
    """A1^p."""
    orders: _Orders
    lossy: _Flags
    W: _Floats
    sticky: bool
    """Whether the model has adhesion,"""
    loss: bool
    """and whether it has loss."""
    box: Box


@inner
def pixel_at(
    columns: Columns,
    amplitude: float,
    table: Table,
    slot: int,
    share: float,
    orders: _Orders,
    lossy: _Flags,
    W: _Floats,
    box: Box,
) -> Pixel:
    """Return a pixel that `overtone.inversion.table.locate` has found in the table."""
    scale = elastic_scale(table, amplitude)
    sticky, loss = adhesive(columns), columns.loss > 0.0
    return Pixel(columns, amplitude, table, slot, share, scale, orders, lossy, W, sticky, loss, box)


@inlined
def columns_at(pixel: Pixel, t: float, s: Scratch) -> float:
    """Fill the whitened columns and data of a pixel at t from the table; return Delta."""
    return tabulated_columns(
        pixel.table, pixel.slot, pixel.share, pixel.scale, t, pixel.orders, pixel.lossy, pixel.W, s
    )


@inlined
def bounded_at(pixel: Pixel, t: float, s: Scratch) -> float:
    """Return the least chi-squared within bounds at t, by the table."""
    columns_at(pixel, t, s)
    return solved(reduce(s, pixel.sticky, pixel.loss), s, pixel.sticky, pixel.box)[0]


@lean
def lowest_between(pixel: Pixel, low: float, high: float, width: float, s: Scratch) -> tuple[float, float]:
    """Return where the least chi-squared within bounds is smallest between two t, by golden section, and its size.

    Derivatives jump where a bound begins to hold, so none are used.
    """
    x1, x2 = low + GOLDEN * (high - low), high - GOLDEN * (high - low)
    f1, f2 = math.inf, math.inf
    first = True  # which of the two is new
    for step in range(_MOST_STEPS):
        value = bounded_at(pixel, x1 if first else x2, s)
        if first:
            f1 = value
        else:
            f2 = value
        if step == 0:
            first = False
            continue
        # a narrow valley goes on until both sides are as good: chi-squared counts in units of the noise
        if high - low <= width and (abs(f1 - f2) <= _EVEN or high - low <= _NARROWEST):
            break
        first = f1 < f2
        if first:
            high, x2, f2 = x2, x1, f1
            x1 = low + GOLDEN * (high - low)
        else:
            low, x1, f1 = x1, x2, f2
            x2 = high - GOLDEN * (high - low)
    return (x1, f1) if f1 < f2 else (x2, f2)


@lean
def scan_valley(pixel: Pixel, stride: int, bounded: _Floats, s: Scratch) -> int:
    """Fill the least chi-squared within bounds at every ``stride`` nodes of the table; return where it is least."""
    least = 0
    for k in range((NODES - 1) // stride + 1):
        t = SHALLOWEST + STEP * stride * k
        bounded[k] = bounded_at(pixel, t, s)
        if bounded[k] < bounded[least]:
            least = k
    return least
