"""Gwyddion files: against gwyfile, against Gwyddion's own converter, and damaged."""

import struct
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from overtone.errors import FileFormatError, OvertoneError
from overtone.io.gwy_container import CONTAINER, MAGIC, GwyObject, parse, serialized
from overtone.io.recording import Recording
from overtone.io.registry import read_channels

VALUES = np.arange(12.0).reshape(3, 4)  # neither square nor symmetric; the top row begins with 0
FIVE = [(0, 0), (0, 255), (255, 0), (255, 255), (100, 37)]


@pytest.fixture
def write(tmp_path: Path) -> Callable[..., Path]:
    """Write fields with gwyfile, an independent library."""
    library = pytest.importorskip("gwyfile.objects")

    def written(fields: Mapping[int, Mapping[str, Any]], **others: Any) -> Path:
        container = library.GwyContainer()
        for number, given in fields.items():
            values = np.asarray(given.get("values", VALUES), dtype=float)
            field = library.GwyDataField(
                values,
                xreal=given.get("xreal", 4e-6),
                yreal=given.get("yreal", 1.5e-6),
                si_unit_xy=given.get("xy", "m"),
                si_unit_z=given.get("z", "m"),
            )
            container[f"/{number}/data"] = field
            if "title" in given:
                container[f"/{number}/data/title"] = given["title"]
            if "mask" in given:
                container[f"/{number}/mask"] = library.GwyDataField(np.asarray(given["mask"], dtype=float))
            if "meta" in given:
                typecodes = dict.fromkeys(given["meta"], "s")
                container[f"/{number}/meta"] = library.GwyContainer(dict(given["meta"]), typecodes)
            if "log" in given:
                strings = library.GwyObject("GwyStringList", {"strings": given["log"]}, {"strings": "S"})
                container[f"/{number}/data/log"] = strings
        for key, value in others.items():
            container[key] = value
        path = tmp_path / "a.gwy"
        container.tofile(str(path))
        return path

    return written


@pytest.fixture(autouse=True)
def _lists_of_texts(monkeypatch: pytest.MonkeyPatch) -> None:
    """Teach gwyfile to write lists of texts, which it only reads."""
    library = pytest.importorskip("gwyfile.objects")
    known = library.serialize_component

    def serialize(name: str, value: Any, typecode: str | None = None) -> bytes:
        if typecode == "S":
            texts = b"".join(text.encode() + b"\0" for text in value)
            return name.encode() + b"\0S" + struct.pack("<I", len(value)) + texts
        return known(name, value, typecode)

    monkeypatch.setattr(library, "serialize_component", serialize)


# --- synthetic files --------------------------------------------------------------------------------


def test_fields_become_channels(write: Callable[..., Path]) -> None:
    scan = read_channels(
        write(
            {
                0: {"title": "HeightRetrace"},
                2: {"title": "Phase", "z": "deg"},
                10: {"title": "Lock-in", "z": "V"},
            }
        )
    )
    assert (scan.format, scan.vendor, scan.dims) == ("gwy", "gwyddion", ("y", "x"))
    assert [(c.name, c.direction, c.unit, c.flattened) for c in scan.channels] == [
        ("Height", "retrace", "m", None),
        ("Phase", None, "rad", None),
        ("Lock-in", None, "V", None),
    ]
    height, phase, _ = (channel.values for channel in scan.channels)
    assert [height[0, 0], height[0, 3], height[2, 0], height[2, 3]] == [0.0, 3.0, 8.0, 11.0]
    np.testing.assert_allclose(phase, np.radians(VALUES), rtol=1e-15)
    np.testing.assert_allclose(scan.coords["x"], [0.5e-6, 1.5e-6, 2.5e-6, 3.5e-6], rtol=1e-12)
    np.testing.assert_allclose(scan.coords["y"], [1.25e-6, 0.75e-6, 0.25e-6], rtol=1e-12)
    assert scan.notes == ()


def test_prefixes_mean_nothing_to_gwyddion(write: Callable[..., Path]) -> None:
    scan = read_channels(write({0: {"title": "a", "z": "nm", "xy": "µm"}, 1: {"title": "b", "z": "mV"}}))
    for channel, unit in zip(scan.channels, ("m", "V"), strict=True):
        assert channel.unit == unit
        np.testing.assert_array_equal(channel.values, VALUES)
    assert scan.coords["x"][-1] == pytest.approx(3.5e-6, rel=1e-12, abs=0)
    assert sum("ignores the prefix" in note for note in scan.notes) == 2


@pytest.mark.parametrize("unit", ["", "T", "arb"])
def test_units_that_are_none(write: Callable[..., Path], unit: str) -> None:
    scan = read_channels(write({0: {"title": "a", "z": unit}}))
    assert scan.channels[0].unit is None
    assert any("unit" in note for note in scan.notes)
    np.testing.assert_array_equal(scan.channels[0].values, VALUES)


@pytest.mark.parametrize(
    "given", [{"xy": ""}, {"xy": "s"}, {"xreal": 0.0}, {"yreal": -1e-6}, {"xreal": np.inf}]
)
def test_no_usable_size(write: Callable[..., Path], given: dict[str, Any]) -> None:
    scan = read_channels(write({0: {"title": "a", **given}}))
    assert dict(scan.coords) == {}
    assert any("no coordinates" in note for note in scan.notes)


def test_what_is_left_out_is_told(write: Callable[..., Path]) -> None:
    library = pytest.importorskip("gwyfile.objects")
    mask = np.zeros((3, 4))
    mask[1, 1] = 1.0
    fields = {
        0: {"title": "a", "mask": mask},
        1: {"title": "b"},
        2: {"title": "cut", "values": VALUES[:2]},
        3: {"title": "smaller", "xreal": 1e-6},
        4: {},
    }
    scan = read_channels(write(fields, **{"/brick/0": library.GwyObject("GwyBrick")}))
    assert [channel.name for channel in scan.channels] == ["a", "b", "field 4"]
    np.testing.assert_array_equal(scan.channels[0].values, VALUES)  # the mask takes nothing away
    said = "\n".join(scan.notes)
    for part in ("cut, smaller", "masks were not used: a", "no title", "brick (1 entries)"):
        assert part in said


@pytest.mark.parametrize(
    ("step", "levelled"),
    [
        ("proc::level(mask_mode=ignore)@2024", True),
        ("proc::align_rows()@2024", True),
        ("proc::line_correct_median()@", True),
        ("proc::fix_zero()@", True),
        ("tool::GwyToolLevel3()@", True),
        ("proc::flatten_base()@", True),
        ('file::igorfile(filename="level.ibw")@2024', None),
        ("proc::fft()@", None),
    ],
)
def test_levelling_takes_the_absolute_value_away(
    write: Callable[..., Path], step: str, levelled: bool | None
) -> None:
    scan = read_channels(write({0: {"title": "Amplitude", "log": ["file::spmfile()@", step]}}))
    assert scan.channels[0].flattened is levelled


def test_asylum_note(write: Callable[..., Path]) -> None:
    meta = {
        "SpringConstant": "2.5",
        "AmpInvOLS": "4e-08",
        "FreeAirAmplitude": "0.5",
        "FreeAirPhase": "80",
        "ImagingMode": "AC Mode",
        "ThermalFrequency": "70000",
        "ThermalQ": "150",
        "FlattenOrder 1": "0",
        "FlattenOrder 0": "-1",
    }
    fields = {
        n: {"title": title, "meta": meta} for n, title in enumerate(("AmplitudeRetrace", "PhaseRetrace"))
    }
    scan = read_channels(write(fields))
    assert scan.vendor == "asylum"
    assert (scan.facts["stiffness"].value, scan.facts["free_amplitude"].value) == (2.5, 2e-8)
    assert scan.facts["free_phase"].value == pytest.approx(np.radians(80.0), rel=1e-15, abs=0)
    assert [(r.source, r.frequency, r.quality_factor) for r in scan.resonances] == [
        ("thermal", 70000.0, 150.0)
    ]
    assert [channel.flattened for channel in scan.channels] == [False, True]


def test_channels_of_several_scans_share_no_settings(write: Callable[..., Path]) -> None:
    metas = [{"SpringConstant": "2.5", "ThermalQ": "100"}, {"SpringConstant": "30", "ThermalQ": "100"}]
    scan = read_channels(write({n: {"title": f"t{n}", "meta": meta} for n, meta in enumerate(metas)}))
    assert "stiffness" not in scan.facts
    assert dict(scan.metadata) == {"ThermalQ": "100"}
    assert any("disagree" in note and "SpringConstant" in note for note in scan.notes)


# --- real files -------------------------------------------------------------------------------------


def test_real_file_against_gwyfile(afm_data: Path) -> None:
    library = pytest.importorskip("gwyfile")
    path = afm_data / "gwyddion" / "PTO_110_Virgin0001.gwy"
    scan, raw = read_channels(path), library.load(str(path))
    assert [(c.name, c.direction, c.unit) for c in scan.channels] == [
        ("Height", "retrace", "m"),
        ("Amplitude", "retrace", "m"),
        ("Deflection", "retrace", "m"),
        ("Phase", "retrace", "rad"),
    ]
    for number, channel in enumerate(scan.channels):
        factor = np.pi / 180.0 if channel.unit == "rad" else 1.0
        np.testing.assert_array_equal(channel.values, raw[f"/{number}/data"].data * factor)
    amplitude = [
        8.497953729591501e-11,
        1.0499000280272952e-10,
        1.4111280199902154e-10,
        1.0966777486132173e-10,
    ]
    assert [scan.channels[1].values[at] for at in FIVE[:4]] == amplitude
    assert scan.channels[2].values.mean() == pytest.approx(1.01194467e-7, rel=1e-8, abs=0)
    # Igor's step is size / (N - 1): 10 um over 255 steps, of which Gwyddion draws 256 pixels.
    assert np.diff(scan.coords["x"]) == pytest.approx(np.full(255, 10e-6 / 255), rel=1e-9, abs=0)
    assert scan.metadata["ImagingMode"] == "PFM Mode"
    assert scan.facts["stiffness"].factory_default
    assert (scan.facts["drive_frequency"].value, scan.vendor) == (434321.9753354788, "asylum")
    assert [r.quality_factor for r in scan.resonances] == [20.0, 127.63]


def test_real_file_of_gwyddion_1(afm_data: Path) -> None:
    """For which gwyfile stops; the same data exist as a Simple Field, and its unit of nm means nothing."""
    gsffile = pytest.importorskip("gsffile")
    scan = read_channels(afm_data / "gwyddion" / "GwiddionReader_chip.gwy")
    expected, header = gsffile.read_gsf(afm_data / "gwyddion" / "GwiddionReader_chip.gsf")
    (channel,) = scan.channels
    assert (channel.unit, channel.values.shape) == ("m", (300, 300))
    np.testing.assert_array_equal(channel.values.astype(np.float32), expected)
    corners = [channel.values[at] for at in ((0, 0), (0, 299), (299, 0), (299, 299))]
    assert corners == [1.8345124e-05, 1.4177744e-05, 1.6641504e-05, 1.6730496e-05]
    assert scan.coords["x"][-1] == pytest.approx(float(header["XReal"]) * 299.5 / 300, rel=1e-12, abs=0)


def _converted(source: Path, target: Path) -> Path:
    """Let Gwyddion itself import a file and save it."""
    pytest.importorskip("gwyddionpy")
    from gwyddionpy import GwyddionPyError, run_converter

    try:
        run_converter(source, target)
    except GwyddionPyError as error:
        pytest.skip(f"no converter: {error}")
    return target


@pytest.mark.parametrize("name", ["AR_20211011", "tono_whiskers"])
def test_gwyddion_says_the_same_of_a_wave_as_the_wave(afm_data: Path, tmp_path: Path, name: str) -> None:
    wave = read_channels(afm_data / "ibw" / f"{name}.ibw")
    scan = read_channels(_converted(afm_data / "ibw" / f"{name}.ibw", tmp_path / "a.gwy"))
    assert scan.vendor == "asylum"
    assert [(c.name, c.direction, c.unit) for c in scan.channels] == [
        (c.name, c.direction, c.unit) for c in wave.channels
    ]
    for ours, theirs in zip(wave.channels, scan.channels, strict=True):
        assert theirs.values.shape == ours.values.shape  # whiskers are 512 x 256
        np.testing.assert_allclose(theirs.values, ours.values, rtol=1e-6, atol=0, err_msg=ours.name)
    # Gwyddion keeps no set-point and no order of flattening.
    expected = {name: fact for name, fact in wave.facts.items() if name != "setpoint_amplitude"}
    assert dict(scan.facts) == expected
    assert len(expected) >= 6
    assert scan.resonances == wave.resonances
    for axis in ("x", "y"):
        np.testing.assert_allclose(np.diff(scan.coords[axis]), np.diff(wave.coords[axis]), rtol=1e-6)


# --- damage -----------------------------------------------------------------------------------------


def _root(**changed: Any) -> bytes:
    unit = GwyObject("GwySIUnit", {"unitstr": "m"})
    items = {"xres": 4, "yres": 3, "xreal": 1e-6, "yreal": 1e-6, "si_unit_xy": unit, "si_unit_z": unit}
    field = GwyObject("GwyDataField", {**items, "data": VALUES, **changed})
    return serialized(GwyObject(CONTAINER, {"/0/data": field, "/0/data/title": "Height"}))


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (_root(xres=5), "15 values for 5 x 3 pixels"),
        (_root(xres=0), "numbers of pixels"),
        (_root(yres=-3), "numbers of pixels"),
        (_root(xres=2**31 - 1, yres=2**31 - 1), "12"),
        (_root(data="text"), "array of doubles"),
        (_root()[:-40], "bytes of"),
        (serialized(GwyObject(CONTAINER, {"/filename": "a"})), "no image"),
        (MAGIC + b"GwyContainer\0\xff\xff\xff\xff", "4294967295 bytes"),
        (MAGIC + b"GwyContainer\0\x08\0\0\0/0/data\0", "a type behind"),
        (MAGIC + b"GwyContainer\0\x0a\0\0\0/0/data\0zz", "known type"),
    ],
)
def test_sizes_that_do_not_fit(tmp_path: Path, content: bytes, message: str) -> None:
    path = tmp_path / "a.gwy"
    path.write_bytes(content)
    with pytest.raises(FileFormatError, match=message):
        read_channels(path)


def _component(name: bytes, code: bytes, value: bytes) -> bytes:
    return name + b"\0" + code + value


@pytest.mark.parametrize("code", [b"D", b"S", b"O", b"C", b"Q"])
def test_counts_are_checked_before_memory_is_taken(tmp_path: Path, code: bytes) -> None:
    body = _component(b"a", code, struct.pack("<I", 2**32 - 1) + b"\0" * 8)
    content = MAGIC + CONTAINER.encode() + b"\0" + struct.pack("<I", len(body)) + body
    with pytest.raises(FileFormatError, match="not a whole Gwyddion file"):
        parse(tmp_path / "a.gwy", content)


def test_objects_within_objects_end(tmp_path: Path) -> None:
    body = b""
    for _ in range(40):
        inner = b"A\0" + struct.pack("<I", len(body)) + body
        body = _component(b"a", b"o", inner)
    content = MAGIC + CONTAINER.encode() + b"\0" + struct.pack("<I", len(body)) + body
    with pytest.raises(FileFormatError, match="within each other"):
        parse(tmp_path / "a.gwy", content)


def test_millions_of_components_are_refused(tmp_path: Path) -> None:
    body = b"a\0b\0" * 300_000
    content = MAGIC + CONTAINER.encode() + b"\0" + struct.pack("<I", len(body)) + body
    with pytest.raises(FileFormatError, match="components"):
        parse(tmp_path / "a.gwy", content)


def _survives(path: Path) -> bool:
    message = ""
    try:
        recording = read_channels(path)
    except OvertoneError as error:
        message = str(error)
    if message:
        assert len(message) < 1000
        assert "beyond reading" not in message  # every damage has a message of its own
        return False
    assert isinstance(recording, Recording)
    assert len({channel.values.shape for channel in recording.channels}) == 1
    return True


def test_damaged_files(tmp_path: Path) -> None:
    content = _root()
    path = tmp_path / "a.gwy"
    for length in np.linspace(4, len(content) - 1, 20, dtype=int):
        path.write_bytes(content[:length])
        assert not _survives(path)
    random = np.random.default_rng(11)
    for _ in range(300):
        changed = bytearray(content)
        for at in random.integers(4, len(content), size=random.integers(1, 4)):
            changed[at] = random.integers(0, 256)
        path.write_bytes(bytes(changed))
        _survives(path)


@pytest.mark.parametrize("name", ["PTO_110_Virgin0001", "GwiddionReader_chip"])
def test_damaged_real_files(afm_data: Path, tmp_path: Path, name: str) -> None:
    content = (afm_data / "gwyddion" / f"{name}.gwy").read_bytes()
    path = tmp_path / "a.gwy"
    for length in np.linspace(20, len(content) - 1, 20, dtype=int):
        path.write_bytes(content[:length])
        assert not _survives(path)
    random = np.random.default_rng(12)
    for _ in range(30):
        changed = bytearray(content)
        for at in random.integers(4, 400, size=2):
            changed[at] = random.integers(0, 256)
        path.write_bytes(bytes(changed))
        _survives(path)
