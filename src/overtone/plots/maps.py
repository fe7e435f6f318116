"""One map: its image, its colour bar, and the veil over what is not determined."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.axes._base import _AxesBase
from matplotlib.backend_bases import RendererBase
from matplotlib.transforms import Bbox

from overtone.plots.curves import draw_curve
from overtone.plots.planes import frame_of, plane_of
from overtone.plots.scales import Array, Limits, Mask, Scale, scale_of
from overtone.plots.text import LABEL_SIZE, TICK_SIZE, draw_empty, label_of, set_title, title_of
from overtone.plots.ticks import edge_ticks, linear_ticks, log_ticks, room_for_ticks

_BAR_GAP, _BAR_WIDTH = 0.09, 0.12
_FEW_STEPS = 16  # so many colours have their edges named
_VEIL_PIXELS = 256
_VEIL_STRIPES = 24
_VEIL, _STRIPE = (212, 212, 212, 219), (148, 148, 148, 219)


def draw_map(
    axes: Axes,
    array: xr.DataArray,
    *,
    title: str | None = None,
    undetermined: xr.DataArray | None = None,
    limits: Limits | None = None,
    scale: Scale | None = None,
    bar: bool = True,
    interval: tuple[xr.DataArray, xr.DataArray] | None = None,
) -> None:
    """Draw one quantity: a map where it has rows and columns, a curve where it has one dimension.

    Parameters
    ----------
    axes : Axes
        Where to draw.
    array : DataArray
        SI values on ``(y, x)``, with coordinates in m or none; on one other dimension for a curve. Of further
        dimensions the first entry is drawn, and the title says so.
    title : str, optional
        Short; the name of the quantity where not given.
    undetermined : DataArray, optional
        True where the value is not determined by the data: covered by a hatched veil.
    limits : tuple of float, optional
        Colour limits in SI units; 2 to 98 % of the determined values where not given.
    scale : Scale, optional
        The whole scale, where maps share one.
    bar : bool, optional
        Whether the map has a colour bar of its own.
    interval : pair of DataArray, optional
        Both ends of an interval on the dimensions of the array, which a curve shows as bars and a map does not.
    """
    plane, note = plane_of(array)
    set_title(axes, (title_of(array) if title is None else title) + note)
    veil = (
        None if undetermined is None else plane_of(undetermined)[0].transpose(*plane.dims).values.astype(bool)
    )
    values = np.asarray(plane.values, dtype=float)
    if not np.isfinite(values).any():
        draw_empty(axes)
        return
    if scale is None:
        scale = scale_of(str(array.name), str(array.attrs.get("units", "")), values, veil, limits)
    label = label_of(array, scale.unit)
    if plane.ndim < 2:
        ends = None
        if interval is not None:
            lower, upper = (
                np.asarray(plane_of(end)[0].values, dtype=float) * scale.factor for end in interval
            )
            ends = (lower, upper)
        draw_curve(axes, plane, values * scale.factor, veil, label, logarithmic=scale.logarithmic, ends=ends)
        return
    drawn = scale.clip(values * scale.factor)
    room = draw_image(axes, plane, drawn, scale)
    if bar:
        _draw_colorbar(axes, drawn, scale, label, room)
    if veil is not None:
        _draw_veil(axes, veil)


def draw_image(axes: Axes, plane: xr.DataArray, values: Array, scale: Scale) -> int:
    """Draw values as an image with its axes, and return how many tick labels fit beside it."""
    frame = frame_of(plane)
    axes.set_anchor("NW")
    axes.tick_params(labelsize=TICK_SIZE)
    axes.imshow(
        np.ma.masked_invalid(values),
        origin="upper",
        extent=frame.extent,
        cmap=scale.colours,
        norm=scale.norm,
        # Averaging is for pixels that the page cannot show one by one, and never for categories, nor for steps: the
        # mean over a border between materials would get the colour of a third.
        interpolation="antialiased"
        if max(values.shape) > 200 and not scale.categorical and not scale.edges
        else "nearest",
        interpolation_stage="data",
        aspect="equal" if frame.equal else "auto",
    )
    axes.set_xlabel(frame.x_label, fontsize=LABEL_SIZE)
    axes.set_ylabel(frame.y_label, fontsize=LABEL_SIZE)
    across, beside = room_for_ticks(axes, frame.ratio)
    left, right, bottom, top = frame.extent
    for axis, room, ends in ((axes.xaxis, across, (left, right)), (axes.yaxis, beside, (bottom, top))):
        low, high = min(ends), max(ends)
        ticks = linear_ticks(low, high, min(room, 5), steps=(1, 2, 4, 5, 10), integer=frame.pixels)
        ticks.put_on(axis)
    return beside


@dataclass(frozen=True)
class _Beside:
    """Places axes to the right of others, as high as these and of a fixed width, whatever their shape."""

    axes: Axes

    def __call__(self, axes: _AxesBase, renderer: RendererBase) -> Bbox:
        box = self.axes.get_position()
        inch = self.axes.figure.dpi / self.axes.figure.bbox.width
        return Bbox.from_bounds(box.x1 + _BAR_GAP * inch, box.y0, _BAR_WIDTH * inch, box.height)


def _draw_colorbar(axes: Axes, values: Array, scale: Scale, label: str, room: int) -> None:
    low, high = scale.limits
    below, above = (bool(out) for out in scale.beyond)
    if not scale.edges:
        below, above = below or bool((values < low).any()), above or bool((values > high).any())
    extend: Literal["neither", "min", "max", "both"] = "neither"
    if below or above:
        extend = "both" if below and above else "min" if below else "max"
    if scale.edges and len(scale.edges) - 1 <= _FEW_STEPS:
        ticks = edge_ticks(scale.edges[:: math.ceil(len(scale.edges) / (room + 1))])
    else:
        ticks = log_ticks(low, high, room) if scale.logarithmic else linear_ticks(low, high, min(room, 6))
    inset = axes.inset_axes((1.04, 0.0, 0.055, 1.0))
    inset.set_axes_locator(_Beside(axes))
    inset.tick_params(labelsize=TICK_SIZE)
    bar = axes.figure.colorbar(
        axes.images[0], cax=inset, extend=extend, ticks=ticks.locator, format=ticks.formatter
    )
    bar.minorticks_off()
    bar.set_label(f"{label}, steps ≥ {scale.step}" if scale.step and room > 4 else label, fontsize=LABEL_SIZE)


def _draw_veil(axes: Axes, veil: Mask) -> None:
    """Cover pixels in half-transparent grey with diagonal stripes.

    The stripes are part of an image: a hatch of matplotlib follows contours, which cut through pixels.
    """
    fineness = math.ceil(_VEIL_PIXELS / max(veil.shape))
    fine = np.repeat(np.repeat(veil, fineness, axis=0), fineness, axis=1)
    period = max(fine.shape) / _VEIL_STRIPES
    diagonal = np.add.outer(np.arange(fine.shape[0]), np.arange(fine.shape[1]))
    cover = np.zeros((*fine.shape, 4), np.uint8)
    cover[fine] = _VEIL
    cover[fine & (diagonal % period < 0.28 * period)] = _STRIPE
    lay_over(axes, cover, "undetermined", zorder=2)


def lay_over(axes: Axes, cover: npt.NDArray[np.uint8], name: str, *, zorder: float) -> None:
    """Lay an image of colours with alpha (y, x, 4) over the map that axes show, within its limits."""
    limits = axes.get_xlim(), axes.get_ylim()
    overlay = axes.imshow(
        cover,
        origin="upper",
        extent=axes.images[0].get_extent(),
        aspect=axes.get_aspect(),
        interpolation="nearest",
        zorder=zorder,
    )
    overlay.set_gid(name)
    axes.set_xlim(limits[0])
    axes.set_ylim(limits[1])
