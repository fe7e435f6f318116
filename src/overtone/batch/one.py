"""One file of a batch: mapped, written, and told of in a line, whatever happens."""

from __future__ import annotations

import secrets
import time
import traceback
import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from overtone.batch.record import Record, record_in, why_again
from overtone.batch.settings import Settings
from overtone.errors import OvertoneError, OvertoneWarning

MAPPED, KEPT, FAILED, NOT_REACHED = "mapped", "kept", "failed", "not reached"


@dataclass(frozen=True)
class Job:
    """What is to be done with one file.

    Parameters
    ----------
    file, output : Path
        The scan and its result.
    report : Path or None
        Its report.
    settings : Settings
        How it is mapped.
    texts : mapping of str to str
        The same as text.
    work : Path
        Folder beside the results for what is not finished.
    why : str
        Why it is done; empty where the result stands.
    """

    file: Path
    output: Path
    report: Path | None
    settings: Settings
    texts: Mapping[str, str]
    work: Path
    why: str


@dataclass(frozen=True)
class Outcome:
    """What became of one file.

    Parameters
    ----------
    file : Path
        The scan.
    result : Path
        Where its result is, or would be.
    state : str
        ``mapped``, ``kept``, ``failed`` or ``not reached``.
    why : str
        Why it was mapped or kept, or what went wrong.
    seconds : float
        How long it took.
    summary : mapping
        ``pixels``, ``determined`` and ``modulus`` [Pa], where the result tells.
    traceback : str
        Of an error that overtone does not know.
    """

    file: Path
    result: Path
    state: str
    why: str
    seconds: float = 0.0
    summary: Mapping[str, Any] | None = None
    traceback: str = ""


def kept(job: Job) -> Outcome:
    """Return that a result stands as it is."""
    record = record_in(job.output)
    return Outcome(
        job.file,
        job.output,
        KEPT,
        "same input, settings and version",
        summary=record.summary if record is not None else None,
    )


def given_up(job: Job, reason: str) -> Outcome:
    """Return that a file was given up."""
    return Outcome(job.file, job.output, FAILED, reason)


def do(job: Job) -> Outcome:
    """Map a file and write its result and report; an error is told, not raised.

    A result is moved to its place in one step, its report before it. The job may run again: a worker that was lost
    after it had finished costs nothing.
    """
    start = time.perf_counter()
    try:
        with warnings.catch_warnings():
            # what these warnings say is kept as findings of the result
            warnings.simplefilter("ignore", OvertoneWarning)
            record = _do(job)
    except Exception as error:
        known = isinstance(error, OvertoneError)
        said = str(error) if known else f"{type(error).__name__}: {error}"
        if job.output.exists():
            said += " The result of an earlier run was left as it is."
        told = "" if known else traceback.format_exc()
        return Outcome(job.file, job.output, FAILED, said, time.perf_counter() - start, traceback=told)
    return Outcome(job.file, job.output, MAPPED, job.why, time.perf_counter() - start, record.summary)


def do_again(job: Job) -> Outcome:
    """Do the same, but keep a result that another worker has finished since."""
    try:
        done = job.output.exists() and not why_again(job.output, job.file, job.texts, job.report)
    except OSError:
        done = False
    return kept(job) if done else do(job)


def _do(job: Job) -> Record:
    if job.output.suffix == ".zarr":
        from overtone.batch.blocks import map_blocks

        return map_blocks(job.file, job.output, job.settings, work=job.work)
    from overtone.batch.mapping import map_scans, report_of
    from overtone.batch.writing import stamps_of, write_map

    stamps = stamps_of([job.file], job.output.parent)
    mapped = map_scans([job.file], job.settings)
    token = secrets.token_hex(8)
    result, page = job.work / f"{token}.nc", job.work / f"{token}.html"
    try:
        record = write_map(
            mapped,
            result,
            stamps=stamps,
            settings=job.texts,
            content=report_of(mapped) if job.report is not None else None,
            report=page if job.report is not None else None,
        )
        if job.report is not None:
            page.replace(job.report)
        result.replace(job.output)
    finally:
        result.unlink(missing_ok=True)
        page.unlink(missing_ok=True)
    return record
