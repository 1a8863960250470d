"""Knowledge from earlier records: possible start counters of a row's record, and the counters that earlier ones used.

`CounterView` has the counters of a row's packets relative to a reference; `record_search.py` uses both.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from polysight.capture.dca1000 import BYTE_COUNT_BITS, MAX_PAYLOAD_BYTES, SEQUENCE_BITS, Counters
from polysight.capture.packet_log import PacketLog

Counts = NDArray[np.int64]
Flags = NDArray[np.bool_]


@dataclass(frozen=True)
class Span:
    """Counters of an earlier record: packets with these counters are left over."""

    start: Counters
    size: int
    sure: bool = True  # packets of the record came, or its place is certain; otherwise perhaps never sent
    missing: tuple[tuple[int, int], ...] | None = None  # byte ranges still missing; None: any of it may still come


@dataclass(frozen=True)
class Past:
    """Knowledge about the record of a row from the records before it."""

    base: Counters | None = None  # start of the previous record, if certain
    ends: tuple[int, ...] = ()  # its possible sizes, bytes; this record starts behind one of them
    spans: tuple[Span, ...] = ()  # counters of earlier records
    joint: Counters | None = None  # end of a complete record with a doubtful start
    joined: int = 0  # number of doubtful records that followed each other without a gap
    unseen: bool = False  # a record may have been sent, at an unknown place, of which nothing came
    guessed: bool = False  # `base` is uncertain, only the end of its record is known
    anew: int = 0  # number of consecutive complete records with the first counters of a card just switched on

    def starts_after(self, strays: PacketLog) -> Past:
        """Return the knowledge after packets between two records, which may be of an unknown record."""
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
        """Bool [packet], True for counters of one of these records."""
        found = np.zeros(self.sizes.size, dtype=np.bool_)
        for span in spans:
            if span.sure is sure:
                found |= self._of(span)[0]
        return found

    def came_before(self, spans: tuple[Span, ...]) -> Flags:
        """Bool [packet], True for counters that came already: a late copy, or the card has restarted."""
        found = np.zeros(self.sizes.size, dtype=np.bool_)
        for span in spans:
            if span.sure and span.missing is not None:
                inside, ahead = self._of(span)
                for start, stop in span.missing:
                    inside &= (ahead + self.sizes <= start) | (ahead >= stop)
                found |= inside
        return found

    def _of(self, span: Span) -> tuple[Flags, Counts]:
        """Bool [packet], True for counters of a record; int64 [packet], bytes behind that record's start."""
        ahead = counter_differences(self._counts, span.start.byte_count, BYTE_COUNT_BITS)
        steps = counter_differences(self._sequences, span.start.sequence, SEQUENCE_BITS)
        return (ahead >= 0) & (ahead < span.size) & (ahead == self.full * steps), ahead

    def at(self, base: int, line: int) -> Counters:
        """Return the counters `base` bytes behind the reference, on a line."""
        return self.reference.after(base, (base - line) // self.full)


def line_of(end: int, full: int) -> int:
    """Return the line of a record that follows a record of `end` bytes, relative to the start of that record."""
    return end - full * -(-end // full)


def full_payload(log: PacketLog) -> int:
    """Return the payload of a full packet: the card's default, unless the packets of a longer row show another."""
    sizes = log.sizes
    if log.expected < MAX_PAYLOAD_BYTES or sizes.size == 0 or (sizes == MAX_PAYLOAD_BYTES).any():
        return MAX_PAYLOAD_BYTES
    _, one = np.unique(log.byte_counts, return_index=True)  # without duplicates
    values, counts = np.unique(sizes[one], return_counts=True)
    return int(values[counts == counts.max()].max()) if counts.max() > 2 else MAX_PAYLOAD_BYTES


def counter_differences(counters: Counts, origin: int, bits: int) -> Counts:
    """Return `counters - origin`, int64 [n], of counters that wrap after `bits` bits; nearest to zero."""
    spare = 64 - bits
    wrapped = (counters.astype(np.uint64) - np.uint64(origin)) << np.uint64(spare)  # the counter's top bit is the sign
    return wrapped.view(np.int64) >> np.int64(spare)
