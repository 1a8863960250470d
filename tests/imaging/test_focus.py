"""Autofocus finds a plane that differs from the rig file."""

import msgspec
import numpy as np
import pytest

from polysight.imaging import ImageBuilder, image_grid
from polysight.imaging.focus import _interpolate_stack, focus_sweep

PLACES_MM = [(-60, -55), (-10, -60), (58, -50), (-62, 5), (3, -4), (60, 8), (-55, 60), (8, 55), (61, 58)]


def _sweep_focus(make_rig, points_rows, depth_mm=0.0, tilt_deg=(0.0, 0.0), noise=0.3):
    """Points on a plane `depth_mm` behind the rig file's, with the tilt `tilt_deg` along x and y."""
    rig = make_rig(88, 41, 8.0, 8.0, pixels=(75, 75))
    grid = image_grid(rig)
    rng = np.random.default_rng(1)
    centre = np.array([grid.x_m.mean(), grid.y_m.mean()])
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
    assert focus.depth_mm == pytest.approx(depth_mm, abs=0.5)
    np.testing.assert_allclose(focus.tilt_deg, tilt_deg, atol=0.2)
    assert focus.gain >= 1 - 1e-6
    assert focus.certain
    np.testing.assert_allclose(focus.depths_mm, np.linspace(-8, 8, 9))
    assert focus.sharpness.max() == 1
    assert abs(focus.depths_mm[np.argmax(focus.sharpness)] - depth_mm) <= 2


def test_a_narrow_scan_gives_no_certain_result(make_rig, points_rows):
    rig = make_rig(21, 21, 6.0, 6.0, pixels=(31, 31))
    point = np.array([image_grid(rig).x_m[15], image_grid(rig).y_m[15], image_grid(rig).z_m])
    builder = ImageBuilder(rig, depth_m=8e-3)
    for index, row in points_rows(rig, rig.receivers[0], [point], [1.0]):
        builder.add_row(rig.receivers[0].name, index, row)
    assert not focus_sweep(builder, planes=5).certain


def test_with_the_right_distance_in_the_rig_file_nothing_is_found(make_rig, points_rows):
    rig = make_rig(88, 9, 8.0, 8.0, pixels=(31, 31))
    point = np.array([image_grid(rig).x_m[15], image_grid(rig).y_m[15], image_grid(rig).z_m + 3e-3])
    geometry = msgspec.structs.replace(rig.geometry, object_distance_mm=rig.geometry.object_distance_mm + 3)
    right = msgspec.structs.replace(rig, geometry=geometry)
    builder = ImageBuilder(right, depth_m=8e-3)
    for index, row in points_rows(right, right.receivers[0], [point], [1.0]):
        builder.add_row(right.receivers[0].name, index, row)
    assert abs(focus_sweep(builder, planes=9).depth_mm) < 0.3


def test_interpolation_between_planes_is_exact_at_all_planes():
    depths = np.linspace(-4e-3, 4e-3, 9)
    stack = 1 + np.random.default_rng(1).random((9, 3, 4))
    for plane, depth in zip(stack, depths, strict=True):
        np.testing.assert_allclose(_interpolate_stack(stack, depths, np.full((3, 4), depth)), plane, rtol=1e-9)
    smooth = (depths**2)[:, None, None] * np.ones((3, 4))
    between = np.full((3, 4), -3.7e-3)
    # Parabolas are exact
    np.testing.assert_allclose(_interpolate_stack(smooth, depths, between), between**2, rtol=1e-9)
