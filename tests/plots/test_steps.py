"""Colours that show no more than intervals support: steps, their edges, and when there are none."""

import numpy as np
import pytest
from matplotlib.colors import LogNorm

from overtone.plots.scales import Scale
from overtone.plots.steps import beyond, interval_scale

WIDTH = 2.0 * 1.645  # of a 90 % interval in standard deviations


def scale_for(median: np.ndarray, sigma: float, veil: np.ndarray | None = None, **options) -> Scale | None:
    half = np.exp(0.5 * WIDTH * sigma)
    veil = np.zeros(median.shape, bool) if veil is None else veil
    return interval_scale("modulus", "Pa", median, median / half, median * half, veil, **options)


def colours_of(scale: Scale, values: np.ndarray) -> np.ndarray:
    """Return the number of the step of each SI value, told from its colour."""
    drawn = scale.colours(scale.norm(np.clip(values * scale.factor, *scale.limits)))
    steps = scale.colours(scale.norm(np.sqrt(np.multiply(scale.edges[1:], scale.edges[:-1]))))
    return np.abs(drawn[:, None, :] - steps[None]).sum(axis=-1).argmin(axis=-1)


def materials(sigma: float, *moduli: float, shared: float = 0.0, count: int = 2000) -> np.ndarray:
    rng = np.random.default_rng(0)
    return np.concatenate([E * np.exp(rng.normal(0.0, sigma, count)) for E in moduli])


@pytest.mark.parametrize("sigma", [0.05, 0.15, 0.4])
def test_every_step_is_as_wide_as_the_typical_interval(sigma):
    scale = scale_for(materials(sigma, 1e8, 2e9), sigma)
    assert scale is not None
    assert isinstance(scale.norm, LogNorm)
    widths = np.diff(np.log(scale.edges)) / (WIDTH * sigma)
    assert widths.min() >= 1.0 - 1e-6
    assert widths.max() <= 1.5 + 1e-6
    assert scale.step == f"× {np.exp(WIDTH * sigma):.2g}"


def test_half_the_interval_makes_twice_the_colours():
    coarse, fine = (scale_for(np.geomspace(1e6, 1e10, 5000), sigma) for sigma in (0.2, 0.1))
    assert coarse is not None
    assert fine is not None
    assert (len(fine.edges) - 1) / (len(coarse.edges) - 1) == pytest.approx(2.0, rel=0.15)


def test_colours_change_at_the_edges_and_nowhere_else():
    scale = scale_for(materials(0.2, 1e8, 2e9), 0.2)
    assert scale is not None
    inner = np.array(scale.edges[1:-1]) / scale.factor
    below, above = colours_of(scale, inner * 0.999), colours_of(scale, inner * 1.001)
    np.testing.assert_array_equal(below, np.arange(inner.size))
    np.testing.assert_array_equal(above, np.arange(inner.size) + 1)
    within = np.geomspace(inner[0] * 1.001, inner[1] * 0.999, 50)
    assert np.unique(colours_of(scale, within)).size == 1


@pytest.mark.parametrize("sigma", [0.1, 0.25, 0.5])
def test_the_scatter_of_one_material_shows_no_contrast(sigma):
    median = materials(sigma, 1.3e9)
    scale = scale_for(median, sigma)
    assert scale is not None
    assert len(scale.edges) - 1 >= 2
    most = np.bincount(colours_of(scale, median)).max()
    assert most > 0.97 * median.size


@pytest.mark.parametrize("ratio", [5.0, 7.3, 12.0, 20.0, 31.0])
def test_two_materials_get_two_colours_without_speckle(ratio):
    median = materials(0.2, 1e8, 1e8 * ratio)
    scale = scale_for(median, 0.2)
    assert scale is not None
    seen = colours_of(scale, median).reshape(2, -1)
    main = [np.bincount(row).argmax() for row in seen]
    assert main[0] != main[1]
    for row, colour in zip(seen, main, strict=True):
        assert (row == colour).mean() > 0.95


def test_a_contrast_within_the_interval_is_not_shown():
    median = materials(0.3, 1e9, 1.25e9)
    scale = scale_for(median, 0.3)
    assert scale is not None
    seen = colours_of(scale, median).reshape(2, -1)
    assert np.bincount(seen[0]).argmax() == np.bincount(seen[1]).argmax()


@pytest.mark.parametrize(("sigma", "stepped"), [(0.004, False), (0.03, True)])
def test_narrow_intervals_leave_the_scale_continuous(sigma, stepped):
    scale = scale_for(np.geomspace(1e8, 3e9, 4000), sigma)  # 2 % of it are a factor of 1.07
    assert scale is not None
    assert bool(scale.edges) is stepped
    assert (scale.step != "") is stepped


def test_what_is_not_determined_sets_neither_limits_nor_steps():
    median = materials(0.1, 1e9)
    open_ones = np.geomspace(1e3, 1e15, 500)
    half = np.exp(0.5 * WIDTH * np.concatenate([np.full(median.size, 0.1), np.full(500, 5.0)]))
    every = np.concatenate([median, open_ones])
    veil = np.arange(every.size) >= median.size
    scale = interval_scale("modulus", "Pa", every, every / half, every * half, veil)
    alone = scale_for(median, 0.1)
    assert scale is not None
    assert alone is not None
    assert scale.edges == alone.edges


def test_nothing_determined_has_no_scale():
    median = materials(0.1, 1e9)
    assert scale_for(median, 0.1, np.ones(median.shape, bool)) is None
    assert scale_for(np.full(5, np.nan), 0.1) is None


def test_values_that_reach_zero_get_linear_steps_in_their_unit():
    rng = np.random.default_rng(1)
    median = rng.uniform(0.0, 10e-9, 3000)
    none = np.zeros(median.shape, bool)
    scale = interval_scale("indentation", "m", median, median - 1e-9, median + 1e-9, none)
    assert scale is not None
    assert not scale.logarithmic
    assert scale.step == "2 nm"
    assert np.diff(scale.edges).min() >= 2.0 - 1e-9
    assert np.diff(scale.edges).max() <= 3.0 + 1e-9


def test_limits_follow_wide_intervals_for_a_decade_only():
    median = materials(0.02, 1e9)
    ends = median / 1e5, median * 1e5
    scale = interval_scale("modulus", "Pa", median, *ends, np.zeros(median.shape, bool))
    assert scale is not None
    low, high = np.array(scale.limits) / scale.factor
    assert low <= 1e8
    assert high >= 1e10
    assert len(scale.edges) == 4  # one colour holds all medians, and one on either side


def test_given_limits_are_covered():
    scale = scale_for(materials(0.2, 1e9), 0.2, within=(1e7, 1e10))
    assert scale is not None
    low, high = np.array(scale.limits) / scale.factor
    assert low <= 1e7
    assert high >= 1e10


def test_values_beyond_are_told():
    scale = scale_for(materials(0.2, 1e9), 0.2)
    assert scale is not None
    assert beyond(scale, np.array([1e9, np.nan])).beyond == (False, False)
    assert beyond(scale, np.array([1e9]), np.array([1e14])).beyond == (False, True)
    assert beyond(scale, np.array([1e3])).beyond == (True, False)


def test_no_colour_is_made_up_between_two_materials_of_a_large_map(a_map, drawn):
    values = np.where(np.arange(300) % 2 == 0, 1e8, 1e10) * np.ones((300, 1))
    scale = interval_scale("modulus", "Pa", values, values / 1.3, values * 1.3, np.zeros(values.shape, bool))
    assert drawn(a_map("modulus", values), scale=scale).images[0].get_interpolation() == "nearest"
    assert drawn(a_map("modulus", values)).images[0].get_interpolation() == "antialiased"
