"""Every format that datasets go out in, through a reader that is not overtone's, and back."""

import csv
import os
import signal
import subprocess
import sys
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr

import overtone as ot
from overtone import provenance
from overtone.demo import virtual_scan
from overtone.errors import ChannelWarning, FileFormatError, ObservablesError, OvertoneWarning
from overtone.io import export
from overtone.io.registry import read_channels
from overtone.readings import probe_of

SUFFIXES = tuple(writer.suffix for writer in export.WRITERS)
CORNERS = [(0, 0), (0, 3), (2, 0), (2, 3)]
HEIGHT = np.arange(12.0).reshape(3, 4) * 1.1e-9  # neither square nor symmetric: 0 is at the top left


def _maps() -> xr.Dataset:
    """A result with floats, an observable without values in places, flags and a further dimension."""
    A1 = HEIGHT + 40e-9
    A1[2, 3] = np.nan
    status = np.array([[0, 1, 0, 1], [1, 1, 1, 1], [0, 0, 0, 1]], np.int8)
    forces = np.stack([-HEIGHT, HEIGHT * np.pi])
    dataset = xr.Dataset(
        {
            "height": (("y", "x"), HEIGHT, {"units": "m", "long_name": "topography"}),
            "A1": (("y", "x"), A1, {"units": "m"}),
            "phi1": (("y", "x"), np.radians(HEIGHT * 1e10 + 3.0), {"units": "rad"}),
            "status": (
                ("y", "x"),
                status,
                {"units": "1", "flag_values": [0, 1], "flag_meanings": "no_contact determined"},
            ),
            "F_cons": (("harmonic", "y", "x"), forces, {"units": "N"}),
        },
        {
            "y": ("y", [1.5e-6, 1.0e-6, 0.5e-6], {"units": "m"}),
            "x": ("x", np.arange(4) * 0.25e-6, {"units": "m"}),
            "harmonic": [1, 2],
        },
        {"source": "a.ibw"},
    )
    return provenance.add_finding(dataset, "A0 has no unit.", "The tip is new.")


PLANES = {
    "height": None,
    "A1": None,
    "phi1": None,
    "status": None,
    "F_cons harmonic 1": 0,
    "F_cons harmonic 2": 1,
}


def _plane(dataset: xr.Dataset, title: str) -> np.ndarray:
    """The values that a channel of this title holds, by hand."""
    index = PLANES[title]
    array = dataset[title.split()[0]].values
    return np.asarray(array if index is None else array[index], dtype=float)


# --- the registry -----------------------------------------------------------------------------------


def test_the_public_names() -> None:
    assert (ot.save, ot.load) == (export.save, export.load)


def test_other_endings_are_refused_with_all_that_exist(tmp_path: Path) -> None:
    with pytest.raises(FileFormatError) as refused:
        ot.save(_maps(), tmp_path / "map.h5")
    assert all(suffix in str(refused.value) for suffix in SUFFIXES)
    with pytest.raises(FileFormatError, match="no ending"):
        ot.save(_maps(), tmp_path / "map")


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_only_datasets(tmp_path: Path, suffix: str) -> None:
    with pytest.raises(ObservablesError, match="to_dataset"):
        ot.save(xr.DataArray([1.0]), tmp_path / f"a{suffix}")  # type: ignore[arg-type]
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_folders_that_do_not_exist(tmp_path: Path, suffix: str) -> None:
    with pytest.raises(FileFormatError, match="existing folder"):
        _saved(_maps(), tmp_path / "missing" / f"a{suffix}")


def _saved(dataset: xr.Dataset, path: Path) -> Path:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ChannelWarning)
        ot.save(dataset, path)
    return path


@pytest.mark.parametrize("suffix", [".nc", ".zarr"])
def test_what_holds_anything_comes_back_identical(tmp_path: Path, suffix: str) -> None:
    pytest.importorskip("zarr")
    whole = _maps()
    ot.save(whole, tmp_path / f"a{suffix}")
    xr.testing.assert_identical(ot.load(tmp_path / f"a{suffix}"), whole)


def test_names_in_capitals(tmp_path: Path) -> None:
    assert read_channels(_saved(_maps(), tmp_path / "A.GWY")).format == "gwy"


# --- netCDF -----------------------------------------------------------------------------------------


def test_h5py_reads_netcdf(tmp_path: Path) -> None:
    import h5py

    path, whole = tmp_path / "a.nc", _maps()
    ot.save(whole, path)
    with h5py.File(path, "r") as file:
        for name in whole.data_vars:
            np.testing.assert_array_equal(file[name][()], whole[name].values)  # bit for bit
        assert file["height"].attrs["units"] == "m"
        assert [file["height"][at] for at in CORNERS] == [HEIGHT[at] for at in CORNERS]
        np.testing.assert_array_equal(file["y"][()], whole["y"].values)


# --- Gwyddion ---------------------------------------------------------------------------------------


def test_gwyfile_reads_every_map(tmp_path: Path) -> None:
    gwyfile = pytest.importorskip("gwyfile")
    path, whole = tmp_path / "a.gwy", _maps()
    ot.save(whole, path)
    container = gwyfile.load(str(path))
    titles = [container[f"/{k}/data/title"] for k in range(6)]
    assert titles == list(PLANES)
    assert "/6/data" not in container
    units = ["m", "m", "rad", "", "N", "N"]
    for k, title in enumerate(titles):
        field, expected = container[f"/{k}/data"], _plane(whole, title)
        known = np.isfinite(expected)
        np.testing.assert_array_equal(field.data[known], expected[known])  # doubles, bit for bit
        assert (field.xreal, field.yreal) == pytest.approx((1e-6, 1.5e-6), rel=1e-12, abs=0)
        assert (field["si_unit_xy"]["unitstr"], field["si_unit_z"]["unitstr"]) == ("m", units[k])
        assert np.isfinite(field.data).all()  # the format allows nothing else
        assert (f"/{k}/mask" in container) == (not known.all())
    mask = container["/1/mask"].data
    assert (mask.sum(), mask[2, 3]) == (1.0, 1.0)
    assert container["/1/data"].data[2, 3] == pytest.approx(np.nanmean(whole["A1"]), rel=1e-12, abs=0)
    meta = container["/3/meta"]
    assert (meta["finding 1"], meta["source"], meta["overtone"]) == (
        "A0 has no unit.",
        "a.ibw",
        ot.__version__,
    )
    assert meta["channel: flag_meanings"] == "no_contact determined"


def test_gwyddionpy_reads_every_map(tmp_path: Path) -> None:
    gwyddionpy = pytest.importorskip("gwyddionpy")
    path, whole = tmp_path / "a.gwy", _maps()
    ot.save(whole, path)
    data = gwyddionpy.load(path)
    assert list(data.channels) == list(PLANES)
    channel = data.channels["height"]
    assert [channel.data[at] for at in CORNERS] == [HEIGHT[at] for at in CORNERS]
    assert (channel.si_unit_xy, channel.si_unit_z, channel.meta["finding 2"]) == ("m", "m", "The tip is new.")


def test_gwyddion_itself_opens_it(tmp_path: Path) -> None:
    gwyddionpy = pytest.importorskip("gwyddionpy")
    whole = _maps()
    other_name = _saved(whole, tmp_path / "a.gwy").rename(
        tmp_path / "a.dat"
    )  # a .gwy would go past the converter
    try:
        data = gwyddionpy.load(other_name)
    except gwyddionpy.GwyddionPyError as error:
        pytest.skip(f"no converter: {error}")
    assert data.source_format == "gwyfile"
    assert list(data.channels) == list(PLANES)
    for title, channel in data.channels.items():
        expected = _plane(whole, title)
        known = np.isfinite(expected)
        np.testing.assert_allclose(channel.data[known], expected[known], rtol=1e-12)
    assert (data.channels["height"].xreal, data.channels["height"].yreal) == pytest.approx((1e-6, 1.5e-6))
    assert data.channels["phi1"].si_unit_z == "rad"


def test_a_gwyddion_file_comes_back(tmp_path: Path) -> None:
    whole = _maps()
    scan = read_channels(_saved(whole, tmp_path / "a.gwy"))
    assert (scan.vendor, [(c.name, c.unit) for c in scan.channels][3]) == ("overtone", ("status", "1"))
    for channel in scan.channels:
        np.testing.assert_array_equal(channel.values, _plane(whole, channel.name))  # NaN where it was
    assert scan.metadata["source"] == "a.ibw"
    np.testing.assert_allclose(np.diff(scan.coords["x"]), 0.25e-6, rtol=1e-9)
    assert float(scan.coords["y"][0]) > float(scan.coords["y"][-1])
    assert scan.notes == ()


def test_observables_come_back_from_gwyddion_with_their_probe(tmp_path: Path) -> None:
    scan = virtual_scan(shape=(4, 6))[0]
    both = xr.concat([scan, scan + 0.0], xr.Variable("direction", ["trace", "retrace"])).assign_attrs(
        scan.attrs
    )
    path = _saved(both, tmp_path / "a.gwy")
    assert read_channels(path).channels[0].direction == "trace"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", OvertoneWarning)
        again = ot.open_scan(path, direction="retrace")
    assert probe_of(again) == probe_of(scan)
    for name in scan.data_vars:
        np.testing.assert_array_equal(again[name], scan[name])


def test_prefixes_go_into_the_values(tmp_path: Path) -> None:
    """Gwyddion ignores the prefix of a unit."""
    dataset = xr.Dataset(
        {"h": (("y", "x"), HEIGHT * 1e9, {"units": "nm"}), "p": (("y", "x"), HEIGHT, {"units": "deg"})}
    )
    scan = read_channels(_saved(dataset, tmp_path / "a.gwy"))
    assert [channel.unit for channel in scan.channels] == ["m", "rad"]
    np.testing.assert_allclose(scan.channels[0].values, HEIGHT, rtol=1e-15)
    np.testing.assert_allclose(scan.channels[1].values, np.radians(HEIGHT), rtol=1e-15)
    assert dict(scan.coords) == {}  # pixels without a size


def test_what_gwyddion_cannot_hold(tmp_path: Path) -> None:
    with pytest.raises(ObservablesError, match=r"no map.*\.csv or \.nc"):
        ot.save(xr.Dataset({"A1": ("z", [1.0, 2.0])}), tmp_path / "a.gwy")
    uneven = _maps().assign_coords(x=("x", [0.0, 1e-6, 3e-6, 4e-6], {"units": "m"}))
    with pytest.raises(ObservablesError, match="x is not evenly spaced"):
        ot.save(uneven, tmp_path / "a.gwy")
    curve = _maps().assign(curve=("z", [1.0]), text=("z", ["a"]))
    with pytest.warns(ChannelWarning, match="curve, text"):
        ot.save(curve, tmp_path / "a.gwy")


# --- tables -----------------------------------------------------------------------------------------


def _rows(path: Path) -> tuple[list[str], list[list[str]]]:
    lines = [line for line in path.read_text(encoding="utf-8").splitlines() if not line.startswith("#")]
    header, *rows = csv.reader(lines)
    return header, rows


def test_the_csv_module_reads_a_table(tmp_path: Path) -> None:
    path, whole = tmp_path / "a.csv", _maps()
    ot.save(whole, path)
    header, rows = _rows(path)
    assert header == [
        "x [m]",
        "y [m]",
        "height [m]",
        "A1 [m]",
        "phi1 [rad]",
        "status [1]",
        "F_cons harmonic 1 [N]",
        "F_cons harmonic 2 [N]",
    ]
    assert len(rows) == 12
    for row, (i, j) in zip(rows, np.ndindex(3, 4), strict=True):
        assert float(row[0]) == whole["x"].values[j]  # every digit
        assert float(row[1]) == whole["y"].values[i]
        assert float(row[2]) == HEIGHT[i, j]
        assert float(row[4]) == whole["phi1"].values[i, j]
        assert row[5] == str(whole["status"].values[i, j])
        assert float(row[7]) == whole["F_cons"].values[1, i, j]
    assert rows[-1][3] == ""
    comments = [line for line in path.read_text().splitlines() if line.startswith("#")]
    assert "# finding 1: A0 has no unit." in comments
    assert "# values of status: 0 no_contact, 1 determined" in comments


def test_pandas_reads_a_table(tmp_path: Path) -> None:
    pandas = pytest.importorskip("pandas")
    path = _saved(_maps(), tmp_path / "a.csv")
    frame = pandas.read_csv(path, comment="#")
    np.testing.assert_allclose(frame["height [m]"].to_numpy().reshape(3, 4), HEIGHT, rtol=1e-15)
    assert frame["A1 [m]"].isna().sum() == 1


def test_a_table_comes_back(tmp_path: Path) -> None:
    whole = _maps()
    scan = read_channels(_saved(whole, tmp_path / "a.csv"))
    assert (scan.dims, [c.name for c in scan.channels]) == (("y", "x"), list(PLANES))
    assert [c.unit for c in scan.channels] == ["m", "m", "rad", "1", "N", "N"]
    for channel in scan.channels:
        np.testing.assert_array_equal(channel.values, _plane(whole, channel.name))  # bit for bit
    for axis in ("x", "y"):
        np.testing.assert_array_equal(scan.coords[axis], whole[axis].values)
    assert scan.notes == ()


def test_curves_and_maps_without_coordinates_as_tables(tmp_path: Path) -> None:
    z = np.array([3e-9, 2e-9, 1e-9])
    curve = xr.Dataset({"A1": ("z", z * 2.0, {"units": "m"}), "n": ("z", [1, 2, 3])}, {"z": z})
    scan = read_channels(_saved(curve, tmp_path / "a.csv"))
    assert (scan.dims, [(c.name, c.unit) for c in scan.channels]) == (("z",), [("A1", "m"), ("n", None)])
    np.testing.assert_array_equal(scan.coords["z"], z)
    bare = xr.Dataset({"A1": (("y", "x"), HEIGHT, {"units": "m"})})
    scan = read_channels(_saved(bare, tmp_path / "b.csv"))
    np.testing.assert_array_equal(scan.channels[0].values, HEIGHT)
    assert dict(scan.coords) == {}
    with pytest.raises(ObservablesError, match=r"neither maps nor curves.*\.nc or \.zarr"):
        ot.save(xr.Dataset({"a": ((), 1.0)}), tmp_path / "c.csv")


def test_directions_and_awkward_names_in_tables(tmp_path: Path) -> None:
    values = np.stack([HEIGHT, HEIGHT + 1.0])
    dims = ("direction", "y", "x")
    dataset = xr.Dataset(
        {"A1": (dims, values, {"units": "m"}), 'a; [b], "c"\n': (("y", "x"), HEIGHT, {"units": "m"})},
        {"direction": ["trace", "retrace"]},
        {"lines": "one\ntwo", "short": "text"},
    )
    path = _saved(dataset, tmp_path / "a.csv")
    assert _rows(path)[0][2:4] == ["A1 trace [m]", "A1 retrace [m]"]
    assert not any(line.startswith("two") for line in path.read_text().splitlines())
    scan = read_channels(path)
    assert len(scan.channels) == 3
    np.testing.assert_array_equal(scan.channels[1].values, HEIGHT + 1.0)
    np.testing.assert_array_equal(scan.channels[2].values, HEIGHT)


# --- Igor -------------------------------------------------------------------------------------------


def test_igor2_reads_observables(tmp_path: Path) -> None:
    from igor2 import binarywave

    scan = virtual_scan(shape=(3, 5))[0]
    wave = binarywave.load(str(_saved(scan, tmp_path / "a.ibw")))["wave"]
    assert wave["wData"].shape[:2] == (5, 3)
    height = wave["wData"][:, :, 0]
    for row, column in [(0, 0), (0, 4), (2, 0), (2, 4)]:
        # 32 bits, columns first and rows from the bottom
        assert height[column, 2 - row] == np.float32(scan["height"].values[row, column])


def test_igor_waves_hold_observables_alone(tmp_path: Path) -> None:
    with pytest.raises(ObservablesError, match=r"observables alone.*got height.*\.gwy or \.csv"):
        ot.save(_maps()[["height", "status"]], tmp_path / "a.ibw")


# --- pictures ---------------------------------------------------------------------------------------


def test_pillow_reads_a_picture(tmp_path: Path) -> None:
    from PIL import Image

    with Image.open(_saved(_maps(), tmp_path / "a.png")) as picture:
        assert picture.format == "PNG"
        assert picture.info["dpi"] == pytest.approx((300, 300), abs=0.01)
        width, height = picture.size
        assert 2500 < width < 3500
        assert height > 1500
        pixels = np.asarray(picture.convert("RGB"))
    # The first map begins with its least value, at its top left.
    light = pixels.sum(axis=2)
    corner = {at: int(light[int(at[0] * height), int(at[1] * width)]) for at in ((0.07, 0.08), (0.41, 0.27))}
    assert corner[0.07, 0.08] < 150 < 450 < corner[0.41, 0.27]
    colours = np.unique(pixels.reshape(-1, 3).astype(int) @ [1 << 16, 1 << 8, 1])
    assert len(colours) > 200  # colour maps and their bars
    # Maps and bars have colours, texts are grey: there is something in every cell of the sheet.
    coloured = pixels.max(axis=2).astype(int) - pixels.min(axis=2) > 40
    for column in np.array_split(coloured, 3, axis=1):
        for cell in np.array_split(column, 2, axis=0):
            assert cell.mean() > 0.05


def test_pictures_of_curves(tmp_path: Path) -> None:
    from PIL import Image

    z = np.linspace(1e-9, 9e-9, 9)
    curve = xr.Dataset({"A1": ("z", z, {"units": "m"}), "phi1": ("z", z * 1e8, {"units": "rad"})}, {"z": z})
    with Image.open(_saved(curve, tmp_path / "a.png")) as picture:
        assert np.asarray(picture.convert("L")).min() < 60


def test_pictures_of_many_maps(tmp_path: Path) -> None:
    variants = {
        f"modulus{end}": (("y", "x"), HEIGHT + 1.0, {"units": "Pa"}) for end in ("", "_lower", "_upper")
    }
    many = {f"own{k}": (("y", "x"), HEIGHT) for k in range(23)}
    with pytest.warns(ChannelWarning, match="modulus_lower, modulus_upper"):
        ot.save(xr.Dataset({**variants, **many}), tmp_path / "a.png")
    with pytest.raises(ObservablesError, match=r"at most 24.*--variables"):
        ot.save(xr.Dataset({f"own{k}": (("y", "x"), HEIGHT) for k in range(25)}), tmp_path / "b.png")


# --- whole or not at all ----------------------------------------------------------------------------


def _everything(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


_INSIDE: dict[str, tuple[Any, str]] = {
    ".nc": (xr.Dataset, "to_netcdf"),
    ".zarr": (xr.Dataset, "to_zarr"),
    ".gwy": (Path, "write_bytes"),
    ".ibw": (Path, "write_bytes"),
    ".png": (Path, "write_bytes"),
    ".csv": (csv, "writer"),
}


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_a_failure_inside_leaves_the_old_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, suffix: str
) -> None:
    path = _saved(virtual_scan(shape=(3, 5))[0], tmp_path / f"a{suffix}")
    before = _everything(tmp_path)
    holder, name = _INSIDE[suffix]
    whole = getattr(holder, name)

    def half(*arguments: Any, **named: Any) -> Any:
        if suffix != ".csv":
            whole(*arguments, **named)
        raise KeyboardInterrupt

    monkeypatch.setattr(holder, name, half)
    with pytest.raises(KeyboardInterrupt):
        ot.save(virtual_scan(shape=(4, 6))[0], path)
    monkeypatch.undo()
    assert _everything(tmp_path) == before


_KILLED = """
import sys, time
import numpy as np, xarray as xr
import overtone as ot
from pathlib import Path
from overtone.io import {module}
whole = {holder}.{name}
def slow(*arguments, **named):
    result = whole(*arguments, **named)
    print("inside", flush=True)
    time.sleep(60)
    return result
{holder}.{name} = slow
values = np.ones((40, 50))
ot.save(xr.Dataset({{"A1": (("y", "x"), values), "phi1": (("y", "x"), values)}}), sys.argv[1])
"""


@pytest.mark.skipif(os.name == "nt", reason="Windows has no such signal")
@pytest.mark.parametrize(
    ("suffix", "module", "holder", "name"),
    [(".gwy", "gwy_write", "Path", "write_bytes"), (".zarr", "zarr_store", "xr.Dataset", "to_zarr")],
)
def test_a_killed_run_leaves_the_old_file(
    tmp_path: Path, suffix: str, module: str, holder: str, name: str
) -> None:
    path = _saved(_maps(), tmp_path / f"a{suffix}")
    before = path.read_bytes() if path.is_file() else _everything(path)
    script = _KILLED.format(module=module, holder=holder, name=name)
    process = subprocess.Popen([sys.executable, "-c", script, str(path)], stdout=subprocess.PIPE, text=True)
    try:
        assert process.stdout is not None
        assert process.stdout.readline().strip() == "inside"  # half way: written beside, not yet moved
        beside = [found.name for found in tmp_path.iterdir() if found != path]
        assert len(beside) == 1
        process.send_signal(signal.SIGKILL)
        process.wait(timeout=20)
    finally:
        process.kill()
        process.wait()
        if process.stdout is not None:
            process.stdout.close()
    assert (path.read_bytes() if path.is_file() else _everything(path)) == before
    if suffix == ".zarr":
        xr.testing.assert_identical(ot.load(path), _maps())


# --- channels of a microscope's file ----------------------------------------------------------------


def test_channels_as_the_file_holds_them(tmp_path: Path, igor_wave: Callable[..., bytes]) -> None:
    layers = np.stack([HEIGHT.T[:, ::-1], HEIGHT.T[:, ::-1] + 1.0, HEIGHT.T[:, ::-1] * 1e10], axis=-1)
    labels = ((), (), ("HeightTrace", "HeightRetrace", "PhaseRetrace"))
    note = "SpringConstant: 2.5\rFlattenOrder 0: -1\rFlattenOrder 1: 1\rFlattenOrder 2: -1\rThermalQ: 20\r"
    source = tmp_path / "a.ibw"
    source.write_bytes(igor_wave(layers, labels=labels, note=note))
    recording = read_channels(source)
    dataset = export.channels_dataset(recording)
    assert list(dataset.data_vars) == ["HeightTrace", "HeightRetrace", "PhaseRetrace"]
    np.testing.assert_array_equal(dataset["HeightTrace"], HEIGHT)
    assert dataset["PhaseRetrace"].attrs["units"] == "rad"
    assert provenance.history(dataset)[-1]["operation"] == "read_channels"
    # Through Gwyddion everything that the wave said is still there, also for a part of its channels.
    for part in (dataset, dataset[["HeightRetrace", "PhaseRetrace"]]):
        again = read_channels(_saved(part, tmp_path / "a.gwy"))
        assert again.vendor == "asylum"
        assert again.facts == recording.facts
        kept = [c for c in recording.channels if f"{c.name}{str(c.direction).capitalize()}" in part]
        for ours, theirs in zip(kept, again.channels, strict=True):
            assert (theirs.name, theirs.direction, theirs.unit) == (ours.name, ours.direction, ours.unit)
            assert theirs.flattened == ours.flattened
            np.testing.assert_array_equal(theirs.values, ours.values)


def test_raw_channels_of_others_do_not_become_overtones(tmp_path: Path) -> None:
    """Else the phases of any microscope would pass for lags referred to the free lever."""
    source = tmp_path / "a.gsf"
    content = b"Gwyddion Simple Field 1.0\nXRes=2\nYRes=1\nTitle=phi1\nZUnits=deg\n"
    source.write_bytes(content + b"\0" * (4 - len(content) % 4) + np.array([1.0, 2.0], "<f4").tobytes())
    again = read_channels(_saved(export.channels_dataset(read_channels(source)), tmp_path / "a.gwy"))
    assert again.vendor == "gwyddion"
    assert again.channels[0].unit == "rad"


def test_names_that_come_twice(tmp_path: Path, igor_wave: Callable[..., bytes]) -> None:
    source = tmp_path / "a.ibw"
    source.write_bytes(igor_wave(np.zeros((4, 3, 3)), labels=((), (), ("Height", "Height", "x"))))
    assert list(export.channels_dataset(read_channels(source)).data_vars) == ["Height", "Height 2", "x 2"]


def test_time_to_write_a_large_map(tmp_path: Path) -> None:
    values = np.random.default_rng(1).random((512, 512))
    dataset = xr.Dataset({f"A{n}": (("y", "x"), values, {"units": "m"}) for n in range(1, 7)})
    begun = time.perf_counter()
    ot.save(dataset, tmp_path / "a.gwy")
    assert time.perf_counter() - begun < 10.0
    assert (tmp_path / "a.gwy").stat().st_size < 1.01 * 6 * values.nbytes + 10_000
