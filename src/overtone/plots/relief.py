"""Shaded relief: the topography under the colours of a map, so that both are seen."""

from __future__ import annotations

import math

import numpy as np
import xarray as xr
from matplotlib.axes import Axes

from overtone.plots.maps import lay_over
from overtone.plots.planes import plane_of
from overtone.plots.scales import Array, Mask

_STEEPEST = 0.9  # slope that the 98th percentile of all slopes is drawn with
_STRENGTH = 0.5  # of black or white, where the surface turns fully from the light or to it
_LIGHT = (-0.5, 0.5, math.sqrt(0.5))  # from the upper left, half way up


def draw_relief(axes: Axes, height: xr.DataArray) -> None:
    """Darken and lighten the map on some axes by how its surface lies to a light from the upper left.

    Parameters
    ----------
    axes : Axes
        With the image of a map.
    height : DataArray
        Topography [m] on the pixels of that map.

    Notes
    -----
    The shade lies over the colours, below the veil over what is not determined; its strength follows the steepest
    slopes of the scan, so that it shows shape and no angles. The tilt of the scan is left out.
    """
    shade = shading(np.asarray(plane_of(height)[0].values, dtype=float))
    cover = np.zeros((*shade.shape, 4), np.uint8)
    cover[shade > 0.0, :3] = 255
    cover[..., 3] = np.round(255.0 * _STRENGTH * np.abs(shade)).astype(np.uint8)
    lay_over(axes, cover, "relief", zorder=1)


def shading(height: Array) -> Array:
    """Return from -1 (turned away) over 0 (flat) to 1 (turned to the light) how each pixel lies to the light.

    Parameters
    ----------
    height : array (y, x)
        Any unit; row 0 on top, pixels as wide as high. Pixels without a height come out flat.
    """
    known = np.isfinite(height)
    if min(height.shape) < 2 or not known.any():
        return np.zeros(height.shape)
    surface = _levelled(np.where(known, height, np.median(height[known])), known)
    slope = np.hypot(*np.gradient(surface))
    steep = float(np.percentile(slope, 98.0))
    if steep <= 0.0:
        return np.zeros(height.shape)
    down, right = np.gradient(surface * (_STEEPEST / steep))  # along rows, which count from the top
    # unit vector to the light against the unit normal (-right, down, 1) in (x, y up, z)
    x, y, z = _LIGHT
    lit = (z - x * right + y * down) / np.sqrt(1.0 + right**2 + down**2)
    shade = np.where(lit < z, lit / z - 1.0, (lit - z) / (1.0 - z))
    return np.where(known, np.clip(shade, -1.0, 1.0), 0.0)


def _levelled(surface: Array, known: Mask) -> Array:
    """Return a surface less the plane through it."""
    rows, columns = np.indices(surface.shape)
    basis = np.stack([np.ones(surface.size), rows.ravel(), columns.ravel()], axis=-1)
    used = known.ravel()
    plane, *_ = np.linalg.lstsq(basis[used], surface.ravel()[used], rcond=None)
    return np.asarray(surface - (basis @ plane).reshape(surface.shape))
