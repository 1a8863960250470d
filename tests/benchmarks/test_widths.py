"""Intervals learnt from examples, with which `benchmarks widths` compares the program's error bars.

From features of a plate they predict the half width of a 95 % interval of its permittivity's error. Rows are the kinds
of disturbance in the benchmark's table.
"""

import numpy as np
import pytest
from benchmarks.widths import learn_half_widths

# A normal distribution has 95 % of its values within so many standard deviations.
SIGMAS_OF_95_PERCENT = 1.96
# Of the half widths here, 6 % are the largest error (measured).
MAX_RELATIVE_ERROR = 0.25


def list_scenes(plates):
    """Number of the scene of each plate, for scenes of six plates."""
    return np.arange(plates) // 6


def test_learnt_intervals_follow_the_noise_of_each_row():
    rng = np.random.default_rng(3)
    plates_of_a_row = 600
    row = np.repeat([0, 1], plates_of_a_row)
    std_of_row = np.array([0.1, 0.4])
    features = np.column_stack([row, rng.standard_normal((row.size, 3))])
    deviation = std_of_row[row] * rng.standard_normal(row.size)
    half_width = learn_half_widths(features, deviation, row, list_scenes(row.size))
    for number, std in enumerate(std_of_row):
        median = np.median(half_width[row == number])
        assert median == pytest.approx(SIGMAS_OF_95_PERCENT * std, rel=MAX_RELATIVE_ERROR)


def test_learnt_intervals_are_narrower_if_a_feature_predicts_the_error():
    rng = np.random.default_rng(5)
    row = np.zeros(1200, np.intp)
    feature = rng.uniform(-1, 1, row.size)
    noise_std = 0.1
    deviation = 2 * feature + noise_std * rng.standard_normal(row.size)
    half_width = learn_half_widths(feature[:, None], deviation, row, list_scenes(row.size))
    # Noise alone would give 0.2, and the deviation without the feature 1.9. Quantiles by decision trees follow a slope
    # in steps, so that 0.66 remains (measured).
    assert 0.19 < np.median(half_width) < 1.9 / 2


def test_learnt_intervals_are_not_narrower_if_features_say_nothing_about_the_error():
    rng = np.random.default_rng(4)
    row = np.zeros(600, np.intp)
    deviation = rng.standard_normal(row.size)
    features = rng.standard_normal((row.size, 3))
    half_width = learn_half_widths(features, deviation, row, list_scenes(row.size))
    assert np.median(half_width) == pytest.approx(SIGMAS_OF_95_PERCENT, rel=MAX_RELATIVE_ERROR)
