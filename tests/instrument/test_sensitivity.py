from pathlib import Path

import numpy as np
import pytest
import xarray as xr

import overtone as ot
from overtone.beam import beam_modes
from overtone.errors import CurveWarning, ObservablesError, ProbeError, UnitError
from overtone.instrument.sensitivity import (
    Sensitivity,
    dynamic_from_amplitude,
    dynamic_from_static,
    dynamic_from_thermal,
    static_from_dynamic,
    static_sensitivity,
)
from overtone.instrument.thermal import BOLTZMANN, resonance_density
from overtone.io.spectrum import spectrum_array
from overtone.probe import Cantilever


def array(z: np.ndarray, values: np.ndarray, unit: str = "V") -> xr.DataArray:
    return xr.DataArray(values, dims="z", coords={"z": z}, attrs={"units": unit})


def force_curve(seed: int, *, noise: float = 5e-3, tilt: float = 2e4, value: float = 52e-9) -> xr.DataArray:
    """Deflection [V] on a hard surface at z = 0, with snap-in and a virtual deflection [V/m]."""
    z = np.linspace(-100e-9, 500e-9, 600)
    volts = np.where(z < 0.0, -z / value - 0.05 * (z > -2e-9), 0.0) + tilt * z + 0.3
    return array(z, volts + np.random.default_rng(seed).normal(0.0, noise, z.size))


def test_the_slope_in_contact_is_found_with_its_error() -> None:
    found = [static_sensitivity(force_curve(seed)) for seed in range(200)]
    z = np.array([(one.value - 52e-9) / one.error for one in found])
    assert abs(z.mean()) < 0.25
    assert 0.85 < (np.abs(z) < 1.645).mean() < 0.95
    assert {one.kind for one in found} == {"static"}


def test_either_direction_and_sign_will_do() -> None:
    curve = force_curve(1)
    value = static_sensitivity(curve).value
    turned = curve.assign_coords(z=-curve["z"])
    upside_down = (-curve).assign_attrs(curve.attrs)
    assert static_sensitivity(turned).value == pytest.approx(value, rel=1e-9, abs=0)
    assert static_sensitivity(upside_down).value == pytest.approx(value, rel=1e-9, abs=0)
    assert static_sensitivity(curve[::-1]).value == pytest.approx(value, rel=1e-12, abs=0)


def test_a_saturated_detector_is_left_out_by_the_range() -> None:
    curve = force_curve(2)
    clipped = curve.clip(max=1.9).assign_attrs(curve.attrs)
    assert static_sensitivity(clipped, between=(0.2, 0.85)).value == pytest.approx(52e-9, rel=0.01, abs=0)


def test_a_curve_that_never_touches_is_refused() -> None:
    curve = force_curve(3)
    with pytest.raises(ObservablesError, match="never touches"):
        static_sensitivity(curve.sel(z=slice(50e-9, None)))
    with pytest.raises(ObservablesError, match="never touches"):
        static_sensitivity(curve.copy(data=np.full(curve.size, 0.3)))
    with pytest.raises(UnitError, match="volts"):
        static_sensitivity(curve.assign_attrs(units="m"))
    with pytest.raises(ObservablesError, match="1 of them NaN"):
        static_sensitivity(curve.where(curve["z"] > -100e-9))
    with pytest.raises(ObservablesError, match="usable curve"):
        static_sensitivity(curve[:5])


def test_a_bent_contact_warns() -> None:
    curve = force_curve(4, noise=1e-3)
    z = curve["z"].values
    soft = curve.copy(data=curve.values + np.where(z < 0, 3e12 * z**2 * 5.0, 0.0))
    with pytest.warns(CurveWarning, match="bent"):
        static_sensitivity(soft)


def test_a_real_curve_on_a_sample_that_gives_way_is_no_calibration(afm_data: Path) -> None:
    recording = ot.read_channels(afm_data / "ibw_curves" / "ForceMetric_X60_3_x4_0100.ibw")
    column = {channel.name: channel.values for channel in recording.channels}
    volts = column["Defl"] / recording.facts["scale:Defl"].value
    with pytest.warns(CurveWarning, match="bent"):
        static_sensitivity(array(column["ZSnsr"][:664], volts[:664]))


def test_asylum_scales_amplitudes_by_the_ratio_of_a_uniform_beam(afm_data: Path) -> None:
    lever = beam_modes(stiffness=1.0, frequency=70e3, quality_factor=140.0)
    for path in sorted((afm_data / "ibw_curves").glob("*.ibw")):
        facts = ot.read_channels(path).facts
        static = Sensitivity(facts["scale:Defl"].value, "static")
        dynamic = dynamic_from_static(static, lever)
        assert facts["amplitude_sensitivity"].value == pytest.approx(dynamic.value, rel=5e-4, abs=0)


def test_static_and_dynamic_turn_into_each_other_and_say_which_they_are() -> None:
    lever = beam_modes(stiffness=40.0, frequency=300e3, quality_factor=450.0)
    static = Sensitivity(50e-9, "static", 1e-9, "slope of a force curve")
    dynamic = dynamic_from_static(static, lever)
    assert dynamic.kind == "dynamic"
    assert dynamic.value == pytest.approx(1.0897 * 50e-9, rel=1e-4, abs=0)
    assert dynamic.relative_error == pytest.approx(static.relative_error, rel=1e-12, abs=0)
    back = static_from_dynamic(dynamic, lever)
    assert (back.kind, back.value) == ("static", pytest.approx(50e-9, rel=1e-12, abs=0))
    with pytest.raises(ProbeError, match="dynamic already"):
        dynamic_from_static(dynamic, lever)
    with pytest.raises(ProbeError, match="static slope"):
        dynamic_from_static(static, Cantilever.single_mode(40.0, 300e3, 450.0))
    with pytest.raises(ProbeError, match="unknown kind"):
        Sensitivity(50e-9, "InvOLS")
    with pytest.raises(ProbeError, match="unphysical"):
        Sensitivity(-50e-9, "static")


def test_an_amplitude_curve_on_a_hard_surface_gives_the_dynamic_one() -> None:
    probe = ot.Probe.simple(stiffness=16.4, frequency=161.8e3, quality_factor=287, radius=10e-9,
                            drive_frequency=161.8e3, free_amplitude=94e-9)  # fmt: skip
    z = np.linspace(115e-9, 30e-9, 100)
    off = {}
    for modulus in (70e9, 2e9):
        material = ot.sample("hertz", modulus=modulus, poisson_ratio=0.3)
        curve = ot.approach_curve(probe, material, z=z)["A1"].sel(direction="approach")
        found = dynamic_from_amplitude(array(curve["z"].values, curve.values / 60e-9))
        assert found.kind == "dynamic"
        off[modulus] = found.value / 60e-9 - 1.0
    assert off[70e9] == pytest.approx(0.003, abs=0.001)
    assert off[2e9] == pytest.approx(0.015, abs=0.003)
    flat = array(z, np.full(z.size, 1.5))
    with pytest.raises(ObservablesError, match="fall far enough"):
        dynamic_from_amplitude(flat)


def test_a_known_stiffness_gives_the_dynamic_one_without_touching() -> None:
    f = np.arange(50.0, 300e3, 50.0)
    mean = BOLTZMANN * 300.0 / 16.4 * resonance_density(f, 161.8e3, 287.0) + 50e-15**2
    z = []
    for seed in range(60):
        drawn = mean * np.random.default_rng(seed).gamma(50.0, 1 / 50.0, f.size) / 60e-9**2
        found = dynamic_from_thermal(spectrum_array(f, drawn, "V^2/Hz"), 16.4, temperature=300.0)
        z.append((found.value - 60e-9) / found.error)
        assert found.kind == "dynamic"
    assert abs(np.mean(z)) < 0.45
    assert 0.75 < np.std(z) < 1.3
    blurred = dynamic_from_thermal(
        spectrum_array(f, drawn, "V^2/Hz"), 16.4, stiffness_error=1.64, temperature=300.0
    )
    assert blurred.relative_error == pytest.approx(np.hypot(found.relative_error, 0.05), rel=1e-6, abs=0)
    with pytest.raises(UnitError, match="no sensitivity"):
        dynamic_from_thermal(spectrum_array(f, drawn, "m^2/Hz"), 16.4)
    with pytest.raises(ProbeError, match="stiffness"):
        dynamic_from_thermal(spectrum_array(f, drawn, "V^2/Hz"), -1.0)
