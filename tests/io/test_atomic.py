import os
import stat

import pytest

from overtone.errors import FileFormatError
from overtone.io.atomic import atomic_path


def test_writes_whole(tmp_path):
    target = tmp_path / "report.html"
    target.write_text("old")
    with atomic_path(target) as temporary:
        assert (temporary.parent, temporary.suffix) == (tmp_path, ".html")
        temporary.write_text("new")
        assert target.read_text() == "old"
    assert target.read_text() == "new"
    assert [file.name for file in tmp_path.iterdir()] == ["report.html"]


@pytest.mark.parametrize("problem", [ValueError, KeyboardInterrupt])
def test_or_not_at_all(tmp_path, problem):
    target = tmp_path / "a.png"
    target.write_text("old")

    def write_half():
        with atomic_path(target) as temporary:
            temporary.write_text("half")
            raise problem

    with pytest.raises(problem):
        write_half()
    assert target.read_text() == "old"
    assert [file.name for file in tmp_path.iterdir()] == ["a.png"]


def test_full_disk_is_told(tmp_path):
    def write():
        with atomic_path(tmp_path / "a.png") as temporary:
            temporary.write_text("half")
            raise OSError(28, "No space left on device")

    with pytest.raises(FileFormatError, match="No space left"):
        write()
    assert list(tmp_path.iterdir()) == []


def test_nothing_written_is_an_error(tmp_path):
    with pytest.raises(FileFormatError, match="cannot write"), atomic_path(tmp_path / "a.nc"):
        pass


@pytest.mark.parametrize(("name", "message"), [("missing/a.nc", "existing folder"), ("", "got a folder")])
def test_places_that_cannot_be_written(tmp_path, name, message):
    with pytest.raises(FileFormatError, match=message), atomic_path(tmp_path / name):
        pass


@pytest.mark.skipif(os.name == "nt", reason="Windows has no such permissions")
def test_others_may_read_the_file(tmp_path):
    (tmp_path / "plain").write_text("")
    with atomic_path(tmp_path / "a.nc") as temporary:
        temporary.write_text("new")
    assert stat.S_IMODE((tmp_path / "a.nc").stat().st_mode) == stat.S_IMODE(
        (tmp_path / "plain").stat().st_mode
    )
