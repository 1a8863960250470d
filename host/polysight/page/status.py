"""Describe the state of a scan for pages: a status in one sentence with what to do, and all that is shown below it.

The functions are pure: they use only the history, the signs of life and the images that they are given. A `Snapshot` is
the whole state, a `Motion` the part that changes while the stage moves; both are sent as JSON.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import msgspec

from polysight.acquisition import STATES, Button, SignOfLife, StateLevel, time_left
from polysight.catalogue import Picture, Program
from polysight.page.history import BoardCounts, PiState, ScanHistory, TriggerHealth, capitalise, parse_seconds
from polysight.results import Verdict, rules
from polysight.store import ScanEnded
from polysight.sync import PUBLISHED_STD
from polysight_shared.errors import quote
from polysight_shared.findings import Finding
from polysight_shared.raster import WIDTH_US

ELAPSED_PLACEHOLDER = "{since}"
"""The page replaces this text by the elapsed time."""
# Number of rows without a fault after which the headline no longer shows the last fault; chosen.
RECENT_ROWS = 3
# A row is late if it takes longer than `LATE_ROWS` usual durations and longer than `LATE_S` seconds; chosen.
LATE_ROWS = 3.0
LATE_S = 60.0
# Residual phase of the direct path above which a row gives a warning; chosen. 0.004 is usual.
DIRECT_RAD = 0.1
# Share of positions without a direct path that gives a warning; chosen.
MASKED_SHARE = 0.05
# Notices of the manifest that a page lists; chosen.
MAX_NOTICES = 30
# Characters of an ISO time up to its seconds: the page and the manifest write different fractions.
ISO_SECONDS_CHARACTERS = 19
# Letter of a row, by how its last take ended; a row without a take has a dot.
MARKS = {"committed": "c", "kept": "k", "rejected": "r"}


class RowSync(NamedTuple):
    """Synchronisation of one board in one row: phase std after all stages and of the direct path (nan: unknown).

    `masked` is the number of positions without a direct path, `snr_db` the direct path over its scatter between bursts,
    `dead_rx` are the RX without a signal, counted from 1.
    """

    object_rad: float
    direct_rad: float
    masked: int
    snr_db: float = math.nan
    dead_rx: tuple[int, ...] = ()


class Profile(msgspec.Struct, frozen=True):
    """Range profile of a row against the excess path, which is the path minus the direct path.

    `boards` has the level of each board, dB relative to the direct path; `scene_m` is the range of excess paths that
    the scene can have.
    """

    row: int
    excess_m: list[float]
    boards: dict[str, list[float]]
    scene_m: tuple[float, float]


@dataclass(frozen=True)
class ShownResults:
    """Results of the rows so far; replaced as a whole, never changed.

    Attributes
    ----------
    revision
        Number that increases with each replacement, so that pages recognise new pictures.
    rows
        Rows that are in the images, ascending.
    pictures
        See :func:`polysight.catalogue.draw`.
    profile
        Range profile of the last row.
    sync
        Residuals of synchronisation by board and row, rows ascending.
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
    life
        What the scan program wrote last; None if it wrote nothing.
    alive
        True if the program wrote recently or, without `life`, if the manifest grew recently.
    killed
        True if the program's process has ended without writing why.
    alive_s
        Time of the last sign of life of a program that is not alive.
    pi_silent_s, pi_limit_s
        Time since the last event of the Pi (None before the first), and its timeout.
    now_s
        Now. Times are seconds since 1970.
    """

    life: SignOfLife | None
    alive: bool
    killed: bool
    alive_s: float
    pi_silent_s: float | None
    pi_limit_s: float
    now_s: float


@dataclass(frozen=True)
class Inputs:
    """Everything that a snapshot is made from.

    Attributes
    ----------
    history
        The scan by its manifest; None before there is a plan.
    signs, pi, shown
        Signs of life, state of the Pi, and results of the rows so far.
    control
        True if pages may offer to pause and stop the scan.
    problem
        Why the manifest cannot be read; "" if it can.
    program
        The last program of this scan that a page started, `scan` or `process`; None without any.
    failure
        Why that program failed, from its log; None if it did not.
    gone
        True if the folder existed before, and does not now.
    verdict
        Verdict of the products with materials, see :class:`polysight.page.watch.ProductsTail`.
    """

    folder: Path
    history: ScanHistory | None
    signs: LifeSigns
    pi: PiState = field(default_factory=PiState)
    shown: ShownResults = field(default_factory=ShownResults)
    control: bool = False
    problem: str = ""
    program: Program | None = None
    failure: Finding | None = None
    gone: bool = False
    verdict: Verdict | None = None


class Status(msgspec.Struct, frozen=True):
    """The headline of the page: a state of `STATES` with its texts completed, and the buttons that may be pressed.

    `ELAPSED_PLACEHOLDER` in `detail` stands for the time elapsed since `since_s` (seconds since 1970).
    """

    key: str
    level: StateLevel
    headline: str
    detail: str = ""
    why: str = ""
    do: str = ""
    press: tuple[Button, ...] = ()
    since_s: float = 0.0


class ScanState(msgspec.Struct, frozen=True, kw_only=True):
    """The scan, its plan, and its rows so far: their number, one letter for each (`MARKS`), and their pulses.

    `pulse_limit_us` is the longest pulse that a radar's SYNC_IN takes.
    """

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
    """Number of rows in the pictures and of rows that wait, and picture to the ends of its colours and their unit."""

    revision: int
    rows: int
    waiting: int
    width_mm: float
    height_mm: float
    scales: dict[str, tuple[float, float, str]]


class Snapshot(msgspec.Struct, frozen=True, kw_only=True):
    """The whole state of a scan; `scan` and what follows are empty where there is no scan yet.

    With `control` the page may control the scan. `sync`, `snr_db` and `lost` map boards and rows to the residual phase
    in degrees (nan: unknown), to the level of the direct path over its scatter, and to the share of missing bytes.
    """

    status: Status
    notices: list[Finding]
    control: bool
    running: bool = False
    paused: bool = False
    scan: ScanState | None = None
    boards: list[BoardCounts] = []
    trigger: TriggerHealth | None = None
    pictures: PicturesState | None = None
    profile: Profile | None = None
    sync: dict[str, dict[int, float]] = {}
    snr_db: dict[str, dict[int, float]] = {}
    lost: dict[str, dict[int, float]] = {}
    paper_deg: float = round(math.degrees(PUBLISHED_STD["phase_rad"]), 2)
    verdict: Verdict | None = None


class Motion(msgspec.Struct, frozen=True, kw_only=True):
    """Stage offset in the rig frame (x, y), mm, and time left with its origin (`measured`, `first row`, `plan`).

    `row` is the running row (-1: none), `point` the last point that it has passed.
    """

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
        return Snapshot(status=judge(inputs), notices=_collect_notices(inputs), control=inputs.control)
    plan = history.plan
    marks = history.marks
    boards = history.boards
    for board in boards:
        board.masked = sum(row.masked for row in shown.sync.get(board.name, {}).values())
    sync = {
        name: {number: round(math.degrees(row.object_rad), 3) for number, row in rows.items()}
        for name, rows in shown.sync.items()
    }
    snr_db = {name: {number: round(row.snr_db, 1) for number, row in rows.items()} for name, rows in shown.sync.items()}
    return Snapshot(
        status=judge(inputs),
        notices=_collect_notices(inputs),
        control=inputs.control,
        running=history.ended is None and inputs.signs.alive,
        paused=history.paused,
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
        pictures=_describe_pictures(history, shown),
        profile=shown.profile,
        sync=sync,
        snr_db=snr_db,
        lost=history.lost_shares,
        verdict=inputs.verdict if _may_have_result(inputs, history) else None,
    )


def make_motion(inputs: Inputs) -> Motion:
    """Describe the fast-changing part."""
    now_s = int(inputs.signs.now_s)
    if inputs.history is None:
        return Motion(now_s=now_s)
    pi = inputs.pi
    left_s = None
    basis = ""
    if inputs.signs.alive:
        left_s, basis = estimate_time_left(inputs.history, inputs.signs.now_s)
    stage = None
    if pi.x_mm is not None and pi.y_mm is not None:
        stage = (round(pi.x_mm, 1), round(pi.y_mm, 1))
    return Motion(now_s=now_s, left_s=left_s, left_from=basis, stage=stage, row=pi.row, point=pi.point)


def estimate_time_left(history: ScanHistory, now_s: float) -> tuple[int | None, str]:
    """Return the seconds to the scan's end and their origin (`measured`, `first row`, `plan`); None: not known."""
    rows_left = history.plan.rows - len(history.takes)
    if history.ended is not None or history.row_seconds is None:
        if rows_left == 0:
            return 0, "measured"
        return None, ""
    row_s, basis = history.row_seconds
    row_began_s = max(history.last_commit_s, history.run_started_s)
    elapsed_in_row_s = 0.0
    if not history.paused:
        elapsed_in_row_s = now_s - row_began_s
    return round(time_left(rows_left, row_s, elapsed_in_row_s)), basis


def _describe_pictures(history: ScanHistory, shown: ShownResults) -> PicturesState:
    """Return the counts of rows in the pictures, their size, and the ends of their colours."""
    image = history.instrument.image
    waiting = max(0, len(history.takes) - len(shown.rows))
    scales = {name: (p.low, p.high, p.unit) for name, p in shown.pictures.items()}
    width_mm = image.columns * image.pixel_mm
    height_mm = image.rows * image.pixel_mm
    return PicturesState(shown.revision, len(shown.rows), waiting, width_mm, height_mm, scales)


def _collect_notices(inputs: Inputs) -> list[Finding]:
    """Return all notices without duplicates, the newest first."""
    notices = []
    if inputs.problem:
        cause = "It was written by another release, or is damaged"
        notices.append(Finding("warning", inputs.problem, cause, f"`polysight validate {quote(inputs.folder)}`"))
    history = inputs.history
    stopped_on_request = history is not None and history.ended is not None and history.ended.exit_status == "abort"
    if inputs.failure is not None and not stopped_on_request:
        notices.append(inputs.failure)
    if history is not None:
        # The error for which the Pi's events cannot be received.
        if inputs.pi.receive_error is not None and history.ended is None:
            notices.append(inputs.pi.receive_error)
        if inputs.shown.problem is not None:
            notices.append(inputs.shown.problem)
        notices += sync_notices(inputs.shown, history.plan.columns)
        notices += inputs.pi.faults
        notices += reversed(history.notices[-MAX_NOTICES:])
    return [notice for k, notice in enumerate(notices) if notice not in notices[:k]]


def sync_notices(shown: ShownResults, columns: int) -> list[Finding]:
    """Return the warnings about the synchronisation of the last row."""
    notices = []
    for board, rows in shown.sync.items():
        if not rows:
            continue
        row = max(rows)
        sync = rows[row]
        for dead in rules.judge_dead_rx(board, {rx: [row] for rx in sync.dead_rx}, rows=1):
            what = capitalise(dead.what)
            why = capitalise(dead.why)
            do = capitalise(dead.do)
            notices.append(Finding("warning", what, why, do, where=f"row {row}"))
        if sync.masked > MASKED_SHARE * columns:
            problem = f"{board}: {sync.masked} of {columns} positions of row {row} have no usable direct path"
            cause = "Something stands between the transmitter and this board, or frames are missing"
            remedy = "Clear the line of sight; look at the board's frames"
        elif sync.direct_rad > DIRECT_RAD:
            problem = f"{board}: synchronisation leaves {sync.direct_rad:.2f} rad in row {row}; 0.004 is usual"
            cause = "A weak direct path, or a strong reflector near it"
            remedy = "Check the antennas' aim; look at the range profile"
        else:
            continue
        notices.append(Finding("warning", problem, cause, remedy, where=f"row {row}"))
    return notices


# --- the headline ---


def make_status(key: str, **words: str | int) -> Status:
    """Return the status of a state of the table, with its texts filled in."""
    state = STATES[key]
    filled = {"since": ELAPSED_PLACEHOLDER, **words}
    # In a command that a user may paste into a shell, the folder is quoted.
    pasted = {**filled, "folder": quote(str(words.get("folder", "")))}
    return Status(
        key=key,
        level=state.level,
        headline=state.headline.format(**filled),
        detail=state.detail.format(**filled).strip(),
        why=state.why.format(**filled),
        do=state.do.format(**pasted),
        press=state.press,
    )


def make_status_since(key: str, since_s: float, **words: str) -> Status:
    """Return the status of a state that has lasted since a time."""
    return msgspec.structs.replace(make_status(key, **words), since_s=since_s)


def make_status_of_finding(key: str, finding: Finding | None, **words: str | int) -> Status:
    """Return the status of a state that reports a finding."""
    if finding is None:
        return make_status(key, what="", why="", do="", **words)
    return make_status(key, what=f"{finding.what}.", why=finding.why, do=finding.do, **words)


def judge(inputs: Inputs) -> Status:
    """Return the status of a scan, which describes its worst condition."""
    history = inputs.history
    folder = str(inputs.folder)
    if inputs.gone:
        return make_status("folder_gone", folder=folder)
    if history is None:
        return _judge_start(inputs)
    if history.ended is not None:
        return _judge_end(inputs, history, history.ended)
    # The conditions are in the order of their weight: the first one that applies is the worst.
    status = _judge_trouble(inputs, history) or _judge_rig(inputs, history) or _judge_rows(inputs, history)
    if status is not None:
        return status
    now = _describe_safe_rows(history)
    if inputs.pi.row >= 0:
        now = f"Row {inputs.pi.row} is being scanned."
    return make_status("rows", now=now)


def _describe_safe_rows(history: ScanHistory) -> str:
    """Return how many rows are committed, as a sentence."""
    return f"{len(history.takes)} of {history.plan.rows} rows are safe."


def _judge_start(inputs: Inputs) -> Status:
    """Return the status of a folder without a manifest."""
    folder = str(inputs.folder)
    if inputs.problem:
        return make_status("unreadable", what=inputs.problem, folder=folder)
    if inputs.program is not None and inputs.program.running:
        return make_status("starting")
    if inputs.failure is not None:
        return make_status_of_finding("start_failed", inputs.failure)
    return make_status("empty", folder=folder)


def _may_have_result(inputs: Inputs, history: ScanHistory) -> bool:
    """True unless the scan runs or its materials are computed: then the products may be those of an earlier run."""
    life = inputs.signs.life
    computing = life is not None and life.doing == "materials" and inputs.signs.alive
    return history.ended is not None and not computing


def _judge_end(inputs: Inputs, history: ScanHistory, ended: ScanEnded) -> Status:
    """Return the status of a scan whose last run has ended."""
    folder = str(inputs.folder)
    safe = _describe_safe_rows(history)
    all_safe = "Every row is safe."
    rows_with_gaps = sum(mark == "kept" for mark in history.marks.values())
    if rows_with_gaps:
        all_safe = f"Every row is safe; {rows_with_gaps} are kept with gaps, masked."
    program = inputs.program
    if not _may_have_result(inputs, history):
        return make_status("materials", all_safe=all_safe)
    if program is not None and program.running and cut_fraction(program.started_utc) > cut_fraction(ended.ended_utc):
        if program.kind == "process":
            return make_status("processing")
        return make_status("resuming", safe=safe)
    if ended.exit_status == "success" and len(history.takes) == history.plan.rows:
        # The program still runs after the last row: whether it will process the scan is not known yet.
        if inputs.verdict is None and inputs.signs.life is not None and inputs.signs.alive:
            return make_status("finishing")
        return _judge_result(inputs, all_safe)
    if ended.exit_status == "abort":
        key = "aborted" if ended.asked == "abort" else "stopped"
        return make_status(key, asker=ended.asker or "somebody", safe=safe, folder=folder)
    problem = f"{capitalise(ended.reason)}."
    do = capitalise(ended.remedy) or f"`polysight resume {quote(folder)}`"
    return make_status("failed", what=problem, safe=safe, why=capitalise(ended.why) or "See its terminal", do=do)


def cut_fraction(iso_time: str) -> str:
    """Return the time without fractions of a second; such texts can be compared."""
    return iso_time[:ISO_SECONDS_CHARACTERS]


def _judge_result(inputs: Inputs, all_safe: str) -> Status:
    """Return the status of a scan whose rows are all recorded."""
    if inputs.verdict is not None:
        return make_status(f"result_{inputs.verdict.level}", all_safe=all_safe)
    if inputs.signs.killed:
        do = f"`polysight process {quote(inputs.folder)} --out {quote(f'{inputs.folder}/products')}`"
        return make_status("unprocessed", what="Its program was killed while it computed materials.", why="", do=do)
    if inputs.failure is not None:
        return make_status_of_finding("unprocessed", inputs.failure)
    return make_status("finished", all_safe=all_safe)


def _judge_trouble(inputs: Inputs, history: ScanHistory) -> Status | None:
    """Return the status if a program or the Pi does not answer, or a request is pending; else None."""
    signs = inputs.signs
    folder = str(inputs.folder)
    safe = _describe_safe_rows(history)
    if _is_connecting(inputs, history):
        return make_status("resuming" if history.takes else "starting", safe=safe)
    if signs.killed or (not signs.alive and signs.life is None):
        return make_status("killed", safe=safe, folder=folder)
    if not signs.alive:
        return make_status_since("frozen", signs.alive_s, safe=safe, folder=folder)
    if signs.pi_silent_s is not None and signs.pi_silent_s > signs.pi_limit_s:
        return make_status_since("pi_silent", inputs.pi.heard_utc_s)
    return _judge_request(signs.life or SignOfLife(), history, folder)


def _is_connecting(inputs: Inputs, history: ScanHistory) -> bool:
    """True if the program that a page started does not accept commands yet, because it wrote no sign of life so far."""
    signs = inputs.signs
    program = inputs.program
    if program is None or program.kind != "scan" or not program.running:
        return False
    if signs.alive:
        has_begun_a_row = inputs.pi.row >= 0 or history.last_commit_s > history.run_started_s
        return signs.life is None and not has_begun_a_row
    # The signs of life are those of an earlier run until the manifest says that this one has begun.
    return parse_seconds(program.started_utc) > history.run_started_s


def _judge_request(life: SignOfLife, history: ScanHistory, folder: str) -> Status | None:
    """Return the status of a scan with a request to pause, stop or abort, from any sender; None without a request."""
    asker = life.asker or "somebody"
    if life.asked == "abort":
        return make_status("aborting", asker=asker)
    if life.asked == "stop":
        return make_status("stopping", asker=asker)
    if history.paused:
        return make_status("paused", asker=asker, safe=_describe_safe_rows(history), folder=folder)
    if life.asked == "pause":
        return make_status("pausing", asker=asker)
    return None


def _judge_rig(inputs: Inputs, history: ScanHistory) -> Status | None:
    """Return the status of a rig that has stopped, is held, homes, or has taken all rows; else None."""
    pi = inputs.pi
    all_rows_are_safe = len(history.takes) == history.plan.rows
    if pi.state == "fault" and pi.faults:
        return make_status_of_finding("rig_fault", pi.faults[-1])
    if pi.state == "fault":
        do = "On the Pi: `journalctl -u polysight-pi`"
        return make_status("rig_fault", what="It occurred before this view.", why="See the Pi's log", do=do)
    if pi.state == "held":
        return make_status("held")
    if all_rows_are_safe and pi.state == "homing":
        return make_status("homing_again")
    if all_rows_are_safe:
        return make_status("finishing")
    if pi.state == "homing":
        return make_status("homing")
    return None


def _judge_rows(inputs: Inputs, history: ScanHistory) -> Status | None:
    """Return the status if rows are retaken, late, or of poor quality; else None."""
    pi = inputs.pi
    newest_warning = next((notice for notice in reversed(history.notices) if notice.level == "warning"), None)
    if pi.row >= 0 and history.marks.get(pi.row) == "rejected":
        return make_status_of_finding("retake", newest_warning, row=pi.row, take=pi.take)
    late_since_s = _find_late_since_s(history, inputs.signs)
    if late_since_s:
        return make_status_since("late", late_since_s)
    if history.rows_since_trouble < RECENT_ROWS and newest_warning is not None:
        return make_status_of_finding("after_fault", newest_warning)
    poor = sync_notices(inputs.shown, history.plan.columns)
    if poor:
        return make_status_of_finding("poor", poor[0])
    return None


def _find_late_since_s(history: ScanHistory, signs: LifeSigns) -> float:
    """Return when the last row ended, if that is much longer ago than a row takes; otherwise 0.

    The duration of the first row alone is not used, because it is not a measure of the others.
    """
    if history.row_seconds is None:
        return 0.0
    row_s, basis = history.row_seconds
    since_s = max(history.last_commit_s, history.run_started_s)
    if basis == "first row" or signs.now_s - since_s < max(LATE_ROWS * row_s, LATE_S):
        return 0.0
    return since_s
