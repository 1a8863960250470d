"""When a stage counts as silent, and when the counts of a row agree, at each limit.

A moving stage is asked for its status every 0.125 s here, a quarter of its heartbeat of 0.5 s, and has half of the
heartbeat, 0.25 s, to answer. At rest it is asked every second and has 3 s.
"""

from types import SimpleNamespace
from typing import Any

import pytest

from polysight_pi.motions import RunningRow, estimate_row_duration_s
from polysight_pi.stage import StatusWatch
from polysight_pi.trigger import Counts
from polysight_shared.faults import PiFault
from polysight_shared.raster import Row, Stage

ROW = Row(index=0, y_mm=0.0, x_start_mm=0.0, step_mm=-2.0, points=50)
HEARTBEAT_S = 0.5
# Time at which a watch begins.
BEGIN_S = 100.0
# The reader looks at the watch every 50 ms.
LOOK_S = 0.05


def make_watch(interval_s: float = 0.125) -> StatusWatch:
    watch = StatusWatch(HEARTBEAT_S, BEGIN_S)
    watch.ask_every(interval_s, BEGIN_S)
    return watch


def look(watch: StatusWatch, begin_s: float, end_s: float) -> float:
    """Look as the reader does, from `begin_s` to `end_s`; return the silence at the end, 0 within the timeout."""
    silent_s = 0.0
    steps = round((end_s - begin_s) / LOOK_S)
    for step in range(steps + 1):
        silent_s = watch.silent_s(begin_s + step * LOOK_S)
    return silent_s


def test_a_request_is_due_once_an_interval():
    watch = make_watch()
    for after_s, is_due in ((0.124, False), (0.125, True), (0.126, False), (0.249, False), (0.25, True)):
        assert watch.is_due(BEGIN_S + after_s) == is_due, after_s

    # An interval of 0 means that the status is not requested any more.
    watch.ask_every(0.0, 101.0)
    assert not watch.is_due(200.0)
    assert not watch.is_at_rest


@pytest.mark.parametrize(("heartbeat_s", "look_s"), [(0.5, 0.05), (0.1, 0.0125), (10.0, 0.05)])
def test_a_watch_is_looked_at_twice_for_each_request(heartbeat_s, look_s):
    assert StatusWatch(heartbeat_s, 0.0).look_s == pytest.approx(look_s)


@pytest.mark.parametrize(("interval_s", "timeout_s"), [(0.125, 0.25), (1.0, 3.0)])
def test_a_stage_is_silent_when_its_oldest_request_is_not_answered(interval_s, timeout_s):
    watch = make_watch(interval_s)
    assert watch.is_at_rest == (interval_s == 1.0)
    asked_s = 120.0
    # Before the first request there is no silence.
    assert look(watch, BEGIN_S, asked_s) == 0.0
    assert watch.is_due(asked_s)
    assert look(watch, asked_s + LOOK_S, asked_s + timeout_s) == 0.0
    # A later request does not begin the time again.
    later_s = asked_s + timeout_s
    assert watch.is_due(later_s)
    assert look(watch, later_s + LOOK_S, later_s + 2 * LOOK_S) == pytest.approx(timeout_s + 2 * LOOK_S)
    watch.note_answer()
    assert watch.silent_s(later_s + 3 * LOOK_S) == 0.0


def test_time_in_which_the_reader_itself_was_late_does_not_count():
    watch = make_watch()
    look(watch, BEGIN_S, 100.1)
    asked_s = 100.125
    assert watch.is_due(asked_s)
    assert watch.silent_s(asked_s) == 0.0
    # The reader slept for ten seconds. Usually it looks every 50 ms, and is late by no more than that.
    awake_s = 110.125
    assert watch.silent_s(awake_s) == 0.0
    # From now on the stage has the usual timeout, half of a heartbeat.
    timeout_s = 0.25
    assert look(watch, awake_s + LOOK_S, awake_s - 2 * LOOK_S + timeout_s) == 0.0
    assert look(watch, awake_s - LOOK_S + timeout_s, awake_s + timeout_s) == pytest.approx(timeout_s + 2 * LOOK_S)


def test_another_interval_of_requests_begins_the_time_again():
    watch = make_watch()
    assert watch.is_due(100.2)
    new_begin_s = 200.0
    watch.ask_every(0.1, new_begin_s)
    assert look(watch, new_begin_s, new_begin_s + HEARTBEAT_S) == 0.0


def make_row(**changes: Any) -> RunningRow:
    """A row of 50 points with 16 pulses each, all of which came."""
    fields: dict[str, Any] = {
        "sequence": 1, "row": ROW, "take": 1, "job": SimpleNamespace(spec=SimpleNamespace(pulses=16)),
        "motion": None, "edges": SimpleNamespace(judge=lambda *_: ""), "points": 50, "triggers": 50,
    }  # fmt: skip
    return RunningRow(**(fields | changes))


# A complete row has an edge and a burst at each of its 50 points.
COMPLETE = Counts(edges=50, bursts=50, pulses=50 * 16)


@pytest.mark.parametrize(
    ("changes", "counts", "status", "fault"),
    [
        ({}, COMPLETE, "done", 0), ({"was_held": True}, COMPLETE, "done", 0),
        ({"points": 49}, COMPLETE, "fault", PiFault.POINTS_MISMATCH),
        ({"points": 51}, COMPLETE, "fault", PiFault.POINTS_MISMATCH),
        ({"triggers": 49}, COMPLETE, "fault", PiFault.POINTS_MISMATCH),
        ({"points": 51, "triggers": 51}, COMPLETE, "fault", PiFault.POINTS_MISMATCH),
        ({}, COMPLETE._replace(edges=49), "fault", PiFault.POINTS_MISMATCH),
        ({}, COMPLETE._replace(bursts=51), "fault", PiFault.POINTS_MISMATCH),
        ({}, COMPLETE._replace(pulses=799), "fault", PiFault.POINTS_MISMATCH),
        ({}, COMPLETE._replace(pulses=801), "fault", PiFault.POINTS_MISMATCH),
        ({"edges": SimpleNamespace(judge=lambda *_: "late")}, COMPLETE, "fault", PiFault.EDGE_TIME),
    ],
)  # fmt: skip
def test_a_row_is_done_when_all_counts_are_those_requested(changes, counts, status, fault):
    row = make_row(**changes)
    row.judge(counts)
    assert (row.status, row.fault) == (status, int(fault))
    assert ("held" in row.reason) == ("was_held" in changes)
    if fault == PiFault.POINTS_MISMATCH:
        assert f"50 points requested, {row.points} passed by the stage with {row.triggers} trigger pulses" in row.reason
        assert f"{counts.pulses} of 800 pulses sent" in row.reason
    # A result is decided once.
    assert not row.set_result("aborted")
    assert row.status == status


def test_a_row_is_expected_to_last_as_long_as_its_travel_points_and_ramps():
    """The travel is the longest one in both axes, one after the other. Travel and row have two ramps each."""
    stage = Stage("x", travel_x_mm=800.0, travel_y_mm=500.0, travel_speed_mm_s=40.0, accel_mm_s2=200.0)
    speed_mm_s = 20.0
    travel_s = (800 + 500) / 40
    points_s = 50 * 2 / speed_mm_s
    ramp_s = speed_mm_s / 200
    assert estimate_row_duration_s(ROW, stage, speed_mm_s) == pytest.approx(travel_s + points_s + 4 * ramp_s)
