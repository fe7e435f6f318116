"""Validity of the contact: the paper's numbers, and JKR contacts that come back from their own harmonics."""

import math
from typing import Any

import numpy as np
import pytest
import xarray as xr
from scipy.optimize import least_squares

import overtone as ot
from overtone.contact import adhesive
from overtone.contact.parameters import effective_modulus
from overtone.errors import ContactModelError, InversionError, ProbeError
from overtone.inversion.jkr import FOLD, jkr_of_harmonics
from overtone.inversion.validity import contact_validity
from overtone.probe import Probe

R = 10e-9
GIVEN: dict[str, Any] = {"poisson_ratio": 0.3, "intermolecular_distance": 0.2e-9}
PAPER = {"modulus": [1.93e9, 93.78e6], "adhesion": [1.91e-9, 16.24e-9], "indentation": [2.42e-9, 17.54e-9]}
A1 = xr.DataArray(39.1e-9)


def probe(radius: float | None = R) -> Probe:
    return Probe.simple(
        stiffness=16.4,
        frequency=161.8e3,
        quality_factor=287.0,
        drive_frequency=161.8e3,
        free_amplitude=94e-9,
        radius=radius,
    )


def properties(**values: Any) -> xr.Dataset:
    return xr.Dataset({name: ("x", np.asarray(value, dtype=float)) for name, value in values.items()})


def jkr_contacts(count: int, depths: tuple[float, float]) -> tuple[dict[str, Any], np.ndarray, np.ndarray]:
    """Return JKR materials, A1 and indentation: ln E*, ln w, ln depth and ln span even."""
    rng = np.random.default_rng(5)

    def even(low: float, high: float) -> np.ndarray:
        return np.exp(rng.uniform(math.log(low), math.log(high), count))

    E, w = even(1e7, 3e10), even(1e-3, 0.3)
    length = np.cbrt(math.pi * w / (4.0 / 3.0 * E)) ** 2 * np.cbrt(R)
    depth, span = even(*depths), even(2e-3, 0.85)
    amplitude = (depth + FOLD) * length / (2.0 * span)
    return {"effective_modulus": E, "radius": R, "work_of_adhesion": w}, amplitude, depth * length


# --- the contact ------------------------------------------------------------------------------------------------


def test_numbers_of_the_papers_polymers() -> None:
    contact = contact_validity(properties(**PAPER), A1, probe(), model="dmt", **GIVEN)
    assert contact["mean_pressure"].values[0] == pytest.approx(0.436e9, rel=2e-3, abs=0)
    assert contact["relative_indentation"].values[1] == pytest.approx(1.754, rel=1e-3, abs=0)
    np.testing.assert_allclose(contact["tabor"], [0.64, 19.9], rtol=5e-3)
    assert contact["contact_radius"].values[0] == pytest.approx(4.919e-9, rel=1e-3, abs=0)
    # 4/3 E* sqrt(R) delta^1.5 - F_ad
    E_star = effective_modulus(np.array(PAPER["modulus"]), 0.3)
    elastic = 4.0 / 3.0 * E_star * math.sqrt(R) * np.array(PAPER["indentation"]) ** 1.5
    np.testing.assert_allclose(contact["peak_force"], elastic - PAPER["adhesion"], rtol=1e-12)
    np.testing.assert_allclose(
        contact["mean_pressure"], elastic / (math.pi * contact["contact_radius"] ** 2), rtol=1e-12
    )
    assert contact.attrs["frequency"] == 161.8e3
    assert all(array.attrs["units"] and array.attrs["long_name"] for array in contact.data_vars.values())


def test_time_in_contact_is_what_the_motion_spends_below_the_surface() -> None:
    delta = np.array([-1e-9, 0.0, 2e-9, 30e-9, 75e-9, 78.2e-9, 90e-9])
    contact = contact_validity(
        properties(modulus=np.full(7, 1e9), indentation=delta), A1, probe(), model="hertz", poisson_ratio=0.3
    )
    theta = (np.arange(200000) + 0.5) * (2.0 * math.pi / 200000)
    share = [(float(A1) * (1.0 + np.cos(theta)) < d).mean() for d in delta]
    np.testing.assert_allclose(contact["contact_time"], share, rtol=0, atol=2e-5)
    assert set(contact.data_vars) == {
        "contact_time", "peak_force", "relative_indentation", "contact_radius", "mean_pressure"
    }  # fmt: skip


def test_nan_in_nan_out_and_nothing_pressed_without_contact() -> None:
    nan = math.nan
    given = properties(
        modulus=[1e9, nan, 1e9, 1e9, 1e9, -1.0, 1e9],
        adhesion=[5e-9, 5e-9, nan, 5e-9, 5e-9, 5e-9, 0.0],
        indentation=[3e-9, 3e-9, 3e-9, nan, -1e-9, 3e-9, 3e-9],
    )
    contact = contact_validity(given, A1, probe(), model="dmt", **GIVEN)
    finite = {name: np.isfinite(array.values).tolist() for name, array in contact.items()}
    touching = [True, False, False, False, False, False, True]
    for name in ("peak_force", "contact_radius", "mean_pressure", "relative_indentation"):
        assert finite[name] == touching, name
    for name in ("tabor", "contact_time"):
        assert finite[name] == [True, False, False, False, True, False, True], name
    for name in ("modulus_jkr", "adhesion_jkr", "model_difference"):
        assert finite[name] == [True, *[False] * 6], name
    assert contact["contact_time"].values[4] == 0.0
    nowhere = contact_validity(given.where(given["modulus"] > 1e12), A1, probe(), model="dmt", **GIVEN)
    assert all(np.isnan(array).all() for array in nowhere.data_vars.values())


def test_maps_keep_their_dimensions_and_take_the_estimate_at_every_pixel() -> None:
    rng = np.random.default_rng(2)
    grid = {
        "modulus": (("y", "x"), 1e9 * rng.uniform(0.5, 2.0, (3, 4))),
        "adhesion": (("y", "x"), 5e-9 * rng.uniform(0.5, 2.0, (3, 4))),
        "indentation": (("y", "x"), 3e-9 * rng.uniform(0.9, 1.1, (3, 4))),
    }
    complete = xr.Dataset(grid, coords={"y": np.arange(3), "x": np.arange(4)})
    amplitude = xr.DataArray(rng.uniform(30e-9, 40e-9, (4, 3)), dims=("x", "y"))
    contact = contact_validity(complete, amplitude, probe(), model="dmt", **GIVEN)
    assert contact["modulus_jkr"].dims == ("y", "x")
    one = contact_validity(complete.isel(y=1, x=2), amplitude.isel(y=1, x=2), probe(), model="dmt", **GIVEN)
    for name in contact:
        assert float(one[name]) == pytest.approx(float(contact[name][1, 2]), rel=1e-9, abs=0), name
    screened = complete.rename({name: f"{name}_unscreened" for name in grid})
    screened = screened.assign({name: complete[name] * math.nan for name in grid})
    xr.testing.assert_allclose(contact, contact_validity(screened, amplitude, probe(), model="dmt", **GIVEN))


def test_peak_of_a_lossy_contact_comes_before_its_deepest_point() -> None:
    given = properties(modulus=[0.2e9], adhesion=[5e-9], indentation=[8e-9], viscosity=[60.0])
    lossy = contact_validity(given, A1, probe(), model="dmt-viscous", **GIVEN)
    lossless = contact_validity(given, A1, probe(), model="dmt", **GIVEN)
    psi = np.linspace(-math.acos(1.0 - 8e-9 / float(A1)), 0.0, 20001)
    gap = float(A1) * (1.0 - np.cos(psi)) - 8e-9
    velocity = float(A1) * 2.0 * math.pi * 161.8e3 * np.sin(psi)
    force = ot.force(
        "dmt-viscous", gap, velocity, radius=R, modulus=0.2e9, adhesion=5e-9, viscosity=60.0, **GIVEN
    )
    assert float(lossy["peak_force"][0]) == pytest.approx(force.max(), rel=1e-3, abs=0)
    assert float(lossy["peak_force"][0]) > 1.05 * float(lossless["peak_force"][0])
    # loss does not enter the conservative harmonics
    assert float(lossy["modulus_jkr"][0]) == pytest.approx(float(lossless["modulus_jkr"][0]), rel=1e-9, abs=0)


def test_other_models_get_what_applies() -> None:
    cone = contact_validity(
        properties(modulus=[1e9], indentation=[5e-9]),
        A1,
        probe(),
        model="cone",
        poisson_ratio=0.3,
        half_angle=math.radians(20.0),
    )
    expected = 2.0 / math.pi * effective_modulus(1e9, 0.3) * math.tan(math.radians(20.0)) * 25e-18
    assert float(cone["peak_force"][0]) == pytest.approx(float(expected), rel=1e-12, abs=0)
    assert set(cone.data_vars) == {"contact_time", "peak_force", "relative_indentation"}
    spring = contact_validity(
        properties(stiffness=[5.0], damping=[0.0], indentation=[2e-9]), A1, probe(None), model="kelvin-voigt"
    )
    assert set(spring.data_vars) == {"contact_time", "peak_force"}
    assert float(spring["peak_force"][0]) == pytest.approx(10e-9, rel=1e-12, abs=0)


def test_calls_that_cannot_be_answered_say_why() -> None:
    given = properties(**PAPER)
    with pytest.raises(InversionError, match="lack adhesion"):
        contact_validity(given.drop_vars("adhesion"), A1, probe(), model="dmt", **GIVEN)
    with pytest.raises(InversionError, match="memory"):
        contact_validity(given, A1, probe(), model="sls", **GIVEN)
    with pytest.raises(InversionError, match="three orders"):
        contact_validity(given, A1, probe(), model="dmt", harmonics=(0, 1, 4), **GIVEN)
    with pytest.raises(ProbeError, match="tip radius"):
        contact_validity(given, A1, probe(None), model="dmt", **GIVEN)
    with pytest.raises(ContactModelError, match="poisson_ratio"):
        contact_validity(given, A1, probe(), model="dmt")


# --- JKR --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("orders", [(0, 1, 2), (1, 2, 3), (0, 2, 3)])
@pytest.mark.parametrize(
    ("depths", "modulus", "adhesion"), [((0.2, 30.0), 1e-4, 1e-4), ((30.0, 300.0), 1e-4, 1e-2)]
)
def test_jkr_comes_back_from_its_own_harmonics(
    orders: tuple[int, ...], depths: tuple[float, float], modulus: float, adhesion: float
) -> None:
    """From a start wrong by a factor of 2, whatever the depth; deep contacts say little of adhesion."""
    material, amplitude, delta = jkr_contacts(400, depths)
    cons = adhesive.harmonics("jkr", amplitude, delta, 3, **material).real
    E, pull = material["effective_modulus"], 1.5 * math.pi * material["work_of_adhesion"] * R
    wrong = np.exp(np.random.default_rng(1).normal(0.0, 0.7, (3, 400)))
    found = jkr_of_harmonics(
        cons,
        amplitude,
        orders=orders,
        radius=R,
        indentation=delta * wrong[0],
        effective_modulus=E * wrong[1],
        adhesion=pull * wrong[2],
    )
    np.testing.assert_allclose(found.effective_modulus, E, rtol=modulus)
    np.testing.assert_allclose(found.adhesion, pull, rtol=adhesion)
    np.testing.assert_allclose(found.indentation, delta, rtol=1e-4)


def test_jkr_of_the_papers_polymers_has_the_harmonics_of_dmt() -> None:
    """Put back into the JKR model: the same three harmonics, to what the table leaves."""
    contact = contact_validity(properties(**PAPER), A1, probe(), model="dmt", **GIVEN)
    np.testing.assert_allclose(contact["model_difference"], [-0.1525, 0.2402], rtol=2e-3)
    np.testing.assert_allclose(
        contact["model_difference"], np.log(contact["modulus_jkr"] / PAPER["modulus"]), rtol=1e-12
    )
    common = {"amplitude": float(A1), "n_max": 2, "radius": R, "poisson_ratio": 0.3}
    for i in range(2):
        dmt = {name: values[i] for name, values in PAPER.items()}
        wanted = ot.force_harmonics("dmt", intermolecular_distance=0.2e-9, **common, **dmt).real
        jkr = {"modulus": float(contact["modulus_jkr"][i]), "adhesion": float(contact["adhesion_jkr"][i])}

        def misfit(p: np.ndarray, jkr: Any = jkr, wanted: Any = wanted) -> np.ndarray:
            return (
                ot.force_harmonics("jkr", indentation=float(p[0]) * 1e-9, **common, **jkr).real / wanted - 1.0
            )

        # the indentation is not among what comes back: one number, three equations
        fit = least_squares(misfit, [dmt["indentation"] * 1e9], xtol=1e-14, ftol=1e-14, gtol=1e-14)
        assert np.abs(fit.fun).max() < 1e-6


def test_jkr_and_dmt_go_together_where_adhesion_is_weak() -> None:
    """Deep in contact JKR's force is Hertz's less pi w R: two thirds of its pull-off force, all of DMT's.

    The next term of the force falls as the depth to the power -3/4, and so does what is left of the difference.
    """
    depth, delta, amplitude = np.array([320.0, 640.0]), 8e-9, 8e-9
    E_star = float(effective_modulus(3e9, 0.3))
    pull = 2.0 * math.sqrt(R) * 4.0 / 3.0 * E_star * (delta / depth) ** 1.5  # w = F_ad/(2 pi R)
    cons = ot.force_harmonics(
        "dmt-contact",
        amplitude=amplitude,
        indentation=delta,
        radius=R,
        modulus=3e9,
        poisson_ratio=0.3,
        adhesion=pull,
    ).real
    found = jkr_of_harmonics(
        cons,
        np.full(2, amplitude),
        orders=(0, 1, 2),
        radius=R,
        indentation=np.full(2, delta),
        effective_modulus=np.full(2, E_star),
        adhesion=pull,
    )
    assert (np.abs(found.effective_modulus / E_star - 1.0) < 5e-5).all()
    inverse, rest = pull / found.adhesion, depth**-0.75
    limit = inverse[1] - rest[1] * (inverse[0] - inverse[1]) / (rest[0] - rest[1])
    assert 1.0 / limit == pytest.approx(1.5, rel=0.02, abs=0)


def test_no_jkr_value_where_it_does_not_apply_or_exist() -> None:
    hard = contact_validity(
        properties(modulus=[60e9, 60e9], adhesion=[1e-9, 60e-9], indentation=[2e-9, 2e-9]),
        A1,
        probe(),
        model="dmt",
        **GIVEN,
    )
    assert hard["tabor"].values[0] < 0.1 < hard["tabor"].values[1]
    assert np.isfinite(hard["modulus_jkr"].values).tolist() == [False, True]
    # a contact held by adhesion alone: no JKR contact pulls like that
    held = contact_validity(
        properties(modulus=[1e8], adhesion=[20e-9], indentation=[1e-9]), A1, probe(), model="dmt", **GIVEN
    )
    assert held["tabor"].values[0] > 5.0
    assert np.isnan(held["modulus_jkr"].values[0])


def test_missing_jkr_contacts_are_attractive_ones() -> None:
    """The search finds every pixel but those that no JKR contact matches: shallow ones with CONS_1 > 0."""
    rng = np.random.default_rng(7)
    E, pull, delta = (10.0 ** rng.uniform(a, b, 3000) for a, b in ((7, 10.4), (-10, -7.5), (-9.7, -7.6)))
    contact = contact_validity(
        properties(modulus=E, adhesion=pull, indentation=delta), A1, probe(), model="dmt", **GIVEN
    )
    first = ot.force_harmonics(
        "dmt", amplitude=float(A1), indentation=delta, n_max=1, radius=R, modulus=E, adhesion=pull, **GIVEN
    ).real[:, 1]
    missing = np.isnan(contact["modulus_jkr"].values) & (contact["tabor"].values > 0.1)
    assert 0.1 < missing.mean() < 0.5
    assert (first[missing] > 0.0).all()
