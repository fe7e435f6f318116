"""How a pixel goes with its material at a held amplitude: against states that a feedback holds, found by the drive."""

import math

import numpy as np
import pytest

from overtone.contact.models import contact_model
from overtone.contact.parameters import effective_modulus
from overtone.contact.sample import sample
from overtone.demo import demo_probe
from overtone.dynamics.hold import hold_amplitude
from overtone.instrument.noise import complete_noise
from overtone.inversion.columns import columns_of
from overtone.inversion.forces import reader_of, rows_of
from overtone.inversion.motion import FEW, follow
from overtone.inversion.priors import complete_priors, for_kernel
from overtone.population.forward import ADHESION, FIRST_DEPTH, TANGENT
from overtone.population.held import PROPERTIES, curvature
from overtone.population.materials import Question

PROBE, POISSON = demo_probe(), 0.35
RECORD = contact_model("dmt-viscous")
MATERIALS = {"stiff": (1.9e9, 2e-9, 0.05), "soft": (94e6, 14e-9, 0.12)}
SETPOINTS = (0.42, 0.55)
UNIT, STEP = 1e-9, 0.1
ROWS = 7


def held(properties, setpoint):
    """Return rows (point, row) [N] and t (point,) of materials that a feedback holds at an amplitude."""
    modulus, adhesion, tangent = np.asarray(properties).T
    E = effective_modulus(modulus, POISSON, PROBE.tip.modulus, PROBE.tip.poisson_ratio)
    solid = sample(
        "dmt-viscous",
        modulus=modulus,
        adhesion=adhesion,
        viscosity=tangent * 2.0 * E / (2.0 * math.pi * PROBE.drive.frequency),
        poisson_ratio=POISSON,
    )
    states = hold_amplitude(PROBE, solid, setpoint=setpoint, n_max=FEW, dims=("point",))
    cons, diss = (states[name].transpose("point", "harmonic").values for name in ("F_cons", "F_diss"))
    Delta = states["indentation"].values / (2.0 * setpoint * PROBE.drive.free_amplitude)
    return np.concatenate([cons, diss[:, 1:]], axis=1), np.log(Delta / (1.0 - Delta))


@pytest.fixture(scope="module", params=list(MATERIALS))
def response(request):
    return respond(MATERIALS[request.param], STEP)


def respond(material, reach, cons=(0, 1, 2, 3), diss=(1, 2, 3)):
    """Return a material with its rows, slopes, curvatures, change of t, and slopes by t alone."""
    rows, orders = rows_of(cons, diss)
    columns = columns_of(RECORD, PROBE, {"poisson_ratio": POISSON})
    priors = for_kernel(complete_priors(None, RECORD, PROBE.tip.radius), "modulus")
    question = Question(columns, rows, follow(PROBE, (2, 3), FEW), priors)
    amplitude = PROBE.drive.free_amplitude * np.array([SETPOINTS])
    scene = question.scene(np.empty(0), np.empty((0, 0)), amplitude, UNIT, [])
    reader = reader_of(PROBE, orders, complete_noise(None, orders))
    first = amplitude[0] * reader.stiffness[orders.index(1)] / UNIT
    t = [held([material], setpoint)[1][0] for setpoint in SETPOINTS]
    v = np.empty(FIRST_DEPTH + 2)
    v[ADHESION], v[TANGENT], v[FIRST_DEPTH:] = math.log(material[1] / UNIT), math.log(material[2]), t
    size = 2 * rows.orders.size
    f, J, H = np.empty(size), np.empty((size, 3)), np.empty((size, 3, 3))
    depth, along = np.empty((2, 3)), np.empty((size, 2))
    curvature(
        scene,
        0,
        math.log(material[0]),
        v,
        np.stack([first.real, first.imag], axis=1),
        np.zeros(2, complex),
        np.ones(PROPERTIES, bool),
        np.full(PROPERTIES, reach),
        f,
        J,
        H,
        depth,
        along,
    )
    return material, f, J, H, depth, along


@pytest.mark.parametrize("scan", [0, 1])
def test_slopes_are_those_of_states_that_are_held(response, scan):
    material, f, J, _, depth, _ = response
    block = slice(scan * ROWS, (scan + 1) * ROWS)
    turned = [np.array(material) * np.exp(sign * STEP * e) for e in np.eye(3) for sign in (1, -1)]
    y, t = held([material, *turned], SETPOINTS[scan])
    np.testing.assert_allclose(f[block], y[0] / UNIT, rtol=1e-4, atol=1e-5 * np.abs(f).max())
    for i in range(3):
        slope = (y[1 + 2 * i] - y[2 + 2 * i]) / UNIT / (2.0 * STEP)
        np.testing.assert_allclose(J[block, i], slope, atol=2e-3 * np.abs(slope).max())
        by_depth = (t[1 + 2 * i] - t[2 + 2 * i]) / (2.0 * STEP)
        assert depth[scan, i] == pytest.approx(by_depth, rel=2e-3, abs=0)
    # a stiffer pixel is indented less
    assert depth[scan, 0] < 0.0


@pytest.mark.parametrize("scan", [0, 1])
def test_the_curve_is_that_of_states_that_are_held(response, scan):
    material, _, _, H, _, _ = response
    block = slice(scan * ROWS, (scan + 1) * ROWS)
    eye = STEP * np.eye(3)
    pairs = [(i, j) for i in range(3) for j in range(i + 1)]
    places = [np.zeros(3), *eye, *-eye, *(eye[i] + eye[j] for i, j in pairs if i != j)]
    y, _ = held([np.array(material) * np.exp(place) for place in places], SETPOINTS[scan])
    y = y / UNIT
    mixed = dict(zip([pair for pair in pairs if pair[0] != pair[1]], y[7:], strict=True))
    for i, j in pairs:
        if i == j:
            want = (y[1 + i] + y[4 + i] - 2.0 * y[0]) / STEP**2
        else:
            want = (mixed[i, j] - y[1 + i] - y[1 + j] + y[0]) / STEP**2
        np.testing.assert_allclose(H[block, i, j], want, atol=0.01 * np.abs(want).max() + 2e-3)
        np.testing.assert_array_equal(H[block, i, j], H[block, j, i])


def test_the_mean_of_pixels_that_scatter_is_off_by_half_of_the_curve(response):
    """Which is what all this is for: pixels of a phase are not in the mean as their median material is."""
    material, f, _, H, _, _ = response
    spread = np.array([0.15, 0.12, 0.15])
    theta = spread * np.random.default_rng(2).standard_normal((200, 3))
    # in pairs, so that what is straight cancels
    y, _ = held(np.array(material) * np.exp(np.concatenate([theta, -theta])), SETPOINTS[0])
    got = y.mean(axis=0) / UNIT - f[:ROWS]
    want = 0.5 * np.einsum("rij,pi,pj->r", H[:ROWS], theta, theta) / len(theta)
    assert np.abs(got).max() > 1e-4
    np.testing.assert_allclose(want, got, atol=0.15 * np.abs(got).max())


def test_what_a_scan_does_alone_is_its_own(response):
    _, _, _, _, _, along = response
    assert (along[:ROWS, 1] == 0.0).all()
    assert (along[ROWS:, 0] == 0.0).all()
    assert np.abs(along[:ROWS, 0]).max() > 0.01


def test_far_steps_stay_on_the_branch_of_the_material():
    """Ten per cent softer it would be repulsive at the same indentation: another state, which no pixel is in."""
    material = (157e6, 23e-9, 0.114)
    _, f, near, _, near_depth, _ = respond(material, 0.05)
    _, _, far, H, far_depth, _ = respond(material, 0.35)
    rows = slice(0, ROWS)
    assert f[1] < 0.0  # attraction holds the amplitude down
    np.testing.assert_allclose(far[rows], near[rows], atol=0.25 * np.abs(near[rows]).max())
    np.testing.assert_allclose(far_depth[0], near_depth[0], atol=0.05)
    assert np.abs(H[rows]).max() < 20.0 * np.abs(near[rows]).max()


def test_without_the_first_harmonic_slopes_are_those_at_one_depth():
    material = MATERIALS["soft"]
    _, f, J, H, depth, along = respond(material, 0.2, (0, 2, 3), ())
    assert (depth == 0.0).all()
    assert (H == 0.0).all()
    # an elastic force and one of adhesion: rows are their sum, and what the motion adds
    np.testing.assert_allclose(J[:, 0] + J[:, 1], f, atol=0.1 * np.abs(f).max())
    assert (J[:, 0] * J[:, 1] < 0.0).any()
    assert np.isfinite(along).all()
