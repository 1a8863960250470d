"""The reported noise of the direct path's power is as large as the scatter of that power from chirp to chirp."""

import numpy as np
import pytest
from tests.support.doctor.case import FRAMES, RIG, make_setup, simulate_frames

from polysight.calibration.direct_signal import find_direct


@pytest.mark.parametrize("noise_counts", [120.0, 300.0])
def test_the_noise_power_is_that_of_the_measured_amplitude(noise_counts):
    """The variance of |A + n|^2 is 2 |A|^2 times the mean of |n|^2, if n is small."""
    words = simulate_frames("RH").astype(float)
    noisy = words + noise_counts * np.random.default_rng(6).standard_normal(words.shape)
    frames = np.round(noisy).clip(-32768, 32767).astype(np.int16)
    signal = find_direct(RIG, RIG.by_name("RH"), frames, np.ones(FRAMES, bool), make_setup("RH"))
    scatter = np.var(signal.power) / (2 * signal.power.mean())
    # The variance of 32 chirps is known to sqrt(2 / 31) = 25 %: the limit is two standard errors.
    assert signal.noise_power.mean() == pytest.approx(scatter, rel=0.5)
