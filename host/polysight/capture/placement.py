"""Which packets are a row, and where each byte belongs: the whole decision (docs/spec/placement.md).

A card numbers every byte that it sends. If the counters of the row's first byte are known, each packet says by itself
where it belongs; packets behind them are left over, packets elsewhere are another record's. So one thing has to be
known, the start, and one has to be seen, the end: a card that drops bytes before numbering them, or a radar that misses
or adds a frame, shows it only in the length of the record. A row is *located* if it starts where it must and ends where
it must. Everything else is masked as a whole; data is original or masked, never guessed.

States (`Past`): nothing came before (*first*), the start is *known*, or it is *lost*. A card whose start is lost is
reset by the host before the next row, which makes it known again.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from polysight.capture.dca1000 import BYTE_COUNT_BITS, MAX_PAYLOAD_BYTES, SEQUENCE_BITS, Counters
from polysight.capture.packet_log import PacketLog

Bytes = NDArray[np.uint8]
Counts = NDArray[np.int64]
Flags = NDArray[np.bool_]
Gap = tuple[int, int]

SWITCHED_ON = Counters(0, 1)
"""Counters of the first packet of a card that was switched on or reset."""
SMALL_RECORD = 16
"""Packets below which a whole record may come late; a later one is no evidence of where the card counts."""
JOINS = 3
"""Records that join a whole one at another place than predicted, after which the card is taken to count there."""
RESTARTS = 2
"""Whole records in which the card counts anew, after which it is taken to do so in every record."""
# Fewer packets with strange counters are damaged ones.
MIN_PACKETS_OF_A_RECORD = 3
# Packets by which a network does not delay one behind others.
_FAR_BEHIND = 64
# A packet size seen in fewer packets may be that of last packets, which are short.
_MIN_PACKETS_OF_A_SIZE = 3


@dataclass(frozen=True)
class Past:
    """Where the next record begins, from the records before it. `Past()` is the state *first*."""

    start: Counters | None = None  # of the next record's first byte; None: unknown
    lost: bool = False  # unknown, and packets of earlier records may still come
    restarts: int = 0  # whole records that did not begin where they had to, but with a card's first counters
    elsewhere: Counters | None = None  # end of a whole record at another place than predicted, alone in its row
    joined: int = 0  # records that joined it without a gap
    undelivered: tuple[Gap, ...] = ()  # of the last record, if the next has the same counters: may come with it

    def after_reset(self) -> Past:
        """Return the knowledge after the host has reset the card: its memory is empty and it counts anew."""
        return replace(self, start=SWITCHED_ON, lost=False, undelivered=())


@dataclass
class PacketCounts:
    """Packets of one row by result: every packet is in exactly one of the first eight; the others are subsets."""

    placed: int = 0
    duplicates: int = 0  # every byte was there already, and equal
    conflicting: int = 0  # other bytes than a packet with equal counters: masked where they overlap
    leftover: int = 0  # of an earlier record
    restarted: int = 0  # after the card restarted within the row and reset its counters
    outside: int = 0  # behind the record's last expected byte, or not kept for lack of memory
    disagreeing: int = 0  # byte count and sequence contradict each other
    malformed: int = 0  # no payload, or longer than the card's packets
    late: int = 0  # placed, after a packet that follows it
    late_by_bytes: int = 0  # largest delay of these, bytes
    short: int = 0  # placed, not full; normally only the last of a record
    before_pulses: int = 0  # leftover, identified by arrival before the row's first pulse
    clock_jumps: int = 0  # number of times the arrival clock went backwards


@dataclass(frozen=True)
class Losses:
    """Missing bytes: before the first packet, in gaps between packets, after the last one."""

    head_bytes: int = 0
    gaps: int = 0
    gap_bytes: int = 0
    tail_bytes: int = 0


@dataclass(frozen=True)
class Placed:
    """Result of placing one record."""

    expected: int  # bytes
    received: int  # bytes
    missing: list[Gap]  # byte ranges (start, stop) that are missing or uncertain: sorted, not touching
    located: bool  # the place of every byte is certain; if not, `missing` is the whole record
    reason: str  # why it is not located
    counts: PacketCounts
    losses: Losses  # missing bytes by kind; for a record that is not located, by its counters only
    past: Past  # knowledge for the next record
    at: Counts  # int64 [packet]: offset of its payload in the row, -1 outside the row
    arrivals: Counts  # int64 [n, 2]: time (monotonic, ns), bytes received by then; no growth: the socket was empty
    holes: list[Gap] = field(default_factory=list)  # missing ranges below the furthest byte, in the card's order
    slipped: bool = False  # not located only because whole frames are missing: triggers were missed

    @property
    def complete(self) -> bool:
        """True if every byte is there and nothing more came."""
        return self.located and not self.missing

    def facts(self) -> dict[str, Any]:
        """Return the entries of the row's index (docs/spec/scan-folder.md)."""
        return {
            "expected": self.expected,
            "received": self.received,
            "located": self.located,
            "reason": self.reason,
            "missing": self.missing,
            "holes": self.holes,
            "clock": "CLOCK_MONOTONIC of the host, ns",
            **{name: int(value) for name, value in (vars(self.counts) | vars(self.losses)).items()},
        }


@dataclass(frozen=True)
class Preview:
    """Progress of a running row: bytes in place, all bytes in place, the furthest packet is a short one."""

    received: int
    complete: bool
    ended: bool


class Evidence(msgspec.Struct, frozen=True):
    """Inputs for placing a row, beside its packets; as of :func:`place_record`."""

    expected: int
    frame_bytes: int
    not_before_ns: int = 0
    dropped_by_card: str = ""
    past: Past = Past()


def place_record(
    log: PacketLog, frame_bytes: int = 1, past: Past | None = None, not_before_ns: int = 0, dropped_by_card: str = ""
) -> tuple[Placed, Bytes]:
    """Place one row's packets; return the result and the row: uint8 [expected], zero at the holes.

    Parameters
    ----------
    log
        The packets; the returned row may share its memory.
    frame_bytes
        Bytes of one frame, 1 if the record has no frames.
    past
        Knowledge from earlier records.
    not_before_ns
        Time before the first pulse of the row (clock of the arrivals); 0 if unknown.
    dropped_by_card
        Names of the status bits by which the card reported data dropped before the packets were numbered: bytes are
        missing without a gap in the counters, so that no byte's place is certain.
    """
    past = past or Past()
    record = _find_record(log, past, not_before_ns)
    row = _Row(log, record)
    why = _why_not_located(record, row, log, frame_bytes)
    if not why.text and dropped_by_card:
        why = _Doubt(f"the card dropped data before numbering it ({dropped_by_card})")
    located = not why.text
    undelivered = list(past.undelivered) if record.start == past.start else []
    holes = _merged([*_gaps(row.covered, row.extent), *row.conflicts, *undelivered])
    missing = _merged([*holes, *([(row.extent, log.expected)] if row.extent < log.expected else [])])
    out = row.bytes(missing if located else holes)
    placed = Placed(
        expected=log.expected,
        received=row.received,
        missing=missing if located else [(0, log.expected)] if log.expected else [],
        located=located,
        reason=why.text,
        counts=row.counts,
        losses=_losses(missing, row.extent, log.expected),
        past=_past_after(past, record, _gaps(row.covered, log.expected)),
        at=row.at,
        arrivals=row.arrivals(),
        holes=holes,
        slipped=why.frames_missing and not dropped_by_card,
    )
    return placed, out


def preview(log: PacketLog, past: Past, not_before_ns: int) -> Preview:
    """Return the progress of a row from its packets so far, without comparing or copying payload."""
    record = _find_record(log, past, not_before_ns)
    if not record.own.any():
        return Preview(0, log.expected == 0, ended=False)
    starts = record.offsets[record.own]
    ends = np.minimum(starts + log.sizes[record.own], log.expected)
    order = np.lexsort((ends, starts))
    reached = np.maximum.accumulate(ends[order])
    fresh = reached - np.maximum(np.append(0, reached[:-1]), starts[order])
    received = int(np.maximum(fresh, 0).sum())
    complete = record.start_is_certain and record.ends_as_planned and received == log.expected
    return Preview(received, complete, record.ended)


# ---- evidence -----------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Record:
    """The row's record among the packets; arrays are [packet]."""

    start: Counters | None  # counters of its first byte; None without any packet
    start_is_certain: bool
    offsets: Counts  # int64, bytes behind the start
    steps: Counts  # int64, packets behind the start
    own: Flags  # counters within the row, and came after the first pulse
    beyond: Flags  # counts on from this record behind the row's last byte
    later: Flags  # of a record behind this one
    early: Flags  # came before the row's first pulse
    too_early: Flags  # of these, the ones with counters of the row
    anew: Flags  # has counters of a card that restarted within the row
    full: int  # payload of a full packet, bytes
    length: int = 0  # bytes up to the end of the furthest packet
    ended: bool = False  # that packet is short, as only a record's last one is
    ends_as_planned: bool = False  # every sign of an end at the row's last byte
    clock_jumps: int = 0
    doubt: str = ""  # why the start is not certain


def _find_record(log: PacketLog, past: Past, not_before_ns: int) -> _Record:
    """Select the row's packets by where the record starts: as predicted, or else where a whole record stands."""
    full = find_full_payload(log)
    jumps = int((np.diff(log.batches[:, 0]) < 0).sum())
    early = np.zeros(log.count, dtype=np.bool_) if jumps else log.arrivals_ns < not_before_ns
    if past.start is not None:
        record = _record_at(log, past.start, full, early, jumps)
        if record.own.any() or not (~early).any():
            return record
    # The largest group of packets that count on from each other, and where it would begin if its end is the row's.
    live = np.flatnonzero(~early)
    if not live.size:
        return _record_at(log, past.start or SWITCHED_ON, full, early, jumps)
    seen_first = Counters(int(log.byte_counts[live[0]]), int(log.sequences[live[0]]))
    ahead = counter_differences(log.byte_counts, seen_first.byte_count, BYTE_COUNT_BITS)
    steps = counter_differences(log.sequences, seen_first.sequence, SEQUENCE_BITS)
    _, group, packets = np.unique((ahead - full * steps)[live], return_inverse=True, return_counts=True)
    own = live[group == int(np.argmax(packets))]
    lowest = own[int(np.argmin(ahead[own]))]
    start = Counters(int(log.byte_counts[lowest]), int(log.sequences[lowest]))
    record = _record_at(log, start, full, early, jumps)
    if not record.ends_as_planned:
        return _doubted(record, "the record is not whole, and its start is unknown")
    if past.start is not None:
        # A card whose counters a reset leaves as they are shows it by whole records that join each other.
        counts_on = start == past.elsewhere and past.joined + 1 >= JOINS and not (~record.own & ~early).any()
        return (
            record if counts_on else _doubted(record, "the record does not begin where the card counts: a second card?")
        )
    if past.lost:
        return _doubted(record, "it is unknown where the last record ended")
    others = ~record.own & ~early
    behind = others & (record.offsets < 0) & (record.steps < 0)
    if (others & ~behind).any() or 2 * int(log.sizes[behind].sum()) >= log.expected:
        return _doubted(record, "packets of another record came with it")
    offsets, sizes = record.offsets[record.own], log.sizes[record.own]
    ended_before = ((sizes < full) & (offsets + sizes < record.length)).any()
    _, first_arrival = np.unique(offsets, return_index=True)
    if ended_before or (np.diff(first_arrival) < 0).any():
        return _doubted(record, "its packets did not come in order, and its start is unknown")
    return record


def _doubted(record: _Record, doubt: str) -> _Record:
    return replace(record, start_is_certain=False, doubt=doubt)


def _record_at(log: PacketLog, start: Counters, full: int, early: Flags, jumps: int) -> _Record:
    """Select the packets of a record that starts with these counters."""
    sizes, expected = log.sizes, log.expected
    offsets = counter_differences(log.byte_counts, start.byte_count, BYTE_COUNT_BITS)
    steps = counter_differences(log.sequences, start.sequence, SEQUENCE_BITS)
    on_line = (offsets == full * steps) & (offsets >= 0)
    own = on_line & (offsets < expected) & ~early
    length, ended = 0, False
    if own.any():
        stops = (offsets + sizes)[own]
        length = int(stops.max())
        ended = bool((sizes[own][stops == length] < full).all())
    near = (offsets < 2 * expected + 2 * full) & (steps > 0) & (steps * full < 4 * expected + 4 * full) & ~early
    beyond = near & on_line & (offsets >= expected)
    later = near & ~on_line & (offsets >= max(length, full))
    ends_in_short = expected % full > 0
    as_planned = length == expected and ended is ends_in_short and not beyond.any()
    anew = np.zeros_like(own)
    if start.byte_count > 2 * expected and own.any():
        anew = (log.byte_counts == full * (log.sequences - 1)) & (log.byte_counts < expected) & ~early & ~own
        anew &= np.arange(log.count) > int(np.argmax(own))
    return _Record(
        start=start,
        start_is_certain=True,
        offsets=offsets,
        steps=steps,
        own=own,
        beyond=beyond,
        later=later & ~anew,
        early=early,
        too_early=early & on_line & (offsets < expected),
        anew=anew,
        full=full,
        length=length,
        ended=ended,
        ends_as_planned=as_planned,
        clock_jumps=jumps,
    )


def counter_differences(counters: Counts, origin: int, bits: int) -> Counts:
    """Return `counters - origin`, int64 [n], of counters that wrap after `bits` bits; nearest to zero."""
    spare = 64 - bits
    wrapped = (counters.astype(np.uint64) - np.uint64(origin)) << np.uint64(spare)  # the counter's top bit is the sign
    return wrapped.view(np.int64) >> np.int64(spare)


def find_full_payload(log: PacketLog) -> int:
    """Payload of a full packet in bytes: the card's default unless most packets of a longer row have another."""
    row_fits_one_packet = log.expected < MAX_PAYLOAD_BYTES
    default_is_seen = bool((log.sizes == MAX_PAYLOAD_BYTES).any())
    if row_fits_one_packet or default_is_seen or log.count == 0:
        return MAX_PAYLOAD_BYTES

    # A packet that came twice counts once.
    _, first_index = np.unique(log.byte_counts, return_index=True)
    sizes, packets = np.unique(log.sizes[first_index], return_counts=True)
    if packets.max() < _MIN_PACKETS_OF_A_SIZE:
        return MAX_PAYLOAD_BYTES
    return int(sizes[packets == packets.max()].max())


# ---- decision -----------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Doubt:
    """Why a record is not located; "" if it is. `frames_missing`: only because whole frames are missing."""

    text: str = ""
    frames_missing: bool = False


def _why_not_located(record: _Record, row: _Row, log: PacketLog, frame_bytes: int) -> _Doubt:
    """Decide if the place of every byte is certain."""
    expected = log.expected
    if expected == 0:
        return _Doubt()
    if log.count == 0:
        return _Doubt("no packet came")
    if not record.own.any():
        return _Doubt("every packet is of an earlier record, by its counters or by its arrival before the first pulse")
    if record.doubt:
        return _Doubt(record.doubt)
    # A card that restarts within the row counts from its first counters on: again, if the row began with them.
    counted_twice = bool(row.conflicts) or row.counts.late_by_bytes > _FAR_BEHIND * record.full
    if row.counts.restarted or (record.start == SWITCHED_ON and counted_twice):
        return _Doubt("the card restarted within it")
    if record.too_early.any():
        return _Doubt("frames came before the first pulse was sent: spurious edges on SYNC_IN")
    if record.length > expected or record.beyond.any():
        return _Doubt("more bytes came than the row has: the radar saw spurious triggers")
    if record.later.sum() >= MIN_PACKETS_OF_A_RECORD:
        return _Doubt("packets of a later record came with it: the card ended this one and began another")
    if record.ends_as_planned:
        return _Doubt()
    missing = expected - record.length
    if not record.ended:
        return _Doubt(
            f"the end of the record did not come ({missing} bytes): without it, data that the card dropped unnoticed or"
            " missed SYNC_IN pulses do not show"
        )
    if missing % frame_bytes or frame_bytes == 1:
        return _Doubt(f"the record ended {missing} bytes early: the card dropped data before numbering it")
    text = f"the record ended {missing // frame_bytes} frames early: missed SYNC_IN pulses"
    # Frames are moved by their arrival only in a record about which nothing else is unclear.
    clean = row.counts.late == 0 and not row.conflicts and not record.later.any()
    return _Doubt(text, frames_missing=clean)


def _past_after(past: Past, record: _Record, undelivered: list[Gap]) -> Past:
    """Return where the next record begins."""
    if record.start is None or not record.own.any() or record.later.any() or record.anew.any():
        return Past(lost=True, restarts=past.restarts)
    length = record.length
    # Only a short packet, or the last planned byte of a record of full packets, is a record's end.
    end_is_known = record.ended or record.ends_as_planned
    if not end_is_known or record.beyond.any():
        return Past(lost=True, restarts=past.restarts)
    next_start = record.start.after(length, -(-length // record.full))
    if record.start_is_certain:
        if past.restarts >= RESTARTS:
            return Past(start=SWITCHED_ON, restarts=past.restarts, undelivered=tuple(undelivered))
        chained = past.start is not None and past.start != SWITCHED_ON
        return Past(start=next_start, restarts=0 if chained else past.restarts)
    # The end of a scan's first record is one wherever that began.
    if past == Past() and record.ended:
        return Past(start=next_start)
    # A whole record at another place than predicted is not trusted: it may be a second card's.
    lost = Past(lost=True, restarts=past.restarts)
    if not record.ends_as_planned or length < SMALL_RECORD * record.full or (~record.own & ~record.early).any():
        return lost
    if record.start != SWITCHED_ON:
        joined = past.joined + 1 if record.start == past.elsewhere else 0
        return replace(lost, elsewhere=next_start, joined=joined)
    if past.restarts + 1 >= RESTARTS:
        return Past(start=SWITCHED_ON, restarts=past.restarts + 1, undelivered=tuple(undelivered))
    return replace(lost, restarts=past.restarts + 1)


def _count_packets(
    log: PacketLog, record: _Record, placed: Flags, duplicate: Flags, conflicting: Flags
) -> PacketCounts:
    """Count a row's packets. `placed`, `duplicate`, `conflicting`: bool [packet], disjoint."""
    rest = ~(placed | duplicate | conflicting)
    leftover = rest & (record.early | ((record.offsets < 0) & (record.steps < 0) & ~record.anew))
    restarted = rest & record.anew & ~leftover
    rest &= ~(leftover | restarted)
    behind_the_row = (record.offsets >= log.expected) & (record.steps > 0) & (record.offsets < 2 * log.expected)
    outside = rest & (record.own | record.beyond | behind_the_row)
    return PacketCounts(
        placed=int(placed.sum()),
        duplicates=int(duplicate.sum()),
        conflicting=int(conflicting.sum()),
        leftover=int(leftover.sum()),
        restarted=int(restarted.sum()),
        outside=int(outside.sum()),
        disagreeing=int((rest & ~outside).sum()),
        malformed=log.malformed,
        before_pulses=int((record.early & leftover).sum()),
        clock_jumps=record.clock_jumps,
    )


# ---- bytes --------------------------------------------------------------------------------------------------------


class _Row:
    """Puts the packets of a record in place."""

    def __init__(self, log: PacketLog, record: _Record) -> None:
        self._log, self._record = log, record
        self._sizes, self._starts = log.sizes, np.cumsum(log.sizes) - log.sizes
        kept = np.arange(log.count) < log.kept
        self._own = record.own & kept
        self.at: Counts = np.full(log.count, -1, dtype=np.int64)
        self.covered: list[Gap] = []  # sorted, joined
        self.conflicts: list[Gap] = []
        self.received = self.extent = 0
        self._stops = np.minimum(record.offsets + self._sizes, log.expected)
        self._placed, self._duplicate, self._conflicting = np.zeros((3, log.count), dtype=np.bool_)
        self._place()
        self.counts = _count_packets(log, record, self._placed, self._duplicate, self._conflicting)
        self._measure()

    def _measure(self) -> None:
        """Find what is covered, and what came late."""
        mine = np.flatnonzero(self._placed)
        if not mine.size:
            return
        starts, stops = self._record.offsets[mine], self._stops[mine]
        order = np.argsort(starts, kind="stable")
        a, b = starts[order], np.maximum.accumulate(stops[order])
        new = np.flatnonzero(np.append(True, a[1:] > b[:-1]))
        self.covered = list(zip(a[new].tolist(), b[np.append(new[1:] - 1, len(b) - 1)].tolist(), strict=True))
        self.extent, self.received = int(b[-1]), sum(stop - start for start, stop in self.covered)
        reached = np.maximum.accumulate(np.append(0, stops))[:-1]
        behind = reached - starts
        self.counts.late = int((behind > 0).sum())
        self.counts.late_by_bytes = max(0, int(behind.max()))
        self.counts.short = int((self._sizes[mine] < self._record.full).sum())

    def _place(self) -> None:
        """Of packets at the same place, select the first and any with more bytes."""
        own = np.flatnonzero(self._own)
        offsets = self._record.offsets[own]
        order = np.argsort(offsets, kind="stable")
        sorted_offsets = offsets[order]
        new = np.append(True, np.diff(sorted_offsets) != 0)[: order.size]
        self._placed[own] = True
        self.at[own] = offsets
        if new.all():
            return
        firsts = np.flatnonzero(new)
        for i, j in zip(firsts.tolist(), [*firsts[1:].tolist(), order.size], strict=True):
            if j - i > 1:
                self._overlap(own[order[i:j]].tolist())

    def _overlap(self, packets: list[int]) -> None:
        """Compare packets of one place, in order of arrival, with the longest so far."""
        longest = packets[0]
        for k in packets[1:]:
            offset = int(self._record.offsets[k])
            both = min(int(self._stops[k]), int(self._stops[longest])) - offset
            if not np.array_equal(self._payload(k)[:both], self._payload(longest)[:both]):
                self.conflicts.append((offset, offset + both))
                self._placed[k], self._conflicting[k], self.at[k] = False, True, -1
                if self._stops[k] > self._stops[longest]:
                    self.conflicts.append((offset, int(self._stops[k])))
                    self.conflicts.append((offset, int(self._stops[longest])))
            elif self._stops[k] > self._stops[longest]:
                longest = k
            else:
                self._placed[k], self._duplicate[k] = False, True

    def _payload(self, k: int) -> Bytes:
        return self._log.payload[self._starts[k] : self._starts[k] + self._sizes[k]]

    def arrivals(self) -> Counts:
        """Return the arrival time of each batch and the bytes received by then, int64 [n, 2]."""
        batches = self._log.batches
        if not batches.size:
            return np.zeros((0, 2), dtype=np.int64)
        reached = np.append(0, np.maximum.accumulate(np.where(self._placed, self._stops, 0)))
        pairs = np.column_stack([batches[:, 0], reached[batches[:, 1]]])
        return np.ascontiguousarray(pairs[pairs[:, 1] > 0])

    def bytes(self, holes: list[Gap]) -> Bytes:
        """Return the row: the log's own memory if it came whole and in order, otherwise a copy. Zero at the holes.

        The log's payload stays as it came: it is stored as the evidence.
        """
        log, mine = self._log, np.flatnonzero(self._placed)
        out = log.payload[: log.expected]
        whole = not holes and self.extent == log.expected
        if not whole or (self.at[mine] != self._starts[mine]).any():
            out = np.zeros(log.expected, dtype=np.uint8)
            self._copy(mine, out)
        out[self.extent :] = 0
        for start, stop in holes:
            out[start:stop] = 0
        return out

    def _copy(self, mine: Counts, out: Bytes) -> None:
        """Copy runs of packets that are consecutive in the log and in the row."""
        if not mine.size:
            return
        offsets, sizes, starts, stops = self.at[mine], self._sizes[mine], self._starts[mine], self._stops[mine]
        joined = (starts[1:] == starts[:-1] + sizes[:-1]) & (offsets[1:] == offsets[:-1] + sizes[:-1])
        firsts = np.flatnonzero(np.append(True, ~joined))
        lasts = np.append(firsts[1:] - 1, len(mine) - 1)
        for i, j in zip(firsts.tolist(), lasts.tolist(), strict=True):
            a, b = int(offsets[i]), int(stops[j])
            out[a:b] = self._log.payload[starts[i] : starts[i] + b - a]


def _losses(missing: list[Gap], extent: int, expected: int) -> Losses:
    if not extent:
        return Losses(tail_bytes=expected)
    head = sum(b - a for a, b in missing if a == 0)
    inner = [min(b, extent) - a for a, b in missing if 0 < a < extent]
    return Losses(head, len(inner), sum(inner), expected - extent)


def _gaps(covered: list[Gap], extent: int) -> list[Gap]:
    """Return the ranges of [0, extent) that are not covered."""
    edges = [0, *(edge for gap in covered for edge in gap), extent]
    return [(a, b) for a, b in zip(edges[::2], edges[1::2], strict=True) if b > a]


def _merged(gaps: list[Gap]) -> list[Gap]:
    """Return the same bytes as sorted ranges that do not touch."""
    out: list[Gap] = []
    for start, stop in sorted(gaps):
        if out and start <= out[-1][1]:
            out[-1] = (out[-1][0], max(out[-1][1], stop))
        else:
            out.append((start, stop))
    return out
