"""Thermal noise against the numbers of the theory, equipartition, and fluctuation-dissipation."""

import numpy as np
import pytest

from overtone.beam import beam_modes
from overtone.errors import ProbeError
from overtone.harmonics import tip_receptance
from overtone.instrument.thermal_noise import BOLTZMANN, thermal_noise_density
from overtone.probe import SLOPE, Cantilever, Detector, Drive, Mode, Probe

TEMPERATURE = 297.0
STIFF = Cantilever.single_mode(16.4, 162e3, 287)
BEAM = beam_modes(stiffness=16.4, frequency=162e3, quality_factor=287, tip_position=0.95)


def test_the_stiff_lever_has_the_noise_of_the_theory() -> None:
    """1.85, 530 and 0.62 fm/sqrt(Hz) at rest, at resonance and at twice it, to the digits given there."""
    at_rest, resonant, twice = 1e15 * thermal_noise_density(STIFF, [0.0, 162e3, 324e3], TEMPERATURE)
    assert (f"{at_rest:.2f}", f"{resonant / 10:.0f}", f"{twice:.2f}") == ("1.85", "53", "0.62")


def test_the_mean_square_is_that_of_equipartition() -> None:
    """int S df = kB T / k for each mode."""
    frequency = np.concatenate([np.linspace(0.0, 3e5, 2_000_001), np.linspace(3e5, 3e7, 500_001)[1:]])
    mean_square = np.trapezoid(thermal_noise_density(STIFF, frequency, TEMPERATURE) ** 2, frequency)
    assert mean_square == pytest.approx(BOLTZMANN * TEMPERATURE / 16.4, rel=1e-4, abs=0)


def dissipative(lever: Cantilever, frequency: np.ndarray) -> np.ndarray:
    """sqrt(4 kB T / w Im(-G)): what any passive lever must have by its losses."""
    loss = -np.imag(tip_receptance(lever, frequency))
    return np.asarray(np.sqrt(4 * BOLTZMANN * TEMPERATURE * loss / (2 * np.pi * frequency)))


@pytest.mark.parametrize("lever", [STIFF, BEAM], ids=["one mode", "three modes"])
def test_the_tip_moves_as_its_losses_demand(lever: Cantilever) -> None:
    frequency = np.array([1e3, 1e5, 162e3, 324e3, 1.01e6, 3e6])
    density = thermal_noise_density(lever, frequency, TEMPERATURE)
    assert density == pytest.approx(dissipative(lever, frequency), rel=1e-12, abs=0)


def test_an_optical_lever_reads_each_mode_by_the_square_of_its_slope() -> None:
    """Slope under a moment is a collocated pair as well: its receptance weighs a mode by (s_j/s_1)^2."""
    probe = Probe(BEAM, Drive(162e3, 94e-9), detector=Detector(SLOPE))
    collocated = Cantilever(
        tuple(Mode(m.stiffness / m.slope_ratio**2, m.frequency, m.quality_factor) for m in BEAM.modes)
    )
    frequency = np.array([1e3, 162e3, 324e3, BEAM.modes[1].frequency])
    read = thermal_noise_density(probe, frequency, TEMPERATURE)
    assert read == pytest.approx(dissipative(collocated, frequency), rel=1e-12, abs=0)
    assert read[-1] > 3 * thermal_noise_density(BEAM, frequency, TEMPERATURE)[-1]
    displacement = Probe(BEAM, Drive(162e3, 94e-9))
    assert np.array_equal(
        thermal_noise_density(displacement, frequency, TEMPERATURE),
        thermal_noise_density(BEAM, frequency, TEMPERATURE),
    )


def test_noise_grows_as_the_root_of_temperature() -> None:
    cold, warm = (thermal_noise_density(STIFF, 1e5, temperature) for temperature in (100.0, 400.0))
    assert warm / cold == pytest.approx(2.0, rel=1e-12, abs=0)


def test_impossible_temperatures_and_frequencies_are_refused() -> None:
    for temperature in (0.0, -20.0, float("nan")):
        with pytest.raises(ProbeError, match="temperature"):
            thermal_noise_density(STIFF, 1e5, temperature)
    for frequency in (-1.0, float("nan")):
        with pytest.raises(ProbeError, match="frequency"):
            thermal_noise_density(STIFF, [1e5, frequency], 295.0)
