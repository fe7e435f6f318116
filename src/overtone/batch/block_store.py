"""The map of a scan while it is not finished: an empty Zarr folder that fills up, and marks of what is done."""

from __future__ import annotations

import glob
import hashlib
import json
import math
import secrets
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from overtone._version import __version__
from overtone.batch.block_shapes import chunk_shape
from overtone.batch.inputs import Stamp
from overtone.batch.record import ATTRIBUTE, Record
from overtone.io.atomic import atomic_path

ZARR = ".zarr"
_MAPS, _DONE = "maps", "done"


def is_begun(folder: Path) -> bool:
    """Tell whether the empty map is there."""
    return (folder / _DONE).is_dir()


def is_done(folder: Path, number: int) -> bool:
    """Tell whether a block is done."""
    return (folder / _DONE / str(number)).is_file()


def put(
    folder: Path, number: int, values: xr.Dataset, region: Mapping[str, slice], counts: Mapping[str, int]
) -> None:
    """Write a block to its place, and mark it as done."""
    import zarr

    root: Any = zarr.open_group(folder / _MAPS, mode="r+", zarr_format=3)
    for name, array in values.data_vars.items():
        root[str(name)][tuple(region.get(str(dim), slice(None)) for dim in array.dims)] = array.values
    with atomic_path(folder / _DONE / str(number)) as temporary:
        temporary.write_text(json.dumps(counts), encoding="utf-8")


def unfinished(work: Path, output: Path, stamp: Stamp, texts: Mapping[str, str]) -> Path:
    """Return the folder of a map that is not finished; those of the same result with other input or settings go."""
    said = json.dumps([stamp.size, stamp.time, dict(texts), __version__], sort_keys=True)
    folder = work / f"{output.stem}-{hashlib.blake2b(said.encode(), digest_size=8).hexdigest()}{ZARR}"
    for other in work.glob(f"{glob.escape(output.stem)}-{'?' * 16}{ZARR}"):
        if other != folder:
            shutil.rmtree(other, ignore_errors=True)
    folder.mkdir(exist_ok=True)
    return folder


def create(folder: Path, template: xr.Dataset, source: xr.Dataset, dims: Sequence[str]) -> None:
    """Make an empty map that has what the one of a pixel has, for every pixel."""
    import zarr
    from zarr.codecs import ZstdCodec

    from overtone.io.attributes import storable_attributes
    from overtone.io.zarr_store import ORDER

    shutil.rmtree(folder / _MAPS, ignore_errors=True)
    root: Any = zarr.create_group(folder / _MAPS, zarr_format=3)
    chunk = dict(zip(dims, chunk_shape(source["A1"], dims), strict=True))
    for name, array in template.variables.items():
        sizes = [source.sizes[dim] if dim in dims else n for dim, n in array.sizes.items()]
        coordinate = source[name].values if name in source.coords else array.values
        stored = root.create_array(
            str(name),
            shape=sizes,
            chunks=[chunk.get(str(dim), n) for dim, n in zip(array.dims, sizes, strict=True)],
            dtype=array.dtype,
            fill_value=math.nan if array.dtype.kind == "f" else 0,
            compressors=(ZstdCodec(level=3, checksum=True),),
            dimension_names=[str(dim) for dim in array.dims],
            attributes=_plain(storable_attributes(array.attrs)),
        )
        if not set(array.dims) & set(dims) or name in source.coords:
            stored[...] = coordinate
    root.attrs.update(_plain(storable_attributes(template.attrs)))
    root.attrs[ORDER] = json.dumps([str(name) for name in template.data_vars])
    (folder / _DONE).mkdir()  # what says that all of this is there


def _plain(attributes: Mapping[str, Any]) -> dict[str, Any]:
    """Return attributes as JSON has them."""
    return {
        name: v.tolist() if isinstance(v, np.ndarray | np.generic) else v for name, v in attributes.items()
    }


def summary(folder: Path, count: int) -> dict[str, Any]:
    """Return how many pixels a map has, and the share of them whose modulus is determined."""
    counts = [json.loads((folder / _DONE / str(i)).read_text(encoding="utf-8")) for i in range(count)]
    pixels = sum(part["pixels"] for part in counts)
    if "determined" not in counts[0]:
        return {"pixels": pixels}
    return {"pixels": pixels, "determined": sum(part["determined"] for part in counts) / pixels}


def finish(folder: Path, output: Path, record: Record, work: Path) -> None:
    """Write what the map says of itself, and move it to its place."""
    import zarr

    maps, aside = folder / _MAPS, work / f"{secrets.token_hex(8)}.old"
    for half in maps.rglob("*.partial"):  # of a worker that was killed
        half.unlink(missing_ok=True)
    zarr.open_group(maps, mode="r+", zarr_format=3).attrs[ATTRIBUTE] = record.text()
    # a folder cannot replace another in one step; killed in between, the next run only has to move
    if output.exists():
        output.rename(aside)
    maps.rename(output)
    shutil.rmtree(aside, ignore_errors=True)
    shutil.rmtree(folder, ignore_errors=True)
