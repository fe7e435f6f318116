"""What a report says of a calibration and a correction, on the page and on a terminal."""

import io
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from rich.cells import cell_len
from rich.console import Console

import overtone as ot
from overtone.errors import ObservablesError
from overtone.instrument.calibration import Calibration, ReferenceMaterial, format_calibration
from overtone.instrument.gates import Gate
from overtone.instrument.unknowns import NEUTRAL
from overtone.quantities import named_array
from overtone.report.content import Calibrated, Report
from overtone.report.page import write_report
from overtone.report.summary import calibration_tables, gate_table, unknown_table
from overtone.report.terminal import print_report

FREE = 94e-9


@pytest.fixture(scope="module")
def calibration() -> Calibration:
    probe = ot.Probe.simple(
        stiffness=16.4,
        frequency=161.8e3,
        quality_factor=287,
        radius=10e-9,
        drive_frequency=161.8e3,
        free_amplitude=FREE,
    )
    return Calibration(
        probe,
        FREE,
        NEUTRAL | {"A0_offset": 2e-9, "gain0": 1.05, "phi1_offset": 0.1},
        ("A0_offset", "gain0", "phi1_offset"),
        np.diag([1e-12, 0.02, 1e-3]) ** 2,
        reference=ReferenceMaterial("PS", "dmt", 0.35, {"modulus": (2e9, 0.1)}),
        findings=("<script>alert(3)</script> was told.",),
        source="<b>curve</b>.ibw",
    )


@pytest.fixture(scope="module")
def gates() -> tuple[Gate, ...]:
    """Gain stands in the way, although its tolerance is the largest number."""
    tolerance = {"A0_offset": 1e-10, "gain0": 0.001, "phi1_offset": math.inf}
    sensitivity = {"A0_offset": 2.5e9, "gain0": 250.0, "phi1_offset": 0.0}
    return (
        Gate("PS", 1.93e9, 0.42, sensitivity, tolerance, 123.4, math.nan, "contrast", "a reason"),
        Gate("LDPE", 94e6, 0.42, sensitivity, tolerance, 0.3, 0.0876, "relative", "another"),
    )


@pytest.fixture(scope="module")
def curve() -> xr.Dataset:
    z = np.linspace(200e-9, -60e-9, 120)
    A = np.minimum(FREE, FREE + 0.9 * z)
    phase = {"A1": A, "phi1": np.arcsin(A / FREE)}
    return xr.Dataset({n: named_array(n, v, ("z",), {"z": z}) for n, v in phase.items()}, coords={"z": z})


@pytest.fixture(scope="module")
def corrected_report(
    report: Report, calibration: Calibration, gates: tuple[Gate, ...], curve: xr.Dataset
) -> Report:
    """The report of a scan that was corrected: zero and phase have moved since the calibration."""
    left = replace(
        calibration,
        values={**calibration.values, "A0_offset": 2.3e-9},
        covariance=np.diag([4e-12, 0.02, 5e-3]) ** 2,
    )
    scan = report.observables.assign_attrs(calibration=format_calibration(left))
    before = report.observables.assign(phi1=report.observables["phi1"] + 0.1)
    known = Calibrated(calibration, curve, curve, gates=gates)
    return replace(report, observables=scan, before=before, calibration=known)


def written(report: Report, folder: Path) -> str:
    return write_report(report, folder / "report.html").read_text(encoding="utf-8")


def test_the_unknown_that_stands_in_the_way_comes_first(
    gates: tuple[Gate, ...], calibration: Calibration
) -> None:
    table = gate_table(gates, calibration)
    first, second = table.rows
    assert first[:6] == ("PS", "1.93 GPa", "0.42", "contrast", "123", "-")
    assert second[:6] == ("LDPE", "94 MPa", "0.42", "relative", "0.3", "0.088")
    # 2 % of 0.1 %, then 1 pm of 100 pm; a phase that does nothing has no tolerance
    assert first[6] == "gain0 to 0.1 % (is 2 %); A0 offset to 100 pm (is 1 pm)"
    assert len(table.columns) == len(first)
    assert "0.25" in table.note


def test_only_the_tightest_tolerances_are_quoted(calibration: Calibration, gates: tuple[Gate, ...]) -> None:
    names = ("A0_offset", "gain0", "phi1_offset", "compression")
    errors = np.array([1e-12, 0.02, 1e-3, 0.01])
    wider = replace(calibration, names=names, covariance=np.diag(errors**2))
    gate = replace(gates[0], tolerance=dict(zip(names, errors / [1.0, 2.0, 3.0, 4.0], strict=True)))
    (row,) = gate_table((gate,), wider).rows
    assert [part.split(" to ")[0] for part in row[6].split("; ")] == ["compression", "phi1 offset", "gain0"]


def test_unknowns_before_the_scan_and_as_applied(corrected_report: Report, calibration: Calibration) -> None:
    table = calibration_tables(corrected_report)[0]
    assert table.columns == ("unknown", "calibrated on PS", "error", "applied to the scan", "error left")
    zero = next(row for row in table.rows if row[0].startswith("A0: zero"))
    assert zero[1:] == ("2 nm", "1 pm", "2.3 nm", "4 pm")
    alone = unknown_table(calibration)
    assert alone.columns == ("unknown", "calibrated on PS", "error")
    assert {len(row) for row in alone.rows} == {3}
    assert "A_ref is 94 nm" in alone.note
    assert "gains and latency are not known" in unknown_table(replace(calibration, reference=None)).note


def test_the_page_has_a_section_with_tables_findings_and_both_figures(
    corrected_report: Report, tmp_path: Path
) -> None:
    text = written(corrected_report, tmp_path)
    headings = ("Findings", "Results", "What the pixels", "Calibration and correction", "Figures", "Metadata")
    places = [text.index(f"<h2>{heading}") for heading in headings]
    assert places == sorted(places)
    section = text[places[3] : places[4]]
    assert section.count("<img") == 2
    assert text.count("<img") == 6 + 2
    for words in (
        "Approach curve before and after",
        "Scan before and after",
        "What the calibration supports",
        "2.3 nm",
    ):
        assert words in section
    assert "&lt;script&gt;alert(3)" in section
    assert "&lt;b&gt;curve&lt;/b&gt;.ibw" in section
    assert "Corrected observables" in text
    assert "correlations" not in text  # the covariance is not a text for readers


def test_a_calibration_from_a_file_has_no_curve_and_no_gates(
    corrected_report: Report, tmp_path: Path
) -> None:
    known = corrected_report.calibration
    assert known is not None
    text = written(replace(corrected_report, calibration=Calibrated(known.calibration)), tmp_path)
    assert "Approach curve before and after" not in text
    assert "Scan before and after" in text
    assert "What the calibration supports" not in text
    assert "The instrument" in text


def test_without_a_calibration_nothing_is_added(report: Report, tmp_path: Path) -> None:
    text = written(report, tmp_path)
    assert "Calibration and correction" not in text
    assert "What the microscope recorded" in text
    assert calibration_tables(report) == ()


def test_a_scan_before_that_is_another_is_refused(corrected_report: Report, tmp_path: Path) -> None:
    before = corrected_report.before
    assert before is not None
    with pytest.raises(ObservablesError, match="do not fit"):
        written(replace(corrected_report, before=before.isel(x=slice(0, 2))), tmp_path)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("width", [70, 100])
def test_the_terminal_prints_the_same_tables(corrected_report: Report, width: int) -> None:
    buffer = io.StringIO()
    print_report(corrected_report, Console(file=buffer, width=width))
    text = buffer.getvalue()
    assert max(cell_len(line) for line in text.splitlines()) <= width
    titles = (
        "Findings\n",
        "Findings of the calibration",
        "Modulus",
        "The instrument",
        "What the calibration supports",
    )
    places = [text.index(title) for title in titles]
    assert places == sorted(places)
    assert "123" in text
    assert "contrast" in text
