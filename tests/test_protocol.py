"""The page on recording: complete for every vendor, honest about what was verified, right in its numbers."""

import math
import re
from dataclasses import fields
from decimal import Decimal
from pathlib import Path

import numpy as np
import pytest
from cyclopts import App

from overtone.cli.protocol import protocol as command
from overtone.errors import OvertoneError, ProbeError
from overtone.presets import preset
from overtone.probe import Probe, format_probe
from overtone.protocol import (
    NOT_VERIFIED,
    full_page,
    probe_numbers,
    protocol,
    reference_probe,
    vendor,
    vendor_page,
    vendors,
)
from overtone.protocol.numbers import texts
from overtone.protocol.records import VendorStep

ROOT = Path(__file__).parents[1]
MARK = f"**{NOT_VERIFIED}**"
SOFT = Probe.simple(
    stiffness=2.5,
    frequency=71.3e3,
    quality_factor=187,
    drive_frequency=71.2e3,
    free_amplitude=150e-9,
    radius=9e-9,
)
SHARP = Probe.simple(
    stiffness=2.5, frequency=71234.567, quality_factor=5e4, drive_frequency=71234.567, free_amplitude=1e-8
)


def run(*arguments: object) -> None:
    app = App(name="overtone", result_action="return_value")
    app.command(command)
    app([str(argument) for argument in arguments], exit_on_error=False)


def flat(text: str) -> str:
    return re.sub(r"\s+", " ", text)


def paragraphs(page: str) -> str:
    """The page with every list entry and paragraph on one line."""
    return re.sub(r"\n(?![\n-])\s*", " ", page)


# --- content --------------------------------------------------------------------------------------


def test_the_page_of_the_docs_is_what_the_program_writes() -> None:
    assert (ROOT / "docs/protocol.md").read_text(encoding="utf-8") == full_page()


@pytest.mark.parametrize("key", vendors())
def test_every_step_is_on_the_page_of_every_vendor(key: str) -> None:
    page = flat(vendor_page(key))
    words = texts(probe_numbers(reference_probe())) | {"last_steps": "18"}
    for number, step in enumerate(protocol().steps, 1):
        assert f"## {number}. {step.title}" in page
        for text in (step.do, step.why, step.check):
            assert flat(text.format_map(words)) in page
    for section in protocol().closing:
        assert f"## {section.title}" in page
    assert len(protocol().steps) == 19


def test_the_full_page_has_every_step_of_every_vendor() -> None:
    page = flat(full_page())
    for key in vendors():
        assert f"### {vendor(key).name}" in page
        assert all(flat(entry.do) in page for entry in vendor(key).steps)


@pytest.mark.parametrize("key", vendors())
def test_marks_stand_exactly_where_the_data_say_so(key: str) -> None:
    lines = {line[2:].strip() for line in paragraphs(vendor_page(key)).splitlines() if line.startswith("- ")}
    for entry in vendor(key).steps:
        line = next(line for line in lines if line.startswith(flat(entry.do)))
        behind = line.removeprefix(flat(entry.do)).strip()
        assert behind == (f"*Source: {flat(entry.source)}.*" if entry.verified else MARK)
    marks = sum(not entry.verified for entry in vendor(key).steps)
    assert vendor_page(key).count(MARK) == marks
    assert marks > 0


def test_a_source_stands_where_verified_and_only_there() -> None:
    entries: list[VendorStep] = [entry for key in vendors() for entry in vendor(key).steps]
    assert all(bool(entry.source) == entry.verified for entry in entries)
    known = {step.key for step in protocol().steps}
    assert {entry.step for entry in entries} <= known


@pytest.mark.parametrize("key", vendors())
def test_the_steps_that_differ_are_told_for_every_vendor(key: str) -> None:
    told = {entry.step for entry in vendor(key).steps}
    assert told >= {"tune", "second", "filters", "deflection", "phase", "channels", "curves", "lift", "save"}


def test_no_line_turns_into_markup_by_its_wrapping() -> None:
    """A wrapped line that began with a dash or a number and a dot would become a list."""
    for page in (full_page(), vendor_page("asylum", SOFT)):
        before = ""
        for line in page.splitlines():
            assert len(line) <= 120 or line.startswith("|")
            if re.match(r"[-+*#>] |\d+[.)] ", line) and before:
                assert before.startswith(("- ", "  ")), line
            before = line
        assert "{" not in page


# --- numbers --------------------------------------------------------------------------------------


def test_numbers_of_a_probe_by_hand() -> None:
    numbers = probe_numbers(SOFT)
    w = 2 * math.pi * 71.3e3
    assert numbers.linewidth == pytest.approx(381.283, rel=1e-5, abs=0)
    assert numbers.ring_down == pytest.approx(2 * 187 / w, rel=1e-12, abs=0)
    assert numbers.pixel_time == pytest.approx(8 * 187 / w, rel=1e-12, abs=0)
    assert numbers.line_rate == pytest.approx(1 / (512 * 3.33934e-3), rel=1e-5, abs=0)
    assert numbers.filter_corner == pytest.approx(71.3e3 / (2 * 187), rel=1e-12, abs=0)
    assert numbers.approach_speed * 2 * numbers.ring_down == pytest.approx(0.05e-9, rel=1e-12, abs=0)
    assert numbers.lift_height == pytest.approx(200e-9, rel=1e-12, abs=0)
    # driven 100 Hz below a linewidth of 381 Hz: tan(phi) = (r/Q) / (1 - r^2)
    r = 71.2 / 71.3
    assert numbers.far_phase == pytest.approx(math.atan2(r / 187, 1 - r**2), rel=1e-12, abs=0)
    stiffness = 2.5 * math.hypot(1 - r**2, r / 187)
    assert numbers.drive_force == pytest.approx(150e-9 * stiffness, rel=1e-12, abs=0)


def test_the_phase_turns_as_fast_as_the_page_says() -> None:
    """Against a difference quotient of the lag, and 10 Hz are 2 degrees on the stiff lever."""

    def lag(frequency: float) -> float:
        r = frequency / 71.3e3
        return math.atan2(r / 187, 1 - r**2)

    slope = (lag(71.2e3 + 1) - lag(71.2e3 - 1)) / 2
    assert probe_numbers(SOFT).phase_slope == pytest.approx(slope, rel=1e-4, abs=0)
    assert math.degrees(10 * probe_numbers(reference_probe()).phase_slope) == pytest.approx(
        2.03, rel=0.002, abs=0
    )


def test_the_ladder_spans_three_linewidths_and_predicts_the_resonance() -> None:
    numbers = probe_numbers(reference_probe())
    frequency = np.array([step.frequency for step in numbers.ladder])
    assert len(frequency) == 13
    assert frequency[-1] - frequency[0] == pytest.approx(3 * 162e3 / 287, rel=1e-3, abs=0)
    r = frequency / 162e3
    stiffness = 16.4 * np.hypot(1 - r**2, r / 287)
    amplitude = np.array([step.amplitude for step in numbers.ladder])
    assert amplitude * stiffness == pytest.approx(94e-9 * 16.4 / 287, rel=1e-9, abs=0)
    assert amplitude.max() / amplitude.min() > 3  # so that a1 squared varies by ten
    assert math.degrees(numbers.ladder[6].phase) == pytest.approx(90, rel=1e-9, abs=0)
    assert numbers.ladder[0].phase < math.pi / 2 < numbers.ladder[-1].phase


@pytest.mark.parametrize("probe", [reference_probe(), SOFT, SHARP], ids=["reference", "soft", "vacuum"])
def test_the_second_lock_in_stands_at_exactly_twice_the_drive(probe: Probe) -> None:
    """In the digits that are printed, also where a linewidth is a hertz."""
    rows = re.findall(r"^\| ([\d.]+) \| ([\d.]+) \| [\d.]+ \| [\d.]+ \|$", vendor_page("asylum", probe), re.M)
    assert len({drive for drive, _ in rows}) == 13
    assert all(2 * Decimal(drive) == Decimal(second) for drive, second in rows)


def test_tolerances_are_equal_forces() -> None:
    """The reference gives back the stated ones; another lever errs by the same newtons."""
    ours = probe_numbers(reference_probe())
    assert (ours.tolerated_A0, math.degrees(ours.tolerated_phase), ours.tolerated_drive) == pytest.approx(
        (1e-12, 0.1, 0.005), rel=1e-12, abs=0
    )
    soft = probe_numbers(SOFT)
    assert soft.tolerated_A0 * 2.5 == pytest.approx(16.4e-12, rel=1e-12, abs=0)
    assert soft.tolerated_phase * soft.drive_force == pytest.approx(
        math.radians(0.1) * 94e-9 * 16.4 / 287, rel=1e-12, abs=0
    )
    assert soft.tolerated_drive * soft.drive_force == pytest.approx(
        0.005 * 94e-9 * 16.4 / 287, rel=1e-12, abs=0
    )


def test_every_number_of_a_probe_with_modes_is_finite() -> None:
    probe = preset(
        "PPP-NCLR",
        free_amplitude=40e-9,
        stiffness=41.0,
        frequency=171e3,
        quality_factor=512,
        radius=8e-9,
    )
    numbers = probe_numbers(probe)
    values = [
        getattr(numbers, field.name) for field in fields(numbers) if field.name not in ("ladder", "noise")
    ]
    assert np.isfinite([*values, *numbers.noise]).all()
    assert min(*values, *numbers.noise) > 0


def test_the_page_of_a_probe_has_its_numbers_and_not_those_of_the_reference() -> None:
    page = flat(vendor_page("bruker", SOFT))
    assert "Numbers of your probe" in page
    assert "71.3 kHz, Q 187, driven at 71.2 kHz with 150 nm" in page
    assert "| linewidth f1/Q | 381 Hz |" in page
    assert "exactly twice the drive (142.4 kHz)" in page
    assert "0.58 Hz or less for a line of 256 pixels" in page  # 1 / (512 * 3.34 ms)
    assert "564 Hz" not in page
    reference = flat(vendor_page("bruker"))
    assert "| linewidth f1/Q | 564 Hz |" in reference
    assert "Numbers of the reference lever" in reference


# --- the command ----------------------------------------------------------------------------------


@pytest.mark.parametrize("key", vendors())
def test_the_command_prints_every_vendor_as_plain_markdown(
    key: str, capsys: pytest.CaptureFixture[str]
) -> None:
    run("protocol", "--vendor", key)
    assert capsys.readouterr().out == vendor_page(key)


def test_the_command_prints_a_rendered_page_on_a_terminal(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("FORCE_COLOR", "1")
    monkeypatch.setenv("COLUMNS", "100")
    run("protocol", "--vendor", "asylum")
    rendered = re.sub(r"\x1b\[[0-9;?]*[a-zA-Z]", "", capsys.readouterr().out)
    assert "6. Second lock-in at exactly 2f, with no drive" in rendered
    assert "**Do.**" not in rendered
    assert rendered.count(NOT_VERIFIED) >= sum(not entry.verified for entry in vendor("asylum").steps)
    run("protocol", "--vendor", "asylum", "--plain")
    assert "**Do.**" in capsys.readouterr().out


def test_the_command_takes_a_probe_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "probe.toml"
    path.write_text(format_probe(SOFT), encoding="utf-8")
    run("protocol", "--vendor", "jpk", "--probe", path)
    assert capsys.readouterr().out == vendor_page("jpk", SOFT)


def test_the_command_says_what_is_nominal_in_a_preset(capsys: pytest.CaptureFixture[str]) -> None:
    run(
        "protocol",
        "--vendor",
        "park",
        "--probe",
        "PPP-NCLR",
        "--free-amplitude",
        "40 nm",
        "--stiffness",
        "41 N/m",
    )
    page = flat(capsys.readouterr().out)
    assert "41 N/m, 190 kHz" in page
    assert "frequency 190 kHz, quality factor 550 (typical of air), radius 7 nm are nominal" in page


def test_the_command_writes_the_page_of_the_docs(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "page.md"
    run("protocol", "--all", "-o", path)
    assert path.read_bytes() == full_page().encode()
    assert "wrote" in capsys.readouterr().out


def test_an_unknown_vendor_is_named_with_the_choices() -> None:
    with pytest.raises(OvertoneError, match="'zeiss'") as error:
        run("protocol", "--vendor", "zeiss")
    assert all(key in str(error.value) for key in vendors())


def test_wrong_calls_are_named(tmp_path: Path) -> None:
    with pytest.raises(OvertoneError, match="no vendor"):
        run("protocol")
    with pytest.raises(OvertoneError, match="--all"):
        run("protocol", "--all", "--vendor", "asylum")
    with pytest.raises(OvertoneError, match="no name for the page"):
        run("protocol", "--all", "-o", tmp_path / "page.png")
    with pytest.raises(ProbeError, match="no preset 'nonsense'"):
        run("protocol", "--vendor", "asylum", "--probe", "nonsense")
    with pytest.raises(OvertoneError, match="free amplitude"):
        run("protocol", "--vendor", "asylum", "--probe", "PPP-NCLR")
    assert list(tmp_path.iterdir()) == []
