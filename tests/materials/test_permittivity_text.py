"""The text of a complex permittivity: loss has a minus, gain a plus, and the text is parsed back."""

import re

import pytest
from hypothesis import given, strategies as st

from polysight.materials import format_permittivity


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (2.89 - 0.43j, "2.89 - j0.43"),
        (2.89 + 27.3j, "2.89 + j27.30"),
        # Zero has the sign of a loss: exactly, rounded from a gain, and in the real part without a minus.
        (4 + 0j, "4.00 - j0.00"),
        (4 + 0.001j, "4.00 - j0.00"),
        (complex(-0.001, -0.0), "0.00 - j0.00"),
        (complex(float("inf"), 0), "inf - j0.00"),
        (complex(float("nan"), float("nan")), "nan - jnan"),
    ],
)
def test_a_loss_has_a_minus_and_a_gain_a_plus(value, text):
    assert format_permittivity(value) == text


def test_the_real_part_may_be_padded_and_the_digits_chosen():
    assert format_permittivity(2.89 - 0.43j, width=6) == "  2.89 - j0.43"
    assert format_permittivity(2.891 - 0.434j, digits=3) == "2.891 - j0.434"


@given(st.floats(-1e6, 1e6), st.floats(-1e6, 1e6))
def test_a_text_has_the_permittivity_to_two_digits(real, imag):
    match = re.fullmatch(r"(-?[0-9.]+) ([-+]) j([0-9.]+)", format_permittivity(complex(real, imag)))
    assert match is not None
    # Rounded to 0.01, which is wrong by 0.005 at most.
    assert float(match[1]) == pytest.approx(real, abs=0.006)
    assert float(match[2] + match[3]) == pytest.approx(imag, abs=0.006)
