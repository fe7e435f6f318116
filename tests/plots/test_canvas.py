import io
import threading

import numpy as np
import pytest
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from PIL import Image

from overtone import plots
from overtone.plots.canvas import new_figure


def test_figures_can_be_drawn_in_threads(energies):
    pictures: list[bytes] = []
    work = [
        threading.Thread(target=lambda: pictures.append(plots.png_bytes(plots.energy_figure(energies))))
        for _ in range(2)
    ]
    for thread in work:
        thread.start()
    for thread in work:
        thread.join()
    assert len(pictures) == 2
    assert pictures[0] == pictures[1]


def test_a_picture_has_few_colours_and_keeps_white_and_large_areas():
    figure = new_figure(4.0, 3.0)
    axes = figure.add_axes((0.0, 0.5, 1.0, 0.5))
    axes.imshow(np.linspace(0.0, 1.0, 4096).reshape(1, -1), aspect="auto", cmap="viridis")
    axes.set_axis_off()
    figure.add_artist(Rectangle((0.0, 0.0), 0.2, 0.2, color="#cc79a7"))
    with Image.open(io.BytesIO(plots.png_bytes(figure))) as picture:
        assert picture.mode == "P"
        assert picture.info["dpi"] == pytest.approx((100.0, 100.0), abs=0.1)
        pixels = np.asarray(picture.convert("RGB")).astype(int)
    drawn = np.asarray(figure.canvas.buffer_rgba())[..., :3].astype(int)
    assert (pixels[drawn.min(axis=-1) == 255] == 255).all()
    assert np.abs(pixels - drawn).max() <= 8


def test_a_figure_of_another_canvas_and_layout_is_drawn_too():
    figure = Figure(figsize=(2.0, 1.0), dpi=50, layout="constrained")
    figure.subplots()
    with Image.open(io.BytesIO(plots.png_bytes(figure))) as picture:
        assert picture.size == (100, 50)
