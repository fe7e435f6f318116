import struct

import numpy as np
import pytest

from overtone.errors import FileFormatError
from overtone.io.registry import read_channels

PAGE = """<!DOCTYPE html><html><head><style>td.caption {{ color: red; }}</style></head><body><table>
<tr><td class="caption">Scan Area (X, Y, Z):</td><td>[&micro;m]</td><td>3.000</td><td>2.000</td></tr>
<tr><td class="caption">Tip Frequency:</td><td>[Hz]</td><td>{frequency}</td><td>&nbsp;</td></tr>
<tr><td class="caption">Tapping Amplitude:</td><td>[nm]</td><td>60.000</td><td>&nbsp;</td></tr>
<tr><td class="caption">Setpoint:</td><td>[%]</td><td>80.00</td></tr>
</table></body></html>"""
VALUES = np.arange(6.0).reshape(2, 3)


@pytest.fixture
def make_set(tmp_path, gwyddion_field):
    def make(fields, frequency="237,595.092", stem="2020 [a] scan", **header):
        header = {"XReal": 3e-6, "YReal": 2e-6, "XYUnits": "m", "ZUnits": "", **header}
        for token, values in fields.items():
            unit = {"ZUnits": "m"} if token.endswith("Z") else {}
            (tmp_path / f"{stem} {token}.gsf").write_bytes(gwyddion_field(values, **{**header, **unit}))
        (tmp_path / f"{stem}.html").write_text(PAGE.format(frequency=frequency), encoding="utf-8")
        return tmp_path

    return make


def by_name(scan):
    return {channel.name: channel for channel in scan.channels}


def test_set_of_harmonics(make_set):
    folder = make_set({"Z": VALUES, "M1A": VALUES * 0 + 59.5, "M1P": VALUES, "M2A": VALUES})
    scan = read_channels(folder)
    assert (scan.format, scan.vendor, scan.dims) == ("neasnom", "neasnom", ("y", "x"))
    channels = by_name(scan)
    assert {name: c.unit for name, c in channels.items()} == {"M1A": "m", "M1P": "rad", "M2A": None, "Z": "m"}
    np.testing.assert_allclose(channels["M1A"].values, 59.5e-9, rtol=1e-6)
    np.testing.assert_array_equal(channels["Z"].values, VALUES)
    np.testing.assert_allclose(scan.coords["y"], [1.5e-6, 0.5e-6])
    assert (scan.facts["drive_frequency"].value, scan.facts["drive_frequency"].unit) == (237595.092, "Hz")
    assert scan.facts["setpoint_amplitude"].value == pytest.approx(60e-9)
    assert scan.facts["setpoint_amplitude"].key == "Tapping Amplitude [nm]"
    assert scan.metadata["Setpoint [%]"] == "80.00"
    assert any("M1A: taken to be in nm" in note for note in scan.notes)
    assert {c.direction for c in scan.channels} == {None}


def test_any_file_of_the_set_opens_it(make_set):
    folder = make_set({"Z": VALUES, "M1A": VALUES})
    names = [[c.name for c in read_channels(path).channels] for path in [folder, *folder.iterdir()]]
    assert names == [["M1A", "Z"]] * 4


def test_amplitude_that_is_not_the_tapping_amplitude_has_no_unit(make_set):
    scan = read_channels(make_set({"Z": VALUES, "M1A": VALUES * 0 + 57.0}))
    assert by_name(scan)["M1A"].unit is None
    np.testing.assert_array_equal(by_name(scan)["M1A"].values, 57.0)
    assert any("not taken to be in nm" in note for note in scan.notes)


def test_size_from_the_page_where_the_fields_have_none(make_set):
    scan = read_channels(make_set({"Z raw": VALUES}, YReal=0))
    assert [c.name for c in scan.channels] == ["Z"]
    np.testing.assert_allclose(scan.coords["y"], [1.5e-6, 0.5e-6])
    assert any("scan area of the page" in note for note in scan.notes)


def test_backward_lines_and_raw_copies(make_set):
    scan = read_channels(make_set({"Z": VALUES, "Z raw": VALUES, "R-Z": VALUES, "R-M1P raw": VALUES}))
    told = [(c.name, c.direction) for c in scan.channels]
    assert told == [("M1P", "retrace"), ("Z", "retrace"), ("Z raw", "trace"), ("Z", "trace")]
    assert {c.unit for c in scan.channels if c.name == "M1P"} == {"rad"}


def test_field_of_another_shape_is_left_out(make_set):
    scan = read_channels(make_set({"Z": VALUES, "M1A": np.ones((4, 4))}))
    assert [c.name for c in scan.channels] == ["Z"]
    assert any("M1A: left out" in note for note in scan.notes)


def test_incomplete_scan_is_told(make_set):
    scan = read_channels(make_set({"Z": VALUES}, YResIncomplete=1))
    assert "the scan is incomplete: 1 of 2 lines were recorded" in scan.notes


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("237,595.092", 237595.092),
        ("237.595,092", 237595.092),
        ("237,595", 237595.0),
        ("0,5", 0.5),
        ("1e5", 1e5),
    ],
)
def test_separators_of_thousands(make_set, text, value):
    assert read_channels(make_set({"Z": VALUES}, frequency=text)).facts["drive_frequency"].value == value


def test_two_sets_in_one_folder(make_set):
    make_set({"Z": VALUES}, stem="one")
    folder = make_set({"Z": VALUES * 2}, stem="two")
    with pytest.raises(FileFormatError, match="one neaSNOM measurement"):
        read_channels(folder)
    np.testing.assert_array_equal(read_channels(folder / "two.html").channels[0].values, VALUES * 2)
    np.testing.assert_array_equal(read_channels(folder / "one Z.gsf").channels[0].values, VALUES)


def test_page_without_its_fields(make_set):
    folder = make_set({})
    with pytest.raises(FileFormatError, match="no channels"):
        read_channels(next(folder.iterdir()))


def test_damaged_field_is_named(make_set):
    folder = make_set({"Z": VALUES, "M1A": VALUES})
    field = folder / "2020 [a] scan M1A.gsf"
    field.write_bytes(field.read_bytes()[:-5])
    with pytest.raises(FileFormatError, match=r"M1A\.gsf"):
        read_channels(folder)


def test_real_harmonics(afm_data):
    folder = afm_data / "neasnom" / "SnO2_NW4_hyp"
    scan = read_channels(folder)
    channels = by_name(scan)
    assert len(channels) == 26
    assert channels["Z"].values.shape == (10, 20)
    assert channels["Z"].unit == "m"
    assert (channels["M1A"].unit, channels["M1A"].values.mean()) == (
        "m",
        pytest.approx(86.951e-9, rel=1e-5, abs=0),
    )
    assert (channels["M2A"].unit, channels["M2A"].values.mean()) == (
        None,
        pytest.approx(0.040392, rel=1e-4, abs=0),
    )
    assert (channels["M2P"].unit, channels["M2P"].values.mean()) == (
        "rad",
        pytest.approx(-0.981756, rel=1e-5, abs=0),
    )
    assert scan.facts["drive_frequency"].value == 237595.092
    assert scan.facts["setpoint_amplitude"].value == pytest.approx(87.076e-9)
    assert scan.facts["setpoint_fraction"].value == pytest.approx(0.7046)
    assert scan.facts["scale:M1A"].value == pytest.approx(4.978e-9)
    assert scan.metadata["Setpoint [%]"] == "70.46"
    np.testing.assert_allclose(scan.coords["x"], (np.arange(20) + 0.5) * 0.04e-6)
    # The last float of the file is the lower right pixel.
    (file,) = folder.glob("* M3P.gsf")
    content = file.read_bytes()
    assert channels["M3P"].values[-1, -1] == struct.unpack("<f", content[-4:])[0]
    assert channels["M3P"].values[0, 0] == struct.unpack("<f", content[-800:-796])[0]


def test_a_page_that_was_cut_off_within_a_number(make_set):
    folder = make_set({"Z": VALUES, "M1A": VALUES * 0 + 59.5})
    (page,) = folder.glob("*.html")
    text = page.read_text(encoding="utf-8")
    page.write_text(text[: text.index("595.092")], encoding="utf-8")
    scan = read_channels(folder)
    assert "drive_frequency" not in scan.facts  # not 237 Hz
    assert any(
        note.endswith("was cut off: settings behind row 1 of its table are missing") for note in scan.notes
    )
    # A page without the last tags is whole as long as its rows are.
    page.write_text(text[: text.index("</table>")], encoding="utf-8")
    assert not any("cut off" in note for note in read_channels(folder).notes)
