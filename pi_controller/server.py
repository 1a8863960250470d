"""The Pi's two ZeroMQ sockets: events out (PUB), commands in and replies out (REP), in one thread.

Only this thread touches the sockets; others hand over bytes and wake it. One command is outstanding at a time, as REP
wants it. Specification: docs/spec/wire.md.
"""

from __future__ import annotations

import math
import os
import queue
import time
from pathlib import Path
from typing import Protocol

import zmq

from polysight.pi_controller.executor import Request, Snapshot
from polysight.shared import __version__
from polysight.shared import messages as m
from polysight.shared.errors import PolysightError, ProtocolError, VersionError
from polysight.shared.faults import PiFault, explain
from polysight.shared.sockets import EVENT_TOPIC, publisher, replier

LINGER_MS = 200


class Answerer(Protocol):
    """What the server needs of the executor."""

    snapshot: Snapshot
    crash: BaseException | None

    def post(self, item: Request, /) -> None:
        """Take a command; its reply comes by the request's `answer`."""
        ...

    def host_alive(self, scan_id: str, /) -> m.Accepted | m.Refused:
        """Take a sign of life."""
        ...


class Server:
    """Binds both sockets.

    Parameters
    ----------
    command_address, event_address
        `tcp://host:port`; the port may be `*`.
    key_dir
        CURVE keys, for addresses that are not loopback.
    heartbeat_ms
        Interval of heartbeat events.
    backend
        Name of the trigger lines, told in HelloReply.

    Raises
    ------
    ConfigError, DeviceError
        when an address is wrong, in use, or has no keys.
    """

    def __init__(
        self, command_address: str, event_address: str, key_dir: Path, heartbeat_ms: int, backend: str
    ) -> None:
        self._heartbeat_ms, self._backend = heartbeat_ms, backend
        self._context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        try:
            self._commands = replier(self._context, command_address, key_dir)
            self._events = publisher(self._context, event_address, key_dir)
        except PolysightError:
            self._context.destroy(linger=0)
            raise
        self.command_address = self._commands.getsockopt_string(zmq.LAST_ENDPOINT)
        self.event_address = self._events.getsockopt_string(zmq.LAST_ENDPOINT)
        self._wake = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)
        self._out: queue.SimpleQueue[tuple[str, bytes]] = queue.SimpleQueue()
        self._stop = False

    def publish(self, events: list[bytes]) -> None:
        """Send packed events, in order. From any thread; returns at once."""
        for raw in events:
            self._out.put(("event", raw))
        os.eventfd_write(self._wake, 1)

    def stop(self) -> None:
        """End :meth:`run`. From any thread, or a signal handler."""
        self._stop = True
        os.eventfd_write(self._wake, 1)

    def run(self, executor: Answerer) -> None:
        """Serve until :meth:`stop`, or until the executor has crashed."""
        poller = zmq.Poller()
        poller.register(self._wake, zmq.POLLIN)
        poller.register(self._commands, zmq.POLLIN)
        next_beat = time.monotonic()
        while not self._stop and executor.crash is None:
            now = time.monotonic()
            if now >= next_beat:
                self._beat(executor.snapshot)
                next_beat = max(next_beat + self._heartbeat_ms / 1e3, now)
            ready = dict(poller.poll(max(0, math.ceil((next_beat - now) * 1e3))))
            if self._wake in ready:
                os.eventfd_read(self._wake)
                self._drain()
            if self._commands in ready:
                self._take(b"".join(self._commands.recv_multipart()), executor)

    def drain(self) -> None:
        """Send what was handed over. For the end, after :meth:`run`."""
        self._drain()

    def close(self) -> None:
        """Close the sockets, giving sent messages a moment to leave."""
        self._context.destroy(linger=LINGER_MS)
        os.close(self._wake)

    def _drain(self) -> None:
        while True:
            try:
                kind, raw = self._out.get_nowait()
            except queue.Empty:
                return
            if kind == "event":
                self._events.send_multipart([EVENT_TOPIC, raw])
            else:
                self._commands.send(raw)

    def _take(self, raw: bytes, executor: Answerer) -> None:
        try:
            command = m.unpack_command(raw)
        except ProtocolError as e:
            number = int(PiFault.VERSION if isinstance(e, VersionError) else PiFault.BAD_REQUEST)
            table = explain(number)
            refused = m.Refused(number=number, what=e.what, why=e.why or table.why, remedy=e.remedy or table.remedy)
            self._commands.send(m.pack(refused))
            return
        snapshot = executor.snapshot
        if isinstance(command, m.Hello):
            self._commands.send(m.pack(self._hello(snapshot)))
        elif isinstance(command, m.Status):
            self._commands.send(m.pack(snapshot.status))
        elif isinstance(command, m.Alive):
            self._commands.send(m.pack(executor.host_alive(command.scan_id)))
        else:
            executor.post(Request(command, self._answer))

    def _answer(self, reply: m.AnyReply) -> None:
        self._out.put(("reply", m.pack(reply)))
        os.eventfd_write(self._wake, 1)

    def _hello(self, snapshot: Snapshot) -> m.HelloReply:
        status = snapshot.status
        return m.HelloReply(
            pi_release=__version__,
            firmware=snapshot.firmware,
            backend=self._backend,
            state=status.state,
            scan_id=status.scan_id,
            last_seq=status.last_seq,
            t_unix_ns=time.time_ns(),
            in_run=snapshot.in_run,
            stage=snapshot.placing,
        )

    def _beat(self, snapshot: Snapshot) -> None:
        # Everything up to the snapshot's number has been handed over before the snapshot was taken, so draining first
        # keeps a heartbeat from announcing an event that has not been sent.
        self._drain()
        beat = m.Heartbeat(
            scan_id=snapshot.status.scan_id,
            seq=snapshot.status.last_seq,
            t_mono_ns=time.monotonic_ns(),
            state=snapshot.status.state,
            period_ms=self._heartbeat_ms,
        )
        self._events.send_multipart([EVENT_TOPIC, m.pack(beat)])
