"""Whatever the stage says, with right checksums: the Pi lives on, tells what its types allow, and leaks nothing."""

from __future__ import annotations

import threading
from pathlib import Path

import pytest

from polysight.shared import messages as m
from polysight.shared.stage_line import Reply

BOUND_BYTES = 24 << 20
FLOOD = 60_000  # lines
HUGE = 9_999_999_999  # ten digits, the most that a line may hold


def resident_bytes() -> int:
    return int(Path("/proc/self/statm").read_text().split()[1]) * 4096


@pytest.mark.parametrize("sign", [1, -1])
def test_an_impossible_place_is_not_told(pi, stage, sign):
    """Status and events stay readable; the place is the last one that was possible."""
    stage.x = stage.y = sign * HUGE
    for alarm in (-HUGE, -1, 1000, HUGE):
        fields = {"state": "idle", "x": stage.x, "y": stage.y, "points": HUGE, "alarm": alarm}
        stage.say(Reply("status", fields={k: str(v) for k, v in fields.items()}))
    told = pi.host.wait(m.StageStatus, lambda e: e.points == HUGE)
    assert (told.x_mm, told.y_mm) == (0.0, 0.0)
    assert 0 <= told.alarm < 1000
    assert pi.host.ask(m.Status()).x_mm == 0.0


def test_impossible_lost_steps_and_points_spoil_no_journal(pi, stage):
    stage.lost = (HUGE, -HUGE)
    pi.host.accepted(pi.host.begin())
    pi.host.home()
    status = pi.host.ask(m.Status())
    assert (status.lost_x_mm, status.lost_y_mm) == (1e6, -1e6)
    stage.pace_s = 0.02
    pi.host.accepted(m.RunRow(scan_id="scan", row_index=0, take=1))
    pi.host.wait(m.Capture)
    row = stage.seen[-1]
    stage.say(Reply("done", row.sequence, fields={"points": str(HUGE), "pulses": "0", "x": str(HUGE), "y": "0"}))
    done = pi.host.wait(m.RowFinished)
    assert (done.status, done.points) == ("fault", HUGE)
    assert pi.host.replay()[-1].seq >= done.seq


@pytest.mark.parametrize(
    "line",
    [
        Reply("status", fields={"state": "row", "x": "1", "y": "2", "points": "3", "alarm": "0"}),
        Reply("banner", fields={"fw": "x" * 60, "proto": "2"}),
        Reply("alarm", number=999),
        Reply("alarm", number=15),
        Reply("done", 7),
        Reply("ok", 7),
        Reply("error", None, 1),
    ],
    ids=lambda r: f"{r.kind}{r.number or ''}",
)
def test_a_flood_of_lines_is_answered_with_patience(pi, stage, line):
    """Far more than a serial line carries: memory stays, and commands are answered."""
    raw, ended = line.encode() * 100, threading.Event()

    def flood() -> None:
        for _ in range(FLOOD // 100):
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
