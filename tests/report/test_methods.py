"""Pages and prints of results with intervals and solutions."""

import html
import io

import numpy as np
import pytest
from rich.cells import cell_len
from rich.console import Console

from overtone.report.content import Report
from overtone.report.page import render
from overtone.report.summary import property_table
from overtone.report.terminal import print_report


def page(report: Report, **results) -> str:
    first = report.observables.isel(y=0, x=0, drop=True)
    shaped = first.broadcast_like(next(iter(results.values()))["status"])
    content = Report(
        "t",
        "s",
        shaped.transpose("y", "x"),
        report.energies.isel(y=0, x=0, drop=True).broadcast_like(shaped),
        results,
        tables=tuple(property_table(label, result) for label, result in results.items()),
    )
    return html.unescape(render(content))


def test_a_page_of_intervals_says_what_a_step_is(report, synthetic):
    text = page(report, a=synthetic.posterior())
    assert (
        text.count('<img src="data:') == 8
    )  # overview, 3 of the scan, properties, certainty, validity, distributions
    for sentence in (
        "at least as wide as the typical 90 % interval",
        "neighbouring colours may be one",
        "the lower and the upper end of its 90 % interval",
        "Certainty from a",
        "Validity from a",
        "Validity (a)",
        "scatter narrower than its bar",
        "several solutions",
    ):
        assert sentence in text, sentence
    assert "N_r is no evidence" not in text


def test_a_page_of_solutions_says_how_many(report, synthetic):
    text = page(report, a=synthetic.exact())
    assert "how many decades of modulus lie between them" in text
    assert "several 8.3 %" in text
    assert "Certainty from" not in text


def test_a_page_where_nothing_is_determined_says_so(report, synthetic):
    text = page(report, a=synthetic.posterior(codes=np.ones((48, 48), np.int8)))
    assert "No pixel is determined: words stand" in text


@pytest.mark.parametrize("width", [60, 80, 100])
def test_everything_is_printed(report, synthetic, width):
    result = synthetic.posterior()
    content = Report(
        "t", "s", report.observables, report.energies, {"a": result}, tables=(property_table("a", result),)
    )
    buffer = io.StringIO()
    print_report(content, Console(file=buffer, width=width))
    text = buffer.getvalue()
    assert max(cell_len(line) for line in text.splitlines()) <= width
    words = " ".join(text.split())
    for piece in (
        "Properties (a)",
        "x 1.67",
        "Validity (a)",
        "paraboloid",
        "several solutions",
        "no contact",
    ):
        assert piece in words, piece
