"""Method ``least-squares``: the published estimator on a scan, for reproduction, with what its answers are worth."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import numpy.typing as npt

from overtone.blocks import run_blocks
from overtone.contact.models import ContactModel
from overtone.inversion import least_squares
from overtone.inversion.columns import Columns
from overtone.inversion.linear import Contact
from overtone.inversion.pixels import Setting
from overtone.inversion.profile import CHI2_90, CHI2_999, modulus_range
from overtone.inversion.result import (
    AT_BOUND,
    DETERMINED,
    MISSING_DATA,
    NOT_CONVERGED,
    NOT_DETERMINED,
    POOR_FIT,
    START_DEPENDENT,
    WIDEST_DETERMINED,
    Sheet,
)

HARMONIC_SETS = ((0, 1, 2), (1, 2, 3))
POOR_RESIDUAL = 0.1
_SAME_ANSWER = 1e-3  # range of ln E below which two starting points found the same minimum
_BLOCK = 256
_LEVELS = np.array([CHI2_90, CHI2_999])


def map_least_squares(
    setting: Setting,
    record: ContactModel,
    columns: Columns,
    sheet: Sheet,
    *,
    progress: Callable[[int, int], None] | None,
) -> None:
    """Fill a sheet with the answer of the best of three starting points at every pixel.

    Parameters
    ----------
    setting : Setting
        The scan, with three conservative harmonics.
    record, columns : ContactModel, Columns
        A paraboloid with at most adhesion.
    sheet : Sheet
        Filled.
    progress : callable, optional
        Called with (pixels done, pixels in all).
    """
    contact = columns.contact
    unknowns = [*record.unknowns, None]
    n = len(unknowns)
    names = [p.name if p else "indentation" for p in unknowns]
    lower = np.log([p.lower if p else least_squares.MIN_INDENTATION for p in unknowns])
    upper = np.log([p.upper if p else 1.0 for p in unknowns])
    starts = [np.log([E, F, d] if n == 3 else [E, d]) for E, F, d in least_squares.STARTS]
    orders = tuple(int(order) for order in setting.rows.orders)
    sheet.add(*names, *(f"{name}_unscreened" for name in names))
    sheet.add("residual", "amplification", "uncertainty", "start_spread", "modulus_lower", "modulus_upper")
    sheet.add("status", fill=MISSING_DATA, dtype="int8")

    def run(block: slice) -> None:
        pixels = setting.pixels(block, 0.5)
        usable = pixels.usable & (pixels.y != 0.0).all(axis=1)
        if not usable.any():
            return
        where = np.flatnonzero(usable) + block.start
        F = np.ascontiguousarray(pixels.y[usable])
        amplitude = np.ascontiguousarray(pixels.amplitude[usable])
        fits = [_fit(F, amplitude, orders, contact, lower, upper, start) for start in starts]
        solution, norm, gain, outcome = (np.stack(parts) for parts in zip(*fits, strict=True))
        chosen = np.argmin(norm, axis=0)[None, :]
        pick = np.take_along_axis
        gain = pick(gain, chosen[..., None], 0)[0]
        best = pick(solution, chosen[..., None], 0)[0]
        residual = pick(norm, chosen, 0)[0]
        whitening = np.ascontiguousarray(pixels.whitening[usable])
        # d ln E per whitened error: the gain is per relative error of each harmonic
        per_force = gain / np.abs(F)
        root = np.linalg.inv(whitening)
        uncertainty = np.linalg.norm(np.einsum("pi,pij->pj", per_force, root), axis=1)
        spread = np.ptp(solution[..., 0], axis=0)
        softest, stiffest = np.empty((where.size, _LEVELS.size)), np.empty((where.size, _LEVELS.size))
        misfit = np.empty(where.size)
        modulus_range(
            F,
            whitening,
            np.array(orders),
            amplitude,
            contact,
            lower,
            upper,
            _LEVELS,
            softest,
            stiffest,
            misfit,
        )
        misfit[residual < 1e-6] = 0.0  # met exactly, between two nodes of the scan
        # The scan is coarser than the narrowest solutions: the fit's own neighbourhood belongs to the range.
        reach = uncertainty[:, None] * np.sqrt(_LEVELS)
        found = best[:, :1]
        softest, stiffest = np.fmin(softest, found - reach), np.fmax(stiffest, found + reach)
        if setting.shared is not None:  # E* goes as 1/sqrt(R)
            calibration = setting.shared.calibration
            of_the_tip = 0.5 * calibration.error("radius") / calibration.values["radius"]
            uncertainty = np.hypot(uncertainty, of_the_tip)
            tip = np.sqrt(_LEVELS) * of_the_tip
            softest, stiffest = (
                found - np.hypot(found - softest, tip),
                found + np.hypot(stiffest - found, tip),
            )
        low, high = np.clip(softest, lower[0], upper[0]), np.clip(stiffest, lower[0], upper[0])
        status = _judge(
            pick(outcome, chosen, 0)[0], residual, misfit, uncertainty, (high - low)[:, 1], spread
        )
        sheet.put("status", where, status)
        values = np.exp(best)
        values[status == NOT_CONVERGED] = math.nan
        for j, name in enumerate(names):
            sheet.put(f"{name}_unscreened", where, values[:, j])
            sheet.put(name, where, np.where(status == DETERMINED, values[:, j], math.nan))
        sheet.put("residual", where, residual)
        sheet.put("amplification", where, np.linalg.norm(gain, axis=1))
        sheet.put("uncertainty", where, uncertainty)
        sheet.put("start_spread", where, spread)
        sheet.put("modulus_lower", where, np.exp(low[:, 0]))
        sheet.put("modulus_upper", where, np.exp(high[:, 0]))

    run_blocks(run, sheet.like.size, _BLOCK, progress)


def _fit(
    F: npt.NDArray[np.float64],
    amplitude: npt.NDArray[np.float64],
    orders: tuple[int, ...],
    contact: Contact,
    lower: npt.NDArray[np.float64],
    upper: npt.NDArray[np.float64],
    start: npt.NDArray[np.float64],
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64], npt.NDArray[np.float64], npt.NDArray[np.int8]]:
    count, n = F.shape[0], start.size
    solution, norm = np.empty((count, n)), np.empty(count)
    gain, outcome = np.empty((count, 3)), np.empty(count, np.int8)
    least_squares.fit_pixels(
        F, np.array(orders), amplitude, contact, lower, upper, start, solution, norm, gain, outcome
    )
    return solution, norm, gain, outcome


def _judge(
    outcome: npt.NDArray[np.int8],
    residual: npt.NDArray[np.float64],
    misfit: npt.NDArray[np.float64],
    uncertainty: npt.NDArray[np.float64],
    width: npt.NDArray[np.float64],
    spread: npt.NDArray[np.float64],
) -> npt.NDArray[np.int8]:
    """Return the status of each fitted pixel; where several apply, the gravest.

    Determined means two things: amplification times the stated noise is at most 1, and no modulus outside
    one decade fits (``width``, the 99.9 % range of ln E). The first alone fails: noise throws one stiff pixel
    in four onto a soft solution with a small amplification, which would pass for determined. A model fits
    badly where N_r exceeds what the method's paper accepts, or where chi-squared is beyond noise (99.9 %).
    """
    status = np.full(outcome.shape, DETERMINED, np.int8)
    status[spread > _SAME_ANSWER] = START_DEPENDENT
    status[~((uncertainty <= 1.0) & (width <= WIDEST_DETERMINED))] = NOT_DETERMINED
    status[(residual > POOR_RESIDUAL) | (misfit > CHI2_999)] = POOR_FIT
    status[outcome == least_squares.AT_BOUND] = AT_BOUND
    status[outcome == least_squares.STALLED] = NOT_CONVERGED
    return status
