import numpy as np
import pytest
import xarray as xr

from overtone import plots
from overtone.inversion.reconstruction import BEYOND_JUMP, RECONSTRUCTED
from overtone.plots.reconstruction import reconstruction_figure


@pytest.fixture
def reconstruction() -> xr.Dataset:
    gap = np.concatenate([np.linspace(-3e-9, -2.5e-9, 5), np.linspace(-1e-9, 30e-9, 60)])
    force = np.where(gap < 0.0, -gap * 5.0, 0.0)
    columns = {"force": force, "force_mean": 1.05 * force, "dissipation": 1e-18 * (gap < 0.0)}
    status = np.where(gap < -2e-9, BEYOND_JUMP, RECONSTRUCTED).astype(np.int8)
    arrays = {name: ("gap", values) for name, values in columns.items()} | {"status": ("gap", status)}
    return xr.Dataset(arrays, coords={"gap": gap})


def test_both_forces_and_the_loss_are_drawn_in_readable_units(reconstruction: xr.Dataset, titles) -> None:
    figure = reconstruction_figure(reconstruction, reconstruction["force"])
    assert titles(figure) == ["force", "energy lost per cycle"]
    forces, losses = figure.axes
    assert [forces.get_ylabel(), losses.get_ylabel()] == ["$F$ [nN]", r"$E_{\mathrm{dis}}$ [eV]"]
    assert forces.get_xlabel() == "closest gap [nm]"
    lines = {line.get_label(): line for line in forces.lines}
    beyond = lines["from A1 and phi1, beyond a jump or at the far end"]
    np.testing.assert_allclose(beyond.get_xdata(), np.linspace(-3.0, -2.5, 5))
    np.testing.assert_allclose(beyond.get_ydata(), np.linspace(15.0, 12.5, 5))
    assert lines["from A0"].get_ydata()[0] == pytest.approx(15.75)
    assert np.isnan(lines["truth"].get_ydata()[5])  # nothing is drawn across the hole
    assert forces.get_xlim()[1] < 5.0  # the free stretch is left out
    legend = [text.get_text() for text in figure.legends[0].get_texts()]
    assert legend[0] == "from A1 and phi1"
    assert plots.png_bytes(figure)[:4] == b"\x89PNG"


def test_a_curve_without_a0_or_loss_is_drawn(reconstruction: xr.Dataset) -> None:
    bare = reconstruction.drop_vars("force_mean").assign(dissipation=0.0 * reconstruction["force"])
    figure = reconstruction_figure(bare)
    assert [text.get_text() for text in figure.legends[0].get_texts()][-1] != "from A0"
    low, high = figure.axes[1].get_ylim()
    assert low < 0.0 < high
    assert plots.png_bytes(figure)
    assert plots.png_bytes(reconstruction_figure(xr.zeros_like(bare)))
