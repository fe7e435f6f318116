import struct
import threading

import numpy as np
import pytest
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm, to_rgba
from matplotlib.figure import Figure

from overtone import plots
from overtone.quantities import named_array
from overtone.report.content import Report

STATUS = {
    "flag_values": [0, 1, 3, 4],
    "flag_meanings": "determined not_determined_by_these_data model_does_not_fit at_bound",
}
REGIME = {"flag_values": [-1, 0, 1], "flag_meanings": "attractive undetermined repulsive"}


def metres(ny: int, nx: int, pixel: float = 50e-9) -> dict[str, tuple[str, np.ndarray]]:
    """Coordinates as a scan carries them: y falls from the top row."""
    return {"y": ("y", np.arange(ny)[::-1] * pixel), "x": ("x", np.arange(nx) * pixel)}


def a_map(name: str, values, **attributes) -> xr.DataArray:
    values = np.asarray(values)
    return named_array(name, values, ("y", "x"), metres(*values.shape), **attributes)


def drawn(array: xr.DataArray, **options) -> Axes:
    figure = plots._figure(4.0, 3.5)
    axes = figure.subplots()
    plots.draw_map(axes, array, **options)
    figure.canvas.draw()  # a picture that cannot be drawn is none
    return axes


def colour_bar(axes: Axes) -> Axes:
    return axes.child_axes[0]


@pytest.fixture(scope="module")
def observables() -> xr.Dataset:
    rng = np.random.default_rng(0)
    noise = rng.normal(1.0, 0.01, (12, 20))
    means = {"height": 5e-9, "A0": 1e-10, "A1": 40e-9, "phi1": 0.4, "A2": 1e-10, "phi2": 4.0}
    return xr.Dataset({name: a_map(name, mean * noise) for name, mean in means.items()})


@pytest.fixture(scope="module")
def energies() -> xr.Dataset:
    rng = np.random.default_rng(1)
    dims, coords = ("harmonic", "y", "x"), metres(12, 20) | {"harmonic": [0, 1, 2]}
    return xr.Dataset(
        {
            "F_cons": named_array("F_cons", rng.normal(-5e-9, 1e-10, (3, 12, 20)), dims, coords),
            "F_diss": named_array("F_diss", rng.normal(0.0, 1e-11, (3, 12, 20)), dims, coords),
            "dissipation": a_map("dissipation", rng.normal(2e-18, 1e-18, (12, 20))),
            "virial": a_map("virial", rng.normal(-1e-16, 1e-18, (12, 20))),
            "regime": a_map("regime", np.repeat([[1] * 15 + [0] * 5], 12, axis=0), **REGIME),
        }
    )


@pytest.fixture(scope="module")
def properties() -> xr.Dataset:
    """Left half soft and determined, right half stiff and open."""
    rng = np.random.default_rng(2)
    status = np.repeat([[0] * 10 + [1] * 9 + [4]], 12, axis=0)
    modulus = np.where(status == 0, 1e8, 3e9) * np.exp(rng.normal(0, 0.1, status.shape))
    arrays = {}
    for name, values in (("modulus", modulus), ("adhesion", 100 / modulus), ("indentation", 1 / modulus)):
        arrays[f"{name}_unscreened"] = a_map(f"{name}_unscreened", values)
        arrays[name] = a_map(name, np.where(status == 0, values, np.nan))
    arrays["modulus_lower"] = a_map("modulus_lower", np.where(status == 0, modulus / 1.5, 1e4))
    arrays["modulus_upper"] = a_map("modulus_upper", np.where(status == 0, modulus * 1.5, 1e12))
    arrays["amplification"] = a_map("amplification", np.where(status == 0, 10.0, 1e4))
    arrays["residual"] = a_map("residual", np.where(status == 0, 0.0, 1e-3))
    arrays["status"] = a_map("status", status.astype(np.int8), **STATUS)
    return xr.Dataset(arrays)


@pytest.fixture(scope="module")
def truth(properties: xr.Dataset) -> xr.Dataset:
    soft = properties["status"].values == 0
    return xr.Dataset(
        {
            "modulus": a_map("modulus", np.where(soft, 9e7, 2e9)),
            "adhesion": a_map("adhesion", np.where(soft, 1e-6, 5e-8)),
            "indentation": a_map("indentation", np.where(soft, 1e-8, -1e-9)),
            "material": (("y", "x"), soft.astype(np.int8)),
        }
    )


# ------------------------------------------------------------------------------------------------------ one map


@pytest.mark.parametrize("ascending", [False, True])
def test_row_0_is_at_the_top_and_values_carry_the_unit(ascending):
    values = np.arange(6.0).reshape(2, 3) * 1e-9 + 1e-9
    array = a_map("A1", values)
    if ascending:
        array = array.assign_coords(y=array["y"].values[::-1])
    axes = drawn(array)
    image = axes.images[0]
    assert image.origin == "upper"
    np.testing.assert_allclose(image.get_array(), values * 1e9)
    # Row 0 lies higher on the screen than row 1, whichever way y runs.
    y = array["y"].values * 1e9
    top, bottom = axes.transData.transform([(0.0, y[0]), (0.0, y[1])])[:, 1]
    assert top > bottom
    left, right, low, high = image.get_extent()
    np.testing.assert_allclose(sorted((low, high)), [-25.0, 75.0])
    np.testing.assert_allclose((left, right), (-25.0, 125.0))
    assert axes.get_xlabel() == "x [nm]"
    assert axes.get_ylabel() == "y [nm]"
    assert colour_bar(axes).get_ylabel() == "$A_{1}$ [nm]"


def test_a_map_without_coordinates_is_in_pixels():
    axes = drawn(named_array("A1", np.ones((3, 5)) * 1e-9, ("y", "x")))
    assert axes.get_xlabel() == "x [pixel]"
    assert axes.images[0].get_extent() == [-0.5, 4.5, 2.5, -0.5]


@pytest.mark.parametrize("shape", [(4, 12), (12, 4), (5, 5)])
def test_pixels_are_square_also_in_oblong_maps(shape):
    axes = drawn(a_map("A1", np.random.default_rng(0).random(shape) * 1e-9))
    box = axes.get_position()
    figure = axes.figure.get_size_inches()
    assert (box.height * figure[1]) / (box.width * figure[0]) == pytest.approx(shape[0] / shape[1], rel=1e-3)


def test_the_order_of_dimensions_does_not_turn_the_map():
    array = a_map("A1", np.arange(6.0).reshape(2, 3) * 1e-9)
    np.testing.assert_allclose(drawn(array.T).images[0].get_array(), array.values * 1e9)


def test_colour_limits_ignore_outliers():
    values = np.linspace(1e-9, 2e-9, 400).reshape(20, 20)
    values[0, 0] = 1.0
    low, high = drawn(a_map("A2", values)).images[0].get_clim()
    np.testing.assert_allclose((low, high), np.percentile(values, [2, 98]) * 1e9)


def test_modulus_is_logarithmic_and_reads_in_a_prefixed_unit():
    axes = drawn(a_map("modulus", np.geomspace(1e8, 1e10, 100).reshape(10, 10)))
    assert isinstance(axes.images[0].norm, LogNorm)
    assert colour_bar(axes).get_ylabel() in ("$E_{s}$ [GPa]", "$E_{s}$ [MPa]")


def test_a_signed_force_is_centred_on_zero():
    image = drawn(a_map("F_cons", np.linspace(-1e-9, 3e-9, 100).reshape(10, 10))).images[0]
    low, high = image.get_clim()
    assert low == -high
    assert image.get_cmap().name == "RdBu_r"


def test_a_phase_that_goes_around_gets_a_cyclic_scale():
    image = drawn(a_map("phi2", np.linspace(0.0, 2 * np.pi, 100).reshape(10, 10))).images[0]
    assert image.get_clim() == (0.0, 360.0)


def test_missing_pixels_are_light_grey():
    values = np.linspace(1e-9, 2e-9, 16).reshape(4, 4)
    values[1, 2] = np.nan
    image = drawn(a_map("A1", values)).images[0]
    assert image.get_array().mask.sum() == 1
    assert tuple(image.get_cmap().get_bad()) == pytest.approx(to_rgba(plots.MISSING_COLOUR))


def test_zero_on_a_logarithmic_scale_is_a_value_and_not_missing():
    image = drawn(a_map("residual", [[0.0, 1e-3], [1e-2, 1e-1]])).images[0]
    assert not np.ma.getmaskarray(image.get_array()).any()


def test_nothing_measured_says_so():
    axes = drawn(a_map("A1", np.full((3, 3), np.nan)))
    assert not axes.images
    assert [text.get_text() for text in axes.texts] == ["no data"]


@pytest.mark.parametrize("name", ["A1", "modulus", "F_cons", "phi1"])
@pytest.mark.parametrize(("value", "shape"), [(0.0, (3, 4)), (40.0, (1, 1)), (1e-9, (1, 40))])
def test_constant_and_tiny_maps_are_drawn(name, value, shape):
    figure = plots._figure(3.0, 3.0)
    axes = figure.subplots()
    array = a_map(name, np.full(shape, value))
    plots.draw_map(axes, array, undetermined=array > 1.0)
    figure.canvas.draw()
    low, high = axes.images[0].get_clim()
    assert low < high


def test_undetermined_pixels_lie_under_a_hatched_veil():
    mask = np.zeros((6, 9), bool)
    mask[2:4, 3:] = True
    array = a_map("modulus", np.geomspace(1e8, 1e10, 54).reshape(6, 9))
    axes = drawn(array, undetermined=array.copy(data=mask))
    image, veil = axes.images
    assert veil.get_gid() == "undetermined"
    assert veil.get_extent() == image.get_extent()
    cover = np.asarray(veil.get_array())
    k = cover.shape[0] // 6
    assert cover.shape[:2] == (6 * k, 9 * k)
    covered = cover[..., 3] > 0.5
    np.testing.assert_array_equal(covered, np.repeat(np.repeat(mask, k, 0), k, 1))
    assert np.unique(cover[covered], axis=0).shape[0] == 2  # stripes


def test_colours_follow_the_determined_pixels():
    values = np.full((10, 10), 1e12)
    values[:5] = np.geomspace(1e8, 2e8, 50).reshape(5, 10)
    array = a_map("modulus", values)
    image = drawn(array, undetermined=array > 1e11).images[0]
    assert image.get_clim()[1] < 210.0  # MPa


def test_limits_can_be_given():
    image = drawn(a_map("modulus", np.full((3, 3), 1e9)), limits=(1e6, 1e9)).images[0]
    np.testing.assert_allclose(image.get_clim()[1] / image.get_clim()[0], 1e3)


def test_a_curve_is_drawn_against_its_dimension():
    z = np.linspace(0.0, 80e-9, 30)
    array = named_array("A1", np.linspace(0.0, 94e-9, 30), ("z",), {"z": ("z", z, {"units": "m"})})
    axes = drawn(array, undetermined=array > 50e-9)
    assert not axes.images
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("z [nm]", "$A_{1}$ [nm]")
    np.testing.assert_allclose(axes.lines[0].get_xdata(), z * 1e9)
    assert "undetermined" in [line.get_gid() for line in axes.lines]


def test_of_a_stack_the_first_map_is_drawn_and_named():
    axes = drawn(named_array("A1", np.random.default_rng(0).random((2, 4, 5)) * 1e-9, ("scan", "y", "x")))
    assert axes.images[0].get_array().shape == (4, 5)
    assert "scan 1 of 2" in axes.get_title(loc="left")


def test_long_titles_are_wrapped():
    title = drawn(a_map("A1", np.ones((3, 3))), title="word " * 30).get_title(loc="left")
    assert title.count("\n") >= 2


# ----------------------------------------------------------------------------------------------------- categories


def test_categories_have_a_legend_with_shares():
    figure = plots._figure(4.0, 3.5)
    axes = figure.subplots()
    plots.draw_flags(axes, a_map("status", [[0, 1, 1, 1], [0, 1, 1, 7]], **STATUS))
    figure.canvas.draw()
    labels = [text.get_text() for text in axes.get_legend().get_texts()]
    assert labels == ["25.0 %  determined", "62.5 %  not determined by these data"]
    assert axes.images[0].get_array().mask.sum() == 1  # an unknown flag is no category


def test_flags_along_a_curve():
    figure = plots._figure(4.0, 3.5)
    axes = figure.subplots()
    plots.draw_flags(axes, named_array("regime", [-1, 0, 1, 1], ("z",), {"z": np.arange(4) * 1e-9}, **REGIME))
    figure.canvas.draw()
    assert len(axes.collections[0].get_offsets()) == 4
    assert len(axes.get_legend().get_texts()) == 3


# -------------------------------------------------------------------------------------------------------- figures


def titles(figure: Figure) -> list[str]:
    return [axes.get_title(loc="left") for axes in figure.axes if axes.get_title(loc="left")]


def size(figure: Figure) -> tuple[int, int]:
    width, height = struct.unpack(">II", plots.png_bytes(figure)[16:24])
    return width, height


def test_observables_are_all_drawn(observables):
    figure = plots.observables_figure(observables)
    assert len(titles(figure)) == 6
    assert titles(figure)[0] == "height"
    assert size(figure)[0] >= 1000


def test_no_observables_still_make_a_figure():
    figure = plots.observables_figure(xr.Dataset())
    assert [text.get_text() for text in figure.axes[0].texts] == ["no data"]


def test_forces_name_their_harmonics_and_read_in_newton(energies):
    figure = plots.forces_figure(energies)
    assert titles(figure) == [
        *(f"conservative force, harmonic {n}" for n in (0, 1, 2)),
        *(f"dissipative force, harmonic {n}" for n in (1, 2)),
    ]
    assert colour_bar(figure.axes[1]).get_ylabel() == r"$F_{\mathrm{cons}}$ [nN]"
    figure.draw_without_rendering()


def test_energies_read_in_electronvolt_and_the_regime_has_shares(energies):
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


def test_a_result_that_concludes_nothing_is_drawn(properties):
    empty = xr.Dataset(
        {
            "modulus": a_map("modulus", np.full((4, 4), np.nan)),
            "status": a_map("status", np.ones((4, 4), np.int8), **STATUS),
        }
    )
    figure = plots.properties_figure("harmonics 0, 1, 2", empty)
    assert [text.get_text() for text in figure.axes[0].texts] == ["no data"]
    figure.draw_without_rendering()
    plots.histogram_figure("harmonics 0, 1, 2", empty).draw_without_rendering()


def test_histograms_count_every_pixel_and_show_true_medians(properties, truth):
    figure = plots.histogram_figure("harmonics 1, 2, 3", properties, truth, ("stiff", "_soft"))
    axes = figure.axes[0]
    counts = sum(patch.get_data().values.sum() for patch in axes.patches)
    assert counts == properties["status"].size
    filled = sum(patch.get_data().values.sum() for patch in axes.patches if patch.get_fill())
    assert filled == int((properties["status"] == 0).sum())
    unit = 1e6 if "MPa" in axes.get_xlabel() else 1e9
    lines = sorted(line.get_xdata()[0] * unit for line in axes.lines)
    np.testing.assert_allclose(lines, [9e7, 2e9])
    legend = [text.get_text() for text in figure.legends[0].get_texts()]
    assert legend == ["material stiff", "material _soft", "determined", "not determined", "true median"]
    figure.draw_without_rendering()


def test_histograms_without_truth(properties):
    figure = plots.histogram_figure("$ in a label", properties)
    assert not figure.axes[0].lines
    figure.draw_without_rendering()


def test_overview_is_wide_and_light(observables, energies, properties, truth):
    report = Report("t", "s", observables, energies, {"harmonics 1, 2, 3": properties}, truth, ("a", "b"))
    figure = plots.overview_figure(report)
    assert titles(figure) == [
        "height",
        "phase lag of harmonic 1",
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


def test_overview_without_a_modulus_shows_energies(observables, energies):
    figure = plots.overview_figure(Report("t", "s", observables.drop_vars("height"), energies))
    assert titles(figure)[0] == "amplitude of harmonic 1"
    assert titles(figure)[-3:] == ["dissipated energy", "virial", "regime"]
    figure.draw_without_rendering()


def test_overview_prefers_the_result_that_determines_most(observables, energies, properties):
    worse = properties.assign(status=properties["status"].copy(data=np.ones((12, 20), np.int8)))
    report = Report("t", "s", observables, energies, {"worse": worse, "better": properties})
    assert "modulus, better" in titles(plots.overview_figure(report))
    assert "modulus, worse" in titles(plots.overview_figure(report, "worse"))


def test_figures_can_be_drawn_in_threads(energies):
    pictures: list[bytes] = []
    work = [
        threading.Thread(target=lambda: pictures.append(plots.png_bytes(plots.energy_figure(energies))))
        for _ in range(2)
    ]
    for thread in work:
        thread.start()
    for thread in work:
        thread.join()
    assert len(pictures) == 2
    assert pictures[0] == pictures[1]
