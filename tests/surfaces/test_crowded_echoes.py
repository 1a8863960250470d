"""Echoes that a window hardly resolves: of two objects side by side, neither gets points from what they mix."""

from __future__ import annotations

import numpy as np
import pytest
from tests.surfaces.test_paths import FREQUENCIES_HZ, empty_scan, with_echo

from polysight.surfaces.measure import find_crowded
from polysight.surfaces.paths import WINDOW_M, Echoes, find_echoes
from polysight_shared.units import SPEED_OF_LIGHT_M_S

WAVE_NUMBER = 2 * np.pi * float(FREQUENCIES_HZ.mean()) / SPEED_OF_LIGHT_M_S
BANDWIDTH_HZ = float(np.ptp(FREQUENCIES_HZ))


def make_echoes(slope_cells: float, path_cells: float, ratio: float, distance_m: float = 0.0) -> Echoes:
    """Two echoes so many resolution cells apart, the second `ratio` as strong and from windows `distance_m` apart."""
    slope = slope_cells * 2 * np.pi / WAVE_NUMBER / WINDOW_M
    path_m = path_cells * SPEED_OF_LIGHT_M_S / BANDWIDTH_HZ
    return Echoes(
        at_m=np.array([[0.0, 0.0, 0.0], [distance_m, 0.0, 0.0]]),
        path_m=np.array([1.7, 1.7 + path_m]),
        slope=np.array([[0.0, 0.0], [slope, 0.0]]),
        bend=np.zeros((2, 2, 2)),
        amplitude=np.array([1.0, ratio], complex),
        amplitude_std=np.full(2, 1e-3),
        path_std_m=np.full(2, 1e-5),
        slope_std=np.full((2, 2), 1e-4),
        share=np.ones(2),
        band_rise=np.zeros(2),
    )


@pytest.mark.parametrize(
    ("slope_cells", "path_cells", "ratio", "distance_m", "expected"),
    [
        (1.0, 0.0, 1.0, 0.0, [True, True]),
        (1.0, 1.0, 1.0, 0.0, [True, True]),
        (2.0, 0.0, 1.0, 0.0, [False, False]),
        (0.0, 2.0, 1.0, 0.0, [False, False]),
        (1.0, 0.0, 0.3, 0.0, [False, True]),
        (1.0, 0.0, 1.0, 0.008, [False, False]),
    ],
)
def test_an_echo_is_crowded_by_a_strong_one_of_its_window_and_cell(
    slope_cells, path_cells, ratio, distance_m, expected
):
    echoes = make_echoes(slope_cells, path_cells, ratio, distance_m)
    assert find_crowded(echoes, WAVE_NUMBER, BANDWIDTH_HZ).tolist() == expected


def test_two_spheres_150_mm_apart_crowd_each_other_and_one_alone_does_not():
    first = np.array([-0.085, 0.104, 0.5])
    one = with_echo(empty_scan(), first, 0.06, 0.5)
    alone = find_echoes(one, (1.4, 2.0))
    assert not find_crowded(alone[np.abs(alone.amplitude) > 0.25], WAVE_NUMBER, BANDWIDTH_HZ).any()
    both = find_echoes(with_echo(one, first + np.array([0.15, 0.0, 0.0]), 0.06, 0.5), (1.4, 2.0))
    strong = both[np.abs(both.amplitude) > 0.25]
    assert find_crowded(strong, WAVE_NUMBER, BANDWIDTH_HZ).mean() > 0.8
