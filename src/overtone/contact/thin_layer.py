"""Thin elastic layer on a rigid substrate under a paraboloid: the force as a sum of powers of indentation.

For a layer of thickness h bonded to a rigid base, a frictionless rigid paraboloid of radius R and
``chi = sqrt(R delta) / h``::

    F = 4/3 E/(1 - nu^2) sqrt(R) delta^(3/2) [1 + c1 chi + c2 chi^2 + c3 chi^3 + c4 chi^4] + O(chi^5)

The coefficients follow from the exact surface response of the layer; ``docs/thin-layer.md`` has the
derivation, the comparison with the published coefficients and the measured errors.
"""

from __future__ import annotations

import math

import numpy as np

from overtone.errors import ContactModelError

# The kernel falls as x^2 exp(-2 x): nothing is left of its second moment beyond x = 24, and 80 points
# give both moments to rounding for every Poisson's ratio.
_REACH = 24.0
_ROOTS, _WEIGHTS = np.polynomial.legendre.leggauss(80)
_X = 0.5 * _REACH * (_ROOTS + 1.0)
_DX = 0.5 * _REACH * _WEIGHTS


def layer_integrals(poisson_ratio: float) -> tuple[float, float]:
    """Return alpha0 < 0 and beta0 > 0, the two numbers of a bonded layer that the force needs.

    A pressure ``p(k)`` (Hankel transform) on a half-space sinks its surface by ``2 (1 - nu^2)/(E k) p``,
    on the layer by the fraction ``L(k h)`` of that,

        L(x) = (2 kappa sinh 2x - 4 x) / (2 kappa cosh 2x + 4 x^2 + 1 + kappa^2),   kappa = 3 - 4 nu

    and the moments of what is missing are

        alpha0 = -int_0^oo (1 - L(x)) dx,   beta0 = 1/4 int_0^oo x^2 (1 - L(x)) dx

    computed here by Gauss-Legendre quadrature to about 1e-12.

    Parameters
    ----------
    poisson_ratio : float
        Poisson's ratio of the layer, -1 < nu <= 0.5.

    Returns
    -------
    tuple of float
        alpha0 and beta0.

    Raises
    ------
    ContactModelError
        If Poisson's ratio is out of range.

    Notes
    -----
    The names and signs are those of Dimitriadis et al., Biophys. J. 82 (2002) 2798. The polynomials in nu
    published there differ from the integrals: alpha0 by 6 % at nu = 0 and 0.5 % from 0.3 to 0.5, beta0 by
    36 % at nu = 0 and 5 to 6 % from 0.3 to 0.5.

    Examples
    --------
    >>> alpha0, beta0 = layer_integrals(0.5)
    >>> print(f"{alpha0:.6f} {beta0:.6f}")
    -1.770217 0.957769
    """
    if not (math.isfinite(poisson_ratio) and -1.0 < poisson_ratio <= 0.5):
        raise ContactModelError(
            "Poisson's ratio is out of range", expected="-1 < nu <= 0.5", got=str(poisson_ratio)
        )
    kappa = 3.0 - 4.0 * poisson_ratio
    fall = np.exp(-2.0 * _X)
    # 1 - L(x), with every growing exponential divided out
    missing = (
        fall
        * (2.0 * kappa * fall + (1.0 + 2.0 * _X) ** 2 + kappa**2)
        / (kappa * (1.0 + fall**2) + (4.0 * _X**2 + 1.0 + kappa**2) * fall)
    )
    return -float(np.sum(_DX * missing)), 0.25 * float(np.sum(_DX * _X**2 * missing))


def layer_coefficients(poisson_ratio: float) -> tuple[float, float, float, float, float]:
    """Return c0 = 1 to c4, which multiply chi^0 to chi^4 in the force on a bonded layer.

    With the contact radius a and ``e = a/h``, the contact problem solved through order e^4 reads

        b = 1 / (1 - 8 beta0 e^3 / (3 pi)),   F = 4/3 E/(1 - nu^2) b a^3 / R
        R delta / a^2 = b (1 + 4 alpha0 e / (3 pi) + 8 beta0 e^3 / (15 pi))

    (``b/R`` is the curvature of the tip plus that of the layer's own dent). Without a this is

        c1 = -2 alpha0 / pi
        c2 = 14/3 alpha0^2 / pi^2
        c3 = -8/pi^3 (40/27 alpha0^3 + 4 pi^2/15 beta0)
        c4 = 16 alpha0/pi^4 (143/72 alpha0^3 + 4 pi^2/5 beta0)

    with alpha0 < 0 and beta0 > 0. For 0 <= nu <= 0.5 c1, c2 and c3 are positive; c4 changes sign at
    nu = 0.235 and is negative below.

    Parameters
    ----------
    poisson_ratio : float
        Poisson's ratio of the layer, -1 < nu <= 0.5.

    Returns
    -------
    tuple of float
        c0, c1, c2, c3, c4.

    Raises
    ------
    ContactModelError
        If Poisson's ratio is out of range.

    Notes
    -----
    Validity: against a numerical solution of the full contact problem the series gives too large a force,
    by less than 1 % up to chi = 0.45 and less than 5 % up to chi = 0.65, for 0 <= nu <= 0.5. At chi = 1 it
    is 10 to 23 % too large: do not extrapolate. The rest is that of Hertz: small strain, indentation well
    below the tip radius, no friction, no adhesion; and a base that neither yields nor lets the layer slip.

    Sources: Dimitriadis et al., Biophys. J. 82 (2002) 2798, hold the contact radius at ``sqrt(R delta)``,
    which makes c2, c3 and c4 too small, and c4 = 0.0975 at nu = 0.5 has lost the minus sign that their own
    formula gives. Garcia and Garcia, Biophys. J. 114 (2018) 2923, agree with c1, c2 and c3; their c4 = 0.755
    at nu = 0.5 is what a contact radius of first order in chi gives, and is too small.

    Examples
    --------
    >>> print(*(f"{c:.4f}" for c in layer_coefficients(0.5)))
    1.0000 1.1270 1.4817 1.4700 1.0047
    """
    alpha0, beta0 = layer_integrals(poisson_ratio)
    pi = math.pi
    return (
        1.0,
        -2.0 * alpha0 / pi,
        14.0 / 3.0 * alpha0**2 / pi**2,
        -8.0 / pi**3 * (40.0 / 27.0 * alpha0**3 + 4.0 * pi**2 / 15.0 * beta0),
        16.0 * alpha0 / pi**4 * (143.0 / 72.0 * alpha0**3 + 4.0 * pi**2 / 5.0 * beta0),
    )
