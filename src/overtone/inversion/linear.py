"""Given the indentation, the harmonics are linear in the material: the part every method shares."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from overtone.contact.terms import NO_ADHESION, adhesion_harmonics, sphere_harmonics
from overtone.kernels import kernel

N_HARMONICS = 3
"""Harmonics a fit uses at once: as many as it has unknowns with adhesion."""

_Floats = npt.NDArray[np.float64]


class Contact(NamedTuple):
    """What a fit takes as known of the contact."""

    tail: int
    """Adhesive term of the model, a constant of `overtone.contact.terms`."""
    a0: float
    """Intermolecular distance [m]."""
    tip_compliance: float
    """(1 - nu_t^2)/E_t [1/Pa]."""
    sample_factor: float
    """1 - nu_s^2."""
    factor: float
    """Coefficient of the elastic term over E*: 4/3 sqrt(R) for a paraboloid [m^0.5]."""


@kernel
def term_harmonics(
    contact: Contact, amplitude: float, Delta: float, orders: npt.NDArray[np.int64], work: _Floats
) -> None:
    """Fill rows of ``work``: harmonics of the elastic and the adhesive term, each with its d/dDelta."""
    n_max = orders[N_HARMONICS - 1]
    sphere_harmonics(amplitude, Delta, n_max, work[0], work[1])
    if contact.tail != NO_ADHESION:
        adhesion_harmonics(contact.tail, amplitude, Delta, contact.a0, n_max, work[2], work[3])


@kernel
def stiffness(contact: Contact, modulus: float) -> tuple[float, float]:
    """Return Lambda [N/m^1.5] of a sample modulus and d ln Lambda / d ln E_s."""
    sample_compliance = contact.sample_factor / modulus
    E_star = 1.0 / (contact.tip_compliance + sample_compliance)
    return contact.factor * E_star, sample_compliance * E_star


@kernel
def sample_modulus(contact: Contact, Lambda: float) -> float:
    """Return the sample modulus of a Lambda, the inverse of `stiffness`; infinite beyond the tip's own."""
    sample_compliance = contact.factor / Lambda - contact.tip_compliance
    return contact.sample_factor / sample_compliance if sample_compliance > 0.0 else math.inf


@kernel
def best_in_box(
    contact: Contact,
    aa: float,
    ab: float,
    bb: float,
    ac: float,
    bc: float,
    lower: _Floats,
    upper: _Floats,
) -> tuple[float, float]:
    """Minimise ``|a Lambda + b F_ad - c|^2`` over the box of the bounds, from its inner products.

    Parameters
    ----------
    contact : Contact
        Turns the bounds of the modulus into those of Lambda; without adhesion b does not count.
    aa, ab, bb, ac, bc : float
        Inner products of the elastic column a, the adhesive column b and the data c.
    lower, upper : array (unknown,)
        Logarithms of the bounds, modulus first, then the force of adhesion.

    Returns
    -------
    tuple of float
        Lambda and F_ad.
    """
    soft, _ = stiffness(contact, math.exp(lower[0]))
    stiff, _ = stiffness(contact, math.exp(upper[0]))
    if contact.tail == NO_ADHESION:
        return min(max(ac / aa, soft), stiff), 0.0
    weak, strong = math.exp(lower[1]), math.exp(upper[1])
    determinant = aa * bb - ab * ab
    if determinant > 1e-14 * aa * bb:
        Lambda = (ac * bb - bc * ab) / determinant
        adhesion = (bc * aa - ac * ab) / determinant
        if soft <= Lambda <= stiff and weak <= adhesion <= strong:
            return Lambda, adhesion
    # The minimum of a convex function over a box it leaves lies on an edge.
    best, Lambda, adhesion = math.inf, soft, weak
    for edge in range(4):
        if edge < 2:
            L = soft if edge == 0 else stiff
            F = min(max((bc - ab * L) / bb, weak), strong)
        else:
            F = weak if edge == 2 else strong
            L = min(max((ac - ab * F) / aa, soft), stiff)
        value = aa * L * L + 2.0 * ab * L * F + bb * F * F - 2.0 * (ac * L + bc * F)
        if value < best:
            best, Lambda, adhesion = value, L, F
    return Lambda, adhesion
