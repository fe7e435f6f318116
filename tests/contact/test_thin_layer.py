"""The series for a thin layer against the full contact problem, solved without any of its derivation.

The layer's response comes from the equations of elasticity through the thickness (matrix exponential), the
contact from collocation of the pressure: no closed-form kernel, no Abel transform, no expansion in a/h.
"""

import math
import re
from functools import cache
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
from scipy.integrate import quad
from scipy.linalg import expm
from scipy.optimize import brentq
from scipy.special import gamma, hyp2f1, j0, jv

from overtone.contact.thin_layer import layer_coefficients, layer_integrals
from overtone.errors import ContactModelError

Array = npt.NDArray[np.float64]

RATIOS = (0.0, 0.3, 0.49, 0.5)
_nodes, _weights = np.polynomial.legendre.leggauss(72)
X, DX = 11.0 * (_nodes + 1.0), 11.0 * _weights
TERMS = 12
ORDER = np.arange(TERMS)[:, None]
R_POINTS = np.cos(np.pi * (np.arange(2 * TERMS) + 0.5) / (4 * TERMS))
# Displacement of a half-space under (1 - r^2)^(k + 1/2), the integral of Weber and Schafheitlin.
HALF_SPACE = (
    gamma(ORDER + 1.5)
    * math.sqrt(math.pi)
    / (2.0 * gamma(ORDER + 2.0))
    * hyp2f1(0.5, -(ORDER + 1.0), 1.0, R_POINTS**2)
)


def layer_response(x: Array, nu: float) -> Array:
    """Return L(x), the sinking of a bonded layer per that of a half-space, from the equations of elasticity.

    State (u_r, u_z, sigma_rz / (G k), sigma_zz / (G k)) in Hankel space against k z, from the base, where both
    displacements vanish, to the surface, where the shear stress does: d state / d(k z) = rate state.
    """
    plane = 1.0 / (1.0 - nu)
    rate = np.array(
        [
            [0.0, 1.0, 1.0, 0.0],
            [-nu * plane, 0.0, 0.0, 0.5 * (1.0 - 2.0 * nu) * plane],
            [2.0 * plane, 0.0, 0.0, nu * plane],
            [0.0, 0.0, -1.0, 0.0],
        ]
    )
    step = expm(rate * x[:, None, None] / 32.0)
    through = np.linalg.matrix_power(step, 32)
    load = np.broadcast_to([[0.0], [1.0]], (x.size, 2, 1))
    surface = through[:, :2, 2:] @ np.linalg.solve(through[:, 2:, 2:], load)
    return np.asarray(surface[:, 1, 0] * plane)


@cache
def missing(nu: float) -> Array:
    return 1.0 - layer_response(X, nu)


def contact(e: float, nu: float) -> tuple[float, float]:
    """Return R delta/a^2 and F R/(E* a^3) of a paraboloid in contact over the radius a = e h.

    The pressure is a sum of (1 - r^2/a^2)^(k + 1/2), so that it vanishes at the edge; the surface follows
    the paraboloid at the collocation points.
    """
    z = e * X
    pressure = 2.0 ** (ORDER + 0.5) * gamma(ORDER + 1.5) * jv(ORDER + 1.5, z) / z ** (ORDER + 1.5)
    layer = e * (pressure * missing(nu) * DX) @ j0(z[:, None] * R_POINTS)
    system = np.column_stack([2.0 * (HALF_SPACE - layer).T, -np.ones(R_POINTS.size)])
    solution, *_ = np.linalg.lstsq(system, -0.5 * R_POINTS**2, rcond=None)
    assert np.abs(system @ solution + 0.5 * R_POINTS**2).max() < 1e-10
    force = 2.0 * np.pi * float(np.sum(solution[:TERMS] / (2.0 * ORDER[:, 0] + 3.0)))
    return float(solution[TERMS]), force


@cache
def force_per_hertz(chi: float, nu: float) -> float:
    """Return the force at chi = sqrt(R delta)/h per the force of Hertz at the same indentation."""
    e = brentq(lambda e: e * math.sqrt(contact(e, nu)[0]) - chi, chi, 1.6 * chi, xtol=1e-15, rtol=1e-14)
    indentation, force = contact(e, nu)
    return float(force / (4.0 / 3.0 * indentation**1.5))


def by_fredholm(e: float, nu: float) -> tuple[float, float]:
    """Return what `contact` returns, from Fredholm's equation on Gauss-Legendre points."""
    roots, weights = np.polynomial.legendre.leggauss(24)
    t, dt = 0.5 * (roots + 1.0), 0.5 * weights
    cosines = np.cos(e * np.outer(np.append(t, 1.0), X))
    kernel = 2.0 / math.pi * e * (cosines * missing(nu) * DX) @ cosines[:-1].T * dt
    height, shape = np.linalg.solve(np.eye(t.size) - kernel[:-1], np.column_stack([np.ones_like(t), t**2])).T
    indentation = (1.0 + kernel[-1] @ shape) / (1.0 + kernel[-1] @ height)  # no pressure at the edge
    return float(indentation), 2.0 * float(np.sum(dt * (indentation * height - shape)))


def series_error(chi: float, nu: float) -> float:
    series = sum(c * chi**k for k, c in enumerate(layer_coefficients(nu)))
    return series / force_per_hertz(chi, nu) - 1.0


def fourth_moment(nu: float) -> float:
    return float(np.sum(DX * X**4 * missing(nu)))


@pytest.mark.parametrize("nu", [-0.9, *RATIOS])
def test_the_integrals_are_moments_of_the_response_of_the_layer(nu: float) -> None:
    alpha0, beta0 = layer_integrals(nu)
    response = missing(nu)
    assert alpha0 == pytest.approx(-np.sum(DX * response), rel=1e-11, abs=0)
    # rounding of 1 - L weighs more at large x
    assert beta0 == pytest.approx(0.25 * np.sum(DX * X**2 * response), rel=1e-9, abs=0)


@pytest.mark.parametrize("nu", [-0.99, *RATIOS])
def test_the_integrals_by_adaptive_quadrature_of_the_textbook_response(nu: float) -> None:
    kappa = 3.0 - 4.0 * nu

    def rest(x: float) -> float:
        top = 2.0 * kappa * math.sinh(2.0 * x) - 4.0 * x
        return 1.0 - top / (2.0 * kappa * math.cosh(2.0 * x) + 4.0 * x**2 + 1.0 + kappa**2)

    def moment(power: int) -> float:
        return float(quad(lambda x: x**power * rest(x), 0.0, 22.0, epsabs=1e-12, epsrel=1e-11)[0])

    assert layer_integrals(nu) == pytest.approx((-moment(0), 0.25 * moment(2)), rel=1e-11, abs=0)


def test_a_thick_layer_is_a_half_space_and_a_compressed_one_is_confined() -> None:
    indentation, force = contact(1e-9, 0.3)
    assert indentation == pytest.approx(1.0, rel=1e-8, abs=0)
    assert force == pytest.approx(4.0 / 3.0, rel=1e-8, abs=0)
    assert force_per_hertz(1e-7, 0.3) == pytest.approx(1.0, abs=1e-6)
    assert layer_coefficients(0.3)[0] == 1.0
    nu, x = 0.3, np.array([1e-4])
    # long waves: the modulus of uniaxial strain, u = p h / M
    confined = x * (1.0 - 2.0 * nu) / (2.0 * (1.0 - nu) ** 2)
    np.testing.assert_allclose(layer_response(x, nu), confined, rtol=1e-6)


@pytest.mark.parametrize("e", [0.05, 0.5, 1.5])
def test_two_solutions_of_the_contact_agree(e: float) -> None:
    assert contact(e, 0.3) == pytest.approx(by_fredholm(e, 0.3), rel=1e-11, abs=0)
    assert contact(e, 0.5) == pytest.approx(by_fredholm(e, 0.5), rel=1e-11, abs=0)


@pytest.mark.parametrize("nu", RATIOS)
def test_the_error_of_the_series_falls_with_the_fifth_power_of_chi(nu: float) -> None:
    """What is left over chi^5 tends to minus the next coefficient, which is known from the derivation."""
    alpha0, beta0 = layer_integrals(nu)
    pi2 = math.pi**2
    next_coefficient = (
        -2.0
        / (2835.0 * math.pi**5)
        * (125440.0 * alpha0**5 + 80640.0 * pi2 * alpha0**2 * beta0 - 81.0 * pi2**2 * fourth_moment(nu))
    )
    left = {}
    for chi in (0.2, 0.1, 0.05, 0.025):
        left[chi] = series_error(chi, nu) * force_per_hertz(chi, nu) / chi**5 + next_coefficient
    # The rest is of first order in chi: it halves with chi.
    assert abs(left[0.1]) < 0.75 * abs(left[0.2])
    assert abs(left[0.05]) < 0.6 * abs(left[0.1])
    assert abs(left[0.025]) < 0.55 * abs(left[0.05])
    assert abs(left[0.025]) < 0.05


@pytest.mark.parametrize("nu", [0.0, 0.3])
def test_the_error_falls_32_times_when_chi_is_halved(nu: float) -> None:
    """At 0.49 and 0.5 the coefficient of chi^5 nearly vanishes, and the error falls faster at first."""
    for chi in (0.1, 0.05):
        assert series_error(chi, nu) / series_error(chi / 2.0, nu) == pytest.approx(32.0, rel=0.06, abs=0)


@pytest.mark.parametrize("nu", [*RATIOS, 0.2, 0.43])
def test_the_stated_range_of_validity(nu: float) -> None:
    assert all(0.0 < series_error(chi, nu) < 0.01 for chi in (0.2, 0.45))
    assert all(0.005 < series_error(chi, nu) < 0.05 for chi in (0.55, 0.65))
    assert 0.09 < series_error(1.0, nu) < 0.23


def test_the_page_has_the_measured_errors() -> None:
    text = (Path(__file__).parents[2] / "docs/thin-layer.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| ([\d.]+) \| (\S+e-\d+) \| (\S+) \| (\S+) \| (\S+) \|$", text, re.M)
    assert len(rows) == 8
    for chi, *errors in rows:
        for nu, error in zip(RATIOS, errors, strict=True):
            assert series_error(float(chi), nu) == pytest.approx(float(error), rel=0.04, abs=0)


def published_fits(nu: float) -> tuple[float, float]:
    alpha0 = -(1.2876 - 1.4678 * nu + 1.3442 * nu**2) / (1.0 - nu)
    return alpha0, (0.6387 - 1.0277 * nu + 1.5164 * nu**2) / (1.0 - nu)


@pytest.mark.parametrize(("nu", "alpha_error", "beta_error"), [(0.0, 0.063, 0.360), (0.5, 0.0052, 0.0523)])
def test_the_published_fits_miss_the_integrals(nu: float, alpha_error: float, beta_error: float) -> None:
    (alpha_fit, beta_fit), (alpha0, beta0) = published_fits(nu), layer_integrals(nu)
    assert alpha_fit / alpha0 - 1.0 == pytest.approx(alpha_error, rel=0.02, abs=0)
    assert beta_fit / beta0 - 1.0 == pytest.approx(beta_error, rel=0.02, abs=0)


def coefficients_of_held_radius(alpha0: float, beta0: float, slope: float) -> Array:
    """Return c0 to c4 where the contact radius is held at sqrt(R delta) (1 + slope chi).

    Moments M0 and M2 of the pressure's transform solve two linear equations; the force is 3/2 M0 of Hertz.
    """
    chis = 0.04 * np.cos(np.pi * (np.arange(9) + 0.5) / 9)
    forces = []
    for chi in chis:
        y = 1.0 + slope * chi
        first, third = -2.0 * alpha0 * chi / math.pi, 4.0 * beta0 * chi**3 / math.pi
        system = np.eye(2) - np.array(
            [
                [first * y - third * y**3 / 3.0, -third * y],
                [first * y**3 / 3.0 - third * y**5 / 5.0, -third * y**3 / 3.0],
            ]
        )
        forces.append(1.5 * np.linalg.solve(system, [y - y**3 / 3.0, y**3 / 3.0 - y**5 / 5.0])[0])
    return np.polynomial.polynomial.polyfit(chis, forces, 8)[:5]


def test_where_the_published_coefficients_come_from() -> None:
    """Both sources at nu = 0.5, to their last printed digit but for one lost sign."""
    alpha0, beta0 = published_fits(0.5)
    dimitriadis = coefficients_of_held_radius(alpha0, beta0, slope=0.0)
    np.testing.assert_allclose(dimitriadis, [1.0, 1.133, 1.283, 0.769, -0.0975], atol=5e-4)
    garcia = coefficients_of_held_radius(alpha0, beta0, slope=-2.0 * alpha0 / (3.0 * math.pi))
    np.testing.assert_allclose(garcia, [1.0, 1.133, 1.497, 1.469, 0.755], atol=6e-4)
    exact = layer_coefficients(0.5)
    for wrong in (dimitriadis, np.array([1.0, 1.133, 1.283, 0.769, 0.0975])):
        assert exact[2] - wrong[2] > 0.19
    assert exact[4] - garcia[4] > 0.2


@pytest.mark.parametrize("nu", [-1.0, 0.51, math.nan, math.inf])
def test_impossible_poisson_ratios_are_refused(nu: float) -> None:
    with pytest.raises(ContactModelError, match=r"Poisson's ratio is out of range: expected -1 < nu <= 0.5"):
        layer_coefficients(nu)
