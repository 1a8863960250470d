"""Committed rows on their way through processing, in order, beside the scan and behind capture.

One worker thread. Capture goes first: the receivers are processes of their own with real-time priority or a negative
nice value, and this thread has a nice value of its own above the program's (`NICE`), so that even where the system
grants the receivers nothing the kernel prefers them by three to one.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable
from concurrent.futures import Future, ThreadPoolExecutor, wait
from contextlib import suppress
from os import PRIO_PROCESS, getpriority, setpriority

OnRow = Callable[[int], None]
NICE = 5


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
