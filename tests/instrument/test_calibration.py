"""Calibrations kept as text: what is written is what is read, and damage is named."""

import json
import math
import tomllib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tomli_w

from overtone.errors import CalibrationError
from overtone.instrument.calibration import (
    Calibration,
    ReferenceMaterial,
    format_calibration,
    joint,
    load_calibration,
    parse_calibration,
    save_calibration,
    summary_rows,
)
from overtone.instrument.unknowns import NEUTRAL
from overtone.probe import Probe


def plain(lever: Probe, names: tuple[str, ...], covariance: np.ndarray) -> Calibration:
    return Calibration(lever, 94e-9, dict(NEUTRAL), names, covariance)


@pytest.mark.parametrize("name", ["calibration.toml", "calibration.json"])
def test_what_is_written_is_read(calibrated: Calibration, tmp_path: Path, name: str) -> None:
    save_calibration(calibrated, tmp_path / name)
    read = load_calibration(tmp_path / name)
    assert read.probe == calibrated.probe
    assert read.amplitude == pytest.approx(calibrated.amplitude, rel=1e-8)
    for unknown, value in calibrated.values.items():
        assert read.values[unknown] == pytest.approx(value, rel=1e-8, abs=0)
    assert read.names == calibrated.names
    np.testing.assert_allclose(read.covariance, calibrated.covariance, rtol=1e-6, atol=0)
    assert read.findings == calibrated.findings
    assert read.source == calibrated.source
    assert read.reference is not None
    assert calibrated.reference is not None
    assert read.reference.stated == ("modulus",)
    for material, (value, error) in calibrated.reference.properties.items():
        assert read.reference.properties[material] == pytest.approx((value, error), rel=1e-5)
    assert set(read.noise) == set(calibrated.noise)
    for column, values in calibrated.curve.items():
        np.testing.assert_allclose(read.curve[column], values, rtol=1e-8, atol=1e-22)


def test_quantities_carry_their_unit(calibrated: Calibration, tmp_path: Path) -> None:
    path = tmp_path / "c.toml"
    save_calibration(calibrated, path)
    table = tomllib.loads(path.read_text(encoding="utf-8"))
    assert table["values"]["A0_offset"].endswith(" nm")
    assert table["values"]["phi1_offset"].endswith(" deg")
    assert isinstance(table["values"]["gain0"], float)
    assert table["reference"]["properties"]["modulus"]["median"].endswith(" GPa")
    assert path.read_text(encoding="utf-8") != format_calibration(calibrated)
    assert parse_calibration(format_calibration(calibrated)).names == calibrated.names


def test_strong_correlations_survive(lever: Probe) -> None:
    """Of two that go together to five nines the difference is known a hundred times better than either."""
    rho, one, other = -0.99999, 3e-12, 0.2
    covariance = np.array([[one**2, rho * one * other], [rho * one * other, other**2]])
    read = parse_calibration(format_calibration(plain(lever, ("A0_offset", "gain2"), covariance)))
    np.testing.assert_allclose(read.covariance, covariance, rtol=1e-6, atol=0)
    row = np.array([1.0 / one, 1.0 / other])
    assert row @ read.covariance @ row == pytest.approx(2.0 * (1.0 + rho), rel=1e-4)


def test_an_unknown_without_error_and_one_alone(lever: Probe) -> None:
    read = parse_calibration(format_calibration(plain(lever, ("A0_offset", "gain2"), np.diag([0.0, 0.04]))))
    assert read.error("A0_offset") == 0.0
    assert read.error("gain2") == pytest.approx(0.2)
    assert read.error("gain3") == 0.0
    assert parse_calibration(format_calibration(plain(lever, (), np.zeros((0, 0))))).names == ()


def test_a_viscous_reference_is_kept(lever: Probe) -> None:
    material = ReferenceMaterial(
        "PDMS", "dmt-viscous", 0.49, {"viscosity": (12.5, 0.1), "modulus": (2e6, 0.2)}
    )
    read = parse_calibration(
        format_calibration(replace(plain(lever, ("gain2",), np.eye(1)), reference=material))
    )
    assert read.reference is not None
    assert read.reference.properties["viscosity"] == pytest.approx((12.5, 0.1), rel=1e-6)
    assert read.reference.properties["modulus"] == pytest.approx((2e6, 0.2), rel=1e-6)


def swap(path: str, value: Any) -> Callable[[dict[str, Any]], None]:
    """Return what replaces an entry of a table; ``...`` removes it."""

    def change(table: dict[str, Any]) -> None:
        *folders, last = path.split("/")
        for folder in folders:
            table = table[folder]
        if value is ...:
            del table[last]
        else:
            table[last] = value

    return change


def negative_eigenvalue(table: dict[str, Any]) -> None:
    table["covariance"]["correlations"][1][0] = 1.5


def repeated_name(table: dict[str, Any]) -> None:
    table["covariance"]["names"][0] = table["covariance"]["names"][1]


def short_column(table: dict[str, Any]) -> None:
    table["curve"]["A0"].pop()


def diagonal(table: dict[str, Any]) -> None:
    table["covariance"]["correlations"][2][2] = 0.5


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (swap("calibration", ...), r"no section \[calibration\]"),
        (swap("calibration/format", 7), "format 7, where this version reads 1"),
        (swap("values/gain2", ...), "no 'gain2'"),
        (swap("values/A0_offset", "2 V"), "A0_offset"),
        (swap("values/A0_offset", 2.0), "A0_offset has no unit"),
        (swap("values/gain9", 1.0), "unknown names in the values: gain9"),
        (swap("values/gain2", math.nan), "gain2"),
        (swap("calibration/amplitude", "-94 nm"), "below zero"),
        (swap("noise/A0", "-1 pm"), "below zero"),
        (swap("probe/cantilever", {}), "probe"),
        (swap("covariance/names", ["gain9"]), "unknown names in the covariance: gain9"),
        (repeated_name, "stands twice"),
        (negative_eigenvalue, "negative eigenvalue"),
        (diagonal, "correlation with itself is not 1"),
        (swap("covariance/correlations", [[1.0]]), "not a triangle of all names"),
        (swap("covariance/errors", ["1 pm"]), "errors that are not one for each name"),
        (swap("covariance", "nothing"), r"no section \[covariance\]"),
        (swap("curve/e9_re", [1.0]), "unknown names in the curve: e9_re"),
        (swap("curve/A1", ...), "a curve without A1 or phi1"),
        (short_column, "columns of other lengths"),
        (swap("reference/properties/modulus", {"median": "2 GPa"}), "no 'log_error'"),
        (swap("reference/poisson_ratio", "soft"), "soft"),
    ],
)
def test_damage_is_named(
    calibrated: Calibration, tmp_path: Path, change: Callable[[dict[str, Any]], None], message: str
) -> None:
    table = json.loads(format_calibration(calibrated))
    change(table)
    for path, text in ((tmp_path / "c.toml", tomli_w.dumps(table)), (tmp_path / "c.json", json.dumps(table))):
        path.write_text(text, encoding="utf-8")
        with pytest.raises(CalibrationError, match=rf"{path.name} is no calibration, or damaged.*{message}"):
            load_calibration(path)


def test_a_negative_error_and_a_lost_number_are_named(calibrated: Calibration) -> None:
    table = json.loads(format_calibration(calibrated))
    table["covariance"]["errors"][0] = "-1 pm"
    with pytest.raises(CalibrationError, match="negative errors"):
        parse_calibration(json.dumps(table))
    table = json.loads(format_calibration(calibrated))
    table["curve"]["A0"][3] = math.nan
    with pytest.raises(CalibrationError, match="column A0 of the curve that are not finite"):
        parse_calibration(json.dumps(table))


@pytest.mark.parametrize("text", ["", "no calibration", "{", "[1, 2", "x = 1", "[calibration]\nformat = 1"])
def test_other_text_is_no_calibration(text: str, tmp_path: Path) -> None:
    path = tmp_path / "other.toml"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(CalibrationError, match=r"other\.toml"):
        load_calibration(path)


def test_files_that_cannot_be_read(tmp_path: Path) -> None:
    with pytest.raises(CalibrationError, match="cannot read the calibration"):
        load_calibration(tmp_path / "absent.toml")
    with pytest.raises(CalibrationError, match="cannot read the calibration"):
        load_calibration(tmp_path)
    (tmp_path / "binary.toml").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(CalibrationError, match="cannot read the calibration"):
        load_calibration(tmp_path / "binary.toml")


def test_the_table_for_people(calibrated: Calibration) -> None:
    rows = {label: (value, error) for label, value, error in summary_rows(calibrated)}
    value, error = rows["A0: gain"]
    assert float(value) == pytest.approx(calibrated.values["gain0"], rel=1e-3)
    assert error == f"{100 * calibrated.error('gain0'):.2g} %"
    assert rows["phi1: zero"][0].endswith("deg")
    assert " pm at " in rows["A2: crosstalk"][0]
    assert "A0: slope along x" in rows  # not measured, but not certain either
    bare = replace(calibrated, names=(), covariance=np.zeros((0, 0)), values=dict(NEUTRAL))
    assert summary_rows(bare) == []


def test_further_unknowns_are_independent() -> None:
    names, covariance = joint(("gain0",), {"gain2": 0.3, "gain0": 9.0}, np.array([[0.01]]))
    assert names == ("gain0", "gain2")
    np.testing.assert_allclose(covariance, np.diag([0.01, 0.09]))
