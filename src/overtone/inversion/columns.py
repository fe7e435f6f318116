"""A contact model as columns: what one unit of each material parameter adds to the force harmonics.

Given the indentation every closed-form model is linear in its parameters,

    CONS_n = S a_n + F_ad b_n          DISS_n = -n tan(delta) S a_n

with the elastic harmonics a_n, the adhesive ones b_n, the coefficient S of the elastic term and the loss tangent of
its viscous partner. The columns come from the record of the model itself (`overtone.contact.models`), whose laws are
tables of numbers: nothing about a model is written here again.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from overtone.contact import law
from overtone.contact.models import BUILT_IN, ContactModel
from overtone.contact.parameters import Parameter
from overtone.contact.terms import NO_ADHESION, adhesion_harmonics, power_harmonics
from overtone.errors import InversionError
from overtone.inversion.linear import Contact
from overtone.kernels import kernel
from overtone.probe import Probe, required_radius

_Floats = npt.NDArray[np.float64]

WORK_ROWS = 6
"""Rows of scratch that `fill_columns` needs; the first four hold its answer."""


class Columns(NamedTuple):
    """A contact model, its given parameters filled in, as kernels take it."""

    powers: _Floats
    """(term,): exponents of the elastic terms."""
    shares: _Floats
    """(term,): their coefficients at S = 1 [m^(p0 - p)], the first of them 1."""
    contact: Contact
    """Tail and range of the attraction; what turns a modulus, or a stiffness, into S."""
    loss: float
    """Loss tangent over viscosity, times S [N/m^p s...]; 0 for a model without loss."""


@kernel
def fill_columns(columns: Columns, amplitude: float, Delta: float, n_max: int, work: _Floats) -> None:
    """Fill rows of ``work`` (6, n_max + 1): a_n, da_n/dDelta, b_n, db_n/dDelta; the other two are scratch.

    Valid for any Delta; the elastic term is zero out of contact.
    """
    power_harmonics(amplitude, Delta, columns.powers[0], n_max, work[0], work[1])
    for k in range(1, columns.powers.shape[0]):
        power_harmonics(amplitude, Delta, columns.powers[k], n_max, work[4], work[5])
        for n in range(n_max + 1):
            work[0, n] += columns.shares[k] * work[4, n]
            work[1, n] += columns.shares[k] * work[5, n]
    contact = columns.contact
    adhesion_harmonics(contact.tail, amplitude, Delta, contact.a0, n_max, work[2], work[3])


@kernel
def adhesive(columns: Columns) -> bool:
    """Return whether the model has a force of adhesion among its unknowns."""
    return bool(columns.contact.tail != NO_ADHESION)


def is_linear(record: ContactModel) -> bool:
    """Return whether a model is a sum of powers, at most one attraction and the viscous partner of its power."""
    known = {law.POWER, law.ADHESION, law.VISCOUS}
    if any(term.row is None for term in record.terms):
        return False
    examples = {q.name: np.asarray(q.example, dtype=float) for q in record.parameters}
    rows = np.asarray(record.table(examples))
    kinds = rows[:, 0]
    if not set(kinds) <= known or not (kinds == law.POWER).any():
        return False
    elastic, viscous = rows[kinds == law.POWER], rows[kinds == law.VISCOUS]
    if (kinds == law.ADHESION).sum() > 1 or len(viscous) > 1:
        return False
    return not len(viscous) or (len(elastic) == 1 and viscous[0, 2] + 1.0 == elastic[0, 2])


def unknowns_of(record: ContactModel) -> tuple[Parameter, ...]:
    """Return the unknowns of a model in the order elastic, adhesion, loss; the last two where it has them."""
    known = {q.name: q for q in record.unknowns}
    return tuple(
        known[name]
        for name in ("modulus", "stiffness", "prefactor", "adhesion", "viscosity", "damping")
        if name in known
    )


def columns_of(record: ContactModel, probe: Probe, given: Mapping[str, float]) -> Columns:
    """Return a model as columns under the tip of a probe.

    Parameters
    ----------
    record : ContactModel
        A linear one (`is_linear`).
    probe : Probe
        With a tip radius where the model needs one.
    given : mapping of str to float
        Parameters of the model that have to be known and are not the probe's, SI units.

    Raises
    ------
    InversionError
        If the model is not linear in its parameters at a given indentation.
    ContactModelError, ProbeError
        If a parameter is missing or out of range, or the tip radius is.
    """
    if not is_linear(record):
        raise InversionError(
            f"model {record.key!r} cannot be inverted",
            expected=", ".join(m.key for m in BUILT_IN if is_linear(m)),
            hint="the one of these nearest to it",
        )
    values: dict[str, npt.NDArray[np.float64]] = {}
    own = {
        "tip_modulus": probe.tip.modulus,
        "tip_poisson_ratio": probe.tip.poisson_ratio,
        "frequency": probe.drive.frequency,
    }
    for q in record.given:
        if q.name == "radius":
            values[q.name] = np.asarray(required_radius(probe))
        elif q.name in own:
            values[q.name] = np.asarray(own[q.name], dtype=float)
        elif given.get(q.name) is not None:
            values[q.name] = q.check(given[q.name])
        elif q.default is not None:
            values[q.name] = np.asarray(q.default)
        else:
            raise InversionError(
                f"model {record.key!r} needs {q.name}", expected=f"{q.meaning} [{q.unit}]", got="no value"
            )
    values |= {q.name: np.asarray(q.example, dtype=float) for q in record.unknowns}
    rows = np.asarray(record.table(values))
    elastic = rows[rows[:, 0] == law.POWER]
    adhesion = rows[rows[:, 0] == law.ADHESION]
    viscous = rows[rows[:, 0] == law.VISCOUS]
    first = unknowns_of(record)[0].name
    if first == "modulus":
        tip = (
            (1.0 - float(values["tip_poisson_ratio"]) ** 2) / float(values["tip_modulus"])
            if "tip_modulus" in values
            else 0.0
        )
        of_the_sample = 1.0 - float(values["poisson_ratio"]) ** 2
        E_star = 1.0 / (tip + of_the_sample / float(values["modulus"]))
    else:
        tip, of_the_sample, E_star = 0.0, 1.0, float(values[first])
    loss = 0.0
    if len(viscous):
        # tan(delta) = w c / (p S) for -c (-d)^(p-1) d' beside S (-d)^p
        of_one = viscous[0, 1] / float(values[unknowns_of(record)[-1].name])
        loss = 2.0 * math.pi * probe.drive.frequency * of_one / elastic[0, 2]
    return Columns(
        elastic[:, 2].copy(),
        elastic[:, 1] / elastic[0, 1],
        Contact(
            int(adhesion[0, 3]) if len(adhesion) else NO_ADHESION,
            float(adhesion[0, 2]) if len(adhesion) else 1.0,
            tip,
            of_the_sample,
            float(elastic[0, 1]) / E_star,
        ),
        float(loss),
    )
