"""An approach curve taken apart: what is far from the sample, what feels it, and readings averaged for a fit."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import xarray as xr

from overtone.errors import CalibrationError
from overtone.instrument.signals import Signals, signals_of
from overtone.units import format_quantity

_Floats = npt.NDArray[np.float64]

_FEWEST = 20  # points of a curve
_FEWEST_FAR = 5
_TOUCHED = 0.02  # of the far amplitude: a loss of so much is contact
_TURNED = 0.1  # of the far amplitude, by which the phasor is off: contact too
_FARTHEST = 0.1  # of the points: certainly far, or there is no far part
_RUN = 4  # points in a row
_CLEAR = 5e-9  # of the onset [m], and
_CLEAR_SHARE = 0.05  # of the free amplitude: attraction reaches that far
_LOWEST, _HIGHEST = 0.12, 0.96  # of the free amplitude: what a fit uses
_AFTER_JUMP = 2  # points that a jump may have spoilt
_LEAST_NOISE = 1e-15  # [m], of data without any
_LEAST_DRIFTING = 10  # far points from which a change along them can be told
_EVIDENCE = 4.0  # standard errors of that change
_BLOCKS, _FEWEST_A_BLOCK = 8, 4  # of the far part, for 1/f noise


class CurveParts(NamedTuple):
    """An approach curve, sorted from far to near, cut where it begins to feel the sample."""

    signals: Signals
    height: _Floats
    """(point,) [m]."""
    far: slice
    """Points that feel nothing."""
    contact: slice
    """Points from the first loss of amplitude on."""
    onset: float
    """Height of the first of them [m]."""


class FreeLever(NamedTuple):
    """The free first harmonic along the far part of a curve."""

    far_end: complex
    """a_1 at the far end [m]."""
    onset: complex
    """a_1 that the far part leads to where contact begins [m]."""
    changes: bool
    """Whether the two differ: the air film between lever and sample."""
    scatter: dict[str, float]
    """Standard deviations of ``A1`` [m] and ``phi1`` [rad]."""


def taken(signals: Signals, part: Any) -> Signals:
    """Return some of the readings: a slice, indices or a mask."""
    return Signals(
        signals.mean[part] if signals.mean is not None else None,
        {n: a[part] for n, a in signals.phasor.items()},
    )


def split_curve(approach: xr.Dataset) -> CurveParts:
    """Sort a curve from far to near and find where it begins to feel the sample.

    Parameters
    ----------
    approach : Dataset
        Observables over ``z`` [m]; points with a NaN in any of them are left out.

    Raises
    ------
    CalibrationError
        If it is too short, begins in contact or never touches.
    """
    signals = signals_of(approach)
    height = np.asarray(approach["z"].values, dtype=float)
    good = np.isfinite(height) & np.isfinite(signals.phasor[1])
    for a in (*signals.phasor.values(), *((signals.mean,) if signals.mean is not None else ())):
        good &= np.isfinite(a)
    order = np.flatnonzero(good)[np.argsort(-height[good], kind="stable")]
    if order.size < _FEWEST:
        lost = "" if order.size == height.size else f" of {height.size}, the others hold a NaN"
        raise CalibrationError(
            "the approach curve is too short",
            expected=f"{_FEWEST} readings or more",
            got=f"{order.size}{lost}",
        )
    signals, height = taken(signals, order), height[order]
    A = np.abs(signals.phasor[1])
    first = max(_FEWEST_FAR, round(_FARTHEST * order.size))
    level = float(np.median(A[:first]))
    scatter = 1.4826 * float(np.median(np.abs(np.diff(A[:first])))) / math.sqrt(2.0)
    limit = level - max(_TOUCHED * level, 6.0 * scatter)
    # below resonance a stiffer contact raises the amplitude: then the phase tells
    start = complex(np.mean(signals.phasor[1][:first]))
    below = (limit > A) | (np.abs(signals.phasor[1] - start) > _TURNED * level)
    runs = np.convolve(below, np.ones(_RUN, int))[_RUN - 1 :] == _RUN
    if not runs.any():
        raise CalibrationError(
            "the curve never touches",
            expected=f"an amplitude that falls by more than {100 * _TOUCHED:g} % towards the sample",
            got=f"{format_quantity(float(A.min()), 'm')} at least, of {format_quantity(level, 'm')}",
            hint="a curve that goes on to half the free amplitude",
        )
    touch = int(np.argmax(runs))
    onset = float(height[touch])
    clear = height > onset + _CLEAR + _CLEAR_SHARE * level
    far = int(np.count_nonzero(clear[:touch]))
    drop = float(A[:first].max() - A[:first].min())
    if far < _FEWEST_FAR or drop > 2.0 * _TOUCHED * level + 12.0 * scatter:
        few = far < _FEWEST_FAR
        raise CalibrationError(
            "the curve has no far part",
            expected=f"{_FEWEST_FAR} readings or more, {format_quantity(_CLEAR + _CLEAR_SHARE * level, 'm')} or more "
            "before the amplitude begins to fall",
            got=str(far)
            if few
            else f"an amplitude that falls by {format_quantity(drop, 'm')} among the first {first}",
            hint="a curve that begins farther away",
        )
    return CurveParts(signals, height, slice(0, far), slice(touch, order.size), onset)


def free_lever(parts: CurveParts) -> FreeLever:
    """Return the free first harmonic at both ends of the far part, and its scatter.

    Notes
    -----
    A straight line leads to the onset: the film of air changes the lever over micrometres.
    """
    a, height = parts.signals.phasor[1][parts.far], parts.height[parts.far]
    mean = complex(a.mean())
    middle = mean / abs(mean)
    design = np.column_stack([np.ones(height.size), (height - parts.onset) * 1e6])
    line, _, _, _ = np.linalg.lstsq(design + 0j, a / middle, rcond=None)
    left = a / middle - design @ line
    freedom = max(height.size - 2, 1)
    radial, tangential = (
        max(math.sqrt(float(part @ part) / freedom), _LEAST_NOISE) for part in (left.real, left.imag)
    )
    slope_error = math.sqrt(float(np.linalg.inv(design.T @ design)[1, 1])) * math.hypot(radial, tangential)
    changes = bool(abs(line[1]) > _EVIDENCE * slope_error and height.size >= _LEAST_DRIFTING)
    ends = (complex((line[0] + line[1] * design[0, 1]) * middle), complex(line[0] * middle))
    far_end, onset = ends if changes else (mean, mean)
    return FreeLever(far_end, onset, changes, {"A1": radial, "phi1": tangential / abs(mean)})


def wander(parts: CurveParts) -> float:
    """Return by how much the mean deflection wanders between the far part and contact, beyond white noise [m].

    From averages over eighths of the far part about a straight line: of 1/f noise they vary as much as averages far
    apart do, twice that in their difference. 0 where the far part is too short to tell, or nothing is left.
    """
    mean, height = parts.signals.mean, parts.height[parts.far]
    if mean is None or height.size < _BLOCKS * _FEWEST_A_BLOCK:
        return 0.0
    values = mean[parts.far]
    design = np.column_stack([np.ones(height.size), height - height.mean()])
    rest = values - design @ np.linalg.lstsq(design, values, rcond=None)[0]
    blocks = np.array([block.mean() for block in np.array_split(rest, _BLOCKS)])
    white = float(np.mean(np.diff(rest) ** 2)) / 2.0
    slow = float(blocks @ blocks) / (_BLOCKS - 2) - white * _BLOCKS / height.size
    return math.sqrt(2.0 * max(slow, 0.0))


def binned(parts: CurveParts, amplitude: float, bins: int) -> tuple[Signals, _Floats, _Floats]:
    """Average the part in contact over neighbours.

    Parameters
    ----------
    parts : CurveParts
        The curve.
    amplitude : float
        Free amplitude [m]; only amplitudes between 0.12 and 0.96 of it count.
    bins : int
        Groups of neighbours at most.

    Returns
    -------
    signals : Signals
        Means (group,), phasors averaged in the frame of the first harmonic.
    height, counts : array (group,)
        Mean height [m], and how many readings went into each.
    """
    part = parts.contact
    A = np.abs(parts.signals.phasor[1][part])
    index = np.flatnonzero((_LOWEST * amplitude < A) & (_HIGHEST * amplitude > A))
    # A jump from one branch to another: what comes right after it is still on the way, and nothing is averaged across
    # it. Branches differ in phase far more than in amplitude.
    steps = np.abs(np.diff(parts.signals.phasor[1][part]))
    usual = float(np.median(steps)) if steps.size else 0.0
    jumps = np.flatnonzero(steps > 10.0 * usual + 0.02 * amplitude)
    for jump in jumps:
        index = index[(index <= jump) | (index > jump + _AFTER_JUMP)]
    pieces = np.split(index, np.searchsorted(index, jumps, side="right"))
    share = min(bins / max(index.size, 1), 1.0)
    groups = [
        group
        for piece in pieces
        if piece.size
        for group in np.array_split(piece, max(round(share * piece.size), 1))
    ]
    signals = taken(parts.signals, part)

    def mean(values: npt.NDArray[Any]) -> npt.NDArray[Any]:
        return np.array([values[group].mean() for group in groups])

    turn = np.exp(1j * np.angle(signals.phasor[1]))
    phase = np.angle(mean(turn)) if groups else np.empty(0)
    phasor = {
        n: np.asarray(mean(a * turn ** (-n)), complex) * np.exp(1j * n * phase)
        for n, a in signals.phasor.items()
    }
    averaged = Signals(np.asarray(mean(signals.mean), float) if signals.mean is not None else None, phasor)
    counts = np.array([group.size for group in groups], dtype=float)
    return averaged, np.asarray(mean(parts.height[part]), float), counts
