"""A map that is made block by block is the one made in one go, to the last bit, and needs the memory of a block."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr

import overtone as ot
from overtone.batch import block_scan, block_shapes, blocks
from overtone.batch.block_shapes import block_shape, regions_of
from overtone.batch.blocks import map_blocks
from overtone.batch.folder import WORK
from overtone.batch.mapping import dataset_of, map_scans
from overtone.batch.one import KEPT, MAPPED
from overtone.batch.record import ATTRIBUTE
from overtone.batch.settings import Settings
from overtone.cli import main
from overtone.demo import virtual_scan
from overtone.errors import OvertoneError
from overtone.io import netcdf
from overtone.quantities import named_array

zarr_store = pytest.importorskip("overtone.io.zarr_store")
pytest.importorskip("zarr")
pytest.importorskip("dask")

EXACT = Settings(method="exact", motion="cosine", poisson_ratio=0.35)


@pytest.fixture(scope="module")
def scan() -> xr.Dataset:
    """A scan in which nothing was recorded in a whole block."""
    scan = virtual_scan(shape=(48, 40), seed=1)[0]
    for name in ("A1", "phi1", "A2", "phi2", "A3", "phi3", "A0"):
        scan[name][16:34, :33] = np.nan
    return scan


@pytest.fixture
def folder(scan: xr.Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The scan as a file and in chunks of 16 x 16, of which two at most make a block."""
    monkeypatch.setattr(zarr_store, "BLOCK", 16)
    monkeypatch.setattr(block_shapes, "LARGEST", 600)
    zarr_store.save(scan, tmp_path / "scan.zarr")
    netcdf.save(scan, tmp_path / "scan.nc")
    return tmp_path


def assert_equal(result: xr.Dataset, whole: xr.Dataset) -> None:
    result, whole = result.copy(), whole.copy()
    assert result.attrs.pop("source") == "scan.zarr"
    assert whole.attrs.pop("source") == "scan.nc"
    result.attrs.pop(ATTRIBUTE)
    history = [json.loads(dataset.attrs.pop("history")) for dataset in (result, whole)]
    assert [step["operation"] for step in history[0]] == [step["operation"] for step in history[1]]
    xr.testing.assert_identical(result, whole)
    assert list(result.data_vars) == list(whole.data_vars)


@pytest.mark.parametrize(
    "settings",
    [
        EXACT,
        Settings(poisson_ratio=0.35, model="auto", motion="cosine", noise="scatter"),
        Settings(poisson_ratio=0.35, radius=9e-9),
        Settings(poisson_ratio=0.35, method="least-squares", model="dmt-linear"),
        Settings(),
    ],
    ids=["exact", "auto", "full motion", "least squares", "energy alone"],
)
def test_blocks_give_what_the_whole_gives(folder: Path, settings: Settings) -> None:
    done: list[tuple[int, int]] = []
    record = map_blocks(
        folder / "scan.zarr", folder / "maps.zarr", settings, progress=lambda *n: done.append(n)
    )
    assert done[-1] == (1920, 1920)
    assert len(done) > 4
    netcdf.save(dataset_of(map_scans([folder / "scan.nc"], settings)), folder / "maps.nc")
    whole = netcdf.load(folder / "maps.nc")
    assert_equal(zarr_store.load(folder / "maps.zarr"), whole)
    assert record.summary is not None
    assert record.summary["pixels"] == 1920
    if "status" in whole:
        assert record.summary["determined"] == float((whole["status"] == 0).mean())
        assert 0.3 < float((whole["status"] == 6).mean()) < 0.35
    assert not (folder / WORK).exists()


def test_a_stack_is_cut_too(scan: xr.Dataset, folder: Path) -> None:
    second = scan.assign({name: scan[name] * 1.01 for name in ("A1", "A2")}).assign_attrs(scan.attrs)
    stack = xr.concat([scan, second], dim="scan", combine_attrs="override")
    zarr_store.save(stack, folder / "scan.zarr")
    netcdf.save(stack, folder / "scan.nc")
    map_blocks(folder / "scan.zarr", folder / "maps.zarr", EXACT)
    netcdf.save(dataset_of(map_scans([folder / "scan.nc"], EXACT)), folder / "maps.nc")
    assert_equal(zarr_store.load(folder / "maps.zarr"), netcdf.load(folder / "maps.nc"))


def test_a_scan_larger_than_the_sample_says_so(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(block_scan, "_SAMPLE", 700)
    read: list[int] = []
    loaded = block_scan.loaded

    def counted(part: xr.Dataset) -> xr.Dataset:
        read.append(part["A1"].size)
        return loaded(part)

    for room in (block_scan, blocks):
        monkeypatch.setattr(room, "loaded", counted)
    map_blocks(folder / "scan.zarr", folder / "maps.zarr", EXACT)
    # never more than a block at a time, and of the sample no more than every third line
    assert max(read) <= 600
    assert sum(read) == 1920 + 640
    findings = json.loads(zarr_store.load(folder / "maps.zarr").attrs["findings"])
    assert any("one in 3 of its lines" in sentence for sentence in findings)


def test_a_run_that_was_stopped_goes_on(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    done: list[int] = []
    mapped = blocks.map_block

    def stop(block: Any) -> None:
        if len(done) == 3:
            done.append(-1)
            raise KeyboardInterrupt
        mapped(block)
        done.append(block.number)

    monkeypatch.setattr(blocks, "map_block", stop)
    output = folder / "maps.zarr"
    with pytest.raises(KeyboardInterrupt):
        map_blocks(folder / "scan.zarr", output, EXACT)
    assert not output.exists()
    map_blocks(folder / "scan.zarr", output, EXACT)
    assert sorted(done) == [-1, *range(max(done) + 1)]
    netcdf.save(dataset_of(map_scans([folder / "scan.nc"], EXACT)), folder / "maps.nc")
    assert_equal(zarr_store.load(output), netcdf.load(folder / "maps.nc"))
    assert not (folder / WORK).exists()
    # an earlier result stands until the new one is whole, and other settings begin again
    done[:] = [-2]
    with pytest.raises(KeyboardInterrupt):
        map_blocks(folder / "scan.zarr", output, Settings(motion="cosine", poisson_ratio=0.3))
    assert_equal(zarr_store.load(output), netcdf.load(folder / "maps.nc"))
    assert len(list((folder / WORK).glob("*.zarr"))) == 1
    done[:] = []
    with pytest.raises(KeyboardInterrupt):
        map_blocks(folder / "scan.zarr", output, Settings(motion="cosine", poisson_ratio=0.31))
    assert len(list((folder / WORK).glob("*.zarr"))) == 1
    assert len(done) == 4


def test_blocks_on_a_cluster_are_the_same(folder: Path) -> None:
    pytest.importorskip("distributed")
    map_blocks(folder / "scan.zarr", folder / "maps.zarr", EXACT, cluster="local")
    netcdf.save(dataset_of(map_scans([folder / "scan.nc"], EXACT)), folder / "maps.nc")
    assert_equal(zarr_store.load(folder / "maps.zarr"), netcdf.load(folder / "maps.nc"))


def test_a_batch_maps_zarr_into_zarr(folder: Path) -> None:
    settings = {"method": "exact", "motion": "cosine", "poisson_ratio": 0.35}
    files = [folder / "scan.zarr", folder / "scan.nc"]
    batch = ot.map_files(files, folder / "results", **settings)
    assert [outcome.result.name for outcome in batch.outcomes] == ["scan_zarr.zarr", "scan_nc.nc"]
    assert batch.count(MAPPED) == 2
    assert batch.outcomes[0].summary == {
        "pixels": 1920,
        "determined": batch.outcomes[1].summary["determined"],
    }
    assert ot.map_files(files, folder / "results", **settings).count(KEPT) == 2
    again = ot.map_files(files, folder / "results", **(settings | {"poisson_ratio": 0.3}))
    assert [outcome.why for outcome in again.outcomes] == ["other settings: poisson_ratio"] * 2


def test_what_needs_a_whole_scan_is_refused_with_a_reason(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    output = folder / "maps.zarr"

    def said(*options: object) -> str:
        with pytest.raises(SystemExit):
            main([str(part) for part in ("map", folder / "scan.zarr", "-o", output, *options)])
        return " ".join(capsys.readouterr().err.split())

    assert "which pools the pixels of a whole scan" in said("--method", "population", "--poisson-ratio", 0.35)
    assert "a calibration, which needs a whole scan" in said("--calibration", folder / "none.toml")
    assert "--report shows a whole map" in said("--report", folder / "maps.html")
    with pytest.raises(SystemExit):
        main(["map", str(folder / "scan.nc"), "-o", str(folder / "maps.nc"), "--cluster", "local"])
    assert "one map in memory" in capsys.readouterr().err
    assert not output.exists()


def test_what_is_no_scan_is_refused(folder: Path) -> None:
    zarr_store.save(xr.Dataset({"modulus": (("y", "x"), np.ones((4, 4)))}), folder / "other.zarr")
    with pytest.raises(OvertoneError, match="holds no observables"):
        map_blocks(folder / "other.zarr", folder / "maps.zarr", EXACT)
    with pytest.raises(OvertoneError, match="there is no Zarr folder"):
        map_blocks(folder / "none.zarr", folder / "maps.zarr", EXACT)
    assert not (folder / "maps.zarr").exists()


@pytest.mark.parametrize(
    ("sizes", "chunks", "expected"),
    [
        ((4096, 4096), (128, 128), (128, 2048)),
        ((4096, 4096), (4096, 4096), (64, 4096)),
        ((100, 100), (30, 30), (100, 100)),
        ((3, 2048, 2048), (1, 512, 512), (1, 512, 512)),
        ((3, 2048, 2048), (3, 256, 2048), (1, 128, 2048)),
        ((5, 64, 64), (5, 64, 32), (5, 64, 64)),
        ((10_000_000,), (1000,), (262_000,)),
        ((10_000_000,), (10_000_000,), (262_144,)),
    ],
)
def test_blocks_are_whole_chunks_or_parts_of_one(
    sizes: tuple[int, ...], chunks: tuple[int, ...], expected: tuple[int, ...]
) -> None:
    import dask.array

    dims = ("scan", "y", "x")[-len(sizes) :]
    like = xr.DataArray(dask.array.zeros(sizes, chunks=chunks), dims=dims)
    assert block_shape(like, dims) == expected
    covered = np.zeros(sizes, np.int8)
    for region in regions_of(like, dims):
        covered[region] += 1
    assert (covered == 1).all()


def test_values_of_whole_chunks_are_written(folder: Path) -> None:
    """The map has chunks of its own blocks, so that no two blocks write into one."""
    map_blocks(folder / "scan.zarr", folder / "maps.zarr", EXACT)
    source, result = (zarr_store.open_lazily(folder / name) for name in ("scan.zarr", "maps.zarr"))
    assert result["modulus"].chunks == source["A1"].chunks
    for region in regions_of(source["A1"], ("y", "x")):
        assert all(edge.start % 16 == 0 for edge in region)
    assert named_array("modulus", result["modulus"].values, ("y", "x")).attrs == result["modulus"].attrs
