"""Decimation passes the scene unchanged and suppresses echoes that would alias onto it."""

import numpy as np
import pytest

from polysight.sync.decimate import decimator, flatten, fold

# Bin of the 192 linear samples, cycles per sample
BIN = 1 / 192

# Samples relative to their middle, and the middles of blocks of four
N = np.arange(192) - 95.5
MIDDLES = N.reshape(-1, 4).mean(axis=1)


def decimate_tone(cycles):
    """A tone of `cycles` per sample after decimation: one sample in four is kept."""
    return flatten(fold(np.exp(2j * np.pi * cycles * N).astype(np.complex64)))


# Largest deviation in the inside of the record, and at its first and last three blocks, where the filter has fewer
# samples. It grows towards the end of the passband, 13 bins to either side of the middle: at 12 bins it is 4.6e-4
# inside and 6e-3 at the ends (measured).
@pytest.mark.parametrize(
    ("bins", "max_inside", "max_at_ends"), [(0, 1e-4, 1e-3), (2, 1e-4, 2e-3), (5.4, 1e-4, 2e-3), (12, 1e-3, 1e-2)]
)
def test_tones_near_the_middle_pass_unchanged(bins, max_inside, max_at_ends):
    for cycles in (bins * BIN, -bins * BIN):
        deviation = np.abs(decimate_tone(cycles) - np.exp(2j * np.pi * cycles * MIDDLES))
        assert deviation[3:-3].max() < max_inside
        assert deviation.max() < max_at_ends


# With one sample in four kept, tones 48 and 96 bins away have the frequency of the scene's middle.
@pytest.mark.parametrize("bins", [43, 46, 48, 50, 53, 91, 96])
def test_tones_that_would_fall_onto_the_scene_are_suppressed_by_40_db(bins):
    assert np.abs(decimate_tone(bins * BIN)[3:-3]).max() < 10 ** (-40 / 20)


def test_decimation_changes_the_power_of_white_noise_by_the_factor_that_it_reports():
    rng = np.random.default_rng(1)
    noise = (rng.standard_normal((4000, 192)) + 1j * rng.standard_normal((4000, 192))).astype(np.complex64)
    power = np.abs(flatten(fold(noise))) ** 2
    # The noise has the power 2, 1 in each part. The mean of 4000 x 42 powers is known to 0.5 %.
    assert power[:, 3:-3].mean() == pytest.approx(2 * decimator().noise, rel=0.01)
    # The first and the last block are little more than a mean of four samples.
    assert power[:, [0, -1]].mean() < 1.3 * 2 / 4
