"""Two things at a time: what comes back, and what is raised when."""

import threading

import numpy as np
import pytest

from overtone import blocks


def test_both_run_and_the_answer_of_the_one_aside_comes_back() -> None:
    met = threading.Event()

    def here(raise_early):  # type: ignore[no-untyped-def]
        assert met.wait(30.0)  # they run at the same time
        raise_early()

    def aside() -> str:
        met.set()
        return "found"

    assert blocks.side_by_side(aside, here) == "found"


def test_an_error_aside_ends_what_runs_here() -> None:
    def aside() -> None:
        raise ValueError("no such phase")

    steps = []

    def here(raise_early):  # type: ignore[no-untyped-def]
        for step in range(10_000):
            steps.append(step)
            raise_early()
            threading.Event().wait(0.001)

    with pytest.raises(ValueError, match="no such phase"):
        blocks.side_by_side(aside, here)
    assert len(steps) < 10_000


def test_an_error_here_waits_for_the_other_and_is_raised() -> None:
    ended = []

    def here(raise_early):  # type: ignore[no-untyped-def]
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        blocks.side_by_side(lambda: ended.append(1), here)
    assert ended == [1]


def test_the_caller_says_what_is_an_error_of_numbers() -> None:
    with np.errstate(divide="ignore"):
        assert np.isinf(blocks.side_by_side(lambda: np.array([1.0]) / 0.0, lambda raise_early: None)).all()


def test_one_thread_does_one_after_the_other(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(blocks, "_limit", 1)
    order: list[str] = []
    names = set()

    def aside() -> None:
        order.append("aside")
        names.add(threading.current_thread().name)

    def here(raise_early):  # type: ignore[no-untyped-def]
        order.append("here")
        raise_early()

    blocks.side_by_side(aside, here)
    assert order == ["here", "aside"]
    assert names == {threading.current_thread().name}
