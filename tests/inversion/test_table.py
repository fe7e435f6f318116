"""Tabulated columns: as good as stated wherever they are asked for, and nothing where the table does not reach."""

import math

import numpy as np
import pytest

from overtone.contact.models import contact_model
from overtone.inversion.columns import WORK_ROWS, Columns, columns_of, fill_columns
from overtone.inversion.table import DEEPEST, NODES, SHALLOWEST, STEP, interpolate_block, table_of
from overtone.probe import Probe

PROBE = Probe.simple(
    stiffness=16.4,
    frequency=161.8e3,
    quality_factor=287.0,
    radius=10e-9,
    drive_frequency=161.8e3,
    free_amplitude=94e-9,
)
GIVEN = {"poisson_ratio": 0.3, "half_angle": 0.35, "thickness": 300e-9, "exponent": 1.2}
ORDERS = np.array([0, 1, 2, 3, 2])


def columns(model: str) -> Columns:
    record = contact_model(model)
    return columns_of(record, PROBE, {q.name: GIVEN[q.name] for q in record.given if q.name in GIVEN})


def by_the_table(
    of: Columns, t: np.ndarray, amplitude: np.ndarray, others: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    table = table_of(of, amplitude if others is None else others, 3)
    a, b = (np.empty((t.size, ORDERS.size)) for _ in range(2))
    interpolate_block(table, amplitude, t, ORDERS, a, b)
    return a, b


def by_closed_forms(of: Columns, t: np.ndarray, amplitude: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    a, b = (np.empty((t.size, ORDERS.size)) for _ in range(2))
    work = np.empty((WORK_ROWS, 4))
    for i in range(t.size):
        fill_columns(of, amplitude[i], 1.0 / (1.0 + math.exp(-t[i])), 3, work)
        a[i], b[i] = work[0, ORDERS], work[2, ORDERS]
    return a, b


@pytest.mark.parametrize(
    "model", ["hertz", "dmt-contact", "dmt-linear", "dmt", "cone", "power", "kelvin-voigt-adhesion"]
)
def test_interpolation_is_as_good_as_stated(model: str) -> None:
    """1e-6 of the largest harmonic at that depth from the polynomials, 1e-6 more from the amplitude."""
    of = columns(model)
    random = np.random.default_rng(3)
    t = random.uniform(SHALLOWEST, DEEPEST, 3000)
    amplitude = random.choice(np.exp(random.uniform(math.log(8e-9), math.log(120e-9), 60)), t.size)
    # the linear tail has an end; a motion that never comes so far up is left to the next test
    within = (model != "dmt-linear") | (2.0 * amplitude / (1.0 + np.exp(t)) > 1e-9)
    t, amplitude = t[within], amplitude[within]
    got, want = by_the_table(of, t, amplitude), by_closed_forms(of, t, amplitude)
    for ours, exact in zip(got, want, strict=True):
        size = np.abs(exact).max(axis=1, keepdims=True)
        assert (np.abs(ours - exact) <= 2e-6 * size).all()


def test_a_motion_within_the_linear_tail_is_interpolated_less_well() -> None:
    """The column bends where the upper turning point passes the end of the tail, 0.4 nm: Delta above 0.97."""
    of = columns("dmt-linear")
    random = np.random.default_rng(5)
    t, amplitude = random.uniform(2.0, DEEPEST, 2000), np.repeat([8e-9, 20e-9, 45e-9, 110e-9], 500)
    got, want = by_the_table(of, t, amplitude)[1], by_closed_forms(of, t, amplitude)[1]
    size = np.abs(want).max(axis=1, keepdims=True)
    assert (np.abs(got - want) <= 5e-4 * size).all()


def test_interpolation_of_a_layer_is_as_good() -> None:
    """Of several powers; the series itself ends long before the tip is half way through."""
    of = columns("thin-layer")
    random = np.random.default_rng(4)
    t, amplitude = random.uniform(SHALLOWEST, 0.0, 500), np.repeat(random.uniform(10e-9, 60e-9, 10), 50)
    got, want = by_the_table(of, t, amplitude)[0], by_closed_forms(of, t, amplitude)[0]
    np.testing.assert_allclose(got / want, 1.0, atol=4e-6)


def test_nodes_are_met_exactly() -> None:
    of = columns("dmt")
    t = SHALLOWEST + STEP * np.arange(NODES)
    amplitude = np.full(NODES, math.exp(-8500 / 500.0))
    got, want = by_the_table(of, t, amplitude), by_closed_forms(of, t, amplitude)
    np.testing.assert_allclose(got[0], want[0], rtol=1e-9)
    np.testing.assert_allclose(got[1], want[1], rtol=1e-9)


def test_no_pixel_depends_on_its_neighbours() -> None:
    of = columns("dmt")
    t = np.linspace(-9.0, 3.0, 50)
    amplitude = np.full(50, 41.3e-9)
    alone = by_the_table(of, t, amplitude)
    for others in (np.array([41.3e-9, 3e-9]), np.geomspace(20e-9, 90e-9, 777), np.array([41.3e-9, 41.35e-9])):
        among = by_the_table(of, t, amplitude, np.append(others, 41.3e-9))
        np.testing.assert_array_equal(among[0], alone[0])
        np.testing.assert_array_equal(among[1], alone[1])


def test_out_of_range_is_not_a_number() -> None:
    of = columns("dmt")
    amplitude = np.array([39e-9, 40e-9, 41e-9, math.nan, 0.0, -1e-9, math.inf])
    table = table_of(of, np.array([40e-9]), 3)
    a, b = np.zeros((7, 5)), np.zeros((7, 5))
    interpolate_block(table, amplitude, np.zeros(7), ORDERS, a, b)
    known = np.array([False, True, False, False, False, False, False])
    np.testing.assert_array_equal(np.isfinite(a).all(axis=1), known)
    np.testing.assert_array_equal(np.isnan(a).all(axis=1), ~known)
    np.testing.assert_array_equal(np.isnan(b).all(axis=1), ~known)


@pytest.mark.parametrize("odd", [1e-15, 1e-3])
def test_absurd_amplitudes_cost_neither_memory_nor_their_neighbours(odd: float) -> None:
    """A dead pixel of 1e-15 m or a saturated one of 1 mm beside an ordinary scan."""
    of = columns("dmt")
    amplitude, t = np.array([40e-9, 41e-9]), np.array([-3.0, -2.0])
    alone = by_the_table(of, t, amplitude)
    others = np.array([40e-9, 41e-9, odd, math.nan, 0.0])
    assert table_of(of, others, 3).elastic.shape[0] < 10
    among = by_the_table(of, t, amplitude, others)
    np.testing.assert_array_equal(among[0], alone[0])
    np.testing.assert_array_equal(among[1], alone[1])


def test_no_amplitude_at_all_makes_a_table_too() -> None:
    assert table_of(columns("hertz"), np.array([math.nan, 0.0]), 3).elastic.shape[0] >= 1
