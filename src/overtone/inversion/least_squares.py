"""The published estimator, for reproduction: nonlinear least squares on three conservative harmonics.

Shaik, Reifenberger and Raman (2020), section 3.3: at each pixel find the sample modulus, the force of
adhesion and the maximum indentation whose tip-indentation formulas (eqs 19, 19c corrected) match the
conservative force harmonics, by least squares on relative residuals. Their supplement, with the
settings, is not available; what stands here is stated instead of guessed silently:

* unknowns are logarithms, ``x = (ln E_s, ln F_ad, ln delta_max)``;
* bounds are those of the model's parameters, ``1 pm <= delta_max <= 2 A1 (1 - 1e-6)``;
* starts are `STARTS`, and the answer of a pixel is the one with the smallest residual;
* Levenberg-Marquardt runs until an undamped step moves no unknown by more than 1e-12, or the cost by
  no more than rounding. Where the data barely tell modulus from adhesion the minimum lies far down a
  long bent valley, in which such a search creeps for thousands of steps; after 60 the descent goes on
  along the valley floor, where modulus and adhesion are the best ones for each indentation, down to
  the same minimum.

The residual norm ``N_r = |F(x) - F| / |F|`` per harmonic, as a root of a sum of squares, is what the paper
reports. It is no evidence: on stiff samples moduli a thousand times apart keep it below 0.1. So each
pixel also carries the row of ``J^-1`` that turns relative errors of the harmonics into ``d ln E``.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from overtone.inversion.linear import (
    N_HARMONICS,
    Contact,
    best_in_box,
    sample_modulus,
    stiffness,
    term_harmonics,
)
from overtone.kernels import inner, kernel

STARTS: tuple[tuple[float, float, float], ...] = (
    (0.05e9, 10e-9, 20e-9),
    (1e9, 10e-9, 5e-9),
    (20e9, 10e-9, 1e-9),
)
"""Starting points (E_s [Pa], F_ad [N], delta_max [m]): a soft, a middling and a stiff sample."""

MIN_INDENTATION = 1e-12
MAX_DELTA = 1.0 - 1e-6
CONVERGED, STALLED, AT_BOUND = 0, 1, 2

_STEP_TOLERANCE = 1e-12
_SOLVED = 1e-20  # a cost this small is a solution: what is left of it is rounding in the harmonics
_DAMPED_STEPS = 60
_VALLEY_STEPS = 200
_UNKNOWNS = 3

_Floats = npt.NDArray[np.float64]


@inner
def _evaluate(
    x: _Floats,
    observed: _Floats,
    orders: npt.NDArray[np.int64],
    amplitude: float,
    contact: Contact,
    work: _Floats,
    residual: _Floats,
    J: _Floats,
) -> float:
    """Fill relative residuals and their Jacobian by x; return the sum of squares.

    The indentation is the last unknown; a model without adhesion has two.
    """
    n = x.shape[0]
    Lambda, share = stiffness(contact, math.exp(x[0]))
    Delta = math.exp(x[n - 1]) / (2.0 * amplitude)
    term_harmonics(contact, amplitude, Delta, orders, work)
    adhesion = math.exp(x[1]) if n == _UNKNOWNS else 0.0
    total = 0.0
    for i in range(N_HARMONICS):
        order, scale = orders[i], 1.0 / abs(observed[i])
        force, slope = Lambda * work[0, order], Lambda * work[1, order]
        J[i, 0] = force * share * scale
        if n == _UNKNOWNS:
            J[i, 1] = adhesion * work[2, order] * scale
            force += adhesion * work[2, order]
            slope += adhesion * work[3, order]
        J[i, n - 1] = slope * Delta * scale
        residual[i] = (force - observed[i]) * scale
        total += residual[i] * residual[i]
    return total


@inner
def _solve(M: _Floats, b: _Floats, n: int, out: _Floats) -> bool:
    """Solve a small symmetric positive system by Cholesky; return False where it is not positive."""
    L = np.empty((_UNKNOWNS, _UNKNOWNS))
    for i in range(n):
        for j in range(i + 1):
            s = M[i, j]
            for k in range(j):
                s -= L[i, k] * L[j, k]
            if i == j:
                if not s > 0.0:
                    return False
                L[i, i] = math.sqrt(s)
            else:
                L[i, j] = s / L[j, j]
    for i in range(n):
        s = b[i]
        for k in range(i):
            s -= L[i, k] * out[k]
        out[i] = s / L[i, i]
    for i in range(n - 1, -1, -1):
        s = out[i]
        for k in range(i + 1, n):
            s -= L[k, i] * out[k]
        out[i] = s / L[i, i]
    return True


@inner
def _descend(
    x: _Floats,
    observed: _Floats,
    orders: npt.NDArray[np.int64],
    amplitude: float,
    contact: Contact,
    lower: _Floats,
    upper: _Floats,
    damping: float,
    work: _Floats,
    residual: _Floats,
    J: _Floats,
) -> tuple[float, bool]:
    """Move x to a minimum by Levenberg-Marquardt within bounds; return the cost and whether it converged."""
    n = x.shape[0]
    trial_residual, trial_J = np.empty(N_HARMONICS), np.empty((N_HARMONICS, _UNKNOWNS))
    trial, step, b = np.empty(n), np.empty(n), np.empty(n)
    M = np.empty((_UNKNOWNS, _UNKNOWNS))
    cost = _evaluate(x, observed, orders, amplitude, contact, work, residual, J)
    growth = 2.0
    for _ in range(_DAMPED_STEPS):
        for i in range(n):
            b[i] = 0.0
            for k in range(N_HARMONICS):
                b[i] -= J[k, i] * residual[k]
            for j in range(n):
                M[i, j] = 0.0
                for k in range(N_HARMONICS):
                    M[i, j] += J[k, i] * J[k, j]
        # An unknown that its bound holds back takes no part in this step.
        for i in range(n):
            if (x[i] <= lower[i] and b[i] < 0.0) or (x[i] >= upper[i] and b[i] > 0.0):
                b[i] = 0.0
                for j in range(n):
                    M[i, j] = 0.0
                    M[j, i] = 0.0
                M[i, i] = 1.0
        for i in range(n):
            M[i, i] += damping * M[i, i] + 1e-300
        if _solve(M, b, n, step):
            size = 0.0
            for i in range(n):
                trial[i] = min(max(x[i] + min(max(step[i], -2.0), 2.0), lower[i]), upper[i])
                size = max(size, abs(trial[i] - x[i]))
            new = _evaluate(trial, observed, orders, amplitude, contact, work, trial_residual, trial_J)
            # A short step ends the search only where the damping did not make it short; so does one that
            # changes the cost by no more than rounding.
            even = abs(new - cost) <= 1e-13 * cost + 1e-26
            done = damping < 1e-6 and (size <= _STEP_TOLERANCE or (size < 1e-6 and even))
            if new <= cost:
                cost = new
                for i in range(n):
                    x[i] = trial[i]
                for k in range(N_HARMONICS):
                    residual[k] = trial_residual[k]
                    for i in range(n):
                        J[k, i] = trial_J[k, i]
                damping, growth = max(0.2 * damping, 1e-16), 2.0
                if done:
                    return cost, True
                continue
            if done:
                return cost, True
        damping *= growth
        growth *= 2.0
    return cost, False


@inner
def _valley_floor(
    x: _Floats,
    observed: _Floats,
    orders: npt.NDArray[np.int64],
    amplitude: float,
    contact: Contact,
    lower: _Floats,
    upper: _Floats,
    work: _Floats,
) -> float:
    """Set modulus and adhesion to the best ones within bounds at the indentation of x.

    Given the indentation the harmonics are linear in Lambda and F_ad, so this is a linear problem in a
    box. Return the slope of the cost along ln delta_max, which at the best values of the others is its
    partial derivative.
    """
    n = x.shape[0]
    Delta = math.exp(x[n - 1]) / (2.0 * amplitude)
    term_harmonics(contact, amplitude, Delta, orders, work)
    aa, ab, bb, ac, bc = 0.0, 0.0, 0.0, 0.0, 0.0
    for i in range(N_HARMONICS):
        scale = 1.0 / abs(observed[i])
        a, c = work[0, orders[i]] * scale, observed[i] * scale
        b = work[2, orders[i]] * scale if n == _UNKNOWNS else 0.0
        aa, ab, bb, ac, bc = aa + a * a, ab + a * b, bb + b * b, ac + a * c, bc + b * c
    Lambda, adhesion = best_in_box(contact, aa, ab, bb, ac, bc, lower, upper)
    x[0] = min(max(math.log(sample_modulus(contact, Lambda)), lower[0]), upper[0])
    if n == _UNKNOWNS:
        x[1] = math.log(adhesion)
    slope = 0.0
    for i in range(N_HARMONICS):
        scale, order = 1.0 / abs(observed[i]), orders[i]
        force, change = Lambda * work[0, order], Lambda * work[1, order]
        if n == _UNKNOWNS:
            force += adhesion * work[2, order]
            change += adhesion * work[3, order]
        slope += 2.0 * (force - observed[i]) * scale * change * Delta * scale
    return slope


@inner
def _follow_valley(
    x: _Floats,
    observed: _Floats,
    orders: npt.NDArray[np.int64],
    amplitude: float,
    contact: Contact,
    lower: _Floats,
    upper: _Floats,
    work: _Floats,
) -> None:
    """Move x down along the valley floor until the slope vanishes or the indentation meets its bound."""
    last = x.shape[0] - 1
    here = x[last]
    slope = _valley_floor(x, observed, orders, amplitude, contact, lower, upper, work)
    stride = 0.02
    for _ in range(_VALLEY_STEPS):
        there = min(max(here - math.copysign(stride, slope), lower[last]), upper[last])
        x[last] = there
        next_slope = _valley_floor(x, observed, orders, amplitude, contact, lower, upper, work)
        if there == here:
            return
        if next_slope * slope <= 0.0:
            break
        here, slope = there, next_slope
        stride = min(1.5 * stride, 0.5)
    else:
        return
    # Illinois variant of regula falsi: a bracket that always shrinks from both ends.
    a, fa, b, fb = here, slope, there, next_slope
    for _ in range(_VALLEY_STEPS):
        if fb == fa or abs(b - a) < 1e-14:
            break
        x[last] = min(max((a * fb - b * fa) / (fb - fa), min(a, b)), max(a, b))
        f = _valley_floor(x, observed, orders, amplitude, contact, lower, upper, work)
        if f * fb <= 0.0:
            a, fa = b, fb
        else:
            fa *= 0.5
        b, fb = x[last], f
        if f == 0.0:
            break


@inner
def _modulus_gain(J: _Floats, n: int, gain: _Floats) -> None:
    """Fill d ln E per relative error of each harmonic: the first row of the pseudo-inverse of J.

    The column of ln E is projected off the others twice instead of forming J^T J, which would square
    a condition that reaches 1e5.
    """
    columns = np.empty((_UNKNOWNS, N_HARMONICS))
    for position in range(n):
        v = columns[position]
        for i in range(N_HARMONICS):
            v[i] = J[i, (position + 1) % n]  # ln E comes last
        for _ in range(2):
            for k in range(position):
                overlap = 0.0
                for i in range(N_HARMONICS):
                    overlap += columns[k, i] * v[i]
                for i in range(N_HARMONICS):
                    v[i] -= overlap * columns[k, i]
        square = 0.0
        for i in range(N_HARMONICS):
            square += v[i] * v[i]
        # Unit vectors for the others; for ln E, v/|v|^2, whose product with a residual is a change of ln E.
        scale = math.sqrt(square) if position < n - 1 else square
        for i in range(N_HARMONICS):
            v[i] = v[i] / scale if square > 0.0 else (0.0 if position < n - 1 else math.inf)
    for i in range(N_HARMONICS):
        gain[i] = columns[n - 1, i]


@kernel
def fit_pixels(
    observed: _Floats,
    orders: npt.NDArray[np.int64],
    amplitude: _Floats,
    contact: Contact,
    lower: _Floats,
    upper: _Floats,
    start: _Floats,
    solution: _Floats,
    norm: _Floats,
    gain: _Floats,
    outcome: npt.NDArray[np.int8],
) -> None:
    """Fit every pixel of a block from one starting point.

    Parameters
    ----------
    observed : array (pixel, 3)
        Conservative force harmonics [N], finite and not zero.
    orders : array (3,)
        Their orders, ascending.
    amplitude : array (pixel,)
        A1 [m].
    contact : Contact
        What is known of the contact.
    lower, upper, start : array (unknown,)
        Bounds and starting point as logarithms of SI values; the indentation, which is last, is also
        kept below ``2 A1 MAX_DELTA``.
    solution, norm, gain, outcome : arrays (pixel, unknown), (pixel,), (pixel, 3), (pixel,)
        Filled: x, N_r, d ln E per relative error of each harmonic, and one of CONVERGED, STALLED, AT_BOUND.
    """
    n = start.shape[0]
    work = np.empty((4, orders[N_HARMONICS - 1] + 1))
    residual, J = np.empty(N_HARMONICS), np.empty((N_HARMONICS, _UNKNOWNS))
    for pixel in range(observed.shape[0]):
        A, F, x = amplitude[pixel], observed[pixel], solution[pixel]
        top = upper.copy()
        top[n - 1] = min(upper[n - 1], math.log(2.0 * A * MAX_DELTA))
        for j in range(n):
            x[j] = min(max(start[j], lower[j]), top[j])
        cost, converged = _descend(x, F, orders, A, contact, lower, top, 1e-3, work, residual, J)
        if not converged:
            _follow_valley(x, F, orders, A, contact, lower, top, work)
            # The floor ends at the minimum: what is left are undamped steps of rounding size.
            cost, converged = _descend(x, F, orders, A, contact, lower, top, 1e-12, work, residual, J)
        outcome[pixel] = CONVERGED if converged or cost < _SOLVED else STALLED
        for j in range(n):
            if x[j] <= lower[j] or x[j] >= top[j]:
                outcome[pixel] = AT_BOUND
        norm[pixel] = math.sqrt(cost)
        _modulus_gain(J, n, gain[pixel])
