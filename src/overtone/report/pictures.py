"""Figures as files: the same figure gives the same bytes, whenever and wherever it is written."""

from __future__ import annotations

import io
from typing import Any

import matplotlib
from matplotlib.collections import QuadMesh
from matplotlib.figure import Figure

from overtone.plots.canvas import TEXTS

FORMATS = ("svg", "pdf", "png")
_DPI = 300
_SALT = "overtone"
# letters as outlines in SVG, which look the same everywhere, and as text in PDF, which journals can edit
_SETTINGS: Any = {
    "svg.hashsalt": _SALT,
    "svg.fonttype": "path",
    "pdf.fonttype": 42,
    "pdf.compression": 6,
}
_METADATA: dict[str, dict[str, None]] = {
    "svg": {"Date": None},
    "pdf": {"CreationDate": None, "ModDate": None},
    "png": {"Software": None},
}


def picture_bytes(figure: Figure, ending: str) -> bytes:
    """Return a figure as SVG, PDF or PNG (300 dots per inch), without dates or random identifiers.

    Parameters
    ----------
    figure : Figure
        Laid out; its size is kept.
    ending : str
        ``svg``, ``pdf`` or ``png``.
    """
    _close_seams(figure)
    written = io.BytesIO()
    with TEXTS, matplotlib.rc_context(_SETTINGS):
        figure.savefig(written, format=ending, dpi=_DPI, metadata=_METADATA[ending])
    return written.getvalue()


def _close_seams(figure: Figure) -> None:
    """Let the cells of colour bars touch: viewers of vector files draw white hairs between them."""
    for axes in figure.axes:
        for bar in axes.child_axes:
            for mesh in bar.collections:
                if isinstance(mesh, QuadMesh):
                    mesh.set_edgecolor("face")
