"""A map as files: the result, its report and the folder for a paper, all of them or none."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from overtone.batch.inputs import Stamp
from overtone.batch.mapping import Mapped, dataset_of
from overtone.batch.record import ATTRIBUTE, Record, path_from, summary_of

if TYPE_CHECKING:
    from overtone.report.content import Report


def stamps_of(files: Sequence[Path], folder: Path) -> dict[str, Stamp]:
    """Return stamps of the files of a map by their paths as seen from a folder, to be taken before they are read.

    Files that cannot be read have none: the reader says what is wrong with them.
    """
    stamps = {}
    for file in files:
        try:
            stamps[path_from(folder, file)] = Stamp.of(file)
        except OSError:
            continue
    return stamps


def write_map(
    mapped: Mapped,
    output: Path,
    *,
    stamps: Mapping[str, Stamp],
    settings: Mapping[str, str],
    content: Report | None = None,
    report: Path | None = None,
    paper: Path | None = None,
) -> Record:
    """Write the files of a map; where one of them cannot be written none is.

    Parameters
    ----------
    mapped : Mapped
        What was mapped.
    output : Path
        Result, netCDF or Zarr.
    stamps : mapping of str to Stamp
        Of `stamps_of`.
    settings : mapping of str to str
        What it was mapped with, as text.
    content : Report, optional
        What the reports say, where there are any.
    report : Path, optional
        Report, one HTML page.
    paper : Path, optional
        Folder of figures and tables for a paper.

    Returns
    -------
    Record
        What the result says of itself.

    Raises
    ------
    OvertoneError
        If a file cannot be written.
    """
    from overtone.io.export import save

    dataset = dataset_of(mapped)
    record = Record(dict(stamps), dict(settings), summary=summary_of(dataset))
    written: list[Path] = []
    # the reports first: where they cannot be written nothing is
    try:
        if report is not None and content is not None:
            from overtone.report.page import write_report

            written.append(write_report(content, report))
            record = replace(record, report=Stamp.of(report).digest)
        if paper is not None and content is not None and mapped.properties is not None:
            written += _written_paper(paper, content, mapped)
        save(dataset.assign_attrs({ATTRIBUTE: record.text()}), output)
    except BaseException:
        for path in written:
            path.unlink(missing_ok=True)
        raise
    return record


def _written_paper(folder: Path, content: Report, mapped: Mapped) -> tuple[Path, ...]:
    from overtone.report.paper import write_paper

    assert mapped.properties is not None
    return write_paper(
        folder,
        content.observables,
        mapped.properties,
        before=content.before,
        energies=content.energies,
        curves=content.calibration,
        title=content.title.removeprefix("overtone: "),
    )
