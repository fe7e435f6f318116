"""NanoScope files: real ones against Gwyddion and against arithmetic by hand, made ones for every branch."""

import math
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from overtone.errors import FileFormatError, OvertoneError
from overtone.io import nanoscope
from overtone.io.ciao import parse_header, parse_value
from overtone.io.recording import Channel, Recording
from overtone.io.registry import read_channels

Made = Callable[..., bytes]
COUNTS = np.array([[-100, 200, 300], [1000, 2000, -3000]], dtype=np.int16)


def channel(recording: Recording, name: str) -> Channel:
    (found,) = [one for one in recording.channels if one.name == name]
    return found


def five(values: np.ndarray) -> list[float]:
    """The corners, row by row from the top, and one pixel inside."""
    return [float(values[at]) for at in ((0, 0), (0, -1), (-1, 0), (-1, -1), (100, 37))]


def opened(folder: Path, content: bytes, name: str = "made.spm") -> Recording:
    path = folder / name
    path.write_bytes(content)
    return read_channels(path)


# --- real files -------------------------------------------------------------------------------------

REAL = {
    "hystorian_test_nanonis.000": {
        "Height": ("m", "retrace", False),
        "ZSensor": ("m", "retrace", False),
        "AmplitudeActual": ("V", "retrace", False),
        "Phase": ("rad", "trace", False),
        "AmplitudeError": ("V", "trace", False),
    },
    "ST_di-3.di": {
        "ZSensor": ("m", "trace", False),
        "AmplitudeError": ("V", "retrace", False),
        "Phase": ("rad", "retrace", False),
        "Height": ("m", "retrace", False),
    },
    "ST_di-4.di": {
        "ZSensor": ("m", "retrace", True),
        "AmplitudeError": ("m", "retrace", False),
        "Phase": ("rad", "retrace", False),
    },
    "ST_di-5.di": {"ZSensor": ("m", "retrace", False), "PeakForceError": ("V", "retrace", False)},
    "nanoAFMr_kpg20080408.007": {"Height": ("m", "retrace", True), "Phase": ("rad", "retrace", True)},
}


@pytest.mark.parametrize("name", REAL)
def test_channels_of_real_files(afm_data: Path, name: str) -> None:
    recording = read_channels(afm_data / "bruker" / name)
    assert (recording.format, recording.vendor, recording.dims) == ("nanoscope", "bruker", ("y", "x"))
    assert {c.name: (c.unit, c.direction, c.flattened) for c in recording.channels} == REAL[name]
    assert not any(c.nap for c in recording.channels)
    assert all(np.isfinite(c.values).all() for c in recording.channels)


@pytest.mark.parametrize("name", REAL)
def test_every_pixel_as_gwyddion_has_it(afm_data: Path, name: str) -> None:
    """Gwyddion is right but for millivolts, which it calls volts."""
    gwyddion = pytest.importorskip("gwyddionpy")
    path = afm_data / "bruker" / name
    try:
        theirs = gwyddion.load(path)
    except gwyddion.ConverterNotFoundError as error:
        pytest.skip(str(error))
    assert len(theirs.channels) == len(REAL[name])
    recording = read_channels(path)
    for ours, other in zip(recording.channels, theirs.channels.values(), strict=True):
        factor = {"m": 1.0, "rad": math.pi / 180.0, "V": 1e-3 if "Amplitude" in ours.name else 1.0}[
            ours.unit or ""
        ]
        np.testing.assert_allclose(ours.values, np.asarray(other.data) * factor, rtol=1e-12, atol=0)
        rows, columns = ours.values.shape
        x, y = recording.coords["x"], recording.coords["y"]
        assert (x[1] - x[0]) * columns == pytest.approx(other.xreal)
        assert (y[0] - y[1]) * rows == pytest.approx(other.yreal)


def test_five_pixels_by_hand(afm_data: Path) -> None:
    """Counts at the places the header states, times the numbers the header states."""
    path = afm_data / "bruker" / "hystorian_test_nanonis.000"
    content, recording = path.read_bytes(), read_channels(path)
    for name, offset, scale in (
        ("AmplitudeActual", 1089536, 3999.939e-3),
        ("Phase", 1613824, math.radians(359.9945)),
        ("Height", 40960, 46.27417 * 21.65764e-9),
        ("ZSensor", 565248, 24.57563 * 79.05961e-9),
    ):
        counts = np.frombuffer(content, "<i2", 512 * 512, offset).reshape(512, 512)
        by_hand = [int(counts[511 - row, column]) * scale / 65536.0 for row, column in ((0, 0), (100, 37))]
        values = channel(recording, name).values
        assert [values[0, 0], values[100, 37]] == pytest.approx(by_hand, rel=1e-12)


@pytest.mark.parametrize(
    ("name", "wanted", "pixels"),
    [
        (
            "ST_di-3.di",
            "AmplitudeError",
            [-0.00242611026, -0.0009612889709, -4.577566528e-05, -4.577566528e-05, -0.005401528503],
        ),
        (
            "ST_di-4.di",
            "AmplitudeError",
            [1.067122131e-09, 4.730151291e-10, 7.416877224e-10, -3.689518007e-10, -7.719606907e-10],
        ),
        (
            "ST_di-5.di",
            "ZSensor",
            [-3.187303355e-07, -3.197734871e-07, -3.018076034e-07, -3.02540903e-07, -3.180472572e-07],
        ),
        (
            "nanoAFMr_kpg20080408.007",
            "Phase",
            [-0.01247655718, 0.02482958409, -0.007535346415, -0.0001588246317, 0.02952373431],
        ),
        (
            "hystorian_test_nanonis.000",
            "AmplitudeActual",
            [0.5486976869, 0.545462873, 0.5457680441, 0.5521156035, 0.5520545693],
        ),
        (
            "hystorian_test_nanonis.000",
            "Phase",
            [0.6612314911, 0.6797348516, 0.7551863789, 0.7494340388, 0.6793513623],
        ),
    ],
)
def test_five_pixels(afm_data: Path, name: str, wanted: str, pixels: list[float]) -> None:
    assert five(channel(read_channels(afm_data / "bruker" / name), wanted).values) == pytest.approx(
        pixels, rel=1e-9
    )


def test_the_amplitude_of_a_real_scan_is_its_setpoint(afm_data: Path) -> None:
    recording = read_channels(afm_data / "bruker" / "hystorian_test_nanonis.000")
    setpoint = recording.facts["setpoint_volts"]
    assert (setpoint.value, setpoint.key) == (pytest.approx(0.55), "@2:TMSetAmplitude")
    assert channel(recording, "AmplitudeActual").values.mean() == pytest.approx(0.55, rel=1e-3)
    # The same amplitude the other way, of which only the difference is stored.
    offset = recording.facts["offset:AmplitudeError"]
    assert (offset.value, offset.unit) == (pytest.approx(0.55), "V")
    whole = channel(recording, "AmplitudeError").values + offset.value
    assert whole.mean() == pytest.approx(0.55, rel=1e-3)
    assert whole.std() == pytest.approx(channel(recording, "AmplitudeActual").values.std(), rel=0.05)
    assert recording.facts["drive_frequency"].value == pytest.approx(271731.4)
    assert recording.facts["drive_amplitude"].value == pytest.approx(0.6137085)
    assert recording.facts["drive_phase"].value == pytest.approx(math.radians(-54.52515))
    assert "amplitude_sensitivity" not in recording.facts
    assert any("no calibration of amplitudes" in note for note in recording.notes)


def test_a_calibrated_scan_has_metres(afm_data: Path) -> None:
    facts = read_channels(afm_data / "bruker" / "ST_di-4.di").facts
    assert facts["amplitude_sensitivity"].value == pytest.approx(62e-9)
    assert facts["amplitude_sensitivity"].key == "@Sens. AmplSens"
    assert facts["offset:AmplitudeError"].value == pytest.approx(0.2468933 * 62e-9)
    assert facts["offset:AmplitudeError"].unit == "m"
    assert facts["setpoint_amplitude"].value == pytest.approx(15.307e-9, rel=1e-4)


def test_a_sensitivity_of_one_without_unit_is_none(afm_data: Path) -> None:
    facts = read_channels(afm_data / "bruker" / "ST_di-3.di").facts
    assert "amplitude_sensitivity" not in facts
    assert not any(name.startswith("scale:") for name in facts)  # the deflection's is not the amplitude's
    assert facts["deflection_sensitivity"].value == pytest.approx(66.5215e-9)


def test_a_scan_that_does_not_tap_has_no_drive(afm_data: Path) -> None:
    assert not read_channels(afm_data / "bruker" / "ST_di-5.di").facts


def test_realtime_planefit_is_not_in_the_data(afm_data: Path) -> None:
    """The phase was shown with each line's mean subtracted; in the file the means of the lines differ."""
    recording = read_channels(afm_data / "bruker" / "hystorian_test_nanonis.000")
    assert recording.metadata["image 4: Realtime Planefit"] == "Offset"
    means = np.degrees(channel(recording, "Phase").values.mean(axis=1))
    assert means.mean() == pytest.approx(39.96, abs=0.01)
    assert means.std() > 3.0


def test_a_truncated_file_says_so(afm_data: Path) -> None:
    with pytest.raises(FileFormatError, match=r"expected 565248 bytes .* got 489346: it was cut off"):
        read_channels(afm_data / "bruker" / "ST_di_corrupted.di")


def survives(path: Path) -> None:
    try:
        recording = read_channels(path)
    except OvertoneError as error:
        message = str(error)
    else:
        assert len({c.values.shape for c in recording.channels}) == 1
        return
    assert len(message) < 1000
    assert "beyond reading" not in message  # every kind of damage has its own message


@pytest.mark.parametrize("name", [*REAL, "ST_di_corrupted.di"])
def test_damaged_real_files(afm_data: Path, tmp_path: Path, name: str) -> None:
    content = (afm_data / "bruker" / name).read_bytes()
    header = content.index(b"\x1a")
    random = np.random.default_rng(sum(name.encode()))
    path = tmp_path / "damaged.spm"
    # The lists of the images are what the sizes hang on; they stand last.
    lists = content.find(b"\\*Ciao image list")
    for attempt in range(60):
        changed = bytearray(content)
        if attempt % 4 == 0:
            changed = changed[: random.integers(20, len(content))]
        for at in random.integers(lists if attempt % 2 else 0, header, size=1 + attempt % 5):
            if at < len(changed):
                changed[at] = random.integers(0, 256)
        path.write_bytes(bytes(changed))
        survives(path)


# --- made files -------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", [np.int16, np.int32])
def test_counts_of_both_sizes(tmp_path: Path, nanoscope_file: Made, kind: type) -> None:
    counts = COUNTS.astype(kind) * (65536 if kind is np.int32 else 1)
    recording = opened(tmp_path, nanoscope_file(("Height", counts)))
    # The bottom line comes first: count x 100 V / 2^16 x 20 nm/V.
    np.testing.assert_allclose(
        channel(recording, "Height").values, COUNTS[::-1] * (100.0 * 20e-9 / 65536.0), rtol=1e-14
    )


def test_scale_counts_and_not_the_hard_scale(tmp_path: Path, nanoscope_file: Made) -> None:
    """Offline, the image was fitted to the range of the counts again; volts a count stayed as they were."""
    changed = {"@2:Z scale": "V [Sens. Zsens] (0.001525879 V/LSB) 2.500000 V", "Offline Planefit": "Full"}
    recording = opened(tmp_path, nanoscope_file(("Height", COUNTS), own=[changed]))
    height = channel(recording, "Height")
    assert height.values[-1, -1] == pytest.approx(300 * 2.5 * 20e-9 / 65536.0)
    assert height.flattened


def test_z_offset_is_no_part_of_the_value(tmp_path: Path, nanoscope_file: Made) -> None:
    own = [{"@2:Z offset": "V [Sens. Zsens] (0.001525879 V/LSB) 50.00000 V"}]
    recording = opened(tmp_path, nanoscope_file(("Height", COUNTS), own=own))
    assert channel(recording, "Height").values[-1, 0] == pytest.approx(-100 * 100.0 * 20e-9 / 65536.0)


def test_long_counts_of_a_short_scale(tmp_path: Path, nanoscope_file: Made) -> None:
    content = nanoscope_file(("Height", COUNTS.astype(np.int32)), own=[{"Bytes/pixel": "2"}])
    assert channel(opened(tmp_path, content), "Height").values[-1, -1] == pytest.approx(300 * 2e-6 / 65536.0)
    for scale in ("V [Sens. Zsens] (0.00000002328 V/LSB) 100.0 V", "V [Sens. Zsens] 100.0 V"):
        own = [{"Bytes/pixel": "2", "@2:Z scale": scale}]
        with pytest.raises(FileFormatError, match=r"expected 2 bytes a pixel in image 1, got 4"):
            opened(tmp_path, nanoscope_file(("Height", COUNTS.astype(np.int32)), own=own))


@pytest.mark.parametrize("section", ["scanner", "scan"])
def test_sensitivities_wherever_they_stand(tmp_path: Path, nanoscope_file: Made, section: str) -> None:
    lines: dict[str, dict[str, str | None]] = {"scanner": {"@Sens. Zsens": None}, "scan": {}}
    lines[section]["@Sens. Zsens"] = "V 30.00000 nm/V"
    content = nanoscope_file(("Height", COUNTS), **lines)
    assert channel(opened(tmp_path, content), "Height").values[-1, -1] == pytest.approx(300 * 3e-6 / 65536.0)


def test_a_sensitivity_that_is_missing(tmp_path: Path, nanoscope_file: Made) -> None:
    recording = opened(tmp_path, nanoscope_file(("Height", COUNTS), scanner={"@Sens. Zsens": None}))
    height = channel(recording, "Height")
    assert height.unit == "V"
    assert height.values[-1, -1] == pytest.approx(300 * 100.0 / 65536.0)
    assert any("(Sens. Zsens) is not in the file" in note for note in recording.notes)


@pytest.mark.parametrize(
    ("sensitivity", "scale", "unit", "value"),
    [
        ("V 2.000000 nA/V", "(1 V/LSB) 10.0 V", "A", 2e-8),
        ("V 3.000000 nN/Arb", "(1 Arb/LSB) 10.0 Arb", "N", 3e-8),
        ("V 1000.000 mV/V", "(1 mV/LSB) 10.0 mV", "V", 1e-2),
        ("V 1.000000 log(Pa)/log(Arb)", "(1 log(Arb)/LSB) 10.0 log(Arb)", None, 1.0),
        ("V 1.000000 ", "(1 Arb/LSB) 10.0 Arb", None, 10.0),
        ("V 1.000000 ", "(1 kHz/LSB) 10.0 kHz", "Hz", 1e4),
        ("V 1.000000 ", "(1 \xba/LSB) 10.0 \xba", "rad", math.radians(10.0)),
        ("V 1.000000 ", "(1 \xb0/LSB) 10.0 \xb0", "rad", math.radians(10.0)),
        ("V -4.000000 nm/V", "(1 mV/LSB) 10.0 mV", "m", -4e-11),
    ],
)
def test_units(
    tmp_path: Path, nanoscope_file: Made, sensitivity: str, scale: str, unit: str | None, value: float
) -> None:
    content = nanoscope_file(
        ("Input1", np.full((2, 2), 16384, np.int16) + np.arange(2, dtype=np.int16)),
        scanner={"@Sens. Input1": sensitivity},
        own=[{"@2:Z scale": f"V [Sens. Input1] {scale}"}],
    )
    recording = opened(tmp_path, content)
    (one,) = recording.channels
    assert one.unit == unit
    assert any("unit is not known" in note for note in recording.notes) == (unit is None)
    if unit is not None:
        assert one.values[0, 0] == pytest.approx(value / 4.0)


def test_amplitude_in_volts_names_its_sensitivity(tmp_path: Path, nanoscope_file: Made) -> None:
    recording = opened(tmp_path, nanoscope_file(("AmplitudeActual", COUNTS), ("AmplitudeError", COUNTS)))
    for name, scale in (("AmplitudeActual", 4.0), ("AmplitudeError", 2.0)):
        assert channel(recording, name).unit == "V"
        assert channel(recording, name).values[-1, -1] == pytest.approx(300 * scale / 65536.0)
        fact = recording.facts[f"scale:{name}"]
        assert (fact.value, fact.unit, fact.key) == (pytest.approx(50e-9), "m/V", "@Sens. AmplSens")
    assert recording.facts["offset:AmplitudeError"].value == pytest.approx(0.4)
    assert "offset:AmplitudeActual" not in recording.facts
    assert recording.facts["setpoint_amplitude"].value == pytest.approx(20e-9)


@pytest.mark.parametrize(
    "scan",
    [
        {"@2:SPMFeedbackList": 'S [SPMFb] "Phase"'},
        {"@2:TMSetAmplitude": None, "@3:TMSetAmplitude": None},
        {"@2:TMSetAmplitude": "V [Sens. AmplSens] 1 Arb"},
        {"@2:TMSetAmplitude": None},  # the one that is left belongs to the interleaved pass
    ],
)
def test_a_setpoint_that_is_not_known_is_not_added(
    tmp_path: Path, nanoscope_file: Made, scan: dict[str, str | None]
) -> None:
    recording = opened(tmp_path, nanoscope_file(("AmplitudeError", COUNTS), scan=scan))
    assert not {"offset:AmplitudeError", "setpoint_volts", "setpoint_amplitude"} & set(recording.facts)


@pytest.mark.parametrize(
    ("mode", "taps"),
    [
        ('S [TMMode] "Tapping"', True),
        (None, True),
        ('S [SoftHarmoniXAutoPilot] "ScanAsyst"', False),
        ("?", True),
    ],
)
def test_only_tapping_has_a_drive(tmp_path: Path, nanoscope_file: Made, mode: str | None, taps: bool) -> None:
    """Other modes keep the settings that tapping had last."""
    recording = opened(tmp_path, nanoscope_file(("Height", COUNTS), scan={"@MicroscopeList": mode}))
    assert ({"drive_frequency", "setpoint_volts"} <= set(recording.facts)) is taps


def test_an_older_header(tmp_path: Path, nanoscope_file: Made) -> None:
    """Version 5 writes other keys, in other cases."""
    content = nanoscope_file(
        ("Amplitude", COUNTS),
        scan={
            "@2:CantFrequency": None,
            "@2:CantDrive": None,
            "@2:CantPhase": None,
            "@Sens. AmplSens": None,
            "@Sens. Amplitude": "V 40.00000 nm/V",
            "@2:Drive frequency": "V (0.0000058208 kHz/LSB) 299.2222 kHz",
            "@2:Drive amplitude": "V (0.6103516 mV/LSB) 19.37896 mV",
            "@2:Drive phase": "V (0.005493164 \xba/LSB) -40.89661 \xba",
            "@2:TMSetAmplitude": "V (0.0003051758 V/LSB) 1.183777 V",
        },
        own=[
            {
                "@2:Z scale": "V [Sens. Amplitude] (0.0003051758 V/LSB) 20.00000 V",
                "Line Direction": None,
                "Line direction": "Trace",
                "Scan Size": None,
                "Scan size": "1000 500 nm",
            }
        ],
    )
    recording = opened(tmp_path, content, "made.007")
    amplitude = channel(recording, "Amplitude")
    assert (amplitude.unit, amplitude.direction) == ("m", "trace")
    assert amplitude.values[-1, -1] == pytest.approx(300 * 20.0 * 40e-9 / 65536.0)
    facts = recording.facts
    assert facts["drive_frequency"].value == pytest.approx(299222.2)
    assert facts["drive_amplitude"].value == pytest.approx(0.01937896)
    assert facts["drive_phase"].value == pytest.approx(math.radians(-40.89661))
    assert facts["setpoint_amplitude"].value == pytest.approx(1.183777 * 40e-9)
    assert recording.coords["y"].tolist() == pytest.approx([375e-9, 125e-9])


def test_a_lift_pass_stays_apart(tmp_path: Path, nanoscope_file: Made) -> None:
    lift = {
        "Scan Line": "Interleave",
        "@2:Image Data": None,
        "@3:Image Data": 'S [Phase] "Phase"',
        "@2:Z scale": None,
        "@3:Z scale": "V [Sens. Phase] (0.005493164 \xba/LSB) 180.0000 \xba",
    }
    scan = {
        "@3:CantFrequency": "V (0.0000116415 kHz/LSB) 299.0000 kHz",
        "@3:CantDrive": "V (0.3051758 mV/LSB) 200.0000 mV linked",
        "@Lift Scan Height": "V [Sens. Zsens] (0.005035400 V/LSB) 2.500000 V",
    }
    recording = opened(
        tmp_path, nanoscope_file(("Phase", COUNTS), ("Phase", COUNTS), own=[{}, lift], scan=scan)
    )
    assert [(c.name, c.nap) for c in recording.channels] == [("Phase", False), ("NapPhase", True)]
    assert channel(recording, "NapPhase").values[-1, -1] == pytest.approx(math.radians(300 * 180.0 / 65536.0))
    assert recording.facts["lift_drive_frequency"].value == pytest.approx(299e3)
    assert "lift_drive_amplitude" not in recording.facts  # linked: that of the main pass is in force
    assert recording.facts["lift_height"].value == pytest.approx(50e-9)


@pytest.mark.parametrize(
    ("own", "size"),
    [
        ({"Scan Size": "1 1 ~m"}, (1e-6, 1e-6)),
        ({"Scan Size": "1 0.5 ~m"}, (1e-6, 0.5e-6)),
        ({"Scan Size": "300 300 nm"}, (300e-9, 300e-9)),
        ({"Scan Size": "2 2 \xb5m"}, (2e-6, 2e-6)),
        ({"Scan Size": "1 1 ~m", "Aspect Ratio": "2:1"}, (1e-6, 0.5e-6)),  # twice the width
        ({"Scan Size": "0.5 0.5 ~m", "Aspect Ratio": "2:1"}, (1e-6, 0.5e-6)),  # twice the height
        ({"Scan Size": "0.2 0.2 ~m", "Aspect Ratio": "2:1"}, (0.2e-6, 0.1e-6)),  # a part, cut out
        ({"Scan Size": "1 0.5 ~m", "Aspect Ratio": "2:1"}, (1e-6, 0.5e-6)),
    ],
)
def test_image_size(
    tmp_path: Path, nanoscope_file: Made, own: dict[str, str | None], size: tuple[float, float]
) -> None:
    recording = opened(tmp_path, nanoscope_file(("Height", COUNTS), own=[own]))
    x, y = recording.coords["x"], recording.coords["y"]
    assert 3 * (x[1] - x[0]) == pytest.approx(size[0])
    assert 2 * (y[0] - y[1]) == pytest.approx(size[1])
    guessed = "Aspect Ratio" in own and own["Scan Size"] != "1 0.5 ~m"
    assert any("aspect ratio of 2:1" in note for note in recording.notes) == guessed


@pytest.mark.parametrize("size", [None, "1", "1 1", "1 1 V", "0 0 ~m", "-1 1 ~m", "x y nm", ""])
def test_no_usable_size(tmp_path: Path, nanoscope_file: Made, size: str | None) -> None:
    recording = opened(tmp_path, nanoscope_file(("Height", COUNTS), own=[{"Scan Size": size}]))
    assert not recording.coords
    assert any("no usable image size" in note for note in recording.notes)


@pytest.mark.parametrize(
    ("own", "flattened"),
    [
        ({}, False),
        ({"Offline Planefit": "Offset"}, True),
        ({"Offline Planefit": "Full"}, True),
        ({"Offline Planefit": None}, None),
        ({"Realtime Planefit": "Line"}, False),  # for the screen only
    ],
)
def test_flattened(
    tmp_path: Path, nanoscope_file: Made, own: dict[str, str | None], flattened: bool | None
) -> None:
    assert (
        channel(opened(tmp_path, nanoscope_file(("Phase", COUNTS), own=[own])), "Phase").flattened
        is flattened
    )


def test_lines_that_average_to_zero_were_fitted(tmp_path: Path, nanoscope_file: Made) -> None:
    centred = np.array([[-100, 101], [2000, -2001], [5, -3]], dtype=np.int16)
    recording = opened(tmp_path, nanoscope_file(("Phase", centred), ("AmplitudeError", centred)))
    assert channel(recording, "Phase").flattened
    assert any("Phase: every line averages to zero" in note for note in recording.notes)
    assert channel(recording, "AmplitudeError").flattened is False  # an error signal does so by itself


@pytest.mark.parametrize("fill", [-32768, 32767])
def test_lines_that_were_never_scanned(tmp_path: Path, nanoscope_file: Made, fill: int) -> None:
    counts = np.arange(20, dtype=np.int16).reshape(5, 4)
    counts[:2] = fill
    counts[3, 1] = fill
    recording = opened(tmp_path, nanoscope_file(("Height", counts)))
    height = channel(recording, "Height").values
    assert np.isnan(height[3:]).all()
    assert np.isfinite(height[:3]).all()  # one pixel at the end of the range is saturated, not missing
    assert any("Height: 2 of 5 lines were not scanned" in note for note in recording.notes)


def test_lines_outside_the_valid_data(tmp_path: Path, nanoscope_file: Made) -> None:
    counts = np.arange(20, dtype=np.int16).reshape(5, 4)
    counts[0] = counts[4] = counts[2] = 0
    own = [{"Valid data start Y": "1", "Valid data len Y": "3"}]
    height = channel(opened(tmp_path, nanoscope_file(("Height", counts), own=own)), "Height").values
    assert np.isnan(height[:, 0]).tolist() == [True, False, False, False, True]


def test_images_of_another_shape_are_left_out(tmp_path: Path, nanoscope_file: Made) -> None:
    recording = opened(tmp_path, nanoscope_file(("Height", COUNTS), ("Phase", COUNTS[:1])))
    assert [c.name for c in recording.channels] == ["Height"]
    assert any("image 2: left out, 1 x 3 pixels" in note for note in recording.notes)


def test_force_curves(tmp_path: Path, nanoscope_file: Made) -> None:
    with pytest.raises(FileFormatError, match=r"got force curves\. Try: export the curve as a table"):
        opened(tmp_path, nanoscope_file(first="Force file list"))
    curves = ["*Ciao force image list", "Data offset: 8192", "Spring Constant: 0.42"]
    with pytest.raises(FileFormatError, match="got force curves"):
        opened(tmp_path, nanoscope_file(sections=curves))
    recording = opened(tmp_path, nanoscope_file(("Height", COUNTS), sections=curves))
    assert [c.name for c in recording.channels] == ["Height"]
    assert recording.facts["stiffness"].value == 0.42
    assert any("force curves in the file were left out" in note for note in recording.notes)


def test_a_header_before_version_4_3(tmp_path: Path) -> None:
    content = b"\\*File list\r\n\\Date: 06:42:39 PM\r\n\\*AFM image list\r\n\\Data offset: 8192\r\n\x1a"
    with pytest.raises(FileFormatError, match=r"version 4\.3 or later .* got none, version not stated"):
        opened(tmp_path, content)


@pytest.mark.parametrize(
    ("own", "message"),
    [
        (
            {"Data offset": "8195"},
            "expected 8207 bytes for image 1 as its header says, got 8204: it was cut off",
        ),
        ({"Data offset": "-8"}, "Data offset of image 1 as a positive whole number, got '-8'"),
        ({"Data offset": None}, "Data offset of image 1 as a positive whole number, got none"),
        ({"Data length": "10"}, "expected 12 bytes for 2 x 3 pixels of image 1, got 10"),
        ({"Samps/line": "4"}, "expected 16 bytes for 2 x 4 pixels of image 1, got 12"),
        ({"Samps/line": "\xb2"}, "Samps/line of image 1 as a positive whole number"),
        ({"Number of lines": "9" * 5000}, "Number of lines of image 1"),
        ({"Number of lines": "1000000000"}, "expected 6000000000 bytes"),
        ({"Bytes/pixel": "4"}, "expected 4 bytes a pixel in image 1, got 2"),
        ({"@2:Z scale": None}, r"@2:Z scale of image 1 \(Height\) as a value with its unit, got none"),
        ({"@2:Z scale": "V [Sens. Zsens] (1 V/LSB) nan V"}, "@2:Z scale of image 1"),
        ({"@2:Z scale": "V [Sens. Zsens] (1 V/LSB) 0 V"}, "@2:Z scale of image 1"),
        ({"@2:Z scale": "V [Sens. Zsens] (1 V/LSB) 1e308 V", "Scan Size": "1 1 ~m"}, ""),
    ],
)
def test_headers_that_do_not_fit(
    tmp_path: Path, nanoscope_file: Made, own: dict[str, str | None], message: str
) -> None:
    content = nanoscope_file(("Height", COUNTS), own=[own])
    if not message:
        assert opened(tmp_path, content).channels
        return
    with pytest.raises(FileFormatError, match=message):
        opened(tmp_path, content)


def test_images_that_overlap_take_no_memory(tmp_path: Path, nanoscope_file: Made) -> None:
    """A hundred lists that point at the same data would take a hundred times the file."""
    counts = np.arange(3000, dtype=np.int16).reshape(30, 100)
    own = [{"Data offset": "65536", "Data length": "6000", "Number of lines": "30"}] * 100
    content = nanoscope_file(*[("Height", counts[:1])] * 99, ("Height", counts), own=own, start=65536)
    with pytest.raises(FileFormatError, match="images of at most"):
        opened(tmp_path, content[: 65536 + 6000])


def test_a_header_without_end(tmp_path: Path, nanoscope_file: Made) -> None:
    content = nanoscope_file(("Height", COUNTS))
    with pytest.raises(FileFormatError, match="a header that ends"):
        opened(tmp_path, content[:300])
    # Ctrl-Z alone ends it as well.
    cut = content.replace(b"\\*File list end\r\n", b"")
    assert opened(tmp_path, cut[: cut.index(b"\x1a") + 1].ljust(8192, b"\0") + COUNTS.tobytes()).channels


@pytest.mark.parametrize(
    "own",
    [
        {"@2:Z scale": "V (" + "a" * 900_000},
        {"@2:Z scale": "V [Sens. Zsens] (1 V/LSB) " + "9" * 900_000},
        {"@2:Z scale": "V (1 " + "/LSB (" * 150_000},
    ],
)
def test_long_values_do_not_hang(tmp_path: Path, nanoscope_file: Made, own: dict[str, str | None]) -> None:
    content = nanoscope_file(("Height", COUNTS), own=[own], start=1 << 20)
    began = time.perf_counter()
    with pytest.raises(FileFormatError, match="@2:Z scale of image 1"):
        opened(tmp_path, content)
    assert time.perf_counter() - began < 5.0


@pytest.mark.parametrize(
    "lists", [b"\\*\n\\a:b\n" * 100_000, b"\\*Ciao image list\n\\Data offset: 9\n" * 20_000]
)
def test_many_lists_do_not_hang(tmp_path: Path, lists: bytes) -> None:
    began = time.perf_counter()
    with pytest.raises(FileFormatError, match="at most 1000 lists"):
        opened(tmp_path, b"\\*File list\n" + lists + b"\x1a")
    assert time.perf_counter() - began < 5.0


def test_values() -> None:
    value = parse_value("V [Sens. Zsens] (0.0007060985 V/LSB) 46.27417 V")
    assert value is not None
    assert (value.number, value.unit, value.sensitivity, value.count) == (
        46.27417,
        "V",
        "Sens. Zsens",
        0.0007060985,
    )
    linked = parse_value("V (0.03125000 1/LSB) 4.000000  linked")
    assert linked is not None
    assert (linked.number, linked.unit, linked.linked) == (4.0, "", True)
    logarithm = parse_value("V [Sens. L] (0.0004882813 log(Arb)/LSB)       0 log(Arb)")
    assert logarithm is not None
    assert (logarithm.number, logarithm.unit) == (0.0, "log(Arb)")
    assert parse_value('S [TMMode] "Tapping"') is None
    assert parse_value("V [x] (1 V/LSB) 1.2.3 V") is None
    assert parse_value("V " + "9" * 400) is None
    assert parse_value("V 1e999 V") is None


def test_keys_that_come_twice_count_once() -> None:
    header = parse_header(
        b"\\*A\r\n\\Key: first\r\n\\key: second\r\nno parameter\r\n\\: nothing\r\n\\@2:B: c: d"
    )
    assert list(header.lists[0].entries()) == [("Key", "first"), ("@2:B", "c: d")]


def test_what_it_is_not() -> None:
    assert nanoscope.sniff(Path("a"), b"\\*File list\r\n")
    assert nanoscope.sniff(Path("a"), b"\\*Force file list\r\n")
    assert not nanoscope.sniff(Path("a.spm"), b"*File list")
