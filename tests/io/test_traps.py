"""What has misled readers of these formats, one test a trap, over the formats that have it.

The numbers are those of the list that the readers were written to.
"""

import math
import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import xarray as xr

from overtone.errors import (
    ChannelError,
    ChannelWarning,
    FileFormatError,
    ObservablesError,
    OvertoneWarning,
    ResonanceWarning,
    UncalibratedWarning,
)
from overtone.harmonics import far_phase
from overtone.inversion.properties import map_energy
from overtone.io.observables import open_scan
from overtone.io.registry import read_channels
from overtone.probe import Probe
from overtone.readings import probe_of

Made = Callable[..., bytes]
ASYLUM = (
    "SpringConstant: 26\rThermalQ: 400\rThermalFrequency: 300000\rDriveFrequency: 300000\rAmpInvOLS: 4e-8\r"
    "FreeAirAmplitude: 1\rFreeAirPhase: 90\rImagingMode: AC Mode\r"
)
# What Asylum and Bruker hold with the tip 20 nm far: counts of 4 V / 2^16 at 50 nm/V.
TWENTY_NM = 20e-9 / 50e-9 * 65536 / 4.0


def probe(frequency: float = 300e3, free_amplitude: float = 40e-9) -> Probe:
    return Probe.simple(
        stiffness=26.0,
        frequency=frequency,
        quality_factor=400.0,
        drive_frequency=frequency,
        free_amplitude=free_amplitude,
    )


def opened(path: Path, **arguments: object) -> tuple[xr.Dataset, dict[type[Warning], str]]:
    """Open a scan; what it warns of by category, several of one joined."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        scan = open_scan(path, **arguments)  # type: ignore[arg-type]
    kinds: dict[type[Warning], str] = {}
    for warning in caught:
        assert issubclass(warning.category, OvertoneWarning)
        kinds[warning.category] = f"{kinds.get(warning.category, '')}\n{warning.message}"
    return scan, kinds


def asylum(folder: Path, igor_wave: Made, labels: list[str], *layers: np.ndarray, note: str = ASYLUM) -> Path:
    """Write images, row 0 at the top."""
    path = folder / "made.ibw"
    path.write_bytes(
        igor_wave(np.stack([layer[::-1].T for layer in layers], axis=-1), note=note, labels=[(), (), labels])
    )
    return path


def bruker(folder: Path, nanoscope_file: Made, *images: tuple[str, np.ndarray], **changes: object) -> Path:
    """Write images of counts, row 0 at the top."""
    path = folder / "made.spm"
    path.write_bytes(
        nanoscope_file(
            *((name, np.rint(counts[::-1]).astype(np.int16)) for name, counts in images), **changes
        )
    )
    return path


def ramp(low: float, high: float, shape: tuple[int, int] = (4, 6)) -> np.ndarray:
    return np.linspace(low, high, shape[0] * shape[1]).reshape(shape)


def test_trap_3_factory_defaults_are_no_calibration(
    igor_wave: Made, nanoscope_file: Made, tmp_path: Path
) -> None:
    """Asylum's stiffness 1, AmpInvOLS 1.09e-7, Q 20 at 75 kHz; Bruker's sensitivity of 1 without a unit."""
    note = (
        ASYLUM.replace("26\r", "1\r")
        .replace("4e-8", "1.09e-7")
        .replace("400", "20")
        .replace("300000", "75000")
    )
    labels = ["AmplitudeRetrace", "PhaseRetrace"]
    _, said = opened(asylum(tmp_path, igor_wave, labels, ramp(19e-9, 21e-9), ramp(60, 80), note=note))
    wanted = "SpringConstant, FreeAirAmplitude x AmpInvOLS, ThermalFrequency, ThermalQ"
    assert f"factory defaults for {wanted}:" in said[UncalibratedWarning]
    _, said = opened(asylum(tmp_path, igor_wave, labels, ramp(19e-9, 21e-9), ramp(60, 80)))
    assert UncalibratedWarning not in said
    counts = ramp(TWENTY_NM, TWENTY_NM + 9)
    unset: dict[str, str | None] = {"@Sens. AmplSens": "V 1.000000 "}
    path = bruker(tmp_path, nanoscope_file, ("AmplitudeActual", counts), ("Phase", counts), scan=unset)
    with pytest.raises(ChannelError, match=r"AmplitudeActual\) has the unit V instead of m.*--scale"):
        opened(path, probe=probe(), far_phase=0.0)


def test_trap_3_in_real_files(afm_data: Path) -> None:
    _, said = opened(afm_data / "ibw" / "tono_whiskers.ibw")
    wanted = "SpringConstant, FreeAirAmplitude x AmpInvOLS, ThermalFrequency, ThermalQ"
    assert f"factory defaults for {wanted}:" in said[UncalibratedWarning]
    with pytest.raises(ChannelError, match=r"AmplitudeError\) has the unit V instead of m.*--scale"):
        opened(afm_data / "bruker" / "ST_di-3.di", probe=probe(337132.2), far_phase=0.0)


def test_trap_4_deflection_with_the_setpoint_in_it(
    igor_wave: Made, nanoscope_file: Made, tmp_path: Path
) -> None:
    """A mean deflection in tapping mode is picometres; a set-point is tens of nanometres."""
    labels = ["AmplitudeRetrace", "PhaseRetrace", "DeflectionRetrace"]
    counts = ramp(TWENTY_NM, TWENTY_NM + 9)
    for offset, kept in ((37.7e-9, False), (0.0, True)):
        deflection = ramp(10e-12, 20e-12) + offset
        layers = ramp(19e-9, 21e-9), ramp(60, 80), deflection
        scan, said = opened(asylum(tmp_path, igor_wave, labels, *layers))
        assert ("A0" in scan) is kept
        assert ("A0 (Deflection) averages 37.7 nm" in said.get(ChannelWarning, "")) is not kept
        path = bruker(
            tmp_path,
            nanoscope_file,
            ("AmplitudeActual", counts),
            ("Phase", ramp(1000, 2000)),
            ("TMDeflection", deflection / 50e-9 * 65536 / 4.0),
            scan={"@Sens. TM Deflection": "V 50.00000 nm/V"},
            own=[{}, {}, {"@2:Z scale": "V [Sens. TM Deflection] (0.00006 V/LSB) 4.000000 V"}],
        )
        scan, said = opened(path, probe=probe(), far_phase=0.0, phase_sign=-1)
        assert ("A0" in scan) is kept
        assert ("A0 (TMDeflection) averages 37.7 nm" in said[ChannelWarning]) is not kept


def test_trap_4_in_a_real_file(afm_data: Path) -> None:
    path = afm_data / "ibw" / "IgorIBWReader_ImageStack_BTFO_DSO.ibw"
    scan, said = opened(path, probe=probe(), far_phase=1.5)
    assert "A0 (Deflection) averages 37.7 nm" in said[ChannelWarning]
    assert "A0" not in scan


def test_trap_5_bruker_stores_the_amplitude_less_its_setpoint(nanoscope_file: Made, tmp_path: Path) -> None:
    images = ("AmplitudeError", ramp(-300, 300)), ("Phase", ramp(1000, 2000))
    calibrated: dict[str, str | None] = {"@Sens. Amplitude Error": "V 50.00000 nm/V"}
    for scan_list, unit in (({}, "400 mV"), (calibrated, "20 nm")):
        path = bruker(tmp_path, nanoscope_file, *images, scan=scan_list)
        scan, said = opened(path, probe=probe(), far_phase=0.0, phase_sign=-1)
        assert f"stores only A - set-point; the set-point, {unit} (@2:TMSetAmplitude" in said[ChannelWarning]
        np.testing.assert_allclose(
            scan["A1"], 20e-9 + np.rint(ramp(-300, 300)) * 2.0 / 65536.0 * 50e-9, rtol=1e-12
        )
    unset: dict[str, str | None] = {"@2:TMSetAmplitude": None, "@3:TMSetAmplitude": None}
    with pytest.raises(
        ObservablesError, match=r"A1 is negative in 12 of 24 pixels.*amplitude minus set-point"
    ):
        opened(bruker(tmp_path, nanoscope_file, *images, scan=unset), probe=probe(), far_phase=0.0)


def test_trap_5_in_a_real_file(afm_data: Path) -> None:
    path = afm_data / "bruker" / "ST_di-4.di"
    scan, said = opened(path, probe=probe(157660.0, 25e-9), far_phase=0.0, phase_sign=-1)
    stored = next(c for c in read_channels(path).channels if c.name == "AmplitudeError")
    np.testing.assert_allclose(scan["A1"], stored.values + 0.2468933 * 62e-9, rtol=1e-12)
    assert float(scan["A1"].mean()) == pytest.approx(15.172e-9, rel=1e-4)
    assert "stores only A - set-point; the set-point, 15.31 nm (@2:TMSetAmplitude" in said[ChannelWarning]


def test_trap_6_trace_and_retrace_are_not_combined(
    igor_wave: Made, nanoscope_file: Made, tmp_path: Path
) -> None:
    mixed = asylum(tmp_path, igor_wave, ["AmplitudeTrace", "PhaseRetrace"], ramp(19e-9, 21e-9), ramp(60, 80))
    with pytest.raises(ChannelError, match="trace and retrace do not mix"):
        opened(mixed)
    counts = ramp(TWENTY_NM, TWENTY_NM + 9)
    images = (
        ("AmplitudeActual", counts),
        ("AmplitudeActual", counts + 100),
        ("Phase", counts),
        ("Phase", counts),
    )
    trace = {"Line Direction": "Trace"}
    mixed = bruker(tmp_path, nanoscope_file, images[0], images[2], own=[{}, trace])
    with pytest.raises(ChannelError, match="trace and retrace do not mix"):
        opened(mixed, probe=probe(), far_phase=0.0)
    both = bruker(tmp_path, nanoscope_file, *images, own=[{}, trace, trace, {}])
    with pytest.raises(ChannelError, match=r"holds AmplitudeActual 2 times.*one line direction"):
        opened(both, probe=probe(), far_phase=0.0)
    means = {
        way: float(opened(both, probe=probe(), far_phase=0.0, direction=way)[0]["A1"].mean())
        for way in ("trace", "retrace")
    }
    assert means["trace"] - means["retrace"] == pytest.approx(100 * 4.0 * 50e-9 / 65536.0)


def test_trap_6_in_a_real_file(afm_data: Path) -> None:
    """Its amplitude is of the retrace, its phase and what the feedback left of the amplitude are of the trace."""
    path = afm_data / "bruker" / "hystorian_test_nanonis.000"
    hint = r"A1: AmplitudeActual retrace, phi1: Phase trace\. Try: --direction trace\.$"
    with pytest.raises(ChannelError, match=hint):
        opened(path, probe=probe(271731.4), far_phase=0.0)
    scales = {"AmplitudeError": 60e-9}
    scan, said = opened(path, probe=probe(271731.4), far_phase=0.0, direction="trace", scales=scales)
    assert scan.attrs["direction"] == "trace"
    assert [scan[name].attrs["channel"] for name in ("A1", "phi1")] == ["AmplitudeError", "Phase"]
    assert float(scan["A1"].mean()) == pytest.approx(549.7046e-3 * 60e-9, rel=1e-5)
    assert "was added" in said[ChannelWarning]


def test_trap_7_flattened_amplitude_and_phase_have_no_absolute_value(
    igor_wave: Made, nanoscope_file: Made, tmp_path: Path
) -> None:
    labels = ["AmplitudeRetrace", "PhaseRetrace"]
    layers = ramp(19e-9, 21e-9), ramp(60, 80)
    for setting, name in (("FlattenOrder 1: 0", "Phase"), ("PlanefitOrder 0: 1", "Amplitude")):
        _, said = opened(asylum(tmp_path, igor_wave, labels, *layers, note=f"{ASYLUM}{setting}\r"))
        assert f"{name} was flattened or plane-fitted" in said[ChannelWarning]
    _, said = opened(asylum(tmp_path, igor_wave, labels, *layers, note=f"{ASYLUM}FlattenOrder 1: -1\r"))
    assert ChannelWarning not in said
    images = ("AmplitudeActual", ramp(TWENTY_NM, TWENTY_NM + 9)), ("Phase", ramp(1000, 2000))
    for fits, flattened in (
        ({}, False),
        ({"Realtime Planefit": "Line"}, False),
        ({"Offline Planefit": "Full"}, True),
    ):
        path = bruker(tmp_path, nanoscope_file, *images, own=[{}, fits])
        _, said = opened(path, probe=probe(), far_phase=0.0, phase_sign=-1)
        assert ("Phase was flattened or plane-fitted" in said[ChannelWarning]) is flattened


def test_trap_7_in_a_real_file(afm_data: Path) -> None:
    channels = read_channels(afm_data / "bruker" / "nanoAFMr_kpg20080408.007").channels
    phase = next(c for c in channels if c.name == "Phase")
    assert phase.flattened
    assert abs(math.degrees(phase.values.mean())) < 0.01


def test_trap_10_phases_wrap_where_the_vendor_likes(
    igor_wave: Made, nanoscope_file: Made, tmp_path: Path
) -> None:
    """[-90, 270] and [-180, 180] degrees give the same forces, and so do both within one image."""
    lag = ramp(100, 250)
    amplitude = ramp(19e-9, 21e-9)
    labels = ["AmplitudeRetrace", "PhaseRetrace"]

    def forces(path: Path, **arguments: object) -> xr.Dataset:
        scan, _ = opened(path, **arguments)
        return map_energy(scan, arguments.get("probe", probe()))  # type: ignore[arg-type]

    wrapped = np.where(lag > 180.0, lag - 360.0, lag)
    assert (wrapped != lag).any()
    whole = forces(asylum(tmp_path, igor_wave, labels, amplitude, lag), probe=probe())
    other = forces(asylum(tmp_path, igor_wave, labels, amplitude, wrapped), probe=probe())
    for name in ("F_cons", "F_diss", "dissipation"):
        np.testing.assert_allclose(other[name], whole[name], rtol=1e-6, atol=1e-22)
    np.testing.assert_array_equal(other["regime"], whole["regime"])
    # Bruker's counts end at +-180 degrees. The same phases as leads that are 0, or 150, for the free lever; the
    # second of them wraps.
    counts = amplitude / 50e-9 * 65536 / 4.0
    for zero in (0.0, 150.0):
        lead = 90.0 - lag + zero
        wraps = (lead + 180.0) % 360.0 - 180.0
        assert (wraps != lead).any() == (zero > 0.0)
        images = ("AmplitudeActual", counts), ("Phase", wraps / 360.0 * 65536)
        made = forces(
            bruker(tmp_path, nanoscope_file, *images),
            probe=probe(),
            far_phase=math.radians(zero),
            phase_sign=-1,
        )
        # Half a count is 1.5 pm and 0.003 degrees, of a drive force of 2.6 nN.
        for name in ("F_cons", "F_diss"):
            np.testing.assert_allclose(made[name], whole[name], rtol=0, atol=5e-13)


def test_trap_11_pixels_without_a_value(igor_wave: Made, nanoscope_file: Made, tmp_path: Path) -> None:
    """What was never scanned is missing, whatever stands for it, and takes no part in a mean."""
    amplitude, phase = ramp(19e-9, 21e-9), ramp(60, 80)
    amplitude[1], phase[1] = np.nan, np.nan
    scan, _ = opened(asylum(tmp_path, igor_wave, ["AmplitudeRetrace", "PhaseRetrace"], amplitude, phase))
    assert int(scan["A1"].isnull().sum()) == 6
    assert float(scan["A1"].mean()) == pytest.approx(np.nanmean(amplitude))
    counts, angles = ramp(TWENTY_NM, TWENTY_NM + 40), ramp(1000, 2000)
    counts[2:], angles[2:] = -32768, -32768
    path = bruker(tmp_path, nanoscope_file, ("AmplitudeActual", counts), ("Phase", angles))
    scan, said = opened(path, probe=probe(), far_phase=0.0, phase_sign=-1)
    for name in ("A1", "phi1"):
        assert np.isnan(scan[name][2:]).all()
        assert np.isfinite(scan[name][:2]).all()
    assert float(scan["A1"].mean()) == pytest.approx(20e-9, rel=1e-2)
    assert "saturated" not in said[ChannelWarning]


def test_trap_11_in_a_real_file(afm_data: Path) -> None:
    """Nanosurf's electronics leave the end of the range, -3.333 V, where nothing was measured."""
    holes = read_channels(afm_data / "nanosurf" / "NSFopen_circles_holes.nid")
    amplitudes = [channel.values for channel in holes.channels if channel.name == "Amplitude"]
    assert amplitudes
    for values in amplitudes:
        assert np.isnan(values).any()
        assert np.nanmin(values) > -0.1


def test_traps_1_and_2_of_two_resonances_the_one_that_predicts_the_free_lever_counts(
    igor_wave: Made, tmp_path: Path
) -> None:
    """Driven 123 Hz below its tune and 213 Hz below its thermal frequency, as in a real file."""
    note = (
        ASYLUM.replace("300000\rDrive", "257190\rDrive")
        .replace("DriveFrequency: 300000", "DriveFrequency: 256977")
        .replace("ThermalQ: 400", "ThermalQ: 471.15")
        .replace("FreeAirPhase: 90", "FreeAirPhase: 70.7\rTuneFreqResult: 257100\rTuneQResult: 391.72")
    )
    labels = ["AmplitudeRetrace", "PhaseRetrace"]
    scan, said = opened(asylum(tmp_path, igor_wave, labels, ramp(30e-9, 31e-9), ramp(66, 75), note=note))
    used = probe_of(scan).cantilever.modes[0]
    assert (used.frequency, used.quality_factor) == (257100.0, 391.72)
    assert "Used tune" in said[ResonanceWarning]
    assert "Rejected thermal" in said[ResonanceWarning]
    # the phase of resonance is not 90 deg here: taken so the mean force would have another sign
    assert math.degrees(far_phase(probe_of(scan))) == pytest.approx(69.4, abs=0.3)


def test_trap_8_the_step_of_igor_reaches_from_the_first_to_the_last_pixel(
    igor_wave: Made, tmp_path: Path
) -> None:
    path = tmp_path / "made.ibw"
    steps, labels = (1e-6 / 4, 3e-6 / 3, 1.0, 1.0), [(), (), ["AmplitudeRetrace", "PhaseRetrace"]]
    note = ASYLUM + "FastScanSize: 1e-6\rSlowScanSize: 3e-6\r"
    path.write_bytes(igor_wave(np.ones((5, 4, 2)), note=note, labels=labels, steps=steps))
    recording = read_channels(path)
    assert not [text for text in recording.notes if "disagree" in text]
    np.testing.assert_allclose(np.ptp(recording.coords["x"]), 1e-6, rtol=1e-12)
    np.testing.assert_allclose(np.ptp(recording.coords["y"]), 3e-6, rtol=1e-12)


def test_trap_9_layers_are_known_by_their_labels(igor_wave: Made, tmp_path: Path) -> None:
    note = ASYLUM + "Channel1DataType: Phase\rChannel2DataType: Amplitude\r"
    path = asylum(
        tmp_path, igor_wave, ["AmplitudeRetrace", "PhaseRetrace"], ramp(19e-9, 21e-9), ramp(60, 80), note=note
    )
    by_name = {channel.name: channel for channel in read_channels(path).channels}
    np.testing.assert_allclose(by_name["Amplitude"].values, ramp(19e-9, 21e-9), rtol=1e-6)
    np.testing.assert_allclose(by_name["Phase"].values, np.radians(ramp(60, 80)), rtol=1e-6)


def test_trap_12_odd_shapes_names_notes_and_endings(
    igor_wave: Made, nanoscope_file: Made, tmp_path: Path
) -> None:
    odd = ASYLUM + "Comment: 5 \u00b5m, na\u00efve\r"
    layers = [ramp(19e-9, 21e-9, (3, 7)), ramp(60, 80, (3, 7))]
    content = igor_wave(
        np.stack([layer[::-1].T for layer in layers], axis=-1),
        note=odd,
        labels=[(), (), ["AmplitudeRetrace", "PhaseRetrace"]],
    )
    path = tmp_path / "picture.spm"  # an Igor wave all the same
    path.write_bytes(content)
    recording = read_channels(path)
    assert recording.format == "igor"
    assert recording.channels[0].values.shape == (3, 7)
    twice = bruker(
        tmp_path,
        nanoscope_file,
        ("Phase", ramp(0, 9)),
        ("Phase", ramp(0, 9)),
        ("AmplitudeActual", ramp(9, 99)),
    )
    with pytest.raises(ChannelError, match="holds Phase 2 times"):
        opened(twice, probe=probe(), far_phase=0.0)
    path.write_bytes(content[:-40])
    with pytest.raises(FileFormatError, match="not a whole Igor"):
        read_channels(path)


def test_trap_13_the_size_of_a_scan_has_a_unit(nanoscope_file: Made, tmp_path: Path) -> None:
    widths = []
    for text in ("2000 2000 nm", "2 2 ~m"):
        path = bruker(tmp_path, nanoscope_file, ("Phase", ramp(0, 9, (8, 8))), own=[{"Scan Size": text}])
        x = read_channels(path).coords["x"]
        widths.append(float(np.ptp(x) + x[1] - x[0]))
    np.testing.assert_allclose(widths, 2e-6, rtol=1e-9)
