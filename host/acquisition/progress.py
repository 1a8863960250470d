"""How a scan proceeds: rows on their way through processing, progress and time left, and the result at its end.

`ProcessingQueue` hands committed rows to processing, in order, from one worker thread. Capture goes first: the
receivers are processes of their own with real-time priority or a negative nice value, and this thread has a nice value
of its own above the program's (`NICE`), so that even where the system grants the receivers nothing the kernel prefers
them by three to one.
"""

from __future__ import annotations

import statistics
import threading
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait
from contextlib import suppress
from dataclasses import dataclass, field
from os import PRIO_PROCESS, getpriority, setpriority

from polysight.host.store import ScanFolder
from polysight.shared.messages import ExitStatus

OnRow = Callable[[int], None]
NICE = 5
_RECENT_ROWS = 25  # enough for a steady median, few enough to follow a rig that was sped up


class ProcessingQueue:
    """Calls `on_row` with each committed row; without it, rows are only counted as done.

    Parameters
    ----------
    on_row
        Processes one row. What it raises is kept; it stops neither the scan nor the rows after it.
    limit
        Rows of this run that may wait before the next one is not begun.
    """

    def __init__(self, on_row: OnRow | None, limit: int) -> None:
        self._on_row, self._limit = on_row, limit
        self._worker = ThreadPoolExecutor(1, thread_name_prefix="rows", initializer=_yield_to_capture)
        self._all: list[Future[None]] = []
        self._own: list[Future[None]] = []

    def add_earlier(self, rows: Iterable[int]) -> None:
        """Rows that were committed before this run: nothing waits for them."""
        for row in rows:
            self._submit(row)

    def add(self, row: int) -> None:
        """A row was committed."""
        future = self._submit(row)
        if future is not None:
            self._own.append(future)

    def _submit(self, row: int) -> Future[None] | None:
        if self._on_row is None:
            return None
        self._all.append(self._worker.submit(self._on_row, row))
        return self._all[-1]

    @property
    def behind(self) -> int:
        """Rows of this run that are not processed, when they are more than the limit; else 0."""
        self._own = [f for f in self._own if not f.done()]
        return len(self._own) if len(self._own) > self._limit else 0

    @property
    def left(self) -> int:
        """Rows that are not processed, of this run and of earlier ones."""
        return sum(not f.done() for f in self._all)

    def wait(self, timeout_s: float) -> None:
        """Until the oldest row is processed, at most so long."""
        wait(self._own[:1], timeout_s)

    def close(self, now: bool) -> BaseException | None:
        """Process what waits, or with `now` only end the row in hand; the first error that processing raised."""
        self._worker.shutdown(wait=True, cancel_futures=now)
        return next((f.exception() for f in self._all if not f.cancelled() and f.exception() is not None), None)


def _yield_to_capture() -> None:
    """Give the worker thread a lower priority than the rest of this program, and so than capture."""
    thread = threading.get_native_id()
    with suppress(OSError):
        setpriority(PRIO_PROCESS, thread, getpriority(PRIO_PROCESS, thread) + NICE)


@dataclass(frozen=True)
class ScanProgress:
    """Where a scan is.

    `phase`: check, connect, home, row, state, held, wait, committed, retake, warning, stop or end. `message` is for
    people, `state` the row's (docs/spec/row.md).
    """

    phase: str
    message: str
    rows: int
    committed: int
    row: int = -1
    take: int = 0
    points: int = 0
    row_points: int = 0
    remaining_s: float | None = None
    state: str = ""


@dataclass
class ScanResult:
    """How a scan ended; `processing_error` is the first error `on_row` raised, after all data is safe."""

    folder: ScanFolder
    exit_status: ExitStatus
    reason: str
    retakes: int = 0
    incomplete_rows: list[int] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)
    processing_error: BaseException | None = None


OnProgress = Callable[[ScanProgress], None]


def usual_row_s(row_seconds: Sequence[float]) -> float:
    """How long a row takes: the median of the last 25, so that a retake or a wait among them does not count.

    Parameters
    ----------
    row_seconds
        [n >= 1] from the end of one row to the end of the next, pauses left out.
    """
    return statistics.median(row_seconds[-_RECENT_ROWS:])


def time_left(rows_left: int, row_s: float, elapsed_s: float = 0.0) -> float:
    """Seconds to the end of a scan.

    Parameters
    ----------
    rows_left
        Rows that are not committed.
    row_s
        How long a row takes.
    elapsed_s
        Since the last row ended, pauses left out; a row that is overdue counts as one that ends now.
    """
    return max(0.0, rows_left * row_s - min(max(elapsed_s, 0.0), row_s))
