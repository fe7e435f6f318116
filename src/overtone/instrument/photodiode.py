"""Optical detection: a laser spot on a split photodiode, and what a lock-in reads from it in the steady state.

The diode tells how much more light falls on one half than on the other. The harmonics it fakes come out of
the shape of the spot here, not out of a polynomial, so that a correction that fits polynomials is tested
against something it was not built on. Deflections and spot sizes share one scale, metres of deflection.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import xarray as xr

from overtone import provenance
from overtone.errors import ObservablesError, OvertoneError
from overtone.quantities import harmonic_orders, named_array, quantity, validate_observables

ROUND = "round"
SQUARE = "square"
GAUSSIAN = "gaussian"

_Floats = npt.NDArray[np.float64]
_FAINTEST_SLOPE = 1e-2  # of the centred spot's: beyond, nobody would call the laser aligned
_ALIASING = 1e-6  # of the stroke: the highest harmonics of the reading must have died down to this
_BLOCK = 2**20  # samples in memory at a time


@dataclass(frozen=True)
class SplitDiode:
    """A spot of light on a photodiode of two halves.

    Parameters
    ----------
    spot : float
        Full width of the spot [m of deflection]: diameter of a round one, side of a square one, four
        standard deviations (the 1/e^2 diameter) of a Gaussian one.
    shape : str
        ``round`` or ``square`` (evenly lit) or ``gaussian``.
    offset : float
        Where the spot's centre rests, from the middle of the diode [m of deflection].
    gap : float
        Width of the dead zone between the halves [m of deflection].

    Raises
    ------
    OvertoneError
        If a number is unphysical, or at rest the spot is so far on one half or so deep in the gap that its
        motion hardly changes the reading.
    """

    spot: float
    shape: str = ROUND
    offset: float = 0.0
    gap: float = 0.0

    def __post_init__(self) -> None:
        if self.shape not in _RESPONSES:
            raise OvertoneError(
                "unknown shape of a laser spot", expected=" or ".join(_RESPONSES), got=repr(self.shape)
            )
        if not (0.0 < self.spot < math.inf and math.isfinite(self.offset) and 0.0 <= self.gap < math.inf):
            raise OvertoneError(
                "unphysical photodiode",
                expected="a finite spot > 0, a finite offset and a finite gap >= 0",
                got=f"spot = {self.spot!r}, offset = {self.offset!r}, gap = {self.gap!r}",
            )
        centred = _RESPONSES[self.shape](np.zeros(1))[1].item() * 2.0 / self.spot
        slope = _difference(self, np.array([self.offset]))[1].item()
        if not slope >= _FAINTEST_SLOPE * centred:
            raise OvertoneError(
                "the laser is not aligned",
                expected=f"a slope at rest of at least {_FAINTEST_SLOPE:.0%} of the centred spot's without gap",
                got=f"{slope / centred:.2g} of it",
                hint="an offset below half the spot and a gap below the spot",
            )


def _round(x: _Floats) -> tuple[_Floats, _Floats]:
    """Return difference of light over total light and its derivative; x = centre over half width."""
    x = np.clip(x, -1.0, 1.0)  # beyond, the spot has left one half
    chord = np.sqrt(1.0 - x * x)
    return (x * chord + np.arcsin(x)) * (2.0 / np.pi), chord * (4.0 / np.pi)


def _square(x: _Floats) -> tuple[_Floats, _Floats]:
    return np.clip(x, -1.0, 1.0), np.where(np.abs(x) < 1.0, 1.0, 0.0)


def _gaussian(x: _Floats) -> tuple[_Floats, _Floats]:
    from scipy.special import erf

    # half width = 2 sigma: centre over sqrt(2) sigma is sqrt(2) x
    u = math.sqrt(2.0) * x
    return np.asarray(erf(u)), np.exp(-u * u) * math.sqrt(8.0 / np.pi)


_RESPONSES = {ROUND: _round, SQUARE: _square, GAUSSIAN: _gaussian}


def _difference(diode: SplitDiode, centre: _Floats) -> tuple[_Floats, _Floats]:
    """Return difference of light over all light of the spot, and its derivative [1/m], by the spot's centre."""
    shape, half = _RESPONSES[diode.shape], diode.spot / 2.0
    if diode.gap == 0.0:
        value, slope = shape(centre / half)
        return value, slope / half
    # With H(u) the share of light beyond an edge at distance u, halves with a gap see H(c - gap/2) and
    # 1 - H(c + gap/2): the difference is the mean of two diodes without gap.
    left, right = shape((centre + diode.gap / 2.0) / half), shape((centre - diode.gap / 2.0) / half)
    return (left[0] + right[0]) / 2.0, (left[1] + right[1]) / (2.0 * half)


def response(diode: SplitDiode, deflection: Any, *, zeroed: bool = False) -> _Floats:
    """Return what the diode reads, calibrated so that small deflections about rest read true.

    Parameters
    ----------
    diode : SplitDiode
        The detector.
    deflection : array, any shape
        Deflection from rest [m].
    zeroed : bool
        Whether the reading at rest is subtracted. It is about the offset of the spot otherwise.

    Returns
    -------
    array, shape of ``deflection``
        Reading [m]. Constant where the spot has left one half.

    Notes
    -----
    Assumes the difference signal at constant laser power: what falls into a gap is not made up for by
    dividing by the sum of both halves.

    Examples
    --------
    >>> diode = SplitDiode(spot=500e-9, offset=25e-9)
    >>> (response(diode, [-94e-9, 1e-12, 94e-9], zeroed=True) * 1e9).round(4)
    array([-9.35408e+01,  1.00000e-03,  8.98316e+01])
    """
    rest, slope = (part.item() for part in _difference(diode, np.array([diode.offset])))
    reading = _difference(diode, diode.offset + np.asarray(deflection, dtype=float))[0]
    return np.asarray((reading - rest if zeroed else reading) / slope)


def waveform(observables: xr.Dataset, phase: Any) -> xr.DataArray:
    """Return the deflection over a period, ``q(theta) = A0 + sum A_n cos(n theta - phi_n)``.

    Parameters
    ----------
    observables : Dataset
        A1, phi1 and any of A0, A2, phi2, ... [m, rad], any dimensions.
    phase : array (theta,)
        theta = w t [rad].

    Returns
    -------
    DataArray
        Deflection [m], dimensions of the observables and ``theta`` last.

    Raises
    ------
    ObservablesError
        If the dataset does not keep the contract of observables.
    OvertoneError
        If ``phase`` is not one-dimensional.
    """
    theta = np.atleast_1d(np.asarray(phase, dtype=float))
    if theta.ndim != 1:
        raise OvertoneError("phases of a waveform lie on one axis", got=f"an array of shape {theta.shape}")
    phasors = _phasors(observables)
    values = _sum_of_harmonics(phasors.values, phasors["harmonic"].values, theta)
    own = phasors.isel(harmonic=0, drop=True)
    axis = xr.DataArray(theta, dims="theta", attrs={"units": "rad", "long_name": "phase of the drive"})
    attrs = {"units": "m", "long_name": "deflection"}
    coords = {**own.coords, "theta": axis}
    return xr.DataArray(values, coords, [*own.dims, "theta"], name="deflection", attrs=attrs)


def read_through(
    observables: xr.Dataset,
    diode: SplitDiode,
    *,
    offset: Any = 0.0,
    orders: Sequence[int] | None = None,
    samples: int = 64,
    zeroed: bool = False,
) -> xr.Dataset:
    """Return the observables that a lock-in without noise reads from the diode in the steady state.

    Parameters
    ----------
    observables : Dataset
        True motion: A1, phi1 and any of A0, A2, phi2, ... [m, rad], any dimensions. Harmonics that are
        absent do not move the spot.
    diode : SplitDiode
        The detector, calibrated at rest.
    offset : float, array or DataArray
        Drift of the spot from rest [m]: one number, an array that broadcasts against A1, or a named array,
        whose new dimensions the result takes too.
    orders : sequence of int, optional
        Harmonics to return; those that are present unless given.
    samples : int
        Samples a period.
    zeroed : bool
        As in `response`.

    Returns
    -------
    Dataset
        A0, A1, phi1, ... as read; phases in [0, 2 pi). Everything else in the dataset is kept.

    Raises
    ------
    ObservablesError
        If the dataset does not keep the contract of observables, or the offset does not fit it.
    OvertoneError
        If ``samples`` are too few: the highest harmonics of the reading must be below 1e-6 of the stroke.
    """
    phasors, shift = _with_shift(_phasors(observables), offset)
    present = phasors["harmonic"].values
    wanted = np.array(sorted(present if orders is None else set(orders)), dtype=int)
    first_of_tail = 3 * samples // 8  # the top quarter of the spectrum shows whether it has died down
    if wanted.size == 0 or wanted.min() < 0 or max(present.max(), wanted.max()) >= first_of_tail:
        raise OvertoneError(
            "these harmonics cannot be had from these samples",
            expected="orders from 0 to below 3/8 of the samples a period",
            got=f"orders {wanted.tolist()} of a motion with {present.tolist()}, {samples} samples",
        )
    theta = 2.0 * np.pi * np.arange(samples) / samples
    rows, shifts = phasors.values.reshape(-1, present.size), shift.values.ravel()
    read, unresolved = np.empty((len(rows), wanted.size), complex), 0
    size = max(1, _BLOCK // samples)
    for block in (slice(start, start + size) for start in range(0, len(rows), size)):
        motion = _sum_of_harmonics(rows[block], present, theta) + shifts[block, None]
        reading = response(diode, motion, zeroed=zeroed)
        spectrum = np.fft.rfft(reading) * (2.0 / samples)
        spectrum[:, 0] /= 2.0
        read[block] = spectrum[:, wanted]
        stroke = np.abs(rows[block][:, present > 0]).sum(axis=1)
        rounding = 1e-14 * np.abs(reading).max(axis=1)
        tail = np.abs(spectrum[:, first_of_tail:]).max(axis=1)
        unresolved += int((tail > _ALIASING * stroke + rounding).sum())
    if unresolved:
        raise OvertoneError(
            f"{samples} samples a period do not resolve the reading at {unresolved} of {len(rows)} points",
            expected=f"harmonics that fall below {_ALIASING:g} of the stroke",
            hint=f"samples={4 * samples}: where the spot leaves one half, harmonics fall slowly",
        )
    places = {**phasors.isel(harmonic=0, drop=True).coords, "harmonic": wanted}
    spectra = xr.DataArray(read.reshape(*shift.shape, wanted.size), places, [*shift.dims, "harmonic"])
    result = observables_of(spectra)
    kept = [name for name in observables.data_vars if not _is_harmonic(str(name))]
    result = result.assign({name: observables[name] for name in kept}).assign_attrs(observables.attrs)
    drift = float(shift.values.flat[0]) if np.ndim(offset) == 0 else f"array of {shift.sizes}"
    return provenance.record(
        result, "read_through", diode=asdict(diode), offset=drift, samples=samples, zeroed=zeroed
    )


def observables_of(phasors: xr.DataArray) -> xr.Dataset:
    """Return A0, A1, phi1, ... of phasors over ``harmonic`` [m], phases in [0, 2 pi)."""
    arrays: dict[str, xr.DataArray] = {}
    for n in (int(order) for order in phasors["harmonic"].values):
        phasor = phasors.sel(harmonic=n, drop=True)
        dims, coords = phasor.dims, phasor.coords
        if n == 0:
            arrays["A0"] = named_array("A0", phasor.values.real, dims, coords)
        else:
            lag = -np.angle(phasor.values) % (2.0 * np.pi)
            arrays[f"A{n}"] = named_array(f"A{n}", np.abs(phasor.values), dims, coords)
            arrays[f"phi{n}"] = named_array(f"phi{n}", lag, dims, coords)
    return xr.Dataset(arrays)


def _is_harmonic(name: str) -> bool:
    record = quantity(name)
    return record is not None and record.symbol.startswith(("A_", "phi_"))


def _phasors(observables: xr.Dataset) -> xr.DataArray:
    """Return a_n over the dimensions of the observables, those of A1 first, and ``harmonic``."""
    orders = harmonic_orders(validate_observables(observables))
    with np.errstate(invalid="ignore"):  # an infinite phase is a lost pixel, as NaN is
        parts = [
            observables["A0"] + 0j if n == 0 else observables[f"A{n}"] * np.exp(-1j * observables[f"phi{n}"])
            for n in orders
        ]
    _, *parts = xr.broadcast(observables["A1"], *parts)
    harmonic = xr.DataArray(list(orders), dims="harmonic", name="harmonic")
    return xr.concat(parts, dim=harmonic, coords="minimal", compat="override").transpose(..., "harmonic")


def _with_shift(phasors: xr.DataArray, offset: Any) -> tuple[xr.DataArray, xr.DataArray]:
    """Return phasors and offset on the same dimensions, but for ``harmonic`` at the end of the first."""
    own = phasors.isel(harmonic=0, drop=True)
    try:
        if not isinstance(offset, xr.DataArray):
            values = np.broadcast_to(np.asarray(offset, dtype=float), own.shape)
            offset = xr.DataArray(values, own.coords, own.dims)
        xr.align(own, offset, join="exact")
        spread, shift = xr.broadcast(phasors, offset, exclude=["harmonic"])
    except (ValueError, TypeError) as error:
        raise ObservablesError(
            "the offset of the spot does not fit the observables",
            expected=f"a number, or an array over some of {dict(own.sizes)}",
            got=str(error).splitlines()[0],
        ) from error
    if not bool(np.isfinite(shift).all()):
        raise ObservablesError("the offset of the spot is not finite", expected="metres of deflection")
    dims = [*own.dims, *(name for name in offset.dims if name not in own.dims)]
    return spread.assign_coords(offset.coords).transpose(*dims, "harmonic"), shift.transpose(*dims)


def _sum_of_harmonics(
    phasors: npt.NDArray[np.complex128], orders: npt.NDArray[Any], theta: _Floats
) -> _Floats:
    """Return Re sum a_n exp(i n theta) with theta on a new last axis."""
    turn = orders[:, None] * theta
    with np.errstate(invalid="ignore"):
        return np.asarray(phasors.real @ np.cos(turn) - phasors.imag @ np.sin(turn))
