"""Capture cards and receiver processes of all recorded boards.

`CaptureRig` starts and stops the records of a row; `has_record_ended` decides if one board's record has ended.
"""

from __future__ import annotations

import time
from collections.abc import Collection
from contextlib import ExitStack, suppress
from pathlib import Path

from msgspec.structs import replace

from polysight.capture import (
    CardClient,
    Progress,
    ReceiverProcess,
    RowCapture,
    Status,
    Version,
    check_receive_buffer,
    receiver_cores,
)
from polysight.store import PART_SUFFIX
from polysight_shared.closing import Closing
from polysight_shared.config import CARD_TAIL_S, Instrument
from polysight_shared.errors import PolysightError

GRACE_NS = 200_000_000
"""Silence after which a record that the card reported as completed has ended: status and data use different ports.
Chosen."""
# Timeout from a record's stop to its last packet and its status; chosen.
_COMPLETED_TIMEOUT_S = 0.2


def has_record_ended(progress: Progress, status: Status, since_ns: int, now_ns: int, silence_ns: int) -> bool:
    """Return True if one board's record has ended: every byte has arrived, or none has arrived for long enough.

    That is `silence_ns`, or `GRACE_NS` if the card reported the end. `progress` is the receiver's latest report,
    `status` what the card reported since the record started. The silence counts from the last packet or from `since_ns`
    (when the row had ended), whichever is later, to `now_ns`, all on the monotonic clock.
    """
    silent_ns = now_ns - max(progress.last_arrival_ns, since_ns)
    # The card reports the end by a short last packet, or by its status.
    reported = progress.ended or Status.RECORD_COMPLETED in status
    if reported:
        silence_ns = min(GRACE_NS, silence_ns)
    return progress.complete or silent_ns >= silence_ns


class CaptureRig(Closing):
    """Cards and receivers of the recorded boards, by board name; a record is what a card sends from start to stop.

    `warnings` lists what differs from the request but suffices to scan. Raises DeviceError if a port is in use, or the
    receive buffer is smaller than two bursts.
    """

    def __init__(self, instrument: Instrument) -> None:
        self._instrument = instrument
        self.warnings: list[str] = []
        self.cards: dict[str, CardClient] = {}
        self.receivers: dict[str, ReceiverProcess] = {}
        self._recording = False
        # Boards whose card has an unknown packet count: it is reset before the next row.
        self._start_lost = {board.name for board in instrument.recorded}
        with ExitStack() as stack:
            for board in instrument.recorded:
                card = CardClient(board, instrument.limits.command_timeout_s)
                self.cards[board.name] = stack.enter_context(card)
            requested = instrument.card.receive_buffer_bytes
            burst_bytes = instrument.burst.pulses * instrument.frame_bytes
            cores = receiver_cores(len(instrument.recorded))
            for board, core in zip(instrument.recorded, cores, strict=True):
                receiver = stack.enter_context(ReceiverProcess(board, requested, core))
                self.receivers[board.name] = receiver
                self.warnings += receiver.warnings
                if warning := check_receive_buffer(board.name, receiver.granted_bytes, requested, burst_bytes):
                    self.warnings.append(warning)
            if (silence_s := instrument.limits.end_of_record_s) <= CARD_TAIL_S:
                self.warnings.append(
                    f"limits.end_of_record_s is {silence_s:g}: a card sends the last packet after {CARD_TAIL_S:g} s of"
                    " silence or when the record is stopped, but possibly not every card sends it when stopped; 3 s "
                    "is safe"
                )
            self._stack = stack.pop_all()

    def configure(self, names: Collection[str] = ()) -> dict[str, Version]:
        """Stop records and configure the named cards (default: all); return FPGA versions.

        Raises DeviceError if a card does not obey; if all cards are configured, also if two cards have the same
        address.
        """
        versions = {}
        for name in names or self.cards:
            card = self.cards[name]
            card.check_alive()
            if not names:
                card.require_alone()
            card.record_stop()
            card.configure(self._instrument.card)
            versions[name] = card.read_version()
        return versions

    def begin_row(self, row: int, take: int, points: int, folder: Path) -> None:
        """Prepare the receivers for a row of `points` positions, then start the records. Raises DeviceError.

        `take` is the number of this attempt, `folder` the scan folder. A card whose counters are not known is reset and
        configured first: it then counts from its first counters. During reception the file's suffix is `PART_SUFFIX`.
        """
        frame_bytes = self._instrument.frame_bytes
        expected_bytes = points * self._instrument.burst.pulses * frame_bytes
        cards_to_reset = set(self._start_lost)
        for name in cards_to_reset:
            self.cards[name].reset_fpga()
            self.configure([name])
        for name, receiver in self.receivers.items():
            path = folder / "raw" / name / f"{row:04d}{PART_SUFFIX}"
            receiver.begin_row(row, take, expected_bytes, frame_bytes, path, after_reset=name in cards_to_reset)
            # If the row is interrupted, the card's count stays unknown; `end_row` removes the name otherwise.
            self._start_lost.add(name)
        self._recording = True
        for card in self.cards.values():
            card.record_start()

    def reset_before_next_row(self, name: str) -> None:
        """Reset this card before the next row: it is uncertain where its last record ended."""
        self._start_lost.add(name)

    @property
    def complete(self) -> bool:
        """True if every expected byte of the row has arrived, on every board."""
        # Poll every receiver, also those after an incomplete one: only polling notices a dead process.
        reports = [receiver.poll() for receiver in self.receivers.values()]
        return all(progress.complete for progress in reports)

    def reports(self) -> dict[str, Progress]:
        """Request the progress of every board's receiver."""
        return {name: receiver.report() for name, receiver in self.receivers.items()}

    def statuses(self) -> dict[str, Status]:
        """Return the status bits that each card reported since its record start; they stay for the next call."""
        return {name: card.take_status() for name, card in self.cards.items()}

    def discard_before(self, time_ns: int) -> None:
        """Treat data that arrived before this time (monotonic clock) as left over from an earlier record."""
        for receiver in self.receivers.values():
            # The request for progress carries this time; its answer is not needed.
            receiver.report(time_ns)

    def end_row(self, not_before_ns: int = 0) -> dict[str, RowCapture]:
        """Stop the records and return the rows, whose files are durable then. Raises DeviceError.

        Data before `not_before_ns` is left over, as in :meth:`discard_before`; of both times the later one counts.
        """
        self.stop_records()
        deadline = time.monotonic() + _COMPLETED_TIMEOUT_S
        for name, receiver in self.receivers.items():
            # A complete row gets no more data: only others need the wait.
            if not receiver.poll().complete:
                self.cards[name].wait_completed(max(0.0, deadline - time.monotonic()))
        statuses = self.statuses()
        rows = {
            name: replace(receiver.end_row(statuses[name], not_before_ns), card_mac=self.cards[name].mac)
            for name, receiver in self.receivers.items()
        }
        self._start_lost = {name for name, row in rows.items() if row.start_lost}
        return rows

    def stop_records(self) -> None:
        """Stop all records. Raises DeviceError."""
        for card in self.cards.values():
            card.record_stop()
        self._recording = False

    def close(self) -> None:
        """Stop records of cards that still reply, end the receiver processes, close the sockets. Safe to repeat."""
        if self._recording:
            self._recording = False
            for card in self.cards.values():
                with suppress(PolysightError):
                    card.record_stop()
        self._stack.close()
