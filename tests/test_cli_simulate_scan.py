"""``overtone simulate scan`` as a user runs it: what it writes, what it says, and what it refuses."""

import re
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from cyclopts import App

import overtone as ot
from overtone.cli.simulate_scan import scan
from overtone.errors import OvertoneError
from overtone.instrument.instrument import Instrument, NearSurface
from overtone.instrument.phantom import blend, gradient
from overtone.instrument.scan import scan_with_truth
from overtone.instrument.toml import save_instrument
from overtone.readings import probe_of

PROBE = """
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
SMALL = ["--setpoint", 0.42, "--pixels", "8x6", "--size", "1 um"]
INSTRUMENT = Instrument(
    mean_offset=25e-12, mean_drift=1e-13, near_surface=NearSurface(0.02), feedback_error=0.01
)


@pytest.fixture
def probe_file(tmp_path: Path) -> Path:
    path = tmp_path / "probe.toml"
    path.write_text(PROBE, encoding="utf-8")
    return path


@pytest.fixture
def instrument_file(tmp_path: Path) -> Path:
    path = tmp_path / "instrument.toml"
    save_instrument(INSTRUMENT, path)
    return path


def run(*arguments: object) -> None:
    app = App(name="simulate")
    app.command(scan)
    app(["scan", *(str(argument) for argument in arguments)], result_action="return_value")


def test_every_file_holds_what_the_library_gives(
    probe_file: Path, instrument_file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out, truth, curve, ladder = (tmp_path / f"{name}.nc" for name in ("scan", "truth", "curve", "ladder"))
    files = ["-o", out, "--truth", truth, "--curve", curve, "--far-field", ladder]
    heights = ["--z", "30 nm to 130 nm", "--points", 26, "--speed", "1 um/s"]
    given = ["--probe", probe_file, "--instrument", instrument_file, "--phantom", "ps-ldpe", "--seed", 3]
    run(*given, *SMALL, *heights, "--lift", "300 nm", *files)
    printed = re.sub(r"\s+", " ", capsys.readouterr().out)
    assert all(f"wrote {path}" in printed for path in (out, truth, curve, ladder))
    assert "8 x 6 pixels at A1 = 39.5 nm" in printed
    assert "Simulated data" in printed

    probe = ot.load_probe(probe_file)
    phantom = blend(shape=(6, 8), size=1e-6, poisson_ratio=0.35, seed=3)
    # after 15 points of the ladder, 0.1 s each, and 100 nm there and back at 1 um/s
    expected, known = scan_with_truth(
        probe, phantom, INSTRUMENT, setpoint=0.42, lift=300e-9, time=1.5 + 0.2, seed=3
    )
    written = ot.load(out)
    for name in expected.data_vars:
        np.testing.assert_allclose(written[name].values, expected[name].values, rtol=1e-12)
    assert probe_of(written) == probe
    xr.testing.assert_allclose(ot.load(truth)["indentation"], known["indentation"], rtol=1e-12)
    np.testing.assert_array_equal(ot.load(truth)["modulus"].values, phantom["modulus"].values)
    assert ot.load(curve).sizes == {"direction": 2, "z": 26}
    assert ot.load(ladder).sizes == {"point": 15}


def test_one_material_and_an_igor_wave(probe_file: Path, tmp_path: Path) -> None:
    out, curve = tmp_path / "scan.ibw", tmp_path / "curve.ibw"
    polymer = "dmt, modulus=2 GPa, poisson_ratio=0.35, adhesion=8 nN"
    run(
        "--probe", probe_file, "--sample", polymer, *SMALL, "--no-retrace", "-o", out, "--curve", curve, "--points", 40
    )  # fmt: skip
    recording = ot.read_channels(out)
    values = {channel.name: channel.values for channel in recording.channels}
    assert {channel.direction for channel in recording.channels} == {"trace"}
    np.testing.assert_allclose(values["Amplitude"], 0.42 * 94e-9, rtol=2e-3)
    assert ot.read_channels(curve).vendor == "asylum"
    # the name inside the wave is that of the file
    assert b"scan\x00" in out.read_bytes()[:400]


def test_a_map_of_ones_own(probe_file: Path, tmp_path: Path) -> None:
    ot.save(gradient(shape=(3, 5), size=1e-6, viscosity=5.0), tmp_path / "map.nc")
    given = ["--probe", probe_file, "--phantom", tmp_path / "map.nc", "--setpoint", 0.5]
    run(*given, "--poisson-ratio", 0.4, "-o", tmp_path / "scan.nc", "--truth", tmp_path / "truth.nc")
    truth = ot.load(tmp_path / "truth.nc")
    assert truth.sizes["y"] == 3
    assert (truth["viscosity"] == 5.0).all()
    with pytest.raises(OvertoneError, match="needs poisson_ratio"):
        run(*given, "-o", tmp_path / "scan.nc")
    with pytest.raises(OvertoneError, match="its own pixels"):
        run(*given, "--pixels", "4x4", "-o", tmp_path / "scan.nc")


def test_every_fault_is_named_at_once(probe_file: Path, tmp_path: Path) -> None:
    bad = tmp_path / "bad.toml"
    bad.write_text('bandwidth = "2 nm"\ncolour = "red"\n', encoding="utf-8")
    with pytest.raises(OvertoneError) as caught:
        run(
            *("--probe", tmp_path / "none.toml", "--instrument", bad, "--phantom", "gold", "--setpoint", 1.4),
            *(
                "--lift",
                "200",
                "--z",
                "up",
                "--points",
                1,
                "--regime",
                "soft",
                "--seed",
                -1,
                "--speed",
                "1 m",
            ),
            *("-o", tmp_path / "scan.txt", "--truth", tmp_path / "no" / "truth.nc"),
        )
    message = str(caught.value)
    for named in (
        "none.toml",
        "unit of bandwidth",
        "no colour",
        "unknown phantom",
        "--setpoint",
        "--lift has no unit",
        "--z is no range",
        "--points",
        "--regime",
        "--seed",
        "unit of --speed",
        "scan.txt does not end in",
        "the folder",
    ):
        assert named in message, named
    assert not list(tmp_path.glob("scan*"))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ([], "--sample or --phantom, got neither"),
        (["--phantom", "gradient", "--pixels", "8"], "columns x rows"),
        (["--phantom", "gradient", "--size", "0 nm"], "--size is no width"),
        (["--sample", "hertz, modulus=1 GPa, poisson_ratio=0.3", "--model", "dmt"], "are for phantoms"),
        (["--phantom", "gradient", "--truth", "PROBE"], "is taken"),
    ],
)
def test_what_cannot_be_scanned_is_refused(
    options: list[str], message: str, probe_file: Path, tmp_path: Path
) -> None:
    arguments = [str(probe_file) if text == "PROBE" else text for text in options]
    with pytest.raises(OvertoneError, match=message):
        run("--probe", probe_file, "--setpoint", 0.4, *arguments, "-o", tmp_path / "scan.nc")


def test_nothing_is_left_behind_where_the_simulation_fails(probe_file: Path, tmp_path: Path) -> None:
    with pytest.raises(OvertoneError, match="would touch"):
        run(
            "--probe",
            probe_file,
            "--phantom",
            "gradient",
            *SMALL,
            "--lift",
            "20 nm",
            "-o",
            tmp_path / "scan.nc",
        )
    assert not list(tmp_path.glob("scan*"))
