"""Calibration of images with metal, and the incidence angle of a rig.

Divided by the metal, H / V of metal is 1. Gains and phases that both channels share cancel, and a known leakage between
the polarisations is removed.
"""

import numpy as np
import pytest
from hypothesis import given, strategies as st
from tests.support.refusals import expect_refusal
from tests.support.rigs import load_published_rig

from polysight import polarimetry
from polysight.imaging import Images
from polysight.polarimetry.calibrate import ratio
from polysight_shared.errors import ErrorCode
from polysight_shared.geometry import incidence_deg, specular_midpoint_m

THETA = np.radians(55.0)

# An image of a metal plate on the left and a dielectric plate on the right; 0 between them.
SHAPE = (40, 60)
METAL = np.zeros(SHAPE, bool)
METAL[10:30, 5:25] = True
PLATE = np.zeros(SHAPE, bool)
PLATE[10:30, 35:55] = True

# Random complex numbers, drawn as magnitude and phase (radians)
complex_gain = st.tuples(st.floats(0.2, 5.0), st.floats(-3.1, 3.1)).map(lambda g: g[0] * np.exp(1j * g[1]))
leak = st.tuples(st.floats(0.0, 0.12), st.floats(-3.1, 3.1)).map(lambda g: g[0] * np.exp(1j * g[1]))


def make_images(h, v):
    return Images(h, v, np.arange(h.shape[1]) * 2e-3, np.arange(h.shape[0]) * 2e-3, np.ones(h.shape, bool))


def make_channels(eps, gain_h=1.0, gain_v=1.0, a=0.0, b=0.0, common=None, noise=0.0):
    """H and V of a metal plate and of one of permittivity `eps`.

    H = gain_h (r_s + a r_p) and V = gain_v (r_p + b r_s), both times `common` [ny, nx]. Noise with the standard
    deviation `noise` is added.
    """
    r_s = np.zeros(SHAPE, complex)
    r_p = np.zeros(SHAPE, complex)
    r_s[METAL], r_p[METAL] = polarimetry.fresnel(np.inf, THETA)
    r_s[PLATE], r_p[PLATE] = polarimetry.fresnel(eps, THETA)
    rng = np.random.default_rng(1)
    h = gain_h * (r_s + a * r_p)
    v = gain_v * (r_p + b * r_s)
    if common is not None:
        h = h * common
        v = v * common
    real_h, imag_h, real_v, imag_v = rng.standard_normal((4, *SHAPE)) * noise / np.sqrt(2)
    return h + real_h + 1j * imag_h, v + real_v + 1j * imag_v


def test_a_ratio_that_is_not_a_number_is_nan_and_warns_of_nothing(recwarn):
    # 2 / 1e-45 is larger than the largest float32; the others are 1 / 0, nan / 1 and 1 / inf.
    h = np.array([1.0, 2.0, 1.0, np.nan, 1.0], np.complex64)
    v = np.array([2.0, 1e-45, 0.0, 1.0, np.inf], np.complex64)
    p = ratio(h, v)
    assert p[0] == 0.5
    assert np.isnan(p[1:].real).all()
    assert np.isnan(p[1:].imag).all()
    assert not list(recwarn)


@given(complex_gain, complex_gain)
def test_metal_is_one_and_gain_is_recovered(gain_h, gain_v):
    h, v = make_channels(4 - 0.4j, gain_h, gain_v)
    out = polarimetry.calibrate(make_images(h, v), METAL)
    np.testing.assert_allclose(out.p[METAL], 1, rtol=1e-9)
    np.testing.assert_allclose(np.abs(out.h[METAL]), 1, rtol=1e-9)
    assert out.metal_h / out.metal_v == pytest.approx(gain_h / gain_v, rel=1e-9)
    r_s, r_p = polarimetry.fresnel(4 - 0.4j, THETA)
    np.testing.assert_allclose(out.p[PLATE], r_s / r_p, rtol=1e-9)


def test_metal_is_one_within_noise():
    h, v = make_channels(4 - 0.4j, gain_h=2.0j, gain_v=0.7, noise=0.02)
    p = polarimetry.calibrate(make_images(h, v), METAL).p[METAL]
    # V is weaker: its noise over its signal is 0.02 / 0.7 = 0.029 a pixel, and 0.0014 in the mean of 400 pixels. The
    # limit is three times that.
    assert abs(p.mean() - 1) < 0.005
    # No pixel of 400 is off by six standard deviations.
    assert np.abs(p - 1).max() < 6 * 0.02 / 0.7


@given(complex_gain, st.floats(-200, 200), st.floats(-200, 200))
def test_common_gain_and_distance_phase_do_not_change_p(gain, tilt_x, tilt_y):
    h, v = make_channels(3.78 - 0.7j, gain_h=1.3j, gain_v=0.8)
    reference = polarimetry.calibrate(make_images(h, v), METAL).p
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]] / 100
    common = gain * np.exp(1j * (tilt_x * x + tilt_y * y))
    moved = polarimetry.calibrate(make_images(h * common, v * common), METAL).p
    inside = METAL | PLATE
    np.testing.assert_allclose(moved[inside], reference[inside], rtol=1e-9)


@given(leak, leak, complex_gain, complex_gain)
def test_leakage_that_is_known_is_removed(a, b, gain_h, gain_v):
    h, v = make_channels(4.69 - 0.7j, gain_h, gain_v, a, b)
    out = polarimetry.calibrate(make_images(h, v), METAL)
    s, p = polarimetry.correct_leakage(out.h, out.v, a, b)
    r_s, r_p = polarimetry.fresnel(4.69 - 0.7j, THETA)
    np.testing.assert_allclose(s[PLATE] / p[PLATE], r_s / r_p, rtol=1e-9)
    np.testing.assert_allclose(s[METAL] / p[METAL], 1, rtol=1e-9)
    np.testing.assert_allclose(np.abs(s[PLATE]), abs(r_s), rtol=1e-9)


def test_metal_alone_does_not_separate_leakage_from_gain():
    """Two rigs with different leakage give the same values on metal, so leakage must be known.

    On metal r_s = r_p = -1: a leakage of 0.1 has the same effect as a gain of 1.1.
    """
    with_leakage, _ = make_channels(4.0, gain_h=1.1, a=0.1)
    with_more_gain, _ = make_channels(4.0, gain_h=1.1 * 1.1)
    np.testing.assert_allclose(with_leakage[METAL], with_more_gain[METAL])
    # On the dielectric plate r_s and r_p differ, and the two rigs do by 0.045.
    r_s, r_p = polarimetry.fresnel(4.0, THETA)
    difference = with_leakage[PLATE][0] - with_more_gain[PLATE][0]
    assert difference == pytest.approx(1.1 * 0.1 * (r_p - r_s))
    assert abs(difference) > 0.01


def test_reference_over_the_whole_plane_removes_uneven_illumination():
    h, v = make_channels(4 - 0.4j)
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]] / 40
    light_h = (1 + 0.3 * x) * np.exp(2j * y)
    light_v = (1.2 - 0.2 * y) * np.exp(1j * x)
    # A metal plate over the whole plane reflects -1 in both channels.
    out = polarimetry.divide_by_metal(make_images(h * light_h, v * light_v), -light_h, -light_v)
    r_s, r_p = polarimetry.fresnel(4 - 0.4j, THETA)
    np.testing.assert_allclose(out.p[PLATE], r_s / r_p, rtol=1e-9)
    np.testing.assert_allclose(out.p[METAL], 1, rtol=1e-9)


def test_dark_or_empty_metal_regions_are_refused():
    h, v = make_channels(4.0)
    empty_mask = np.zeros(SHAPE, bool)
    between_plates = ~(METAL | PLATE)
    for mask in (empty_mask, between_plates):
        with expect_refusal(ErrorCode.NO_DATA):
            polarimetry.calibrate(make_images(h, v), mask)
    with expect_refusal(ErrorCode.MISMATCH, (2, 2)):
        polarimetry.calibrate(make_images(h, v), np.ones((2, 2), bool))


def test_images_in_single_precision_stay_in_single_precision():
    h, v = (a.astype(np.complex64) for a in make_channels(4.0, noise=0.01))
    out = polarimetry.calibrate(make_images(h, v), METAL)
    assert out.h.dtype == out.v.dtype == out.p.dtype == np.complex64
    assert polarimetry.correct_leakage(out.h, out.v, 0.05, 0.05)[0].dtype == np.complex64
    assert polarimetry.smooth(out.h, 1.0).dtype == np.complex64


def test_smoothing_keeps_constants_reduces_noise_and_respects_holes():
    image = np.full(SHAPE, 2 - 1j)
    np.testing.assert_allclose(polarimetry.smooth(image, 1.5), image)
    rng = np.random.default_rng(2)
    noise = rng.standard_normal(SHAPE) + 1j * rng.standard_normal(SHAPE)
    # A Gaussian window averages over 4 pi sigma^2 = 50 pixels, so that noise becomes 7 times weaker.
    assert polarimetry.smooth(noise, 2.0).std() < noise.std() / 5
    image[3, 4] = np.nan
    out = polarimetry.smooth(image, 1.5)
    assert np.isnan(out[3, 4])
    out[3, 4] = 2 - 1j
    np.testing.assert_allclose(out, 2 - 1j)


def test_the_incidence_angle_is_that_of_the_specular_midpoint():
    rig = load_published_rig()
    mean_of_receivers_deg = np.mean([incidence_deg(rig, board) for board in rig.receivers])
    assert np.degrees(polarimetry.specular_incidence_rad(rig)) == pytest.approx(mean_of_receivers_deg)
    middle_x_m, middle_y_m, _ = specular_midpoint_m(rig, rig.receivers[0])
    x = middle_x_m + np.linspace(-0.15, 0.15, 7)
    y = middle_y_m + np.linspace(-0.15, 0.15, 5)
    angles = polarimetry.incidence_choice(rig, x, y, "one")
    assert angles.one_rad.shape == angles.pixel_rad.shape == (5, 7)
    assert np.ptp(angles.one_rad) == 0
    # Half of the Fresnel zone is some 70 mm wide in x. The angle of a pixel is a mean over its zone, which is 0.07
    # degrees less than the angle of its middle.
    difference_deg = np.degrees(angles.pixel_rad - angles.one_rad)
    at_the_middle_deg = difference_deg[2, 3]
    assert -0.15 < at_the_middle_deg < 0
    # A pixel two metres to the side is the mirror point of no position of the stage: it gets the angle of the middle.
    far_x_m = np.array([middle_x_m + 2.0])
    angle_outside = polarimetry.incidence_choice(rig, far_x_m, np.array([middle_y_m]), "pixel").used_rad
    assert angle_outside[0, 0] == pytest.approx(polarimetry.specular_incidence_rad(rig))
