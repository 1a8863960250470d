"""The rival of `benchmarks widths`: its intervals follow the noise of each row, and the information in its features."""

import numpy as np
import pytest
from benchmarks.widths import learn_half_widths


def test_learnt_intervals_follow_the_noise_of_each_row():
    rng = np.random.default_rng(3)
    row = np.repeat([0, 1], 600)
    std = np.where(row == 0, 0.1, 0.4)
    features = np.column_stack([row, rng.standard_normal((row.size, 3))])
    half_width = learn_half_widths(features, std * rng.standard_normal(row.size), row, np.arange(row.size) // 6)
    for number in (0, 1):
        of_row = row == number
        assert np.median(half_width[of_row]) == pytest.approx(1.96 * std[of_row][0], rel=0.25)


def test_learnt_intervals_are_narrower_by_what_a_feature_tells():
    rng = np.random.default_rng(5)
    row = np.zeros(1200, np.intp)
    feature = rng.uniform(-1, 1, row.size)
    deviation = 2 * feature + 0.1 * rng.standard_normal(row.size)
    half_width = learn_half_widths(feature[:, None], deviation, row, np.arange(row.size) // 6)
    # Without the feature it is 1.9. Quantiles of trees follow a slope in steps: 0.2 would be the noise alone.
    assert 0.19 < np.median(half_width) < 0.95


def test_errors_that_no_feature_shows_stay_in_the_intervals():
    rng = np.random.default_rng(4)
    row = np.zeros(600, np.intp)
    deviation = rng.standard_normal(row.size)
    half_width = learn_half_widths(rng.standard_normal((row.size, 3)), deviation, row, np.arange(row.size) // 6)
    assert np.median(half_width) == pytest.approx(1.96, rel=0.25)
