"""Blocks of pixels as the kernels take them, with what a calibration leaves uncertain."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import xarray as xr

from overtone.contact.models import contact_model
from overtone.contact.sample import sample
from overtone.dynamics.hold import hold_amplitude
from overtone.harmonics import far_phase, to_force_harmonics
from overtone.instrument.noise import complete_noise
from overtone.inversion.columns import columns_of
from overtone.inversion.pixels import Setting, radius_exponent
from overtone.inversion.table import interpolate_block
from overtone.probe import BASE, Drive, Probe

PROBE = Probe.simple(
    stiffness=16.4,
    frequency=161.8e3,
    quality_factor=287.0,
    radius=10e-9,
    drive_frequency=161.8e3,
    free_amplitude=94e-9,
)


@pytest.fixture(scope="module")
def scan() -> xr.Dataset:
    modulus = np.geomspace(50e6, 5e9, 12).reshape(3, 4)
    return hold_amplitude(
        PROBE,
        sample("dmt", modulus=modulus, poisson_ratio=0.3, adhesion=10e-9),
        setpoint=0.6,
        dims=("y", "x"),
    )


def setting(
    observables: xr.Dataset, cons: tuple[int, ...] = (0, 1, 2), diss: tuple[int, ...] = (), **options: Any
) -> Setting:
    probe = options.pop("probe", PROBE)
    return Setting.of(
        observables, probe, cons, diss, complete_noise(options.pop("noise", None), (0, 1, 2, 3))
    )


def test_a_block_holds_the_forces_of_its_pixels(scan: xr.Dataset) -> None:
    all_of_it = setting(scan, (0, 1, 3), (2,))
    pixels = all_of_it.pixels(slice(3, 9), 0.0)
    want = to_force_harmonics(scan, PROBE)
    cons = want["F_cons"].transpose("y", "x", "harmonic").values.reshape(12, 4)
    diss = want["F_diss"].transpose("y", "x", "harmonic").values.reshape(12, 4)
    np.testing.assert_allclose(pixels.y[:, :3], cons[3:9][:, [0, 1, 3]], rtol=1e-11)
    size = np.abs(cons).max()
    np.testing.assert_allclose(pixels.y[:, 3], diss[3:9, 2], rtol=1e-11, atol=1e-11 * size)
    np.testing.assert_allclose(pixels.amplitude, scan["A1"].values.ravel()[3:9], rtol=1e-12)
    assert pixels.usable.all()
    # harmonics that were measured are known to the motion, whether or not they are rows
    assert all_of_it.orders == (0, 1, 2, 3)
    assert all_of_it.known == (2, 3)
    f = cons - 1j * diss
    np.testing.assert_allclose(pixels.known, f[3:9][:, [2, 3]], rtol=1e-11)


def test_only_harmonics_asked_for_are_read(scan: xr.Dataset) -> None:
    assert setting(scan, (0, 1, 2)).orders == (0, 1, 2)
    assert setting(scan, (2, 3)).orders == (1, 2, 3)
    assert setting(scan, (0, 1, 2)).known == (2,)


@pytest.mark.parametrize(
    ("cons", "diss", "row"), [((0, 1, 2), (), 1), ((1, 2, 3), (1,), 0), ((0, 2, 3), (1,), -1)]
)
def test_where_the_attraction_shows(
    scan: xr.Dataset, cons: tuple[int, ...], diss: tuple[int, ...], row: int
) -> None:
    """The sign of CONS_1; DISS_1 has the same order and is no attraction."""
    np.testing.assert_array_equal(setting(scan, cons, diss).attraction, [row])


def test_without_a_calibration_errors_are_those_of_noise(scan: xr.Dataset) -> None:
    pixels = setting(scan).pixels(slice(0, 12), -0.5)
    assert pixels.of_noise is pixels.whitening
    assert not pixels.pull.any()
    assert not pixels.left.any()


def test_more_noise_weighs_less(scan: xr.Dataset) -> None:
    one = setting(scan, noise={"A0": 1e-12, "A1": 1e-12, "phi1": 1e-4, "A2": 1e-12}).pixels(slice(0, 12), 0.0)
    ten = setting(scan, noise={"A0": 1e-11, "A1": 1e-11, "phi1": 1e-3, "A2": 1e-11}).pixels(slice(0, 12), 0.0)
    np.testing.assert_allclose(
        ten.whitening, 0.1 * one.whitening, rtol=1e-6, atol=1e-4 * np.abs(ten.whitening).max()
    )


def test_lost_pixels_are_marked(scan: xr.Dataset) -> None:
    broken = scan.copy(deep=True)
    broken["A1"][0, 0] = 0.0
    broken["A1"][0, 1] = math.nan
    broken["phi1"][0, 2] = math.inf
    broken["A2"][0, 3] = math.nan
    broken["A3"][1, 0] = math.nan  # not used
    pixels = setting(broken).pixels(slice(0, 12), 0.0)
    np.testing.assert_array_equal(pixels.usable, [False] * 4 + [True] * 8)


def test_the_table_reaches_every_amplitude(scan: xr.Dataset) -> None:
    varied = scan.assign(
        A1=scan["A1"] * xr.DataArray(np.linspace(0.3, 1.5, 12).reshape(3, 4), dims=("y", "x"))
    )
    columns = columns_of(contact_model("dmt"), PROBE, {"poisson_ratio": 0.3})
    here = setting(varied)
    table = here.table(columns)
    amplitude = here.pixels(slice(0, 12), 0.0).amplitude
    a, b = np.empty((12, 3)), np.empty((12, 3))
    interpolate_block(table, amplitude, np.zeros(12), np.array([0, 1, 2]), a, b)
    assert np.isfinite(a).all()
    assert np.isfinite(b).all()


def test_the_table_reaches_the_amplitude_of_the_tip_under_a_shaken_base() -> None:
    """Where reading and motion differ by per cents, low in quality."""
    probe = Probe(
        Probe.simple(
            stiffness=2.0,
            frequency=60e3,
            quality_factor=5.0,
            radius=10e-9,
            drive_frequency=60e3,
            free_amplitude=50e-9,
        ).cantilever,
        Drive(60e3, 50e-9, BASE),
        PROBE.tip,
    )
    phase = far_phase(probe) + np.linspace(-1.5, 1.5, 60)
    scan = xr.Dataset(
        {
            "A0": ("p", np.full(60, 1e-10)),
            "A1": ("p", np.linspace(20e-9, 49e-9, 60)),
            "phi1": ("p", phase),
            "A2": ("p", np.full(60, 1e-10)),
            "phi2": ("p", np.zeros(60)),
        }
    )
    here = setting(scan, probe=probe)
    amplitude = here.pixels(slice(0, 60), 0.0).amplitude
    assert np.abs(amplitude / scan["A1"].values - 1.0).max() > 0.02
    table = here.table(columns_of(contact_model("dmt"), probe, {"poisson_ratio": 0.3}))
    a, b = np.empty((60, 3)), np.empty((60, 3))
    interpolate_block(table, amplitude, np.zeros(60), np.array([0, 1, 2]), a, b)
    assert np.isfinite(a).all()


@pytest.mark.parametrize(
    ("model", "given", "exponent"),
    [
        ("dmt", {"poisson_ratio": 0.3}, -0.5),
        ("hertz-viscous", {"poisson_ratio": 0.3}, -0.5),
        ("flat-punch", {"poisson_ratio": 0.3}, -1.0),
        ("cone", {"poisson_ratio": 0.3, "half_angle": 0.3}, 0.0),
        ("kelvin-voigt", {}, 0.0),
        ("thin-layer", {"poisson_ratio": 0.3, "thickness": 1e-6}, -0.5),
    ],
)
def test_what_a_wider_tip_makes_of_the_modulus(model: str, given: dict[str, float], exponent: float) -> None:
    assert radius_exponent(contact_model(model), PROBE, given) == pytest.approx(exponent, abs=1e-6)


def test_without_a_tip_there_is_no_such_change() -> None:
    bare = Probe(PROBE.cantilever, PROBE.drive)
    assert radius_exponent(contact_model("kelvin-voigt"), bare, {}) == 0.0


class Known:
    """Three shared errors of known size in place of a calibration: two of them move forces, two the radius."""

    of_radius = np.array([0.05, -0.03, 0.0])

    def changes(self, block: slice, orders: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray]:
        count = block.stop - block.start
        random = np.random.default_rng(7)
        part = random.normal(size=(len(orders), 3)) + 1j * random.normal(size=(len(orders), 3))
        part = part * 3e-11
        part[:, 1] = 0.0
        return np.broadcast_to(part, (count, len(orders), 3)), self.of_radius


@pytest.mark.parametrize("diss", [(), (1, 2)])
def test_a_residual_says_which_way_shared_errors_went(scan: xr.Dataset, diss: tuple[int, ...]) -> None:
    """Pull and what is left of the radius are the regression on drawn errors, signs included."""
    shared = Known()
    plain = setting(scan, (0, 1, 2), diss)
    pixels = replace(plain, shared=shared).pixels(slice(0, 2), -0.5)
    rows = plain.rows
    changes = shared.changes(slice(0, 2), plain.orders)[0][0][rows.harmonics]
    of_force = np.where(rows.lossy[:, None], -changes.imag, changes.real)
    random = np.random.default_rng(8)
    z = random.normal(size=(200000, 3))
    root = np.linalg.inv(pixels.of_noise[0])
    # what is read falls short of the truth by what the calibration would have to add to it
    residual = random.normal(size=(z.shape[0], rows.orders.size)) @ root.T - z @ of_force.T
    white = residual @ pixels.whitening[0].T
    np.testing.assert_allclose(white.T @ white / z.shape[0], np.eye(rows.orders.size), atol=0.015)
    wanted = -0.5 * z @ shared.of_radius
    error = 5.0 * wanted.std() / math.sqrt(z.shape[0])
    np.testing.assert_allclose(pixels.pull[0], wanted @ white / z.shape[0], atol=error)
    assert np.abs(pixels.pull[0]).max() > 10.0 * error
    left = wanted - white @ pixels.pull[0]
    assert pixels.left[0] == pytest.approx(left.var(), rel=0.02, abs=0)
    # noise alone weighs the same as without a calibration
    np.testing.assert_array_equal(pixels.of_noise, plain.pixels(slice(0, 2), 0.0).whitening)
