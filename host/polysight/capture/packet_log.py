"""The packets of a row in the order of their arrival, with the times at which they came.

A packet is a header of ten bytes (sequence number, byte count: `docs/spec/dca1000.md`) and payload. Which of them are
the row is decided in `placement.py`.
"""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from polysight.capture.dca1000 import BYTE_COUNT_BITS, MAX_PAYLOAD_BYTES, PACKET_HEADER_BYTES, SEQUENCE_BITS

Bytes = NDArray[np.uint8]
Counts = NDArray[np.int64]

# Room for packets of an earlier record that arrive late: their payload lies outside the row.
_SPARE_BYTES = 1 << 20
# The payload of so many rows is kept at most. Duplicates from two network paths already make two rows of one.
_MAX_ROWS = 4


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
        # Allocate the pages before the first packet.
        memory[:expected].fill(0)
        self.payload = memory
        # The arrays of headers grow when needed; this many packets need no growth while a row is received.
        packets = 2 * expected // MAX_PAYLOAD_BYTES + 256
        self._heads = np.zeros((packets, PACKET_HEADER_BYTES), dtype=np.uint8)
        self._sizes = np.zeros(packets, dtype=np.uint16)
        self._times = np.zeros(packets, dtype=np.int64)
        self.count = 0
        self.kept = 0
        self.malformed = 0
        self.payload_bytes = 0
        # Bytes of `payload` that are in use.
        self._filled = 0

    def add(self, packets: Bytes, lengths: NDArray[np.integer], times_ns: int | Counts) -> None:
        """Log packets in the order of their arrival.

        `packets` is uint8 [n, >= longest length] with header and payload, `lengths` integer [n] bytes, `times_ns` the
        time of each one's arrival, int64 [n], or that of all; monotonic clock.
        """
        sizes = lengths.astype(np.int64) - PACKET_HEADER_BYTES
        times = np.broadcast_to(np.asarray(times_ns, dtype=np.int64), sizes.shape)
        is_well_formed = (sizes > 0) & (sizes <= MAX_PAYLOAD_BYTES)
        if not is_well_formed.all():
            self.malformed += int((~is_well_formed).sum())
            packets = packets[is_well_formed]
            sizes = sizes[is_well_formed]
            times = times[is_well_formed]
        n = len(sizes)
        if n == 0:
            return
        if self.count + n > len(self._sizes):
            self._heads = _double_capacity(self._heads, n)
            self._sizes = _double_capacity(self._sizes, n)
            self._times = _double_capacity(self._times, n)
        new = slice(self.count, self.count + n)
        self._heads[new] = packets[:, :PACKET_HEADER_BYTES]
        self._sizes[new] = sizes
        self._times[new] = times
        total = int(sizes.sum())
        if self.kept == self.count and self._make_room(total):
            self._copy(packets, sizes)
            self.kept += n
        self.count += n
        self.payload_bytes += total

    def _copy(self, packets: Bytes, sizes: Counts) -> None:
        """Append the payload of packets, in runs of one size."""
        bounds = [0, *(np.flatnonzero(np.diff(sizes)) + 1).tolist(), len(sizes)]
        for first, end in pairwise(bounds):
            size = int(sizes[first])
            target = self.payload[self._filled : self._filled + (end - first) * size].reshape(end - first, size)
            target[:] = packets[first:end, PACKET_HEADER_BYTES : PACKET_HEADER_BYTES + size]
            self._filled += target.size

    def _make_room(self, more: int) -> bool:
        """Make room for `more` bytes of payload; False if that would be more than is kept."""
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

    @property
    def arrivals_ns(self) -> Counts:
        """int64 [packet]: arrival time of each, monotonic clock."""
        return self._times[: self.count]

    @property
    def sequences(self) -> Counts:
        """int64 [packet]: the card's sequence numbers, bytes 0 to 3 of a packet's header."""
        return self._heads[: self.count, 0:4].copy().view("<u4")[:, 0].astype(np.int64)

    @property
    def byte_counts(self) -> Counts:
        """int64 [packet]: the card's byte counts, bytes 4 to 9 of a packet's header."""
        # numpy has no integer of 48 bits, so two zero bytes are added.
        eight_bytes = np.zeros((self.count, 8), dtype=np.uint8)
        eight_bytes[:, :6] = self._heads[: self.count, 4:10]
        return eight_bytes.view("<i8")[:, 0]

    @property
    def sizes(self) -> Counts:
        """int64 [packet]: bytes of payload."""
        return self._sizes[: self.count].astype(np.int64)

    @property
    def last_is_short(self) -> bool:
        """True if the last packet is smaller than the one before it: a record may have ended."""
        return self.count > 1 and bool(self._sizes[self.count - 1] < self._sizes[self.count - 2])

    @property
    def last_arrival_ns(self) -> int:
        """Arrival time of the last packet; 0 before the first."""
        if not self.count:
            return 0
        return int(self._times[self.count - 1])

    @staticmethod
    def restore(
        expected: int, sequences: Counts, byte_counts: Counts, sizes: Counts, times_ns: Counts, payload: Bytes
    ) -> PacketLog:
        """Return a log of these packets, as read from a file; arrays as of the properties, `times_ns` as arrivals."""
        log = PacketLog(0)
        log.expected = expected
        log.count = len(sizes)
        log.kept = len(sizes)
        log._heads = np.zeros((len(sizes), PACKET_HEADER_BYTES), dtype=np.uint8)
        log._heads[:, 0:4] = (sequences % (1 << SEQUENCE_BITS)).astype("<u4")[:, None].view(np.uint8)
        log._heads[:, 4:10] = (byte_counts % (1 << BYTE_COUNT_BITS)).astype("<i8")[:, None].view(np.uint8)[:, :6]
        log._sizes = sizes.astype(np.uint16)
        log._times = times_ns
        log.payload = payload
        log.payload_bytes = int(sizes.sum())
        return log


def _double_capacity(array: NDArray[Any], more: int) -> NDArray[Any]:
    """Return a copy of the array with room for twice its entries plus `more`, filled with zeros."""
    return np.concatenate([array, np.zeros((len(array) + more, *array.shape[1:]), dtype=array.dtype)])
