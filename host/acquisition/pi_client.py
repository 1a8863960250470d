"""The host's end of the sockets to the Pi: commands with time-out and retry, events without gaps, and the heartbeat.

`PiClient` sends commands and reads events; a gap in their sequence is filled from the Pi's journal. `HostHeartbeat`
tells the Pi that this process lives, from a thread and a socket of its own.
"""

from __future__ import annotations

import secrets
import threading
import time
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Any, TypeVar

import msgspec
import zmq

from polysight.host.capture import take_priority
from polysight.shared.config import Instrument
from polysight.shared.errors import DeviceError, ProtocolError, ScanError
from polysight.shared.faults import PiFault
from polysight.shared.messages import (
    JOURNALLED,
    Abort,
    Accepted,
    Alive,
    AnyCommand,
    AnyEvent,
    AnyReply,
    BeginRun,
    EndRun,
    ExitStatus,
    Heartbeat,
    Hello,
    HelloReply,
    Home,
    Pulse,
    Pulsed,
    Refused,
    Replay,
    ReplayReply,
    RowFinished,
    RowStarted,
    RunRow,
    State,
    Status,
    StatusReply,
    pack,
    unpack_event,
    unpack_reply,
)
from polysight.shared.sockets import HandshakeMonitor, requester, subscriber

ATTEMPTS = 3  # to ask a question
REAL_TIME = 1  # of the heartbeat: below the receiving processes
_SILENT_BEATS = 10  # more than the Pi waits before it takes a host for dead
_REPLY_LIMIT_S = 1.0  # then the question was lost, and another one is asked
AT_WORK: tuple[State, ...] = ("homing", "running", "held", "done")  # which change by themselves
_REST_LIMIT_S = 10.0
_LOOK_S = 0.05
_REPLAY_LIMIT = 1000  # events
R = TypeVar("R", bound=AnyReply)


class HostHeartbeat:
    """Says `Alive` from a thread and a socket of its own, so that it lives as long as this process, and no longer.

    Parameters
    ----------
    context, instrument
        Where the Pi is.
    scan_id
        The run that is begun.
    interval_s
        How often.
    owner
        As in `BeginRun`.
    """

    def __init__(
        self, context: zmq.Context[Any], instrument: Instrument, scan_id: str, interval_s: float, owner: str = ""
    ) -> None:
        self._socket = requester(context, instrument.pi.command_address, Path(instrument.pi.key_dir))
        self._alive, self._interval_s = pack(Alive(scan_id=scan_id, owner=owner)), interval_s
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._beat, name="heartbeat", daemon=True)
        self._thread.start()

    def _beat(self) -> None:
        take_priority(REAL_TIME)  # where that is not permitted, a busy machine may cost a row, which is taken again
        try:
            while not self._stop.wait(self._interval_s):
                with suppress(zmq.Again):  # nobody to send to: the Pi will notice
                    self._socket.send(self._alive)
                waited_s = 0.0
                while not self._stop.is_set() and waited_s < _REPLY_LIMIT_S:
                    if self._socket.poll(round(self._interval_s * 1e3)):
                        self._socket.recv()
                        break
                    waited_s += self._interval_s
        finally:
            self._socket.close()

    def stop(self) -> None:
        """No more."""
        self._stop.set()
        self._thread.join()


class RefusedError(ScanError):
    """The Pi did not take a command; `number` is of shared/faults.py."""

    def __init__(self, command: str, refusal: Refused) -> None:
        super().__init__(f"the Pi refused {command}: {refusal.what}", refusal.why, refusal.remedy)
        self.number = refusal.number


class PiClient:
    """Talks to one Pi. Used by one thread.

    Parameters
    ----------
    instrument
        Addresses, keys and limits.

    Raises
    ------
    ConfigError
        when an address needs keys that are not there.
    """

    def __init__(self, context: zmq.Context[Any], instrument: Instrument) -> None:
        self._context, self._instrument = context, instrument
        self._heartbeat: HostHeartbeat | None = None
        self._address = instrument.pi.command_address
        self._event_address = instrument.pi.event_address
        self._timeout_s = instrument.limits.command_timeout_s
        self._silence_s = max(10 * instrument.pi.heartbeat_ms / 1e3, instrument.limits.command_timeout_s)
        self._on_event: Callable[[AnyEvent], None] = _ignore
        keys = Path(instrument.pi.key_dir)
        self._events = subscriber(context, self._event_address, keys)
        self._commands = requester(context, self._address, keys)
        self._handshake = HandshakeMonitor(self._commands)
        self._owner = secrets.token_hex(16)  # of the runs that this client begins
        self._scan_id = ""
        self._last_seq = 0
        self._last_heard_s = time.monotonic()
        self._pending: deque[AnyEvent] = deque()
        self.gaps_filled = 0  # events that PUB lost and the journal returned
        self.state: State = "idle"  # of the last heartbeat

    @property
    def event_socket(self) -> zmq.Socket[bytes]:
        """The event socket, for a poller."""
        return self._events

    def follow(self, scan_id: str, last_seq: int, on_event: Callable[[AnyEvent], None]) -> None:
        """Follow the events of a scan: `on_event` takes each one after `last_seq` exactly once, in order."""
        self._scan_id, self._last_seq, self._on_event = scan_id, last_seq, on_event

    # --- commands ---

    def hello(self) -> HelloReply:
        """Who is there? Raises DeviceError when nobody answers, ProtocolError for another release."""
        return self._ask(Hello(), HelloReply)

    def status(self) -> StatusReply:
        """Everything the Pi knows about itself. Raises DeviceError."""
        return self._ask(Status(), StatusReply)

    def begin_run(self, run: BeginRun) -> None:
        """Begin a run, or take it up again; twice is once. Keeps the promise of `run.heartbeat_ms` until its end.

        A program of the same scan that was killed a moment ago counts as alive for some beats: that is waited for.

        Raises RefusedError, DeviceError.
        """
        run = msgspec.structs.replace(run, owner=self._owner)
        deadline = time.monotonic() + _SILENT_BEATS * run.heartbeat_ms / 1e3
        while True:
            try:
                self._ask(run, Accepted)
                break
            except RefusedError as e:
                its_own = e.number == PiFault.NOT_READY and self.status().scan_id == run.scan_id
                if not its_own or time.monotonic() > deadline:
                    raise
                time.sleep(_LOOK_S)
        self._fall_silent()
        if run.heartbeat_ms:
            interval_s = run.heartbeat_ms / 1e3
            self._heartbeat = HostHeartbeat(self._context, self._instrument, run.scan_id, interval_s, self._owner)

    def end_run(self, scan_id: str, exit_status: ExitStatus, reason: str) -> None:
        """End the run. Raises RefusedError, DeviceError."""
        self._ask(EndRun(scan_id=scan_id, exit_status=exit_status, reason=reason[:500], owner=self._owner), Accepted)
        self._fall_silent()

    def home(self) -> None:
        """Begin to home the stage. Raises RefusedError, DeviceError."""
        if self._once(Home(), self._timeout_s) is None and self.status().state not in ("homing", "ready"):
            self._ask(Home(), Accepted)

    def run_row(self, scan_id: str, row_index: int, take: int) -> None:
        """Begin a row. When the reply is lost, it is found out whether the row runs before asking again.

        Raises RefusedError, DeviceError.
        """
        command = RunRow(scan_id=scan_id, row_index=row_index, take=take, owner=self._owner)
        for _ in range(ATTEMPTS):
            reply = self._once(command, self._timeout_s / ATTEMPTS)
            if isinstance(reply, Accepted):
                self.state = reply.state  # the heartbeat heard last is older
                return
            status = self.status()
            if status.state in ("running", "held") and (status.row_index, status.take) == (row_index, take):
                return
            self._catch_up(status.last_seq)
            if any(_is_of(e, row_index, take) for e in self._pending):
                return
        raise self._silent("RunRow")

    def pulse(self, pulses: int, period_us: float, width_us: float) -> Pulsed:
        """One burst on SYNC_IN at rest. Sent once: a second one would be more frames than asked for.

        Raises RefusedError, DeviceError.
        """
        reply = self._once(Pulse(pulses=pulses, period_us=period_us, width_us=width_us), self._timeout_s)
        if not isinstance(reply, Pulsed):
            raise self._silent("Pulse")
        return reply

    def abort(self, reason: str) -> None:
        """Stop the row now; aborting twice does no harm. Raises RefusedError, DeviceError."""
        self._ask(Abort(reason=reason[:500], owner=self._owner), Accepted)

    def come_to_rest(self, reason: str) -> None:
        """Stop whatever moves, and wait until it stands: a run cannot end before. Raises RefusedError, DeviceError.

        What moves for another host's run is left alone.
        """
        if self.status().scan_id != self._scan_id:
            return
        self.abort(reason)
        deadline = time.monotonic() + _REST_LIMIT_S
        while self.status().state in AT_WORK and time.monotonic() < deadline:
            time.sleep(_LOOK_S)

    def _ask(self, command: AnyCommand, kind: type[R]) -> R:
        """A command that may be sent twice."""
        for _ in range(ATTEMPTS):
            reply = self._once(command, self._timeout_s / ATTEMPTS)
            if isinstance(reply, kind):
                return reply
            if reply is not None:
                raise ProtocolError(f"the Pi answered {type(command).__name__} with {type(reply).__name__}")
        raise self._silent(type(command).__name__)

    def _once(self, command: AnyCommand, limit_s: float) -> AnyReply | None:
        """Send once; the reply, or None after `limit_s`. A new request drops the old one (relaxed, correlated REQ)."""
        try:
            self._commands.send(pack(command))
        except zmq.Again:  # nobody to send to
            return None
        if not self._commands.poll(round(limit_s * 1e3)):
            return None
        reply = unpack_reply(self._commands.recv())
        self._last_heard_s = time.monotonic()
        if isinstance(reply, Refused):
            raise RefusedError(type(command).__name__, reply)
        return reply

    def _silent(self, command: str) -> DeviceError:
        if self._handshake.refused():
            return DeviceError(
                f"the Pi at {self._address} refuses this host's key",
                "the key was revoked or never allowed, or pi.key here is another Pi's",
                f"on the Pi: `polysight-pi keys --list`; here: the key files in {self._instrument.pi.key_dir}"
                " (docs/how-to/install.md)",
            )
        return DeviceError(
            f"the Pi at {self._address} did not answer {command} within {self._timeout_s:g} s ({ATTEMPTS} attempts)",
            "`polysight-pi run` is not running there, the address is wrong, or the CURVE keys do not match",
            "on the Pi: `systemctl status polysight-pi`, `journalctl -u polysight-pi -n 20`; here: check"
            " pi.command_address (a scan that was begun takes another one with `polysight resume SCAN --config"
            " instrument.toml`)",
        )

    # --- events ---

    def events(self) -> list[AnyEvent]:
        """Journalled events of the scan that have come, in order, without waiting; what PUB lost is asked for.

        Raises
        ------
        DeviceError
            when the Pi is silent on both sockets, or its journal lacks what was lost.
        """
        while self._events.poll(0):
            parts = self._events.recv_multipart()
            self._last_heard_s = time.monotonic()
            event = unpack_event(parts[-1])
            if isinstance(event, Heartbeat):
                self.state = event.state
            if event.scan_id != self._scan_id or not self._scan_id:
                continue
            if isinstance(event, JOURNALLED):
                if event.seq == self._last_seq + 1:
                    self._take(event)
                elif event.seq > self._last_seq:
                    self._catch_up(event.seq)
            elif event.seq > self._last_seq:
                self._catch_up(event.seq)
        if time.monotonic() - self._last_heard_s > self._silence_s:
            self._catch_up(self.status().last_seq)  # its heartbeats do not come: does it answer?
        out = list(self._pending)
        self._pending.clear()
        return out

    def _take(self, event: AnyEvent) -> None:
        self._last_seq = event.seq
        self._pending.append(event)
        self._on_event(event)

    def _catch_up(self, to_seq: int) -> None:
        """Fetch journalled events from the first one not seen up to `to_seq`."""
        while self._last_seq < to_seq:
            reply = self._ask(
                Replay(scan_id=self._scan_id, from_seq=self._last_seq + 1, limit=_REPLAY_LIMIT), ReplayReply
            )
            before = self._last_seq
            for event in reply.events:
                if event.seq == self._last_seq + 1:
                    self._take(event)
                    self.gaps_filled += 1
            if self._last_seq == before:
                raise DeviceError(
                    f"the Pi's journal of scan {self._scan_id} lacks event {before + 1} (it ends at {reply.last_seq})",
                    "the journal on the Pi was removed or damaged",
                    "start a new scan; the committed rows of this one stay valid",
                )

    def drain(self) -> None:
        """Take the events up to the newest one in the Pi's journal. Raises DeviceError."""
        self._catch_up(self.status().last_seq)

    def close(self) -> None:
        """Close the sockets."""
        self._fall_silent()
        self._events.close()
        self._handshake.close()
        self._commands.close()

    def _fall_silent(self) -> None:
        if self._heartbeat is not None:
            self._heartbeat.stop()
            self._heartbeat = None

    def __enter__(self) -> PiClient:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()


def _ignore(event: AnyEvent) -> None:
    del event


def _is_of(event: AnyEvent, row_index: int, take: int) -> bool:
    if isinstance(event, RowStarted):
        return event.row.index == row_index and event.take == take
    return isinstance(event, RowFinished) and (event.row_index, event.take) == (row_index, take)
