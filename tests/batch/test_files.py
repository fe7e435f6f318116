"""Many files: each its own result, whatever the others do, and no work twice."""

import csv
import json
import os
import shutil
from pathlib import Path

import numpy as np
import pytest
import xarray as xr

import overtone as ot
from overtone.batch.folder import WORK, working_folder
from overtone.batch.inputs import find_files, names_of
from overtone.batch.mapping import dataset_of, map_scans
from overtone.batch.one import FAILED, KEPT, MAPPED
from overtone.batch.record import ATTRIBUTE
from overtone.batch.settings import Settings, settings_of, texts_of
from overtone.errors import FileFormatError, OvertoneError
from overtone.io.netcdf import load, save

from .conftest import NAMES, SETTINGS, write_scans


@pytest.fixture
def scans(base: xr.Dataset, tmp_path: Path) -> Path:
    return write_scans(tmp_path / "scans", base, 3)


def test_a_result_is_what_a_map_of_the_file_alone_is(scans: Path, tmp_path: Path) -> None:
    batch = ot.map_files(scans / "*.nc", tmp_path / "results", **SETTINGS)
    assert [outcome.state for outcome in batch.outcomes] == [MAPPED] * 3
    alone = dataset_of(map_scans([(scans / "scan_001.nc").absolute()], Settings(**SETTINGS)))
    result = load(tmp_path / "results" / "scan_001.nc")
    record = json.loads(result.attrs.pop(ATTRIBUTE))
    assert record["files"].keys() == {"../scans/scan_001.nc"}
    save(alone, tmp_path / "alone.nc")
    xr.testing.assert_identical(result, load(tmp_path / "alone.nc"))
    assert sorted(path.name for path in (tmp_path / "results").iterdir()) == [
        "batch.csv",
        "batch.json",
        *(f"scan_{i:03d}.nc" for i in range(3)),
    ]


def test_odd_files_are_told_of_and_the_others_mapped(
    scans: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (scans / "scan_000.nc").write_bytes((scans / "scan_001.nc").read_bytes()[:2000])
    (scans / "text.ibw").write_text("no scan")

    def stumble(path: Path, *_: object, **__: object) -> None:
        raise ZeroDivisionError(f"in {path.name}")

    batch = ot.map_files([scans / "*", scans / "none.nc"], tmp_path / "results", **SETTINGS)
    states = {outcome.file.name: outcome.state for outcome in batch.outcomes}
    assert states == {
        "scan_000.nc": FAILED,
        "scan_001.nc": MAPPED,
        "scan_002.nc": MAPPED,
        "text.ibw": FAILED,
        "none.nc": FAILED,
    }
    with (tmp_path / "results" / "batch.csv").open(encoding="utf-8") as stream:
        rows = {row["file"]: row for row in csv.DictReader(stream)}
    assert "there is no file" in rows["../scans/none.nc"]["why"]
    assert rows["../scans/scan_001.nc"]["result"] == "scan_001.nc"
    assert rows["../scans/scan_001.nc"]["pixels"] == "256"
    assert rows["../scans/text.ibw"]["result"] == ""
    # whatever goes wrong with one file, and is no error of overtone's
    monkeypatch.setattr("overtone.io.observables.open_scan", stumble)
    batch = ot.map_files(scans / "scan_00[12].nc", tmp_path / "others", **SETTINGS)
    assert [outcome.why for outcome in batch.failed] == [
        "ZeroDivisionError: in scan_001.nc",
        "ZeroDivisionError: in scan_002.nc",
    ]
    log = json.loads((tmp_path / "others" / "batch.json").read_text(encoding="utf-8"))
    assert "stumble" in log["files"][0]["traceback"]


def test_what_is_done_is_kept_and_what_has_changed_is_made_again(
    base: xr.Dataset, scans: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    results = tmp_path / "results"

    def run(**others: object) -> dict[str, str]:
        batch = ot.map_files(scans / "*.nc", results, **(SETTINGS | others))
        assert not batch.failed
        return {outcome.result.stem: outcome.why for outcome in batch.outcomes if outcome.state != KEPT}

    every = {f"scan_{i:03d}" for i in range(3)}
    assert set(run().values()) == {"new"}
    before = {path: path.stat().st_mtime_ns for path in results.glob("*.nc")}
    assert run() == {}
    assert before == {path: path.stat().st_mtime_ns for path in results.glob("*.nc")}
    # the same bytes at another time are the same input
    os.utime(scans / "scan_000.nc")
    assert run() == {}
    save(base[NAMES].assign_attrs(base.attrs), scans / "scan_000.nc")
    assert run() == {"scan_000": "the input has changed"}
    assert run(poisson_ratio=0.3) == dict.fromkeys(every, "other settings: poisson_ratio")
    assert run(poisson_ratio=0.3, radius=10e-9) == dict.fromkeys(every, "other settings: radius")
    content = (results / "scan_002.nc").read_bytes()
    for damaged in (content[:3000] + b"x" * 9 + content[3009:], content[:-1], content[:5000], b""):
        (results / "scan_002.nc").write_bytes(damaged)
        assert run(poisson_ratio=0.3, radius=10e-9) == {"scan_002": "the result was damaged"}
    asked = dict.fromkeys(every, "asked for again")
    assert run(redo=True, poisson_ratio=0.3, radius=10e-9) == asked
    monkeypatch.setattr("overtone.batch.record.__version__", "99.0")
    assert {why.split(",")[1] for why in run(poisson_ratio=0.3, radius=10e-9).values()} == {" is 99.0"}


def test_a_report_belongs_to_its_result(scans: Path, tmp_path: Path) -> None:
    results = tmp_path / "results"

    def run(*, reports: bool = True, **others: object) -> list[str]:
        batch = ot.map_files(scans / "scan_001.nc", results, reports=reports, motion="cosine", **others)
        assert not batch.failed
        return [outcome.why for outcome in batch.outcomes if outcome.state != KEPT]

    assert run(reports=False) == ["new"]
    assert run() == ["its report is missing"]
    assert "scan_001.nc" in (results / "scan_001.html").read_text(encoding="utf-8")
    assert run() == []
    (results / "scan_001.html").write_text("another")
    assert run() == ["its report is of another run"]
    assert run(reports=False, radius=9e-9) == ["other settings: radius"]
    assert run(radius=9e-9) == ["its report is missing"]
    assert sorted(path.name for path in results.iterdir()) == [
        "batch.csv",
        "batch.json",
        "scan_001.html",
        "scan_001.nc",
    ]


def test_a_file_of_the_settings_counts_by_its_content(tmp_path: Path) -> None:
    (tmp_path / "labels.csv").write_text("one")
    settings = settings_of({"method": "population", "phases": str(tmp_path / "labels.csv")})
    before = texts_of(settings)
    assert texts_of(settings) == before
    (tmp_path / "labels.csv").write_text("two")
    assert texts_of(settings) != before
    assert texts_of(Settings()) == {}
    assert texts_of(Settings(noise={"A0": 1e-12})).keys() == {"noise"}


def test_files_of_one_name_do_not_overwrite_each_other(scans: Path, tmp_path: Path) -> None:
    for folder in ("a", "b"):
        (tmp_path / folder).mkdir()
        shutil.copy(scans / "scan_000.nc", tmp_path / folder / "scan.nc")
    shutil.copy(scans / "scan_001.nc", tmp_path / "b" / "scan.nc")
    results = tmp_path / "results"

    def run(*files: str) -> list[tuple[str, str]]:
        batch = ot.map_files([tmp_path / file for file in files], results, **SETTINGS)
        return [(outcome.result.name, outcome.state) for outcome in batch.outcomes]

    assert run("a/scan.nc", "b/scan.nc", "a/scan.nc") == [("a_scan.nc", MAPPED), ("b_scan.nc", MAPPED)]
    assert run("a/scan.nc", "b/scan.nc") == [("a_scan.nc", KEPT), ("b_scan.nc", KEPT)]
    # nor over several runs
    assert run("a/scan.nc") == [("scan.nc", MAPPED)]
    content = (results / "scan.nc").read_bytes()
    (results / "b_scan.nc").unlink()
    assert run("b/scan.nc") == [("scan_nc.nc", MAPPED)]
    assert (results / "scan.nc").read_bytes() == content
    assert run("b/scan.nc") == [("scan_nc.nc", KEPT)]
    # nor what somebody else has put there
    save(load(scans / "scan_002.nc"), results / "scan_002.nc")
    content = (results / "scan_002.nc").read_bytes()
    assert run("scans/scan_002.nc") == [("scan_002_nc.nc", MAPPED)]
    assert (results / "scan_002.nc").read_bytes() == content


def test_a_result_goes_with_its_file(scans: Path, tmp_path: Path) -> None:
    ot.map_files(scans / "*.nc", tmp_path / "results", **SETTINGS)
    scans.rename(tmp_path / "renamed")
    batch = ot.map_files(tmp_path / "renamed" / "*.nc", tmp_path / "results", **SETTINGS)
    assert batch.count(KEPT) == 3


def test_names_keep_files_apart() -> None:
    def first(*files: str) -> list[str]:
        return [names[0] for names in names_of([Path(file) for file in files])]

    assert first("x/scan.ibw", "y/other.ibw") == ["scan", "other"]
    assert first("x/scan.ibw", "x/scan.gwy") == ["scan_ibw", "scan_gwy"]
    assert first("x/scan.ibw", "y/SCAN.ibw") == ["x_scan", "y_SCAN"]
    assert first("m/x/scan.ibw", "n/x/scan.ibw") == ["m_x_scan", "n_x_scan"]
    assert len(set(first("1/m/x/scan.ibw", "2/m/x/scan.ibw", "x_scan.ibw", "x_scan_ibw"))) == 4


def test_patterns_are_resolved_where_a_shell_does_not(scans: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(scans.parent)
    assert [path.name for path in find_files(["scans/*_00[02].nc"])] == ["scan_000.nc", "scan_002.nc"]
    assert len(find_files([Path("**/*.nc")])) == 3
    (scans / "odd[1].nc").touch()
    assert find_files(["scans/odd[1].nc"]) == (Path("scans/odd[1].nc"),)
    with pytest.raises(FileFormatError, match="no file fits"):
        find_files(["scans/*.ibw"])


def test_what_is_wrong_whatever_the_file_is_raised_at_once(scans: Path, tmp_path: Path) -> None:
    results = tmp_path / "results"
    for settings, message in (
        ({"method": "exakt"}, "unknown method"),
        ({"modell": "dmt"}, "'modell' is no setting"),
        ({"model": "dtm"}, "unknown contact model"),
        ({"poisson_ratio": 0.9}, "out of range"),
        ({"lift": True}, "--lift corrects a scan"),
        ({"noise": "scater"}, "--noise is not understood"),
        ({"calibration": tmp_path / "none.toml"}, "cannot read"),
    ):
        with pytest.raises(OvertoneError, match=message):
            ot.map_files(scans / "*.nc", results, **settings)
        assert not results.exists()
    with pytest.raises(OvertoneError, match="would lie among the scans"):
        ot.map_files(scans / "*.nc", scans, **SETTINGS)
    (tmp_path / "file").touch()
    with pytest.raises(OvertoneError, match="is no folder"):
        ot.map_files(scans / "*.nc", tmp_path / "file", **SETTINGS)


def test_one_batch_at_a_time_and_only_its_own_left_overs_go(scans: Path, tmp_path: Path) -> None:
    results = tmp_path / "results"
    with working_folder(results) as work:
        with pytest.raises(OvertoneError, match="another batch is writing"):
            ot.map_files(scans / "*.nc", results, **SETTINGS)
        assert work.is_dir()
    assert not work.exists()
    work.mkdir()
    (work / "0123456789abcdef.nc").write_text("half")
    (work / ".0123456789abcdef.partial.nc").write_text("half")
    (results / ".0123456789abcdef.partial.nc").write_text("of another program")
    (results / "notes.txt").write_text("mine")
    assert ot.map_files(scans / "*.nc", results, **SETTINGS).count(MAPPED) == 3
    names = {path.name for path in results.iterdir()}
    assert WORK not in names
    assert {".0123456789abcdef.partial.nc", "notes.txt"} <= names


def test_an_interrupt_stops_between_files_and_leaves_a_log(scans: Path, tmp_path: Path) -> None:
    def stop(done: int, count: int) -> None:
        if done == 1:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        ot.map_files(scans / "*.nc", tmp_path / "results", progress=stop, **SETTINGS)
    names = sorted(path.name for path in (tmp_path / "results").iterdir())
    assert names == ["batch.csv", "batch.json", "scan_000.nc"]
    log = json.loads((tmp_path / "results" / "batch.json").read_text(encoding="utf-8"))
    assert [row["state"] for row in log["files"]] == ["mapped", "not reached", "not reached"]
    batch = ot.map_files(scans / "*.nc", tmp_path / "results", **SETTINGS)
    assert [outcome.state for outcome in batch.outcomes] == [KEPT, MAPPED, MAPPED]


def test_a_failure_leaves_an_earlier_result(scans: Path, tmp_path: Path) -> None:
    ot.map_files(scans / "*.nc", tmp_path / "results", **SETTINGS)
    before = (tmp_path / "results" / "scan_001.nc").read_bytes()
    (scans / "scan_001.nc").write_text("overwritten")
    batch = ot.map_files(scans / "*.nc", tmp_path / "results", **SETTINGS)
    assert [outcome.state for outcome in batch.outcomes] == [KEPT, FAILED, KEPT]
    assert "earlier run was left" in batch.failed[0].why
    assert (tmp_path / "results" / "scan_001.nc").read_bytes() == before


def test_results_can_be_mapped_again_as_scans(scans: Path, tmp_path: Path) -> None:
    """A result holds its observables: the record of how it was made is not taken for that of the next."""
    ot.map_files(scans / "*.nc", tmp_path / "results", **SETTINGS)
    batch = ot.map_files(tmp_path / "results" / "*.nc", tmp_path / "again", **SETTINGS)
    assert batch.count(MAPPED) == 3
    once, twice = (
        load(tmp_path / folder / "scan_001.nc")["modulus"].values for folder in ("results", "again")
    )
    np.testing.assert_array_equal(once, twice)
