import numpy as np
import pytest

import overtone as ot
from overtone.contact.models import contact_model
from overtone.demo import demo_probe

VALUES = {
    "modulus": 0.37e9,
    "poisson_ratio": 0.41,
    "radius": 23e-9,
    "tip_modulus": 70e9,
    "tip_poisson_ratio": 0.17,
    "adhesion": 6.3e-9,
    "viscosity": 120.0,
    "stiffness": 3.1,
    "damping": 2.2e-6,
    "half_angle": 0.4,
    "rupture_distance": 2.7e-9,
    "intermolecular_distance": 0.31e-9,
    "frequency": 87e3,
}


@pytest.mark.parametrize(
    "key", ["hertz", "dmt", "dmt-linear", "dmt-viscous", "kelvin-voigt-adhesion", "cone", "capillary"]
)
@pytest.mark.parametrize("Delta", [0.02, 0.3, 0.8])
def test_without_higher_harmonics_it_is_the_closed_form(key: str, Delta: float) -> None:
    given = {p.name: VALUES[p.name] for p in contact_model(key).parameters}
    at = {"amplitude": 30e-9, "indentation": 60e-9 * Delta, "n_max": 6}
    closed = ot.force_harmonics(key, **at, **given)
    sampled = ot.force_harmonics(key, higher=np.zeros(2), **at, **given)
    assert abs(sampled - closed).max() < 1e-9 * abs(closed).max()


def test_on_the_motion_of_a_steady_state_it_is_its_force() -> None:
    """The harmonic balance samples the same motion in its own way."""
    state = ot.hold_amplitude(
        demo_probe(),
        ot.sample("dmt", modulus=94e6, poisson_ratio=0.35, adhesion=16e-9),
        setpoint=0.42,
        keep=10,
    )
    phase = float(state["phi1"])
    higher = [
        float(state[f"A{n}"]) * np.exp(1j * (n * phase - float(state[f"phi{n}"]))) for n in range(2, 11)
    ]
    at_pi = float(state["A1"] - state["Z"] - state["A0"]) - sum(
        (-1) ** n * b.real for n, b in enumerate(higher, start=2)
    )
    law = {"modulus": 94e6, "poisson_ratio": 0.35, "adhesion": 16e-9, "radius": 10e-9}
    f = ot.force_harmonics(
        "dmt", amplitude=float(state["A1"]), indentation=at_pi, higher=higher, n_max=5, **law
    )
    expected = (state["F_cons"] - 1j * state["F_diss"]).values[:6]
    assert abs(f - expected).max() < 1e-7 * abs(expected).max()
    bare = ot.force_harmonics("dmt", amplitude=float(state["A1"]), indentation=at_pi, n_max=5, **law)
    assert abs(bare - expected).max() > 1e-3 * abs(expected).max()
