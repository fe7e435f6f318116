"""Method ``exact``: every solution of every pixel of a scan."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import numpy.typing as npt

from overtone.blocks import run_blocks
from overtone.contact.models import ContactModel
from overtone.inversion import exact
from overtone.inversion.columns import Columns, adhesive, unknowns_of
from overtone.inversion.linear import sample_modulus, stiffness
from overtone.inversion.motion import MANY, differences, follow, settle
from overtone.inversion.pixels import Pixels, Setting
from overtone.inversion.result import (
    DETERMINED,
    MISSING_DATA,
    NO_CONTACT,
    NO_SOLUTION,
    NOT_CONVERGED,
    NOT_DETERMINED,
    POOR_FIT,
    SEVERAL_SOLUTIONS,
    Sheet,
)
from overtone.inversion.table import NODES
from overtone.inversion.valley import Box
from overtone.kernels import kernel
from overtone.probe import Probe

_Floats = npt.NDArray[np.float64]

BLOCK = 2048
_WIDEST = 1.0  # standard deviation of ln E that is still a determination
_SAME = 2e-3  # relative difference of indentations below which two solutions are one
_STRONGEST = 1e-6  # force of adhesion of the fallback [N]


@kernel
def _to_property(columns: Columns, S: _Floats, value: _Floats, share: _Floats) -> None:
    """Fill the elastic property of each S, and d ln S / d ln of it."""
    for i in range(S.shape[0]):
        if S[i] > 0.0:
            value[i] = sample_modulus(columns.contact, S[i])
            _, share[i] = stiffness(columns.contact, value[i])
        else:
            value[i], share[i] = math.nan, math.nan


def property_of(columns: Columns, S: _Floats) -> tuple[_Floats, _Floats]:
    """Return the elastic property of coefficients S, of any shape, and d ln S / d ln of it.

    NaN where S is none, infinite where no sample under this tip is so stiff.
    """
    flat = np.ascontiguousarray(S, dtype=float).ravel()
    value, share = np.empty(flat.size), np.empty(flat.size)
    _to_property(columns, flat, value, share)
    return value.reshape(S.shape), share.reshape(S.shape)


def map_solutions(
    setting: Setting,
    record: ContactModel,
    columns: Columns,
    probe: Probe,
    sheet: Sheet,
    *,
    full_motion: bool,
    radius_error: float,
    progress: Callable[[int, int], None] | None,
) -> None:
    """Fill a sheet with every solution.

    Parameters
    ----------
    setting : Setting
        The scan.
    record, columns : ContactModel, Columns
        The model.
    probe : Probe
        Its lever.
    sheet : Sheet
        Filled.
    full_motion : bool
        Whether the harmonics of the motion count, or it is taken for a bare cosine.
    radius_error : float
        Standard deviation of ln of the elastic unknown from the radius of the tip.
    progress : callable, optional
        Called with (pixels done, pixels in all).
    """
    from scipy.stats import chi2 as chi2_law

    names = [q.name for q in unknowns_of(record)]
    every = [*names, "indentation"] + (["loss_tangent"] if columns.loss > 0.0 else [])
    sheet.add(*every, *(f"{name}_unscreened" for name in every))
    sheet.add(*(f"{name}_solutions" for name in every), extra=exact.MOST)
    sheet.add("misfit", "uncertainty")
    sheet.add("solutions", fill=0, dtype="int8")
    sheet.add("status", fill=MISSING_DATA, dtype="int8")
    table = setting.table(columns)
    rows = setting.rows
    elastic = unknowns_of(record)[0]
    box = Box(
        stiffness(columns.contact, elastic.lower)[0],
        stiffness(columns.contact, elastic.upper)[0],
        0.0,
        _STRONGEST if adhesive(columns) else 0.0,
    )
    square = rows.orders.size == 3 and not rows.lossy.any() and adhesive(columns) and columns.loss == 0.0
    cross = np.empty((table.elastic.shape[0] if square else 0, 3, NODES))
    if square:
        exact.fill_cross(table, rows.orders, cross)
    followed = follow(probe, setting.known, MANY if full_motion else 0)
    # chi-squared beyond noise (99.9 %)
    limit = float(chi2_law.isf(1e-3, max(rows.orders.size - len(names) - 1, 1)))

    def run(block: slice) -> None:
        pixels = setting.pixels(block, 0.0)
        solutions, spreads, best, chi2, count = _solve(pixels)
        before, rests = count.copy(), np.repeat(chi2[:, None], exact.MOST, axis=1)
        if full_motion:
            _settle(pixels, solutions, spreads, rests, best, count)
        lost = (before > 0) & ~np.isfinite(solutions[:, :, exact.DELTA_]).any(axis=1)
        _sort(solutions, spreads, rests, count)
        some = count > 0
        deepest = np.clip(count - 1, 0, exact.MOST - 1)
        chosen = np.take_along_axis(solutions, deepest[:, None, None], 1)[:, 0]
        spread = np.take_along_axis(spreads, deepest[:, None], 1)[:, 0]
        chi2 = np.where(some, np.take_along_axis(rests, deepest[:, None], 1)[:, 0], chi2)
        answer = np.where(some[:, None], chosen, best)
        value, share = property_of(columns, answer[:, exact.S_])
        with np.errstate(invalid="ignore", divide="ignore"):
            uncertainty = np.hypot(spread / (answer[:, exact.S_] * share), radius_error)
        usable = pixels.usable & (count >= 0)
        status = np.full(count.size, MISSING_DATA, np.int8)
        status[usable] = DETERMINED
        apart = some & (chosen[:, exact.DELTA_] < 0.0)
        with np.errstate(invalid="ignore"):
            status[usable & ~(uncertainty <= _WIDEST)] = NOT_DETERMINED
            status[usable & (count > 1)] = SEVERAL_SOLUTIONS
            status[usable & (count == 1) & apart] = NO_CONTACT
            status[usable & ~some] = NO_SOLUTION
            status[usable & (chi2 > limit)] = POOR_FIT
            status[usable & lost] = NOT_CONVERGED
        sheet.put("status", block, status)
        sheet.put("solutions", block, np.where(usable, count, 0))
        sheet.put(
            "uncertainty", block, np.where(usable & (answer[:, exact.DELTA_] > 0.0), uncertainty, math.nan)
        )
        sheet.put("misfit", block, np.where(usable, chi2, math.nan))
        every_value, _ = property_of(columns, solutions[:, :, exact.S_])
        sure = status == DETERMINED
        sticking = sure | (status == NO_CONTACT)
        for name in every:
            values = _quantity(name, answer, value)
            values = np.where(usable, values, math.nan)
            sheet.put(f"{name}_unscreened", block, values)
            fine = sticking if name in ("adhesion", "indentation") else sure
            sheet.put(name, block, np.where(fine, values, math.nan))
            sheet.put(f"{name}_solutions", block, _quantity(name, solutions, every_value))

    def _solve(pixels: Pixels) -> tuple[_Floats, _Floats, _Floats, _Floats, npt.NDArray[np.int8]]:
        size = pixels.y.shape[0]
        spans, shifts = (
            np.zeros((size, 2)),
            np.zeros((size, exact.PLACES if full_motion else 0, rows.orders.size)),
        )
        common = (pixels.y, pixels.whitening, pixels.amplitude, pixels.usable, columns, table)
        if full_motion:
            differences(*common, rows.orders, rows.lossy, box, followed, pixels.known, spans, shifts)
        solutions, spreads = np.empty((size, exact.MOST, 4)), np.empty((size, exact.MOST))
        best, chi2, count = np.empty((size, 4)), np.empty(size), np.empty(size, np.int8)
        exact.solve_pixels(
            *common,
            cross,
            rows.orders,
            rows.lossy,
            setting.attraction,
            box,
            spans,
            shifts,
            solutions,
            spreads,
            best,
            chi2,
            count,
        )
        return solutions, spreads, best, chi2, count

    def _settle(
        pixels: Pixels,
        solutions: _Floats,
        spreads: _Floats,
        rests: _Floats,
        best: _Floats,
        count: npt.NDArray[np.int8],
    ) -> None:
        """Move every solution to the full motion; those that come to no rest, or to the same one, are none.

        Where the bare cosine has none the closest one is moved: it may be a solution there.
        """
        none = (count == 0) & (best[:, exact.DELTA_] > 0.0)
        solutions[none, 0], spreads[none, 0] = best[none], 1.0
        for k in range(exact.MOST):
            one, spread, rest = (np.ascontiguousarray(part[:, k]) for part in (solutions, spreads, rests))
            settle(
                pixels.y,
                pixels.whitening,
                pixels.amplitude,
                columns,
                rows.orders,
                rows.lossy,
                followed,
                pixels.known,
                one,
                spread,
                rest,
            )
            depth = one[:, exact.DELTA_]
            for j in range(k):
                with np.errstate(invalid="ignore"):
                    again = np.abs(depth - solutions[:, j, exact.DELTA_]) < _SAME * np.abs(depth)
                one[again] = math.nan
            solutions[:, k], spreads[:, k], rests[:, k] = one, spread, rest

    def _sort(solutions: _Floats, spreads: _Floats, rests: _Floats, count: npt.NDArray[np.int8]) -> None:
        """Drop what no sample under this tip can have, and put the deepest last, none beyond it."""
        S, F = solutions[:, :, exact.S_], solutions[:, :, exact.F_]
        solutions[(box.stiffest < S) | (F > _STRONGEST)] = math.nan
        depth = solutions[:, :, exact.DELTA_]
        order = np.argsort(np.where(np.isnan(depth), np.inf, depth), axis=1)
        solutions[:] = np.take_along_axis(solutions, order[:, :, None], 1)
        spreads[:] = np.take_along_axis(spreads, order, 1)
        rests[:] = np.take_along_axis(rests, order, 1)
        found = np.isfinite(solutions[:, :, exact.DELTA_]).sum(axis=1)
        count[count >= 0] = found[count >= 0]

    def _quantity(name: str, solution: _Floats, elastic_value: _Floats) -> _Floats:
        if name == "indentation":
            return solution[..., exact.DELTA_]
        if name == "adhesion":
            return solution[..., exact.F_]
        with np.errstate(invalid="ignore", divide="ignore"):
            if name == "loss_tangent":
                return np.asarray(solution[..., exact.C_] / solution[..., exact.S_])
            if name in ("viscosity", "damping"):
                return np.asarray(solution[..., exact.C_] / columns.loss)
        return elastic_value

    run_blocks(run, sheet.like.size, BLOCK, progress)
