import runpy
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from overtone import plots
from overtone.plots.canvas import new_figure
from overtone.quantities import named_array

_STATUS = {
    "flag_values": [0, 1, 3, 4],
    "flag_meanings": "determined not_determined_by_these_data model_does_not_fit at_bound",
}
_REGIME = {"flag_values": [-1, 0, 1], "flag_meanings": "attractive undetermined repulsive"}


def _metres(ny: int, nx: int, pixel: float = 50e-9) -> dict[str, tuple[str, np.ndarray]]:
    """Coordinates as a scan carries them: y falls from the top row."""
    return {"y": ("y", np.arange(ny)[::-1] * pixel), "x": ("x", np.arange(nx) * pixel)}


def _map(name: str, values, **attributes) -> xr.DataArray:
    values = np.asarray(values)
    return named_array(name, values, ("y", "x"), _metres(*values.shape), **attributes)


def _drawn(array: xr.DataArray, **options) -> Axes:
    figure = new_figure(4.0, 3.5)
    axes = figure.subplots()
    plots.draw_map(axes, array, **options)
    figure.canvas.draw()  # a picture that cannot be drawn is none
    return axes


def _titles(figure: Figure) -> list[str]:
    return [axes.get_title(loc="left") for axes in figure.axes if axes.get_title(loc="left")]


@pytest.fixture(scope="session")
def synthetic() -> SimpleNamespace:
    """Return what makes results with intervals and solutions."""
    return SimpleNamespace(**runpy.run_path(str(Path(__file__).with_name("synthetic.py"))))


@pytest.fixture(scope="session")
def a_map() -> Callable[..., xr.DataArray]:
    """Return what makes a map of a known quantity with coordinates."""
    return _map


@pytest.fixture(scope="session")
def drawn() -> Callable[..., Axes]:
    """Return what draws an array on axes of its own."""
    return _drawn


@pytest.fixture(scope="session")
def titles() -> Callable[[Figure], list[str]]:
    """Return what reads the titles of the cells of a figure."""
    return _titles


@pytest.fixture(scope="session")
def status_flags() -> dict[str, object]:
    return _STATUS


@pytest.fixture(scope="session")
def regime_flags() -> dict[str, object]:
    return _REGIME


@pytest.fixture(scope="session")
def observables() -> xr.Dataset:
    rng = np.random.default_rng(0)
    noise = rng.normal(1.0, 0.01, (12, 20))
    means = {"height": 5e-9, "A0": 1e-10, "A1": 40e-9, "phi1": 0.4, "A2": 1e-10, "phi2": 4.0}
    return xr.Dataset({name: _map(name, mean * noise) for name, mean in means.items()})


@pytest.fixture(scope="session")
def energies() -> xr.Dataset:
    rng = np.random.default_rng(1)
    dims, coords = ("harmonic", "y", "x"), _metres(12, 20) | {"harmonic": [0, 1, 2]}
    return xr.Dataset(
        {
            "F_cons": named_array("F_cons", rng.normal(-5e-9, 1e-10, (3, 12, 20)), dims, coords),
            "F_diss": named_array("F_diss", rng.normal(0.0, 1e-11, (3, 12, 20)), dims, coords),
            "dissipation": _map("dissipation", rng.normal(2e-18, 1e-18, (12, 20))),
            "virial": _map("virial", rng.normal(-1e-16, 1e-18, (12, 20))),
            "regime": _map("regime", np.repeat([[1] * 15 + [0] * 5], 12, axis=0), **_REGIME),
        }
    )


@pytest.fixture(scope="session")
def properties() -> xr.Dataset:
    """Left half soft and determined, right half stiff and open."""
    rng = np.random.default_rng(2)
    status = np.repeat([[0] * 10 + [1] * 9 + [4]], 12, axis=0)
    modulus = np.where(status == 0, 1e8, 3e9) * np.exp(rng.normal(0, 0.1, status.shape))
    arrays = {}
    for name, values in (("modulus", modulus), ("adhesion", 100 / modulus), ("indentation", 1 / modulus)):
        arrays[f"{name}_unscreened"] = _map(f"{name}_unscreened", values)
        arrays[name] = _map(name, np.where(status == 0, values, np.nan))
    arrays["modulus_lower"] = _map("modulus_lower", np.where(status == 0, modulus / 1.5, 1e4))
    arrays["modulus_upper"] = _map("modulus_upper", np.where(status == 0, modulus * 1.5, 1e12))
    arrays["amplification"] = _map("amplification", np.where(status == 0, 10.0, 1e4))
    arrays["residual"] = _map("residual", np.where(status == 0, 0.0, 1e-3))
    arrays["status"] = _map("status", status.astype(np.int8), **_STATUS)
    return xr.Dataset(arrays)


@pytest.fixture(scope="session")
def truth(properties: xr.Dataset) -> xr.Dataset:
    soft = properties["status"].values == 0
    return xr.Dataset(
        {
            "modulus": _map("modulus", np.where(soft, 9e7, 2e9)),
            "adhesion": _map("adhesion", np.where(soft, 1e-6, 5e-8)),
            "indentation": _map("indentation", np.where(soft, 1e-8, -1e-9)),
            "material": (("y", "x"), soft.astype(np.int8)),
        }
    )
