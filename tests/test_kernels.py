"""Compiled kernels must never outlive the sources they were made of."""

import shutil
from pathlib import Path

import numba
import pytest

from overtone import kernels
from overtone.contact import terms


def test_an_edit_in_any_room_of_kernels_moves_the_cache(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    copy = tmp_path / "overtone"
    shutil.copytree(Path(kernels.__file__).parent, copy, ignore=shutil.ignore_patterns("__pycache__"))
    monkeypatch.setattr(kernels, "_PACKAGE", copy)
    folders = [kernels._folder()]
    for room in ("contact/terms.py", "dynamics/steady.py", "inversion/linear.py"):
        with (copy / room).open("a", encoding="utf-8") as source:
            source.write("# an edit\n")
        folders.append(kernels._folder())
    assert len(set(folders)) == len(folders)
    assert all(Path(folder).parent == Path(folders[0]).parent for folder in folders)


def test_other_packages_keep_their_own_cache() -> None:
    assert "kernels-" not in str(numba.config.CACHE_DIR)
    assert "kernels-" in str(terms.power_force._cache.cache_path)
