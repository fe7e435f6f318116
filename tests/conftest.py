"""Where reference numbers and real microscope files lie: beside the repository, read in place."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

_SHARED = Path(__file__).parents[2] / "shared"


def _folder(path: Path) -> Path:
    if not path.is_dir():
        pytest.skip(f"no folder {path.name} of reference data beside the repository")
    return path


@pytest.fixture(scope="session")
def afm_data() -> Path:
    """Return the folder of real microscope files."""
    return _folder(_SHARED / "data" / "afm")


@pytest.fixture(scope="session")
def steady_states() -> list[dict[str, Any]]:
    """Return the eight steady states of section 3 of the method's paper, by shooting."""
    return list(
        json.loads((_folder(_SHARED / "reference") / "steady_state_section3.json").read_text())["rows"]
    )


@pytest.fixture(scope="session")
def jkr_reference() -> np.ndarray:
    """Return contact radius [m], penetration [m] and force [N] of a JKR contact, E* 1.0905 GPa, R 10 nm, 20 nN."""
    path = _folder(_SHARED / "reference" / "jkr") / "jkr_Es1.09GPa_R10nm_Fad20nN.csv"
    return np.loadtxt(path, delimiter=",").T * 1e-9


@pytest.fixture(scope="session")
def eq17_quadrature() -> list[dict[str, Any]]:
    """Return harmonics of eq 17 by quadrature."""
    return list(json.loads((_folder(_SHARED / "reference") / "eq17_quadrature.json").read_text())["rows"])
