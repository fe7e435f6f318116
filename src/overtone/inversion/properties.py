"""Observables to maps of material properties, with what each pixel can be trusted for."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from functools import partial

import numpy as np
import xarray as xr

from overtone import provenance
from overtone.blocks import side_by_side
from overtone.contact.models import BUILT_IN, ContactModel, contact_model
from overtone.contact.parameters import DISTANCE, POISSON_RATIO
from overtone.errors import InversionError
from overtone.harmonics import UNDETERMINED, energy, regime, to_force_harmonics
from overtone.instrument.material import Reference
from overtone.instrument.noise import complete_noise
from overtone.inversion.columns import columns_of, is_linear, unknowns_of
from overtone.inversion.marginal import Candidate, map_posteriors
from overtone.inversion.pixels import Setting, radius_exponent
from overtone.inversion.priors import Prior, complete_priors, format_priors, of_single_pixels, shared_priors
from overtone.inversion.published import HARMONIC_SETS, POOR_RESIDUAL, map_least_squares
from overtone.inversion.result import (
    AT_BOUND,
    DETERMINED,
    MISSING_DATA,
    NO_CONTACT,
    NO_SOLUTION,
    NOT_CONVERGED,
    NOT_DETERMINED,
    POOR_FIT,
    SEVERAL_SOLUTIONS,
    START_DEPENDENT,
    STATUS_FLAGS,
    STATUS_MEANINGS,
    WIDEST_DETERMINED,
    Sheet,
)
from overtone.inversion.separable import map_solutions
from overtone.probe import Probe, format_probe
from overtone.quantities import harmonic_orders, named_array, validate_observables
from overtone.readings import reading_of

__all__ = [
    "AT_BOUND",
    "AUTO",
    "COMPARED",
    "DETERMINED",
    "HARMONIC_SETS",
    "METHODS",
    "MISSING_DATA",
    "MOTIONS",
    "NOT_CONVERGED",
    "NOT_DETERMINED",
    "NO_CONTACT",
    "NO_SOLUTION",
    "POOR_FIT",
    "POOR_RESIDUAL",
    "SEVERAL_SOLUTIONS",
    "START_DEPENDENT",
    "STATUS_FLAGS",
    "STATUS_MEANINGS",
    "WIDEST_DETERMINED",
    "harmonics_for",
    "map_energy",
    "map_properties",
    "records_of",
    "undetermined_properties",
]

POPULATION = "population"
METHODS = {
    "posterior": "medians and 90 % intervals of the posterior of each pixel",
    POPULATION: "posteriors of pixels that share the material of their phase and the errors of the scan",
    "exact": "every solution of each pixel, without intervals",
    "least-squares": "the published estimator, for reproduction",
}
AUTO = "auto"
COMPARED = ("hertz", "dmt", "hertz-viscous", "dmt-viscous")
"""Models that ``model="auto"`` compares."""
MOTIONS = ("full", "cosine")
_HIGHEST = 3  # harmonics beyond are rarely above their noise


def map_properties(
    observables: xr.Dataset,
    probe: Probe,
    *,
    model: str,
    poisson_ratio: float | None = None,
    method: str = "posterior",
    harmonics: Sequence[int] | None = None,
    noise: Mapping[str, float] | None = None,
    priors: Mapping[str, Prior] | None = None,
    motion: str = "full",
    intermolecular_distance: float = 0.2e-9,
    given: Mapping[str, float] | None = None,
    phases: int | xr.DataArray | None = None,
    reference: Reference | None = None,
    reference_pixels: xr.DataArray | Sequence[float] | None = None,
    seed: int = 0,
    dtype: str = "float64",
    progress: Callable[[int, int], None] | None = None,
) -> xr.Dataset:
    """Map modulus, adhesion, indentation and loss, and how far the data determine them.

    Parameters
    ----------
    observables : Dataset
        Observables of the harmonics asked for, any dimensions. Where their reading (see
        `overtone.readings`) doubts one of these harmonics, every pixel is "not determined".
    probe : Probe
        With a tip radius, for the models that need one.
    model : str
        Key of a contact model that is linear in its parameters at a given indentation, or ``auto``: the one of
        `COMPARED` that the data of each pixel prefer (posterior only).
    poisson_ratio : float
        Poisson's ratio of the sample; it has no default.
    method : str
        ``posterior``, ``population``, ``exact`` or ``least-squares`` (the published estimator, for reproduction).
    harmonics : sequence of int, optional
        Conservative harmonics used. Unless given those of 0 to 3 that were measured; for ``least-squares`` (0, 1, 2) or
        (1, 2, 3). A model with loss uses the dissipative ones above 0 as well.
    noise : mapping, optional
        Standard deviation of each observable [m, rad], ``{"A0": 5e-12, "phi1": 2e-3, "A2": 1e-12}``;
        `overtone.instrument.noise.ORDINARY_NOISE` where not stated.
    priors : mapping of str to Prior, optional
        What is known before (posterior and population): of modulus (or stiffness, prefactor), adhesion, loss_tangent,
        indentation. Materials of a population may have an adhesion whose logarithm is even or normal as well. See
        `overtone.inversion.priors.DEFAULTS` for those not stated.
    motion : str
        ``full``: the harmonics of the tip's motion count, those that were measured as measured. ``cosine``: they do
        not, as in the published formulas; moduli come out 1 to 6 % high. ``least-squares`` knows no other.
    intermolecular_distance : float
        a0 [m].
    given : mapping of str to float, optional
        What else the model has to know: half_angle, thickness, exponent.
    phases : None, int or DataArray (y, x), optional
        Population only: phases found by the scan, their number, or labels (-1 for pixels of none).
    reference : Reference, optional
        Population only: a material in the scan whose modulus is known. A scan that `overtone.correct` has anchored to
        one needs none.
    reference_pixels : DataArray (y, x) or sequence, optional
        Where it lies: a mask, or a rectangle (x0, y0, x1, y1) [m].
    seed : int
        Of the draws of the population.
    dtype : str
        ``float64``, or ``float32`` for maps of half the size.
    progress : callable, optional
        Called with (pixels done, pixels in all).

    Returns
    -------
    Dataset
        On the dimensions of A1: the model's unknowns and ``indentation`` [SI], each NaN unless it is determined, and
        ``<name>_unscreened`` at every pixel; ``status``, which speaks of the modulus; ``uncertainty``, the standard
        deviation of ln E.

        ``posterior`` adds ``<name>_lower`` and ``<name>_upper`` (90 % interval; the value is the median),
        ``loss_tangent``, ``misfit`` (chi-squared), ``log_evidence``, ``contact_probability``; after
        `overtone.correct` ``uncertainty_statistical`` and ``uncertainty_systematic``; with ``auto`` ``model`` and
        ``model_probability``. ``population`` has these pooled, with what each pixel says by itself as
        ``<name>_unpooled``, ``_unpooled_lower`` and ``_unpooled_upper``; ``phase`` (-1 for none), ``phase_probability``
        and ``shrinkage``; over ``material`` the table of phases (``material_<name>`` with its interval, spread within
        the phase, statistical and systematic error, ratio to the reference, misfit) and, over ``row`` as well, each
        harmonic with the interval that the others predict (``check_observed``, ``check_lower``, ``check_upper``);
        ``verdict`` and ``verdict_reason`` as attributes. The two parts of the uncertainty are those of pooled pixels.
        ``exact`` adds ``solutions`` (their number), ``<name>_solutions`` and ``misfit``.
        ``least-squares`` adds ``residual`` (N_r), ``amplification`` (norm of d ln E per independent relative error of
        each harmonic), ``start_spread`` (range of ln E over the starting points), ``modulus_lower`` and
        ``modulus_upper`` (every modulus that some indentation and adhesion reconcile with the data at 90 %).

    Raises
    ------
    InversionError, ContactModelError, ObservablesError, OvertoneError
        If method, model or prior are unknown or do not fit, a harmonic or the tip radius is missing, or a ratio is out
        of range.

    Notes
    -----
    Intermittent contact only: Delta = delta_max/(2 A1) from 1e-5 to 0.999. Errors that the whole scan shares (1 pm of
    A0, 1 degree of phase) count in intervals, uncertainty and status where the scan was corrected with a calibration
    (`overtone.correct`); they do not average out over pixels. Without one intervals hold noise only. What no interval
    holds is that the contact may follow another law: see `overtone.contact_validity`.
    """
    if method not in METHODS:
        raise InversionError("unknown method", expected=", ".join(METHODS), got=repr(method))
    if motion not in MOTIONS:
        raise InversionError("unknown motion", expected=" or ".join(MOTIONS), got=repr(motion))
    if dtype not in ("float64", "float32"):
        raise InversionError("maps of this kind are not made", expected="float64 or float32", got=repr(dtype))
    records = records_of(model, method)
    known = _known(records, poisson_ratio, intermolecular_distance, given)
    columns = tuple(columns_of(record, probe, known) for record in records)
    cons, diss = _rows(observables, records, method, harmonics)
    orders = tuple(sorted({*cons, *diss, 1}))
    validate_observables(observables)
    sigma = complete_noise(noise, orders)
    scans = [observables]
    if method == POPULATION:
        from overtone.population.population import split_scans

        if unknowns_of(records[0])[0].name != "modulus":
            raise InversionError(
                f"model {model!r} has no modulus that pixels could share",
                expected=", ".join(
                    m.key for m in BUILT_IN if is_linear(m) and unknowns_of(m)[0].name == "modulus"
                ),
                hint='method="posterior"',
            )
        scans = split_scans(observables)
    settings = [Setting.of(scan, probe, cons, diss, sigma) for scan in scans]
    setting = settings[0]
    sheet = Sheet(scans[0]["A1"], dtype)
    stated: dict[str, object] = {}
    materials, of_all = None, {}
    if method == "least-squares":
        map_least_squares(setting, records[0], columns[0], sheet, progress=progress)
    elif method == "exact":
        error = _radius_error(setting, radius_exponent(records[0], probe, known))
        map_solutions(
            setting,
            records[0],
            columns[0],
            probe,
            sheet,
            full_motion=motion == "full",
            radius_error=error,
            progress=progress,
        )
    else:
        alone = of_single_pixels(priors) if method == POPULATION else priors
        candidates = tuple(
            Candidate.of(r, c, setting, complete_priors(alone, r, probe.tip.radius), probe, known)
            for r, c in zip(records, columns, strict=True)
        )
        single = partial(map_posteriors, setting, candidates, probe, sheet, full_motion=motion == "full")
        if method != POPULATION:
            single(progress=progress)
        else:
            from overtone.population.population import Request, find_materials, pool_scan

            of_all = shared_priors(priors, candidates[0].priors, probe.tip.radius)
            request = Request(phases, reference, reference_pixels, seed)
            share = partial(
                find_materials,
                settings,
                scans,
                columns[0],
                of_all,
                probe,
                candidates[0].exponent,
                request,
                full_motion=motion == "full",
            )

            def sum_pixels(raise_early: Callable[[], None]) -> None:
                def told(done: int, count: int) -> None:
                    raise_early()
                    if progress is not None:
                        progress(done, count)

                single(progress=told, parts=False)

            # neither needs the other, and together they leave no core idle
            found = side_by_side(share, sum_pixels)
            pool_scan(found, sheet, progress)
            materials = found.table
        together = {name: prior for c in candidates for name, prior in c.priors.items()}
        stated = {"priors": format_priors(together)}
    reading = reading_of(observables)
    doubts = [reading.doubts[n] for n in cons if n in reading.doubts] if reading else []
    sheet.attributes["status"] = dict(STATUS_FLAGS)
    if doubts:
        status = sheet.values["status"]
        status[status != MISSING_DATA] = NOT_DETERMINED
        for name in [q.name for r in records for q in unknowns_of(r)] + ["indentation", "loss_tangent"]:
            if name in sheet.values:
                sheet.values[name][:] = math.nan
    attributes: dict[str, object] = dict(observables.attrs)
    attributes |= {"model": model, "method": method, "method_note": METHODS[method], **stated}
    if doubts:
        reasons = dict.fromkeys(line for doubt in doubts for line in doubt.splitlines())
        attributes["cannot_conclude"] = " ".join(f"{reason}." for reason in reasons)
    result = sheet.dataset(attributes)
    if materials is not None:
        result = result.assign(materials.arrays).assign_attrs(materials.attributes)
        if doubts:
            result = result.assign_attrs(
                verdict="contrast", verdict_reason=str(attributes["cannot_conclude"])
            )
        stated |= {"shared_priors": format_priors(of_all)}
        stated |= {"phases": "given" if isinstance(phases, xr.DataArray) else phases, "seed": seed}
    return provenance.record(
        result,
        "map_properties",
        probe=format_probe(probe),
        model=model,
        method=method,
        harmonics=cons,
        dissipative_harmonics=diss,
        motion=motion if method != "least-squares" else "cosine",
        noise=sigma,
        noise_stated=sorted(noise or {}),
        **known,
        **stated,
    )


def records_of(model: str, method: str) -> tuple[ContactModel, ...]:
    """Return the models that a key stands for.

    Raises
    ------
    InversionError, ContactModelError
        If there is no such model, or the method cannot invert it.
    """
    if model == AUTO:
        if method != "posterior":
            raise InversionError(
                "models are compared by their posteriors", expected='method="posterior"', got=repr(method)
            )
        return tuple(contact_model(key) for key in COMPARED)
    record = contact_model(model)
    fits = is_linear(record)
    if method == "least-squares":
        fits = fits and record.tail is not None and record.invertible
    if not fits:
        can = (
            m.key
            for m in BUILT_IN
            if is_linear(m) and (method != "least-squares" or (m.tail is not None and m.invertible))
        )
        raise InversionError(
            f"model {model!r} cannot be inverted",
            expected=", ".join(can),
            hint="the one of these nearest to it",
        )
    return (record,)


def harmonics_for(observables: xr.Dataset, model: str, method: str) -> tuple[int, ...]:
    """Return the harmonics that a method uses of those that were measured.

    Raises
    ------
    InversionError, ContactModelError
        If they are too few, or there is no such model.
    """
    return _rows(observables, records_of(model, method), method, None)[0]


def _known(
    records: tuple[ContactModel, ...],
    poisson_ratio: float | None,
    distance: float,
    given: Mapping[str, float] | None,
) -> dict[str, float]:
    """Return the parameters that the models have to know and are not the probe's."""
    names = {q.name for record in records for q in record.given}
    unknown = sorted(set(given or {}) - names)
    if unknown:
        raise InversionError(f"the model takes no {unknown[0]}", expected=", ".join(sorted(names)))
    known = dict(given or {})
    if "poisson_ratio" in names:
        if poisson_ratio is None:
            raise InversionError(
                "Poisson's ratio of the sample is not known",
                expected="a number; it has no default",
                hint="poisson_ratio=0.35",
            )
        known["poisson_ratio"] = float(POISSON_RATIO.check(poisson_ratio))
    known["intermolecular_distance"] = float(DISTANCE.check(distance))
    return known


def _rows(
    observables: xr.Dataset,
    records: tuple[ContactModel, ...],
    method: str,
    harmonics: Sequence[int] | None,
) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Return the conservative and the dissipative harmonics that are used."""
    measured = harmonic_orders(observables)
    if harmonics is None:
        cons = (0, 1, 2) if method == "least-squares" else tuple(n for n in measured if n <= _HIGHEST)
    else:
        cons = tuple(sorted(harmonics))
    if method == "least-squares" and cons not in HARMONIC_SETS:
        raise InversionError(
            "harmonics do not fit the method", expected="(0, 1, 2) or (1, 2, 3)", got=str(cons)
        )
    missing = [n for n in cons if n not in measured]
    if missing:
        raise InversionError(
            f"harmonic {missing[0]} was not measured",
            expected=f"harmonics {cons}",
            got=f"harmonics {measured}",
            hint="another set of harmonics, or energy and virial, which need A1 and phi1 only",
        )
    lossy = any({"viscosity", "damping"} & {q.name for q in record.unknowns} for record in records)
    diss = tuple(n for n in cons if 1 <= n <= 2) if lossy else ()
    if len(set(cons)) < len(cons):
        raise InversionError("a harmonic is asked for twice", got=str(tuple(harmonics or ())))
    most = max(len(unknowns_of(record)) for record in records) + 1
    if len(cons) + len(diss) < most:
        raise InversionError(
            "too few harmonics for the unknowns of the model",
            expected=f"{most} force harmonics or more, for {most - 1} properties and the indentation",
            got=f"{len(cons)} conservative and {len(diss)} dissipative ones, of harmonics {cons}",
            hint="more harmonics, or a model with fewer unknowns",
        )
    return cons, diss


def _radius_error(setting: Setting, exponent: float) -> float:
    """Return the standard deviation of ln of the elastic unknown from the radius of the tip."""
    if setting.shared is None or "radius" not in setting.shared.calibration.names:
        return 0.0
    calibration = setting.shared.calibration
    return abs(exponent) * calibration.error("radius") / calibration.values["radius"]


def undetermined_properties(observables: xr.Dataset, model: str, reason: str) -> xr.Dataset:
    """Return property maps that are NaN and "not determined" at every pixel, with the reason.

    Parameters
    ----------
    observables : Dataset
        Gives dimensions and coordinates.
    model : str
        Key of the contact model that was asked for.
    reason : str
        Why nothing can be concluded.
    """
    amplitude = observables["A1"]
    unknowns = [*(parameter.name for parameter in contact_model(model).unknowns), "indentation"]
    empty = np.full(amplitude.shape, math.nan)
    arrays = {name: named_array(name, empty, amplitude.dims, amplitude.coords) for name in unknowns}
    status = np.full(amplitude.shape, NOT_DETERMINED, np.int8)
    arrays["status"] = named_array("status", status, amplitude.dims, amplitude.coords, **STATUS_FLAGS)
    attributes = dict(observables.attrs) | {"model": model, "cannot_conclude": reason}
    return provenance.record(xr.Dataset(arrays, attrs=attributes), "undetermined_properties", reason=reason)


def map_energy(
    observables: xr.Dataset, probe: Probe, *, noise: Mapping[str, float] | None = None
) -> xr.Dataset:
    """Map force harmonics, dissipated energy, virial and regime: what is known without A0 and A2.

    Parameters
    ----------
    observables : Dataset
        At least A1 and phi1. Where their reading (see `overtone.readings`) leaves other probes open, a
        regime they do not share is undetermined; where it says the phase has no established zero, all are.
    probe : Probe
        No tip radius needed.
    noise : mapping, optional
        As for `map_properties`; the one of phi1 decides which sign of CONS_1 can be told.

    Returns
    -------
    Dataset
        ``F_cons``, ``F_diss``, ``dissipation``, ``virial``, ``regime``.
    """
    force = to_force_harmonics(observables, probe)
    reading = reading_of(observables)
    alternatives = reading.alternatives if reading else ()
    signs = regime(observables, probe, alternatives, noise=complete_noise(noise, (1,))["phi1"])
    if reading and not reading.phase_established:
        signs = signs.copy(data=np.full(signs.shape, UNDETERMINED, np.int8))
    return force.drop_vars(["A1", "phi1"]).merge(energy(force, probe)).assign(regime=signs)
