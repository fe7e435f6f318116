"""Removal of what an instrument adds, against a forward model of its own: a polynomial on a sampled waveform."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from overtone.instrument.signals import Signals
from overtone.instrument.unknowns import (
    LEVER,
    NAMES,
    NEUTRAL,
    UNKNOWNS,
    crosstalk_of,
    distortion_basis,
    distortion_of,
    probe_with,
    undo,
    wrapped,
)
from overtone.probe import Cantilever, Detector, Drive, Mode, Probe, Tip

A_REF = 94e-9
FIRST = np.array([40e-9 * np.exp(-0.6j), 75e-9 * np.exp(-1.2j)])
ELECTRONICS = dict(NEUTRAL) | {
    "A0_offset": 2e-10,
    "gain0": 1.1,
    "phi1_offset": 0.3,
    "gain2": 0.9,
    "latency2": 0.5,
    "crosstalk2_re": 2e-11,
    "crosstalk2_im": -1e-11,
    "gain3": 1.2,
    "latency3": -0.7,
    "crosstalk3_re": 5e-12,
    "crosstalk3_im": 3e-12,
}

Motion = tuple[Any, dict[int, Any]]


def behind_the_detector(mean: Any, phasor: dict[int, Any], c2: float, chi: float) -> Motion:
    """Return harmonics of ``s + c2 s^2 + c3 s^3``, scaled so that a first harmonic of A_ref is read as such."""
    c3 = -4.0 * chi / (3.0 * A_REF**2)
    theta = 2.0 * np.pi * np.arange(48) / 48
    s = np.asarray(mean)[..., None] + 0.0 * theta
    for n, a in phasor.items():
        s = s + np.abs(a)[..., None] * np.cos(n * theta + np.angle(a)[..., None])
    s = s + c2 * s**2 + c3 * s**3
    s = s / (1.0 - chi)
    return s.mean(-1), {n: 2.0 * (s * np.exp(-1j * n * theta)).mean(-1) for n in phasor}


def as_read(motion: Motion, electronics: dict[str, float]) -> Signals:
    """Return what the electronics make of it."""
    mean, phasor = motion
    read = {}
    for n, a in phasor.items():
        read[n] = a * np.exp(-1j * n * electronics["phi1_offset"])
        if n > 1:
            read[n] = read[n] * electronics[f"gain{n}"] * np.exp(-1j * electronics[f"latency{n}"])
            read[n] = read[n] + electronics[f"crosstalk{n}_re"] + 1j * electronics[f"crosstalk{n}_im"]
    return Signals(mean * electronics["gain0"] + electronics["A0_offset"], read)


def measured_far_away(c2: float, chi: float, electronics: dict[str, float]) -> dict[str, float]:
    """Return the unknowns, distortions as a first harmonic alone shows them at several amplitudes."""
    first = np.array([0.35, 0.7, 1.0]) * A_REF * np.exp(-0.4j)
    none = np.zeros(3)
    read = as_read(behind_the_detector(none, {1: first, 2: 0j * none, 3: 0j * none}, c2, chi), electronics)
    values = electronics | {"compression": chi}
    a1 = read.phasor[1] / A_REF
    u = np.abs(a1) ** 2
    bowed, _, _, _ = np.linalg.lstsq(
        np.stack([u, u**2], -1), read.mean - electronics["A0_offset"], rcond=None
    )
    values |= {f"distortion0_{j}": float(bowed[j]) for j in range(2)}
    for n in (2, 3):
        alone = read.phasor[n] - complex(electronics[f"crosstalk{n}_re"], electronics[f"crosstalk{n}_im"])
        k = np.linalg.solve(np.stack([a1**n * u**j for j in range(3)], -1), alone)
        values |= {f"distortion{n}_{j}_re": float(k[j].real) for j in range(3)}
        values |= {f"distortion{n}_{j}_im": float(k[j].imag) for j in range(3)}
    return values


def left(mean: Any, a2: Any, a3: Any, c2: float, chi: float, electronics: dict[str, float]) -> dict[int, Any]:
    """Return what of the true signals is not recovered, harmonic by harmonic [m]."""
    true = {1: FIRST, 2: a2 + 0j * FIRST, 3: a3 + 0j * FIRST}
    read = as_read(behind_the_detector(mean + 0.0 * FIRST.real, true, c2, chi), electronics)
    clean = undo(read, measured_far_away(c2, chi, electronics), A_REF)
    return {0: clean.mean - mean} | {n: clean.phasor[n] - true[n] for n in true}


A2, A3 = 80e-12 * np.exp(-4.0j), 40e-12 * np.exp(1.0j)
MEAN = 40e-12
SIZES = {0: MEAN, 1: 75e-9, 2: 80e-12, 3: 40e-12}
CHI, BEND = 0.02, 0.3e-9  # of an ordinary photodiode, and c2 A_ref^2/2 [m]
C2 = 2.0 * BEND / A_REF**2


def test_nothing_added_is_nothing_removed() -> None:
    given = Signals(np.full(2, MEAN), {1: FIRST, 2: FIRST * 1e-3, 3: FIRST * 1e-4, 5: FIRST * 1e-5})
    clean = undo(given, NEUTRAL, A_REF)
    np.testing.assert_array_equal(clean.mean, given.mean)
    for n, a in given.phasor.items():
        np.testing.assert_allclose(clean.phasor[n], a, rtol=1e-14)


def test_linear_electronics_are_removed_exactly() -> None:
    for n, size in left(MEAN, A2, A3, 0.0, 0.0, ELECTRONICS).items():
        assert np.abs(size).max() < 1e-11 * SIZES[n] + 1e-24


def test_what_is_left_of_a_bent_detector_falls_as_the_square_of_its_bend() -> None:
    """From 2 % of compression down: without the terms to first order it would fall by 2 at each step, not by 4."""
    before = None
    for k in range(4):
        share = 0.5**k
        now = left(MEAN, A2, A3, C2 * share, CHI * share, ELECTRONICS)
        worst = {n: float(np.abs(size).max()) / SIZES[n] for n, size in now.items()}
        assert max(worst.values()) < 8.0 * (CHI * share) ** 2
        if before is not None:
            for n in worst:
                assert before[n] / worst[n] > 3.2, n
        before = worst


def test_a_spot_that_has_moved_is_followed_whatever_the_gain_of_the_mean() -> None:
    """Virtual deflection of 5 nm puts 2 chi A0 u into a2, more than a2 itself: the spot counts, not what is read."""
    moved = 5e-9
    term = 2.0 * CHI * moved * np.abs(FIRST / A_REF) ** 2
    for gain in (1.0, 1.1, 1.3):
        rest = left(moved, A2, A3, 0.0, CHI, ELECTRONICS | {"gain0": gain})
        assert (np.abs(rest[2]) < 0.03 * term).all()
    assert term.min() > 30e-12


# --- each term that mixes harmonics, by itself ----------------------------------------------------

U = np.abs(FIRST / A_REF) ** 2
TERMS = {
    "a1 is weakened": ({"chi": CHI}, 1, -CHI * U * FIRST),
    "A0 is weakened": ({"mean": 1e-10, "chi": CHI}, 0, -2.0 * CHI * U * 1e-10),
    "A0 takes a2": ({"a2": A2, "chi": CHI}, 0, -CHI * (FIRST**2 * np.conj(A2)).real / A_REF**2),
    "a2 is weakened": ({"a2": A2, "chi": CHI}, 2, -2.0 * CHI * U * A2),
    "a2 takes A0": ({"mean": 1e-10, "chi": CHI}, 2, -2.0 * CHI * 1e-10 * FIRST**2 / A_REF**2),
    "a2 takes a3": ({"a3": A3, "c2": C2}, 2, C2 * A3 * np.conj(FIRST)),
    "a3 is weakened": ({"a3": A3, "chi": CHI}, 3, -2.0 * CHI * U * A3),
    "a3 takes a2": ({"a2": A2, "c2": C2}, 3, C2 * FIRST * A2),
}


@pytest.mark.parametrize("name", list(TERMS))
def test_each_term_is_what_a_detector_makes_and_is_taken_out(name: str) -> None:
    chosen, n, expected = TERMS[name]
    given = {"mean": 0.0, "a2": 0.0, "a3": 0.0, "c2": 0.0, "chi": 0.0} | chosen
    bend = given["c2"], given["chi"]
    true = {0: given["mean"], 1: FIRST, 2: given["a2"] + 0j * FIRST, 3: given["a3"] + 0j * FIRST}
    mean, phasor = behind_the_detector(true[0] + 0.0 * FIRST.real, {k: true[k] for k in (1, 2, 3)}, *bend)
    none = {1: FIRST, 2: 0j * FIRST, 3: 0j * FIRST}
    alone_mean, alone = behind_the_detector(0.0 * FIRST.real, none, *bend)
    made = {0: mean - alone_mean, 1: phasor[1]} | {k: phasor[k] - alone[k] for k in (2, 3)}
    # lengths are calibrated at A_ref: that much is put back everywhere
    made = {k: made[k] * (1.0 - given["chi"]) for k in made}
    np.testing.assert_allclose(made[n] - true[n], expected, rtol=0.02)
    electronics = ELECTRONICS | {"gain0": 1.0}
    rest = left(given["mean"], given["a2"], given["a3"], *bend, electronics)[n]
    assert (np.abs(rest) < 0.06 * np.abs(expected)).all()


# --- slopes ---------------------------------------------------------------------------------------


def test_slopes_are_as_read_at_the_free_amplitude_and_weaker_in_contact_as_the_detector_makes_them() -> None:
    height, x, y = np.array([60e-9, -40e-9]), np.array([1e-6, 2e-6]), np.array([-3e-6, 1e-6])
    true = 0.01 * height + 2e-3 * x - 1e-3 * y
    electronics = ELECTRONICS
    free = {1: np.full(2, A_REF + 0j), 2: np.zeros(2, complex), 3: np.zeros(2, complex)}
    at_the_reference = as_read(behind_the_detector(true, free, 0.0, CHI), electronics)
    nothing = as_read(behind_the_detector(0.0 * true, free, 0.0, CHI), electronics)
    share = float(((at_the_reference.mean - nothing.mean) / true)[0])
    assert share == pytest.approx(1.1 * (1.0 - 2.0 * CHI) / (1.0 - CHI), rel=2e-4, abs=0)
    slopes = {"A0_slope_z": 0.01 * share, "A0_slope_x": 2e-3 * share, "A0_slope_y": -1e-3 * share}
    values = measured_far_away(0.0, CHI, electronics) | slopes
    read = as_read(
        behind_the_detector(MEAN + true, {1: FIRST, 2: 0j * FIRST, 3: 0j * FIRST}, 0.0, CHI), electronics
    )
    clean = undo(read, values, A_REF, height=height, x=x, y=y)
    assert np.abs(true).min() > 1e-9
    np.testing.assert_allclose(clean.mean, MEAN, atol=3.0 * CHI**2 * np.abs(true).max())
    assert (np.abs(clean.phasor[2]) < 0.05 * 2.0 * CHI * np.abs(true) * U).all()


# --- pieces ---------------------------------------------------------------------------------------


def test_signals_that_were_not_measured_stay_away() -> None:
    values = measured_far_away(C2, CHI, ELECTRONICS)
    clean = undo(Signals(None, {1: FIRST, 3: FIRST * 1e-3}), values, A_REF)
    assert clean.mean is None
    assert sorted(clean.phasor) == [1, 3]


def test_higher_harmonics_are_only_turned() -> None:
    clean = undo(Signals(None, {1: FIRST, 4: FIRST * 1e-3}), dict(NEUTRAL) | {"phi1_offset": 0.2}, A_REF)
    np.testing.assert_allclose(clean.phasor[4], FIRST * 1e-3 * np.exp(0.8j), rtol=1e-13)
    np.testing.assert_allclose(clean.phasor[1], FIRST * np.exp(0.2j), rtol=1e-13)


def test_a_lost_pixel_does_not_spread() -> None:
    a2 = np.array([A2, np.nan])
    clean = undo(Signals(np.full(2, MEAN), {1: FIRST, 2: a2, 3: FIRST * 1e-3}), ELECTRONICS, A_REF)
    assert np.isfinite([clean.mean[0], clean.phasor[2][0], clean.phasor[3][0]]).all()
    assert np.isfinite(clean.phasor[1]).all()


def test_bases_are_powers_of_the_first_harmonic() -> None:
    a = FIRST[0] / A_REF
    np.testing.assert_allclose(distortion_basis(FIRST[0], 0, A_REF), [abs(a) ** 2, abs(a) ** 4], rtol=1e-13)
    for n in (2, 3):
        expected = [a**n, a**n * abs(a) ** 2, a**n * abs(a) ** 4]
        np.testing.assert_allclose(distortion_basis(FIRST[0], n, A_REF), expected, rtol=1e-13)
    values = {name: float(k) for k, name in enumerate(NAMES)}
    for n in (0, 2, 3):
        for j, c in enumerate(distortion_of(values, n)):
            names = [f"distortion0_{j}"] if n == 0 else [f"distortion{n}_{j}_re", f"distortion{n}_{j}_im"]
            assert c == complex(*(values[name] for name in names))
    assert crosstalk_of(values, 3) == complex(values["crosstalk3_re"], values["crosstalk3_im"])


def test_every_unknown_has_one_name_a_unit_and_a_meaning() -> None:
    assert len(set(NAMES)) == len(NAMES)
    assert set(LEVER) < set(NAMES)
    for unknown in UNKNOWNS:
        assert unknown.unit in ("m", "rad", "1")
        assert unknown.meaning
        assert unknown.neutral == (1.0 if unknown.name.startswith("gain") or unknown.name in LEVER else 0.0)


def test_factors_of_the_lever_change_what_they_name() -> None:
    modes = (Mode(16.4, 161.8e3, 287.0), Mode(640.0, 1.01e6, 600.0, 3.47))
    probe = Probe(Cantilever(modes, 15.9, 1.0897), Drive(161.8e3, 94e-9), Tip(10e-9), Detector("slope"))
    assert probe_with(probe, NEUTRAL) == probe
    factors = {
        "stiffness": 1.1,
        "quality_factor": 0.9,
        "resonance": 0.999,
        "free_amplitude": 0.98,
        "radius": 1.3,
    }
    assert set(factors) == set(LEVER)
    changed = probe_with(probe, dict(NEUTRAL) | factors)
    assert [mode.stiffness for mode in changed.cantilever.modes] == pytest.approx(
        [1.1 * 16.4, 1.1 * 640.0], rel=1e-14, abs=0
    )
    assert changed.cantilever.static_stiffness == pytest.approx(1.1 * 15.9, rel=1e-14, abs=0)
    assert [mode.quality_factor for mode in changed.cantilever.modes] == pytest.approx(
        [0.9 * 287.0, 600.0], rel=1e-14, abs=0
    )
    assert [mode.frequency for mode in changed.cantilever.modes] == pytest.approx(
        [0.999 * 161.8e3, 1.01e6], rel=1e-14, abs=0
    )
    assert changed.drive.frequency == 161.8e3
    assert changed.drive.free_amplitude == pytest.approx(0.98 * 94e-9, rel=1e-14, abs=0)
    assert changed.tip.radius == pytest.approx(13e-9, rel=1e-14, abs=0)
    assert changed.cantilever.static_slope_ratio == 1.0897
    assert changed.detector == probe.detector
    blunt = replace(probe, tip=Tip(None), cantilever=Cantilever(modes))
    assert probe_with(blunt, dict(NEUTRAL) | factors).tip.radius is None


def test_angles_are_wrapped() -> None:
    angles = np.array([0.1, 2.0 * math.pi + 0.1, -2.0 * math.pi + 0.1, 3.5, -3.5])
    expected = [0.1, 0.1, 0.1, 3.5 - 2.0 * math.pi, 2.0 * math.pi - 3.5]
    np.testing.assert_allclose(wrapped(angles), expected, rtol=1e-12)
