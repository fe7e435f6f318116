"""Parameters of contact models: each one declared once, with its unit, its range and its default."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from overtone.errors import ContactModelError

Values = Mapping[str, npt.NDArray[np.float64]]


@dataclass(frozen=True)
class Parameter:
    """One parameter of a contact model.

    Parameters
    ----------
    name, symbol, unit, meaning : str
        Name in calls, symbol in formulas, SI unit, and what it is.
    lower, upper : float
        Bounds between which an inversion looks for it.
    default : float or None
        None where the user has to say.
    minimum, maximum : float
        Range outside which a value makes no sense.
    zero_allowed : bool
        Whether the minimum itself is allowed.
    example : float
        An ordinary value, for figures.
    """

    name: str
    symbol: str
    unit: str
    meaning: str
    lower: float
    upper: float
    default: float | None = None
    minimum: float = 0.0
    maximum: float = math.inf
    zero_allowed: bool = False
    example: float = 1.0

    def check(self, value: Any) -> npt.NDArray[np.float64]:
        """Return the value as an array of floats, or say what is wrong with it.

        Raises
        ------
        ContactModelError
            If it is not a finite number in the range of the parameter.
        """
        try:
            array = np.asarray(value, dtype=float)
        except (TypeError, ValueError) as error:
            raise ContactModelError(f"{self.name} is not a number", got=repr(value)) from error
        low = array >= self.minimum if self.zero_allowed else array > self.minimum
        if not np.all(np.isfinite(array) & low & (array <= self.maximum)):
            sign = ">=" if self.zero_allowed else ">"
            limit = "" if math.isinf(self.maximum) else f" and <= {self.maximum:g}"
            bad = array[~(np.isfinite(array) & low & (array <= self.maximum))].ravel()
            raise ContactModelError(
                f"{self.name} is out of range",
                expected=f"finite numbers {sign} {self.minimum:g}{limit} {self.unit}".replace(" 1", ""),
                got=f"{bad[0]:g}",
            )
        return array


MODULUS = Parameter("modulus", "E_s", "Pa", "elastic modulus of the sample", 1e4, 1e12, example=1e9)
ADHESION = Parameter(
    "adhesion", "F_ad", "N", "force of adhesion", 1e-12, 1e-6, zero_allowed=True, example=10e-9
)
RADIUS = Parameter("radius", "R", "m", "radius of the tip or punch", 1e-10, 1e-4, example=10e-9)
POISSON_RATIO = Parameter(
    "poisson_ratio",
    "nu_s",
    "1",
    "Poisson's ratio of the sample",
    -1.0,
    0.5,
    minimum=-1.0,
    maximum=0.5,
    example=0.35,
)
TIP_MODULUS = Parameter(
    "tip_modulus", "E_t", "Pa", "Young's modulus of the tip", 1e9, 1e13, default=130e9, example=130e9
)
TIP_POISSON_RATIO = Parameter(
    "tip_poisson_ratio",
    "nu_t",
    "1",
    "Poisson's ratio of the tip",
    -1.0,
    0.5,
    0.3,
    minimum=-1.0,
    maximum=0.5,
    example=0.3,
)
DISTANCE = Parameter(
    "intermolecular_distance",
    "a_0",
    "m",
    "range of the attraction",
    1e-12,
    1e-8,
    default=0.2e-9,
    example=0.2e-9,
)
VISCOSITY = Parameter(
    "viscosity", "eta", "Pa s", "viscosity of the contact", 1e-3, 1e6, zero_allowed=True, example=100.0
)
STIFFNESS = Parameter("stiffness", "k_s", "N/m", "stiffness of the sample", 1e-4, 1e5, example=5.0)
DAMPING = Parameter(
    "damping", "c_s", "N s/m", "damping of the sample", 1e-12, 1.0, zero_allowed=True, example=1e-6
)
EXPONENT = Parameter(
    "exponent", "p", "1", "power of the indentation", 0.0, 10.0, maximum=10.0, zero_allowed=True, example=1.5
)
PREFACTOR = Parameter("prefactor", "C", "N/m^p", "force at unit indentation", 1e-6, 1e30, example=1e5)
HALF_ANGLE = Parameter(
    "half_angle",
    "alpha",
    "rad",
    "half-angle of the cone",
    0.01,
    1.56,
    maximum=math.radians(89.9),
    example=math.radians(20.0),
)
THICKNESS = Parameter("thickness", "h", "m", "thickness of the layer", 1e-10, 1e-2, example=50e-9)
WORK_OF_ADHESION = Parameter(
    "work_of_adhesion", "w", "J/m^2", "work of adhesion", 1e-5, 10.0, zero_allowed=True, example=0.1
)
RUPTURE = Parameter("rupture_distance", "d_c", "m", "gap at which the neck breaks", 1e-11, 1e-6, example=2e-9)
INSTANTANEOUS_MODULUS = Parameter(
    "instantaneous_modulus",
    "E_0",
    "Pa",
    "modulus of the sample at once, not below modulus",
    1e4,
    1e12,
    example=3e9,
)
RELAXATION_TIME = Parameter(
    "relaxation_time", "tau", "s", "stress relaxation time of the sample", 1e-12, 1e3, example=1e-6
)
FREQUENCY = Parameter("frequency", "f", "Hz", "frequency of the motion", 1.0, 1e9, example=160e3)


def effective_modulus(
    modulus: Any, poisson_ratio: Any, tip_modulus: Any = 130e9, tip_poisson_ratio: Any = 0.3
) -> npt.NDArray[np.float64]:
    """Return E* of tip and sample [Pa], ``1/E* = (1-nu_t^2)/E_t + (1-nu_s^2)/E_s`` (eq 16).

    Examples
    --------
    >>> float(round(effective_modulus(1e9, 0.3, 130e9, 0.3) / 1e9, 6))
    1.090513
    """
    sample = (1.0 - np.square(poisson_ratio)) / np.asarray(modulus, dtype=float)
    return np.asarray(1.0 / ((1.0 - np.square(tip_poisson_ratio)) / tip_modulus + sample))


def resolve(
    key: str, parameters: tuple[Parameter, ...], given: Mapping[str, Any]
) -> dict[str, npt.NDArray[np.float64]]:
    """Return the value of every parameter of a model, defaults filled in.

    Raises
    ------
    ContactModelError
        If a name is not one of the model's, a value is missing or out of range.
    """
    given = {name: value for name, value in given.items() if value is not None}
    known = {parameter.name: parameter for parameter in parameters}
    unknown = [name for name in given if name not in known]
    if unknown:
        raise ContactModelError(
            f"model {key!r} has no {unknown[0]}",
            expected=", ".join(known),
            got=f"{unknown[0]}={given[unknown[0]]!r}",
        )
    missing = [p.name for p in parameters if p.default is None and given.get(p.name) is None]
    if missing:
        raise ContactModelError(
            f"model {key!r} needs {' and '.join(missing)}", got=f"only {', '.join(given)}"
        )
    values = {}
    for parameter in parameters:
        value = given.get(parameter.name)
        values[parameter.name] = parameter.check(parameter.default if value is None else value)
    return values


def check_shapes(values: Values, **arrays: npt.NDArray[np.float64]) -> None:
    """Refuse parameters and arrays that do not broadcast.

    Raises
    ------
    ContactModelError
        With the shapes that arrived.
    """
    everything = {**values, **arrays}
    try:
        np.broadcast_shapes(*(array.shape for array in everything.values()))
    except ValueError as error:
        shapes = ", ".join(f"{name} {array.shape}" for name, array in everything.items() if array.shape)
        raise ContactModelError("shapes do not fit", expected="arrays that broadcast", got=shapes) from error
