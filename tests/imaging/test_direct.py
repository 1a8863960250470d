"""Backprojection by direct sum: focus, adjoint, linearity, for any antennas and voxels."""

import numpy as np
import pytest

from polysight.imaging import backproject, project
from polysight_shared.units import SPEED_OF_LIGHT_M_S as C


def _compute_phase_history(f, tx, rx, reference, points, amplitudes):
    """Samples [pulse, frequency] of point targets; the phase is that of the path minus the pulse's reference path."""
    out = np.zeros((len(tx), f.size), complex)
    for point, amplitude in zip(points, amplitudes, strict=True):
        d = np.linalg.norm(point - tx, axis=1) + np.linalg.norm(point - rx, axis=1) - reference
        out += amplitude * np.exp(2j * np.pi * f * d[:, None] / C)
    return out


def test_a_monostatic_radar_referenced_to_the_scene_centre_focuses_in_three_dimensions():
    """60 pulses at 9 to 10 GHz from 50 m away. Heights of the radar that scatter by 3 m give a resolution in z."""
    rng = np.random.default_rng(0)
    f = np.linspace(9e9, 10e9, 40)
    angle = np.linspace(-0.1, 0.1, 60)
    radar = 50 * np.column_stack([np.sin(angle), np.full(60, -1.0), 0.3 + 0.06 * rng.standard_normal(60)])
    # The phase of each pulse is that of the path to the middle of the scene and back.
    reference = 2 * np.linalg.norm(radar, axis=1)
    points = np.array([[1.0, -0.5, 0.2], [-1.5, 1.0, 0.0]])
    amplitudes = np.array([1.0, 0.5j])
    samples = _compute_phase_history(f, radar, radar, reference, points, amplitudes)
    # The plane z = 0.2, in steps of 5 and 10 cm: the first point lies on it, and on one of its voxels.
    x, y = np.meshgrid(np.linspace(-2, 2, 81), np.linspace(-2, 2, 41))
    voxels = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, 0.2)])
    image = np.abs(backproject(samples, f, radar, radar, voxels, reference)) / samples.size
    brightest_voxel = voxels[np.argmax(image)]
    assert np.abs(brightest_voxel - points[0]).max() < 1e-9
    # The point has amplitude 1. The sidelobes of the second one, half as strong, may add to it; 0.001 is measured here.
    assert image.max() == pytest.approx(1, abs=0.15)
    # A line through the point along z; it is the middle one of 21 voxels.
    along_z = points[0] + np.linspace(-1, 1, 21)[:, None] * [0, 0, 1]
    focus = backproject(samples, f, radar, radar, along_z, reference) / samples.size
    middle = 10
    assert np.argmax(np.abs(focus)) == middle
    # For the same reason the phase may change a little; 0.0001 rad is measured.
    assert np.angle(focus[middle]) == pytest.approx(0, abs=0.15)


def test_evenly_spaced_frequencies_by_horner_equal_the_plain_sum():
    rng = np.random.default_rng(1)
    f = 76e9 + 1e8 * np.arange(9)
    tx = rng.uniform(-0.5, 0.5, (7, 3))
    rx = rng.uniform(-0.5, 0.5, (7, 3))
    voxels = rng.uniform(-0.5, 0.5, (7, 3))
    reference = rng.uniform(0, 1, 7)
    s = rng.standard_normal((7, 9)) + 1j * rng.standard_normal((7, 9))
    # Frequencies in another order are not evenly spaced, so that each gets an exponential of its own.
    order = rng.permutation(9)
    even = backproject(s, f, tx, rx, voxels, reference)
    shuffled = backproject(s[:, order], f[order], tx, rx, voxels, reference)
    np.testing.assert_allclose(even, shuffled, rtol=1e-8)
    d = np.linalg.norm(voxels[:, None] - tx, axis=2) + np.linalg.norm(voxels[:, None] - rx, axis=2) - reference
    plain = (s * np.exp(-2j * np.pi * d[..., None] * f / C)).sum(axis=(1, 2))
    np.testing.assert_allclose(even, plain, rtol=1e-8)


@pytest.mark.parametrize("evenly_spaced", [True, False])
def test_project_is_the_adjoint_of_backproject_for_any_antennas_and_voxels(evenly_spaced):
    """<project(x), y> = <x, backproject(y)> for any x and y."""
    rng = np.random.default_rng(5)
    if evenly_spaced:
        f = 76e9 + 4e8 * np.arange(9)
    else:
        f = 76e9 + np.sort(rng.uniform(0, 4e9, 9))
    tx = rng.uniform(-1, 1, (40, 3))
    rx = rng.uniform(-1, 1, (40, 3))
    reference = rng.uniform(0, 2, 40)
    voxels = rng.uniform(-1, 1, (30, 3))
    y = rng.standard_normal((40, 9)) + 1j * rng.standard_normal((40, 9))
    x = rng.standard_normal(30) + 1j * rng.standard_normal(30)
    forward = np.vdot(project(x, f, tx, rx, voxels, reference), y)
    back = np.vdot(x, backproject(y, f, tx, rx, voxels, reference))
    assert abs(forward - back) < 1e-10 * np.linalg.norm(x) * np.linalg.norm(y)


def test_backprojection_is_linear_and_works_with_one_frequency():
    rng = np.random.default_rng(2)
    tx = rng.uniform(-0.5, 0.5, (5, 3))
    rx = rng.uniform(-0.5, 0.5, (5, 3))
    voxels = rng.uniform(-0.5, 0.5, (5, 3))
    a = rng.standard_normal((5, 1)) + 0j
    b = rng.standard_normal((5, 1)) + 0j
    no_reference_m = np.zeros(5)
    geometry = ([77e9], tx, rx, voxels, no_reference_m)
    image_of_sum = backproject(a + 2j * b, *geometry)
    sum_of_images = backproject(a, *geometry) + 2j * backproject(b, *geometry)
    np.testing.assert_allclose(image_of_sum, sum_of_images, rtol=1e-9)


@pytest.mark.parametrize(
    "change",
    [{"samples": np.zeros(3)}, {"frequencies_hz": [1.0]}, {"tx_m": np.zeros((2, 3))}, {"voxels_m": np.zeros(3)}],
)
def test_shapes_that_do_not_fit_are_refused(change):
    valid_arguments = {
        "samples": np.zeros((3, 2)),
        "frequencies_hz": [1.0, 2.0],
        "tx_m": np.zeros((3, 3)),
        "rx_m": np.zeros((3, 3)),
        "voxels_m": np.zeros((4, 3)),
        "reference_m": np.zeros(3),
    }
    assert backproject(**valid_arguments).shape == (4,)
    # The message has the expected shapes in brackets, as "[position, frequency]".
    with pytest.raises(ValueError, match=r"\["):
        backproject(**{**valid_arguments, **change})
