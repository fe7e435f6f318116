import struct

import numpy as np

from overtone import plots
from overtone.report.content import Report


def test_overview_is_wide_and_light(observables, energies, properties, truth, titles):
    report = Report("t", "s", observables, energies, {"harmonics 1, 2, 3": properties}, truth, ("a", "b"))
    figure = plots.overview_figure(report)
    assert titles(figure) == [
        "height",
        "mean deflection",
        "amplitude of harmonic 2",
        "modulus, truth",
        "modulus, harmonics 1, 2, 3",
        "width of the 90 % range",
        "status",
    ]
    width = figure.axes[5].images[0].get_array()
    np.testing.assert_allclose([width.min(), width.max()], [2 * np.log10(1.5), 8.0])
    picture = plots.png_bytes(figure)
    assert struct.unpack(">I", picture[16:20])[0] == 1400
    assert len(picture) < 300_000


def test_overview_without_a_modulus_shows_energies(observables, energies, titles):
    figure = plots.overview_figure(Report("t", "s", observables.drop_vars("height"), energies))
    assert titles(figure)[0] == "amplitude of harmonic 1"
    assert titles(figure)[-3:] == ["dissipated energy", "virial", "regime"]
    figure.draw_without_rendering()


def test_overview_prefers_the_result_that_determines_most(observables, energies, properties, titles):
    worse = properties.assign(status=properties["status"].copy(data=np.ones((12, 20), np.int8)))
    report = Report("t", "s", observables, energies, {"worse": worse, "better": properties})
    assert "modulus, better" in titles(plots.overview_figure(report))
    assert "modulus, worse" in titles(plots.overview_figure(report, "worse"))
