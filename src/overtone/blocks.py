"""Run a kernel over blocks of pixels on all cores, with progress."""

from __future__ import annotations

import functools
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor, as_completed, wait

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
