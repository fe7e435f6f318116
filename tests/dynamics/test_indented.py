"""Motions at a given amplitude and indentation: the states of the full balance, found the other way round."""

import math
from dataclasses import replace

import numpy as np
import pytest
import xarray as xr

from overtone.contact.sample import Sample, sample
from overtone.dynamics.balance import FOUND, NOT_CONVERGED
from overtone.dynamics.hold import hold_amplitude
from overtone.dynamics.indented import Indented, indented_states
from overtone.dynamics.system import setup
from overtone.harmonics import far_phase, read_receptance
from overtone.probe import BASE, SLOPE, TIP, Cantilever, Detector, Drive, Mode, Probe

MATERIALS = {
    "hertz": sample("hertz", modulus=1e9, poisson_ratio=0.3),
    "dmt": sample("dmt", modulus=1e9, poisson_ratio=0.3, adhesion=20e-9),
    "dmt-viscous": sample("dmt-viscous", modulus=94e6, poisson_ratio=0.4, adhesion=16e-9, viscosity=30.0),
    "jkr": sample("jkr", modulus=1e9, poisson_ratio=0.3, adhesion=20e-9),
}
SETPOINTS = np.array([0.3, 0.6, 0.9])


def single(k: float = 16.4, r: float = 1.0) -> Probe:
    return Probe.simple(
        stiffness=k,
        frequency=161.8e3,
        quality_factor=287.0,
        radius=10e-9,
        drive_frequency=r * 161.8e3,
        free_amplitude=94e-9,
    )


def lever(acts_on: str = TIP, Q: float = 287.0, r: float = 1.0) -> Probe:
    """Return an optical lever of three modes."""
    modes = (
        Mode(16.4, 161.8e3, Q, 1.0, 1.5),
        Mode(644.0, 1.014e6, 2.0 * Q, 3.473, -0.87),
        Mode(5050.0, 2.84e6, 3.0 * Q, 5.7, 0.5),
    )
    return replace(
        single(r=r),
        cantilever=Cantilever(modes, 15.92, 1.0897),
        drive=Drive(r * 161.8e3, 94e-9, acts_on),
        detector=Detector(SLOPE),
    )


PROBES = {
    "one mode": single(),
    "off resonance": single(r=0.997),
    "optical lever": lever(),
    "shaken base": lever(BASE, r=0.998),
    "shaken base, low Q": lever(BASE, Q=20.0),
    "static sensitivity": replace(lever(), detector=Detector(SLOPE, "static")),
}


def found(probe: Probe, of: Sample, regime: str = "repulsive") -> xr.Dataset:
    states = hold_amplitude(probe, of, setpoint=SETPOINTS, regime=regime)
    return states.isel(setpoint=states["state"].values == FOUND)


def of_states(probe: Probe, of: Sample, states: xr.Dataset) -> Indented:
    return indented_states(probe, of, amplitude=states["A1"].values, indentation=states["indentation"].values)


def check(got: Indented, states: xr.Dataset, probe: Probe, where: slice | np.ndarray = slice(None)) -> None:
    """Compare force, height, drive and readings with states of the balance."""
    states = states.isel(setpoint=where)
    force = (states["F_cons"] - 1j * states["F_diss"]).transpose("setpoint", "harmonic").values
    largest = np.abs(force).max(axis=1, keepdims=True)
    np.testing.assert_allclose(got.force[where, :4] / largest, force / largest, atol=1e-8)
    np.testing.assert_allclose(got.height[where], states["Z"], atol=1e-8 * 94e-9)
    np.testing.assert_allclose(np.abs(got.drive[where]), setup(probe, 10).lever.force, rtol=1e-8)
    np.testing.assert_allclose(got.reading[where, 1], states["A1"], rtol=1e-12)
    np.testing.assert_allclose(got.reading[where, 0].real, states["A0"], atol=1e-8 * largest.max() / 16.4)
    for n in (2, 3):
        e = states[f"A{n}"] * np.exp(1j * (n * states["phi1"] - states[f"phi{n}"]))
        np.testing.assert_allclose(got.reading[where, n], e, atol=1e-8 * largest.max() / 16.4)


@pytest.mark.parametrize("model", list(MATERIALS))
@pytest.mark.parametrize("name", list(PROBES))
def test_repulsive_states_are_those_of_the_balance(name: str, model: str) -> None:
    probe, of = PROBES[name], MATERIALS[model]
    states = found(probe, of)
    assert states.sizes["setpoint"] >= 2
    assert (states["indentation"] > 0.0).all()
    got = of_states(probe, of, states)
    assert (got.status == FOUND).all()
    check(got, states, probe)


@pytest.mark.parametrize("model", ["dmt", "dmt-viscous"])
def test_attractive_states_hover_above_the_sample(model: str) -> None:
    probe, of = single(k=0.5), MATERIALS[model]
    states = found(probe, of, "attractive")
    assert states.sizes["setpoint"] == 3
    assert float(states["indentation"].min()) < -0.5e-9
    got = of_states(probe, of, states)
    assert (got.status == FOUND).all()
    check(got, states, probe)


def test_soft_levers_converge_slowly_and_what_does_not_is_marked() -> None:
    """20 nN on 0.5 to 4 N/m bends the lever by nanometres in its higher harmonics: a plain substitution runs away."""
    marked = 0
    for k in (0.35, 0.5, 1.0, 2.0, 4.0):
        probe = single(k=k)
        states = found(probe, MATERIALS["dmt"])
        got = of_states(probe, MATERIALS["dmt"], states)
        assert set(got.status) <= {FOUND, NOT_CONVERGED}
        done = np.flatnonzero(got.status == FOUND)
        check(got, states, probe, done)
        marked += int((got.status == NOT_CONVERGED).sum())
        assert k < 1.0 or done.size == got.status.size
    assert marked > 0


def test_the_drive_is_what_the_state_needs() -> None:
    """f_1 = (A1 - A1far exp(i (phi1 - phi_far)))/G: the drive of the observables, in the frame of the first."""
    for probe in (single(), single(r=1.004), lever()):
        states = found(probe, MATERIALS["dmt-viscous"])
        got = of_states(probe, MATERIALS["dmt-viscous"], states)
        G = complex(read_receptance(probe, probe.drive.frequency))
        phase = states["phi1"].values - far_phase(probe)
        expected = probe.drive.free_amplitude * np.exp(1j * phase) / G
        np.testing.assert_allclose(got.drive, expected, rtol=1e-8)


@pytest.mark.parametrize("name", ["one mode", "optical lever", "shaken base, low Q"])
def test_the_free_amplitude_does_not_count(name: str) -> None:
    """The drive follows from the state, also where what is read depends on the drive."""
    probe = PROBES[name]
    other = replace(probe, drive=replace(probe.drive, free_amplitude=2.5 * 94e-9))
    states = found(probe, MATERIALS["dmt"])
    here, there = (of_states(p, MATERIALS["dmt"], states) for p in (probe, other))
    np.testing.assert_allclose(there.force, here.force, rtol=1e-7, atol=1e-16)
    np.testing.assert_allclose(there.drive, here.drive, rtol=1e-8)
    np.testing.assert_allclose(there.height, here.height, rtol=1e-8)


def test_the_closest_gap_is_held() -> None:
    """The lowest point of the motion, which one mode reads as it is."""
    probe, theta = single(), np.linspace(0.0, 2.0 * math.pi, 20001)
    got = indented_states(probe, MATERIALS["dmt"], amplitude=50e-9, indentation=[2e-9, 6e-9, -1e-9])
    assert (got.status == FOUND).all()
    for k, delta in enumerate((2e-9, 6e-9, -1e-9)):
        orders = np.arange(got.reading.shape[1])
        gap = got.height[k] + (got.reading[k] @ np.exp(1j * np.outer(orders, theta))).real
        assert gap.min() == pytest.approx(-delta, rel=1e-6, abs=0)


def test_one_material_a_point_and_plain_numbers() -> None:
    moduli = np.array([0.5e9, 1e9, 2e9])
    many = sample("dmt", modulus=moduli, poisson_ratio=0.3, adhesion=20e-9)
    got = indented_states(single(), many, amplitude=[40e-9, 50e-9, 60e-9], indentation=3e-9)
    for k, (modulus, A) in enumerate(zip(moduli, (40e-9, 50e-9, 60e-9), strict=True)):
        one = sample("dmt", modulus=modulus, poisson_ratio=0.3, adhesion=20e-9)
        alone = indented_states(single(), one, amplitude=A, indentation=3e-9)
        np.testing.assert_array_equal(alone.force[0], got.force[k])
        assert alone.height[0] == got.height[k]


def test_broken_numbers_are_marked_and_nothing_gives_nothing() -> None:
    got = indented_states(
        lever(BASE), MATERIALS["dmt"], amplitude=[40e-9, math.nan, 40e-9], indentation=[3e-9, 3e-9, math.nan]
    )
    assert got.status.tolist() == [FOUND, NOT_CONVERGED, NOT_CONVERGED]
    none = indented_states(lever(BASE), MATERIALS["dmt"], amplitude=[], indentation=[])
    assert none.force.shape == (0, 11)
    assert none.status.size == 0


def test_harmonics_kept_change_little() -> None:
    few, many = (
        indented_states(single(), MATERIALS["dmt"], amplitude=50e-9, indentation=5e-9, n_max=n)
        for n in (10, 20)
    )
    assert few.force.shape[1] == 11
    np.testing.assert_allclose(few.force[0, :4].real, many.force[0, :4].real, rtol=2e-4)
