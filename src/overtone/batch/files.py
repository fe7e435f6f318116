"""Many files with the same settings, each with a result of its own."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Generator, Sequence
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from overtone.batch.folder import working_folder
from overtone.batch.inputs import each_once, find_files, names_of
from overtone.batch.log import write_log
from overtone.batch.one import FAILED, NOT_REACHED, Job, Outcome, do, do_again, given_up, kept
from overtone.batch.record import belongs_to, why_again
from overtone.batch.settings import Settings, absolute, check_settings, noise_of, settings_of, texts_of
from overtone.errors import OvertoneError


@dataclass(frozen=True)
class Batch:
    """What became of the files of a batch.

    Parameters
    ----------
    out_dir : Path
        Where the results are.
    outcomes : tuple of Outcome
        One a file, in their order.
    """

    out_dir: Path
    outcomes: tuple[Outcome, ...]

    def count(self, state: str) -> int:
        """Return how many files have a state: ``mapped``, ``kept``, ``failed`` or ``not reached``."""
        return Counter(outcome.state for outcome in self.outcomes)[state]

    @property
    def failed(self) -> tuple[Outcome, ...]:
        """Files that have no result."""
        return tuple(outcome for outcome in self.outcomes if outcome.state == FAILED)


def map_files(
    files: str | Path | Sequence[str | Path],
    out_dir: str | Path,
    *,
    reports: bool = False,
    redo: bool = False,
    cluster: Any = None,
    progress: Callable[[int, int], None] | None = None,
    **settings: Any,
) -> Batch:
    """Map many files with the same settings, each with a result of its own, and go on where a run before was stopped.

    Parameters
    ----------
    files : str, Path or sequence of them
        Files, or patterns such as ``scans/*.ibw``.
    out_dir : str or Path
        Folder of the results, ``<name>.nc`` for each file; made where it is not there. Files of one name get names
        that keep them apart (``monday_scan.nc``), and nothing that is not a result of the same file is overwritten.
        ``batch.csv`` and ``batch.json`` in it tell what became of each file.
    reports : bool
        Whether each result has a report beside it, ``<name>.html``.
    redo : bool
        Whether finished results are made again. A result is finished where the same version of overtone made it, with
        the same settings, from the same content of the file.
    cluster : str, optional
        ``local`` for processes of this computer, or the address of a Dask scheduler, ``tcp://host:8786``, whose workers
        share the file system. Needs ``pip install "overtone[cluster]"``. In a script, call from below
        ``if __name__ == "__main__":``.
    progress : callable, optional
        Called with (files done, files in all).
    **settings
        What of `overtone.batch.settings.Settings` is not the default: ``poisson_ratio``, ``model``, ``method``,
        ``harmonics``, ``noise``, ``priors``, ``motion``, ``given``; ``probe``, ``radius`` [m], ``channels``,
        ``scales``, ``far_phase`` [rad], ``phase_sign``, ``direction``, ``corrected``; ``calibration``,
        ``reference_area``, ``lift``; for method ``population`` ``phases``, ``reference``, ``reference_pixels``,
        ``seed``.

    Returns
    -------
    Batch
        What became of each file. A file that cannot be mapped is told of, not raised.

    Raises
    ------
    OvertoneError
        If settings are wrong whatever the file, the folder cannot be written to or another batch is at work there, no
        file fits a pattern, or the cluster cannot be had.

    Notes
    -----
    Killed at any moment, a run leaves whole results only: what is not finished lies in the folder ``.overtone`` beside
    them, which the next run clears.
    """
    return map_each(
        [files] if isinstance(files, str | Path) else files,
        Path(out_dir),
        settings_of(settings),
        reports=reports,
        redo=redo,
        cluster=cluster,
        progress=progress,
    )


def map_each(
    files: Sequence[str | Path],
    out_dir: Path,
    settings: Settings,
    *,
    reports: bool = False,
    redo: bool = False,
    cluster: Any = None,
    progress: Callable[[int, int], None] | None = None,
) -> Batch:
    """Do what `map_files` does, with settings as a record."""
    inputs = each_once(find_files(files))
    settings = absolute(settings)
    check_settings(settings)
    noise_of(settings)
    texts = _texts(settings)
    if cluster is not None:
        from overtone.batch.cluster import check_cluster

        check_cluster(cluster)
    with working_folder(out_dir.absolute()) as work:
        outputs = _outputs([file.absolute() for file in inputs], work.parent, settings)
        jobs = [_job(file, output, work, settings, texts, reports, redo) for file, output in outputs.items()]
        outcomes: dict[int, Outcome] = {i: kept(job) for i, job in enumerate(jobs) if not job.why}
        if progress is not None:
            progress(len(outcomes), len(jobs))
        todo = {i: job for i, job in enumerate(jobs) if job.why}
        try:
            with closing(_run(todo, cluster, work)) as done:
                for i, outcome in done:
                    outcomes[i] = outcome
                    if progress is not None:
                        progress(len(outcomes), len(jobs))
        finally:
            every = tuple(outcomes.get(i) or _not_reached(job) for i, job in enumerate(jobs))
            batch = Batch(out_dir, every)
            write_log(batch.outcomes, out_dir.absolute(), work, texts)
    return batch


def _run(todo: dict[int, Job], cluster: Any, work: Path) -> Generator[tuple[int, Outcome], None, None]:
    if cluster is None or not todo:
        for i, job in todo.items():
            yield i, do(job)
        return
    from overtone.batch.cluster import run_jobs
    from overtone.batch.warm import warm_up

    settings = next(iter(todo.values())).settings
    yield from run_jobs(todo, cluster, work, do_again, given_up, partial(warm_up, settings))


def _outputs(files: Sequence[Path], out_dir: Path, settings: Settings) -> dict[Path, Path]:
    """Return the result of each file: under a name that is free, or that its result has from an earlier run.

    Raises
    ------
    OvertoneError
        If a result would lie among scans of its own kind.
    """
    ladders = names_of(files)
    taken = {names[0].casefold() for names in ladders}
    outputs: dict[Path, Path] = {}
    for file, names in zip(files, ladders, strict=True):
        zarr = file.suffix.lower() == ".zarr" and in_blocks(settings)
        ending = ".zarr" if zarr else ".nc"
        if file.suffix.lower() == ending and file.resolve().parent == out_dir.resolve():
            raise OvertoneError(
                f"the results would lie among the scans, such as {file.name}",
                expected="a folder of their own",
                got=str(out_dir),
                hint="--out-dir results",
            )
        for name in names:
            output = out_dir / (name + ending)
            free = name == names[0] or name.casefold() not in taken
            if free and (not output.exists() or belongs_to(output, file)):
                break
        else:
            raise OvertoneError(
                f"no name is left for the result of {file}", got=str(output), hint="another folder"
            )
        taken.add(name.casefold())
        outputs[file] = output
    return outputs


def _job(
    file: Path,
    output: Path,
    work: Path,
    settings: Settings,
    texts: dict[str, str],
    reports: bool,
    redo: bool,
) -> Job:
    """Return what is to be done with a file, and why."""
    report = output.with_suffix(".html") if reports else None
    if not output.exists():
        why = "new"
    elif redo:
        why = "asked for again"
    else:
        try:
            why = why_again(output, file, texts, report)
        except OSError:
            why = "the input cannot be read"
    return Job(file, output, report, settings, texts, work, why)


def in_blocks(settings: Settings) -> bool:
    """Tell whether a map with these settings can be made block by block, each by itself."""
    return settings.method != "population" and settings.calibration is None


def _texts(settings: Settings) -> dict[str, str]:
    try:
        return texts_of(settings)
    except OSError as error:
        raise OvertoneError(
            f"cannot read {error.filename}", got=error.strerror or str(error), hint="check the path"
        ) from error


def _not_reached(job: Job) -> Outcome:
    return Outcome(job.file, job.output, NOT_REACHED, job.why)
