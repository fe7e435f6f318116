"""How the properties of one inversion are distributed, material by material."""

from __future__ import annotations

import math
from collections.abc import Hashable, Sequence
from dataclasses import dataclass

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from overtone.plots.categories import PALETTE
from overtone.plots.scales import Array, Limits, Mask
from overtone.plots.sheet import Sheet
from overtone.plots.text import LABEL_SIZE, TICK_SIZE, draw_empty, label_of, set_title
from overtone.plots.ticks import Ticks, log_ticks, power_labels
from overtone.quantities import quantity
from overtone.report.results import (
    LEAST_SQUARES,
    PROPERTIES,
    estimate_of,
    interval_of,
    method_of,
    properties_in,
    undetermined,
)
from overtone.units import display_unit

_QUALITIES = {"residual": "residual", "misfit": "misfit"}
_COLUMNS = 2
_COLUMN_WIDTH = 5.0
_RATIO = 0.5


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
    dims = properties["status"].dims
    determined = ~undetermined(properties).values.ravel()
    groups = _groups(truth, materials, dims, determined.size)
    panels = {name: PROPERTIES[name] for name in properties_in(properties)} | _QUALITIES
    found = {name: estimate_of(properties, name) for name in panels}
    shown = {name: estimate for name, estimate in found.items() if estimate is not None}
    count = _COLUMNS * math.ceil(max(len(shown), 1) / _COLUMNS)
    sheet = Sheet.new(count, _COLUMNS, _COLUMN_WIDTH, _RATIO)
    for spare in sheet.cells[len(shown) :]:
        spare.set_axis_off()
    for axes, (name, estimate) in zip(sheet.cells, shown.items(), strict=False):
        true = truth[name].transpose(*dims).values.ravel() if truth is not None and name in truth else None
        typical = _typical(properties, name, determined, groups)
        _draw_histogram(axes, estimate, determined, groups, true, panels[name], typical)
    handles: list[Patch | Line2D] = [Patch(facecolor=g.colour, label=g.label) for g in groups if g.label]
    handles += [
        Patch(facecolor="0.5", label="determined"),
        Patch(facecolor="none", edgecolor="0.3", label="not determined"),
    ]
    if any(_typical(properties, name, determined, groups) for name in shown):
        handles.append(
            Line2D([], [], color="0.2", marker="|", markersize=7.0, label="typical 90 % interval of a pixel")
        )
    if truth is not None:
        handles.append(Line2D([], [], color="0.2", linestyle="--", label="true median"))
    legend = sheet.figure.legend(
        handles=handles,
        loc="lower center",
        ncols=len(handles) if len(handles) < 6 else 3,
        frameon=False,
        borderaxespad=0.0,
        fontsize=LABEL_SIZE,
    )
    for text in legend.get_texts():
        text.set_parse_math(False)
    return sheet.lay_out(label, legend)


@dataclass(frozen=True)
class _Group:
    """Pixels that a histogram shows in one colour."""

    label: str
    colour: str
    mask: Mask


def _groups(
    truth: xr.Dataset | None, materials: Sequence[str], dims: tuple[Hashable, ...], count: int
) -> list[_Group]:
    if truth is None or "material" not in truth:
        return [_Group("", PALETTE[0], np.ones(count, bool))]
    index = truth["material"].transpose(*dims).values.ravel()
    groups = []
    for order, material in enumerate(np.unique(index)):
        known = 0 <= material < len(materials)
        # A legend drops names that begin with an underscore.
        label = f"material {materials[int(material)]}" if known else f"material {material}"
        groups.append(_Group(label, PALETTE[order % len(PALETTE)], index == material))
    return groups


def _typical(
    properties: xr.Dataset, name: str, determined: Mask, groups: Sequence[_Group]
) -> list[Limits | None]:
    """Return the medians of both ends over the determined pixels of each group, nothing without intervals."""
    interval = interval_of(properties, name)
    if interval is None or method_of(properties) == LEAST_SQUARES:
        return []  # a range of moduli alone is drawn with the maps
    ends = [np.asarray(end.values, dtype=float).ravel() for end in interval]
    found: list[Limits | None] = []
    for group in groups:
        low, high = (_positive_median(end[determined & group.mask]) for end in ends)
        found.append((low, high) if low is not None and high is not None else None)
    return found


def _draw_histogram(
    axes: Axes,
    array: xr.DataArray,
    determined: Mask,
    groups: Sequence[_Group],
    true: Array | None,
    title: str,
    typical: Sequence[Limits | None],
) -> None:
    """Count pixels in logarithmic bins, the determined ones filled; counts are logarithmic too, to show few."""
    set_title(axes, title)
    values = np.asarray(array.values, dtype=float).ravel()
    usable = np.isfinite(values) & (values > 0.0)
    if not usable.any():
        draw_empty(axes)
        return
    record = quantity(str(array.name))
    medians = [_positive_median(true[group.mask]) if true is not None else None for group in groups]
    ends = [end for pair in typical if pair is not None for end in pair]
    low, high = _reach([values[usable], np.array([*(m for m in medians if m is not None), *ends])])
    unit = display_unit(float(np.median(values[usable])), record.unit if record else "1")
    edges = np.geomspace(low, high, 61)
    most = 1
    for group, median in zip(groups, medians, strict=True):
        for chosen, filled in (
            (usable & group.mask & ~determined, False),
            (usable & group.mask & determined, True),
        ):
            # Values at either end must not fall out by rounding.
            counts, _ = np.histogram(np.clip(values[chosen], low, high), edges)
            most = max(most, int(counts.max()))
            if filled:
                axes.stairs(counts, edges * unit.factor, fill=True, color=group.colour, alpha=0.55)
            else:
                axes.stairs(counts, edges * unit.factor, color=group.colour, linewidth=1.2)
        if median is not None:
            axes.axvline(median * unit.factor, color=group.colour, linestyle="--", linewidth=1.6)
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.set_xlim(low * unit.factor, high * unit.factor)
    top = 1.6 * most
    for group, pair in zip(groups, typical, strict=False):
        if pair is not None:
            between = [end * unit.factor for end in pair]
            axes.plot(between, [top, top], color=group.colour, marker="|", markersize=7.0, linewidth=1.4)
            top *= 1.7
    axes.set_ylim(0.6, top)
    log_ticks(low * unit.factor, high * unit.factor, 8).put_on(axes.xaxis)
    _powers_of_ten(1.6 * most).put_on(axes.yaxis)
    axes.set_xlabel(label_of(array, unit.label), fontsize=LABEL_SIZE)
    axes.set_ylabel("pixels", fontsize=LABEL_SIZE)
    axes.tick_params(labelsize=TICK_SIZE)


def _powers_of_ten(high: float) -> Ticks:
    positions = tuple(10.0**n for n in range(math.floor(math.log10(high)) + 1))
    return Ticks(positions, power_labels(positions, 1.0, high))


def _positive_median(values: Array) -> float | None:
    finite = values[np.isfinite(values)]
    median = float(np.median(finite)) if finite.size else 0.0
    return median if median > 0.0 else None


def _reach(parts: Sequence[Array]) -> Limits:
    """Return the extremes, at least a third of a decade apart, so that ticks and bins have room."""
    values = np.concatenate(parts)
    low, high = float(values.min()), float(values.max())
    if high < 2.0 * low:
        middle = math.sqrt(low) * math.sqrt(high)
        low, high = middle / 1.6, middle * 1.6
    return low / 1.05, high * 1.05
