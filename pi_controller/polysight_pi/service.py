"""`polysight-pi run`: creates lines, stage, executor and sockets, and closes them in a safe order."""

from __future__ import annotations

import os
import signal
import sys
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Any

from polysight_pi import system
from polysight_pi.executor import Executor
from polysight_pi.journal import Journal, JournalFullError
from polysight_pi.lines import open_lines
from polysight_pi.server import Server
from polysight_pi.stage import StageDriver
from polysight_pi.trigger import TriggerLoop
from polysight_shared.config import Instrument
from polysight_shared.error_codes import ErrorCode
from polysight_shared.errors import ConfigError, DeviceError

END_TIMEOUT_S = 0.8
TAKE_OVER_KEY = "take-over-key"  # file beside the journals with a key that every run accepts from a person at the Pi


def log(text: str) -> None:
    """Write one line to the log (stderr)."""
    sys.stderr.write(f"polysight-pi: {text}\n")
    sys.stderr.flush()


class Service:
    """The whole Pi half, on GPIO or on simulated wires.

    Raises ConfigError or DeviceError if an address, a line, the journal or the stage is not available; everything
    opened before is closed.
    """

    def __init__(self, instrument: Instrument, wires: Path | None = None) -> None:
        pi, folder = instrument.pi, Path(instrument.pi.journal_dir)
        with ExitStack() as opened:
            journal = Journal(folder, lambda events: self.server.publish(events), log)
            opened.callback(_close, journal)
            # Rights that the thread lacks were reported already for the process.
            prepare = system.prepare_thread if wires is None else lambda: None
            self._loop = TriggerLoop(open_lines(instrument, wires), self._post, prepare)
            opened.callback(self._loop.stop)
            self.server = Server(pi.command_address, pi.event_address, Path(pi.key_dir), pi.heartbeat_ms)
            opened.callback(self.server.close)
            stage = StageDriver(instrument.stage, self._post)
            opened.callback(stage.close)
            self.executor = Executor(stage, self._loop, journal, partial(system.notify_systemd, "WATCHDOG=1"))
            _write_secret(folder / TAKE_OVER_KEY, self.executor.take_over_key)
            stage.connect()
            self._opened = opened.pop_all()

    def _post(self, item: Any) -> None:
        self.executor.post(item)

    def serve(self) -> None:
        """Serve until :meth:`stop`, then stop the stage and end the row. Raises DeviceError after an internal error."""
        self._loop.start()
        self.executor.start()
        memory = system.MemoryWatch(self.server.ports, log)
        memory.start()
        self.server.run(self.executor)
        memory.stop()
        self.executor.stop(END_TIMEOUT_S)
        self.server.drain()
        if self.executor.crash is not None:
            what = f"the executor failed: {self.executor.crash!r}"
            raise DeviceError(what, "an internal error", "report it with its trace")

    def stop(self) -> None:
        """End :meth:`serve`. From any thread, or a signal handler."""
        self.server.stop()

    def close(self) -> None:
        """Set outputs low, then close everything."""
        self._loop.stop()
        self._opened.close()


def _close(journal: Journal) -> None:
    try:
        journal.close()
    except JournalFullError as e:
        log(str(e))


def _write_secret(path: Path, secret: str) -> None:
    """Write a file that only this program's user can read. Raises ConfigError."""
    try:
        path.unlink(missing_ok=True)
        with os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600), "w") as file:
            file.write(secret)
    except OSError as e:
        why = "the disk is full or read-only"
        raise ConfigError(f"{path}: {e.strerror}", why, "free space there", code=ErrorCode.DISK_FULL) from None


def run(instrument: Instrument, wires: Path | None) -> int:
    """Serve until SIGTERM or SIGINT. Prints `ready <command address>` on stdout once it does.

    Raises ConfigError or DeviceError if it cannot start.
    """
    if wires is not None:
        system.die_with_parent(signal.SIGTERM)
    else:
        for sentence in system.prepare_process():
            log(sentence)
    service = Service(instrument, wires)
    try:
        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, lambda *_: service.stop())
        sys.stdout.write(f"ready {service.server.command_address}\nevents {service.server.event_address}\n")
        sys.stdout.flush()
        system.notify_systemd("READY=1")
        service.serve()
    finally:
        service.close()
    return 0
