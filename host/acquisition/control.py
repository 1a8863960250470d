"""Asking a running scan to stop, pause or go on: by signals, and by files in `<scan>/control/`.

Ctrl-C and SIGTERM become a `StopRequest`, which any thread can look at. From outside the terminal a scan is asked by an
empty file named for the wish. The scan makes that folder when it begins, obeys what it finds there by removing it,
touches `alive` once a second, and removes the folder at its end. A file's name is written whole or not at all, so there
is nothing to parse and nothing can be torn; `touch SCAN/control/pause` in a shell does the same. Specification:
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
from types import FrameType, TracebackType

from polysight.shared.errors import ScanError

CONTROL = "control"
ALIVE = "alive"
_LOOK_S = 0.2
_BEAT_S = 1.0
_TAKEN_LIMIT_S = 5.0


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


class Wish(StrEnum):
    """What can be asked of a running scan."""

    PAUSE = "pause"  # after the running row, until `continue`
    CONTINUE = "continue"
    STOP = "stop"  # end after the running row
    ABORT = "abort"  # end now


class ControlDesk:
    """Takes wishes for a scan that this program runs, from a thread of its own: a slow disk must not stop the scan.

    Parameters
    ----------
    folder
        The scan folder.
    stop
        What hears of the wishes.
    """

    def __init__(self, folder: Path, stop: StopRequest) -> None:
        self._folder, self._stop = folder / CONTROL, stop
        self._closed = threading.Event()
        self._thread: threading.Thread | None = None

    def open(self) -> None:
        """Begin to listen; only who holds the scan's lock may. Again is nothing. What was asked before is forgotten."""
        if self._thread is None:
            self._thread = threading.Thread(target=self._serve, name="control", daemon=True)
            self._thread.start()

    def _serve(self) -> None:
        beat_at, cleared = 0.0, False
        while not self._closed.wait(_LOOK_S):
            with suppress(OSError):  # a full disk costs the wishes, never the scan
                if not cleared:
                    self._folder.mkdir(exist_ok=True)
                    self._clear()
                    cleared = True
                if time.monotonic() >= beat_at:
                    (self._folder / ALIVE).touch()
                    beat_at = time.monotonic() + _BEAT_S
                for wish in Wish:
                    self._take(wish)
        with suppress(OSError):
            self._clear()
            self._folder.rmdir()

    def _take(self, wish: Wish) -> None:
        """Obey a wish that is there. It is removed first: what cannot be removed would be obeyed for ever."""
        path = self._folder / wish
        if not path.exists():
            return
        path.unlink()
        if wish in (Wish.PAUSE, Wish.CONTINUE):
            self._stop.paused = wish is Wish.PAUSE
        elif wish is Wish.ABORT:
            self._stop.request()
            self._stop.request()
        elif not self._stop.after_row:  # asked twice is still after the row: a double click must not cut it
            self._stop.request()

    def _clear(self) -> None:
        for name in (*Wish, ALIVE):
            (self._folder / name).unlink(missing_ok=True)

    def close(self) -> None:
        """Listen no more."""
        self._closed.set()
        if self._thread is not None:
            self._thread.join(_TAKEN_LIMIT_S)

    def __enter__(self) -> ControlDesk:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()


def ask(folder: Path, wish: Wish, limit_s: float = _TAKEN_LIMIT_S) -> None:
    """Ask the scan that runs in `folder`; returns when it has heard.

    Raises
    ------
    ScanError
        when no scan program listens there, or it does not take the wish in time; then the wish is withdrawn.
    """
    path = folder / CONTROL / wish
    try:
        path.touch()
    except OSError as e:
        raise ScanError(
            f"{folder}: nobody can be asked to {wish}: {e.strerror}",
            "no scan runs in this folder, or you may not write to it",
            f"a scan that was killed goes on with `polysight resume {folder}`",
        ) from None
    deadline = time.monotonic() + limit_s
    while path.exists():
        if time.monotonic() > deadline:
            with suppress(FileNotFoundError):
                path.unlink()
                raise ScanError(
                    f"{folder}: the scan did not hear {wish!s} within {limit_s:g} s, and will not obey it any more",
                    "its program was killed, or hangs",
                    "press Ctrl-C in its terminal; the emergency stop stops the stage",
                )
        time.sleep(_LOOK_S / 4)


def last_sign_of_life(folder: Path) -> float | None:
    """When the scan program said last that it lives (seconds, the file system's clock); None when it never did."""
    try:
        return (folder / CONTROL / ALIVE).stat().st_mtime
    except OSError:
        return None
