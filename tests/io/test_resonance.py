import math
from pathlib import Path

import numpy as np
import pytest

from overtone.errors import ProbeError, ResonanceWarning, UncalibratedWarning
from overtone.io.recording import Fact, Recording, Resonance
from overtone.io.registry import read_channels
from overtone.io.resonance import rank_resonances, usable_resonances


def recording(free_phase: float | None, *resonances: Resonance, **facts: float) -> Recording:
    values = {"stiffness": 28.0, "drive_frequency": 256.9768e3, "free_amplitude": 33e-9} | facts
    records = {name: Fact(value, "", name) for name, value in values.items() if math.isfinite(value)}
    if free_phase is not None:
        records["free_phase"] = Fact(math.radians(free_phase), "rad", "FreeAirPhase")
    return Recording(Path("x.ibw"), "igor", "asylum", ("y", "x"), {}, (), records, resonances)


TUNE = Resonance("tune", 257.10e3, 391.72, ("TuneFreqResult", "TuneQResult"))
THERMAL = Resonance("thermal", 257.190e3, 471.15, ("ThermalFrequency", "ThermalQ"))


@pytest.mark.parametrize("order", [(TUNE, THERMAL), (THERMAL, TUNE)])
@pytest.mark.parametrize(("phase", "winner"), [(70.7, "tune"), (52.5, "thermal")])
def test_the_resonance_that_predicts_the_free_phase_wins(
    order: tuple[Resonance, Resonance], phase: float, winner: str
) -> None:
    with pytest.warns(ResonanceWarning, match=rf"Used {winner}.*Rejected"):
        tests = rank_resonances(recording(phase, *order))
    assert tests[0].resonance.source == winner
    assert len(tests) == 2


def test_a_real_scan_is_explained_by_its_tune(afm_data: Path) -> None:
    with pytest.warns(ResonanceWarning, match="Rejected thermal"):
        best, rejected = rank_resonances(read_channels(afm_data / "ibw" / "AR_20211011.ibw"))
    assert best.resonance.source == "tune"
    assert math.degrees(best.far_phase) == pytest.approx(69.4, abs=0.05)
    assert abs(math.degrees(best.phase_error or 9)) == pytest.approx(1.3, abs=0.05)
    assert best.amplitude_ratio == pytest.approx(0.986, abs=2e-3)
    assert math.degrees(rejected.far_phase) == pytest.approx(51.95, abs=0.1)
    assert rejected.amplitude_ratio == pytest.approx(1.172, abs=5e-3)


def test_no_resonance_that_fits_is_warned_of() -> None:
    with pytest.warns(ResonanceWarning, match="no resonance of the file fits"):
        rank_resonances(recording(5.0, TUNE))


def test_without_a_free_phase_the_tune_is_used_and_nothing_claimed() -> None:
    with pytest.warns(ResonanceWarning, match="no free-air phase stored"):
        best, _ = rank_resonances(recording(None, THERMAL, TUNE))
    assert best.resonance.source == "tune"
    assert best.phase_error is None


def test_factory_defaults_are_left_out_and_named() -> None:
    default = Resonance("thermal", 75e3, 20.0, ("ThermalFrequency", "ThermalQ"), factory_default=True)
    with pytest.warns(UncalibratedWarning, match="ThermalFrequency, ThermalQ"):
        (only,) = rank_resonances(recording(70.0, default, TUNE))
    assert only.resonance.source == "tune"


@pytest.mark.parametrize("name", ["stiffness", "drive_frequency", "free_amplitude"])
def test_what_a_probe_lacks_is_named(name: str) -> None:
    with pytest.raises(ProbeError, match=f"no {name.replace('_', ' ')}"):
        rank_resonances(recording(70.0, TUNE, **{name: np.nan}))
    with pytest.raises(ProbeError, match="no resonance"):
        rank_resonances(recording(70.0))


NOMINAL = Resonance("nominal", 256.9e3, 412.0, ("Prop1", "Prop4"))
CATALOGUE = Resonance("nominal", 257.0e3, 400.0, ("Prop1", "Prop4"), factory_default=True)


def test_a_nominal_resonance_gives_way_to_a_measured_one() -> None:
    (only,) = rank_resonances(recording(69.4, NOMINAL, TUNE))
    assert only.resonance.source == "tune"


def test_a_nominal_resonance_within_whose_width_the_drive_lies_is_used_with_a_warning() -> None:
    with pytest.warns(UncalibratedWarning, match=r"256.9 kHz with Q 412 \(Prop1, Prop4\).*nothing says"):
        (only,) = rank_resonances(recording(None, NOMINAL))
    assert only.resonance is NOMINAL


@pytest.mark.parametrize(
    "nominal",
    [
        CATALOGUE,  # round digits: however near, its Q is of no lever
        Resonance("nominal", 190.0e3, 500.0, ("Prop1", "Prop4"), factory_default=True),
        # beyond half a width: 256.9768 - 256.6 kHz over 256.6 kHz / 412
        Resonance("nominal", 256.6e3, 412.0, ("Prop1", "Prop4")),
    ],
)
def test_a_catalogue_never_becomes_the_probe(nominal: Resonance) -> None:
    with pytest.raises(
        ProbeError, match=r"no resonance frequency and quality factor \(\S+ kHz with Q .* is "
    ):
        rank_resonances(recording(70.0, nominal))
    assert usable_resonances(recording(70.0, nominal)) == ()


def test_the_catalogue_of_a_real_file_is_not_its_lever(afm_data: Path) -> None:
    """It was driven 9 % off the catalogue's resonance."""
    assert usable_resonances(read_channels(afm_data / "nanosurf" / "NSFopen_MoS2.nid")) == ()
    with pytest.warns(UncalibratedWarning, match="stands where the catalogue's values stand"):
        (only,) = rank_resonances(read_channels(afm_data / "nanosurf" / "NSFopen_grid1.nid"))
    assert only.resonance.frequency == pytest.approx(170.037e3, rel=1e-5)
