"""Takes rows: from arming the radars to what the receivers got.

`RowTransaction` is the state machine of one take (docs/spec/row.md); `RowTaker` drives it with Pi, radars and cards.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor, wait
from enum import StrEnum
from pathlib import Path

import zmq

from polysight.host.acquisition.capture_rig import CaptureRig, record_ending
from polysight.host.acquisition.control import StopRequest
from polysight.host.acquisition.pi_client import PiClient
from polysight.host.acquisition.slipped_row import ToldCapture, find_frames, find_slip, first_pulse_ns
from polysight.host.acquisition.take import ON_REQUEST, FaultKind, Take, TakeFault
from polysight.host.radar import RadarControl
from polysight.host.store import PART
from polysight.shared.config import Instrument
from polysight.shared.errors import ScanError
from polysight.shared.faults import explain
from polysight.shared.messages import Capture, RowFinished
from polysight.shared.raster import Row
from polysight.shared.units import NS_PER_S

_TURN_MS = 50  # how often stop requests and limits are looked at
_ABORT_LIMIT_S = 10.0
_DISK_NOTICE_S = 2.0


class RowState(StrEnum):
    """Where one take of a row is."""

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
    """One take on its way through the states; `tell` hears of each one, the first included."""

    def __init__(self, tell: Callable[[RowState], None]) -> None:
        self._tell = tell
        self.state = RowState.WAITING
        tell(self.state)

    def to(self, state: RowState) -> None:
        """Go on to a state. Raises ScanError when it does not follow from the one before: a fault of this program."""
        if state not in TRANSITIONS[self.state]:
            raise ScanError(f"a row went from {self.state} to {state}", "a fault of this program", "report it")
        self.state = state
        self._tell(state)

    def fail(self) -> None:
        """End as failed, unless it has ended already."""
        if TRANSITIONS[self.state]:
            self.to(RowState.FAILED)


class RowTaker:
    """Takes rows, one at a time. `say` is told phase and message of what holds a row up, `on_point` its points."""

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
        say: Callable[[str, str], None],
    ) -> None:
        self._instrument, self._rig, self._radars, self._pi = instrument, rig, radars, pi
        self._scan_id, self._folder, self._stop = scan_id, folder, stop
        self._on_point, self._say = on_point, say
        self._poller = zmq.Poller()
        self._poller.register(pi.event_socket, zmq.POLLIN)
        for part in (*rig.receivers.values(), *rig.cards.values()):
            self._poller.register(part.fileno(), zmq.POLLIN)

    def take(self, row: Row, number: int, transaction: RowTransaction) -> Take:
        """Run the row and receive it; `transaction` is left in `checking`.

        Raises
        ------
        PolysightError
            when the Pi, a card, a receiver or a radar's control does not do its part at all.
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
            self._rig.row_runs(time.monotonic_ns())
            self._pi.run_row(self._scan_id, row.index, number)
            self._wait_for_row(take, transaction)
            if take.bursts_are_whole:
                transaction.to(RowState.COLLECTING)
                self._wait_for_data()
                take.not_done = self._radars.wait_done(self._instrument.limits.end_of_record_s)
        transaction.to(RowState.WRITING)
        self._end_records(take)
        take.radars = self._radars.states()
        if take.bursts_are_whole:
            self._find_missed_pulses(take)
        transaction.to(RowState.CHECKING)
        return take

    def _wait_for_row(self, take: Take, transaction: RowTransaction) -> None:
        """Until the Pi says how the row ended. Aborts it when asked to stop now, or when it is in vain."""
        limit_s = row_limit_s(self._instrument, take.row)
        deadline = time.monotonic() + limit_s
        silence = _Silence(self._instrument, self._rig)
        held = False
        while take.finished is None:
            self._turn(take)
            fault = ON_REQUEST if self._stop.now else None if take.aborted else self._in_vain(take, silence)
            if take.finished is None and fault and not take.aborted:
                take.aborted = fault
                deadline = time.monotonic() + _ABORT_LIMIT_S
                transaction.to(RowState.ABORTING)
                self._pi.abort(fault.text)
            if take.finished is None and self._pi.state in ("fault", "idle"):
                self._check_stopped(take)
            if self._pi.state == "held" and not take.aborted:
                deadline = time.monotonic() + limit_s  # however long somebody looks at it
                if not held:
                    self._say("held", f"row {take.row.index} is held; who sent `Hold` sends `Resume`")
                held = True
            if time.monotonic() > deadline:
                if take.aborted:
                    return
                raise ScanError(
                    f"row {take.row.index} did not end within {limit_s:.0f} s",
                    "the stage stands still, or the Pi's program hangs",
                    f"`journalctl -u polysight-pi -n 20` on the Pi, then `polysight resume {self._folder}`",
                )

    def _in_vain(self, take: Take, silence: _Silence) -> TakeFault | None:
        """Why the row cannot become whole any more and is not worth its time; None while it can."""
        take.radars = self._radars.states()
        if stopped := take.stopped_radars:
            told = (f"{name}: the radar has stopped: {s.detail}" for name, s in stopped.items())
            return TakeFault(FaultKind.RADAR_STOPPED, "; ".join(told))
        if boards := silence.boards(take.told):
            return TakeFault(FaultKind.NO_DATA, f"no data from {', '.join(boards)}")
        return None

    def _check_stopped(self, take: Take) -> None:
        """A Pi that cannot write its journal, or was started anew, cannot tell how the row ended, only where it is."""
        status = self._pi.status()
        if status.state not in ("fault", "idle"):
            return  # the heartbeat was older than this row
        if status.scan_id == self._scan_id:
            self._pi.drain()
        self._collect(take)
        if take.finished is None and status.scan_id != self._scan_id:
            raise ScanError(
                f"the Pi's program was started anew in row {take.row.index}",
                "power was lost there, or the program ended",
                f"`polysight resume {self._folder}`; why it ended: `journalctl -u polysight-pi` on the Pi",
            )
        if take.finished is None:
            e = explain(status.fault)
            raise ScanError(
                f"the Pi stopped in row {take.row.index}: {e.what}: {status.reason}",
                e.why,
                f"{e.remedy}, then `polysight resume {self._folder}`",
            )

    def _turn(self, take: Take) -> None:
        self._poller.poll(_TURN_MS)
        self._rig.statuses()  # reads what the cards report by themselves
        _ = self._rig.complete  # reads what the receivers say
        self._collect(take)

    def _collect(self, take: Take) -> None:
        for event in self._pi.events():
            if isinstance(event, Capture) and (event.row_index, event.take) == (take.row.index, take.number):
                take.told.append(ToldCapture(event, time.monotonic_ns()))
                self._on_point(event.point + 1)
            elif isinstance(event, RowFinished) and (event.row_index, event.take) == (take.row.index, take.number):
                take.finished = event

    def _wait_for_data(self) -> None:
        """Until every byte is there, or the record has ended on every board that lacks some."""
        finished_ns = time.monotonic_ns()
        limit_ns = int(self._instrument.limits.end_of_record_s * NS_PER_S)
        while not self._rig.complete and not self._stop.now:
            self._poller.poll(_TURN_MS)
            now, statuses, reports = time.monotonic_ns(), self._rig.statuses(), self._rig.reports()
            if all(record_ending(r, statuses[n], finished_ns, now, limit_ns) for n, r in reports.items()):
                return

    def _end_records(self, take: Take) -> None:
        """Stop the records and make the rows durable. A slow disk is waited for, and that is told."""
        began = time.monotonic()
        with ThreadPoolExecutor(1, thread_name_prefix="disk") as beside:
            ending = beside.submit(self._rig.end_row, first_pulse_ns(take.told) or 0)
            while not wait([ending], _DISK_NOTICE_S).done:
                waited_s = time.monotonic() - began
                self._say("wait", f"row {take.row.index}: the disk has not taken it after {waited_s:.0f} s; waiting")
            take.captures = ending.result()

    def _find_missed_pulses(self, take: Take) -> None:
        """Every pulse was sent. Which ones boards missed that are short of frames, and whether the others slipped."""
        for name, capture in take.captures.items():
            path = self._folder / "raw" / name / f"{take.row.index:04d}{PART}"
            if capture.slipped:
                take.placed[name] = find_frames(path, take.row, take.told, self._instrument)
            elif not capture.missing and (slipped := find_slip(path, take.row, take.told, self._instrument)):
                take.placed[name] = slipped


class _Silence:
    """Notices boards of which nothing has come long after bursts were sent: those radars are not armed."""

    def __init__(self, instrument: Instrument, rig: CaptureRig) -> None:
        self._rig = rig
        self._limit_ns = int(instrument.limits.end_of_record_s * NS_PER_S)
        # So many bursts fill two packets at least.
        burst_bytes = instrument.burst.pulses * instrument.frame_bytes
        self._bursts = -(-2 * instrument.card.packet_bytes // burst_bytes)
        self._looked_ns = 0
        self._all_heard = False

    def boards(self, told: list[ToldCapture]) -> list[str]:
        """The silent ones, [] while none is."""
        now = time.monotonic_ns()
        if self._all_heard or len(told) < self._bursts or now - self._looked_ns < self._limit_ns:
            return []
        if now - told[self._bursts - 1].told_ns < self._limit_ns:
            return []
        self._looked_ns = now
        silent = [name for name, progress in self._rig.reports().items() if progress.received == 0]
        self._all_heard = not silent
        return silent


def row_limit_s(instrument: Instrument, row: Row) -> float:
    """A row takes longer than this only when something hangs: four times the way there and along it, and a minute."""
    stage = instrument.stage
    there_s = (stage.travel_x_mm + stage.travel_y_mm) / stage.travel_speed_mm_s
    return 60.0 + 4 * (there_s + abs(row.step_mm) * row.points / stage.speed_mm_s)
