"""A parabola through three nodes of the valley, for a first look."""

import math

import numpy as np
import pytest

from overtone.inversion.stretches import STRIDE, _vertex
from overtone.inversion.table import SHALLOWEST, STEP
from overtone.kernels import kernel

WIDTH = STEP * STRIDE


@kernel
def vertex(bounded, k, low, high):  # type: ignore[no-untyped-def]
    return _vertex(bounded, k, low, high)


def nodes(at: float, bend: float, least: float) -> np.ndarray:
    t = SHALLOWEST + WIDTH * np.arange(20)
    return np.asarray(least + bend * (t - at) ** 2)


@pytest.mark.parametrize("away", [-0.45, -0.2, 0.0, 0.3])
def test_a_parabola_is_met(away: float) -> None:
    at = SHALLOWEST + WIDTH * (7 + away)
    t, value = vertex(nodes(at, 3.0, 2.0), 7, -math.inf, math.inf)
    assert t == pytest.approx(at, abs=1e-9)
    assert value == pytest.approx(2.0, abs=1e-9)


def test_a_bound_holds_it_and_its_value_is_that_at_the_bound() -> None:
    at = SHALLOWEST + WIDTH * 7.3
    t, value = vertex(nodes(at, 3.0, 2.0), 7, -math.inf, at - 0.1)
    assert t == pytest.approx(at - 0.1, abs=1e-9)
    assert value == pytest.approx(2.0 + 3.0 * 0.01, abs=1e-9)


def test_never_beyond_half_a_node_nor_below_nothing() -> None:
    # the neighbour that the prior excludes is lower
    bounded = np.array([9.0, 0.0, 1.0, 4.0, 9.0])
    t, value = vertex(bounded, 2, SHALLOWEST, math.inf)
    assert t == pytest.approx(SHALLOWEST + 1.5 * WIDTH)
    assert 0.0 <= value < 1.0
    t, value = vertex(np.array([10.0, 1.0, 0.5, 0.1]), 3, -math.inf, math.inf)
    assert (t, value) == (SHALLOWEST + 3.0 * WIDTH, 0.1)


def test_what_does_not_bend_is_the_node() -> None:
    t, value = vertex(np.array([1.0, 1.0, 1.0]), 1, -math.inf, math.inf)
    assert (t, value) == (SHALLOWEST + WIDTH, 1.0)
