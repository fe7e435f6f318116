import math

import numpy as np
import pytest

from overtone.errors import ChannelError, FileFormatError, OvertoneError
from overtone.io.nanosurf_settings import number, parameter, quantity_of
from overtone.io.observables import open_scan
from overtone.io.recording import Recording
from overtone.io.registry import read_channels

INFO = {
    "Image size": "2µm",
    "Setpoint": "65 %",
    "Vibration freq.": "170.147kHz",
    "Vibration ampl.": "500mV",
    "Excitation ampl.": "1.33 V",
    "Ref. phase": "0.353k",
    "Measurement environment": "Air",
    "Op. mode": "Phase Contrast",
    "Scan head": "53-13-029.hed",
}
FEEDBACK = {
    "RefFrq": "D[170147]*[Hz]",
    "RefAmplitude": "D[1.32567]*[V]",
    "RefPhase": "D[353.382]*[]",
    "DynamicAmp": "D[0.500063]*[V]",
}
LEVER = {
    "Name": "NCLR",
    "Manufacturer": "Nanosensors",
    "Prop0": "D[24.075]*[N/m]",
    "Prop1": "D[170037]*[Hz]",
    "Prop4": "D[546.786]*[]",
    "Prop5": "D[65000]*[Hz]",
    "Prop6": "D[5.1234]*[]",
    "Prop10": "D[2000]*[]",
    "Prop11": "D[171000]*[Hz]",
}
INPUTS = {
    "In0": "0,Channel0,Amplitude,V,2.5,0",
    "In5": "5,TipSignalDC,Deflection,m,5.84e-06,0",
    "In15": "16,TipSignalDC1,Deflection,V,10,0",
}
SECOND = ("2nd scan forward", "2nd scan backward")


def entries(title, lines):
    return f"[{title}]\n" + "".join(f"{key}={value}\n" for key, value in lines.items()) + "\n"


def nid(frames, *, info=INFO, feedback=FEEDBACK, lever=LEVER, inputs=INPUTS, encoding="latin-1", **change):
    """A Nanosurf file: frames are {group: {channel: (unit, minimum, span, numbers)}}, numbers as stored."""
    table, sets, data = {"Version": "2", "GroupCount": len(frames)}, [], b""
    for g, (group, channels) in enumerate(frames.items()):
        table[f"Gr{g}-Name"] = group
        for c, (name, (unit, minimum, span, numbers)) in enumerate(channels.items()):
            key = f"DataSet-{g}:{c}"
            table[f"Gr{g}-Ch{c}"] = key
            section = {
                "Version": "2",
                "Points": numbers.shape[1],
                "Lines": numbers.shape[0],
                "Frame": group,
                "CurLine": numbers.shape[0] - 1,
                "Dim0Name": "X*",
                "Dim0Unit": "m",
                "Dim0Range": "2e-006",
                "Dim0Min": "0",
                "Dim1Unit": "m",
                "Dim1Range": "2e-006",
                "Dim1Min": "0",
                "Dim2Name": name.rstrip("*"),
                "Dim2Unit": unit,
                "Dim2Range": span,
                "Dim2Min": minimum,
                "SaveMode": "Binary",
                "SaveBits": 8 * numbers.dtype.itemsize,
                "SaveSign": "Signed",
                "SaveOrder": "Intel",
                **change,
            }
            sets.append((key, {k: v for k, v in section.items() if v is not None}))
            data += numbers.tobytes()
    text = entries("DataSet", table)
    text += entries("DataSet-Info", {"-- Scan --": "--------", **info}) if info else ""
    text += entries("DataSet\\DataSetInfos\\Scan", {"SubSectionCount": 0, **info}) if info else ""
    text += entries("DataSet\\Calibration\\Scanhead", inputs) if inputs else ""
    text += entries("DataSet\\Calibration\\Cantilever", lever) if lever else ""
    text += entries("DataSet\\Parameters\\ZFeedback", feedback) if feedback else ""
    text += "".join(entries(key, section) for key, section in sets)
    return (text + "\n").replace("\n", "\r\n").encode(encoding) + b"#!" + data


def plain(lines=4, points=3, item="<i2", shift=0):
    """Amplitude and phase of a small image whose numbers differ from one another."""
    steps = np.arange(lines * points).reshape(lines, points) + shift
    full = 2 ** (8 * np.dtype(item).itemsize - 1)
    return {
        "Amplitude": ("V", -10, 20, (steps * (full // 100)).astype(item) + 1),
        "Phase": ("°", -180, 360, (-steps * (full // 50)).astype(item)),
    }


BOTH = {"Scan forward": plain(), "Scan backward": plain(shift=1)}


@pytest.fixture
def read_nid(tmp_path):
    def read(frames, **arguments):
        path = tmp_path / "scan.nid"
        path.write_bytes(nid(frames, **arguments))
        return read_channels(path)

    return read


def channel(recording, name, direction="trace"):
    return next(c for c in recording.channels if (c.name, c.direction) == (name, direction))


# --- synthetic files ------------------------------------------------------------------------------


@pytest.mark.parametrize(("item", "full"), [("<i2", 65536.0), ("<i4", 4294967296.0)])
def test_numbers_become_values_and_the_first_line_is_the_bottom(read_nid, item, full):
    frames = {"Scan forward": plain(item=item), "Scan backward": plain(item=item, shift=2)}
    scan = read_nid(frames)
    assert (scan.format, scan.vendor, scan.dims) == ("nanosurf", "nanosurf", ("y", "x"))
    assert [(c.name, c.unit, c.direction, c.nap) for c in scan.channels] == [
        ("Amplitude", "V", "trace", False),
        ("Phase", "rad", "trace", False),
        ("Amplitude", "V", "retrace", False),
        ("Phase", "rad", "retrace", False),
    ]
    for direction, frame in (("trace", "Scan forward"), ("retrace", "Scan backward")):
        numbers = {name: stored[3] for name, stored in frames[frame].items()}
        amplitude, phase = (channel(scan, name, direction).values for name in ("Amplitude", "Phase"))
        assert amplitude.shape == (4, 3)
        assert amplitude.dtype == np.float64
        for row in range(4):
            for column in range(3):  # backward lines run from left to right as well
                n = numbers["Amplitude"][3 - row, column]
                assert amplitude[row, column] == pytest.approx((n + full / 2) / full * 20 - 10, rel=1e-12)
                n = numbers["Phase"][3 - row, column]
                expected = math.radians((n + full / 2) / full * 360 - 180)
                assert phase[row, column] == pytest.approx(expected, rel=1e-12, abs=1e-12)


def test_pixels_need_not_be_square(read_nid):
    scan = read_nid({"Scan forward": plain(lines=4, points=8)}, Dim1Range="1e-6")
    assert channel(scan, "Amplitude").values.shape == (4, 8)
    np.testing.assert_allclose(scan.coords["x"], (np.arange(8) + 0.5) * 0.25e-6, rtol=1e-12)
    np.testing.assert_allclose(scan.coords["y"], [0.875e-6, 0.625e-6, 0.375e-6, 0.125e-6], rtol=1e-12)


def test_unit_of_the_scan_size(read_nid):
    scan = read_nid(BOTH, Dim0Unit="µm", Dim0Range="2", Dim1Unit="nm", Dim1Range="4000")
    np.testing.assert_allclose(scan.coords["x"], np.array([1, 3, 5]) * 1e-6 / 3, rtol=1e-12)
    np.testing.assert_allclose(scan.coords["y"], [3.5e-6, 2.5e-6, 1.5e-6, 0.5e-6], rtol=1e-12)
    assert not any("Image size" in note for note in scan.notes)
    other = read_nid(BOTH, Dim0Range="2")
    assert not other.coords
    assert "the file states no usable image size, so there are no coordinates" in other.notes
    other = read_nid(BOTH, Dim0Range="3e-6", Dim1Range="3e-6")
    assert "Image size 2e-06 m and the 3e-06 m of the data disagree; the data were believed" in other.notes


@pytest.mark.parametrize(
    "change",
    [{"Dim0Unit": "s"}, {"Dim0Unit": ""}, {"Dim1Range": "0"}, {"Dim1Range": "nan"}, {"Dim0Range": None}],
)
def test_no_usable_size_no_coordinates(read_nid, change):
    scan = read_nid(BOTH, **change)
    assert dict(scan.coords) == {}
    assert "the file states no usable image size, so there are no coordinates" in scan.notes


@pytest.mark.parametrize("name", ["scan.ibw", "scan.csv", "scan"])
def test_content_decides_not_the_name(tmp_path, name):
    (tmp_path / name).write_bytes(nid(BOTH))
    assert read_channels(tmp_path / name).format == "nanosurf"
    (tmp_path / name).write_bytes(b"\xef\xbb\xbf" + nid(BOTH, encoding="utf-8"))
    assert read_channels(tmp_path / name).format == "nanosurf"


@pytest.mark.parametrize("encoding", ["latin-1", "utf-8"])
def test_degrees_in_either_encoding(read_nid, encoding):
    scan = read_nid(BOTH, encoding=encoding)
    assert channel(scan, "Phase").unit == "rad"
    assert scan.metadata["Image size"] == "2µm"


def test_units_that_are_not_known_stay_away(read_nid):
    scan = read_nid({"Scan forward": {**plain(), "User": ("arb", 0, 1, np.ones((4, 3), "<i2"))}})
    assert channel(scan, "User").unit is None
    assert "User: the unit 'arb' is not known; values are as in the file" in scan.notes


def test_second_scan_is_another_pass(read_nid):
    scan = read_nid(BOTH | dict.fromkeys(SECOND, plain(shift=3)))
    assert [(c.name, c.direction, c.nap) for c in scan.channels if c.name == "Phase"] == [
        ("Phase", "trace", False),
        ("Phase", "retrace", False),
        ("Phase", "trace", True),
        ("Phase", "retrace", True),
    ]


def test_a_name_that_comes_twice(read_nid):
    numbers = np.arange(12, dtype="<i2").reshape(4, 3)
    scan = read_nid(
        {"Scan forward": {"Amplitude": ("V", -1, 2, numbers), "Amplitude*": ("V", -1, 2, numbers + 1)}}
    )
    assert [c.name for c in scan.channels] == ["Amplitude", "Amplitude (Ch1)"]
    assert scan.channels[1].values[3, 0] == pytest.approx(2 / 65536, rel=1e-12)


def test_curves_are_left_out_and_named(read_nid):
    curve = {"Deflection": ("m", -1e-6, 2e-6, np.zeros((2, 5), "<i4"))}
    scan = read_nid({"Spec forward": curve, "Scan forward": plain()})
    assert [c.name for c in scan.channels] == ["Amplitude", "Phase"]
    assert channel(scan, "Amplitude").values[3, 1] == pytest.approx(20 * (327 + 1) / 65536, rel=1e-12)
    assert "left out, because they are no images: Spec forward" in scan.notes
    with pytest.raises(FileFormatError, match=r"holds no image.*got Spec forward.*table"):
        read_nid({"Spec forward": curve})


def test_images_of_another_shape_are_left_out(read_nid):
    scan = read_nid({"Scan forward": plain(), "Scan backward": plain(lines=5)})
    assert {c.direction for c in scan.channels} == {"trace"}
    assert "Scan backward Phase: left out, its pixels are not those of Amplitude" in scan.notes


# --- what is no value -----------------------------------------------------------------------------


def test_amplitude_below_zero_is_a_marker_for_every_channel(read_nid):
    forward, backward = plain(), plain()
    forward["Amplitude"][3][0, 2] = -10923
    forward["Topography"] = ("m", -1e-5, 2e-5, np.full((4, 3), 100, "<i2"))
    scan = read_nid({"Scan forward": forward, "Scan backward": backward})
    for name in ("Amplitude", "Phase", "Topography"):
        values = channel(scan, name).values
        assert np.argwhere(np.isnan(values)).tolist() == [[3, 2]]
    assert not np.isnan(channel(scan, "Phase", "retrace").values).any()
    assert [note for note in scan.notes if "NaN" in note] == [
        "Scan forward: 1 pixels have an amplitude below zero, where the electronics stopped; they are NaN in all "
        "channels"
    ]


def test_an_amplitude_that_is_negative_throughout_is_no_marker(read_nid):
    frame = plain()
    frame["Amplitude"] = ("V", -10, 20, np.full((4, 3), -5000, "<i2") + np.arange(3, dtype="<i2"))
    assert not np.isnan(channel(read_nid({"Scan forward": frame}), "Amplitude").values).any()


@pytest.mark.parametrize("item", ["<i2", "<i4"])
def test_ends_of_the_converter_are_no_values(read_nid, item):
    limits = np.iinfo(item)
    numbers = np.arange(12, dtype=item).reshape(4, 3)
    numbers[0, 0], numbers[2, 1] = limits.min, limits.max
    frame = {"Z-Axis": ("m", -1e-5, 2e-5, numbers), "Phase": ("°", -180, 360, numbers)}
    scan = read_nid({"Scan forward": frame})
    height, phase = (channel(scan, name).values for name in ("Z-Axis", "Phase"))
    assert np.argwhere(np.isnan(height)).tolist() == [[1, 1], [3, 0]]
    assert np.isfinite(phase).all()  # it passes through the ends of its range
    assert phase[3, 0] == pytest.approx(-math.pi, rel=1e-12)
    assert [note for note in scan.notes if "NaN" in note] == [
        "Scan forward, Z-Axis: 2 pixels sit at an end of the converter's range; they are NaN"
    ]


@pytest.mark.parametrize("rest", [0, -32768, 32767])
def test_lines_that_were_never_scanned(read_nid, rest):
    frame = plain(lines=6)
    for stored in frame.values():
        stored[3][4:] = rest
    scan = read_nid({"Scan forward": frame}, CurLine="3")
    for c in scan.channels:
        assert np.isnan(c.values).all(axis=1).tolist() == [True, True, False, False, False, False]
        assert np.isfinite(c.values[2:]).all()
    assert "Scan forward: 2 of 6 lines were not recorded; they are NaN" in scan.notes
    assert any(note.startswith("the file was stored at line 4 of 6") for note in scan.notes)


def test_a_channel_at_rest_alone_is_not_an_unscanned_line(read_nid):
    frame = {**plain(), "User": ("V", -10, 20, np.zeros((4, 3), "<i2"))}
    scan = read_nid({"Scan forward": frame})
    assert channel(scan, "User").values.tolist() == [[0.0] * 3] * 4
    assert not np.isnan(channel(scan, "Amplitude").values).any()


# --- settings -------------------------------------------------------------------------------------


def test_facts(read_nid):
    scan = read_nid(BOTH)
    told = {name: (fact.value, fact.unit, fact.key) for name, fact in scan.facts.items()}
    sensitivity = (pytest.approx(584e-9, rel=1e-12), "m/V", "TipSignalDC / TipSignalDC1")
    assert told == {
        "stiffness": (24.075, "N/m", "Prop0"),
        "drive_frequency": (170147.0, "Hz", "RefFrq"),
        "drive_amplitude": (1.32567, "V", "RefAmplitude"),
        "free_amplitude_volts": (0.500063, "V", "DynamicAmp"),
        "setpoint_fraction": (0.65, "1", "Setpoint"),
        "deflection_sensitivity": sensitivity,
        "scale:Amplitude": sensitivity,
        "free_amplitude": (
            pytest.approx(0.500063 * 584e-9, rel=1e-12),
            "m",
            "DynamicAmp x TipSignalDC / TipSignalDC1",
        ),
    }
    assert not any(fact.factory_default for fact in scan.facts.values())
    (resonance,) = scan.resonances
    assert (resonance.source, resonance.frequency, resonance.quality_factor) == ("nominal", 170037.0, 546.786)
    assert (resonance.keys, resonance.factory_default) == (("Prop1", "Prop4"), False)
    assert not any("catalogue" in note or "driven" in note for note in scan.notes)
    assert any("353.382 deg (RefPhase)" in note for note in scan.notes)


def test_numbers_of_a_catalogue_are_told_by_their_digits(read_nid):
    lever = {**LEVER, "Prop0": "D[48]*[N/m]", "Prop1": "D[190000]*[Hz]", "Prop4": "D[500]*[]"}
    scan = read_nid(BOTH, lever=lever)
    assert scan.facts["stiffness"].factory_default
    assert scan.resonances[0].factory_default
    text = " ".join(scan.notes)
    assert "48 N/m (Prop0) is a round number as in the catalogue of Nanosensors NCLR" in text
    assert "the resonance of 190 kHz with Q 500 (Prop1, Prop4) is of the catalogue" in text
    assert "driven at 170.147 kHz, 10 % off that resonance" in text
    assert read_nid(BOTH, lever={**LEVER, "Prop4": "D[500]*[]"}).resonances[0].factory_default


@pytest.mark.parametrize(
    ("environment", "pair"),
    [("Air", (170037.0, 546.786)), ("Liquid", (65000.0, 5.1234)), ("Vacuum", (171000.0, 2000.0))],
)
def test_resonance_of_the_environment(read_nid, environment, pair):
    (found,) = read_nid(BOTH, info={**INFO, "Measurement environment": environment}).resonances
    assert (found.frequency, found.quality_factor) == pair
    assert not read_nid(BOTH, info={**INFO, "Measurement environment": "Mercury"}).resonances


def test_without_a_quality_factor_there_is_no_resonance(read_nid):
    scan = read_nid(BOTH, lever={k: v for k, v in LEVER.items() if k != "Prop4"})
    assert scan.resonances == ()
    assert (
        "the file holds no resonance with a quality factor, only a resonance frequency, Prop1 D[170037]*[Hz]"
        in scan.notes
    )


def test_parameters_that_another_mode_left_do_not_count(read_nid):
    info = {**INFO, "Excitation ampl.": "1.3 V"}
    facts = read_nid(BOTH, info=info).facts
    assert (facts["drive_amplitude"].value, facts["drive_amplitude"].key) == (1.3, "Excitation ampl.")
    contact = {"Op. mode": "Lateral Force", "Setpoint": "20nN", "Scan head": "79-16-002.hed"}
    scan = read_nid({"Scan forward": plain()}, info=contact)
    assert not {"drive_frequency", "free_amplitude", "setpoint_fraction", "drive_amplitude"} & set(scan.facts)
    assert "the file says Lateral Force, and nothing of a vibration" in scan.notes


def test_old_files_have_infos_only(read_nid):
    info = {k: v for k, v in INFO.items() if k != "Setpoint"} | {
        "Set point": "61 %",
        "Vibration ampl.": "0.58 V",
    }
    facts = read_nid(BOTH, info=info, feedback={}, lever={}, inputs={}).facts
    assert {name: fact.value for name, fact in facts.items()} == {
        "drive_frequency": 170147.0,
        "drive_amplitude": 1.33,
        "free_amplitude_volts": 0.58,
        "setpoint_fraction": 0.61,
    }
    assert not read_nid(BOTH, info={}, feedback=FEEDBACK, lever={}, inputs={}).facts


def test_scan_heads_without_calibration(read_nid):
    facts = read_nid(BOTH, info={**INFO, "Scan head": "Uncal_EZ2-AFM 110u.hed"}).facts
    assert facts["deflection_sensitivity"].factory_default
    assert facts["free_amplitude"].factory_default
    assert facts["scale:Amplitude"].factory_default


@pytest.mark.parametrize(
    "change",
    [
        {"In5": "5,TipSignalDC,Deflection,V,10,0"},
        {"In15": "16,TipSignalDC1,Deflection,N,1,0"},
        {"In15": "16,TipSignalDC1,Deflection,V,0,0"},
        {"In5": "5,TipSignalDC,Deflection,m,many,0"},
        {"In5": "5,TipSignalDC"},
    ],
)
def test_sensitivity_needs_the_same_full_scale_in_both_units(read_nid, change):
    assert not {"deflection_sensitivity", "scale:Amplitude", "free_amplitude"} & set(
        read_nid(BOTH, inputs={**INPUTS, **change}).facts
    )


def test_texts_of_settings():
    assert quantity_of("0.346k", "1") is None
    assert quantity_of("-1.84µm", "m") == pytest.approx(-1.84e-6)
    assert quantity_of("1e999 V", "V") is None
    assert quantity_of("9" * 100 + " V", "V") is None
    assert quantity_of("", "V") is None
    assert math.isnan(number("1 V"))
    assert math.isnan(number("inf"))
    assert parameter({"a": "D[1e-008]*[m]"}, "a", "m") == pytest.approx(1e-8)
    assert parameter({"a": "D[3]*[]"}, "a", "1") == 3.0
    for text in ("D[3]*[]", "D[x]*[m]", "3 m", "S[<a>]*[]"):
        assert parameter({"a": text}, "a", "m") is None


def test_the_header_is_kept(read_nid):
    scan = read_nid(BOTH, lever={**LEVER, "Long": "x" * 2000}, LineDim7Points="1024")
    assert scan.metadata["Op. mode"] == "Phase Contrast"
    assert scan.metadata["Calibration\\Cantilever\\Prop0"] == "D[24.075]*[N/m]"
    assert scan.metadata["DataSet-1:1\\Dim2Name"] == "Phase"
    assert not any("LineDim" in key or "Long" in key or key.startswith("--") for key in scan.metadata)


# --- trace and retrace ----------------------------------------------------------------------------


def test_trace_and_retrace_are_not_chosen_silently(tmp_path):
    path = tmp_path / "scan.nid"
    path.write_bytes(nid(BOTH))
    with pytest.raises(ChannelError, match=r"Amplitude 2 times.*--direction trace or --direction retrace"):
        open_scan(path)


# --- damage ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ({"Points": "0"}, "Points of"),
        ({"Points": "-3"}, "Points of"),
        ({"Lines": "9" * 5000}, "Lines of"),
        ({"Lines": "1000000"}, "24000000 bytes of data"),
        ({"Lines": "3"}, "72 bytes of data for 4 data sets, got 96"),
        ({"Lines": None}, "Lines of"),
        ({"SaveBits": "8"}, "16 or 32 bits.*Binary 8"),
        ({"SaveSign": "Unsigned"}, "signed numbers"),
        ({"SaveOrder": "Motorola"}, "Intel order"),
        ({"SaveMode": "Ascii"}, "signed numbers"),
        ({"Dim2Range": "1e300"}, "Dim2Range of"),
        ({"Dim2Min": "nan"}, "Dim2Min of"),
        ({"Dim2Min": None}, "Dim2Min of"),
    ],
)
def test_every_size_in_the_header_is_checked(read_nid, change, expected):
    with pytest.raises(FileFormatError, match=rf"not a whole Nanosurf file: expected .*{expected}"):
        read_nid(BOTH, **change)


def test_headers_that_end_or_lead_nowhere(tmp_path):
    path = tmp_path / "scan.nid"
    whole = nid(BOTH)
    for content, expected in (
        (whole.replace(b"\n#!", b"\n!!"), "a line '#!'"),
        (whole.replace(b"-Ch", b"-XX"), "channels in its section"),
        (whole.replace(b"[DataSet-1:1]", b"[DataSet-9:1]"), r"a section \[DataSet-1:1\]"),
        (whole + b"\0", r"96 bytes of data for 4 data sets, got 97"),
        (whole[:-1], r"96 bytes of data for 4 data sets, got 95"),
    ):
        path.write_bytes(content)
        with pytest.raises(FileFormatError, match=expected):
            read_channels(path)
    many = "".join(f"Gr0-Ch{i}=DataSet-0:0\r\n" for i in range(2000))
    path.write_bytes(b"[DataSet]\r\n" + many.encode() + whole[whole.find(b"Gr0-Name") :])
    with pytest.raises(FileFormatError, match="at most 1000 data sets"):
        read_channels(path)


def survives(path):
    try:
        scan = read_channels(path)
    except OvertoneError as error:
        scan = str(error)
    if isinstance(scan, str):
        assert len(scan) < 1000
        return False
    assert isinstance(scan, Recording)
    assert len({c.values.shape for c in scan.channels}) == 1
    return True


@pytest.mark.parametrize("item", ["<i2", "<i4"])
def test_damaged_files_give_an_error_or_values(tmp_path, item):
    path = tmp_path / "damaged.nid"
    content = nid({"Scan forward": plain(6, 5, item), "Scan backward": plain(6, 5, item, 1)})
    header = content.find(b"\n#!")
    cuts = {*np.linspace(1, header, 10, dtype=int), *np.linspace(header, len(content) - 1, 10, dtype=int)}
    for length in sorted(cuts):
        path.write_bytes(content[:length])
        assert not survives(path)  # cut short is never read as whole
    random = np.random.default_rng(11)
    read = 0
    for attempt in range(300):
        changed = bytearray(content)
        limit = len(content) if attempt % 3 == 0 else header
        for at in random.integers(0, limit, size=1 + attempt % 4):
            changed[at] = random.integers(0, 256)
        path.write_bytes(bytes(changed))
        read += survives(path)
    assert 50 < read < 300
    path.write_bytes(content)
    assert survives(path)


# --- real files -----------------------------------------------------------------------------------

# Row 0 at the top: four corners and one inside.
PIXELS = ((0, 0), (0, -1), (-1, 0), (-1, -1), (100, 37))
REAL = [
    (
        "NSFopen_MoS2.nid",
        "Amplitude",
        "trace",
        [0.124921798706, 0.124314296991, 0.125559214503, 0.126899946481, 0.125295706093],
    ),
    (
        "NSFopen_MoS2.nid",
        "Phase",
        "retrace",
        [-5.90790867805, -34.5648889616, -13.5241769627, 6.80484574288, 5.11449348181],
    ),
    (
        "NSFopen_grid1.nid",
        "Z-Axis",
        "trace",
        [9.69904211519e-07, 1.02129366084e-06, 7.18667154181e-07, 7.53667950488e-07, 8.6600952748e-07],
    ),
    (
        "NSFopen_circles_holes.nid",
        "Topography",
        "retrace",
        [-6.0771484375e-08, 1.04489746094e-07, -6.46162109375e-07, -4.0927734375e-08, -5.68647460938e-07],
    ),
    (
        "NanoSurf_20160301.nid",
        "Amplitude",
        "retrace",
        [0.0468444824219, 0.0502777099609, 0.0519561767578, 0.0514221191406, 0.0676727294922],
    ),
]


@pytest.mark.parametrize(("name", "label", "direction", "expected"), REAL)
def test_named_pixels_of_real_files(afm_data, name, label, direction, expected):
    values = channel(read_channels(afm_data / "nanosurf" / name), label, direction).values
    factor = math.radians(1.0) if label == "Phase" else 1.0
    for pixel, value in zip(PIXELS, expected, strict=True):
        assert values[pixel] == pytest.approx(factor * value, rel=1e-9)


def test_named_pixels_by_hand(afm_data):
    # Forward amplitude of 16 bits: its data set is the second of four, lines from the bottom.
    content = (afm_data / "nanosurf" / "NanoSurf_20160301.nid").read_bytes()
    start = 12917 + 2 + 2 * 128 * 128
    stored = int.from_bytes(content[start + 2 * (27 * 128 + 37) :][:2], "little", signed=True)
    scan = read_channels(afm_data / "nanosurf" / "NanoSurf_20160301.nid")
    assert channel(scan, "Amplitude").values[100, 37] == pytest.approx(stored * 5 / 65536, rel=1e-12)


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize(
    "name", ["NSFopen_MoS2", "NSFopen_grid1", "NSFopen_circles_holes", "NanoSurf_20160301"]
)
def test_every_channel_agrees_with_nsfopen(afm_data, name):
    nsfopen = pytest.importorskip("NSFopen.read")
    path = afm_data / "nanosurf" / f"{name}.nid"
    images = nsfopen.read(str(path)).data["Image"]
    scan = read_channels(path)
    assert len(scan.channels) == len(images)
    for c in scan.channels:
        other = images[{"trace": "Forward", "retrace": "Backward"}[c.direction]][c.name][::-1]
        values = np.degrees(c.values) if c.unit == "rad" else c.values
        there = np.isfinite(values)
        np.testing.assert_allclose(values[there], other[there], rtol=1e-9, atol=1e-16)
        assert there.mean() > 0.9998


@pytest.mark.parametrize(
    ("name", "volts", "fraction", "free"),
    [
        ("NSFopen_MoS2.nid", 0.25, 0.5, 34.825e-9),
        ("NSFopen_grid1.nid", 0.500063, 0.65, 0.500063 * 584e-9),
        ("NSFopen_circles_holes.nid", 0.58, 0.61, None),
        ("NanoSurf_20160301.nid", 0.100253, 0.5, 80.2024e-9),
    ],
)
def test_the_amplitude_sits_at_the_set_point(afm_data, name, volts, fraction, free):
    scan = read_channels(afm_data / "nanosurf" / name)
    assert scan.facts["free_amplitude_volts"].value == volts
    assert scan.facts["setpoint_fraction"].value == fraction
    for direction in ("trace", "retrace"):
        mean = np.nanmean(channel(scan, "Amplitude", direction).values)
        assert mean == pytest.approx(volts * fraction, rel=0.015)
    if free is None:
        assert "free_amplitude" not in scan.facts
    else:
        assert scan.facts["free_amplitude"].value == pytest.approx(free, rel=1e-9)


@pytest.mark.filterwarnings("ignore")
def test_sensitivity_and_where_nsfopen_is_wrong(afm_data):
    nsfopen = pytest.importorskip("NSFopen.read")
    found = {}
    for name in ("NSFopen_MoS2", "NSFopen_grid1", "NanoSurf_20160301"):
        path = afm_data / "nanosurf" / f"{name}.nid"
        theirs = nsfopen.read(str(path)).param["Tip"]["Sensitivity"]["Value"]
        scan = read_channels(path)
        found[name] = (scan.facts["deflection_sensitivity"].value, theirs)
        if name != "NanoSurf_20160301":
            # The force set-point stands in the file in metres and in volts.
            metres, volts = (
                float(scan.metadata[f"Parameters\\ZFeedback\\SetPointForce_{unit}"][2:].split("]")[0])
                for unit in ("m", "V")
            )
            assert found[name][0] == pytest.approx(metres / volts, rel=1e-4)
    assert found["NSFopen_MoS2"] == pytest.approx((139.3e-9, 139.3e-9), rel=1e-9)
    assert found["NSFopen_grid1"] == pytest.approx((584e-9, 584e-9), rel=1e-9)
    # It divides by the full scale of the amplitude, which is 2.5 V here, where that of the deflection is 10 V.
    assert found["NanoSurf_20160301"] == pytest.approx((800e-9, 3200e-9), rel=1e-9)


def test_real_file_with_invalid_pixels(afm_data):
    scan = read_channels(afm_data / "nanosurf" / "NSFopen_circles_holes.nid")
    assert [(c.name, c.direction, int(np.isnan(c.values).sum())) for c in scan.channels] == [
        ("Topography", "trace", 4),
        ("Amplitude", "trace", 4),
        ("Topography", "retrace", 8),
        ("Amplitude", "retrace", 8),
    ]
    forward = channel(scan, "Topography")
    assert np.argwhere(np.isnan(forward.values)).tolist() == [[217, 13], [217, 14], [252, 200], [252, 201]]
    assert np.nanmax(forward.values) < 0.16e-6  # 6.77 um with them
    assert np.nanmin(channel(scan, "Amplitude").values) > 0.0  # -3.33 V with them
    assert sum("amplitude below zero" in note for note in scan.notes) == 2


def test_real_file_with_pixels_that_are_not_square(afm_data):
    scan = read_channels(afm_data / "nanosurf" / "NSFopen_MoS2.nid")
    assert channel(scan, "Amplitude").values.shape == (256, 512)
    assert np.ptp(scan.coords["x"]) == pytest.approx(3.97339e-6 * 511 / 512, rel=1e-9)
    assert np.ptp(scan.coords["y"]) == pytest.approx(3.97339e-6 * 255 / 256, rel=1e-9)
    assert scan.coords["y"][0] > scan.coords["y"][-1]
    assert [c.name for c in scan.channels[:4]] == ["Z-Axis", "Amplitude", "Phase", "Z-Axis Sensor"]


def test_real_files_are_not_read_from_both_directions_at_once(afm_data):
    with pytest.raises(ChannelError, match="--direction trace or --direction retrace"):
        open_scan(afm_data / "nanosurf" / "NSFopen_MoS2.nid")


def test_real_lever_that_was_and_that_was_not_measured(afm_data):
    nominal, measured = (
        read_channels(afm_data / "nanosurf" / f"NSFopen_{name}.nid") for name in ("MoS2", "grid1")
    )
    assert (nominal.facts["stiffness"].value, nominal.facts["stiffness"].factory_default) == (48.0, True)
    assert (measured.facts["stiffness"].value, measured.facts["stiffness"].factory_default) == (24.075, False)
    assert nominal.resonances[0].factory_default
    assert not measured.resonances[0].factory_default
    assert any("172.823 kHz, 9 % off that resonance" in note for note in nominal.notes)
