"""A cluster gives what one process gives, and loses nothing when a worker dies."""

import multiprocessing
import os
import re
import signal
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import xarray as xr

import overtone as ot
from overtone.batch.cluster import run_jobs
from overtone.batch.one import FAILED, KEPT, MAPPED
from overtone.cli import main
from overtone.errors import OvertoneError
from overtone.io.netcdf import load, save

from .conftest import SETTINGS, assert_same_results, write_scans

FILES = 24


@pytest.fixture(scope="module")
def scans(base: xr.Dataset, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_scans(tmp_path_factory.mktemp("cluster") / "scans", base, FILES)


@pytest.fixture(scope="module")
def scheduler() -> Iterator[Any]:
    """A cluster of somebody else's, with two workers of two threads."""
    distributed = pytest.importorskip("distributed")
    where = {"dashboard_address": "127.0.0.1:0", "scheduler_kwargs": {"dashboard": False}}
    with distributed.LocalCluster(n_workers=2, threads_per_worker=2, **where) as cluster:
        yield cluster


def test_a_worker_that_is_killed_loses_nothing(scans: Path, tmp_path: Path) -> None:
    pytest.importorskip("distributed")
    killed: list[int] = []

    def kill(done: int, count: int) -> None:
        workers = [child.pid for child in multiprocessing.active_children() if child.pid is not None]
        if done == count // 2 and not killed:
            os.kill(workers[0], signal.SIGKILL)
            killed.append(workers[0])

    batch = ot.map_files(scans / "*.nc", tmp_path / "cluster", cluster="local", progress=kill, **SETTINGS)
    assert len(killed) == 1
    assert not batch.failed
    assert batch.count(MAPPED) + batch.count(KEPT) == FILES
    ot.map_files(scans / "*.nc", tmp_path / "plain", **SETTINGS)
    assert_same_results(tmp_path / "cluster", tmp_path / "plain", FILES)
    assert not list((tmp_path / "cluster").glob(".*"))


def test_the_workers_of_a_scheduler_take_one_scan_at_a_time(
    scans: Path, scheduler: Any, tmp_path: Path
) -> None:
    """With two threads each: findings come from warnings, which are one for all threads of a process."""
    base = load(scans / "scan_000.nc")
    files = [tmp_path / "scans" / f"scan_{i:03d}.nc" for i in range(16)]
    files[0].parent.mkdir()
    for i, file in enumerate(files):
        save(base.assign(A0=base["A0"] + (10 + i) * 1e-9).assign_attrs(base.attrs), file)
    (tmp_path / "odd.nc").write_text("no scan")
    address = scheduler.scheduler_address
    batch = ot.map_files([*files, tmp_path / "odd.nc"], tmp_path / "cluster", cluster=address, **SETTINGS)
    assert [outcome.state for outcome in batch.outcomes] == [MAPPED] * 16 + [FAILED]
    ot.map_files(files, tmp_path / "plain", **SETTINGS)
    assert_same_results(tmp_path / "cluster", tmp_path / "plain", 16)
    for i, file in enumerate(files):
        findings = load(tmp_path / "cluster" / file.name).attrs["findings"]
        assert re.findall(r"averages (\d+)[\d.]* nm", findings) == [str(10 + i)]
    again = ot.map_files(files, tmp_path / "cluster", cluster=address, **SETTINGS)
    assert again.count(KEPT) == 16


DIE = "__import__('os').kill(__import__('os').getpid(), 9)"


@pytest.mark.parametrize(
    ("odd", "reason"), [(DIE, "4 workers died over it"), ("1 / 0", "ZeroDivisionError: division by zero")]
)
def test_a_job_that_kills_its_workers_is_given_up_and_the_others_done(
    odd: str, reason: str, tmp_path: Path
) -> None:
    pytest.importorskip("distributed")
    jobs = {i: odd if i == 1 else f"2 * {i}" for i in range(6)}
    done = dict(run_jobs(jobs, "local", tmp_path, eval, lambda _, said: said))
    assert reason in done.pop(1)
    assert done == {0: 0, 2: 4, 3: 6, 4: 8, 5: 10}


def test_workers_that_do_not_fit_are_refused(
    scans: Path, scheduler: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    address = scheduler.scheduler_address
    with monkeypatch.context() as patch:
        patch.setattr("overtone.batch.cluster.__version__", "99.0")
        with pytest.raises(OvertoneError, match="has another overtone: expected 99"):
            ot.map_files(scans / "*.nc", tmp_path / "results", cluster=address, **SETTINGS)
    with monkeypatch.context() as patch:
        patch.setattr(Path, "touch", lambda *_: None)
        with pytest.raises(OvertoneError, match="does not see the folder"):
            ot.map_files(scans / "*.nc", tmp_path / "results", cluster=address, **SETTINGS)
    assert not list((tmp_path / "results").glob("*.nc"))


def test_without_dask_it_says_what_to_install(
    scans: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(OvertoneError, match=re.escape('pip install "overtone[cluster]"')):
        ot.map_files(scans / "*.nc", tmp_path / "results", cluster="local", **SETTINGS)
    assert not (tmp_path / "results").exists()


def test_what_is_no_cluster_is_refused(scans: Path, tmp_path: Path) -> None:
    pytest.importorskip("distributed")
    with pytest.raises(OvertoneError, match="'lokal' is no cluster"):
        ot.map_files(scans / "*.nc", tmp_path / "results", cluster="lokal", **SETTINGS)


def test_the_command_line_maps_on_a_cluster(
    scans: Path, scheduler: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    options = ["--method", "exact", "--motion", "cosine", "--poisson-ratio", "0.35"]
    where = ["--out-dir", str(tmp_path / "results"), "--cluster", scheduler.scheduler_address]
    with pytest.raises(SystemExit) as end:
        main(["map", f"{scans}/scan_00*.nc", *where, *options])
    assert end.value.code in (0, None)
    assert "10 mapped" in capsys.readouterr().out
    assert len(list((tmp_path / "results").glob("*.nc"))) == 10
