"""The Pi's two ZeroMQ sockets, served by one thread: events (PUB), commands and replies (ROUTER).

Only this thread uses the sockets; others queue messages and wake it. A ROUTER keeps each command's envelope, so
`Hello`, `Status` and `Alive` are answered while the executor is busy or hangs. Specification: docs/spec/wire.md.
"""

from __future__ import annotations

import math
import os
import queue
import time
import traceback
from pathlib import Path

import msgspec
import zmq

from polysight_pi.executor import HUNG_S, Executor, refused
from polysight_pi.keys import AllowedKeys
from polysight_shared import messages as m
from polysight_shared.errors import PolysightError, ProtocolError, VersionError
from polysight_shared.faults import PiFault
from polysight_shared.sockets import EVENT_TOPIC, authenticator, is_loopback, publisher, replier

LINGER_MS = 200
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
        self.ports = {int(a.rpartition(":")[2]) for a in (self.command_address, self.event_address)}
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
        """Answer an authentication request of ZeroMQ (ZAP, RFC 27): a client with an allowed public key may connect."""
        version, number, _, _, _, mechanism, *credentials = self._zap.recv_multipart()
        key = bytes(credentials[0]) if mechanism == b"CURVE" and credentials else b""
        name = self._allowed.name_of(key) if key else ""
        code, text = (b"200", b"OK") if name else (b"400", b"this key is not allowed")
        self._zap.send_multipart([version, number, code, text, key.hex().encode(), b""])

    def _receive(self, executor: Executor) -> None:
        """Answer one command: its envelope (routing frames up to the empty one) and one frame of content."""
        frames = self._commands.recv_multipart(copy=False)
        parts = [f.bytes for f in frames]
        if b"" not in parts[1:-1]:
            return  # no REQ framing: no client waits for a reply
        end = parts.index(b"", 1) + 1
        envelope = tuple(parts[:end])
        if self._secret and not self._allowed.name_of(bytes.fromhex(str(frames[-1].get("User-Id")))):
            reply = refused(PiFault.NOT_OWNER, "this client's key was revoked", "see `polysight-pi keys --list`")
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
            return refused(number, e.what, e.why, e.remedy)
        except Exception as e:  # noqa: BLE001 - reported to the client and in the log
            traceback.print_exc()
            return refused(PiFault.BAD_REQUEST, f"a command of {len(raw)} bytes cannot be read: {type(e).__name__}")
        if executor.unresponsive_s > HUNG_S:
            return refused(PiFault.PROGRAM, f"the executor has hung for {executor.unresponsive_s:.0f} s")
        if isinstance(command, m.Hello):
            return msgspec.structs.replace(executor.hello, t_unix_ns=time.time_ns())
        if isinstance(command, m.Status):
            return executor.status
        if isinstance(command, m.Alive):
            return executor.host_alive(command.scan_id, command.owner)
        if executor.submit(command, lambda reply: self._queue((envelope, m.pack(reply)))):
            return None
        return refused(PiFault.NOT_READY, "too many commands are waiting", "", "wait for replies")

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
