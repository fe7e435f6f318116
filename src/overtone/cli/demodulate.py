"""``overtone demodulate``: a recorded deflection becomes observables."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Annotated, Any

from cyclopts import Parameter
from rich.console import Console
from rich.table import Table

from overtone.cli.options import parse_pairs
from overtone.cli.progress import progress_bar
from overtone.errors import OvertoneError
from overtone.units import format_quantity, parse_quantity


def demodulate(
    file: Path,
    /,
    *,
    output: Annotated[Path, Parameter(name=["--output", "-o"])],
    bandwidth: str,
    drive_frequency: str | None = None,
    harmonics: str = "0,1,2,3",
    channel: Annotated[tuple[str, ...], Parameter(name="--channel")] = (),
    sensitivity: str | None = None,
    sampling_rate: str | None = None,
    track: str | None = None,
    reference: Annotated[tuple[str, ...], Parameter(name="--reference")] = (),
    output_rate: str | None = None,
    probe: Path | None = None,
) -> None:
    """Demodulate a recorded deflection: amplitudes and phases of all harmonics over time.

    Parameters
    ----------
    file : Path
        Trace: CSV with units in its header, .ibw, netCDF.
    output : Path
        Observables, a netCDF file that "overtone map" and ot.open_scan read.
    bandwidth : str
        Equivalent noise bandwidth of the low-pass, for example "1 kHz".
    drive_frequency : str
        Where the drive is to be looked for, within 5 %; that of the probe, or the strongest line unless given.
    harmonics : str
        Which harmonics, 1 among them.
    channel : tuple
        deflection=NAME, drive=NAME or time=NAME; may be repeated.
    sensitivity : str
        Deflection per volt, for example "60 nm/V".
    sampling_rate : str
        For files that do not know, for example "2 MHz".
    track : str
        How the phase of the drive is known: drive (a channel, the default where there is one), constant (the default
        without), linear, follow, or none: exactly --drive-frequency.
    reference : tuple
        When the lever is free, for example "0 ms to 20 ms"; may be repeated.
    output_rate : str
        Outputs a second, about twice the bandwidth unless given.
    probe : Path
        Probe file (TOML). With --reference phi1 is referred to the free lever.
    """
    from overtone import provenance
    from overtone.harmonics import far_phase
    from overtone.instrument.demodulate import demodulate as demodulated
    from overtone.io.atomic import atomic_path
    from overtone.io.netcdf import save
    from overtone.io.traces import read_trace
    from overtone.probe import load_probe
    from overtone.readings import Reading, with_reading

    _check_output(output, [path for path in (file, probe) if path is not None])
    rates = {
        name: None if text is None else parse_quantity(text, "Hz", f"--{name.replace('_', '-')}")
        for name, text in (
            ("drive_frequency", drive_frequency),
            ("sampling_rate", sampling_rate),
            ("output_rate", output_rate),
        )
    }
    width = parse_quantity(bandwidth, "Hz", "--bandwidth")
    orders, spans = _orders(harmonics), [_span(text) for text in reference]
    lever = None if probe is None else load_probe(probe)
    if lever is not None and rates["drive_frequency"] is None:
        rates["drive_frequency"] = lever.drive.frequency
    deflection, drive = read_trace(
        file,
        channels=parse_pairs(channel, "--channel"),
        sensitivity=None if sensitivity is None else parse_quantity(sensitivity, "m/V", "--sensitivity"),
        sampling_rate=rates["sampling_rate"],
    )
    referred = lever is not None and bool(spans)
    with progress_bar() as update:
        result = demodulated(
            deflection,
            bandwidth=width,
            drive=drive,
            harmonics=orders,
            track=track,
            reference=spans or None,
            reference_phase=far_phase(lever) if lever is not None and referred else None,
            progress=partial(update, "demodulating"),
            **rates,
        )
    if lever is not None:
        result = with_reading(result, Reading(lever, phase_established=referred)).assign_attrs(
            detector=lever.detector.kind
        )
    result = result.assign_attrs(source=file.name)
    with atomic_path(output) as temporary:
        save(result, temporary)
    console = Console(highlight=False)
    _print_summary(console, file, result)
    for sentence in provenance.findings(result):
        console.print(f"- {sentence}", markup=False, soft_wrap=True)
    console.print(f"wrote {output}", soft_wrap=True, markup=False)


def _check_output(output: Path, inputs: Sequence[Path]) -> None:
    """Refuse an output that could not be written, or would replace an input."""
    if output.suffix.lower() != ".nc":
        raise OvertoneError(f"{output.name} is no name for a result", expected="a name that ends in .nc")
    if not output.parent.is_dir():
        raise OvertoneError(f"the folder {output.parent} does not exist", hint="create it first")
    if output.is_dir():
        raise OvertoneError(f"{output} is a folder", expected="the name of a file")
    if any(output.resolve() == path.resolve() for path in inputs):
        raise OvertoneError(f"{output} is the trace itself", expected="another name for the result")


def _orders(text: str) -> tuple[int, ...]:
    try:
        return tuple(int(part) for part in text.split(","))
    except ValueError as error:
        raise OvertoneError("--harmonics is not a list", expected="0,1,2,3", got=repr(text)) from error


def _span(text: str) -> tuple[float, float]:
    """Return start and stop of a window of time [s]."""
    start, to, stop = text.partition(" to ")
    if not to:
        raise OvertoneError(
            "--reference is no window", expected='text such as "0 ms to 20 ms"', got=repr(text)
        )
    return parse_quantity(start, "s", "--reference"), parse_quantity(stop, "s", "--reference")


def _print_summary(console: Console, file: Path, result: Any) -> None:
    import numpy as np

    from overtone.instrument.demodulate import noise_of

    attributes = result.attrs
    time = result["time"].values
    console.print(
        f"{file.name}: drive at {format_quantity(attributes['drive_frequency'], 'Hz', 9)}, "
        f"drift {attributes['frequency_drift']:.3g} Hz/s, track {attributes['track']}",
        markup=False,
        soft_wrap=True,
    )
    console.print(
        f"{time.size} outputs from {format_quantity(float(time[0]), 's')} to {format_quantity(float(time[-1]), 's')}, "
        f"bandwidth {format_quantity(attributes['bandwidth'], 'Hz')}, {attributes['filter']}",
        markup=False,
        soft_wrap=True,
    )
    table = Table(box=None, pad_edge=False, padding=(0, 2, 0, 0))
    for heading in ("", "median", "least", "most", "noise"):
        table.add_column(heading, overflow="fold")
    noise = noise_of(result)
    for name, array in result.data_vars.items():
        unit = array.attrs["units"]
        values = (np.median(array.values), array.values.min(), array.values.max())
        cells = [format_quantity(float(value), unit, 4) for value in values]
        sigma = noise.get(str(name))
        table.add_row(str(name), *cells, "" if sigma is None else format_quantity(sigma, unit, 3))
    console.print()
    console.print(table)
    console.print()
    stated = (f'--noise {name}="{_quoted(name, sigma)}"' for name, sigma in noise.items())
    console.print("for overtone map: " + " ".join(stated), markup=False, soft_wrap=True)


def _quoted(name: str, sigma: float) -> str:
    return format_quantity(sigma, "rad" if name.startswith("phi") else "m", 3)
