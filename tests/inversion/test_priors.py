"""What is known beforehand: defaults that are wide, statements that fit, and the same numbers in the kernel."""

import math

import pytest

from overtone.contact.models import contact_model, models
from overtone.errors import InversionError
from overtone.inversion.columns import is_linear, unknowns_of
from overtone.inversion.priors import (
    CONTACT,
    DEFAULTS,
    LOG_NORMAL,
    LOG_RANGE,
    NORMAL,
    RANGE,
    Prior,
    complete_priors,
    for_kernel,
    format_priors,
    interval_width,
)

DMT, VISCOUS = contact_model("dmt"), contact_model("dmt-viscous")


@pytest.mark.parametrize(
    ("kind", "first", "second"),
    [
        (LOG_RANGE, 0.0, 1.0),
        (LOG_RANGE, -1.0, 1.0),
        (LOG_RANGE, 2.0, 1.0),
        (LOG_RANGE, 1.0, 1.0),
        (RANGE, -1e-9, 1e-9),
        (RANGE, 1.0, 0.5),
        (RANGE, 0.0, math.inf),
        (LOG_NORMAL, 1e9, 1.0),
        (LOG_NORMAL, 1e9, 0.5),
        (LOG_NORMAL, 0.0, 2.0),
        (NORMAL, 1e-9, 0.0),
        (NORMAL, math.nan, 1e-9),
        ("gamma", 1.0, 2.0),
    ],
)
def test_numbers_that_make_no_distribution(kind: str, first: float, second: float) -> None:
    with pytest.raises(InversionError, match="a prior makes no distribution"):
        Prior(kind, first, second)


@pytest.mark.parametrize(
    ("kind", "first", "second"),
    [(RANGE, 0.0, 1.0), (NORMAL, 0.0, 1e-9), (NORMAL, -1e-9, 1e-9), (LOG_NORMAL, 1e9, 1.01)],
)
def test_numbers_that_do(kind: str, first: float, second: float) -> None:
    assert Prior(kind, first, second).kind == kind


def test_every_model_has_a_prior_of_every_unknown() -> None:
    for record in (m for m in models() if is_linear(m)):
        priors = complete_priors(None, record, 10e-9)
        names = [q.name for q in unknowns_of(record)]
        lossy = {"viscosity", "damping"} & set(names)
        expected = (
            {names[0], "indentation"} | ({"adhesion"} & set(names)) | ({"loss_tangent"} if lossy else set())
        )
        assert set(priors) == expected


def test_the_adhesion_follows_the_radius() -> None:
    """Half-normal of 2 pi R w at w = 0.3 J/m^2; without a tip a fixed force."""
    prior = complete_priors(None, DMT, 10e-9)["adhesion"]
    assert (prior.kind, prior.first) == (NORMAL, 0.0)
    assert prior.second == pytest.approx(18.85e-9, rel=1e-3, abs=0)
    assert complete_priors(None, DMT, 40e-9)["adhesion"].second == pytest.approx(
        4.0 * prior.second, rel=1e-12, abs=0
    )
    assert complete_priors(None, DMT, None)["adhesion"] == DEFAULTS["adhesion"]


def test_statements_replace_defaults_and_leave_the_others() -> None:
    stated = {"modulus": Prior(LOG_NORMAL, 2e9, 3.0), "adhesion": Prior(RANGE, 0.0, 50e-9)}
    priors = complete_priors(stated, VISCOUS, 10e-9)
    assert priors["modulus"] == stated["modulus"]
    assert priors["adhesion"] == stated["adhesion"]
    assert priors["loss_tangent"] == DEFAULTS["loss_tangent"]
    assert priors["indentation"] == DEFAULTS["indentation"]
    # of what the model does not have nothing is taken: several models share one statement
    assert "adhesion" not in complete_priors(stated, contact_model("hertz"), 10e-9)


@pytest.mark.parametrize(
    ("name", "prior", "match"),
    [
        ("Modulus", Prior(LOG_RANGE, 1e6, 1e9), "'Modulus' has no prior.*modulus, stiffness"),
        ("viscosity", Prior(LOG_RANGE, 1.0, 1e3), "'viscosity' has no prior"),
        ("modulus", Prior(RANGE, 1e6, 1e9), "a prior of modulus does not fit.*log-range or log-normal"),
        ("modulus", Prior(NORMAL, 1e9, 1e8), "a prior of modulus does not fit"),
        ("adhesion", Prior(LOG_NORMAL, 1e-9, 2.0), "a prior of adhesion does not fit.*range or normal"),
        ("indentation", Prior(RANGE, 0.0, 1e-8), "a prior of indentation does not fit"),
        ("loss_tangent", Prior(NORMAL, 0.1, 0.1), "a prior of loss_tangent does not fit"),
    ],
)
def test_statements_that_do_not_fit(name: str, prior: Prior, match: str) -> None:
    with pytest.raises(InversionError, match=match):
        complete_priors({name: prior}, DMT, 10e-9)


def test_the_width_of_an_interval() -> None:
    """By hand: 90 % of a range, and 3.29 deviations of a normal; of the logarithm where ratios count."""
    assert interval_width(Prior(LOG_RANGE, 1e6, 1e9)) == pytest.approx(0.9 * math.log(1e3), rel=1e-12)
    assert interval_width(Prior(LOG_NORMAL, 1e9, 2.0)) == pytest.approx(3.2897 * math.log(2.0), rel=1e-4)
    assert interval_width(Prior(RANGE, 1e-9, 11e-9)) == pytest.approx(9e-9, rel=1e-12, abs=0)
    assert interval_width(Prior(NORMAL, 5e-9, 1e-9)) == pytest.approx(3.2897e-9, rel=1e-4, abs=0)


def test_the_kernel_takes_the_same_numbers() -> None:
    kernel = for_kernel(complete_priors(None, VISCOUS, 10e-9), "modulus")
    assert (kernel.log_low, kernel.log_high) == pytest.approx((math.log(1e6), math.log(3e11)), rel=1e-12)
    assert kernel.precision == 0.0
    scale = 2.0 * math.pi * 10e-9 * 0.3
    assert kernel.adhesion_precision == pytest.approx(scale**-2, rel=1e-12, abs=0)
    assert (kernel.adhesion_low, kernel.adhesion_mean) == (0.0, 0.0)
    assert kernel.adhesion_high == pytest.approx(6.0 * scale, rel=1e-12, abs=0)
    assert (kernel.tangent_high, kernel.shallowest, kernel.contact) == (2.0, 1e-11, CONTACT)


def test_stated_kinds_in_the_kernel() -> None:
    stated = {
        "modulus": Prior(LOG_NORMAL, 2e9, 3.0),
        "adhesion": Prior(RANGE, 1e-9, 50e-9),
        "loss_tangent": Prior(RANGE, 0.0, 0.5),
        "indentation": Prior(LOG_RANGE, 1e-10, 1e-7),
    }
    kernel = for_kernel(complete_priors(stated, VISCOUS, 10e-9), "modulus")
    assert kernel.centre == pytest.approx(math.log(2e9), rel=1e-12)
    assert kernel.precision == pytest.approx(math.log(3.0) ** -2, rel=1e-12)
    assert kernel.log_high - kernel.centre == pytest.approx(6.0 * math.log(3.0), rel=1e-12)
    assert kernel.centre - kernel.log_low == pytest.approx(6.0 * math.log(3.0), rel=1e-12)
    assert (kernel.adhesion_low, kernel.adhesion_high, kernel.adhesion_precision) == (1e-9, 50e-9, 0.0)
    assert kernel.tangent_high == 0.5
    assert kernel.shallowest == 1e-10
    normal = for_kernel(complete_priors({"adhesion": Prior(NORMAL, 12e-9, 2e-9)}, DMT, 10e-9), "modulus")
    assert normal.adhesion_mean == 12e-9
    assert normal.adhesion_high == pytest.approx(24e-9, rel=1e-12, abs=0)
    assert normal.adhesion_low == 0.0


@pytest.mark.parametrize(
    ("stated", "name"),
    [
        ({"indentation": Prior(LOG_RANGE, 1e-11, 5e-9)}, "indentation"),
        ({"loss_tangent": Prior(RANGE, 0.2, 0.5)}, "loss_tangent"),
    ],
)
def test_no_bound_that_was_stated_is_dropped(stated: dict[str, Prior], name: str) -> None:
    """A statement that the kernel cannot keep is refused, or kept: never taken as another one."""
    try:
        priors = complete_priors(stated, VISCOUS, 10e-9)
    except InversionError:
        return
    wider = {"indentation": Prior(LOG_RANGE, 1e-11, 1e-6), "loss_tangent": Prior(RANGE, 0.0, 0.5)}[name]
    other = complete_priors({name: wider}, VISCOUS, 10e-9)
    assert for_kernel(priors, "modulus") != for_kernel(other, "modulus")


def test_priors_are_recorded_in_one_line() -> None:
    line = format_priors({"modulus": Prior(LOG_RANGE, 1e6, 3e11), "adhesion": Prior(NORMAL, 0.0, 19e-9)})
    assert line == "modulus log-range 1e+06 3e+11; adhesion normal 0 1.9e-08"
