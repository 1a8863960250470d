"""Pause, continue and stop a running scan: by signals and by files in `<scan>/control/`.

Ctrl-C and SIGTERM set a `StopRequest`, which any thread may read. Other programs send a `ScanCommand` by creating an
empty file with the command's name in `<scan>/control/`; `touch SCAN/control/pause` in a shell does the same. The scan
creates that folder when it begins, renames each command file, obeys and removes it, writes `alive` once a second, and
removes the folder at its end. A command file may hold who sent it. `alive` says which process scans, what it does and
what it was asked (`read_life`), so that page, list and terminal distinguish a killed scan from one that runs.
Specification: docs/spec/scan-folder.md.
"""

from __future__ import annotations

import os
import signal
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from enum import StrEnum
from pathlib import Path
from types import FrameType
from typing import Literal

import msgspec

from polysight_shared.closing import Closing
from polysight_shared.errors import ErrorCode, ScanError, quote

# Names of the folder in a scan folder, and of the file with the sign of life.
CONTROL_FOLDER = "control"
ALIVE_FILE = "alive"
# Time between two looks of a scan for command files (chosen).
_POLL_S = 0.2
# Time between two looks of a command's sender for its acceptance: it waits little longer than the scan takes.
_ACCEPTANCE_POLL_S = _POLL_S / 4
# A sign of life that is unchanged is written again after this time, far below LAPSE_S.
_ALIVE_INTERVAL_S = 1.0
# Time in which a scan accepts a command; chosen.
_TIMEOUT_S = 5.0
LAPSE_S = 15.0
"""After this time without a sign of life a scan's program hangs, or its machine has failed; chosen."""
# Length of a command sender's name in characters; the rest of a longer one is cut off.
MAX_ASKER = 60
Doing = Literal["rows", "materials"]


class StopRequest:
    """Counts requests to stop; safe in any thread and in signal handlers.

    Attributes
    ----------
    paused
        True if the next row must not begin yet.
    asker
        Who sent the last request or command.
    """

    def __init__(self) -> None:
        self._count = 0
        self.paused = False
        self.asker = ""

    def request(self, asker: str = "a program") -> None:
        """Request to stop: the first time after the current row, the second time now."""
        self.asker = asker
        self._count += 1

    @property
    def pending(self) -> str:
        """The strongest command that holds now: `abort`, `stop`, `pause`, or "" for none.

        It stays after the scan has obeyed it.
        """
        if self.now:
            return ScanCommand.ABORT
        if self.after_row:
            return ScanCommand.STOP
        if self.paused:
            return ScanCommand.PAUSE
        return ""

    @property
    def after_row(self) -> bool:
        """True if the scan must stop at the end of the current row."""
        return self._count >= 1

    @property
    def now(self) -> bool:
        """True if the scan must stop immediately."""
        return self._count >= 2


def _is_main_thread() -> bool:
    return threading.current_thread() is threading.main_thread()


@contextmanager
def stop_on_interrupt(stop: StopRequest) -> Iterator[None]:
    """Turn Ctrl-C into one stop request and SIGTERM into two; no effect outside the main thread."""

    def handle(number: int, frame: FrameType | None) -> None:
        del frame
        if number == signal.SIGTERM:
            stop.request("SIGTERM")
            stop.request("SIGTERM")
        else:
            stop.request("Ctrl-C")

    numbers = ()
    if _is_main_thread():
        numbers = (signal.SIGINT, signal.SIGTERM)
    old_handlers = {number: signal.signal(number, handle) for number in numbers}
    try:
        yield
    finally:
        for number, handler in old_handlers.items():
            signal.signal(number, handler)


@contextmanager
def ignore_hangup() -> Iterator[None]:
    """Ignore SIGHUP, as from a lost ssh connection; no effect outside the main thread."""
    if not _is_main_thread():
        yield
        return
    old_handler = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGHUP, old_handler)


class ScanCommand(StrEnum):
    """Commands for a running scan; the values are the names of their files."""

    # Wait after the current row, until `continue`.
    PAUSE = "pause"
    CONTINUE = "continue"
    # End the scan after the current row.
    STOP = "stop"
    # End the scan now, in the middle of a row.
    ABORT = "abort"


class SignOfLife(msgspec.Struct, frozen=True):
    """Content of `alive`: the scan's process, its start time in `ticks` (:func:`read_start_ticks`), its machine `host`.

    It is `doing` "rows" as long as rows are taken, "materials" while they are searched for after the last row. `asked`
    is the pending command of `asker`, "" for none. The reader sets `written_s` (since 1970) from the file.
    """

    pid: int = 0
    ticks: int = 0
    host: str = ""
    doing: Doing = "rows"
    asked: str = ""
    asker: str = ""
    written_s: float = 0.0

    @property
    def is_here(self) -> bool:
        """True if the process is or was one of this machine."""
        return self.pid > 0 and self.host == socket.gethostname()

    @property
    def killed(self) -> bool:
        """True if the process ran on this machine and no longer exists: a scan that ends by itself removes the file."""
        return self.is_here and read_start_ticks(self.pid) != self.ticks


def read_start_ticks(pid: int) -> int | None:
    """Return the start time of a running process in clock ticks since boot, or None if it has ended.

    It distinguishes a process from a later one with the same number.
    """
    try:
        text = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8", errors="replace")
    except OSError:
        return None
    # Fields of proc(5) after the name: the state ("Z": ended, but not yet reaped), and as the 20th the start time.
    fields = text.rpartition(")")[2].split()
    if fields[0] == "Z":
        return None
    return int(fields[19])


class ControlFolder(Closing):
    """Serve `<folder>/control` for a scan of this program and pass commands to `stop`.

    Runs in a thread of its own, so that a slow disk does not stop the scan.
    """

    def __init__(self, folder: Path, stop: StopRequest) -> None:
        self._folder = folder / CONTROL_FOLDER
        self._stop = stop
        self._doing: Doing = "rows"
        self._closed = threading.Event()
        self._thread: threading.Thread | None = None

    def open(self) -> None:
        """Start to serve, once; the caller must hold the scan's lock. Earlier command files are deleted."""
        if self._thread is None:
            self._thread = threading.Thread(target=self._serve, name="control", daemon=True)
            self._thread.start()

    def end_rows(self) -> None:
        """Accept no more commands: the rows have ended, and only materials are still computed."""
        self._doing = "materials"

    def _serve(self) -> None:
        """Obey requests and write `alive`, until the folder is closed."""
        written_life: SignOfLife | None = None
        next_alive_s = 0.0
        cleared = False
        ticks = read_start_ticks(os.getpid()) or 0
        while not self._closed.wait(_POLL_S):
            # A full disk must not end the scan.
            with suppress(OSError):
                if not cleared:
                    self._folder.mkdir(exist_ok=True)
                    self._clear()
                    cleared = True
                if self._doing == "rows":
                    for command in ScanCommand:
                        self._obey_command(command)
                pending = self._stop.pending
                asker = ""
                if pending:
                    asker = self._stop.asker
                life = SignOfLife(os.getpid(), ticks, socket.gethostname(), self._doing, pending, asker)
                if life != written_life or time.monotonic() >= next_alive_s:
                    self._write(life)
                    written_life = life
                    next_alive_s = time.monotonic() + _ALIVE_INTERVAL_S
        with suppress(OSError):
            self._clear()
            self._folder.rmdir()

    def _write(self, life: SignOfLife) -> None:
        """Write `alive`, so that a reader sees the old content or the new one."""
        # The file is not forced to the disk: after a power loss it is not needed.
        part = self._folder / f".{ALIVE_FILE}.part"
        try:
            part.write_bytes(msgspec.json.encode(life))
            part.replace(self._folder / ALIVE_FILE)
        except OSError:
            # The disk is full: the old content with a new time is a sign of life, too.
            (self._folder / ALIVE_FILE).touch()

    def _obey_command(self, command: ScanCommand) -> None:
        """Obey a command if its file exists.

        The file is renamed first: its sender can no longer withdraw it, and waits. A file that cannot be renamed is not
        obeyed, because it would be obeyed again and again.
        """
        path = self._folder / command
        if not path.exists():
            return
        asker = _read_asker(path)
        accepted = path.replace(_accepted_path(path))
        if command in (ScanCommand.PAUSE, ScanCommand.CONTINUE):
            self._stop.paused = command is ScanCommand.PAUSE
            self._stop.asker = asker
        elif command is ScanCommand.ABORT:
            self._stop.request(asker)
            self._stop.request(asker)
        # A second `stop` (double click) must not abort the row.
        elif not self._stop.after_row:
            self._stop.request(asker)
        accepted.unlink()

    def _clear(self) -> None:
        """Delete every file of the folder."""
        for path in self._folder.iterdir():
            path.unlink(missing_ok=True)

    def close(self) -> None:
        """Stop serving and remove the folder."""
        self._closed.set()
        if self._thread is not None:
            self._thread.join(_TIMEOUT_S)


def _accepted_path(path: Path) -> Path:
    """Return the path that a command's file has while the command is executed."""
    return path.with_name(f".{path.name}.accepted")


def _read_asker(path: Path) -> str:
    """Return the sender of a command: the text of its file, which a shell's `touch` leaves empty."""
    with path.open("rb") as f:
        text = f.read(4 * MAX_ASKER).decode("utf-8", errors="replace")
    printable = "".join(character for character in text if character.isprintable())
    return printable.strip()[:MAX_ASKER] or "a file in control/"


def send_command(folder: Path, command: ScanCommand, asker: str = "a program", limit_s: float = _TIMEOUT_S) -> None:
    """Send a command to the scan that runs in `folder`, in the name of `asker`; return when it has been obeyed.

    Raises ScanError if no scan runs there, or it does not accept the command in time; the command is then withdrawn.
    """
    path = folder / CONTROL_FOLDER / command
    life = read_life(folder)
    if life is not None and life.killed:
        raise ScanError(
            f"{folder}: no running scan accepts `{command}`", "its program was killed",
            f"`polysight resume {quote(folder)}`; the stage has stopped automatically", code=ErrorCode.NO_ANSWER,
        )  # fmt: skip
    if life is not None and life.doing == "materials":
        raise ScanError(
            f"{folder}: no running scan accepts `{command}`", "all its rows are recorded, and materials are being "
            "computed",
            "wait; nothing moves now", code=ErrorCode.NO_ANSWER,
        )  # fmt: skip
    try:
        _write_command(path, asker)
    except OSError as e:
        raise ScanError(
            f"{folder}: no running scan accepts `{command}`: {e.strerror}",
            "no scan runs in this folder, it was moved or renamed, or you may not write to it",
            f"if its program was killed, resume the scan with `polysight resume {quote(folder)}`",
            code=ErrorCode.NO_ANSWER,
        ) from None
    deadline = time.monotonic() + limit_s
    while path.exists() or _accepted_path(path).exists():
        if time.monotonic() > deadline:
            try:
                path.unlink()
            except FileNotFoundError:
                # The command was accepted at the last moment.
                return
            raise ScanError(
                f"{folder}: the scan did not accept `{command}` within {limit_s:g} s; the command is withdrawn",
                "its program was killed, or hangs",
                "press Ctrl-C in its terminal; the emergency stop stops the stage",
                code=ErrorCode.NO_ANSWER,
            )
        time.sleep(_ACCEPTANCE_POLL_S)


def _write_command(path: Path, asker: str) -> None:
    """Create a command's file, complete from the beginning; on a full disk it is empty, and still a command."""
    part = path.with_name(f".{path.name}.part")
    with part.open("wb", buffering=0) as f, suppress(OSError):
        f.write(asker.encode())
    part.replace(path)


def read_life(folder: Path) -> SignOfLife | None:
    """Return the scan program's last sign of life, with the file system's time of it; None if there is none.

    A file that another program or an earlier release touched is a sign of life without content.
    """
    path = folder / CONTROL_FOLDER / ALIVE_FILE
    try:
        with path.open("rb") as f:
            content = f.read(4096)
            written_s = os.fstat(f.fileno()).st_mtime
    except OSError:
        return None
    try:
        life = msgspec.json.decode(content, type=SignOfLife)
    except (msgspec.MsgspecError, UnicodeDecodeError):
        life = SignOfLife()
    return msgspec.structs.replace(life, written_s=written_s)
