"""Receive the Pi's event stream. There is no command socket here, so the live view cannot command the Pi."""

from __future__ import annotations

import threading
import time
from dataclasses import dataclass, replace
from pathlib import Path

import zmq

from polysight.page.history import Notice, notice_of_error, notice_of_fault
from polysight_shared.config import Instrument
from polysight_shared.errors import PolysightError, ProtocolError
from polysight_shared.messages import (
    Capture,
    Fault,
    Heartbeat,
    RowFinished,
    RowStarted,
    StageStatus,
    State,
    unpack_event,
)
from polysight_shared.sockets import observer

_TURN_MS = 200
_FAULTS = 20


@dataclass(frozen=True)
class PiState:
    """State of the Pi by its last events; replaced as a whole, never changed.

    Attributes
    ----------
    heard_s, heard_utc_s
        Time of the last event, on the monotonic clock and in seconds since 1970; 0 before.
    state
        The Pi's.
    x_mm, y_mm
        Stage offset in the rig frame; None while unknown.
    row, take, point
        Of the running row; row -1 between rows.
    faults
        Faults since the last row that was done.
    deaf
        Why no events can be received.
    """

    heard_s: float = 0.0
    heard_utc_s: int = 0
    state: State | None = None
    x_mm: float | None = None
    y_mm: float | None = None
    row: int = -1
    take: int = 0
    point: int = 0
    faults: tuple[Notice, ...] = ()
    deaf: Notice | None = None


class PiListener:
    """Receives the Pi's events of one scan in a thread of its own."""

    def __init__(self, instrument: Instrument, scan_id: str) -> None:
        self._instrument, self._scan_id = instrument, scan_id
        self.heard = PiState()
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, name="listener", daemon=True)
        self._thread.start()

    def _run(self) -> None:
        context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        try:
            pi = self._instrument.pi
            socket = observer(context, pi.event_address, Path(pi.key_dir))
            while not self._ended.is_set():
                if socket.poll(_TURN_MS):
                    self._take(socket.recv_multipart()[-1])
        except PolysightError as e:
            self.heard = replace(self.heard, deaf=notice_of_error(e, "note"))
        finally:
            context.destroy(linger=0)

    def _take(self, raw: bytes) -> None:
        try:
            event = unpack_event(raw)
        except ProtocolError as e:
            self.heard = replace(self.heard, deaf=notice_of_error(e, "note"))
            return
        h = replace(self.heard, heard_s=time.monotonic(), heard_utc_s=int(time.time()), deaf=None)
        if isinstance(event, Heartbeat):
            h = replace(h, state=event.state)
        elif isinstance(event, StageStatus):
            stage = self._instrument.stage
            h = replace(h, x_mm=event.x_mm - stage.centre_x_mm, y_mm=event.y_mm - stage.centre_y_mm)
        if event.scan_id == self._scan_id:
            if isinstance(event, RowStarted):
                h = replace(h, row=event.row.index, take=event.take, point=0, state="running")
            elif isinstance(event, Capture):
                h = replace(h, row=event.row_index, take=event.take, point=event.point + 1)
            elif isinstance(event, RowFinished):
                h = replace(h, row=-1, point=0, faults=() if event.status == "done" else h.faults)
            elif isinstance(event, Fault):
                h = replace(h, faults=(*h.faults, notice_of_fault(event))[-_FAULTS:])
        self.heard = h

    def close(self) -> None:
        """Stop the thread."""
        self._ended.set()
        self._thread.join()
