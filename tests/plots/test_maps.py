import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm, to_rgba

from overtone import plots
from overtone.plots.canvas import new_figure
from overtone.plots.scales import MISSING_COLOUR
from overtone.quantities import named_array


def colour_bar(axes: Axes) -> Axes:
    return axes.child_axes[0]


@pytest.mark.parametrize("ascending", [False, True])
def test_row_0_is_at_the_top_and_values_carry_the_unit(ascending, a_map, drawn):
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


def test_a_map_without_coordinates_is_in_pixels(drawn):
    axes = drawn(named_array("A1", np.ones((3, 5)) * 1e-9, ("y", "x")))
    assert axes.get_xlabel() == "x [pixel]"
    assert axes.images[0].get_extent() == [-0.5, 4.5, 2.5, -0.5]


@pytest.mark.parametrize("shape", [(4, 12), (12, 4), (5, 5)])
def test_pixels_are_square_also_in_oblong_maps(shape, a_map, drawn):
    axes = drawn(a_map("A1", np.random.default_rng(0).random(shape) * 1e-9))
    box = axes.get_position()
    figure = axes.figure.get_size_inches()
    assert (box.height * figure[1]) / (box.width * figure[0]) == pytest.approx(
        shape[0] / shape[1], rel=1e-3, abs=0
    )


def test_the_order_of_dimensions_does_not_turn_the_map(a_map, drawn):
    array = a_map("A1", np.arange(6.0).reshape(2, 3) * 1e-9)
    np.testing.assert_allclose(drawn(array.T).images[0].get_array(), array.values * 1e9)


def test_colour_limits_ignore_outliers(a_map, drawn):
    values = np.linspace(1e-9, 2e-9, 400).reshape(20, 20)
    values[0, 0] = 1.0
    low, high = drawn(a_map("A2", values)).images[0].get_clim()
    np.testing.assert_allclose((low, high), np.percentile(values, [2, 98]) * 1e9)


def test_modulus_is_logarithmic_and_reads_in_a_prefixed_unit(a_map, drawn):
    axes = drawn(a_map("modulus", np.geomspace(1e8, 1e10, 100).reshape(10, 10)))
    assert isinstance(axes.images[0].norm, LogNorm)
    assert colour_bar(axes).get_ylabel() in ("$E_{s}$ [GPa]", "$E_{s}$ [MPa]")


def test_a_signed_force_is_centred_on_zero(a_map, drawn):
    image = drawn(a_map("F_cons", np.linspace(-1e-9, 3e-9, 100).reshape(10, 10))).images[0]
    low, high = image.get_clim()
    assert low == -high
    assert image.get_cmap().name == "RdBu_r"


def test_a_phase_that_goes_around_gets_a_cyclic_scale(a_map, drawn):
    image = drawn(a_map("phi2", np.linspace(0.0, 2 * np.pi, 100).reshape(10, 10))).images[0]
    assert image.get_clim() == (0.0, 360.0)


def test_missing_pixels_are_light_grey(a_map, drawn):
    values = np.linspace(1e-9, 2e-9, 16).reshape(4, 4)
    values[1, 2] = np.nan
    image = drawn(a_map("A1", values)).images[0]
    assert image.get_array().mask.sum() == 1
    assert tuple(image.get_cmap().get_bad()) == pytest.approx(to_rgba(MISSING_COLOUR))


def test_zero_on_a_logarithmic_scale_is_a_value_and_not_missing(a_map, drawn):
    image = drawn(a_map("residual", [[0.0, 1e-3], [1e-2, 1e-1]])).images[0]
    assert not np.ma.getmaskarray(image.get_array()).any()


def test_nothing_measured_says_so(a_map, drawn):
    axes = drawn(a_map("A1", np.full((3, 3), np.nan)))
    assert not axes.images
    assert [text.get_text() for text in axes.texts] == ["no data"]


@pytest.mark.parametrize("name", ["A1", "modulus", "F_cons", "phi1"])
@pytest.mark.parametrize(("value", "shape"), [(0.0, (3, 4)), (40.0, (1, 1)), (1e-9, (1, 40))])
def test_constant_and_tiny_maps_are_drawn(name, value, shape, a_map):
    figure = new_figure(3.0, 3.0)
    axes = figure.subplots()
    array = a_map(name, np.full(shape, value))
    plots.draw_map(axes, array, undetermined=array > 1.0)
    figure.canvas.draw()
    low, high = axes.images[0].get_clim()
    assert low < high


def test_undetermined_pixels_lie_under_a_hatched_veil(a_map, drawn):
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


def test_colours_follow_the_determined_pixels(a_map, drawn):
    values = np.full((10, 10), 1e12)
    values[:5] = np.geomspace(1e8, 2e8, 50).reshape(5, 10)
    array = a_map("modulus", values)
    image = drawn(array, undetermined=array > 1e11).images[0]
    assert image.get_clim()[1] < 210.0  # MPa


def test_limits_can_be_given(a_map, drawn):
    image = drawn(a_map("modulus", np.full((3, 3), 1e9)), limits=(1e6, 1e9)).images[0]
    np.testing.assert_allclose(image.get_clim()[1] / image.get_clim()[0], 1e3)


def test_a_curve_is_drawn_against_its_dimension(drawn):
    z = np.linspace(0.0, 80e-9, 30)
    array = named_array("A1", np.linspace(0.0, 94e-9, 30), ("z",), {"z": ("z", z, {"units": "m"})})
    axes = drawn(array, undetermined=array > 50e-9)
    assert not axes.images
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("z [nm]", "$A_{1}$ [nm]")
    np.testing.assert_allclose(axes.lines[0].get_xdata(), z * 1e9)
    assert "undetermined" in [line.get_gid() for line in axes.lines]


def test_of_a_stack_the_first_map_is_drawn_and_named(drawn):
    axes = drawn(named_array("A1", np.random.default_rng(0).random((2, 4, 5)) * 1e-9, ("scan", "y", "x")))
    assert axes.images[0].get_array().shape == (4, 5)
    assert "scan 1 of 2" in axes.get_title(loc="left")


def test_long_titles_are_wrapped(a_map, drawn):
    title = drawn(a_map("A1", np.ones((3, 3))), title="word " * 30).get_title(loc="left")
    assert title.count("\n") >= 2
