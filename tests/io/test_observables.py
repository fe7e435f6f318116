import dataclasses
import math
import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import xarray as xr

import overtone as ot
from overtone import provenance
from overtone.demo import demo_probe, virtual_scan
from overtone.errors import (
    ChannelError,
    ChannelWarning,
    OvertoneError,
    OvertoneWarning,
    PhaseReferenceWarning,
    ProbeError,
    ResonanceWarning,
    UncalibratedWarning,
)
from overtone.harmonics import far_phase
from overtone.instrument.calibration import Calibration, format_calibration
from overtone.instrument.unknowns import NEUTRAL
from overtone.inversion.properties import NOT_DETERMINED, map_energy, map_properties
from overtone.io.netcdf import save
from overtone.io.observables import missing_for_modulus, open_scan
from overtone.probe import Cantilever, Detector, Drive, Mode, Probe
from overtone.quantities import named_array
from overtone.readings import Reading, probe_of, reading_of, with_reading

SNOM = "neasnom/SnO2_NW4_hyp"


def snom_probe(radius: float | None = 20e-9) -> Probe:
    return Probe.simple(
        stiffness=40.0,
        frequency=237.595e3,
        quality_factor=400.0,
        drive_frequency=237595.092,
        free_amplitude=123.6e-9,
        radius=radius,
    )


def quietly(path: Path, **arguments: object) -> xr.Dataset:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", OvertoneWarning)
        return open_scan(path, **arguments)  # type: ignore[arg-type]


def said(dataset: xr.Dataset) -> str:
    return "\n".join(provenance.findings(dataset))


# --- a real Cypher scan -----------------------------------------------------------------------------


def test_energy_and_regime_of_a_real_scan(afm_data: Path) -> None:
    scan = quietly(afm_data / "ibw" / "AR_20211011.ibw")
    result = map_energy(scan, probe_of(scan))
    first = result["F_cons"].sel(harmonic=1)
    assert float(first.mean()) == pytest.approx(-0.0483e-9, abs=1e-12)
    assert float((first > 0).mean()) == pytest.approx(0.281, abs=2e-3)
    assert float(result["dissipation"].mean()) / 1.602176634e-19 == pytest.approx(106.9, abs=0.3)
    # Every pixel the rejected resonance or the free-air phase turns round is undetermined.
    regime = result["regime"]
    assert not (regime == 1).any()
    assert 0.1 < float((regime == -1).mean()) < 0.281
    assert "Rejected thermal" in said(scan)
    assert "A0" in missing_for_modulus(scan)
    assert "A2" in missing_for_modulus(scan)


def test_shifting_the_phase_to_90_degrees_would_be_wrong(afm_data: Path) -> None:
    """The drive is below resonance: referred to the free lever, the free phase is 69 degrees, not 90."""
    path = afm_data / "ibw" / "AR_20211011.ibw"
    referred = quietly(path, far_phase=math.radians(70.714))
    stored = quietly(path)
    shift = float((referred["phi1"] - stored["phi1"]).mean())
    assert math.degrees(shift) == pytest.approx(69.42 - 70.714, abs=0.02)
    assert float(map_energy(referred, probe_of(referred))["F_cons"].sel(harmonic=1).mean()) < 0.0


def test_a_scan_of_factory_defaults_is_named(afm_data: Path) -> None:
    with pytest.warns(UncalibratedWarning, match="SpringConstant"), warnings.catch_warnings():
        warnings.simplefilter("ignore", ResonanceWarning)
        warnings.simplefilter("ignore", PhaseReferenceWarning)
        scan = open_scan(afm_data / "ibw" / "tono_whiskers.ibw")
    assert "UncalibratedWarning" in said(scan)
    reading = reading_of(scan)
    assert reading is not None
    assert not reading.phase_established
    assert (map_energy(scan, probe_of(scan))["regime"] == 0).all()


def test_nap_channels_never_mix_in(afm_data: Path) -> None:
    scan = quietly(afm_data / "ibw" / "AutexysEFM_0000.ibw")
    assert scan["A1"].attrs["channel"] == "Amplitude"
    assert scan["phi1"].attrs["channel"] == "Phase"


def test_two_drive_tones_are_not_harmonics(afm_data: Path) -> None:
    with pytest.raises(OvertoneError):
        quietly(afm_data / "ibw" / "DTMicroscope_scan_0001_DART.ibw")
    scan = quietly(afm_data / "ibw" / "DTMicroscope_scan_0001_DART.ibw", probe=snom_probe())
    assert "A1" in scan
    assert "A2" not in scan


def test_a_scan_without_phase_is_refused(afm_data: Path) -> None:
    with pytest.raises(ChannelError, match="no channel for A1 and phi1"):
        open_scan(afm_data / "ibw" / "10x10-one_channel_without_name.ibw")


# --- a real harmonic scan ---------------------------------------------------------------------------


def test_a_phase_without_zero_is_asked_for(afm_data: Path) -> None:
    with pytest.raises(ChannelError, match="--far-phase"):
        quietly(afm_data / SNOM, probe=snom_probe())
    with pytest.raises(ProbeError, match="stiffness"):
        quietly(afm_data / SNOM, far_phase=1.57)


def test_harmonics_without_unit_are_left_out(afm_data: Path) -> None:
    with pytest.warns(
        ChannelWarning,
        match=r"A0 \(M0A: no unit, and a zero that is not known\), A2 \(M2A: no unit\), A3 \(M3A: no unit\)",
    ):
        scan = open_scan(afm_data / SNOM, probe=snom_probe(), far_phase=1.57)
    assert set(scan.data_vars) == {"height", "A1", "phi1"}
    result = map_energy(scan, snom_probe())
    assert list(result["harmonic"].values) == [1]
    scale = 40.0 * 123.6e-9 / 400.0
    assert float(abs(result["F_cons"]).max()) < 1.1 * scale
    assert 0.0 < float(result["dissipation"].median()) < 1e-15


def test_a_second_harmonic_locked_to_the_first_proves_nothing(afm_data: Path) -> None:
    scan = quietly(afm_data / SNOM, probe=snom_probe(), far_phase=1.57, scales={"M2A": 1e-9, "M3A": 1e-9})
    assert "constant to 0.013 rad" in said(scan)
    forces = map_energy(scan, snom_probe())
    assert list(forces["harmonic"].values) == [1, 2, 3]
    single = 3 * 40.0 * float(scan["A2"].mean())
    assert float(np.hypot(forces["F_cons"], forces["F_diss"]).sel(harmonic=2).mean()) == pytest.approx(
        single, rel=0.02, abs=0
    )
    result = map_properties(scan, snom_probe(), model="dmt-linear", poisson_ratio=0.25, harmonics=(1, 2, 3))
    status = result["status"].values
    assert not np.isfinite(result["modulus"]).any()
    assert (status == NOT_DETERMINED).all()
    assert "no modulus can be concluded" in result.attrs["cannot_conclude"]


# --- made files -------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def scan() -> xr.Dataset:
    return virtual_scan(shape=(6, 8), seed=2)[0]


def test_a_saved_scan_opens_as_it_was(scan: xr.Dataset, tmp_path: Path) -> None:
    save(scan, tmp_path / "scan.nc")
    again = open_scan(tmp_path / "scan.nc")
    for name in scan.data_vars:
        np.testing.assert_array_equal(again[name], scan[name])
    assert probe_of(again) == demo_probe()
    reading = reading_of(again)
    assert reading is not None
    assert reading.corrected
    assert not reading.doubts


def test_axes_keep_their_units(scan: xr.Dataset, tmp_path: Path) -> None:
    """A series over time, as a trace is demodulated into, and set-points, which have no unit."""
    series = (
        scan.isel(y=0, drop=True).drop_vars("x").rename(x="time").assign_coords(time=np.arange(8) * 0.5e-3)
    )
    series["time"].attrs["units"] = "s"
    save(series, tmp_path / "series.nc")
    again = open_scan(tmp_path / "series.nc")
    assert again["A1"].dims == ("time",)
    np.testing.assert_array_equal(again["time"], series["time"])
    assert again["time"].attrs == {"units": "s", "long_name": "time"}
    np.testing.assert_array_equal(again["A2"], series["A2"])
    steps = (
        scan.isel(y=0, drop=True)
        .drop_vars("x")
        .rename(x="setpoint")
        .assign_coords(setpoint=np.linspace(0.2, 0.9, 8))
    )
    save(steps, tmp_path / "steps.nc")
    assert open_scan(tmp_path / "steps.nc")["setpoint"].attrs["units"] == "1"
    assert open_scan(tmp_path / "steps.nc")["A1"].dims == ("setpoint",)


def write_table(folder: Path, scan: xr.Dataset, header: str = "") -> Path:
    path = folder / "scan.csv"
    names = ["A0", "A1", "phi1", "A2", "phi2"]
    rows = [", ".join(f"{name} [{'deg' if name.startswith('phi') else 'pm'}]" for name in names)]
    scale = [np.degrees(1.0) if name.startswith("phi") else 1e12 for name in names]
    for values in zip(*(scan[name].values.ravel() for name in names), strict=True):
        rows.append(", ".join(repr(float(v * s)) for v, s in zip(values, scale, strict=True)))
    path.write_text(header + "\n".join(rows))
    return path


def test_a_table_is_doubted_until_it_is_said_to_be_corrected(scan: xr.Dataset, tmp_path: Path) -> None:
    path = write_table(tmp_path, scan)
    doubted = quietly(path, probe=demo_probe())
    assert (
        "DistortionWarning: A0 is as the file stores it: its zero far from the surface is not known"
        in said(doubted)
    )
    assert "nothing in the file says that they are" in said(doubted)
    np.testing.assert_allclose(doubted["A0"], scan["A0"].values.ravel(), rtol=1e-12)
    np.testing.assert_allclose(doubted["phi2"], scan["phi2"].values.ravel(), rtol=1e-12)
    reading = reading_of(doubted)
    assert reading is not None
    assert 0 in reading.doubts
    assert not reading.phase_established
    trusted = reading_of(open_scan(path, probe=demo_probe(), corrected=True))
    assert trusted is not None
    assert not trusted.doubts


def test_phase_reference_turns_every_harmonic(scan: xr.Dataset, tmp_path: Path) -> None:
    """A phase stored as a lead with an arbitrary zero: referred to the free lever it is what it was.

    Shifting the reference of phi1 by eps shifts phi_n by n eps.
    """
    eps = 0.7
    stored = scan[["A0", "A1", "phi1", "A2", "phi2"]].copy(deep=True)
    for n in (1, 2):
        stored[f"phi{n}"] = -(scan[f"phi{n}"] - n * eps)
    path = write_table(tmp_path, stored)
    free_reading = -(far_phase(demo_probe()) - eps)
    again = open_scan(path, probe=demo_probe(), far_phase=free_reading, phase_sign=-1, corrected=True)
    for n in (1, 2):
        np.testing.assert_allclose(again[f"phi{n}"], scan[f"phi{n}"].values.ravel(), atol=1e-12)


def test_a_wrong_probe_is_noticed(scan: xr.Dataset, tmp_path: Path) -> None:
    path = write_table(tmp_path, scan)
    small = Probe.simple(
        stiffness=16.4, frequency=161.8e3, quality_factor=287.0, drive_frequency=161.8e3, free_amplitude=20e-9
    )
    wrong = quietly(path, probe=small, corrected=True)
    assert "more than the free amplitude" in said(wrong)
    assert "would give energy to the tip" in said(wrong)
    assert (map_energy(wrong, small)["regime"] == 0).all()


def test_an_optical_lever_needs_its_modes(afm_data: Path) -> None:
    """Stating that the harmonics were corrected does not turn a slope into a displacement."""
    scales = {"M2A": 1e-9, "M3A": 1e-9}
    single = reading_of(
        quietly(afm_data / SNOM, probe=snom_probe(), far_phase=1.57, scales=scales, corrected=True)
    )
    assert single is not None
    assert set(single.doubts) == {2, 3}
    assert "7 to 40 % low" in single.doubts[2]
    modes = (
        Mode(40.0, 237.595e3, 400.0),
        Mode(1571.0, 1.489e6, 600.0, 3.473),
    )
    lever = Probe(Cantilever(modes, 38.8, 1.0897), Drive(237595.092, 123.6e-9), detector=Detector("slope"))
    known = reading_of(quietly(afm_data / SNOM, probe=lever, far_phase=1.57, scales=scales, corrected=True))
    assert known is not None
    assert not known.doubts


def test_a_probe_file_is_held_against_the_free_phase(afm_data: Path) -> None:
    """The resonance that the file's own values reject is not made right by coming from a probe file."""
    thermal = Probe.simple(
        stiffness=27.952,
        frequency=257190.3,
        quality_factor=471.15,
        drive_frequency=256976.8,
        free_amplitude=33.272e-9,
    )
    scan = quietly(afm_data / "ibw" / "AR_20211011.ibw", probe=thermal)
    assert "+18.8 deg off" in said(scan)
    assert (map_energy(scan, thermal)["regime"] == 0).all()


def test_other_readings_carry_the_shift_that_makes_the_free_lever_free(afm_data: Path) -> None:
    """At its stored free-air values the lever feels no force, in the reading that is referred to them."""
    reading = reading_of(quietly(afm_data / "ibw" / "AR_20211011.ibw"))
    assert reading is not None
    (thermal, none), (tune, shift) = reading.alternatives
    assert none == 0.0
    assert thermal.cantilever.modes[0].quality_factor == 471.15
    free = xr.Dataset(
        {"A1": ("point", [tune.drive.free_amplitude]), "phi1": ("point", [math.radians(70.714) + shift])}
    )
    force = map_energy(free, tune)
    assert abs(float(force["F_cons"][0, 0])) < 1e-15
    assert abs(float(force["F_diss"][0, 0])) < 1e-15


def test_a_first_harmonic_without_unit_is_refused(scan: xr.Dataset, tmp_path: Path) -> None:
    path = write_table(tmp_path, scan)
    path.write_text(path.read_text().replace("A1 [pm]", "A1 [V]"))
    with pytest.raises(ChannelError, match=r"A1 \(A1\) has the unit V instead of m"):
        quietly(path, probe=demo_probe())


def test_a_scale_for_a_channel_with_a_unit_is_refused(scan: xr.Dataset, tmp_path: Path) -> None:
    with pytest.raises(ChannelError, match="has the unit m in the file"):
        quietly(write_table(tmp_path, scan), probe=demo_probe(), scales={"A1": 1e-9})


def test_an_empty_channel_is_not_a_measured_one(scan: xr.Dataset, tmp_path: Path) -> None:
    path = write_table(tmp_path, scan.assign(A0=scan["A0"] * np.nan))
    opened = quietly(path, probe=demo_probe(), corrected=True)
    assert "A0" not in opened
    assert "no pixel has a value: A0" in said(opened)


def test_another_imaging_mode_is_no_tapping(afm_data: Path) -> None:
    scan = quietly(afm_data / "ibw" / "DTMicroscope_scan_0001_DART.ibw", probe=snom_probe())
    assert "the file says PFM Mode, not AC mode" in said(scan)
    assert (map_energy(scan, snom_probe())["regime"] == 0).all()


@pytest.mark.parametrize(
    ("arguments", "word"),
    [
        ({"channels": {"A2": "UserIn7"}}, "no channel 'UserIn7'"),
        ({"channels": {"B2": "A2"}}, "not an observable"),
        ({"scales": {"A9": 1.0}}, "no channel 'A9'"),
        ({"phase_sign": 2}, "unknown phase sign"),
        ({"direction": "trace"}, "has no trace"),
    ],
)
def test_wrong_options_are_named(
    scan: xr.Dataset, tmp_path: Path, arguments: dict[str, object], word: str
) -> None:
    with pytest.raises(ChannelError, match=word):
        quietly(write_table(tmp_path, scan), probe=demo_probe(), **arguments)


def test_channels_can_be_named(scan: xr.Dataset, tmp_path: Path) -> None:
    path = write_table(tmp_path, scan)
    path.write_text(path.read_text().replace("A2 [pm]", "UserIn0"))
    named = quietly(path, probe=demo_probe(), channels={"A2": "UserIn0"}, scales={"UserIn0": 1e-12})
    np.testing.assert_allclose(named["A2"], scan["A2"].values.ravel(), rtol=1e-12)


def test_trace_and_retrace_do_not_mix(igor_wave: Callable[..., bytes], tmp_path: Path) -> None:
    note = "SpringConstant: 28\rThermalQ: 400\rThermalFrequency: 257000\rDriveFrequency: 257000\rAmpInvOLS: 4e-8\r"
    note += "FreeAirAmplitude: 1\rFreeAirPhase: 90\rImagingMode: AC Mode\r"
    values = np.full((3, 4, 2), 20.0)
    path = tmp_path / "mixed.ibw"
    path.write_bytes(igor_wave(values, note=note, labels=[[], [], ["AmplitudeTrace", "PhaseRetrace"]]))
    with pytest.raises(ChannelError, match="do not mix"):
        quietly(path)


def test_deflection_with_the_set_point_in_it_is_not_a_mean_deflection(
    igor_wave: Callable[..., bytes], tmp_path: Path
) -> None:
    note = "SpringConstant: 28\rThermalQ: 400\rThermalFrequency: 257000\rDriveFrequency: 257000\rAmpInvOLS: 4e-8\r"
    note += "FreeAirAmplitude: 1\rFreeAirPhase: 90\rImagingMode: AC Mode\r"
    values = np.stack([np.full((3, 4), v) for v in (20e-9, 80.0, 37e-9)], axis=-1)
    path = tmp_path / "setpoint.ibw"
    labels = [[], [], ["AmplitudeRetrace", "PhaseRetrace", "DeflectionRetrace"]]
    path.write_bytes(igor_wave(values, note=note, labels=labels))
    with pytest.warns(ChannelWarning, match="a set-point is still in it"), warnings.catch_warnings():
        warnings.simplefilter("ignore", PhaseReferenceWarning)
        assert "A0" not in open_scan(path)


# --- lines and passes -------------------------------------------------------------------------------


def test_trace_and_retrace_of_a_netcdf_file(scan: xr.Dataset, tmp_path: Path) -> None:
    path = tmp_path / "both.nc"
    back = scan.assign({name: 1.02 * scan[name] for name in ("A1", "A2", "A0")})
    both = xr.concat([scan, back], dim="direction", combine_attrs="override")
    save(both.assign_coords(direction=["trace", "retrace"]), path)
    with pytest.raises(ChannelError, match="one line direction"):
        open_scan(path)
    for direction, truth in (("trace", scan), ("retrace", back)):
        again = open_scan(path, direction=direction)
        assert again.attrs["direction"] == direction
        assert again["A1"].dims == ("y", "x")
        for name in ("A0", "A1", "phi1", "A2", "phi2", "height"):
            np.testing.assert_array_equal(again[name], truth[name])
        # what was opened as one line is one when it is opened again
        save(again, tmp_path / "one.nc")
        assert open_scan(tmp_path / "one.nc").attrs["direction"] == direction
    with pytest.raises(ChannelError, match="has no approach: expected retrace or trace"):
        open_scan(path, direction="approach")


def test_the_nap_pass_of_a_real_file(afm_data: Path) -> None:
    from igor2 import binarywave

    path = afm_data / "ibw" / "AutexysEFM_0000.ibw"
    stated = binarywave.load(str(path))["wave"]["wData"]
    main, nap = quietly(path), quietly(path, lift=True)
    assert (main["A1"].attrs["channel"], nap["A1"].attrs["channel"]) == ("Amplitude", "NapAmplitude")
    assert nap["phi1"].attrs["channel"] == "NapPhase"
    assert set(nap.data_vars) == {"A1", "phi1"}  # there is no other Nap channel, and none is lent
    for row, column in [(0, 0), (0, 31), (31, 0), (7, 20)]:
        assert float(nap["A1"][row, column]) == stated[column, 31 - row, 2]
        assert float(main["A1"][row, column]) == stated[column, 31 - row, 1]
        assert math.degrees(float(nap["phi1"][row, column])) == pytest.approx(
            float(stated[column, 31 - row, 4]), rel=1e-12, abs=0
        )
    assert nap.attrs["pass"] == "lift"
    assert nap.attrs["lift_height"] == 1e-8
    assert "pass" not in main.attrs
    # its drive is another one, 47 Hz and a factor of 29 away: the probe of the main pass is not sure
    assert "60.248 kHz (NapDriveFrequency) instead of 60.201 kHz" in said(nap)
    assert "10 mV (NapDriveAmplitude) instead of 290.64 mV" in said(nap)
    assert "drive of its own" not in said(main)
    reading = reading_of(nap)
    assert reading is not None
    assert not reading.phase_established


def test_the_main_pass_takes_no_nap_channel_by_name(afm_data: Path) -> None:
    path = afm_data / "ibw" / "AutexysEFM_0000.ibw"
    with pytest.raises(ChannelError, match="no channel for A1"):
        quietly(path, channels={"A1": "NapAmplitude"})
    named = quietly(path, channels={"A1": "NapAmplitude"}, lift=True)
    assert named["A1"].attrs["channel"] == "NapAmplitude"


@pytest.mark.parametrize(
    ("own", "same"),
    [
        ("NapDriveFrequency: 257000\rNapDriveAmplitude: 0.1\rDriveAmplitude: 0.1", True),
        ("NapDriveFrequency: 257100\rNapDriveAmplitude: 0.1\rDriveAmplitude: 0.1", False),
        ("NapDriveFrequency: 257000\rNapDriveAmplitude: 0.2\rDriveAmplitude: 0.1", False),
        ("ScanRate: 1", True),
    ],
)
def test_a_lift_pass_with_a_drive_of_its_own(
    igor_wave: Callable[..., bytes], tmp_path: Path, own: str, same: bool
) -> None:
    note = "SpringConstant: 28\rThermalQ: 400\rThermalFrequency: 257000\rDriveFrequency: 257000\rAmpInvOLS: 4e-8\r"
    note += "FreeAirAmplitude: 1\rFreeAirPhase: 90\rImagingMode: AC Mode\r" + own
    values = np.stack([np.full((3, 4), v) for v in (20e-9, 60.0, 39e-9, 78.0)], axis=-1)
    labels = [[], [], ["AmplitudeRetrace", "PhaseRetrace", "NapAmplitudeRetrace", "NapPhaseRetrace"]]
    path = tmp_path / "lift.ibw"
    path.write_bytes(igor_wave(values, note=note, labels=labels))
    lift = quietly(path, lift=True)
    readings = [reading_of(lift), reading_of(quietly(path))]
    assert [reading.phase_established for reading in readings if reading is not None] == [same, True]
    assert ("drive of its own" in said(lift)) != same
    assert float(lift["A1"][0, 0]) == pytest.approx(39e-9, rel=1e-6, abs=0)


def test_a_file_without_a_lift_pass(afm_data: Path, scan: xr.Dataset, tmp_path: Path) -> None:
    with pytest.raises(ChannelError, match="has no Nap or Lift pass: expected channels such as"):
        open_scan(afm_data / "ibw" / "AR_20211011.ibw", lift=True)
    save(scan, tmp_path / "scan.nc")
    with pytest.raises(ChannelError, match="has no Nap or Lift pass"):
        open_scan(tmp_path / "scan.nc", lift=True)


def test_the_lift_pass_of_a_netcdf_file(scan: xr.Dataset, tmp_path: Path) -> None:
    path = tmp_path / "lift.nc"
    lift = {f"lift_{name}": array + 0.25 * abs(array) for name, array in scan.data_vars.items()}
    save(scan.assign(lift).assign_attrs(lift_height=50e-9), path)
    main, far = open_scan(path), open_scan(path, lift=True)
    assert set(main.data_vars) == set(far.data_vars) == set(scan.data_vars)
    for name in scan.data_vars:
        np.testing.assert_array_equal(main[name], scan[name])
        np.testing.assert_array_equal(far[name], lift[f"lift_{name}"])
    assert far.attrs["lift_height"] == 50e-9
    assert provenance.history(far)[-1]["arguments"]["lift"] is True
    # half a pass is none
    save(scan.assign(lift_A1=scan["A1"]), path)
    with pytest.raises(ChannelError, match="no channel for phi1"):
        open_scan(path, lift=True)


def test_the_zero_of_a0_is_what_a_lift_pass_is_for(scan: xr.Dataset, tmp_path: Path) -> None:
    path = tmp_path / "lift.nc"
    off = scan["A0"] + 8e-9
    lift = {f"lift_{name}": scan[name] for name in ("A1", "phi1")} | {"lift_A0": off}
    save(scan.assign(lift | {"A0": off}), path)
    with pytest.warns(ChannelWarning, match="A0 .* averages 8"):
        assert "A0" not in open_scan(path)
    np.testing.assert_array_equal(open_scan(path, lift=True)["A0"], off)


# --- saturation -------------------------------------------------------------------------------------


def noisy(seed: int = 3, shape: tuple[int, int] = (40, 50)) -> xr.Dataset:
    random = np.random.default_rng(seed)
    noise = {name: random.normal(size=shape) for name in ("A0", "A1", "phi1", "A2", "phi2")}
    means = {
        "A0": (100e-12, 5e-12),
        "A1": (40e-9, 1e-10),
        "phi1": (0.4, 0.01),
        "A2": (90e-12, 5e-12),
        "phi2": (4, 0.1),
    }
    return xr.Dataset(
        {
            name: (
                ("y", "x"),
                means[name][0] + means[name][1] * n,
                {"units": "rad" if "phi" in name else "m"},
            )
            for name, n in noise.items()
        }
    )


def opened_saying(dataset: xr.Dataset, folder: Path) -> str:
    save(dataset, folder / "scan.nc")
    return said(quietly(folder / "scan.nc", probe=demo_probe(), corrected=True))


@pytest.mark.parametrize(("name", "side"), [("A2", "largest"), ("A0", "smallest"), ("phi1", "largest")])
def test_a_clipped_channel_is_named(tmp_path: Path, name: str, side: str) -> None:
    whole = noisy()
    assert "saturated" not in opened_saying(whole, tmp_path)
    limit = float(whole[name].quantile(0.97 if side == "largest" else 0.03))
    clipped = whole[name].clip(**{"max" if side == "largest" else "min": limit}, keep_attrs=True)
    text = opened_saying(whole.assign({name: clipped}), tmp_path)
    assert (
        f"ChannelWarning: {name} ({name}) is saturated: 3 % of its pixels sit exactly at its {side}" in text
    )
    assert text.count("saturated") == 1
    # 1 % and less may be chance
    limit = float(whole[name].quantile(0.99 if side == "largest" else 0.01))
    few = whole[name].clip(**{"max" if side == "largest" else "min": limit}, keep_attrs=True)
    assert int((few == limit).sum()) == 20
    assert "saturated" not in opened_saying(whole.assign({name: few}), tmp_path)


def test_both_ends_of_a_range(tmp_path: Path) -> None:
    whole = noisy()
    low, high = (float(whole["A2"].quantile(q)) for q in (0.05, 0.95))
    text = opened_saying(whole.assign(A2=whole["A2"].clip(low, high, keep_attrs=True)), tmp_path)
    assert "exactly at its largest" in text
    assert "exactly at its smallest" in text


def test_what_repeats_for_other_reasons_is_not_saturated(tmp_path: Path) -> None:
    whole = noisy()
    # a coarse converter repeats every value, here in 40 of 2000 pixels at an end and in 80 elsewhere
    ranks = np.random.default_rng(5).permutation(2000).reshape(40, 50)
    coarse = whole["A2"].copy(data=80e-12 + 1e-12 * np.round(ranks / 80.0))
    assert int((coarse == coarse.max()).sum()) > 20
    # a feedback that holds the amplitude, and two materials without noise
    held = xr.full_like(whole["A1"], 40e-9)
    half = xr.where(np.arange(50) < 20, 1.0, 1.1) * xr.ones_like(whole["A2"])
    for change in ({"A2": coarse}, {"A1": held}, {"A2": whole["A2"].copy(data=half.values * 90e-12)}):
        assert "saturated" not in opened_saying(whole.assign(change), tmp_path)
    # free pixels of a simulation without noise: nothing moves there
    free = np.arange(50) < 10
    still = {
        name: whole[name].where(~free, limit(whole[name].values)) for name, limit in {"A1": np.max}.items()
    } | {name: whole[name].where(~free, float(whole[name].mean())) for name in ("A0", "phi1", "A2", "phi2")}
    assert "saturated" not in opened_saying(whole.assign(still), tmp_path)
    assert "saturated" in opened_saying(whole.assign(A1=still["A1"]), tmp_path)


def test_no_real_file_is_called_saturated(afm_data: Path) -> None:
    names = ("AR_20211011", "AutexysEFM_0000", "DTMicroscope_scan_0001_DART", "tono_whiskers")
    paths = [afm_data / "ibw" / f"{name}.ibw" for name in (*names, "IgorIBWReader_ImageStack_BTFO_DSO")]
    for path in paths:
        assert "saturated" not in said(quietly(path, probe=snom_probe())), path.name
    assert "saturated" not in said(quietly(paths[1], probe=snom_probe(), lift=True))
    scales = {f"M{n}A": 1e-9 for n in (0, 2, 3, 4, 5)}
    snom = quietly(afm_data / SNOM, probe=snom_probe(), far_phase=1.57, scales=scales)
    assert "saturated" not in said(snom)


def test_a_clipped_layer_of_a_real_scan(afm_data: Path, tmp_path: Path) -> None:
    """The amplitude of a real scan, cut at its 95th percentile in place."""
    content = bytearray((afm_data / "ibw" / "AR_20211011.ibw").read_bytes())
    size = 128 * 128
    amplitude = np.frombuffer(content, "<f4", count=size, offset=384 + 4 * size)
    content[384 + 4 * size : 384 + 8 * size] = np.minimum(amplitude, np.quantile(amplitude, 0.95)).tobytes()
    (tmp_path / "clipped.ibw").write_bytes(bytes(content))
    assert "A1 (Amplitude) is saturated: 5 % of its pixels" in said(quietly(tmp_path / "clipped.ibw"))


def test_what_a_correction_left_open_is_saved_with_the_scan(tmp_path):
    probe = demo_probe()
    left = Calibration(
        probe,
        probe.drive.free_amplitude,
        dict(NEUTRAL),
        ("A0_offset", "stiffness"),
        np.diag([1e-24, 0.05**2]),
    )
    values = {"A0": 1e-12, "A1": 40e-9, "phi1": 1.2, "A2": 1e-10, "phi2": 2.0}
    scan = xr.Dataset({n: named_array(n, np.full((3, 4), v), ("y", "x")) for n, v in values.items()})
    flags = np.zeros((3, 4), np.int8)
    flags[0, 1] = 1
    scan = scan.assign(reference=named_array("reference", flags, ("y", "x")))
    scan = with_reading(scan, Reading(probe, corrected=True)).assign_attrs(
        calibration=format_calibration(left)
    )
    path = tmp_path / "corrected.nc"
    ot.save(scan, path)
    opened = ot.open_scan(path)
    assert opened.attrs["calibration"] == scan.attrs["calibration"]
    assert opened["reference"].dtype.kind == "i"
    np.testing.assert_array_equal(opened["reference"], flags)
    # it is that of its own probe and no other
    other = dataclasses.replace(probe, tip=dataclasses.replace(probe.tip, radius=33e-9))
    assert "calibration" not in ot.open_scan(path, probe=other).attrs
    ot.save(with_reading(scan, Reading(probe, corrected=False)), path)
    with pytest.warns(OvertoneWarning):
        assert "calibration" not in ot.open_scan(path).attrs
