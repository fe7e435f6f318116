"""Traces from files: which channel is which, in which unit, and against which time."""

import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import xarray as xr

from overtone.errors import ChannelError, FileFormatError, UnitError
from overtone.instrument.demodulate import demodulate
from overtone.io.netcdf import save
from overtone.io.traces import read_trace

RATE, COUNT = 2e6, 400


def samples() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    t = np.arange(COUNT) / RATE
    return t, 0.8 * np.cos(2 * np.pi * 160e3 * t - 1.0), np.cos(2 * np.pi * 160e3 * t)


def table(path: Path, header: str, *columns: np.ndarray) -> Path:
    rows = "\n".join(", ".join(f"{value:.9g}" for value in row) for row in zip(*columns, strict=True))
    path.write_text(f"{header}\n{rows}\n", encoding="utf-8")
    return path


def test_a_table_with_time_deflection_and_drive(tmp_path: Path) -> None:
    t, q, d = samples()
    path = table(tmp_path / "a.csv", "time [us], deflection [mV], drive [V]", t * 1e6, q * 1e3, d)
    deflection, drive = read_trace(path, sensitivity=60e-9)
    assert deflection.dims == ("time",)
    assert deflection.attrs["units"] == "m"
    np.testing.assert_allclose(deflection.values, q * 60e-9, rtol=1e-8)
    np.testing.assert_allclose(deflection["time"].values, t, rtol=1e-8, atol=0)
    assert deflection["time"].attrs["units"] == "s"
    assert drive is not None
    assert drive.attrs["units"] == "V"
    np.testing.assert_allclose(drive.values, d, rtol=1e-8)


def test_channels_go_by_name_where_they_are_given(tmp_path: Path) -> None:
    t, q, d = samples()
    path = table(tmp_path / "a.csv", "clock [ms], ch1 [nm], ch2 [V]", t * 1e3, q * 1e2, d)
    with pytest.raises(ChannelError, match=r"which channel is the deflection: .* got clock, ch1, ch2"):
        read_trace(path)
    deflection, drive = read_trace(path, channels={"deflection": "ch1", "time": "clock"})
    assert drive is None
    np.testing.assert_allclose(deflection.values, q * 1e-7, rtol=1e-8)
    np.testing.assert_allclose(deflection["time"].values, t, rtol=1e-8, atol=0)
    _, drive = read_trace(path, channels={"deflection": "ch1", "time": "clock", "drive": "ch2"})
    assert drive is not None
    np.testing.assert_allclose(drive.values, d, rtol=1e-8)


def test_a_single_column_and_the_rate(tmp_path: Path) -> None:
    t, q, _ = samples()
    path = table(tmp_path / "a.csv", "ADC", q)
    deflection, _ = read_trace(path, sensitivity=60e-9, sampling_rate=RATE)
    np.testing.assert_allclose(deflection["time"].values, t, rtol=1e-12, atol=0)
    np.testing.assert_allclose(deflection.values, q * 60e-9, rtol=1e-8)
    with pytest.raises(ChannelError, match="does not say when"):
        read_trace(path, sensitivity=60e-9)
    with pytest.raises(UnitError, match="has no unit"):
        read_trace(path, sampling_rate=RATE)


def test_an_igor_wave_knows_its_step(tmp_path: Path, igor_wave: Callable[..., bytes]) -> None:
    t, q, _ = samples()
    path = tmp_path / "a.ibw"
    path.write_bytes(igor_wave(q, steps=(1e6 / RATE, 1.0, 1.0, 1.0), unit="V", axis_units=("us", "", "", "")))
    deflection, _ = read_trace(path, sensitivity=60e-9)
    np.testing.assert_allclose(deflection.values, q * 60e-9, rtol=1e-6)
    np.testing.assert_allclose(deflection["time"].values, t, rtol=1e-12, atol=0)
    columns = np.stack([q * 1e-9, t * 0.0], axis=1)
    labels = ((), ("Defl", "ZSnsr"))
    path.write_bytes(
        igor_wave(
            columns, steps=(1 / RATE, 1.0, 1.0, 1.0), labels=labels, unit="m", axis_units=("s", "", "", "")
        )
    )
    deflection, _ = read_trace(path)
    assert deflection.attrs["channel"] == "Defl"
    np.testing.assert_allclose(deflection["time"].values, t, rtol=1e-12, atol=0)
    path.write_bytes(igor_wave(q, steps=(1.0, 1.0, 1.0, 1.0), unit="m", axis_units=("", "", "", "")))
    with pytest.raises(ChannelError, match="sampling-rate"):
        read_trace(path)


def test_netcdf_over_time(tmp_path: Path) -> None:
    t, q, d = samples()
    coords = {"time": xr.DataArray(t * 1e3, dims="time", attrs={"units": "ms"})}
    stored = xr.Dataset(
        {"deflection": ("time", q * 1e2, {"units": "nm"}), "drive": ("time", d, {"units": "V"})},
        coords=coords,
    )
    save(stored, tmp_path / "a.nc")
    deflection, drive = read_trace(tmp_path / "a.nc")
    np.testing.assert_allclose(deflection.values, q * 1e-7, rtol=1e-12)
    np.testing.assert_allclose(deflection["time"].values, t, rtol=1e-12, atol=0)
    assert drive is not None
    save(stored.assign(other=("more", np.ones(3))), tmp_path / "b.nc")
    with pytest.raises(FileFormatError, match="holds no trace"):
        read_trace(tmp_path / "b.nc")


def test_what_is_read_can_be_demodulated(tmp_path: Path) -> None:
    t, q, d = samples()
    path = table(tmp_path / "a.csv", "time [us], deflection [V], drive [V]", t * 1e6, q, d)
    deflection, drive = read_trace(path, sensitivity=60e-9)
    seen = demodulate(deflection, drive=drive, bandwidth=25e3, harmonics=(0, 1, 2))
    np.testing.assert_allclose(seen["A1"].values, 48e-9, rtol=1e-6)
    np.testing.assert_allclose(seen["phi1"].values, 1.0, rtol=1e-6)


def test_wrong_traces_have_named_errors(tmp_path: Path, igor_wave: Callable[..., bytes]) -> None:
    t, q, d = samples()
    path = table(tmp_path / "a.csv", "time [us], deflection [nm], force [nN]", t * 1e6, q, d)
    with pytest.raises(UnitError, match="in metres already"):
        read_trace(path, sensitivity=60e-9)
    with pytest.raises(UnitError, match="has the unit N"):
        read_trace(path, channels={"deflection": "force"})
    with pytest.raises(ChannelError, match="no channel 'Defl'"):
        read_trace(path, channels={"deflection": "Defl"})
    with pytest.raises(ChannelError, match="'A1' is no part of a trace"):
        read_trace(path, channels={"A1": "force"})
    with pytest.raises(UnitError, match=r"the time \(force\) has the unit N"):
        read_trace(path, channels={"time": "force"})
    with pytest.raises(ChannelError, match="sampling rate is not positive"):
        read_trace(path, sampling_rate=-1.0)
    with pytest.raises(UnitError, match="sensitivity is not usable"):
        read_trace(path, sensitivity=math.nan)
    volts = table(tmp_path / "v.csv", "time [us], deflection [V]", t * 1e6, q)
    with pytest.raises(UnitError, match=r"has the unit V: expected metres, or volts and a sensitivity"):
        read_trace(volts)
    bare = table(tmp_path / "t.csv", "time, deflection [nm]", t * 1e6, q)
    with pytest.raises(UnitError, match=r"the time \(time\) has no unit"):
        read_trace(bare)
    image = tmp_path / "image.ibw"
    image.write_bytes(igor_wave(np.ones((4, 5))))
    with pytest.raises(FileFormatError, match="holds no trace"):
        read_trace(image)
    with pytest.raises(FileFormatError, match="there is no file"):
        read_trace(tmp_path / "none.csv")
