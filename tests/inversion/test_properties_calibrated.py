"""Property maps of corrected scans: errors that the whole scan shares are in the range of moduli."""

import math
import warnings
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import xarray as xr

from overtone.contact.sample import sample
from overtone.demo import demo_probe
from overtone.dynamics.hold import hold_amplitude
from overtone.errors import CalibrationWarning
from overtone.instrument.approach_fit import Reference
from overtone.instrument.calibrate import calibrate
from overtone.instrument.calibration import Calibration, format_calibration
from overtone.instrument.correct import calibration_of, correct
from overtone.instrument.curve import simulate_far_field
from overtone.instrument.instrument import Instrument, readings
from overtone.instrument.phantom import blend
from overtone.instrument.photodiode import SplitDiode
from overtone.inversion.properties import map_properties
from overtone.quantities import named_array
from overtone.readings import Reading, probe_of, with_reading

NOISE = {"A0": 1e-12, "A1": 20e-12, "phi1": 3e-4, "A2": 1.4e-12, "A3": 1.6e-12}
MICROSCOPE = Instrument(
    diode=SplitDiode(500e-9, offset=25e-9),
    gains={0: 1.03, 2: 0.92, 3: 0.9},
    latency={2: 0.3, 3: 0.4},
    crosstalk={2: 50e-12 * np.exp(1j), 3: 20e-12j},
    phase_offset=0.1,
    mean_offset=2e-9,
    mean_slope_z=2e-3,
)
NAMES = ["A0", *(f"{letter}{n}" for n in range(1, 7) for letter in ("A", "phi"))]


def calibration() -> Calibration:
    """Return a calibration on PS, from a curve and a frequency ladder."""
    probe = demo_probe()
    held = hold_amplitude(
        probe,
        sample("dmt", modulus=1.93e9, poisson_ratio=0.35, adhesion=1.91e-9),
        setpoint=np.linspace(0.2, 0.985, 100),
        n_max=6,
        keep=6,
    )
    z = np.concatenate([held["Z"].values, np.linspace(130e-9, 330e-9, 50)])
    free = {"A1": 94e-9, "phi1": math.pi / 2}
    arrays = {
        name: named_array(name, np.concatenate([held[name].values, np.full(50, free.get(name, 0.0))]), ("z",))
        for name in NAMES
    }
    motion = xr.Dataset(arrays, {"z": ("z", z)}).sortby("z", ascending=False)
    generator = np.random.default_rng(2)
    shift = MICROSCOPE.mean_slope_z * motion["z"].values
    curve = readings(motion, MICROSCOPE, probe, shift=shift, generator=generator).assign_coords(z=motion["z"])
    ladder = simulate_far_field(probe, MICROSCOPE, height=300e-9, seed=3)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", CalibrationWarning)
        return calibrate(
            curve,
            probe,
            reference=Reference(0.35, modulus=1.93e9, name="PS"),
            far_field=ladder,
            height_noise=0.02e-9,
        )


@pytest.fixture(scope="module")
def scan() -> tuple[xr.Dataset, xr.Dataset]:
    """Return a corrected scan of a blend and its surface."""
    probe, surface = demo_probe(), blend(shape=(24, 24), seed=5, size=2e-6)
    material = sample(
        "dmt", modulus=surface["modulus"].values, poisson_ratio=0.35, adhesion=surface["adhesion"].values
    )
    held = hold_amplitude(probe, material, setpoint=0.42, n_max=6, keep=6)
    height = held["Z"].values + surface["height"].values
    arrays = {name: named_array(name, held[name].values, ("y", "x"), surface.coords) for name in NAMES}
    arrays["height"] = named_array("height", height, ("y", "x"), surface.coords)
    later = replace(MICROSCOPE, phase_offset=0.1 + math.radians(0.4), mean_offset=2.1e-9)
    raw = readings(xr.Dataset(arrays), later, probe, shift=2e-3 * height, generator=np.random.default_rng(6))
    return correct(with_reading(raw, Reading(probe)), calibration()), surface


def mapped(corrected: xr.Dataset, **arguments: Any) -> xr.Dataset:
    asked: dict[str, Any] = {
        "method": "least-squares",
        "model": "dmt",
        "poisson_ratio": 0.35,
        "harmonics": (1, 2, 3),
        "noise": NOISE,
    }
    return map_properties(corrected, probe_of(corrected), **asked | arguments)


def without(corrected: xr.Dataset) -> xr.Dataset:
    """Return the same numbers without a word of the calibration."""
    return (
        corrected.assign_attrs({n: v for n, v in corrected.attrs.items() if n != "calibration"})
        .drop_attrs(deep=False)
        .assign_attrs({n: v for n, v in corrected.attrs.items() if n != "calibration"})
    )


def changed(corrected: xr.Dataset, change: Callable[[Calibration], Calibration]) -> xr.Dataset:
    left = calibration_of(corrected)
    assert left is not None
    return corrected.assign_attrs(calibration=format_calibration(change(left)))


def only(name: str, error: float) -> Callable[[Calibration], Calibration]:
    """Return what leaves a calibration with one uncertain unknown."""

    def change(left: Calibration) -> Calibration:
        covariance = np.zeros_like(left.covariance)
        index = left.names.index(name)
        covariance[index, index] = error**2
        return replace(left, covariance=covariance)

    return change


def width(result: xr.Dataset, where: np.ndarray) -> np.ndarray:
    values: np.ndarray = np.log(result["modulus_upper"].values / result["modulus_lower"].values)[where]
    return values


@pytest.fixture(scope="module")
def results(scan: tuple[xr.Dataset, xr.Dataset]) -> tuple[xr.Dataset, xr.Dataset]:
    corrected, _ = scan
    return mapped(corrected), mapped(without(corrected))


def test_ranges_hold_the_soft_truth_and_are_wider_than_those_of_noise(
    scan: tuple[xr.Dataset, xr.Dataset], results: tuple[xr.Dataset, xr.Dataset]
) -> None:
    _, surface = scan
    soft = surface["material"].values == 1
    whole, noise_only = results
    truth = surface["modulus"].values[soft]
    held = (whole["modulus_lower"].values[soft] <= truth) & (truth <= whole["modulus_upper"].values[soft])
    assert held.mean() > 0.93
    assert (width(whole, soft) > width(noise_only, soft)).all()
    assert np.median(width(whole, soft)) > 1.1 * np.median(width(noise_only, soft))
    ratio = whole["modulus_unscreened"].values[soft] / truth
    assert abs(np.log(np.median(ratio))) < 0.15


def test_the_estimate_itself_is_the_same(results: tuple[xr.Dataset, xr.Dataset]) -> None:
    whole, noise_only = results
    xr.testing.assert_equal(
        whole["modulus_unscreened"].drop_attrs(), noise_only["modulus_unscreened"].drop_attrs()
    )
    assert (whole["uncertainty"] >= noise_only["uncertainty"]).all()


def test_the_mean_deflection_decides_how_wide(scan: tuple[xr.Dataset, xr.Dataset]) -> None:
    """Harmonics 0, 1, 2: one picometre of A0 that all pixels share opens the range of the soft ones."""
    corrected, surface = scan
    soft = surface["material"].values == 1
    sharp = changed(corrected, only("A0_offset", 0.05e-12))
    open_ = changed(corrected, only("A0_offset", 2e-12))
    one, other = (mapped(c, harmonics=(0, 1, 2)) for c in (sharp, open_))
    assert np.median(width(other, soft)) > 1.2 * np.median(width(one, soft))


def test_the_radius_widens_by_half_its_relative_error(
    scan: tuple[xr.Dataset, xr.Dataset], results: tuple[xr.Dataset, xr.Dataset]
) -> None:
    """E* goes as 1/sqrt(R): 20 % of R are 10 % of E, at 90 % 1.645 times that, beside all else."""
    corrected, surface = scan
    soft = surface["material"].values == 1
    noise_only = results[1]
    result = mapped(changed(corrected, only("radius", 0.2)))
    found = np.log(result["modulus_unscreened"].values[soft])
    for name, sign in (("modulus_upper", 1.0), ("modulus_lower", -1.0)):
        before = sign * (np.log(noise_only[name].values[soft]) - found)
        after = sign * (np.log(result[name].values[soft]) - found)
        np.testing.assert_allclose(after**2 - before**2, (1.6449 * 0.5 * 0.2) ** 2, rtol=2e-3)
    np.testing.assert_allclose(
        result["uncertainty"].values[soft] ** 2 - noise_only["uncertainty"].values[soft] ** 2, 0.01, rtol=1e-3
    )


def test_a_certain_calibration_changes_nothing(
    scan: tuple[xr.Dataset, xr.Dataset], results: tuple[xr.Dataset, xr.Dataset]
) -> None:
    certain = mapped(changed(scan[0], only("gain2", 0.0)))
    for name in ("modulus_lower", "modulus_upper", "uncertainty"):
        np.testing.assert_allclose(certain[name], results[1][name], rtol=1e-12)


def test_a_shared_gain_counts_as_it_is(scan: tuple[xr.Dataset, xr.Dataset]) -> None:
    """The linearised error against a refit with the gain moved by it."""
    corrected, surface = scan
    soft = surface["material"].values == 1
    error = 0.004
    exact = dict.fromkeys(NOISE, 1e-16)
    stated = mapped(changed(corrected, only("gain2", error)), noise=exact)
    moved = mapped(without(corrected).assign(A2=corrected["A2"] / (1.0 + error)), noise=exact)
    here = np.log(stated["modulus_unscreened"].values[soft])
    there = np.log(moved["modulus_unscreened"].values[soft])
    fits = stated["residual"].values[soft] < 1e-3
    assert fits.sum() > 10
    np.testing.assert_allclose(
        stated["uncertainty"].values[soft][fits], np.abs(there - here)[fits], rtol=0.15
    )
