"""A pixel about its phase, against states that the simulator holds: properties that it never sees as slopes."""

import math

import numpy as np
import pytest

from overtone.contact.models import contact_model
from overtone.contact.parameters import effective_modulus
from overtone.contact.sample import sample
from overtone.demo import demo_probe
from overtone.dynamics.hold import hold_amplitude
from overtone.inversion.columns import columns_of
from overtone.inversion.forces import rows_of
from overtone.inversion.motion import FEW, follow
from overtone.inversion.priors import complete_priors, for_kernel
from overtone.population.deviation import Centre, of_the_motion, settle_pixels
from overtone.population.draws import without_motion
from overtone.population.forward import ADHESION, FIRST_DEPTH, TANGENT
from overtone.population.materials import Question

PROBE, POISSON, UNIT = demo_probe(), 0.35, 1e-9
SETPOINTS = (0.42, 0.55)
AMPLITUDE = PROBE.drive.free_amplitude * np.array([SETPOINTS])
# attraction and repulsion nearly cancel in the second: ten per cent of a property turn CONS_1 about
MATERIALS = {"stiff": (1.9e9, 2e-9, 0.05), "soft": (140e6, 18e-9, 0.11), "softer": (60e6, 14e-9, 0.12)}
CONS, DISS = (0, 1, 2, 3), (1, 2)
SPREAD = np.array([0.2, 0.2, 0.2])


def held(materials, setpoint, model="dmt-viscous"):
    """Return the rows [unit] of materials at a set-point, and t."""
    E, F, tangent = np.array(materials).T
    two = 2.0 * effective_modulus(E, POISSON, PROBE.tip.modulus, PROBE.tip.poisson_ratio)
    loss = {"viscosity": tangent * two / (2.0 * math.pi * PROBE.drive.frequency)}
    solid = sample(
        model,
        modulus=E,
        adhesion=F,
        poisson_ratio=POISSON,
        **(loss if model == "dmt-viscous" else {}),
    )
    states = hold_amplitude(PROBE, solid, setpoint=setpoint, n_max=FEW, dims=("point",))
    cons, diss = (states[name].transpose("point", "harmonic").values for name in ("F_cons", "F_diss"))
    Delta = states["indentation"].values / (2.0 * setpoint * PROBE.drive.free_amplitude)
    lossy = diss[:, list(DISS)] if model == "dmt-viscous" else np.empty((len(E), 0))
    return np.concatenate([cons[:, list(CONS)], lossy], axis=1) / UNIT, np.log(Delta / (1.0 - Delta))


def a_phase(material, model="dmt-viscous", noise=1e-3):
    """Return a scene without motion and the centre of a phase, whose rows are known to so much of the largest."""
    record = contact_model(model)
    rows, _ = rows_of(CONS, DISS if model == "dmt-viscous" else ())
    columns = columns_of(record, PROBE, {"poisson_ratio": POISSON})
    priors = for_kernel(complete_priors(None, record, PROBE.tip.radius), "modulus")
    question = Question(columns, rows, follow(PROBE, (2, 3), FEW), priors)
    scene = question.scene(np.empty(0), np.empty((0, 0)), AMPLITUDE, UNIT, [])
    bare = without_motion(scene)
    middle = [held([material], setpoint, model) for setpoint in SETPOINTS]
    v = np.empty(FIRST_DEPTH + 2)
    v[ADHESION], v[TANGENT] = math.log(material[1] / UNIT), math.log(material[2])
    v[FIRST_DEPTH:] = [t[0] for _, t in middle]
    size = 2 * rows.orders.size
    motion, by = np.zeros(size), np.zeros((size, 4))
    of_the_motion(scene, bare, 0, math.log(material[0]), v, motion, by)
    # how the indentation follows, by states a little to either side
    step = 0.02
    sides = [np.array(material) * np.exp(sign * step * e) for e in np.eye(3) for sign in (1, -1)]
    t = np.array([held(sides, setpoint, model)[1] for setpoint in SETPOINTS])
    depth = (t[:, ::2] - t[:, 1::2]) / (2.0 * step)
    lossy = model == "dmt-viscous"
    spread = SPREAD if lossy else np.array([*SPREAD[:2], 0.0])
    scale = noise * np.abs(np.concatenate([y[0] for y, _ in middle])).max()
    return bare, Centre(
        math.log(material[0]),
        v,
        motion,
        by,
        np.zeros(size),
        np.zeros((3, size)),
        np.eye(size) / scale**2,
        spread,
        depth,
        math.inf if lossy else 0.2,
    )


def settled(bare, centre, y, place=None):
    theta, covariance = np.empty((len(y), 5)), np.empty((len(y), 5, 5))
    found = np.zeros(len(y), bool)
    settle_pixels(
        bare, 0, centre, y, np.zeros((len(y), 3)) if place is None else place, theta, covariance, found
    )
    return theta, covariance, found


def pixels_of(material, away, model="dmt-viscous"):
    """Return the rows of pixels (pixel, datum) that are so far off a material, and their t (scan, pixel)."""
    parts = [held(np.array(material) * np.exp(away), setpoint, model) for setpoint in SETPOINTS]
    return np.concatenate([y for y, _ in parts], axis=1), np.array([t for _, t in parts])


@pytest.mark.parametrize("name", list(MATERIALS))
def test_pixels_come_back(name):
    material = MATERIALS[name]
    away = 0.15 * np.random.default_rng(3).standard_normal((40, 3))
    y, t = pixels_of(material, away)
    bare, centre = a_phase(material, noise=2e-6)
    theta, covariance, found = settled(bare, centre, y)
    # data as good as this leave the phase no say: what is left is the motion, taken as straight
    assert found.all()
    np.testing.assert_allclose(theta[:, :3], away, atol=0.05)
    assert (np.sqrt(((theta[:, :3] - away) ** 2).mean(axis=0)) < 0.01).all()
    extra = t.T - centre.unknowns[FIRST_DEPTH:] - away @ centre.depth.T
    np.testing.assert_allclose(theta[:, 3:], extra, atol=0.03)
    assert (np.linalg.eigvalsh(covariance) > 0.0).all()


def test_a_pixel_that_says_nothing_is_its_phase():
    material = MATERIALS["soft"]
    bare, centre = a_phase(material, noise=1e4)
    y, _ = pixels_of(material, np.array([[0.3, -0.2, 0.1]]))
    theta, covariance, found = settled(bare, centre, y)
    assert found.all()
    np.testing.assert_allclose(theta, 0.0, atol=1e-3)
    np.testing.assert_allclose(np.diag(covariance[0])[:3], SPREAD**2, rtol=1e-3)


def test_the_covariance_is_that_of_many_noisy_readings():
    material = MATERIALS["softer"]
    bare, centre = a_phase(material, noise=2e-3)
    random = np.random.default_rng(4)
    away = SPREAD * random.standard_normal((600, 3))
    y, _ = pixels_of(material, away)
    y = y + random.standard_normal(y.shape) / np.sqrt(np.diag(centre.precision))
    theta, covariance, found = settled(bare, centre, y)
    assert found.mean() > 0.99
    z = (theta - np.column_stack([away, np.zeros((600, 2))]))[found, :3]
    z /= np.sqrt(np.einsum("paa->pa", covariance))[found, :3]
    np.testing.assert_allclose(z.std(axis=0), 1.0, atol=0.12)
    # the likeliest value of a skew distribution is not its mean
    np.testing.assert_allclose(z.mean(axis=0), 0.0, atol=0.25)
    # the data had something to say
    assert (np.median(np.sqrt(np.einsum("paa->pa", covariance)), axis=0)[:3] < 0.7 * SPREAD).any()


def test_a_model_without_loss_leaves_it_alone():
    material = (1.2e9, 5e-9, 0.05)
    bare, centre = a_phase(material, "dmt", noise=1e-5)
    away = np.column_stack([0.15 * np.random.default_rng(5).standard_normal((20, 2)), np.zeros(20)])
    y, _ = pixels_of(material, away, "dmt")
    theta, _, found = settled(bare, centre, y)
    assert found.all()
    np.testing.assert_allclose(theta[:, :2], away[:, :2], atol=0.03)
    assert (theta[:, 2] == 0.0).all()


def test_what_the_instrument_adds_is_taken_off():
    material = MATERIALS["stiff"]
    bare, centre = a_phase(material)
    random = np.random.default_rng(6)
    y, _ = pixels_of(material, 0.1 * random.standard_normal((5, 3)))
    want, _, _ = settled(bare, centre, y)
    shift, tilt = random.standard_normal(y.shape[1]), random.standard_normal((3, y.shape[1]))
    place = random.standard_normal((5, 3))
    moved = centre._replace(shift=shift, tilt=tilt)
    got, _, _ = settled(bare, moved, y + shift + place @ tilt, place)
    np.testing.assert_allclose(got, want, atol=1e-9)


def test_a_pixel_that_no_material_makes_is_not_found():
    material = MATERIALS["softer"]
    bare, centre = a_phase(material, noise=1e-5)
    y, _ = pixels_of(material, np.zeros((1, 3)))
    _, _, found = settled(bare, centre, np.concatenate([1e3 * y, y * math.nan, y]))
    assert found.tolist() == [False, False, True]
