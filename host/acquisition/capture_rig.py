"""All recorded boards at once: their cards and their receiving processes.

`CaptureRig` starts and stops the records of a row; `record_ending` decides when one board's record has ended.
"""

from __future__ import annotations

import time
from collections.abc import Collection
from contextlib import ExitStack, suppress
from enum import Enum
from pathlib import Path
from types import TracebackType

from polysight.host.capture import (
    CardClient,
    Progress,
    ReceiverProcess,
    RowCapture,
    Status,
    Version,
    check_receive_buffer,
    receiver_cores,
)
from polysight.host.store import PART
from polysight.shared.config import Instrument
from polysight.shared.errors import PolysightError

TAIL_S = 2.0
"""Silence after which a card sends what does not fill a packet (seen)."""
GRACE_NS = 200_000_000
"""Silence after which nothing comes any more, once the card said so: status and data come on different ports."""
_COMPLETED_LIMIT_S = 0.2  # from a record's stop to its last packet and its status


class Ending(Enum):
    """Why a record counts as ended."""

    BYTES = "every expected byte is there"
    STATUS = "the card reports the record as completed"
    TAIL = "the record's short last packet came"
    SILENCE = "nothing came any more"


def record_ending(progress: Progress, status: Status, since_ns: int, now_ns: int, silence_ns: int) -> Ending | None:
    """Why one board's record has ended, or None while it has not; whichever is first.

    Parameters
    ----------
    progress
        What its receiver said last.
    status
        What its card reported by itself since the record started.
    since_ns, now_ns
        When the last pulse was sent, and now, on the monotonic clock.
    silence_ns
        Silence that ends a record by itself. The card sends its short last packet after 2 s of it (seen).
    """
    if progress.complete:
        return Ending.BYTES
    silent_ns = now_ns - max(progress.last_arrival_ns, since_ns)
    if silent_ns >= GRACE_NS and Status.RECORD_COMPLETED in status:
        return Ending.STATUS
    if silent_ns >= GRACE_NS and progress.ended:
        return Ending.TAIL
    return Ending.SILENCE if silent_ns >= silence_ns else None


class CaptureRig:
    """Cards and receivers of the boards that are recorded.

    Attributes
    ----------
    warnings
        What is not as asked, but good enough to scan.

    Raises
    ------
    DeviceError
        when a port is in use, or the receive buffer is too small for two bursts.
    """

    def __init__(self, instrument: Instrument) -> None:
        self._instrument = instrument
        self.warnings: list[str] = []
        self.cards: dict[str, CardClient] = {}
        self.receivers: dict[str, ReceiverProcess] = {}
        self._recording = False
        self._stack = ExitStack()
        with ExitStack() as stack:
            for board in instrument.recorded:
                card = CardClient(board, instrument.limits.command_timeout_s)
                self.cards[board.name] = stack.enter_context(card)
            wanted, burst_bytes = instrument.card.receive_buffer_bytes, instrument.burst.pulses * instrument.frame_bytes
            cores = receiver_cores(len(instrument.recorded))
            for board, core in zip(instrument.recorded, cores, strict=True):
                receiver = stack.enter_context(ReceiverProcess(board, wanted, core))
                self.receivers[board.name] = receiver
                self.warnings += receiver.warnings
                if warning := check_receive_buffer(board.name, receiver.granted_bytes, wanted, burst_bytes):
                    self.warnings.append(warning)
            if (silence_s := instrument.limits.end_of_record_s) <= TAIL_S:
                self.warnings.append(
                    f"limits.end_of_record_s is {silence_s:g}: a card sends the last packet after {TAIL_S:g} s of"
                    " silence, or at the record's stop, but not every card may do the latter; 3 s is safe"
                )
            self._stack = stack.pop_all()

    def configure(self, names: Collection[str] = ()) -> dict[str, Version]:
        """Set cards up, all unless named, and stop what they may record; returns FPGA versions. Raises DeviceError."""
        found = {}
        for name in names or self.cards:
            card = self.cards[name]
            card.alive()
            card.record_stop()
            card.configure(self._instrument.card)
            found[name] = card.version()
        return found

    def begin_row(self, row: int, take: int, points: int, folder: Path) -> None:
        """Arm the receivers, then start the records. Raises DeviceError."""
        frame_bytes = self._instrument.frame_bytes
        expected = points * self._instrument.burst.pulses * frame_bytes
        for name, receiver in self.receivers.items():
            receiver.begin_row(row, take, expected, frame_bytes, folder / "raw" / name / f"{row:04d}{PART}")
        self._recording = True
        for card in self.cards.values():
            card.record_start()

    @property
    def complete(self) -> bool:
        """Whether every expected byte of the row is there, on every board."""
        # Each one is asked, also behind one that is not complete: a process that died is noticed by asking.
        found = [receiver.poll() for receiver in self.receivers.values()]
        return all(progress.complete for progress in found)

    def reports(self) -> dict[str, Progress]:
        """How far the row is on every board, asked for."""
        return {name: receiver.report() for name, receiver in self.receivers.items()}

    def statuses(self) -> dict[str, Status]:
        """Status bits each card reported since its record start."""
        return {name: card.take_status() for name, card in self.cards.items()}

    def row_runs(self, not_before_ns: int) -> None:
        """No pulse of the row was sent before this time (monotonic clock): what came earlier is left over."""
        for receiver in self.receivers.values():
            receiver.report(not_before_ns)

    def end_row(self, not_before_ns: int = 0) -> dict[str, RowCapture]:
        """Stop the records and take the rows: their files are durable when this returns. Raises DeviceError.

        `not_before_ns` as in :meth:`row_runs`, known better by now.
        """
        self.stop_records()
        deadline = time.monotonic() + _COMPLETED_LIMIT_S
        for name, receiver in self.receivers.items():
            if not receiver.poll().complete:  # of a complete row nothing can follow
                self.cards[name].wait_completed(max(0.0, deadline - time.monotonic()))
        statuses = self.statuses()
        return {name: receiver.end_row(statuses[name], not_before_ns) for name, receiver in self.receivers.items()}

    def stop_records(self) -> None:
        """Stop all records. Raises DeviceError."""
        for card in self.cards.values():
            card.record_stop()
        self._recording = False

    def close(self) -> None:
        """Stop recording where the cards still listen, end the processes, close the sockets. Twice is once."""
        if self._recording:
            self._recording = False
            for card in self.cards.values():
                with suppress(PolysightError):
                    card.record_stop()
        self._stack.close()

    def __enter__(self) -> CaptureRig:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()
