"""The joint fit of an approach curve, and the search it uses: known truths, and the covariance against refits."""

import math

import numpy as np
import pytest

from overtone.contact.sample import Sample
from overtone.dynamics.hold import hold_amplitude
from overtone.errors import CalibrationError
from overtone.instrument.approach_fit import Curve, Fit, Reference, fit_approach
from overtone.instrument.latent import Problem, search
from overtone.instrument.material import STARTS, Scale, scale_of
from overtone.instrument.signals import Signals, signals_of
from overtone.instrument.unknowns import NEUTRAL
from overtone.probe import Probe

NAMES = ("gain0", "gain2", "latency2", "stiffness")
WIDTHS = np.array([0.1, 0.3, 0.5, 0.05])
NOISE = {"A0": 2e-12, "A1": 20e-12, "phi1": 3e-4, "A2": 2e-12, "height": 0.1e-9}


def observed(
    probe: Probe, material: Sample, *, gain0: float = 1.0, gain2: float = 1.0, latency2: float = 0.0
) -> Curve:
    """Return a noise-free curve behind plain electronics, its heights 300 nm off."""
    held = hold_amplitude(probe, material, setpoint=np.linspace(0.25, 0.9, 14), n_max=6, keep=2)
    clean = signals_of(held[["A0", "A1", "phi1", "A2", "phi2"]])
    assert clean.mean is not None
    second = clean.phasor[2] * gain2 * np.exp(-1j * latency2)
    return Curve(
        Signals(clean.mean * gain0, {1: clean.phasor[1], 2: second}), held["Z"].values + 300e-9, NOISE
    )


def fitted(curve: Curve, probe: Probe, reference: Reference, latency2: float = 0.0) -> Fit:
    neutral = {**NEUTRAL, "latency2": latency2}
    return fit_approach(
        curve,
        probe,
        reference,
        amplitude=probe.drive.free_amplitude,
        names=NAMES,
        mean=np.array([neutral[name] for name in NAMES]),
        covariance=np.diag(WIDTHS**2),
        neutral=neutral,
    )


@pytest.fixture(scope="module")
def fit(lever: Probe, soft: Sample) -> Fit:
    curve = observed(lever, soft, gain0=1.04, gain2=0.85, latency2=0.2)
    return fitted(curve, lever, Reference(0.35, modulus=93.78e6, modulus_error=0.05), latency2=0.15)


def test_gains_latency_material_and_zero_come_out(fit: Fit, lever: Probe, soft: Sample) -> None:
    value = dict(zip(fit.names, fit.values, strict=True))
    assert fit.converged
    assert value["gain0"] == pytest.approx(1.04, rel=2e-3)
    assert value["gain2"] == pytest.approx(0.85, rel=2e-3)
    assert value["latency2"] == pytest.approx(0.2, rel=5e-3)
    assert value["stiffness"] == pytest.approx(1.0, rel=5e-3)
    assert math.exp(fit.material["modulus"][0]) == pytest.approx(93.78e6, rel=0.01)
    assert math.exp(fit.material["adhesion"][0]) == pytest.approx(16.24e-9, rel=0.01)
    assert fit.zero == pytest.approx(300e-9, rel=1e-3)
    held = hold_amplitude(lever, soft, setpoint=np.linspace(0.25, 0.9, 14), n_max=6, keep=2)
    assert fit.indentation == pytest.approx(held["indentation"].values, rel=5e-3)
    assert fit.predicted["A0"] == pytest.approx(held["A0"].values, rel=5e-3)
    assert fit.chi2 < 0.2


def test_the_freedom_counts_the_data(fit: Fit) -> None:
    """CONS_1, A0, both quadratures of A2 and the height at 14 points; latent depths, two of the material, a zero."""
    assert fit.freedom == 5 * 14 - 14 - 2 - 1


def test_the_covariance_is_that_of_refits(lever: Probe, soft: Sample) -> None:
    """Over noisy copies of one curve the estimates scatter as the part of the covariance that noise makes."""
    clean = observed(lever, soft)
    reference = Reference(0.35, modulus=93.78e6, modulus_error=0.05)
    g = np.random.default_rng(8)
    values, chi2 = [], []
    for _ in range(8):
        assert clean.signals.mean is not None
        shape = clean.height.shape
        first = clean.signals.phasor[1]
        lag, swing = (g.normal(0.0, NOISE[name], shape) for name in ("phi1", "A1"))
        turned = first * np.exp(-1j * lag) * (1.0 + swing / np.abs(first))
        # harmonics are noisy in the frame of the first one
        second = clean.signals.phasor[2] * (turned / np.abs(turned) / first * np.abs(first)) ** 2
        second = second + g.normal(0, NOISE["A2"], shape) + 1j * g.normal(0, NOISE["A2"], shape)
        noisy = Curve(
            Signals(clean.signals.mean + g.normal(0, NOISE["A0"], shape), {1: turned, 2: second}),
            clean.height + g.normal(0, NOISE["height"], shape),
            NOISE,
        )
        result = fitted(noisy, lever, reference)
        values.append(result.values)
        chi2.append(result.chi2 / result.freedom)
    spread = np.std(values, axis=0, ddof=1)
    sigma = np.sqrt(np.diag(result.covariance))
    latency = NAMES.index("latency2")  # known from nothing but the noise
    assert spread[latency] == pytest.approx(sigma[latency], rel=0.5)
    assert (spread < 1.3 * sigma).all()
    assert np.mean(chi2) == pytest.approx(1.0, abs=0.25)


def test_an_adhesion_too_small_to_be_seen_does_not_pull_at_the_modulus(lever: Probe, stiff: Sample) -> None:
    """With a prior even in the logarithm, a flat likelihood drew the modulus of 1.93 GPa down by 21 %."""
    result = fitted(observed(lever, stiff), lever, Reference(0.35))
    modulus, error = result.material["modulus"]
    assert abs(modulus - math.log(1.93e9)) < 0.3 * error
    assert error < 0.8
    assert result.converged


def test_without_a_stated_modulus_the_gains_share_its_error(lever: Probe, stiff: Sample) -> None:
    curve = observed(lever, stiff)
    known, unknown = (
        fitted(curve, lever, reference)
        for reference in (Reference(0.35, modulus=1.93e9, modulus_error=0.01), Reference(0.35))
    )
    gain2 = NAMES.index("gain2")
    wider = math.sqrt(unknown.covariance[gain2, gain2] / known.covariance[gain2, gain2])
    assert wider > 1.15
    assert unknown.material["modulus"][1] > 10.0 * known.material["modulus"][1]


def test_a_stated_property_is_a_prior(lever: Probe, soft: Sample) -> None:
    """A modulus stated 30 % too high to 1 % is believed; the gains then pay for it."""
    wrong = fitted(observed(lever, soft), lever, Reference(0.35, modulus=1.3 * 93.78e6, modulus_error=0.01))
    assert wrong.material["modulus"][0] == pytest.approx(math.log(1.3 * 93.78e6), abs=0.05)
    assert abs(dict(zip(wrong.names, wrong.values, strict=True))["stiffness"] - 1.0) > 0.02


@pytest.mark.parametrize("model", ["thin-layer", "kelvin-voigt", "power", "sls", "maugis"])
def test_models_that_no_curve_tells_are_named(lever: Probe, soft: Sample, model: str) -> None:
    with pytest.raises(CalibrationError, match=rf"model '{model}' is not for references"):
        fitted(observed(lever, soft), lever, Reference(0.35, model=model))


# --- how properties are searched ------------------------------------------------------------------


def test_scales_go_there_and_back() -> None:
    for scale in (Scale(math.log(1e9), 3.0), Scale(0.0, 20.0, 2e-9)):
        for value in (1e-10, 3e-9, 50e-9):
            assert scale.value(scale.at(value)) == pytest.approx(value, rel=1e-4)
    even = Scale(0.0, 20.0, 2e-9)
    assert even.value(even.at(20e-9) + 0.05) - 20e-9 == pytest.approx(0.05 * 20 * 2e-9, rel=1e-3)
    assert 0.0 < even.value(-1e3) < 1e-12  # never below zero
    known = scale_of(Reference(0.3, modulus=2e9, modulus_error=0.2), "modulus")
    assert known.value(1.0) == pytest.approx(2e9 * math.exp(0.2))
    assert set(STARTS) == {"modulus", "adhesion", "viscosity"}


# --- the search -----------------------------------------------------------------------------------


def valley(points: int = 6) -> Problem:
    """Return a bent valley: latent numbers follow a power of the shared one, as depths follow a modulus."""
    x = np.linspace(1.0, 2.0, points)

    def residuals(p: np.ndarray) -> np.ndarray:
        shared, latent = p[0], p[1:]
        one = 200.0 * (latent - x * np.exp(shared))
        other = latent - 3.0 * x
        return np.concatenate([one, other, [0.01 * shared]])

    def jacobian(p: np.ndarray) -> np.ndarray:
        J, here = np.zeros((2 * points + 1, p.size)), residuals(p)
        for k in range(p.size):
            moved = p.copy()
            moved[k] += 1e-6
            J[:, k] = (residuals(moved) - here) / 1e-6
        return J

    return Problem(residuals, jacobian, points, 1, 1, 1e-6)


def test_a_bent_valley_is_walked_in_few_steps() -> None:
    found = search(valley(), np.concatenate([[-2.0], np.full(6, 0.1)]), 12)
    assert found.converged
    assert found.p[0] == pytest.approx(math.log(3.0), abs=0.02)
    assert found.cost < 0.01  # of 4e5 at the start


def test_a_search_that_is_cut_short_says_so() -> None:
    assert not search(valley(), np.concatenate([[-4.0], np.full(6, 0.1)]), 1).converged
