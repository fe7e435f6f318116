import math
from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from overtone.contact.parameters import effective_modulus
from overtone.contact.sample import Sample, sample
from overtone.contact.terms import adhesion_shape, sphere_force
from overtone.dynamics.balance import FOUND, NO_STATE
from overtone.dynamics.hold import hold_amplitude
from overtone.dynamics.steady import steady_states
from overtone.errors import OvertoneError
from overtone.harmonics import energy, to_force_harmonics
from overtone.probe import Cantilever, Detector, Drive, Mode, Probe, Tip


def section_3_probe() -> Probe:
    """Return the probe of section 3 of the method's paper."""
    return Probe.simple(
        stiffness=26.0,
        frequency=303e3,
        quality_factor=456.0,
        radius=10e-9,
        drive_frequency=303e3,
        free_amplitude=85e-9,
    )


def section_3_sample() -> Sample:
    return sample("dmt", modulus=1e9, poisson_ratio=0.3, adhesion=20e-9)


def test_reference_states_by_shooting(steady_states: list[dict[str, Any]]) -> None:
    """Eight steady states of an independent shooting solution, at ten and at thirty harmonics."""
    for n_max, tolerance in ((10, 1.2e-4), (30, 3e-6)):
        for row in steady_states:
            state = hold_amplitude(
                section_3_probe(), section_3_sample(), setpoint=row["A_nm"][1] / 85.0, n_max=n_max
            )
            assert int(state["state"]) == FOUND
            amplitudes = [float(state[f"A{n}"]) * 1e9 for n in range(4)]
            phases = [math.degrees(float(state[f"phi{n}"])) for n in (1, 2, 3)]
            np.testing.assert_allclose(amplitudes, row["A_nm"], rtol=tolerance)
            np.testing.assert_allclose(phases, row["phi_deg"][1:], atol=1e-5)
            assert float(state["Z"]) * 1e9 == pytest.approx(row["Z_nm"], abs=2e-4)
            assert float(state["indentation"]) * 1e9 == pytest.approx(row["delta_max_nm"], abs=2e-3)


@pytest.mark.parametrize("model", ["dmt", "dmt-linear", "hertz"])
def test_time_integration_stays_in_the_state(model: str) -> None:
    """Start the equation of motion in the state, off resonance, and come back to it a period later."""
    probe = Probe.simple(
        stiffness=5.0,
        frequency=1.0,
        quality_factor=20.0,
        radius=10e-9,
        drive_frequency=0.97,
        free_amplitude=40e-9,
    )
    adhesion = None if model == "hertz" else 3e-9
    material = sample(model, modulus=50e6, poisson_ratio=0.4, adhesion=adhesion)
    n_max = 40
    state = hold_amplitude(probe, material, setpoint=0.6, n_max=n_max, keep=n_max)
    assert int(state["state"]) == FOUND
    w, A_far = 2 * np.pi * 0.97, 40e-9
    G = 1.0 / (5.0 * (1 - 0.97**2 + 1j * 0.97 / 20.0))
    F_dr = A_far / abs(G)
    E_star = float(effective_modulus(50e6, 0.4, probe.tip.modulus, probe.tip.poisson_ratio))
    Lambda, Z = 4.0 / 3.0 * E_star * math.sqrt(10e-9), float(state["Z"])

    def motion(t: float) -> tuple[float, float]:
        q, v = float(state["A0"]), 0.0
        for n in range(1, n_max + 1):
            x = n * w * t - float(state[f"phi{n}"])
            q += float(state[f"A{n}"]) * math.cos(x)
            v -= n * w * float(state[f"A{n}"]) * math.sin(x)
        return q, v

    def right_side(t: float, y: np.ndarray) -> list[float]:
        q, v = y * 1e-9
        d = Z + q
        F = sphere_force(d, Lambda) - (adhesion or 0.0) * adhesion_shape(material.model.tail, d, 0.2e-9)
        acceleration = (2 * np.pi) ** 2 * ((F_dr * math.cos(w * t) + F) / 5.0 - q) - 2 * np.pi * v / 20.0
        return [v * 1e9, acceleration * 1e9]

    start = np.array(motion(0.0)) * 1e9
    period = 0.0 + 2 * np.pi / w
    end = solve_ivp(
        right_side, (0.0, period), start, method="DOP853", rtol=1e-10, atol=1e-9, max_step=period / 400
    ).y[:, -1]
    scale = np.array([24.0, 24.0 * w])
    assert (abs(end - start) / scale).max() < 3e-5


def test_energy_of_a_conservative_contact_balances() -> None:
    state = hold_amplitude(section_3_probe(), section_3_sample(), setpoint=0.5, n_max=20, keep=20)
    force = to_force_harmonics(state.drop_vars(["F_cons", "F_diss"]).expand_dims("point"), section_3_probe())
    lost = energy(force, section_3_probe())["dissipation"]
    assert abs(float(lost[0])) < 1e-8 * abs(float(energy(force, section_3_probe())["virial"][0]))


def test_force_of_the_state_is_what_eq_6_reads_from_it() -> None:
    state = hold_amplitude(section_3_probe(), section_3_sample(), setpoint=0.5)
    observed = to_force_harmonics(
        state.drop_vars(["F_cons", "F_diss"]).expand_dims("point"), section_3_probe()
    )
    for n in range(4):
        true = float(state["F_cons"].sel(harmonic=n))
        assert float(observed["F_cons"].sel(harmonic=n)[0]) == pytest.approx(true, rel=1e-8, abs=0)


def test_a_state_that_does_not_exist_is_said_to() -> None:
    """A lever that has to lose more amplitude than a whisper-soft sample can take from it."""
    weak = sample("hertz", modulus=np.array([1e-3, 1e9]), poisson_ratio=0.3)
    state = hold_amplitude(section_3_probe(), weak, setpoint=0.5)
    assert list(state["state"].values) == [NO_STATE, FOUND]
    assert np.isnan(state["A0"].values[0])
    assert np.isfinite(state["A0"].values[1])


def test_maps_equal_single_states() -> None:
    modulus = np.array([[0.1e9, 0.5e9], [1e9, 2e9]])
    both = hold_amplitude(
        section_3_probe(), sample("dmt", modulus=modulus, poisson_ratio=0.3, adhesion=5e-9), setpoint=0.5
    )
    assert both["A2"].dims == ("y", "x")
    one = hold_amplitude(
        section_3_probe(), sample("dmt", modulus=0.5e9, poisson_ratio=0.3, adhesion=5e-9), setpoint=0.5
    )
    assert float(both["A2"][0, 1]) == float(one["A2"])


@pytest.mark.parametrize("setpoint", [0.0, 1.0, -0.2, float("nan")])
def test_set_points_out_of_reach_are_refused(setpoint: float) -> None:
    with pytest.raises(OvertoneError, match="set-point"):
        hold_amplitude(section_3_probe(), section_3_sample(), setpoint=setpoint)


def test_an_optical_lever_reads_its_own_harmonics() -> None:
    """With three modes and a slope detector the observables give back the force through the same receptance."""
    modes = (Mode(26.0, 303e3, 456.0), Mode(1021.0, 1.9e6, 600.0, 3.47), Mode(8005.0, 5.32e6, 700.0, 5.70))
    lever = Probe(Cantilever(modes, 25.2, 1.0897), Drive(303e3, 85e-9), Tip(10e-9), Detector("slope"))
    state = hold_amplitude(lever, section_3_sample(), setpoint=0.5)
    force = to_force_harmonics(state.drop_vars(["F_cons", "F_diss"]).expand_dims("point"), lever)
    for n in range(4):
        true = float(state["F_cons"].sel(harmonic=n))
        assert float(force["F_cons"].sel(harmonic=n)[0]) == pytest.approx(true, rel=1e-8, abs=0)
    plain = hold_amplitude(section_3_probe(), section_3_sample(), setpoint=0.5)
    assert 0.55 < float(state["A2"] / plain["A2"]) < 0.65


def test_a_probe_without_radius_is_refused() -> None:
    probe = Probe.simple(
        stiffness=26.0, frequency=303e3, quality_factor=456.0, drive_frequency=303e3, free_amplitude=85e-9
    )
    with pytest.raises(OvertoneError, match="no tip radius"):
        hold_amplitude(probe, section_3_sample(), setpoint=0.5)


def test_attractive_states_that_touch_lightly_are_found() -> None:
    """The outermost state goes on into light contact; it is the one that `steady_states` has at its height."""
    lever = Probe.simple(
        stiffness=40.0,
        frequency=320e3,
        quality_factor=400.0,
        radius=10e-9,
        drive_frequency=320e3,
        free_amplitude=25e-9,
    )
    material = sample("dmt-viscous", modulus=1e9, poisson_ratio=0.35, adhesion=10e-9, viscosity=50.0)
    held = hold_amplitude(lever, material, setpoint=[0.99, 0.9, 0.8], regime="attractive")
    assert (held["state"] == FOUND).all()
    assert float(held["indentation"][0]) < 0.0 < float(held["indentation"][1])
    assert (held["F_cons"].sel(harmonic=1) > 0.0).all()
    for k in range(3):
        states = steady_states(lever, material, z=float(held["Z"][k]))
        off = np.nanmin(np.abs(states["A1"].values - float(held["A1"][k])))
        assert off < 1e-9 * 25e-9


def test_soft_levers_on_stiff_sticky_samples_converge_with_many_harmonics() -> None:
    """Substitution of the high harmonics runs away where 2 F_ad/a0 exceeds (n^2 - 1) k."""
    lever = Probe.simple(
        stiffness=0.5856,
        frequency=300e3,
        quality_factor=499.5,
        radius=10e-9,
        drive_frequency=300e3,
        free_amplitude=67.79e-9,
    )
    material = sample("dmt", modulus=8.835e9, poisson_ratio=0.3, adhesion=28.23e-9)
    states = [hold_amplitude(lever, material, setpoint=0.43, n_max=n) for n in (10, 20, 40)]
    assert all(int(state["state"]) == FOUND for state in states)
    Z = [float(state["Z"]) for state in states]
    assert abs(Z[2] - Z[1]) < 0.2 * abs(Z[1] - Z[0])


def test_iterations_that_run_away_end() -> None:
    """A step to a negative amplitude once sent the quadrature into an endless loop."""
    lever = Probe.simple(
        stiffness=10.0,
        frequency=303e3,
        quality_factor=456.0,
        radius=10e-9,
        drive_frequency=303e3,
        free_amplitude=85e-9,
    )
    states = steady_states(lever, section_3_sample(), z=[40e-9, 70e-9])
    assert int((states["state"] == FOUND).sum()) >= 2


def test_arrays_of_set_points() -> None:
    both = hold_amplitude(section_3_probe(), section_3_sample(), setpoint=[0.3, 0.6])
    assert both["A1"].dims == ("setpoint",)
    for k, setpoint in enumerate((0.3, 0.6)):
        one = hold_amplitude(section_3_probe(), section_3_sample(), setpoint=setpoint)
        assert float(both["A2"][k]) == pytest.approx(float(one["A2"]), rel=1e-12, abs=0)
    with pytest.raises(OvertoneError, match="regime"):
        hold_amplitude(section_3_probe(), section_3_sample(), setpoint=0.5, regime="sideways")
