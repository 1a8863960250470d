"""Simulated shapes: place, normal and permittivity are within the required errors, or no value is given."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.support.kept import assert_kept, collect_figures, describe_figures, summarise_array
from tests.support.refusals import expect_refusal

from polysight.data import find_packaged
from polysight.report import surface_figure
from polysight.surfaces import (
    SURFACE,
    Uncertainty,
    analyse_surface,
    join_turned,
    read_surface,
    reflect_curved,
    reflect_flat,
    visible_normals,
    write_surface,
)
from polysight.surfaces.result import point_cloud
from polysight_shared.config import load_instrument
from polysight_shared.errors import ErrorCode
from polysight_worlds.media import Stack
from polysight_worlds.shape_scenes import ShapeScene
from polysight_worlds.shapes import cylinder, sphere

# A rig that stands as its file says: only noise and the method's own errors remain.
EXACT = Uncertainty(leakage=1e-4, axis_rad=1e-4, place_m=1e-6)

# At the middle of the rig's band, 1 / m
WAVE_NUMBER = 1634.0

# Front of the objects: in the middle between TX and the receivers, half a metre before the stage
CENTRE_M = (-0.01, 0.104, 0.5)


def make_sphere_scene(radius_m: float, stack: Stack) -> ShapeScene:
    x, y, z = CENTRE_M
    return ShapeScene("sphere", (sphere("ball", stack, (x, y, z + radius_m), radius_m),), stack.below, radius_m)


@pytest.fixture(scope="module")
def glass_ball(see, gains, optics):
    scene = make_sphere_scene(0.11, Stack(below=5.2 - 0.4j))
    surface = see(scene.shapes)
    return scene, surface, analyse_surface(surface, optics, gains, uncertainty=EXACT, scan_id="ball", simulated=True)


def test_points_and_normals_of_a_sphere_are_found(glass_ball):
    scene, _, surface = glass_ball
    distance, normals = scene.nearest_surface(surface.points_m)
    angle = np.degrees(np.arccos(np.clip((normals * surface.normals).sum(axis=1), -1, 1)))
    # Required are half a millimetre and half a degree; the medians are 0.09 mm and 0.13 degrees.
    assert np.median(np.abs(distance)) < 0.5e-3
    assert np.median(angle) < 0.5


def test_the_surface_of_a_sphere_changes_only_on_purpose(glass_ball):
    _, _, surface = glass_ball
    arrays = {name: value for name, value in vars(surface).items() if isinstance(value, np.ndarray)}
    figures: dict[str, Any] = {name: summarise_array(v) for name, v in arrays.items() if v.dtype.kind in "bfc"}
    with collect_figures() as saved:
        surface_figure(surface)
    figures["picture"] = describe_figures(saved)
    assert_kept(Path(__file__).parent / "kept" / "glass-ball.json", figures)


def test_the_permittivity_of_a_sphere_is_found_within_its_error(glass_ball):
    scene, _, surface = glass_ball
    main = surface.segments[0]
    error = main.permittivity - scene.permittivity
    assert abs(error) < 0.03 * abs(scene.permittivity)
    parts = np.array([error.real, error.imag])
    # 99 % of chi squared with two degrees of freedom
    assert parts @ np.linalg.inv(np.array(main.covariance)) @ parts < 9.2


def test_a_cylinder_of_50_mm_is_measured(see, gains, optics):
    medium = 3.4 - 0.5j
    rod = cylinder("rod", Stack(below=medium), (CENTRE_M[0], CENTRE_M[1], 0.55), 0.05, 0.4, axis=(0.5, 1.0, 0.05))
    scene = ShapeScene("cylinder", (rod,), medium, 0.05)
    surface = analyse_surface(see(scene.shapes), optics, gains, uncertainty=EXACT)
    _, normals = scene.nearest_surface(surface.points_m)
    angle = np.degrees(np.arccos(np.clip((normals * surface.normals).sum(axis=1), -1, 1)))
    # The median angle is 0.13 degrees, and the permittivity wrong by 1.4 %.
    assert np.median(angle) < 1.0
    assert abs(surface.segments[0].permittivity - medium) < 0.05 * abs(medium)


def test_metal_is_metal_and_has_no_permittivity(metal, gains, optics):
    surface = analyse_surface(metal, optics, gains, uncertainty=EXACT)
    assert surface.segments[0].name == "metal"
    assert surface.segments[0].permittivity is None
    assert np.isnan(surface.permittivity).all()


def test_a_sphere_with_a_radius_below_40_mm_has_a_shape_and_a_reason_but_no_permittivity(see, gains, optics):
    scene = make_sphere_scene(0.03, Stack(below=4 - 0.4j))
    seen = see(scene.shapes, columns=64, rows=44)
    surface = analyse_surface(seen, optics, gains, uncertainty=EXACT)
    assert len(surface.points_m)
    assert [s.permittivity for s in surface.segments] == [None] * len(surface.segments)
    assert all(s.reason for s in surface.segments)


def test_without_a_reference_the_shape_alone_is_given(glass_ball, optics):
    _, glass_surface, with_reference = glass_ball
    surface = analyse_surface(glass_surface, optics, None, uncertainty=EXACT)
    assert np.array_equal(surface.points_m, with_reference.points_m)
    assert all(s.permittivity is None and s.reason for s in surface.segments)


def test_the_error_grows_with_what_is_not_known(glass_ball, gains, optics):
    _, surface, exact = glass_ball
    traces = [np.trace(exact.segments[0].covariance)]
    # Leakage, then the antennas' axes, then their places are known less well.
    uncertainties = [
        Uncertainty(leakage=0.02, axis_rad=1e-4, place_m=1e-6),
        Uncertainty(leakage=0.02, axis_rad=0.02, place_m=1e-6),
        Uncertainty(leakage=0.02, axis_rad=0.02, place_m=1e-3),
    ]
    for uncertainty in uncertainties:
        judged = analyse_surface(surface, optics, gains, uncertainty=uncertainty).segments[0]
        traces.append(np.trace(judged.covariance))
    assert traces == sorted(traces)
    assert traces[-1] > 2 * traces[0]


def test_scans_of_a_turntable_are_joined_where_the_object_stood(glass_ball):
    """The same ball, scanned on a table that was turned by 40 degrees, is moved back to its place."""
    _, _, surface = glass_ball
    # x and z of the vertical axis of the table, metres
    axis = (0.03, 0.55)
    angle = np.radians(40.0)
    # A positive angle turns +z towards +x.
    turn = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
    on_axis = np.array([axis[0], 0.0, axis[1]])
    rotated_points_m = (surface.points_m - on_axis) @ turn.T + on_axis
    rotated_surface = replace(surface, points_m=rotated_points_m, normals=surface.normals @ turn.T)
    joined = join_turned([surface, rotated_surface], [0.0, 40.0], axis)
    # The points and segments of the second scan follow those of the first.
    count = len(surface.points_m)
    of_second_scan = joined.segments[len(surface.segments) :]
    assert np.allclose(joined.points_m[count:], surface.points_m, atol=1e-9)
    assert np.allclose(joined.normals[count:], surface.normals, atol=1e-9)
    assert [s.number for s in joined.segments] == list(range(2 * len(surface.segments)))
    assert set(joined.segment[count:]) <= {s.number for s in of_second_scan}
    assert [s.turned_deg for s in of_second_scan] == [40.0] * len(surface.segments)


def test_surfaces_whose_numbers_have_gaps_keep_different_numbers_when_joined(glass_ball):
    """An edge that was dropped leaves a gap in the numbers, here 0 and 2; no two surfaces may get the same number."""
    _, _, surface = glass_ball
    is_first_half = np.arange(len(surface.points_m)) < len(surface.points_m) // 2
    segments = (surface.segments[0], replace(surface.segments[0], number=2))
    with_gap = replace(surface, segment=np.where(is_first_half, 0, 2), segments=segments)
    joined = join_turned([with_gap, with_gap], [0.0, 40.0], (0.03, 0.55))
    assert len({s.number for s in joined.segments}) == 4
    # Numbers of the points, in the order in which they first occur, scan by scan
    numbers = []
    for numbers_of_scan in np.split(joined.segment, 2):
        numbers.extend(int(number) for number in dict.fromkeys(numbers_of_scan))
    assert numbers == [s.number for s in joined.segments]


def test_a_surface_that_is_written_and_read_again_is_the_same(glass_ball, tmp_path):
    _, _, surface = glass_ball
    write_surface(tmp_path, surface)
    read = read_surface(tmp_path / SURFACE)
    assert read.segments == surface.segments
    assert read.scan_id == surface.scan_id
    assert np.array_equal(read.points_m, surface.points_m)
    assert np.array_equal(read.permittivity, surface.permittivity, equal_nan=True)


@pytest.mark.parametrize(
    "content", [None, b"", b"not an archive", {"points_m": np.zeros((1, 3))}, {"segments": "[{}]"}]
)
def test_the_error_of_a_file_that_is_not_a_surface_names_the_file(content: Any, tmp_path):
    path = tmp_path / SURFACE
    if isinstance(content, bytes):
        path.write_bytes(content)
    elif content is not None:
        arrays: dict[str, Any] = content
        np.savez(path, allow_pickle=False, **arrays)
    with expect_refusal(ErrorCode.FILE_UNREADABLE, path):
        read_surface(path)


def test_the_point_cloud_is_a_ply_of_all_points(glass_ball):
    _, _, surface = glass_ball
    head, _, body = point_cloud(surface).partition(b"end_header\n")
    assert head.startswith(b"ply\nformat binary_little_endian 1.0\n")
    assert f"element vertex {len(surface.points_m)}".encode() in head
    # Each property is a number of four bytes.
    properties = head.count(b"\nproperty ")
    assert len(body) == 4 * properties * len(surface.points_m)
    # x, y and z of the first point, millimetres
    first_point_mm = np.frombuffer(body[:12], "<f4")
    assert np.allclose(first_point_mm, 1e3 * surface.points_m[0], atol=1e-3)


def test_a_surface_without_curvature_reflects_by_fresnel():
    theta = np.radians([40.0, 55.0, 62.0])
    flat = reflect_flat(4 - 0.3j, theta)
    no_bend = np.zeros(3)
    curved = reflect_curved(4 - 0.3j, theta, no_bend, no_bend, WAVE_NUMBER)
    assert np.allclose(flat, curved, atol=1e-9)


def test_curved_metal_turns_p_by_the_known_phase():
    """A metal sphere: r_p / r_s turns by sin^2 / (k R cos^3), 0.02 rad at a radius of 100 mm and 55 degrees."""
    theta = np.radians([55.0])
    radius_m = 0.1
    bend = np.array([1 / radius_m])
    r_s, r_p = reflect_curved(np.inf, theta, bend, bend, WAVE_NUMBER)
    expected = np.sin(theta) ** 2 / (WAVE_NUMBER * radius_m * np.cos(theta) ** 3)
    # The formula is of the first order in 1 / (k R), which is 0.006.
    assert np.angle(r_p / r_s) == pytest.approx(expected, rel=0.05)


def test_the_published_grid_shows_normals_of_15_and_22_degrees():
    """The grid reaches 0.349 m in x and 0.199 m in y to each side, at half a metre and 55 degrees of incidence.

    Beyond the alias angle, echoes appear in other directions; with steps of 2 mm it is 57 degrees.
    """
    normals_deg = visible_normals(load_instrument(find_packaged(Path("instrument.toml"))))
    assert normals_deg.x_deg == pytest.approx(15, abs=1)
    assert normals_deg.y_deg == pytest.approx(22, abs=1)
    assert min(normals_deg.alias_deg) > 50
