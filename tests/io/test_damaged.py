"""Files cut short or with wrong bytes: an overtone error or a recording, never anything else."""

import shutil
import tempfile
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from hypothesis import given, settings
from hypothesis import strategies as st

from overtone.errors import OvertoneError
from overtone.io.netcdf import load, save
from overtone.io.recording import Recording
from overtone.io.registry import read_channels

REAL = [
    "ibw/AR_20211011.ibw",
    "ibw/AutexysEFM_0000.ibw",
    "ibw/10x10-one_channel_without_name.ibw",
    "ibw/DTMicroscope_scan_0001_DART.ibw",
    "ibw/tono_whiskers.ibw",
    "ibw_byteorder/mac-version2.ibw",
    "ibw_byteorder/mac-version5.ibw",
    "ibw_byteorder/win-version5.ibw",
    "ibw_curves/ForceMetric_X60_3_x4_0100.ibw",
    "ibw_curves/LRCol0_MS_LG7d0001.ibw",
    "gwyddion/GwiddionReader_chip.gsf",
]


def survives(path):
    try:
        recording = read_channels(path)
    except OvertoneError as error:
        recording = str(error)
    if isinstance(recording, str):
        assert len(recording) < 1000
        return False
    assert isinstance(recording, Recording)
    shapes = {channel.values.shape for channel in recording.channels}
    assert len(shapes) == 1
    assert len(shapes.pop()) == len(recording.dims)
    return True


def damage(content, folder, suffix, seed, header=512):
    path = folder / f"damaged{suffix}"
    lengths = sorted(
        {
            0,
            1,
            2,
            7,
            *np.linspace(8, header, 7, dtype=int),
            *np.linspace(header, len(content) - 1, 9, dtype=int),
        }
    )
    for length in lengths:
        if length < len(content):
            path.write_bytes(content[:length])
            survives(path)
    random = np.random.default_rng(seed)
    for attempt in range(24):
        changed = bytearray(content)
        # Most bytes are pixels, where nothing can go wrong; the header takes two of three hits.
        limit = len(content) if attempt % 3 == 0 else min(header, len(content))
        for at in random.integers(0, limit, size=1 + attempt % 4):
            changed[at] = random.integers(0, 256)
        path.write_bytes(bytes(changed))
        survives(path)


@pytest.mark.parametrize("name", REAL)
def test_damaged_real_files(afm_data, tmp_path, name):
    source = afm_data / name
    damage(source.read_bytes(), tmp_path, source.suffix, seed=sum(name.encode()))
    assert survives(source)  # nothing of the damage stays behind


def test_damaged_neasnom_sets(afm_data, tmp_path):
    folder = shutil.copytree(
        afm_data / "neasnom" / "SnO2_NW4_hyp", tmp_path / "set", copy_function=shutil.copyfile
    )
    folder.chmod(0o755)
    random = np.random.default_rng(3)
    for file in sorted(folder.iterdir())[::3] + sorted(folder.glob("*.html")):
        content = file.read_bytes()
        for length in (0, len(content) // 3, len(content) - 1):
            file.write_bytes(content[:length])
            survives(folder)
            survives(file)
        changed = bytearray(content)
        for at in random.integers(0, len(content), size=8):
            changed[at] = random.integers(0, 256)
        file.write_bytes(bytes(changed))
        survives(folder)
        file.write_bytes(content)
    assert survives(folder)


@pytest.mark.parametrize("order", ["<", ">"])
def test_damaged_waves(tmp_path, igor_wave, order):
    note = "SpringConstant: 1\rDriveFrequency: 1e5\rThermalQ: 20\rThermalFrequency: 75000\rFlattenOrder 0: 1"
    labels = [(), (), ("HeightTrace", "PhaseTrace")]
    content = igor_wave(np.ones((4, 3, 2)), order=order, note=note, labels=labels)
    damage(content, tmp_path, ".ibw", seed=1)
    for at in range(0, 384, 2):
        path = tmp_path / "flipped.ibw"
        for value in (b"\xff\xff", b"\x7f\xff", b"\0\0"):
            path.write_bytes(content[:at] + value + content[at + 2 :])
            survives(path)


def test_damaged_netcdf(tmp_path):
    path = tmp_path / "whole.nc"
    values = np.random.default_rng(2).random((20, 30))
    variables = {name: (("y", "x"), values, {"units": "m"}) for name in ("A0", "A1", "A2")}
    save(xr.Dataset(variables, {"y": np.arange(20.0), "x": np.arange(30.0)}, {"history": "[]"}), path)
    content = path.read_bytes()
    for seed in range(3):
        damage(content, tmp_path, ".nc", seed=seed, header=len(content) // 2)
    random = np.random.default_rng(7)
    for _ in range(50):
        changed = bytearray(content)
        changed[random.integers(8, len(content) - 60)] ^= 1 << random.integers(0, 8)
        path.write_bytes(bytes(changed))
        with pytest.raises(OvertoneError, match="damaged"):
            load(path)
    path.write_bytes(content[:4000])
    with pytest.raises(OvertoneError, match="cannot be read"):
        load(path)


def test_netcdf_that_another_program_changed_opens(tmp_path):
    import h5py

    path = tmp_path / "a.nc"
    save(xr.Dataset({"A1": ("point", [1.0, 2.0], {"units": "m"})}), path)
    with h5py.File(path, "a") as file:
        file.attrs["remark"] = "checked"
        file["A1"][0] = 3.0
    assert load(path).attrs["remark"] == "checked"
    assert load(path)["A1"].values.tolist() == [3.0, 2.0]


def test_damaged_tables(tmp_path):
    rows = "".join(f"{i % 5},{i // 5},{i / 7:.6f},{i}\n" for i in range(25))
    damage(
        ("# made: here\nx [nm],y [nm],A1 [nm],phi1 [deg]\n" + rows).encode(),
        tmp_path,
        ".csv",
        seed=5,
        header=60,
    )


MAGIC = st.sampled_from(
    [
        b"\x05\x00",
        b"\x00\x05",
        b"\x02\x00",
        b"\x00\x03",
        b"\x01\x00",
        b"Gwyddion Simple Field 1.0\nXRes=2\nYRes=2\n",
        b"\x89HDF\r\n\x1a\n",
        b"CDF\x01",
        b"<html>Tip Frequency",
        b"a [nm],b [nm]\n1,2\n",
        b"\xff\xfe",
        b"",
    ]
)


@settings(max_examples=150, deadline=None, derandomize=True)
@given(
    magic=MAGIC,
    rest=st.binary(max_size=600),
    suffix=st.sampled_from([".ibw", ".gsf", ".csv", ".html", ".nc"]),
)
def test_anything_behind_a_familiar_beginning(magic, rest, suffix):
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"any{suffix}"
        path.write_bytes(magic + rest)
        survives(path)
