"""A stage that rests although it has not reported the end of its motion is noticed by its statuses."""

import pytest
from tests.support.pi.machine_bench import Bench

from polysight_pi.machine import MAX_REPEAT_REQUESTS, RESTING_STATUSES
from polysight_shared import messages as m
from polysight_shared.faults import PiFault
from polysight_shared.stage_line import Reply

# Number of statuses of rest after which the Pi has asked the stage often enough to repeat its report.
MOST_RESTING_STATUSES = RESTING_STATUSES * MAX_REPEAT_REQUESTS
JOG = m.Jog(axis="x", from_mm=0.0, distance_mm=5.0, speed_mm_s=10.0, heartbeat_ms=500, owner="o")


def begin(motion: str) -> Bench:
    """A bench whose stage has accepted this motion."""
    bench = Bench().begin_and_home()
    if motion == "row":
        bench.start()
        return bench
    bench.machine.command("EndRun")
    bench.run_posted()
    if motion == "jog":
        bench.machine.command("Jog", JOG)
    else:
        bench.machine.command("Home")
    bench.run_posted()
    bench.send_reply(Reply("ok", bench.stage.number))
    return bench


@pytest.mark.parametrize("motion", ["row", "jog", "homing"])
def test_a_stage_that_rests_and_does_not_repeat_its_report_is_a_fault(motion):
    bench = begin(motion)
    for _ in range(MOST_RESTING_STATUSES):
        bench.send_status(0, state="idle")
    assert bench.machine.fault == 0
    bench.send_status(0, state="idle")
    assert (bench.machine.state, bench.machine.fault) == ("fault", PiFault.STAGE_LOST)


@pytest.mark.parametrize("motion", ["row", "jog", "homing"])
def test_only_consecutive_statuses_of_rest_count(motion):
    bench = begin(motion)
    for _ in range(3):
        for _ in range(MOST_RESTING_STATUSES):
            bench.send_status(0, state="idle")
        bench.send_status(0, state="jog")
    assert bench.machine.fault == 0
