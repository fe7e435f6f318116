"""``overtone plan``: what a measurement will tell, before it is made."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

from cyclopts import Parameter
from rich.console import Console
from rich.table import Table

from overtone.cli.options import ProbeOptions, open_probe, open_sample
from overtone.cli.progress import progress_bar
from overtone.errors import OvertoneError
from overtone.units import format_quantity, parse_quantity

_FIGURES = {".png": "png", ".svg": "svg", ".pdf": "pdf"}
_MOST_POINTS = 100
_WIDE = 100.0  # a factor beyond says no more than that
_SHORT_NAMES = {"E": "modulus", "nu": "poisson_ratio", "Fad": "adhesion", "eta": "viscosity"}


def plan(
    *,
    probe: ProbeOptions,
    sample: str,
    setpoint: str = "0.3 .. 0.9",
    points: int = 12,
    lever: Annotated[tuple[str, ...], Parameter(name="--lever")] = (),
    calibration: str = "ordinary",
    noise: Annotated[tuple[str, ...], Parameter(name="--noise")] = (),
    model: str | None = None,
    harmonics: str | None = None,
    output: Annotated[Path | None, Parameter(name=["--output", "-o"])] = None,
    figure: Path | None = None,
) -> None:
    """Tell what lever, free amplitude and set-point will tell of a material, before it is measured.

    Parameters
    ----------
    probe : ProbeOptions
        The probe. Its --free-amplitude may be a range, "20 nm .. 100 nm".
    sample : str
        Contact model and parameters, "dmt, E=2 GPa, nu=0.35, Fad=8 nN", or a TOML file.
    setpoint : str
        A1/A1far, such as "0.3 .. 0.9", "0.4, 0.6" or "0.5".
    points : int
        How many set-points, and free amplitudes, of a range.
    lever : tuple
        Another lever to compare with, a probe file or preset; may be repeated.
    calibration : str
        none, ordinary, careful, perfect (noise only), or the file of a calibration.
    noise : tuple
        Standard deviation of an observable, for example A0="5 pm"; may be repeated. Or
        "bandwidth=500 Hz, detector=50 fm/rtHz". An ordinary one is assumed elsewhere.
    model : str
        Contact model that the readings will be inverted with; that of the sample unless given.
    harmonics : str
        Harmonics that will be measured, for example 0,1,2; 0 to 3 unless given.
    output : Path
        Result, a netCDF file.
    figure : Path
        Figure (.png, .svg, .pdf).
    """
    from overtone import provenance
    from overtone.io.netcdf import save
    from overtone.planning.choice import best_choice
    from overtone.planning.experiment import plan_experiment

    _check_paths(output, figure, [probe.probe, sample, calibration, *lever])
    if not 1 < points <= _MOST_POINTS:
        raise OvertoneError("--points is out of range", expected=f"2 to {_MOST_POINTS}", got=str(points))
    setpoints = _range(setpoint, "1", "--setpoint", points)
    amplitudes = None
    if probe.free_amplitude is not None:
        amplitudes = _range(probe.free_amplitude, "m", "--free-amplitude", points)
        probe = replace(probe, free_amplitude=f"{amplitudes[0]!r} m")
    main = open_probe(probe)
    others = _others(lever, main.drive.free_amplitude)
    material = open_sample(_in_long_names(sample))
    known = _calibration(calibration)
    sigma, remark = _noise(noise, main, amplitudes or [main.drive.free_amplitude], setpoints)
    with progress_bar() as update:
        result = plan_experiment(
            main,
            material,
            setpoint=setpoints,
            free_amplitude=amplitudes,
            probes=others,
            noise=sigma,
            calibration=known,
            model=model,
            harmonics=_orders(harmonics),
            progress=lambda done, count: update("planning", done, count),
        )
    choice = best_choice(result)
    said = (
        list(choice.sentences) if choice else ["No feedback holds a repulsive state anywhere in this range."]
    )
    result = provenance.add_finding(result, *said, remark)
    written = []
    if figure is not None:
        _draw(result, choice, figure)
        written.append(figure)
    if output is not None:
        save(result, output)
        written.append(output)
    _print(Console(highlight=False), result, [*said, remark], written)


# --- what was asked for ---------------------------------------------------------------------------


def _check_paths(output: Path | None, figure: Path | None, inputs: Sequence[str]) -> None:
    """Refuse outputs that could not be written, or would replace an input or each other."""
    taken = {Path(text).resolve() for text in inputs}
    for option, path, endings in (("--output", output, (".nc",)), ("--figure", figure, tuple(_FIGURES))):
        if path is None:
            continue
        if path.suffix.lower() not in endings:
            raise OvertoneError(
                f"{path.name} is no name for {option}", expected=f"a name that ends in {' or '.join(endings)}"
            )
        if not path.parent.is_dir():
            raise OvertoneError(f"the folder {path.parent} does not exist", hint="create it first")
        if path.is_dir():
            raise OvertoneError(f"{path} is a folder", expected="the name of a file")
        if path.resolve() in taken:
            raise OvertoneError(f"{path} is taken", expected="a name of its own for each file")
        taken.add(path.resolve())


def _range(text: str, unit: str, option: str, points: int) -> list[float]:
    """Return the values of "a .. b", "a to b", "a, b, c" or "a" [SI]."""
    import numpy as np

    ends = re.split(r"\s*\.\.\s*|\s+to\s+", text.strip())
    if len(ends) > 2 or not all(ends):
        example = '"0.3 .. 0.9"' if unit == "1" else '"20 nm .. 100 nm"'
        raise OvertoneError(f"{option} is no range", expected=f"text such as {example}", got=repr(text))
    if len(ends) == 1:
        return [parse_quantity(part, unit, option) for part in text.split(",")]
    low, high = (parse_quantity(end, unit, option) for end in ends)
    if not low < high:
        raise OvertoneError(f"{option} is no range", expected="the lower end first", got=repr(text))
    return [float(value) for value in np.linspace(low, high, points)]


def _others(texts: Sequence[str], free_amplitude: float) -> dict[str, Any]:
    """Return other levers by the names of their files or presets."""
    levers: dict[str, Any] = {}
    for text in texts:
        name = Path(text).stem if text.lower().endswith(".toml") else text
        if name in levers:
            raise OvertoneError(
                "two levers have one name", got=name, hint="another name for one of the files"
            )
        levers[name] = open_probe(ProbeOptions(text, free_amplitude=f"{free_amplitude!r} m"))
    return levers


def _in_long_names(text: str) -> str:
    """Return the text of a sample with E, nu, Fad and eta written out."""
    if text.lower().endswith(".toml"):
        return text
    names = "|".join(_SHORT_NAMES)
    return re.sub(rf"(?<=,)(\s*)({names})(?=\s*=)", lambda m: m.group(1) + _SHORT_NAMES[m.group(2)], text)


def _calibration(text: str) -> Any:
    """Return the calibration of a file, or the word for one."""
    from overtone.instrument.calibration import load_calibration
    from overtone.planning.quality import QUALITIES

    if text in QUALITIES:
        return text
    if Path(text).suffix.lower() not in (".toml", ".json"):
        raise OvertoneError(
            "--calibration is not understood",
            expected=f"{', '.join(QUALITIES)}, or a file that overtone calibrate wrote",
            got=repr(text),
            hint="--calibration careful",
        )
    return load_calibration(text)


def _noise(
    texts: Sequence[str], probe: Any, amplitudes: Sequence[float], setpoints: Sequence[float]
) -> tuple[dict[str, float], str]:
    """Return the noise that is to be expected, and a sentence about it."""
    import numpy as np
    import xarray as xr

    from overtone.batch.noise import PAIR, SCATTER, noise_request, resolve_noise

    request = noise_request(texts)
    if request.source in (SCATTER, PAIR):
        raise OvertoneError(
            f"--noise {request.source} is told from a scan",
            expected="what can be known before there is one",
            hint='--noise A0="5 pm", or --noise "bandwidth=500 Hz, detector=50 fm/rtHz"',
        )
    # as loud as the phase gets: that of the smallest amplitude
    read = min(amplitudes) * min(setpoints)
    names = ("A0", "A1", "phi1", "A2", "phi2", "A3", "phi3")
    return resolve_noise(request, xr.Dataset({name: ("point", np.array([read])) for name in names}), probe)


def _orders(text: str | None) -> tuple[int, ...] | None:
    if text is None:
        return None
    try:
        orders = tuple(int(part) for part in text.split(","))
    except ValueError as error:
        raise OvertoneError("--harmonics is not a list", expected="0,1,2", got=repr(text)) from error
    if min(orders) < 0:
        raise OvertoneError("--harmonics is not a list", expected="0,1,2", got=repr(text))
    return orders


# --- what is said and written ---------------------------------------------------------------------


def _print(console: Console, plan: Any, said: Sequence[str], written: Sequence[Path]) -> None:
    from overtone.planning.choice import best_of_each, elastic_of

    console.print(
        f"{plan.attrs['sample']}; {plan.attrs['calibration_assumed']}", markup=False, soft_wrap=True
    )
    first = elastic_of(plan)
    rows, two = best_of_each(plan), False
    for name in plan["lever"].values:
        table = Table(box=None, pad_edge=False, padding=(0, 2, 0, 0))
        for heading in (
            "A1far",
            "A1/A1far",
            f"{first}, 90 %",
            "factor",
            "limited by",
            "adhesion, 90 %",
            "F max",
        ):
            if not heading.startswith("adhesion") or "adhesion_lower" in plan:
                table.add_column(heading, no_wrap=True)
        for lever, A, cell in rows:
            if lever == str(name):
                table.add_row(
                    format_quantity(A, "m"), *(_cells(cell) if cell is not None else ["-", "no state"])
                )
                two = two or (cell is not None and bool(cell["bistable"]))
        console.print()
        if plan.sizes["lever"] > 1:
            console.print(str(name), markup=False)
        console.print(table)
    if two:
        console.print("* a stable attractive state has the same set-point", markup=False)
    console.print()
    for sentence in said:
        console.print(f"- {sentence}", markup=False, soft_wrap=True)
    for path in written:
        console.print(f"wrote {path}", soft_wrap=True, markup=False)


def _cells(cell: Any) -> list[str]:
    """Return the row of the best set-point at one free amplitude."""
    from overtone.inversion.result import DETERMINED
    from overtone.planning.choice import decided_by, elastic_of

    first = elastic_of(cell)
    factor = float(cell["interval_factor"])
    told = int(cell["status"]) == DETERMINED
    row = [
        f"{float(cell['setpoint']):.2g}{'*' if bool(cell['bistable']) else ''}",
        _interval(cell, first) if told else "not determined",
        _short(factor) if factor < _WIDE else f"> {_WIDE:g}",
        decided_by(cell),
    ]
    if "adhesion_lower" in cell:
        row.append(_interval(cell, "adhesion"))
    return [*row, format_quantity(float(cell["peak_force"]), "N")]


def _interval(cell: Any, name: str) -> str:
    from overtone.units import display_unit

    unit = str(cell[f"{name}_lower"].attrs["units"])
    low, high = float(cell[f"{name}_lower"]), float(cell[f"{name}_upper"])
    display = display_unit(high, unit)
    return f"{_short(low * display.factor)} .. {_short(high * display.factor)} {display.label}"


def _short(value: float) -> str:
    """Write two digits, without powers of ten."""
    return f"{float(f'{value:.2g}'):g}"


def _draw(plan: Any, choice: Any, path: Path) -> None:
    from overtone.io.atomic import atomic_path
    from overtone.plots.canvas import TEXTS, png_bytes
    from overtone.plots.plan import plan_figure

    picture = plan_figure(plan, choice, f"{plan.attrs['sample']}; {plan.attrs['calibration_assumed']}")
    kind = _FIGURES[path.suffix.lower()]
    with atomic_path(path) as temporary:
        if kind == "png":
            temporary.write_bytes(png_bytes(picture))
            return
        undated = {"svg": {"Date": None}, "pdf": {"CreationDate": None}}[kind]
        with TEXTS:
            picture.savefig(temporary, format=kind, metadata=undated)
