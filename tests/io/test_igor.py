import math

import numpy as np
import pytest

import overtone.io.registry as registry
from overtone.errors import FileFormatError

read_channels = registry.read_channels

NOTE = "\r".join(
    [
        "ImagingMode: AC Mode",
        "springCONSTANT: 2.5",
        "InvOLS: 5e-08",
        "AmpInvOLS: 6e-08",
        "DriveFrequency:161812.123456",
        "FreeAirAmplitude: 0.5",
        "FreeAirPhase: 90",
        "AmplitudeSetpointVolts: 0.4",
        "TunePeakResult: 0.55",
        "ThermalFrequency: 1.6181e+05",
        "ThermalQ: 287",
        "ResFreq1: 161814.5",
        "TuneFreqResult: 1.6179e+05",
        "TuneQResult: 290",
        "FlattenOrder 0: -1",
        "PlanefitOrder 0: 1",
        "FlattenOrder 1: -1",
        "PlanefitOrder 1: -1",
        "a line without any colon",
        ": a line without a key",
        "DriveFrequency: 5@Line: 12",
        "EndHeadTemp:33.8125 \xb0C",
    ]
)


def by_name(recording):
    return {channel.name: channel for channel in recording.channels}


@pytest.fixture
def read_wave(tmp_path, igor_wave):
    def read(values, **arguments):
        path = tmp_path / "wave.ibw"
        path.write_bytes(igor_wave(values, **arguments))
        return read_channels(path)

    return read


# --- synthetic waves ------------------------------------------------------------------------------


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("kind", [2, 4, 0x10])
def test_image_is_turned_upright(read_wave, order, kind):
    values = np.arange(3 * 4 * 2).reshape(3, 4, 2)
    scan = read_wave(
        values, order=order, kind=kind, labels=[(), (), ("HeightTrace", "PhaseTrace")], note=NOTE
    )
    assert (scan.format, scan.vendor, scan.dims) == ("igor", "asylum", ("y", "x"))
    height, phase = scan.channels
    assert height.values.shape == (4, 3)
    assert height.values.dtype == np.float64
    for row in range(4):
        for column in range(3):
            assert height.values[row, column] == values[column, 3 - row, 0]
            assert phase.values[row, column] == pytest.approx(math.radians(values[column, 3 - row, 1]))
    np.testing.assert_allclose(scan.coords["x"], [0, 1e-9, 2e-9])
    np.testing.assert_allclose(scan.coords["y"], [3e-9, 2e-9, 1e-9, 0], atol=1e-24)


def test_labels_are_cut_at_their_end_and_at_the_direction(read_wave):
    names = (
        "AmplitudeRetrace",
        "NapPhaseTrace",
        "HeightRetraceMod0",
        "UserIn0Retrace",
        "Amplitude2Trace",
        "",
    )
    scan = read_wave(np.ones((2, 3, 6)), labels=[(), (), names], note=NOTE)
    told = [(c.name, c.direction, c.nap, c.unit) for c in scan.channels]
    assert told == [
        ("Amplitude", "retrace", False, "m"),
        ("NapPhase", "trace", True, "rad"),
        ("HeightMod0", "retrace", False, "m"),
        ("UserIn0", "retrace", False, None),
        ("Amplitude2", "trace", False, "m"),
        ("layer 6", None, False, None),
    ]
    assert "no unit in the file: UserIn0, layer 6" in scan.notes
    assert "1 of 6 layers have no label in the file" in scan.notes
    assert [c.flattened for c in scan.channels] == [True, False, None, None, None, None]


def test_facts_and_resonances(read_wave):
    scan = read_wave(np.ones((2, 2, 1)), labels=[(), (), ("AmplitudeTrace",)], note=NOTE)
    values = {name: (fact.value, fact.unit) for name, fact in scan.facts.items()}
    assert values == {
        "stiffness": (2.5, "N/m"),
        "drive_frequency": (161812.123456, "Hz"),
        "amplitude_sensitivity": (6e-8, "m/V"),
        "free_amplitude": (pytest.approx(30e-9), "m"),
        "tune_amplitude": (pytest.approx(33e-9), "m"),
        "setpoint_amplitude": (pytest.approx(24e-9), "m"),
        "free_phase": (pytest.approx(math.pi / 2), "rad"),
    }
    assert scan.facts["stiffness"].key == "springCONSTANT"
    assert scan.facts["free_amplitude"].key == "FreeAirAmplitude x AmpInvOLS"
    assert not any(fact.factory_default for fact in scan.facts.values())
    thermal, tune = scan.resonances
    # 161814.5 rounds to 161810, the thermal value, at five digits.
    assert (thermal.source, thermal.frequency, thermal.quality_factor) == ("thermal", 161814.5, 287.0)
    assert thermal.keys == ("ResFreq1", "ThermalQ")
    assert (tune.source, tune.frequency, tune.keys) == ("tune", 161790.0, ("TuneFreqResult", "TuneQResult"))
    assert "DriveFrequency was changed during the scan, to 5@Line: 12" in scan.notes
    assert scan.metadata["EndHeadTemp"] == "33.8125 °C"


@pytest.mark.parametrize("absent", ["0", "NaN", "inf", "", "not a number"])
def test_what_was_not_measured_is_absent(read_wave, absent):
    note = NOTE.replace("FreeAirAmplitude: 0.5", f"FreeAirAmplitude: {absent}").replace(
        "FreeAirPhase: 90", f"FreeAirPhase: {absent}"
    )
    scan = read_wave(np.ones((2, 2, 1)), note=note)
    assert not {"free_amplitude", "free_phase"} & set(scan.facts)


def test_setpoint_counts_only_where_the_amplitude_is_the_feedback(read_wave):
    scan = read_wave(np.ones((2, 2, 1)), note=NOTE.replace("AC Mode", "PFM Mode"))
    assert "setpoint_amplitude" not in scan.facts
    assert scan.metadata["ImagingMode"] == "PFM Mode"


def test_curve_has_one_channel_a_column(read_wave):
    values = np.arange(15.0).reshape(5, 3)
    scan = read_wave(
        values,
        labels=[(), ("Raw", "Amp", "Phase")],
        note=NOTE,
        axis_units=("s", "", "", ""),
        steps=(1e-4, 1, 1, 1),
    )
    assert (scan.dims, dict(scan.coords)) == (("point",), {})
    assert [(c.name, c.unit) for c in scan.channels] == [("Raw", "m"), ("Amp", "m"), ("Phase", "rad")]
    np.testing.assert_array_equal(scan.channels[1].values, values[:, 1])
    assert "one point every 0.0001 s" in scan.notes


@pytest.mark.parametrize(("unit", "seconds"), [("s", 5e-7), ("ms", 5e-10)])
@pytest.mark.parametrize("shape", [(50,), (50, 3)])
def test_waves_over_time_tell_their_sampling_step(read_wave, unit, seconds, shape):
    labels = [(), ("a", "b", "c")] if len(shape) == 2 else []
    scan = read_wave(np.ones(shape), labels=labels, steps=(5e-7, 1, 1, 1), axis_units=(unit, "", "", ""))
    step = scan.facts["sampling_step"]
    assert (step.value, step.unit) == (pytest.approx(seconds, rel=1e-12, abs=0), "s")


@pytest.mark.parametrize(
    ("unit", "step"), [("", 1e-3), ("m", 1e-3), ("s", 0.0), ("s", -1.0), ("s", math.inf)]
)
def test_other_waves_have_no_sampling_step(read_wave, unit, step):
    line = read_wave(np.ones(4), steps=(step, 1, 1, 1), axis_units=(unit, "", "", ""))
    assert "sampling_step" not in line.facts


def test_images_have_no_sampling_step(read_wave):
    image = read_wave(np.ones((4, 3, 1)), axis_units=("s", "m", "", ""))
    assert "sampling_step" not in image.facts


def test_one_measurement_written_down_twice_is_one_resonance(read_wave):
    same = NOTE.replace("TuneFreqResult: 1.6179e+05", "TuneFreqResult: 161814.5").replace(
        "TuneQResult: 290", "TuneQResult: 287"
    )
    scan = read_wave(np.ones((2, 2, 1)), note=same)
    assert [(r.source, r.frequency) for r in scan.resonances] == [("thermal", 161814.5)]
    assert len(read_wave(np.ones((2, 2, 1)), note=NOTE).resonances) == 2


def test_a_lift_pass_has_settings_of_its_own(read_wave):
    note = NOTE + "\rDriveAmplitude: 0.2\rNapHeight: 5e-08\rNapDriveAmplitude: 0.1\rNapDriveFrequency: 161000"
    labels = [(), (), ("AmplitudeTrace", "NapAmplitudeTrace")]
    facts = read_wave(np.ones((2, 2, 2)), note=note, labels=labels).facts
    assert {name: (fact.value, fact.unit) for name, fact in facts.items() if "lift" in name} == {
        "lift_height": (5e-8, "m"),
        "lift_drive_amplitude": (0.1, "V"),
        "lift_drive_frequency": (161000.0, "Hz"),
    }
    assert facts["drive_amplitude"].value == 0.2
    assert "lift_height" not in read_wave(np.ones((2, 2, 1)), note=note, labels=[(), (), labels[2][:1]]).facts


def test_plain_waves_of_one_and_two_dimensions(read_wave):
    line = read_wave(np.arange(4.0), unit="nm")
    assert (line.vendor, line.dims, line.channels[0].name, line.channels[0].unit) == (
        "igor",
        ("point",),
        "layer 1",
        "m",
    )
    np.testing.assert_allclose(line.channels[0].values, np.arange(4) * 1e-9)
    image = read_wave(np.zeros((4, 2)), axis_units=("", "", "", ""))
    assert (image.dims, image.channels[0].values.shape, image.coords) == (("y", "x"), (2, 4), {})
    assert any("no coordinates" in note for note in image.notes)


@pytest.mark.parametrize(("kind", "what"), [(0, "text"), (5, "complex")])
def test_waves_without_real_numbers_are_refused(tmp_path, igor_wave, kind, what):
    path = tmp_path / "wave.ibw"
    path.write_bytes(igor_wave(np.ones((2, 2)), kind=kind))
    with pytest.raises(FileFormatError, match=what):
        read_channels(path)


def test_waves_of_four_dimensions_are_refused(read_wave):
    with pytest.raises(FileFormatError, match="4 dimensions"):
        read_wave(np.ones((2, 2, 2, 2)))


def test_waves_of_countless_layers_are_refused(read_wave):
    with pytest.raises(FileFormatError, match="at most 1000 layers"):
        read_wave(np.ones((1, 1, 1001)))


def test_scan_size_that_disagrees_is_told(read_wave):
    scan = read_wave(np.ones((3, 3, 1)), note=NOTE + "\rFastScanSize: 5e-9\rSlowScanSize: 2e-9")
    assert [note for note in scan.notes if "disagree" in note] == [
        "FastScanSize 5e-09 m and the 2e-09 m of the wave disagree; the wave was believed"
    ]


# --- real files -----------------------------------------------------------------------------------


def raw(path):
    from igor2 import binarywave

    return binarywave.load(str(path))["wave"]["wData"]


def test_single_frequency_scan(afm_data):
    path = afm_data / "ibw" / "AR_20211011.ibw"
    scan = read_channels(path)
    channels = by_name(scan)
    assert list(channels) == ["Height", "Amplitude", "Phase", "ZSensor"]
    assert {c.direction for c in scan.channels} == {"retrace"}
    assert [c.flattened for c in scan.channels] == [True, False, False, True]
    assert channels["Amplitude"].values.mean() == pytest.approx(30.832e-9, abs=5e-13)
    assert math.degrees(channels["Phase"].values.mean()) == pytest.approx(69.81, abs=5e-3)
    stated = raw(path)
    for row, column in [(0, 0), (0, 127), (127, 0), (127, 127)]:
        assert channels["Amplitude"].values[row, column] == stated[column, 127 - row, 1]
        assert channels["Phase"].values[row, column] == pytest.approx(
            math.radians(stated[column, 127 - row, 2])
        )
    np.testing.assert_allclose(scan.coords["x"], np.linspace(0, 4e-6, 128), atol=1e-15)
    np.testing.assert_allclose(scan.coords["y"], np.linspace(4e-6, 0, 128), atol=1e-15)

    facts = scan.facts
    assert facts["stiffness"].value == 27.952
    assert facts["drive_frequency"].value == pytest.approx(256976.80, abs=5e-3)
    assert facts["amplitude_sensitivity"].value == 4.1497e-8
    assert facts["free_amplitude"].value == pytest.approx(33.27e-9, abs=5e-12)
    assert facts["setpoint_amplitude"].value == pytest.approx(30.85e-9, abs=5e-12)
    assert math.degrees(facts["free_phase"].value) == pytest.approx(70.714)
    assert not any(fact.factory_default for fact in facts.values())
    thermal, tune = scan.resonances
    assert (thermal.frequency, thermal.quality_factor) == (pytest.approx(257190.34, abs=5e-3), 471.15)
    assert (tune.frequency, tune.quality_factor) == (257100.0, 391.72)
    assert not thermal.factory_default
    assert not tune.factory_default
    assert scan.metadata["ScanRate"] == "2.0032"


def test_image_that_is_not_square(afm_data):
    path = afm_data / "ibw" / "tono_whiskers.ibw"
    scan = read_channels(path)
    stated = raw(path)
    assert stated.shape == (256, 512, 4)
    height = scan.channels[0].values
    assert height.shape == (512, 256)
    assert height[0, 3] == stated[3, 511, 0]
    assert height[511, 255] == stated[255, 0, 0]
    assert (scan.coords["y"][0], scan.coords["x"][-1]) == (pytest.approx(60e-6), pytest.approx(30e-6))
    defaults = {name for name, fact in scan.facts.items() if fact.factory_default}
    assert defaults == {
        "stiffness",
        "amplitude_sensitivity",
        "free_amplitude",
        "setpoint_amplitude",
        "tune_amplitude",
    }
    thermal, tune = scan.resonances
    assert thermal.factory_default
    assert (tune.frequency, tune.quality_factor) == (pytest.approx(77950.1898), 175.6)
    assert not tune.factory_default
    assert math.degrees(scan.facts["free_phase"].value) == pytest.approx(5.2347)


def test_nap_channels_are_kept_apart(afm_data):
    scan = read_channels(afm_data / "ibw" / "AutexysEFM_0000.ibw")
    assert [c.name for c in scan.channels] == [
        "Height",
        "Amplitude",
        "NapAmplitude",
        "Phase",
        "NapPhase",
        "ZSensor",
    ]
    assert [c.name for c in scan.channels if c.nap] == ["NapAmplitude", "NapPhase"]
    assert by_name(scan)["NapAmplitude"].values.mean() == pytest.approx(9.9725e-10, rel=1e-4, abs=0)


def test_two_drive_tones(afm_data):
    scan = read_channels(afm_data / "ibw" / "DTMicroscope_scan_0001_DART.ibw")
    units = {c.name: c.unit for c in scan.channels}
    assert units == {
        "Height": "m",
        "Amplitude1": "m",
        "Amplitude2": "m",
        "Phase1": "rad",
        "Phase2": "rad",
        "Frequency": "Hz",
    }
    assert by_name(scan)["Frequency"].values.mean() == pytest.approx(365422, abs=1)
    assert scan.facts["second_lockin_frequency"].value == 384070.0
    assert scan.facts["scale:Amplitude2"].factory_default
    assert scan.metadata["DualACMode"] == "1"


def test_deflection_with_its_setpoint(afm_data):
    scan = read_channels(afm_data / "ibw" / "IgorIBWReader_ImageStack_BTFO_DSO.ibw")
    assert [c.name for c in scan.channels] == ["Height", "Amplitude", "Deflection", "Phase"]
    assert by_name(scan)["Deflection"].values.mean() == pytest.approx(37.73e-9, abs=5e-12)
    assert scan.facts["scale:Deflection"].value == 3.7919e-8
    assert "free_phase" not in scan.facts


def test_wave_without_note_or_label(afm_data):
    scan = read_channels(afm_data / "ibw" / "10x10-one_channel_without_name.ibw")
    assert (scan.vendor, scan.channels[0].name, scan.channels[0].unit) == ("igor", "layer 1", None)
    assert scan.channels[0].values.shape == (10, 10)
    assert (dict(scan.coords), dict(scan.facts), scan.resonances) == ({}, {}, ())


def test_dynamic_approach_curve(afm_data):
    curve = read_channels(afm_data / "ibw_curves" / "LRCol0_MS_LG7d0001.ibw")
    assert [(c.name, c.unit) for c in curve.channels] == [
        ("Raw", "m"),
        ("Defl", "m"),
        ("Amp", "m"),
        ("Phase", "rad"),
        ("ZSnsr", "m"),
    ]
    assert curve.channels[0].values.shape == (15286,)
    assert by_name(curve)["Amp"].values.mean() == pytest.approx(1.8311e-9, rel=1e-4, abs=0)
    assert curve.facts["stiffness"].value == 25.36
    assert (curve.resonances[0].frequency, curve.resonances[0].quality_factor) == (127970.0, 8.1153)
    assert (curve.metadata["Indexes"], curve.metadata["Direction"]) == ("0,7643,15285", "NaN,1,-1,")
    assert curve.facts["sampling_step"].value == pytest.approx(6e-5, rel=1e-9, abs=0)


def test_lever_that_was_never_tuned(afm_data):
    curve = read_channels(afm_data / "ibw_curves" / "ForceMetric_X60_3_x4_0100.ibw")
    thermal, tune = curve.resonances
    assert (thermal.factory_default, tune.factory_default) == (False, True)


@pytest.mark.parametrize("name", ["mac-version2.ibw", "mac-version5.ibw", "win-version5.ibw"])
def test_byte_orders_and_versions(afm_data, name):
    line = read_channels(afm_data / "ibw_byteorder" / name)
    np.testing.assert_array_equal(line.channels[0].values, [5, 4, 3, 2, 1])
    assert line.dims == ("point",)
