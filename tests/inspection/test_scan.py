"""What an inspection says, on every real file and on files that lack one thing each."""

import math
import re
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr

import overtone as ot
from overtone.errors import ChannelError, OvertoneError
from overtone.inspection.records import IF, NO, YES, Ask, ChannelRow, Inspection
from overtone.inspection.tables import numbers_text
from overtone.inspection.verdicts import ABSOLUTE, CALIBRATES, CONTRAST, ENERGIES, REGIME, RELATIVE
from overtone.io import gwyddion_bridge, zarr_store
from overtone.io.netcdf import save
from overtone.probe import Probe, load_probe
from overtone.provenance import add_finding, record
from overtone.quantities import named_array
from overtone.readings import Reading, with_reading
from overtone.units import conversion_factor

Made = Callable[..., bytes]
QUESTIONS = (ENERGIES, REGIME, CONTRAST, RELATIVE, ABSOLUTE)
PROBE = Probe.simple(
    stiffness=26.0, frequency=300e3, quality_factor=400.0, drive_frequency=300e3, free_amplitude=40e-9
)
ASYLUM = {
    "SpringConstant": "26",
    "ThermalQ": "400",
    "ThermalFrequency": "300000",
    "DriveFrequency": "300000",
    "AmpInvOLS": "4e-8",
    "FreeAirAmplitude": "1",
    "FreeAirPhase": "90",
    "ImagingMode": "AC Mode",
}
# What cannot be read, and says so itself.
UNREADABLE = ("ST_di_corrupted.di", "polar-graphs-demo.pxp")
# Folders of the files that the optional library reads.
BRIDGED = ("agilent", "nanonis", "ntmdt", "wsxm")


def answers(inspection: Inspection) -> dict[str, str]:
    return {verdict.question: verdict.answer for verdict in inspection.verdicts}


def verdict(inspection: Inspection, question: str) -> Any:
    return next(v for v in inspection.verdicts if v.question == question)


def options(inspection: Inspection) -> list[str]:
    return [ask.option for ask in inspection.asks if ask.option]


def texts(inspection: Inspection) -> str:
    """Everything that a person reads."""
    parts = [inspection.headline, inspection.format, *inspection.remarks, *inspection.made_by]
    parts += [f"{row.what} {row.remark} {row.purpose}" for row in inspection.missing]
    parts += [f"{ask.sentence} {ask.option}" for ask in inspection.asks]
    parts += [verdict.sentence() for verdict in inspection.verdicts]
    parts += [f"{row.name} {row.text} {row.remark}" for row in inspection.settings]
    parts += [row.remark for row in inspection.channels]
    return "\n".join(parts)


@pytest.fixture
def asylum(tmp_path: Path, igor_wave: Made) -> Callable[..., Path]:
    """Write an image with these layers; keywords replace lines of its note, None takes one out."""

    def write(layers: dict[str, np.ndarray] | None = None, **note: str | None) -> Path:
        rng = np.random.default_rng(1)
        layers = layers if layers is not None else first(rng)
        lines = {**ASYLUM, **note}
        text = "".join(f"{key}: {value}\r" for key, value in lines.items() if value is not None)
        stack = np.stack([layer.T[:, ::-1] for layer in layers.values()], axis=2).astype("<f4")
        labels = [[], [], list(layers)]
        path = tmp_path / "made.ibw"
        path.write_bytes(igor_wave(stack, note=text, labels=labels, kind=2))
        return path

    return write


def first(rng: np.random.Generator) -> dict[str, np.ndarray]:
    return {
        "AmplitudeRetrace": 30e-9 + 1e-10 * rng.standard_normal((12, 10)),
        "PhaseRetrace": 55.0 + 0.5 * rng.standard_normal((12, 10)),
    }


def harmonics(rng: np.random.Generator) -> dict[str, np.ndarray]:
    return first(rng) | {
        "DeflectionRetrace": 1e-10 + 1e-11 * rng.standard_normal((12, 10)),
        "Amplitude2Retrace": 1e-10 + 2e-11 * rng.standard_normal((12, 10)),
        "Phase2Retrace": 40.0 + 30 * rng.standard_normal((12, 10)),
    }


def inspected(path: Path, **arguments: Any) -> Inspection:
    """Inspect without a word: what is said stands in the inspection."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        result = ot.inspect_scan(path, **arguments)
    assert caught == []
    return result


# --- every real file --------------------------------------------------------------------------------


def real_files(folder: Path) -> list[Path]:
    """Every file that this installation can read."""
    files = [p for p in folder.rglob("*") if p.is_file() and p.suffix != ".md" and "neasnom" not in p.parts]
    readable = [p for p in files if p.name not in UNREADABLE and not needs_gwyddion(p)]
    return [*sorted(readable), folder / "neasnom" / "SnO2_NW4_hyp"]


def needs_gwyddion(path: Path) -> bool:
    """Whether only Gwyddion, which is not installed, could read the file."""
    return path.parent.name in BRIDGED and not gwyddion_bridge.is_installed()


def test_every_real_file_gets_a_whole_answer_in_plain_words(afm_data: Path) -> None:
    for path in real_files(afm_data):
        found = inspected(path)
        assert found.channels, path.name
        expected = (ENERGIES, REGIME, CALIBRATES) if found.kind == "curve" else QUESTIONS
        assert tuple(v.question for v in found.verdicts) == expected, path.name
        for said in found.verdicts:
            assert said.answer in (YES, IF, NO)
            assert bool(said.lacking) == (said.answer == IF)
            assert said.reason or said.answer == IF, path.name
        # nobody has to know the program to read it
        for internal in ("scale:", "offset:", "Warning", "open_scan", "('", "None", " nan", "Traceback"):
            assert internal not in texts(found), (path.name, internal)
        sentences = [ask.sentence for ask in found.asks]
        assert len(set(sentences)) == len(sentences) <= 8
        given = [word for option in options(found) for word in re.findall(r"--[\w-]+ \S+", option)]
        assert len(set(given)) >= len(given) - 1, path.name  # the probe file may serve twice
        assert all(s.endswith((".", "?")) and (s[0].isupper() or s[0].isdigit()) for s in sentences)
        assert answers(found)[ENERGIES] == YES or found.asks, path.name


def test_yes_means_that_it_opens(afm_data: Path) -> None:
    opened = 0
    for path in real_files(afm_data):
        found = inspected(path)
        opener = ot.open_curve if found.kind == "curve" else ot.open_scan
        if answers(found)[ENERGIES] == YES:
            opened += 1
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                assert "A1" in opener(path)
    assert opened == 1  # one real file describes everything that its energies take


ANSWERED: dict[str, dict[str, Any]] = {
    "nanosurf/NSFopen_MoS2.nid": {"direction": "trace"},
    "nanosurf/NSFopen_grid1.nid": {"direction": "retrace"},
    "jpk/TopoStats_file.jpk": {"direction": "retrace"},
    "jpk/AFMReader_sample_0.h5-jpk": {"direction": "trace", "frame": 2},
    "bruker/ST_di-3.di": {"scales": {"AmplitudeError": 60e-9}},
    "bruker/ST_di-4.di": {},
    "bruker/hystorian_test_nanonis.000": {"direction": "trace", "scales": {"AmplitudeError": 60e-9}},
    "neasnom/SnO2_NW4_hyp": {},
}


@pytest.mark.parametrize("name", ANSWERED)
def test_what_is_asked_for_is_all_it_takes(name: str, afm_data: Path) -> None:
    """Each answer on its own leaves the others on the list; with all of them the file opens."""
    path = afm_data / name
    drive = next(
        conversion_factor(row.text.split()[1], "Hz") * float(row.text.split()[0])
        for row in inspected(path).settings
        if row.name == "drive frequency"
    )
    probe = Probe.simple(
        stiffness=40.0, frequency=drive, quality_factor=300.0, drive_frequency=drive, free_amplitude=400e-9
    )
    given = {"probe": probe, "far_phase": 1.2, **ANSWERED[name]}
    flags = {
        "probe": "--probe",
        "far_phase": "--far-phase",
        "direction": "--direction",
        "frame": "--frame",
        "scales": "--scale",
    }
    bare = inspected(path)
    assert answers(bare)[ENERGIES] == IF
    for key in given:
        some = {k: v for k, v in given.items() if k != key}
        asked = [option for option in options(inspected(path, **some)) if option.startswith(flags[key])]
        needed = key != "probe" or "jpk/AFM" not in name  # that file describes its lever
        assert bool(asked) == needed, key
        assert (answers(inspected(path, **some))[ENERGIES] == YES) != needed, key
    whole = inspected(path, **given)
    assert answers(whole)[ENERGIES] in (YES, IF)
    assert verdict(whole, ENERGIES).lacking in ((), ("the phase far from the surface",))  # a made-up zero
    assert whole.probe_file == ""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        assert "A1" in ot.open_scan(path, **given)


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("ibw/IgorIBWReader_ImageStack_BTFO_DSO.ibw", "The file says PFM Mode (ImagingMode)"),
        ("ibw/DTMicroscope_scan_0001_DART.ibw", "The file says PFM Mode (ImagingMode)"),
        ("nsid_h5/DTMicroscope_PMN28Pt0000.h5", "The file says PFM Mode (ImagingMode)"),
        ("bruker/ST_di-5.di", "It has the channels of PeakForce tapping"),
        ("agilent/ST_mi-1.mi", "The file says Contact AFM (mode)"),
        ("nanonis/A151216.123306-02602.sxm", "It has the channels of frequency modulation"),
        ("ibw_curves/afmformats_SiN_FD_plot.ibw", "The file says Contact (ImagingMode)"),
    ],
)
def test_what_was_not_recorded_in_tapping_mode_gives_nothing(name: str, said: str, afm_data: Path) -> None:
    if name.startswith(("agilent", "nanonis")):
        pytest.importorskip("gwyddionpy")
    found = inspected(afm_data / name)
    assert set(answers(found).values()) == {NO}
    assert all(v.reason.startswith(said) for v in found.verdicts)
    assert [row.what for row in found.missing] == ["tapping (AC) mode"]
    assert found.asks[0].later
    assert "tapping (AC) mode" in found.asks[0].sentence
    assert options(found) == []
    assert found.probe_file == ""


def test_a_calibrated_scan_gives_energies_and_no_modulus(afm_data: Path) -> None:
    found = inspected(afm_data / "ibw" / "AR_20211011.ibw")
    assert answers(found) == {ENERGIES: YES, REGIME: YES, CONTRAST: NO, RELATIVE: NO, ABSOLUTE: NO}
    assert "Not recorded: mean deflection (A0)" in verdict(found, CONTRAST).reason
    # the share that both resonances of the file agree on; the rest hangs on which is right
    assert verdict(found, REGIME).reason.startswith("Of the pixels: attractive 16.6 %, undetermined 83.4 %")
    assert "128 x 128 pixels, 4 x 4 µm; mode: AC Mode" in found.headline
    rows = {row.name: row for row in found.channels}
    assert [rows[name].used_as for name in ("Amplitude", "Phase", "ZSensor", "Height")] == [
        "A1",
        "phi1",
        "height",
        "",
    ]
    assert rows["Amplitude"].mean == pytest.approx(30.83e-9, rel=1e-3, abs=0)
    assert rows["Height"].remark == "flattened"
    settings = {row.name: (row.text, row.key) for row in found.settings}
    assert settings["stiffness k of the lever"] == ("27.952 N/m", "SpringConstant")
    assert settings["resonance f0 of the tune"] == ("257.1 kHz, Q 391.7", "TuneFreqResult, TuneQResult")
    assert "second lock-in frequency" not in settings  # nobody recorded one
    assert (options(found), found.probe_file) == ([], "")
    assert any("Rejected thermal" in remark for remark in found.remarks)


def test_factory_defaults_give_not_even_joules(afm_data: Path) -> None:
    found = inspected(afm_data / "ibw" / "tono_whiskers.ibw")
    energies = verdict(found, ENERGIES)
    assert (energies.answer, energies.lacking) == (
        IF,
        ("a measured k", "a calibrated sensitivity", "the phase far from the surface"),
    )
    assert "neither joules nor newtons" in energies.reason
    assert verdict(found, REGIME).lacking == ("the phase far from the surface",)  # a sign has no scale
    defaults = [row.key for row in found.settings if row.remark == "factory default"]
    assert "SpringConstant" in defaults
    assert "AmpInvOLS" in defaults
    assert any("5.2 deg in the file" in row.remark for row in found.missing)
    assert '[cantilever]\nstiffness = "? N/m"' in found.probe_file
    assert 'free_amplitude = "242.5141 nm"' in found.probe_file  # in the metres of A1, nominal as they are


def test_mixed_line_directions_are_a_question(afm_data: Path) -> None:
    path = afm_data / "bruker" / "hystorian_test_nanonis.000"
    found = inspected(path)
    assert options(found)[0] == "--direction trace"  # amplitude and phase of the retrace do not exist
    assert {row.name: row.used_as for row in found.channels if row.used_as} == {
        "Phase": "phi1",
        "AmplitudeError": "A1",
    }
    assert "+ set-point" in next(row.remark for row in found.channels if row.name == "AmplitudeError")
    assert "--direction trace" not in options(inspected(path, direction="trace"))
    with pytest.raises(ChannelError, match="has no approach"):
        ot.inspect_scan(path, direction="approach")


def test_a_catalogue_is_no_lever(afm_data: Path) -> None:
    found = inspected(afm_data / "nanosurf" / "NSFopen_MoS2.nid")
    remarks = {row.what: row.remark for row in found.missing}
    assert "of the catalogue, not of this lever" in remarks["resonance f0 and quality factor Q"]
    assert "a factory default" in remarks["stiffness k of the lever"]
    assert 'frequency = "? kHz"' in found.probe_file
    near = inspected(afm_data / "nanosurf" / "NSFopen_grid1.nid", direction="trace", far_phase=1.4)
    assert "f0 and Q confirmed" in verdict(near, ENERGIES).lacking
    assert "not measured" in next(r.remark for r in near.settings if r.key == "Prop1, Prop4")


def test_a_curve_at_the_free_resonance_asks_for_a_word(afm_data: Path) -> None:
    """Its note names the mode of the images around it."""
    found = inspected(afm_data / "ibw_curves" / "LRCol0_MS_LG7d0001.ibw")
    assert found.kind == "curve"
    assert answers(found) == {ENERGIES: IF, REGIME: IF, CALIBRATES: IF}
    assert found.asks == (Ask("Was the curve recorded in tapping mode?"),)


def test_harmonics_without_units_are_asked_for(afm_data: Path) -> None:
    path = afm_data / "neasnom" / "SnO2_NW4_hyp"
    found = inspected(path)
    assert '--scale M0A="? nm" --scale M2A="? nm"' in options(found)
    assert "the unit of M0A" in verdict(found, CONTRAST).lacking
    assert next(row.remark for row in found.channels if row.name == "M2A") == "no unit"
    scaled = inspected(path, scales={"M0A": 1e-12, "M2A": 1e-12})
    assert not any(option.startswith("--scale") for option in options(scaled))


# --- one thing missing --------------------------------------------------------------------------------


def test_a_scan_of_everything_but_the_calibration(asylum: Callable[..., Path]) -> None:
    layers = harmonics(np.random.default_rng(2))
    found = inspected(asylum(layers, DriveFrequency1="600000", InvOLS="4e-8"))
    assert (answers(found)[ENERGIES], answers(found)[REGIME]) == (YES, YES)
    contrast, relative, absolute = (verdict(found, question) for question in (CONTRAST, RELATIVE, ABSOLUTE))
    assert contrast.lacking == ("the modes of the lever", "an approach curve on a reference material")
    assert relative.lacking == ("what contrast takes", "a reference material of known modulus in the scan")
    assert absolute.lacking == ("what contrast takes", "the tip radius", "Poisson's ratio of the sample")
    assert options(found) == ["--probe probe.toml", '--radius "? nm"']
    known = inspected(asylum(layers, DriveFrequency1="600000"), corrected=True, radius=1e-8)
    assert verdict(known, CONTRAST).lacking == ("the modes of the lever",)
    assert "--radius" not in " ".join(options(known))


def test_a_lever_with_modes_and_radius_needs_none(asylum: Callable[..., Path]) -> None:
    lever = ot.preset("PPP-NCHR", free_amplitude=40e-9, frequency=300e3, drive_frequency=300e3, stiffness=26.0,
                      quality_factor=400.0, radius=1e-8)  # fmt: skip
    path = asylum(harmonics(np.random.default_rng(2)), DriveFrequency1="600000")
    found = inspected(path, probe=lever, corrected=True)
    assert answers(found) == {ENERGIES: YES, REGIME: YES, CONTRAST: YES, RELATIVE: IF, ABSOLUTE: IF}
    assert verdict(found, ABSOLUTE).lacking == ("Poisson's ratio of the sample",)


def test_a_second_lock_in_elsewhere_is_no_second_harmonic(asylum: Callable[..., Path]) -> None:
    found = inspected(asylum(harmonics(np.random.default_rng(2)), DriveFrequency1="450000"))
    assert answers(found)[CONTRAST] == NO
    assert "listened at 450 kHz, not at twice the drive" in verdict(found, CONTRAST).reason


def test_inputs_of_the_user_may_hold_a_harmonic(asylum: Callable[..., Path]) -> None:
    rng = np.random.default_rng(3)
    layers = first(rng) | {
        "UserIn0Retrace": 0.1 * rng.random((12, 10)),
        "DeflectionRetrace": 1e-11 * rng.random((12, 10)),
    }
    found = inspected(asylum(layers))
    assert answers(found)[CONTRAST] == IF
    assert "--channel A2=UserIn0" in options(found)


def test_an_offset_in_the_deflection_is_seen(asylum: Callable[..., Path]) -> None:
    layers = harmonics(np.random.default_rng(2))
    layers["DeflectionRetrace"] += 40e-9
    found = inspected(asylum(layers, DriveFrequency1="600000"))
    assert "the zero of A0" in verdict(found, CONTRAST).lacking
    assert "an offset" in next(row.remark for row in found.channels if row.used_as == "A0")


@pytest.mark.parametrize(
    ("note", "lacking", "option"),
    [
        ({"SpringConstant": None}, "k", "--probe probe.toml"),
        ({"SpringConstant": "1"}, "a measured k", "--probe probe.toml"),
        ({"ThermalQ": None}, "f0 and Q", "--probe probe.toml"),
        ({"DriveFrequency": None}, "the drive frequency", "--probe probe.toml"),
        ({"FreeAirAmplitude": None}, "the free amplitude", "--probe probe.toml"),
        ({"AmpInvOLS": "1.09e-7"}, "a calibrated sensitivity", None),
        ({"FreeAirPhase": "40"}, "the phase far from the surface", '--far-phase "? deg"'),
        # an amplitude that averages more than the free one
        ({"FreeAirAmplitude": "0.5"}, "a calibrated sensitivity", None),
    ],
)
def test_each_thing_that_energies_take(
    asylum: Callable[..., Path], note: dict[str, str | None], lacking: str, option: str | None
) -> None:
    assert answers(inspected(asylum()))[ENERGIES] == YES
    found = inspected(asylum(**note))
    assert verdict(found, ENERGIES).lacking == (lacking,)
    assert options(found) == ([option] if option else [])
    assert len([row for row in found.missing if row.purpose.startswith("energies")]) == 1


def test_a_second_harmonic_that_the_detector_explains_needs_a_calibration(
    asylum: Callable[..., Path],
) -> None:
    layers = harmonics(np.random.default_rng(2))
    del layers["DeflectionRetrace"]
    layers |= {"Amplitude3Retrace": layers["Amplitude2Retrace"], "Phase3Retrace": layers["Phase2Retrace"]}
    free = inspected(asylum(layers, DriveFrequency1="600000"))
    assert verdict(free, CONTRAST).lacking == ("the modes of the lever",)
    layers["Amplitude2Retrace"] = 1e5 * layers["AmplitudeRetrace"] ** 2
    layers["Phase2Retrace"] = 2.0 * layers["PhaseRetrace"] + 10.0
    locked = inspected(asylum(layers, DriveFrequency1="600000"))
    assert verdict(locked, CONTRAST).lacking == (
        "the modes of the lever",
        "an approach curve on a reference material",
    )
    assert any(remark.startswith("phi2 - 2 phi1 is constant") for remark in locked.remarks)


def test_what_nothing_explains_is_said_as_it_is(asylum: Callable[..., Path]) -> None:
    layers = first(np.random.default_rng(1))
    layers["AmplitudeRetrace"][0, 0] = -1e-9
    found = inspected(asylum(layers))
    assert answers(found)[ENERGIES] == NO
    assert verdict(found, ENERGIES).reason.startswith("A1 is negative in 1 of 120 pixels")


@pytest.mark.parametrize("gone", ["AmplitudeRetrace", "PhaseRetrace"])
def test_without_amplitude_or_phase_there_is_nothing(asylum: Callable[..., Path], gone: str) -> None:
    layers = {k: v for k, v in first(np.random.default_rng(1)).items() if k != gone}
    found = inspected(asylum(layers))
    assert set(answers(found).values()) == {NO}
    assert found.asks[0].later
    assert gone.removesuffix("Retrace").lower() in found.asks[0].sentence


def test_amplitude_and_phase_in_opposite_directions_never_meet(asylum: Callable[..., Path]) -> None:
    rng = np.random.default_rng(1)
    made = first(rng)
    found = inspected(
        asylum({"AmplitudeTrace": made["AmplitudeRetrace"], "PhaseRetrace": made["PhaseRetrace"]})
    )
    assert set(answers(found).values()) == {NO}
    assert "opposite line directions" in verdict(found, ENERGIES).reason
    assert "same line direction" in found.asks[0].sentence


def test_both_directions_are_a_choice(asylum: Callable[..., Path]) -> None:
    rng = np.random.default_rng(1)
    layers = first(rng) | {k.replace("Retrace", "Trace"): v for k, v in first(rng).items()}
    found = inspected(asylum(layers))
    assert verdict(found, ENERGIES).lacking == ("the choice of a line direction",)
    assert options(found) == ["--direction trace"]
    assert answers(inspected(asylum(layers), direction="retrace"))[ENERGIES] == YES
    layers |= {name: layer for name, layer in harmonics(rng).items() if name not in layers}
    fuller = inspected(asylum(layers, DriveFrequency1="600000"))  # the retrace has harmonics
    assert options(fuller)[0] == "--direction retrace"


def test_flattened_amplitudes_are_lost(asylum: Callable[..., Path]) -> None:
    note = {"Flatten Offsets 0": "1e-9;2e-9", "FlattenOrder 0": "1"}
    found = inspected(asylum(**note))
    assert set(answers(found).values()) == {NO}
    assert "its absolute value is lost" in verdict(found, ENERGIES).reason
    assert "raw file" in found.asks[0].sentence


def test_saturated_and_invalid_pixels_are_told(asylum: Callable[..., Path]) -> None:
    layers = first(np.random.default_rng(1))
    phase = layers["PhaseRetrace"]
    phase[phase > np.percentile(phase, 60)] = np.float32(np.percentile(phase, 60))
    layers["AmplitudeRetrace"][0, :3] = np.nan
    remarks = {row.name: row.remark for row in inspected(asylum(layers)).channels}
    assert remarks == {"Amplitude": "3 invalid pixels", "Phase": "saturated"}


def test_a_phase_that_makes_energy_is_doubted(asylum: Callable[..., Path]) -> None:
    layers = first(np.random.default_rng(1))
    layers["PhaseRetrace"] = -layers["PhaseRetrace"]
    found = inspected(asylum(layers))
    assert "sign or zero of the phase" in next(r.remark for r in found.missing if r.what.startswith("phase"))
    assert verdict(found, REGIME).lacking == ("the phase far from the surface",)


def test_a_table_of_nobody_asks_for_lever_and_zero(tmp_path: Path) -> None:
    path = tmp_path / "scan.csv"
    path.write_text("A1 [nm], phi1 [deg]\n16.5, 24.9\n16.4, 25.3\n", encoding="utf-8")
    found = inspected(path)
    assert found.kind == "points"
    assert verdict(found, ENERGIES).lacking == (
        "k",
        "f0 and Q",
        "the drive frequency",
        "the free amplitude",
        "the phase far from the surface",
    )
    assert answers(inspected(path, probe=PROBE, far_phase=1.57))[ENERGIES] == YES
    path.write_text("amp, lag [deg]\n16.5, 24.9\n16.4, 25.3\n", encoding="utf-8")
    found = inspected(path)
    assert options(found) == ['--channel A1="amp"', '--channel phi1="lag"']
    named = inspected(path, channels={"A1": "amp", "phi1": "lag"}, probe=PROBE, far_phase=1.57)
    assert verdict(named, ENERGIES).lacking == ("the unit of the amplitude",)
    assert '--scale amp="? nm"' in options(named)


def test_the_probe_file_has_to_be_completed(asylum: Callable[..., Path], tmp_path: Path) -> None:
    path = asylum(SpringConstant="1")
    found = inspected(path)
    file = tmp_path / "probe.toml"
    file.write_text(found.probe_file, encoding="utf-8")
    with pytest.raises(OvertoneError, match="stiffness is not a number with a unit"):
        load_probe(file)
    file.write_text(found.probe_file.replace("? N/m", "26 N/m"), encoding="utf-8")
    probe = load_probe(file)
    assert probe.cantilever.modes[0].quality_factor == 400.0
    assert probe.drive.free_amplitude == pytest.approx(40e-9, rel=1e-9, abs=0)
    assert answers(inspected(path, probe=probe))[ENERGIES] == YES


def test_arguments_that_the_file_does_not_have_are_refused(asylum: Callable[..., Path]) -> None:
    path = asylum()
    for arguments in ({"channels": {"A2": "nope"}}, {"direction": "trace"}, {"frame": 2}, {"lift": True}):
        with pytest.raises(ChannelError):
            ot.inspect_scan(path, **arguments)


# --- what overtone saved --------------------------------------------------------------------------------


@pytest.fixture
def scan() -> xr.Dataset:
    rng = np.random.default_rng(4)
    coords = {
        "y": ("y", np.linspace(3e-6, 0.0, 4), {"units": "m"}),
        "x": ("x", np.linspace(0.0, 2e-6, 5), {"units": "m"}),
    }
    values = {"A0": 1e-10, "A1": 20e-9, "phi1": 0.6, "A2": 1e-10, "phi2": 4.0}
    arrays = {
        name: named_array(name, mean * (1 + 0.05 * rng.standard_normal((4, 5))), ("y", "x"))
        for name, mean in values.items()
    }
    return with_reading(xr.Dataset(arrays, coords), Reading(PROBE, corrected=True))


def result_of(scan: xr.Dataset, **attributes: str) -> xr.Dataset:
    modulus = np.linspace(1e9, 2e9, 20).reshape(4, 5)
    modulus[0, 0] = np.nan
    arrays = {
        "modulus": named_array("modulus", modulus, ("y", "x")),
        "modulus_lower": named_array("modulus_lower", 0.5 * modulus, ("y", "x")),
        "modulus_upper": named_array("modulus_upper", 2.0 * modulus, ("y", "x")),
        "dissipation": named_array("dissipation", np.full((4, 5), 3e-18), ("y", "x")),
        "regime": named_array(
            "regime",
            np.array([1] * 15 + [0] * 5, np.int8).reshape(4, 5),
            ("y", "x"),
            flag_values=[-1, 0, 1],
            flag_meanings="attractive undetermined repulsive",
        ),
        "status": named_array(
            "status",
            np.array([1] + [0] * 19, np.int8).reshape(4, 5),
            ("y", "x"),
            flag_values=[0, 1],
            flag_meanings="determined not_determined_by_these_data",
        ),
    }
    result = record(scan.assign(arrays), "open_scan", path="/data/a.ibw", far_phase=math.pi / 2)
    result = record(result, "map_properties", model="dmt", probe="[cantilever]\nmuch", poisson_ratio=0.35)
    return add_finding(result, "Noise was not stated.").assign_attrs(attributes)


@pytest.mark.parametrize("ending", [".nc", ".zarr"])
def test_a_saved_scan_is_a_scan(scan: xr.Dataset, tmp_path: Path, ending: str) -> None:
    path = tmp_path / f"scan{ending}"
    if ending == ".zarr":
        pytest.importorskip("zarr")
    (save if ending == ".nc" else zarr_store.save)(scan, path)
    found = inspected(path)
    assert (found.kind, found.format) == ("scan", "netCDF (.nc)" if ending == ".nc" else "Zarr store (.zarr)")
    assert (answers(found)[ENERGIES], answers(found)[CONTRAST]) == (YES, YES)
    assert verdict(found, ABSOLUTE).lacking == ("the tip radius", "Poisson's ratio of the sample")
    assert verdict(found, REGIME).reason == "Of the pixels: repulsive 100 %."


@pytest.mark.parametrize("ending", [".nc", ".zarr"])
def test_a_result_says_what_is_in_it_and_how_it_was_made(
    scan: xr.Dataset, tmp_path: Path, ending: str
) -> None:
    path = tmp_path / f"maps{ending}"
    if ending == ".zarr":
        pytest.importorskip("zarr")
    (save if ending == ".nc" else zarr_store.save)(result_of(scan), path)
    found = inspected(path)
    assert (found.kind, found.channels, found.missing, found.asks) == ("result", (), (), ())
    assert found.headline == "a result of overtone (map_properties): 5 x 4 pixels, 2 x 3 µm"
    rows = {row.name: row for row in found.properties}
    assert set(rows) == {"modulus", "dissipation"}
    modulus = rows["modulus"]
    assert modulus.share == 0.95
    values = np.linspace(1e9, 2e9, 20)[1:]
    assert modulus.median == pytest.approx(np.median(values), rel=1e-12, abs=0)
    assert (modulus.low, modulus.high) == pytest.approx(
        tuple(np.percentile(values, (5, 95))), rel=1e-12, abs=0
    )
    assert (modulus.lower, modulus.upper) == pytest.approx(
        (modulus.median / 2, modulus.median * 2), rel=1e-12
    )
    assert math.isnan(rows["dissipation"].lower)
    assert found.made_by[0].endswith(": path a.ibw; far phase 90 deg")
    assert found.made_by[1].endswith(": model dmt; poisson ratio 0.35")  # the probe is long
    assert "Noise was not stated." in found.remarks
    assert verdict(found, REGIME).reason == "Of the pixels: undetermined 25.0 %, repulsive 75.0 %."
    assert (
        verdict(found, CONTRAST).reason
        == "Of the pixels: determined 95.0 %, not determined by these data 5.0 %."
    )
    assert verdict(found, ABSOLUTE).lacking == ("a correction that is right",)


@pytest.mark.parametrize(
    ("attributes", "expected"),
    [
        ({"verdict": "absolute", "verdict_reason": "Good."}, (YES, YES, YES)),
        ({"verdict": "relative", "verdict_reason": "The radius."}, (YES, YES, NO)),
        ({"verdict": "contrast", "verdict_reason": "No reference."}, (YES, NO, NO)),
        ({"cannot_conclude": "The zero of A0."}, (NO, NO, NO)),
        ({"corrected": "False"}, (YES, NO, NO)),
        ({"calibration": "[calibration]"}, (YES, IF, IF)),
    ],
)
def test_the_verdict_of_a_result_is_repeated(
    scan: xr.Dataset, tmp_path: Path, attributes: dict[str, str], expected: tuple[str, ...]
) -> None:
    save(result_of(scan, **attributes), tmp_path / "maps.nc")
    found = inspected(tmp_path / "maps.nc")
    assert tuple(answers(found)[question] for question in (CONTRAST, RELATIVE, ABSOLUTE)) == expected
    if "verdict_reason" in attributes:
        assert verdict(found, ABSOLUTE).reason == attributes["verdict_reason"]


def test_materials_of_a_pooled_result_are_told(scan: xr.Dataset, tmp_path: Path) -> None:
    pooled = result_of(scan).assign_coords(material=["soft_phase", "matrix"])
    for name, values in {"": (1e8, 2e9), "_lower": (0.8e8, 1e9), "_upper": (1.2e8, 4e9)}.items():
        pooled[f"material_modulus{name}"] = ("material", list(values), {"units": "Pa"})
    pooled["material_pixels"] = ("material", [8, 12])
    save(pooled, tmp_path / "maps.nc")
    remarks = inspected(tmp_path / "maps.nc").remarks
    assert remarks[:2] == (
        "Material soft phase: modulus 100 MPa (90 %: 80 MPa .. 120 MPa), 8 pixels.",
        "Material matrix: modulus 2 GPa (90 %: 1 GPa .. 4 GPa), 12 pixels.",
    )


def test_a_simulated_curve_is_a_curve(tmp_path: Path) -> None:
    z = np.linspace(60e-9, 10e-9, 60)
    amplitude = np.minimum(40e-9, z + 1e-9)
    arrays = {
        "A1": named_array("A1", amplitude, ("z",)),
        "phi1": named_array("phi1", np.arcsin(amplitude / 40e-9), ("z",)),
        "A0": named_array("A0", 1e-12 * np.ones(60), ("z",)),
    }
    curve = xr.Dataset(arrays, {"z": ("z", z, {"units": "m"})})
    save(with_reading(curve, Reading(PROBE)), tmp_path / "curve.nc")
    found = inspected(tmp_path / "curve.nc")
    assert found.kind == "curve"
    assert "60 points, 50 nm of height" in found.headline
    assert answers(found) == {ENERGIES: YES, REGIME: YES, CALIBRATES: YES}


def test_a_plan_is_no_map(tmp_path: Path) -> None:
    grid = ("lever", "free_amplitude", "setpoint")
    modulus = named_array("modulus", np.full((1, 2, 3), 1e9), grid)
    plan = xr.Dataset({"modulus": modulus, "status": (grid, np.zeros((1, 2, 3), np.int8))})
    save(record(plan, "plan_experiment", model="dmt"), tmp_path / "plan.nc")
    found = inspected(tmp_path / "plan.nc")
    assert found.headline.startswith("a result of overtone (plan_experiment): 1 lever, 2 free_amplitude")
    assert [row.name for row in found.properties] == ["modulus"]
    assert found.verdicts == ()


def test_what_a_simulation_knows_of_a_curve_makes_it_no_result(tmp_path: Path) -> None:
    z = np.linspace(60e-9, 10e-9, 60)
    made = {"A1": np.minimum(40e-9, z), "phi1": z * 0.0 + 0.5, "indentation": z, "dissipation": 0.0 * z}
    curve = xr.Dataset(
        {k: named_array(k, v, ("z",)) for k, v in made.items()}, {"z": ("z", z, {"units": "m"})}
    )
    save(curve, tmp_path / "curve.nc")
    assert inspected(tmp_path / "curve.nc").kind == "curve"


# --- numbers ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("unit", "mean", "low", "high", "expected"),
    [
        ("m", -2.6e-17, -3.25e-8, 5.08e-8, ("nm", "0", "-32.5 .. 50.8")),
        ("rad", math.pi / 4, 0.0, math.pi / 2, ("deg", "45", "0 .. 90")),
        ("V", 0.1251, 0.0141, 0.2125, ("mV", "125.1", "14.1 .. 212.5")),
        (None, 44.16, 39.37, 48.46, ("none", "44.16", "39.37 .. 48.46")),
        ("1", 0.5, 0.5, 0.5, ("1", "0.5", "0.5")),
        ("A", 1.5e-13, -2e-14, 3e-13, ("fA", "150", "-20 .. 300")),
        ("m", math.nan, math.nan, math.nan, ("m", "-", "-")),
    ],
)
def test_numbers_have_the_digits_of_their_range(
    unit: str | None, mean: float, low: float, high: float, expected: tuple[str, str, str]
) -> None:
    assert numbers_text(ChannelRow("c", unit, None, "", mean, low, high, "")) == expected
