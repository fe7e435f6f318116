import struct
import time

import numpy as np
import pytest

from overtone.errors import ChannelError, FileFormatError
from overtone.io.registry import read_channels
from overtone.io.selection import Request, choose
from overtone.io.vendors import vendor_of

tifffile = pytest.importorskip("tifffile")

VALUES = np.arange(12.0).reshape(3, 4) - 5.0
SIZE = 580
# Park's own order of the entries, with how much room each takes.
ENTRIES = (
    "i:dataCategory 64s:channelName 16s:headMode d:lowPassStrength i:isAutoFlatten i:isAcTrack i:width i:height "
    "d:scanRotation i:isSineScan d:overScanRatio i:isFastScanLeftToRight i:isSlowScanBottomToTop i:isXYSwapped "
    "d:scanSizeWidth d:scanSizeHeight d:scanOffsetX d:scanOffsetY d:scanRate d:setpoint 16s:setpointUnit d:tipBias "
    "d:sampleBias d:dataGain d:ZScale d:ZOffset 16s:unit i:dataMin i:dataMax i:dataAverage i:compression "
    "i:isLogScale i:isSquared d:zServoGain d:zScannerRange 16s:xyVoltageMode 16s:zVoltageMode 16s:xyServoMode "
    "i:dataType i:numOfPddRegionX i:numOfPddRegionY d:ncmAmplitude d:ncmFrequency d:headRotation 32s:cantileverName "
    "d:ncmDrivePercent d:intensityFactor d:headTilting d:logAmpOffset d:tipSampleDistance d:zServoNcGain "
    "d:zServoPGain d:zServoIGain i:isTapping"
)
USUAL = {
    "channelName": "NCM Amplitude",
    "headMode": "NCM",
    "isFastScanLeftToRight": 1,
    "scanSizeWidth": 4.0,
    "scanSizeHeight": 1.5,
    "scanOffsetX": 3.75,
    "scanRate": 1.0,
    "dataGain": -2.0,
    "ZScale": 1.0,
    "unit": "nm",
    "dataType": 2,
    "ncmAmplitude": 15.0,
    "ncmFrequency": 280e3,
    "setpoint": 10.0,
    "setpointUnit": "nm",
    "cantileverName": "NCHR",
}


def header(**changes):
    known = {entry.split(":")[1] for entry in ENTRIES.split()}
    values = USUAL | changes
    assert set(values) <= known
    parts = []
    for kind, name in (entry.split(":") for entry in ENTRIES.split()):
        value = values.get(name, "" if kind.endswith("s") else 0)
        parts.append(struct.pack("<" + kind, value.encode("utf-16-le") if kind.endswith("s") else value))
    return b"".join(parts).ljust(SIZE, b"\0")


def write(
    path, values=VALUES, *, magic=235082497, when="2021:09:16 13:17:54", data=None, head=None, **changes
):
    kind = {0: "<i2", 1: "<i4", 2: "<f4"}.get(changes.get("dataType", 2), "<f4")
    shape = {"width": values.shape[1], "height": values.shape[0]}
    head = header(**{**shape, **changes}) if head is None else head
    data = values.astype(kind).tobytes() if data is None else data
    tags = [(50432, 4, 1, magic, False), (50433, 4, 1, 16777218, False)]
    tags += [(50434, 1, len(data), data, False), (50435, 7, len(head), head, False)]
    tifffile.imwrite(
        path,
        np.zeros((4, 4), np.uint8),
        photometric="palette",
        colormap=np.zeros((3, 256), np.uint16),
        extratags=tags,
        metadata=None,
        software=False,
        datetime=when,
        byteorder="<",
    )
    return path


@pytest.fixture
def image_of(tmp_path):
    def read(values=VALUES, **arguments):
        return read_channels(write(tmp_path / "image.tiff", values, **arguments))

    return read


# --- one file -------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", [0, 1, 2])
def test_one_channel(image_of, kind):
    scan = image_of(dataType=kind)
    assert (scan.format, scan.vendor, scan.dims) == ("park", "park", ("y", "x"))
    (channel,) = scan.channels
    assert (channel.name, channel.unit, channel.direction, channel.flattened) == (
        "NCM Amplitude",
        "m",
        "trace",
        None,
    )
    for row in range(3):
        for column in range(4):  # stored from the bottom
            expected = VALUES[2 - row, column] * -2e-9
            assert channel.values[row, column] == pytest.approx(expected, rel=1e-14, abs=0)
    np.testing.assert_allclose(scan.coords["x"], [0.5e-6, 1.5e-6, 2.5e-6, 3.5e-6])
    np.testing.assert_allclose(scan.coords["y"], [1.25e-6, 0.75e-6, 0.25e-6])
    assert (scan.metadata["headMode"], scan.metadata["cantileverName"]) == ("NCM", "NCHR")
    assert scan.metadata["time"] == "2021:09:16 13:17:54"
    assert scan.notes == ()
    assert not vendor_of(scan).phase_known


@pytest.mark.parametrize(
    ("stated", "unit", "factor"),
    [
        ("um", "m", 1e-6),
        ("deg", "rad", np.pi / 180),
        ("V", "V", 1.0),
        ("µm", "m", 1e-6),
        ("", None, 1.0),
        ("x", None, 1.0),
    ],
)
def test_units(image_of, stated, unit, factor):
    scan = image_of(unit=stated)
    assert scan.channels[0].unit == unit
    np.testing.assert_allclose(scan.channels[0].values, VALUES[::-1] * -2.0 * factor)
    said = {"": "states no unit", "x": "unit 'x' is not known"}.get(stated)
    assert any(said in note for note in scan.notes) if said else not scan.notes


def test_scale_that_readers_disagree_on(image_of):
    for changes in ({"ZScale": 2.0}, {"ZOffset": 0.5}):
        scan = image_of(**changes)
        assert scan.channels[0].unit is None
        np.testing.assert_allclose(scan.channels[0].values, VALUES[::-1] * -2.0)
        assert any("ZScale" in note for note in scan.notes)


def test_logarithms_and_squares_have_no_unit(image_of):
    assert any("logarithms" in note for note in image_of(isLogScale=1).notes)
    scan = image_of(isSquared=1)
    assert scan.channels[0].unit is None
    assert any("squares" in note for note in scan.notes)


def test_flattened_turned_and_swapped(image_of):
    scan = image_of(isAutoFlatten=1, scanRotation=45.0, isXYSwapped=1)
    assert scan.channels[0].flattened is True
    assert "the scan was turned by 45 deg: x runs along its lines" in scan.notes
    assert any("axes of the scan were swapped" in note for note in scan.notes)


@pytest.mark.parametrize("kind", [0, 1])
def test_ends_of_the_range_are_invalid(image_of, kind):
    values = VALUES.copy()
    values[0, 0], values[2, 3] = np.iinfo(f"i{2 << kind}").max, np.iinfo(f"i{2 << kind}").min
    scan = image_of(values, dataType=kind)
    lost = np.isnan(scan.channels[0].values)
    assert (lost.sum(), lost[2, 0], lost[0, 3]) == (2, True, True)
    assert any("2 invalid pixels" in note for note in scan.notes)


def test_size_that_cannot_be(image_of):
    scan = image_of(scanSizeWidth=0.0)
    assert scan.coords == {}
    assert any("no usable image size" in note for note in scan.notes)


def test_facts(image_of):
    facts = image_of().facts
    assert {name: (fact.value, fact.unit, fact.key) for name, fact in facts.items()} == {
        "drive_frequency": (280e3, "Hz", "ncmFrequency"),
        "setpoint_amplitude": (pytest.approx(10e-9), "m", "setpoint"),
    }
    assert image_of(setpoint=1.5, setpointUnit="V").facts["setpoint_volts"].value == 1.5
    assert "drive_frequency" not in image_of(ncmFrequency=0.0).facts


@pytest.mark.parametrize("unit", ["um", "", "x"])
def test_setpoint_in_a_unit_that_cannot_be(image_of, unit):
    # Real headers state micrometres for what the operator set in nanometres.
    scan = image_of(setpointUnit=unit)
    assert set(scan.facts) == {"drive_frequency"}
    assert any("set-point of 10" in note and "NCM amplitude of 15" in note for note in scan.notes)


def test_direction_of_header_and_name(tmp_path):
    scan = read_channels(write(tmp_path / "a.tiff", isFastScanLeftToRight=0))
    assert scan.channels[0].direction == "retrace"
    scan = read_channels(write(tmp_path / "b_NCM Amplitude_Backward_001.tiff"))
    assert scan.channels[0].direction == "retrace"
    assert any("taken as retrace by its name; its header says trace" in note for note in scan.notes)


def test_spectra_give_the_image_of_their_places(image_of):
    scan = image_of(dataCategory=2)
    np.testing.assert_allclose(scan.channels[0].values, VALUES[::-1] * -2e-9)
    assert any("spectra of this file are not read" in note for note in scan.notes)
    with pytest.raises(FileFormatError, match="line profile, not an image"):
        image_of(dataCategory=1)


# --- sets -----------------------------------------------------------------------------------------


def scan_files(folder, number=7, *, sample="film_240101", **changes):
    """The four files of a tapping scan, as SmartScan names them."""
    folder.mkdir(exist_ok=True)
    for offset, (name, unit) in enumerate(
        (("NCM Amplitude", "nm"), ("NCM Phase", "deg"), ("Z Height", "um"))
    ):
        for forward in (1, 0):
            way = "Forward" if forward else "Backward"
            own = {"channelName": name, "unit": unit, "isFastScanLeftToRight": forward}
            path = folder / f"{sample}_{name}_{way}_{number:03d}.tiff"
            write(path, VALUES + offset, **{**own, **changes})
    return folder


def test_folder_is_one_recording(tmp_path):
    folder = scan_files(tmp_path / "scan")
    (folder / "remarks.txt").write_text("none")
    tifffile.imwrite(folder / "photo.tif", np.zeros((4, 4, 3), np.uint8), photometric="rgb")
    scan = read_channels(folder)
    assert sorted((c.name, c.direction, c.unit) for c in scan.channels) == [
        ("NCM Amplitude", "retrace", "m"),
        ("NCM Amplitude", "trace", "m"),
        ("NCM Phase", "retrace", "rad"),
        ("NCM Phase", "trace", "rad"),
        ("Z Height", "retrace", "m"),
        ("Z Height", "trace", "m"),
    ]
    assert scan.metadata["files"].count(".tiff") == 6
    with pytest.raises(ChannelError, match=r"2 times.*--direction"):
        choose(scan, Request())
    chosen = choose(scan, Request(direction="trace"))
    assert {name: c.name for name, c in chosen.items()} == {
        "height": "Z Height",
        "A1": "NCM Amplitude",
        "phi1": "NCM Phase",
    }
    np.testing.assert_allclose(np.degrees(chosen["phi1"].values), (VALUES[::-1] + 1.0) * -2.0)


def test_directions_do_not_mix(tmp_path):
    folder = scan_files(tmp_path / "scan")
    for gone in ("NCM Amplitude_Forward", "NCM Phase_Backward", "Z Height_Forward"):
        next(folder.glob(f"*{gone}*")).unlink()
    with pytest.raises(ChannelError, match="do not mix"):
        choose(read_channels(folder), Request())


def test_single_file_names_the_others(tmp_path):
    folder = scan_files(scan_files(tmp_path / "scan"), number=8)
    scan = read_channels(folder / "film_240101_NCM Phase_Forward_007.tiff")
    assert [(c.name, c.direction) for c in scan.channels] == [("NCM Phase", "trace")]
    (note,) = scan.notes
    assert note.count("_007.tiff") == 5
    assert "_008" not in note
    assert "folder of their own" in note


def test_names_with_a_number_for_each_file(tmp_path):
    for number, name in enumerate(("Topography", "NCM Amplitude", "NCM Phase")):
        write(
            tmp_path / f"Film {number:04d}.tiff",
            channelName=name,
            scanRate=0.1,
            when=f"2021:09:16 13:17:5{number}",
        )
    assert [c.name for c in read_channels(tmp_path).channels] == ["Topography", "NCM Amplitude", "NCM Phase"]
    note = read_channels(tmp_path / "Film 0001.tiff").notes[-1]
    assert "Film 0000.tiff, Film 0002.tiff" in note


@pytest.mark.parametrize(
    "changes",
    [
        {"scanOffsetX": 4.0},
        {"scanSizeHeight": 1.6},
        {"scanRate": 2.0},
        {"ncmFrequency": 281e3},
        {"when": "2021:09:16 13:18:05"},  # 11 s later, where a scan takes 3 s
        {"sample": "foil_240101"},
        {"number": 9},
    ],
)
def test_several_scans_in_a_folder(tmp_path, changes):
    folder = scan_files(tmp_path / "scan")
    # Without more the same words in another spelling: only the header tells the two scans apart.
    scan_files(folder, **{"number": 7, "sample": "film 240101", **changes})
    with pytest.raises(
        FileFormatError, match=r"holds 2 scans.*and 5 more; .*and 5 more.*folder of their own"
    ):
        read_channels(folder)
    first = read_channels(folder / "film_240101_NCM Phase_Forward_007.tiff")
    assert first.notes[-1].count("film_240101_") == 5
    assert first.notes[-1].count(".tiff") == 5


def test_same_channel_twice_is_two_scans(tmp_path):
    write(tmp_path / "a_001.tiff")
    write(tmp_path / "a_002.tiff")
    with pytest.raises(FileFormatError, match="2 scans"):
        read_channels(tmp_path)


@pytest.mark.parametrize("names", [("a_{}_1", "b_{}_1"), ("a_{}_1", "a_{}_2"), ("a 1", "b 1")])
def test_other_names_are_other_scans(tmp_path, names):
    for name, channel in zip(names, ("NCM Amplitude", "NCM Phase"), strict=True):
        write(tmp_path / f"{name.format(channel)}.tiff", channelName=channel)
    with pytest.raises(FileFormatError, match="2 scans"):
        read_channels(tmp_path)


def test_files_without_a_time_belong_together(tmp_path):
    for name in ("NCM Phase", "NCM Amplitude"):
        write(tmp_path / f"a_{name}_1.tiff", channelName=name, when=None)
    assert len(read_channels(tmp_path).channels) == 2


def test_spectra_beside_a_scan(tmp_path):
    folder = scan_files(tmp_path / "scan")
    write(folder / "curve_001.tiff", dataCategory=2)
    scan = read_channels(folder)
    assert len(scan.channels) == 6
    assert any("left out, because they hold spectra: curve_001.tiff" in note for note in scan.notes)


def test_damaged_file_of_a_set(tmp_path):
    folder = scan_files(tmp_path / "scan")
    broken = folder / "film_240101_NCM Phase_Forward_007.tiff"
    write(broken, channelName="NCM Phase", data=b"short")
    with pytest.raises(
        FileFormatError, match=r"NCM Phase_Forward_007\.tiff is not a Park image that is whole"
    ):
        read_channels(folder)
    note = read_channels(folder / "film_240101_NCM Amplitude_Forward_007.tiff").notes[-1]
    assert note.count(".tiff") == 4


def test_folder_of_pictures(tmp_path):
    tifffile.imwrite(tmp_path / "photo.tif", np.zeros((4, 4, 3), np.uint8), photometric="rgb")
    with pytest.raises(FileFormatError, match="is a folder"):
        read_channels(tmp_path)


# --- what is refused ------------------------------------------------------------------------------


def test_ordinary_picture(tmp_path):
    tifffile.imwrite(tmp_path / "export.tiff", np.zeros((8, 8), np.uint16))
    with pytest.raises(FileFormatError, match=r"export\.tiff.*TIFF picture"):
        read_channels(tmp_path / "export.tiff")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"magic": 7}, "expected the mark of Park"),
        ({"head": b"short"}, "a header of 540 bytes, got 5 bytes"),
        ({"data": bytes(47)}, "expected 48 bytes of data for 4 x 3 pixels, got 47"),
        ({"data": bytes(49)}, "expected 48 bytes of data for 4 x 3 pixels, got 49"),
        ({"width": 0}, "a positive number of pixels"),
        ({"width": -4, "height": -3}, "a positive number of pixels"),
        ({"width": 2**31 - 1, "height": 2**31 - 1}, "a positive number of pixels"),
        ({"width": 2**14, "height": 2**14}, "expected 1073741824 bytes of data"),
        ({"dataType": 3}, "data type 3, compression 0"),
        ({"compression": 1}, "data type 2, compression 1"),
        ({"dataGain": np.nan}, "a finite number as dataGain"),
        ({"scanSizeWidth": np.inf}, "a finite number as scanSizeWidth"),
    ],
)
def test_impossible_headers(image_of, arguments, message):
    began = time.perf_counter()
    with pytest.raises(FileFormatError, match=message):
        image_of(**arguments)
    assert time.perf_counter() - began < 2.0


def test_damaged_files(tmp_path, caplog, survives):
    content = write(tmp_path / "whole.tiff").read_bytes()
    path, random, outcomes = tmp_path / "damaged.tiff", np.random.default_rng(19), []
    for length in np.linspace(1, len(content) - 1, 20, dtype=int):
        outcomes.append(survives(path, content[:length]))
    for attempt in range(150):
        changed = bytearray(content)
        for at in random.integers(0, len(content), size=1 + attempt % 4):
            changed[at] = random.integers(0, 256)
        outcomes.append(survives(path, bytes(changed)))
    assert 20 < sum(outcomes) < 150
    assert caplog.records == []


# --- real files -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "size", "frequency", "pixels"),
    [
        (
            "Park_20210916_034.tiff",
            2.5e-6,
            280655.02142137097,
            "0.26494674597 0.36039948351 0.18873186293 0.31793142303 -1.17558719313",
        ),
        (
            "nanoAFMr_ForceCurve_009.tiff",
            3.25e-6,
            285054.83260019554,
            "-80.6215924837 -60.2886214866 -99.0642339121 -78.6380090698 -86.774179240",
        ),
    ],
)
def test_real_files(afm_data, name, size, frequency, pixels):
    scan = read_channels(afm_data / "park" / name)
    (channel,) = scan.channels
    assert (channel.name, channel.unit, channel.direction) == ("Topography", "m", "trace")
    values = channel.values * 1e9
    assert values.shape == (256, 256)
    found = [values[0, 0], values[0, -1], values[-1, 0], values[-1, -1], values[100, 30]]
    np.testing.assert_allclose(found, [float(number) for number in pixels.split()], rtol=1e-9)
    assert scan.coords["y"][0] + scan.coords["y"][-1] == pytest.approx(size)
    assert scan.facts["drive_frequency"].value == frequency
    assert "setpoint_amplitude" not in scan.facts
    assert any("whose unit cannot be right" in note for note in scan.notes)
    assert any("spectra" in note for note in scan.notes) == ("Force" in name)


def test_real_picture_shows_the_values_the_same_way_up(afm_data):
    path = afm_data / "park" / "Park_20210916_034.tiff"
    with tifffile.TiffFile(path) as file:
        picture = file.pages[0].asarray().astype(float)
    (channel,) = read_channels(path).channels
    # The palette of this file runs from low to high.
    assert np.corrcoef(picture.ravel(), channel.values.ravel())[0, 1] > 0.9


def test_real_values_are_those_of_gwyddion(afm_data):
    gwyddionpy = pytest.importorskip("gwyddionpy")
    path = afm_data / "park" / "Park_20210916_034.tiff"
    try:
        data = gwyddionpy.load(path)
    except gwyddionpy.ConverterNotFoundError:
        pytest.skip("no converter")
    (other,) = data.channels.values()
    (channel,) = read_channels(path).channels
    assert other.si_unit_z == channel.unit == "m"
    np.testing.assert_allclose(channel.values, other.data, rtol=1e-12, atol=1e-24)


def test_real_folder_holds_one_scan_and_spectra(afm_data):
    scan = read_channels(afm_data / "park")
    assert [c.name for c in scan.channels] == ["Topography"]
    assert any("nanoAFMr_ForceCurve_009.tiff" in note for note in scan.notes)


def test_damaged_real_file(afm_data, tmp_path, survives):
    content = (afm_data / "park" / "Park_20210916_034.tiff").read_bytes()
    random, path = np.random.default_rng(23), tmp_path / "damaged.tiff"
    for length in np.linspace(1, len(content) - 70000, 20, dtype=int):
        assert not survives(path, content[:length])
    for attempt in range(30):
        changed = bytearray(content)
        for at in random.integers(0, 2041, size=1 + attempt % 4):
            changed[at] = random.integers(0, 256)
        survives(path, bytes(changed))
