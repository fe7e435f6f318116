import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from overtone.errors import OvertoneError, UnitError
from overtone.units import (
    conversion_factor,
    display_unit,
    format_quantity,
    parse_amplitude_density,
    parse_quantity,
)


@pytest.mark.parametrize(
    ("text", "unit", "value"),
    [
        ("94 nm", "m", 94e-9),
        ("94nm", "m", 94e-9),
        ("16.4 N/m", "N/m", 16.4),
        ("16.4 pN/pm", "N/m", 16.4),
        ("161.8 kHz", "Hz", 161.8e3),
        ("1.93 GPa", "Pa", 1.93e9),
        ("90 deg", "rad", math.pi / 2),
        ("1.1 keV", "J", 1.1e3 * 1.602176634e-19),
        ("41.497 nm/V", "m/V", 41.497e-9),
        ("2 Å", "m", 0.2e-9),
        ("5 µm", "m", 5e-6),
        ("3 mPa s", "Pa s", 3e-3),
        ("72 mJ/m^2", "J/m^2", 0.072),
        ("0.35", "1", 0.35),
        ("70 %", "1", 0.7),
    ],
)
def test_text_with_a_unit_becomes_si(text: str, unit: str, value: float) -> None:
    assert parse_quantity(text, unit) == pytest.approx(value, rel=1e-14, abs=0)


@pytest.mark.parametrize(
    ("text", "unit", "word"),
    [
        ("94", "m", "no unit"),
        ("94 nm", "N/m", "does not fit"),
        ("94 furlong", "m", "unknown unit"),
        ("nm", "m", "not a number"),
        ("94 nm/", "m", "incomplete"),
        ("1 rad", "1", "does not fit"),
        ("1 km^1000", "m", "at most 6"),
        ("", "m", "not a number"),
    ],
)
def test_a_unit_that_does_not_fit_is_named(text: str, unit: str, word: str) -> None:
    with pytest.raises(UnitError, match=word) as caught:
        parse_quantity(text, unit, "free_amplitude")
    assert isinstance(caught.value, OvertoneError)


@given(st.floats(1e-15, 1e14), st.sampled_from(["m", "N", "Pa", "Hz", "J", "V"]))
def test_displayed_values_read_back(value: float, unit: str) -> None:
    display = display_unit(value, unit)
    assert parse_quantity(f"{value * display.factor!r} {display.label}", unit) == pytest.approx(
        value, rel=1e-12, abs=0
    )


def test_conversion_inverts() -> None:
    assert conversion_factor("nm", "pm") == pytest.approx(1000.0)
    assert conversion_factor("deg", "rad") * conversion_factor("rad", "deg") == pytest.approx(1.0)


def test_what_is_not_a_number_is_not_printed_as_one() -> None:
    assert format_quantity(math.nan, "Pa") == "-"
    assert format_quantity(0.0, "m") == "0 m"


@pytest.mark.parametrize(
    ("text", "unit", "value"),
    [
        ("50 fm/rtHz", "m", 50e-15),
        ("50fm/ rtHz ", "m", 50e-15),
        ("0.05 pm/sqrt(Hz)", "m", 50e-15),
        ("0.05 pm / sqrtHz", "m", 50e-15),
        ("1e-13 m/√Hz", "m", 1e-13),
        ("700 nV/√(Hz)", "V", 700e-9),
    ],
)
def test_amplitude_densities_become_si(text: str, unit: str, value: float) -> None:
    assert parse_amplitude_density(text, unit) == pytest.approx(value, rel=1e-14, abs=0)


@pytest.mark.parametrize(
    ("text", "word"),
    [
        ("50 fm", "no amplitude density"),
        ("50 fm/Hz", "no amplitude density"),
        ("50 fm^2/Hz", "no amplitude density"),
        ("50 fm/sqrt(Hz", "no amplitude density"),
        ("50 rtHz", "no amplitude density"),
        ("50 nV/rtHz", "does not fit"),
        ("50 /rtHz", "no unit"),
        ("fm/rtHz", "not a number"),
    ],
)
def test_what_is_no_amplitude_density_is_named(text: str, word: str) -> None:
    with pytest.raises(UnitError, match=f"detector.*{word}"):
        parse_amplitude_density(text, "m", "detector")
