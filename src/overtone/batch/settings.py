"""What is asked of every map, as one record: it travels to other processes, and a result remembers it."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from overtone.batch.noise import NoiseRequest, noise_request
from overtone.errors import OvertoneError

if TYPE_CHECKING:
    from overtone.probe import Probe

POPULATION = "population"


@dataclass(frozen=True)
class Settings:
    """How scans are read, corrected and mapped.

    Parameters
    ----------
    probe : Probe, optional
        The probe; without it, it is built from each file.
    radius : float, optional
        Tip radius [m], in place of that of the probe.
    channels, scales : mapping
        As `overtone.open_scan` takes them: observable to channel, and channel to the SI value of one count.
    far_phase : float, optional
        Reading of the phase channel far from the surface [rad].
    phase_sign : int
        1 where the stored phases are lags, -1 where they are leads.
    direction : str, optional
        ``trace`` or ``retrace``, where a file holds both.
    corrected : bool
        True states that A0 and the higher harmonics were corrected beforehand.
    frame : int, optional
        Which frame of a video, from 1.
    calibration : Path, optional
        Calibration of the instrument that scans are corrected with first.
    reference_area : str, tuple or None
        Where its reference material is: ``auto``, None for nowhere, or (x0, y0, x1, y1) [m].
    lift : bool
        Whether the lift (Nap) pass takes part in the correction.
    model : str, optional
        Contact model; ``dmt`` unless given, where a modulus can be mapped.
    method, harmonics, poisson_ratio, priors, motion, given
        As `overtone.map_properties` takes them.
    noise : mapping, str or None
        Standard deviation of observables [m, rad]; or a source, ``scatter``, ``pair``, or
        ``bandwidth=500 Hz, detector=50 fm/rtHz``.
    phases : int or Path, optional
        Population: number of phases, or a file with labels.
    reference : Reference, optional
        Population: a material in the scan whose modulus is known.
    reference_pixels : tuple or Path, optional
        Population: where it is, a rectangle (x0, y0, x1, y1) [m] or a file with a mask.
    seed : int
        Population: of its random draws.
    """

    probe: Probe | None = None
    radius: float | None = None
    channels: Mapping[str, str] = field(default_factory=dict)
    scales: Mapping[str, float] = field(default_factory=dict)
    far_phase: float | None = None
    phase_sign: int = 1
    direction: str | None = None
    corrected: bool = False
    frame: int | None = None
    calibration: Path | None = None
    reference_area: str | tuple[float, float, float, float] | None = "auto"
    lift: bool = False
    model: str | None = None
    method: str = "posterior"
    harmonics: tuple[int, ...] | None = None
    poisson_ratio: float | None = None
    noise: NoiseRequest | Mapping[str, float] | str | None = None
    priors: Mapping[str, Any] = field(default_factory=dict)
    motion: str = "full"
    given: Mapping[str, float] = field(default_factory=dict)
    phases: int | Path | None = None
    reference: Any = None
    reference_pixels: tuple[float, float, float, float] | Path | None = None
    seed: int = 0


def settings_of(given: Mapping[str, Any]) -> Settings:
    """Return settings from keyword arguments; paths of a probe or a calibration may be text.

    Raises
    ------
    OvertoneError
        If there is no such setting, or a file of them cannot be read.
    """
    known = [part.name for part in fields(Settings)]
    unknown = [name for name in given if name not in known]
    if unknown:
        raise OvertoneError(
            f"{unknown[0]!r} is no setting of a map", expected=", ".join(known), got=repr(unknown[0])
        )
    values = dict(given)
    if isinstance(values.get("probe"), str | Path):
        from overtone.probe import load_probe

        values["probe"] = load_probe(values["probe"])
    for name in ("calibration", "phases", "reference_pixels"):
        if isinstance(values.get(name), str):
            values[name] = Path(values[name])
    for name in ("harmonics", "reference_pixels", "reference_area"):
        if isinstance(values.get(name), list):
            values[name] = tuple(values[name])
    return Settings(**values)


def absolute(settings: Settings) -> Settings:
    """Return settings whose files are found from any folder."""
    paths: dict[str, Any] = {
        part.name: value.resolve()
        for part in fields(Settings)
        if isinstance(value := getattr(settings, part.name), Path)
    }
    return replace(settings, **paths)


def check_settings(settings: Settings, scans: int = 1) -> None:
    """Refuse what could not be mapped, whether or not the file allows a modulus.

    Parameters
    ----------
    settings : Settings
        What was asked for.
    scans : int
        How many files make up one map.

    Raises
    ------
    OvertoneError
        If settings are unknown, out of range, or do not fit each other.
    """
    from overtone.contact.parameters import POISSON_RATIO
    from overtone.inversion.properties import HARMONIC_SETS, METHODS, MOTIONS, records_of

    if settings.method not in METHODS:
        raise OvertoneError("unknown method", expected=", ".join(METHODS), got=repr(settings.method))
    if settings.motion not in MOTIONS:
        raise OvertoneError("unknown motion", expected=", ".join(MOTIONS), got=repr(settings.motion))
    if settings.model is not None:
        records_of(settings.model, settings.method)
    if settings.priors and settings.method not in ("posterior", POPULATION):
        raise OvertoneError(
            "only the posterior has priors",
            expected="--method posterior or population",
            got=settings.method,
        )
    if scans > 1 and settings.method != POPULATION:
        raise OvertoneError(
            f"{scans} scans are mapped one by one",
            expected="one file, or --method population, which takes scans of the same pixels together",
            got=f"--method {settings.method}",
            hint="--out-dir results, for a result of each",
        )
    if (
        settings.method == "least-squares"
        and settings.harmonics is not None
        and settings.harmonics not in HARMONIC_SETS
    ):
        raise OvertoneError(
            "harmonics do not fit the method", expected="0,1,2 or 1,2,3", got=str(settings.harmonics)
        )
    if settings.poisson_ratio is not None:
        POISSON_RATIO.check(settings.poisson_ratio)
    if settings.calibration is None:
        for option, said in (
            ("--reference-area", settings.reference_area != "auto"),
            ("--lift", settings.lift),
        ):
            if said:
                raise OvertoneError(
                    f"{option} corrects a scan",
                    expected="a calibration",
                    hint="--calibration calibration.toml",
                )


def noise_of(settings: Settings) -> NoiseRequest:
    """Return what is known of the noise.

    Raises
    ------
    OvertoneError
        If it is not understood.
    """
    from overtone.instrument.noise import complete_noise

    noise = settings.noise
    if noise is None or isinstance(noise, NoiseRequest):
        return noise or NoiseRequest()
    if isinstance(noise, str):
        return noise_request([noise])
    complete_noise(noise, ())  # refuses what cannot be a standard deviation
    return NoiseRequest(dict(noise))


def texts_of(settings: Settings) -> dict[str, str]:
    """Return every setting that is not the default as text: the same text, the same map.

    Files count by their content, so that a calibration that was made again is another one.

    Raises
    ------
    OSError
        If a file of the settings cannot be read.
    """
    default = Settings()
    texts = {}
    for part in fields(Settings):
        value = getattr(settings, part.name)
        if part.name == "noise":
            value = noise_of(settings)
        if value != getattr(default, part.name) and value != noise_of(default):
            texts[part.name] = _text(value)
    return texts


def _text(value: Any) -> str:
    from overtone.probe import Probe, format_probe

    if isinstance(value, Probe):
        return format_probe(value)
    if isinstance(value, Path):
        return hashlib.blake2b(value.read_bytes(), digest_size=16).hexdigest()
    if isinstance(value, Mapping):
        return json.dumps({name: _text(item) for name, item in sorted(value.items())})
    return repr(value)
