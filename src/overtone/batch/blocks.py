"""A map larger than memory: Zarr in, Zarr out, block by block, each pixel as it would be mapped in one go.

Methods that take every pixel by itself need no more than the block at hand. What a scan says of itself as a whole (its
reading, its noise where that is told from the scan) is told from lines spread over it, as many as fit into memory. An
unfinished map lies beside the result, with a mark for each block that is done, so that a run that was stopped goes on.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Generator, Mapping, Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Any

from overtone.batch.block_scan import Plan, guarded, loaded, observables_in, open_source, planned
from overtone.batch.block_shapes import Region, regions_of
from overtone.batch.block_store import ZARR, create, finish, is_begun, is_done, put, summary, unfinished
from overtone.batch.folder import working_folder
from overtone.batch.inputs import Stamp
from overtone.batch.mapping import merged, properties_of
from overtone.batch.record import Record, path_from
from overtone.batch.settings import POPULATION, Settings, check_settings, texts_of
from overtone.errors import FileFormatError, OvertoneError, OvertoneWarning

Progress = Callable[[int, int], None] | None


def fits_in_blocks(
    files: Sequence[Path],
    output: Path,
    settings: Settings,
    cluster: Any = None,
    report: Path | None = None,
    paper: Path | None = None,
) -> bool:
    """Tell whether a map is made block by block: one Zarr folder in, one out.

    Raises
    ------
    OvertoneError
        If it would be, and cannot with these settings; or a cluster is asked for and there are no blocks.
    """
    zarr = [path.suffix.lower() == ZARR for path in (*files, output)]
    if not all(zarr):
        if cluster is not None:
            raise OvertoneError(
                "one map in memory uses the cores of this computer",
                expected="--out-dir for many files, or .zarr in and out for one that is cut into blocks",
                got=f"--cluster {cluster} and {output.name}",
            )
        return False
    whole = next((reason for reason, true in _wholes(files, settings) if true), None)
    if whole is not None:
        raise OvertoneError(
            "a .zarr is mapped into a .zarr block by block",
            expected="pixels that can be mapped each by itself",
            got=whole,
            hint="-o maps.nc, which maps all of it in memory",
        )
    for option, path in (("--report", report), ("--paper", paper)):
        if path is not None:
            raise OvertoneError(f"{option} shows a whole map", got="one that is made block by block")
    return True


def _wholes(files: Sequence[Path], settings: Settings) -> list[tuple[str, bool]]:
    return [
        (f"{len(files)} files", len(files) > 1),
        ("method population, which pools the pixels of a whole scan", settings.method == POPULATION),
        ("a calibration, which needs a whole scan to be corrected", settings.calibration is not None),
    ]


@dataclass(frozen=True)
class Block:
    """One block of a map."""

    plan: Plan
    number: int
    region: Region


def map_blocks(
    file: Path,
    output: Path,
    settings: Settings,
    *,
    cluster: Any = None,
    progress: Progress = None,
    work: Path | None = None,
) -> Record:
    """Map a scan in a Zarr folder into another, block by block; a run that was stopped goes on where it was.

    Parameters
    ----------
    file, output : Path
        Zarr folders: observables as `overtone.save` writes them, and the result.
    settings : Settings
        What is asked for; not method population, and no calibration.
    cluster : str, optional
        Where blocks are mapped, as of `overtone.map_files`.
    progress : callable, optional
        Called with (pixels done, pixels in all).
    work : Path, optional
        Folder for what is not finished, on the file system of the output; one beside it unless given.

    Returns
    -------
    Record
        What the result says of itself.

    Raises
    ------
    OvertoneError
        If the file is no such scan, the settings do not fit, or a block cannot be mapped.
    """
    check_settings(settings)
    fits_in_blocks([file], output, settings)
    if cluster is not None:
        from overtone.batch.cluster import check_cluster

        check_cluster(cluster)
    file, output = file.absolute(), output.absolute()
    texts = texts_of(settings)
    if not file.is_dir():
        raise FileFormatError(
            f"there is no Zarr folder {str(file)!r}",
            expected="a scan as overtone.save writes it",
            got="a file" if file.exists() else "nothing",
            hint="check the path",
        )
    stamp = Stamp.of(file, digest=False)
    with ExitStack() as stack:
        work = work or stack.enter_context(working_folder(output.parent))
        folder = unfinished(work, output, stamp, texts)
        source = open_source(file, stamp)
        plan, template = planned(file, stamp, folder, settings)
        if not is_begun(folder):
            create(folder, template, source, plan.dims)
        regions = regions_of(source["A1"], plan.dims)
        blocks = {i: Block(plan, i, region) for i, region in enumerate(regions)}
        _map_all(blocks, folder, cluster, work, progress)
        record = Record({path_from(output.parent, file): stamp}, texts, summary=summary(folder, len(blocks)))
        finish(folder, output, record, work)
    return record


def _map_all(blocks: Mapping[int, Block], folder: Path, cluster: Any, work: Path, progress: Progress) -> None:
    sizes = {i: math.prod(part.stop - part.start for part in b.region) for i, b in blocks.items()}
    done = {i for i in blocks if is_done(folder, i)}
    todo = {i: block for i, block in blocks.items() if i not in done}
    with closing(_run(todo, cluster, work)) as finished:
        for i in chain(done, finished):
            done.add(i)
            if progress is not None:
                progress(sum(sizes[i] for i in done), sum(sizes.values()))


def _run(todo: Mapping[int, Block], cluster: Any, work: Path) -> Generator[int, None, None]:
    if cluster is None or not todo:
        for i, block in todo.items():
            map_block(block)
            yield i
        return
    from overtone.batch.cluster import run_jobs
    from overtone.batch.warm import warm_up

    warm = partial(warm_up, next(iter(todo.values())).plan.settings)
    for i, reason in run_jobs(todo, cluster, work, _map_block_or_say, _given_up, warm):
        if reason:
            raise OvertoneError(
                f"block {i} of {todo[i].plan.file.name} could not be mapped",
                got=reason,
                hint="the same command again: blocks that are done are kept",
            )
        yield i


def _given_up(block: Block, reason: str) -> str:
    return reason


def _map_block_or_say(block: Block) -> str:
    """Map a block and return what is wrong with it; what is not overtone's is raised, and tried again elsewhere."""
    try:
        map_block(block)
    except OvertoneError as error:
        return str(error)
    return ""


def map_block(block: Block) -> None:
    """Map one block, write it to its place, and mark it as done.

    Raises
    ------
    OvertoneError
        If it cannot be mapped.
    """
    from overtone.inversion.properties import DETERMINED, map_energy
    from overtone.readings import probe_of

    plan = block.plan
    region = dict(zip(plan.dims, block.region, strict=True))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", OvertoneWarning)  # said of the scan as a whole
        raw = guarded(loaded(open_source(plan.file, plan.stamp).isel(region)), plan.guard, plan.dims[0])
        observables = observables_in(raw, plan.file, plan.settings, known=True)[list(plan.names)]
        observables = observables.assign_attrs(plan.attributes)
        energies = map_energy(observables, probe_of(observables), noise=plan.noise)
        properties, _, _ = properties_of(observables, plan.settings, plan.noise)
    result = merged(observables, energies, properties).isel({plan.dims[0]: slice(None, -1)})
    counts = {"pixels": int(result["A1"].size)}
    if "status" in result:
        counts["determined"] = int((result["status"] == DETERMINED).sum())
    put(plan.folder, block.number, result, region, counts)
