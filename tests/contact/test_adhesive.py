"""JKR and Maugis-Dugdale against reference tables, closed limits and quadrature of the law itself."""

import math
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.optimize import brentq

from overtone.contact import terms
from overtone.contact.adhesive import (
    dugdale_range,
    harmonics,
    jkr_curve,
    jkr_force,
    maugis_curve,
    maugis_force,
    maugis_parameter,
)
from overtone.errors import ContactModelError

# E* [Pa], R [m], w [J/m^2]: F_ad of JKR is 4.7 nN
SOFT = {"effective_modulus": 1e9, "radius": 10e-9, "work_of_adhesion": 0.1}
# all of Maugis's units are one
UNITS = {"effective_modulus": 0.75, "radius": 1.0, "work_of_adhesion": 1.0 / math.pi}


def reach(lam: float) -> float:
    """Return the range of attraction of a Maugis parameter, in Maugis's units."""
    return 2.0 / (math.pi * lam)


@pytest.fixture(scope="module")
def tables() -> Path:
    """Return the folder of reference tables beside the repository."""
    folder = Path(__file__).parents[3] / "shared" / "reference" / "jkr"
    if not folder.is_dir():
        pytest.skip("no folder jkr of reference data beside the repository")
    return folder


def jkr_fold(effective_modulus: float, radius: float, work_of_adhesion: float) -> tuple[float, float]:
    """Return contact radius and indentation where the contact of JKR breaks."""
    a = (math.pi * work_of_adhesion * radius**2 / (8.0 * effective_modulus)) ** (1.0 / 3.0)
    return a, -3.0 * a * a / radius


def maugis_point(lam: float, m: float) -> tuple[float, float, float]:
    """Return A, D and P of Maugis 1992 at m = c/a, as he wrote them, by the quadratic in A."""
    t, angle = math.sqrt(m * m - 1.0), math.acos(1.0 / m)
    p, q = 0.5 * lam * (t + (m * m - 2.0) * angle), 4.0 / 3.0 * lam**2 * (t * angle - m + 1.0)
    A = (-q + math.sqrt(q * q + 4.0 * p)) / (2.0 * p)
    return A, A * A - 4.0 / 3.0 * lam * A * t, A**3 - lam * A * A * (t + m * m * angle)


def hertz(amplitude: float, indentation: float, n_max: int, material: dict[str, float]) -> np.ndarray:
    h, dh = np.empty(n_max + 1), np.empty(n_max + 1)
    terms.sphere_harmonics(amplitude, indentation / (2.0 * amplitude), n_max, h, dh)
    return 4.0 / 3.0 * material["effective_modulus"] * math.sqrt(material["radius"]) * h


def by_quadrature(
    law: Callable[..., Any], amplitude: float, indentation: float, levels: tuple[float, ...], n_max: int
) -> np.ndarray:
    """Return the harmonics of a law on the bare cosine, theta from 0 to 2 pi, cut at these indentations.

    Adaptive, with both ends of each piece smoothed by theta = a + s^2.
    """
    edges = {0.0, math.pi, 2.0 * math.pi}
    for level in levels:
        cosine = 1.0 - (indentation - level) / amplitude
        if -1.0 < cosine < 1.0:
            edges |= {math.pi - math.acos(cosine), math.pi + math.acos(cosine)}
    ends = sorted(edges)

    def integral(weight: Callable[[float], float]) -> float:
        total = 0.0
        for a, b in pairwise(ends):
            reach_ = math.sqrt(0.5 * (b - a))
            for start, sign in ((a, 1.0), (b, -1.0)):

                def integrand(s: float, start: float = start, sign: float = sign) -> float:
                    theta = start + sign * s * s
                    x = indentation - amplitude * (1.0 + math.cos(theta))
                    return float(law(x, approaching=theta < math.pi)) * weight(theta) * 2.0 * s

                total += quad(integrand, 0.0, reach_, epsabs=1e-11, epsrel=1e-10, limit=100)[0]
        return total

    out = [integral(lambda theta: 0.5) + 0j]
    for n in range(1, n_max + 1):
        out.append(
            integral(lambda theta, n=n: math.cos(n * theta))
            - 1j * integral(lambda theta, n=n: math.sin(n * theta))
        )
    return np.array(out) / math.pi


def test_jkr_meets_its_reference_table(tables: Path) -> None:
    a, delta, force = (
        np.loadtxt(tables / "jkr_Es1.09GPa_R10nm_Fad20nN.csv", delimiter=",", comments="#").T * 1e-9
    )
    material = {"effective_modulus": 1090512541.0, "radius": 10e-9, "work_of_adhesion": 0.4244131816}
    ours = jkr_curve(a, **material)
    np.testing.assert_allclose(ours, (delta, force), rtol=1e-8)
    stable = a > jkr_fold(**material)[0]
    assert np.count_nonzero(stable) == stable.size - 1  # the first row lies just before the fold
    np.testing.assert_allclose(
        jkr_force(delta, approaching=False, **material)[stable], force[stable], rtol=1e-8
    )


def test_maugis_meets_its_reference_table(tables: Path) -> None:
    lam, A, load, shift = np.loadtxt(tables / "maugis_dimensionless.csv", delimiter=",", comments="#").T
    ours = maugis_curve(A, range_of_attraction=reach(1.0) / lam, **UNITS)
    np.testing.assert_allclose(ours[0], shift, rtol=1e-8, atol=1e-11)
    np.testing.assert_allclose(ours[1], load, rtol=1e-8, atol=1e-11)
    np.testing.assert_allclose(
        maugis_parameter(range_of_attraction=reach(1.0) / lam, **UNITS), lam, rtol=1e-14
    )
    stable = np.ones(lam.shape, dtype=bool)
    for value in np.unique(lam):
        rows = lam == value
        stable[rows] = A[rows] > A[rows][np.argmin(shift[rows])] if value > 0.938 else True
    # the table rounds the indentation to 1e-11, which the stiffness of 6 to 60 carries into the force
    force = maugis_force(
        shift[stable], approaching=False, range_of_attraction=reach(1.0) / lam[stable], **UNITS
    )
    np.testing.assert_allclose(force, load[stable], rtol=1e-8, atol=1e-9)
    assert np.count_nonzero(stable) > 0.9 * stable.size


def test_pull_off_and_jumps_of_jkr() -> None:
    pull = math.pi * SOFT["work_of_adhesion"] * SOFT["radius"]
    a, fold = jkr_fold(**SOFT)
    delta, force = jkr_curve(a * 9.0 ** (1.0 / 3.0), **SOFT)
    assert float(force) == pytest.approx(-1.5 * pull, rel=1e-14, abs=0)
    assert float(jkr_force(delta, approaching=False, **SOFT)) == pytest.approx(-1.5 * pull, rel=1e-14, abs=0)
    along = jkr_force(np.linspace(fold, 5e-9, 2001), approaching=False, **SOFT)
    assert -1.5 * pull * (1.0 + 1e-14) <= along.min() <= -1.4999 * pull
    assert float(jkr_force(0.0, approaching=True, **SOFT)) == pytest.approx(
        -4.0 / 3.0 * pull, rel=1e-14, abs=0
    )
    assert float(jkr_force(-1e-15, approaching=True, **SOFT)) == 0.0
    held = float(jkr_force(fold * (1.0 - 1e-12), approaching=False, **SOFT))
    assert held == pytest.approx(-5.0 / 6.0 * pull, rel=1e-5, abs=0)
    assert float(jkr_force(fold * (1.0 + 1e-12), approaching=False, **SOFT)) == 0.0


def test_pull_off_of_maugis_goes_from_dmt_to_jkr() -> None:
    """In units of pi w R: from 2 down to 3/2."""
    pulls = []
    for lam in (1e-4, 1e-2, 0.1, 0.3, 0.8, 1.0, 2.0, 5.0, 20.0, 1e3):
        delta, _ = maugis_curve(np.geomspace(1e-3, 3.0, 4001), range_of_attraction=reach(lam), **UNITS)
        delta = np.append(delta, -1e-9)
        pulls.append(maugis_force(delta, approaching=False, range_of_attraction=reach(lam), **UNITS).min())
    assert np.all(np.diff(pulls) > 0.0)
    assert pulls[0] == pytest.approx(-2.0, abs=1e-3)
    assert pulls[-1] == pytest.approx(-1.5, abs=1e-3)


@pytest.mark.parametrize(
    ("amplitude", "indentation"),
    [(40e-9, 3e-9), (300e-9, 1e-9), (5e-9, 0.1e-9), (1.2e-9, 1e-9), (1e-6, 1e-12), (20e-9, 39e-9)],
)
def test_energy_lost_by_jkr_is_the_area_of_its_loop(amplitude: float, indentation: float) -> None:
    """The area in closed form: between the fold and zero gap, by z with a = a_s z^2."""
    a, fold = jkr_fold(**SOFT)
    assert indentation - 2.0 * amplitude < fold
    area = math.pi * SOFT["work_of_adhesion"] * a * a * (2.4 * 4.0 ** (1.0 / 3.0) + 0.4)
    root = math.sqrt(-fold)  # the force starts with a root at the fold

    def pull(s: float) -> float:
        return -2.0 * s * float(jkr_force(fold + s * s, approaching=False, **SOFT))

    check = quad(pull, 1e-9 * root, root, epsrel=1e-10, epsabs=0)
    assert check[0] == pytest.approx(area, rel=1e-8, abs=0)
    f = harmonics("jkr", amplitude, indentation, 1, **SOFT)
    assert -math.pi * amplitude * f[1].imag == pytest.approx(area, rel=1e-8, abs=0)


@pytest.mark.parametrize("lam", [0.01, 0.1, 0.5])
def test_energy_lost_by_maugis_without_contact(lam: float) -> None:
    """Where the tip lets go and is caught without contact, the area is a polynomial in the radius."""
    rim = 8.0 * lam / (3.0 * math.pi)
    amplitude = reach(lam) + 10.0
    f = harmonics("maugis", amplitude, 1.0, 1, range_of_attraction=reach(lam), **UNITS)
    area = 17.0 / 24.0 * math.pi * lam * rim**4
    assert -math.pi * amplitude * f[1].imag == pytest.approx(area, rel=1e-8, abs=0)


@pytest.mark.parametrize("lam", [1.0, 2.0, 5.0, 30.0])
def test_energy_lost_by_maugis_from_contact(lam: float) -> None:
    """The area from Maugis's equations in his own variables, on log(m - 1)."""

    def shift(x: float) -> float:
        return maugis_point(lam, 1.0 + math.exp(x))[1]

    def slope(x: float, h: float = 1e-3) -> float:  # sixth order
        d = [shift(x + k * h) - shift(x - k * h) for k in (1, 2, 3)]
        return (45.0 * d[0] - 9.0 * d[1] + d[2]) / (60.0 * h)

    start = -2.0 * math.log(lam) - 4.0
    end = start
    while slope(end) < 0.0:
        end += 0.25
    last = brentq(slope, end - 0.25, end, xtol=1e-13)
    caught = brentq(lambda x: shift(x) + reach(lam), start, last, xtol=1e-14)
    area = quad(
        lambda x: maugis_point(lam, 1.0 + math.exp(x))[2] * slope(x), caught, last, epsrel=1e-11, epsabs=0
    )
    amplitude = 20.0
    f = harmonics("maugis", amplitude, 2.0, 1, range_of_attraction=reach(lam), **UNITS)
    assert -math.pi * amplitude * f[1].imag == pytest.approx(area[0], rel=1e-8, abs=0)


def test_without_adhesion_the_harmonics_are_those_of_hertz() -> None:
    bare = {**SOFT, "work_of_adhesion": 0.0}
    for amplitude, indentation in ((40e-9, 2e-9), (40e-9, 60e-9), (5e-9, 1e-12)):
        expected = hertz(amplitude, indentation, 6, SOFT)
        for law, extra in (("jkr", {}), ("maugis", {"range_of_attraction": 0.2e-9})):
            f = harmonics(law, amplitude, indentation, 6, **bare, **extra)
            assert abs(f - expected).max() <= 1e-10 * abs(expected).max()
    expected = hertz(40e-9, 2e-9, 6, SOFT)
    for law, extra in (("jkr", {}), ("maugis", {"range_of_attraction": 0.2e-9})):
        previous = math.inf
        for work in (1e-3, 1e-4, 1e-5, 1e-6, 1e-7, 1e-12):
            f = harmonics(law, 40e-9, 2e-9, 6, **{**SOFT, "work_of_adhesion": work}, **extra)
            error = abs(f - expected).max() / abs(expected).max()
            assert error < 0.4 * previous
            previous = error
        assert previous < 1e-5


def test_maugis_with_a_long_weak_attraction_is_dmt_with_a_linear_tail() -> None:
    """The tail of eq 17 with 2 a0 = h0 and F_ad = 2 pi w R: errors shrink as lambda does, of a force as its root."""
    previous = math.inf
    for lam in (0.4, 0.2, 0.1, 0.05, 0.025, 1e-3):
        h, dh = np.empty(7), np.empty(7)
        amplitude, indentation = 2.0 * reach(lam), 1.0
        terms.linear_adhesion_harmonics(
            amplitude, indentation / (2.0 * amplitude), 0.5 * reach(lam), 6, h, dh
        )
        expected = 2.0 * h + hertz(amplitude, indentation, 6, UNITS)
        f = harmonics("maugis", amplitude, indentation, 6, range_of_attraction=reach(lam), **UNITS)
        error = abs(f - expected).max() / abs(expected).max()
        assert error < 0.65 * previous
        previous = error
    assert previous < 3e-3
    x = np.array([0.5, 2.0, 10.0])
    force = maugis_force(x, approaching=True, range_of_attraction=reach(1e-6), **UNITS)
    np.testing.assert_allclose(force, x**1.5 - 2.0, atol=1e-2)


def test_maugis_with_a_short_strong_attraction_is_jkr() -> None:
    expected = harmonics("jkr", 20.0, 1.0, 6, **UNITS)
    x = np.array([-1.0, -0.5, 0.5, 4.0])
    branch = jkr_force(x[1:], approaching=False, **UNITS)
    previous, previous_force = math.inf, math.inf
    for lam in (5.0, 20.0, 80.0, 320.0, 1280.0):
        f = harmonics("maugis", 20.0, 1.0, 6, range_of_attraction=reach(lam), **UNITS)
        force = maugis_force(x, approaching=False, range_of_attraction=reach(lam), **UNITS)
        assert force[0] == 0.0
        errors = abs(f - expected).max() / abs(expected).max(), abs(force[1:] - branch).max()
        assert errors[0] < 0.3 * previous
        assert errors[1] < 0.3 * previous_force
        previous, previous_force = errors
    assert previous < 3e-4


@pytest.mark.parametrize(
    ("amplitude", "indentation"),
    [
        (30.0, 1.0),  # caught and let go
        (1.0, 1.6),  # let go early in the upper half of the cycle
        (1.0, 1.2),  # a neck all the time, Delta < 1
        (1.0, 3.0),  # contact all the time, Delta > 1
    ],
)
def test_jkr_harmonics_against_quadrature_of_the_law(amplitude: float, indentation: float) -> None:
    fold = jkr_fold(**UNITS)[1]
    held = indentation - 2.0 * amplitude >= fold

    def law(x: float, approaching: bool) -> Any:
        return jkr_force(x, approaching=approaching and not held, **UNITS)

    expected = by_quadrature(law, amplitude, indentation, (fold, 0.0), 3)
    f = harmonics("jkr", amplitude, indentation, 3, **UNITS)
    assert abs(f - expected).max() <= 1e-8 * abs(expected).max()
    assert (abs(f.imag).max() == 0.0) == held


@pytest.mark.parametrize("lam", [0.2, 0.9, 0.94, 3.0])
def test_maugis_harmonics_against_quadrature_of_the_law(lam: float) -> None:
    h0 = reach(lam)

    def law(x: float, approaching: bool) -> Any:
        return maugis_force(x, approaching=approaching, range_of_attraction=h0, **UNITS)

    # folds and first contacts, located here anew; contact has no fold of its own below 0.938
    rim = 8.0 * lam / (3.0 * math.pi)
    levels = [-h0, -h0 - 0.5 * rim * rim, float(maugis_curve(0.0, range_of_attraction=h0, **UNITS)[0])]
    if lam > 0.938:
        a = np.geomspace(1e-4, 1.0, 200_001)
        levels[1:] = [float(maugis_curve(a, range_of_attraction=h0, **UNITS)[0].min()) - 1e-12]
    for amplitude, indentation in ((10.0 + h0, 0.7), (8.0, -0.3 * h0)):
        if indentation - 2.0 * amplitude > levels[1]:
            continue
        expected = by_quadrature(law, amplitude, indentation, tuple(levels), 2)
        f = harmonics("maugis", amplitude, indentation, 2, range_of_attraction=h0, **UNITS)
        assert abs(f - expected).max() <= 1e-8 * abs(expected).max()


def test_contact_begins_smoothly() -> None:
    """Force and stiffness of the loaded disc and of Maugis's contact meet at a = 0."""
    for lam in (0.05, 0.3, 0.8):
        onset = float(maugis_curve(0.0, range_of_attraction=reach(lam), **UNITS)[0])
        previous = math.inf
        for h in (1e-4, 1e-6, 1e-8):  # the stiffness goes on as the root of the distance: a tenth each
            x = onset + h * np.array([-2.0, -1.0, -1e-6, 1e-6, 1.0, 2.0])
            force = maugis_force(x, approaching=False, range_of_attraction=reach(lam), **UNITS)
            assert abs(force[3] - force[2]) < 1e-4 * h
            mismatch = abs((force[5] - force[4]) / (force[1] - force[0]) - 1.0)
            assert mismatch < 0.15 * previous
            previous = mismatch


def test_contact_breaks_from_contact_above_lambda_0_938() -> None:
    """Below, the stable branch goes on without contact: the fold then lies where the disc folds."""
    for lam, from_contact in ((0.93, False), (0.937, False), (0.939, True), (1.0, True)):
        a = np.array([0.0, 1e-3])
        delta, _ = maugis_curve(a, range_of_attraction=reach(lam), **UNITS)
        assert (delta[1] < delta[0]) == from_contact


def test_three_kinds_of_motion() -> None:
    h0 = 1e-9
    fold = jkr_fold(**SOFT)[1]
    assert not harmonics("jkr", 40e-9, [-1e-9, 0.0], 3, **SOFT).any()
    assert not harmonics("maugis", 40e-9, [-5e-9, -h0], 3, range_of_attraction=h0, **SOFT).any()
    caught = harmonics("maugis", 40e-9, -0.99 * h0, 3, range_of_attraction=h0, **SOFT)
    assert caught[0].real < 0.0
    assert caught[1].imag < 0.0  # DISS_1 > 0: energy is lost
    # a neck holds to the fold: no loss although the undeformed surfaces part
    for top in (10e-9 + 0.99 * fold, 10e-9, 30e-9):
        held = harmonics("jkr", 5e-9, top, 3, **SOFT)
        assert not held.imag.any()
        assert abs(held.real).min() > 0.0
    assert harmonics("jkr", 5e-9, 10e-9 + 1.01 * fold, 3, **SOFT)[1].imag < 0.0


def test_harmonics_are_continuous_in_the_indentation() -> None:
    """Across the first contact (Maugis) and through ordinary motions: a small step changes little."""
    lam = 0.3
    onset = float(maugis_curve(0.0, range_of_attraction=reach(lam), **UNITS)[0])
    for top in (onset, 0.0, 1.0):
        f = harmonics(
            "maugis", 10.0, np.array([-1e-7, 0.0, 1e-7]) + top, 4, range_of_attraction=reach(lam), **UNITS
        )
        steps = np.diff(f, axis=0)
        assert abs(steps).max() < 1e-6 * abs(f).max()
        assert abs(steps[1] - steps[0]).max() < 1e-2 * abs(steps).max()


def test_tabor_parameter_and_maugis_parameter() -> None:
    """With sigma0 of Lennard-Jones surfaces lambda is 1.1570 mu."""
    z0 = 0.3e-9
    E, R, w = SOFT.values()
    mu = (R * w * w / (E * E * z0**3)) ** (1.0 / 3.0)
    lam = maugis_parameter(range_of_attraction=dugdale_range(z0), **SOFT)
    assert float(lam) / mu == pytest.approx(1.1570, abs=5e-5)
    # the steepest point of a Lennard-Jones attraction, w = 1 and z0 = 1: 8/3 (z^-3 - z^-9)
    z = np.linspace(1.0, 1.5, 200_001)
    assert 1.0 / float(dugdale_range(1.0)) == pytest.approx(
        (8.0 / 3.0 * (z**-3 - z**-9)).max(), rel=1e-9, abs=0
    )


def test_arguments_broadcast() -> None:
    moduli = np.array([[1e8], [1e9]])
    f = harmonics(
        "maugis",
        40e-9,
        [1e-9, 2e-9, 3e-9],
        5,
        effective_modulus=moduli,
        radius=10e-9,
        work_of_adhesion=[0.0, 0.05, 0.1],
        range_of_attraction=0.3e-9,
    )
    assert f.shape == (2, 3, 6)
    single = harmonics("maugis", 40e-9, 3e-9, 5, range_of_attraction=0.3e-9, **SOFT)
    np.testing.assert_array_equal(f[1, 2], single)
    force = jkr_force(
        [[0.0], [-0.5e-9]],
        effective_modulus=1e9,
        radius=10e-9,
        work_of_adhesion=0.1,
        approaching=[True, False],
    )
    assert force.shape == (2, 2)
    assert force[1, 0] == 0.0
    assert force[0, 0] == force[0, 1]
    assert maugis_curve([0.0, 1e-9, 2e-9], range_of_attraction=1e-9, **SOFT)[0].shape == (3,)
    assert harmonics("jkr", 40e-9, np.empty((0, 2)), 3, **SOFT).shape == (0, 2, 4)


@pytest.mark.parametrize(
    ("call", "word"),
    [
        (lambda: harmonics("dmt", 1e-8, 1e-9, 3, **SOFT), "unknown adhesive law"),
        (lambda: harmonics("jkr", 0.0, 1e-9, 3, **SOFT), "amplitude is out of range"),
        (lambda: harmonics("jkr", 1e-8, math.nan, 3, **SOFT), "indentation is out of range"),
        (lambda: harmonics("jkr", 1e-8, 1e-9, -1, **SOFT), "n_max"),
        (lambda: harmonics("jkr", 1e-8, 1e-9, 2.0, **SOFT), "n_max"),  # type: ignore[arg-type]
        (lambda: harmonics("maugis", 1e-8, 1e-9, 3, **SOFT), "range_of_attraction"),
        (lambda: harmonics("jkr", 1e-8, 1e-9, 3, range_of_attraction=1e-9, **SOFT), "do not fit law 'jkr'"),
        (lambda: harmonics("jkr", [1e-8] * 3, [1e-9] * 2, 3, **SOFT), "shapes do not fit"),
        (lambda: jkr_force(0.0, approaching=1, **SOFT), "approaching"),
        (
            lambda: jkr_force(0.0, approaching=True, **{**SOFT, "effective_modulus": 0.0}),
            "effective_modulus is",
        ),
        (lambda: jkr_force(0.0, approaching=True, **{**SOFT, "radius": -1e-9}), "radius is out of range"),
        (lambda: jkr_force(0.0, approaching=True, **{**SOFT, "work_of_adhesion": -0.1}), "work_of_adhesion"),
        (
            lambda: maugis_force(0.0, approaching=True, range_of_attraction=0.0, **SOFT),
            "range_of_attraction is",
        ),
        (lambda: jkr_curve(-1e-9, **SOFT), "contact_radius"),
        (
            lambda: maugis_curve(1e-9, range_of_attraction=1e-9, **{**SOFT, "work_of_adhesion": 0.0}),
            "work_of_adhesion",
        ),
        (lambda: dugdale_range(0.0), "intermolecular_distance"),
    ],
)
def test_wrong_arguments_are_named(call: Callable[[], object], word: str) -> None:
    with pytest.raises(ContactModelError, match=word):
        call()
