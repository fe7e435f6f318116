"""A report on a terminal: findings, tables and what the pixels can be trusted for."""

from __future__ import annotations

from collections.abc import Sequence

from rich import box
from rich.cells import cell_len
from rich.console import Console
from rich.padding import Padding
from rich.table import Table as RichTable
from rich.text import Text

from overtone.report.content import Report, Table
from overtone.report.shares import status_shares
from overtone.report.validity import validity_tables

_WIDEST = 100
_GAP = 2


def print_report(report: Report, console: Console | None = None) -> None:
    """Print findings, tables and shares of status.

    Parameters
    ----------
    report : Report
        What to show.
    console : Console, optional
        Where to; standard output where not given.

    Notes
    -----
    Texts of a file are printed as they are: neither markup nor control characters in them take effect.
    """
    console = console or Console()
    width = min(console.width, _WIDEST)
    console.print(_plain(report.title, "bold"), width=width)
    if report.subtitle:
        console.print(_plain(report.subtitle), width=width)
    if report.findings:
        console.print()
        console.print(Text("Findings", style="bold"), width=width)
        console.print(_findings(report.findings), width=width)
    if report.calibration is not None and report.calibration.calibration.findings:
        console.print()
        console.print(Text("Findings of the calibration", style="bold"), width=width)
        console.print(_findings(report.calibration.calibration.findings), width=width)
    for table in (*report.tables, *_calibration_tables(report)):
        print_table(table, console)
    if report.properties:
        console.print()
        console.print(_table(status_shares(report.properties), width), width=width)
    for table in validity_tables(report.properties):
        print_table(table, console)


def print_table(table: Table, console: Console) -> None:
    """Print a table with its note, as wide as the console and its words allow."""
    width = min(console.width, _WIDEST)
    console.print()
    console.print(_table(table, width), width=width)
    if table.note:
        console.print(Padding(_plain(table.note, "italic"), (0, 0, 0, 1)), width=width)


def _calibration_tables(report: Report) -> tuple[Table, ...]:
    if report.calibration is None:
        return ()
    from overtone.report.summary import calibration_tables  # brings the contact models with it

    return calibration_tables(report)


def _findings(findings: tuple[str, ...]) -> RichTable:
    grid = RichTable.grid(padding=(0, 1))
    grid.add_column(width=2, justify="right")
    grid.add_column(overflow="fold")
    for finding in findings:
        grid.add_row(Text("-"), _plain(finding))
    return grid


def _table(table: Table, width: int) -> RichTable:
    if _widths(table, width) is None and _widths(_turned(table), width) is not None:
        table = _turned(table)
    laid_out = RichTable(
        title=_plain(table.title, "bold"),
        title_justify="left",
        title_style="",
        box=box.SIMPLE_HEAD,
        pad_edge=False,
        padding=(0, _GAP - 1, 0, 0),
    )
    widths: Sequence[int | None] = _widths(table, width) or [None] * len(table.columns)
    for column, wide in zip(table.columns, widths, strict=True):
        laid_out.add_column(_plain(column, "bold"), overflow="fold", width=wide)
    for row in table.rows:
        laid_out.add_row(*(_plain(cell) for cell in row))
    return laid_out


def _turned(table: Table) -> Table:
    """Return the table with rows and columns exchanged: many columns of few rows fit better so."""
    first, *others = zip(table.columns, *table.rows, strict=True)
    return Table(table.title, first, tuple(others), table.note)


def _widths(table: Table, width: int) -> list[int] | None:
    """Return column widths that break no word, None where there are none.

    Left to itself, rich takes from the widest column only, until there is no room for its words.
    """
    columns = list(zip(table.columns, *table.rows, strict=True))
    lines = [max(cell_len(cell) for cell in column) for column in columns]
    words = [max(cell_len(word) for cell in column for word in [*cell.split(), ""]) for column in columns]
    spare = width - _GAP * len(columns) - sum(words)
    if spare < 0:
        return None
    # The least needy first: a number with its unit stays on one line, and prose gets what is left.
    needs = sorted(range(len(words)), key=lambda i: lines[i] - words[i])
    for left, i in zip(range(len(needs), 0, -1), needs, strict=True):
        given = min(lines[i] - words[i], spare // left)
        words[i] += given
        spare -= given
    return words


def _plain(text: str, style: str = "") -> Text:
    """Return text in which nothing is an instruction: no markup, and no sequence a terminal obeys."""
    return Text("".join(c if c.isprintable() or c == "\n" else "\ufffd" for c in text), style=style)
