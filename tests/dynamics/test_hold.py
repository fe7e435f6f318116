"""Set-points one a point, and a mean deflection that has a sensitivity of its own."""

import numpy as np
import pytest
import xarray as xr

from overtone.contact.sample import Sample, sample
from overtone.dynamics.balance import FOUND
from overtone.dynamics.hold import hold_amplitude
from overtone.dynamics.steady import steady_states
from overtone.dynamics.transient import settle, sweep
from overtone.errors import OvertoneError
from overtone.harmonics import to_force_harmonics
from overtone.probe import SLOPE, STATIC, Cantilever, Detector, Drive, Mode, Probe, Tip
from overtone.provenance import history

SETPOINTS = np.array([[0.3, 0.5, 0.7], [0.4, 0.6, 0.8]])


def lever(sensitivity: str = "dynamic", kind: str = SLOPE) -> Probe:
    modes = (
        Mode(26.0, 303e3, 60.0, 1.0, 1.6),
        Mode(1021.0, 6.27 * 303e3, 90.0, 3.47, -0.9),
        Mode(8005.0, 17.55 * 303e3, 120.0, 5.70, 0.5),
    )
    return Probe(
        Cantilever(modes, 25.2, 1.0897), Drive(0.99 * 303e3, 40e-9), Tip(10e-9), Detector(kind, sensitivity)
    )


def materials(*shape: int) -> Sample:
    modulus = 0.5e9 + 1e9 * np.linspace(0.0, 1.0, int(np.prod(shape))).reshape(shape)
    return sample("dmt", modulus=modulus, poisson_ratio=0.3, adhesion=4e-9)


# --- one set-point a point ------------------------------------------------------------------------


def test_each_point_has_its_own_set_point() -> None:
    of = materials(2, 3)
    coords = {"y": [1e-6, 0.0], "x": [0.0, 1e-6, 2e-6], "line": ("y", [0, 1])}
    each = hold_amplitude(lever(), of, setpoint=xr.DataArray(SETPOINTS, coords, ("y", "x")))
    assert each["A1"].dims == ("y", "x")
    assert "setpoint" not in each.dims
    np.testing.assert_allclose(each["A1"], SETPOINTS * 40e-9, rtol=1e-9)
    for i in range(2):
        for k in range(3):
            alone = hold_amplitude(
                lever(),
                sample("dmt", modulus=of.values["modulus"][i, k], poisson_ratio=0.3, adhesion=4e-9),
                setpoint=SETPOINTS[i, k],
            )
            for name in ("A0", "A2", "phi1", "Z", "indentation"):
                assert float(each[name][i, k]) == pytest.approx(float(alone[name]), rel=1e-9, abs=0), name
    # coordinates of the set-points stay
    np.testing.assert_array_equal(each["x"], coords["x"])
    np.testing.assert_array_equal(each["line"], [0, 1])
    assert history(each)[-1]["arguments"]["setpoint"] == "one a point"


def test_the_order_of_dimensions_does_not_matter() -> None:
    each = xr.DataArray(SETPOINTS, dims=("y", "x"))
    here, there = (
        hold_amplitude(lever(), materials(2, 3), setpoint=s) for s in (each, each.transpose("x", "y"))
    )
    np.testing.assert_array_equal(here["A2"], there["A2"])
    named = hold_amplitude(
        lever(), materials(6), setpoint=xr.DataArray(SETPOINTS.ravel(), dims="point"), dims=("point",)
    )
    np.testing.assert_allclose(named["A2"], here["A2"].values.ravel(), rtol=1e-9)


def test_a_bare_cosine_has_set_points_of_its_own_too() -> None:
    each = xr.DataArray(SETPOINTS, dims=("y", "x"))
    states = hold_amplitude(lever(), materials(2, 3), setpoint=each, n_max=1)
    assert (states["state"] == FOUND).all()
    np.testing.assert_allclose(states["A1"], SETPOINTS * 40e-9, rtol=1e-12)


def test_a_data_array_over_other_dimensions_is_an_array_of_set_points() -> None:
    states = hold_amplitude(lever(), materials(2), setpoint=xr.DataArray([0.3, 0.4, 0.5], dims="setpoint"))
    assert states["A1"].sizes == {"setpoint": 3, "dim_0": 2}
    one = hold_amplitude(lever(), materials(2), setpoint=xr.DataArray(0.4))
    np.testing.assert_allclose(one["A2"], states["A2"].sel(setpoint=0.4), rtol=1e-9)


@pytest.mark.parametrize(
    ("setpoint", "message"),
    [
        (xr.DataArray(SETPOINTS[:, :2], dims=("y", "x")), "do not fit.*'x': 3.*'x': 2"),
        (xr.DataArray(SETPOINTS, dims=("row", "x")), "do not fit"),
        (SETPOINTS, "do not fit"),
        (xr.DataArray(SETPOINTS + 0.3, dims=("y", "x")), r"out of reach.*1\.0"),
        (xr.DataArray(np.full((2, 3), np.nan), dims=("y", "x")), "out of reach"),
        (np.empty(0), "out of reach"),
    ],
)
def test_set_points_that_do_not_fit_are_refused(setpoint: object, message: str) -> None:
    with pytest.raises(OvertoneError, match=message):
        hold_amplitude(lever(), materials(2, 3), setpoint=setpoint)


# --- the sensitivity of the mean ------------------------------------------------------------------

DMT = sample("dmt", modulus=1e9, poisson_ratio=0.3, adhesion=4e-9)


def test_the_mean_is_read_as_what_the_tip_does_and_nothing_else_changes() -> None:
    dynamic, static, plain = (
        hold_amplitude(p, DMT, setpoint=0.6) for p in (lever(), lever(STATIC), lever(kind="displacement"))
    )
    assert float(dynamic["A0"] / static["A0"]) == pytest.approx(1.0897, rel=1e-9, abs=0)
    # what the tip does: the mean force over the static stiffness
    mean_force = float(static["F_cons"].sel(harmonic=0))
    assert float(static["A0"]) == pytest.approx(mean_force / 25.2, rel=1e-9, abs=0)
    assert float(plain["A0"]) == pytest.approx(float(plain["F_cons"].sel(harmonic=0)) / 25.2, rel=1e-9, abs=0)
    for name in ("A1", "phi1", "A2", "phi2", "A3", "phi3", "Z", "F_cons"):
        np.testing.assert_array_equal(static[name], dynamic[name])


@pytest.mark.parametrize("sensitivity", ["dynamic", STATIC])
def test_states_and_time_integration_read_the_same_mean(sensitivity: str) -> None:
    """The balance reads it through a receptance, integration from the slopes of the modes."""
    probe = lever(sensitivity)
    held = hold_amplitude(probe, DMT, setpoint=0.6, n_max=40)
    settled = settle(probe, DMT, Z=float(held["Z"]), tolerance=1e-12)
    assert float(settled["A1"]) == pytest.approx(0.6 * 40e-9, rel=1e-5, abs=0)
    for name in ("A0", "A2", "phi1"):
        assert float(settled[name]) == pytest.approx(float(held[name]), rel=2e-4, abs=0), name
    at_height = steady_states(probe, DMT, z=[float(held["Z"])], n_max=40)
    assert float(abs(at_height["A0"] / float(held["A0"]) - 1.0).min()) < 1e-4


def test_forces_do_not_depend_on_the_sensitivity_if_it_is_stated() -> None:
    forces = []
    for sensitivity in ("dynamic", STATIC):
        probe = lever(sensitivity)
        state = hold_amplitude(probe, DMT, setpoint=0.6).drop_vars(["F_cons", "F_diss"]).expand_dims("point")
        forces.append(to_force_harmonics(state, probe)["F_cons"].values)
    np.testing.assert_allclose(forces[1], forces[0], rtol=1e-10)
    # confused, F0 is 9 % off
    state = (
        hold_amplitude(lever(STATIC), DMT, setpoint=0.6).drop_vars(["F_cons", "F_diss"]).expand_dims("point")
    )
    wrong = to_force_harmonics(state, lever())["F_cons"].sel(harmonic=0)
    assert float(wrong[0] / forces[0][0, 0]) == pytest.approx(1.0 / 1.0897, rel=1e-9, abs=0)


def test_sweeps_read_it_as_well() -> None:
    """Behind a filter, in contact, from 25 to 24 nm."""
    settings = {"z": [25e-9, 24e-9], "speed": 1e-5, "bandwidth": 2e4, "settle_periods": 200}
    dynamic, static = (sweep(lever(s), DMT, **settings)[0] for s in ("dynamic", STATIC))
    assert float(np.abs(static["A0"]).min()) > 1e-12
    np.testing.assert_allclose(dynamic["A0"] / static["A0"], 1.0897, rtol=1e-9)
    np.testing.assert_array_equal(dynamic["A2"], static["A2"])
