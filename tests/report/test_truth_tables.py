"""Results beside the truth: how many intervals hold it."""

import numpy as np
import pytest

from overtone.report.summary import truth_properties_table, truth_table

MATERIALS = ("PS", "LDPE")
INSIDE = "truth in it: all, determined"


def rows(table) -> list[dict[str, str]]:
    return [dict(zip(table.columns, cells, strict=True)) for cells in table.rows]


def share(text: str) -> float:
    return float(text.split(" ")[0])


def test_intervals_that_are_right_hold_the_truth_at_ninety_percent(synthetic):
    found = rows(truth_table({"a": synthetic.posterior(shared=0.0)}, synthetic.truth(), MATERIALS))
    assert [cells["material"] for cells in found] == ["PS", "LDPE"]
    for cells in found:
        every, determined = cells[INSIDE].split(", ")
        assert share(every) == pytest.approx(90.0, abs=5.0)
        assert share(determined) == pytest.approx(90.0, abs=5.0)
        assert cells["method"] == "posterior"
        assert cells["determined"].endswith("can tell")
    assert found[0]["truth"] == "1.9 GPa"


@pytest.mark.parametrize(("scale", "low", "high"), [(0.5, 50.0, 68.0), (2.0, 99.0, 100.0)])
def test_intervals_that_are_wrong_are_found_out(synthetic, scale, low, high):
    result = synthetic.posterior(shared=0.0)
    middle = result["modulus_unscreened"]
    for end in ("lower", "upper"):
        name = f"modulus_{end}"
        result[name] = middle * (result[name] / middle) ** scale
    for cells in rows(truth_table({"a": result}, synthetic.truth(), MATERIALS)):
        assert low <= share(cells[INSIDE]) <= high


def test_coverage_is_counted_pixel_by_pixel(synthetic):
    result, truth = synthetic.posterior(), synthetic.truth()
    soft = synthetic.material() == 1
    sure = (synthetic.status_codes() == 0) & soft
    inside = (result["adhesion_lower"] <= truth["adhesion"]) & (truth["adhesion"] <= result["adhesion_upper"])
    known = np.isfinite(result["adhesion_lower"].values) & soft
    expected = f"{100 * inside.values[known].mean():.0f} %, {100 * inside.values[sure].mean():.0f} %"
    found = rows(truth_properties_table({"a": result}, truth, MATERIALS))
    assert (
        next(c for c in found if c["property"] == "adhesion" and c["material"] == "LDPE")[INSIDE] == expected
    )
    assert [cells["property"] for cells in found[::2]] == ["adhesion", "maximum indentation", "loss tangent"]


def test_all_methods_stand_beside_each_other(synthetic):
    results = {"a": synthetic.posterior(), "b": synthetic.exact()}
    table = truth_table(results, synthetic.truth(), MATERIALS)
    assert [cells["method"] for cells in rows(table)] == ["posterior", "exact"] * 2
    assert rows(table)[1][INSIDE] == "-"


def test_the_published_estimator_keeps_its_table(synthetic):
    result = synthetic.posterior().drop_vars(["misfit", "log_evidence"]).assign_attrs(method="least-squares")
    result["residual"] = result["uncertainty"] * 0.1
    result["start_spread"] = result["uncertainty"] * 0.0
    table = truth_table({"a": result}, synthetic.truth(), MATERIALS)
    assert table.title == "Modulus by least squares, the published estimator"
    assert "N_r < 0.1" in table.columns
    assert truth_properties_table({"a": result}, synthetic.truth(), MATERIALS).title.endswith(
        "by least squares"
    )


def test_materials_that_no_pixel_is_of_are_told_with_dashes(synthetic):
    table = truth_table({"a": synthetic.posterior()}, synthetic.truth(), (*MATERIALS, "PMMA"))
    assert rows(table)[-1]["truth"] == "-"
    assert rows(table)[-1][INSIDE] == "-, -"
