"""How a map is cut into blocks: as many whole stored chunks as fit into the memory that a block may take."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import product

import xarray as xr

LARGEST = 1 << 18
"""Pixels of a block at most."""

Region = tuple[slice, ...]


def regions_of(like: xr.DataArray, dims: Sequence[str]) -> list[Region]:
    """Return the blocks that cover an array, each of whole stored chunks, as slices along its dimensions.

    Parameters
    ----------
    like : DataArray
        With chunks.
    dims : sequence of str
        Its dimensions that are cut.
    """
    shape = block_shape(like, dims)
    starts = [range(0, like.sizes[dim], size) for dim, size in zip(dims, shape, strict=True)]
    sizes = [like.sizes[dim] for dim in dims]
    return [
        tuple(slice(a, min(a + n, top)) for a, n, top in zip(corner, shape, sizes, strict=True))
        for corner in product(*starts)
    ]


def block_shape(like: xr.DataArray, dims: Sequence[str]) -> tuple[int, ...]:
    """Return the shape of a block: as many whole chunks as `LARGEST` allows, or the part of one that it allows."""
    chunk = chunk_shape(like, dims)
    shape = list(chunk)
    for axis in reversed(range(len(dims))):  # lines first, as they are stored
        spare = LARGEST // math.prod(shape)
        if spare > 1:
            shape[axis] *= min(spare, math.ceil(like.sizes[dims[axis]] / shape[axis]))
    return tuple(min(n, like.sizes[dim]) for n, dim in zip(shape, dims, strict=True))


def chunk_shape(like: xr.DataArray, dims: Sequence[str]) -> tuple[int, ...]:
    """Return the shape of a stored chunk, or of the part of it that is no larger than a block may be."""
    shape = [like.chunksizes[dim][0] for dim in dims]
    for axis in range(len(dims)):
        if math.prod(shape) > LARGEST:
            shape[axis] = max(1, LARGEST // math.prod(shape[:axis] + shape[axis + 1 :]))
    return tuple(shape)
