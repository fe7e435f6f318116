import math
from typing import Any

import numpy as np
import pytest
import xarray as xr

from overtone import provenance
from overtone.contact.sample import sample
from overtone.demo import demo_probe, virtual_scan
from overtone.dynamics.hold import hold_amplitude
from overtone.errors import ContactModelError, InversionError, OvertoneError
from overtone.inversion.properties import (
    AT_BOUND,
    DETERMINED,
    MISSING_DATA,
    NOT_DETERMINED,
    POOR_FIT,
    map_energy,
    map_properties,
    undetermined_properties,
)
from overtone.probe import Probe, Tip
from overtone.readings import Reading, with_reading

OBSERVED = ["A0", "A1", "phi1", "A2", "phi2", "A3", "phi3"]
ASKED: dict[str, Any] = {"method": "least-squares", "model": "dmt-linear", "poisson_ratio": 0.35}


@pytest.fixture(scope="module")
def scan() -> tuple[xr.Dataset, xr.Dataset]:
    return virtual_scan(shape=(24, 36), seed=5)


@pytest.fixture(scope="module")
def soft() -> xr.Dataset:
    """Return noise-free observables of soft samples, which harmonics 1, 2, 3 determine."""
    modulus = np.linspace(60e6, 120e6, 5)
    state = hold_amplitude(
        demo_probe(), sample("dmt", modulus=modulus, poisson_ratio=0.35, adhesion=16e-9), setpoint=0.42
    )
    return state[OBSERVED].assign(truth=("dim_0", modulus))


def test_soft_samples_are_determined_by_harmonics_1_2_3(soft: xr.Dataset) -> None:
    result = map_properties(soft, demo_probe(), harmonics=(1, 2, 3), **ASKED)
    assert (result["status"] == DETERMINED).all()
    np.testing.assert_allclose(result["modulus"], soft["truth"], rtol=0.05)
    assert (result["modulus_lower"] < soft["truth"]).all()
    assert (result["modulus_upper"] > soft["truth"]).all()
    xr.testing.assert_allclose(result["modulus"], result["modulus_unscreened"])


def test_the_exact_tail_inverts_what_the_exact_tail_made(soft: xr.Dataset) -> None:
    """What is left is the bare cosine of eq 10: 2 to 3 %, and the same from either set of harmonics."""
    for harmonics in ((0, 1, 2), (1, 2, 3)):
        asked = ASKED | {"model": "dmt", "harmonics": harmonics, "noise": {"A0": 1e-14}}
        result = map_properties(soft, demo_probe(), **asked)
        ratio = result["modulus_unscreened"].values / soft["truth"].values
        assert ((ratio > 1.015) & (ratio < 1.035)).all()


def test_least_squares_cannot_tell_stiff_samples_and_says_so(scan: tuple[xr.Dataset, xr.Dataset]) -> None:
    observables, truth = scan
    stiff = truth["material"].values == 0
    for harmonics in ((0, 1, 2), (1, 2, 3)):
        result = map_properties(observables, demo_probe(), harmonics=harmonics, **ASKED)
        # A good residual everywhere, and no modulus: that is the point.
        assert (result["residual"].values[stiff] < 0.1).mean() > 0.95
        assert (result["status"].values[stiff] == DETERMINED).mean() < 0.01
        shown = np.isfinite(result["modulus"].values)
        np.testing.assert_array_equal(shown, result["status"].values == DETERMINED)
        low, high = result["modulus_lower"].values, result["modulus_upper"].values
        covered = (low <= truth["modulus"].values) & (truth["modulus"].values <= high)
        assert 0.86 < covered.mean() < 0.99


def test_shared_doubts_leave_no_pixel_determined(soft: xr.Dataset) -> None:
    doubtful = with_reading(soft, Reading(demo_probe(), doubts={2: "distortion"}))
    result = map_properties(doubtful, demo_probe(), harmonics=(1, 2, 3), **ASKED)
    assert (result["status"] == NOT_DETERMINED).all()
    assert np.isnan(result["modulus"]).all()
    assert result.attrs["cannot_conclude"] == "distortion."
    harmless = with_reading(soft, Reading(demo_probe(), doubts={0: "offset"}))
    assert (
        map_properties(harmless, demo_probe(), harmonics=(1, 2, 3), **ASKED)["status"] == DETERMINED
    ).all()


def test_more_noise_determines_less(soft: xr.Dataset) -> None:
    width = []
    for phase in (1e-4, 1e-3, 1e-2):
        result = map_properties(
            soft, demo_probe(), harmonics=(1, 2, 3), noise={"phi1": phase, "A2": 1e-14, "A3": 1e-14}, **ASKED
        )
        width.append(float(np.log(result["modulus_upper"] / result["modulus_lower"]).mean()))
    assert width == sorted(width)
    assert width[-1] > 2 * width[0]


def test_broken_pixels_are_a_status(soft: xr.Dataset) -> None:
    broken = soft.copy(deep=True)
    broken["A2"][0] = np.nan
    broken["phi1"][1] = np.inf
    broken["A1"][2] = 0.0
    broken["A3"][3] = 0.0
    result = map_properties(broken, demo_probe(), harmonics=(1, 2, 3), **ASKED)
    assert list(result["status"].values) == [MISSING_DATA] * 4 + [DETERMINED]
    assert np.isnan(result["modulus_unscreened"].values[:4]).all()


def test_results_do_not_depend_on_the_order_of_pixels(scan: tuple[xr.Dataset, xr.Dataset]) -> None:
    observables, _ = scan
    whole = map_properties(observables, demo_probe(), **ASKED)
    turned = map_properties(observables.isel(y=slice(None, None, -1)), demo_probe(), **ASKED)
    part = map_properties(observables.isel(y=slice(3, 9), x=slice(0, 5)), demo_probe(), **ASKED)
    names = ["modulus_unscreened", "residual", "uncertainty", "status", "modulus_lower"]
    xr.testing.assert_identical(whole[names], turned[names].isel(y=slice(None, None, -1)))
    xr.testing.assert_identical(whole[names].isel(y=slice(3, 9), x=slice(0, 5)), part[names])
    swapped = map_properties(observables.transpose("x", "y"), demo_probe(), **ASKED)
    np.testing.assert_array_equal(swapped["residual"].transpose("y", "x"), whole["residual"])


def test_an_answer_at_a_bound_says_so(scan: tuple[xr.Dataset, xr.Dataset]) -> None:
    result = map_properties(scan[0], demo_probe(), **ASKED)
    bound = result["status"] == AT_BOUND
    assert bound.any()
    assert np.isnan(result["modulus"].where(bound, drop=True)).all()


def test_the_result_tells_how_it_was_made(soft: xr.Dataset) -> None:
    result = map_properties(soft, demo_probe(), harmonics=(1, 2, 3), noise={"A2": 2e-12}, **ASKED)
    entry = provenance.history(result)[-1]
    assert entry["operation"] == "map_properties"
    assert entry["arguments"]["noise"]["A2"] == 2e-12
    assert entry["arguments"]["noise_stated"] == ["A2"]
    assert result["modulus"].attrs["units"] == "Pa"
    assert result["status"].attrs["flag_meanings"].split()[NOT_DETERMINED] == "not_determined_by_these_data"


@pytest.mark.parametrize(
    ("change", "error", "word"),
    [
        ({"method": "guess"}, InversionError, "unknown method"),
        ({"model": "dtm"}, ContactModelError, "unknown contact model"),
        ({"model": "dmt-viscous"}, InversionError, "cannot be inverted"),
        ({"harmonics": (0, 2, 3)}, InversionError, "harmonics do not fit"),
        ({"poisson_ratio": 0.8}, ContactModelError, "poisson_ratio is out"),
        ({"noise": {"B0": 1.0}}, OvertoneError, "noise is not stated"),
    ],
)
def test_wrong_calls_are_named(
    soft: xr.Dataset, change: dict[str, Any], error: type[Exception], word: str
) -> None:
    with pytest.raises(error, match=word):
        map_properties(soft, demo_probe(), **(ASKED | change))


def test_what_was_not_measured_is_asked_for(soft: xr.Dataset) -> None:
    with pytest.raises(InversionError, match="harmonic 0 was not measured"):
        map_properties(soft.drop_vars("A0"), demo_probe(), **ASKED)
    blunt = Probe(demo_probe().cantilever, demo_probe().drive, Tip(radius=None))
    with pytest.raises(OvertoneError, match="no tip radius"):
        map_properties(soft, blunt, **ASKED)


def test_a_modulus_scales_as_the_root_of_the_radius(soft: xr.Dataset) -> None:
    wide = Probe(demo_probe().cantilever, demo_probe().drive, Tip(radius=40e-9))
    sharp, blunt = (
        map_properties(soft, p, harmonics=(1, 2, 3), **ASKED)["modulus"] for p in (demo_probe(), wide)
    )
    np.testing.assert_allclose(sharp / blunt, 2.0, rtol=2e-3)


def test_nothing_to_conclude_is_a_result_too(soft: xr.Dataset) -> None:
    result = undetermined_properties(soft, "dmt-linear", "no A2")
    assert (result["status"] == NOT_DETERMINED).all()
    assert np.isnan(result["modulus"]).all()
    assert result.attrs["cannot_conclude"] == "no A2"


def test_a_misfit_beyond_noise_is_no_modulus() -> None:
    """Hertz on an adhesive sample leaves a residual below 0.1 and a chi-squared far beyond noise."""
    state = hold_amplitude(
        demo_probe(), sample("dmt", modulus=30e6, poisson_ratio=0.35, adhesion=5e-9), setpoint=0.3
    )
    pixel = state[OBSERVED].expand_dims("point")
    noise = {"A3": 1e-13, "A2": 1e-13, "phi1": 1e-4}
    for method in ("least-squares", "posterior", "exact"):
        asked = ASKED | {"model": "hertz", "harmonics": (1, 2, 3), "method": method, "noise": noise}
        assert int(map_properties(pixel, demo_probe(), **asked)["status"][0]) == POOR_FIT


def test_perfect_data_are_no_crash(soft: xr.Dataset) -> None:
    silent = dict.fromkeys(("A1", "phi1", "A2", "A3"), 0.0)
    result = map_properties(soft, demo_probe(), harmonics=(1, 2, 3), noise=silent, **ASKED)
    assert np.isfinite(result["modulus_lower"]).all()


def test_energy_needs_only_amplitude_and_phase(scan: tuple[xr.Dataset, xr.Dataset]) -> None:
    observables, _ = scan
    result = map_energy(observables[["A1", "phi1"]].assign_attrs(observables.attrs), demo_probe())
    assert list(result["harmonic"].values) == [1]
    # A conservative sample: the energy lost is zero within the noise of the phase.
    noise = math.pi * 39.5e-9 * 16.4 * 94e-9 / 287 * math.cos(0.43) * math.radians(0.1)
    noise = math.hypot(noise, math.pi * 39.5e-9 * 16.4 / 287 * 20e-12)
    assert abs(float(result["dissipation"].mean())) < 4 * noise / math.sqrt(result["dissipation"].size)
    assert float(result["dissipation"].std()) == pytest.approx(noise, rel=0.1, abs=0)
    assert (result["regime"] == 1).all()
    unsure = with_reading(observables, Reading(demo_probe(), phase_established=False))
    assert (map_energy(unsure, demo_probe())["regime"] == 0).all()
