"""Zarr stores: out and back, against zarr itself, block by block, and refused where they hold code or lies."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr

from overtone.errors import FileFormatError, ObservablesError, OvertoneError
from overtone.io import zarr_store
from overtone.io.atomic import atomic_folder
from overtone.io.recording import Recording
from overtone.io.registry import read_channels

zarr = pytest.importorskip("zarr")


def _dataset(rows: int = 3, columns: int = 4) -> xr.Dataset:
    values = np.random.default_rng(1).random((2, rows, columns)) * 1e-9
    values[0, -1, 0] = np.nan
    return xr.Dataset(
        {
            "A1": (("direction", "y", "x"), values, {"units": "m", "numbers": [1.5, 2.0], "none": None}),
            "phi1": (("direction", "y", "x"), values.astype(np.float32), {"units": "rad"}),
            "A0": (("y", "x"), np.full((rows, columns), np.nan), {"units": "m"}),
            "status": (
                ("y", "x"),
                np.zeros((rows, columns), np.int8),
                {"flag_values": [0, 1], "flag_meanings": "a b"},
            ),
            "used": ("y", np.ones(rows, bool)),
            "count": ((), 7),
            "note": ((), "µ text"),
        },
        {
            "y": ("y", np.arange(rows)[::-1] * 1e-9, {"units": "m"}),
            "x": ("x", np.arange(columns) * 1e-9, {"units": "m"}),
            "direction": ["trace", "retrace"],
        },
        {"history": json.dumps([{"operation": "µ"}]), "radius": 1e-8, "empty": "", "nothing": None},
    )


def test_round_trip_bit_for_bit(tmp_path: Path) -> None:
    path, dataset = tmp_path / "map.zarr", _dataset()
    zarr_store.save(dataset, path)
    again = zarr_store.load(path)
    assert list(again.data_vars) == list(dataset.data_vars)  # in order, too
    for name in dataset.variables:
        assert again[name].dtype == dataset[name].dtype, name
        np.testing.assert_array_equal(again[name].values, dataset[name].values)
        assert again[name].dims == dataset[name].dims
    assert again.attrs == {
        "history": dataset.attrs["history"],
        "radius": 1e-8,
        "empty": "",
        "nothing": "null",
    }
    assert again["A1"].attrs == {"units": "m", "numbers": [1.5, 2.0], "none": "null"}
    assert dataset["A1"].attrs["none"] is None
    zarr_store.save(again, path)  # over the very store it came from
    xr.testing.assert_identical(zarr_store.load(path), again)
    assert [file.name for file in tmp_path.iterdir()] == ["map.zarr"]


def test_zarr_itself_reads_it(tmp_path: Path) -> None:
    path, dataset = tmp_path / "map.zarr", _dataset(300, 200)
    zarr_store.save(dataset, path)
    group = zarr.open_group(path, mode="r", zarr_format=3)
    array = group["A1"]
    assert (array.shape, array.chunks, array.dtype) == ((2, 300, 200), (2, 128, 128), np.dtype("f8"))
    np.testing.assert_array_equal(array[...], dataset["A1"].values)
    assert array.metadata.dimension_names == ("direction", "y", "x")
    assert (array.attrs["units"], group.attrs["radius"]) == ("m", 1e-8)
    assert group["direction"][...].tolist() == ["trace", "retrace"]
    description = json.loads((path / "A1" / "zarr.json").read_text())
    assert [(codec["name"], codec["configuration"].get("checksum")) for codec in description["codecs"]] == [
        ("bytes", None),
        ("zstd", True),
    ]


def test_blocks_stay_on_the_disk(tmp_path: Path) -> None:
    pytest.importorskip("dask")
    path, dataset = tmp_path / "map.zarr", _dataset(300, 200)
    zarr_store.save(dataset, path)
    lazy = zarr_store.open_lazily(path)
    assert lazy["A1"].chunks == ((2,), (128, 128, 44), (128, 72))
    assert isinstance(lazy["x"].values, np.ndarray)
    block = lazy["A1"].isel(y=slice(128, 256), x=slice(0, 128))
    shutil.rmtree(path / "A1" / "c" / "0" / "0")  # the other blocks are not touched
    np.testing.assert_array_equal(block.values, dataset["A1"].values[:, 128:256, :128])
    np.testing.assert_array_equal(lazy["direction"].values, ["trace", "retrace"])


def test_blocks_of_dask_are_kept(tmp_path: Path) -> None:
    pytest.importorskip("dask")
    path = tmp_path / "map.zarr"
    dataset = _dataset(300, 200).chunk(y=50, x=-1)
    zarr_store.save(dataset, path)
    assert zarr_store.open_lazily(path)["A1"].chunks == ((2,), (50,) * 6, (200,))
    xr.testing.assert_equal(zarr_store.load(path), _dataset(300, 200))


def test_read_as_a_scan(tmp_path: Path) -> None:
    path = tmp_path / "map.zarr"
    zarr_store.save(_dataset(), path)
    scan = read_channels(path)
    assert (scan.format, scan.vendor, scan.dims) == ("zarr", "overtone", ("y", "x"))
    assert [(c.name, c.direction, c.unit) for c in scan.channels] == [
        ("A1", "trace", "m"),
        ("A1", "retrace", "m"),
        ("phi1", "trace", "rad"),
        ("phi1", "retrace", "rad"),
        ("A0", None, "m"),
    ]
    np.testing.assert_array_equal(scan.channels[1].values, _dataset()["A1"].values[1])
    assert scan.coords["y"].tolist() == _dataset()["y"].values.tolist()


def test_stores_of_others_with_names_and_units(tmp_path: Path) -> None:
    path = tmp_path / "theirs.zarr"
    group = zarr.create_group(path, zarr_format=3)
    array = group.create_array("A1", shape=(3, 4), dtype="f4", dimension_names=("y", "x"))
    array[...] = np.arange(12.0).reshape(3, 4)
    array.attrs["units"] = "nm"
    scan = read_channels(path)
    assert (scan.channels[0].name, scan.channels[0].unit) == ("A1", "m")
    np.testing.assert_allclose(
        scan.channels[0].values[[0, 0, 2, 2], [0, 3, 0, 3]], [0, 3e-9, 8e-9, 11e-9], rtol=1e-12
    )


# --- whole or not at all ----------------------------------------------------------------------------


def _content(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


def test_a_failure_leaves_the_old_store(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "map.zarr"
    zarr_store.save(_dataset(), path)
    before = _content(path)
    whole = xr.Dataset.to_zarr

    def half(self: xr.Dataset, store: Path, **arguments: Any) -> None:
        whole(self[["A1"]], store, **{**arguments, "encoding": {}})
        raise KeyboardInterrupt

    monkeypatch.setattr(xr.Dataset, "to_zarr", half)
    with pytest.raises(KeyboardInterrupt):
        zarr_store.save(_dataset(5, 6), path)
    assert _content(path) == before
    assert [file.name for file in tmp_path.iterdir()] == ["map.zarr"]


def test_a_move_that_fails_puts_the_old_one_back(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "map.zarr"
    zarr_store.save(_dataset(), path)
    before = _content(path)
    move = Path.rename

    def rename(self: Path, target: Path) -> Path:
        if ".partial" in self.name:
            raise OSError(5, "Input/output error")
        return move(self, target)

    monkeypatch.setattr(Path, "rename", rename)
    with pytest.raises(FileFormatError, match="Input/output error"):
        zarr_store.save(_dataset(5, 6), path)
    assert _content(path) == before
    assert [file.name for file in tmp_path.iterdir()] == ["map.zarr"]


def test_only_stores_are_replaced(tmp_path: Path) -> None:
    path = tmp_path / "map.zarr"
    path.mkdir()
    (path / "thesis.txt").write_text("years of work")
    with pytest.raises(FileFormatError, match="other content"):
        zarr_store.save(_dataset(), path)
    assert (path / "thesis.txt").read_text() == "years of work"
    (tmp_path / "file.zarr").write_text("")
    with pytest.raises(FileFormatError, match="a file or a link"):
        zarr_store.save(_dataset(), tmp_path / "file.zarr")
    with pytest.raises(FileFormatError, match="existing folder"):
        zarr_store.save(_dataset(), tmp_path / "missing" / "map.zarr")
    with (
        pytest.raises(FileFormatError, match="cannot write"),
        atomic_folder(tmp_path / "new.zarr", lambda _: True),
    ):
        pass  # nothing was written


# --- what is refused --------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("bad", "message"),
    [
        (xr.Dataset({"c": ("x", [1j])}), "complex"),
        (xr.Dataset({"o": ("x", np.array([{}, 1], dtype=object))}), "cannot be written"),
        (xr.DataArray([1.0]), "to_dataset"),
    ],
)
def test_what_cannot_be_saved(tmp_path: Path, bad: Any, message: str) -> None:
    with pytest.raises(ObservablesError, match=message):
        zarr_store.save(bad, tmp_path / "a.zarr")
    assert list(tmp_path.iterdir()) == []


def test_another_ending(tmp_path: Path) -> None:
    with pytest.raises(FileFormatError, match=r"\.zarr"):
        zarr_store.save(_dataset(), tmp_path / "a.nc")


@pytest.fixture
def store(tmp_path: Path) -> Path:
    path = tmp_path / "map.zarr"
    zarr_store.save(_dataset(), path)
    return path


def _changed(store: Path, **changes: Any) -> None:
    file = store / "A1" / "zarr.json"
    file.write_text(json.dumps({**json.loads(file.read_text()), **changes}))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"codecs": [{"name": "pickle"}]}, "ordinary compression of A1"),
        ({"codecs": [{"name": "numcodecs.pickle", "configuration": {}}]}, "ordinary compression"),
        (
            {"codecs": [{"name": "sharding_indexed", "configuration": {"codecs": [{"name": "pickle"}]}}]},
            "ordinary compression",
        ),
        ({"codecs": None}, "ordinary compression"),
        ({"storage_transformers": [{"name": "x"}]}, "ordinary compression"),
        ({"data_type": "object"}, "numbers or text in A1"),
        ({"data_type": {"name": "structured"}}, "numbers or text in A1"),
        ({"shape": [10**6, 10**6, 10**6]}, "bytes claimed"),
        ({"shape": [-1, 3, 4]}, "sizes of A1"),
        ({"shape": "many"}, "sizes of A1"),
        ({"shape": [3, 4]}, "dimensions in A1"),
        (
            {"chunk_grid": {"name": "regular", "configuration": {"chunk_shape": [2, 10**7, 10**7]}}},
            "bytes claimed",
        ),
        ({"chunk_grid": {"name": "regular", "configuration": {"chunk_shape": [2, 0, 4]}}}, "sizes of A1"),
        ({"chunk_grid": None}, "sizes of A1"),
        ({"zarr_format": 2}, "version 3 in A1/zarr.json"),
    ],
)
def test_descriptions_are_checked_before_the_library_sees_them(
    store: Path, changes: dict[str, Any], message: str
) -> None:
    _changed(store, **changes)
    with pytest.raises(FileFormatError, match=message):
        zarr_store.load(store)


def test_version_2_is_not_opened(tmp_path: Path) -> None:
    path = tmp_path / "old.zarr"
    path.mkdir()
    (path / ".zgroup").write_text('{"zarr_format": 2}')
    with pytest.raises(FileFormatError, match="version 2"):
        read_channels(path)


@pytest.mark.parametrize("function", [zarr_store.load, zarr_store.open_lazily])
def test_no_store(tmp_path: Path, function: Callable[[Path], xr.Dataset]) -> None:
    with pytest.raises(FileFormatError, match="got nothing"):
        function(tmp_path / "missing.zarr")
    (tmp_path / "a.zarr").write_text("")
    with pytest.raises(FileFormatError, match="a file"):
        function(tmp_path / "a.zarr")
    (tmp_path / "b.zarr").mkdir()
    with pytest.raises(FileFormatError, match="no Zarr store"):
        function(tmp_path / "b.zarr")


def test_an_array_is_no_store(store: Path) -> None:
    with pytest.raises(FileFormatError, match="folder above"):
        read_channels(store / "A1")


def test_damaged_blocks_are_noticed(store: Path) -> None:
    file = store / "A1" / "c" / "0" / "0" / "0"
    content = bytearray(file.read_bytes())
    content[len(content) // 2] ^= 4
    file.write_bytes(bytes(content))
    with pytest.raises(FileFormatError, match="cannot be read"):
        zarr_store.load(store)


def test_damaged_stores(store: Path) -> None:
    random = np.random.default_rng(41)
    for file in [path for path in sorted(store.rglob("*")) if path.is_file()]:
        content = file.read_bytes()
        for _ in range(4):
            changed = bytearray(content)
            changed[random.integers(0, len(content))] = random.integers(0, 256)
            file.write_bytes(bytes(changed))
            _survives(store)
            file.write_bytes(content[: random.integers(0, len(content))])
            _survives(store)
        file.write_bytes(content)
    assert _survives(store)


def _survives(path: Path) -> bool:
    message = ""
    try:
        recording = read_channels(path)
    except OvertoneError as error:
        message = str(error)
    if message:
        assert len(message) < 1000
        return False
    assert isinstance(recording, Recording)
    return True
