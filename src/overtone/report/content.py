"""What a report says, before it is laid out on a terminal or a page."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import xarray as xr

if TYPE_CHECKING:
    from overtone.instrument.calibration import Calibration
    from overtone.instrument.gates import Gate


@dataclass(frozen=True)
class Table:
    """A table of text cells.

    Parameters
    ----------
    title : str
        One line.
    columns : tuple of str
        Headings with units.
    rows : tuple of tuple of str
        One cell a column.
    note : str
        What a reader has to know beside the numbers.
    """

    title: str
    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    note: str = ""


@dataclass(frozen=True)
class Calibrated:
    """The calibration that a scan was corrected with, and what it rests on.

    Parameters
    ----------
    calibration : Calibration
        As it was made, before the scan.
    raw, corrected : Dataset or None
        Its approach curve over ``z`` as read, and out of `overtone.correct`; both or none.
    far_field : Dataset or None
        Its readings without a sample.
    gates : tuple of Gate
        What it supports, from `overtone.gates` on `calibration_of` the scan, or on itself.
    """

    calibration: Calibration
    raw: xr.Dataset | None = None
    corrected: xr.Dataset | None = None
    far_field: xr.Dataset | None = None
    gates: tuple[Gate, ...] = ()


@dataclass(frozen=True)
class Report:
    """Everything a report shows.

    Parameters
    ----------
    title, subtitle : str
        What was measured, and from where.
    observables : Dataset
        Observables, with ``height`` where there is one.
    energies : Dataset
        ``F_cons``, ``F_diss``, ``dissipation``, ``virial``, and ``regime`` where it was decided.
    properties : mapping of str to Dataset
        Results of `map_properties` by a label such as "harmonics 1, 2, 3"; empty where no modulus was asked for.
    truth : Dataset or None
        Properties that a simulation started from, with ``material`` (index of the material of each pixel).
    materials : tuple of str
        Names of the materials of ``truth``.
    tables : tuple of Table
        In the order to be read.
    findings : tuple of str
        Plain sentences: what was assumed, rejected, or cannot be concluded.
    before : Dataset or None
        The scan as the microscope stored it, where ``observables`` were corrected; the same pixels.
    calibration : Calibrated or None
        What it was corrected with.
    """

    title: str
    subtitle: str
    observables: xr.Dataset
    energies: xr.Dataset
    properties: Mapping[str, xr.Dataset] = field(default_factory=dict)
    truth: xr.Dataset | None = None
    materials: tuple[str, ...] = ()
    tables: tuple[Table, ...] = ()
    findings: tuple[str, ...] = ()
    before: xr.Dataset | None = None
    calibration: Calibrated | None = None
