"""Method population from the command line: what it takes, what it writes, and what it refuses before it starts."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
import xarray as xr

from overtone.batch.sample import read_plane
from overtone.cli import main
from overtone.contact.sample import sample
from overtone.demo import demo_probe, virtual_scan
from overtone.dynamics.hold import hold_amplitude
from overtone.errors import OvertoneError
from overtone.instrument.noise import add_noise
from overtone.instrument.phantom import blend
from overtone.io.netcdf import load, save
from overtone.readings import Reading, with_reading

SHAPE = (36, 40)
MAPPED = ("--method", "population", "--poisson-ratio", 0.35, "--model", "dmt")


def run(*arguments: object) -> int:
    """Run the command line and return its exit code."""
    try:
        main([str(argument) for argument in arguments])
    except SystemExit as stop:
        return int(stop.code or 0)
    return 0


def flat(text: str) -> str:
    return re.sub(r"\s+", " ", text)


@pytest.fixture(scope="module")
def world() -> tuple[xr.Dataset, xr.Dataset]:
    """A scan of two polymers and its truth."""
    return virtual_scan(shape=SHAPE, seed=3)


def at_setpoint(setpoint: float) -> xr.Dataset:
    """The same sample at another set-point, with noise of its own."""
    phantom = blend(shape=SHAPE, seed=3)
    material = sample("dmt", modulus=phantom["modulus"], poisson_ratio=0.35, adhesion=phantom["adhesion"])
    states = hold_amplitude(demo_probe(), material, setpoint=setpoint).assign_coords(phantom.coords)
    read = add_noise(states[["A0", "A1", "phi1", "A2", "phi2", "A3", "phi3"]], seed=11)
    return with_reading(read, Reading(demo_probe(), corrected=True))


@pytest.fixture(scope="module")
def labels(world: tuple[xr.Dataset, xr.Dataset]) -> xr.DataArray:
    """The material of each pixel, none along the first column."""
    material = world[1]["material"].astype(float)
    return material.where(material.x > material.x.min()).rename("labels")


@pytest.fixture(scope="module")
def folder(
    world: tuple[xr.Dataset, xr.Dataset], labels: xr.DataArray, tmp_path_factory: pytest.TempPathFactory
) -> Path:
    """Scans and labels as files."""
    path = tmp_path_factory.mktemp("population")
    scan = world[0]
    save(scan, path / "scan.nc")
    save(labels.to_dataset(), path / "labels.nc")
    save((labels == 0).astype(float).rename("mask").to_dataset(), path / "mask.nc")
    save(labels.isel(y=slice(0, 10)).to_dataset(), path / "short.nc")
    save(labels.assign_coords(x=labels.x + 1e-6).to_dataset(), path / "beside.nc")
    save(xr.Dataset({"a": labels, "b": labels}), path / "two.nc")
    upper = scan.y > scan.y.mean()
    save(
        scan.assign(A0=scan.A0.where(upper), A2=scan.A2.where(~upper)).assign_attrs(scan.attrs),
        path / "blind.nc",
    )
    save(scan.isel(y=0, drop=True), path / "line.nc")
    save(scan.isel(y=slice(0, 20)), path / "half.nc")
    save(scan.drop_vars(["A3", "phi3"]), path / "fewer.nc")
    save(scan.assign_attrs(calibration="another"), path / "other.nc")
    return path


@pytest.fixture(scope="module")
def mapped(folder: Path) -> tuple[xr.Dataset, str]:
    """The result of a whole run, and its page."""
    code = run(
        "map",
        folder / "scan.nc",
        *MAPPED,
        *("--phases", folder / "labels.nc", "--reference", "E=2 GPa, E_error=1 %, nu=0.4, name=PS blend"),
        *("--reference-region", folder / "mask.nc", "--seed", 3),
        *("-o", folder / "maps.nc", "--report", folder / "maps.html", "--paper", folder / "paper"),
    )
    assert code == 0
    return load(folder / "maps.nc"), (folder / "maps.html").read_text(encoding="utf-8")


def test_a_run_gives_pixels_and_materials(
    mapped: tuple[xr.Dataset, str], labels: xr.DataArray, world: tuple[xr.Dataset, xr.Dataset]
) -> None:
    result, _ = mapped
    assert result["modulus"].dims == ("y", "x")
    assert [str(name) for name in result["material"].values] == ["PS_blend", "phase_2"]
    assert [str(name) for name in result["row"].values] == ["CONS_0", "CONS_1", "CONS_2", "CONS_3"]
    assert result["phase"].attrs["flag_meanings"] == "none PS_blend phase_2"
    known = result["phase"].values >= 0
    assert (result["phase"].values[known] == labels.values[known]).all()
    assert not known[:, 0].any()
    assert known[:, 1:].mean() > 0.9
    assert (result["shrinkage"].values[~known] == 0.0).all()
    soft = result["phase"].values == 1
    truth = float(np.median(world[1]["modulus"].values[soft]))
    assert float(result["material_modulus"][1]) == pytest.approx(truth, rel=0.03, abs=0)
    wide = np.log(result["modulus_upper"] / result["modulus_lower"]).values[soft]
    alone = np.log(result["modulus_unpooled_upper"] / result["modulus_unpooled_lower"]).values[soft]
    assert np.median(wide) < np.median(alone)


def test_a_reference_stands_at_the_poisson_ratio_of_the_map(mapped: tuple[xr.Dataset, str]) -> None:
    result, _ = mapped
    stands = 2e9 * (1 - 0.35**2) / (1 - 0.4**2)
    assert float(result["material_modulus"][0]) == pytest.approx(stands, rel=0.02, abs=0)
    findings = json.loads(result.attrs["findings"])
    assert any("PS blend, 2 GPa at 0.4, stands as 2.09 GPa" in sentence for sentence in findings)


def test_a_result_without_a_calibration_says_what_it_lacks(mapped: tuple[xr.Dataset, str]) -> None:
    result, page = mapped
    assert any("no number of pixels averages the rest out" in s for s in json.loads(result.attrs["findings"]))
    assert "what its pixels share is in no interval" in page


def test_the_page_and_the_paper_show_phases_and_materials(
    mapped: tuple[xr.Dataset, str], folder: Path
) -> None:
    result, page = mapped
    for title in ("Phases from", "Predictive check from", "Materials", "Verdict: "):
        assert title in page
    assert result.attrs["verdict_reason"].split(":")[0][1:] in page
    names = {path.name for path in (folder / "paper").iterdir()}
    assert {"tables.csv", "methods.md", "report.html", "figure_phases.svg", "figure_phases.csv"} <= names


def test_the_terminal_prints_materials_and_verdict(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Two set-points of the same pixels, and as many phases as are asked for."""
    save(at_setpoint(0.6), tmp_path / "second.nc")
    files = (folder / "scan.nc", tmp_path / "second.nc")
    assert run("map", *files, *MAPPED, "--phases", 2, "-o", tmp_path / "maps.nc") == 0
    printed = flat(capsys.readouterr().out)
    assert "scan.nc and 1 more" in printed
    assert "2 scans, of which the first is shown" in printed
    assert "2 phases asked for" in printed
    assert "Verdict: " in printed
    result = load(tmp_path / "maps.nc")
    assert result["A1"].dims == ("scan", "y", "x")
    assert result["modulus"].dims == ("y", "x")
    assert result.sizes["row"] == 8


WRONG = {
    "no phases": (("--phases", 0), "expected 1 to 127", "the scan chooses"),
    "too many phases": (("--phases", 200), "expected 1 to 127", "the scan chooses"),
    "no file of labels": (("--phases", "none.nc"), "which is no file", "a number of phases"),
    "labels as a picture": (("--phases", "labels.png"), "holds no labels that can be read", "netCDF"),
    "labels of other pixels": (
        ("--phases", "short.nc"),
        "36 lines of 40 pixels, got 10 lines",
        "same pixels",
    ),
    "labels of another place": (("--phases", "beside.nc"), "lies elsewhere than the scan", "same pixels"),
    "two variables": (("--phases", "two.nc"), "which variable is meant", "a, b"),
    "reference without a place": (
        ("--reference", "E=2 GPa, nu=0.35"),
        "the place where it is",
        "--reference-region",
    ),
    "place without a reference": (("--reference-region", "mask.nc"), "the place where it is", "--reference "),
    "reference without a modulus": (
        ("--reference", "nu=0.35", "--reference-region", "mask.nc"),
        "--reference has no modulus",
        "E=2 GPa",
    ),
    "reference without a ratio": (
        ("--reference", "E=2 GPa", "--reference-region", "mask.nc"),
        "no Poisson's ratio",
        "nu=0.35",
    ),
    "region outside": (
        ("--reference", "E=2 GPa, nu=0.35", "--reference-region", "1 mm, 1 mm, 2 mm, 2 mm"),
        "lies outside of the scan",
        "overtone inspect",
    ),
    "region of a pixel": (
        ("--reference", "E=2 GPa, nu=0.35", "--reference-region", "0 nm, 0 nm, 1 nm, 1 nm"),
        "too few pixels of the reference",
        "25 or more",
    ),
    "half a rectangle": (
        ("--reference", "E=2 GPa, nu=0.35", "--reference-region", "0 um, 1 um"),
        "--reference-region is not understood",
        "0 um, 0 um, 2 um, 1 um",
    ),
    "negative seed": (("--seed", -1), "--seed is not a seed", "0 or more"),
    "paper on a file": (("--paper", "scan.nc"), "no folder for a paper", "another name"),
    "paper nowhere": (("--paper", "absent/paper"), "no folder for a paper", "create it first"),
    "models compared": (("--model", "auto"), "compared by their posteriors", "posterior"),
    "another method": (("--method", "posterior", "--phases", 2), "belongs to another method", "population"),
    "reference of another method": (
        ("--method", "exact", "--reference", "E=2 GPa, nu=0.35"),
        "belongs to another method",
        "--reference-area",
    ),
}
FILES = {
    "one dimension": (("line.nc",), "phases are found in maps", "--method posterior"),
    "no pixel complete": (("blind.nc",), "no pixel has all harmonics", "--harmonics 1,2,3"),
    "one scan twice": (("scan.nc", "scan.nc"), "scan 2 has the very readings of the first", "the other file"),
    "other pixels": (("scan.nc", "half.nc"), "scan 2 has other pixels", "36"),
    "other harmonics": (("scan.nc", "fewer.nc"), "scan 2 has other harmonics", "0, 1, 2, 3"),
}


@pytest.mark.parametrize("kind", [*WRONG, *FILES])
def test_what_cannot_be_mapped_is_said_before_it_is_tried(
    kind: str,
    folder: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(folder)
    (folder / "labels.png").write_bytes(b"\x89PNG\r\n\x1a\n")
    options, *words = WRONG.get(kind, ((), "", ""))
    files = ("scan.nc",)
    if kind in FILES:
        files, *words = FILES[kind]
    mapped = [*MAPPED, *options]
    if "--method" in options:
        mapped = ["--poisson-ratio", 0.35, *options]
    if "--model" in options:
        mapped = [*MAPPED[:-2], *options]
    assert run("map", *files, *mapped, "-o", tmp_path / "maps.nc", "--report", tmp_path / "maps.html") == 1
    said = flat(capsys.readouterr().err)
    for word in words:
        assert word in said
    assert "Traceback" not in said
    assert not list(tmp_path.iterdir())


def test_several_files_are_for_the_population(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    files = (folder / "scan.nc", folder / "scan.nc")
    assert run("map", *files, "--poisson-ratio", 0.35, "-o", tmp_path / "maps.nc") == 1
    assert "--method population" in flat(capsys.readouterr().err)


def test_a_paper_needs_a_modulus(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    asked = ("--method", "population", "--paper", tmp_path / "paper", "-o", tmp_path / "maps.nc")
    assert run("map", folder / "scan.nc", *asked) == 1
    assert "Poisson's ratio of the sample" in flat(capsys.readouterr().err)
    assert not list(tmp_path.iterdir())


def test_labels_are_read_from_tables_and_turned_like_the_scan(
    world: tuple[xr.Dataset, xr.Dataset], labels: xr.DataArray, tmp_path: Path
) -> None:
    scan = world[0]
    lines = ["x [um], y [um], phase"]
    for y in labels.y.values:
        lines += [f"{1e6 * x:.9g}, {1e6 * y:.9g}, {float(labels.sel(y=y, x=x)):g}" for x in labels.x.values]
    (tmp_path / "labels.csv").write_text("\n".join(lines), encoding="utf-8")
    found = read_plane(tmp_path / "labels.csv", scan, ("labels", "phase"))
    np.testing.assert_array_equal(found.values, labels.values)
    save(labels.isel(y=slice(None, None, -1)).to_dataset(), tmp_path / "turned.nc")
    np.testing.assert_array_equal(read_plane(tmp_path / "turned.nc", scan, ("labels",)).values, labels.values)
    bare = labels.drop_vars(["x", "y"])
    save(bare.to_dataset(), tmp_path / "bare.nc")
    np.testing.assert_array_equal(read_plane(tmp_path / "bare.nc", scan, ("labels",)).values, labels.values)
    (tmp_path / "points.csv").write_text("x [um], phase\n0, 1\n1, 0\n", encoding="utf-8")
    with pytest.raises(OvertoneError, match="none over y and x"):
        read_plane(tmp_path / "points.csv", scan, ("phase",))
