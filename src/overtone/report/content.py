"""What a report says, before it is laid out on a terminal or a page."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import xarray as xr


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
