"""The path of an echo is recovered: its length, its slope and its bend over a window.

A window is a part of the positions of a scan. Over it, the path from TX over a point of the surface to RX is a
polynomial of second degree of the stage's offset; slope and bend are its first and second derivatives. They give the
point, the normal and the curvature of the surface.
"""

from dataclasses import replace

import numpy as np
import pytest

from polysight.surfaces import Samples
from polysight.surfaces.paths import find_echoes, measure_echoes
from polysight.surfaces.points import (
    compute_spreading,
    compute_unit_legs,
    find_curvature,
    find_normals,
    find_offset_that_sees,
    find_specular_points,
    predict_echo,
)
from polysight.surfaces.window import find_mirror_path
from polysight_shared.units import SPEED_OF_LIGHT_M_S
from polysight_worlds.rig import published_boards
from polysight_worlds.shape_scenes import scan_offsets

C = SPEED_OF_LIGHT_M_S

# The linear part of the published sweep
FREQUENCIES_HZ = np.linspace(76.282e9, 79.749e9, 12)


def make_empty_scan() -> Samples:
    """A scan of one window and a half, without echoes."""
    boards = published_boards()
    offsets = scan_offsets(21, 21)
    rx_m = np.array([rx.position for rx in boards.h])
    cube = np.zeros((4, FREQUENCIES_HZ.size, 21, 21), complex)
    return Samples(cube, np.ones((21, 21), bool), offsets, FREQUENCIES_HZ, boards.tx.position, rx_m)


def _normalise(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def add_sphere_echo(scan: Samples, point_m: np.ndarray, radius_m: float, amplitude: complex) -> Samples:
    """Add the echo of a metal sphere whose front is at `point_m`, in ray optics.

    At the specular point the normal halves the angle between the directions to TX and RX. The iteration takes as normal
    the bisector at the last point; it ends far below a micrometre.
    """
    centre = point_m + np.array([0.0, 0.0, radius_m])
    tx = scan.tx_m + scan.offsets_m
    rx = scan.rx_m[:, None, None] + scan.offsets_m
    normal = np.array([0.0, 0.0, -1.0])
    for _ in range(12):
        specular_point = centre + radius_m * normal
        bisector = _normalise(tx - specular_point) + _normalise(rx - specular_point)
        normal = _normalise(bisector)
    specular_point = centre + radius_m * normal
    paths_m = np.linalg.norm(specular_point - tx, axis=-1) + np.linalg.norm(specular_point - rx, axis=-1)
    excess_m = paths_m - scan.direct_m[:, None, None]
    turns = scan.frequencies_hz[None, :, None, None] * excess_m[:, None] / C
    return replace(scan, cube=scan.cube + amplitude * np.exp(2j * np.pi * turns))


def add_mirror_echo(scan: Samples, z_m: float, amplitude: complex) -> Samples:
    """Add the echo of a level mirror, the same for all stage positions."""
    mirrored_tx_m = scan.tx_m * [1, 1, -1] + [0, 0, 2 * z_m]
    excess_m = np.linalg.norm(scan.rx_m - mirrored_tx_m, axis=1) - scan.direct_m
    echo = amplitude * np.exp(2j * np.pi / C * np.outer(excess_m, scan.frequencies_hz))
    return replace(scan, cube=scan.cube + echo[:, :, None, None])


# Direction away from the stage
BEHIND = np.array([0.0, 0.0, 1.0])

# Front of the spheres: in the middle between TX and H, half a metre before the stage
FRONT_M = np.array([-0.01, 0.104, 0.5])


def test_a_sphere_is_found_with_points_normals_and_radius():
    radius_m = 0.12
    scan = add_sphere_echo(make_empty_scan(), FRONT_M, radius_m, amplitude=0.5 * np.exp(0.3j))
    echoes = find_echoes(scan, (1.4, 2.0))
    points = find_specular_points(echoes.path_m, echoes.slope, echoes.at_m, scan.tx_m, scan.middle_m)
    normals, _ = find_normals(points, echoes.at_m, scan.tx_m, scan.middle_m)
    bends = find_curvature(points, normals, echoes.at_m, scan.tx_m, scan.middle_m, echoes.bend)
    from_centre_m = points - (FRONT_M + radius_m * BEHIND)
    # There is no noise: points lie 2 micrometres from the sphere, normals are wrong by 0.002 degrees, curvatures by
    # 0.4 % and amplitudes by 0.03 %.
    assert np.abs(np.linalg.norm(from_centre_m, axis=1) - radius_m).max() < 1e-4
    assert np.abs(np.cross(normals, from_centre_m / radius_m)).max() < np.radians(0.1)
    assert np.allclose(np.linalg.eigvalsh(bends), 1 / radius_m, rtol=0.1)
    assert np.abs(echoes.amplitude) == pytest.approx(0.5, rel=1e-2)


def test_a_weak_echo_is_found_near_a_strong_one():
    """A sphere of 0.16 of the amplitude of a mirror that lies 150 mm behind its front."""
    radius_m = 0.1
    mirror = add_mirror_echo(make_empty_scan(), z_m=0.65, amplitude=1.0)
    both = add_sphere_echo(mirror, FRONT_M, radius_m, amplitude=0.16)
    echoes = find_echoes(both, (1.4, 2.1))
    points = find_specular_points(echoes.path_m, echoes.slope, echoes.at_m, both.tx_m, both.middle_m)
    from_sphere_m = np.abs(np.linalg.norm(points - (FRONT_M + radius_m * BEHIND), axis=1) - radius_m)
    # One point of the sphere or more for each window
    windows = len(np.unique(echoes.at_m, axis=0))
    assert (from_sphere_m < 1e-3).sum() >= windows


def test_the_path_of_a_point_gives_the_point_back():
    scan = make_empty_scan()
    rng = np.random.default_rng(1)
    n = 200
    points = rng.uniform([-0.1, 0.0, 0.4], [0.1, 0.2, 0.6], (n, 3))
    at_m = np.stack([rng.uniform(-0.05, 0.05, n), rng.uniform(-0.05, 0.05, n), np.zeros(n)], axis=1)
    normals, _ = find_normals(points, at_m, scan.tx_m, scan.middle_m)
    # Curvatures from hollow (radius 0.5 m) to a radius of 67 mm, 1 / m
    bends = rng.uniform(-2, 15, (n, 2, 2))
    bends = (bends + np.swapaxes(bends, 1, 2)) / 2
    path, slope, bend = predict_echo(points, normals, bends, at_m, scan.tx_m, scan.middle_m)
    assert np.allclose(find_specular_points(path, slope, at_m, scan.tx_m, scan.middle_m), points, atol=1e-8)
    found_bends = find_curvature(points, normals, at_m, scan.tx_m, scan.middle_m, bend)
    # Curvatures are up to 15 / m and found to 5e-7 / m.
    assert np.allclose(found_bends, bends, atol=1e-4)
    # The search begins 22 mm away from the position that sees the point.
    seen_from = find_offset_that_sees(points, normals, at_m + np.array([0.01, 0.02, 0]), scan.tx_m, scan.middle_m)
    assert np.allclose(seen_from, at_m, atol=1e-8)


def test_the_echo_of_a_mirror_falls_with_the_length_of_its_path():
    """A mirror 0.5 m before the stage: its point lies where the line from RX to the mirrored TX crosses it."""
    scan = make_empty_scan()
    at_m = np.zeros((1, 3))
    mirror_z_m = 0.5
    mirrored_tx_m = scan.tx_m * [1, 1, -1] + [0, 0, 2 * mirror_z_m]
    share = (mirror_z_m - scan.middle_m[2]) / (mirrored_tx_m[2] - scan.middle_m[2])
    point = (scan.middle_m + share * (mirrored_tx_m - scan.middle_m))[None]
    normals, _ = find_normals(point, at_m, scan.tx_m, scan.middle_m)
    _, _, out_m, back_m = compute_unit_legs(point, at_m, scan.tx_m, scan.middle_m)
    flat = np.zeros((1, 2, 2))
    factors = compute_spreading(point, normals, flat, at_m, scan.tx_m, scan.middle_m)
    assert np.allclose(normals, [[0, 0, -1]], atol=1e-9)
    assert factors[0] == pytest.approx(1 / float(out_m[0] + back_m[0]), rel=1e-6)


def test_a_known_path_is_measured_without_the_gain_of_a_search():
    """Noise alone has the power of a mean over the samples; a maximum over paths would be several times as large."""
    scan = make_empty_scan()
    rng = np.random.default_rng(7)
    noise = rng.normal(size=scan.cube.shape) + 1j * rng.normal(size=scan.cube.shape)
    noisy = replace(scan, cube=noise)
    # Slopes so far apart that their means are independent.
    slope = np.stack(np.meshgrid(np.linspace(-0.35, 0.35, 6), np.linspace(-0.35, 0.35, 6)), axis=-1).reshape(-1, 2)
    count = len(slope)
    path = np.full(count, find_mirror_path(scan, 0.5))
    echoes, inside = measure_echoes(noisy, np.zeros((count, 3)), path, slope, np.zeros((count, 2, 2)))
    # The noise has the power 2 (1 in each part) in each sample of a window: four RX, all frequencies and positions.
    height, width = scan.window_shape()
    mean_power = 2 / (len(scan.rx_m) * FREQUENCIES_HZ.size * height * width)
    assert inside.all()
    # The mean power of 36 echoes scatters by 1 / sqrt(36); the largest of 36 is about four times the mean.
    assert np.mean(np.abs(echoes.amplitude) ** 2) / mean_power == pytest.approx(1, abs=0.6)


def test_an_amplitude_is_that_at_the_requested_place_and_not_the_mean_of_the_window():
    """Near Brewster's angle |V| changes by a per cent a millimetre; here the amplitude is 2 + 40 x - 30 y (in metres).

    It grows by 2 % a millimetre along x. The places lie between the positions of the stage, less than a step away.
    """
    mirror = add_mirror_echo(make_empty_scan(), z_m=0.5, amplitude=1.0)
    x_m = mirror.offsets_m[..., 0]
    y_m = mirror.offsets_m[..., 1]
    scan = replace(mirror, cube=mirror.cube * (2 + 40 * x_m - 30 * y_m))
    at_m = np.array([[0.0, 0.0, 0.0], [0.0009, -0.0007, 0.0], [-0.0004, 0.0008, 0.0]])
    path = np.full(3, find_mirror_path(scan, 0.5))
    echoes, inside = measure_echoes(scan, at_m, path, np.zeros((3, 2)), np.zeros((3, 2, 2)))
    assert inside.all()
    expected = 2 + 40 * at_m[:, 0] - 30 * at_m[:, 1]
    # They agree to 1.5e-6. The mean of the window, 2 in its middle, would be wrong by up to 3 %.
    assert np.abs(echoes.amplitude) == pytest.approx(expected, rel=1e-4)
