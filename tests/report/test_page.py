import base64
import re
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
import xarray as xr

from overtone.errors import FileFormatError
from overtone.report import page
from overtone.report.content import Report
from overtone.report.page import write_report

VOID = {"meta", "img", "br", "hr", "link", "input"}


class Document(HTMLParser):
    """What a browser would find: tags, attributes, texts, and whether tags close in order."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.stack: list[str] = []
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.cells: list[str] = []
        self.texts: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))
        if tag not in VOID:
            self.stack.append(tag)
        if tag in ("td", "th"):
            self.cells.append("")

    def handle_endtag(self, tag):
        assert self.stack.pop() == tag

    def handle_data(self, data):
        self.texts.append(data)
        if self.stack and self.stack[-1] in ("td", "th"):
            self.cells[-1] += data


@pytest.fixture(scope="module")
def written(report: Report, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("report") / "report.html"
    assert write_report(report, str(path)) == path
    return path


@pytest.fixture(scope="module")
def document(written: Path) -> Document:
    return Document(written.read_text(encoding="utf-8"))


def test_the_page_is_well_formed(document):
    assert document.stack == []
    assert document.tags[0][0] == "html"


def test_every_cell_and_finding_is_there(document, report):
    for table in report.tables:
        for cell in (*table.columns, *(cell for row in table.rows for cell in row)):
            assert cell in document.cells
    text = "\n".join(document.texts)
    for sentence in (*report.findings, report.title, report.subtitle, "A note."):
        assert sentence in text


def test_findings_come_before_tables_and_figures(written):
    text = written.read_text(encoding="utf-8")
    places = [
        text.index(f"<h2>{h}") for h in ("Findings", "Results", "What the pixels", "Figures", "Metadata")
    ]
    assert places == sorted(places)


def test_texts_of_a_file_stay_texts(written, document):
    tags = [tag for tag, _ in document.tags]
    assert "script" not in tags
    assert "b" not in tags
    assert "&lt;script&gt;alert(2)" in written.read_text(encoding="utf-8")
    assert all(str(attrs["src"]).startswith("data:") for tag, attrs in document.tags if tag == "img")


def test_nothing_is_loaded_from_elsewhere(written, document):
    links = [attrs[name] for _, attrs in document.tags for name in ("src", "href") if name in attrs]
    assert not [link for link in links if not str(link).startswith("data:")]
    assert not re.search(r"(src|href)\s*=\s*.?https?://|@import|url\(", written.read_text(encoding="utf-8"))


def test_figures_are_embedded_with_captions(document):
    images = [attrs for tag, attrs in document.tags if tag == "img"]
    assert len(images) == 6  # overview, observables, forces, energy, properties, histograms
    for attributes in images:
        kind, data = str(attributes["src"]).split(",", 1)
        assert kind == "data:image/png;base64"
        assert base64.b64decode(data, validate=True).startswith(b"\x89PNG")
        assert attributes["alt"]
    text = "\n".join(document.texts)
    assert "N_r is no evidence" in text
    assert "the data do not determine the value" in text


def test_status_is_summed_up(document):
    at = document.cells.index("not determined by these data")
    assert document.cells[at + 1] == "66.7 %"


def test_history_tells_each_step_and_each_probe_once(document, report):
    text = "\n".join(document.texts)
    for operation in ("open_scan", "map_energy", "map_properties"):
        assert operation in text
    probe = report.observables.attrs["probe"]
    assert text.count(probe) == 1
    assert "as above" in text
    assert "dmt-linear" in text


def test_version_and_date(document):
    assert re.search(r"Written by overtone \S+ on \d{4}-\d\d-\d\d", " ".join(document.texts))


def test_a_report_of_a_curve_without_modulus_or_findings(report, tmp_path):
    line = {"y": 0}
    short = Report("curve", "", report.observables.isel(line), report.energies.isel(line))
    text = write_report(short, tmp_path / "curve.html").read_text(encoding="utf-8")
    assert "<h2>Findings" not in text
    assert text.count("<img") == 3


def test_odd_attributes_do_not_stop_a_report(report, tmp_path):
    attributes = {"array": np.arange(3), "history": '["text", {"arguments": 3}]', "nested": '["a\\nb"]'}
    odd = report.observables.assign_attrs(attributes)
    text = write_report(Report("odd", "", odd, xr.Dataset()), tmp_path / "odd.html").read_text(
        encoding="utf-8"
    )
    assert "array" in text
    assert "no data" not in text


def test_a_failed_write_leaves_the_old_file_and_nothing_else(report, tmp_path, monkeypatch):
    path = tmp_path / "report.html"
    path.write_text("old", encoding="utf-8")

    def fail(_: Report) -> str:
        raise RuntimeError("halfway")

    monkeypatch.setattr(page, "render", fail)
    with pytest.raises(RuntimeError, match="halfway"):
        write_report(report, path)
    assert [p.name for p in tmp_path.iterdir()] == ["report.html"]
    assert path.read_text(encoding="utf-8") == "old"


def test_a_folder_that_does_not_exist_is_told_before_anything_is_drawn(report, tmp_path, monkeypatch):
    monkeypatch.setattr(page, "render", lambda _: pytest.fail("drawn for nothing"))
    with pytest.raises(FileFormatError, match="existing folder"):
        write_report(replace(report, title="x"), tmp_path / "absent" / "report.html")
