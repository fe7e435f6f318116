"""Algebra of matrices so small that a call of a library takes longer than the work; all of it in place."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from overtone.dynamics.balance import solve_in_place
from overtone.kernels import inner, lean

_Floats = npt.NDArray[np.float64]


@lean
def cholesky(H: _Floats) -> bool:
    """Replace a positive matrix by its lower factor; return False where it is none."""
    m = H.shape[0]
    for i in range(m):
        for j in range(i + 1):
            total = H[i, j]
            for k in range(j):
                total -= H[i, k] * H[j, k]
            if i == j:
                if not total > 0.0:
                    return False
                H[i, i] = math.sqrt(total)
            else:
                H[i, j] = total / H[j, j]
        for j in range(i + 1, m):
            H[i, j] = 0.0
    return True


@lean
def solve_factored(L: _Floats, b: _Floats, out: _Floats) -> None:
    """Fill the solution of L L' out = b; ``out`` may be b."""
    n = b.shape[0]
    for a in range(n):
        total = b[a]
        for c in range(a):
            total -= L[a, c] * out[c]
        out[a] = total / L[a, a]
    for a in range(n - 1, -1, -1):
        total = out[a]
        for c in range(a + 1, n):
            total -= L[c, a] * out[c]
        out[a] = total / L[a, a]


@lean
def half_square(P: _Floats, y: _Floats, centre: _Floats) -> float:
    """Return half of the square of how far y is off a centre, in the metric P."""
    size = y.shape[0]
    total = 0.0
    for i in range(size):
        row = 0.0
        for j in range(size):
            row += P[i, j] * (y[j] - centre[j])
        total += 0.5 * (y[i] - centre[i]) * row
    return total


@lean
def squared_length(L: _Floats, step: _Floats) -> float:
    """Return the squared length of a step in the metric L L'."""
    n = step.shape[0]
    length = 0.0
    for a in range(n):
        along = 0.0
        for c in range(a, n):
            along += L[c, a] * step[c]
        length += along * along
    return length


@inner
def eliminate(A: _Floats, b: _Floats) -> float:
    """Replace b by the solution x of A x = b; return ln of the size of the determinant of A.

    Of A what is left is no use; where it is singular minus infinity is returned, and b is none.
    """
    if solve_in_place(A, b) == 0.0:
        return -math.inf
    log_det = 0.0
    for a in range(b.shape[0]):
        log_det += math.log(abs(A[a, a]))  # the pivots
    return log_det


@lean
def in_units(A: _Floats, scale: _Floats) -> float:
    """Divide rows and columns of a matrix by a scale; return what that adds to ln of its determinant."""
    added = 0.0
    for a in range(scale.shape[0]):
        added += 2.0 * math.log(scale[a])
        for c in range(scale.shape[0]):
            A[a, c] /= scale[a] * scale[c]
    return added
