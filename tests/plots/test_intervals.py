"""Interval maps: one scale for a row, words where nothing is determined, bars along a curve."""

import itertools
import runpy
from pathlib import Path

import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from overtone import plots
from overtone.report.content import Report

boxes = runpy.run_path(str(Path(__file__).with_name("test_sheet.py")))["boxes"]


def row(figure: Figure, title: str) -> list[Axes]:
    k = next(k for k, axes in enumerate(figure.axes) if axes.get_title("left") == f"{title}, median")
    return figure.axes[k : k + 3]


def words(axes: Axes) -> str:
    return " ".join(" ".join(text.get_text().split()) for text in axes.texts)


def keep_clear(figure: Figure) -> None:
    seen = boxes(figure)
    width, height = figure.bbox.size
    for text, (left, bottom, right, top) in seen.items():
        assert left > 0.0 and bottom > 0.0 and right < width and top < height, text  # noqa: PT018
    for one, other in itertools.combinations(seen, 2):
        a, b = seen[one], seen[other]
        assert a[2] <= b[0] or b[2] <= a[0] or a[3] <= b[1] or b[3] <= a[1], (one, other)


@pytest.fixture(scope="module")
def figure(synthetic) -> Figure:
    return plots.properties_figure("harmonics 0, 1, 2", synthetic.posterior())


@pytest.mark.parametrize("title", ["modulus", "adhesion", "maximum indentation", "loss tangent"])
def test_median_and_both_ends_share_one_scale_and_one_bar(figure, title):
    cells = row(figure, title)
    assert [axes.get_title("left") for axes in cells[1:]] == ["lower end (90 %)", "upper end (90 %)"]
    images = [axes.images[0] for axes in cells]
    assert len({image.get_clim() for image in images}) == 1
    tables = [image.get_cmap()(np.linspace(0.0, 1.0, 400)) for image in images]
    assert all(np.array_equal(tables[0], table) for table in tables)
    assert [len(axes.child_axes) for axes in cells] == [0, 0, 1]
    label = cells[2].child_axes[0].get_ylabel()
    assert "steps ≥ × " in label
    assert "[" in label or title == "loss tangent"


def test_maps_hold_median_and_ends_and_only_the_median_has_a_veil(figure, synthetic):
    result = synthetic.posterior()
    cells = row(figure, "modulus")
    low, high = (np.array(cells[0].images[0].get_clim())) * 1e6
    for axes, name in zip(cells, ("modulus_unscreened", "modulus_lower", "modulus_upper"), strict=True):
        drawn = axes.images[0].get_array()
        expected = np.ma.masked_invalid(result[name].values)
        np.testing.assert_allclose(drawn.filled(0.0) * 1e6, expected.filled(0.0), rtol=1e-12)
    assert [len(axes.images) for axes in cells] == [2, 1, 1]
    assert low < 95e6 < 1.9e9 < high


def test_few_colours_stand_in_a_material(figure, synthetic):
    image = row(figure, "modulus")[0].images[0]
    sure = synthetic.status_codes() == 0
    for index in (0, 1):
        values = image.get_array()[sure & (synthetic.material() == index)]
        colours = np.unique(image.get_cmap()(image.norm(values)), axis=0)
        assert len(colours) <= 2


def test_where_nothing_is_determined_words_stand_instead_of_colours(synthetic):
    nothing = synthetic.posterior(codes=np.ones((48, 48), np.int8), noise=0.2)
    figure = plots.properties_figure("harmonics 0, 1, 2", nothing)
    assert not [axes for axes in figure.axes if axes.images]
    cells = row(figure, "modulus")
    assert words(cells[0]) == "not determined at any pixel"
    low, high = np.percentile(nothing["modulus_lower"], [5.0, 95.0])
    assert words(cells[1]) == f"{low / 1e3:.3g} kPa to {high / 1e9:.3g} GPa at 90 % of pixels"
    keep_clear(figure)


def test_a_curve_has_its_intervals_as_bars(synthetic):
    line = synthetic.posterior().isel(y=40)
    figure = plots.properties_figure("a line", line)
    axes = figure.axes[0]
    bars = next(c for c in axes.collections if c.get_gid() == "interval")
    ends = np.array([segment[:, 1] for segment in bars.get_segments()])
    factor = 1e-9 if "GPa" in axes.get_ylabel() else 1e-6
    known = np.isfinite(line["modulus_lower"].values)
    np.testing.assert_allclose(ends[known, 0], line["modulus_lower"].values[known] * factor)
    np.testing.assert_allclose(ends[known, 1], line["modulus_upper"].values[known] * factor)
    figure.draw_without_rendering()


@pytest.mark.parametrize("rows", [slice(None), slice(8, 14)])
def test_texts_of_all_figures_keep_clear(rows, synthetic):
    result = synthetic.posterior().isel(y=rows)
    for draw in (plots.properties_figure, plots.certainty_figure, plots.validity_figure):
        keep_clear(draw("harmonics 0, 1, 2", result))
    keep_clear(plots.properties_figure("harmonics 0, 1, 2", synthetic.exact().isel(y=rows)))


def test_certainty_shows_both_parts_on_one_scale_and_every_legend(synthetic, titles):
    figure = plots.certainty_figure("harmonics 0, 1, 2", synthetic.posterior())
    assert titles(figure) == [
        "width of the 90 % range",
        "uncertainty of ln E, noise",
        "uncertainty of ln E, shared",
        "status",
        "probability of contact",
        "contact model chosen",
        "probability of that model",
    ]
    by_title = {axes.get_title("left"): axes for axes in figure.axes}
    noise, shared = (by_title[f"uncertainty of ln E, {part}"].images[0] for part in ("noise", "shared"))
    assert noise.get_clim() == shared.get_clim()
    width = by_title["width of the 90 % range"].images[0].get_array()
    assert width.min() == pytest.approx(2 * 1.645 * np.hypot(0.12, 0.1) / np.log(10.0), rel=1e-6)
    legends = [
        text.get_text() for axes in figure.axes if axes.get_legend() for text in axes.get_legend().get_texts()
    ]
    for name in ("several solutions", "no contact", "determined", "dmt", "jkr", "maugis"):
        assert any(name in label for label in legends)


def test_what_a_result_lacks_is_left_out(synthetic, titles):
    bare = synthetic.posterior(several_models=False).drop_vars(["contact_probability"])
    assert titles(plots.certainty_figure("a", bare))[-1] == "status"
    uncalibrated = synthetic.posterior(shared=0.0)
    figure = plots.certainty_figure("a", uncalibrated)
    cell = next(axes for axes in figure.axes if axes.get_title("left") == "uncertainty of ln E, shared")
    assert "not calibrated" in words(cell)


def test_statuses_have_colours_of_their_own(synthetic):
    from overtone.plots.categories import _FLAG_COLOURS

    meanings = [meaning.replace("_", " ") for meaning in synthetic.MEANINGS]
    assert len({_FLAG_COLOURS[meaning] for meaning in meanings}) == len(meanings)


def test_the_overview_of_intervals_compares_with_the_truth(synthetic, observables, energies, titles):
    report = Report(
        "t", "s", observables, energies, {"a": synthetic.posterior()}, synthetic.truth(), ("PS", "LDPE")
    )
    figure = plots.overview_figure(report)
    by_title = {axes.get_title("left"): axes for axes in figure.axes}
    true, found = by_title["modulus, truth"].images[0], by_title["modulus, a"].images[0]
    assert true.get_clim() == found.get_clim()
    ends = np.array(true.get_clim()) * 1e6
    assert ends[0] <= 95e6
    assert ends[1] >= 1.9e9
    assert "width of the 90 % range" in titles(figure)
    nothing = synthetic.posterior(codes=np.ones((48, 48), np.int8))
    figure = plots.overview_figure(Report("t", "s", observables, energies, {"a": nothing}))
    cell = next(axes for axes in figure.axes if axes.get_title("left") == "modulus, a")
    assert not cell.images
    assert words(cell) == "not determined at any pixel"


def test_histograms_have_the_typical_interval_as_a_bar(synthetic):
    result = synthetic.posterior()
    figure = plots.histogram_figure("a", result, synthetic.truth(), ("PS", "LDPE"))
    axes = figure.axes[0]
    unit = 1e6 if "MPa" in axes.get_xlabel() else 1e9
    bars = [line.get_xdata() * unit for line in axes.lines if line.get_marker() == "|"]
    assert len(bars) == 2
    for low, high in bars:
        assert np.log(high / low) == pytest.approx(2 * 1.645 * np.hypot(0.12, 0.1), rel=1e-6)
    legend = [text.get_text() for text in figure.legends[0].get_texts()]
    assert "typical 90 % interval of a pixel" in legend
    assert [axes.get_title("left") for axes in figure.axes][4] == "misfit"


def test_solutions_are_counted_and_their_distance_is_drawn_where_there_are_several(synthetic, titles):
    result = synthetic.exact()
    figure = plots.properties_figure("a", result)
    assert titles(figure) == [
        *("modulus", "adhesion", "maximum indentation"),
        *("solutions", "modulus, between solutions"),
        *("status", "uncertainty of ln E"),
    ]
    by_title = {axes.get_title("left"): axes for axes in figure.axes}
    spread = by_title["modulus, between solutions"].images[0].get_array()
    np.testing.assert_array_equal(~np.ma.getmaskarray(spread), result["solutions"].values == 2)
    np.testing.assert_allclose(spread.compressed(), 2.5 / np.log(10.0), rtol=1e-9)
    legends = [
        [t.get_text() for t in axes.get_legend().get_texts()] for axes in figure.axes if axes.get_legend()
    ]
    assert [label.split("  ")[1] for label in legends[0]] == ["none", "one", "two"]
    assert by_title["modulus"].child_axes[0].get_ylabel().endswith("steps ≥ × 1.5")
    one = result.isel(y=slice(10, 20)).drop_vars("modulus_solutions")
    assert "modulus, between solutions" not in titles(plots.properties_figure("a", one))


def test_validity_draws_what_is_there(synthetic, titles):
    result = synthetic.posterior()
    assert len(titles(plots.validity_figure("a", result))) == 9
    fewer = result.drop_vars(["peak_force", "modulus_jkr"])
    figure = plots.validity_figure("a", fewer)
    assert titles(figure)[0] == "contact radius"
    assert all(len(axes.images) == 2 for axes in figure.axes if axes.get_title("left"))
