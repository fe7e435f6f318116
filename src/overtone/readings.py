"""How a scan has been read: its probe, the other readings its file leaves open, what cannot be concluded.

Kept as text in the attributes of the observables, so that it survives a file and travels with the data.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import xarray as xr

from overtone.errors import ObservablesError
from overtone.probe import Probe, format_probe, parse_probe


@dataclass(frozen=True)
class Reading:
    """How observables were read from a file.

    Parameters
    ----------
    probe : Probe
        The probe in use.
    alternatives : tuple of (Probe, float)
        Probes that may be meant as well, each with what it adds to phi1 [rad].
    phase_established : bool
        Whether the zero of the phase rests on evidence; without, no sign of a force can be told.
    corrected : bool
        Whether A0 and the higher harmonics were freed of offset and detector distortion.
    doubts : mapping of int to str
        Harmonic to the reasons why nothing can be concluded from it, one a line.
    """

    probe: Probe
    alternatives: tuple[tuple[Probe, float], ...] = ()
    phase_established: bool = True
    corrected: bool = False
    doubts: Mapping[int, str] = field(default_factory=dict)


def with_reading(observables: xr.Dataset, reading: Reading) -> xr.Dataset:
    """Return the observables with the reading in their attributes."""
    return observables.assign_attrs(
        probe=format_probe(reading.probe),
        alternatives=json.dumps([[format_probe(probe), shift] for probe, shift in reading.alternatives]),
        phase_established=str(reading.phase_established),
        corrected=str(reading.corrected),
        doubts=json.dumps({str(n): reason for n, reason in reading.doubts.items()}),
    )


def parse_reading(attributes: Mapping[str, object]) -> Reading | None:
    """Return the reading that attributes hold, None where they hold no probe.

    Raises
    ------
    ProbeError, ObservablesError
        If the text was damaged.
    """
    if "probe" not in attributes:
        return None
    try:
        alternatives: Sequence[tuple[str, float]] = json.loads(str(attributes.get("alternatives", "[]")))
        doubts: Mapping[str, str] = json.loads(str(attributes.get("doubts", "{}")))
        return Reading(
            probe=parse_probe(str(attributes["probe"]), source="the probe stored with the scan"),
            alternatives=tuple((parse_probe(text), float(shift)) for text, shift in alternatives),
            phase_established=attributes.get("phase_established", "True") == "True",
            corrected=attributes.get("corrected", "False") == "True",
            doubts={int(n): str(reason) for n, reason in doubts.items()},
        )
    except (ValueError, TypeError, AttributeError) as error:
        raise ObservablesError(
            "the attributes that say how the scan was read are damaged",
            got=str(error),
            hint="give a probe file",
        ) from error


def reading_of(observables: xr.Dataset) -> Reading | None:
    """Return how a scan was read, None where it does not say."""
    return parse_reading(observables.attrs)


def probe_of(observables: xr.Dataset) -> Probe:
    """Return the probe a scan was opened with.

    Raises
    ------
    ObservablesError
        If it carries none.
    """
    reading = reading_of(observables)
    if reading is None:
        raise ObservablesError("the scan carries no probe", hint="open_scan(path, probe=load_probe(...))")
    return reading.probe
