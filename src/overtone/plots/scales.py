"""From values to colours: unit, colour map and limits of a quantity."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from matplotlib import colormaps
from matplotlib.colors import BoundaryNorm, Colormap, ListedColormap, LogNorm, Normalize

from overtone.quantities import quantity
from overtone.units import display_unit

MISSING_COLOUR = "0.87"
_LOGARITHMIC = ("modulus", "amplification", "residual", "uncertainty", "misfit", "tabor", "mean_pressure")

Array = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]
Limits = tuple[float, float]


@dataclass(frozen=True)
class Scale:
    """From SI values to colours: factor and label of the unit, colour map and norm in that unit."""

    factor: float
    unit: str
    colours: Colormap
    norm: Normalize
    si_unit: str = "1"
    edges: tuple[float, ...] = ()
    """Where colours change, where they change in steps."""
    step: str = ""
    """How wide such a step is at least, in words."""
    beyond: tuple[bool, bool] = (False, False)
    """Whether maps on the same scale hold values below and above it."""

    @property
    def logarithmic(self) -> bool:
        """Whether equal ratios get equal steps of colour."""
        return isinstance(self.norm, LogNorm)

    @property
    def categorical(self) -> bool:
        """Whether colours stand for kinds, between which there is nothing."""
        return isinstance(self.norm, BoundaryNorm)

    @property
    def limits(self) -> Limits:
        """The values of the first and the last colour."""
        low, high = self.norm.vmin, self.norm.vmax
        return (0.0 if low is None else float(low), 1.0 if high is None else float(high))

    def clip(self, values: Array) -> Array:
        """Give zero the lowest colour on a logarithmic scale: it is a value, not missing data."""
        return np.where(values <= 0.0, self.limits[0] / 10.0, values) if self.logarithmic else values


def scale_of(
    name: str,
    unit: str,
    values: Array,
    veil: Mask | None,
    limits: Limits | None,
    *,
    logarithmic: bool | None = None,
) -> Scale:
    """Return the scale of a quantity.

    Parameters
    ----------
    name, unit : str
        Name of the quantity, and its unit where the name is not a known one.
    values : array
        SI values, at least one of them finite.
    veil : array of bool, optional
        True where a value is not determined: these do not set the colours.
    limits : tuple of float, optional
        Limits in SI units to use instead of those that fit the values.
    logarithmic : bool, optional
        Whether equal ratios get equal steps of colour; as suits the quantity where not given.
    """
    record = quantity(name)
    kind = record.kind if record else "quality"
    unit = record.unit if record else unit
    chosen = readable(values, veil)
    low, high = limits or robust_limits(chosen, positive=False)
    if logarithmic is None:
        logarithmic = name.startswith(_LOGARITHMIC) or (
            kind == "property" and low > 0.0 and high > 100.0 * low
        )
    logarithmic = logarithmic and high > 0.0
    if logarithmic and low <= 0.0:
        low, high = robust_limits(chosen if (chosen > 0.0).any() else values, positive=True)
    display = display_unit(
        math.sqrt(low) * math.sqrt(high) if logarithmic else max(abs(low), abs(high)), unit
    )
    low, high = low * display.factor, high * display.factor
    norm: Normalize
    if logarithmic:
        low, high = (low / 2.0, high * 2.0) if high < low * 1.001 else (low, high)
        norm = LogNorm(low, high)
    else:
        if high - low <= 1e-6 * max(abs(low), abs(high)):
            margin = 0.05 * max(abs(low), abs(high)) or 1.0
            low, high = low - margin, high + margin
        norm = Normalize(low, high)
    colours = "viridis" if kind == "property" else "cividis"
    if unit == "rad" and high - low > 270.0:
        # A phase that goes around: 0 and 360 degrees are the same and get the same colour.
        colours, norm = "twilight", Normalize(-180.0, 180.0) if low < 0.0 else Normalize(0.0, 360.0)
    elif low < 0.0 < high and (kind == "force" or name == "virial"):
        # Centred on zero only where the sign changes: otherwise half of the colours would go unused.
        reach = max(-low, high)
        colours, norm = "RdBu_r", Normalize(-reach, reach)
    return Scale(
        display.factor, display.label, colormaps[colours].with_extremes(bad=MISSING_COLOUR), norm, unit
    )


def category_scale(colours: list[str]) -> Scale:
    """Return the scale of codes that count up from zero, a colour for each."""
    listed = ListedColormap(colours).with_extremes(bad=MISSING_COLOUR)
    return Scale(1.0, "", listed, BoundaryNorm(np.arange(len(colours) + 1) - 0.5, len(colours)))


def readable(values: Array, veil: Mask | None) -> Array:
    """Return the finite values that set the colours: the determined ones, where they are not a handful."""
    finite = np.isfinite(values)
    return values[finite & ~veil] if veil is not None and is_readable(values, veil) else values[finite]


def is_readable(values: Array, veil: Mask) -> bool:
    """Return whether enough values are determined to set the colours for all."""
    return bool(np.count_nonzero(np.isfinite(values) & ~veil) >= max(20, 0.02 * values.size))


def robust_limits(values: Array, *, positive: bool) -> Limits:
    """Return the 2nd and 98th percentile, or the extremes where those coincide."""
    values = values[np.isfinite(values)]
    if positive:
        values = values[values > 0.0]
    low, high = np.percentile(values, [2.0, 98.0])
    if low == high:
        low, high = values.min(), values.max()
    return float(low), float(high)


def positive_limits(values: Array) -> Limits | None:
    """Return limits of the positive values, None where there are none."""
    return robust_limits(values, positive=True) if (values > 0.0).any() else None
