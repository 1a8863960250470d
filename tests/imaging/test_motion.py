"""Compensation of the stage's motion within a burst."""

import msgspec
import numpy as np
import pytest

from polysight.imaging.geometry import REACH, design_burst_filters, undo_burst_motion

COUNT = 61
MIDDLE = slice(REACH, -REACH)


@pytest.fixture(scope="module")
def fast(rig):
    """A rig whose bursts nearly fill the step: 16 pulses at 100 mm/s in steps of 2.5 mm."""
    grid = msgspec.structs.replace(rig.grid, columns=100, rows=8, step_x_mm=2.5, step_y_mm=4.0)
    stage = msgspec.structs.replace(rig.stage, speed_mm_s=100.0)
    return msgspec.structs.replace(rig, grid=grid, stage=stage)


def average_over_burst(turns, rig):
    """A wave of `turns` cycles per position, averaged over the burst of each position."""
    pulse = (np.arange(rig.burst.pulses) - (rig.burst.pulses - 1) / 2) * rig.burst.period_us * 1e-6
    offsets = pulse * rig.stage.speed_mm_s / rig.grid.step_x_mm
    return np.exp(2j * np.pi * turns * (np.arange(COUNT)[:, None] + offsets)).mean(axis=1).astype(np.complex64)


@pytest.mark.parametrize(
    ("turns", "centre"), [(-0.4, 0.0), (-0.2, 0.0), (0.0, 0.0), (0.1, 0.0), (0.3, 0.0), (0.0, 0.1), (0.35, 0.1)]
)
def test_every_wave_keeps_its_amplitude_and_phase(fast, turns, centre):
    """The law holds for any part of the phase change that burst alignment has removed."""
    samples_at_rest = np.exp(2j * np.pi * turns * np.arange(COUNT))
    average = average_over_burst(turns - centre, fast) * np.exp(2j * np.pi * centre * np.arange(COUNT))
    valid = np.ones(COUNT, bool)
    turn = np.full(COUNT, 2 * np.pi * centre)
    undone = undo_burst_motion(average, valid, turn, design_burst_filters(fast))
    np.testing.assert_allclose(undone[MIDDLE], samples_at_rest[MIDDLE], atol=6e-3)
    assert turns == centre or abs(average[30]) < 1 - 1.2 * (turns - centre) ** 2


def test_a_slow_stage_and_one_pulse_need_no_filter(rig):
    slow = msgspec.structs.replace(rig, burst=msgspec.structs.replace(rig.burst, pulses=1))
    np.testing.assert_allclose(design_burst_filters(slow), np.eye(REACH + 1)[np.zeros(REACH + 1, int)], atol=1e-6)


def test_masked_positions_have_no_influence_and_ends_are_not_changed(fast):
    """The filter uses only valid neighbours."""
    rng = np.random.default_rng(1)
    samples = (rng.standard_normal((2, COUNT)) + 1j * rng.standard_normal((2, COUNT))).astype(np.complex64)
    valid = np.ones(COUNT, bool)
    valid[[20, 21, 40]] = False
    turn = rng.uniform(-1, 1, COUNT)
    filters = design_burst_filters(fast)
    first = undo_burst_motion(samples, valid, turn, filters)
    changed = np.where(valid, samples, 1e6).astype(np.complex64)
    np.testing.assert_array_equal(undo_burst_motion(changed, valid, turn, filters)[:, valid], first[:, valid])
    for alone in (0, COUNT - 1, 19, 22):
        np.testing.assert_array_equal(first[:, alone], samples[:, alone])


def test_a_row_in_the_other_direction_is_filtered_equally(fast):
    rng = np.random.default_rng(2)
    samples = (rng.standard_normal((2, COUNT)) + 1j * rng.standard_normal((2, COUNT))).astype(np.complex64)
    valid = rng.uniform(size=COUNT) < 0.9
    turn = rng.uniform(-1, 1, COUNT)
    filters = design_burst_filters(fast)
    reverse = undo_burst_motion(samples, valid, turn, filters)
    back = undo_burst_motion(samples[:, ::-1], valid[::-1], -turn[::-1], filters)
    np.testing.assert_allclose(back[:, ::-1], reverse, atol=1e-5)
