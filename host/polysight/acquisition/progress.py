"""Progress and result of a scan, and the queue of rows for processing.

`ProcessingQueue` passes committed rows to processing, in order, in one worker thread. Capture has priority: receivers
are processes with real-time priority or a negative nice value, and the nice value of the worker thread is `NICE` above
that of the program, so that the kernel prefers the receivers by three to one even if the system grants no priority.
"""

from __future__ import annotations

import statistics
import threading
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait
from contextlib import suppress
from dataclasses import dataclass, field
from os import PRIO_PROCESS, getpriority, setpriority

from polysight.store import ScanFolder
from polysight_shared.messages import ExitStatus

# Called with the index of a committed row.
OnRow = Callable[[int], None]
# Added to the nice value of the program (chosen): the receivers get three times as much processor time.
NICE = 5
# Rows of the typical duration. Chosen: enough for a steady median, few enough to follow a faster rig.
_RECENT_ROWS = 25


class ProcessingQueue:
    """Calls `on_row` with each committed row, if there is one; `limit` rows of this run may wait.

    An exception of `on_row` is kept for `close`; it stops neither the scan nor later rows.
    """

    def __init__(self, on_row: OnRow | None, limit: int) -> None:
        self._on_row = on_row
        self._limit = limit
        self._worker = ThreadPoolExecutor(1, thread_name_prefix="rows", initializer=_yield_to_capture)
        # Every row that was queued, and the unprocessed rows of this run.
        self._futures: list[Future[None]] = []
        self._of_this_run: list[Future[None]] = []

    def add_earlier(self, rows: Iterable[int]) -> None:
        """Queue rows that were committed before this run; the scan does not wait for them."""
        if self._on_row is not None:
            self._futures += [self._worker.submit(self._on_row, row) for row in rows]

    def add(self, row: int) -> None:
        """Queue a row that was just committed."""
        self.add_earlier([row])
        self._of_this_run += self._futures[-1:]

    @property
    def over_limit(self) -> int:
        """Number of unprocessed rows of this run if it is above the limit, otherwise 0."""
        self._of_this_run = [f for f in self._of_this_run if not f.done()]
        if len(self._of_this_run) <= self._limit:
            return 0
        return len(self._of_this_run)

    @property
    def rows_left(self) -> int:
        """Number of unprocessed rows, of this run and of earlier ones."""
        return sum(not f.done() for f in self._futures)

    def wait(self, timeout_s: float) -> None:
        """Wait until the oldest row of this run is processed, or for the timeout."""
        wait(self._of_this_run[:1], timeout_s)

    def close(self, now: bool) -> BaseException | None:
        """Process the queued rows (with `now` only the current one); return the first error of processing, or None."""
        self._worker.shutdown(wait=True, cancel_futures=now)
        return next((f.exception() for f in self._futures if not f.cancelled() and f.exception() is not None), None)


def _yield_to_capture() -> None:
    """Lower the priority of the worker thread below the rest of this program, and so below capture."""
    thread = threading.get_native_id()
    with suppress(OSError):
        setpriority(PRIO_PROCESS, thread, getpriority(PRIO_PROCESS, thread) + NICE)


@dataclass(frozen=True)
class ScanProgress:
    """Progress of a scan.

    `phase` is check, connect, home, row, state, held (the stage, by a command), wait (for processing, disk or stage, or
    paused), committed, retake, warning, stop or end; `message` is for people; `state` is the row's (docs/spec/row.md).
    """

    phase: str
    message: str
    # Rows of the scan, and how many of them are committed.
    rows: int
    committed: int
    # Index of the current row, and the number of this attempt to record it; -1 and 0 before the first.
    row: int = -1
    take: int = 0
    # Points of the take so far, of `row_points`.
    points: int = 0
    row_points: int = 0
    # None while unknown.
    remaining_s: float | None = None
    state: str = ""


@dataclass
class ScanResult:
    """Result of a scan: how it ended, and the number of `retakes` (rows recorded again because of faults).

    `incomplete_rows` were committed with faults. `processing_error` is the first error of `on_row` and does not affect
    the recorded data.
    """

    folder: ScanFolder
    exit_status: ExitStatus
    reason: str
    retakes: int = 0
    incomplete_rows: list[int] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)
    processing_error: BaseException | None = None


OnProgress = Callable[[ScanProgress], None]


def typical_row_s(row_seconds: Sequence[float]) -> float:
    """Return the typical duration of a row: the median of the last 25, so that a retake or a wait has no effect.

    `row_seconds` [n >= 1] are from the end of one row to the end of the next, pauses left out.
    """
    return statistics.median(row_seconds[-_RECENT_ROWS:])


def time_left(rows_left: int, row_s: float, elapsed_s: float = 0.0) -> float:
    """Return the seconds to the end of a scan with `rows_left` uncommitted rows of `row_s` seconds each.

    `elapsed_s` is the time since the last row ended, without pauses; an overdue row counts as ending now.
    """
    return max(0.0, rows_left * row_s - min(max(elapsed_s, 0.0), row_s))
