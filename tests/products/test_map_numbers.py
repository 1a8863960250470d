"""Levels, ranges of colours, texts of number ranges and names for MATLAB, as maps and exports have them."""

import numpy as np
import pytest

from polysight.products.exports import _make_matlab_name, format_ranges
from polysight.products.maps import _find_ratio_limits_db, level_db, percentile


@pytest.mark.parametrize(
    ("numbers", "text"),
    [
        ([], "none"), ([3], "3"), ([3, 4], "3-4"), ([3, 5], "3, 5"), ([3, 7, 8, 9], "3, 7-9"),
        ([0, 1, 2, 4, 6, 7], "0-2, 4, 6-7"),
    ],
)  # fmt: skip
def test_numbers_are_written_as_ranges(numbers, text):
    assert format_ranges(numbers) == text


def test_levels_are_decibels_of_amplitudes():
    levels = level_db(np.array([1.0, 10.0j, -0.1, 2.0, 0.0, np.nan, np.inf]))
    # 20 log10(2) = 6.0206.
    np.testing.assert_allclose(levels[:4], [0.0, 20.0, -20.0, 6.0206], atol=1e-4)
    # Zero and values that are not finite have one level, far below any level of an image.
    assert len(set(levels[4:].tolist())) == 1
    assert levels[4] < -100


def test_a_percentile_is_of_the_pixels_of_a_mask():
    values = np.array([[0.0, 10.0], [20.0, 1000.0]])
    mask = np.array([[True, True], [True, False]])
    assert percentile(values, mask, 50) == 10.0
    assert percentile(values, mask, 100) == 20.0
    # Without any pixel it is the default.
    no_pixel = np.zeros((2, 2), bool)
    assert percentile(values, no_pixel, 50, default=-3.0) == -3.0


@pytest.mark.parametrize(
    ("patches_db", "limits"),
    [
        # A decibel more on either side, rounded outwards to whole decibels; the range always begins below 0 dB.
        ([0.5, 6.2], (-1.0, 8.0)), ([-2.5, 6.0], (-4.0, 7.0)), ([3.0, 9.0], (-1.0, 10.0)),
    ],
)  # fmt: skip
def test_ratios_have_the_range_of_the_patches(patches_db, limits):
    level = np.full((2, 2), 50.0)
    low, high = _find_ratio_limits_db(level, np.ones((2, 2), bool), patches_db)
    assert (low, high) == limits


def test_without_patches_ratios_have_the_range_of_the_opaque_pixels():
    # Opaque pixels from -5 to 14 dB, and transparent ones of 90 dB.
    level = np.linspace(-5.0, 15.0, 2001)
    level[1900:] = 90.0
    opaque = np.arange(2001) < 1900
    low, high = _find_ratio_limits_db(level, opaque, [])
    # The range is that of percentiles near the ends of the levels, rounded to whole decibels.
    assert -6.0 <= low <= -4.0
    assert 12.0 <= high <= 15.0


def test_without_opaque_pixels_the_range_of_ratios_is_not_empty():
    low, high = _find_ratio_limits_db(np.full(10, 5.0), np.zeros(10, bool), [])
    assert low < high


def test_patches_of_nearly_one_ratio_have_a_range_of_six_decibels():
    """The colours cover six decibels at least, because noise must not look like a difference."""
    low, high = _find_ratio_limits_db(np.linspace(-5.0, 15.0, 10), np.ones(10, bool), [-40.0, -39.5])
    # A decibel below the lowest patch, as above
    assert low == -41.0
    assert high == low + 6.0


@pytest.mark.parametrize(
    ("key", "name"),
    [("rms", "rms"), ("2nd", "x2nd"), ("_a", "x_a"), ("a b/c", "a_b_c"), ("", "x"), ("a" * 100, "a" * 63)],
)
def test_names_for_matlab_begin_with_a_letter(key, name):
    assert _make_matlab_name(key) == name
