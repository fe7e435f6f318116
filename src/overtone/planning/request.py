"""What a plan was asked for, checked: set-points, free amplitudes, levers, and how readings are to be inverted."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from overtone.contact.models import BUILT_IN, ContactModel, contact_model
from overtone.contact.sample import OF_THE_PROBE, Sample
from overtone.errors import InversionError, OvertoneError, ProbeError
from overtone.inversion.columns import is_linear, unknowns_of
from overtone.inversion.priors import Prior
from overtone.inversion.properties import AUTO, COMPARED
from overtone.probe import Probe

_Floats = npt.NDArray[np.float64]

FIRST_LEVER = "probe"
"""Name of the lever that a plan is asked for first."""
_LARGEST = 10e-6  # m: a free amplitude beyond is metres for nanometres


@dataclass(frozen=True)
class Inversion:
    """How every reading is inverted: the arguments of `overtone.map_properties` that do not change."""

    records: tuple[ContactModel, ...]
    arguments: Mapping[str, Any]

    @property
    def first(self) -> str:
        """Name of the elastic unknown."""
        return unknowns_of(self.records[0])[0].name

    @property
    def needs_radius(self) -> bool:
        """Whether a modulus takes the radius of the tip."""
        return any(q.name == "radius" for record in self.records for q in record.given)


def _numbers(values: Any, what: str, example: str) -> _Floats:
    """Return numbers as a sorted array of one dimension, each once."""
    try:
        array = np.atleast_1d(np.asarray(values, dtype=float))
    except (TypeError, ValueError) as error:
        raise OvertoneError(f"the {what} is not a number", expected=example, got=repr(values)) from error
    if array.ndim != 1 or array.size == 0:
        raise OvertoneError(
            f"the {what} is no list of numbers", expected=example, got=f"an array of shape {array.shape}"
        )
    return np.unique(array)


def checked_setpoints(setpoint: Any) -> _Floats:
    """Return set-points, sorted.

    Raises
    ------
    OvertoneError
        If one is not between 0 and 1.
    """
    setpoints = _numbers(setpoint, "set-point", "A1/A1far between 0 and 1")
    bad = setpoints[~((setpoints > 0.0) & (setpoints < 1.0))]
    if bad.size:
        raise OvertoneError(
            "the set-point is out of reach",
            expected="0 < A1/A1far < 1",
            got=", ".join(f"{value:g}" for value in bad[:3]),
            hint="a share of the free amplitude, such as 0.6, and not a length or per cent",
        )
    return setpoints


def checked_amplitudes(free_amplitude: Any, probe: Probe) -> _Floats:
    """Return free amplitudes [m], sorted; that of the probe where none are given.

    Raises
    ------
    OvertoneError
        If one is not above 0, or as large as nanometres taken for metres.
    """
    given = probe.drive.free_amplitude if free_amplitude is None else free_amplitude
    amplitudes = _numbers(given, "free amplitude", "A1far [m]")
    bad = amplitudes[~((amplitudes > 0.0) & (amplitudes <= _LARGEST))]
    if bad.size:
        raise OvertoneError(
            "the free amplitude is out of range",
            expected="metres, above 0 and up to 10 um",
            got=f"{bad[0]:g} m",
            hint="25e-9 for 25 nm",
        )
    return amplitudes


def named_levers(probe: Probe, probes: Mapping[str, Probe] | None) -> dict[str, Probe]:
    """Return every lever by its name.

    Raises
    ------
    ProbeError
        If one is no probe, or has a name that is taken.
    """
    levers = {FIRST_LEVER: probe}
    for name, lever in (probes or {}).items():
        if not isinstance(lever, Probe) or name in levers or not name:
            raise ProbeError(
                f"{name!r} is no other lever",
                expected=f"a Probe under a name of its own, {FIRST_LEVER!r} is the first",
                got=type(lever).__name__,
                hint="probes={'soft': load_probe(path)}",
            )
        levers[str(name)] = lever
    return levers


def inversion_of(
    sample: Sample,
    model: str | None = None,
    noise: Mapping[str, float] | None = None,
    priors: Mapping[str, Prior] | None = None,
    harmonics: Sequence[int] | None = None,
) -> Inversion:
    """Return how readings of a sample are inverted.

    Raises
    ------
    OvertoneError
        If it is no sample, or several.
    InversionError
        If the model cannot be inverted, or has to know what the sample does not say.
    """
    if not isinstance(sample, Sample):
        raise OvertoneError("no sample", expected="what overtone.sample returned", got=type(sample).__name__)
    if sample.shape:
        raise OvertoneError(
            "a plan is for one material",
            expected="plain numbers",
            got=f"arrays of shape {sample.shape}",
            hint="one plan for each material",
        )
    key = model or sample.model.key
    records = tuple(contact_model(k) for k in COMPARED) if key == AUTO else (contact_model(key),)
    if not is_linear(records[0]):
        raise InversionError(
            f"readings of model {key!r} cannot be inverted",
            expected=", ".join(m.key for m in BUILT_IN if is_linear(m)),
            hint='a nearby model for the inversion, such as model="dmt"',
        )
    taken = {q.name: q for record in records for q in record.given if q.name not in OF_THE_PROBE}
    known = {name: float(value) for name, value in sample.values.items() if name in taken}
    missing = [name for name, q in taken.items() if name not in known and q.default is None]
    if missing:
        raise InversionError(
            f"the sample is of another model than {key!r}",
            expected=f"a sample that says {' and '.join(missing)}",
            got=f"one of model {sample.model.key!r} with {', '.join(sample.values)}",
            hint="a sample of the model that is inverted, or leave out model",
        )
    arguments: dict[str, Any] = {"model": key, "noise": noise, "priors": priors, "harmonics": harmonics}
    for name in ("poisson_ratio", "intermolecular_distance"):
        if name in known:
            arguments[name] = known.pop(name)
    return Inversion(records, arguments | {"given": known})
