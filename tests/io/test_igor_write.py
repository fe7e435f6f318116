"""Observables as an Asylum .ibw: the bytes, an independent reader, and overtone's own."""

import math
import struct
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
from igor2 import binarywave

from overtone import provenance
from overtone.demo import demo_probe, virtual_scan
from overtone.errors import ChannelError, ChannelWarning, FileFormatError, ObservablesError, OvertoneWarning
from overtone.harmonics import far_phase
from overtone.inversion.properties import map_energy
from overtone.io.export import save
from overtone.io.igor_write import write
from overtone.io.observables import open_scan
from overtone.io.registry import read_channels
from overtone.probe import Cantilever, Detector, Drive, Mode, Probe
from overtone.readings import probe_of

ORDERS = (1, 2, 3)
HARMONICS = ("A0", *(f"{letter}{n}" for n in ORDERS for letter in ("A", "phi")))
FLOAT32 = 2.0**-24  # the largest relative error of rounding to 32 bits


@pytest.fixture(scope="module")
def scan() -> xr.Dataset:
    return virtual_scan(shape=(8, 12))[0]


def opened(path: Path, **arguments: Any) -> xr.Dataset:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", OvertoneWarning)
        return open_scan(path, **arguments)


def independent(path: Path) -> dict[str, Any]:
    return dict(binarywave.load(str(path))["wave"])


def labels_of(wave: dict[str, Any], axis: int) -> list[str]:
    return [label.decode("latin-1") for label in wave["labels"][axis]]


# --- bytes ------------------------------------------------------------------------------------------


def test_layout_of_the_file(scan: xr.Dataset, tmp_path: Path) -> None:
    """Against Igor's technical note 3, number by number."""
    path = tmp_path / "2024 scan-µ.ibw"
    save(scan, path)
    content = path.read_bytes()
    version, _, total, *sizes = struct.unpack_from("<hH 15i", content)
    formula, note, *rest = sizes
    assert (version, formula, rest[:5], rest[9:]) == (5, 0, [0] * 5, [0] * 3)
    assert rest[5:9] == [0, 0, 32 * 9, 0]  # eight layers, and the cell that names the dimension
    points, kind = struct.unpack_from("<ih", content, 76)
    assert (points, kind) == (8 * 12 * 8, 2)
    assert total == 320 + 4 * points
    assert struct.unpack_from("<4i", content, 132) == (12, 8, 8, 0)
    assert len(content) == 384 + 4 * points + note + 32 * 9
    # Igor sums the headers up in 16 bits, as it did in the files of the instrument.
    assert int(np.frombuffer(content[:384], "<i2").sum(dtype=np.int64)) % 2**16 == 0
    name = content[92:124].split(b"\0")[0]
    assert name == b"w2024_scan__"
    cells = [content[-32 * k :][:32] for k in range(9, 0, -1)]
    assert cells[0] == b"\0" * 32
    assert cells[1] == b"HeightRetrace".ljust(32, b"\0")
    assert all(cell[31] == 0 for cell in cells)


def test_real_instruments_sum_their_headers_up_alike(afm_data: Path) -> None:
    for name in ("AR_20211011", "AutexysEFM_0000", "tono_whiskers"):
        header = (afm_data / "ibw" / f"{name}.ibw").read_bytes()[:384]
        assert int(np.frombuffer(header, "<i2").sum(dtype=np.int64)) % 2**16 == 0


# --- an independent reader --------------------------------------------------------------------------


def test_igor2_reads_a_scan(scan: xr.Dataset, tmp_path: Path) -> None:
    path = tmp_path / "scan.ibw"
    save(scan, path)
    wave = independent(path)
    values, header = wave["wData"], wave["wave_header"]
    names = ["Height", "Amplitude", "Deflection", "Phase", "Amplitude2", "Phase2", "Amplitude3", "Phase3"]
    assert labels_of(wave, 2) == ["", *(f"{name}Retrace" for name in names)]
    assert (values.shape, values.dtype) == ((12, 8, 8), np.dtype("float32"))
    for row, column in [(0, 0), (0, 11), (7, 0), (7, 11), (2, 5)]:
        # file[x, y]: columns first, rows from the bottom
        assert values[column, 7 - row, 0] == np.float32(scan["height"][row, column])
        assert values[column, 7 - row, 2] == np.float32(scan["A0"][row, column])
        assert values[column, 7 - row, 3] == np.float32(np.degrees(scan["phi1"][row, column]))
    step = float(scan["x"][1] - scan["x"][0])
    assert header["sfA"][:2] == pytest.approx([step, step], rel=1e-12, abs=0)
    assert header["sfB"][:2] == pytest.approx([0.0, 0.0], abs=1e-30)
    assert [b"".join(unit) for unit in header["dimUnits"][:2]] == [b"m", b"m"]
    note = dict(line.split(": ", 1) for line in wave["note"].decode("latin-1").split("\r") if line)
    probe = demo_probe()
    assert note["ImagingMode"] == "AC Mode"
    stated = {key: float(note[key]) for key in note if key not in ("ImagingMode",)}
    volt = stated["AmpInvOLS"]
    expected = {
        "SpringConstant": 16.4,
        "ThermalFrequency": 161.8e3,
        "ThermalQ": 287.0,
        "TuneFreqResult": 161.8e3,
        "TuneQResult": 287.0,
        "DriveFrequency": 161.8e3,
        "DriveFrequency1": 323.6e3,
        "FreeAirAmplitude": 94e-9 / volt,
        "FreeAirPhase": math.degrees(far_phase(probe)),
        "AmplitudeSetpointVolts": float(scan["A1"].mean()) / volt,
        "ScanSize": 11 * step,
        "FastScanSize": 11 * step,
        "SlowScanSize": 7 * step,
    }
    for key, value in expected.items():
        assert stated.pop(key) == pytest.approx(value, rel=1e-9, abs=0), key
    assert set(stated) == {"InvOLS", "AmpInvOLS", "Amp2InvOLS"}
    assert not {1e-7, 1.09e-7, 2e-8} & set(stated.values())  # what stands for "never calibrated"


# --- overtone's own reader --------------------------------------------------------------------------


def test_a_scan_comes_back(scan: xr.Dataset, tmp_path: Path) -> None:
    path = tmp_path / "scan.ibw"
    save(scan, path)
    again = opened(path, corrected=True)
    assert set(again.data_vars) == {"height", *HARMONICS}
    for name in again.data_vars:
        np.testing.assert_allclose(again[name], scan[name], rtol=1.1 * FLOAT32, err_msg=str(name))
    for axis in ("x", "y"):
        np.testing.assert_allclose(again[axis], scan[axis], rtol=1e-12, atol=1e-20)
    assert float(again["y"][0]) > float(again["y"][-1])
    # one lever, stated once as tune and once as thermal
    recording = read_channels(path)
    assert [r.source for r in recording.resonances] == ["thermal"]
    assert not any(fact.factory_default for fact in recording.facts.values())
    back, probe = probe_of(again), demo_probe()
    assert back.cantilever.modes[0] == Mode(16.4, 161.8e3, 287.0)
    assert back.drive.frequency == probe.drive.frequency
    assert back.drive.free_amplitude == pytest.approx(probe.drive.free_amplitude, rel=1e-14, abs=0)
    assert "Rejected" not in "".join(provenance.findings(again))
    forces = [map_energy(which, probe)["F_cons"].sel(harmonic=1) for which in (scan, again)]
    np.testing.assert_allclose(forces[1], forces[0], rtol=1e-5)


def test_rounding_costs_less_than_a_ten_thousandth_of_the_noise(tmp_path: Path) -> None:
    """On the worst that a scan holds: A0 at 10 nm with 5 pm of noise, lags up to 180 deg with 0.1 deg."""
    random = np.random.default_rng(11)
    shape = (64, 64)
    values = {
        "A0": random.uniform(7.5e-9, 10e-9, shape),
        "A1": random.uniform(20e-9, 60e-9, shape),
        "phi1": random.uniform(0.0, math.pi, shape),
    }
    noise = {"A0": 5e-12, "A1": 50e-12, "phi1": math.radians(0.1)}
    scan = xr.Dataset({name: (("y", "x"), array) for name, array in values.items()})
    save(scan, tmp_path / "scan.ibw")
    stored = {channel.name: channel.values for channel in read_channels(tmp_path / "scan.ibw").channels}
    for name, channel in (("A0", "Deflection"), ("A1", "Amplitude"), ("phi1", "Phase")):
        error = stored[channel] - values[name]
        assert 0.0 < np.sqrt(np.mean(error**2)) < 1e-4 * noise[name], name
        assert np.abs(error).max() < 1e-4 * noise[name], name


def test_trace_and_retrace(scan: xr.Dataset, tmp_path: Path) -> None:
    lines = xr.concat([scan, scan.assign(A1=1.01 * scan["A1"])], dim="direction", combine_attrs="override")
    both = lines.assign_coords(direction=["retrace", "trace"])
    path = tmp_path / "both.ibw"
    save(both, path)
    with pytest.raises(ChannelError, match="one line direction"):
        opened(path)
    for line, factor in (("retrace", 1.0), ("trace", 1.01)):
        again = opened(path, direction=line)
        assert again.attrs["direction"] == line
        np.testing.assert_allclose(again["A1"], factor * scan["A1"], rtol=2 * FLOAT32)
        save(again, tmp_path / "one.ibw")
        assert {c.direction for c in read_channels(tmp_path / "one.ibw").channels} == {line}
    save(both.sel(direction="trace"), tmp_path / "one.ibw")
    assert {c.direction for c in read_channels(tmp_path / "one.ibw").channels} == {"trace"}
    names = [label for label in labels_of(independent(path), 2) if label.startswith("Amplitude")]
    assert names[:3] == ["AmplitudeTrace", "Amplitude2Trace", "Amplitude3Trace"]


def test_the_lift_pass_is_a_pass_of_its_own(scan: xr.Dataset, tmp_path: Path) -> None:
    lift = {f"lift_{name}": scan[name] * 0.5 for name in HARMONICS}
    path = tmp_path / "lift.ibw"
    save(scan.assign(lift).assign_attrs(lift_height=30e-9), path)
    labels = labels_of(independent(path), 2)
    assert [label for label in labels if label.startswith("Nap")] == [
        f"Nap{name}Retrace"
        for name in ("Amplitude", "Deflection", "Phase", "Amplitude2", "Phase2", "Amplitude3", "Phase3")
    ]
    main, far = opened(path), opened(path, lift=True)
    assert far.attrs["lift_height"] == 30e-9
    for name in HARMONICS:
        np.testing.assert_allclose(main[name], scan[name], rtol=1.1 * FLOAT32)
        np.testing.assert_allclose(far[name], scan[name] * 0.5, rtol=1.1 * FLOAT32)


def test_rows_and_columns_in_any_order(scan: xr.Dataset, tmp_path: Path) -> None:
    mixed = scan.isel(y=slice(None, None, -1), x=slice(None, None, -1)).transpose("x", "y")
    save(mixed, tmp_path / "mixed.ibw")
    save(scan, tmp_path / "scan.ibw")
    np.testing.assert_array_equal(
        independent(tmp_path / "mixed.ibw")["wData"], independent(tmp_path / "scan.ibw")["wData"]
    )


def test_pixels_without_place_and_pixels_without_value(scan: xr.Dataset, tmp_path: Path) -> None:
    bare = scan.drop_vars(["x", "y"]).copy(deep=True)
    bare["A1"][1, 2] = np.nan
    bare["phi2"][3, 4] = np.nan
    save(bare, tmp_path / "bare.ibw")
    again = opened(tmp_path / "bare.ibw")
    assert not again.coords
    for name in ("A1", "phi2"):
        np.testing.assert_allclose(again[name], bare[name], rtol=1.1 * FLOAT32, equal_nan=True)
    assert int(again["A1"].isnull().sum()) == int(again["phi2"].isnull().sum()) == 1


def test_one_line_and_a_place_far_away(scan: xr.Dataset, tmp_path: Path) -> None:
    line = scan.isel(y=slice(2, 3)).assign_coords(x=scan["x"] + 3e-6)
    save(line, tmp_path / "line.ibw")
    again = opened(tmp_path / "line.ibw")
    for axis in ("x", "y"):
        np.testing.assert_allclose(again[axis], line[axis], rtol=1e-12)


def test_a_height_of_the_sensor_goes_back_under_its_name(scan: xr.Dataset, tmp_path: Path) -> None:
    sensor = scan.copy()
    sensor["height"] = scan["height"].assign_attrs(channel="ZSensor")
    save(sensor, tmp_path / "scan.ibw")
    assert "ZSensorRetrace" in labels_of(independent(tmp_path / "scan.ibw"), 2)


def test_what_does_not_fit_is_named(scan: xr.Dataset, tmp_path: Path) -> None:
    more = scan.assign(modulus=scan["A1"], A9=scan["A1"], phi9=scan["phi1"], lift_height=scan["height"])
    more = more.assign(A4=("y", np.ones(8)))
    with pytest.warns(ChannelWarning, match="no place for modulus, A4: left out"):
        save(more, tmp_path / "scan.ibw")
    again = opened(tmp_path / "scan.ibw")
    assert {"A9", "phi9"} <= set(again.data_vars)
    assert "A4" not in again


def test_only_the_first_mode_of_a_lever(scan: xr.Dataset, tmp_path: Path) -> None:
    from overtone.readings import Reading, with_reading

    modes = (Mode(40.0, 237.6e3, 400.0), Mode(1571.0, 1.489e6, 600.0, 3.473))
    lever = Probe(Cantilever(modes, 38.8, 1.09), Drive(237.5e3, 94e-9), detector=Detector("slope"))
    save(with_reading(scan, Reading(lever)), tmp_path / "scan.ibw")
    back = probe_of(opened(tmp_path / "scan.ibw"))
    assert back.cantilever.modes == modes[:1]
    assert back.detector.kind == "displacement"
    # as the detector of all modes reads the phase, which the first alone does not quite predict
    stated = read_channels(tmp_path / "scan.ibw").facts["free_phase"].value
    assert stated == pytest.approx(far_phase(lever), rel=1e-12, abs=0)


def test_without_a_probe_the_note_says_nothing_of_it(scan: xr.Dataset, tmp_path: Path) -> None:
    bare = scan.assign_attrs()
    del bare.attrs["probe"]
    save(bare, tmp_path / "bare.ibw")
    recording = read_channels(tmp_path / "bare.ibw")
    assert (recording.vendor, recording.resonances) == ("asylum", ())
    assert "stiffness" not in recording.facts
    # a second lock-in of unknown frequency is no harmonic
    assert not {"A2", "A3"} & set(opened(tmp_path / "bare.ibw", probe=demo_probe()).data_vars)


# --- refusals ---------------------------------------------------------------------------------------


def test_uneven_pixels_are_refused(scan: xr.Dataset, tmp_path: Path) -> None:
    x = scan["x"].values.copy()
    x[3] += 0.01 * (x[1] - x[0])
    with pytest.raises(ObservablesError, match="x is not evenly spaced"):
        save(scan.assign_coords(x=x), tmp_path / "scan.ibw")


@pytest.mark.parametrize("names", [["approach", "retract"], ["trace", "trace"], ["up", "trace"]])
def test_other_directions_are_refused(scan: xr.Dataset, tmp_path: Path, names: list[str]) -> None:
    both = xr.concat([scan, scan], dim="direction", combine_attrs="override").assign_coords(direction=names)
    with pytest.raises(ObservablesError, match="expected trace and retrace, each once"):
        save(both, tmp_path / "scan.ibw")
    with pytest.raises(ObservablesError, match="directions of another kind"):
        save(both.drop_vars("direction"), tmp_path / "scan.ibw")


def test_other_dimensions_are_refused(scan: xr.Dataset, tmp_path: Path) -> None:
    with pytest.raises(ObservablesError, match="A1 over point"):
        save(scan.stack(point=("y", "x")).reset_index("point"), tmp_path / "scan.ibw")
    with pytest.raises(ObservablesError, match="A1 over setpoint, y, x"):
        save(scan.expand_dims("setpoint"), tmp_path / "scan.ibw")
    with pytest.raises(ObservablesError, match="observables lack A1"):
        save(scan[["phi1"]], tmp_path / "scan.ibw")


def test_a_failure_leaves_the_old_file(scan: xr.Dataset, tmp_path: Path) -> None:
    path = tmp_path / "scan.IBW"
    save(scan, path)
    before = path.read_bytes()
    with pytest.raises(ObservablesError):
        save(scan[["phi1"]], path)
    assert path.read_bytes() == before
    assert [file.name for file in tmp_path.iterdir()] == ["scan.IBW"]
    with pytest.raises(FileFormatError, match="folder"):
        write(scan, tmp_path / "missing" / "scan.ibw")


def test_the_same_data_make_the_same_file(scan: xr.Dataset, tmp_path: Path) -> None:
    save(scan, tmp_path / "a.ibw")
    first = (tmp_path / "a.ibw").read_bytes()
    save(scan, tmp_path / "a.ibw")
    assert (tmp_path / "a.ibw").read_bytes() == first
