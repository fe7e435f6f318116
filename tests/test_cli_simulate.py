"""``overtone simulate`` as a user runs it: what it says, what it writes, and what it refuses."""

import json
import re
import tomllib
from pathlib import Path

import numpy as np
import pytest
import xarray as xr

import overtone as ot
from overtone import provenance
from overtone.cli import main
from overtone.readings import probe_of

PROBE = """
[cantilever]
stiffness = "40 N/m"
frequency = "320 kHz"
quality_factor = 400

[drive]
frequency = "320 kHz"
free_amplitude = "25 nm"

[tip]
radius = "10 nm"
"""
SAMPLE = "dmt-viscous, modulus=1 GPa, poisson_ratio=0.35, adhesion=10 nN, viscosity=50 Pa s"
TWO_STATES = ["--z", "12 nm to 30 nm", "--points", 25]


@pytest.fixture
def probe_file(tmp_path: Path) -> Path:
    path = tmp_path / "probe.toml"
    path.write_text(PROBE, encoding="utf-8")
    return path


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    path = tmp_path / "out"
    path.mkdir()
    return path


def run(*arguments: object) -> int:
    """Run the command line and return its exit code."""
    try:
        main(["simulate", "curve", *(str(argument) for argument in arguments)])
    except SystemExit as stop:
        return int(stop.code or 0)
    return 0


def flat(text: str) -> str:
    return re.sub(r"\s+", " ", text)


def test_the_files_hold_what_the_library_gives(
    probe_file: Path, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out, table, picture = folder / "curve.nc", folder / "curve.csv", folder / "curve.png"
    files = ["-o", out, "--csv", table, "--plot", picture]
    assert run("--probe", probe_file, "--sample", SAMPLE, *TWO_STATES, "--branches", *files) == 0
    printed = flat(capsys.readouterr().out)
    assert all(f"wrote {path}" in printed for path in (out, table, picture))

    probe = ot.load_probe(probe_file)
    polymer = ot.sample("dmt-viscous", modulus=1e9, poisson_ratio=0.35, adhesion=10e-9, viscosity=50)
    z = np.linspace(30e-9, 12e-9, 25)
    curve, states = ot.approach_curve(probe, polymer, z=z), ot.steady_states(probe, polymer, z=z)
    written = ot.load(out)
    for name in curve.data_vars:
        xr.testing.assert_identical(written[name], curve[name])
    for name in states.data_vars:
        xr.testing.assert_identical(written[f"{name}_branches"].rename(name), states[name])
    assert written["jump"].dtype == bool
    assert written["direction"].values.tolist() == ["approach", "retract"]
    assert provenance.history(written) == provenance.history(curve)
    assert probe_of(written) == probe

    for direction in ("approach", "retract"):
        scan = ot.open_scan(out, direction=direction)
        np.testing.assert_array_equal(scan["A1"].values, curve["A1"].sel(direction=direction).values)
    assert "cannot_conclude" not in scan.attrs
    recording = ot.read_channels(table)
    assert recording.dims == ("z",)
    columns = {channel.name: channel for channel in recording.channels}
    in_time = np.concatenate([z, z[::-1]])
    np.testing.assert_allclose(recording.coords["z"], in_time, rtol=1e-9)
    for name in ("A1", "phi1", "A0", "A2", "peak_force", "dissipation"):
        there, back = curve[name].values
        np.testing.assert_allclose(columns[name].values, [*there, *back[::-1]], rtol=1e-9)
        assert columns[name].unit == curve[name].attrs["units"]
    assert columns["direction"].values.tolist() == [0.0] * 25 + [1.0] * 25
    assert "state no unit" not in " ".join(recording.notes)
    assert ot.open_scan(table, probe=probe, corrected=True)["A1"].dims == ("z",)
    assert picture.read_bytes().startswith(b"\x89PNG")


def test_the_summary_says_what_happened(probe_file: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run("--probe", probe_file, "--sample", SAMPLE, *TWO_STATES, "--branches") == 0
    printed = flat(capsys.readouterr().out)
    assert "dmt-viscous: modulus 1 GPa, adhesion 10 nN" in printed
    assert "k 40 N/m, f 320 kHz, Q 400, R 10 nm" in printed
    assert "Z from 30 nm down to 12 nm, 25 heights 750 pm apart" in printed
    # down held back by attraction to the fold near 17.5 nm, up on repulsion to the one near 21.5 nm
    assert "Z 18 .. 17.25 nm: A1 Z 21 .. 21.75 nm: A1" in printed
    assert "hysteresis: from Z = 18 nm to 21 nm approach and retract differ" in printed
    assert "3.75 nm wide, give or take the 750 pm between heights" in printed
    assert "more than one stable state at Z 18 nm .. 21 nm (2)" in printed
    assert "heights without a state none none" in printed

    assert run("--probe", probe_file, "--sample", SAMPLE, "--points", 20) == 0
    printed = flat(capsys.readouterr().out)
    assert "(from the set-point 0.1 to 1.2 A1far, chosen; --z gives others), 20 heights" in printed
    assert "more than one stable state" not in printed


def test_a_sweep_in_time_comes_through_the_same_files(
    probe_file: Path, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    probe_file.write_text(PROBE.replace("= 400", "= 40"))
    fast = ["--method", "transient", "--speed", "20 um/s", "--bandwidth", "20 kHz"]
    files = ["-o", folder / "curve.nc", "--csv", folder / "curve.csv", "--plot", folder / "curve.png"]
    assert run("--probe", probe_file, "--sample", SAMPLE, *TWO_STATES, *fast, *files) == 0
    printed = flat(capsys.readouterr().out)
    assert re.search(r"approach and retract differ by up to \S+ \wm in A1, at Z = ", printed)
    assert "the base moves by 796 pm while the lever forgets" in printed
    assert "heights without a state none none" in printed
    written = ot.load(folder / "curve.nc")
    rates = {"speed": 20e-6, "bandwidth": 20e3}
    polymer = ot.sample("dmt-viscous", modulus=1e9, poisson_ratio=0.35, adhesion=10e-9, viscosity=50)
    curve = ot.approach_curve(
        ot.load_probe(probe_file), polymer, z=np.linspace(30e-9, 12e-9, 25), method="transient", **rates
    )
    for name in curve.data_vars:
        xr.testing.assert_equal(written[name], curve[name])
    assert ot.read_channels(folder / "curve.csv").dims == ("z",)
    assert (folder / "curve.png").read_bytes().startswith(b"\x89PNG")


def test_heights_without_a_state_are_counted(probe_file: Path, capsys: pytest.CaptureFixture[str]) -> None:
    neck = "capillary, modulus=1 GPa, poisson_ratio=0.35, adhesion=5 nN, rupture_distance=1.5 nm"
    assert run("--probe", probe_file, "--sample", neck, "--z", "24 nm to 30 nm", "--points", 7) == 0
    printed = flat(capsys.readouterr().out)
    assert "heights without a state 2 no state 2 no state" in printed
    assert "no hysteresis where both sweeps have a state" in printed


def test_far_from_resonance_the_heights_reach_the_end_of_the_hysteresis(
    probe_file: Path, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    hard = [
        "--sample",
        "dmt, modulus=2 GPa, poisson_ratio=0.35, adhesion=10 nN",
        "--drive-frequency",
        "322 kHz",
    ]
    assert run("--probe", probe_file, *hard, "--points", 40, "-o", folder / "curve.nc") == 0
    assert "they still differ" not in flat(capsys.readouterr().out)
    curve = ot.load(folder / "curve.nc")
    assert float(curve["z"].max()) > 1.4 * 25e-9
    there, back = curve["A1"].values
    assert there[0] == pytest.approx(back[0], rel=1e-9, abs=0)
    assert np.nanmax(np.abs(there - back)) > 5e-9
    assert run("--probe", probe_file, *hard, "--points", 20, "--z", "5 nm to 30 nm") == 0
    assert "they still differ at the highest height" in flat(capsys.readouterr().out)


def test_a_sample_file_is_the_sample_of_the_text(probe_file: Path, folder: Path) -> None:
    page = (Path(__file__).parents[1] / "docs" / "simulate.md").read_text(encoding="utf-8")
    block = re.search(r"```toml\n(.+?)```", page, re.S)
    assert block is not None
    assert tomllib.loads(block.group(1))["model"] == "dmt-viscous"
    (folder / "sample.toml").write_text(block.group(1), encoding="utf-8")
    for name, text in (("file", folder / "sample.toml"), ("text", SAMPLE)):
        assert run("--probe", probe_file, "--sample", text, *TWO_STATES, "-o", folder / f"{name}.nc") == 0
    xr.testing.assert_identical(ot.load(folder / "file.nc"), ot.load(folder / "text.nc"))


def test_a_preset_says_what_is_nominal_and_takes_what_was_measured(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    preset = ["--probe", "ppp-nchr", "--free-amplitude", "25 nm", "--stiffness", "36 N/m", "--radius", "9 nm"]
    preset += ["--quality-factor", 431]
    assert (
        run(*preset, "--sample", SAMPLE, "--z", "20 nm to 30 nm", "--points", 5, "-o", folder / "a.nc") == 0
    )
    printed = flat(capsys.readouterr().out)
    assert "UncalibratedWarning: PPP-NCHR: frequency 330 kHz is nominal" in printed
    result = ot.load(folder / "a.nc")
    assert "frequency 330 kHz is nominal" in json.loads(result.attrs["findings"])[0]
    probe = probe_of(result)
    assert probe.cantilever.modes[0].stiffness == pytest.approx(36.0)
    assert probe.tip.radius == 9e-9
    assert probe.detector.kind == "slope"


@pytest.mark.parametrize(("suffix", "start"), [("svg", b"<?xml"), ("pdf", b"%PDF")])
def test_figures_can_be_drawn_as_lines(suffix: str, start: bytes, probe_file: Path, folder: Path) -> None:
    for name in ("one", "two"):
        picture = folder / f"{name}.{suffix}"
        assert run("--probe", probe_file, "--sample", SAMPLE, *TWO_STATES, "--plot", picture) == 0
        assert picture.read_bytes().startswith(start)


def test_options_replace_what_the_probe_file_says(
    probe_file: Path, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    probe_file.write_text(PROBE.replace('radius = "10 nm"', ""))
    short = ["--probe", probe_file, "--sample", SAMPLE, "--z", "25 nm to 40 nm", "--points", 3]
    assert run(*short, "-o", folder / "none.nc") == 1
    assert 'or --radius "10 nm"' in flat(capsys.readouterr().err)
    replaced = ["--radius", "7 nm", "--free-amplitude", "30 nm", "--drive-frequency", "319.8 kHz"]
    assert run(*short, *replaced, "-o", folder / "curve.nc") == 0
    probe = probe_of(ot.load(folder / "curve.nc"))
    assert probe.tip.radius == 7e-9
    assert (probe.drive.free_amplitude, probe.drive.frequency) == (30e-9, 319.8e3)


WRONG: dict[str, tuple[dict[str, object], str]] = {
    "unknown preset": ({"--probe": "PPP-NCRH", "--free-amplitude": "15 nm"}, "Try: PPP-NCLR or PPP-NCHR"),
    "preset without amplitude": ({"--probe": "PPP-NCHR"}, '--free-amplitude "40 nm"'),
    "no probe file": ({"--probe": "none.toml"}, "cannot read the probe file none.toml"),
    "stiffness beside a probe file": ({"--stiffness": "4 N/m"}, "--stiffness is for presets"),
    "negative Q in the probe": ({"probe": ("= 400", "= -400")}, "quality_factor = -400.0"),
    "zero drive amplitude in the probe": ({"probe": ("25 nm", "0 nm")}, "free_amplitude = 0.0"),
    "zero drive amplitude": ({"--free-amplitude": "0 nm"}, "free_amplitude = 0.0"),
    "unknown model": ({"--sample": "dtm, modulus=2 GPa"}, "unknown contact model"),
    "no model": ({"--sample": "modulus=2 GPa"}, "does not begin with a model"),
    "no parameters": ({"--sample": "jkr"}, "modulus [Pa], adhesion [N], poisson_ratio"),
    "no Poisson ratio": (
        {"--sample": "dmt, modulus=2 GPa, adhesion=8 nN"},
        "'dmt' needs poisson_ratio: expected modulus [Pa], adhesion [N], poisson_ratio; "
        "intermolecular_distance is 200 pm unless given",
    ),
    "radius of the sample": ({"--sample": f"{SAMPLE}, radius=9 nm"}, "radius belongs to the probe"),
    "unknown parameter": ({"--sample": f"{SAMPLE}, colour=2 nm"}, "has no colour"),
    "no pair": ({"--sample": f"{SAMPLE}, 7"}, "--sample is not a pair"),
    "wrong unit": (
        {"--sample": SAMPLE.replace("1 GPa", "1 nm")},
        "the unit of modulus in --sample does not fit",
    ),
    "no unit": ({"--sample": SAMPLE.replace("1 GPa", "1")}, "modulus in --sample has no unit"),
    "negative modulus": ({"--sample": SAMPLE.replace("1 GPa", "-1 GPa")}, "modulus is out of range"),
    "impossible ratio": ({"--sample": SAMPLE.replace("0.35", "0.7")}, "poisson_ratio is out of range"),
    "relaxing sample": (
        {
            "--sample": "sls, modulus=1 GPa, poisson_ratio=0.3, instantaneous_modulus=2 GPa, relaxation_time=1 us"
        },
        "cannot be simulated",
    ),
    "no sample file": ({"--sample": "none.toml"}, "cannot read the sample file none.toml"),
    "sample file without a model": ({"sample": 'modulus = "1 GPa"'}, "names no model"),
    "sample file with a bare number": (
        {"sample": 'model = "hertz"\nmodulus = 1e9\npoisson_ratio = 0.3'},
        "modulus in sample.toml has no unit",
    ),
    "sample file that is none": ({"sample": "model ="}, "sample.toml is not TOML"),
    "empty z": ({"--z": ""}, "--z is no range"),
    "one height": ({"--z": "5 nm"}, "--z is no range"),
    "reversed z": ({"--z": "100 nm to 5 nm"}, "the lower height first"),
    "z without unit": ({"--z": "5 to 100"}, "--z has no unit"),
    "z in metres": ({"--z": "5 m to 100 m"}, "heights are out of reach"),
    "one point": ({"--points": 1}, "--points is out of range"),
    "unknown method": ({"--method": "fast"}, "unknown method"),
    "speed without transient": ({"--speed": "100 nm/s"}, "Try: --method transient"),
    "bandwidth without transient": ({"--bandwidth": "2 kHz"}, "Try: --method transient"),
    "transient without speed": ({"--method": "transient"}, 'Try: --speed "100 nm/s"'),
    "wrong unit of speed": ({"--method": "transient", "--speed": "5 nm"}, "the unit of --speed does not fit"),
    "no harmonics": ({"--harmonics": 0}, "out of range"),
    "no netCDF name": ({"-o": "curve.txt"}, "ends in .nc"),
    "no figure name": ({"--plot": "curve.gif"}, "ends in .png or .svg or .pdf"),
    "no folder": ({"--csv": "nowhere/curve.csv"}, "does not exist"),
}


@pytest.mark.parametrize("kind", WRONG)
def test_wrong_input_gets_a_line_with_advice_and_leaves_no_output(
    kind: str,
    probe_file: Path,
    folder: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    changes, words = dict(WRONG[kind][0]), WRONG[kind][1]
    monkeypatch.chdir(folder)
    arguments: dict[str, object] = {
        "--probe": probe_file,
        "--sample": SAMPLE,
        "--z": "18 nm to 30 nm",
        "--points": 3,
    }
    arguments |= {"-o": "curve.nc", "--csv": "curve.csv", "--plot": "curve.png"}
    if "probe" in changes:
        old, new = changes.pop("probe")  # type: ignore[misc]
        assert old in PROBE
        probe_file.write_text(PROBE.replace(old, new))
    if "sample" in changes:
        (folder.parent / "sample.toml").write_text(str(changes.pop("sample")))
        changes["--sample"] = folder.parent / "sample.toml"
    assert run(*(text for pair in (arguments | changes).items() for text in pair)) == 1
    captured = capsys.readouterr()
    assert words in flat(captured.err)
    assert "Traceback" not in captured.err
    lines = [
        line for line in captured.err.splitlines() if line.strip() and "━" not in line and "%" not in line
    ]
    assert len(lines) == 1
    assert re.match(r"\w+Error: ", lines[0])
    assert "wrote" not in captured.out
    assert not list(folder.iterdir())


def test_outputs_have_names_of_their_own(
    probe_file: Path, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    sample = folder / "sample.csv"
    sample.write_text("mine")
    short = ["--probe", probe_file, "--z", "18 nm to 30 nm", "--points", 3]
    assert run(*short, "--sample", sample, "--csv", sample) == 1
    assert "is taken" in capsys.readouterr().err
    assert sample.read_text() == "mine"
    (folder / "curve.nc").mkdir()
    assert run(*short, "--sample", SAMPLE, "-o", folder / "curve.nc", "--csv", folder / "a.csv") == 1
    assert "is a folder" in capsys.readouterr().err
    assert not (folder / "a.csv").exists()


def test_where_one_file_cannot_be_written_none_is(
    probe_file: Path, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object, **__: object) -> None:
        raise OSError("no space")

    monkeypatch.setattr("overtone.plots.png_bytes", fail)
    files = ["-o", folder / "a.nc", "--csv", folder / "a.csv", "--plot", folder / "a.png"]
    assert run("--probe", probe_file, "--sample", SAMPLE, *TWO_STATES, *files) == 1
    assert not list(folder.iterdir())
