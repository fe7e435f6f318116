"""A report on a terminal: findings, tables and what the pixels can be trusted for."""

from __future__ import annotations

from rich import box
from rich.console import Console
from rich.padding import Padding
from rich.table import Table as RichTable
from rich.text import Text

from overtone.report.content import Report, Table
from overtone.report.shares import flag_shares, format_share

_WIDEST = 100


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
    for table in report.tables:
        console.print()
        console.print(_table(table), width=width)
        if table.note:
            console.print(Padding(_plain(table.note, "italic"), (0, 0, 0, 1)), width=width)
    if report.properties:
        console.print()
        console.print(_table(_status(report)), width=width)


def _findings(findings: tuple[str, ...]) -> RichTable:
    grid = RichTable.grid(padding=(0, 1))
    grid.add_column(width=2, justify="right")
    grid.add_column(overflow="fold")
    for finding in findings:
        grid.add_row(Text("•"), _plain(finding))
    return grid


def _table(table: Table) -> RichTable:
    laid_out = RichTable(
        title=_plain(table.title, "bold"),
        title_justify="left",
        title_style="",
        box=box.SIMPLE_HEAD,
        pad_edge=False,
    )
    for column in table.columns:
        laid_out.add_column(_plain(column, "bold"), overflow="fold")
    for row in table.rows:
        laid_out.add_row(*(_plain(cell) for cell in row))
    return laid_out


def _status(report: Report) -> Table:
    """Return the shares of status side by side; what no pixel is stays out."""
    shares = {label: flag_shares(result["status"]) for label, result in report.properties.items()}
    meanings = dict.fromkeys(
        meaning
        for result in shares.values()
        for meaning, share in result.items()
        if share > 0.0 or meaning == "determined"
    )
    rows = (
        (meaning, *(format_share(result.get(meaning, 0.0)) for result in shares.values()))
        for meaning in meanings
    )
    return Table("Share of pixels", ("status", *shares), tuple(rows))


def _plain(text: str, style: str = "") -> Text:
    """Return text in which nothing is an instruction: no markup, and no sequence a terminal obeys."""
    return Text("".join(c if c.isprintable() or c == "\n" else "\ufffd" for c in text), style=style)
