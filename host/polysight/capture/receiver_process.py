"""Receiver process of one card: `python -m polysight.capture.receiver_process FD`.

It is a separate process, so that processing in the host cannot delay reception. It waits in one poll() for requests on
the inherited socket FD and for the card's data, and ends when the socket closes, which happens at the latest when the
host ends. A *take* is one attempt to record a row. A *record* is what the card sends between start and stop; each take
has a record of its own.
"""

from __future__ import annotations

import contextlib
import select
import signal
import socket
import sys
import time
from multiprocessing.connection import Connection
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from polysight.capture import receiver as messages
from polysight.capture.dca1000 import LOST_BEFORE_PACKETS, PacketLog, Status
from polysight.capture.network import BatchReceiver, bind_udp, count_kernel_drops, enlarge_receive_buffer
from polysight.capture.placement import EarlierRecords, Evidence, Preview, place_record, preview
from polysight.capture.receiver import take_core, take_priority
from polysight.capture.row_files import PACKETS_SUFFIX, Segment, write_index, write_packets
from polysight_shared.errors import DeviceError, PolysightError

# Batches fetched before requests are checked again (chosen): they hold more packets than a receive buffer of 8 MiB.
_MAX_BATCHES = 64
# Pause after a preview, in units of the time that this preview took: previews take a twentieth of the time at most.
_PAUSE_PER_PREVIEW = 20
# Remedy where requests came in a wrong order: that is an error of this program, not of the user.
_RESTART_REMEDY = "start the scan again"
# Pause after each reception in which packets gather in the kernel's buffer: fewer, larger batches (chosen).
_GATHER_MS = 1


class _Row:
    """A row during reception."""

    def __init__(self, request: messages.BeginRow, segment: Segment, log: PacketLog, past: EarlierRecords) -> None:
        self.request = request
        self.segment = segment
        self.log = log
        self.past = past
        # Number of packets from between rows that were dropped when this row began.
        self.stale = 0
        # Counts of the socket when the row began: packets from other addresses, packets dropped by the kernel.
        self.strangers = 0
        self.drops = 0
        # Time before the first pulse of the row, monotonic clock; 0 while it is unknown.
        self.not_before_ns = 0
        # The last notice to the host: whether all frames were complete, and whether the record had ended.
        self._reported = (False, False)
        # Number of packets at the last preview.
        self._previewed = 0
        self._next_preview_ns = 0
        self._preview = Preview(0, request.expected_bytes == 0, ended=False)

    def has_news(self) -> bool:
        """True if the host must be notified: the row has become complete, or its last packet came.

        Previews the row only if it may have ended, packets came since, and the pause after the last preview is over.
        """
        log = self.log
        if log.payload_bytes < log.expected and not log.last_is_short:
            return False
        began_ns = time.monotonic_ns()
        if log.count == self._previewed or began_ns < self._next_preview_ns:
            return False
        self._update()
        ended_ns = time.monotonic_ns()
        self._next_preview_ns = ended_ns + _PAUSE_PER_PREVIEW * (ended_ns - began_ns)
        last_reported = self._reported
        self._reported = (self._preview.complete, self._preview.ended)
        return self._reported != last_reported and any(self._reported)

    def progress(self) -> messages.Progress:
        """Return the progress of the row by the packets so far."""
        self._update()
        return messages.Progress(
            row=self.request.row,
            take=self.request.take,
            received=self._preview.received,
            complete=self._preview.complete,
            last_arrival_ns=self.log.last_arrival_ns,
            ended=self._preview.ended,
        )

    def _update(self) -> None:
        """Preview the row again if packets came since the last preview."""
        if self.log.count != self._previewed:
            self._previewed = self.log.count
            self._preview = preview(self.log, self.past, self.not_before_ns)


class Receiver:
    """Serves one card until the host closes the connection."""

    def __init__(self, connection: Connection) -> None:
        self._connection = connection
        self._socket: socket.socket | None = None
        self._batches: BatchReceiver | None = None
        self._row: _Row | None = None
        # Knowledge of the card from earlier records.
        self._past = EarlierRecords()
        # Memory of the previous row, which the next one reuses.
        self._memory: NDArray[np.uint8] | None = None

    def serve(self) -> None:
        """Answer requests and receive until the connection closes."""
        poll = select.poll()
        requests = select.poll()
        poll.register(self._connection.fileno(), select.POLLIN)
        requests.register(self._connection.fileno(), select.POLLIN)
        while True:
            ready = dict(poll.poll())
            if self._socket is not None and self._socket.fileno() in ready and self._row is not None:
                self._receive()
                # A pause, which a request ends.
                requests.poll(_GATHER_MS)
            if self._connection.fileno() in ready:
                try:
                    request = messages.next_request(self._connection)
                except (EOFError, OSError):
                    break
                try:
                    answer = self._answer(request)
                except PolysightError as e:
                    answer = messages.Failed(e.what, e.why, e.remedy, e.code)
                messages.send(self._connection, answer)
                # Between rows the socket is not polled: stray packets wait there until the next row drops them.
                if self._socket is not None and self._row is not None:
                    poll.register(self._socket.fileno(), select.POLLIN)
                elif self._socket is not None:
                    with contextlib.suppress(KeyError):
                        poll.unregister(self._socket.fileno())
        if self._row is not None:
            self._row.segment.discard()

    def _answer(self, request: messages.Request) -> messages.Answer:
        """Execute a request and return the answer; between rows the progress is that of no row (-1)."""
        if isinstance(request, messages.Open):
            return self._open(request)
        if isinstance(request, messages.BeginRow):
            return self._begin(request)
        if isinstance(request, messages.EndRow):
            return self._end(request)
        # A `Report`: the request for the progress.
        if self._row is None:
            return messages.Progress(row=-1, take=0, received=0, complete=False, last_arrival_ns=0)
        self._row.not_before_ns = request.not_before_ns or self._row.not_before_ns
        return self._row.progress()

    def _open(self, request: messages.Open) -> messages.Answer:
        """Bind the data socket, enlarge its buffer, and take priority and core as far as the system permits."""
        self._socket = bind_udp(request.host_address, request.data_port, f"{request.board} data")
        granted = enlarge_receive_buffer(self._socket, request.buffer_bytes)
        self._batches = BatchReceiver(self._socket, request.card_address)
        priority, priority_warning = take_priority()
        core, core_warning = take_core(request.core, request.own_core, urgent=not priority_warning)
        scheduling = f"{'any core' if core is None else f'core {core}'}, {priority}"
        port = self._socket.getsockname()[1]
        return messages.Opened(
            granted, port, scheduling, [warning for warning in (core_warning, priority_warning) if warning]
        )

    def _begin(self, request: messages.BeginRow) -> messages.Answer:
        """Begin a row: reserve its file and memory, and drop packets from between rows.

        Raises DeviceError if no socket is open, or the row is larger than memory.
        """
        if self._socket is None or self._batches is None:
            raise DeviceError(
                "the receiver has no socket yet", "a row began before the cards were opened", _RESTART_REMEDY
            )
        if self._row is not None:
            self._discard()
        segment = Segment(Path(request.path), request.expected_bytes)
        try:
            log = PacketLog(request.expected_bytes, self._memory)
        except MemoryError:
            segment.discard()
            problem = f"{request.path}: no memory for a row of {request.expected_bytes} bytes"
            remedy = "scan shorter rows, or fewer pulses"
            raise DeviceError(problem, "the row is larger than memory", remedy) from None
        strays = PacketLog(0)
        for n in self._batches.receive_all():
            strays.add(self._batches.packets[:n], self._batches.lengths[:n], 0)
        if request.after_reset:
            self._past = EarlierRecords.after_reset()
        self._row = row = _Row(request, segment, log, self._past)
        row.stale = strays.count + strays.malformed
        row.strangers = self._batches.strangers
        row.drops = count_kernel_drops(self._socket)
        return messages.Began(row.stale)

    def _discard(self) -> None:
        """Discard the row; the end of its record is unknown then."""
        if self._row is not None:
            self._row.segment.discard()
        self._row = None
        self._past = EarlierRecords()

    def _receive(self) -> None:
        """Log the packets that wait at the socket, at most `_MAX_BATCHES` batches; send progress if there is news."""
        row = self._row
        batches = self._batches
        if row is None or batches is None:
            return
        for _ in range(_MAX_BATCHES):
            self._log(row, batches, batches.receive())
            if batches.is_drained:
                break
        if row.has_news():
            messages.send(self._connection, row.progress())

    @staticmethod
    def _log(row: _Row, batches: BatchReceiver, n: int) -> None:
        """Log the first `n` packets of the last batch."""
        row.log.add(batches.packets[:n], batches.lengths[:n], batches.times_ns[:n])

    def _end(self, request: messages.EndRow) -> messages.Answer:
        """End the row: place its packets, and write payload, index and packets. Raises DeviceError without a row."""
        row = self._row
        if row is None or self._socket is None or self._batches is None:
            raise DeviceError("no row is being received", "a row ended that had not begun", _RESTART_REMEDY)
        for n in self._batches.receive_all():
            self._log(row, self._batches, n)
        self._row = None
        begin_request = row.request
        log = row.log
        path = Path(row.request.path)
        # Names of the status bits by which the card reports data lost before its packets were numbered.
        loss_bits = (Status(request.card_status) & LOST_BEFORE_PACKETS).name or ""
        not_before_ns = max(request.not_before_ns, row.not_before_ns)
        evidence = Evidence(begin_request.expected_bytes, begin_request.frame_bytes, not_before_ns, loss_bits, row.past)
        placed, payload = place_record(log, begin_request.frame_bytes, row.past, not_before_ns, loss_bits)
        self._past = placed.past
        self._memory = log.payload
        crc = row.segment.finish(payload)
        facts = {
            "row": begin_request.row,
            "take": begin_request.take,
            **placed.facts(),
            "card_status": request.card_status,
        }
        index_crc = write_index(path.with_suffix(".idx"), facts, placed.arrivals)
        arrivals = placed.arrivals
        first_arrival_ns = 0
        last_arrival_ns = 0
        if arrivals.size:
            first_arrival_ns = int(arrivals[0, 0])
            last_arrival_ns = int(arrivals[-1, 0])
        return messages.RowCapture(
            row=begin_request.row,
            take=begin_request.take,
            expected=placed.expected,
            bytes=placed.received,
            missing=placed.missing,
            located=placed.located,
            reason=placed.reason,
            counts=placed.counts,
            losses=placed.losses,
            strangers=self._batches.strangers - row.strangers,
            stale=row.stale,
            kernel_drops=count_kernel_drops(self._socket) - row.drops,
            first_arrival_ns=first_arrival_ns,
            last_arrival_ns=last_arrival_ns,
            crc32=crc,
            index_crc32=index_crc,
            packets_crc32=write_packets(path.with_suffix(PACKETS_SUFFIX), log, evidence, placed),
            card_status=request.card_status,
            holes=placed.holes,
            slipped=placed.slipped,
            start_lost=placed.past.lost,
        )


def main(argv: list[str]) -> int:
    """Run the receiver on the inherited socket; its descriptor is the only argument."""
    # The host decides when a row ends.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    with Connection(int(argv[1])) as connection:
        try:
            Receiver(connection).serve()
        except PolysightError as e:
            # The host program may have ended already.
            with contextlib.suppress(DeviceError):
                messages.send(connection, messages.Failed(e.what, e.why, e.remedy, e.code))
            return e.exit_status
    return 0


if __name__ == "__main__":
    raise SystemExit(main(sys.argv))
