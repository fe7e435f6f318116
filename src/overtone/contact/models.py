"""Contact models as records in one registry: terms, parameters, assumptions and source, written once."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from overtone.contact import adhesive, terms
from overtone.contact import parameters as p
from overtone.contact.kinds import (
    Term,
    adhesion_term,
    branch_term,
    history_term,
    hysteresis_term,
    power_term,
    viscous_term,
)
from overtone.contact.parameters import Parameter, Values, effective_modulus
from overtone.contact.relaxation import sls_harmonics
from overtone.contact.thin_layer import layer_coefficients
from overtone.errors import ContactModelError


@dataclass(frozen=True)
class ContactModel:
    """A law for the force between tip and sample: a sum of terms.

    Parameters
    ----------
    key, title : str
        Name in calls and on the command line, and in words.
    terms : tuple of Term
        Each linear in one material parameter once the indentation is given.
    unknowns : tuple of Parameter
        Material parameters an inversion looks for, next to the indentation.
    given : tuple of Parameter
        Parameters that have to be known.
    assumptions : str
        What it takes for granted and where that fails.
    source : str
        Where the law comes from.
    tail : int or None
        For a paraboloid with adhesion: the shape of its adhesive term, a constant of
        `overtone.contact.terms`. None for laws of another kind.
    invertible : bool
        Whether `overtone.map_properties` can look for its unknowns.
    """

    key: str
    title: str
    terms: tuple[Term, ...]
    unknowns: tuple[Parameter, ...]
    given: tuple[Parameter, ...]
    assumptions: str
    source: str
    tail: int | None = None
    invertible: bool = False

    def table(self, values: Values) -> npt.NDArray[np.float64]:
        """Return the law as a table for compiled code, last axes term and column (`overtone.contact.law`).

        Raises
        ------
        ContactModelError
            If a term has none: its force depends on more than gap, velocity and whether contact holds.
        """
        missing = [term.formula for term in self.terms if term.row is None]
        if missing:
            raise ContactModelError(
                f"the motion over a sample of model {self.key!r} cannot be simulated",
                expected="terms with a row for compiled code",
                got=", ".join(missing),
                hint="a model whose loss follows gap and velocity, such as dmt-viscous or hertz-viscous",
            )
        rows = [np.asarray(term.row(values)) for term in self.terms if term.row is not None]
        shape = np.broadcast_shapes(*(row.shape for row in rows))
        return np.ascontiguousarray(np.stack([np.broadcast_to(row, shape) for row in rows], axis=-2))

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Every parameter of the model, unknowns first."""
        return self.unknowns + self.given


# --- coefficients -----------------------------------------------------------------------------------------------


def _E_star(values: Values) -> npt.NDArray[np.float64]:
    return effective_modulus(
        *(values[k] for k in ("modulus", "poisson_ratio", "tip_modulus", "tip_poisson_ratio"))
    )


def _sphere(values: Values) -> Any:
    return 4.0 / 3.0 * _E_star(values) * np.sqrt(values["radius"])


def _sphere_viscosity(values: Values) -> Any:
    return values["viscosity"] * np.sqrt(values["radius"])


def _cone(values: Values) -> Any:
    return 2.0 / math.pi * _E_star(values) * np.tan(values["half_angle"])


def _punch(values: Values) -> Any:
    return 2.0 * _E_star(values) * values["radius"]


def _layer(order: int) -> Any:
    """Return the coefficient of (-d)^((3 + order)/2) of a bonded layer; the tip counts as rigid."""

    def coefficient(values: Values) -> Any:
        ratio, where = np.unique(values["poisson_ratio"], return_inverse=True)
        series = np.array([layer_coefficients(float(nu))[order] for nu in ratio])[where]
        plane = values["modulus"] / (1.0 - values["poisson_ratio"] ** 2)
        scale = np.sqrt(values["radius"]) ** (order + 1) / values["thickness"] ** order
        return 4.0 / 3.0 * plane * scale * series.reshape(values["poisson_ratio"].shape)

    return coefficient


def _relaxing_sphere(
    values: Values, amplitude: npt.NDArray[np.float64], Delta: npt.NDArray[np.float64], n_max: int
) -> npt.NDArray[np.complex128]:
    plane = 1.0 / (1.0 - values["poisson_ratio"] ** 2)
    return sls_harmonics(
        amplitude,
        2.0 * amplitude * Delta,
        n_max,
        frequency=values["frequency"],
        radius=values["radius"],
        effective_modulus=values["modulus"] * plane,
        instantaneous_modulus=values["instantaneous_modulus"] * plane,
        relaxation_time=values["relaxation_time"],
    )


def _jkr(values: Values) -> dict[str, Any]:
    work = values["adhesion"] / (1.5 * math.pi * values["radius"])
    return {"effective_modulus": _E_star(values), "radius": values["radius"], "work_of_adhesion": work}


def _jkr_row(values: Values) -> Any:
    return adhesive.jkr_row(**_jkr(values))


def _maugis_row(values: Values) -> Any:
    return adhesive.maugis_row(**_maugis(values))


def _jkr_force(values: Values, gap: Any, approaching: Any) -> Any:
    return adhesive.jkr_force(-gap, approaching=approaching, **_jkr(values))


def _jkr_harmonics(values: Values, amplitude: Any, Delta: Any, n_max: int) -> Any:
    return adhesive.harmonics("jkr", amplitude, 2.0 * amplitude * Delta, n_max, **_jkr(values))


def _maugis(values: Values) -> dict[str, Any]:
    return {
        "effective_modulus": _E_star(values),
        "radius": values["radius"],
        "work_of_adhesion": values["work_of_adhesion"],
        # with this range the limit of hard samples is dmt-linear, whose tail ends at 2 a0
        "range_of_attraction": 2.0 * values["intermolecular_distance"],
    }


def _maugis_force(values: Values, gap: Any, approaching: Any) -> Any:
    return adhesive.maugis_force(-gap, approaching=approaching, **_maugis(values))


def _maugis_harmonics(values: Values, amplitude: Any, Delta: Any, n_max: int) -> Any:
    return adhesive.harmonics("maugis", amplitude, 2.0 * amplitude * Delta, n_max, **_maugis(values))


def _value(name: str) -> Any:
    return lambda values: values[name]


def _constant(number: float) -> Any:
    return lambda values: number


# --- terms ------------------------------------------------------------------------------------------------------

_SPHERE = power_term("4/3 E* sqrt(R) (-d)^(3/2)", _sphere, _constant(1.5))
_SPHERE_LOSS = viscous_term("-eta sqrt(R) (-d)^(1/2) d'", _sphere_viscosity, _constant(0.5))
_SPRING = power_term("-k_s d", _value("stiffness"), _constant(1.0))
_SPRING_LOSS = viscous_term("-c_s d'", _value("damping"), _constant(0.0))
_CONTACT_ADHESION = adhesion_term("-F_ad in contact", terms.CONTACT_ONLY, _value("adhesion"))
_LINEAR = adhesion_term("-F_ad max(0, 1 - d/(2 a_0))", terms.LINEAR_TAIL, _value("adhesion"))
_VAN_DER_WAALS = adhesion_term("-F_ad (a_0/(a_0 + d))^2", terms.VAN_DER_WAALS_TAIL, _value("adhesion"))
_NECK = hysteresis_term("-F_ad for 0 < d < d_c on retraction", _value("adhesion"), _value("rupture_distance"))

_TIP = (p.RADIUS, p.POISSON_RATIO, p.TIP_MODULUS, p.TIP_POISSON_RATIO)
_SOLID = (p.POISSON_RATIO, p.TIP_MODULUS, p.TIP_POISSON_RATIO)
_PAPER = "Shaik, Reifenberger and Raman, Nanotechnology 31 (2020) 455502"
_HERTZIAN = "Small strain, indentation well below the tip radius, elastic half-space."

BUILT_IN = (
    ContactModel(
        key="kelvin-voigt",
        title="Spring and dashpot in parallel",
        terms=(_SPRING, _SPRING_LOSS),
        unknowns=(p.STIFFNESS, p.DAMPING),
        given=(p.FREQUENCY,),
        assumptions="Stiffness independent of indentation; the dashpot pulls at the end of contact.",
        source=f"{_PAPER}, fig. 2(a)",
    ),
    ContactModel(
        key="kelvin-voigt-adhesion",
        title="Spring and dashpot with a constant adhesion in contact",
        terms=(_SPRING, _SPRING_LOSS, _CONTACT_ADHESION),
        unknowns=(p.STIFFNESS, p.DAMPING, p.ADHESION),
        given=(p.FREQUENCY,),
        assumptions="As kelvin-voigt; adhesion without range, the same in and out.",
        source=f"{_PAPER}, fig. 2(b)",
    ),
    ContactModel(
        key="hertz",
        title="Hertz: paraboloid on an elastic half-space, no adhesion",
        terms=(_SPHERE,),
        unknowns=(p.MODULUS,),
        given=_TIP,
        assumptions=f"{_HERTZIAN} No loss. Adhesion of a few per cent of the peak force already biases the modulus.",
        source=f"{_PAPER}, fig. 2(c)",
        tail=terms.NO_ADHESION,
        invertible=True,
    ),
    ContactModel(
        key="hertz-viscous",
        title="Hertz with a Kelvin-Voigt contact",
        terms=(_SPHERE, _SPHERE_LOSS),
        unknowns=(p.MODULUS, p.VISCOSITY),
        given=(*_TIP, p.FREQUENCY),
        assumptions=f"{_HERTZIAN} Loss proportional to the contact radius and the speed; the force turns attractive "
        "before contact ends, where a real contact would let go.",
        source="Garcia and San Paulo, Phys. Rev. B 60 (1999) 4961, for the form of the loss",
    ),
    ContactModel(
        key="dmt-contact",
        title="DMT without attraction outside contact",
        terms=(_SPHERE, _CONTACT_ADHESION),
        unknowns=(p.MODULUS, p.ADHESION),
        given=_TIP,
        assumptions=f"{_HERTZIAN} Stiff and weakly adhesive (small Tabor parameter), no loss, no attraction "
        "before contact.",
        source=f"{_PAPER}, fig. 2(d)",
        tail=terms.CONTACT_ONLY,
    ),
    ContactModel(
        key="dmt-linear",
        title="DMT with an attraction that falls linearly to zero at 2 a0",
        terms=(_SPHERE, _LINEAR),
        unknowns=(p.MODULUS, p.ADHESION),
        given=(*_TIP, p.DISTANCE),
        assumptions="Hertz contact under constant adhesion (Tabor parameter below about 0.1; JKR is the better limit "
        "for soft samples), no loss. The linear tail has the area of the van der Waals tail only for a0 << A1; it "
        "costs 4 to 17 % of the modulus where adhesion is strong.",
        source=f"{_PAPER}, eqs 17 and 19, with eq 19c corrected: gamma/beta in its first term reads gamma/(2 beta)",
        tail=terms.LINEAR_TAIL,
        invertible=True,
    ),
    ContactModel(
        key="dmt",
        title="DMT with the van der Waals attraction of a sphere",
        terms=(_SPHERE, _VAN_DER_WAALS),
        unknowns=(p.MODULUS, p.ADHESION),
        given=(*_TIP, p.DISTANCE),
        assumptions="As dmt-linear, with the attraction (a0/(a0 + d))^2 outside contact.",
        source=f"{_PAPER}, eq 15; its harmonics in closed form are derived in overtone.contact.terms",
        tail=terms.VAN_DER_WAALS_TAIL,
        invertible=True,
    ),
    ContactModel(
        key="dmt-viscous",
        title="DMT with van der Waals attraction and a Kelvin-Voigt contact",
        terms=(_SPHERE, _VAN_DER_WAALS, _SPHERE_LOSS),
        unknowns=(p.MODULUS, p.ADHESION, p.VISCOSITY),
        given=(*_TIP, p.DISTANCE, p.FREQUENCY),
        assumptions="As dmt, with the loss of hertz-viscous.",
        source=f"{_PAPER}, eq 15, with the loss of Garcia and San Paulo, Phys. Rev. B 60 (1999) 4961",
    ),
    ContactModel(
        key="cone",
        title="Sneddon: cone on an elastic half-space",
        terms=(power_term("2/pi E* tan(alpha) d^2", _cone, _constant(2.0)),),
        unknowns=(p.MODULUS,),
        given=(p.HALF_ANGLE, *_SOLID),
        assumptions="Indentation well beyond the blunt end of the tip; half-angle not small; no adhesion, no loss.",
        source="Sneddon, Int. J. Eng. Sci. 3 (1965) 47",
    ),
    ContactModel(
        key="flat-punch",
        title="Sneddon: flat cylindrical punch on an elastic half-space",
        terms=(power_term("-2 E* R d", _punch, _constant(1.0)),),
        unknowns=(p.MODULUS,),
        given=(p.RADIUS, *_SOLID),
        assumptions="Full and parallel contact at once; no adhesion, no loss.",
        source="Sneddon, Int. J. Eng. Sci. 3 (1965) 47",
    ),
    ContactModel(
        key="power",
        title="Any power of the indentation",
        terms=(power_term("C (-d)^p", _value("prefactor"), _value("exponent")),),
        unknowns=(p.PREFACTOR,),
        given=(p.EXPONENT,),
        assumptions="A power law from the first touch on; p = 1 punch, 3/2 paraboloid, 2 cone.",
        source="Sneddon, Int. J. Eng. Sci. 3 (1965) 47, for axisymmetric punches of power-law profile",
    ),
    ContactModel(
        key="thin-layer",
        title="Paraboloid on a thin layer bonded to a rigid substrate",
        terms=tuple(
            power_term(f"layer term of (-d)^({3 + order}/2)", _layer(order), _constant(1.5 + 0.5 * order))
            for order in range(5)
        ),
        unknowns=(p.MODULUS,),
        given=(p.RADIUS, p.POISSON_RATIO, p.THICKNESS),
        assumptions="Rigid tip and substrate, perfect bond, no friction, no adhesion, no loss. The series in "
        "chi = sqrt(R delta)/h is right to 1 % up to chi = 0.45 and to 5 % up to 0.65; at 1 it is 10 to 23 % too "
        "large.",
        source="derived again in docs/thin-layer.md; Dimitriadis et al., Biophys. J. 82 (2002) 2798, and Garcia and "
        "Garcia, Biophys. J. 114 (2018) 2923, disagree on some of its numbers",
    ),
    ContactModel(
        key="jkr",
        title="JKR: adhesion inside the contact only, with its hysteresis",
        terms=(
            branch_term(
                "JKR, F_ad = 3/2 pi w R",
                _jkr_force,
                _jkr_harmonics,
                _jkr_row,
            ),
        ),
        unknowns=(p.MODULUS, p.ADHESION),
        given=_TIP,
        assumptions="Soft and sticky samples (Tabor parameter above 5), small strain, quasi-static, gap imposed: "
        "contact starts at d = 0 and ends where the neck becomes unstable. A neck that the motion never breaks loses "
        "nothing.",
        source="Johnson, Kendall and Roberts, Proc. R. Soc. A 324 (1971) 301",
    ),
    ContactModel(
        key="maugis",
        title="Maugis-Dugdale: adhesion of finite range, between DMT and JKR",
        terms=(
            branch_term("Maugis, w over a range of 2 a_0", _maugis_force, _maugis_harmonics, _maugis_row),
        ),
        unknowns=(p.MODULUS, p.WORK_OF_ADHESION),
        given=(*_TIP, p.DISTANCE),
        assumptions="Constant adhesive stress over a range of 2 a0, so that hard samples give dmt-linear; small "
        "strain, quasi-static, gap imposed. DMT is reached slowly: at a Maugis parameter of 0.1 a fifth of the "
        "adhesion is still missing at a given indentation.",
        source="Maugis, J. Colloid Interface Sci. 150 (1992) 243",
    ),
    ContactModel(
        key="sls",
        title="Paraboloid on a standard linear solid",
        terms=(
            history_term(
                "Lee-Radok in, Ting out, E(t) = E_s + (E_0 - E_s) exp(-t/tau)",
                _relaxing_sphere,
                "force_harmonics, or sls_force_history of overtone.contact.relaxation",
            ),
        ),
        unknowns=(p.MODULUS, p.INSTANTANEOUS_MODULUS, p.RELAXATION_TIME),
        given=(p.RADIUS, p.POISSON_RATIO, p.FREQUENCY),
        assumptions="Rigid tip, no adhesion, intermittent contact only, and a surface that has recovered before the "
        "next tap: sls_residual of overtone.contact.relaxation gives the dent that is left.",
        source="Lee and Radok, J. Appl. Mech. 27 (1960) 438; Ting, J. Appl. Mech. 33 (1966) 845",
    ),
    ContactModel(
        key="capillary",
        title="Hertz with a neck that forms at contact and breaks on retraction",
        terms=(_SPHERE, _CONTACT_ADHESION, _NECK),
        unknowns=(p.MODULUS, p.ADHESION),
        given=(*_TIP, p.RUPTURE),
        assumptions=f"{_HERTZIAN} The force of the neck is constant from contact to rupture; it does not re-form while "
        "the tip comes back from beyond its reach.",
        source="Zitzler, Herminghaus and Mugele, Phys. Rev. B 66 (2002) 155436, for the constant-force neck",
    ),
)
_REGISTRY = {model.key: model for model in BUILT_IN}


def models() -> tuple[ContactModel, ...]:
    """Return every contact model, simplest first."""
    return tuple(_REGISTRY.values())


def register(model: ContactModel) -> None:
    """Add a contact model of one's own.

    Raises
    ------
    ContactModelError
        If the key is taken or a parameter appears twice.
    """
    names = [parameter.name for parameter in model.parameters]
    if model.key in _REGISTRY:
        raise ContactModelError(f"there is a model {model.key!r} already", hint="another key")
    if len(set(names)) != len(names):
        raise ContactModelError(f"model {model.key!r} declares a parameter twice", got=", ".join(names))
    _REGISTRY[model.key] = model


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
