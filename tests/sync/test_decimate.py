"""Decimation passes the scene unchanged and suppresses echoes that would alias onto it."""

import numpy as np
import pytest

from polysight.sync.decimate import decimator, flatten, fold

BIN = 1 / 192
N = np.arange(192) - 95.5
MIDDLES = N.reshape(-1, 4).mean(axis=1)


def decimate_tone(cycles):
    return flatten(fold(np.exp(2j * np.pi * cycles * N).astype(np.complex64)))


@pytest.mark.parametrize(
    ("bins", "inner", "edge"), [(0, 1e-4, 1e-3), (2, 1e-4, 2e-3), (5.4, 1e-4, 2e-3), (12, 1e-3, 1e-2)]
)
def test_tones_near_the_middle_pass_unchanged(bins, inner, edge):
    for sign in (1, -1):
        deviation = np.abs(decimate_tone(sign * bins * BIN) - np.exp(2j * np.pi * sign * bins * BIN * MIDDLES))
        assert deviation[3:-3].max() < inner
        assert deviation.max() < edge


@pytest.mark.parametrize("bins", [43, 46, 48, 50, 53, 91, 96])
def test_tones_that_would_fall_onto_the_scene_are_stopped(bins):
    assert np.abs(decimate_tone(bins * BIN)[3:-3]).max() < 10 ** (-40 / 20)


def test_the_noise_is_known():
    rng = np.random.default_rng(1)
    noise = (rng.standard_normal((4000, 192)) + 1j * rng.standard_normal((4000, 192))).astype(np.complex64)
    out = flatten(fold(noise))
    assert (np.abs(out[:, 3:-3]) ** 2).mean() == pytest.approx(2 * decimator().noise, rel=0.01)
    assert (np.abs(out[:, [0, -1]]) ** 2).mean() < 1.3 * 2 / 4
