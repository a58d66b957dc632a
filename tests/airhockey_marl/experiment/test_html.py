"""Numbers on pages and pictures."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from airhockey_marl.experiment.html import WIDTH, number


@given(st.floats() | st.none() | st.integers(-(10**300), 10**300), st.integers(0, 6))
def test_a_number_of_any_magnitude_is_short(value, digits):
    text = number(value, digits)
    assert 0 < len(text) <= WIDTH
    if value is not None and abs(value) < 1e308:  # rounded up, larger ones are infinite
        shown = float(text.replace("−", "-"))
        assert shown == pytest.approx(float(value), rel=0.06, abs=0.51 * 10.0**-digits)


@pytest.mark.parametrize(
    ("value", "digits", "text"),
    [
        (1e300, 2, "1.0e300"),
        (-1e300, 2, "−1.0e300"),
        (math.nan, 2, "–"),
        (None, 2, "–"),
        (-math.inf, 3, "−∞"),
        (-0.0, 2, "0.00"),
        (-0.004, 2, "0.00"),
        (-1.5, 1, "−1.5"),
        (12345.678, 3, "12345.7"),
        (79228162514264337593543950336.0, 2, "7.9e28"),
    ],
)
def test_numbers(value, digits, text):
    assert number(value, digits) == text
