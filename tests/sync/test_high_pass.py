"""The high-pass filter: response, inverse, compensation with three taps, and fit to a sweep."""

import msgspec
import numpy as np
import pytest
from tests.support.refusals import expect_refusal

from polysight.sync.high_pass_filter import Equaliser, HighPass, apply_filter, fit_high_pass, high_pass
from polysight_shared.errors import ErrorCode


def test_each_section_is_3_db_down_and_45_degrees_ahead_at_its_corner():
    corner_hz = 175e3
    at_corner, far_above = HighPass((corner_hz,)).response(np.array([corner_hz, 100 * corner_hz]))
    assert abs(at_corner) == pytest.approx(np.sqrt(0.5))
    assert np.angle(at_corner, deg=True) == pytest.approx(45)
    # At 100 times the corner the response is 1 / sqrt(1 + 100**-2), 5e-5 below 1.
    assert abs(far_above) == pytest.approx(1, abs=1e-4)


def test_sections_multiply_and_no_corners_is_the_identity():
    f = np.linspace(1e3, 2e6, 50)
    response = HighPass((175e3, 350e3)).response(f)
    np.testing.assert_allclose(response, HighPass((175e3,)).response(f) * HighPass((350e3,)).response(f))
    np.testing.assert_array_equal(HighPass().response(f), 1)


def test_negative_if_is_the_conjugate_of_positive(rig):
    f = np.linspace(1e3, 1e6, 50)
    model = high_pass(rig.chirp)
    np.testing.assert_allclose(model.response(-f), model.response(f).conj())


def test_noise_is_amplified_at_most_fourfold(rig):
    f = np.linspace(-2e6, 2e6, 4001)
    model = high_pass(rig.chirp)
    assert np.abs(model.inverse(f)).max() <= 4 + 1e-9
    # Where the filter leaves more than a quarter, it is inverted exactly.
    is_strong = np.abs(model.response(f)) > 0.25
    np.testing.assert_allclose((model.inverse(f) * model.response(f))[is_strong], 1, atol=1e-12)


@pytest.mark.parametrize("mode", ["complex1x", "complex2x"])
@pytest.mark.parametrize(("if_hz", "max_error"), [(300e3, 4e-3), (500e3, 1e-3), (900e3, 3e-4), (-700e3, 5e-4)])
def test_three_taps_are_the_inverse_over_the_signals_band(rig, mode, if_hz, max_error):
    """Every tone within 40 kHz of the centre is restored.

    The error is larger near the filter's corners. Measured are 3.0e-3, 9.5e-4, 2.9e-4 and 4.7e-4.
    """
    if mode == "complex1x" and if_hz < 0:
        # There is no negative IF: this one is seen at -0.7 + 2.15 = 1.45 MHz.
        if_hz += rig.chirp.sample_rate_hz
    chirp = msgspec.structs.replace(rig.chirp, if_mode=mode)
    model = high_pass(chirp)
    rate = chirp.sample_rate_hz
    if mode == "complex2x" and if_hz > rate / 2:
        if_hz -= rate
    taps = Equaliser.from_model(model, chirp, 4).taps(np.array([if_hz / rate]))[0]
    frequencies_hz = np.linspace(-40e3, 40e3, 81)
    # The taps are a block of four samples apart.
    tap_samples = 4 * np.array([-1, 0, 1])
    response = np.exp(2j * np.pi * np.outer(frequencies_hz / rate, tap_samples)) @ taps
    np.testing.assert_allclose(response * model.response(if_hz + frequencies_hz), 1, atol=max_error)


def test_two_tones_are_restored_up_to_the_ends_of_the_record(rig):
    model = high_pass(rig.chirp)
    chirp = rig.chirp
    # 48 blocks of four samples, mixed down from the centre of the signal's band
    times_s = np.arange(48) * 4 / chirp.sample_rate_hz
    centre_hz = 500e3
    tones_hz = np.array([-15e3, 17e3])
    tones = np.exp(2j * np.pi * np.outer(tones_hz, times_s))
    clean = tones.sum(axis=0)
    filtered = (model.response(centre_hz + tones_hz)[:, None] * tones).sum(axis=0)
    centre_cycles = np.array([[centre_hz / chirp.sample_rate_hz]])
    taps = Equaliser.from_model(model, chirp, 4).taps(centre_cycles).astype(np.complex64)
    restored = apply_filter(filtered[None, None, None].astype(np.complex64), taps)[0, 0, 0]
    # The filter changes the two tones of amplitude 1 by up to 1.7 (measured).
    assert np.abs(filtered - clean).max() > 0.3
    # The first and the last block have one neighbour only, so that their error is larger.
    np.testing.assert_allclose(restored[1:-1], clean[1:-1], atol=2e-3)
    np.testing.assert_allclose(restored, clean, atol=2e-2)


def test_without_corners_the_taps_are_the_identity(rig):
    taps = Equaliser.from_model(HighPass(), rig.chirp, 4).taps(np.array([0.1, 0.6]))
    np.testing.assert_allclose(taps, [[0, 1, 0]] * 2, atol=1e-12)


@pytest.mark.parametrize("corners", [(175e3, 350e3), (235e3, 700e3), (350e3, 1.4e6), (161e3, 372e3)])
def test_a_fit_recovers_the_corners_of_a_sweep(corners):
    """The amplitude has an unknown gain (37) and errors of 1 %, which change the corners by 0.7 % (measured)."""
    rng = np.random.default_rng(2)
    f = np.linspace(100e3, 1.9e6, 60)
    amplitude = 37 * np.abs(HighPass(corners).response(f)) * (1 + 0.01 * rng.standard_normal(60))
    np.testing.assert_allclose(fit_high_pass(f, amplitude).corners_hz, corners, rtol=0.06)


def test_a_sweep_of_few_points_or_far_above_the_corners_is_refused():
    f = np.linspace(1.5e6, 1.9e6, 40)
    with expect_refusal(ErrorCode.NOT_ENOUGH_DATA, 5):
        fit_high_pass(f[:5], np.ones(5))
    # A constant amplitude shows no corner.
    with expect_refusal(ErrorCode.MISMATCH):
        fit_high_pass(f, np.ones(f.size))
