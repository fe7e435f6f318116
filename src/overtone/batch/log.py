"""What became of each file of a batch, for people and for programs."""

from __future__ import annotations

import csv
import io
import json
import secrets
from collections.abc import Mapping, Sequence
from pathlib import Path

from overtone._version import __version__
from overtone.batch.one import FAILED, KEPT, MAPPED, NOT_REACHED, Outcome
from overtone.batch.record import path_from
from overtone.report.content import Table
from overtone.units import format_quantity

NAMES = "batch.csv", "batch.json"
_MOST_ROWS = 60
_COLUMNS = ("file", "result", "state", "why", "seconds", "pixels", "determined", "modulus_median_Pa")


def write_log(outcomes: Sequence[Outcome], out_dir: Path, work: Path, settings: Mapping[str, str]) -> None:
    """Write ``batch.csv`` and ``batch.json``, each whole; where they cannot be written, results still stand.

    Parameters
    ----------
    outcomes : sequence of Outcome
        One a file.
    out_dir, work : Path
        Where to, and where it is made.
    settings : mapping of str to str
        That are not the default.
    """
    rows = [_row(outcome, out_dir) for outcome in outcomes]
    table = io.StringIO()
    writer = csv.DictWriter(table, _COLUMNS, lineterminator="\n", extrasaction="ignore")
    writer.writeheader()
    writer.writerows(rows)
    whole = {"overtone": __version__, "settings": dict(settings), "files": rows}
    for name, text in zip(NAMES, (table.getvalue(), json.dumps(whole, indent=1)), strict=True):
        temporary = work / f"{secrets.token_hex(8)}.log"
        try:
            temporary.write_text(text, encoding="utf-8")
            temporary.replace(out_dir / name)
        except OSError:  # such as a table that is open in Excel
            temporary.unlink(missing_ok=True)


def _row(outcome: Outcome, out_dir: Path) -> dict[str, object]:
    summary = outcome.summary or {}
    row: dict[str, object] = {
        "file": path_from(out_dir, outcome.file),
        "result": outcome.result.name if outcome.state in (MAPPED, KEPT) else "",
        "state": outcome.state,
        "why": outcome.why,
        "seconds": round(outcome.seconds, 3),
        "pixels": summary.get("pixels"),
        "determined": summary.get("determined"),
        "modulus_median_Pa": summary.get("modulus"),
    }
    return row | ({"traceback": outcome.traceback} if outcome.traceback else {})


def batch_table(outcomes: Sequence[Outcome]) -> Table:
    """Return the table that ends a batch: files, what became of them and why; of very many only what is unusual."""
    counts = {state: sum(o.state == state for o in outcomes) for state in (MAPPED, KEPT, FAILED, NOT_REACHED)}
    shown = list(outcomes)
    left_out = ""
    if len(shown) > _MOST_ROWS:
        shown = [o for o in shown if o.state == FAILED or (o.state == MAPPED and o.why != "new")][:_MOST_ROWS]
        left_out = " Shown are those that failed or were made again; batch.csv has all of them."
    rows = tuple(
        (o.file.name, o.result.name if o.state in (MAPPED, KEPT) else "-", o.state, _why(o), *_numbers(o))
        for o in shown
    )
    note = ", ".join(f"{count} {state}" for state, count in counts.items() if count)
    return Table(
        f"{len(outcomes)} files",
        ("file", "result", "outcome", "why", "determined", "median modulus"),
        rows,
        note=f"{note}.{left_out}",
    )


def _why(outcome: Outcome) -> str:
    """Return why in a few words; what went wrong is told in full elsewhere."""
    if outcome.state == KEPT:
        return "unchanged"
    return outcome.why.split(": expected")[0].split(": got")[0] if outcome.state == FAILED else outcome.why


def _numbers(outcome: Outcome) -> tuple[str, str]:
    summary = outcome.summary or {}
    share, modulus = summary.get("determined"), summary.get("modulus")
    return (
        "-" if share is None else f"{100.0 * share:.0f} %",
        "-" if modulus is None else format_quantity(modulus, "Pa"),
    )
