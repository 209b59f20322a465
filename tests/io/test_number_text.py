"""Numbers as text: values with errors follow the rounding rule of the Particle Data Group."""

import math

import pytest

from spotcheck.io.number_text import number_text, quantity_text, rounded_text, two_digits


@pytest.mark.parametrize(
    ("value", "stderr", "unit", "text"),
    [
        (0.0239, 0.0004, "1", "0.0239 ± 0.0004"),
        (-29.2, 0.35, "px", "−29.20 ± 0.35 px"),
        (0.8159, 0.0045, "px", "0.816 ± 0.004 px"),
        (1.23e-5, 4.2e-7, "s", "12.3 ± 0.4 µs"),
        (1.50432e-4, 1.13e-6, "m", "150.4 ± 1.1 µm"),
        (12.3, 1.4, "deg", "12.3 ± 1.4°"),
        (30022.4, 123.0, "px/s", "30020 ± 120 px/s"),
        (30022.4, 98.0, "px/s", "30020 ± 100 px/s"),
        (-3.2e-8, 1.1e-9, "1", "(−3.20 ± 0.11)×10⁻⁸"),
        (0.0, 2e-9, "1", "(0.0 ± 2.0)×10⁻⁹"),
        (0.25, 0.003, "DN/e-", "0.2500 ± 0.0030 DN/e-"),
        # Without a usable error, the value has four digits.
        (851.3, None, "DN", "851.3 DN"),
        (851.3, 0.0, "DN", "851.3 DN"),
        (851.3, math.nan, "DN", "851.3 DN"),
        (30022.4, None, "px/s", "30022 px/s"),
        (2.5e-4, 0.0, "1", "0.00025"),
        (0.0, None, "s", "0 s"),
        (30.0, math.inf, "degree", "30 ± ∞°"),
        (None, 0.1, "px", "no value"),
        (math.nan, 0.1, "px", "no value"),
    ],
)
def test_values_with_their_errors(value, stderr, unit, text):
    assert quantity_text(value, stderr, unit) == text


@pytest.mark.parametrize(
    ("stderr", "text"),
    [(0.354, "5.12 ± 0.35"), (0.356, "5.1 ± 0.4"), (0.949, "5.1 ± 0.9"), (0.951, "5.1 ± 1.0"), (0.1, "5.12 ± 0.10")],
)
def test_errors_have_the_digits_of_the_particle_data_group(stderr, text):
    """The rule: three highest digits from 100 to 354 give two digits, to 949 one, above they are rounded to 1000."""
    assert quantity_text(5.123, stderr) == text


def test_a_value_can_be_rounded_as_its_error_demands():
    assert [rounded_text(-5.123, error) for error in (0.11, 0.5, 30.0)] == ["−5.12", "−5.1", "−5"]


def test_numbers_without_errors():
    assert [number_text(x) for x in (1.0, 5440.0, 961000.0, -2e-7, 9.996, None, math.nan)] == [
        "1.00", "5440", "9.61 · 10⁵", "−2.00 · 10⁻⁷", "10.0", "–", "–",
    ]  # fmt: skip
    assert [two_digits(x) for x in (0, 360, 0.05, 2.5e-16, 2.65e14)] == [
        "0", "360", "0.05", "2.5 · 10⁻¹⁶", "2.6 · 10¹⁴",
    ]  # fmt: skip
