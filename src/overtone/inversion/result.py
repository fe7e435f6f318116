"""What every method of inversion returns: names, statuses, and the way values become named maps."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt
import xarray as xr

from overtone.quantities import named_array

DETERMINED = 0
NOT_DETERMINED = 1
START_DEPENDENT = 2
POOR_FIT = 3
AT_BOUND = 4
NOT_CONVERGED = 5
MISSING_DATA = 6
SEVERAL_SOLUTIONS = 7
NO_SOLUTION = 8
NO_CONTACT = 9
STATUS_MEANINGS = {
    DETERMINED: "determined",
    NOT_DETERMINED: "not_determined_by_these_data",
    START_DEPENDENT: "answer_depends_on_start",
    POOR_FIT: "model_does_not_fit",
    AT_BOUND: "at_bound",
    NOT_CONVERGED: "not_converged",
    MISSING_DATA: "missing_data",
    SEVERAL_SOLUTIONS: "several_solutions",
    NO_SOLUTION: "no_physical_solution",
    NO_CONTACT: "no_contact",
}
STATUS_FLAGS = {"flag_values": list(STATUS_MEANINGS), "flag_meanings": " ".join(STATUS_MEANINGS.values())}

WIDEST_DETERMINED = math.log(10.0)
"""A property is determined where what the data allow of it spans less than a factor of ten."""


class Sheet:
    """Maps that fill up block by block, flat, and become a dataset in the end.

    Parameters
    ----------
    like : DataArray
        Gives dimensions, coordinates and shape.
    dtype : str
        Of the maps.
    """

    def __init__(self, like: xr.DataArray, dtype: str = "float64") -> None:
        self.like = like
        self.dtype = np.dtype(dtype)
        self.values: dict[str, npt.NDArray[Any]] = {}
        self.attributes: dict[str, dict[str, object]] = {}

    def add(self, *names: str, extra: int = 0, fill: float = math.nan, dtype: str | None = None) -> None:
        """Add maps, NaN unless filled otherwise; with ``extra`` a last dimension ``solution``."""
        shape = (self.like.size, extra) if extra else (self.like.size,)
        for name in names:
            self.values[name] = np.full(shape, fill, dtype or self.dtype)

    def put(self, name: str, where: npt.NDArray[np.intp] | slice, values: Any) -> None:
        """Write the values of some pixels."""
        self.values[name][where] = values

    def dataset(self, attributes: Mapping[str, object]) -> xr.Dataset:
        """Return the maps as a dataset."""
        arrays = {}
        for name, values in self.values.items():
            dims, shape = self.like.dims, self.like.shape
            if values.ndim == 2:
                dims, shape = (*dims, "solution"), (*shape, values.shape[1])
            arrays[name] = named_array(
                name, values.reshape(shape), dims, self.like.coords, **self.attributes.get(name, {})
            )
        return xr.Dataset(arrays, attrs=dict(attributes))
