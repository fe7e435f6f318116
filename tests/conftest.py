from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def afm_data() -> Path:
    """Real microscope files, which lie beside the repository and are not part of it."""
    folder = Path(__file__).parents[2] / "shared" / "data" / "afm"
    if not folder.is_dir():
        pytest.skip("the real AFM files are not beside the repository (../shared/data/afm)")
    return folder
