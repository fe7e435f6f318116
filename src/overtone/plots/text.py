"""Titles and labels: how a quantity is called in a figure, and how large it is written."""

from __future__ import annotations

import re
import textwrap

import xarray as xr
from matplotlib.axes import Axes

from overtone.quantities import quantity

TITLE_SIZE, LABEL_SIZE, TICK_SIZE = 10.0, 9.0, 8.0
HEADING_SIZE = TITLE_SIZE + 1.0
TITLE_PAD = 6.0
POINTS_PER_INCH = 72.0
NO_DATA = "no data"
_TITLES = {
    "A0": "mean deflection",
    "residual": "residual $N_r$",
    "dissipation": "dissipated energy",
}
# what the rules of symbols below do not set, or what has no symbol of its own
_LABELS = {
    "misfit": r"$\chi^2$",
    "loss_tangent": r"$\tan\,\delta$",
    "uncertainty": r"$\sigma$ of $\ln E_s$",
    "uncertainty_statistical": r"$\sigma$ of $\ln E_s$",
    "uncertainty_systematic": r"$\sigma$ of $\ln E_s$",
    "contact_probability": "probability",
    "model_probability": "probability",
}
_VARIANTS = ("_unscreened", "_lower", "_upper")
_GREEK = ("phi", "delta", "sigma", "eta")


def wrapped(text: str, inches: float, size: float) -> str:
    """Break a text into lines that are about as long as there is room for, from the width of a mean letter."""
    return textwrap.fill(text, max(12, int(inches * POINTS_PER_INCH / (0.55 * size))))


def height_of(text: str, size: float) -> float:
    """Return how high the lines of a text are in inches."""
    return 1.25 * size * (text.count("\n") + 1) / POINTS_PER_INCH


def set_title(axes: Axes, title: str) -> None:
    """Write a title over the axes, wrapped to their width."""
    inches = axes.bbox.width / axes.figure.dpi
    # With a height of its own the title is not moved clear of the ticks, which takes a second layout of them.
    axes.set_title(wrapped(title, inches, TITLE_SIZE), fontsize=TITLE_SIZE, loc="left", y=1.0, pad=TITLE_PAD)


def title_of(array: xr.DataArray) -> str:
    """Return what stands above the map of an array."""
    name = str(array.name)
    record = quantity(name)
    if name in _TITLES:
        return _TITLES[name]
    if record and record.kind == "observable" and record.symbol != "h":
        return record.meaning
    return name.replace("_", " ")


def label_of(array: xr.DataArray, unit: str) -> str:
    """Return what stands at an axis or a colour bar: the symbol and the unit, as far as there are such."""
    name = str(array.name)
    for variant in _VARIANTS:
        name = name.removesuffix(variant)
    if name in _LABELS:
        return with_unit(_LABELS[name], unit)
    record = quantity(name)
    symbol = record.symbol if record else ""
    if symbol:
        return with_unit(typeset(symbol), unit)
    return unit or str(array.name).replace("_", " ")


def with_unit(text: str, unit: str) -> str:
    """Return a text with the unit in brackets behind it, where there is one."""
    return f"{text} [{unit}]" if unit else text


def typeset(symbol: str) -> str:
    r"""Typeset a symbol.

    Examples
    --------
    >>> print(typeset("delta_max"), typeset("A_0"), typeset("E_s"))
    $\delta_{\mathrm{max}}$ $A_{0}$ $E_{s}$
    """
    base, _, index = symbol.partition("_")
    base = f"\\{base}" if base in _GREEK else base
    if not index:
        return f"${base}$"
    return (
        f"${base}_{{\\mathrm{{{index}}}}}$"
        if re.fullmatch("[A-Za-z]{2,}", index)
        else f"${base}_{{{index}}}$"
    )


def draw_empty(axes: Axes) -> None:
    """Draw a square that says that there are no data."""
    axes.set_xticks([])
    axes.set_yticks([])
    axes.set_box_aspect(1.0)
    axes.set_anchor("NW")
    axes.text(
        0.5,
        0.5,
        NO_DATA,
        transform=axes.transAxes,
        ha="center",
        va="center",
        color="0.4",
        fontsize=TITLE_SIZE,
    )


def draw_words(axes: Axes, words: str) -> None:
    """Fill the cell of a map with words."""
    axes.set_xticks([])
    axes.set_yticks([])
    axes.set_facecolor("0.97")
    inches = axes.bbox.width / axes.figure.dpi
    axes.text(
        0.5,
        0.5,
        wrapped(words, 0.9 * inches, LABEL_SIZE),
        transform=axes.transAxes,
        ha="center",
        va="center",
        color="0.3",
        fontsize=LABEL_SIZE,
        parse_math=False,
    )
