"""Options that several commands share, and the reading of their values."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from cyclopts import Parameter

from overtone.errors import OvertoneError
from overtone.units import parse_quantity


@Parameter(name="*")
@dataclass(frozen=True)
class ScanOptions:
    """How a file is to be read."""

    probe: Annotated[Path | None, Parameter(name="--probe")] = None
    """Probe file (TOML). Without it the probe is built from the scan file."""
    radius: Annotated[str | None, Parameter(name="--radius")] = None
    """Tip radius with its unit, for example "10 nm"."""
    channel: Annotated[tuple[str, ...], Parameter(name="--channel")] = ()
    """Observable=channel, for example A2=UserIn0; may be repeated."""
    scale: Annotated[tuple[str, ...], Parameter(name="--scale")] = ()
    """Channel=value of one count, for example M2A="1 nm"; may be repeated."""
    far_phase: Annotated[str | None, Parameter(name="--far-phase")] = None
    """Reading of the phase channel far from the surface, for example "88.2 deg"."""
    phase_sign: Annotated[int, Parameter(name="--phase-sign")] = 1
    """1 where stored phases are lags, -1 where they are leads."""
    direction: Annotated[str | None, Parameter(name="--direction")] = None
    """trace or retrace, where the file holds both."""
    corrected: Annotated[bool, Parameter(name="--corrected", negative=())] = False
    """A0 and the higher harmonics were corrected for offset and detector distortion beforehand."""


def parse_pairs(texts: Sequence[str], option: str) -> dict[str, str]:
    """Return NAME=VALUE texts as a dictionary."""
    pairs = {}
    for text in texts:
        name, equals, value = text.partition("=")
        if not equals or not name.strip() or not value.strip():
            raise OvertoneError(f"{option} is not a pair", expected="NAME=VALUE", got=repr(text))
        pairs[name.strip()] = value.strip()
    return pairs


def open_with(path: Path, options: ScanOptions) -> Any:
    """Open a scan as the options say and return its observables, the tip radius set."""
    from dataclasses import replace

    from overtone.io.observables import open_scan
    from overtone.probe import load_probe
    from overtone.readings import reading_of, with_reading

    channels = parse_pairs(options.channel, "--channel")
    scales = {}
    for name, text in parse_pairs(options.scale, "--scale").items():
        match = text.rsplit(maxsplit=1)[-1]
        unit = "rad" if match in ("deg", "rad", "mrad", "°") else "m"
        scales[name] = parse_quantity(text, unit, f"--scale {name}")
    observables = open_scan(
        path,
        probe=load_probe(options.probe) if options.probe else None,
        channels=channels,
        scales=scales,
        far_phase=parse_quantity(options.far_phase, "rad", "--far-phase") if options.far_phase else None,
        phase_sign=options.phase_sign,
        direction=options.direction,
        corrected=options.corrected,
    )
    reading = reading_of(observables)
    if options.radius and reading is not None:
        tip = replace(reading.probe.tip, radius=parse_quantity(options.radius, "m", "--radius"))
        observables = with_reading(observables, replace(reading, probe=replace(reading.probe, tip=tip)))
    return observables


def parse_noise(texts: Sequence[str]) -> dict[str, float]:
    """Return --noise A0="5 pm" options in SI units."""
    from overtone.quantities import quantity

    noise = {}
    for name, text in parse_pairs(texts, "--noise").items():
        record = quantity(name)
        if record is None or record.kind != "observable":
            raise OvertoneError(f"--noise {name} is not an observable", expected="A0, A1, phi1, A2, ...")
        noise[name] = parse_quantity(text, record.unit, f"--noise {name}")
    return noise
