"""Run a kernel over blocks of pixels on all cores, with progress."""

from __future__ import annotations

import contextvars
import functools
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor, as_completed, wait
from typing import TypeVar

Result = TypeVar("Result")

_limit: int | None = None


def run_blocks(
    kernel: Callable[[slice], None],
    count: int,
    size: int,
    progress: Callable[[int, int], None] | None = None,
) -> None:
    """Call ``kernel(slice)`` for consecutive blocks that cover ``range(count)``.

    The kernel releases the interpreter lock and writes its results itself, so that threads suffice and
    results do not depend on the order of blocks.

    Parameters
    ----------
    kernel : callable
        Does the work of one block.
    count, size : int
        Number of items, and items a block.
    progress : callable, optional
        Called with (items done, items in all) after each block, from the calling thread.
    """
    blocks = [slice(start, min(start + size, count)) for start in range(0, count, size)]
    done = 0
    futures = {_threads().submit(kernel, block): block for block in blocks}
    try:
        for future in as_completed(futures):
            future.result()
            block = futures[future]
            done += block.stop - block.start
            if progress is not None:
                progress(done, count)
    except BaseException:
        for future in futures:
            future.cancel()
        wait(futures)
        raise


def side_by_side(aside: Callable[[], Result], here: Callable[[Callable[[], None]], None]) -> Result:
    """Call ``aside`` in a thread of its own while ``here`` runs; return what it returns.

    Where one thread is all there is (`limit_threads`) they run one after the other.

    Parameters
    ----------
    aside : callable
        Under the caller's context (`numpy.errstate`).
    here : callable
        Is given a function to call now and then, which raises what ``aside`` has raised.

    Notes
    -----
    What ``here`` raises is raised when ``aside`` has ended: a thread cannot be stopped.
    """
    if _limit == 1:
        here(lambda: None)
        return aside()
    with ThreadPoolExecutor(1, thread_name_prefix="overtone-aside") as thread:
        waiting = thread.submit(contextvars.copy_context().run, aside)

        def raise_early() -> None:
            if waiting.done():
                waiting.result()

        here(raise_early)
        return waiting.result()


def limit_threads(count: int) -> None:
    """Use so many threads from now on instead of one a core: where several processes share the cores."""
    global _limit
    _limit = count


def _threads() -> ThreadPoolExecutor:
    return _pool(_limit or os.cpu_count() or 1)


@functools.cache
def _pool(count: int) -> ThreadPoolExecutor:
    """Return the threads, started once: starting them takes longer than many a call."""
    return ThreadPoolExecutor(max_workers=count, thread_name_prefix="overtone")
