"""Which moduli do the data allow? The profile likelihood, over every indentation.

A local Jacobian answers for the neighbourhood of one solution. Noise can throw a stiff pixel onto a soft
solution whose neighbourhood is narrow, and a stiff one may fit as well: what counts is every modulus for
which some indentation and some adhesion reproduce the harmonics within the stated noise. Given the
indentation the problem is linear and its answer an interval; the union over indentations is the range.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from overtone.contact.terms import NO_ADHESION
from overtone.inversion.linear import (
    N_HARMONICS,
    Contact,
    best_in_box,
    sample_modulus,
    stiffness,
    term_harmonics,
)
from overtone.kernels import inner, kernel

CHI2_90 = 2.705543454095404
CHI2_999 = 10.827566170662733
"""90 % and 99.9 % quantiles of chi-squared with one degree of freedom."""
N_NODES = 120
"""Indentations of the coarse scan; half as many more refine around the best of them."""

_Floats = npt.NDArray[np.float64]


@inner
def _at_indentation(
    log_indentation: float,
    observed: _Floats,
    W: _Floats,
    orders: npt.NDArray[np.int64],
    amplitude: float,
    contact: Contact,
    lower: _Floats,
    upper: _Floats,
    work: _Floats,
) -> tuple[float, float, float]:
    """Return the best Lambda at an indentation, its variance there, and chi-squared."""
    adhesive = contact.tail != NO_ADHESION
    term_harmonics(contact, amplitude, math.exp(log_indentation) / (2.0 * amplitude), orders, work)
    aa, ab, bb, ac, bc, cc = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for i in range(N_HARMONICS):
        a, b, c = 0.0, 0.0, 0.0
        for j in range(N_HARMONICS):
            a += W[i, j] * work[0, orders[j]]
            c += W[i, j] * observed[j]
            if adhesive:
                b += W[i, j] * work[2, orders[j]]
        aa, ab, bb, ac, bc, cc = aa + a * a, ab + a * b, bb + b * b, ac + a * c, bc + b * c, cc + c * c
    Lambda, adhesion = best_in_box(contact, aa, ab, bb, ac, bc, lower, upper)
    chi2 = cc + aa * Lambda**2 + 2.0 * ab * Lambda * adhesion + bb * adhesion**2
    chi2 -= 2.0 * (ac * Lambda + bc * adhesion)
    determinant = aa * bb - ab * ab
    variance = bb / determinant if adhesive and determinant > 0.0 else 1.0 / aa
    return Lambda, variance, max(chi2, 0.0)


@kernel
def modulus_range(
    observed: _Floats,
    whitening: _Floats,
    orders: npt.NDArray[np.int64],
    amplitude: _Floats,
    contact: Contact,
    lower: _Floats,
    upper: _Floats,
    levels: _Floats,
    low: _Floats,
    high: _Floats,
    misfit: _Floats,
) -> None:
    """Fill the smallest and the largest ln E_s the data of each pixel allow.

    Parameters
    ----------
    observed : array (pixel, 3)
        Conservative force harmonics [N].
    whitening : array (pixel, 3, 3)
        Matrix that turns their errors into independent ones of variance 1.
    orders, amplitude, contact
        As for the fit.
    lower, upper : array (unknown,)
        Logarithms of the bounds; the indentation comes last.
    levels : array (level,)
        Quantiles of chi-squared that bound what is allowed.
    low, high : array (pixel, level)
        Filled: ln E_s.
    misfit : array (pixel,)
        Filled: the smallest chi-squared of the scan. Nothing but noise beyond `CHI2_999` needs a better model.
    """
    last = lower.shape[0] - 1
    work = np.empty((4, orders[N_HARMONICS - 1] + 1))
    count = N_NODES + N_NODES // 2
    Lambda, variance, chi2 = np.empty(count), np.empty(count), np.empty(count)
    soft, _ = stiffness(contact, math.exp(lower[0]))
    stiff, _ = stiffness(contact, math.exp(upper[0]))
    for pixel in range(observed.shape[0]):
        A = amplitude[pixel]
        start = lower[last]
        stop = min(upper[last], math.log(2.0 * A * (1.0 - 1e-6)))
        step = (stop - start) / (N_NODES - 1)
        best = 0
        for k in range(count):
            if k == N_NODES:
                start, step = start + (best - 1) * step, 2.0 * step / (count - N_NODES + 1)
            position = start + k * step if k < N_NODES else start + (k - N_NODES + 1) * step
            Lambda[k], variance[k], chi2[k] = _at_indentation(
                min(max(position, lower[last]), stop),
                observed[pixel],
                whitening[pixel],
                orders,
                A,
                contact,
                lower,
                upper,
                work,
            )
            if chi2[k] < chi2[best]:
                best = k
        misfit[pixel] = chi2[best]
        for level in range(levels.shape[0]):
            least, most = math.inf, -math.inf
            limit = chi2[best] + levels[level]
            for k in range(count):
                if chi2[k] > limit:
                    continue
                reach = math.sqrt((limit - chi2[k]) * variance[k])
                least, most = min(least, Lambda[k] - reach), max(most, Lambda[k] + reach)
                # What is allowed ends between this node and the next one of the same scan that is not.
                for other in (k - 1, k + 1):
                    same_scan = other >= 0 and other < count and (other < N_NODES) == (k < N_NODES)
                    if same_scan and chi2[other] > limit:
                        share = (limit - chi2[k]) / (chi2[other] - chi2[k])
                        edge = Lambda[k] * (Lambda[other] / Lambda[k]) ** share
                        least, most = min(least, edge), max(most, edge)
            softest = math.log(sample_modulus(contact, max(least, soft)))
            stiffest = math.log(sample_modulus(contact, min(most, stiff)))
            low[pixel, level], high[pixel, level] = max(softest, lower[0]), min(stiffest, upper[0])
