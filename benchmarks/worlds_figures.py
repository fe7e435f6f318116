"""Figures of the page on simulated worlds."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from overtone.plots.canvas import new_figure
from overtone.plots.categories import PALETTE
from overtone.plots.text import LABEL_SIZE, TICK_SIZE, TITLE_SIZE
from worlds_limit import PROPERTIES
from worlds_numbers import (
    ANY,
    GROUPS,
    MATERIALS,
    NINETY,
    Number,
    Rows,
    by_depth,
    ends_of,
    flags_of,
    of_materials,
    off_by,
    one_a_world,
    resolved,
    under_best_conditions,
)
from worlds_scores import CHECKED, NULLS, WRONG

Found = Mapping[tuple[str, ...], Number]

COLOURS = dict(zip(PROPERTIES, (PALETTE[0], PALETTE[5], PALETTE[3]), strict=True))
MARKS = dict(zip(PROPERTIES, "osv", strict=True))
OF_MATERIAL = dict(zip(MATERIALS, (PALETTE[0], PALETTE[5], PALETTE[2]), strict=True))
FEWEST = 8


def _figure(width: float, height: float) -> Figure:
    figure = new_figure(width, height)
    figure.set_dpi(150)
    return figure


def _dress(axes: Axes, x: str, y: str, title: str) -> None:
    axes.set_xlabel(x, fontsize=LABEL_SIZE)
    axes.set_ylabel(y, fontsize=LABEL_SIZE)
    axes.set_title(title, fontsize=TITLE_SIZE, loc="left")
    axes.tick_params(labelsize=TICK_SIZE)
    axes.grid(color="0.9", linewidth=0.6)
    axes.set_axisbelow(True)


def figures_of(rows: Rows, found: Found) -> dict[str, Figure]:
    """Return all figures by name."""
    return {
        "coverage": coverage(found),
        "width": width(rows),
        "wrong": wrong(rows),
        "null": null(rows),
        "least-squares": least_squares(rows),
        "prediction": prediction(found),
    }


def coverage(found: Found) -> Figure:
    """Return what narrow intervals of materials hold, by noise, calibration, reference and material."""
    figure = _figure(10.0, 3.8)
    axes = figure.subplots()
    axes.axhspan(85.0, 95.0, color="0.93", zorder=0)
    axes.axhline(90.0, color="0.5", linewidth=0.9)
    for k, name in enumerate(PROPERTIES):
        for place, over in enumerate(GROUPS):
            number = found["coverage", name, over, "narrow"]
            if number.answers < FEWEST:
                continue
            value = number.value
            error = math.sqrt(max(value * (1.0 - value), 0.09 / number.answers) / number.answers)
            axes.errorbar(
                place + 0.18 * (k - 1),
                100.0 * value,
                100.0 * error,
                fmt=MARKS[name],
                color=COLOURS[name],
                markersize=4.5,
                linewidth=1.0,
                label=name.replace("_", " ") if place == 0 else None,
            )
    axes.set_xticks(range(len(GROUPS)), [over.replace(" ", "\n", 1) for over in GROUPS])
    axes.legend(fontsize=TICK_SIZE, frameon=False, loc="lower left", ncols=3)
    _dress(axes, "", "truths in 90 % intervals [%]", "Medians of materials, narrow intervals")
    figure.tight_layout()
    return figure


def width(rows: Rows) -> Figure:
    """Return widths of the intervals of ln E against the information limit."""
    figure = _figure(9.0, 4.2)
    some = resolved(of_materials(rows))
    for axes, reference in zip(figure.subplots(1, 2, sharex=True, sharey=True), (0, 1), strict=True):
        for material, colour in OF_MATERIAL.items():
            mine = some.equal(reference=reference, material=material)
            axes.plot(
                NINETY * mine.value("modulus_limit"),
                ends_of(mine, "modulus").log_width,
                "o",
                color=colour,
                markersize=3.5,
                alpha=0.7,
                label=material,
            )
        line = np.array([0.03, 12.0])
        axes.plot(line, line, color="#000000", linewidth=0.8)
        axes.plot(line, 1.5 * line, color="#000000", linewidth=0.8, linestyle=":")
        axes.set(xscale="log", yscale="log")
        axes.legend(fontsize=TICK_SIZE, frameon=False, loc="upper left")
        title = f"{'With' if reference else 'Without'} reference"
        _dress(axes, "90 % width of ln E at the limit", "width of the interval of ln E", title)
    figure.tight_layout()
    return figure


def wrong(rows: Rows) -> Figure:
    """Return how far wrong models move ln E, and what warns of it."""
    kinds = ("three", *WRONG)
    figure = _figure(9.0, 4.2)
    generator = np.random.default_rng(0)
    for axes, reference in zip(figure.subplots(1, 2, sharey=True), (0, 1), strict=True):
        axes.axhspan(-0.5, 0.5, color="0.93", zorder=0)
        for place, kind in enumerate(kinds):
            for k, (material, colour) in enumerate(OF_MATERIAL.items()):
                mine = under_best_conditions(rows, kind).equal(reference=reference, material=material)
                if not len(mine):
                    continue
                off, warned = off_by(mine), flags_of(mine)[ANY]
                x = place + 0.25 * (k - 1) + generator.uniform(-0.06, 0.06, off.size)
                for which, face in ((warned, colour), (~warned, "none")):
                    axes.plot(
                        x[which],
                        off[which],
                        "o",
                        color=colour,
                        markerfacecolor=face,
                        markersize=3.5,
                    )
        axes.set_yscale("symlog", linthresh=1.0)
        ticks = (-10, -3, -1, -0.5, 0, 0.5, 1, 3, 10)
        axes.set_yticks(ticks, [f"{tick:g}" for tick in ticks])
        axes.set_xticks(range(len(kinds)), kinds)
        handles = [
            Line2D([], [], color=colour, marker="o", linestyle="", markersize=4, label=material)
            for material, colour in OF_MATERIAL.items()
        ]
        axes.legend(handles=handles, fontsize=TICK_SIZE, frameon=False, loc="upper left")
        title = f"{'With' if reference else 'Without'} reference (filled: something warns)"
        _dress(axes, "", "ln E off the truth / width of its interval", title)
    figure.tight_layout()
    return figure


def null(rows: Rows) -> Figure:
    """Return how many phases were found where there is one material, or none."""
    figure = _figure(7.0, 3.2)
    for axes, kind in zip(figure.subplots(1, 2, sharey=True), NULLS, strict=True):
        some = one_a_world(rows.kind(kind))
        for name, column, colour, shift in (
            ("found", "phases", PALETTE[0], -0.2),
            ("resolved", "resolved_phases", PALETTE[5], 0.2),
        ):
            counts = (
                np.bincount(some.value(column).astype(int), minlength=5)[:5] if len(some) else np.zeros(5)
            )
            axes.bar(np.arange(5) + shift, 100.0 * counts / max(len(some), 1), 0.38, color=colour, label=name)
        axes.set_xticks(range(5))
        axes.legend(fontsize=TICK_SIZE, frameon=False)
        _dress(axes, "phases", "worlds [%]", kind)
    figure.tight_layout()
    return figure


def least_squares(rows: Rows) -> Figure:
    """Return errors of the published estimator against those of pooled pixels and of materials."""
    figure = _figure(9.0, 4.2)
    for axes, (column, title) in zip(
        figure.subplots(1, 2, sharex=True, sharey=True),
        (("error_pixel", "pooled pixels"), ("error_material", "median of the material")),
        strict=True,
    ):
        for depth, some in by_depth(rows).items():
            for material, colour in OF_MATERIAL.items():
                mine = some.equal(material=material)
                face = colour if depth == "deep" else "none"
                axes.plot(
                    mine.value("error_fit"),
                    np.maximum(mine.value(column), 1e-3),
                    "o",
                    color=colour,
                    markerfacecolor=face,
                    markersize=4,
                    label=f"{material}, {depth}" if len(mine) else None,
                )
        line = np.array([1e-3, 10.0])
        axes.plot(line, line, color="#000000", linewidth=0.8)
        axes.set(xscale="log", yscale="log")
        axes.legend(fontsize=TICK_SIZE, frameon=False, loc="upper left")
        _dress(axes, "least-squares: median |ln E/E true|", "population: |ln E/E true|", title)
    figure.tight_layout()
    return figure


def prediction(found: Found) -> Figure:
    """Return how many harmonics lie where the others predict them."""
    kinds = ("three", *WRONG)
    figure = _figure(8.0, 3.4)
    axes = figure.subplots()
    axes.axhline(90.0, color="0.5", linewidth=0.9)
    for k, kind in enumerate(kinds):
        values = [found["prediction", name, f"{kind}, all", "inside"].value for name in CHECKED]
        axes.bar(
            np.arange(len(CHECKED)) + 0.2 * (k - 1.5),
            100.0 * np.nan_to_num(values),
            0.18,
            color=PALETTE[k],
            label=kind,
        )
    axes.set_xticks(range(len(CHECKED)), CHECKED)
    axes.set_ylim(0.0, 105.0)
    axes.legend(fontsize=TICK_SIZE, frameon=True, ncols=4, loc="lower left")
    _dress(axes, "", "inside of the predicted 90 % interval [%]", "Each harmonic, predicted from the others")
    figure.tight_layout()
    return figure
