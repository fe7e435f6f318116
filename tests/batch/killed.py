"""A process that maps a folder of scans again and again, each time in a child that its parent may kill.

python killed.py SCANS RESULTS: reads a line for each run, after how long it is killed or "whole", and says how it
ended; the time is counted in those that one scan takes. Everything is imported and compiled once, so that a run takes
no longer than its work.
"""

import os
import signal
import sys
import tempfile
import time
from pathlib import Path

import overtone as ot
from overtone import blocks

SETTINGS = {"method": "exact", "motion": "cosine", "poisson_ratio": 0.35}


def main(scans: Path, results: Path) -> None:
    """Run once for every line that comes."""
    with tempfile.TemporaryDirectory() as folder:
        first = sorted(scans.iterdir())[0]
        ot.map_files(first, folder, **SETTINGS)
        start = time.perf_counter()
        ot.map_files(first, folder, redo=True, **SETTINGS)
        unit = time.perf_counter() - start
    for line in sys.stdin:
        child = os.fork()
        if child == 0:
            blocks._pool.cache_clear()  # threads do not live on in a child
            ot.map_files(scans / "*.nc", results, **SETTINGS)
            os._exit(0)
        if line.strip() != "whole":
            time.sleep(float(line) * unit)
            os.kill(child, signal.SIGKILL)
        _, status = os.waitpid(child, 0)
        sys.stdout.write(f"{os.waitstatus_to_exitcode(status)}\n")
        sys.stdout.flush()


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
