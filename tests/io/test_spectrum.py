from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import xarray as xr

import overtone as ot
from overtone.errors import ChannelError, ChannelWarning, FileFormatError, OvertoneError, UnitError
from overtone.io.spectrum import density_factor, read_spectrum, spectrum_array

F = np.array([1e3, 2e3, 3e3])


def table(tmp_path: Path, text: str, name: str = "thermal.csv") -> Path:
    path = tmp_path / name
    path.write_text(text, encoding="utf-8")
    return path


@pytest.mark.parametrize(
    ("unit", "expected"),
    [
        ("m^2/Hz", (1.0, "m^2/Hz", False)),
        ("pm²/Hz", (1e-24, "m^2/Hz", False)),
        ("V^2/kHz", (1e-3, "V^2/Hz", False)),
        ("fm/rtHz", (1e-15, "m^2/Hz", True)),
        ("m/√Hz", (1.0, "m^2/Hz", True)),
        ("nV/sqrt(Hz)", (1e-9, "V^2/Hz", True)),
        ("V/Hz^0.5", (1.0, "V^2/Hz", True)),
        ("V/Hz^(1/2)", (1.0, "V^2/Hz", True)),
        ("pm Hz^-0.5", (1e-12, "m^2/Hz", True)),
        ("V", None),
        ("m/Hz", None),
        ("N/rtHz", None),
        ("dB", None),
        ("", None),
    ],
)
def test_units_of_densities(unit: str, expected: tuple[float, str, bool] | None) -> None:
    found = density_factor(unit)
    if expected is None:
        assert found is None
    else:
        assert found is not None
        assert found[1:] == expected[1:]
        assert found[0] == pytest.approx(expected[0], rel=1e-12, abs=0)


@pytest.mark.parametrize(
    ("header", "factor", "unit", "power"),
    [
        ("frequency [kHz], density [V^2/Hz]", 1.0, "V^2/Hz", 1),
        ("f (kHz), amplitude (fm/rtHz)", 1e-15, "m^2/Hz", 2),
        ("Frequency [kHz], PSD [V/sqrt(Hz)]", 1.0, "V^2/Hz", 2),
        ("Frequency/kHz, PSD/pm^2/Hz", 1e-24, "m^2/Hz", 1),
    ],
)
def test_tables_with_units_in_the_header(
    tmp_path: Path, header: str, factor: float, unit: str, power: int
) -> None:
    path = table(tmp_path, f"# lever: 3\n{header}\n1, 2\n3, 5\n2, 4\n")
    found = read_spectrum(path)
    np.testing.assert_allclose(found["frequency"].values, F)
    np.testing.assert_allclose(found.values, (factor * np.array([2.0, 4.0, 5.0])) ** power, rtol=1e-12)
    assert (found.dims, found.attrs["units"], found["frequency"].attrs["units"]) == (
        ("frequency",),
        unit,
        "Hz",
    )
    assert found.attrs["source"] == "thermal.csv"


def test_tabs_and_decimal_commas(tmp_path: Path) -> None:
    found = read_spectrum(table(tmp_path, "f [Hz]\tS [V/rtHz]\n10,5\t0,5\n20,5\t1,5\n", "thermal.tsv"))
    np.testing.assert_allclose(found["frequency"].values, [10.5, 20.5])
    np.testing.assert_allclose(found.values, [0.25, 2.25])


def test_of_several_columns_one_has_to_be_named(tmp_path: Path) -> None:
    path = table(
        tmp_path, "f [Hz], before [V/rtHz], after [V/rtHz], temperature [K]\n1, 2, 3, 4\n2, 3, 4, 5\n"
    )
    with pytest.raises(ChannelError, match="before, after"):
        read_spectrum(path)
    np.testing.assert_allclose(read_spectrum(path, channel="after").values, [9.0, 16.0])
    with pytest.raises(ChannelError, match="no 'later'"):
        read_spectrum(path, channel="later")
    with pytest.raises(UnitError, match="no unit of a spectrum"):
        read_spectrum(path, channel="temperature")


def test_a_unit_may_be_stated_where_the_file_has_none(tmp_path: Path) -> None:
    path = table(tmp_path, "f [Hz], S\n1, 2\n2, 3\n")
    with pytest.raises(UnitError, match="no spectral density"):
        read_spectrum(path)
    found = read_spectrum(path, unit="nV/rtHz")
    np.testing.assert_allclose(found.values, [4e-18, 9e-18])
    with pytest.raises(UnitError, match="no unit of a spectrum"):
        read_spectrum(path, unit="dBV")


@pytest.mark.parametrize(
    ("text", "error", "word"),
    [
        ("S [V/rtHz], T [V/rtHz]\n1, 2\n2, 3\n", ChannelError, "no column of frequencies"),
        ("f [Hz], S [dBm]\n1, 2\n2, 3\n", UnitError, "no spectral density"),
        ("f [Hz], S [V/rtHz]\n-1, 2\n2, 3\n", FileFormatError, "not usable"),
        ("f [Hz], S [V/rtHz]\n1, 2\n1, 3\n", FileFormatError, "not usable"),
        ("f [Hz], S [V/rtHz]\n1, 2\n", FileFormatError, "without bins"),
        ("f [Hz], S [V/rtHz]\n", FileFormatError, "rows of numbers"),
        ("x [nm], y [nm], S [V/rtHz]\n0, 0, 1\n1, 0, 1\n", FileFormatError, "map or a curve"),
        ("", FileFormatError, "empty"),
        ("%PDF-1.7\x01", FileFormatError, "not known"),
    ],
)
def test_files_without_a_spectrum_say_why(
    tmp_path: Path, text: str, error: type[OvertoneError], word: str
) -> None:
    with pytest.raises(error, match=word):
        read_spectrum(table(tmp_path, text))


def test_a_missing_file_says_so(tmp_path: Path) -> None:
    with pytest.raises(FileFormatError, match="there is no file"):
        read_spectrum(tmp_path / "nothing.csv")


def test_an_igor_wave_is_scaled_in_frequency(tmp_path: Path, igor_wave: Callable[..., bytes]) -> None:
    path = tmp_path / "thermal.ibw"
    wave = {"steps": (76.3, 1, 1, 1), "axis_units": ("Hz", "", "", "")}
    path.write_bytes(igor_wave(np.array([3e-13, 5e-13, 4e-13]), note="InvOLS: 5e-08\rThermalQ: 20", **wave))
    with pytest.warns(ChannelWarning, match="m/rtHz"):
        found = read_spectrum(path)
    np.testing.assert_allclose(found["frequency"].values, [0.0, 76.3, 152.6])
    np.testing.assert_allclose(found.values, [9e-26, 25e-26, 16e-26])
    assert (found.attrs["units"], found.attrs["vendor"]) == ("m^2/Hz", "asylum")
    np.testing.assert_allclose(read_spectrum(path, unit="V^2/Hz").values, [3e-13, 5e-13, 4e-13])

    path.write_bytes(igor_wave(np.array([3.0, 5.0, 4.0]), **wave))
    with pytest.raises(UnitError, match="no unit of a spectrum"):
        read_spectrum(path)
    path.write_bytes(igor_wave(np.array([3.0, 5.0, 4.0])))
    with pytest.raises(UnitError, match="not scaled in Hz"):
        read_spectrum(path, unit="V/rtHz")
    path.write_bytes(igor_wave(np.ones((3, 4)), **wave))
    with pytest.raises(FileFormatError, match="one-dimensional"):
        read_spectrum(path)


def test_a_real_image_is_no_spectrum(afm_data: Path) -> None:
    with pytest.raises(FileFormatError, match="no spectrum"):
        read_spectrum(afm_data / "ibw" / "AR_20211011.ibw")


def test_netcdf_keeps_what_is_known_of_the_averages(tmp_path: Path) -> None:
    density = spectrum_array(F, np.array([1.0, 2.0, 3.0]), "V^2/Hz", averages=12.5, window="hann")
    ot.save(density.to_dataset(), tmp_path / "thermal.nc")
    found = read_spectrum(tmp_path / "thermal.nc")
    np.testing.assert_array_equal(found.values, density.values)
    assert (found.attrs["averages"], found.attrs["window"]) == (12.5, "hann")
    amplitude = xr.Dataset(
        {"S": ("frequency", [1.0, 2.0, 3.0], {"units": "pm/rtHz"})},
        coords={"frequency": ("frequency", [1.0, 2.0, 3.0], {"units": "kHz"})},
    )
    ot.save(amplitude, tmp_path / "other.nc")
    other = read_spectrum(tmp_path / "other.nc")
    np.testing.assert_allclose(other.values, [1e-24, 4e-24, 9e-24], rtol=1e-12)
    np.testing.assert_allclose(other["frequency"].values, F)
    ot.save(amplitude.drop_vars("frequency"), tmp_path / "bare.nc")
    with pytest.raises(FileFormatError, match="no spectrum"):
        read_spectrum(tmp_path / "bare.nc")
    amplitude["frequency"].attrs["units"] = "s"
    ot.save(amplitude, tmp_path / "time.nc")
    with pytest.raises(UnitError, match="no unit of frequency"):
        read_spectrum(tmp_path / "time.nc")
