"""``overtone map``."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Annotated, Any

from cyclopts import Parameter
from rich.console import Console

from overtone.cli.options import ScanOptions, open_with, parse_noise
from overtone.cli.progress import progress_bar
from overtone.errors import OvertoneError


def map_scan(
    file: Path,
    /,
    *,
    output: Annotated[Path, Parameter(name=["--output", "-o"])],
    report: Path | None = None,
    model: str | None = None,
    method: str = "least-squares",
    harmonics: str | None = None,
    poisson_ratio: float | None = None,
    noise: Annotated[tuple[str, ...], Parameter(name="--noise")] = (),
    calibration: Path | None = None,
    reference_area: str | None = None,
    lift: Annotated[bool, Parameter(negative=())] = False,
    scan: ScanOptions = ScanOptions(),  # noqa: B008 - a frozen record
) -> None:
    """Map a scan: force, energy, virial and regime always, mechanical properties where the data allow.

    Parameters
    ----------
    file : Path
        Scan, curve or table: .ibw, a neaSNOM folder, netCDF, CSV.
    output : Path
        Result, a netCDF file.
    report : Path
        Report as one HTML file.
    model : str
        Contact model (see "overtone models"); dmt-linear unless given, where a modulus can be mapped.
    method : str
        least-squares: the published estimator, for reproduction.
    harmonics : str
        0,1,2 or 1,2,3; the first set that was measured unless given.
    poisson_ratio : float
        Poisson's ratio of the sample; needed for a modulus, not assumed.
    noise : tuple
        Standard deviation of an observable, for example A0="5 pm"; may be repeated. Unless given, it is told from trace
        and retrace where the file has both and --direction says which is mapped; an ordinary one is assumed elsewhere.
    calibration : Path
        Calibration of the instrument ("overtone calibrate"): the scan is corrected with it first.
    reference_area : str
        Where the reference material of the calibration is: "auto" (found by how it looks, the default), "none", or a
        rectangle "x0, y0, x1, y1" with units, such as "0 um, 0 um, 2 um, 1 um".
    lift : bool
        Use the lift (Nap) pass of the file, recorded with the drive on, for drift, slopes and background.
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
    from overtone.report.summary import energy_table, property_table
    from overtone.report.terminal import print_report

    _check_paths(file, output, report)
    _check_request(model, method, harmonics, poisson_ratio)
    sigma = parse_noise(noise)
    observables, correction = _opened(file, scan, calibration, reference_area, lift)
    observables, sigma = _with_noise_of_the_pair(file, scan, observables, sigma)
    energies = map_energy(observables, probe_of(observables), noise=sigma)
    with progress_bar() as update:
        result, label, remark = _properties(
            observables,
            model,
            method,
            harmonics,
            poisson_ratio,
            sigma,
            partial(update, "inverting"),
        )
    if remark:
        observables = provenance.add_finding(observables, remark)
    properties: dict[str, xr.Dataset] = {} if result is None else {label: result}
    tables = [energy_table(energies, _other_readings(observables))]
    if result is not None:
        tables.append(property_table(label, result))
    content = Report(
        title=f"overtone: {file.name}",
        subtitle=" x ".join(map(str, observables["A1"].shape)) + " pixels",
        observables=observables,
        energies=energies,
        properties=properties,
        tables=tuple(tables),
        findings=tuple(provenance.findings(observables)),
        **correction,
    )
    merged = observables.merge(energies.drop_attrs(deep=False))
    if result is not None:
        merged = merged.merge(result.drop_attrs(deep=False)).assign_attrs(result.attrs)
    # the report first: where it cannot be written nothing is
    if report is not None:
        write_report(content, report)
    try:
        save(merged.assign_attrs(findings=observables.attrs.get("findings", "[]")), output)
    except BaseException:
        if report is not None:
            report.unlink(missing_ok=True)
        raise
    console = Console()
    print_report(content, console)
    for path in (output, report):
        if path is not None:
            console.print(f"wrote {path}", highlight=False, soft_wrap=True, markup=False)


def _opened(
    file: Path, scan: ScanOptions, calibration: Path | None, reference_area: str | None, lift: bool
) -> tuple[Any, dict[str, Any]]:
    """Return the scan, corrected where there is a calibration, and what a report says of that."""
    if calibration is None:
        for option, given in (("--reference-area", reference_area), ("--lift", lift)):
            if given:
                raise OvertoneError(
                    f"{option} corrects a scan",
                    expected="a calibration",
                    hint="--calibration calibration.toml",
                )
        return open_with(file, scan), {}
    from overtone import provenance
    from overtone.errors import CalibrationError
    from overtone.instrument.calibration import load_calibration
    from overtone.instrument.correct import calibration_of, correct
    from overtone.instrument.gates import gates
    from overtone.report.content import Calibrated

    record = load_calibration(calibration)
    before = open_with(file, scan, probe=record.probe, keep_offset=True)
    nap = open_with(file, scan, probe=record.probe, lift=True) if lift else None
    after = correct(before, record, reference=_area(reference_area), lift=nap)
    left = calibration_of(after)
    supported: tuple[Any, ...] = ()
    if left is not None and left.reference is not None:
        setpoint = float(after["A1"].median()) / left.probe.drive.free_amplitude
        try:
            supported = gates(left, setpoint=setpoint)
        except CalibrationError as error:
            after = provenance.add_finding(after, f"What the calibration supports cannot be told: {error}")
    return after, {"before": before, "calibration": Calibrated(record, gates=supported)}


def _area(text: str | None) -> Any:
    """Return the reference area of a text: auto, None, or a rectangle [m]."""
    from overtone.units import parse_quantity

    if text is None or text == "auto":
        return "auto"
    if text == "none":
        return None
    parts = text.split(",")
    if len(parts) != 4:
        raise OvertoneError(
            "--reference-area is not understood",
            expected='"auto", "none" or "x0, y0, x1, y1" with units',
            got=repr(text),
        )
    return tuple(parse_quantity(part, "m", "--reference-area") for part in parts)


def _with_noise_of_the_pair(
    file: Path, scan: ScanOptions, observables: Any, stated: dict[str, float]
) -> tuple[Any, dict[str, float]]:
    """Return the scan and its noise: as stated, or from trace and retrace where the file holds both.

    The two ways are as stored: what the calibration of a corrected scan says of the gains is divided out.
    """
    from dataclasses import replace

    from overtone import provenance
    from overtone.instrument.correct import calibration_of
    from overtone.instrument.noise import noise_from_pair
    from overtone.readings import probe_of

    other = {"trace": "retrace", "retrace": "trace"}.get(scan.direction or "")
    if stated or other is None:
        return observables, stated
    try:
        pair = [
            open_with(file, replace(scan, direction=way), probe=probe_of(observables), keep_offset=True)
            for way in (scan.direction, other)
        ]
        noise = noise_from_pair(*pair)
    except OvertoneError:  # the other way was not recorded, or not with the same channels
        return observables, stated
    corrected = calibration_of(observables)
    if corrected is not None:
        gains = {f"A{n}": corrected.values[f"gain{n}"] for n in (0, 2, 3)}
        noise = {name: value / gains.get(name, 1.0) for name, value in noise.items()}
    from overtone.quantities import quantity
    from overtone.units import format_quantity

    texts = (
        f"{name} {format_quantity(value, getattr(quantity(name), 'unit', '1'))}"
        for name, value in noise.items()
    )
    return provenance.add_finding(observables, f"Noise, from trace and retrace: {', '.join(texts)}."), noise


def _check_paths(file: Path, output: Path, report: Path | None) -> None:
    """Refuse outputs that could not be written, or would replace the scan or each other."""
    paths = [path for path in (output, report) if path is not None]
    for path in paths:
        if not path.parent.is_dir():
            raise OvertoneError(f"the folder {path.parent} does not exist", hint="create it first")
        if path.is_dir():
            raise OvertoneError(f"{path} is a folder", expected="the name of a file")
        if path.resolve() == file.resolve():
            raise OvertoneError(f"{path} is the scan itself", expected="another name for the result")
    if len({path.resolve() for path in paths}) < len(paths):
        raise OvertoneError("result and report have the same name", got=str(output))
    if output.suffix.lower() != ".nc":
        raise OvertoneError(f"{output.name} is no name for a result", expected="a name that ends in .nc")


def _check_request(
    model: str | None, method: str, harmonics: str | None, poisson_ratio: float | None
) -> None:
    """Refuse what could not be mapped, whether or not the file allows a modulus."""
    from overtone.contact.models import contact_model
    from overtone.contact.parameters import POISSON_RATIO
    from overtone.inversion.properties import HARMONIC_SETS, METHODS

    if model is not None and not contact_model(model).invertible:
        raise OvertoneError(f"model {model!r} cannot be inverted", hint="overtone models")
    if method not in METHODS:
        raise OvertoneError("unknown method", expected=", ".join(METHODS), got=repr(method))
    orders = _parse_harmonics(harmonics)
    if orders is not None and orders not in HARMONIC_SETS:
        raise OvertoneError("harmonics do not fit the method", expected="0,1,2 or 1,2,3", got=str(harmonics))
    if poisson_ratio is not None:
        POISSON_RATIO.check(poisson_ratio)


def _other_readings(observables: Any) -> list[Any]:
    """Return the energies of the same scan as its file may be read otherwise."""
    from overtone.inversion.properties import map_energy
    from overtone.readings import reading_of

    reading = reading_of(observables)
    alternatives = reading.alternatives if reading is not None else ()
    first = observables[["A1", "phi1"]].drop_attrs(deep=False)
    return [map_energy(first.assign(phi1=first["phi1"] + shift), probe) for probe, shift in alternatives]


def _properties(
    observables: Any,
    model: str | None,
    method: str,
    harmonics: str | None,
    poisson_ratio: float | None,
    noise: dict[str, float],
    progress: Any,
) -> tuple[Any, str, str]:
    """Return the property maps with a label, and what to say where there are none or nothing is sure."""
    from overtone.inversion.properties import HARMONIC_SETS, map_properties, undetermined_properties
    from overtone.io.observables import missing_for_modulus
    from overtone.quantities import harmonic_orders
    from overtone.readings import probe_of

    probe = probe_of(observables)
    measured = set(harmonic_orders(observables))
    orders = _parse_harmonics(harmonics) or next((s for s in HARMONIC_SETS if set(s) <= measured), None)
    missing = [
        text
        for text, absent in (
            ('the tip radius (--radius "10 nm")', probe.tip.radius is None),
            ("Poisson's ratio of the sample (--poisson-ratio 0.35)", poisson_ratio is None),
        )
        if absent
    ]
    if missing and model is not None:
        raise OvertoneError(
            "a modulus was asked for",
            expected=" and ".join(missing),
            got="no value",
            hint="neither has a default",
        )
    if orders is None:
        reason = f"no modulus: {missing_for_modulus(observables)}."
        if model is None:
            return None, "", reason
        return undetermined_properties(observables, model, reason), "no harmonics", reason
    if missing:
        return None, "", f"no modulus was mapped, because it needs {' and '.join(missing)}."
    result = map_properties(
        observables,
        probe,
        model=model or "dmt-linear",
        poisson_ratio=float(poisson_ratio or 0.0),
        method=method,
        harmonics=orders,
        noise=noise,
        progress=progress,
    )
    assumed = (
        ""
        if noise
        else "noise was not stated, an ordinary one is assumed (5 pm on A0, 0.1 deg, 1 pm on A2, A3)."
    )
    return result, "harmonics " + ", ".join(map(str, orders)), assumed


def _parse_harmonics(text: str | None) -> tuple[int, ...] | None:
    if text is None:
        return None
    try:
        return tuple(int(part) for part in text.split(","))
    except ValueError as error:
        raise OvertoneError("--harmonics is not a list", expected="0,1,2 or 1,2,3", got=repr(text)) from error
