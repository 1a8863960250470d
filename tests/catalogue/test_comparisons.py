"""Two scans are compared pixel by pixel and patch by patch.

The pixels and patches are made by the tests. They have places, differences, errors of the differences, and notes about
what limits the comparison.
"""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from tests.support.refusals import expect_refusal

from polysight.catalogue.results import Comparison, compare_pixels, draw_comparison
from polysight.results import PatchFigures, PermittivityFigures
from polysight_shared.errors import ErrorCode

NAMES = ("first", "second")
# The difference of an unchanged pixel is complex noise. If its real and its imaginary part have a standard deviation of
# 1, its magnitude has a Rayleigh distribution with the median sqrt(2 ln 2) = 1.18.
UNCHANGED_MEDIAN = (2 * np.log(2)) ** 0.5
# The standard deviation of a difference of two pixels with errors of 0.3.
DIFFERENCE_STD = 0.3 * 2**0.5


def make_pixels(p: complex = 1.0, x0_mm: float = 0.0, **changes: Any) -> Any:
    """Pixels of 2 mm, 4 in x and 3 in y; all are clear (bright enough), and have the same ratio and permittivity.

    The permittivity is four times the ratio, so that a test tells one from the other.
    """
    shape = (3, 4)
    fields: dict[str, Any] = {
        "referenced": True,
        "x_mm": x0_mm + 2.0 * np.arange(4),
        "y_mm": 2.0 * np.arange(3),
        "clear": np.ones(shape, bool),
        "p": np.full(shape, p),
        "p_std": np.full(shape, 0.3),
        "permittivity": SimpleNamespace(mask=np.ones(shape, bool), value=np.full(shape, 4 * p)),
        "theta_rad": np.radians(44.0),
        "simulated": False,
        "segments": [],
        "extent_mm": (-1.0, 7.0, -1.0, 5.0),
    }
    return SimpleNamespace(**(fields | changes))


def compare(a: Any, b: Any) -> Comparison:
    return compare_pixels(a, b, NAMES)


def test_a_difference_is_the_first_scan_minus_the_second():
    comparison = compare(make_pixels(2.0), make_pixels(0.5 + 1j, p_std=np.full((3, 4), 0.4)))
    assert (comparison.p == 1.5 - 1j).all()
    assert (comparison.permittivity == 4 * (1.5 - 1j)).all()
    # Independent errors of 0.3 and 0.4 are 0.5 together: the root of the sum of squares.
    assert comparison.sigmas == pytest.approx(abs(1.5 - 1j) / 0.5)
    # The pixels differ by more than their stated errors. The scatter is never above 1: the errors count in full.
    assert comparison.figures.scatter == 1.0
    assert comparison.figures.significant_share == 1.0
    assert comparison.figures.compared == 3 * 4
    assert comparison.figures.notes == []


@pytest.mark.parametrize(("sigmas", "share"), [(2.99, 0.0), (3.01, 0.25)])
def test_a_difference_of_more_than_three_standard_deviations_is_significant(sigmas, share):
    """One column of four differs by so many standard deviations; the others scatter as their errors say.

    The scatter is estimated from the median magnitude alone, so all three unchanged columns may have this median.
    """
    differences = np.full((3, 4), UNCHANGED_MEDIAN * DIFFERENCE_STD)
    differences[:, 0] = sigmas * DIFFERENCE_STD
    first = make_pixels()
    first.p = 1 + differences
    assert compare(first, make_pixels(1.0)).figures.significant_share == share


# Columns of the first scan, at x = 0, 2, 4 and 6 mm, that have a pixel of the shifted second scan within 1 mm.
@pytest.mark.parametrize(
    ("shift_mm", "columns"),
    [(0.0, [0, 1, 2, 3]), (1.0, [0, 1, 2, 3]), (1.1, [1, 2, 3]), (4.0, [2, 3]), (-4.0, [0, 1]), (6.9, [3])],
)
def test_pixels_within_half_a_pixel_are_at_one_place(shift_mm, columns):
    comparison = compare(make_pixels(2.0), make_pixels(1.0, x0_mm=shift_mm))
    is_compared = np.isfinite(comparison.p)
    compared_columns = np.zeros((3, 4), bool)
    compared_columns[:, columns] = True
    assert is_compared.tolist() == compared_columns.tolist()
    assert comparison.figures.compared == 3 * len(columns)


def test_scans_without_a_common_place_have_nothing_to_compare():
    with expect_refusal(ErrorCode.MISMATCH, "no area in common"):
        compare(make_pixels(), make_pixels(x0_mm=8.1))
    nowhere = np.zeros((3, 4), bool)
    with expect_refusal(ErrorCode.MISMATCH):
        compare(make_pixels(), make_pixels(clear=nowhere))


def test_a_scan_without_a_metal_reference_has_nothing_to_compare_and_is_named():
    for is_first_referenced, is_second_referenced, name in ((False, True, "first"), (True, False, "second")):
        with expect_refusal(ErrorCode.NO_DATA, name):
            compare(make_pixels(referenced=is_first_referenced), make_pixels(referenced=is_second_referenced))


def test_only_pixels_that_are_clear_and_known_in_both_scans_are_compared():
    clear_a = np.ones((3, 4), bool)
    clear_a[0, 0] = False
    clear_b = np.ones((3, 4), bool)
    clear_b[1, 1] = False
    known = np.ones((3, 4), bool)
    known[2, 2] = False
    b = make_pixels(clear=clear_b)
    b.permittivity.mask = known
    comparison = compare(make_pixels(2.0, clear=clear_a), b)
    assert np.argwhere(np.isnan(comparison.p)).tolist() == [[0, 0], [1, 1]]
    assert np.argwhere(np.isnan(comparison.permittivity)).tolist() == [[0, 0], [1, 1], [2, 2]]


@pytest.mark.parametrize(
    ("changes", "note"),
    [
        ({"theta_rad": np.radians(44.4)}, None),
        ({"theta_rad": np.radians(44.6)}, "44.0 and 44.6 degrees"),
        ({"theta_rad": np.radians(43.4)}, "44.0 and 43.4 degrees"),
        ({"simulated": True}, "one of the two is simulated"),
        ({"p_std": np.full((3, 4), np.nan)}, "errors of one are not known"),
    ],
)
def test_what_limits_a_comparison_is_a_note(changes, note):
    """Angles of incidence may differ by half a degree; the first scan has 44 degrees."""
    notes = compare(make_pixels(2.0), make_pixels(1.0, **changes)).figures.notes
    if note is None:
        assert notes == []
    else:
        (only_note,) = notes
        assert note in only_note


def test_scans_that_share_their_errors_are_compared_in_units_of_their_scatter():
    """Errors that both scans share cancel in the difference: unchanged pixels scatter less than the stated errors."""
    comparison = compare(make_pixels(1.1), make_pixels(1.0))
    # All pixels differ by 0.1, less than unchanged pixels with independent errors would.
    scatter = 0.1 / DIFFERENCE_STD / UNCHANGED_MEDIAN
    assert comparison.figures.scatter == round(scatter, 3)
    assert f"{scatter:.2f} of their stated errors" in comparison.figures.notes[0]
    # In units of errors that are smaller by this factor they scatter as unchanged pixels do.
    assert comparison.sigmas == pytest.approx(UNCHANGED_MEDIAN)


def test_errors_that_are_not_known_leave_a_comparison_without_significance():
    figures = compare(make_pixels(2.0, p_std=np.full((3, 4), np.nan)), make_pixels(1.0)).figures
    assert figures.significant_share is None
    assert figures.scatter is None
    assert figures.compared == 3 * 4


def make_patch(x_mm: float, y_mm: float, real: float = 3.0, imag: float = -0.5, **changes: Any) -> PatchFigures:
    """A patch of PET, 10 x 16 mm about this place, with errors of 0.3 and 0.4 of its permittivity's parts."""
    value = PermittivityFigures(real=real, imag=imag, covariance=[[0.09, 0.0], [0.0, 0.16]])
    box_mm = (x_mm - 5, y_mm - 8, x_mm + 5, y_mm + 8)
    fields: dict[str, Any] = {"label": 1, "name": "PET", "box_mm": box_mm, "permittivity": value}
    return PatchFigures(**(fields | changes))


def pair_patches(first: list[PatchFigures], second: list[PatchFigures]) -> list[Any]:
    """The patches of two scans that are compared with each other."""
    return compare(make_pixels(2.0, segments=first), make_pixels(1.0, segments=second)).figures.patches


# A triangle with sides of 9, 12 and 15 mm has a right angle.
@pytest.mark.parametrize(("x_mm", "y_mm", "pairs"), [(9.0, 12.0, 1), (9.1, 12.0, 0), (-9.0, -12.0, 1), (0.0, 15.1, 0)])
def test_patches_whose_centres_are_within_15_mm_are_one_plate(x_mm, y_mm, pairs):
    assert len(pair_patches([make_patch(0.0, 0.0)], [make_patch(x_mm, y_mm)])) == pairs


def test_a_patch_is_compared_with_the_nearest_one_and_never_with_the_metal():
    near = make_patch(3.0, 0.0, label=7)
    far = make_patch(0.0, 5.0, label=8)
    metal = make_patch(0.0, 0.0, label=9, metal_reference=True)
    (compared,) = pair_patches([make_patch(0.04, 0.06, label=2), metal], [far, metal, near])
    assert compared.labels == (2, 7)
    assert compared.names == ("PET", "PET")
    # The centre of the first scan's patch, rounded to 0.1 mm.
    assert compared.place_mm == (0.0, 0.1)
    assert pair_patches([make_patch(0.0, 0.0)], [metal]) == []


def test_a_difference_of_two_patches_has_the_errors_of_both():
    """Variances of 0.09 and 0.16 of real and imaginary part are twice as large for a difference."""
    (compared,) = pair_patches([make_patch(0.0, 0.0)], [make_patch(0.0, 0.0, real=2.4, imag=-0.1)])
    assert (compared.difference.real, compared.difference.imag) == (0.6, -0.4)
    assert compared.difference.real_std == round((2 * 0.09) ** 0.5, 4)
    assert compared.difference.imag_std == round((2 * 0.16) ** 0.5, 4)
    assert compared.sigmas == round((0.6**2 / (2 * 0.09) + 0.4**2 / (2 * 0.16)) ** 0.5, 2)


@pytest.mark.parametrize("covariance", [None, [[0.0, 0.0], [0.0, 0.0]], [[float("nan"), 0.0], [0.0, 1.0]]])
def test_without_an_error_a_difference_of_two_patches_has_no_significance(covariance):
    value = PermittivityFigures(real=2.4, imag=-0.1, covariance=covariance)
    exact = PermittivityFigures(real=3.0, imag=-0.5, covariance=[[0.0, 0.0], [0.0, 0.0]])
    (compared,) = pair_patches([make_patch(0.0, 0.0, permittivity=exact)], [make_patch(0.0, 0.0, permittivity=value)])
    assert (compared.difference.real, compared.difference.imag) == (0.6, -0.4)
    assert compared.difference.real_std is None
    assert compared.sigmas is None
    (compared,) = pair_patches([make_patch(0.0, 0.0, permittivity=None)], [make_patch(0.0, 0.0)])
    assert compared.difference is None
    assert compared.sigmas is None


def test_the_colours_of_a_map_of_differences_reach_the_largest_difference():
    """A signed map is symmetric about zero; the loss has the other sign than the imaginary part."""
    comparison = compare(make_pixels(2.0), make_pixels(1.0))
    values = np.full((3, 4), -0.2 - 0.4j)
    comparison = replace(comparison, p=values, permittivity=values)
    for name, low, high in (("p", 0.0, abs(0.2 + 0.4j)), ("permittivity", -0.2, 0.2), ("loss", -0.4, 0.4)):
        picture = draw_comparison(comparison, name)
        # Limits of colours are rounded to three digits.
        assert picture.low == pytest.approx(low, abs=1e-3)
        assert picture.high == pytest.approx(high, abs=1e-3)
    # A map without any difference has a range of colours, too: up to 0.001.
    empty = replace(comparison, p=np.zeros((3, 4)))
    assert draw_comparison(empty, "p").high == pytest.approx(1e-3)
