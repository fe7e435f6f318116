import numpy as np
import pytest

from overtone.errors import FileFormatError
from overtone.io.registry import read_channels

VALUES = np.arange(6.0).reshape(2, 3)


@pytest.fixture
def read_field(tmp_path, gwyddion_field):
    def read(**header):
        path = tmp_path / "alone.gsf"
        path.write_bytes(gwyddion_field(VALUES, **header))
        return read_channels(path)

    return read


def test_lone_field(read_field):
    scan = read_field(Title="Amplitude", XReal=3e-6, YReal=4.0e-6, XYUnits="m", ZUnits="nm")
    assert (scan.format, scan.vendor, scan.dims) == ("gsf", "gwyddion", ("y", "x"))
    assert (scan.channels[0].name, scan.channels[0].unit) == ("Amplitude", "m")
    np.testing.assert_allclose(scan.channels[0].values, VALUES * 1e-9)
    np.testing.assert_allclose(scan.coords["x"], [0.5e-6, 1.5e-6, 2.5e-6])
    np.testing.assert_allclose(scan.coords["y"], [3e-6, 1e-6])


def test_missing_size_and_unit_are_told(read_field):
    scan = read_field(XReal=3e-6, YReal=0, XYUnits="m")
    assert (scan.channels[0].name, scan.channels[0].unit, dict(scan.coords)) == ("alone", None, {})
    assert any("no coordinates" in note for note in scan.notes)
    assert any("no unit" in note for note in scan.notes)
    assert any("'T'" in note for note in read_field(ZUnits="T").notes)


def test_header_with_equal_signs_and_latin_text(tmp_path, gwyddion_field):
    path = tmp_path / "field.gsf"
    path.write_bytes(gwyddion_field(VALUES, Comment="a=b", Note="µm").replace("µ".encode(), b"\xb5 "))
    scan = read_channels(path)
    assert (scan.metadata["Comment"], scan.metadata["Note"]) == ("a=b", "\xb5 m")


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (b"XRes = 3", b"XRes = 9", "72 bytes"),
        (b"XRes = 3", b"XRes = -", "XRes"),
        (b"XRes = 3", b"XRes = 0", "XRes"),
        (b"YRes = 2", b"Yres = 2", "YRes"),
        (b"XRes = 3", b"XRes = 999999999", "bytes of data"),
        (b"XRes = 3", b"XRes = " + b"9" * 5000, "XRes"),
    ],
)
def test_header_that_does_not_fit(tmp_path, gwyddion_field, old, new, message):
    path = tmp_path / "field.gsf"
    path.write_bytes(gwyddion_field(VALUES).replace(old, new))
    with pytest.raises(FileFormatError, match=message):
        read_channels(path)


def test_real_field(afm_data):
    scan = read_channels(afm_data / "gwyddion" / "GwiddionReader_chip.gsf")
    assert (scan.channels[0].name, scan.channels[0].unit, scan.channels[0].values.shape) == (
        "Topography",
        "m",
        (300, 300),
    )
    assert scan.channels[0].values.mean() == pytest.approx(1.61414e-5, rel=1e-5, abs=0)
    assert scan.coords["x"][-1] == pytest.approx(80e-6 * 299.5 / 300)


def test_agrees_with_the_reference_reader(afm_data):
    import gsffile

    for path in [afm_data / "gwyddion" / "GwiddionReader_chip.gsf", *afm_data.glob("neasnom/*/* O*A.gsf")]:
        from overtone.io.gsf import read_field

        expected, header = gsffile.read_gsf(path)
        field = read_field(path)
        np.testing.assert_array_equal(field.values, expected)
        assert float(field.header["XReal"]) == header["XReal"]
