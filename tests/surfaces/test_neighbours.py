"""Two objects side by side, which one window of a scan hardly resolves: their echoes are separated, in H and in V."""

from dataclasses import replace

import numpy as np
import pytest
from tests.surfaces.test_paths import BEHIND, FRONT_M, add_sphere_echo, make_empty_scan

from polysight.surfaces import Samples
from polysight.surfaces.paths import find_echoes, measure_echoes
from polysight.surfaces.points import find_specular_points
from polysight.surfaces.window import Echoes

RADIUS_M = 0.06

# Paths from TX to RX that are searched
GATE_M = (1.4, 2.2)


def scan_two(apart_m: tuple[float, float, float], second: complex) -> tuple[Samples, list[np.ndarray]]:
    """Scan two spheres whose fronts are `apart_m` apart; their echoes have the amplitudes 0.5 and `second`."""
    fronts = [FRONT_M - np.array(apart_m) / 2, FRONT_M + np.array(apart_m) / 2]
    one_sphere = add_sphere_echo(make_empty_scan(), fronts[0], RADIUS_M, 0.5)
    both_spheres = add_sphere_echo(one_sphere, fronts[1], RADIUS_M, second)
    return both_spheres, fronts


def find_owner(echoes: Echoes, scan: Samples, fronts: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Distance of each echo's point from the surface of the nearer sphere, metres; and which sphere that is, 0 or 1."""
    points = find_specular_points(echoes.path_m, echoes.slope, echoes.at_m, scan.tx_m, scan.middle_m)
    distances_m = []
    for front in fronts:
        centre = front + RADIUS_M * BEHIND
        distances_m.append(np.abs(np.linalg.norm(points - centre, axis=1) - RADIUS_M))
    return np.min(distances_m, axis=0), np.argmin(distances_m, axis=0)


def keep_first_rx(scan: Samples) -> Samples:
    return replace(scan, cube=scan.cube[:1], rx_m=scan.rx_m[:1])


# One resolution cell of a window is 140 mm in x, 48 mm in y and 74 mm in range.
@pytest.mark.parametrize(
    ("apart_m", "with_one_rx"),
    [((0.15, 0, 0), False), ((0, 0.06, 0), False), ((0, 0, 0.1), False), ((0, 0.06, 0), True)],
)
def test_each_of_two_objects_has_its_own_place_and_strength(apart_m, with_one_rx):
    scan, fronts = scan_two(apart_m, 0.4j)
    if with_one_rx:
        scan = keep_first_rx(scan)
    echoes = find_echoes(scan, GATE_M)
    away_m, owner = find_owner(echoes, scan, fronts)
    windows = len(np.unique(echoes.at_m, axis=0))
    assert np.bincount(owner, minlength=2).tolist() == [windows, windows]
    # There is no noise: the places are within 8 micrometres of the spheres and the amplitudes within 0.8 %.
    assert away_m.max() < 1e-4
    assert np.abs(echoes.amplitude) == pytest.approx(np.where(owner == 0, 0.5, 0.4), rel=0.03)


def test_echoes_of_one_window_are_separated_along_known_paths():
    """V is measured along paths that H gives: a neighbour's echo must not leak into an object's ratio.

    The spheres are 70 mm apart in y. If each echo is measured alone, the weaker one is wrong by up to 47 %; together
    with the other, by 0.2 %.
    """
    scan, fronts = scan_two((0.0, 0.07, 0.0), 0.2)
    echoes = find_echoes(scan, GATE_M)
    _, owner = find_owner(echoes, scan, fronts)
    # Echoes with the same place are of one window.
    _, window = np.unique(echoes.at_m, axis=0, return_inverse=True)
    window = window.reshape(-1)
    paths = (echoes.at_m, echoes.path_m, echoes.slope, echoes.bend)
    together, inside = measure_echoes(scan, *paths, window=window)
    alone, _ = measure_echoes(scan, *paths)
    is_weak = owner == 1
    assert inside.all()
    assert np.abs(together.amplitude[is_weak]) == pytest.approx(0.2, rel=0.05)
    relative_errors_alone = np.abs(alone.amplitude[is_weak]) / 0.2 - 1
    assert np.abs(relative_errors_alone).max() > 0.1


def test_a_wave_that_an_edge_cuts_is_one_echo():
    """The edge of a plate cuts its wave. Two waves of opposite sign would fit it better, but there is one object."""
    scan, _ = scan_two((0.0, 0.0, 0.0), 0.5)
    column = np.arange(scan.valid.shape[1])
    # From 1 to 0 about the middle column, three columns (one e-fold) wide
    step = 1 / (1 + np.exp((column - column.mean()) / 3))
    cut = Samples(scan.cube * step, scan.valid, scan.offsets_m, scan.frequencies_hz, scan.tx_m, scan.rx_m)
    echoes = find_echoes(cut, GATE_M)
    amplitude = np.abs(echoes.amplitude)
    # Both spheres are at the same place: 0.5 + 0.5 where nothing is cut.
    assert amplitude.max() < 1
    # One strong echo in each window
    windows = len(np.unique(echoes.at_m, axis=0))
    assert (amplitude > 0.25).sum() == windows
