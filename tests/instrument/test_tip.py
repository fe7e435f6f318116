import numpy as np
import pytest
import xarray as xr

from overtone.contact.parameters import effective_modulus
from overtone.errors import ObservablesError, OvertoneError, ProbeError
from overtone.instrument.tip import tip_radius, tip_wear
from overtone.probe import Probe

PS = {"poisson_ratio": 0.35}


def probe(radius: float | None = 10e-9) -> Probe:
    return Probe.simple(stiffness=16.4, frequency=161.8e3, quality_factor=287.0, radius=radius,
                        drive_frequency=161.8e3, free_amplitude=94e-9)  # fmt: skip


def apparent(true: float, radius: float, assumed: float = 10e-9, nu: float = 0.35) -> float:
    """Modulus that a map with the assumed radius gives: the one with the same Lambda."""
    star = effective_modulus(true, nu) * np.sqrt(radius / assumed)
    return float((1 - nu**2) / (1 / star - (1 - 0.3**2) / 130e9))


def series(
    seed: int, *, lines: int = 128, alike: float = 0.0, spread: float = 0.05, growth: float = 0.0
) -> xr.DataArray:
    """Apparent modulus by line, neighbours alike, of a tip whose ln R grows."""
    rng = np.random.default_rng(seed)
    noise = np.empty(lines)
    noise[0] = rng.normal() / np.sqrt(1 - alike**2)
    for i in range(1, lines):
        noise[i] = alike * noise[i - 1] + rng.normal()
    radius = 10e-9 * np.exp(growth * np.linspace(0, 1, lines))
    modulus = [apparent(2e9, R) for R in radius]
    return xr.DataArray(modulus * np.exp(spread * noise), dims="y")


# --- the radius -----------------------------------------------------------------------------------


@pytest.mark.parametrize("true", [50e6, 2e9, 70e9])
@pytest.mark.parametrize("radius", [6e-9, 10e-9, 35e-9])
def test_the_radius_gives_the_reference_its_modulus(true: float, radius: float) -> None:
    found = tip_radius(apparent(true, radius), true, probe(), **PS)
    assert found.radius == pytest.approx(radius, rel=1e-9, abs=0)
    assert found.probe.tip.radius == found.radius
    assert found.assumed_radius == 10e-9
    assert (found.relative_error, found.lower) == (0.0, found.radius)


def test_another_poisson_ratio_of_the_reference_counts() -> None:
    # (1 - nu^2)/E alone enters, but for the tip
    found = tip_radius(2e9, 2e9, probe(), poisson_ratio=0.35, reference_poisson_ratio=0.5)
    assert found.radius == pytest.approx(
        10e-9 * (effective_modulus(2e9, 0.35) / effective_modulus(2e9, 0.5)) ** 2, rel=1e-12, abs=0
    )


@pytest.mark.parametrize("true", [2e9, 70e9])
def test_errors_are_those_of_draws(true: float) -> None:
    measured = apparent(true, 15e-9)
    found = tip_radius(measured, true, probe(), apparent_error=0.05, reference_error=0.03, **PS)
    rng = np.random.default_rng(0)
    draws = np.log([
        tip_radius(measured * np.exp(rng.normal(0, 0.05)), true * np.exp(rng.normal(0, 0.03)), probe(), **PS).radius
        for _ in range(3000)
    ])  # fmt: skip
    assert found.relative_error == pytest.approx(draws.std(), rel=0.06, abs=0)
    low, high = np.exp(np.quantile(draws, [0.05, 0.95]))
    assert (found.lower, found.upper) == (pytest.approx(low, rel=0.03), pytest.approx(high, rel=0.03))
    if true == 2e9:  # a soft sample: the tip does not give way, and ln R takes twice the error
        assert found.relative_error == pytest.approx(2 * np.hypot(0.05, 0.03), rel=0.05, abs=0)
    else:
        assert found.relative_error < 1.6 * np.hypot(0.05, 0.03)


def test_of_a_map_the_median_counts_and_the_lines_scatter() -> None:
    z = []
    for seed in range(200):
        rng = np.random.default_rng(1000 + seed)
        lines = series(seed, lines=64, alike=0.5, spread=0.1).values[:, None]
        values = lines * np.exp(rng.normal(0, 0.3, (64, 40)))
        values[rng.random(values.shape) < 0.5] = np.nan
        found = tip_radius(xr.DataArray(values, dims=("y", "x")), 2e9, probe(), **PS)
        z.append(np.log(found.radius / 10e-9) / found.relative_error)
    # counted by pixels the error would be a fifth of this
    assert 0.8 < np.std(z) < 1.25
    assert abs(np.mean(z)) < 0.25
    plain = tip_radius(np.array([1.9e9, 2.0e9, 2.1e9]), 2e9, probe(), **PS)
    assert plain.radius == pytest.approx(10e-9, rel=1e-9, abs=0)


def test_radii_that_cannot_be_had_are_refused() -> None:
    with pytest.raises(ProbeError, match="no tip radius"):
        tip_radius(2e9, 2e9, probe(None), **PS)
    with pytest.raises(ObservablesError, match="no apparent modulus"):
        tip_radius(np.full(5, np.nan), 2e9, probe(), **PS)
    with pytest.raises(ObservablesError, match="unphysical apparent"):
        tip_radius(-2e9, 2e9, probe(), **PS)
    with pytest.raises(ObservablesError, match="reference"):
        tip_radius(2e9, 0.0, probe(), **PS)
    with pytest.raises(OvertoneError, match="apparent_error"):
        tip_radius(2e9, 2e9, probe(), apparent_error=-0.1, **PS)


# --- wear -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("alike", [0.0, 0.5, 0.8])
def test_a_tip_that_does_not_wear_is_said_to_wear_one_time_in_ten(alike: float) -> None:
    found = [tip_wear(series(seed, alike=alike), probe(), first="top", **PS) for seed in range(300)]
    covered = np.mean([one.lower <= 0.0 <= one.upper for one in found])
    assert 0.85 <= covered <= 0.955
    assert np.mean([one.significant for one in found]) < 0.15
    assert np.mean([one.independent_lines for one in found]) == pytest.approx(
        128 * (1 - alike) / (1 + alike), rel=0.25, abs=0
    )


@pytest.mark.parametrize("alike", [0.0, 0.6])
def test_wear_is_found_as_large_as_it_was(alike: float) -> None:
    found = [
        tip_wear(series(seed, alike=alike, growth=0.3, spread=0.03), probe(), first="top", **PS)
        for seed in range(150)
    ]
    assert np.mean([one.change for one in found]) == pytest.approx(0.3, abs=0.012)
    assert 0.84 < np.mean([one.lower <= 0.3 <= one.upper for one in found]) < 0.96


def test_the_verdict_says_it_in_a_sentence() -> None:
    grown = series(0, growth=0.2, spread=0.01)
    worn = tip_wear(grown, probe(), first="top", **PS)
    assert worn.significant
    assert worn.verdict.startswith("the radius grew by 2")
    assert "% over the scan" in worn.verdict
    # the other way round it shrinks, which no wear does
    assert "no wear does" in tip_wear(grown, probe(), first="bottom", **PS).verdict
    assert tip_wear(series(1, spread=0.01), probe(), first="top", **PS).verdict.startswith("no wear beyond ")
    alike = tip_wear(series(2, lines=16, alike=0.97), probe(), first="top", **PS)
    assert not alike.significant
    assert "cannot be told" in alike.verdict


def test_over_time_and_with_pixels_missing_it_is_the_same() -> None:
    lines = series(3, growth=0.2, spread=0.01)
    by_line = tip_wear(lines, probe(), first="top", **PS)
    over_time = lines.rename(y="time").assign_coords(time=np.linspace(0.0, 512.0, 128))
    assert tip_wear(over_time, probe(), **PS).change == pytest.approx(by_line.change, rel=1e-9, abs=0)
    spread = lines.expand_dims(x=30).transpose("y", "x").copy()
    spread.values[:, ::3] = np.nan
    spread.values[17] = np.nan
    spread.values[40, 1] = 1e12  # one wild pixel moves no median
    found = tip_wear(spread, probe(), first="top", **PS)
    assert found.lines == 127
    assert found.change == pytest.approx(by_line.change, abs=0.01)


def test_scans_that_cannot_tell_are_refused() -> None:
    with pytest.raises(ObservablesError, match="scanned first"):
        tip_wear(series(0), probe(), **PS)
    with pytest.raises(ObservablesError, match="too few lines"):
        tip_wear(series(0, lines=8), probe(), first="top", **PS)
    with pytest.raises(ObservablesError, match="slow axis"):
        tip_wear(series(0).rename(y="x"), probe(), first="top", **PS)
    with pytest.raises(ObservablesError, match="no apparent modulus"):
        tip_wear(series(0) * np.nan, probe(), first="top", **PS)
