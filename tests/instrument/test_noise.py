import numpy as np
import pytest
import xarray as xr

from overtone.errors import OvertoneError
from overtone.instrument.noise import ORDINARY_NOISE, add_noise, complete_noise
from overtone.instrument.phantom import POLYOLEFIN, POLYSTYRENE, blend


def clean(n: int = 200_000) -> xr.Dataset:
    values = {"A0": 1e-10, "A1": 4e-8, "phi1": 0.5, "A2": 1e-10, "phi2": 4.0, "A3": 1e-13, "phi3": 1.0}
    return xr.Dataset({name: ("point", np.full(n, value)) for name, value in values.items()})


def test_noise_has_the_stated_size() -> None:
    noisy = add_noise(clean(), {"A0": 7e-12}, seed=0)
    assert noisy["A0"].std() == pytest.approx(7e-12, rel=0.01, abs=0)
    assert noisy["phi1"].std() == pytest.approx(ORDINARY_NOISE["phi1"], rel=0.01, abs=0)
    assert noisy["A2"].std() == pytest.approx(ORDINARY_NOISE["A2"], rel=0.02, abs=0)
    assert float((noisy["phi2"] - 4.0).std()) == pytest.approx(ORDINARY_NOISE["A2"] / 1e-10, rel=0.02, abs=0)


def test_noise_averages_out_of_phasors_not_of_amplitudes() -> None:
    """A third harmonic ten times below the noise: its amplitude is noise, its mean phasor is not."""
    noisy = add_noise(clean(), seed=1)
    phasor = (noisy["A3"].values * np.exp(-1j * noisy["phi3"].values)).mean()
    assert abs(phasor - 1e-13 * np.exp(-1j)) < 2e-14
    assert float(noisy["A3"].mean()) > 1e-12


def test_the_seed_decides() -> None:
    xr.testing.assert_identical(add_noise(clean(10), seed=3), add_noise(clean(10), seed=3))
    assert float(add_noise(clean(10), seed=4)["A0"][0]) != float(add_noise(clean(10), seed=3)["A0"][0])


@pytest.mark.parametrize("noise", [{"modulus": 1.0}, {"A0": -1e-12}, {"A0": float("nan")}])
def test_noise_that_makes_no_sense_is_refused(noise: dict[str, float]) -> None:
    with pytest.raises(OvertoneError, match="noise is not stated"):
        complete_noise(noise, (0, 1, 2))


def test_a_phantom_has_the_materials_it_was_made_of() -> None:
    phantom = blend(shape=(60, 80), seed=0)
    assert phantom["modulus"].shape == (60, 80)
    for index, material in enumerate((POLYSTYRENE, POLYOLEFIN)):
        mask = phantom["material"].values == index
        assert 0.3 < mask.mean() < 0.7
        assert np.median(phantom["modulus"].values[mask]) == pytest.approx(material.modulus, rel=0.02, abs=0)
        assert np.log(phantom["adhesion"].values[mask]).std() == pytest.approx(
            material.spread, rel=0.1, abs=0
        )
    assert float(phantom["y"][0]) > float(phantom["y"][-1])


def test_impossible_phantoms_are_refused() -> None:
    with pytest.raises(OvertoneError, match="coverage"):
        blend(coverage=0.99, seed=0)
