"""Traces behind the photodiode, and the lock-in that reads them: delays, noise, leaks and the converter."""

import warnings
from typing import Any

import numpy as np
import pytest
import xarray as xr

from overtone.errors import DistortionWarning, OvertoneError
from overtone.instrument.demodulate import demodulate
from overtone.instrument.lockin import NOISE_WIDTH
from overtone.instrument.lockin import response as window_response
from overtone.instrument.photodiode import SplitDiode, observables_of, read_through, response, waveform
from overtone.instrument.trace import lock_in, sample_trace

FREQUENCY = 161.8e3
RATE = 5e6  # 30.9 samples a period
ALIGNED = SplitDiode(spot=1.0)  # so large that it reads as a ruler does


def motion(**values: float) -> xr.Dataset:
    given = {"A0": -0.12e-9, "A1": 94e-9, "phi1": 1.4, "A2": 0.07e-9, "phi2": 4.0, "A3": 0.01e-9, "phi3": 0.8}
    return xr.Dataset(given | values)


def free(amplitude: Any, phase: float = 0.0, dims: str = "z") -> xr.Dataset:
    zero = np.zeros(np.shape(amplitude))
    names = {"A0": zero, "A1": amplitude, "phi1": zero + phase, "A2": zero, "phi2": zero}
    names |= {"A3": zero, "phi3": zero}
    return xr.Dataset({name: ((dims,) if zero.ndim else (), value) for name, value in names.items()})


def phasor(observables: xr.Dataset, n: int) -> Any:
    if n == 0:
        return observables["A0"].values + 0j
    return observables[f"A{n}"].values * np.exp(-1j * observables[f"phi{n}"].values)


def record(observables: xr.Dataset, diode: SplitDiode = ALIGNED, **options: Any) -> xr.DataArray:
    given = {"drive_frequency": FREQUENCY, "sampling_rate": RATE, "duration": 1e-3, "seed": 3, "zeroed": True}
    return sample_trace(observables, diode, **(given | options))


def leak(bandwidth: float, lines: int = 1) -> float:
    """Return what a line so many drive frequencies away leaves in a phasor, over its own, seen from both sides."""
    return 2.0 * window_response(lines * FREQUENCY / bandwidth)


def test_a_lag_is_a_delay() -> None:
    late = 0.7e-6
    time = np.arange(5000) / RATE
    signal = xr.DataArray(np.cos(2 * np.pi * FREQUENCY * (time - late)), {"time": time}, ["time"])
    phasors, _ = lock_in(signal, FREQUENCY, (1,))
    assert float(observables_of(phasors)["phi1"]) == pytest.approx(
        2 * np.pi * FREQUENCY * late, rel=1e-8, abs=0
    )


@pytest.mark.parametrize("gap", [0.0, 40e-9])
@pytest.mark.parametrize("shape", ["round", "gaussian"])
def test_reading_against_a_lock_in_in_time(shape: str, gap: float) -> None:
    """Fourier sums over one period, and a record of 5000 samples that no period divides."""
    diode = SplitDiode(500e-9, shape, offset=25e-9, gap=gap)
    read = read_through(motion(), diode)
    theta = np.arange(4096) * 2 * np.pi / 4096
    dense = response(diode, waveform(motion(), theta).values)
    trace = sample_trace(
        motion(), diode, drive_frequency=FREQUENCY, sampling_rate=RATE, duration=1e-3, seed=0
    )
    assert trace.dims == ("time",)
    assert trace.size == 5000
    phasors, _ = lock_in(trace, FREQUENCY)
    for n in range(4):
        brute = (dense * np.exp(-1j * n * theta)).mean() * (2 if n else 1)
        assert abs(phasor(read, n) - brute) < 1e-12 * 94e-9
        assert abs(phasors.sel(harmonic=n).item() - brute) < 1e-9 * 94e-9
    xr.testing.assert_allclose(observables_of(phasors)["phi2"], read["phi2"], rtol=1e-6)


def test_noise_of_the_phasors_is_that_of_the_bandwidth() -> None:
    density, points = 60e-15, 4000
    trace = record(free(np.full(points, 1e-9)), noise_density=density, duration=0.2e-3)
    phasors, bandwidth = lock_in(trace, FREQUENCY)
    assert bandwidth == pytest.approx(NOISE_WIDTH / 0.2e-3, rel=1e-3, abs=0)
    accuracy = 4 / np.sqrt(2 * points)
    assert phasors.sel(harmonic=0).real.std() == pytest.approx(
        density * np.sqrt(bandwidth), rel=accuracy, abs=0
    )
    for n in (1, 2, 3):
        noise = phasors.sel(harmonic=n).values - (1e-9 if n == 1 else 0.0)
        for part in (noise.real, noise.imag):
            assert part.std() == pytest.approx(density * np.sqrt(2 * bandwidth), rel=accuracy, abs=0)
            assert abs(part.mean()) < 4 * part.std() / np.sqrt(points)
    rest = trace - record(free(np.full(points, 1e-9)), duration=0.2e-3)
    assert rest.std() == pytest.approx(density * np.sqrt(RATE / 2), rel=4 / np.sqrt(2 * trace.size), abs=0)
    # white: no memory from one sample to the next
    assert abs((rest[:, 1:].values * rest[:, :-1].values).mean() / rest.values.var()) < 4 / np.sqrt(
        trace.size
    )
    again = record(free(np.full(points, 1e-9)), noise_density=density, duration=0.2e-3, seed=4)
    assert not np.array_equal(trace, again)


def test_drift_of_a_trace_goes_into_the_mean_alone() -> None:
    trace = record(motion(), drift_rate=1e-6)
    assert float(trace[-1] - record(motion())[-1]) == pytest.approx(1e-6 * (1e-3 - 1 / RATE), rel=1e-6, abs=0)
    phasors, bandwidth = lock_in(trace, FREQUENCY)
    middle = (trace.size - 1) / (2 * RATE)
    assert phasors.sel(harmonic=0).real.item() == pytest.approx(-0.12e-9 + 1e-6 * middle, rel=1e-6, abs=0)
    for n in (1, 2, 3):
        error = phasors.sel(harmonic=n).item() - complex(phasor(motion(), n))
        assert abs(error) < leak(bandwidth) * 94e-9


def test_the_diode_sees_the_drift() -> None:
    """At the end of a drift the slope of the diode, not of the ruler, reads the motion."""
    diode = SplitDiode(500e-9)
    trace = record(free(1e-10), diode, drift_rate=100e-9 / 10e-3, duration=10e-3)
    phasors, _ = lock_in(trace, FREQUENCY, (0, 1), duration=1e-3)
    assert phasors.dims == ("window", "harmonic")
    assert phasors.sizes["window"] == 10
    where = 1e-5 * phasors["time"].values
    np.testing.assert_allclose(
        phasors.sel(harmonic=1).real / 1e-10, np.sqrt(1 - (where / 250e-9) ** 2), rtol=2e-4
    )
    np.testing.assert_allclose(phasors.sel(harmonic=1).imag / 1e-10, 0.0, atol=1e-4)


def test_windows_share_the_time_of_the_trace() -> None:
    trace = record(motion(), duration=2.1e-3)
    whole, _ = lock_in(trace, FREQUENCY)
    split, bandwidth = lock_in(trace, FREQUENCY, duration=0.5e-3)
    late, _ = lock_in(trace.isel(time=slice(1234, None)), FREQUENCY)
    assert split.sizes["window"] == 4
    assert bandwidth == pytest.approx(NOISE_WIDTH / 0.5e-3, rel=1e-3, abs=0)
    assert split["time"].values[1] == pytest.approx(0.75e-3 - 0.5 / RATE, rel=1e-9, abs=0)
    assert abs(split - whole).max() < 1e-7 * 94e-9
    assert abs(late - whole).max() < 1e-9 * 94e-9


@pytest.mark.parametrize("cycles", [6.5, 20.5, 80.5, 1000.5])
def test_harmonics_do_not_leak(cycles: float) -> None:
    """A mean so many bins away, and the line on the other side of zero at twice that."""
    trace = record(free(1e-9).assign(A0=1e-6), duration=cycles / FREQUENCY)
    phasors, bandwidth = lock_in(trace, FREQUENCY, (1, 2))
    for n, line in ((1, 1e-9), (2, 0.0)):
        error = abs(phasors.sel(harmonic=n).item() - line)
        assert (
            1e-4 * leak(bandwidth, n) * 1e-6
            < error
            < 1.05 * (leak(bandwidth, n) * 1e-6 + leak(bandwidth) * 1e-9)
        )
    assert leak(bandwidth) < 2e-7


def test_rounding_of_the_adc() -> None:
    full_scale, bits = 200e-9, 12
    step = 2 * full_scale / 2**bits
    exact, rounded = record(motion()), record(motion(), bits=bits, range=full_scale)
    codes = rounded / step
    np.testing.assert_allclose(codes, np.round(codes), atol=1e-6)
    error = (rounded - exact).values
    assert abs(error).max() <= step / 2 * (1 + 1e-9)
    assert error.std() == pytest.approx(step / np.sqrt(12), rel=0.05, abs=0)


def test_samples_outside_the_adc_are_reported() -> None:
    with pytest.warns(DistortionWarning, match="of 5000 samples lie outside"):
        trace = record(motion(), bits=12, range=60e-9)
    assert float(trace.min()) == pytest.approx(-60e-9, rel=1e-9, abs=0)
    assert float(trace.max()) == pytest.approx(60e-9 * (1 - 2 / 2**12), rel=1e-9, abs=0)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        record(motion(), bits=12, range=100e-9)


def test_many_points_are_one_call() -> None:
    diode = SplitDiode(500e-9, offset=25e-9)
    curve = free(np.linspace(20e-9, 94e-9, 5), 0.4)
    trace = record(curve.assign_coords(z=np.arange(5.0)), diode)
    assert trace.dims == ("z", "time")
    phasors, _ = lock_in(trace.transpose("time", "z"), FREQUENCY)
    assert phasors.dims == ("z", "harmonic")
    np.testing.assert_array_equal(phasors["z"], np.arange(5.0))
    read = read_through(curve, diode, zeroed=True)
    for n in range(4):
        assert abs(phasors.sel(harmonic=n) - phasor(read, n)).max() < 1e-9 * 94e-9


@pytest.mark.parametrize(
    ("options", "problem"),
    [
        ({"drive_frequency": 0.0}, "drive_frequency = 0.0"),
        ({"sampling_rate": np.nan}, "sampling_rate = nan"),
        ({"duration": -1.0}, "duration = -1.0"),
        ({"duration": 1e-8}, "shorter than a sample"),
        ({"noise_density": -1e-15}, "noise_density"),
        ({"drift_rate": np.inf}, "drift_rate"),
        ({"bits": 12}, "bits = 12 with range = None"),
        ({"range": 1e-6}, "range"),
        ({"bits": 0, "range": 1e-6}, "bits = 0"),
        ({"sampling_rate": 900e3}, "harmonic 3 lies above half the sampling rate"),
    ],
)
def test_impossible_traces_are_refused(options: dict[str, Any], problem: str) -> None:
    with pytest.raises(OvertoneError, match=problem):
        record(motion(), **options)


def test_records_that_mix_harmonics_are_refused() -> None:
    trace = record(motion())
    short = trace.isel(time=slice(0, 170))
    for bad, harmonics in ((short, (1,)), (trace, (1, 20)), (trace.isel(time=slice(0, None, 6)), (1, 2, 3))):
        with pytest.raises(OvertoneError, match="does not keep the harmonics apart"):
            lock_in(bad, FREQUENCY, harmonics)
    # sampled 6.03 times a period, the third harmonic has its mirror image five bins away
    coarse = record(free(1e-9), sampling_rate=6.03 * FREQUENCY)
    lock_in(coarse, FREQUENCY, (0, 1, 2))
    with pytest.raises(OvertoneError, match="does not keep the harmonics apart"):
        lock_in(coarse, FREQUENCY, (0, 1, 2, 3))
    with pytest.raises(OvertoneError, match="even time"):
        lock_in(trace.drop_vars("time"), FREQUENCY)
    uneven = trace.assign_coords(time=trace["time"].values ** 1.1)
    with pytest.raises(OvertoneError, match="even time"):
        lock_in(uneven, FREQUENCY)
    with pytest.raises(OvertoneError, match="cannot be done"):
        lock_in(trace, FREQUENCY, duration=1.0)
    with pytest.raises(OvertoneError, match="cannot be done"):
        lock_in(trace, FREQUENCY, (-1, 1))


def test_one_lock_in_reads_what_the_other_reads() -> None:
    """A trace that is read as a measured one gives the motion behind the diode."""
    diode = SplitDiode(500e-9, offset=25e-9)
    trace = record(motion(), diode, duration=20e-3)
    read = read_through(motion(), diode, zeroed=True)
    measured = demodulate(trace, bandwidth=1e3, drive_frequency=FREQUENCY, track="none")
    split, bandwidth = lock_in(trace, FREQUENCY, duration=NOISE_WIDTH / 1e3)
    assert bandwidth == pytest.approx(1e3, rel=1e-3, abs=0)
    for n in range(4):
        for seen in (measured, observables_of(split)):
            error = phasor(seen, n) - complex(phasor(read, n))
            assert np.abs(error).max() < leak(bandwidth) * 94e-9
