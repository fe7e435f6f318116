"""Files of a batch, or blocks of a large map, on the workers of a Dask cluster: of this computer or of many."""

from __future__ import annotations

import logging
import os
import secrets
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from importlib import import_module
from pathlib import Path
from typing import Any, TypeVar

from overtone._version import __version__
from overtone.errors import OvertoneError

_Job = TypeVar("_Job")
_Result = TypeVar("_Result")

LOCAL = "local"
_RETRIES = 2  # of a task whose own error is not one of a file: those are told, not raised
_FAILURES = 3  # workers that may die over a task before it counts as the reason
_PATIENCE = 60.0  # seconds to wait for the first worker, and for a scheduler to answer

# Kernels use as many threads as a worker has; two maps at once in one process would mix up their warnings.
_ONE_AT_A_TIME = threading.Lock()


def check_cluster(cluster: Any) -> None:
    """Refuse what is no cluster, and say what to install where it cannot be had.

    Raises
    ------
    OvertoneError
        If it is neither ``local`` nor an address, or Dask is not installed.
    """
    try:
        import_module("distributed")
    except ImportError as error:
        raise OvertoneError(
            "a cluster needs Dask, which is not installed",
            got=str(error),
            hint='pip install "overtone[cluster]"',
        ) from error
    if isinstance(cluster, str) and cluster != LOCAL and "://" not in cluster:
        raise OvertoneError(
            f"{cluster!r} is no cluster",
            expected='"local", or the address of a scheduler',
            hint="--cluster tcp://host:8786",
        )


def run_jobs(
    jobs: Mapping[int, _Job],
    cluster: Any,
    work: Path,
    task: Callable[[_Job], _Result],
    lost: Callable[[_Job, str], _Result],
    warm: Callable[[], object] | None = None,
) -> Iterator[tuple[int, _Result]]:
    """Do jobs on the workers of a cluster and yield what came of each, as it comes.

    A job whose worker dies is done again by another; one that kills its workers is given up and told of.

    Parameters
    ----------
    jobs : mapping of int to job
        Anything that can be pickled.
    cluster : str or Client
        ``local``, the address of a scheduler, or a client of one.
    work : Path
        Folder that all workers have to see.
    task : callable
        Does a job; a function of a module. It may be called again for a job that is done.
    lost : callable
        Takes a job that was given up and the reason, and returns what came of it.
    warm : callable, optional
        Done by one worker of each computer before anything else.

    Raises
    ------
    OvertoneError
        If there is no such scheduler or it has no workers, they run another version of overtone or do not see the
        folder, or the scheduler is lost.
    """
    distributed: Any = import_module("distributed")
    with _client(cluster, len(jobs)) as client:
        _check_workers(client, work)
        if warm is not None:
            _warm(client, warm)
        run = secrets.token_hex(4)
        futures = {
            client.submit(_on_worker, task, job, key=f"overtone-{run}-{i}", pure=False, retries=_RETRIES): i
            for i, job in jobs.items()
        }
        try:
            for future in distributed.as_completed(futures, loop=client.loop):
                i = futures[future]
                if future.status == "cancelled":
                    raise OvertoneError(
                        "the scheduler of the cluster was lost", hint="the same command again"
                    )
                error = future.exception()
                yield i, future.result() if error is None else lost(jobs[i], _said(error))
                future.release()
        finally:
            client.cancel(list(futures), reason="the batch has ended")


def _on_worker(task: Callable[[_Job], _Result], job: _Job) -> _Result:
    from overtone.blocks import limit_threads

    distributed: Any = import_module("distributed")
    with _ONE_AT_A_TIME:
        limit_threads(distributed.get_worker().state.nthreads)
        return task(job)


def _warm(client: Any, warm: Callable[[], object]) -> None:
    """Do something on one worker of each computer, and wait for it."""
    one = {info["host"]: address for address, info in client.scheduler_info(n_workers=-1)["workers"].items()}
    futures = [
        client.submit(_call, warm, pure=False, workers=[address], allow_other_workers=True)
        for address in one.values()
    ]
    for future in futures:
        future.exception()


def _call(warm: Callable[[], object]) -> None:
    _on_worker(lambda _: warm(), None)


def _said(error: BaseException) -> str:
    if type(error).__name__ == "KilledWorker":
        return f"{_FAILURES + 1} workers died over it: it may need more memory than a worker has."
    return f"{type(error).__name__}: {error}"


@contextmanager
def _client(cluster: Any, jobs: int) -> Iterator[Any]:
    """Give a client of the cluster; what was started for it ends with it."""
    distributed: Any = import_module("distributed")
    if not isinstance(cluster, str):
        yield cluster
        return
    if cluster != LOCAL:
        try:
            client = distributed.Client(cluster, timeout=_PATIENCE / 4, set_as_default=False)
        except (OSError, ValueError) as error:
            raise OvertoneError(
                f"no scheduler answers at {cluster}", got=str(error), hint="dask scheduler, and its address"
            ) from error
        with client:
            yield client
        return
    with _local(jobs) as started, distributed.Client(started, set_as_default=False) as client:
        yield client


@contextmanager
def _local(jobs: int) -> Iterator[Any]:
    """Give a cluster of processes of this computer, one thread each."""
    dask: Any = import_module("dask")
    distributed: Any = import_module("distributed")
    # a worker gets its next file when it is free: one that dies takes no file with it that it had not begun
    settings = {
        "distributed.scheduler.worker-saturation": 1.0,
        "distributed.scheduler.allowed-failures": _FAILURES,
    }
    with dask.config.set(settings):
        try:
            started = distributed.LocalCluster(
                n_workers=min(os.cpu_count() or 1, jobs),
                threads_per_worker=1,
                processes=True,
                dashboard_address="127.0.0.1:0",
                scheduler_kwargs={"dashboard": False},
                preload=["overtone.batch.worker"],
                silence_logs=logging.CRITICAL,
            )
        except RuntimeError as error:
            raise OvertoneError(
                "the processes of a local cluster do not start",
                got=str(error),
                hint='in a script, the call from below if __name__ == "__main__":',
            ) from error
        with started:
            yield started


def _check_workers(client: Any, work: Path) -> None:
    """Refuse workers of another version, and those that do not see the folder of the results."""
    try:
        client.wait_for_workers(1, timeout=_PATIENCE)
    except TimeoutError as error:
        raise OvertoneError(
            "the scheduler has no workers", expected="one or more", hint="dask worker tcp://host:8786"
        ) from error
    mark = work / f"{secrets.token_hex(8)}.mark"
    mark.touch()
    try:
        said = client.run(_look, str(mark), on_error="return")
    finally:
        with suppress(OSError):
            mark.unlink()
    for worker, answer in said.items():
        if isinstance(answer, BaseException):
            raise OvertoneError(
                f"the worker {worker} cannot run overtone",
                got=str(answer),
                hint=f'pip install "overtone[cluster]=={__version__}" where it runs',
            ) from answer
        version, sees = answer
        if version != __version__:
            raise OvertoneError(
                f"the worker {worker} has another overtone", expected=__version__, got=version
            )
        if not sees:
            raise OvertoneError(
                f"the worker {worker} does not see the folder {work.parent}",
                expected="workers that share the file system",
                hint="a folder that all computers of the cluster have under the same name",
            )


def _look(mark: str) -> tuple[str, bool]:
    return __version__, Path(mark).exists()
