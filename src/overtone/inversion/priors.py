"""What is known of a sample before it was measured: broad unless the user says more, and always stated.

Every default is wide on purpose: an interval is then what the data say. A property whose interval is as wide as its
prior was not measured.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

from overtone.contact.models import ContactModel
from overtone.errors import InversionError
from overtone.inversion.columns import unknowns_of
from overtone.inversion.posterior import Prior as KernelPrior

LOG_RANGE, RANGE, LOG_NORMAL, NORMAL = "log-range", "range", "log-normal", "normal"

CONTACT = 0.5
"""Probability of contact before a pixel is measured; the other half is a tip that never touches."""

LEAST_WORK, MOST_WORK = 1e-3, 1.0
"""Range of the default prior of the adhesion that the pixels of a phase share [J/m^2], every ratio alike."""

WORK_OF_ADHESION = 0.3
"""Scale of the default prior of adhesion [J/m^2]: F_ad = 2 pi R w, as likely smaller; capillary necks included."""


@dataclass(frozen=True)
class Prior:
    """What is known of one property.

    Parameters
    ----------
    kind : str
        ``log-range`` (every ratio between two bounds alike), ``range`` (every value alike), ``log-normal`` (a median,
        and the factor of one standard deviation) or ``normal`` (a mean and a standard deviation, of what is not
        negative).
    first, second : float
        The two numbers, SI units.
    """

    kind: str
    first: float
    second: float

    def __post_init__(self) -> None:
        """Refuse numbers that make no distribution."""
        fine = math.isfinite(self.first) and math.isfinite(self.second)
        if self.kind in (LOG_RANGE, RANGE):
            fine = fine and self.first < self.second and self.first >= 0.0
            fine = fine and (self.kind == RANGE or self.first > 0.0)
        elif self.kind == LOG_NORMAL:
            fine = fine and self.first > 0.0 and self.second > 1.0
        elif self.kind == NORMAL:
            fine = fine and self.second > 0.0
        else:
            fine = False
        if not fine:
            raise InversionError(
                "a prior makes no distribution",
                expected="log-range or range (low, high), log-normal (median, factor > 1) or normal (mean, deviation)",
                got=f"{self.kind} ({self.first:g}, {self.second:g})",
            )


DEFAULTS: dict[str, Prior] = {
    "modulus": Prior(LOG_RANGE, 1e6, 3e11),
    "stiffness": Prior(LOG_RANGE, 1e-2, 1e3),
    "prefactor": Prior(LOG_RANGE, 1e-6, 1e30),
    "indentation": Prior(LOG_RANGE, 1e-11, 1e-6),
    "adhesion": Prior(NORMAL, 0.0, 20e-9),
    "loss_tangent": Prior(RANGE, 0.0, 2.0),
}
"""Priors where the user states none; that of adhesion follows the tip radius where there is one."""

_KINDS = {
    "modulus": (LOG_RANGE, LOG_NORMAL),
    "stiffness": (LOG_RANGE, LOG_NORMAL),
    "prefactor": (LOG_RANGE, LOG_NORMAL),
    "indentation": (LOG_RANGE,),
    "adhesion": (RANGE, NORMAL),
    "loss_tangent": (RANGE,),
}
_FARTHEST = 6.0  # standard deviations at which a normal prior ends


def complete_priors(
    stated: Mapping[str, Prior] | None, record: ContactModel, radius: float | None
) -> dict[str, Prior]:
    """Return the prior of every property of a model, defaults filled in.

    Parameters
    ----------
    stated : mapping of str to Prior, optional
        By name of the property: modulus (or stiffness, prefactor), adhesion, loss_tangent, indentation.
    record : ContactModel
        The model.
    radius : float, optional
        Of the tip [m]; scales the default prior of adhesion.

    Raises
    ------
    InversionError
        If a name or a kind does not fit.
    """
    names = [q.name for q in unknowns_of(record)]
    own = [names[0], "indentation", *(["adhesion"] if "adhesion" in names else [])]
    if {"viscosity", "damping"} & set(names):
        own.append("loss_tangent")
    priors = {name: DEFAULTS[name] for name in own}
    if "adhesion" in priors and radius is not None:
        priors["adhesion"] = Prior(NORMAL, 0.0, 2.0 * math.pi * radius * WORK_OF_ADHESION)
    for name, prior in (stated or {}).items():
        if name not in _KINDS:
            raise InversionError(f"{name!r} has no prior", expected=", ".join(_KINDS), got=name)
        if prior.kind not in _KINDS[name]:
            raise InversionError(
                f"a prior of {name} does not fit", expected=" or ".join(_KINDS[name]), got=prior.kind
            )
        if name == "loss_tangent" and prior.first != 0.0:
            raise InversionError("a prior of the loss tangent begins at 0", got=f"{prior.first:g}")
        if name in priors:
            priors[name] = prior
    return priors


def of_single_pixels(stated: Mapping[str, Prior] | None) -> dict[str, Prior]:
    """Return the stated priors that a pixel by itself can be given: adhesion only where it is no logarithm."""
    return {
        name: prior
        for name, prior in (stated or {}).items()
        if name != "adhesion" or prior.kind not in (LOG_RANGE, LOG_NORMAL)
    }


def shared_priors(
    stated: Mapping[str, Prior] | None, priors: Mapping[str, Prior], radius: float | None
) -> dict[str, Prior]:
    """Return the priors of materials that pixels share: every ratio of adhesions alike unless something is stated.

    A pixel by itself is integrated over its adhesion in closed form, which asks for a normal prior. That gives most of
    its weight to forces near its scale; where a shared calibration links materials, a weak adhesion of one would then
    pull all of them.

    Parameters
    ----------
    stated : mapping of str to Prior, optional
        By the user.
    priors : mapping of str to Prior
        From `complete_priors`.
    radius : float, optional
        Of the tip [m].
    """
    shared = dict(priors)
    if "adhesion" in shared and "adhesion" in (stated or {}):
        shared["adhesion"] = (stated or {})["adhesion"]
    elif "adhesion" in shared and radius is not None:
        around = 2.0 * math.pi * radius
        shared["adhesion"] = Prior(LOG_RANGE, around * LEAST_WORK, around * MOST_WORK)
    return shared


def interval_width(prior: Prior) -> float:
    """Return the width of the 90 % interval of a prior: of the logarithm, where it is one of ratios."""
    if prior.kind == LOG_RANGE:
        return 0.9 * math.log(prior.second / prior.first)
    if prior.kind == LOG_NORMAL:
        return 2.0 * 1.6448536269514722 * math.log(prior.second)
    return (
        0.9 * (prior.second - prior.first) if prior.kind == RANGE else 2.0 * 1.6448536269514722 * prior.second
    )


def for_kernel(priors: Mapping[str, Prior], first: str) -> KernelPrior:
    """Return priors as the kernel takes them.

    Parameters
    ----------
    priors : mapping
        From `complete_priors`.
    first : str
        Name of the elastic unknown.
    """
    elastic = priors[first]
    if elastic.kind == LOG_RANGE:
        low, high, centre, precision = math.log(elastic.first), math.log(elastic.second), 0.0, 0.0
    else:
        spread = math.log(elastic.second)
        centre, precision = math.log(elastic.first), spread**-2
        low, high = centre - _FARTHEST * spread, centre + _FARTHEST * spread
    adhesion = priors.get("adhesion", DEFAULTS["adhesion"])
    if adhesion.kind == LOG_NORMAL:
        spread = math.log(adhesion.second)
        mean, F_precision = math.log(adhesion.first), spread**-2
        F_low, F_high = (math.exp(mean + side * _FARTHEST * spread) for side in (-1.0, 1.0))
    elif adhesion.kind in (RANGE, LOG_RANGE):
        F_low, F_high, mean, F_precision = adhesion.first, adhesion.second, 0.0, 0.0
    else:
        mean, F_precision = adhesion.first, adhesion.second**-2
        F_low, F_high = 0.0, max(mean, 0.0) + _FARTHEST * adhesion.second
    tangent = priors.get("loss_tangent", DEFAULTS["loss_tangent"])
    return KernelPrior(
        low,
        high,
        centre,
        precision,
        F_low,
        F_high,
        mean,
        F_precision,
        tangent.second,
        priors["indentation"].first,
        priors["indentation"].second,
        CONTACT,
    )


def format_priors(priors: Mapping[str, Prior]) -> str:
    """Return priors as one line for a record."""
    return "; ".join(f"{name} {p.kind} {p.first:g} {p.second:g}" for name, p in priors.items())
