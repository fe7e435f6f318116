"""The lock-in itself: its window, its averages one by one, and blocks that do not show."""

import numpy as np
import pytest

from overtone.instrument import lockin, samples
from overtone.instrument.lockin import (
    BETA,
    MAIN_LOBE,
    NOISE_WIDTH,
    LowPass,
    Phase,
    averages,
    kaiser,
    length_for,
    low_pass,
    noise_beside,
    response,
)
from overtone.instrument.samples import Trace

RATE, FREQUENCY = 2e6, 161_803.4
ORDERS = (0, 1, 2, 5)
ROUNDING = 1e-12 * 50e-9  # n theta is 1e4 rad, and known to 1e-12


def signals(count: int = 30_000) -> Trace:
    """Return three signals of harmonics and noise, of different size."""
    theta = phase(count).at(0, count)
    q = 3e-12 + 50e-9 * np.cos(theta - 1.3) + 20e-12 * np.cos(2 * theta - 0.7)
    noise = np.random.default_rng(7).normal(0.0, 25e-12, (3, count))
    return Trace(q * np.array([[1.0], [0.5], [0.0]]) + noise, RATE, 0.0)


def phase(count: int) -> Phase:
    """Return a drive that drifts by 1 kHz/s and wobbles."""
    turn, drift = 2 * np.pi * FREQUENCY / RATE, np.pi * 1e3 / RATE**2
    return Phase(0.5 * count, (0.4, turn, drift), rest=lambda k: 0.1 * np.sin(k / 500.0))


def window(bandwidth: float = 2e3) -> LowPass:
    return low_pass(RATE, length_for(RATE, bandwidth), round(RATE / (2 * bandwidth)))


def test_the_filter_is_the_one_that_is_stated() -> None:
    x = np.linspace(-1.0, 1.0, 2_000_001)
    window = np.i0(BETA * np.sqrt(1.0 - x**2))
    width = float(0.5 * np.trapezoid(window**2, x / 2) / np.trapezoid(window, x / 2) ** 2)
    assert width == pytest.approx(NOISE_WIDTH, rel=1e-6, abs=0)
    for bandwidth in (300.0, 2e3, 20e3):
        filtered = low_pass(RATE, length_for(RATE, bandwidth), 100)
        w = kaiser(filtered.length)
        w = w / w.sum()
        assert RATE * float((w**2).sum()) / 2 == pytest.approx(filtered.bandwidth, rel=1e-9, abs=0)
        assert filtered.bandwidth == pytest.approx(bandwidth, rel=2e-2, abs=0)
        m = np.arange(w.size) - 0.5 * (w.size - 1)
        for offset in (0.2, 1.0, 3.0, 4.5):
            transform = float((w * np.cos(2 * np.pi * offset * filtered.bandwidth / RATE * m)).sum())
            assert response(offset) == pytest.approx(transform, rel=0.02, abs=0)
        beyond = np.linspace(MAIN_LOBE * 1.01, min(40.0, 0.45 * RATE / filtered.bandwidth), 4000)
        transform = [
            abs((w * np.cos(2 * np.pi * f * filtered.bandwidth / RATE * m)).sum()) for f in beyond[::40]
        ]
        assert max(transform) < 1.2e-7
        assert all(t < 1.3 * response(f) for t, f in zip(transform, beyond[::40], strict=True))


def test_every_output_is_one_window_by_hand() -> None:
    trace, used, theta = signals(), window(), phase(30_000).at(0, 30_000)
    seen, centres = averages(trace, phase(30_000), ORDERS, used, 1_000, 29_990)
    assert seen.shape == (4, 3, (28_990 - used.length) // used.step + 1)
    w = kaiser(used.length)
    for j in (0, 7, centres.size - 1):
        first = 1_000 + j * used.step
        part = slice(first, first + used.length)
        assert centres[j] == first + 0.5 * (used.length - 1)
        for i, n in enumerate(ORDERS):
            expected = (w * trace.values[:, part] * np.exp(-1j * n * theta[part])).sum(axis=1) / w.sum()
            np.testing.assert_allclose(seen[i, :, j], expected, rtol=0, atol=ROUNDING)


@pytest.mark.parametrize("block", [64, 1000, 4096])
def test_blocks_do_not_show(block: int, monkeypatch: pytest.MonkeyPatch) -> None:
    trace, used = signals(), window()
    whole, _ = averages(trace, phase(30_000), ORDERS, used, 0, 30_000)
    stated = window().bandwidth
    monkeypatch.setattr(lockin, "BLOCK", block)
    monkeypatch.setattr(samples, "BLOCK", block)
    said: list[tuple[int, int]] = []
    parts, _ = averages(
        trace, phase(30_000), ORDERS, used, 0, 30_000, progress=lambda *call: said.append(call)
    )
    np.testing.assert_allclose(parts, whole, rtol=0, atol=ROUNDING)
    assert window().bandwidth == pytest.approx(stated, rel=1e-12, abs=0)
    assert [done for done, _ in said] == sorted(done for done, _ in said)
    assert said[-1][1] - said[-1][0] < used.step


def test_signals_side_by_side_are_those_one_by_one() -> None:
    trace, used = signals(), window()
    together, centres = averages(trace, phase(30_000), ORDERS, used, 0, 30_000)
    for k, values in enumerate(trace.values):
        alone, alike = averages(Trace(values, RATE, 0.0), phase(30_000), ORDERS, used, 0, 30_000)
        assert alone.shape == (4, centres.size)
        np.testing.assert_array_equal(alike, centres)
        np.testing.assert_allclose(alone, together[:, k], rtol=0, atol=ROUNDING)


def test_an_output_at_every_sample_is_the_same() -> None:
    trace, sparse = signals(9_000), window()
    dense, _ = averages(trace, phase(9_000), (0, 1), sparse._replace(step=1), 0, 9_000)
    seen, _ = averages(trace, phase(9_000), (0, 1), sparse, 0, 9_000)
    np.testing.assert_allclose(dense[..., :: sparse.step], seen, rtol=0, atol=ROUNDING)


def test_a_record_shorter_than_the_window_has_no_output() -> None:
    used = window()
    seen, centres = averages(signals(2_000), phase(2_000), (1,), used, 0, used.length - 1)
    assert seen.shape == (1, 3, 0)
    assert centres.size == 0


def test_noise_beside_a_line_is_that_of_the_floor() -> None:
    trace, used = signals(400_000), window()
    for k in (0, 2):  # with harmonics and without: lines do not count
        one = Trace(trace.values[k], RATE, 0.0)
        sigma = noise_beside(one, phase(400_000), ORDERS, FREQUENCY, used, (0, 400_000), followed=False)
        for n in ORDERS:
            expected = 25e-12 * np.sqrt((2.0 if n else 1.0) * used.bandwidth / (RATE / 2))
            assert sigma[n] == pytest.approx(expected, rel=0.06, abs=0)
