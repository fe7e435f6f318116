"""The numbers of docs/identifiability.md: fig 7 of the paper inverted, and what a small residual leaves open."""

import importlib.util
import math
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import xarray as xr

import overtone as ot

_DOCS = Path(__file__).parents[2] / "docs"
SETPOINTS = (0.2, 0.5, 0.7, 0.9)


@pytest.fixture(scope="module")
def script() -> ModuleType:
    """Return the script that makes the page."""
    spec = importlib.util.spec_from_file_location("identifiability_page", _DOCS / "identifiability.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def states(script: ModuleType) -> xr.Dataset:
    """Return noise-free states of section 3 of the paper: 1 GPa, 20 nN, DMT."""
    sample = ot.sample("dmt", modulus=1e9, poisson_ratio=0.3, adhesion=20e-9)
    return ot.hold_amplitude(script.probe_of_section_3(), sample, setpoint=SETPOINTS, n_max=40)


def inverted(states: xr.Dataset, probe: ot.Probe, **how: Any) -> tuple[np.ndarray, np.ndarray]:
    """Return modulus [GPa] and adhesion [nN] from harmonics 0 to 2."""
    found = ot.map_properties(states, probe, poisson_ratio=0.3, harmonics=(0, 1, 2), **how)
    return found["modulus_unscreened"].values / 1e9, found["adhesion_unscreened"].values / 1e-9


# --- fig 7 -------------------------------------------------------------------------------------------------------


def test_the_published_estimator_on_fig_7(script: ModuleType, states: xr.Dataset) -> None:
    """The linear tail costs 4 to 17 % of the modulus."""
    modulus, adhesion = inverted(
        states, script.probe_of_section_3(), model="dmt-linear", method="least-squares"
    )
    np.testing.assert_allclose(modulus, [0.961, 0.916, 0.889, 0.829], atol=1e-3)
    np.testing.assert_allclose(adhesion, [19.5, 19.4, 19.2, 18.5], atol=0.06)


@pytest.mark.parametrize("method", ["exact", "least-squares"])
def test_the_exact_tail_on_a_bare_cosine(script: ModuleType, states: xr.Dataset, method: str) -> None:
    """Two independent solvers; what is left is eq 10."""
    how = {"motion": "cosine"} if method == "exact" else {}
    modulus, adhesion = inverted(states, script.probe_of_section_3(), model="dmt", method=method, **how)
    np.testing.assert_allclose(modulus, [1.063, 1.034, 1.024, 1.016], atol=1e-3)
    np.testing.assert_allclose(adhesion, [20.3, 20.1, 20.1, 20.1], atol=0.06)


def test_the_full_motion_leaves_nothing(script: ModuleType, states: xr.Dataset) -> None:
    modulus, adhesion = inverted(states, script.probe_of_section_3(), model="dmt", method="exact")
    np.testing.assert_allclose(modulus, 1.0, rtol=1e-3)
    np.testing.assert_allclose(adhesion, 20.0, rtol=1e-3)


# --- what harmonics leave open -----------------------------------------------------------------------------------


def test_a_small_residual_accepts_decades_of_moduli_of_polystyrene(script: ModuleType) -> None:
    """The least N_r below 0.1, without noise: PS is open towards stiff, LDPE is closed by four harmonics."""
    low, high = script.accepted(script.PS, (0, 1, 2))
    assert low < script.PS.modulus < high
    assert math.log10(high / low) > 2.0
    # open by four decades and more: an undented sample is within N_r = 0.03
    assert low == pytest.approx(9.5e6, rel=0.1, abs=0)
    assert script.least_residual(script.PS, (0, 1, 2), np.array([1e12]))[0] == pytest.approx(
        0.023, rel=0.05, abs=0
    )
    low, high = script.accepted(script.LDPE, (0, 1, 2, 3))
    assert math.log10(high / low) < 1.0


def test_the_residual_vanishes_at_the_truth_and_is_that_of_the_fit_elsewhere(script: ModuleType) -> None:
    """The least residual at a modulus by another search, over adhesion and indentation at once."""
    from scipy.optimize import minimize

    data = script.cons("dmt-linear", *script.PS, script.MAP_AMPLITUDE)[:3]
    assert script.least_residual(script.PS, (0, 1, 2), np.array([script.PS.modulus]))[0] < 1e-6
    for modulus in (0.1e9, 10e9):

        def residual(x: np.ndarray, modulus: float = modulus) -> float:
            found = script.cons("dmt-linear", modulus, *np.exp(x), script.MAP_AMPLITUDE)[:3]
            return float(np.linalg.norm(found / data - 1.0))

        best = min(
            minimize(
                residual, np.log([F, d]), method="Nelder-Mead", options={"xatol": 1e-8, "fatol": 1e-10}
            ).fun
            for F in (1e-10, 2e-9, 2e-8)
            for d in (1e-9, 1e-8)
        )
        assert script.least_residual(script.PS, (0, 1, 2), np.array([modulus]))[0] == pytest.approx(
            best, rel=1e-3, abs=0
        )


@pytest.mark.parametrize(
    ("Delta", "expected"),
    [(0.01, (1e5, 2e4, 1.5e4)), (0.1, (1.6e3, 280.0, 211.0)), (0.5, (29.0, 2.5, 1.8))],
)
def test_amplification(script: ModuleType, Delta: float, expected: tuple[float, ...]) -> None:
    """Within the factor that another norm makes (2.5), and always less with more harmonics."""
    found = [script.amplification(Delta, orders) for orders in script.SETS.values()]
    for value, known in zip(found, expected, strict=True):
        assert known / 2.5 < value < known * 2.5
    assert found[2] < min(found[:2])


def test_amplification_is_the_gain_of_the_estimator(script: ModuleType) -> None:
    """The derivative of the published estimator's own answer, on data of the contact that it fits."""
    A, modulus, depth = 40e-9, 1e8, 8e-9
    Lambda = 4.0 / 3.0 * math.sqrt(1e-8) / (0.91 / 130e9 + 0.91 / modulus)
    adhesion = 0.3 * Lambda * depth**1.5
    force = script.cons("dmt-linear", modulus, adhesion, depth, A)[:3]
    answers = []
    for i in range(3):
        sides = []
        for way in (1.0, -1.0):
            nudged = force.copy()
            nudged[i] += way * 1e-6 * abs(force[i])
            one = script.converged(nudged[None], np.array([A]), (modulus, adhesion, depth))
            sides.append(math.log(one.modulus[0]))
        answers.append((sides[0] - sides[1]) / 2e-6)
    # the linear tail, which the table leaves out, changes little at this depth
    assert script.amplification(0.1, (0, 1, 2)) == pytest.approx(np.linalg.norm(answers), rel=0.15, abs=0)


# --- least squares from one start --------------------------------------------------------------------------------


def test_a_stopped_fit_repeats_its_start_and_a_finished_one_scatters(script: ModuleType) -> None:
    force, amplitude = script.forces_of(script.noisy_scan(script.PS, {}))
    few = slice(0, 24)
    means = []
    for modulus in (0.5e9, 2e9, 8e9):
        way = script.searched(force[few], amplitude[few], (modulus, 2e-9, 2.5e-9), most=20)
        early = script.stopped(way, script.ACCEPTED)
        assert early.residual.max() < 0.1
        assert early.modulus.std() / early.modulus.mean() < 0.01
        means.append(early.modulus.mean())
    assert means[0] < 0.6 * means[1] < 0.36 * means[2]
    finished = [script.converged(force, amplitude, start) for start in script.STARTS]
    for one in finished:
        assert np.log(one.modulus).std() > 1.0
        assert (one.residual < 0.1).mean() > 0.99
        # at the minimum the start does not matter
        same = np.abs(np.log(one.modulus / finished[0].modulus)) < 1e-3
        assert same.mean() > 0.98


def test_errors_that_a_scan_shares_move_its_median_further_than_its_standard_error(
    script: ModuleType,
) -> None:
    medians = {}
    for title, errors in script.SHARED.items():
        found = script.converged(*script.forces_of(script.noisy_scan(script.LDPE, errors)), script.STARTS[4])
        medians[title] = np.median(found.modulus)
    assert medians["none"] == pytest.approx(script.LDPE.modulus, rel=0.15, abs=0)
    assert medians["+1 pm of A0"] > 1.1 * medians["none"] > 1.2 * medians["-1 pm of A0"]
    assert medians["+1 degree of phi1"] > 1.25 * medians["none"] > 1.5 * medians["-1 degree of phi1"]


def test_the_tables_of_the_page_are_those_of_the_script(script: ModuleType) -> None:
    page = (_DOCS / "identifiability.md").read_text(encoding="utf-8")
    assert script.amplification_table() in page
    assert script.ratio_table() in page
    assert "${" not in page
