"""How much of the disc about a point its segment fills: all of it inside, half of it at a straight border."""

import numpy as np
import pytest

from polysight.surfaces.paths import STRIDE_M
from polysight.surfaces.permittivity import BORDER_DISC_M, SAME_COLUMN_M, find_filling


def lay_windows(stride_m: tuple[float, float], jitter_m: float) -> np.ndarray:
    """Places of windows over 0.2 m x 0.2 m, each moved a little."""
    x, y = np.meshgrid(*(np.arange(-0.1, 0.1, step) for step in stride_m))
    places = np.stack([x.ravel(), y.ravel()], axis=1)
    return places + jitter_m * np.random.default_rng(4).uniform(-1, 1, places.shape)


@pytest.mark.parametrize("stride_m", [(STRIDE_M, STRIDE_M), (0.01, 0.006), (0.007, 0.012)])
@pytest.mark.parametrize("jitter_m", [0.0, 0.2 * SAME_COLUMN_M])
def test_a_surface_fills_its_discs_whatever_the_distance_of_windows(stride_m, jitter_m):
    """Windows of one column lie up to 1.5 mm apart: these are no strides."""
    at_m = lay_windows(stride_m, jitter_m)
    extent_m = (at_m.min(axis=0), at_m.max(axis=0))
    filling = find_filling(at_m, np.zeros(len(at_m), int), extent_m)
    inside = np.abs(at_m).max(axis=1) < 0.1 - BORDER_DISC_M - max(stride_m)
    assert filling[inside] == pytest.approx(1.0, abs=0.1)
    # The end of the scan is no border.
    assert np.median(filling[~inside]) == pytest.approx(1.0, abs=0.1)


def test_a_straight_border_halves_the_disc():
    at_m = lay_windows((0.005, 0.005), 0.0)
    segment = (at_m[:, 0] > 0).astype(int)
    filling = find_filling(at_m, segment, (at_m.min(axis=0), at_m.max(axis=0)))
    middle = np.abs(at_m[:, 1]) < 0.04
    is_next = middle & (np.abs(at_m[:, 0]) < 0.004)
    is_far = middle & (np.abs(np.abs(at_m[:, 0]) - 0.075) < 0.01)
    assert filling[is_next] == pytest.approx(0.5, abs=0.06)
    assert filling[is_far] == pytest.approx(1.0, abs=0.06)
