"""Algebra in place against NumPy's."""

import numpy as np
import pytest

from overtone.kernels import kernel
from overtone.population import algebra


@kernel
def factored(H):  # type: ignore[no-untyped-def]
    return algebra.cholesky(H)


@kernel
def solved(L, b, out):  # type: ignore[no-untyped-def]
    algebra.solve_factored(L, b, out)


@kernel
def length_of(L, step):  # type: ignore[no-untyped-def]
    return algebra.squared_length(L, step)


@kernel
def half_square_of(P, y, centre):  # type: ignore[no-untyped-def]
    return algebra.half_square(P, y, centre)


@kernel
def eliminated(A, b):  # type: ignore[no-untyped-def]
    return algebra.eliminate(A, b)


@kernel
def scaled(A, scale):  # type: ignore[no-untyped-def]
    return algebra.in_units(A, scale)


def positive(rng: np.random.Generator, n: int) -> np.ndarray:
    A = rng.standard_normal((n, n)) * 10.0 ** rng.uniform(-3, 3, n)[:, None]
    return np.asarray(A @ A.T)


@pytest.mark.parametrize("n", [1, 2, 5, 12])
def test_factor_solution_and_length(n: int) -> None:
    rng = np.random.default_rng(n)
    H, b, out = positive(rng, n), rng.standard_normal(n), np.empty(n)
    L = H.copy()
    assert factored(L)
    np.testing.assert_allclose(L, np.linalg.cholesky(H), rtol=1e-7, atol=1e-12 * np.abs(L).max())
    size = np.sqrt(np.diag(H))
    solved(L, b * size, out)
    np.testing.assert_allclose(H @ out / size, b, rtol=1e-6, atol=1e-6)
    assert length_of(L, b) == pytest.approx(b @ H @ b, rel=1e-9, abs=0)


def test_what_is_not_positive_has_no_factor() -> None:
    assert not factored(np.array([[1.0, 2.0], [2.0, 1.0]]))
    assert not factored(np.array([[1.0, np.nan], [np.nan, 1.0]]))


@pytest.mark.parametrize("n", [1, 2, 5, 12])
def test_elimination(n: int) -> None:
    """Rows have to change places: the first member is nothing."""
    rng = np.random.default_rng(n)
    A, b = rng.standard_normal((n, n)), rng.standard_normal(n)
    A[0, 0] = 0.0 if n > 1 else A[0, 0]
    work, x = A.copy(), b.copy()
    log_det = eliminated(work, x)
    assert log_det == pytest.approx(np.linalg.slogdet(A)[1], rel=1e-9)
    np.testing.assert_allclose(x, np.linalg.solve(A, b), rtol=1e-7)


def test_a_singular_matrix_is_told() -> None:
    assert eliminated(np.zeros((2, 2)), np.ones(2)) == -np.inf


def test_units_leave_the_determinant() -> None:
    rng = np.random.default_rng(7)
    A = positive(rng, 5)
    scale = np.sqrt(np.diag(A))
    work = A.copy()
    added = scaled(work, scale)
    np.testing.assert_allclose(np.diag(work), 1.0)
    assert np.linalg.slogdet(work)[1] + added == pytest.approx(np.linalg.slogdet(A)[1], rel=1e-9)


def test_half_of_a_square_is_that_of_the_matrix():
    random = np.random.default_rng(11)
    root, y, centre = random.standard_normal((4, 4)), random.standard_normal(4), random.standard_normal(4)
    P = root @ root.T
    want = 0.5 * (y - centre) @ P @ (y - centre)
    assert half_square_of(P, y, centre) == pytest.approx(want, rel=1e-12, abs=0)
