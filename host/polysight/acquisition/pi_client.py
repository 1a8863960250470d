"""Client for the Pi: commands with timeout and retry, events without gaps, and the host's heartbeat.

`PiClient` sends commands and reads events; lost events are fetched from the Pi's journal. `HostHeartbeat` sends
`Alive` from its own thread and socket. A *run* is what the Pi calls a scan, a *take* one attempt to record a row;
*journalled* events are those that the Pi keeps and numbers (`seq`). Protocol: docs/spec/wire.md.
"""

from __future__ import annotations

import secrets
import threading
import time
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any, TypeVar

import msgspec
import zmq

from polysight.capture import take_priority
from polysight_shared import messages as m
from polysight_shared.closing import Closing
from polysight_shared.config import Instrument
from polysight_shared.errors import DeviceError, ErrorCode, ProtocolError, ScanError
from polysight_shared.faults import PiFault
from polysight_shared.sockets import HandshakeMonitor, create_requester, create_subscriber

# Number of times that a command is sent before the Pi counts as silent; chosen.
ATTEMPTS = 3
# Real-time priority of the heartbeat: below the receiver processes.
REAL_TIME = 1
# Heartbeats to wait for the end of a killed program's run: more than the four after which the Pi considers a host dead.
_SILENT_BEATS = 10
# Time to wait for a reply to `Alive` before it is sent again (chosen).
_ALIVE_TIMEOUT_S = 1.0
# States of the Pi that change without a command.
MOVING: tuple[m.State, ...] = ("homing", "jogging", "running", "held", "done")
# Time for the stage to come to rest; chosen.
_REST_TIMEOUT_S = 10.0
# Period of the heartbeat during a jog where the rig file has none for rows; chosen.
_JOG_HEARTBEAT_MS = 100
# Between two questions for the Pi's status (chosen).
_POLL_S = 0.05
# Events that one reply brings from the Pi's journal at most (chosen).
_REPLAY_LIMIT = 1000
# Characters of a reason that are sent (chosen): the Pi repeats it in sentences of its own, which may hold 4,000.
_MAX_REASON = 500
R = TypeVar("R", bound=m.AnyReply)


class HostHeartbeat:
    """Sends `Alive` for run `scan_id` every `interval_s` while this process lives, in its own thread and socket.

    `scan_id` is "" for a jog. `owner` as in `BeginRun`.
    """

    def __init__(
        self, context: zmq.Context[Any], instrument: Instrument, scan_id: str, interval_s: float, owner: str = ""
    ) -> None:
        self._socket = create_requester(context, instrument.pi.command_address, Path(instrument.pi.key_dir))
        self._alive = m.pack(m.Alive(scan_id=scan_id, owner=owner))
        self._interval_s = interval_s
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._send_heartbeats, name="heartbeat", daemon=True)
        self._thread.start()

    def _send_heartbeats(self) -> None:
        """Send `Alive`, wait for its reply or the timeout, and repeat, until `stop`."""
        # Without permission for real time, a busy machine may delay a heartbeat and so cause a retake.
        take_priority(REAL_TIME)
        try:
            while not self._stop.wait(self._interval_s):
                # Without a connection nothing is sent: the Pi notices the missing heartbeat.
                with suppress(zmq.Again):
                    self._socket.send(self._alive)
                waited_s = 0.0
                while not self._stop.is_set() and waited_s < _ALIVE_TIMEOUT_S:
                    if self._socket.poll(round(self._interval_s * 1e3)):
                        self._socket.recv()
                        break
                    waited_s += self._interval_s
        finally:
            self._socket.close()

    def stop(self) -> None:
        """Stop sending."""
        self._stop.set()
        self._thread.join()


class RefusedError(ScanError):
    """The Pi refused a command; `number` is of shared/polysight_shared/faults.py."""

    def __init__(self, command: str, refusal: m.Refused) -> None:
        problem = f"the Pi refused {command}: {refusal.problem}"
        super().__init__(problem, refusal.cause, refusal.remedy, code=ErrorCode.REFUSED_BY_PEER)
        self.number = refusal.number


class PiClient(Closing):
    """Client of one Pi, for one thread; `instrument` has addresses, keys and limits.

    `owner` identifies the runs and jogs that it begins; clients with the same one stop each other's.
    Raises ConfigError if an address needs keys that are missing.
    """

    def __init__(self, context: zmq.Context[Any], instrument: Instrument, owner: str = "") -> None:
        self._context = context
        self._instrument = instrument
        self._heartbeat: HostHeartbeat | None = None
        self._address = instrument.pi.command_address
        self._event_address = instrument.pi.event_address
        self._timeout_s = instrument.limits.command_timeout_s
        # Silence on both sockets after which the Pi is asked if it still answers: ten of its heartbeats, and no less
        # than a command's timeout.
        self._silence_s = max(10 * instrument.pi.heartbeat_ms / 1e3, instrument.limits.command_timeout_s)
        self._on_event: Callable[[m.AnyEvent], object] = lambda _: None
        keys = Path(instrument.pi.key_dir)
        self._events = create_subscriber(context, self._event_address, keys)
        self._commands = create_requester(context, self._address, keys)
        self._handshake = HandshakeMonitor(self._commands)
        self._owner = owner or secrets.token_hex(16)
        self._scan_id = ""
        self._last_seq = 0
        self._last_heard_s = time.monotonic()
        self._pending: deque[m.AnyEvent] = deque()
        # Events fetched from the Pi's journal, because the event socket did not bring them, or not yet.
        self.gaps_filled = 0
        # State of the Pi in its last heartbeat.
        self.state: m.State = "idle"

    @property
    def event_socket(self) -> zmq.Socket[bytes]:
        """The event socket, for a poller."""
        return self._events

    def follow(self, scan_id: str, last_seq: int, on_event: Callable[[m.AnyEvent], None]) -> None:
        """Follow the events of a scan: call `on_event` exactly once with each event after `last_seq`, in order."""
        self._scan_id = scan_id
        self._last_seq = last_seq
        self._on_event = on_event

    # --- commands ---

    def hello(self) -> m.HelloReply:
        """Identify the Pi. Raises DeviceError if it does not answer, ProtocolError for another release."""
        return self._ask(m.Hello(), m.HelloReply)

    def status(self) -> m.StatusReply:
        """Return the Pi's status. Raises DeviceError."""
        return self._ask(m.Status(), m.StatusReply)

    def begin_run(self, run: m.BeginRun) -> None:
        """Begin or resume a run and send its heartbeat until the run's end. Safe to repeat.

        Waits some heartbeats if the Pi still considers a killed program of the same scan alive. `owns_home`: no one
        else may home the stage in this run.

        Raises RefusedError, DeviceError.
        """
        run = msgspec.structs.replace(run, owner=self._owner, owns_home=True)
        deadline = time.monotonic() + _SILENT_BEATS * run.heartbeat_ms / 1e3
        while True:
            try:
                self._ask(run, m.Accepted)
                break
            except RefusedError as e:
                same_scan = e.number == PiFault.NOT_READY and self.status().scan_id == run.scan_id
                if not same_scan or time.monotonic() > deadline:
                    raise
                time.sleep(_POLL_S)
        self._stop_heartbeat()
        if run.heartbeat_ms:
            interval_s = run.heartbeat_ms / 1e3
            self._heartbeat = HostHeartbeat(self._context, self._instrument, run.scan_id, interval_s, self._owner)

    def end_run(self, scan_id: str, exit_status: m.ExitStatus, reason: str) -> None:
        """End the run. Raises RefusedError, DeviceError."""
        self._ask(
            m.EndRun(scan_id=scan_id, exit_status=exit_status, reason=reason[:_MAX_REASON], owner=self._owner),
            m.Accepted,
        )
        self._stop_heartbeat()

    def home(self) -> None:
        """Start homing. Without a reply, retry unless the stage is homing. Raises RefusedError, DeviceError."""
        command = m.Home(owner=self._owner)
        if self._send_once(command, self._timeout_s) is None and self.status().state != "homing":
            self._ask(command, m.Accepted)

    def jog(self, axis: m.Axis, distance_mm: float, speed_mm_s: float) -> m.StatusReply:
        """Move one axis of the homed stage and wait for its end; return the status there.

        The stage stops if this program ends or is interrupted. Raises RefusedError, DeviceError, or ScanError if the
        stage does not get there.
        """
        from_mm = _find_place_mm(self.status(), axis)
        heartbeat_ms = self._instrument.pi.host_heartbeat_ms or _JOG_HEARTBEAT_MS
        command = m.Jog(
            axis=axis,
            from_mm=from_mm,
            distance_mm=distance_mm,
            speed_mm_s=speed_mm_s,
            heartbeat_ms=heartbeat_ms,
            owner=self._owner,
        )
        heartbeat = HostHeartbeat(self._context, self._instrument, "", heartbeat_ms / 1e3, self._owner)
        try:
            self._ask(command, m.Accepted)
            status = self.status()
            while status.state == "jogging":
                time.sleep(_POLL_S)
                status = self.status()
        except KeyboardInterrupt:
            self.abort("stopped by its operator")
            raise
        finally:
            heartbeat.stop()

        missing_mm = from_mm + distance_mm - _find_place_mm(status, axis)
        # The stage moves in whole steps, so it may stop half a step from the target; 1 % is for rounding.
        tolerance_mm = 1.01 * 0.5 / self._instrument.stage.steps_per_mm
        if status.fault or abs(missing_mm) > tolerance_mm:
            raise ScanError(
                f"the stage stopped about {abs(missing_mm):.1f} mm before the end of the jog",
                status.reason or "it was aborted",
                "look at the stage; home it if its state is `fault`",
                code=ErrorCode.STAGE_NOT_READY,
            )
        return status

    def run_row(self, scan_id: str, row_index: int, take: int) -> None:
        """Begin a row. If the reply is lost, check if the row runs before a retry.

        Raises RefusedError, DeviceError.
        """
        command = m.RunRow(scan_id=scan_id, row_index=row_index, take=take, owner=self._owner)
        for _ in range(ATTEMPTS):
            reply = self._send_once(command, self._timeout_s / ATTEMPTS)
            if isinstance(reply, m.Accepted):
                # The reply is newer than the last heartbeat.
                self.state = reply.state
                return
            status = self.status()
            if status.state in ("running", "held") and (status.row_index, status.take) == (row_index, take):
                return
            self._catch_up(status.last_seq)
            if any(_belongs_to_take(e, row_index, take) for e in self._pending):
                return
        raise self._no_answer_error("RunRow")

    def pulse(self, pulses: int, period_us: float, width_us: float) -> m.Pulsed:
        """Send one burst on SYNC_IN with the stage at rest. No retry: a second burst would add frames.

        Raises RefusedError, DeviceError.
        """
        reply = self._send_once(m.Pulse(pulses=pulses, period_us=period_us, width_us=width_us), self._timeout_s)
        if not isinstance(reply, m.Pulsed):
            raise self._no_answer_error("Pulse")
        return reply

    def abort(self, reason: str) -> None:
        """Abort the row now; safe to repeat. Raises RefusedError, DeviceError."""
        self._ask(m.Abort(reason=reason[:_MAX_REASON], owner=self._owner), m.Accepted)

    def come_to_rest(self, reason: str) -> None:
        """Abort the row and wait until the stage stands, which `end_run` needs; do nothing in another host's run.

        Raises RefusedError, DeviceError.
        """
        if self.status().scan_id != self._scan_id:
            return
        self.abort(reason)
        deadline = time.monotonic() + _REST_TIMEOUT_S
        while self.status().state in MOVING and time.monotonic() < deadline:
            time.sleep(_POLL_S)

    def _ask(self, command: m.AnyCommand, kind: type[R]) -> R:
        """Send a command, which must be safe to repeat, with retries; return its reply, a `kind`.

        Raises RefusedError, DeviceError without a reply, ProtocolError for a reply of another kind.
        """
        for _ in range(ATTEMPTS):
            reply = self._send_once(command, self._timeout_s / ATTEMPTS)
            if isinstance(reply, kind):
                return reply
            if reply is not None:
                problem = f"the Pi answered {type(command).__name__} with {type(reply).__name__}"
                raise ProtocolError(problem, code=ErrorCode.MESSAGE_INVALID)
        raise self._no_answer_error(type(command).__name__)

    def _send_once(self, command: m.AnyCommand, timeout_s: float) -> m.AnyReply | None:
        """Send once and return the reply, None after the timeout. A later request replaces this one (ZMQ_REQ_RELAXED).

        Raises RefusedError.
        """
        try:
            self._commands.send(m.pack(command))
        except zmq.Again:
            # There is no connection to the Pi.
            return None
        if not self._commands.poll(round(timeout_s * 1e3)):
            return None
        reply = m.unpack_reply(self._commands.recv())
        self._last_heard_s = time.monotonic()
        if isinstance(reply, m.Refused):
            raise RefusedError(type(command).__name__, reply)
        return reply

    def _no_answer_error(self, command: str) -> DeviceError:
        """Return the error for a Pi that is silent or refuses this host's key, or a program without CURVE there."""
        is_refused = self._handshake.is_refused()
        if self._handshake.lacks_curve:
            return DeviceError(
                f"the program at {self._address} does not use CURVE keys",
                "it is another program, or a tunnel to the Pi's loopback address, which needs no keys",
                "correct pi.command_address and pi.event_address; with a tunnel they are tcp://127.0.0.1:PORT here",
                code=ErrorCode.MISMATCH,
            )
        if is_refused:
            return DeviceError(
                f"the Pi at {self._address} refuses this host's key",
                "the key was revoked or never allowed, or pi.key here belongs to another Pi",
                f"on the Pi: `polysight-pi keys --list`; here: the key files in {self._instrument.pi.key_dir}"
                " (docs/how-to/install.md)",
                code=ErrorCode.REFUSED_BY_PEER,
            )
        return DeviceError(
            f"the Pi at {self._address} did not answer {command} within {self._timeout_s:g} s ({ATTEMPTS} attempts)",
            "`polysight-pi run` is not running there, the address is wrong, or the CURVE keys do not match",
            "on the Pi: `systemctl status polysight-pi`, `journalctl -u polysight-pi -n 20`; here: check"
            " pi.command_address (`polysight resume SCAN --config instrument.toml` resumes a scan with another one)",
            code=ErrorCode.NO_ANSWER,
        )

    # --- events ---

    def events(self) -> list[m.AnyEvent]:
        """Return the scan's journalled events that have arrived, in order, without waiting; fetch lost ones.

        Raises DeviceError if the Pi is silent on both sockets, or its journal lacks the lost events.
        """
        while self._events.poll(0):
            # A topic, then the event.
            parts = self._events.recv_multipart()
            self._last_heard_s = time.monotonic()
            event = m.unpack_event(parts[-1])
            if isinstance(event, m.Heartbeat):
                self.state = event.state
            if event.scan_id != self._scan_id or not self._scan_id:
                continue
            if isinstance(event, m.JOURNALLED_EVENTS) and event.seq == self._last_seq + 1:
                self._take(event)
            elif event.seq > self._last_seq:
                # Some were lost: an event that is not journalled has the number of the last one that is.
                self._catch_up(event.seq)
        if time.monotonic() - self._last_heard_s > self._silence_s:
            # Heartbeats are missing: check that the Pi answers commands.
            self._catch_up(self.status().last_seq)
        events = list(self._pending)
        self._pending.clear()
        return events

    def _take(self, event: m.AnyEvent) -> None:
        """Accept the next event in order: keep it for :meth:`events` and pass it to the follower."""
        self._last_seq = event.seq
        self._pending.append(event)
        self._on_event(event)

    def _catch_up(self, to_seq: int) -> None:
        """Fetch the missing journalled events up to `to_seq`. Raises DeviceError if the journal lacks one."""
        while self._last_seq < to_seq:
            reply = self._ask(
                m.Replay(scan_id=self._scan_id, from_seq=self._last_seq + 1, limit=_REPLAY_LIMIT), m.ReplayReply
            )
            seq_before = self._last_seq
            for event in reply.events:
                if event.seq == self._last_seq + 1:
                    self._take(event)
                    self.gaps_filled += 1
            if self._last_seq == seq_before:
                raise DeviceError(
                    f"the Pi's journal of scan {self._scan_id} lacks event {seq_before + 1}"
                    f" (it ends at {reply.last_seq})",
                    "the journal on the Pi was removed or damaged",
                    "start a new scan; the committed rows of this one stay valid",
                    code=ErrorCode.NO_DATA,
                )

    def drain(self) -> None:
        """Fetch all events in the Pi's journal. Raises DeviceError."""
        self._catch_up(self.status().last_seq)

    def close(self) -> None:
        """Stop the heartbeat and close the sockets."""
        self._stop_heartbeat()
        self._events.close()
        self._handshake.close()
        self._commands.close()

    def _stop_heartbeat(self) -> None:
        if self._heartbeat is not None:
            self._heartbeat.stop()
            self._heartbeat = None


def _find_place_mm(status: m.StatusReply, axis: m.Axis) -> float:
    if axis == "x":
        return status.x_mm
    return status.y_mm


def _belongs_to_take(event: m.AnyEvent, row_index: int, take: int) -> bool:
    """Return True if an event says that this take of the row has begun or ended."""
    if isinstance(event, m.RowStarted):
        return event.row.index == row_index and event.take == take
    return isinstance(event, m.RowFinished) and (event.row_index, event.take) == (row_index, take)
