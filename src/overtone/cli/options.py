"""Options that several commands share, and the reading of their values."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from cyclopts import Parameter

from overtone.errors import OvertoneError
from overtone.units import format_quantity, parse_quantity


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
    """Channel=value of one count or one volt, for example M2A="1 nm" or Amplitude="62 nm/V"; may be repeated."""
    far_phase: Annotated[str | None, Parameter(name="--far-phase")] = None
    """Reading of the phase channel far from the surface, for example "88.2 deg"."""
    phase_sign: Annotated[int, Parameter(name="--phase-sign")] = 1
    """1 where stored phases are lags, -1 where they are leads."""
    direction: Annotated[str | None, Parameter(name="--direction")] = None
    """trace or retrace, approach or retract, where the file holds both."""
    corrected: Annotated[bool, Parameter(name="--corrected", negative=())] = False
    """A0 and the higher harmonics were corrected for offset and detector distortion beforehand."""
    frame: Annotated[int | None, Parameter(name="--frame")] = None
    """Which frame of a video, from 1."""


@Parameter(name="*")
@dataclass(frozen=True)
class ProbeOptions:
    """The probe: a file, or a preset with what was measured."""

    probe: Annotated[str, Parameter(name="--probe")]
    """Probe file (TOML), or the name of a preset such as PPP-NCHR."""
    free_amplitude: Annotated[str | None, Parameter(name="--free-amplitude")] = None
    """Amplitude A1 far from the sample, for example "40 nm"; a preset has none of its own."""
    drive_frequency: Annotated[str | None, Parameter(name="--drive-frequency")] = None
    """For example "299.5 kHz"; a preset is driven at its resonance unless given."""
    radius: Annotated[str | None, Parameter(name="--radius")] = None
    """Tip radius, for example "10 nm"."""
    stiffness: Annotated[str | None, Parameter(name="--stiffness")] = None
    """Measured stiffness of a preset, for example "36 N/m"."""
    frequency: Annotated[str | None, Parameter(name="--frequency")] = None
    """Measured resonance of a preset, for example "312 kHz"."""
    quality_factor: Annotated[float | None, Parameter(name="--quality-factor")] = None
    """Measured quality factor of a preset."""


def open_probe(options: ProbeOptions) -> Any:
    """Return the probe of a file or of a preset, with what the options replace."""
    from dataclasses import replace

    from overtone.presets import preset
    from overtone.probe import load_probe

    names = {
        "free_amplitude": "m",
        "drive_frequency": "Hz",
        "radius": "m",
        "stiffness": "N/m",
        "frequency": "Hz",
    }
    given: dict[str, Any] = {}
    for name, unit in names.items():
        text = getattr(options, name)
        if text is not None:
            given[name] = parse_quantity(text, unit, _option(name))
    if options.quality_factor is not None:
        given["quality_factor"] = options.quality_factor
    path = Path(options.probe)
    if path.suffix.lower() == ".toml" or path.is_file():
        probe = load_probe(path)
        excess = [name for name in ("stiffness", "frequency", "quality_factor") if name in given]
        if excess:
            raise OvertoneError(
                f"{_option(excess[0])} is for presets",
                got=f"the probe file {path.name}",
                hint="the value in the file itself",
            )
        drive = {
            field: given[name]
            for field, name in (("frequency", "drive_frequency"), ("free_amplitude", "free_amplitude"))
            if name in given
        }
        tip = {"radius": given["radius"]} if "radius" in given else {}
        return replace(probe, drive=replace(probe.drive, **drive), tip=replace(probe.tip, **tip))
    if "free_amplitude" not in given:
        preset(options.probe, free_amplitude=1e-9)  # a name that is none is the first thing to say
        raise OvertoneError(
            f"the preset {options.probe} has no free amplitude",
            expected="the amplitude far from the sample",
            hint='--free-amplitude "40 nm"',
        )
    return preset(options.probe, **given)


def open_sample(text: str) -> Any:
    """Return the material that a text such as "hertz, modulus=1 GPa, poisson_ratio=0.3" or a TOML file describes."""
    import tomllib

    path = Path(text)
    if path.suffix.lower() != ".toml":
        model, *pairs = (part.strip() for part in text.split(","))
        if "=" in model:
            raise OvertoneError(
                "--sample does not begin with a model",
                expected='text such as "hertz, modulus=1 GPa, poisson_ratio=0.3"',
                got=repr(text),
                hint="overtone models",
            )
        return _material(model, parse_pairs([pair for pair in pairs if pair], "--sample"), "--sample")
    try:
        table = tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise OvertoneError(
            f"cannot read the sample file {path}", got=error.strerror or str(error), hint="check the path"
        ) from error
    except ValueError as error:
        raise OvertoneError(f"{path.name} is not TOML", got=str(error)) from error
    model = table.pop("model", None)
    if not isinstance(model, str):
        raise OvertoneError(
            f"{path.name} names no model", expected='a line such as model = "dmt"', hint="overtone models"
        )
    return _material(model, table, path.name)


def _material(key: str, texts: Mapping[str, Any], source: str) -> Any:
    """Return a material from texts with units; where they do not fit the model, say what it takes."""
    from overtone.contact.models import contact_model
    from overtone.contact.sample import OF_THE_PROBE, sample

    parameters = [q for q in contact_model(key).parameters if q.name not in OF_THE_PROBE]
    units = {q.name: "1" if "^p" in q.unit else q.unit for q in parameters}
    wanted = ", ".join(
        q.name + (f" [{q.unit}]" if q.unit != "1" else "") for q in parameters if q.default is None
    )
    optional = "".join(
        f"; {q.name} is {format_quantity(q.default, q.unit)} unless given"
        for q in parameters
        if q.default is not None
    )
    for name in texts:
        if name not in units:
            of_the_probe = name in OF_THE_PROBE
            raise OvertoneError(
                f"{name} belongs to the probe" if of_the_probe else f"model {key!r} has no {name}",
                expected=wanted + optional,
                hint=f"{_option(name)}, or the probe file" if name == "radius" else None,
            )
    missing = [q.name for q in parameters if q.default is None and q.name not in texts]
    if missing:
        raise OvertoneError(
            f"model {key!r} needs {' and '.join(missing)}",
            expected=wanted + optional,
            got=", ".join(texts) or "none of them",
            hint=f'--sample "{key}, '
            + ", ".join(f"{q.name}={_example(q)}" for q in parameters if q.default is None)
            + '"',
        )
    values = {name: parse_quantity(text, units[name], f"{name} in {source}") for name, text in texts.items()}
    return sample(key, **values)


def _example(parameter: Any) -> str:
    text = format_quantity(parameter.example, parameter.unit)
    return text.removesuffix(" N/m^p")


def _option(name: str) -> str:
    return "--" + name.replace("_", "-")


def parse_pairs(texts: Sequence[str], option: str) -> dict[str, str]:
    """Return NAME=VALUE texts as a dictionary."""
    pairs = {}
    for text in texts:
        name, equals, value = text.partition("=")
        if not equals or not name.strip() or not value.strip():
            raise OvertoneError(f"{option} is not a pair", expected="NAME=VALUE", got=repr(text))
        pairs[name.strip()] = value.strip()
    return pairs


def parse_rectangle(text: str, option: str, besides: str = "") -> tuple[float, float, float, float]:
    """Return the corners x0, y0, x1, y1 [m] of a text such as "0 um, 0 um, 2 um, 1 um".

    ``besides`` says what else the option takes.
    """
    parts = [part.strip() for part in text.split(",")]
    if len(parts) != 4:
        raise OvertoneError(
            f"{option} is not understood",
            expected=f'{besides}"x0, y0, x1, y1" with units',
            got=repr(text),
            hint=f'{option} "0 um, 0 um, 2 um, 1 um"',
        )
    x0, y0, x1, y1 = (parse_quantity(part, "m", option) for part in parts)
    return x0, y0, x1, y1


def reading_arguments(options: ScanOptions) -> dict[str, Any]:
    """Return what the options say of reading a file, as the arguments of `open_scan` and `open_curve`."""
    from overtone.probe import load_probe

    scales = {}
    for name, text in parse_pairs(options.scale, "--scale").items():
        match = text.rsplit(maxsplit=1)[-1]
        unit = "rad" if match in ("deg", "rad", "mrad", "°") else "m/V" if match.endswith("/V") else "m"
        scales[name] = parse_quantity(text, unit, f"--scale {name}")
    return {
        "probe": load_probe(options.probe) if options.probe else None,
        "channels": parse_pairs(options.channel, "--channel"),
        "scales": scales,
        "far_phase": parse_quantity(options.far_phase, "rad", "--far-phase") if options.far_phase else None,
        "phase_sign": options.phase_sign,
        "corrected": options.corrected,
    }


def open_with(
    path: Path, options: ScanOptions, *, probe: Any = None, lift: bool = False, keep_offset: bool = False
) -> Any:
    """Open a scan as the options say and return its observables, the tip radius set.

    ``probe`` stands in where the options name none; ``lift`` and ``keep_offset`` are those of `open_scan`.
    """
    from overtone.batch.opened import with_radius
    from overtone.io.observables import open_scan

    arguments = reading_arguments(options)
    arguments["probe"] = arguments["probe"] or probe
    observables = open_scan(
        path,
        direction=options.direction,
        frame=options.frame,
        lift=lift,
        keep_offset=keep_offset,
        **arguments,
    )
    return with_radius(observables, radius_of(options))


def radius_of(options: ScanOptions) -> float | None:
    """Return the tip radius [m] that the options give, None where they give none."""
    return parse_quantity(options.radius, "m", "--radius") if options.radius else None
