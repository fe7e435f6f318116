"""Blocks of pixels as the kernels take them: force harmonics and the covariance of their errors."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import xarray as xr

from overtone.contact.models import ContactModel
from overtone.instrument.calibration import Calibration
from overtone.instrument.correct import calibration_of
from overtone.instrument.shared import shared_changes
from overtone.instrument.signals import Positions, Signals, positions, signals_of
from overtone.inversion.columns import Columns, columns_of
from overtone.inversion.forces import Reader, Rows, force_block, reader_of, readings_of, row_block, rows_of
from overtone.inversion.table import Table, table_of
from overtone.probe import Probe

_Floats = npt.NDArray[np.float64]
_Complex = npt.NDArray[np.complex128]

_STEP = 1e-4
_FARTHEST = 10.0  # free amplitudes beyond which a reading is none


class Pixels(NamedTuple):
    """A block of pixels."""

    y: _Floats
    """(pixel, row): force harmonics [N]."""
    whitening: _Floats
    """(pixel, row, row): of noise and shared errors together."""
    of_noise: _Floats
    """The same of noise alone."""
    amplitude: _Floats
    """(pixel,): of the tip [m]."""
    usable: npt.NDArray[np.bool_]
    known: _Complex
    """(pixel, harmonic): forces of the harmonics above the first that were measured [N]."""
    pull: _Floats
    """(pixel or 1, row): what a whitened residual says of ln of the elastic unknown through the radius of the tip."""
    left: _Floats
    """(pixel or 1,): variance of it that is left, from the radius."""


class Harmonics(NamedTuple):
    """Force harmonics of a block of pixels, in the phase of the tip."""

    f: _Complex
    """(pixel, harmonic): CONS_n - i DISS_n [N]."""
    errors: _Complex
    """(pixel, harmonic, source): change by one standard deviation of each independent error of a reading."""
    amplitude: _Floats
    """(pixel,): of the tip [m]."""
    turn: _Complex
    """(pixel,): from the phase of the reading into that of the tip."""
    usable: npt.NDArray[np.bool_]


def in_rows(values: _Complex, rows: Rows) -> _Floats:
    """Return complex harmonics (pixel, harmonic, ...) as the rows of an inversion (pixel, row, ...)."""
    out = np.empty((values.shape[0], rows.orders.size, *values.shape[2:]))
    for r, (h, lossy) in enumerate(zip(rows.harmonics, rows.lossy, strict=True)):
        out[:, r] = -values[:, h].imag if lossy else values[:, h].real
    return out


class Shared(NamedTuple):
    """What a calibration leaves uncertain, for the pixels of a scan, flat."""

    calibration: Calibration
    signals: Signals
    where: Positions

    @classmethod
    def of(cls, observables: xr.Dataset, calibration: Calibration) -> Shared:
        """Return it for a corrected scan."""
        signals, where = signals_of(observables), positions(observables)
        flat = Signals(
            signals.mean.ravel() if signals.mean is not None else None,
            {n: a.ravel() for n, a in signals.phasor.items()},
        )
        return cls(calibration, flat, Positions(*(part.ravel() for part in where)))

    def changes(
        self, pixels: npt.NDArray[np.intp] | slice, orders: tuple[int, ...]
    ) -> tuple[_Complex, _Floats]:
        """Return what each shared error does to the harmonics of some pixels (pixel, harmonic, source), and to ln R."""
        signals, where = self.signals, Positions(*(part[pixels] for part in self.where))
        chosen = Signals(
            signals.mean[pixels] if signals.mean is not None else None,
            {n: a[pixels] for n, a in signals.phasor.items()},
        )
        return shared_changes(chosen, self.calibration, orders, **where._asdict())


@dataclass(frozen=True)
class Setting:
    """A scan with all that an inversion needs to know of it.

    Parameters
    ----------
    rows : Rows
        Force harmonics that are used.
    orders : tuple of int
        Harmonics that are read.
    reader : Reader
        Turns readings into forces.
    amplitudes, phases : list of array
        Readings, flat.
    shared : Shared or None
        What a calibration leaves uncertain.
    """

    rows: Rows
    orders: tuple[int, ...]
    reader: Reader
    amplitudes: list[_Floats]
    phases: list[_Floats]
    shared: Shared | None

    @classmethod
    def of(
        cls,
        observables: xr.Dataset,
        probe: Probe,
        cons: tuple[int, ...],
        diss: tuple[int, ...],
        sigma: Mapping[str, float],
    ) -> Setting:
        """Return it for a scan."""
        rows, orders = rows_of(cons, diss)
        amplitudes, phases = readings_of(observables, orders)
        calibration = calibration_of(observables)
        shared = Shared.of(observables, calibration) if calibration is not None else None
        return cls(rows, orders, reader_of(probe, orders, sigma), amplitudes, phases, shared)

    @property
    def known(self) -> tuple[int, ...]:
        """Harmonics above the first that were measured."""
        return tuple(n for n in self.orders if n > 1)

    @property
    def attraction(self) -> npt.NDArray[np.int64]:
        """Row of CONS_1, -1 without."""
        found = [i for i, n in enumerate(self.rows.orders) if n == 1 and not self.rows.lossy[i]]
        return np.array(found[:1] or [-1])

    def table(self, columns: Columns) -> Table:
        """Return the table of a model for the amplitudes of the scan."""
        # the amplitude of the tip is not quite that of the reading: a step beyond each is needed, not all pixels
        first = self.amplitudes[self.orders.index(1)]
        first = first[np.isfinite(first) & (first > 0.0)]
        factor = 1.0 / abs(self.reader.reading[0])
        reach = abs(self.reader.reading[1] * self.reader.free) * factor
        low, high = first * factor - reach, first * factor + reach
        if reach > 1e-12 * first.max(initial=1e-30):
            first = np.exp(
                np.arange(math.log(max(low.min(), 1e-2 * first.min())), math.log(high.max()), 1e-3)
            )
        else:
            first = first * factor
        return table_of(columns, first, int(self.rows.orders.max()))

    def pixels(self, block: slice, exponent: float) -> Pixels:
        """Return a block of pixels.

        Parameters
        ----------
        block : slice
            Which.
        exponent : float
            Change of ln of the elastic unknown with ln R at a given force.
        """
        h = self.harmonics(block)
        f, errors = h.f, h.errors
        count = f.shape[0]
        rows = self.rows.orders.size
        y, W, usable = np.empty((count, rows)), np.empty((count, rows, rows)), np.empty(count, np.bool_)
        row_block(f, errors, self.rows, y, W, usable)
        of_noise, pull, left = W, np.zeros((1, rows)), np.zeros(1)
        if self.shared is not None:
            changes, of_radius = self.changes(self.shared, block, h.turn)
            of_noise, W = W, np.empty_like(W)
            row_block(f, np.concatenate([errors, changes], axis=-1), self.rows, y, W, usable)
            moved = np.einsum("pjs,s->pj", in_rows(changes, self.rows), of_radius)
            along = np.einsum("pij,pj->pi", W, moved)
            # a residual says which way the shared errors went, and with them the radius
            pull = -exponent * along
            left = np.maximum(exponent**2 * ((of_radius**2).sum() - (along**2).sum(axis=1)), 0.0)
            pull[~usable], left[~usable] = 0.0, 0.0
        usable &= h.usable
        known = np.ascontiguousarray(f[:, [i for i, n in enumerate(self.orders) if n > 1]])
        return Pixels(y, W, of_noise, h.amplitude, usable, known, pull, left)

    def harmonics(self, block: slice) -> Harmonics:
        """Return the force harmonics of a block of pixels with the errors of their noise."""
        amplitude = np.ascontiguousarray(np.stack([a[block] for a in self.amplitudes], axis=1), dtype=float)
        phase = np.ascontiguousarray(np.stack([p[block] for p in self.phases], axis=1), dtype=float)
        count, harmonics = amplitude.shape
        f = np.empty((count, harmonics), complex)
        errors = np.empty((count, harmonics, 1 + 2 * harmonics), complex)
        of_the_tip, turn = np.empty(count), np.empty(count, complex)
        with np.errstate(invalid="ignore"):
            force_block(amplitude, phase, self.reader, f, errors, of_the_tip, turn)
            first = amplitude[:, self.orders.index(1)]
            usable = (first > 0.0) & (first < _FARTHEST * abs(self.reader.free)) & np.isfinite(of_the_tip)
        return Harmonics(f, errors, of_the_tip, turn, usable)

    def changes(
        self, shared: Shared, pixels: npt.NDArray[np.intp] | slice, turn: _Complex
    ) -> tuple[_Complex, _Floats]:
        """Return what each shared error does to the harmonics of some pixels, in the phase of the tip, and to ln R.

        ``turn`` (pixel,) is that of `Harmonics`.
        """
        changes, of_radius = shared.changes(pixels, self.orders)
        return changes * turn[:, None, None] ** np.array(self.orders)[None, :, None], of_radius


def radius_exponent(record: ContactModel, probe: Probe, given: Mapping[str, float]) -> float:
    """Return the change of ln of the elastic unknown with ln R, at the force and the indentation of a pixel."""
    from dataclasses import replace

    if probe.tip.radius is None:
        return 0.0
    wider = replace(probe, tip=replace(probe.tip, radius=probe.tip.radius * math.exp(_STEP)))
    here, there = (columns_of(record, p, given).contact.factor for p in (probe, wider))
    return -math.log(there / here) / _STEP
