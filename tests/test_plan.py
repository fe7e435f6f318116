"""What an experiment will tell: physics that must hold, states that can be held, the choice and its figure."""

from dataclasses import replace

import numpy as np
import pytest
import xarray as xr
from matplotlib.patches import Rectangle

import overtone as ot
from overtone.errors import CalibrationError, InversionError, ObservablesError, OvertoneError, ProbeError
from overtone.instrument.calibration import Calibration
from overtone.instrument.noise import ORDINARY_NOISE, add_noise
from overtone.instrument.unknowns import NEUTRAL
from overtone.inversion.result import DETERMINED, MISSING_DATA
from overtone.planning.choice import best_choice, best_of_each
from overtone.planning.experiment import plan_experiment
from overtone.planning.held import FALLING, NO_REPULSIVE, UNSTABLE, USABLE
from overtone.planning.quality import QUALITIES, assumed_calibration, calibration_for
from overtone.plots.plan import plan_figure

READINGS = ["A0", "A1", "phi1", "A2", "phi2", "A3", "phi3"]
QUIET = {name: 1e-3 * sigma for name, sigma in ORDINARY_NOISE.items()}


def lever(free_amplitude: float = 94e-9, **changes: float) -> ot.Probe:
    values = {"stiffness": 16.4, "frequency": 161.8e3, "quality_factor": 287.0, "radius": 10e-9} | changes
    return ot.Probe.simple(drive_frequency=values["frequency"], free_amplitude=free_amplitude, **values)


@pytest.fixture(scope="module")
def polymer() -> ot.Sample:
    return ot.sample("dmt", modulus=100e6, poisson_ratio=0.45, adhesion=4e-9)


@pytest.fixture(scope="module")
def stiff() -> ot.Sample:
    return ot.sample("hertz", modulus=2e9, poisson_ratio=0.35)


@pytest.fixture(scope="module")
def plan(polymer: ot.Sample) -> xr.Dataset:
    """A plan with every kind of cell: determined, not, unstable, beside an attractive state."""
    return plan_experiment(
        lever(),
        polymer,
        setpoint=np.linspace(0.2, 0.8, 4),
        free_amplitude=[8e-9, 20e-9, 30e-9, 60e-9, 94e-9],
        calibration="careful",
        probes={"soft": lever(stiffness=2.0, frequency=70e3, quality_factor=150.0, radius=20e-9)},
    )


def one(probe: ot.Probe, sample: ot.Sample, setpoint: float = 0.3, **arguments: object) -> xr.Dataset:
    return plan_experiment(probe, sample, setpoint=setpoint, **arguments).squeeze()


def sources(probe: ot.Probe, **errors: float) -> Calibration:
    """Return a calibration in which only some unknowns are uncertain."""
    covariance = np.diag([error**2 for error in errors.values()])
    return Calibration(probe, probe.drive.free_amplitude, dict(NEUTRAL), tuple(errors), covariance)


# --- what it returns ------------------------------------------------------------------------------


def test_a_plan_has_every_lever_amplitude_and_setpoint(plan: xr.Dataset) -> None:
    assert dict(plan.sizes) == {"lever": 2, "free_amplitude": 5, "setpoint": 4}
    assert plan["lever"].values.tolist() == ["probe", "soft"]
    assert plan["free_amplitude"].attrs["units"] == "m"
    for name in ("modulus", "adhesion", "indentation"):
        assert plan[f"{name}_lower"].dims == ("lever", "free_amplitude", "setpoint")
        known = np.isfinite(plan[f"{name}_unscreened"])
        assert bool((plan[f"{name}_lower"] <= plan[f"{name}_unscreened"]).where(known, True).all())
        assert bool((plan[f"{name}_unscreened"] <= plan[f"{name}_upper"]).where(known, True).all())
    assert all("units" in array.attrs for array in plan.data_vars.values())


def test_a_cell_is_the_posterior_on_the_state_that_is_held(plan: xr.Dataset, polymer: ot.Sample) -> None:
    probe = lever(20e-9)
    state = ot.hold_amplitude(probe, polymer, setpoint=[0.4])
    cell = plan.sel(lever="probe", free_amplitude=20e-9).isel(setpoint=1)
    assert float(cell["setpoint"]) == pytest.approx(0.4, rel=1e-12, abs=0)
    for name in (*READINGS, "Z", "peak_force", "contact_time"):
        assert float(cell[name]) == pytest.approx(float(state[name].squeeze()), rel=1e-9, abs=0)
    indentation = float(state["indentation"].squeeze())
    assert float(cell["true_indentation"]) == pytest.approx(indentation, rel=1e-9, abs=0)
    assert float(cell["relative_indentation"]) == pytest.approx(indentation / 10e-9, rel=1e-9, abs=0)
    told = one(probe, polymer, 0.4)
    result = ot.map_properties(
        state[READINGS].drop_vars("harmonic", errors="ignore"), probe, model="dmt", poisson_ratio=0.45
    )
    assert float(told["modulus_upper"]) == pytest.approx(
        float(result["modulus_upper"].squeeze()), rel=1e-9, abs=0
    )


def test_noise_and_shared_errors_add_to_the_whole(plan: xr.Dataset) -> None:
    whole, noise, shared = (plan[f"uncertainty{part}"] for part in ("", "_statistical", "_systematic"))
    determined = (plan["status"] == DETERMINED).values
    assert determined.sum() >= 10
    together = np.hypot(noise, shared).values[determined]
    assert together == pytest.approx(whole.values[determined], rel=1e-9, abs=0)
    assert (shared.values[determined] > 0.0).all()


def test_without_a_calibration_only_noise_counts(polymer: ot.Sample) -> None:
    alone, perfect = (one(lever(20e-9), polymer, calibration=word) for word in (None, "perfect"))
    assert float(alone["uncertainty_systematic"]) == 0.0
    assert float(alone["uncertainty_statistical"]) == float(alone["uncertainty"]) > 0.0
    xr.testing.assert_equal(alone, perfect)


def test_the_truth_lies_in_intervals_of_determined_cells(plan: xr.Dataset) -> None:
    # beyond, the tip hardly leaves the sample
    told = plan.where((plan["status"] == DETERMINED) & (plan["true_indentation"] < plan["A1"]))
    assert int(np.isfinite(told["modulus_lower"]).sum()) >= 12
    for name, truth in (("modulus", 100e6), ("adhesion", 4e-9)):
        inside = (told[f"{name}_lower"] < truth) & (truth < told[f"{name}_upper"])
        assert bool(inside.where(np.isfinite(told["modulus_lower"]), True).all())


# --- physics that must hold -----------------------------------------------------------------------


def test_less_noise_and_a_better_calibration_narrow_the_interval(polymer: ot.Sample) -> None:
    probe = lever(20e-9)

    def widths(**arguments: object) -> list[float]:
        found = plan_experiment(probe, polymer, setpoint=[0.25, 0.35], **arguments)
        return np.log(found["interval_factor"].values.ravel()).tolist()

    noisy = [widths(noise={n: k * s for n, s in ORDINARY_NOISE.items()}) for k in (0.5, 1.0, 2.0)]
    assert (np.diff(noisy, axis=0) > 0.0).all()
    assert noisy[1][0] == pytest.approx(2.0 * noisy[0][0], rel=0.05, abs=0)  # small errors: as the noise
    known = [widths(calibration=word) for word in ("perfect", "careful", "ordinary", "none")]
    assert (np.diff(known, axis=0) > 0.0).all()
    assert known[0] == noisy[1]


def test_a_smaller_amplitude_helps_against_relative_errors(stiff: ot.Sample) -> None:
    amplitudes = np.array([10e-9, 20e-9, 40e-9, 80e-9])
    gains = sources(lever(), gain0=0.01, gain2=0.01, gain3=0.01)
    found = plan_experiment(
        lever(), stiff, setpoint=[0.3, 0.6], free_amplitude=amplitudes, noise=QUIET, calibration=gains
    ).squeeze()
    assert (found["stable"] & ~found["bistable"]).all()
    # F ~ A gives delta ~ A^(3/4): the share of the path that lies in contact grows towards small amplitudes
    Delta = (found["true_indentation"] / (2.0 * found["A1"])).sel(setpoint=0.3)
    slope = np.polyfit(np.log(amplitudes), np.log(Delta), 1)[0]
    assert slope == pytest.approx(-0.25, rel=0.03, abs=0)
    assert (np.diff(found["interval_factor"], axis=0) > 0.0).all()
    # with modulus and indentation unknown a relative error counts about 1/Delta times
    spread = found["uncertainty"].sel(setpoint=0.3)
    assert float(spread[0] / spread[-1]) == pytest.approx(float(Delta[-1] / Delta[0]), rel=0.15, abs=0)


def test_a_larger_amplitude_helps_against_noise(stiff: ot.Sample) -> None:
    found = plan_experiment(
        lever(), stiff, setpoint=0.3, free_amplitude=[20e-9, 40e-9, 80e-9, 160e-9]
    ).squeeze()
    assert (np.diff(found["interval_factor"]) < 0.0).all()


def test_the_radius_enters_as_its_root(polymer: ot.Sample) -> None:
    probe = lever(20e-9)
    cell = one(probe, polymer, noise=QUIET, calibration=sources(probe, radius=0.1))
    # E* goes as 1/sqrt(R) at given forces, and the tip is far stiffer than the sample
    assert float(cell["uncertainty_systematic"]) == pytest.approx(0.05, rel=0.02, abs=0)


@pytest.mark.parametrize("setpoint", [0.2, 0.3])
@pytest.mark.parametrize("free_amplitude", [20e-9, 94e-9])
def test_the_interval_is_the_mean_one_over_noise(
    polymer: ot.Sample, free_amplitude: float, setpoint: float
) -> None:
    probe = lever(free_amplitude)
    cell = one(probe, polymer, setpoint)
    assert int(cell["status"]) == DETERMINED
    state = ot.hold_amplitude(probe, polymer, setpoint=setpoint)
    many = state[READINGS].drop_vars("harmonic", errors="ignore").expand_dims(draw=300).copy(deep=True)
    told = ot.map_properties(add_noise(many, seed=1), probe, model="dmt", poisson_ratio=0.45)
    mean = float(np.log(told["modulus_upper"] / told["modulus_lower"]).mean())
    assert np.log(float(cell["interval_factor"])) == pytest.approx(mean, rel=0.2, abs=0)
    inside = (told["modulus_lower"] < 100e6) & (told["modulus_upper"] > 100e6)
    assert float(inside.mean()) > 0.7


# --- states that a feedback holds -----------------------------------------------------------------


def test_where_there_is_no_state_there_is_nothing_and_a_reason(polymer: ot.Sample) -> None:
    springy = ot.sample("kelvin-voigt-adhesion", stiffness=1.0, damping=1e-7, adhesion=5e-9)
    found = plan_experiment(lever(radius=None), springy, setpoint=[0.4, 0.7], free_amplitude=[5e-9, 60e-9])
    lost = found["reason"].values == NO_REPULSIVE
    assert lost[0, 0].all()
    assert not lost[0, 1].any()
    for name in ("stiffness_lower", "stiffness_unscreened", "peak_force", "A0", "uncertainty_systematic"):
        np.testing.assert_array_equal(np.isnan(found[name].values), lost, err_msg=name)
    assert (found["status"].values[lost] == MISSING_DATA).all()
    assert not found["stable"].values[lost].any()
    assert best_choice(found) is not None
    nothing = found.isel(free_amplitude=[0])
    assert best_choice(nothing) is None
    everywhere = plan_experiment(lever(5e-9, radius=None), springy, setpoint=[0.4, 0.7])
    assert set(everywhere.data_vars) <= set(found.data_vars)
    assert np.isnan(everywhere["stiffness_unscreened"]).all()


def test_stable_is_what_the_states_at_that_height_say(plan: xr.Dataset, polymer: ot.Sample) -> None:
    of_lever = plan.sel(lever="probe")
    assert int(of_lever["reason"].isel(free_amplitude=0, setpoint=0)) == UNSTABLE
    assert (of_lever["reason"].isel(free_amplitude=4) == USABLE).all()
    for place in ((0, 0), (0, 1), (4, 0)):
        cell = of_lever.isel(free_amplitude=place[0], setpoint=place[1])
        states = ot.steady_states(lever(float(cell["free_amplitude"])), polymer, z=float(cell["Z"]))
        nearest = int(
            np.nanargmin(np.abs(states["indentation"].squeeze("z") - cell["true_indentation"]).values)
        )
        assert bool(states["stable"].squeeze("z")[nearest]) == bool(cell["stable"])


def test_an_amplitude_that_falls_with_the_height_cannot_be_held(
    polymer: ot.Sample, monkeypatch: pytest.MonkeyPatch
) -> None:
    from overtone.planning import held

    true = held.hold_amplitude

    def turned(*arguments: object, **keywords: object) -> xr.Dataset:
        state = true(*arguments, **keywords)
        return state.assign(Z=-state["Z"]) if state.sizes["setpoint"] > 2 else state

    monkeypatch.setattr(held, "hold_amplitude", turned)
    found = plan_experiment(lever(), polymer, setpoint=[0.3, 0.5])
    assert (found["reason"] == FALLING).all()
    assert not found["stable"].any()


@pytest.mark.parametrize(("free_amplitude", "repulsive"), [(20e-9, False), (60e-9, True)])
def test_a_feedback_from_far_meets_the_attractive_state_first_where_both_are(
    plan: xr.Dataset, polymer: ot.Sample, free_amplitude: float, repulsive: bool
) -> None:
    probe = lever(free_amplitude)
    both = plan["bistable"].sel(lever="probe", free_amplitude=free_amplitude).isel(setpoint=2)
    assert bool(both) != repulsive
    sweep = ot.approach_curve(probe, polymer, z=np.linspace(0.2, 1.2, 60) * free_amplitude).sel(
        direction="approach"
    )
    reached = int(np.argmax(sweep["A1"].values <= 0.6 * free_amplitude))
    assert bool(sweep["phi1"][reached] < np.pi / 2.0) == repulsive


# --- what was known of the instrument -------------------------------------------------------------


def test_a_word_is_a_calibration(polymer: ot.Sample) -> None:
    probe = lever(20e-9)
    written = assumed_calibration("careful", probe)
    assert written is not None
    assert written.error("A0_offset") == pytest.approx(1e-12, rel=1e-12, abs=0)
    by_word, by_record = (one(probe, polymer, calibration=c) for c in ("careful", written))
    assert float(by_word["modulus_upper"]) == pytest.approx(
        float(by_record["modulus_upper"]), rel=1e-9, abs=0
    )
    assert set(QUALITIES["none"]) == set(QUALITIES["careful"]) == set(QUALITIES["ordinary"])
    for name, sigma in QUALITIES["careful"].items():
        assert sigma < QUALITIES["ordinary"][name] < QUALITIES["none"][name]


def test_factors_of_the_lever_are_in_the_planned_probe(polymer: ot.Sample) -> None:
    probe = lever(20e-9)
    softer = replace(sources(probe, stiffness=0.016), values=dict(NEUTRAL) | {"stiffness": 1.6})
    known = calibration_for(softer, probe)
    assert known is not None
    assert known.values["stiffness"] == 1.0
    assert known.error("stiffness") == pytest.approx(0.01, rel=1e-12, abs=0)
    quiet = {name: 0.02 * sigma for name, sigma in ORDINARY_NOISE.items()}
    cell = one(probe, polymer, noise=quiet, calibration=softer)
    # all forces grow alike, and the modulus with them
    assert float(cell["uncertainty_systematic"]) == pytest.approx(0.01, rel=0.05, abs=0)


# --- what is refused ------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("changes", "error", "says"),
    [
        ({"setpoint": 1.2}, OvertoneError, "0 < A1/A1far < 1"),
        ({"setpoint": [0.5, np.nan]}, OvertoneError, "out of reach"),
        ({"setpoint": "half"}, OvertoneError, "not a number"),
        ({"setpoint": [[0.5]]}, OvertoneError, "list of numbers"),
        ({"free_amplitude": 25.0}, OvertoneError, "25e-9 for 25 nm"),
        ({"free_amplitude": []}, OvertoneError, "list of numbers"),
        ({"calibration": "sloppy"}, CalibrationError, "none, ordinary, careful, perfect"),
        ({"calibration": 3}, CalibrationError, "cannot use this calibration"),
        ({"probe": lever(radius=None)}, ProbeError, "tip radius"),
        ({"probe": "probe.toml"}, ProbeError, "load_probe"),
        ({"probes": {"probe": lever()}}, ProbeError, "name of its own"),
        ({"probes": {"soft": lever(radius=None)}}, ProbeError, "tip radius"),
        ({"sample": "dmt"}, OvertoneError, "overtone.sample"),
        (
            {"sample": ot.sample("hertz", modulus=[1e9, 2e9], poisson_ratio=0.3)},
            OvertoneError,
            "one plan for each",
        ),
        (
            {"sample": ot.sample("kelvin-voigt", stiffness=1.0, damping=1e-7), "model": "dmt"},
            InversionError,
            "poisson",
        ),
        (
            {"sample": ot.sample("jkr", modulus=1e9, poisson_ratio=0.3, adhesion=5e-9)},
            InversionError,
            "model=",
        ),
        ({"model": "nonsense"}, OvertoneError, "nonsense"),
        ({"harmonics": (0, 1)}, InversionError, "too few harmonics"),
        ({"noise": {"A0": -1.0}}, OvertoneError, "not stated in a usable way"),
    ],
)
def test_bad_input_is_refused_with_a_hint(
    polymer: ot.Sample, changes: dict[str, object], error: type[OvertoneError], says: str
) -> None:
    arguments: dict[str, object] = {"probe": lever(), "sample": polymer, "setpoint": 0.5} | changes
    with pytest.raises(error, match=says.replace("(", r"\(")):
        plan_experiment(arguments.pop("probe"), arguments.pop("sample"), **arguments)


def test_a_calibration_of_another_lever_is_refused(polymer: ot.Sample) -> None:
    other = lever(frequency=70e3)
    with pytest.raises(CalibrationError, match="another lever"):
        plan_experiment(
            lever(), polymer, setpoint=0.5, probes={"soft": other}, calibration=sources(lever(), gain0=0.1)
        )


# --- the choice -----------------------------------------------------------------------------------


def test_the_choice_is_the_narrowest_interval_that_is_safe_to_hold(plan: xr.Dataset) -> None:
    choice = best_choice(plan)
    assert choice is not None
    assert choice.determined
    safe = plan["stable"] & ~plan["bistable"] & (plan["status"] == DETERMINED)
    narrowest = float(plan["interval_factor"].where(safe).min())
    assert narrowest <= choice.factor <= 1.1 * narrowest
    cell = plan.sel(lever=choice.lever, free_amplitude=choice.free_amplitude, setpoint=choice.setpoint)
    assert bool(cell["stable"])
    assert not bool(cell["bistable"])
    assert choice.lower == float(cell["modulus_lower"])
    near = safe & (plan["interval_factor"] <= 1.1 * narrowest)
    assert float(cell["peak_force"]) == float(plan["peak_force"].where(near).min())
    assert float(plan["interval_factor"].where(plan["bistable"]).min()) < choice.factor
    text = " ".join(choice.sentences)
    assert "a stable attractive state has the same set-point; they were passed over" in text
    assert "not stable 2" in text
    assert "careful calibration, assumed" in text


def test_where_nothing_is_determined_the_choice_says_so(polymer: ot.Sample) -> None:
    found = plan_experiment(lever(), polymer, setpoint=[0.5, 0.8], free_amplitude=50e-9, calibration="none")
    choice = best_choice(found)
    assert choice is not None
    assert not choice.determined
    assert choice.sentences[0].startswith("No choice determines the modulus")
    assert "the calibration decides" in choice.sentences[1].lower() or "both" in choice.sentences[1]


def test_a_model_that_is_not_that_of_the_sample_is_told_where_it_misses() -> None:
    capped = ot.sample("cone", modulus=1e9, poisson_ratio=0.3, half_angle=0.3)
    found = plan_experiment(lever(60e-9), capped, setpoint=0.4, model="hertz", noise=QUIET)
    choice = best_choice(found)
    assert choice is not None
    assert any("misses the modulus of the sample, 1 GPa" in sentence for sentence in choice.sentences)


def test_each_row_has_its_best(plan: xr.Dataset) -> None:
    rows = best_of_each(plan)
    assert [(name, A) for name, A, _ in rows] == [
        (name, A) for name in ("probe", "soft") for A in plan["free_amplitude"].values
    ]
    cell = rows[4][2]
    assert cell is not None
    of_row = plan.sel(lever="probe").isel(free_amplitude=4)
    assert float(cell["interval_factor"]) <= 1.1 * float(of_row["interval_factor"].min())
    with pytest.raises(ObservablesError, match="no plan"):
        best_choice(xr.Dataset({"modulus": 1.0}))


# --- the figure -----------------------------------------------------------------------------------


def test_the_figure_marks_what_cannot_be_held_and_the_best(plan: xr.Dataset) -> None:
    choice = best_choice(plan)
    assert choice is not None
    figure = plan_figure(plan, choice, "a polymer")
    factor, other, force, _ = figure.axes[:4]
    assert factor.get_title(loc="left") == "probe: modulus, 90 % interval"
    assert force.get_title(loc="left") == "probe: peak force"
    held = plan["stable"].sel(lever="probe").values
    hatched = [p for p in factor.patches if isinstance(p, Rectangle) and p.get_gid() == "not held"]
    assert len(hatched) == int((~held).sum()) == 1
    corner = hatched[0].get_bbox()
    assert corner.contains(8.0, 0.2)
    stars = [line for line in factor.lines if line.get_gid() == "best"]
    assert len(stars) == 1
    assert not [line for line in other.lines if line.get_gid() == "best"]
    assert np.ravel(stars[0].get_xydata()) == pytest.approx([1e9 * choice.free_amplitude, choice.setpoint])
    dots = next(line for line in factor.lines if line.get_gid() == "bistable")
    assert len(dots.get_xdata()) == int(plan["bistable"].sel(lever="probe").sum())
    contours = {c.get_gid() for c in factor.collections if c.get_gid()}
    assert contours == {"factor 2", "factor 10"}
    mesh = factor.collections[0]
    shown = plan["interval_factor"].sel(lever="probe").transpose("setpoint", "free_amplitude").values
    assert np.asarray(mesh.get_array()).ravel() == pytest.approx(shown.ravel())
    legend = [text.get_text() for text in figure.legends[0].get_texts()]
    assert legend[2:] == ["no stable repulsive state", "attractive state as well", "best"]


def test_one_amplitude_or_one_setpoint_becomes_a_curve(plan: xr.Dataset) -> None:
    for few, label in (
        ({"free_amplitude": [1]}, "set-point"),
        ({"setpoint": [1]}, "far"),
        ({"setpoint": [1], "free_amplitude": [1]}, "set-point"),
    ):
        part = plan.isel(few)
        figure = plan_figure(part, best_choice(part))
        assert len(figure.axes) == 4
        assert label in figure.axes[2].get_xlabel()
        drawn = [line for line in figure.axes[0].lines if line.get_gid() in ("held", "bistable", "not held")]
        assert (
            sum(len(line.get_xdata()) for line in drawn)
            == part.sizes["setpoint"] * part.sizes["free_amplitude"]
        )
