"""Intervals hold what they say: a part of docs/posterior.md, with draws of its own."""

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from scipy.stats import binom, chisquare

SCRIPT = Path(__file__).parents[2] / "docs" / "posterior.py"
NUMBER = 1000
"""Of the chunk: none of those of the page."""
NOISE_DRAWS, INSTRUMENT_DRAWS = 50, 20
"""Of each model and noise."""
KINDS = {
    "elastic": ("modulus", "stiffness"),
    "adhesion": ("adhesion",),
    "indentation": ("indentation",),
    "loss": ("viscosity", "damping"),
    "loss_tangent": ("loss_tangent",),
}
CHANCE = 1e-3
"""That a right program fails, over all that is asserted of coverage and ranks together."""
CHECKS = 2 * 2 * len(KINDS)

Outcomes = dict[tuple[str, str], dict[str, np.ndarray]]


@pytest.fixture(scope="module")
def script() -> ModuleType:
    spec = importlib.util.spec_from_file_location("posterior_page", SCRIPT)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def outcomes(script: ModuleType) -> Outcomes:
    found = {}
    for model in script.MODELS:
        for run, size in ((script.NOISE_ONLY, NOISE_DRAWS), (script.CALIBRATED, INSTRUMENT_DRAWS)):
            parts = [script.inverted(model, run, level, NUMBER, size) for level in script.LEVELS]
            found[model, run] = script.together(parts)
    return found


def bins(script: ModuleType, outcomes: Outcomes, run: str, kind: str) -> np.ndarray:
    """Return the bins of the truths of a kind of quantity, over all models."""
    parts = [
        script.bins_of(some, name)
        for (model, its_run), some in outcomes.items()
        for name in script.MODELS[model]
        if its_run == run and name in KINDS[kind]
    ]
    found = np.concatenate(parts)
    return found[found >= 0]


def holds(found: np.ndarray) -> bool:
    """Return whether chance makes a coverage so far from 90 %."""
    low, high = binom.ppf([0.5 * CHANCE / CHECKS, 1.0 - 0.5 * CHANCE / CHECKS], found.size, 0.9)
    return bool(low <= np.isin(found, (1, 2)).sum() <= high)


def narrowed(some: dict[str, np.ndarray], name: str, factor: float) -> dict[str, np.ndarray]:
    """Return outcomes with intervals that are narrower about their medians: of ratios, but for adhesion and tangent."""
    result = dict(some)
    for end in ("lower", "upper"):
        middle, edge = some[f"{name}_unscreened"], some[f"{name}_{end}"]
        if name in ("adhesion", "loss_tangent"):
            result[f"{name}_{end}"] = middle + factor * (edge - middle)
        else:
            with np.errstate(invalid="ignore"):  # indentations of no contact are negative, and do not count
                result[f"{name}_{end}"] = middle * (edge / middle) ** factor
    return result


@pytest.mark.parametrize("kind", KINDS)
def test_ninety_of_hundred_intervals_hold_the_truth(
    kind: str, script: ModuleType, outcomes: Outcomes
) -> None:
    for run, fewest in ((script.NOISE_ONLY, 200), (script.CALIBRATED, 80)):
        found = bins(script, outcomes, run, kind)
        assert found.size > fewest
        assert holds(found), (run, np.isin(found, (1, 2)).mean())


@pytest.mark.parametrize("kind", KINDS)
def test_truths_are_as_likely_in_every_part_of_a_posterior(
    kind: str, script: ModuleType, outcomes: Outcomes
) -> None:
    for run in (script.NOISE_ONLY, script.CALIBRATED):
        found = bins(script, outcomes, run, kind)
        counts = np.bincount(found, minlength=4)
        assert chisquare(counts, np.array(script.BINS) * found.size).pvalue > CHANCE / CHECKS, (run, counts)


@pytest.mark.parametrize("kind", KINDS)
def test_intervals_that_are_too_narrow_are_found_out(
    kind: str, script: ModuleType, outcomes: Outcomes
) -> None:
    tampered = {}
    for (model, run), some in outcomes.items():
        changed = some
        for name in set(script.MODELS[model]) & set(KINDS[kind]):
            changed = narrowed(changed, name, 0.7)
        tampered[model, run] = changed
    assert not holds(bins(script, tampered, script.NOISE_ONLY, kind))


def test_no_interval_is_much_wider_than_the_data_allow(script: ModuleType, outcomes: Outcomes) -> None:
    """Width over the information limit, where a posterior is near a Gaussian."""
    for run in (script.NOISE_ONLY, script.CALIBRATED):
        ratios = []
        for model, (elastic, *_) in script.MODELS.items():
            some = outcomes[model, run]
            width = np.log(some[f"{elastic}_upper"] / some[f"{elastic}_lower"])
            near = np.isfinite(some["limit"]) & (script.bins_of(some, elastic) >= 0)
            ratios.append((width / (2.0 * script.NINETY * some["limit"]))[near])
        together = np.concatenate(ratios)
        assert together.size > 20
        assert 0.9 < np.median(together) < 1.25


def test_a_draw_is_what_the_force_law_says(script: ModuleType) -> None:
    """What an instrument without error reads of a draw gives back the force that was simulated."""
    draw = None
    random = np.random.default_rng(5)
    while draw is None:
        draw = script.one_draw("dmt-viscous", random, calibrated=False)
    observables = script.observables_of([draw.reading])
    force = script.ot.to_force_harmonics(observables, draw.probe)
    state = script.indented_states(
        draw.probe,
        script.sample_of("dmt-viscous", draw.probe, [draw.truth]),
        amplitude=[draw.truth["A1"]],
        indentation=[draw.truth["indentation"]],
        n_max=script.N_MAX,
    )
    for n in range(4):
        f = complex(force["F_cons"].sel(harmonic=n)[0], -force["F_diss"].sel(harmonic=n)[0])
        assert f == pytest.approx(complex(state.force[0, n]), rel=1e-9, abs=0)
    tangent = draw.truth["viscosity"] / script.loss_of("dmt-viscous", draw.probe, draw.truth["modulus"], 1.0)
    assert tangent == pytest.approx(draw.truth["loss_tangent"], rel=1e-12, abs=0)


def test_the_page_is_the_one_of_the_table(script: ModuleType) -> None:
    rows = script.read_table(SCRIPT.parent / "posterior.csv")
    assert script.page(rows) == (SCRIPT.parent / "posterior.md").read_text(encoding="utf-8")
    draws = [row.draws for row in rows if row.number == "poor fit" and row.noise == script.ALL]
    assert min(draws) >= script.DRAWS
    assert len(draws) == len(script.MODELS) * len(script.RUNS)
