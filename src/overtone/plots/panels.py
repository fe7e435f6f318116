"""Figures from a list of panels, each of which takes one cell of a sheet, or one more for its legend."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from overtone.plots.categories import draw_flags
from overtone.plots.sheet import Sheet
from overtone.plots.text import draw_empty, draw_words, set_title

COLUMNS = 3
_COLUMN_WIDTH = 3.4


@dataclass(frozen=True)
class Panel:
    """What draws on one cell, or on two beside each other."""

    draw: Callable[..., None]
    """Called with as many axes as it takes cells."""
    cells: int = 1


def panels_figure(panels: Sequence[Panel], heading: str, ratio: float) -> Figure:
    """Return a figure of panels, three cells in a row; a panel of two cells does not go over the end of a row."""
    placed: list[tuple[Panel, int]] = []
    at = 0
    for panel in panels:
        if at % COLUMNS + panel.cells > COLUMNS:
            at += COLUMNS - at % COLUMNS
        placed.append((panel, at))
        at += panel.cells
    sheet = Sheet.new(max(at, COLUMNS), COLUMNS, _COLUMN_WIDTH, ratio)
    used = {first + k for panel, first in placed for k in range(panel.cells)}
    for k, axes in enumerate(sheet.cells):
        if k not in used:
            axes.set_axis_off()
    for panel, first in placed:
        panel.draw(*sheet.cells[first : first + panel.cells])
    if not placed:
        sheet.cells[0].set_axis_on()
        draw_empty(sheet.cells[0])
    return sheet.lay_out(heading)


def flags_panel(array: xr.DataArray, title: str) -> Panel:
    """Return the panel of a categorical map, with its legend in a cell of its own."""

    def draw(axes: Axes, legend_axes: Axes) -> None:
        draw_flags(axes, array, title=title, legend_axes=legend_axes)

    return Panel(draw, cells=2)


def words_panel(title: str, words: str) -> Panel:
    """Return a panel that says something where colours would say too much."""
    return Panel(partial(_draw_words, title=title, words=words))


def _draw_words(axes: Axes, title: str, words: str) -> None:
    set_title(axes, title)
    draw_words(axes, words)
