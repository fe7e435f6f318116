"""``overtone demo``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter
from rich.console import Console

from overtone.cli.progress import progress_bar


def demo(*, output: Annotated[Path, Parameter(name=["--output", "-o"])] = Path("overtone-demo")) -> None:
    """Simulate a session at the microscope: calibrate, scan a PS-LDPE blend, correct, map, and compare with the truth.

    Needs no input. The first run compiles the kernels, which takes half a minute.

    Parameters
    ----------
    output : Path
        Folder for curve.nc, ladder.nc, calibration.toml, scan.nc, results.nc, published.nc and report.html.
    """
    from overtone.demo import run_demo
    from overtone.report.terminal import print_report

    with progress_bar() as update:
        result = run_demo(output, progress=update)
    console = Console()
    print_report(result.report, console)
    for path in result.files:
        console.print(f"wrote {path}", highlight=False, soft_wrap=True)
