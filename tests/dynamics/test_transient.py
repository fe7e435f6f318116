import math
from collections.abc import Callable
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
import xarray as xr
from scipy.integrate import solve_ivp

from overtone.contact import law
from overtone.contact.adhesive import jkr_force
from overtone.contact.parameters import effective_modulus
from overtone.contact.sample import Sample, sample
from overtone.dynamics import dop853, integrate
from overtone.dynamics.system import excitation, laws, phase_offset
from overtone.dynamics.transient import (
    Motion,
    contacts_of,
    filter_decay,
    floquet_multipliers,
    free_motion,
    lever_of,
    memory_of,
    motion_of,
    motion_under,
    settle,
    sweep,
)
from overtone.errors import OvertoneError
from overtone.harmonics import energy, far_phase, to_force_harmonics
from overtone.probe import Cantilever, Detector, Drive, Mode, Probe, Tip

RADIUS, MODULUS, ADHESION, DISTANCE, RUPTURE = 10e-9, 1e9, 4e-9, 0.2e-9, 1e-9
MATERIALS: dict[str, dict[str, float]] = {
    "hertz": {},
    "dmt-contact": {"adhesion": ADHESION},
    "dmt-linear": {"adhesion": ADHESION},
    "dmt": {"adhesion": ADHESION},
    "dmt-viscous": {"adhesion": ADHESION, "viscosity": 40.0},
    "capillary": {"adhesion": ADHESION, "rupture_distance": RUPTURE},
    "jkr": {"adhesion": ADHESION},
    "maugis": {"work_of_adhesion": 0.05},
}


def material(key: str, **changes: float) -> Sample:
    return sample(key, modulus=MODULUS, poisson_ratio=0.3, **{**MATERIALS[key], **changes})


def small_lever(ratio: float = 1.02, quality_factor: float = 30.0, acts_on: str = "tip") -> Probe:
    """Return a lever that forgets soon, off resonance."""
    return Probe(
        Cantilever.single_mode(5.0, 300e3, quality_factor), Drive(ratio * 300e3, 20e-9, acts_on), Tip(RADIUS)
    )


def three_modes(ratio: float = 0.99, acts_on: str = "tip", kind: str = "slope", **lever: float) -> Probe:
    modes = (
        Mode(26.0, 303e3, 60.0, 1.0, 1.6),
        Mode(1021.0, 6.27 * 303e3, 90.0, 3.47, -0.9),
        Mode(8005.0, 17.55 * 303e3, 120.0, 5.70, 0.5),
    )
    return Probe(
        Cantilever(modes, **lever), Drive(ratio * 303e3, 40e-9, acts_on), Tip(RADIUS), Detector(kind)
    )


def section_3_probe() -> Probe:
    """Return the probe of section 3 of the method's paper."""
    return Probe.simple(
        stiffness=26.0,
        frequency=303e3,
        quality_factor=456.0,
        radius=RADIUS,
        drive_frequency=303e3,
        free_amplitude=85e-9,
    )


def follow(probe: Probe, of: Sample, Z: float, motion: Motion, count: int, tolerance: float) -> Motion:
    """Return the state some periods later."""
    lever = lever_of(probe)
    state = np.concatenate([motion.deflection, motion.velocity])[None] / lever.length
    mode = np.array([[-1, int(motion.held)]])
    status, steps = np.zeros(1, np.int8), np.zeros(1, np.int64)
    contacts = contacts_of(laws(probe, of), lever.length)
    integrate.follow_block(
        lever, contacts, np.array([Z / lever.length]), count, state, mode, tolerance, status, steps
    )
    assert status[0] == integrate.DONE
    q, v = np.split(state[0] * lever.length, 2)
    return Motion(q, v, np.array(mode[0, 1] > 0))


# --- the method -------------------------------------------------------------------------------------------------


def test_coefficients_keep_the_conditions_of_their_order() -> None:
    np.testing.assert_allclose(dop853.A.sum(axis=1), dop853.C, atol=2e-15)
    for k in range(8):
        np.testing.assert_allclose(dop853.B @ dop853.C**k, 1 / (k + 1), rtol=1e-14)
    np.testing.assert_allclose(dop853.B @ dop853.A @ dop853.C**6, 1 / 56, rtol=1e-14)
    for estimate, order in ((dop853.E5, 5), (dop853.E3, 3)):
        for k in range(order):
            assert estimate @ dop853.C**k == pytest.approx(0.0, abs=1e-14)


def analytic(probe: Probe, start: Motion, theta: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the free motion of damped modes under the drive."""
    rest = free_motion(probe)
    q, v = [], []
    forced = excitation(probe).modal
    for j, mode in enumerate(probe.cantilever.modes):
        r = mode.frequency / probe.drive.frequency
        root = r * np.sqrt(1 / (4 * mode.quality_factor**2) - 1 + 0j)
        rates = -r / (2 * mode.quality_factor) + np.array([root, -root])
        off = np.array([start.deflection[j] - rest.deflection[j], start.velocity[j] - rest.velocity[j]])
        parts = np.linalg.solve(np.array([[1, 1], rates]), off) * np.exp(rates * theta)
        phasor = forced[j] / (1 - r**-2 + 1j / (r * mode.quality_factor)) * np.exp(1j * theta)
        q.append((parts.sum() + phasor).real)
        v.append(((parts * rates).sum() + 1j * phasor).real)
    return np.array(q), np.array(v)


@pytest.mark.parametrize("acts_on", ["tip", "base"])
@pytest.mark.parametrize("ratio", [1.0, 0.93])
def test_free_motion_decays_as_it_must(acts_on: str, ratio: float) -> None:
    probe = three_modes(ratio, acts_on)
    start = Motion(np.array([11e-9, -3e-9, 1e-9]), np.array([-7e-9, 20e-9, 5e-9]), np.array(False))
    end = follow(probe, material("hertz"), 1e-6, start, 7, 1e-12)
    q, v = analytic(probe, start, 7 * 2 * np.pi)
    np.testing.assert_allclose(end.deflection, q, rtol=0, atol=1e-10 * 40e-9)
    np.testing.assert_allclose(end.velocity, v, rtol=0, atol=1e-9 * 40e-9)


@pytest.mark.parametrize("acts_on", ["tip", "base"])
@pytest.mark.parametrize("lever", [{}, {"static_stiffness": 25.2, "static_slope_ratio": 1.0897}])
def test_free_motion_is_read_as_the_probe_says(acts_on: str, lever: dict[str, float]) -> None:
    probe = three_modes(0.97, acts_on, **lever)
    far = settle(probe, material("hertz"), Z=1e-6)
    assert int(far["state"]) == integrate.DONE
    assert float(far["A1"]) == pytest.approx(40e-9, rel=1e-9)
    assert float(far["phi1"]) == pytest.approx(far_phase(probe) % (2 * np.pi), abs=1e-9)
    assert abs(float(far["A0"])) < 1e-9 * 40e-9
    assert float(far["A2"]) < 1e-9 * 40e-9
    assert float(far["dissipation"]) == float(far["contact_time"]) == float(far["peak_force"]) == 0.0


# --- against an integrator that knows nothing of this one ------------------------------------------------------


class Plain:
    """The equation of motion of one mode in plain Python, in nanometres and radians of the drive."""

    def __init__(self, probe: Probe, key: str, Z: float) -> None:
        mode = probe.cantilever.modes[0]
        self.r = mode.frequency / probe.drive.frequency
        self.Q, self.k, self.Z = mode.quality_factor, mode.stiffness, Z
        self.drive, self.w = excitation(probe), 2 * np.pi * probe.drive.frequency
        self.E = float(effective_modulus(MODULUS, 0.3, probe.tip.modulus, probe.tip.poisson_ratio))
        self.key, self.inside, self.held = key, False, False
        a_s = (ADHESION / 12 * RADIUS / self.E) ** (1 / 3)  # a_s^3 = pi w R^2 / (8 E*), F_ad = 3/2 pi w R
        self.neck = 3.0 * a_s**2 / RADIUS
        self.levels = {
            "dmt-linear": [0.0, 2 * DISTANCE],
            "capillary": [0.0, RUPTURE],
            "jkr": [0.0, self.neck],
        }.get(key, [0.0])

    def force(self, d: float, v: float) -> float:
        if self.key == "jkr":
            work = ADHESION / (1.5 * math.pi * RADIUS)
            pars = {"effective_modulus": self.E, "radius": RADIUS, "work_of_adhesion": work}
            return float(jkr_force(-min(d, self.neck), approaching=False, **pars)) if self.held else 0.0
        if self.inside:
            depth = max(-d, 0.0)
            total = 4 / 3 * self.E * math.sqrt(RADIUS) * depth**1.5
            if self.key == "dmt-viscous":
                total -= 40.0 * math.sqrt(RADIUS * depth) * v
            return total - (ADHESION if self.key != "hertz" else 0.0)
        if self.key in ("dmt", "dmt-viscous"):
            return -ADHESION * (DISTANCE / (DISTANCE + max(d, 0.0))) ** 2
        if self.key == "dmt-linear":
            return -ADHESION * max(0.0, 1 - d / (2 * DISTANCE))
        return -ADHESION if self.key == "capillary" and self.held else 0.0

    def gap(self, theta: float, y: np.ndarray) -> float:
        return self.Z + y[0] * 1e-9 + (self.drive.direct * np.exp(1j * theta)).real

    def right_side(self, theta: float, y: np.ndarray) -> list[float]:
        turn = np.exp(1j * theta)
        speed = y[1] * 1e-9 + (1j * self.drive.direct * turn).real
        F = self.force(self.gap(theta, y), self.w * speed)
        push = self.r**2 * (F / self.k + (self.drive.modal[0] * turn).real) * 1e9
        return [y[1], push - self.r**2 * y[0] - self.r / self.Q * y[1]]

    def follow(self, start: Motion, end: float, dense: list[Any] | None = None) -> np.ndarray:
        """Return deflection and velocity [nm], restarted at every gap where the force is not smooth."""
        theta, y = 0.0, np.array([start.deflection[0], start.velocity[0]]) * 1e9
        gap = self.gap(0.0, y)
        self.inside, self.held = gap < 0.0, gap < 0.0
        region = sum(gap > level for level in self.levels)
        while theta < end:
            bounds = [b for b in (region - 1, region) if 0 <= b < len(self.levels)]
            events: list[Callable[..., float]] = []
            for b in bounds:

                def event(t: float, y: np.ndarray, level: float = self.levels[b]) -> float:
                    return (self.gap(t, y) - level) * 1e9

                event.terminal, event.direction = True, -1.0 if b < region else 1.0  # type: ignore[attr-defined]
                events.append(event)
            solution = solve_ivp(
                self.right_side,
                (theta, end),
                y,
                method="DOP853",
                rtol=1e-12,
                atol=1e-12,
                events=events,
                max_step=0.1,
                dense_output=dense is not None,
            )
            if dense is not None:
                dense.append((theta, solution.t[-1], solution.sol))
            theta, y = solution.t[-1], solution.y[:, -1]
            if solution.status != 1:
                continue
            hit = next(b for b, found in zip(bounds, solution.t_events, strict=True) if found.size)
            region = hit if hit < region else region + 1
            self.inside = region == 0
            if hit == 0 and self.inside:
                self.held = True
            elif hit == len(self.levels) - 1 and region > hit:
                self.held = False
        return y


@pytest.mark.parametrize("acts_on", ["tip", "base"])
@pytest.mark.parametrize("key", [key for key in MATERIALS if key != "maugis"])
def test_motion_equals_that_of_another_integrator(key: str, acts_on: str) -> None:
    if acts_on == "base" and key not in ("dmt-viscous", "capillary"):
        pytest.skip("the drive is the same for all")
    probe = small_lever(acts_on=acts_on)
    Z = 12e-9
    start = free_motion(probe)
    end = follow(probe, material(key), Z, start, 3, 1e-13)
    y = Plain(probe, key, Z).follow(start, 6 * np.pi)
    ours = np.array([end.deflection[0], end.velocity[0]]) * 1e9
    np.testing.assert_allclose(ours, y, rtol=0, atol=2e-9)


def test_phasors_of_a_transient_are_those_of_its_dense_motion() -> None:
    """The first period after a start far from any state, read with a base that moves."""
    probe, Z, slope = small_lever(), 12e-9, -0.05e-9
    lever = lever_of(probe)
    plain = Plain(probe, "dmt", Z)
    plain.gap = lambda t, y: Z + slope * t + y[0] * 1e-9  # type: ignore[method-assign]
    start, dense = free_motion(probe), []
    plain.follow(start, 2 * np.pi, dense)
    nodes, weights = np.polynomial.legendre.leggauss(40)
    expected = np.zeros(4, complex)
    for a, b, solution in dense:
        for left, right in pairwise(np.linspace(a, b, 20)):
            theta = 0.5 * (left + right) + 0.5 * (right - left) * nodes
            q = solution(theta)[0] * 1e-9 * weights * 0.5 * (right - left) / np.pi
            expected += [(q * np.exp(-1j * n * theta)).sum() * (0.5 if n == 0 else 1.0) for n in range(4)]
    # a lock-in that forgets within a period reads that period alone
    speed = -slope * lever.speed / lever.length
    heights = [Z, Z + slope * 2 * np.pi]
    readings, _ = sweep(
        probe, material("dmt"), z=heights, speed=speed, bandwidth=1e9, start=start, order=1, tolerance=1e-12
    )
    offset = phase_offset(probe, excitation(probe))
    assert float(readings["A0"][1]) == pytest.approx(expected[0].real, abs=1e-9 * 20e-9)
    for n in (1, 2, 3):
        phasor = float(readings[f"A{n}"][1]) * np.exp(1j * (n * offset - float(readings[f"phi{n}"][1])))
        assert abs(phasor - expected[n]) < 1e-9 * 20e-9


# --- states -----------------------------------------------------------------------------------------------------


def reference_motion(rows: list[dict[str, Any]], probe: Probe) -> Motion:
    offset, n = phase_offset(probe, excitation(probe)), np.arange(4)
    lag = np.radians([row["phi_deg"] for row in rows])
    phasors = np.array([row["A_nm"] for row in rows]) * 1e-9 * np.exp(1j * (n * offset - lag))
    shape = len(rows)
    return Motion(
        phasors.sum(axis=1).real[:, None], (1j * n * phasors).sum(axis=1).real[:, None], np.zeros(shape, bool)
    )


@pytest.mark.parametrize("method", ["shooting", "relax"])
def test_reference_states_by_shooting(method: str, steady_states: list[dict[str, Any]]) -> None:
    probe = section_3_probe()
    rows = steady_states if method == "shooting" else steady_states[3:4]
    Z = np.array([row["Z_nm"] for row in rows]) * 1e-9
    of = sample("dmt", modulus=1e9, poisson_ratio=0.3, adhesion=20e-9)
    state = settle(probe, of, Z=Z, start=reference_motion(rows, probe), method=method, tolerance=1e-11)
    assert (state["state"] == integrate.DONE).all()
    for n in range(4):
        np.testing.assert_allclose(state[f"A{n}"] * 1e9, [row["A_nm"][n] for row in rows], rtol=1e-7)
    for n in (1, 2, 3):
        off = np.degrees(state[f"phi{n}"].values) - [row["phi_deg"][n] for row in rows]
        np.testing.assert_allclose((off + 180) % 360 - 180, 0.0, atol=2e-6)
    np.testing.assert_allclose(state["indentation"] * 1e9, [row["delta_max_nm"] for row in rows], atol=2e-5)


def test_error_falls_with_the_tolerance(steady_states: list[dict[str, Any]]) -> None:
    probe = section_3_probe()
    Z = np.array([row["Z_nm"] for row in steady_states]) * 1e-9
    of = sample("dmt", modulus=1e9, poisson_ratio=0.3, adhesion=20e-9)
    start = reference_motion(steady_states, probe)
    exact = settle(probe, of, Z=Z, start=start, tolerance=1e-13)
    errors = []
    for tolerance in (1e-6, 1e-7, 1e-8, 1e-9, 1e-10, 1e-11):
        state = settle(probe, of, Z=Z, start=start, tolerance=tolerance)
        errors.append(max(float(abs(state[f"A{n}"] / exact[f"A{n}"] - 1).max()) for n in range(4)))
    assert all(finer < 0.5 * coarser for coarser, finer in pairwise(errors))
    assert errors[0] < 1e-3
    assert errors[-1] < 3e-8


def phasor_of(state: xr.Dataset, n: int) -> complex:
    """Return a harmonic of the reading, turned to the phase of the first."""
    return complex(state[f"A{n}"] * np.exp(1j * (n * state["phi1"] - state[f"phi{n}"])))


@pytest.mark.parametrize("key", ["dmt", "dmt-viscous", "capillary", "jkr", "maugis"])
@pytest.mark.parametrize("lever", ["one", "three"])
def test_energy_balances(key: str, lever: str) -> None:
    """What the drive gives is what lever and sample lose, harmonic by harmonic and as a whole."""
    probe = small_lever() if lever == "one" else three_modes(1.0, kind="displacement")
    Z = 0.6 * probe.drive.free_amplitude
    state = settle(probe, material(key), Z=Z, n_max=60, tolerance=1e-13)
    assert int(state["state"]) == integrate.DONE
    assert float(state["indentation"]) > 0.0
    force = (state["F_cons"] - 1j * state["F_diss"]).values
    drive = excitation(probe)
    given = lost = 0.0
    for n in range(1, 61):
        f = force[n]
        for mode in probe.cantilever.modes:
            x = n * probe.drive.frequency / mode.frequency
            # the drive as the reading sees it: time counted from the phase of the first harmonic
            push = 0.0 + 0j
            if n == 1:
                raw = phase_offset(probe, drive) - float(state["phi1"])
                push = drive.force * np.exp(-1j * raw)
            q = (f + push) / mode.stiffness / (1 - x**2 + 1j * x / mode.quality_factor)
            given += np.pi * n * (push * np.conj(q)).imag
            lost += np.pi * n * mode.stiffness * x / mode.quality_factor * abs(q) ** 2
    sample_loss = float(state["dissipation"])
    assert given == pytest.approx(lost + sample_loss, rel=1e-8, abs=0)
    if key == "dmt":
        assert abs(sample_loss) < 1e-9 * given
    elif key == "capillary":
        assert sample_loss == pytest.approx(ADHESION * RUPTURE, rel=1e-7)
    else:
        assert sample_loss > 1e-4 * given


@pytest.mark.parametrize("key", list(MATERIALS))
def test_force_of_the_state_is_what_is_read_from_it(key: str) -> None:
    probe = three_modes(0.99, static_stiffness=25.2, static_slope_ratio=1.0897)
    state = settle(probe, material(key), Z=25e-9, tolerance=1e-12)
    assert int(state["state"]) == integrate.DONE
    force = to_force_harmonics(
        state[["A0", "A1", "phi1", "A2", "phi2", "A3", "phi3"]].expand_dims("p"), probe
    )
    for name in ("F_cons", "F_diss"):
        np.testing.assert_allclose(force[name].isel(p=0), state[name], atol=2e-8 * float(state["peak_force"]))
    first = float(energy(force, probe)["virial"][0])
    assert first == pytest.approx(float(state["virial"]), rel=1e-6)


def test_three_modes_equal_three_oscillators_in_plain_python() -> None:
    probe = three_modes(1.0, kind="displacement")
    E = float(effective_modulus(MODULUS, 0.3, probe.tip.modulus, probe.tip.poisson_ratio))
    w, modal = probe.drive.frequency, excitation(probe).modal.real
    r = np.array([mode.frequency for mode in probe.cantilever.modes]) / w
    Q = np.array([mode.quality_factor for mode in probe.cantilever.modes])
    k = np.array([mode.stiffness for mode in probe.cantilever.modes])
    Z = 30e-9

    def right_side(theta: float, y: np.ndarray) -> np.ndarray:
        d = Z + y[:3].sum() * 1e-9
        F = 4 / 3 * E * math.sqrt(RADIUS) * max(-d, 0.0) ** 1.5
        a = r**2 * ((F / k + modal * math.cos(theta)) * 1e9 - y[:3]) - r / Q * y[3:]
        return np.concatenate([y[3:], a])

    start = free_motion(probe)
    y = np.concatenate([start.deflection, start.velocity]) * 1e9
    y = solve_ivp(right_side, (0, 4 * np.pi), y, method="DOP853", rtol=1e-11, atol=1e-11, max_step=0.01).y[
        :, -1
    ]
    end = follow(probe, material("hertz"), Z, start, 2, 1e-12)
    ours = np.concatenate([end.deflection, end.velocity]) * 1e9
    np.testing.assert_allclose(ours, y, rtol=0, atol=2e-8)


def test_modes_that_were_left_out_give_way() -> None:
    """A lever of one mode with a soft rest is what a mode far above makes of it."""
    stiff, rest = Mode(26.0, 303e3, 60.0), 1 / 25.0 - 1 / 26.0
    high = Mode(1 / rest, 60 * 303e3, 1.0)
    drive = Drive(303e3, 40e-9)
    short = Probe(Cantilever((stiff,), static_stiffness=25.0), drive, Tip(RADIUS))
    full = Probe(Cantilever((stiff, high)), drive, Tip(RADIUS))
    for key in ("hertz", "dmt", "capillary"):
        one, two = (settle(probe, material(key), Z=25e-9, tolerance=1e-11) for probe in (short, full))
        assert int(one["state"]) == int(two["state"]) == integrate.DONE
        rigid = settle(Probe(Cantilever((stiff,)), drive, Tip(RADIUS)), material(key), Z=25e-9)
        effect = float(rigid["A0"] - two["A0"])
        assert float(one["A0"] - two["A0"]) == pytest.approx(0.0, abs=0.05 * abs(effect))
        assert float(one["A1"]) == pytest.approx(float(two["A1"]), rel=3e-4)


@pytest.mark.parametrize("key", list(MATERIALS))
def test_a_contact_may_be_far_stiffer_than_the_modes_left_out(key: str) -> None:
    """A soft lever on a hard sample: the gap barely moves in contact, and all that is left is to find it."""
    soft = Cantilever((Mode(0.4, 303e3, 80.0), Mode(16.0, 1.9e6, 100.0)), static_stiffness=0.36)
    probe = Probe(soft, Drive(303e3, 15e-9), Tip(RADIUS))
    hard = {} if key == "maugis" else {"adhesion": 0.3e-9}
    of = sample(
        key, poisson_ratio=0.3, modulus=50e9, **{**MATERIALS[key], **(hard if key != "hertz" else {})}
    )
    state = settle(probe, of, Z=9e-9, tolerance=1e-9)
    assert int(state["state"]) in (integrate.DONE, integrate.NOT_SETTLED)
    assert float(state["indentation"]) < 0.3e-9
    force = to_force_harmonics(state[["A0", "A1", "phi1", "A2", "phi2"]].expand_dims("p"), probe)
    if int(state["state"]) == integrate.DONE:
        np.testing.assert_allclose(
            force["F_cons"].isel(p=0), state["F_cons"][:3], atol=1e-4 * float(state["peak_force"])
        )


def test_shooting_and_following_end_in_the_same_state() -> None:
    probe = small_lever()
    for key in MATERIALS:
        fast, slow = (
            settle(probe, material(key), Z=np.array([8e-9, 15e-9]), method=method, tolerance=1e-12)
            for method in ("shooting", "relax")
        )
        for n in range(4):
            np.testing.assert_allclose(fast[f"A{n}"], slow[f"A{n}"], atol=1e-9 * 20e-9)
        assert int(fast["periods"].max()) < int(slow["periods"].max())


def coexistence() -> tuple[Probe, Sample]:
    """Return a probe and a material with an attractive and a repulsive state from 35 to 37 nm."""
    probe = Probe(Cantilever.single_mode(26.0, 303e3, 456.0), Drive(303e3, 40e-9), Tip(RADIUS))
    return probe, sample("dmt", modulus=1e9, poisson_ratio=0.3, adhesion=10e-9)


def along(probe: Probe, of: Sample, *heights: float) -> xr.Dataset:
    """Return the state at the last height, from the free motion over those before it."""
    motion = free_motion(probe)
    for Z in heights:
        state = settle(probe, of, Z=Z, start=motion)
        motion = motion_of(state)
    return state


APPROACH = (40.8e-9, 39.2e-9, 37.6e-9, 36e-9)
RETRACTION = (20e-9, 24e-9, 28e-9, 32e-9, 36e-9)


def test_two_states_coexist() -> None:
    """At one height, from outside the attractive state, from contact the repulsive one."""
    probe, of = coexistence()
    out, hard = along(probe, of, *APPROACH), along(probe, of, *RETRACTION)
    assert float(out["F_cons"].sel(harmonic=1)) > 0.0
    assert float(hard["F_cons"].sel(harmonic=1)) < 0.0
    for state in (out, hard):
        multipliers, status = floquet_multipliers(probe, of, Z=36e-9, motion=motion_of(state))
        assert status == integrate.DONE
        assert abs(multipliers).max() < 1.0


def test_no_state_within_the_periods_allowed_is_said() -> None:
    state = settle(section_3_probe(), material("dmt"), Z=40e-9, method="relax", max_periods=20)
    assert int(state["state"]) == integrate.NOT_SETTLED
    assert np.isfinite(float(state["A1"]))


def test_broken_numbers_end_with_a_status_not_a_hang() -> None:
    start = Motion(np.array([math.nan]), np.array([0.0]), np.array(False))
    state = settle(section_3_probe(), material("dmt"), Z=40e-9, start=start)
    assert int(state["state"]) == integrate.NOT_FINITE
    assert math.isnan(float(state["A1"]))
    far = Motion(np.array([-1e3]), np.array([1e30]), np.array(False))
    assert int(settle(section_3_probe(), material("dmt"), Z=40e-9, start=far)["state"]) != integrate.DONE


@pytest.mark.parametrize("key", list(MATERIALS))
@pytest.mark.parametrize("speed", [0.0, 1e-9, -1e-9])
def test_a_start_on_a_gap_where_the_force_changes_finds_its_side(key: str, speed: float) -> None:
    """Exactly at each such gap, moving in, out, or at rest: the motion is that from a hair to one side."""
    probe, Z = small_lever(), 3e-9
    records = laws(probe, material(key))
    for level in records.levels[0, : records.kinks[0]]:
        ends = []
        for hair in (-1e-16, 0.0, 1e-16):
            start = Motion(np.array([level - Z + hair]), np.array([speed]), np.array(False))
            ends.append(float(follow(probe, material(key), Z, start, 2, 1e-11).deflection[0]))
        assert min(abs(ends[1] - ends[0]), abs(ends[1] - ends[2])) < 1e-4 * 20e-9


# --- stability --------------------------------------------------------------------------------------------------


def test_multipliers_of_a_free_lever_are_those_of_its_modes() -> None:
    probe = three_modes(0.99)
    multipliers, status = floquet_multipliers(
        probe, material("hertz"), Z=1e-6, motion=free_motion(probe), tolerance=1e-13
    )
    assert status == integrate.DONE
    r = np.array([mode.frequency for mode in probe.cantilever.modes]) / probe.drive.frequency
    Q = np.array([mode.quality_factor for mode in probe.cantilever.modes])
    rates = -r / (2 * Q) + 1j * r * np.sqrt(1 - 1 / (4 * Q**2))
    expected = np.exp(2 * np.pi * np.concatenate([rates, np.conj(rates)]))
    for value in expected:
        assert abs(multipliers - value).min() < 1e-6


@pytest.mark.parametrize("key", ["hertz", "dmt-contact", "dmt-linear", "dmt"])
def test_a_conservative_contact_keeps_the_volume_of_phase_space(key: str) -> None:
    """Liouville: the product of the multipliers is that of the free lever, whatever the conservative force."""
    probe = small_lever()
    state = settle(probe, material(key), Z=np.array([6e-9, 12e-9]))
    multipliers, _ = floquet_multipliers(probe, material(key), Z=state["Z"], motion=motion_of(state))
    product = np.exp(-2 * np.pi / (1.02 * 30.0))
    np.testing.assert_allclose(np.prod(multipliers, axis=-1), product, rtol=1e-5)


def test_newton_does_not_stay_in_a_state_that_does_not_last() -> None:
    """Starts from between the two states, where a third one is unstable."""
    probe, of = coexistence()
    ends = [motion_of(along(probe, of, *heights)) for heights in (APPROACH, RETRACTION)]
    found = set()
    for share in np.linspace(0.0, 1.0, 9):
        q, v = ((1 - share) * one + share * two for one, two in zip(ends[0][:2], ends[1][:2], strict=True))
        state = settle(probe, of, Z=36e-9, start=Motion(q, v, np.array(False)))
        assert int(state["state"]) == integrate.DONE
        multipliers, _ = floquet_multipliers(probe, of, Z=36e-9, motion=motion_of(state))
        assert abs(multipliers).max() < 1.0
        found.add(float(state["F_cons"].sel(harmonic=1)) > 0.0)
    assert found == {True, False}


# --- sweeps -----------------------------------------------------------------------------------------------------


def test_a_sweep_far_away_reads_the_free_motion() -> None:
    probe = three_modes(0.98)
    readings, end = sweep(
        probe, material("dmt"), z=np.linspace(2.0e-6, 1.9e-6, 5), speed=1e-2, bandwidth=5e3, tolerance=1e-9
    )
    np.testing.assert_allclose(readings["A1"], 40e-9, rtol=1e-6)
    np.testing.assert_allclose(readings["phi1"], far_phase(probe), atol=1e-6)
    assert end.filtered is not None


def test_a_slow_sweep_reads_the_states() -> None:
    probe = small_lever()
    of = material("dmt-viscous")
    z = np.linspace(14e-9, 13.9e-9, 3)
    readings, _ = sweep(probe, of, z=z, speed=2e-7, bandwidth=2e4, settle_periods=400)
    states = settle(probe, of, Z=z)
    # four time constants of the filter late, and those of the lever
    for name in ("A1", "phi1", "A2", "F_cons", "indentation", "dissipation"):
        np.testing.assert_allclose(readings[name], states[name].values, rtol=3e-4)


def test_a_sweep_goes_on_where_another_ended() -> None:
    probe = small_lever()
    of = material("capillary")
    settings: dict[str, Any] = {"speed": 2e-3, "bandwidth": 1e4, "tolerance": 1e-10}
    period = 2e-3 / (1.02 * 300e3)  # travel of the base
    middle, last = 25e-9 - 200 * period, 25e-9 - 400 * period
    whole, _ = sweep(probe, of, z=[25e-9, middle, last], **settings)
    first, end = sweep(probe, of, z=[25e-9, middle], **settings)
    second, _ = sweep(probe, of, z=[middle, last], start=end, **settings)
    # resting for no period, it begins with the period that passes the first height
    np.testing.assert_allclose(whole["A1"][1], first["A1"][1], rtol=1e-12)
    np.testing.assert_allclose(whole["A1"][2], second["A1"][1], rtol=1e-3)


def test_approach_and_retraction_differ_where_states_coexist() -> None:
    probe, of = coexistence()
    z = np.linspace(42e-9, 30e-9, 49)
    settings: dict[str, Any] = {"speed": 1e-6, "bandwidth": 2e4, "tolerance": 1e-7}
    down, end = sweep(probe, of, z=z, **settings)
    up, _ = sweep(probe, of, z=z[::-1], start=end, **settings)
    assert down.attrs["travel_per_memory"] < 0.5e-9
    apart = abs(down["A1"] - up["A1"].sel(z=down["z"]))
    assert float(apart.sel(z=36e-9, method="nearest")) > 1e-9
    assert float(apart.isel(z=0)) < 0.05e-9
    assert float(down["F_cons"].sel(harmonic=1, z=36e-9, method="nearest")) > 0.0
    assert float(up["F_cons"].sel(harmonic=1, z=36e-9, method="nearest")) < 0.0


def test_the_filter_has_its_bandwidth() -> None:
    for order in (1, 4):
        decay = filter_decay(1e3, order, 300e3)
        z = np.exp(2j * np.pi * 1e3 / 300e3)
        gain = abs((1 - decay) / (1 - decay / z)) ** order
        assert gain == pytest.approx(1 / math.sqrt(2), rel=2e-3)


def test_maps_of_materials_are_swept_and_settled_point_by_point() -> None:
    probe = small_lever()
    both = sample("dmt", modulus=np.array([0.5e9, 1e9]), poisson_ratio=0.3, adhesion=ADHESION)
    states = settle(probe, both, Z=10e-9)
    assert states["A1"].shape == (2,)
    single = settle(probe, material("dmt"), Z=10e-9)
    assert float(states["A1"][1]) == float(single["A1"])
    readings, end = sweep(probe, both, z=[20e-9, 19.9e-9], speed=1e-3, bandwidth=1e4)
    assert readings["A1"].shape == (2, 2)
    assert end.deflection.shape == (2, 1)


# --- arguments --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"method": "magic"}, "unknown method"),
        ({"tolerance": 0.0}, "tolerance"),
        ({"Z": math.nan}, "heights"),
        ({"Z": np.zeros((3, 1, 2))}, "do not fit"),
        ({"start": Motion(np.zeros(2), np.zeros(2), np.array(False))}, "start"),
    ],
)
def test_settle_refuses_what_it_cannot_do(changes: dict[str, Any], message: str) -> None:
    three = sample("hertz", modulus=np.array([1e9, 2e9, 3e9]), poisson_ratio=0.3)
    with pytest.raises(OvertoneError, match=message):
        settle(small_lever(), three, **{"Z": 10e-9, **changes})


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"z": [1e-8, 2e-8, 1e-8]}, "one way"),
        ({"z": [1e-8]}, "one way"),
        ({"speed": 0.0}, "speed"),
        ({"bandwidth": -1.0}, "bandwidth"),
        ({"order": 0}, "stages"),
    ],
)
def test_sweep_refuses_what_it_cannot_do(changes: dict[str, Any], message: str) -> None:
    arguments = {"z": [2e-8, 1e-8], "speed": 1e-6, "bandwidth": 1e4, **changes}
    with pytest.raises(OvertoneError, match=message):
        sweep(small_lever(), material("hertz"), **arguments)


def test_a_filter_of_another_lock_in_is_refused() -> None:
    _, end = sweep(small_lever(), material("hertz"), z=[30e-9, 29.9e-9], speed=1e-3, bandwidth=1e4)
    with pytest.raises(OvertoneError, match="another lock-in"):
        sweep(
            small_lever(), material("hertz"), z=[30e-9, 31e-9], speed=1e-3, bandwidth=1e4, order=2, start=end
        )


def test_a_periodic_force_gives_its_state() -> None:
    """The state under the force of a settled motion is that motion."""
    probe, of = small_lever(), material("hertz")
    state = settle(probe, of, Z=12e-9, n_max=40, tolerance=1e-12)
    raw = phase_offset(probe, excitation(probe)) - float(state["phi1"])
    force = (state["F_cons"] - 1j * state["F_diss"]).values * np.exp(1j * np.arange(41) * raw)
    motion = motion_under(probe, force)
    np.testing.assert_allclose(motion.deflection, state["q"], atol=1e-6 * 20e-9)
    assert memory_of(probe) == pytest.approx(30 * 1.02 / math.pi)
    assert law.LEVELS == 4
