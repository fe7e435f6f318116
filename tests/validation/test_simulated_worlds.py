"""Simulated worlds are what they say: benchmarks/worlds_simulated.py and worlds_forces.py."""

import importlib
import math
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
import xarray as xr
from scipy.integrate import quad

import overtone as ot
from overtone.instrument.correct import calibration_of
from overtone.instrument.shared import forces_of, shared_changes
from overtone.instrument.signals import positions, signals_of
from overtone.instrument.unknowns import undo

FOLDER = Path(__file__).parents[2] / "benchmarks"
SMALL = (40, 40)
ORDERS = (0, 1, 2, 3)


@pytest.fixture
def worlds(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(str(FOLDER))
    return importlib.import_module("worlds_simulated")


@pytest.fixture
def forces(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(str(FOLDER))
    return importlib.import_module("worlds_forces")


def solid_of(truth: xr.Dataset, poisson_ratio: float) -> ot.Sample:
    values = {name: truth[name].values for name in ("modulus", "adhesion", "viscosity")}
    return ot.sample("dmt-viscous", poisson_ratio=poisson_ratio, **values)


@pytest.fixture
def quiet(worlds: ModuleType, monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.setattr(worlds, "NOISE", {name: 1e-6 * sigma for name, sigma in worlds.NOISE.items()})
    return worlds


def test_readings_are_those_of_the_true_lever_through_the_true_instrument(quiet: ModuleType) -> None:
    world = quiet.world(3, calibration="loose", noise_A0=1e-18, shape=SMALL)
    read, where = signals_of(world.scan), positions(world.scan)._asdict()
    undone = undo(read, world.errors, world.calibration.amplitude, **where)
    share = world.scan["A1"] / world.true_probe.drive.free_amplitude
    states = ot.hold_amplitude(world.true_probe, solid_of(world.truth, 0.35), setpoint=share.drop_attrs())
    force = (states["F_cons"] - 1j * states["F_diss"]).transpose("y", "x", "harmonic").values
    np.testing.assert_allclose(forces_of(undone, world.true_probe, ORDERS), force, rtol=0, atol=1e-5 * 2e-9)
    np.testing.assert_allclose(world.truth["indentation"], states["indentation"], rtol=1e-5)


def test_true_less_inferred_force_is_the_shared_change_of_the_drawn_errors(quiet: ModuleType) -> None:
    tenth = {name: 0.1 * sigma for name, sigma in quiet.TIGHT.items()}
    world = quiet.world(3, calibration=tenth, noise_A0=1e-18, shape=SMALL)
    read, where, left = signals_of(world.scan), positions(world.scan)._asdict(), calibration_of(world.scan)
    assert left is not None
    states = ot.hold_amplitude(
        world.true_probe,
        solid_of(world.truth, 0.35),
        setpoint=(world.scan["A1"] / world.true_probe.drive.free_amplitude).drop_attrs(),
    )
    true = (states["F_cons"] - 1j * states["F_diss"]).transpose("y", "x", "harmonic").values
    off = true - forces_of(read, world.probe, ORDERS)
    changes, radius = shared_changes(read, left, ORDERS, **where)
    # the covariance is diagonal, so a source is an unknown, up to a sign and the order
    scaled = np.array([(world.errors[n] - left.values[n]) / left.error(n) for n in left.names])
    vectors = np.linalg.eigh(left.covariance / np.outer(*2 * [np.sqrt(np.diag(left.covariance))]))[1]
    linear = changes @ (vectors.T @ scaled)
    size = np.sqrt((np.abs(off) ** 2).mean(axis=(0, 1)))
    assert (size > 1e-12).all()
    assert (np.sqrt((np.abs(off - linear) ** 2).mean(axis=(0, 1))) < 0.02 * size).all()
    assert radius @ (vectors.T @ scaled) == pytest.approx(world.errors["radius"] - 1.0, rel=1e-6)


def test_a_seed_is_one_sample_and_one_instrument_whatever_else_is_asked(worlds: ModuleType) -> None:
    first = worlds.world(5, shape=SMALL)
    other = worlds.world(5, shape=SMALL, kind="blunted-cone", noise_A0=50e-12, calibration="loose")
    xr.testing.assert_identical(first.truth.drop_vars("indentation"), other.truth.drop_vars("indentation"))
    assert first.materials == other.materials
    names = [name for name in worlds.TIGHT if name not in ("stiffness", "radius")]
    neutral = first.calibration.values
    for name in names:
        drawn = [(w.errors[name] - neutral[name]) / w.calibration.error(name) for w in (first, other)]
        assert drawn[0] == pytest.approx(drawn[1], rel=1e-6)
    # a cone goes in deeper
    assert float(np.abs(first.truth["indentation"] / other.truth["indentation"] - 1.0).max()) > 0.01


def test_materials_say_what_is_true_of_their_pixels(worlds: ModuleType) -> None:
    world = worlds.world(8, shape=(96, 96), calibration="tight")
    material = world.truth["material"].values
    assert 0.2 < (material == 1).mean() < 0.4
    assert 0.02 < (material == 2).mean() < 0.08
    assert 0.03 < (material == -1).mean() < 0.3
    for index, one in enumerate(world.materials):
        own = world.truth["modulus"].values[material == index]
        assert one.modulus == pytest.approx(np.median(own), rel=1e-9)
        assert one.drawn["modulus"] == pytest.approx(one.modulus, rel=0.1)
        assert one.spread["modulus"] == pytest.approx(np.log(own).std(), rel=1e-9)
        assert worlds.SPREAD[0] * 0.7 < one.spread["adhesion"] < worlds.SPREAD[1] * 1.3
    w_eta = 2.0 * math.pi * world.probe.drive.frequency * world.truth["viscosity"]
    E = 1.0 / ((1.0 - 0.35**2) / world.truth["modulus"] + (1.0 - 0.3**2) / 130e9)
    np.testing.assert_allclose(w_eta / (2.0 * E), world.truth["loss_tangent"], rtol=1e-9)


def test_several_set_points_are_scans_of_the_same_pixels(worlds: ModuleType) -> None:
    world = worlds.world(8, shape=SMALL, setpoints=(0.42, 0.6), kind="gradient")
    ratio = world.scans[1]["A1"].mean() / world.scans[0]["A1"].mean()
    assert float(ratio) == pytest.approx(0.6 / 0.42, rel=1e-3)
    assert world.truth["indentation"].dims == ("setpoint", "y", "x")
    assert world.materials == ()
    assert (world.truth["material"] == -1).all()


def test_a_force_that_is_dmt_viscous_is_held_as_hold_amplitude_holds_it(forces: ModuleType) -> None:
    from overtone.demo import demo_probe

    probe = demo_probe()
    E, tangent = np.array([[94e6, 0.5e9, 1.93e9]]), np.array([[0.1, 0.1, 0.05]])
    star = 1.0 / ((1.0 - 0.35**2) / E + (1.0 - 0.3**2) / 130e9)
    eta = tangent * star / (math.pi * probe.drive.frequency)
    solid = ot.sample("dmt-viscous", modulus=E, adhesion=5e-9, viscosity=eta, poisson_ratio=0.35)
    # the search begins at another amplitude, and has to find its way; the motion is followed anew but once on it
    states = ot.hold_amplitude(probe, solid, setpoint=0.45)
    wanted = ot.hold_amplitude(probe, solid, setpoint=0.42)

    def same(contacts: object, indentation: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        ones = np.ones(indentation.shape)
        return contacts.bare(indentation, ones), ones

    amplitude = np.full(E.shape, 0.42 * probe.drive.free_amplitude)
    held = forces.held(probe, solid, tangent, amplitude, states, same)
    for name in ("A0", "A1", "A2", "A3", "phi1", "phi2", "phi3", "indentation"):
        np.testing.assert_allclose(held[name], wanted[name], rtol=1e-5, err_msg=name)
    np.testing.assert_allclose(held["Z"], wanted["Z"], rtol=0, atol=10e-12)


def test_cone_contact_against_quadrature(forces: ModuleType) -> None:
    for a in (0.5, 1.5, 3.0):
        edge = math.asin(min(forces.BLUNT / a, 1.0))

        def slope(t: float, a: float = a) -> float:
            return a * math.sin(t) if a * math.sin(t) < forces.BLUNT else forces.SLOPE

        depth = a * quad(slope, 0.0, math.pi / 2, points=[edge])[0]
        force = (
            2.0
            * quad(lambda t, a=a: (a * math.sin(t)) ** 2 * slope(t, a), 0.0, math.pi / 2, points=[edge])[0]
        )
        np.testing.assert_allclose(forces.cone_contact(np.array([a])), [[depth], [force]], rtol=1e-8)


def test_blunted_cone_and_relaxing_solid_against_their_laws(
    forces: ModuleType, monkeypatch: pytest.MonkeyPatch
) -> None:
    omega, A, delta, fad, star, t = 2.0 * math.pi * 161.8e3, 40e-9, 20e-9, 5e-9, 100e6, 0.1
    nu, tip = 0.35, (1.0 - 0.3**2) / 130e9
    given = {
        "modulus": (1.0 - nu**2) / (1.0 / star - tip),
        "poisson_ratio": nu,
        "adhesion": fad,
        "viscosity": t * 2.0 * star / omega,
        "intermolecular_distance": 0.2e-9,
        "radius": 10e-9,
        "tip_modulus": 130e9,
        "tip_poisson_ratio": 0.3,
        "frequency": 161.8e3,
    }
    arrays = {name: np.array([value]) for name, value in given.items()}
    contacts = forces.Contacts(arrays, np.array([star]), np.array([t]), np.array([A]))
    f, times = forces.blunted_cone(contacts, np.array([delta]))
    assert times[0] == pytest.approx(0.88, abs=0.03)
    radii = np.linspace(1e-4, 6.0, 60000)
    depth, load = forces.cone_contact(radii)
    theta = np.linspace(0.0, 2.0 * math.pi, 400001)
    gap, velocity = A * (1.0 + np.cos(theta)) - delta, -A * omega * np.sin(theta)
    inside = np.maximum(-gap, 0.0) / 10e-9
    # from Sneddon's curve itself; the loss is eta times the contact radius times the velocity
    force = star * 1e-16 * np.interp(inside, depth, load, left=0.0)
    force -= given["viscosity"] * 10e-9 * np.interp(inside, depth, radii, left=0.0) * velocity
    force -= np.where(gap < 0.0, fad, fad * (0.2e-9 / (0.2e-9 + np.maximum(gap, 0.0))) ** 2)
    for n in (0, 1, 2, 3):
        wave = np.trapezoid(force * np.exp(-1j * n * theta), theta) / (math.pi if n else 2.0 * math.pi)
        assert abs(wave - f[0, n]) < 2e-4 * abs(f[0, 1])
    # a solid with the storage modulus and the loss tangent of the contact at the frequency of the drive
    told: dict[str, np.ndarray] = {}
    monkeypatch.setattr(forces, "sls_harmonics", lambda *_, **solid: told.update(solid) or np.zeros((1, 11)))
    forces.standard_linear_solid(contacts, np.array([delta]))
    x = omega * told["relaxation_time"]
    late, excess = told["effective_modulus"], told["instantaneous_modulus"] - told["effective_modulus"]
    complex_modulus = late + excess * 1j * x / (1.0 + 1j * x)
    assert complex_modulus[0] == pytest.approx(star * (1.0 + 1j * t), rel=1e-9)
    monkeypatch.undo()
    # a solid that hardly relaxes is an elastic one
    elastic = contacts._replace(tangent=np.array([1e-9]))
    relaxing = forces.standard_linear_solid(elastic, np.array([delta]))[0]
    own = {name: value for name, value in given.items() if name not in ("viscosity", "frequency")}
    wanted = ot.force_harmonics("dmt", amplitude=A, indentation=delta, n_max=10, **own)
    np.testing.assert_allclose(relaxing[0], wanted, rtol=0, atol=1e-7 * abs(wanted[1]))
