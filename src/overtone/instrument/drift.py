"""Drift along the slow axis: a random walk from line to line, as far as the lines show it."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

_Floats = npt.NDArray[np.float64]

_LEAST = 1e-6  # of the scatter: a walk that no data show is still a walk


def smooth_lines(
    values: npt.NDArray[np.float64], usable: npt.NDArray[np.bool_]
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Return the drift of a quantity over lines, from the pixels of each line that may be used.

    Parameters
    ----------
    values : array (line, pixel)
        Any unit.
    usable : array (line, pixel)
        Which pixels count; lines without any are bridged.

    Returns
    -------
    drift, error : array (line,)
        Mean of each line as a random walk smooths it, and its standard deviation.

    Notes
    -----
    The step of the walk is told by how much more the medians of neighbouring lines differ than the scatter within them
    explains; the smoothing is that of a Kalman filter there and back, solved at once.
    """
    from scipy.linalg import solveh_banded

    lines = values.shape[0]
    middle, error = np.zeros(lines), np.full(lines, math.inf)
    for i in range(lines):
        known = values[i][usable[i]]
        if known.size:
            middle[i] = np.median(known)
            spread = 1.4826 * np.median(np.abs(known - middle[i])) if known.size > 2 else math.inf
            error[i] = 1.2533 * spread / math.sqrt(known.size)
    some = np.isfinite(error)
    if not some.any():
        return np.zeros(lines), np.full(lines, math.inf)
    floor = float(np.median(error[some])) or 1e-30
    error = np.where(some, np.maximum(error, 0.1 * floor), math.inf)
    at = np.flatnonzero(some)
    if at.size < 3:
        level = float(np.average(middle[some], weights=error[some] ** -2))
        return np.full(lines, level), np.full(lines, float(np.sum(error[some] ** -2) ** -0.5))
    steps, gaps = np.diff(middle[at]), np.diff(at)
    excess = steps**2 - error[at[1:]] ** 2 - error[at[:-1]] ** 2
    walk = max(float(np.mean(excess / gaps)), _LEAST * floor**2)
    # minimise sum (m - d)^2/e^2 + sum (d_{i+1} - d_i)^2/walk
    weight = np.where(some, error, 1.0) ** -2 * some
    diagonal = weight + (np.r_[0.0, np.ones(lines - 1)] + np.r_[np.ones(lines - 1), 0.0]) / walk
    banded = np.vstack([np.r_[0.0, np.full(lines - 1, -1.0 / walk)], diagonal])
    scale = float(diagonal.max())
    solved = solveh_banded(banded / scale, np.column_stack([weight * middle, np.eye(lines)]) / scale)
    return solved[:, 0], np.sqrt(np.maximum(np.diag(solved[:, 1:]), 0.0))
