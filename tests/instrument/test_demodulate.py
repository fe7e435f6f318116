"""What comes out of a trace against what was put into it: phasors, their noise and their time."""

import json
import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import xarray as xr

import overtone as ot
from overtone import provenance
from overtone.errors import (
    DistortionWarning,
    ObservablesError,
    OvertoneError,
    UnitError,
)
from overtone.instrument.demodulate import demodulate, noise_of
from overtone.instrument.lockin import NOISE_WIDTH
from overtone.io.netcdf import load, save

RATE, FREQUENCY = 2e6, 161_803.4
FLOOR = 25e-15  # m/sqrt(Hz)
AMPLITUDES = {0: 3e-12, 1: 50e-9, 2: 20e-12, 3: 8e-12}
LAGS = {1: 1.3, 2: 0.7, 3: 4.1}


def times(count: int) -> np.ndarray:
    return np.arange(count) / RATE


def trace(
    theta: np.ndarray, *, noise: float = 0.0, lag: Any = LAGS[1], amplitudes: dict[int, float] = AMPLITUDES
) -> np.ndarray:
    """Return ``A0 + sum A_n cos(n theta - phi_n)``; where phi1 moves by e, phi_n moves by n e."""
    q = np.full(theta.shape, amplitudes[0])
    for n, A in amplitudes.items():
        if n:
            q += A * np.cos(n * theta - LAGS[n] - n * (lag - LAGS[1]))
    white = noise * math.sqrt(RATE / 2.0)
    return q + np.random.default_rng(7).normal(0.0, white, theta.size) if noise else q


def phase(t: np.ndarray, drift: float = 0.0, start: float = 0.0) -> np.ndarray:
    return 2 * np.pi * (FREQUENCY * t + 0.5 * drift * t**2) + start


def angle(x: Any) -> np.ndarray:
    """Return an angle within half a turn of zero."""
    return np.angle(np.exp(1j * np.asarray(x)))


def test_known_phasors_come_back() -> None:
    seen = demodulate(
        trace(phase(times(100_000))),
        sampling_rate=RATE,
        drive_frequency=FREQUENCY,
        bandwidth=2e3,
        track="none",
    )
    assert seen["A1"].dims == ("time",)
    # the first harmonic leaks from both sides of zero, at distances of one and more drive frequencies
    leaks = 2.0 * seen.attrs["leakage"] * AMPLITUDES[1]
    assert seen.attrs["leakage"] < 1e-8
    for n, A in AMPLITUDES.items():
        np.testing.assert_allclose(seen[f"A{n}"].values, A, rtol=0, atol=leaks)
        assert seen[f"A{n}"].attrs["units"] == "m"
        if n:
            np.testing.assert_allclose(angle(seen[f"phi{n}"] - LAGS[n]), 0.0, atol=leaks / A)
            assert seen[f"phi{n}"].attrs["units"] == "rad"


def test_the_output_is_timed_by_the_middle_of_its_window() -> None:
    begin = 5.000_001  # no whole number of periods
    t = times(200_000) + begin
    grows = 1e-9 * (1.0 + (t - begin))
    q = xr.DataArray(
        grows * np.cos(2 * np.pi * FREQUENCY * t), dims="time", coords={"time": t}, attrs={"units": "m"}
    )
    seen = demodulate(q, bandwidth=1e3, drive_frequency=FREQUENCY, track="none", harmonics=(1,))
    np.testing.assert_allclose(seen["A1"].values, 1e-9 * (1.0 + seen["time"].values - begin), rtol=1e-7)
    np.testing.assert_allclose(
        angle(seen["phi1"]), 0.0, atol=1e-5
    )  # the time of the record is that of the phase
    assert seen["time"].attrs["units"] == "s"
    spacing = np.diff(seen["time"].values)
    np.testing.assert_allclose(spacing, 0.5e-3, rtol=1e-6)
    half = 0.5 * NOISE_WIDTH / 1e3
    assert float(seen["time"][0]) - begin == pytest.approx(half, rel=1e-2, abs=0)
    assert 0.1 + begin - float(seen["time"][-1]) < half + 0.51e-3
    faster = demodulate(
        q, bandwidth=1e3, output_rate=10e3, drive_frequency=FREQUENCY, track="none", harmonics=(1,)
    )
    assert faster.sizes["time"] == pytest.approx(5 * seen.sizes["time"], rel=0.03, abs=0)
    np.testing.assert_allclose(faster["A1"].values[::5][: seen.sizes["time"]], seen["A1"].values, rtol=1e-12)


def test_a_faint_harmonic_beside_a_large_one() -> None:
    small = {0: 0.0, 1: 50e-9, 2: 5e-12, 3: 0.0}
    seen = demodulate(trace(phase(times(100_000)), amplitudes=small), sampling_rate=RATE, bandwidth=5e3)
    for n in (0, 2, 3):
        np.testing.assert_allclose(seen[f"A{n}"].values, small[n], rtol=0, atol=1e-6 * small[1])
    np.testing.assert_allclose(
        angle(seen["phi2"] - 2 * seen["phi1"] - (LAGS[2] - 2 * LAGS[1])), 0.0, atol=1e-2
    )
    assert seen.attrs["leakage"] < 1e-6


@pytest.mark.parametrize("bandwidth", [500.0, 4e3])
def test_noise_is_what_the_bandwidth_predicts(bandwidth: float) -> None:
    seen = demodulate(trace(phase(times(2_000_000)), noise=FLOOR), sampling_rate=RATE, bandwidth=bandwidth)
    stated = noise_of(seen)
    assert set(stated) == {"A0", "A1", "phi1", "A2", "A3"}
    count = seen.sizes["time"]
    sampling = 4.0 * 1.2 / math.sqrt(2.0 * count)  # outputs overlap by half
    for n in (0, 1, 2, 3):
        expected = FLOOR * math.sqrt((2.0 if n else 1.0) * bandwidth)
        assert stated[f"A{n}"] == pytest.approx(expected, rel=0.06, abs=0)
        phasor = seen["A0"].values if n == 0 else seen[f"A{n}"].values * np.exp(-1j * seen[f"phi{n}"].values)
        true = AMPLITUDES[n] if n == 0 else phasor.mean()
        spread = np.sqrt(np.mean(np.abs(phasor - true) ** 2) / (2.0 if n else 1.0))
        assert spread == pytest.approx(expected, rel=sampling, abs=0)
        assert abs(abs(phasor.mean()) - AMPLITUDES[n]) < 5.0 * expected / math.sqrt(count / 1.2)
    assert stated["phi1"] == pytest.approx(stated["A1"] / AMPLITUDES[1], rel=1e-3, abs=0)
    assert float(seen["phi1"].std()) == pytest.approx(stated["phi1"], rel=0.1 + sampling, abs=0)


def test_a_line_beside_a_harmonic_is_no_noise() -> None:
    t = times(1_000_000)
    hum = 1e-9 * np.cos(2 * np.pi * (2 * FREQUENCY + 2_200.0) * t)
    with_hum = noise_of(demodulate(trace(phase(t), noise=FLOOR) + hum, sampling_rate=RATE, bandwidth=500.0))
    assert with_hum["A2"] == pytest.approx(FLOOR * math.sqrt(1e3), rel=0.06, abs=0)


def test_noise_goes_to_the_maps(tmp_path: Any) -> None:
    seen = demodulate(trace(phase(times(400_000)), noise=FLOOR), sampling_rate=RATE, bandwidth=1e3)
    save(seen, tmp_path / "seen.nc")
    stated = noise_of(load(tmp_path / "seen.nc"))
    assert stated == noise_of(seen)
    probe = ot.Probe.simple(
        stiffness=16.4,
        frequency=FREQUENCY,
        quality_factor=287,
        drive_frequency=FREQUENCY,
        free_amplitude=60e-9,
    )
    assert np.isfinite(ot.map_energy(seen, probe, noise=stated)["virial"]).all()
    with pytest.raises(ObservablesError, match="carry no noise"):
        noise_of(seen.drop_attrs())


def test_phases_share_one_time() -> None:
    t = times(200_000)
    kept = demodulate(trace(phase(t)), drive=np.cos(phase(t)), sampling_rate=RATE, bandwidth=1e3)
    for shift in (0.3, -1.1):
        moved = demodulate(trace(phase(t)), drive=np.cos(phase(t) + shift), sampling_rate=RATE, bandwidth=1e3)
        for n in (1, 2, 3):  # cos(n theta - phi_n) with theta = theta' - shift
            np.testing.assert_allclose(angle(moved[f"phi{n}"] - kept[f"phi{n}"] - n * shift), 0.0, atol=1e-5)
    referred = demodulate(
        trace(phase(t)), sampling_rate=RATE, bandwidth=1e3, reference=(0.0, 0.1), reference_phase=LAGS[1]
    )
    for n in (1, 2, 3):
        np.testing.assert_allclose(angle(referred[f"phi{n}"] - LAGS[n]), 0.0, atol=1e-5)


def test_a_late_lever_has_a_positive_lag() -> None:
    t = times(200_000)
    delay = 1e-6
    late = 1e-9 * np.cos(2 * np.pi * FREQUENCY * (t - delay))
    seen = demodulate(
        late, drive=np.cos(2 * np.pi * FREQUENCY * t), sampling_rate=RATE, bandwidth=1e3, harmonics=(1,)
    )
    np.testing.assert_allclose(seen["phi1"].values, 2 * np.pi * FREQUENCY * delay, rtol=1e-6)


def test_a_motion_that_was_integrated_in_time() -> None:
    from scipy.integrate import solve_ivp

    from overtone.dynamics.transient import settle

    f, Q, k, free, Z = 303e3, 100.0, 26.0, 30e-9, 24e-9
    probe = ot.Probe.simple(
        stiffness=k, frequency=f, quality_factor=Q, radius=10e-9, drive_frequency=f, free_amplitude=free
    )
    law = {"modulus": 1e9, "poisson_ratio": 0.3}
    state = settle(probe, ot.sample("hertz", **law), Z=Z, n_max=4)
    reduced = 1.0 / ((1 - 0.3**2) / 1e9 + (1 - probe.tip.poisson_ratio**2) / probe.tip.modulus)
    stiff = 4.0 / 3.0 * reduced * math.sqrt(10e-9)

    def motion(theta: float, y: np.ndarray) -> list[float]:
        force = stiff * max(-(Z + y[0]), 0.0) ** 1.5
        return [y[1], -y[0] - y[1] / Q + free / Q * math.cos(theta) + force / k]

    samples, periods, settled = (
        40,
        360,
        240,
    )  # seven times the memory Q/pi of the lever, for the errors of the start
    theta = 2 * np.pi * np.arange(samples * periods) / samples
    start = [float(state["q"][0]), float(state["v"][0])]
    solved = solve_ivp(
        motion, (0.0, theta[-1]), start, method="DOP853", t_eval=theta, rtol=1e-9, atol=1e-17, max_step=0.2
    )
    seen = demodulate(
        solved.y[0][settled * samples :],
        drive=np.cos(theta[settled * samples :]),
        sampling_rate=samples * f,
        bandwidth=f / 40,
        harmonics=range(5),
    )
    assert float(state["A2"]) > 1e-11
    for n in range(5):
        np.testing.assert_allclose(seen[f"A{n}"].values, float(state[f"A{n}"]), rtol=0, atol=1e-6 * free)
        if n:
            off = angle(seen[f"phi{n}"] - float(state[f"phi{n}"]))
            np.testing.assert_allclose(off, 0.0, atol=2e-6 * free / float(state[f"A{n}"]))


def test_progress_comes_to_the_end() -> None:
    said: list[tuple[int, int]] = []
    demodulate(
        trace(phase(times(400_000))),
        sampling_rate=RATE,
        bandwidth=1e3,
        progress=lambda *call: said.append(call),
    )
    assert len(said) > 2
    assert [done for done, _ in said] == sorted(done for done, _ in said)
    assert said[-1][1] - said[-1][0] <= RATE / 2e3


def test_integers_and_single_precision_are_numbers_too() -> None:
    q = trace(phase(times(100_000)))
    single = demodulate(q.astype(np.float32), sampling_rate=RATE, bandwidth=1e3)
    assert float(single["A1"].mean()) == pytest.approx(AMPLITUDES[1], rel=1e-6, abs=0)
    counts = demodulate(np.round(q / 1e-11).astype(np.int16), sampling_rate=RATE, bandwidth=1e3)
    assert float(counts["A1"].mean()) == pytest.approx(AMPLITUDES[1] / 1e-11, rel=1e-4, abs=0)


def test_the_history_says_how(tmp_path: Any) -> None:
    seen = demodulate(trace(phase(times(100_000))), sampling_rate=RATE, bandwidth=1e3)
    entry = provenance.history(seen)[-1]
    assert entry["operation"] == "demodulate"
    assert entry["arguments"]["bandwidth"] == 1e3
    assert "Kaiser" in seen.attrs["filter"]
    assert json.loads(seen.attrs["noise"])["A1"] > 0


# --- what is refused -----------------------------------------------------------------------------


def good() -> np.ndarray:
    return trace(phase(times(50_000)), noise=FLOOR)


def timed(t: np.ndarray, **attributes: str) -> xr.DataArray:
    coords = {"time": xr.DataArray(t, dims="time", attrs={"units": attributes.pop("time", "s")})}
    return xr.DataArray(good()[: t.size], dims="time", coords=coords, attrs=attributes)


def jittered() -> np.ndarray:
    t = times(50_000)
    t[20_000:] += 0.4 / RATE
    return t


def with_gap() -> np.ndarray:
    q = good()
    q[300:310] = np.nan
    return q


CASES: dict[str, tuple[Callable[[], Any], dict[str, Any], type[OvertoneError], str]] = {
    "no rate": (good, {"sampling_rate": None}, ObservablesError, "has no time"),
    "no bandwidth": (good, {"bandwidth": 0.0}, OvertoneError, "bandwidth is not positive"),
    "two dimensions": (lambda: np.ones((3, 4)), {}, ObservablesError, "is no trace"),
    "complex": (lambda: good() + 0j, {}, ObservablesError, "is no trace"),
    "volts": (
        lambda: timed(times(50_000), units="V"),
        {"sampling_rate": None},
        UnitError,
        "unit of the deflection",
    ),
    "time in ms": (
        lambda: timed(times(50_000), units="m", time="ms"),
        {"sampling_rate": None},
        UnitError,
        "coordinate time",
    ),
    "not uniform": (
        lambda: timed(jittered()),
        {"sampling_rate": None},
        ObservablesError,
        "not sampled uniformly",
    ),
    "another rate": (
        lambda: timed(times(50_000)),
        {"sampling_rate": 2.01e6},
        ObservablesError,
        "not sampled uniformly",
    ),
    "gaps": (with_gap, {}, ObservablesError, "10 of 50000 samples"),
    "too short": (lambda: good()[:150], {"bandwidth": 2e4}, ObservablesError, "too short"),
    "filter too long": (good, {"bandwidth": 30.0}, ObservablesError, "shorter than the filter"),
    "filter longer than the phase is known": (
        good,
        {"bandwidth": 48.755, "drive": np.cos(phase(times(50_000)))},  # 49,989 of 50,000 samples
        ObservablesError,
        "shorter than the filter",
    ),
    "filter of a year": (good, {"bandwidth": 4e-8}, ObservablesError, "shorter than the filter"),
    "beyond Nyquist": (good, {"harmonics": (0, 1, 7)}, OvertoneError, "harmonic 7 is beyond"),
    "bandwidth too large": (good, {"bandwidth": 81e3}, OvertoneError, "does not separate harmonics"),
    "no first harmonic": (good, {"harmonics": (0, 2)}, OvertoneError, "harmonics are not usable"),
    "half a harmonic": (good, {"harmonics": (1, 1.5)}, OvertoneError, "harmonics are not usable"),
    "unknown track": (good, {"track": "pll"}, OvertoneError, "unknown track"),
    "no drive": (good, {"track": "drive"}, OvertoneError, "expected a recorded drive"),
    "drive unused": (good, {"track": "linear", "drive": good()}, OvertoneError, "a drive was recorded"),
    "no exact frequency": (good, {"track": "none"}, OvertoneError, "needs the frequency"),
    "drive too short": (good, {"drive": good()[:-5]}, ObservablesError, "differ in length"),
    "reference outside": (good, {"reference": (1.0, 2.0)}, OvertoneError, "no part of the record"),
    "reference reversed": (good, {"reference": (0.02, 0.01)}, OvertoneError, "no part of the record"),
    "reference of words": (good, {"reference": "all"}, OvertoneError, "no part of the record"),
    "reference too short": (good, {"reference": (0.0, 1e-4)}, OvertoneError, "too short to tell"),
    "phase without reference": (good, {"reference_phase": 1.5}, OvertoneError, "nothing to hold for"),
    "a constant": (lambda: np.ones(50_000), {}, ObservablesError, "no line"),
    "noise alone": (
        lambda: np.random.default_rng(0).normal(0, 1e-9, 200_000),
        {},
        ObservablesError,
        "no line stands above the noise in the trace",
    ),
    "elsewhere": (good, {"drive_frequency": 120e3}, ObservablesError, "within 5 % of 120 kHz"),
    "too faint": (
        lambda: trace(phase(times(400_000)), noise=1e-9, amplitudes={0: 0.0, 1: 130e-9}),
        {"bandwidth": 50e3, "harmonics": (1,)},
        ObservablesError,
        "in this bandwidth",
    ),
}


@pytest.mark.parametrize("kind", CASES)
def test_wrong_calls_have_named_errors(kind: str) -> None:
    make, arguments, error, words = CASES[kind]
    with pytest.raises(error, match=words):
        demodulate(make(), **{"sampling_rate": RATE, "bandwidth": 1e3, **arguments})


def test_a_wide_filter_is_warned_of() -> None:
    with pytest.warns(DistortionWarning, match=r"lets neighbouring harmonics through, at 0\.00"):
        seen = demodulate(trace(phase(times(50_000))), sampling_rate=RATE, bandwidth=45e3)
    assert seen.attrs["leakage"] > 1e-4
