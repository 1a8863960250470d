"""Autofocus finds a plane that differs from the rig file."""

import msgspec
import numpy as np
import pytest

from polysight.imaging import ImageBuilder, image_grid
from polysight.imaging.focus import _interpolate_stack, focus_sweep

# Nine points near the corners, edges and middle of the image of 150 x 150 mm: x, y from its middle.
PLACES_MM = [(-60, -55), (-10, -60), (58, -50), (-62, 5), (3, -4), (60, 8), (-55, 60), (8, 55), (61, 58)]


def _sweep_focus(make_rig, points_rows, depth_mm=0.0, tilt_deg=(0.0, 0.0), noise=0.3):
    """Focus of nine points on a plane `depth_mm` behind the rig file's, with the tilt `tilt_deg` along x and y.

    The scan is as wide as the published one, with steps four times as wide.
    """
    rig = make_rig(columns=88, rows=41, step_x=8.0, step_y=8.0, pixels=(75, 75))
    grid = image_grid(rig)
    rng = np.random.default_rng(1)
    centre = np.array([grid.x_m.mean(), grid.y_m.mean()])
    # Each point is moved by up to half a pixel: points on pixels would be sharper than others.
    xy = np.array(PLACES_MM) / 1e3 + rng.uniform(-1e-3, 1e-3, (len(PLACES_MM), 2))
    z = grid.z_m + depth_mm / 1e3 + xy @ np.tan(np.radians(tilt_deg))
    points = np.column_stack([xy + centre, z])
    builder = ImageBuilder(rig, depth_m=8e-3)
    board = rig.receivers[0]
    amplitudes = rng.uniform(0.5, 1, len(points)) * np.exp(2j * np.pi * rng.uniform(size=len(points)))
    for index, row in points_rows(rig, board, points, amplitudes, noise=noise):
        builder.add_row(board.name, index, row)
    return focus_sweep(builder, planes=9)


@pytest.mark.parametrize(("depth_mm", "tilt_deg"), [(3.0, (0.0, 0.0)), (-3.0, (1.0, 0.0)), (1.0, (-0.5, 1.0))])
def test_a_plane_wrong_by_3_mm_or_1_degree_is_found_within_half_a_millimetre_and_0_2_degrees(
    make_rig, points_rows, depth_mm, tilt_deg
):
    focus = _sweep_focus(make_rig, points_rows, depth_mm, tilt_deg)
    # The errors measured are 0.13 mm and 0.17 degrees.
    assert focus.depth_mm == pytest.approx(depth_mm, abs=0.5)
    np.testing.assert_allclose(focus.tilt_deg, tilt_deg, atol=0.2)
    # The gain is the sharpness of the sharpest plane over that of the rig file's plane.
    assert focus.gain >= 1 - 1e-6
    assert focus.certain
    np.testing.assert_allclose(focus.depths_mm, np.linspace(-8, 8, 9))
    assert focus.sharpness.max() == 1
    # The planes of the sweep are 2 mm apart; a tilt moves the sharpest one by up to one of them.
    assert abs(focus.depths_mm[np.argmax(focus.sharpness)] - depth_mm) <= 2


def test_the_focus_of_a_narrow_scan_is_uncertain(make_rig, points_rows):
    """With an aperture of 120 mm a wrong depth hardly changes the sharpness."""
    rig = make_rig(columns=21, rows=21, step_x=6.0, step_y=6.0, pixels=(31, 31))
    grid = image_grid(rig)
    middle_point = np.array([grid.x_m[15], grid.y_m[15], grid.z_m])
    builder = ImageBuilder(rig, depth_m=8e-3)
    for index, row in points_rows(rig, rig.receivers[0], [middle_point], [1.0]):
        builder.add_row(rig.receivers[0].name, index, row)
    assert not focus_sweep(builder, planes=5).certain


def test_the_focus_of_a_rig_file_with_the_right_distance_is_at_depth_0(make_rig, points_rows):
    """The point lies 3 mm behind the published plane, and the rig file says so."""
    rig = make_rig(columns=88, rows=9, step_x=8.0, step_y=8.0, pixels=(31, 31))
    grid = image_grid(rig)
    point = np.array([grid.x_m[15], grid.y_m[15], grid.z_m + 3e-3])
    geometry = msgspec.structs.replace(rig.geometry, object_distance_mm=rig.geometry.object_distance_mm + 3)
    right_rig = msgspec.structs.replace(rig, geometry=geometry)
    builder = ImageBuilder(right_rig, depth_m=8e-3)
    board = right_rig.receivers[0]
    for index, row in points_rows(right_rig, board, [point], [1.0]):
        builder.add_row(board.name, index, row)
    # With the published distance the depth would be 3 mm.
    assert abs(focus_sweep(builder, planes=9).depth_mm) < 0.3


def test_interpolation_between_planes_is_exact_at_all_planes_and_for_parabolas():
    depths = np.linspace(-4e-3, 4e-3, 9)
    stack = 1 + np.random.default_rng(1).random((9, 3, 4))
    for plane, depth in zip(stack, depths, strict=True):
        np.testing.assert_allclose(_interpolate_stack(stack, depths, np.full((3, 4), depth)), plane, rtol=1e-9)
    parabola = (depths**2)[:, None, None] * np.ones((3, 4))
    between_planes = np.full((3, 4), -3.7e-3)
    interpolated = _interpolate_stack(parabola, depths, between_planes)
    np.testing.assert_allclose(interpolated, between_planes**2, rtol=1e-9)
