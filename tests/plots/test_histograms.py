import numpy as np

from overtone import plots


def test_histograms_count_every_pixel_and_show_true_medians(properties, truth):
    figure = plots.histogram_figure("harmonics 1, 2, 3", properties, truth, ("stiff", "_soft"))
    axes = figure.axes[0]
    counts = sum(patch.get_data().values.sum() for patch in axes.patches)
    assert counts == properties["status"].size
    filled = sum(patch.get_data().values.sum() for patch in axes.patches if patch.get_fill())
    assert filled == int((properties["status"] == 0).sum())
    unit = 1e6 if "MPa" in axes.get_xlabel() else 1e9
    lines = sorted(line.get_xdata()[0] * unit for line in axes.lines)
    np.testing.assert_allclose(lines, [9e7, 2e9])
    legend = [text.get_text() for text in figure.legends[0].get_texts()]
    assert legend == ["material stiff", "material _soft", "determined", "not determined", "true median"]
    figure.draw_without_rendering()


def test_histograms_without_truth(properties):
    figure = plots.histogram_figure("$ in a label", properties)
    assert not figure.axes[0].lines
    figure.draw_without_rendering()
