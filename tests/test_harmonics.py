import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import xarray as xr
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import brentq

from overtone.errors import ObservablesError
from overtone.harmonics import (
    ATTRACTIVE,
    REPULSIVE,
    UNDETERMINED,
    energy,
    far_phase,
    read_receptance,
    regime,
    tip_receptance,
    to_force_harmonics,
    to_observables,
)
from overtone.probe import Cantilever, Detector, Drive, Mode, Probe


def simple(r: float = 1.0, Q: float = 287.0) -> Probe:
    return Probe.simple(
        stiffness=16.4, frequency=161.8e3, quality_factor=Q, drive_frequency=r * 161.8e3, free_amplitude=94e-9
    )


def observables(**values: float) -> xr.Dataset:
    return xr.Dataset({name: ("point", [value]) for name, value in values.items()})


EXAMPLE = {"A0": 1.3e-10, "A1": 39e-9, "phi1": 0.6, "A2": 1.1e-10, "phi2": 4.2, "A3": 4e-11, "phi3": 1.7}


def paper_eq5(
    k: float, r: float, Q: float, far: float, o: dict[str, float]
) -> tuple[list[float], list[float]]:
    """Return eqs 5a-g as they are printed: no complex numbers, no receptance."""
    G = 1.0 / (k * math.hypot(1 - r**2, r / Q))
    F_dr = far / G
    cons = [k * o["A0"], -F_dr * math.cos(o["phi1"]) + k * o["A1"] * (1 - r**2)]
    diss = [0.0, F_dr * math.sin(o["phi1"]) - k * o["A1"] * r / Q]
    for n in (2, 3):
        x, A = n * o["phi1"] - o[f"phi{n}"], o[f"A{n}"]
        a, b = 1 - n**2 * r**2, n * r / Q
        cons.append(k * A * (math.cos(x) * a - b * math.sin(x)))
        diss.append(k * A * (-math.sin(x) * a - b * math.cos(x)))
    return cons, diss


@pytest.mark.parametrize("r", [1.0, 0.98, 1.013])
@pytest.mark.parametrize("Q", [8.0, 287.0])
def test_one_complex_line_is_eqs_5a_to_5g(r: float, Q: float) -> None:
    force = to_force_harmonics(observables(**EXAMPLE), simple(r, Q))
    cons, diss = paper_eq5(16.4, r, Q, 94e-9, EXAMPLE)
    np.testing.assert_allclose(force["F_cons"].values[:, 0], cons, rtol=1e-12, atol=1e-22)
    np.testing.assert_allclose(force["F_diss"].values[:, 0], diss, rtol=1e-12, atol=1e-22)


def test_eq_6_gives_the_force_harmonics_of_the_reference_states(steady_states: list[dict[str, Any]]) -> None:
    probe = Probe.simple(
        stiffness=26.0, frequency=303e3, quality_factor=456.0, drive_frequency=303e3, free_amplitude=85e-9
    )
    for row in steady_states:
        values = {f"A{n}": A * 1e-9 for n, A in enumerate(row["A_nm"])}
        values |= {f"phi{n}": math.radians(row["phi_deg"][n]) for n in (1, 2, 3)}
        force = to_force_harmonics(observables(**values), probe)
        np.testing.assert_allclose(force["F_cons"].values[:, 0] * 1e9, row["F_eq6_nN"], rtol=1e-9)
        # A conservative force: its dissipative part only feeds what the lever loses in its higher harmonics,
        # so that the energy lost in the contact, all harmonics together, nearly vanishes (n > 3 are left out).
        assert abs(force["F_diss"].values).max() < 1e-4 * abs(force["F_cons"].values).max()
        first = math.pi * row["A_nm"][1] * 1e-9 * float(force["F_diss"].sel(harmonic=1)[0])
        assert abs(float(energy(force, probe)["dissipation"][0])) < 0.6 * abs(first)


def test_no_force_is_the_free_lever() -> None:
    for probe in (simple(), simple(0.99), beam("slope")):
        free = observables(A1=probe.drive.free_amplitude, phi1=far_phase(probe))
        force = to_force_harmonics(free, probe)
        scale = probe.drive.free_amplitude / abs(complex(read_receptance(probe, probe.drive.frequency)))
        assert abs(force["F_cons"].values).max() < 1e-13 * scale
        assert abs(force["F_diss"].values).max() < 1e-13 * scale


def test_the_free_phase_is_90_degrees_only_at_resonance() -> None:
    assert far_phase(simple()) == pytest.approx(math.pi / 2)
    # the values of a real Cypher scan: 256976.8 Hz on a tune of 257.10 kHz with Q 391.72
    tuned = Probe.simple(
        stiffness=27.952,
        frequency=257.10e3,
        quality_factor=391.72,
        drive_frequency=256976.8,
        free_amplitude=33.27e-9,
    )
    assert math.degrees(far_phase(tuned)) == pytest.approx(69.4, abs=0.05)


@settings(max_examples=60, deadline=None)
@given(
    amplitude=st.floats(0.05, 0.98),
    cosine=st.floats(-1.0, 1.0),
    r=st.floats(0.95, 1.05),
    A2=st.floats(1e-13, 1e-9),
    phi2=st.floats(0.0, 6.28),
    slope=st.booleans(),
)
def test_there_and_back_again(
    amplitude: float, cosine: float, r: float, A2: float, phi2: float, slope: bool
) -> None:
    probe = beam("slope") if slope else simple(r)
    phase = math.acos(cosine)
    start = observables(A0=1e-10, A1=amplitude * 94e-9, phi1=phase, A2=A2, phi2=phi2)
    back = to_observables(to_force_harmonics(start, probe), probe)
    for name in ("A0", "A1", "A2"):
        np.testing.assert_allclose(back[name], start[name], rtol=1e-9)
    for name in ("phi1", "phi2"):
        assert abs(np.angle(np.exp(1j * (back[name] - start[name])))).max() < 1e-7


def test_a_force_that_the_amplitude_contradicts_is_refused() -> None:
    force = to_force_harmonics(observables(**EXAMPLE), simple())
    with pytest.raises(ObservablesError, match="contradict"):
        to_observables(force.assign(A1=force["A1"] * 1.1), simple())
    with pytest.raises(ObservablesError, match="harmonic 1 and the amplitude"):
        to_observables(force.drop_vars("A1"), simple())


# --- the optical lever ------------------------------------------------------------------------------


def beam(kind: str, modes: int = 3, Q: float = 287.0, k: float = 16.4, f: float = 161.8e3) -> Probe:
    """Return a uniform cantilever from its beam equation, spot and tip at the free end."""

    def frequency_equation(x: float) -> float:
        return math.cos(x) + 1.0 / math.cosh(x)

    lambdas = [brentq(frequency_equation, a, a + 1.5) for a in (1.2, 4.0, 7.0)][:modes]
    static = k * 12.0 / lambdas[0] ** 4
    slopes = []
    for x in lambdas:
        sigma = (math.sinh(x) - math.sin(x)) / (math.cosh(x) + math.cos(x))
        shape = math.cosh(x) - math.cos(x) - sigma * (math.sinh(x) - math.sin(x))
        slope = x * (math.sinh(x) + math.sin(x) - sigma * (math.cosh(x) - math.cos(x)))
        slopes.append(slope / shape)
    records = tuple(
        Mode(static * x**4 / 12.0, f * (x / lambdas[0]) ** 2, Q, s / slopes[0])
        for x, s in zip(lambdas, slopes, strict=True)
    )
    return Probe(Cantilever(records, static, 1.5 / slopes[0]), Drive(f, 94e-9), detector=Detector(kind))


def test_an_optical_lever_reads_the_second_harmonic_40_percent_low() -> None:
    """Reading over single-mode prediction of a uniform beam, tip and spot at its end."""

    def ratio(n: int, kind: str) -> float:
        single = Cantilever.single_mode(16.4, 161.8e3, 287.0)
        many, one = read_receptance(beam(kind), n * 161.8e3), tip_receptance(single, n * 161.8e3)
        return float((many / one).real)

    assert ratio(0, "slope") == pytest.approx(1.1226, abs=2e-4)
    assert ratio(2, "slope") == pytest.approx(0.6012, abs=3e-3)
    assert ratio(3, "slope") == pytest.approx(-0.196, abs=8e-3)
    assert ratio(2, "displacement") == pytest.approx(0.9006, abs=2e-3)


def test_acceleration_form_converges_faster_than_the_plain_sum() -> None:
    full, frequency = beam("displacement"), 2 * 161.8e3
    best = complex(tip_receptance(full.cantilever, frequency))
    short = Cantilever(full.cantilever.modes[:2], full.cantilever.static_stiffness)
    plain = Cantilever(full.cantilever.modes[:2])
    error = [abs(complex(tip_receptance(c, frequency)) / best - 1) for c in (short, plain)]
    assert error[0] < 0.05 * error[1]


def test_a_mean_with_a_static_sensitivity_is_what_the_tip_does() -> None:
    """Calibrated on a force curve, the slope at rest is worth the displacement at rest; all else is as it was."""
    dynamic = beam("slope")
    static = replace(dynamic, detector=Detector("slope", "static"))
    assert complex(read_receptance(static, 0.0)) == complex(tip_receptance(static.cantilever, 0.0))
    ratio = complex(read_receptance(dynamic, 0.0)) / complex(read_receptance(static, 0.0))
    assert ratio.real == pytest.approx(1.5 / 1.3765, rel=1e-4, abs=0)
    assert far_phase(static) == far_phase(dynamic)
    frequencies = np.array([0.0, 1.0, 161.8e3, 2 * 161.8e3])
    here, there = read_receptance(dynamic, frequencies), read_receptance(static, frequencies)
    np.testing.assert_array_equal(here[1:], there[1:])
    assert there[0] == complex(read_receptance(static, 0.0))
    # one that reads displacement has nothing to choose
    plain = beam("displacement")
    other = replace(plain, detector=Detector("displacement", "static"))
    np.testing.assert_array_equal(read_receptance(plain, frequencies), read_receptance(other, frequencies))


def test_a_static_mean_is_turned_into_the_force_by_the_static_stiffness() -> None:
    static = replace(beam("slope"), detector=Detector("slope", "static"))
    force = to_force_harmonics(observables(**EXAMPLE), static)["F_cons"]
    stiffness = static.cantilever.static_stiffness
    assert stiffness is not None
    assert float(force.sel(harmonic=0)[0]) == pytest.approx(EXAMPLE["A0"] * stiffness, rel=1e-12, abs=0)
    dynamic = to_force_harmonics(observables(**EXAMPLE), beam("slope"))["F_cons"]
    assert float((force / dynamic).sel(harmonic=0)[0]) == pytest.approx(1.0897, abs=1e-4)
    np.testing.assert_array_equal(force.values[1:], dynamic.values[1:])
    back = to_observables(to_force_harmonics(observables(A0=1e-10, A1=5e-8, phi1=0.9), static), static)
    assert float(back["A0"][0]) == pytest.approx(1e-10, rel=1e-9, abs=0)


# --- energy and regime ------------------------------------------------------------------------------


def test_dissipation_is_clevelands_formula() -> None:
    phase, A = 0.9, 40e-9
    force = to_force_harmonics(observables(A1=A, phi1=phase), simple())
    result = energy(force, simple())
    expected = math.pi * 16.4 * A / 287.0 * (94e-9 * math.sin(phase) - A)
    assert float(result["dissipation"][0]) == pytest.approx(expected, rel=1e-12, abs=0)
    assert float(result["virial"][0]) == pytest.approx(
        -0.5 * A * 16.4 * 94e-9 / 287 * math.cos(phase), rel=1e-12, abs=0
    )


def test_a_lost_higher_harmonic_does_not_lose_the_energy() -> None:
    data = observables(**(EXAMPLE | {"A2": np.nan}))
    both = energy(to_force_harmonics(data, simple()), simple())["dissipation"]
    alone = energy(to_force_harmonics(data[["A1", "phi1", "A3", "phi3"]], simple()), simple())["dissipation"]
    assert float(both[0]) == pytest.approx(float(alone[0]), rel=1e-12, abs=0)


def test_power_into_the_lever_is_the_drive_minus_its_damping() -> None:
    """Energy of all harmonics against the integral of force times velocity over a period."""
    probe = simple(0.99, 30.0)
    data = observables(**EXAMPLE)
    force = to_force_harmonics(data, probe)
    theta = np.linspace(0, 2 * np.pi, 4096, endpoint=False)
    f = force["F_cons"].values[:, 0] - 1j * force["F_diss"].values[:, 0]
    F = sum((f[n] * np.exp(1j * n * theta)).real for n in range(4))
    q = [0.0, EXAMPLE["A1"]]
    q += [EXAMPLE[f"A{n}"] * np.exp(1j * (n * EXAMPLE["phi1"] - EXAMPLE[f"phi{n}"])) for n in (2, 3)]
    velocity = sum((1j * n * q[n] * np.exp(1j * n * theta)).real for n in range(1, 4))
    lost = -np.mean(F * velocity) * 2 * np.pi
    assert float(energy(force, probe)["dissipation"][0]) == pytest.approx(lost, rel=1e-10, abs=0)


def test_regime_is_the_sign_of_the_force_not_of_the_phase() -> None:
    """Below resonance a phase under 90 degrees may well be attraction."""
    probe = simple(0.999)
    phases = np.array([far_phase(probe) + 0.2, far_phase(probe) - 0.4])
    data = xr.Dataset({"A1": ("point", [90e-9, 90e-9]), "phi1": ("point", phases)})
    assert phases[0] < math.pi / 2
    assert list(regime(data, probe).values) == [ATTRACTIVE, REPULSIVE]


def test_readings_that_disagree_leave_the_regime_undetermined() -> None:
    probe = simple()
    data = xr.Dataset({"A1": ("point", [50e-9] * 4), "phi1": ("point", [0.5, 1.5, 2.5, np.nan])})
    assert list(regime(data, probe, noise=0.002).values) == [REPULSIVE, REPULSIVE, ATTRACTIVE, UNDETERMINED]
    assert regime(data, probe, [(probe, 0.2)]).values[1] == UNDETERMINED
    assert regime(data, probe, noise=0.1).values[1] == UNDETERMINED


@pytest.mark.parametrize(
    ("change", "word"),
    [
        ({"A1": -1e-9}, "negative"),
        ({"A1": np.nan}, "no pixel"),
    ],
)
def test_datasets_that_break_the_contract_are_refused(change: dict[str, float], word: str) -> None:
    with pytest.raises(ObservablesError, match=word):
        to_force_harmonics(observables(**(EXAMPLE | change)), simple())


def test_a_dataset_without_phase_is_refused() -> None:
    with pytest.raises(ObservablesError, match="lack phi1"):
        to_force_harmonics(observables(A1=1e-9), simple())
    wrong = observables(A1=1.0, phi1=1.0)
    wrong["A1"].attrs["units"] = "nm"
    with pytest.raises(ObservablesError, match="not in SI"):
        to_force_harmonics(wrong, simple())
