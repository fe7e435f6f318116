"""A run that is killed at any moment leaves whole results only, and the next goes on where it was."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import xarray as xr

import overtone as ot
from overtone.batch.record import is_whole, record_in
from overtone.io.netcdf import load

from .conftest import SETTINGS, assert_same_results, write_scans

KILLS = 20
FILES = 24


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs processes that split")
def test_twenty_kills_leave_whole_results_and_the_end_is_the_same(base: xr.Dataset, tmp_path: Path) -> None:
    scans = write_scans(tmp_path / "scans", base, FILES)
    results = tmp_path / "killed"
    generator = np.random.default_rng(7)
    seen, progress = set(), []
    # the package is found as it is here, the folder of this file is not what is imported from
    script = Path(__file__).parent / "killed.py"
    with subprocess.Popen(
        [sys.executable, script, scans, results], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdin is not None
        assert process.stdout is not None
        ended = []
        for delay in [*generator.uniform(0.1, 3.0, KILLS), "whole"]:
            process.stdin.write(f"{delay}\n")
            process.stdin.flush()
            ended.append(int(process.stdout.readline()))
            there = sorted(results.glob("*.nc"))
            for path in there:
                assert is_whole(path)
                assert record_in(path) is not None
                if path not in seen:
                    assert load(path)["A1"].size == 256
            # nothing that was done is lost
            assert seen <= set(there)
            seen = set(there)
            progress.append(len(seen))
        process.stdin.close()
    assert ended[-1] == 0
    killed = [code == -9 for code in ended]
    # most of the kills hit a run at work, and runs got further in between
    assert sum(killed) >= KILLS // 2
    assert len(set(progress)) > 5
    assert len(seen) == FILES
    assert not list(results.rglob(".*"))
    ot.map_files(scans / "*.nc", tmp_path / "undisturbed", **SETTINGS)
    assert_same_results(results, tmp_path / "undisturbed", FILES)
