"""Observables as phasors: what corrections and regressions work on."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import xarray as xr

from overtone.quantities import harmonic_orders, named_array

_Floats = npt.NDArray[np.float64]
_Complex = npt.NDArray[np.complex128]


class Signals(NamedTuple):
    """Mean deflection and phasors ``a_n = A_n exp(-i phi_n)`` [m], all of one shape."""

    mean: _Floats | None
    """A0 [m], None where it was not measured."""
    phasor: Mapping[int, _Complex]
    """Harmonic, 1 or more, to a_n [m]."""

    @property
    def orders(self) -> tuple[int, ...]:
        """Harmonics that are there, 0 for the mean."""
        return (*((0,) if self.mean is not None else ()), *sorted(self.phasor))


class Positions(NamedTuple):
    """Where pixels lie, about the middle of the scan [m]."""

    height: _Floats
    x: _Floats
    y: _Floats


def positions(scan: xr.Dataset) -> Positions:
    """Return heights and coordinates about their means; what the scan lacks, or a pixel, counts as the mean."""
    like = scan["A1"]

    def about_mean(array: xr.DataArray | None) -> _Floats:
        if array is None:
            return np.zeros(like.shape)
        values = np.asarray(array.broadcast_like(like).transpose(*like.dims).values, dtype=float)
        known = np.isfinite(values)
        return np.where(known, values - (values[known].mean() if known.any() else 0.0), 0.0)

    return Positions(
        about_mean(scan.get("height")),
        about_mean(scan["x"] if "x" in scan.coords else None),
        about_mean(scan["y"] if "y" in scan.coords else None),
    )


def signals_of(observables: xr.Dataset) -> Signals:
    """Return the phasors of observables, on the dimensions of A1."""
    like = observables["A1"]
    orders = harmonic_orders(observables)

    def values(name: str) -> _Floats:
        array = observables[name].broadcast_like(like).transpose(*like.dims)
        return np.asarray(array.values, dtype=float)

    with np.errstate(invalid="ignore"):  # an infinite phase is a lost pixel, as NaN is
        phasor = {n: values(f"A{n}") * np.exp(-1j * values(f"phi{n}")) for n in orders if n > 0}
    return Signals(values("A0") if 0 in orders else None, phasor)


def with_signals(observables: xr.Dataset, signals: Signals) -> xr.Dataset:
    """Return observables with other phasors; whatever else the dataset holds stays, attributes too."""
    like = observables["A1"]
    arrays: dict[str, xr.DataArray] = {}

    def put(name: str, values: _Floats) -> None:
        attributes = observables[name].attrs if name in observables else {}
        arrays[name] = named_array(name, values, like.dims, like.coords).assign_attrs(attributes)

    if signals.mean is not None:
        put("A0", signals.mean)
    for n, a in signals.phasor.items():
        put(f"A{n}", np.abs(a))
        put(f"phi{n}", np.mod(-np.angle(a), 2.0 * math.pi))
    return observables.assign(arrays)


def in_the_frame_of_the_first(signals: Signals) -> dict[int, _Complex]:
    """Return ``e_n = a_n (a_1/|a_1|)^-n`` of the higher harmonics: free of the origin of time [m]."""
    with np.errstate(invalid="ignore", divide="ignore"):
        turn = np.conj(signals.phasor[1]) / np.abs(signals.phasor[1])
        return {n: a * turn**n for n, a in signals.phasor.items() if n > 1}
