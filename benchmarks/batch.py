"""Many small maps through a cluster of this computer, one worker killed half way, against one process. By hand:

python benchmarks/batch.py [files]
"""

import multiprocessing
import os
import signal
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

import overtone as ot
from overtone.demo import virtual_scan
from overtone.instrument.noise import add_noise

NAMES = ["A0", "A1", "phi1", "A2", "phi2"]
SETTINGS = {"method": "exact", "motion": "cosine", "poisson_ratio": 0.35}


def make_scans(folder: Path, count: int) -> Path:
    """Write scans of 16 x 16 pixels, of one sample with noise of their own."""
    folder.mkdir()
    base, _ = virtual_scan(shape=(16, 16), seed=1)
    for i in range(count):
        ot.save(add_noise(base[NAMES], seed=i).assign_attrs(base.attrs), folder / f"scan_{i:04d}.nc")
    return folder


def kill_one_half_way(done: int, count: int) -> None:
    """Kill a worker once half of the files are done."""
    if done == count // 2:
        os.kill(next(child.pid for child in multiprocessing.active_children() if child.pid), signal.SIGKILL)


def largest_difference(one: Path, other: Path) -> tuple[int, float]:
    """Return how many results two folders have in common, and the largest relative difference of any number."""
    names = {path.name for path in one.glob("*.nc")} & {path.name for path in other.glob("*.nc")}
    worst = 0.0
    for name in names:
        here, there = ot.load(one / name), ot.load(other / name)
        assert set(here.variables) == set(there.variables)
        for key in here.variables:
            a, b = here[key].values.astype(float), there[key].values.astype(float)
            assert (np.isnan(a) == np.isnan(b)).all()
            with np.errstate(invalid="ignore", divide="ignore"):
                worst = max(worst, float(np.nanmax(np.where(a == b, 0.0, abs(a - b) / abs(a)), initial=0.0)))
    return len(names), worst


def main(count: str = "200") -> None:
    """Print seconds, ratios and differences."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        scans = make_scans(folder / "scans", int(count))
        ot.map_files(sorted(scans.iterdir())[0], folder / "first", **SETTINGS)  # kernels are compiled
        seconds = {}
        for label, options in (
            ("one process", {}),
            ("local cluster", {"cluster": "local"}),
            ("one worker killed", {"cluster": "local", "progress": kill_one_half_way}),
            ("all kept", {}),
        ):
            results = folder / ("one process" if label == "all kept" else label)
            start = time.perf_counter()
            batch = ot.map_files(scans / "*.nc", results, **options, **SETTINGS)
            seconds[label] = time.perf_counter() - start
            same, worst = largest_difference(folder / "one process", results)
            print(
                f"{label:>18}: {seconds[label]:6.1f} s, {seconds['one process'] / seconds[label]:5.2f} times as fast, "
                f"{batch.count('mapped')} mapped, {batch.count('kept')} kept, {len(batch.failed)} failed; {same} "
                f"results, largest relative difference {worst:g}",
                flush=True,
            )


if __name__ == "__main__":
    main(*sys.argv[1:])
