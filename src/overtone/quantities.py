"""Every named array once: symbol, SI unit and meaning; datasets are checked against it.

Dimensions are named, arrays carry SI units in ``attrs["units"]`` and angles are radians in the lag
convention ``q = A0 + sum A_n cos(n w t - phi_n)``. What was not measured is absent, never zero.
"""

from __future__ import annotations

import re
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr

from overtone.errors import ObservablesError


@dataclass(frozen=True)
class Quantity:
    """A named array: what it is called in a dataset, in a formula, and what it means."""

    name: str
    symbol: str
    unit: str
    meaning: str
    kind: str
    """``observable``, ``motion``, ``force``, ``energy``, ``property`` or ``quality``."""


_QUANTITIES = (
    Quantity("height", "h", "m", "topography as the feedback recorded it", "observable"),
    Quantity("A0", "A_0", "m", "mean deflection, zero far from the sample", "observable"),
    Quantity("Z", "Z", "m", "height of the base: the gap of a lever at rest without force", "motion"),
    Quantity("contact_time", "t_c", "1", "share of a period in contact", "motion"),
    Quantity("peak_force", "F_max", "N", "strongest repulsion in a cycle", "motion"),
    Quantity("pull_force", "F_min", "N", "strongest attraction in a cycle, negative", "motion"),
    Quantity(
        "jump", "", "1", "whether the motion jumped to another branch since the height before", "motion"
    ),
    Quantity("stable", "", "1", "whether the motion persists when it is disturbed", "motion"),
    Quantity("F_cons", "F_cons", "N", "conservative force harmonic (cosine coefficient)", "force"),
    Quantity("F_diss", "F_diss", "N", "dissipative force harmonic (sine coefficient)", "force"),
    Quantity("gap", "D", "m", "closest gap in a cycle, negative in contact", "force"),
    Quantity("force", "F", "N", "force between tip and sample, from A1 and phi1", "force"),
    Quantity("force_mean", "F", "N", "force between tip and sample, from A0", "force"),
    Quantity("damping", "Gamma", "N s/m", "damping coefficient of a force -Gamma d'", "property"),
    Quantity("truncation", "", "N", "about what a force that decays beyond the far end would add", "quality"),
    Quantity(
        "closure", "", "1", "share of CONS_1 that the force on its motion leaves unexplained", "quality"
    ),
    Quantity("A0_gain", "", "1", "mean deflection read over the one that the force implies", "quality"),
    Quantity("A0_offset", "", "m", "mean deflection read where the force implies none", "quality"),
    Quantity("dissipation", "E_dis", "J", "energy lost in the contact per cycle", "energy"),
    Quantity("virial", "V_ts", "J", "virial of the tip-sample force, A1 CONS_1 / 2", "energy"),
    Quantity("regime", "", "1", "sign of the first conservative harmonic", "energy"),
    Quantity("modulus", "E_s", "Pa", "elastic modulus of the sample", "property"),
    Quantity("adhesion", "F_ad", "N", "force of adhesion", "property"),
    Quantity("indentation", "delta_max", "m", "maximum indentation in a cycle", "property"),
    Quantity("viscosity", "eta", "Pa s", "viscosity of the contact", "property"),
    Quantity("loss_tangent", "", "1", "loss tangent of the contact, w eta/(2 E*)", "property"),
    Quantity("stiffness", "k_s", "N/m", "stiffness of the sample", "property"),
    Quantity("prefactor", "C", "N/m^p", "force at unit indentation", "property"),
    Quantity("residual", "N_r", "1", "relative residual norm of the force harmonics", "quality"),
    Quantity("misfit", "chi2", "1", "smallest chi-squared of the model, against the stated noise", "quality"),
    Quantity("solutions", "", "1", "number of physical solutions of the force harmonics", "quality"),
    Quantity(
        "log_evidence",
        "ln Z",
        "1",
        "logarithm of the probability of the data under model and priors",
        "quality",
    ),
    Quantity("contact_probability", "", "1", "probability that the tip touches the sample", "quality"),
    Quantity(
        "model_probability", "", "1", "probability of the model chosen, among those compared", "quality"
    ),
    Quantity("model", "", "1", "contact model chosen, among those compared", "quality"),
    Quantity("amplification", "", "1", "error of ln E per relative error of a force harmonic", "quality"),
    Quantity(
        "uncertainty",
        "sigma_lnE",
        "1",
        "standard deviation of ln E, noise and errors that the whole scan shares together",
        "quality",
    ),
    Quantity("uncertainty_statistical", "", "1", "the part of it that comes from noise", "quality"),
    Quantity(
        "uncertainty_systematic",
        "",
        "1",
        "the part of it that the whole scan shares, from the calibration",
        "quality",
    ),
    Quantity("start_spread", "", "1", "range of ln E over the starting points", "quality"),
    Quantity("contact_radius", "a", "m", "radius of the contact at the deepest point", "quality"),
    Quantity(
        "mean_pressure",
        "p_m",
        "Pa",
        "elastic load over the area of the contact, at the deepest point",
        "quality",
    ),
    Quantity(
        "relative_indentation", "delta_max/R", "1", "maximum indentation over the tip radius", "quality"
    ),
    Quantity("tabor", "", "1", "Tabor parameter: below 0.1 DMT applies, above 5 JKR", "quality"),
    Quantity(
        "modulus_jkr",
        "E_JKR",
        "Pa",
        "elastic modulus if the contact is JKR, from the same harmonics",
        "quality",
    ),
    Quantity(
        "adhesion_jkr",
        "F_ad,JKR",
        "N",
        "force of adhesion if the contact is JKR, from the same harmonics",
        "quality",
    ),
    Quantity("model_difference", "", "1", "ln of the JKR modulus over the DMT modulus", "quality"),
    Quantity("reference", "", "1", "whether a pixel was taken as the reference material", "quality"),
    Quantity(
        "shrinkage",
        "",
        "1",
        "how far the phase of a pixel decides its ln E: 0 its own data, 1 its phase",
        "quality",
    ),
    Quantity("phase", "", "1", "phase of the pixel, found in what was measured", "quality"),
    Quantity("phase_probability", "", "1", "probability that the pixel belongs to its phase", "quality"),
    Quantity("status", "", "1", "what this pixel can be trusted for", "quality"),
)
_BY_NAME = {quantity.name: quantity for quantity in _QUANTITIES}
LIFT = "lift_"
"""What begins the names of readings of a lift (Nap) pass, where they stand beside those of the scan."""
_HARMONIC = re.compile(r"(A|phi)([1-9]\d*)")
_VARIANTS = {
    "_unpooled": "of the pixel by itself, without regard to its phase",
    "_unpooled_lower": "lower end of the 90 % interval of the pixel by itself",
    "_unpooled_upper": "upper end of the 90 % interval of the pixel by itself",
    "_unscreened": "every pixel the estimator finished",
    "_solutions": "every physical solution, deepest indentation last",
    "_lower": "lower end of the 90 % interval (noise; shared errors where the scan was calibrated)",
    "_upper": "upper end of the 90 % interval (noise; shared errors where the scan was calibrated)",
}


def quantity(name: str) -> Quantity | None:
    """Return the record of a named array, or None where overtone does not know the name.

    Harmonic observables are known for every order. A property comes in variants: ``_lower`` and
    ``_upper`` bound it, and ``_unscreened`` is what the estimator returned before pixels that the data do
    not determine were set to NaN.

    Examples
    --------
    >>> quantity("phi2").unit, quantity("A7").symbol, quantity("nonsense")
    ('rad', 'A_7', None)
    """
    match = _HARMONIC.fullmatch(name)
    if match:
        order = match.group(2)
        if match.group(1) == "A":
            return Quantity(name, f"A_{order}", "m", f"amplitude of harmonic {order}", "observable")
        return Quantity(name, f"phi_{order}", "rad", f"phase lag of harmonic {order}", "observable")
    for suffix, meaning in _VARIANTS.items():
        base = _BY_NAME.get(name.removesuffix(suffix))
        if name.endswith(suffix) and base is not None and base.kind == "property":
            return Quantity(name, base.symbol, base.unit, f"{base.meaning}, {meaning}", base.kind)
    return _BY_NAME.get(name)


def known_quantities() -> tuple[Quantity, ...]:
    """Return every quantity, the first three harmonics standing for all orders."""
    harmonics = [name for n in (1, 2, 3) for name in (f"A{n}", f"phi{n}")]
    records = (quantity(name) for name in harmonics)
    return tuple(record for record in records if record is not None) + _QUANTITIES


def named_array(
    name: str,
    values: Any,
    dims: Sequence[Hashable],
    coords: Mapping[Any, Any] | None = None,
    **attributes: Any,
) -> xr.DataArray:
    """Build an array that carries its unit and meaning.

    Parameters
    ----------
    name : str
        A known quantity.
    values : array
        Values in SI units with shape ``dims``.
    dims : sequence of str
        Dimension names.
    coords : mapping, optional
        Coordinates; those of other dimensions are left out.
    **attributes
        Further attributes of the array.

    Raises
    ------
    ObservablesError
        If the name is not a known quantity.
    """
    kept = {
        key: value
        for key, value in (coords or {}).items()
        if set(getattr(value, "dims", (key,))) <= set(dims)
    }
    return xr.DataArray(named_variable(name, values, dims, **attributes), coords=kept, name=name)


def named_variable(name: str, values: Any, dims: Sequence[Hashable], **attributes: Any) -> xr.Variable:
    """Build the same without coordinates, for a dataset that has them: a tenth of the time.

    Raises
    ------
    ObservablesError
        If the name is not a known quantity.
    """
    record = quantity(name)
    if record is None:
        raise ObservablesError(f"{name!r} is not a quantity of overtone", hint="a name of the glossary")
    attrs = {"units": record.unit, "long_name": record.meaning, **attributes}
    return xr.Variable(tuple(dims), np.asarray(values), attrs)


def harmonic_orders(observables: xr.Dataset) -> tuple[int, ...]:
    """Return the orders whose amplitude and phase are both present, 0 where A0 is.

    Examples
    --------
    >>> harmonic_orders(xr.Dataset({"A1": 1.0, "phi1": 1.0, "A3": 1.0}))
    (1,)
    """
    orders = [0] if "A0" in observables else []
    amplitudes = (_HARMONIC.fullmatch(str(name)) for name in observables.data_vars)
    found = {int(match.group(2)) for match in amplitudes if match and match.group(1) == "A"}
    return tuple(orders + sorted(n for n in found if f"phi{n}" in observables))


def validate_observables(observables: xr.Dataset) -> xr.Dataset:
    """Check that a dataset keeps the contract of observables and return it unchanged.

    Parameters
    ----------
    observables : Dataset
        Variables ``A1``, ``phi1`` and any of ``A0``, ``A2``, ``phi2``, ... on any dimensions, SI units.

    Raises
    ------
    ObservablesError
        If A1 or phi1 is missing, a unit is not SI, a dimension is empty, an amplitude is negative,
        or no pixel has both A1 and phi1.
    """
    missing = [name for name in ("A1", "phi1") if name not in observables]
    if missing:
        raise ObservablesError(
            f"observables lack {' and '.join(missing)}",
            expected="A1 and phi1 at least",
            got=", ".join(map(str, observables.data_vars)) or "an empty dataset",
            hint="name the channel, for example --channel A1=Amplitude",
        )
    for name, array in observables.data_vars.items():
        record = quantity(str(name))
        if record is None or record.kind != "observable":
            continue
        if array.size == 0:
            raise ObservablesError(
                f"{name} has no pixels", expected="at least one", got=str(dict(array.sizes))
            )
        unit = array.attrs.get("units", record.unit)
        if unit != record.unit:
            raise ObservablesError(f"{name} is not in SI units", expected=record.unit, got=str(unit))
        if not np.issubdtype(array.dtype, np.floating):
            raise ObservablesError(f"{name} is not an array of floats", got=str(array.dtype))
        if record.symbol.startswith("A_") and record.name != "A0" and bool((array < 0).any()):
            raise ObservablesError(
                f"{name} is negative in {int((array < 0).sum())} of {array.size} pixels",
                expected="an amplitude, which has no sign",
                hint="the file may hold the amplitude error (amplitude minus set-point) or a flattened channel",
            )
    if not bool((np.isfinite(observables["A1"]) & np.isfinite(observables["phi1"])).any()):
        raise ObservablesError("no pixel has both A1 and phi1", got="NaN everywhere")
    return observables
