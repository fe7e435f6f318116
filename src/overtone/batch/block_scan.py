"""A scan in a Zarr folder: what it says as a whole, and its blocks as observables."""

from __future__ import annotations

import functools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from overtone.batch.inputs import Stamp
from overtone.batch.mapping import merged, properties_of
from overtone.batch.noise import resolve_noise
from overtone.batch.opened import reading_arguments, with_radius
from overtone.batch.settings import Settings, noise_of
from overtone.errors import ObservablesError, OvertoneError

_SAMPLE = 1 << 20  # pixels that tell what a scan says as a whole


@dataclass(frozen=True)
class Plan:
    """What the map of a block needs to know.

    Parameters
    ----------
    file, stamp : Path, Stamp
        Zarr folder of the scan.
    folder : Path
        Where the unfinished map and the marks are.
    settings : Settings
        How it is mapped.
    names : tuple of str
        Observables that are used.
    dims : tuple of str
        Of the pixels.
    attributes : mapping
        Of the observables: how they were read.
    noise : mapping
        Standard deviation of observables [m, rad].
    guard : Dataset
        A good pixel of the file: one line of it goes with each block, so that one where nothing was recorded is mapped
        like any other.
    """

    file: Path
    stamp: Stamp
    folder: Path
    settings: Settings
    names: tuple[str, ...]
    dims: tuple[str, ...]
    attributes: Mapping[str, Any]
    noise: dict[str, float]
    guard: xr.Dataset


@functools.lru_cache(maxsize=4)
def open_source(file: Path, stamp: Stamp) -> xr.Dataset:
    """Return a scan whose values are read when they are needed; checked and opened once a process.

    ``stamp`` is that of the file, so that it is opened again where it has changed.
    """
    from overtone.io.zarr_store import open_lazily

    source: xr.Dataset = open_lazily(file)
    if "A1" not in source:
        raise ObservablesError(
            f"{file.name} holds no observables",
            expected="A1, phi1 and others, as overtone.save writes them",
            got=", ".join(map(str, source.data_vars)) or "nothing",
        )
    dims = source["A1"].dims
    same: xr.Dataset = source[[name for name, array in source.data_vars.items() if array.dims == dims]]
    return same


def loaded(part: xr.Dataset) -> xr.Dataset:
    """Read values in this thread: a worker of a cluster would wait for itself."""
    import dask

    with dask.config.set(scheduler="synchronous"):
        read: xr.Dataset = part.load()
    return read


def observables_in(dataset: xr.Dataset, file: Path, settings: Settings, *, known: bool) -> xr.Dataset:
    """Return observables of a part of a file; with ``known`` without what is said of it."""
    from overtone.io.netcdf import recording_of
    from overtone.io.observables import observables_of
    from overtone.io.opening import kept_warnings, with_history
    from overtone.io.selection import Request

    arguments = reading_arguments(settings)
    request = Request(**arguments, keep_offset=known)
    with kept_warnings() as said:
        recording = recording_of(file, dataset, "zarr")
        observables = observables_of(recording, request)
    if not known:
        observables = with_history(observables, "open_scan", file, request, [*recording.notes, *said])
    return with_radius(observables, settings.radius)


def planned(file: Path, stamp: Stamp, folder: Path, settings: Settings) -> tuple[Plan, xr.Dataset]:
    """Return the plan of a map, and the map of one pixel, which says what every other will hold."""
    from overtone import provenance
    from overtone.inversion.properties import map_energy
    from overtone.readings import probe_of

    source = open_source(file, stamp)
    dims = tuple(str(dim) for dim in source["A1"].dims if dim != "direction")
    sample, step = _sample(source, dims)
    observables = observables_in(sample, file, settings, known=False)
    probe = probe_of(observables)

    def both() -> tuple[xr.Dataset, xr.Dataset]:
        other = {"trace": "retrace", "retrace": "trace"}.get(settings.direction or "")
        if other is None:
            raise OvertoneError(
                "it is not said which of trace and retrace is mapped",
                hint="--direction trace, or --noise scatter",
            )
        ways = (replace(settings, direction=way) for way in (settings.direction, other))
        here, there = (observables_in(sample, file, way, known=True) for way in ways)
        return here, there

    noise, said = resolve_noise(noise_of(settings), observables, probe, pair=both)
    observables = provenance.add_finding(observables, said)
    if step > 1:
        observables = provenance.add_finding(
            observables,
            f"Mapped block by block: what the scan says as a whole, such as its noise, is told from one in {step} of "
            "its lines.",
        )
    good = np.isfinite(observables["A1"].values) & np.isfinite(observables["phi1"].values)
    where = dict(zip(observables["A1"].dims, np.argwhere(good)[0], strict=True))
    pixel = {dim: slice(i, i + 1) for dim, i in where.items()}
    part = observables.isel(pixel)
    properties, _, remarks = properties_of(part, settings, noise)
    part = provenance.add_finding(part, *remarks)
    template = merged(part, map_energy(part, probe, noise=noise), properties)
    guard = sample.isel(pixel)
    for name, array in sample.data_vars.items():
        known = array.values[np.isfinite(array.values)]
        if known.size:
            guard[name] = guard[name].fillna(known[0])
    names = tuple(map(str, observables.data_vars))
    return Plan(file, stamp, folder, settings, names, dims, observables.attrs, noise, guard), template


def _sample(source: xr.Dataset, dims: Sequence[str]) -> tuple[xr.Dataset, int]:
    """Return lines spread over a scan, and how many lines there are to each of them.

    Whole lines, because neighbours along them tell the noise; read band by band, because that of which only a line is
    taken takes as much memory as the whole.
    """
    size, steps = source["A1"].size, {}
    for dim in dims[:-1] or dims:
        steps[dim] = min(math.ceil(size / _SAMPLE), source.sizes[dim])
        size //= steps[dim]
    first, band = dims[0], source["A1"].chunksizes[dims[0]][0]
    bands = []
    for start in range(0, source.sizes[first], band):
        rows = range(start, min(start + band, source.sizes[first]))
        taken = [row for row in rows if row % steps[first] == 0]
        if taken:
            every = {dim: slice(None, None, step) for dim, step in steps.items() if dim != first}
            part = {first: slice(taken[0], taken[-1] + 1, steps[first])}
            bands.append(loaded(source.isel(every | part)).copy(deep=True))
    sample = xr.concat(
        bands, dim=first, coords="minimal", compat="override", join="override", combine_attrs="override"
    )
    return sample, math.prod(steps.values())


def guarded(raw: xr.Dataset, guard: xr.Dataset, first: str) -> xr.Dataset:
    """Return a block with a line of good pixels behind it."""
    arrays = {}
    for name, array in raw.data_vars.items():
        shape = [1 if dim == first else n for dim, n in array.sizes.items()]
        line = np.broadcast_to(guard[name].values, shape)
        values = np.concatenate([array.values, line], axis=array.dims.index(first))
        arrays[name] = (array.dims, values, array.attrs)
    coords = {name: (array.dims, array.values, array.attrs) for name, array in raw.coords.items()}
    if first in coords:
        dims, values, attributes = coords[first]
        coords[first] = (dims, np.append(values, values[-1]), attributes)
    return xr.Dataset(arrays, coords=coords, attrs=raw.attrs)
