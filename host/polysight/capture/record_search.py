"""The packets of a row, the record among them, and what is known of earlier and later records (docs/spec/placement.md).

`PacketLog` collects packets as they arrive. Within a record all packets but the last are full, so
`byte count - full x sequence` is constant: the record's *line*. Packets of other records are on other lines, or on the
same line at other counts. The start is certain if the counters of earlier records (`Past`) leave one possibility, or if
the record's end proves it. Otherwise the record is not located. `past_after` is the knowledge for the next.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from polysight.capture.dca1000 import BYTE_COUNT_BITS, MAX_PAYLOAD_BYTES, PACKET_HEADER_BYTES, SEQUENCE_BITS, Counters

Bytes = NDArray[np.uint8]
Counts = NDArray[np.int64]
Flags = NDArray[np.bool_]


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


SMALL_RECORD = 16  # packets: a record of this size may be delayed as a whole
_NEAR = 64  # records
SWITCHED_ON = Counters(0, 1)  # of the first packet after a reset
_JOINS, _JOINS_SMALL = 1, 3  # consecutive doubtful records without a gap, after which the next one is trusted


@dataclass(frozen=True)
class Found:
    """The record among a row's packets; arrays are [packet]."""

    base: Counters | None  # of the record's first byte, a guess unless `certain`; None without any packet
    certain: bool  # the base is certain
    located: bool  # the place of every byte is certain
    reason: str  # why it is not located
    offsets: Counts  # int64, bytes from the base
    steps: Counts  # int64, packets from the base
    own: Flags  # on the record's line, from the base on, and of no earlier record
    early: Flags  # came before the row's first pulse
    old: Flags  # has counters of an earlier record
    full: int  # payload of a full packet
    excess: bool = False  # more came than the record has
    doubtful: bool = False  # complete, but possibly made of packets of an earlier record
    fresh: bool = False
    """It starts with the counters of a card just switched on, and nothing else came: the base is practically certain
    for a row with missed triggers, whose frames are placed by arrival times."""
    start_known: bool = False  # its start is known from earlier records
    clock_jumps: int = 0  # number of times the arrival clock went backwards; arrival times are then ignored
    restarted: bool = False  # the card may have restarted just before it, so its last packet is its end
    repeated: Flags | None = None  # has counters that came before and is not a known copy; None if no packet has


@dataclass(frozen=True)
class _Verdict:
    """Decision about the packets on one line; `base` relative to the reference, the rest as in `Found`."""

    base: int
    certain: bool
    located: bool
    reason: str = ""
    excess: bool = False
    doubtful: bool = False
    fresh: bool = False
    start_known: bool = False


def find_record(log: PacketLog, frame_bytes: int, past: Past, not_before_ns: int = 0) -> Found:
    """Find a row's record among its packets.

    Parameters
    ----------
    log
        The packets.
    frame_bytes
        Bytes of a frame; 1 if the record has none.
    past
        Knowledge from earlier records.
    not_before_ns
        Time before the first pulse of the row: packets that arrived earlier are left over.
    """
    full = full_payload(log)
    nothing = np.zeros(log.count, dtype=np.bool_)
    if log.count == 0:
        return Found(
            None, False, log.expected == 0, "no packet came", log.sizes, log.sizes, nothing, nothing, nothing, full
        )
    first = Counters(int(log.byte_counts[0]), int(log.sequences[0]))
    packets = CounterView(log, past.base or first, full)
    early, jumps = _before_pulses(log, not_before_ns)
    old = packets.inside(past.spans, sure=True)
    if past.base is not None and len(past.ends) == 1:
        old |= (packets.line == line_of(past.ends[0], full)) & (packets.ahead < past.ends[0])
    repeated = packets.came_before(past.spans) & ~early
    live = ~(early | old)
    sorted_out = Found(None, False, False, "", packets.ahead, packets.steps, nothing, early, old, full,
                       clock_jumps=jumps)  # fmt: skip
    found = _found(packets, live, log.expected, frame_bytes, past, sorted_out) if live.any() else None
    if repeated.any() and (found is None or not _ends_as_expected(found, log)):
        # Repeated counters in a row without its end: late copies, or the card has restarted.
        if found is not None and found.located:
            why = "packets repeat earlier counters, and the record's end is missing: the card may have restarted"
            return replace(found, located=False, certain=False, reason=why, restarted=True, repeated=repeated)
        unknown = Past(spans=past.spans, joint=past.joint, joined=past.joined, unseen=True, anew=past.anew)
        packets = CounterView(log, Counters(int(log.byte_counts[repeated][0]), int(log.sequences[repeated][0])), full)
        sorted_out = replace(sorted_out, old=old & ~repeated, repeated=repeated)
        found = _found(packets, live | repeated, log.expected, frame_bytes, unknown, sorted_out)
    if found is None:
        why = "every packet is of an earlier record, by its counters or by its arrival before the first pulse"
        return replace(sorted_out, reason=why)
    return found


def _found(packets: CounterView, live: Flags, expected: int, frame_bytes: int, past: Past, sorted_out: Found) -> Found:
    """Find the record among the `live` packets; `sorted_out` classifies the others."""
    line, v = _Search(packets, live, expected, frame_bytes, past).best()
    offsets, steps = packets.ahead - v.base, packets.steps - (v.base - line) // packets.full
    own = live & (packets.line == line) & (offsets >= 0)
    found = replace(
        sorted_out, base=packets.at(v.base, line), certain=v.certain, located=v.located, reason=v.reason,
        offsets=offsets, steps=steps, own=own, excess=v.excess, doubtful=v.doubtful, fresh=v.fresh,
        start_known=v.start_known,
    )  # fmt: skip
    if v.located and (why := _rival(packets, found, live & ~own, expected)):
        return replace(found, located=False, certain=False, reason=why)
    return found


def _rival(packets: CounterView, found: Found, rest: Flags, expected: int) -> str:
    """Return why other packets may be the row's record instead; "" if they may not.

    The host has started one record, so the card's last one is the row's, unless the card started another by itself.
    """
    if later_packets(found, rest, expected, expected).any():
        return "packets of two consecutive records came: it is unknown which is the row's"
    before = (found.offsets < 0) & (found.steps < 0)
    if _many(packets, rest & ~before, expected) or (not found.start_known and _many(packets, rest & before, expected)):
        return "half of another record came with it: it is unknown which is the row's"
    return ""


def _many(packets: CounterView, which: Flags | Counts, expected: int) -> bool:
    """True if these packets have half of a record's bytes: networks do not delay so many."""
    _, one = np.unique(packets.ahead[which], return_index=True)
    return 2 * int(packets.sizes[which][one].sum()) >= expected > 0


def later_packets(found: Found, rest: Flags, stop: int, expected: int) -> Flags:
    """Select the packets with counters not far behind a record that ended at `stop`."""
    behind = (found.offsets >= stop) & (found.offsets < stop + 2 * expected + found.full)
    counted = (found.steps > 0) & (found.steps * found.full < stop + 4 * expected + 4 * found.full)
    return rest & behind & counted


def _ends_as_expected(found: Found, log: PacketLog) -> bool:
    """True if the last byte came of a located record whose start was known from earlier records."""
    return found.located and found.start_known and int((found.offsets + log.sizes)[found.own].max()) == log.expected


class _Search:
    """Decides about each line of a row's packets, and chooses the record's."""

    def __init__(self, packets: CounterView, live: Flags, expected: int, frame_bytes: int, past: Past) -> None:
        self._p, self._live, self._expected, self._frame, self._past = packets, live, expected, frame_bytes, past
        self._unsure = live & packets.inside(past.spans, sure=False) if past.spans else np.zeros_like(live)
        ends = np.array(past.ends if past.base is not None else (), dtype=np.int64)
        self._ends, self._end_lines = ends, ends - packets.full * -(-ends // packets.full)

    def best(self) -> tuple[int, _Verdict]:
        """Return the record's line and the decision about it.

        Preferred is a line on which the record is expected to start, if it is located; otherwise that with most bytes.
        """
        p, live = self._p, np.flatnonzero(self._live)
        lines, group = np.unique(p.line[live], return_inverse=True)
        order = np.lexsort((p.ahead[live], group))
        new = np.ones(len(order), dtype=np.bool_)
        new[1:] = (np.diff(group[order]) != 0) | (np.diff(p.ahead[live][order]) != 0)
        weight = np.bincount(group[order], weights=p.sizes[live][order] * new, minlength=len(lines))
        furthest = np.full(len(lines), -(1 << 62), dtype=np.int64)
        np.maximum.at(furthest, group, p.ahead[live])
        by_weight = np.lexsort((furthest, weight))[::-1]
        start_known = [int(k) for k in by_weight if np.isin(lines[k], self._end_lines)]
        for k in start_known:
            verdict = self._judge(live[group == k], int(lines[k]))
            if verdict.located:
                return int(lines[k]), verdict
        k = int(by_weight[0])
        return int(lines[k]), self._judge(live[group == k], int(lines[k]))

    def _judge(self, which: Counts, line: int) -> _Verdict:
        """Decide about the packets on one line."""
        p, bases = self._p, self._ends[self._end_lines == line]
        first, last = int(p.ahead[which].min()), int(p.ahead[which].max())
        last_size = int(p.sizes[which][p.ahead[which] == last].max())
        stop, short = last + last_size, last_size < p.full
        if bases.size:
            verdict = replace(self._from_past(bases, first, stop, short), start_known=True)
        else:
            inside = p.ahead[which] >= stop - self._expected  # none if a packet is longer than the row
            verdict = self._from_itself(int(p.ahead[which][inside].min(initial=last)), first, stop, last_size)
            if verdict.located and self._ended_within(which, stop):
                why = "a record ended within it: the card may have restarted"
                verdict = replace(verdict, located=False, certain=False, reason=why)
            if verdict.located and self._before_switched_on(verdict.base, first, line):
                why = "its first bytes would be older than the card's counters: the card restarted within it"
                verdict = replace(verdict, located=False, certain=False, reason=why)
            if verdict.located and p.at(first, line) == SWITCHED_ON and self._ends_first(which):
                why = "its end came before its beginning, which has a card's first counters: it restarted within it"
                verdict = replace(verdict, located=False, certain=False, reason=why)
            if verdict.located and not self._much(which):
                why = "too little of it came to distinguish it from the end of an earlier record"
                verdict = replace(verdict, located=False, certain=False, reason=why)
            alone = which.size == self._live.sum() and not self._past.spans and p.at(first, line) == Counters(0, 1)
            if alone and not verdict.located and not verdict.excess:
                why = self._too_short(first, stop, short).reason or "its last bytes are missing"
                verdict = replace(verdict, reason=f"{why}; the card's counters had just begun", fresh=True)
        start = p.at(verdict.base, line)
        unsure = not bases.size or self._past.guessed
        strange = (unsure and self._past.unseen) or (not bases.size and self._is_behind(verdict.base))
        # With full packets only, a late packet at the head and a lost one at the end add up to the row's length.
        by_length = not bases.size and not short and bool(self._past.spans)
        unclear = self._unclear(which, strange) or self._unclear(which[self._unsure[which]], True)
        if verdict.located and (by_length or unclear):
            verdict = replace(verdict, doubtful=True)
        if verdict.doubtful:
            enough = _JOINS if self._expected >= SMALL_RECORD * p.full else _JOINS_SMALL
            joins = self._past.joint == start and self._past.joined >= enough
            if not joins and not (start == SWITCHED_ON and self._past.anew >= enough):
                why = "its packets may be late packets of an earlier record"
                return replace(verdict, located=False, certain=False, reason=why)
        return verdict

    def _ended_within(self, which: Counts, stop: int) -> bool:
        """True if a short packet is before the last: only the last of a record is short."""
        sizes = self._p.sizes[which]
        return bool(((sizes < self._p.full) & (self._p.ahead[which] + sizes < stop)).any())

    def _ends_first(self, which: Counts) -> bool:
        """True if the packets that came first belong behind all later ones."""
        ahead = self._p.ahead[which]
        first = int(np.argmin(ahead))
        return first > 0 and int(ahead[first:].max()) < int(ahead[:first].min())

    def _before_switched_on(self, base: int, first: int, line: int) -> bool:
        """True if a record from `base` on would begin before sequence 1 and byte 0, where counters start."""
        at, lost = self._p.at(first, line), first - base
        return at.byte_count < lost and at.sequence <= lost // self._p.full

    def _unclear(self, which: Counts, suspect: bool) -> bool:
        """True if suspect packets may be an earlier record's; half of a record that is not small cannot."""
        big = self._expected >= SMALL_RECORD * self._p.full
        return suspect and which.size > 0 and not (big and self._much(which))

    def _is_behind(self, base: int) -> bool:
        """True if a record with this base was sent not long before the expected start of this one."""
        near = -_NEAR * (self._expected + self._p.full)
        return bool(self._ends.size) and near < base < int(self._ends.min())

    def _much(self, which: Counts) -> bool:
        return _many(self._p, which, self._expected)

    def _from_past(self, bases: Counts, first: int, stop: int, short: bool) -> _Verdict:
        """Decide for a record that starts at one of these bases."""
        e = self._expected
        possible = bases[(stop <= bases + e) & (bases <= first)]
        if not possible.size:
            base = int(bases[bases <= first].max(initial=-1)) if (bases <= first).any() else int(bases.min())
            more = stop - base - e
            if more > 0:
                why = f"{more} bytes more than the row has: the radar saw spurious triggers"
                return _Verdict(base, False, False, why, excess=True)
            return _Verdict(first, False, False, "packets precede the expected start of the record")
        if possible.size > 1:
            base = int(possible.max())
            if not (short and stop in possible + e):
                return _Verdict(base, False, False, "the record has more than one possible start")
            possible = possible[possible + e == stop]
        if int(possible[0]) + e == stop:
            return _Verdict(int(possible[0]), True, True)
        return self._too_short(int(possible[0]), stop, short)

    def _too_short(self, base: int, stop: int, short: bool) -> _Verdict:
        """Decide for a record with a certain start whose last bytes are missing."""
        missing = base + self._expected - stop
        frames = f" ({missing // self._frame} frames)" if missing % self._frame == 0 and self._frame > 1 else ""
        if short:
            why = (
                f"the record ended {missing} bytes{frames} early: missed SYNC_IN pulses, or the card dropped data"
                " before numbering it"
            )
            return _Verdict(base, True, False, why)
        if missing >= self._frame > 1:
            why = f"the last {missing} bytes are missing, and perhaps frames before them"
            return _Verdict(base, True, False, why)
        return _Verdict(base, True, True)

    def _from_itself(self, first_inside: int, first: int, stop: int, last_size: int) -> _Verdict:
        """Decide for a record with an unknown start, which only its end can prove."""
        e, full = self._expected, self._p.full
        base = stop - e
        lost = first_inside - base
        if last_size < full and (e - last_size) % full == 0:
            if lost % self._frame or self._frame == 1 or lost == 0:
                return _Verdict(base, True, True)
        elif last_size == full and e % full == 0 and stop - first == e:
            return _Verdict(base, True, True)
        if stop - first > e:
            return _Verdict(
                first, False, False, f"{stop - first - e} bytes more than the row has, and its start is unknown",
                excess=True,
            )  # fmt: skip
        why = f"{e - (stop - first)} bytes short, and the start of the record is unknown"
        return _Verdict(first, False, False, why)


def _before_pulses(log: PacketLog, not_before_ns: int) -> tuple[Flags, int]:
    """Select packets that arrived before the first pulse, and count backward jumps of the arrival clock.

    If the clock jumps, no packet is selected.
    """
    jumps = int((np.diff(log.batches[:, 0]) < 0).sum())
    early = log.arrivals_ns < not_before_ns
    return (np.zeros_like(early) if jumps else early), jumps


_REMEMBERED = 4  # earlier records whose counters are kept
_GAPS = 64  # largest number of gaps of a record that are kept


def past_after(past: Past, found: Found, log: PacketLog, located: bool, frame_bytes: int) -> Past:
    """Return the knowledge for the next record.

    `located` is also False if the card reported dropped data: then only a short last packet marks the record's end.
    """
    e, full = log.expected, found.full
    if found.base is None:
        return _after_nothing(past, e, full, frame_bytes)
    base, ends = found.base, (found.offsets + log.sizes)[found.own]
    stop = int(ends.max())
    more = _more_records(found, stop, e)
    if located and not more:
        sure = tuple(span for span in past.spans if span.sure)
        anew = past.anew + 1 if base == SWITCHED_ON and past.spans else 0
        return Past(base, (e,), _remember(sure, Span(base, e, missing=_outstanding(found, log))), anew=anew)
    first = int(found.offsets[found.own].min())
    short = bool((log.sizes[found.own][ends == stop] < full).all())
    if found.restarted:
        return Past(base, tuple(sorted({stop, e})), _remember(past.spans, Span(base, e)))
    if more:  # the end of the last of them is unknown
        return Past(spans=_remember(past.spans, Span(base, max(stop, e))), unseen=True)
    if found.certain:
        frames = range(-(-stop // frame_bytes) * frame_bytes, e + 1, frame_bytes) if frame_bytes > 1 else range(0)
        return Past(base, tuple(sorted({*frames, *([stop] if short else [])})), _remember(past.spans, Span(base, e)))
    back = -(-max(0, first - (stop - e)) // full)  # packets that may be lost before the first
    low, high = first - back * full, max(stop, first + e) if e % full else stop
    spans = _remember(past.spans, Span(base.after(low, low // full), high - low))
    end, joined = base.after(stop, -(-stop // full)), 0
    if found.doubtful:
        joined = past.joined + 1 if past.joint == base else 1
        spans = (*spans, Span(end, e, sure=False))
    elif e % full == 0 and first + e > stop:
        spans = (*spans, Span(end, first + e - stop, sure=False))
    anew = past.anew + 1 if found.doubtful and base == SWITCHED_ON else 0
    known = Past(spans=spans, joint=end if joined else None, joined=joined, unseen=past.unseen, anew=anew)
    # A short packet ends its record, wherever that began. One truncated on the way leads to a line without packets.
    return replace(known, base=base, ends=(stop,), guessed=True) if short and not found.doubtful else known


def _outstanding(found: Found, log: PacketLog) -> tuple[tuple[int, int], ...] | None:
    """Return the missing byte ranges of a located record; None if they are too many to keep."""
    came = (found.own | found.old) & (found.offsets >= 0) & (found.offsets < log.expected)
    starts, stops = found.offsets[came], (found.offsets + log.sizes)[came]
    order = np.argsort(starts, kind="stable")
    a = np.append(starts[order], log.expected)
    b = np.maximum.accumulate(np.append(0, stops[order]))
    gaps = tuple((int(b[k]), int(a[k])) for k in np.flatnonzero(a > b).tolist())
    return gaps if len(gaps) <= _GAPS else None


def _more_records(found: Found, stop: int, expected: int) -> bool:
    """True if packets have counters behind the record's end: another record of unknown size, or the card restarted."""
    return bool(later_packets(found, ~(found.own | found.early | found.old), stop, expected).any())


def _after_nothing(past: Past, expected: int, full: int, frame_bytes: int) -> Past:
    """Return the knowledge after a row without packets, whose record may have been sent or not."""
    if past.base is None or len(past.ends) != 1 or past.guessed:
        return Past(spans=past.spans, unseen=True)
    end = past.ends[0]
    base = past.base.after(end, -(-end // full))
    spans = _remember(past.spans, Span(base, expected, sure=False))
    step = frame_bytes if frame_bytes > 1 else max(1, expected)
    return Past(base, tuple(range(0, expected + 1, step)), spans, unseen=True)


def _remember(spans: tuple[Span, ...], span: Span) -> tuple[Span, ...]:
    return (*spans, span)[-_REMEMBERED:]
