"""The benchmark of surfaces: the errors of the surface that is found in a scan of a random object."""

import numpy as np
import pytest
from benchmarks.shapes import ScanKind, angles_deg, judge_object, squared_distances

SMALL_SCAN = ScanKind(columns=64, rows=44)


@pytest.mark.slow
def test_the_surface_of_a_sphere_is_found_where_it_is():
    """The limits of medians are those of the benchmark for this shape, `benchmarks.shapes.LARGE`."""
    figures = judge_object("sphere", seed=100, disturbance="none", scan=SMALL_SCAN)
    # 60 points, none of which is away from the sphere (measured).
    assert figures.points > 10
    assert figures.stray <= 0.05 * figures.points
    # 0.04 degrees and 0.04 mm (measured).
    assert figures.normal_deg is not None
    assert figures.normal_deg < 0.5
    assert figures.point_mm is not None
    assert figures.point_mm < 0.5
    # The error of the permittivity, or the reason why there is none.
    assert figures.error is not None or figures.reason


def test_distances_of_complex_numbers_are_in_standard_deviations_of_their_parts():
    deviations = np.array([3 + 4j, 0.1j])
    # Variances of real and imaginary part: 1 and 1 of the first number, 1 and 0.1 squared of the second.
    covariances = np.array([np.diag([1.0, 1.0]), np.diag([1.0, 0.1**2])])
    assert squared_distances(deviations, covariances) == pytest.approx([3**2 + 4**2, 1])


def test_angles_between_normals_are_in_degrees():
    tilt_rad = 0.01
    tilted_normals = np.array([[0.0, np.sin(tilt_rad), np.cos(tilt_rad)]])
    normals = np.array([[0.0, 0.0, 1.0]])
    assert angles_deg(tilted_normals, normals) == pytest.approx(np.degrees(tilt_rad))
