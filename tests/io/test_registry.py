import os

import numpy as np
import pytest

from overtone.errors import FileFormatError
from overtone.io.registry import FORMATS, read_channels


def test_keys_are_unique():
    assert len({known.key for known in FORMATS}) == len(FORMATS)


@pytest.mark.parametrize("name", ["scan.csv", "scan", "scan.nc"])
def test_content_decides_not_the_name(tmp_path, igor_wave, name):
    path = tmp_path / name
    path.write_bytes(igor_wave(np.ones((2, 3))))
    assert read_channels(str(path)).format == "igor"


def test_table_under_another_name(tmp_path):
    path = tmp_path / "curve.ibw"
    path.write_text("z [nm], A1 [nm]\n1, 2\n")
    assert read_channels(path).format == "table"


def test_text_under_the_name_of_a_wave(tmp_path):
    path = tmp_path / "scan.ibw"
    path.write_text("This is no wave.\nIt is a letter.\n")
    with pytest.raises(FileFormatError, match=r"Igor binary wave.*'This is no wave.*its name promises Igor"):
        read_channels(path)


def test_missing_file_and_folder(tmp_path):
    with pytest.raises(FileFormatError, match=r"there is no file.*check the name"):
        read_channels(tmp_path / "missing.ibw")
    with pytest.raises(FileFormatError, match="check the folder"):
        read_channels(tmp_path / "nowhere" / "missing.ibw")


def test_folder_that_is_no_set(tmp_path):
    with pytest.raises(FileFormatError, match=r"is a folder.*neaSNOM"):
        read_channels(tmp_path)


def test_empty_file(tmp_path):
    (tmp_path / "empty.ibw").touch()
    with pytest.raises(FileFormatError, match="empty"):
        read_channels(tmp_path / "empty.ibw")


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no pipes on this system")
def test_pipe_is_refused_without_waiting(tmp_path):
    os.mkfifo(tmp_path / "pipe.ibw")
    with pytest.raises(FileFormatError, match="no ordinary file"):
        read_channels(tmp_path / "pipe.ibw")


def test_web_page_that_is_no_header(tmp_path):
    (tmp_path / "page.html").write_text("<html>hello, world</html>")
    with pytest.raises(FileFormatError, match=r"format of page.html"):
        read_channels(tmp_path / "page.html")


@pytest.mark.parametrize(
    ("name", "what"),
    [
        ("nanosurf/NSFopen_grid1.nid", "Nanosurf"),
        ("ntmdt/GaAs_map.mdt", "NT-MDT"),
        ("nanonis/A151216.123306-02602.sxm", "Nanonis"),
        ("agilent/ST_mi-1.mi", "Agilent"),
        ("wsxm/ST_top-1.top", "WSxM"),
    ],
)
def test_formats_that_are_known_but_not_read(afm_data, name, what):
    with pytest.raises(FileFormatError, match=f"got an? .*{what}"):
        read_channels(afm_data / name)
