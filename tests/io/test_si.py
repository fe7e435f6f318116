import pytest

from overtone.io.si import to_si


@pytest.mark.parametrize(
    ("unit", "expected"),
    [
        ("nm", (1e-9, "m")),
        ("Degrees", (pytest.approx(0.017453292519943295), "rad")),
        ("mV", (1e-3, "V")),
        ("kHz", (1e3, "Hz")),
        ("pN/nm", (pytest.approx(1e-3), "N/m")),
        ("%", (0.01, "1")),
        ("A", (1.0, "A")),
        ("pA", (pytest.approx(1e-12, rel=1e-12, abs=0), "A")),
        ("amperes", (1.0, "A")),
        ("W/V", (1.0, "A")),
        ("T", None),
        ("", None),
        ("nm/", None),
        ("cubits", None),
        ("km^1000", None),
        ("m " * 1000, None),
    ],
)
def test_units_of_files(unit, expected):
    assert to_si(unit) == expected
