import numpy as np
import pytest

from overtone.contact.validity import adhesion_regime, tabor_parameter
from overtone.errors import ContactModelError


def test_tabor_parameter_of_the_papers_polymers() -> None:
    mu = tabor_parameter(
        radius=10e-9,
        modulus=np.array([1.93e9, 93.78e6]),
        poisson_ratio=0.3,
        adhesion=np.array([1.91e-9, 16.24e-9]),
    )
    np.testing.assert_allclose(mu, [0.64, 19.9], rtol=5e-3)


def test_tabor_parameter_scales_as_it_should() -> None:
    def mu(**change: float) -> float:
        given = {"radius": 1e-8, "modulus": 1e6, "poisson_ratio": 0.5, "adhesion": 1e-9, "tip_modulus": 1e15}
        return float(tabor_parameter(**(given | change)))

    assert mu(adhesion=8e-9) / mu() == pytest.approx(4.0)
    assert mu(modulus=8e6) / mu() == pytest.approx(0.25, rel=1e-6, abs=0)
    assert mu(radius=8e-8) / mu() == pytest.approx(0.5)  # at given force of adhesion, w falls as 1/R


@pytest.mark.parametrize(("tabor", "word"), [(0.01, "DMT"), (1.0, "between"), (20.0, "JKR")])
def test_regimes_are_named(tabor: float, word: str) -> None:
    assert adhesion_regime(tabor).startswith(word)


def test_wrong_values_are_refused() -> None:
    with pytest.raises(ContactModelError, match="radius"):
        tabor_parameter(radius=-1.0, modulus=1e9, poisson_ratio=0.3, adhesion=1e-9)
