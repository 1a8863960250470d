"""Impossible replies of the stage, with correct checksums: the Pi stays alive, its messages valid, its memory flat."""

from __future__ import annotations

import threading

import pytest
from tests.support.pi.program import resident_bytes

from polysight_shared import messages as m
from polysight_shared.stage_line import Reply

BOUND_BYTES = 24 << 20
FLOOD = 100_000  # lines
HUGE = 9_999_999_999  # ten digits, the most that a line may hold


@pytest.mark.parametrize("sign", [1, -1])
def test_an_impossible_position_is_ignored(pi, stage, sign):
    """Status and events stay readable; the position is the last possible one."""
    stage.x = stage.y = sign * HUGE
    for alarm in (-HUGE, -1, 1000, HUGE):
        fields = {"state": "idle", "x": stage.x, "y": stage.y, "points": HUGE, "alarm": alarm}
        stage.say(Reply("status", fields={k: str(v) for k, v in fields.items()}))
    seen = pi.host.wait(m.StageStatus, lambda e: e.points == HUGE)
    assert (seen.x_mm, seen.y_mm) == (0.0, 0.0)
    assert 0 <= seen.alarm < 1000
    assert pi.host.ask(m.Status()).x_mm == 0.0


def test_impossible_lost_steps_and_points_spoil_no_journal(pi, stage):
    stage.lost = (HUGE, -HUGE)
    pi.host.accepted(pi.host.begin())
    pi.host.home()
    status = pi.host.ask(m.Status())
    assert (status.lost_x_mm, status.lost_y_mm) == (1e6, -1e6)
    stage.pace_s = 0.02
    pi.host.start_row()
    pi.host.wait(m.Capture)
    row = stage.seen[-1]
    stage.say(Reply("done", row.sequence, fields={"points": str(HUGE), "pulses": "0", "x": str(HUGE), "y": "0"}))
    done = pi.host.wait(m.RowFinished)
    assert (done.status, done.points) == ("fault", HUGE)
    assert pi.host.replay()[-1].seq >= done.seq


def test_a_flood_of_lines_keeps_commands_answered(pi, stage):
    """Far more than a serial line carries."""
    lines = (
        Reply("status", fields={"state": "row", "x": "1", "y": "2", "points": "3", "alarm": "0"}),
        Reply("banner", fields={"fw": "x" * 60, "proto": "2"}), Reply("alarm", number=999), Reply("alarm", number=15),
        Reply("done", 7), Reply("ok", 7), Reply("error", None, 1),
    )  # fmt: skip
    raw, ended = b"".join(line.encode() for line in lines) * 14, threading.Event()

    def flood() -> None:
        for _ in range(FLOOD // 98):
            stage.say_raw(raw)
        ended.set()

    before = resident_bytes()
    thread = threading.Thread(target=flood)
    thread.start()
    while not ended.wait(0.05):
        assert isinstance(pi.host.ask(m.Status()), m.StatusReply)
    thread.join()
    assert resident_bytes() - before < BOUND_BYTES
    assert pi.service.executor.crash is None
    assert isinstance(pi.host.ask(m.Abort()), m.Accepted)
