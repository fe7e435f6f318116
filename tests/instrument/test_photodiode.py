"""The photodiode against the light on its halves, and its reading against quadrature of the response."""

from typing import Any

import numpy as np
import pytest
import xarray as xr
from scipy.integrate import dblquad, quad

from overtone import provenance
from overtone.errors import ObservablesError, OvertoneError
from overtone.instrument.photodiode import (
    SplitDiode,
    read_through,
    response,
    waveform,
)

SHAPES = ("round", "square", "gaussian")
ALIGNED = SplitDiode(spot=1.0)  # so large that it reads as a ruler does


def motion(**values: float) -> xr.Dataset:
    given = {"A0": -0.12e-9, "A1": 94e-9, "phi1": 1.4, "A2": 0.07e-9, "phi2": 4.0, "A3": 0.01e-9, "phi3": 0.8}
    return xr.Dataset(given | values)


def free(amplitude: Any, phase: float = 0.0, dims: str = "z") -> xr.Dataset:
    zero = np.zeros(np.shape(amplitude))
    names = {"A0": zero, "A1": amplitude, "phi1": zero + phase, "A2": zero, "phi2": zero}
    names |= {"A3": zero, "phi3": zero}
    return xr.Dataset({name: ((dims,) if zero.ndim else (), value) for name, value in names.items()})


def phasor(observables: xr.Dataset, n: int) -> Any:
    if n == 0:
        return observables["A0"].values + 0j
    return observables[f"A{n}"].values * np.exp(-1j * observables[f"phi{n}"].values)


def light(shape: str, half: float, low: float, high: float) -> float:
    """Return the light of a centred spot between two heights, by integrating its intensity over the area."""
    if shape == "gaussian":
        sigma = half / 2.0
        low, high = max(low, -9 * sigma), min(high, 9 * sigma)

        def intensity(x: float, y: float) -> float:
            return float(np.exp(-(x * x + y * y) / (2 * sigma**2)))

        def edge(_: float) -> float:
            return 9 * sigma
    else:
        low, high = max(low, -half), min(high, half)

        def intensity(x: float, y: float) -> float:
            return 1.0

        def edge(y: float) -> float:
            return half if shape == "square" else float(np.sqrt(max(half * half - y * y, 0.0)))

    if high <= low:
        return 0.0
    return float(dblquad(intensity, low, high, lambda y: -edge(y), edge, epsabs=1e-10, epsrel=1e-10)[0])


@pytest.mark.parametrize("gap", [0.0, 60e-9])
@pytest.mark.parametrize("shape", SHAPES)
def test_response_is_the_difference_of_the_lit_areas(shape: str, gap: float) -> None:
    diode = SplitDiode(500e-9, shape, offset=25e-9, gap=gap)
    half, cut = 250.0, gap * 1e9 / 2.0
    whole = light(shape, half, -np.inf, np.inf)

    def difference(
        centre: float,
    ) -> float:  # the spot's centre at `centre`: seen from it, the gap lies at -centre
        upper = light(shape, half, cut - centre, np.inf)
        return (upper - light(shape, half, -np.inf, -cut - centre)) / whole

    slope = (difference(25.5) - difference(24.5)) / 1e-9
    for deflection in (-400.0, -190.0, -94.0, -20.0, 60.0, 170.0, 300.0):
        expected = difference(25.0 + deflection) / slope
        assert response(diode, deflection * 1e-9) == pytest.approx(expected, rel=2e-5, abs=0)


@pytest.mark.parametrize("gap", [0.0, 40e-9])
@pytest.mark.parametrize("offset", [0.0, 30e-9, -110e-9])
@pytest.mark.parametrize("shape", SHAPES)
def test_small_deflections_about_rest_read_true(shape: str, offset: float, gap: float) -> None:
    diode = SplitDiode(500e-9, shape, offset, gap)
    step = 1e-12
    pair = response(diode, np.array([-step, step]))
    assert (pair[1] - pair[0]) / (2 * step) == pytest.approx(1.0, rel=1e-7, abs=0)
    assert response(diode, 0.0, zeroed=True) == 0.0
    q = np.array([[-80e-9, 10e-9], [3e-9, 50e-9]])
    lifted = response(diode, q) - response(diode, q, zeroed=True)
    np.testing.assert_allclose(lifted, response(diode, 0.0), rtol=1e-9, atol=1e-14 * 80e-9)
    assert lifted.shape == q.shape


@pytest.mark.parametrize("shape", SHAPES)
def test_a_large_spot_reads_the_motion(shape: str) -> None:
    read = read_through(motion(), SplitDiode(1.0, shape, offset=1e-3), zeroed=True)
    for n in range(4):
        assert phasor(read, n) == pytest.approx(complex(phasor(motion(), n)), rel=1e-5, abs=0)


@pytest.mark.parametrize("shape", SHAPES)
def test_a_centred_diode_makes_no_even_harmonics(shape: str) -> None:
    read = read_through(free(94e-9, 0.6), SplitDiode(500e-9, shape, gap=20e-9), samples=64)
    assert read["A2"] < 1e-14 * 94e-9
    assert abs(read["A0"]) < 1e-14 * 94e-9
    if shape != "square":
        assert read["A3"] > 0.3e-9


@pytest.mark.parametrize("offset", [25e-9, -25e-9])
@pytest.mark.parametrize(
    ("shape", "coefficient"),
    [
        # kappa2 = V''/(4 V'), by differentiating the lit area: -x/(4 r (1 - x^2)), 0, -s/(4 sigma^2)
        ("round", -25e-9 / (4 * 250e-9**2) / (1 - 0.1**2)),
        ("square", 0.0),
        ("gaussian", -25e-9 / (4 * 125e-9**2)),
    ],
)
def test_fake_second_harmonic_to_leading_order(shape: str, coefficient: float, offset: float) -> None:
    """a2 = kappa2 a1^2 with the phase of a1^2, and A0 shifts by |kappa2| |a1|^2."""
    amplitude = 1e-9
    read = read_through(free(amplitude, 0.9), SplitDiode(500e-9, shape, offset), zeroed=True)
    expected = coefficient * np.sign(offset) * amplitude**2
    if coefficient == 0.0:
        assert read["A2"] < 1e-12 * amplitude
        return
    assert phasor(read, 2) == pytest.approx(expected * np.exp(-2j * 0.9), rel=1e-4, abs=0)
    assert float(read["A0"]) == pytest.approx(expected, rel=1e-4, abs=0)


@pytest.mark.parametrize(
    ("shape", "spot", "fake"),
    [
        ("round", 500e-9, 0.927e-9),
        ("square", 500e-9, 0.0),
        ("gaussian", 500e-9, 3.08e-9),
        ("gaussian", 1000e-9, 0.853e-9),  # 500 nm counted as two standard deviations
    ],
)
def test_fake_second_harmonic_of_an_ordinary_lever(shape: str, spot: float, fake: float) -> None:
    """25 nm of offset at 94 nm amplitude; every order of the distortion, by quadrature of the response."""
    diode = SplitDiode(spot, shape, offset=25e-9)
    read = float(read_through(free(94e-9), diode)["A2"])
    if fake == 0.0:
        assert read < 1e-14 * 94e-9
        return
    assert read == pytest.approx(fake, rel=1e-3, abs=0)

    def integrand(theta: float) -> float:
        return float(response(diode, 94e-9 * np.cos(theta))) * 1e9 * np.cos(2 * theta)

    assert read == pytest.approx(abs(quad(integrand, 0, np.pi)[0]) * 2e-9 / np.pi, rel=1e-7, abs=0)
    leading = 94e-9**2 * 25e-9 / (4 * (spot / (2 if shape == "round" else 4)) ** 2)
    assert read == pytest.approx(leading, rel=0.15, abs=0)


def test_a_lag_is_a_delay() -> None:
    theta = np.linspace(0, 2 * np.pi, 721)
    delayed = xr.Dataset({"A1": 50e-9, "phi1": 0.5})
    assert float(waveform(delayed, theta).idxmax("theta")) == pytest.approx(0.5, abs=theta[1] / 2, rel=0)
    q = waveform(motion(), theta).values
    expected = -0.12e-9 + sum(
        A * np.cos(n * theta - phi) for n, A, phi in ((1, 94e-9, 1.4), (2, 0.07e-9, 4.0), (3, 0.01e-9, 0.8))
    )
    assert abs(q - expected).max() < 1e-14 * 94e-9


def test_waveform_keeps_dimensions() -> None:
    stack = motion().expand_dims(y=2, x=[1.0, 2.0, 3.0])
    q = waveform(stack, [0.0, 1.0])
    assert q.dims == ("y", "x", "theta")
    assert q.attrs["units"] == "m"
    np.testing.assert_array_equal(q["x"], [1.0, 2.0, 3.0])
    np.testing.assert_allclose(q[1, 2], waveform(motion(), [0.0, 1.0]), rtol=1e-15)
    with pytest.raises(OvertoneError, match="one axis"):
        waveform(motion(), np.zeros((2, 2)))


def test_aliasing_is_below_a_millionth_or_refused() -> None:
    dense = {"samples": 2**15}
    smooth = SplitDiode(500e-9, offset=25e-9)
    large = free(np.array([94e-9, 150e-9, 200e-9]), 0.3)
    edge = SplitDiode(500e-9, "square", offset=25e-9)
    beyond = free(np.array([260e-9, 400e-9]), 0.3)
    for diode, observables, samples in ((smooth, large, 64), (edge, beyond, 4096)):
        coarse = read_through(observables, diode, samples=samples)
        fine = read_through(observables, diode, **dense)
        for n in range(4):
            assert np.all(abs(phasor(coarse, n) - phasor(fine, n)) < 1e-6 * observables["A1"].values)
    with pytest.raises(OvertoneError, match=r"do not resolve the reading at 2 of 2 points.*samples=256"):
        read_through(beyond, edge)
    with pytest.raises(OvertoneError, match="cannot be had from these samples"):
        read_through(motion(), smooth, samples=8)


def test_drift_moves_the_working_point_but_not_the_calibration() -> None:
    diode = SplitDiode(500e-9, offset=25e-9)
    stack = motion().expand_dims(y=[0.0, 1.0], x=3)
    drift = np.array([0.0, 20e-9, -50e-9])
    by_array = read_through(stack, diode, offset=drift)
    by_name = read_through(stack, diode, offset=xr.DataArray(drift, dims="x"))
    xr.testing.assert_equal(by_array, by_name)
    added = read_through(motion(), diode, offset=xr.DataArray(drift, {"line": [5, 6, 7]}, ["line"]))
    assert added["A1"].dims == ("line",)
    np.testing.assert_array_equal(added["line"], [5, 6, 7])
    for k, shift in enumerate(drift):
        single = read_through(motion(), diode, offset=shift)
        moved = read_through(motion(A0=-0.12e-9 + shift), diode)
        for n in range(4):
            assert phasor(single, n) == pytest.approx(complex(phasor(moved, n)), rel=1e-9, abs=0)
            assert phasor(by_array, n)[1, k] == pytest.approx(complex(phasor(single, n)), rel=1e-9, abs=0)
            assert phasor(added, n)[k] == pytest.approx(complex(phasor(single, n)), rel=1e-9, abs=0)
    # away from rest the slope is no longer the calibrated one: V'(75 nm)/V'(25 nm) for a small motion
    small = read_through(free(1e-12), diode, offset=50e-9)
    assert float(small["A1"]) / 1e-12 == pytest.approx(np.sqrt((1 - 0.3**2) / (1 - 0.1**2)), rel=1e-6, abs=0)


def test_offsets_that_do_not_fit_are_refused() -> None:
    stack = motion().expand_dims(x=[0.0, 1.0, 2.0])
    for offset in (np.zeros(2), xr.DataArray(np.zeros(3), {"x": [0.0, 1.0, 5.0]}, ["x"]), "much"):
        with pytest.raises(ObservablesError, match="does not fit"):
            read_through(stack, ALIGNED, offset=offset)
    with pytest.raises(ObservablesError, match="not finite"):
        read_through(stack, ALIGNED, offset=np.nan)


@pytest.mark.parametrize("shape", SHAPES)
def test_saturation(shape: str) -> None:
    """Beyond the edge the reading stands still at all the light over the slope; it clips to a square wave."""
    diode = SplitDiode(500e-9, shape)
    slope = {"round": 4 / np.pi / 250e-9, "square": 1 / 250e-9, "gaussian": np.sqrt(2 / np.pi) / 125e-9}[
        shape
    ]
    far = response(diode, np.array([-5e-6, -2e-6, 2e-6, 5e-6]))
    np.testing.assert_allclose(far * slope, [-1, -1, 1, 1], rtol=1e-12)
    read = read_through(free(1e-3, 1.0), diode, samples=2**18)
    assert float(read["A1"]) * slope == pytest.approx(4 / np.pi, rel=1e-4, abs=0)
    assert float(read["A3"]) * slope == pytest.approx(4 / np.pi / 3, rel=1e-3, abs=0)
    assert float(read["phi1"]) == pytest.approx(1.0, rel=1e-4, abs=0)


def test_reading_keeps_the_rest_of_the_dataset() -> None:
    stack = motion().expand_dims(x=[0.0, 1.0, 2.0]).assign(height=("x", [1e-9, 2e-9, 3e-9]))
    stack = stack.assign(A2=("x", [0.07e-9, np.nan, 0.07e-9])).assign_attrs(detector="slope")
    read = read_through(stack, SplitDiode(500e-9, offset=25e-9), orders=(1, 2, 4))
    assert set(read.data_vars) == {"A1", "phi1", "A2", "phi2", "A4", "phi4", "height"}
    np.testing.assert_array_equal(np.isnan(read["A2"]), [False, True, False])
    assert read["A2"].attrs["units"] == "m"
    assert read.attrs["detector"] == "slope"
    assert provenance.history(read)[0]["arguments"]["diode"]["offset"] == 25e-9
    with pytest.raises(ObservablesError, match="lack A1"):
        read_through(stack.drop_vars("A1"), ALIGNED)


@pytest.mark.parametrize(
    ("options", "problem"),
    [
        ({"spot": 0.0}, "unphysical photodiode"),
        ({"spot": np.nan}, "unphysical photodiode"),
        ({"spot": 1e-6, "gap": -1e-9}, "unphysical photodiode"),
        ({"spot": 1e-6, "offset": np.inf}, "unphysical photodiode"),
        ({"spot": 1e-6, "shape": "oval"}, "unknown shape"),
        ({"spot": 1e-6, "offset": 0.6e-6}, "not aligned"),
        ({"spot": 1e-6, "gap": 1.1e-6}, "not aligned"),
        ({"spot": 1e-6, "shape": "gaussian", "offset": 2e-6}, "not aligned"),
        ({"spot": 1e-6, "shape": "square", "offset": -0.5e-6}, "not aligned"),
    ],
)
def test_impossible_diodes_are_refused(options: dict[str, Any], problem: str) -> None:
    with pytest.raises(OvertoneError, match=problem):
        SplitDiode(**options)
