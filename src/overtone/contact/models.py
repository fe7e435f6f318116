"""Contact models as records in one registry: parameters, assumptions and source of each, written once."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from overtone.contact import terms
from overtone.errors import ContactModelError


@dataclass(frozen=True)
class Parameter:
    """One parameter of a model: its unit, and the bounds between which an inversion looks for it."""

    name: str
    symbol: str
    unit: str
    meaning: str
    lower: float
    upper: float
    default: float | None = None
    """None where the user has to say."""


MODULUS = Parameter("modulus", "E_s", "Pa", "elastic modulus of the sample", 1e4, 1e12)
ADHESION = Parameter("adhesion", "F_ad", "N", "force of adhesion", 1e-12, 1e-6)
RADIUS = Parameter("radius", "R", "m", "tip radius", 1e-10, 1e-4)
POISSON = Parameter("poisson_ratio", "nu_s", "1", "Poisson's ratio of the sample", -1.0, 0.5)
DISTANCE = Parameter(
    "intermolecular_distance", "a_0", "m", "intermolecular distance", 1e-12, 1e-8, default=0.2e-9
)


@dataclass(frozen=True)
class ContactModel:
    """A law for the force between tip and sample, a sum of terms linear in its unknowns.

    Parameters
    ----------
    key, title : str
        Name in calls and on the command line, and in words.
    tail : int
        Shape of the adhesive term, one of the constants of `overtone.contact.terms`.
    unknowns : tuple of Parameter
        Material parameters an inversion looks for, next to the indentation.
    given : tuple of Parameter
        Parameters that have to be known.
    invertible : bool
        Whether its harmonics exist in closed form here; without, the model serves simulation only.
    assumptions : str
        What it takes for granted and where that fails.
    source : str
        Where the law comes from.
    """

    key: str
    title: str
    tail: int
    unknowns: tuple[Parameter, ...]
    given: tuple[Parameter, ...]
    invertible: bool
    assumptions: str
    source: str


_PAPER = "Shaik, Reifenberger and Raman, Nanotechnology 31 (2020) 455502"
_MODELS = (
    ContactModel(
        key="hertz",
        title="Hertz: paraboloid on an elastic half-space, no adhesion",
        tail=terms.NO_ADHESION,
        unknowns=(MODULUS,),
        given=(RADIUS, POISSON),
        invertible=True,
        assumptions="Small strain, indentation well below the tip radius, no adhesion, no loss. Adhesion of "
        "a few per cent of the peak force already biases the modulus.",
        source=f"{_PAPER}, fig. 2(c)",
    ),
    ContactModel(
        key="dmt-linear",
        title="DMT with an attraction that falls linearly to zero at 2 a0",
        tail=terms.LINEAR_TAIL,
        unknowns=(MODULUS, ADHESION),
        given=(RADIUS, POISSON, DISTANCE),
        invertible=True,
        assumptions="Hertz contact under constant adhesion (Tabor parameter below about 0.1; JKR is the "
        "better limit for soft samples), no loss. The linear tail has the area of the van der Waals tail only "
        "for a0 << A1; it costs 4 to 17 % of the modulus where adhesion is strong.",
        source=f"{_PAPER}, eqs 17 and 19, with eq 19c corrected: gamma/beta in its first term reads gamma/(2 beta)",
    ),
    ContactModel(
        key="dmt",
        title="DMT with the van der Waals attraction of a sphere",
        tail=terms.VAN_DER_WAALS_TAIL,
        unknowns=(MODULUS, ADHESION),
        given=(RADIUS, POISSON, DISTANCE),
        invertible=False,
        assumptions="As dmt-linear, with the attraction (a0/(a0 + d))^2 outside contact.",
        source=f"{_PAPER}, eq 15",
    ),
)
_REGISTRY = {model.key: model for model in _MODELS}


def models() -> tuple[ContactModel, ...]:
    """Return every contact model, simplest first."""
    return _MODELS


def contact_model(key: str) -> ContactModel:
    """Return the contact model of this key.

    Raises
    ------
    ContactModelError
        If there is none.

    Examples
    --------
    >>> [parameter.name for parameter in contact_model("dmt-linear").unknowns]
    ['modulus', 'adhesion']
    """
    if key not in _REGISTRY:
        raise ContactModelError("unknown contact model", expected=", ".join(_REGISTRY), got=repr(key))
    return _REGISTRY[key]


def effective_modulus(
    modulus: Any, poisson_ratio: float, tip_modulus: float, tip_poisson_ratio: float
) -> npt.NDArray[np.float64]:
    """Return E* of tip and sample [Pa], ``1/E* = (1-nu_t^2)/E_t + (1-nu_s^2)/E_s`` (eq 16).

    Examples
    --------
    >>> float(round(effective_modulus(1e9, 0.3, 130e9, 0.3) / 1e9, 6))
    1.090513
    """
    sample = (1.0 - poisson_ratio**2) / np.asarray(modulus, dtype=float)
    return np.asarray(1.0 / ((1.0 - tip_poisson_ratio**2) / tip_modulus + sample))


@dataclass(frozen=True)
class Sample:
    """A material under a tip: a contact model with its parameters in SI units.

    Parameters
    ----------
    model : ContactModel
        The force law.
    modulus, adhesion : array, any one shape
        Elastic modulus [Pa] and force of adhesion [N].
    poisson_ratio : float
        Poisson's ratio of the sample.
    intermolecular_distance : float
        a0 [m], range of the attraction.
    """

    model: ContactModel
    modulus: npt.NDArray[np.float64]
    adhesion: npt.NDArray[np.float64]
    poisson_ratio: float
    intermolecular_distance: float


def sample(
    model: str,
    *,
    modulus: Any,
    poisson_ratio: float,
    adhesion: Any = None,
    intermolecular_distance: float = 0.2e-9,
) -> Sample:
    """Describe a material, or a map of them, by a contact model and its parameters.

    Parameters
    ----------
    model : str
        Key of a contact model.
    modulus : array, any shape
        Elastic modulus [Pa], positive.
    poisson_ratio : float
        Poisson's ratio; it has no default.
    adhesion : array, broadcast against ``modulus``
        Force of adhesion [N], not negative; required by the models that have it and refused by the rest.
    intermolecular_distance : float
        a0 [m].

    Raises
    ------
    ContactModelError
        If a parameter is missing, not a finite number in its range, not one of the model's, or if the
        shapes do not fit.

    Examples
    --------
    >>> float(sample("dmt", modulus=2e9, poisson_ratio=0.35, adhesion=8e-9).modulus)
    2000000000.0
    """
    record = contact_model(model)
    wants_adhesion = ADHESION in record.unknowns
    if wants_adhesion != (adhesion is not None):
        verb = "needs" if wants_adhesion else "has no"
        raise ContactModelError(f"model {model!r} {verb} adhesion", got=f"adhesion={adhesion!r}")
    E, F = np.asarray(modulus, dtype=float), np.asarray(0.0 if adhesion is None else adhesion, dtype=float)
    if not (np.all(np.isfinite(E)) and np.all(E > 0)):
        raise ContactModelError("modulus is out of range", expected="finite numbers > 0 Pa")
    if not (np.all(np.isfinite(F)) and np.all(F >= 0)):
        raise ContactModelError("adhesion is out of range", expected="finite numbers >= 0 N")
    check_poisson_ratio(poisson_ratio)
    if not (math.isfinite(intermolecular_distance) and intermolecular_distance > 0):
        raise ContactModelError(
            "intermolecular_distance is out of range", expected="> 0 m", got=str(intermolecular_distance)
        )
    try:
        E, F = np.broadcast_arrays(E, F)
    except ValueError as error:
        raise ContactModelError(
            "shapes do not fit",
            expected="arrays that broadcast",
            got=f"modulus {E.shape}, adhesion {F.shape}",
        ) from error
    return Sample(record, E, F, poisson_ratio, intermolecular_distance)


def check_poisson_ratio(poisson_ratio: float) -> None:
    """Refuse a Poisson's ratio outside (-1, 0.5]."""
    if not (math.isfinite(poisson_ratio) and POISSON.lower < poisson_ratio <= POISSON.upper):
        raise ContactModelError(
            "Poisson's ratio is out of range", expected="-1 < nu <= 0.5", got=str(poisson_ratio)
        )
