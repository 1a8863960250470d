"""The path of an echo over a window is recovered."""

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
    locate,
    predict_echo,
)
from polysight.surfaces.window import find_mirror_path
from polysight_shared.units import SPEED_OF_LIGHT_M_S
from polysight_worlds.rig import published_boards
from polysight_worlds.shape_scenes import scan_offsets

C = SPEED_OF_LIGHT_M_S
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
    """Add a metal sphere's specular path, found by minimising over its surface with Newton's method."""
    centre = point_m + np.array([0.0, 0.0, radius_m])
    tx = scan.tx_m + scan.offsets_m
    rx = scan.rx_m[:, None, None] + scan.offsets_m
    normal = np.array([0.0, 0.0, -1.0])
    for _ in range(12):
        p = centre + radius_m * normal
        way = _normalise(tx - p) + _normalise(rx - p)
        normal = _normalise(way)
    p = centre + radius_m * normal
    paths = np.linalg.norm(p - tx, axis=-1) + np.linalg.norm(p - rx, axis=-1)
    excess = paths - scan.direct_m[:, None, None]
    turns = scan.frequencies_hz[None, :, None, None] * excess[:, None] / C
    return replace(scan, cube=scan.cube + amplitude * np.exp(2j * np.pi * turns))


def add_mirror_echo(scan: Samples, z_m: float, amplitude: complex) -> Samples:
    """Add the echo of a level mirror, the same for all stage positions."""
    image = scan.tx_m * [1, 1, -1] + [0, 0, 2 * z_m]
    excess = np.linalg.norm(scan.rx_m - image, axis=1) - scan.direct_m
    echo = amplitude * np.exp(2j * np.pi / C * np.outer(excess, scan.frequencies_hz))
    return replace(scan, cube=scan.cube + echo[:, :, None, None])


BEHIND = np.array([0.0, 0.0, 1.0])
FRONT_M = np.array([-0.01, 0.104, 0.5])


def test_a_sphere_of_rays_is_found_with_point_normal_and_radius():
    scan = add_sphere_echo(make_empty_scan(), FRONT_M, 0.12, 0.5 * np.exp(0.3j))
    echoes = find_echoes(scan, (1.4, 2.0))
    points = locate(echoes.path_m, echoes.slope, echoes.at_m, scan.tx_m, scan.middle_m)
    normals, _ = find_normals(points, echoes.at_m, scan.tx_m, scan.middle_m)
    bends = find_curvature(points, normals, echoes.at_m, scan.tx_m, scan.middle_m, echoes.bend)
    errors_m = points - FRONT_M - 0.12 * BEHIND
    assert np.abs(np.linalg.norm(errors_m, axis=1) - 0.12).max() < 1e-4
    assert np.abs(np.cross(normals, errors_m / 0.12)).max() < np.radians(0.1)
    assert np.allclose(np.linalg.eigvalsh(bends), 1 / 0.12, rtol=0.1)
    assert np.abs(echoes.amplitude) == pytest.approx(0.5, rel=1e-2)


def test_a_weak_echo_is_found_near_a_strong_one():
    strong = add_mirror_echo(make_empty_scan(), 0.65, 1.0)
    both_echoes = add_sphere_echo(strong, FRONT_M, 0.1, 0.16)
    echoes = find_echoes(both_echoes, (1.4, 2.1))
    points = locate(echoes.path_m, echoes.slope, echoes.at_m, both_echoes.tx_m, both_echoes.middle_m)
    from_weak = np.abs(np.linalg.norm(points - (FRONT_M + 0.1 * BEHIND), axis=1) - 0.1)
    assert (from_weak < 1e-3).sum() >= len(np.unique(echoes.at_m, axis=0))


def test_the_path_of_a_point_gives_the_point_back():
    scan = make_empty_scan()
    rng = np.random.default_rng(1)
    n = 200
    points = rng.uniform([-0.1, 0.0, 0.4], [0.1, 0.2, 0.6], (n, 3))
    at_m = np.stack([rng.uniform(-0.05, 0.05, n), rng.uniform(-0.05, 0.05, n), np.zeros(n)], axis=1)
    normals, _ = find_normals(points, at_m, scan.tx_m, scan.middle_m)
    bends = rng.uniform(-2, 15, (n, 2, 2))
    bends = (bends + np.swapaxes(bends, 1, 2)) / 2
    path, slope, bend = predict_echo(points, normals, bends, at_m, scan.tx_m, scan.middle_m)
    assert np.allclose(locate(path, slope, at_m, scan.tx_m, scan.middle_m), points, atol=1e-8)
    assert np.allclose(find_curvature(points, normals, at_m, scan.tx_m, scan.middle_m, bend), bends, atol=1e-4)
    seen_from = find_offset_that_sees(points, normals, at_m + np.array([0.01, 0.02, 0]), scan.tx_m, scan.middle_m)
    assert np.allclose(seen_from, at_m, atol=1e-8)


def test_a_mirror_spreads_as_its_path():
    scan = make_empty_scan()
    at_m = np.zeros((1, 3))
    image = scan.tx_m * [1, 1, -1] + [0, 0, 1.0]
    share = (0.5 - scan.middle_m[2]) / (image[2] - scan.middle_m[2])
    point = (scan.middle_m + share * (image - scan.middle_m))[None]
    normals, _ = find_normals(point, at_m, scan.tx_m, scan.middle_m)
    _, _, out_m, back_m = compute_unit_legs(point, at_m, scan.tx_m, scan.middle_m)
    factors = compute_spreading(point, normals, np.zeros((1, 2, 2)), at_m, scan.tx_m, scan.middle_m)
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
    height, width = scan.window_shape()
    expected = 2 / (len(scan.rx_m) * FREQUENCIES_HZ.size * height * width)
    assert inside.all()
    assert np.mean(np.abs(echoes.amplitude) ** 2) / expected == pytest.approx(1, abs=0.6)


def test_an_amplitude_is_that_of_the_place_asked_not_of_the_window():
    """Places between stage positions: |V| changes by a per cent a millimetre near Brewster's angle."""
    level = 2 + 40 * make_empty_scan().offsets_m[..., 0] - 30 * make_empty_scan().offsets_m[..., 1]
    mirror = add_mirror_echo(make_empty_scan(), 0.5, 1.0)
    scan = replace(mirror, cube=mirror.cube * level)
    at_m = np.array([[0.0, 0.0, 0.0], [0.0009, -0.0007, 0.0], [-0.0004, 0.0008, 0.0]])
    path = np.full(3, find_mirror_path(scan, 0.5))
    echoes, inside = measure_echoes(scan, at_m, path, np.zeros((3, 2)), np.zeros((3, 2, 2)))
    assert inside.all()
    assert np.abs(echoes.amplitude) == pytest.approx(2 + 40 * at_m[:, 0] - 30 * at_m[:, 1], rel=1e-4)
