"""The reference material of an approach curve: what is known of it beforehand, and how the rest is searched."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

from overtone.contact.models import contact_model
from overtone.contact.parameters import POISSON_RATIO
from overtone.errors import CalibrationError


@dataclass(frozen=True)
class Reference:
    """The material of an approach curve, as far as it is known beforehand.

    Parameters
    ----------
    poisson_ratio : float
        Of the material; it has no default.
    modulus : float, optional
        Young's modulus [Pa]. Without it only gains and offsets that do not depend on it are learnt.
    modulus_error : float
        Relative standard deviation of it.
    adhesion : float, optional
        Force of adhesion [N].
    adhesion_error : float
        Relative standard deviation of it.
    model : str
        Contact model, ``dmt`` unless given; one with ``viscosity`` uses DISS_1 as well.
    name : str
        What it is called in reports.

    Raises
    ------
    CalibrationError, ContactModelError
        If a number makes no sense or there is no such model.
    """

    poisson_ratio: float
    modulus: float | None = None
    modulus_error: float = 0.1
    adhesion: float | None = None
    adhesion_error: float = 0.3
    model: str = "dmt"
    name: str = "reference"

    def __post_init__(self) -> None:
        POISSON_RATIO.check(self.poisson_ratio)
        for name in ("modulus", "adhesion", "modulus_error", "adhesion_error"):
            value = getattr(self, name)
            if value is not None and not 0.0 < value < math.inf:
                raise CalibrationError(
                    f"the {name.replace('_', ' ')} of the reference makes no sense",
                    expected="a finite positive number",
                    got=repr(value),
                )
        contact_model(self.model)


class Scale(NamedTuple):
    """How a property of the reference is searched: by its logarithm, or evenly above a size and so below it."""

    mean: float
    """Of the prior, in what is searched."""
    width: float
    size: float | None = None
    """Softplus of this size [SI] in place of an exponential."""

    def value(self, p: float) -> float:
        """Return the property [SI] at p prior widths from the prior's mean."""
        x = self.mean + self.width * p
        if self.size is None:
            return math.exp(min(max(x, -60.0), 60.0))
        return self.size * (math.log1p(math.exp(-abs(x))) + max(x, 0.0)) + _LEAST_PROPERTY

    def at(self, value: float) -> float:
        """Return where a property [SI] lies, in prior widths from the prior's mean."""
        x = math.log(value) if self.size is None else math.log(math.expm1(min(value / self.size, 500.0)))
        return (x - self.mean) / self.width


# an adhesion too small to be seen must not pull at the modulus: even, its posterior is nearly normal down to nothing
_BROAD = {
    "modulus": Scale(math.log(1e9), math.log(20.0)),
    "adhesion": Scale(0.0, 20.0, 2e-9),
    "viscosity": Scale(math.log(10.0), math.log(20.0)),
}
STARTS: Mapping[str, tuple[float, ...]] = {
    "modulus": (1e9, 1e10, 1e8),
    "adhesion": (5e-9, 1e-9, 25e-9),
    "viscosity": (10.0,),
}
"""Where a search for a property that was not stated begins [SI]."""
_LEAST_PROPERTY = 1e-15


def scale_of(reference: Reference, name: str) -> Scale:
    """Return how a property is searched: about what was stated, or broadly."""
    known = getattr(reference, name, None)
    if known is not None:
        return Scale(math.log(known), float(getattr(reference, f"{name}_error")))
    return _BROAD[name]
