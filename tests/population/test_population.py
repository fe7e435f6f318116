"""Method ``population`` from scan to table, on simulated worlds in which everything is known."""

import importlib
import math
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
import xarray as xr

import overtone as ot
from overtone.errors import InversionError
from overtone.instrument.gates import GATE
from overtone.instrument.material import Reference
from overtone.inversion.priors import Prior
from overtone.inversion.result import DETERMINED

FOLDER = Path(__file__).parents[2] / "benchmarks"
SHAPE = (48, 48)
SEED = 14
NAMES = ("modulus", "adhesion", "loss_tangent")


@pytest.fixture(scope="module")
def worlds():
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(FOLDER))
        yield importlib.import_module("worlds_simulated")


def mapped(world, scan=None, **options):
    return ot.map_properties(
        world.scan if scan is None else scan,
        world.probe,
        **{
            "model": "dmt-viscous",
            "poisson_ratio": world.materials[0].poisson_ratio if world.materials else 0.35,
            "method": "population",
            "noise": world.noise,
            **options,
        },
    )


@pytest.fixture(scope="module")
def three(worlds):
    return worlds.world(SEED, shape=SHAPE)


@pytest.fixture(scope="module")
def labels(three):
    """The truth, as an operator might know it."""
    return xr.DataArray(three.truth["material"].values.astype(int), dims=("y", "x"))


@pytest.fixture(scope="module")
def part(three, labels):
    """A strip of the scan with its two large materials, for what any scan shows."""
    return three.scan.isel(y=slice(0, 20)), labels[:20].where(labels[:20] < 2, -1)


@pytest.fixture(scope="module")
def strip(three, part):
    return mapped(three, part[0], phases=part[1])


@pytest.fixture(scope="module")
def result(three):
    return mapped(three)


@pytest.fixture(scope="module")
def labelled(three, labels):
    return mapped(three, phases=labels)


def of_material(result, world, k):
    """Return which phase most pixels of a true material belong to."""
    phase = result["phase"].values[world.truth["material"].values == k]
    return int(np.bincount(phase[phase >= 0]).argmax())


def test_every_phase_is_found(result, three):
    assert result.sizes["material"] == len(three.materials)
    truth = three.truth["material"].values
    found = [of_material(result, three, k) for k in range(3)]
    assert sorted(found) == [0, 1, 2]
    for k, own in enumerate(found):
        assert np.mean(result["phase"].values[truth == k] == own) > 0.8
        assert result["material_resolved"].values[own] == 1
    assert result["phase"].attrs["flag_meanings"].split() == ["none", "phase_1", "phase_2", "phase_3"]
    assert list(result["material"].values) == ["phase_1", "phase_2", "phase_3"]


def test_the_table_holds_what_is_true(result, labelled, three):
    """Inside of the interval, or beside it by no more than half of its width."""
    for found, places in ((result, [of_material(result, three, k) for k in range(3)]), (labelled, range(3))):
        for k, material in zip(places, three.materials, strict=True):
            for name in NAMES:
                low, high = (
                    math.log(float(found[f"material_{name}_{end}"][k])) for end in ("lower", "upper")
                )
                reach = 0.5 * (high - low)
                assert low - reach < math.log(getattr(material, name)) < high + reach, (material.name, name)
        # the scatter within a phase is a true one, with what interphases add
        assert 0.03 < float(found["material_modulus_spread"][places[0]]) < 0.6
        assert (found["material_misfit_probability"] > 1e-3).all()


def test_pooled_pixels_are_sharper_and_right(result, three):
    k = next(i for i, m in enumerate(three.materials) if m.name == "LDPE")
    own = (result["phase"].values == of_material(result, three, k)) & (three.truth["material"].values == k)
    own &= result["shrinkage"].values > 0.0
    assert own.sum() > 200
    pooled = np.log(result["modulus_upper"] / result["modulus_lower"]).values[own]
    alone = np.log(result["modulus_unpooled_upper"] / result["modulus_unpooled_lower"]).values[own]
    # what the scan shares is most of an interval of a soft pixel, and all of it stays
    assert np.median(pooled) < 0.98 * np.median(alone)
    true = three.truth["modulus"].values[own]
    inside = (result["modulus_lower"].values[own] < true) & (true < result["modulus_upper"].values[own])
    # what they share is one draw, so that in a lucky scan all of them are right: how often, many worlds tell
    assert inside.mean() > 0.8
    # ranks of pixels within the phase are seen in spite of all that they share
    seen = np.corrcoef(np.log(true), np.log(result["modulus_unscreened"].values[own]))[0, 1]
    assert seen > 0.5
    shrunk = result["shrinkage"].values[own]
    assert ((shrunk >= 0.0) & (shrunk <= 1.0)).all()
    assert 0.05 < np.median(shrunk) < 0.95


def test_what_is_pooled_and_what_is_not(result, three):
    posterior = mapped(three, method="posterior")
    for name in (*NAMES, "viscosity", "indentation"):
        np.testing.assert_array_equal(result[f"{name}_unpooled"], posterior[f"{name}_unscreened"])
        for end in ("lower", "upper"):
            np.testing.assert_array_equal(result[f"{name}_unpooled_{end}"], posterior[f"{name}_{end}"])
    nowhere = result["phase"].values == -1
    assert 0.05 < nowhere.mean() < 0.4  # interphases
    for name in ("modulus_lower", "modulus_upper", "adhesion_unscreened", "status", "uncertainty"):
        np.testing.assert_array_equal(result[name].values[nowhere], posterior[name].values[nowhere])
    assert (result["shrinkage"].values[nowhere] == 0.0).all()
    known = result["status"].values == DETERMINED
    np.testing.assert_array_equal(np.isfinite(result["modulus"].values), known)
    assert (result["modulus_lower"] <= result["modulus_unscreened"]).all()
    assert (result["modulus_unscreened"] <= result["modulus_upper"]).all()


def test_it_is_the_same_again_and_with_other_threads(three, part, strip, monkeypatch):
    (scan, own), first = part, strip
    with ThreadPoolExecutor(1) as one:
        monkeypatch.setattr("overtone.blocks._threads", lambda: one)
        again = mapped(three, scan, phases=own)
    monkeypatch.undo()
    for name in first.data_vars:
        np.testing.assert_array_equal(again[name].values, first[name].values, err_msg=name)
    other = mapped(three, scan, phases=own, seed=5)
    assert not np.array_equal(other["material_modulus"], first["material_modulus"])
    width = np.log(first["material_modulus_upper"] / first["material_modulus_lower"]).values
    off = np.log(other["material_modulus"].values / first["material_modulus"].values)
    assert (np.abs(off) < 0.35 * width)[np.isfinite(width)].all()


def test_it_comes_back_from_a_file(result, tmp_path):
    ot.save(result, tmp_path / "result.nc")
    back = ot.load(tmp_path / "result.nc")
    assert set(back.data_vars) == set(result.data_vars)
    for name in result.data_vars:
        np.testing.assert_array_equal(back[name].values, result[name].values, err_msg=name)
        assert back[name].attrs.get("units") == result[name].attrs.get("units"), name
    for name in ("verdict", "verdict_reason", "phase_note", "method"):
        assert back.attrs[name] == result.attrs[name]


def test_labels_are_taken_as_they_are(labelled, labels):
    assert labelled.attrs["phase_note"].startswith("labels as given")
    phase = labelled["phase"].values
    kept = phase >= 0
    np.testing.assert_array_equal(phase[kept], labels.values[kept])
    assert (phase[labels.values < 0] == -1).all()
    # pixels that are unlike their phase drop out, few of them
    assert kept.sum() > 0.95 * (labels.values >= 0).sum()


def test_a_count_is_kept(three):
    found = mapped(three, phases=2)
    assert found.sizes["material"] == 2
    assert "2 phases asked for" in found.attrs["phase_note"]


def test_a_reference_makes_ratios(three, labels, labelled):
    matrix, soft = three.materials[0], three.materials[1]
    reference = Reference(0.35, modulus=matrix.modulus, modulus_error=0.05, name="polystyrene film")
    found = mapped(three, phases=labels, reference=reference, reference_pixels=labels == 0)
    assert list(found["material"].values) == ["polystyrene_film", "phase_2", "phase_3"]
    assert found["material_reference"].values.tolist() == [1, 0, 0]
    assert "polystyrene_film" in found["phase"].attrs["flag_meanings"]
    low, middle, high = (float(found[f"material_modulus_ratio{end}"][1]) for end in ("_lower", "", "_upper"))
    assert low < middle < high
    reach = (high / low) ** 0.5
    assert low / reach < soft.modulus / matrix.modulus < high * reach
    # ratios are known well enough; that another law of contact fits as well counts against them
    ratio = found["material_modulus_ratio_upper"] / found["material_modulus_ratio_lower"]
    open_ = np.log(ratio.values[1:]) / 3.29
    law = np.nan_to_num(found["material_modulus_law"].values[1:])
    assert open_.max() < GATE
    assert found.attrs["verdict"] == ("relative" if np.hypot(open_, law).max() <= GATE else "contrast")
    assert "inferred together with a reference" in found.attrs["verdict_reason"]
    # what is known of the reference sharpens it, and all ratios
    own = np.log(found["material_modulus_upper"] / found["material_modulus_lower"]).values
    before = np.log(labelled["material_modulus_upper"] / labelled["material_modulus_lower"]).values
    assert own[0] < 0.25 < before[0]
    assert "material_modulus_ratio" not in labelled


def test_lost_pixels_stay_lost(three, part):
    scan, labels = part[0].copy(deep=True), part[1]
    scan["A0"][3:5] = math.nan
    scan["A1"][15, 20] = math.nan
    found = mapped(three, scan, phases=labels)
    lost = np.zeros(labels.shape, bool)
    lost[3:5], lost[15, 20] = True, True
    assert (found["phase"].values[lost] == -1).all()
    assert (found["shrinkage"].values[lost] == 0.0).all()
    for name in ("modulus", "modulus_unscreened", "modulus_lower", "adhesion_upper", "modulus_unpooled"):
        assert np.isnan(found[name].values[lost]).all(), name
    assert np.isfinite(found["modulus_unscreened"].values[~lost]).all()


def test_a_second_set_point_tells_more(worlds, part, strip):
    both = worlds.world(SEED, shape=SHAPE, setpoints=(0.42, 0.6))
    scans = [scan.isel(y=slice(0, 20)) for scan in both.scans]
    np.testing.assert_array_equal(scans[0]["A2"], part[0]["A2"])
    stack = xr.concat(scans, dim="setpoint", join="override", combine_attrs="override")
    found = mapped(both, stack, phases=part[1])
    assert found["modulus"].dims == ("y", "x")
    assert found.sizes["row"] == 2 * strip.sizes["row"]
    width, before = (
        np.log(r["material_modulus_upper"] / r["material_modulus_lower"]).values for r in (found, strip)
    )
    # a soft material is as sharp as the radius allows at one set-point; what its pixels tell is told better by two
    statistical = found["material_modulus_statistical"].values / strip["material_modulus_statistical"].values
    assert statistical[1] < 0.95
    assert width[1] < 1.05 * before[1]
    # a stiff one stays open to what is shared
    assert width[0] < 1.4 * before[0]
    for k in (0, 1):
        low, high = (math.log(float(found[f"material_modulus_{end}"][k])) for end in ("lower", "upper"))
        reach = 0.5 * (high - low)
        assert low - reach < math.log(both.materials[k].modulus) < high + reach


def test_one_material_is_one_phase(worlds):
    world = worlds.world(2, kind="homogeneous", shape=SHAPE)
    found = mapped(world)
    assert found.sizes["material"] == 1
    assert found["material_resolved"].values.tolist() == [1]
    assert np.mean(found["phase"].values == 0) > 0.85
    low, high = (math.log(float(found[f"material_modulus_{end}"][0])) for end in ("lower", "upper"))
    reach = 0.5 * (high - low)
    assert low - reach < math.log(world.materials[0].modulus) < high + reach


def test_a_gradient_is_not_pooled(worlds):
    world = worlds.world(3, kind="gradient", shape=SHAPE)
    found = mapped(world)
    assert (found["shrinkage"] == 0.0).all()
    np.testing.assert_array_equal(found["modulus_lower"], found["modulus_unpooled_lower"])
    assert (found["material_resolved"] == 0).all()
    assert found.attrs["verdict"] == "contrast"


@pytest.mark.parametrize(
    ("name", "prior"),
    [("loss_tangent", Prior("range", 0.0, 0.05)), ("adhesion", Prior("range", 0.0, 2e-9))],
    ids=["loss_tangent", "adhesion"],
)
def test_priors_that_the_scan_contradicts_are_kept(three, part, name, prior):
    """And a chain that does not move is not taken for one that knows."""
    found = mapped(three, part[0], phases=part[1], priors={name: prior})
    values = found[f"material_{name}_upper"].values
    assert np.isfinite(values).any()
    assert (values[np.isfinite(values)] <= prior.second * (1.0 + 1e-6)).all()
    if found.attrs["verdict"] != "contrast":
        low, high = (found[f"material_modulus_{end}"].values for end in ("lower", "upper"))
        assert (np.log(high / low)[np.isfinite(low)] > 0.17).all()  # more than the radius alone


def test_what_makes_no_sense_is_refused(three, part):
    scan, labels = part[0].isel(y=slice(0, 10)), part[1][:10]
    rectangle = (0.0, 0.0, 5e-7, 5e-7)
    reference = Reference(0.35, modulus=2e9)
    with pytest.raises(InversionError, match="where the reference lies"):
        mapped(three, scan, phases=labels, reference=reference)
    with pytest.raises(InversionError, match="without its modulus"):
        mapped(three, scan, phases=labels, reference_pixels=rectangle)
    with pytest.raises(InversionError, match="modulus of the reference is not known"):
        mapped(three, scan, phases=labels, reference=Reference(0.35), reference_pixels=labels == 0)
    with pytest.raises(InversionError, match="no one phase"):
        mapped(three, scan, phases=labels, reference=reference, reference_pixels=labels == -1)
    with pytest.raises(InversionError, match="do not fit the scan"):
        mapped(three, scan, phases=labels[:-1])
    with pytest.raises(InversionError, match="no pixel is labelled"):
        mapped(three, scan, phases=labels * 0 - 1)
    with pytest.raises(InversionError, match="another number of phases"):
        mapped(three, scan, phases=0)
    with pytest.raises(InversionError, match="phases are found in maps"):
        mapped(three, scan.isel(y=0))


def test_a_model_without_a_modulus_is_refused(three, part):
    with pytest.raises(InversionError, match="modulus"):
        mapped(three, part[0], phases=part[1], model="kelvin-voigt")


def test_pixels_at_borders_are_told_nothing():
    from overtone.population.phases import labels_as_phases
    from overtone.population.population import _at_borders

    label = np.zeros((20, 30), int)
    label[:, 15:] = 1
    label[:, 14:16] = -1  # a band between two phases
    label[5, 5] = label[9, 6] = 1  # odd ones
    label[15, 25] = -1
    label[12, :] = -1  # a line that was lost
    random = np.random.default_rng(0)
    phases = labels_as_phases(label, random.standard_normal((20, 30, 2)), np.eye(2))
    known = np.ones(label.shape, bool)
    known[12] = False
    border = _at_borders(phases, known)
    want = np.zeros(label.shape, bool)
    want[:, [13, 16]] = True
    want[5, 5] = want[9, 6] = True  # odd ones are, what is about them is not
    mine = label >= 0
    np.testing.assert_array_equal(border[mine], want[mine])
