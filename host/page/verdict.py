"""Whether the scan is fine, in one sentence, and what to do when it is not. Pure: everything it judges is handed in."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from polysight.host.acquisition import ScanCommand
from polysight.host.page.images import Shown
from polysight.host.page.listener import Heard
from polysight.host.page.story import Notice, Story, sentence

StatusLevel = Literal["good", "done", "wait", "warn", "bad"]
SINCE = "{since}"  # where the page writes for how long
_LATELY_ROWS = 3  # a rejected take is news for so many rows
_LATE_ROWS = 3.0  # no row has ended for so many rows' time: something holds the scan up
_LATE_S = 60.0
_DIRECT_RAD = 0.1  # residual of the direct path above which images lose contrast; usual is 0.004
_MASKED = 0.05  # share of positions without a direct path that is worth a word


@dataclass(frozen=True)
class Status:
    """The headline: `level` for colour and sign, `do` empty when there is nothing to do.

    `SINCE` in `detail` stands for the time that has passed since `since_s` (seconds since 1970).
    """

    level: StatusLevel
    headline: str
    detail: str = ""
    why: str = ""
    do: str = ""
    since_s: float = 0.0


@dataclass(frozen=True)
class Signs:
    """Signs of life.

    Attributes
    ----------
    alive, alive_s
        Whether the scan program gives signs; when it gave the last one, if not.
    pi_silent_s, pi_limit_s
        For how long the Pi has been silent, None while nothing was ever heard of it; and for how long it may be.
    now_s
        Now. Times are seconds since 1970.
    """

    alive: bool
    alive_s: float
    pi_silent_s: float | None
    pi_limit_s: float
    now_s: float


def no_scan(folder: Path) -> Status:
    """Nothing there yet."""
    return Status(
        "wait", "No scan here yet", f"{folder} holds no scan. This page begins by itself when it does.", "",
        f"`polysight scan --out {folder}`",
    )  # fmt: skip


def unreadable(folder: Path, problem: str) -> Status:
    """A scan whose first fact cannot be made sense of."""
    why = "It was written by another release, or is damaged"
    return Status("bad", "This scan cannot be shown", problem, why, f"`polysight validate {folder}`")


def judge(story: Story, folder: Path, signs: Signs, heard: Heard, shown: Shown, asked: ScanCommand | None) -> Status:
    """The status of a scan: the worst thing first."""
    rows, done = story.plan.rows, len(story.takes)
    resume = f"`polysight resume {folder}`"
    if story.ended is not None:
        return _ended(story, rows, done, resume)
    if not signs.alive:
        return Status(
            "bad", "The scan program is gone", f"No sign of life for {SINCE}; {done} of {rows} rows are safe.",
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
            "bad", "It came before this view.", "Its terminal says more", "On the Pi: `journalctl -u polysight-pi`"
        )
        told = heard.faults[-1] if heard.faults else unknown
        return Status("bad", "The rig has stopped with a fault", told.what, told.why, told.do)
    if asked is ScanCommand.ABORT:
        return Status("wait", "Stopping now", "The stage stops; the running row will be taken again.")
    if asked is ScanCommand.STOP:
        return Status("wait", "Stopping after this row", f"Afterwards, {resume} goes on.")
    if story.paused:
        return Status(
            "wait", "Paused", f"{done} of {rows} rows are safe. Nothing moves.", "",
            f"Continue with the button, or `touch {folder}/control/continue`",
        )  # fmt: skip
    if asked is ScanCommand.PAUSE:
        return Status("wait", "Pausing after this row", "The stage stands still then, until you continue.")
    if heard.state == "held":
        return Status(
            "warn", "The stage is held", "Within a row. Held for more than 2 s, the row is taken again.",
            "A program other than polysight sent the Pi `Hold`",
            f"That program sends `Resume`; or end the scan: `touch {folder}/control/abort`",
        )  # fmt: skip
    if heard.state == "homing":
        return Status("good", "Homing the stage", "Rows begin when it knows where it is.")
    if heard.row >= 0 and story.marks.get(heard.row) == "rejected":
        return _news(story, f"Row {heard.row} is taken again (take {heard.take})")
    if late := _late(story, signs):
        return late
    if story.rows_since_trouble < _LATELY_ROWS and any(n.level == "warn" for n in story.notices):
        return _news(story, "Going on, after trouble with a row")
    if poor := sync_notices(shown, story.plan.columns):
        return Status("warn", "Rows come, but their data is poor", poor[0].what, poor[0].why, poor[0].do)
    now = f"Row {heard.row} is being scanned." if heard.row >= 0 else f"{done} of {rows} rows are safe."
    return Status("good", "All is well", now)


def _ended(story: Story, rows: int, done: int, resume: str) -> Status:
    ended = story.ended or {}
    reason, status = sentence(str(ended.get("reason", ""))), ended.get("exit_status")
    if status == "success" and done == rows:
        gaps = sum(mark == "kept" for mark in story.marks.values())
        whole = "Every row is safe." if not gaps else f"Every row is safe; {gaps} are kept with gaps, masked."
        return Status("done", "The scan is finished", whole)
    if status == "abort":
        return Status("wait", "Stopped on request", f"{done} of {rows} rows are safe.", "", resume)
    return Status(
        "bad", "The scan has failed", reason, sentence(str(ended.get("why", ""))) or "Its terminal says more",
        sentence(str(ended.get("remedy", ""))) or resume,
    )  # fmt: skip


def _news(story: Story, headline: str) -> Status:
    told = next((n for n in reversed(story.notices) if n.level == "warn"), None)
    if told is None:
        return Status("warn", headline)
    return Status("warn", headline, f"{told.what}.", told.why, told.do)


def _late(story: Story, signs: Signs) -> Status | None:
    """Whether no row has ended for much longer than a row takes."""
    known, since = story.row_seconds, max(story.last_commit_s, story.run_started_s)
    if known is None or known[1] == "first row" or signs.now_s - since < max(_LATE_ROWS * known[0], _LATE_S):
        return None
    return Status(
        "warn", "No row has ended for a while", f"None for {SINCE}, though the scan program lives.",
        "It waits for the disk, for processing, or for the stage", "Look at its terminal: it says for what", since,
    )  # fmt: skip


def sync_notices(shown: Shown, columns: int) -> list[Notice]:
    """What the last row's synchronisation says, where it is not as it should be."""
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
