"""The posterior of a pixel against sums over dense grids of every unknown, by numpy alone."""

import math
from typing import NamedTuple

import numpy as np
import pytest

from overtone.contact.evaluate import force_harmonics
from overtone.contact.models import contact_model
from overtone.contact.terms import adhesion_harmonics
from overtone.inversion.columns import WORK_ROWS, Columns, columns_of, fill_columns
from overtone.inversion.forces import rows_of
from overtone.inversion.linear import stiffness
from overtone.inversion.motion import follow
from overtone.inversion.posterior import (
    ADHESION_,
    CONTACT_,
    EVIDENCE_,
    INDENTATION_,
    LOSS_,
    MEAN_,
    MISFIT_,
    MODULUS_,
    QUANTITIES,
    SPREAD_,
    SUMMARIES,
    TANGENT_,
    Prior,
    posterior_pixels,
)
from overtone.inversion.table import table_of
from overtone.probe import Probe

PROBE = Probe.simple(
    stiffness=16.4,
    frequency=161.8e3,
    quality_factor=287.0,
    radius=10e-9,
    drive_frequency=161.8e3,
    free_amplitude=94e-9,
)
LEVELS = np.array([0.05, 0.5, 0.95])
HALF_NORMAL = Prior(
    log_low=math.log(1e6),
    log_high=math.log(3e11),
    centre=0.0,
    precision=0.0,
    adhesion_low=0.0,
    adhesion_high=6.0 * 19e-9,
    adhesion_mean=0.0,
    adhesion_precision=19e-9**-2,
    tangent_high=2.0,
    shallowest=1e-11,
    deepest=1e-6,
    contact=0.5,
)
RANGE = HALF_NORMAL._replace(adhesion_low=1e-9, adhesion_high=60e-9, adhesion_precision=0.0)
NORMAL = HALF_NORMAL._replace(
    adhesion_high=12e-9 + 6.0 * 3e-9, adhesion_mean=12e-9, adhesion_precision=3e-9**-2
)
LOG_NORMAL = HALF_NORMAL._replace(
    log_low=math.log(1e9) - 6.0 * math.log(3.0),
    log_high=math.log(1e9) + 6.0 * math.log(3.0),
    centre=math.log(1e9),
    precision=math.log(3.0) ** -2,
)


class Pixel(NamedTuple):
    """A pixel: what was measured, and what whitens its errors."""

    y: np.ndarray
    W: np.ndarray
    amplitude: float
    cons: tuple[int, ...]
    diss: tuple[int, ...] = ()
    model: str = "dmt"


class Answer(NamedTuple):
    quantiles: np.ndarray
    summary: np.ndarray


def columns(model: str) -> Columns:
    return columns_of(contact_model(model), PROBE, {"poisson_ratio": 0.3})


def ours(
    pixel: Pixel, prior: Prior, pull: np.ndarray | None = None, left: float = 0.0, whole: bool = True
) -> Answer:
    of, (rows, _) = columns(pixel.model), rows_of(pixel.cons, pixel.diss)
    amplitude = np.array([pixel.amplitude])
    answer = Answer(np.empty((1, QUANTITIES, 3)), np.empty((1, SUMMARIES)))
    size = rows.orders.size
    posterior_pixels(
        pixel.y[None],
        pixel.W[None],
        amplitude,
        np.array([True]),
        of,
        table_of(of, amplitude, int(rows.orders.max())),
        rows.orders,
        rows.lossy,
        np.array([pixel.cons.index(1) if 1 in pixel.cons else -1]),
        prior,
        follow(PROBE, (), 0),
        np.zeros((1, 0), complex),
        np.zeros((1, size)) if pull is None else pull[None],
        np.array([left]),
        whole,
        *answer,
    )
    return Answer(answer.quantiles[0], answer.summary[0])


def legendre(low: np.ndarray, high: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return nodes and weights between bounds, on a new last axis."""
    x, w = np.polynomial.legendre.leggauss(count)
    half = 0.5 * (high - low)[..., None]
    return low[..., None] + half * (1.0 + x), half * w


def reach(
    low: np.ndarray, high: np.ndarray, mean: np.ndarray, sigma: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return where a Gaussian between two bounds has its mass."""
    left = np.maximum(low, np.minimum(mean - 8.0 * sigma, high))
    right = np.minimum(high, np.maximum(mean + 8.0 * sigma, low))
    # beyond a bound it falls off within a part of sigma
    tail = 40.0 * sigma**2 / np.maximum(np.maximum(low - mean, mean - high), sigma)
    right = np.where(
        mean < low, np.minimum(right + (right <= left) * tail, low + np.minimum(tail, 8.0 * sigma)), right
    )
    left = np.where(mean > high, np.maximum(high - np.minimum(tail, 8.0 * sigma), low), left)
    return left, np.minimum(right, high)


class Brute(NamedTuple):
    """Sums of the posterior over dense grids."""

    log_evidence: float
    """Of contact alone, priors included but not that of contact."""
    t: np.ndarray
    along: np.ndarray
    """Mass at each t."""
    x: np.ndarray
    F: np.ndarray
    tangent: np.ndarray
    c: np.ndarray
    weight: np.ndarray
    """(t, x, F, tangent)."""
    misfit: float


def sum_over(pixel: Pixel, prior: Prior, t: np.ndarray, sizes: tuple[int, int, int]) -> Brute:
    of, (rows, _) = columns(pixel.model), rows_of(pixel.cons, pixel.diss)
    A, orders = pixel.amplitude, rows.orders
    work = np.empty((WORK_ROWS, 4))
    a, b, v = (np.zeros((t.size, orders.size)) for _ in range(3))
    Delta = 1.0 / (1.0 + np.exp(-t))
    for k, D in enumerate(Delta):
        fill_columns(of, A, D, 3, work)
        a[k] = np.where(rows.lossy, 0.0, work[0, orders])
        b[k] = np.where(rows.lossy, 0.0, work[2, orders])
        v[k] = np.where(rows.lossy, -orders * work[0, orders], 0.0)
    a, b, v, y = a @ pixel.W.T, b @ pixel.W.T, v @ pixel.W.T, pixel.W @ pixel.y
    lossy = bool(rows.lossy.any())
    E_low, E_high = prior.log_low, prior.log_high
    # first look: for each t, which ln E matter at all (best F_ad within bounds, best loss of any sign)
    x = np.broadcast_to(np.linspace(E_low, E_high, 4001), (t.size, 4001))

    def S_of(x: np.ndarray) -> np.ndarray:
        compliance = of.contact.tip_compliance + of.contact.sample_factor * np.exp(-x)
        return of.contact.factor / compliance

    def project(u: np.ndarray) -> np.ndarray:
        """Take the loss off a column."""
        if not lossy:
            return u
        return u - v * ((u * v).sum(axis=1) / (v * v).sum(axis=1))[:, None]

    ra, rb = project(a), project(b)
    ry = project(np.broadcast_to(y, a.shape))
    bb = (rb * rb).sum(axis=1)[:, None]
    root = prior.adhesion_precision

    def conditional(S: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return mean and deviation of F_ad at S, prior included."""
        by = (rb * ry).sum(axis=1)[:, None] - S * (ra * rb).sum(axis=1)[:, None]
        precision = bb + root
        return (by + root * prior.adhesion_mean) / precision, np.broadcast_to(precision**-0.5, by.shape)

    def profile(x: np.ndarray) -> np.ndarray:
        S = S_of(x)
        F = np.clip(conditional(S)[0], prior.adhesion_low, prior.adhesion_high)
        left = ry[:, None] - S[..., None] * ra[:, None] - F[..., None] * rb[:, None]
        return (
            (left**2).sum(axis=2)
            + root * (F - prior.adhesion_mean) ** 2
            + prior.precision * (x - prior.centre) ** 2
        )

    # the range of ln E at each t: grids within grids, because a valley may be a thousandth wide
    low, high = np.full(t.size, E_low), np.full(t.size, E_high)
    for _ in range(7):
        x = low[:, None] + (high - low)[:, None] * np.linspace(0.0, 1.0, 121)
        value = profile(x)
        best = value.argmin(axis=1)
        keep = value <= value.min(axis=1, keepdims=True) + 60.0
        first, last = keep.argmax(axis=1), 120 - keep[:, ::-1].argmax(axis=1)
        at = np.arange(t.size)
        low, high = x[at, np.maximum(first - 1, 0)], x[at, np.minimum(last + 1, 120)]
        assert (best >= 0).all()
    x, wx = legendre(low, high, sizes[0])
    S = S_of(x)
    mean, sigma = conditional(S)
    F, wF = legendre(
        *reach(np.full(S.shape, prior.adhesion_low), np.full(S.shape, prior.adhesion_high), mean, sigma),
        sizes[1],
    )
    left = y - S[..., None, None] * a[:, None, None] - F[..., None] * b[:, None, None]
    if lossy:
        vv = (v * v).sum(axis=1)[:, None, None]
        c_mean = (left * v[:, None, None]).sum(axis=3) / vv
        high_c = np.broadcast_to((prior.tangent_high * S)[..., None], c_mean.shape)
        c, wc = legendre(
            *reach(np.zeros(c_mean.shape), high_c, c_mean, np.broadcast_to(vv**-0.5, c_mean.shape)), sizes[2]
        )
        rest = (
            (left**2).sum(axis=3) - c_mean**2 * vv[..., 0][..., None]
            if vv.ndim == 4
            else (left**2).sum(axis=3) - c_mean**2 * vv
        )
        chi2 = rest[..., None] + vv[..., None] * (c - c_mean[..., None]) ** 2
        tangent = c / S[..., None, None]
        measure = wc / S[..., None, None] / prior.tangent_high
    else:
        chi2, c = (left**2).sum(axis=3)[..., None], np.zeros((*F.shape, 1))
        tangent, measure = c, np.ones_like(c)
    penalty = root * (F - prior.adhesion_mean) ** 2
    log_E = prior.precision * (x - prior.centre) ** 2
    least = float(chi2.min())
    density = np.exp(-0.5 * (chi2 - least) - 0.5 * penalty[..., None] - 0.5 * log_E[..., None, None])
    step = np.gradient(t)
    step[[0, -1]] *= 0.5
    by_t = step * (1.0 - Delta)
    weight = density * measure * wF[..., None] * wx[..., None, None] * by_t[:, None, None, None]
    # the priors' norms
    grid_F = np.linspace(prior.adhesion_low, prior.adhesion_high, 20001)
    norm_F = np.trapezoid(np.exp(-0.5 * root * (grid_F - prior.adhesion_mean) ** 2), grid_F)
    grid_x = np.linspace(E_low, E_high, 20001)
    norm_x = np.trapezoid(np.exp(-0.5 * prior.precision * (grid_x - prior.centre) ** 2), grid_x)
    bottom = max(prior.shallowest, 2.0 * A / (1.0 + math.exp(11.5)))
    norm_t = math.log(2.0 * A / (1.0 + math.exp(-7.0)) / bottom)
    total = float(weight.sum())
    log_norm = float(np.log(np.diag(pixel.W)).sum()) - 0.5 * orders.size * math.log(2.0 * math.pi)
    evidence = math.log(total / (norm_F * norm_x * norm_t)) - 0.5 * least + log_norm
    return Brute(evidence, t, weight.sum(axis=(1, 2, 3)), x, F, tangent, c, weight, least)


def brute(pixel: Pixel, prior: Prior, sizes: tuple[int, int, int] = (60, 24, 1), count: int = 700) -> Brute:
    A = pixel.amplitude
    bottom = max(math.log(prior.shallowest / (2.0 * A - prior.shallowest)), -11.5)
    low, high = bottom, 7.0
    found = sum_over(pixel, prior, np.linspace(low, high, count), (40, 12, min(8, sizes[2])))
    # only where there is anything, on a finer grid each time
    for _ in range(2):
        some = np.flatnonzero(found.along > 1e-9 * found.along.max())
        low = found.t[max(some[0] - 2, 0)]
        high = found.t[min(some[-1] + 2, count - 1)]
        found = sum_over(pixel, prior, np.linspace(low, high, count), sizes)
    return found


def weighted_quantiles(values: np.ndarray, weight: np.ndarray) -> np.ndarray:
    values, weight = np.broadcast_arrays(values, weight)
    some = weight > 1e-12 * weight.max()
    order = np.argsort(values[some])
    x, w = values[some][order], weight[some][order]
    share = (np.cumsum(w) - 0.5 * w) / w.sum()
    return np.interp(LEVELS, share, x)


def check(pixel: Pixel, prior: Prior, sizes: tuple[int, int, int] = (60, 24, 1), count: int = 700) -> Brute:
    """Compare quantiles with sums to 8 % of the width of each interval, and the evidence to 0.1."""
    got, want = ours(pixel, prior), brute(pixel, prior, sizes, count)
    evidence = want.log_evidence + math.log(prior.contact)
    if pixel.y[pixel.cons.index(1)] > 0.0:
        apart = apart_by_brute_force(pixel, prior)[0] + math.log(1.0 - prior.contact)
        assert apart < evidence  # else the medians are those of another regime
        evidence = float(np.logaddexp(evidence, apart))
    assert got.summary[EVIDENCE_] == pytest.approx(evidence, abs=0.1)
    x, F, tangent = want.x[..., None, None], want.F[..., None], want.tangent
    quantiles = {
        MODULUS_: weighted_quantiles(want.x, want.weight.sum(axis=(2, 3))),
        ADHESION_: weighted_quantiles(want.F, want.weight.sum(axis=3)),
    }
    total = want.weight.sum()
    mean = float((want.weight * x).sum() / total)
    spread = math.sqrt(float((want.weight * (x - mean) ** 2).sum() / total))
    assert got.summary[MEAN_] == pytest.approx(mean, abs=0.1 * spread)
    assert got.summary[SPREAD_] == pytest.approx(spread, rel=0.06)
    share = (np.cumsum(want.along) - 0.5 * want.along) / want.along.sum()
    t = np.interp(LEVELS, share, want.t)
    quantiles[INDENTATION_] = np.log(2.0 * pixel.amplitude / (1.0 + np.exp(-t)))
    mine = {q: got.quantiles[q] for q in quantiles}
    mine[INDENTATION_] = np.log(got.quantiles[INDENTATION_])
    if pixel.diss:
        quantiles[TANGENT_] = weighted_quantiles(tangent, want.weight)
        quantiles[LOSS_] = np.log(weighted_quantiles(want.c, want.weight))
        mine[TANGENT_], mine[LOSS_] = got.quantiles[TANGENT_], np.log(got.quantiles[LOSS_])
    assert F.shape[0] == x.shape[0]
    for q, theirs in quantiles.items():
        off = (mine[q] - theirs) / (theirs[2] - theirs[0])
        np.testing.assert_allclose(off, 0.0, atol=0.08, err_msg=f"quantity {q}: {mine[q]} {theirs}")
    return want


def noisy(
    modulus: float,
    adhesion: float,
    indentation: float,
    noise: float,
    cons: tuple[int, ...],
    seed: int,
    amplitude: float = 45e-9,
    tangent: float = -1.0,
) -> Pixel:
    """Return a pixel with the errors of an ordinary scan times ``noise``; the phase is shared by its forces."""
    random = np.random.default_rng(seed)
    diss = (1, 2) if tangent >= 0.0 else ()
    model = "dmt-viscous" if diss else "dmt"
    of = columns(model)
    known = {"radius": 10e-9, "poisson_ratio": 0.3}
    if diss:
        S, _ = stiffness(of.contact, modulus)
        known |= {"viscosity": tangent * S / of.loss, "frequency": 161.8e3}
    f = force_harmonics(
        model, amplitude=amplitude, indentation=indentation, modulus=modulus, adhesion=adhesion, **known
    )
    y = np.concatenate([f.real[list(cons)], -f.imag[list(diss)]])
    sigma = {0: 16.4 * 5e-12, 1: 1e-12, 2: 3 * 16.4 * 1e-12, 3: 8 * 16.4 * 1e-12}
    own = np.array([sigma[n] for n in cons] + [{1: 16.4 / 287 * 2e-11, 2: sigma[2]}[n] for n in diss])
    phase = (
        1.7e-3
        * 16.4
        / 287
        * 94e-9
        * np.array([0.0 if n == 0 else 0.8 if n == 1 else 0.02 * n for n in cons] + [0.5] * len(diss))
    )
    C = noise**2 * (np.diag(own**2) + np.outer(phase, phase))
    y = y + np.linalg.cholesky(C) @ random.normal(size=y.size)
    return Pixel(y, np.linalg.inv(np.linalg.cholesky(C)), amplitude, cons, diss, model)


PIXELS = {
    "soft, deep": noisy(80e6, 12e-9, 12e-9, 1.0, (0, 1, 2), 1),
    "soft, four harmonics": noisy(60e6, 15e-9, 8e-9, 1.0, (0, 1, 2, 3), 2),
    "soft, little noise": noisy(150e6, 8e-9, 6e-9, 0.1, (0, 1, 2), 3),
    "medium": noisy(600e6, 10e-9, 4e-9, 1.0, (0, 1, 2, 3), 4),
    "medium, little noise": noisy(600e6, 10e-9, 4e-9, 0.1, (1, 2, 3), 5),
    "medium, hardly any noise": noisy(700e6, 10e-9, 4e-9, 0.01, (0, 1, 2, 3), 6),
    "stiff": noisy(2.5e9, 8e-9, 2e-9, 1.0, (0, 1, 2), 7),
    "stiff, much noise": noisy(2.5e9, 8e-9, 2e-9, 5.0, (0, 1, 2, 3), 8),
    "stiff, shallow": noisy(4e9, 12e-9, 0.6e-9, 1.0, (0, 1, 2, 3), 9),
    "no adhesion": noisy(300e6, 0.0, 5e-9, 1.0, (0, 1, 2), 10),
    "very soft": noisy(5e6, 5e-9, 30e-9, 1.0, (0, 1, 2, 3), 11),
    "hopeless": noisy(2e9, 5e-9, 3e-9, 40.0, (0, 1, 2), 12),
}


@pytest.mark.parametrize("key", PIXELS)
def test_medians_and_intervals_are_those_of_a_dense_grid(key: str) -> None:
    pixel = PIXELS[key]
    check(pixel, HALF_NORMAL)
    got = ours(pixel, HALF_NORMAL)
    # repelled: out of contact does not count
    assert (got.summary[CONTACT_] == 1.0) == (pixel.y[pixel.cons.index(1)] <= 0.0) or got.summary[
        CONTACT_
    ] > 0.99


@pytest.mark.parametrize("prior", [RANGE, NORMAL, LOG_NORMAL], ids=["range", "normal", "log-normal"])
@pytest.mark.parametrize("key", ["soft, deep", "medium", "stiff, much noise"])
def test_other_priors(key: str, prior: Prior) -> None:
    check(PIXELS[key], prior)


def test_the_misfit_is_that_of_the_data_alone() -> None:
    """A strongly adhesive sample that the model gives exactly does not fit badly: the prior is no datum."""
    exact = noisy(300e6, 45e-9, 6e-9, 0.03, (0, 1, 2, 3), 61)
    f = force_harmonics(
        "dmt",
        amplitude=exact.amplitude,
        indentation=6e-9,
        radius=10e-9,
        poisson_ratio=0.3,
        modulus=300e6,
        adhesion=45e-9,
    )
    assert ours(exact._replace(y=f.real.copy()), HALF_NORMAL).summary[MISFIT_] < 0.5


def test_a_prior_that_knows_more_leaves_less() -> None:
    pixel = PIXELS["stiff"]
    wide, sharp = (
        ours(pixel, HALF_NORMAL),
        ours(pixel, HALF_NORMAL._replace(adhesion_mean=8e-9, adhesion_precision=0.1e-9**-2)),
    )
    assert np.ptp(sharp.quantiles[ADHESION_]) < 0.05 * np.ptp(wide.quantiles[ADHESION_])
    assert sharp.summary[SPREAD_] < 0.9 * wide.summary[SPREAD_]


@pytest.mark.parametrize(
    "pixel",
    [
        noisy(90e6, 10e-9, 9e-9, 1.0, (0, 1, 2), 21, tangent=0.3),
        noisy(1.2e9, 6e-9, 3e-9, 1.0, (0, 1, 2, 3), 22, tangent=0.05),
    ],
    ids=["soft", "stiff"],
)
def test_a_model_with_loss(pixel: Pixel) -> None:
    """Four unknowns: the loss is shared by two harmonics, and by the conservative ones through the phase."""
    check(pixel, HALF_NORMAL, sizes=(50, 20, 18), count=300)


def apart_by_brute_force(pixel: Pixel, prior: Prior) -> tuple[float, np.ndarray, np.ndarray]:
    """Return the logarithm of the evidence out of contact, and quantiles of F_ad and of the gap."""
    a0, A = 0.2e-9, pixel.amplitude
    low, high = math.log(max(1e-4 * a0, prior.shallowest)), math.log(min(1e4 * a0, 2.0 * A))
    gap = np.exp(np.linspace(low, high, 1501))
    of = columns(pixel.model)
    rows = len(pixel.cons) + len(pixel.diss)
    b, work = np.zeros((gap.size, rows)), np.empty((2, 4))
    for k, D in enumerate(gap):
        adhesion_harmonics(of.contact.tail, A, -0.5 * D / A, a0, 3, work[0], work[1])
        b[k, : len(pixel.cons)] = work[0, list(pixel.cons)]
    b, y = b @ pixel.W.T, pixel.W @ pixel.y
    F = np.linspace(prior.adhesion_low, prior.adhesion_high, 2001)
    prior_F = np.exp(-0.5 * prior.adhesion_precision * (F - prior.adhesion_mean) ** 2)
    prior_F /= np.trapezoid(prior_F, F)
    chi2 = (y @ y) - 2.0 * np.outer(b @ y, F) + np.outer((b * b).sum(axis=1), F**2)
    least = chi2.min()
    weight = np.exp(-0.5 * (chi2 - least)) * prior_F
    weight *= (F[1] - F[0]) * (1.0 / (gap.size - 1))
    log_norm = float(np.log(np.diag(pixel.W)).sum()) - 0.5 * y.size * math.log(2.0 * math.pi)
    evidence = math.log(float(weight.sum())) - 0.5 * least + log_norm
    return (
        evidence,
        weighted_quantiles(F[None], weight),
        weighted_quantiles(np.log(gap), weight.sum(axis=1)),
    )


APART = {
    "far": noisy(1e9, 12e-9, -1.5e-9, 1.0, (0, 1, 2), 31),
    "near": noisy(1e9, 12e-9, -0.2e-9, 1.0, (0, 1, 2, 3), 32),
    "weak": noisy(1e9, 3e-9, -0.5e-9, 3.0, (0, 1, 2), 33),
}


@pytest.mark.parametrize("key", APART)
def test_out_of_contact(key: str) -> None:
    """Evidence of both regimes, and what is known of gap and adhesion where contact is the less likely."""
    pixel = APART[key]
    assert pixel.y[1] > 0.0
    got = ours(pixel, HALF_NORMAL)
    apart, F, gap = apart_by_brute_force(pixel, HALF_NORMAL)
    touching = brute(pixel, HALF_NORMAL).log_evidence
    together = np.logaddexp(apart, touching)
    assert got.summary[EVIDENCE_] == pytest.approx(together + math.log(0.5), abs=0.1)
    assert got.summary[CONTACT_] == pytest.approx(math.exp(touching - together), abs=0.01)
    # the same with another probability of contact
    sure = ours(pixel, HALF_NORMAL._replace(contact=0.99)).summary[CONTACT_]
    odds = math.exp(touching - apart) * 99.0
    assert sure == pytest.approx(odds / (1.0 + odds), abs=0.01)
    assert ours(pixel, HALF_NORMAL._replace(contact=1.0)).summary[CONTACT_] == 1.0
    if got.summary[CONTACT_] < 0.5:
        np.testing.assert_allclose((got.quantiles[ADHESION_] - F) / np.ptp(F), 0.0, atol=0.03)
        mine = np.log(-got.quantiles[INDENTATION_])[::-1]
        np.testing.assert_allclose((mine - gap) / np.ptp(gap), 0.0, atol=0.03)
        assert np.isnan(got.quantiles[MODULUS_]).all()


@pytest.mark.parametrize("key", ["soft, deep", "medium", "stiff"])
def test_errors_that_forces_and_radius_share(key: str) -> None:
    """Against a sum over the shared error itself: at each of its values the posterior, and what R does to E."""
    pixel, exponent, of_radius, alone = PIXELS[key], -0.5, 0.06, 0.04
    # as large as noise along one direction of its own
    change = np.linalg.inv(pixel.W) @ np.random.default_rng(51).normal(size=pixel.y.size) * 1.2
    nodes, weights = np.polynomial.hermite_e.hermegauss(41)
    means, spreads, logs = [], [], []
    for z in nodes:
        # the true calibration is z above the one applied: the forces then are those read plus z changes
        one = ours(pixel._replace(y=pixel.y + z * change), HALF_NORMAL, whole=False)
        means.append(one.summary[MEAN_] + exponent * of_radius * z)
        spreads.append(one.summary[SPREAD_])
        logs.append(one.summary[EVIDENCE_])
    share = weights * np.exp(np.array(logs) - max(logs))
    share /= share.sum()
    mean = float(share @ np.array(means))
    variance = (
        float(share @ (np.array(spreads) ** 2 + (np.array(means) - mean) ** 2)) + (exponent * alone) ** 2
    )
    C = np.linalg.inv(pixel.W.T @ pixel.W) + np.outer(change, change)
    W = np.linalg.inv(np.linalg.cholesky(C))
    along = W @ change * of_radius
    left = exponent**2 * (of_radius**2 + alone**2 - float(along @ along))
    got = ours(pixel._replace(W=W), HALF_NORMAL, pull=-exponent * along, left=left)
    assert got.summary[MEAN_] == pytest.approx(mean, abs=0.03 * math.sqrt(variance))
    assert got.summary[SPREAD_] == pytest.approx(math.sqrt(variance), rel=0.03)
    assert got.quantiles[MODULUS_, 0] < got.summary[MEAN_] < got.quantiles[MODULUS_, 2]
    # and the evidence is that of the wider errors
    total = max(logs) + math.log(
        float(weights @ np.exp(np.array(logs) - max(logs))) / math.sqrt(2.0 * math.pi)
    )
    assert got.summary[EVIDENCE_] == pytest.approx(total, abs=0.1)


def test_what_the_radius_alone_leaves_uncertain_widens_the_modulus_only() -> None:
    pixel = PIXELS["medium, hardly any noise"]
    sharp, wide = ours(pixel, HALF_NORMAL), ours(pixel, HALF_NORMAL, left=0.05**2)
    assert wide.summary[SPREAD_] == pytest.approx(math.hypot(sharp.summary[SPREAD_], 0.05), rel=1e-3)
    width = np.ptp(wide.quantiles[MODULUS_])
    expected = 2.0 * 1.645 * math.hypot(sharp.summary[SPREAD_], 0.05)
    assert width == pytest.approx(expected, rel=0.03)
    np.testing.assert_array_equal(wide.quantiles[ADHESION_], sharp.quantiles[ADHESION_])
    np.testing.assert_array_equal(wide.quantiles[INDENTATION_], sharp.quantiles[INDENTATION_])


def test_a_summary_alone_is_the_same_summary() -> None:
    pixel = PIXELS["medium"]
    whole, short = ours(pixel, HALF_NORMAL), ours(pixel, HALF_NORMAL, whole=False)
    np.testing.assert_array_equal(whole.summary, short.summary)
    assert np.isnan(short.quantiles[MODULUS_]).all()
