"""Sheets of cells, laid out once from the room that the texts around their images take."""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis, XAxis, YAxis
from matplotlib.backend_bases import RendererBase
from matplotlib.backends.backend_agg import RendererAgg
from matplotlib.figure import Figure
from matplotlib.legend import Legend
from matplotlib.transforms import Bbox, ScaledTranslation

from overtone.plots.canvas import TEXTS, new_figure
from overtone.plots.text import HEADING_SIZE, POINTS_PER_INCH, TITLE_PAD, TITLE_SIZE, height_of, wrapped

_EDGE = 0.08
_GAP = 0.13
_HANGING = 0.45
_SHARE_OF_IMAGE = 0.68
_SMALLEST_IMAGE = 0.3


@dataclass(frozen=True)
class Sheet:
    """A figure with cells, row by row, whose images have one height over width.

    The width of the figure is given; its height follows when it is laid out. The layouts of matplotlib measure
    every text several times, which takes longer than to draw the figure.
    """

    figure: Figure
    cells: list[Axes]
    columns: int
    ratio: float

    @classmethod
    def new(cls, count: int, columns: int, column_width: float, ratio: float) -> Sheet:
        """Return a sheet of empty cells.

        Until it is laid out, every cell has about the size it will have, so that titles and ticks fit.

        Parameters
        ----------
        count : int
            How many cells.
        columns : int
            How many of them in a row, where there are so many.
        column_width : float
            Width of a column with its labels in inches.
        ratio : float
            Height over width of the images.
        """
        columns = min(count, columns)
        figure = new_figure(column_width * columns, column_width * _SHARE_OF_IMAGE * ratio)
        width = _SHARE_OF_IMAGE / columns
        cells = [figure.add_axes((k % columns / columns, 0.0, width, 1.0)) for k in range(count)]
        return cls(figure, cells, columns, ratio)

    def lay_out(self, heading: str = "", legend: Legend | None = None) -> Figure:
        """Give every cell its place, and return the figure.

        Parameters
        ----------
        heading : str, optional
            Text above all cells; wrapped, and taken as it is.
        legend : Legend, optional
            One of the figure, to be put below all cells.
        """
        self._omit_repeated_labels()
        renderer = _measuring_renderer(float(self.figure.dpi))
        with TEXTS:
            rooms = [_room(cell, renderer) for cell in self.cells]
            legend_height = legend.get_window_extent(renderer).height if legend is not None else 0.0
        width = float(self.figure.get_figwidth())
        columns = [_Column.around(rooms[j :: self.columns]) for j in range(self.columns)]
        labels = sum(column.left + column.right for column in columns)
        image = (width - 2 * _EDGE - _GAP * (self.columns - 1) - labels) / self.columns
        image = max(image, _SMALLEST_IMAGE * width / self.columns)

        text = wrapped(heading, width - 2 * _EDGE, HEADING_SIZE)
        y = _EDGE + (height_of(text, HEADING_SIZE) + _GAP if text else 0.0)
        places = []
        for first in range(0, len(rooms), self.columns):
            row = rooms[first : first + self.columns]
            y += max(room.top for room in row)
            bottoms = [room.bottom for k, room in enumerate(row, first) if not self._hangs_free(k)]
            bottom = max(bottoms, default=0.0)
            height = max(self.ratio * image, *(room.legend + _HANGING - bottom for room in row))
            x = _EDGE
            for room, column in zip(row, columns, strict=False):
                whole = column.left + image + column.right
                if room.bare:  # may use the room of the labels it has not, but those of the cell above
                    places.append((x, y + _HANGING, whole, height + bottom - _HANGING))
                else:
                    places.append((x + column.left, y, image, height))
                x += whole + _GAP
            y += height + bottom + _GAP
        if legend is not None:
            y += legend_height / self.figure.dpi + _GAP
        total = math.ceil((y - _GAP + _EDGE) * self.figure.dpi) / self.figure.dpi
        self.figure.set_size_inches(width, total)
        for cell, (x, y, wide, high) in zip(self.cells, places, strict=True):
            cell.set_position((x / width, 1.0 - (y + high) / total, wide / width, high / total))
        if text:
            self.figure.suptitle(
                text, y=1.0 - _EDGE / total, va="top", fontsize=HEADING_SIZE, parse_math=False
            )
        if legend is not None:
            legend.set_bbox_to_anchor((0.5, _EDGE / total), self.figure.transFigure)
        return self.figure

    def _omit_repeated_labels(self) -> None:
        """Leave out tick labels and names of axes that the cell to the left or the cell below has too."""
        for k, cell in enumerate(self.cells):
            if k % self.columns and _reads_alike(cell.yaxis, self.cells[k - 1].yaxis):
                _hide_labels(cell.yaxis)
            below = self._below(k)
            if below is not None and _reads_alike(cell.xaxis, below.xaxis):
                _hide_labels(cell.xaxis)

    def _hangs_free(self, k: int) -> bool:
        """Return whether the labels below a cell may hang into the next row, where no axes are."""
        below = self._below(k)
        is_last_row = k // self.columns == (len(self.cells) - 1) // self.columns
        return not is_last_row and (below is None or not below.axison)

    def _below(self, k: int) -> Axes | None:
        return self.cells[k + self.columns] if k + self.columns < len(self.cells) else None


@dataclass(frozen=True)
class _Room:
    """What the texts around the image of a cell take, or the legend that it has instead of one, in inches."""

    left: float = 0.0
    right: float = 0.0
    bottom: float = 0.0
    top: float = 0.0
    legend: float = 0.0
    bare: bool = False


@dataclass(frozen=True)
class _Column:
    """The room that texts to the left and the right of the images of a column take."""

    left: float
    right: float

    @classmethod
    def around(cls, rooms: list[_Room]) -> _Column:
        return cls(max(room.left for room in rooms), max(room.right for room in rooms))


@functools.cache
def _measuring_renderer(dpi: float) -> RendererAgg:
    """Return what texts are measured with: one for all figures, for it remembers what it measured."""
    return RendererAgg(1, 1, dpi)  # type: ignore[no-untyped-call]


def _room(cell: Axes, renderer: RendererBase) -> _Room:
    dpi = cell.figure.dpi
    legend = cell.get_legend()
    if not cell.axison:
        high = float(legend.get_window_extent(renderer).height) / dpi if legend else 0.0
        return _Room(legend=high, bare=True)
    cell.apply_aspect()
    texts = [_measured(cell.xaxis, renderer), _measured(cell.yaxis, renderer)]
    for inset in cell.child_axes:
        locator = inset.get_axes_locator()
        inset.apply_aspect(None if locator is None else locator(inset, renderer))
        texts.append(_measured(inset.yaxis, renderer))
    if legend is not None:
        texts.append(legend.get_window_extent(renderer))
    box = Bbox.union([cell.bbox, *(text for text in texts if text is not None)])
    title = cell.get_title(loc="left")
    return _Room(
        (cell.bbox.x0 - box.x0) / dpi,
        (box.x1 - cell.bbox.x1) / dpi,
        (cell.bbox.y0 - box.y0) / dpi,
        height_of(title, TITLE_SIZE) + TITLE_PAD / POINTS_PER_INCH if title else 0.0,
    )


def _measured(axis: XAxis | YAxis, renderer: RendererBase) -> Bbox | None:
    """Return the box around the texts of an axis, and pin its label where it is.

    The label would otherwise be moved clear of the ticks, which are measured for that, whenever it is drawn.
    """
    box = axis.get_tightbbox(renderer)
    frame, inches = axis.axes.bbox, axis.axes.figure.dpi_scale_trans
    x, y = (float(value) for value in axis.label.get_position())
    if isinstance(axis, XAxis):
        shift = ScaledTranslation(0.0, (y - frame.y0) / axis.axes.figure.dpi, inches)
        axis.set_label_coords(x, 0.0, axis.axes.transAxes + shift)
    else:
        is_right = x > frame.x0
        edge = frame.x1 if is_right else frame.x0
        shift = ScaledTranslation((x - edge) / axis.axes.figure.dpi, 0.0, inches)
        axis.set_label_coords(float(is_right), y, axis.axes.transAxes + shift)
    return box


def _reads_alike(one: Axis, other: Axis) -> bool:
    text = one.get_label_text()
    return (
        bool(text)
        and text == other.get_label_text()
        and one.axes.axison
        and other.axes.axison
        and one.get_scale() == other.get_scale()
        and np.array_equal(one.get_view_interval(), other.get_view_interval())
    )


def _hide_labels(axis: Axis) -> None:
    axis.set_tick_params(labelleft=False, labelbottom=False)
    axis.label.set_visible(False)
