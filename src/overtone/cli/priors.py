"""Priors as the command line has them: a range, a mean with its deviation, or a median with its factor."""

from __future__ import annotations

from typing import Any

from overtone.errors import OvertoneError
from overtone.units import parse_quantity

_UNITS = {
    "modulus": "Pa",
    "stiffness": "N/m",
    "prefactor": "1",
    "adhesion": "N",
    "indentation": "m",
    "loss_tangent": "1",
}
_IN_RATIOS = ("modulus", "stiffness", "prefactor", "indentation")


def parse_priors(texts: tuple[str, ...]) -> dict[str, Any]:
    """Return priors by name of the property.

    Parameters
    ----------
    texts : tuple of str
        Such as ``modulus=10 MPa .. 10 GPa`` (a range; of ratios for modulus, stiffness and indentation),
        ``adhesion=8 nN +- 3 nN`` (mean and standard deviation) or ``modulus=2 GPa */ 3`` (median and the factor of one
        standard deviation).

    Raises
    ------
    OvertoneError
        If a text is not understood.
    """
    from overtone.inversion.priors import LOG_NORMAL, LOG_RANGE, NORMAL, RANGE, Prior

    priors: dict[str, Any] = {}
    for text in texts:
        name, _, value = (part.strip() for part in text.partition("="))
        if name in priors:
            raise OvertoneError(f"--prior {name} is given twice", got=repr(text))
        mark = next((m for m in ("..", "+-", "*/") if m in value), None)
        if name not in _UNITS or mark is None:
            raise OvertoneError(
                "--prior is not understood",
                expected='modulus="10 MPa .. 10 GPa", adhesion="8 nN +- 3 nN" or modulus="2 GPa */ 3"; names are '
                + ", ".join(_UNITS),
                got=repr(text),
            )
        left, right = (part.strip() for part in value.split(mark, 1))
        unit = _UNITS[name]
        first = parse_quantity(left, unit, f"--prior {name}")
        second = parse_quantity(right, "1" if mark == "*/" else unit, f"--prior {name}")
        kind = {"..": LOG_RANGE if name in _IN_RATIOS else RANGE, "+-": NORMAL, "*/": LOG_NORMAL}[mark]
        priors[name] = Prior(kind, first, second)
    return priors
