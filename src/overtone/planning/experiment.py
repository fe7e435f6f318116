"""What a measurement will tell of a material: the posterior on the noise-free state, before anything is measured.

The reading that lever and material would give is simulated, with every harmonic of the motion, and inverted with the
noise and the shared errors that are to be expected. The interval around noise-free data is close to the mean one over
noise, without a thousand realisations; medians of noisy pixels scatter within it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt
import xarray as xr

from overtone import provenance
from overtone.contact.sample import Sample
from overtone.errors import ProbeError
from overtone.instrument.calibration import Calibration, format_calibration
from overtone.instrument.noise import complete_noise
from overtone.inversion.columns import is_linear, unknowns_of
from overtone.inversion.priors import Prior
from overtone.inversion.properties import map_properties
from overtone.inversion.result import MISSING_DATA, STATUS_FLAGS
from overtone.inversion.validity import contact_validity
from overtone.planning.held import held_states
from overtone.planning.quality import calibration_for, described
from overtone.planning.request import (
    Inversion,
    checked_amplitudes,
    checked_setpoints,
    inversion_of,
    named_levers,
)
from overtone.probe import Probe, format_probe, required_radius
from overtone.quantities import quantity
from overtone.units import format_quantity

_Floats = npt.NDArray[np.float64]

DIMS = ("lever", "free_amplitude", "setpoint")
_KEPT = 3  # harmonics that are read, and more where they are asked for
_OF_STATES = ("Z", "peak_force", "pull_force", "contact_time", "stable", "bistable", "reason")
_OF_CONTACT = ("mean_pressure", "relative_indentation", "tabor")
_LEFT_OUT = ("misfit", "log_evidence")  # of data without noise they say nothing
_MEANINGS = {
    "true_indentation": ("m", "maximum indentation of the state that is held"),
    "relative_indentation": ("1", "maximum indentation over the tip radius"),
    "interval_factor": ("1", "upper over lower end of the 90 % interval of the elastic unknown"),
}


def plan_experiment(
    probe: Probe,
    sample: Sample,
    *,
    setpoint: Any,
    free_amplitude: Any = None,
    probes: Mapping[str, Probe] | None = None,
    noise: Mapping[str, float] | None = None,
    calibration: Calibration | str | None = None,
    model: str | None = None,
    priors: Mapping[str, Prior] | None = None,
    harmonics: Sequence[int] | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> xr.Dataset:
    """Return what each choice of lever, free amplitude and set-point would tell of a material.

    Parameters
    ----------
    probe : Probe
        The lever ``probe`` of the result; with a tip radius, for models that need one.
    sample : Sample
        One material: what is taken to be there.
    setpoint : float or array (setpoint,)
        A1 / A1far, between 0 and 1; sorted.
    free_amplitude : float or array (free_amplitude,), optional
        A1far [m], sorted; that of ``probe`` unless given. Every lever is driven to each of them.
    probes : mapping of str to Probe, optional
        Other levers, by name.
    noise : mapping, optional
        As in `overtone.map_properties`: `overtone.instrument.noise.ORDINARY_NOISE` where not stated.
    calibration : Calibration or str, optional
        What the whole scan shares: a calibration of this lever, with its covariance, or how good one is assumed to be,
        as independent standard deviations (`overtone.planning.quality.QUALITIES`):

        - ``none``: A0 300 pm, phi1 5 deg, gains 30 %, 100 pm added to A2 and A3, k 30 %, Q 10 %, A1far 5 %, R 50 %;
        - ``ordinary``: A0 10 pm, phi1 1 deg, gains 5 %, 5 pm added, k 10 %, Q 2 %, A1far 1 %, R 25 %;
        - ``careful``: A0 1 pm, phi1 0.2 deg, gains of A0 and A2 1 %, of A3 2 %, 0.5 pm added, k 5 %, Q 0.5 %,
          A1far 0.3 %, R 10 %;
        - ``perfect``, and None: nothing is shared. What noise alone leaves is a bound that no microscope reaches.
    model : str, optional
        Contact model of the inversion, or ``auto``; that of the sample unless given. With another one the intervals
        hold what that model would say, which need not hold the truth.
    priors, harmonics
        As in `overtone.map_properties`.
    progress : callable, optional
        Called with (lever and free amplitude done, in all).

    Returns
    -------
    Dataset
        Over ``lever``, ``free_amplitude`` and ``setpoint``, NaN where there is no repulsive state:

        - what a posterior has (`overtone.map_properties`): ``<name>_unscreened`` (median), ``<name>_lower``,
          ``<name>_upper`` (90 %) and ``<name>`` (the median where it is determined) of every unknown and of
          ``indentation``; ``uncertainty`` with ``uncertainty_statistical`` and ``uncertainty_systematic``;
          ``contact_probability``, ``status``; and ``interval_factor``, upper over lower end of the elastic unknown;
        - ``stable``: whether a feedback can hold a repulsive state; ``reason`` why not; ``bistable``: whether a stable
          attractive state has the same set-point, in which a feedback that comes from far stays;
        - of the state: expected readings (``A0``, ``A1``, ``phi1``, ``A2``, ...), ``Z``, ``true_indentation``,
          ``peak_force``, ``pull_force``, ``contact_time`` (share of a period), and where they apply
          ``mean_pressure`` [Pa], ``relative_indentation`` (delta/R) and ``tabor``.

    Raises
    ------
    OvertoneError, InversionError, CalibrationError, ProbeError, ContactModelError
        If set-points or free amplitudes are out of range; if the sample is several, does not say what the model has to
        know, or belongs to a model that cannot be inverted; if the tip radius is missing; if a word for the calibration
        is unknown, or a calibration belongs to another lever.

    Notes
    -----
    One pixel, one reading. Noise falls with the root of the pixels averaged, shared errors do not. Slopes of A0 count
    as at the middle of the scan, where they do nothing.

    The interval on noise-free data stands for the expected one: ln of its width is within about 10 % of the mean over
    realisations of the noise where one solution has the weight, and up to a half below it in the cells next to the
    border where a second one comes in. The true value lies in the interval as often as it says where the data determine
    it; elsewhere the prior speaks, and the median may be anywhere.

    Against noise of a given size a larger amplitude helps, because every reading grows with it; against relative errors
    (gains) a smaller one, because the tip then sinks in by a larger share of its path (Delta = delta/2 A1). Which of
    them wins is what a plan tells.

    Examples
    --------
    >>> probe = Probe.simple(stiffness=2, frequency=70e3, quality_factor=150, drive_frequency=70e3,
    ...                      free_amplitude=40e-9, radius=20e-9)
    >>> from overtone.contact.sample import sample
    >>> polymer = sample("dmt", modulus=100e6, poisson_ratio=0.45, adhesion=4e-9)
    >>> plan = plan_experiment(probe, polymer, setpoint=[0.4, 0.8], calibration="careful")
    >>> plan.sizes["lever"], plan.sizes["free_amplitude"], plan.stable.values.ravel().tolist()
    (1, 1, [True, True])
    """
    setpoints = checked_setpoints(setpoint)
    if not isinstance(probe, Probe):
        raise ProbeError("no probe", expected="a Probe", got=type(probe).__name__, hint="load_probe(path)")
    amplitudes = checked_amplitudes(free_amplitude, probe)
    levers = named_levers(probe, probes)
    inversion = inversion_of(sample, model, noise, priors, harmonics)
    if inversion.needs_radius or "radius" in {q.name for q in sample.model.given}:
        for lever in levers.values():
            required_radius(lever)
    assumed = described(calibration) if isinstance(calibration, str | None) else ""
    keep = max([_KEPT, *(harmonics or ())])
    rows = [(name, A) for name in levers for A in amplitudes]
    cells = []
    for done, (name, A) in enumerate(rows):
        lever = levers[name]
        driven = replace(lever, drive=replace(lever.drive, free_amplitude=float(A)))
        held = held_states(driven, sample, setpoints, keep)
        told = _told(held, driven, inversion, calibration_for(calibration, driven), keep)
        cells.append((held, told, _contact(held, driven, sample)))
        if progress is not None:
            progress(done + 1, len(rows))
    plan = _assembled(cells, (len(levers), len(amplitudes), len(setpoints)), inversion, keep)
    plan = plan.assign_coords(
        lever=("lever", list(levers)),
        free_amplitude=("free_amplitude", amplitudes, {"units": "m", "long_name": "A1 far from the sample"}),
        setpoint=("setpoint", setpoints, {"units": "1", "long_name": "A1 / A1far"}),
    )
    sigma = complete_noise(noise, tuple(range(keep + 1)))
    plan.attrs = {
        "sample": _text(sample),
        "model": model or sample.model.key,
        "calibration_assumed": assumed or described(calibration),
        "elastic": inversion.first,
        "elastic_true": float(sample.values.get(inversion.first, math.nan)),
    }
    return provenance.record(
        plan,
        "plan_experiment",
        probes={name: format_probe(lever) for name, lever in levers.items()},
        sample=_text(sample),
        model=model or sample.model.key,
        calibration=assumed or described(calibration),
        noise=sigma,
        noise_stated=sorted(noise or {}),
        harmonics=list(harmonics) if harmonics is not None else None,
    )


# --- what it would tell ---------------------------------------------------------------------------


def _readings(keep: int) -> list[str]:
    return ["A0", "A1", "phi1", *(f"{part}{n}" for n in range(2, keep + 1) for part in ("A", "phi"))]


def _told(
    held: xr.Dataset, probe: Probe, inversion: Inversion, calibration: Calibration | None, keep: int
) -> xr.Dataset | None:
    """Return the posterior on the readings of held states, None where there is none."""
    observables = held[_readings(keep)].drop_vars("harmonic", errors="ignore")
    observables.attrs = {}
    if not bool(np.isfinite(observables["A1"]).any()):
        return None
    if calibration is not None:
        observables.attrs["calibration"] = format_calibration(calibration)
    result = map_properties(observables, probe, **inversion.arguments)
    if calibration is None:
        result = result.assign(
            uncertainty_statistical=result["uncertainty"],
            uncertainty_systematic=result["uncertainty"].where(result["uncertainty"].isnull(), 0.0),
        )
    first = inversion.first
    factor = result[f"{first}_upper"] / result[f"{first}_lower"]
    return result.drop_vars(_LEFT_OUT, errors="ignore").assign(interval_factor=factor)


def _contact(held: xr.Dataset, probe: Probe, sample: Sample) -> xr.Dataset:
    """Return depth, pressure and adhesion regime of held states, as far as the model of the sample has them."""
    if not is_linear(sample.model):  # pressure and regime of the others are another matter
        radius = probe.tip.radius or math.nan
        return xr.Dataset(
            {"relative_indentation": held["indentation"].where(held["indentation"] >= 0.0) / radius}
        )
    unknowns = {q.name for q in sample.model.unknowns}
    truth = xr.Dataset({"indentation": held["indentation"]}).assign(
        {name: value for name, value in sample.values.items() if name in unknowns}
    )
    given: dict[str, Any] = {n: float(v) for n, v in sample.values.items() if n not in unknowns}
    found = contact_validity(truth, held["A1"], probe, model=sample.model.key, **given)
    return found[[name for name in _OF_CONTACT if name in found]]


def _assembled(
    cells: Sequence[tuple[xr.Dataset, xr.Dataset | None, xr.Dataset]],
    shape: tuple[int, int, int],
    inversion: Inversion,
    keep: int,
) -> xr.Dataset:
    """Return the cells of all levers and free amplitudes as one dataset."""
    parts: list[dict[str, xr.DataArray]] = []
    for held, told, contact in cells:
        part = {name: held[name] for name in (*_readings(keep), *_OF_STATES)}
        part["true_indentation"] = held["indentation"]
        part |= {str(name): contact[name] for name in contact.data_vars}
        part |= {str(name): told[name] for name in told.data_vars} if told is not None else {}
        parts.append(part)
    names = list(dict.fromkeys(name for part in parts for name in part))
    empty = [name for name in _expected_names(inversion) if name not in names]
    variables: dict[str, xr.Variable] = {}
    for name in (*names, *empty):
        arrays = [part.get(name) for part in parts]
        example = next((array for array in arrays if array is not None), None)
        dtype = example.dtype if example is not None else np.dtype(float)
        fill: Any = math.nan
        if name == "status":
            dtype, fill = np.dtype(np.int8), MISSING_DATA
        elif dtype.kind != "f":
            fill = -1 if name == "model" else 0
        values = np.full((len(parts), shape[2]), fill, dtype)
        for k, array in enumerate(arrays):
            if array is not None:
                values[k] = array.values
        attributes = dict(example.attrs) if example is not None else {}
        variables[name] = xr.Variable(DIMS, values.reshape(shape), attributes | _named(name))
    if "status" in variables:
        variables["status"].attrs |= dict(STATUS_FLAGS)
    return xr.Dataset(variables)


def _expected_names(inversion: Inversion) -> list[str]:
    """Return what every plan holds, states or none."""
    unknowns = dict.fromkeys(q.name for record in inversion.records for q in unknowns_of(record))
    variants = ("", "_unscreened", "_lower", "_upper")
    of_noise = ("uncertainty", "uncertainty_statistical", "uncertainty_systematic")
    return [
        *(f"{name}{variant}" for name in (*unknowns, "indentation") for variant in variants),
        *of_noise,
        "interval_factor",
        "contact_probability",
        "status",
    ]


def _named(name: str) -> dict[str, str]:
    """Return unit and meaning of a variable that has none yet."""
    if name in _MEANINGS:
        unit, meaning = _MEANINGS[name]
        return {"units": unit, "long_name": meaning}
    record = quantity(name)
    if record is None or name in ("stable", "reason", "bistable"):
        return {}
    return {"units": record.unit, "long_name": record.meaning}


def _text(sample: Sample) -> str:
    units = {q.name: q.unit for q in sample.model.parameters}
    values = (f"{name} {format_quantity(float(v), units[name])}" for name, v in sample.values.items())
    return f"{sample.model.key}: {', '.join(values)}"
