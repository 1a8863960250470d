"""The error bar of a permittivity is the slope of Eq. 3, and contains the same plate at other places."""

import numpy as np
import pytest
from scipy import ndimage

from polysight.materials.measure import Scatter, estimate_border_errors, estimate_permittivity, relative_errors
from polysight.polarimetry import PlaneReference, permittivity_from_ratio, ratio_from_permittivity

THETA = np.radians(55.0)


def draw_pixels(eps, sigma, n, rng):
    q = 1 / ratio_from_permittivity(eps, THETA)
    return np.ones(n, complex), q + sigma * (rng.standard_normal(n) + 1j * rng.standard_normal(n))


def test_the_error_grows_towards_metal():
    sizes = [
        estimate_permittivity(*draw_pixels(eps, 0.004, 500, np.random.default_rng(3)), THETA).real_std
        for eps in (2.0 - 0.1j, 4.0 - 0.1j, 8.0 - 0.1j, 16.0 - 0.1j)
    ]
    assert sizes == sorted(sizes)
    step = 1e-6
    q = 1 / ratio_from_permittivity(4.0 - 0.1j, THETA)
    slope = abs(permittivity_from_ratio(q + step, THETA) - permittivity_from_ratio(q - step, THETA)) / (2 * step)
    h, v = draw_pixels(4.0 - 0.1j, 0.004, 4000, np.random.default_rng(4))
    assert estimate_permittivity(h, v, THETA).real_std == pytest.approx(slope * 0.004, rel=0.05)


def test_errors_of_a_plate_fall_with_the_root_of_its_independent_places():
    usual = (0.03, 0.04)
    none = np.zeros(2, complex)
    errors = [relative_errors(Scatter(*usual, blocks, none, none, (0, 0)), usual) for blocks in (1.0, 4.0, 25.0)]
    np.testing.assert_allclose(errors, np.array([relative_errors(None, usual)]) / [[1], [2], [5]])


def test_a_shifted_plate_stays_within_its_error_bar(synthetic, request):
    """Nine plates in random placements with noise: all estimates are within three standard errors."""
    placements = 8 if request.config.getoption("--long") else 3
    z = []
    for seed in range(placements):
        scene = synthetic(seed, uneven=0.0)
        for patch in scene.analyse().patches:
            e = patch.permittivity
            truth = patch.truth
            if truth is None or truth.permittivity is None or e.value is None:
                continue
            difference = e.value - truth.permittivity
            z += [difference.real / e.real_std, difference.imag / e.loss_std]
    assert len(z) > 10 * placements
    assert max(np.abs(z)) < 3
    assert np.sqrt(np.mean(np.square(z))) < 1.2


def measure_with_separate_metal(scene, lit, segmentation):
    """Patch number to the error of its real part, with metal that was measured only at the pixels `lit`."""
    ones = np.ones(scene.h.shape, complex)
    metal = PlaneReference(ones, ones, lit, scene.x_m, scene.y_m, spread=1e-3, how="drawn")
    patches = scene.analyse(metal=metal, segmentation=segmentation).patches
    return {p.patch.label: p.permittivity.real_std for p in patches if p.permittivity.value is not None}


def test_a_plate_that_the_end_of_a_small_aperture_lights_is_known_less_well(synthetic):
    """Metal of another scan was lit by the same aperture, but not next to the edges of these plates."""
    scene = synthetic(3, noise=0.002)
    segmentation = scene.analyse().segmentation
    everywhere = np.ones(scene.h.shape, bool)
    inside = measure_with_separate_metal(scene, everywhere, segmentation)
    neighbour = next(p for p in segmentation.patches if p.label in inside)
    columns = np.flatnonzero(neighbour.mask.any(axis=0))
    lit = everywhere.copy()
    lit[:, columns[-1] - 7 :] = False
    at_border = measure_with_separate_metal(scene, lit, segmentation)
    assert at_border[neighbour.label] > 1.2 * inside[neighbour.label]


def test_a_plate_that_fills_the_lit_pixels_is_lit_as_the_metal_was(synthetic):
    scene = synthetic(3)
    patch = scene.analyse().segmentation.patches[0]
    assert estimate_border_errors(patch, patch.mask, scene.x_m) == (0.0, 0.0)
    lit = ndimage.binary_dilation(patch.mask)
    assert min(estimate_border_errors(patch, lit, scene.x_m)) > 0.005
    assert estimate_border_errors(patch, np.ones(patch.mask.shape, bool), scene.x_m) == (0.0, 0.0)


def test_a_box_over_dark_pixels_has_the_largest_error(synthetic):
    """Boxes drawn by hand may lie in dark parts of the image."""
    scene = synthetic(3)
    patch = scene.analyse().segmentation.patches[0]
    assert estimate_border_errors(patch, ~patch.mask, scene.x_m) == (0.2, 0.2)


def test_the_error_at_the_end_of_the_aperture_falls_with_the_distance(synthetic):
    """The effect on the amplitude is largest near the end; that on the phase falls more slowly."""
    scene = synthetic(3)
    patch = scene.analyse().segmentation.patches[0]
    errors = []
    for distance_px in range(1, 24, 2):
        lit = ndimage.binary_dilation(patch.mask, iterations=distance_px)
        errors.append(estimate_border_errors(patch, lit, scene.x_m))
    amplitude, phase = np.array(errors).T
    assert (np.diff(amplitude) < 0).all()
    assert (np.diff(phase) < 0).all()
    assert amplitude[0] > phase[0]
    assert amplitude[-1] < phase[-1]
