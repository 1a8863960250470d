"""Record one take of a row with the Pi, the radars and the cards, list its faults, and commit or reject it.

`RowTaker` drives a take through the states of `RowTransaction` (docs/spec/row.md). `Take.faults` compares the data of
every board with the pulses that were sent. `commit_row` makes the files durable and adds the row to the manifest;
`reject_row` deletes them.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor, wait
from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path
from typing import Any

import msgspec
import zmq

from polysight.acquisition import pulse_times
from polysight.acquisition.capture_rig import CaptureRig, has_record_ended
from polysight.acquisition.control import StopRequest
from polysight.acquisition.pi_client import PiClient
from polysight.capture import PACKETS_SUFFIX, RowCapture, explain_silent_radar, make_write_error, valid_frames
from polysight.radar import BoardState, RadarControl, RadarState
from polysight.store import (
    PART_SUFFIX,
    BoardRow,
    LogDigest,
    ManifestWriter,
    Reception,
    RowCommitted,
    RowFault,
    RowRejected,
    ScanFolder,
    utc_now,
)
from polysight_shared.config import Instrument
from polysight_shared.errors import ErrorCode, ScanError, join_advice, quote
from polysight_shared.faults import explain
from polysight_shared.files import sync_folder
from polysight_shared.messages import Capture, RowFinished
from polysight_shared.raster import Row
from polysight_shared.units import NS_PER_S


class FaultKind(StrEnum):
    """Kinds of faults of a take. The manifest stores the values: never change the meaning of one."""

    # The scan was aborted on request.
    ON_REQUEST = "on_request"
    # The radar reported that it has stopped.
    RADAR_STOPPED = "radar_stopped"
    # The radar is still armed after the last pulse.
    RADAR_WAITS = "radar_waits"
    # The Pi ended the row; `number` is the fault's in shared/polysight_shared/faults.py.
    PI_FAULT = "pi_fault"
    # The Pi did not report how the row ended.
    NO_END = "no_end"
    # Points or pulses are not as planned.
    COUNTS_DIFFER = "counts_differ"
    # No packet of the board came.
    NO_DATA = "no_data"
    # The row was held (paused by a command) so long that the cards ended their records.
    HELD = "held"
    # Frames are missing at known pulses.
    PULSES_MISSED = "pulses_missed"
    # There are as many frames as pulses, but not at the pulses' times.
    SLIPPED = "slipped"
    # Frames are missing at unknown pulses.
    FRAMES_MISSING = "frames_missing"
    # The card reports that it dropped data before numbering packets.
    CARD_DROPPED = "card_dropped"
    # Packets are missing, and the kernel dropped at least some of them.
    LOST_BY_HOST = "lost_by_host"
    # Packets are missing that never reached this machine.
    LOST_ON_THE_WAY = "lost_on_the_way"
    # Packets have equal counters and different bytes.
    CONFLICTING = "conflicting"
    # The place of the data in the row is uncertain.
    UNLOCATED = "unlocated"


@dataclass(frozen=True)
class TakeFault:
    """One fault of a take: a kind for programs, a text for people."""

    kind: FaultKind
    text: str
    # Name of the board; "" if the fault concerns the whole row.
    board: str = ""
    # The Pi's number of a `PI_FAULT`.
    number: int = 0

    def __str__(self) -> str:
        if self.board:
            return f"{self.board}: {self.text}"
        return self.text

    def to_row_fault(self) -> RowFault:
        """Return the fault as the manifest stores it."""
        return RowFault(str(self.kind), self.board, self.number)


ON_REQUEST = TakeFault(FaultKind.ON_REQUEST, "stop requested at the host")


def join_faults(faults: list[TakeFault]) -> str:
    """Join the faults to one sentence."""
    return "; ".join(map(str, faults))


@dataclass
class Take:
    """Data and events of one take, an attempt to record a row; dictionaries are by board."""

    row: Row
    # 1 for the first attempt.
    number: int
    # The Pi's report on the end of the row; None if there was none.
    finished: RowFinished | None = None
    # Results of reception; empty until the records have ended.
    captures: dict[str, RowCapture] = field(default_factory=dict)
    # Reason why the host aborted the row, or did not begin it.
    aborted: TakeFault | None = None
    # The Pi's events on bursts that it has sent, one for each position of the stage.
    events: list[pulse_times.ReceivedCapture] = field(default_factory=list)
    # Latest state of each radar.
    radars: dict[str, BoardState] = field(default_factory=dict)
    # Radars that did not confirm the end of all frames.
    not_done: list[str] = field(default_factory=list)
    # Pulse of each frame by arrival times, for boards of which it is certain how many frames came.
    frames: dict[str, pulse_times.PlacedFrames] = field(default_factory=dict)

    def faults(self, pulses_per_point: int) -> list[TakeFault]:
        """List the faults of this take; empty if it is complete."""
        faults = [
            TakeFault(FaultKind.RADAR_STOPPED, f"the radar has stopped: {s.detail}", name)
            for name, s in self.stopped_radars.items()
        ]
        if fault := self._find_fault_of_pi(self.row.points * pulses_per_point):
            faults.append(fault)
        faults += [
            TakeFault(FaultKind.RADAR_WAITS, "the radar still waits for pulses, it missed some", name)
            for name in self.not_done
        ]
        if self.aborted and not self.events:
            # Without pulses there is no data to judge.
            return faults
        board_faults = (
            self._find_board_fault(name, capture, pulses_per_point) for name, capture in self.captures.items()
        )
        return faults + [fault for fault in board_faults if fault is not None]

    def _find_fault_of_pi(self, pulses: int) -> TakeFault | None:
        """Return the fault that the Pi reported; None if the row was run as planned."""
        end = self.finished
        if end is None:
            return self.aborted or TakeFault(FaultKind.NO_END, "the Pi did not report how the row ended")
        if end.status != "done":
            text = f"the row ended as {end.status}: {end.reason or explain(end.fault).problem}"
            if self.aborted is not None and end.status == "aborted":
                return TakeFault(self.aborted.kind, text)
            return TakeFault(FaultKind.PI_FAULT, text, number=end.fault)
        if (end.points, end.pulses) != (self.row.points, pulses):
            text = f"{end.points} points and {end.pulses} pulses, {self.row.points} and {pulses} planned"
            return TakeFault(FaultKind.COUNTS_DIFFER, text)
        return None

    def find_displaced(self, name: str) -> pulse_times.PlacedFrames | None:
        """Return where a board's frames are if they are not at their pulses; None if they are, or it is unknown."""
        frames = self.frames.get(name)
        if frames is None or not frames.is_timed:
            return None
        if self.captures[name].slipped or frames.contradicted:
            return frames
        return None

    def _find_board_fault(self, name: str, capture: RowCapture, pulses_per_point: int) -> TakeFault | None:
        """Return the fault of one board's data; None if it is complete."""
        displaced = self.find_displaced(name)
        radar = self.radars.get(name, BoardState(RadarState.UNKNOWN))
        # `note` is not empty if the row was held.
        if self.note:
            held_text = "; the row was held, and a card ends its record after 2 s without data"
        else:
            held_text = ""
        if capture.counts.placed == 0:
            if radar.detail:
                detail = f"; its radar was {radar.detail}, and may not have obeyed"
            else:
                detail = ""
            return TakeFault(FaultKind.NO_DATA, f"no data: {capture.reason}{detail}", name)
        if displaced is not None:
            # `slots` has the pulse of each frame that came.
            if held_text:
                kind = FaultKind.HELD
            elif displaced.slots.size < displaced.pulses:
                kind = FaultKind.PULSES_MISSED
            else:
                kind = FaultKind.SLIPPED
            return TakeFault(kind, pulse_times.describe(displaced, pulses_per_point) + held_text, name)
        if not capture.located:
            # If several kinds are possible, the one with the clearest remedy is chosen; the text lists all that is
            # known.
            frames = self.frames.get(name)
            if frames is not None:
                unplaced = f"; missed pulses cannot be located: {frames.reason}"
            else:
                unplaced = ""
            waits_text = ""
            if radar.state is RadarState.ARMED:
                waits_text = "; the radar still waits for pulses"
                kind = FaultKind.RADAR_WAITS
            elif held_text:
                kind = FaultKind.HELD
            else:
                kind = _classify_unlocated(capture)
            return TakeFault(kind, capture.reason + unplaced + waits_text + held_text, name)
        if capture.counts.conflicting and capture.missing:
            text = f"{capture.counts.conflicting} packets have other bytes than packets with equal counters"
            return TakeFault(FaultKind.CONFLICTING, f"{text}; {capture.missing_bytes} bytes are masked", name)
        if capture.missing:
            text = (
                f"{capture.missing_bytes} bytes are missing in {len(capture.missing)} places"
                f" ({capture.kernel_drops} packets dropped by this machine)"
            )
            kind = FaultKind.LOST_BY_HOST if capture.kernel_drops > 0 else FaultKind.LOST_ON_THE_WAY
            return TakeFault(kind, text, name)
        return None

    @property
    def all_pulses_sent(self) -> bool:
        """True if the Pi sent every pulse of the row, so that only data can be missing."""
        return self.finished is not None and self.finished.status == "done"

    @property
    def note(self) -> str:
        """The Pi's remark on a completed row: that it was held on the way."""
        if self.finished is not None and self.all_pulses_sent:
            return self.finished.reason
        return ""

    @property
    def stopped_radars(self) -> dict[str, BoardState]:
        """Radars that stopped without a command."""
        return {name: s for name, s in self.radars.items() if s.state is RadarState.FAULT}

    @property
    def silent_boards(self) -> list[str]:
        """Boards without any data although bursts were sent."""
        return [n for n, c in self.captures.items() if c.counts.placed == 0 and (self.events or self.all_pulses_sent)]


def _classify_unlocated(capture: RowCapture) -> FaultKind:
    """Return why a board's data cannot be located in the row."""
    if capture.lost_before_packets:
        return FaultKind.CARD_DROPPED
    if capture.slipped:
        return FaultKind.FRAMES_MISSING
    return FaultKind.UNLOCATED


def commit_row(
    scan: ScanFolder, writer: ManifestWriter, take: Take, faults: list[TakeFault], events: LogDigest
) -> None:
    """Rename the row's files to their final names, durably, then add `row_committed` to the manifest.

    `events` is the digest of the event log, which must be on the disk. `faults` are those of a row kept incomplete;
    empty for a complete row. Raises DeviceError if the disk fails.
    """
    planned_frames = take.row.points * scan.instrument.burst.pulses
    boards: dict[str, BoardRow] = {}
    for name, capture in take.captures.items():
        final = scan.row_path(name, take.row.index)
        frames = take.frames.get(name)
        # Frames that must be moved to the pulse at which they arrived; None if the record is already in order.
        frames_to_move = pulse_times.find_frames_to_move(capture, frames)
        # Frames whose pulse is known only from their number, because their times could not be compared.
        untimed_frames = 0
        if capture.located and (frames is None or not frames.is_timed):
            untimed_frames = planned_frames
        missed_pulses = None
        if capture.slipped and frames is not None:
            missed_pulses = frames.pulses - frames.slots.size
        if frames_to_move is not None:
            capture = pulse_times.rewrite_row(
                final.with_suffix(PART_SUFFIX), capture, frames_to_move, scan.instrument.frame_bytes
            )
            take.captures[name] = capture
        try:
            final.with_suffix(PART_SUFFIX).rename(final)
        except OSError as e:
            raise make_write_error(final, "renamed", e) from None
        sync_folder(final.parent)
        packets_crc32 = ""
        if capture.packets_crc32:
            packets_crc32 = f"{capture.packets_crc32:08x}"
        boards[name] = BoardRow(
            file=str(final.relative_to(scan.path)),
            bytes=capture.expected,
            frames_expected=planned_frames,
            frames_received=int(valid_frames(capture.missing, planned_frames, scan.instrument.frame_bytes).sum()),
            missing_bytes=capture.missing_bytes,
            crc32=f"{capture.crc32:08x}",
            index_crc32=f"{capture.index_crc32:08x}",
            packets_crc32=packets_crc32,
            pulses_missed=missed_pulses,
            frames_untimed=untimed_frames,
            **_describe_reception(capture),
        )
    pulses = 0
    if take.finished:
        pulses = take.finished.pulses
    writer.append(
        RowCommitted(
            row=take.row.index,
            take=take.number,
            direction=take.row.direction,
            boards=boards,
            pulses=pulses,
            events=events,
            committed_utc=utc_now(),
            kept_incomplete=[str(f) for f in faults],
            faults=[f.to_row_fault() for f in faults],
            note=take.note,
        )
    )


def reject_row(scan: ScanFolder, writer: ManifestWriter, take: Take, faults: list[TakeFault]) -> None:
    """Delete the files of the take and add `row_rejected` with the faults to the manifest. Raises DeviceError."""
    for name in take.captures:
        path = scan.row_path(name, take.row.index)
        for suffix in (PART_SUFFIX, ".idx", PACKETS_SUFFIX):
            path.with_suffix(suffix).unlink(missing_ok=True)
    writer.append(
        RowRejected(
            row=take.row.index,
            take=take.number,
            reasons=[str(f) for f in faults],
            faults=[f.to_row_fault() for f in faults],
            boards={name: Reception(**_describe_reception(capture)) for name, capture in take.captures.items()},
            rejected_utc=utc_now(),
        )
    )


def _describe_reception(capture: RowCapture) -> dict[str, Any]:
    """Return the counts of `capture` under the names of the manifest, which differ for placed packets and bytes."""
    counts = {**msgspec.structs.asdict(capture), **vars(capture.counts), **vars(capture.losses)}
    known_counts = {kind: counts[kind] for kind in Reception.__struct_fields__ if kind in counts}
    return {**known_counts, "packets": capture.counts.placed, "received_bytes": capture.bytes}


def explain_incomplete_row(take: Take, faults: list[TakeFault], scan: ScanFolder, takes: int) -> ScanError:
    """Return the error for a row whose retakes are used up, with the likeliest cause."""
    cause = "packets are lost on the network or in this machine, or a board misses SYNC_IN pulses"
    remedy = "see the counts of row_rejected in the manifest; check cable, receive buffer and load"
    if take.stopped_radars:
        cause = "a radar has stopped without a command, or its connection is lost"
        remedy = "check its USB cable, its power and its SYNC_IN (docs/how-to/radar-bring-up.md)"
    elif take.silent_boards:
        silent = [
            explain_silent_radar(scan.instrument.by_name(name), take.captures[name]) for name in take.silent_boards
        ]
        states = [f"{n}'s radar was {take.radars[n].detail}" for n in take.silent_boards if n in take.radars]
        cause = "; ".join([f"{e.what}: {e.why}" for e in silent] + states)
        remedy = silent[0].remedy
    elif take.finished is not None and take.finished.fault:
        explained = explain(take.finished.fault)
        cause = explained.cause
        remedy = explained.remedy
    return ScanError(
        f"row {take.row.index} is not complete after {takes} takes: {join_faults(faults)}",
        cause,
        join_advice(
            remedy, f"then `polysight resume {quote(scan.path)}`; with --keep-incomplete it keeps such rows, masked"
        ),
        code=ErrorCode.ROW_INCOMPLETE,
    )


# Interval at which stop requests and timeouts are checked; chosen.
_POLL_MS = 50
# An aborted row ends as soon as the stage has braked; a Pi that is silent longer than this does not respond.
_ABORT_TIMEOUT_S = 10.0
# A row that is not on the disk after this time is reported, and again each time it passes; chosen.
_DISK_NOTICE_S = 2.0


class RowState(StrEnum):
    """State of a take."""

    # The stage, the disk or processing is not ready for the row.
    WAITING = "waiting"
    # The radars are made to wait for pulses, and the cards begin to record.
    ARMING = "arming"
    # The Pi moves the stage and sends pulses.
    RUNNING = "running"
    # The row was aborted; the stage brakes.
    ABORTING = "aborting"
    # Every pulse is sent; data is still on its way.
    COLLECTING = "collecting"
    # The records are stopped, and the files are made durable.
    WRITING = "writing"
    # The data is compared with the pulses.
    CHECKING = "checking"
    # The five states from here on are final. The row is complete and in the manifest.
    COMMITTED = "committed"
    # The row is in the manifest although it is incomplete.
    KEPT = "kept"
    # The files of the take were deleted.
    REJECTED = "rejected"
    # A stop was requested before the row began.
    STOPPED = "stopped"
    # An error ended the take.
    FAILED = "failed"


# States that may follow each state.
TRANSITIONS: dict[RowState, frozenset[RowState]] = {
    RowState.WAITING: frozenset({RowState.ARMING, RowState.STOPPED, RowState.FAILED}),
    RowState.ARMING: frozenset({RowState.RUNNING, RowState.WRITING, RowState.FAILED}),
    RowState.RUNNING: frozenset({RowState.COLLECTING, RowState.ABORTING, RowState.WRITING, RowState.FAILED}),
    RowState.ABORTING: frozenset({RowState.COLLECTING, RowState.WRITING, RowState.FAILED}),
    RowState.COLLECTING: frozenset({RowState.WRITING, RowState.FAILED}),
    RowState.WRITING: frozenset({RowState.CHECKING, RowState.FAILED}),
    RowState.CHECKING: frozenset({RowState.COMMITTED, RowState.KEPT, RowState.REJECTED, RowState.FAILED}),
    RowState.COMMITTED: frozenset(),
    RowState.KEPT: frozenset(),
    RowState.REJECTED: frozenset(),
    RowState.STOPPED: frozenset(),
    RowState.FAILED: frozenset(),
}


class RowTransaction:
    """State machine of one take; calls `on_state` with each state, including the first."""

    def __init__(self, on_state: Callable[[RowState], None]) -> None:
        self._on_state = on_state
        self.state = RowState.WAITING
        on_state(self.state)

    def change_state(self, state: RowState) -> None:
        """Change to a state. Raises ScanError if `TRANSITIONS` does not allow it, which is a bug."""
        if state not in TRANSITIONS[self.state]:
            raise ScanError(f"a row went from {self.state} to {state}", "a fault of this program", "report it")
        self.state = state
        self._on_state(state)

    def fail(self) -> None:
        """Change to `failed`, except from a final state."""
        if TRANSITIONS[self.state]:
            self.change_state(RowState.FAILED)


class RowTaker:
    """Record rows of scan `scan_id` into the scan folder `folder`, one at a time.

    `notify(phase, message)` reports delays, `on_point` the number of positions done. `stop` is read at every step.
    """

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
        self._instrument = instrument
        self._rig = rig
        self._radars = radars
        self._pi = pi
        self._scan_id = scan_id
        self._folder = folder
        self._stop = stop
        self._on_point = on_point
        self._notify = notify
        self._poller = zmq.Poller()
        self._poller.register(pi.event_socket, zmq.POLLIN)
        for part in (*rig.receivers.values(), *rig.cards.values()):
            self._poller.register(part.fileno(), zmq.POLLIN)

    def take(self, row: Row, number: int, transaction: RowTransaction) -> Take:
        """Run and receive a row; leaves `transaction` in `checking`.

        Raises PolysightError if the Pi, a card, a receiver or a radar does not respond.
        """
        take = Take(row, number)
        transaction.change_state(RowState.ARMING)
        self._radars.arm(row.points * self._instrument.burst.pulses)
        self._rig.begin_row(row.index, number, row.points, self._folder)
        take.radars = self._radars.states()
        if self._stop.now:
            take.aborted = ON_REQUEST
        elif take.stopped_radars:
            take.aborted = TakeFault(FaultKind.RADAR_STOPPED, "the row was not begun")
        else:
            transaction.change_state(RowState.RUNNING)
            self._radars.note_row_start()
            self._rig.discard_before(time.monotonic_ns())
            self._pi.run_row(self._scan_id, row.index, number)
            self._wait_for_row(take, transaction)
            if take.all_pulses_sent:
                transaction.change_state(RowState.COLLECTING)
                self._wait_for_data()
                take.not_done = self._radars.wait_done(self._instrument.limits.end_of_record_s)
        transaction.change_state(RowState.WRITING)
        self._end_records(take)
        take.radars = self._radars.states()
        if take.all_pulses_sent:
            self._time_frames(take)
        transaction.change_state(RowState.CHECKING)
        return take

    def _wait_for_row(self, take: Take, transaction: RowTransaction) -> None:
        """Wait until the Pi reports the row's end. Abort the row on request, or if its data cannot become complete.

        Raises ScanError if the row does not end in time.
        """
        limit_s = row_limit_s(self._instrument, take.row)
        deadline = time.monotonic() + limit_s
        silence = _SilenceCheck(self._instrument, self._rig)
        is_held = False
        while take.finished is None:
            # Check the time before reading: a message that came while this program was paused still counts.
            is_late = time.monotonic() > deadline
            self._poll(take)
            if take.finished is not None:
                return
            if take.aborted:
                fault = None
            elif self._stop.now:
                fault = ON_REQUEST
            else:
                fault = self._find_fatal_fault(take, silence)
            if fault is not None:
                take.aborted = fault
                deadline = time.monotonic() + _ABORT_TIMEOUT_S
                is_late = False
                transaction.change_state(RowState.ABORTING)
                self._pi.abort(fault.text)
            if self._pi.state in ("fault", "idle"):
                self._check_stopped(take)
            if self._pi.state == "held" and not take.aborted:
                # A held row has no timeout.
                deadline = time.monotonic() + limit_s
                is_late = False
                if not is_held:
                    self._notify("held", f"row {take.row.index} is held; send `Resume` from where `Hold` was sent")
                is_held = True
            if is_late:
                if take.aborted:
                    return
                raise ScanError(
                    f"row {take.row.index} did not end within {limit_s:.0f} s",
                    "the stage does not move, or the Pi's program hangs",
                    f"`journalctl -u polysight-pi -n 20` on the Pi, then `polysight resume {quote(self._folder)}`",
                    code=ErrorCode.NO_ANSWER,
                )

    def _find_fatal_fault(self, take: Take, silence: _SilenceCheck) -> TakeFault | None:
        """Update the radars' states; return a fault because of which the row cannot become complete, or None."""
        take.radars = self._radars.states()
        if stopped := take.stopped_radars:
            texts = (f"{name}: the radar has stopped: {s.detail}" for name, s in stopped.items())
            return TakeFault(FaultKind.RADAR_STOPPED, "; ".join(texts))
        if boards := silence.find_silent_boards(take.events):
            return TakeFault(FaultKind.NO_DATA, f"no data from {', '.join(boards)}")
        return None

    def _check_stopped(self, take: Take) -> None:
        """Raise ScanError if the Pi is in a fault or restarted, and its journal does not contain the row's end."""
        status = self._pi.status()
        if status.state not in ("fault", "idle"):
            # The last heartbeat was from before this row.
            return
        if status.scan_id == self._scan_id:
            self._pi.drain()
        self._collect(take)
        if take.finished is None and status.scan_id != self._scan_id:
            raise ScanError(
                f"the Pi's program restarted in row {take.row.index}",
                "power was lost there, or the program ended",
                f"`polysight resume {quote(self._folder)}`; why it ended: `journalctl -u polysight-pi` on the Pi",
                code=ErrorCode.STAGE_NOT_READY,
            )
        if take.finished is None:
            explanation = explain(status.fault)
            raise ScanError(
                f"the Pi stopped in row {take.row.index}: {explanation.problem}: {status.reason}",
                explanation.cause,
                f"{explanation.remedy}, then `polysight resume {quote(self._folder)}`",
                code=ErrorCode.STAGE_NOT_READY,
            )

    def _poll(self, take: Take) -> None:
        """Wait for messages of the Pi, the cards and the receivers, and read all of them."""
        self._poller.poll(_POLL_MS)
        # Asking for the state reads the messages of cards and receivers.
        self._rig.statuses()
        _ = self._rig.complete
        self._collect(take)

    def _collect(self, take: Take) -> None:
        """Keep the Pi's events of this take; those of other rows and takes are ignored."""
        for event in self._pi.events():
            if isinstance(event, Capture) and (event.row_index, event.take) == (take.row.index, take.number):
                take.events.append(pulse_times.ReceivedCapture(event, time.monotonic_ns()))
                self._on_point(event.point + 1)
            elif isinstance(event, RowFinished) and (event.row_index, event.take) == (take.row.index, take.number):
                take.finished = event

    def _wait_for_data(self) -> None:
        """Wait until every board's data is complete, or its record has ended."""
        finished_ns = time.monotonic_ns()
        limit_ns = int(self._instrument.limits.end_of_record_s * NS_PER_S)
        while not self._rig.complete and not self._stop.now:
            self._poller.poll(_POLL_MS)
            now = time.monotonic_ns()
            statuses = self._rig.statuses()
            reports = self._rig.reports()
            if all(has_record_ended(r, statuses[n], finished_ns, now, limit_ns) for n, r in reports.items()):
                return

    def _end_records(self, take: Take) -> None:
        """Stop the records and make the rows durable; notify while a slow disk delays this."""
        started_s = time.monotonic()
        with ThreadPoolExecutor(1, thread_name_prefix="disk") as executor:
            ending = executor.submit(self._rig.end_row, pulse_times.time_before_first_pulse_ns(take.events) or 0)
            while not wait([ending], _DISK_NOTICE_S).done:
                waited_s = time.monotonic() - started_s
                self._notify("wait", f"row {take.row.index} is not written after {waited_s:.0f} s: the disk is slow")
            take.captures = ending.result()

    def _time_frames(self, take: Take) -> None:
        """Compare frames and pulses of boards of which it is certain how many frames came; every pulse was sent."""
        for name, capture in take.captures.items():
            path = self._folder / "raw" / name / f"{take.row.index:04d}{PART_SUFFIX}"
            if capture.located or capture.slipped:
                take.frames[name] = pulse_times.find_frames(path, take.row, take.events, self._instrument)
                if take.frames[name].contradicted:
                    # The radar may have sent more frames than came: the end of the record may be lost.
                    self._rig.reset_before_next_row(name)


class _SilenceCheck:
    """Finds boards that send no data long after bursts were sent: their radars are not armed."""

    def __init__(self, instrument: Instrument, rig: CaptureRig) -> None:
        self._rig = rig
        self._limit_ns = int(instrument.limits.end_of_record_s * NS_PER_S)
        burst_bytes = instrument.burst.pulses * instrument.frame_bytes
        # A card sends a packet only when it is full: silence counts only after bursts that fill two packets. Their
        # number is rounded up.
        self._bursts = -(-2 * instrument.card.packet_bytes // burst_bytes)
        # Time of the last check, monotonic clock.
        self._checked_ns = 0
        # True once every board has sent data: nothing is left to check.
        self._all_heard = False

    def find_silent_boards(self, events: list[pulse_times.ReceivedCapture]) -> list[str]:
        """Return the boards without a byte `end_of_record_s` after enough bursts; checked once in that time."""
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
    """Return the timeout of a row: one minute plus four times the travel to it and along it.

    It is generous on purpose (chosen): only a stage that stands still or a Pi that hangs is to reach it.
    """
    stage = instrument.stage
    travel_s = (stage.travel_x_mm + stage.travel_y_mm) / stage.travel_speed_mm_s
    return 60.0 + 4 * (travel_s + abs(row.step_mm) * row.points / stage.speed_mm_s)
