"""What a calibration supports: against the shared errors of the theory, inverted again without linearising."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import xarray as xr
from scipy.optimize import brentq, fsolve

from overtone.contact.sample import Sample, sample
from overtone.dynamics.balance import FOUND
from overtone.dynamics.hold import hold_amplitude
from overtone.dynamics.indented import indented_states
from overtone.errors import CalibrationError
from overtone.harmonics import to_force_harmonics
from overtone.instrument.calibration import Calibration, ReferenceMaterial
from overtone.instrument.gates import ABSOLUTE, CONTRAST, GATE, RELATIVE, SOFTER, Gate, gates
from overtone.instrument.unknowns import NEUTRAL, UNKNOWNS
from overtone.probe import Probe

# the LDPE-like pixel of the map in the method's paper: A1 39.1 nm of 94 nm, delta 17.54 nm
PROBE = Probe.simple(
    stiffness=16.4,
    frequency=161.8e3,
    quality_factor=287.0,
    radius=10e-9,
    drive_frequency=161.8e3,
    free_amplitude=94e-9,
)
SETPOINT = 39.1 / 94.0
MODULUS, ADHESION = 93.78e6, 16.24e-9
ERRORS = {
    "A0_offset": 1e-12,
    "phi1_offset": math.radians(0.1),
    "gain0": 0.01,
    "gain2": 0.01,
    "free_amplitude": 0.005,
    "quality_factor": 0.005,
    "stiffness": 0.05,
    "radius": 0.15,
    "compression": 0.002,
    "A0_slope_z": 0.005,
}


def pixel(viscosity: float, **changes: float) -> Sample:
    values = {"modulus": MODULUS, "adhesion": ADHESION} | changes
    return sample("dmt-viscous", poisson_ratio=0.3, viscosity=viscosity, **values)


def calibration(
    errors: dict[str, float] | None = None, reference: ReferenceMaterial | None = None, **values: float
) -> Calibration:
    errors = ERRORS if errors is None else errors
    covariance = np.diag([error**2 for error in errors.values()])
    return Calibration(PROBE, 94e-9, dict(NEUTRAL) | values, tuple(errors), covariance, reference=reference)


@pytest.fixture(scope="module")
def viscosity() -> float:
    """Return the viscosity with which the pixel has its indentation at this amplitude: it loses 2.1 keV a cycle."""

    def off(logarithm: float) -> float:
        state = hold_amplitude(PROBE, pixel(math.exp(logarithm)), setpoint=SETPOINT)
        return float(state["indentation"]) * 1e9 - 17.54

    return math.exp(brentq(off, 2.0, 4.0, xtol=1e-7))


@pytest.fixture(scope="module")
def state(viscosity: float) -> xr.Dataset:
    return hold_amplitude(PROBE, pixel(viscosity), setpoint=SETPOINT)


@pytest.fixture(scope="module")
def gate(viscosity: float) -> Gate:
    (only,) = gates(calibration(), setpoint=SETPOINT, materials={"LDPE": pixel(viscosity)})
    return only


def inverted(state: xr.Dataset, viscosity: float, probe: Probe = PROBE, **errors: float) -> np.ndarray:
    """Return ln of modulus, adhesion and indentation over the true ones, from readings that are off by errors."""
    data = state[["A0", "A1", "phi1", "A2", "phi2"]].expand_dims("point")
    data = data.assign(
        A0=data["A0"] * (1.0 + errors.get("gain0", 0.0)) + errors.get("A0", 0.0),
        A2=data["A2"] * (1.0 + errors.get("gain2", 0.0)),
        phi1=data["phi1"] + errors.get("phi1", 0.0),
        phi2=data["phi2"] + 2.0 * errors.get("phi1", 0.0),
    )
    target = to_force_harmonics(data, probe)["F_cons"].values[:, 0]

    def off(logarithms: np.ndarray) -> np.ndarray:
        E, F, delta = np.exp(logarithms)
        material = pixel(viscosity, modulus=MODULUS * E, adhesion=ADHESION * F)
        there = indented_states(
            PROBE, material, amplitude=[float(state["A1"])], indentation=[delta * float(state["indentation"])]
        )
        assert int(there.status[0]) == FOUND
        return np.asarray((there.force[0, :3].real - target) * 1e9)

    root, _, flag, message = fsolve(off, np.zeros(3), full_output=True, xtol=1e-12)
    assert flag == 1, message
    return np.asarray(root)


def test_the_pixel_is_the_one_of_the_paper(state: xr.Dataset) -> None:
    """F0, F1, F2 = 0.646, -2.01, 3.58 nN of eq 19; the full motion makes them some per cent smaller."""
    assert float(state["indentation"]) == pytest.approx(17.54e-9, rel=1e-5, abs=0)
    np.testing.assert_allclose(state["F_cons"].values[:3] * 1e9, [0.646, -2.01, 3.58], rtol=0.04)
    assert float(state["A0"]) == pytest.approx(39e-12, rel=0.03, abs=0)
    assert float(state["dissipation"]) / 1.602e-19 == pytest.approx(2100.0, rel=0.03, abs=0)


@pytest.mark.parametrize(
    ("errors", "modulus"),
    [
        ({"A0": 1e-12}, 0.133),
        ({"A0": -1e-12}, 0.071),
        ({"phi1": math.radians(1.0)}, 0.74),
        ({"phi1": -math.radians(1.0)}, 0.040),
        ({"gain2": 0.05}, 0.25),
        ({"gain2": -0.05}, 0.047),
        ({"drive": -0.02}, 0.18),
        ({"drive": 0.02}, 0.059),
    ],
)
def test_shared_errors_do_what_the_theory_says(
    state: xr.Dataset, viscosity: float, errors: dict[str, float], modulus: float
) -> None:
    """Its table [GPa], inverted without linearising; that had the forces of eq 19, these are of the full motion."""
    drive = replace(PROBE.drive, free_amplitude=94e-9 * (1.0 + errors.get("drive", 0.0)))
    found = inverted(state, viscosity, replace(PROBE, drive=drive), **errors)
    assert MODULUS * math.exp(found[0]) * 1e-9 == pytest.approx(modulus, rel=0.25, abs=0)


def test_sensitivities_are_those_of_the_inversion(state: xr.Dataset, viscosity: float, gate: Gate) -> None:
    """Central differences of the three harmonics solved again: an unknown that is too large is taken off too much."""
    small = {
        "A0": ("A0_offset", 5e-14),
        "phi1": ("phi1_offset", 2e-5),
        "gain0": ("gain0", 2e-4),
        "gain2": ("gain2", 2e-4),
    }
    for reading, (name, step) in small.items():
        up, down = (inverted(state, viscosity, **{reading: s})[0] for s in (-step, step))
        assert gate.sensitivity[name] == pytest.approx((up - down) / (2.0 * step), rel=3e-3, abs=0), name
    ends = []
    for factor in (1.0002, 0.9998):
        probe = replace(PROBE, drive=replace(PROBE.drive, free_amplitude=94e-9 * factor))
        ends.append(inverted(state, viscosity, probe)[0])
    assert gate.sensitivity["free_amplitude"] == pytest.approx((ends[0] - ends[1]) / 4e-4, rel=3e-3, abs=0)
    # one picometre is hardly small any more
    for size in (1e-12, -1e-12):
        root = inverted(state, viscosity, A0=-size)[0]
        assert gate.sensitivity["A0_offset"] * size == pytest.approx(root, rel=0.15, abs=0)


def test_tolerances_are_of_the_size_that_the_theory_says(gate: Gate) -> None:
    """About 1 pm, 0.1 deg, 1 % and 0.5 %: what moves ln E by a quarter."""
    for name, value in (("A0_offset", 1e-12), ("gain2", 0.01), ("gain0", 0.01), ("free_amplitude", 0.005)):
        assert 0.5 * value < gate.tolerance[name] < 2.1 * value, name
    assert 0.1 < math.degrees(gate.tolerance["phi1_offset"]) < 0.21
    assert gate.sensitivity["A0_offset"] < 0.0
    for name, slope in gate.sensitivity.items():
        if slope:
            assert gate.tolerance[name] == pytest.approx(GATE / abs(slope), rel=1e-12, abs=0)


def test_stiffness_and_radius_scale_the_modulus(gate: Gate) -> None:
    """All forces grow with the stiffness: E with them. At a given Lambda E goes as 1/sqrt(R)."""
    assert gate.sensitivity["stiffness"] == pytest.approx(1.0, abs=0.05)
    assert gate.sensitivity["radius"] == pytest.approx(-0.5, rel=1e-12, abs=0)
    # drive amplitude over Q is what counts
    assert gate.sensitivity["quality_factor"] == pytest.approx(
        -gate.sensitivity["free_amplitude"], rel=0.01, abs=0
    )
    assert gate.tolerance["A0_slope_z"] == math.inf


def test_errors_add_up_as_their_covariance_says(viscosity: float, gate: Gate) -> None:
    total = math.sqrt(sum((gate.sensitivity[name] * error) ** 2 for name, error in ERRORS.items()))
    assert gate.absolute_error == pytest.approx(total, rel=1e-9, abs=0)
    # drive and Q that err together cancel
    pair = {"free_amplitude": 0.005, "quality_factor": 0.005}
    tied = replace(calibration(pair), covariance=np.full((2, 2), 0.005**2))
    (together,) = gates(tied, setpoint=SETPOINT, materials={"LDPE": pixel(viscosity)})
    assert together.absolute_error < 0.02 * 0.005 * abs(gate.sensitivity["free_amplitude"])


def test_where_the_instrument_adds_something_the_answer_is_nearly_the_same(
    viscosity: float, gate: Gate
) -> None:
    """Offset, turned phase and latency are taken off before anything else."""
    known = calibration(A0_offset=3e-10, phi1_offset=0.3, latency2=0.4, crosstalk2_re=2e-11, gain2=0.8)
    (other,) = gates(known, setpoint=SETPOINT, materials={"LDPE": pixel(viscosity)})
    for name in ("A0_offset", "phi1_offset", "gain0", "free_amplitude"):
        assert other.sensitivity[name] == pytest.approx(gate.sensitivity[name], rel=1e-3, abs=0), name
    assert other.sensitivity["gain2"] == pytest.approx(gate.sensitivity["gain2"] / 0.8, rel=1e-3, abs=0)


def test_an_unknown_without_error_has_a_tolerance_all_the_same(viscosity: float, gate: Gate) -> None:
    (sure,) = gates(
        calibration(ERRORS | {"gain2": 0.0, "A0_offset": 0.0}),
        setpoint=SETPOINT,
        materials={"LDPE": pixel(viscosity)},
    )
    for name in ("gain2", "A0_offset"):
        assert sure.tolerance[name] == pytest.approx(gate.tolerance[name], rel=1e-3, abs=0)


# --- with a reference -----------------------------------------------------------------------------

PS = ReferenceMaterial("PS", "dmt", 0.34, {"modulus": (3e9, 0.1), "adhesion": (10e-9, 0.2)})


def test_without_materials_the_reference_and_a_softer_one_are_asked_for() -> None:
    own, soft = gates(calibration(reference=PS), setpoint=0.6)
    assert (own.material, soft.material) == ("PS", "20 times softer")
    assert own.modulus == 3e9
    assert soft.modulus == pytest.approx(3e9 / SOFTER, rel=1e-12, abs=0)
    assert math.isnan(own.relative_error)
    # a stiff sample is hopeless: picometres of A0 leave it open
    assert own.verdict == CONTRAST
    assert own.absolute_error > 4.0 * soft.absolute_error > 4.0
    assert "leave its modulus open" in own.reason
    assert own.tolerance["A0_offset"] < 0.2 * soft.tolerance["A0_offset"]


def test_a_reference_of_known_modulus_takes_its_share_of_the_errors_away() -> None:
    """Conditioning a Gaussian: var(a | b) = var a - cov(a, b)^2/var b; b is the reference, inverted, with its error."""
    own, soft = gates(calibration(reference=PS), setpoint=0.6)
    rows = [np.array([g.sensitivity[name] for name in ERRORS]) for g in (soft, own)]
    C = np.diag([error**2 for error in ERRORS.values()])
    a, ab, b = rows[0] @ C @ rows[0], rows[0] @ C @ rows[1], rows[1] @ C @ rows[1] + 0.1**2
    assert soft.relative_error == pytest.approx(math.sqrt(a - ab**2 / b), rel=1e-6, abs=0)
    assert soft.relative_error < soft.absolute_error
    # and by drawing it: the modulus of the soft one, regressed on that of the reference
    generator = np.random.default_rng(0)
    draws = generator.normal(size=(200_000, len(ERRORS))) * np.array(list(ERRORS.values()))
    x, y = draws @ rows[1] + generator.normal(0.0, 0.1, 200_000), draws @ rows[0]
    left = y - x * (x @ y) / (x @ x)
    assert soft.relative_error == pytest.approx(float(left.std()), rel=0.01, abs=0)


@pytest.mark.parametrize(
    ("errors", "verdict", "words"),
    [
        ({"A0_offset": 1e-14, "radius": 0.1}, ABSOLUTE, "one standard deviation"),
        ({"radius": 0.6}, RELATIVE, "its ratio to the reference"),
        ({"A0_offset": 5e-12, "phi1_offset": 0.02}, RELATIVE, "leave its modulus open; they move its ratio"),
        ({"A0_offset": 5e-12, "gain0": 0.2, "gain2": 0.2}, CONTRAST, "would do"),
    ],
)
def test_verdicts(errors: dict[str, float], verdict: str, words: str) -> None:
    _, soft = gates(calibration(errors, PS), setpoint=0.6)
    assert soft.verdict == verdict
    assert words in soft.reason
    assert (soft.absolute_error <= GATE) is (verdict == ABSOLUTE)
    if verdict != ABSOLUTE:
        worst = max(errors, key=lambda name: abs(soft.sensitivity[name]) * errors[name])
        assert worst in soft.reason


def test_many_small_errors_name_the_largest_of_them() -> None:
    """None of them by itself would do harm."""
    names = [
        unknown.name for unknown in UNKNOWNS if unknown.name not in ("A0_slope_z", "A0_slope_x", "A0_slope_y")
    ]
    _, soft = gates(calibration(dict.fromkeys(names, 1e-15), PS), setpoint=0.6)
    alone = {name: 0.11 / abs(s) for name, s in soft.sensitivity.items() if abs(s) > 1e-6}
    assert len(alone) > 8
    _, soft = gates(calibration(alone, PS), setpoint=0.6)
    assert soft.absolute_error > GATE
    assert "would do" in soft.reason


def test_a_material_with_the_name_of_the_reference_is_the_reference() -> None:
    """As the calibration has it, whatever it is said to be."""
    other = sample("dmt", modulus=1e8, poisson_ratio=0.34, adhesion=10e-9)
    named, soft = gates(calibration(reference=PS), setpoint=0.6, materials={"PS": other, "soft": other})
    own, _ = gates(calibration(reference=PS), setpoint=0.6)
    assert named.modulus == own.modulus == 3e9
    assert named.absolute_error == own.absolute_error != soft.absolute_error
    assert math.isnan(named.relative_error)
    assert soft.modulus == 1e8


# --- what is refused ------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "reference", "message"),
    [
        ({}, None, "no material to ask for"),
        (
            {},
            ReferenceMaterial("spring", "kelvin-voigt", 0.3, {"stiffness": (1.0, 0.1)}),
            "no material to ask for",
        ),
        (
            {"materials": {"map": sample("hertz", modulus=[1e8, 1e9], poisson_ratio=0.3)}},
            None,
            "one material",
        ),
        (
            {"materials": {"air": sample("hertz", modulus=1e-3, poisson_ratio=0.3)}},
            None,
            "no repulsive state",
        ),
    ],
)
def test_questions_without_an_answer_are_refused(
    arguments: dict[str, Any], reference: ReferenceMaterial | None, message: str
) -> None:
    with pytest.raises(CalibrationError, match=message):
        gates(calibration(reference=reference), setpoint=SETPOINT, **arguments)
