"""From curve and far-field data to a calibration: what was put in comes out, within its stated errors, or is named."""

import math
import re
import warnings
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import xarray as xr

from overtone.beam import beam_modes
from overtone.contact.sample import Sample, sample
from overtone.errors import CalibrationError, CalibrationWarning, OvertoneError, ProbeError
from overtone.instrument.approach_fit import Reference
from overtone.instrument.calibrate import calibrate, split_curve
from overtone.instrument.calibration import Calibration
from overtone.instrument.correct import correct
from overtone.instrument.curve_parts import binned
from overtone.instrument.far_field import PRIORS
from overtone.instrument.instrument import Instrument, NearSurface, lever_at
from overtone.instrument.photodiode import SplitDiode
from overtone.instrument.signals import signals_of
from overtone.instrument.unknowns import undo, wrapped
from overtone.probe import Cantilever, Detector, Drive, Probe, Tip
from overtone.provenance import record
from overtone.readings import Reading, with_reading

Factory = Callable[..., Any]
HEIGHT_NOISE = 0.05e-9
TRUTH = {
    "gain0": 1.03,
    "gain2": 0.92,
    "gain3": 0.9,
    "latency2": 0.3,
    "latency3": 0.4,
    "phi1_offset": 0.1,
    "stiffness": 1.0,
    "radius": 1.0,
}


def quietly(raw: xr.Dataset, probe: Probe, **arguments: Any) -> Calibration:
    """Calibrate without its warnings."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", CalibrationWarning)
        return calibrate(raw, probe, **{"height_noise": HEIGHT_NOISE, **arguments})


def heard(raw: xr.Dataset, probe: Probe, **arguments: Any) -> tuple[Calibration, str]:
    """Calibrate, and return what was warned of as well."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        result = calibrate(raw, probe, **{"height_noise": HEIGHT_NOISE, **arguments})
    assert {warning.category for warning in caught} <= {CalibrationWarning}
    assert [str(warning.message) for warning in caught] == list(result.findings)
    return result, "\n".join(result.findings)


def scores(calibration: Calibration, truth: dict[str, float]) -> np.ndarray:
    """Return by how many standard errors each unknown is off."""
    return np.array(
        [(calibration.values[name] - true) / calibration.error(name) for name, true in truth.items()]
    )


@pytest.fixture(scope="module")
def raw(
    lever: Probe, microscope: Instrument, stiff: Sample, motion_of: Factory, read_curve: Factory
) -> xr.Dataset:
    return read_curve(motion_of(lever, stiff, microscope), lever, microscope, seed=3)


@pytest.fixture(scope="module")
def ladder(lever: Probe, microscope: Instrument, read_ladder: Factory) -> xr.Dataset:
    return read_ladder(lever, microscope, seed=4)


@pytest.fixture(scope="module")
def reference() -> Reference:
    return Reference(0.35, modulus=2e9, name="PS")


# --- what was put in ------------------------------------------------------------------------------


def test_what_was_put_in_comes_out_within_its_errors(
    lever: Probe,
    microscope: Instrument,
    soft: Sample,
    motion_of: Factory,
    read_curve: Factory,
    read_ladder: Factory,
    calibrated: Calibration,
) -> None:
    """Scores of 8 unknowns over curves on two materials; a bias of the model shows as a large mean square."""
    found = [scores(calibrated, TRUTH)]
    motion = motion_of(lever, soft, microscope)
    for seed in (11, 12, 13):
        curve = read_curve(motion, lever, microscope, seed=seed)
        far = read_ladder(lever, microscope, seed=100 + seed)
        known = Reference(0.35, modulus=98e6, adhesion=15e-9)
        found.append(scores(quietly(curve, lever, reference=known, far_field=far), TRUTH))
    assert np.abs(found).max() < 3.5
    assert np.sqrt(np.mean(np.square(found))) < 1.3


def test_errors_are_small_where_the_data_tell(calibrated: Calibration) -> None:
    assert calibrated.error("gain0") < 0.02
    assert calibrated.error("gain2") < 0.015
    assert calibrated.error("latency2") < 0.01
    assert calibrated.error("A0_slope_z") < 1e-5
    assert calibrated.error("crosstalk2_re") < 1e-12
    # what no curve tells keeps its prior
    assert calibrated.error("radius") == pytest.approx(0.15, rel=0.2)
    assert calibrated.reference is not None
    modulus, error = calibrated.reference.properties["modulus"]
    assert abs(math.log(modulus / 1.93e9)) < 2.0 * error
    assert error == pytest.approx(0.1, rel=0.3)
    assert calibrated.reference.stated == ("modulus",)


def test_distortion_and_crosstalk_are_told_apart(calibrated: Calibration, microscope: Instrument) -> None:
    d = complex(calibrated.values["crosstalk2_re"], calibrated.values["crosstalk2_im"])
    error = math.hypot(calibrated.error("crosstalk2_re"), calibrated.error("crosstalk2_im"))
    assert abs(d - microscope.crosstalk[2]) < 3.0 * error
    kappa = complex(calibrated.values["distortion2_0_re"], calibrated.values["distortion2_0_im"])
    assert abs(kappa) == pytest.approx(0.82e-9, rel=0.05)  # many times the signal


def test_the_correction_follows_the_motion(
    calibrated: Calibration,
    raw: xr.Dataset,
    lever: Probe,
    stiff: Sample,
    microscope: Instrument,
    motion_of: Factory,
) -> None:
    """Raw readings are off by many times the signal; corrected ones by what the errors of the calibration allow."""
    truth = signals_of(motion_of(lever, stiff, microscope))
    parts = split_curve(raw)
    height = raw["z"].values - parts.onset
    clean = undo(signals_of(raw), calibrated.values, calibrated.amplitude, height=height)
    contact = np.abs(truth.phasor[1]) < 0.95 * lever.drive.free_amplitude
    assert np.abs(signals_of(raw).phasor[2] - truth.phasor[2])[contact].mean() > 300e-12
    assert np.abs(np.mean((clean.phasor[2] - truth.phasor[2])[contact])) < 1.5e-12
    assert abs(np.mean((clean.mean - truth.mean)[contact])) < 4e-12
    assert np.abs(np.angle(clean.phasor[1] / truth.phasor[1]))[contact].mean() < 1e-3


def test_the_fitted_curve_is_that_of_the_reference(
    calibrated: Calibration,
    raw: xr.Dataset,
    lever: Probe,
    stiff: Sample,
    microscope: Instrument,
    motion_of: Factory,
) -> None:
    """The table that anchors scans holds the motion of the reference, from another code than the fit."""
    motion = motion_of(lever, stiff, microscope)
    order = np.argsort(motion["A1"].values)
    inside = order[np.isfinite(motion["A1"].values[order])]
    A0 = np.interp(calibrated.curve["A1"], motion["A1"].values[inside], motion["A0"].values[inside])
    assert calibrated.curve["A0"] == pytest.approx(A0, rel=0.035, abs=0)
    e2 = np.interp(calibrated.curve["A1"], motion["A1"].values[inside], motion["A2"].values[inside])
    assert np.abs(calibrated.curve["e2_re"]) == pytest.approx(e2, rel=0.03, abs=0)
    assert (calibrated.curve["e2_re"] < 0.0).all()


def test_offsets_count_from_where_contact_begins(calibrated: Calibration, raw: xr.Dataset) -> None:
    """Virtual deflection of 2 nm/um over the 100 nm to the far part is 0.2 nm, and no drift."""
    parts = split_curve(raw)
    far = parts.height[parts.far]
    added = calibrated.values["distortion0_0"] + calibrated.values["distortion0_1"]
    assert parts.signals.mean is not None
    here = float(np.mean(parts.signals.mean[parts.far])) - added
    slope = calibrated.values["A0_slope_z"] * (far.mean() - parts.onset)
    assert slope > 0.2e-9
    assert calibrated.values["A0_offset"] == pytest.approx(here - slope, rel=0, abs=2e-12)


def test_without_a_stated_modulus_gains_and_modulus_share_their_error(
    lever: Probe,
    microscope: Instrument,
    soft: Sample,
    motion_of: Factory,
    read_curve: Factory,
    read_ladder: Factory,
) -> None:
    curve = read_curve(motion_of(lever, soft, microscope), lever, microscope, seed=11)
    far = read_ladder(lever, microscope, seed=111)
    sharp: dict[str, Any] = {"far_field": far, "errors": {"radius": 0.01, "stiffness": 0.005}}
    stated = Reference(0.35, modulus=93.78e6, modulus_error=0.01)
    known = quietly(curve, lever, reference=stated, **sharp)
    unknown, said = heard(curve, lever, reference=Reference(0.35), **sharp)
    assert re.search("gains and modulus were fitted together, and share their error", said)
    assert unknown.reference is not None
    assert known.reference is not None
    modulus, error = unknown.reference.properties["modulus"]
    assert modulus == pytest.approx(93.78e6, rel=0.1)
    assert error > 2.0 * known.reference.properties["modulus"][1]
    assert unknown.reference.stated == ()
    for name in ("gain0", "gain2"):
        assert unknown.error(name) > 0.99 * known.error(name)  # the detector's bend limits both here
        assert abs(unknown.values[name] - TRUTH[name]) < 3.0 * unknown.error(name)


def test_without_the_third_harmonic(
    raw: xr.Dataset, ladder: xr.Dataset, lever: Probe, reference: Reference
) -> None:
    result, said = heard(raw.drop_vars(["A3", "phi3"]), lever, reference=reference, far_field=ladder)
    assert re.search("no third harmonic far from the surface", said)
    assert "gain3" not in result.names
    assert "e3_re" not in result.curve
    # how much of A1 the detector loses far data do not say, but the whole curve on a known reference does
    few = {name: TRUTH[name] for name in ("gain0", "gain2", "latency2", "phi1_offset", "stiffness")}
    assert np.abs(scores(result, few)).max() < 3.0
    assert result.error("compression") < 0.4 * PRIORS["compression"]
    assert abs(result.values["compression"] - 0.0184) < 3.0 * result.error("compression")


@pytest.mark.parametrize(
    ("dropped", "gone"),
    [(["A2", "phi2", "A3", "phi3"], ("gain2", "crosstalk2_re")), (["A0"], ("gain0", "A0_offset"))],
)
def test_without_a_signal_the_rest_is_calibrated(
    raw: xr.Dataset,
    ladder: xr.Dataset,
    lever: Probe,
    reference: Reference,
    dropped: list[str],
    gone: tuple[str, ...],
) -> None:
    result = quietly(raw.drop_vars(dropped), lever, reference=reference, far_field=ladder)
    assert not set(gone) & set(result.names)
    kept = {name: true for name, true in TRUTH.items() if name in result.names}
    assert {"gain0", "gain2"} & set(kept)
    assert np.abs(scores(result, kept)).max() < 3.0


def test_a_lever_of_three_modes_read_as_slope(
    microscope: Instrument, motion_of: Factory, read_curve: Factory, read_ladder: Factory, stiff: Sample
) -> None:
    """A0 reads 12 % high and A2 40 % low against one mode: gains must not take that for the electronics."""
    cantilever = beam_modes(stiffness=16.4, frequency=161.8e3, quality_factor=287.0)
    probe = Probe(cantilever, Drive(161.8e3, 94e-9), Tip(10e-9), Detector("slope"))
    curve = read_curve(motion_of(probe, stiff, microscope), probe, microscope, seed=5)
    far = read_ladder(probe, microscope, seed=6)
    known = Reference(0.35, modulus=1.93e9)
    result = quietly(curve, probe, reference=known, far_field=far)
    assert np.abs(scores(result, TRUTH)).max() < 3.5
    single = Probe(Cantilever((probe.cantilever.modes[0],)), probe.drive, probe.tip)
    mistaken = quietly(curve, single, reference=known, far_field=far)
    assert mistaken.values["gain2"] < 0.75 * result.values["gain2"]


def test_a_reference_that_loses_energy(
    lever: Probe, microscope: Instrument, motion_of: Factory, read_curve: Factory, read_ladder: Factory
) -> None:
    lossy = sample("dmt-viscous", modulus=1e9, poisson_ratio=0.35, adhesion=5e-9, viscosity=60.0)
    curve = read_curve(motion_of(lever, lossy, microscope), lever, microscope, seed=7)
    far = read_ladder(lever, microscope, seed=8)
    known = Reference(0.35, modulus=1e9, model="dmt-viscous")
    result = quietly(curve, lever, reference=known, far_field=far)
    assert result.reference is not None
    viscosity, error = result.reference.properties["viscosity"]
    assert abs(math.log(viscosity / 60.0)) < 3.0 * error + 0.02
    # DISS_1 hangs on the zero of the phase, which hangs on Q and resonance where the drive is beside it
    assert error < 0.25
    assert np.abs(scores(result, TRUTH)).max() < 3.5


def test_the_lever_just_above_the_sample_is_used(
    lever: Probe, stiff: Sample, motion_of: Factory, read_curve: Factory, read_ladder: Factory
) -> None:
    """A film of air takes a tenth of Q and lowers the resonance: far data alone would be off by 10 % of the force."""
    film = Instrument(
        diode=SplitDiode(500e-9, offset=25e-9),
        gains={0: 1.03, 2: 0.92, 3: 0.9},
        latency={2: 0.3, 3: 0.4},
        phase_offset=0.1,
        near_surface=NearSurface(damping=0.1, softening=1e-4, decay=5e-6),
    )
    curve = read_curve(motion_of(lever, stiff, film), lever, film, seed=9)
    far = read_ladder(lever, film, seed=10)
    result = quietly(curve, lever, reference=Reference(0.35, modulus=1.93e9), far_field=far)
    near = lever_at(lever, film, height=97e-9)
    mode, true = result.probe.cantilever.modes[0], near.cantilever.modes[0]
    assert mode.quality_factor == pytest.approx(true.quality_factor, rel=0.01)
    assert mode.frequency == pytest.approx(true.frequency, rel=2e-5)
    assert result.amplitude == pytest.approx(near.drive.free_amplitude, rel=5e-3)
    assert np.abs(scores(result, TRUTH)).max() < 3.5
    assert any("were used" in sentence for sentence in result.findings)


# --- without a reference, without a ladder --------------------------------------------------------


def test_without_a_reference_the_zeros_are_known_and_gains_are_not(
    raw: xr.Dataset, ladder: xr.Dataset, lever: Probe
) -> None:
    result, said = heard(raw, lever, far_field=ladder)
    assert re.search("no reference was given", said)
    assert result.reference is None
    assert result.values["phi1_offset"] == pytest.approx(0.1, abs=1e-3)
    assert result.values["gain0"] == 1.0
    assert result.error("gain2") == pytest.approx(0.3)
    assert set(result.curve) == {"A1", "phi1", "A0", "e2_re", "e2_im", "e3_re", "e3_im"}


def test_without_a_ladder_what_cannot_be_told_apart_is_wide_and_said(raw: xr.Dataset, lever: Probe) -> None:
    result, said = heard(raw, lever)
    assert re.search("distortion and crosstalk of harmonic 2 cannot be told apart", said)
    assert result.error("crosstalk2_re") > 50e-12
    # their sum at the free amplitude, where a1^2 turns by -1, is known
    names = [f"distortion2_{j}_re" for j in range(3)] + ["crosstalk2_re"]
    phase = np.exp(-2j * (math.pi / 2 + 0.1))
    rows = np.zeros((2, len(result.names)))
    for name in names[:3]:
        rows[0, result.names.index(name)] = phase.real
        rows[0, result.names.index(name.replace("_re", "_im"))] = -phase.imag
    rows[0, result.names.index("crosstalk2_re")] = 1.0
    assert math.sqrt(float(rows[0] @ result.covariance @ rows[0])) < 1e-12


def test_a_ladder_without_a_harmonic_leaves_it_to_the_curve(
    raw: xr.Dataset, ladder: xr.Dataset, lever: Probe
) -> None:
    result, said = heard(raw, lever, far_field=ladder.drop_vars(["A3", "phi3"]))
    assert re.search("lack harmonic 3, so the far part of the curve stands alone", said)
    assert result.error("crosstalk3_re") > 20e-12  # not told apart, but there
    assert result.error("crosstalk2_re") < 2e-12


def test_a_ladder_without_the_mean_still_tells_the_second_harmonic(
    raw: xr.Dataset, ladder: xr.Dataset, lever: Probe
) -> None:
    result = quietly(raw, lever, far_field=ladder.drop_vars("A0"))
    assert result.error("crosstalk2_re") < 2e-12
    assert result.error("distortion0_0") > 50e-12


def test_points_with_nan_do_nothing(raw: xr.Dataset, lever: Probe, ladder: xr.Dataset) -> None:
    holes = raw.copy(deep=True)
    holes["A2"].values[[3, 70, 110]] = math.nan
    holes["A0"].values[[20, 90]] = math.nan
    holes["A1"].values[100] = math.nan
    lost = np.array([3, 70, 110, 20, 90, 100])
    one = quietly(holes, lever, far_field=ladder)
    other = quietly(raw.isel(z=np.setdiff1d(np.arange(raw.sizes["z"]), lost)), lever, far_field=ladder)
    assert one.values == other.values
    np.testing.assert_array_equal(one.covariance, other.covariance)


def test_heights_in_any_order_and_from_any_origin(raw: xr.Dataset, lever: Probe, ladder: xr.Dataset) -> None:
    shuffled = raw.isel(z=np.random.default_rng(0).permutation(raw.sizes["z"]))
    shuffled = shuffled.assign_coords(z=shuffled["z"] - 3e-6)
    one, other = (quietly(curve, lever, far_field=ladder) for curve in (raw, shuffled))
    for name in ("A0_offset", "A0_slope_z", "phi1_offset", "distortion2_0_re"):
        assert one.values[name] == pytest.approx(other.values[name], rel=1e-6)


def test_stated_noise_counts(raw: xr.Dataset, lever: Probe, ladder: xr.Dataset) -> None:
    wide = quietly(raw, lever, far_field=ladder, noise={"A2": 50e-12})
    assert wide.noise["A2"] == 50e-12
    assert wide.error("crosstalk2_re") > 5.0 * quietly(raw, lever, far_field=ladder).error("crosstalk2_re")


# --- taking a curve apart -------------------------------------------------------------------------


def test_averaging_keeps_phases_that_turn(raw: xr.Dataset) -> None:
    parts = split_curve(raw)
    signals, height, counts = binned(parts, 94e-9, 24)
    assert height.size == counts.size == 24
    assert counts.sum() == pytest.approx(len(parts.height[parts.contact]), rel=0.1)
    turn = (
        np.abs(signals.phasor[2])
        - np.interp(height[::-1], parts.height[::-1], np.abs(parts.signals.phasor[2])[::-1])[::-1]
    )
    assert (
        np.abs(turn).max() < 6e-12
    )  # a phasor averaged without its frame shrinks where the phase turns fast


# --- what is refused ------------------------------------------------------------------------------


def far_only(raw: xr.Dataset) -> xr.Dataset:
    return raw.isel(z=raw["A1"].values > 92.3e-9)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (far_only, "the curve never touches"),
        (lambda raw: raw.isel(z=raw["A1"].values < 85e-9), "the curve has no far part"),
        (lambda raw: raw.isel(z=np.r_[0:3, 60:180]), "the curve has no far part"),
        (lambda raw: raw.isel(z=slice(0, 12)), "the approach curve is too short"),
        (lambda raw: raw.where(raw["z"] > 1.0), "no pixel has both A1 and phi1"),
        (lambda raw: raw.drop_vars("z"), "the approach curve has no heights"),
        (lambda raw: raw.expand_dims("y"), "this is no approach curve"),
        (lambda raw: raw.expand_dims(direction=["approach"]), "this is no approach curve"),
        (lambda raw: record(raw, "correct"), "corrected before"),
        (lambda raw: with_reading(raw, Reading(Probe.simple(**PLAIN), corrected=True)), "corrected before"),
        (
            lambda raw: with_reading(raw, Reading(Probe.simple(**PLAIN | {"drive_frequency": 160e3}))),
            "curve and probe are of different drives",
        ),
    ],
)
def test_curves_that_calibrate_nothing_are_named(
    raw: xr.Dataset, lever: Probe, change: Callable[[xr.Dataset], xr.Dataset], message: str
) -> None:
    with pytest.raises(OvertoneError, match=message):
        calibrate(change(raw), lever)


PLAIN: dict[str, Any] = {
    "stiffness": 16.4,
    "frequency": 161.8e3,
    "quality_factor": 287.0,
    "drive_frequency": 161.8e3,
    "free_amplitude": 94e-9,
}


def test_a_corrected_curve_is_not_calibrated_again(
    raw: xr.Dataset, lever: Probe, calibrated: Calibration
) -> None:
    done = correct(raw, calibrated)
    with pytest.raises(CalibrationError, match=r"corrected before.*calibrate first, then correct"):
        calibrate(done, lever)
    # the attributes alone give it away, and so does the history alone
    for kept in ("calibration", "history"):
        bare = done.assign_attrs({}).copy()
        bare.attrs = {kept: done.attrs[kept]}
        with pytest.raises(CalibrationError, match="corrected before"):
            calibrate(bare, lever)


def test_a_map_is_not_calibrated(lever: Probe) -> None:
    pixels = xr.Dataset(
        {"A1": (("y", "x"), np.full((4, 4), 4e-8)), "phi1": (("y", "x"), np.full((4, 4), 1.0))}
    )
    with pytest.raises(CalibrationError, match=r"dimensions y, x.*a map is corrected, not calibrated"):
        calibrate(pixels, lever)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"errors": {"gain9": 0.1}}, "'gain9' is no unknown of a calibration"),
        ({"errors": {"gain2": -0.1}}, "standard deviation of gain2 makes no sense"),
        ({"priors": {"slope": 0.1}}, "'slope' is no prior of far-field data"),
        ({"noise": {"A2": -1e-12}}, "noise is not stated in a usable way"),
        ({"height_noise": 0.0}, "unphysical noise of the height"),
    ],
)
def test_numbers_that_make_no_sense_are_named(
    raw: xr.Dataset, lever: Probe, arguments: dict[str, Any], message: str
) -> None:
    with pytest.raises(OvertoneError, match=message):
        calibrate(raw, lever, **arguments)


@pytest.mark.parametrize(
    ("numbers", "message"),
    [
        ({"modulus": -1e9}, "modulus of the reference makes no sense"),
        ({"modulus": 1e9, "modulus_error": 0.0}, "modulus error of the reference"),
        ({"adhesion": math.nan}, "adhesion of the reference"),
        ({"model": "nonsense"}, "nonsense"),
    ],
)
def test_a_reference_that_makes_no_sense_is_named(numbers: dict[str, Any], message: str) -> None:
    with pytest.raises(OvertoneError, match=message):
        Reference(0.35, **numbers)
    with pytest.raises(OvertoneError, match=r"[Pp]oisson"):
        Reference(0.7)


def test_a_reference_needs_a_radius_and_a_model_that_a_curve_tells(raw: xr.Dataset, lever: Probe) -> None:
    with pytest.raises(ProbeError, match="no tip radius"):
        quietly(raw, replace(lever, tip=Tip()), reference=Reference(0.35, modulus=2e9))
    with pytest.raises(CalibrationError, match=r"not for references.*dmt"):
        quietly(raw, lever, reference=Reference(0.35, modulus=2e9, model="thin-layer"))
    few = raw.drop_vars(["A0", "A2", "phi2", "A3", "phi3"])
    with pytest.raises(CalibrationError, match="needs more than the first harmonic"):
        quietly(few, lever, reference=Reference(0.35, modulus=2e9))


def test_mean_deflection_of_the_wrong_sign(
    raw: xr.Dataset, ladder: xr.Dataset, lever: Probe, reference: Reference
) -> None:
    wrong = raw.assign(A0=-raw["A0"].assign_attrs(raw["A0"].attrs))
    far = ladder.assign(A0=-ladder["A0"])
    with pytest.raises(CalibrationError, match=r"does not follow.*sign and unit"):
        quietly(wrong, lever, reference=reference, far_field=far)


def test_phases_of_the_wrong_sign(raw: xr.Dataset, lever: Probe, reference: Reference) -> None:
    wrong = raw.assign({name: -raw[name] for name in ("phi1", "phi2", "phi3")})
    with pytest.raises(CalibrationError, match=r"never touches in repulsion.*phase_sign=-1"):
        quietly(wrong, lever, reference=reference)


def test_a_curve_that_does_not_follow_the_reference(
    raw: xr.Dataset, ladder: xr.Dataset, lever: Probe
) -> None:
    """Heights told ten times too large: no material taps like this."""
    stretched = raw.assign_coords(z=raw["z"] * 1.5)
    with pytest.raises(CalibrationError, match="the approach curve does not follow the reference"):
        quietly(stretched, lever, reference=Reference(0.35, modulus=2e9), far_field=ladder)


def test_a_poor_fit_widens_the_errors_and_says_so(
    raw: xr.Dataset, ladder: xr.Dataset, lever: Probe, reference: Reference, calibrated: Calibration
) -> None:
    """A height that creeps by a nanometre where its noise is a hundredth of that."""
    z = raw["z"].values
    creeping = raw.assign_coords(z=z + 1e-9 * np.sin(40.0 * (z - z.min()) / np.ptp(z)))
    poor, said = heard(creeping, lever, reference=reference, far_field=ladder, height_noise=0.2e-9)
    assert re.search("errors were widened", said)
    assert poor.error("gain2") > 0.9 * calibrated.error("gain2")


def test_a_saturated_signal_is_named(raw: xr.Dataset, lever: Probe) -> None:
    limit = float(np.quantile(raw["A2"].values, 0.6))
    clipped = raw.assign(A2=raw["A2"].clip(max=limit).assign_attrs(raw["A2"].attrs))
    _, said = heard(clipped, lever)
    assert re.search(r"A2 is saturated: \d+ % of the curve", said)
    assert not any("saturated" in sentence for sentence in quietly(raw, lever).findings)


def test_another_free_amplitude_than_that_of_the_probe_is_said(raw: xr.Dataset, lever: Probe) -> None:
    other = replace(lever, drive=replace(lever.drive, free_amplitude=80e-9))
    result, said = heard(raw, other)
    assert re.search("the probe says 80 nm; that of the curve was used", said)
    assert result.probe.drive.free_amplitude == pytest.approx(94e-9, rel=1e-3)


def test_phases_of_latencies_are_wrapped(calibrated: Calibration) -> None:
    for n in (2, 3):
        latency = calibrated.values[f"latency{n}"]
        assert latency == pytest.approx(float(wrapped(latency)), rel=1e-12)
