import itertools

import numpy as np
import pytest
import xarray as xr
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.text import Text

from overtone import plots
from overtone.quantities import named_array
from overtone.report.content import Report


def boxes(figure: Figure) -> dict[Text, tuple[float, float, float, float]]:
    """Where every text that is seen lies, in pixels."""
    figure.canvas.draw()
    seen = {}
    axes = [cell for parent in figure.axes for cell in (parent, *parent.child_axes) if parent.axison]
    texts = [text for cell in axes for text in (cell.xaxis.label, cell.yaxis.label, *cell.texts)]
    texts += [
        text for cell in axes for text in cell.findobj(Text) if text.get_text() == cell.get_title("left")
    ]
    for axis in (axis for cell in axes for axis in (cell.xaxis, cell.yaxis)):
        texts += [label for label in axis.get_ticklabels() if label.get_visible()]
    legends = [*figure.legends, *(cell.get_legend() for cell in figure.axes if cell.get_legend())]
    texts += [text for legend in legends for text in legend.get_texts()]
    for text in texts:
        if text.get_text() and text.get_visible():
            seen[text] = tuple(text.get_window_extent().padded(-1.0).extents)
    return seen


def shown(axis: Axis) -> bool:
    return axis.label.get_visible() and any(label.get_visible() for label in axis.get_ticklabels())


@pytest.mark.parametrize("shape", [(30, 200), (200, 30), (1, 1)])
def test_texts_keep_clear_of_each_other_and_of_the_edge(shape, a_map, status_flags):
    rng = np.random.default_rng(0)
    stiff = np.exp(rng.normal(20.0, 2.0, shape))
    names = ("modulus", "adhesion", "indentation", "modulus_lower", "amplification", "residual")
    result = xr.Dataset({name: a_map(name, stiff / stiff.max() ** (i / 2)) for i, name in enumerate(names)})
    result["status"] = a_map("status", rng.integers(0, 2, shape).astype(np.int8), **status_flags)
    figure = plots.properties_figure("a label of many words, " * 12, result)
    seen = boxes(figure)
    assert len(seen) > 20
    width, height = figure.bbox.size
    for text, (left, bottom, right, top) in seen.items():
        assert left > 0.0 and bottom > 0.0 and right < width and top < height, text  # noqa: PT018
    for one, other in itertools.combinations(seen, 2):
        a, b = seen[one], seen[other]
        apart = a[2] <= b[0] or b[2] <= a[0] or a[3] <= b[1] or b[3] <= a[1]
        assert apart, (one, other)


def test_a_neighbour_names_the_axes_that_all_share(observables):
    cells = plots.observables_figure(observables).axes[:6]
    assert [shown(cell.yaxis) for cell in cells] == [True, False, False, True, False, False]
    assert [shown(cell.xaxis) for cell in cells] == [False, False, False, True, True, True]


def test_axes_that_differ_keep_their_labels(observables, energies, properties, truth):
    elsewhere = observables.assign_coords(x=observables["x"] + 1e-6)
    report = Report("t", "s", elsewhere, energies, {"a": properties}, truth, ("a", "b"))
    cells = plots.overview_figure(report).axes[:8]
    assert [shown(cell.xaxis) for cell in cells[:3]] == [True, True, True]
    assert [shown(cell.yaxis) for cell in cells[:3]] == [True, False, False]


def test_a_curve_has_its_own_ordinate():
    z = {"z": ("z", np.arange(30) * 1e-9, {"units": "m"})}
    rng = np.random.default_rng(0)
    curves = {name: named_array(name, rng.normal(1e-9, 1e-11, 30), ("z",), z) for name in ("A0", "A1", "A2")}
    cells = plots.observables_figure(xr.Dataset(curves)).axes[:3]
    assert all(shown(cell.yaxis) for cell in cells)
