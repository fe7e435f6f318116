"""The files of tests/io, made there."""

import runpy
from pathlib import Path

_MADE = runpy.run_path(str(Path(__file__).parents[1] / "io" / "conftest.py"))
igor_wave, nanoscope_file = _MADE["igor_wave"], _MADE["nanoscope_file"]
