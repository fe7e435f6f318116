"""``overtone inspect``."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from rich.console import Console, Group, RenderableType
from rich.padding import Padding
from rich.table import Table
from rich.text import Text

from overtone.cli.options import ScanOptions, reading_arguments
from overtone.units import format_quantity, parse_quantity

if TYPE_CHECKING:
    from overtone.inspection.records import Ask, Inspection, Verdict

_WIDEST = 100
_LONGEST_KEY = 30
_LONGEST_NAME = 20
_USES = {"A0": "deflection", "A1": "amplitude", "phi1": "phase"}
_COLOURS = {"yes": "green", "no": "red"}
_UNBROKEN = ("unit", "mean", "range", "value", "line")


def inspect(file: Path, /, *, scan: ScanOptions = ScanOptions()) -> None:  # noqa: B008 - a frozen record
    """Say what a file holds, what is missing, what to ask the operator for, and what it can give.

    Parameters
    ----------
    file : Path
        Scan, video, curve or table of a microscope, or a result of overtone.
    scan : ScanOptions
        What is known already of how the file is to be read.
    """
    from overtone.inspection.scan import inspect_scan

    radius = parse_quantity(scan.radius, "m", "--radius") if scan.radius else None
    inspection = inspect_scan(
        file, direction=scan.direction, frame=scan.frame, radius=radius, **reading_arguments(scan)
    )
    console = Console(highlight=False)
    page = Group(*_parts(inspection))
    width = min(console.width, _WIDEST)
    if console.is_terminal:
        console.print(page, width=width)
        return
    with console.capture() as captured:
        console.print(page, width=width)
    plain = "\n".join(line.rstrip() for line in captured.get().splitlines())
    console.print(plain, markup=False, soft_wrap=True)


def _parts(inspection: Inspection) -> Iterator[RenderableType]:
    """Yield what is to be printed, from what was found to what it can give."""
    yield _plain(f"{inspection.path.name}: {inspection.format}", "bold")
    yield _plain(inspection.headline)
    if inspection.channels:
        yield from _channels(inspection)
    if inspection.properties:
        yield from _properties(inspection)
    if inspection.settings:
        yield _title("Instrument")
        rows = [(row.name, row.text, _short(row.key), row.remark) for row in inspection.settings]
        yield _table(("setting", "value", "in the file", "remark"), rows)
    for title, texts in (("Noticed", inspection.remarks), ("How it was made", inspection.made_by)):
        if texts:
            yield _title(title)
            yield _list([_plain(text) for text in texts])
    if inspection.missing:
        yield _title("Missing")
    for purpose in dict.fromkeys(row.purpose for row in inspection.missing):
        found = [row for row in inspection.missing if row.purpose == purpose]
        yield _plain(f"for {purpose}")
        yield _list([_plain(f"{row.what}: {row.remark}" if row.remark else row.what) for row in found])
    if inspection.asks:
        yield _title("Ask for, or do next time")
        yield _list([_ask(ask) for ask in inspection.asks], numbered=True)
    if inspection.probe_file:
        yield _title("probe.toml, to complete")
        file = _plain(inspection.probe_file.rstrip("\n"))
        file.no_wrap, file.overflow = True, "ignore"  # to be copied
        yield Padding(file, (0, 0, 0, 4))
    if inspection.verdicts:
        yield _title("What it can give")
        yield _list(list(_verdicts(inspection.verdicts)))


def _channels(inspection: Inspection) -> Iterator[RenderableType]:
    from overtone.inspection.tables import numbers_text

    ways = {row.direction for row in inspection.channels}
    one = next(iter(ways)) if len(ways) == 1 else None
    rows = []
    for row in inspection.channels:
        unit, mean, span = numbers_text(row)
        line = "" if one else row.direction or ""
        rows.append((row.name, unit, line, _USES.get(row.used_as, row.used_as), mean, span, row.remark))
    yield _title(f"Channels ({one})" if one else "Channels")
    yield _table(("channel", "unit", "line", "used as", "mean", "range", "remark"), rows)


def _properties(inspection: Inspection) -> Iterator[RenderableType]:
    rows = [
        (
            row.name.replace("_", " "),
            format_quantity(row.median, row.unit),
            _interval(row.low, row.high, row.unit),
            _interval(row.lower, row.upper, row.unit),
            f"{100.0 * row.share:.3g} %",
        )
        for row in inspection.properties
    ]
    yield _title("Properties")
    yield _table(("property", "median", "5 .. 95 % of pixels", "90 % interval of a pixel", "pixels"), rows)


def _interval(low: float, high: float, unit: str) -> str:
    ends = format_quantity(low, unit), format_quantity(high, unit)
    return "" if "-" in ends else " .. ".join(ends)


def _ask(ask: Ask) -> Text:
    text = ask.sentence
    if ask.later:
        text = f"Next time: {text[0].lower()}{text[1:]}"
    return _plain(text) + _plain(f"  {ask.option}", "bold") if ask.option else _plain(text)


def _merged(verdicts: Sequence[Verdict]) -> list[tuple[str, Verdict]]:
    """Return the verdicts with their questions, those of the modulus together where they are the same."""
    merged: list[tuple[str, Verdict]] = []
    for verdict in verdicts:
        subject, _, kind = verdict.question.rpartition(", ")
        last = merged[-1] if merged else None
        same = last is not None and (verdict.answer, verdict.lacking, verdict.reason) == (
            last[1].answer,
            last[1].lacking,
            last[1].reason,
        )
        if subject and last is not None and same and last[0].startswith(f"{subject}, "):
            merged[-1] = (f"{last[0]} / {kind}", last[1])
        else:
            merged.append((verdict.question, verdict))
    return merged


def _verdicts(verdicts: Sequence[Verdict]) -> Iterator[Text]:
    said = ""
    for question, verdict in _merged(verdicts):
        shown = verdict
        if verdict.answer == "no" and verdict.reason == said:
            shown = replace(verdict, reason="For the same reason.")
        said = verdict.reason
        text = _plain(shown.sentence().removeprefix(f"{verdict.question}: "))
        text.stylize(f"bold {_COLOURS.get(verdict.answer, 'yellow')}", 0, len(verdict.answer))
        yield _plain(f"{question}: ") + text


# --- how it looks ---------------------------------------------------------------------------------


def _title(text: str) -> Text:
    return Text("\n") + _plain(text, "bold")


def _table(headings: Sequence[str], rows: Iterable[Sequence[str]]) -> Table:
    """Return a table without lines, columns that are empty left out."""
    columns = [column for column in zip(headings, *rows, strict=True) if any(column[1:])]
    table = Table(box=None, pad_edge=False, padding=(0, 2, 0, 0))
    for heading, *texts in columns:
        short = heading == "channel" and max(map(len, texts)) <= _LONGEST_NAME
        table.add_column(_plain(heading, "dim"), overflow="fold", no_wrap=short or heading in _UNBROKEN)
    for cells in zip(*(column[1:] for column in columns), strict=True):
        table.add_row(*map(_plain, cells))
    return table


def _list(texts: Sequence[Text], *, numbered: bool = False) -> Table:
    grid = Table.grid(padding=(0, 1))
    grid.add_column(width=3 if numbered else 2, justify="right")
    grid.add_column(overflow="fold")
    for k, text in enumerate(texts, start=1):
        grid.add_row(Text(f"{k}." if numbered else "-"), text)
    return grid


def _short(key: str) -> str:
    """Return long dotted keys without what stands before their last parts."""
    words = []
    for word in key.split(" "):
        kept = word
        while len(kept) > _LONGEST_KEY and "." in kept:
            kept = kept.split(".", 1)[1]
        words.append(kept if kept == word else f"...{kept}")
    return " ".join(words)


def _plain(text: str, style: str = "") -> Text:
    """Return text in which nothing is an instruction: no markup, and no sequence that a terminal obeys."""
    return Text("".join(c if c.isprintable() or c == "\n" else "\ufffd" for c in text), style=style)
