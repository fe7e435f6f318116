"""The commands as a user runs them: on real files, on wrong ones, and what they leave behind."""

import re
import sys
from pathlib import Path

import numpy as np
import pytest
import xarray as xr

from overtone.cli import main
from overtone.demo import virtual_scan
from overtone.instrument.calibration import load_calibration
from overtone.inversion.properties import MISSING_DATA, NOT_DETERMINED
from overtone.io.netcdf import load, save
from overtone.provenance import add_finding
from overtone.report.results import alone

PROBE = """
[cantilever]
stiffness = "40 N/m"
frequency = "237.595 kHz"
quality_factor = 400

[drive]
frequency = "237595.092 Hz"
free_amplitude = "123.6 nm"
"""


@pytest.fixture
def probe_file(tmp_path: Path) -> Path:
    path = tmp_path / "probe.toml"
    path.write_text(PROBE, encoding="utf-8")
    return path


@pytest.fixture(scope="module")
def scan_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("scan") / "scan.nc"
    save(virtual_scan(shape=(10, 12), seed=3)[0], path)
    return path


def run(*arguments: object) -> int:
    """Run the command line and return its exit code."""
    try:
        main([str(argument) for argument in arguments])
    except SystemExit as stop:
        return int(stop.code or 0)
    return 0


def flat(text: str) -> str:
    return re.sub(r"\s+", " ", text)


def test_map_a_real_scan(afm_data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out, page = tmp_path / "maps.nc", tmp_path / "maps.html"
    assert run("map", afm_data / "ibw" / "AR_20211011.ibw", "-o", out, "--report", page) == 0
    printed = flat(capsys.readouterr().out)
    assert "Rejected thermal" in printed
    assert "for a modulus this file lacks A0" in printed
    assert "-48.3 pN" in printed
    result = load(out)
    assert {"dissipation", "virial", "regime", "F_cons"} <= set(result.data_vars)
    assert "modulus" not in result
    assert result["dissipation"].attrs["units"] == "J"
    assert result["regime"].attrs["flag_meanings"] == "attractive undetermined repulsive"
    text = page.read_text(encoding="utf-8")
    assert "Rejected thermal" in text
    assert "<img" in text


def test_map_a_real_harmonic_scan(
    afm_data: Path, tmp_path: Path, probe_file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = afm_data / "neasnom" / "SnO2_NW4_hyp"
    reading = ["--probe", probe_file, "--far-phase", "90 deg"]
    assert run("map", folder, "-o", tmp_path / "energy.nc", *reading) == 0
    assert "not used for want of a unit: A0 (M0A: no unit, and a zero that is not known)" in flat(
        capsys.readouterr().out
    )
    assert list(load(tmp_path / "energy.nc")["harmonic"].values) == [1]

    asked = [*reading, "--radius", "20 nm", "--poisson-ratio", 0.25]
    assert run("map", folder, "-o", tmp_path / "none.nc", "--model", "dmt-linear", *asked) == 0
    assert (load(tmp_path / "none.nc")["status"] == NOT_DETERMINED).all()

    scaled = ["--scale", "M2A=1 nm", "--scale", "M3A=1 nm"]
    assert run("map", folder, "-o", tmp_path / "all.nc", *asked, *scaled) == 0
    assert "distortion in the detector" in flat(capsys.readouterr().out)
    result = load(tmp_path / "all.nc")
    assert list(result["harmonic"].values) == [1, 2, 3]
    assert not np.isfinite(result["modulus"]).any()
    assert (result["status"] == NOT_DETERMINED).all()
    assert "no modulus can be concluded" in result.attrs["cannot_conclude"]


def test_map_a_simulated_scan(scan_file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "maps.nc"
    arguments = ["--poisson-ratio", 0.35, "--harmonics", "1,2,3", "--noise", "A2=0.5 pm"]
    assert run("map", scan_file, "-o", out, *arguments) == 0
    assert "of pixels are determined" in flat(capsys.readouterr().out)
    result = load(out)
    assert result["modulus"].dims == ("y", "x")
    assert 0.1 < float(np.isfinite(result["modulus"]).mean()) < 0.9


def test_radius_and_poisson_ratio_are_asked_for(
    scan_file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "maps.nc"
    assert run("map", scan_file, "-o", out) == 0
    assert "--poisson-ratio" in flat(capsys.readouterr().out)
    assert "modulus" not in load(out)
    assert run("map", scan_file, "-o", tmp_path / "no.nc", "--model", "hertz") == 1
    assert "Poisson's ratio" in flat(capsys.readouterr().err)
    assert not (tmp_path / "no.nc").exists()


def test_nan_pixels_are_a_status(tmp_path: Path) -> None:
    scan, _ = virtual_scan(shape=(4, 5), seed=1)
    scan["A2"][1, 2] = np.nan
    save(scan, tmp_path / "holes.nc")
    assert run("map", tmp_path / "holes.nc", "-o", tmp_path / "maps.nc", "--poisson-ratio", 0.3) == 0
    result = load(tmp_path / "maps.nc")
    assert int(result["status"][1, 2]) == MISSING_DATA
    assert int((result["status"] == MISSING_DATA).sum()) == 1


def broken(kind: str, afm_data: Path, folder: Path) -> tuple[list[object], str]:
    """Return arguments for a wrong call of map, and what its message has to say."""
    real = afm_data / "ibw" / "AR_20211011.ibw"
    path = folder / "scan.ibw"
    if kind == "missing":
        return [folder / "none.ibw"], "there is no file"
    if kind == "truncated":
        path.write_bytes(real.read_bytes()[:40_000])
        return [path], "FileFormatError"
    if kind == "text":
        path.write_text("x, y\nthis is no scan\n")
        return [path], "FileFormatError"
    if kind == "empty":
        path.touch()
        return [path], "FileFormatError"
    if kind == "no phase":
        return [afm_data / "ibw" / "10x10-one_channel_without_name.ibw"], "no channel for A1 and phi1"
    if kind == "probe without k":
        probe = folder / "probe.toml"
        probe.write_text(PROBE.replace('stiffness = "40 N/m"\n', ""))
        return [real, "--probe", probe], "lacks stiffness"
    if kind == "wrong unit in the probe":
        probe = folder / "probe.toml"
        probe.write_text(PROBE.replace("40 N/m", "40 nm"))
        return [real, "--probe", probe], "does not fit"
    if kind == "wrong unit in an option":
        return [real, "--radius", "10 Hz"], "does not fit"
    if kind == "no unit in an option":
        return [real, "--far-phase", "90"], "has no unit"
    if kind == "unknown method":
        return [real, "--harmonics", "one"], "--harmonics is not a list"
    if kind == "no folder":
        return [real, "-o", folder / "nowhere" / "out.nc"], "does not exist"
    if kind == "the scan itself":
        path = folder / "scan.nc"
        save(virtual_scan(shape=(3, 4), seed=1)[0], path)
        return [path, "-o", path], "is the scan itself"
    if kind == "result and report alike":
        return [real, "-o", folder / "out.html"], "the same name"
    if kind == "report into a folder":
        (folder / "out.html").mkdir()
        return [real], "is a folder"
    if kind == "impossible ratio":
        return [real, "--poisson-ratio", "0.9"], "poisson_ratio is out of range"
    if kind == "wrong harmonics":
        return [real, "--harmonics", "5,6"], "harmonic 5 was not measured"
    if kind == "wrong model":
        return [real, "--model", "dtm"], "unknown contact model"
    assert kind == "no netCDF name"
    return [real, "-o", folder / "out.txt"], "nc"


@pytest.mark.parametrize(
    "kind",
    [
        "missing",
        "truncated",
        "text",
        "empty",
        "no phase",
        "probe without k",
        "wrong unit in the probe",
        "wrong unit in an option",
        "no unit in an option",
        "unknown method",
        "no folder",
        "no netCDF name",
        "the scan itself",
        "result and report alike",
        "report into a folder",
        "impossible ratio",
        "wrong harmonics",
        "wrong model",
    ],
)
def test_wrong_input_gets_a_clear_error_and_leaves_no_output(
    kind: str, afm_data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    work = tmp_path / "work"
    work.mkdir()
    arguments, word = broken(kind, afm_data, work)
    before = {path.name for path in work.iterdir()}
    if "-o" not in arguments:
        arguments += ["-o", work / "out.nc"]
    assert run("map", *arguments, "--report", work / "out.html") == 1
    captured = capsys.readouterr()
    assert word in flat(captured.err)
    assert "Traceback" not in captured.err
    assert {path.name for path in work.iterdir()} == before


PARTS = ("Channels", "Instrument", "Missing", "Ask for, or do next time", "What it can give")


@pytest.mark.parametrize(
    "name",
    [
        "ibw/AR_20211011.ibw",
        "ibw/tono_whiskers.ibw",
        "ibw/AutexysEFM_0000.ibw",
        "ibw/DTMicroscope_scan_0001_DART.ibw",
        "nanosurf/NSFopen_circles_holes.nid",
        "bruker/hystorian_test_nanonis.000",
        "jpk/AFMReader_sample_0.h5-jpk",
        "neasnom/SnO2_NW4_hyp",
    ],
)
def test_inspect_prints_plain_text_of_eighty_columns(
    name: str, afm_data: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    assert run("inspect", afm_data / name) == 0
    lines = capsys.readouterr().out.splitlines()
    printed = "\n".join(lines)
    places = [
        next(k for k, line in enumerate(lines) if line == part or line.startswith(f"{part} ("))
        for part in PARTS
    ]
    assert places == sorted(places)
    # the probe file is there to be copied, so its lines are not broken
    comments = [line for line in lines if line.startswith("    ") and "  # " in line]
    assert all(len(line) <= 80 for line in lines if line not in comments)
    assert all(line == line.rstrip() for line in lines)
    assert all(character.isprintable() or character == "\n" for character in printed)
    assert "Warning" not in printed
    questions = [line for line in lines[places[-1] :] if line.startswith(" - ")]
    assert [question.split()[1] for question in questions[:3]] == ["energy", "regime", "modulus,"]


def test_inspect_says_the_same_thing_once(afm_data: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run("inspect", afm_data / "ibw" / "DTMicroscope_scan_0001_DART.ibw") == 0
    printed = flat(capsys.readouterr().out)
    assert "first harmonic: no. The file says PFM Mode (ImagingMode); it takes tapping mode." in printed
    assert "modulus, contrast / relative / absolute: no. For the same reason." in printed


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--lift"], "--lift corrects a scan: expected a calibration"),
        (["--reference-area", "none"], "--reference-area corrects a scan: expected a calibration"),
        (["--calibration", "absent.toml"], "cannot read the calibration"),
        (["--calibration", "PROBE"], "is no calibration, or damaged"),
    ],
)
def test_corrections_without_a_calibration_are_named(
    scan_file: Path,
    probe_file: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    options: list[str],
    message: str,
) -> None:
    out, page = tmp_path / "maps.nc", tmp_path / "maps.html"
    given = [probe_file if option == "PROBE" else option for option in options]
    assert run("map", scan_file, "-o", out, "--report", page, *given) == 1
    assert message in flat(capsys.readouterr().err)
    assert not out.exists()
    assert not page.exists()


def test_noise_is_told_from_trace_and_retrace(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Two noisy copies of one scan: 5 pm on A0 and 1 pm on A2, which the file does not say."""
    ways = [virtual_scan(shape=(20, 24), seed=3)[0]]
    motion = virtual_scan(shape=(20, 24), seed=3)[0]
    g = np.random.default_rng(4)
    for way in (ways[0], motion):
        way["A0"] = way["A0"] + g.normal(0.0, 4e-12, way["A0"].shape)
    ways.append(motion)
    both = xr.concat(ways, dim="direction", combine_attrs="override").assign_coords(
        direction=["trace", "retrace"]
    )
    save(both, tmp_path / "both.nc")
    base = ["map", tmp_path / "both.nc", "-o", tmp_path / "maps.nc"]
    assert run(*base, "--direction", "trace") == 0
    found = re.search(r"Noise, from trace and retrace: .*?A0 ([\d.]+) pm", flat(capsys.readouterr().out))
    assert found is not None
    assert float(found.group(1)) == pytest.approx(4.0, rel=0.15)
    # what is stated stands
    assert run(*base, "--direction", "trace", "--noise", "A0=7 pm") == 0
    assert "from trace and retrace" not in flat(capsys.readouterr().out)


def test_inspect_asks_until_nothing_is_missing(
    afm_data: Path, probe_file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = afm_data / "neasnom" / "SnO2_NW4_hyp"
    assert run("inspect", folder) == 0
    printed = flat(capsys.readouterr().out)
    assert "energy dissipated and force of the first harmonic: yes, with k, f0 and Q" in printed
    assert "--probe probe.toml 2. What did M1P read far from the surface" in printed
    assert '--far-phase "? deg"' in printed
    assert 'frequency = "237.595092 kHz" # Tip Frequency [Hz]' in printed
    assert run("inspect", folder, "--probe", probe_file, "--far-phase", "90 deg", "--radius", "10 nm") == 0
    printed = flat(capsys.readouterr().out)
    assert "first harmonic: yes. Everything it takes is there." in printed
    assert "--far-phase" not in printed
    assert "probe.toml, to complete" not in printed
    assert "tip radius" not in printed
    assert run("inspect", folder, "--far-phase", "? deg") == 1
    assert "--far-phase is not a number with a unit" in flat(capsys.readouterr().err)
    assert run("inspect", afm_data / "none.ibw") == 1
    assert "there is no file" in flat(capsys.readouterr().err)


def test_inspect_a_result(scan_file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "maps.nc"
    assert run("map", scan_file, "-o", out, "--poisson-ratio", "0.35", "--method", "exact") == 0
    capsys.readouterr()
    assert run("inspect", out) == 0
    printed = flat(capsys.readouterr().out)
    assert "a result of overtone (map_properties): 12 x 10 pixels" in printed
    assert "method exact" in printed
    assert "regime (attractive or repulsive): yes. Of the pixels: repulsive 100 %." in printed
    assert "modulus, relative / absolute: yes, with a correction that is right." in printed
    assert "modulus" in printed.split("Noticed")[0]
    assert run("inspect", scan_file) == 0
    assert "modulus, absolute: yes, with Poisson's ratio of the sample" in flat(capsys.readouterr().out)


def test_inspect_obeys_no_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Names out of a file are text: neither markup nor what a terminal obeys."""
    path = tmp_path / "maps.nc"
    maps = xr.Dataset({"modulus": (("y", "x"), np.full((2, 3), 1e9), {"units": "Pa"})})
    save(add_finding(maps, "[red]x[/] and \x1b[31m."), path)
    assert run("inspect", path) == 0
    printed = capsys.readouterr().out
    assert "[red]x" in printed
    assert "\x1b" not in printed


def test_models_are_listed(capsys: pytest.CaptureFixture[str]) -> None:
    assert run("models") == 0
    printed = flat(capsys.readouterr().out)
    for key in ("hertz", "dmt-linear", "dmt"):
        assert key in printed
    assert "gamma/(2 beta)" in printed


@pytest.mark.parametrize("key", ["dmt", "sls", "capillary"])
def test_any_model_can_be_drawn(key: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    picture = tmp_path / "model.png"
    assert run("models", key, "--plot", picture, "--set", "modulus=0.5 GPa") == 0
    assert picture.read_bytes().startswith(b"\x89PNG")
    assert "assumes" in capsys.readouterr().out


def test_models_say_which_adhesion_suits(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    contact = ["--set", "radius=10 nm", "--set", "poisson_ratio=0.3"]
    assert run("models", "dmt", *contact, "--set", "modulus=93.78 MPa", "--set", "adhesion=16.24 nN") == 0
    assert "Tabor parameter 20: JKR" in flat(capsys.readouterr().out)
    assert run("models", "dmt", "--set", "modulus=1 nm") == 1
    assert "does not fit" in flat(capsys.readouterr().err)
    assert run("models", "--plot", tmp_path / "all.png") == 1
    assert run("models", "dmt", "--plot", tmp_path / "dmt.txt") == 1
    assert not list(tmp_path.iterdir())


def test_the_demo_writes_what_it_says(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run("demo", "-o", tmp_path / "demo") == 0
    printed = flat(capsys.readouterr().out)
    assert "By population the modulus of LDPE is determined" in printed
    assert "By population the modulus of PS is determined" in printed
    assert "It is the reference, whose modulus was told." in printed
    assert "Verdict: relative" in printed
    beside = printed.split("Materials beside the truth")[1].split("The modulus of the median")[0]
    assert (beside.count("yes"), beside.count(" no ")) == (2, 0)
    result, published = (load(tmp_path / "demo" / name) for name in ("results.nc", "published.nc"))
    assert result.sizes["y"] == result.sizes["x"] == 128
    truth = result["modulus_truth"]
    stiff = result["material_truth"] == 0
    assert [str(name) for name in result["material"].values] == ["PS", "phase_2"]
    # by themselves stiff pixels know nothing
    sure = alone(result)["status"] == 0
    assert float(sure.where(stiff).mean()) < 0.02
    assert float(sure.where(~stiff).mean()) > 0.9
    # those beside a border are told nothing
    assert float((result["status"] == 0).mean()) > 0.9
    soft = result["modulus"].where(~stiff) / truth
    assert 0.85 < float(soft.median()) < 1.15
    for material in (stiff, ~stiff):
        for name in ("modulus", "modulus_unpooled"):
            held = (result[f"{name}_lower"] <= truth) & (truth <= result[f"{name}_upper"])
            assert 0.85 < float(held.where(material).mean()) <= 1.0
    assert float((published["status"] == 0).mean()) < 0.01
    assert float((published["residual"] < 0.1).mean()) > 0.9
    # the same from its files, by the commands of the README
    again, remade, folder = tmp_path / "maps.nc", tmp_path / "calibration.toml", tmp_path / "demo"
    reference = ("--reference", "E=2 GPa, nu=0.35, name=PS", "--far-field", folder / "ladder.nc")
    assert run("calibrate", folder / "curve.nc", *reference, "-o", remade) == 0
    assert load_calibration(remade).values == pytest.approx(
        load_calibration(folder / "calibration.toml").values, rel=1e-4, abs=1e-15
    )
    calibrated = ("--calibration", folder / "calibration.toml", "--lift")
    assert (
        run(
            "map",
            folder / "scan.nc",
            *calibrated,
            "-o",
            again,
            "--poisson-ratio",
            0.35,
            "--model",
            "dmt",
            "--method",
            "least-squares",
            "--harmonics",
            "0,1,2",
        )
        == 0
    )
    ratio = load(again)["modulus_unscreened"] / published["modulus_unscreened"]
    # decimals in the file of the calibration, and how little these pixels determine
    assert float(abs(np.log(ratio)).median()) < 1e-4


def test_a_demo_that_cannot_be_written_says_so(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "taken").write_text("a file")
    assert run("demo", "-o", tmp_path / "taken") == 1
    assert "Traceback" not in capsys.readouterr().err
    assert (tmp_path / "taken").read_text() == "a file"


def test_what_noise_selected_is_not_quoted(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A stiff sample alone: a handful of pixels pass, all of them far too soft."""
    scan, truth = virtual_scan(shape=(60, 60), seed=4)
    stiff = np.flatnonzero(truth["material"].values.ravel() == 0)
    only = scan.stack(point=("y", "x")).isel(point=stiff).reset_index("point", drop=True)
    save(only, tmp_path / "stiff.nc")
    assert run("map", tmp_path / "stiff.nc", "-o", tmp_path / "maps.nc", "--poisson-ratio", 0.35) == 0
    printed = flat(capsys.readouterr().out)
    row = re.search(r"modulus +(\S+) +(\S+)", printed.split("Properties")[1])
    assert row is not None
    assert row.group(1) == "-"


def test_help_needs_no_heavy_imports() -> None:
    """Typing --help should not compile or load what only mapping needs."""
    import subprocess

    code = "import sys, overtone.cli.app; sys.exit('numba' in sys.modules or 'xarray' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
