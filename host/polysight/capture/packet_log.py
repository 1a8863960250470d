"""The packets of a row in the order of their arrival, with the times at which they came."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from polysight.capture.dca1000 import BYTE_COUNT_BITS, MAX_PAYLOAD_BYTES, PACKET_HEADER_BYTES, SEQUENCE_BITS

Bytes = NDArray[np.uint8]
Counts = NDArray[np.int64]

_SPARE_BYTES = 1 << 20  # of payload beyond the row, for left-over packets
_MAX_ROWS = 4  # of payload that is kept; two network paths double it


class PacketLog:
    """The packets of one row of `expected` bytes in the order of their arrival.

    `memory`, uint8, is reused for the payload if it is large enough.

    Attributes
    ----------
    count
        Packets logged.
    malformed
        Packets without payload, or longer than the card's: counted, not logged.
    payload
        uint8: payload of the first `kept` packets, one after another.
    kept
        Packets with stored payload: all, unless far more came than the row has.
    payload_bytes
        Bytes of payload received.
    """

    def __init__(self, expected: int, memory: Bytes | None = None) -> None:
        self.expected = expected
        if memory is None or memory.size < expected + _SPARE_BYTES:
            memory = np.empty(expected + _SPARE_BYTES, dtype=np.uint8)
        memory[:expected].fill(0)  # allocate the pages before the first packet
        self.payload = memory
        packets = 2 * expected // MAX_PAYLOAD_BYTES + 256
        self._heads = np.zeros((packets, PACKET_HEADER_BYTES), dtype=np.uint8)
        self._sizes = np.zeros(packets, dtype=np.uint16)
        self._batches = np.zeros((packets, 2), dtype=np.int64)
        self.count = self.kept = self.malformed = self.payload_bytes = 0
        self._filled = self._noted = 0
        self._quiet_ns = 0  # last time since the last batch at which the socket was empty

    def add(self, packets: Bytes, lengths: NDArray[np.integer], t_ns: int) -> None:
        """Log packets in the order of their arrival.

        `packets` is uint8 [n, >= longest length] with header and payload, `lengths` integer [n] bytes, `t_ns` the time
        of reception, monotonic clock.
        """
        sizes = lengths.astype(np.int64) - PACKET_HEADER_BYTES
        good = (sizes > 0) & (sizes <= MAX_PAYLOAD_BYTES)
        if not good.all():
            self.malformed += int((~good).sum())
            packets, sizes = packets[good], sizes[good]
        n = len(sizes)
        if n == 0:
            return
        if self.count + n > len(self._sizes):
            self._heads, self._sizes = _doubled(self._heads, n), _doubled(self._sizes, n)
        self._heads[self.count : self.count + n] = packets[:, :PACKET_HEADER_BYTES]
        self._sizes[self.count : self.count + n] = sizes
        total = int(sizes.sum())
        if self.kept == self.count and self._room_for(total):
            self._copy(packets, sizes)
            self.kept += n
        self.count += n
        self.payload_bytes += total
        self._note(t_ns)

    def note_quiet(self, t_ns: int) -> None:
        """Record that the socket was empty at this time."""
        self._quiet_ns = t_ns

    def _copy(self, packets: Bytes, sizes: Counts) -> None:
        bounds = np.flatnonzero(np.diff(sizes)) + 1
        for i, j in zip([0, *bounds.tolist()], [*bounds.tolist(), len(sizes)], strict=True):
            size = int(sizes[i])
            to = self.payload[self._filled : self._filled + (j - i) * size].reshape(j - i, size)
            to[:] = packets[i:j, PACKET_HEADER_BYTES : PACKET_HEADER_BYTES + size]
            self._filled += to.size

    def _room_for(self, more: int) -> bool:
        """True if `more` bytes of payload can be kept; memory grows up to `_MAX_ROWS` rows."""
        if self._filled + more <= self.payload.size:
            return True
        size = min(2 * self.payload.size + more, self.max_kept_bytes(self.expected))
        if self._filled + more > size:
            return False
        grown = np.empty(size, dtype=np.uint8)
        grown[: self._filled] = self.payload[: self._filled]
        self.payload = grown
        return True

    @staticmethod
    def max_kept_bytes(expected: int) -> int:
        """Return the largest payload that is kept of a row of `expected` bytes."""
        return _MAX_ROWS * (expected + _SPARE_BYTES)

    def _note(self, t_ns: int) -> None:
        if self._noted + 2 > len(self._batches):
            self._batches = _doubled(self._batches, 2)
        if self._quiet_ns and self._noted:
            self._batches[self._noted] = self._quiet_ns, self._batches[self._noted - 1, 1]
            self._noted += 1
        self._quiet_ns = 0
        self._batches[self._noted] = t_ns, self.count
        self._noted += 1

    @property
    def batches(self) -> Counts:
        """int64 [n, 2]: time (monotonic, ns), packets received by then; without growth, the socket was empty."""
        return self._batches[: self._noted]

    @property
    def sequences(self) -> Counts:
        """int64 [packet]."""
        return self._heads[: self.count, 0:4].copy().view("<u4")[:, 0].astype(np.int64)

    @property
    def byte_counts(self) -> Counts:
        """int64 [packet]: the card's byte count, 48 bits."""
        wide = np.zeros((self.count, 8), dtype=np.uint8)
        wide[:, :6] = self._heads[: self.count, 4:10]
        return wide.view("<i8")[:, 0]

    @property
    def sizes(self) -> Counts:
        """int64 [packet]: bytes of payload."""
        return self._sizes[: self.count].astype(np.int64)

    @property
    def arrivals_ns(self) -> Counts:
        """int64 [packet]: latest possible arrival time of each."""
        return np.repeat(self.batches[:, 0], np.diff(self.batches[:, 1], prepend=0))

    @property
    def last_is_short(self) -> bool:
        """True if the last packet is smaller than the one before it: a record may have ended."""
        return self.count > 1 and bool(self._sizes[self.count - 1] < self._sizes[self.count - 2])

    @property
    def last_arrival_ns(self) -> int:
        """Arrival time of the last batch; 0 before the first."""
        return int(self._batches[self._noted - 1, 0]) if self._noted else 0

    @staticmethod
    def restore(
        expected: int, sequences: Counts, byte_counts: Counts, sizes: Counts, batches: Counts, payload: Bytes
    ) -> PacketLog:
        """Restore a log from a file; arrays as of the properties."""
        log = PacketLog(0, payload if payload.size >= _SPARE_BYTES else None)
        log.expected, log.count, log.kept = expected, len(sizes), len(sizes)
        log._heads = np.zeros((len(sizes), PACKET_HEADER_BYTES), dtype=np.uint8)
        log._heads[:, 0:4] = (sequences % (1 << SEQUENCE_BITS)).astype("<u4")[:, None].view(np.uint8)
        log._heads[:, 4:10] = (byte_counts % (1 << BYTE_COUNT_BITS)).astype("<i8")[:, None].view(np.uint8)[:, :6]
        log._sizes = sizes.astype(np.uint16)
        log._batches, log._noted = batches, len(batches)
        log.payload, log._filled, log.payload_bytes = payload, payload.size, int(sizes.sum())
        return log


def _doubled(array: NDArray[Any], more: int) -> NDArray[Any]:
    """Return the array with space for twice as many entries, and `more`."""
    return np.concatenate([array, np.zeros((len(array) + more, *array.shape[1:]), dtype=array.dtype)])
