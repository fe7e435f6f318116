"""A map of 4096 x 4096 pixels: seconds, and the most memory the process ever held. By hand:

python benchmarks/large_map.py [method] [motion] [side]
"""

import resource
import sys
import time

import numpy as np
import xarray as xr

import overtone as ot
from overtone.demo import demo_probe, virtual_scan

NAMES = ("A0", "A1", "phi1", "A2", "phi2")


def peak() -> float:
    """Return the most memory so far [GB]."""
    scale = 1.0 if sys.platform == "darwin" else 1024.0  # bytes there, kilobytes elsewhere
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * scale / 1e9


def main(method: str = "posterior", motion: str = "full", side: str = "4096") -> None:
    """Map so many pixels, single precision in and out."""
    small, _ = virtual_scan(shape=(64, 64), seed=1)
    times = int(side) // 64
    tiled = {
        name: (("y", "x"), np.tile(small[name].values.astype(np.float32), (times, times)), small[name].attrs)
        for name in NAMES
    }
    scan = xr.Dataset(tiled, attrs=small.attrs)
    ot.map_properties(small, demo_probe(), model="dmt", poisson_ratio=0.35, method=method, motion=motion)
    before, start = peak(), time.perf_counter()
    maps = ot.map_properties(
        scan, demo_probe(), model="dmt", poisson_ratio=0.35, method=method, motion=motion, dtype="float32"
    )
    seconds = time.perf_counter() - start
    print(
        f"{method}, {motion}: {maps['status'].size / 1e6:.1f} million pixels in {seconds:.0f} s, "
        f"{maps['status'].size / seconds:,.0f} a second; at most {peak():.2f} GB ({before:.2f} GB before)"
    )


if __name__ == "__main__":
    main(*sys.argv[1:])
