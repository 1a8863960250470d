"""How much of the disc about a point is filled with points of the same segment.

It is all of the disc inside a segment, and half of it at a straight border. `at_m` are the places of windows, which are
parts of a scan that give one point each.
"""

import numpy as np
import pytest

from polysight.surfaces.paths import STRIDE_M
from polysight.surfaces.permittivity import BORDER_DISC_M, SAME_COLUMN_M, find_filling


def lay_windows(stride_m: tuple[float, float], jitter_m: float) -> np.ndarray:
    """Places of windows over 0.2 m x 0.2 m, each moved by up to `jitter_m` along both axes."""
    x, y = np.meshgrid(*(np.arange(-0.1, 0.1, step) for step in stride_m))
    places = np.stack([x.ravel(), y.ravel()], axis=1)
    return places + jitter_m * np.random.default_rng(4).uniform(-1, 1, places.shape)


@pytest.mark.parametrize("stride_m", [(STRIDE_M, STRIDE_M), (0.01, 0.006), (0.007, 0.012)])
@pytest.mark.parametrize("jitter_m", [0.0, 0.2 * SAME_COLUMN_M])
def test_a_surface_fills_its_discs_whatever_the_distance_of_windows(stride_m, jitter_m):
    """Windows of one column may lie up to `SAME_COLUMN_M` apart in x, which must not be taken for their distance."""
    at_m = lay_windows(stride_m, jitter_m)
    extent_m = (at_m.min(axis=0), at_m.max(axis=0))
    filling = find_filling(at_m, np.zeros(len(at_m), int), extent_m)
    inside = np.abs(at_m).max(axis=1) < 0.1 - BORDER_DISC_M - max(stride_m)
    # Windows are counted: whether one near the rim of the disc lies in it changes the share by up to 7 %.
    assert filling[inside] == pytest.approx(1.0, abs=0.1)
    # The end of the scan is no border.
    assert np.median(filling[~inside]) == pytest.approx(1.0, abs=0.1)


def test_a_straight_border_halves_the_disc():
    at_m = lay_windows((0.005, 0.005), 0.0)
    segment = (at_m[:, 0] > 0).astype(int)
    filling = find_filling(at_m, segment, (at_m.min(axis=0), at_m.max(axis=0)))
    # Neither place is near the end of the scan in y. The disc has a radius of 50 mm.
    in_middle_rows = np.abs(at_m[:, 1]) < 0.04
    from_border_m = np.abs(at_m[:, 0])
    is_next = in_middle_rows & (from_border_m < 0.004)
    is_far = in_middle_rows & (np.abs(from_border_m - 0.075) < 0.01)
    # 0.53: the column on the border itself belongs to the segment.
    assert filling[is_next] == pytest.approx(0.5, abs=0.06)
    assert filling[is_far] == pytest.approx(1.0, abs=0.06)
