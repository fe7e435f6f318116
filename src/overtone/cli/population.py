"""Options of ``overtone map`` for method ``population``: phases, the reference in the scan, the report for a paper."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from cyclopts import Parameter

from overtone.batch.sample import FILES, Sample
from overtone.batch.settings import POPULATION
from overtone.cli.calibrate import parse_reference
from overtone.cli.options import parse_rectangle
from overtone.errors import OvertoneError

MOST_PHASES = 127
_TABLES = (".nc", ".csv", ".tsv", ".txt", ".dat", ".gsf")


@Parameter(name="*")
@dataclass(frozen=True)
class PopulationOptions:
    """What method population is told of the sample."""

    phases: Annotated[str | None, Parameter(name="--phases")] = None
    """Population: how many phases, or a file with their labels (whole numbers from 0; -1 or NaN for none). The scan
    chooses unless given."""
    reference: Annotated[str | None, Parameter(name="--reference")] = None
    """Population: a material in the scan whose modulus is known, for example "E=2 GPa, E_error=10 %, nu=0.35, name=PS".
    A scan that its calibration has anchored to a reference needs none."""
    reference_region: Annotated[str | None, Parameter(name="--reference-region")] = None
    """Where it is: a rectangle "x0, y0, x1, y1" with units, or a file with a mask."""
    seed: Annotated[int | None, Parameter(name="--seed")] = None
    """Population: of its random draws; 0 unless given."""
    paper: Annotated[Path | None, Parameter(name="--paper")] = None
    """Population: folder for figures (SVG, PDF, PNG) with their numbers, tables, a methods paragraph and a page."""


def sample_of(options: PopulationOptions, method: str) -> Sample:
    """Return what the options say.

    Raises
    ------
    OvertoneError
        If one of them is not understood, needs another, or belongs to another method.
    """
    given = {
        "--phases": options.phases,
        "--reference": options.reference,
        "--reference-region": options.reference_region,
        "--seed": options.seed,
        "--paper": options.paper,
    }
    named = [name for name, value in given.items() if value is not None]
    if method != POPULATION:
        if named:
            raise OvertoneError(
                f"{named[0]} belongs to another method",
                expected=f"--method {POPULATION}",
                got=f"--method {method}",
                hint="--reference-area for the reference of a calibration"
                if "reference" in named[0]
                else None,
            )
        return Sample()
    if (options.reference is None) != (options.reference_region is None):
        lacking, example = (
            ("--reference-region", '"0 um, 0 um, 2 um, 1 um"')
            if options.reference_region is None
            else ("--reference", '"E=2 GPa, E_error=10 %, nu=0.35, name=PS"')
        )
        raise OvertoneError(
            "a reference is a material and the place where it is",
            expected="--reference and --reference-region",
            got=f"no {lacking}",
            hint=f"{lacking} {example}",
        )
    if options.seed is not None and options.seed < 0:
        raise OvertoneError("--seed is not a seed", expected="0 or more", got=str(options.seed))
    return Sample(_phases(options.phases), _reference(options.reference), _region(options), options.seed or 0)


def _phases(text: str | None) -> int | Path | None:
    if text is None:
        return None
    try:
        count = int(text)
    except ValueError:
        return _existing(Path(text), "--phases", "a number of phases, or a file with their labels")
    if not 1 <= count <= MOST_PHASES:
        raise OvertoneError(
            "--phases is not a number of phases",
            expected=f"1 to {MOST_PHASES}, or a file with labels",
            got=text,
            hint="leave it out, and the scan chooses",
        )
    return count


def _reference(text: str | None) -> Any:
    if text is None:
        return None
    reference = parse_reference(text)
    if reference.modulus is None:
        raise OvertoneError(
            "--reference has no modulus",
            expected="E, which is what a reference is for",
            got=repr(text),
            hint=f'--reference "E=2 GPa, {text.strip()}"',
        )
    return reference


def _region(options: PopulationOptions) -> tuple[float, float, float, float] | Path | None:
    text = options.reference_region
    if text is None:
        return None
    path = Path(text)
    if path.suffix.lower() in _TABLES or path.exists():
        return _existing(path, "--reference-region", "a rectangle, or a file with a mask")
    return parse_rectangle(text, "--reference-region", "a file with a mask, or ")


def _existing(path: Path, option: str, expected: str) -> Path:
    if not path.is_file():
        raise OvertoneError(
            f"{option} is not understood", expected=expected, got=f"{str(path)!r}, which is no file"
        )
    if path.suffix.lower() not in _TABLES:
        raise OvertoneError(
            f"{path.name} holds no labels that can be read", expected=FILES, hint="save them as netCDF"
        )
    return path
