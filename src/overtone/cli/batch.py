"""Options of ``overtone map`` for many files and many computers, and what a batch says in the end."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter
from rich.console import Console

from overtone.cli.progress import progress_bar
from overtone.errors import OvertoneError

if TYPE_CHECKING:
    from overtone.batch.settings import Settings

_MOST_MESSAGES = 20


@Parameter(name="*")
@dataclass(frozen=True)
class BatchOptions:
    """Many files, or many computers."""

    out_dir: Annotated[Path | None, Parameter(name="--out-dir")] = None
    """Folder of results, one for each file, <name>.nc, and batch.csv, which tells what became of each; made where it is
    not there. Results that are finished are kept, so that the same command goes on where it was stopped."""
    reports: Annotated[bool, Parameter(name="--reports", negative=())] = False
    """With --out-dir: a report beside each result, <name>.html."""
    redo: Annotated[bool, Parameter(name="--redo", negative=())] = False
    """With --out-dir: make finished results again."""
    cluster: Annotated[str | None, Parameter(name="--cluster")] = None
    """Where files, or blocks of a .zarr, are mapped: local, for processes of this computer, or the address of a Dask
    scheduler such as tcp://host:8786, whose workers share the file system."""


def check_batch(batch: BatchOptions, output: Path | None, report: Path | None, paper: Path | None) -> None:
    """Refuse options of one map for many, and of many for one."""
    if output is None and batch.out_dir is None:
        raise OvertoneError(
            "it is not said where the result is to go",
            expected="--output for one map, or --out-dir for a map of each file",
            hint="-o maps.nc, or --out-dir results",
        )
    if batch.out_dir is None:
        for option, given in (("--reports", batch.reports), ("--redo", batch.redo)):
            if given:
                raise OvertoneError(f"{option} is for many files", expected="--out-dir", got="--output")
        return
    for option, path, hint in (
        ("--output", output, "one of the two"),
        ("--report", report, "--reports, for one beside each result"),
        ("--paper", paper, "one file at a time, with --output"),
    ):
        if path is not None:
            raise OvertoneError(f"{option} is for one map, --out-dir for many", got=str(path), hint=hint)


def map_batch(files: Sequence[Path], settings: Settings, batch: BatchOptions) -> None:
    """Map each file, print what became of it, and say so where some failed.

    Raises
    ------
    OvertoneError
        If a file failed, after all others were mapped.
    """
    from overtone.batch.files import map_each
    from overtone.batch.log import NAMES, batch_table
    from overtone.report.terminal import print_table

    assert batch.out_dir is not None
    console = Console()
    counts = (0, len(files))

    def count(done: int, every: int) -> None:
        nonlocal counts
        counts = done, every
        update("files", done, every)

    try:
        with progress_bar() as update:
            done = map_each(
                files,
                batch.out_dir,
                settings,
                reports=batch.reports,
                redo=batch.redo,
                cluster=batch.cluster,
                progress=count,
            )
    except KeyboardInterrupt:
        said = "stopped: {} of {} files are done, and the same command goes on from there".format(*counts)
        Console(stderr=True).print(said)
        raise
    print_table(batch_table(done.outcomes), console)
    for outcome in done.failed[:_MOST_MESSAGES]:
        console.print(f"{outcome.file.name}: {outcome.why}", highlight=False, soft_wrap=True, markup=False)
    console.print(
        f"results and {NAMES[0]} are in {batch.out_dir}", highlight=False, soft_wrap=True, markup=False
    )
    if done.failed:
        raise OvertoneError(
            f"{len(done.failed)} of {len(done.outcomes)} files failed",
            got=", ".join(outcome.file.name for outcome in done.failed[:5])
            + (", ..." if len(done.failed) > 5 else ""),
            hint=f"{batch.out_dir / NAMES[0]} says why; the same command maps only what is not done",
        )


def summary_line(summary: Mapping[str, Any] | None) -> str:
    """Return what is in a map in a line."""
    counts = dict(summary or {})
    line = f"{counts.get('pixels', 0)} pixels"
    if "determined" in counts:
        line += f", the modulus of {100.0 * counts['determined']:.0f} % is determined"
    return line
