import os
import time
from pathlib import Path

import numpy as np
import pytest

from overtone.errors import ChannelError, FileFormatError, OvertoneError
from overtone.io import gwyddion_bridge, gwyddion_units
from overtone.io.gwyddion_units import Statement, confirmed
from overtone.io.observables import open_scan
from overtone.io.recording import Recording
from overtone.io.registry import read_channels

REAL = {
    "nanonis": "nanonis/A151216.123306-02602.sxm",
    "ntmdt": "ntmdt/GaAs_map.mdt",
    "wsxm": "wsxm/ST_top-1.top",
    "agilent": "agilent/ST_mi-1.mi",
}
HEAD = b":NANONIS_VERSION:\n2\n"
SXM = (
    HEAD + b":DATA_INFO:\n\tChannel\tName\tUnit\tDirection\tCalibration\tOffset\n"
    b"\t14\tZ\tm\tboth\t1\t0\n\t17\tAmplitude\t%b\tforward\t1\t0\n\n:SCANIT_END:\n\n\n\x1a\x04"
)
PICOVIEW = b"fileType      Image\nversion       PicoView\n" + b"".join(
    b"bufferLabel   %b\ndirection     Trace\nbufferRange   1.0e+001\nbufferUnit    %b\ntrace         %b\n"
    % line
    for line in (
        (b"Deflection", b"V", b"Trace"),
        (b"Friction", b"mV", b"Trace"),
        (b"Friction", b"mV", b"Retrace"),
    )
)


@pytest.fixture(autouse=True)
def helper():
    pytest.importorskip("gwyddionpy")
    return pytest.importorskip("gwyddionpy_converter")


def channel(recording, name, direction="trace"):
    return next(c for c in recording.channels if (c.name, c.direction) == (name, direction))


# --- real files by own arithmetic -----------------------------------------------------------------


def test_nanonis_by_own_arithmetic(afm_data):
    path = afm_data / REAL["nanonis"]
    scan = read_channels(path)
    assert (scan.format, scan.vendor, scan.dims) == ("gwyddion", "nanonis", ("y", "x"))
    content = path.read_bytes()
    start = content.index(b"\x1a\x04") + 2
    stored = np.frombuffer(content, ">f4", offset=start).reshape(9, 2, 128, 128).astype(float)
    names = [
        ("Z", "m", 1.0),
        ("Input_4", "V", 1.0),
        ("Current", None, 1.0),
        ("Phase", "rad", np.pi / 180),
        ("Amplitude", "m", 1.0),
        ("Frequency_Shift", "Hz", 1.0),
        ("Excitation", "V", 1.0),
        ("LIX_1_omega", None, 1.0),
        ("LIY_1_omega", None, 1.0),
    ]
    assert len(scan.channels) == 18
    for (name, unit, factor), lines in zip(names, stored, strict=True):
        trace, retrace = channel(scan, name), channel(scan, name, "retrace")
        # Whether the ampere is among the known units is no matter here.
        assert trace.unit == retrace.unit
        assert trace.unit == unit or (unit is None and trace.unit == "A")
        # Scanned upwards: the first line is the lowest; backward lines as they were scanned.
        np.testing.assert_allclose(trace.values, lines[0][::-1] * factor, rtol=1e-12)
        np.testing.assert_allclose(retrace.values, lines[1][::-1, ::-1] * factor, rtol=1e-12)
    amplitude = channel(scan, "Amplitude").values
    expected = [1.002605e-10, 1.000283e-10, 1.003037e-10, 9.991747e-11, 1.000488e-10]
    for pixel, value in zip(((0, 0), (0, -1), (-1, 0), (-1, -1), (100, 37)), expected, strict=True):
        assert amplitude[pixel] == pytest.approx(value, rel=1e-6)
    assert amplitude.mean() == pytest.approx(100e-12, rel=1e-4)  # its set-point, in the header
    assert scan.metadata["Oscillation Control::Amplitude Setpoint (m)"] == "100E-12"
    np.testing.assert_allclose(np.diff(scan.coords["x"]), 2e-9 / 128, rtol=1e-9)
    assert scan.coords["y"][0] > scan.coords["y"][-1]


def test_wsxm_by_own_arithmetic(afm_data):
    path = afm_data / REAL["wsxm"]
    scan = read_channels(path)
    (height,) = scan.channels
    assert (height.name, height.unit, height.direction) == ("Topography", "m", "trace")
    stored = np.frombuffer(path.read_bytes(), "<i2", offset=2245).reshape(256, 256).astype(float)
    # Z Amplitude 18.8851 nm between Minimum 5927 and Maximum 6900; the first number is the lower right corner.
    np.testing.assert_allclose(height.values, stored[::-1, ::-1] * 18.8851e-9 / (6900 - 5927), rtol=1e-5)
    assert np.ptp(height.values) == pytest.approx(18.8851e-9, rel=1e-5)
    assert scan.coords["x"][-1] == pytest.approx(600e-9 * 255.5 / 256, rel=1e-9)


def test_agilent_by_own_arithmetic(afm_data):
    path = afm_data / REAL["agilent"]
    scan = read_channels(path)
    content = path.read_bytes()
    start = content.index(b"data          BINARY_32\n") + 24
    stored = np.frombuffer(content, "<i4", offset=start).reshape(4, 256, 256) / 2.0**31
    told = [(c.name, c.unit, c.direction) for c in scan.channels]
    assert told == [
        ("Topography", "m", "trace"),
        ("Deflection", "V", "trace"),
        ("Friction", "V", "trace"),
        ("Friction", "V", "retrace"),
    ]
    for c, lines, scale in zip(scan.channels, stored, (2.9025e-6, 10.0, 10.0, 10.0), strict=True):
        np.testing.assert_allclose(c.values, lines[::-1] * scale, rtol=1e-9)
    np.testing.assert_allclose(np.diff(scan.coords["x"]), 20e-6 / 256, rtol=1e-9)


def test_nt_mdt_keeps_no_unit_that_nothing_confirms(afm_data):
    scan = read_channels(afm_data / REAL["ntmdt"])
    assert [(c.name, c.unit, c.direction) for c in scan.channels] == [
        ("1F:Iprobe (2)", None, "trace"),
        ("1B:Iprobe (3)", None, "retrace"),
    ]
    assert any("1F:Iprobe (2) (trace) has no unit: 'A', which Gwyddion states" in note for note in scan.notes)
    for c in scan.channels:
        steps = c.values / 3.8147264e-13
        np.testing.assert_allclose(steps, np.rint(steps), atol=0.02)
    assert np.ptp(scan.coords["y"]) == pytest.approx(3.0008335e-6 * 255 / 256, rel=1e-6)


@pytest.mark.parametrize("name", ["scan.ibw", "scan.nid", "scan"])
def test_content_decides_not_the_name(afm_data, tmp_path, name):
    (tmp_path / name).write_bytes((afm_data / REAL["wsxm"]).read_bytes())
    assert read_channels(tmp_path / name).vendor == "wsxm"


def test_trace_and_retrace_are_not_chosen_silently(afm_data):
    with pytest.raises(ChannelError, match=r"holds Z 2 times.*--direction trace or --direction retrace"):
        open_scan(afm_data / REAL["nanonis"])


def survives(path):
    begun = time.monotonic()
    try:
        scan = read_channels(path)
    except OvertoneError as error:
        scan = str(error)
    assert time.monotonic() - begun < 5.0
    if isinstance(scan, str):
        assert len(scan) < 1000
        return False
    assert isinstance(scan, Recording)
    assert len({c.values.shape for c in scan.channels}) == 1
    return True


@pytest.mark.parametrize("name", REAL.values(), ids=REAL)
def test_damaged_real_files(afm_data, tmp_path, name):
    content = (afm_data / name).read_bytes()
    path = tmp_path / Path(name).name
    for length in np.linspace(30, len(content) - 1, 6, dtype=int):
        path.write_bytes(content[:length])
        assert not survives(path)
    random = np.random.default_rng(17)
    for _ in range(12):
        changed = bytearray(content)
        for at in random.integers(0, 3000, size=4):
            changed[at] = random.integers(0, 256)
        path.write_bytes(bytes(changed))
        survives(path)
    path.write_bytes(content)
    assert survives(path)


# --- a real helper, a synthetic file --------------------------------------------------------------


def test_unit_of_the_scan_size_and_pixels_that_are_not_square(tmp_path):
    numbers = (np.arange(12) * 100).reshape(3, 4).astype("<i2")
    header = (
        "fileformat = bcrstm\nheadersize = 2048\nxpixels = 4\nypixels = 3\nxlength = 400\nylength = 150\n"
        "xunit = nm\nyunit = nm\nzunit = nm\nbit2nm = 0.5\n"
    )
    path = tmp_path / "scan.bcr"
    path.write_bytes(header.encode().ljust(2048, b"\0") + numbers.tobytes())
    scan = read_channels(path)
    assert (scan.vendor, scan.channels[0].unit) == ("bcr", "m")
    np.testing.assert_allclose(scan.channels[0].values, numbers * 0.5e-9, rtol=1e-9)
    np.testing.assert_allclose(scan.coords["x"], [50e-9, 150e-9, 250e-9, 350e-9], rtol=1e-9)
    np.testing.assert_allclose(scan.coords["y"], [125e-9, 75e-9, 25e-9], rtol=1e-9)


# --- a synthetic helper ---------------------------------------------------------------------------


def gwy(path, fields, masks=None, xy="m"):
    """Gwyddion's own file; fields are {title: (unit, values)}."""
    objects = pytest.importorskip("gwyfile.objects")
    container = objects.GwyContainer()
    for i, (title, (unit, values)) in enumerate(fields.items()):
        container[f"/{i}/data"] = objects.GwyDataField(
            np.asarray(values, float), xreal=2e-9, yreal=1e-9, si_unit_xy=xy, si_unit_z=unit
        )
        container[f"/{i}/data/title"] = title
        if masks and title in masks:
            container[f"/{i}/mask"] = objects.GwyDataField(np.asarray(masks[title], float))
    container.tofile(str(path))


@pytest.fixture
def run_helper(tmp_path, monkeypatch, helper):
    """Put a script in the place of the helper; it is given the file and where the answer goes."""

    def run(script, header=HEAD):
        program = tmp_path / "gwyconvert"
        program.write_text(f"#!/bin/sh\n{script}\n")
        program.chmod(0o755)
        monkeypatch.setattr(helper, "binary_path", lambda: program)
        path = tmp_path / "scan.sxm"
        path.write_bytes(header)
        return read_channels(path)

    return run


@pytest.fixture
def answered(tmp_path, run_helper):
    def read(fields, header=HEAD, module="nanonis", **arguments):
        gwy(tmp_path / "prepared.gwy", fields, **arguments)
        return run_helper(
            f"""cp "{tmp_path}/prepared.gwy" "$2"; echo '{{"module": "{module}"}}'""", header=header
        )

    return read


VALUES = np.arange(6.0).reshape(2, 3)
SXM_FIELDS = {
    "Z (Forward)": ("m", VALUES * 1e-9),
    "Z (Backward)": ("m", VALUES * 2e-9),
    "Amplitude (Forward)": ("V", VALUES),
}


def test_units_that_the_header_confirms(answered):
    scan = answered(SXM_FIELDS, SXM % b"V")
    assert [(c.name, c.unit, c.direction) for c in scan.channels] == [
        ("Z", "m", "trace"),
        ("Z", "m", "retrace"),
        ("Amplitude", "V", "trace"),
    ]
    np.testing.assert_array_equal(scan.channels[2].values, VALUES)
    assert scan.notes == ("read by Gwyddion (nanonis)",)


@pytest.mark.parametrize(
    "header", [SXM % b"mV", SXM % b"m", SXM % b"arb", HEAD], ids=["mV", "m", "arb", "none"]
)
def test_units_that_it_does_not(answered, header):
    scan = answered(SXM_FIELDS, header)
    assert [c.unit for c in scan.channels] == ["m", "m", None]
    np.testing.assert_array_equal(scan.channels[2].values, VALUES)
    assert "Amplitude (trace) has no unit: 'V', which Gwyddion states, is not confirmed" in scan.notes[1]


def test_a_header_of_other_channels_confirms_nothing(answered):
    fields = {"Phase2 (Forward)": ("m", VALUES), "Z2 (Backward)": ("m", VALUES), "A (Forward)": ("V", VALUES)}
    assert [c.unit for c in answered(fields, SXM % b"V").channels] == [None, None, None]
    swapped = {"Z (Backward)": ("m", VALUES), "Z (Forward)": ("m", VALUES), "Amplitude": ("V", VALUES)}
    scan = answered(swapped, SXM % b"V")
    # Heights count by their name, once nothing contradicts them.
    assert [(c.unit, c.direction) for c in scan.channels] == [
        ("m", "retrace"),
        ("m", "trace"),
        ("V", "trace"),
    ]


def test_a_height_that_the_header_contradicts(answered):
    header = (SXM % b"V").replace(b"\tZ\tm\t", b"\tZ\tnm\t")
    assert [c.unit for c in answered(SXM_FIELDS, header).channels] == [None, None, "V"]


def test_steps_of_the_converter_tell_millivolts_from_volts(answered):
    steps = np.array([[0, 1, 2], [5, 7, 30]])
    fields = {
        "Deflection": ("V", steps * 10 / 32768),
        "Friction": ("V", steps * 10 / 32768),  # the header says mV: a thousand times too much
        "Friction (2)": ("V", steps * 10e-3 / 32768),
    }
    scan = answered(fields, PICOVIEW, module="mifile")
    assert [(c.name, c.unit, c.direction) for c in scan.channels] == [
        ("Deflection", "V", "trace"),
        ("Friction", None, "trace"),
        ("Friction", "V", "retrace"),
    ]


def test_confirmed():
    steps = np.array([-3.0, 4.0, 5.0])
    assert confirmed(Statement("a", "mV", full_scale=10.0), steps * 10 / 32768, (1e-3, "V"))
    assert confirmed(Statement("a", "mV", full_scale=10.0), steps * 10e-3 / 32768, (1.0, "V"))
    assert not confirmed(Statement("a", "mV", full_scale=10.0), steps * 10e-6 / 32768, (1.0, "V"))
    assert not confirmed(Statement("a", "V", full_scale=10.0), steps * 1e5, (1.0, "V"))
    assert not confirmed(Statement("a", "V", full_scale=10.0), np.ones(3) * 10 / 32768, (1.0, "V"))
    assert confirmed(Statement("a", "nm", span=8.0), steps * 1e-9, (1.0, "m"))
    assert not confirmed(Statement("a", "um", span=8.0), steps * 1e-9, (1.0, "m"))
    assert not confirmed(Statement("a", "m"), np.full(3, np.nan), (1.0, "m"))
    assert not confirmed(Statement("a", "deg"), steps, (1.0, "rad"))


def test_headers_that_say_nothing_usable():
    for statements in (gwyddion_units.of_nanonis, gwyddion_units.of_agilent, gwyddion_units.of_wsxm):
        for header in (
            b"",
            b"\xff" * 5000,
            SXM % b"V" if statements is not gwyddion_units.of_nanonis else HEAD,
        ):
            assert statements(header) == []
    assert gwyddion_units.of_nanonis(SXM.replace(b"\tboth", b"\tup") % b"V") == [
        Statement("Amplitude", "V", "trace")
    ]
    assert gwyddion_units.of_agilent(PICOVIEW.replace(b"1.0e+001", b"many")) == []


def test_pixels_that_gwyddion_marks_are_no_values(answered):
    mask = np.zeros((2, 3))
    mask[0, 1] = 1.0
    scan = answered(SXM_FIELDS, SXM % b"V", masks={"Amplitude (Forward)": mask})
    assert np.argwhere(np.isnan(scan.channels[2].values)).tolist() == [[0, 1]]
    assert np.isfinite(scan.channels[0].values).all()
    assert "Amplitude: 1 pixels are marked as invalid; they are NaN" in scan.notes
    with pytest.raises(FileFormatError, match="mask of"):
        answered(SXM_FIELDS, masks={"Z (Forward)": np.zeros((3, 3))})


def test_size_without_the_metre(answered):
    scan = answered(SXM_FIELDS, xy="s")
    assert dict(scan.coords) == {}
    assert "there is no usable image size, so there are no coordinates" in scan.notes
    assert answered(SXM_FIELDS).coords["y"].tolist() == pytest.approx([0.75e-9, 0.25e-9])


def test_images_of_another_shape_are_left_out(answered):
    scan = answered({"Height": ("m", VALUES), "Phase": ("deg", np.zeros((4, 4)))})
    assert [c.name for c in scan.channels] == ["Height"]
    assert "Phase: left out, its pixels are not those of Height" in scan.notes
    with pytest.raises(FileFormatError, match="expected an image, got none; curves"):
        answered({})


# --- what the helper must not do ------------------------------------------------------------------


def test_a_helper_that_hangs_is_killed(run_helper, tmp_path):
    begun = time.monotonic()
    with pytest.raises(FileFormatError, match=r"opens in 4 s, got no end"):
        run_helper(f'echo $$ > "{tmp_path}/pid"; exec sleep 60')
    assert 3.5 < time.monotonic() - begun < 5.0
    with pytest.raises(ProcessLookupError):
        os.kill(int((tmp_path / "pid").read_text()), 0)


@pytest.mark.skipif(not hasattr(os, "fork"), reason="limits need a POSIX system")
def test_a_helper_that_takes_all_memory_is_stopped(run_helper, monkeypatch):
    import sys

    command = f'exec "{sys.executable}" -c "x = bytearray(600 << 20)"'
    with pytest.raises(FileFormatError, match=r"got (Traceback|status -)"):
        run_helper(command)
    monkeypatch.setattr(gwyddion_bridge, "_bounded", lambda command, size: command)
    with pytest.raises(FileFormatError, match=r"got status 0"):  # it would have had it
        run_helper(command)


@pytest.mark.skipif(not hasattr(os, "fork"), reason="limits need a POSIX system")
def test_a_helper_that_never_stops_writing_is_stopped(run_helper, monkeypatch):
    monkeypatch.setattr(gwyddion_bridge, "_LARGEST_ANSWER", 1 << 20)
    begun = time.monotonic()
    with pytest.raises(FileFormatError, match="got status"):
        run_helper("exec yes")
    assert time.monotonic() - begun < 3.5


@pytest.mark.parametrize(
    ("script", "message"),
    [
        ("echo cannot load it >&2; exit 1", "got cannot load it"),
        ("kill -5 $$", "got status -5"),
        ('echo {} ; touch "$2"', "takes for ''"),
        ('echo nonsense; touch "$2"', "takes for ''"),
        ("""echo '{"module": "pngfile"}'; touch "$2" """, "takes for 'pngfile'"),
        (
            """echo '{"module": "nanonis"}'; echo GWYPrubbish > "$2" """,
            "a Nanonis scan that Gwyddion reads, got",
        ),
    ],
)
def test_answers_that_are_none(run_helper, script, message):
    with pytest.raises(FileFormatError, match=message):
        run_helper(script)


def test_answers_that_are_too_large(answered, monkeypatch):
    monkeypatch.setattr(gwyddion_bridge, "_LARGEST_ANSWER", 100)
    monkeypatch.setattr(gwyddion_bridge, "_bounded", lambda command, size: command)
    with pytest.raises(FileFormatError, match="pixels that fit the size of the file"):
        answered(SXM_FIELDS)


def test_nothing_is_left_behind(answered, tmp_path, monkeypatch):
    folder = tmp_path / "temporary"
    folder.mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(folder))
    answered(SXM_FIELDS)
    with pytest.raises(FileFormatError):
        answered({})
    assert list(folder.iterdir()) == []


def test_numbers_have_a_decimal_point_everywhere(answered, run_helper, tmp_path, monkeypatch):
    monkeypatch.setenv("LC_ALL", "de_DE.UTF-8")
    with pytest.raises(FileFormatError, match="got numeric C all none"):
        run_helper('echo "numeric $LC_NUMERIC all ${LC_ALL-none}" >&2; exit 1')


# --- without the library --------------------------------------------------------------------------


@pytest.mark.parametrize("lacking", ["gwyddionpy", "gwyddionpy_converter"])
@pytest.mark.parametrize(
    ("head", "what"),
    [
        (b":NANONIS_VERSION:\n2\n", "a Nanonis scan"),
        (b"\x01\xb0\x93\xff" + b"\0" * 40, "an NT-MDT file"),
        (b"WSxM file copyright Nanotec\n", "a WSxM file"),
        (b"fileType      Image\n", "an Agilent or Keysight file"),
        (b"\xaa\0" + "STiMage 005.".encode("utf-16-le"), "an RHK SM4 file"),
        (b"ISO/TC 201 SPM data transfer format\n", "an ISO 28600 file"),
    ],
)
def test_the_message_says_what_to_install(tmp_path, monkeypatch, lacking, head, what):
    found = gwyddion_bridge.find_spec
    monkeypatch.setattr(gwyddion_bridge, "find_spec", lambda name: None if name == lacking else found(name))
    path = tmp_path / "scan.dat"
    path.write_bytes(head)
    with pytest.raises(
        FileFormatError, match=rf'is {what}, .*none installed.*pip install "overtone\[formats\]"'
    ):
        read_channels(path)


def test_other_files_are_none_of_its_business():
    for head in (
        b"",
        b"GWYP",
        b"[DataSet]\r\n",
        b"\x89HDF\r\n\x1a\n",
        b"II*\0",
        b"z [nm], A1 [nm]\n",
        b"\x05\0",
    ):
        assert gwyddion_bridge.family_of(head) is None
