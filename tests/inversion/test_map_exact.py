"""Method ``exact`` on scans: the same answer however the pixels are arranged, and a status for every broken one."""

import math
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import xarray as xr

from overtone import blocks
from overtone.contact.sample import sample
from overtone.dynamics.hold import hold_amplitude
from overtone.errors import InversionError, ObservablesError, OvertoneError, ProbeError
from overtone.harmonics import far_phase
from overtone.instrument.noise import add_noise
from overtone.inversion import exact, separable
from overtone.inversion.properties import map_properties
from overtone.inversion.result import (
    DETERMINED,
    MISSING_DATA,
    NO_CONTACT,
    NO_SOLUTION,
    NOT_DETERMINED,
    POOR_FIT,
    SEVERAL_SOLUTIONS,
)
from overtone.probe import Probe, Tip
from overtone.readings import Reading, with_reading

PROBE = Probe.simple(
    stiffness=16.4,
    frequency=161.8e3,
    quality_factor=287.0,
    radius=10e-9,
    drive_frequency=161.8e3,
    free_amplitude=94e-9,
)
ASKED: dict[str, Any] = {"model": "dmt", "poisson_ratio": 0.3, "method": "exact"}
FINE = {"A0": 1e-14, "A1": 1e-14, "phi1": 1e-6, "A2": 1e-15, "A3": 1e-15}


@pytest.fixture(scope="module")
def scan() -> tuple[xr.Dataset, np.ndarray]:
    """Return a noisy scan of many materials, and their moduli."""
    random = np.random.default_rng(1)
    modulus = np.exp(random.uniform(math.log(40e6), math.log(6e9), (9, 14)))
    material = sample(
        "dmt", modulus=modulus, poisson_ratio=0.3, adhesion=random.uniform(2e-9, 20e-9, (9, 14))
    )
    setpoint = xr.DataArray(random.uniform(0.35, 0.9, (9, 14)), dims=("y", "x"))
    return add_noise(hold_amplitude(PROBE, material, setpoint=setpoint, dims=("y", "x")), seed=2), modulus


@pytest.fixture(scope="module")
def clean() -> tuple[xr.Dataset, np.ndarray]:
    modulus = np.geomspace(60e6, 900e6, 6)
    material = sample("dmt", modulus=modulus, poisson_ratio=0.3, adhesion=12e-9)
    return hold_amplitude(PROBE, material, setpoint=0.5, n_max=20, dims=("p",)), modulus


def identical(one: xr.Dataset, other: xr.Dataset) -> None:
    assert set(one.data_vars) == set(other.data_vars)
    for name in one.data_vars:
        assert one[name].dims == other[name].dims
        np.testing.assert_array_equal(one[name], other[name], err_msg=str(name))


@pytest.mark.parametrize("model", ["dmt", "dmt-viscous"])
@pytest.mark.parametrize("motion", ["full", "cosine"])
def test_blocks_and_threads_do_not_matter(
    scan: tuple[xr.Dataset, np.ndarray], monkeypatch: pytest.MonkeyPatch, model: str, motion: str
) -> None:
    asked = {**ASKED, "model": model, "motion": motion}
    whole = map_properties(scan[0], PROBE, **asked)
    for size in (1, 17):
        monkeypatch.setattr(separable, "BLOCK", size)
        identical(map_properties(scan[0], PROBE, **asked), whole)
    with ThreadPoolExecutor(1) as alone:
        monkeypatch.setattr(blocks, "_threads", lambda: alone)
        identical(map_properties(scan[0], PROBE, **asked), whole)


def test_order_and_neighbours_do_not_matter(scan: tuple[xr.Dataset, np.ndarray]) -> None:
    whole = map_properties(scan[0], PROBE, **ASKED)
    turned = map_properties(scan[0].isel(y=slice(None, None, -1)), PROBE, **ASKED)
    identical(turned.isel(y=slice(None, None, -1)), whole)
    part = map_properties(scan[0].isel(y=slice(3, 5), x=[7]), PROBE, **ASKED)
    identical(part, whole.isel(y=slice(3, 5), x=[7]))
    crossed = map_properties(scan[0].transpose(..., "x", "y"), PROBE, **ASKED)
    identical(crossed.transpose("y", "x", ...), whole)
    single = map_properties(scan[0].isel(y=2, x=3), PROBE, **ASKED)
    identical(single, whole.isel(y=2, x=3))


def test_harmonics_are_taken_in_any_order(scan: tuple[xr.Dataset, np.ndarray]) -> None:
    identical(
        map_properties(scan[0], PROBE, harmonics=(2, 0, 1), **ASKED),
        map_properties(scan[0], PROBE, harmonics=(0, 1, 2), **ASKED),
    )


def test_what_a_result_holds(scan: tuple[xr.Dataset, np.ndarray]) -> None:
    result = map_properties(scan[0], PROBE, **ASKED)
    names = {
        f"{q}{v}" for q in ("modulus", "adhesion", "indentation") for v in ("", "_unscreened", "_solutions")
    }
    assert set(result.data_vars) == names | {"misfit", "uncertainty", "solutions", "status"}
    assert result["modulus_solutions"].dims == ("y", "x", "solution")
    assert result.sizes["solution"] == exact.MOST
    assert result["modulus"].attrs["units"] == "Pa"
    shown = np.isfinite(result["modulus"].values)
    np.testing.assert_array_equal(shown, result["status"].values == DETERMINED)
    np.testing.assert_array_equal(result["modulus"].values[shown], result["modulus_unscreened"].values[shown])
    found = np.isfinite(result["indentation_solutions"].values).sum(axis=2)
    np.testing.assert_array_equal(result["solutions"], found)
    viscous = map_properties(scan[0], PROBE, **{**ASKED, "model": "dmt-viscous"})
    assert {"viscosity", "loss_tangent", "loss_tangent_solutions"} <= set(viscous.data_vars)


def test_good_data_are_determined(clean: tuple[xr.Dataset, np.ndarray]) -> None:
    result = map_properties(clean[0], PROBE, noise=FINE, **ASKED)
    assert (result["status"] == DETERMINED).all()
    np.testing.assert_allclose(result["modulus"], clean[1], rtol=1e-4)
    np.testing.assert_allclose(result["adhesion"], 12e-9, rtol=1e-4)
    np.testing.assert_allclose(result["indentation"], clean[0]["indentation"], rtol=1e-4)
    assert (result["uncertainty"] < 0.02).all()


def test_uncertainty_is_the_scatter_of_noisy_answers(clean: tuple[xr.Dataset, np.ndarray]) -> None:
    noise = {"A0": 1e-13, "A1": 4e-13, "phi1": 4e-5, "A2": 2e-14, "A3": 2e-14}
    one = clean[0].isel(p=[1])
    many = add_noise(one.isel(p=np.zeros(2000, int)), noise, seed=4)
    result = map_properties(many, PROBE, noise=noise, **ASKED)
    log = np.log(result["modulus_unscreened"].values)
    sigma = float(result["uncertainty"].median())
    assert 0.005 < sigma < 0.2
    assert float(np.std(log)) == pytest.approx(sigma, rel=0.1)
    assert float(np.mean(log)) == pytest.approx(math.log(clean[1][1]), abs=0.15 * sigma + sigma**2)


def test_noise_that_is_stated_smaller_than_it_is_fits_badly(clean: tuple[xr.Dataset, np.ndarray]) -> None:
    noisy = add_noise(clean[0].isel(p=np.zeros(60, int)), {"A0": 1e-11, "A2": 3e-12, "A3": 3e-12}, seed=5)
    result = map_properties(
        noisy, PROBE, noise={"A0": 1e-13, "A1": 1e-13, "phi1": 1e-5, "A2": 3e-14, "A3": 3e-14}, **ASKED
    )
    assert (result["status"] == POOR_FIT).mean() > 0.8
    assert np.isnan(result["modulus"].values[result["status"].values == POOR_FIT]).all()


def test_statuses_of_pixels_without_one_answer(scan: tuple[xr.Dataset, np.ndarray]) -> None:
    result = map_properties(scan[0], PROBE, harmonics=(0, 1, 2), **ASKED)
    status, count = result["status"].values, result["solutions"].values
    np.testing.assert_array_equal(status == SEVERAL_SOLUTIONS, count > 1)
    np.testing.assert_array_equal(status == NO_SOLUTION, count == 0)
    assert (status == NO_SOLUTION).any()
    # the closest sample there is stands in the unscreened maps
    none = status == NO_SOLUTION
    assert np.isfinite(result["modulus_unscreened"].values[none]).all()
    assert (result["misfit"].values[none] > 0.0).all()
    wide = result["uncertainty"].values[(status == DETERMINED)]
    assert (wide <= 1.0).all()
    assert (result["uncertainty"].values[status == NOT_DETERMINED] > 1.0).all()


def broken(clean: xr.Dataset) -> tuple[xr.Dataset, list[int]]:
    """Return twelve pixels, each with a fault of its own, and which status they must have."""
    scan = clean.isel(p=np.full(13, 2)).copy(deep=True)
    faults: list[tuple[dict[str, float], int]] = [
        ({"A0": math.nan}, MISSING_DATA),
        ({"A1": math.nan}, MISSING_DATA),
        ({"phi1": math.nan}, MISSING_DATA),
        ({"A2": math.nan}, MISSING_DATA),
        ({"phi3": math.inf}, MISSING_DATA),
        ({"A1": 0.0}, MISSING_DATA),
        ({"A1": math.inf}, MISSING_DATA),
        ({"A3": math.inf}, MISSING_DATA),
        ({"A0": -math.inf}, MISSING_DATA),
        ({"A0": 0.0, "A1": 0.0, "phi1": 0.0, "A2": 0.0, "phi2": 0.0, "A3": 0.0, "phi3": 0.0}, MISSING_DATA),
    ]
    for pixel, (changes, _) in enumerate(faults):
        for name, value in changes.items():
            scan[name][pixel] = value
    return scan, [status for _, status in faults] + [DETERMINED] * 3


@pytest.mark.parametrize("model", ["dmt", "dmt-viscous", "hertz", "thin-layer"])
def test_broken_pixels_have_a_status(clean: tuple[xr.Dataset, np.ndarray], model: str) -> None:
    observables, expected = broken(clean[0])
    result = map_properties(
        observables,
        PROBE,
        given={"thickness": 1e-6} if model == "thin-layer" else None,
        **{**ASKED, "model": model},
    )
    missing = np.array(expected) == MISSING_DATA
    np.testing.assert_array_equal(result["status"].values == MISSING_DATA, missing)
    for name in ("modulus", "modulus_unscreened", "misfit", "uncertainty"):
        assert np.isnan(result[name].values[missing]).all()
    assert not result["solutions"].values[missing].any()
    # and those beside them are as they were
    alone = map_properties(
        clean[0].isel(p=[2]),
        PROBE,
        given={"thickness": 1e-6} if model == "thin-layer" else None,
        **{**ASKED, "model": model},
    )
    np.testing.assert_array_equal(
        result["modulus_unscreened"].values[~missing], np.repeat(alone["modulus_unscreened"].values, 3)
    )


@pytest.mark.parametrize("amplitude", [1e-15, 1e-12, 1e-3])
def test_absurd_amplitudes_spoil_no_neighbour(clean: tuple[xr.Dataset, np.ndarray], amplitude: float) -> None:
    observables = clean[0].copy(deep=True)
    observables["A1"][1] = amplitude
    result = map_properties(observables, PROBE, **ASKED)
    whole = map_properties(clean[0], PROBE, **ASKED)
    others = [0, 2, 3, 4, 5]
    identical(result.isel(p=others), whole.isel(p=others))
    assert int(result["status"][1]) != DETERMINED
    assert np.isnan(result["modulus"][1])


def test_a_saturated_scan_has_no_answer(clean: tuple[xr.Dataset, np.ndarray]) -> None:
    """Every reading the same: the free motion, or none that a contact could make."""
    for values in (
        {"A0": 0.0, "A1": 94e-9, "phi1": far_phase(PROBE), "A2": 0.0, "phi2": 0.0, "A3": 0.0, "phi3": 0.0},
        {"A0": 1e-9, "A1": 94e-9, "phi1": 3.1, "A2": 1e-9, "phi2": 1.0, "A3": 1e-9, "phi3": 1.0},
    ):
        flat = xr.Dataset({name: (("y", "x"), np.full((3, 4), value)) for name, value in values.items()})
        result = map_properties(flat, PROBE, **ASKED)
        assert not (result["status"] == DETERMINED).any()
        assert np.isnan(result["modulus"]).all()


def test_attractive_pixels_among_others(clean: tuple[xr.Dataset, np.ndarray]) -> None:
    probe = replace(PROBE, drive=replace(PROBE.drive, free_amplitude=20e-9))
    adhesion = np.array([20e-9, 35e-9])
    apart = hold_amplitude(
        probe,
        sample("dmt", modulus=np.full(2, 1e9), poisson_ratio=0.3, adhesion=adhesion),
        setpoint=0.8,
        regime="attractive",
        n_max=20,
        dims=("p",),
    )
    soft = sample("dmt", modulus=np.full(2, 3e8), poisson_ratio=0.3, adhesion=adhesion)
    touching = hold_amplitude(probe, soft, setpoint=0.4, n_max=20, dims=("p",))
    both = xr.concat([apart, touching], "p")
    result = map_properties(both, probe, **ASKED)
    assert list(result["status"].values[:2]) == [NO_CONTACT, NO_CONTACT]
    np.testing.assert_allclose(result["adhesion"][:2], adhesion, rtol=1e-3)
    assert (result["indentation"][:2] < 0.0).all()
    assert np.isnan(result["modulus_unscreened"][:2]).all()
    off = np.abs(result["modulus_solutions"][2:] / 3e8 - 1.0)
    assert (off.min("solution") < 0.01).all()


def test_half_the_size(scan: tuple[xr.Dataset, np.ndarray]) -> None:
    whole = map_properties(scan[0], PROBE, **ASKED)
    half = map_properties(scan[0], PROBE, dtype="float32", **ASKED)
    assert half["modulus"].dtype == np.float32
    np.testing.assert_array_equal(half["status"], whole["status"])
    np.testing.assert_allclose(half["modulus_unscreened"], whole["modulus_unscreened"], rtol=1e-6)
    # readings of half the size are read as they are
    narrow = scan[0].astype(np.float32)
    result = map_properties(narrow, PROBE, **ASKED)
    assert result["modulus"].dtype == np.float64
    np.testing.assert_array_equal(result["modulus"].shape, whole["modulus"].shape)


def test_progress_counts_every_pixel(
    scan: tuple[xr.Dataset, np.ndarray], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(separable, "BLOCK", 50)
    seen: list[tuple[int, int]] = []
    map_properties(scan[0], PROBE, progress=lambda done, total: seen.append((done, total)), **ASKED)
    assert len(seen) == 3
    assert seen[-1] == (126, 126)


def test_doubts_of_the_reading_leave_nothing_determined(clean: tuple[xr.Dataset, np.ndarray]) -> None:
    doubtful = with_reading(clean[0], Reading(PROBE, doubts={2: "distortion"}))
    result = map_properties(doubtful, PROBE, noise=FINE, **ASKED)
    assert (result["status"] == NOT_DETERMINED).all()
    for name in ("modulus", "adhesion", "indentation"):
        assert np.isnan(result[name]).all()
        assert np.isfinite(result[f"{name}_unscreened"]).all()
    assert result.attrs["cannot_conclude"] == "distortion."
    spared = map_properties(doubtful, PROBE, noise=FINE, harmonics=(0, 1, 3), **ASKED)
    assert (spared["status"] == DETERMINED).any()


@pytest.mark.parametrize(
    ("change", "error", "match"),
    [
        ({"method": "magic"}, InversionError, "unknown method.*posterior, population, exact, least-squares"),
        ({"motion": "sine"}, InversionError, "unknown motion.*full or cosine"),
        ({"dtype": "int8"}, InversionError, "float64 or float32"),
        ({"model": "jkr"}, InversionError, "'jkr' cannot be inverted.*dmt-viscous"),
        ({"model": "nonsense"}, OvertoneError, "nonsense"),
        ({"model": "auto"}, InversionError, 'method="posterior"'),
        ({"poisson_ratio": None}, InversionError, "Poisson's ratio.*no default"),
        ({"poisson_ratio": 0.7}, OvertoneError, "poisson_ratio is out of range"),
        ({"harmonics": (0, 1)}, InversionError, "too few harmonics.*3 force harmonics or more"),
        ({"harmonics": (0, 1), "model": "hertz"}, None, ""),
        ({"harmonics": (1,), "model": "hertz"}, InversionError, "too few harmonics"),
        ({"harmonics": (1, 1, 2)}, InversionError, "twice"),
        ({"harmonics": (0, 1, 2, 4)}, InversionError, "harmonic 4 was not measured"),
        ({"model": "cone"}, InversionError, "needs half_angle"),
        ({"given": {"colour": 1.0}}, InversionError, "takes no colour"),
        ({"noise": {"A1": -1.0}}, OvertoneError, "noise is not stated"),
        ({"intermolecular_distance": -1e-9}, OvertoneError, "intermolecular_distance is out of range"),
    ],
)
def test_calls_that_cannot_be_answered(
    clean: tuple[xr.Dataset, np.ndarray], change: dict[str, Any], error: type[Exception] | None, match: str
) -> None:
    asked = {**ASKED, **change}
    if error is None:
        assert map_properties(clean[0], PROBE, **asked)["modulus_unscreened"].shape == (6,)
        return
    with pytest.raises(error, match=match):
        map_properties(clean[0], PROBE, **asked)


def test_scans_that_cannot_be_read(clean: tuple[xr.Dataset, np.ndarray]) -> None:
    with pytest.raises(ObservablesError, match="lack"):
        map_properties(clean[0].drop_vars("phi1"), PROBE, harmonics=(0, 2, 3), **ASKED)
    with pytest.raises(ObservablesError, match="negative"):
        map_properties(clean[0].assign(A1=-clean[0]["A1"]), PROBE, **ASKED)
    with pytest.raises(ProbeError, match="no tip radius"):
        map_properties(clean[0], replace(PROBE, tip=Tip()), **ASKED)
