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
