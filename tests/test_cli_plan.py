"""``overtone plan`` as a user runs it: what it says, what it writes, and what it refuses."""

import re
from pathlib import Path

import numpy as np
import pytest

import overtone as ot
from overtone import provenance
from overtone.cli import main
from overtone.cli.app import app
from overtone.cli.plan import plan as command
from overtone.planning.experiment import plan_experiment
from overtone.planning.quality import assumed_calibration

PROBE = """
cantilever = {{stiffness = "{k} N/m", frequency = "{f} kHz", quality_factor = {Q}}}
drive = {{frequency = "{f} kHz", free_amplitude = "94 nm"}}
tip = {{radius = "10 nm"}}
"""
SAMPLE = "dmt, modulus=100 MPa, poisson_ratio=0.45, adhesion=4 nN"
RANGES = ["--setpoint", "0.2 .. 0.8", "--free-amplitude", "15 nm .. 95 nm", "--points", 4]


@pytest.fixture(scope="module", autouse=True)
def _registered() -> None:
    if "plan" not in app:
        app.command(command)


@pytest.fixture
def probe_file(tmp_path: Path) -> Path:
    path = tmp_path / "probe.toml"
    path.write_text(PROBE.format(k=16.4, f=161.8, Q=287), encoding="utf-8")
    return path


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    path = tmp_path / "out"
    path.mkdir()
    return path


def run(*arguments: object) -> int:
    """Run the command line and return its exit code."""
    try:
        main(["plan", *(str(argument) for argument in arguments)])
    except SystemExit as stop:
        return int(stop.code or 0)
    return 0


def flat(text: str) -> str:
    return re.sub(r"\s+", " ", text)


def test_the_files_hold_what_the_library_gives(
    probe_file: Path, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    soft = folder / "soft.toml"
    soft.write_text(PROBE.format(k=2, f=70, Q=150), encoding="utf-8")
    out, picture = folder / "plan.nc", folder / "plan.png"
    files = ["-o", out, "--figure", picture]
    asked = ["--probe", probe_file, "--sample", SAMPLE, *RANGES, "--lever", soft, "--calibration", "careful"]
    assert run(*asked, *files) == 0
    printed = flat(capsys.readouterr().out)
    assert all(f"wrote {path}" in printed for path in (out, picture))
    assert picture.read_bytes().startswith(b"\x89PNG")

    expected = plan_experiment(
        ot.load_probe(probe_file),
        ot.sample("dmt", modulus=100e6, poisson_ratio=0.45, adhesion=4e-9),
        setpoint=np.linspace(0.2, 0.8, 4),
        free_amplitude=np.linspace(15e-9, 95e-9, 4),
        probes={"soft": ot.load_probe(soft)},
        calibration="careful",
    )
    written = ot.load(out)
    assert written["lever"].values.tolist() == ["probe", "soft"]
    assert written["stable"].dtype == bool
    for name in expected.data_vars:
        np.testing.assert_allclose(written[name].values, expected[name].values, rtol=1e-9, err_msg=name)
    said = provenance.findings(written)
    assert said[0].startswith("Best: ")
    assert all(flat(sentence) in printed for sentence in said)
    assert "careful calibration, assumed" in printed
    assert "Noise was not stated, an ordinary one is assumed" in printed


def test_the_table_has_a_row_for_each_amplitude(probe_file: Path, capsys: pytest.CaptureFixture[str]) -> None:
    ranges = ["--setpoint", "0.3", "--free-amplitude", "20 nm, 50 nm, 94 nm"]
    assert run("--probe", probe_file, "--sample", SAMPLE, *ranges, "--calibration", "perfect") == 0
    lines = capsys.readouterr().out.splitlines()
    rows = {line.split(" nm")[0]: line for line in lines if re.match(r"\d+ nm ", line)}
    assert list(rows) == ["20", "50", "94"]
    assert "0.3*" in rows["20"]
    assert " MPa " in rows["20"]
    assert "noise" in rows["20"]
    assert "not determined" in rows["50"]
    assert "0.3*" not in rows["94"]
    assert "* a stable attractive state has the same set-point" in lines
    assert "noise only" in lines[0]
    assert max(len(line) for line in rows.values()) <= 80


@pytest.mark.parametrize(
    "sample", ["dmt, E=100 MPa, nu=0.45, Fad=4 nN", "dmt,E = 100 MPa,  Fad=4 nN, nu=0.45"]
)
def test_short_names_of_a_sample(probe_file: Path, sample: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert run("--probe", probe_file, "--sample", sample, "--setpoint", "0.4") == 0
    assert "modulus 100 MPa, adhesion 4 nN, poisson_ratio 0.45" in capsys.readouterr().out


def test_a_calibration_from_a_file(
    probe_file: Path, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    record = assumed_calibration("careful", ot.load_probe(probe_file))
    assert record is not None
    ot.save_calibration(record, folder / "calibration.toml")
    asked = ["--probe", probe_file, "--sample", SAMPLE, "--setpoint", "0.2, 0.4"]
    assert run(*asked, "--calibration", folder / "calibration.toml", "-o", folder / "file.nc") == 0
    assert run(*asked, "--calibration", "careful", "-o", folder / "word.nc") == 0
    by_file, by_word = ot.load(folder / "file.nc"), ot.load(folder / "word.nc")
    np.testing.assert_allclose(by_file["modulus_upper"], by_word["modulus_upper"], rtol=1e-6)
    capsys.readouterr()


def test_noise_from_a_bandwidth(probe_file: Path, capsys: pytest.CaptureFixture[str]) -> None:
    asked = ["--probe", probe_file, "--sample", SAMPLE, "--setpoint", "0.4"]
    assert run(*asked, "--noise", "bandwidth=500 Hz, detector=50 fm/rtHz") == 0
    assert "Noise, from a bandwidth of 500 Hz" in flat(capsys.readouterr().out)


@pytest.mark.parametrize("ending", [".svg", ".pdf"])
def test_figures_of_other_kinds(probe_file: Path, folder: Path, ending: str) -> None:
    picture = folder / f"plan{ending}"
    assert run("--probe", probe_file, "--sample", SAMPLE, "--setpoint", "0.2, 0.4", "--figure", picture) == 0
    assert picture.stat().st_size > 1000


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        (["--setpoint", "0.3 .. 1.2"], "0 < A1/A1far < 1"),
        (["--setpoint", "0.9 .. 0.3"], "lower end first"),
        (["--setpoint", "0.3 .."], "--setpoint is no range"),
        (["--setpoint", "60 nm"], "--setpoint"),
        (["--free-amplitude", "25"], "--free-amplitude"),
        (["--points", "1"], "--points is out of range"),
        (["--calibration", "sloppy"], "none, ordinary, careful, perfect"),
        (["--calibration", "nothing.toml"], "cannot read the calibration"),
        (["--noise", "scatter"], "told from a scan"),
        (["--noise", "A0=5"], "A0"),
        (["--harmonics", "0,x"], "--harmonics is not a list"),
        (["--harmonics", "0,1"], "too few harmonics"),
        (["--sample", "E=2 GPa"], "does not begin with a model"),
        (["--sample", "jkr, E=2 GPa, nu=0.3, Fad=5 nN"], "cannot be inverted"),
        (["--model", "nonsense"], "nonsense"),
        (["--lever", "nothing.toml"], "nothing.toml"),
        (["--output", "plan.txt"], "no name for --output"),
        (["--figure", "plan.jpg"], "no name for --figure"),
        (["--figure", "missing/plan.png"], "does not exist"),
    ],
)
def test_what_cannot_be_planned_is_refused_in_one_line(
    probe_file: Path, changes: list[str], says: str, capsys: pytest.CaptureFixture[str]
) -> None:
    asked = {"--probe": str(probe_file), "--sample": SAMPLE, "--setpoint": "0.4"} | dict([changes])
    assert run(*(part for pair in asked.items() for part in pair)) == 1
    said = flat(capsys.readouterr().err)
    assert says in said
    assert "Traceback" not in said
