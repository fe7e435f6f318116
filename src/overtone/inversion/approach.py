"""An approach curve as the inversion takes it: one line of rows, from near to far, up to where the gap turns back."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import xarray as xr

from overtone.errors import InversionError, ObservablesError
from overtone.probe import Probe
from overtone.quantities import validate_observables
from overtone.units import format_quantity

FEWEST = 5
"""Points below which there is no curve."""
_NEAR, _FAR = slice(None, 3), slice(-3, None)
_MANY_SIGMA = 8.0  # what no scatter of some thousand points reaches
_STEEPEST = 3.0  # gap per height above which a step is a jump: smooth motion has 0 to 1

_Floats = npt.NDArray[np.float64]
_Mask = npt.NDArray[np.bool_]


@dataclass
class Curve:
    """A curve, row by row from the closest gap to the farthest; rows of one stretch have no jump between them."""

    base: _Floats
    """Z - A1: the closest gap, but for the mean deflection and the higher harmonics."""
    height: _Floats
    amplitude: _Floats
    cons: _Floats
    diss: _Floats
    mean: _Floats
    """CONS_0; where A0 was not measured, what the force makes of it."""
    gap: _Floats
    force: _Floats
    mean_force: _Floats
    damping: _Floats
    heat: _Floats
    """The part of DISS_1 that is lost in the lever."""
    motion: _Floats
    """Harmonics of the tip's motion over psi, a row of n = 0, 1, 2, ...; zero for n < 2."""
    count: _Floats
    stretch: npt.NDArray[np.int64]

    def take(self, rows: slice) -> Curve:
        """Return some of the rows, in arrays of their own."""
        return Curve(**{name: values[rows].copy() for name, values in vars(self).items()})

    @property
    def hole(self) -> _Mask:
        """Which segments between rows are holes that a jump left."""
        return np.diff(self.stretch) != 0

    def pooled(self, resolution: float = 0.0) -> Curve:
        """Return means over neighbours: of those out of order, and of those closer than the resolution."""
        groups = _groups(self.gap, self.count, self.stretch, resolution)
        first = np.flatnonzero(np.diff(groups, prepend=-1))
        total = np.add.reduceat(self.count, first)
        means: dict[str, Any] = {
            name: (np.add.reduceat((self.count * values.T).T, first, axis=0).T / total).T
            for name, values in vars(self).items()
        }
        return Curve(**(means | {"count": total, "stretch": self.stretch[first]}))


def _groups(
    gap: _Floats, count: _Floats, stretch: npt.NDArray[np.int64], resolution: float
) -> npt.NDArray[np.int64]:
    """Return a number for each row: that of its group of neighbours; the means of groups rise.

    Pool-adjacent-violators gives the rising sequence nearest to the data, without a window to choose; its steps
    are then gathered until a group is as wide as the resolution.
    """
    blocks: list[list[float]] = []  # mean, count, rows, stretch
    for value, weight, part in zip(gap.tolist(), count.tolist(), stretch.tolist(), strict=True):
        blocks.append([value, weight, 1, part])
        while len(blocks) > 1 and blocks[-2][0] >= blocks[-1][0]:
            mean, n, rows, _ = blocks.pop()
            other = blocks[-1]
            other[0] = (other[0] * other[1] + mean * n) / (other[1] + n)
            other[1], other[2] = other[1] + n, other[2] + rows
    number, numbers = -1, []
    start, part = -math.inf, -1.0
    for mean, _, rows, own in blocks:
        if own != part or mean - start >= resolution:
            number, start, part = number + 1, mean, own
        numbers += [number] * int(rows)
    return np.array(numbers)


def scatter_of(x: _Floats, y: _Floats) -> float:
    """Return the standard deviation of noise on a smooth curve: of each point against a cubic through four others."""
    if x.size < 2 * FEWEST:
        return 0.0
    rows = np.arange(2, x.size - 2)
    around = np.stack([rows - 2, rows - 1, rows + 1, rows + 2])
    weights = np.ones((4, rows.size))
    for a in range(4):
        for c in range(4):
            if a != c:
                weights[a] *= (x[rows] - x[around[c]]) / (x[around[a]] - x[around[c]])
    off = np.abs(y[rows] - (weights * y[around]).sum(axis=0)) / np.sqrt(1.0 + (weights**2).sum(axis=0))
    return 1.4826 * float(np.median(off))


def single_line(curve: xr.Dataset) -> tuple[xr.Dataset, _Floats, str]:
    """Return the observables over one dimension, the height of the base there, and its name."""
    validate_observables(curve)
    names = [name for name in ("A0", "A1", "phi1") if name in curve]
    place = next((name for name in ("Z", "z") if name in curve.variables), None)
    if place is None:
        raise ObservablesError(
            "the curve does not say where the base was",
            expected="a coordinate or variable Z or z in m",
            got=", ".join(map(str, curve.variables)),
            hint="curve.assign(Z=(dim, heights))",
        )
    height = curve[place]
    line = curve[names].drop_vars([str(name) for name in curve[names].coords])
    line = line.squeeze()
    dims = line["A1"].dims
    if len(dims) != 1 or any(line[name].dims != dims for name in names):
        got = ", ".join(f"{name} over ({', '.join(map(str, curve[name].dims))})" for name in names)
        raise ObservablesError(
            "this is not one curve",
            expected="A1 and phi1 over one dimension",
            got=got,
            hint="one curve at a time, such as curve.isel(direction=0)",
        )
    height = height.squeeze()
    if height.dims != dims:
        raise ObservablesError(
            f"{place} does not belong to the curve",
            expected=f"heights over {dims[0]}",
            got=f"{place} over ({', '.join(map(str, height.dims))})",
        )
    unit = height.attrs.get("units", "m")
    if unit != "m":
        raise ObservablesError(f"{place} is not in SI units", expected="m", got=str(unit))
    return line, np.asarray(height.values, dtype=float), place


def rows_in_order(
    line: xr.Dataset, height: _Floats, probe: Probe, findings: list[str]
) -> tuple[xr.Dataset, _Floats]:
    """Return the complete rows from the lowest to the highest base, those at one height averaged."""
    if "A0" in line and not np.isfinite(line["A0"].values).any():
        line = line.drop_vars("A0")
        findings.append("A0 has no values and was not used.")
    whole = np.isfinite(height) & (line["A1"].values > 0.0)
    for name in line.data_vars:
        whole &= np.isfinite(line[name].values)
    lost = int(whole.size - whole.sum())
    if lost:
        findings.append(f"{lost} of {whole.size} rows were incomplete and left out.")
    levels, group = np.unique(height[whole], return_inverse=True)
    if levels.size < FEWEST:
        raise InversionError(
            "too few points for a force curve",
            expected=f"{FEWEST} complete rows at different heights or more",
            got=f"{levels.size} of {whole.size} rows",
        )
    count = np.bincount(group)
    phase = np.exp(1j * line["phi1"].values[whole])
    columns = {str(name): np.bincount(group, line[name].values[whole]) / count for name in line.data_vars}
    turn = np.bincount(group, phase.real) + 1j * np.bincount(group, phase.imag)
    columns["phi1"] = np.angle(turn) % (2.0 * np.pi)
    ends = [abs(float(np.median(columns["A1"][part])) - probe.drive.free_amplitude) for part in (_NEAR, _FAR)]
    if ends[1] > ends[0] + 0.02 * probe.drive.free_amplitude:
        raise InversionError(
            "the height grows toward the sample",
            expected="Z that is largest far away, where A1 is free",
            got=f"A1 off its free value by {format_quantity(ends[1], 'm')} where Z is largest and by "
            f"{format_quantity(ends[0], 'm')} where it is smallest",
            hint="-Z instead of Z, or the free amplitude of this curve in the probe",
        )
    return xr.Dataset({name: ("row", values) for name, values in columns.items()}), levels


def uninterrupted(curve: Curve, scatter: float, findings: list[str]) -> Curve:
    """Cut a curve where the gap turns back, and number the stretches between jumps."""
    gap, height = curve.gap, curve.height
    slack = _MANY_SIGMA * scatter + 1e-12 * float(np.max(curve.amplitude))
    step, climb = np.diff(gap), np.diff(height)
    jump = np.abs(step) > _STEEPEST * climb + slack
    # from far to near the gap falls; where it has risen by more than noise it turned at its lowest point so far
    lowest = np.minimum.accumulate(gap[::-1])[::-1]
    turned = np.flatnonzero(gap - lowest > slack)
    first = 0
    if turned.size:
        after = int(turned[-1])
        first = after + 1 + int(np.argmin(gap[after + 1 :]))
        by_jump = bool(jump[after:first].any())
        how = "the amplitude fell by a jump and the gap grew" if by_jump else "the closest gap turned back"
        findings.append(
            f"At A1 = {format_quantity(float(curve.amplitude[first]), 'm')} {how} although the base went on: "
            f"the {first} rows nearer than that are cut off."
        )
    kept = curve.take(slice(first, None))
    kept.stretch[1:] = np.cumsum(jump[first:])
    return kept
