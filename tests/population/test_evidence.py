"""What a scan has measured of its phases: against a dense Gaussian of all tiles, and against simulated readings."""

import math
from dataclasses import replace

import numpy as np
import pytest
import xarray as xr

from overtone.contact.models import contact_model
from overtone.contact.sample import sample
from overtone.demo import demo_probe
from overtone.dynamics.hold import hold_amplitude
from overtone.instrument.calibration import Calibration, format_calibration
from overtone.instrument.noise import add_noise, complete_noise
from overtone.instrument.shared import redo
from overtone.instrument.signals import positions, signals_of, with_signals
from overtone.instrument.unknowns import NEUTRAL, probe_with
from overtone.inversion.columns import columns_of
from overtone.inversion.linear import sample_modulus
from overtone.inversion.pixels import Setting, radius_exponent
from overtone.population.evidence import (
    Bend,
    Known,
    Tiles,
    beyond_scatter,
    evidence_of,
    harvest,
    inverse,
    scatter_of,
    tiles_of,
    z_given,
)
from overtone.quantities import named_array
from overtone.readings import Reading, with_reading

DATA, SHARED, OWN = 4, 3, 2
UNKNOWNS = 4
COMPUTED = 1e-4  # relative accuracy that a harmonic is computed with


# --- the Gaussian -----------------------------------------------------------------------------------------------


def a_phase(random, tiles):
    """Return tiles of any numbers, of about 1 nN, with errors of about a per cent."""
    root = 0.03 * random.standard_normal((DATA, DATA))
    between = 0.01 * random.standard_normal((DATA, DATA))
    return Tiles(
        y=1e-9 * (1.0 + 0.3 * random.standard_normal(DATA) + 0.02 * random.standard_normal((tiles, DATA))),
        changes=1e-9
        * (
            0.05 * random.standard_normal((DATA, SHARED))
            + 0.02 * random.standard_normal((tiles, DATA, SHARED))
        ),
        radius=np.array([0.02, -0.07, 0.05]),
        stiffness=np.array([0.0, 0.04, -0.02]),
        pixels=random.integers(5, 40, tiles),
        within=1e-18 * (root @ root.T + 1e-4 * np.eye(DATA)),
        between=1e-18 * between @ between.T,
        amplitude=np.array([40e-9]),
        slope=np.zeros((DATA, 1)),
        place=np.zeros((tiles, 3)),
    )


@pytest.fixture(scope="module")
def phases():
    random = np.random.default_rng(11)
    tiles = [a_phase(random, count) for count in (7, 4)]
    bends = [
        Bend(1e-11 * random.standard_normal(DATA), 1e-11 * random.standard_normal((DATA, OWN))) for _ in tiles
    ]
    return tiles, bends, (Known(1, 21.3, 0.04, -0.5),)


def dense(tiles, bends, known):
    """Return every reading less its bend, which unknown it is of, what z adds to it, and the covariance of the rest.

    In nN; z holds the shared errors, then those of the bend of each phase.
    """
    rows = sum(t.y.size for t in tiles) + len(known)
    unknowns = DATA * len(tiles) + len(known)
    y, A = np.zeros(rows), np.zeros((rows, unknowns))
    C, K = np.zeros((rows, SHARED + OWN * len(tiles))), np.zeros((rows, rows))
    at = 0
    for k, t in enumerate(tiles):
        first = at
        for i in range(len(t.y)):
            block = slice(at, at + DATA)
            y[block] = 1e9 * (t.y[i] - bends[k].shift)
            A[block, k * DATA : (k + 1) * DATA] = np.eye(DATA)
            C[block, :SHARED] = 1e9 * t.changes[i]
            C[block, SHARED + k * OWN : SHARED + (k + 1) * OWN] = 1e9 * bends[k].errors
            K[block, block] = 1e18 * (t.between + t.within / t.pixels[i])
            at += DATA
        # the accuracy of what is computed is the same for all tiles of a phase
        W = np.linalg.inv(K[first:at, first:at])
        own = A[first:at, k * DATA : (k + 1) * DATA]
        mean = np.linalg.solve(own.T @ W @ own, own.T @ W @ y[first:at])
        K[first:at, first:at] += own @ np.diag((COMPUTED * mean) ** 2) @ own.T
    for j, fact in enumerate(known):
        y[at], A[at, DATA * len(tiles) + j], K[at, at] = fact.value, 1.0, fact.error**2
        C[at, :SHARED] = fact.exponent * tiles[0].radius
        at += 1
    return y, A, C, K


def before(sources):
    """Return precision and pull of z beforehand, with what two phases of so many unknowns take off the stiffness."""
    of_lever = np.zeros(sources)
    of_lever[:SHARED] = [0.0, 0.04, -0.02]
    return np.eye(sources) + 2 * UNKNOWNS * np.outer(of_lever, of_lever), 2 * UNKNOWNS * of_lever


def test_centre_and_covariance_are_those_of_all_tiles_together(phases):
    tiles, bends, known = phases
    evidence = evidence_of(tiles, bends, known, UNKNOWNS)
    y, A, C, K = dense(*phases)
    P, pull = before(C.shape[1])
    W = np.linalg.inv(K + C @ np.linalg.inv(P) @ C.T)
    covariance = np.linalg.inv(A.T @ W @ A)
    scale = np.r_[np.full(2 * DATA, 1e9 * evidence.unit), 1.0]
    off = y - C @ np.linalg.solve(P, pull)
    np.testing.assert_allclose(evidence.centre * scale, covariance @ A.T @ W @ off, rtol=1e-8)
    size = np.sqrt(np.diag(covariance))
    got = evidence.covariance * np.outer(scale, scale) / np.outer(size, size)
    np.testing.assert_allclose(got, covariance / np.outer(size, size), atol=1e-7)
    # phases share the calibration: their errors go together
    assert np.abs(got[:DATA, DATA : 2 * DATA]).max() > 0.3
    np.testing.assert_allclose(evidence.precision @ evidence.covariance, np.eye(len(size)), atol=1e-7)


def test_z_at_given_harmonics_is_that_of_all_tiles_together(phases):
    tiles, bends, known = phases
    evidence = evidence_of(tiles, bends, known, UNKNOWNS)
    y, A, C, K = dense(*phases)
    f = evidence.centre + 0.5 * np.sqrt(np.diag(evidence.covariance))
    W = np.linalg.inv(K)
    P, pull = before(C.shape[1])
    P = P + C.T @ W @ C
    scale = np.r_[np.full(2 * DATA, 1e9 * evidence.unit), 1.0]
    mean = np.linalg.solve(P, pull + C.T @ W @ (y - A @ (f * scale)))
    sources = C.shape[1]
    got = z_given(evidence, f[None], np.zeros((1, sources)))[0]
    np.testing.assert_allclose(got, mean, atol=1e-7)
    assert np.abs(mean).max() > 0.1
    draws = z_given(evidence, np.broadcast_to(f, (sources, f.size)), np.eye(sources)) - got
    np.testing.assert_allclose(draws.T @ draws, np.linalg.inv(P), atol=1e-7)


def test_the_inverse_of_rows_of_very_different_sizes():
    random = np.random.default_rng(3)
    root, scale = random.standard_normal((5, 5)), np.array([1e-9, 1.0, 1e6, 1e-3, 1e-12])
    matrix = (root @ root.T + np.eye(5)) * np.outer(scale, scale)
    got = inverse(matrix) * np.outer(scale, scale)
    np.testing.assert_allclose(got, np.linalg.inv(root @ root.T + np.eye(5)), rtol=1e-9)


def test_what_tiles_differ_by_beyond_their_scatter_is_right_in_the_mean():
    random = np.random.default_rng(5)
    between = np.array([[0.5, 0.2], [0.2, 0.3]])
    within = np.array([[4.0, -1.0], [-1.0, 9.0]])
    count = np.array([4, 9, 30, 17, 12, 6, 25, 14])
    worlds = 4000
    root_b, root_w = np.linalg.cholesky(between), np.linalg.cholesky(within)
    means = random.standard_normal((worlds, count.size, 2)) @ root_b.T
    means += random.standard_normal((worlds, count.size, 2)) @ root_w.T / np.sqrt(count)[:, None]
    found = np.stack([beyond_scatter(m, count.astype(float), within) for m in means])
    error = found.std(axis=0) / math.sqrt(worlds)
    assert (np.abs(found.mean(axis=0) - between) < 3.5 * error).all()
    # sharp enough to tell a tile more or less
    assert (error < 0.04 * np.sqrt(np.outer(np.diag(between), np.diag(between)))).all()


# --- readings ---------------------------------------------------------------------------------------------------

PROBE = demo_probe()
SHAPE = (6, 6)
ERRORS = {
    "A0_offset": 3e-13,
    "gain0": 5e-4,
    "gain2": 5e-4,
    "gain3": 1e-3,
    "latency2": 5e-4,
    "latency3": 5e-4,
    "phi1_offset": 2e-4,
    "stiffness": 5e-3,
    "quality_factor": 5e-4,
    "free_amplitude": 3e-4,
    "radius": 1e-2,
    "A0_slope_x": 1e-6,
}
SILENCE = {"A0": 1e-17, "A1": 1e-17, "phi1": 1e-9, "A2": 1e-17, "A3": 1e-17}
TILE = np.repeat(np.arange(SHAPE[0]), SHAPE[1])


def a_scan(values=NEUTRAL, amplitude=0.42, modulus=0.4e9):
    """Return readings of one material under the true lever, and its true forces (pixel, row)."""
    lever = probe_with(PROBE, values)
    solid = sample(
        "dmt-viscous",
        modulus=np.full(SHAPE, modulus),
        adhesion=6e-9,
        viscosity=30.0,
        poisson_ratio=0.35,
    )
    share = np.broadcast_to(amplitude * PROBE.drive.free_amplitude / lever.drive.free_amplitude, SHAPE)
    states = hold_amplitude(lever, solid, setpoint=xr.DataArray(share, dims=("y", "x")), n_max=12)
    x = np.linspace(-1e-6, 1e-6, SHAPE[1])
    clean = xr.Dataset(
        {name: states[name] for name in ("A0", "A1", "phi1", "A2", "phi2", "A3", "phi3")},
    ).assign_coords(x=("x", x), y=("y", x[: SHAPE[0]]))
    clean["height"] = named_array("height", np.zeros(SHAPE), ("y", "x"), clean.coords)
    where = positions(clean)._asdict()
    read = with_signals(clean, redo(signals_of(clean), values, PROBE.drive.free_amplitude, **where))
    # tiles without any scatter have no weights
    read = add_noise(read, SILENCE, seed=1)
    cons, diss = (
        states[name].transpose("y", "x", "harmonic").values.reshape(-1, 4) for name in ("F_cons", "F_diss")
    )
    return with_reading(read, Reading(PROBE, corrected=True)), np.concatenate([cons, diss[:, 1:]], axis=1)


def a_setting(scan, names=()):
    """Return it with a calibration that leaves some unknowns open, of `ERRORS`."""
    if names:
        covariance = np.diag([ERRORS[name] ** 2 for name in names])
        left = Calibration(PROBE, PROBE.drive.free_amplitude, dict(NEUTRAL), tuple(names), covariance)
        scan = scan.assign_attrs(calibration=format_calibration(left))
    return Setting.of(scan, PROBE, (0, 1, 2, 3), (1, 2, 3), complete_noise(None, (0, 1, 2, 3)))


@pytest.mark.parametrize("name", list(ERRORS))
def test_readings_move_as_an_unknown_larger_than_believed_says(name):
    """``y = f + C z``: what is concluded is that much off what is true, for z = 1."""
    scan, true = a_scan({**NEUTRAL, name: NEUTRAL[name] + ERRORS[name]})
    setting = a_setting(scan, (name,))
    tiles = tiles_of([setting], harvest([setting]), np.arange(true.shape[0]), np.zeros(len(TILE), int))
    if name == "A0_slope_x":
        column = np.arange(len(TILE)) % SHAPE[1]
        tiles = tiles_of([setting], harvest([setting]), np.arange(true.shape[0]), column)
        true = np.stack([true[column == k].mean(axis=0) for k in range(SHAPE[1])])
        assert tiles.y[0, 0] * tiles.y[-1, 0] > 0.0
    else:
        true = true.mean(axis=0)[None]
    off, want = tiles.y - true, tiles.changes[..., 0]
    sign = np.linalg.eigh(np.eye(1))[1][0, 0]  # of a root of the covariance
    size = np.abs(off).max()
    if name == "radius":
        assert size < 1e-5 * np.abs(true).max()
        assert np.abs(want).max() < 1e-5 * np.abs(true).max()
        assert tiles.radius[0] == pytest.approx(sign * ERRORS[name], rel=1e-9, abs=0)
        return
    assert size > 1e-13
    np.testing.assert_allclose(sign * want, off, atol=0.02 * size)
    assert tiles.radius[0] == 0.0
    of_stiffness = sign * ERRORS[name] if name == "stiffness" else 0.0
    assert tiles.stiffness[0] == pytest.approx(of_stiffness, rel=1e-9, abs=1e-15)


def test_a_lever_is_not_believed_to_be_softer_the_more_unknowns_there_are():
    """Forces that determine each its own unknown say nothing of the stiffness they all are a multiple of."""
    phases, error, noise = 3, 0.05, 0.01
    z, ln_f = np.linspace(-8.0, 8.0, 1601), np.linspace(-1.0, 1.0, 4001)
    # read: 1. True: f = 1 + error z, whose logarithm is even beforehand; a phase by itself, integrated over it
    off = 1.0 + error * z[:, None] - np.exp(ln_f)
    of_one = np.exp(-0.5 * (off / noise) ** 2).sum(axis=1)
    shift = 1 * phases * error
    plain, told = -0.5 * z**2, shift * z - 0.5 * (1.0 + phases * error**2) * z**2
    for prior, want in ((plain, -shift), (told, 0.0)):
        weight = np.exp(prior) * of_one**phases
        assert (weight @ z) / weight.sum() == pytest.approx(want, abs=0.01)
    tiles = a_phase(np.random.default_rng(1), 3)._replace(stiffness=np.array([error, 0.0, 0.0]))
    still = Bend(np.zeros(DATA), np.zeros((DATA, 0)))
    told, plain = (evidence_of([tiles] * phases, [still] * phases, (), n) for n in (1, 0))
    np.testing.assert_allclose(told.z_pull - plain.z_pull, [shift, 0.0, 0.0], atol=1e-12)


def test_the_scatter_of_a_phase_is_that_of_its_pixels_without_the_instrument():
    random = np.random.default_rng(5)
    count, each = 150, 30
    within, between = np.diag([1.0, 4.0, 0.5, 2.0]), np.outer(*2 * [np.array([1.0, -1.0, 0.5, 0.0])])
    changes = random.standard_normal((count, DATA, SHARED))
    z = np.array([1.0, -0.5, 2.0])
    means = random.multivariate_normal(np.zeros(DATA), between + within / each, count)
    tiles = a_phase(random, count)._replace(
        y=means + changes @ z, changes=changes, pixels=np.full(count, each), within=within
    )
    np.testing.assert_allclose(scatter_of(tiles, z), within + between, atol=0.5)
    # taken for the sample's, what the instrument adds would make it many times that
    assert np.trace(scatter_of(tiles, np.zeros(SHARED))) > 2.0 * np.trace(within + between)


def test_a_known_modulus_tells_the_radius():
    """A tip wider than believed by one deviation: forces are those of a stiffer sample, and z comes back as 1."""
    record, given = contact_model("dmt-viscous"), {"poisson_ratio": 0.35}
    exponent = radius_exponent(record, PROBE, given)
    assert exponent == pytest.approx(-0.5, rel=1e-6, abs=0)
    modulus, error = 50e6, 0.01
    wide = replace(PROBE, tip=replace(PROBE.tip, radius=PROBE.tip.radius * (1.0 + error)))
    of_wide, nominal = (columns_of(record, probe, given).contact for probe in (wide, PROBE))
    compliance = of_wide.tip_compliance + of_wide.sample_factor / modulus
    believed = sample_modulus(nominal, of_wide.factor / compliance)
    assert math.log(believed / modulus) == pytest.approx(0.5 * error, rel=0.05, abs=0)
    tiles = a_phase(np.random.default_rng(1), 3)
    tiles = tiles._replace(
        changes=np.zeros_like(tiles.changes[..., :1]), radius=np.array([error]), stiffness=np.zeros(1)
    )
    still = Bend(np.zeros(DATA), np.zeros((DATA, 0)))
    evidence = evidence_of([tiles], [still], (Known(0, math.log(modulus), 1e-5, exponent),), 0)
    f = np.r_[evidence.centre[:DATA], math.log(believed)]
    z = z_given(evidence, f[None], np.zeros((1, 1)))[0, 0]
    assert z == pytest.approx(1.0, rel=0.05, abs=0)
    # and ln E of the sample is what the forces say at the nominal radius, and what the radius takes off
    assert math.log(believed) + exponent * error * z == pytest.approx(math.log(modulus), rel=1e-4, abs=0)


def test_what_the_feedback_leaves_is_taken_off_along_the_amplitude():
    random = np.random.default_rng(8)
    scan, _ = a_scan(amplitude=0.42 * (1.0 + 0.003 * random.standard_normal(SHAPE)))
    setting = a_setting(scan)
    data = harvest([setting])
    tiles = tiles_of([setting], data, np.arange(len(TILE)), TILE)
    (up, above), (down, below) = (a_scan(amplitude=0.42 * factor) for factor in (1.003, 0.997))
    step = float(up["A1"].mean() - down["A1"].mean())
    slope = (above.mean(axis=0) - below.mean(axis=0)) / step
    np.testing.assert_allclose(tiles.slope[:, 0], slope, atol=5e-3 * np.abs(slope).max())
    # and nothing is left of it
    before = data.y.std(axis=0)
    least = 1.1e-3 * np.sqrt(np.diag(data.noise))  # no scatter is taken to be smaller
    assert (np.sqrt(np.diag(tiles.within)) < 0.02 * before + least).all()
    assert tiles.amplitude[0] == pytest.approx(float(scan["A1"].mean()), rel=1e-9, abs=0)
    np.testing.assert_allclose(
        tiles.y, np.broadcast_to(data.y.mean(axis=0), tiles.y.shape), atol=2e-3 * before.max()
    )


def test_the_noise_of_a_pixel_is_what_its_forces_scatter_by():
    sigma = {"A0": 20e-12, "A1": 1e-12, "phi1": 2e-3, "A2": 3e-12, "A3": 2e-12}
    scan, _ = a_scan()
    many = scan.isel(y=np.repeat(np.arange(SHAPE[0]), 60))
    noisy = add_noise(many, sigma, seed=4)
    setting = Setting.of(noisy, PROBE, (0, 1, 2, 3), (1, 2, 3), complete_noise(sigma, (0, 1, 2, 3)))
    data = harvest([setting])
    seen = np.cov(data.y.T)
    size = np.sqrt(np.diag(data.noise))
    count = len(data.y)
    np.testing.assert_allclose(
        seen / np.outer(size, size),
        data.noise / np.outer(size, size),
        atol=4.5 * math.sqrt(2.0 / count),
    )


def test_lost_pixels_are_not_used_and_scans_stand_side_by_side():
    (scan, _), (other, _) = a_scan(), a_scan(amplitude=0.6)
    scan = scan.copy(deep=True)
    scan["A2"][2, 3] = math.nan
    settings = [a_setting(scan, ("gain0", "radius")), a_setting(other, ("gain0", "radius"))]
    data = harvest(settings)
    assert np.flatnonzero(~data.usable).tolist() == [2 * SHAPE[1] + 3]
    assert data.y.shape == (36, 14)
    assert (data.noise[:7, 7:] == 0.0).all()
    tiles = tiles_of(settings, data, np.flatnonzero(data.usable), TILE)
    assert tiles.changes.shape == (6, 14, 2)
    each = [tiles_of([s], harvest([s]), np.flatnonzero(data.usable), TILE).changes[0] for s in settings]
    np.testing.assert_allclose(tiles.changes[0], np.concatenate(each), rtol=1e-9, atol=1e-20)
