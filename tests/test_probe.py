import re
from dataclasses import replace
from pathlib import Path

import pytest

import overtone as ot
from overtone.errors import ProbeError
from overtone.probe import Cantilever, Detector, Drive, Mode, Probe, Tip, format_probe, parse_probe

SIMPLE = {
    "stiffness": 16.4,
    "frequency": 161.8e3,
    "quality_factor": 287.0,
    "radius": 10e-9,
    "drive_frequency": 161.8e3,
    "free_amplitude": 94e-9,
}

TEXT = """
[cantilever]
stiffness = "16.4 N/m"
frequency = "161.8 kHz"
quality_factor = 287

[drive]
frequency = "161.8 kHz"
free_amplitude = "94 nm"

[tip]
radius = "10 nm"
"""


def test_toml_gives_the_same_probe_as_the_call() -> None:
    assert parse_probe(TEXT) == Probe.simple(**SIMPLE)


@pytest.mark.parametrize(
    "probe",
    [
        Probe.simple(**SIMPLE),
        Probe.simple(**(SIMPLE | {"stiffness": 40.0, "free_amplitude": 1.0 / 3.0 * 1e-7})),
        Probe(
            Cantilever((Mode(16.4, 161.8e3, 287.0), Mode(640.0, 1.01e6, 600.0, 3.47)), 15.9, 1.0897),
            Drive(161.7e3, 94e-9),
            Tip(),
            Detector("slope"),
        ),
    ],
)
def test_a_saved_probe_reads_back_to_the_same_floats(probe: Probe, tmp_path: Path) -> None:
    path = tmp_path / "probe.toml"
    ot.save_probe(probe, path)
    assert ot.load_probe(path) == probe


def test_every_fault_is_named_at_once() -> None:
    text = (
        TEXT.replace('"16.4 N/m"', '"16.4 nm"').replace('free_amplitude = "94 nm"', "").replace("tip", "typ")
    )
    with pytest.raises(ProbeError) as caught:
        parse_probe(text)
    message = str(caught.value)
    assert "does not fit" in message
    assert "lacks free_amplitude" in message
    assert "unknown section [typ]" in message


@pytest.mark.parametrize(
    ("change", "word"),
    [
        ({"stiffness": -1.0}, "stiffness"),
        ({"quality_factor": 0.0}, "quality_factor"),
        ({"free_amplitude": float("nan")}, "free_amplitude"),
        ({"radius": 0.0}, "radius"),
        ({"tip_poisson_ratio": 0.7}, "poisson_ratio"),
    ],
)
def test_unphysical_probes_are_refused(change: dict[str, float], word: str) -> None:
    with pytest.raises(ProbeError, match=word):
        Probe.simple(**(SIMPLE | change))


@pytest.mark.parametrize(
    "text", ["", "not toml [", "[cantilever]\nstiffness = 3", TEXT + "\n[detector]\nkind = 'ear'"]
)
def test_what_is_not_a_probe_is_refused(text: str) -> None:
    with pytest.raises(ProbeError):
        parse_probe(text)


def test_a_missing_file_is_an_error_of_ours(tmp_path: Path) -> None:
    with pytest.raises(ProbeError, match="cannot read"):
        ot.load_probe(tmp_path / "none.toml")


def test_the_radius_has_no_default() -> None:
    probe = Probe.simple(**{name: value for name, value in SIMPLE.items() if name != "radius"})
    assert probe.tip.radius is None
    assert "radius" not in format_probe(probe)
    assert parse_probe(format_probe(replace(probe, tip=Tip(radius=2e-8)))).tip.radius == 2e-8


# --- the sensitivity of the mean ------------------------------------------------------------------


def test_the_mean_is_calibrated_as_the_amplitudes_unless_stated() -> None:
    assert Detector().mean_sensitivity == "dynamic"
    assert parse_probe(TEXT).detector == Detector("displacement", "dynamic")
    stated = parse_probe(TEXT + '\n[detector]\nkind = "slope"\nmean_sensitivity = "static"\n')
    assert stated.detector == Detector("slope", "static")
    assert parse_probe(format_probe(stated)) == stated


def test_other_sensitivities_are_refused() -> None:
    with pytest.raises(ProbeError, match=r"sensitivity of the mean.*'dynamic' or 'static'.*'thermal'"):
        Detector("slope", "thermal")
    with pytest.raises(ProbeError, match="sensitivity of the mean"):
        parse_probe(TEXT + '\n[detector]\nmean_sensitivity = "both"\n')
    with pytest.raises(ProbeError, match="unknown detector"):
        Detector("ear")


# --- a beam in place of modes ---------------------------------------------------------------------

BEAM = """
[cantilever.beam]
stiffness = "16.4 N/m"
frequency = "161.8 kHz"
quality_factor = 287
tip_position = 0.95
tip_mass = 0.02
spot_position = 0.9

[drive]
frequency = "161.8 kHz"
free_amplitude = "94 nm"

[detector]
kind = "slope"
"""


def test_a_beam_stands_for_its_modes(tmp_path: Path) -> None:
    probe = parse_probe(BEAM)
    assert probe.cantilever == ot.beam_modes(
        stiffness=16.4,
        frequency=161.8e3,
        quality_factor=287.0,
        tip_position=0.95,
        tip_mass=0.02,
        spot_position=0.9,
    )
    assert len(probe.cantilever.modes) == 3
    path = tmp_path / "beam.toml"
    path.write_text(BEAM, encoding="utf-8")
    assert ot.load_probe(path) == probe
    # what is written are the modes, and they are the same
    assert parse_probe(format_probe(probe)) == probe


def test_a_beam_may_state_its_static_stiffness() -> None:
    probe = parse_probe(BEAM.replace('stiffness = "16.4 N/m"', 'static_stiffness = "15.9 N/m"'))
    assert probe.cantilever.static_stiffness == pytest.approx(15.9, rel=1e-12, abs=0)
    plain = parse_probe(BEAM.replace("tip_position = 0.95\ntip_mass = 0.02\nspot_position = 0.9\n", ""))
    assert plain.cantilever.modes[0].stiffness == pytest.approx(16.4, rel=1e-12, abs=0)
    assert plain.cantilever.static_slope_ratio == pytest.approx(1.0897, abs=1e-4)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('frequency = "161.8 kHz"\nquality', "quality", "beam] lacks frequency"),
        ("quality_factor = 287\n", "", "beam] lacks quality_factor"),
        ("tip_mass", "weight", "no quantity 'weight'"),
        ('stiffness = "16.4 N/m"\n', "", "stiffness"),
        ('"16.4 N/m"', '"16.4 nm"', "cantilever.beam.stiffness"),
        ("tip_mass = 0.02", "tip_mass = -1", "mass"),
        ("tip_mass = 0.02", 'tip_mass = "heavy"', "cantilever.beam.tip_mass"),
        ("tip_mass = 0.02", "tip_mass = [1, 2]", "cantilever.beam.tip_mass"),
        ("tip_position = 0.95", "tip_position = 1.5", "tip"),
    ],
)
def test_beams_that_cannot_be_are_refused(old: str, new: str, message: str) -> None:
    assert old in BEAM
    with pytest.raises(ProbeError, match=re.escape(message)):
        parse_probe(BEAM.replace(old, new, 1))


def test_a_beam_beside_modes_is_refused() -> None:
    both = BEAM + '\n[[cantilever.modes]]\nstiffness = "16.4 N/m"\nfrequency = "1 kHz"\nquality_factor = 3\n'
    with pytest.raises(ProbeError, match="either a beam or modes"):
        parse_probe(both)
    with pytest.raises(ProbeError, match="is not a table"):
        parse_probe('cantilever = {beam = 3}\ndrive = {frequency = "1 kHz", free_amplitude = "9 nm"}\n')


def test_every_fault_of_a_beam_is_named_at_once() -> None:
    text = BEAM.replace("quality_factor = 287\n", "").replace("tip_mass", "weight").replace("free_", "")
    with pytest.raises(ProbeError) as caught:
        parse_probe(text)
    for part in ("lacks quality_factor", "'weight'", "lacks free_amplitude"):
        assert part in str(caught.value)
