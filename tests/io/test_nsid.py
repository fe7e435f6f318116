"""HDF5 of pycroscopy: NSID and USID, against h5py by hand and against the wave that such a file was made from."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import xarray as xr

from overtone.errors import FileFormatError, OvertoneError
from overtone.io import hdf5_guard, netcdf, nsid
from overtone.io.recording import Recording
from overtone.io.registry import read_channels

VALUES = np.arange(12.0, dtype=np.float32).reshape(3, 4)  # rows over y, columns over x
NOTE = {"SpringConstant": 2.5, "ImagingMode": 1, "AmpInvOLS": 4e-8, "FreeAirAmplitude": 0.5, "ThermalQ": 150}
WHOLE = ({"quantity": "HeightRetrace"}, {"quantity": "PhaseRetrace", "units": "deg"})


def _add(
    file: h5py.File,
    index: int,
    values: np.ndarray,
    *,
    quantity: str,
    units: str = "m",
    names: Sequence[str] = ("y", "x"),
    positions: Mapping[str, np.ndarray] | None = None,
    axis_unit: str = "m",
    note: Mapping[str, object] | None = None,
    measurement: int = 0,
) -> h5py.Dataset:
    """Write a channel as pyNSID does: a group in a group, with the scales of its dimensions beside it."""
    name = f"Channel_{index}"
    group = file.require_group(f"Measurement_{measurement:03d}/{name}/{name}")
    data = group.create_dataset(name, data=values)
    data.attrs.update({"quantity": quantity, "units": units, "data_type": "IMAGE", "modality": "generic"})
    for k, axis in enumerate(names):
        along = (positions or {}).get(axis, np.arange(values.shape[k]) * 1e-9)
        scale = group.create_dataset(axis, data=along)
        scale.attrs.update({"quantity": axis, "units": axis_unit, "dimension_type": "SPATIAL"})
        scale.make_scale(axis)
        data.dims[k].label = axis
        data.dims[k].attach_scale(scale)
    if note is not None:
        group.create_group("original_metadata").attrs.update(note)
    return data


@pytest.fixture
def write(tmp_path: Path) -> Callable[..., Path]:
    def written(*channels: dict[str, Any], **common: Any) -> Path:
        path = tmp_path / "a.h5"
        with h5py.File(path, "w") as file:
            for index, given in enumerate(channels):
                arguments = {"values": VALUES, **common, **given}
                _add(file, index, arguments.pop("values"), **arguments)
        return path

    return written


# --- NSID -------------------------------------------------------------------------------------------


def test_a_file_of_another_instrument(write: Callable[..., Path]) -> None:
    scan = read_channels(write(*WHOLE, {"quantity": "Field", "units": "T"}))
    assert (scan.format, scan.vendor, scan.dims) == ("nsid", "pycroscopy", ("y", "x"))
    assert [(c.name, c.direction, c.unit) for c in scan.channels] == [
        ("Height", "retrace", "m"),
        ("Phase", "retrace", "rad"),
        ("Field", None, None),
    ]
    height, phase, field = (channel.values for channel in scan.channels)
    assert [height[0, 0], height[0, 3], height[2, 0], height[2, 3]] == [0.0, 3.0, 8.0, 11.0]
    np.testing.assert_allclose(phase, np.radians(VALUES.astype(float)), rtol=1e-15)
    np.testing.assert_array_equal(field, VALUES)
    np.testing.assert_allclose(scan.coords["y"], [2e-9, 1e-9, 0.0], atol=1e-25)  # row 0 has the largest y
    assert any("which way up" in note for note in scan.notes)
    assert any("'T' is not known" in note for note in scan.notes)


def test_what_came_from_asylum_counts_rows_from_the_bottom(write: Callable[..., Path]) -> None:
    given = {"names": ("x", "y"), "values": VALUES.T, "note": NOTE}
    scan = read_channels(write(*({**channel, **given} for channel in WHOLE)))
    assert scan.vendor == "asylum"
    np.testing.assert_array_equal(scan.channels[0].values, VALUES[::-1])
    np.testing.assert_allclose(scan.coords["y"], [2e-9, 1e-9, 0.0], atol=1e-25)
    assert scan.facts["free_amplitude"].value == pytest.approx(2e-8, rel=1e-12, abs=0)
    assert (scan.facts["stiffness"].value, scan.metadata["ImagingMode"]) == (2.5, "AC Mode")
    assert "ImagingMode 1 is AC Mode" in scan.notes


def test_y_that_falls_has_the_top_first(write: Callable[..., Path]) -> None:
    falling = {"y": np.array([3e-9, 2e-9, 1e-9])}
    scan = read_channels(write({"quantity": "HeightRetrace", "positions": falling, "note": NOTE}))
    np.testing.assert_array_equal(scan.channels[0].values, VALUES)
    np.testing.assert_array_equal(scan.coords["y"], falling["y"])


@pytest.mark.parametrize(
    ("quantity", "unit"), [("FrequencyRetrace", "Hz"), ("UserIn0Retrace", None), ("Amplitude2Trace", "m")]
)
def test_metres_that_pycroscopy_wrote_for_want_of_a_unit(
    write: Callable[..., Path], quantity: str, unit: str | None
) -> None:
    scan = read_channels(write({"quantity": quantity, "note": NOTE}))
    assert scan.channels[0].unit == unit
    assert read_channels(write({"quantity": quantity})).channels[0].unit == "m"


def test_coordinates_without_lengths(write: Callable[..., Path]) -> None:
    scan = read_channels(write({"quantity": "Height", "axis_unit": "deg"}))
    assert dict(scan.coords) == {}
    # The scales of a phase are in its own unit in the files of pycroscopy, so another channel has to give them.
    scan = read_channels(
        write({"quantity": "Phase", "axis_unit": "deg", "units": "deg"}, {"quantity": "Height"})
    )
    assert scan.coords["x"][-1] == pytest.approx(3e-9, rel=1e-12, abs=0)


def test_what_is_left_out_is_told(write: Callable[..., Path]) -> None:
    spectra = {"quantity": "Spectra", "values": np.zeros((3, 4, 2)), "names": ("y", "x", "bias")}
    cut = {"quantity": "Cut", "values": VALUES[:2]}
    odd = {"quantity": "Odd", "names": ("a", "b")}
    path = write(*WHOLE, spectra, cut, odd)
    with h5py.File(path, "a") as file:
        _add(file, 0, VALUES, quantity="Later", measurement=1)
        file["Measurement_000/elsewhere"] = h5py.ExternalLink("/etc/passwd", "/")
        file["Measurement_000/soft"] = h5py.SoftLink("/Measurement_001")
    scan = read_channels(path)
    assert [channel.name for channel in scan.channels] == ["Height", "Phase"]
    said = "\n".join(scan.notes)
    for part in ("Spectra", "Cut", "Odd", "Measurement_001"):
        assert part in said


def test_no_image(write: Callable[..., Path]) -> None:
    with pytest.raises(FileFormatError, match=r"no image .*got Odd"):
        read_channels(write({"quantity": "Odd", "names": ("a", "b")}))


def test_channels_are_counted_as_people_do(write: Callable[..., Path]) -> None:
    scan = read_channels(write(*({"quantity": f"Q{k}"} for k in range(12))))
    assert [channel.name for channel in scan.channels] == [f"Q{k}" for k in range(12)]


def test_claimed_sizes_are_checked(write: Callable[..., Path]) -> None:
    path = write(*WHOLE)
    with h5py.File(path, "a") as file:
        group = file["Measurement_000"].create_group("Huge")
        data = group.create_dataset(
            "Huge", (100_000, 100_000), dtype="f4", chunks=(100, 100)
        )  # nothing stored
        data.attrs.update({"quantity": "Huge", "units": "m"})
        data.dims[0].label, data.dims[1].label = "y", "x"
    with pytest.raises(FileFormatError, match=r"damaged.*Huge"):
        read_channels(path)


# --- which file it is -------------------------------------------------------------------------------


def test_only_files_of_pycroscopy_are_taken(
    tmp_path: Path, write: Callable[..., Path], afm_data: Path
) -> None:
    def is_one(path: Path) -> bool:
        return nsid.sniff(path, path.read_bytes()[:4096])

    assert is_one(write(*WHOLE))
    assert not is_one(afm_data / "jpk" / "AFMReader_sample_0.h5-jpk")
    # A history may name a measurement.
    netcdf.save(xr.Dataset({"A1": ("point", [1.0])}, attrs={"history": "Measurement_000"}), tmp_path / "a.nc")
    assert not is_one(tmp_path / "a.nc")
    xr.Dataset({"A1": ("point", [1.0])}, attrs={"history": "Measurement_000"}).to_netcdf(
        tmp_path / "b.nc", engine="h5netcdf"
    )
    assert not is_one(tmp_path / "b.nc")
    assert not is_one(afm_data / "ibw" / "AR_20211011.ibw")


def test_groups_of_the_newest_kind_of_hdf5(tmp_path: Path) -> None:
    path = tmp_path / "a.h5"
    with h5py.File(path, "w", libver="latest") as file:
        _add(file, 0, VALUES, quantity="Height")
    assert read_channels(path).format == "nsid"


# --- USID -------------------------------------------------------------------------------------------


def _usid(path: Path, *, x_fastest: bool = True, unit: str = "m", positions: int = 12) -> Path:
    """A map as pyUSID writes it: positions by one step, with two tables of where they are."""
    y, x = np.divmod(np.arange(12), 4) if x_fastest else np.divmod(np.arange(12), 3)[::-1]
    indices = np.stack([x, y], axis=1)[:positions]
    with h5py.File(path, "w") as file:
        group = file.create_group("Measurement_000/Channel_000")
        data = group.create_dataset("Raw_Data", data=VALUES[indices[:, 1], indices[:, 0]][:, np.newaxis])
        data.attrs.update({"quantity": "Height", "units": "nm"})
        for name, table in (("Indices", indices.astype("u4")), ("Values", indices * 0.5)):
            ancillary = group.create_dataset(f"Position_{name}", data=table)
            ancillary.attrs["labels"] = np.array(["X", "Y"], dtype="S1")
            ancillary.attrs["units"] = np.array([unit, unit], dtype="S4")
            data.attrs[f"Position_{name}"] = ancillary.ref
            steps = group.create_dataset(f"Spectroscopic_{name}", data=np.zeros((1, 1)))
            data.attrs[f"Spectroscopic_{name}"] = steps.ref
    return path


@pytest.mark.parametrize("x_fastest", [True, False])
def test_usid(tmp_path: Path, x_fastest: bool) -> None:
    scan = read_channels(_usid(tmp_path / "a.h5", x_fastest=x_fastest, unit="um"))
    np.testing.assert_allclose(scan.channels[0].values, VALUES.astype(float) * 1e-9, rtol=1e-15)
    np.testing.assert_allclose(scan.coords["x"], np.arange(4) * 0.5e-6, rtol=1e-12)
    np.testing.assert_allclose(scan.coords["y"], [1e-6, 0.5e-6, 0.0], rtol=1e-12)


def test_usid_with_positions_missing(tmp_path: Path) -> None:
    with pytest.raises(FileFormatError, match="full grid"):
        read_channels(_usid(tmp_path / "a.h5", positions=11))


# --- real files -------------------------------------------------------------------------------------


def test_real_file_by_hand(afm_data: Path) -> None:
    path = afm_data / "nsid_h5" / "DTMicroscope_PMN28Pt0000.h5"
    scan = read_channels(path)
    assert [(c.name, c.direction, c.unit, c.flattened) for c in scan.channels] == [
        ("Height", "retrace", "m", False),
        ("Amplitude", "retrace", "m", False),
        ("Deflection", "retrace", "m", False),
        ("Phase", "retrace", "rad", False),
    ]
    with h5py.File(path) as file:
        for k, channel in enumerate(scan.channels):
            stored = file[f"Measurement_000/Channel_{k}/Channel_{k}/Channel_{k}"][()].astype(float)
            factor = np.pi / 180.0 if channel.unit == "rad" else 1.0
            for row, column in [(0, 0), (0, 255), (255, 0), (255, 255), (100, 37)]:
                # stored[x, y] with y from the bottom
                assert channel.values[row, column] == stored[column, 255 - row] * factor
    height = scan.channels[0].values
    assert height[0, 0] == pytest.approx(8.332652328e-07, rel=1e-9, abs=0)
    assert height[255, 0] == pytest.approx(1.728719639e-07, rel=1e-9, abs=0)
    # The tip runs along x: what it feels changes less from pixel to pixel than from line to line.
    for channel in scan.channels[:2]:
        along, across = (np.abs(np.diff(channel.values, axis=axis)).mean() for axis in (1, 0))
        assert along < 0.7 * across
    assert scan.coords["x"][-1] == pytest.approx(4e-6, rel=1e-12, abs=0)
    assert (scan.vendor, scan.metadata["ImagingMode"]) == ("asylum", "PFM Mode")
    assert scan.facts["drive_frequency"].value == 357810.0
    assert scan.facts["stiffness"].factory_default
    assert [(r.source, r.quality_factor) for r in scan.resonances] == [("thermal", 20.0), ("tune", 218.47)]


@pytest.mark.parametrize("name", ["IgorIBWReader_ImageStack_BTFO_DSO", "tono_whiskers"])
def test_same_data_as_the_wave(afm_data: Path, tmp_path: Path, name: str) -> None:
    """As pycroscopy turns a wave into NSID: layers as they lie in it, and the last of two values of a key."""
    from igor2 import binarywave

    source = afm_data / "ibw" / f"{name}.ibw"
    wave, raw = read_channels(source), binarywave.load(str(source))["wave"]
    pairs = [line.split(":") for line in raw["note"].decode("latin-1").split("\r")]
    note = {pair[0].strip(): pair[1].strip() for pair in pairs if len(pair) == 2}
    path = tmp_path / "a.h5"
    with h5py.File(path, "w") as file:
        for k, channel in enumerate(wave.channels):
            layer = raw["wData"][:, :, k]
            positions = {
                "x": np.linspace(0, float(note["FastScanSize"]), layer.shape[0]),
                "y": np.linspace(0, float(note["SlowScanSize"]), layer.shape[1]),
            }
            unit = "deg" if channel.name.startswith("Phase") else "m"
            label = channel.name + str(channel.direction).capitalize()
            _add(file, k, layer, quantity=label, units=unit, names=("x", "y"), positions=positions, note=note)
    scan = read_channels(path)
    for ours, theirs in zip(wave.channels, scan.channels, strict=True):
        assert (theirs.name, theirs.direction, theirs.unit) == (ours.name, ours.direction, ours.unit)
        np.testing.assert_array_equal(theirs.values, ours.values)
    for axis in ("x", "y"):
        np.testing.assert_allclose(scan.coords[axis], wave.coords[axis], rtol=1e-6, atol=1e-12)
    assert scan.vendor == "asylum"


# --- damage -----------------------------------------------------------------------------------------


def _survives(path: Path) -> bool:
    message = ""
    try:
        recording = read_channels(path)
    except OvertoneError as error:
        message = str(error)
    if message:
        assert len(message) < 1000
        return False
    assert isinstance(recording, Recording)
    assert len({channel.values.shape for channel in recording.channels}) == 1
    return True


@pytest.mark.parametrize("kind", ["nsid", "usid"])
def test_damaged_files(tmp_path: Path, write: Callable[..., Path], kind: str) -> None:
    whole = (
        write(*({**channel, "note": NOTE} for channel in WHOLE))
        if kind == "nsid"
        else _usid(tmp_path / "u.h5")
    )
    content = whole.read_bytes()
    path = tmp_path / "damaged.h5"
    for length in np.linspace(8, len(content) - 1, 20, dtype=int):
        path.write_bytes(content[:length])
        assert not _survives(path)
    random = np.random.default_rng(21)
    for _ in range(6):
        changed = bytearray(content)
        for at in random.integers(8, len(content), size=random.integers(1, 5)):
            changed[at] = random.integers(0, 256)
        path.write_bytes(bytes(changed))
        _survives(path)


def test_damage_that_hdf5_does_not_survive(tmp_path: Path, write: Callable[..., Path]) -> None:
    """Wrong numbers in the heap of texts: the library crashes or never comes back, in another process."""
    content = write(*({**channel, "note": NOTE} for channel in WHOLE)).read_bytes()
    path = tmp_path / "damaged.h5"
    heap = content.index(b"GCOL")
    lengths = [at for at in range(heap + 16, heap + 600, 8) if content[at : at + 8] == b"\x07" + b"\0" * 7]
    assert len(lengths) > 2  # the text "SPATIAL"
    for at, value in [(lengths[0], 161), (lengths[1] - 8, 246), (lengths[1] - 8, 30), (lengths[2], 255)]:
        path.write_bytes(content[:at] + bytes([value]) + content[at + 1 :])
        _survives(path)


def test_damaged_real_file(afm_data: Path, tmp_path: Path) -> None:
    content = (afm_data / "nsid_h5" / "DTMicroscope_PMN28Pt0000.h5").read_bytes()
    path = tmp_path / "damaged.h5"
    for length in np.linspace(8, len(content) - 1, 20, dtype=int):
        path.write_bytes(content[:length])
        assert not _survives(path)
    random = np.random.default_rng(22)
    for _ in range(4):
        changed = bytearray(content)
        for at in random.integers(8, 20_000, size=3):
            changed[at] = random.integers(0, 256)
        path.write_bytes(bytes(changed))
        _survives(path)


def test_another_process_is_asked_first(
    tmp_path: Path, write: Callable[..., Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    path = write(*WHOLE)
    hdf5_guard.check(path, "overtone.io.nsid:parts_of")
    hdf5_guard.check(path, "os:listdir")  # an error is an answer
    (tmp_path / "harmful.py").write_text(
        "import os\ndef crash(path): os.abort()\ndef never(path):\n    while True: pass\n"
    )
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    with pytest.raises(FileFormatError, match="crash of the library"):
        hdf5_guard.check(path, "harmful:crash")
    monkeypatch.setattr(hdf5_guard, "_SECONDS", 0.2)
    with pytest.raises(FileFormatError, match="no answer"):
        hdf5_guard.check(path, "harmful:never")
    monkeypatch.undo()
    path.write_bytes(path.read_bytes()[:-1])
    with pytest.raises(FileFormatError, match="bytes as its header says"):
        hdf5_guard.check(path, "overtone.io.nsid:parts_of")
