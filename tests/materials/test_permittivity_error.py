"""The error bar of a permittivity is the error of the ratio times the slope of Eq. 3.

It holds the estimates of the same plate at other places of the scan.
"""

import numpy as np
import pytest
from scipy import ndimage

from polysight.materials.measure import Scatter, estimate_border_errors, estimate_permittivity, relative_errors
from polysight.polarimetry import PlaneReference, permittivity_from_ratio, ratio_from_permittivity

THETA = np.radians(55.0)


def draw_pixels(eps, sigma, pixels, rng):
    """Return H and V of pixels of a plate with H = 1; `sigma` is the standard deviation of each part of V / H."""
    v_over_h = 1 / ratio_from_permittivity(eps, THETA)
    noise = sigma * (rng.standard_normal(pixels) + 1j * rng.standard_normal(pixels))
    return np.ones(pixels, complex), v_over_h + noise


def test_the_error_of_a_permittivity_grows_towards_metal():
    errors = []
    for eps in (2.0 - 0.1j, 4.0 - 0.1j, 8.0 - 0.1j, 16.0 - 0.1j):
        h, v = draw_pixels(eps, sigma=0.004, pixels=500, rng=np.random.default_rng(3))
        errors.append(estimate_permittivity(h, v, THETA).real_std)
    assert errors == sorted(errors)


def test_the_error_of_a_permittivity_is_that_of_the_ratio_times_the_slope_of_eq_3():
    step = 1e-6
    v_over_h = 1 / ratio_from_permittivity(4.0 - 0.1j, THETA)
    difference = permittivity_from_ratio(v_over_h + step, THETA) - permittivity_from_ratio(v_over_h - step, THETA)
    slope = abs(difference) / (2 * step)
    h, v = draw_pixels(4.0 - 0.1j, sigma=0.004, pixels=4000, rng=np.random.default_rng(4))
    # The spread of 4000 pixels, from the median deviation, has an error of 1.17 / sqrt(4000) = 2 %.
    assert estimate_permittivity(h, v, THETA).real_std == pytest.approx(slope * 0.004, rel=0.05)


def test_errors_of_a_plate_fall_with_the_root_of_its_independent_places():
    usual = (0.03, 0.04)
    no_slope = np.zeros(2, complex)
    errors = []
    for places in (1.0, 4.0, 25.0):
        scatter = Scatter(*usual, blocks=places, slope=no_slope, slope_std=no_slope, centre_m=(0, 0))
        errors.append(relative_errors(scatter, usual))
    error_of_one_place = np.array(relative_errors(None, usual))
    np.testing.assert_allclose(errors, [error_of_one_place, error_of_one_place / 2, error_of_one_place / 5])


def test_a_shifted_plate_stays_within_its_error_bar(synthetic, request):
    """Nine plates in random placements with noise: all estimates are within three standard errors."""
    placements = 8 if request.config.getoption("--long") else 3
    errors_in_stds = []
    for seed in range(placements):
        scene = synthetic(seed, uneven=0.0)
        for patch in scene.analyse().patches:
            e = patch.permittivity
            truth = patch.truth
            if truth is None or truth.permittivity is None or e.value is None:
                continue
            difference = e.value - truth.permittivity
            errors_in_stds += [difference.real / e.real_std, difference.imag / e.loss_std]
    # Of nine plates eight have a permittivity, two numbers each.
    assert len(errors_in_stds) > 10 * placements
    # Here the largest is 1.3 and the root mean square 0.51.
    assert max(np.abs(errors_in_stds)) < 3
    assert np.sqrt(np.mean(np.square(errors_in_stds))) < 1.2


def measure_with_separate_metal(scene, lit, segmentation):
    """Return patch number to the error of its real part, with metal measured in another scan, at the pixels `lit`."""
    ones = np.ones(scene.h.shape, complex)
    metal = PlaneReference(ones, ones, lit, scene.x_m, scene.y_m, spread=1e-3, how="drawn")
    patches = scene.analyse(metal=metal, segmentation=segmentation).patches
    return {p.patch.label: p.permittivity.real_std for p in patches if p.permittivity.value is not None}


def test_a_plate_at_the_end_of_the_lit_area_has_a_larger_error(synthetic):
    """At the end of the lit area the edges of a plate change its image, and metal of another scan had other edges."""
    scene = synthetic(seed=3, noise=0.002)
    segmentation = scene.analyse().segmentation
    everywhere = np.ones(scene.h.shape, bool)
    inside = measure_with_separate_metal(scene, everywhere, segmentation)
    patch = next(p for p in segmentation.patches if p.label in inside)
    columns = np.flatnonzero(patch.mask.any(axis=0))
    # The lit area ends seven pixels, 14 mm, before the end of the patch.
    lit = everywhere.copy()
    lit[:, columns[-1] - 7 :] = False
    at_border = measure_with_separate_metal(scene, lit, segmentation)
    # The error becomes 2.9 times as large.
    assert at_border[patch.label] > 1.2 * inside[patch.label]


def test_a_plate_that_fills_the_lit_area_has_no_error_of_its_border(synthetic):
    """The metal that is the reference had the same edges. A plate far away from the border has no such error either."""
    scene = synthetic(seed=3)
    patch = scene.analyse().segmentation.patches[0]
    assert estimate_border_errors(patch, patch.mask, scene.x_m) == (0.0, 0.0)
    # With metal whose edges are a pixel farther out, the errors are 6 % in amplitude and 3 % in phase.
    lit = ndimage.binary_dilation(patch.mask)
    assert min(estimate_border_errors(patch, lit, scene.x_m)) > 0.005
    assert estimate_border_errors(patch, np.ones(patch.mask.shape, bool), scene.x_m) == (0.0, 0.0)


def test_a_box_over_dark_pixels_has_the_largest_error(synthetic):
    """Boxes drawn by hand may lie in dark parts of the image: they get the largest error that there is, 0.2."""
    scene = synthetic(seed=3)
    patch = scene.analyse().segmentation.patches[0]
    assert estimate_border_errors(patch, ~patch.mask, scene.x_m) == (0.2, 0.2)


def test_the_error_at_the_end_of_the_aperture_falls_with_the_distance(synthetic):
    """The effect on the amplitude is largest near the end; that on the phase falls more slowly."""
    scene = synthetic(seed=3)
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
