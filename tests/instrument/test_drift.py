"""Drift along the slow axis: is the walk found again, and are its errors what they say?"""

import numpy as np
import pytest

from overtone.instrument.drift import _evidence, _smoothed, smooth_lines

LINES, PIXELS = 80, 60
ALONE = 1.2533 / np.sqrt(PIXELS)  # error of the median of a line, in units of the noise of a pixel


def walked(step: float, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return a walk, pixels that scatter by 1 about it, and which of them count: not all lines have some."""
    generator = np.random.default_rng(seed)
    drift = np.cumsum(generator.normal(0.0, step, LINES))
    values = drift[:, None] + generator.normal(0.0, 1.0, (LINES, PIXELS))
    usable = np.ones((LINES, PIXELS), bool)
    usable[30:36] = False
    usable[50, 2:] = False
    values[~usable] = 1e3
    return drift, values, usable


@pytest.mark.parametrize("step", [0.0, 0.1, 0.5, 2.0])
def test_walks_are_found_again_and_errors_hold(step: float) -> None:
    """A slow walk, hidden in the noise of each line, as well as one that leaps."""
    held, off, bridged = [], [], []
    for seed in range(60):
        drift, values, usable = walked(step, seed)
        found, error = smooth_lines(values, usable)
        held.append(np.abs(found - drift) < 1.645 * error)
        off.append(found - drift)
        bridged.append(held[-1][30:36])
    assert np.mean(held) == pytest.approx(0.9 if step else 0.94, abs=0.03)
    assert np.mean(bridged) > 0.84
    there = np.delete(np.array(off), [*range(30, 36), 50], axis=1)
    # never worse than the lines by themselves, and better by far where the walk is slow
    ratio = float(there.std()) / ALONE
    assert ratio < {0.0: 0.5, 0.1: 0.65, 0.5: 1.0, 2.0: 1.02}[step]


def test_lines_without_pixels_are_bridged_with_an_error_that_grows() -> None:
    _, values, usable = walked(0.5, 1)
    found, error = smooth_lines(values, usable)
    assert error[30] > 1.5 * error[29]
    # a bridge: variances go as k (7 - k)/7 from one end
    assert error[32] / error[30] == pytest.approx(np.sqrt(2.0), rel=0.1)
    # a walk between two known places goes straight from one to the other
    straight = np.linspace(found[29], found[36], 8)
    np.testing.assert_allclose(found[29:37], straight, rtol=1e-6)


def test_the_smoothing_is_a_kalman_filter_there_and_back() -> None:
    """Against the covariance of a walk as a dense Gaussian process, its start nearly unknown."""
    generator = np.random.default_rng(4)
    lines, walk, start = 12, 0.3, 1e4
    reading, error = generator.normal(size=lines), generator.uniform(0.5, 1.0, lines)
    error[[3, 4, 9]] = np.inf
    some = np.isfinite(error)
    own = start + walk * np.minimum.outer(np.arange(lines), np.arange(lines))
    gain = own[:, some] @ np.linalg.inv(own[np.ix_(some, some)] + np.diag(error[some] ** 2))
    mean, variance = _smoothed(np.where(some, reading, 0.0), error, walk)
    np.testing.assert_allclose(mean, gain @ reading[some], atol=1e-3)
    np.testing.assert_allclose(variance, np.diag(own - gain @ own[some]), rtol=1e-3)
    # and the evidence is that of the same process, up to what does not depend on the walk
    walks, at = np.array([0.01, 0.3, 4.0]), np.flatnonzero(some)
    evidence = _evidence(reading[some], error[some], np.diff(at), walks)
    expected = []
    for one in walks:
        S = start + one * np.minimum.outer(at, at) + np.diag(error[some] ** 2)
        expected.append(-0.5 * (np.linalg.slogdet(S)[1] + reading[some] @ np.linalg.solve(S, reading[some])))
    np.testing.assert_allclose(np.diff(evidence), np.diff(expected), atol=2e-3)


def test_picometres_are_as_good_as_metres() -> None:
    _, values, usable = walked(0.5, 2)
    found, error = smooth_lines(values, usable)
    small, small_error = smooth_lines(1e-12 * values + 3e-10, usable)
    np.testing.assert_allclose(small - 3e-10, 1e-12 * found, atol=1e-17)
    np.testing.assert_allclose(small_error, 1e-12 * error, rtol=1e-4)


def test_constants_stay_and_their_error_is_none() -> None:
    found, error = smooth_lines(np.full((10, 20), 3e-10), np.ones((10, 20), bool))
    np.testing.assert_allclose(found, 3e-10, rtol=1e-10)
    assert error.max() < 1e-20
    steps = np.repeat(np.arange(10.0)[:, None], 20, axis=1)
    np.testing.assert_allclose(smooth_lines(steps, np.ones((10, 20), bool))[0], np.arange(10.0), atol=1e-12)


def test_lost_pixels_do_not_count() -> None:
    _, values, usable = walked(0.5, 3)
    values[5, ::7] = np.nan
    values[6] = np.nan
    marked = usable & np.isfinite(values)
    for a, b in zip(smooth_lines(values, usable), smooth_lines(values, marked), strict=True):
        np.testing.assert_array_equal(a, b)
        assert np.isfinite(a).all()


def test_few_lines_have_one_level() -> None:
    generator = np.random.default_rng(0)
    values = generator.normal(5.0, 1.0, (40, 50))
    usable = np.zeros((40, 50), bool)
    usable[[3, 30]] = True
    found, error = smooth_lines(values, usable)
    assert np.ptp(found) == 0.0
    assert found[0] == pytest.approx(5.0, abs=3.0 * error[0])
    assert error[0] == pytest.approx(1.2533 / np.sqrt(100), rel=0.3)


def test_without_pixels_nothing_is_known() -> None:
    found, error = smooth_lines(np.ones((4, 5)), np.zeros((4, 5), bool))
    assert not found.any()
    assert np.isinf(error).all()
    # two pixels of a line do not tell their own scatter
    usable = np.zeros((4, 5), bool)
    usable[:, :2] = True
    assert np.isinf(smooth_lines(np.ones((4, 5)), usable)[1]).all()
