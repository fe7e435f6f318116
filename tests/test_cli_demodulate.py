"""``overtone demodulate`` as a user runs it: what it says, what it writes, and what it refuses."""

import re
from pathlib import Path

import numpy as np
import pytest

import overtone as ot
from overtone.cli.app import app, main
from overtone.cli.demodulate import demodulate
from overtone.harmonics import far_phase
from overtone.instrument.demodulate import noise_of
from overtone.probe import parse_probe
from overtone.readings import reading_of

RATE, FREQUENCY = 1.6e6, 161.8e3
PROBE = """
[cantilever]
stiffness = "16.4 N/m"
frequency = "161.9 kHz"
quality_factor = 287

[drive]
frequency = "161.8 kHz"
free_amplitude = "60 nm"
"""

if "demodulate" not in list(app):
    app.command(demodulate)


@pytest.fixture
def probe_file(tmp_path: Path) -> Path:
    path = tmp_path / "probe.toml"
    path.write_text(PROBE, encoding="utf-8")
    return path


@pytest.fixture(scope="module")
def trace_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A lever that is free for 30 ms and then taps: 40 nm instead of 60, 0.3 rad less lag and a second harmonic."""
    t = np.arange(80_000) / RATE
    taps = np.clip((t - 0.032) / 0.006, 0.0, 1.0)
    theta = 2 * np.pi * FREQUENCY * t + 0.8
    lag = 1.2 - 0.3 * taps
    volts = (60e-9 - 20e-9 * taps) * np.cos(theta - lag) + taps * 20e-12 * np.cos(2 * theta - 2 * lag - 0.5)
    volts = volts / 60e-9 + np.random.default_rng(1).normal(0.0, 2e-4, t.size)
    path = tmp_path_factory.mktemp("trace") / "trace.csv"
    rows = zip(t * 1e6, volts, np.cos(theta), strict=True)
    path.write_text(
        "time [us], Defl [V], ref [V]\n" + "\n".join(f"{a:.4f}, {b:.7g}, {c:.7g}" for a, b, c in rows)
    )
    return path


def run(*arguments: object) -> int:
    """Run the command line and return its exit code."""
    try:
        main(["demodulate", *(str(argument) for argument in arguments)])
    except SystemExit as stop:
        return int(stop.code or 0)
    return 0


def flat(text: str) -> str:
    return re.sub(r"\s+", " ", text)


ORDINARY = ["--bandwidth", "1 kHz", "--sensitivity", "60 nm/V", "--channel", "deflection=Defl"]


def test_a_trace_becomes_observables(
    trace_file: Path, tmp_path: Path, probe_file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "seen.nc"
    told = ["--probe", probe_file, "--reference", "0 ms to 28 ms"]
    assert run(trace_file, "-o", out, *ORDINARY, *told) == 0
    printed = flat(capsys.readouterr().out)
    assert "drive at 161.8" in printed
    assert "bandwidth 1 kHz, Kaiser window" in printed
    assert re.search(r"A1 60 nm 40 nm 60 nm", printed)
    assert '--noise A0="' in printed
    assert f"wrote {out}" in printed
    seen = ot.load(out)
    assert seen["A1"].dims == ("time",)
    assert set(noise_of(seen)) == {"A0", "A1", "phi1", "A2", "A3"}
    probe = parse_probe(PROBE)
    free, tapping = seen["time"].values < 0.028, seen["time"].values > 0.04
    assert float(seen["phi1"].values[free].mean()) == pytest.approx(far_phase(probe), rel=1e-4, abs=0)
    assert float(seen["phi1"].values[tapping].mean()) == pytest.approx(
        far_phase(probe) - 0.3, rel=1e-3, abs=0
    )
    reading = reading_of(seen)
    assert reading is not None
    assert reading.phase_established
    # the scan opens like any other, with the probe it was made with
    with pytest.warns():
        scan = ot.open_scan(out)
    np.testing.assert_array_equal(scan["A2"].values, seen["A2"].values)
    assert scan["A2"].dims == ("time",)
    np.testing.assert_array_equal(scan["time"].values, seen["time"].values)
    assert scan["time"].attrs["units"] == "s"
    assert ot.probe_of(scan).drive.free_amplitude == 60e-9


def test_a_recorded_drive_is_the_reference(trace_file: Path, tmp_path: Path) -> None:
    out = tmp_path / "seen.nc"
    assert run(trace_file, "-o", out, *ORDINARY, "--channel", "drive=ref", "--harmonics", "1,2") == 0
    seen = ot.load(out)
    assert set(seen.data_vars) == {"A1", "phi1", "A2", "phi2"}
    assert seen.attrs["track"] == "drive"
    free, tapping = seen["time"].values < 0.028, seen["time"].values > 0.04
    assert float(seen["phi1"].values[free].mean()) == pytest.approx(1.2, rel=1e-3, abs=0)
    assert float(seen["phi1"].values[tapping].mean()) == pytest.approx(0.9, rel=1e-3, abs=0)
    assert reading_of(seen) is None


def test_warnings_are_printed_and_kept(
    trace_file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "seen.nc"
    assert run(trace_file, "-o", out, *ORDINARY) == 0
    assert "leaves one frequency" in flat(capsys.readouterr().out)
    assert "leaves one frequency" in ot.load(out).attrs["findings"]


WRONG: dict[str, tuple[list[str], str]] = {
    "no bandwidth unit": (["--bandwidth", "1000"], "has no unit"),
    "wrong bandwidth unit": (["--bandwidth", "1 nm"], "does not fit"),
    "no deflection": (["--channel", "deflection=Deflection"], "has no channel 'Deflection'"),
    "no sensitivity": (["--sensitivity", "60 nm"], "does not fit"),
    "harmonics in words": (["--harmonics", "first"], "--harmonics is not a list"),
    "reference without to": (["--reference", "20 ms"], "--reference is no window"),
    "reference outside": (["--reference", "1 s to 2 s"], "no part of the record"),
    "another drive": (["--drive-frequency", "300 kHz"], "no line stands above the noise"),
    "unknown track": (["--track", "phase-locked"], "unknown track"),
    "too many harmonics": (["--harmonics", "0,1,2,3,4,5"], "harmonic 5 is beyond"),
    "no probe": (["--probe", "none.toml"], "cannot read the probe file"),
    "no netCDF": (["-o", "seen.csv"], "no name for a result"),
    "no folder": (["-o", "nowhere/seen.nc"], "does not exist"),
}


@pytest.mark.parametrize("kind", WRONG)
def test_wrong_calls_get_a_clear_error_and_leave_no_output(
    kind: str,
    trace_file: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    arguments, words = WRONG[kind]
    options = dict(zip(ORDINARY[::2], ORDINARY[1::2], strict=True)) | {"-o": "seen.nc"}
    options |= dict(zip(arguments[::2], arguments[1::2], strict=True))
    assert run(trace_file, *(part for pair in options.items() for part in pair)) == 1
    printed = capsys.readouterr().err
    assert words in flat(printed)
    assert "Traceback" not in printed
    assert not list(tmp_path.iterdir())


def test_the_trace_is_not_replaced(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "trace.nc"
    path.write_bytes(b"something")
    assert run(path, "-o", path, "--bandwidth", "1 kHz") == 1
    assert "is the trace itself" in flat(capsys.readouterr().err)
    assert path.read_bytes() == b"something"
