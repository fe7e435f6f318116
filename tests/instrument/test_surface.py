from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from overtone.beam import beam_modes
from overtone.errors import ObservablesError, ProbeError
from overtone.harmonics import far_phase, read_receptance
from overtone.instrument.surface import lever_near_surface, resonance_from_ladder
from overtone.probe import Cantilever, Detector, Drive, Probe


def single(drive: float = 161.8e3) -> Probe:
    return Probe.simple(stiffness=16.4, frequency=161.8e3, quality_factor=287.0, radius=10e-9,
                        drive_frequency=drive, free_amplitude=94e-9)  # fmt: skip


def beam(drive: float = 161.5e3, kind: str = "slope") -> Probe:
    lever = beam_modes(stiffness=16.4, frequency=161.8e3, quality_factor=287.0, tip_position=0.93)
    return Probe(lever, Drive(drive, 94e-9), detector=Detector(kind))


def changed(probe: Probe, frequency: float, quality_factor: float) -> Probe:
    """The same drive force on a lever whose first mode is another one: what the surface does."""
    modes = probe.cantilever.modes
    first = replace(modes[0], frequency=frequency, quality_factor=quality_factor)
    near = replace(probe, cantilever=replace(probe.cantilever, modes=(first, *modes[1:])))
    force = probe.drive.free_amplitude / abs(read_receptance(probe, probe.drive.frequency))
    amplitude = force * abs(read_receptance(near, probe.drive.frequency))
    return replace(near, drive=replace(probe.drive, free_amplitude=float(amplitude)))


# --- near the surface -----------------------------------------------------------------------------


@pytest.mark.parametrize(
    "probe", [single(), single(161.4e3), beam(), beam(kind="displacement"), beam(162.3e3)]
)
@pytest.mark.parametrize(("frequency", "quality_factor"), [(161.3e3, 210.0), (161.9e3, 300.0), (158e3, 40.0)])
def test_the_free_response_gives_resonance_and_q_exactly(
    probe: Probe, frequency: float, quality_factor: float
) -> None:
    near = changed(probe, frequency, quality_factor)
    found = lever_near_surface(probe, free_amplitude=near.drive.free_amplitude, phase=far_phase(near))
    assert found.frequency == pytest.approx(frequency, rel=1e-10, abs=0)
    assert found.quality_factor == pytest.approx(quality_factor, rel=1e-8, abs=0)
    # and the receptance of the probe returned is the measured one
    w = probe.drive.frequency
    np.testing.assert_allclose(read_receptance(found.probe, w), read_receptance(near, w), rtol=1e-9)
    assert found.probe.drive.free_amplitude == near.drive.free_amplitude
    assert found.probe.cantilever.modes[1:] == probe.cantilever.modes[1:]
    assert not found.covariance.any()


def test_at_resonance_the_closed_form_is_the_one_by_hand() -> None:
    # half the amplitude at the same phase is half the Q, nothing else
    found = lever_near_surface(single(), free_amplitude=47e-9, phase=np.pi / 2)
    assert found.quality_factor == pytest.approx(143.5, rel=1e-9, abs=0)
    assert found.frequency == pytest.approx(161.8e3, rel=1e-9, abs=0)
    # a lag above 90 degrees: driven above the resonance, which has gone down
    assert lever_near_surface(single(), free_amplitude=80e-9, phase=1.8).frequency < 161.8e3


def test_errors_of_the_response_are_carried() -> None:
    near = changed(beam(), 161.2e3, 220.0)
    A, phi = near.drive.free_amplitude, far_phase(near)
    stated = lever_near_surface(
        beam(), free_amplitude=A, phase=phi, amplitude_error=0.3e-9, phase_error=0.004
    )
    rng = np.random.default_rng(0)
    drawn = np.log([
        [one.frequency, one.quality_factor]
        for one in (
            lever_near_surface(beam(), free_amplitude=A + rng.normal(0, 0.3e-9), phase=phi + rng.normal(0, 0.004))
            for _ in range(800)
        )
    ])  # fmt: skip
    np.testing.assert_allclose(np.var(drawn, axis=0), np.diag(stated.covariance), rtol=0.15)  # 3 sigma of 800
    correlation = stated.covariance[0, 1] / np.sqrt(np.prod(np.diag(stated.covariance)))
    assert np.corrcoef(drawn.T)[0, 1] == pytest.approx(correlation, abs=0.1)
    assert stated.quality_factor_error == pytest.approx(220.0 * np.std(drawn[:, 1]), rel=0.1, abs=0)


def test_a_response_of_no_lever_is_refused() -> None:
    with pytest.raises(ProbeError, match="no lever answers"):
        lever_near_surface(single(), free_amplitude=90e-9, phase=-0.5)
    with pytest.raises(ProbeError):
        lever_near_surface(single(), free_amplitude=-90e-9, phase=1.5)
    with pytest.raises(ProbeError, match="unusable"):
        lever_near_surface(single(), free_amplitude=90e-9, phase=float("nan"))


# --- a ladder of frequencies ----------------------------------------------------------------------


def ladder(
    probe: Probe, seed: int | None = None, *, noise: float = 0.3e-9, points: int = 25
) -> dict[str, Any]:
    """Reading at constant drive over three linewidths to either side, with a phase offset of 0.7 rad."""
    first = probe.cantilever.modes[0]
    f = first.frequency * (1.0 + np.linspace(-3.0, 3.0, points) / first.quality_factor)
    a = 94e-9 / abs(read_receptance(probe, first.frequency)) * read_receptance(probe, f) * np.exp(-0.7j)
    if seed is not None:
        rng = np.random.default_rng(seed)
        a = a + rng.normal(0, noise, points) + 1j * rng.normal(0, noise, points)
    return {"frequency": f, "amplitude": np.abs(a), "phase": np.angle(a.conj())}


@pytest.mark.parametrize("probe", [single(), beam(), beam(kind="displacement")])
def test_a_ladder_without_noise_gives_everything_back(probe: Probe) -> None:
    start = changed(probe, 150e3, 100.0)  # the probe handed over is not the one measured
    found = resonance_from_ladder(**ladder(probe), probe=start)
    assert found.frequency == pytest.approx(161.8e3, rel=1e-9, abs=0)
    assert found.quality_factor == pytest.approx(287.0, rel=1e-6, abs=0)
    assert found.phase_offset == pytest.approx(0.7, rel=1e-6, abs=0)
    assert found.probe is not None
    G = abs(read_receptance(probe, np.array([161.8e3, probe.drive.frequency])))
    assert found.probe.drive.free_amplitude == pytest.approx(94e-9 * G[1] / G[0], rel=1e-6, abs=0)
    assert found.drive == pytest.approx(94e-9 / G[0] / 16.4, rel=1e-6, abs=0)


def test_a_single_mode_needs_no_probe_and_a_beam_taken_for_one_is_off() -> None:
    found = resonance_from_ladder(**ladder(single()))
    assert found.probe is None
    assert found.drive == pytest.approx(94e-9 / 287.0, rel=1e-6, abs=0)
    low_q = Probe(
        beam_modes(stiffness=0.1, frequency=20e3, quality_factor=3.0),
        Drive(20e3, 50e-9),
        detector=Detector("slope"),
    )
    points = ladder(low_q) | {}
    points["frequency"] = np.linspace(5e3, 40e3, 25)
    a = read_receptance(low_q, points["frequency"]) * 1e-9
    points |= {"amplitude": np.abs(a), "phase": -np.angle(a)}
    assert resonance_from_ladder(**points, probe=low_q).quality_factor == pytest.approx(3.0, rel=1e-6, abs=0)
    assert abs(resonance_from_ladder(**points).quality_factor / 3.0 - 1.0) > 0.01


@pytest.mark.parametrize("noise", [None, 0.3e-9])
def test_errors_of_a_ladder_cover(noise: float | None) -> None:
    probe = beam()
    drive = resonance_from_ladder(**ladder(probe), probe=probe).drive
    z, chi2 = [], []
    for seed in range(300):
        found = resonance_from_ladder(**ladder(probe, seed), probe=probe, noise=noise)
        logs = [
            np.log(found.frequency / 161.8e3),
            np.log(found.quality_factor / 287.0),
            np.log(found.drive / drive),
        ]
        z.append([*logs, found.phase_offset - 0.7] / np.sqrt(np.diag(found.covariance)))
        chi2.append(found.chi2_per_dof)
        assert found.noise == pytest.approx(0.3e-9, rel=0.5, abs=0)
    covered = (np.abs(z) < 1.645).mean(axis=0)
    assert ((covered > 0.85) & (covered < 0.95)).all(), covered
    assert (np.abs(np.mean(z, axis=0)) < 0.2).all()
    assert chi2[0] is None if noise is None else np.mean(chi2) == pytest.approx(1.0, abs=0.05)
    shape = found.covariance / np.sqrt(np.outer(*2 * [np.diag(found.covariance)]))
    np.testing.assert_allclose(np.corrcoef(np.transpose(z)), shape, atol=0.2)


def test_ladders_that_show_no_resonance_are_refused() -> None:
    good = ladder(single(), 1)
    with pytest.raises(ObservablesError, match="cannot be fitted"):
        resonance_from_ladder(**{name: values[:3] for name, values in good.items()})
    with pytest.raises(ObservablesError, match="NaN"):
        resonance_from_ladder(**(good | {"phase": np.where(np.arange(25) == 3, np.nan, good["phase"])}))
    with pytest.raises(ObservablesError, match="no list"):
        resonance_from_ladder(good["frequency"], good["amplitude"][:5], good["phase"])
    rng = np.random.default_rng(3)
    with pytest.raises(ObservablesError, match="no resonance"):
        resonance_from_ladder(good["frequency"], rng.rayleigh(1e-9, 25), rng.uniform(0, 6, 25))
    with pytest.raises(ObservablesError, match="noise"):
        resonance_from_ladder(**good, noise=-1.0)


def test_a_record_of_one_mode_is_the_same_by_hand() -> None:
    lever = Cantilever.single_mode(16.4, 161.8e3, 287.0)
    f = np.array([161e3, 161.5e3, 161.8e3, 162.3e3])
    x = f / 161.8e3
    by_hand = 1.0 / (1 - x**2 + 1j * x / 287.0) / 16.4
    np.testing.assert_allclose(read_receptance(Probe(lever, Drive(161e3, 1e-9)), f), by_hand, rtol=1e-12)
    found = resonance_from_ladder(f, np.abs(by_hand), -np.angle(by_hand))
    assert found.drive == pytest.approx(1 / 16.4, rel=1e-9, abs=0)
