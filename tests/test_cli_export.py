"""``overtone export`` as a user runs it: what it writes, what it says, and what it refuses."""

import csv
import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import xarray as xr

import overtone as ot
from overtone.cli.app import main
from overtone.demo import virtual_scan
from overtone.io.registry import read_channels

VALUES = np.arange(12.0).reshape(3, 4) * 1e-9


@pytest.fixture
def export(capsys: pytest.CaptureFixture[str]) -> Callable[..., tuple[int, str]]:
    """Run the command and return its exit code and what it said."""

    def run(*arguments: object) -> tuple[int, str]:
        try:
            main(["export", *(str(argument) for argument in arguments)])
        except SystemExit as ended:
            code = ended.code if isinstance(ended.code, int) else 1
        else:
            code = 0
        said = capsys.readouterr()
        return code, " ".join((said.out + said.err).split())

    return run


@pytest.fixture
def result(tmp_path: Path) -> Path:
    coords = {"y": ("y", [2e-9, 1e-9, 0.0], {"units": "m"}), "x": ("x", np.arange(4) * 1e-9, {"units": "m"})}
    maps = {name: (("y", "x"), VALUES + k, {"units": "Pa"}) for k, name in enumerate(("modulus", "storage"))}
    ot.save(xr.Dataset({**maps, "materials": ("material", [1.0])}, coords), tmp_path / "result.nc")
    return tmp_path / "result.nc"


@pytest.fixture
def wave(tmp_path: Path) -> Path:
    """A scan as an .ibw of Asylum, with everything that its observables need."""
    scan = virtual_scan(shape=(4, 6))[0]
    ot.save(scan[["height", "A1", "phi1"]], tmp_path / "scan.ibw")
    return tmp_path / "scan.ibw"


def test_a_result_goes_to_gwyddion(
    export: Callable[..., tuple[int, str]], result: Path, tmp_path: Path
) -> None:
    code, said = export(result, tmp_path / "map.gwy")
    assert code == 0
    assert "no place for materials" in said
    assert f"wrote {tmp_path / 'map.gwy'}: modulus, storage" in said
    scan = read_channels(tmp_path / "map.gwy")
    assert [channel.name for channel in scan.channels] == ["modulus", "storage"]
    np.testing.assert_array_equal(scan.channels[1].values, VALUES + 1.0)


def test_some_of_its_variables(export: Callable[..., tuple[int, str]], result: Path, tmp_path: Path) -> None:
    code, said = export(result, tmp_path / "map.csv", "--variables", "storage, modulus")
    assert (code, "no place" in said) == (0, False)
    with (tmp_path / "map.csv").open() as stream:
        header = next(csv.reader(line for line in stream if not line.startswith("#")))
    assert header == ["x [m]", "y [m]", "storage [Pa]", "modulus [Pa]"]
    code, said = export(result, tmp_path / "map.csv", "--variables", "storage,E")
    assert code == 1
    assert "no variable 'E': expected modulus, storage, materials" in said


def test_from_one_format_for_everything_to_the_other(
    export: Callable[..., tuple[int, str]], result: Path, tmp_path: Path
) -> None:
    pytest.importorskip("zarr")
    assert export(result, tmp_path / "a.zarr")[0] == 0
    assert export(tmp_path / "a.zarr", tmp_path / "b.nc")[0] == 0
    xr.testing.assert_identical(ot.load(tmp_path / "b.nc"), ot.load(result))


def test_a_scan_goes_out_as_its_channels(
    export: Callable[..., tuple[int, str]], wave: Path, tmp_path: Path
) -> None:
    code, said = export(wave, tmp_path / "a.csv")
    assert code == 0
    assert "HeightRetrace, AmplitudeRetrace, PhaseRetrace" in said
    scan, table = read_channels(wave), read_channels(tmp_path / "a.csv")
    assert [channel.name for channel in table.channels] == [
        "HeightRetrace",
        "AmplitudeRetrace",
        "PhaseRetrace",
    ]
    for ours, theirs in zip(scan.channels, table.channels, strict=True):
        np.testing.assert_array_equal(theirs.values, ours.values)
        assert theirs.unit == ours.unit


@pytest.mark.parametrize("option", [("--observables",), ("--corrected",), ("--phase-sign", "-1")])
def test_or_as_its_observables(
    export: Callable[..., tuple[int, str]], wave: Path, tmp_path: Path, option: tuple[str, ...]
) -> None:
    code, said = export(wave, tmp_path / "a.nc", *option)
    assert code == 0
    assert "height, A1, phi1" in said
    observables = ot.load(tmp_path / "a.nc")
    sign = -1.0 if "-1" in option else 1.0
    expected = next(c for c in read_channels(wave).channels if c.name == "Phase").values
    np.testing.assert_array_equal(observables["phi1"], sign * expected)
    assert "probe" in observables.attrs


def test_an_igor_wave_always_holds_observables(
    export: Callable[..., tuple[int, str]], wave: Path, tmp_path: Path
) -> None:
    assert export(wave, tmp_path / "again.ibw")[0] == 0
    scan, again = read_channels(wave), read_channels(tmp_path / "again.ibw")
    for ours, theirs in zip(scan.channels, again.channels, strict=True):
        assert theirs.name == ours.name
        np.testing.assert_allclose(theirs.values, ours.values, rtol=1e-6)


def test_a_picture(export: Callable[..., tuple[int, str]], result: Path, tmp_path: Path) -> None:
    from PIL import Image

    assert export(result, tmp_path / "a.png")[0] == 0
    with Image.open(tmp_path / "a.png") as picture:
        assert picture.info["dpi"] == pytest.approx((300, 300), abs=0.01)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("a.h5", ".gwy (maps for Gwyddion)"),
        ("a.ibw", "observables alone"),
        ("missing/a.gwy", "does not exist"),
        ("result.nc", "is the file itself"),
    ],
)
def test_what_is_refused(
    export: Callable[..., tuple[int, str]], result: Path, tmp_path: Path, name: str, message: str
) -> None:
    before = result.read_bytes()
    code, said = export(result, tmp_path / name)
    assert (code, message in said) == (1, True)
    assert result.read_bytes() == before
    assert [file.name for file in tmp_path.iterdir()] == ["result.nc"]


def test_a_file_that_is_missing(export: Callable[..., tuple[int, str]], tmp_path: Path) -> None:
    code, said = export(tmp_path / "missing.ibw", tmp_path / "a.gwy")
    assert (code, "there is no file" in said) == (1, True)


def test_one_wave_of_an_experiment(
    export: Callable[..., tuple[int, str]], wave: Path, tmp_path: Path
) -> None:
    image = wave.read_bytes()
    waves = [image[:92] + name.ljust(32, b"\0") + image[124:] for name in (b"one", b"two")]
    records = b"".join(struct.pack("<Hhi", 3, 0, len(body)) + body for body in waves)
    (tmp_path / "a.pxp").write_bytes(struct.pack("<Hhi", 11, 0, 4) + b"view" + records)
    code, said = export(tmp_path / "a.pxp", tmp_path / "a.gwy")
    assert (code, "2 images" in said, 'a.pxp::one"' in said) == (1, True, True)
    assert export(f"{tmp_path / 'a.pxp'}::two", tmp_path / "a.gwy")[0] == 0
    assert read_channels(tmp_path / "a.gwy").metadata["source"] == "a.pxp::two"


def test_a_real_scan(export: Callable[..., tuple[int, str]], afm_data: Path, tmp_path: Path) -> None:
    source = afm_data / "ibw" / "tono_whiskers.ibw"
    assert export(source, tmp_path / "a.gwy")[0] == 0
    scan, again = read_channels(source), read_channels(tmp_path / "a.gwy")
    assert again.facts == scan.facts
    assert again.resonances == scan.resonances
    for ours, theirs in zip(scan.channels, again.channels, strict=True):
        np.testing.assert_array_equal(theirs.values, ours.values)
        assert (theirs.name, theirs.direction, theirs.flattened) == (
            ours.name,
            ours.direction,
            ours.flattened,
        )
