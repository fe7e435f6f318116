"""Other laws of contact: against quadrature, at their limits, and what a fit under them finds."""

import math
from itertools import pairwise

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.optimize import minimize

import overtone as ot
from overtone.contact.models import contact_model
from overtone.demo import demo_probe
from overtone.inversion.columns import columns_of
from overtone.inversion.forces import rows_of
from overtone.inversion.motion import follow
from overtone.inversion.priors import complete_priors, for_kernel, of_single_pixels, shared_priors
from overtone.population.evidence import Evidence, Tiles, inverse
from overtone.population.forward import ADHESION, FIRST_DEPTH, TANGENT
from overtone.population.joint import Joint, Response
from overtone.population.laws import (
    HALF_ANGLE,
    OMEGA_TAU,
    Contacts,
    Surroundings,
    alternatives,
    cone_contact,
    of_the_model,
)
from overtone.population.materials import Draws, Question
from overtone.population.other_laws import laws_of
from overtone.population.refit import LIKELY, Obeyed, refits
from overtone.population.spread import Spread
from overtone.population.table import Material

PROBE = demo_probe()
R, OMEGA = PROBE.tip.radius, 2.0 * math.pi * PROBE.drive.frequency
COLUMNS = columns_of(contact_model("dmt-viscous"), PROBE, {"poisson_ratio": 0.35})
AROUND = Surroundings(COLUMNS, R, OMEGA, 3)
LAWS = {law.key: law for law in alternatives(COLUMNS, True, True)}
SOFT = Contacts(*(np.array([v]) for v in (1.1e8, 14e-9, 0.08, 40e-9, 12e-9)))
STIFF = Contacts(*(np.array([v]) for v in (2.2e9, 2e-9, 0.04, 40e-9, 2.0e-9)))


def harmonics_of(force, contact, n_max=3):
    """Return cosine coefficients of a force of the depth alone on the bare cosine, by quadrature."""
    A, delta = contact.amplitude[0], contact.indentation[0]
    # contact begins, and the cone does, at depths where the force has a kink
    depths = (0.0, math.cos(HALF_ANGLE) ** 2 * R)
    ends = [0.0, *(math.acos(min(max((delta - depth) / A - 1.0, -1.0), 1.0)) for depth in depths), math.pi]

    def part(x, n):
        return force(delta - A * (1.0 + math.cos(x))) * math.cos(n * x)

    def whole(n):
        return sum(quad(part, a, b, (n,), epsabs=1e-16, epsrel=1e-9)[0] for a, b in pairwise(ends))

    return np.array([whole(n) * (1.0 if n == 0 else 2.0) / math.pi for n in range(n_max + 1)])


@pytest.mark.parametrize("contact", [SOFT, STIFF])
def test_the_model_is_that_of_the_package(contact):
    E, F, tangent, A, delta = (float(part[0]) for part in contact)
    stated = {
        "modulus": 1.0 / ((1.0 / E - COLUMNS.contact.tip_compliance) / COLUMNS.contact.sample_factor),
        "adhesion": F,
        "viscosity": 2.0 * E * tangent / OMEGA,
        "poisson_ratio": 0.35,
        "radius": R,
        "frequency": PROBE.drive.frequency,
    }
    found = ot.force_harmonics("dmt-viscous", amplitude=A, indentation=delta, n_max=3, **stated)
    np.testing.assert_allclose(of_the_model(AROUND, contact)[0], found, rtol=1e-9)


def test_a_cone_is_sneddons():
    b, slope = math.cos(HALF_ANGLE), 1.0 / math.tan(HALF_ANGLE)
    for a in (0.4, b, 1.1, 2.5):
        # with r = a sin(u) nothing is singular
        steep = [math.asin(b / a)] if a > b else None
        both = [
            quad(
                lambda u, p=p, a=a: (
                    (a * math.sin(u)) ** p * (a * math.sin(u) if a * math.sin(u) < b else slope)
                ),
                0.0,
                0.5 * math.pi,
                points=steep,
                epsrel=1e-11,
            )[0]
            for p in (0, 2)
        ]
        depth, force = cone_contact(np.array([a]))
        assert depth[0] == pytest.approx(a * both[0], rel=1e-9)
        assert force[0] == pytest.approx(2.0 * both[1], rel=1e-9)


def test_a_blunted_cone_on_the_motion():
    x, force = cone_contact(np.linspace(1e-4, 3.0, 200000))
    E, F, a0 = SOFT.E_star[0], SOFT.adhesion[0], COLUMNS.contact.a0

    def law(depth):
        if depth > 0.0:
            return E * R**2 * np.interp(depth / R, x, force) - F
        return -F * a0**2 / (a0 - depth) ** 2

    found = LAWS["blunted-cone"].harmonics(AROUND, SOFT)[0].real
    np.testing.assert_allclose(found, harmonics_of(law, SOFT), rtol=1e-4)
    # softer than the paraboloid where the cone is reached, and it where it is not
    assert found[0] < of_the_model(AROUND, SOFT)[0, 0].real
    np.testing.assert_allclose(
        LAWS["blunted-cone"].harmonics(AROUND, STIFF), of_the_model(AROUND, STIFF), rtol=1e-12
    )
    assert [LAWS["blunted-cone"].applies(AROUND, c).item() for c in (SOFT, STIFF)] == [True, False]


def test_jkr_is_that_of_the_package_with_the_loss_of_the_model():
    E, F, _, A, delta = (float(part[0]) for part in SOFT)
    stated = {"radius": R, "modulus": E, "poisson_ratio": 0.0, "tip_modulus": 1e13, "tip_poisson_ratio": 0.0}
    found = ot.force_harmonics("jkr", amplitude=A, indentation=delta, n_max=3, adhesion=F, **stated)
    law = LAWS["jkr"].harmonics(AROUND, SOFT)[0]
    np.testing.assert_allclose(law.real, found.real, rtol=1e-3)
    np.testing.assert_allclose(
        law.imag - of_the_model(AROUND, SOFT)[0].imag, found.imag, rtol=1e-3, atol=1e-13
    )
    weak = STIFF._replace(adhesion=np.array([1e-11]))
    assert [LAWS["jkr"].applies(AROUND, c).item() for c in (SOFT, weak)] == [True, False]


@pytest.mark.parametrize("x", OMEGA_TAU)
def test_a_solid_that_relaxes_stores_and_loses_what_it_should(x):
    law = LAWS[f"sls-{x:g}"]
    slight = SOFT._replace(tangent=np.array([1e-5]))
    np.testing.assert_allclose(
        law.harmonics(AROUND, slight).real, of_the_model(AROUND, slight).real, rtol=1e-3
    )
    lost = -law.harmonics(AROUND, SOFT)[0, 1].imag
    # less than the dashpot at one tangent: a contact is shorter than a period
    assert 0.0 < lost < -of_the_model(AROUND, SOFT)[0, 1].imag
    too_much = SOFT._replace(tangent=np.array([1.1 / x]))
    assert not law.applies(AROUND, too_much).item()
    assert np.isnan(law.harmonics(AROUND, too_much)).all()


def test_models_that_are_no_paraboloid_have_no_alternatives():
    cone = columns_of(contact_model("cone"), PROBE, {"poisson_ratio": 0.35, "half_angle": 0.3})
    assert alternatives(cone, False, False) == ()
    keys = [law.key for law in alternatives(COLUMNS, False, False)]
    assert keys == ["blunted-cone"]


# --- fits -----------------------------------------------------------------------------------------

ROWS, _ = rows_of((0, 1, 2, 3), (1, 2, 3))
UNIT, AMPLITUDE = 1e-9, 40e-9
PRIORS = {"modulus": ot.Prior("log-normal", 0.45e9, 4.0), "adhesion": ot.Prior("log-normal", 5.7e-9, 2.8)}
QUESTION = Question(
    COLUMNS,
    ROWS,
    follow(PROBE, (2, 3), 0),
    for_kernel(
        shared_priors(PRIORS, complete_priors(of_single_pixels(PRIORS), contact_model("dmt-viscous"), R), R),
        "modulus",
    ),
    even=True,
)


def rows_under(law, theta):
    """Return the harmonics of one material under a law, in units."""
    x, F, tangent, t = theta
    E = 1.0 / (COLUMNS.contact.tip_compliance + COLUMNS.contact.sample_factor * math.exp(-x))
    parts = (E, math.exp(F) * UNIT, math.exp(tangent), AMPLITUDE, 2.0 * AMPLITUDE / (1.0 + math.exp(-t)))
    contact = Contacts(*(np.array([part]) for part in parts))
    f = (law.harmonics if law else of_the_model)(AROUND, contact)[0][ROWS.orders]
    return np.where(ROWS.lossy, -f.imag, f.real) / UNIT


def log_prior(theta):
    x, F, tangent, t = theta
    p = QUESTION.prior
    away = F + math.log(UNIT) - p.adhesion_mean
    return (
        -0.5 * p.precision * (x - p.centre) ** 2
        - 0.5 * p.adhesion_precision * away**2
        + tangent
        - math.log1p(math.exp(t))
    )


def joint_of(y, covariance, theta, motion):
    """Return a joint posterior of one material with given readings; its draws lie about an estimate."""
    random, draws, size = np.random.default_rng(3), 40, y.size
    at = theta + 1e-3 * random.standard_normal((draws, 4))
    unknowns = np.empty((draws, 1, FIRST_DEPTH + 1))
    unknowns[:, 0, ADHESION], unknowns[:, 0, TANGENT], unknowns[:, 0, FIRST_DEPTH] = at[:, 1:].T
    sources = 1
    evidence = Evidence(
        y, covariance, covariance, UNIT, y, np.zeros((size, sources)), np.eye(1), np.zeros(1), np.array([0.1])
    )
    amplitude = np.array([[AMPLITUDE]])
    scene = QUESTION.scene(evidence.centre, evidence.precision, amplitude, UNIT, [])
    forces = np.array([rows_under(None, one) for one in at]) + motion
    found = Draws(at[:, :1], unknowns, forces, random.standard_normal((draws, 1)), np.ones(1), 0.6, scene)
    zero = np.zeros((size, size))
    tiles = Tiles(
        y[None],
        np.zeros((1, size, 1)),
        np.array([0.1]),
        np.zeros(1),
        np.array([9]),
        zero,
        zero,
        amplitude[0],
        zero,
        zero,
    )
    J = np.zeros((size, 3))
    response = Response(np.zeros(size), J, np.zeros((size, 3, 3)), np.zeros((1, 3)), np.zeros((size, 1)))
    return Joint((tiles,), (Spread(np.zeros(3), np.zeros(3), np.eye(3)),), (response,), evidence, (), found)


@pytest.mark.parametrize("true", ["jkr", "blunted-cone", f"sls-{OMEGA_TAU[0]:g}"])
def test_the_law_of_the_sample_is_found_and_its_modulus(true):
    theta = np.array([math.log(9e7), math.log(12.0), math.log(0.08), -1.6])
    motion = 0.01 * np.arange(ROWS.orders.size)
    y = rows_under(LAWS[true], theta) + motion
    covariance = (1e-3 * np.abs(y).max()) ** 2 * np.eye(y.size)
    found = {refit.key: refit for refit in refits(joint_of(y, covariance, theta, motion), QUESTION, -0.5)}

    def best(law):
        def cost(one):
            off = rows_under(law, one) + motion_of_best - y
            return 0.5 * off @ inverse(covariance) @ off - log_prior(one)

        answers = [
            minimize(
                cost,
                theta + off,
                method="Nelder-Mead",
                options={"xatol": 1e-8, "fatol": 1e-9, "maxiter": 20000},
            )
            for off in (0.0, np.array([0.2, 0.1, 0.0, -0.1]))
        ]
        return min(answers, key=lambda answer: answer.fun)

    # the motion adds what it adds at the best draw of the model: here the same everywhere
    motion_of_best = motion
    model, law = best(None), best(LAWS[true])
    assert found[true].change[0] == pytest.approx(law.x[0] - model.x[0], abs=2e-3)
    assert found[true].gain == pytest.approx(model.fun - law.fun, rel=1e-2, abs=0.05)
    assert found[true].gain > 0.0
    assert law.x[0] == pytest.approx(theta[0], abs=0.02)


def test_a_law_that_the_data_exclude():
    theta = np.array([math.log(9e7), math.log(12.0), math.log(0.08), -1.6])
    y = rows_under(None, theta)
    covariance = (1e-3 * np.abs(y).max()) ** 2 * np.eye(y.size)
    found = {refit.key: refit for refit in refits(joint_of(y, covariance, theta, 0.0), QUESTION, -0.5)}
    assert found["jkr"].excluded
    assert found["jkr"].gain < -LIKELY
    assert not any(refit.better for refit in found.values())
    loose = 400.0**2 * covariance
    found = {refit.key: refit for refit in refits(joint_of(y, loose, theta, 0.0), QUESTION, -0.5)}
    assert not found["jkr"].excluded
    assert Obeyed(LAWS["jkr"], np.array([True])).law.title == "JKR adhesion"


def test_the_table_of_laws_takes_the_largest_change_that_is_not_excluded():
    theta = np.array([math.log(9e7), math.log(12.0), math.log(0.08), -1.6])
    y = rows_under(None, theta)
    covariance = (1e-3 * np.abs(y).max()) ** 2 * np.eye(y.size)
    loose, tight = (joint_of(y, size * covariance, theta, 0.0) for size in (400.0**2, 1.0))
    materials = [
        Material(0, 100, 1, True, False, loose, 0),
        Material(1, 100, 1, True, False, None, 0),
        Material(2, 100, 1, True, False, tight, 0),
    ]
    found = laws_of(materials, QUESTION, -0.5, ["open", "none", "sure"])
    keys = list(found.arrays["law_change"]["law"].values)
    for k, joint in ((0, loose), (2, tight)):
        tried = {refit.key: refit for refit in refits(joint, QUESTION, -0.5)}
        assert set(tried) <= set(keys)  # a law that does not apply is not tried
        changes = [refit.change[0] for refit in tried.values() if not refit.excluded]
        assert found.error[k] == max(changes, key=abs)
        assert found.arrays["law_gain"].values[k, keys.index("jkr")] == tried["jkr"].gain
    assert (
        found.arrays["law_gain"].values[2, keys.index("jkr")]
        < -LIKELY
        < found.arrays["law_gain"].values[0, 0]
    )
    assert np.isnan(found.error[1])
    assert np.isnan(found.arrays["law_change"].values[1]).all()
    assert found.better == ""
    joint = joint_of(rows_under(LAWS["jkr"], theta), covariance, theta, 0.0)
    found = laws_of([Material(0, 9, 1, True, False, joint, 0)], QUESTION, -0.5, ["a"])
    assert found.better.startswith("JKR adhesion (ln of odds ")
