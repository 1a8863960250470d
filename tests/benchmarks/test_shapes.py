"""The benchmark of surfaces judges one small scan of a drawn object as it claims to."""

import numpy as np
import pytest
from benchmarks.shapes import ScanKind, angles_deg, judge_object, squared_distances

SMALL_SCAN = ScanKind(columns=64, rows=44)


@pytest.mark.slow
def test_a_drawn_sphere_is_found_where_it_is():
    figures = judge_object("sphere", 100, "none", SMALL_SCAN)
    assert figures.points > 10
    assert figures.stray <= 0.05 * figures.points
    assert figures.normal_deg is not None
    assert figures.normal_deg < 0.5
    assert figures.point_mm is not None
    assert figures.point_mm < 0.5
    assert figures.error is not None or figures.reason


def test_distances_in_regions_and_angles_are_those_of_their_definitions():
    deviations = np.array([3 + 4j, 0.1j])
    covariances = np.array([np.eye(2), np.diag([1.0, 0.01])])
    assert squared_distances(deviations, covariances) == pytest.approx([25, 1])
    tilted = np.array([[0.0, np.sin(0.01), np.cos(0.01)]])
    assert angles_deg(tilted, np.array([[0.0, 0.0, 1.0]])) == pytest.approx(np.degrees(0.01))
