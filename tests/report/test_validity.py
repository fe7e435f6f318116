"""What the contact asks of its model, in a table with plain remarks."""

import numpy as np
import pytest

from overtone.report.validity import validity_table, validity_tables


def remarks(table) -> dict[str, str]:
    return {cells[0]: cells[-1] for cells in table.rows}


def shares(synthetic) -> tuple[str, str]:
    sure = synthetic.status_codes() == 0
    soft = synthetic.material()[sure].mean()
    return f"{100 * soft:.1f} %", f"{100 * (1 - soft):.1f} %"


def test_limits_that_are_passed_are_remarked_with_the_share_of_pixels(synthetic):
    soft, stiff = shares(synthetic)
    table = validity_table("a", synthetic.posterior(noise=0.01, shared=0.0))
    assert table is not None
    said = remarks(table)
    assert said["mean pressure"].startswith(f"above 10 % of the modulus at {stiff}")
    assert (
        said["indentation over tip radius"]
        == f"above 0.5 at {soft} of them: a paraboloid no longer describes the tip"
    )
    assert f"between 0.1 and 5 at {stiff}" in said["Tabor parameter"]
    assert f"above 5 at {soft} of them: JKR" in said["Tabor parameter"]
    assert said["ln of JKR over DMT modulus"].startswith("larger than the standard deviation of ln E")
    assert said["share of a cycle in contact"] == said["peak force"] == ""
    assert table.rows[0][1].endswith("nN")
    assert [cells[1].split()[-1] for cells in table.rows[1:3]] == ["nm", "MPa"]


@pytest.mark.parametrize(
    ("name", "quantity", "within", "beyond"),
    [
        ("relative_indentation", "indentation over tip radius", 0.49, 0.51),
        ("tabor", "Tabor parameter", 0.09, 0.11),
        ("contact_time", "share of a cycle in contact", 0.49, 0.51),
    ],
)
def test_a_limit_is_passed_or_not(synthetic, name, quantity, within, beyond):
    result = synthetic.posterior()
    for value, remarked in ((within, False), (beyond, True)):
        table = validity_table("a", result.assign({name: result[name].copy(data=np.full((48, 48), value))}))
        assert table is not None
        assert bool(remarks(table)[quantity]) is remarked


def test_pressure_is_compared_with_the_modulus_of_its_pixel(synthetic):
    result = synthetic.posterior()
    for share, remarked in ((0.099, False), (0.101, True)):
        table = validity_table("a", result.assign(mean_pressure=share * result["modulus_unscreened"]))
        assert table is not None
        assert bool(remarks(table)["mean pressure"]) is remarked


def test_what_is_absent_is_left_out(synthetic):
    result = synthetic.posterior()
    assert validity_table("a", synthetic.posterior(validity=False)) is None
    assert [table.title for table in validity_tables({"a": result, "b": synthetic.exact()})] == [
        "Validity (a)"
    ]
    one = validity_table("a", result[["tabor", "status"]])
    assert one is not None
    assert len(one.rows) == 1


def test_nothing_determined_is_said(synthetic):
    table = validity_table("a", synthetic.posterior(codes=np.ones((48, 48), np.int8)))
    assert table is not None
    assert table.note == "No pixel is determined."
    assert {cell for cells in table.rows for cell in cells[1:]} == {"-", ""}
