"""Files per second of a batch on processes of this computer against one process; read the ratio, not the seconds.

The time that a cluster takes to start counts, so that few small files are slower on it, and many large ones are not.
"""

from pathlib import Path
from typing import Any

import pytest

import overtone as ot
from overtone.demo import virtual_scan
from overtone.instrument.noise import add_noise

FILES = 24
NAMES = ["A0", "A1", "phi1", "A2", "phi2"]
SETTINGS = {"method": "exact", "motion": "cosine", "poisson_ratio": 0.35}


@pytest.fixture(scope="module")
def scans(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("batch")
    scans = folder / "scans"
    scans.mkdir()
    base, _ = virtual_scan(shape=(16, 16), seed=1)
    for i in range(FILES):
        ot.save(add_noise(base[NAMES], seed=i).assign_attrs(base.attrs), scans / f"scan_{i:03d}.nc")
    ot.map_files(sorted(scans.iterdir())[0], folder / "first", **SETTINGS)
    return scans


@pytest.mark.benchmark(group="24 maps of 16 x 16")
@pytest.mark.parametrize("cluster", [None, "local"], ids=["one process", "local cluster"])
def test_batch(benchmark: Any, scans: Path, tmp_path: Path, cluster: str | None) -> None:
    if cluster is not None:
        pytest.importorskip("distributed")
    batch = benchmark.pedantic(
        ot.map_files,
        args=(scans / "*.nc", tmp_path),
        kwargs=SETTINGS | {"cluster": cluster, "redo": True},
        rounds=1,
        iterations=1,
    )
    assert batch.count("mapped") == FILES
    benchmark.extra_info["files per call"] = FILES
