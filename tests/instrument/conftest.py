"""A virtual laboratory for calibrations and corrections: a lever, a microscope that adds to it, curves and scans."""

import warnings
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import xarray as xr

from overtone.contact.sample import Sample, sample
from overtone.demo import demo_probe
from overtone.dynamics.hold import hold_amplitude
from overtone.errors import CalibrationWarning
from overtone.harmonics import far_phase
from overtone.instrument.approach_fit import Reference
from overtone.instrument.calibrate import calibrate
from overtone.instrument.calibration import Calibration
from overtone.instrument.curve import simulate_far_field
from overtone.instrument.instrument import Instrument, lever_at, readings
from overtone.instrument.photodiode import SplitDiode
from overtone.probe import Probe
from overtone.quantities import named_array
from overtone.readings import Reading, with_reading

HEIGHT_NOISE = 0.05e-9
_FAR = (130e-9, 330e-9)


@pytest.fixture(scope="session")
def lever() -> Probe:
    return demo_probe()


@pytest.fixture(scope="session")
def microscope() -> Instrument:
    """Return what the microscope adds: everything at once."""
    return Instrument(
        diode=SplitDiode(500e-9, offset=25e-9),
        gains={0: 1.03, 2: 0.92, 3: 0.9},
        latency={2: 0.3, 3: 0.4},
        crosstalk={2: 50e-12 * np.exp(1j), 3: 20e-12j},
        phase_offset=0.1,
        mean_offset=2e-9,
        mean_slope_z=2e-3,
    )


@pytest.fixture(scope="session")
def stiff() -> Sample:
    return sample("dmt", modulus=1.93e9, poisson_ratio=0.35, adhesion=1.91e-9)


@pytest.fixture(scope="session")
def soft() -> Sample:
    return sample("dmt", modulus=93.78e6, poisson_ratio=0.35, adhesion=16.24e-9)


def harmonics(keep: int = 6) -> list[str]:
    return ["A0", *(f"{letter}{n}" for n in range(1, keep + 1) for letter in ("A", "phi"))]


@pytest.fixture(scope="session")
def motion_of() -> Callable[..., xr.Dataset]:
    """Return the motion of an approach curve over z: repulsive states, and free."""

    def motion(
        probe: Probe,
        material: Sample,
        instrument: Instrument,
        *,
        points: int = 120,
        far: int = 60,
        deepest: float = 0.2,
    ) -> xr.Dataset:
        near = lever_at(probe, instrument, height=0.0)
        setpoint = np.linspace(0.2, 0.985, points)
        held = hold_amplitude(near, material, setpoint=setpoint, n_max=6, keep=6)
        above = np.linspace(*_FAR, far)
        levers = [lever_at(probe, instrument, height=float(height)) for height in above]
        z = np.concatenate([held["Z"].values, above])
        arrays = {}
        for name in harmonics():
            free = np.zeros(far)
            if name == "A1":
                free = np.array([there.drive.free_amplitude for there in levers])
            if name == "phi1":
                free = np.array([far_phase(there) for there in levers])
            values = np.concatenate([held[name].values, free])
            arrays[name] = named_array(name, values, ("z",))
        return xr.Dataset(arrays, {"z": ("z", z, {"units": "m"})}).sortby("z", ascending=False)

    return motion


@pytest.fixture(scope="session")
def read_curve() -> Callable[..., xr.Dataset]:
    """Return what the microscope stores of a curve, its heights from an unknown origin and with an error."""

    def read(
        motion: xr.Dataset, probe: Probe, instrument: Instrument, *, seed: int, noise: float = HEIGHT_NOISE
    ) -> xr.Dataset:
        generator = np.random.default_rng(seed)
        z = motion["z"].values
        raw = readings(motion, instrument, probe, shift=instrument.mean_slope_z * z, generator=generator)
        z = z + 777e-9 + generator.normal(0.0, noise, z.size) if noise else z + 777e-9
        raw = raw.assign_coords(z=("z", z, {"units": "m"}))
        raw.attrs["source"] = "curve"
        return with_reading(raw, Reading(probe))

    return read


@pytest.fixture(scope="session")
def read_ladder() -> Callable[..., xr.Dataset]:
    """Return a frequency ladder of the free lever, as the microscope stores it."""

    def read(probe: Probe, instrument: Instrument, *, seed: int) -> Any:
        return simulate_far_field(probe, instrument, height=300e-9, seed=seed)

    return read


@pytest.fixture(scope="session")
def calibrated(
    lever: Probe,
    microscope: Instrument,
    stiff: Sample,
    motion_of: Callable[..., xr.Dataset],
    read_curve: Callable[..., xr.Dataset],
    read_ladder: Callable[..., xr.Dataset],
) -> Calibration:
    """Return a calibration on the stiff reference, its modulus stated 4 % too high and known to 10 %."""
    raw = read_curve(motion_of(lever, stiff, microscope), lever, microscope, seed=3)
    ladder = read_ladder(lever, microscope, seed=4)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", CalibrationWarning)
        return calibrate(
            raw,
            lever,
            reference=Reference(0.35, modulus=2e9, name="PS"),
            far_field=ladder,
            height_noise=HEIGHT_NOISE,
        )
