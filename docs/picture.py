"""Make the picture of the README: the overview of the demonstration."""

from pathlib import Path
from tempfile import TemporaryDirectory

from overtone.demo import run_demo
from overtone.io.atomic import atomic_path
from overtone.plots import overview_figure, png_bytes


def main() -> None:
    """Write docs/images/overview.png."""
    with TemporaryDirectory() as folder:
        report = run_demo(folder).report
    with atomic_path(Path(__file__).parent / "images" / "overview.png") as temporary:
        temporary.write_bytes(png_bytes(overview_figure(report)))


if __name__ == "__main__":
    main()
