"""A metal plate over the whole image plane as reference: gains that vary are divided out, dark pixels are masked."""

import numpy as np
import pytest
from hypothesis import given, strategies as st
from tests.support.refusals import expect_refusal

from polysight.imaging import Images
from polysight.polarimetry import fresnel, plane_reference
from polysight_shared.errors import ErrorCode

THETA = np.radians(55.0)

# Pixels of 2 mm, metres
X = np.arange(60) * 2e-3
Y = np.arange(50) * 2e-3


def make_images(h, v):
    shape = (Y.size, X.size)
    return Images(np.broadcast_to(h, shape), np.broadcast_to(v, shape), X, Y, np.ones(shape, bool))


def draw_gains(rng, depth):
    """Gain of each channel, which varies over the plane by about `depth` (a third of a wave from edge to edge)."""
    y, x = np.meshgrid(Y / Y[-1], X / X[-1], indexing="ij")
    waves = [a * np.sin(2 * x + b) + c * np.cos(2 * y) for a, b, c in rng.uniform(-1, 1, (4, 3))]
    gain_h = np.exp(depth * (waves[0] + 1j * waves[2]))
    gain_v = np.exp(depth * (waves[1] + 1j * waves[3]))
    return gain_h, gain_v


def add_noise(image, rng, noise):
    """The image with complex white noise of this standard deviation."""
    return image + noise / np.sqrt(2) * (rng.standard_normal(image.shape) + 1j * rng.standard_normal(image.shape))


@given(st.integers(0, 2**32 - 1), st.floats(-3.1, 3.1), st.floats(-100, 100))
def test_gains_over_the_plane_are_divided_out(seed, phase, tilt):
    """A common phase of both channels, by distance or tilt of the plates, has no influence."""
    gain_h, gain_v = draw_gains(np.random.default_rng(seed), depth=0.1)
    common = np.exp(1j * (phase + tilt * X))[None, :]
    reference = plane_reference(make_images(-gain_h * common, -gain_v * common))
    r_s, r_p = fresnel(4 - 0.4j, THETA)
    corrected = reference.apply(make_images(gain_h * r_s, gain_v * r_p))
    is_valid = reference.valid
    # There is metal everywhere, and the gains vary by some 10 % only: nothing is too weak.
    assert is_valid.mean() > 0.9
    # The reference is smoothed, which changes gains that vary. Over 150 draws P was wrong by up to 1.9 %, |H| by up to
    # 1.1 %, and P in the middle, where the window is not one-sided, by up to 0.34 %. The limits are at least 3.5 times
    # as large.
    np.testing.assert_allclose(corrected.p[is_valid], r_s / r_p, rtol=0.08)
    np.testing.assert_allclose(np.abs(corrected.h[is_valid]), abs(r_s), rtol=0.08)
    np.testing.assert_allclose(corrected.p[15:-15, 15:-15], r_s / r_p, rtol=0.012)


def test_speckle_of_the_plate_is_smoothed_and_measured():
    rng = np.random.default_rng(3)
    ones = np.ones((Y.size, X.size), complex)
    reference = plane_reference(make_images(add_noise(ones, rng, 0.05), add_noise(ones, rng, 0.05)))
    ratio = (reference.h / reference.v)[reference.valid]
    # Of a single pixel the ratio scatters by sqrt(2) * 0.05 = 0.07, of smoothed ones by 0.005.
    assert np.std(ratio) < 0.01
    # The variance of each part of V / H is half of the power of H's noise plus half of V's: 0.05^2 / 2 + 0.05^2 / 2.
    assert reference.spread == pytest.approx(0.05, rel=0.2)


def test_weak_parts_and_the_rim_are_masked():
    """The plate ends at x = 70 mm; beyond its end the amplitude is 40 dB less."""
    rng = np.random.default_rng(4)
    h = np.where(X[None, :] < 0.07, 1.0, 0.01) * np.ones((Y.size, 1), complex)
    reference = plane_reference(make_images(add_noise(h, rng, 0.01), add_noise(h, rng, 0.01)), smooth_mm=4.0)
    # Smoothing mixes dark pixels into the rim of the plate, which is 4 mm wide as the window: the last column that is
    # valid is at 66 mm.
    assert reference.valid[:, X < 0.06].all()
    assert not reference.valid[:, X > 0.068].any()
    assert np.isnan(reference.h[:, -1]).all()
    corrected = reference.apply(make_images(h, h))
    assert np.isnan(corrected.p[:, -1]).all()
    np.testing.assert_allclose(corrected.p[reference.valid], 1, atol=0.02)
    # The share is rounded to four digits.
    assert reference.facts().share_of_plane == pytest.approx(reference.valid.mean(), abs=1e-4)


def test_facts_of_a_reference_hold_the_variation_of_the_gains_over_the_plane():
    # The gains vary by up to some 2 %, or 0.2 dB; the standard deviation of their ratio is 0.044 dB.
    gain_h, gain_v = draw_gains(np.random.default_rng(5), depth=0.02)
    reference = plane_reference(make_images(gain_h, gain_v))
    assert reference.facts().ratio_variation_db > 0.01


def test_images_without_a_metal_plate_are_refused():
    dark = np.zeros((Y.size, X.size), complex)
    with expect_refusal(ErrorCode.NO_DATA):
        plane_reference(make_images(dark, dark))
    # Single bright pixels
    spots = dark.copy()
    spots[::10, ::10] = 1.0
    with expect_refusal(ErrorCode.NO_DATA):
        plane_reference(make_images(spots, spots), smooth_mm=2.0)
    with expect_refusal(ErrorCode.MISMATCH):
        plane_reference(make_images(dark + 1, dark + 1)).check_axes(X + 1e-3, Y)


@pytest.mark.parametrize("permittivity", [2.1, 4.75 - 2.43j, 9 - 0.2j])
def test_a_scene_with_other_plates_than_the_metal_is_refused(permittivity):
    """If it were accepted, all pixels except the metal's would be masked without a message."""
    r_s, r_p = fresnel(permittivity, THETA)
    is_metal = (X < 0.07)[None, :]
    h = np.where(is_metal, 1.0, r_s) * np.ones((Y.size, 1), complex)
    v = np.where(is_metal, 1.0, r_p) * np.ones((Y.size, 1), complex)
    with expect_refusal(ErrorCode.MISMATCH):
        plane_reference(make_images(h, v))


@given(st.integers(0, 2**32 - 1), st.floats(0.02, 0.12))
def test_a_metal_plate_alone_is_accepted_however_small_and_unevenly_lit(seed, width_m):
    """Outside of the plate the amplitude is 34 dB less."""
    gain_h, gain_v = draw_gains(np.random.default_rng(seed), depth=0.1)
    amplitude = np.where((width_m > X)[None, :], 1.0, 0.02)
    plane_reference(make_images(gain_h * amplitude, gain_v * amplitude), smooth_mm=2.0)
