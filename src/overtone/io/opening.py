"""What was noticed while a file was opened, and how it was opened, kept with the observables."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import xarray as xr

from overtone import provenance
from overtone.io.selection import Request
from overtone.probe import format_probe


@contextmanager
def kept_warnings() -> Iterator[list[str]]:
    """Pass on the warnings of a block and keep what they said: a warning scrolls away, a dataset stays."""
    said: list[str] = []
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        yield said
    for warning in caught:
        warnings.warn_explicit(warning.message, warning.category, warning.filename, warning.lineno)
    said += dict.fromkeys(f"{w.category.__name__}: {w.message}" for w in caught)


def with_history(
    dataset: xr.Dataset, operation: str, path: str | Path, request: Request, sentences: Sequence[str]
) -> xr.Dataset:
    """Return observables that carry what was noticed and how they were opened."""
    dataset = provenance.add_finding(dataset, *map(_sentence, sentences))
    return provenance.record(
        dataset,
        operation,
        path=str(path),
        probe=format_probe(request.probe) if request.probe else "from the file",
        channels=dict(request.channels),
        scales=dict(request.scales),
        far_phase=request.far_phase,
        phase_sign=request.phase_sign,
        direction=request.direction,
        corrected=request.corrected,
        **({"lift": True} if request.lift else {}),
        **({"frame": request.frame} if request.frame else {}),
    )


def _sentence(text: str) -> str:
    text = text.strip()
    first = text.split(maxsplit=1)[0] if text else ""
    if first.isalpha() and first.islower():
        text = text[0].upper() + text[1:]
    return text + ("" if text.endswith(".") else ".")
