"""The folder of a paper: every file is there, reads back, and says what was left out."""

import base64
import csv
import re
import runpy
import xml.etree.ElementTree as ElementTree
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import xarray as xr

from overtone.errors import FileFormatError, ObservablesError, OvertoneError
from overtone.instrument.correct import calibration_of
from overtone.io import table as table_reader
from overtone.quantities import named_array
from overtone.report import paper
from overtone.report.content import Calibrated
from overtone.report.page import Picture
from overtone.report.paper import materials_table, with_setpoint, write_paper
from overtone.report.paper_content import setpoint_of
from overtone.report.paper_figures import NAMES

HERE = Path(__file__).parent
world = SimpleNamespace(**runpy.run_path(str(HERE.parent / "plots" / "population.py")))
Document = runpy.run_path(str(HERE / "test_page.py"))["Document"]
SIZE = 20
ENDINGS = ("svg", "pdf", "png", "csv")


def a_curve(free: float = 94e-9) -> xr.Dataset:
    z = np.linspace(200e-9, -60e-9, 120)
    A = np.minimum(free, free + 0.9 * z)
    phase = {"A1": A, "phi1": np.arcsin(A / free)}
    return xr.Dataset({n: named_array(n, v, ("z",), {"z": z}) for n, v in phase.items()}, coords={"z": z})


@pytest.fixture(scope="module")
def scan() -> xr.Dataset:
    return world.calibrated(world.observables(2, size=SIZE))


@pytest.fixture(scope="module")
def result(scan: xr.Dataset) -> xr.Dataset:
    return world.result(scan, 2)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("paper") / "out"


@pytest.fixture(scope="module")
def written(folder: Path, scan: xr.Dataset, result: xr.Dataset) -> tuple[Path, ...]:
    """Everything there can be."""
    calibration = calibration_of(scan)
    assert calibration is not None
    other = world.result(scan, 2, seed=5, shift=0.1)
    return write_paper(
        str(folder),
        scan,
        result,
        before=world.before(scan),
        energies=world.energies(scan),
        curves=Calibrated(calibration, a_curve(), a_curve()),
        others=(other.assign_attrs(setpoint=0.6), other.assign_attrs(setpoint=0.3)),
        truth=world.truth(2, SIZE),
        title="A blend & its <phases>",
    )


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """No pictures: only what is said and counted."""
    monkeypatch.setattr(paper, "FORMATS", ())
    monkeypatch.setattr(paper, "picture_of", lambda title, figure, caption: Picture(title, caption, "data:,"))


def rows_of(path: Path) -> list[dict[str, str]]:
    lines = [line for line in path.read_text(encoding="utf-8").splitlines() if not line.startswith("#")]
    return list(csv.DictReader(lines))


def same(texts: list[str], values: np.ndarray) -> None:
    """Hold cells against numbers, digit by digit."""
    read = np.array([float(text) if text else np.nan for text in texts])
    np.testing.assert_array_equal(read, np.asarray(values, dtype=float).ravel())


# --- files ------------------------------------------------------------------------------------------------------------


def test_other_laws_are_a_table(tmp_path, quick, scan, result) -> None:
    tried = result.assign(
        law_change=(("material", "law"), [[0.1], [0.4]]), law_gain=(("material", "law"), [[-2.0], [-2.0]])
    ).assign_coords(law=["jkr"])
    tried = tried.assign(law_title=("law", ["JKR adhesion"]), material_modulus_law=("material", [0.1, 0.4]))
    write_paper(tmp_path / "out", scan, tried)
    rows = rows_of(tmp_path / "out" / "laws.csv")
    column = next(name for name in rows[0] if name.startswith("law_change"))
    same([row[column] for row in rows], np.array([0.1, 0.4]))
    assert {row["law"] for row in rows} == {"jkr"}


def test_every_file_is_there_and_is_told_of(written, folder):
    expected = {f"{name}.{ending}" for name in NAMES for ending in ENDINGS}
    expected |= {"tables.csv", "metadata.csv", "methods.md", "report.html"}
    assert {path.name for path in written} == expected
    assert all(path.parent == folder and path.stat().st_size > 100 for path in written)
    assert {path.name for path in folder.iterdir()} == expected
    assert [path.name for path in folder.parent.iterdir()] == ["out"]  # nothing half done is left


@pytest.mark.parametrize("name", NAMES)
def test_pictures_are_what_their_names_say(written, folder, name):
    root = ElementTree.fromstring((folder / f"{name}.svg").read_bytes())
    assert root.tag == "{http://www.w3.org/2000/svg}svg"
    assert float(root.attrib["width"].removesuffix("pt")) > 200.0
    pdf = (folder / f"{name}.pdf").read_bytes()
    assert pdf.startswith(b"%PDF-")
    assert b"CreationDate" not in pdf
    assert (folder / f"{name}.png").read_bytes().startswith(b"\x89PNG")
    assert "<dc:date>" not in (folder / f"{name}.svg").read_text(encoding="utf-8")


def test_the_same_input_gives_the_same_bytes(written, folder, tmp_path, monkeypatch, scan, result):
    monkeypatch.setattr(
        paper, "paper_figures", lambda p: [f for f in PAPER_FIGURES(p) if not isinstance(f, str)][3:6]
    )
    again = write_paper(tmp_path / "again", scan, result, truth=world.truth(2, SIZE))
    compared = [path.name for path in again if path.name.startswith(("figure_profiles", "figure_check"))]
    assert len(compared) == 8
    for name in compared:
        assert (tmp_path / "again" / name).read_bytes() == (folder / name).read_bytes(), name


PAPER_FIGURES = paper.paper_figures


# --- numbers ----------------------------------------------------------------------------------------------------------


def test_maps_read_back_as_the_same_numbers(written, folder, result):
    recording = table_reader.read(folder / "figure_properties.csv")
    assert recording.dims == ("y", "x")
    found = {channel.name: channel for channel in recording.channels}
    for name in ("modulus", "modulus_unscreened", "adhesion_lower", "loss_tangent_upper"):
        np.testing.assert_array_equal(found[name].values, result[name].values)
    assert found["modulus"].unit == "Pa"
    assert found["height"].unit == "m"
    np.testing.assert_array_equal(recording.coords["x"], result["x"].values)
    assert recording.metadata["status"].startswith("0 = determined")


def test_observables_stand_before_and_after(written, folder, scan):
    recording = table_reader.read(folder / "figure_observables.csv")
    found = {channel.name: channel for channel in recording.channels}
    np.testing.assert_array_equal(found["A0"].values, scan["A0"].values)
    np.testing.assert_array_equal(found["A0_before"].values, world.before(scan)["A0"].values)
    assert [found[name].unit for name in ("A2", "A2_before", "phi2", "phi2_before")] == [
        "m",
        "m",
        "rad",
        "rad",
    ]


def test_the_profile_holds_everything_that_is_drawn(written, folder, result):
    rows = rows_of(folder / "figure_profiles.csv")
    text = (folder / "report.html").read_text(encoding="utf-8")
    word, number = re.search(r"(row|column) (\d+) of \d+, along", text).groups()
    at, k = ("y", int(number) - 1) if word == "row" else ("x", int(number) - 1)
    line = result.isel({at: k})
    for name in ("modulus", "modulus_lower", "modulus_unpooled_upper", "loss_tangent_unpooled"):
        unit = "1" if name.startswith("loss") else "Pa"
        same([r[f"{name} [{unit}]"] for r in rows], line[name].values)
    same([r["adhesion_truth [N]"] for r in rows], world.truth(2, SIZE)["adhesion"].isel({at: k}).values)
    phase = result["phase"].values
    counts = [np.unique(r[r >= 0], return_counts=True)[1] for r in (*phase, *phase.T)]
    shown = np.unique(line["phase"].values[line["phase"].values >= 0], return_counts=True)[1]
    assert shown.size == 2
    assert shown.min() == max(c.min() for c in counts if c.size == 2)


def test_tables_of_materials_check_and_set_points_read_back(written, folder, scan, result):
    rows = rows_of(folder / "tables.csv")
    assert [row["material"] for row in rows] == ["PS", "LDPE"]
    for name in result.data_vars:
        if result[name].dims == ("material",):
            unit = result[name].attrs["units"]
            same([row[f"{name} [{unit}]"] for row in rows], result[name].values)
    rows = rows_of(folder / "figure_check.csv")
    assert [(row["material"], row["row"]) for row in rows[:2]] == [("PS", "CONS_0"), ("PS", "CONS_1")]
    same([row["check_upper [N]"] for row in rows], result["check_upper"].values)
    rows = rows_of(folder / "figure_setpoints.csv")
    assert [row["material"] for row in rows] == ["PS", "LDPE"] * 3
    same([row["setpoint [1]"] for row in rows[2:4]], np.full(2, setpoint_of(scan)))  # between 0.3 and 0.6
    same([row["modulus [Pa]"] for row in rows[2:4]], result["material_modulus"].values)
    rows = rows_of(folder / "figure_space.csv")
    same([row["phase [1]"] for row in rows], result["phase"].values)
    same([row["A2 [m]"] for row in rows], scan["A2"].values)


def test_metadata_are_si_numbers_with_units(written, folder):
    found = {row["what"]: (row["value"], row["unit"]) for row in rows_of(folder / "metadata.csv")}
    assert found["stiffness of mode 1"] == ("16.4", "N/m")
    assert found["free amplitude"] == ("9.4e-08", "m")
    assert found["Poisson's ratio of the sample"] == ("0.37", "1")
    assert float(found["noise of phi1"][0]) == world.NOISE["phi1"]
    assert found["noise of phi1"][1] == "rad"
    assert float(found["error left, mean deflection read without a force"][0]) == pytest.approx(
        1.2e-12, rel=1e-6
    )
    assert found["verdict"] == ("relative", "")
    assert found["file"] == ("blend.ibw", "")  # without the folder it lay in


# --- page -------------------------------------------------------------------------------------------------------------


def test_the_page_shows_all_and_needs_nothing_else(written, folder, result):
    text = (folder / "report.html").read_text(encoding="utf-8")
    document = Document(text)
    assert document.stack == []
    images = [attributes["src"] for tag, attributes in document.tags if tag == "img"]
    assert len(images) == len(NAMES)
    assert all(
        base64.b64decode(source.removeprefix("data:image/png;base64,")).startswith(b"\x89PNG")
        for source in images
    )
    for cell in (cell for row in materials_table(result).rows for cell in row if cell):
        assert cell in document.cells
    assert "<phases>" not in text
    words = " ".join(document.texts)
    for part in (
        "A blend & its <phases>",
        "Verdict: relative",
        "Shared errors move ln E",
        "Nanotechnology 31",
        "Figure 10",
    ):
        assert part in words
    assert "Left out" not in words
    assert '"correlations"' not in text  # no covariance as text
    assert not re.search(r'(src|href)="(?!data:)', text)


def test_nothing_says_when_it_was_written(written, folder):
    text = re.sub('base64,[^"]*', "", (folder / "report.html").read_text(encoding="utf-8"))
    assert "UTC" not in text
    assert "Written by overtone" in text


# --- what is not there ------------------------------------------------------------------------------------------------


@pytest.mark.usefixtures("quick")
def test_what_was_not_given_is_left_out_and_said(tmp_path, scan, result):
    bare, alone = scan[["A1", "phi1"]], result.drop_vars(["check_observed", "shrinkage"])
    for dataset in (bare, alone):
        dataset.attrs = {key: value for key, value in dataset.attrs.items() if key != "calibration"}
    files = {path.name for path in write_paper(tmp_path / "out", bare, alone)}
    assert "figure_setpoints.csv" not in files
    assert "figure_space.csv" not in files
    assert {"figure_observables.csv", "figure_properties.csv", "figure_profiles.csv"} <= files
    page, methods = (
        (tmp_path / "out" / name).read_text(encoding="utf-8") for name in ("report.html", "methods.md")
    )
    for said in (
        "Observables before correction",
        "Shaded relief",
        "Scatter of the observables",
        "Predictive check",
        "Dependence on the set-point",
        "Forces and energies",
        "Approach curve of the calibration",
        "Truth along the profiles",
    ):
        assert f"Left out. {said}" in page
        assert f"- {said}" in methods
    assert "not corrected with a calibration" in methods


@pytest.mark.usefixtures("quick")
@pytest.mark.parametrize("phases", [0, 1, 3])
def test_any_number_of_phases(tmp_path, phases):
    scan = world.observables(phases, size=SIZE)
    result = world.result(scan, phases)
    others = (result.assign_attrs(setpoint=0.7),)
    files = {path.name for path in write_paper(tmp_path / "out", scan, result, others=others)}
    assert ("figure_check.csv" in files) == (phases > 0)
    assert ("figure_setpoints.csv" in files) == (phases > 0)
    rows = rows_of(tmp_path / "out" / "tables.csv")
    assert len(rows) == phases
    text = (tmp_path / "out" / "methods.md").read_text(encoding="utf-8")
    assert ("No phases were told apart" in text) == (phases == 0)


@pytest.mark.usefixtures("quick")
@pytest.mark.parametrize("code", [1, 6])
def test_results_that_say_nothing(tmp_path, scan, result, code):
    nothing = result.copy()
    for name in result.data_vars:
        if code == 6 and result[name].dtype.kind == "f":
            nothing[name] = xr.full_like(result[name], np.nan)
    nothing["status"] = xr.full_like(result["status"], code)
    others = (nothing.assign_attrs(setpoint=0.6),)
    files = write_paper(tmp_path / "out", scan, nothing, before=world.before(scan), others=others)
    page = (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    assert "No pixel is determined" in page
    table = next(path for path in files if path.name == "figure_properties.csv")
    found = {channel.name: channel.values for channel in table_reader.read(table).channels}
    np.testing.assert_array_equal(found["modulus_unscreened"], nothing["modulus_unscreened"].values)


@pytest.mark.usefixtures("quick")
def test_axes_in_another_order_and_pixels_without_positions(tmp_path, scan, result):
    turned = result.transpose("x", "y", "material", "row")
    write_paper(tmp_path / "a", scan, result)
    write_paper(tmp_path / "b", scan.transpose("x", "y"), turned)
    for name in ("figure_space.csv", "figure_properties.csv", "figure_profiles.csv", "tables.csv"):
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes()
    write_paper(tmp_path / "c", scan.drop_vars(["x", "y"]), result.drop_vars(["x", "y"]))
    assert (tmp_path / "c" / "figure_space.csv").read_text().splitlines()[2].startswith("x [1],y [1],A0 [m]")


# --- what is refused --------------------------------------------------------------------------------------------------


@pytest.mark.usefixtures("quick")
def test_a_folder_of_an_earlier_report_is_renewed_and_other_files_stay(tmp_path, scan, result):
    (tmp_path / "notes.txt").write_text("mine")
    (tmp_path / "figure_setpoints.csv").write_text("stale")
    (tmp_path / "tables.csv").write_text("stale")
    write_paper(tmp_path, scan, result)
    assert (tmp_path / "notes.txt").read_text() == "mine"
    assert not (tmp_path / "figure_setpoints.csv").exists()
    assert "PS" in (tmp_path / "tables.csv").read_text()


@pytest.mark.usefixtures("quick")
def test_a_folder_that_cannot_be_written(tmp_path, scan, result, monkeypatch):
    with pytest.raises(FileFormatError, match="folder above"):
        write_paper(tmp_path / "none" / "out", scan, result)
    (tmp_path / "file").write_text("a file")
    with pytest.raises(FileFormatError, match="a folder, got a file"):
        write_paper(tmp_path / "file", scan, result)
    (tmp_path / "old").mkdir()
    (tmp_path / "old" / "tables.csv").mkdir()
    with pytest.raises(FileFormatError, match=r"tables\.csv"):
        write_paper(tmp_path / "old", scan, result)
    before = sorted(path.name for path in tmp_path.iterdir())
    write_bytes = Path.write_bytes

    def full(self: Path, content: bytes) -> int:
        if self.name == "metadata.csv":
            raise OSError(28, "No space left on device")
        return write_bytes(self, content)

    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(FileFormatError, match="No space left"):
        write_paper(tmp_path / "out", scan, result)
    assert sorted(path.name for path in tmp_path.iterdir()) == before


def test_datasets_that_do_not_fit_are_refused(tmp_path, scan, result):
    with pytest.raises(ObservablesError, match="no phase"):
        write_paper(tmp_path / "out", scan, result.drop_vars("phase"))
    with pytest.raises(ObservablesError, match="observables and result"):
        write_paper(tmp_path / "out", scan.isel(x=slice(1, None)), result)
    with pytest.raises(ObservablesError, match="before correction"):
        write_paper(tmp_path / "out", scan, result, before=scan.isel(y=slice(2, None)))
    with pytest.raises(ObservablesError, match="no map"):
        write_paper(tmp_path / "out", scan.isel(y=0), result.isel(y=0))
    with pytest.raises(ObservablesError, match="set-point of a result is not known"):
        write_paper(tmp_path / "out", scan, result, others=(result,))
    with pytest.raises(OvertoneError):
        write_paper(tmp_path / "out", scan.assign_attrs(calibration="{}"), result)
    assert not (tmp_path / "out").exists()


def test_a_set_point_comes_from_the_scan_or_is_stated(scan, result):
    assert setpoint_of(scan) == pytest.approx(40.0 / 94.0, rel=1e-3)
    assert setpoint_of(with_setpoint(result, scan)) == setpoint_of(scan)
    assert setpoint_of(result.assign_attrs(setpoint="0.55")) == 0.55
