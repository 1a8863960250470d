"""Widths and sidelobes of a point response, blocks of scan positions and limits of the image equal plain formulas."""

import math
from dataclasses import replace

import numpy as np
import pytest
import scipy.signal

from polysight.imaging.geometry import Antennas, Aperture, ImageGrid
from polysight.imaging.resolution import (
    PhaseSlope,
    _combine_positions,
    _measure_sidelobe_db,
    _measure_width,
    _round_pair,
    compute_field_limits,
    compute_limit_m,
)
from polysight.planning import PlanChanges
from polysight.polarimetry.fresnel import IncidenceChoice, _convolve, incidence_on_planes

# Pixels of a cut through a point response, from its peak
OFFSETS = np.arange(-60, 61)

# First sidelobe of a sinc. It may lie between two pixels: 0.02 dB is measured.
SINC_SIDELOBE_DB = pytest.approx(-13.26, abs=0.05)


@pytest.mark.parametrize("half_px", [7.3, 10.0, 12.6])
def test_a_width_is_that_between_the_points_of_half_power(half_px):
    """Triangles, whose amplitude falls from 1 to sqrt(1/2), half of the power, within `half_px` pixels."""
    fall_per_px = (1 - 0.5**0.5) / half_px
    triangle = 1 - fall_per_px * abs(OFFSETS)
    assert _measure_width(np.maximum(triangle, 0)) == pytest.approx(2 * half_px)
    # The left side is twice as steep: it falls within half of `half_px`.
    skew_triangle = np.where(OFFSETS < 0, 1 - 2 * fall_per_px * abs(OFFSETS), triangle)
    assert _measure_width(skew_triangle) == pytest.approx(1.5 * half_px)


def test_the_width_of_a_cut_that_does_not_fall_to_half_power_is_infinite():
    assert _measure_width(np.ones(121)) == math.inf
    falls_to_the_left_only = np.where(OFFSETS < 0, 0.2, 1.0)
    assert _measure_width(falls_to_the_left_only) == math.inf


def test_a_uniform_aperture_has_the_width_and_sidelobe_of_a_sinc():
    # First zeros 20 pixels from the peak
    cut = np.abs(np.sinc(OFFSETS / 20))
    assert _measure_width(cut) == pytest.approx(0.886 * 20, rel=2e-3)
    assert _measure_sidelobe_db(cut) == SINC_SIDELOBE_DB


def test_the_sidelobe_is_the_higher_one_of_both_sides():
    cut = np.abs(np.sinc(OFFSETS / 20))
    weak_to_the_right = np.where(OFFSETS < 0, cut, np.minimum(cut, np.exp(-abs(OFFSETS) / 5)))
    assert _measure_sidelobe_db(weak_to_the_right) == SINC_SIDELOBE_DB


def test_a_cut_without_a_minimum_has_the_level_at_its_end_as_sidelobe():
    # The amplitude falls by a factor of 10, 20 dB, within 40 pixels: 30 dB within 60.
    assert _measure_sidelobe_db(10 ** (-abs(OFFSETS) / 40)) == pytest.approx(-30.0)
    # The least level that is reported
    assert _measure_sidelobe_db(np.where(OFFSETS == 0, 1.0, 0.0)) == pytest.approx(-180.0)


def make_aperture(rows: int, columns: int, step_m: float = 0.01) -> Aperture:
    """Positions in a plane 0.5 m before the image, TX and the first RX 0.3 m to either side of its middle."""
    column_m = (np.arange(columns) - (columns - 1) / 2) * step_m
    row_m = (np.arange(rows) - (rows - 1) / 2) * step_m
    y_m, x_m = np.meshgrid(row_m, column_m, indexing="ij")
    rx_m = np.array([[0.3, 0.0, 0.0], [0.9, 0.9, 0.0]])
    tx_m = np.array([-0.3, 0.0, 0.0])
    antennas = Antennas(tx_m, rx_m)
    grid = ImageGrid(x_m=np.linspace(-0.1, 0.1, 21), y_m=np.linspace(-0.1, 0.1, 21), z_m=0.5, pixel_m=0.01)
    offsets_m = np.stack([x_m, y_m, 0 * x_m], axis=-1)
    return Aperture(antennas, offsets_m, frequencies_hz=np.array([77e9, 79e9]), grid=grid)


@pytest.mark.parametrize(
    ("shape", "blocks"), [((7, 9), (3, 4)), ((7, 9), (7, 9)), ((7, 9), (20, 20)), ((1, 9), (8, 2))]
)
def test_blocks_keep_the_weight_and_the_middle_of_their_positions(shape, blocks):
    """Positions are combined to `blocks` (rows, columns) at most."""
    aperture = make_aperture(*shape)
    weights = np.random.default_rng(1).uniform(size=shape)
    combined, block_weights = _combine_positions(aperture, weights, blocks)
    expected_shape = tuple(min(count, most) for count, most in zip(shape, blocks, strict=True))
    assert block_weights.shape == expected_shape
    assert block_weights.sum() == pytest.approx(weights.sum())
    assert combined.offsets_m.shape == (*expected_shape, 3)
    if shape == expected_shape:
        np.testing.assert_allclose(combined.offsets_m, aperture.offsets_m)
        np.testing.assert_allclose(block_weights, weights)
    # The first block has the positions before the second one begins.
    height = shape[0] // expected_shape[0]
    width = shape[1] // expected_shape[1]
    np.testing.assert_allclose(combined.offsets_m[0, 0], aperture.offsets_m[:height, :width].mean(axis=(0, 1)))
    assert block_weights[0, 0] == pytest.approx(weights[:height, :width].sum())


@pytest.mark.parametrize("axis", [0, 1])
def test_the_limit_of_the_geometry_is_that_of_the_range_of_directions(axis):
    """0.886 wavelengths over the range of sin(theta_tx) + sin(theta_rx) from one end of the aperture to the other.

    The ends are those of the middle row or column; the receiver is the first RX.
    """
    aperture = make_aperture(rows=11, columns=21)
    point = np.array([0.02, -0.01, 0.5])
    if axis == 0:
        ends_m = ((-0.1, 0.0), (0.1, 0.0))
    else:
        ends_m = ((0.0, -0.05), (0.0, 0.05))
    sums_of_sines = []
    for x_m, y_m in ends_m:
        sum_of_sines = 0.0
        for antenna_x_m in (-0.3, 0.3):
            from_antenna = point - (x_m + antenna_x_m, y_m, 0.0)
            sum_of_sines += from_antenna[axis] / np.linalg.norm(from_antenna)
        sums_of_sines.append(sum_of_sines)
    # At the middle of the frequencies, 78 GHz
    wavelength_m = 299_792_458 / 78e9
    expected_m = 0.886 * wavelength_m / abs(sums_of_sines[1] - sums_of_sines[0])
    assert compute_limit_m(aperture, point, axis) == pytest.approx(expected_m)


def test_an_axis_with_one_position_has_an_infinite_limit():
    assert compute_limit_m(make_aperture(1, 5), np.array([0.0, 0.0, 0.5]), 1) == math.inf
    assert compute_limit_m(make_aperture(5, 1), np.array([0.0, 0.0, 0.5]), 0) == math.inf


def test_numbers_that_are_not_finite_are_written_as_none():
    assert _round_pair((1.23456, math.inf)) == (1.235, None)
    assert _round_pair((math.nan, -2.0)) == (None, -2.0)


@pytest.mark.parametrize("axis", [0, 1])
def test_the_mirror_zone_ends_where_the_phase_has_turned_by_half_a_circle(rig, axis):
    """Between a place and the specular point the phase is the integral of the slope."""
    slope = PhaseSlope(rig, axis)
    # The linear part has 192 samples.
    middle_hz = rig.chirp.first_sample_hz + rig.chirp.hz_per_sample * 96
    zone_m = compute_field_limits(rig).mirror_zone_mm[axis] / 1e3
    places_m = np.linspace(0, zone_m, 200)
    slopes = [slope.slope(place_m, middle_hz) - slope.slope(0.0, middle_hz) for place_m in places_m]
    phase_rad = np.trapezoid(slopes, places_m)
    # The zone is computed with a slope that changes evenly from the specular point on. 0.4 % is measured.
    assert phase_rad == pytest.approx(np.pi, rel=0.05)


@pytest.mark.parametrize("axis", ["x", "y"])
def test_an_image_is_free_of_ghosts_up_to_where_slopes_differ_by_a_turn_over_a_step(rig, axis):
    """Phase slopes (radians per metre of stage) that differ by a whole turn over a step have the same samples.

    The echoes of two such places cannot be distinguished. Steps of 8 mm instead of 2 bring them into reach.
    """
    number = "xy".index(axis)
    wide = PlanChanges(**{f"step_{axis}_mm": 8.0}).apply(rig)
    free_m = compute_field_limits(wide).alias_free_mm[number] / 1e3
    slope = PhaseSlope(rig, number)
    # Slopes are steepest at the end of the sweep.
    highest_hz = rig.chirp.first_sample_hz + rig.chirp.hz_per_sample * 192
    grid = wide.grid
    if axis == "x":
        size_m = (grid.columns - 1) * grid.step_x_mm / 1e3
    else:
        size_m = (grid.rows - 1) * grid.step_y_mm / 1e3
    distances_m = []
    for centre_m in np.linspace(-size_m / 4, size_m / 4, 5):
        # Pairs of places at -p and +p about this centre: the nearest whose slopes differ by a turn over 8 mm
        place_m = np.linspace(-1.5, 1.5, 2001)
        slopes = np.array([slope.slope(centre_m + place, highest_hz) for place in place_m])
        difference = slopes - slopes[::-1]
        ambiguous_m = place_m[difference >= 2 * np.pi / 8e-3]
        if ambiguous_m.size:
            distances_m.append(2 * ambiguous_m.min())
        else:
            distances_m.append(math.inf)
    # The pairs searched here are 3 mm apart (2 x 1.5 mm); distances are about 0.5 m.
    assert free_m == pytest.approx(min(distances_m), rel=0.02)


def test_a_convolution_is_the_full_linear_one():
    rng = np.random.default_rng(2)
    for first, second in (((5, 7), (3, 4)), ((1, 6), (4, 1)), ((8, 8), (8, 8))):
        a = rng.normal(size=first)
        b = rng.normal(size=second)
        np.testing.assert_allclose(_convolve(a, b), scipy.signal.convolve2d(a, b), atol=1e-12)


def test_angles_on_a_plane_behind_are_smaller(rig):
    """TX and RX stay where they are: the tangent of the angle is inversely proportional to the plane's distance."""
    angle = np.array([[0.5, 0.8]])
    assert incidence_on_planes(angle, None, rig) is angle
    z_m = rig.geometry.object_distance_mm / 1e3
    moved = incidence_on_planes(angle, np.array([[0.1, -0.05]]), rig)
    np.testing.assert_allclose(np.tan(moved) / np.tan(angle), [[z_m / (z_m + 0.1), z_m / (z_m - 0.05)]])


def test_both_kinds_of_angle_are_written_in_degrees():
    """One angle for the image, and one per pixel with its least, median and largest value."""
    one_angle = np.full((2, 2), np.radians(44.0))
    by_pixel = np.radians([[40.0, 43.0], [45.0, 47.0]])
    choice = IncidenceChoice("pixel", one_angle, by_pixel)
    assert choice.used_rad is by_pixel
    assert choice.other_rad is one_angle
    facts = choice.facts(np.ones((2, 2), bool))
    assert (facts.used, facts.one_deg, facts.pixel_deg) == ("by pixel", 44.0, (40.0, 44.0, 47.0))
    assert facts.largest_difference_deg == 4.0
    # Only the pixels of 43 and 45 degrees are valid.
    facts = replace(choice, choice="one").facts(np.array([[False, True], [True, False]]))
    assert facts.used == "one number for the image"
    assert facts.pixel_deg == (43.0, 44.0, 45.0)
    assert facts.largest_difference_deg == 1.0
    # If no pixel is valid, the angles of all pixels are written.
    assert choice.facts(np.zeros((2, 2), bool)).pixel_deg == (40.0, 44.0, 47.0)
