"""Quadratures of lock-ins: signs, factors and units, and which harmonic a channel belongs to."""

import math
from pathlib import Path

import numpy as np
import pytest
import xarray as xr

import overtone as ot
from overtone import provenance
from overtone.errors import ChannelError, ObservablesError, PhaseReferenceWarning, UnitError
from overtone.harmonics import far_phase, to_force_harmonics
from overtone.io.quadratures import from_quadratures, read_quadratures


def table(path: Path, header: str, *columns: np.ndarray) -> Path:
    rows = "\n".join(", ".join(f"{value:.9g}" for value in row) for row in zip(*columns, strict=True))
    path.write_text(f"{header}\n{rows}\n", encoding="utf-8")
    return path


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
