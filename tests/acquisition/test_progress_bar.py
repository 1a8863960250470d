"""Progress of a running scan: bars of rows and points on a terminal, otherwise a line per tenth; notices on both."""

from __future__ import annotations

import io
import re

from rich.console import Console

from polysight.acquisition.scan import ScanProgress
from polysight.jobs.live_scan import ScanBar

ROWS = 20


def shown(*steps: ScanProgress, terminal: bool) -> str:
    out = io.StringIO()
    with ScanBar(Console(file=out, width=200, force_terminal=terminal, color_system=None)) as bar:
        for step in steps:
            bar.update(step)
    return re.sub(r"\x1b\[[0-9;?]*[a-zA-Z]", "", out.getvalue())


def committed(n: int, left_s: float | None) -> ScanProgress:
    return ScanProgress("committed", "", ROWS, n, row=n - 1, take=1, remaining_s=left_s)


def test_a_line_at_every_tenth_of_the_scan():
    said = shown(*(committed(n, 60.0 * (ROWS - n)) for n in range(1, ROWS + 1)), terminal=False).splitlines()
    assert said[0] == "1 of 20 rows, 19:00 left"
    assert said[1:] == [f"{n} of 20 rows, {ROWS - n}:00 left" for n in range(2, ROWS + 1, 2)]


def test_time_left_in_words():
    def left(seconds: float | None) -> str:
        return shown(committed(1, seconds), terminal=False).strip()

    assert left(None) == "1 of 20 rows,"
    assert left(5.4) == "1 of 20 rows, 0:05 left"
    assert left(3599.6) == "1 of 20 rows, 1:00:00 left"
    assert left(2 * 3600 + 3 * 60 + 4) == "1 of 20 rows, 2:03:04 left"


def test_notices_are_shown_and_steps_are_not():
    step = {"rows": ROWS, "committed": 3, "row": 4, "take": 1}
    answer = ("warning", "retake", "home", "check", "connect", "stop", "held", "wait", "end")
    said = shown(*(ScanProgress(phase, f"so {phase}", **step) for phase in (*answer, "row", "state")), terminal=False)
    assert said.splitlines() == [f"{phase}: so {phase}" for phase in answer]


def test_bars_over_rows_and_points_on_a_terminal():
    step = ScanProgress("state", "", ROWS, 3, row=4, take=1, points=7, row_points=140, remaining_s=90.0)
    said = shown(step, terminal=True)
    assert re.search(r"rows .*3/20 +1:30 left", said)
    assert re.search(r"row 4 .*7/140", said)
    assert "take" not in said
    again = ScanProgress("state", "", ROWS, 3, row=4, take=2, points=0, row_points=140)
    assert "row 4 take 2" in shown(again, terminal=True)
    assert "points" not in shown(committed(1, None), terminal=True), "no bar before a row has points"
    assert " rows, " not in shown(committed(2, 60.0), terminal=True), "lines are for what is no terminal"
