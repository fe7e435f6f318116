"""Figures of many maps: observables, forces, energies, and the properties of one inversion."""

from __future__ import annotations

import numpy as np
import xarray as xr
from matplotlib.figure import Figure

from overtone.plots.categories import draw_flags
from overtone.plots.intervals import interval_figure
from overtone.plots.maps import draw_map
from overtone.plots.planes import ratio_of
from overtone.plots.results import measured
from overtone.plots.scales import Limits, is_readable, positive_limits
from overtone.plots.sheet import Sheet
from overtone.plots.solutions import solutions_figure
from overtone.plots.text import draw_empty
from overtone.report.results import EXACT, POSTERIOR, estimate_of, method_of, undetermined

_COLUMNS = 3
_COLUMN_WIDTH = 3.4


def observables_figure(observables: xr.Dataset) -> Figure:
    """Return the maps of everything that was measured.

    Parameters
    ----------
    observables : Dataset
        Observables, with ``height`` where there is one.
    """
    arrays = [observables[name] for name in measured(observables)]
    sheet = _sheet(arrays, len(arrays))
    for axes, array in zip(sheet.cells, arrays, strict=False):
        draw_map(axes, array)
    return sheet.lay_out()


def forces_figure(energies: xr.Dataset) -> Figure:
    """Return the maps of the force harmonics: all conservative ones and the dissipative ones from the first on.

    Parameters
    ----------
    energies : Dataset
        ``F_cons(harmonic)`` and ``F_diss(harmonic)``.
    """
    panels: list[tuple[str, xr.DataArray]] = []
    for name, word, first in (("F_cons", "conservative", 0), ("F_diss", "dissipative", 1)):
        if name in energies:
            for n in energies["harmonic"].values:
                if n >= first:
                    panels.append((f"{word} force, harmonic {n}", energies[name].sel(harmonic=n, drop=True)))
    sheet = _sheet([array for _, array in panels], len(panels))
    for axes, (title, array) in zip(sheet.cells, panels, strict=False):
        draw_map(axes, array, title=title)
    return sheet.lay_out()


def energy_figure(energies: xr.Dataset) -> Figure:
    """Return the maps of dissipated energy and virial, and of the regime where it was decided.

    Parameters
    ----------
    energies : Dataset
        ``dissipation`` and ``virial`` [J], optionally ``regime``.
    """
    arrays = [energies[name] for name in ("dissipation", "virial", "regime") if name in energies]
    sheet = _sheet(arrays, len(arrays))
    for axes, array in zip(sheet.cells, arrays, strict=False):
        if array.name == "regime":
            draw_flags(axes, array)
        else:
            draw_map(axes, array)
    return sheet.lay_out()


def properties_figure(label: str, properties: xr.Dataset) -> Figure:
    """Return the maps of one inversion, by its method.

    Parameters
    ----------
    label : str
        What the result was inverted from, such as "harmonics 1, 2, 3".
    properties : Dataset
        Result of `overtone.map_properties`.

    Returns
    -------
    Figure
        Of ``least-squares``: estimates under their veil, range, quality and status. Of ``exact``: estimates, number
        of solutions and status. Of ``posterior``: median and interval of every property; what each pixel can be
        trusted for is in `certainty_figure`.
    """
    method = method_of(properties)
    if method == POSTERIOR:
        return interval_figure(label, properties)
    if method == EXACT:
        return solutions_figure(label, properties)
    veil = undetermined(properties)
    limits = _shared_limits(properties, veil)
    estimates = {"modulus": "modulus", "adhesion": "adhesion", "indentation": "maximum indentation"}
    others = {
        "modulus_lower": "modulus, lower end (90 %)",
        "modulus_upper": "modulus, upper end (90 %)",
        "amplification": "noise amplification",
        "residual": "residual",
    }
    panels: list[tuple[str, xr.DataArray | None, xr.DataArray | None]]
    panels = [
        (f"{title}, estimate", estimate_of(properties, name), veil) for name, title in estimates.items()
    ]
    panels += [(title, properties.get(name), None) for name, title in others.items()]
    drawn = [(title, array, cover) for title, array, cover in panels if array is not None]
    sheet = _sheet([properties["status"]], len(drawn) + 2)
    for axes, (title, array, cover) in zip(sheet.cells, drawn, strict=False):
        shared = limits if str(array.name).startswith("modulus") else None
        draw_map(axes, array, title=title, undetermined=cover, limits=shared)
    draw_flags(sheet.cells[-2], properties["status"], title="status", legend_axes=sheet.cells[-1])
    return sheet.lay_out(label)


def _sheet(arrays: list[xr.DataArray], count: int) -> Sheet:
    """Return a sheet whose cells have the shape of the first array, or one that says that there is nothing."""
    sheet = Sheet.new(max(count, 1), _COLUMNS, _COLUMN_WIDTH, ratio_of(arrays[0] if arrays else None))
    if count == 0:
        draw_empty(sheet.cells[0])
    return sheet


def _shared_limits(properties: xr.Dataset, veil: xr.DataArray) -> Limits | None:
    """Return limits for the modulus and both ends of its range, as wide as the determined pixels need."""
    modulus = estimate_of(properties, "modulus")
    if modulus is None:
        return None
    mask = veil.values
    if not is_readable(modulus.values, mask):
        return positive_limits(modulus.values)
    bounds = [properties[name] for name in ("modulus_lower", "modulus_upper") if name in properties]
    sure = [array.transpose(*veil.dims).values[~mask] for array in (modulus, *bounds)]
    return positive_limits(np.concatenate(sure))
