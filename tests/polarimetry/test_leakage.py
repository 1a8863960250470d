"""Leakage and gain imbalance are recovered from metal at two orientations; insufficient standards are refused.

The metal standards are a plate and a screen of parallel strips. Each reflects a known *wave*, the pair (s, p); the rig
makes of it H = g (s + a p) and V = p + b s, with the leakages a and b and the gain imbalance g.
"""

import numpy as np
import pytest
from hypothesis import given, strategies as st
from tests.support.calibration import compute_remaining
from tests.support.refusals import expect_refusal

from polysight.polarimetry import Leakage, estimate_leakage_from_images
from polysight.polarimetry.calibrate import (
    PLATE,
    MetalStandard,
    common_direction,
    estimate_axial_ratio,
    estimate_leakage,
    strips_wave,
)
from polysight_shared.errors import ErrorCode
from polysight_simulators.scene import strips

# Incidence angle; about that of the published rig.
THETA = np.radians(55.0)

# Angles of the strips from the vertical, radians.
UPRIGHT = 0.0
LYING = np.pi / 2

gain = st.tuples(st.floats(0.3, 3.0), st.floats(-3.1, 3.1)).map(lambda g: g[0] * np.exp(1j * g[1]))
leak = st.tuples(st.floats(0.0, 0.15), st.floats(-3.1, 3.1)).map(lambda g: g[0] * np.exp(1j * g[1]))
seeds = st.integers(0, 2**32 - 1)


def measure_standard(truth, wave, rng, noise=0.0, pixels=400):
    """H and V of a standard's pixels, as a rig with the leakage `truth` receives its wave.

    Each pixel has a phase and an amplitude of its own, common to H and V: distance and illumination are not known.
    `noise` is the standard deviation of the noise over the signal, the same in both channels.
    """
    illumination = rng.uniform(0.7, 1.3, pixels) * np.exp(2j * np.pi * rng.random(pixels))
    received_pair = truth.matrix() @ np.array(wave)
    h, v = received_pair[:, None] * illumination
    complex_noise = (rng.standard_normal((2, pixels)) + 1j * rng.standard_normal((2, pixels))) / np.sqrt(2)
    # The gain of H amplifies its noise, too; that of V is 1.
    noise_h = noise * abs(truth.imbalance) * complex_noise[0]
    noise_v = noise * complex_noise[1]
    return h + noise_h, v + noise_v


def measure_metal_standard(truth, wave, rng, noise=0.0):
    """The standard with the pair (H, V) that its pixels have in common up to a factor, and its known wave (s, p)."""
    h, v = measure_standard(truth, wave, rng, noise)
    return MetalStandard(measured=common_direction(h, v), wave=wave)


@given(leak, leak, gain, seeds, st.floats(0.0, 0.3))
def test_leakage_and_gain_are_recovered_from_a_plate_and_two_orientations(a, b, g, seed, rotation_rad):
    truth = Leakage(a, b, g, 0.0)
    rng = np.random.default_rng(seed)
    waves = (PLATE, strips_wave(UPRIGHT + rotation_rad, THETA), strips_wave(LYING + rotation_rad, THETA))
    leakage = estimate_leakage([measure_metal_standard(truth, w, rng) for w in waves])
    np.testing.assert_allclose([leakage.h, leakage.v, leakage.imbalance], [a, b, g], rtol=1e-6, atol=1e-8)
    assert compute_remaining(leakage, truth) == pytest.approx((0, 0), abs=1e-7)


@given(leak, leak, gain, seeds)
def test_with_noise_crosstalk_and_imbalance_stay_below_the_limits(a, b, g, seed):
    """The noise of 0.05 is 26 dB below the signal in each of 400 pixels.

    Their mean has an error of 0.05 / sqrt(400) = 0.0025 in each channel, and the estimate joins several such errors:
    over 50 draws the crosstalk was up to 0.006 and the imbalance up to 0.009.
    """
    truth = Leakage(a, b, g, 0.0)
    rng = np.random.default_rng(seed)
    waves = (PLATE, strips_wave(UPRIGHT, THETA), strips_wave(LYING, THETA))
    crosstalk, imbalance = compute_remaining(
        estimate_leakage([measure_metal_standard(truth, w, rng, 0.05) for w in waves]), truth
    )
    assert crosstalk < 0.01
    assert imbalance < 0.025


@given(leak, leak, gain, seeds)
def test_more_orientations_give_a_least_squares_solution_and_a_residual(a, b, g, seed):
    truth = Leakage(a, b, g, 0.0)
    rng = np.random.default_rng(seed)
    waves = [PLATE, *(strips_wave(np.radians(d), THETA) for d in (0, 45, 90, 135, -30))]
    exact = estimate_leakage([measure_metal_standard(truth, w, rng) for w in waves])
    assert exact.residual < 1e-7
    assert compute_remaining(exact, truth) == pytest.approx((0, 0), abs=1e-7)
    other_measurements = [measure_metal_standard(truth, w, rng) for w in waves]
    # The strips at 90 degrees are entered as strips at 75 degrees: the residual is 0.07 to 0.08.
    wrong_wave = strips_wave(np.radians(75), THETA)
    other_measurements[3] = MetalStandard(measured=other_measurements[3].measured, wave=wrong_wave)
    assert estimate_leakage(other_measurements).residual > 0.02


@given(leak, gain, seeds)
def test_one_orientation_gives_the_leakage_if_both_receivers_have_the_same(a, g, seed):
    """The authors of the paper call this one number the axial ratio."""
    truth = Leakage(a, a, g, 0.0)
    rng = np.random.default_rng(seed)
    for psi in (UPRIGHT, LYING, 0.4):
        strips = measure_metal_standard(truth, strips_wave(psi, THETA), rng)
        leakage = estimate_axial_ratio(measure_metal_standard(truth, PLATE, rng), strips)
        assert leakage.h == leakage.v
        np.testing.assert_allclose(leakage.h, a, atol=1e-7)


@given(leak, leak, gain, seeds)
def test_uneven_illumination_has_no_influence(a, b, g, seed):
    """Gains that vary over the plane are the same for plate and strips."""
    truth = Leakage(a, b, g, 0.0)
    y, x = np.mgrid[:20, :30] / 20
    # H grows along x and turns along y, V grows along y and turns along x.
    growth_h, turn_h, growth_v, turn_v = np.random.default_rng(seed).uniform(-0.4, 0.4, 4)
    gain_h = (1 + growth_h * x) * np.exp(1j * turn_h * y)
    gain_v = (1.3 + growth_v * y) * np.exp(1j * turn_v * x)

    def form_images(wave):
        h, v = truth.matrix() @ np.array(wave)
        return gain_h * h, gain_v * v

    strips = [(psi, *form_images(strips_wave(psi, THETA))) for psi in (UPRIGHT, LYING)]
    whole_image = np.ones((20, 30), bool)
    leakage = estimate_leakage_from_images(form_images(PLATE), strips, whole_image, THETA)
    np.testing.assert_allclose([leakage.h, leakage.v], [a, b], atol=1e-7)


def test_strips_reflect_the_field_along_them():
    """The transmitter sends s and p of equal strength: 45 degrees between them, seen along the ray.

    On the plane the component of p is shorter, by cos(theta), so that strips at the angle psi see the field
    cos(psi) + sin(psi) cos(theta).
    """
    assert strips_wave(UPRIGHT, THETA) == pytest.approx((-1, 0), abs=1e-12)
    assert strips_wave(LYING, THETA) == pytest.approx((0, -1), abs=1e-12)
    # Strips reflect s and p alike, as a plate does, where cos(psi) = sin(psi) cos(theta).
    like_a_plate = np.arctan(1 / np.cos(THETA))
    assert strips_wave(like_a_plate, THETA) == pytest.approx((-1, -1))
    # At the opposite angle the field along the strips is cos(psi) - sin(psi) cos(theta) = 0: they reflect nothing.
    with expect_refusal(ErrorCode.VALUE_INVALID):
        strips_wave(-like_a_plate, THETA)


@given(st.floats(-3.1, 3.1), st.floats(0.1, 1.3))
def test_strips_agree_with_the_simulator_which_solves_for_the_current(psi, theta):
    field_along_strips = np.cos(psi) + np.sin(psi) * np.cos(theta)
    # `strips_wave` refuses strips that see less than 0.1: they reflect almost nothing.
    if abs(field_along_strips) > 0.1:
        np.testing.assert_allclose(strips_wave(psi, theta), strips(psi, theta), rtol=1e-9, atol=1e-12)


def test_insufficient_standards_are_refused():
    truth = Leakage(0.05, 0.05j, 1.0, 0.0)
    rng = np.random.default_rng(1)
    plate = measure_metal_standard(truth, PLATE, rng)
    upright = measure_metal_standard(truth, strips_wave(UPRIGHT, THETA), rng)
    # The message names the number of standards.
    with expect_refusal(ErrorCode.NOT_ENOUGH_DATA, 2):
        estimate_leakage([plate, upright])
    # Three standards, but only two different waves
    with expect_refusal(ErrorCode.VALUES_CONFLICT):
        estimate_leakage([plate, plate, upright])
    with expect_refusal(ErrorCode.NO_DATA):
        common_direction(np.zeros(5, complex), np.zeros(5, complex))
