"""The report for a paper: a folder with figures, the numbers behind them, tables, a methods paragraph and a page."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import xarray as xr

from overtone import provenance
from overtone.instrument.correct import calibration_of
from overtone.report.content import Calibrated, Report, Table
from overtone.report.data_files import cells_text, table_text
from overtone.report.folder import filled_folder
from overtone.report.materials import materials_table, verdict_text
from overtone.report.page import lay_out, picture_of
from overtone.report.paper_content import Paper, PaperFigure, with_setpoint
from overtone.report.paper_data import law_data, material_data
from overtone.report.paper_facts import facts_of, metadata_cells, metadata_rows, metadata_table
from overtone.report.paper_figures import NAMES, paper_figures
from overtone.report.paper_methods import REFERENCES, methods_paragraphs, methods_text
from overtone.report.pictures import FORMATS, picture_bytes
from overtone.report.shares import status_shares
from overtone.report.summary import gate_table, unknown_table

__all__ = ["materials_table", "with_setpoint", "write_paper"]

TABLES, METADATA, METHODS, PAGE = "tables.csv", "metadata.csv", "methods.md", "report.html"
LAWS = "laws.csv"
_EXTRA = ("_fit",)  # further tables of a figure
_LABEL = "population"


def write_paper(
    folder: str | Path,
    observables: xr.Dataset,
    result: xr.Dataset,
    *,
    before: xr.Dataset | None = None,
    energies: xr.Dataset | None = None,
    curves: Calibrated | None = None,
    others: Sequence[xr.Dataset] = (),
    truth: xr.Dataset | None = None,
    title: str = "Nanomechanical maps",
) -> tuple[Path, ...]:
    """Write everything a paper needs of a scan into a folder: figures, their numbers, tables, methods, a page.

    Parameters
    ----------
    folder : str or Path
        Created where it does not exist. In one that exists, files of an earlier report are replaced, those that this
        one has not are removed, and all others stay.
    observables : Dataset
        The scan (y, x) that was inverted; with ``height`` where there is one.
    result : Dataset
        Of `overtone.map_properties` by method ``population``.
    before : Dataset, optional
        The scan as the microscope stored it.
    energies : Dataset, optional
        Result of `overtone.map_energy`.
    curves : Calibrated, optional
        The calibration with its approach curve before and after.
    others : sequence of Dataset
        Results at further set-points of the same area; each with A1 and its probe, or through `with_setpoint`.
    truth : Dataset, optional
        Properties (y, x) that a simulation started from.
    title : str
        What was measured.

    Returns
    -------
    tuple of Path
        The files: every figure as .svg, .pdf, .png and .csv, ``tables.csv`` (materials), ``laws.csv`` (what other laws
        of contact would change, where some were tried), ``metadata.csv``, ``methods.md`` and ``report.html``.

    Raises
    ------
    FileFormatError
        If the folder cannot be written; nothing is left of it then.
    ObservablesError
        If the datasets do not fit each other, are no maps, or a set-point is not known.

    Notes
    -----
    The same input gives the same files, byte for byte, with the same versions of overtone and matplotlib.
    """
    paper = Paper(title, observables, result, before, energies, curves, tuple(others), truth)
    facts = facts_of(observables, result)
    rows, paragraphs = metadata_rows(facts), methods_paragraphs(facts, result)
    figures: list[PaperFigure] = []
    left_out: list[str] = []
    # first, so that a folder that cannot be written is told of before anything is drawn
    with filled_folder(folder, _known_names()) as place:
        for found in paper_figures(paper):
            if isinstance(found, str):
                left_out.append(found)
                continue
            figures.append(found)
            for ending in FORMATS:
                place.write(f"{found.name}.{ending}", picture_bytes(found.figure, ending))
            for beyond, data in found.data.items():
                place.write(
                    f"{found.name}{beyond}.csv", table_text(data, (f"figure: {found.title}",)).encode()
                )
        place.write(TABLES, table_text(material_data(result), ("table: materials",)).encode())
        laws = law_data(result)
        if laws is not None:
            place.write(LAWS, table_text(laws, ("table: other laws of contact",)).encode())
        place.write(METADATA, cells_text(metadata_cells(rows)).encode())
        place.write(METHODS, methods_text(title, paragraphs, left_out).encode())
        place.write(PAGE, _page(paper, figures, left_out, paragraphs, metadata_table(rows)).encode())
    return place.files


def _page(
    paper: Paper,
    figures: Sequence[PaperFigure],
    left_out: Sequence[str],
    paragraphs: Sequence[str],
    metadata: Table,
) -> str:
    """Return the page that shows all."""
    result = paper.result
    calibration = calibration_of(paper.observables) or calibration_of(result)
    tables = [materials_table(result)]
    if calibration is not None:
        made = paper.curves.calibration if paper.curves is not None else calibration
        tables.append(unknown_table(made, calibration if made is not calibration else None))
        if paper.curves is not None and paper.curves.gates:
            tables.append(gate_table(paper.curves.gates, calibration))
    tables.append(metadata)
    verdict = verdict_text(result)
    findings = (
        *([verdict] if verdict else []),
        *provenance.findings(paper.observables),
        *(f"Left out. {sentence}" for sentence in left_out),
    )
    # a whole covariance as text: the tables say that better
    scan, properties = (
        dataset.drop_attrs(deep=False).assign_attrs(
            {k: v for k, v in dataset.attrs.items() if k != "calibration"}
        )
        for dataset in (paper.observables, result)
    )
    rows, columns = result["status"].transpose("y", "x").shape
    report = Report(
        title=paper.title,
        subtitle=f"{columns} x {rows} pixels",
        observables=scan,
        energies=xr.Dataset(),
        properties={_LABEL: properties},
        tables=tuple(tables),
        findings=findings,
    )
    pictures = [
        picture_of(f"Figure {k}: {figure.title}", figure.figure, figure.caption)
        for k, figure in enumerate(figures, start=1)
    ]
    methods = (*paragraphs, *(f"[{k}] {text}" for k, text in enumerate(REFERENCES, start=1)))
    return lay_out(report, pictures, status=(status_shares(report.properties),), methods=methods)


def _known_names() -> frozenset[str]:
    """Return the names of all files that a report may have."""
    pictures = (f"{name}.{ending}" for name in NAMES for ending in FORMATS)
    numbers = (f"{name}{beyond}.csv" for name in NAMES for beyond in ("", *_EXTRA))
    return frozenset((*pictures, *numbers, TABLES, LAWS, METADATA, METHODS, PAGE))
