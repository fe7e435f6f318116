"""A report as one HTML file that needs nothing else."""

from __future__ import annotations

import base64
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib.resources import files
from pathlib import Path
from typing import Any

import xarray as xr
from jinja2 import Environment, StrictUndefined
from matplotlib.figure import Figure

from overtone import plots, provenance
from overtone._version import __version__
from overtone.io.atomic import atomic_path
from overtone.plots.phases import phases_figure
from overtone.plots.prediction import prediction_figure
from overtone.report import captions
from overtone.report.content import Report, Table
from overtone.report.results import EXACT, LEAST_SQUARES, POSTERIOR, is_pooled, method_of, undetermined
from overtone.report.shares import status_shares
from overtone.report.validity import validity_in, validity_tables

_Pairs = tuple[tuple[str, str], ...]
_SHOWN_ELSEWHERE = ("history", "findings")


def write_report(report: Report, path: str | Path) -> Path:
    """Write a report as one self-contained HTML file, whole or not at all.

    Parameters
    ----------
    report : Report
        What to show.
    path : str or Path
        Where to; an existing file is replaced.

    Returns
    -------
    Path
        The file written.

    Raises
    ------
    FileFormatError
        If the folder does not exist or the file cannot be written.
    """
    path = Path(path)
    with atomic_path(path) as temporary:
        temporary.write_text(render(report), encoding="utf-8")
    return path


def render(report: Report) -> str:
    """Return the HTML text of a report; everything in it that came from a file is escaped."""
    return lay_out(
        report,
        list(_pictures(report)),
        calibration=_calibration(report),
        status=(status_shares(report.properties), *validity_tables(report.properties))
        if report.properties
        else (),
        date=datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC"),
    )


def lay_out(
    report: Report,
    figures: Sequence[Picture],
    *,
    calibration: _Calibration | None = None,
    status: Sequence[Table] = (),
    methods: Sequence[str] = (),
    date: str = "",
) -> str:
    """Return the HTML text of a page: texts, tables, metadata and history of a report, with these figures.

    Parameters
    ----------
    report : Report
        Whose findings, tables and datasets are told of.
    figures : sequence of Picture
        In the order to be seen.
    calibration : optional
        What is said of calibration and correction.
    status : sequence of Table
        What the pixels can be trusted for.
    methods : sequence of str
        Paragraphs on how the results were made.
    date : str
        When; left out where not given.
    """
    environment = Environment(
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    source = files("overtone.report").joinpath("page.html.j2").read_text(encoding="utf-8")
    return environment.from_string(source).render(
        report=report,
        figures=figures,
        calibration=calibration,
        status=status,
        methods=methods,
        records=list(_records(report)),
        version=__version__,
        date=date,
    )


@dataclass(frozen=True)
class Picture:
    """A figure as it stands in the page."""

    title: str
    caption: str
    source: str


@dataclass(frozen=True)
class _Calibration:
    """What the page says of a calibration and a correction."""

    source: str
    findings: tuple[str, ...]
    tables: tuple[Table, ...]
    figures: tuple[Picture, ...]


def _calibration(report: Report) -> _Calibration | None:
    """Return what there is to say of the calibration and the correction, None where there was none."""
    known = report.calibration
    figures = []
    if known is not None and known.raw is not None and known.corrected is not None:
        figure = plots.calibration_figure(known.raw, known.corrected, known.calibration, known.far_field)
        figures.append(picture_of("Approach curve before and after", figure, captions.CURVE))
    if report.before is not None:
        figure = plots.correction_figure(report.before, report.observables)
        figures.append(picture_of("Scan before and after", figure, captions.SCAN))
    if known is None:
        return _Calibration("", (), (), tuple(figures)) if figures else None
    from overtone.report.summary import calibration_tables

    return _Calibration(
        known.calibration.source, known.calibration.findings, calibration_tables(report), tuple(figures)
    )


def _pictures(report: Report) -> Iterator[Picture]:
    if report.properties:
        yield picture_of(
            "At a glance",
            plots.overview_figure(report),
            _glance(report),
        )
    yield picture_of(
        "Observables",
        plots.observables_figure(report.observables),
        ("What the microscope recorded" if report.before is None else "Corrected observables")
        + "; colours run from the 2nd to the 98th percentile in every map.",
    )
    yield picture_of(
        "Force harmonics",
        plots.forces_figure(report.energies),
        "Fourier coefficients of the force on the tip, conservative (cosine) and dissipative (sine).",
    )
    yield picture_of(
        "Energy",
        plots.energy_figure(report.energies),
        "Energy lost per cycle and virial, which follow from amplitude and phase alone, without a contact model.",
    )
    for label, result in report.properties.items():
        yield from _property_pictures(label, result, report)


def _glance(report: Report) -> str:
    text = "What was measured, the modulus concluded from it, and how many decades of modulus fit the data at 90 %. "
    stepped = any(method_of(result) != LEAST_SQUARES for result in report.properties.values())
    return f"{text}{captions.GREY}" + (f" {captions.STEPS}" if stepped else "")


def _property_pictures(label: str, result: xr.Dataset, report: Report) -> Iterator[Picture]:
    """Yield what there is to see of one inversion, with the words of its method."""
    method = method_of(result)
    caption = {POSTERIOR: captions.INTERVALS, EXACT: captions.SOLUTIONS}.get(method, captions.ESTIMATES)
    if method != LEAST_SQUARES and bool(undetermined(result).all()):
        caption = f"{captions.NOWHERE} {caption}"
    yield picture_of(f"Properties from {label}", plots.properties_figure(label, result), caption)
    if method == POSTERIOR:
        yield picture_of(f"Certainty from {label}", plots.certainty_figure(label, result), captions.CERTAINTY)
    if is_pooled(result):
        yield picture_of(f"Phases from {label}", phases_figure(result), captions.PHASES)
        if result.sizes["material"] and result.sizes.get("row", 0):
            yield picture_of(f"Predictive check from {label}", prediction_figure(result), captions.CHECK)
    if validity_in(result):
        yield picture_of(f"Validity from {label}", plots.validity_figure(label, result), captions.VALIDITY)
    yield picture_of(
        f"Distributions from {label}",
        plots.histogram_figure(label, result, report.truth, report.materials),
        captions.BARS if method == POSTERIOR else captions.COUNTS,
    )


def picture_of(title: str, figure: Figure, caption: str) -> Picture:
    """Return a figure as it stands in the page, its picture within the text."""
    data = base64.b64encode(plots.png_bytes(figure)).decode("ascii")
    return Picture(title, caption, f"data:image/png;base64,{data}")


@dataclass(frozen=True)
class _Step:
    """One entry of a history; texts of several lines, such as a probe, stand on their own."""

    operation: str
    version: str
    arguments: _Pairs
    texts: _Pairs


@dataclass(frozen=True)
class _Record:
    """What a dataset tells about itself beyond what the observables have already told."""

    title: str
    attributes: _Pairs
    texts: _Pairs
    continues: bool
    steps: tuple[_Step, ...]


def _records(report: Report) -> Iterator[_Record]:
    datasets = {"Observables": report.observables}
    if report.energies.data_vars:
        datasets["Forces and energies"] = report.energies
    datasets |= {f"Properties from {label}": result for label, result in report.properties.items()}
    if report.truth is not None:
        datasets["Truth of the simulation"] = report.truth
    known = report.observables
    shown: set[str] = set()
    # a whole covariance as text: where there is a section on the calibration, that says it better
    elsewhere = (*_SHOWN_ELSEWHERE, *(("calibration",) if report.calibration is not None else ()))
    for title, dataset in datasets.items():
        first = dataset is known
        past = [] if first else provenance.history(known)
        entries = provenance.history(dataset)
        continues = bool(past) and entries[: len(past)] == past
        attributes = {
            key: value
            for key, value in dataset.attrs.items()
            if key not in elsewhere and (first or _text(known.attrs.get(key)) != _text(value))
        }
        short, long = _laid_out(attributes, shown)
        steps = tuple(_step(entry, shown) for entry in entries[len(past) if continues else 0 :])
        yield _Record(title, short, long, continues, steps)


def _step(entry: Any, shown: set[str]) -> _Step:
    if not isinstance(entry, dict):
        return _Step(_text(entry), "", (), ())
    given = entry.get("arguments", {})
    short, long = _laid_out(given if isinstance(given, dict) else {"arguments": given}, shown)
    return _Step(_text(entry.get("operation", "?")), _text(entry.get("overtone", "")), short, long)


def _laid_out(given: Mapping[Any, Any], shown: set[str]) -> tuple[_Pairs, _Pairs]:
    """Part texts of several lines from short ones; a text that was shown before is named, not repeated."""
    short, long = [], []
    for name, value in given.items():
        text = _text(value)
        if "\n" not in text:
            short.append((str(name), text))
        elif text in shown:
            short.append((str(name), "as above"))
        else:
            shown.add(text)
            long.append((str(name), text))
    return tuple(short), tuple(long)


def _text(value: Any) -> str:
    """Return a value as text; line breaks inside of JSON are broken where a reader expects them."""
    text = value if isinstance(value, str) else json.dumps(value, default=str, ensure_ascii=False)
    return text.replace("\\n", "\n").replace('\\"', '"') if text[:1] in ("[", "{") and "\\n" in text else text
