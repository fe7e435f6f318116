"""Instruments as text: there and back, with units, and every fault at once."""

import dataclasses
from pathlib import Path

import pytest

from overtone.errors import OvertoneError
from overtone.instrument.instrument import Instrument, NearSurface
from overtone.instrument.photodiode import SplitDiode
from overtone.instrument.toml import (
    format_instrument,
    load_instrument,
    parse_instrument,
    save_instrument,
)

FULL = Instrument(
    mean_offset=25.3e-12,
    mean_slope_z=2.1e-3,
    mean_slope_x=1e-5,
    mean_slope_y=-3e-5,
    mean_drift=0.7e-12,
    flicker=12e-12,
    diode=SplitDiode(500e-9, "gaussian", offset=25e-9, gap=10e-9),
    crosstalk={2: 30e-12 - 10e-12j, 3: -5e-12j},
    drive_distortion={2: 3e-12 + 0j},
    gains={0: 1.02, 2: 0.97},
    latency={2: 0.3, 3: -0.1},
    phase_offset=0.01,
    near_surface=NearSurface(0.03, 1e-4, 3.3e-6),
    frequency_drift=0.1,
    quality_drift=1e-5,
    drive_drift=-2e-6,
    bandwidth=1234.5,
    line_time=0.9,
    feedback_error=0.02,
    detector_noise=41e-15,
    temperature=300.0,
)


def test_an_instrument_comes_back_as_it_went(tmp_path: Path) -> None:
    save_instrument(FULL, tmp_path / "instrument.toml")
    back = load_instrument(tmp_path / "instrument.toml")
    for field in dataclasses.fields(Instrument):
        there, here = getattr(FULL, field.name), getattr(back, field.name)
        if field.name in ("crosstalk", "drive_distortion"):
            assert here.keys() == there.keys()
            for n, value in there.items():
                assert here[n] == pytest.approx(value, rel=1e-14, abs=0)
        else:
            assert here == there, field.name
    bent = Instrument(distortion={2: 2.3e4, 3: -1.7e11})
    assert parse_instrument(format_instrument(bent)) == bent


def test_every_number_of_an_instrument_has_a_place_in_the_file() -> None:
    """The full one differs from the neutral one in each of them, so none can be lost unseen."""
    for field in dataclasses.fields(Instrument):
        if field.name != "distortion":
            assert getattr(FULL, field.name) != getattr(Instrument(), field.name), field.name
            assert field.name in format_instrument(FULL)
    assert format_instrument(Instrument()) == ""
    assert parse_instrument("") == Instrument()


def test_units_are_those_of_the_text() -> None:
    found = parse_instrument("""
        mean_slope_z = "3 nm/um"
        mean_drift = "6 pm/min"
        flicker = "10 pm/sqrt(Hz)"
        detector_noise = "35 fm/√Hz"
        frequency_drift = "6 Hz/min"
        quality_drift = "0.1 %/min"
        phase_offset = "-90 deg"
        feedback_error = "2 %"
        distortion = {2 = "0.02 1/um", 3 = "-0.5 1/um^2"}
        [crosstalk.2]
        amplitude = "50 pm"
        phase = "90 deg"
    """)
    assert found.mean_slope_z == pytest.approx(3e-3, rel=1e-14, abs=0)
    assert found.mean_drift == pytest.approx(1e-13, rel=1e-14, abs=0)
    assert (found.flicker, found.detector_noise) == (10e-12, 35e-15)
    assert found.frequency_drift == pytest.approx(0.1, rel=1e-14, abs=0)
    assert found.quality_drift == pytest.approx(0.001 / 60, rel=1e-14, abs=0)
    assert found.phase_offset == pytest.approx(-1.5707963267948966, rel=1e-14, abs=0)
    assert found.distortion == {2: pytest.approx(2e4, rel=1e-14), 3: pytest.approx(-5e11, rel=1e-14)}
    # a lag: the phasor points down
    assert found.crosstalk[2] == pytest.approx(-50e-12j, rel=1e-12, abs=1e-26)


def test_every_fault_is_named_at_once() -> None:
    with pytest.raises(OvertoneError) as caught:
        parse_instrument(
            """
            colour = 1
            mean_offset = 5
            bandwidth = "2 nm"
            flicker = "10 pm"
            latency = {5 = "1 rad"}
            crosstalk = {2 = "50 pm"}
            line_time = true
            gains = 3
            [diode]
            offset = "1 m"
            angle = "3 deg"
            """,
            source="mine.toml",
        )
    message = str(caught.value)
    for named in (
        "mine.toml",
        "no colour",
        "mean_offset has no unit",
        "unit of bandwidth",
        "flicker is no amplitude density",
        "latency.5",
        "crosstalk.2 is no phasor",
        "line_time is no quantity",
        "gains is no table",
        "[diode] lacks spot",
        "no quantity 'angle'",
    ):
        assert named in message, named


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("bandwidth = ", "is not TOML"),
        ('bandwidth = "0 Hz"', "unphysical instrument"),
        ('diode = {spot = "1 um", shape = "star"}', "shape of a laser spot"),
        ("near_surface = 3", r"\[near_surface\] is not a table"),
        ('distortion = {0 = "1 1/m"}', "distortion.0"),
    ],
)
def test_what_describes_no_instrument_is_refused(text: str, message: str) -> None:
    with pytest.raises(OvertoneError, match=message):
        parse_instrument(text)


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(OvertoneError, match=r"cannot read the instrument file .*none\.toml"):
        load_instrument(tmp_path / "none.toml")
