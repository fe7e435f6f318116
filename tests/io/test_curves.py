"""Approach curves: which points, which way up, where from; and what is refused."""

import math
import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import xarray as xr

import overtone as ot
from overtone import provenance
from overtone.cli import main
from overtone.errors import (
    ChannelError,
    ChannelWarning,
    FileFormatError,
    ObservablesError,
    OvertoneError,
    OvertoneWarning,
    ProbeError,
)
from overtone.harmonics import far_phase
from overtone.io.curves import open_curve
from overtone.io.export import load, save
from overtone.io.registry import read_channels
from overtone.probe import Probe, save_probe
from overtone.readings import Reading, probe_of, reading_of, with_reading

PROBE = Probe.simple(
    stiffness=30.0,
    frequency=300e3,
    quality_factor=300.0,
    drive_frequency=300e3,
    free_amplitude=20e-9,
    radius=10e-9,
)
NOTE = "\r".join(
    [
        "ImagingMode: AC Mode",
        "SpringConstant: 30",
        "InvOLS: 5e-08",
        "AmpInvOLS: 6e-08",
        "DriveFrequency: 300000",
        "DriveFrequency1: 600000",
        "ThermalFrequency: 300000",
        "ThermalQ: 300",
    ]
)
FREE = "\rFreeAirAmplitude: 0.33333333333333\rFreeAirPhase: 90"
COLUMNS = ("Raw", "Defl", "Amp", "Phase", "ZSnsr")


def quietly(path: Path, **arguments: object) -> xr.Dataset:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", OvertoneWarning)
        return open_curve(path, **arguments)  # type: ignore[arg-type]


def said(dataset: xr.Dataset) -> str:
    return "\n".join(provenance.findings(dataset))


def tapping(height: np.ndarray) -> dict[str, np.ndarray]:
    """A lever whose amplitude is cut by the sample, with 40 nm of offset in A0."""
    noise = np.random.default_rng(int(height.size)).normal(size=(3, height.size))
    first = np.where(height > 20e-9, 20e-9, height) + 5e-12 * noise[0]
    sine = np.clip(first / 20e-9, 0.0, 1.0)
    return {
        "Defl": 40e-9 + 1e-12 * noise[1] + 50e-12 * (height < 20e-9),
        "Amp": first,
        "Phase": np.degrees(np.arcsin(sine)) + 0.05 * noise[2],
    }


def base(*parts: tuple[float, float, int]) -> np.ndarray:
    """Heights of the base part by part, each from, to and points."""
    return np.concatenate([np.linspace(a, b, n) for a, b, n in parts])


THERE_AND_BACK = base((60e-9, 4e-9, 500), (4e-9, 60e-9, 420))


@pytest.fixture
def write(tmp_path: Path, igor_wave: Callable[..., bytes]) -> Callable[..., Path]:
    def make(
        height: np.ndarray,
        *,
        indexes: str,
        direction: str = "NaN,1,-1,",
        columns: tuple[str, ...] = COLUMNS,
        sensor: float = -1.0,
        note: str = NOTE + FREE,
        change: Callable[[dict[str, np.ndarray]], None] | None = None,
        step: float = 1e-3,
        unit: str = "s",
    ) -> Path:
        values = tapping(height) | {"ZSnsr": sensor * height + 3e-6, "Raw": sensor * height * 1.02}
        if change is not None:
            change(values)
        text = note + f"\rIndexes: {indexes}\rDirection: {direction}"
        wave = np.stack([values[name] for name in columns], axis=-1)
        path = tmp_path / "curve.ibw"
        path.write_bytes(
            igor_wave(
                wave, note=text, labels=[(), columns], steps=(step, 1, 1, 1), axis_units=(unit, "", "", "")
            )
        )
        return path

    return make


# --- a real curve -----------------------------------------------------------------------------------


def raw(path: Path) -> np.ndarray:
    from igor2 import binarywave

    return np.asarray(binarywave.load(str(path))["wave"]["wData"], dtype=float)


@pytest.mark.parametrize(
    ("direction", "points"), [("approach", slice(0, 7644)), ("retract", slice(7644, 15286))]
)
def test_a_real_curve(afm_data: Path, direction: str, points: slice) -> None:
    path = afm_data / "ibw_curves" / "LRCol0_MS_LG7d0001.ibw"
    curve = quietly(path, direction=direction)
    stated = raw(path)[points]
    order = np.argsort(stated[:, 4], kind="stable")  # the sensor grows towards the sample
    np.testing.assert_array_equal(curve["z"], -stated[order, 4])
    np.testing.assert_array_equal(curve["A0"], stated[order, 1])
    np.testing.assert_array_equal(curve["A1"], stated[order, 2])
    np.testing.assert_allclose(curve["phi1"], np.radians(stated[order, 3]), rtol=1e-14)
    assert (np.diff(curve["z"]) <= 0.0).all()
    assert float(curve["A1"][:100].mean()) > 10 * float(curve["A1"][-100:].mean())
    assert curve["z"].attrs["zero"] == "arbitrary"
    assert str(curve["direction"].values) == direction
    start = points.start * 6e-5
    times = np.sort(curve["time"].values)
    assert times[0] == pytest.approx(start, rel=1e-9, abs=1e-12)
    assert np.diff(times) == pytest.approx(6e-5, rel=1e-6)
    assert set(curve.data_vars) == {"A0", "A1", "phi1"}
    assert "The height z is minus ZSnsr" in said(curve)
    # No free amplitude in the file; the tune says 2.142 nm at its peak.
    assert probe_of(curve).drive.free_amplitude == pytest.approx(2.125e-9, rel=2e-3, abs=0)
    assert "median of the far end" in said(curve)


@pytest.mark.parametrize("name", ["afmformats_SiN_FD_plot", "ForceMetric_X60_3_x4_0100"])
def test_static_curves_lack_amplitude_and_phase(afm_data: Path, name: str) -> None:
    with pytest.raises(ChannelError, match=r"no channel for A1 and phi1.*got Raw, Defl, ZSnsr"):
        open_curve(afm_data / "ibw_curves" / f"{name}.ibw", probe=PROBE)


def test_a_scan_is_no_curve(afm_data: Path) -> None:
    with pytest.raises(ChannelError, match="holds no curve over height"):
        open_curve(afm_data / "ibw" / "AR_20211011.ibw")


# --- segments of an Asylum wave ---------------------------------------------------------------------


@pytest.mark.parametrize("sensor", [1.0, -1.0])
@pytest.mark.parametrize("direction", ["approach", "retract"])
def test_unequal_segments_and_either_sign_of_the_sensor(
    write: Callable[..., Path], sensor: float, direction: str
) -> None:
    path = write(THERE_AND_BACK, indexes="0,499,919", sensor=sensor)
    curve = quietly(path, direction=direction)
    approach = direction == "approach"
    points = slice(0, 500) if approach else slice(500, 920)
    assert curve.sizes["z"] == (500 if approach else 420)
    # z runs with the base, whichever way the sensor counts; its zero is that of the sensor.
    offset = 3e-6 if sensor > 0.0 else -3e-6
    np.testing.assert_allclose(curve["z"] - offset, np.sort(THERE_AND_BACK[points])[::-1], rtol=0, atol=1e-12)
    values = tapping(THERE_AND_BACK)
    order = slice(None) if approach else slice(None, None, -1)
    np.testing.assert_allclose(curve["A1"], values["Amp"][points][order], rtol=1e-6)
    np.testing.assert_allclose(curve["A0"], values["Defl"][points][order], rtol=1e-6)
    np.testing.assert_allclose(curve["time"], (np.arange(920) * 1e-3)[points][order], rtol=1e-12)
    assert ("minus ZSnsr" in said(curve)) == (sensor < 0.0)


def test_dwells_belong_to_neither_way(write: Callable[..., Path]) -> None:
    height = base((60e-9, 4e-9, 300), (4e-9, 4e-9, 77), (4e-9, 60e-9, 250), (60e-9, 60e-9, 30))
    path = write(height, indexes="0,299,376,626,656", direction="NaN,1,0,-1,0")
    approach, retract = quietly(path), quietly(path, direction="retract")
    assert (approach.sizes["z"], retract.sizes["z"]) == (300, 250)
    np.testing.assert_allclose(retract["A1"], tapping(height)["Amp"][377:627][::-1], rtol=1e-6)
    assert "Parts in which the base stands still were left out: 2." in said(approach)


def test_the_way_back_may_come_first(write: Callable[..., Path]) -> None:
    height = base((4e-9, 60e-9, 420), (60e-9, 4e-9, 500))
    path = write(height, indexes="0,419,919", direction="NaN,-1,1")
    with warnings.catch_warnings():
        warnings.simplefilter("error", ChannelWarning)
        warnings.filterwarnings("ignore", category=OvertoneWarning, message="(?!.*exchanged)")
        approach = open_curve(path)
    assert approach.sizes["z"] == 500
    np.testing.assert_allclose(approach["A1"], tapping(height)["Amp"][420:], rtol=1e-6)


def test_exchanged_ways_are_noticed(write: Callable[..., Path]) -> None:
    path = write(THERE_AND_BACK, indexes="0,499,919", direction="NaN,-1,1")
    match = r"calls this the approach, but.*away from.*may be exchanged"
    with pytest.warns(ChannelWarning, match=match), warnings.catch_warnings():
        warnings.filterwarnings("ignore", category=OvertoneWarning, message="(?!.*exchanged)")
        curve = open_curve(path, probe=PROBE)
    assert curve.sizes["z"] == 420
    assert (np.diff(curve["z"]) < 0).all()
    assert float(curve["A1"][0]) > float(curve["A1"][-1])


def test_the_first_of_several_approaches(write: Callable[..., Path]) -> None:
    height = base((60e-9, 4e-9, 300), (4e-9, 60e-9, 100), (60e-9, 4e-9, 200), (4e-9, 60e-9, 100))
    curve = quietly(write(height, indexes="0,299,399,599,699", direction="NaN,1,-1,1,-1"))
    assert curve.sizes["z"] == 300
    assert "holds 2 ways of the kind approach" in said(curve)


def test_a_last_index_behind_the_last_point(write: Callable[..., Path]) -> None:
    assert quietly(write(THERE_AND_BACK, indexes="0,499,920"), direction="retract").sizes["z"] == 420


@pytest.mark.parametrize(
    ("indexes", "direction"),
    [
        ("0,499", "NaN,1,-1"),  # one end too few
        ("0,499,5000", "NaN,1,-1"),  # beyond the data
        ("0,499,800", "NaN,1,-1"),  # ends before them
        ("0,499,400,919", "NaN,1,0,-1"),  # falls
        ("5,499,919", "NaN,1,-1"),
        ("-1,499,919", "NaN,1,-1"),
        ("0,4x9,919", "NaN,1,-1"),
        ("0,499.5,919", "NaN,1,-1"),
        ("0,499,919", "NaN,1,7"),
        ("0,499,919", "NaN,1"),
        ("0,499,919", ""),
        ("", ""),
        ("NaN", "NaN"),
        ("0", "NaN"),
    ],
)
def test_damaged_indexes_are_named(write: Callable[..., Path], indexes: str, direction: str) -> None:
    with pytest.raises(FileFormatError, match=r"does not say where approach and retract begin and end.*919"):
        open_curve(write(THERE_AND_BACK, indexes=indexes, direction=direction), probe=PROBE)


def test_a_way_that_is_not_there(write: Callable[..., Path]) -> None:
    path = write(THERE_AND_BACK[:500], indexes="0,499", direction="NaN,1")
    assert quietly(path).sizes["z"] == 500
    with pytest.raises(ChannelError, match="has no retract: expected approach"):
        open_curve(path, probe=PROBE, direction="retract")
    with pytest.raises(ChannelError, match="unknown direction of a curve"):
        open_curve(path, direction="trace")


# --- channels of a curve ----------------------------------------------------------------------------


def test_the_sensor_before_the_piezo(write: Callable[..., Path]) -> None:
    with_sensor = quietly(write(THERE_AND_BACK, indexes="0,499,919"))
    without = quietly(write(THERE_AND_BACK, indexes="0,499,919", columns=COLUMNS[:-1]))
    assert float(np.ptp(with_sensor["z"].values)) == pytest.approx(56e-9, rel=1e-4, abs=0)
    assert float(np.ptp(without["z"].values)) == pytest.approx(1.02 * 56e-9, rel=1e-4, abs=0)
    assert "what the piezo was told" in said(without)
    with pytest.raises(ChannelError, match="a channel ZSnsr or ZSensor or Raw"):
        open_curve(write(THERE_AND_BACK, indexes="0,499,919", columns=COLUMNS[1:-1]), probe=PROBE)


def test_a_second_lock_in_at_twice_the_drive(write: Callable[..., Path]) -> None:
    def second(values: dict[str, np.ndarray]) -> None:
        values |= {"Amp2": values["Amp"] / 500.0, "Phas2": 2.0 * values["Phase"]}

    columns = (*COLUMNS, "Amp2", "Phas2")
    curve = quietly(write(THERE_AND_BACK, indexes="0,499,919", columns=columns, change=second))
    np.testing.assert_allclose(curve["A2"], curve["A1"] / 500.0, rtol=1e-6)
    np.testing.assert_allclose(curve["phi2"], 2.0 * curve["phi1"], rtol=1e-6)
    dual = (NOTE + FREE).replace("600000", "450000")
    two_tones = quietly(write(THERE_AND_BACK, indexes="0,499,919", columns=columns, change=second, note=dual))
    assert "A2" not in two_tones


def test_the_far_end_gives_the_zero_so_an_offset_stays(write: Callable[..., Path]) -> None:
    curve = quietly(write(THERE_AND_BACK, indexes="0,499,919"))
    assert float(curve["A0"][:50].mean()) == pytest.approx(40e-9, rel=1e-4, abs=0)
    assert "not used" not in said(curve)
    assert "its zero far from the surface is not known" in said(curve)
    corrected = reading_of(quietly(write(THERE_AND_BACK, indexes="0,499,919"), probe=PROBE, corrected=True))
    assert corrected is not None
    assert "its zero" not in corrected.doubts.get(0, "")


def test_the_phase_reference_is_as_in_a_scan(write: Callable[..., Path]) -> None:
    path = write(THERE_AND_BACK, indexes="0,499,919")
    stored = quietly(path, probe=PROBE)
    turned = quietly(path, probe=PROBE, far_phase=math.radians(80.0))
    shift = far_phase(PROBE) - math.radians(80.0)
    np.testing.assert_allclose(turned["phi1"] - stored["phi1"], shift, rtol=1e-12)
    lead = quietly(path, probe=PROBE, far_phase=math.radians(80.0), phase_sign=-1)
    np.testing.assert_allclose(
        lead["phi1"], far_phase(PROBE) + math.radians(80.0) - stored["phi1"], rtol=1e-12
    )


def test_a_free_amplitude_out_of_a_far_end_that_is_not_steady_is_not_taken(
    write: Callable[..., Path],
) -> None:
    steady = quietly(write(THERE_AND_BACK, indexes="0,499,919", note=NOTE))
    assert probe_of(steady).drive.free_amplitude == pytest.approx(20e-9, rel=1e-3, abs=0)
    # 18 nm is within reach of the sample
    near = write(base((18e-9, 4e-9, 300), (4e-9, 18e-9, 300)), indexes="0,299,599", note=NOTE)
    with pytest.raises(ProbeError, match="no free amplitude"):
        open_curve(near)


def test_rows_without_height_or_value(write: Callable[..., Path]) -> None:
    def lose(values: dict[str, np.ndarray]) -> None:
        values["ZSnsr"][3:10] = np.nan
        values["Amp"][20:25] = np.nan
        values["Defl"][30] = np.inf

    path = write(THERE_AND_BACK, indexes="0,499,919", change=lose)
    with pytest.warns(ChannelWarning, match="7 of 500 points have no height"), warnings.catch_warnings():
        warnings.filterwarnings("ignore", category=OvertoneWarning, message="(?!.*no height)")
        curve = open_curve(path, probe=PROBE)
    assert curve.sizes["z"] == 493
    assert np.isfinite(curve["z"]).all()
    assert int(np.isnan(curve["A1"]).sum()) == 5  # a lost value is NaN, and not filled


@pytest.mark.parametrize("lost", ["ZSnsr", "Amp", "Phase"])
def test_too_few_points_are_counted(write: Callable[..., Path], lost: str) -> None:
    def lose(values: dict[str, np.ndarray]) -> None:
        values[lost][19:] = np.nan

    with pytest.raises(ChannelError, match="at least 20 points with height, A1 and phi1, got 19 of 500"):
        open_curve(write(THERE_AND_BACK, indexes="0,499,919", change=lose), probe=PROBE)


def test_a_curve_that_never_reaches_the_sample_has_no_way_up(write: Callable[..., Path]) -> None:
    path = write(base((90e-9, 40e-9, 100), (40e-9, 90e-9, 100)), indexes="0,99,199")
    with pytest.raises(ChannelError, match="the amplitude falls towards neither end"):
        open_curve(path, probe=PROBE)


def test_a_clipped_channel_of_a_curve(write: Callable[..., Path]) -> None:
    def clip(values: dict[str, np.ndarray]) -> None:
        values["Defl"] = np.minimum(values["Defl"], 40e-9)

    with pytest.warns(ChannelWarning, match=r"A0 \(Defl\) is saturated"), warnings.catch_warnings():
        warnings.filterwarnings("ignore", category=OvertoneWarning, message="(?!.*saturated)")
        open_curve(write(THERE_AND_BACK, indexes="0,499,919", change=clip), probe=PROBE)


# --- curves of overtone -----------------------------------------------------------------------------

SAMPLE = "dmt, modulus=2 GPa, poisson_ratio=0.35, adhesion=8 nN"


@pytest.fixture(scope="module")
def simulated() -> xr.Dataset:
    material = ot.sample("dmt", modulus=2e9, poisson_ratio=0.35, adhesion=8e-9)
    curve = ot.approach_curve(PROBE, material, z=np.linspace(3e-9, 26e-9, 40))
    return with_reading(curve, Reading(PROBE, corrected=True))


@pytest.mark.parametrize("direction", ["approach", "retract"])
def test_a_simulated_curve_comes_back(simulated: xr.Dataset, tmp_path: Path, direction: str) -> None:
    save(simulated, tmp_path / "curve.nc")
    curve = open_curve(tmp_path / "curve.nc", direction=direction)
    truth = simulated.sel(direction=direction)
    np.testing.assert_array_equal(curve["z"], simulated["z"])
    for name in ("A0", "A1", "phi1", "A2", "phi2", "A3", "phi3"):
        np.testing.assert_array_equal(curve[name], truth[name])
    assert curve["z"].attrs["zero"] == "surface"
    assert str(curve["direction"].values) == direction
    assert probe_of(curve) == PROBE
    # the two ways differ, or the choice would prove nothing
    assert not np.allclose(
        *(simulated["A1"].sel(direction=way) for way in ("approach", "retract")), rtol=1e-3, atol=0
    )


@pytest.mark.parametrize("direction", ["approach", "retract"])
def test_the_files_of_the_command_line(tmp_path: Path, direction: str) -> None:
    save_probe(PROBE, tmp_path / "probe.toml")
    arguments = ["--probe", "probe.toml", "--sample", SAMPLE, "--z", "3 nm to 26 nm", "--points", "40"]
    arguments[1] = str(tmp_path / "probe.toml")
    files = ["-o", str(tmp_path / "curve.nc"), "--csv", str(tmp_path / "curve.csv")]
    with pytest.raises(SystemExit) as stop:
        main(["simulate", "curve", *arguments, *files])
    assert not stop.value.code
    binary = open_curve(tmp_path / "curve.nc", direction=direction)
    text = open_curve(tmp_path / "curve.csv", direction=direction, probe=PROBE, corrected=True)
    np.testing.assert_allclose(text["z"], binary["z"], rtol=1e-9)
    for name in ("A0", "A1", "phi1", "A2", "phi2"):
        np.testing.assert_allclose(text[name], binary[name], rtol=1e-8)
    assert binary["z"].attrs["zero"] == text["z"].attrs["zero"] == "surface"
    assert "direction" not in text.data_vars


def test_what_was_opened_can_be_saved_and_opened_again(write: Callable[..., Path], tmp_path: Path) -> None:
    """An arbitrary zero stays one; so does the way."""
    curve = quietly(write(THERE_AND_BACK, indexes="0,499,919"), direction="retract")
    save(curve, tmp_path / "again.nc")
    xr.testing.assert_identical(load(tmp_path / "again.nc"), curve)
    again = quietly(tmp_path / "again.nc", direction="retract")
    assert again["z"].attrs["zero"] == "arbitrary"
    assert str(again["direction"].values) == "retract"
    np.testing.assert_array_equal(again["A1"], curve["A1"])
    with pytest.raises(ChannelError, match="has no approach: expected retract"):
        open_curve(tmp_path / "again.nc")


def table(folder: Path, header: str, rows: list[str]) -> Path:
    path = folder / "curve.csv"
    path.write_text("\n".join([header, *rows]))
    return path


ROWS = [f"{z}, {min(z, 20)}, {90 if z > 20 else 4.5 * z}" for z in range(40, 4, -1)]


def test_a_table_without_a_way(tmp_path: Path) -> None:
    path = table(tmp_path, "z [nm], A1 [nm], phi1 [deg]", ROWS)
    curve = open_curve(path, probe=PROBE, corrected=True, direction="retract")
    assert curve["z"].attrs["zero"] == "arbitrary"  # somebody else's table
    assert "direction" not in curve.coords
    assert "does not say which way" in said(curve)
    np.testing.assert_allclose(curve["z"], np.arange(40, 4, -1) * 1e-9, rtol=1e-12)


def test_a_table_with_lost_cells(tmp_path: Path) -> None:
    rows = [*ROWS[:5], "nan, 20, 90", *ROWS[5:], "3, nan, nan"]
    with pytest.warns(ChannelWarning, match="1 of 38 points have no height"):
        curve = open_curve(table(tmp_path, "z [nm], A1 [nm], phi1 [deg]", rows), probe=PROBE, corrected=True)
    assert curve.sizes["z"] == 37
    assert np.isnan(curve["A1"].values[-1])


def test_a_table_whose_height_counts_down(tmp_path: Path) -> None:
    rows = [f"{60 - z}, {min(z, 20)}, {90 if z > 20 else 4.5 * z}" for z in range(40, 4, -1)]
    with pytest.warns(ChannelWarning, match="does it count the other way"):
        open_curve(table(tmp_path, "z [nm], A1 [nm], phi1 [deg]", rows), probe=PROBE, corrected=True)


@pytest.mark.parametrize("odd", ["2", "0.5", ""])
def test_a_column_of_other_ways(tmp_path: Path, odd: str) -> None:
    rows = [f"{row}, 0" for row in ROWS] + [f"4, 4, 18, {odd}"]
    path = table(tmp_path, "z [nm], A1 [nm], phi1 [deg], direction [1]", rows)
    with pytest.raises(ChannelError, match=r"0 \(approach\) or 1 \(retract\) in every row"):
        open_curve(path, probe=PROBE)


def test_a_table_with_one_way(tmp_path: Path) -> None:
    path = table(tmp_path, "z [nm], A1 [nm], phi1 [deg], direction [1]", [f"{row}, 0" for row in ROWS])
    assert open_curve(path, probe=PROBE, corrected=True).sizes["z"] == 36
    with pytest.raises(ChannelError, match="has no retract: expected approach"):
        open_curve(path, probe=PROBE, direction="retract")


def test_a_table_without_height(tmp_path: Path) -> None:
    path = table(tmp_path, "A1 [nm], phi1 [deg]", [row.split(", ", 1)[1] for row in ROWS])
    with pytest.raises(ChannelError, match="one column or dimension z in m"):
        open_curve(path, probe=PROBE)


def test_too_short_a_table(tmp_path: Path) -> None:
    path = table(tmp_path, "z [nm], A1 [nm], phi1 [deg]", ROWS[:19])
    with pytest.raises(ChannelError, match="got 19 of 19"):
        open_curve(path, probe=PROBE)


# --- curves as Igor waves ---------------------------------------------------------------------------


@pytest.mark.parametrize("direction", ["approach", "retract"])
def test_a_curve_goes_through_an_igor_wave(simulated: xr.Dataset, tmp_path: Path, direction: str) -> None:
    path = tmp_path / "curve.ibw"
    with pytest.warns(ChannelWarning, match="no place for.*jump"):
        save(simulated, path)
    recording = read_channels(path)
    assert [c.name for c in recording.channels] == [
        "Amp",
        "Defl",
        "Phase",
        "Amp2",
        "Phas2",
        "Amp3",
        "Phas3",
        "ZSnsr",
    ]
    assert (recording.metadata["Indexes"], recording.metadata["Direction"]) == ("0,39,79", "NaN,1,-1,")
    curve = quietly(path, direction=direction, probe=PROBE, corrected=True)
    truth = simulated.sel(direction=direction)
    np.testing.assert_allclose(curve["z"], simulated["z"], rtol=6e-8)
    for name in ("A0", "A1", "A2", "A3", "phi1", "phi2", "phi3"):
        np.testing.assert_allclose(curve[name], truth[name], rtol=1e-7)
    assert curve["z"].attrs["zero"] == "arbitrary"
    # the base goes down and up again, as a microscope records it
    sensor = next(c.values for c in recording.channels if c.name == "ZSnsr")
    assert (np.diff(sensor[:40]) > 0).all()
    assert (np.diff(sensor[40:]) < 0).all()


def test_one_way_alone_as_an_igor_wave(simulated: xr.Dataset, tmp_path: Path) -> None:
    back = simulated[["A0", "A1", "phi1"]].sel(direction="retract")
    save(back, tmp_path / "back.ibw")
    curve = quietly(tmp_path / "back.ibw", direction="retract", probe=PROBE)
    np.testing.assert_allclose(curve["A1"], back["A1"], rtol=1e-7)
    with pytest.raises(ChannelError, match="has no approach"):
        open_curve(tmp_path / "back.ibw", probe=PROBE)
    with pytest.raises(ObservablesError, match="no height"):
        save(back.drop_vars("z"), tmp_path / "back.ibw")


def test_files_cut_short_or_changed_never_end_in_a_traceback(
    write: Callable[..., Path], tmp_path: Path
) -> None:
    content = write(THERE_AND_BACK, indexes="0,499,919").read_bytes()
    path = tmp_path / "damaged.ibw"
    random = np.random.default_rng(4)
    note_at = content.index(b"Indexes")
    for attempt in range(40):
        changed = bytearray(content)
        changed[random.integers(note_at, note_at + 40)] = random.integers(32, 127)
        path.write_bytes(bytes(changed) if attempt % 2 else content[: int(random.integers(0, len(content)))])
        try:
            size = quietly(path, probe=PROBE).sizes["z"]
        except OvertoneError as error:
            size = 20 * (len(str(error)) < 1000)
        assert size >= 20
