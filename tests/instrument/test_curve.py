"""Simulated calibration data: the free lever over frequencies and drives, and approach curves."""

import math
import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr

import overtone as ot
from overtone.errors import OvertoneError, OvertoneWarning
from overtone.instrument.curve import simulate_approach, simulate_far_field
from overtone.instrument.far_field import far_field, ladder_points
from overtone.instrument.instrument import Instrument, NearSurface, lever_at, noise_of
from overtone.io.curves import open_curve
from overtone.probe import BASE, Probe

PROBE = Probe.simple(
    stiffness=16.4,
    frequency=161.8e3,
    quality_factor=287.0,
    radius=10e-9,
    drive_frequency=161.75e3,
    free_amplitude=94e-9,
)
QUIET = Instrument(detector_noise=0.0, temperature=1e-30, bandwidth=1e9)
POLYMER = ot.sample("dmt", modulus=1e9, poisson_ratio=0.35, adhesion=10e-9)
HEIGHTS = np.linspace(200e-9, 20e-9, 46)


def phasors(observables: xr.Dataset, n: int) -> np.ndarray:
    return np.asarray(observables[f"A{n}"].values * np.exp(-1j * observables[f"phi{n}"].values))


# --- far field -------------------------------------------------------------------------------------


def response(f: np.ndarray, frequency: float = 161.8e3, quality: float = 287.0) -> np.ndarray:
    x = f / frequency
    return np.asarray(1.0 / (1.0 - x**2 + 1j * x / quality))


def test_a_free_lever_follows_its_resonance() -> None:
    ladder = simulate_far_field(PROBE, QUIET, height=1e-6, drives=(1.0, 0.5), seed=0)
    assert ladder["A1"].dims == ("point",)
    f = ladder["frequency"].values
    width = 161.8e3 / 287.0
    np.testing.assert_allclose(f[:15], 161.8e3 + width * np.linspace(-1.5, 1.5, 15), rtol=1e-12)
    expected = 94e-9 * response(f) / abs(response(np.array(161.75e3))) * ladder["drive"].values
    np.testing.assert_allclose(phasors(ladder, 1), expected, rtol=1e-9)
    assert 0.3 < float(ladder["A1"][0] / ladder["A1"].max()) < 0.35
    assert (ladder["z"] == 1e-6).all()


def test_a_driven_base_drives_more_at_higher_frequencies() -> None:
    probe = replace(PROBE, drive=replace(PROBE.drive, acts_on=BASE))
    f = np.array([150e3, 161.75e3, 180e3])
    ladder = simulate_far_field(probe, QUIET, height=1e-6, frequencies=f, seed=0)
    expected = 94e-9 * response(f) / abs(response(f[1])) * (f / f[1]) ** 2
    np.testing.assert_allclose(phasors(ladder, 1), expected, rtol=1e-9)


def test_the_lever_of_a_ladder_is_that_of_its_height_and_time() -> None:
    instrument = replace(QUIET, near_surface=NearSurface(0.1, 0.0, 1e-6), frequency_drift=0.5)
    f = np.full(4, 161.75e3)
    ladder = simulate_far_field(
        PROBE, instrument, height=2e-6, frequencies=f, interval=10.0, time=5.0, seed=0
    )
    quality = 287.0 * (1.0 - 0.1 * math.exp(-2.0))
    for k, t in enumerate((15.0, 25.0, 35.0, 45.0)):
        a = 94e-9 * response(f[k], 161.8e3 + 0.5 * t, quality) / abs(response(np.array(161.75e3)))
        assert phasors(ladder, 1)[k] == pytest.approx(complex(a), rel=1e-9, abs=0)


def test_a_ladder_scatters_by_the_noise_and_drifts() -> None:
    noisy = Instrument(mean_drift=1e-12, mean_slope_z=2e-3, mean_offset=1e-11)
    ladder = simulate_far_field(
        PROBE, noisy, height=1e-6, frequencies=np.full(20000, 161.75e3), interval=1e-3, seed=3
    )
    sigma = noise_of(noisy, PROBE)
    for n in (1, 2, 3):
        assert phasors(ladder, n).real.std() == pytest.approx(sigma[f"A{n}"], rel=0.03, abs=0)
    time = np.arange(1, 20001) * 1e-3
    slope, start = np.polyfit(time, ladder["A0"].values, 1)
    assert slope == pytest.approx(1e-12, rel=0.02, abs=0)
    assert start == pytest.approx(2e-3 * 1e-6 + 1e-11, rel=1e-3, abs=0)
    assert (ladder["A0"].values - slope * time).std() == pytest.approx(sigma["A0"], rel=0.03, abs=0)


def test_a_ladder_gives_back_the_instrument() -> None:
    """Distortion and crosstalk out of the regression that calibrates with it."""
    kappa2, kappa3 = 8e3, -2e10
    instrument = replace(
        Instrument(bandwidth=100.0), distortion={2: kappa2, 3: kappa3}, crosstalk={2: 2e-11 + 3e-11j}
    )
    ladder = simulate_far_field(PROBE, instrument, height=1e-6, seed=8)
    points = ladder_points(ladder)
    np.testing.assert_array_equal(points.drive, 1.0)
    np.testing.assert_array_equal(points.height, 1e-6)
    found = far_field(points, reference=94e-9).values
    total = sum(found[f"distortion2_{j}_re"] for j in range(3))
    assert total == pytest.approx(kappa2 * 94e-9**2, rel=0.03, abs=0)
    assert found["crosstalk2_re"] == pytest.approx(2e-11, abs=1.5e-12)
    assert found["crosstalk2_im"] == pytest.approx(3e-11, abs=1.5e-12)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"height": 50e-9}, "not free"),
        ({"height": 1e-6, "drives": (), "interval": 0.0}, "got drives, interval"),
        ({"height": math.inf, "frequencies": [-1.0]}, "got frequencies, height"),
    ],
)
def test_ladders_that_make_no_sense_are_refused(options: dict[str, Any], message: str) -> None:
    with pytest.raises(OvertoneError, match=message):
        simulate_far_field(PROBE, QUIET, seed=0, **options)


# --- approach --------------------------------------------------------------------------------------


def approach(instrument: Instrument, **options: Any) -> xr.Dataset:
    given = {"z": HEIGHTS, "seed": 1, "n_max": 6} | options
    return simulate_approach(PROBE, POLYMER, instrument, **given)


def test_a_perfect_instrument_reads_the_curve() -> None:
    curve = approach(QUIET)
    expected = ot.approach_curve(PROBE, POLYMER, z=HEIGHTS, n_max=6, keep=6)
    assert curve["A1"].dims == ("direction", "z")
    assert curve["z"].attrs["zero"] == "surface"
    np.testing.assert_allclose(curve["A0"].values, expected["A0"].values, rtol=1e-9, atol=1e-20)
    for n in (1, 2):
        np.testing.assert_allclose(phasors(curve, n), phasors(expected, n), rtol=1e-8, atol=1e-19)


def test_every_point_has_the_lever_of_its_height_and_time() -> None:
    instrument = replace(
        QUIET, near_surface=NearSurface(0.1, 3e-4, 1e-6), frequency_drift=2.0, drive_drift=-1e-3
    )
    curve = approach(instrument, speed=100e-9, time=3.0)
    step = 4e-9 / 100e-9
    for way, k in ((0, 1), (0, 20), (1, 1), (0, 40), (1, 44), (1, 33)):
        z = HEIGHTS[k]
        t = 3.0 + step * (k + 1 if way == 0 else 46 + 46 - k)
        lever = lever_at(PROBE, instrument, height=z, time=t)
        states = ot.steady_states(lever, POLYMER, z=z, n_max=6).isel(z=0)
        off = np.abs(states["A1"].values - float(curve["A1"][way, k]))
        branch = int(np.nanargmin(off))
        assert bool(states["stable"][branch])
        # out of contact attraction is weak, and taken as that of the lever in the middle of the curve
        free = float(curve["A1"][way, k]) > 0.97 * lever.drive.free_amplitude
        for name in ("A1", "phi1"):
            tolerance = 1e-5 if free else 1e-8
            assert float(curve[name][way, k]) == pytest.approx(
                float(states[name][branch]), rel=tolerance, abs=0
            )


def test_where_attraction_is_weak_the_lever_is_followed_as_closely() -> None:
    """From hardly any force to a per mille of the drive: solved or scaled, each point is in its own state."""
    near = replace(QUIET, near_surface=NearSurface(0.05, 0.0, 1e-6))
    heights = np.linspace(140e-9, 93e-9, 24)
    curve = approach(near, z=heights)
    for k, z in enumerate(heights):
        states = ot.steady_states(lever_at(PROBE, near, height=z), POLYMER, z=z, n_max=6).isel(z=0, branch=0)
        assert float(curve["A1"][0, k]) == pytest.approx(float(states["A1"]), rel=1e-5, abs=0)
        assert float(curve["phi1"][0, k]) == pytest.approx(float(states["phi1"]), rel=1e-5, abs=0)


def test_the_mean_follows_height_and_time() -> None:
    instrument = replace(QUIET, mean_slope_z=3e-3, mean_drift=1e-12, mean_offset=2e-11)
    curve, plain = approach(instrument, speed=100e-9), approach(QUIET)
    added = (curve["A0"] - plain["A0"]).values
    step = 4e-9 / 100e-9
    k = np.arange(46)
    np.testing.assert_allclose(added[0], 2e-11 + 3e-3 * HEIGHTS + 1e-12 * step * (k + 1), rtol=1e-6)
    np.testing.assert_allclose(added[1], 2e-11 + 3e-3 * HEIGHTS + 1e-12 * step * (92 - k), rtol=1e-6)


def test_flicker_goes_on_where_the_base_turns_round() -> None:
    """The last reading of the approach and the first of the retract are neighbours in time."""
    heights = np.linspace(400e-9, 300e-9, 40)
    plain = approach(QUIET, z=heights)["A0"].values
    turns, ends = [], []
    for seed in range(40):
        noise = approach(replace(QUIET, flicker=10e-12), z=heights, seed=seed)["A0"].values - plain
        turns.append(noise[1, -1] - noise[0, -1])
        ends.append(noise[1, -20] - noise[0, -20])
    assert np.std(turns) < 0.7 * np.std(ends)
    assert np.std(turns) > 1e-12


def test_a_slow_lock_in_lags_there_and_back() -> None:
    """Each reading closes 1 - exp(-t/tau) of what is between it and the motion, in the order of time."""
    slow = replace(QUIET, bandwidth=1.0 / (4.0 * 0.1))
    uneven = np.concatenate([np.linspace(130e-9, 82e-9, 13), np.linspace(80e-9, 40e-9, 21)])
    curve, plain = (approach(instrument, z=uneven, speed=100e-9) for instrument in (slow, QUIET))
    gaps = -np.diff(uneven) / 100e-9
    for way, steps in ((0, gaps), (1, gaps[::-1])):
        turn = slice(None, None, -1 if way else 1)
        there, seen = phasors(plain, 1)[way, turn], phasors(curve, 1)[way, turn]
        state, expected = there[0], [there[0]]
        for a, step in zip(there[1:], steps, strict=True):
            state = state + (a - state) * (1.0 - math.exp(-step / 0.1))
            expected.append(state)
        np.testing.assert_allclose(seen, expected, rtol=1e-8)
        assert np.abs(seen - there).max() > 1e-9


def test_noise_of_the_height_moves_the_amplitude_in_contact() -> None:
    curve = approach(QUIET, height_noise=0.2e-9, z=np.linspace(80e-9, 30e-9, 101))
    plain = approach(QUIET, z=np.linspace(80e-9, 30e-9, 101))
    off = (curve["A1"] - plain["A1"]).values
    slope = np.gradient(plain["A1"].values[0], plain["z"].values)
    assert off.std() == pytest.approx(0.2e-9 * slope.mean(), rel=0.15, abs=0)
    assert np.abs(np.corrcoef(off[0], off[1])[0, 1]) < 0.35


def test_a_saved_curve_opens_again(tmp_path: Path) -> None:
    curve = approach(Instrument())
    ot.save(curve, tmp_path / "curve.nc")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", OvertoneWarning)
        opened = open_curve(tmp_path / "curve.nc", direction="retract")
    assert opened["z"].attrs["zero"] == "surface"
    np.testing.assert_allclose(opened["A2"].values, curve["A2"].values[1], rtol=1e-12)


def test_curves_that_make_no_sense_are_refused() -> None:
    with pytest.raises(OvertoneError, match="one material"):
        simulate_approach(
            PROBE, ot.sample("hertz", modulus=[1e9, 2e9], poisson_ratio=0.3), QUIET, z=HEIGHTS, seed=0
        )
    with pytest.raises(OvertoneError, match="speed, time"):
        approach(QUIET, speed=0.0, time=math.inf)
    with pytest.raises(OvertoneError, match="noise of the height"):
        approach(QUIET, height_noise=-1e-9)
    with pytest.raises(OvertoneError, match="not numbers"):
        approach(QUIET, z="high")
