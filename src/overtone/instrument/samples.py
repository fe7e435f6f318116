"""A signal sampled at a constant rate: how an array becomes one, and what speaks against it."""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import xarray as xr

from overtone.errors import DistortionWarning, ObservablesError, OvertoneError, UnitError

BLOCK = 1 << 17
"""Samples that are worked on at a time."""
_JITTER = 0.1  # of a sampling interval: time labels farther off are no uniform sampling
_LEVEL = 1e-9  # of the span of a signal: values closer than that are one and the same


class Trace(NamedTuple):
    """Samples at a constant rate."""

    values: npt.NDArray[Any]
    """Over time, which is the last dimension."""
    rate: float
    """Samples a second [Hz]."""
    start: float
    """Time of the first sample [s]."""


def blocks(first: int, last: int) -> Iterator[tuple[int, int]]:
    """Yield start and stop of blocks that make up a range of samples."""
    return ((start, min(start + BLOCK, last)) for start in range(first, last, BLOCK))


def check_positive(**numbers: float | None) -> None:
    """Refuse frequencies that are none; None passes.

    Raises
    ------
    OvertoneError
        If one is not finite or not positive.
    """
    for name, value in numbers.items():
        if value is not None and not (math.isfinite(value) and value > 0.0):
            raise OvertoneError(f"{name} is not positive", expected="a positive number in Hz", got=str(value))


def sampled(signal: Any, rate: float | None, name: str, unit: str | None = None) -> Trace:
    """Return a signal over time as samples at a constant rate.

    Parameters
    ----------
    signal : DataArray (time) or array (n)
        With a coordinate ``time`` [s], or without where ``rate`` is given.
    rate : float or None
        Samples a second [Hz]; without it the labels of time tell.
    name : str
        What to call the signal in messages.
    unit : str, optional
        Unit that a DataArray has to have where it states one.

    Raises
    ------
    UnitError
        If the unit is another, or the time is not in seconds.
    ObservablesError
        If the signal is not real and one-dimensional, has no time, or is not uniformly sampled.
    OvertoneError
        If the rate is not positive.
    """
    values = signal.values if isinstance(signal, xr.DataArray) else np.asarray(signal)
    if values.ndim != 1 or values.dtype.kind not in "fiu" or values.size < 2:
        raise ObservablesError(
            f"the {name} is no trace",
            expected="real numbers over one dimension, time",
            got=f"shape {values.shape} of {values.dtype}",
        )
    check_positive(sampling_rate=rate)
    time = None
    if isinstance(signal, xr.DataArray):
        stated = signal.attrs.get("units", unit)
        if unit is not None and stated != unit:
            raise UnitError(
                f"the unit of the {name} does not fit",
                expected=f"a DataArray in {unit}",
                got=repr(stated),
                hint="multiply by the sensitivity in m/V and set attrs['units'] = 'm'",
            )
        time = signal.coords.get("time")
    if time is None:
        if rate is None:
            raise ObservablesError(
                f"the {name} has no time", expected="a coordinate time in s, or sampling_rate in Hz"
            )
        return Trace(values, float(rate), 0.0)
    labels = time.values
    if labels.shape != values.shape or labels.dtype.kind not in "fiu" or time.attrs.get("units", "s") != "s":
        got = f"{labels.dtype} in {time.attrs.get('units', 's')!r}"
        raise UnitError("the coordinate time does not fit", expected="numbers in s along the trace", got=got)
    step = float(labels[-1] - labels[0]) / (values.size - 1) if rate is None else 1.0 / rate
    off = max(
        float(np.abs(labels[start:stop] - labels[0] - step * np.arange(start, stop)).max())
        for start, stop in blocks(0, values.size)
    )
    # Labels are rounded, and a rate that was measured is not: then they only have to tell the same story.
    if not (step > 0.0 and off <= step * (_JITTER if rate is None else 1.0)):
        raise ObservablesError(
            f"the {name} is not sampled uniformly",
            expected=f"a sample every {step:.6g} s",
            got=f"times that are up to {off / abs(step or 1.0):.3g} intervals off",
            hint="resample the trace, or give sampling_rate and leave out the time if its labels are only rounded",
        )
    return Trace(values, 1.0 / step, float(labels[0]))


def check_values(trace: Trace, name: str, *, may_clip: bool = False) -> None:
    """Refuse gaps, and warn where the signal ran against a limit unless it may.

    Raises
    ------
    ObservablesError
        If samples are not finite.

    Warns
    -----
    DistortionWarning
        If so many samples stand at an extreme that something saturated.
    """
    values, lost, low, high = trace.values, 0, math.inf, -math.inf
    for start, stop in blocks(0, values.size):
        block = values[start:stop]
        lost += int(block.size - np.isfinite(block).sum())
        low, high = min(low, float(block.min())), max(high, float(block.max()))
    if lost:
        raise ObservablesError(
            f"the {name} has gaps",
            expected="a number at every sample: a filter cannot leave any out",
            got=f"{lost} of {values.size} samples are not finite",
            hint="cut the trace before or after them",
        )
    if may_clip or high <= low:
        return  # a constant has no line, which is said elsewhere
    clipped = max(_at_limit(values, high, 1.0, high - low), _at_limit(values, low, -1.0, high - low))
    if clipped:
        warnings.warn(
            f"the {name} stands at its extreme in {clipped} of {values.size} samples, as where a detector or a "
            "converter saturates: its harmonics are then those of the clipping",
            DistortionWarning,
            stacklevel=2,
        )


def _at_limit(values: npt.NDArray[Any], limit: float, sign: float, span: float) -> int:
    """Return how many samples stand at an extreme where no smooth motion would leave so many, else 0."""
    next_level, at_next, at_limit = math.inf, 0, 0  # levels count from the limit inwards
    for start, stop in blocks(0, values.size):
        below = sign * (limit - np.asarray(values[start:stop], dtype=np.float64))  # >= 0
        at_limit += int((below <= _LEVEL * span).sum())
        apart = below[(below > _LEVEL * span) & (below < 0.02 * span)]
        if apart.size:
            level = float(apart.min())
            if level < next_level - _LEVEL * span:
                next_level, at_next = level, 0
            at_next += int((np.abs(apart - next_level) <= _LEVEL * span).sum())
    # A turning point is passed smoothly: of the steps of a converter the last holds some three times the one
    # before it, and of values without steps it holds as many as any. The hundredth next to it is never empty
    # but where a period is a whole number of samples.
    clipped = at_limit >= max(20, 1e-3 * values.size) and at_limit > 5 * at_next > 0
    return at_limit if clipped else 0
