"""Drift along the slow axis: a random walk from line to line, as far as the lines show it."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

_Floats = npt.NDArray[np.float64]

_FEWEST = 3  # pixels that tell their own scatter
_LEAST = 1e-6  # of the scatter: a walk that no data show is still a walk
_WALKS = 48
_UNLIKELY = 1e-3  # of the best walk: one that hardly counts


def smooth_lines(values: _Floats, usable: npt.NDArray[np.bool_]) -> tuple[_Floats, _Floats]:
    """Return the drift of a quantity over lines, from the pixels of each line that may be used.

    Parameters
    ----------
    values : array (line, pixel)
        Any unit; NaN does not count.
    usable : array (line, pixel)
        Which pixels count; lines with fewer than three are bridged.

    Returns
    -------
    drift, error : array (line,)
        Mean of each line as a random walk smooths it, and its standard deviation; infinite where no line counts.

    Notes
    -----
    Medians of lines, with the scatter within them, are readings of a random walk. How far it steps is not taken from
    the differences of neighbours, which hide a slow walk in their noise, but from the likelihood of all lines, and
    averaged over what that leaves open. Pixels of a line count as independent of each other.
    """
    lines = values.shape[0]
    middle, error = np.zeros(lines), np.full(lines, math.inf)
    for i in range(lines):
        known = values[i][usable[i] & np.isfinite(values[i])]
        if known.size >= _FEWEST:
            middle[i] = np.median(known)
            spread = 1.4826 * float(np.median(np.abs(known - middle[i])))
            error[i] = 1.2533 * spread / math.sqrt(known.size)
    some = np.isfinite(error)
    if not some.any():
        return np.zeros(lines), error
    floor = float(np.median(error[some])) or 1e-30
    error = np.where(some, np.maximum(error, 0.1 * floor), math.inf)
    at = np.flatnonzero(some)
    if at.size < _FEWEST:
        level = float(np.average(middle[some], weights=error[some] ** -2))
        return np.full(lines, level), np.full(lines, float(np.sum(error[some] ** -2) ** -0.5))
    widest = 10.0 * max(float(np.max(np.diff(middle[at]) ** 2)), floor**2)
    walks = np.geomspace(_LEAST * floor**2, widest, _WALKS)
    evidence = _evidence(middle[at], error[at], np.diff(at), walks)
    share = np.exp(evidence - evidence.max())
    likely = np.flatnonzero(share > _UNLIKELY)
    share = share[likely] / share[likely].sum()
    drifts, variances = (
        np.array(part)
        for part in zip(*(_smoothed(middle, error, walk) for walk in walks[likely]), strict=True)
    )
    drift = share @ drifts
    return drift, np.sqrt(share @ (variances + (drifts - drift) ** 2))


def _evidence(middle: _Floats, error: _Floats, gaps: npt.NDArray[np.int64], walks: _Floats) -> _Floats:
    """Return the logarithm of the likelihood of readings of a random walk, by the variance of its step."""
    mean, variance = np.full(walks.shape, middle[0]), np.full(walks.shape, error[0] ** 2)
    result = np.zeros(walks.shape)
    for reading, sigma, gap in zip(middle[1:], error[1:], gaps, strict=True):
        variance = variance + walks * gap
        off, total = reading - mean, variance + sigma**2
        result -= 0.5 * (np.log(total) + off**2 / total)
        mean = mean + variance / total * off
        variance = variance * sigma**2 / total
    return result


def _smoothed(middle: _Floats, error: _Floats, walk: float) -> tuple[_Floats, _Floats]:
    """Return mean and variance of a random walk at every line, by its readings before and after."""
    from scipy.linalg import solveh_banded

    # minimise sum (m - d)^2/e^2 + sum (d_{i+1} - d_i)^2/walk
    lines = middle.size
    weight = error**-2.0  # 0 for lines without a reading
    diagonal = weight + (np.r_[0.0, np.ones(lines - 1)] + np.r_[np.ones(lines - 1), 0.0]) / walk
    banded = np.vstack([np.r_[0.0, np.full(lines - 1, -1.0 / walk)], diagonal])
    scale = float(diagonal.max())
    solved = solveh_banded(banded / scale, np.column_stack([weight * middle, np.eye(lines)]) / scale)
    return solved[:, 0], np.maximum(np.diag(solved[:, 1:]), 0.0)
