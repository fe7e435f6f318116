"""Which adhesive contact model suits a contact: the Tabor parameter and what follows from it."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt

from overtone.contact.parameters import ADHESION, DISTANCE, RADIUS, effective_modulus

DMT_LIMIT = 0.1
JKR_LIMIT = 5.0


def tabor_parameter(
    *,
    radius: Any,
    modulus: Any,
    poisson_ratio: Any,
    adhesion: Any,
    intermolecular_distance: Any = 0.2e-9,
    tip_modulus: Any = 130e9,
    tip_poisson_ratio: Any = 0.3,
) -> npt.NDArray[np.float64]:
    """Return the Tabor parameter ``(R w^2 / (E*^2 a0^3))^(1/3)``, with ``w = F_ad/(2 pi R)``.

    It compares how far adhesion stretches the neck of a contact with how far it reaches: small for hard
    samples with long-ranged adhesion (DMT), large for soft and sticky ones (JKR).

    Parameters
    ----------
    radius, modulus, adhesion, intermolecular_distance : array, broadcast
        R [m], sample modulus [Pa], F_ad [N], a0 [m].
    poisson_ratio, tip_modulus, tip_poisson_ratio : array, broadcast
        Of the sample, and modulus [Pa] and Poisson's ratio of the tip.

    Returns
    -------
    array
        Without unit.

    Raises
    ------
    ContactModelError
        If a value is out of range.

    Notes
    -----
    Tabor, J. Colloid Interface Sci. 58 (1977) 2. With JKR's ``F_ad = 3/2 pi w R`` it is 1.21 times as large.

    Examples
    --------
    PS and LDPE of the method's paper:

    >>> [round(float(tabor_parameter(radius=10e-9, modulus=E, poisson_ratio=0.3, adhesion=F)), 2)
    ...  for E, F in ((1.93e9, 1.91e-9), (93.78e6, 16.24e-9))]
    [0.64, 19.89]
    """
    R, F, a0 = RADIUS.check(radius), ADHESION.check(adhesion), DISTANCE.check(intermolecular_distance)
    E_star = effective_modulus(modulus, poisson_ratio, tip_modulus, tip_poisson_ratio)
    w = F / (2.0 * math.pi * R)
    return np.asarray(np.cbrt(R * w**2 / (E_star**2 * a0**3)))


def adhesion_regime(tabor: float) -> str:
    """Return in words which adhesive model a Tabor parameter calls for.

    Examples
    --------
    >>> adhesion_regime(20.0)
    'JKR: soft and sticky; a DMT modulus is biased (jkr)'
    """
    if tabor < DMT_LIMIT:
        return "DMT: hard or weakly adhesive (dmt)"
    if tabor <= JKR_LIMIT:
        return "between DMT and JKR: give both and their difference (maugis, between dmt and jkr)"
    return "JKR: soft and sticky; a DMT modulus is biased (jkr)"
