"""What makes an array a record: its rate, its unit, and no gaps or limits in it."""

import warnings

import numpy as np
import pytest
import xarray as xr

from overtone.errors import DistortionWarning, ObservablesError, UnitError
from overtone.instrument.samples import Trace, check_values, sampled

RATE = 2e6


def times(count: int = 50_000) -> np.ndarray:
    return np.arange(count) / RATE


def motion(t: np.ndarray) -> np.ndarray:
    theta = 2 * np.pi * 161_803.4 * t
    return 50e-9 * np.cos(theta - 1.3) + 20e-12 * np.cos(2 * theta) + 3e-12


def timed(t: np.ndarray, unit: str = "s") -> xr.DataArray:
    coords = {"time": xr.DataArray(t, dims="time", attrs={"units": unit})}
    return xr.DataArray(motion(times(t.size)), dims="time", coords=coords, attrs={"units": "m"})


def test_rate_and_start_come_from_the_labels() -> None:
    trace = sampled(timed(times() + 3.0), None, "deflection", "m")
    assert trace.rate == pytest.approx(RATE, rel=1e-9, abs=0)
    assert trace.start == 3.0
    assert sampled(motion(times()), RATE, "deflection")[1:] == (RATE, 0.0)
    # a unit counts where one is wanted
    assert sampled(timed(times()).assign_attrs(units="V"), None, "drive").values.size == 50_000
    with pytest.raises(UnitError, match="unit of the drive does not fit"):
        sampled(timed(times()).assign_attrs(units="V"), None, "drive", "m")
    with pytest.raises(UnitError, match="coordinate time"):
        sampled(timed(times(), "ms"), None, "deflection", "m")


def test_rounded_labels_of_time_do_with_the_rate() -> None:
    rate = RATE / 1.1
    rounded = timed(np.round(np.arange(50_000) / rate, 7))  # steps of 0.5 and 0.6 us
    with pytest.raises(ObservablesError, match="not sampled uniformly"):
        sampled(rounded, None, "deflection", "m")
    assert sampled(rounded, rate, "deflection", "m").rate == pytest.approx(rate, rel=1e-12, abs=0)
    with pytest.raises(ObservablesError, match="not sampled uniformly"):
        sampled(rounded, 1.001 * rate, "deflection", "m")
    with pytest.raises(ObservablesError, match="not sampled uniformly"):
        sampled(timed(-times()), None, "deflection", "m")


def test_clipping_is_noticed_and_steps_of_a_converter_are_not() -> None:
    t = times(400_000)
    q = motion(t) + np.random.default_rng(7).normal(0.0, 25e-12, t.size)
    with pytest.warns(DistortionWarning, match="the deflection stands at its extreme"):
        check_values(Trace(np.minimum(q, 49e-9), RATE, 0.0), "deflection")
    with pytest.warns(DistortionWarning, match="stands at its extreme"):
        check_values(Trace(np.maximum(np.round(q, 11), -45e-9), RATE, 0.0), "deflection")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_values(Trace(np.minimum(q, 49e-9), RATE, 0.0), "drive", may_clip=True)
        check_values(Trace(np.zeros(1000), RATE, 0.0), "deflection")
        for step in (1e-9, 1e-10, 1e-11):
            check_values(Trace(np.round(q / step) * step, RATE, 0.0), "deflection")
        # a period of a whole number of samples stands still at its turning points as well
        turn = 2 * np.pi * np.arange(100_000) / 10
        for lag in (0.0, 0.3, np.pi / 10):
            check_values(Trace(1e-9 * np.cos(turn - lag), RATE, 0.0), "deflection")


def test_gaps_are_refused() -> None:
    q = motion(times())
    q[300:310] = np.nan
    with pytest.raises(ObservablesError, match=r"the drive has gaps.*10 of 50000 samples"):
        check_values(Trace(q, RATE, 0.0), "drive", may_clip=True)
