"""Presets against silicon, the drag of air and their own files."""

import math
import tomllib
import warnings
from importlib import resources
from typing import Any

import numpy as np
import pytest
from scipy.special import kv

import overtone
from overtone.errors import OvertoneWarning, ProbeError, UncalibratedWarning
from overtone.harmonics import read_receptance
from overtone.presets import preset, presets
from overtone.probe import Probe, format_probe, parse_probe
from overtone.units import parse_quantity

FILES = {
    file.name: tomllib.loads(file.read_text(encoding="utf-8"))
    for file in (resources.files(overtone) / "probes").iterdir()
}
RECTANGULAR = sorted(name for name, table in FILES.items() if table["shape"] == "rectangular")
MEASURED: dict[str, Any] = {"stiffness": 36.0, "frequency": 312e3, "quality_factor": 430.0, "radius": 8e-9}


def quietly(name: str, **given: Any) -> Probe:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UncalibratedWarning)
        return preset(name, **({"free_amplitude": 40e-9} | given))


def geometry(name: str) -> dict[str, float]:
    nominal = FILES[name]["nominal"]
    values = {key: parse_quantity(nominal[key], "m") for key in ("length", "width", "thickness")}
    return values | {
        "stiffness": parse_quantity(nominal["stiffness"], "N/m"),
        "frequency": parse_quantity(nominal["frequency"], "Hz"),
    }


def test_every_file_is_a_preset_and_every_preset_a_file() -> None:
    assert set(presets()) == {table["name"] for table in FILES.values()}
    assert {name.casefold().replace(":", "-") + ".toml" for name in presets()} == set(FILES)
    assert 10 <= len(presets()) <= 20


@pytest.mark.parametrize("file", sorted(FILES))
def test_a_file_holds_what_it_should_and_says_what_is_assumed(file: str) -> None:
    table = FILES[file]
    assert set(table) == {"name", "maker", "shape", "nominal", "assumed"}
    assert table["shape"] in {"rectangular", "narrowing"}
    nominal = {"stiffness", "stiffness_range", "frequency", "radius", "length", "width", "thickness"}
    assert set(table["nominal"]) - {"tip_setback"} == nominal
    assert set(table["assumed"]) - {"tip_setback"} == {"quality_factor", "tip_mass"}
    assert ("tip_setback" in table["nominal"]) != ("tip_setback" in table["assumed"])
    low, high = (parse_quantity(end, "N/m") for end in table["nominal"]["stiffness_range"])
    assert low < geometry(file)["stiffness"] < high


@pytest.mark.parametrize("file", RECTANGULAR)
def test_nominal_stiffness_and_frequency_are_those_of_silicon_of_that_size(file: str) -> None:
    sheet = geometry(file)
    length, width, thickness = sheet["length"], sheet["width"], sheet["thickness"]
    modulus, density = 169e9, 2330.0
    stiffness = modulus * width * thickness**3 / (4 * length**3)
    frequency = 0.1615 * thickness / length**2 * math.sqrt(modulus / density)
    assert sheet["stiffness"] == pytest.approx(stiffness, rel=0.2, abs=0)
    assert sheet["frequency"] == pytest.approx(frequency, rel=0.2, abs=0)


def hydrodynamic(frequency: float, width: float) -> complex:
    """Return Sader's function of a rectangular lever in air, J. Appl. Phys. 84 (1998) 64, eqs 20 and 21."""
    reynolds = 1.18 * 2 * math.pi * frequency * width**2 / (4 * 1.86e-5)
    root = np.sqrt(1j * reynolds)
    circle = 1 + 4j * kv(1, -1j * root) / (root * kv(0, -1j * root))
    t = math.log10(reynolds)
    real = np.polyval([0.00069085, -0.0035117, 0.044055, -0.12886, 0.46842, -0.48274, 0.91324], t)
    real /= np.polyval([0.00069085, -0.0035862, 0.045155, -0.13444, 0.48690, -0.56964, 1.0], t)
    imag = np.polyval([-0.000044510, 0.000064577, -0.00010961, 0.016294, -0.029256, -0.024134], t)
    imag /= np.polyval([0.0028361, -0.014369, 0.079156, -0.18357, 0.55182, -0.59702, 1.0], t)
    return complex((real + 1j * imag) * circle)


@pytest.mark.parametrize("file", RECTANGULAR)
def test_quality_factors_stay_below_the_drag_of_air(file: str) -> None:
    sheet = geometry(file)
    rate = 2 * math.pi * sheet["frequency"]
    drag = 0.1906 * 1.18 * sheet["width"] ** 2 * sheet["length"] * rate**2
    limit = sheet["stiffness"] / (drag * hydrodynamic(sheet["frequency"], sheet["width"]).imag)
    assert 0.5 * limit < FILES[file]["assumed"]["quality_factor"] < limit


@pytest.mark.parametrize("file", RECTANGULAR)
def test_drag_broadens_higher_modes_about_as_the_root_of_frequency(file: str) -> None:
    # The assumption of beam_modes: Q_j = Q_1 sqrt(w_j/w_1).
    sheet = geometry(file)
    first, second = (hydrodynamic(r * sheet["frequency"], sheet["width"]).imag for r in (1.0, 6.267))
    exponent = math.log(first / second) / math.log(6.267)
    assert exponent == pytest.approx(0.5, rel=0, abs=0.06)


@pytest.mark.parametrize("name", presets())
def test_a_preset_is_a_probe_of_three_modes_on_an_optical_lever(name: str) -> None:
    with pytest.warns(UncalibratedWarning) as caught:
        probe = preset(name, free_amplitude=40e-9)
    message = str(caught[0].message)
    assert all(word in message for word in (name, "stiffness", "frequency", "quality factor", "radius"))
    assert probe.detector.kind == "slope"
    assert probe.drive.free_amplitude == 40e-9
    assert probe.drive.frequency == probe.cantilever.modes[0].frequency
    assert len(probe.cantilever.modes) == 3
    n = np.array([2.0])
    single = 1 / (probe.cantilever.modes[0].stiffness * (1 - n**2))
    gain = (read_receptance(probe, n * probe.drive.frequency) / single)[0].real
    assert 0.6 < gain < 0.9
    # The file that comes of it is the same probe.
    assert parse_probe(format_probe(probe)) == probe


def test_what_was_measured_is_kept_and_silences_the_warning() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error", OvertoneWarning)
        probe = preset("PPP-NCHR", free_amplitude=40e-9, drive_frequency=311e3, **MEASURED)
    mode = probe.cantilever.modes[0]
    assert (mode.stiffness, mode.frequency, mode.quality_factor) == (36.0, 312e3, 430.0)
    assert probe.tip.radius == 8e-9
    assert probe.drive.frequency == 311e3


@pytest.mark.parametrize("left_out", sorted(MEASURED))
def test_the_warning_names_what_is_left_nominal(left_out: str) -> None:
    given = {name: value for name, value in MEASURED.items() if name != left_out}
    with pytest.warns(UncalibratedWarning, match=left_out.replace("_", " ")) as caught:
        preset("PPP-NCHR", free_amplitude=40e-9, **given)
    message = str(caught[0].message)
    assert "is nominal" in message
    assert not any(f"{name.replace('_', ' ')} " in message for name in given)


def test_a_lever_that_narrows_is_doubtful_however_well_measured() -> None:
    with pytest.warns(UncalibratedWarning, match="narrows") as caught:
        preset("AC160TS-R3", free_amplitude=40e-9, **MEASURED)
    assert len(caught) == 1


def test_position_mass_spot_and_second_mode_can_be_given() -> None:
    usual = quietly("Tap300Al-G").cantilever
    at_end = quietly("Tap300Al-G", tip_position=1.0, tip_mass=0.0).cantilever
    assert at_end.modes[1].frequency / at_end.modes[0].frequency == pytest.approx(6.26689, rel=1e-5, abs=0)
    assert usual.modes[1].stiffness / at_end.modes[1].stiffness > 3
    spot = quietly("Tap300Al-G", spot_position=0.7).cantilever
    assert spot.modes[1].slope_ratio < usual.modes[1].slope_ratio
    measured = quietly("Tap300Al-G", higher_frequencies=[1.87e6]).cantilever
    assert [mode.frequency for mode in measured.modes] == [300e3, 1.87e6]


def test_the_tip_stands_behind_the_end_by_its_setback() -> None:
    # 15 um of 225 um; a force there bends a shorter beam.
    lever = quietly("Multi75Al-G", tip_mass=0.0).cantilever
    named = quietly("Multi75Al-G", tip_mass=0.0, tip_position=1 - 15 / 225).cantilever
    assert lever.modes[1].stiffness == pytest.approx(named.modes[1].stiffness, rel=1e-9, abs=0)


@pytest.mark.parametrize("name", ["hq:nsc15", "HQ-NSC15", "hq nsc15"])
def test_case_and_punctuation_do_not_matter(name: str) -> None:
    assert quietly(name) == quietly("HQ:NSC15")


def test_an_unknown_name_is_refused_with_near_ones() -> None:
    with pytest.raises(ProbeError, match=r"no preset 'PPP-NCHX'.*Try: .*PPP-NCHR"):
        preset("PPP-NCHX", free_amplitude=40e-9)
    with pytest.raises(ProbeError, match=r"Try: Probe\.simple"):
        preset("?", free_amplitude=40e-9)


def test_a_free_amplitude_is_wanted() -> None:
    with pytest.raises(TypeError, match="free_amplitude"):
        preset("PPP-NCHR")  # type: ignore[call-arg]
    with pytest.raises(ProbeError, match="free_amplitude"):
        quietly("PPP-NCHR", free_amplitude=0.0)
