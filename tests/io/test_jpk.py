import math
import struct
import time

import numpy as np
import pytest

from overtone.errors import ChannelError, FileFormatError
from overtone.io.registry import read_channels
from overtone.io.selection import Request, choose
from overtone.io.vendors import vendor_of

tifffile = pytest.importorskip("tifffile")

VALUES = np.arange(12, dtype=">i4").reshape(3, 4) * 1000 - 5000
VOLTS = ("volts", "raw", "V", 2e-9, 0.5)
AMPLITUDE = (
    ("voltsamplitude", "volts", "V", 4e-9, 0.0),
    ("distanceamplitude", "voltsamplitude", "m", 8e-17, 0.0),
)
AC = """sine-generator-feedback-settings.amplitude : 5.0
sine-generator-feedback-settings.frequency : 88378.5
sine-generator-feedback-settings.phaseshift : -0.55
setpoint-feedback-settings.relative-setpoint : 0.9
setpoint-feedback-settings.setpoint-slot : voltsamplitude
adjust-reference-amplitude-feedback-settings.enabled : true
adjust-reference-amplitude-feedback-settings.reference-amplitude : 2.0
"""


def ascii_tag(code, text):
    return (code, 2, None, text, False)


def double(code, value):
    return (code, 12, 1, value, False)


def slot_tags(slots, default, encoder="SignedInteger"):
    """A raw slot and those given as (name, parent, unit, multiplier, offset); without a unit uncalibrated."""
    tags = [(32896, 9, 1, len(slots) + 1, False), ascii_tag(32897, default), ascii_tag(32912, "raw")]
    tags += [ascii_tag(32929, encoder), ascii_tag(32931, "NullScaling")]
    for at, (name, parent, unit, multiplier, offset) in enumerate(slots, 1):
        base = 32912 + 48 * at
        tags += [ascii_tag(base, name), ascii_tag(base + 2, parent)]
        if unit is None:
            tags.append(ascii_tag(base + 1, "UnknownCalibration"))
            continue
        tags += [ascii_tag(base + 18, unit), ascii_tag(base + 19, "LinearScaling")]
        tags += [double(base + 20, multiplier), double(base + 21, offset)]
    return tags


def channel(
    values=VALUES, name="amplitude", title="Lock-In Amplitude", retrace=0, slots=(VOLTS,), default=None, **kw
):
    default = default or slots[-1][0]
    tags = [ascii_tag(32848, name), ascii_tag(32850, title), *slot_tags(slots, default, **kw)]
    return values, tags + ([] if retrace is None else [(32849, 8, 1, retrace, False)])


def grid(u=4e-6, v=3e-6, theta=0.0, reflect=0, columns=4, rows=3):
    tags = [double(32834, u), double(32835, v), double(32836, theta), (32837, 8, 1, reflect, False)]
    return [*tags, (32838, 9, 1, columns, False), (32839, 9, 1, rows, False)]


def write(path, *channels, scan=None, feedback="", mode="ac", extra=(), byteorder=">"):
    tags = [*(grid() if scan is None else scan), ascii_tag(32848, "thumbnail"), *slot_tags((VOLTS,), "volts")]
    tags += [ascii_tag(32816, mode)] + ([ascii_tag(32830, feedback)] if feedback else []) + list(extra)
    with tifffile.TiffWriter(path, byteorder=byteorder) as file:
        thumbnail = np.zeros((2, 2), np.uint8)
        colours = np.zeros((3, 256), np.uint16)
        options = {"metadata": None, "software": False}
        file.write(thumbnail, photometric="palette", colormap=colours, extratags=tags, **options)
        for values, own in channels:
            data = values if isinstance(values, np.ndarray) else np.asarray(values)
            file.write(data, photometric="minisblack", extratags=own, **options)
    return path


@pytest.fixture
def scan_of(tmp_path):
    def read(*channels, **arguments):
        return read_channels(write(tmp_path / "scan.jpk", *channels, **arguments))

    return read


# --- channels -------------------------------------------------------------------------------------


@pytest.mark.parametrize("byteorder", ["<", ">"])
def test_trace_and_retrace(scan_of, byteorder):
    scan = scan_of(
        channel(slots=(VOLTS, *AMPLITUDE)),
        channel(VALUES + 1, slots=(VOLTS, *AMPLITUDE), retrace=1),
        channel(VALUES, "phase", "Lock-In Phase", slots=(("degrees", "raw", "deg", 0.01, 1.0),)),
        byteorder=byteorder,
    )
    assert (scan.format, scan.vendor, scan.dims) == ("jpk", "jpk", ("y", "x"))
    trace, retrace, phase = scan.channels
    assert [(c.name, c.direction, c.unit) for c in scan.channels] == [
        ("Lock-In Amplitude", "trace", "m"),
        ("Lock-In Amplitude", "retrace", "m"),
        ("Lock-In Phase", "trace", "rad"),
    ]
    for row in range(3):
        for column in range(4):
            raw = float(VALUES[2 - row, column])  # stored from the bottom
            assert trace.values[row, column] == pytest.approx(raw * 8e-17, rel=1e-14, abs=0)
            assert retrace.values[row, column] == pytest.approx((raw + 1.0) * 8e-17, rel=1e-14, abs=0)
            assert phase.values[row, column] == pytest.approx(math.radians(0.01 * raw + 1.0), rel=1e-14)
    np.testing.assert_allclose(scan.coords["x"], [0.5e-6, 1.5e-6, 2.5e-6, 3.5e-6])
    np.testing.assert_allclose(scan.coords["y"], [2.5e-6, 1.5e-6, 0.5e-6])
    assert not vendor_of(scan).phase_known
    assert vendor_of(scan).optical_lever


def test_directions_do_not_mix(scan_of):
    phase = {"name": "phase", "title": "Lock-In Phase", "slots": (("degrees", "raw", "deg", 0.01, 0.0),)}
    both = [channel(slots=(VOLTS, *AMPLITUDE), retrace=r) for r in (0, 1)]
    scan = scan_of(*both, *(channel(retrace=r, **phase) for r in (0, 1)))
    with pytest.raises(ChannelError, match=r"2 times.*--direction trace or --direction retrace"):
        choose(scan, Request())
    chosen = choose(scan, Request(direction="retrace"))
    assert {c.direction for c in chosen.values()} == {"retrace"}
    mixed = scan_of(both[0], channel(retrace=1, **phase))
    with pytest.raises(ChannelError, match="trace and retrace do not mix"):
        choose(mixed, Request())


def test_channel_without_direction(scan_of):
    assert scan_of(channel(retrace=None)).channels[0].direction is None


def test_reflected_scan_is_stored_from_the_top(scan_of):
    scan = scan_of(channel(), scan=grid(reflect=1))
    np.testing.assert_allclose(scan.channels[0].values, VALUES * 2e-9 + 0.5)


@pytest.mark.parametrize(
    ("encoder", "stored", "meant"),
    [
        ("SignedShort", ">u2", ">i2"),
        ("UnsignedShort", ">i2", ">u2"),
        ("SignedInteger", ">i4", ">i4"),
        ("Float", ">f4", ">f4"),
    ],
)
def test_sign_is_that_of_the_encoder(scan_of, encoder, stored, meant):
    values = np.array([[1, 40000], [30000, 65000]], np.uint16 if "Short" in encoder else np.int32)
    values = values.astype(meant).view(stored)
    scan = scan_of(channel(values, encoder=encoder), scan=grid(columns=2, rows=2))
    np.testing.assert_allclose(scan.channels[0].values, values.view(meant)[::-1] * 2e-9 + 0.5)


def test_amplitude_that_was_not_calibrated_is_in_volts(scan_of):
    uncalibrated = ("distanceamplitude", "voltsamplitude", None, 0.0, 0.0)
    scan = scan_of(channel(slots=(VOLTS, AMPLITUDE[0], uncalibrated), default="voltsamplitude"), feedback=AC)
    assert scan.channels[0].unit == "V"
    np.testing.assert_allclose(scan.channels[0].values, VALUES[::-1] * 4e-9)
    assert "amplitude_sensitivity" not in scan.facts
    assert "free_amplitude" not in scan.facts
    assert scan.facts["free_amplitude_volts"].value == 2.0


def test_calibrated_amplitude_that_was_shown_in_volts(scan_of):
    scan = scan_of(channel(slots=(VOLTS, *AMPLITUDE), default="voltsamplitude"))
    assert scan.channels[0].unit == "m"
    np.testing.assert_allclose(scan.channels[0].values, VALUES[::-1] * 8e-17)
    assert any("in metres by its calibration 'distanceamplitude'" in note for note in scan.notes)


def test_height_keeps_the_calibration_that_was_chosen(scan_of):
    slots = (("nominal", "raw", "m", 1e-12, 2e-6), ("calibrated", "nominal", "m", 3e-12, 4e-6))
    scan = scan_of(channel(name="height", title="Height", slots=slots, default="nominal"))
    np.testing.assert_allclose(scan.channels[0].values, VALUES[::-1] * 1e-12 + 2e-6)
    assert scan.notes == ()


def test_missing_and_unknown_calibrations(scan_of):
    scan = scan_of(channel(default="gone"))
    assert scan.channels[0].unit == "V"
    assert any("'gone' is not in the file; 'volts' was taken" in note for note in scan.notes)
    scan = scan_of(channel(slots=(("user", "raw", None, 0.0, 0.0),)))
    assert scan.channels[0].unit is None
    np.testing.assert_array_equal(scan.channels[0].values, VALUES[::-1])
    assert any("no calibration" in note for note in scan.notes)
    scan = scan_of(channel(slots=(("user", "raw", "furlong", 2.0, 0.0),)))
    assert scan.channels[0].unit is None
    assert any("'furlong' is not known" in note for note in scan.notes)


def test_ends_of_the_range_are_invalid(scan_of):
    values = VALUES.copy()
    values[0, 0], values[0, 1], values[1, 1] = -(2**31), 2**31 - 1, 2**31 - 2
    scan = scan_of(channel(values))
    lost = np.isnan(scan.channels[0].values)
    assert (lost.sum(), lost[2, 0], lost[2, 1], lost[1, 1]) == (2, True, True, False)
    assert any("2 invalid pixels" in note for note in scan.notes)


def test_channel_of_another_shape_is_left_out(scan_of):
    scan = scan_of(channel(), channel(np.zeros((2, 2), ">i4"), title="Odd"))
    assert [c.name for c in scan.channels] == ["Lock-In Amplitude"]
    assert any("Odd: left out, (2, 2) pixels" in note for note in scan.notes)


# --- size and settings ----------------------------------------------------------------------------


def test_turned_scan_and_unusable_sizes(scan_of):
    scan = scan_of(channel(), scan=grid(theta=math.pi / 2))
    assert "the scan was turned by 90 deg: x runs along its lines" in scan.notes
    assert len(scan.coords["x"]) == 4
    assert scan.metadata["grid theta (tag 32836)"] == str(math.pi / 2)
    for wrong in (grid(u=0.0), grid(v=math.nan), grid(u=5.0)):
        scan = scan_of(channel(), scan=wrong)
        assert scan.coords == {}
        assert any("no usable image size" in note for note in scan.notes)
    scan = scan_of(channel(), scan=grid(rows=7))
    assert scan.coords == {}
    assert any("7 x 4 pixels and holds 3 x 4" in note for note in scan.notes)


def test_facts_of_an_ac_mode(scan_of):
    scan = scan_of(channel(slots=(VOLTS, *AMPLITUDE)), feedback=AC)
    facts = {name: (fact.value, fact.unit) for name, fact in scan.facts.items()}
    assert facts == {
        "drive_frequency": (88378.5, "Hz"),
        "drive_amplitude": (5.0, "V"),
        "setpoint_fraction": (0.9, "1"),
        "amplitude_sensitivity": (pytest.approx(2e-8), "m/V"),
        "free_amplitude_volts": (2.0, "V"),
        "free_amplitude": (pytest.approx(4e-8), "m"),
        "setpoint_volts": (pytest.approx(1.8), "V"),
        "setpoint_amplitude": (pytest.approx(3.6e-8), "m"),
    }
    assert scan.facts["drive_frequency"].key == "sine-generator-feedback-settings.frequency"
    assert scan.facts["setpoint_amplitude"].key == (
        "relative-setpoint x reference-amplitude x calibration distanceamplitude / voltsamplitude"
    )
    assert any("phase shift of -0.55" in note and "no unit" in note for note in scan.notes)
    assert any("readjusted during the scan" in note for note in scan.notes)


def test_setpoint_in_metres(scan_of):
    settings = AC.replace("slot : voltsamplitude", "slot : distanceamplitude").replace(": 2.0", ": 4e-8")
    facts = scan_of(channel(slots=(VOLTS, *AMPLITUDE)), feedback=settings).facts
    assert (facts["free_amplitude"].value, facts["free_amplitude"].unit) == (4e-8, "m")
    assert facts["setpoint_amplitude"].value == pytest.approx(3.6e-8)
    assert "free_amplitude_volts" not in facts
    assert "amplitude_sensitivity" not in facts


def test_old_files_keep_the_feedback_in_tags(scan_of):
    tags = [double(32821, 1.5), double(32822, 0.25), double(32823, 70e3), double(32824, 12.0)]
    facts = scan_of(channel(slots=(VOLTS, *AMPLITUDE)), mode="intermittent", extra=tags).facts
    assert (facts["drive_frequency"].value, facts["drive_amplitude"].value) == (70e3, 0.25)
    assert facts["free_amplitude"].value == pytest.approx(3e-8)
    # In contact mode the same tags mean other things.
    assert scan_of(channel(slots=(VOLTS, *AMPLITUDE)), mode="contact", extra=tags).facts.keys() <= {
        "amplitude_sensitivity"
    }


@pytest.mark.parametrize("calibrated", [0, 1])
def test_stiffness_of_old_files(scan_of, calibrated):
    fact = scan_of(channel(), extra=[double(32785, 0.3), (32786, 9, 1, calibrated, False)]).facts["stiffness"]
    assert (fact.value, fact.unit, fact.factory_default) == (0.3, "N/m", not calibrated)


def test_calibration_of_the_lever_and_escaped_text(scan_of):
    text = (
        "environment.cantilever-calibration-info.spring-constant : 200 mN/m\n"
        "environment.cantilever-calibration-info.sensitivity : 20 nm/V\n"
        "environment.cantilever-calibration-info.frequency : 60.5 kHz\n"
        "environment.cantilever-calibration-info.qFactor : 2.5\n"
        "when : 2017-01-16 16\\:00\\:32\nrange : 6.5 \\u00B5m\n"
    )
    scan = scan_of(channel(), extra=[ascii_tag(32791, text)])
    assert (scan.facts["stiffness"].value, scan.facts["stiffness"].unit) == (0.2, "N/m")
    assert scan.facts["deflection_sensitivity"].value == pytest.approx(20e-9)
    (resonance,) = scan.resonances
    assert (resonance.source, resonance.frequency, resonance.quality_factor) == ("thermal", 60500.0, 2.5)
    assert (scan.metadata["when"], scan.metadata["range"]) == ("2017-01-16 16:00:32", "6.5 µm")
    off = text + "environment.cantilever-calibration-info.defined : false\n"
    scan = scan_of(channel(), extra=[ascii_tag(32791, off)])
    assert (dict(scan.facts), scan.resonances) == ({}, ())


# --- what is refused ------------------------------------------------------------------------------


@pytest.mark.parametrize("member", ["header.properties", "segments/0/header.properties", "shared-data/x"])
def test_archive_of_curves(tmp_path, member):
    import zipfile

    path = tmp_path / "curve.jpk-force"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr(member, "type=x")
    with pytest.raises(
        FileFormatError, match=r"archive of force curves.*data-image\.jpk.*JPK Data Processing"
    ):
        read_channels(path)


def test_other_archives_are_not_jpk(tmp_path):
    import zipfile

    with zipfile.ZipFile(tmp_path / "sheet.xlsx", "w") as archive:
        archive.writestr("[Content_Types].xml", "<x/>")
    with pytest.raises(FileFormatError, match="ZIP archive or spreadsheet"):
        read_channels(tmp_path / "sheet.xlsx")


@pytest.mark.parametrize("byteorder", ["<", ">"])
def test_ordinary_picture(tmp_path, byteorder):
    path = tmp_path / "photo.tif"
    tifffile.imwrite(path, np.zeros((8, 8, 3), np.uint8), photometric="rgb", byteorder=byteorder)
    with pytest.raises(FileFormatError, match=r"photo\.tif.*TIFF picture"):
        read_channels(path)
    path = path.rename(tmp_path / "photo.jpk")
    with pytest.raises(FileFormatError, match="no channel of a JPK image"):
        read_channels(path)


def test_truncated_image(tmp_path):
    path = write(tmp_path / "scan.jpk", channel(np.zeros((64, 64), ">i4")))
    content = path.read_bytes()
    path.write_bytes(content[:-1])
    with pytest.raises(FileFormatError, match=r"expected \d+ bytes as its pages say"):
        read_channels(path)
    path.write_bytes(content[:9])
    with pytest.raises(FileFormatError, match=r"scan\.jpk is not a JPK image that is whole"):
        read_channels(path)


def entry_of(content, page, code):
    """Where the entry of a tag stands in a big-endian TIFF."""
    start = struct.unpack_from(">I", content, 4)[0]
    for _ in range(page):
        start = struct.unpack_from(
            ">I", content, start + 2 + 12 * struct.unpack_from(">H", content, start)[0]
        )[0]
    count = struct.unpack_from(">H", content, start)[0]
    return next(
        at
        for at in range(start + 2, start + 2 + 12 * count, 12)
        if struct.unpack_from(">H", content, at)[0] == code
    )


@pytest.mark.parametrize("code", [256, 257])
def test_claim_of_many_pixels(tmp_path, code):
    path = write(tmp_path / "scan.jpk", channel())
    content = bytearray(path.read_bytes())
    struct.pack_into(">I", content, entry_of(content, 1, code) + 8, 2**31 - 1)
    path.write_bytes(bytes(content))
    began = time.perf_counter()
    with pytest.raises(FileFormatError, match=r"fit into a file of|bytes for"):
        read_channels(path)
    assert time.perf_counter() - began < 2.0


def test_claim_of_few_pixels_is_no_image_either(tmp_path):
    path = write(tmp_path / "scan.jpk", channel())
    content = bytearray(path.read_bytes())
    struct.pack_into(">I", content, entry_of(content, 1, 257) + 8, 2)
    path.write_bytes(bytes(content))
    with pytest.raises(FileFormatError, match=r"expected 32 bytes for \(2, 4\) pixels, got 48"):
        read_channels(path)


def test_tags_that_share_their_bytes(tmp_path):
    # Every tag may point at the whole file; together they must not claim much more than it.
    path = write(tmp_path / "scan.jpk", channel(np.zeros((700, 700), ">i4")), feedback="x" * 1000)
    content = bytearray(path.read_bytes())
    for code in (32830, 32816):
        struct.pack_into(">II", content, entry_of(content, 0, code) + 4, len(content) - 8, 8)
    path.write_bytes(bytes(content))
    with pytest.raises(FileFormatError, match="tags that fit into a file"):
        read_channels(path)


def test_pages_that_share_their_pixels(tmp_path):
    path = write(
        tmp_path / "scan.jpk", channel(np.zeros((1200, 1200), ">i4")), scan=grid(columns=1200, rows=1200)
    )
    content = bytearray(path.read_bytes())
    first = struct.unpack_from(">I", content, 4)[0]
    page = struct.unpack_from(">I", content, first + 2 + 12 * struct.unpack_from(">H", content, first)[0])[0]
    length = 2 + 12 * struct.unpack_from(">H", content, page)[0]
    last = page + length
    for _ in range(30):
        struct.pack_into(">I", content, last, len(content))
        content += content[page : page + length] + bytes(4)
        last = len(content) - 4
    path.write_bytes(bytes(content))
    with pytest.raises(FileFormatError, match="images that fit into a file of"):
        read_channels(path)


def test_compressed_page(tmp_path):
    values, tags = channel()
    path = tmp_path / "scan.jpk"
    options = {"photometric": "minisblack", "metadata": None, "compression": "zlib"}
    tifffile.imwrite(path, values, extratags=[*grid(), *tags], byteorder=">", **options)
    with pytest.raises(FileFormatError, match="numbers without compression, got compression"):
        read_channels(path)


def test_pages_in_a_circle(tmp_path):
    path = write(tmp_path / "scan.jpk", channel())
    content = bytearray(path.read_bytes())
    first = struct.unpack_from(">I", content, 4)[0]
    count = struct.unpack_from(">H", content, first)[0]
    second = struct.unpack_from(">I", content, first + 2 + 12 * count)[0]
    struct.pack_into(">I", content, second + 2 + 12 * struct.unpack_from(">H", content, second)[0], first)
    path.write_bytes(bytes(content))
    assert len(read_channels(path).channels) == 1


@pytest.mark.parametrize("count", [0, 100000])
def test_number_of_slots(tmp_path, count):
    values, tags = channel()
    tags = [(32896, 9, 1, count, False) if tag[0] == 32896 else tag for tag in tags]
    with pytest.raises(FileFormatError, match=f"calibration slots, got {count}"):
        read_channels(write(tmp_path / "scan.jpk", (values, tags)))


def test_damaged_files(tmp_path, caplog, survives):
    whole = write(tmp_path / "whole.jpk", channel(slots=(VOLTS, *AMPLITUDE)), channel(retrace=1), feedback=AC)
    content, path, random = whole.read_bytes(), tmp_path / "damaged.jpk", np.random.default_rng(11)
    outcomes = []
    for length in np.linspace(1, len(content) - 1, 20, dtype=int):
        outcomes.append(survives(path, content[:length]))
    for attempt in range(120):
        changed = bytearray(content)
        for at in random.integers(0, len(content), size=1 + attempt % 4):
            changed[at] = random.integers(0, 256)
        outcomes.append(survives(path, bytes(changed)))
    assert 20 < sum(outcomes) < 120
    assert caplog.records == []


# --- real files -----------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def real(afm_data):
    return read_channels(afm_data / "jpk" / "TopoStats_file.jpk")


def named(recording, name, direction):
    return next(c for c in recording.channels if (c.name, c.direction) == (name, direction))


def test_real_channels(real):
    names = ["Height", "Height (measured)", "Lock-In Amplitude", "Lock-In Phase", "Error Signal"]
    units = ["m", "m", "m", "rad", "V"]
    assert [(c.name, c.direction, c.unit) for c in real.channels] == [
        (name, direction, unit)
        for direction in ("retrace", "trace")
        for name, unit in zip(names, units, strict=True)
    ]


@pytest.mark.parametrize(
    ("name", "unit", "pixels"),
    [
        (
            "Lock-In Amplitude",
            1e-9,
            "25.873097133589 25.837339493745 25.454908373228 25.535556008732 25.826765097",
        ),
        (
            "Lock-In Phase",
            math.pi / 180,
            "-9.3917512998 -9.2286669797 -8.8996190947 -8.8990388487 -9.0842914016",
        ),
        ("Height (measured)", 1e-6, "3.7839653906 3.8282728839 3.8090253437 3.7912406092 3.8146762343"),
    ],
)
def test_real_pixels(real, name, unit, pixels):
    values = named(real, name, "trace").values / unit
    found = [values[0, 0], values[0, -1], values[-1, 0], values[-1, -1], values[100, 30]]
    np.testing.assert_allclose(found, [float(number) for number in pixels.split()], rtol=3e-11)


def test_real_values_are_arithmetic_of_the_raw_tags(afm_data, real):
    with tifffile.TiffFile(afm_data / "jpk" / "TopoStats_file.jpk") as file:
        raw = file.pages[3].asarray()
        tags = {tag.code: tag.value for tag in file.pages[3].tags}
    assert (tags[32850], tags[32849], tags[33056]) == ("Lock-In Amplitude", 1, "distanceamplitude")
    expected = raw[::-1] * tags[33076] + tags[33077]
    np.testing.assert_allclose(named(real, "Lock-In Amplitude", "retrace").values, expected, rtol=1e-14)


def test_real_values_are_those_of_gwyddion(afm_data, real):
    gwyddionpy = pytest.importorskip("gwyddionpy")
    try:
        data = gwyddionpy.load(afm_data / "jpk" / "TopoStats_file.jpk")
    except gwyddionpy.ConverterNotFoundError:
        pytest.skip("no converter")
    found = {channel.name: channel for channel in data.channels.values()}
    assert len(found) == 10
    for channel_ in real.channels:
        other = found[channel_.name + (" (retrace)" if channel_.direction == "retrace" else "")]
        factor = math.pi / 180.0 if other.si_unit_z == "deg" else 1.0
        np.testing.assert_allclose(channel_.values, other.data * factor, rtol=1e-12)
    assert (real.coords["x"][-1] + real.coords["x"][0]) == pytest.approx(other.xreal)


def test_real_facts_agree_with_the_data(real):
    facts = real.facts
    assert facts["drive_frequency"].value == 88378.8851072282
    assert facts["setpoint_volts"].value == pytest.approx(1.7387439435348273)  # tag 32819 says the same
    assert real.metadata["setpoint (tag 32819)"] == "1.7387439435348273"
    assert facts["setpoint_fraction"].value == 0.9054335194026142
    assert facts["amplitude_sensitivity"].value == pytest.approx(14.8776e-9, rel=1e-5)
    # The feedback holds the amplitude at its set-point.
    assert named(real, "Lock-In Amplitude", "trace").values.mean() == pytest.approx(
        facts["setpoint_amplitude"].value, rel=0.005
    )
    assert real.resonances == ()
    assert real.metadata[
        "z-scanner-map.z-scanner.internal-z-scanner.z-scanner-environment.z-range.fancyname"
    ] == ("6.5 µm (max range)")


def test_damaged_real_file(afm_data, tmp_path, survives):
    content = (afm_data / "jpk" / "TopoStats_file.jpk").read_bytes()
    random, path = np.random.default_rng(5), tmp_path / "damaged.jpk"
    for length in np.linspace(1, len(content) - 1, 20, dtype=int):
        assert not survives(path, content[:length])
    for attempt in range(30):
        changed = bytearray(content)
        for at in random.integers(0, 14900, size=1 + attempt % 4):
            changed[at] = random.integers(0, 256)
        survives(path, bytes(changed))
