import json

import numpy as np
import pytest
import xarray as xr

from overtone.errors import FileFormatError, ObservablesError
from overtone.io.netcdf import load, save
from overtone.io.registry import read_channels


@pytest.fixture
def dataset():
    coords = {"y": ("y", [2e-9, 1e-9], {"units": "m"}), "x": ("x", [0.0, 1.0, 2.0], {"units": "nm"})}
    values = np.array([[1.0, 2.0, np.nan], [4.0, 5.0, 6.0]])
    variables = {
        "A1": (("y", "x"), values, {"units": "nm"}),
        "phi1": (("y", "x"), values, {"units": "deg"}),
        "bare": (("y", "x"), values.astype(np.float32)),
        "field": (("y", "x"), values, {"units": "T"}),
        "status": (("y", "x"), np.zeros((2, 3), dtype=np.int8), {"flag_meanings": "good bad"}),
        "F_cons": (("harmonic", "y", "x"), np.stack([values, values]), {"units": "N"}),
    }
    return xr.Dataset(variables, coords, {"history": json.dumps([{"operation": "µ"}]), "radius": 1e-8})


def test_round_trip(tmp_path, dataset):
    path = tmp_path / "map.nc"
    save(dataset, path)
    xr.testing.assert_identical(load(path), dataset)
    save(load(path), path)  # also over the very file it came from
    xr.testing.assert_identical(load(path), dataset)
    assert [file.name for file in tmp_path.iterdir()] == ["map.nc"]


def test_attributes_that_netcdf_cannot_hold(tmp_path):
    attributes = {
        "none": None,
        "flag": True,
        "nested": {"a": [1, 2]},
        "list": ["a", "b"],
        "big": 2**70,
        "empty": "",
    }
    attributes |= {"zero": "a\0b", "bytes": b"ab", "numbers": (1.5, 2.0), "long": "x" * 100_000, 5: 1}
    source = xr.Dataset({"A1": ("x", [1.0], dict(attributes))}, attrs=attributes)
    save(source, tmp_path / "a.nc")
    stored = load(tmp_path / "a.nc")
    for kept in (stored.attrs, stored["A1"].attrs):
        assert (kept["none"], kept["flag"], kept["empty"]) == ("null", "true", "")
        assert json.loads(kept["nested"]) == {"a": [1, 2]}
        assert json.loads(kept["list"]) == ["a", "b"]
        assert (kept["big"], kept["zero"], kept["bytes"]) == (str(2**70), "ab", "ab")
        np.testing.assert_array_equal(kept["numbers"], [1.5, 2.0])
        assert (len(kept["long"]), kept["5"]) == (100_000, 1)
    assert source.attrs["none"] is None
    assert source["A1"].attrs["flag"] is True


def test_floats_are_compressed(tmp_path):
    save(xr.Dataset({"A1": (("y", "x"), np.zeros((500, 500)))}), tmp_path / "a.nc")
    assert (tmp_path / "a.nc").stat().st_size < 100_000


def test_other_suffixes_are_refused(tmp_path, dataset):
    with pytest.raises(FileFormatError, match=r"\.nc"):
        save(dataset, tmp_path / "map.h5")
    with pytest.raises(FileFormatError, match="folder"):
        save(dataset, tmp_path / "missing" / "map.nc")


@pytest.mark.parametrize(
    ("bad", "message"),
    [
        (xr.Dataset({"c": ("x", [1j])}), "complex"),
        (xr.Dataset({"a/b": ("x", [1.0])}), "cannot be written"),
        (xr.Dataset({"o": ("x", np.array([{}, 1], dtype=object))}), "cannot be written"),
        (xr.DataArray([1.0]), "to_dataset"),
    ],
)
def test_failure_leaves_the_old_file_and_no_other(tmp_path, dataset, bad, message):
    path = tmp_path / "map.nc"
    save(dataset, path)
    before = path.read_bytes()
    with pytest.raises(ObservablesError, match=message):
        save(bad, path)
    assert path.read_bytes() == before
    assert [file.name for file in tmp_path.iterdir()] == ["map.nc"]


def test_recording(tmp_path, dataset):
    path = tmp_path / "map.nc"
    save(dataset, path)
    scan = read_channels(path)
    assert (scan.format, scan.vendor, scan.dims) == ("netcdf", "overtone", ("y", "x"))
    assert [(c.name, c.unit) for c in scan.channels] == [
        ("A1", "m"),
        ("phi1", "rad"),
        ("bare", None),
        ("field", None),
    ]
    assert scan.channels[0].values[1, 0] == pytest.approx(4e-9)
    assert np.isnan(scan.channels[0].values[0, 2])
    assert scan.channels[1].values[1, 0] == pytest.approx(np.radians(4))
    np.testing.assert_allclose(scan.coords["x"], [0, 1e-9, 2e-9])
    np.testing.assert_allclose(scan.coords["y"], [2e-9, 1e-9])
    assert scan.metadata["radius"] == "1e-08"
    assert any("status, F_cons" in note for note in scan.notes)


@pytest.mark.parametrize("names", [("trace", "retrace"), ("approach", "retract")])
def test_directions_become_those_of_the_channels(tmp_path, names):
    values = np.arange(12.0).reshape(2, 2, 3)
    both = xr.Dataset(
        {"A1": (("direction", "y", "x"), values, {"units": "m"}), "height": (("y", "x"), values[0])},
        {"direction": list(names)},
    )
    save(both, tmp_path / "both.nc")
    scan = read_channels(tmp_path / "both.nc")
    assert scan.dims == ("y", "x")
    assert [(c.name, c.direction) for c in scan.channels] == [
        ("A1", names[0]),
        ("A1", names[1]),
        ("height", None),
    ]
    for k, channel in enumerate(scan.channels[:2]):
        np.testing.assert_array_equal(channel.values, values[k])
    # one of them alone keeps its name, as a coordinate or as an attribute
    save(both.sel(direction=names[1]), tmp_path / "one.nc")
    assert {c.direction for c in read_channels(tmp_path / "one.nc").channels} == {names[1]}
    bare = both.sel(direction=names[1], drop=True).assign_attrs(direction=names[1])
    save(bare, tmp_path / "bare.nc")
    assert {c.direction for c in read_channels(tmp_path / "bare.nc").channels} == {names[1]}
    save(bare.assign_attrs(direction="up"), tmp_path / "other.nc")
    assert {c.direction for c in read_channels(tmp_path / "other.nc").channels} == {None}


def test_a_lift_pass_is_told_apart(tmp_path, dataset):
    lifted = dataset.assign(lift_A1=dataset["A1"] * 2, lift_phi1=dataset["phi1"])
    save(lifted.assign_attrs(lift_height=4e-8), tmp_path / "lift.nc")
    scan = read_channels(tmp_path / "lift.nc")
    assert [c.name for c in scan.channels if c.nap] == ["lift_A1", "lift_phi1"]
    assert (scan.facts["lift_height"].value, scan.facts["lift_height"].unit) == (4e-8, "m")
    save(dataset.assign_attrs(lift_height=4e-8), tmp_path / "none.nc")
    assert not read_channels(tmp_path / "none.nc").facts


def test_where_the_height_of_a_curve_is_zero(tmp_path):
    curve = xr.Dataset({"A1": ("z", np.ones(3), {"units": "m"})}, {"z": ("z", [3e-9, 2e-9, 1e-9])})
    save(curve, tmp_path / "curve.nc")
    assert "zero of z" not in read_channels(tmp_path / "curve.nc").metadata
    curve["z"].attrs["zero"] = "arbitrary"
    save(curve, tmp_path / "curve.nc")
    assert read_channels(tmp_path / "curve.nc").metadata["zero of z"] == "arbitrary"


def test_stack_and_curve_dimensions(tmp_path):
    stack = xr.Dataset(
        {"A1": (("setpoint", "z"), np.ones((2, 3)), {"units": "m"})}, {"setpoint": [0.5, 0.7], "z": [0, 1, 2]}
    )
    save(stack, tmp_path / "stack.nc")
    scan = read_channels(tmp_path / "stack.nc")
    assert scan.dims == ("setpoint", "z")
    np.testing.assert_array_equal(scan.coords["setpoint"], [0.5, 0.7])
    assert any("metres were assumed" in note for note in scan.notes)


@pytest.mark.parametrize(("unit", "factor"), [("s", 1.0), ("ms", 1e-3), ("", 1.0)])
def test_time_is_a_dimension_in_seconds(tmp_path, unit, factor):
    attributes = {"units": unit} if unit else {}
    coords = {"time": ("time", [1.0, 2.0, 4.0], attributes)}
    seen = xr.Dataset({"A1": ("time", np.ones(3), {"units": "m"})}, coords)
    save(seen, tmp_path / "seen.nc")
    scan = read_channels(tmp_path / "seen.nc")
    assert scan.dims == ("time",)
    np.testing.assert_allclose(scan.coords["time"], np.array([1.0, 2.0, 4.0]) * factor, rtol=1e-15)
    assert any("seconds were assumed" in note for note in scan.notes) == (not unit)


@pytest.mark.parametrize(("name", "unit", "kind"), [("time", "nm", "time"), ("z", "ms", "length")])
def test_a_coordinate_of_another_kind_is_left_out(tmp_path, name, unit, kind):
    seen = xr.Dataset({"A1": (name, np.ones(2), {"units": "m"})}, {name: (name, [0.0, 1.0], {"units": unit})})
    save(seen, tmp_path / "seen.nc")
    scan = read_channels(tmp_path / "seen.nc")
    assert scan.dims == (name,)
    assert not scan.coords
    assert any(f"{unit!r} is no {kind}" in note for note in scan.notes)


def test_other_hdf5_is_told_apart(tmp_path):
    import h5py

    path = tmp_path / "other.h5"
    with h5py.File(path, "w") as file:
        file["Entry/data"] = np.ones((3, 3))
    with pytest.raises(FileFormatError, match="HDF5, but not in the layout of netCDF"):
        read_channels(path)
    with h5py.File(path, "w") as file:
        file["data"] = np.ones((3, 3))
    with pytest.raises(FileFormatError):
        read_channels(path)


def test_array_that_claims_more_than_the_file_can_hold(tmp_path):
    import h5py

    path = tmp_path / "huge.nc"
    with h5py.File(path, "w") as file:
        for name, size in (("y", 1 << 20), ("x", 1 << 16)):
            file.create_dataset(name, shape=(size,), dtype="f4", chunks=(1024,)).make_scale(name)
        huge = file.create_dataset("A1", shape=(1 << 20, 1 << 16), dtype="f8", chunks=(64, 64))
        huge.dims[0].attach_scale(file["y"])
        huge.dims[1].attach_scale(file["x"])
    with pytest.raises(FileFormatError, match="claimed"):
        read_channels(path)


def test_file_without_a_channel(tmp_path):
    save(xr.Dataset({"count": ("x", [1, 2]), "odd": ("frequency", [1.0])}), tmp_path / "a.nc")
    with pytest.raises(FileFormatError, match=r"odd\(frequency\)"):
        read_channels(tmp_path / "a.nc")


def test_classic_netcdf_is_named(tmp_path):
    path = tmp_path / "old.nc"
    path.write_bytes(b"CDF\x01" + b"\0" * 60)
    with pytest.raises(FileFormatError, match="nccopy"):
        load(path)


def test_load_of_what_is_not_there_or_no_netcdf(tmp_path):
    with pytest.raises(FileFormatError, match="no file"):
        load(tmp_path / "missing.nc")
    (tmp_path / "text.nc").write_text("hello")
    with pytest.raises(FileFormatError, match="no netCDF"):
        load(tmp_path / "text.nc")
