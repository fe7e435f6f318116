"""Every observable before and after the correction, side by side on scales of one width."""

from __future__ import annotations

import xarray as xr
from matplotlib.figure import Figure

from overtone.plots.correction import Pair, check_pixels, continuous, draw_pair
from overtone.plots.maps import draw_map
from overtone.plots.planes import plane_of, ratio_of
from overtone.plots.results import measured
from overtone.plots.sheet import Sheet
from overtone.plots.text import typeset
from overtone.quantities import quantity

_COLUMNS = 4
_COLUMN_WIDTH = 3.2
_WIDEST = 4.0


def before_after_figure(scan: xr.Dataset, corrected: xr.Dataset) -> Figure:
    """Return the maps of everything that was measured, each as read and corrected beside each other.

    Parameters
    ----------
    scan : Dataset
        Observables (y, x) as the microscope stored them.
    corrected : Dataset
        The same, out of `overtone.correct`, with ``height`` where there is one.

    Raises
    ------
    ObservablesError
        If these are no maps, or not of the same pixels.

    Notes
    -----
    Both colour scales of a signal have one unit and are equally wide, each about its own map: equal steps of colour are
    equal differences. Where a drift makes the map before more than four times as wide, each has a scale of its own, or
    nothing would be seen of what is left. Phases of higher harmonics are counted from that of the first, as the force
    sees them.
    """
    check_pixels(scan, corrected)
    pairs = _pairs(scan, corrected)
    has_height = "height" in corrected
    sheet = Sheet.new(2 * len(pairs) + has_height, _COLUMNS, _COLUMN_WIDTH, ratio_of(corrected["A1"]))
    for k, pair in enumerate(pairs):
        draw_pair(sheet.cells[2 * k], sheet.cells[2 * k + 1], pair, _WIDEST)
    if has_height:
        draw_map(sheet.cells[-1], corrected["height"], title="topography")
    return sheet.lay_out()


def _pairs(scan: xr.Dataset, corrected: xr.Dataset) -> list[Pair]:
    found = []
    for name in measured(corrected):
        if name == "height" or name not in scan:
            continue
        record = quantity(name)
        assert record is not None  # measured names are known ones
        order = int(name.removeprefix("phi")) if name.startswith("phi") else 0
        planes = [plane_of(dataset[name])[0] for dataset in (scan, corrected)]
        symbol = typeset(record.symbol)
        if order > 1:
            firsts = [plane_of(dataset["phi1"])[0] for dataset in (scan, corrected)]
            planes = [plane - order * first for plane, first in zip(planes, firsts, strict=True)]
            symbol = rf"$\phi_{order} - {order}\phi_1$"
        if order:
            planes = [continuous(plane) for plane in planes]
        found.append(Pair(_title(name), symbol, record.unit, *planes))
    return found


def _title(name: str) -> str:
    """Return a title that leaves room for "as read" behind it."""
    if name == "A0":
        return "mean deflection"
    kind, word = ("phi", "phase") if name.startswith("phi") else ("A", "amplitude")
    return f"{word} {name.removeprefix(kind)}"
