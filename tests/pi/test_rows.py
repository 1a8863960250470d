"""Host and Pi agree on which rasters fit the stage, and on what the radars take: one rule each, in shared."""

from __future__ import annotations

from collections.abc import Callable

import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.support.rigs import published_rig

from polysight.plan.timing import row_motion_s
from polysight_pi.executor import burst_of, check_run
from polysight_pi.machine import RefusedError
from polysight_shared import messages as m
from polysight_shared.config import Burst
from polysight_shared.faults import PiFault
from polysight_shared.raster import MIN_PERIOD_US, WIDTH_US, plan_raster

RIG = published_rig()
replace = msgspec.structs.replace


def rule_of(make: Callable[[], object]) -> str:
    """The rule of the rig file that is broken; "" when none is."""
    try:
        make()
    except ValueError as e:
        return str(e)
    return ""


@given(
    columns=st.integers(1, 450),
    rows=st.integers(1, 300),
    speed=st.integers(1, 100),
    accel=st.integers(10, 500),
    backlash=st.integers(0, 10),
    centre=st.integers(300, 500),
)
@settings(max_examples=200, deadline=None)
def test_the_pi_takes_a_raster_when_the_rig_file_is_taken(columns, rows, speed, accel, backlash, centre):
    """So that what `config` and the doctor accept is not refused by BeginRun, and the other way round."""
    stage = replace(
        RIG.stage, speed_mm_s=float(speed), accel_mm_s2=float(accel), backlash_mm=float(backlash),
        centre_x_mm=float(centre), travel_speed_mm_s=100.0,
    )  # fmt: skip
    grid, burst = replace(RIG.grid, columns=columns, rows=rows), Burst(pulses=1, period_us=MIN_PERIOD_US)
    run = m.BeginRun(
        scan_id="s", plan=plan_raster(grid), pulses=1, period_us=burst.period_us, width_us=burst.width_us,
        speed_mm_s=stage.speed_mm_s,
    )  # fmt: skip
    broken = rule_of(lambda: replace(RIG, stage=stage, grid=grid, burst=burst))
    if not broken:
        return check_run(run, stage)
    with pytest.raises(RefusedError) as refused:
        check_run(run, stage)
    assert (refused.value.number, refused.value.what) == (PiFault.BAD_REQUEST, broken)


def test_the_run_up_is_what_the_host_counts_with():
    """A row from rest to rest: its points and the run-up at both ends, at a speed that is reached."""
    grid, stage = RIG.grid, RIG.stage
    v, a = stage.speed_mm_s, stage.accel_mm_s2
    length = (grid.columns - 1) * grid.step_x_mm + 2 * stage.run_up_mm(grid.step_x_mm)
    assert row_motion_s(grid, stage) == pytest.approx(length / v + v / a)
    assert stage.run_up_mm(2.0, 20.0) == pytest.approx(20.0**2 / (2 * a) + 2.0)


@given(period=st.floats(1, 1000), width=st.floats(0.001, 10))
@settings(max_examples=100, deadline=None)
def test_the_pi_sends_the_pulses_that_the_rig_file_may_hold(period, width):
    def sent() -> bool:
        try:
            return bool(burst_of(m.Pulse(pulses=1, period_us=period, width_us=width)))
        except RefusedError:
            return False

    edges = (MIN_PERIOD_US, *WIDTH_US)
    if min(abs(x - e) for e in edges for x in (period, width)) > 1e-3:  # the Pi counts in whole nanoseconds
        assert sent() == (not rule_of(lambda: Burst(pulses=1, period_us=period, width_us=width)))
