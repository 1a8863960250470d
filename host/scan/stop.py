"""Asking a scan to stop: once, after this row; twice, now. Or to wait before its next row."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType


class StopRequest:
    """Counts the requests to stop. Safe from any thread and from signal handlers."""

    def __init__(self) -> None:
        self._count = 0
        self.paused = False  # whether the next row is not to begin yet

    def request(self) -> None:
        """Ask once more."""
        self._count += 1

    @property
    def after_row(self) -> bool:
        """Whether to stop at the next row's end."""
        return self._count >= 1

    @property
    def now(self) -> bool:
        """Whether to stop at once."""
        return self._count >= 2


@contextmanager
def interrupts_request(stop: StopRequest) -> Iterator[None]:
    """Within the block, Ctrl-C asks `stop` once a time, and SIGTERM asks for an end at once.

    Outside the main thread signals cannot be caught, and nothing changes.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def ask(number: int, frame: FrameType | None) -> None:
        del frame
        stop.request()
        if number == signal.SIGTERM:
            stop.request()

    before = {number: signal.signal(number, ask) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@contextmanager
def hangups_pass() -> Iterator[None]:
    """Within the block, the end of the terminal (SIGHUP: a lost ssh connection) ends nothing; in the main thread."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGHUP, before)


@contextmanager
def interrupts_wait() -> Iterator[None]:
    """Within the block, Ctrl-C and SIGTERM are held back from this thread; they come at its end."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT, signal.SIGTERM})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
