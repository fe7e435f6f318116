"""Which pixels of a scan are the reference material: as marked, or as they look."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np
import numpy.typing as npt
import xarray as xr

from overtone.errors import CalibrationError

_Floats = npt.NDArray[np.float64]
_Mask = npt.NDArray[np.bool_]

_FEWEST = 25
_SHARE = 0.005  # of a scan: fewer pixels are an edge or an accident
_NEAR = 3.0  # standard deviations of what all pixels share
_WITHIN = 3.5  # standard deviations of a pixel about its phase
_PASSES = 20


def reference_pixels(scan: xr.Dataset, chosen: xr.DataArray | Sequence[float]) -> _Mask:
    """Return the pixels that a mask or a rectangle marks.

    Parameters
    ----------
    scan : Dataset
        Observables (y, x).
    chosen : DataArray or sequence
        Mask on the dimensions of A1, or ``(x0, y0, x1, y1)`` [m].

    Raises
    ------
    CalibrationError
        If it does not fit the scan or marks fewer than 25 pixels.
    """
    like = scan["A1"]
    if isinstance(chosen, xr.DataArray):
        if set(chosen.dims) != set(like.dims) or any(chosen.sizes[d] != like.sizes[d] for d in like.dims):
            raise CalibrationError(
                "the mask of the reference does not fit the scan",
                expected=str(dict(like.sizes)),
                got=str(dict(chosen.sizes)),
            )
        # NaN marks nothing
        mask: _Mask = np.nan_to_num(np.asarray(chosen.transpose(*like.dims).values, dtype=float)) != 0.0
    else:
        try:
            corners = np.asarray(chosen, dtype=float)
        except (TypeError, ValueError):
            corners = np.empty(0)
        if corners.shape != (4,) or not np.isfinite(corners).all():
            raise CalibrationError(
                "a rectangle is four numbers", expected="x0, y0, x1, y1 [m]", got=repr(chosen)
            )
        if not {"x", "y"} <= set(scan.coords):
            raise CalibrationError("the scan has no coordinates", expected="x and y [m]", hint="a mask")
        x0, y0, x1, y1 = (float(v) for v in corners)
        x, y = scan["x"].broadcast_like(like), scan["y"].broadcast_like(like)
        inside = (x >= min(x0, x1)) & (x <= max(x0, x1)) & (y >= min(y0, y1)) & (y <= max(y0, y1))
        mask = np.asarray(inside.transpose(*like.dims).values)
    mask = mask & np.isfinite(like.values)
    if int(mask.sum()) < _FEWEST:
        raise CalibrationError(
            "too few pixels of the reference", expected=f"{_FEWEST} or more", got=str(int(mask.sum()))
        )
    return mask


def find_reference(
    off: Mapping[str, _Floats], shared: Mapping[str, float], drift: Mapping[str, float], findings: list[str]
) -> _Mask:
    """Return the pixels that look like the reference, as far as the calibration is sure how it looks.

    Parameters
    ----------
    off : mapping of str to array (y, x)
        How far each pixel is from the approach curve in each reading.
    shared : mapping of str to float
        Standard deviation of what all pixels are off together: zero, phase, gains.
    drift : mapping of str to float
        What one line may differ from another by without being of another material.
    findings : list of str
        Gets a sentence where another group of pixels would pass as well.

    Raises
    ------
    CalibrationError
        If no group of pixels is near enough to the curve.
    """
    names = list(off)
    shape = off[names[0]].shape
    points = np.stack([off[name].ravel() for name in names], axis=-1)
    known = np.isfinite(points).all(axis=1)
    # the scatter of one phase: neighbours along a line are mostly of one material
    noise = np.array([math.hypot(_neighbour_noise(off[name]), drift.get(name, 0.0)) for name in names])
    width = np.array([shared[name] for name in names])
    scaled = points / noise
    allowed = np.sqrt(1.0 + (width / noise) ** 2)
    near = known & (np.abs(scaled) < _NEAR * allowed).all(axis=1)
    least = max(_FEWEST, math.ceil(_SHARE * known.sum()))
    if int(near.sum()) < least:
        raise CalibrationError(
            "the reference is absent from the scan",
            expected=f"{least} pixels or more that look like the approach curve, within what may have drifted",
            got=f"{int(near.sum())}",
            hint="mark it (reference=mask or rectangle), a curve taken at this session, or reference=None",
        )
    group = _densest(scaled, near)
    mask = np.zeros(points.shape[0], bool)
    mask[group] = True
    if int(mask.sum()) < least:
        raise CalibrationError(
            "no group of pixels looks like the reference",
            expected=f"{least} pixels or more",
            got=str(int(mask.sum())),
        )
    others = near & ~mask
    rest = _densest(scaled, others) if int(others.sum()) >= least else np.empty(0, int)
    if rest.size > max(least, 0.2 * mask.sum()):
        findings.append(
            f"another group of {100 * rest.size / known.sum():.2g} % of the pixels passes for the reference as well; "
            "the larger one was taken: mark the reference where that is wrong"
        )
    return mask.reshape(shape)


def _densest(scaled: _Floats, among: _Mask) -> npt.NDArray[np.intp]:
    """Return the pixels about the place where most of some pixels lie."""
    index = np.flatnonzero(among)
    # start from the pixel with most others around it, out of a sample
    sample = scaled[index[:: max(1, index.size // 400)]]
    crowd = [int((np.abs(sample - s) < _WITHIN).all(axis=1).sum()) for s in sample]
    middle = sample[int(np.argmax(crowd))]
    inside = np.empty(0, int)
    for _ in range(_PASSES):
        inside = index[(np.abs(scaled[index] - middle) < _WITHIN).all(axis=1)]
        if not inside.size:
            break
        moved = np.median(scaled[inside], axis=0)
        if np.abs(moved - middle).max() < 1e-3:
            break
        middle = moved
    return inside


def _neighbour_noise(values: _Floats) -> float:
    """Return the scatter from one pixel to the next along the last axis, whatever the phases."""
    steps = np.diff(values, axis=-1)
    known = steps[np.isfinite(steps)]
    if known.size == 0:
        return math.inf
    return max(1.4826 * float(np.median(np.abs(known))) / math.sqrt(2.0), 1e-18)
