"""Sample maps: the materials, surfaces and places that they were asked for."""

from dataclasses import replace

import numpy as np
import pytest
import xarray as xr

import overtone as ot
from overtone.errors import OvertoneError
from overtone.instrument.phantom import (
    POLYOLEFIN,
    POLYSTYRENE,
    blend,
    gradient,
    map_of,
    material_of,
    sample_map,
)


def test_options_of_a_blend_change_nothing_else() -> None:
    plain = blend(shape=(24, 32), size=4e-6, seed=3)
    more = blend(
        POLYSTYRENE, replace(POLYOLEFIN, viscosity=50.0), shape=(24, 32), size=4e-6, poisson_ratio=0.4, seed=3
    )
    for name in plain.data_vars:
        xr.testing.assert_identical(plain[name], more[name])
    assert set(plain.data_vars) == {"modulus", "adhesion", "height", "material"}
    assert set(more.data_vars) - set(plain.data_vars) == {"viscosity", "poisson_ratio"}
    assert (more["poisson_ratio"] == 0.4).all()


def test_a_viscous_material_is_viscous_in_its_domains_only() -> None:
    phantom = blend(POLYSTYRENE, replace(POLYOLEFIN, viscosity=50.0), shape=(64, 64), seed=1)
    soft = phantom["material"].values == 1
    assert not phantom["viscosity"].values[~soft].any()
    inside = np.log(phantom["viscosity"].values[soft])
    assert np.median(inside) == pytest.approx(np.log(50.0), abs=0.03)
    assert inside.std() == pytest.approx(0.1, rel=0.1, abs=0)
    assert phantom["viscosity"].attrs["units"] == "Pa s"


def test_relief_and_tilt_are_those_asked_for() -> None:
    flat = blend(shape=(40, 40), relief=0.0, seed=2)
    steps = flat["height"].values[flat["material"].values == 1]
    assert (steps == POLYOLEFIN.height).all()
    tilted = blend(shape=(40, 40), relief=0.0, tilt=0.01, seed=2)
    np.testing.assert_allclose(
        (tilted["height"] - flat["height"]).values,
        np.broadcast_to(0.01 * flat["x"].values, (40, 40)),
        atol=1e-20,
    )
    wavy = blend(shape=(40, 40), relief=5e-9, seed=2)
    assert float(abs(wavy["height"] - flat["height"]).max()) == pytest.approx(5e-9, rel=0.02, abs=0)


def test_a_gradient_is_even_in_the_logarithm_and_has_no_phases() -> None:
    surface = gradient(modulus=(1e8, 1e10), adhesion=(2e-9, 8e-9), shape=(17, 33))
    assert "material" not in surface
    steps = np.diff(np.log(surface["modulus"].values), axis=1)
    np.testing.assert_allclose(steps, np.log(100.0) / 32, rtol=1e-9)
    assert float(surface["modulus"][0, 0]) == pytest.approx(1e8, rel=1e-12, abs=0)
    # adhesion rises along y, which falls from row to row
    assert float(surface["adhesion"].sel(y=0.0)[5]) == pytest.approx(2e-9, rel=1e-12, abs=0)
    assert float(surface["adhesion"][0, 5]) == pytest.approx(8e-9, rel=1e-12, abs=0)
    together = np.corrcoef(surface["modulus"].values.ravel(), surface["adhesion"].values.ravel())
    assert abs(together[0, 1]) < 1e-9


def test_arrays_become_a_map_with_places() -> None:
    modulus = np.arange(1.0, 13.0).reshape(3, 4) * 1e9
    surface = sample_map(size=2e-6, modulus=modulus, adhesion=5e-9, poisson_ratio=0.3, height=modulus * 1e-18)
    np.testing.assert_array_equal(surface["modulus"].values, modulus)
    np.testing.assert_allclose(surface["x"].values, [0.0, 0.5e-6, 1e-6, 1.5e-6])
    np.testing.assert_allclose(surface["y"].values, [1e-6, 0.5e-6, 0.0])
    material = material_of(surface, None, None)
    assert material.model.key == "dmt"
    np.testing.assert_array_equal(material.values["modulus"], modulus)
    xr.testing.assert_identical(
        map_of(ot.sample("hertz", modulus=modulus, poisson_ratio=0.3), 2e-6)["x"], surface["x"]
    )


def test_a_viscosity_chooses_the_viscous_model() -> None:
    surface = gradient(viscosity=30.0, poisson_ratio=0.35, shape=(2, 3))
    assert material_of(surface, None, None).model.key == "dmt-viscous"
    with pytest.raises(OvertoneError, match="'dmt' has no viscosity"):
        material_of(surface, "dmt", None)
    with pytest.raises(OvertoneError, match="of its own"):
        material_of(surface, None, 0.3)
    with pytest.raises(OvertoneError, match="needs poisson_ratio"):
        material_of(gradient(shape=(2, 3)), None, None)


def test_what_is_no_map_is_refused() -> None:
    with pytest.raises(OvertoneError, match="colour belong to no sample"):
        sample_map(size=1e-6, modulus=np.ones((2, 2)), colour=3.0)
    with pytest.raises(OvertoneError, match="do not fit"):
        sample_map(size=1e-6, modulus=np.ones((2, 2)), adhesion=np.ones((3, 2)))
    with pytest.raises(OvertoneError, match="no sample map"):
        sample_map(size=1e-6, modulus=1e9)
    with pytest.raises(OvertoneError, match="no sample map"):
        sample_map(size=0.0, modulus=np.ones((2, 2)))
    with pytest.raises(OvertoneError, match="lacks places"):
        map_of(ot.sample("hertz", modulus=np.ones((2, 2)) * 1e9, poisson_ratio=0.3), None)
    with pytest.raises(OvertoneError, match="cannot be made"):
        gradient(modulus=(0.0, 1e9))
