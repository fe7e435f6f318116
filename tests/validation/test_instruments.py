"""Some of the random instruments of docs/instruments.md: applied to simulated curves, learnt, removed."""

import importlib.util
import sys
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from scipy.stats import chi2

from overtone.instrument.photodiode import SplitDiode
from overtone.instrument.signals import signals_of

SCRIPT = Path(__file__).parents[2] / "docs" / "instruments.py"
NUMBERS = (2, 4, 10, 22, 1, 5, 7, 35)
"""Even ones are formulas, odd ones work in time. 4 and 5: a jump to a larger amplitude, 4 above the free one."""
OPEN = (4, 10, 5, 35)
"""Those that are calibrated without a frequency ladder, too."""


@pytest.fixture(scope="module")
def script() -> ModuleType:
    spec = importlib.util.spec_from_file_location("instruments_page", SCRIPT)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def outcomes(script: ModuleType) -> dict[tuple[int, str], Any]:
    found = {}
    for number in NUMBERS:
        fields = (script.LADDER, script.NONE) if number in OPEN else (script.LADDER,)
        found |= {(o.number, o.far_field): o for o in script.round_trip(number, fields)}
    return found


@pytest.mark.parametrize("number", NUMBERS)
def test_a_frequency_ladder_brings_a2_to_the_noise(
    number: int, script: ModuleType, outcomes: dict[tuple[int, str], Any]
) -> None:
    o = outcomes[number, script.LADDER]
    assert o.kind == (script.IN_TIME if number % 2 else script.ANALYTIC)
    assert o.before["a2"] > 5.0 * o.noise["a2"]  # there was something to remove
    assert o.residual["a2"] <= 2.0 * o.noise["a2"], script.told(o)
    assert (
        o.residual["a2"] > 0.7 * o.noise["a2"]
    )  # less than the noise that is in it would be a fault of the check


def test_errors_are_as_large_as_stated_with_and_without_a_ladder(
    script: ModuleType, outcomes: dict[tuple[int, str], Any]
) -> None:
    for far_field, numbers in ((script.LADDER, NUMBERS), (script.NONE, OPEN)):
        some = [outcomes[number, far_field] for number in numbers]
        # points of an instrument share its errors, so that each instrument counts as one number: 1 in 1000 above
        limit = chi2.isf(1e-3, len(some))
        for name in (*script.SIGNALS, *script.UNKNOWNS):
            assert sum(script.rms(o.off[name]) ** 2 for o in some) < limit, (far_field, name)


def test_without_a_ladder_the_calibration_knows_that_it_does_not_know(
    script: ModuleType, outcomes: dict[tuple[int, str], Any]
) -> None:
    for number in OPEN:
        with_ladder, without = (outcomes[number, f] for f in (script.LADDER, script.NONE))
        assert without.error["crosstalk2"] > 3.0 * with_ladder.error["crosstalk2"]
        assert any("frequency ladder" in sentence for sentence in without.findings)


@pytest.mark.parametrize("number", [2, 1])
def test_the_injected_noise_is_what_scatters(number: int, script: ModuleType) -> None:
    case = script.drawn(number)
    # a straight detector at rest: nothing but noise
    rest = replace(case.instrument, distortion={}, mean_slope_z=0.0)
    straight = SplitDiode(spot=1e-3) if case.diode is not None else None
    case = replace(case, instrument=rest, diode=straight, drift=0.0)
    free = script.free(np.full(400, case.probe.drive.free_amplitude + 0j))
    read = signals_of(script.measured(case, free, 0.0, np.zeros(400), stream=7))
    assert read.mean is not None
    scatter = {"A0": np.std(read.mean) / rest.gains[0]}
    for n in (2, 3):
        scatter[f"a{n}"] = np.std(read.phasor[n]) / np.sqrt(2.0) / rest.gains[n]
    assert scatter == pytest.approx(script.injected(case), rel=0.15, abs=0)  # 4 standard errors of A0


def test_what_the_detector_fakes_is_what_the_formula_says(script: ModuleType) -> None:
    case = script.drawn(2)
    raw, i, A = script.curve_data(case), case.instrument, case.probe.drive.free_amplitude
    time = np.interp(script.centre(raw), raw["z"].values[::-1], np.linspace(0.0, 60.0, 300)[::-1])
    moved = i.mean_slope_z * script.centre(raw) + case.drift * time
    # s + 2 kappa_2 s^2 + 4 kappa_3 s^3 of moved + A cos: its first harmonic at rest is A (1 + 3 kappa_3 A^2)
    added = (i.distortion[2] + 6.0 * i.distortion[3] * moved) * A**2 / (1.0 + 3.0 * i.distortion[3] * A**2)
    expected = added * i.gains[2] * np.exp(-1j * i.latency[2])
    assert script.faked(case, raw) == pytest.approx(expected, rel=1e-9, abs=0)


def test_the_table_is_the_one_of_the_page(script: ModuleType) -> None:
    page = (SCRIPT.parent / "instruments.md").read_text(encoding="utf-8")
    rows = script.read_table(SCRIPT.parent / "instruments.csv")
    for text in script.markdown(rows):
        assert text in page
    for kind in (script.ANALYTIC, script.IN_TIME):
        counted = {(row.far_field, row.name): row for row in rows if row.kind == kind}
        assert counted[script.LADDER, "a2"].instruments >= 100
        assert counted[script.LADDER, "a2"].within_2 == 1.0
