import numpy as np
import pytest

from overtone.contact.models import contact_model, models
from overtone.contact.parameters import effective_modulus
from overtone.contact.sample import sample
from overtone.errors import ContactModelError


def test_every_record_is_complete() -> None:
    keys = [model.key for model in models()]
    assert len(set(keys)) == len(keys)
    for model in models():
        assert model.assumptions
        assert model.source
        for parameter in (*model.unknowns, *model.given):
            assert parameter.lower < parameter.upper
            assert parameter.meaning


def test_a_parameter_means_the_same_in_every_model() -> None:
    seen: dict[str, object] = {}
    for model in models():
        for parameter in (*model.unknowns, *model.given):
            assert seen.setdefault(parameter.name, parameter) == parameter


def test_effective_modulus_is_eq_16() -> None:
    assert float(effective_modulus(1e9, 0.3, 130e9, 0.3)) == pytest.approx(
        1.0905125408942204e9, rel=1e-12, abs=0
    )
    rigid = effective_modulus(np.array([1e6, 1e9]), 0.5, 1e30, 0.0)
    np.testing.assert_allclose(rigid, np.array([1e6, 1e9]) / 0.75)


@pytest.mark.parametrize(
    ("arguments", "word"),
    [
        ({"model": "dtm", "modulus": 1e9, "poisson_ratio": 0.3}, "unknown contact model"),
        ({"model": "dmt", "modulus": 1e9, "poisson_ratio": 0.3}, "needs adhesion"),
        ({"model": "hertz", "modulus": 1e9, "poisson_ratio": 0.3, "adhesion": 1e-9}, "has no adhesion"),
        ({"model": "hertz", "modulus": -1e9, "poisson_ratio": 0.3}, "modulus is out of range"),
        ({"model": "hertz", "modulus": np.nan, "poisson_ratio": 0.3}, "modulus is out of range"),
        (
            {"model": "dmt", "modulus": 1e9, "poisson_ratio": 0.3, "adhesion": -1.0},
            "adhesion is out of range",
        ),
        ({"model": "hertz", "modulus": 1e9, "poisson_ratio": 0.6}, "poisson_ratio is out"),
        ({"model": "dmt", "modulus": [1e9] * 3, "poisson_ratio": 0.3, "adhesion": [1e-9] * 2}, "shapes"),
        (
            {
                "model": "dmt",
                "modulus": 1e9,
                "poisson_ratio": 0.3,
                "adhesion": 1e-9,
                "intermolecular_distance": 0.0,
            },
            "intermolecular_distance",
        ),
    ],
)
def test_wrong_parameters_are_named(arguments: dict[str, object], word: str) -> None:
    with pytest.raises(ContactModelError, match=word):
        sample(**arguments)  # type: ignore[arg-type]


def test_a_sample_broadcasts() -> None:
    blend = sample("dmt", modulus=np.full((3, 4), 1e9), poisson_ratio=0.3, adhesion=5e-9)
    assert blend.values["adhesion"].shape == blend.shape == (3, 4)
    assert contact_model("dmt") is blend.model
