"""Where along the indentation a posterior has its mass: stretches of t around the minima of chi-squared."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from overtone.inversion.search import Pixel, bounded_at, lowest_between, scan_valley
from overtone.inversion.table import NODES, SHALLOWEST, STEP
from overtone.inversion.valley import Scratch
from overtone.kernels import inner, lean

_Floats = npt.NDArray[np.float64]

STRIDE = 6
"""Of the table, in the first look at the valley."""
REACH = 20.0
"""Of chi-squared beyond its least, where stretches end."""
MODES = 3
"""Minima that are followed."""
_CORE = 9.0  # of chi-squared, within which a minimum has its core
_NARROW_CORE = 0.4  # of its stretch


@lean
def _edge(
    pixel: Pixel,
    s: Scratch,
    bounded: _Floats,
    where: float,
    depth: float,
    least: float,
    reach: float,
    limit: float,
    up: bool,
    closely: bool,
) -> float:
    """Return the t above or below a minimum at which chi-squared has risen by a reach over ``least``, or the limit.

    ``bounded`` holds chi-squared at the nodes of `scan_valley`; between two of them it is looked at ``closely``, or
    taken for a parabola.
    """
    width, target = STEP * STRIDE, least + reach
    inside, at_inside, outside, at_outside = where, depth, limit, math.inf
    # node by node until it is out
    place = (where - SHALLOWEST) / width
    k = math.floor(place) + 1 if up else math.ceil(place) - 1
    while 0 <= k < bounded.shape[0]:
        t = SHALLOWEST + width * k
        if (t >= limit) if up else (t <= limit):
            break
        if bounded[k] > target:
            outside, at_outside = t, bounded[k]
            break
        inside, at_inside = t, bounded[k]
        k += 1 if up else -1
    if at_outside == math.inf:
        return limit
    # until the end of the stretch is known to a part of its length
    for _ in range(60):
        x0, x1 = math.sqrt(max(at_inside - least, 0.0)), math.sqrt(at_outside - least)
        part = (math.sqrt(reach) - x0) / (x1 - x0)
        if not closely:
            return inside + part * (outside - inside)
        middle = inside + min(max(part, 0.25), 0.75) * (outside - inside)
        value = bounded_at(pixel, middle, s)
        if value > target:
            outside, at_outside = middle, value
            if value < target + 0.3 * reach:
                break
        else:
            inside, at_inside = middle, value
        if abs(outside - inside) < 0.01 * abs(inside - where):
            break
    return outside


@lean
def _vertex(bounded: _Floats, k: int, low: float, high: float) -> tuple[float, float]:
    """Return where, between two t, a parabola through a node and its neighbours is least, and how small it is."""
    width = STEP * STRIDE
    if not 0 < k < bounded.shape[0] - 1:
        return min(max(SHALLOWEST + width * k, low), high), bounded[k]
    tilt, bend = bounded[k - 1] - bounded[k + 1], bounded[k - 1] - 2.0 * bounded[k] + bounded[k + 1]
    shift = min(max(0.5 * tilt / bend, -0.5), 0.5) if bend > 0.0 else 0.0
    t = min(max(SHALLOWEST + width * (k + shift), low), high)
    x = (t - SHALLOWEST) / width - k
    return t, max(bounded[k] - 0.5 * tilt * x + 0.5 * bend * x * x, 0.0)


@inner
def find_stretches(
    pixel: Pixel,
    s: Scratch,
    bounded: _Floats,
    bottom: float,
    top: float,
    closely: bool,
    ends: _Floats,
    cores: _Floats,
) -> tuple[int, float, float]:
    """Fill the stretches of t that matter, and the core of each; return how many, the least chi-squared, and where.

    ``bottom`` and ``top`` are the t that the prior allows. Without ``closely`` all is known to a part of the distance
    of two nodes, for a tenth of the work, and cores are not looked for.
    """
    nodes = (NODES - 1) // STRIDE + 1
    width = STEP * STRIDE
    scan_valley(pixel, STRIDE, bounded, s)
    least, deepest_at = math.inf, bottom
    minima = 0
    where, depth = np.empty(MODES), np.empty(MODES)
    for k in range(nodes):
        t = SHALLOWEST + width * k
        if t < bottom - width or t > top + width:
            continue
        before = bounded[k - 1] if k > 0 and t - width > bottom - width else math.inf
        after = bounded[k + 1] if k < nodes - 1 and t + width < top + width else math.inf
        if not (bounded[k] <= before and bounded[k] < after):
            continue
        low, high = max(t - width, bottom), min(t + width, top)
        if not low < high:
            continue
        if closely:
            near, value = lowest_between(pixel, low, high, 2e-3, s)
        else:
            near, value = _vertex(bounded, k, low, high)
        if minima < MODES:
            where[minima], depth[minima] = near, value
            minima += 1
        else:  # the worst gives way
            worst = 0
            for j in range(1, MODES):
                if depth[j] > depth[worst]:
                    worst = j
            if value < depth[worst]:
                for j in range(worst, MODES - 1):
                    where[j], depth[j] = where[j + 1], depth[j + 1]
                where[MODES - 1], depth[MODES - 1] = near, value
        if value < least:
            least, deepest_at = value, near
    count = 0
    target = least + REACH
    for j in range(minima):
        if depth[j] > target:
            continue
        if count > 0 and where[j] <= ends[count - 1, 1]:
            continue  # within the stretch of the one before
        for side in range(2):
            limit = bottom if side == 0 else top
            up = side == 1
            ends[count, side] = _edge(pixel, s, bounded, where[j], depth[j], least, REACH, limit, up, closely)
            if closely:
                cores[count, side] = _edge(
                    pixel, s, bounded, where[j], depth[j], depth[j], _CORE, limit, up, closely
                )
        if count > 0 and ends[count, 0] < ends[count - 1, 1]:
            ends[count, 0] = ends[count - 1, 1]
        count += 1
    return count, least, deepest_at


@lean
def partition(ends: _Floats, cores: _Floats, count: int, parts: _Floats) -> int:
    """Fill the stretches, those with a narrow core in three parts; return how many there are.

    A peak on a plateau needs nodes as close as it is narrow, and the plateau does not.
    """
    found = 0
    for k in range(count):
        low, high = ends[k, 0], ends[k, 1]
        first, last = max(cores[k, 0], low), min(cores[k, 1], high)
        if not last - first < _NARROW_CORE * (high - low):
            parts[found, 0], parts[found, 1] = low, high
            found += 1
            continue
        for start, stop in ((low, first), (first, last), (last, high)):
            if stop - start > 1e-9:
                parts[found, 0], parts[found, 1] = start, stop
                found += 1
    return found
