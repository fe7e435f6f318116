"""What to know of the contact beside every modulus: load, size, pressure, adhesion regime, and what JKR would say."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import xarray as xr

from overtone import provenance
from overtone.contact import law
from overtone.contact.evaluate import force, force_harmonics
from overtone.contact.models import ContactModel, contact_model
from overtone.contact.parameters import MODULUS, Parameter, effective_modulus
from overtone.contact.terms import NO_ADHESION
from overtone.contact.validity import DMT_LIMIT, tabor_parameter
from overtone.errors import InversionError
from overtone.inversion.jkr import jkr_of_harmonics
from overtone.inversion.properties import AUTO, COMPARED
from overtone.probe import Probe, required_radius
from overtone.quantities import named_variable

_HIGHEST = 3  # of the harmonics that JKR is tabulated for
_INSTANTS = 64  # of the way in, for models whose force depends on speed

_Floats = npt.NDArray[np.float64]


def contact_validity(
    properties: xr.Dataset,
    amplitude: xr.DataArray,
    probe: Probe,
    *,
    model: str,
    harmonics: Sequence[int] = (0, 1, 2),
    **given: float,
) -> xr.Dataset:
    """Return what tells how far the contact of each pixel can be trusted to be what the model takes it for.

    Parameters
    ----------
    properties : Dataset
        A result of `overtone.map_properties`, or any dataset with ``indentation`` [m] and the unknowns of the model,
        SI units; the estimate at every pixel (``<name>_unscreened``) is taken where there is one.
    amplitude : DataArray
        A1 [m], on dimensions of the properties.
    probe : Probe
        With a tip radius where the model needs one.
    model : str
        Key of the contact model that the properties belong to.
    harmonics : sequence of int
        The three orders, of 0 to 3, whose conservative harmonics JKR has to reproduce; without three no JKR values.
    **given : float
        Parameters of the model that the probe does not hold: ``poisson_ratio``, ``intermolecular_distance`` [m],
        ``half_angle`` [rad], ``thickness`` [m].

    Returns
    -------
    Dataset
        On the dimensions of the properties, NaN where they are or make no sense, with the attribute ``frequency`` [Hz]
        at which the modulus holds (that of the drive: a polymer is softer at 1 Hz). For every model:

        - ``peak_force`` [N]: the force at the deepest point, where a lossless contact pushes most (negative where
          even there adhesion wins); the largest on the way in for a model with a loss that follows speed. NaN
          without contact.
        - ``contact_time``: ``arccos(1 - 2 Delta)/pi``, ``Delta = delta_max/(2 A1)``; 0 for a tip that never touches,
          1 for one that never leaves.
        - ``relative_indentation``: ``delta_max/R``, where the probe has a radius. A tip is a paraboloid only well
          below 1.

        For a paraboloid with a modulus also ``contact_radius`` [m], ``mean_pressure`` [Pa], of the elastic load over
        ``pi a^2`` (under a sphere, flow begins at about 1.1 times the yield stress: Johnson, Contact Mechanics, 1985,
        section 6.1), and with adhesion ``tabor``,
        ``modulus_jkr`` [Pa], ``adhesion_jkr`` [N] and ``model_difference = ln(modulus_jkr/modulus)``.

    Raises
    ------
    InversionError
        If the model is none of one gap and velocity, or a property is missing.
    ContactModelError, ProbeError
        If the model is unknown, or a parameter or the tip radius is missing or out of range.

    Notes
    -----
    The JKR values answer one question: what would the modulus be if the same three conservative harmonics at the
    same A1 came from a JKR contact? They are solved for exactly (`overtone.inversion.jkr`), wherever the Tabor
    parameter is above 0.1 and such a contact exists: from 0.1 to 5 both models are candidates and their difference is
    an error of the model, above 5 JKR is the better one. They are NaN at a Tabor parameter below 0.1; where no JKR
    contact has these harmonics, which happens only in mostly attractive contacts (CONS_1 > 0) less than three times as
    deep as the neck is long, ``(pi w sqrt(R)/K)^(2/3)`` with ``K = 4/3 E*``; where the tip hardly leaves the sample
    (nine tenths of the way down in contact); and where JKR asks for a sample stiffer than the tip lets through.

    DMT spends adhesion on a tail outside contact, JKR on a neck, so the difference falls with depth. Beyond 3 nm and
    ten lengths of the neck it is at most 0.05 to 0.15 from harmonics (0, 1, 2) and 0.02 to 0.06 from (1, 2, 3), which
    see less of the tail (A1 10 to 80 nm, R 5 to 30 nm, a0 0.2 nm). The paper's PS has -0.15 (-0.07), its LDPE, at a
    Tabor parameter of 20, +0.24 (+0.23). Hard samples dented by 1 nm or less differ by factors, with the search as
    exact as anywhere: three harmonics of a short contact hardly tell adhesion from modulus, and a slightly different
    law moves both. Such a difference says that the modulus hangs on the adhesion model. The loss that JKR's hysteresis
    implies is not held against the data.

    Examples
    --------
    PS of the method's paper:

    >>> probe = Probe.simple(stiffness=16.4, frequency=161.8e3, quality_factor=287, drive_frequency=161.8e3,
    ...                      free_amplitude=94e-9, radius=10e-9)
    >>> ps = xr.Dataset({"modulus": 1.93e9, "adhesion": 1.91e-9, "indentation": 2.42e-9})
    >>> contact = contact_validity(ps, xr.DataArray(39.1e-9), probe, model="dmt", poisson_ratio=0.3)
    >>> [round(float(contact[name]), 3) for name in ("tabor", "relative_indentation", "contact_time")]
    [0.642, 0.242, 0.113]
    >>> round(float(contact["mean_pressure"]) / 1e9, 2)
    0.44
    """
    record = contact_model(model)
    if any(term.row is None for term in record.terms):
        raise InversionError(
            f"model {model!r} has no force of gap and velocity", hint="a model whose force has no memory"
        )
    names = [parameter.name for parameter in record.unknowns]
    arrays = {name: _estimate(properties, name) for name in ("indentation", *names)}
    reference = arrays["indentation"]
    dims, shape = reference.dims, reference.shape
    flat = {
        name: array.broadcast_like(reference).transpose(*dims).values.astype(float).ravel()
        for name, array in (arrays | {"A1": amplitude}).items()
    }
    usable = np.isfinite(flat["indentation"]) & np.isfinite(flat["A1"]) & (flat["A1"] > 0.0)
    for parameter in record.unknowns:
        usable &= _in_range(parameter, flat[parameter.name])
    # a lone pixel goes as scalars: numpy marks what it broadcasts to one element, and compiled code warns of the mark
    one = usable.sum() == 1
    values = {name: np.asarray(array[usable][0]) if one else array[usable] for name, array in flat.items()}
    fixed = _fixed(record, probe, given)
    found = {
        name: _spread(array, usable, shape)
        for name, array in _of_contact(record, values, fixed, probe, harmonics).items()
    }
    variables = {name: named_variable(name, array, dims) for name, array in found.items()}
    result = xr.Dataset(variables, coords=reference.coords)
    result.attrs = dict(properties.attrs) | {"model": model, "frequency": probe.drive.frequency}
    return provenance.record(
        result,
        "contact_validity",
        model=model,
        harmonics=tuple(harmonics),
        **{k: float(v) for k, v in given.items()},
    )


def with_validity(
    properties: xr.Dataset,
    amplitude: xr.DataArray,
    probe: Probe,
    *,
    model: str,
    harmonics: Sequence[int],
    **given: float | None,
) -> xr.Dataset:
    """Return a result of `overtone.map_properties` with what `contact_validity` says beside it.

    Parameters
    ----------
    properties, amplitude, probe, **given
        As there; what is None is left out.
    model : str
        The one that was asked for, ``auto`` included: what a pixel's own model lacks is none there.
    harmonics : sequence of int
        Those that were used; the JKR values take three of them.

    Raises
    ------
    InversionError, ContactModelError, ProbeError
        As `contact_validity`.
    """
    whole = properties
    if model == AUTO:
        model = COMPARED[-1]
        fill = {
            name: properties[name].fillna(0.0) for name in ("adhesion_unscreened", "viscosity_unscreened")
        }
        whole = properties.assign(fill)
    orders = tuple(n for n in harmonics if n <= _HIGHEST)[:3]
    known = {name: value for name, value in given.items() if value is not None}
    found = contact_validity(
        whole, amplitude, probe, model=model, harmonics=orders if len(orders) == 3 else (), **known
    )
    frequency = {"frequency": found.attrs["frequency"]}
    return properties.assign(found.data_vars).assign_attrs(frequency)


def _estimate(properties: xr.Dataset, name: str) -> xr.DataArray:
    """Return the estimate of a property at every pixel."""
    for candidate in (f"{name}_unscreened", name):
        if candidate in properties:
            return properties[candidate]
    raise InversionError(
        f"the properties lack {name}",
        expected="the unknowns of the contact model and the indentation",
        got=", ".join(map(str, properties.data_vars)) or "an empty dataset",
        hint="the model that the properties were mapped with",
    )


def _in_range(parameter: Parameter, array: _Floats) -> npt.NDArray[np.bool_]:
    """Return which values make sense."""
    low = array >= parameter.minimum if parameter.zero_allowed else array > parameter.minimum
    return np.asarray(np.isfinite(array) & low & (array <= parameter.maximum))


def _fixed(record: ContactModel, probe: Probe, given: dict[str, float]) -> dict[str, Any]:
    """Return the parameters of the model that do not vary from pixel to pixel, those of the probe among them."""
    known = {parameter.name for parameter in record.given}
    own = {
        "radius": probe.tip.radius,
        "tip_modulus": probe.tip.modulus,
        "tip_poisson_ratio": probe.tip.poisson_ratio,
        "frequency": probe.drive.frequency,
    }
    if "radius" in known:
        own["radius"] = required_radius(probe)
    # a caller has one set of arguments for all models: what this one does not know is not its own
    spare = {"poisson_ratio", "intermolecular_distance"} - known
    return {k: v for k, v in own.items() if k in known} | {k: v for k, v in given.items() if k not in spare}


def _spread(array: _Floats, usable: npt.NDArray[np.bool_], shape: tuple[int, ...]) -> _Floats:
    """Return an array of the usable pixels as a map, NaN elsewhere."""
    whole = np.full(usable.size, math.nan)
    whole[usable] = array
    return whole.reshape(shape)


def _of_contact(
    record: ContactModel,
    values: dict[str, _Floats],
    fixed: dict[str, Any],
    probe: Probe,
    orders: Sequence[int],
) -> dict[str, _Floats]:
    """Return the quantities that apply to this model, for pixels without NaN."""
    A, delta = values["A1"], values["indentation"]
    law_values = {parameter.name: values[parameter.name] for parameter in record.unknowns}
    Delta = 0.5 * delta / A
    touching = delta >= 0.0
    half_angle = np.arccos(1.0 - 2.0 * np.clip(Delta, 0.0, 1.0))
    found = {"contact_time": half_angle / math.pi}
    peak = force(record.key, -delta, **_without(fixed, "frequency"), **law_values)
    if "frequency" in fixed:
        omega = 2.0 * math.pi * fixed["frequency"]
        for psi in np.linspace(0.0, 1.0, _INSTANTS, endpoint=False)[1:, None] * half_angle:
            gap, velocity = A * (1.0 - 2.0 * Delta - np.cos(psi)), -A * omega * np.sin(psi)
            way_in = force(record.key, gap, velocity, **_without(fixed, "frequency"), **law_values)
            peak = np.maximum(peak, way_in)
    found["peak_force"] = np.where(touching, peak, math.nan)
    R = probe.tip.radius
    if R is not None:
        found["relative_indentation"] = np.where(touching, delta / R, math.nan)
    if R is None or "modulus" not in values or not _is_paraboloid(record):
        return found
    of_both = ("poisson_ratio", "tip_modulus", "tip_poisson_ratio")
    tip: dict[str, Any] = {name: fixed[name] for name in of_both}
    E_star = effective_modulus(values["modulus"], **tip)
    depth = np.where(touching, delta, math.nan)
    found["contact_radius"] = np.sqrt(R * depth)
    # 4/3 E* sqrt(R) delta^1.5 over pi R delta
    found["mean_pressure"] = 4.0 / (3.0 * math.pi) * E_star * np.sqrt(depth / R)
    if "adhesion" not in values or record.tail == NO_ADHESION:
        return found
    distance = {k: v for k, v in fixed.items() if k == "intermolecular_distance"}
    tabor = tabor_parameter(
        radius=R, modulus=values["modulus"], adhesion=values["adhesion"], **tip, **distance
    )
    cons = force_harmonics(record.key, amplitude=A, indentation=delta, n_max=3, **fixed, **law_values).real
    if len(orders) != 3:
        return found | {"tabor": tabor}
    return found | {"tabor": tabor} | _of_jkr(cons, values, tabor, E_star, R, tip, orders)


def _of_jkr(
    cons: _Floats,
    values: dict[str, _Floats],
    tabor: _Floats,
    E_star: _Floats,
    R: float,
    tip: dict[str, Any],
    orders: Sequence[int],
) -> dict[str, _Floats]:
    """Return modulus and adhesion of the JKR contact with the same harmonics, where JKR may apply."""
    applies = (tabor > DMT_LIMIT) & (values["indentation"] >= 0.0)
    jkr = jkr_of_harmonics(
        np.where(applies[..., None], cons, math.nan).reshape(-1, cons.shape[-1]),
        values["A1"],
        orders=orders,
        radius=R,
        indentation=values["indentation"],
        effective_modulus=E_star,
        adhesion=values["adhesion"],
    )
    of_the_tip = (1.0 - tip["tip_poisson_ratio"] ** 2) / tip["tip_modulus"]
    compliance = 1.0 / jkr.effective_modulus - of_the_tip
    with np.errstate(divide="ignore"):
        modulus = np.where(compliance > 0.0, (1.0 - tip["poisson_ratio"] ** 2) / compliance, math.nan)
    exists = (modulus >= MODULUS.lower) & (modulus <= MODULUS.upper)
    modulus = np.where(exists, modulus, math.nan)
    return {
        "modulus_jkr": modulus,
        "adhesion_jkr": np.where(exists, jkr.adhesion, math.nan),
        "model_difference": np.log(modulus / values["modulus"]),
    }


def _without(values: dict[str, Any], name: str) -> dict[str, Any]:
    return {key: value for key, value in values.items() if key != name}


def _is_paraboloid(record: ContactModel) -> bool:
    """Return whether the elastic part of the law is that of Hertz, one power 3/2."""
    examples = {q.name: np.asarray(q.example, dtype=float) for q in record.parameters}
    rows = np.asarray(record.table(examples))
    elastic = rows[rows[:, 0] == law.POWER]
    return len(elastic) == 1 and bool(elastic[0, 2] == 1.5) and "radius" in {q.name for q in record.given}
