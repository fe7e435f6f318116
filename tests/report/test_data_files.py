"""Tables as text: units in the first line, the same numbers back, categories in words."""

import csv
import math

import numpy as np
import pytest
import xarray as xr

from overtone.io import table as table_reader
from overtone.report.content import Table
from overtone.report.data_files import cells_text, table_text


@pytest.fixture
def maps() -> xr.Dataset:
    rng = np.random.default_rng(0)
    values = rng.normal(size=(3, 4)) * 1e-12
    values[1, 2] = math.nan
    return xr.Dataset(
        {
            "A0": (("y", "x"), values),
            "thing": (("y", "x"), rng.normal(size=(3, 4)), {"units": "N/m"}),
            "phase": (
                ("y", "x"),
                np.arange(12, dtype=np.int8).reshape(3, 4) % 3 - 1,
                {"flag_values": [-1, 0, 1], "flag_meanings": "none soft_one stiff"},
            ),
        },
        coords={"y": np.arange(3)[::-1] * 1e-8, "x": np.arange(4) * 1e-8},
    )


def test_a_map_reads_back(maps, tmp_path):
    path = tmp_path / "map.csv"
    path.write_text(table_text(maps, ("figure: a map",)), encoding="utf-8")
    recording = table_reader.read(path)
    found = {channel.name: channel for channel in recording.channels}
    np.testing.assert_array_equal(found["A0"].values, maps["A0"].values)
    np.testing.assert_array_equal(found["phase"].values, maps["phase"].values)
    assert (found["A0"].unit, found["thing"].unit) == ("m", "N/m")
    np.testing.assert_array_equal(recording.coords["y"], maps["y"].values)
    assert recording.metadata == {"figure": "a map", "phase": "-1 = none, 0 = soft one, 1 = stiff"}


def test_the_first_lines(maps):
    lines = table_text(maps).splitlines()
    assert lines[0] == "# phase: -1 = none, 0 = soft one, 1 = stiff"
    assert lines[1] == "x [m],y [m],A0 [m],thing [N/m],phase [1]"
    assert lines[2].split(",")[:2] == ["0.0", "2e-08"]
    assert lines[2 + 6].split(",")[2] == ""  # what is not known


def test_texts_and_repeated_dimensions():
    dataset = xr.Dataset(
        {
            "force": (("material", "row"), np.arange(4.0).reshape(2, 2), {"units": "N"}),
            "p": ("material", [0.5, 0.25]),
        },
        coords={"material": ["a, b", 'c"'], "row": ["r1", "r2"]},
    )
    rows = list(csv.reader(table_text(dataset).splitlines()))
    assert rows == [
        ["material", "row", "force [N]", "p [1]"],
        ["a, b", "r1", "0.0", "0.5"],
        ["a, b", "r2", "1.0", "0.5"],
        ['c"', "r1", "2.0", "0.25"],
        ['c"', "r2", "3.0", "0.25"],
    ]


def test_single_precision_is_kept():
    value = np.float32(0.1)
    text = table_text(xr.Dataset({"a": ("i", np.array([value], np.float32))}))
    assert np.float32(text.splitlines()[-1].split(",")[1]) == value


def test_nothing_has_a_header_only():
    assert table_text(xr.Dataset({"a": ("i", np.empty(0))})).splitlines() == ["i [1],a [1]"]


def test_cells():
    assert cells_text(Table("t", ("a", "b"), (("1", "x, y"),))) == 'a,b\n1,"x, y"\n'
