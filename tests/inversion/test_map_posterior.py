"""Method ``posterior`` on scans: arrangement, broken pixels, priors, models compared; coverage is tested elsewhere."""

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
from overtone.errors import InversionError, OvertoneError, ProbeError
from overtone.harmonics import far_phase
from overtone.instrument.noise import add_noise
from overtone.inversion import marginal
from overtone.inversion.priors import Prior
from overtone.inversion.properties import COMPARED, map_properties
from overtone.inversion.result import DETERMINED, MISSING_DATA, NO_CONTACT, NOT_DETERMINED
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
ASKED: dict[str, Any] = {"model": "dmt", "poisson_ratio": 0.3}
GOOD = {"A0": 2e-13, "A1": 1e-12, "phi1": 1e-4, "A2": 4e-14, "A3": 4e-14}
VARIANTS = ("", "_unscreened", "_lower", "_upper")


@pytest.fixture(scope="module")
def scan() -> xr.Dataset:
    """Return a noisy scan of many materials."""
    random = np.random.default_rng(1)
    modulus = np.exp(random.uniform(math.log(40e6), math.log(6e9), (6, 9)))
    material = sample("dmt", modulus=modulus, poisson_ratio=0.3, adhesion=random.uniform(2e-9, 20e-9, (6, 9)))
    setpoint = xr.DataArray(random.uniform(0.35, 0.9, (6, 9)), dims=("y", "x"))
    return add_noise(hold_amplitude(PROBE, material, setpoint=setpoint, dims=("y", "x")), seed=2)


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


@pytest.mark.parametrize("model", ["dmt", "dmt-viscous", "auto"])
@pytest.mark.parametrize("motion", ["full", "cosine"])
def test_blocks_and_threads_do_not_matter(
    scan: xr.Dataset, monkeypatch: pytest.MonkeyPatch, model: str, motion: str
) -> None:
    asked = {**ASKED, "model": model, "motion": motion}
    whole = map_properties(scan, PROBE, **asked)
    for size in (1, 13):
        monkeypatch.setattr(marginal, "BLOCK", size)
        identical(map_properties(scan, PROBE, **asked), whole)
    with ThreadPoolExecutor(1) as alone:
        monkeypatch.setattr(blocks, "_threads", lambda: alone)
        identical(map_properties(scan, PROBE, **asked), whole)


def test_order_and_neighbours_do_not_matter(scan: xr.Dataset) -> None:
    whole = map_properties(scan, PROBE, **ASKED)
    turned = map_properties(scan.isel(y=slice(None, None, -1)), PROBE, **ASKED)
    identical(turned.isel(y=slice(None, None, -1)), whole)
    identical(
        map_properties(scan.isel(y=slice(3, 5), x=[7]), PROBE, **ASKED), whole.isel(y=slice(3, 5), x=[7])
    )
    crossed = map_properties(scan.transpose(..., "x", "y"), PROBE, **ASKED)
    identical(crossed.transpose("y", "x"), whole)


def test_what_a_result_holds(scan: xr.Dataset) -> None:
    result = map_properties(scan, PROBE, **ASKED)
    names = {f"{q}{v}" for q in ("modulus", "adhesion", "indentation") for v in VARIANTS}
    rest = {"uncertainty", "misfit", "log_evidence", "contact_probability", "status"}
    assert set(result.data_vars) == names | rest
    shown = np.isfinite(result["modulus"].values)
    np.testing.assert_array_equal(shown, result["status"].values == DETERMINED)
    for q in ("modulus", "adhesion", "indentation"):
        low, middle, high = (result[f"{q}{v}"].values for v in ("_lower", "_unscreened", "_upper"))
        assert (low <= middle).all()
        assert (middle <= high).all()
    assert "modulus log-range 1e+06 3e+11" in result.attrs["priors"]
    viscous = map_properties(scan, PROBE, **{**ASKED, "model": "dmt-viscous"})
    assert {f"{q}{v}" for q in ("viscosity", "loss_tangent") for v in VARIANTS} <= set(viscous.data_vars)
    spring = map_properties(scan, PROBE, model="kelvin-voigt")
    assert {"stiffness", "damping", "loss_tangent", "indentation_upper"} <= set(spring.data_vars)
    assert "modulus" not in spring


def test_good_data_are_determined(clean: tuple[xr.Dataset, np.ndarray]) -> None:
    """Medians where the truth is, intervals around it, as wide as ordinary propagation says."""
    soft = slice(0, 4)
    result = map_properties(clean[0], PROBE, noise=GOOD, **ASKED).isel(p=soft)
    by_propagation = map_properties(clean[0], PROBE, noise=GOOD, method="exact", **ASKED).isel(p=soft)
    assert (result["status"] == DETERMINED).all()
    truth = {
        "modulus": clean[1][soft],
        "adhesion": 12e-9,
        "indentation": clean[0]["indentation"].values[soft],
    }
    for name, value in truth.items():
        assert (result[f"{name}_lower"] < value).all()
        assert (result[f"{name}_upper"] > value).all()
        assert (
            np.abs(result[name] - value) < 0.25 * (result[f"{name}_upper"] - result[f"{name}_lower"])
        ).all()
    sharp = by_propagation["uncertainty"].values < 0.1
    assert sharp.any()
    np.testing.assert_allclose(
        result["uncertainty"].values[sharp], by_propagation["uncertainty"].values[sharp], rtol=0.15
    )
    assert (result["contact_probability"] > 0.99).all()


def test_noisy_answers_cover_the_truth(clean: tuple[xr.Dataset, np.ndarray]) -> None:
    """300 noisy readings of one soft pixel: nine intervals in ten hold its modulus, where the prior says little."""
    many = add_noise(clean[0].isel(p=np.ones(300, int)), GOOD, seed=4)
    result = map_properties(many, PROBE, noise=GOOD, **ASKED)
    for name, truth in (("modulus", clean[1][1]), ("adhesion", 12e-9)):
        inside = (result[f"{name}_lower"] < truth) & (truth < result[f"{name}_upper"])
        # five standard errors of 300 draws
        assert float(inside.mean()) == pytest.approx(0.9, abs=0.087)


def test_more_noise_leaves_more_open(clean: tuple[xr.Dataset, np.ndarray]) -> None:
    width = []
    for factor in (1.0, 5.0, 25.0):
        noise = {name: factor * value for name, value in GOOD.items()}
        result = map_properties(clean[0], PROBE, noise=noise, **ASKED)
        width.append(np.log(result["modulus_upper"] / result["modulus_lower"]).values)
    # once the prior is all that is left, noise makes no difference any more
    assert (width[1][:3] > 2.0 * width[0][:3]).all()
    assert (width[2] > width[0]).all()


def test_a_stated_prior_counts(clean: tuple[xr.Dataset, np.ndarray]) -> None:
    ordinary = map_properties(clean[0], PROBE, **ASKED)
    priors = {"modulus": Prior("log-normal", 2e8, 1.2)}
    told = map_properties(clean[0], PROBE, priors=priors, **ASKED)
    assert (told["uncertainty"] < 0.2).all()
    assert (told["uncertainty"] < ordinary["uncertainty"]).all()
    assert ((told["modulus_unscreened"] > 1e8) & (told["modulus_unscreened"] < 4e8)).all()
    assert "modulus log-normal 2e+08 1.2" in told.attrs["priors"]
    # the interval says little more than that prior, which is no measurement
    assert (told["status"] != DETERMINED).any()
    bounded = map_properties(clean[0], PROBE, priors={"modulus": Prior("log-range", 1e8, 3e8)}, **ASKED)
    assert (bounded["modulus_lower"] >= 1e8 * (1 - 1e-9)).all()
    assert (bounded["modulus_upper"] <= 3e8 * (1 + 1e-9)).all()
    sticky = map_properties(clean[0], PROBE, priors={"adhesion": Prior("range", 11e-9, 13e-9)}, **ASKED)
    assert (sticky["adhesion_lower"] >= 11e-9 * (1 - 1e-9)).all()
    assert (sticky["adhesion_upper"] <= 13e-9 * (1 + 1e-9)).all()
    shallow = map_properties(
        clean[0], PROBE, priors={"indentation": Prior("log-range", 1e-11, 1e-9)}, **ASKED
    )
    assert (shallow["indentation_upper"] <= 1.001e-9).all()


@pytest.mark.parametrize(
    ("fault", "value"),
    [
        ("A0", math.nan),
        ("A1", math.nan),
        ("phi1", math.inf),
        ("A2", math.inf),
        ("phi3", math.nan),
        ("A1", 0.0),
        ("A1", math.inf),
    ],
)
@pytest.mark.parametrize("model", ["dmt", "auto"])
def test_broken_pixels_have_a_status(
    clean: tuple[xr.Dataset, np.ndarray], fault: str, value: float, model: str
) -> None:
    broken = clean[0].copy(deep=True)
    broken[fault][2] = value
    asked = {**ASKED, "model": model}
    result, whole = map_properties(broken, PROBE, **asked), map_properties(clean[0], PROBE, **asked)
    assert int(result["status"][2]) == MISSING_DATA
    for name in (
        "modulus_unscreened",
        "modulus_lower",
        "uncertainty",
        "log_evidence",
        "contact_probability",
        "misfit",
    ):
        assert np.isnan(result[name][2])
    if model == "auto":
        assert int(result["model"][2]) == -1
        assert np.isnan(result["model_probability"][2])
    others = [0, 1, 3, 4, 5]
    identical(result.isel(p=others), whole.isel(p=others))


@pytest.mark.parametrize("amplitude", [1e-15, 1e-12, 1e-3])
def test_absurd_amplitudes_spoil_no_neighbour(clean: tuple[xr.Dataset, np.ndarray], amplitude: float) -> None:
    observables = clean[0].copy(deep=True)
    observables["A1"][1] = amplitude
    result, whole = map_properties(observables, PROBE, **ASKED), map_properties(clean[0], PROBE, **ASKED)
    others = [0, 2, 3, 4, 5]
    identical(result.isel(p=others), whole.isel(p=others))
    assert int(result["status"][1]) != DETERMINED


@pytest.mark.parametrize("model", ["dmt", "dmt-viscous", "auto", "kelvin-voigt-adhesion"])
def test_a_saturated_scan_has_no_answer(model: str) -> None:
    for values in (
        {"A0": 0.0, "A1": 94e-9, "phi1": far_phase(PROBE), "A2": 0.0, "phi2": 0.0, "A3": 0.0, "phi3": 0.0},
        {"A0": 1e-9, "A1": 94e-9, "phi1": 3.1, "A2": 1e-9, "phi2": 1.0, "A3": 1e-9, "phi3": 1.0},
    ):
        flat = xr.Dataset({name: (("y", "x"), np.full((2, 3), value)) for name, value in values.items()})
        result = map_properties(flat, PROBE, **{**ASKED, "model": model})
        assert not (result["status"] == DETERMINED).any()


def test_attractive_pixels_have_no_modulus() -> None:
    probe = replace(PROBE, drive=replace(PROBE.drive, free_amplitude=20e-9))
    adhesion = np.array([20e-9, 35e-9])
    material = sample("dmt", modulus=np.full(2, 1e9), poisson_ratio=0.3, adhesion=adhesion)
    apart = hold_amplitude(probe, material, setpoint=0.8, regime="attractive", n_max=20, dims=("p",))
    better = {name: 0.1 * sigma for name, sigma in GOOD.items()}
    sure = map_properties(apart, probe, noise=better, **ASKED)
    assert (sure["status"] == NO_CONTACT).all()
    assert (sure["contact_probability"] < 0.05).all()
    # a contact so slight that noise does not tell it from none is no determination either
    result = map_properties(apart, probe, noise=GOOD, **ASKED)
    assert (result["status"] != DETERMINED).all()
    assert (result["contact_probability"] < 0.5).all()
    assert np.isnan(result["modulus"]).all()
    assert np.isnan(sure["modulus"]).all()
    assert (result["indentation_upper"] < 0.0).all()
    for name, truth in (("adhesion", adhesion), ("indentation", apart["indentation"].values)):
        assert (result[f"{name}_lower"] < truth).all()
        assert (result[f"{name}_upper"] > truth).all()
        assert np.isfinite(result[name]).all()


def simulated(model: str, **material: float) -> xr.Dataset:
    """Return good data of a soft material, eight noisy readings."""
    states = hold_amplitude(
        PROBE,
        sample(model, poisson_ratio=0.3, modulus=np.full(8, 150e6), **material),
        setpoint=0.5,
        n_max=20,
        dims=("p",),
    )
    return add_noise(states, GOOD, seed=6)


@pytest.mark.parametrize(
    ("made_of", "material"),
    [
        ("hertz", {}),
        ("dmt", {"adhesion": 12e-9}),
        ("dmt-viscous", {"adhesion": 12e-9, "viscosity": 20.0}),
        ("hertz-viscous", {"viscosity": 20.0}),
    ],
)
def test_data_choose_the_model_that_made_them(made_of: str, material: dict[str, float]) -> None:
    result = map_properties(simulated(made_of, **material), PROBE, noise=GOOD, **{**ASKED, "model": "auto"})
    names = result["model"].attrs["flag_meanings"].split()
    assert names == ["none", *COMPARED]
    chosen = [
        dict(zip(result["model"].attrs["flag_values"], names, strict=True))[int(k)]
        for k in result["model"].values
    ]
    assert chosen == [made_of] * 8
    assert (result["model_probability"] > 0.5).all()
    assert (result["modulus_lower"] < 150e6).mean() > 0.6
    assert (result["modulus_upper"] > 150e6).mean() > 0.6


def test_the_preferred_model_has_the_larger_evidence() -> None:
    data = simulated("dmt", adhesion=12e-9)
    alone = {
        model: map_properties(data, PROBE, noise=GOOD, harmonics=(0, 1, 2, 3), **{**ASKED, "model": model})
        for model in COMPARED[:2]
    }
    assert (alone["dmt"]["log_evidence"] > alone["hertz"]["log_evidence"] + 5.0).all()
    # evidence is compared on the same rows: with loss those of DISS are among them
    both = map_properties(data, PROBE, noise=GOOD, **{**ASKED, "model": "auto"})
    assert (both["log_evidence"] != alone["dmt"]["log_evidence"]).all()


def test_half_the_size(scan: xr.Dataset) -> None:
    whole, half = map_properties(scan, PROBE, **ASKED), map_properties(scan, PROBE, dtype="float32", **ASKED)
    assert half["modulus_upper"].dtype == np.float32
    np.testing.assert_array_equal(half["status"], whole["status"])
    np.testing.assert_allclose(half["modulus_unscreened"], whole["modulus_unscreened"], rtol=1e-6)


def test_doubts_of_the_reading_leave_nothing_determined(clean: tuple[xr.Dataset, np.ndarray]) -> None:
    doubtful = with_reading(clean[0], Reading(PROBE, doubts={0: "offset"}))
    result = map_properties(doubtful, PROBE, noise=GOOD, **ASKED)
    assert (result["status"] == NOT_DETERMINED).all()
    for name in ("modulus", "adhesion", "indentation"):
        assert np.isnan(result[name]).all()
    assert result.attrs["cannot_conclude"] == "offset."
    spared = map_properties(doubtful, PROBE, noise=GOOD, harmonics=(1, 2, 3), **ASKED)
    assert (spared["status"] == DETERMINED).any()


@pytest.mark.parametrize(
    ("change", "error", "match"),
    [
        ({"priors": {"Modulus": Prior("log-range", 1e6, 1e9)}}, InversionError, "'Modulus' has no prior"),
        ({"priors": {"modulus": Prior("range", 1e6, 1e9)}}, InversionError, "does not fit"),
        ({"model": "auto", "harmonics": (0,)}, InversionError, "too few harmonics"),
        ({"model": "dmt", "harmonics": (1, 2)}, InversionError, "too few harmonics.*0 dissipative"),
        ({"model": "auto", "poisson_ratio": None}, InversionError, "no default"),
        ({"model": "sls"}, InversionError, "cannot be inverted"),
        ({"noise": {"A2": math.nan}}, OvertoneError, "noise is not stated"),
    ],
)
def test_calls_that_cannot_be_answered(
    clean: tuple[xr.Dataset, np.ndarray], change: dict[str, Any], error: type[Exception], match: str
) -> None:
    with pytest.raises(error, match=match):
        map_properties(clean[0], PROBE, **{**ASKED, **change})


def test_a_modulus_needs_a_tip(clean: tuple[xr.Dataset, np.ndarray]) -> None:
    with pytest.raises(ProbeError, match="no tip radius"):
        map_properties(clean[0], replace(PROBE, tip=Tip()), **{**ASKED, "model": "auto"})
