"""One map: files in, what was measured and concluded out, with all that a report of it says."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from overtone.batch.noise import resolve_noise
from overtone.batch.opened import both_ways, first_of, opened
from overtone.batch.sample import Sample, arguments_of, check_scan, no_calibration
from overtone.batch.settings import POPULATION, Settings, check_settings, noise_of
from overtone.errors import InversionError, OvertoneError

if TYPE_CHECKING:
    import xarray as xr

    from overtone.report.content import Report

Progress = Callable[[int, int], None] | None


@dataclass(frozen=True)
class Mapped:
    """A map of one file, or of several that are one stack.

    Parameters
    ----------
    files : tuple of Path
        Where it comes from.
    observables : Dataset
        The scan, corrected where there was a calibration, with every finding.
    energies : Dataset
        Of `overtone.map_energy`.
    properties : Dataset or None
        Of `overtone.map_properties`, None where none were mapped.
    label : str
        What the properties were told from.
    pooled : bool
        Whether the scans of a stack were mapped together.
    correction : mapping
        What a report says of it.
    """

    files: tuple[Path, ...]
    observables: xr.Dataset
    energies: xr.Dataset
    properties: xr.Dataset | None
    label: str
    pooled: bool = False
    correction: dict[str, Any] = field(default_factory=dict)


def map_scans(
    files: Sequence[Path], settings: Settings, *, for_paper: bool = False, progress: Progress = None
) -> Mapped:
    """Open, correct and map the scan of a file, or of several as one stack.

    Parameters
    ----------
    files : sequence of Path
        One scan, or scans of the same pixels for method population.
    settings : Settings
        What is asked for.
    for_paper : bool
        Whether a map without a modulus is of no use.
    progress : callable, optional
        Called with (pixels done, pixels in all).

    Raises
    ------
    OvertoneError
        If a file cannot be read, or the settings do not fit it.
    """
    check_settings(settings, len(files))
    observables, correction = opened(files, settings)
    told = partial(both_ways, files[0], settings)
    mapped = map_observables(observables, settings, told=told, for_paper=for_paper, progress=progress)
    return Mapped(tuple(files), *mapped, settings.method == POPULATION, correction)


def map_observables(
    observables: xr.Dataset,
    settings: Settings,
    *,
    told: Callable[[Any], tuple[Any, Any]] | None = None,
    for_paper: bool = False,
    progress: Progress = None,
) -> tuple[xr.Dataset, xr.Dataset, xr.Dataset | None, str]:
    """Map observables; return them with their findings, their energies, the properties and a label of these.

    Parameters
    ----------
    observables : Dataset
        With their reading.
    settings : Settings
        What is asked for.
    told : callable, optional
        Takes the probe and returns trace and retrace, which tell the noise.
    for_paper, progress
        As of `map_scans`.
    """
    from overtone import provenance
    from overtone.inversion.properties import map_energy
    from overtone.readings import probe_of

    probe = probe_of(observables)
    first = first_of(observables) if settings.method == POPULATION else observables
    pair = partial(told, probe) if told is not None else None
    sigma, said = resolve_noise(noise_of(settings), first, probe, pair=pair)
    observables = provenance.add_finding(observables, said)
    energies = map_energy(observables, probe, noise=sigma)
    result, label, remarks = properties_of(observables, settings, sigma, for_paper, progress)
    return provenance.add_finding(observables, *remarks), energies, result, label


def dataset_of(mapped: Mapped) -> xr.Dataset:
    """Return all that was measured and concluded as one dataset, as it is saved."""
    return merged(mapped.observables, mapped.energies, mapped.properties)


def merged(observables: xr.Dataset, energies: xr.Dataset, properties: xr.Dataset | None) -> xr.Dataset:
    """Return observables, energies and properties as one dataset."""
    whole = observables.merge(energies.drop_attrs(deep=False))
    if properties is not None:
        whole = whole.merge(properties.drop_attrs(deep=False)).assign_attrs(properties.attrs)
    return whole.assign_attrs(findings=observables.attrs.get("findings", "[]"))


def report_of(mapped: Mapped) -> Report:
    """Return what a report says of a map; of a stack, its first scan is shown."""
    from overtone import provenance
    from overtone.report.content import Report
    from overtone.report.summary import energy_table, result_tables

    observables, energies = mapped.observables, mapped.energies
    if mapped.pooled:
        observables, energies = first_of(observables), first_of(energies)
    scans = mapped.observables["A1"].size // observables["A1"].size
    tables = [energy_table(energies, _other_readings(observables))]
    if mapped.properties is not None:
        tables += result_tables(mapped.label, mapped.properties)
    further = len(mapped.files) - 1
    return Report(
        title=f"overtone: {mapped.files[0].name}" + (f" and {further} more" if further else ""),
        subtitle=" x ".join(map(str, observables["A1"].shape))
        + " pixels"
        + (f", {scans} scans, of which the first is shown" if scans > 1 else ""),
        observables=observables,
        energies=energies,
        properties={} if mapped.properties is None else {mapped.label: mapped.properties},
        tables=tuple(tables),
        findings=tuple(provenance.findings(mapped.observables)),
        **mapped.correction,
    )


def _other_readings(observables: xr.Dataset) -> list[xr.Dataset]:
    """Return the energies of the same scan as its file may be read otherwise."""
    from overtone.inversion.properties import map_energy
    from overtone.readings import reading_of

    reading = reading_of(observables)
    alternatives = reading.alternatives if reading is not None else ()
    first = observables[["A1", "phi1"]].drop_attrs(deep=False)
    return [map_energy(first.assign(phi1=first["phi1"] + shift), probe) for probe, shift in alternatives]


def properties_of(
    observables: xr.Dataset,
    settings: Settings,
    noise: dict[str, float],
    for_paper: bool = False,
    progress: Progress = None,
) -> tuple[xr.Dataset | None, str, tuple[str, ...]]:
    """Return the property maps with a label, and what to say of them, or where there are none.

    Parameters
    ----------
    observables : Dataset
        With their reading.
    settings : Settings
        What is asked for.
    noise : dict
        Standard deviation of observables [m, rad].
    for_paper, progress
        As of `map_scans`.

    Raises
    ------
    OvertoneError
        If a modulus was asked for that these observables or settings do not allow.
    """
    from overtone.inversion.properties import map_properties, undetermined_properties
    from overtone.inversion.validity import with_validity
    from overtone.io.observables import missing_for_modulus
    from overtone.readings import probe_of

    probe = probe_of(observables)
    orders = _orders(observables, settings)
    missing = [
        text
        for text, absent in (
            ('the tip radius (--radius "10 nm")', probe.tip.radius is None),
            ("Poisson's ratio of the sample (--poisson-ratio 0.35)", settings.poisson_ratio is None),
        )
        if absent
    ]
    if missing and (settings.model is not None or for_paper) and _needs_a_tip(settings):
        raise OvertoneError(
            "a modulus was asked for",
            expected=" and ".join(missing),
            got="no value",
            hint="neither has a default",
        )
    if orders is None:
        reason = f"no modulus: {missing_for_modulus(observables)}."
        if for_paper:
            raise OvertoneError("there is nothing to write a paper of", got=reason.removesuffix("."))
        if settings.model is None:
            return None, "", (reason,)
        none = undetermined_properties(first_of(observables), settings.model, reason)
        return none, "no harmonics", (reason,)
    if missing and (settings.model is None or _needs_a_tip(settings)):
        return None, "", (f"no modulus was mapped, because it needs {' and '.join(missing)}.",)
    model = settings.model or "dmt"
    sample: dict[str, Any] = {}
    remarks: tuple[str, ...] = ()
    if settings.method == POPULATION:
        check_scan(first_of(observables), orders)
        told = Sample(settings.phases, settings.reference, settings.reference_pixels, settings.seed)
        sample, remark = arguments_of(told, first_of(observables), settings.poisson_ratio)
        remarks = tuple(text for text in (no_calibration(observables), remark) if text)
    result = map_properties(
        observables,
        probe,
        model=model,
        poisson_ratio=settings.poisson_ratio,
        method=settings.method,
        harmonics=orders,
        noise=noise,
        priors=settings.priors,
        motion=settings.motion,
        given=settings.given,
        progress=progress,
        **sample,
    )
    result = with_validity(
        result,
        first_of(observables)["A1"],
        probe,
        model=model,
        poisson_ratio=settings.poisson_ratio,
        harmonics=orders,
        **settings.given,
    )
    return result, "harmonics " + ", ".join(map(str, orders)), remarks


def _needs_a_tip(settings: Settings) -> bool:
    from overtone.inversion.properties import records_of

    records = records_of(settings.model or "dmt", settings.method)
    return any(q.name == "poisson_ratio" for record in records for q in record.given)


def _orders(observables: xr.Dataset, settings: Settings) -> tuple[int, ...] | None:
    """Return the harmonics to use, None where too few were measured."""
    from overtone.inversion.properties import HARMONIC_SETS, harmonics_for
    from overtone.quantities import harmonic_orders

    measured = set(harmonic_orders(observables))
    if settings.harmonics is not None:
        missing = sorted(set(settings.harmonics) - measured)
        if missing:
            raise OvertoneError(
                f"harmonic {missing[0]} was not measured",
                expected=f"some of {', '.join(map(str, sorted(measured)))}",
                got=f"--harmonics {','.join(map(str, settings.harmonics))}",
            )
        return settings.harmonics
    if settings.method == "least-squares":
        return next((orders for orders in HARMONIC_SETS if set(orders) <= measured), None)
    try:
        return harmonics_for(observables, settings.model or "dmt", settings.method)
    except InversionError:
        return None
