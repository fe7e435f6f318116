"""What a feedback loop holds: amplitudes a little off the set-point, and the state of motion at each of them."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import numpy.typing as npt
import xarray as xr

from overtone.contact.sample import Sample
from overtone.dynamics.balance import FOUND
from overtone.dynamics.hold import hold_amplitude
from overtone.errors import OvertoneError
from overtone.harmonics import far_phase
from overtone.instrument.instrument import Instrument, lever_at, readings
from overtone.instrument.low_pass import correlated
from overtone.probe import Probe
from overtone.quantities import named_array
from overtone.units import format_quantity

_Floats = npt.NDArray[np.float64]
_Progress = Callable[[int, int], None]

_DIMS = ("y", "x")
_MEMORY = 3.0  # pixels over which the error of the feedback forgets itself
_GRID, _HIGHEST = 257, 1.3  # amplitudes at which the detector is tried, up to this share of the free one


def feedback_error(instrument: Instrument, relief: _Floats, generator: np.random.Generator) -> _Floats:
    """Return how far the amplitude of each pixel is off the set-point, as a share of it.

    Correlated along the fast axis, twice as large where the surface is as steep as on average than where it is flat;
    ``instrument.feedback_error`` is its root mean square over the scan.

    Parameters
    ----------
    instrument : Instrument
        Its ``feedback_error``.
    relief : array (y, x)
        The surface [m].
    generator : Generator
        Of the error.
    """
    wandering = correlated(relief.shape, math.exp(-1.0 / _MEMORY), generator)
    steep = np.abs(np.gradient(relief, axis=1)) if relief.shape[1] > 1 else np.zeros(relief.shape)
    typical = math.sqrt(float(np.mean(steep**2)))
    weight = 1.0 + steep / typical if typical > 0.0 else np.ones(relief.shape)
    weight /= math.sqrt(float(np.mean(weight**2)))
    return np.asarray(instrument.feedback_error * weight * wandering)


def behind_the_detector(probe: Probe, instrument: Instrument, read: _Floats) -> _Floats:
    """Return the amplitude of the motion of which the detector reads this one [m]."""
    if instrument.diode is None and not instrument.distortion:
        return read
    free = probe.drive.free_amplitude
    grid = np.linspace(0.0, _HIGHEST, _GRID) * free
    zero = np.zeros(_GRID)
    motion = xr.Dataset(
        {name: named_array(name, v, ("point",)) for name, v in (("A0", zero), ("A1", grid), ("phi1", zero))}
    )
    seen = readings(motion, instrument, probe)["A1"].values
    if not (np.diff(seen) > 0.0).all() or read.max() > seen[-1]:
        raise OvertoneError(
            "the detector does not tell amplitudes apart",
            expected=f"a reading that rises with the amplitude up to {_HIGHEST:g} times the free one",
            hint="a larger spot on the photodiode, or less distortion",
        )
    return np.asarray(np.interp(read, seen, grid))


def levers_of_lines(probe: Probe, instrument: Instrument, times: _Floats, height: float) -> list[Probe]:
    """Return the lever at a height [m] in each line (y), one for all of them where nothing drifts.

    Parameters
    ----------
    probe, instrument
        As in `overtone.instrument.instrument.lever_at`.
    times : array (y,)
        When each line is recorded [s].
    height : float
        Of the base [m].
    """
    drifts = (instrument.frequency_drift, instrument.quality_drift, instrument.drive_drift)
    return [
        lever_at(probe, instrument, height=height, time=float(t))
        for t in (times if any(drifts) else times[:1])
    ]


def held(
    levers: Sequence[Probe],
    material: Sample,
    amplitude: _Floats,
    working: float,
    regime: str,
    n_max: int,
    keep: int,
    progress: _Progress | None,
) -> tuple[xr.Dataset, int]:
    """Return the state at the amplitude of every pixel, free where the tip lost the surface, and how many did.

    Parameters
    ----------
    levers : sequence of Probe
        Of each line (y), or one for all.
    material : Sample
        Arrays (y, x).
    amplitude : array (y, x)
        A1 of the motion [m].
    working : float
        A1 at the set-point [m].
    regime, n_max, keep
        As in `overtone.hold_amplitude`.
    progress : callable, optional
        Called with (pixels done, pixels in all).

    Raises
    ------
    OvertoneError
        If a lever swings less than the set-point without a surface, or the error of the feedback is larger than it.
    """
    free = np.array([lever.drive.free_amplitude for lever in levers])[:, None]
    if not (free > working).all():
        line = f" in line {int(np.argmin(free)) + 1}" if len(levers) > 1 else ""
        raise OvertoneError(
            "the feedback never reaches the surface",
            expected=f"a set-point below the free amplitude near the surface, {format_quantity(free.min(), 'm')}{line}",
            got=format_quantity(working, "m"),
            hint="a lower set-point, or less drift and damping",
        )
    if not (amplitude > 0.0).all():
        raise OvertoneError(
            "the error of the feedback is larger than the set-point",
            expected="a feedback_error of a few per cent",
            got=f"an amplitude of {format_quantity(float(amplitude.min()), 'm')}",
        )
    off = amplitude >= free
    wanted = np.where(off, 0.5, amplitude / free)
    shape = wanted.shape

    def hold(
        lever: Probe, part: Sample, setpoints: _Floats, dims: Sequence[str], report: Any = None
    ) -> xr.Dataset:
        each = xr.DataArray(setpoints, dims=dims)
        options = {"regime": regime, "n_max": n_max, "keep": keep, "dims": tuple(dims), "progress": report}
        return hold_amplitude(lever, part, setpoint=each, **options)

    if len(levers) == 1:
        states = hold(levers[0], material, wanted, _DIMS, progress)
    else:
        values = {name: np.broadcast_to(array, shape) for name, array in material.values.items()}
        parts = [
            Sample(material.model, {name: v[row] for name, v in values.items()}) for row in range(shape[0])
        ]
        # a line is too short to be shared out, so that each thread takes lines of its own
        with ThreadPoolExecutor(os.cpu_count()) as pool:
            lines: list[xr.Dataset] = []
            for one in pool.map(hold, levers, parts, wanted, [("x",)] * len(parts)):
                lines.append(one)
                if progress is not None:
                    progress(len(lines) * shape[1], wanted.size)
        states = xr.concat(lines, dim="y", combine_attrs="override").transpose("harmonic", *_DIMS)
    if off.any():
        states = _set_free(states, np.broadcast_to(off, shape), levers)
    return states, int(off.sum())


def _set_free(states: xr.Dataset, off: npt.NDArray[np.bool_], levers: Sequence[Probe]) -> xr.Dataset:
    """Return states that are the free motion where the tip is off the surface."""
    phases = np.array([far_phase(lever) for lever in levers])[:, None]
    amplitudes = np.array([lever.drive.free_amplitude for lever in levers])[:, None]
    free = {"A1": amplitudes, "phi1": phases, "Z": amplitudes, "state": np.full((1, 1), FOUND, np.int8)}
    untold = {"indentation", "contact_time", "peak_force", "pull_force"}
    result = states.copy()
    for name, array in states.data_vars.items():
        value = free.get(str(name), np.full((1, 1), math.nan if name in untold else 0.0))
        filled = np.where(off, np.broadcast_to(value, off.shape), array.values)
        result[name] = array.copy(data=filled.astype(array.dtype))
    return result
