"""Ticks that are found once: locators and formatters would find them again at every layout and drawing."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.ticker import FixedFormatter, FixedLocator, LogLocator, MaxNLocator, NullLocator

from overtone.plots.text import POINTS_PER_INCH, TICK_SIZE

_SUPERSCRIPTS = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
_MINUS = str.maketrans("-", "−")


@dataclass(frozen=True)
class Ticks:
    """Where ticks are and what stands at them."""

    positions: tuple[float, ...]
    labels: tuple[str, ...]

    @property
    def locator(self) -> FixedLocator:
        """What tells an axis the positions."""
        return FixedLocator(self.positions)

    @property
    def formatter(self) -> FixedFormatter:
        """What tells an axis the labels."""
        return FixedFormatter(self.labels)

    def put_on(self, axis: Axis) -> None:
        """Give an axis these ticks and no others."""
        axis.set_major_locator(self.locator)
        axis.set_major_formatter(self.formatter)
        axis.set_minor_locator(NullLocator())


def linear_ticks(
    low: float, high: float, count: int, *, steps: Sequence[float] = (1, 2, 5, 10), integer: bool = False
) -> Ticks:
    """Return at most ``count`` steps of round numbers between two limits, a single number for a count of one.

    Examples
    --------
    >>> linear_ticks(-0.3, 1.1, 4).labels, linear_ticks(0.2, 0.2004, 3).labels
    (('0.0', '0.5', '1.0'), ('0.2000', '0.2002', '0.2004'))
    """
    locator = MaxNLocator(count, steps=list(steps), integer=integer, min_n_ticks=1)
    positions = _between(locator.tick_values(low, high), low, high)
    positions = positions[:1] if count == 1 else positions
    return Ticks(positions, _plain_labels(positions))


def log_ticks(low: float, high: float, room: int) -> Ticks:
    """Return powers of ten between two positive limits, or round numbers where these span a decade only.

    Examples
    --------
    >>> log_ticks(2e-8, 3e-2, 4).labels, log_ticks(60.0, 190.0, 4).labels
    (('10⁻⁶', '10⁻⁴', '10⁻²'), ('80', '120', '160'))
    """
    decades = math.log10(high / low)
    if decades > 1.0:
        dense = decades < 2.0 and room > 5
        locator = LogLocator(10.0, subs=(1.0, 2.0, 5.0) if dense else (1.0,), numticks=min(room, 8))
        found = locator.tick_values(low, high)
    else:
        found = MaxNLocator(min(room, 5)).tick_values(low, high)
    positions = _between(found, low, high)
    positions = positions[:1] if room == 1 else positions
    return Ticks(positions, power_labels(positions, low, high))


def edge_ticks(edges: Sequence[float]) -> Ticks:
    """Return ticks at numbers that are not round, with two or three digits.

    Examples
    --------
    >>> edge_ticks((83.2114, 124.817, 1187.2)).labels
    ('83.2', '125', '1190')
    """
    digits = 2 if len(edges) > 1 and _apart(edges, 2) else 3
    labels = tuple(_rounded(edge, digits).translate(_MINUS) for edge in edges)
    return Ticks(tuple(edges), labels)


def _apart(edges: Sequence[float], digits: int) -> bool:
    """Return whether rounding moves no edge by more than a tenth of its distance to the next."""
    step = np.diff(edges).min()
    return all(abs(float(f"{edge:.{digits}g}") - edge) < 0.05 * step for edge in edges)


def _rounded(value: float, digits: int) -> str:
    number = float(f"{value:.{digits}g}")
    return f"{number:g}" if number == 0.0 or 1e-3 <= abs(number) < 1e5 else f"{number:.{digits - 1}e}"


def power_labels(positions: Sequence[float], low: float, high: float) -> tuple[str, ...]:
    """Write plain numbers where all of them are short, and powers of ten otherwise.

    The powers are plain letters: formulas take many times as long to set.
    """
    plain = low >= 0.5e-3 and high < 2e5
    return tuple(f"{p:g}" if plain or p <= 0.0 else _power(p) for p in positions)


def room_for_ticks(axes: Axes, ratio: float | None) -> tuple[int, int]:
    """Return how many tick labels fit below and beside an image of this height over width.

    The cell it was given sets its size; without a ratio the image fills that.
    """
    width, height = axes.bbox.width / axes.figure.dpi, axes.bbox.height / axes.figure.dpi
    if ratio is not None:
        width, height = min(width, height / ratio), min(height, width * ratio)
    line = TICK_SIZE / POINTS_PER_INCH
    across = max(1, int(width / (4.0 * line)))
    # Two labels are worth being close to each other: one alone tells no scale.
    return across, max(2, int(height / (2.2 * line))) if height > 2.4 * line else 1


def _between(found: npt.ArrayLike, low: float, high: float) -> tuple[float, ...]:
    # Limits that are round numbers may have been rounded.
    slack = 1e-9 * min(high - low, abs(low) or math.inf)
    return tuple(float(p) for p in np.asarray(found) if low - slack <= p <= high + slack)


def _plain_labels(positions: Sequence[float]) -> tuple[str, ...]:
    """Write all numbers with the digits that the distance between them needs, and with a true minus sign."""
    step = (
        min(np.diff(positions), default=1.0)
        if len(positions) > 1
        else abs(positions[0])
        if positions
        else 1.0
    )
    tolerance = 1e-3 * (step or 1.0)
    digits = next((d for d in range(15) if all(abs(round(p, d) - p) < tolerance for p in positions)), 15)
    return tuple(f"{p + 0.0:.{digits}f}".translate(_MINUS) for p in (round(p, digits) for p in positions))


def _power(value: float) -> str:
    exponent = math.floor(math.log10(value) + 1e-9)
    mantissa = value / 10.0**exponent
    power = f"10{str(exponent).translate(_SUPERSCRIPTS)}"
    return power if abs(mantissa - 1.0) < 1e-6 else f"{mantissa:.3g}·{power}"
