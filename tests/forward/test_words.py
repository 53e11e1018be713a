"""Numbers in words: digits by the rule of the Particle Data Group, units of the right size."""

import math

import pytest

from forward.readable import (
    and_error,
    duration,
    interval,
    number,
    per,
    percent,
    places,
    power_of_ten,
    quantity,
    rounded,
    scale,
    with_error,
)

pytestmark = pytest.mark.unit


@pytest.mark.parametrize(
    ("error", "expected"),
    [(0.100, 2), (0.354, 2), (0.356, 1), (0.94, 1), (1.0, 1), (3.5, 1), (3.6, 0), (12.0, 0), (36.0, -1), (1.2e-5, 6)],
)
def test_places_of_errors(error, expected):
    """Two digits from 10 to 35, one from 36 to 94."""
    assert places(error) == expected


@pytest.mark.parametrize(
    ("value", "error", "expected"),
    [
        (0.122791, 0.000151, "0.12279 ± 0.00015"),
        (12.31142, 0.0091, "12.311 ± 0.009"),
        (-3.14159, 0.027, "−3.142 ± 0.027"),
        (1234.5, 56.0, "1,230 ± 60"),
        (0.827, 0.119, "0.83 ± 0.12"),
        (0.827, 0.367, "0.8 ± 0.4"),
        (1.5e-9, 2e-11, "(1.500 ± 0.020) × 10⁻⁹"),
        (2e7, 4e5, "(2.00 ± 0.04) × 10⁷"),
    ],
)
def test_values_with_errors(value, error, expected):
    assert with_error(value, error) == expected


def test_numbers():
    assert [number(x) for x in (0.0, 123456.0, 1.23456e-5, math.nan, -math.inf)] == [
        "0",
        "123,500",
        "1.235 × 10⁻⁵",
        "–",
        "−∞",
    ]
    assert rounded(0.1234567, 1e-9) == "0.123457"
    assert power_of_ten(-12) == "10⁻¹²"
    assert [duration(s) for s in (0.234, 35.0, 250.0, 11_100.0)] == ["0.23 s", "35 s", "4 min 10 s", "3 h 05 min"]
    assert (per("m", "Pa"), per("m", "N/m"), per("J", "1")) == ("m/Pa", "m/(N/m)", "J")


@pytest.mark.parametrize(
    ("value", "unit", "expected"),
    [
        (0.12, "m", (1e-2, "cm")),
        (2.0, "m", (1.0, "m")),
        (-3e-4, "m", (1e-6, "µm")),
        (5e3, "Pa", (1e3, "kPa")),
        (2e-5, "m²", (1e-6, "mm²")),
        (2e-4, "m²", (1e-4, "cm²")),
        (3e-6, "m³", (1e-6, "cm³")),
        (3e-7, "m³", (1e-9, "mm³")),
        (0.02, "N/m", (1e-3, "mN/m")),
        (0.0, "m", (1.0, "m")),
        (5.0, "1", (1.0, "1")),
    ],
)
def test_units_of_the_right_size(value, unit, expected):
    assert scale(value, unit) == expected


def test_quantities():
    assert quantity(0.12279, 0.00015, "m") == "12.279\u00a0cm"
    assert and_error(0.12311, 0.00009, "m") == "12.311 ± 0.009\u00a0cm"
    assert interval(0.11, 0.137, "m", 0.12) == "11.0–13.7\u00a0cm"
    assert [percent(p) for p in (0.71, 0.032, 1e-4, 0.9996, 1.0)] == [
        "71\u00a0%",
        "3.2\u00a0%",
        "below 0.1\u00a0%",
        "above 99.9\u00a0%",
        "100\u00a0%",
    ]
