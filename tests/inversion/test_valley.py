"""The linear problem of a pixel at one indentation, against least squares of numpy and scipy."""

import math

import numpy as np
import pytest
from scipy.optimize import lsq_linear, nnls

from overtone.contact.models import contact_model
from overtone.inversion.columns import Columns, columns_of
from overtone.inversion.table import table_of
from overtone.inversion.valley import (
    Box,
    best_F,
    best_S,
    chi2_at,
    edge_of_S,
    exact_columns,
    new_scratch,
    physical,
    reduce,
    set_data,
    set_places,
    solved,
    tabulated_columns,
    whiten,
)
from overtone.kernels import kernel
from overtone.probe import Probe

FREE = Box(-math.inf, math.inf, -math.inf, math.inf)


@kernel
def everything(a, b, v, y, sticky, loss, box, target, S_asked, out):  # type: ignore[no-untyped-def]
    """Fill out with all that the module says of a whitened problem."""
    s = new_scratch(y.shape[0], 3, 0)
    s.wa[:], s.wb[:], s.wv[:], s.wy[:] = a, b, v, y
    m = reduce(s, sticky, loss)
    out[0], out[1], out[2] = m.rest, m.S, m.F0 + m.F1 * m.S
    out[3] = m.c0 + m.c1 * m.S + m.c2 * out[2]
    out[4] = chi2_at(m, S_asked, box)
    out[5] = best_S(m, box)
    out[6] = chi2_at(m, out[5], box)
    out[7] = best_F(m, out[5], box)
    out[8] = edge_of_S(m, box, out[6] + target, -1.0)
    out[9] = edge_of_S(m, box, out[6] + target, 1.0)
    out[10] = chi2_at(m, out[8], box)
    out[11] = chi2_at(m, out[9], box)
    out[12] = 1.0 if physical(m) else 0.0
    chi2, m, S = solved(m, s, sticky, box)
    out[13], out[14], out[15] = chi2, S, best_F(m, S, box)
    out[16] = m.c0 + m.c1 * S + m.c2 * out[15]


class Answer:
    """Names for what the kernel filled."""

    def __init__(self, out: np.ndarray) -> None:
        self.rest, self.S, self.F, self.c, self.at_S, self.best_S, self.least, self.best_F = out[:8]
        self.edges, self.at_edges = out[8:10], out[10:12]
        self.physical = bool(out[12])
        self.solved, self.solved_S, self.solved_F, self.solved_c = out[13:17]


def answer(
    problem: tuple[np.ndarray, ...],
    sticky: bool,
    loss: bool,
    box: Box = FREE,
    target: float = 1.0,
    S_asked: float = 1.0,
) -> Answer:
    out = np.empty(17)
    everything(*problem, sticky, loss, Box(*map(float, box)), target, S_asked, out)
    return Answer(out)


def problems(count: int, rows: int, seed: int) -> list[tuple[np.ndarray, ...]]:
    """Return random columns a, b, v and data; b is nearly the opposite of a, as in deep contact."""
    random = np.random.default_rng(seed)
    found = []
    for k in range(count):
        a = random.normal(size=rows) * 10.0 ** random.uniform(-2, 2)
        apart = 10.0 ** random.uniform(-2.5, 0.5)
        b = -a * random.uniform(0.5, 2.0) + apart * np.linalg.norm(a) * random.normal(size=rows)
        v = random.normal(size=rows)
        S, F, c = random.uniform(-0.5, 2.0, 3)
        y = S * a + F * b + (c * v if k % 2 else 0.0) + random.normal(size=rows)
        found.append((a, b, v, y))
    return found


def matrix(problem: tuple[np.ndarray, ...], sticky: bool, loss: bool) -> np.ndarray:
    a, b, v, _ = problem
    return np.stack([a, *([b] if sticky else []), *([v] if loss else [])], axis=1)


CASES = [(False, False), (True, False), (False, True), (True, True)]


@pytest.mark.parametrize(("sticky", "loss"), CASES)
@pytest.mark.parametrize("rows", [3, 4, 6])
def test_without_bounds_it_is_least_squares(rows: int, sticky: bool, loss: bool) -> None:
    for problem in problems(100, rows, seed=rows):
        M, y = matrix(problem, sticky, loss), problem[3]
        x = np.linalg.lstsq(M, y, rcond=None)[0]
        got = answer(problem, sticky, loss)
        mine = [got.S, *([got.F] if sticky else []), *([got.c] if loss else [])]
        np.testing.assert_allclose(mine, x, rtol=1e-7, atol=1e-9 * np.abs(x).max())
        assert got.rest == pytest.approx(float(((y - M @ x) ** 2).sum()), rel=1e-8, abs=1e-12 * float(y @ y))
        assert got.F == 0.0 or sticky
        assert got.c == 0.0 or loss
        assert got.physical == bool((x[0] > 0.0) and (x[1:] >= 0.0).all())


@pytest.mark.parametrize(("sticky", "loss"), CASES)
def test_within_bounds_it_is_bounded_least_squares(sticky: bool, loss: bool) -> None:
    random = np.random.default_rng(11)
    held = 0
    for problem in problems(300, 5, seed=12):
        y = problem[3]
        M = matrix(problem, sticky, loss)
        low, high = np.sort(random.uniform(0.0, 2.0, (2, 2)), axis=0)
        box = Box(low[0], high[0], low[1], high[1])
        lower = [low[0], *([low[1]] if sticky else [])]
        upper = [high[0], *([high[1]] if sticky else [])]
        for least_c in (-np.inf, 0.0) if loss else (None,):
            bounds = (lower, upper)
            if least_c is not None:
                bounds = ([*lower, least_c], [*upper, np.inf])
            want = lsq_linear(M, y, bounds=bounds, method="bvls", tol=1e-14)
            got = answer(problem, sticky, loss, box)
            value, S, F = got.least, got.best_S, got.best_F
            if least_c == 0.0 or not loss:
                value, S, F = got.solved, got.solved_S, got.solved_F
                assert got.solved_c >= 0.0
            assert value == pytest.approx(2.0 * want.cost, rel=1e-9)
            scale = np.abs(want.x).max()
            assert pytest.approx(want.x[0], rel=1e-6, abs=1e-7 * scale) == S
            assert box.softest <= S <= box.stiffest
            if sticky:
                assert pytest.approx(want.x[1], rel=1e-6, abs=1e-6 * scale) == F
                assert box.weakest <= F <= box.strongest
            held += bool((want.active_mask != 0).any())
    assert held > 100


@pytest.mark.parametrize(("sticky", "loss"), CASES)
def test_no_sign_but_plus_is_nonnegative_least_squares(sticky: bool, loss: bool) -> None:
    for problem in problems(200, 4, seed=21):
        x, norm = nnls(matrix(problem, sticky, loss), problem[3])
        got = answer(problem, sticky, loss, Box(0.0, math.inf, 0.0, math.inf))
        assert got.solved == pytest.approx(norm**2, rel=1e-9)
        assert got.solved_S == pytest.approx(x[0], rel=1e-6, abs=1e-7 * x.max())


@pytest.mark.parametrize("loss", [False, True])
def test_chi_squared_at_a_given_S(loss: bool) -> None:
    """The other two at their best: adhesion within bounds, the loss of any sign."""
    random = np.random.default_rng(31)
    for problem in problems(150, 5, seed=32):
        a, _, _, y = problem
        low, high = np.sort(random.uniform(0.0, 1.5, 2))
        S = random.uniform(0.0, 2.0)
        M = matrix(problem, True, loss)[:, 1:]
        bounds = ([low, *([-np.inf] * loss)], [high, *([np.inf] * loss)])
        want = 2.0 * lsq_linear(M, y - S * a, bounds=bounds, method="bvls", tol=1e-14).cost
        got = answer(problem, True, loss, Box(0.0, 5.0, low, high), S_asked=S)
        assert got.at_S == pytest.approx(want, rel=1e-9)


@pytest.mark.parametrize(("sticky", "loss"), CASES)
def test_edges_reach_the_target(sticky: bool, loss: bool) -> None:
    """Both, whether or not a bound of the adhesion holds at the best S, at the edge, or at both edges."""
    random = np.random.default_rng(41)
    for problem in problems(300, 5, seed=42):
        low, high = np.sort(random.uniform(-0.2, 1.5, 2))
        target = 10.0 ** random.uniform(-1, 2)
        got = answer(problem, sticky, loss, Box(-math.inf, math.inf, low, high), target=target)
        np.testing.assert_allclose(got.at_edges, got.least + target, rtol=1e-8)
        assert got.edges[0] < got.best_S < got.edges[1]


def test_a_column_that_vanishes_is_left_out() -> None:
    a, b, v, y = problems(1, 4, seed=51)[0]
    none = np.zeros(4)
    without = answer((a, none, none, y), True, True)
    assert (without.S, without.rest, without.F, without.c) == pytest.approx(
        (float(a @ y) / float(a @ a), float(y @ y) - float(a @ y) ** 2 / float(a @ a), 0.0, 0.0), rel=1e-9
    )
    nothing = answer((none, b, v, y), False, False)
    assert (nothing.S, nothing.rest) == (0.0, pytest.approx(float(y @ y)))


@kernel
def polynomial(low, high, shifts, first, t, out):  # type: ignore[no-untyped-def]
    s = new_scratch(first.shape[0], 3, shifts.shape[0])
    set_places(s, low, high)
    s.first[:] = first
    s.shifts[:] = shifts
    for i in range(t.shape[0]):
        set_data(s, t[i])
        out[i] = s.wy


@kernel
def places_of(count, low, high, out):  # type: ignore[no-untyped-def]
    s = new_scratch(1, 3, count)
    set_places(s, low, high)
    out[:] = s.places


@pytest.mark.parametrize("count", [3, 4, 5])
def test_what_the_motion_adds_is_interpolated_by_a_polynomial(count: int) -> None:
    """One through every place is met everywhere between them, and goes on level beyond."""
    places, first = np.empty(count), np.array([1.0, -2.0])
    places_of(count, -6.0, -1.5, places)
    assert (np.diff(places) > 0.0).all()
    assert places[0] > -6.0
    assert places[-1] < -1.5
    parts = np.random.default_rng(61).normal(size=(2, count))
    shifts = np.stack([np.polyval(part, places) for part in parts], axis=1)
    t = np.concatenate([np.linspace(places[0], places[-1], 41), places, [-9.0, 2.0]])
    out = np.empty((t.size, 2))
    polynomial(-6.0, -1.5, shifts, first, t, out)
    inside = np.clip(t, places[0], places[-1])
    want = first - np.stack([np.polyval(part, inside) for part in parts], axis=1)
    np.testing.assert_allclose(out, want, rtol=1e-10, atol=1e-10 * np.abs(shifts).max())


def test_no_places_leave_the_data_alone() -> None:
    out = np.empty((1, 2))
    polynomial(0.0, 1.0, np.empty((0, 2)), np.array([3.0, -1.0]), np.array([0.3]), out)
    np.testing.assert_array_equal(out, [[3.0, -1.0]])


@kernel
def both_ways(columns, table, amplitude, t, orders, lossy, W, y, exactly, out):  # type: ignore[no-untyped-def]
    s = new_scratch(orders.shape[0], 3, 0)
    whiten(W, y, s.first)
    if exactly:
        out[3, 0] = exact_columns(columns, amplitude, t, orders, lossy, W, s)
    else:
        scale = amplitude**table.power
        out[3, 0] = tabulated_columns(table, 0, 0.0, scale, t, orders, lossy, W, s)
    out[0], out[1], out[2] = s.wa, s.wb, s.wv
    out[4] = s.wy


def viscous_columns() -> Columns:
    probe = Probe.simple(
        stiffness=16.4,
        frequency=161.8e3,
        quality_factor=287.0,
        radius=10e-9,
        drive_frequency=161.8e3,
        free_amplitude=94e-9,
    )
    return columns_of(contact_model("dmt-viscous"), probe, {"poisson_ratio": 0.3})


def test_whitened_columns_of_rows() -> None:
    """Conservative rows know a and b, dissipative ones -n a alone; all of them times the lower triangle."""
    columns = viscous_columns()
    amplitude = math.exp(-8500 / 500.0)  # at a step of the table
    table = table_of(columns, np.array([amplitude * 1.00001]), 3)
    orders, lossy = np.array([0, 1, 2, 1, 2]), np.array([False, False, False, True, True])
    random = np.random.default_rng(71)
    W, y = np.tril(random.normal(size=(5, 5))), random.normal(size=5)
    from overtone.contact.terms import VAN_DER_WAALS_TAIL, adhesion_harmonics, sphere_harmonics

    for t in (-7.3, -2.1, 0.4):
        Delta = 1.0 / (1.0 + math.exp(-t))
        a, b, spare = np.empty(4), np.empty(4), np.empty(4)
        sphere_harmonics(amplitude, Delta, 3, a, spare)
        adhesion_harmonics(VAN_DER_WAALS_TAIL, amplitude, Delta, 0.2e-9, 3, b, spare)
        want = np.zeros((5, 5))
        want[0] = W @ np.where(lossy, 0.0, a[orders])
        want[1] = W @ np.where(lossy, 0.0, b[orders])
        want[2] = W @ np.where(lossy, -orders * a[orders], 0.0)
        want[4] = W @ y
        for exactly, accuracy in ((True, 1e-11), (False, 2e-6)):
            out = np.zeros((5, 5))
            both_ways(columns, table, amplitude, t, orders, lossy, W, y, exactly, out)
            assert out[3, 0] == pytest.approx(Delta, rel=1e-14)
            for row in (0, 1, 2, 4):
                np.testing.assert_allclose(out[row], want[row], atol=accuracy * np.abs(want[row]).max())
