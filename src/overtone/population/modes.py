"""Where a cloud of points is dense: its modes, the passes between them, and how deep a valley along a line is.

No shape is assumed. A mode is a place from which every way out leads through thinner regions; two modes are told apart
by the density of the highest pass between them, so that a bent or skew cloud stays one. The density is that of the
nearest neighbours, which adapts to clouds of very different width.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

_Floats = npt.NDArray[np.float64]
_Mask = npt.NDArray[np.bool_]

_NEIGHBOURS = 24
_PROMINENCE = 0.6
"""Of a mode over its pass, in ln density: about three standard deviations of the density of so many neighbours."""
_PARTS, _FEWEST_PARTS = 6, 4
"""A window of the density along a line holds this part of the smaller side; the second one if that is small."""
_FEWEST = 5  # points in a window


class Modes(NamedTuple):
    """Modes of a cloud."""

    label: npt.NDArray[np.intp]
    """(point,): the mode it lies under; one of few points that is no mode of its own has a label all the same."""
    modes: list[int]
    """Labels of those with enough points."""
    passes: dict[tuple[int, int], float]
    """ln of the density of the pass between two modes that touch."""


def modes_of(points: _Floats, fewest: int) -> Modes:
    """Return the modes of a cloud.

    Parameters
    ----------
    points : array (point, coordinate)
        In units in which all coordinates are alike.
    fewest : int
        Points that a mode must have.

    Notes
    -----
    Points are taken from dense to thin; each joins the mode of a denser neighbour, and where two modes meet the lower
    one is merged unless it stands out enough (by persistence: Chazal, Guibas, Oudot and Skraba, J. ACM 60 (2013) 41).
    """
    from scipy.spatial import cKDTree

    count, dimensions = points.shape
    near = min(_NEIGHBOURS, count - 1)
    distance, neighbours = cKDTree(points).query(points, near + 1)
    density = -dimensions * np.log(np.maximum(distance[:, near], np.finfo(float).tiny))
    order = np.argsort(-density, kind="stable")
    rank = np.empty(count, np.intp)
    rank[order] = np.arange(count)
    # in the order of density, a denser point has a smaller index
    links = rank[neighbours[order, 1:]].tolist()
    height = density[order].tolist()
    root = list(range(count))
    size = [1] * count
    passes: dict[tuple[int, int], float] = {}

    def find(i: int) -> int:
        while root[i] != i:
            root[i] = root[root[i]]
            i = root[i]
        return i

    for i in range(count):
        # most neighbours have one root: it is looked for once
        found = sorted({find(j) for j in {root[j] for j in links[i] if j < i}})
        if not found:
            continue
        top = found[0]
        root[i] = top
        size[top] += 1
        for other in found[1:]:
            if height[other] - height[i] < _PROMINENCE or size[other] < fewest:
                root[other] = top
                size[top] += size[other]
            else:
                passes.setdefault((top, other), height[i])
    ends = np.array([find(i) for i in range(count)], np.intp)
    between: dict[tuple[int, int], float] = {}
    for (i, j), level in passes.items():
        a, b = sorted((find(i), find(j)))
        if a != b:
            between[a, b] = max(between.get((a, b), -np.inf), level)
    label = np.empty(count, np.intp)
    label[order] = ends
    return Modes(label, [int(r) for r in np.unique(ends) if size[r] >= fewest], between)


def divisions(found: Modes) -> list[set[int]]:
    """Return the ways to divide modes in two: one side of each, that across the lowest pass first."""
    group = {mode: mode for mode in found.modes}

    def find(i: int) -> int:
        while group[i] != i:
            i = group[i]
        return i

    links = sorted(
        ((level, a, b) for (a, b), level in found.passes.items() if a in group and b in group), reverse=True
    )
    tree = []
    for level, a, b in links:
        if find(a) != find(b):
            group[find(a)] = find(b)
            tree.append((level, a, b))
    first = find(found.modes[0]) if found.modes else 0
    for mode in found.modes:
        if find(mode) != first:
            group[find(mode)] = first
            tree.append((-np.inf, mode, first))
    sides = []
    for cut in sorted(tree):
        side, grown = {cut[1]}, True
        while grown:
            more = {m for link in tree if link is not cut and side & {*link[1:]} for m in link[1:]}
            grown = not more <= side
            side |= more
        sides.append(side)
    return sides


def valleys(along: _Floats, low: float, high: float) -> list[tuple[float, float]]:
    """Return how deep valleys along a line are, and where.

    Parameters
    ----------
    along : array (point,)
        Places of points.
    low, high : float
        Between which they may lie.

    Returns
    -------
    list of (float, float)
        Density in the valley over that of the lower of the summits at its sides (1 or more without one), and the place
        of its ground; the deepest one for every width of the window, the widest window first.

    Notes
    -----
    A density is that of a window with a sixth of the points on the smaller side of the place: a cut that leaves many
    points on both sides is judged by wide windows, one that leaves few by narrow ones.
    """
    ordered = np.sort(along)
    count = len(ordered)
    found = []
    window = _FEWEST
    while _FEWEST_PARTS * window <= 0.5 * count:
        first = np.arange(0, count - window, max(1, window // 8))
        left, right = ordered[first], ordered[first + window]
        density = window / np.maximum(right - left, np.finfo(float).tiny)
        middle = first + window // 2
        smaller = np.minimum(middle, count - middle) / window
        where = 0.5 * (left + right)
        least = _PARTS if window > _FEWEST else _FEWEST_PARTS
        fits = (where > low) & (where < high) & (smaller >= least) & (smaller < 1.5 * _PARTS)
        if fits.any():
            before = np.maximum.accumulate(density)
            after = np.maximum.accumulate(density[::-1])[::-1]
            ratio = np.where(fits, density / np.minimum(before, after), np.inf)
            ground = int(np.argmin(ratio))
            found.append((float(ratio[ground]), float(where[ground])))
        window = -(-3 * window // 2)
    return found[::-1]
