"""The receiving process of one card: `python -m polysight.host.capture.receiver_process FD`.

A process of its own, so that imaging in the host never starves it. It obeys requests on the inherited socket FD, sits
in one poll() over that and the card's data, and ends when the host does, because then the socket closes.
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

from polysight.host.capture import receiver as words
from polysight.host.capture.dca1000 import LOST_BEFORE_PACKETS, MAX_PAYLOAD_BYTES, Counters, Status
from polysight.host.capture.network import BatchReceiver, bind_udp, enlarge_receive_buffer, kernel_drops
from polysight.host.capture.placement import Placement
from polysight.host.capture.scheduling import take_core, take_priority
from polysight.host.capture.segment import Segment, write_index
from polysight.shared.errors import DeviceError, PolysightError

_MAX_BATCHES = 64  # batches fetched before the pipe is looked at again
_GATHER_MS = 1  # packets gather in the kernel's buffer meanwhile: fewer, fuller batches


class _Row:
    """The row that is being received."""

    def __init__(
        self,
        request: words.BeginRow,
        segment: Segment,
        start: Counters | None,
        stale: int,
        strangers: int,
        drops: int,
    ) -> None:
        self.request, self.segment = request, segment
        self.stale, self.strangers, self.drops = stale, strangers, drops
        self.placement = Placement(self.segment.data, request.frame_bytes, start)
        self._arrivals = np.zeros((2 * request.expected_bytes // MAX_PAYLOAD_BYTES + 256, 2), dtype=np.int64)
        self._noted = 0
        self._quiet_ns = 0  # when the socket was last found empty since the last batch
        self._told = (False, False)

    def note_arrival(self) -> None:
        """Write down when the packets just placed came, and up to which byte the row is there.

        Before it, when the socket was last found empty: these packets came later than that.
        """
        if self.placement.forgotten:
            self._noted, self.placement.forgotten = 0, False
        if self._noted + 2 > len(self._arrivals):
            self._arrivals = np.concatenate([self._arrivals, np.zeros_like(self._arrivals)])
        if self._quiet_ns and self._noted:
            self._arrivals[self._noted] = self._quiet_ns, self._arrivals[self._noted - 1, 1]
            self._noted += 1
        self._quiet_ns = 0
        self._arrivals[self._noted] = time.monotonic_ns(), self.placement.extent
        self._noted += 1

    def note_quiet(self, looked_ns: int) -> None:
        """Nothing waited in the socket at this time."""
        self._quiet_ns = looked_ns

    @property
    def arrivals(self) -> NDArray[np.int64]:
        """int64 [n, 2]: time (monotonic, ns), bytes. Where the bytes do not grow, the socket was found empty then."""
        return self._arrivals[: self._noted]

    def news(self) -> bool:
        """Whether there is something to tell the host unasked."""
        told, self._told = self._told, (self.placement.complete, self.placement.ended)
        return self._told != told and any(self._told)

    def progress(self) -> words.Progress:
        p, r = self.placement, self.request
        last = int(self.arrivals[-1, 0]) if self._noted else 0
        return words.Progress(r.row, r.take, p.received, p.complete, last, p.ended)


class Receiver:
    """Serves one card until the host closes the connection."""

    def __init__(self, connection: Connection) -> None:
        self._connection = connection
        self._socket: socket.socket | None = None
        self._batches: BatchReceiver | None = None
        self._row: _Row | None = None
        self._start: Counters | None = None  # where the card's next record should start
        self._memory: NDArray[np.uint8] | None = None  # of the row before, taken again

    def serve(self) -> None:
        """Obey requests and receive until the connection closes."""
        poll, requests = select.poll(), select.poll()
        poll.register(self._connection.fileno(), select.POLLIN)
        requests.register(self._connection.fileno(), select.POLLIN)
        while True:
            ready = dict(poll.poll())
            if self._socket is not None and self._socket.fileno() in ready and self._row is not None:
                self._receive()
                requests.poll(_GATHER_MS)
            if self._connection.fileno() in ready:
                try:
                    request = words.next_request(self._connection)
                except (EOFError, OSError):
                    break
                try:
                    answer = self._obey(request)
                except PolysightError as e:
                    answer = words.Failed(e.what, e.why, e.remedy)
                words.send(self._connection, answer)
                # Between rows the socket is not watched: stray packets wait there until the next row drops them.
                if self._socket is not None and self._row is not None:
                    poll.register(self._socket.fileno(), select.POLLIN)
                elif self._socket is not None:
                    with contextlib.suppress(KeyError):
                        poll.unregister(self._socket.fileno())
        if self._row is not None:
            self._row.segment.discard()

    def _obey(self, request: words.Request) -> words.Answer:
        if isinstance(request, words.Open):
            return self._open(request)
        if isinstance(request, words.BeginRow):
            return self._begin(request)
        if isinstance(request, words.EndRow):
            return self._end(Status(request.card_status))
        if isinstance(request, words.Discard):
            if self._row is not None:
                self._row.segment.discard()
                self._row, self._start = None, None
            return words.Discarded()
        return self._row.progress() if self._row is not None else words.Progress(-1, 0, 0, False, 0)

    def _open(self, request: words.Open) -> words.Answer:
        self._socket = bind_udp(request.host_address, request.data_port, f"{request.board} data")
        granted = enlarge_receive_buffer(self._socket, request.buffer_bytes)
        self._batches = BatchReceiver(self._socket, request.card_address)
        core, unpinned = take_core(request.core)
        priority, ordinary = take_priority()  # capture goes before processing where the system allows it
        scheduling = f"{'any core' if core is None else f'core {core}'}, {priority}"
        port = self._socket.getsockname()[1]
        return words.Opened(granted, port, scheduling, [w for w in (unpinned, ordinary) if w])

    def _begin(self, request: words.BeginRow) -> words.Answer:
        if self._socket is None or self._batches is None:
            raise DeviceError("the receiver has no socket yet")
        if self._row is not None:
            self._row.segment.discard()
            self._row, self._start = None, None
        segment = Segment(Path(request.path), request.expected_bytes, self._memory)
        self._memory = segment.memory
        stale = 0
        while n := self._batches.receive():
            stale += n
        if stale:
            self._start = None  # the card went on counting: where it starts now is not known
        self._row = _Row(request, segment, self._start, stale, self._batches.strangers, kernel_drops(self._socket))
        return words.Began(stale)

    def _receive(self) -> None:
        row, batches = self._row, self._batches
        if row is None or batches is None:
            return
        for _ in range(_MAX_BATCHES):
            looked_ns = time.monotonic_ns()
            n = batches.receive()
            if n == 0:
                row.note_quiet(looked_ns)
                break
            row.placement.place(batches.packets[:n], batches.lengths[:n])
            row.note_arrival()
        if row.news():
            words.send(self._connection, row.progress())

    def _end(self, card_status: Status) -> words.Answer:
        row = self._row
        if row is None or self._socket is None or self._batches is None:
            raise DeviceError("no row is being received")
        self._receive()
        self._row = None
        placed = row.placement.finish((card_status & LOST_BEFORE_PACKETS).name or "")
        self._start = placed.next_start
        counts, request = placed.counts, row.request
        facts = {
            "row": request.row,
            "take": request.take,
            "expected": placed.expected,
            "received": placed.received,
            "located": placed.located,
            "reason": placed.reason,
            "missing": placed.missing,
            "holes": placed.holes,
            "clock": "CLOCK_MONOTONIC of the host, ns",
            "card_status": int(card_status),
            **{name: int(value) for name, value in (vars(counts) | vars(placed.losses)).items()},
        }
        crc = row.segment.finish()
        arrivals = row.arrivals
        index_crc = write_index(Path(request.path).with_suffix(".idx"), facts, arrivals)
        return words.RowCapture(
            row=request.row,
            take=request.take,
            expected=placed.expected,
            bytes=placed.received,
            missing=placed.missing,
            located=placed.located,
            reason=placed.reason,
            packets=counts.placed,
            duplicates=counts.duplicates,
            late=counts.late,
            outside=counts.outside,
            disagreeing=counts.disagreeing,
            malformed=counts.malformed,
            short=counts.short,
            strangers=self._batches.strangers - row.strangers,
            stale=row.stale,
            kernel_drops=kernel_drops(self._socket) - row.drops,
            first_arrival_ns=int(arrivals[0, 0]) if arrivals.size else 0,
            last_arrival_ns=int(arrivals[-1, 0]) if arrivals.size else 0,
            crc32=crc,
            index_crc32=index_crc,
            leftover=counts.leftover,
            late_by_bytes=counts.late_by_bytes,
            head_bytes=placed.losses.head_bytes,
            gaps=placed.losses.gaps,
            gap_bytes=placed.losses.gap_bytes,
            tail_bytes=placed.losses.tail_bytes,
            card_status=int(card_status),
            holes=placed.holes,
            slipped=placed.slipped,
        )


def main(argv: list[str]) -> int:
    """Run the receiver on the inherited socket whose descriptor is the only argument."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the host decides when a row ends
    with Connection(int(argv[1])) as connection:
        try:
            Receiver(connection).serve()
        except PolysightError as e:
            with contextlib.suppress(DeviceError):  # the host may be gone; then nobody is left to tell
                words.send(connection, words.Failed(e.what, e.why, e.remedy))
            return e.exit_status
    return 0


if __name__ == "__main__":
    raise SystemExit(main(sys.argv))
