"""What the records before tell about a row: where it may start, and which counters are theirs.

`CounterView` holds the counters of a row's packets relative to a reference; `record_search.py` decides with both.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from polysight.host.capture.dca1000 import BYTE_COUNT_BITS, MAX_PAYLOAD_BYTES, SEQUENCE_BITS, Counters
from polysight.host.capture.packet_log import PacketLog

Counts = NDArray[np.int64]
Flags = NDArray[np.bool_]


@dataclass(frozen=True)
class Span:
    """Counters of an earlier record: packets that carry them are left over.

    `sure`: packets of that record came, or its place is certain. Otherwise it may never have been sent. `missing`: byte
    ranges of it that did not come, of a record whose place was certain; None: any of it may still come.
    """

    start: Counters
    size: int
    sure: bool = True
    missing: tuple[tuple[int, int], ...] | None = None


@dataclass(frozen=True)
class Past:
    """What the records before tell about this one.

    Attributes
    ----------
    base
        Where the record before this one started, when that was certain.
    ends
        The sizes in bytes that it may have had: this record starts behind one of them. One of a located record.
    spans
        Counters of earlier records.
    joint, joined
        Where a whole record ended whose start was not believed, and how many of them followed without a seam.
    unseen
        Whether a record may have been sent of which nothing came, and it is not known where.
    guessed
        Whether `base` is not certain: only where its record ended is.
    anew
        How many whole records, one behind the other, began with the counters of a card that was just switched on.
    """

    base: Counters | None = None
    ends: tuple[int, ...] = ()
    spans: tuple[Span, ...] = ()
    joint: Counters | None = None
    joined: int = 0
    unseen: bool = False
    guessed: bool = False
    anew: int = 0

    @staticmethod
    def ending_at(start: Counters) -> Past:
        """The record before ended here for certain."""
        return Past(start, (0,))

    def starts_after(self, strays: PacketLog) -> Past:
        """The same after packets that came between two records: some of them may be of a record nobody knows."""
        if strays.count == 0 or self.base is None or self._knows(strays):
            return self
        return replace(self, base=None, ends=())

    def _knows(self, strays: PacketLog) -> bool:
        full = full_payload(strays)
        packets = CounterView(strays, self.base or Counters(0, 0), full)
        known = packets.inside(self.spans, sure=True)
        if len(self.ends) == 1:
            known |= (packets.line == line_of(self.ends[0], full)) & (packets.ahead < self.ends[0])
        return bool(known.all())


class CounterView:
    """Counters of all packets relative to a reference. Attributes are int64 [packet]."""

    def __init__(self, log: PacketLog, reference: Counters, full: int) -> None:
        self.reference, self.full, self.sizes = reference, full, log.sizes
        self._counts, self._sequences = log.byte_counts, log.sequences
        self.ahead = counter_differences(self._counts, reference.byte_count, BYTE_COUNT_BITS)
        self.steps = counter_differences(self._sequences, reference.sequence, SEQUENCE_BITS)
        self.line = self.ahead - full * self.steps

    def inside(self, spans: tuple[Span, ...], sure: bool) -> Flags:
        """Whether each has counters of one of these records."""
        found = np.zeros(self.sizes.size, dtype=np.bool_)
        for span in spans:
            if span.sure is sure:
                found |= self._of(span)[0]
        return found

    def came_before(self, spans: tuple[Span, ...]) -> Flags:
        """Whether each has counters that came already: a copy on a slow path, or a card that began anew."""
        found = np.zeros(self.sizes.size, dtype=np.bool_)
        for span in spans:
            if span.sure and span.missing is not None:
                inside, ahead = self._of(span)
                for start, stop in span.missing:
                    inside &= (ahead + self.sizes <= start) | (ahead >= stop)
                found |= inside
        return found

    def _of(self, span: Span) -> tuple[Flags, Counts]:
        """Whether each has counters of a record, and how many bytes it lies behind that one's start."""
        ahead = counter_differences(self._counts, span.start.byte_count, BYTE_COUNT_BITS)
        steps = counter_differences(self._sequences, span.start.sequence, SEQUENCE_BITS)
        return (ahead >= 0) & (ahead < span.size) & (ahead == self.full * steps), ahead

    def at(self, base: int, line: int) -> Counters:
        """The counters so many bytes from the reference, on a line."""
        return self.reference.after(base, (base - line) // self.full)


def line_of(end: int, full: int) -> int:
    """The line of a record that starts behind one of `end` bytes, relative to that one's start."""
    return end - full * -(-end // full)


def full_payload(log: PacketLog) -> int:
    """Payload of a full packet: the card's usual one, unless the packets of a longer row show another."""
    sizes = log.sizes
    if log.expected < MAX_PAYLOAD_BYTES or sizes.size == 0 or (sizes == MAX_PAYLOAD_BYTES).any():
        return MAX_PAYLOAD_BYTES
    _, one = np.unique(log.byte_counts, return_index=True)  # a network may bring one packet many times
    values, counts = np.unique(sizes[one], return_counts=True)
    return int(values[counts == counts.max()].max()) if counts.max() > 2 else MAX_PAYLOAD_BYTES


def counter_differences(counters: Counts, origin: int, bits: int) -> Counts:
    """`counters - origin` of the card's counters, int64 [n], which wrap after so many bits; nearest to zero."""
    spare = 64 - bits
    wrapped = (counters.astype(np.uint64) - np.uint64(origin)) << np.uint64(spare)  # the counter's top bit is the sign
    return wrapped.view(np.int64) >> np.int64(spare)
