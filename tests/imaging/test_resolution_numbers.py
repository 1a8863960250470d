"""Widths, sidelobes, blocks of positions and limits, each compared with plain formulas."""

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

OFFSETS = np.arange(-60, 61)


@pytest.mark.parametrize("half_px", [7.3, 10.0, 12.6])
def test_a_width_is_that_between_the_points_of_half_power(half_px):
    """A cut that falls by 1 - sqrt(1/2) over half of its width, on each side by itself."""
    fall = (1 - 0.5**0.5) / half_px
    assert _measure_width(np.maximum(1 - fall * abs(OFFSETS), 0)) == pytest.approx(2 * half_px)
    skew = np.where(OFFSETS < 0, 1 - 2 * fall * abs(OFFSETS), 1 - fall * abs(OFFSETS))
    assert _measure_width(skew) == pytest.approx(1.5 * half_px)


def test_a_width_that_is_not_reached_is_infinite():
    assert _measure_width(np.ones(121)) == math.inf
    assert _measure_width(np.where(OFFSETS < 0, 0.2, 1.0)) == math.inf


def test_a_uniform_aperture_has_the_width_and_sidelobe_of_a_sinc():
    cut = np.abs(np.sinc(OFFSETS / 20))
    assert _measure_width(cut) == pytest.approx(0.886 * 20, rel=2e-3)
    assert _measure_sidelobe_db(cut) == pytest.approx(-13.26, abs=0.05)
    # The higher one of both sides; without a minimum, the level at the end
    one_side = np.where(OFFSETS < 0, cut, np.minimum(cut, np.exp(-abs(OFFSETS) / 5)))
    assert _measure_sidelobe_db(one_side) == pytest.approx(-13.26, abs=0.05)
    assert _measure_sidelobe_db(10 ** (-abs(OFFSETS) / 40)) == pytest.approx(-30.0)
    assert _measure_sidelobe_db(np.where(OFFSETS == 0, 1.0, 0.0)) == pytest.approx(-180.0)


def make_aperture(rows: int, columns: int, step_m: float = 0.01) -> Aperture:
    """Positions in a plane 0.5 m before the point, TX and RX at opposite sides of it."""
    y_m, x_m = np.meshgrid(
        (np.arange(rows) - (rows - 1) / 2) * step_m, (np.arange(columns) - (columns - 1) / 2) * step_m, indexing="ij"
    )
    rx_m = np.array([[0.3, 0.0, 0.0], [0.9, 0.9, 0.0]])
    tx_m = np.array([-0.3, 0.0, 0.0])
    antennas = Antennas(tx_m, rx_m)
    grid = ImageGrid(np.linspace(-0.1, 0.1, 21), np.linspace(-0.1, 0.1, 21), 0.5, 0.01)
    return Aperture(antennas, np.stack([x_m, y_m, 0 * x_m], axis=-1), np.array([77e9, 79e9]), grid)


@pytest.mark.parametrize(
    ("shape", "blocks"), [((7, 9), (3, 4)), ((7, 9), (7, 9)), ((7, 9), (20, 20)), ((1, 9), (8, 2))]
)
def test_blocks_keep_the_weight_and_the_middle_of_their_positions(shape, blocks):
    aperture = make_aperture(*shape)
    weights = np.random.default_rng(1).uniform(size=shape)
    combined, block_weights = _combine_positions(aperture, weights, blocks)
    expected_shape = tuple(min(count, most) for count, most in zip(shape, blocks, strict=True))
    assert block_weights.shape == expected_shape
    assert block_weights.sum() == pytest.approx(weights.sum())
    assert combined.offsets_m.shape == (*expected_shape, 3)
    rows = np.array_split(np.arange(shape[0]), expected_shape[0])
    if shape == expected_shape:
        np.testing.assert_allclose(combined.offsets_m, aperture.offsets_m)
        np.testing.assert_allclose(block_weights, weights)
    assert len(rows) == expected_shape[0]
    # The first block has the positions before the second one begins.
    height = shape[0] // expected_shape[0]
    width = shape[1] // expected_shape[1]
    np.testing.assert_allclose(combined.offsets_m[0, 0], aperture.offsets_m[:height, :width].mean(axis=(0, 1)))
    assert block_weights[0, 0] == pytest.approx(weights[:height, :width].sum())


@pytest.mark.parametrize("axis", [0, 1])
def test_the_limit_of_the_geometry_is_that_of_the_range_of_directions(axis):
    """0.886 over the range of sin(TX) + sin(RX) over the wavelength, of the middle line and the first RX."""
    aperture = make_aperture(11, 21)
    point = np.array([0.02, -0.01, 0.5])
    ends = np.array([[-0.1, 0.0], [0.1, 0.0]]) if axis == 0 else np.array([[0.0, -0.05], [0.0, 0.05]])
    sines = []
    for x_m, y_m in ends:
        total = 0.0
        for antenna_x_m in (-0.3, 0.3):
            way = point - (x_m + antenna_x_m, y_m, 0.0)
            total += way[axis] / np.linalg.norm(way)
        sines.append(total)
    wavelength_m = 299_792_458 / 78e9
    assert compute_limit_m(aperture, point, axis) == pytest.approx(0.886 * wavelength_m / abs(sines[1] - sines[0]))


def test_one_position_limits_nothing():
    assert compute_limit_m(make_aperture(1, 5), np.array([0.0, 0.0, 0.5]), 1) == math.inf
    assert compute_limit_m(make_aperture(5, 1), np.array([0.0, 0.0, 0.5]), 0) == math.inf


def test_numbers_that_are_not_finite_are_not_written():
    assert _round_pair((1.23456, math.inf)) == (1.235, None)
    assert _round_pair((math.nan, -2.0)) == (None, -2.0)


@pytest.mark.parametrize("axis", [0, 1])
def test_the_mirror_zone_ends_where_the_phase_has_turned_by_half_a_circle(rig, axis):
    """Between a place and the specular point the phase is the integral of the slope."""
    slope = PhaseSlope(rig, axis)
    middle_hz = rig.chirp.first_sample_hz + rig.chirp.hz_per_sample * 96
    zone_m = compute_field_limits(rig).mirror_zone_mm[axis] / 1e3
    places = np.linspace(0, zone_m, 200)
    phase = np.trapezoid([slope.slope(place, middle_hz) - slope.slope(0.0, middle_hz) for place in places], places)
    assert phase == pytest.approx(np.pi, rel=0.05)


@pytest.mark.parametrize("axis", ["x", "y"])
def test_ghosts_are_nearer_with_wider_steps(rig, axis):
    """Slopes that differ by a turn over a step cannot be told apart: half of the step is twice the difference."""
    number = "xy".index(axis)
    wide = PlanChanges(**{f"step_{axis}_mm": 8.0}).apply(rig)
    free_m = compute_field_limits(wide).alias_free_mm[number] / 1e3
    slope = PhaseSlope(rig, number)
    high_hz = rig.chirp.first_sample_hz + rig.chirp.hz_per_sample * 192
    grid = wide.grid
    size_m = ((grid.columns - 1) * grid.step_x_mm, (grid.rows - 1) * grid.step_y_mm)[number] / 1e3
    apart = []
    for centre_m in np.linspace(-size_m / 4, size_m / 4, 5):
        place_m = np.linspace(-1.5, 1.5, 2001)
        slopes = np.array([slope.slope(centre_m + place, high_hz) for place in place_m])
        # The nearest pair of places about this centre whose slopes differ by a whole turn over the step
        difference = slopes - slopes[::-1]
        reached = place_m[np.flatnonzero(difference >= 2 * np.pi / 8e-3)]
        apart.append(2 * reached.min() if reached.size else math.inf)
    assert free_m == pytest.approx(min(apart), rel=0.02)


def test_a_convolution_is_the_full_linear_one():
    rng = np.random.default_rng(2)
    for first, second in (((5, 7), (3, 4)), ((1, 6), (4, 1)), ((8, 8), (8, 8))):
        a = rng.normal(size=first)
        b = rng.normal(size=second)
        np.testing.assert_allclose(_convolve(a, b), scipy.signal.convolve2d(a, b), atol=1e-12)


def test_angles_on_a_plane_behind_are_smaller(rig):
    """The antennas are as far apart: the tangents are as one over the distances."""
    angle = np.array([[0.5, 0.8]])
    assert incidence_on_planes(angle, None, rig) is angle
    z_m = rig.geometry.object_distance_mm / 1e3
    moved = incidence_on_planes(angle, np.array([[0.1, -0.05]]), rig)
    np.testing.assert_allclose(np.tan(moved) / np.tan(angle), [[z_m / (z_m + 0.1), z_m / (z_m - 0.05)]])


def test_both_kinds_of_angle_are_written_in_degrees():
    one = np.full((2, 2), np.radians(44.0))
    by_pixel = np.radians([[40.0, 43.0], [45.0, 47.0]])
    choice = IncidenceChoice("pixel", one, by_pixel)
    assert choice.used_rad is by_pixel
    assert choice.other_rad is one
    facts = choice.facts(np.ones((2, 2), bool))
    assert (facts.used, facts.one_deg, facts.pixel_deg) == ("by pixel", 44.0, (40.0, 44.0, 47.0))
    assert facts.largest_difference_deg == 4.0
    lit = replace(choice, choice="one").facts(np.array([[False, True], [True, False]]))
    assert (lit.used, lit.pixel_deg, lit.largest_difference_deg) == (
        "one number for the image",
        (43.0, 44.0, 45.0),
        1.0,
    )
    assert choice.facts(np.zeros((2, 2), bool)).pixel_deg == (40.0, 44.0, 47.0)
