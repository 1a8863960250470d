"""`polysight-pi run`: the two ZeroMQ sockets, and the service that creates all parts and closes them in a safe order.

Events go out on a PUB socket, commands come in on a ROUTER, which keeps each command's envelope, so that `Hello`,
`Status` and `Alive` are answered while the executor is busy or hangs. Only the server's thread uses the sockets; others
queue messages and wake it. Specification: docs/spec/wire.md.
"""

from __future__ import annotations

import math
import os
import queue
import signal
import sys
import time
import traceback
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Any

import msgspec
import zmq

from polysight_pi import system
from polysight_pi.executor import HUNG_S, Executor, make_refusal
from polysight_pi.journal import Journal, JournalFullError
from polysight_pi.keys import AllowedKeys
from polysight_pi.lines import open_lines
from polysight_pi.stage import StageDriver
from polysight_pi.trigger import TriggerLoop
from polysight_shared import messages as m
from polysight_shared.config import Instrument
from polysight_shared.error_codes import ErrorCode
from polysight_shared.errors import ConfigError, DeviceError, PolysightError, ProtocolError, VersionError
from polysight_shared.faults import PiFault
from polysight_shared.sockets import EVENT_TOPIC, authenticator, is_loopback, publisher, replier

LINGER_MS = 200
END_TIMEOUT_S = 0.8
TAKE_OVER_KEY = "take-over-key"  # file beside the journals with a key that every run accepts from a person at the Pi
Envelope = tuple[bytes, ...]


class Server:
    """Binds both sockets. Raises ConfigError or DeviceError if an address is wrong, in use, or has no keys."""

    def __init__(self, command_address: str, event_address: str, key_dir: Path, heartbeat_ms: int) -> None:
        self._heartbeat_ms = heartbeat_ms
        self._context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        self._allowed = AllowedKeys(key_dir)
        self._secret = not is_loopback(command_address)
        try:
            self._zap = authenticator(self._context)  # before the others are bound: it authenticates their connections
            self._commands = replier(self._context, command_address, key_dir)
            self._events = publisher(self._context, event_address, key_dir)
        except PolysightError:
            self._context.destroy(linger=0)
            raise
        self.command_address = self._commands.getsockopt_string(zmq.LAST_ENDPOINT)
        self.event_address = self._events.getsockopt_string(zmq.LAST_ENDPOINT)
        self.ports = {int(address.rpartition(":")[2]) for address in (self.command_address, self.event_address)}
        self._wake = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)
        self._out: queue.SimpleQueue[tuple[Envelope, bytes]] = queue.SimpleQueue()
        self._stop = False

    def publish(self, events: list[bytes]) -> None:
        """Queue packed events, in order. From any thread; returns at once."""
        self._queue(*(((), raw) for raw in events))

    def _queue(self, *messages: tuple[Envelope, bytes]) -> None:
        for message in messages:
            self._out.put(message)
        os.eventfd_write(self._wake, 1)

    def stop(self) -> None:
        """End :meth:`run`. From any thread or a signal handler."""
        self._stop = True
        os.eventfd_write(self._wake, 1)

    def run(self, executor: Executor) -> None:
        """Serve until :meth:`stop` or a crash of the executor."""
        poller = zmq.Poller()
        poller.register(self._wake, zmq.POLLIN)
        poller.register(self._commands, zmq.POLLIN)
        poller.register(self._zap, zmq.POLLIN)
        next_beat = time.monotonic()
        while not self._stop and executor.crash is None:
            now = time.monotonic()
            if now >= next_beat:
                self._beat(executor)
                next_beat = max(next_beat + self._heartbeat_ms / 1e3, now)
            ready = dict(poller.poll(max(0, math.ceil((next_beat - now) * 1e3))))
            if self._wake in ready:
                os.eventfd_read(self._wake)
                self.drain()
            if self._zap in ready:
                self._authenticate()
            if self._commands in ready:
                self._receive(executor)

    def drain(self) -> None:
        """Send the queued messages. In the thread of :meth:`run`, or after its end."""
        while True:
            try:
                envelope, raw = self._out.get_nowait()
            except queue.Empty:
                return
            if envelope:
                self._reply(envelope, raw)
            else:
                self._events.send_multipart([EVENT_TOPIC, raw])

    def _authenticate(self) -> None:
        """Answer an authentication request of ZeroMQ (ZAP, RFC 27): a client with an allowed public key may connect.

        In this thread: pyzmq's own authenticator is a second one with asyncio, whose death nobody notices, and which
        waits for ever when it is closed then.
        """
        version, number, _, _, _, mechanism, *credentials = self._zap.recv_multipart()
        key = b""
        if mechanism == b"CURVE" and credentials:
            key = bytes(credentials[0])
        code = b"400"
        text = b"this key is not allowed"
        if self._allowed.client_name(key):
            code = b"200"
            text = b"OK"
        self._zap.send_multipart([version, number, code, text, key.hex().encode(), b""])

    def _receive(self, executor: Executor) -> None:
        """Answer one command: its envelope (routing frames up to the empty one) and one frame of content."""
        frames = self._commands.recv_multipart(copy=False)
        parts = [f.bytes for f in frames]
        if b"" not in parts[1:-1]:
            return  # no REQ framing: no client waits for a reply
        end = parts.index(b"", 1) + 1
        envelope = tuple(parts[:end])
        if self._secret and not self._allowed.client_name(bytes.fromhex(str(frames[-1].get("User-Id")))):
            reply = make_refusal(PiFault.NOT_OWNER, "this client's key was revoked", "see `polysight-pi keys --list`")
        else:
            reply = self._answer(b"".join(parts[end:]), envelope, executor)
        if reply is not None:
            self._reply(envelope, m.pack(reply))

    def _reply(self, envelope: Envelope, raw: bytes) -> None:
        try:
            self._commands.send_multipart([*envelope, raw], zmq.NOBLOCK)
        except zmq.ZMQError:
            return  # the client is gone or does not read; it will retry

    def close(self) -> None:
        """Close the sockets after a moment for messages already sent."""
        self._context.destroy(linger=LINGER_MS)
        os.close(self._wake)

    def _answer(self, raw: bytes, envelope: Envelope, executor: Executor) -> m.AnyReply | None:
        """Return the reply to a command, or None if the executor replies later. No message can end the program."""
        try:
            command = m.unpack_command(raw)
        except ProtocolError as e:
            number = PiFault.VERSION if isinstance(e, VersionError) else PiFault.BAD_REQUEST
            return make_refusal(number, e.what, e.why, e.remedy)
        except Exception as e:  # noqa: BLE001 - reported to the client and in the log
            traceback.print_exc()
            return make_refusal(
                PiFault.BAD_REQUEST, f"a command of {len(raw)} bytes cannot be read: {type(e).__name__}"
            )
        if executor.unresponsive_s > HUNG_S:
            return make_refusal(PiFault.PROGRAM, f"the executor has hung for {executor.unresponsive_s:.0f} s")
        if isinstance(command, m.Hello):
            return msgspec.structs.replace(executor.hello, t_unix_ns=time.time_ns())
        if isinstance(command, m.Status):
            return executor.status
        if isinstance(command, m.Alive):
            return executor.host_alive(command.scan_id, command.owner)
        if executor.submit(command, lambda reply: self._queue((envelope, m.pack(reply)))):
            return None
        return make_refusal(PiFault.NOT_READY, "too many commands are waiting", "", "wait for replies")

    def _beat(self, executor: Executor) -> None:
        """Publish a heartbeat, unless the executor hangs."""
        if executor.unresponsive_s > HUNG_S:
            return
        # Events up to status.last_seq are in the queue by now; sending them first keeps a heartbeat from announcing an
        # event that was not sent.
        status = executor.status
        self.drain()
        beat = m.Heartbeat(
            scan_id=status.scan_id, seq=status.last_seq, t_mono_ns=time.monotonic_ns(), state=status.state,
            period_ms=self._heartbeat_ms,
        )  # fmt: skip
        self._events.send_multipart([EVENT_TOPIC, m.pack(beat)])


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
        pi = instrument.pi
        folder = Path(pi.journal_dir)
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
