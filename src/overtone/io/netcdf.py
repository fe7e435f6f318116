"""netCDF: the files that overtone writes itself, and others' that keep to named dimensions and units."""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Hashable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import numpy.typing as npt
import xarray as xr

from overtone.errors import FileFormatError, ObservablesError
from overtone.io import hdf5_guard
from overtone.io.atomic import atomic_path
from overtone.io.attributes import as_text, with_storable_attributes
from overtone.io.recording import Channel, Fact, Recording
from overtone.io.si import to_si
from overtone.quantities import LIFT

HDF5 = b"\x89HDF\r\n\x1a\n"
"""How netCDF 4 begins, and every other HDF5 file."""
_CLASSIC = b"CDF"
# A file that overtone saves ends with this line and the digest of all that stands before it. HDF5
# ignores what follows its own end and cuts it off when another program changes the file.
_SEAL = b"\novertone blake2b "
_DIGEST_SIZE = 32
_AXES = {"y": "m", "x": "m", "z": "m", "time": "s"}
_KNOWN_DIMS = {*_AXES, "setpoint", "scan", "point"}
REFERENCE = "reference"
"""Flags of the pixels that a correction was anchored to: whole numbers, and a channel all the same."""
_DIRECTIONS = ("trace", "retrace", "approach", "retract")
# Deflate cannot shrink data more than this; whoever claims more has a damaged header.
_LARGEST_RATIO = 1100
_SLACK = 1 << 22


def sniff(path: Path, head: bytes) -> bool:
    """Tell whether the file begins like netCDF 4, which is HDF5, or like classic netCDF."""
    return head.startswith((HDF5, _CLASSIC))


def save(dataset: xr.Dataset, path: str | Path) -> None:
    """Write a dataset to a netCDF file, whole or not at all.

    Arrays of floats are compressed without loss. The file ends with a digest, so that damage is noticed when it is
    read again. Attributes that netCDF cannot hold, such as None, truth values and nested records, are written as JSON
    text. `overtone.io.export.save` writes other formats as well.

    Parameters
    ----------
    dataset : Dataset
        Observables, force harmonics, properties or anything else xarray holds.
    path : str or Path
        Name that ends in ``.nc``; an existing file is replaced once the new one is complete.

    Raises
    ------
    FileFormatError
        If the name ends otherwise, the folder does not exist or the file cannot be written.
    ObservablesError
        If the argument is no dataset, or holds arrays that the format cannot.
    """
    target = Path(path)
    if target.suffix.lower() != ".nc":
        raise FileFormatError(
            f"cannot save {target.name!r} as netCDF",
            expected="a name that ends in .nc",
            got=repr(target.suffix),
            hint="overtone.save for other formats",
        )
    check_dataset(dataset)
    for name, array in dataset.variables.items():
        if array.dtype.kind == "c":
            raise ObservablesError(
                f"{name} holds complex numbers, which netCDF does not",
                hint="save real and imaginary part, or amplitude and phase, as two variables",
            )
    storable = with_storable_attributes(dataset)
    encoding = {
        name: {"zlib": True, "complevel": 4}
        for name, array in storable.variables.items()
        if array.dtype.kind == "f" and array.ndim > 0 and array.size > 0
    }
    with atomic_path(target) as temporary:
        try:
            storable.to_netcdf(temporary, engine="h5netcdf", encoding=encoding)
        except (OSError, ImportError):
            raise
        except Exception as error:
            raise ObservablesError(
                "the dataset cannot be written as netCDF",
                got=f"{type(error).__name__} ({error})",
                hint="plain numbers and text in variables, coordinates and names",
            ) from error
        digest = _digest(temporary, temporary.stat().st_size)
        with temporary.open("ab") as stream:
            stream.write(_SEAL + digest)


def check_dataset(dataset: object) -> None:
    """Refuse what is no dataset.

    Raises
    ------
    ObservablesError
        If it is none.
    """
    if not isinstance(dataset, xr.Dataset):
        raise ObservablesError(
            "only datasets can be saved",
            expected="an xarray.Dataset",
            got=type(dataset).__name__,
            hint="array.to_dataset(name=...) for a single array",
        )


def load(path: str | Path) -> xr.Dataset:
    """Return the dataset of a netCDF file as it was saved, in memory, with the file closed.

    Parameters
    ----------
    path : str or Path
        A file that :func:`save` wrote.

    Raises
    ------
    FileFormatError
        If the file is missing, damaged or no netCDF.
    """
    source = Path(path)
    if not source.is_file():
        raise FileFormatError(
            f"there is no file {str(source)!r}",
            expected="a netCDF file",
            got="nothing",
            hint="check the path",
        )
    with _reading(source), source.open("rb") as stream:
        head = stream.read(8)
    if not sniff(source, head):
        raise FileFormatError(
            f"{source.name} is no netCDF file",
            expected="a file that overtone saved",
            got=repr(head) if head else "an empty file",
            hint="read_channels for the files of a microscope",
        )
    return _load(source, head)


def read(path: Path) -> Recording:
    """Read a netCDF file as a recording: every float variable over known dimensions is a channel.

    A recording has one set of dimensions, that of ``A1`` or else the commonest; variables over others are left
    out, and notes name them. A dimension, a single value or an attribute ``direction`` (trace and retrace,
    approach and retract) becomes that of the channels. Variables ``lift_A0``, ``lift_A1``, ``lift_phi1``, ...
    are the Nap or Lift pass of the same scan.

    Parameters
    ----------
    path : Path
        The .nc file.

    Raises
    ------
    FileFormatError
        If the file is damaged, is HDF5 of another layout, or holds no channel.
    """
    with path.open("rb") as stream:
        dataset = _load(path, stream.read(8))
    return recording_of(path, dataset, "netcdf")


def recording_of(path: Path, dataset: xr.Dataset, form: str) -> Recording:
    """Return the recording that a dataset is, as `read` does; ``form`` is the key of the file's format.

    Raises
    ------
    FileFormatError
        If it holds no channel.
    """
    notes: list[str] = []
    stated = dataset.attrs.get("direction")
    only = str(stated) if stated in _DIRECTIONS else None
    parts = [
        (part, values, only if way is None else way)
        for name, array in dataset.data_vars.items()
        for part, values, way in _by_direction(str(name), array)
    ]
    usable = [
        (name, array, direction)
        for name, array, direction in parts
        if (array.dtype.kind == "f" or (name == REFERENCE and array.dtype.kind in "iu"))
        and array.ndim > 0
        and array.size > 0
        and set(array.dims) <= _KNOWN_DIMS
    ]
    if not usable:
        raise FileFormatError(
            f"{path.name} holds no channel",
            expected="arrays of floats over y and x, z, time or point",
            got=_listed({name: array.dims for name, array in dataset.data_vars.items()}) or "no variables",
            hint="a file that overtone saved, or one with these dimension names",
        )
    dims = _common_dims({name: array for name, array, _ in usable})
    channels = [
        _channel(name, array, direction, notes) for name, array, direction in usable if array.dims == dims
    ]
    left_out = [str(name) for name in dataset.data_vars if name not in {channel.name for channel in channels}]
    if left_out:
        notes.append(
            f"left out, because they are not floats over {' and '.join(dims)}: {', '.join(left_out)}"
        )
    metadata = {str(key): as_text(value) for key, value in dataset.attrs.items()}
    if "z" in dims and "z" in dataset.coords and "zero" in dataset["z"].attrs:
        metadata["zero of z"] = as_text(dataset["z"].attrs["zero"])
    facts = {}
    lift_height = dataset.attrs.get("lift_height")
    if isinstance(lift_height, float | np.floating) and any(channel.nap for channel in channels):
        facts["lift_height"] = Fact(float(lift_height), "m", "lift_height")
    return Recording(
        path=path,
        format=form,
        vendor="overtone",
        dims=dims,
        coords=_coordinates(dataset, dims, notes),
        channels=tuple(channels),
        facts=facts,
        metadata=metadata,
        notes=tuple(dict.fromkeys(notes)),
    )


# --- reading --------------------------------------------------------------------------------------


def _load(path: Path, head: bytes) -> xr.Dataset:
    if head.startswith(_CLASSIC):
        raise FileFormatError(
            f"{path.name} is a classic netCDF file",
            expected="netCDF 4, which is what overtone writes",
            got=f"version {head[3:4]!r} of the classic format",
            hint="convert it with: nccopy -k nc4 old.nc new.nc",
        )
    with _reading(path):
        sealed = check_seal(path)
    if not sealed:  # nothing tells damage from data, and some damage HDF5 never returns from
        hdf5_guard.check(path, f"{__name__}:{_unguarded.__name__}")
    return _unguarded(path)


def _unguarded(path: Path) -> xr.Dataset:
    with _reading(path):
        _open_once(path)
        dataset = xr.open_dataset(path, engine="h5netcdf", decode_times=False)
    with dataset, _reading(path):
        if not dataset.variables:
            raise FileFormatError(
                f"{path.name} is HDF5, but not in the layout of netCDF",
                expected="arrays with named dimensions at the top of the file",
                got="none",
                hint="export other HDF5 files as netCDF or .gsf",
            )
        # Compressed arrays may be larger than the file, but not by any factor.
        claimed, size = dataset.nbytes, path.stat().st_size
        if claimed > _LARGEST_RATIO * size + _SLACK:
            raise FileFormatError(
                f"{path.name} is damaged",
                expected=f"arrays that fit into a file of {size} bytes",
                got=f"{claimed} bytes claimed",
                hint="copy the file again",
            )
        return dataset.load()


def is_sealed(path: Path) -> bool:
    """Tell whether a file ends as those do that overtone saves, whatever else is in it."""
    return _seal(path) is not None


def _seal(path: Path) -> tuple[int, bytes] | None:
    """Return how long the content before a seal is, and the digest in it; None where there is no seal."""
    size = path.stat().st_size - len(_SEAL) - _DIGEST_SIZE
    if size < 0:
        return None
    with path.open("rb") as stream:
        stream.seek(size)
        end = stream.read()
    return (size, end.removeprefix(_SEAL)) if end.startswith(_SEAL) else None


def check_seal(path: Path) -> bool:
    """Tell whether a file is sealed; refuse one that has changed, before HDF5, which damage can send astray.

    Raises
    ------
    FileFormatError
        If the content is not that of the digest in the seal.
    """
    found = _seal(path)
    if found is not None and found[1] != _digest(path, found[0]):
        raise FileFormatError(
            f"{path.name} is damaged",
            expected="the content that overtone saved",
            got="another digest",
            hint="copy the file again",
        )
    return found is not None


def _digest(path: Path, size: int) -> bytes:
    """Return the digest of the first ``size`` bytes of a file."""
    digest = hashlib.blake2b(digest_size=_DIGEST_SIZE)
    with path.open("rb") as stream:
        while size > 0 and (block := stream.read(min(size, 1 << 20))):
            digest.update(block)
            size -= len(block)
    return digest.digest()


def _open_once(path: Path) -> None:
    # h5netcdf reads this attribute while it opens a file; where that fails, it leaves an object
    # behind that prints a traceback when it is thrown away. So it is tried here first.
    import h5py

    with h5py.File(path, "r") as file:
        file.attrs.get("_nc3_strict")


@contextmanager
def _reading(path: Path) -> Iterator[None]:
    try:
        yield
    except (FileFormatError, ImportError):
        raise
    # h5py raises nearly every kind there is, for damaged files and for other layouts alike.
    except Exception as error:
        raise FileFormatError(
            f"{path.name} cannot be read as netCDF",
            expected="a whole HDF5 file in the layout of netCDF 4",
            got=f"{type(error).__name__} ({str(error)[:200]})",
            hint="copy the file again, or export other HDF5 files as netCDF or .gsf",
        ) from error


def _common_dims(usable: dict[str, xr.DataArray]) -> tuple[str, ...]:
    if "A1" in usable:
        return tuple(map(str, usable["A1"].dims))
    counts = Counter(array.dims for array in usable.values())
    return tuple(map(str, counts.most_common(1)[0][0]))


def _by_direction(name: str, array: xr.DataArray) -> list[tuple[str, xr.DataArray, str | None]]:
    """Return a variable once for each direction that it holds, or as it is."""
    if "direction" not in array.coords:
        return [(name, array, None)]
    if "direction" not in array.dims:  # one direction, taken out of several
        one = array["direction"]
        return [(name, array, str(one.values) if one.ndim == 0 and one.dtype.kind in "UTO" else None)]
    names = array["direction"].values
    return [(name, array.isel(direction=k, drop=True), str(names[k])) for k in range(names.size)]


def _channel(name: str, array: xr.DataArray, direction: str | None, notes: list[str]) -> Channel:
    values = array.values.astype(np.float64)
    nap = name.startswith(LIFT)
    stated = str(array.attrs.get("units", "")).strip()
    known = to_si(stated) if stated else None
    if known is None:
        notes.append(
            f"{name}: the unit {stated!r} is not known" if stated else f"{name}: the file states no unit"
        )
        return Channel(name, values, None, direction, nap)
    return Channel(name, values * known[0], known[1], direction, nap)


def _coordinates(
    dataset: xr.Dataset, dims: tuple[str, ...], notes: list[str]
) -> dict[str, npt.NDArray[np.float64]]:
    coords: dict[str, npt.NDArray[np.float64]] = {}
    for name in dims:
        if (
            name not in dataset.coords
            or dataset[name].dtype.kind not in "fiu"
            or dataset[name].dims != (name,)
        ):
            continue
        values = dataset[name].values.astype(np.float64)
        stated = str(dataset[name].attrs.get("units", "")).strip()
        unit = _AXES.get(name)
        known = to_si(stated) if stated else (1.0, unit or "")
        if known is None or unit not in (None, known[1]):
            kind = "time" if unit == "s" else "length"
            notes.append(f"coordinate {name}: {stated!r} is no {kind}, so it was left out")
            continue
        if unit is not None and not stated:
            assumed = "seconds" if unit == "s" else "metres"
            notes.append(f"coordinate {name}: the file states no unit; {assumed} were assumed")
        coords[name] = values * known[0]
    return coords


def _listed(dims: dict[Hashable, tuple[Hashable, ...]]) -> str:
    return ", ".join(f"{name}({', '.join(map(str, over))})" for name, over in list(dims.items())[:8])
