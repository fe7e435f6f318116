"""``overtone map``."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Annotated, Any, NamedTuple

from cyclopts import Parameter
from rich.console import Console

from overtone.cli.noise import noise_request, resolve_noise
from overtone.cli.opened import both_ways, first_of, opened
from overtone.cli.options import ScanOptions
from overtone.cli.population import (
    POPULATION,
    PopulationOptions,
    Sample,
    arguments_of,
    check_scan,
    no_calibration,
    sample_of,
)
from overtone.cli.priors import parse_priors
from overtone.cli.progress import progress_bar
from overtone.errors import OvertoneError


def map_scan(
    file: Path,
    /,
    *further: Path,
    output: Annotated[Path, Parameter(name=["--output", "-o"])],
    report: Path | None = None,
    model: str | None = None,
    method: str = "posterior",
    harmonics: str | None = None,
    poisson_ratio: float | None = None,
    noise: Annotated[tuple[str, ...], Parameter(name="--noise")] = (),
    prior: Annotated[tuple[str, ...], Parameter(name="--prior")] = (),
    motion: str = "full",
    parameter: Annotated[tuple[str, ...], Parameter(name="--parameter")] = (),
    calibration: Path | None = None,
    reference_area: str | None = None,
    lift: Annotated[bool, Parameter(negative=())] = False,
    population: PopulationOptions = PopulationOptions(),  # noqa: B008 - a frozen record
    scan: ScanOptions = ScanOptions(),  # noqa: B008 - a frozen record
) -> None:
    """Map a scan: force, energy, virial and regime always, mechanical properties where the data allow.

    Parameters
    ----------
    file : Path
        Scan, curve or table: .ibw, a neaSNOM folder, netCDF, CSV.
    further : Path
        Further scans of the same pixels, at other set-points, that population takes together with the first.
    output : Path
        Result, a netCDF file.
    report : Path
        Report as one HTML file.
    model : str
        Contact model (see "overtone models"), or auto: the one the data of each pixel prefer. dmt unless given, where a
        modulus can be mapped.
    method : str
        posterior: medians and 90 % intervals. population: the same, sharpened by what the pixels of a phase share, with
        a table of materials. exact: every solution, without intervals. least-squares: the published estimator, for
        reproduction.
    harmonics : str
        Such as 0,1,2; those of 0 to 3 that were measured unless given.
    poisson_ratio : float
        Poisson's ratio of the sample; needed for a modulus, not assumed.
    noise : tuple
        Standard deviation of an observable, for example A0="5 pm", or where noise is told from: scatter (neighbouring
        pixels), pair (trace and retrace), or "bandwidth=500 Hz, detector=50 fm/rtHz, temperature=300 K"; may be
        repeated, single values stand. Unless given, it is told from trace and retrace where the file has both and
        --direction says which is mapped; an ordinary one is assumed elsewhere.
    prior : tuple
        What is known of a property before, for example modulus="10 MPa .. 10 GPa" or adhesion="8 nN +- 3 nN"; may be
        repeated. Broad ones unless given; the report states them.
    motion : str
        full: the harmonics of the tip's motion count. cosine: they do not, as in the published formulas.
    parameter : tuple
        What else the model has to know, for example thickness="50 nm"; may be repeated.
    calibration : Path
        Calibration of the instrument ("overtone calibrate"): the scan is corrected with it first.
    reference_area : str
        Where the reference material of the calibration is: "auto" (found by how it looks, the default), "none", or a
        rectangle "x0, y0, x1, y1" with units, such as "0 um, 0 um, 2 um, 1 um".
    lift : bool
        Use the lift (Nap) pass of the file, recorded with the drive on, for drift, slopes and background.
    population : PopulationOptions
        What method population is told of the sample.
    scan : ScanOptions
        How the file is to be read.
    """
    import xarray as xr

    from overtone import provenance
    from overtone.inversion.properties import map_energy
    from overtone.io.netcdf import save
    from overtone.readings import probe_of
    from overtone.report.content import Report
    from overtone.report.page import write_report
    from overtone.report.summary import energy_table, result_tables
    from overtone.report.terminal import print_report

    files = (file, *further)
    told = sample_of(population, method)
    _check_paths(files, output, report, population.paper)
    asked = _Request(
        model,
        method,
        _parse_harmonics(harmonics),
        poisson_ratio,
        parse_priors(prior),
        motion,
        _parse_given(parameter),
        told,
        population.paper is not None,
    )
    _check_request(asked, len(files))
    wanted = noise_request(noise)
    observables, correction = opened(files, scan, calibration, reference_area, lift)
    probe, pooled = probe_of(observables), method == POPULATION
    first = first_of(observables) if pooled else observables
    sigma, said = resolve_noise(wanted, first, probe, pair=partial(both_ways, file, scan, probe))
    observables = provenance.add_finding(observables, said)
    energies = map_energy(observables, probe, noise=sigma)
    with progress_bar() as update:
        result, label, remarks = _properties(observables, asked, sigma, partial(update, "inverting"))
    observables = provenance.add_finding(observables, *remarks)
    first = first_of(observables) if pooled else observables
    scans = observables["A1"].size // first["A1"].size
    properties: dict[str, xr.Dataset] = {} if result is None else {label: result}
    shown = first_of(energies) if pooled else energies
    tables = [energy_table(shown, _other_readings(first))]
    if result is not None:
        tables += result_tables(label, result)
    content = Report(
        title=f"overtone: {file.name}" + (f" and {len(further)} more" if further else ""),
        subtitle=" x ".join(map(str, first["A1"].shape))
        + " pixels"
        + (f", {scans} scans, of which the first is shown" if scans > 1 else ""),
        observables=first,
        energies=shown,
        properties=properties,
        tables=tuple(tables),
        findings=tuple(provenance.findings(observables)),
        **correction,
    )
    merged = observables.merge(energies.drop_attrs(deep=False))
    if result is not None:
        merged = merged.merge(result.drop_attrs(deep=False)).assign_attrs(result.attrs)
    written: list[Path] = []
    # the reports first: where they cannot be written nothing is
    try:
        if report is not None:
            written.append(write_report(content, report))
        if population.paper is not None and result is not None:
            written += _written_paper(population.paper, content, result)
        save(merged.assign_attrs(findings=observables.attrs.get("findings", "[]")), output)
    except BaseException:
        for path in written:
            path.unlink(missing_ok=True)
        raise
    console = Console()
    print_report(content, console)
    for name in (output, report, population.paper):
        if name is not None:
            console.print(f"wrote {name}", highlight=False, soft_wrap=True, markup=False)


def _written_paper(folder: Path, content: Any, result: Any) -> tuple[Path, ...]:
    from overtone.report.paper import write_paper

    return write_paper(
        folder,
        content.observables,
        result,
        before=content.before,
        energies=content.energies,
        curves=content.calibration,
        title=content.title.removeprefix("overtone: "),
    )


def _check_paths(files: tuple[Path, ...], output: Path, report: Path | None, paper: Path | None) -> None:
    """Refuse outputs that could not be written, or would replace a scan or each other."""
    paths = [path for path in (output, report) if path is not None]
    for path in paths:
        if not path.parent.is_dir():
            raise OvertoneError(f"the folder {path.parent} does not exist", hint="create it first")
        if path.is_dir():
            raise OvertoneError(f"{path} is a folder", expected="the name of a file")
        if path.resolve() in [file.resolve() for file in files]:
            raise OvertoneError(f"{path} is the scan itself", expected="another name for the result")
    named = [*paths, *([paper] if paper is not None else [])]
    if len({path.resolve() for path in named}) < len(named):
        raise OvertoneError("result and report have the same name", got=str(output))
    if output.suffix.lower() != ".nc":
        raise OvertoneError(f"{output.name} is no name for a result", expected="a name that ends in .nc")
    if paper is not None and (not paper.parent.is_dir() or (paper.exists() and not paper.is_dir())):
        raise OvertoneError(
            f"{paper} is no folder for a paper",
            expected="the name of a folder",
            got="a file" if paper.exists() else f"the folder {paper.parent} does not exist",
            hint="another name" if paper.exists() else "create it first",
        )


class _Request(NamedTuple):
    """What was asked of the inversion."""

    model: str | None
    method: str
    harmonics: tuple[int, ...] | None
    poisson_ratio: float | None
    priors: dict[str, Any]
    motion: str
    given: dict[str, float]
    sample: Sample
    paper: bool


def _check_request(asked: _Request, files: int) -> None:
    """Refuse what could not be mapped, whether or not the file allows a modulus."""
    from overtone.contact.parameters import POISSON_RATIO
    from overtone.inversion.properties import HARMONIC_SETS, METHODS, MOTIONS, records_of

    if asked.method not in METHODS:
        raise OvertoneError("unknown method", expected=", ".join(METHODS), got=repr(asked.method))
    if asked.motion not in MOTIONS:
        raise OvertoneError("unknown motion", expected=", ".join(MOTIONS), got=repr(asked.motion))
    if asked.model is not None:
        records_of(asked.model, asked.method)
    if asked.priors and asked.method not in ("posterior", POPULATION):
        raise OvertoneError(
            "only the posterior has priors", expected="--method posterior or population", got=asked.method
        )
    if files > 1 and asked.method != POPULATION:
        raise OvertoneError(
            f"{files} scans are mapped one by one",
            expected="one file, or --method population, which takes scans of the same pixels together",
            got=f"--method {asked.method}",
        )
    if (
        asked.method == "least-squares"
        and asked.harmonics is not None
        and asked.harmonics not in HARMONIC_SETS
    ):
        raise OvertoneError(
            "harmonics do not fit the method", expected="0,1,2 or 1,2,3", got=str(asked.harmonics)
        )
    if asked.poisson_ratio is not None:
        POISSON_RATIO.check(asked.poisson_ratio)


def _parse_given(texts: tuple[str, ...]) -> dict[str, float]:
    """Return parameters of the model by name [SI]."""
    from overtone.contact.models import models
    from overtone.units import parse_quantity

    known = {q.name: q for record in models() for q in record.given}
    given = {}
    for text in texts:
        name, mark, value = (part.strip() for part in text.partition("="))
        if not mark or name not in known:
            raise OvertoneError(
                "--parameter is not understood",
                expected='a name and a value, such as thickness="50 nm"; names are ' + ", ".join(known),
                got=repr(text),
            )
        given[name] = parse_quantity(value, known[name].unit, f"--parameter {name}")
    return given


def _other_readings(observables: Any) -> list[Any]:
    """Return the energies of the same scan as its file may be read otherwise."""
    from overtone.inversion.properties import map_energy
    from overtone.readings import reading_of

    reading = reading_of(observables)
    alternatives = reading.alternatives if reading is not None else ()
    first = observables[["A1", "phi1"]].drop_attrs(deep=False)
    return [map_energy(first.assign(phi1=first["phi1"] + shift), probe) for probe, shift in alternatives]


def _properties(
    observables: Any, asked: _Request, noise: dict[str, float], progress: Any
) -> tuple[Any, str, tuple[str, ...]]:
    """Return the property maps with a label, and what to say of them, or where there are none."""
    from overtone.inversion.properties import map_properties, undetermined_properties
    from overtone.inversion.validity import with_validity
    from overtone.io.observables import missing_for_modulus
    from overtone.readings import probe_of

    probe = probe_of(observables)
    orders = _orders(observables, asked)
    missing = [
        text
        for text, absent in (
            ('the tip radius (--radius "10 nm")', probe.tip.radius is None),
            ("Poisson's ratio of the sample (--poisson-ratio 0.35)", asked.poisson_ratio is None),
        )
        if absent
    ]
    if missing and (asked.model is not None or asked.paper) and _needs_a_tip(asked):
        raise OvertoneError(
            "a modulus was asked for",
            expected=" and ".join(missing),
            got="no value",
            hint="neither has a default",
        )
    if orders is None:
        reason = f"no modulus: {missing_for_modulus(observables)}."
        if asked.paper:
            raise OvertoneError("there is nothing to write a paper of", got=reason.removesuffix("."))
        if asked.model is None:
            return None, "", (reason,)
        return undetermined_properties(first_of(observables), asked.model, reason), "no harmonics", (reason,)
    if missing and (asked.model is None or _needs_a_tip(asked)):
        return None, "", (f"no modulus was mapped, because it needs {' and '.join(missing)}.",)
    model = asked.model or "dmt"
    sample: dict[str, Any] = {}
    remarks: tuple[str, ...] = ()
    if asked.method == POPULATION:
        check_scan(first_of(observables), orders)
        sample, remark = arguments_of(asked.sample, first_of(observables), asked.poisson_ratio)
        remarks = tuple(text for text in (no_calibration(observables), remark) if text)
    result = map_properties(
        observables,
        probe,
        model=model,
        poisson_ratio=asked.poisson_ratio,
        method=asked.method,
        harmonics=orders,
        noise=noise,
        priors=asked.priors,
        motion=asked.motion,
        given=asked.given,
        progress=progress,
        **sample,
    )
    result = with_validity(
        result,
        first_of(observables)["A1"],
        probe,
        model=model,
        poisson_ratio=asked.poisson_ratio,
        harmonics=orders,
        **asked.given,
    )
    return result, "harmonics " + ", ".join(map(str, orders)), remarks


def _needs_a_tip(asked: _Request) -> bool:
    from overtone.inversion.properties import records_of

    records = records_of(asked.model or "dmt", asked.method)
    return any(q.name == "poisson_ratio" for record in records for q in record.given)


def _orders(observables: Any, asked: _Request) -> tuple[int, ...] | None:
    """Return the harmonics to use, None where too few were measured."""
    from overtone.errors import InversionError
    from overtone.inversion.properties import HARMONIC_SETS, harmonics_for
    from overtone.quantities import harmonic_orders

    measured = set(harmonic_orders(observables))
    if asked.harmonics is not None:
        missing = sorted(set(asked.harmonics) - measured)
        if missing:
            raise OvertoneError(
                f"harmonic {missing[0]} was not measured",
                expected=f"some of {', '.join(map(str, sorted(measured)))}",
                got=f"--harmonics {','.join(map(str, asked.harmonics))}",
            )
        return asked.harmonics
    if asked.method == "least-squares":
        return next((orders for orders in HARMONIC_SETS if set(orders) <= measured), None)
    try:
        return harmonics_for(observables, asked.model or "dmt", asked.method)
    except InversionError:
        return None


def _parse_harmonics(text: str | None) -> tuple[int, ...] | None:
    if text is None:
        return None
    try:
        return tuple(int(part) for part in text.split(","))
    except ValueError as error:
        raise OvertoneError("--harmonics is not a list", expected="such as 0,1,2", got=repr(text)) from error
