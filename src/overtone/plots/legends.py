"""A legend below all cells of a sheet, in as many columns as the figure is wide for."""

from __future__ import annotations

from collections.abc import Sequence

from matplotlib.figure import Figure
from matplotlib.legend import Legend
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from overtone.plots.text import LABEL_SIZE, POINTS_PER_INCH

_LETTER = 0.55  # width of a mean letter, in font sizes
_HANDLE, _GAP = 2.8, 2.0  # of a handle with its space, and between columns


def legend_below(figure: Figure, handles: Sequence[Line2D | Patch], most: int = 5) -> Legend:
    """Return a legend for `Sheet.lay_out`, with no more columns than fit beside each other.

    Parameters
    ----------
    figure : Figure
        Of the width it will have.
    handles : sequence of Line2D or Patch
        With labels.
    most : int
        Columns at most.
    """
    room = figure.get_figwidth() * POINTS_PER_INCH / LABEL_SIZE
    lengths = [_HANDLE + _LETTER * len(str(handle.get_label())) for handle in handles]
    columns = min(len(handles), most)
    while columns > 1 and _width(lengths, columns) > room:
        columns -= 1
    return figure.legend(
        handles=list(handles),
        loc="lower center",
        ncols=max(columns, 1),
        frameon=False,
        borderaxespad=0.0,
        fontsize=LABEL_SIZE,
    )


def _width(lengths: Sequence[float], columns: int) -> float:
    """Return how wide a legend is, in font sizes; it is filled column by column, the first ones by one more."""
    rows, longer = divmod(len(lengths), columns)
    total, first = _GAP * (columns - 1), 0
    for k in range(columns):
        last = first + rows + (k < longer)
        total += max(lengths[first:last], default=0.0)
        first = last
    return total
