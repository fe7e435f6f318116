import math
import time
import zlib

import numpy as np
import pytest

from overtone.errors import ChannelError, FileFormatError
from overtone.io.registry import read_channels
from overtone.io.selection import Request, choose

h5py = pytest.importorskip("h5py")

ROWS, COLUMNS, FRAMES = 3, 4, 2
RAW = np.arange(ROWS * COLUMNS * FRAMES, dtype="<i4").reshape(FRAMES, ROWS * COLUMNS).T * 1000 - 7000
GRID = {
    "ilength": COLUMNS,
    "jlength": ROWS,
    "ulength": 4e-6,
    "vlength": 3e-6,
    "theta": -0.0,
    "reflect": "false",
}
SETTINGS = {
    "feedback-settings.sine-generator-feedback-settings.frequency": 874578.9,
    "environment.feedback-mode.sine-generator-feedback-settings.frequency": "874578.9",
    "feedback-settings.sine-generator-feedback-settings.amplitude": 1.14,
    "feedback-settings.setpoint-feedback-settings.relative-setpoint": 0.75,
    "feedback-settings.setpoint-feedback-settings.setpoint-slot": "voltsamplitude",
    "feedback-settings.adjust-reference-amplitude-feedback-settings.reference-amplitude": 2.0,
    "feedback-settings.adjust-reference-amplitude-feedback-settings.enabled": "false",
    "environment.cantilever-calibration-info.defined": "true",
    "environment.cantilever-calibration-info.spring-constant": "197.984 mN/m",
    "environment.cantilever-calibration-info.sensitivity": "2.79370 nm/V",
    "environment.cantilever-calibration-info.frequency": "564.3 kHz",
    "environment.cantilever-calibration-info.qFactor": "1.493",
    "environment.cantilever-calibration-info.calibration-environment": "Water",
    "environment.cantilever-calibration-info.tip-radius": math.nan,
}


def scaling(group, multiplier, offset, unit, **more):
    own = {"type": "linear", "style": "offsetmultiplier", "multiplier": multiplier, "offset": offset}
    return {f"{group}.scaling.{key}": value for key, value in (own | {"unit.unit": unit} | more).items()}


def conversion(name, base, multiplier, offset, unit, defined="true"):
    own = {"base-calibration-slot": base, "defined": defined}
    return {f"conversion.{name}.{key}": value for key, value in own.items()} | scaling(
        f"conversion.{name}", multiplier, offset, unit
    )


AMPLITUDE = {
    **scaling("encoder", 5e-9, 0.5, "V"),
    **conversion("voltsamplitude", "volts", 2.0, 0.25, "V"),
    **conversion("distanceamplitude", "voltsamplitude", 3e-9, 1e-9, "m"),
    "conversion.volts.defined": "false",
    "conversions.base": "volts",
    "conversions.default": "distanceamplitude",
    "conversions.list": "voltsamplitude distanceamplitude",
    "encoder.type": "signedinteger",
    "channel.name": "amplitude",
    "channel.fancy-name": "Lock-In Amplitude",
}
PLAIN = AMPLITUDE | scaling("encoder", 5e-9, 0.0, "V") | conversion("voltsamplitude", "volts", 2.0, 0.0, "V")
PLAIN |= conversion("distanceamplitude", "voltsamplitude", 3e-9, 0.0, "m")
PHASE = {
    **scaling("encoder", 1e-3, 0.0, "deg"),
    "conversion.user.defined": "false",
    "conversions.base": "degrees",
    "conversions.default": "degrees",
    "conversions.list": "user",
    "channel.name": "phase",
    "channel.fancy-name": "Lock-In Phase",
}


def write(path, *channels, settings=SETTINGS, grid=GRID, root="JPK SCAN", **storage):
    """A .h5-jpk file; a channel is its attributes, its integers and the attribute retrace."""
    storage = {"chunks": (ROWS * COLUMNS, 1), "compression": "gzip", **storage}
    with h5py.File(path, "w") as file:
        file.attrs["file-format-info"] = np.bytes_(root)
        scan = file.create_group("Measurement_000")
        for key, value in settings.items():
            scan.attrs[key] = np.bytes_(value) if isinstance(value, str) else value
        for key, value in grid.items():
            scan.attrs[f"position-pattern.grid.{key}"] = np.bytes_(value) if isinstance(value, str) else value
        scan.attrs["position list"] = np.arange(5.0)
        for index, (attributes, raw, retrace) in enumerate(channels):
            group = scan.create_group(f"Channel_{index:03d}")
            for key, value in (attributes | ({"retrace": retrace} if retrace else {})).items():
                group.attrs[key] = np.bytes_(value) if isinstance(value, str) else value
            group.create_dataset("thumbnail", data=np.zeros((4, 1), "<i4"))
            group.create_dataset("Data", data=raw, **storage)
        scan.create_group("meta-data").create_dataset("relative-setpoint", data=np.full((FRAMES, 1), 0.75))
    return path


@pytest.fixture
def scan_of(tmp_path):
    def read(*channels, **arguments):
        return read_channels(write(tmp_path / "scan.h5-jpk", *channels, **arguments))

    return read


# --- channels -------------------------------------------------------------------------------------


def test_frames_and_chained_calibrations(scan_of):
    scan = scan_of((AMPLITUDE, RAW, "false"), (AMPLITUDE, RAW + 1, "true"), (PHASE, RAW, "false"))
    assert (scan.format, scan.vendor, scan.dims) == ("jpk_h5", "jpk", ("frame", "y", "x"))
    assert [(c.name, c.direction, c.unit, c.values.shape) for c in scan.channels] == [
        ("Lock-In Amplitude", "trace", "m", (2, 3, 4)),
        ("Lock-In Amplitude", "retrace", "m", (2, 3, 4)),
        ("Lock-In Phase", "trace", "rad", (2, 3, 4)),
    ]
    trace, retrace, phase = (channel.values for channel in scan.channels)
    for frame in range(FRAMES):
        for row in range(ROWS):
            for column in range(COLUMNS):
                raw = float(RAW[(ROWS - 1 - row) * COLUMNS + column, frame])
                volts = 2.0 * (5e-9 * raw + 0.5) + 0.25
                assert trace[frame, row, column] == pytest.approx(3e-9 * volts + 1e-9, rel=1e-12, abs=0)
                assert phase[frame, row, column] == pytest.approx(math.radians(1e-3 * raw), rel=1e-12)
    np.testing.assert_allclose(retrace - trace, 3e-17, rtol=1e-6)
    assert set(scan.coords) == {"y", "x"}
    np.testing.assert_allclose(scan.coords["x"], [0.5e-6, 1.5e-6, 2.5e-6, 3.5e-6])
    np.testing.assert_allclose(scan.coords["y"], [2.5e-6, 1.5e-6, 0.5e-6])
    assert scan.metadata["environment.cantilever-calibration-info.calibration-environment"] == "Water"
    assert "position list" not in scan.metadata


def test_one_frame_is_a_map(scan_of):
    scan = scan_of((PHASE, RAW[:, :1], "false"))
    assert (scan.dims, scan.channels[0].values.shape) == (("y", "x"), (3, 4))
    np.testing.assert_allclose(np.degrees(scan.channels[0].values[0]), RAW[8:, 0] * 1e-3)


def test_directions_do_not_mix(scan_of):
    scan = scan_of(*((kind, RAW[:, :1], way) for kind in (PLAIN, PHASE) for way in ("true", "false")))
    with pytest.raises(ChannelError, match="2 times"):
        choose(scan, Request())
    assert {c.direction for c in choose(scan, Request(direction="trace")).values()} == {"trace"}
    mixed = scan_of((PLAIN, RAW[:, :1], "true"), (PHASE, RAW[:, :1], "false"))
    with pytest.raises(ChannelError, match="do not mix"):
        choose(mixed, Request())
    assert scan_of((PHASE, RAW, None)).channels[0].direction is None


def test_reflected_scan_and_turned_scan(scan_of):
    scan = scan_of((PHASE, RAW, "false"), grid=GRID | {"reflect": "true", "theta": math.pi / 4})
    np.testing.assert_allclose(np.degrees(scan.channels[0].values[0, 0]), RAW[:4, 0] * 1e-3)
    assert "the scan was turned by 45 deg: x runs along its lines" in scan.notes


def test_amplitude_in_volts_where_it_is_not_calibrated(scan_of):
    own = PLAIN | {"conversion.distanceamplitude.defined": "false", "conversions.default": "voltsamplitude"}
    scan = scan_of((own, RAW, "false"))
    assert scan.channels[0].unit == "V"
    np.testing.assert_allclose(scan.channels[0].values[1, 2], 1e-8 * RAW[:4, 1])
    assert "free_amplitude" not in scan.facts
    assert scan.facts["setpoint_volts"].value == 1.5


def test_calibrated_amplitude_that_was_shown_in_volts(scan_of):
    scan = scan_of((PLAIN | {"conversions.default": "voltsamplitude"}, RAW, "false"))
    assert scan.channels[0].unit == "m"
    assert any("in metres by its calibration" in note for note in scan.notes)


@pytest.mark.parametrize("key", ["conversions.base", "encoder.scaling.multiplier", "encoder.scaling.type"])
def test_channel_without_calibration(scan_of, key):
    own = {name: value for name, value in PHASE.items() if name != key}
    scan = scan_of((own, RAW, "false"))
    if key == "conversions.base":
        assert scan.channels[0].unit == "rad"
        return
    assert scan.channels[0].unit is None
    np.testing.assert_array_equal(scan.channels[0].values[0, 2], RAW[:4, 0])
    assert any("no calibration" in note for note in scan.notes)


def test_ends_of_the_range_are_invalid(scan_of):
    raw = RAW.copy()
    raw[0, 1], raw[5, 0] = 2**31 - 1, -(2**31)
    scan = scan_of((PHASE, raw, "false"))
    lost = np.isnan(scan.channels[0].values)
    assert (lost.sum(), lost[1, 2, 0], lost[0, 1, 1]) == (2, True, True)
    assert any("2 invalid pixels" in note for note in scan.notes)


def test_facts(scan_of):
    scan = scan_of((PLAIN, RAW, "false"))
    facts = {name: (fact.value, fact.unit) for name, fact in scan.facts.items()}
    assert facts == {
        "stiffness": (0.197984, "N/m"),
        "deflection_sensitivity": (pytest.approx(2.7937e-9), "m/V"),
        "drive_frequency": (874578.9, "Hz"),
        "drive_amplitude": (1.14, "V"),
        "setpoint_fraction": (0.75, "1"),
        "amplitude_sensitivity": (pytest.approx(3e-9), "m/V"),
        "free_amplitude_volts": (2.0, "V"),
        "free_amplitude": (pytest.approx(6e-9), "m"),
        "setpoint_volts": (1.5, "V"),
        "setpoint_amplitude": (pytest.approx(4.5e-9), "m"),
    }
    assert scan.facts["drive_frequency"].key == "feedback-settings.sine-generator-feedback-settings.frequency"
    (resonance,) = scan.resonances
    assert (resonance.frequency, resonance.quality_factor, resonance.source) == (564300.0, 1.493, "thermal")
    assert any("calibrated in Water: 564.3 kHz, Q 1.493" in note for note in scan.notes)
    assert not any("set-point was changed" in note for note in scan.notes)


def test_setpoint_that_changes_between_frames(tmp_path):
    path = write(tmp_path / "scan.h5-jpk", (PLAIN, RAW, "false"))
    with h5py.File(path, "a") as file:
        file["Measurement_000/meta-data/relative-setpoint"][1, 0] = 0.5
    assert any("set-point was changed between frames" in note for note in read_channels(path).notes)


# --- which files ----------------------------------------------------------------------------------


def test_content_decides_not_the_name(tmp_path):
    path = write(tmp_path / "scan.h5", (PHASE, RAW, "false"))
    assert read_channels(path).format == "jpk_h5"
    path = write(tmp_path / "other.h5-jpk", (PHASE, RAW, "false"), root="SOMETHING")
    with pytest.raises(FileFormatError, match=r"other\.h5-jpk is not a JPK file.*the mark of JPK"):
        read_channels(path)


def test_other_hdf5_is_left_to_others(tmp_path):
    import xarray as xr

    from overtone.io.netcdf import save

    marked = {"file-format-info": "JPK SCAN", "history": "[]"}
    save(xr.Dataset({"A1": ("point", [1.0, 2.0], {"units": "m"})}, attrs=marked), tmp_path / "a.nc")
    assert read_channels(tmp_path / "a.nc").format == "netcdf"


# --- damage ---------------------------------------------------------------------------------------


def refuse(path, match):
    began = time.perf_counter()
    with pytest.raises(FileFormatError, match=match):
        read_channels(path)
    assert time.perf_counter() - began < 5.0


def test_truncated_file(tmp_path):
    path = write(tmp_path / "scan.h5-jpk", (PHASE, RAW, "false"))
    path.write_bytes(path.read_bytes()[:-1])
    refuse(path, r"scan\.h5-jpk is not a JPK file that is whole.*readable HDF5")


@pytest.mark.parametrize(("columns", "rows"), [(5, 3), (0, 3), ("many", 3), (10**12, 10**12), (-4, -3)])
def test_grid_that_does_not_fit(tmp_path, columns, rows):
    path = write(
        tmp_path / "scan.h5-jpk", (PHASE, RAW, "false"), grid=GRID | {"ilength": columns, "jlength": rows}
    )
    refuse(path, r"15 pixels by|as a positive whole number")


def test_channels_with_different_frames(tmp_path):
    path = write(tmp_path / "scan.h5-jpk", (PHASE, RAW, "false"), (PLAIN, RAW[:, :1], "false"))
    refuse(path, r"12 pixels by 2 frames in Channel_001, got \(12, 1\)")


def test_file_without_channels(tmp_path):
    refuse(write(tmp_path / "scan.h5-jpk"), "at least one channel, got none")


def huge(path, frames, **options):
    """A file whose channel claims many frames and holds none of them."""
    with h5py.File(write(path, (PHASE, RAW, "false")), "a") as file:
        group = file["Measurement_000/Channel_000"]
        del group["Data"]
        options = {"chunks": (12, 1), "compression": "gzip", **options}
        group.create_dataset("Data", shape=(12, frames), dtype="<i4", **options)
    return path


def test_claim_far_beyond_the_file(tmp_path):
    path = huge(tmp_path / "scan.h5-jpk", 10**9)
    assert path.stat().st_size < 100_000
    refuse(path, "channels that fit into a file of")


def test_frames_that_were_never_written(tmp_path):
    # HDF5 would read them as zeros.
    refuse(huge(tmp_path / "scan.h5-jpk", 1000), "expected 1000 blocks of data, got 0 blocks")
    path = huge(tmp_path / "scan.h5-jpk", 1000, chunks=None, compression=None)
    refuse(path, "expected 48000 bytes of data, got 0")


def test_blocks_far_larger_than_the_data(tmp_path):
    path = huge(tmp_path / "scan.h5-jpk", 2, chunks=(12, 2**24), maxshape=(12, None))
    refuse(path, "blocks of data, got 0 blocks of 805306368 bytes")


def test_block_that_unpacks_to_far_more(tmp_path):
    path = huge(tmp_path / "scan.h5-jpk", 1, chunks=(12, 1))
    with h5py.File(path, "a") as file:
        bomb = zlib.compress(bytes(300 << 20), 9)
        file["Measurement_000/Channel_000/Data"].id.write_direct_chunk((0, 0), bomb)
    assert path.stat().st_size < 1_000_000
    refuse(path, "blocks of 48 bytes, got a larger one")


def test_links_out_of_the_file(tmp_path):
    other = write(tmp_path / "other.h5", (PHASE, RAW, "false"))
    for link in (
        h5py.ExternalLink(other.name, "/Measurement_000/Channel_000/Data"),
        h5py.SoftLink("/Measurement_000/Channel_000/thumbnail"),
    ):
        path = write(tmp_path / "scan.h5-jpk", (PHASE, RAW, "false"))
        with h5py.File(path, "a") as file:
            del file["Measurement_000/Channel_000/Data"]
            file["Measurement_000/Channel_000/Data"] = link
        refuse(path, "a link to elsewhere")


def test_data_in_another_file(tmp_path):
    (tmp_path / "secret").write_bytes(bytes(96))
    path = huge(
        tmp_path / "scan.h5-jpk",
        2,
        chunks=None,
        compression=None,
        external=[(str(tmp_path / "secret"), 0, 96)],
    )
    refuse(path, "an array in another file")


def test_other_compressions(tmp_path):
    path = write(tmp_path / "scan.h5-jpk", (PHASE, RAW, "false"), compression="lzf")
    refuse(path, "without compression or with deflate")
    for options in ({"compression": None, "chunks": None}, {"shuffle": True, "fletcher32": True}):
        path = write(tmp_path / "scan.h5-jpk", (PHASE, RAW, "false"), **options)
        np.testing.assert_allclose(
            np.degrees(read_channels(path).channels[0].values[1, 2]), RAW[:4, 1] * 1e-3
        )


def test_damaged_files(tmp_path, survives):
    content = write(tmp_path / "whole.h5-jpk", (PLAIN, RAW, "false"), (PHASE, RAW, "false")).read_bytes()
    path, random, outcomes = tmp_path / "damaged.h5-jpk", np.random.default_rng(13), []
    for length in np.linspace(9, len(content) - 1, 20, dtype=int):
        outcomes.append(survives(path, content[:length]))
    assert not any(outcomes)
    for attempt in range(150):
        changed = bytearray(content)
        for at in random.integers(8, len(content), size=1 + attempt % 4):
            changed[at] = random.integers(0, 256)
        outcomes.append(survives(path, bytes(changed)))
    assert any(outcomes)


# --- the real file --------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def real(afm_data):
    return read_channels(afm_data / "jpk" / "AFMReader_sample_0.h5-jpk")


def named(recording, name, direction):
    return next(c for c in recording.channels if (c.name, c.direction) == (name, direction))


def test_real_channels(real):
    assert real.dims == ("frame", "y", "x")
    assert {(c.name, c.direction, c.unit, c.values.shape) for c in real.channels} == {
        (name, direction, unit, (4, 128, 128))
        for direction in ("trace", "retrace")
        for name, unit in {
            "Height": "m",
            "Lock-In Amplitude": "m",
            "Lock-In Phase": "rad",
            "Error Signal": "m",
        }.items()
    } | {("Height (measured)", "trace", "m", (4, 128, 128))}


@pytest.mark.parametrize(
    ("name", "frame", "unit", "pixels"),
    [
        ("Lock-In Amplitude", 0, 1e-9, "4.2504462578 4.2196640968 4.3040434184 4.2275881469 4.1971424052"),
        ("Lock-In Amplitude", 3, 1e-9, "4.1355951992 4.1891578651 4.0016022976 4.2164824255 4.2190629058"),
        (
            "Lock-In Phase",
            0,
            math.pi / 180,
            "28.813999957 25.238259323 23.45126327 26.5124954657 26.140359012",
        ),
        (
            "Lock-In Phase",
            3,
            math.pi / 180,
            "28.481779556 27.013582796 28.275453201 26.044961013 26.0161006889",
        ),
    ],
)
def test_real_pixels(real, name, frame, unit, pixels):
    values = named(real, name, "trace").values[frame] / unit
    found = [values[0, 0], values[0, -1], values[-1, 0], values[-1, -1], values[40, 100]]
    np.testing.assert_allclose(found, [float(number) for number in pixels.split()], rtol=3e-11)


def test_real_values_are_those_of_the_net_encoder(afm_data, real):
    # The software also writes down the whole chain of a channel in one step.
    with h5py.File(afm_data / "jpk" / "AFMReader_sample_0.h5-jpk") as file:
        scan = file["Measurement_000"]
        y = scan["Position_Values"][:, 1].reshape(128, 128)
        assert (np.diff(y[:, 0]) > 0.0).all()  # stored from the bottom
        for group in (scan[f"Channel_{index:03d}"] for index in range(9)):
            name = group.attrs["channel.fancy-name"].decode()
            direction = {b"true": "retrace", b"false": "trace"}[group.attrs["retrace"]]
            (data,) = (group[key][()] for key in group if key != "thumbnail")
            net = [group.attrs[f"net-encoder.scaling.{key}"] for key in ("multiplier", "offset")]
            expected = (data * net[0] + net[1]).T.reshape(4, 128, 128)[:, ::-1]
            if name == "Lock-In Phase":
                expected = np.radians(expected)
            np.testing.assert_allclose(named(real, name, direction).values, expected, rtol=1e-11, atol=1e-21)


def test_real_facts_agree_with_the_data(real):
    assert real.facts["stiffness"].value == 0.197984
    assert real.facts["drive_frequency"].value == 874578.9731207577
    assert real.facts["setpoint_fraction"].value == 0.7642388757525779
    # The feedback holds the amplitude at its set-point.
    assert named(real, "Lock-In Amplitude", "trace").values.mean() == pytest.approx(
        real.facts["setpoint_amplitude"].value, rel=0.002
    )
    assert real.coords["x"][0] == pytest.approx(150e-9 / 256)


def test_damaged_real_file(afm_data, tmp_path, survives):
    content = (afm_data / "jpk" / "AFMReader_sample_0.h5-jpk").read_bytes()
    random, path = np.random.default_rng(17), tmp_path / "damaged.h5-jpk"
    for length in np.linspace(9, len(content) - 1, 20, dtype=int):
        assert not survives(path, content[:length])
    for attempt in range(30):
        changed = bytearray(content)
        for at in random.integers(8, 60000, size=1 + attempt % 4):
            changed[at] = random.integers(0, 256)
        survives(path, bytes(changed))
