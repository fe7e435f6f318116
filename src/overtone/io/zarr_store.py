"""Zarr stores (.zarr): folders in which every array lies in blocks, for maps that are larger than the memory.

A store is version 3 of the format with named dimensions, as xarray writes it. Before the library sees it, every
description in it is checked here: sizes, and that it asks for no code beyond the usual compressors, for stores of
version 2 may hold pickled objects, which execute.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from overtone.errors import FileFormatError, ObservablesError, OvertoneError
from overtone.io.atomic import atomic_folder
from overtone.io.attributes import with_storable_attributes
from overtone.io.netcdf import check_dataset, recording_of
from overtone.io.recording import Recording

BLOCK = 128
"""Rows and columns of the blocks of a map; other dimensions are whole in each."""
ORDER = "overtone_order"
"""Attribute with the order of variables: a folder has none."""
_DESCRIPTION = "zarr.json"
_VERSION_2 = (".zgroup", ".zarray", ".zmetadata")
_NUMBERS = frozenset(
    (
        "bool",
        "int8",
        "int16",
        "int32",
        "int64",
        "uint8",
        "uint16",
        "uint32",
        "uint64",
        "float16",
        "float32",
        "float64",
    )
)
_TEXTS = frozenset(("string", "fixed_length_utf32"))
_CODECS = frozenset(
    ("bytes", "zstd", "blosc", "gzip", "crc32c", "transpose", "vlen-utf8", "sharding_indexed")
)
_LONGEST_DESCRIPTION = 64 << 20
_MOST_ARRAYS, _MOST_FILES = 10_000, 1_000_000
# What compression may gain at the most, and what empty blocks, which are not stored, may come to.
_LARGEST_RATIO, _SLACK = 1100, 200 << 20


def sniff(path: Path, head: bytes) -> bool:
    """Tell whether the path is a folder with the description of a Zarr group or array in it."""
    return path.is_dir() and any((path / name).is_file() for name in (_DESCRIPTION, *_VERSION_2))


def save(dataset: xr.Dataset, path: str | Path) -> None:
    """Write a dataset to a Zarr store, whole or not at all.

    Maps are cut into blocks of `BLOCK` rows and columns, compressed without loss and with a checksum each. Arrays
    that dask holds in blocks keep those, and are computed block by block.

    Parameters
    ----------
    dataset : Dataset
        Observables, force harmonics, properties or anything else xarray holds.
    path : str or Path
        Name that ends in ``.zarr``; an existing store is replaced once the new one is complete.

    Raises
    ------
    FileFormatError
        If the name ends otherwise, the folder above does not exist, something that is no store is in the way, or it
        cannot be written.
    ObservablesError
        If the argument is no dataset, or holds arrays that the format cannot.
    """
    target = Path(path)
    if target.suffix.lower() != ".zarr":
        raise FileFormatError(
            f"cannot save {target.name!r} as Zarr",
            expected="a name that ends in .zarr",
            got=repr(target.suffix),
            hint="overtone.save for other formats",
        )
    check_dataset(dataset)
    with _library():
        from zarr.codecs import ZstdCodec
    storable = with_storable_attributes(dataset)
    encoding: dict[Any, Any] = {}
    for name, array in dataset.variables.items():
        if array.dtype.kind == "c":
            raise ObservablesError(
                f"{name} holds complex numbers, which not every reader of Zarr knows",
                hint="save real and imaginary part, or amplitude and phase, as two variables",
            )
        if array.dtype.kind in "US":  # text of fixed length has no specification
            storable[name] = storable[name].astype(object)
        if array.ndim and array.size and array.dtype.kind in "biuf":
            blocks = tuple(
                min(BLOCK, size) if dim in ("y", "x") else size for dim, size in array.sizes.items()
            )
            encoding[name] = {"compressors": (ZstdCodec(level=3, checksum=True),)}
            if array.chunks is None:
                encoding[name]["chunks"] = blocks
    storable.attrs[ORDER] = json.dumps([str(name) for name in dataset.data_vars])
    with atomic_folder(target, lambda old: sniff(old, b"")) as temporary:
        try:
            storable.to_zarr(temporary, mode="w-", zarr_format=3, consolidated=False, encoding=encoding)
        except (OSError, ImportError, OvertoneError):
            raise
        except Exception as error:
            raise ObservablesError(
                "the dataset cannot be written as Zarr",
                got=f"{type(error).__name__} ({error})",
                hint="plain numbers and text in variables, coordinates and names",
            ) from error


def load(path: str | Path) -> xr.Dataset:
    """Return the dataset of a store as it was saved, in memory.

    Parameters
    ----------
    path : str or Path
        A store that :func:`save` wrote, or another of version 3 with named dimensions.

    Raises
    ------
    FileFormatError
        If it is missing, damaged or no such store.
    """
    source = Path(path)
    size, claimed = _check(source)
    if claimed > _LARGEST_RATIO * size + _SLACK:
        raise _damaged(source, f"arrays that fit into a store of {size} bytes", f"{claimed} bytes claimed")
    with _reading(source):
        return _opened(source, chunks=None).load()


def open_lazily(path: str | Path) -> xr.Dataset:
    """Return the dataset of a store with its arrays still on the disk, as dask arrays in the blocks they are stored in.

    Coordinates and text are in memory. Reading a block later raises what the library raises where the store is damaged.

    Parameters
    ----------
    path : str or Path
        A store that :func:`save` wrote, or another of version 3 with named dimensions.

    Raises
    ------
    FileFormatError
        If it is missing, damaged or no such store.
    """
    source = Path(path)
    _check(source)
    with _library():
        import dask.array  # noqa: F401 - what xarray needs for blocks
    with _reading(source):
        return _opened(source, chunks={})


def read(path: Path) -> Recording:
    """Read a Zarr store as a recording: every float variable over known dimensions is a channel.

    The rules are those of `overtone.io.netcdf.read`.

    Parameters
    ----------
    path : Path
        The folder.

    Raises
    ------
    FileFormatError
        If the store is damaged, of another version, or holds no channel.
    """
    return recording_of(path, load(path), "zarr")


# --- the store ------------------------------------------------------------------------------------


def _opened(path: Path, chunks: dict[Any, Any] | None) -> xr.Dataset:
    with _library():
        import zarr  # noqa: F401 - what xarray needs
    dataset: xr.Dataset = xr.open_zarr(
        path, chunks=chunks, consolidated=False, zarr_format=3, decode_times=False
    )
    order = dataset.attrs.pop(ORDER, None)
    names = json.loads(order) if isinstance(order, str) else []
    first = [name for name in names if name in dataset.data_vars] if isinstance(names, list) else []
    rest = sorted(str(name) for name in dataset.data_vars if name not in first)
    dataset = dataset[[*first, *rest]]
    for name, array in dataset.variables.items():
        if array.dtype.kind in "OT":  # text, which netCDF gives back with a fixed length
            dataset[name] = dataset[name].copy(data=np.array(array.values.tolist(), dtype=str))
    return dataset.drop_encoding() if chunks is None else dataset


def _check(path: Path) -> tuple[int, int]:
    """Check every description of a store, and return the bytes it takes and those its arrays claim."""
    if not path.is_dir():
        raise FileFormatError(
            f"there is no Zarr store {str(path)!r}",
            expected="a folder that overtone saved",
            got="a file" if path.exists() else "nothing",
            hint="check the path",
        )
    if not (path / _DESCRIPTION).is_file():
        version_2 = any((path / name).is_file() for name in _VERSION_2)
        raise FileFormatError(
            f"{path.name} is {'a Zarr store of version 2' if version_2 else 'no Zarr store'}",
            expected="a folder with zarr.json in it, which is version 3",
            got="version 2, which may hold code" if version_2 else "none",
            hint="xr.open_zarr(old).to_zarr(new, zarr_format=3)" if version_2 else "check the path",
        )
    root = _description(path, path / _DESCRIPTION)
    if root.get("node_type") != "group":
        raise _damaged(
            path, "a group of arrays", repr(root.get("node_type"))[:40], "open the folder above it"
        )
    size, claimed, files, arrays = 0, 0, 0, 0
    for found in path.rglob("*"):
        files += 1
        if files > _MOST_FILES:
            raise _damaged(path, f"at most {_MOST_FILES} files", "more")
        if not found.is_file():
            continue
        size += found.stat().st_size
        if found.name == _DESCRIPTION and found.parent != path:
            arrays += 1
            if arrays > _MOST_ARRAYS:
                raise _damaged(path, f"at most {_MOST_ARRAYS} arrays", "more")
            claimed += _claimed(path, found)
    return size, claimed


def _description(path: Path, file: Path) -> dict[str, Any]:
    name = file.relative_to(path)
    if file.stat().st_size > _LONGEST_DESCRIPTION:
        raise _damaged(path, f"a description {name} of ordinary size", f"{file.stat().st_size} bytes")
    try:
        found = json.loads(file.read_bytes())
    except (ValueError, RecursionError) as error:
        raise _damaged(path, f"JSON in {name}", str(error)[:80]) from error
    if not isinstance(found, dict) or found.get("zarr_format") != 3:
        raise _damaged(path, f"the description of version 3 in {name}", "another")
    return found


def _claimed(path: Path, file: Path) -> int:
    """Return how many bytes an array takes in memory; refuse types and codecs that are not among the usual."""
    found = _description(path, file)
    if found.get("node_type") != "array":
        return 0  # a group below: xarray does not look into it
    name = file.parent.name
    shape = _sizes(path, name, found.get("shape"), least=0)
    grid = found.get("chunk_grid")
    settings = grid.get("configuration") if isinstance(grid, dict) else None
    chunks = _sizes(path, name, settings.get("chunk_shape") if isinstance(settings, dict) else None, least=1)
    if len(chunks) != len(shape):
        raise _damaged(path, f"blocks of {len(shape)} dimensions in {name}", f"{len(chunks)}")
    kind = found.get("data_type")
    if isinstance(kind, dict):
        kind = kind.get("name")
    if kind not in _NUMBERS | _TEXTS:
        raise _damaged(path, f"numbers or text in {name}", repr(kind)[:40], "save the array as real numbers")
    others = [codec for codec in _codecs(found.get("codecs")) if codec not in _CODECS]
    if others or found.get("storage_transformers"):
        raise _damaged(
            path, f"ordinary compression of {name}", repr(others[:3]), "save it with zstd, gzip or blosc"
        )
    item = 8 if kind in _TEXTS else np.dtype(kind).itemsize
    # A block is unpacked whole, also where it stands over the edge of its array.
    return item * max(math.prod(shape), math.prod(chunks))


def _sizes(path: Path, name: str, given: Any, least: int) -> tuple[int, ...]:
    fine = (
        isinstance(given, list)
        and len(given) <= 32
        and all(type(n) is int and least <= n < 2**48 for n in given)
    )
    if not fine:
        raise _damaged(path, f"sizes of {name}", repr(given)[:40])
    return tuple(given)


def _codecs(given: Any) -> Iterator[str]:
    """Yield the name of every codec, also of those within a shard."""
    for codec in given if isinstance(given, list) else [None]:
        settings = codec.get("configuration", {}) if isinstance(codec, Mapping) else {}
        yield str(codec.get("name")) if isinstance(codec, Mapping) else repr(codec)[:40]
        for inner in ("codecs", "index_codecs"):
            if isinstance(settings, Mapping) and inner in settings:
                yield from _codecs(settings[inner])


@contextmanager
def _library() -> Iterator[None]:
    try:
        yield
    except ImportError as error:
        raise OvertoneError(
            "Zarr stores need libraries that are not installed",
            got=str(error),
            hint='pip install "overtone[cluster]"',
        ) from error


@contextmanager
def _reading(path: Path) -> Iterator[None]:
    try:
        yield
    except (OvertoneError, ImportError):
        raise
    except Exception as error:  # zarr and its codecs raise nearly every kind there is
        raise FileFormatError(
            f"{path.name} cannot be read as a Zarr store",
            expected="a whole store of version 3 with named dimensions",
            got=f"{type(error).__name__} ({str(error)[:200]})",
            hint="copy the folder again, with all that is in it",
        ) from error


def _damaged(path: Path, expected: str, got: str, hint: str = "copy the folder again") -> FileFormatError:
    return FileFormatError(
        f"{path.name} is not a Zarr store that overtone reads", expected=expected, got=got, hint=hint
    )
