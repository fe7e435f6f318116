"""Make the pictures of the pages: the overview of the demonstration, and an approach curve."""

from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

import overtone as ot
from overtone.demo import run_demo
from overtone.io.atomic import atomic_path
from overtone.plots import curve_figure, overview_figure, png_bytes

IMAGES = Path(__file__).parent / "images"


def overview() -> bytes:
    """Return the overview of the demonstration."""
    with TemporaryDirectory() as folder:
        return png_bytes(overview_figure(run_demo(folder).report))


def approach() -> bytes:
    """Return an approach curve with two branches: the probe and the sample of docs/simulate.md."""
    probe = ot.Probe.simple(
        stiffness=40.0,
        frequency=320e3,
        quality_factor=400.0,
        radius=10e-9,
        drive_frequency=320e3,
        free_amplitude=25e-9,
    )
    polymer = ot.sample("dmt-viscous", modulus=1e9, poisson_ratio=0.35, adhesion=10e-9, viscosity=50.0)
    z = np.linspace(2e-9, 30e-9, 141)
    states = ot.steady_states(probe, polymer, z=z)
    return png_bytes(curve_figure(ot.approach_curve(probe, polymer, z=z), states))


def main() -> None:
    """Write docs/images."""
    for name, picture in (("overview", overview), ("curve", approach)):
        with atomic_path(IMAGES / f"{name}.png") as temporary:
            temporary.write_bytes(picture())


if __name__ == "__main__":
    main()
