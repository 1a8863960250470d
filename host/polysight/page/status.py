"""The state of a scan for pages: a status in one sentence with what to do, and all that is shown below it.

Pure functions of history, signs of life and images. A `Snapshot` is the whole state, a `Motion` the part that changes
while the stage moves; both are sent as JSON.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, NamedTuple

import msgspec

from polysight.acquisition import ScanCommand, time_left
from polysight.catalogue import Picture
from polysight.page.history import BoardCounts, PiState, ScanHistory, TriggerHealth, sentence
from polysight.results import Verdict
from polysight.store import ScanEnded
from polysight_shared.findings import Finding
from polysight_shared.raster import WIDTH_US

StatusLevel = Literal["good", "done", "wait", "warn", "bad"]
SINCE = "{since}"
"""The page puts the elapsed time here."""
PAPER_PHASE_RAD = 0.022
"""Phase residual after all stages, paper section 9.1."""
# A rejected take is shown for so many rows.
RECENT_ROWS = 3
# Timeout of a row, in usual durations and at least.
LATE_ROWS = 3.0
LATE_S = 60.0
# Residual of the direct path above which images lose contrast; 0.004 is usual.
DIRECT_RAD = 0.1
# Share of positions without a direct path that gives a warning.
MASKED_SHARE = 0.05
MAX_NOTICES = 30
MARKS = {"committed": "c", "kept": "k", "rejected": "r"}


class RowSync(NamedTuple):
    """Synchronisation of one board in one row: phase std after all stages and of the direct path (nan: unknown)."""

    object_rad: float
    direct_rad: float
    masked: int


class Profile(msgspec.Struct, frozen=True):
    """Range profile of a row: excess path, dB below the direct path by board, and the scene's excess paths."""

    row: int
    excess_m: list[float]
    boards: dict[str, list[float]]
    scene_m: tuple[float, float]


@dataclass(frozen=True)
class Shown:
    """Results of the rows so far; replaced as a whole, never changed.

    Attributes
    ----------
    rows
        Rows that are in the images, ascending.
    pictures
        See :func:`polysight.catalogue.draw`.
    profile
        Of the last row.
    sync
        By board and row, rows ascending.
    problem
        The last error of a row.
    """

    revision: int = 0
    rows: tuple[int, ...] = ()
    pictures: dict[str, Picture] = field(default_factory=dict)
    profile: Profile | None = None
    sync: dict[str, dict[int, RowSync]] = field(default_factory=dict)
    problem: Finding | None = None


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


@dataclass(frozen=True)
class Inputs:
    """What a snapshot is made from; `asked` is the command that the scan has not yet carried out."""

    folder: Path
    history: ScanHistory | None
    signs: LifeSigns
    pi: PiState = field(default_factory=PiState)
    shown: Shown = field(default_factory=Shown)
    asked: ScanCommand | None = None
    control: bool = False
    problem: str = ""
    verdict: Verdict | None = None


class Status(msgspec.Struct, frozen=True):
    """The headline: `level` sets colour and sign; `do` is empty if there is nothing to do.

    `SINCE` in `detail` stands for the time elapsed since `since_s` (seconds since 1970).
    """

    level: StatusLevel
    headline: str
    detail: str = ""
    why: str = ""
    do: str = ""
    since_s: float = 0.0


class ScanState(msgspec.Struct, frozen=True, kw_only=True):
    """The scan, its plan, and its rows so far: their number, one letter for each (`MARKS`), and their pulses."""

    folder: str
    rig: str
    simulated: bool
    columns: int
    rows: int
    step_x_mm: float
    step_y_mm: float
    receivers: list[str]
    committed: int
    marks: str
    pulses: int
    pulse_limit_us: float


class PicturesState(msgspec.Struct, frozen=True):
    """Rows in the pictures, rows that are not in them yet, and by name the ends of each picture's colours."""

    revision: int
    rows: int
    waiting: int
    width_mm: float
    height_mm: float
    scales: dict[str, tuple[float, float, str]]


class Snapshot(msgspec.Struct, frozen=True, kw_only=True):
    """The whole state of a scan; `scan` and what follows are empty where there is no scan yet.

    `control`: it may be controlled; `asked`: what it was asked and has not carried out. `sync` is the phase left over
    by board and row, degrees (nan: unknown).
    """

    status: Status
    notices: list[Finding]
    control: bool
    running: bool = False
    paused: bool = False
    asked: ScanCommand | None = None
    scan: ScanState | None = None
    boards: list[BoardCounts] = []
    trigger: TriggerHealth | None = None
    pictures: PicturesState | None = None
    profile: Profile | None = None
    sync: dict[str, dict[int, float]] = {}
    paper_deg: float = round(math.degrees(PAPER_PHASE_RAD), 2)
    verdict: Verdict | None = None


class Motion(msgspec.Struct, frozen=True, kw_only=True):
    """Stage offset in the rig frame (x, y), mm, and time left with its origin (`measured`, `first row`, `plan`)."""

    now_s: int
    left_s: int | None = None
    left_from: str = ""
    stage: tuple[float, float] | None = None
    row: int = -1
    point: int = 0


def make_snapshot(inputs: Inputs) -> Snapshot:
    """Describe the whole state of a scan."""
    history = inputs.history
    shown = inputs.shown
    if history is None:
        status = _unreadable(inputs) if inputs.problem else no_scan(inputs.folder)
        return Snapshot(status=status, notices=_notices(inputs), control=inputs.control)
    plan = history.plan
    marks = history.marks
    boards = history.boards
    for board in boards:
        board.masked = sum(sync.masked for sync in shown.sync.get(board.name, {}).values())
    sync = {
        name: {row: round(math.degrees(sync.object_rad), 3) for row, sync in rows.items()}
        for name, rows in shown.sync.items()
    }
    return Snapshot(
        status=judge(inputs, history),
        notices=_notices(inputs),
        control=inputs.control,
        running=history.ended is None and inputs.signs.alive,
        paused=history.paused,
        asked=inputs.asked,
        scan=ScanState(
            folder=str(inputs.folder),
            rig=history.instrument.name,
            simulated=history.simulated,
            columns=plan.columns,
            rows=plan.rows,
            step_x_mm=plan.step_x_mm,
            step_y_mm=plan.step_y_mm,
            receivers=[board.name for board in history.instrument.receivers],
            committed=len(history.takes),
            marks="".join(MARKS.get(marks.get(row, ""), ".") for row in range(plan.rows)),
            pulses=len(history.takes) * plan.columns * history.instrument.burst.pulses,
            pulse_limit_us=WIDTH_US[1],
        ),
        boards=boards,
        trigger=history.trigger,
        pictures=_pictures(history, shown),
        profile=shown.profile,
        sync=sync,
        # Products of an earlier run may lie there while the scan goes on.
        verdict=inputs.verdict if history.ended is not None else None,
    )


def make_motion(inputs: Inputs) -> Motion:
    """Describe the fast-changing part."""
    now_s = int(inputs.signs.now_s)
    if inputs.history is None:
        return Motion(now_s=now_s)
    pi = inputs.pi
    left_s, basis = remaining(inputs.history, inputs.signs.now_s) if inputs.signs.alive else (None, "")
    stage = None
    if pi.x_mm is not None and pi.y_mm is not None:
        stage = (round(pi.x_mm, 1), round(pi.y_mm, 1))
    return Motion(now_s=now_s, left_s=left_s, left_from=basis, stage=stage, row=pi.row, point=pi.point)


def remaining(history: ScanHistory, now_s: float) -> tuple[int | None, str]:
    """Seconds to the scan's end and their origin (`measured`, `first row`, `plan`); None: not known."""
    rows_left = history.plan.rows - len(history.takes)
    if history.ended is not None or history.row_seconds is None:
        return (0, "measured") if rows_left == 0 else (None, "")
    row_s, basis = history.row_seconds
    row_began_s = max(history.last_commit_s, history.run_started_s)
    in_row_s = 0.0 if history.paused else now_s - row_began_s
    return round(time_left(rows_left, row_s, in_row_s)), basis


def _pictures(history: ScanHistory, shown: Shown) -> PicturesState:
    image = history.instrument.image
    waiting = max(0, len(history.takes) - len(shown.rows))
    scales = {name: (p.low, p.high, p.unit) for name, p in shown.pictures.items()}
    width_mm = image.columns * image.pixel_mm
    height_mm = image.rows * image.pixel_mm
    return PicturesState(shown.revision, len(shown.rows), waiting, width_mm, height_mm, scales)


def _notices(inputs: Inputs) -> list[Finding]:
    """All notices, the newest first, each once."""
    notices = []
    if inputs.problem:
        why = "It was written by another release, or is damaged"
        notices.append(Finding("warning", inputs.problem, why, f"`polysight validate {inputs.folder}`"))
    history = inputs.history
    if history is not None:
        if inputs.pi.deaf is not None and history.ended is None:
            notices.append(inputs.pi.deaf)
        if inputs.shown.problem is not None:
            notices.append(inputs.shown.problem)
        notices += sync_notices(inputs.shown, history.plan.columns)
        notices += inputs.pi.faults
        notices += reversed(history.notices[-MAX_NOTICES:])
    return [notice for k, notice in enumerate(notices) if notice not in notices[:k]]


def sync_notices(shown: Shown, columns: int) -> list[Finding]:
    """Warnings about the synchronisation of the last row."""
    notices = []
    for board, rows in shown.sync.items():
        if not rows:
            continue
        row = max(rows)
        sync = rows[row]
        if sync.masked > MASKED_SHARE * columns:
            what = f"{board}: {sync.masked} of {columns} positions of row {row} have no usable direct path"
            why = "Something stands between the transmitter and this board, or frames are missing"
            do = "Clear the line of sight; look at the board's frames"
        elif sync.direct_rad > DIRECT_RAD:
            what = f"{board}: synchronisation leaves {sync.direct_rad:.2f} rad in row {row}; 0.004 is usual"
            why = "A weak direct path, or a strong reflector near it"
            do = "Check the antennas' aim; look at the range profile"
        else:
            continue
        notices.append(Finding("warning", what, why, do, where=f"row {row}"))
    return notices


# --- the headline ---


def no_scan(folder: Path) -> Status:
    """Status of a folder without a scan."""
    detail = f"{folder} holds no scan. This page starts when one does."
    return Status("wait", "No scan here yet", detail, "", f"`polysight scan --out {folder}`")


def _unreadable(inputs: Inputs) -> Status:
    """Status of a scan whose first fact cannot be read."""
    why = "It was written by another release, or is damaged"
    return Status("bad", "This scan cannot be shown", inputs.problem, why, f"`polysight validate {inputs.folder}`")


def judge(inputs: Inputs, history: ScanHistory) -> Status:
    """The status of a scan; the worst condition wins."""
    if history.ended is not None:
        return _judge_end(inputs, history, history.ended)
    status = _judge_trouble(inputs, history) or _judge_command(inputs, history) or _judge_rows(inputs, history)
    if status is not None:
        return status
    now = _safe_rows(history)
    if inputs.pi.row >= 0:
        now = f"Row {inputs.pi.row} is being scanned."
    return Status("good", "All is well", now)


def _safe_rows(history: ScanHistory) -> str:
    return f"{len(history.takes)} of {history.plan.rows} rows are safe."


def _judge_end(inputs: Inputs, history: ScanHistory, ended: ScanEnded) -> Status:
    resume = f"`polysight resume {inputs.folder}`"
    if ended.exit_status == "success" and len(history.takes) == history.plan.rows:
        gaps = sum(mark == "kept" for mark in history.marks.values())
        detail = f"Every row is safe; {gaps} are kept with gaps, masked." if gaps else "Every row is safe."
        return Status("done", "The scan is finished", detail)
    if ended.exit_status == "abort":
        return Status("wait", "Stopped on request", _safe_rows(history), "", resume)
    why = sentence(ended.why) or "See its terminal"
    do = sentence(ended.remedy) or resume
    return Status("bad", "The scan has failed", sentence(ended.reason), why, do)


def _judge_trouble(inputs: Inputs, history: ScanHistory) -> Status | None:
    """A program or Pi that does not answer, or a rig that has stopped."""
    signs = inputs.signs
    if not signs.alive:
        return Status(
            "bad", "The scan program has ended", f"No sign of life for {SINCE}; {_safe_rows(history)}",
            "It was killed, or the computer was switched off", f"`polysight resume {inputs.folder}`", signs.alive_s,
        )  # fmt: skip
    if signs.pi_silent_s is not None and signs.pi_silent_s > signs.pi_limit_s:
        return Status(
            "bad", "The Pi is silent", f"No heartbeat for {SINCE}. The stage stops by itself.",
            "Network or power of the Pi, or its program ended", "On the Pi: `systemctl status polysight-pi`",
            inputs.pi.heard_utc_s,
        )  # fmt: skip
    if inputs.pi.state != "fault":
        return None
    headline = "The rig has stopped with a fault"
    if not inputs.pi.faults:
        do = "On the Pi: `journalctl -u polysight-pi`"
        return Status("bad", headline, "It occurred before this view.", "See the Pi's log", do)
    fault = inputs.pi.faults[-1]
    return Status("bad", headline, fault.what, fault.why, fault.do)


def _judge_command(inputs: Inputs, history: ScanHistory) -> Status | None:
    """A scan that was asked to stop or pause, or is held."""
    folder = inputs.folder
    if inputs.asked is ScanCommand.ABORT:
        return Status("wait", "Stopping now", "The stage stops; the running row will be retaken.")
    if inputs.asked is ScanCommand.STOP:
        return Status("wait", "Stopping after this row", f"Resume later: `polysight resume {folder}`.")
    if history.paused:
        do = f"Continue with the button, or `touch {folder}/control/continue`"
        return Status("wait", "Paused", f"{_safe_rows(history)} Nothing moves.", "", do)
    if inputs.asked is ScanCommand.PAUSE:
        return Status("wait", "Pausing after this row", "The stage stands still then, until you continue.")
    if inputs.pi.state == "held":
        return Status(
            "warn", "The stage is held", "Within a row. Held for more than 2 s, the row is retaken.",
            "A program other than polysight sent the Pi `Hold`",
            f"That program sends `Resume`; or end the scan: `touch {folder}/control/abort`",
        )  # fmt: skip
    return None


def _judge_rows(inputs: Inputs, history: ScanHistory) -> Status | None:
    """Rows that are retaken, late, or poor."""
    pi = inputs.pi
    if pi.state == "homing":
        return Status("good", "Homing the stage", "Rows begin when its position is known.")
    if pi.row >= 0 and history.marks.get(pi.row) == "rejected":
        return _recent_warning(history, f"Row {pi.row} is retaken (take {pi.take})")
    if late := _judge_lateness(history, inputs.signs):
        return late
    if history.rows_since_trouble < RECENT_ROWS and any(n.level == "warning" for n in history.notices):
        return _recent_warning(history, "Scanning, after a fault in a row")
    if poor := sync_notices(inputs.shown, history.plan.columns):
        return Status("warn", "Scanning, but the data is poor", poor[0].what, poor[0].why, poor[0].do)
    return None


def _recent_warning(history: ScanHistory, headline: str) -> Status:
    for notice in reversed(history.notices):
        if notice.level == "warning":
            return Status("warn", headline, f"{notice.what}.", notice.why, notice.do)
    return Status("warn", headline)


def _judge_lateness(history: ScanHistory, signs: LifeSigns) -> Status | None:
    """A warning if no row has ended for much longer than a row takes."""
    if history.row_seconds is None:
        return None
    row_s, basis = history.row_seconds
    since = max(history.last_commit_s, history.run_started_s)
    if basis == "first row" or signs.now_s - since < max(LATE_ROWS * row_s, LATE_S):
        return None
    return Status(
        "warn", "No row has ended for a while", f"None for {SINCE}, though the scan program runs.",
        "It waits for the disk, for processing, or for the stage", "See its terminal", since,
    )  # fmt: skip
