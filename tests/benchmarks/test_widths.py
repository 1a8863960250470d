"""The rival of `benchmarks widths`: intervals that it learns hold 95 % in each row, and are as narrow as the noise."""

import numpy as np
import pytest
from benchmarks.widths import learn_half_widths


def test_learnt_intervals_are_those_of_the_noise_in_each_row():
    rng = np.random.default_rng(3)
    row = np.repeat([0, 1], 600)
    scene = np.arange(row.size) // 6
    known = rng.uniform(-1, 1, row.size)
    std = np.where(row == 0, 0.1, 0.4)
    deviation = 2 * known + std * rng.standard_normal(row.size)
    half_width = learn_half_widths(np.column_stack([row, known]), deviation, row, scene)
    for number in (0, 1):
        # What it learns of the known part is not exact: a third above 1.96 standard deviations at most.
        assert 1.7 < np.median(half_width[row == number]) / std[row == number][0] < 2.7


def test_what_no_feature_tells_stays_in_the_intervals():
    rng = np.random.default_rng(4)
    row = np.zeros(600, np.intp)
    deviation = rng.standard_normal(row.size)
    half_width = learn_half_widths(rng.standard_normal((row.size, 3)), deviation, row, np.arange(row.size) // 6)
    assert np.median(half_width) == pytest.approx(1.96, rel=0.25)
