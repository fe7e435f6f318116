"""Draws of materials: against the quadrature over a pixel, and against its sums over what two materials share."""

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
from overtone.inversion.posterior import (
    ADHESION_,
    EVIDENCE_,
    INDENTATION_,
    MEAN_,
    MODULUS_,
    QUANTITIES,
    SPREAD_,
    SUMMARIES,
    TANGENT_,
    posterior_pixels,
)
from overtone.inversion.priors import Prior, complete_priors, for_kernel
from overtone.inversion.table import table_of
from overtone.population.evidence import Evidence
from overtone.population.forward import ADHESION, FIRST_DEPTH, TANGENT
from overtone.population.materials import MIXED, Question, draw_materials, profiles_of
from overtone.population.sampler import walk

PROBE, POISSON = demo_probe(), 0.35
RECORD = contact_model("dmt-viscous")
CONS, DISS = (0, 1, 2, 3), (1, 2, 3)
UNIT = 1e-9
A = 39.5e-9
MATERIALS = {"stiff": (1.9e9, 2e-9, 0.05, 1.1e-9), "soft": (94e6, 16e-9, 0.15, 7.5e-9)}
NOISE = np.array([3.0, 0.6, 3.0, 7.0, 0.6, 3.0, 7.0]) * 1e-12 / UNIT
LEVELS = np.array([0.05, 0.5, 0.95])


def question(stated=None, harmonics=FEW):
    rows, _ = rows_of(CONS, DISS)
    priors = for_kernel(complete_priors(stated, RECORD, PROBE.tip.radius), "modulus")
    columns = columns_of(RECORD, PROBE, {"poisson_ratio": POISSON})
    return Question(columns, rows, follow(PROBE, (2, 3), harmonics), priors)


def forces(material, *, full=True):
    """Return the rows of a material by substitution of the motion, or on a bare cosine [unit]."""
    modulus, adhesion, tangent, depth = material
    E = effective_modulus(modulus, POISSON, PROBE.tip.modulus, PROBE.tip.poisson_ratio)
    values = {
        "modulus": modulus,
        "adhesion": adhesion,
        "viscosity": tangent * 2.0 * E / (2.0 * math.pi * PROBE.drive.frequency),
        "poisson_ratio": POISSON,
    }
    if full:
        solid = sample("dmt-viscous", **values)
        f = indented_states(PROBE, solid, amplitude=[A], indentation=[depth], n_max=FEW).force[0]
    else:
        values |= {"tip_modulus": PROBE.tip.modulus, "tip_poisson_ratio": PROBE.tip.poisson_ratio}
        values |= {"radius": PROBE.tip.radius, "frequency": PROBE.drive.frequency}
        f = force_harmonics("dmt-viscous", amplitude=A, indentation=depth, **values)
    return np.concatenate([f.real[list(CONS)], -f.imag[list(DISS)]]) / UNIT


def evidence(mean, statistical, changes):
    """Return the evidence of harmonics whose shared errors nothing but they tell of."""
    sources = changes.shape[1]
    return Evidence(
        mean,
        statistical + changes @ changes.T,
        statistical,
        UNIT,
        mean,
        changes,
        np.eye(sources),
        np.zeros(sources),
        np.zeros(sources),
    )


def draws(q, told, materials, seed):
    amplitude = np.full((materials, 1), A)
    parts = profiles_of(q, told, amplitude, ())
    assert parts is not None
    return draw_materials(q, told, amplitude, (), parts, seed), parts


def pixel(q, y, covariance):
    """Return quantiles and summary of rows [unit], by the sums over a pixel."""
    count, size = len(y), len(NOISE)
    W = np.broadcast_to(np.linalg.inv(np.linalg.cholesky(covariance * UNIT**2)), (count, size, size)).copy()
    quantiles, summary = np.empty((count, QUANTITIES, 3)), np.empty((count, SUMMARIES))
    amplitude = np.full(count, A)
    posterior_pixels(
        y * UNIT,
        W,
        amplitude,
        np.ones(count, bool),
        q.columns,
        table_of(q.columns, amplitude, 3),
        q.rows.orders,
        q.rows.lossy,
        np.array([1]),
        q.prior,
        follow(PROBE, (), max(q.followed.tip.size - 1, 0)),
        np.zeros((count, 0), complex),
        np.zeros((count, size)),
        np.zeros(count),
        True,
        quantiles,
        summary,
    )
    return quantiles, summary


def walked(q, told, part, steps, stride=0.5, seed=1):
    """Return a long chain of one material."""
    scene = q.scene(told.centre, told.precision, np.array([[A]]), UNIT, [])
    random = np.random.default_rng(seed)
    start, others = part.at(0.5)
    x, v, f = np.empty((steps, 1)), np.empty((steps, 1, FIRST_DEPTH + 1)), np.empty((steps, NOISE.size))
    numbers = random.standard_normal((steps, FIRST_DEPTH + 2)), random.uniform(size=steps)
    walk(scene, q.prior, True, True, stride, np.array([start]), others[None].copy(), *numbers, x, v, f)
    return x[steps // 20 :, 0], v[steps // 20 :, 0], f[steps // 20 :]


@pytest.fixture(scope="module", params=list(MATERIALS))
def alone(request):
    """One material, measured once; the quadrature of a pixel says what its posterior is.

    The stiff one on a bare cosine: its draws hang together, and many are needed.
    """
    full = request.param == "soft"
    q = question(harmonics=FEW if full else 0)
    sigma = NOISE * {"stiff": 0.3, "soft": 1.0}[request.param]
    y = forces(MATERIALS[request.param], full=full) + sigma * np.random.default_rng(5).standard_normal(
        NOISE.size
    )
    told = evidence(y, np.diag(sigma**2), np.zeros((NOISE.size, 0)))
    parts = profiles_of(q, told, np.array([[A]]), ())
    assert parts is not None
    return q, told, parts[0], pixel(q, y[None], np.diag(sigma**2))[0][0]


def test_draws_of_one_material_are_those_of_the_quadrature_over_a_pixel(alone):
    q, told, part, want = alone
    x, v, f = walked(q, told, part, 20000 if q.followed.tip.size else 240000)
    Delta = 1.0 / (1.0 + np.exp(-v[:, FIRST_DEPTH]))
    for values, truth in (
        (x, want[MODULUS_]),
        (np.exp(v[:, ADHESION]) * UNIT, want[ADHESION_]),
        (np.exp(v[:, TANGENT]), want[TANGENT_]),
        (2.0 * A * Delta, want[INDENTATION_]),
    ):
        width = truth[2] - truth[0]
        # neighbours in a chain are alike; and the sums themselves are sure of 3 %
        np.testing.assert_allclose(np.quantile(values, LEVELS), truth, rtol=0, atol=0.08 * width)
        assert np.mean((values > truth[0]) & (values < truth[2])) == pytest.approx(0.9, rel=0, abs=0.03)
    # what fits, fits: 7 harmonics
    off = (f - told.centre) / np.sqrt(np.diag(told.covariance))
    assert 2.0 < np.median((off**2).sum(axis=1)) < 20.0


@pytest.mark.parametrize("alone", ["soft"], indirect=True)
@pytest.mark.parametrize("stride", [0.5, 1.2])
def test_however_long_the_steps_the_draws_are_the_same(alone, stride):
    """A step that cannot be taken back would make draws lean to where such steps lead: by 6 % of the width, if long."""
    q, told, part, want = alone
    width = want[MODULUS_, 2] - want[MODULUS_, 0]
    x, _, _ = walked(q, told, part, 20000, stride, seed=2)
    np.testing.assert_allclose(np.quantile(x, LEVELS), want[MODULUS_], rtol=0, atol=0.04 * width)


def test_the_profile_of_a_material_is_that_of_the_quadrature(alone):
    _, _, part, want = alone
    got = [part.quantile(level) for level in LEVELS]
    width = want[MODULUS_, 2] - want[MODULUS_, 0]
    np.testing.assert_allclose(got, want[MODULUS_], rtol=0, atol=0.12 * width)
    assert part.below[0] == 0.0
    assert part.below[-1] == pytest.approx(1.0, rel=1e-12, abs=0)


def test_chains_are_accepted_agree_and_are_the_same_for_the_same_seed(alone):
    q, told, part, want = alone
    amplitude = np.array([[A]])
    drawn = [draw_materials(q, told, amplitude, (), [part], seed) for seed in (0, 1, 0)]
    for d in drawn:
        assert 0.3 < d.accepted < 0.9
        assert (d.mixing < MIXED).all()
    first, second, again = drawn
    np.testing.assert_array_equal(again.ln_E, first.ln_E)
    np.testing.assert_array_equal(again.unknowns, first.unknowns)
    np.testing.assert_array_equal(again.forces, first.forces)
    width = want[MODULUS_, 2] - want[MODULUS_, 0]
    assert not np.array_equal(second.ln_E, first.ln_E)
    for d in (first, second):
        assert np.median(d.ln_E) == pytest.approx(want[MODULUS_, 1], rel=0, abs=0.25 * width)
        got = np.quantile(d.ln_E, 0.95) - np.quantile(d.ln_E, 0.05)
        # of a stiff one few draws are independent, and its open end is reached slowly
        assert got == pytest.approx(width, rel=0.3 if width < 1.0 else 0.5, abs=0)


def test_two_materials_share_what_the_calibration_left_open():
    """At each z materials are independent: sums over z of sums over pixels are the whole posterior."""
    q, random = question(), np.random.default_rng(9)
    size = NOISE.size
    y = np.concatenate([forces(material) for material in MATERIALS.values()])
    change = np.zeros((2 * size, 1))
    change[[0, size], 0] = 0.03  # the zero of A0, ten times its noise
    change[[2, size + 2], 0] = 0.01 * y[[2, size + 2]]
    true_z = 0.8
    y = y + change[:, 0] * true_z + np.tile(NOISE, 2) * random.standard_normal(2 * size)
    told = evidence(y, np.diag(np.tile(NOISE, 2) ** 2), change)
    nodes = np.linspace(-4.0, 4.0, 161)
    log_w, mean, spread = -0.5 * nodes**2, [], []
    for k in range(2):
        at = slice(k * size, (k + 1) * size)
        _, summary = pixel(q, y[at] - nodes[:, None] * change[at, 0], np.diag(NOISE**2))
        log_w = log_w + summary[:, EVIDENCE_]
        mean.append(summary[:, MEAN_])
        spread.append(summary[:, SPREAD_])
    w = np.exp(log_w - log_w.max())
    w /= w.sum()
    mean, spread = np.array(mean), np.array(spread)
    middle = mean @ w
    covariance = (mean - middle[:, None]) * w @ (mean - middle[:, None]).T + np.diag(spread**2 @ w)
    size_of = np.sqrt(np.diag(covariance))
    correlation = covariance[0, 1] / size_of.prod()
    z_mean = nodes @ w
    z_spread = math.sqrt((nodes - z_mean) ** 2 @ w)
    # the two together know z better than before, and it ties them
    assert z_spread < 0.8
    found = [draws(q, told, 2, seed)[0] for seed in range(3)]
    ln_E, z = np.concatenate([d.ln_E for d in found]), np.concatenate([d.z[:, 0] for d in found])
    assert (np.abs(ln_E.mean(axis=0) - middle) < 0.15 * size_of).all()
    np.testing.assert_allclose(ln_E.std(axis=0), size_of, rtol=0.15)
    assert np.corrcoef(ln_E.T)[0, 1] == pytest.approx(correlation, rel=0, abs=0.12)
    assert z.mean() == pytest.approx(z_mean, rel=0, abs=0.15 * z_spread)
    assert z.std() == pytest.approx(z_spread, rel=0.15, abs=0)
    assert all(d.mixing.max() < MIXED for d in found)


@pytest.mark.parametrize(
    ("name", "prior"),
    [
        ("loss_tangent", Prior("range", 0.0, 0.04)),
        ("adhesion", Prior("range", 0.0, 1.2e-9)),
        ("adhesion", Prior("range", 4e-9, 30e-9)),
        ("modulus", Prior("log-range", 1e6, 1.2e9)),
        ("modulus", Prior("log-range", 3e9, 3e11)),
    ],
)
def test_draws_stay_within_bounds_that_the_data_would_leave(name, prior):
    """Where the truth is beyond a bound the draws pile up before it, and move."""
    q = question({name: prior})
    # a little noisier, so that a bound is beyond what is likely but not beyond belief
    sigma = 4.0 * NOISE
    told = evidence(forces(MATERIALS["stiff"]), np.diag(sigma**2), np.zeros((sigma.size, 0)))
    drawn, _ = draws(q, told, 1, 1)
    values = {
        "modulus": np.exp(drawn.ln_E[:, 0]),
        "adhesion": np.exp(drawn.unknowns[:, 0, ADHESION]) * UNIT,
        "loss_tangent": np.exp(drawn.unknowns[:, 0, TANGENT]),
    }[name]
    assert (values >= prior.first).all()
    assert (values <= prior.second).all()
    assert drawn.accepted > 0.1
    assert np.unique(drawn.ln_E).size > 50
    quantiles, _ = pixel(q, told.centre[None], np.diag(sigma**2))
    low, middle, high = quantiles[0, MODULUS_]
    got = np.quantile(drawn.ln_E[:, 0], LEVELS)
    np.testing.assert_allclose(got, (low, middle, high), rtol=0, atol=0.2 * (high - low))
