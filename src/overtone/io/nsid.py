"""HDF5 files of pycroscopy: the N-dimensional layout NSID and its predecessor USID.

Both keep a measurement in a group ``Measurement_000`` with a dataset for each channel, which says its ``quantity``
and ``units``. In NSID its dimensions are named and lie beside it as scales. In USID it is a table of positions by
spectroscopic steps, and two further tables give the place of each position. What came from Asylum's .ibw keeps their
note as attributes of ``original_metadata`` and, as the wave does, counts rows from the bottom.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from overtone.errors import FileFormatError
from overtone.io import asylum, hdf5_guard
from overtone.io.recording import Channel, Recording
from overtone.io.si import to_si

_GROUP, _OF_JPK, _OF_NETCDF = b"Measurement_", b"jpkspm", b"_NCProperties"
_SEARCHED = 1 << 20
_DEEPEST, _MOST_OBJECTS, _MOST_ATTRIBUTES = 6, 5000, 5000
_SLACK = 200 << 20
_AXES = ("y", "x")
# pycroscopy keeps the last of two values of a key, which is a number here; of six files of the instrument each that
# says "Initial ImagingMode: 1" says "ImagingMode: AC Mode" as well, and 3 goes with PFM.
_IMAGING_MODES = {"1": "AC Mode", "3": "PFM Mode"}

_Floats = npt.NDArray[np.float64]


@dataclass(frozen=True)
class _Map:
    """One channel, still as the file orders it."""

    index: int
    """Among all channels of the file, which Asylum's settings go by."""
    label: str
    unit: str
    values: _Floats
    """Over y and x, in the order of the file's own y."""
    y: _Floats | None
    x: _Floats | None
    """Positions [m], None where the file gives no lengths."""


def sniff(path: Path, head: bytes) -> bool:
    """Tell whether the file is HDF5 with a group of measurements, and none of JPK or of overtone itself."""
    if not head.startswith(hdf5_guard.MAGIC):
        return False
    with path.open("rb") as stream:
        start = stream.read(_SEARCHED)
    # By its bytes alone: opening a damaged file may end the process. netCDF may speak of measurements in its history.
    return _GROUP in start and not any(mark in start for mark in (_OF_JPK, _OF_NETCDF))


def read(path: Path) -> Recording:
    """Read every image of the first measurement of an NSID or USID file.

    A label such as ``HeightRetrace`` is split into name and direction, as the labels of an .ibw are. Row 0 is the
    top: the row with the largest y of what came from Asylum's waves, the first row of anything else, as pycroscopy
    shows it. Spectra, further measurements and images of another size than the commonest are left out, and notes
    name them.

    Parameters
    ----------
    path : Path
        The .h5 or .hf5 file.

    Raises
    ------
    FileFormatError
        If the file is damaged or holds no image.
    """
    hdf5_guard.check(path, f"{__name__}:{parts_of.__name__}")
    names, metadata, maps, others = parts_of(path)
    notes: list[str] = []
    if not maps:
        raise _no_image(path, others)
    if len(names) > 1:
        notes.append(f"left out: {', '.join(names[1:5])}; only {names[0]} was read")
    shape = Counter(one.values.shape for one in maps).most_common(1)[0][0]
    others += [one.label for one in maps if one.values.shape != shape]
    if others:
        notes.append(f"left out, because they are no images or of another size: {', '.join(others[:8])}")
    kept = [one for one in maps if one.values.shape == shape]
    mode = _IMAGING_MODES.get(metadata.get("ImagingMode", ""))
    if mode is not None:
        notes.append(f"ImagingMode {metadata['ImagingMode']} is {mode}")
        metadata["ImagingMode"] = mode
    settings = asylum.Settings(metadata)
    is_asylum = asylum.is_asylum(settings)
    first = next((one for one in kept if one.y is not None and one.x is not None), kept[0])
    upside_down = is_asylum and (first.y is None or _ascends(first.y))
    channels = tuple(_channel(one, upside_down, settings if is_asylum else None, notes) for one in kept)
    if is_asylum:
        notes.extend(asylum.changed_during_the_scan(metadata.items()))
    else:
        notes.append("the file does not say which way up its images are; the first row was taken as the top")
    return Recording(
        path=path,
        format="nsid",
        vendor="asylum" if is_asylum else "pycroscopy",
        dims=_AXES,
        coords=_coordinates(first, notes),
        channels=channels,
        facts=asylum.facts_of(settings, {channel.name for channel in channels}) if is_asylum else {},
        resonances=asylum.resonances_of(settings, notes) if is_asylum else (),
        metadata=metadata,
        notes=tuple(notes),
    )


# --- the file -------------------------------------------------------------------------------------


def parts_of(path: Path) -> tuple[list[str], dict[str, str], list[_Map], list[str]]:
    """Return all that is read of a file: names of measurements, settings, images, and what is no image.

    Raises
    ------
    FileFormatError
        If the file is damaged or of another layout.
    """
    import h5py

    try:
        with h5py.File(path, "r") as file:
            names = sorted(key for key in file if key.startswith(_GROUP.decode()))
            group = file[names[0]] if names else None
            if not isinstance(group, h5py.Group):
                raise _no_image(path, names)
            return names, _metadata(group), *_maps(path, group)
    except (FileFormatError, MemoryError):
        raise
    except Exception as error:  # h5py raises nearly every kind there is for damaged files
        raise FileFormatError(
            f"{path.name} cannot be read as NSID or USID",
            expected="a whole HDF5 file of pycroscopy",
            got=f"{type(error).__name__} ({str(error)[:200]})",
            hint="copy the file again",
        ) from error


def _objects(group: Any, depth: int = 0) -> Iterator[tuple[Any, Any]]:
    """Yield every dataset below a group with the group it lies in; links to other places are not followed."""
    import h5py

    for key in sorted(group, key=_natural):
        if not isinstance(group.get(key, getlink=True), h5py.HardLink):
            continue
        found = group[key]
        if isinstance(found, h5py.Dataset):
            yield group, found
        elif isinstance(found, h5py.Group) and depth < _DEEPEST:
            yield from _objects(found, depth + 1)


def _natural(name: str) -> tuple[str, int]:
    """Order Channel_2 before Channel_10."""
    stem = name.rstrip("0123456789")
    digits = name[len(stem) :]
    return stem, int(digits) if 0 < len(digits) < 10 else -1


def _maps(path: Path, group: Any) -> tuple[list[_Map], list[str]]:
    """Return the images of a measurement, and the names of the channels that are none."""
    maps: list[_Map] = []
    others: list[str] = []
    claimed = 0
    for count, (parent, dataset) in enumerate(_objects(group)):
        if count >= _MOST_OBJECTS:
            raise _damaged(path, f"at most {_MOST_OBJECTS} datasets", "more")
        attributes = dataset.attrs
        if "quantity" not in attributes or "units" not in attributes or "CLASS" in attributes:
            continue  # a scale, a table of positions or something else beside the channels
        label = _text(attributes["quantity"]).strip() or dataset.name.rsplit("/", 1)[-1]
        if dataset.dtype.kind not in "fiu" or dataset.is_virtual or dataset.external or dataset.size == 0:
            others.append(label)
            continue
        # Two copies in memory at the most, as doubles.
        claimed += 16 * int(dataset.size)
        if claimed > 10 * path.stat().st_size + _SLACK:
            raise _damaged(path, f"channels that fit into a file of {path.stat().st_size} bytes", label)
        read_one = _positions_by_steps if "Position_Indices" in attributes else _named_dimensions
        one = read_one(path, parent, dataset, label, len(maps) + len(others))
        if one is None:
            others.append(label)
        else:
            maps.append(one)
    return maps, others


def _named_dimensions(path: Path, group: Any, dataset: Any, label: str, index: int) -> _Map | None:
    """Return an NSID channel over dimensions x and y in either order, None where it has others."""
    names = [str(dimension.label).lower() for dimension in dataset.dims]
    if sorted(names) != sorted(_AXES):
        return None
    values = _values(dataset)
    if names == ["x", "y"]:
        values = values.T
    y, x = (
        _scale(group, _text(dataset.dims[names.index(axis)].label), values.shape[i])
        for i, axis in enumerate(_AXES)
    )
    return _Map(index, label, _text(dataset.attrs["units"]).strip(), values, y, x)


def _scale(group: Any, name: str, length: int) -> _Floats | None:
    """Return the positions [m] along a dimension, None where there are none or none in units of length."""
    if name not in group or group[name].shape != (length,) or group[name].dtype.kind not in "fiu":
        return None
    known = to_si(_text(group[name].attrs.get("units", "")))
    if known is None or known[1] != "m":
        return None
    return _usable(_values(group[name]) * known[0])


def _positions_by_steps(path: Path, group: Any, dataset: Any, label: str, index: int) -> _Map | None:
    """Return a USID channel of one step over a full grid of positions X and Y, None where it is another."""
    if dataset.ndim != 2 or dataset.shape[1] != 1:
        return None
    indices, places = (dataset.file[dataset.attrs[key]] for key in ("Position_Indices", "Position_Values"))
    names = [_text(name).lower() for name in np.atleast_1d(indices.attrs.get("labels", ()))]
    if (
        sorted(names) != sorted(_AXES)
        or indices.shape != (dataset.shape[0], 2)
        or places.shape != indices.shape
    ):
        return None
    row, column = (np.asarray(indices[:, names.index(axis)], dtype=np.int64) for axis in _AXES)
    rows, columns = int(row.max()) + 1, int(column.max()) + 1
    pixel = row * columns + column
    if (
        rows * columns != pixel.size
        or row.min() < 0
        or column.min() < 0
        or np.unique(pixel).size != pixel.size
    ):
        raise _damaged(
            path, f"a full grid of positions of {label}", f"{pixel.size} positions, {columns} x {rows}"
        )
    order = np.argsort(pixel)
    units = [_text(unit) for unit in np.atleast_1d(places.attrs.get("units", ()))]
    axes: list[_Floats | None] = []
    for axis, picked in (("y", order[::columns]), ("x", order[:columns])):
        k = names.index(axis)
        known = to_si(units[k]) if len(units) == 2 else None
        lengths = known is not None and known[1] == "m"
        axes.append(
            _usable(np.asarray(places[:, k], dtype=float)[picked] * known[0]) if known and lengths else None
        )
    return _Map(
        index,
        label,
        _text(dataset.attrs["units"]).strip(),
        _values(dataset)[order, 0].reshape(rows, columns),
        *axes,
    )


def _usable(positions: _Floats) -> _Floats | None:
    steps = np.diff(positions)
    fine = np.isfinite(positions).all() and ((steps > 0.0).all() or (steps < 0.0).all())
    return positions if fine else None


def _values(dataset: Any) -> _Floats:
    with np.errstate(invalid="ignore"):  # a signalling NaN is a NaN like any other
        return np.asarray(dataset[()]).astype(np.float64)


def _metadata(group: Any, depth: int = 0) -> dict[str, str]:
    """Return the attributes of the first group of original metadata below a group, as text."""
    import h5py

    for key in sorted(group, key=_natural)[:_MOST_OBJECTS]:
        if not isinstance(group.get(key, getlink=True), h5py.HardLink):
            continue
        found = group[key]
        if not isinstance(found, h5py.Group):
            continue
        if key == "original_metadata":
            return {str(name): _text(found.attrs[name]) for name in list(found.attrs)[:_MOST_ATTRIBUTES]}
        below = _metadata(found, depth + 1) if depth < _DEEPEST else {}
        if below:
            return below
    # The settings of USID files are attributes of the measurement itself.
    return (
        {str(name): _text(group.attrs[name]) for name in list(group.attrs)[:_MOST_ATTRIBUTES]}
        if depth == 0
        else {}
    )


def _text(value: Any) -> str:
    if isinstance(value, bytes):
        return value.decode("latin-1").replace("\0", "")
    return str(value)


def _no_image(path: Path, got: list[str]) -> FileFormatError:
    return FileFormatError(
        f"{path.name} holds no image in the layout of NSID or USID",
        expected="a group Measurement_000 with datasets over x and y",
        got=", ".join(got[:8]) or "none",
        hint="export the channels as one table (CSV) with units in its header, or as netCDF",
    )


def _damaged(path: Path, expected: str, got: str) -> FileFormatError:
    return FileFormatError(f"{path.name} is damaged", expected=expected, got=got, hint="copy the file again")


# --- what it says ---------------------------------------------------------------------------------


def _ascends(positions: _Floats) -> bool:
    return bool(positions[0] <= positions[-1])


def _channel(one: _Map, upside_down: bool, settings: asylum.Settings | None, notes: list[str]) -> Channel:
    name, direction = asylum.split_label(one.label)
    factor, unit = _unit(name, one.unit, settings is not None, notes)
    values = one.values[::-1] if upside_down else one.values
    return Channel(
        name=name,
        values=np.ascontiguousarray(values) * factor,
        unit=unit,
        direction=direction,
        nap=asylum.is_nap(name) if settings is not None else False,
        flattened=asylum.is_flattened(one.index, settings) if settings is not None else None,
    )


def _unit(name: str, stated: str, is_asylum: bool, notes: list[str]) -> tuple[float, str | None]:
    """Return the factor to SI and the unit; what came from an .ibw has metres written to whatever it did not know."""
    known = to_si(stated) if stated else None
    if is_asylum and known == (1.0, "m"):
        known = asylum.unit_of_kind(name)
        if known is None:
            notes.append(f"{name}: 'm' is what pycroscopy writes where it knows no unit, so there is none")
        elif known != (1.0, "m"):
            notes.append(f"{name}: is no length, whatever the file says; its unit is {known[1]}")
    elif known is None:
        notes.append(
            f"{name}: the unit {stated!r} is not known; values are as in the file"
            if stated
            else f"{name}: the file states no unit"
        )
    return known if known is not None else (1.0, None)


def _coordinates(first: _Map, notes: list[str]) -> dict[str, _Floats]:
    """Return coordinates [m], row 0 with the largest y."""
    if first.y is None or first.x is None:
        notes.append("the file states no usable image size, so there are no coordinates")
        return {}
    y = first.y
    if _ascends(y):
        # Turned over with the image, or counted downwards from the first row: the same numbers.
        y = np.ascontiguousarray(y[0] + y[-1] - y)
    return {"y": y, "x": first.x}
