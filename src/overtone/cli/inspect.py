"""``overtone inspect``."""

from __future__ import annotations

from pathlib import Path

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from overtone.cli.options import ScanOptions, open_with
from overtone.errors import OvertoneError
from overtone.units import display_unit, format_quantity


def inspect(file: Path, /, *, scan: ScanOptions = ScanOptions()) -> None:  # noqa: B008 - a frozen record
    """Say what a file holds, what is missing, what to ask the operator for, and what it can give.

    Parameters
    ----------
    file : Path
        Scan, curve or table: .ibw, a neaSNOM folder, netCDF, CSV.
    scan : ScanOptions
        How the file is to be read.
    """
    import numpy as np

    from overtone import provenance
    from overtone.io.observables import missing_for_modulus
    from overtone.io.registry import read_channels
    from overtone.io.vendors import vendor_of

    recording = read_channels(file)
    console = Console()
    sizes = (
        " x ".join(str(size) for size in recording.channels[0].values.shape)
        if recording.channels
        else "no data"
    )
    console.print(
        f"{file.name}: {recording.format}, {vendor_of(recording).title}, {sizes} over {recording.dims}",
        markup=False,
    )
    used: dict[str, str] = {}
    verdict: list[str] = []
    try:
        observables = open_with(file, scan)
        used = {str(array.attrs["channel"]): str(name) for name, array in observables.data_vars.items()}
        verdict = [
            *provenance.findings(observables),
            "can give: force and energy of the first harmonic, regime.",
        ]
        lacking = missing_for_modulus(observables)
        verdict.append(
            lacking + "." if lacking else "a modulus needs the tip radius and the Poisson ratio as well."
        )
    except OvertoneError as error:
        verdict = [*recording.notes, f"cannot be mapped as it is: {error}"]
    channels = Table(title="Channels")
    for heading in ("channel", "unit", "line", "used as", "mean", "range", "remark"):
        channels.add_column(heading, overflow="fold")
    for channel in recording.channels:
        values = channel.values[np.isfinite(channel.values)]
        remarks = [text for text, on in (("Nap pass", channel.nap), ("flattened", channel.flattened)) if on]
        lost = channel.values.size - values.size
        remarks += [f"{lost} invalid pixels"] if lost else []
        mean = span = "-"
        if values.size:
            low, high = float(values.min()), float(values.max())
            display = display_unit(max(abs(low), abs(high)), channel.unit or "1")
            mean = f"{values.mean() * display.factor:.4g} {display.label}"
            span = f"{low * display.factor:.4g} .. {high * display.factor:.4g}"
        role = "" if channel.nap else used.get(channel.name, "")
        cells = (
            channel.name,
            channel.unit or "none",
            channel.direction or "",
            role,
            mean,
            span,
            ", ".join(remarks),
        )
        channels.add_row(*map(escape, cells))
    console.print(channels)
    if recording.facts or recording.resonances:
        facts = Table(title="Instrument")
        for heading in ("quantity", "value", "key in the file", "remark"):
            facts.add_column(heading, overflow="fold")
        for name, fact in recording.facts.items():
            remark = "factory default" if fact.factory_default else ""
            facts.add_row(name.replace("_", " "), _text(fact.value, fact.unit), escape(fact.key), remark)
        for pair in recording.resonances:
            value = f"{pair.frequency / 1e3:.3f} kHz, Q {pair.quality_factor:g}"
            remark = "factory default" if pair.factory_default else ""
            facts.add_row(f"resonance ({pair.source})", value, escape(", ".join(pair.keys)), remark)
        console.print(facts)
    for sentence in verdict:
        console.print(f"- {sentence}", markup=False, highlight=False)


def _text(value: float, unit: str) -> str:
    if unit == "m/V":
        return f"{value * 1e9:.5g} nm/V"
    return format_quantity(value, unit, 5)
