"""Compensation of the stage's motion within a burst: the pulses of a position are sent while the stage moves."""

import msgspec
import numpy as np
import pytest

from polysight.imaging.geometry import REACH, design_burst_filters, undo_burst_motion

# Positions of a row
COUNT = 61

# Positions with all neighbours that the filter uses
MIDDLE = slice(REACH, -REACH)


@pytest.fixture(scope="module")
def fast(rig):
    """A rig whose bursts nearly fill the step: in 16 pulses of 1.5 ms at 100 mm/s it moves 2.4 of 2.5 mm."""
    grid = msgspec.structs.replace(rig.grid, columns=100, rows=8, step_x_mm=2.5, step_y_mm=4.0)
    stage = msgspec.structs.replace(rig.stage, speed_mm_s=100.0)
    return msgspec.structs.replace(rig, grid=grid, stage=stage)


def average_over_burst(turns, rig):
    """A wave of `turns` cycles per position, averaged over the burst of each position."""
    pulse_times_s = (np.arange(rig.burst.pulses) - (rig.burst.pulses - 1) / 2) * rig.burst.period_us * 1e-6
    # In steps of the grid
    offsets = pulse_times_s * rig.stage.speed_mm_s / rig.grid.step_x_mm
    return np.exp(2j * np.pi * turns * (np.arange(COUNT)[:, None] + offsets)).mean(axis=1).astype(np.complex64)


@pytest.mark.parametrize(
    ("turns", "centre"), [(-0.4, 0.0), (-0.2, 0.0), (0.0, 0.0), (0.1, 0.0), (0.3, 0.0), (0.0, 0.1), (0.35, 0.1)]
)
def test_every_wave_keeps_its_amplitude_and_phase(fast, turns, centre):
    """Waves of `turns` cycles per position. Burst alignment has removed the phase change of `centre` cycles.

    Alignment is within a burst only, so that the average is that of a wave of `turns - centre` cycles, turned from
    position to position by the rest.
    """
    samples_at_rest = np.exp(2j * np.pi * turns * np.arange(COUNT))
    average = average_over_burst(turns - centre, fast) * np.exp(2j * np.pi * centre * np.arange(COUNT))
    valid = np.ones(COUNT, bool)
    turn = np.full(COUNT, 2 * np.pi * centre)
    undone = undo_burst_motion(average, valid, turn, design_burst_filters(fast))
    # A filter of few taps leaves an error of up to 4.7e-3 (measured).
    np.testing.assert_allclose(undone[MIDDLE], samples_at_rest[MIDDLE], atol=6e-3)
    # Without the filter the wave is weaker by (2 pi)^2 / 2 times the variance of the pulses' places (0.077 steps^2),
    # times the turns squared: by 1.5 of these, less the fourth order.
    if turns != centre:
        middle = COUNT // 2
        assert abs(average[middle]) < 1 - 1.2 * (turns - centre) ** 2


def test_a_slow_stage_and_one_pulse_need_no_filter(rig):
    slow = msgspec.structs.replace(rig, burst=msgspec.structs.replace(rig.burst, pulses=1))
    # Each filter is 1 at the position itself and 0 at its neighbours.
    no_filters = np.zeros((REACH + 1, REACH + 1))
    no_filters[:, 0] = 1
    np.testing.assert_allclose(design_burst_filters(slow), no_filters, atol=1e-6)


def test_masked_positions_have_no_influence_and_ends_are_not_changed(fast):
    """The filter uses only valid neighbours."""
    rng = np.random.default_rng(1)
    samples = (rng.standard_normal((2, COUNT)) + 1j * rng.standard_normal((2, COUNT))).astype(np.complex64)
    valid = np.ones(COUNT, bool)
    valid[[20, 21, 40]] = False
    turn = rng.uniform(-1, 1, COUNT)
    filters = design_burst_filters(fast)
    first = undo_burst_motion(samples, valid, turn, filters)
    # A value that would show in any average
    changed = np.where(valid, samples, 1e6).astype(np.complex64)
    np.testing.assert_array_equal(undo_burst_motion(changed, valid, turn, filters)[:, valid], first[:, valid])
    # Both ends of the row, and the positions at the masked ones 20 and 21: they have no valid neighbour on one side.
    for position in (0, COUNT - 1, 19, 22):
        np.testing.assert_array_equal(first[:, position], samples[:, position])


def test_a_row_in_the_other_direction_is_filtered_equally(fast):
    rng = np.random.default_rng(2)
    samples = (rng.standard_normal((2, COUNT)) + 1j * rng.standard_normal((2, COUNT))).astype(np.complex64)
    valid = rng.uniform(size=COUNT) < 0.9
    turn = rng.uniform(-1, 1, COUNT)
    filters = design_burst_filters(fast)
    forward = undo_burst_motion(samples, valid, turn, filters)
    backward = undo_burst_motion(samples[:, ::-1], valid[::-1], -turn[::-1], filters)
    np.testing.assert_allclose(backward[:, ::-1], forward, atol=1e-5)
