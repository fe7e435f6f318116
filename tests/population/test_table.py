"""The table of materials, its checks and its verdict: on worlds that are straight and Gaussian, where all is known."""

import math

import numpy as np
import pytest
import xarray as xr
from scipy.stats import kstest

import overtone as ot
from overtone.contact.models import contact_model
from overtone.demo import demo_probe
from overtone.instrument.gates import ABSOLUTE, CONTRAST, GATE, RELATIVE
from overtone.inversion.columns import columns_of
from overtone.inversion.forces import rows_of
from overtone.inversion.motion import follow
from overtone.inversion.priors import complete_priors, for_kernel
from overtone.population.evidence import Evidence, Tiles, inverse
from overtone.population.forward import ADHESION, FIRST_DEPTH, TANGENT
from overtone.population.joint import Joint, Response
from overtone.population.materials import Draws, Question
from overtone.population.other_laws import Laws
from overtone.population.spread import Spread
from overtone.population.table import Material, draws_of, materials_of
from overtone.population.verdict import verdict_of

PROBE = demo_probe()
RECORD = contact_model("dmt-viscous")
ROWS, _ = rows_of((0, 1, 2, 3), (1, 2, 3))
SIZE, UNIT, A = 7, 1e-9, 40e-9
QUESTION = Question(
    columns_of(RECORD, PROBE, {"poisson_ratio": 0.35}),
    ROWS,
    follow(PROBE, (2, 3), 0),
    for_kernel(complete_priors(None, RECORD, PROBE.tip.radius), "modulus"),
)
# of ln E, ln F, ln tan, t
CENTRE = np.array([math.log(1e9), math.log(6.0), math.log(0.1), -2.5])
J = np.linalg.qr(np.random.default_rng(1).standard_normal((SIZE, 4)))[0] * np.array([2.0, 1.5, 1.0, 0.7])
SPREAD = Spread(np.array([0.1, 0.15, 0.2]), np.full(3, 0.1), 0.1 * np.eye(3))
EXPONENT = -0.5


def straight(y, covariance, draws=200, seed=0, radius=(0.1,), shift=None):
    """Return the joint posterior of phases whose harmonics are straight in their unknowns, from readings (phase, row).

    Errors are of one covariance; one source of z moves nothing but the radius.
    """
    phases, random = len(y), np.random.default_rng(seed)
    whole = np.kron(np.eye(phases), covariance)
    P = inverse(J.T @ np.linalg.inv(covariance) @ J)
    u = np.empty((draws, phases, 4))
    for k in range(phases):
        best = P @ J.T @ np.linalg.solve(covariance, y[k])
        u[:, k] = best + random.standard_normal((draws, 4)) @ np.linalg.cholesky(P).T
    if shift is not None:  # what all phases share
        u[..., 0] += shift * random.standard_normal((draws, 1))
    sources = len(radius)
    evidence = Evidence(
        y.ravel(),
        whole,
        whole,
        UNIT,
        y.ravel(),
        np.zeros((y.size, sources)),
        np.eye(sources),
        np.zeros(sources),
        np.array(radius),
    )
    amplitude = np.full((phases, 1), A)
    scene = QUESTION.scene(evidence.centre, evidence.precision, amplitude, UNIT, [])
    at = CENTRE + u
    unknowns = np.empty((draws, phases, FIRST_DEPTH + 1))
    unknowns[..., ADHESION], unknowns[..., TANGENT], unknowns[..., FIRST_DEPTH] = np.moveaxis(
        at[..., 1:], -1, 0
    )
    found = Draws(
        at[..., 0],
        unknowns,
        (u @ J.T).reshape(draws, -1),
        random.standard_normal((draws, sources)),
        np.ones(phases),
        0.6,
        scene,
    )
    tiles = Tiles(
        y[0][None] * UNIT,
        np.zeros((1, SIZE, sources)),
        np.array(radius),
        np.zeros(len(radius)),
        np.array([400]),
        covariance * UNIT**2,
        covariance * UNIT**2,
        np.array([A]),
        np.zeros((SIZE, 1)),
        np.zeros((1, 3)),
    )
    response = Response(np.zeros(SIZE), J[:, :3], np.zeros((SIZE, 3, 3)), np.zeros((1, 3)), J[:, 3:])
    return Joint((tiles,) * phases, (SPREAD,) * phases, (response,) * phases, evidence, (), found)


def covariance(size=0.02, seed=3):
    root = np.random.default_rng(seed).standard_normal((SIZE, SIZE))
    return size**2 * (0.2 * root @ root.T + np.eye(SIZE))


def material(joint, place=0, *, reference=False, resolved=True):
    return Material(place, 400, 3, resolved, reference, joint, place)


def laws(*errors, better=""):
    """Return what other laws would change of ln of the moduli."""
    return Laws(np.array(errors), better, {})


def table(materials, names=None, known=None, anchored=False, calibrated=True, other=None):
    names = names or [f"phase_{i + 1}" for i in range(len(materials))]
    return materials_of(
        materials,
        names,
        QUESTION,
        ROWS,
        EXPONENT,
        known or {},
        "as given",
        anchored,
        calibrated,
        other or laws(*[math.nan] * len(materials)),
    )


@pytest.fixture(scope="module")
def worlds():
    """Readings of 300 phases whose unknowns were drawn from what is known before, and their errors."""
    random, C = np.random.default_rng(7), covariance()
    u = np.array([4.0, 2.0, 2.0, 3.0]) * random.standard_normal((300, 4))
    y = u @ J.T + random.standard_normal((300, SIZE)) @ np.linalg.cholesky(C).T
    return y, C


def test_misfits_are_those_of_chi_squared(worlds):
    y, C = worlds
    found = [material(straight(one[None], C, 40, seed=i)) for i, one in enumerate(y)]
    assert found[0].freedom == SIZE - 4
    assert kstest([m.misfit_probability for m in found], "uniform").pvalue > 0.01
    # the least misfit is what is left of the readings across the four directions
    L = np.linalg.cholesky(C)
    Q = np.linalg.qr(np.linalg.solve(L, J))[0]
    e = np.linalg.solve(L, y[0])
    assert found[0].misfit == pytest.approx(e @ e - (Q.T @ e) @ (Q.T @ e), rel=1e-6, abs=0)


def test_a_wrong_model_does_not_fit(worlds):
    y, C = worlds
    across = np.linalg.svd(J)[0][:, 4]
    assert material(straight((y[0] + 0.3 * across)[None], C)).misfit_probability < 1e-6


def test_nine_in_ten_harmonics_are_where_the_others_say(worlds):
    y, C = worlds
    inside, width = [], []
    for i, one in enumerate(y[:150]):
        arrays = table([material(straight(one[None], C, 40, seed=i))]).arrays
        seen, low, high = (arrays[f"check_{name}"].values[0] for name in ("observed", "lower", "upper"))
        np.testing.assert_allclose(seen, one * UNIT, rtol=1e-12)
        inside.append((low < seen) & (seen < high))
        width.append(high - low)
    share = np.mean(inside)
    assert share == pytest.approx(0.9, rel=0, abs=0.03)
    # each row for itself, none of them for free
    assert (np.mean(inside, axis=0) > 0.82).all()
    assert (np.mean(inside, axis=0) < 0.97).all()
    # what the others say of a row is no sharper than its own error at given others allows
    own = 2.0 * 1.645 * UNIT / np.sqrt(np.diag(np.linalg.inv(C)))
    assert (np.mean(width, axis=0) > own).all()


def test_a_harmonic_that_is_off_shows(worlds):
    _, C = worlds
    random = np.random.default_rng(2)
    true = J @ np.array([0.3, -0.2, 0.1, 0.2])
    one = true + 0.1 * np.linalg.cholesky(C) @ random.standard_normal(SIZE)
    one[5] += 1.0
    arrays = table([material(straight(one[None], C))]).arrays
    row = arrays["check_observed"].isel(row=5)
    assert str(row["row"].values) == "DISS_2"
    assert float(row[0]) > float(arrays["check_upper"][0, 5])
    # the others say where it was
    middle = 0.5 * (arrays["check_upper"] + arrays["check_lower"])[0, 5]
    assert abs(float(middle) - UNIT * true[5]) < UNIT * 0.3


def test_medians_and_intervals_are_those_of_the_draws():
    y, C = np.zeros((2, SIZE)), covariance(0.05)
    joint = straight(y, C, draws=400)
    arrays = table([material(joint, 0), material(joint, 1)]).arrays
    for k in range(2):
        # a wider tip by one deviation is a softer sample, at the same force
        ln_E = joint.draws.ln_E[:, k] + EXPONENT * 0.1 * joint.draws.z[:, 0]
        got = [float(arrays[f"material_modulus{end}"][k]) for end in ("_lower", "", "_upper")]
        np.testing.assert_allclose(got, np.exp(np.quantile(ln_E, [0.05, 0.5, 0.95])), rtol=1e-9)
        F = np.exp(joint.draws.unknowns[:, k, ADHESION]) * UNIT
        assert float(arrays["material_adhesion"][k]) == pytest.approx(np.median(F), rel=1e-3, abs=0)
        t = joint.draws.unknowns[:, k, FIRST_DEPTH]
        depth = 2.0 * A / (1.0 + np.exp(-np.median(t)))
        assert float(arrays["material_indentation"][k]) == pytest.approx(depth, rel=1e-3, abs=0)
    np.testing.assert_array_equal(arrays["material_modulus_spread"], [0.1, 0.1])
    np.testing.assert_array_equal(arrays["material_adhesion_spread"], [0.15, 0.15])
    # statistical: the error of a straight fit; systematic: what is left of the interval
    P = np.linalg.inv(J.T @ np.linalg.inv(C) @ J + np.diag(np.array([4.0, 2.0, 2.0, 3.0]) ** -2.0))
    statistical = arrays["material_modulus_statistical"].values
    np.testing.assert_allclose(statistical, math.sqrt(P[0, 0]), rtol=1e-6)
    total = np.log(arrays["material_modulus_upper"] / arrays["material_modulus_lower"]).values / 3.28970725
    np.testing.assert_allclose(
        np.hypot(statistical, arrays["material_modulus_systematic"].values), total, rtol=1e-6
    )
    np.testing.assert_allclose(arrays["material_modulus_systematic"].values, 0.05, rtol=0.3)


def test_viscosity_is_that_of_the_loss_tangent():
    joint = straight(np.zeros((1, SIZE)), covariance())
    found = draws_of(QUESTION, material(joint), EXPONENT)
    E, tangent = np.exp(joint.draws.ln_E[:, 0]), np.exp(joint.draws.unknowns[:, 0, TANGENT])
    E_star = 1.0 / ((1.0 - 0.35**2) / E + (1.0 - PROBE.tip.poisson_ratio**2) / PROBE.tip.modulus)
    viscosity = tangent * 2.0 * E_star / (2.0 * math.pi * PROBE.drive.frequency)
    of_radius = EXPONENT * 0.1 * joint.draws.z[:, 0]
    np.testing.assert_allclose(found["viscosity"], np.log(viscosity) + of_radius, rtol=1e-9)


def test_what_phases_share_drops_out_of_their_ratio():
    y = np.zeros((2, SIZE))
    y[1] = J @ np.array([0.7, 0.0, 0.0, 0.0])
    joint = straight(y, covariance(0.002), draws=400, shift=0.5, radius=(0.2,))
    arrays = table([material(joint, 0, reference=True), material(joint, 1)], known={0: (21.0, 0.01)}).arrays
    np.testing.assert_allclose(arrays["material_modulus_ratio"], [1.0, math.exp(0.7)], rtol=0.01)
    assert (
        float(arrays["material_modulus_ratio_lower"][0])
        == 1.0
        == float(arrays["material_modulus_ratio_upper"][0])
    )
    ratio = np.log(arrays["material_modulus_ratio_upper"] / arrays["material_modulus_ratio_lower"])[1]
    whole = np.log(arrays["material_modulus_upper"] / arrays["material_modulus_lower"])[1]
    assert float(ratio) < 0.1 * float(whole)
    np.testing.assert_array_equal(arrays["material_reference"], [1, 0])


def test_a_reference_that_anchored_the_scan_counts_with_its_own_error():
    C = covariance(0.002)
    other, own = straight(np.zeros((1, SIZE)), C, 4000), straight(np.zeros((1, SIZE)), C, seed=1)
    known = {0: (CENTRE[0] - 1.0, 0.2)}
    reference = Material(0, 400, 1, True, True, own, 0)
    sample = Material(1, 400, 1, True, False, other, 0)
    arrays = table([reference, sample], known=known, anchored=True).arrays
    assert float(arrays["material_modulus_ratio"][1]) == pytest.approx(math.e, rel=0.02, abs=0)
    half = 0.5 * float(
        np.log(arrays["material_modulus_ratio_upper"] / arrays["material_modulus_ratio_lower"])[1]
    )
    assert half == pytest.approx(1.645 * math.hypot(0.2, 0.05), rel=0.05, abs=0)


def verdict(materials, **options):
    attributes = table(materials, ["PS", "LDPE", "filler"][: len(materials)], **options).attributes
    return attributes["verdict"], attributes["verdict_reason"]


def test_every_verdict_is_reached():
    sharp = straight(np.zeros((2, SIZE)), covariance(0.005), radius=(0.1,))
    shared = straight(np.zeros((2, SIZE)), covariance(0.005), radius=(0.1,), shift=0.6)
    open_ = straight(np.zeros((2, SIZE)), covariance(1.0), radius=(0.1,))
    known = {0: (CENTRE[0], 0.05)}
    assert verdict([material(sharp, 0), material(sharp, 1)])[0] == ABSOLUTE
    told, why = verdict([material(sharp, 0), material(sharp, 1)], calibrated=False)
    assert told == CONTRAST
    assert "no calibration" in why
    told, why = verdict([material(shared, 0), material(shared, 1)])
    assert told == CONTRAST
    assert "no reference" in why
    told, why = verdict([material(shared, 0, reference=True), material(shared, 1)], known=known)
    assert told == RELATIVE
    assert "inferred together" in why
    told, why = verdict(
        [material(shared, 0, reference=True), material(shared, 1)], known=known, anchored=True
    )
    assert "anchored" in why
    told, why = verdict([material(open_, 0, reference=True), material(open_, 1)], known=known)
    assert told == CONTRAST
    assert "LDPE" in why
    told, why = verdict([material(sharp, 0, reference=True)], known=known)
    assert told == CONTRAST
    assert "nothing but the reference" in why
    told, why = verdict([material(None), material(sharp, 1, resolved=False)])
    assert told == CONTRAST
    assert "no phase" in why


def test_the_gate_is_where_the_verdict_turns():
    materials = [material(straight(np.zeros((1, SIZE)), covariance(0.005)))]
    for size, want in ((0.98, ABSOLUTE), (1.02, CONTRAST)):
        reach = 1.6448536 * size * GATE
        columns = {
            "material_modulus_lower": np.array([1e9 * math.exp(-reach)]),
            "material_modulus_upper": np.array([1e9 * math.exp(reach)]),
            "material_modulus_law": np.array([math.nan]),
        }
        assert verdict_of(materials, columns, ["PS"], False, "")[0] == want
        # another law that fits as well is an error like any other
        open_ = columns | {"material_modulus_law": np.array([-0.5 * GATE])}
        assert verdict_of(materials, open_, ["PS"], False, "")[0] == CONTRAST
        told, why = verdict_of(
            materials, columns | {"material_modulus_law": np.array([2.0 * GATE])}, ["PS"], False, ""
        )
        assert told == CONTRAST
        assert "another law of contact" in why


def test_a_model_that_does_not_fit_is_named():
    across = np.linalg.svd(J)[0][:, 4]
    bad = material(straight((0.3 * across)[None], covariance(0.005)))
    told, why = verdict([bad])
    assert told == CONTRAST
    assert "does not fit PS" in why


def test_draws_that_have_not_settled_are_named():
    joint = straight(np.zeros((1, SIZE)), covariance())
    moving = Draws(**{**joint.draws.__dict__, "mixing": np.array([1.5])})
    restless = Joint(**{**joint.__dict__, "draws": moving})
    assert "not settled" in table([material(restless)]).attributes["phase_note"]
    told, why = verdict([material(restless)])
    assert told == CONTRAST
    assert "PS have not settled" in why
    assert "not settled" not in table([material(joint)]).attributes["phase_note"]


def test_arrays_have_names_units_and_places(tmp_path):
    joint = straight(np.zeros((2, SIZE)), covariance())
    found = table([material(joint, 0), material(None, 1, resolved=False)], ["PS", "LDPE"])
    units = {
        "material_modulus": "Pa",
        "material_modulus_lower": "Pa",
        "material_adhesion_upper": "N",
        "material_indentation": "m",
        "material_viscosity": "Pa s",
        "material_loss_tangent": "1",
        "material_modulus_spread": "1",
        "material_modulus_statistical": "1",
        "material_misfit": "1",
        "material_misfit_probability": "1",
        "material_pixels": "1",
        "check_observed": "N",
        "check_lower": "N",
    }
    for name, unit in units.items():
        assert found.arrays[name].attrs["units"] == unit, name
        assert found.arrays[name].attrs["long_name"], name
        assert found.arrays[name].dims[0] == "material"
    assert list(found.arrays["check_upper"]["row"].values) == [
        *(f"CONS_{n}" for n in range(4)),
        *(f"DISS_{n}" for n in (1, 2, 3)),
    ]
    assert found.arrays["material_resolved"].values.tolist() == [1, 0]
    # one without a posterior holds no numbers
    for name in ("material_modulus", "material_misfit", "material_adhesion_spread"):
        assert np.isfinite(found.arrays[name].values[0]), name
        assert np.isnan(found.arrays[name].values[1]), name
    assert np.isnan(found.arrays["check_observed"].values[1]).all()
    # through a file and back
    whole = xr.Dataset(dict(found.arrays)).assign_attrs(found.attributes)
    ot.save(whole, tmp_path / "materials.nc")
    back = ot.load(tmp_path / "materials.nc")
    for name, array in found.arrays.items():
        np.testing.assert_array_equal(back[name].values, array.values)
        assert back[name].attrs["units"] == array.attrs["units"]
    assert list(back["material"].values) == ["PS", "LDPE"]
    assert back.attrs["verdict_reason"] == found.attributes["verdict_reason"]
