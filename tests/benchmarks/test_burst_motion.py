"""Images of a simulated scan in motion, beside one that stands still during each burst."""

import pytest
from benchmarks.burst_motion import GRID, errors


@pytest.mark.parametrize(("speed_mm_s", "amplitude"), [(20.0, 0.6), (100.0, 0.1)])
def test_what_motion_costs_is_mostly_undone(speed_mm_s, amplitude):
    """Weak echoes, and such as burst alignment follows: four together have 2.4 times the direct path's amplitude."""
    error = errors(speed_mm_s, amplitude, {**GRID, "rows": 8})
    assert error["ignored"] > 2 * error["mean"]
    assert error["mean"] > 2 * error["undone"]
