"""The unit that a file states, turned into the SI unit that overtone keeps."""

from __future__ import annotations

from overtone.errors import UnitError
from overtone.units import conversion_factor

# What a value may become, in the order of preference where two share a dimension.
_SI_UNITS = ("m", "rad", "V", "A", "Hz", "N", "N/m", "m/V", "Pa", "J", "W", "s", "K", "1")
_LONGEST_UNIT = 40
_SPELLED_OUT = {
    "degree": "deg",
    "degrees": "deg",
    "radian": "rad",
    "radians": "rad",
    "meter": "m",
    "meters": "m",
    "metre": "m",
    "metres": "m",
    "volt": "V",
    "volts": "V",
    "ampere": "A",
    "amperes": "A",
    "hertz": "Hz",
}


def to_si(unit: str) -> tuple[float, str] | None:
    """Return the factor and the SI unit for the text of a unit, None where it is not known.

    Parameters
    ----------
    unit : str
        Unit as a file states it.

    Examples
    --------
    >>> to_si("pm"), to_si("nm/V"), to_si("arb. units")
    ((1e-12, 'm'), (1e-09, 'm/V'), None)
    """
    text = _SPELLED_OUT.get(unit.strip().lower(), unit.strip())
    if len(text) > _LONGEST_UNIT:
        return None
    for target in _SI_UNITS:
        try:
            return conversion_factor(text, target), target
        except (UnitError, ArithmeticError):  # km^1000 is beyond any float
            continue
    return None
