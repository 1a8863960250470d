"""Record one take of a row with the Pi, the radars and the cards.

`RowTransaction` is the state machine of a take (docs/spec/row.md); `RowTaker` drives it.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor, wait
from enum import StrEnum
from pathlib import Path

import zmq

from polysight.acquisition.capture_rig import CaptureRig, record_ended
from polysight.acquisition.control import StopRequest
from polysight.acquisition.pi_client import PiClient
from polysight.acquisition.slipped_row import ReceivedCapture, find_frames, find_slip, first_pulse_ns
from polysight.acquisition.take import ON_REQUEST, FaultKind, Take, TakeFault
from polysight.radar import RadarControl
from polysight.store import PART
from polysight_shared.config import Instrument
from polysight_shared.error_codes import ErrorCode
from polysight_shared.errors import ScanError
from polysight_shared.faults import explain
from polysight_shared.messages import Capture, RowFinished
from polysight_shared.raster import Row
from polysight_shared.units import NS_PER_S

_POLL_MS = 50  # interval at which stop requests and timeouts are checked
_ABORT_TIMEOUT_S = 10.0
_DISK_NOTICE_S = 2.0


class RowState(StrEnum):
    """State of a take."""

    WAITING = "waiting"
    ARMING = "arming"
    RUNNING = "running"
    ABORTING = "aborting"
    COLLECTING = "collecting"
    WRITING = "writing"
    CHECKING = "checking"
    COMMITTED = "committed"
    KEPT = "kept"
    REJECTED = "rejected"
    STOPPED = "stopped"
    FAILED = "failed"


S = RowState
TRANSITIONS: dict[RowState, frozenset[RowState]] = {
    S.WAITING: frozenset({S.ARMING, S.STOPPED, S.FAILED}),
    S.ARMING: frozenset({S.RUNNING, S.WRITING, S.FAILED}),
    S.RUNNING: frozenset({S.COLLECTING, S.ABORTING, S.WRITING, S.FAILED}),
    S.ABORTING: frozenset({S.COLLECTING, S.WRITING, S.FAILED}),
    S.COLLECTING: frozenset({S.WRITING, S.FAILED}),
    S.WRITING: frozenset({S.CHECKING, S.FAILED}),
    S.CHECKING: frozenset({S.COMMITTED, S.KEPT, S.REJECTED, S.FAILED}),
    S.COMMITTED: frozenset(),
    S.KEPT: frozenset(),
    S.REJECTED: frozenset(),
    S.STOPPED: frozenset(),
    S.FAILED: frozenset(),
}


class RowTransaction:
    """State machine of one take; calls `on_state` with each state, including the first."""

    def __init__(self, on_state: Callable[[RowState], None]) -> None:
        self._on_state = on_state
        self.state = RowState.WAITING
        on_state(self.state)

    def to(self, state: RowState) -> None:
        """Change to a state. Raises ScanError if `TRANSITIONS` does not allow it, which is a bug."""
        if state not in TRANSITIONS[self.state]:
            raise ScanError(f"a row went from {self.state} to {state}", "a fault of this program", "report it")
        self.state = state
        self._on_state(state)

    def fail(self) -> None:
        """Change to `failed`, except from a final state."""
        if TRANSITIONS[self.state]:
            self.to(RowState.FAILED)


class RowTaker:
    """Record rows, one at a time; `notify(phase, message)` reports delays, `on_point` the number of points done."""

    def __init__(
        self,
        instrument: Instrument,
        rig: CaptureRig,
        radars: RadarControl,
        pi: PiClient,
        scan_id: str,
        folder: Path,
        stop: StopRequest,
        on_point: Callable[[int], None],
        notify: Callable[[str, str], None],
    ) -> None:
        self._instrument, self._rig, self._radars, self._pi = instrument, rig, radars, pi
        self._scan_id, self._folder, self._stop = scan_id, folder, stop
        self._on_point, self._notify = on_point, notify
        self._poller = zmq.Poller()
        self._poller.register(pi.event_socket, zmq.POLLIN)
        for part in (*rig.receivers.values(), *rig.cards.values()):
            self._poller.register(part.fileno(), zmq.POLLIN)

    def take(self, row: Row, number: int, transaction: RowTransaction) -> Take:
        """Run and receive a row; leaves `transaction` in `checking`.

        Raises PolysightError if the Pi, a card, a receiver or a radar does not respond.
        """
        take = Take(row, number)
        transaction.to(RowState.ARMING)
        self._radars.arm(row.points * self._instrument.burst.pulses)
        self._rig.begin_row(row.index, number, row.points, self._folder)
        take.radars = self._radars.states()
        if self._stop.now:
            take.aborted = ON_REQUEST
        elif take.stopped_radars:
            take.aborted = TakeFault(FaultKind.RADAR_STOPPED, "the row was not begun")
        else:
            transaction.to(RowState.RUNNING)
            self._radars.row_begins()
            self._rig.discard_before(time.monotonic_ns())
            self._pi.run_row(self._scan_id, row.index, number)
            self._wait_for_row(take, transaction)
            if take.all_pulses_sent:
                transaction.to(RowState.COLLECTING)
                self._wait_for_data()
                take.not_done = self._radars.wait_done(self._instrument.limits.end_of_record_s)
        transaction.to(RowState.WRITING)
        self._end_records(take)
        take.radars = self._radars.states()
        if take.all_pulses_sent:
            self._find_missed_pulses(take)
        transaction.to(RowState.CHECKING)
        return take

    def _wait_for_row(self, take: Take, transaction: RowTransaction) -> None:
        """Wait until the Pi reports the row's end. Abort the row on request, or if its data cannot become complete."""
        limit_s = row_limit_s(self._instrument, take.row)
        deadline = time.monotonic() + limit_s
        silence = _SilenceCheck(self._instrument, self._rig)
        held = False
        while take.finished is None:
            self._poll(take)
            fault = ON_REQUEST if self._stop.now else None if take.aborted else self._fatal_fault(take, silence)
            if take.finished is None and fault and not take.aborted:
                take.aborted = fault
                deadline = time.monotonic() + _ABORT_TIMEOUT_S
                transaction.to(RowState.ABORTING)
                self._pi.abort(fault.text)
            if take.finished is None and self._pi.state in ("fault", "idle"):
                self._check_stopped(take)
            if self._pi.state == "held" and not take.aborted:
                deadline = time.monotonic() + limit_s  # a held row has no timeout
                if not held:
                    self._notify("held", f"row {take.row.index} is held; send `Resume` from where `Hold` was sent")
                held = True
            if time.monotonic() > deadline:
                if take.aborted:
                    return
                raise ScanError(
                    f"row {take.row.index} did not end within {limit_s:.0f} s",
                    "the stage stands still, or the Pi's program hangs",
                    f"`journalctl -u polysight-pi -n 20` on the Pi, then `polysight resume {self._folder}`",
                    code=ErrorCode.NO_ANSWER,
                )

    def _fatal_fault(self, take: Take, silence: _SilenceCheck) -> TakeFault | None:
        """Return a fault for which the row is aborted because it cannot become complete; None if there is none."""
        take.radars = self._radars.states()
        if stopped := take.stopped_radars:
            texts = (f"{name}: the radar has stopped: {s.detail}" for name, s in stopped.items())
            return TakeFault(FaultKind.RADAR_STOPPED, "; ".join(texts))
        if boards := silence.boards(take.events):
            return TakeFault(FaultKind.NO_DATA, f"no data from {', '.join(boards)}")
        return None

    def _check_stopped(self, take: Take) -> None:
        """Raise ScanError if the Pi is in a fault or restarted, and its journal does not contain the row's end."""
        status = self._pi.status()
        if status.state not in ("fault", "idle"):
            return  # the last heartbeat was from before this row
        if status.scan_id == self._scan_id:
            self._pi.drain()
        self._collect(take)
        if take.finished is None and status.scan_id != self._scan_id:
            raise ScanError(
                f"the Pi's program restarted in row {take.row.index}",
                "power was lost there, or the program ended",
                f"`polysight resume {self._folder}`; why it ended: `journalctl -u polysight-pi` on the Pi",
                code=ErrorCode.STAGE_NOT_READY,
            )
        if take.finished is None:
            e = explain(status.fault)
            raise ScanError(
                f"the Pi stopped in row {take.row.index}: {e.what}: {status.reason}",
                e.why,
                f"{e.remedy}, then `polysight resume {self._folder}`",
                code=ErrorCode.STAGE_NOT_READY,
            )

    def _poll(self, take: Take) -> None:
        self._poller.poll(_POLL_MS)
        self._rig.statuses()  # reads the cards' messages
        _ = self._rig.complete  # reads the receivers' messages
        self._collect(take)

    def _collect(self, take: Take) -> None:
        for event in self._pi.events():
            if isinstance(event, Capture) and (event.row_index, event.take) == (take.row.index, take.number):
                take.events.append(ReceivedCapture(event, time.monotonic_ns()))
                self._on_point(event.point + 1)
            elif isinstance(event, RowFinished) and (event.row_index, event.take) == (take.row.index, take.number):
                take.finished = event

    def _wait_for_data(self) -> None:
        """Wait until every board's data is complete, or its record has ended."""
        finished_ns = time.monotonic_ns()
        limit_ns = int(self._instrument.limits.end_of_record_s * NS_PER_S)
        while not self._rig.complete and not self._stop.now:
            self._poller.poll(_POLL_MS)
            now, statuses, reports = time.monotonic_ns(), self._rig.statuses(), self._rig.reports()
            if all(record_ended(r, statuses[n], finished_ns, now, limit_ns) for n, r in reports.items()):
                return

    def _end_records(self, take: Take) -> None:
        """Stop the records and make the rows durable; notify while a slow disk delays this."""
        began = time.monotonic()
        with ThreadPoolExecutor(1, thread_name_prefix="disk") as executor:
            ending = executor.submit(self._rig.end_row, first_pulse_ns(take.events) or 0)
            while not wait([ending], _DISK_NOTICE_S).done:
                waited_s = time.monotonic() - began
                self._notify("wait", f"row {take.row.index} is not written after {waited_s:.0f} s: the disk is slow")
            take.captures = ending.result()

    def _find_missed_pulses(self, take: Take) -> None:
        """Place the frames of boards that missed pulses or whose frames slipped; every pulse was sent."""
        for name, capture in take.captures.items():
            path = self._folder / "raw" / name / f"{take.row.index:04d}{PART}"
            if capture.slipped:
                take.placed[name] = find_frames(path, take.row, take.events, self._instrument)
            elif not capture.missing and (slipped := find_slip(path, take.row, take.events, self._instrument)):
                take.placed[name] = slipped


class _SilenceCheck:
    """Finds boards that send no data long after bursts were sent: their radars are not armed."""

    def __init__(self, instrument: Instrument, rig: CaptureRig) -> None:
        self._rig = rig
        self._limit_ns = int(instrument.limits.end_of_record_s * NS_PER_S)
        burst_bytes = instrument.burst.pulses * instrument.frame_bytes
        self._bursts = -(-2 * instrument.card.packet_bytes // burst_bytes)  # that fill at least two packets
        self._checked_ns = 0
        self._all_heard = False

    def boards(self, events: list[ReceivedCapture]) -> list[str]:
        """Return the silent boards."""
        now = time.monotonic_ns()
        if self._all_heard or len(events) < self._bursts or now - self._checked_ns < self._limit_ns:
            return []
        if now - events[self._bursts - 1].received_ns < self._limit_ns:
            return []
        self._checked_ns = now
        silent = [name for name, progress in self._rig.reports().items() if progress.received == 0]
        self._all_heard = not silent
        return silent


def row_limit_s(instrument: Instrument, row: Row) -> float:
    """Return the timeout of a row: one minute plus four times the travel to it and along it."""
    stage = instrument.stage
    travel_s = (stage.travel_x_mm + stage.travel_y_mm) / stage.travel_speed_mm_s
    return 60.0 + 4 * (travel_s + abs(row.step_mm) * row.points / stage.speed_mm_s)
