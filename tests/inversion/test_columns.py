"""Contact models as columns: S a_n + F_ad b_n and the loss tangent give back the harmonics of every linear model."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from overtone.contact.evaluate import force_harmonics
from overtone.contact.models import contact_model, models
from overtone.errors import ContactModelError, InversionError, ProbeError
from overtone.inversion.columns import (
    WORK_ROWS,
    adhesive,
    columns_of,
    fill_columns,
    is_linear,
    unknowns_of,
)
from overtone.inversion.linear import stiffness
from overtone.probe import Probe, Tip

PROBE = Probe.simple(
    stiffness=16.4,
    frequency=161.8e3,
    quality_factor=287.0,
    radius=12e-9,
    drive_frequency=150e3,
    free_amplitude=94e-9,
    tip_modulus=160e9,
    tip_poisson_ratio=0.25,
)
GIVEN: dict[str, float] = {
    "poisson_ratio": 0.37,
    "intermolecular_distance": 0.25e-9,
    "half_angle": math.radians(20.0),
    "thickness": 80e-9,
    "exponent": 1.8,
}
UNKNOWN: dict[str, float] = {
    "modulus": 0.7e9,
    "stiffness": 6.0,
    "prefactor": 4e5,
    "adhesion": 11e-9,
    "viscosity": 40.0,
    "damping": 2e-6,
}
LINEAR = (
    "kelvin-voigt",
    "kelvin-voigt-adhesion",
    "hertz",
    "hertz-viscous",
    "dmt-contact",
    "dmt-linear",
    "dmt",
    "dmt-viscous",
    "cone",
    "flat-punch",
    "power",
    "thin-layer",
)
N_MAX = 5


def given_of(model: str) -> dict[str, float]:
    return {q.name: GIVEN[q.name] for q in contact_model(model).given if q.name in GIVEN}


def of_the_model(model: str, amplitude: float, indentation: float) -> np.ndarray:
    """Return the harmonics of the record itself, by its terms."""
    of_the_probe = {
        "radius": PROBE.tip.radius,
        "tip_modulus": PROBE.tip.modulus,
        "tip_poisson_ratio": PROBE.tip.poisson_ratio,
        "frequency": PROBE.drive.frequency,
    }
    record = contact_model(model)
    known = {q.name: of_the_probe[q.name] for q in record.given if q.name in of_the_probe}
    unknown = {q.name: UNKNOWN[q.name] for q in record.unknowns}
    return force_harmonics(
        model,
        amplitude=amplitude,
        indentation=indentation,
        n_max=N_MAX,
        **known,
        **given_of(model),
        **unknown,
    )


def filled(columns: Any, amplitude: float, Delta: float) -> np.ndarray:
    work = np.full((WORK_ROWS, N_MAX + 1), math.nan)
    fill_columns(columns, amplitude, Delta, N_MAX, work)
    return work


def test_linear_models_are_those_of_powers_attraction_and_loss() -> None:
    assert {m.key for m in models() if is_linear(m)} == set(LINEAR)


@pytest.mark.parametrize("model", ["jkr", "maugis", "sls", "capillary"])
def test_others_are_not_and_say_so(model: str) -> None:
    assert not is_linear(contact_model(model))
    with pytest.raises(InversionError, match=r"cannot be inverted.*dmt-viscous"):
        columns_of(contact_model(model), PROBE, GIVEN)


@pytest.mark.parametrize("Delta", [-0.01, 3e-4, 0.03, 0.4, 0.9])
@pytest.mark.parametrize("model", LINEAR)
def test_columns_give_back_the_model(model: str, Delta: float) -> None:
    amplitude = 43e-9
    record = contact_model(model)
    columns = columns_of(record, PROBE, given_of(model))
    names = [q.name for q in unknowns_of(record)]
    S, _ = stiffness(columns.contact, UNKNOWN[names[0]])
    F = UNKNOWN["adhesion"] if "adhesion" in names else 0.0
    work = filled(columns, amplitude, Delta)
    f = of_the_model(model, amplitude, 2.0 * amplitude * Delta)
    # a loss out of contact is none
    size = np.abs(f).max()
    np.testing.assert_allclose(S * work[0] + F * work[2], f.real, rtol=1e-9, atol=1e-11 * size)
    tangent = columns.loss * UNKNOWN[names[-1]] / S
    lost = -np.arange(N_MAX + 1) * tangent * S * work[0]
    np.testing.assert_allclose(lost, -f.imag, rtol=1e-9, atol=1e-11 * size)
    lossy = bool({"viscosity", "damping"} & set(names))
    assert (columns.loss > 0.0) == lossy
    assert np.any(f.imag[1:] != 0.0) == (lossy and Delta > 0.0)
    assert adhesive(columns) == ("adhesion" in names)


@pytest.mark.parametrize("model", LINEAR)
def test_derivatives_are_those_of_the_columns(model: str) -> None:
    columns = columns_of(contact_model(model), PROBE, given_of(model))
    for Delta in (2e-3, 0.1, 0.7):
        step = 1e-5 * Delta
        up, here, down = (filled(columns, 43e-9, Delta + k * step) for k in (1, 0, -1))
        for row in (0, 2):
            slope = (up[row] - down[row]) / (2.0 * step)
            np.testing.assert_allclose(here[row + 1], slope, rtol=1e-6, atol=1e-6 * np.abs(slope).max())


def test_the_elastic_column_vanishes_out_of_contact() -> None:
    work = filled(columns_of(contact_model("dmt"), PROBE, GIVEN), 43e-9, -1e-3)
    assert not work[:2].any()
    assert (np.abs(work[2]) > 0.0).all()


def test_a_harmonic_by_hand() -> None:
    """Of a linear spring: mean and first harmonic of k max(0, -d), by plain sums over the phase."""
    columns = columns_of(contact_model("kelvin-voigt"), PROBE, {})
    theta = (np.arange(200000) + 0.5) * 2.0 * math.pi / 200000
    depth = np.maximum(0.2 * 43e-9 - 43e-9 * (1.0 + np.cos(theta)), 0.0)
    work = filled(columns, 43e-9, 0.1)
    assert work[0, 0] == pytest.approx(depth.mean(), rel=1e-6, abs=0)
    assert work[0, 1] == pytest.approx(2.0 * (depth * np.cos(theta)).mean(), rel=1e-6, abs=0)


def test_unknowns_come_elastic_first_and_loss_last() -> None:
    names = {m.key: [q.name for q in unknowns_of(m)] for m in models() if is_linear(m)}
    assert names["dmt-viscous"] == ["modulus", "adhesion", "viscosity"]
    assert names["kelvin-voigt-adhesion"] == ["stiffness", "adhesion", "damping"]
    assert names["power"] == ["prefactor"]


def test_the_tip_and_the_drive_come_from_the_probe() -> None:
    record = contact_model("hertz-viscous")
    here = columns_of(record, PROBE, GIVEN)
    wider = columns_of(record, replace(PROBE, tip=replace(PROBE.tip, radius=48e-9)), GIVEN)
    faster = columns_of(record, replace(PROBE, drive=replace(PROBE.drive, frequency=300e3)), GIVEN)
    assert wider.contact.factor == pytest.approx(2.0 * here.contact.factor, rel=1e-12, abs=0)
    assert faster.loss == pytest.approx(2.0 * here.loss, rel=1e-12, abs=0)
    assert here.contact.tip_compliance == pytest.approx((1.0 - 0.25**2) / 160e9, rel=1e-12, abs=0)


def test_what_is_missing_is_named() -> None:
    with pytest.raises(InversionError, match="needs poisson_ratio"):
        columns_of(contact_model("dmt"), PROBE, {})
    with pytest.raises(InversionError, match="needs half_angle"):
        columns_of(contact_model("cone"), PROBE, {"poisson_ratio": 0.3})
    with pytest.raises(ContactModelError, match="poisson_ratio is out of range"):
        columns_of(contact_model("dmt"), PROBE, {"poisson_ratio": 0.8})
    with pytest.raises(ProbeError, match="no tip radius"):
        columns_of(contact_model("dmt"), replace(PROBE, tip=Tip()), GIVEN)
    # none is needed where no tip touches
    assert columns_of(contact_model("kelvin-voigt"), replace(PROBE, tip=Tip()), {}).loss > 0.0
