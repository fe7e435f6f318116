"""Modes of a beam against finite elements and against the exact solution at a given frequency."""

import math
import warnings
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from scipy.linalg import eigh
from scipy.optimize import brentq

from overtone.beam import beam_modes, warn_of_internal_resonance
from overtone.errors import ProbeError, ResonanceWarning
from overtone.harmonics import read_receptance, tip_receptance
from overtone.probe import Cantilever, Detector, Drive, Mode, Probe

# Tip, spot, mass of the tip over mass of the beam.
LEVERS = [(1.0, 1.0, 0.0), (0.95, 0.9, 0.0), (0.9, 0.95, 0.04), (1.0, 0.7, 0.3), (0.6, 1.0, 1.5)]


def lever(tip: float, spot: float, tip_mass: float, count: int = 3, **options: Any) -> Cantilever:
    """Return a beam with E I / L^3 = 1, f_1 = 1 and next to no damping."""
    return beam_modes(
        static_stiffness=3.0 / tip**3,
        frequency=1.0,
        quality_factor=1e12,
        count=count,
        tip_position=tip,
        spot_position=spot,
        tip_mass=tip_mass,
        **options,
    )


@dataclass
class Elements:
    """The same beam as 160 cubic elements with E I = L = m_beam = 1."""

    squared: np.ndarray
    stiffness: np.ndarray
    slope: np.ndarray
    participation: np.ndarray
    static_stiffness: float
    static_slope: float

    @classmethod
    def of(cls, tip: float, spot: float, tip_mass: float) -> "Elements":
        marks = sorted({0.0, tip, spot, 1.0})
        parts = [
            np.linspace(start, end, max(2, round(160 * (end - start))), endpoint=False)
            for start, end in pairwise(marks)
        ]
        x = np.append(np.concatenate(parts), 1.0)
        K, M = np.zeros((2, 2 * len(x), 2 * len(x)))
        for i, h in enumerate(np.diff(x)):
            at = slice(2 * i, 2 * i + 4)
            K[at, at] += [
                [12 / h**3, 6 / h**2, -12 / h**3, 6 / h**2],
                [6 / h**2, 4 / h, -6 / h**2, 2 / h],
                [-12 / h**3, -6 / h**2, 12 / h**3, -6 / h**2],
                [6 / h**2, 2 / h, -6 / h**2, 4 / h],
            ]
            M[at, at] += (h / 420) * np.array(
                [
                    [156, 22 * h, 54, -13 * h],
                    [22 * h, 4 * h**2, 13 * h, -3 * h**2],
                    [54, 13 * h, 156, -22 * h],
                    [-13 * h, -3 * h**2, -22 * h, 4 * h**2],
                ]
            )
        tip_at, spot_at = (2 * int(np.argmin(abs(x - mark))) for mark in (tip, spot))
        M[tip_at, tip_at] += tip_mass
        rigid = np.tile([1.0, 0.0], len(x))  # the base moves every node alike
        load = M @ rigid
        # Of M against K, because rounding then spares the lowest modes.
        size = len(K) - 2
        inverse, shapes = eigh(M[2:, 2:], K[2:, 2:], subset_by_index=[size - 5, size - 1])
        squared, shapes = 1 / inverse[::-1], shapes[:, ::-1] / np.sqrt(inverse[::-1])
        at_tip = shapes[tip_at - 2]
        bend = np.linalg.solve(K[2:, 2:], np.eye(size)[tip_at - 2])
        return cls(
            squared=squared,
            stiffness=squared / at_tip**2,
            slope=shapes[spot_at - 1] / at_tip,
            participation=at_tip * (load[2:] @ shapes),
            static_stiffness=1 / bend[tip_at - 2],
            static_slope=bend[spot_at - 1] / bend[tip_at - 2],
        )


@pytest.mark.parametrize(("tip", "spot", "tip_mass"), LEVERS)
def test_modes_are_those_of_finite_elements(tip: float, spot: float, tip_mass: float) -> None:
    beam, elements = lever(tip, spot, tip_mass, count=5), Elements.of(tip, spot, tip_mass)
    ratios = np.sqrt(elements.squared / elements.squared[0])
    slopes = elements.slope / elements.slope[0]
    np.testing.assert_allclose([m.frequency for m in beam.modes], ratios, rtol=1e-6)
    np.testing.assert_allclose([m.stiffness for m in beam.modes], elements.stiffness, rtol=1e-5)
    np.testing.assert_allclose([m.slope_ratio for m in beam.modes], slopes, rtol=1e-5)
    participation = [m.base_participation for m in beam.modes]
    np.testing.assert_allclose(participation, elements.participation, rtol=1e-5)
    assert beam.static_stiffness == pytest.approx(elements.static_stiffness, rel=1e-6, abs=0)
    static = elements.static_slope / elements.slope[0]
    assert beam.static_slope_ratio == pytest.approx(static, rel=1e-6, abs=0)


def test_the_uniform_beam_has_its_known_numbers() -> None:
    beam = lever(1.0, 1.0, 0.0)
    known = {
        "stiffness": [1.0302, 40.46, 317.2],
        "frequency": [1, 6.267, 17.55],
        "slope": [1.3765, 4.7808, 7.8487],
    }
    assert beam.static_stiffness == pytest.approx(3.0)
    for mode, k, f, s in zip(beam.modes, *known.values(), strict=True):
        assert mode.stiffness / 3.0 == pytest.approx(k, rel=2e-4, abs=0)
        assert mode.frequency == pytest.approx(f, rel=2e-4, abs=0)
        assert mode.slope_ratio == pytest.approx(s / known["slope"][0], rel=5e-5, abs=0)
    # s_1 itself: the static slope at the end is 3/2 of the displacement.
    assert 1.5 / beam.static_slope_ratio == pytest.approx(1.3765, rel=5e-5, abs=0)
    assert beam.static_slope_ratio == pytest.approx(1.0897, rel=5e-5, abs=0)
    # Clamped and free: cos lambda cosh lambda = -1, which is hit here to rounding.
    root = brentq(lambda z: math.cos(z) + 1 / math.cosh(z), 1, 3, xtol=1e-15)
    assert beam.modes[0].stiffness == pytest.approx(root**4 / 4, rel=1e-12, abs=0)


TABLE = [
    # tip, spot, tip mass, A0 slope, A2 slope, A3 slope, A2 displacement
    (1.0, 1.0, 0.0, 1.1226, 0.6012, -0.196, 0.9006),
    (1.0, 0.9, 0.0, 1.113, 0.631, -0.116, 0.9006),
    (0.95, 0.95, 0.0, 1.088, 0.710, 0.119, 0.938),
    (0.93, 0.93, 0.0, 1.075, 0.753, 0.243, 0.951),
    (1.0, 1.0, 0.05, 1.095, 0.690, 0.066, 0.932),
]


@pytest.mark.parametrize("count", [3, 20])
@pytest.mark.parametrize(("tip", "spot", "tip_mass", "A0", "A2", "A3", "A2_displacement"), TABLE)
def test_what_an_optical_lever_reads_over_the_single_mode_prediction(
    tip: float,
    spot: float,
    tip_mass: float,
    A0: float,
    A2: float,
    A3: float,
    A2_displacement: float,
    count: int,
) -> None:
    beam = lever(tip, spot, tip_mass, count)
    probe = Probe(beam, Drive(1.0, 1e-8), detector=Detector("slope"))
    n = np.array([0.0, 2.0, 3.0])
    single_mode = 1 / (beam.modes[0].stiffness * (1 - n**2))
    # Three modes and the static answer are as good as twenty to 4e-4.
    slack = 5.1e-4 if count == 20 else 1e-3
    np.testing.assert_allclose(read_receptance(probe, n) / single_mode, [A0, A2, A3], rtol=0, atol=slack)
    displacement = tip_receptance(beam, n) / single_mode
    assert displacement[1].real == pytest.approx(A2_displacement, rel=0, abs=slack)


@dataclass
class ExactBeam:
    """Displacement and slope at one frequency, from the values at the clamp: no modes at all."""

    tip: float
    tip_mass: float

    def conditions(self, z: float) -> np.ndarray:
        """Return moment and shear at the end and the jump at the tip for M_0, Q_0 and the jump."""
        a, mu = self.tip, self.tip_mass
        return np.array(
            [
                [bend(z, 1, 2, 2), bend(z, 1, 3, 2), bend(z, 1 - a, 3, 2)],
                [bend(z, 1, 2, 3), bend(z, 1, 3, 3), bend(z, 1 - a, 3, 3)],
                [-mu * z**4 * bend(z, a, 2, 0), -mu * z**4 * bend(z, a, 3, 0), 1.0],
            ]
        )

    def first_root(self) -> float:
        """Return lambda_1, where the conditions have a solution without a force."""
        return float(brentq(lambda z: np.linalg.det(self.conditions(z)), 0.3, 2.0, xtol=1e-14))

    def response(self, z: float, x: float, order: int, force: float = 0.0, base: float = 0.0) -> float:
        """Return a derivative of the total displacement at x under a force at the tip and a moving base."""
        a, mu = self.tip, self.tip_mass
        right = [
            -base * bend(z, 1, 0, 2),
            -base * bend(z, 1, 0, 3),
            force + mu * z**4 * base * bend(z, a, 0, 0),
        ]
        moment, shear, jump = np.linalg.solve(self.conditions(z), right)
        far = jump * bend(z, x - a, 3, order) if x > a else 0.0
        clamp = base * bend(z, x, 0, order) + moment * bend(z, x, 2, order) + shear * bend(z, x, 3, order)
        return float(clamp + far)


def bend(z: float, x: float, start: int, order: int) -> float:
    """Return a derivative of the solution whose derivative ``start`` alone is 1 at x = 0."""
    # sum of (z x)^(4 m + start - order) / (...)!, written with cosh, sinh, cos, sin
    family = (start - order) % 4
    growing, waving = (
        (math.cosh, math.cos),
        (math.sinh, math.sin),
        (math.cosh, lambda s: -math.cos(s)),
        (math.sinh, lambda s: -math.sin(s)),
    )[family]
    return 0.5 * (growing(z * x) + waving(z * x)) * z ** (order - start)


@pytest.mark.parametrize(("tip", "spot", "tip_mass"), LEVERS)
@pytest.mark.parametrize("ratio", [0.5, 2.0, 3.0, 8.0])
def test_the_modal_sum_is_the_exact_answer_at_any_frequency(
    tip: float, spot: float, tip_mass: float, ratio: float
) -> None:
    beam, exact = lever(tip, spot, tip_mass, count=20), ExactBeam(tip, tip_mass)
    probe = Probe(beam, Drive(1.0, 1e-8), detector=Detector("slope"))
    first = exact.first_root()
    z = first * math.sqrt(ratio)
    receptance = exact.response(z, tip, 0, force=1.0)
    assert tip_receptance(beam, ratio).real == pytest.approx(receptance, rel=1e-6, abs=1e-6)
    # Slope in units of the slope of the first mode per displacement of the tip.
    mode = lambda x, order: exact.response(first * (1 - 1e-7), x, order, force=1.0)  # noqa: E731
    reading = exact.response(z, spot, 1, force=1.0) * mode(tip, 0) / mode(spot, 1)
    assert read_receptance(probe, ratio).real == pytest.approx(reading, rel=1e-5, abs=1e-5)
    # A base that moves by 1: what the tip does relative to it, with the weights of the modes.
    relative = exact.response(z, tip, 0, base=1.0) - 1.0
    x = np.array([ratio / mode.frequency for mode in beam.modes])
    modal = np.sum([m.base_participation for m in beam.modes] * x**2 / (1 - x**2))
    assert modal == pytest.approx(relative, rel=1e-5, abs=1e-5)


@pytest.mark.parametrize(("tip", "spot", "tip_mass"), LEVERS)
def test_sum_rules(tip: float, spot: float, tip_mass: float) -> None:
    beam = lever(tip, spot, tip_mass, count=20)
    k = np.array([mode.stiffness for mode in beam.modes])
    s = np.array([mode.slope_ratio for mode in beam.modes])
    assert np.sum(1 / k) == pytest.approx(1 / beam.static_stiffness, rel=2e-5, abs=0)
    # Nothing lies above the exact sum, and what is left shrinks as 1/lambda^3.
    assert np.sum(1 / k) < 1 / beam.static_stiffness
    assert np.sum(s / k) == pytest.approx(beam.static_slope_ratio / beam.static_stiffness, rel=2e-3, abs=0)
    # The modes carry the whole mass between them: Gamma_j^2 m_j adds up to beam and tip.
    masses = (
        k
        / (np.array([mode.frequency for mode in beam.modes]) * ExactBeam(tip, tip_mass).first_root() ** 2)
        ** 2
    )
    carried = np.cumsum(np.array([mode.base_participation for mode in beam.modes]) ** 2 * masses)
    assert 0.975 * (1 + tip_mass) < carried[-1] < 1 + tip_mass


def test_twenty_modes_keep_their_digits() -> None:
    beam = lever(1.0, 1.0, 0.0, count=20)
    # Every mode of the bare beam has a quarter of its mass at the end.
    squared = np.array([mode.frequency**2 for mode in beam.modes])
    k = np.array([mode.stiffness for mode in beam.modes])
    np.testing.assert_allclose(k / squared, k[0], rtol=1e-11)


@pytest.mark.parametrize("given", ["stiffness", "static_stiffness"])
def test_the_stiffness_that_was_given_is_kept(given: str) -> None:
    beam = beam_modes(frequency=75e3, quality_factor=200, tip_position=0.94, tip_mass=0.03, **{given: 2.8})
    kept = beam.modes[0].stiffness if given == "stiffness" else beam.static_stiffness
    assert kept == pytest.approx(2.8, rel=1e-12, abs=0)
    assert beam.modes[0].stiffness > beam.static_stiffness
    assert beam.modes[0].frequency == 75e3
    assert beam.modes[0].quality_factor == 200


def test_the_spot_is_the_tip_unless_given() -> None:
    given = {"stiffness": 2.8, "frequency": 75e3, "quality_factor": 200, "tip_position": 0.94}
    assert beam_modes(**given) == beam_modes(**given, spot_position=0.94)
    assert beam_modes(**given) != beam_modes(**given, spot_position=1.0)


def test_damping_rates_grow_as_the_root_of_frequency_unless_told() -> None:
    given = {"stiffness": 40.0, "frequency": 3e5, "quality_factor": 400.0}
    modes = beam_modes(**given).modes
    rates = [mode.frequency / mode.quality_factor for mode in modes]
    assert rates[1] / rates[0] == pytest.approx(math.sqrt(6.26689), rel=1e-5, abs=0)
    told = beam_modes(**given, higher_quality_factors=[700.0, 500.0]).modes
    assert [mode.quality_factor for mode in told] == [400.0, 700.0, 500.0]


def test_a_measured_second_mode_keeps_the_mass_of_the_beam() -> None:
    given = {"stiffness": 26.0, "frequency": 3e5, "quality_factor": 400.0, "count": 2}
    plain, measured = beam_modes(**given), beam_modes(**given, higher_frequencies=[1.7e6])
    assert measured.modes[0] == plain.modes[0]
    assert measured.modes[1].frequency == 1.7e6
    masses = [lever.modes[1].stiffness / lever.modes[1].frequency ** 2 for lever in (plain, measured)]
    assert masses[0] == pytest.approx(masses[1], rel=1e-12, abs=0)
    assert measured.modes[1].slope_ratio == plain.modes[1].slope_ratio


@pytest.mark.parametrize(("ratio", "warned"), [(5.93, False), (5.96, True), (6.04, True), (6.07, False)])
def test_a_second_mode_at_the_sixth_harmonic_is_told(ratio: float, warned: bool) -> None:
    def make() -> None:
        beam_modes(
            stiffness=2.0, frequency=7e4, quality_factor=150, count=2, higher_frequencies=[ratio * 7e4]
        )

    if warned:
        with pytest.warns(ResonanceWarning, match=f"at {ratio:.3f} times the first: the sixth harmonic"):
            make()
    else:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            make()


def test_modes_from_elsewhere_can_be_asked_too() -> None:
    modes = (Mode(2.0, 7e4, 150.0), Mode(72.0, 4.2e5, 400.0))
    with pytest.warns(ResonanceWarning, match=r"6\.000") as caught:
        warn_of_internal_resonance(Cantilever(modes))
    assert len(caught) == 1
    warn_of_internal_resonance(Cantilever(modes[:1]))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"tip_position": 1.2}, ["tip_position = 1.2", "spot_position = 1.2"]),
        ({"tip_position": 0.0}, ["tip_position"]),
        ({"spot_position": float("nan")}, ["spot_position"]),
        ({"tip_mass": -0.1}, ["tip_mass"]),
        ({"tip_mass": 11.0}, ["tip_mass"]),
        ({"count": 0}, ["count"]),
        ({"count": 2.0}, ["count"]),
        ({"count": 21}, ["count"]),
        ({"frequency": 0.0, "quality_factor": -1.0}, ["frequency = 0.0", "quality_factor = -1.0"]),
        ({"stiffness": float("inf")}, ["stiffness = inf"]),
        ({"stiffness": None}, ["exactly one of stiffness"]),
        ({"static_stiffness": 39.0}, ["exactly one of stiffness"]),
        ({"higher_quality_factors": [1.0]}, ["has 1 values for 2 higher modes"]),
        ({"higher_frequencies": [1e6, 0.0]}, ["higher_frequencies are not all"]),
    ],
)
def test_impossible_beams_are_refused_with_every_fault(change: dict[str, Any], words: list[str]) -> None:
    with pytest.raises(ProbeError) as caught:
        beam_modes(**({"stiffness": 40.0, "frequency": 3e5, "quality_factor": 400.0} | change))
    assert all(word in str(caught.value) for word in words)


def test_a_tip_on_a_node_is_refused() -> None:
    # The second mode of a clamped and free beam, from the textbook: its node is at 0.7834.
    z = brentq(lambda z: math.cos(z) + 1 / math.cosh(z), 4.0, 5.0, xtol=1e-15)
    weight = (math.sinh(z) - math.sin(z)) / (math.cosh(z) + math.cos(z))

    def shape(x: float) -> float:
        return math.cosh(z * x) - math.cos(z * x) - weight * (math.sinh(z * x) - math.sin(z * x))

    node = brentq(shape, 0.7, 0.9, xtol=1e-15)
    assert node == pytest.approx(0.7834, rel=1e-4, abs=0)
    with pytest.raises(ProbeError, match="on a node of mode 2"):
        lever(node, 1.0, 0.0, count=2)
    assert len(lever(node, 1.0, 0.0, count=1).modes) == 1
    assert lever(node + 0.01, 1.0, 0.0, count=2).modes[1].stiffness > 1e3
