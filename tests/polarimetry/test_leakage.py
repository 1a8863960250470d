"""Leakage and gain imbalance are recovered from metal at two orientations; insufficient standards are refused."""

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

THETA = np.radians(55.0)
UPRIGHT = 0.0
LYING = np.pi / 2
gain = st.tuples(st.floats(0.3, 3.0), st.floats(-3.1, 3.1)).map(lambda g: g[0] * np.exp(1j * g[1]))
leak = st.tuples(st.floats(0.0, 0.15), st.floats(-3.1, 3.1)).map(lambda g: g[0] * np.exp(1j * g[1]))
seeds = st.integers(0, 2**32 - 1)


def measure_standard(truth, wave, rng, noise=0.0, pixels=400):
    """Pixels of a standard: its wave through the rig, with a phase of the distance per pixel, and noise."""
    phase = np.exp(2j * np.pi * rng.random(pixels)) * rng.uniform(0.7, 1.3, pixels)
    h, v = (truth.matrix() @ np.array(wave))[:, None] * phase
    n = rng.standard_normal((2, pixels)) + 1j * rng.standard_normal((2, pixels))
    return h + noise * abs(truth.imbalance) * n[0] / np.sqrt(2), v + noise * n[1] / np.sqrt(2)


def measure_metal_standard(truth, wave, rng, noise=0.0):
    return MetalStandard(common_direction(*measure_standard(truth, wave, rng, noise)), wave)


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
    """26 dB per pixel: residual crosstalk below 0.01, imbalance below 0.025."""
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
    # Wrong orientation
    other_measurements[3] = MetalStandard(other_measurements[3].measured, strips_wave(np.radians(75), THETA))
    assert estimate_leakage(other_measurements).residual > 0.02


@given(leak, gain, seeds)
def test_one_orientation_gives_the_axial_ratio_of_two_equal_boards(a, g, seed):
    truth = Leakage(a, a, g, 0.0)
    rng = np.random.default_rng(seed)
    for psi in (UPRIGHT, LYING, 0.4):
        strips = measure_metal_standard(truth, strips_wave(psi, THETA), rng)
        ratio = estimate_axial_ratio(measure_metal_standard(truth, PLATE, rng), strips)
        assert ratio.h == ratio.v
        np.testing.assert_allclose(ratio.h, a, atol=1e-7)


@given(leak, leak, gain, seeds)
def test_uneven_illumination_has_no_influence(a, b, g, seed):
    """Gains that vary over the plane are the same for plate and strips."""
    truth = Leakage(a, b, g, 0.0)
    y, x = np.mgrid[:20, :30] / 20
    bend = np.random.default_rng(seed).uniform(-0.4, 0.4, 4)
    light = np.stack([(1 + bend[0] * x) * np.exp(1j * bend[1] * y), (1.3 + bend[2] * y) * np.exp(1j * bend[3] * x)])

    def image(wave):
        return light * (truth.matrix() @ np.array(wave))[:, None, None]

    strips = [(psi, *image(strips_wave(psi, THETA))) for psi in (UPRIGHT, LYING)]
    leakage = estimate_leakage_from_images(tuple(image(PLATE)), strips, np.ones((20, 30), bool), THETA)
    np.testing.assert_allclose([leakage.h, leakage.v], [a, b], atol=1e-7)


def test_strips_reflect_the_field_along_them():
    assert strips_wave(UPRIGHT, THETA) == pytest.approx((-1, 0), abs=1e-12)
    assert strips_wave(LYING, THETA) == pytest.approx((0, -1), abs=1e-12)
    # Strips along the transmitter's field on the plane reflect all of it.
    along = np.arctan(1 / np.cos(THETA))
    assert strips_wave(along, THETA) == pytest.approx((-1, -1))
    with expect_refusal(ErrorCode.VALUE_INVALID):
        strips_wave(-along, THETA)


@given(st.floats(-3.1, 3.1), st.floats(0.1, 1.3))
def test_strips_agree_with_the_simulator_which_solves_for_the_current(psi, theta):
    if abs(np.cos(psi) + np.sin(psi) * np.cos(theta)) > 0.1:
        np.testing.assert_allclose(strips_wave(psi, theta), strips(psi, theta), rtol=1e-9, atol=1e-12)


def test_insufficient_standards_are_refused():
    truth = Leakage(0.05, 0.05j, 1.0, 0.0)
    rng = np.random.default_rng(1)
    plate = measure_metal_standard(truth, PLATE, rng)
    upright = measure_metal_standard(truth, strips_wave(UPRIGHT, THETA), rng)
    with expect_refusal(ErrorCode.NOT_ENOUGH_DATA, 2):
        estimate_leakage([plate, upright])
    with expect_refusal(ErrorCode.VALUES_CONFLICT):
        estimate_leakage([plate, plate, upright])
    with expect_refusal(ErrorCode.NO_DATA):
        common_direction(np.zeros(5, complex), np.zeros(5, complex))
