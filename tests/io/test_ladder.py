from pathlib import Path

import numpy as np
import pytest
import xarray as xr

import overtone as ot
from overtone.errors import ChannelError, ChannelWarning, OvertoneError
from overtone.io.ladder import open_ladder
from overtone.provenance import history
from overtone.quantities import validate_observables

TEXT = """# instrument: lock-in 2
frequency [kHz], drive, z [um], A0 [pm], A1 [nm], phi1 [deg], A2 [pm], phi2 [deg]
161.0, 1.0, 1.5, 10, 50, 120, 30, 10
161.8, 1.0, 1.5, 11, 60,  90, 31, 20
162.6, 1.0, 1.6, 12, 50,  60, 32, 30
"""


def table(tmp_path: Path, text: str, name: str = "ladder.csv") -> Path:
    path = tmp_path / name
    path.write_text(text, encoding="utf-8")
    return path


def netcdf(tmp_path: Path, **coords: object) -> Path:
    data = {"A1": ("point", [5e-8, 6e-8], {"units": "m"}), "phi1": ("point", [1.2, 1.6], {"units": "rad"})}
    path = tmp_path / "ladder.nc"
    ot.save(xr.Dataset(data, coords), path)
    return path


def test_a_table_is_a_ladder(tmp_path: Path) -> None:
    ladder = open_ladder(table(tmp_path, TEXT))
    assert ladder["A1"].dims == ("point",)
    validate_observables(ladder)
    np.testing.assert_allclose(ladder["frequency"], [161.0e3, 161.8e3, 162.6e3], rtol=1e-12)
    np.testing.assert_allclose(ladder["z"], [1.5e-6, 1.5e-6, 1.6e-6], rtol=1e-12)
    np.testing.assert_array_equal(ladder["drive"], [1.0, 1.0, 1.0])
    np.testing.assert_allclose(ladder["A0"], [1.0e-11, 1.1e-11, 1.2e-11], rtol=1e-12)
    np.testing.assert_allclose(ladder["A2"], [3.0e-11, 3.1e-11, 3.2e-11], rtol=1e-12)
    np.testing.assert_allclose(ladder["phi1"], np.radians([120.0, 90.0, 60.0]), rtol=1e-12)
    for name, unit in (("frequency", "Hz"), ("drive", "1"), ("z", "m"), ("A2", "m"), ("phi2", "rad")):
        assert ladder[name].attrs["units"] == unit
    assert ladder.attrs["source"] == "ladder.csv"
    assert history(ladder)[-1]["operation"] == "open_ladder"


def test_leads_become_lags(tmp_path: Path) -> None:
    path = table(tmp_path, TEXT)
    lags, leads = open_ladder(path), open_ladder(path, phase_sign=-1)
    for n in (1, 2):
        np.testing.assert_array_equal(leads[f"phi{n}"], -lags[f"phi{n}"])
        np.testing.assert_array_equal(leads[f"A{n}"], lags[f"A{n}"])
    np.testing.assert_array_equal(leads["A0"], lags["A0"])
    with pytest.raises(ChannelError, match="lags or leads"):
        open_ladder(path, phase_sign=0)


def test_only_what_varies_needs_to_be_there(tmp_path: Path) -> None:
    ladder = open_ladder(table(tmp_path, "A1 [nm], phi1 [deg]\n50, 90\n60, 80\n"))
    assert set(ladder.variables) == {"A1", "phi1"}
    # a table with heights alone is read as a curve, and is a ladder all the same
    curve = open_ladder(table(tmp_path, "z [nm], A1 [nm], phi1 [deg]\n900, 50, 90\n950, 60, 80\n"))
    assert curve["A1"].dims == ("point",)
    np.testing.assert_allclose(curve["z"], [9.0e-7, 9.5e-7], rtol=1e-12)


@pytest.mark.parametrize("unit", ["Hz", "kHz"])
def test_netcdf_keeps_what_stands_beside_the_points(tmp_path: Path, unit: str) -> None:
    f = np.array([161e3, 162e3])
    stated = f if unit == "Hz" else f * 1e-3
    path = netcdf(tmp_path, frequency=("point", stated, {"units": unit}), drive=("point", [1.0, 0.5]))
    ladder = open_ladder(path)
    np.testing.assert_allclose(ladder["frequency"], f, rtol=1e-12)
    np.testing.assert_array_equal(ladder["drive"], [1.0, 0.5])


def test_one_number_holds_for_all_points(tmp_path: Path) -> None:
    path = netcdf(tmp_path, drive=0.5, z=((), 1e-6, {"units": "m"}))
    ladder = open_ladder(path)
    np.testing.assert_array_equal(ladder["drive"], [0.5, 0.5])
    np.testing.assert_array_equal(ladder["z"], [1e-6, 1e-6])


def test_a_ladder_that_overtone_saved_comes_back(tmp_path: Path) -> None:
    ladder = open_ladder(table(tmp_path, TEXT))
    ot.save(ladder, tmp_path / "again.nc")
    again = open_ladder(tmp_path / "again.nc")
    for name in ladder.variables:
        np.testing.assert_allclose(again[name], ladder[name], rtol=1e-12)


def test_a_harmonic_without_its_phase_is_said_not_to_count(tmp_path: Path) -> None:
    path = table(tmp_path, "A1 [nm], phi1 [deg], A2 [pm], phi3 [deg]\n50, 90, 3, 1\n60, 80, 3, 1\n")
    with pytest.warns(ChannelWarning, match="does not count") as caught:
        open_ladder(path)
    said = " ".join(str(warning.message) for warning in caught)
    assert "A2 without phi2" in said
    assert "phi3 without A3" in said


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("A1 [nm]\n50\n60\n", "no column phi1"),
        ("frequency [kHz], A2 [pm]\n50, 1\n60, 1\n", "no column A1 and phi1"),
        ("A1 [V], phi1 [deg]\n50, 90\n60, 80\n", "A1 has the unit V"),
        ("A1, phi1 [deg]\n50, 90\n60, 80\n", "A1 has the unit none"),
        ("A1 [nm], phi1 [nm]\n50, 90\n60, 80\n", "phi1 has the unit m"),
        ("frequency, A1 [nm], phi1 [deg]\n1, 50, 90\n2, 60, 80\n", "frequency has the unit none"),
        ("frequency [s], A1 [nm], phi1 [deg]\n1, 50, 90\n2, 60, 80\n", "frequency has the unit s"),
        ("drive [V], A1 [nm], phi1 [deg]\n1, 50, 90\n2, 60, 80\n", "drive has the unit V"),
        ("z [V], A1 [nm], phi1 [deg]\n1, 50, 90\n2, 60, 80\n", "z has the unit V"),
    ],
)
def test_columns_that_are_missing_or_of_another_unit_are_named(
    tmp_path: Path, text: str, message: str
) -> None:
    with pytest.raises(ChannelError, match=message):
        open_ladder(table(tmp_path, text))


def test_what_does_not_fit_the_points_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ChannelError, match="frequency does not fit"):
        open_ladder(netcdf(tmp_path, frequency=("setpoint", [1.0, 2.0, 3.0], {"units": "Hz"})))
    with pytest.raises(ChannelError, match="unit furlong"):
        open_ladder(netcdf(tmp_path, z=("point", [1.0, 2.0], {"units": "furlong"})))


def test_two_readings_of_each_channel_are_refused(tmp_path: Path) -> None:
    data = {
        name: (("direction", "point"), np.full((2, 3), 1e-8), {"units": u})
        for name, u in (("A1", "m"), ("phi1", "rad"))
    }
    ot.save(xr.Dataset(data, {"direction": ["trace", "retrace"]}), tmp_path / "both.nc")
    with pytest.raises(ChannelError, match="a channel twice"):
        open_ladder(tmp_path / "both.nc")


def test_a_missing_file_is_an_error_of_ours(tmp_path: Path) -> None:
    with pytest.raises(OvertoneError, match="there is no file"):
        open_ladder(tmp_path / "none.csv")
