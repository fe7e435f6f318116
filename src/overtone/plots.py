"""Figures of observables, forces, energies and properties: pictures only, no science.

Figures are built without pyplot, so that they need no screen and may be drawn in threads. In every map row 0
is at the top, light grey is missing data, and a grey hatched veil covers what the data do not determine.
"""

from __future__ import annotations

import io
import math
import re
import textwrap
from collections.abc import Hashable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt
import xarray as xr
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colorbar import Colorbar
from matplotlib.colors import BoundaryNorm, Colormap, ListedColormap, LogNorm, Normalize
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullLocator, ScalarFormatter
from PIL import Image

from overtone.quantities import harmonic_orders, quantity
from overtone.report.content import Report
from overtone.report.shares import flag_shares, flags, format_share
from overtone.units import display_unit

_Array = npt.NDArray[np.float64]
_Limits = tuple[float, float]

TITLE_SIZE, LABEL_SIZE, TICK_SIZE = 10.0, 9.0, 8.0
DPI = 100
NO_DATA = "no data"
MISSING_COLOUR = "0.87"
_TITLES = {
    "A0": "mean deflection",
    "residual": "residual $N_r$",
    "dissipation": "dissipated energy",
}
_FLAG_COLOURS = {
    "determined": "#0072b2",
    "not determined by these data": "#b5b5b5",
    "answer depends on start": "#f0e442",
    "model does not fit": "#d55e00",
    "at bound": "#cc79a7",
    "not converged": "#000000",
    "missing data": "#ededed",
    "attractive": "#0072b2",
    "undetermined": "#b5b5b5",
    "repulsive": "#d55e00",
}
_MATERIAL_COLOURS = ("#0072b2", "#e69f00", "#009e73", "#cc79a7", "#56b4e9", "#d55e00", "#7f7f7f")
_LOGARITHMIC = ("modulus", "amplification", "residual", "uncertainty")
_GREEK = ("phi", "delta", "sigma")


# ---------------------------------------------------------------------------------------------------- one map


def draw_map(
    axes: Axes,
    array: xr.DataArray,
    *,
    title: str | None = None,
    undetermined: xr.DataArray | None = None,
    limits: _Limits | None = None,
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
    """
    plane, note = _plane(array)
    _set_title(axes, (_default_title(array) if title is None else title) + note)
    veil = (
        None if undetermined is None else _plane(undetermined)[0].transpose(*plane.dims).values.astype(bool)
    )
    values = np.asarray(plane.values, dtype=float)
    if not np.isfinite(values).any():
        _draw_empty(axes)
        return
    scale = _scale(str(array.name), str(array.attrs.get("units", "")), values, veil, limits)
    label = _label(array, scale.unit)
    if plane.ndim < 2:
        _draw_curve(axes, plane, values * scale.factor, veil, scale, label)
    else:
        image = _draw_image(axes, plane, scale.clip(values * scale.factor), scale)
        _draw_colorbar(axes, image, scale, label)
        if veil is not None:
            _draw_veil(axes, image, veil)


def draw_flags(
    axes: Axes, array: xr.DataArray, *, title: str | None = None, legend_axes: Axes | None = None
) -> None:
    """Draw a categorical map with the share of pixels of each category in its legend.

    Parameters
    ----------
    axes : Axes
        Where to draw.
    array : DataArray
        Integers with ``flag_values`` and ``flag_meanings``, such as ``status`` and ``regime``.
    title : str, optional
        Short; the name of the quantity where not given.
    legend_axes : Axes, optional
        A cell that the legend has for itself; below the map where not given.
    """
    plane, note = _plane(array)
    _set_title(axes, (_default_title(array) if title is None else title) + note)
    known = flags(array)
    colours = [_FLAG_COLOURS.get(m, _MATERIAL_COLOURS[i % 7]) for i, m in enumerate(known.values())]
    codes = np.full(plane.shape, math.nan)
    for i, flag in enumerate(known):
        codes[plane.values == flag] = i
    if not known or not np.isfinite(codes).any():
        _draw_empty(axes)
        if legend_axes is not None:
            legend_axes.set_axis_off()
        return
    if plane.ndim < 2:
        _draw_flag_points(axes, plane, codes, colours)
    else:
        norm = BoundaryNorm(np.arange(len(known) + 1) - 0.5, len(known))
        _draw_image(axes, plane, codes, _Scale(1.0, "", ListedColormap(colours), norm))
    shares = flag_shares(array)
    handles = [
        Patch(facecolor=colour, edgecolor="0.4", label=f"{format_share(share)}  {meaning}")
        for colour, (meaning, share) in zip(colours, shares.items(), strict=True)
        if share > 0.0 or meaning == "determined" or len(shares) <= 3
    ]
    if legend_axes is None:
        axes.legend(
            handles=handles,
            loc="upper left",
            bbox_to_anchor=(-0.05, -0.2),
            frameon=False,
            fontsize=LABEL_SIZE,
        )
    else:
        legend_axes.set_axis_off()
        legend_axes.legend(
            handles=handles, loc="center left", frameon=False, fontsize=LABEL_SIZE, borderaxespad=0
        )


@dataclass(frozen=True)
class _Scale:
    """From SI values to colours: factor and label of the unit, colour map and norm in that unit."""

    factor: float
    unit: str
    colours: Colormap
    norm: Normalize

    @property
    def logarithmic(self) -> bool:
        return isinstance(self.norm, LogNorm)

    @property
    def categorical(self) -> bool:
        return isinstance(self.norm, BoundaryNorm)

    @property
    def limits(self) -> _Limits:
        low, high = self.norm.vmin, self.norm.vmax
        return (0.0 if low is None else float(low), 1.0 if high is None else float(high))

    def clip(self, values: _Array) -> _Array:
        """Give zero the lowest colour on a logarithmic scale: it is a value, not missing data."""
        return np.where(values <= 0.0, self.limits[0] / 10.0, values) if self.logarithmic else values


def _scale(
    name: str, unit: str, values: _Array, veil: npt.NDArray[np.bool_] | None, limits: _Limits | None
) -> _Scale:
    record = quantity(name)
    kind = record.kind if record else "quality"
    unit = record.unit if record else unit
    chosen = _readable(values, veil)
    low, high = limits or _robust_limits(chosen, positive=False)
    logarithmic = name.startswith(_LOGARITHMIC) or (kind == "property" and low > 0.0 and high > 100.0 * low)
    logarithmic = logarithmic and high > 0.0
    if logarithmic and low <= 0.0:
        low, high = _robust_limits(chosen if (chosen > 0.0).any() else values, positive=True)
    display = display_unit(
        math.sqrt(low) * math.sqrt(high) if logarithmic else max(abs(low), abs(high)), unit
    )
    low, high = low * display.factor, high * display.factor
    norm: Normalize
    if logarithmic:
        low, high = (low / 2.0, high * 2.0) if high < low * 1.001 else (low, high)
        norm = LogNorm(low, high)
    else:
        if high - low <= 1e-6 * max(abs(low), abs(high)):
            margin = 0.05 * max(abs(low), abs(high)) or 1.0
            low, high = low - margin, high + margin
        norm = Normalize(low, high)
    colours = "viridis" if kind == "property" else "cividis"
    if unit == "rad" and high - low > 270.0:
        # A phase that goes around: 0 and 360 degrees are the same and get the same colour.
        colours, norm = "twilight", Normalize(-180.0, 180.0) if low < 0.0 else Normalize(0.0, 360.0)
    elif low < 0.0 < high and (kind == "force" or name == "virial"):
        # Centred on zero only where the sign changes: otherwise half of the colours would go unused.
        reach = max(-low, high)
        colours, norm = "RdBu_r", Normalize(-reach, reach)
    return _Scale(display.factor, display.label, colormaps[colours].with_extremes(bad=MISSING_COLOUR), norm)


def _readable(values: _Array, veil: npt.NDArray[np.bool_] | None) -> _Array:
    """Return the finite values that set the colours: the determined ones, where they are not a handful."""
    finite = np.isfinite(values)
    return values[finite & ~veil] if veil is not None and _is_readable(values, veil) else values[finite]


def _is_readable(values: _Array, veil: npt.NDArray[np.bool_]) -> bool:
    return bool(np.count_nonzero(np.isfinite(values) & ~veil) >= max(20, 0.02 * values.size))


def _robust_limits(values: _Array, *, positive: bool) -> _Limits:
    """Return the 2nd and 98th percentile, or the extremes where those coincide."""
    values = values[np.isfinite(values)]
    if positive:
        values = values[values > 0.0]
    low, high = np.percentile(values, [2.0, 98.0])
    if low == high:
        low, high = values.min(), values.max()
    return float(low), float(high)


def _plane(array: xr.DataArray) -> tuple[xr.DataArray, str]:
    """Return what can be drawn on one plane, and a note where that is not all of it."""
    kept: list[Hashable] = ["y", "x"] if {"y", "x"} <= set(array.dims) else list(array.dims)[-2:]
    leading = [dim for dim in array.dims if dim not in kept]
    notes = [f", {dim} 1 of {array.sizes[dim]}" for dim in leading if array.sizes[dim] > 1]
    plane = array.isel(dict.fromkeys(leading, 0), drop=True).transpose(*kept)
    return plane, "".join(notes)


def _draw_image(axes: Axes, plane: xr.DataArray, values: _Array, scale: _Scale) -> AxesImage:
    frame = _frame(plane)
    image = axes.imshow(
        np.ma.masked_invalid(values),
        origin="upper",
        extent=frame.extent,
        cmap=scale.colours.with_extremes(bad=MISSING_COLOUR),
        norm=scale.norm,
        # Averaging is for pixels that the page cannot show one by one, and never for categories.
        interpolation="antialiased" if max(values.shape) > 200 and not scale.categorical else "nearest",
        interpolation_stage="data",
        aspect="equal" if frame.equal else "auto",
    )
    axes.set_xlabel(frame.x_label, fontsize=LABEL_SIZE)
    axes.set_ylabel(frame.y_label, fontsize=LABEL_SIZE)
    for axis, room in ((axes.xaxis, 5), (axes.yaxis, min(_room_for_ticks(image), 5))):
        axis.set_major_locator(MaxNLocator(room, steps=[1, 2, 4, 5, 10], integer=frame.pixels, min_n_ticks=1))
    axes.tick_params(labelsize=TICK_SIZE)
    return image


@dataclass(frozen=True)
class _Frame:
    """Where an image lies: (left, right, bottom, top) of its outer edges, row 0 at the top."""

    extent: tuple[float, float, float, float]
    x_label: str
    y_label: str
    equal: bool
    pixels: bool = False


def _frame(plane: xr.DataArray) -> _Frame:
    rows, columns = plane.dims
    is_map = {rows, columns} == {"y", "x"}
    y, x = _coordinate(plane, rows), _coordinate(plane, columns)
    step_y, step_x = _step(y), _step(x)
    if is_map:  # a map of one row or column takes the pixel size of the other direction
        step_x, step_y = step_x or abs(step_y), step_y or -abs(step_x)
    if y is None or x is None or step_x == 0.0 or step_y == 0.0:
        height, width = plane.shape
        extent = (-0.5, width - 0.5, height - 0.5, -0.5)
        return _Frame(
            extent, f"{columns} [pixel]", f"{rows} [pixel]", _is_drawable(is_map, height, width), pixels=True
        )
    left, right = x[0] - step_x / 2.0, x[-1] + step_x / 2.0
    top, bottom = y[0] - step_y / 2.0, y[-1] + step_y / 2.0
    across, along = abs(bottom - top), abs(right - left)
    common = max(across, along) if is_map else 0.0
    x_unit = display_unit(common or along, _coordinate_unit(plane, columns))
    y_unit = display_unit(common or across, _coordinate_unit(plane, rows))
    return _Frame(
        (left * x_unit.factor, right * x_unit.factor, bottom * y_unit.factor, top * y_unit.factor),
        _with_unit(str(columns), x_unit.label),
        _with_unit(str(rows), y_unit.label),
        _is_drawable(is_map, across, along),
    )


def _is_drawable(is_map: bool, height: float, width: float) -> bool:
    """Return whether equal scales leave something to see: a single scan line would be a hairline."""
    return is_map and 0.05 < height / width < 20.0


def _coordinate(array: xr.DataArray, dim: Hashable) -> _Array | None:
    if dim not in array.coords or not np.issubdtype(array.coords[dim].dtype, np.number):
        return None
    values = np.asarray(array.coords[dim].values, dtype=float)
    return values if values.shape == (array.sizes[dim],) and np.isfinite(values).all() else None


def _coordinate_unit(array: xr.DataArray, dim: Hashable) -> str:
    return str(array.coords[dim].attrs.get("units", "m" if dim in ("x", "y", "z") else "1"))


def _step(coordinate: _Array | None) -> float:
    if coordinate is None or coordinate.size < 2:
        return 0.0
    return float(coordinate[-1] - coordinate[0]) / (coordinate.size - 1)


def _draw_colorbar(axes: Axes, image: AxesImage, scale: _Scale, label: str) -> None:
    values: _Array = np.ma.compressed(np.ma.asarray(image.get_array()))
    low, high = scale.limits
    below, above = bool((values < low).any()), bool((values > high).any())
    extend: Literal["neither", "min", "max", "both"] = "neither"
    if below or above:
        extend = "both" if below and above else "min" if below else "max"
    # An inset keeps the height of the image, whatever its aspect.
    bar = axes.figure.colorbar(image, cax=axes.inset_axes((1.04, 0.0, 0.055, 1.0)), extend=extend)
    bar.set_label(label, fontsize=LABEL_SIZE)
    bar.ax.tick_params(labelsize=TICK_SIZE)
    if scale.logarithmic:
        _set_log_ticks(bar, low, high, _room_for_ticks(image))
    elif isinstance(bar.formatter, ScalarFormatter):
        # An offset would be written above the bar, into the title of the map.
        bar.formatter.set_useOffset(False)
        bar.formatter.set_scientific(False)
        bar.update_ticks()


def _room_for_ticks(image: AxesImage) -> int:
    """Return how many tick labels fit beside an image, from the cell it was given."""
    left, right, bottom, top = image.get_extent()
    cell, aspect = image.axes.bbox, image.axes.get_aspect()
    height = (
        cell.height
        if aspect == "auto"
        else min(cell.height, cell.width * abs((top - bottom) / (right - left)))
    )
    return max(2, int(height / image.axes.figure.dpi * 72.0 / (2.2 * TICK_SIZE)))


def _set_log_ticks(bar: Colorbar, low: float, high: float, room: int) -> None:
    decades = math.log10(high / low)
    if decades > 1.0:
        dense = decades < 2.0 and room > 5
        bar.locator = LogLocator(10.0, subs=(1.0, 2.0, 5.0) if dense else (1.0,), numticks=min(room, 8))
    else:
        bar.locator = MaxNLocator(min(room, 5))
    bar.minorlocator = NullLocator()
    bar.formatter = _log_formatter(low, high)
    bar.update_ticks()


def _log_formatter(low: float, high: float) -> FuncFormatter:
    """Write plain numbers where all of them are short, and powers of ten otherwise."""
    plain = low >= 0.5e-3 and high < 2e5

    def write(value: float, _: int | None = None) -> str:
        exponent = math.floor(math.log10(value) + 1e-9) if value > 0.0 else 0
        mantissa = value / 10.0**exponent
        if plain or value <= 0.0:
            return f"{value:g}"
        return (
            f"$10^{{{exponent}}}$"
            if abs(mantissa - 1.0) < 1e-6
            else f"${mantissa:.3g}\\cdot 10^{{{exponent}}}$"
        )

    return FuncFormatter(write)


def _draw_veil(axes: Axes, image: AxesImage, veil: npt.NDArray[np.bool_]) -> None:
    """Cover pixels in half-transparent grey with diagonal stripes.

    The stripes are part of an image: a hatch of matplotlib follows contours, which cut through pixels.
    """
    fineness = math.ceil(480 / max(veil.shape))
    fine = np.repeat(np.repeat(veil, fineness, axis=0), fineness, axis=1)
    i, j = np.indices(fine.shape)
    period = max(fine.shape) / 24.0
    stripe = (i + j) % period < 0.28 * period
    cover = np.zeros((*fine.shape, 4), np.float32)
    cover[fine] = (0.83, 0.83, 0.83, 0.86)
    cover[fine & stripe] = (0.58, 0.58, 0.58, 0.86)
    limits = axes.get_xlim(), axes.get_ylim()
    overlay = axes.imshow(
        cover, origin="upper", extent=image.get_extent(), aspect=axes.get_aspect(), zorder=2
    )
    overlay.set_gid("undetermined")
    axes.set_xlim(limits[0])
    axes.set_ylim(limits[1])


def _draw_curve(
    axes: Axes,
    line: xr.DataArray,
    values: _Array,
    veil: npt.NDArray[np.bool_] | None,
    scale: _Scale,
    label: str,
) -> None:
    position, position_label = _abscissa(line)
    values = np.atleast_1d(values)
    sure = np.ones(values.shape, bool) if veil is None else ~np.atleast_1d(veil)
    axes.plot(position, values, "-", color="0.75", linewidth=0.8, zorder=1)
    if (~sure).any():
        points = axes.plot(
            position[~sure], values[~sure], "o", markersize=3.5, mfc="none", mec="0.6", zorder=2
        )
        points[0].set_gid("undetermined")
    axes.plot(position[sure], values[sure], "o", markersize=3, color="#0072b2", zorder=3)
    if scale.logarithmic:
        axes.set_yscale("log", nonpositive="mask")
    axes.set_xlabel(position_label, fontsize=LABEL_SIZE)
    axes.set_ylabel(label, fontsize=LABEL_SIZE)
    axes.tick_params(labelsize=TICK_SIZE)


def _draw_flag_points(axes: Axes, line: xr.DataArray, codes: _Array, colours: Sequence[str]) -> None:
    position, label = _abscissa(line)
    codes = np.atleast_1d(codes)
    known = np.isfinite(codes)
    axes.scatter(position[known], codes[known], s=12, c=[colours[int(code)] for code in codes[known]])
    axes.set_yticks([])
    axes.set_xlabel(label, fontsize=LABEL_SIZE)
    axes.tick_params(labelsize=TICK_SIZE)


def _abscissa(line: xr.DataArray) -> tuple[_Array, str]:
    if line.ndim == 0:
        return np.zeros(1), ""
    dim = line.dims[0]
    coordinate = _coordinate(line, dim)
    if coordinate is None:
        return np.arange(line.size, dtype=float), str(dim)
    unit = display_unit(float(np.abs(coordinate).max(initial=0.0)), _coordinate_unit(line, dim))
    return coordinate * unit.factor, _with_unit(str(dim), unit.label)


def _draw_empty(axes: Axes) -> None:
    axes.set_xticks([])
    axes.set_yticks([])
    axes.set_box_aspect(1.0)
    axes.text(
        0.5,
        0.5,
        NO_DATA,
        transform=axes.transAxes,
        ha="center",
        va="center",
        color="0.4",
        fontsize=TITLE_SIZE,
    )


# --------------------------------------------------------------------------------------------------------- text


def _set_title(axes: Axes, title: str) -> None:
    inches = axes.bbox.width / axes.figure.dpi
    letters = max(12, int(inches * 72.0 / (0.55 * TITLE_SIZE)))
    axes.set_title(textwrap.fill(title, letters), fontsize=TITLE_SIZE, loc="left")


def _default_title(array: xr.DataArray) -> str:
    name = str(array.name)
    record = quantity(name)
    if name in _TITLES:
        return _TITLES[name]
    if record and record.kind == "observable" and record.symbol != "h":
        return record.meaning
    return name.replace("_", " ")


def _label(array: xr.DataArray, unit: str) -> str:
    record = quantity(str(array.name))
    symbol = record.symbol if record else ""
    if symbol:
        return _with_unit(_math(symbol), unit)
    return unit or str(array.name).replace("_", " ")


def _with_unit(text: str, unit: str) -> str:
    return f"{text} [{unit}]" if unit else text


def _math(symbol: str) -> str:
    r"""Typeset a symbol.

    Examples
    --------
    >>> print(_math("delta_max"), _math("A_0"), _math("E_s"))
    $\delta_{\mathrm{max}}$ $A_{0}$ $E_{s}$
    """
    base, _, index = symbol.partition("_")
    base = f"\\{base}" if base in _GREEK else base
    if not index:
        return f"${base}$"
    return (
        f"${base}_{{\\mathrm{{{index}}}}}$"
        if re.fullmatch("[A-Za-z]{2,}", index)
        else f"${base}_{{{index}}}$"
    )


# ------------------------------------------------------------------------------------------------------ figures


def observables_figure(observables: xr.Dataset) -> Figure:
    """Return the maps of everything that was measured.

    Parameters
    ----------
    observables : Dataset
        Observables, with ``height`` where there is one.
    """
    arrays = [observables[name] for name in _measured(observables)]
    figure, cells = _grid(arrays, len(arrays))
    for axes, array in zip(cells, arrays, strict=True):
        draw_map(axes, array)
    return figure


def forces_figure(energies: xr.Dataset) -> Figure:
    """Return the maps of the force harmonics: all conservative ones and the dissipative ones from the first on.

    Parameters
    ----------
    energies : Dataset
        ``F_cons(harmonic)`` and ``F_diss(harmonic)``.
    """
    panels: list[tuple[str, xr.DataArray]] = []
    for name, word, first in (("F_cons", "conservative", 0), ("F_diss", "dissipative", 1)):
        if name in energies:
            for n in energies["harmonic"].values:
                if n >= first:
                    panels.append((f"{word} force, harmonic {n}", energies[name].sel(harmonic=n, drop=True)))
    figure, cells = _grid([array for _, array in panels], len(panels))
    for axes, (title, array) in zip(cells, panels, strict=True):
        draw_map(axes, array, title=title)
    return figure


def energy_figure(energies: xr.Dataset) -> Figure:
    """Return the maps of dissipated energy and virial, and of the regime where it was decided.

    Parameters
    ----------
    energies : Dataset
        ``dissipation`` and ``virial`` [J], optionally ``regime``.
    """
    arrays = [energies[name] for name in ("dissipation", "virial", "regime") if name in energies]
    figure, cells = _grid(arrays, len(arrays), below=0.7 if "regime" in energies else 0.0)
    for axes, array in zip(cells, arrays, strict=True):
        if array.name == "regime":
            draw_flags(axes, array)
        else:
            draw_map(axes, array)
    return figure


def properties_figure(label: str, properties: xr.Dataset) -> Figure:
    """Return the maps of one inversion: estimates under their veil, range, quality and status.

    Parameters
    ----------
    label : str
        What the result was inverted from, such as "harmonics 1, 2, 3".
    properties : Dataset
        Result of `overtone.map_properties`.
    """
    veil = _undetermined(properties)
    limits = _shared_limits(properties, veil)
    estimates = {"modulus": "modulus", "adhesion": "adhesion", "indentation": "maximum indentation"}
    others = {
        "modulus_lower": "modulus, lower end (90 %)",
        "modulus_upper": "modulus, upper end (90 %)",
        "amplification": "noise amplification",
        "residual": "residual",
    }
    panels: list[tuple[str, xr.DataArray | None, xr.DataArray | None]]
    panels = [(f"{title}, estimate", _estimate(properties, name), veil) for name, title in estimates.items()]
    panels += [(title, properties.get(name), None) for name, title in others.items()]
    drawn = [(title, array, cover) for title, array, cover in panels if array is not None]
    figure, cells = _grid([properties["status"]], len(drawn) + 2)
    figure.suptitle(label, fontsize=TITLE_SIZE + 1.0, parse_math=False)
    for axes, (title, array, cover) in zip(cells, drawn, strict=False):
        shared = limits if str(array.name).startswith("modulus") else None
        draw_map(axes, array, title=title, undetermined=cover, limits=shared)
    draw_flags(cells[-2], properties["status"], title="status", legend_axes=cells[-1])
    return figure


def histogram_figure(
    label: str, properties: xr.Dataset, truth: xr.Dataset | None = None, materials: Sequence[str] = ()
) -> Figure:
    """Return histograms of one inversion, with the true medians where they are known.

    Parameters
    ----------
    label : str
        What the result was inverted from.
    properties : Dataset
        Result of `overtone.map_properties`.
    truth : Dataset, optional
        ``modulus``, ``adhesion``, ``indentation`` that a simulation started from, and ``material``.
    materials : sequence of str
        Names of the materials.
    """
    panels = {
        "modulus": "modulus",
        "adhesion": "adhesion",
        "indentation": "maximum indentation",
        "residual": "residual",
    }
    dims = properties["status"].dims
    determined = ~_undetermined(properties).values.ravel()
    groups = _groups(truth, materials, dims, determined.size)
    shown = [name for name in panels if _estimate(properties, name) is not None]
    figure = _figure(10.0, 2.9 * math.ceil(len(shown) / 2) + 0.7)
    cells = figure.subplots(math.ceil(len(shown) / 2), 2, squeeze=False).ravel()
    figure.suptitle(label, fontsize=TITLE_SIZE + 1.0, parse_math=False)
    for spare in cells[len(shown) :]:
        spare.set_axis_off()
    for axes, name in zip(cells, shown, strict=False):
        estimate = _estimate(properties, name)
        if estimate is None:
            continue
        true = truth[name].transpose(*dims).values.ravel() if truth is not None and name in truth else None
        _draw_histogram(axes, estimate, determined, groups, true, panels[name])
    handles = [Patch(facecolor=g.colour, label=g.label) for g in groups if g.label]
    handles += [
        Patch(facecolor="0.5", label="determined"),
        Patch(facecolor="none", edgecolor="0.3", label="not determined"),
    ]
    lines = [Line2D([], [], color="0.2", linestyle="--", label="true median")] if truth is not None else []
    legend = figure.legend(
        handles=[*handles, *lines],
        loc="outside lower center",
        ncols=min(len(handles) + 1, 6),
        frameon=False,
        fontsize=LABEL_SIZE,
    )
    for text in legend.get_texts():
        text.set_parse_math(False)
    return figure


def overview_figure(report: Report, label: str | None = None) -> Figure:
    """Return one wide picture: what was measured, what was concluded, and how far it can be trusted.

    Parameters
    ----------
    report : Report
        What to show.
    label : str, optional
        Which property result; the one with most determined pixels where not given.
    """
    observables = report.observables
    names = ["height" if "height" in observables else "A1", "A0" if "A0" in observables else "phi1", "A2"]
    top: list[xr.DataArray] = [observables[name] for name in names if name in observables]
    if report.truth is None or not report.properties:
        spare = [name for name in _measured(observables) if name not in names]
        top += [observables[name] for name in spare[: 4 - len(top)]]
    figure = _figure(14.0, 2 * (2.25 * _shape(top[0] if top else None) + 0.75), dpi=100)
    cells = figure.subplots(2, 4)
    for axes in cells.ravel():
        axes.set_axis_off()
    for axes, array in zip(cells[0], top, strict=False):
        axes.set_axis_on()
        draw_map(axes, array)
    if report.properties:
        chosen = label or max(report.properties, key=lambda key: _determined_share(report.properties[key]))
        _draw_conclusions(cells, chosen, report.properties[chosen], report.truth)
    else:
        _draw_energies(cells[1], report.energies)
    return figure


def _draw_conclusions(
    cells: npt.NDArray[np.object_], label: str, properties: xr.Dataset, truth: xr.Dataset | None
) -> None:
    veil, estimate = _undetermined(properties), _estimate(properties, "modulus")
    limits = None if estimate is None else _modulus_limits(_readable(estimate.values, veil.values))
    if truth is not None and "modulus" in truth:
        # One scale for truth and estimate, so that colours compare.
        limits = _modulus_limits(truth["modulus"].values) or limits
        cells[0, 3].set_axis_on()
        draw_map(cells[0, 3], truth["modulus"], title="modulus, truth", limits=limits)
    if estimate is not None:
        cells[1, 0].set_axis_on()
        draw_map(cells[1, 0], estimate, title=f"modulus, {label}", undetermined=veil, limits=limits)
    if {"modulus_lower", "modulus_upper"} <= set(properties):
        cells[1, 1].set_axis_on()
        draw_map(cells[1, 1], _range_width(properties), title="width of the 90 % range")
    cells[1, 2].set_axis_on()
    draw_flags(cells[1, 2], properties["status"], title="status", legend_axes=cells[1, 3])


def _draw_energies(cells: npt.NDArray[np.object_], energies: xr.Dataset) -> None:
    for axes, name in zip(cells, ("dissipation", "virial"), strict=False):
        if name in energies:
            axes.set_axis_on()
            draw_map(axes, energies[name])
    if "regime" in energies:
        cells[2].set_axis_on()
        draw_flags(cells[2], energies["regime"], legend_axes=cells[3])


def png_bytes(figure: Figure) -> bytes:
    """Return the figure as a PNG at its own resolution, in 256 colours: maps of noise pack badly in more."""
    drawn, packed = io.BytesIO(), io.BytesIO()
    engine = figure.get_layout_engine()
    if engine is not None:
        # Laid out once and for all: saving would otherwise draw everything a second time to do it again.
        engine.execute(figure)
        figure.set_layout_engine("none")
    figure.savefig(drawn, format="png", metadata={"Software": None})
    with Image.open(drawn) as picture:
        palette = picture.convert("RGB").quantize(
            256, Image.Quantize.MAXCOVERAGE, kmeans=2, dither=Image.Dither.NONE
        )
        palette.save(packed, "PNG", optimize=True, dpi=(figure.dpi, figure.dpi))
    return packed.getvalue()


# ------------------------------------------------------------------------------------------------ parts of them


def _figure(width: float, height: float, dpi: int = DPI) -> Figure:
    figure = Figure(figsize=(width, height), dpi=dpi, layout="compressed", facecolor="white")
    engine = figure.get_layout_engine()
    if isinstance(engine, ConstrainedLayoutEngine):
        engine.set(w_pad=0.07, h_pad=0.07)
    FigureCanvasAgg(figure)
    return figure


def _grid(arrays: Sequence[xr.DataArray], count: int, below: float = 0.0) -> tuple[Figure, list[Axes]]:
    """Return a figure with ``count`` cells, at most three a row, that have the shape of the first array.

    Below is the room for a legend under a row, in inches.
    """
    if count == 0:
        figure = _figure(3.4, 2.4)
        _draw_empty(figure.subplots())
        return figure, []
    columns = min(count, 3)
    rows = math.ceil(count / columns)
    figure = _figure(3.4 * columns, rows * (2.1 * _shape(arrays[0]) + 0.75 + below))
    cells = list(figure.subplots(rows, columns, squeeze=False).ravel())
    for spare in cells[count:]:
        spare.set_axis_off()
    return figure, cells[:count]


def _shape(array: xr.DataArray | None) -> float:
    """Return height over width of a map as it will be drawn, within what fits a page."""
    if array is None:
        return 1.0
    plane, _ = _plane(array)
    if plane.ndim < 2:
        return 0.8
    frame = _frame(plane)
    left, right, bottom, top = frame.extent
    return min(max(abs((top - bottom) / (right - left)), 0.3), 1.6) if frame.equal else 0.8


def _measured(observables: xr.Dataset) -> list[str]:
    names = ["height"]
    for n in harmonic_orders(observables):
        names += ["A0"] if n == 0 else [f"A{n}", f"phi{n}"]
    return [name for name in names if name in observables]


def _undetermined(properties: xr.Dataset) -> xr.DataArray:
    """Return True where the status is not the flag "determined"."""
    status = properties["status"]
    sure = [flag for flag, meaning in flags(status).items() if meaning == "determined"]
    return ~status.isin(sure)


def _determined_share(properties: xr.Dataset) -> float:
    return flag_shares(properties["status"]).get("determined", 0.0)


def _modulus_limits(values: _Array) -> _Limits | None:
    """Return limits of positive values, None where there are none."""
    return _robust_limits(values, positive=True) if (values > 0.0).any() else None


def _shared_limits(properties: xr.Dataset, veil: xr.DataArray) -> _Limits | None:
    """Return limits for the modulus and both ends of its range, as wide as the determined pixels need."""
    modulus = _estimate(properties, "modulus")
    if modulus is None:
        return None
    mask = veil.values
    if not _is_readable(modulus.values, mask):
        return _modulus_limits(modulus.values)
    bounds = [properties[name] for name in ("modulus_lower", "modulus_upper") if name in properties]
    sure = [array.transpose(*veil.dims).values[~mask] for array in (modulus, *bounds)]
    return _modulus_limits(np.concatenate(sure))


def _range_width(properties: xr.Dataset) -> xr.DataArray:
    ratio = properties["modulus_upper"] / properties["modulus_lower"]
    return xr.DataArray(np.log10(ratio), name="range_width", attrs={"units": "decades"})


def _estimate(properties: xr.Dataset, name: str) -> xr.DataArray | None:
    """Return what the estimator gave at every pixel, or None where the result lacks it."""
    for candidate in (f"{name}_unscreened", name):
        if candidate in properties:
            return properties[candidate].transpose(*properties["status"].dims)
    return None


@dataclass(frozen=True)
class _Group:
    """Pixels that a histogram shows in one colour."""

    label: str
    colour: str
    mask: npt.NDArray[np.bool_]


def _groups(
    truth: xr.Dataset | None, materials: Sequence[str], dims: tuple[Hashable, ...], count: int
) -> list[_Group]:
    if truth is None or "material" not in truth:
        return [_Group("", _MATERIAL_COLOURS[0], np.ones(count, bool))]
    index = truth["material"].transpose(*dims).values.ravel()
    groups = []
    for order, material in enumerate(np.unique(index)):
        known = 0 <= material < len(materials)
        # A legend drops names that begin with an underscore.
        label = f"material {materials[int(material)]}" if known else f"material {material}"
        colour = _MATERIAL_COLOURS[order % len(_MATERIAL_COLOURS)]
        groups.append(_Group(label, colour, index == material))
    return groups


def _draw_histogram(
    axes: Axes,
    array: xr.DataArray,
    determined: npt.NDArray[np.bool_],
    groups: Sequence[_Group],
    true: _Array | None,
    title: str,
) -> None:
    """Count pixels in logarithmic bins, the determined ones filled; counts are logarithmic too, to show few."""
    _set_title(axes, title)
    values = np.asarray(array.values, dtype=float).ravel()
    usable = np.isfinite(values) & (values > 0.0)
    if not usable.any():
        _draw_empty(axes)
        return
    record = quantity(str(array.name))
    medians = [_positive_median(true[group.mask]) if true is not None else None for group in groups]
    low, high = _reach([values[usable], np.array([m for m in medians if m is not None])])
    unit = display_unit(float(np.median(values[usable])), record.unit if record else "1")
    edges = np.geomspace(low, high, 61)
    for group, median in zip(groups, medians, strict=True):
        for chosen, filled in (
            (usable & group.mask & ~determined, False),
            (usable & group.mask & determined, True),
        ):
            # Values at either end must not fall out by rounding.
            counts, _ = np.histogram(np.clip(values[chosen], low, high), edges)
            if filled:
                axes.stairs(counts, edges * unit.factor, fill=True, color=group.colour, alpha=0.55)
            else:
                axes.stairs(counts, edges * unit.factor, color=group.colour, linewidth=1.2)
        if median is not None:
            axes.axvline(median * unit.factor, color=group.colour, linestyle="--", linewidth=1.6)
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.set_ylim(0.6, None)
    axes.set_xlim(low * unit.factor, high * unit.factor)
    few = high < 30.0 * low
    axes.xaxis.set_major_locator(LogLocator(10.0, subs=(1.0, 2.0, 5.0) if few else (1.0,), numticks=9))
    axes.xaxis.set_major_formatter(_log_formatter(low * unit.factor, high * unit.factor))
    axes.xaxis.set_minor_locator(NullLocator())
    axes.set_xlabel(_label(array, unit.label), fontsize=LABEL_SIZE)
    axes.set_ylabel("pixels", fontsize=LABEL_SIZE)
    axes.tick_params(labelsize=TICK_SIZE)


def _positive_median(values: _Array) -> float | None:
    finite = values[np.isfinite(values)]
    median = float(np.median(finite)) if finite.size else 0.0
    return median if median > 0.0 else None


def _reach(parts: Sequence[_Array]) -> _Limits:
    """Return the extremes, at least a third of a decade apart, so that ticks and bins have room."""
    values = np.concatenate(parts)
    low, high = float(values.min()), float(values.max())
    if high < 2.0 * low:
        middle = math.sqrt(low) * math.sqrt(high)
        low, high = middle / 1.6, middle * 1.6
    return low / 1.05, high * 1.05
