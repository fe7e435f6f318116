import struct

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from overtone import plots


def colour_bar(axes: Axes) -> Axes:
    return axes.child_axes[0]


def size(figure: Figure) -> tuple[int, int]:
    width, height = struct.unpack(">II", plots.png_bytes(figure)[16:24])
    return width, height


def test_observables_are_all_drawn(observables, titles):
    figure = plots.observables_figure(observables)
    assert len(titles(figure)) == 6
    assert titles(figure)[0] == "height"
    assert size(figure)[0] >= 1000


def test_no_observables_still_make_a_figure():
    figure = plots.observables_figure(xr.Dataset())
    assert [text.get_text() for text in figure.axes[0].texts] == ["no data"]


def test_forces_name_their_harmonics_and_read_in_newton(energies, titles):
    figure = plots.forces_figure(energies)
    assert titles(figure) == [
        *(f"conservative force, harmonic {n}" for n in (0, 1, 2)),
        *(f"dissipative force, harmonic {n}" for n in (1, 2)),
    ]
    assert colour_bar(figure.axes[1]).get_ylabel() == r"$F_{\mathrm{cons}}$ [nN]"
    figure.draw_without_rendering()


def test_energies_read_in_electronvolt_and_the_regime_has_shares(energies, titles):
    figure = plots.energy_figure(energies)
    assert [colour_bar(axes).get_ylabel()[-4:] for axes in figure.axes[:2]] == ["[eV]", "[eV]"]
    labels = [text.get_text() for text in figure.axes[2].get_legend().get_texts()]
    assert labels == ["0 %  attractive", "25.0 %  undetermined", "75.0 %  repulsive"]
    assert len(titles(plots.energy_figure(energies.drop_vars("regime")))) == 2
    figure.draw_without_rendering()


def test_properties_share_one_modulus_scale_and_veil_the_estimates(properties):
    figure = plots.properties_figure("harmonics 1, 2, 3", properties)
    by_title = {axes.get_title(loc="left"): axes for axes in figure.axes}
    modulus = [by_title[t] for t in by_title if t.startswith("modulus")]
    assert len(modulus) == 3
    assert len({axes.images[0].get_clim() for axes in modulus}) == 1
    veiled = {title for title, axes in by_title.items() if len(axes.images) == 2}
    assert veiled == {"modulus, estimate", "adhesion, estimate", "maximum indentation, estimate"}
    assert "status" in by_title
    figure.draw_without_rendering()


def test_a_result_that_concludes_nothing_is_drawn(properties, a_map, status_flags):
    empty = xr.Dataset(
        {
            "modulus": a_map("modulus", np.full((4, 4), np.nan)),
            "status": a_map("status", np.ones((4, 4), np.int8), **status_flags),
        }
    )
    figure = plots.properties_figure("harmonics 0, 1, 2", empty)
    assert [text.get_text() for text in figure.axes[0].texts] == ["no data"]
    figure.draw_without_rendering()
    plots.histogram_figure("harmonics 0, 1, 2", empty).draw_without_rendering()
