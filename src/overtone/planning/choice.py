"""Which cell of a plan to measure, and why, in words."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import xarray as xr

from overtone.contact.validity import JKR_LIMIT, adhesion_regime
from overtone.errors import ObservablesError
from overtone.inversion.result import DETERMINED
from overtone.planning.held import REASONS, USABLE
from overtone.units import format_quantity

_Index = tuple[int, int, int]

_AS_GOOD = 1.1  # an interval wider by less counts as equal, and the gentler tap wins
_DECIDES = 2.0  # ratio of standard deviations from which one part of the error decides
_HUGE = 1e3  # a factor beyond says no more than that
_DEEP = 1.0  # delta/R from which a paraboloid no longer describes a tip
_AXES = {1: "free amplitudes", 2: "set-points"}
_LAWS_WITH_TAIL = ("dmt", "dmt-linear", "dmt-viscous")


@dataclass(frozen=True)
class Choice:
    """The cell of a plan to measure.

    Parameters
    ----------
    lever : str
        Name of the lever.
    free_amplitude, setpoint : float
        A1far [m] and A1/A1far.
    lower, median, upper : float
        Expected 90 % interval of the elastic unknown and its median [SI].
    factor : float
        Upper over lower end.
    determined : bool
        Whether the elastic unknown will be determined.
    sentences : tuple of str
        Why, and what else there is to know, for people.
    """

    lever: str
    free_amplitude: float
    setpoint: float
    lower: float
    median: float
    upper: float
    factor: float
    determined: bool
    sentences: tuple[str, ...]


def best_choice(plan: xr.Dataset) -> Choice | None:
    """Return the cell with the narrowest interval of the elastic unknown, None where no state can be held.

    Parameters
    ----------
    plan : Dataset
        Result of `overtone.plan_experiment`.

    Raises
    ------
    ObservablesError
        If it is none.

    Notes
    -----
    Cells in which a stable attractive state has the same set-point count only where there are no others; likewise those
    that do not determine the unknown, and then those whose interval would miss it. Of intervals within 10 % of the
    narrowest the one of least peak force is taken.
    """
    where = _best(plan, np.ones(_shape(plan), bool))
    if where is None:
        return None
    cell = plan.isel(dict(zip(_dims(plan), where, strict=True)))
    first = elastic_of(plan)
    lower, median, upper = (float(cell[f"{first}{v}"]) for v in ("_lower", "_unscreened", "_upper"))
    return Choice(
        str(cell["lever"].values),
        float(cell["free_amplitude"]),
        float(cell["setpoint"]),
        lower,
        median,
        upper,
        float(cell["interval_factor"]),
        int(cell["status"]) == DETERMINED,
        tuple(_sentences(plan, cell, where)),
    )


def best_of_each(plan: xr.Dataset) -> list[tuple[str, float, xr.Dataset | None]]:
    """Return lever, free amplitude [m] and the best cell of every row of a plan, None where no state can be held.

    Raises
    ------
    ObservablesError
        If it is no plan.
    """
    rows: list[tuple[str, float, xr.Dataset | None]] = []
    for i, lever in enumerate(plan["lever"].values):
        for j, A in enumerate(plan["free_amplitude"].values):
            only = np.zeros(_shape(plan), bool)
            only[i, j] = True
            where = _best(plan, only)
            cell = plan.isel(dict(zip(_dims(plan), where, strict=True))) if where is not None else None
            rows.append((str(lever), float(A), cell))
    return rows


def elastic_of(plan: xr.Dataset) -> str:
    """Return the name of the elastic unknown of a plan.

    Raises
    ------
    ObservablesError
        If it is no plan.
    """
    if "elastic" not in plan.attrs or "interval_factor" not in plan:
        raise ObservablesError(
            "the dataset is no plan",
            expected="what overtone.plan_experiment returned",
            got=", ".join(map(str, plan.data_vars)) or "an empty dataset",
        )
    return str(plan.attrs["elastic"])


def factor_text(factor: float, determined: bool) -> str:
    """Return how wide an interval is, in words."""
    size = f"{factor:.2g}" if factor < 10.0 else f"{factor:.3g}"
    if not factor < _HUGE:
        size = f"over {_HUGE:g}"
    return f"a factor of {size}" if determined else f"not determined (a factor of {size})"


def decided_by(cell: xr.Dataset) -> str:
    """Return which part of the error decides how wide an interval is: noise, calibration, or both."""
    noise, shared = (float(cell[f"uncertainty_{part}"]) for part in ("statistical", "systematic"))
    if not shared > noise / _DECIDES:
        return "noise"
    return "calibration" if shared > noise * _DECIDES else "both"


def _dims(plan: xr.Dataset) -> tuple[str, str, str]:
    elastic_of(plan)
    return ("lever", "free_amplitude", "setpoint")


def _shape(plan: xr.Dataset) -> tuple[int, ...]:
    return tuple(plan.sizes[dim] for dim in _dims(plan))


def _values(plan: xr.Dataset, name: str) -> npt.NDArray[np.float64]:
    return np.asarray(plan[name].transpose(*_dims(plan)).values)


def _best(plan: xr.Dataset, among: npt.NDArray[np.bool_]) -> _Index | None:
    factor = _values(plan, "interval_factor")
    allowed = among & _values(plan, "stable").astype(bool) & np.isfinite(factor)
    first, truth = elastic_of(plan), float(plan.attrs.get("elastic_true", math.nan))
    with np.errstate(invalid="ignore"):
        misses = (truth < _values(plan, f"{first}_lower")) | (truth > _values(plan, f"{first}_upper"))
    alone, determined = ~_values(plan, "bistable").astype(bool), _values(plan, "status") == DETERMINED
    for better in (alone, determined, ~misses):
        if (allowed & better).any():
            allowed &= better
    if not allowed.any():
        return None
    near = allowed & (factor <= _AS_GOOD * factor[allowed].min())
    force = np.where(near, _values(plan, "peak_force"), np.inf)
    i, j, k = np.unravel_index(int(np.argmin(force)), force.shape)
    return int(i), int(j), int(k)


def _sentences(plan: xr.Dataset, cell: xr.Dataset, where: _Index) -> list[str]:
    first = elastic_of(plan)
    unit = str(plan[f"{first}_lower"].attrs["units"])
    determined = int(cell["status"]) == DETERMINED
    place = f"{_place(plan, cell)} at set-point {float(cell['setpoint']):.2g}"
    interval = " to ".join(format_quantity(float(cell[f"{first}_{end}"]), unit) for end in ("lower", "upper"))
    factor = factor_text(float(cell["interval_factor"]), determined)
    if determined:
        said = [f"Best: {place}: {first} {interval} (90 %), {factor} from end to end."]
    else:
        said = [f"No choice determines the {first}; nearest: {place}: {interval} (90 %), {factor}."]
    said.append(_errors(plan, cell))
    others = [
        f"{_place(plan, row)} {_short(row)}"
        for lever, A, row in best_of_each(plan)
        if row is not None and (lever, A) != (str(cell["lever"].values), float(cell["free_amplitude"]))
    ]
    if others:
        said.append(f"At their best set-points: {'; '.join(_thinned(others))}.")
    truth = float(plan.attrs.get("elastic_true", math.nan))
    if truth < float(cell[f"{first}_lower"]) or truth > float(cell[f"{first}_upper"]):
        said.append(
            f"The interval misses the {first} of the sample, {format_quantity(truth, unit)}: with model "
            f"{plan.attrs['model']} it will be biased."
        )
    edges = [
        text
        for axis, text in _AXES.items()
        if plan.sizes[_dims(plan)[axis]] > 1 and _is_edge(plan, where, axis)
    ]
    if edges:
        said.append(
            f"It lies at the edge of the {' and of the '.join(edges)} asked for: there may be better beyond."
        )
    said += _about_states(plan, cell)
    return said + _about_contact(plan, cell)


def _place(plan: xr.Dataset, cell: xr.Dataset) -> str:
    text = f"free amplitude {format_quantity(float(cell['free_amplitude']), 'm')}"
    return text if plan.sizes["lever"] == 1 else f"{cell['lever'].values}, {text}"


def _short(cell: xr.Dataset) -> str:
    return factor_text(float(cell["interval_factor"]), int(cell["status"]) == DETERMINED)


def _thinned(texts: list[str]) -> list[str]:
    """Return a few of many texts, the first and the last among them."""
    if len(texts) <= 4:
        return texts
    return [texts[round(k * (len(texts) - 1) / 3)] for k in range(4)]


def _errors(plan: xr.Dataset, cell: xr.Dataset) -> str:
    noise, shared = (float(cell[f"uncertainty_{part}"]) for part in ("statistical", "systematic"))
    first = elastic_of(plan)
    sizes = f"standard deviation of ln {first} {noise:.2g} from noise, {shared:.2g} from what the scan shares"
    advice = {
        "noise": "noise decides: averaging pixels, or more time for each, narrows it",
        "calibration": "the calibration decides: averaging pixels does not help, a better calibration does",
        "both": "noise and calibration both count",
    }[decided_by(cell)]
    return f"{advice[0].upper()}{advice[1:]} ({sizes}; {plan.attrs['calibration_assumed']})."


def _is_edge(plan: xr.Dataset, where: _Index, axis: int) -> bool:
    return where[axis] in (0, plan.sizes[_dims(plan)[axis]] - 1)


def _about_states(plan: xr.Dataset, cell: xr.Dataset) -> list[str]:
    said = []
    reason, bistable = _values(plan, "reason"), _values(plan, "bistable").astype(bool)
    if bool(cell["bistable"]):
        said.append(
            "A stable attractive state has the same set-point, and a feedback that comes from far stays in it: a "
            "larger drive for a moment may bring it over, and the regime of the scan tells."
        )
    elif bistable.any():
        factor = _values(plan, "interval_factor")
        narrowest = float(np.min(factor[bistable], initial=math.inf))
        more = ""
        if narrowest < float(cell["interval_factor"]) / _AS_GOOD:
            more = f" The narrowest of them would be a factor of {narrowest:.2g}."
        said.append(
            f"In {bistable.sum()} of {bistable.size} cells a stable attractive state has the same set-point; they were "
            f"passed over.{more}"
        )
    lost = reason != USABLE
    if lost.any():
        kinds = (
            f"{REASONS[key].replace('_', ' ')} {count}"
            for key in REASONS
            if key != USABLE and (count := int((reason == key).sum()))
        )
        said.append(
            f"In {lost.sum()} of {lost.size} cells no feedback holds a repulsive state ({', '.join(kinds)})."
        )
    return said


def _about_contact(plan: xr.Dataset, cell: xr.Dataset) -> list[str]:
    said = []
    if "relative_indentation" in cell and float(cell["relative_indentation"]) > _DEEP:
        said.append(
            f"The tip sinks in by {float(cell['relative_indentation']):.2g} of its radius: a paraboloid no longer "
            "describes it."
        )
    if (
        "tabor" in cell
        and float(cell["tabor"]) > JKR_LIMIT
        and str(plan.attrs["model"]).startswith(_LAWS_WITH_TAIL)
    ):
        said.append(f"Tabor parameter {float(cell['tabor']):.2g}: {adhesion_regime(float(cell['tabor']))}.")
    return said
