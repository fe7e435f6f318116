"""``overtone calibrate``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

from cyclopts import Parameter
from rich.console import Console
from rich.markup import escape

from overtone.cli.options import ScanOptions, radius_of, reading_arguments
from overtone.errors import CalibrationError, OvertoneError
from overtone.units import parse_quantity

_KEYS = {
    "E": "modulus",
    "modulus": "modulus",
    "nu": "poisson_ratio",
    "poisson_ratio": "poisson_ratio",
    "Fad": "adhesion",
    "adhesion": "adhesion",
    "E_error": "modulus_error",
    "modulus_error": "modulus_error",
    "Fad_error": "adhesion_error",
    "adhesion_error": "adhesion_error",
    "model": "model",
    "name": "name",
}
_UNITS = {"modulus": "Pa", "adhesion": "N", "poisson_ratio": "1", "modulus_error": "1", "adhesion_error": "1"}


def calibrate_curve(
    file: Path,
    /,
    *,
    output: Annotated[Path, Parameter(name=["--output", "-o"])],
    reference: str | None = None,
    far_field: Path | None = None,
    setpoint: float | None = None,
    plot: Annotated[bool, Parameter(negative=())] = False,
    scan: ScanOptions = ScanOptions(),  # noqa: B008 - a frozen record
) -> None:
    """Calibrate an instrument from an approach curve on a reference material and data far from it.

    Parameters
    ----------
    file : Path
        Approach curve: Asylum .ibw, netCDF or CSV over z, as the microscope stored it.
    output : Path
        Calibration, TOML (or JSON where the name ends in .json).
    reference : str
        The material under the tip, for example "E=2 GPa, nu=0.35"; also Fad=8 nN, E_error=10 %, model=dmt, name=PS.
        Without it gains and latency stay unknown.
    far_field : Path
        Readings far from the surface at several drive frequencies at constant drive: a table or netCDF with
        frequency, A0, A1, phi1, A2, phi2.
    setpoint : float
        A1/A1far of the scans, for the table of what the calibration supports; 0.5 unless given.
    plot : bool
        Also draw the curve before and after, beside the output, as PNG.
    scan : ScanOptions
        How the files are to be read.
    """
    from overtone.batch.opened import with_radius
    from overtone.instrument.calibrate import calibrate
    from overtone.instrument.calibration import save_calibration
    from overtone.io.atomic import atomic_path
    from overtone.io.curves import open_curve
    from overtone.io.ladder import open_ladder

    if setpoint is not None and not 0.0 < setpoint < 1.0:
        raise OvertoneError("--setpoint is A1 over A1far", expected="between 0 and 1", got=f"{setpoint:g}")
    material = parse_reference(reference) if reference is not None else None
    if not output.parent.is_dir():
        raise OvertoneError(f"the folder {output.parent} does not exist", hint="create it first")
    if output.resolve() == file.resolve() or output.suffix.lower() not in (".toml", ".json"):
        raise OvertoneError(
            f"{output.name} is no name for a calibration", expected="a name that ends in .toml or .json"
        )
    raw = with_radius(
        open_curve(file, direction=scan.direction or "approach", **reading_arguments(scan)), radius_of(scan)
    )
    ladder = open_ladder(far_field, phase_sign=scan.phase_sign) if far_field else None
    probe = _probe(raw)
    console = Console()
    with console.status("fitting the approach curve"):
        calibration = calibrate(raw, probe, reference=material, far_field=ladder)
    # drawn before anything is written: where that fails nothing is
    picture = _drawn(raw, calibration, ladder) if plot else None
    save_calibration(calibration, output)
    written = [output]
    if picture is not None:
        written.append(output.with_suffix(".png"))
        with atomic_path(written[-1]) as temporary:
            temporary.write_bytes(picture)
    _print(console, file, raw, calibration, 0.5 if setpoint is None else setpoint)
    for path in written:
        console.print(f"wrote {path}", highlight=False, soft_wrap=True, markup=False)


def parse_reference(text: str) -> Any:
    """Return the reference that a text such as "E=2 GPa, nu=0.35" describes."""
    from overtone.instrument.approach_fit import Reference

    values: dict[str, Any] = {}
    for part in text.split(","):
        name, equals, value = (piece.strip() for piece in part.partition("="))
        if not equals or name not in _KEYS or not value:
            raise OvertoneError(
                "--reference is not understood",
                expected='text such as "E=2 GPa, nu=0.35", with any of '
                + ", ".join(k for k in _KEYS if len(k) < 10),
                got=repr(part.strip()),
            )
        key = _KEYS[name]
        if key in values:
            raise OvertoneError(f"--reference gives {name} twice", got=repr(text))
        values[key] = parse_quantity(value, _UNITS[key], f"--reference {name}") if key in _UNITS else value
    if "poisson_ratio" not in values:
        raise OvertoneError(
            "--reference has no Poisson's ratio",
            expected="nu, which scales a modulus by 1 - nu^2 and has no default",
            hint=f'--reference "{text.strip()}, nu=0.35"',
        )
    return Reference(**values)


def _probe(raw: Any) -> Any:
    from overtone.readings import probe_of

    return probe_of(raw)


def _drawn(raw: Any, calibration: Any, ladder: Any) -> bytes:
    """Return the curve before and after as PNG."""
    from overtone.instrument.correct import correct
    from overtone.plots import png_bytes
    from overtone.plots.calibration import calibration_figure

    return png_bytes(calibration_figure(raw, correct(raw, calibration), calibration, far_field=ladder))


def _print(console: Console, file: Path, raw: Any, calibration: Any, setpoint: float) -> None:
    from overtone.instrument.correct import unsettled_findings
    from overtone.instrument.gates import gates
    from overtone.report.summary import gate_table, unknown_table
    from overtone.report.terminal import print_table

    console.print(f"[bold]Calibration from {escape(file.name)}[/]")
    print_table(unknown_table(calibration), console)
    for sentence in (*unsettled_findings(raw, calibration), *calibration.findings):
        console.print(f"- {sentence}", markup=False, highlight=False, soft_wrap=True)
    if calibration.reference is None:
        return
    try:
        supported = gates(calibration, setpoint=setpoint)
    except CalibrationError as error:
        console.print(
            f"- what it supports cannot be told: {error}", markup=False, highlight=False, soft_wrap=True
        )
        return
    print_table(gate_table(supported, calibration), console)
    for gate in supported:
        sentence = f"- {gate.material}: {gate.verdict}; {gate.reason}"
        console.print(sentence, markup=False, highlight=False, soft_wrap=True)
