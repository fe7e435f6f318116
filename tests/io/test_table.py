import math
import time

import numpy as np
import pytest
import xarray as xr

import overtone as ot
from overtone.errors import FileFormatError
from overtone.io.registry import read_channels


@pytest.fixture
def read_table(tmp_path):
    def read(text, name="table.csv", encoding="utf-8"):
        path = tmp_path / name
        path.write_bytes(text.encode(encoding) if isinstance(text, str) else text)
        return read_channels(path)

    return read


def by_name(recording):
    return {channel.name: channel for channel in recording.channels}


def test_grid_with_units(read_table):
    scan = read_table(
        "# instrument: lock-in 2\n# a remark\nx [nm], y [nm], A0 [pm], A1 (nm), phi1/deg, gain\n"
        "0,0,-10,60,90,1\n10,0,-20,61,,2\n0,5,-30,62,80,3\n10,5,-40,63,70,4\n"
    )
    assert (scan.format, scan.vendor, scan.dims) == ("table", "overtone", ("y", "x"))
    np.testing.assert_allclose(scan.coords["x"], [0, 10e-9])
    np.testing.assert_allclose(scan.coords["y"], [5e-9, 0])
    channels = by_name(scan)
    assert {name: c.unit for name, c in channels.items()} == {
        "A0": "m",
        "A1": "m",
        "phi1": "rad",
        "gain": None,
    }
    np.testing.assert_allclose(channels["A1"].values, [[62e-9, 63e-9], [60e-9, 61e-9]])
    np.testing.assert_allclose(channels["A0"].values[0], [-30e-12, -40e-12])
    assert math.isnan(channels["phi1"].values[1, 1])
    assert channels["phi1"].values[1, 0] == pytest.approx(math.pi / 2)
    assert scan.metadata == {"instrument": "lock-in 2"}
    assert "gain: the header states no unit" in scan.notes


def test_order_of_rows_does_not_matter(read_table):
    rows = [f"{x},{y},{10 * y + x}" for x in (0.1, 0.2, 0.3) for y in (0.7, 0.4)]
    np.random.default_rng(1).shuffle(rows)
    scan = read_table("X [µm],Y [µm],A1 [nm]\n" + "\n".join(rows))
    np.testing.assert_allclose(scan.coords["y"], [0.7e-6, 0.4e-6])
    np.testing.assert_allclose(scan.channels[0].values, np.array([[7.1, 7.2, 7.3], [4.1, 4.2, 4.3]]) * 1e-9)


@pytest.mark.parametrize(
    "rows", ["0,0,1\n1,0,2\n0,1,3", "0,0,1\n0,0,2\n1,1,3\n1,1,4", "0,0,1\n,1,2\n1,0,3\n1,1,4"]
)
def test_points_that_fill_no_grid(read_table, rows):
    scan = read_table("x [nm],y [nm],A1 [nm]\n" + rows)
    assert (scan.dims, dict(scan.coords)) == (("point",), {})
    assert [c.name for c in scan.channels] == ["x", "y", "A1"]
    assert any("rectangle" in note for note in scan.notes)


def test_grid_without_lengths(read_table):
    scan = read_table("x,y,A1 [nm]\n0,0,1\n1,0,2\n")
    assert (scan.dims, dict(scan.coords), scan.channels[0].values.shape) == (("y", "x"), {}, (1, 2))


def test_curve(read_table):
    curve = read_table("z [nm]\tA1 [nm]\n3\t1\n2\t0.5\n3\t1\n", "curve.tsv")
    assert curve.dims == ("z",)
    np.testing.assert_allclose(curve.coords["z"], [3e-9, 2e-9, 3e-9])
    assert read_table("z,A1 [nm]\n3,1\n").dims == ("point",)


@pytest.mark.parametrize("separator", [";", "\t"])
def test_decimal_comma(read_table, separator):
    scan = read_table(f"t [s]{separator}A1 [nm]\n0,5{separator}1\n1,5{separator}-2,25e1\n")
    np.testing.assert_allclose(by_name(scan)["A1"].values, [1e-9, -22.5e-9])
    np.testing.assert_allclose(by_name(scan)["t"].values, [0.5, 1.5])
    with pytest.raises(FileFormatError, match="line 3, column 'A1' with a decimal comma"):
        read_table(f"t [s]{separator}A1 [nm]\n0,5{separator}1\n1,5{separator}2.5\n")


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16", "latin-1"])
def test_encodings(read_table, encoding):
    scan = read_table("x0 [µm],phi1 [°]\r\n1,90\r\n2,45\r\n", encoding=encoding)
    assert [(c.name, c.unit) for c in scan.channels] == [("x0", "m"), ("phi1", "rad")]


def test_header_in_a_comment(read_table, tmp_path):
    np.savetxt(tmp_path / "a.csv", [[1.0, 2.0], [3.0, 4.0]], delimiter=",", header="A0 [pm], A1 [nm]")
    scan = read_channels(tmp_path / "a.csv")
    assert [(c.name, c.unit) for c in scan.channels] == [("A0", "m"), ("A1", "m")]
    np.testing.assert_allclose(scan.channels[1].values, [2e-9, 4e-9])


def test_units_that_are_unknown_or_open(read_table):
    scan = read_table("B [T],S [a.u.],E [nm/V],a/b,q [1]\n1,2,3,4,5\n")
    assert [(c.name, c.unit) for c in scan.channels] == [
        ("B", None),
        ("S", None),
        ("E", "m/V"),
        ("a/b", None),
        ("q", "1"),
    ]
    assert "B: the unit 'T' is not known; values are as in the file" in scan.notes


def test_missing_cells(read_table):
    scan = read_table("A1 [nm],A2 [nm],\n1\n2,NaN,,\n, 3\n\n")
    np.testing.assert_allclose(by_name(scan)["A2"].values, [math.nan, math.nan, 3e-9])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("A1 [nm],A2 [nm]\n1,2\n3,four\n", "line 3, column 'A2'.*'four'"),
        ("A1 [nm],A2 [nm]\n1,2\n3,1_000\n", "line 3, column 'A2'"),
        ("A1 [nm],A2 [nm]\n1,2,3\n", "2 cells in line 2"),
        ("A1 [nm],A1 [pm]\n1,2\n", "A1 twice"),
        ("A1 [nm],A2 [nm]\n", "rows of numbers"),
        ("1,2\n3,4\n", "column names"),
        ("A1" + " " * 100_000 + "[nm],A2\n1,2\n", "ordinary length"),
        ("# only a remark\n", "header and rows"),
        ('A1 [nm],A2 [nm]\n1,"2\n3",4\n', "quotation marks"),
        ("A1 [nm],A2 [nm]\n1,2\n" + "9" * 200_000 + ",1\n", "not a table"),
    ],
)
def test_what_is_wrong_is_named(read_table, text, message):
    with pytest.raises(FileFormatError, match=message):
        read_table(text)


def test_large_map_in_reasonable_time(read_table):
    y, x = np.mgrid[0:128, 0:128]
    columns = np.stack([x.ravel(), y.ravel(), *np.random.default_rng(0).random((3, x.size))], axis=1)
    text = "x [nm],y [nm],A1 [nm],A2 [nm],phi1 [deg]\n" + "\n".join(
        ",".join(map(str, row)) for row in columns
    )
    start = time.perf_counter()
    assert read_table(text).channels[0].values.shape == (128, 128)
    assert time.perf_counter() - start < 5.0


@pytest.mark.parametrize("end", ["", "3", "3e-1", "3.5, "])
def test_a_table_that_ends_within_a_row_was_cut_off(tmp_path, end):
    path = tmp_path / "cut.csv"
    path.write_text(f"z [nm], A1 [nm], phi1 [deg]\n1, 2, 3\n{end}")
    if not end:
        assert read_channels(path).channels[0].values.size == 1
        return
    with pytest.raises(FileFormatError, match=r"3 cells in line 3, got \d and the end of the file"):
        read_channels(path)
    # Short rows stay allowed: with an end, or where others are short too.
    path.write_text(f"z [nm], A1 [nm], phi1 [deg]\n1, 2, 3\n{end}\n")
    assert read_channels(path).channels[0].values.size == 2
    path.write_text(f"z [nm], A1 [nm], phi1 [deg]\n1, 2\n{end}")
    assert read_channels(path).channels[0].values.size == 2


def test_rows_of_a_table_of_ours_are_counted(tmp_path):
    path = tmp_path / "own.csv"
    ot.save(xr.Dataset({"A1": ("z", [1.0, 2.0, 3.25], {"units": "m"})}, {"z": [3.0, 2.0, 1.0]}), path)
    text = path.read_text()
    assert "# rows: 3\n" in text
    for cut in (text[:-1], text[:-2], text[: text.rindex("\n", 0, -1) + 1]):
        path.write_text(cut)
        with pytest.raises(FileFormatError, match="3 rows as its first lines say"):
            read_channels(path)
    path.write_text(text.replace("# rows: 3\n", ""))
    assert read_channels(path).channels[0].values.size == 3
    path.write_text(text.replace("# rows: 3\n", "# rows: 9\n").replace("# written by", "# copied from"))
    assert read_channels(path).channels[0].values.size == 3  # somebody else's line
