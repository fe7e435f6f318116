"""Calibration data of a virtual microscope: the free lever over frequency and drive, and approach curves."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import xarray as xr

from overtone import provenance
from overtone.contact.sample import Sample
from overtone.dynamics.curve import DIRECTIONS, approach_curve
from overtone.dynamics.steady import checked_heights, steady_states
from overtone.errors import OvertoneError
from overtone.harmonics import far_phase, read_receptance
from overtone.instrument.instrument import Instrument, flicker_noise, free_response, lever_at, readings
from overtone.instrument.low_pass import behind_the_lock_in, time_constant
from overtone.instrument.scan import NOT_CORRECTED
from overtone.probe import Probe
from overtone.quantities import harmonic_orders, named_array
from overtone.readings import Reading, with_reading
from overtone.units import format_quantity

_Floats = npt.NDArray[np.float64]

_POINTS, _WIDTHS = 15, 1.5  # of a ladder: frequencies, and linewidths to each side of the resonance
_FAINT = 1e-4  # of the drive force: a first harmonic below it leaves the motion that of a free lever
_SEEN = (2, 3)


def simulate_far_field(
    probe: Probe,
    instrument: Instrument,
    *,
    height: float,
    frequencies: Any = None,
    drives: Sequence[float] = (1.0,),
    interval: float = 0.1,
    time: float = 0.0,
    seed: int,
) -> xr.Dataset:
    """Return readings of the free lever over a ladder of drive frequencies and of drives.

    Parameters
    ----------
    probe : Probe
        The lever far from the sample at time zero.
    instrument : Instrument
        What the microscope adds.
    height : float
        Of the base above the surface [m]; the lever is the one at this height.
    frequencies : array, optional
        Drive frequencies [Hz]; unless given 15 of them within one and a half linewidths of the resonance, where the
        amplitude falls to a third.
    drives : sequence of float
        Drives over the one of the scan. Each goes through all frequencies.
    interval : float
        Time from one reading to the next [s].
    time : float
        When the ladder begins [s], for drifts.
    seed : int
        Seed of the noise.

    Returns
    -------
    Dataset
        ``A0, A1, phi1, A2, phi2, A3, phi3`` over ``point``, with coordinates ``frequency`` [Hz], ``drive`` [1] and
        ``z`` [m].

    Raises
    ------
    OvertoneError
        If a number is not finite and positive, or the lever would touch the surface.

    Notes
    -----
    Every reading has settled. The phase is the lag behind the drive, in which a free lever driven as the probe says
    has its `far_phase`.
    """
    mode = probe.cantilever.modes[0]
    width = mode.frequency / mode.quality_factor
    ladder = mode.frequency + np.linspace(-_WIDTHS, _WIDTHS, _POINTS) * width
    f = np.atleast_1d(np.asarray(ladder if frequencies is None else frequencies, dtype=float))
    v = np.atleast_1d(np.asarray(drives, dtype=float))
    _require(
        {"frequencies": f, "drives": v, "interval": np.array([interval]), "height": np.array([height])}, time
    )
    frequency, drive = np.tile(f, v.size), np.repeat(v, f.size)
    times = time + interval * np.arange(1, frequency.size + 1)
    a = np.array(
        [
            _free(lever_at(probe, instrument, height=height, time=float(t)), fi) * vi
            for t, fi, vi in zip(times, frequency, drive, strict=True)
        ]
    )
    _check_height(height, float(np.abs(a).max()))
    places = {
        "frequency": ("point", frequency, {"units": "Hz", "long_name": "drive frequency"}),
        "drive": ("point", drive, {"units": "1", "long_name": "drive over the one of the scan"}),
        "z": ("point", np.full(frequency.size, height), {"units": "m", "long_name": "height of the base"}),
    }
    motion = _free_dataset(a, ("point",)).assign_coords(places)
    generator = np.random.default_rng(seed)
    shift = instrument.mean_slope_z * height + instrument.mean_drift * times
    shift = shift + flicker_noise(instrument, times.size, interval, generator)
    now = drive * (1.0 + instrument.drive_drift * times)
    read = readings(motion, instrument, probe, shift=shift, drive=now, generator=generator)
    read.attrs = {"source": "simulated", "vendor": "overtone", "detector": probe.detector.kind}
    arguments = {"height": height, "interval": interval, "time": time, "seed": seed}
    read = provenance.record(read, "simulate_far_field", **arguments, drives=v.tolist())
    read = provenance.add_finding(
        read,
        f"Simulated data: a free lever {format_quantity(height, 'm')} above the surface at {f.size} frequencies and "
        f"{v.size} drives, as a virtual microscope reads it.",
    )
    return with_reading(read, Reading(probe, corrected=False, doubts=NOT_CORRECTED))


def _free(lever: Probe, frequency: float) -> complex:
    """Return the phasor of the free first harmonic at a frequency, of the drive that the lever has at its own [m]."""
    own, there = (complex(free_response(lever, f)) for f in (lever.drive.frequency, frequency))
    return complex(lever.drive.free_amplitude * np.exp(-1j * far_phase(lever)) * there / own)


def _free_dataset(first: npt.NDArray[np.complex128], dims: tuple[str, ...]) -> xr.Dataset:
    """Return observables of a free motion."""
    arrays = {
        "A1": np.abs(first),
        "phi1": np.mod(-np.angle(first), 2.0 * math.pi),
        "A0": np.zeros(first.shape),
    }
    arrays |= {f"{letter}{n}": np.zeros(first.shape) for n in _SEEN for letter in ("A", "phi")}
    return xr.Dataset({name: named_array(name, values, dims) for name, values in arrays.items()})


def simulate_approach(
    probe: Probe,
    sample: Sample,
    instrument: Instrument,
    *,
    z: Any,
    speed: float = 200e-9,
    height_noise: float = 0.0,
    time: float = 0.0,
    seed: int,
    n_max: int = 10,
    keep: int = 6,
    progress: Callable[[int, int], None] | None = None,
) -> xr.Dataset:
    """Return an approach curve, there and back, as a microscope would store it.

    Parameters
    ----------
    probe : Probe
        The lever far from the sample at time zero; with a tip radius.
    sample : Sample
        One material.
    instrument : Instrument
        What the microscope adds.
    z : array (z,)
        Heights of the base above the surface [m]; the highest ones out of contact, for the far field.
    speed : float
        Of the base [m/s]: how much time there is to drift, and for the lock-in. The lever is always in its steady
        state.
    height_noise : float
        Standard deviation of where the base is about where the file says it is [m].
    time : float
        When the curve begins [s], for drifts.
    seed : int
        Seed of the noise.
    n_max, keep : int
        Harmonics of the motion that act back on the force, and that the detector sees.
    progress : callable, optional
        Called with (points done, points in all).

    Returns
    -------
    Dataset
        ``A0, A1, phi1, A2, phi2, A3, phi3`` over ``direction`` (approach, retract) and ``z`` (falling). Its attribute
        ``zero`` is ``surface``: z = 0 is where the tip of a lever at rest touches, which a real microscope does not
        know.

    Raises
    ------
    OvertoneError
        If the sample is an array, there are no heights, or a number makes no sense.
    ContactModelError, ProbeError
        If the sample cannot be simulated or the probe has no tip radius.

    Notes
    -----
    At every height the lever is the one that height and time leave. The branch is the one of a sweep with the lever at
    the surface in the middle of the curve: where drift moves a fold, the jump is off by as much.
    """
    if sample.shape:
        raise OvertoneError("an approach curve takes one material", got=f"arrays of shape {sample.shape}")
    _require({"speed": np.array([speed])}, time)
    if not 0.0 <= height_noise < math.inf:
        raise OvertoneError("unphysical noise of the height", expected="0 m or more", got=repr(height_noise))
    generator = np.random.default_rng(seed)
    steps, times = _sweep_times(z, speed, time)
    middle = lever_at(probe, instrument, height=0.0, time=float(times.mean()))
    swept = approach_curve(middle, sample, z=z, n_max=n_max, keep=keep)
    heights = swept["z"].values
    there = heights + height_noise * generator.standard_normal((2, heights.size))
    names = [name for n in harmonic_orders(swept) for name in (f"A{n}", f"phi{n}") if name in swept]
    motion = swept[names].copy(deep=True)
    near = instrument.near_surface
    drifts = (instrument.frequency_drift, instrument.quality_drift, instrument.drive_drift)
    if any(drifts) or near.damping or near.softening or height_noise > 0.0:
        _follow(motion, swept, probe, instrument, sample, times, there, middle, n_max, keep, progress)
    shift = instrument.mean_slope_z * there + instrument.mean_drift * times
    interval = float(steps.mean())
    in_time = flicker_noise(instrument, times.size, interval, generator)
    shift = shift + np.stack([in_time[: heights.size], in_time[heights.size :][::-1]])
    drive = 1.0 + instrument.drive_drift * times
    read = readings(motion, instrument, probe, shift=shift, drive=drive)
    decay = np.exp(-steps / time_constant(instrument))
    in_order = decay[0], decay[1][::-1]
    ways = [
        behind_the_lock_in(read.isel(direction=k), instrument, probe, in_order[k], bool(k), generator)
        for k in range(2)
    ]
    result = xr.concat(ways, dim="direction").assign_coords(direction=list(DIRECTIONS), z=swept["z"])
    result["z"].attrs["zero"] = "surface"
    result.attrs = {"source": "simulated", "vendor": "overtone", "detector": probe.detector.kind}
    arguments = {"speed": speed, "height_noise": height_noise, "time": time, "seed": seed}
    result = provenance.record(result, "simulate_approach", **arguments, n_max=n_max, keep=keep)
    result = provenance.add_finding(
        result,
        f"Simulated data: model {sample.model.key} on a motion with {n_max} harmonics, swept at "
        f"{format_quantity(speed * 1e9, '1')} nm/s, as a virtual microscope reads it.",
    )
    return with_reading(result, Reading(probe, corrected=False, doubts=NOT_CORRECTED))


def _sweep_times(z: Any, speed: float, start: float) -> tuple[_Floats, _Floats]:
    """Return the time since the reading before, and of each reading (direction, z) [s]; z falls."""
    heights = np.unique(checked_heights(z))[::-1]
    gaps = -np.diff(heights) / speed
    typical = float(gaps.mean()) if gaps.size else 1.0
    down = np.concatenate([[typical], gaps])
    up = np.concatenate([gaps, [typical]])  # at each height, since the one below
    there = start + np.cumsum(down)
    back = there[-1] + np.cumsum(up[::-1])[::-1]
    return np.stack([down, up]), np.stack([there, back])


def _follow(
    motion: xr.Dataset,
    swept: xr.Dataset,
    probe: Probe,
    instrument: Instrument,
    sample: Sample,
    times: _Floats,
    there: _Floats,
    middle: Probe,
    n_max: int,
    keep: int,
    progress: Callable[[int, int], None] | None,
) -> None:
    """Replace the motion of a sweep by that of the lever as it is at each height and time, in place."""
    first = swept[["F_cons", "F_diss"]].sel(harmonic=1).transpose("direction", "z")
    force = np.hypot(first["F_cons"].values, first["F_diss"].values)
    drive = middle.drive.free_amplitude / abs(complex(read_receptance(middle, middle.drive.frequency)))
    ordered = motion.transpose("direction", "z")
    arrays = {str(name): ordered[name].values for name in ordered.data_vars}
    reference = {name: values.copy() for name, values in arrays.items()}
    depth = swept["indentation"].transpose("direction", "z").values
    before = _free(middle, middle.drive.frequency)
    for done, (way, k) in enumerate(np.ndindex(*times.shape), start=1):
        height = float(there[way, k])
        lever = lever_at(probe, instrument, height=height, time=float(times[way, k]))
        f = float(force[way, k])
        if f < _FAINT * drive:
            # a1 = G (F + f1), and each harmonic is bound to the phase of the first
            ratio = _free(lever, lever.drive.frequency) / before
            for name, values in arrays.items():
                if name == "A1":
                    values[way, k] *= abs(ratio)
                elif name.startswith("phi"):
                    values[way, k] = (values[way, k] - int(name[3:]) * np.angle(ratio)) % (2.0 * math.pi)
        elif math.isfinite(f):
            states = steady_states(lever, sample, z=height, n_max=n_max, keep=keep).isel(z=0)
            good = states["stable"].values & np.isfinite(states["A1"].values)
            off = np.abs(states["A1"].values - reference["A1"][way, k])
            off += np.abs(states["indentation"].values - depth[way, k])
            branch = int(np.argmin(np.where(good, off, np.inf)))
            for name, values in arrays.items():
                values[way, k] = float(states[name][branch]) if good.any() else math.nan
        if progress is not None:
            progress(done, times.size)
    for name, values in arrays.items():
        motion[name] = ordered[name].copy(data=values)


def _check_height(height: float, swing: float) -> None:
    if height <= swing:
        raise OvertoneError(
            "the lever is not free",
            expected=f"a height above its swing of {format_quantity(swing, 'm')}",
            got=format_quantity(height, "m"),
        )


def _require(values: dict[str, _Floats], time: float) -> None:
    """Refuse numbers that are not finite and positive, naming every one of them."""
    bad = [
        name
        for name, array in values.items()
        if array.size == 0 or not (np.isfinite(array) & (array > 0.0)).all()
    ]
    bad += [] if math.isfinite(time) else ["time"]
    if bad:
        raise OvertoneError(
            "unphysical settings of a virtual measurement",
            expected="finite positive numbers",
            got=", ".join(bad),
        )
