"""The virtual scan, signal by signal: what is in it is what was asked for, and nothing else."""

import json
import math
import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr

import overtone as ot
from overtone import provenance
from overtone.errors import OvertoneError, OvertoneWarning
from overtone.instrument.feedback import feedback_error
from overtone.instrument.instrument import Instrument, NearSurface, lever_at, noise_of
from overtone.instrument.low_pass import correlated, low_pass
from overtone.instrument.phantom import gradient, sample_map
from overtone.instrument.scan import scan_with_truth, simulate_scan
from overtone.probe import Probe
from overtone.readings import reading_of

PROBE = Probe.simple(
    stiffness=16.4,
    frequency=161.8e3,
    quality_factor=287.0,
    radius=10e-9,
    drive_frequency=161.8e3,
    free_amplitude=94e-9,
)
# no noise, and a lock-in that follows at once
QUIET = Instrument(detector_noise=0.0, temperature=1e-30, bandwidth=1e9)
SURFACE = gradient(shape=(12, 16), size=2e-6, relief=8e-9, poisson_ratio=0.35)
ORDERS = (1, 2, 3)


def scan(instrument: Instrument, surface: Any = SURFACE, **options: Any) -> tuple[xr.Dataset, xr.Dataset]:
    given = {"setpoint": 0.42, "seed": 4, "n_max": 6} | options
    return scan_with_truth(PROBE, surface, instrument, **given)


@pytest.fixture(scope="module")
def quiet() -> tuple[xr.Dataset, xr.Dataset]:
    return scan(QUIET)


def phasors(observables: xr.Dataset, n: int) -> np.ndarray:
    return np.asarray(observables[f"A{n}"].values * np.exp(-1j * observables[f"phi{n}"].values))


# --- an instrument that adds nothing ---------------------------------------------------------------


def test_a_perfect_instrument_reads_the_motion(quiet: tuple[xr.Dataset, xr.Dataset]) -> None:
    observables, truth = quiet
    assert observables["A1"].dims == ("direction", "y", "x")
    assert observables["direction"].values.tolist() == ["trace", "retrace"]
    states = ot.hold_amplitude(
        PROBE,
        ot.sample("dmt", modulus=SURFACE.modulus, adhesion=SURFACE.adhesion, poisson_ratio=0.35),
        setpoint=0.42,
        n_max=6,
        keep=6,
    )
    for way in range(2):
        one = observables.isel(direction=way)
        np.testing.assert_allclose(one["A0"].values, states["A0"].values, rtol=1e-9)
        for n in ORDERS:
            np.testing.assert_allclose(phasors(one, n), phasors(states, n), rtol=1e-8)
        # the base follows the surface at the height of the state
        np.testing.assert_allclose(
            one["height"].values, (SURFACE.height + states["Z"].values).values, rtol=1e-12
        )
    np.testing.assert_allclose(truth["indentation"].values, states["indentation"].values, rtol=1e-12)
    np.testing.assert_array_equal(truth["modulus"].values, SURFACE["modulus"].values)


def test_the_lever_of_each_line_gives_the_same_as_one_for_all(quiet: tuple[xr.Dataset, xr.Dataset]) -> None:
    observables, truth = scan(replace(QUIET, frequency_drift=1e-12))
    for name in ("A0", "A1", "phi1", "A2", "phi2", "height"):
        np.testing.assert_allclose(observables[name].values, quiet[0][name].values, rtol=1e-9)
    assert set(truth.data_vars) == set(quiet[1].data_vars)
    assert truth["F_cons"].dims == quiet[1]["F_cons"].dims


def test_trace_alone_is_the_trace(quiet: tuple[xr.Dataset, xr.Dataset]) -> None:
    noisy = Instrument(bandwidth=200.0)
    both, one = scan(noisy)[0], scan(noisy, retrace=False)[0]
    assert one.attrs["direction"] == "trace"
    assert one["A1"].dims == ("y", "x")
    for name in ("A0", "A1", "phi1", "A2", "phi2"):
        np.testing.assert_array_equal(one[name].values, both[name].values[0])
        assert (both[name].values[0] != both[name].values[1]).all()


# --- the mean deflection ---------------------------------------------------------------------------


def test_virtual_deflection_follows_height_and_place(quiet: tuple[xr.Dataset, xr.Dataset]) -> None:
    slopes = {"mean_slope_z": 4e-3, "mean_slope_x": 1e-4, "mean_slope_y": -3e-4, "mean_offset": 3e-11}
    observables, truth = scan(replace(QUIET, **slopes))
    added = (observables["A0"] - truth["A0"]).transpose("direction", "y", "x").values
    x, y = (
        np.broadcast_to(SURFACE[name].values.reshape(s), (12, 16))
        for name, s in (("x", (1, -1)), ("y", (-1, 1)))
    )
    design = np.stack([np.ones(192), observables["height"].values[0].ravel(), x.ravel(), y.ravel()], axis=-1)
    for way in range(2):
        found = np.linalg.lstsq(design / design.max(axis=0), added[way].ravel(), rcond=None)[0] / design.max(
            axis=0
        )
        np.testing.assert_allclose(found, [3e-11, 4e-3, 1e-4, -3e-4], rtol=1e-6)
    np.testing.assert_array_equal(phasors(observables, 2), phasors(quiet[0], 2))


def test_the_spot_drifts_in_the_order_of_the_lines() -> None:
    """Row 0 first; trace from left to right in half of a line's time, retrace back in the other half."""
    observables, truth = scan(replace(QUIET, mean_drift=1e-12, line_time=2.0), time=7.0)
    added = (observables["A0"] - truth["A0"]).transpose("direction", "y", "x").values / 1e-12
    pixel = 1.0 / 16
    row, column = np.mgrid[0:12, 0:16]
    np.testing.assert_allclose(added[0], 7.0 + 2.0 * row + (column + 1) * pixel, rtol=1e-6)
    np.testing.assert_allclose(added[1], 7.0 + 2.0 * row + 1.0 + (16 - column) * pixel, rtol=1e-6)


def test_a_lift_pass_doubles_the_time_of_a_line() -> None:
    observables, truth = scan(replace(QUIET, mean_drift=1e-12, line_time=2.0), lift=300e-9, retrace=False)
    added = (observables["A0"] - truth["A0"]).transpose("y", "x").values / 1e-12
    row, column = np.mgrid[0:12, 0:16]
    np.testing.assert_allclose(added, 4.0 * row + (column + 1) / 16, rtol=1e-6)
    np.testing.assert_allclose(
        observables["lift_A0"].values / 1e-12, 4.0 * row + 2.0 + (column + 1) / 16, rtol=1e-6
    )


def test_flicker_goes_on_from_line_to_line_and_pass_to_pass() -> None:
    """Neighbours in time are alike, and more so than pixels one above the other."""
    surface = gradient(shape=(32, 32), size=2e-6, relief=0.0, poisson_ratio=0.35)
    observables, truth = scan(replace(QUIET, flicker=20e-12, line_time=0.2), surface, n_max=1)
    noise = (observables["A0"] - truth["A0"]).transpose("direction", "y", "x").values
    in_time = np.concatenate([np.concatenate([noise[0, r], noise[1, r, ::-1]]) for r in range(32)])
    steps = np.diff(in_time)
    turns = np.abs(np.arange(steps.size) % 32 - 31) == 0
    assert steps[turns].std() == pytest.approx(steps[~turns].std(), rel=0.4, abs=0)
    assert steps.std() < 0.75 * np.diff(noise[0], axis=0).std()
    # int S df from the first line of the spectrum to the last, whose power a real series halves
    lines = np.arange(1, 1025) / (2048 * 0.2 / 64)
    expected = 20e-12 * math.sqrt(float(np.sum(1.0 / lines)) * lines[0])
    assert in_time.std() == pytest.approx(expected, rel=0.25, abs=0)


# --- the lever in time ------------------------------------------------------------------------------


def test_each_line_has_the_lever_of_its_time() -> None:
    drifting = replace(QUIET, frequency_drift=0.8, quality_drift=2e-4, drive_drift=-3e-4, line_time=1.5)
    observables, truth = scan(drifting, lift=400e-9, retrace=False)
    force = 94e-9 * 16.4 / 287.0
    for row in (0, 5, 11):
        t = row * 3.0 + 1.5 + 0.75  # the middle of the lift pass
        x = 161.8e3 / (161.8e3 + 0.8 * t)
        response = 1.0 / (16.4 * (1.0 - x**2 + 1j * x / (287.0 * (1.0 + 2e-4 * t))))
        line = observables.isel(y=row)
        np.testing.assert_allclose(
            line["lift_A1"].values, force * (1.0 - 3e-4 * t) * abs(response), rtol=1e-9
        )
        np.testing.assert_allclose(line["lift_phi1"].values, -np.angle(response), rtol=1e-9)
        assert float(truth["frequency"][row]) == pytest.approx(161.8e3 + 0.8 * (t - 1.5), rel=1e-12, abs=0)
    # the state of a line, by hand
    row, t = 7, 7 * 3.0 + 0.75
    lever = lever_at(PROBE, drifting, height=0.42 * 94e-9, time=t)
    material = ot.sample(
        "dmt", modulus=SURFACE.modulus[row], adhesion=SURFACE.adhesion[row], poisson_ratio=0.35
    )
    state = ot.hold_amplitude(
        lever, material, setpoint=0.42 * 94e-9 / lever.drive.free_amplitude, n_max=6, dims=("x",)
    )
    np.testing.assert_allclose(observables["phi1"].values[row], state["phi1"].values, rtol=1e-9)
    np.testing.assert_allclose(observables["A1"].values[row], 0.42 * 94e-9, rtol=1e-9)


def test_the_film_of_air_damps_the_scan_more_than_the_lift_pass() -> None:
    near = replace(QUIET, near_surface=NearSurface(0.2, 0.0, 500e-9))
    observables, truth = scan(near, lift=400e-9)
    share = 0.2 * math.exp(-(0.42 * 94e-9 + 400e-9) / 500e-9)
    np.testing.assert_allclose(observables["lift_A1"].values, 94e-9 * (1.0 - share), rtol=1e-9)
    below = 0.2 * math.exp(-0.42 * 94e-9 / 500e-9)
    np.testing.assert_allclose(truth["quality_factor"].values, 287.0 * (1.0 - below), rtol=1e-12)
    np.testing.assert_allclose(observables["A1"].values, 0.42 * 94e-9, rtol=1e-9)


# --- feedback --------------------------------------------------------------------------------------


def test_the_error_of_the_feedback_has_its_size_and_memory_and_is_larger_on_slopes() -> None:
    relief = np.zeros((200, 128))
    relief[:, 64:] = np.cumsum(np.ones((200, 64)), axis=1) * 1e-9
    error = feedback_error(Instrument(feedback_error=0.03), relief, np.random.default_rng(1))
    assert math.sqrt(np.mean(error**2)) == pytest.approx(0.03, rel=0.05, abs=0)
    flat, steep = error[:, :60], error[:, 68:]
    # all slope lies in one half: rms sqrt(1/2) of it, weights 1 and 1 + sqrt(2)
    assert steep.std() / flat.std() == pytest.approx(1.0 + math.sqrt(2.0), rel=0.1, abs=0)
    neighbours = np.mean(flat[:, 1:] * flat[:, :-1]) / np.mean(flat**2)
    assert neighbours == pytest.approx(math.exp(-1.0 / 3.0), abs=0.03)
    assert abs(np.mean(flat[1:] * flat[:-1]) / np.mean(flat**2)) < 0.03


def test_each_pixel_is_in_the_state_at_its_own_amplitude() -> None:
    observables, _ = scan(replace(QUIET, feedback_error=0.05), retrace=False)
    amplitude = observables["A1"].values
    assert np.std(amplitude / (0.42 * 94e-9)) == pytest.approx(0.05, rel=0.25, abs=0)
    for row, column in ((0, 3), (6, 9), (11, 15)):
        material = ot.sample(
            "dmt",
            modulus=float(SURFACE.modulus[row, column]),
            adhesion=float(SURFACE.adhesion[row, column]),
            poisson_ratio=0.35,
        )
        state = ot.hold_amplitude(PROBE, material, setpoint=amplitude[row, column] / 94e-9, n_max=6)
        for name in ("A0", "phi1", "A2", "phi2"):
            assert float(observables[name][row, column]) == pytest.approx(float(state[name]), rel=1e-7, abs=0)


def test_the_feedback_holds_what_the_detector_reads() -> None:
    """3 kappa_3 |a1|^2 = -1 % at A1far: at 0.42 of it the detector shows 0.8 % more than there is."""
    kappa3 = -0.01 / (3.0 * 94e-9**2)
    observables, truth = scan(replace(QUIET, distortion={3: kappa3}))
    np.testing.assert_allclose(observables["A1"].values, 0.42 * 94e-9, rtol=2e-5)
    amplitude = truth["A1"].values
    seen = amplitude * (1.0 - 0.01 * (amplitude / 94e-9) ** 2) / (1.0 - 0.01)
    np.testing.assert_allclose(seen, 0.42 * 94e-9, rtol=1e-6)
    assert (amplitude < 0.993 * 0.42 * 94e-9).all()


def test_where_the_feedback_loses_the_surface_the_lever_is_free() -> None:
    observables, truth = scan(replace(QUIET, feedback_error=0.1), setpoint=0.95, retrace=False)
    lost = ~np.isfinite(truth["peak_force"].values)
    assert 0.05 < lost.mean() < 0.6
    np.testing.assert_allclose(observables["A1"].values[lost], 94e-9, rtol=1e-12)
    np.testing.assert_allclose(observables["phi1"].values[lost], np.pi / 2, rtol=1e-12)
    assert (observables["A1"].values[~lost] < 94e-9).all()
    assert any(
        f"lost the surface at {lost.sum()} of 192" in text for text in provenance.findings(observables)
    )


# --- lift ------------------------------------------------------------------------------------------


def test_a_lift_pass_holds_virtual_deflection_and_background() -> None:
    kappa2 = 3e4
    instrument = replace(QUIET, mean_slope_z=4e-3, distortion={2: kappa2}, crosstalk={2: 2e-11j, 3: 5e-12})
    observables, _ = scan(instrument, lift=300e-9)
    height = observables["height"].values + 300e-9
    # |a1|^2 of the free amplitude beside the slope; s^2 of the spot that has moved
    shift = 4e-3 * height
    expected = shift + 2.0 * kappa2 * (shift**2 + 0.5 * 94e-9**2)
    np.testing.assert_allclose(observables["lift_A0"].values, expected, rtol=1e-9)
    background = kappa2 * (94e-9 * -1j) ** 2 + 2e-11j
    lifted = observables.drop_vars([n for n in observables.data_vars if not str(n).startswith("lift_")])
    lifted = lifted.rename({n: str(n).removeprefix("lift_") for n in lifted.data_vars})
    np.testing.assert_allclose(phasors(lifted, 2), background, rtol=1e-9)
    np.testing.assert_allclose(phasors(lifted, 3), 5e-12, rtol=1e-5)
    assert observables.attrs["lift_height"] == 300e-9


def test_a_lift_pass_that_would_tap_is_refused() -> None:
    with pytest.raises(OvertoneError, match="would touch the surface: expected more than"):
        scan(QUIET, lift=50e-9)


# --- lock-in ---------------------------------------------------------------------------------------


def edge() -> xr.Dataset:
    modulus = np.full((4, 32), 2e9)
    modulus[:, 16:] = 0.2e9
    return sample_map(size=2e-6, modulus=modulus, adhesion=5e-9, poisson_ratio=0.35)


def test_an_edge_lags_to_the_right_in_trace_and_to_the_left_in_retrace() -> None:
    """1 - exp(-k t/tau) after k pixels, tau = 1/(4 B)."""
    interval = 0.5 / 32
    slow = replace(QUIET, bandwidth=1.0 / (4.0 * 2.0 * interval))  # a time constant of two pixels
    observables, truth = scan(slow, edge())
    left, right = (truth.isel(x=k)["A0"].values[0] for k in (0, -1))
    assert abs(right - left) > 1e-12
    trace, retrace = observables["A0"].values[:, 2]
    k = np.arange(1, 17)
    reached = 1.0 - np.exp(-k / 2.0)
    np.testing.assert_allclose((trace[16:] - left) / (right - left), reached, rtol=1e-6)
    np.testing.assert_allclose(trace[:16], left, rtol=1e-9)
    np.testing.assert_allclose((retrace[:16][::-1] - right) / (left - right), reached, rtol=1e-6)
    np.testing.assert_allclose(retrace[16:], right, rtol=1e-9)
    # phasors are filtered, not amplitudes
    ends = phasors(truth, 2)[0, [0, -1]]
    np.testing.assert_allclose(
        phasors(observables, 2)[0, 0, 16:], ends[0] + (ends[1] - ends[0]) * reached, rtol=1e-6
    )


def test_a_lost_pixel_stays_lost_and_takes_no_other_with_it() -> None:
    values = np.array([[1.0, 1.0, np.nan, 5.0, 5.0], [np.nan, 2.0, 2.0, 2.0, 2.0]])
    out = low_pass(values, 0.5)
    np.testing.assert_array_equal(out, [[1.0, 1.0, np.nan, 3.0, 4.0], [np.nan, 2.0, 2.0, 2.0, 2.0]])
    turned = low_pass(values * 1j, 0.5)
    np.testing.assert_array_equal(turned.imag[0, 3:], [3.0, 4.0])


@pytest.mark.parametrize("decay", [0.0, 0.6])
def test_noise_is_as_large_as_stated_and_as_slow_as_the_filter(decay: float) -> None:
    noise = correlated((20000, 12), decay, np.random.default_rng(2))
    np.testing.assert_allclose(noise.std(axis=0), 1.0, rtol=0.02)
    np.testing.assert_allclose(np.mean(noise[:, 1:] * noise[:, :-1], axis=0), decay, atol=0.03)


def test_the_scan_is_as_noisy_as_its_instrument() -> None:
    surface = gradient(shape=(48, 48), size=2e-6, relief=0.0, poisson_ratio=0.35)
    noisy = replace(Instrument(), line_time=10.0)
    observables, truth = scan(noisy, surface, n_max=1)
    sigma = noise_of(noisy, PROBE)
    off = (observables["A0"] - truth["A0"]).values
    assert off.std() == pytest.approx(sigma["A0"], rel=0.05, abs=0)
    for n in ORDERS:
        off = phasors(observables, n) - phasors(truth, n)
        assert off.real.std() == pytest.approx(sigma[f"A{n}"], rel=0.05, abs=0)
        assert off.imag.std() == pytest.approx(sigma[f"A{n}"], rel=0.05, abs=0)


def test_the_seed_decides() -> None:
    noisy = Instrument(feedback_error=0.02, flicker=1e-12)
    small = gradient(shape=(3, 4), poisson_ratio=0.35)
    once, again, other = (scan(noisy, small, seed=seed, n_max=1)[0] for seed in (1, 1, 2))
    xr.testing.assert_identical(once, again)
    assert (once["A0"] != other["A0"]).all()
    # a lift pass changes nothing of what is drawn for the other
    lifted = scan(replace(noisy, flicker=0.0), small, n_max=1, lift=300e-9)[0]
    plain = scan(replace(noisy, flicker=0.0), small, n_max=1)[0]
    np.testing.assert_array_equal(lifted["A0"].values, plain["A0"].values)


# --- what it says ----------------------------------------------------------------------------------


def test_a_scan_says_that_it_is_simulated_and_not_what_is_true() -> None:
    instrument = replace(QUIET, near_surface=NearSurface(0.1), mean_offset=3.3e-11)
    observables, truth = scan(instrument)
    reading = reading_of(observables)
    assert reading is not None
    assert reading.probe == PROBE
    assert not reading.corrected
    assert reading.phase_established
    assert 0 in reading.doubts
    assert provenance.history(observables)[-1]["operation"] == "simulate_scan"
    assert any(text.startswith("Simulated data") for text in provenance.findings(observables))
    assert "33" not in json.dumps(provenance.history(observables))
    assert 'mean_offset = "33.0 pm"' in truth.attrs["instrument"]
    names = {"height"} | {f"{letter}{n}" for n in ORDERS for letter in ("A", "phi")} | {"A0"}
    assert set(observables.data_vars) == names
    xr.testing.assert_identical(
        simulate_scan(PROBE, SURFACE, instrument, setpoint=0.42, seed=4, n_max=6), observables
    )


def test_a_saved_scan_opens_again(tmp_path: Path) -> None:
    observables, _ = scan(replace(Instrument(), mean_slope_z=1e-3), lift=300e-9)
    ot.save(observables, tmp_path / "scan.nc")
    ot.save(observables, tmp_path / "scan.ibw")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", OvertoneWarning)
        for way, direction in enumerate(("trace", "retrace")):
            main = ot.open_scan(tmp_path / "scan.nc", direction=direction)
            above = ot.open_scan(tmp_path / "scan.nc", direction=direction, lift=True)
            for name in ("A0", "A1", "phi1", "A2", "phi2", "A3", "phi3", "height"):
                np.testing.assert_allclose(main[name].values, observables[name].values[way], rtol=1e-12)
            np.testing.assert_allclose(above["A0"].values, observables["lift_A0"].values[way], rtol=1e-12)
            igor = ot.open_scan(tmp_path / "scan.ibw", probe=PROBE, direction=direction)
            np.testing.assert_allclose(igor["A2"].values, observables["A2"].values[way], rtol=1e-6)
    reading = reading_of(main)
    assert reading is not None
    assert reading.phase_established
    assert not reading.corrected
    assert above.attrs["lift_height"] == 300e-9


# --- arguments -------------------------------------------------------------------------------------


def test_a_sample_is_scanned_like_a_map() -> None:
    material = ot.sample("dmt", modulus=SURFACE.modulus, adhesion=SURFACE.adhesion, poisson_ratio=0.35)
    flat = SURFACE.assign(height=SURFACE["height"] * 0.0)
    there, here = scan(QUIET, flat)[0], scan(QUIET, material, size=2e-6)[0]
    for name in ("A0", "A1", "phi1", "height", "x", "y"):
        np.testing.assert_allclose(here[name].values, there[name].values, rtol=1e-12)
    with pytest.raises(OvertoneError, match="lacks places"):
        scan(QUIET, material)
    with pytest.raises(OvertoneError, match="its own model"):
        scan(QUIET, material, size=2e-6, model="dmt")


def test_a_viscous_map_loses_energy() -> None:
    viscous = gradient(modulus=(1e9, 3e9), shape=(3, 4), viscosity=100.0, poisson_ratio=0.35)
    _, truth = scan(QUIET, viscous)
    assert (truth["dissipation"] > 1e-19).all()
    assert (truth["viscosity"] == 100.0).all()


def test_a_pixel_without_a_state_is_lost_alone_and_counted() -> None:
    """So viscous and soft that the drive cannot feed the loss."""
    viscous = gradient(modulus=(1e8, 3e9), shape=(3, 4), viscosity=100.0, poisson_ratio=0.35)
    observables, truth = scan(replace(QUIET, bandwidth=20.0), viscous)
    lost = truth["state"].values != 0
    assert lost.sum() == 1
    assert lost[0, 0]
    for name in ("A0", "A1", "phi2", "height"):
        np.testing.assert_array_equal(np.isnan(observables[name].values), np.stack([lost, lost]))
    assert any("at 91.67 % of pixels" in text for text in provenance.findings(observables))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"setpoint": 1.2, "lift": -1.0, "time": math.nan}, "setpoint = 1.2 .*; lift = -1.0 .*; time = nan"),
        ({"size": 1e-6}, "no sample map: .*the map has places"),
        ({"poisson_ratio": 0.3}, "of its own"),
        ({"model": "hertz"}, "'hertz' has no adhesion"),
        ({"regime": "soft"}, "unknown regime"),
    ],
)
def test_wrong_calls_are_refused(options: dict[str, Any], message: str) -> None:
    with pytest.raises(OvertoneError, match=message):
        scan(QUIET, **options)


def test_maps_without_places_or_with_holes_are_refused() -> None:
    with pytest.raises(OvertoneError, match=r"no places y \[m\]; no places x"):
        scan(QUIET, SURFACE.drop_vars(["x", "y"]))
    with pytest.raises(OvertoneError, match="not finite"):
        scan(QUIET, SURFACE.assign(height=SURFACE["height"] * np.nan))


def test_a_set_point_that_the_lever_cannot_reach_is_named() -> None:
    with pytest.raises(OvertoneError, match="never reaches the surface"):
        scan(replace(QUIET, near_surface=NearSurface(damping=0.7)))
    with pytest.raises(OvertoneError, match="in line 12"):
        scan(replace(QUIET, drive_drift=-0.055))
    with pytest.raises(OvertoneError, match="larger than the set-point"):
        scan(replace(QUIET, feedback_error=1.0))
