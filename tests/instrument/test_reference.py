"""Which pixels are the reference: as marked, or as they look."""

import math
from typing import Any

import numpy as np
import pytest
import xarray as xr

from overtone.errors import CalibrationError
from overtone.instrument.reference import _neighbour_noise, find_reference, reference_pixels

SHAPE = (40, 50)


def scan(**coords: Any) -> xr.Dataset:
    y, x = np.linspace(2e-6, 0.0, SHAPE[0]), np.linspace(0.0, 5e-6, SHAPE[1])
    return xr.Dataset({"A1": (("y", "x"), np.full(SHAPE, 4e-8))}, {"y": y, "x": x} | coords)


# --- as marked ------------------------------------------------------------------------------------


def test_a_mask_marks_its_pixels_whatever_the_order_of_its_dimensions() -> None:
    mask = np.zeros(SHAPE, bool)
    mask[3:9, 10:30] = True
    for chosen in (
        xr.DataArray(mask, dims=("y", "x")),
        xr.DataArray(mask.T, dims=("x", "y")),
        xr.DataArray(mask.astype(np.int8), dims=("y", "x")),
        xr.DataArray(np.where(mask, 1.0, math.nan), dims=("y", "x")),
    ):
        np.testing.assert_array_equal(reference_pixels(scan(), chosen), mask)


def test_a_rectangle_marks_what_lies_in_it_whichever_corners_are_given() -> None:
    given = scan()
    expected = (
        (given["x"].values >= 1e-6)
        & (given["x"].values <= 2e-6)
        & ((given["y"].values >= 0.5e-6) & (given["y"].values <= 1.5e-6))[:, None]
    )
    assert 100 < expected.sum() < 400
    for chosen in ((1e-6, 0.5e-6, 2e-6, 1.5e-6), [2e-6, 1.5e-6, 1e-6, 0.5e-6]):
        np.testing.assert_array_equal(reference_pixels(given, chosen), expected)
    # the scan may lie the other way round
    np.testing.assert_array_equal(
        reference_pixels(given.transpose("x", "y"), (1e-6, 0.5e-6, 2e-6, 1.5e-6)), expected.T
    )


def test_lost_pixels_are_no_reference() -> None:
    given = scan()
    given["A1"][5, 12] = math.nan
    marked = reference_pixels(given, xr.DataArray(np.ones(SHAPE, bool), dims=("y", "x")))
    assert not marked[5, 12]
    assert marked.sum() == marked.size - 1


@pytest.mark.parametrize(
    ("chosen", "message"),
    [
        (xr.DataArray(np.ones((40, 49), bool), dims=("y", "x")), "does not fit"),
        (xr.DataArray(np.ones(SHAPE, bool), dims=("row", "x")), "does not fit"),
        (xr.DataArray(np.zeros(SHAPE, bool), dims=("y", "x")), "too few pixels"),
        ((0.0, 0.0, 1e-6), "four numbers"),
        ((0.0, 0.0, 1e-6, math.nan), "four numbers"),
        ((0.0, 0.0, 0.1e-6, 0.1e-6), "too few pixels"),
        ((7e-6, 0.0, 9e-6, 2e-6), "too few pixels"),
        (("left", 0.0, 1e-6, 1e-6), "four numbers"),
        (5.0, "four numbers"),
        ("here", "four numbers"),
    ],
)
def test_marks_that_do_not_fit_are_refused(chosen: Any, message: str) -> None:
    with pytest.raises(CalibrationError, match=message):
        reference_pixels(scan(), chosen)


def test_a_rectangle_needs_coordinates() -> None:
    with pytest.raises(CalibrationError, match="no coordinates"):
        reference_pixels(scan().drop_vars("x"), (0.0, 0.0, 1e-6, 1e-6))


# --- as they look ---------------------------------------------------------------------------------

NOISE = {"phi1": 2e-3, "e2_re": 1e-12, "e2_im": 1e-12}
SHARED = {"phi1": 0.02, "e2_re": 5e-12, "e2_im": 5e-12}
NEAR, FAR = (0.01, 1e-12, 0.0), (0.3, 40e-12, 10e-12)


def stripes(
    *parts: tuple[float, tuple[float, float, float]], seed: int = 0
) -> tuple[dict[str, Any], np.ndarray]:
    """Return how far pixels are off the curve, in stripes of a width and an offset each, and their stripe."""
    generator = np.random.default_rng(seed)
    edges = np.round(np.cumsum([0.0] + [width for width, _ in parts]) * SHAPE[1]).astype(int)
    which = np.zeros(SHAPE, int)
    for k in range(len(parts)):
        which[:, edges[k] : edges[k + 1]] = k
    off = {
        name: np.array([part[i] for _, part in parts])[which] + generator.normal(0.0, sigma, SHAPE)
        for i, (name, sigma) in enumerate(NOISE.items())
    }
    return off, which


def test_the_phase_on_the_curve_is_found_among_two() -> None:
    for share in (0.1, 0.5, 0.9):
        off, which = stripes((share, NEAR), (1.0 - share, FAR))
        findings: list[str] = []
        mask = find_reference(off, SHARED, {}, findings)
        assert mask[which == 0].mean() > 0.98
        assert not mask[which == 1].any()
        assert findings == []


def test_one_reading_alone_may_tell_them_apart() -> None:
    for i in range(3):
        other = tuple(FAR[k] if k == i else NEAR[k] for k in range(3))
        if i == 2:
            other = (NEAR[0], NEAR[1], 60e-12)
        off, which = stripes((0.5, NEAR), (0.5, other))
        mask = find_reference(off, SHARED, {}, [])
        assert mask[which == 0].mean() > 0.98
        assert not mask[which == 1].any()


def test_two_groups_near_the_curve_are_said_and_the_larger_is_taken() -> None:
    off, which = stripes((0.6, NEAR), (0.4, (0.04, 8e-12, 0.0)))
    findings: list[str] = []
    mask = find_reference(off, SHARED, {}, findings)
    assert mask[which == 0].mean() > 0.98
    assert not mask[which == 1].any()
    assert len(findings) == 1
    assert "another group of 4" in findings[0]
    assert "passes for the reference" in findings[0]


def test_a_few_odd_pixels_are_no_other_group() -> None:
    off, which = stripes((0.94, NEAR), (0.06, (0.04, 8e-12, 0.0)))
    findings: list[str] = []
    assert not find_reference(off, SHARED, {}, findings)[which == 1].any()
    assert findings == []


def test_drift_from_line_to_line_is_not_another_material() -> None:
    """A phase that walks by ten times the noise of a pixel: where that is allowed for, it is one material."""
    off, _ = stripes((1.0, NEAR))
    off["phi1"] = off["phi1"] + np.linspace(-0.02, 0.02, SHAPE[0])[:, None]
    findings: list[str] = []
    assert find_reference(off, SHARED, {"phi1": 0.015}, findings).mean() > 0.97
    assert findings == []
    # without it, half of the scan is missed, and that is said
    assert find_reference(off, SHARED, {}, findings).mean() < 0.6
    assert len(findings) == 1


@pytest.mark.parametrize("seed", [0, 1])
def test_a_reference_that_is_not_there_is_an_error(seed: int) -> None:
    off, _ = stripes((0.5, FAR), (0.5, (-0.2, 40e-12, 0.0)), seed=seed)
    with pytest.raises(CalibrationError, match="absent from the scan"):
        find_reference(off, SHARED, {}, [])


def test_pixels_all_over_the_place_are_no_group() -> None:
    """Near enough to the curve, each by itself, but no two alike."""
    generator = np.random.default_rng(0)
    off = {name: np.full(SHAPE, 100.0 * sigma) for name, sigma in NOISE.items()}
    block = generator.uniform(-2.5, 2.5, (7, 8, 3))
    # neighbours are alike, so that the noise is small; the blocks are not
    for i, name in enumerate(NOISE):
        off[name] = np.kron(block[:, :, i], np.ones((6, 7)))[: SHAPE[0], : SHAPE[1]] * SHARED[name]
        off[name] = off[name] + generator.normal(0.0, 0.05 * NOISE[name], SHAPE)
    findings: list[str] = []
    mask = find_reference(off, SHARED, {}, findings)
    assert mask.sum() <= 42
    assert findings


def test_lost_pixels_do_not_pass() -> None:
    off, which = stripes((0.5, NEAR), (0.5, FAR))
    off["e2_re"][:10, :10] = math.nan
    mask = find_reference(off, SHARED, {}, [])
    assert not mask[:10, :10].any()
    assert mask[which == 0].sum() > 0.98 * ((which == 0).sum() - 100)
    nothing = {name: np.full(SHAPE, math.nan) for name in NOISE}
    with pytest.raises(CalibrationError, match="absent"):
        find_reference(nothing, SHARED, {}, [])


def test_noise_is_that_along_the_lines() -> None:
    """Lines that jump against each other and two materials in each leave it as it is."""
    off, which = stripes((0.5, NEAR), (0.5, FAR))
    jumps = np.random.default_rng(1).normal(0.0, 0.5, SHAPE[0])
    assert _neighbour_noise(off["phi1"] + jumps[:, None]) == pytest.approx(NOISE["phi1"], rel=0.05, abs=0)
    assert which.max() == 1
    assert _neighbour_noise(np.full(SHAPE, math.nan)) == math.inf
    assert _neighbour_noise(np.ones(SHAPE)) > 0.0
