"""Packed Igor experiments: against igor2, byte by byte, and damaged."""

import struct
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest

from overtone.errors import FileFormatError, OvertoneError
from overtone.io import igor, igor_experiment
from overtone.io.recording import Recording
from overtone.io.registry import read_channels

VALUES = np.arange(35.0).reshape(7, 5)  # columns, rows from the bottom
LABELS = ((), (), ("HeightRetrace", "AmplitudeRetrace"))
IMAGE = np.stack([VALUES, VALUES + 100.0], axis=-1)


def _named(wave: bytes, name: str, order: str = "<") -> bytes:
    assert struct.unpack_from(order + "h", wave)[0] == 5
    return wave[:92] + name.encode().ljust(32, b"\0") + wave[124:]


def _record(kind: int, body: bytes, order: str = "<") -> bytes:
    return struct.pack(order + "Hhi", kind, 0, len(body)) + body


def _experiment(*parts: tuple[int, bytes], order: str = "<") -> bytes:
    whole = [(11, b"\x10\0\x10\0windows".ljust(52, b"\0")), *parts, (5, b"#pragma rtGlobals=1\r")]
    return b"".join(_record(kind, body, order) for kind, body in whole)


def _folder(name: str, *parts: tuple[int, bytes]) -> Sequence[tuple[int, bytes]]:
    return [(9, name.encode().ljust(32, b"\0")), *parts, (10, b"\0")]


@pytest.fixture
def write(tmp_path: Path) -> Callable[..., Path]:
    def written(*parts: tuple[int, bytes], order: str = "<") -> Path:
        path = tmp_path / "a.pxp"
        path.write_bytes(_experiment(*parts, order=order))
        return path

    return written


@pytest.mark.parametrize("order", ["<", ">"])
def test_the_one_image(write: Callable[..., Path], igor_wave: Callable[..., bytes], order: str) -> None:
    image = _named(
        igor_wave(IMAGE, labels=LABELS, note="SpringConstant: 2\r", order=order), "Scan0001", order
    )
    curve = _named(igor_wave(np.arange(9.0), order=order), "loop", order)
    colours = _named(igor_wave(np.zeros((256, 3)), order=order), "colours", order)
    text = _named(igor_wave(np.array([b"a", b"b"]), kind=0, order=order), "names", order)
    path = write((3, curve), (3, colours), (3, text), (3, image), order=order)
    scan = read_channels(path)
    assert (scan.format, scan.vendor, scan.dims, scan.path) == ("igor_experiment", "asylum", ("y", "x"), path)
    assert [(c.name, c.direction, c.unit) for c in scan.channels] == [
        ("Height", "retrace", "m"),
        ("Amplitude", "retrace", "m"),
    ]
    np.testing.assert_array_equal(scan.channels[0].values, VALUES.T[::-1])
    assert scan.channels[0].values[0, 0] == VALUES[0, -1]
    assert scan.facts["stiffness"].value == 2.0
    assert "wave Scan0001 of an experiment of 4" in scan.notes
    alone = path.with_name("alone.ibw")
    alone.write_bytes(image)
    assert read_channels(alone).facts == scan.facts
    np.testing.assert_array_equal(read_channels(alone).coords["y"], scan.coords["y"])


def test_several_images_are_listed_and_one_can_be_named(
    write: Callable[..., Path], igor_wave: Callable[..., bytes]
) -> None:
    first, second = (_named(igor_wave(IMAGE + k, labels=LABELS), f"Scan{k}") for k in (0, 1))
    path = write((3, first), *_folder("older", (3, second), *_folder("oldest", (3, first))))
    with pytest.raises(FileFormatError) as refused:
        read_channels(path)
    for part in ("3 images", "Scan0 (7 x 5 x 2)", "older:Scan1", "older:oldest:Scan0", 'Try: "a.pxp::Scan0"'):
        assert part in str(refused.value)
    for name, offset in [("Scan1", 1.0), ("older:Scan1", 1.0), ("root:older:scan1", 1.0), ("Scan0", 0.0)]:
        scan = read_channels(f"{path}::{name}")
        assert scan.channels[0].values[-1, 0] == offset
        assert scan.path.name == f"a.pxp::{name}"
    with pytest.raises(FileFormatError, match=r"no wave 'Scan7'.*Scan0"):
        read_channels(f"{path}::Scan7")


def test_names_that_are_not_enough(write: Callable[..., Path], igor_wave: Callable[..., bytes]) -> None:
    image = _named(igor_wave(IMAGE, labels=LABELS), "Scan")
    path = write(*_folder("a", (3, image)), *_folder("b", (3, image)))
    with pytest.raises(FileFormatError, match=r"2 waves 'Scan'.*with its folders"):
        read_channels(f"{path}::Scan")
    assert read_channels(f"{path}::b:Scan").channels[0].values.shape == (5, 7)


def test_one_curve_where_there_is_no_image(
    write: Callable[..., Path], igor_wave: Callable[..., bytes]
) -> None:
    path = write((3, _named(igor_wave(np.arange(9.0)), "loop")))
    assert read_channels(path).dims == ("point",)


def test_superseded_records_do_not_count(write: Callable[..., Path], igor_wave: Callable[..., bytes]) -> None:
    old, new = (_named(igor_wave(IMAGE + k, labels=LABELS), "Scan") for k in (0, 1))
    scan = read_channels(write((3 | 0x8000, old), (3, new)))
    assert scan.channels[0].values[-1, 0] == 1.0


def test_nothing_to_read(write: Callable[..., Path], igor_wave: Callable[..., bytes]) -> None:
    with pytest.raises(FileFormatError, match="no image"):
        read_channels(write((2, b"history")))
    text = _named(igor_wave(np.array([b"a", b"b"]), kind=0), "names")
    with pytest.raises(FileFormatError, match="no image"):
        read_channels(write((3, text)))
    with pytest.raises(FileFormatError, match="real numbers"):
        read_channels(f"{write((3, text))}::names")


def test_parts_of_other_files_do_not_exist(tmp_path: Path, igor_wave: Callable[..., bytes]) -> None:
    path = tmp_path / "a.ibw"
    path.write_bytes(igor_wave(IMAGE, labels=LABELS))
    with pytest.raises(FileFormatError, match="no parts to choose from"):
        read_channels(f"{path}::Scan")
    with pytest.raises(FileFormatError, match="there is no file"):
        read_channels(tmp_path / "missing.pxp::Scan")


def test_a_lone_wave_is_no_experiment(afm_data: Path) -> None:
    for path in sorted(afm_data.glob("ibw*/*.ibw")):
        head = path.read_bytes()[:4096]
        assert igor.sniff(path, head)
        assert not igor_experiment.sniff(path, head), path.name


def test_a_wave_of_zeros_is_no_experiment(tmp_path: Path, igor_wave: Callable[..., bytes]) -> None:
    """Eight zeros are a record without content."""
    path = tmp_path / "a.ibw"
    path.write_bytes(igor_wave(np.zeros((4, 2))))
    assert read_channels(path).format == "igor"


def test_an_experiment_that_begins_like_a_wave(tmp_path: Path, igor_wave: Callable[..., bytes]) -> None:
    image = _named(igor_wave(IMAGE, labels=LABELS), "Scan")
    path = tmp_path / "a.pxp"
    path.write_bytes(_record(1, b"\0" * 8) + _record(3, image))
    assert igor.sniff(path, path.read_bytes()[:4096])
    assert read_channels(path).format == "igor_experiment"


def test_real_experiment_against_igor2(afm_data: Path) -> None:
    packed = pytest.importorskip("igor2.packed")
    path = afm_data / "igor_experiment" / "polar-graphs-demo.pxp"
    with pytest.raises(FileFormatError, match=r"no image.*radiusData \(128\).*W_plrY6 \(64\).*::radiusData"):
        read_channels(path)
    _, tree = packed.load(str(path), initial_byte_order="<")
    waves = {name: record for name, record in tree["root"].items() if hasattr(record, "wave")}
    assert len(waves) == 8
    for name, record in waves.items():
        scan = read_channels(f"{path}::{name.decode()}")
        np.testing.assert_array_equal(scan.channels[0].values, record.wave["wave"]["wData"])
    radius = read_channels(f"{path}::radiusData").channels[0].values
    assert radius[:2] == pytest.approx([0.3, 0.5448544], rel=1e-6, abs=0)


# --- damage -----------------------------------------------------------------------------------------


def _survives(path: Path, wave: str = "") -> bool:
    message = ""
    try:
        recording = read_channels(f"{path}{wave}")
    except OvertoneError as error:
        message = str(error)
    if message:
        assert len(message) < 1000
        assert "beyond reading" not in message
        return False
    assert isinstance(recording, Recording)
    return True


@pytest.mark.parametrize(
    ("size", "message"), [(2**31 - 1, "2147483647 bytes of record"), (-5, "-5 bytes of record")]
)
def test_lengths_are_checked(
    tmp_path: Path, igor_wave: Callable[..., bytes], size: int, message: str
) -> None:
    content = _experiment((3, igor_wave(IMAGE)))
    path = tmp_path / "a.pxp"
    path.write_bytes(content[:64] + struct.pack("<i", size) + content[68:])
    with pytest.raises(FileFormatError, match=message):
        read_channels(path)


def test_folders_within_folders_end(write: Callable[..., Path]) -> None:
    with pytest.raises(FileFormatError, match="within each other"):
        read_channels(write(*[(9, b"a\0")] * 60))


def test_damaged_files(tmp_path: Path, igor_wave: Callable[..., bytes]) -> None:
    image = _named(igor_wave(IMAGE, labels=LABELS, note="SpringConstant: 2\r"), "Scan")
    content = _experiment((3, image), *_folder("a", (3, _named(igor_wave(np.arange(9.0)), "loop"))))
    path = tmp_path / "a.pxp"
    for length in np.linspace(2, len(content) - 1, 20, dtype=int):
        path.write_bytes(content[:length])
        assert not _survives(path)
    random = np.random.default_rng(31)
    for _ in range(400):
        changed = bytearray(content)
        for at in random.integers(2, len(content), size=random.integers(1, 4)):
            changed[at] = random.integers(0, 256)
        path.write_bytes(bytes(changed))
        _survives(path)


def test_damaged_real_file(afm_data: Path, tmp_path: Path) -> None:
    content = (afm_data / "igor_experiment" / "polar-graphs-demo.pxp").read_bytes()
    path = tmp_path / "a.pxp"
    for length in np.linspace(9, len(content) - 1, 20, dtype=int):
        path.write_bytes(content[:length])
        assert not _survives(path)
    random = np.random.default_rng(32)
    for _ in range(60):
        changed = bytearray(content)
        for at in random.integers(8, len(content), size=30):
            changed[at] = random.integers(0, 256)
        path.write_bytes(bytes(changed))
        _survives(path, "::radiusData")
