"""The status of a scan in one sentence, with what to do: pure functions of history, signs of life and images."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from polysight.acquisition import ScanCommand
from polysight.page.history import Notice, ScanHistory, sentence
from polysight.page.images import Shown
from polysight.page.listener import PiState
from polysight.store import ScanEnded

StatusLevel = Literal["good", "done", "wait", "warn", "bad"]
SINCE = "{since}"  # the page puts the elapsed time here
_LATELY_ROWS = 3  # a rejected take is shown for so many rows
_LATE_ROWS = 3.0  # timeout of a row, in usual durations
_LATE_S = 60.0
_DIRECT_RAD = 0.1  # residual of the direct path above which images lose contrast; usual is 0.004
_MASKED = 0.05  # share of positions without a direct path that gives a warning


@dataclass(frozen=True)
class Status:
    """The headline: `level` sets colour and sign; `do` is empty if there is nothing to do.

    `SINCE` in `detail` stands for the time elapsed since `since_s` (seconds since 1970).
    """

    level: StatusLevel
    headline: str
    detail: str = ""
    why: str = ""
    do: str = ""
    since_s: float = 0.0


@dataclass(frozen=True)
class LifeSigns:
    """Signs of life of the scan program and the Pi.

    Attributes
    ----------
    alive, alive_s
        True if the scan program gives signs of life; otherwise the time of the last one.
    pi_silent_s, pi_limit_s
        Time since the last event of the Pi (None before the first), and its timeout.
    now_s
        Now. Times are seconds since 1970.
    """

    alive: bool
    alive_s: float
    pi_silent_s: float | None
    pi_limit_s: float
    now_s: float


def no_scan(folder: Path) -> Status:
    """Status of a folder without a scan."""
    return Status(
        "wait", "No scan here yet", f"{folder} holds no scan. This page starts when one does.", "",
        f"`polysight scan --out {folder}`",
    )  # fmt: skip


def unreadable(folder: Path, problem: str) -> Status:
    """Status of a scan whose first fact cannot be read."""
    why = "It was written by another release, or is damaged"
    return Status("bad", "This scan cannot be shown", problem, why, f"`polysight validate {folder}`")


def judge(
    history: ScanHistory, folder: Path, signs: LifeSigns, heard: PiState, shown: Shown, asked: ScanCommand | None
) -> Status:
    """The status of a scan; the worst condition wins."""
    rows, done = history.plan.rows, len(history.takes)
    resume = f"`polysight resume {folder}`"
    if history.ended is not None:
        return _ended(history, rows, done, resume)
    if not signs.alive:
        return Status(
            "bad", "The scan program has ended", f"No sign of life for {SINCE}; {done} of {rows} rows are safe.",
            "It was killed, or the computer was switched off", resume, signs.alive_s,
        )  # fmt: skip
    if signs.pi_silent_s is not None and signs.pi_silent_s > signs.pi_limit_s:
        return Status(
            "bad", "The Pi is silent", f"No heartbeat for {SINCE}. The stage stops by itself.",
            "Network or power of the Pi, or its program ended", "On the Pi: `systemctl status polysight-pi`",
            heard.heard_utc_s,
        )  # fmt: skip
    if heard.state == "fault":
        unknown = Notice(
            "bad", "It occurred before this view.", "See the Pi's log", "On the Pi: `journalctl -u polysight-pi`"
        )
        fault = heard.faults[-1] if heard.faults else unknown
        return Status("bad", "The rig has stopped with a fault", fault.what, fault.why, fault.do)
    if asked is ScanCommand.ABORT:
        return Status("wait", "Stopping now", "The stage stops; the running row will be retaken.")
    if asked is ScanCommand.STOP:
        return Status("wait", "Stopping after this row", f"Resume later: {resume}.")
    if history.paused:
        return Status(
            "wait", "Paused", f"{done} of {rows} rows are safe. Nothing moves.", "",
            f"Continue with the button, or `touch {folder}/control/continue`",
        )  # fmt: skip
    if asked is ScanCommand.PAUSE:
        return Status("wait", "Pausing after this row", "The stage stands still then, until you continue.")
    if heard.state == "held":
        return Status(
            "warn", "The stage is held", "Within a row. Held for more than 2 s, the row is retaken.",
            "A program other than polysight sent the Pi `Hold`",
            f"That program sends `Resume`; or end the scan: `touch {folder}/control/abort`",
        )  # fmt: skip
    if heard.state == "homing":
        return Status("good", "Homing the stage", "Rows begin when its position is known.")
    if heard.row >= 0 and history.marks.get(heard.row) == "rejected":
        return _news(history, f"Row {heard.row} is retaken (take {heard.take})")
    if late := _late(history, signs):
        return late
    if history.rows_since_trouble < _LATELY_ROWS and any(n.level == "warn" for n in history.notices):
        return _news(history, "Scanning, after a fault in a row")
    if poor := sync_notices(shown, history.plan.columns):
        return Status("warn", "Scanning, but the data is poor", poor[0].what, poor[0].why, poor[0].do)
    now = f"Row {heard.row} is being scanned." if heard.row >= 0 else f"{done} of {rows} rows are safe."
    return Status("good", "All is well", now)


def _ended(history: ScanHistory, rows: int, done: int, resume: str) -> Status:
    ended = history.ended or ScanEnded()
    reason, status = sentence(ended.reason), ended.exit_status
    if status == "success" and done == rows:
        gaps = sum(mark == "kept" for mark in history.marks.values())
        whole = "Every row is safe." if not gaps else f"Every row is safe; {gaps} are kept with gaps, masked."
        return Status("done", "The scan is finished", whole)
    if status == "abort":
        return Status("wait", "Stopped on request", f"{done} of {rows} rows are safe.", "", resume)
    return Status(
        "bad", "The scan has failed", reason, sentence(ended.why) or "See its terminal",
        sentence(ended.remedy) or resume,
    )  # fmt: skip


def _news(history: ScanHistory, headline: str) -> Status:
    last = next((n for n in reversed(history.notices) if n.level == "warn"), None)
    if last is None:
        return Status("warn", headline)
    return Status("warn", headline, f"{last.what}.", last.why, last.do)


def _late(history: ScanHistory, signs: LifeSigns) -> Status | None:
    """A warning if no row has ended for much longer than a row takes."""
    known, since = history.row_seconds, max(history.last_commit_s, history.run_started_s)
    if known is None or known[1] == "first row" or signs.now_s - since < max(_LATE_ROWS * known[0], _LATE_S):
        return None
    return Status(
        "warn", "No row has ended for a while", f"None for {SINCE}, though the scan program runs.",
        "It waits for the disk, for processing, or for the stage", "See its terminal", since,
    )  # fmt: skip


def sync_notices(shown: Shown, columns: int) -> list[Notice]:
    """Warnings about the synchronisation of the last row."""
    found = []
    for board, rows in shown.sync.items():
        if not rows:
            continue
        row = max(rows)
        _, direct_rad, masked = rows[row]
        if masked > _MASKED * columns:
            what = f"{board}: {masked} of {columns} positions of row {row} have no usable direct path"
            why = "Something stands between the transmitter and this board, or frames are missing"
            found.append(Notice("warn", what, why, "Clear the line of sight; look at the board's frames", row=row))
        elif direct_rad > _DIRECT_RAD:
            what = f"{board}: synchronisation leaves {direct_rad:.2f} rad in row {row}; 0.004 is usual"
            why = "A weak direct path, or a strong reflector near it"
            found.append(Notice("warn", what, why, "Check the antennas' aim; look at the range profile", row=row))
    return found
