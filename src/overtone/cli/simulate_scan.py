"""``overtone simulate scan``: what a microscope would store of a sample of known properties."""

from __future__ import annotations

import re
import warnings
from collections.abc import Callable
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Annotated, Any, TypeVar

from cyclopts import Parameter
from rich.console import Console

from overtone.cli.options import ProbeOptions, open_probe, open_sample
from overtone.cli.progress import progress_bar
from overtone.errors import OvertoneError, OvertoneWarning
from overtone.units import format_quantity, parse_quantity

_Result = TypeVar("_Result")

_PHANTOMS = ("ps-ldpe", "gradient")
_POISSON_RATIO = 0.35  # of the phantoms made here, which are no unknown samples
_PIXELS, _SIZE = "128x128", "8 um"
_MOST_PIXELS, _MOST_POINTS = 4096, 100_000
_LOWEST_SETPOINT, _FARTHEST = 0.1, 4.0  # of the free amplitude: ends of a curve unless given
_LADDER_INTERVAL = 0.1  # s
_ENDINGS = {
    "--output": (".nc", ".ibw"),
    "--curve": (".nc", ".ibw"),
    "--far-field": (".nc",),
    "--truth": (".nc",),
}


def scan(
    *,
    probe: ProbeOptions,
    setpoint: float,
    output: Annotated[Path, Parameter(name=["--output", "-o"])],
    sample: str | None = None,
    phantom: str | None = None,
    pixels: str | None = None,
    size: str | None = None,
    model: str | None = None,
    poisson_ratio: float | None = None,
    instrument: Path | None = None,
    regime: str = "repulsive",
    retrace: bool = True,
    lift: str | None = None,
    seed: int = 1,
    truth: Path | None = None,
    curve: Path | None = None,
    reference: str | None = None,
    z: str | None = None,
    points: int = 200,
    speed: str = "200 nm/s",
    far_field: Path | None = None,
    far_height: str = "1 um",
    harmonics: int = 10,
) -> None:
    """Simulate a scan as a microscope would store it, with calibration data and the truth beside it.

    Parameters
    ----------
    probe : ProbeOptions
        The probe.
    setpoint : float
        A1/A1far that the feedback holds.
    output : Path
        Scan, a netCDF file (.nc) or an Igor wave (.ibw).
    sample : str
        One material everywhere: "dmt, modulus=2 GPa, poisson_ratio=0.35, adhesion=8 nN", or a TOML file.
    phantom : str
        In place of a sample ps-ldpe (a polymer blend), gradient (no phases), or a netCDF map of properties.
    pixels : str
        Columns x rows; 128x128 unless given.
    size : str
        Width of the scan; "8 um" unless given.
    model : str
        Contact model of a phantom; dmt, or dmt-viscous where the map has a viscosity, unless given.
    poisson_ratio : float
        Of a phantom; 0.35 for ps-ldpe and gradient unless given.
    instrument : Path
        What the microscope adds (TOML); nothing but noise unless given.
    regime : str
        repulsive or attractive.
    retrace : bool
        Keep the retrace as well.
    lift : str
        Height of a lift pass above the working height, for example "200 nm".
    seed : int
        Seed of sample, feedback and noise.
    truth : Path
        Where to write what was really there (.nc).
    curve : Path
        Where to write an approach curve (.nc, .ibw).
    reference : str
        Material of the curve, as --sample; that of the sample, or of the middle of the phantom, unless given.
    z : str
        Heights of the curve, "5 nm to 400 nm"; from the set-point 0.1 to four free amplitudes unless given.
    points : int
        Heights of the curve.
    speed : str
        Of the base in the curve.
    far_field : Path
        Where to write a ladder of drive frequencies far from the sample (.nc).
    far_height : str
        Height of the ladder.
    harmonics : int
        Harmonics of the motion that act back on the force.
    """
    faults: list[str] = []
    try_ = partial(_try, faults)
    files = {"--output": output, "--curve": curve, "--far-field": far_field, "--truth": truth}
    given = {Path(text) for text in (probe.probe, sample, phantom, reference, str(instrument or "")) if text}
    _check_paths(files, given, faults)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", OvertoneWarning)
        lever = try_(lambda: open_probe(probe))
        ground = try_(lambda: _ground(sample, phantom, pixels, size, model, poisson_ratio, seed))
        device = try_(lambda: _instrument(instrument))
        height = try_(lambda: None if lift is None else parse_quantity(lift, "m", "--lift"))
        far = try_(lambda: parse_quantity(far_height, "m", "--far-height"))
        rate = try_(lambda: parse_quantity(speed, "m/s", "--speed"))
        bounds = try_(lambda: None if z is None else _bounds(z))
        spot = try_(lambda: None if reference is None else open_sample(reference))
        if not 0.0 < setpoint < 1.0:
            faults.append(f"--setpoint is out of reach: expected A1/A1far between 0 and 1, got {setpoint:g}.")
        if regime not in ("repulsive", "attractive"):
            faults.append(f"--regime is repulsive or attractive, got {regime!r}.")
        if not 2 <= points <= _MOST_POINTS:
            faults.append(f"--points is out of range: expected 2 to {_MOST_POINTS}, got {points}.")
        if seed < 0:
            faults.append(f"--seed is no seed: expected 0 or more, got {seed}.")
        if faults or lever is None or ground is None or device is None or rate is None or far is None:
            problem = "this scan cannot be simulated" if len(faults) == 1 else f"{len(faults)} faults"
            raise OvertoneError(problem, got=" ".join(faults))
        options = {
            "setpoint": setpoint,
            "regime": regime,
            "retrace": retrace,
            "lift": height,
            "n_max": harmonics,
        }
        with progress_bar() as update:
            made = _run(
                lever,
                ground,
                device,
                options,
                seed,
                far_field is not None and far,
                curve is not None,
                spot,
                bounds,
                points,
                rate,
                update,
            )
        written = _write(made, files)
    said = dict.fromkeys(str(w.message) for w in caught if issubclass(w.category, OvertoneWarning))
    _print(made["--output"], lever, device, ground, setpoint, list(said), written)


def _try(faults: list[str], work: Callable[[], _Result]) -> _Result | None:
    """Return what the work returns; on an error None, with its message in the list."""
    try:
        return work()
    except OvertoneError as error:
        faults.append(str(error))
        return None


# --- what was asked for ----------------------------------------------------------------------------


def _check_paths(outputs: dict[str, Path | None], inputs: set[Path], faults: list[str]) -> None:
    """Name every output that could not be written, or would replace an input or another one."""
    taken = {path.resolve() for path in inputs}
    for option, path in outputs.items():
        if path is None:
            continue
        if path.suffix.lower() not in _ENDINGS[option]:
            faults.append(f"{option} {path.name} does not end in {' or '.join(_ENDINGS[option])}.")
        if not path.parent.is_dir():
            faults.append(f"the folder {path.parent} of {option} does not exist.")
        elif path.is_dir():
            faults.append(f"{option} {path} is a folder.")
        if path.resolve() in taken:
            faults.append(f"{option} {path} is taken: each file needs a name of its own.")
        taken.add(path.resolve())


def _instrument(path: Path | None) -> Any:
    from overtone.instrument.instrument import Instrument
    from overtone.instrument.toml import load_instrument

    return Instrument() if path is None else load_instrument(path)


def _ground(
    sample: str | None,
    phantom: str | None,
    pixels: str | None,
    size: str | None,
    model: str | None,
    poisson_ratio: float | None,
    seed: int,
) -> tuple[Any, dict[str, Any]]:
    """Return what is scanned, and the options that go with it."""
    from overtone.instrument.phantom import blend, gradient
    from overtone.io.netcdf import load

    if (sample is None) == (phantom is None):
        raise OvertoneError(
            "one thing to scan is needed",
            expected="--sample or --phantom",
            got="both" if sample else "neither",
        )
    if phantom is not None and phantom not in _PHANTOMS:
        path = Path(phantom)
        if path.suffix.lower() != ".nc":
            raise OvertoneError(
                "unknown phantom", expected=f"{', '.join(_PHANTOMS)} or a netCDF map", got=repr(phantom)
            )
        if pixels or size:
            raise OvertoneError("a map has its own pixels and size", hint="leave out --pixels and --size")
        return load(path), {"model": model, "poisson_ratio": poisson_ratio}
    shape = _shape(pixels or _PIXELS)
    width = parse_quantity(size or _SIZE, "m", "--size")
    if width <= 0.0:
        raise OvertoneError("--size is no width", expected="more than 0 m", got=repr(size))
    if sample is not None:
        if model or poisson_ratio is not None:
            raise OvertoneError(
                "--model and --poisson-ratio are for phantoms", hint="in the text of --sample"
            )
        return _everywhere(open_sample(sample), shape), {"size": width}
    nu = _POISSON_RATIO if poisson_ratio is None else poisson_ratio
    if phantom == "gradient":
        return gradient(shape=shape, size=width, poisson_ratio=nu), {"model": model}
    return blend(shape=shape, size=width, poisson_ratio=nu, seed=seed), {"model": model}


def _shape(text: str) -> tuple[int, int]:
    match = re.fullmatch(r"\s*(\d+)\s*[x×]\s*(\d+)\s*", text)
    columns, rows = (int(match.group(1)), int(match.group(2))) if match else (0, 0)
    if not (1 <= columns <= _MOST_PIXELS and 1 <= rows <= _MOST_PIXELS):
        raise OvertoneError(
            "--pixels is no number of pixels",
            expected=f"columns x rows such as 128x128, up to {_MOST_PIXELS} each",
            got=repr(text),
        )
    return rows, columns


def _everywhere(material: Any, shape: tuple[int, int]) -> Any:
    import numpy as np

    from overtone.contact.sample import Sample

    return Sample(material.model, {name: np.broadcast_to(v, shape) for name, v in material.values.items()})


def _bounds(text: str) -> tuple[float, float]:
    """Return the lowest and the highest height [m]."""
    low_text, to, high_text = text.partition(" to ")
    if to and low_text.strip() and high_text.strip():
        low, high = (parse_quantity(part, "m", "--z") for part in (low_text, high_text))
        if low < high:
            return low, high
    raise OvertoneError(
        "--z is no range", expected='the lower height first, such as "5 nm to 400 nm"', got=repr(text)
    )


# --- the work --------------------------------------------------------------------------------------


def _run(
    lever: Any,
    ground: tuple[Any, dict[str, Any]],
    device: Any,
    options: dict[str, Any],
    seed: int,
    far: Any,
    curve: bool,
    spot: Any,
    bounds: tuple[float, float] | None,
    points: int,
    speed: float,
    update: Callable[[str, int, int], None],
) -> dict[str, Any]:
    """Return the datasets by option, recorded one after the other: ladder, curve, scan."""
    from overtone.instrument.curve import simulate_approach, simulate_far_field
    from overtone.instrument.scan import scan_with_truth

    made, clock = {}, 0.0
    if far is not False:
        ladder = simulate_far_field(lever, device, height=far, interval=_LADDER_INTERVAL, seed=seed)
        made["--far-field"] = ladder
        clock += _LADDER_INTERVAL * ladder.sizes["point"]
    if curve:
        material = spot if spot is not None else _middle(*ground)
        heights = _heights(lever, material, bounds, points)
        report = partial(update, "approach curve")
        made["--curve"] = simulate_approach(
            lever, material, device, z=heights, speed=speed, time=clock, seed=seed, progress=report
        )
        clock += 2.0 * float(heights[0] - heights[-1]) / speed
    surface, extra = ground
    report = partial(update, "scan")
    made["--output"], made["--truth"] = scan_with_truth(
        lever, surface, device, time=clock, seed=seed, progress=report, **options, **extra
    )
    return made


def _middle(surface: Any, extra: dict[str, Any]) -> Any:
    """Return the material of the pixel in the middle."""
    from overtone.contact.sample import Sample
    from overtone.instrument.phantom import material_of

    if not isinstance(surface, Sample):
        surface = material_of(surface, extra.get("model"), extra.get("poisson_ratio"))
    at = tuple(length // 2 for length in surface.shape)
    return Sample(surface.model, {name: values[at] for name, values in surface.values.items()})


def _heights(lever: Any, material: Any, bounds: tuple[float, float] | None, points: int) -> Any:
    """Return the heights of the curve [m], falling."""
    import math

    import numpy as np

    from overtone.dynamics.hold import hold_amplitude

    if bounds is None:
        free = lever.drive.free_amplitude
        low = float(hold_amplitude(lever, material, setpoint=_LOWEST_SETPOINT)["Z"])
        bounds = (low if math.isfinite(low) else _LOWEST_SETPOINT * free, _FARTHEST * free)
    return np.linspace(bounds[1], bounds[0], points)


# --- what is written and printed -------------------------------------------------------------------


def _write(made: dict[str, Any], files: dict[str, Path | None]) -> list[Path]:
    """Write every file that was asked for, or none."""
    from overtone.io.atomic import atomic_path
    from overtone.io.export import save

    written = []
    with ExitStack() as stack:
        # an Igor wave holds its own name, which is not to be that of a temporary file
        for option, path in sorted(
            files.items(), key=lambda entry: entry[1] is not None and entry[1].suffix == ".ibw"
        ):
            if path is not None:
                wave = path.suffix.lower() == ".ibw"
                save(made[option], path if wave else stack.enter_context(atomic_path(path)))
                written.append(path)
    return written


def _print(
    result: Any,
    lever: Any,
    device: Any,
    ground: tuple[Any, dict[str, Any]],
    setpoint: float,
    said: list[str],
    written: list[Path],
) -> None:
    from overtone import provenance

    console = Console(highlight=False)
    passes = 2 if "lift_height" in result.attrs else 1
    rows, columns = result.sizes["y"], result.sizes["x"]
    held = format_quantity(setpoint * lever.drive.free_amplitude, "m")
    lines = [
        f"{columns} x {rows} pixels at A1 = {held} ({setpoint:g} A1far), "
        f"{format_quantity(rows * passes * device.line_time, 's')} of scanning",
        *(f"- {sentence}" for sentence in (*provenance.findings(result), *said)),
        *(f"wrote {path}" for path in written),
    ]
    for line in lines:
        console.print(line, soft_wrap=True, markup=False)
