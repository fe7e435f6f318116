"""``overtone map`` of many files, as a user runs it."""

import re
import subprocess
import sys
from pathlib import Path

import pytest
import xarray as xr

from overtone.cli import main
from overtone.io.netcdf import load

from .conftest import write_scans

OPTIONS = ("--method", "exact", "--motion", "cosine", "--poisson-ratio", "0.35")


def run(*arguments: object) -> int:
    """Run the command line and return its exit code."""
    try:
        main([str(argument) for argument in arguments])
    except SystemExit as stop:
        return int(stop.code or 0)
    return 0


def flat(text: str) -> str:
    return re.sub(r"\s+", " ", text)


@pytest.fixture
def scans(base: xr.Dataset, tmp_path: Path) -> Path:
    return write_scans(tmp_path / "scans", base, 2)


def test_a_batch_says_what_became_of_each_file(
    scans: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (scans / "odd.csv").write_text("no, numbers\n")
    asked = ("map", scans / "*", "--out-dir", tmp_path / "results", *OPTIONS)
    assert run(*asked) == 1
    said = capsys.readouterr()
    assert "2 mapped, 1 failed" in flat(said.out)
    assert "odd.csv: " in flat(said.out)
    assert "1 of 3 files failed" in flat(said.err)
    assert "Traceback" not in said.err
    (scans / "odd.csv").unlink()
    assert run(*asked) == 0
    assert "2 kept" in flat(capsys.readouterr().out)
    assert run(*asked, "--redo") == 0
    said = capsys.readouterr()
    assert "2 mapped" in flat(said.out)
    assert said.out.count("asked for") == 2
    result = load(tmp_path / "results" / "scan_000.nc")
    # one file by itself says the same
    assert run("map", scans / "scan_000.nc", "-o", tmp_path / "results" / "alone.nc", *OPTIONS) == 0
    xr.testing.assert_identical(load(tmp_path / "results" / "alone.nc"), result)


def test_population_maps_each_scan_by_itself(scans: Path, tmp_path: Path) -> None:
    """Several files of method population are one stack, but for a batch."""
    arguments = ("--method", "population", "--poisson-ratio", "0.35", "--phases", 1)
    assert run("map", scans / "*.nc", "--out-dir", tmp_path / "results", *arguments) == 0
    for name in ("scan_000.nc", "scan_001.nc"):
        result = load(tmp_path / "results" / name)
        assert result["A1"].dims == ("y", "x")
        assert result.sizes["material"] == 1


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ((), "it is not said where the result is to go"),
        (("-o", "maps.nc", "--out-dir", "results"), "--output is for one map"),
        (("--out-dir", "results", "--report", "maps.html"), "--reports, for one beside each result"),
        (("--out-dir", "results", "--paper", "paper", "--method", "population"), "--paper is for one map"),
        (("-o", "maps.nc", "--redo"), "--redo is for many files"),
        (("-o", "maps.nc", "--reports"), "--reports is for many files"),
        (("-o", "maps.nc"), "2 scans are mapped one by one"),
        (("--out-dir", "results", "--cluster", "lokal"), "is no cluster"),
        (("--out-dir", "results", "--harmonics", "one"), "--harmonics is not a list"),
        (("--out-dir", "results", "--noise", "much"), "--noise is not understood"),
    ],
)
def test_what_does_not_fit_is_said_before_anything_is_written(
    options: tuple[str, ...],
    message: str,
    scans: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    if "--cluster" in options:
        pytest.importorskip("distributed")
    monkeypatch.chdir(tmp_path)
    assert run("map", "scans/*.nc", *options) == 1
    said = flat(capsys.readouterr().err)
    assert message in said
    assert "Traceback" not in said
    assert [path.name for path in tmp_path.iterdir()] == ["scans"]


def test_an_interrupt_says_how_far_it_came(
    scans: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    import overtone.batch.files as files

    do, done = files.do, []

    def stop(job: object) -> object:
        if done:
            raise KeyboardInterrupt
        done.append(job)
        return do(job)

    monkeypatch.setattr(files, "do", stop)
    assert run("map", scans / "*.nc", "--out-dir", tmp_path / "results", *OPTIONS) == 130
    assert "1 of 2 files are done" in flat(capsys.readouterr().err)


def test_nothing_of_dask_is_loaded_until_it_is_asked_for() -> None:
    code = (
        "import sys, overtone as ot, overtone.cli.app; ot.map_files; import overtone.batch.files;"
        "sys.exit(any(name in sys.modules for name in ('dask', 'distributed', 'zarr', 'numba')))"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
