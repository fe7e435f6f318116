"""The virtual microscope: a scan of a sample of known properties, as an instrument would store it.

A feedback loop holds the amplitude that the detector reads, each pixel a little off; the steady state at that
amplitude, of the lever as drift and the air film have left it, gives the motion; detector, electronics, lock-in and
noise make readings of it. Lines are recorded from the top row down, each as trace, retrace and, where there is a lift
pass, trace and retrace of that.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import xarray as xr

from overtone import provenance
from overtone.contact.sample import Sample
from overtone.dynamics.balance import FOUND
from overtone.errors import OvertoneError
from overtone.harmonics import far_phase
from overtone.instrument.feedback import behind_the_detector, feedback_error, held, levers_of_lines
from overtone.instrument.instrument import Instrument, flicker_noise, readings
from overtone.instrument.low_pass import behind_the_lock_in, time_constant
from overtone.instrument.phantom import map_of, material_of
from overtone.probe import Probe, format_probe
from overtone.quantities import LIFT, harmonic_orders, named_array, named_variable
from overtone.readings import Reading, with_reading
from overtone.units import format_quantity

_Floats = npt.NDArray[np.float64]
_Progress = Callable[[int, int], None]

_DIMS = ("y", "x")
_LINES = ("trace", "retrace")

NOT_CORRECTED = {
    0: "A0 is as the virtual microscope reads it, with the offset and the drift of its instrument; 1 pm of it moves a "
    "modulus by tens of per cent"
}
"""Doubts of simulated readings, by harmonic."""


def simulate_scan(
    probe: Probe,
    surface: xr.Dataset | Sample,
    instrument: Instrument,
    *,
    setpoint: float,
    model: str | None = None,
    poisson_ratio: float | None = None,
    size: float | None = None,
    regime: str = "repulsive",
    retrace: bool = True,
    lift: float | None = None,
    time: float = 0.0,
    seed: int,
    n_max: int = 10,
    keep: int = 6,
    progress: _Progress | None = None,
) -> xr.Dataset:
    """Return a scan of a sample of known properties, as a microscope would store it.

    Parameters
    ----------
    probe : Probe
        The lever far from the sample at time zero, which is what the operator knows; with a tip radius.
    surface : Dataset or Sample
        A map over (y, x) of what the contact model needs (``modulus``, ``adhesion``, ...), with coordinates [m] and
        optional ``height`` [m], as `overtone.instrument.phantom` makes them; or a sample of arrays (y, x).
    instrument : Instrument
        What the microscope adds.
    setpoint : float
        A1 that the feedback holds over A1far of the probe, as the detector reads both.
    model : str, optional
        Contact model of a map: ``dmt-viscous`` where it has a viscosity, else ``dmt``, unless given.
    poisson_ratio : float, optional
        Of the sample, where the map has none.
    size : float, optional
        Width of the scan [m], for a `Sample`.
    regime : str
        ``repulsive`` or ``attractive``: the state that is held.
    retrace : bool
        Whether the retrace is kept as well: a first dimension ``direction`` then.
    lift : float, optional
        Height of a lift pass above the working height [m]: the drive on, free of contact.
    time : float
        When the scan begins [s], for drifts.
    seed : int
        Seed of feedback error and noise.
    n_max : int
        Harmonics of the motion that act back on the force.
    keep : int
        Harmonics of the motion that the detector sees.
    progress : callable, optional
        Called with (pixels done, pixels in all).

    Returns
    -------
    Dataset
        ``A0, A1, phi1, A2, phi2, A3, phi3`` and ``height`` [m] over (y, x) or (direction, y, x); of a lift pass also
        ``lift_A0``, ``lift_A1``, ... ``height`` is that of the base, in the frame in which a flat sample of
        height 0 has the Z of its steady state. Attributes say how it was read, history and findings. A pixel
        without a steady state is NaN.

    Raises
    ------
    OvertoneError
        If the set-point is out of reach of the lever as it is near the surface, a lift pass would touch, or
        arguments do not fit each other.
    ContactModelError, ProbeError
        If the sample is incomplete or the probe has no tip radius.

    Notes
    -----
    Lever and drive change from line to line, not within one. Trace and retrace meet the same states, with the same
    error of the feedback; detector, filter, drift of the mean and noise are their own. The thermal motion is
    that of the free lever.
    """
    return scan_with_truth(
        probe,
        surface,
        instrument,
        setpoint=setpoint,
        model=model,
        poisson_ratio=poisson_ratio,
        size=size,
        regime=regime,
        retrace=retrace,
        lift=lift,
        time=time,
        seed=seed,
        n_max=n_max,
        keep=keep,
        progress=progress,
    )[0]


def scan_with_truth(
    probe: Probe,
    surface: xr.Dataset | Sample,
    instrument: Instrument,
    *,
    setpoint: float,
    model: str | None = None,
    poisson_ratio: float | None = None,
    size: float | None = None,
    regime: str = "repulsive",
    retrace: bool = True,
    lift: float | None = None,
    time: float = 0.0,
    seed: int,
    n_max: int = 10,
    keep: int = 6,
    progress: _Progress | None = None,
) -> tuple[xr.Dataset, xr.Dataset]:
    """Return a scan as `simulate_scan` does, and the truth behind it.

    Returns
    -------
    tuple of Dataset
        Observables, and over (y, x): the states at which the tip really was, as `overtone.hold_amplitude` returns
        them; the properties of the map; and by line (y) the ``frequency`` [Hz], ``quality_factor`` and
        ``free_amplitude`` [m] of the lever.
    """
    _check_numbers(setpoint, lift, time)
    if isinstance(surface, Sample):
        if model is not None or poisson_ratio is not None:
            raise OvertoneError("a Sample has its own model and Poisson's ratio", hint="leave them out")
        ground, material = map_of(surface, size), surface
    else:
        ground, material = _checked(surface, size), material_of(surface, model, poisson_ratio)
    clock = Clock(ground.sizes["y"], ground.sizes["x"], instrument.line_time, lift is not None, time)
    for_error, for_flicker, for_noise, for_lift = np.random.default_rng(seed).spawn(4)
    relief = ground["height"].values
    working = setpoint * probe.drive.free_amplitude
    off = 1.0 + feedback_error(instrument, relief, for_error)
    amplitude = behind_the_detector(probe, instrument, working * off)
    lines = levers_of_lines(probe, instrument, clock.middle(0), working)
    states, lost = held(lines, material, amplitude, working, regime, n_max, keep, progress)
    states = states.assign_coords(ground.coords)
    base = relief + states["Z"].values
    flicker = flicker_noise(instrument, clock.count, clock.interval, for_flicker)
    places = ground["x"].values[None, :], ground["y"].values[:, None]

    def observe(
        motion: xr.Dataset, height: _Floats, number: int, generator: np.random.Generator
    ) -> xr.Dataset:
        shift = instrument.mean_slope_z * height
        shift = shift + instrument.mean_slope_x * places[0] + instrument.mean_slope_y * places[1]
        drive = 1.0 + instrument.drive_drift * clock.middle(number)[:, None]
        seen = []
        for back in range(2 if retrace else 1):
            drift = instrument.mean_drift * clock.time(number, back) + flicker[clock.index(number, back)]
            read = readings(motion, instrument, probe, shift=shift + drift, drive=drive)
            decay = math.exp(-clock.interval / time_constant(instrument))
            seen.append(behind_the_lock_in(read, instrument, probe, decay, bool(back), generator))
        return xr.concat(seen, dim="direction", combine_attrs="drop_conflicts") if retrace else seen[0]

    names = [name for n in harmonic_orders(states) for name in (f"A{n}", f"phi{n}") if name in states]
    result = observe(states[names], base, 0, for_noise)
    recorded = named_array("height", base, _DIMS, ground.coords)
    result["height"] = recorded.broadcast_like(result["A1"]).transpose(*result["A1"].dims).copy()
    if lift is not None:
        above = levers_of_lines(probe, instrument, clock.middle(1), working + lift)
        _check_lift(lift, states["Z"].values, above)
        free = _free_motion(above, ground, harmonic_orders(states))
        result = result.assign(_named_lift(observe(free, base + lift, 1, for_lift)))
    if retrace:
        result = result.assign_coords(direction=list(_LINES))
    result.attrs = {"source": "simulated", "vendor": "overtone", "detector": probe.detector.kind}
    result.attrs |= {} if retrace else {"direction": _LINES[0]}
    result.attrs |= {} if lift is None else {"lift_height": float(lift)}
    arguments = {"setpoint": setpoint, "regime": regime, "retrace": retrace, "lift": lift, "time": time}
    result = provenance.record(result, "simulate_scan", **arguments, seed=seed, n_max=n_max, keep=keep)
    result = provenance.add_finding(result, *_sentences(states, lost, material, n_max, lift))
    result = with_reading(result, Reading(probe, corrected=False, doubts=NOT_CORRECTED))
    return result, _truth(states, ground, lines, probe, instrument)


# --- time ------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Clock:
    """When each pixel is read: lines from the top, in each the passes, in each trace and retrace.

    Parameters
    ----------
    rows, columns : int
        Of the scan.
    line_time : float
        Of a line of one pass, trace and retrace [s].
    lift : bool
        Whether every line has a second pass.
    start : float
        When the first pixel begins [s].
    """

    rows: int
    columns: int
    line_time: float
    lift: bool
    start: float

    @property
    def interval(self) -> float:
        """Time of a pixel [s]."""
        return self.line_time / 2 / self.columns

    @property
    def count(self) -> int:
        """Number of readings from the first to the last."""
        return self.rows * (1 + self.lift) * 2 * self.columns

    def index(self, number: int, back: int) -> npt.NDArray[np.int64]:
        """Return the place in time of every pixel (y, x) of a pass and a direction."""
        row = np.arange(self.rows, dtype=np.int64)[:, None]
        column = np.arange(self.columns, dtype=np.int64)[None, :]
        along = self.columns - 1 - column if back else column
        return ((row * (1 + self.lift) + number) * 2 + back) * self.columns + along

    def time(self, number: int, back: int) -> _Floats:
        """Return when every pixel (y, x) of a pass and a direction has been read [s]."""
        return np.asarray(self.start + (self.index(number, back) + 1) * self.interval)

    def middle(self, number: int) -> _Floats:
        """Return the middle of a pass of each line (y) [s]."""
        return np.asarray(
            self.start + (np.arange(self.rows) * (1 + self.lift) + number + 0.5) * self.line_time
        )


# --- lift ------------------------------------------------------------------------------------------


def _free_motion(levers: Sequence[Probe], ground: xr.Dataset, orders: Sequence[int]) -> xr.Dataset:
    """Return the free motion (y, x) of the lever of each line."""
    shape = ground.sizes["y"], ground.sizes["x"]

    def array(name: str, values: Any) -> xr.DataArray:
        column = np.broadcast_to(np.asarray(values, dtype=float).reshape(-1, 1), shape)
        return named_array(name, column, _DIMS, ground.coords)

    arrays = {"A1": array("A1", [lever.drive.free_amplitude for lever in levers])}
    arrays["phi1"] = array("phi1", [far_phase(lever) for lever in levers])
    for n in orders:
        if n != 1:
            arrays |= {name: array(name, 0.0) for name in ([f"A{n}", f"phi{n}"] if n else ["A0"])}
    return xr.Dataset(arrays)


def _check_lift(lift: float, height: _Floats, levers: Sequence[Probe]) -> None:
    """Refuse a lift pass that would tap."""
    swing = max(lever.drive.free_amplitude for lever in levers)
    lowest = float(np.nanmin(height)) if np.isfinite(height).any() else 0.0
    if lowest + lift <= swing:
        raise OvertoneError(
            "the lift pass would touch the surface",
            expected=f"more than {format_quantity(swing - lowest, 'm')} above the working height, where the lever "
            f"swings by {format_quantity(swing, 'm')}",
            got=format_quantity(lift, "m"),
        )


def _named_lift(observables: xr.Dataset) -> dict[str, xr.DataArray]:
    """Return the readings of a lift pass under names of their own."""
    named = {}
    for name, array in observables.data_vars.items():
        meaning = f"{array.attrs['long_name']}, in the lift pass"
        named[f"{LIFT}{name}"] = array.assign_attrs(long_name=meaning)
    return named


# --- what is said, and what was true ---------------------------------------------------------------


def _sentences(states: xr.Dataset, lost: int, material: Sample, n_max: int, lift: float | None) -> list[str]:
    found = float((states["state"] == FOUND).mean())
    said = [
        f"Simulated data: model {material.model.key} on a motion with {n_max} harmonics; a steady state was found at "
        f"{100 * found:.4g} % of pixels. Readings are those of a virtual microscope, not corrected."
    ]
    if lost:
        said.append(
            f"The feedback lost the surface at {lost} of {states['A1'].size} pixels, where the lever swings freely."
        )
    if lift is not None:
        said.append(
            f"A lift pass {format_quantity(lift, 'm')} above the working height is in the variables {LIFT}..."
        )
    return said


def _truth(
    states: xr.Dataset, ground: xr.Dataset, levers: Sequence[Probe], probe: Probe, instrument: Instrument
) -> xr.Dataset:
    """Return states, properties of the map, and the lever of each line."""
    from overtone.instrument.toml import format_instrument

    modes = [lever.cantilever.modes[0] for lever in levers]
    by_line = {
        "frequency": ([mode.frequency for mode in modes], "Hz", "resonance of the lever"),
        "quality_factor": ([mode.quality_factor for mode in modes], "1", "quality factor of the lever"),
        "free_amplitude": (
            [lever.drive.free_amplitude for lever in levers],
            "m",
            "free amplitude of the lever",
        ),
    }
    truth = states.assign({name: ground[name] for name in ground.data_vars})
    for name, (values, unit, meaning) in by_line.items():
        line = np.broadcast_to(np.asarray(values), (ground.sizes["y"],)).copy()
        truth[name] = xr.Variable(("y",), line, {"units": unit, "long_name": meaning})
    truth.attrs = {"detector": probe.detector.kind, "instrument": format_instrument(instrument)}
    return provenance.record(truth, "scan_with_truth", probe=format_probe(probe))


# --- arguments -------------------------------------------------------------------------------------


def _check_numbers(setpoint: float, lift: float | None, time: float) -> None:
    bad = [] if 0.0 < setpoint < 1.0 else [f"setpoint = {setpoint!r} (between 0 and 1)"]
    bad += [] if lift is None or 0.0 < lift < math.inf else [f"lift = {lift!r} (metres above 0)"]
    bad += [] if math.isfinite(time) else [f"time = {time!r} (seconds)"]
    if bad:
        raise OvertoneError("this scan cannot be made", got="; ".join(bad))


def _checked(surface: xr.Dataset, size: float | None) -> xr.Dataset:
    """Return a map with its surface, over (y, x); or say what it lacks."""
    faults = [f"no dimension {dim}" for dim in _DIMS if dim not in surface.dims]
    faults += [f"no places {dim} [m]" for dim in _DIMS if dim in surface.dims and dim not in surface.coords]
    faults += [f"a dimension {dim}" for dim in surface.dims if dim not in _DIMS]
    faults += ["a size as well, although the map has places"] if size is not None else []
    if faults:
        raise OvertoneError(
            "this is no sample map",
            expected="properties over (y, x) with coordinates [m]",
            got="; ".join(map(str, faults)),
            hint="overtone.instrument.phantom.sample_map",
        )
    height = surface["height"] if "height" in surface else xr.zeros_like(surface["x"] * surface["y"])
    values = height.transpose(*_DIMS).values.astype(float)
    if not np.isfinite(values).all():
        raise OvertoneError("the surface of the map is not finite", got="NaN or infinity in height")
    ground = surface.transpose(*_DIMS).assign(height=named_variable("height", values, _DIMS))
    return ground.drop_attrs(deep=False)
