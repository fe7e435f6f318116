"""Units at the edges: text such as "94 nm" becomes SI floats, and SI floats become readable text.

Inside the package every number is an SI float (radians for angles); only files, configuration and
the command line carry units, and all of them pass through here.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from decimal import Decimal

from overtone.errors import UnitError

# Exponents of (metre, kilogram, second, volt, radian, kelvin). The volt and the radian stand on
# their own: a sensitivity in nm/V must not pass for a length, nor an angle for a plain number.
_Dimension = tuple[int, int, int, int, int, int]

_BASE: dict[str, tuple[float, _Dimension]] = {
    "m": (1.0, (1, 0, 0, 0, 0, 0)),
    "g": (1e-3, (0, 1, 0, 0, 0, 0)),
    "s": (1.0, (0, 0, 1, 0, 0, 0)),
    "V": (1.0, (0, 0, 0, 1, 0, 0)),
    "rad": (1.0, (0, 0, 0, 0, 1, 0)),
    "K": (1.0, (0, 0, 0, 0, 0, 1)),
    "Hz": (1.0, (0, 0, -1, 0, 0, 0)),
    "N": (1.0, (1, 1, -2, 0, 0, 0)),
    "Pa": (1.0, (-1, 1, -2, 0, 0, 0)),
    "J": (1.0, (2, 1, -2, 0, 0, 0)),
    "W": (1.0, (2, 1, -3, 0, 0, 0)),
    "eV": (1.602176634e-19, (2, 1, -2, 0, 0, 0)),
    "A": (1.0, (2, 1, -3, -1, 0, 0)),  # a watt per volt
}
_PLAIN: dict[str, tuple[float, _Dimension]] = {
    "1": (1.0, (0, 0, 0, 0, 0, 0)),
    "%": (0.01, (0, 0, 0, 0, 0, 0)),
    "deg": (math.pi / 180.0, (0, 0, 0, 0, 1, 0)),
    "°": (math.pi / 180.0, (0, 0, 0, 0, 1, 0)),
    "Å": (1e-10, (1, 0, 0, 0, 0, 0)),
    "min": (60.0, (0, 0, 1, 0, 0, 0)),
}
_PREFIX = {
    "f": 1e-15,
    "p": 1e-12,
    "n": 1e-9,
    "u": 1e-6,
    "µ": 1e-6,
    "μ": 1e-6,
    "m": 1e-3,
    "c": 1e-2,
    "k": 1e3,
    "M": 1e6,
    "G": 1e9,
    "T": 1e12,
}
_DISPLAY_PREFIX = {-15: "f", -12: "p", -9: "n", -6: "µ", -3: "m", 0: "", 3: "k", 6: "M", 9: "G", 12: "T"}
_PREFIXED_SI = ("m", "N", "Pa", "J", "Hz", "V", "A", "s")
_QUANTITY = re.compile(r"\s*([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*(.*?)\s*")
_SYMBOL = re.compile(r"([A-Za-zµμÅ°%]+|1)(?:\^?(-?\d+))?")
_PER_ROOT_HERTZ = re.compile(r"\s*/\s*(?:rt|sqrt|√)\s*(?:Hz|\(\s*Hz\s*\))\s*$")


def _symbol(text: str) -> tuple[float, _Dimension] | None:
    if text in _PLAIN:
        return _PLAIN[text]
    if text in _BASE:
        return _BASE[text]
    prefix, base = text[:1], text[1:]
    if prefix in _PREFIX and base in _BASE:
        factor, dimension = _BASE[base]
        return _PREFIX[prefix] * factor, dimension
    return None


def parse_unit(text: str) -> tuple[float, _Dimension]:
    """Return the SI factor and the dimension of a unit such as ``nm/V``, ``N/m`` or ``Pa s``.

    Raises
    ------
    UnitError
        If the text is not a product of known units.

    Examples
    --------
    >>> parse_unit("mN/m")[0]
    0.001
    """
    factor, dimension = 1.0, [0] * 6
    numerator, *denominators = text.strip().split("/")
    for sign, group in [(1, numerator), *((-1, part) for part in denominators)]:
        symbols = group.replace("*", " ").replace("·", " ").split()
        if not symbols:
            raise UnitError(f"unit {text!r} is incomplete", hint='a form such as "nm", "N/m" or "Pa s"')
        for symbol in symbols:
            match = _SYMBOL.fullmatch(symbol)
            known = _symbol(match.group(1)) if match else None
            if match is None or known is None:
                raise UnitError(
                    f"unknown unit {symbol!r} in {text!r}",
                    expected="SI units with a prefix, eV, deg, % or Å",
                    hint='for example "94 nm", "16.4 N/m", "161.8 kHz", "41.5 nm/V"',
                )
            power = sign * int(match.group(2) or 1)
            if abs(power) > 6:
                raise UnitError(f"power {power} in unit {text!r}", expected="a power of at most 6")
            factor *= known[0] ** power
            dimension = [a + power * b for a, b in zip(dimension, known[1], strict=True)]
    return factor, (dimension[0], dimension[1], dimension[2], dimension[3], dimension[4], dimension[5])


def conversion_factor(unit: str, to: str, name: str = "quantity") -> float:
    """Return the number that turns a value in ``unit`` into a value in ``to``.

    Parameters
    ----------
    unit, to : str
        Unit that arrived and unit that is wanted, of the same dimension.
    name : str
        What the value is, for the error message.

    Raises
    ------
    UnitError
        If a unit is unknown or the dimensions differ.

    Examples
    --------
    >>> conversion_factor("nm", "m")
    1e-09
    """
    factor, dimension = parse_unit(unit)
    target, wanted = parse_unit(to)
    if dimension != wanted:
        raise UnitError(
            f"the unit of {name} does not fit", expected=f"one that converts to {to}", got=repr(unit)
        )
    return factor / target


def parse_quantity(text: str | float, unit: str, name: str = "quantity") -> float:
    """Return the SI value of a text with a unit, for example ``"94 nm"`` for a length.

    Parameters
    ----------
    text : str or float
        Number and unit. A bare number passes only where ``unit`` is ``"1"``.
    unit : str
        SI unit of the result, ``"1"`` for plain numbers.
    name : str
        What the value is, for the error message.

    Raises
    ------
    UnitError
        If there is no number, no unit where one is due, or one of another dimension.

    Examples
    --------
    >>> parse_quantity("16.4 N/m", "N/m"), parse_quantity("287", "1")
    (16.4, 287.0)
    """
    match = _QUANTITY.fullmatch(str(text))
    example = {"m": "94 nm", "N/m": "16.4 N/m", "Hz": "161.8 kHz", "Pa": "130 GPa", "rad": "90 deg"}.get(
        unit, unit
    )
    if match is None:
        raise UnitError(
            f"{name} is not a number with a unit", expected=f'text such as "{example}"', got=repr(text)
        )
    number, unit_text = match.group(1), match.group(2)
    if not unit_text:
        if unit != "1":
            raise UnitError(f"{name} has no unit", expected=f'text such as "{example}"', got=repr(text))
        return float(number)
    # Decimal, so that "94 nm" is the float 94e-9 and not its neighbour 94 * 1e-9.
    return float(Decimal(number) * Decimal(repr(conversion_factor(unit_text, unit, name))))


def parse_amplitude_density(text: str | float, unit: str, name: str = "quantity") -> float:
    """Return the SI value of an amplitude density, for example ``"50 fm/rtHz"`` for one of lengths.

    Parameters
    ----------
    text : str or float
        Number and unit, with ``/rtHz``, ``/sqrt(Hz)`` or ``/√Hz`` at its end.
    unit : str
        SI unit of what is dense, ``"m"`` for a result in m/sqrt(Hz).
    name : str
        What the value is, for the error message.

    Raises
    ------
    UnitError
        If the text is no such density, or one of another dimension.

    Examples
    --------
    >>> parse_amplitude_density("50 fm/rtHz", "m"), parse_amplitude_density("0.1 pm/sqrt(Hz)", "m")
    (5e-14, 1e-13)
    """
    above, found = _PER_ROOT_HERTZ.subn("", str(text))
    if not found:
        raise UnitError(
            f"{name} is no amplitude density",
            expected=f'text such as "50 {"f" if unit == "m" else ""}{unit}/rtHz"',
            got=repr(text),
        )
    return parse_quantity(above, unit, name)


@dataclass(frozen=True)
class DisplayUnit:
    """A unit for people: multiply an SI value by ``factor`` and write ``label`` behind it."""

    factor: float
    label: str


def display_unit(magnitude: float, unit: str) -> DisplayUnit:
    """Choose the prefix in which a value of this magnitude reads best; radians read in degrees.

    Examples
    --------
    >>> display_unit(1.93e9, "Pa").label, display_unit(0.5, "rad").label, display_unit(3.0, "N/m").label
    ('GPa', 'deg', 'N/m')
    """
    if unit == "rad":
        return DisplayUnit(180.0 / math.pi, "deg")
    magnitude = abs(magnitude)
    if unit == "J" and 0.0 < magnitude < 1e-12:
        electronvolt = _BASE["eV"][0]
        kilo = magnitude >= 1e3 * electronvolt
        return DisplayUnit(1.0 / electronvolt / (1e3 if kilo else 1.0), "keV" if kilo else "eV")
    if unit not in _PREFIXED_SI or magnitude == 0.0 or not math.isfinite(magnitude):
        return DisplayUnit(1.0, "" if unit == "1" else unit)
    exponent = min(max(3 * math.floor(math.log10(magnitude) / 3.0 + 1e-12), -15), 12)
    return DisplayUnit(10.0**-exponent, _DISPLAY_PREFIX[exponent] + unit)


def format_quantity(value: float, unit: str, digits: int = 3) -> str:
    """Write an SI value with a readable prefix.

    Examples
    --------
    >>> format_quantity(1.93e9, "Pa"), format_quantity(94e-9, "m"), format_quantity(287.0, "1")
    ('1.93 GPa', '94 nm', '287')
    """
    if not math.isfinite(value):
        return "-"
    display = display_unit(value, unit)
    return f"{value * display.factor:.{digits}g} {display.label}".strip()
