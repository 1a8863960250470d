"""Time left: the duration of rows without pauses between them, the same in the terminal and on the page."""

import io
import re
import statistics
from typing import Literal

import msgspec
import pytest
from rich.console import Console
from tests.support.page.live_view import add_fact, begin_history
from tests.support.rigs import load_published_rig
from tests.support.store.facts import load_facts

from polysight.acquisition import scan
from polysight.acquisition.control import StopRequest
from polysight.acquisition.progress import ScanProgress, time_left, typical_row_s
from polysight.acquisition.row import row_limit_s
from polysight.acquisition.scan import run_scan
from polysight.jobs.live_scan import ScanBar
from polysight.page.history import parse_seconds
from polysight.page.status import estimate_time_left
from polysight_shared.raster import Row

# Durations of a row, a pause and a homing in these tests.
ROW_S = 12.0
PAUSE_S = 7200.0
HOMING_S = 240.0


def test_time_left_is_rows_times_their_time_minus_elapsed_time():
    assert time_left(10, ROW_S) == 10 * ROW_S
    assert time_left(0, ROW_S, 5.0) == 0
    for elapsed in (0.0, 1.0, ROW_S):
        assert time_left(10, ROW_S, elapsed) == 10 * ROW_S - elapsed
    # A row that lasts longer than expected is assumed to end now; the others still need their time.
    assert time_left(10, ROW_S, 1e6) == 9 * ROW_S
    # A clock that was set back does not lengthen the time left.
    assert time_left(10, ROW_S, -3.0) == 10 * ROW_S


def test_one_long_row_does_not_change_the_typical_row_time():
    usual = [11.0, 12.0, 13.0] * 20
    assert typical_row_s([*usual, 900.0]) == statistics.median(usual)
    # Rows of a rig that was sped up are the typical ones after 25 of them.
    assert typical_row_s([*usual, *[6.0] * 25]) == 6.0


def test_the_time_limit_of_a_row_is_a_minute_and_four_times_its_travel():
    rig = load_published_rig()
    stage = msgspec.structs.replace(rig.stage, travel_speed_mm_s=50.0, speed_mm_s=5.0)
    travel_s = (stage.travel_x_mm + stage.travel_y_mm) / stage.travel_speed_mm_s
    row = Row(index=0, y_mm=0.0, x_start_mm=40.0, step_mm=-2.0, points=50)
    row_s = 50 * 2.0 / 5.0
    limit_s = row_limit_s(msgspec.structs.replace(rig, stage=stage), row)
    assert limit_s == 60 + 4 * (travel_s + row_s)


class Clock:
    """A clock in place of the module `time`: it advances when a test says so, and by a sleep, which ends a pause."""

    def __init__(self, stop: StopRequest) -> None:
        self.now = 1000.0
        self._stop = stop

    def monotonic(self) -> float:
        return self.now

    def sleep(self, _: float) -> None:
        self.now += PAUSE_S
        self._stop.paused = False


def test_neither_pause_nor_homing_is_time_of_a_row(rig, tmp_path, monkeypatch):
    """Rows of `ROW_S`, the first after homing, the third after a pause of two hours."""
    stop = StopRequest()
    # Time left, with the number of committed rows or the message of a pause.
    reported = []
    clock = Clock(stop)
    monkeypatch.setattr(scan, "time", clock)

    def progress(p) -> None:
        if p.phase == "home":
            clock.now += HOMING_S
        if p.state == "checking" and p.phase == "state":
            clock.now += ROW_S
        if p.phase == "committed":
            reported.append((p.committed, p.remaining_s))
            stop.paused = p.committed == 2
        if p.phase == "wait":
            reported.append((p.message, p.remaining_s))

    result = run_scan(rig.instrument, tmp_path / "s", stop=stop, progress=progress)
    assert result.exit_status == "success"
    assert [f["fact"] for f in load_facts(result.folder, "scan_paused")] == ["scan_paused"]
    after_rows = [report for report in reported if isinstance(report[0], int)]
    assert after_rows == [(n, (4 - n) * ROW_S) for n in (1, 2, 3, 4)]
    # At the beginning of the pause and at its end
    at_pause_s = [remaining_s for message, remaining_s in reported if isinstance(message, str)]
    assert at_pause_s == [2 * ROW_S] * 2


def test_the_page_has_the_same_time_left(rig, tmp_path):
    """Facts of a scan with changed times: rows a minute apart, a pause of a day before the last."""
    run_scan(rig.instrument, tmp_path / "s")
    utc = "2026-05-{:02d}T02:{:02d}:00.000+00:00"
    started, *facts = load_facts(tmp_path / "s")
    history = begin_history(started | {"started_utc": utc.format(1, 0)})
    for fact in facts:
        if fact["fact"] == "row_committed" and fact["row"] < 3:
            add_fact(history, fact | {"committed_utc": utc.format(1, fact["row"] + 1)})
    add_fact(history, {"fact": "scan_paused", "paused_utc": utc.format(1, 3)})
    add_fact(history, {"fact": "scan_continued", "continued_utc": utc.format(2, 3)})
    seconds_left, _ = estimate_time_left(history, parse_seconds(utc.format(2, 3)) + 20)
    assert seconds_left == pytest.approx(time_left(1, 60.0, 20.0))


ROWS = 20


def show_progress(*steps: ScanProgress, terminal: bool, colours: Literal["standard"] | None = None) -> str:
    out = io.StringIO()
    with ScanBar(Console(file=out, width=200, force_terminal=terminal, color_system=colours)) as bar:
        for step in steps:
            bar.update(step)
    if colours:
        return out.getvalue()
    # Without the escape codes of the terminal.
    return re.sub(r"\x1b\[[0-9;?]*[a-zA-Z]", "", out.getvalue())


def make_progress(n: int, left_s: float | None) -> ScanProgress:
    return ScanProgress("committed", "", ROWS, n, row=n - 1, take=1, remaining_s=left_s)


def test_a_log_has_a_line_at_every_tenth_of_the_scan():
    progress_text = show_progress(
        *(make_progress(n, 60.0 * (ROWS - n)) for n in range(1, ROWS + 1)), terminal=False
    ).splitlines()
    assert progress_text[0] == "1 of 20 rows, 19:00 left"
    assert progress_text[1:] == [f"{n} of 20 rows, {ROWS - n}:00 left" for n in range(2, ROWS + 1, 2)]


def test_a_log_has_notices_and_not_every_step():
    step = {"rows": ROWS, "committed": 3, "row": 4, "take": 1}
    notices = ("warning", "retake", "home", "check", "connect", "stop", "held", "wait", "end")
    steps = [ScanProgress(phase, f"so {phase}", **step) for phase in (*notices, "row", "state")]
    progress_text = show_progress(*steps, terminal=False)
    assert progress_text.splitlines() == [f"{phase}: so {phase}" for phase in notices]


@pytest.mark.parametrize("phase", ["warning", "end"])
def test_messages_are_shown_without_a_change(phase):
    """Brackets and colons, which are markup for the display's library, and numbers, which it colours."""
    message = "the Pi's [stage] differs in 'travel_x_mm' = 12.5: see [/tmp/rig] :x:"
    step = ScanProgress(phase, message, ROWS, committed=3, row=4, take=1)
    assert f"{phase}: {message}\n" in show_progress(step, terminal=True, colours="standard")
    assert show_progress(step, terminal=False) == f"{phase}: {message}\n"
