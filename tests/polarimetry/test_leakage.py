"""Leakage and gain from metal at two orientations: any truth comes back, and what cannot be told is refused."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from polysight.host.polarimetry import (
    Leakage,
    Standard,
    common_direction,
    estimate_axial_ratio,
    estimate_leakage,
    leakage_from_images,
    strips_wave,
)
from polysight.host.polarimetry.leakage import PLATE
from polysight.shared.errors import DataError, PolysightError
from polysight.simulators.scene import decode_scene, strips

THETA = np.radians(55.0)
UPRIGHT, LYING = 0.0, np.pi / 2
gain = st.tuples(st.floats(0.3, 3.0), st.floats(-3.1, 3.1)).map(lambda g: g[0] * np.exp(1j * g[1]))
leak = st.tuples(st.floats(0.0, 0.15), st.floats(-3.1, 3.1)).map(lambda g: g[0] * np.exp(1j * g[1]))
seeds = st.integers(0, 2**32 - 1)


def measured(truth, wave, rng, noise=0.0, pixels=400):
    """Pixels of a standard: its wave through the rig, each pixel with its own distance phase, and noise."""
    phase = np.exp(2j * np.pi * rng.random(pixels)) * rng.uniform(0.7, 1.3, pixels)
    h, v = (truth.matrix() @ np.array(wave))[:, None] * phase
    n = rng.standard_normal((2, pixels)) + 1j * rng.standard_normal((2, pixels))
    return h + noise * abs(truth.imbalance) * n[0] / np.sqrt(2), v + noise * n[1] / np.sqrt(2)


def standard(truth, wave, rng, noise=0.0):
    return Standard(common_direction(*measured(truth, wave, rng, noise)), wave)


@given(leak, leak, gain, seeds, st.floats(0.0, 0.3))
def test_any_leakage_and_gain_come_back_from_a_plate_and_two_orientations(a, b, g, seed, turned):
    truth, rng = Leakage(a, b, g, 0.0), np.random.default_rng(seed)
    waves = (PLATE, strips_wave(UPRIGHT + turned, THETA), strips_wave(LYING + turned, THETA))
    found = estimate_leakage([standard(truth, w, rng) for w in waves])
    np.testing.assert_allclose([found.h, found.v, found.imbalance], [a, b, g], rtol=1e-6, atol=1e-8)
    assert found.remaining(truth) == pytest.approx((0, 0), abs=1e-7)


@given(leak, leak, gain, seeds)
def test_with_noise_crosstalk_and_imbalance_stay_below_what_is_asked(a, b, g, seed):
    """26 dB a pixel: residual crosstalk below 0.01, imbalance below 0.025."""
    truth, rng = Leakage(a, b, g, 0.0), np.random.default_rng(seed)
    waves = (PLATE, strips_wave(UPRIGHT, THETA), strips_wave(LYING, THETA))
    crosstalk, imbalance = estimate_leakage([standard(truth, w, rng, 0.05) for w in waves]).remaining(truth)
    assert crosstalk < 0.01
    assert imbalance < 0.025


@given(leak, leak, gain, seeds)
def test_more_orientations_are_least_squares_and_tell_how_well_they_agree(a, b, g, seed):
    truth, rng = Leakage(a, b, g, 0.0), np.random.default_rng(seed)
    waves = [PLATE, *(strips_wave(np.radians(d), THETA) for d in (0, 45, 90, 135, -30))]
    exact = estimate_leakage([standard(truth, w, rng) for w in waves])
    assert exact.residual < 1e-7
    assert exact.remaining(truth) == pytest.approx((0, 0), abs=1e-7)
    wrong = [standard(truth, w, rng) for w in waves]
    wrong[3] = Standard(wrong[3].measured, strips_wave(np.radians(75), THETA))  # not turned as was said
    assert estimate_leakage(wrong).residual > 0.02


@given(leak, gain, seeds)
def test_one_orientation_gives_the_axial_ratio_of_two_equal_boards(a, g, seed):
    truth, rng = Leakage(a, a, g, 0.0), np.random.default_rng(seed)
    for psi in (UPRIGHT, LYING, 0.4):
        strips = standard(truth, strips_wave(psi, THETA), rng)
        found = estimate_axial_ratio(standard(truth, PLATE, rng), strips)
        assert found.h == found.v
        np.testing.assert_allclose(found.h, a, atol=1e-7)


@given(leak, leak, gain, seeds)
def test_images_with_uneven_light_give_the_same(a, b, g, seed):
    """Gains that differ over the plane are the plate's too, and drop out."""
    truth = Leakage(a, b, g, 0.0)
    y, x = np.mgrid[:20, :30] / 20
    bend = np.random.default_rng(seed).uniform(-0.4, 0.4, 4)
    light = np.stack([(1 + bend[0] * x) * np.exp(1j * bend[1] * y), (1.3 + bend[2] * y) * np.exp(1j * bend[3] * x)])

    def image(wave):
        return light * (truth.matrix() @ np.array(wave))[:, None, None]

    strips = [(psi, *image(strips_wave(psi, THETA))) for psi in (UPRIGHT, LYING)]
    found = leakage_from_images(tuple(image(PLATE)), strips, np.ones((20, 30), bool), THETA)
    np.testing.assert_allclose([found.h, found.v], [a, b], atol=1e-7)


def test_strips_return_what_lies_along_them():
    assert strips_wave(UPRIGHT, THETA) == pytest.approx((-1, 0), abs=1e-12)
    assert strips_wave(LYING, THETA) == pytest.approx((0, -1), abs=1e-12)
    # Strips along the transmitter's field on the plane return all of it.
    along = np.arctan(1 / np.cos(THETA))
    assert strips_wave(along, THETA) == pytest.approx((-1, -1))
    with pytest.raises(PolysightError, match="almost nothing"):
        strips_wave(-along, THETA)


@given(st.floats(-3.1, 3.1), st.floats(0.1, 1.3))
def test_strips_are_those_of_the_simulator_which_solves_for_the_current(psi, theta):
    if abs(np.cos(psi) + np.sin(psi) * np.cos(theta)) > 0.1:
        np.testing.assert_allclose(strips_wave(psi, theta), strips(psi, theta), rtol=1e-9, atol=1e-12)


def test_only_metal_can_be_strips():
    plate = {"name": "x", "centre_mm": [0.0, 0.0], "size_mm": [9.0, 9.0], "permittivity": [4.0, 0.4]}
    with pytest.raises(PolysightError, match="strips_deg goes with metal"):
        decode_scene({"name": "t", "plates": [{**plate, "strips_deg": 0.0}]}, "test")


def test_what_cannot_be_told_is_refused():
    truth, rng = Leakage(0.05, 0.05j, 1.0, 0.0), np.random.default_rng(1)
    plate, upright = standard(truth, PLATE, rng), standard(truth, strips_wave(UPRIGHT, THETA), rng)
    with pytest.raises(DataError, match="2 metal standards"):
        estimate_leakage([plate, upright])
    with pytest.raises(DataError, match="cannot tell"):
        estimate_leakage([plate, plate, upright])
    with pytest.raises(DataError, match="no signal"):
        common_direction(np.zeros(5, complex), np.zeros(5, complex))
