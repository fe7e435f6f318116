"""Figures that need no screen, and pictures of them as PNG."""

from __future__ import annotations

import io
import threading

import numpy as np
import numpy.typing as npt
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image

DPI = 100
# Held while texts are measured or drawn: matplotlib has one parser of formulas, which is not safe in threads.
TEXTS = threading.Lock()
_COLOURS = 256
_BITS = 6


def new_figure(width: float, height: float) -> Figure:
    """Return an empty white figure of a size in inches."""
    figure = Figure(figsize=(width, height), dpi=DPI, facecolor="white")
    FigureCanvasAgg(figure)
    return figure


def png_bytes(figure: Figure) -> bytes:
    """Return the figure as a PNG at its own resolution, in 256 colours: maps of noise pack badly in more.

    Parameters
    ----------
    figure : Figure
        A figure with an opaque background.
    """
    canvas = figure.canvas if isinstance(figure.canvas, FigureCanvasAgg) else FigureCanvasAgg(figure)
    with TEXTS:
        canvas.draw()  # type: ignore[no-untyped-call]
    picture = np.asarray(canvas.buffer_rgba())  # type: ignore[no-untyped-call]
    packed = io.BytesIO()
    _in_few_colours(picture).save(packed, "PNG", dpi=(figure.dpi, figure.dpi))
    return packed.getvalue()


def _in_few_colours(picture: npt.NDArray[np.uint8]) -> Image.Image:
    """Replace the colours of an opaque picture by the 256 that stand for them best.

    The palette is cut from the different colours, of which there are a few thousand, and not from a million
    pixels. Each counts as the root of its pixels: white paper would leave too little for the colour bars.
    """
    steps = picture[..., :3].astype(np.int32) >> (8 - _BITS)
    keys = (steps[..., 0] << 2 * _BITS) | (steps[..., 1] << _BITS) | steps[..., 2]
    pixels = np.bincount(keys.ravel(), minlength=1 << 3 * _BITS)
    used = np.flatnonzero(pixels)
    channels = np.stack([used >> 2 * _BITS, used >> _BITS, used], axis=-1) & ((1 << _BITS) - 1)
    # The highest step is full intensity, so that white stays white.
    colours = np.round(channels * (255.0 / ((1 << _BITS) - 1))).astype(np.uint8)
    repeats = np.ceil(np.sqrt(pixels[used])).astype(int)
    sample = Image.fromarray(np.repeat(colours, repeats, axis=0)[np.newaxis])
    sample = sample.quantize(_COLOURS, Image.Quantize.MEDIANCUT, kmeans=1, dither=Image.Dither.NONE)
    index = np.zeros(pixels.size, np.uint8)
    index[used] = np.asarray(sample)[0, np.cumsum(repeats) - 1]
    reduced = Image.fromarray(index[keys])
    reduced.putpalette(sample.getpalette() or [])
    return reduced
