import io

import pytest
from rich.cells import cell_len
from rich.console import Console

from overtone.report.content import Report, Table
from overtone.report.terminal import print_report


def printed(report: Report, width: int = 80, **options) -> str:
    buffer = io.StringIO()
    print_report(report, Console(file=buffer, width=width, **options))
    return buffer.getvalue()


@pytest.mark.parametrize("width", [60, 80, 100, 200])
def test_everything_is_printed_within_the_width(report, width):
    text = printed(report, width)
    assert max(cell_len(line) for line in text.splitlines()) <= min(width, 100)
    for table in report.tables:
        for cell in (table.title, *table.columns, *(cell for row in table.rows for cell in row)):
            assert cell in text
    assert "A note." in text
    assert "66.7 %" in text


def test_texts_of_a_file_are_printed_as_they_are(report):
    text = printed(report, 100, force_terminal=True, color_system="truecolor")
    assert "[bold]Not markup[/bold]" in text
    assert "[red]subtitle[/red]" in text
    assert "\x1b[31m" not in text


def test_findings_come_first(report):
    text = printed(report)
    assert text.index("Findings") < text.index("Modulus") < text.index("Share of pixels")


def wide(report: Report, rows: int) -> Report:
    columns = (
        "material",
        "harmonics",
        "determined",
        "uncertainty",
        "amplification",
        "indentation",
        "undetermined",
    )
    cells = ("polystyrene", "0, 1, 2", "0.1 %", "1.93 GPa", "12000", "2.67 nm", "99.9 %")
    return Report(
        "t", "", report.observables, report.energies, tables=(Table("Wide", columns, (cells,) * rows),)
    )


def test_a_table_too_wide_is_turned_rather_than_broken_within_words(report):
    lines = printed(wide(report, 2)).splitlines()
    row = next(line for line in lines if "undetermined" in line)
    assert row.split() == ["undetermined", "99.9", "%", "99.9", "%"]


def test_a_table_that_fits_keeps_its_lines(report):
    assert "polystyrene  0, 1, 2    0.1 %       1.93 GPa" in printed(wide(report, 9), 100)
