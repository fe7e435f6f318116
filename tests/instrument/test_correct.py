"""Scans corrected: what the microscope added is gone, and what is left of it is within the error that is stated."""

import json
import math
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
import xarray as xr

from overtone import provenance
from overtone.contact.sample import Sample, sample
from overtone.dynamics.hold import hold_amplitude
from overtone.errors import CalibrationError, CalibrationWarning, OvertoneError
from overtone.instrument.calibration import Calibration
from overtone.instrument.correct import DRIFT, calibration_of, correct, unsettled_findings
from overtone.instrument.instrument import Instrument, readings
from overtone.instrument.phantom import blend
from overtone.instrument.shared import redo
from overtone.instrument.signals import Positions, Signals, in_the_frame_of_the_first, positions, signals_of
from overtone.instrument.state import State, drifting
from overtone.instrument.unknowns import probe_with, undo
from overtone.probe import Probe
from overtone.quantities import named_array
from overtone.readings import Reading, reading_of, with_reading

Factory = Callable[..., Any]
SETPOINT = 0.42
SIZE = 48


@dataclass(frozen=True)
class Sighted:
    """A scan of a blend of a reference and a softer material, without an instrument."""

    surface: xr.Dataset
    motion: xr.Dataset
    height: np.ndarray
    soft: np.ndarray


def named(motion: xr.Dataset, surface: xr.Dataset, height: np.ndarray) -> xr.Dataset:
    names = ["A0", *(f"{letter}{n}" for n in range(1, 7) for letter in ("A", "phi"))]
    arrays = {
        name: named_array(name, motion[name].values, ("y", "x"), surface.coords)
        for name in names
        if name in motion
    }
    return xr.Dataset(arrays | {"height": named_array("height", height, ("y", "x"), surface.coords)})


@pytest.fixture(scope="module")
def sighted(lever: Probe) -> Sighted:
    surface = blend(shape=(SIZE, SIZE), seed=1, size=3e-6)
    material = sample(
        "dmt", modulus=surface["modulus"].values, poisson_ratio=0.35, adhesion=surface["adhesion"].values
    )
    held = hold_amplitude(lever, material, setpoint=SETPOINT, n_max=6, keep=6)
    height = held["Z"].values + surface["height"].values
    return Sighted(
        surface, named(held, surface, height), height - height.mean(), surface["material"].values == 1
    )


@dataclass(frozen=True)
class Drifted:
    """What differs between the calibration and the scan."""

    phase: float = math.radians(0.5)
    crosstalk: complex = 3e-12 - 2e-12j
    zero: float = 0.15e-9
    walk: float = 3e-12
    slope_x: float = 1e-3
    seed: int = 0


def read_scan(
    sighted: Sighted, lever: Probe, microscope: Instrument, drifted: Drifted, *, lift: float | None = None
) -> xr.Dataset:
    """Return what the microscope stores of the scan, or of a lift pass above it."""
    generator = np.random.default_rng(drifted.seed)
    walk = np.cumsum(generator.normal(0.0, drifted.walk, SIZE))[:, None]
    x = sighted.surface["x"].values[None, :] - sighted.surface["x"].values.mean()
    above = lift or 0.0
    shift = drifted.zero + walk + microscope.mean_slope_z * (sighted.height + above) + drifted.slope_x * x
    now = replace(
        microscope,
        phase_offset=microscope.phase_offset + drifted.phase,
        crosstalk={n: d + drifted.crosstalk for n, d in microscope.crosstalk.items()},
    )
    motion = sighted.motion
    if lift is not None:
        free = {
            name: lever.drive.free_amplitude if name == "A1" else math.pi / 2 if name == "phi1" else 0.0
            for name in motion.data_vars
            if name != "height"
        }
        motion = motion.assign({name: xr.full_like(motion[name], value) for name, value in free.items()})
    scan = with_reading(readings(motion, now, lever, shift=shift, generator=generator), Reading(lever))
    return scan.assign_attrs(lift_height=lift) if lift is not None else scan


def off_the_truth(corrected: xr.Dataset, motion: xr.Dataset, where: np.ndarray) -> dict[str, float]:
    """Return by how much means over some pixels are off: A0, e2, e3 [m], phi1 [rad]."""
    one, other = signals_of(corrected), signals_of(motion)
    frames = in_the_frame_of_the_first(one), in_the_frame_of_the_first(other)
    assert one.mean is not None
    assert other.mean is not None
    return {
        "A0": float(np.nanmean((one.mean - other.mean)[where])),
        "phi1": float(np.nanmean(-np.angle(one.phasor[1] / other.phasor[1])[where])),
        **{f"e{n}": float(np.abs(np.nanmean((frames[0][n] - frames[1][n])[where]))) for n in (2, 3)},
    }


def quietly(scan: xr.Dataset, calibration: Calibration, **arguments: Any) -> xr.Dataset:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", CalibrationWarning)
        return correct(scan, calibration, **arguments)


@pytest.fixture(scope="module")
def scan(sighted: Sighted, lever: Probe, microscope: Instrument) -> xr.Dataset:
    return read_scan(sighted, lever, microscope, Drifted())


@pytest.fixture(scope="module")
def corrected(scan: xr.Dataset, calibrated: Calibration) -> xr.Dataset:
    return correct(scan, calibrated)


# --- what comes out -------------------------------------------------------------------------------


def test_a_scan_is_freed_of_what_the_microscope_added(
    scan: xr.Dataset, corrected: xr.Dataset, sighted: Sighted
) -> None:
    """Raw readings are off by many times the signal of 40 pm (soft) to 120 pm (stiff)."""
    soft, stiff = sighted.soft, ~sighted.soft
    raw = off_the_truth(scan, sighted.motion, soft)
    assert abs(raw["A0"]) > 1e-9
    assert raw["e2"] > 50e-12
    assert abs(raw["phi1"]) > 0.1
    for part in (soft, stiff):
        left = off_the_truth(corrected, sighted.motion, part)
        assert abs(left["A0"]) < 4e-12
        assert left["e2"] < 2.5e-12
        assert left["e3"] < 2.5e-12
        assert abs(left["phi1"]) < math.radians(0.3)


def test_the_difference_between_the_materials_is_kept(corrected: xr.Dataset, sighted: Sighted) -> None:
    """Anchoring moves both materials alike: their contrast is right to a picometre, whatever has drifted."""
    soft, stiff = (off_the_truth(corrected, sighted.motion, part) for part in (sighted.soft, ~sighted.soft))
    assert soft["A0"] == pytest.approx(stiff["A0"], rel=0, abs=2.5e-12)
    assert soft["phi1"] == pytest.approx(stiff["phi1"], rel=0, abs=2e-4)


def test_auto_finds_the_reference_and_nothing_else(corrected: xr.Dataset, sighted: Sighted) -> None:
    found = corrected["reference"].values == 1
    assert found[~sighted.soft].mean() > 0.98
    assert found[sighted.soft].mean() < 0.002
    assert corrected["reference"].attrs["flag_meanings"] == "other reference"


def test_a_mask_and_a_rectangle_say_the_same(
    scan: xr.Dataset, corrected: xr.Dataset, calibrated: Calibration, sighted: Sighted
) -> None:
    mask = xr.DataArray(~sighted.soft, dims=("y", "x"))
    marked = correct(scan, calibrated, reference=mask)
    # the largest rectangle without a domain, out of a few
    x, y = sighted.surface["x"].values, sighted.surface["y"].values
    places = [(i, j) for i in range(0, SIZE - 12, 4) for j in range(0, SIZE - 12, 4)]
    i, j = next(p for p in places if not sighted.soft[p[0] : p[0] + 12, p[1] : p[1] + 12].any())
    rectangle = (float(x[j]), float(y[i]), float(x[j + 11]), float(y[i + 11]))
    boxed = quietly(scan, calibrated, reference=rectangle)
    assert int(boxed["reference"].sum()) == 144
    # far from the box the zero has walked on by 3 pm a line, over 36 lines
    for other, close in ((marked, 2e-12), (boxed, 20e-12)):
        np.testing.assert_allclose(other["A0"].mean(), corrected["A0"].mean(), rtol=0, atol=close)
        np.testing.assert_allclose(other["A2"].mean(), corrected["A2"].mean(), rtol=0, atol=2e-12)
        np.testing.assert_allclose(other["phi1"].mean(), corrected["phi1"].mean(), rtol=0, atol=1e-3)


def test_a_walk_of_the_zero_is_followed_line_by_line(
    sighted: Sighted, lever: Probe, microscope: Instrument, calibrated: Calibration
) -> None:
    wild = read_scan(sighted, lever, microscope, Drifted(walk=20e-12, seed=4))
    done = correct(wild, calibrated)
    lines = np.nanmean(
        np.where(sighted.soft, np.nan, done["A0"].values - sighted.motion["A0"].values), axis=1
    )
    assert np.std(lines) < 1.5e-12
    assert any("drift of A0 along the slow axis" in said for said in provenance.findings(done))


def test_slopes_are_told_from_the_materials(corrected: xr.Dataset, sighted: Sighted) -> None:
    """The soft domains lie 12 nm deeper: at 2 nm/um of virtual deflection that alone is 24 pm."""
    left = calibration_of(corrected)
    assert left is not None
    assert left.values["A0_slope_x"] == pytest.approx(1.03e-3, rel=0.05)
    assert left.error("A0_slope_x") < 5e-5
    error = corrected["A0"].values - sighted.motion["A0"].values
    assert abs(np.polyfit(sighted.height[sighted.soft], error[sighted.soft], 1)[0]) < 2e-4


def test_matching_moves_no_more_than_what_may_have_drifted(
    corrected: xr.Dataset, calibrated: Calibration
) -> None:
    left = calibration_of(corrected)
    assert left is not None
    for name, width in DRIFT.items():
        moved = left.values[name] - calibrated.values[name]
        if name in ("free_amplitude", "resonance", "quality_factor"):
            moved = 0.0  # these are in the probe
        assert abs(moved) < 3.0 * math.hypot(width, calibrated.error(name))
    assert left.values["phi1_offset"] - calibrated.values["phi1_offset"] == pytest.approx(
        math.radians(0.5), abs=math.radians(0.3)
    )


def test_a_reference_does_not_sharpen_the_calibration_itself(
    corrected: xr.Dataset, calibrated: Calibration
) -> None:
    """Gains come from the curve: that the reference lies on a curve corrected with the same gains tells nothing new."""
    left = calibration_of(corrected)
    assert left is not None
    for name in ("gain0", "gain2", "latency2", "stiffness", "radius"):
        value = left.values[name] if name not in ("stiffness", "radius") else 1.0
        before = calibrated.error(name) / (
            calibrated.values[name] if name in ("stiffness", "radius") else 1.0
        )
        assert left.error(name) > 0.95 * before
        assert value > 0.0
    # what drifts in a moment is told, though, by three hundred times
    assert left.error("A0_offset") < 0.02 * DRIFT["A0_offset"]
    assert left.error("phi1_offset") < DRIFT["phi1_offset"]


def test_an_unsure_gain_stays_unsure_however_well_the_reference_fits(
    scan: xr.Dataset, calibrated: Calibration
) -> None:
    """The curve was made with the same wrong gain: that it fits says nothing of the gain, only of its drift."""
    wide = calibrated.covariance.copy()
    wide[calibrated.names.index("gain2"), calibrated.names.index("gain2")] = 0.1**2
    still = {"crosstalk2_re": 1e-13, "crosstalk2_im": 1e-13, "free_amplitude": 1e-4, "quality_factor": 1e-4}
    left = calibration_of(correct(scan, replace(calibrated, covariance=wide), drift=still))
    assert left is not None
    assert left.error("gain2") > 0.095
    assert left.values["gain2"] == pytest.approx(calibrated.values["gain2"], rel=0.02)


# --- does the stated error cover ------------------------------------------------------------------


class Worlds:
    """Scans whose instrument has drifted as `DRIFT` says, and calibrations that err as their covariance says."""

    def __init__(self, calibration: Calibration) -> None:
        self.calibration = calibration
        known = calibration.reference
        assert known is not None
        reference = {name: value for name, (value, _) in known.properties.items()}
        surface = blend(shape=(SIZE, SIZE), seed=1, size=3e-6)
        self.surface, self.soft = surface, surface["material"].values == 1
        values = {
            name: np.where(self.soft, surface[name].values, reference[name])
            for name in ("modulus", "adhesion")
        }
        self.material = sample("dmt", poisson_ratio=0.35, **values)
        here = self.held(calibration.values)
        height = here["Z"].values + surface["height"].values
        self.height = height - height.mean()
        self.where = positions(named(here, surface, height))
        self.base = signals_of(named(here, surface, height))
        self.slopes = {name: self._slope(name) for name in ("free_amplitude", "quality_factor", "resonance")}
        probe = probe_with(calibration.probe, calibration.values)
        curve = hold_amplitude(
            probe,
            sample("dmt", poisson_ratio=0.35, **reference),
            setpoint=np.linspace(0.2, 0.96, 24),
            n_max=6,
        )
        self.curve_height = curve["Z"].values - curve["Z"].values.max()
        names = ["A0", *(f"{letter}{n}" for n in (1, 2, 3) for letter in ("A", "phi"))]
        self.curve = redo(
            signals_of(curve[names]), calibration.values, calibration.amplitude, height=self.curve_height
        )
        scale = np.sqrt(np.diag(calibration.covariance))
        scale[scale == 0.0] = 1.0
        sizes, vectors = np.linalg.eigh(calibration.covariance / np.outer(scale, scale))
        self.root = scale[:, None] * vectors * np.sqrt(np.maximum(sizes, 0.0))

    def held(self, values: Mapping[str, float]) -> xr.Dataset:
        probe = probe_with(self.calibration.probe, values)
        setpoint = SETPOINT * self.calibration.amplitude / probe.drive.free_amplitude
        return hold_amplitude(probe, self.material, setpoint=setpoint, n_max=6, keep=3)

    def _slope(self, name: str) -> tuple[float, Signals]:
        step = 3e-5 if name == "resonance" else 0.01
        there = {**self.calibration.values, name: self.calibration.values[name] + step}
        return step, signals_of(named(self.held(there), self.surface, self.height))

    def motion(self, drift: Mapping[str, float]) -> Signals:
        """Return the motion under a lever that has drifted, linear about the one that has not."""
        assert self.base.mean is not None
        mean, phasor = self.base.mean.copy(), {n: a.copy() for n, a in self.base.phasor.items()}
        for name, (step, there) in self.slopes.items():
            assert there.mean is not None
            share = drift.get(name, 0.0) / step
            mean += share * (there.mean - self.base.mean)
            for n in phasor:
                phasor[n] += share * (there.phasor[n] - self.base.phasor[n])
        return Signals(mean, phasor)

    def drawn(self, seed: int) -> tuple[Calibration, xr.Dataset, Signals]:
        """Return a calibration that errs, a scan with drift and noise, and the true motion."""
        g, c = np.random.default_rng(seed), self.calibration
        wrong = dict(zip(c.names, self.root @ g.normal(size=len(c.names)), strict=True))
        values = {name: float(value + wrong.get(name, 0.0)) for name, value in c.values.items()}
        # a fit that ends there reproduces its curve with what it believes
        clean = undo(self.curve, values, c.amplitude, height=self.curve_height)
        frame = in_the_frame_of_the_first(clean)
        table = {
            "A1": np.abs(clean.phasor[1]),
            "phi1": np.mod(-np.angle(clean.phasor[1]), 2 * math.pi),
            "A0": clean.mean,
        }
        for n in (2, 3):
            table |= {f"e{n}_re": frame[n].real, f"e{n}_im": frame[n].imag}
        drift = {name: float(g.normal(0.0, width)) for name, width in DRIFT.items() if name in c.names}
        now = {name: value + drift.get(name, 0.0) for name, value in c.values.items()}
        motion = self.motion(drift)
        read = redo(motion, now, c.amplitude, **self.where._asdict())
        assert read.mean is not None
        shape = read.mean.shape
        walk = np.cumsum(g.normal(0.0, 3e-12, SIZE))[:, None]
        noisy = {
            n: a + g.normal(0, 1.4e-12, shape) + 1j * g.normal(0, 1.4e-12, shape)
            for n, a in read.phasor.items()
        }
        arrays = {"A0": (("y", "x"), read.mean + walk + g.normal(0.0, 1e-12, shape))}
        for n, a in noisy.items():
            arrays |= {
                f"A{n}": (("y", "x"), np.abs(a)),
                f"phi{n}": (("y", "x"), np.mod(-np.angle(a), 2 * math.pi)),
            }
        scan = xr.Dataset(arrays, self.surface.coords).assign(height=(("y", "x"), self.height))
        mistaken = replace(c, values=values, curve={n: np.asarray(v) for n, v in table.items()})
        return mistaken, with_reading(scan, Reading(c.probe)), motion

    def score(self, corrected: xr.Dataset, motion: Signals) -> np.ndarray:
        """Return errors of mean A0 and mean e2 on the other material over their stated standard deviations."""
        left = calibration_of(corrected)
        assert left is not None

        def means(signals: Signals) -> np.ndarray:
            assert signals.mean is not None
            e2 = in_the_frame_of_the_first(signals)[2][self.soft]
            return np.array([np.nanmean(signals.mean[self.soft]), np.nanmean(e2.real)])

        got, where = signals_of(corrected), self.where._asdict()
        read = redo(got, left.values, left.amplitude, **where)
        rows = []
        for name in left.names:
            step = 1e-2 * max(left.error(name), 1e-15)
            there = undo(read, {**left.values, name: left.values[name] + step}, left.amplitude, **where)
            rows.append((means(there) - means(got)) / step)
        J = np.array(rows).T
        sigma = np.sqrt(np.einsum("ij,jk,ik->i", J, left.covariance, J))
        score: np.ndarray = (means(got) - means(motion)) / sigma
        return score


def test_the_stated_error_covers_what_is_left(calibrated: Calibration) -> None:
    """The 90 % interval holds the truth of the other material in about 90 % of worlds, and is no wider than that."""
    worlds = Worlds(calibrated)
    scores = []
    for seed in range(100, 132):  # of 120 others 91 and 95 % were inside
        mistaken, scan, motion = worlds.drawn(seed)
        scores.append(worlds.score(quietly(scan, mistaken), motion))
    inside = (np.abs(scores) < 1.645).mean(axis=0)
    assert ((inside >= 0.80) & (inside <= 0.97)).all()
    assert np.sqrt(np.mean(np.square(scores), axis=0)) == pytest.approx([1.0, 1.0], abs=0.3)


# --- lift pass and curve --------------------------------------------------------------------------


def test_a_lift_pass_alone_gives_zero_phase_and_background(
    scan: xr.Dataset, sighted: Sighted, lever: Probe, microscope: Instrument, calibrated: Calibration
) -> None:
    above = read_scan(sighted, lever, microscope, Drifted(), lift=200e-9)
    done = correct(scan, calibrated, reference=None, lift=above)
    assert "reference" not in done
    left, bare = off_the_truth(done, sighted.motion, sighted.soft), calibration_of(done)
    assert bare is not None
    assert abs(left["A0"]) < 4e-12
    assert left["e2"] < 4e-12
    assert abs(left["phi1"]) < math.radians(0.3)
    assert bare.error("A0_offset") < 0.05 * DRIFT["A0_offset"]
    assert bare.error("phi1_offset") < math.radians(1.0)
    assert any("lift pass: phi1 drifted by" in said for said in provenance.findings(done))


def test_a_lift_pass_follows_phase_and_zero_over_the_lines(
    sighted: Sighted, lever: Probe, microscope: Instrument, calibrated: Calibration
) -> None:
    """The electronics turn by six degrees over the scan: crosstalk of 50 pm does not turn with them."""
    turn = np.linspace(-1.0, 1.0, SIZE)[:, None] * math.radians(3.0)

    def turned(scan: xr.Dataset) -> xr.Dataset:
        arrays = {}
        for n in (1, 2, 3):
            d = {1: 0.0, **microscope.crosstalk}[n] + (Drifted().crosstalk if n > 1 else 0.0)
            a = (scan[f"A{n}"].values * np.exp(-1j * scan[f"phi{n}"].values) - d) * np.exp(-1j * n * turn) + d
            arrays[f"A{n}"] = scan[f"A{n}"].copy(data=np.abs(a))
            arrays[f"phi{n}"] = scan[f"phi{n}"].copy(data=np.mod(-np.angle(a), 2 * math.pi))
        return scan.assign(arrays)

    moving = Drifted(walk=10e-12, seed=2)
    main, above = (
        turned(read_scan(sighted, lever, microscope, moving, lift=lift)) for lift in (None, 200e-9)
    )
    done = correct(main, calibrated, reference=None, lift=above)
    frame = (
        in_the_frame_of_the_first(signals_of(done))[2],
        in_the_frame_of_the_first(signals_of(sighted.motion))[2],
    )
    lines = (frame[0] - frame[1]).mean(axis=1)
    assert np.abs(lines - lines.mean()).max() < 2.5e-12  # turned with the rest, crosstalk would leave 5 pm
    phase = np.angle(signals_of(done).phasor[1] / signals_of(sighted.motion).phasor[1]).mean(axis=1)
    assert np.ptp(phase) < math.radians(0.03)  # of six degrees
    assert np.std((done["A0"].values - sighted.motion["A0"].values).mean(axis=1)) < 1.5e-12


def test_the_background_of_a_lift_pass_counts_with_its_phase(
    sighted: Sighted, lever: Probe, microscope: Instrument, calibrated: Calibration
) -> None:
    """Distortion and crosstalk are seen as one sum, with a1^2 turned by about -1: that alone may be learnt."""
    names, wide = calibrated.names, calibrated.covariance.copy()
    first = np.exp(-2j * (math.pi / 2.0 + microscope.phase_offset + Drifted().phase))
    for unit in (80e-12, 80e-12j):  # d + kappa (a1/A)^2 stays as it is
        open_ = np.zeros(len(names))
        for name, value in (("distortion2_0", unit), ("crosstalk2", -unit * first)):
            open_[names.index(f"{name}_re")] = complex(value).real
            open_[names.index(f"{name}_im")] = complex(value).imag
        wide += np.outer(open_, open_)
    loose = replace(calibrated, covariance=wide)
    above = read_scan(sighted, lever, microscope, Drifted(), lift=200e-9)
    scan = read_scan(sighted, lever, microscope, Drifted())
    one, other = (calibration_of(quietly(scan, c, reference=None, lift=above)) for c in (calibrated, loose))
    assert one is not None
    assert other is not None
    assert other.error("distortion2_0_re") > 60e-12  # what the lift pass cannot tell stays open
    assert abs(other.values["distortion2_0_re"] - one.values["distortion2_0_re"]) < 30e-12


def test_a_curve_is_corrected_by_its_own_far_part(
    lever: Probe,
    stiff: Sample,
    microscope: Instrument,
    motion_of: Factory,
    read_curve: Factory,
    calibrated: Calibration,
) -> None:
    motion = motion_of(lever, stiff, microscope)
    later = replace(microscope, mean_offset=2.4e-9, phase_offset=0.13)
    raw = read_curve(motion, lever, later, seed=20)
    done = correct(raw, calibrated)
    assert abs(np.mean(done["A0"].values[:60])) < 1e-12
    contact = np.arange(raw.sizes["z"]) >= 60
    assert abs(np.mean((done["A0"].values - motion["A0"].values)[contact])) < 5e-12
    assert np.abs(done["phi1"].values - motion["phi1"].values)[contact].mean() < 2e-3
    left = calibration_of(done)
    assert left is not None
    assert left.values["phi1_offset"] == pytest.approx(0.13, abs=1e-3)
    assert left.error("A0_offset") < 0.05 * DRIFT["A0_offset"]
    reading = reading_of(done)
    assert reading is not None
    assert reading.corrected


# --- what it carries ------------------------------------------------------------------------------


def test_the_calibration_travels_with_the_scan(
    corrected: xr.Dataset, scan: xr.Dataset, calibrated: Calibration
) -> None:
    left, reading = calibration_of(corrected), reading_of(corrected)
    assert left is not None
    assert reading is not None
    assert calibration_of(scan) is None
    assert reading.corrected
    assert reading.phase_established
    assert reading.alternatives == ()
    assert reading.doubts == {}
    assert left.names == calibrated.names
    # what was applied to the lever is in the probe, and the factors are one
    assert left.probe.drive.free_amplitude == pytest.approx(reading.probe.drive.free_amplitude, rel=1e-6)
    for name in ("stiffness", "quality_factor", "resonance", "free_amplitude", "radius"):
        assert left.values[name] == 1.0
    np.linalg.cholesky(left.covariance + 1e-12 * np.diag(np.diag(left.covariance)))
    entry = provenance.history(corrected)[-1]
    assert entry["operation"] == "correct"
    assert entry["arguments"]["applied"]["phi1_offset"] == pytest.approx(left.values["phi1_offset"])
    assert corrected["A0"].attrs["units"] == "m"


def test_damaged_text_in_the_attributes_is_named(corrected: xr.Dataset) -> None:
    with pytest.raises(CalibrationError, match="the calibration of the scan"):
        calibration_of(corrected.assign_attrs(calibration='{"calibration": {}}'))


A0_DOUBT = "A0 is as the file stores it: its zero far from the surface is not known"
LOCKED = "phi2 - 2 phi1 is constant to 0.010 rad and A2/A1^2 to 1.0 % over the scan"
SLOPE = "an optical lever reads slope: against a single-mode probe it shows A0 about 12 % high"


def doubtful(scan: xr.Dataset) -> xr.Dataset:
    reading = reading_of(scan)
    assert reading is not None
    scan = with_reading(
        scan, replace(reading, doubts={0: f"{A0_DOUBT}\n{SLOPE}", 2: f"{LOCKED}\n{SLOPE}", 3: SLOPE})
    )
    said = [f"DistortionWarning: {line}." for line in (A0_DOUBT, LOCKED, SLOPE)]
    return provenance.add_finding(scan, *said, "Rejected thermal.")


def test_doubts_that_are_settled_go_and_others_stay(scan: xr.Dataset, calibrated: Calibration) -> None:
    done = quietly(doubtful(scan), calibrated)
    reading = reading_of(done)
    assert reading is not None
    assert reading.doubts == {0: SLOPE, 2: SLOPE, 3: SLOPE}
    said = provenance.findings(done)
    assert said[:2] == [f"DistortionWarning: {SLOPE}.", "Rejected thermal."]
    assert not any(A0_DOUBT in sentence or LOCKED in sentence for sentence in said)
    assert any("left after correction" in sentence for sentence in said)


def test_the_doubt_about_slope_goes_with_a_lever_that_has_its_modes(
    scan: xr.Dataset, calibrated: Calibration
) -> None:
    lever = calibrated.probe.cantilever
    two = replace(lever, modes=(*lever.modes, replace(lever.modes[0], frequency=1e6)))
    probe = replace(
        calibrated.probe, cantilever=two, detector=replace(calibrated.probe.detector, kind="slope")
    )
    assert unsettled_findings(doubtful(scan), replace(calibrated, probe=probe)) == ["Rejected thermal."]


def test_a_harmonic_that_was_not_calibrated_is_doubted(scan: xr.Dataset, calibrated: Calibration) -> None:
    kept = [n for n in calibrated.names if not n.startswith("A0") and n != "gain0" and "distortion0" not in n]
    index = [calibrated.names.index(n) for n in kept]
    without = replace(
        calibrated,
        names=tuple(kept),
        covariance=calibrated.covariance[np.ix_(index, index)],
        curve={n: v for n, v in calibrated.curve.items() if n != "A0"},
    )
    with pytest.warns(CalibrationWarning, match="the calibration says nothing of harmonic 0"):
        done = correct(doubtful(scan), without)
    reading = reading_of(done)
    assert reading is not None
    assert A0_DOUBT in reading.doubts[0]
    assert "says nothing of harmonic 0" in reading.doubts[0]
    assert any(A0_DOUBT in sentence for sentence in provenance.findings(done))


def test_without_an_anchor_the_drift_is_left_and_said(scan: xr.Dataset, calibrated: Calibration) -> None:
    with pytest.warns(
        CalibrationWarning, match=r"nothing in the scan anchors A0 and phase.*drifted by 300 pm"
    ):
        done = correct(scan, calibrated, reference=None)
    left = calibration_of(done)
    assert left is not None
    assert left.error("A0_offset") == pytest.approx(DRIFT["A0_offset"], rel=0.01)
    assert left.values["A0_offset"] == pytest.approx(calibrated.values["A0_offset"], rel=1e-8)


# --- pixels that are not there --------------------------------------------------------------------


def test_nan_and_zero_pixels_do_nothing_to_the_others(
    scan: xr.Dataset, corrected: xr.Dataset, calibrated: Calibration, sighted: Sighted
) -> None:
    holes = scan.copy(deep=True)
    holes["A1"].values[3, 5] = math.nan
    holes["A0"].values[10, 11] = math.nan
    holes["A2"].values[20, 7] = math.nan
    holes["height"].values[30, 30] = math.nan
    for name in ("A0", "A1", "A2", "A3"):
        holes[name].values[40, 2] = 0.0
    done = correct(holes, calibrated)
    assert np.isnan(done["A1"].values[3, 5])
    assert np.isnan(done["A0"].values[10, 11])
    assert np.isnan(done["A2"].values[20, 7])
    assert done["A1"].values[40, 2] == 0.0
    for pixel in ((3, 5), (10, 11), (20, 7), (40, 2)):
        assert done["reference"].values[pixel] in (0, 1)
    others = np.ones((SIZE, SIZE), bool)
    others[[3, 10, 20, 30, 40], [5, 11, 7, 30, 2]] = False
    for name, close in (("A0", 1.5e-12), ("A2", 0.3e-12), ("phi1", 1e-3)):
        change = (done[name].values - corrected[name].values)[others]
        assert np.isfinite(change).all()
        assert np.abs(change).max() < close


def test_a_line_of_nan_is_bridged(scan: xr.Dataset, calibrated: Calibration, sighted: Sighted) -> None:
    gap = scan.copy(deep=True)
    for name in ("A0", "A1", "phi1", "A2", "phi2", "A3", "phi3"):
        gap[name].values[12] = math.nan
    done = correct(gap, calibrated)
    assert np.isnan(done["A0"].values[12]).all()
    left = off_the_truth(done, sighted.motion, sighted.soft)
    assert abs(left["A0"]) < 4e-12


# --- what is refused ------------------------------------------------------------------------------


def test_a_scan_is_corrected_once(corrected: xr.Dataset, calibrated: Calibration) -> None:
    with pytest.raises(CalibrationError, match="corrected before"):
        correct(corrected, calibrated)


def test_a_correction_needs_a_calibration_first(scan: xr.Dataset) -> None:
    with pytest.raises(CalibrationError, match="calibrate first, then correct"):
        correct(scan, None)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            lambda scan: with_reading(scan, replace(reading_of(scan), corrected=True)),
            "the scan is stated to be corrected",
        ),
        (
            lambda scan: with_reading(scan, Reading(Probe.simple(**PLAIN | {"drive_frequency": 160e3}))),
            r"different drives.*161\.8 kHz.*160 kHz",
        ),
        (lambda scan: scan.assign(A1=scan["A1"] * 5.0), "amplitudes of scan and calibration do not fit"),
        (
            lambda scan: scan.assign(A1=scan["A1"] * 5.0).drop_attrs(),
            "amplitudes of scan and calibration do not fit",
        ),
        (lambda scan: scan.assign(A1=scan["A1"] * 0.4), "amplitudes that the approach curve does not have"),
        (lambda scan: scan.expand_dims(direction=["trace"]), "the scan holds several directions"),
        (lambda scan: scan.isel(x=slice(0, 0)), "has no pixels"),
        (lambda scan: scan.drop_vars("phi1"), "observables lack phi1"),
        (lambda scan: scan.where(scan["x"] > 1.0), "no pixel has both"),
        (lambda scan: scan.assign(A2=scan["A2"] + 0.3e-9), "the reference is absent from the scan"),
    ],
)
def test_scans_that_do_not_fit_are_named(
    scan: xr.Dataset, calibrated: Calibration, change: Callable[[xr.Dataset], xr.Dataset], message: str
) -> None:
    with pytest.raises(OvertoneError, match=message):
        correct(change(scan), calibrated)


PLAIN: dict[str, Any] = {
    "stiffness": 16.4,
    "frequency": 161.8e3,
    "quality_factor": 287.0,
    "drive_frequency": 161.8e3,
    "free_amplitude": 94e-9,
}


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"reference": "everywhere"}, "unknown choice of the reference"),
        ({"reference": (0.0, 0.0, 1e-9, 1e-9)}, "too few pixels"),
        ({"reference": (0.0, 1.0)}, "a rectangle is four numbers"),
        ({"reference": xr.DataArray(np.ones((3, 3), bool), dims=("y", "x"))}, "does not fit the scan"),
        ({"drift": {"A0_zero": 1e-12}}, "'A0_zero' is no unknown"),
        ({"drift": {"A0_offset": -1.0}}, "the drift of A0_offset makes no sense"),
    ],
)
def test_arguments_that_make_no_sense_are_named(
    scan: xr.Dataset, calibrated: Calibration, arguments: dict[str, Any], message: str
) -> None:
    with pytest.raises(CalibrationError, match=message):
        correct(scan, calibrated, **arguments)


def test_a_mark_without_a_reference_in_the_calibration(scan: xr.Dataset, calibrated: Calibration) -> None:
    bare = replace(calibrated, reference=None)
    with pytest.raises(CalibrationError, match="the calibration has no reference"):
        correct(scan, bare, reference=(0.0, 0.0, 1e-6, 1e-6))
    assert "reference" not in quietly(scan, bare)


def test_a_scan_without_the_reference_material(
    sighted: Sighted, lever: Probe, microscope: Instrument, calibrated: Calibration, soft: Sample
) -> None:
    held = hold_amplitude(
        lever,
        sample("dmt", modulus=np.full((SIZE, SIZE), 93.78e6), poisson_ratio=0.35, adhesion=16.24e-9),
        setpoint=SETPOINT,
        n_max=6,
        keep=6,
    )
    only = replace(sighted, motion=named(held, sighted.surface, sighted.height))
    with pytest.raises(CalibrationError, match=r"the reference is absent from the scan.*reference=None"):
        correct(read_scan(only, lever, microscope, Drifted()), calibrated)


def test_lift_passes_that_do_not_fit(
    scan: xr.Dataset, sighted: Sighted, lever: Probe, microscope: Instrument, calibrated: Calibration
) -> None:
    above = read_scan(sighted, lever, microscope, Drifted(), lift=200e-9)
    with pytest.raises(CalibrationError, match="scan and lift pass do not fit"):
        correct(scan, calibrated, lift=above.isel(y=slice(0, 20)))
    off = above.assign(A1=above["A1"] * 1e-3)
    with pytest.raises(CalibrationError, match=r"not free of the sample, or its drive was off"):
        correct(scan, calibrated, lift=off)
    with pytest.raises(CalibrationError, match="not free of the sample"):
        correct(scan, calibrated, lift=scan)
    with pytest.raises(OvertoneError, match="no pixel has both"):
        correct(scan, calibrated, lift=above.where(above["x"] > 1.0))


# --- the state ------------------------------------------------------------------------------------


def test_a_measurement_of_the_drift_leaves_what_was_calibrated(calibrated: Calibration) -> None:
    state = drifting(calibrated, {"A0_offset": 0.3e-9, "gain2": 0.005})
    row = state.row(gain2=1.0)[None, :]
    done = state.compared(np.array([0.004]), row, row, np.array([1e-8]))
    assert done.values["gain2"] - done.calibrated["gain2"] == pytest.approx(0.004, rel=1e-3)
    assert done.error("gain2") == pytest.approx(math.hypot(calibrated.error("gain2"), 1e-4), rel=1e-2)
    direct = state.measured(np.array([0.004]), row, np.array([1e-8]))
    assert direct.error("gain2") == pytest.approx(1e-4, rel=1e-2)
    assert direct.values["gain2"] == pytest.approx(calibrated.values["gain2"] + 0.004, rel=1e-4)


def test_the_update_is_that_of_least_squares() -> None:
    """Against the normal equations, on three unknowns of very different size."""
    g = np.random.default_rng(5)
    root = np.diag([1e-12, 1.0, 1e3]) @ g.normal(size=(3, 3))
    prior = root @ root.T
    both = np.block([[prior, prior], [prior, prior]])
    values = {"A0_offset": 2e-12, "gain0": 0.5, "gain2": 300.0}
    state = State(dict(values), dict(values), tuple(values), both)
    H = g.normal(size=(2, 3)) / np.array([1e-12, 1.0, 1e3])
    variance = np.array([0.3, 0.7])
    off = np.array([0.4, -1.1])
    information = np.linalg.inv(prior / np.outer([1e-12, 1, 1e3], [1e-12, 1, 1e3]))
    scaled = H * np.array([1e-12, 1.0, 1e3])
    covariance = np.linalg.inv(information + scaled.T @ np.diag(1 / variance) @ scaled)
    change = covariance @ scaled.T @ (off / variance) * np.array([1e-12, 1.0, 1e3])
    done = state.measured(off, H, variance)
    for k, name in enumerate(values):
        assert done.values[name] - values[name] == pytest.approx(change[k], rel=1e-6)
        expected = math.sqrt(covariance[k, k]) * [1e-12, 1.0, 1e3][k]
        assert done.error(name) == pytest.approx(expected, rel=1e-6)
    assert done.error("gain9") == 0.0
    assert json.dumps(sorted(done.calibrated)) == json.dumps(sorted(values))


def test_positions_of_pixels_are_about_their_middle(sighted: Sighted) -> None:
    where = positions(sighted.motion)
    assert isinstance(where, Positions)
    for part in where:
        assert abs(part.mean()) < 1e-15
