"""Small scans of one sample, which differ in their noise."""

from pathlib import Path

import pytest
import xarray as xr

from overtone.demo import virtual_scan
from overtone.instrument.noise import add_noise
from overtone.io.netcdf import save

SETTINGS = {"method": "exact", "motion": "cosine", "poisson_ratio": 0.35}
"""Of which a map takes no time, so that it goes into what is tested."""
NAMES = ["A0", "A1", "phi1", "A2", "phi2"]


@pytest.fixture(scope="session")
def base() -> xr.Dataset:
    return virtual_scan(shape=(16, 16), seed=1)[0]


def write_scans(folder: Path, base: xr.Dataset, count: int) -> Path:
    """Write scans into a folder."""
    folder.mkdir(parents=True)
    for i in range(count):
        save(add_noise(base[NAMES], seed=i).assign_attrs(base.attrs), folder / f"scan_{i:03d}.nc")
    return folder


def assert_same_results(one: Path, other: Path, count: int) -> None:
    """Compare all results of two folders, values and attributes."""
    from overtone.io.netcdf import load

    names = sorted(path.name for path in one.glob("*.nc"))
    assert len(names) == count
    assert names == sorted(path.name for path in other.glob("*.nc"))
    for name in names:
        xr.testing.assert_identical(load(one / name), load(other / name))
