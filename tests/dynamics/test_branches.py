"""Every branch, its stability and its folds, against time integration that knows nothing of branches."""

import math
from typing import Any

import numpy as np
import pytest
import xarray as xr

import overtone as ot
from overtone.contact.sample import Sample
from overtone.dynamics.transient import Motion, motion_under, settle
from overtone.errors import OvertoneError
from overtone.probe import Cantilever, Detector, Drive, Mode, Probe, Tip

CASES = 50


def random_case(seed: int) -> tuple[Probe, Sample, float]:
    """Return a lever, a material and a height where it taps, attracted or not."""
    rng = np.random.default_rng(seed)
    free = float(rng.uniform(10e-9, 60e-9))
    probe = Probe.simple(
        stiffness=float(np.exp(rng.uniform(math.log(2.0), math.log(40.0)))),
        frequency=100e3,
        quality_factor=float(rng.uniform(20.0, 90.0)),
        radius=10e-9,
        drive_frequency=100e3 * float(rng.choice([1.0, rng.uniform(0.99, 1.01)])),
        free_amplitude=free,
    )
    modulus = float(np.exp(rng.uniform(math.log(2e7), math.log(3e9))))
    adhesion = float(rng.uniform(0.5e-9, 12e-9))
    model = ("dmt", "hertz", "dmt-viscous", "dmt-linear", "capillary")[seed % 5]
    parameters = {"modulus": modulus, "poisson_ratio": 0.35, "adhesion": adhesion}
    if model == "hertz":
        del parameters["adhesion"]
    if model == "dmt-viscous":
        parameters["viscosity"] = float(rng.uniform(1.0, 60.0))
    if model == "capillary":
        parameters["rupture_distance"] = 0.6e-9
    return probe, ot.sample(model, **parameters), free * float(rng.uniform(0.3, 1.02))


def motion_in_state(probe: Probe, states: xr.Dataset, branch: int) -> Motion:
    """Return a state as it is where the drive is largest."""
    state = states.isel(z=0, branch=branch)
    n = state["harmonic"].values
    force = (state["F_cons"] - 1j * state["F_diss"]).values * np.exp(-1j * n * float(state["phi1"]))
    return motion_under(probe, force)


def anywhere(probe: Probe) -> list[Motion]:
    """Return motions of many amplitudes and phases."""
    motions = []
    for part in (0.02, 0.3, 0.6, 0.9, 1.1):
        for phase in (0.3, 1.1, 1.9, 2.7):
            q = part * probe.drive.free_amplitude * np.exp(-1j * phase)
            motions.append(Motion(np.array([q.real]), np.array([-q.imag]), np.array(False)))
    return motions


@pytest.mark.parametrize("seed", range(CASES))
def test_time_integration_from_anywhere_ends_in_a_stable_branch(seed: int) -> None:
    """And the motion stays in every stable branch, and leaves every unstable one, when it starts beside it."""
    probe, material, Z = random_case(seed)
    free = probe.drive.free_amplitude
    states = ot.steady_states(probe, material, z=Z, n_max=20, keep=20)
    found = [k for k in range(states.sizes["branch"]) if int(states["state"][0, k]) == 0]
    assert found
    stable = [k for k in found if bool(states["stable"][0, k])]
    known = states["A1"].values[0]

    ends = [
        settle(probe, material, Z=Z, start=start, method="relax", tolerance=1e-8, goal=1e-6)
        for start in anywhere(probe)
    ]
    settled = [float(end["A1"]) for end in ends if int(end["state"]) == 0]
    assert settled
    for amplitude in settled:
        assert np.abs(known[stable] - amplitude).min() < 2e-4 * free, (amplitude, known[stable])

    for k in found:
        start = motion_in_state(probe, states, k)
        beside = start._replace(deflection=start.deflection + 1e-4 * free)
        end = settle(probe, material, Z=Z, start=beside, method="relax", tolerance=1e-9, goal=1e-7)
        stays = int(end["state"]) == 0 and abs(float(end["A1"]) - known[k]) < 2e-4 * free
        assert stays == (k in stable), (k, float(end["A1"]), known, states["stable"].values)


def lever(**changes: float) -> Probe:
    values = {
        "stiffness": 26.0,
        "frequency": 303e3,
        "quality_factor": 456.0,
        "radius": 10e-9,
        "drive_frequency": 303e3,
        "free_amplitude": 85e-9,
    }
    return Probe.simple(**{**values, **changes})


def polymer(**changes: float) -> Sample:
    return ot.sample("dmt", **{"modulus": 1e9, "poisson_ratio": 0.3, "adhesion": 20e-9, **changes})


def test_branches_meet_at_the_folds_and_end_there() -> None:
    """Close to a fold two branches differ as the root of the distance; beyond it both are gone."""
    z = np.linspace(75.5e-9, 76.2e-9, 701)
    states = ot.steady_states(lever(), polymer(), z=z)
    there = (states["state"] == 0).values
    upper, middle = 0, 2  # the attractive branch and the unstable one end at the same height
    first = int(np.argmax(there[:, upper]))
    assert first > 0
    assert first == int(np.argmax(there[:, middle]))
    gap = np.abs(states["A1"].values[:, upper] - states["A1"].values[:, middle])
    near, far = gap[first], gap[first + 300]
    steps = np.array([z[first] - z[first - 1], z[first + 300] - z[first - 1]])
    # within one step of the height of the fold, known to a step
    assert near < 1.05 * far * math.sqrt(steps[0] / steps[1])
    # a sweep beyond the fold goes elsewhere, one before it stays
    for k, stays in ((first + 4, True), (first - 4, False)):
        start = motion_in_state(lever(), ot.steady_states(lever(), polymer(), z=z[first], keep=10), 0)
        end = settle(lever(), polymer(), Z=z[k], start=start, method="relax", tolerance=1e-9, goal=1e-8)
        assert (abs(float(end["A1"]) - float(states["A1"][first, upper])) < 1e-9) == stays


def test_approach_curve_jumps_where_its_branch_ends() -> None:
    z = np.linspace(60e-9, 90e-9, 61)
    curve = ot.approach_curve(lever(), polymer(), z=z)
    jumps = {
        name: curve["z"].values[curve["jump"].sel(direction=name).values] for name in ("approach", "retract")
    }
    assert [round(float(x) * 1e9, 1) for x in jumps["approach"]] == [75.5]
    assert [round(float(x) * 1e9, 1) for x in jumps["retract"]] == [81.5]
    states = ot.steady_states(lever(), polymer(), z=curve["z"].values)
    # every point of the sweep is a stable state
    for direction in ("approach", "retract"):
        amplitude = curve["A1"].sel(direction=direction).values
        known = np.where(states["stable"].values, states["A1"].values, np.nan)
        assert np.nanmin(np.abs(known - amplitude[:, None]), axis=1).max() < 1e-15
    # phi1 passes 90 degrees down and back at different heights: hysteresis
    between = (curve["z"] > 76e-9) & (curve["z"] < 81e-9)
    apart = (curve["A1"].sel(direction="retract") - curve["A1"].sel(direction="approach")).values[between]
    assert (apart > 1e-9).all()


def test_a_slow_sweep_in_time_goes_through_the_same_states() -> None:
    """The lever and the filter lag behind the base: half the speed, half the difference."""
    probe = lever(quality_factor=40.0, free_amplitude=30e-9)
    material = polymer(adhesion=5e-9)
    z = np.linspace(20e-9, 33e-9, 27)
    steady = ot.approach_curve(probe, material, z=z, n_max=20)
    lags = []
    for speed in (8e-6, 4e-6):
        moving = ot.approach_curve(probe, material, z=z, method="transient", speed=speed)
        assert {"speed", "bandwidth"} <= set(moving.attrs)
        difference = (moving["A1"] - steady["A1"]).where(~steady["jump"] & (steady["z"] < 28e-9))
        # the amplitude is behind: too large on the way there, too small on the way back
        assert float(difference.sel(direction="approach").median()) > 0.0
        assert float(difference.sel(direction="retract").median()) < 0.0
        lags.append(float(np.abs(difference).median()))
    assert lags[0] < 0.3e-9
    assert lags[1] == pytest.approx(0.5 * lags[0], rel=0.05, abs=0)


def test_tip_and_base_drive_differ_as_the_quality_factor_falls() -> None:
    """The base moves too: with Q = 2 the gap is another one; with Q = 200 nobody sees it."""
    for Q, apart in ((2.0, True), (200.0, False)):  # the mean deflection tells: the base takes up the rest
        modes = Cantilever.single_mode(1.0, 20e3, Q)
        material = ot.sample("hertz", modulus=1e7, poisson_ratio=0.4)
        deep = [
            float(
                ot.steady_states(
                    Probe(modes, Drive(20e3, 20e-9, acts_on=acts_on), Tip(10e-9)), material, z=18e-9, n_max=20
                )["indentation"].max()
            )
            for acts_on in ("tip", "base")
        ]
        assert (abs(deep[0] - deep[1]) > 0.5e-9) == apart


@pytest.mark.parametrize("acts_on", ["tip", "base"])
@pytest.mark.parametrize("kind", ["displacement", "slope"])
def test_several_modes_any_drive_and_detector_against_time_integration(acts_on: str, kind: str) -> None:
    modes = (
        Mode(2.0, 70e3, 15.0, 1.0, 1.5660),
        Mode(2.0 * 6.267**2, 70e3 * 6.267, 60.0, 3.473, -0.8679),
        Mode(2.0 * 17.55**2, 70e3 * 17.55, 100.0, 5.702, 0.5089),
    )
    probe = Probe(Cantilever(modes), Drive(69.5e3, 25e-9, acts_on), Tip(10e-9), Detector(kind))
    material = ot.sample("dmt-viscous", modulus=3e8, poisson_ratio=0.4, adhesion=3e-9, viscosity=10.0)
    for Z in (12e-9, 20e-9):
        states = ot.steady_states(probe, material, z=Z, n_max=60, keep=3)
        best = int(np.nanargmax(np.where(states["stable"].values[0], states["A1"].values[0], np.nan)))
        state = states.isel(z=0, branch=best)
        end = settle(probe, material, Z=Z, tolerance=1e-11)
        assert int(end["state"]) == 0
        for name in ("A0", "A1", "A2", "A3"):
            assert float(state[name]) == pytest.approx(float(end[name]), rel=2e-4, abs=0), name
        for name in ("phi1", "phi2", "phi3"):
            off = (float(state[name]) - float(end[name]) + math.pi) % (2 * math.pi) - math.pi
            assert abs(off) < 1e-4, name
        for name in ("indentation", "peak_force", "dissipation", "contact_time"):
            assert float(state[name]) == pytest.approx(float(end[name]), rel=3e-3, abs=0), name
        difference = abs(state["F_cons"] - end["F_cons"]).max() / abs(end["F_cons"]).max()
        assert float(difference) < 2e-4


def test_arrays_of_materials_and_a_sequence_of_probes() -> None:
    moduli = np.array([5e7, 1e9])
    both = ot.steady_states(lever(), polymer(modulus=moduli), z=[40e-9, 70e-9], dims=("material",))
    assert both["A1"].dims == ("material", "z", "branch")
    for k, modulus in enumerate(moduli):
        one = ot.steady_states(lever(), polymer(modulus=modulus), z=[40e-9, 70e-9])
        expected, got = np.sort(one["A1"].values[1]), np.sort(both["A1"].values[k, 1])
        np.testing.assert_allclose(
            got[: np.isfinite(expected).sum()], expected[np.isfinite(expected)], rtol=1e-12
        )
    probes = ot.steady_states([lever(), lever(stiffness=10.0)], polymer(), z=70e-9)
    assert probes["A1"].dims == ("probe", "z", "branch")
    assert probes["stable"].dtype == bool


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"z": []}, "no heights"),
        ({"z": [[1e-9]]}, "no heights"),
        ({"z": math.nan}, "not finite"),
        ({"z": 80.0}, "out of reach"),
        ({"z": 80e-9, "n_max": 0}, "harmonics"),
        ({"z": 80e-9, "keep": 0}, "harmonics"),
    ],
)
def test_wrong_calls_are_named(arguments: dict[str, Any], message: str) -> None:
    for function in (ot.steady_states, ot.approach_curve):
        with pytest.raises(OvertoneError, match=message):
            function(lever(), polymer(), **arguments)


def test_more_wrong_calls() -> None:
    with pytest.raises(OvertoneError, match="unknown method"):
        ot.approach_curve(lever(), polymer(), z=50e-9, method="quick")
    with pytest.raises(OvertoneError, match="needs a speed"):
        ot.approach_curve(lever(), polymer(), z=[50e-9, 60e-9], method="transient")
    with pytest.raises(OvertoneError, match="no speed"):
        ot.approach_curve(lever(), polymer(), z=50e-9, speed=1e-7)
    with pytest.raises(OvertoneError, match="unphysical"):
        lever(quality_factor=-3.0)
    with pytest.raises(OvertoneError, match="unphysical"):
        lever(free_amplitude=0.0)
    with pytest.raises(OvertoneError, match="tip radius"):
        ot.steady_states(Probe(lever().cantilever, Drive(303e3, 85e-9)), polymer(), z=50e-9)
    relaxing = ot.sample(
        "sls", modulus=1e8, instantaneous_modulus=1e9, relaxation_time=1e-6, poisson_ratio=0.4
    )
    with pytest.raises(OvertoneError, match="cannot be simulated"):
        ot.steady_states(lever(), relaxing, z=50e-9)


def test_both_states_next_to_a_fold_in_deep_contact_are_found() -> None:
    """Of two states 0.6 nm apart one was once missed, and the other returned without a word."""
    probe = lever(
        stiffness=1.4204523,
        frequency=300e3,
        drive_frequency=300e3,
        quality_factor=386.924676,
        free_amplitude=53.294673e-9,
    )
    material = polymer(modulus=68.203103e6, adhesion=35.55781e-9)
    held = ot.hold_amplitude(probe, material, setpoint=0.31939095)
    states = ot.steady_states(probe, material, z=float(held["Z"]))
    assert float(np.nanmin(np.abs(states["A1"].values - float(held["A1"])))) < 1e-15
    assert int(states["stable"].sum()) == 2


def test_off_resonance_the_amplitude_exceeds_the_free_one_and_branches_are_still_found() -> None:
    """Above resonance a soft sample stiffens the lever towards the drive: A1 grows to 2.3 times A1far."""
    probe = lever(
        stiffness=30.0, frequency=3e5, drive_frequency=3.015e5, quality_factor=400.0, free_amplitude=50e-9
    )
    material = ot.sample("hertz", modulus=50e6, poisson_ratio=0.3)
    for part in (0.5, 0.7, 0.9):
        states = ot.steady_states(probe, material, z=part * 50e-9)
        end = settle(probe, material, Z=part * 50e-9, tolerance=1e-9, goal=1e-7, method="relax")
        assert float(end["A1"]) > 60e-9
        known = states["A1"].values[states["stable"].values]
        assert np.abs(known - float(end["A1"])).min() < 2e-3 * float(end["A1"])


def test_a_material_in_permanent_contact_is_held() -> None:
    probe = lever(
        stiffness=25.66,
        frequency=3e5,
        drive_frequency=3e5,
        quality_factor=58.0,
        radius=16.88e-9,
        free_amplitude=18.68e-9,
    )
    material = polymer(modulus=48.08e6, adhesion=4.065e-9)
    held = ot.hold_amplitude(probe, material, setpoint=0.25)
    assert int(held["state"]) == 0
    assert float(held["indentation"]) > 2.0 * float(held["A1"])
    end = settle(probe, material, Z=float(held["Z"]), tolerance=1e-10)
    assert float(end["A1"]) == pytest.approx(float(held["A1"]), rel=1e-3, abs=0)


def test_names_of_dimensions_and_empty_samples_are_checked() -> None:
    two = polymer(modulus=np.array([1e8, 1e9]))
    for dims in (("a", "b"), ("z",)):
        with pytest.raises(OvertoneError, match="names of dimensions"):
            ot.steady_states(lever(), two, z=50e-9, dims=dims)
    with pytest.raises(OvertoneError, match="no points"):
        ot.steady_states(lever(), polymer(modulus=np.empty(0)), z=50e-9)
    with pytest.raises(OvertoneError, match="not numbers"):
        ot.steady_states(lever(), polymer(), z="70 nm")
    with pytest.raises(OvertoneError, match="takes one material"):
        ot.approach_curve(lever(), two, z=[50e-9, 60e-9], method="transient", speed=1e-6)
    with pytest.raises(OvertoneError, match="do not rise"):
        ot.beam_modes(stiffness=40.0, frequency=3e5, quality_factor=400.0, count=2, higher_frequencies=[1e5])
