"""The table of materials: numbers of the result, and what must not be read out of them."""

import io
import math
import runpy
from pathlib import Path
from types import SimpleNamespace

import pytest
import xarray as xr
from rich.console import Console

from overtone.report.materials import interval, materials_table, sentence, verdict_text
from overtone.report.shares import format_share
from overtone.report.terminal import print_table

world = SimpleNamespace(**runpy.run_path(str(Path(__file__).parents[1] / "plots" / "population.py")))


@pytest.fixture(scope="module")
def result() -> xr.Dataset:
    return world.result(world.observables(2, size=20), 2)


def test_a_row_is_a_material_and_a_property(result):
    table = materials_table(result)
    rows = {(row[0], row[2]): row for row in table.rows}
    pixels = int(result["material_pixels"][0])
    assert rows["PS (reference)", "modulus"][1:] == (
        f"{pixels} (1)",
        "modulus",
        "1.93 GPa",
        "1.15 .. 3.24 GPa",
        "0.08",
        "0.05",
        "0.31",
    )
    assert rows["", "modulus ratio"][3:5] == ("0.0487", "0.039 .. 0.0609")
    assert [row[2] for row in table.rows].count("modulus ratio") == 1  # not of the reference itself
    assert "Verdict: relative" in table.note
    share = format_share(float((result["phase"] < 0).mean()))
    assert f"{share} of pixels belong to no phase." in table.note


def test_what_is_merged_or_does_not_fit_is_said(result):
    merged = result.assign(
        material_resolved=result["material_resolved"].copy(data=[1, 0]),
        material_misfit_probability=result["material_misfit_probability"].copy(data=[0.5, 1e-4]),
    )
    table = materials_table(merged)
    assert any(row[0] == "LDPE (merged, not resolved)" for row in table.rows)
    assert "The model does not fit LDPE: a misfit as large has a chance of 0.01 %." in table.note
    assert "does not fit PS" not in table.note


def with_laws(result: xr.Dataset, change: float, gain: float) -> xr.Dataset:
    """Return a result that was fitted under one other law, which changes its second material."""
    found = result.assign(
        material_modulus_law=("material", [0.0, change]),
        law_change=(("material", "law"), [[0.0], [change]]),
        law_gain=(("material", "law"), [[gain], [gain]]),
        law_title=("law", ["JKR adhesion"]),
    )
    return found.assign_coords(law=["jkr"])


def test_another_law_that_fits_as_well_is_said_where_it_counts(result):
    reach = 0.5 * math.log(float(result["material_modulus_upper"][1] / result["material_modulus_lower"][1]))
    said = materials_table(with_laws(result, -1.01 * reach, -2.0)).note
    assert f"LDPE would have {math.exp(-1.01 * reach):.2g} times its modulus" in said
    assert "prefer" not in said
    assert "would have" not in materials_table(with_laws(result, 0.99 * reach, -2.0)).note
    said = materials_table(with_laws(result, 0.99 * reach, 23.03)).note
    assert "The data prefer JKR adhesion to the model, with odds of 10^10 to 1." in said


def test_what_is_not_known_is_a_dash(result):
    unknown = result.assign(material_modulus=result["material_modulus"].copy(data=[math.nan, 9e7]))
    unknown = unknown.drop_vars(["material_domains", "material_modulus_spread", "material_modulus_lower"])
    row = materials_table(unknown).rows[0]
    assert row[1] == str(int(result["material_pixels"][0]))
    assert row[3:6] == ("-", "-", "-")


def test_no_phases():
    scan = world.observables(0, size=20)
    table = materials_table(world.result(scan, 0))
    assert table.rows == ()
    assert "No phases: nothing is pooled" in table.note


@pytest.mark.parametrize("width", [80, 100])
def test_no_word_is_broken_on_a_terminal(result, width):
    console = Console(file=io.StringIO(), width=width)
    print_table(materials_table(result), console)
    lines = console.file.getvalue().splitlines()
    assert all(len(line) <= width for line in lines)
    text = " ".join(console.file.getvalue().split())
    for word in ("(reference)", "indentation", "viscosity", "LDPE", "1.93"):
        assert word in text


def test_a_verdict_says_what_it_supports(result):
    assert verdict_text(result).startswith(
        "Verdict: relative (ratios to the reference, no moduli in pascal)."
    )
    assert verdict_text(result.assign_attrs(verdict="contrast", verdict_reason="")) == (
        "Verdict: contrast (what is stiffer than what, no moduli and no ratios)."
    )
    assert verdict_text(result.assign_attrs(verdict="")) == ""


def test_words():
    assert sentence("shared errors move ln E") == "Shared errors move ln E."
    assert sentence("A0 drifts.") == "A0 drifts."
    assert sentence(" ") == ""
    assert interval(1e9, 2.5e9, "Pa") == "1 .. 2.5 GPa"
    assert interval(math.nan, 1.0, "Pa") == "-"
