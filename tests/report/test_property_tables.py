"""Tables of properties by method: intervals of one pixel, never an error of a mean."""

import numpy as np
import pytest
import xarray as xr

from overtone.report.numbers import interval_text
from overtone.report.results import (
    EXACT,
    LEAST_SQUARES,
    POSTERIOR,
    linearised_interval,
    method_of,
    properties_in,
)
from overtone.report.summary import property_table


def row(table, name: str) -> dict[str, str]:
    found = next(cells for cells in table.rows if cells[0] == name)
    return dict(zip(table.columns, found, strict=True))


def test_a_posterior_gives_the_interval_of_one_pixel_and_both_parts(synthetic):
    table = property_table("a", synthetic.posterior(noise=0.12, shared=0.1))
    modulus = row(table, "modulus")
    assert modulus["90 % interval of one pixel, end to end"] == f"x {np.exp(3.29 * np.hypot(0.12, 0.1)):.3g}"
    assert modulus["sd of ln E, noise"] == "0.12"
    assert modulus["sd of ln E, whole scan"] == "0.1"
    assert row(table, "adhesion")["sd of ln E, noise"] == "-"
    assert [cells[0] for cells in table.rows] == [
        "modulus",
        "adhesion",
        "maximum indentation",
        "loss tangent",
    ]
    assert "Intervals hold noise and what the calibration" in table.note
    assert "no error of a mean" in table.note
    assert "Model chosen: dmt" in table.note


def test_more_pixels_do_not_make_the_interval_narrower(synthetic):
    whole = synthetic.posterior()
    corner = whole.isel(y=slice(20, 28), x=slice(20, 28))
    column = "90 % interval of one pixel, end to end"
    assert (
        row(property_table("a", whole), "modulus")[column]
        == row(property_table("a", corner), "modulus")[column]
    )


def test_only_determined_pixels_are_quoted(synthetic):
    result = synthetic.posterior()
    sure = synthetic.status_codes() == 0
    median = np.median(result["modulus_unscreened"].values[sure])
    assert row(property_table("a", result), "modulus")["median, determined"] == f"{median / 1e9:.3g} GPa"


def test_where_nothing_is_determined_the_note_says_what_the_data_allow(synthetic):
    nothing = synthetic.posterior(codes=np.ones((48, 48), np.int8), shared=0.0)
    table = property_table("a", nothing)
    assert {cell for cells in table.rows for cell in cells[1:]} == {"-"}
    low, high = (float(np.median(nothing[f"modulus_{end}"])) for end in ("lower", "upper"))
    assert f"allow a modulus from {low / 1e6:.3g} MPa to {high / 1e9:.3g} GPa" in table.note
    assert "Intervals hold noise only." in table.note


def test_a_handful_of_determined_pixels_is_not_quoted(synthetic):
    codes = np.ones((48, 48), np.int8)
    codes[0, :5] = 0
    table = property_table("a", synthetic.posterior(codes=codes))
    assert "5 pixels pass as determined" in table.note
    assert row(table, "modulus")["median, determined"] == "-"


def test_exact_results_tell_how_many_solutions_there_are(synthetic):
    result = synthetic.exact()
    table = property_table("a", result)
    count = result["solutions"].values
    shares = [100 * (count == 1).mean(), 100 * (count > 1).mean(), 100 * (count == 0).mean()]
    one, several, none = (f"{share:.1f} %" for share in shares)
    assert f"one solution {one}, several {several}, none {none}." in table.note
    assert row(table, "modulus")["sd of ln E, one pixel"] == "0.12"


def test_the_method_is_read_from_the_result(synthetic):
    posterior, exact = synthetic.posterior(), synthetic.exact()
    for result, method in ((posterior, POSTERIOR), (exact, EXACT)):
        assert method_of(result) == method
        assert method_of(result.drop_attrs(deep=False)) == method
    assert method_of(posterior.drop_attrs(deep=False).drop_vars(["misfit", "log_evidence"])) == LEAST_SQUARES


def test_a_spring_model_leads_with_its_stiffness():
    cells = xr.DataArray([1.0, 2.0], dims="x")
    result = xr.Dataset({"damping": cells, "stiffness_unscreened": cells, "status": cells})
    assert properties_in(result) == ("stiffness", "damping")


def test_a_modulus_without_an_interval_has_the_linearised_one(synthetic):
    interval = linearised_interval(synthetic.exact(), "modulus")
    assert interval is not None
    np.testing.assert_allclose(
        np.nanmax(interval.upper / interval.lower), np.exp(2 * 1.645 * 0.12), rtol=1e-9
    )
    assert linearised_interval(synthetic.exact(), "adhesion") is None


def test_an_interval_of_a_huge_uncertainty_is_open():
    cells = xr.DataArray([1e9, 2e9], dims="x")
    result = xr.Dataset({"modulus": cells, "uncertainty": cells * 0 + 1e6, "status": cells * 0})
    interval = linearised_interval(result, "modulus")
    assert interval is not None
    np.testing.assert_array_equal(interval.lower, 0.0)
    np.testing.assert_array_equal(interval.upper, np.inf)


@pytest.mark.parametrize(
    ("lower", "upper", "unit", "text"),
    [
        ([1e9, 1e9, np.nan], [2e9, 2e9, 3e9], "Pa", "x 2"),
        ([1.0], [2691.0], "1", "x 2691"),
        ([-1e-9, 0.0, 0.0], [2e-9, 2e-9, 2e-9], "m", "2 nm wide"),
        ([np.nan], [1.0], "1", "-"),
    ],
)
def test_widths_of_intervals(lower, upper, unit, text):
    assert interval_text(np.array(lower), np.array(upper), unit) == text
