"""Scans of one area as one stack: the same pixels, lever and calibration, or a word on what differs."""

import json

import numpy as np
import pytest
import xarray as xr

import overtone as ot
from overtone import provenance
from overtone.demo import demo_probe
from overtone.errors import InversionError, ObservablesError
from overtone.quantities import named_array
from overtone.readings import Reading, reading_of, with_reading

SIZES = {"A0": 1e-10, "A1": 4e-8, "phi1": 1.2, "A2": 5e-11, "phi2": 0.3}


def scan(scale: float = 1.0, shape: tuple[int, int] = (4, 5), **reading: object) -> xr.Dataset:
    coords = {"y": np.arange(shape[0])[::-1] * 1e-7, "x": np.arange(shape[1]) * 1e-7}
    arrays = {n: named_array(n, np.full(shape, scale * v), ("y", "x"), coords) for n, v in SIZES.items()}
    found = xr.Dataset(arrays, attrs={"source": f"scan {scale}"})
    return with_reading(found, Reading(demo_probe(), corrected=True, **reading))  # type: ignore[arg-type]


def test_a_stack_holds_its_scans_and_what_is_said_of_them() -> None:
    first, second = scan(1.0), scan(2.0, doubts={2: "a doubt"}, phase_established=False)
    first = provenance.add_finding(first, "Of both.", "Of one.")
    second = provenance.add_finding(second, "Of both.", "Of the other.")
    stack = ot.stack_scans([first, second])
    assert stack["A1"].dims == ("scan", "y", "x")
    for i, one in enumerate((first, second)):
        xr.testing.assert_identical(
            stack["phi2"].isel(scan=i).drop_attrs(deep=False), one["phi2"].drop_attrs(deep=False)
        )
    assert stack["A2"].attrs["units"] == "m"
    assert provenance.findings(stack) == ["Of both.", "Of one.", "Of the other."]
    reading = reading_of(stack)
    assert reading is not None
    assert dict(reading.doubts) == {2: "a doubt"}
    assert not reading.phase_established
    assert json.loads(stack.attrs["history"])[-1]["arguments"]["sources"] == ["scan 1.0", "scan 2.0"]
    assert stack.attrs["source"] == "scan 1.0"


def test_dimensions_may_be_in_another_order_and_places_off_by_their_last_digits() -> None:
    other = scan(2.0).transpose("x", "y")
    other = other.assign_coords(x=other.x * (1 + 1e-9))
    stack = ot.stack_scans([scan(), other])
    assert stack["A1"].shape == (2, 4, 5)
    assert (stack["A1"].isel(scan=1) == 8e-8).all()


def test_what_not_all_scans_have_is_left_out_and_said() -> None:
    first = scan()
    first["height"] = named_array("height", np.zeros((4, 5)), ("y", "x"), first.coords)
    stack = ot.stack_scans([first, scan(2.0)])
    assert "height" not in stack
    assert "Not all scans have height" in provenance.findings(stack)[-1]


def calibrated(text: str) -> xr.Dataset:
    return scan().assign_attrs(calibration=text)


@pytest.mark.parametrize(
    ("scans", "error", "said"),
    [
        ([], ObservablesError, "nothing to stack"),
        ([scan(), 3], ObservablesError, "scan 2 is no dataset"),
        ([scan().isel(y=0)], ObservablesError, "scan 1 is no map"),
        ([scan().expand_dims("scan")], ObservablesError, "scan 1 is no map"),
        ([scan(), scan().drop_vars("phi1")], ObservablesError, "lack phi1"),
        ([scan(), scan(shape=(4, 6))], InversionError, "scan 2 has other pixels.*'x': 5.*'x': 6.*Try"),
        (
            [scan(), scan(2.0), scan().assign_coords(x=scan().x + 1e-8)],
            InversionError,
            "scan 3 lies elsewhere.*Try",
        ),
        ([scan(), scan().drop_vars("x")], InversionError, "do not both say where"),
        ([scan(), scan().drop_vars("A0")], InversionError, "other harmonics.*0, 1, 2, got 1, 2.*Try"),
        (
            [calibrated("a"), calibrated("b")],
            InversionError,
            "another calibration.*two that differ.*reference=None",
        ),
        ([scan(), scan()], InversionError, "scan 2 has the very readings of the first.*Try"),
        ([calibrated("a"), scan()], InversionError, "another calibration.*one that is not"),
    ],
)
def test_what_does_not_belong_together_is_named(
    scans: list[xr.Dataset], error: type[Exception], said: str
) -> None:
    with pytest.raises(error, match=said):
        ot.stack_scans(scans)


def test_another_lever_is_another_experiment() -> None:
    from dataclasses import replace

    probe = demo_probe()
    other = with_reading(
        scan(), Reading(replace(probe, drive=replace(probe.drive, free_amplitude=9e-8)), corrected=True)
    )
    with pytest.raises(InversionError, match=r"another probe.*got free_amplitude"):
        ot.stack_scans([scan(), other])
