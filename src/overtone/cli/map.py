"""``overtone map``."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter
from rich.console import Console

from overtone.batch.noise import noise_request
from overtone.cli.batch import BatchOptions, check_batch, map_batch, summary_line
from overtone.cli.options import ScanOptions, parse_rectangle, radius_of, reading_arguments
from overtone.cli.population import PopulationOptions, sample_of
from overtone.cli.priors import parse_priors
from overtone.cli.progress import progress_bar
from overtone.errors import OvertoneError
from overtone.units import parse_quantity

if TYPE_CHECKING:
    from overtone.batch.settings import Settings


def map_scan(
    file: Path,
    /,
    *further: Path,
    output: Annotated[Path | None, Parameter(name=["--output", "-o"])] = None,
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
    batch: BatchOptions = BatchOptions(),  # noqa: B008 - a frozen record
    scan: ScanOptions = ScanOptions(),  # noqa: B008 - a frozen record
) -> None:
    """Map a scan: force, energy, virial and regime always, mechanical properties where the data allow.

    Parameters
    ----------
    file : Path
        Scan, curve or table of any format that overtone reads.
    further : Path
        Further files: with --out-dir each a scan of its own, with --method population and --output scans of the same
        pixels at other set-points, taken together with the first. Patterns such as "*.ibw" are understood.
    output : Path
        Result, a netCDF file; of a Zarr folder, which may be larger than memory, a .zarr.
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
    batch : BatchOptions
        Many files, or many computers.
    scan : ScanOptions
        How the file is to be read.
    """
    from dataclasses import replace

    from overtone.batch.blocks import fits_in_blocks, map_blocks
    from overtone.batch.inputs import find_files
    from overtone.batch.mapping import map_scans, report_of
    from overtone.batch.settings import check_settings, texts_of
    from overtone.batch.writing import stamps_of, write_map
    from overtone.report.terminal import print_report

    check_batch(batch, output, report, population.paper)
    files = find_files((file, *further))
    told = sample_of(population, method)
    if output is not None:
        _check_paths(files, output, report, population.paper)
    settings = replace(
        _reading(scan, calibration, reference_area, lift),
        model=model,
        method=method,
        harmonics=_parse_harmonics(harmonics),
        poisson_ratio=poisson_ratio,
        priors=parse_priors(prior),
        motion=motion,
        given=_parse_given(parameter),
        phases=told.phases,
        reference=told.reference,
        reference_pixels=told.region,
        seed=told.seed,
    )
    check_settings(settings, len(files) if output is not None else 1)
    settings = replace(settings, noise=noise_request(noise))
    if output is None:
        map_batch(files, settings, batch)
        return
    if fits_in_blocks(files, output, settings, batch.cluster, report, population.paper):
        with progress_bar() as update:
            record = map_blocks(
                files[0], output, settings, cluster=batch.cluster, progress=partial(update, "mapping")
            )
        Console().print(summary_line(record.summary))
    else:
        stamps = stamps_of(files, output.parent)
        for_paper = population.paper is not None
        with progress_bar() as update:
            mapped = map_scans(files, settings, for_paper=for_paper, progress=partial(update, "inverting"))
        content = report_of(mapped)
        write_map(
            mapped,
            output,
            stamps=stamps,
            settings=texts_of(settings),
            content=content,
            report=report,
            paper=population.paper,
        )
        print_report(content, Console())
    for name in (output, report, population.paper):
        if name is not None:
            Console().print(f"wrote {name}", highlight=False, soft_wrap=True, markup=False)


def _reading(scan: ScanOptions, calibration: Path | None, reference_area: str | None, lift: bool) -> Settings:
    """Return settings of how a scan is read and corrected."""
    from overtone.batch.settings import Settings

    if reference_area is not None and calibration is None:  # "auto" by itself asks for nothing
        raise OvertoneError(
            "--reference-area corrects a scan",
            expected="a calibration",
            hint="--calibration calibration.toml",
        )
    return Settings(
        **reading_arguments(scan),
        radius=radius_of(scan),
        direction=scan.direction,
        frame=scan.frame,
        calibration=calibration,
        reference_area=_area(reference_area),
        lift=lift,
    )


def _area(text: str | None) -> str | tuple[float, float, float, float] | None:
    """Return the reference area of a text: auto, None, or a rectangle [m]."""
    if text is None or text == "auto":
        return "auto"
    if text == "none":
        return None
    return parse_rectangle(text, "--reference-area", '"auto", "none" or ')


def _check_paths(files: tuple[Path, ...], output: Path, report: Path | None, paper: Path | None) -> None:
    """Refuse outputs that could not be written, or would replace a scan or each other."""
    paths = [path for path in (output, report) if path is not None]
    zarr = output.suffix.lower() == ".zarr"
    for path in paths:
        if not path.parent.is_dir():
            raise OvertoneError(f"the folder {path.parent} does not exist", hint="create it first")
        if path.is_dir() and not (zarr and path == output and (path / "zarr.json").is_file()):
            raise OvertoneError(f"{path} is a folder", expected="the name of a file")
        if path.resolve() in [file.resolve() for file in files]:
            raise OvertoneError(f"{path} is the scan itself", expected="another name for the result")
    named = [*paths, *([paper] if paper is not None else [])]
    if len({path.resolve() for path in named}) < len(named):
        raise OvertoneError("result and report have the same name", got=str(output))
    if output.suffix.lower() != ".nc" and not zarr:
        raise OvertoneError(f"{output.name} is no name for a result", expected="a name that ends in .nc")
    if paper is not None and (not paper.parent.is_dir() or (paper.exists() and not paper.is_dir())):
        raise OvertoneError(
            f"{paper} is no folder for a paper",
            expected="the name of a folder",
            got="a file" if paper.exists() else f"the folder {paper.parent} does not exist",
            hint="another name" if paper.exists() else "create it first",
        )


def _parse_given(texts: tuple[str, ...]) -> dict[str, float]:
    """Return parameters of the model by name [SI]."""
    from overtone.contact.models import models

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


def _parse_harmonics(text: str | None) -> tuple[int, ...] | None:
    if text is None:
        return None
    try:
        return tuple(int(part) for part in text.split(","))
    except ValueError as error:
        raise OvertoneError("--harmonics is not a list", expected="such as 0,1,2", got=repr(text)) from error
