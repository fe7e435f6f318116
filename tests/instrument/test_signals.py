"""Observables as phasors: the way there, the way back, and the frame of the first harmonic."""

import math

import numpy as np
import xarray as xr

from overtone.instrument.signals import (
    Signals,
    in_the_frame_of_the_first,
    positions,
    signals_of,
    with_signals,
)

VALUES = {"A0": 1e-10, "A1": 4e-8, "phi1": 0.7, "A2": 1e-10, "phi2": 5.0, "A3": 3e-11, "phi3": 2.0}


def scan(shape: tuple[int, int] = (3, 4), **changes: float) -> xr.Dataset:
    generator = np.random.default_rng(1)
    arrays = {
        name: (("y", "x"), value * generator.uniform(0.5, 1.0, shape), {"units": "m"})
        for name, value in (VALUES | changes).items()
    }
    for name in arrays:
        if name.startswith("phi"):
            arrays[name][2]["units"] = "rad"
    coords = {"y": np.linspace(2e-6, 0.0, shape[0]), "x": np.linspace(0.0, 3e-6, shape[1])}
    return xr.Dataset(arrays, coords, {"source": "a file"})


def test_a_phasor_is_amplitude_and_lag() -> None:
    """q = A cos(n w t - phi) = Re(A exp(-i phi) exp(i n w t)), at any time."""
    given = scan()
    signals = signals_of(given)
    assert signals.orders == (0, 1, 2, 3)
    np.testing.assert_array_equal(signals.mean, given["A0"].values)
    for n in (1, 2, 3):
        for t in (0.0, 0.3, 2.0):
            motion = (signals.phasor[n] * np.exp(1j * n * t)).real
            expected = given[f"A{n}"].values * np.cos(n * t - given[f"phi{n}"].values)
            np.testing.assert_allclose(motion, expected, rtol=1e-12, atol=1e-14 * VALUES[f"A{n}"])


def test_there_and_back_again() -> None:
    given = scan().assign(height=(("y", "x"), np.ones((3, 4)), {"units": "m"}))
    given["A2"].attrs["note"] = "kept"
    back = with_signals(given, signals_of(given))
    assert back.attrs == given.attrs
    assert back["A2"].attrs["note"] == "kept"
    xr.testing.assert_identical(back["height"], given["height"])
    for name in VALUES:
        np.testing.assert_allclose(back[name], given[name], rtol=1e-12)
        assert back[name].dims == ("y", "x")


def test_what_was_not_measured_is_absent() -> None:
    alone = signals_of(scan().drop_vars(["A0", "phi2"]))
    assert alone.mean is None
    assert alone.orders == (1, 3)
    put = with_signals(scan().drop_vars("A0"), alone)
    assert "A0" not in put


def test_dimensions_follow_the_first_amplitude() -> None:
    given = scan()
    mixed = given.assign(A0=given["A0"].transpose("x", "y"), A2=given["A2"].isel(y=0, drop=True))
    signals = signals_of(mixed)
    np.testing.assert_array_equal(signals.mean, given["A0"].values)
    np.testing.assert_allclose(np.abs(signals.phasor[2]), np.tile(given["A2"].values[0], (3, 1)), rtol=1e-12)


def test_a_lost_phase_is_a_lost_pixel() -> None:
    given = scan()
    given["phi2"][1, 2] = math.inf
    given["phi1"][0, 0] = math.nan
    signals = signals_of(given)
    assert np.isnan(signals.phasor[2][1, 2])
    assert np.isfinite(signals.phasor[2]).sum() == 11
    assert np.isfinite(in_the_frame_of_the_first(signals)[3]).sum() == 11


def test_the_frame_of_the_first_forgets_the_origin_of_time() -> None:
    signals = signals_of(scan())
    later = Signals(signals.mean, {n: a * np.exp(-0.83j * n) for n, a in signals.phasor.items()})
    here, there = in_the_frame_of_the_first(signals), in_the_frame_of_the_first(later)
    assert sorted(here) == [2, 3]
    given = scan()
    for n in (2, 3):
        np.testing.assert_allclose(there[n], here[n], rtol=1e-12)
        turn = n * given["phi1"].values - given[f"phi{n}"].values
        np.testing.assert_allclose(here[n], given[f"A{n}"].values * np.exp(1j * turn), rtol=1e-12)


def test_positions_are_about_the_middle() -> None:
    height = 3e-6 + np.arange(12.0).reshape(3, 4) * 1e-9
    height[0, 0] = math.nan
    given = scan().assign(height=(("x", "y"), height.T))
    where = positions(given)
    known = np.isfinite(height)
    np.testing.assert_allclose(where.height[known], height[known] - height[known].mean(), rtol=1e-6)
    # a pixel without a height counts as the mean of those that have one
    assert where.height[0, 0] == 0.0
    np.testing.assert_allclose(where.x[1], np.linspace(-1.5e-6, 1.5e-6, 4), rtol=1e-12)
    np.testing.assert_allclose(where.y[:, 1], [1e-6, 0.0, -1e-6], rtol=1e-12, atol=1e-20)
    nowhere = positions(scan().drop_vars(["x", "y"]))
    assert all(part.shape == (3, 4) and not part.any() for part in nowhere)
