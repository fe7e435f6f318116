"""The harmonics of a material: against states of the full motion, differences, and summits that numpy confirms."""

import math

import numpy as np
import pytest

from overtone.contact.evaluate import force_harmonics
from overtone.contact.models import contact_model
from overtone.contact.parameters import effective_modulus
from overtone.contact.sample import sample
from overtone.demo import demo_probe
from overtone.dynamics.indented import indented_states
from overtone.inversion.columns import columns_of
from overtone.inversion.forces import rows_of
from overtone.inversion.motion import FEW, follow
from overtone.inversion.priors import complete_priors, for_kernel
from overtone.kernels import kernel
from overtone.population.forward import (
    ADHESION,
    BY_MODULUS,
    FIRST_DEPTH,
    TANGENT,
    all_rows,
    new_desk,
    one_at_rest,
)
from overtone.population.materials import Question
from overtone.population.search import climb, starts_of_material

PROBE, POISSON = demo_probe(), 0.35
RECORD = contact_model("dmt-viscous")
CONS, DISS = (0, 1, 2, 3), (1, 2, 3)
ROWS = len(CONS) + len(DISS)
UNIT = 0.8e-9
AMPLITUDE = np.array([[39.5e-9, 28e-9], [40e-9, 28.5e-9], [41e-9, 29e-9]])
MATERIALS = (  # modulus, adhesion, loss tangent, indentations at the two set-points
    (1.9e9, 2e-9, 0.05, (1.1e-9, 1.4e-9)),
    (94e6, 16e-9, 0.15, (7.5e-9, 9e-9)),
    (0.5e9, 6e-9, 0.1, (2.5e-9, 3.1e-9)),
)


@kernel
def on_the_desk(scene, x, v, corrected, f, J, J_x):
    desk = new_desk(scene)
    for _ in range(30):
        all_rows(scene, x, v, desk)
    if corrected:
        for k in range(x.shape[0]):
            one_at_rest(scene, k, x[k], v[k], desk)
        all_rows(scene, x, v, desk)
    f[:], J[:], J_x[:] = desk.f, desk.J, desk.J_x


def question(harmonics=FEW, model=RECORD):
    diss = DISS if model is RECORD else ()
    rows, _ = rows_of(CONS, diss)
    given = {"poisson_ratio": POISSON}
    priors = for_kernel(complete_priors(None, model, PROBE.tip.radius), "modulus")
    return Question(columns_of(model, PROBE, given), rows, follow(PROBE, (2, 3), harmonics), priors)


def unknowns(materials=MATERIALS, scans=2):
    x = np.log([m[0] for m in materials])
    v = np.empty((len(materials), FIRST_DEPTH + scans))
    for k, (_, adhesion, tangent, depths) in enumerate(materials):
        Delta = np.array(depths[:scans]) / (2.0 * AMPLITUDE[k, :scans])
        v[k, ADHESION], v[k, TANGENT] = math.log(adhesion / UNIT), math.log(tangent)
        v[k, FIRST_DEPTH:] = np.log(Delta / (1.0 - Delta))
    return x, v


def rows_at(q, x, v, *, references=(), corrected=False):
    materials, scans = len(x), v.shape[1] - FIRST_DEPTH
    size = materials * scans * q.rows.orders.size + len(references)
    scene = q.scene(np.zeros(size), np.eye(size), AMPLITUDE[:materials, :scans], UNIT, references)
    f, J, J_x = np.empty(size), np.empty((size, v.size)), np.zeros((size, materials))
    on_the_desk(scene, x, v, corrected, f, J, J_x)
    return f, J, J_x


def viscosity_of(modulus, tangent):
    E = effective_modulus(modulus, POISSON, PROBE.tip.modulus, PROBE.tip.poisson_ratio)
    return tangent * 2.0 * E / (2.0 * math.pi * PROBE.drive.frequency)


def theirs(material, amplitude, indentation, *, full):
    """Return the rows by other code: the full motion by substitution, or the law on a bare cosine by quadrature [N]."""
    modulus, adhesion, tangent, _ = material
    values = {"modulus": modulus, "adhesion": adhesion, "viscosity": viscosity_of(modulus, tangent)}
    if full:
        solid = sample("dmt-viscous", poisson_ratio=POISSON, **values)
        f = indented_states(PROBE, solid, amplitude=[amplitude], indentation=[indentation], n_max=FEW).force[
            0
        ]
    else:
        f = force_harmonics(
            "dmt-viscous",
            amplitude=amplitude,
            indentation=indentation,
            radius=PROBE.tip.radius,
            frequency=PROBE.drive.frequency,
            poisson_ratio=POISSON,
            tip_modulus=PROBE.tip.modulus,
            tip_poisson_ratio=PROBE.tip.poisson_ratio,
            **values,
        )
    return np.concatenate([f.real[list(CONS)], -f.imag[list(DISS)]])


@pytest.mark.parametrize(("harmonics", "accuracy"), [(0, 1e-9), (FEW, 1e-4)], ids=["bare", "full"])
def test_rows_are_those_of_the_law_on_its_motion(harmonics, accuracy):
    f, _, _ = rows_at(question(harmonics), *unknowns())
    for k, material in enumerate(MATERIALS):
        for s, depth in enumerate(material[3]):
            want = theirs(material, AMPLITUDE[k, s], depth, full=harmonics > 0) / UNIT
            got = f[(2 * k + s) * ROWS : (2 * k + s + 1) * ROWS]
            np.testing.assert_allclose(got, want, rtol=accuracy, atol=1e-2 * accuracy * np.abs(want).max())


def test_a_model_without_adhesion_and_loss_has_elastic_rows_only():
    q = question(model=contact_model("hertz"))
    assert not q.sticky
    assert not q.loss
    x, v = unknowns(MATERIALS[:1], 1)
    f, J, _ = rows_at(q, x, v, corrected=True)
    moved = v.copy()
    moved[:, :FIRST_DEPTH] += 1.0
    np.testing.assert_allclose(rows_at(q, x, moved)[0], f, rtol=1e-12)
    assert np.abs(J[:, :FIRST_DEPTH]).max() < 1e-9 * np.abs(f).max()
    assert (f[:2] * [1.0, -1.0] > 0.0).all()  # nothing attracts


def test_slopes_are_those_of_the_rows():
    """Central differences of the rows at rest; all unknowns, two scans, known moduli behind."""
    q, (x, v) = question(), unknowns()
    _, J, J_x = rows_at(q, x, v, references=[2, 0], corrected=True)
    size = np.abs(J[: len(MATERIALS) * 2 * ROWS]).max()
    step = 1e-3

    def difference(dx, dv):
        return (
            rows_at(q, x + dx, v + dv, references=[2, 0])[0]
            - rows_at(q, x - dx, v - dv, references=[2, 0])[0]
        ) / (2.0 * step)

    none_x, none_v = np.zeros_like(x), np.zeros_like(v)
    for k in range(len(x)):
        for a in range(v.shape[1]):
            moved = none_v.copy()
            moved[k, a] = step
            column = J[:, k * v.shape[1] + a]
            np.testing.assert_allclose(column, difference(none_x, moved), atol=1e-3 * np.abs(column).max())
        moved_x = none_x.copy()
        moved_x[k] = step
        np.testing.assert_allclose(
            J_x[:, k], difference(moved_x, none_v), atol=1e-3 * np.abs(J_x[:-2, k]).max()
        )
    # without what the harmonics of the motion add they are some per cent off
    bare = rows_at(q, x, v, references=[2, 0])[1]
    assert 3e-3 * size < np.abs(bare - J).max() < 0.2 * size
    assert J_x[-2].tolist() == [0.0, 0.0, 1.0]
    assert J_x[-1].tolist() == [1.0, 0.0, 0.0]
    assert BY_MODULUS == 3


def log_posterior(q, scene, x, v):
    """Return ln of the posterior density of (ln E, ln F, ln tan, t): data, and priors that are flat in F and tan."""
    f, _, _ = rows_at(q, x, v)
    off = f - scene.centre
    F = np.exp(v[:, ADHESION]) * UNIT
    prior = (
        -0.5 * q.prior.adhesion_precision * (F - q.prior.adhesion_mean) ** 2 + v[:, ADHESION] + v[:, TANGENT]
    )
    # ln of the indentation is uniform: d ln Delta/dt = 1 - Delta
    Delta = 1.0 / (1.0 + np.exp(-v[:, FIRST_DEPTH:]))
    return -0.5 * off @ scene.precision @ off + prior.sum() + np.log(1.0 - Delta).sum()


@pytest.mark.parametrize("index", [0, 1])
def test_climbing_ends_on_the_summit(index):
    q, material = question(), (MATERIALS[index],)
    x, v = unknowns(material, 1)
    x, v = x.copy(), v.copy()
    truth = np.r_[x, v[0]]
    f, _, _ = rows_at(q, x, v)
    noise = np.array([4.0, 0.6, 3.0, 7.0, 0.6, 3.0, 7.0]) * 1e-12 / UNIT
    random = np.random.default_rng(3)
    scene = q.scene(
        f + noise * random.standard_normal(f.size), np.diag(noise**-2.0), AMPLITUDE[:1, :1], UNIT, []
    )
    x += 0.8
    v += np.array([[-0.7, 0.6, 0.5]])
    start = np.r_[x, v[0]]
    covariance = np.empty((1, 1))
    height = climb(scene, q.prior, True, True, x, v, covariance)
    assert height == pytest.approx(log_posterior(q, scene, x, v), rel=0, abs=0.05)
    # differences say that it is a summit, and how wide: within a few deviations of the truth
    at, steps = np.r_[x, v[0]], np.full(4, 2e-4)

    def value(u):
        return log_posterior(q, scene, u[:1], u[None, 1:])

    eye = np.diag(steps)
    gradient = np.array([(value(at + e) - value(at - e)) / (2.0 * e.sum()) for e in eye])
    hessian = np.array(
        [
            [
                (value(at + e + g) - value(at + e - g) - value(at - e + g) + value(at - e - g))
                / (4.0 * e.sum() * g.sum())
                for g in eye
            ]
            for e in eye
        ]
    )
    width = np.linalg.inv(-hessian)
    # what is left to climb: ln of the density, and a quarter of a deviation; the start was hundreds below
    assert np.linalg.eigvalsh(-hessian)[0] > 0.0
    assert 0.5 * gradient @ width @ gradient < 0.03
    assert value(start) < height - 200.0
    assert height - 10.0 < value(truth) < height + 0.03
    assert covariance[0, 0] == pytest.approx(width[0, 0], rel=0.25, abs=0)


@pytest.mark.parametrize("index", [0, 1, 2])
def test_places_along_the_valley_hold_the_truth(index):
    q, material = question(), (MATERIALS[index],)
    x, v = unknowns(material, 1)
    f, _, _ = rows_at(q, x, v)
    noise = np.array([4.0, 0.6, 3.0, 7.0, 0.6, 3.0, 7.0]) * 1e-12 / UNIT
    # unknowns of `rows_at` are at the amplitude of the first material
    scene = q.scene(f, np.diag(noise**-2.0), AMPLITUDE[:1, :1], UNIT, [])
    places = v[0, FIRST_DEPTH] + np.array([-1.0, 0.0, 1.0])
    ln_E, others, chi2 = np.empty(3), np.empty((3, FIRST_DEPTH + 1)), np.empty(3)
    starts_of_material(scene, True, True, ln_E, others, chi2, places)
    assert np.argmin(chi2) == 1
    assert chi2[1] < 1e-2
    assert chi2[[0, 2]].min() > 20.0 * chi2[1]
    assert ln_E[1] == pytest.approx(x[0], rel=0, abs=0.01)
    np.testing.assert_allclose(others[1], v[0], atol=0.01)


def test_no_place_is_one_of_a_sample_stiffer_than_any():
    q = question()
    x, v = unknowns(MATERIALS[:1], 1)
    f, _, _ = rows_at(q, x, v)
    noise = np.full(ROWS, 1e-3)
    scene = q.scene(f, np.diag(noise**-2.0), AMPLITUDE[:1, :1], UNIT, [])
    ln_E, others, chi2 = np.empty(1), np.empty((1, FIRST_DEPTH + 1)), np.empty(1)
    starts_of_material(scene, True, True, ln_E, others, chi2, np.array([-9.0]))
    assert math.isnan(ln_E[0])
    assert chi2[0] == math.inf
