"""The numbers behind the figures of a paper: datasets from which each of them can be drawn again."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import xarray as xr

from overtone.plots.correction import continuous
from overtone.plots.observable_space import Axis, Scatter
from overtone.plots.planes import plane_of
from overtone.plots.results import measured
from overtone.plots.text import typeset
from overtone.quantities import quantity
from overtone.report.paper_content import Paper, materials_of, names_of
from overtone.report.results import PROPERTIES, properties_in, undetermined

_VARIANTS = ("", "_unscreened", "_lower", "_upper")
_ALONE = ("_unpooled", "_unpooled_lower", "_unpooled_upper")
_OF_A_MATERIAL = ("", "_lower", "_upper", "_statistical", "_systematic")
_SCATTERS = {
    ("A0", "A2"): "second harmonic over mean deflection",
    ("phi1", "A2"): "second harmonic over phase",
    ("F_cons_1", "F_cons_2"): "conservative forces, harmonics 1 and 2",
    ("F_cons_0", "F_diss_1"): "dissipative force over mean force",
}
_FEW = 3  # pixels of a phase on a line, below which the line does not show it


def readings_data(paper: Paper) -> xr.Dataset:
    """Return the observables, and where they were corrected those before, named ``<name>_before``."""
    found = {name: paper.observables[name] for name in measured(paper.observables)}
    if paper.before is not None:
        found |= {f"{name}_before": paper.before[name] for name in measured(paper.before) if name != "height"}
    return _maps(found)


def property_data(paper: Paper) -> xr.Dataset:
    """Return every property with its interval, the status, and the height."""
    names = [f"{name}{end}" for name in properties_in(paper.result) for end in _VARIANTS]
    found = {name: paper.result[name] for name in (*names, "status") if name in paper.result}
    return _maps(found | _height(paper))


def phase_data(paper: Paper) -> xr.Dataset:
    """Return phase, its probability, shrinkage and status."""
    names = ("phase", "phase_probability", "shrinkage", "status")
    return _maps({name: paper.result[name] for name in names if name in paper.result})


def force_data(energies: xr.Dataset) -> xr.Dataset:
    """Return forces and energies, a variable ``F_cons_<n>`` or ``F_diss_<n>`` a harmonic."""
    found: dict[str, xr.DataArray] = {}
    for name in energies.data_vars:
        array = energies[name]
        if "harmonic" not in array.dims:
            found[str(name)] = array
            continue
        for n in array["harmonic"].values:
            if n > 0 or name != "F_diss":
                found[f"{name}_{n}"] = array.sel(harmonic=n, drop=True)
    return _maps({name: array for name, array in found.items() if {"y", "x"} <= set(array.dims)})


def scatters_of(paper: Paper) -> list[Scatter]:
    """Return the scatters of observables, and of force harmonics where there are energies, that can be drawn."""
    signals = _signals(paper)
    return [
        Scatter(title, _axis(across, signals[across]), _axis(up, signals[up]))
        for (across, up), title in _SCATTERS.items()
        if across in signals and up in signals
    ]


def space_data(paper: Paper) -> xr.Dataset:
    """Return what the scatters show, with the phase of each pixel."""
    signals = _signals(paper)
    used = {axis.name for scatter in scatters_of(paper) for axis in (scatter.across, scatter.up)}
    return _maps(
        {name: array for name, array in signals.items() if name in used} | {"phase": paper.result["phase"]}
    )


def profile_data(paper: Paper) -> tuple[xr.Dataset, str]:
    """Return the line that crosses most phases, and in words which it is.

    Rows come before columns. Of several lines with as many phases it is the one that leaves the shortest of them the
    most pixels, and of these the one with most determined pixels; a phase counts from three pixels on.
    """
    phase = plane_of(paper.result["phase"])[0]
    sure = ~undetermined(paper.result).transpose(*phase.dims).values
    across, k = _line(np.asarray(phase.values, dtype=int), sure)
    along, at = ("x", "y") if across else ("y", "x")
    found: dict[str, xr.DataArray] = {"phase": paper.result["phase"], **_height(paper)}
    for name in properties_in(paper.result):
        for end in (*_VARIANTS, *_ALONE):
            if f"{name}{end}" in paper.result:
                found[f"{name}{end}"] = paper.result[f"{name}{end}"]
        if paper.truth is not None and name in paper.truth:
            found[f"{name}_truth"] = paper.truth[name]
    line = _maps(found).isel({at: k}, drop=True)
    word = "row" if across else "column"
    return line, f"{word} {k + 1} of {phase.sizes[at]}, along {along}"


def _line(phase: np.ndarray, sure: np.ndarray) -> tuple[bool, int]:
    """Return whether the line to show is a row, and its index."""
    best: tuple[int, int, int] = (-1, -1, -1)
    found = (True, 0)
    for across, lines, known in ((True, phase, sure), (False, phase.T, sure.T)):
        for k in range(lines.shape[0]):
            counts = np.unique(lines[k][lines[k] >= 0], return_counts=True)[1]
            counts = counts[counts >= _FEW]
            score = (
                counts.size,
                int(counts.min(initial=0) if not counts.size else counts.min()),
                int(known[k].sum()),
            )
            if score > best:
                best, found = score, (across, k)
    return found


def material_data(result: xr.Dataset) -> xr.Dataset:
    """Return everything a result holds of its materials, on ``material`` alone."""
    return result[[name for name in result.data_vars if result[name].dims == ("material",)]].drop_attrs(
        deep=False
    )


def law_data(result: xr.Dataset) -> xr.Dataset | None:
    """Return what other laws of contact would change (material, law), None where none was tried."""
    names = ("law_change", "law_gain")
    if any(name not in result for name in names):
        return None
    return result[list(names)].drop_attrs(deep=False)


def check_data(result: xr.Dataset) -> xr.Dataset | None:
    """Return the predictive check (material, row), None where the result has none."""
    names = ("check_observed", "check_lower", "check_upper")
    if any(name not in result for name in names):
        return None
    extra = [name for name in ("material_misfit", "material_misfit_probability") if name in result]
    return result[[*names, *extra]].drop_attrs(deep=False)


def setpoint_data(paper: Paper) -> tuple[xr.Dataset, tuple[str, ...]]:
    """Return medians of the materials over (setpoint, material), and the properties that are there.

    Materials are those of the main result, found by name at the other set-points; one that is not found there is NaN.
    """
    wanted = materials_of(paper.result)
    results = list(zip(paper.setpoints, (paper.result, *paper.others), strict=True))
    names = names_of(paper.result, tuple(PROPERTIES), "material_{}")
    points = []
    for setpoint, result in sorted(results, key=lambda pair: pair[0]):
        rows = {}
        for name in names:
            for end in _OF_A_MATERIAL:
                array = result.get(f"material_{name}{end}")
                values = np.full(len(wanted), np.nan)
                if array is not None and array.dims == ("material",):
                    known = dict(
                        zip(materials_of(result), np.asarray(array.values, dtype=float), strict=True)
                    )
                    values = np.array([known.get(material, np.nan) for material in wanted])
                attributes = (
                    dict(paper.result[f"material_{name}{end}"].attrs)
                    if f"material_{name}{end}" in paper.result
                    else {}
                )
                rows[f"{name}{end}"] = ("material", values, attributes)
        points.append(xr.Dataset(rows, coords={"material": list(wanted)}).expand_dims(setpoint=[setpoint]))
    return xr.concat(points, "setpoint", combine_attrs="override"), names


def _signals(paper: Paper) -> dict[str, xr.DataArray]:
    """Return observables and force harmonics by name, the phase without jumps of a turn."""
    found = {
        name: plane_of(paper.observables[name])[0]
        for name in ("A0", "phi1", "A2")
        if name in paper.observables
    }
    if "phi1" in found:
        found["phi1"] = continuous(found["phi1"])
    if paper.energies is not None:
        forces = force_data(paper.energies)
        found |= {str(name): forces[name] for name in forces.data_vars if str(name).startswith("F_")}
    return found


def _axis(name: str, array: xr.DataArray) -> Axis:
    record = quantity(name)
    if record is not None:
        return Axis(name, typeset(record.symbol), record.unit, np.asarray(array.values, dtype=float).ravel())
    kind, _, order = name.removeprefix("F_").partition("_")
    symbol = rf"$F_{{{order}}}^{{\mathrm{{{kind}}}}}$"
    return Axis(name, symbol, "N", np.asarray(array.values, dtype=float).ravel())


def _height(paper: Paper) -> dict[str, xr.DataArray]:
    return {} if paper.height is None else {"height": paper.height}


def _maps(arrays: dict[str, xr.DataArray]) -> xr.Dataset:
    """Return arrays as one dataset (y, x), with the coordinates of the first."""
    planes = {name: plane_of(array)[0].transpose("y", "x") for name, array in arrays.items()}
    coords = {
        dim: next(iter(planes.values())).coords[dim]
        for dim in ("y", "x")
        if dim in next(iter(planes.values())).coords
    }
    kept = {name: (("y", "x"), plane.values, _attributes(name, plane)) for name, plane in planes.items()}
    return xr.Dataset(kept, coords=coords)


def _attributes(name: str, array: xr.DataArray) -> dict[str, object]:
    """Return what a table says of an array: its unit, and what its numbers stand for where these are categories."""
    record = quantity(name)
    kept: Iterable[str] = ("units", "flag_values", "flag_meanings")
    found = {key: array.attrs[key] for key in kept if key in array.attrs}
    if "units" not in found and record is not None:
        found["units"] = record.unit
    return found
