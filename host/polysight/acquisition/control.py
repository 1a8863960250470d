"""Pause, continue and stop a running scan: by signals and by files in `<scan>/control/`.

Ctrl-C and SIGTERM set a `StopRequest`, which any thread may read. Other programs send a `ScanCommand` by creating an
empty file with the command's name in `<scan>/control/`; `touch SCAN/control/pause` in a shell does the same. The scan
creates that folder when it begins, removes each command file and then obeys it, touches `alive` once a second, and
removes the folder at its end. File names are atomic, so there is nothing to parse. Specification:
docs/spec/scan-folder.md.
"""

from __future__ import annotations

import signal
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from enum import StrEnum
from pathlib import Path
from types import FrameType

from polysight_shared.error_codes import ErrorCode
from polysight_shared.errors import ScanError

CONTROL = "control"
ALIVE = "alive"
_POLL_S = 0.2
_ALIVE_INTERVAL_S = 1.0
_TIMEOUT_S = 5.0  # for a scan to accept a command


class StopRequest:
    """Counts requests to stop; safe in any thread and in signal handlers."""

    def __init__(self) -> None:
        self._count = 0
        self.paused = False  # the next row must not begin yet

    def request(self) -> None:
        """Request to stop: the first time after the current row, the second time now."""
        self._count += 1

    @property
    def after_row(self) -> bool:
        """True if the scan must stop at the end of the current row."""
        return self._count >= 1

    @property
    def now(self) -> bool:
        """True if the scan must stop immediately."""
        return self._count >= 2


def _in_main_thread() -> bool:
    return threading.current_thread() is threading.main_thread()


@contextmanager
def stop_on_interrupt(stop: StopRequest) -> Iterator[None]:
    """Turn Ctrl-C into one stop request and SIGTERM into two; no effect outside the main thread."""

    def handle(number: int, frame: FrameType | None) -> None:
        del frame
        stop.request()
        if number == signal.SIGTERM:
            stop.request()

    numbers = (signal.SIGINT, signal.SIGTERM) if _in_main_thread() else ()
    before = {number: signal.signal(number, handle) for number in numbers}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@contextmanager
def ignore_hangup() -> Iterator[None]:
    """Ignore SIGHUP, as from a lost ssh connection; no effect outside the main thread."""
    if not _in_main_thread():
        yield
        return
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGHUP, before)


@contextmanager
def delay_interrupts() -> Iterator[None]:
    """Block SIGINT and SIGTERM in this thread until the block ends."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT, signal.SIGTERM})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


class ScanCommand(StrEnum):
    """Commands for a running scan; the values are the names of their files."""

    PAUSE = "pause"  # after the current row, until `continue`
    CONTINUE = "continue"
    STOP = "stop"  # after the current row
    ABORT = "abort"  # now


class ControlFolder:
    """Serve `<folder>/control` for a scan of this program and pass commands to `stop`.

    Runs in a thread of its own, so that a slow disk does not stop the scan.
    """

    def __init__(self, folder: Path, stop: StopRequest) -> None:
        self._folder, self._stop = folder / CONTROL, stop
        self._closed = threading.Event()
        self._thread: threading.Thread | None = None

    def open(self) -> None:
        """Start to serve, once; the caller must hold the scan's lock. Earlier command files are deleted."""
        if self._thread is None:
            self._thread = threading.Thread(target=self._serve, name="control", daemon=True)
            self._thread.start()

    def _serve(self) -> None:
        next_alive, cleared = 0.0, False
        while not self._closed.wait(_POLL_S):
            with suppress(OSError):  # a full disk must not end the scan
                if not cleared:
                    self._folder.mkdir(exist_ok=True)
                    self._clear()
                    cleared = True
                if time.monotonic() >= next_alive:
                    (self._folder / ALIVE).touch()
                    next_alive = time.monotonic() + _ALIVE_INTERVAL_S
                for command in ScanCommand:
                    self._obey(command)
        with suppress(OSError):
            self._clear()
            self._folder.rmdir()

    def _obey(self, command: ScanCommand) -> None:
        """Obey a command if its file exists. The file is removed first, or it would be obeyed again and again."""
        path = self._folder / command
        if not path.exists():
            return
        path.unlink()
        if command in (ScanCommand.PAUSE, ScanCommand.CONTINUE):
            self._stop.paused = command is ScanCommand.PAUSE
        elif command is ScanCommand.ABORT:
            self._stop.request()
            self._stop.request()
        elif not self._stop.after_row:  # a second `stop` (double click) must not abort the row
            self._stop.request()

    def _clear(self) -> None:
        for name in (*ScanCommand, ALIVE):
            (self._folder / name).unlink(missing_ok=True)

    def close(self) -> None:
        """Stop serving and remove the folder."""
        self._closed.set()
        if self._thread is not None:
            self._thread.join(_TIMEOUT_S)

    def __enter__(self) -> ControlFolder:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def send_command(folder: Path, command: ScanCommand, limit_s: float = _TIMEOUT_S) -> None:
    """Send a command to the scan that runs in `folder`; return when it has been accepted.

    Raises ScanError if no scan runs there, or it does not accept the command in time; the command is then withdrawn.
    """
    path = folder / CONTROL / command
    try:
        path.touch()
    except OSError as e:
        raise ScanError(
            f"{folder}: no running scan takes `{command}`: {e.strerror}",
            "no scan runs in this folder, or you may not write to it",
            f"if its program was killed, resume the scan with `polysight resume {folder}`",
            code=ErrorCode.NO_ANSWER,
        ) from None
    deadline = time.monotonic() + limit_s
    while path.exists():
        if time.monotonic() > deadline:
            with suppress(FileNotFoundError):
                path.unlink()
                raise ScanError(
                    f"{folder}: the scan did not accept `{command}` within {limit_s:g} s; the command is withdrawn",
                    "its program was killed, or hangs",
                    "press Ctrl-C in its terminal; the emergency stop stops the stage",
                    code=ErrorCode.NO_ANSWER,
                )
        time.sleep(_POLL_S / 4)


def last_alive_s(folder: Path) -> float | None:
    """Return when the scan program last touched `alive` (file system's clock, seconds); None if it never did."""
    try:
        return (folder / CONTROL / ALIVE).stat().st_mtime
    except OSError:
        return None
