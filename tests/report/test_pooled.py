"""Pooled results in tables and pages: phases, materials, and what the pixels say by themselves."""

import math
import runpy
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import xarray as xr

from overtone.io.netcdf import load, save
from overtone.report.content import Report
from overtone.report.page import render
from overtone.report.results import alone, is_pooled
from overtone.report.summary import (
    property_table,
    result_tables,
    truth_materials_table,
    truth_properties_table,
    truth_table,
)

world = SimpleNamespace(**runpy.run_path(str(Path(__file__).parents[1] / "plots" / "population.py")))
SIZE = 24
MATERIALS = ("PS", "LDPE")


@pytest.fixture(scope="module")
def scan() -> xr.Dataset:
    return world.observables(2, size=SIZE)


@pytest.fixture(scope="module")
def result(scan: xr.Dataset) -> xr.Dataset:
    return world.result(scan, 2)


@pytest.fixture(scope="module")
def truth() -> xr.Dataset:
    known = world.truth(2, SIZE)
    material = xr.DataArray(world.labels(2, SIZE)[0], dims=("y", "x"), coords=known.coords)
    return known.assign(material=material)


def rows(table) -> list[dict[str, str]]:
    return [dict(zip(table.columns, cells, strict=True)) for cells in table.rows]


def test_a_line_a_material_says_whether_its_interval_holds_the_truth(result, truth):
    found = rows(truth_materials_table({"population": result}, truth, MATERIALS))
    assert [cells["material"] for cells in found] == ["PS", "LDPE"]
    assert [cells["phase"] for cells in found] == ["PS", "LDPE"]
    assert [cells["truth"] for cells in found] == ["1.93 GPa", "94 MPa"]
    assert [cells["pooled 90 % interval holds"] for cells in found] == ["yes", "yes"]
    moved = result.assign(material_modulus_lower=2.0 * result["material_modulus_upper"])
    moved["material_modulus_upper"] = 3.0 * result["material_modulus_upper"]
    found = rows(truth_materials_table({"population": moved}, truth, MATERIALS))
    assert [cells["pooled 90 % interval holds"] for cells in found] == ["no", "no"]


def test_a_material_without_a_phase_or_an_inversion_is_a_dash(result, truth):
    one = result.assign(phase=result["phase"].where(result["phase"] != 1, -1).astype("int8"))
    found = rows(truth_materials_table({"population": one}, truth, MATERIALS))
    assert found[1]["phase"] == "none of its own"
    # a phase that is mostly another material is not its own
    whole = result.assign(phase=xr.zeros_like(result["phase"]))
    assert (
        rows(truth_materials_table({"population": whole}, truth, MATERIALS))[1]["phase"] == "none of its own"
    )
    unknown = result.assign(material_modulus=result["material_modulus"].copy(data=[math.nan, 9e7]))
    found = rows(truth_materials_table({"population": unknown}, truth, MATERIALS))
    assert (found[0]["median"], found[0]["pooled 90 % interval holds"]) == ("-", "-")


def test_results_without_phases_have_no_such_table(result, truth):
    bare = result.drop_dims("material")
    assert not is_pooled(bare)
    assert truth_materials_table({"posterior": bare}, truth, MATERIALS) is None
    assert [table.title for table in result_tables("a", bare)] == ["Properties (a)"]
    assert [table.title for table in result_tables("a", result)] == ["Materials", "Properties (a)"]


def test_the_pixels_alone_stand_behind_the_pooled_ones(result, truth):
    found = rows(truth_table({"population": result}, truth, MATERIALS))
    assert [cells["from"] for cells in found] == ["population", "its pixels alone"] * 2
    assert [cells["method"] for cells in found] == ["population", "posterior"] * 2
    pooled, own = (float(cells["90 % interval of one pixel"].removeprefix("x ")) for cells in found[2:])
    inside = result["phase"].values == 1
    ratio = (result["modulus_unpooled_upper"] / result["modulus_unpooled_lower"]).values[inside]
    assert own == pytest.approx(np.median(ratio), rel=0.05, abs=0)
    assert pooled < own
    others = rows(truth_properties_table({"population": result}, truth, MATERIALS))
    assert {cells["from"] for cells in others} == {"population", "its pixels alone"}


def test_a_pixel_alone_is_determined_by_its_own_interval(result):
    wide = result.assign(modulus_unpooled_upper=20.0 * result["modulus_unpooled_lower"])
    status = alone(wide)["status"]
    inside = result["phase"].values >= 0
    assert (status.values[inside] == 1).all()
    assert (status.values[~inside] == result["status"].values[~inside]).all()
    narrow = result.assign(modulus_unpooled_upper=2.0 * result["modulus_unpooled_lower"])
    assert (alone(narrow)["status"].values[inside] == 0).all()
    assert alone(result)["modulus_lower"].name == "modulus_lower"


def test_the_table_of_properties_says_what_pooling_made_of_a_pixel(result):
    note = property_table("a", result).note
    inside = result["phase"].values >= 0
    for name in ("modulus_unpooled", "modulus"):
        ratio = (result[f"{name}_upper"] / result[f"{name}_lower"]).values[inside]
        assert f"x {np.median(ratio):.3g}" in note
    assert "by itself" not in property_table("a", result.drop_vars("modulus_unpooled_lower")).note


def test_the_page_shows_phases_and_the_check(scan, result):
    report = Report("a title", "", scan, world.energies(scan), {"harmonics 0, 1": result})
    text = render(report)
    assert "Phases from harmonics 0, 1" in text
    assert "Predictive check from harmonics 0, 1" in text
    nothing = world.result(world.observables(0, size=SIZE), 0)
    text = render(Report("a title", "", scan, world.energies(scan), {"harmonics 0, 1": nothing}))
    assert "Phases from harmonics 0, 1" in text
    assert "Predictive check" not in text


@pytest.mark.parametrize("phases", [0, 1, 2])
def test_materials_come_back_from_a_file(phases, tmp_path):
    result = world.result(world.observables(phases, size=SIZE), phases)
    save(result, tmp_path / "maps.nc")
    again = load(tmp_path / "maps.nc")
    assert dict(again.sizes) == dict(result.sizes)
    for name in ("material", "row"):
        assert [str(v) for v in again[name].values] == [str(v) for v in result[name].values]
    for name in result.data_vars:
        np.testing.assert_array_equal(again[name].values, result[name].values)
    assert again["phase"].attrs["flag_meanings"] == result["phase"].attrs["flag_meanings"]
    assert again.attrs["verdict"] == result.attrs["verdict"]
    assert [t.rows for t in result_tables("a", again)] == [t.rows for t in result_tables("a", result)]
