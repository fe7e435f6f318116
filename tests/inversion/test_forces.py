"""Force harmonics in blocks: those of `to_force_harmonics`, in the phase of the tip, with the errors of each."""

import math
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import pytest
import xarray as xr

from overtone.contact.sample import sample
from overtone.dynamics.indented import Indented, indented_states
from overtone.dynamics.system import setup
from overtone.harmonics import far_phase, read_receptance, tip_receptance, to_force_harmonics
from overtone.instrument.noise import add_noise, complete_noise
from overtone.inversion.forces import Rows, force_block, reader_of, readings_of, row_block, rows_of
from overtone.probe import BASE, SLOPE, TIP, Cantilever, Detector, Drive, Mode, Probe

ORDERS = (0, 1, 2, 3)
NOISE = {"A0": 5e-12, "A1": 2e-11, "phi1": 2e-3, "A2": 1e-12, "A3": 1.5e-12}


def single(r: float = 1.0) -> Probe:
    return Probe.simple(
        stiffness=16.4,
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
        single(r),
        cantilever=Cantilever(modes, 15.92, 1.0897),
        drive=Drive(r * 161.8e3, 94e-9, acts_on),
        detector=Detector(SLOPE),
    )


PROBES = {
    "one mode": single(),
    "off resonance": single(0.99),
    "optical lever": lever(),
    "static sensitivity": replace(lever(), detector=Detector(SLOPE, "static")),
    "shaken base": lever(BASE, r=0.998),
    "shaken base, low Q": lever(BASE, Q=20.0),
}
PLAIN = [key for key, probe in PROBES.items() if probe.detector.kind != SLOPE]
TURNED = [key for key in PROBES if key not in PLAIN]


class Block(NamedTuple):
    f: np.ndarray
    errors: np.ndarray
    tip_amplitude: np.ndarray
    turn: np.ndarray


def forces(observables: xr.Dataset, probe: Probe, sigma: dict[str, float] | None = None) -> Block:
    reader = reader_of(probe, ORDERS, complete_noise(sigma or NOISE, ORDERS))
    amplitudes, phases = readings_of(observables, ORDERS)
    count = amplitudes[0].size
    amplitude = np.stack(amplitudes, axis=1)
    phase = np.stack([np.broadcast_to(p, count) for p in phases], axis=1)
    block = Block(
        np.empty((count, 4), complex),
        np.empty((count, 4, 9), complex),
        np.empty(count),
        np.empty(count, complex),
    )
    force_block(amplitude, np.ascontiguousarray(phase), reader, *block)
    return block


def plain(observables: xr.Dataset, probe: Probe) -> np.ndarray:
    result = to_force_harmonics(observables, probe)
    return (result["F_cons"] - 1j * result["F_diss"]).transpose(..., "harmonic").values


def random_readings(count: int, seed: int = 1) -> xr.Dataset:
    random = np.random.default_rng(seed)
    values = {
        "A0": random.uniform(-2e-10, 6e-10, count),
        "A1": random.uniform(20e-9, 90e-9, count),
        "phi1": random.uniform(0.2, 2.8, count),
    }
    for n in (2, 3):
        values[f"A{n}"] = random.uniform(1e-11, 2e-10, count)
        values[f"phi{n}"] = random.uniform(0.0, 2.0 * math.pi, count)
    return xr.Dataset({name: ("pixel", value) for name, value in values.items()})


def states(probe: Probe, **changes: Any) -> tuple[Indented, np.ndarray, np.ndarray]:
    """Return motions of a viscous, sticky sample with the forces and the amplitude in the phase of the tip."""
    material = {"modulus": 0.8e9, "poisson_ratio": 0.3, "adhesion": 12e-9, "viscosity": 60.0} | changes
    found = indented_states(
        probe,
        sample("dmt-viscous", **material),
        amplitude=np.array([60e-9, 45e-9, 45e-9, 70e-9]),
        indentation=np.array([3e-9, 0.5e-9, 7e-9, 1.5e-9]),
        n_max=12,
    )
    # what moves the tip is the force together with the drive that stands for the base
    motion = complex(tip_receptance(probe.cantilever, probe.drive.frequency)) * (
        found.force[:, 1] + found.drive
    )
    back = np.exp(-1j * np.angle(motion)[:, None] * np.arange(13))
    return found, found.force * back, np.abs(motion)


def read_in_its_own_probe(probe: Probe, found: Indented, pixel: int) -> tuple[Probe, xr.Dataset]:
    """Return the probe whose free amplitude the state of a pixel needs, and what it reads there."""
    share = abs(found.drive[pixel]) / setup(probe, 3).lever.force
    own = replace(probe, drive=replace(probe.drive, free_amplitude=share * probe.drive.free_amplitude))
    G = complex(read_receptance(probe, probe.drive.frequency))
    reading = found.reading[pixel]
    rotor = (reading[1] - G * found.force[pixel, 1]) / own.drive.free_amplitude
    assert abs(abs(rotor) - 1.0) < 1e-8
    phi1 = float(np.angle(rotor)) + far_phase(probe)
    values = {"A0": reading[0].real, "A1": reading[1].real, "phi1": phi1 % (2.0 * math.pi)}
    for n in (2, 3):
        values[f"A{n}"] = abs(reading[n])
        values[f"phi{n}"] = (n * phi1 - float(np.angle(reading[n]))) % (2.0 * math.pi)
    return own, xr.Dataset({name: ("pixel", np.array([float(v)])) for name, v in values.items()})


@pytest.mark.parametrize("key", PLAIN)
def test_forces_are_those_of_the_whole_dataset(key: str) -> None:
    observables = random_readings(60)
    got = forces(observables, PROBES[key])
    want = plain(observables, PROBES[key])
    np.testing.assert_allclose(got.f[:, 1:], want[:, 1:], rtol=1e-11)
    np.testing.assert_allclose(got.f[:, 0].real, want[:, 0].real, rtol=1e-11)
    np.testing.assert_allclose(got.turn, 1.0, rtol=1e-11)


@pytest.mark.parametrize("key", TURNED)
def test_an_optical_lever_reads_another_phase_than_that_of_the_tip(key: str) -> None:
    observables = random_readings(60)
    got = forces(observables, PROBES[key])
    want = plain(observables, PROBES[key]) * got.turn[:, None] ** np.arange(4)
    np.testing.assert_allclose(got.f[:, 1:], want[:, 1:], rtol=1e-11)
    np.testing.assert_allclose(np.abs(got.turn), 1.0, rtol=1e-12)
    assert np.abs(np.angle(got.turn)).max() > 1e-4


@pytest.mark.parametrize("key", PROBES)
def test_readings_of_simulated_motions_come_back_in_the_phase_of_the_tip(key: str) -> None:
    probe = PROBES[key]
    found, f, tip_amplitude = states(probe)
    for pixel in range(4):
        own, observables = read_in_its_own_probe(probe, found, pixel)
        got = forces(observables, own)
        size = np.abs(f[pixel]).max()
        np.testing.assert_allclose(got.f[0], f[pixel, :4], rtol=1e-7, atol=1e-9 * size)
        assert got.tip_amplitude[0] == pytest.approx(tip_amplitude[pixel], rel=1e-8, abs=0)


def test_the_lever_of_low_quality_would_be_misread_without() -> None:
    """The turn is not small there: without it the loss is off by half."""
    found, f, _ = states(PROBES["shaken base, low Q"])
    assert (np.abs(found.force[:, 1].imag / f[:, 1].imag - 1.0) > 0.05).all()


@pytest.mark.parametrize("key", PROBES)
def test_errors_are_the_derivatives_by_each_reading(key: str) -> None:
    """One column an error, signs included; into the phase of the tip by the turn of the reading itself."""
    probe = PROBES[key]
    observables = random_readings(25, seed=2)
    errors = forces(observables, probe).errors
    turn = forces(observables, probe).turn[:, None] ** np.arange(4)
    sources: list[tuple[int, str, Any]] = [(0, "phi1", NOISE["phi1"])]
    sources += [(1 + n, f"A{n}", NOISE[f"A{n}"]) for n in ORDERS]
    sources += [(5 + n, f"phi{n}", NOISE[f"A{n}"] / observables[f"A{n}"]) for n in (2, 3)]
    for column, name, sigma in sources:
        step = 1e-3 * sigma
        up, down = (
            plain(observables.assign({name: observables[name] + way * step}), probe) for way in (1, -1)
        )
        want = (up - down) / 2e-3 * turn
        size = np.abs(want).max()
        np.testing.assert_allclose(errors[:, :, column], want, rtol=1e-5, atol=1e-6 * size, err_msg=name)
    # A1 has no phase of its own beside phi1, A0 none at all
    assert not errors[:, :, 5:7].any()


@pytest.mark.parametrize(("key", "part"), [("shaken base", 0.02), ("shaken base, low Q", 0.2)])
def test_what_an_error_does_to_the_turn_is_left_out(key: str, part: float) -> None:
    """A share of about 4/Q of the error of each force, under a shaken base; nothing under a force at the tip."""
    probe = PROBES[key]
    observables = random_readings(100, seed=2)
    errors = forces(observables, probe).errors
    size = np.sqrt((np.abs(errors) ** 2).sum(axis=2))
    for column, name in ((0, "phi1"), (2, "A1")):
        step = 1e-3 * NOISE[name]
        up, down = (
            forces(observables.assign({name: observables[name] + way * step}), probe).f for way in (1, -1)
        )
        off = np.abs((up - down) / 2e-3 - errors[:, :, column]) / size
        assert 0.1 * part < off.max() < part


def test_a_stated_phase_counts_instead_of_the_amplitude() -> None:
    observables = random_readings(10, seed=3)
    errors = forces(observables, single(), {**NOISE, "phi2": 0.02}).errors
    by_amplitude = np.abs(errors[:, 2, 3]) / NOISE["A2"]
    np.testing.assert_allclose(np.abs(errors[:, 2, 7]), 0.02 * observables["A2"] * by_amplitude, rtol=1e-12)


def rowed(
    block: Block, rows: Rows, errors: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    count, size = block.f.shape[0], rows.orders.size
    y, W, usable = np.empty((count, size)), np.empty((count, size, size)), np.empty(count, bool)
    row_block(block.f, block.errors if errors is None else errors, rows, y, W, usable)
    return y, W, usable


def test_rows_are_conservative_first() -> None:
    rows, orders = rows_of((0, 2, 3), (1, 2))
    assert orders == (0, 1, 2, 3)
    np.testing.assert_array_equal(rows.orders, [0, 2, 3, 1, 2])
    np.testing.assert_array_equal(rows.lossy, [False, False, False, True, True])
    np.testing.assert_array_equal(rows.harmonics, [0, 2, 3, 1, 2])
    rows, orders = rows_of((2, 3), ())
    assert orders == (1, 2, 3)  # A1 and phi1 are always needed
    np.testing.assert_array_equal(rows.harmonics, [1, 2])
    block = forces(random_readings(8), single())
    y, _, _ = rowed(block, rows_of((0, 1, 2, 3), (1, 2))[0])
    np.testing.assert_array_equal(y[:, :4], block.f.real)
    np.testing.assert_array_equal(y[:, 4:], -block.f[:, 1:3].imag)


def test_whitening_makes_errors_independent() -> None:
    block = forces(random_readings(30), single())
    rows = rows_of((0, 1, 2, 3), (1, 2))[0]
    _, W, usable = rowed(block, rows)
    assert usable.all()
    parts = np.where(
        rows.lossy[:, None], -block.errors[:, rows.harmonics].imag, block.errors[:, rows.harmonics].real
    )
    white = np.einsum("pij,pjs->pis", W, parts)
    np.testing.assert_allclose(
        np.einsum("pis,pjs->pij", white, white), np.broadcast_to(np.eye(6), (30, 6, 6)), atol=1e-4
    )
    assert not np.triu(W, 1).any()


@pytest.mark.parametrize("key", ["off resonance", "optical lever"])
def test_covariance_is_that_of_drawn_noise(key: str) -> None:
    """Of 40000 noisy readings of one pixel, through `add_noise` and `to_force_harmonics`: 4 standard errors."""
    probe, draws = PROBES[key], 40000
    one = random_readings(1, seed=6).assign(A2=("pixel", [8e-11]), A3=("pixel", [3e-11]))
    many = one.isel(pixel=np.zeros(draws, int))
    block = forces(one, probe)
    f = plain(add_noise(many, NOISE, seed=7), probe) * block.turn[0] ** np.arange(4)
    rows = rows_of((0, 1, 2, 3), (1, 2))[0]
    drawn = np.where(rows.lossy, -f[:, rows.harmonics].imag, f[:, rows.harmonics].real)
    y, W, _ = rowed(block, rows)
    white = (drawn - y[0]) @ W[0].T
    covariance = white.T @ white / draws
    # whitened, every entry has the same standard error; phases bend by a part of their 2 mrad
    np.testing.assert_allclose(covariance, np.eye(6), atol=4.5 * math.sqrt(2.0 / draws))
    np.testing.assert_allclose(white.mean(axis=0), 0.0, atol=4.5 / math.sqrt(draws))


def test_data_free_of_noise_have_a_whitening_all_the_same() -> None:
    block = forces(random_readings(5), single(), dict.fromkeys([*NOISE, "phi2", "phi3"], 0.0))
    y, W, usable = rowed(block, rows_of((0, 1, 2), ())[0])
    assert usable.all()
    assert np.isfinite(W).all()
    assert (np.abs(np.einsum("pij,pj->pi", W, y)).max(axis=1) > 1e6).all()


def test_lost_pixels_are_not_usable() -> None:
    observables = random_readings(7)
    for pixel, (name, value) in enumerate(
        [("A0", math.nan), ("A1", math.inf), ("phi1", math.nan), ("A2", math.inf), ("phi3", math.inf)]
    ):
        observables[name][pixel] = value
    with np.errstate(invalid="ignore"):
        block = forces(observables, single())
    rows = rows_of((0, 1, 2, 3), ())[0]
    _, _, usable = rowed(block, rows)
    np.testing.assert_array_equal(usable, [False] * 5 + [True] * 2)
    # nothing at all is no force
    nothing = block._replace(f=np.zeros_like(block.f))
    errors = np.nan_to_num(block.errors)
    assert not rowed(nothing, rows, errors)[2].any()


def test_readings_are_flat_on_the_dimensions_of_the_amplitude() -> None:
    random = np.random.default_rng(8)
    values = {name: random.uniform(1.0, 2.0, (3, 4)) for name in ("A0", "A1", "phi1", "A2", "phi2")}
    scan = xr.Dataset({name: (("y", "x"), value) for name, value in values.items()})
    scan["A2"] = scan["A2"].transpose("x", "y")
    scan["A0"] = ("x", values["A0"][0])
    amplitudes, phases = readings_of(scan, (0, 1, 2))
    np.testing.assert_array_equal(amplitudes[0], np.tile(values["A0"][0], 3))
    np.testing.assert_array_equal(amplitudes[2], values["A2"].ravel())
    np.testing.assert_array_equal(phases[2], values["phi2"].ravel())
    assert not phases[0].any()
