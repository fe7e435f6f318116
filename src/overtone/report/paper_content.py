"""What goes into the report for a paper: the datasets it is made of, and a figure with the numbers behind it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import xarray as xr
from matplotlib.figure import Figure

from overtone.errors import ObservablesError
from overtone.readings import reading_of
from overtone.report.content import Calibrated
from overtone.report.results import undetermined

SETPOINT = "setpoint"
"""Attribute of a result: the set-point A1/A1far of its scan."""
_FOR_A_RESULT = "the result of overtone.map_properties by method population"


@dataclass(frozen=True)
class Paper:
    """Everything the report for a paper shows.

    Parameters
    ----------
    title : str
        What was measured.
    observables, result : Dataset
        One scan (y, x), and what method ``population`` made of it.
    before, energies, truth : Dataset, optional
        The scan as read, results of `overtone.map_energy`, and properties that a simulation started from.
    curves : Calibrated, optional
        The calibration with its approach curve.
    others : sequence of Dataset
        Results at further set-points of the same area.
    """

    title: str
    observables: xr.Dataset
    result: xr.Dataset
    before: xr.Dataset | None = None
    energies: xr.Dataset | None = None
    curves: Calibrated | None = None
    others: tuple[xr.Dataset, ...] = ()
    truth: xr.Dataset | None = None

    def __post_init__(self) -> None:
        """Refuse datasets that do not belong together."""
        needed = ("status", "phase", "material")
        missing = [
            name for name in needed if name not in self.result.variables and name not in self.result.dims
        ]
        if missing:
            raise ObservablesError(
                f"the result has no {missing[0]}",
                expected=_FOR_A_RESULT,
                got=", ".join(map(str, self.result.data_vars)) or "an empty dataset",
                hint='method="population"',
            )
        if "A1" not in self.observables:
            raise ObservablesError("the observables lack A1", expected="one scan with A1 and phi1 at least")
        shape = dict(self.result["status"].sizes)
        if set(shape) != {"y", "x"} or 0 in shape.values():
            raise ObservablesError(
                "the result is no map", expected="dimensions (y, x)", got=str(shape), hint="one scan"
            )
        together = {
            "observables": self.observables["A1"],
            "scan before correction": None if self.before is None else self.before.get("A1"),
            "forces and energies": None if self.energies is None else self.energies.get("virial"),
            "truth": None if self.truth is None else next(iter(self.truth.data_vars.values()), None),
        }
        for what, array in together.items():
            if array is not None and {d: array.sizes.get(d) for d in ("y", "x")} != shape:
                raise ObservablesError(
                    f"{what} and result do not fit",
                    expected=f"pixels {shape}",
                    got=str(dict(array.sizes)),
                    hint="the datasets of one scan",
                )
        if self.others:
            _ = self.setpoints

    @property
    def setpoints(self) -> tuple[float, ...]:
        """Set-points of this scan and of the others, in that order.

        Raises
        ------
        ObservablesError
            If one of them is not known.
        """
        own = self.result if SETPOINT in self.result.attrs else self.observables
        return (setpoint_of(own), *(setpoint_of(other) for other in self.others))

    @property
    def height(self) -> xr.DataArray | None:
        """Topography of the scan [m], None where it was not recorded."""
        height = self.observables.get("height")
        return height if height is not None and bool(np.isfinite(height).any()) else None


@dataclass(frozen=True)
class PaperFigure:
    """A figure with the numbers it was drawn from.

    Parameters
    ----------
    name : str
        What its files are called, without an ending.
    title, caption : str
        What it shows.
    figure : Figure
        As drawn.
    data : mapping of str to Dataset
        What it was drawn from, by what its file is called beyond the name; one of them without anything.
    """

    name: str
    title: str
    caption: str
    figure: Figure
    data: Mapping[str, xr.Dataset] = field(default_factory=dict)


def setpoint_of(dataset: xr.Dataset) -> float:
    """Return the set-point A1/A1far of a scan: what it is stated to be, or else from its A1 and its probe.

    Raises
    ------
    ObservablesError
        If it is not known.
    """
    stated = dataset.attrs.get(SETPOINT)
    if stated is not None:
        return float(stated)
    reading = reading_of(dataset)
    if reading is None or "A1" not in dataset or not bool(np.isfinite(dataset["A1"]).any()):
        raise ObservablesError(
            "the set-point of a result is not known",
            expected=f"A1 and its probe, or an attribute {SETPOINT!r}",
            got="neither",
            hint="with_setpoint(result, observables)",
        )
    return float(dataset["A1"].median()) / reading.probe.drive.free_amplitude


def with_setpoint(result: xr.Dataset, observables: xr.Dataset) -> xr.Dataset:
    """Return a result that says at which set-point its scan was taken.

    Raises
    ------
    ObservablesError
        If the observables do not tell.
    """
    return result.assign_attrs({SETPOINT: setpoint_of(observables)})


def materials_of(result: xr.Dataset) -> tuple[str, ...]:
    """Return the names of the materials of a result, in the order of their phases."""
    return tuple(str(name) for name in result["material"].values)


def determined_share(result: xr.Dataset) -> float:
    """Return the share of pixels that are determined."""
    return float((~undetermined(result)).mean())


def names_of(result: xr.Dataset, candidates: Sequence[str], form: str) -> tuple[str, ...]:
    """Return the properties of which a result holds an array such as ``material_{}``."""
    return tuple(name for name in candidates if form.format(name) in result)
