"""Errors that a whole scan shares, carried to forces: against finite differences of the public way there."""

import math
from dataclasses import replace

import numpy as np
import pytest
import xarray as xr

from overtone.errors import ObservablesError
from overtone.harmonics import to_force_harmonics
from overtone.instrument.calibration import Calibration
from overtone.instrument.shared import conservative, first_force, redo, shared_forces
from overtone.instrument.signals import Signals, signals_of, with_signals
from overtone.instrument.unknowns import LEVER, NAMES, NEUTRAL, UNKNOWNS, probe_with, undo
from overtone.probe import Cantilever, Detector, Drive, Mode, Probe, Tip

A_REF = 94e-9
MODES = (Mode(16.4, 161.8e3, 287.0), Mode(640.0, 1.014e6, 500.0, 3.47), Mode(5100.0, 2.84e6, 700.0, 5.7))
SINGLE = Probe(Cantilever(MODES[:1]), Drive(161.5e3, A_REF), Tip(10e-9))
SLOPE = Probe(Cantilever(MODES, 15.9, 1.09), Drive(161.8e3, A_REF), Tip(10e-9), Detector("slope"))
PROBES = {
    "one mode, off resonance": SINGLE,
    "three modes, slope": SLOPE,
    "static sensitivity": replace(SLOPE, detector=Detector("slope", "static")),
}
VALUES = dict(NEUTRAL) | {
    "A0_offset": 2e-10,
    "A0_slope_z": 0.004,
    "A0_slope_x": 1e-3,
    "A0_slope_y": -2e-3,
    "distortion0_0": 3e-10,
    "distortion0_1": -5e-11,
    "gain0": 1.1,
    "phi1_offset": 0.2,
    "compression": 0.02,
    "distortion2_0_re": 2e-10,
    "distortion2_0_im": -1e-10,
    "distortion2_1_re": 3e-11,
    "crosstalk2_im": 2e-11,
    "gain2": 0.85,
    "latency2": 0.5,
    "distortion3_0_re": -6e-10,
    "crosstalk3_re": 1e-11,
    "gain3": 1.2,
    "latency3": -0.4,
    "stiffness": 1.05,
    "quality_factor": 0.97,
    "resonance": 1.0001,
    "free_amplitude": 1.01,
    "radius": 1.2,
}
SCALES = {"m": 5e-12, "rad": 2e-3, "1": 1e-2}
WHERE = {
    "height": np.linspace(-30e-9, 30e-9, 6),
    "x": np.linspace(-1e-6, 1e-6, 6),
    "y": np.linspace(2e-6, -2e-6, 6),
}


def observables(count: int = 6) -> xr.Dataset:
    generator = np.random.default_rng(2)
    sizes = {"A0": 1e-10, "A1": 4e-8, "phi1": 0.7, "A2": 1e-10, "phi2": 5.0, "A3": 4e-11, "phi3": 2.0}
    return xr.Dataset({n: ("point", v * generator.uniform(0.7, 1.3, count)) for n, v in sizes.items()})


def calibration(probe: Probe = SINGLE, *, scale: float = 1.0, names: tuple[str, ...] = NAMES) -> Calibration:
    """Return a calibration whose unknowns are all unsure, and correlated with each other."""
    units = {unknown.name: unknown.unit for unknown in UNKNOWNS}
    # ten hertz turn the phase by two degrees
    sizes = {name: SCALES[unit] for name, unit in units.items()} | {"resonance": 1e-5}
    spread = scale * np.array([sizes[name] for name in names])
    root = np.random.default_rng(3).normal(size=(len(names), 2 * len(names)))
    covariance = root @ root.T / (2 * len(names)) * np.outer(spread, spread)
    return Calibration(probe, A_REF, VALUES, names, covariance)


# --- there and back -------------------------------------------------------------------------------


def test_readings_are_what_the_removal_turns_into_the_signals() -> None:
    clean = signals_of(observables())
    read = redo(clean, VALUES, A_REF, **WHERE)
    # far from what they were: offsets, distortion, gain, phase
    assert np.abs(read.mean - clean.mean).min() > 1e-10
    assert all(
        np.abs(read.phasor[n] - clean.phasor[n]).min() > 0.05 * np.abs(clean.phasor[n]).max()
        for n in (1, 2, 3)
    )
    again = undo(read, VALUES, A_REF, **WHERE)
    np.testing.assert_allclose(again.mean, clean.mean, rtol=1e-8)
    for n in (1, 2, 3):
        np.testing.assert_allclose(again.phasor[n], clean.phasor[n], rtol=1e-8)


def test_readings_are_found_without_a_mean_and_beyond_the_third_harmonic() -> None:
    whole = signals_of(observables())
    clean = Signals(None, {1: whole.phasor[1], 2: whole.phasor[2], 5: whole.phasor[3]})
    again = undo(redo(clean, VALUES, A_REF), VALUES, A_REF)
    assert again.mean is None
    for n in (1, 2, 5):
        np.testing.assert_allclose(again.phasor[n], clean.phasor[n], rtol=1e-8)


# --- forces ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", list(PROBES))
def test_forces_are_those_of_the_public_way(name: str) -> None:
    probe, data = PROBES[name], observables()
    expected = to_force_harmonics(data, probe)
    got = conservative(signals_of(data), probe, (0, 1, 2, 3))
    for k in range(4):
        np.testing.assert_allclose(got[:, k], expected["F_cons"].sel(harmonic=k), rtol=1e-11)
    np.testing.assert_allclose(conservative(signals_of(data), probe, (2, 0)), got[:, [2, 0]], rtol=1e-14)
    first = first_force(data["A1"].values, data["phi1"].values, probe)
    np.testing.assert_allclose(first.imag, -expected["F_diss"].sel(harmonic=1), rtol=1e-11)


def test_a_harmonic_that_was_not_measured_is_named() -> None:
    whole = signals_of(observables())
    with pytest.raises(ObservablesError, match="harmonic 0 was not measured"):
        conservative(Signals(None, whole.phasor), SINGLE, (0, 1, 2))
    with pytest.raises(ObservablesError, match="harmonic 4, 5 was not measured"):
        conservative(whole, SINGLE, (1, 4, 5))


def forces(data: xr.Dataset, read: Signals, values: dict[str, float], probe: Probe) -> np.ndarray:
    """Return conservative harmonics of corrected readings by the dataset and its public function."""
    there = probe_with(probe, values)
    return to_force_harmonics(with_signals(data, undo(read, values, A_REF, **WHERE)), there)[
        "F_cons"
    ].values.T


@pytest.mark.parametrize("name", list(PROBES))
def test_changes_of_the_forces_have_the_covariance_of_finite_differences(name: str) -> None:
    """F F^T = J C J^T for every pair of (point, harmonic), J from one unknown at a time."""
    probe, data = PROBES[name], observables()
    known, clean = calibration(probe), signals_of(data)
    got, radius = shared_forces(clean, known, (0, 1, 2, 3), **WHERE)
    assert got.shape == (6, 4, len(NAMES))
    read = redo(clean, VALUES, A_REF, **WHERE)
    J = np.empty((6, 4, len(NAMES)))
    for j, unknown in enumerate(NAMES):
        step = 1e-2 * known.error(unknown)
        up, down = (forces(data, read, VALUES | {unknown: VALUES[unknown] + s}, probe) for s in (step, -step))
        J[..., j] = (up - down) / (2.0 * step)
    expected = np.einsum("pmi,ij,qnj->pmqn", J, known.covariance, J)
    made = np.einsum("pms,qns->pmqn", got, got)
    size = np.sqrt(np.einsum("pmpm->pm", expected))
    scale = size[:, :, None, None] * size
    assert size.min() > 0.0
    np.testing.assert_allclose(made / scale, expected / scale, atol=1e-3)
    # ln R goes with the same sources
    at = NAMES.index("radius")
    assert float(radius @ radius) == pytest.approx(known.covariance[at, at] / 1.2**2, rel=1e-9, abs=0)
    together = np.einsum("pms,s->pm", got, radius)
    np.testing.assert_allclose(
        together / size, np.einsum("pmi,i->pm", J, known.covariance[at]) / 1.2 / size, atol=1e-3
    )


def test_one_offset_moves_the_mean_force_alone_and_by_the_static_stiffness() -> None:
    plain = replace(calibration(), values=dict(NEUTRAL), names=("A0_offset",), covariance=np.array([[1e-24]]))
    got, radius = shared_forces(signals_of(observables()), plain, (0, 1, 2))
    np.testing.assert_allclose(np.abs(got[:, 0, 0]), 16.4e-12, rtol=1e-9)
    assert np.abs(got[:, 1:, 0]).max() < 1e-9 * 16.4e-12
    assert radius.tolist() == [0.0]


def test_the_phase_turns_the_drive_against_the_first_harmonic() -> None:
    """d CONS_1/d eps = -F_dr sin phi1 at resonance, with phi1 read too large by eps: here it is then taken off."""
    probe = replace(SINGLE, drive=Drive(161.8e3, A_REF))
    plain = replace(
        calibration(probe), values=dict(NEUTRAL), names=("phi1_offset",), covariance=np.array([[1e-6]])
    )
    data = observables()
    got, _ = shared_forces(signals_of(data), plain, (1,))
    expected = 16.4 * A_REF / 287.0 * np.sin(data["phi1"].values) * 1e-3
    np.testing.assert_allclose(np.abs(got[:, 0, 0]), expected, rtol=1e-4)


def test_unknowns_without_an_error_and_an_empty_covariance_add_nothing() -> None:
    names = ("A0_offset", "gain2", "phi1_offset")
    partly = replace(calibration(), names=names, covariance=np.diag([1e-24, 0.0, 1e-6]))
    got, radius = shared_forces(signals_of(observables()), partly, (0, 1, 2))
    assert got.shape == (6, 3, 2)
    assert radius.shape == (2,)
    none = replace(calibration(), names=(), covariance=np.zeros((0, 0)))
    got, radius = shared_forces(signals_of(observables()), none, (0, 1, 2))
    assert got.shape == (6, 3, 0)
    assert radius.shape == (0,)


def test_fully_correlated_unknowns_are_one_source() -> None:
    """Drive and quality factor that change together by as much leave the free amplitude's phase, and one source."""
    root = np.array([5e-12, 2e-3])
    tied = replace(calibration(), names=("A0_offset", "phi1_offset"), covariance=np.outer(root, root))
    got, _ = shared_forces(signals_of(observables()), tied, (0, 1))
    assert got.shape == (6, 2, 1)
    alone = [
        shared_forces(
            signals_of(observables()), replace(tied, names=(n,), covariance=np.array([[s**2]])), (0, 1)
        )[0]
        for n, s in zip(("A0_offset", "phi1_offset"), root, strict=True)
    ]
    sign = np.sign(got[0, 0, 0] / alone[0][0, 0, 0])
    # in the direction of the root both move with their own sign
    np.testing.assert_allclose(sign * got[:, 0, 0], alone[0][:, 0, 0], rtol=1e-4)
    assert np.abs(np.abs(got[:, 1, 0]) - np.abs(alone[1][:, 1, 0])).max() < 1e-4 * np.abs(got[:, 1, 0]).max()


def test_every_factor_of_the_lever_counts() -> None:
    for name in LEVER:
        one = replace(calibration(), names=(name,), covariance=np.array([[1e-4]]))
        got, radius = shared_forces(signals_of(observables()), one, (0, 1, 2))
        if name == "radius":
            assert not got.any()
            assert abs(radius[0]) == pytest.approx(1e-2 / 1.2, rel=1e-9, abs=0)
        else:
            assert math.sqrt(float((got**2).sum())) > 0.0
            assert radius.tolist() == [0.0]
