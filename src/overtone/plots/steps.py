"""Colour scales whose steps are as wide as what one pixel leaves open: no contrast that the intervals do not support.

A step is the median 90 % interval of the determined pixels, or up to half as much again. Values two steps apart are
then different for a pixel with a typical interval, at more than two standard deviations of their difference (3.29 over
the root of two); neighbouring steps may hold one value, for a scale has edges somewhere. They lie where the fewest
pixels are, so that the scatter of one material does not fall on two colours where one can hold it.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import numpy.typing as npt
from matplotlib.colors import ListedColormap

from overtone.plots.scales import MISSING_COLOUR, Array, Limits, Mask, Scale, robust_limits, scale_of
from overtone.units import format_quantity

_CONTINUOUS = 0.02  # of the range: finer steps are not seen
_LOGARITHMIC_FROM = 3.0  # between the limits
_FINE = 12  # parts of a step
_WIDEST = 18  # of them, in one step
_OF_THE_ENDS = 0.2  # what a pixel counts whose interval ends at an edge, against one whose median lies there
_WASTE = 1e-4  # share of pixels that a wider step has to save
_FARTHEST = 10.0  # factor beyond the medians, to which a scale follows the intervals


def interval_scale(
    name: str,
    unit: str,
    median: Array,
    lower: Array,
    upper: Array,
    veil: Mask,
    within: Limits | None = None,
) -> Scale | None:
    """Return one scale for a property and both ends of its interval, None where no pixel is determined.

    Parameters
    ----------
    name, unit : str
        Name of the property, and its unit where the name is not a known one.
    median, lower, upper : array
        SI values of one shape.
    veil : array of bool
        True where a value is not determined: these set neither limits nor steps.
    within : tuple of float, optional
        Limits in SI units that the steps have to cover; those of the determined pixels where not given.
    """
    sure = ~veil & np.isfinite(median) & np.isfinite(lower) & np.isfinite(upper)
    if not sure.any():
        return None
    median, lower, upper = median[sure], lower[sure], upper[sure]
    positive = (lower > 0.0) & (median > 0.0)
    whole = within or robust_limits(np.concatenate([median, lower, upper]), positive=False)
    logarithmic = bool(positive.mean() > 0.9) and whole[1] > _LOGARITHMIC_FROM * max(whole[0], 0.0)
    if logarithmic:
        median, lower, upper = np.log(median[positive]), np.log(lower[positive]), np.log(upper[positive])
        reach = math.log(_FARTHEST)
    else:
        reach = max(float(np.ptp(median)), float(np.median(upper - lower)))
    step = float(np.median(upper - lower))
    if within is None:
        low, high = robust_limits(np.concatenate([median, lower, upper]), positive=False)
        inner = robust_limits(median, positive=False)
        low, high = max(low, inner[0] - reach), min(high, inner[1] + reach)
    else:
        low, high = map(math.log, within) if logarithmic else within
    fine = step <= _CONTINUOUS * (high - low)
    steps = np.empty(0, int)
    if not fine:
        low, high, steps = _steps(median, np.concatenate([lower, upper]), step, low, high)
    ends = (math.exp(low), math.exp(high)) if logarithmic else (low, high)
    scale = scale_of(name, unit, np.asarray(ends), None, ends, logarithmic=logarithmic)
    if fine:
        return scale
    edges = low + step / _FINE * np.concatenate([[0], np.cumsum(steps)])
    edges = (np.exp(edges) if logarithmic else edges) * scale.factor
    shades = scale.colours(np.repeat(np.linspace(0.0, 1.0, steps.size), steps))
    return replace(
        scale,
        colours=ListedColormap(shades, name=scale.colours.name).with_extremes(bad=MISSING_COLOUR),
        edges=tuple(float(edge) for edge in edges),
        step=f"× {_factor(math.exp(step))}" if logarithmic else format_quantity(step, scale.si_unit, 2),
    )


def beyond(scale: Scale, *parts: Array) -> Scale:
    """Return the scale with the word whether any of these SI values lie below or above it."""
    every = np.concatenate([np.asarray(part, dtype=float).ravel() for part in parts]) * scale.factor
    low, high = scale.limits
    slack = 1e-9 * (high - low)
    return replace(scale, beyond=(bool((every < low - slack).any()), bool((every > high + slack).any())))


def _steps(
    medians: Array, ends: Array, step: float, low: float, high: float
) -> tuple[float, float, npt.NDArray[np.int_]]:
    """Return the limits that steps have which cover a range, and the width of each in parts of a step; two at least.

    Every step is as wide as asked for, or up to half as much again. Of all such ways to divide the range it is the one
    whose edges lie on the fewest pixels, by dynamic programming over a fine grid: the best way to an edge goes over the
    best way to the one before.
    """
    points = math.ceil((high - low) / step * _FINE - 1e-6) + 2 * _FINE + 1
    grid: Array = np.asarray(low - step + step / _FINE * np.arange(points), dtype=float)
    cost = _crowd(medians, grid, step) + _OF_THE_ENDS * _crowd(ends, grid, step)
    best = np.where(grid <= low + 1e-9 * step, cost + _WASTE * (low - grid) / step, np.inf)
    before = np.full(grid.size, -1)
    for i in range(_FINE, grid.size):
        widths = np.arange(_FINE, min(_WIDEST, i) + 1)
        ways = best[i - widths] + _WASTE * (widths - _FINE)
        found = int(np.argmin(ways))
        if ways[found] + cost[i] < best[i]:
            best[i], before[i] = ways[found] + cost[i], i - widths[found]
    last = np.flatnonzero(grid >= high - 1e-9 * step)
    last = last[before[last] >= 0]
    edges = [int(last[np.argmin(best[last] + _WASTE * (grid[last] - high) / step)])]
    while before[edges[0]] >= 0:
        edges.insert(0, int(before[edges[0]]))
    first, widths = float(grid[edges[0]]), np.diff(edges)
    if widths.size == 1:  # one colour tells no scale
        first, widths = first - step, np.array([_FINE, widths[0], _FINE])
    return first, first + step / _FINE * float(widths.sum()), widths


def _crowd(values: Array, grid: Array, step: float) -> Array:
    """Return which share of the values lies about each point of the grid, smoothly."""
    counts, _ = np.histogram(values, np.append(grid, grid[-1] + step / _FINE) - 0.5 * step / _FINE)
    reach = np.arange(-_FINE // 2, _FINE // 2 + 1) / (_FINE / 6.0)
    return np.convolve(counts / max(values.size, 1), np.exp(-0.5 * reach**2), mode="same")


def _factor(value: float) -> str:
    """Write a factor so that it is told from one."""
    return f"{value:.2g}" if value >= 1.1 else f"{value:.3g}"
