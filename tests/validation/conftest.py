"""Results of other programs, beside the repository, and the script of the page docs/validation.md."""

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

import pytest

_ROOT = Path(__file__).parents[2]
_REFERENCE = _ROOT.parent / "shared" / "reference"


def _folder(name: str) -> Path:
    if not (_REFERENCE / name).is_dir():
        pytest.skip(f"no folder {name} of reference data beside the repository")
    return _REFERENCE / name


@pytest.fixture(scope="session")
def pydampf() -> Path:
    """Return the folder of approach curves that another program stepped through in time."""
    return _folder("pydampf")


@pytest.fixture(scope="session")
def solares() -> Path:
    """Return the folder of a three-mode lever over generalised Maxwell solids, stepped through in time."""
    return _folder("solares")


@pytest.fixture(scope="session")
def page() -> ModuleType:
    """Return the script of the page, which has eqs 6 and 19 as they are printed."""
    spec = importlib.util.spec_from_file_location("validation_page", _ROOT / "docs" / "validation.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module
