"""`polysight-pi run`: the two ZeroMQ sockets, and the service that creates all parts and closes them in a safe order.

Events go out on a PUB socket, commands come in on a ROUTER, which keeps each command's envelope, so that `Hello`,
`Status` and `Alive` are answered while the executor is busy. Each socket has a thread that alone uses it, and an I/O
thread of libzmq; others queue messages. Specification: docs/spec/wire.md.
"""

from __future__ import annotations

import os
import queue
import signal
import sys
import threading
import time
import traceback
from contextlib import ExitStack, suppress
from functools import partial
from pathlib import Path
from typing import Any

import zmq

from polysight_pi import system
from polysight_pi.executor import HUNG_S, LATE_S, Executor, make_refusal
from polysight_pi.journal import Journal, JournalFullError, JournalThread
from polysight_pi.keys import AllowedKeys
from polysight_pi.lines import open_lines
from polysight_pi.stage import StageDriver
from polysight_pi.trigger import TriggerLoop
from polysight_shared import messages as m
from polysight_shared.config import Instrument
from polysight_shared.errors import ConfigError, DeviceError, ErrorCode, PolysightError, ProtocolError, VersionError
from polysight_shared.faults import PiFault
from polysight_shared.program import die_with_parent
from polysight_shared.sockets import (
    EVENT_TOPIC,
    create_authenticator,
    create_publisher,
    create_replier,
    is_loopback,
    make_server_context,
)

# Time for which closed sockets still send (chosen).
LINGER_MS = 200
# Longest time of a turn of a socket's thread that has nothing to do; chosen.
POLL_MS = 250
# Each part gets this long to end; a thread that hangs is left alone then. Chosen: all together end within the 5 s of
# TimeoutStopSec in polysight-pi.service.
END_TIMEOUT_S = 0.8
# File in the journals' folder with a key that every run accepts from a person at the Pi.
TAKE_OVER_KEY = "take-over-key"
# Frames of a message before its content: the route to the client, and an empty frame.
Envelope = tuple[bytes, ...]


class Server:
    """The two sockets and their threads. `heartbeat_ms`: period of the Pi's heartbeat.

    Raises ConfigError or DeviceError if an address is wrong, in use, or has no keys.
    """

    def __init__(self, command_address: str, event_address: str, key_dir: Path, heartbeat_ms: int) -> None:
        self._heartbeat_ms = heartbeat_ms
        self._context = make_server_context()
        self._allowed = AllowedKeys(key_dir)
        # True if clients need a key, and are checked again at each command.
        self._secret = not is_loopback(command_address)
        try:
            # Bound before the others, whose connections it authenticates.
            self._zap = create_authenticator(self._context)
            self._commands = create_replier(self._context, command_address, key_dir)
            self._events = create_publisher(self._context, event_address, key_dir)
        except PolysightError:
            self._context.destroy(linger=0)
            raise
        self.command_address = self._commands.getsockopt_string(zmq.LAST_ENDPOINT)
        self.event_address = self._events.getsockopt_string(zmq.LAST_ENDPOINT)
        self.ports = {int(address.rpartition(":")[2]) for address in (self.command_address, self.event_address)}
        # Written by other threads, wakes the command socket's thread.
        self._wake = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)
        # Replies of the executor, to be sent by the command socket's thread.
        self._replies: queue.SimpleQueue[tuple[Envelope, bytes]] = queue.SimpleQueue()
        # Events to be published; None ends the event socket's thread.
        self._unsent: queue.SimpleQueue[bytes | None] = queue.SimpleQueue()
        self._publisher: threading.Thread | None = None
        # When the thread of each socket last completed a turn.
        self._turned_s: dict[str, float] = {}
        self._stop = False

    def publish(self, events: list[bytes]) -> None:
        """Queue packed events, in order. From any thread; returns immediately."""
        for raw in events:
            self._unsent.put(raw)

    def find_late(self, limit_s: float) -> str:
        """Name a socket that has not been served for longer than this; "" if there is none. From any thread."""
        now = time.monotonic()
        for name, turned_s in list(self._turned_s.items()):
            if now - turned_s > limit_s:
                return f"the {name} socket has not been served for {now - turned_s:.1f} s"
        return ""

    def stop(self) -> None:
        """End :meth:`run`. From any thread or a signal handler."""
        self._stop = True
        os.eventfd_write(self._wake, 1)

    def run(self, executor: Executor) -> None:
        """Answer commands until :meth:`stop` or a crash of the executor. Events are sent until :meth:`finish`."""
        self._publisher = threading.Thread(target=self._send_events, args=(executor,), name="events", daemon=True)
        self._publisher.start()
        poller = zmq.Poller()
        for source in (self._wake, self._commands, self._zap):
            poller.register(source, zmq.POLLIN)
        while not self._stop and executor.crash is None:
            self._turned_s["command"] = time.monotonic()
            ready = dict(poller.poll(POLL_MS))
            if self._wake in ready:
                os.eventfd_read(self._wake)
            self._send_replies()
            if self._zap in ready:
                self._authenticate()
            if self._commands in ready:
                self._receive(executor)
        self._turned_s.clear()

    def _send_events(self, executor: Executor) -> None:
        """Send queued events and heartbeats.

        In a thread of its own: when subscribers with many topics leave, libzmq cleans up inside a send, for up to
        minutes (300 with ten topics of 1 kB each: 18 s). Manual mode (XPUB_MANUAL) takes as long.
        """
        next_beat = time.monotonic()
        while True:
            # Like the other socket's thread, this one waits no longer than POLL_MS: with rare heartbeats it would count
            # as late otherwise.
            wait_s = min(POLL_MS / 1e3, max(0.0, next_beat - time.monotonic()))
            try:
                raw = self._unsent.get(timeout=wait_s)
                if raw is None:
                    return
                self._events.send_multipart([EVENT_TOPIC, raw])
            except queue.Empty:
                if time.monotonic() >= next_beat and self._publish_heartbeat(executor):
                    next_beat = max(next_beat + self._heartbeat_ms / 1e3, time.monotonic())
            if not self._stop:
                self._turned_s["event"] = time.monotonic()

    def _send_replies(self) -> None:
        with suppress(queue.Empty):
            while True:
                self._reply(*self._replies.get_nowait())

    def finish(self) -> None:
        """Send what is queued. After the end of :meth:`run`."""
        self._send_replies()
        self._unsent.put(None)
        if self._publisher is not None:
            self._publisher.join(END_TIMEOUT_S)

    def _authenticate(self) -> None:
        """Answer an authentication request of ZeroMQ (ZAP, RFC 27): a client with an allowed public key may connect.

        In this thread: pyzmq's own authenticator is a second one with asyncio, whose end is not noticed, and which
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
        """Receive one command, its envelope and one frame of content, and answer it or pass it to the executor."""
        frames = self._commands.recv_multipart(copy=False)
        parts = [f.bytes for f in frames]
        if b"" not in parts[1:-1]:
            # Without the framing of a REQ socket no client waits for a reply.
            return
        end = parts.index(b"", 1) + 1
        envelope = tuple(parts[:end])
        # "User-Id" is the key in hexadecimal digits, as `_authenticate` answered.
        if self._secret and not self._allowed.client_name(bytes.fromhex(str(frames[-1].get("User-Id")))):
            reply = make_refusal(PiFault.NOT_OWNER, "this client's key was revoked", "see `polysight-pi keys --list`")
        else:
            reply = self._answer(b"".join(parts[end:]), envelope, executor)
        if reply is not None:
            self._reply(envelope, m.pack(reply))

    def _reply(self, envelope: Envelope, raw: bytes) -> None:
        """Send an encoded reply to the client that `envelope` names, if it takes it immediately."""
        try:
            self._commands.send_multipart([*envelope, raw], zmq.NOBLOCK)
        except zmq.ZMQError:
            # The client is disconnected, or does not read and will retry.
            return

    def close(self) -> None:
        """Close the sockets after a moment for messages already sent; leave a thread that hangs inside one alone."""
        self._unsent.put(None)
        if self._publisher is not None:
            self._publisher.join(END_TIMEOUT_S)
        if self._publisher is None or not self._publisher.is_alive():
            self._context.destroy(linger=LINGER_MS)
            os.close(self._wake)

    def _queue_reply(self, envelope: Envelope, reply: m.AnyReply) -> None:
        self._replies.put((envelope, m.pack(reply)))
        os.eventfd_write(self._wake, 1)

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
            return executor.hello
        if isinstance(command, m.Status):
            return executor.status
        if isinstance(command, m.Alive):
            return executor.host_alive(command.scan_id, command.owner)
        if executor.submit(command, partial(self._queue_reply, envelope)):
            return None
        return make_refusal(PiFault.NOT_READY, "too many commands are waiting", "", "wait for replies")

    def _publish_heartbeat(self, executor: Executor) -> bool:
        """Publish a heartbeat, unless the executor hangs. Return False if an event up to its number is not sent yet."""
        status = executor.status
        if not self._unsent.empty():
            return False
        if executor.unresponsive_s > HUNG_S:
            return True
        beat = m.Heartbeat(
            scan_id=status.scan_id, seq=status.last_seq, t_mono_ns=time.monotonic_ns(), state=status.state,
            period_ms=self._heartbeat_ms,
        )  # fmt: skip
        self._events.send_multipart([EVENT_TOPIC, m.pack(beat)])
        return True


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
            self._journal = JournalThread(journal)
            opened.callback(self._close_journal)
            # Rights that the thread lacks were reported already for the process.
            prepare = system.prepare_thread if wires is None else lambda: None
            self._loop = TriggerLoop(open_lines(instrument, wires), self._post, prepare)
            opened.callback(self._loop.stop)
            self.server = Server(pi.command_address, pi.event_address, Path(pi.key_dir), pi.heartbeat_ms)
            opened.callback(self.server.close)
            stage = StageDriver(
                instrument.stage,
                self._post,
                caller_late_s=lambda: self.executor.unresponsive_s,
                bound_now_ns=self._loop.bound_now_ns,
            )
            opened.callback(stage.close)
            feed = partial(system.notify_systemd, "WATCHDOG=1")
            self.executor = Executor(stage, self._loop, self._journal, feed, self._find_late)
            _write_secret(folder / TAKE_OVER_KEY, self.executor.take_over_key)
            stage.connect()
            self._opened = opened.pop_all()

    def _post(self, item: Any) -> None:
        self.executor.post(item)

    def _find_late(self) -> str:
        """Name a part of the program that has not answered for LATE_S; "" if there is none."""
        late_s = self._journal.late_s
        if late_s > LATE_S:
            return f"the journal has not answered for {late_s:.1f} s"
        return self.server.find_late(LATE_S)

    def serve(self) -> None:
        """Serve until :meth:`stop`, then stop the stage and end the row. Raises DeviceError after an internal error."""
        self._loop.start()
        self.executor.start()
        memory = system.MemoryWatch(self.server.ports, log)
        memory.start()
        self.server.run(self.executor)
        memory.stop()
        self.executor.stop(END_TIMEOUT_S)
        self._close_journal()
        self.server.finish()
        if self.executor.crash is not None:
            summary = f"the executor failed: {self.executor.crash!r}"
            raise DeviceError(summary, "an internal error", "report it with its trace")

    def stop(self) -> None:
        """End :meth:`serve`. From any thread, or a signal handler."""
        self.server.stop()

    def close(self) -> None:
        """Set outputs low, then close everything."""
        self._loop.stop()
        self._opened.close()

    def _close_journal(self) -> None:
        """Write what waits and close the journal; log it if the disk is full."""
        try:
            self._journal.stop(END_TIMEOUT_S)
        except JournalFullError as e:
            log(str(e))


def _write_secret(path: Path, secret: str) -> None:
    """Write a file that only this program's user can read. Raises ConfigError."""
    try:
        path.unlink(missing_ok=True)
        with os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600), "w") as file:
            file.write(secret)
    except OSError as e:
        cause = "the disk is full or read-only"
        raise ConfigError(f"{path}: {e.strerror}", cause, "free space there", code=ErrorCode.DISK_FULL) from None


def run(instrument: Instrument, wires: Path | None) -> int:
    """Serve until SIGTERM or SIGINT, with simulated lines if `wires` is the socket of a hub. Return 0.

    Prints `ready <command address>` and `events <event address>` on stdout once it serves. Raises ConfigError or
    DeviceError if it cannot start.
    """
    if wires is not None:
        die_with_parent()
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
