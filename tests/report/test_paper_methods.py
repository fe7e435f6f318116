"""Methods paragraphs: every number of the provenance stands in them, and nothing that is not known is made up."""

import json
import runpy
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest
import xarray as xr

from overtone import provenance
from overtone._version import __version__
from overtone.instrument.calibration import format_calibration
from overtone.instrument.correct import calibration_of
from overtone.report.paper_facts import facts_of, metadata_rows, metadata_table
from overtone.report.paper_methods import methods_paragraphs, methods_text

world = SimpleNamespace(**runpy.run_path(str(Path(__file__).parents[1] / "plots" / "population.py")))
SIZE = 20


@pytest.fixture(scope="module")
def scan() -> xr.Dataset:
    return world.calibrated(world.observables(2, size=SIZE))


@pytest.fixture(scope="module")
def result(scan: xr.Dataset) -> xr.Dataset:
    return world.result(scan, 2)


def text_of(scan: xr.Dataset, result: xr.Dataset) -> str:
    return "\n".join(methods_paragraphs(facts_of(scan, result), result))


def test_the_numbers_of_the_provenance_are_there(scan, result):
    text = text_of(scan, result)
    for part in (
        "20 x 20 pixels (800 nm x 800 nm)",
        "blend.ibw",
        "stiffness of 16.4 N/m",
        "resonance frequency of 161.8 kHz",
        "quality factor of 287",
        "tip radius of 10 nm",
        "driven at 161.8 kHz to a free amplitude of 94 nm",
        "set-point A1/A1far of 0.426",
        "mean deflection and amplitude and phase of harmonics 1, 2 and 3",
        "calibrated (curve.ibw)",
        "PS (Poisson's ratio 0.35; modulus 2 GPa known to 10 %)",
        "zero of A0 1.2 pm",
        "zero of phi1 0.1 deg",
        "gain of A2 0.7 %",
        "stiffness 5 %",
        "radius 10 %",
        "contact model dmt-viscous (DMT with van der Waals attraction and a Kelvin-Voigt contact)",
        "Poisson's ratio of the sample of 0.37",
        "intermolecular distance of 200 pm",
        "conservative force harmonics 0, 1, 2 and 3 and the dissipative ones 1 and 2",
        "motion of the tip with its higher harmonics",
        "A0 5 pm, A1 10 pm (assumed), phi1 0.115 deg (assumed), A2 2 pm,",
        "modulus log-uniform from 1 MPa to 300 GPa",
        "adhesion normal with mean 0 N and standard deviation 18.8 nN",
        "loss tangent uniform from 0 to 2",
        "2 phases of the sample: PS, LDPE.",
        "2 phases minimise the description length of the observables.",
        "Verdict: relative",
        f"overtone {__version__}",
    ):
        assert part in text, part
    assert "[not recorded]" not in text


def test_no_modulus_in_pascal_unless_it_is_absolute(scan, result):
    assert "1.93 GPa" not in text_of(scan, result)
    assert "modulus over that of the reference 0.0487 (0.039 .. 0.0609)" in text_of(scan, result)
    absolute = result.assign_attrs(verdict="absolute")
    assert "modulus 1.93 GPa (1.15 .. 3.24 GPa)" in text_of(scan, absolute)


def test_what_is_not_known_is_to_be_filled_in(scan, result):
    bare = scan.drop_attrs(deep=False)
    text = text_of(bare, result.drop_attrs(deep=False))
    assert text.count("[not recorded]") >= 5
    assert "Cantilever and drive: [not recorded]." in text
    assert "not corrected with a calibration" in text
    assert "set-point" not in text
    rows = {name: value for name, value, _ in metadata_rows(facts_of(bare, result.drop_attrs(deep=False)))}
    assert rows["probe"] == "not recorded"
    assert rows["calibration"] == "none: the scan was not corrected"


def test_the_probe_may_come_from_the_history_alone(scan, result):
    bare = scan.drop_attrs(deep=False)
    assert "stiffness of 16.4 N/m" in text_of(bare, result)


def test_further_arguments_stand_in_the_table(scan, result):
    more = provenance.record(result, "map_properties", model="dmt", thickness=5e-8, phases=3, given={"a": 1})
    rows = {name: (value, unit) for name, value, unit in metadata_rows(facts_of(scan, more))}
    assert rows["thickness"] == (5e-8, "m")
    assert rows["phases"] == (3, "1")
    assert rows["given"] == ('{"a": 1}', "")
    assert rows["model"] == ("dmt", "")
    cells = dict(metadata_table(metadata_rows(facts_of(scan, more))).rows)
    assert cells["thickness"] == "50 nm"
    assert cells["drive frequency"] == "161.8 kHz"


def test_markdown_has_its_references_and_no_markup_of_the_sample(scan, result):
    odd = result.assign_coords(material=["<b>x</b>", "*y*"])
    text = methods_text("a_b", methods_paragraphs(facts_of(scan, odd), odd), ("This: not given.",))
    assert text.startswith("# Methods: a\\_b\n")
    assert "1. N. H. Shaik, R. G. Reifenberger and A. Raman, Nanomechanical mapping" in text
    assert "Nanotechnology 31, 455502 (2020)" in text
    assert "\\<b\\>x\\</b\\>" in text
    assert "\\*y\\*" in text
    assert "lever [1]" in text
    assert text.endswith("- This: not given.\n")


@pytest.mark.parametrize(
    ("phases", "said"),
    [
        (None, "Phases were found in the space of the observables before any contact model"),
        (3, "Phases were found in the space of the observables, their number being given as 3, before"),
        ("given", "Pixels were put to phases by labels given beforehand."),
    ],
)
def test_how_phases_came_about(scan, result, phases, said):
    called = provenance.record(result, "map_properties", method="population", phases=phases)
    assert said in text_of(scan, called)


def test_a_large_error_of_the_reference_is_a_factor(scan, result):
    known = calibration_of(scan)
    loose = replace(known, reference=replace(known.reference, properties={"adhesion": (3e-9, 1.0)}))
    text = text_of(scan.assign_attrs(calibration=format_calibration(loose)), result)
    assert "adhesion 3 nN known to a factor of 2.7" in text


def test_priors_are_those_of_the_materials_where_pixels_share_them(scan, result):
    shared = "modulus log-normal 4.5e+08 4; adhesion log-range 6.28e-11 6.28e-08"
    entries = json.loads(result.attrs["history"])
    next(e for e in entries if e["operation"] == "map_properties")["arguments"]["shared_priors"] = shared
    told = result.assign_attrs(history=json.dumps(entries))
    text = text_of(scan, told)
    assert "adhesion log-uniform from 62.8 pN to 62.8 nN" in text
    assert "truncated at zero" not in text
    assert ("prior", "adhesion log-range 6.28e-11 6.28e-08", "") in metadata_rows(facts_of(scan, told))
