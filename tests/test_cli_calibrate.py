"""``overtone calibrate`` and ``overtone map --calibration`` as a user runs them, from files to files."""

import math
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr

from overtone import provenance
from overtone.cli import main
from overtone.cli.calibrate import parse_reference
from overtone.contact.sample import sample
from overtone.demo import demo_probe
from overtone.dynamics.hold import hold_amplitude
from overtone.errors import OvertoneError
from overtone.instrument.calibration import load_calibration
from overtone.instrument.correct import calibration_of
from overtone.instrument.curve import simulate_far_field
from overtone.instrument.instrument import Instrument, readings
from overtone.instrument.phantom import blend
from overtone.instrument.photodiode import SplitDiode
from overtone.io.netcdf import load, save
from overtone.probe import save_probe
from overtone.quantities import named_array
from overtone.readings import Reading, reading_of, with_reading

MICROSCOPE = Instrument(
    diode=SplitDiode(500e-9, offset=25e-9),
    gains={0: 1.03, 2: 0.92, 3: 0.9},
    latency={2: 0.3, 3: 0.4},
    crosstalk={2: 50e-12 * np.exp(1j), 3: 20e-12j},
    phase_offset=0.1,
    mean_offset=20e-9,
    mean_slope_z=2e-3,
)
REFERENCE = "E=2 GPa, nu=0.35, name=PS"
NAMES = ["A0", *(f"{letter}{n}" for n in range(1, 7) for letter in ("A", "phi"))]


def run(*arguments: object) -> int:
    """Run the command line and return its exit code."""
    try:
        main([str(argument) for argument in arguments])
    except SystemExit as stop:
        return int(stop.code or 0)
    return 0


def flat(text: str) -> str:
    return re.sub(r"\s+", " ", text)


def raw_curve() -> xr.Dataset:
    probe = demo_probe()
    held = hold_amplitude(
        probe,
        sample("dmt", modulus=1.93e9, poisson_ratio=0.35, adhesion=1.91e-9),
        setpoint=np.linspace(0.2, 0.985, 100),
        n_max=6,
        keep=6,
    )
    z = np.concatenate([held["Z"].values, np.linspace(130e-9, 330e-9, 50)])
    free = {"A1": 94e-9, "phi1": math.pi / 2}
    arrays = {
        name: named_array(name, np.concatenate([held[name].values, np.full(50, free.get(name, 0.0))]), ("z",))
        for name in NAMES
    }
    motion = xr.Dataset(arrays, {"z": ("z", z, {"units": "m"})}).sortby("z", ascending=False)
    shift = MICROSCOPE.mean_slope_z * motion["z"].values
    raw = readings(motion, MICROSCOPE, probe, shift=shift, generator=np.random.default_rng(2))
    return with_reading(raw.assign_coords(z=motion["z"]), Reading(probe))


def raw_scan() -> xr.Dataset:
    """Return trace, retrace and a lift pass of a blend, the zero 0.3 nm on."""
    probe, surface = demo_probe(), blend(shape=(24, 32), seed=5, size=2e-6)
    material = sample(
        "dmt", modulus=surface["modulus"].values, poisson_ratio=0.35, adhesion=surface["adhesion"].values
    )
    held = hold_amplitude(probe, material, setpoint=0.42, n_max=6, keep=6)
    height = held["Z"].values + surface["height"].values
    arrays = {name: named_array(name, held[name].values, ("y", "x"), surface.coords) for name in NAMES}
    motion = xr.Dataset(arrays | {"height": named_array("height", height, ("y", "x"), surface.coords)})
    later = replace(MICROSCOPE, phase_offset=0.1 + math.radians(0.4), mean_offset=20.3e-9)
    g = np.random.default_rng(6)
    ways = [readings(motion, later, probe, shift=2e-3 * height, generator=g) for _ in range(2)]
    free = {name: 94e-9 if name == "A1" else math.pi / 2 if name == "phi1" else 0.0 for name in NAMES}
    swing = motion.assign({name: xr.full_like(motion[name], value) for name, value in free.items()})
    above = [
        readings(swing, later, probe, shift=2e-3 * (height + 200e-9), generator=g).drop_vars("height")
        for _ in range(2)
    ]
    both = [xr.concat(pair, dim="direction", combine_attrs="drop_conflicts") for pair in (ways, above)]
    lifted = {f"lift_{name}": array for name, array in both[1].data_vars.items()}
    scan = both[0].assign(lifted).assign_coords(direction=["trace", "retrace"])
    scan.attrs |= {"lift_height": 200e-9}
    return with_reading(scan, Reading(probe))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with curve, ladder, scan and probe."""
    path = tmp_path_factory.mktemp("instrument")
    save(raw_curve(), path / "curve.nc")
    save(simulate_far_field(demo_probe(), MICROSCOPE, height=300e-9, seed=3), path / "ladder.nc")
    save(raw_scan(), path / "scan.nc")
    save_probe(demo_probe(), path / "probe.toml")
    return path


@pytest.fixture(scope="module")
def calibration_file(folder: Path) -> Path:
    path = folder / "calibration.toml"
    assert (
        run(
            "calibrate",
            folder / "curve.nc",
            "-o",
            path,
            "--reference",
            REFERENCE,
            "--far-field",
            folder / "ladder.nc",
        )
        == 0
    )
    return path


# --- calibrate ------------------------------------------------------------------------------------


def test_calibrate_prints_unknowns_and_verdicts(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "c.json"
    code = run(
        "calibrate", folder / "curve.nc", "-o", out, "--reference", REFERENCE,
        "--far-field", folder / "ladder.nc", "--setpoint", 0.42, "--plot",
    )  # fmt: skip
    printed = flat(capsys.readouterr().out)
    assert code == 0
    for text in (
        "A0: gain",
        "A2: latency",
        "A2: crosstalk",
        "phi1: zero",
        "error",
        "pm at",
        "resonance and Q",
    ):
        assert text in printed
    assert re.search(r"- PS: (absolute|relative|contrast);", printed)
    assert re.search(r"20 times softer: (absolute|relative|contrast);", printed)
    assert f"wrote {out}" in printed
    assert out.with_suffix(".png").read_bytes().startswith(b"\x89PNG")
    result = load_calibration(out)
    assert result.values["gain2"] == pytest.approx(0.92, rel=0.03)
    assert result.reference is not None
    assert result.reference.name == "PS"
    assert result.values["A0_offset"] == pytest.approx(20e-9, rel=0.1)


def test_without_a_reference_only_zeros_are_printed(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "zeros.toml"
    assert run("calibrate", folder / "curve.nc", "-o", out) == 0
    printed = flat(capsys.readouterr().out)
    assert "no reference was given: gains and latency of the harmonics are not known" in printed
    assert "cannot be told apart" in printed
    assert "absolute;" not in printed
    assert load_calibration(out).reference is None


def test_what_the_file_says_is_printed_and_settled_doubts_are_not(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    raw = raw_curve()
    limit = float(np.quantile(raw["A2"].values, 0.6))
    clipped = raw.assign(A2=raw["A2"].clip(max=limit).assign_attrs(raw["A2"].attrs))
    path = tmp_path / "clipped.nc"
    save(clipped, path)
    assert run("calibrate", path, "-o", tmp_path / "c.toml") == 0
    printed = flat(capsys.readouterr().out)
    assert "A2 (A2) is saturated" in printed
    assert "A2 is saturated" in printed
    assert "its zero far from the surface is not known" not in printed


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "--reference is not understood"),
        ("2 GPa", "--reference is not understood"),
        ("E=2 GPa, stiffness=3 N/m, nu=0.3", "--reference is not understood"),
        ("E=, nu=0.3", "--reference is not understood"),
        ("E=2 GPa", "no Poisson's ratio"),
        ("E=2 nm, nu=0.3", "--reference E"),
        ("E=2, nu=0.3", "has no unit"),
        ("E=-2 GPa, nu=0.3", "modulus of the reference makes no sense"),
        ("E=2 GPa, nu=0.7", "oisson"),
        ("E=2 GPa, E_error=0 %, nu=0.3", "modulus error of the reference makes no sense"),
        ("E=2 GPa, nu=0.3, model=nonsense", "nonsense"),
        ("E=2 GPa, modulus=1 GPa, nu=0.3", "gives modulus twice"),
    ],
)
def test_references_that_are_not_understood(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], text: str, message: str
) -> None:
    with pytest.raises(OvertoneError, match=message):
        parse_reference(text)
    out = tmp_path / "none.toml"
    assert run("calibrate", folder / "curve.nc", "-o", out, "--reference", text) == 1
    assert message in flat(capsys.readouterr().err)
    assert list(tmp_path.iterdir()) == []


def test_a_reference_in_words() -> None:
    reference = parse_reference(
        "E=2 GPa, nu=0.35, Fad=8 nN, E_error=5 %, Fad_error=20 %, model=dmt-viscous, name=soft one"
    )
    assert (reference.modulus, reference.poisson_ratio, reference.adhesion) == (2e9, 0.35, 8e-9)
    assert (reference.modulus_error, reference.adhesion_error) == (0.05, 0.2)
    assert (reference.model, reference.name) == ("dmt-viscous", "soft one")
    assert parse_reference("nu=0.4").modulus is None


def test_calibrations_that_cannot_be_made_leave_no_file(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "c.toml"
    short = tmp_path / "short.nc"
    save(raw_curve().isel(z=slice(0, 51)), short)
    cases: list[tuple[list[Any], str]] = [
        ([folder / "absent.nc", "-o", out], "absent.nc"),
        ([folder / "curve.nc", "-o", tmp_path / "c.txt"], "a name that ends in .toml or .json"),
        ([folder / "curve.nc", "-o", tmp_path / "nowhere" / "c.toml"], "does not exist"),
        ([folder / "curve.nc", "-o", out, "--setpoint", 1.5], "--setpoint is A1 over A1far"),
        ([folder / "curve.nc", "-o", out, "--corrected"], "corrected before"),
        ([folder / "curve.nc", "-o", out, "--far-field", folder / "absent.csv"], "absent.csv"),
        ([short, "-o", out, "--reference", REFERENCE], "falls towards neither end"),
        (
            [folder / "curve.nc", "-o", out, "--phase-sign", -1, "--reference", REFERENCE],
            "never touches in repulsion",
        ),
    ]
    for arguments, message in cases:
        assert run("calibrate", *arguments) == 1, message
        assert message in flat(capsys.readouterr().err)
    assert list(tmp_path.iterdir()) == [short]


# --- map --calibration ----------------------------------------------------------------------------


def test_map_a_scan_with_its_calibration(
    folder: Path, calibration_file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A0 of the file has an offset of 20 nm, which without a calibration would be left out."""
    out, page = tmp_path / "maps.nc", tmp_path / "maps.html"
    code = run(
        "map", folder / "scan.nc", "-o", out, "--report", page, "--calibration", calibration_file,
        "--direction", "trace", "--poisson-ratio", 0.35, "--model", "dmt",
    )  # fmt: skip
    printed = flat(capsys.readouterr().out)
    assert code == 0
    assert "anchor A0, phase and higher harmonics to the approach curve" in printed
    assert "left after correction: A0 +-" in printed
    assert "Noise, from trace and retrace: " in printed
    assert "its zero far from the surface is not known" not in printed
    assert "an ordinary one is assumed" not in printed
    result = load(out)
    assert {"modulus", "modulus_lower", "status", "reference", "A0", "virial"} <= set(result.data_vars)
    left, reading = calibration_of(result), reading_of(result)
    assert left is not None
    assert reading is not None
    assert reading.corrected
    surface = blend(shape=(24, 32), seed=5, size=2e-6)
    soft = surface["material"].values == 1
    assert float(result["A0"].values[soft].mean()) == pytest.approx(130e-12, abs=6e-12)
    truth = surface["modulus"].values[soft]
    held = (result["modulus_lower"].values[soft] <= truth) & (truth <= result["modulus_upper"].values[soft])
    assert held.mean() > 0.9
    assert [entry["operation"] for entry in provenance.history(result)].count("correct") == 1
    text = page.read_text(encoding="utf-8")
    assert "Calibration" in text
    assert "PS" in text


def test_noise_of_trace_and_retrace_is_that_of_the_corrected_scan(
    folder: Path, calibration_file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The detector's 30 fm/rtHz in 1 kHz are 0.95 pm of A0 as read, and 3 % less behind its gain."""
    base = ["map", folder / "scan.nc", "--direction", "trace"]
    found = []
    for i, more in enumerate((["--calibration", calibration_file], [])):
        assert run(*base, "-o", tmp_path / f"{i}.nc", *more) == 0
        match = re.search(r"trace and retrace: .*?A2 ([\d.]+) pm", flat(capsys.readouterr().out))
        assert match is not None
        found.append(float(match.group(1)))
    assert found[0] / found[1] == pytest.approx(1.0 / 0.92, rel=0.02)


def test_map_with_a_lift_pass_and_an_area(
    folder: Path, calibration_file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    base = ["map", folder / "scan.nc", "--calibration", calibration_file, "--direction", "retrace"]
    assert run(*base, "-o", tmp_path / "lift.nc", "--lift", "--reference-area", "none") == 0
    printed = flat(capsys.readouterr().out)
    assert "lift pass: A0 without the sample is" in printed
    assert "anchor A0, phase" not in printed
    lifted = load(tmp_path / "lift.nc")
    assert "reference" not in lifted
    assert run(*base, "-o", tmp_path / "box.nc", "--reference-area", "0 um, 0 um, 2 um, 0.4 um") == 0
    assert "% ) anchor" not in flat(capsys.readouterr().out)
    assert 0.15 < float(load(tmp_path / "box.nc")["reference"].mean()) < 0.35


def test_corrections_that_cannot_be_made_leave_no_file(
    folder: Path, calibration_file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "maps.nc"
    damaged = tmp_path / "damaged.toml"
    damaged.write_text("[calibration]\nformat = 1\n", encoding="utf-8")
    scan = ["map", folder / "scan.nc", "-o", out, "--direction", "trace"]
    with_it = [*scan, "--calibration", calibration_file]
    cases: list[tuple[list[Any], str]] = [
        ([*scan, "--lift"], "--lift corrects a scan: expected a calibration"),
        ([*scan, "--reference-area", "auto"], "--reference-area corrects a scan: expected a calibration"),
        ([*scan, "--calibration", folder / "absent.toml"], "cannot read the calibration"),
        ([*scan, "--calibration", damaged], "damaged.toml is no calibration, or damaged"),
        ([*with_it, "--reference-area", "everywhere"], "--reference-area is not understood"),
        ([*with_it, "--reference-area", "0, 0, 1, 1"], "--reference-area has no unit"),
        ([*with_it, "--reference-area", "0 nm, 0 nm, 1 nm, 1 nm"], "too few pixels of the reference"),
        ([*with_it, "--corrected"], "the scan is stated to be corrected"),
        (["map", folder / "curve.nc", "-o", out, "--calibration", calibration_file, "--lift"], "lift"),
    ]
    for arguments, message in cases:
        assert run(*arguments) == 1, message
        assert message in flat(capsys.readouterr().err)
    assert list(tmp_path.iterdir()) == [damaged]


def test_a_result_is_not_corrected_again(
    folder: Path, calibration_file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    once = tmp_path / "once.nc"
    assert (
        run("map", folder / "scan.nc", "-o", once, "--direction", "trace", "--calibration", calibration_file)
        == 0
    )
    capsys.readouterr()
    assert run("map", once, "-o", tmp_path / "twice.nc", "--calibration", calibration_file) == 1
    assert "corrected" in flat(capsys.readouterr().err)
    assert not (tmp_path / "twice.nc").exists()
