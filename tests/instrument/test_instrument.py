"""What an instrument adds to the signals, one number at a time, against arithmetic that does not use it."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import xarray as xr

from overtone.errors import OvertoneError
from overtone.harmonics import far_phase
from overtone.instrument.instrument import (
    Instrument,
    NearSurface,
    flicker_noise,
    free_response,
    lever_at,
    noise_of,
    readings,
)
from overtone.instrument.photodiode import SplitDiode
from overtone.probe import BASE, SLOPE, Cantilever, Detector, Drive, Mode, Probe

PROBE = Probe.simple(
    stiffness=16.4,
    frequency=161.8e3,
    quality_factor=287.0,
    radius=10e-9,
    drive_frequency=161.8e3,
    free_amplitude=94e-9,
)
QUIET = Instrument(detector_noise=0.0, temperature=1e-30)


def motion(shape: tuple[int, ...] = (), **values: Any) -> xr.Dataset:
    given = {"A0": 0.0, "A1": 40e-9, "phi1": 0.7, "A2": 0.0, "phi2": 0.0, "A3": 0.0, "phi3": 0.0} | values
    dims = tuple(f"dim{k}" for k in range(len(shape)))
    return xr.Dataset({name: (dims, np.full(shape, value)) for name, value in given.items()})


def phasor(read: xr.Dataset, n: int) -> complex:
    return complex(read[f"A{n}"].values * np.exp(-1j * read[f"phi{n}"].values))


# --- the lever ------------------------------------------------------------------------------------


def test_ten_hertz_of_drift_turn_the_free_phase_by_two_degrees() -> None:
    """atan(2 Q df/f): 2 Q df/f = 574 * 10 / 161.8e3."""
    later = lever_at(PROBE, replace(QUIET, frequency_drift=0.5), time=20.0)
    turned = math.degrees(far_phase(PROBE) - far_phase(later))
    assert turned == pytest.approx(math.degrees(math.atan(574.0 * 10.0 / 161.8e3)), rel=1e-3, abs=0)
    assert turned == pytest.approx(2.03, abs=0.01)


def test_the_force_of_the_drive_stays_the_same() -> None:
    """A = F/(k |1 - x^2 + i x/Q|), written out for the lever near the surface and later."""
    instrument = replace(
        QUIET, near_surface=NearSurface(0.05, 2e-4, 3e-6), frequency_drift=0.3, quality_drift=1e-4
    )
    there = lever_at(PROBE, instrument, height=1e-6, time=30.0)
    share = math.exp(-1.0 / 3.0)
    frequency = 161.8e3 * (1.0 - 2e-4 * share) + 9.0
    quality = 287.0 * (1.0 - 0.05 * share) * 1.003
    x = 161.8e3 / frequency
    force = 94e-9 * 16.4 / 287.0
    expected = force / (16.4 * abs(1.0 - x**2 + 1j * x / quality))
    assert there.drive.free_amplitude == pytest.approx(expected, rel=1e-12, abs=0)
    assert there.cantilever.modes[0].quality_factor == pytest.approx(quality, rel=1e-14, abs=0)
    assert there.tip == PROBE.tip


def test_the_motion_of_a_driven_base_stays_the_same() -> None:
    """Of two modes read as slope: A = y |sum s G x^2/(1 - x^2 + i x/Q)|, y the motion of the base."""
    modes = (Mode(16.4, 161.8e3, 120.0, 1.0, 1.5), Mode(644.0, 1014e3, 300.0, 3.4, -0.9))
    probe = Probe(Cantilever(modes), Drive(161.8e3, 94e-9, BASE), detector=Detector(SLOPE))

    def reading(first: float) -> float:
        total = 0j
        for f, q, s, gamma in ((first, 120.0, 1.0, 1.5), (1014e3, 300.0, 3.4, -0.9)):
            x = 161.8e3 / f
            total += s * gamma * x**2 / (1.0 - x**2 + 1j * x / q)
        return abs(total)

    softer = lever_at(probe, replace(QUIET, near_surface=NearSurface(softening=0.01)), height=0.0)
    expected = 94e-9 * reading(161.8e3 * 0.99) / reading(161.8e3)
    assert softer.drive.free_amplitude == pytest.approx(expected, rel=1e-12, abs=0)
    assert abs(complex(free_response(probe, 161.8e3))) == pytest.approx(reading(161.8e3), rel=1e-12, abs=0)


def test_far_away_and_at_once_the_lever_is_its_own() -> None:
    instrument = replace(QUIET, near_surface=NearSurface(0.3, 1e-3), frequency_drift=1.0, drive_drift=1e-3)
    assert lever_at(PROBE, instrument) == PROBE


def test_a_drive_that_fades_takes_the_amplitude_with_it() -> None:
    later = lever_at(PROBE, replace(QUIET, drive_drift=-1e-3), time=50.0)
    assert later.drive.free_amplitude == pytest.approx(0.95 * 94e-9, rel=1e-12, abs=0)
    assert far_phase(later) == far_phase(PROBE)


# --- detector -------------------------------------------------------------------------------------


def test_a_first_harmonic_alone_makes_the_powers_of_itself() -> None:
    """kappa_2 a1^2, kappa_3 a1^3, kappa_2 |a1|^2, and the loss 3 kappa_3 |a1|^2; lengths are calibrated at A1far."""
    kappa2, kappa3 = 2e4, -1.5e11
    read = readings(motion(), replace(QUIET, distortion={2: kappa2, 3: kappa3}), PROBE)
    a1 = 40e-9 * np.exp(-0.7j)
    scale = 1.0 + 3.0 * kappa3 * 94e-9**2
    assert scale < 0.998
    assert phasor(read, 2) == pytest.approx(kappa2 * a1**2 / scale, rel=1e-9, abs=0)
    assert phasor(read, 3) == pytest.approx(kappa3 * a1**3 / scale, rel=1e-9, abs=0)
    assert float(read["A0"]) == pytest.approx(kappa2 * 40e-9**2 / scale, rel=1e-9, abs=0)
    assert phasor(read, 1) == pytest.approx(a1 * (1.0 + 3.0 * kappa3 * 40e-9**2) / scale, rel=1e-12, abs=0)


def test_the_free_amplitude_is_read_as_it_is() -> None:
    free = motion(A1=94e-9)
    for detector in ({"distortion": {2: 2e4, 3: -1.5e11}}, {"diode": SplitDiode(1e-6, offset=60e-9)}):
        read = readings(free, replace(QUIET, **detector), PROBE)
        assert float(read["A1"]) == pytest.approx(94e-9, rel=1e-9, abs=0)


def test_a_wide_diode_bends_as_its_taylor_series_says() -> None:
    """Centred Gaussian spot: erf(u) = (2/sqrt(pi)) (u - u^3/3), u = sqrt(2) s/half, so kappa_3 = -1/(6 half^2)."""
    half = 1.5e-6
    diode = replace(QUIET, diode=SplitDiode(2.0 * half, "gaussian"))
    polynomial = replace(QUIET, distortion={3: -1.0 / (6.0 * half**2)})
    there, here = (readings(motion(A0=1e-9), instrument, PROBE) for instrument in (diode, polynomial))
    assert phasor(there, 3) == pytest.approx(phasor(here, 3), rel=2e-3, abs=0)
    assert phasor(there, 2) == pytest.approx(phasor(here, 2), rel=2e-3, abs=0)
    lost = [float(read["A1"]) / 40e-9 - 1.0 for read in (there, here)]
    assert lost[0] == pytest.approx(lost[1], rel=5e-3, abs=0)


def test_a_spot_that_has_moved_distorts_otherwise() -> None:
    """(s + m)^3 holds 3 m s^2: a2 gains 6 kappa_3 m a1^2, and A0 the shift itself."""
    kappa3, moved = -1.5e11, 3e-9
    instrument = replace(QUIET, distortion={3: kappa3})
    read = readings(motion(), instrument, PROBE, shift=moved)
    a1 = 40e-9 * np.exp(-0.7j)
    scale = 1.0 + 3.0 * kappa3 * 94e-9**2
    assert phasor(read, 2) == pytest.approx(6.0 * kappa3 * moved * a1**2 / scale, rel=1e-9, abs=0)
    # 4 k (m^3 + 3 m a^2/2)
    expected = (moved + 4.0 * kappa3 * (moved**3 + 1.5 * moved * 40e-9**2)) / scale
    assert float(read["A0"]) == pytest.approx(expected, rel=1e-9, abs=0)


def test_without_a_detector_of_its_own_the_shift_is_read_as_deflection() -> None:
    shift = np.array([[1e-9, -2e-9]])
    read = readings(motion((1, 2), A0=5e-11), QUIET, PROBE, shift=shift)
    np.testing.assert_allclose(read["A0"].values, shift + 5e-11, rtol=1e-12)
    np.testing.assert_allclose(read["A1"].values, 40e-9, rtol=1e-12)


# --- electronics ----------------------------------------------------------------------------------


def test_electronics_weaken_delay_and_leak() -> None:
    instrument = replace(
        QUIET,
        mean_offset=7e-11,
        gains={0: 1.1, 2: 0.9},
        latency={2: 0.4, 3: -0.2},
        crosstalk={2: 3e-11j, 3: 1e-11},
        drive_distortion={2: 2e-12},
    )
    a2, a3 = 1e-10 * np.exp(-2.0j), 4e-11 * np.exp(-1.0j)
    given = motion(A0=2e-10, A2=abs(a2), phi2=2.0, A3=abs(a3), phi3=1.0)
    for drive in (1.0, 0.6):
        read = readings(given, instrument, PROBE, drive=drive)
        leak = 3e-11j * drive + 2e-12 * drive**2
        assert phasor(read, 2) == pytest.approx(0.9 * a2 * np.exp(-0.4j) + leak, rel=1e-12, abs=0)
        assert phasor(read, 3) == pytest.approx(a3 * np.exp(0.2j) + 1e-11 * drive, rel=1e-12, abs=0)
        assert float(read["A0"]) == pytest.approx(1.1 * 2e-10 + 7e-11, rel=1e-12, abs=0)
        assert phasor(read, 1) == pytest.approx(40e-9 * np.exp(-0.7j), rel=1e-12, abs=0)


def test_a_wrong_zero_of_the_phase_turns_each_harmonic_by_as_many_times() -> None:
    given = motion(A2=1e-10, phi2=2.0, A3=4e-11, phi3=1.0)
    read = readings(given, replace(QUIET, phase_offset=0.05), PROBE)
    for n, phase in ((1, 0.7), (2, 2.0), (3, 1.0)):
        assert float(read[f"phi{n}"]) == pytest.approx(phase + 0.05 * n, rel=1e-12, abs=0)


# --- noise ----------------------------------------------------------------------------------------


def test_noise_is_that_of_the_theory() -> None:
    """1.85, 530 and 0.62 fm/rtHz of the lever beside 30 fm/rtHz of the detector, in 1 kHz."""
    sigma = noise_of(Instrument(temperature=297.0), PROBE)
    for name, thermal, width in (("A0", 1.85, 1.0), ("A1", 530.0, 2.0), ("A2", 0.62, 2.0)):
        expected = 1e-15 * math.hypot(thermal, 30.0) * math.sqrt(width * 1e3)
        assert sigma[name] == pytest.approx(expected, rel=5e-3, abs=0)


def test_readings_scatter_by_the_noise() -> None:
    read = readings(motion((400, 400), A2=1e-10), Instrument(), PROBE, generator=np.random.default_rng(5))
    sigma = noise_of(Instrument(), PROBE)
    assert float(read["A0"].std()) == pytest.approx(sigma["A0"], rel=0.01, abs=0)
    for n in (1, 2, 3):
        a = read[f"A{n}"].values * np.exp(-1j * read[f"phi{n}"].values)
        assert a.real.std() == pytest.approx(sigma[f"A{n}"], rel=0.01, abs=0)
        assert a.imag.std() == pytest.approx(sigma[f"A{n}"], rel=0.01, abs=0)


def test_flicker_has_its_density_at_one_hertz_and_falls_as_one_over_f() -> None:
    interval, count = 4e-3, 2**14
    instrument = Instrument(flicker=20e-12)
    frequency = np.fft.rfftfreq(count, interval)
    power = np.zeros(frequency.size)
    for seed in range(40):
        series = flicker_noise(instrument, count, interval, np.random.default_rng(seed))
        power += 2.0 * interval / count * np.abs(np.fft.rfft(series)) ** 2 / 40
    near = (frequency > 0.7) & (frequency < 1.4)
    assert np.mean(power[near] * frequency[near]) == pytest.approx((20e-12) ** 2, rel=0.1, abs=0)
    wide = (frequency > 0.05) & (frequency < 100.0)
    slope = np.polyfit(np.log(frequency[wide]), np.log(power[wide]), 1)[0]
    assert slope == pytest.approx(-1.0, abs=0.02)
    assert not flicker_noise(Instrument(), count, interval, np.random.default_rng(0)).any()


# --- what is refused ------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("wrong", "named"),
    [
        ({"bandwidth": 0.0, "line_time": -1.0}, "bandwidth = 0.0; line_time = -1.0"),
        ({"flicker": -1e-12}, "flicker"),
        ({"detector_noise": math.nan}, "detector_noise"),
        ({"gains": {2: 0.0}}, "gain of harmonic 2"),
        ({"crosstalk": {4: 1e-12}}, "harmonics of an instrument are 2 and 3"),
        ({"diode": SplitDiode(1e-6), "distortion": {2: 1.0}}, "not both"),
    ],
)
def test_impossible_instruments_are_refused(wrong: dict[str, Any], named: str) -> None:
    with pytest.raises(OvertoneError, match=named):
        Instrument(**wrong)
