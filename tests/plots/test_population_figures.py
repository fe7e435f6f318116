"""Figures of results by method population: what is drawn is what the datasets say, and texts keep clear."""

import itertools
import math
import runpy
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.colors import to_hex
from matplotlib.figure import Figure

from overtone.errors import ObservablesError
from overtone.plots.before_after import before_after_figure
from overtone.plots.observable_space import Axis, Scatter, space_figure
from overtone.plots.phases import NONE_COLOUR, as_text, phase_colour, phases_figure
from overtone.plots.prediction import prediction_figure, standardised
from overtone.plots.profiles import profile_figure
from overtone.plots.property_maps import property_maps_figure
from overtone.plots.relief import shading
from overtone.plots.setpoints import setpoint_figure

HERE = Path(__file__).parent
world = SimpleNamespace(**runpy.run_path(str(HERE / "population.py")))
boxes = runpy.run_path(str(HERE / "test_sheet.py"))["boxes"]
SIZE = 24


@pytest.fixture(scope="module")
def scan() -> xr.Dataset:
    return world.observables(2, size=SIZE)


@pytest.fixture(scope="module")
def result(scan: xr.Dataset) -> xr.Dataset:
    return world.result(scan, 2)


@pytest.fixture(scope="module")
def profile(result: xr.Dataset) -> xr.Dataset:
    line = result[[name for name in result.data_vars if result[name].dims == ("y", "x")]].isel(y=6)
    known = world.truth(2, SIZE).isel(y=6)
    return line.assign({f"{name}_truth": known[name] for name in known.data_vars})


def cell(figure: Figure, title: str) -> Axes:
    return next(axes for axes in figure.axes if axes.get_title("left").replace("\n", " ").startswith(title))


def keep_clear(figure: Figure) -> None:
    seen = boxes(figure)
    width, height = figure.bbox.size
    assert len(seen) > 3
    for text, (left, bottom, right, top) in seen.items():
        assert left > 0.0 and bottom > 0.0 and right < width and top < height, text  # noqa: PT018
    for one, other in itertools.combinations(seen, 2):
        a, b = seen[one], seen[other]
        assert a[2] <= b[0] or b[2] <= a[0] or a[3] <= b[1] or b[3] <= a[1], (one, other)


# --- relief -----------------------------------------------------------------------------------------------------------


def test_slopes_to_the_upper_left_are_light_and_those_away_from_it_dark():
    y, x = np.mgrid[:41, :41].astype(float)
    hill = np.exp(-((y - 20.0) ** 2 + (x - 20.0) ** 2) / 50.0)
    shade = shading(hill)
    assert shade[16, 16] > 0.3  # row 0 is on top
    assert shade[24, 24] < -0.3
    assert shade[24, 16] == pytest.approx(
        shade[16, 24], rel=1e-6
    )  # along the light neither side is turned to it
    assert shade[24, 24] < shade[24, 16] < 0.0 < shade[16, 16]
    assert shade[20, 20] == pytest.approx(0.0, abs=1e-9)


def test_tilt_and_size_of_the_relief_do_not_change_its_shade():
    rng = np.random.default_rng(0)
    y, x = np.mgrid[:30, :30].astype(float)
    rough = rng.normal(size=(30, 30))
    np.testing.assert_allclose(shading(1e-9 * (rough + 4.0 * x - 2.0 * y)), shading(rough), rtol=0, atol=1e-9)


def test_no_height_is_flat():
    height = np.random.default_rng(0).normal(size=(12, 12))
    height[3, 4] = math.nan
    assert shading(height)[3, 4] == 0.0
    assert not shading(np.full((5, 5), math.nan)).any()
    assert not shading(np.ones((5, 5))).any()
    assert not shading(np.arange(5.0)[None, :]).any()


def test_relief_lies_between_colours_and_veil(scan, result):
    figure = property_maps_figure(result, scan["height"])
    images = cell(figure, "modulus, median").images
    gids = [image.get_gid() for image in sorted(images, key=lambda image: image.get_zorder())]
    assert gids == [None, "relief", "undetermined"]
    assert images[0].get_extent() == images[-1].get_extent()
    maps = [axes for axes in figure.axes if axes.images and axes.get_title("left")]
    assert len(maps) == 15
    assert all(any(image.get_gid() == "relief" for image in axes.images) for axes in maps)
    flat = property_maps_figure(result)
    assert not any(image.get_gid() == "relief" for axes in flat.axes for image in axes.images)


# --- before and after -------------------------------------------------------------------------------------------------


def test_every_signal_stands_before_and_after_on_scales_of_one_width(scan):
    figure = before_after_figure(world.before(scan), scan)
    for title in (
        "mean deflection",
        "amplitude 1",
        "phase 1",
        "amplitude 2",
        "phase 2",
        "amplitude 3",
        "phase 3",
    ):
        pair = [cell(figure, f"{title}, {word}") for word in ("as read", "corrected")]
        spans = [float(np.ptp(axes.images[0].get_clim())) for axes in pair]
        assert spans[0] == pytest.approx(spans[1], rel=1e-9)
        labels = [axes.child_axes[0].get_ylabel() for axes in pair]
        assert labels[0] == labels[1]
        assert "[" in labels[0]
    drawn = np.asarray(cell(figure, "phase 2, corrected").images[0].get_array())
    expected = np.degrees(scan["phi2"].values - 2.0 * scan["phi1"].values)
    np.testing.assert_allclose(np.exp(1j * np.radians(drawn)), np.exp(1j * np.radians(expected)), rtol=1e-9)
    assert cell(figure, "topography").images


def test_a_drift_does_not_hide_what_is_left(scan):
    rows = np.linspace(-1.0, 1.0, SIZE)[:, None]
    drifting = world.before(scan).assign(A0=scan["A0"] + 3e-9 * rows)
    figure = before_after_figure(drifting, scan)
    wide, narrow = (
        float(np.ptp(cell(figure, f"mean deflection, {word}").images[0].get_clim()))
        for word in ("as read", "corrected")
    )
    low, high = np.percentile(scan["A0"].values, [2.0, 98.0])
    unit = 1e12 if "pm" in cell(figure, "mean deflection, corrected").child_axes[0].get_ylabel() else 1e9
    assert narrow == pytest.approx((high - low) * unit, rel=1e-6)
    assert wide > 10.0 * narrow


def test_scans_of_other_pixels_are_refused(scan):
    with pytest.raises(ObservablesError, match="do not fit"):
        before_after_figure(scan.isel(y=slice(1, None)), scan)


# --- phases -----------------------------------------------------------------------------------------------------------


def test_none_is_grey_and_phases_keep_their_colours(result):
    axes = cell(phases_figure(result), "phase")
    image = axes.images[0]
    phase = result["phase"].values
    for code, colour in ((-1, NONE_COLOUR), (0, phase_colour(0)), (1, phase_colour(1))):
        found = {to_hex(rgba) for rgba in image.to_rgba(image.get_array())[phase == code]}
        assert found == {colour}
    assert len({NONE_COLOUR, *(phase_colour(k) for k in range(6))}) == 7


def test_a_name_is_no_formula():
    assert as_text("_a_b$x$") == r"a b\$x\$"


def test_every_pixel_is_drawn_in_the_colour_of_its_phase(scan, result):
    pair = Scatter(
        "both",
        Axis("A0", "$A_0$", "m", scan["A0"].values.ravel()),
        Axis("A2", "$A_2$", "m", scan["A2"].values.ravel()),
    )
    figure = space_figure([pair], result["phase"])
    points = figure.axes[0].collections[0]
    colours = [to_hex(colour) for colour in points.get_facecolors()]
    drawn = sorted(zip(map(tuple, points.get_offsets().data), colours, strict=True))
    picometres = (1e12 * scan[name].values.ravel() for name in ("A0", "A2"))
    codes = result["phase"].values.ravel()
    expected = sorted((x, y, phase_colour(int(code))) for x, y, code in zip(*picometres, codes, strict=True))
    np.testing.assert_allclose([point for point, _ in drawn], [row[:2] for row in expected], rtol=1e-9)
    assert [colour for _, colour in drawn] == [row[2] for row in expected]
    none = int((codes < 0).sum())
    assert set(colours[:none]) == {NONE_COLOUR}  # below the others
    assert NONE_COLOUR not in colours[none:]
    assert figure.axes[0].get_xlabel() == "$A_0$ [pm]"
    keep_clear(figure)


# --- profiles ---------------------------------------------------------------------------------------------------------


def test_a_profile_holds_the_line_its_bands_and_the_truth(profile):
    axes = cell(profile_figure(profile, ("modulus",)), "modulus")
    assert axes.get_ylabel() == "$E_{s}$ [MPa]"
    lines = [np.asarray(line.get_ydata(), dtype=float) for line in axes.lines]
    for name in ("modulus_unscreened", "modulus_unpooled", "modulus", "modulus_truth"):
        expected = 1e-6 * profile[name].values
        assert any(np.allclose(line, expected, rtol=1e-9, atol=0.0, equal_nan=True) for line in lines), name
    tops = [band.get_datalim(axes.transData).y1 for band in axes.collections[:2]]
    assert max(tops) == pytest.approx(1e-6 * float(profile["modulus_unpooled_upper"].max()), rel=1e-6)
    assert min(tops) == pytest.approx(1e-6 * float(profile["modulus_upper"].max()), rel=1e-6)
    assert axes.get_yscale() == "log"


def test_what_is_pooled_is_in_the_frame_however_wide_the_pixels_alone_are(profile):
    wide = profile.assign(modulus_unpooled_upper=profile["modulus_unpooled_upper"] * 1e9)
    low, high = cell(profile_figure(wide, ("modulus",)), "modulus").get_ylim()
    assert low < 1e-6 * float(profile["modulus_lower"].min())
    assert 1e-6 * float(profile["modulus_upper"].max()) < high < 1e3 * float(profile["modulus_upper"].max())


def test_colours_along_the_foot_are_the_phases_of_the_pixels(profile):
    axes = cell(profile_figure(profile, ("modulus",)), "modulus")
    position = 1e9 * profile["x"].values
    for x, code in zip(position, profile["phase"].values, strict=True):
        spans = [patch for patch in axes.patches if patch.get_x() <= x <= patch.get_x() + patch.get_width()]
        assert [to_hex(patch.get_facecolor()) for patch in spans] == [phase_colour(int(code))]


def test_a_profile_without_truth_and_without_single_pixels(profile):
    kept = [name for name in profile.data_vars if "unpooled" not in name and "truth" not in name]
    figure = profile_figure(profile[kept], ("modulus", "adhesion"))
    words = [text.get_text() for text in figure.legends[0].get_texts()]
    assert "truth" not in words
    assert "pixel alone" not in words
    keep_clear(figure)


# --- predictive check -------------------------------------------------------------------------------------------------


def test_standard_deviations_are_those_of_the_interval(result):
    simple = xr.Dataset(
        {
            "check_observed": (("material", "row"), [[2.0, 1.0]]),
            "check_lower": (("material", "row"), [[-1.645, 1.0]]),
            "check_upper": (("material", "row"), [[1.645, 1.0]]),
        }
    )
    found = standardised(simple)
    assert float(found[0, 0]) == pytest.approx(2.0, rel=1e-12)
    assert math.isnan(float(found[0, 1]))  # nothing was predicted
    assert float(standardised(result)[0, -1]) == pytest.approx(3.1, rel=1e-9)


def test_what_lies_outside_is_a_diamond(result):
    axes = cell(prediction_figure(result), "PS")
    marks = {
        line.get_marker(): np.asarray(line.get_xdata()) for line in axes.lines if line.get_marker() in "oD"
    }
    np.testing.assert_allclose(marks["D"], [3.1], rtol=1e-9)
    assert marks["o"].size == 5
    assert "p = 0.37" in axes.get_title("left")
    labels = [label.get_text() for label in axes.get_yticklabels()]
    assert labels[0].startswith("CONS₀  ")
    assert labels[0].endswith(" nN")


def test_far_values_stand_at_the_edge_in_numbers(result):
    far = result.assign(check_observed=result["check_observed"] * 40.0)
    axes = cell(prediction_figure(far), "PS")
    high = axes.get_xlim()[1]
    for line in axes.lines[1:]:
        assert (np.abs(line.get_xdata()) <= high).all()
    assert any(float(text.get_text()) > high for text in axes.texts)


# --- set-points -------------------------------------------------------------------------------------------------------


def medians() -> xr.Dataset:
    dims = ("setpoint", "material")
    middle = np.array([[1.9e9, 9e7], [2.1e9, math.nan]])
    return xr.Dataset(
        {
            "modulus": (dims, middle, {"units": "Pa"}),
            "modulus_lower": (dims, middle / 1.5, {"units": "Pa"}),
            "modulus_upper": (dims, middle * 1.5, {"units": "Pa"}),
            "modulus_statistical": (dims, np.full((2, 2), 0.1), {"units": "1"}),
        },
        coords={"setpoint": [0.4, 0.7], "material": ["PS", "LDPE"]},
    )


def test_medians_stand_at_their_set_points_with_their_intervals():
    figure = setpoint_figure(medians(), ("modulus",))
    axes = cell(figure, "modulus")
    line = next(line for line in axes.lines if to_hex(line.get_color()) == phase_colour(0))
    unit = 1e-9 if "GPa" in axes.get_ylabel() else 1e-6
    np.testing.assert_allclose(line.get_ydata(), np.array([1.9e9, 2.1e9]) * unit, rtol=1e-9)
    np.testing.assert_allclose(line.get_xdata(), [0.4, 0.7], atol=0.01)
    ends = np.array([segment[:, 1] for segment in axes.collections[0].get_segments()])
    np.testing.assert_allclose(
        ends, np.array([[1.9e9 / 1.5, 1.9e9 * 1.5], [1.4e9, 3.15e9]]) * unit, rtol=1e-9
    )
    keep_clear(figure)


# --- texts ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("phases", [0, 1, 3])
def test_texts_keep_clear_of_each_other(phases):
    scan = world.observables(phases, size=SIZE)
    result = world.result(scan, phases)
    for figure in (
        before_after_figure(world.before(scan), scan),
        property_maps_figure(result, scan["height"]),
        phases_figure(result),
    ):
        keep_clear(figure)
    if phases:
        keep_clear(prediction_figure(result))
    line = (
        result.isel(y=5)
        .drop_vars(["material", "row"], errors="ignore")
        .assign(height=scan["height"].isel(y=5))
    )
    keep_clear(profile_figure(line, ("modulus", "adhesion", "loss_tangent"), "a line"))
