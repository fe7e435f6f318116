"""Traces and quadratures from files: which channel is which, in which unit, and against which time."""

import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import xarray as xr

import overtone as ot
from overtone import provenance
from overtone.errors import ChannelError, FileFormatError, ObservablesError, PhaseReferenceWarning, UnitError
from overtone.harmonics import far_phase, to_force_harmonics
from overtone.instrument.demodulate import demodulate
from overtone.io.netcdf import save
from overtone.io.traces import from_quadratures, read_quadratures, read_trace

RATE, COUNT = 2e6, 400


def samples() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    t = np.arange(COUNT) / RATE
    return t, 0.8 * np.cos(2 * np.pi * 160e3 * t - 1.0), np.cos(2 * np.pi * 160e3 * t)


def table(path: Path, header: str, *columns: np.ndarray) -> Path:
    rows = "\n".join(", ".join(f"{value:.9g}" for value in row) for row in zip(*columns, strict=True))
    path.write_text(f"{header}\n{rows}\n", encoding="utf-8")
    return path


# --- traces ---------------------------------------------------------------------------------------


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


# --- quadratures ----------------------------------------------------------------------------------


def quadratures(rms: bool = True, sign: int = -1, unit: str = "m", polar: bool = False) -> xr.Dataset:
    """What a lock-in makes of A_n 40 nm, 30 pm and lags 1.2, 4.4, by averaging the signal itself."""
    theta = 2 * np.pi * np.arange(64) / 64
    q = 40e-9 * np.cos(theta - 1.2) + 30e-12 * np.cos(2 * theta - 4.4)
    arrays: dict[str, xr.DataArray] = {}
    for n in (1, 2):
        z = 2.0 * np.mean(q * np.exp(sign * 1j * n * theta)) / (math.sqrt(2.0) if rms else 1.0)
        parts = {"R": abs(z), "theta": np.angle(z)} if polar else {"X": z.real, "Y": z.imag}
        for name, value in parts.items():
            units = "rad" if name == "theta" else unit
            scaled = value if name == "theta" or unit == "m" else value / 60e-9
            arrays[f"{name}{n}"] = xr.DataArray([scaled], dims="point", attrs={"units": units})
    return xr.Dataset(arrays)


@pytest.mark.parametrize("polar", [False, True])
@pytest.mark.parametrize("unit", ["m", "V"])
@pytest.mark.parametrize("sign", [-1, 1])
@pytest.mark.parametrize("rms", [True, False])
def test_quadratures_become_lags(rms: bool, sign: int, unit: str, polar: bool) -> None:
    signals = quadratures(rms, sign, unit, polar)
    seen = from_quadratures(
        signals, rms=rms, phase_sign=sign, sensitivity=60e-9 if unit == "V" else None, common_oscillator=True
    )
    np.testing.assert_allclose([float(seen["A1"][0]), float(seen["phi1"][0])], [40e-9, 1.2], rtol=1e-9)
    np.testing.assert_allclose([float(seen["A2"][0]), float(seen["phi2"][0])], [30e-12, 4.4], rtol=1e-6)


def test_a_lever_that_is_driven_at_resonance_loses_energy() -> None:
    # the sign of the phase by physics: less amplitude than free, at resonance, means work done on the sample
    probe = ot.Probe.simple(
        stiffness=16.4, frequency=161.8e3, quality_factor=287, drive_frequency=161.8e3, free_amplitude=60e-9
    )
    lag = far_phase(probe)
    signals = xr.Dataset(
        {
            "X1": ("point", [40e-9 * math.cos(lag)], {"units": "m"}),
            "Y1": ("point", [-40e-9 * math.sin(lag)], {"units": "m"}),
        }
    )
    force = to_force_harmonics(from_quadratures(signals, rms=False), probe).sel(harmonic=1)
    assert float(force["F_diss"][0]) > 0.1 * 16.4 * 60e-9 / 287


def test_own_oscillators_are_warned_of() -> None:
    with pytest.warns(PhaseReferenceWarning, match="phi2 may be referred to oscillators of their own"):
        seen = from_quadratures(quadratures(), rms=True)
    assert any("calibrated" in sentence for sentence in provenance.findings(seen))
    from_quadratures(quadratures()[["X1", "Y1"]], rms=True)


def test_tables_of_lock_ins(tmp_path: Path) -> None:
    s = quadratures()
    x1, y1, x2, y2 = (s[name].values * np.ones(3) for name in ("X1", "Y1", "X2", "Y2"))
    path = table(
        tmp_path / "a.csv",
        "X1 [nm], Y1 [nm], X2 [pm], Y2 [pm], A0 [pm]",
        x1 * 1e9,
        y1 * 1e9,
        x2 * 1e12,
        y2 * 1e12,
        x1 * 0 + 5,
    )
    seen = from_quadratures(read_quadratures(path), rms=True, common_oscillator=True)
    np.testing.assert_allclose(seen["A1"].values, 40e-9, rtol=1e-7)
    np.testing.assert_allclose(seen["phi2"].values, 4.4, rtol=1e-6)
    np.testing.assert_allclose(seen["A0"].values, 5e-12, rtol=1e-9)  # rms is no matter of a mean
    path = table(
        tmp_path / "b.csv",
        "dev2/demods/0/sample.x [V], dev2/demods/0/sample.y [V], demods/3/sample.r [V], demods/3/sample.theta [deg]",
        x1 / 60e-9,
        y1 / 60e-9,
        np.hypot(x2, y2) / 60e-9,
        np.degrees(np.arctan2(y2, x2)),
    )
    with pytest.raises(ChannelError, match="which harmonic demodulator 0 listened to"):
        read_quadratures(path)
    read = read_quadratures(path, demodulators={0: 1, 3: 2})
    assert set(read.data_vars) == {"X1", "Y1", "R2", "theta2"}
    seen = from_quadratures(read, rms=True, sensitivity=60e-9, common_oscillator=True)
    np.testing.assert_allclose(seen["A2"].values, 30e-12, rtol=1e-6)
    np.testing.assert_allclose(seen["phi2"].values, 4.4, rtol=1e-6)
    path = table(
        tmp_path / "c.csv",
        "x [nm], y [nm]",
        x1 * np.array([1e9, 1.1e9, 1.2e9]),
        y1 * np.array([1e9, 1.1e9, 1.2e9]),
    )
    assert set(read_quadratures(path).data_vars) == {"X1", "Y1"}


def test_wrong_quadratures_have_named_errors(tmp_path: Path) -> None:
    with pytest.raises(ChannelError, match="harmonic 2 is not whole"):
        from_quadratures(quadratures().drop_vars("Y2"), rms=True)
    with pytest.raises(ChannelError, match="no harmonic 1"):
        from_quadratures(quadratures()[["X2", "Y2"]], rms=True)
    with pytest.raises(UnitError, match="X1 has the unit V"):
        from_quadratures(quadratures(unit="V"), rms=True)
    with pytest.raises(UnitError, match="X1 has no unit"):
        from_quadratures(quadratures().drop_attrs(), rms=True)
    with pytest.raises(ChannelError, match="unknown phase sign"):
        from_quadratures(quadratures(), rms=True, phase_sign=0)
    bad = quadratures(polar=True)
    bad["theta1"].attrs["units"] = "V"
    with pytest.raises(UnitError, match="theta1 is not in radians"):
        from_quadratures(bad, rms=True)
    with pytest.raises(ChannelError, match="holds no quadratures"):
        read_quadratures(table(tmp_path / "a.csv", "A1 [nm], phi1 [deg]", np.ones(3), np.ones(3)))
    with pytest.raises(ObservablesError, match="no pixel"):
        from_quadratures(
            quadratures()[["X1", "Y1"]] * np.nan + xr.zeros_like(quadratures()[["X1", "Y1"]]), rms=True
        )
