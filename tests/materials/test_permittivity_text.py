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
        (4 + 0j, "4.00 - j0.00"),
        (4 + 0.001j, "4.00 - j0.00"),
        (complex(-0.001, -0.0), "0.00 - j0.00"),
        (complex(float("inf"), 0), "inf - j0.00"),
        (complex(float("nan"), float("nan")), "nan - jnan"),
    ],
)
def test_loss_is_minus_gain_is_plus(value, text):
    assert format_permittivity(value) == text


def test_parts_line_up_in_columns():
    assert format_permittivity(2.89 - 0.43j, width=6) == "  2.89 - j0.43"
    assert format_permittivity(2.891 - 0.434j, digits=3) == "2.891 - j0.434"


@given(st.floats(-1e6, 1e6), st.floats(-1e6, 1e6))
def test_what_is_written_reads_back(real, imag):
    match = re.fullmatch(r"(-?[0-9.]+) ([-+]) j([0-9.]+)", format_permittivity(complex(real, imag)))
    assert match is not None
    assert float(match[1]) == pytest.approx(real, abs=0.006)
    assert float(match[2] + match[3]) == pytest.approx(imag, abs=0.006)
