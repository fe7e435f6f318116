import numpy as np
import pytest
import xarray as xr

from overtone.quantities import named_array
from overtone.report.shares import flag_shares, flags, format_share, status_shares

STATUS = {
    "flag_values": np.array([0, 1, 4]),
    "flag_meanings": "determined not_determined_by_these_data at_bound",
}


def test_shares_of_every_flag():
    status = named_array("status", np.array([[0, 1], [1, 1]], np.int8), ("y", "x"), **STATUS)
    assert flag_shares(status) == {"determined": 0.25, "not determined by these data": 0.75, "at bound": 0.0}


def test_no_flags_no_shares():
    assert flags(xr.DataArray([1, 2])) == {}


@pytest.mark.parametrize(
    ("share", "text"), [(0.0, "0 %"), (1e-6, "< 0.1 %"), (0.5, "50.0 %"), (1 - 1e-6, "> 99.9 %")]
)
def test_a_share_never_rounds_to_none_or_all(share, text):
    assert format_share(share) == text


def test_results_side_by_side():
    one = xr.Dataset({"status": named_array("status", [0, 1], ("x",), **STATUS)})
    other = xr.Dataset({"status": named_array("status", [1, 1], ("x",), **STATUS)})
    table = status_shares({"a": one, "b": other})
    assert table.columns == ("status", "a", "b")
    assert table.rows == (
        ("determined", "50.0 %", "0 %"),
        ("not determined by these data", "50.0 %", "100 %"),
    )
