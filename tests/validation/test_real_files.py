"""The page docs/files.md: what overtone reads from files that others published, held against other readers."""

import importlib
import importlib.util
import math
import re
import sys
from collections import Counter
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from overtone.errors import FileFormatError
from overtone.io.registry import read_channels

SCRIPT = Path(__file__).parents[2] / "docs" / "files.py"
LIBRARIES = ("gwyddionpy", "gwyddionpy_converter", "gwyfile", "gsffile", "NSFopen", "tifffile", "h5py")


def _script() -> ModuleType:
    spec = importlib.util.spec_from_file_location("files_page", SCRIPT)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


PAGE = _script()
FILES = {file.name: file for vendor in PAGE.VENDORS for file in vendor.files}
READ = [name for name, file in FILES.items() if file.readers]
BRIDGED = {"nanonis", "ntmdt", "agilent", "wsxm"}


def readable(name: str) -> str:
    if name.split("/")[0] in BRIDGED:
        for library in LIBRARIES[:3]:
            pytest.importorskip(library)
    return name


@pytest.fixture(scope="module")
def text() -> str:
    return str(PAGE.section(PAGE.PAGE.read_text(encoding="utf-8"), "values"))


def written(text: str, name: str) -> list[list[str]]:
    """The cells of the table of a file."""
    (part,) = re.findall(rf"^\*\*{re.escape(Path(name).name)}\*\* \(.+?(?=^\*\*|^###|\Z)", text, re.M | re.S)
    lines = [line for line in part.splitlines() if line.startswith("| ")][1:]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]


def test_every_file_of_the_folder_is_on_the_page(afm_data: Path, text: str) -> None:
    there = {path.relative_to(afm_data).as_posix() for path in afm_data.rglob("*") if path.is_file()}
    there = {str(Path(name).parent) if name.startswith("neasnom/") else name for name in there} - {
        "PROVENANCE.md"
    }
    assert there == {name.partition("::")[0] for name in FILES}
    assert set(PAGE.origins(afm_data)) == there
    assert Counter(re.findall(r"^\*\*(.+?)\*\*", text, re.M)) == Counter(Path(name).name for name in FILES)
    assert "/work" not in PAGE.PAGE.read_text(encoding="utf-8")


@pytest.mark.parametrize("name", READ)
def test_channels_units_and_named_pixels(afm_data: Path, text: str, name: str) -> None:
    rows = PAGE.rows_of(afm_data, FILES[readable(name)], asked=False)
    assert written(text, name) == [[row.label, row.unit, *row.pixels, cells[-1]] for row, cells in
                                   zip(rows, written(text, name), strict=True)]  # fmt: skip
    assert f"\n{PAGE.headed(afm_data, FILES[name])}\n" in text


@pytest.mark.parametrize("name", READ)
def test_every_pixel_against_other_readers(afm_data: Path, text: str, name: str) -> None:
    for library in LIBRARIES:
        pytest.importorskip(library)
    rows = PAGE.rows_of(afm_data, FILES[name])
    assert all(row.digits is not None and row.digits >= 14 for row in rows)
    assert [row.agrees for row in rows] == [cells[-1] for cells in written(text, name)]


def test_other_readers_would_see_a_wrong_scale_a_flip_and_a_wrong_unit(afm_data: Path) -> None:
    values = next(c.values for c in read_channels(afm_data / "ibw/AR_20211011.ibw").channels)
    for wrong in (values[::-1], values[:, ::-1], values.T, values * (1.0 + 1e-9), values * 1e3, values[:-1]):
        assert PAGE.digits(wrong, values) < 10
    holes, all_there = values.copy(), np.ones_like(values)
    holes[3, 4] = np.nan
    assert PAGE.digits(holes, values) == 16
    assert PAGE.digits(values, holes) == 0  # a number where others have none
    assert PAGE.digits(all_there * np.nan, all_there) == 0


def test_the_picture_that_park_rendered_shows_the_way_up(afm_data: Path) -> None:
    pytest.importorskip("tifffile")
    upright, upside_down, mirrored = PAGE.park_picture(afm_data / "park/Park_20210916_034.tiff")
    assert upright > 0.92
    assert max(upside_down, mirrored) < 0.1


@pytest.mark.parametrize("one", PAGE.MEANS, ids=lambda one: one.name)
def test_feedbacks_held_what_their_headers_say(afm_data: Path, one: tuple[str, str, float, float]) -> None:
    readable(one[0])
    assert PAGE.mean_of(afm_data, one) == pytest.approx(one[2], rel=one[3], abs=0)


@pytest.mark.parametrize("one", PAGE.FACTS, ids=lambda one: f"{one.name}-{one.what}")
def test_facts_that_a_person_noted(afm_data: Path, one: tuple[str, str, float, float]) -> None:
    assert read_channels(afm_data / one[0]).facts[one[1]].value == pytest.approx(one[2], rel=one[3], abs=0)


def test_the_file_that_was_cut_off_is_refused(afm_data: Path) -> None:
    with pytest.raises(FileFormatError, match="565248 bytes for image 3 as its header says, got 489346"):
        read_channels(afm_data / "bruker/ST_di_corrupted.di")


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_the_page_is_what_the_script_writes_now(afm_data: Path, text: str) -> None:
    for library in LIBRARIES:
        pytest.importorskip(library)
    assert text.strip() == PAGE.values_section(afm_data).strip()


def test_the_table_of_damage_counts_enough_and_nothing_bad() -> None:
    text = PAGE.section(PAGE.PAGE.read_text(encoding="utf-8"), "damage")
    total, bad = (
        int(re.match(r"\s*(\d+) damaged files", text)[1]),
        int(re.search(r"\*\*(\d+) did\s+not", text)[1]),
    )
    rows = [line.strip("| ").split(" | ") for line in text.splitlines() if re.search(r"\| \d", line)]
    assert total == sum(int(row[1]) for row in rows)
    assert total >= 2000
    assert bad == 0
    for kind, _, *shares, slowest in rows:
        assert math.isclose(sum(map(float, shares)), 100.0, abs_tol=1.6), kind
        assert float(slowest) < 5.0, kind
