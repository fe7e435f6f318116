"""Harmonics of every model against quadrature of its own force law over a full period of the motion."""

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

import overtone as ot
from overtone.contact import terms
from overtone.contact.models import ContactModel, contact_model, models
from overtone.errors import ContactModelError

N_MAX = 6
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(80)
BY_QUADRATURE = ("sls", "jkr", "maugis")
CLOSED = [model.key for model in models() if model.key not in BY_QUADRATURE]

# Away from every number the paper uses: off resonance nothing changes here, the frequency only enters loss.
VALUES: dict[str, Any] = {
    "modulus": 0.37e9,
    "poisson_ratio": 0.41,
    "radius": 23e-9,
    "tip_modulus": 70e9,
    "tip_poisson_ratio": 0.17,
    "adhesion": 6.3e-9,
    "viscosity": 120.0,
    "stiffness": 3.1,
    "damping": 2.2e-6,
    "exponent": 1.27,
    "prefactor": 5e3,
    "half_angle": 0.4,
    "rupture_distance": 2.7e-9,
    "intermolecular_distance": 0.31e-9,
    "frequency": 87e3,
    "thickness": 60e-9,
    "work_of_adhesion": 0.1,
}


def parameters(model: ContactModel) -> dict[str, Any]:
    return {parameter.name: VALUES[parameter.name] for parameter in model.parameters}


def by_quadrature(law: Any, amplitude: float, Delta: float, frequency: float, scale: float) -> np.ndarray:
    """Return CONS_n - i DISS_n of a law(gap, velocity) on its own cosine motion.

    A full period in theta with the velocity of the motion, cut where the gap passes zero and then multiples of
    a length ``scale``, each piece smoothed at both ends.
    """
    u1, w = 1.0 - 2.0 * Delta, 2.0 * math.pi * frequency
    levels = [0.0, *(scale * (2.0**k - 1.0) for k in range(1, 24)), 2.0 * scale]
    levels += [VALUES["rupture_distance"]]
    edges = {0.0, math.pi, 2.0 * math.pi}
    for level in levels:
        cosine = level / amplitude - u1
        if -1.0 < cosine < 1.0:
            edges |= {math.acos(cosine), 2.0 * math.pi - math.acos(cosine)}
    ends = np.array(sorted(edges))
    starts, stops = ends[:-1], ends[1:]
    s = 0.5 * (1.0 + _NODES)
    reach = 0.5 * (stops - starts)
    left = starts[:, None] + reach[:, None] * s**2
    right = stops[:, None] - reach[:, None] * s**2
    theta = np.concatenate([left, right]).ravel()
    weight = np.tile((reach[:, None] * 2.0 * s * 0.5 * _WEIGHTS).ravel(), 2)
    gap, velocity = amplitude * (u1 + np.cos(theta)), -amplitude * w * np.sin(theta)
    values = law(gap, velocity) * weight
    orders = np.arange(N_MAX + 1)[:, None]
    cons, diss = (np.cos(orders * theta) @ values, np.sin(orders * theta) @ values)
    factor = np.where(np.arange(N_MAX + 1) == 0, 0.5, 1.0) / math.pi
    return factor * (cons - 1j * diss)


def largest_term(model: ContactModel, amplitude: float, indentation: float) -> float:
    values = {name: np.asarray(value) for name, value in parameters(model).items()}
    A, D = np.asarray(amplitude), np.asarray(indentation / (2 * amplitude))
    return max(float(abs(term.harmonics(values, A, D, N_MAX)).max()) for term in model.terms)


@pytest.mark.parametrize("key", CLOSED)
@settings(max_examples=25, deadline=None)
@given(
    Delta=st.one_of(
        st.floats(-20.0, -1e-6),
        st.floats(1e-6, 0.1),
        st.floats(0.1, 0.999),
        st.floats(1.0001, 30.0),
    ),
    log_amplitude=st.floats(-9.5, -5.5),
)
@example(Delta=0.31e-9 / (2 * 10e-9), log_amplitude=-8.0)  # delta = a0, where b = 1
@example(Delta=1e-5, log_amplitude=-6.5)
@example(Delta=0.9999, log_amplitude=-8.0)
@example(Delta=-1e-6, log_amplitude=-8.0)
def test_harmonics_are_those_of_the_force_law(key: str, Delta: float, log_amplitude: float) -> None:
    model = contact_model(key)
    if key == "capillary" and Delta < 0.0:
        Delta = max(
            -Delta % 1.0, 1e-6
        )  # as a function of the gap alone the law cannot know that the tip never touched
    amplitude = 10.0**log_amplitude
    given = parameters(model)
    ours = ot.force_harmonics(
        key, amplitude=amplitude, indentation=2.0 * amplitude * Delta, n_max=N_MAX, **given
    )

    def law(gap: np.ndarray, velocity: np.ndarray) -> np.ndarray:
        return ot.force(key, gap, velocity, **{k: v for k, v in given.items() if k != "frequency"})

    reference = by_quadrature(law, amplitude, Delta, VALUES["frequency"], VALUES["intermolecular_distance"])
    scale = largest_term(model, amplitude, 2.0 * amplitude * Delta)
    assert abs(ours - reference).max() <= 1e-9 * max(scale, abs(reference).max(), 1e-30)


@pytest.mark.parametrize("power", [0.0, 0.4, 0.5, 1.0, 1.5, 2.0, 2.7, 4.0])
@pytest.mark.parametrize("Delta", [1e-4, 0.05, 0.3, 0.7, 0.98, 1.02, 1.3, 6.0])
def test_derivatives_of_powers(power: float, Delta: float) -> None:
    """Against finite differences; a constant in permanent contact has none."""

    def at(D: float) -> tuple[np.ndarray, np.ndarray]:
        h, dh = np.empty(7), np.empty(7)
        terms.power_harmonics(1.0, D, power, 6, h, dh)
        return h, dh

    step = 1e-5 * min(Delta, abs(1.0 - Delta))
    slope = (at(Delta + step)[0] - at(Delta - step)[0]) / (2.0 * step)
    assert abs(at(Delta)[1] - slope).max() <= 1e-6 * max(abs(slope).max(), 1e-3)


@pytest.mark.parametrize("tail", [terms.LINEAR_TAIL, terms.VAN_DER_WAALS_TAIL, terms.CONTACT_ONLY])
@pytest.mark.parametrize("reach", [1e-4, 0.01, 0.3])
@pytest.mark.parametrize("Delta", [-2.0, -0.21, 0.003, 0.2, 0.8])
def test_derivatives_of_adhesion(tail: int, reach: float, Delta: float) -> None:
    def at(D: float) -> tuple[np.ndarray, np.ndarray]:
        h, dh = np.empty(7), np.empty(7)
        terms.adhesion_harmonics(tail, 1.0, D, reach, 6, h, dh)
        return h, dh

    step = 1e-6 * abs(Delta)
    slope = (at(Delta + step)[0] - at(Delta - step)[0]) / (2.0 * step)
    assert abs(at(Delta)[1] - slope).max() <= 1e-5 * max(abs(slope).max(), 1e-4)


@pytest.mark.parametrize("reach", [1e-3, 0.1, 1.5])
@pytest.mark.parametrize("Delta", [0.003, 0.2, 0.8])
def test_derivatives_of_hysteresis(reach: float, Delta: float) -> None:
    def at(D: float) -> tuple[np.ndarray, np.ndarray]:
        cons, diss, dcons, ddiss = (np.empty(7) for _ in range(4))
        terms.hysteresis_harmonics(1.0, D, reach, 6, cons, diss, dcons, ddiss)
        return cons - 1j * diss, dcons - 1j * ddiss

    step = 1e-6 * Delta
    slope = (at(Delta + step)[0] - at(Delta - step)[0]) / (2.0 * step)
    assert abs(at(Delta)[1] - slope).max() <= 1e-6 * abs(slope).max()


def test_a_viscous_partner_loses_energy_and_a_spring_does_not() -> None:
    given = parameters(contact_model("dmt-viscous"))
    f = ot.force_harmonics("dmt-viscous", amplitude=30e-9, indentation=4e-9, **given)
    assert f[1].imag < 0.0  # DISS_1 = -Im f_1 > 0: the tip heats the sample
    ratio = (
        -f.imag
        / ot.force_harmonics(
            "hertz", amplitude=30e-9, indentation=4e-9, **parameters(contact_model("hertz"))
        ).real
    )
    E_star = 1.0 / ((1 - 0.17**2) / 70e9 + (1 - 0.41**2) / 0.37e9)
    expected = -np.arange(4) * 2 * math.pi * 87e3 * 120.0 / (2 * E_star)
    np.testing.assert_allclose(ratio, expected, rtol=1e-9, atol=1e-15)


def test_a_neck_loses_its_force_times_its_reach() -> None:
    given = parameters(contact_model("capillary"))
    for Delta in (0.01, 0.3, 0.9):
        f = ot.force_harmonics("capillary", amplitude=30e-9, indentation=60e-9 * Delta, **given)
        lost = -math.pi * 30e-9 * f[1].imag
        assert lost == pytest.approx(6.3e-9 * min(2.7e-9, 60e-9 * (1 - Delta)), rel=1e-9, abs=0)


@pytest.mark.parametrize("key", ["jkr", "maugis"])
@pytest.mark.parametrize("Delta", [0.02, 0.15, 0.6])
def test_adhesive_models_against_a_sampled_tap(key: str, Delta: float) -> None:
    """One tap through `ot.force`, its own velocity choosing the branch; a plain sum meets jumps to 1/N."""
    given = parameters(contact_model(key))
    amplitude = 30e-9
    ours = ot.force_harmonics(key, amplitude=amplitude, indentation=2 * amplitude * Delta, n_max=6, **given)
    theta = (np.arange(400_000) + 0.5) * 2 * math.pi / 400_000
    gap = amplitude * (1 - 2 * Delta + np.cos(theta))
    force = ot.force(key, gap, -np.sin(theta), **given)
    sampled = np.exp(-1j * np.outer(np.arange(7), theta)) @ force * 2 / theta.size
    sampled[0] /= 2
    assert abs(ours - sampled).max() < 2e-5 * abs(ours).max()
    assert -ours[1].imag > 0.0


def test_jkr_reference_curve(jkr_reference: Any) -> None:
    """Force against penetration of an independent solution, on the branch that a retraction follows."""
    _, depth, force = jkr_reference
    stable = slice(int(np.argmin(depth)) + 1, None)
    ours = ot.force("jkr", -depth[stable], 1.0, modulus=1e9, poisson_ratio=0.3, radius=10e-9, adhesion=20e-9)
    np.testing.assert_allclose(ours, force[stable], rtol=1e-6, atol=1e-15)


def test_adhesion_to_zero_gives_hertz() -> None:
    given = parameters(contact_model("dmt")) | {"adhesion": 0.0}
    hertz = parameters(contact_model("hertz"))
    np.testing.assert_array_equal(
        ot.force_harmonics("dmt", amplitude=30e-9, indentation=4e-9, **given),
        ot.force_harmonics("hertz", amplitude=30e-9, indentation=4e-9, **hertz),
    )


def test_thickness_to_infinity_gives_hertz() -> None:
    """The first correction is c1 chi: the difference falls tenfold a decade of thickness."""
    given = parameters(contact_model("thin-layer"))
    rigid = parameters(contact_model("hertz")) | {"tip_modulus": 1e30}
    hertz = ot.force_harmonics("hertz", amplitude=30e-9, indentation=4e-9, **rigid)
    previous = math.inf
    for thickness in (1e-6, 1e-5, 1e-4, 1e-3):
        layer = ot.force_harmonics(
            "thin-layer", amplitude=30e-9, indentation=4e-9, **(given | {"thickness": thickness})
        )
        error = abs(layer / hertz - 1.0).max()
        assert error < 0.11 * previous
        previous = error
    assert previous < 1e-4


def test_everything_broadcasts() -> None:
    given = parameters(contact_model("dmt")) | {"modulus": np.array([[1e8], [1e9]])}
    f = ot.force_harmonics("dmt", amplitude=np.full(3, 30e-9), indentation=4e-9, n_max=5, **given)
    assert f.shape == (2, 3, 6)
    one = ot.force_harmonics("dmt", amplitude=30e-9, indentation=4e-9, n_max=5, **(given | {"modulus": 1e9}))
    np.testing.assert_array_equal(f[1, 2], one)


@pytest.mark.parametrize(
    ("change", "word"),
    [
        ({"modulis": 1.0}, "has no modulis"),
        ({"modulus": None}, "needs modulus"),
        ({"modulus": -1.0}, "modulus is out of range"),
        ({"radius": math.nan}, "radius is out of range"),
        ({"adhesion": "much"}, "adhesion is not a number"),
        ({"modulus": np.ones(3), "radius": np.ones(2)}, "shapes do not fit"),
        ({"amplitude": 0.0}, "amplitude"),
        ({"n_max": -1}, "n_max"),
    ],
)
def test_wrong_parameters_are_named(change: dict[str, Any], word: str) -> None:
    given = parameters(contact_model("dmt")) | {"amplitude": 30e-9, "indentation": 4e-9} | change
    with pytest.raises(ContactModelError, match=word):
        ot.force_harmonics("dmt", **given)


def test_map_table_of_the_paper_through_the_exact_law() -> None:
    for modulus, adhesion, depth, expected in (
        (1.93e9, 1.91e-9, 2.42e-9, (1.97080, -3.90639, 3.80185)),
        (93.78e6, 16.24e-9, 17.54e-9, (0.64596, -2.01215, 3.58542)),
    ):
        f = ot.force_harmonics(
            "dmt",
            amplitude=39.1e-9,
            indentation=depth,
            modulus=modulus,
            adhesion=adhesion,
            poisson_ratio=0.3,
            radius=10e-9,
        )
        np.testing.assert_allclose(f.real[:3] * 1e9, expected, atol=6e-6)
