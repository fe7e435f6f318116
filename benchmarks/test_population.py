"""A whole scan of 256 x 256 pixels by method population, beside what a user would write today.

Three materials under an instrument that is off by what its calibration states. The rival is a loop of SciPy over the
pixels with the closed forms of this package, from one start: without intervals, phases or shared errors. It is given
a part of the pixels; what is printed (`-s`) is for the whole scan. That the answers are right is shown in
docs/worlds.md.
"""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.optimize import least_squares

import overtone as ot
from overtone.contact.models import contact_model
from overtone.inversion.columns import columns_of, fill_columns
from overtone.inversion.linear import stiffness

SHAPE = (256, 256)
PRIORS = {"modulus": ot.Prior("log-normal", 0.45e9, 4.0), "adhesion": ot.Prior("log-normal", 5.7e-9, 2.8)}
LOOPED = 512  # pixels that the loop of SciPy is given
GROUP = "a whole scan, 256 x 256"


@pytest.fixture(scope="module")
def sample() -> Any:
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(Path(__file__).parent))
        worlds = importlib.import_module("worlds_simulated")
    return worlds.world(2, kind="three", noise_A0=5e-12, calibration="tight", shape=SHAPE)


def asked(sample: Any, model: str, motion: str) -> dict[str, Any]:
    return {
        "model": model,
        "poisson_ratio": sample.materials[0].poisson_ratio,
        "noise": sample.noise,
        "priors": PRIORS,
        "motion": motion,
    }


def noted(benchmark: Any, pixels: int) -> None:
    seconds = benchmark.stats["min"] / pixels * SHAPE[0] * SHAPE[1]
    benchmark.extra_info["seconds for 256 x 256 pixels"] = round(seconds, 2)
    print(f"{benchmark.name}: {seconds:.1f} s for 256 x 256 pixels")


@pytest.mark.benchmark(group=GROUP)
@pytest.mark.parametrize("motion", ["full", "cosine"])
@pytest.mark.parametrize("model", ["dmt-viscous", "dmt"])
def test_population(benchmark: Any, sample: Any, model: str, motion: str) -> None:
    """Single pixels, phases, materials with what they share, other laws of contact, pooled pixels."""
    options = asked(sample, model, motion) | {"method": "population"}
    corner = sample.scan.isel(y=slice(0, 40), x=slice(0, 40))
    ot.map_properties(corner, sample.probe, **options)  # compiles
    result = benchmark.pedantic(
        ot.map_properties, (sample.scan, sample.probe), options, rounds=3, iterations=1
    )
    noted(benchmark, sample.scan["A1"].size)
    assert result.sizes["material"] > 1


@pytest.mark.benchmark(group=GROUP)
def test_single_pixels(benchmark: Any, sample: Any) -> None:
    """Method posterior with both parts of the uncertainty, for comparison."""
    options = asked(sample, "dmt-viscous", "full") | {"method": "posterior", "priors": None}
    ot.map_properties(sample.scan.isel(y=slice(0, 8)), sample.probe, **options)
    benchmark.pedantic(ot.map_properties, (sample.scan, sample.probe), options, rounds=1, iterations=1)
    noted(benchmark, sample.scan["A1"].size)


@pytest.mark.benchmark(group=GROUP)
def test_loop_of_scipy(benchmark: Any, sample: Any) -> None:
    """Modulus, adhesion, loss tangent and indentation of pixel after pixel, on a bare cosine."""
    forces = ot.to_force_harmonics(sample.scan, sample.probe)
    columns = columns_of(
        contact_model("dmt-viscous"), sample.probe, {"poisson_ratio": sample.materials[0].poisson_ratio}
    )
    some = np.linspace(0, sample.scan["A1"].size - 1, LOOPED).astype(int)
    cons = forces["F_cons"].transpose(..., "harmonic").values.reshape(-1, forces.sizes["harmonic"])[some, :4]
    loss = forces["F_diss"].sel(harmonic=1).values.ravel()[some]
    observed = np.column_stack([cons, loss])
    amplitude = sample.scan["A1"].values.ravel()[some]
    work = np.empty((6, 4))

    def left_over(x: np.ndarray, y: np.ndarray, A: float) -> np.ndarray:
        E, F, tangent, indentation = np.exp(x)
        fill_columns(columns, A, indentation / (2.0 * A), 3, work)
        S = stiffness(columns.contact, E)[0]
        model = np.append(S * work[0] + F * work[2], -S * tangent * work[0, 1])
        return np.asarray((model - y) / np.abs(y).max())

    def loop(count: int) -> None:
        for y, A in zip(observed[:count], amplitude[:count], strict=True):
            top = np.log([1e12, 1e-6, 2.0, 2.0 * A * 0.999])
            start, bottom = np.log([1e9, 10e-9, 0.05, 5e-9]), np.log([1e4, 1e-12, 1e-6, 1e-12])
            least_squares(left_over, start, bounds=(bottom, top), args=(y, A))

    loop(1)  # compiles
    benchmark.pedantic(loop, (LOOPED,), rounds=1, iterations=1)
    noted(benchmark, LOOPED)
