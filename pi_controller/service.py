"""`polysight-pi run`: puts lines, stage, executor and sockets together, and takes them apart in a safe order."""

from __future__ import annotations

import signal
import sys
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from polysight.pi_controller import realtime
from polysight.pi_controller.bursts import Lines
from polysight.pi_controller.executor import Executor
from polysight.pi_controller.journal import TAKE_OVER_KEY, JournalFolder, JournalFullError
from polysight.pi_controller.ledger import Ledger
from polysight.pi_controller.lines import open_lines
from polysight.pi_controller.memory import MemoryWatch
from polysight.pi_controller.server import Server
from polysight.pi_controller.stage import StageDriver
from polysight.pi_controller.stage_link import StageNews
from polysight.pi_controller.trigger import BurstSent, LoopFault, TriggerLoop
from polysight.shared.config import Instrument
from polysight.shared.errors import DeviceError
from polysight.shared.messages import Pulsed

END_LIMIT_S = 0.8


@dataclass(frozen=True)
class Options:
    """What the command line adds to the rig file, or replaces in it."""

    wires: Path | None = None
    stage_port: str | None = None
    journal: Path | None = None
    command_address: str | None = None
    event_address: str | None = None


def log(text: str) -> None:
    """One line to the log (stderr)."""
    sys.stderr.write(f"polysight-pi: {text}\n")
    sys.stderr.flush()


class Service:
    """The Pi half as a whole; `lines` are used instead of opening those of the rig.

    Raises
    ------
    ConfigError, DeviceError
        when an address, a line, the journal or the stage cannot be had. What was opened before is closed again.
    """

    def __init__(self, instrument: Instrument, options: Options, lines: Lines | None = None) -> None:
        pi, simulated = instrument.pi, options.wires is not None
        with ExitStack() as opened:
            folder = JournalFolder(options.journal or Path(pi.journal_dir))
            opened.callback(folder.close)
            lines = lines or open_lines(instrument, options.wires)
            # What is not permitted to its thread was not permitted to the process, which has said so.
            prepare = (lambda: None) if simulated else realtime.prepare_thread
            self._loop = TriggerLoop(lines, self._post, prepare)
            opened.callback(self._loop.stop)
            addresses = options.command_address or pi.command_address, options.event_address or pi.event_address
            self.server = Server(*addresses, Path(pi.key_dir), pi.heartbeat_ms, lines.name)
            opened.callback(self.server.close)
            self._ledger = Ledger(folder, self.server.publish, log)
            opened.callback(self._close_ledger)
            stage = StageDriver(instrument.stage, options.stage_port or instrument.stage.port, self._post)
            opened.callback(stage.close)
            turned = partial(realtime.notify_systemd, "WATCHDOG=1")
            self.executor = Executor(stage, self._loop, self._ledger, turned)
            folder.write_secret(TAKE_OVER_KEY, self.executor.take_over_key)
            stage.connect()
            self._opened = opened.pop_all()

    def _post(self, item: StageNews | BurstSent | Pulsed | LoopFault) -> None:
        self.executor.post(item)

    def _close_ledger(self) -> None:
        try:
            self._ledger.close()
        except JournalFullError as e:
            log(str(e))

    def serve(self) -> None:
        """Serve until :meth:`stop`; then stop the stage and end the row. Raises DeviceError when a part failed."""
        self._loop.start()
        self.executor.start()
        memory = MemoryWatch(self.server.ports, log)
        memory.start()
        self.server.run(self.executor)
        memory.stop()
        self.executor.stop(END_LIMIT_S)
        self.server.drain()
        if self.executor.crash is not None:
            raise DeviceError(
                f"the executor failed: {self.executor.crash!r}", "a fault of this program", "report it with its trace"
            )

    def stop(self) -> None:
        """End :meth:`serve`. From any thread, or a signal handler."""
        self.server.stop()

    def close(self) -> None:
        """Outputs low first, then everything is closed."""
        self._loop.stop()
        self._opened.close()


def run(instrument: Instrument, options: Options) -> int:
    """Serve until SIGTERM or SIGINT. Prints `ready <command address>` on stdout when it serves.

    Raises ConfigError or DeviceError when it cannot start.
    """
    if options.wires is not None:
        realtime.die_with_parent(signal.SIGTERM)
    else:
        for sentence in realtime.prepare_process():
            log(sentence)
    service = Service(instrument, options)
    try:
        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, lambda *_: service.stop())
        sys.stdout.write(f"ready {service.server.command_address}\nevents {service.server.event_address}\n")
        sys.stdout.flush()
        realtime.notify_systemd("READY=1")
        service.serve()
    finally:
        service.close()
    return 0
