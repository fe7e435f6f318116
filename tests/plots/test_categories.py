import numpy as np

from overtone import plots
from overtone.plots.canvas import new_figure
from overtone.quantities import named_array


def test_categories_have_a_legend_with_shares(a_map, status_flags):
    figure = new_figure(4.0, 3.5)
    axes = figure.subplots()
    plots.draw_flags(axes, a_map("status", [[0, 1, 1, 1], [0, 1, 1, 7]], **status_flags))
    figure.canvas.draw()
    labels = [text.get_text() for text in axes.get_legend().get_texts()]
    assert labels == ["25.0 %  determined", "62.5 %  not determined by these data"]
    assert axes.images[0].get_array().mask.sum() == 1  # an unknown flag is no category


def test_flags_along_a_curve(regime_flags):
    figure = new_figure(4.0, 3.5)
    axes = figure.subplots()
    plots.draw_flags(
        axes, named_array("regime", [-1, 0, 1, 1], ("z",), {"z": np.arange(4) * 1e-9}, **regime_flags)
    )
    figure.canvas.draw()
    assert len(axes.collections[0].get_offsets()) == 4
    assert len(axes.get_legend().get_texts()) == 3
