"""Decide which packets are a row, and where each byte belongs (docs/spec/placement.md).

A *record* is one recording of a card, normally that of one row of the scan. A card numbers every byte that it sends:
each packet has a byte count and a sequence number, its *counters*. If the counters of the row's first byte, the
*start*, are known, each packet's place follows from its counters alone. Packets with earlier counters are left over
from an earlier record; packets whose counters do not fit the start belong to another record.

A card may drop bytes before it numbers them, and a radar may miss or add a frame. Only the length of the record shows
that. So a row is *located* if its start is known and its record ends where it must. A row that is not located is masked
as a whole. Every byte of a row is original or masked, never guessed.

The start of a record is known after one whose start and end are certain, and after a reset by the host
(`EarlierRecords`). After any other record the host has to reset the card.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from polysight.capture.dca1000 import BYTE_COUNT_BITS, MAX_PAYLOAD_BYTES, SEQUENCE_BITS, Counters, PacketLog

Bytes = NDArray[np.uint8]
Counts = NDArray[np.int64]
Flags = NDArray[np.bool_]
# A gap is a range of bytes of the row: its first, and the one after its last.
Gap = tuple[int, int]

COUNTERS_AFTER_RESET = Counters(0, 1)
"""Counters of the first packet of a card that was switched on or reset."""
# If fewer packets seem to be of another record, or of a second card, they count as damaged; chosen.
MIN_PACKETS_OF_A_RECORD = 3
# Largest number of later packets that may arrive before a packet. If more do, the card has restarted and used the same
# counters twice. Chosen: far more than a switch or the kernel reorders.
_MOST_OVERTAKING_PACKETS = 64
# A size of fewer packets does not count as the size of full packets: the last packet of a record is short.
_MIN_PACKETS_OF_A_SIZE = 3


@dataclass(frozen=True)
class EarlierRecords:
    """Start of the next record, known from the records before it."""

    # Counters of the next record's first byte. None: they are unknown, and the card has to be reset.
    start: Counters | None = None

    @property
    def lost(self) -> bool:
        """True if the start is unknown."""
        return self.start is None

    @staticmethod
    def after_reset() -> EarlierRecords:
        """Return the start after a reset by the host: the card's memory is empty, and its counters start again."""
        return EarlierRecords(start=COUNTERS_AFTER_RESET)


@dataclass
class PacketCounts:
    """Packets of one row by result: every packet is in exactly one of the first eight counts, `placed` to `malformed`.

    Of the others, `late` and `short` count packets of `placed`, and `before_pulses` packets of `leftover`.
    """

    placed: int = 0
    # Packets whose bytes had all come before, with the same values.
    duplicates: int = 0
    # Packets whose bytes differ from those of another packet with equal counters; their place in the row is masked.
    conflicting: int = 0
    # Number of packets that belong to an earlier record.
    leftover: int = 0
    # Packets with the counters of a card that restarted within the row.
    restarted: int = 0
    # Packets beyond the record's last expected byte, or not kept for lack of memory.
    outside: int = 0
    # All others: their byte count and sequence number contradict each other, or are far from the row's.
    disagreeing: int = 0
    # Packets without payload, or longer than the card's.
    malformed: int = 0
    # Placed packets that came after a packet of a later place.
    late: int = 0
    # Largest delay of late packets, bytes.
    late_by_bytes: int = 0
    # Placed packets that are not full: normally only the last one of a record.
    short: int = 0
    # Number of packets in `leftover` that came before the row's first pulse.
    before_pulses: int = 0


@dataclass(frozen=True)
class Losses:
    """Missing bytes of a row: before its first packet, in `gaps` gaps between packets, after its last one."""

    head_bytes: int = 0
    gaps: int = 0
    gap_bytes: int = 0
    tail_bytes: int = 0


@dataclass(frozen=True)
class PlacedRecord:
    """Result of placing one record."""

    # Bytes of the whole row, and those that are in place.
    expected: int
    received: int
    # Byte ranges (start, stop) that are missing or uncertain: sorted, not touching.
    missing: list[Gap]
    # True if the place of every byte is certain; otherwise `missing` is the whole record.
    located: bool
    # Why the row is not located; "" if it is.
    reason: str
    counts: PacketCounts
    # Missing bytes by kind, as the packets' counters show them, also for a record that is not located.
    losses: Losses
    # Knowledge for placing the next record.
    past: EarlierRecords
    # int64 [packet]: offset of the packet's payload in the row, -1 outside the row.
    offsets: Counts
    # int64 [n, 2]: time (host's monotonic clock, ns), and end of the furthest packet that had come by then, bytes.
    arrivals: Counts
    # Missing or uncertain ranges before the furthest byte that came, sorted, as the packets' counters show them.
    holes: list[Gap] = field(default_factory=list)
    # True if nothing but missing whole frames (missed triggers) keeps the row from being located.
    slipped: bool = False

    @property
    def complete(self) -> bool:
        """True if the row is located and no byte is missing or uncertain."""
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
    """Progress of a running row."""

    # Bytes in place; each counts once.
    received: int
    # True if all bytes are in place and the record ends where it should.
    complete: bool
    # True if the furthest packet is a short one: the card ended the record.
    ended: bool


class Evidence(msgspec.Struct, frozen=True):
    """Inputs for placing a row, in addition to its packets (:func:`place_record`). By default the start is unknown."""

    # Bytes of the whole row.
    expected: int
    frame_bytes: int
    not_before_ns: int = 0
    dropped_by_card: str = ""
    past: EarlierRecords = EarlierRecords()


def place_record(
    log: PacketLog,
    frame_bytes: int = 1,
    past: EarlierRecords | None = None,
    not_before_ns: int = 0,
    dropped_by_card: str = "",
) -> tuple[PlacedRecord, Bytes]:
    """Place one row's packets; return the result and the row: uint8 [expected], zero at the holes.

    Parameters
    ----------
    log
        The packets; the returned row may share its memory.
    frame_bytes
        Bytes of one frame, 1 if the record has no frames.
    past
        Knowledge from earlier records; default: the card was reset.
    not_before_ns
        A time before the first pulse of the row, in ns of the arrivals' clock. Packets that came before it are not of
        the row. 0: it is unknown, and no packet is too early.
    dropped_by_card
        Names of the status bits by which the card reported data dropped before the packets were numbered: bytes are
        missing without a gap in the counters, so that no byte's place is certain.
    """
    past = past or EarlierRecords.after_reset()
    record = _find_record(log, past, not_before_ns)
    row = _Row(log, record)
    cause = _find_doubt(record, row, log, frame_bytes)
    if past.lost:
        cause = _Doubt("it is unknown where the last record ended")
    if not cause.text and dropped_by_card:
        cause = _Doubt(f"the card dropped data before numbering it ({dropped_by_card})")
    holes = _merge([*_find_gaps(row.covered, row.extent), *row.conflicts])
    missing = _merge([*holes, (row.extent, log.expected)])
    if cause.text:
        out = row.fill_row(holes)
        masked = _merge([(0, log.expected)])
    else:
        out = row.fill_row(missing)
        masked = missing
    placed = PlacedRecord(
        expected=log.expected,
        received=row.received,
        missing=masked,
        located=not cause.text,
        reason=cause.text,
        counts=row.counts,
        losses=_count_losses(missing, row.extent, log.expected),
        past=_continue_past(record, cause),
        offsets=row.offsets,
        arrivals=row.arrivals(),
        holes=holes,
        slipped=cause.frames_missing and not dropped_by_card,
    )
    return placed, out


def preview(log: PacketLog, past: EarlierRecords, not_before_ns: int) -> Preview:
    """Return the progress of a row from its packets so far, without comparing or copying payload."""
    record = _find_record(log, past, not_before_ns)
    if not record.of_row.any():
        return Preview(0, log.expected == 0, ended=False)
    # Packets in the order of their place. Each byte counts once: of a packet, those beyond the ends of all earlier
    # ones.
    starts = record.offsets[record.of_row]
    ends = np.minimum(starts + log.sizes[record.of_row], log.expected)
    order = np.lexsort((ends, starts))
    reached = np.maximum.accumulate(ends[order])
    fresh = reached - np.maximum(np.append(0, reached[:-1]), starts[order])
    received = int(np.maximum(fresh, 0).sum())
    is_complete = not past.lost and record.ends_as_planned and received == log.expected
    return Preview(received, is_complete, record.ended)


# ---- evidence -----------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Record:
    """The record that is expected for the row, and how each packet relates to it; arrays are [packet]."""

    # Counters of the first byte of the record.
    start: Counters
    # int64: byte count of each packet minus that of the start.
    offsets: Counts
    # int64: sequence number of each packet minus that of the start.
    steps: Counts
    # Packets with counters within the row that came after the first pulse.
    of_row: Flags
    # Packets whose counters continue those of this record beyond the row's last byte.
    beyond: Flags
    # Packets of a record after this one: their counters do not fit this record's start.
    later: Flags
    # True for packets that came before the row's first pulse.
    early: Flags
    # Early packets with counters within the row: frames that no pulse of the row triggered.
    too_early: Flags
    # Packets with counters of a card that restarted within the row.
    after_restart: Flags
    # Payload of a full packet, bytes.
    full: int
    # Bytes from the start to the end of the furthest packet.
    length: int
    # True if the furthest packet is short, as only a record's last one is.
    ended: bool
    # True if the record ends at the row's last byte (with a short packet, unless full ones fill the row), and no
    # packet continues it.
    ends_as_planned: bool


def _find_record(log: PacketLog, past: EarlierRecords, not_before_ns: int) -> _Record:
    """Select the packets of the record that begins at `past.start`; if that is unknown, as after a reset."""
    full_payload = find_full_payload(log)
    is_early = log.arrivals_ns < not_before_ns
    start = past.start or COUNTERS_AFTER_RESET
    sizes = log.sizes
    expected = log.expected
    offsets = counter_differences(log.byte_counts, start.byte_count, BYTE_COUNT_BITS)
    steps = counter_differences(log.sequences, start.sequence, SEQUENCE_BITS)
    # All packets of a record but the last are full: so byte count and sequence number of a packet determine each other.
    counters_agree = (offsets == full_payload * steps) & (offsets >= 0)
    is_of_row = counters_agree & (offsets < expected) & ~is_early
    length = 0
    ended = False
    if is_of_row.any():
        stops = (offsets + sizes)[is_of_row]
        length = int(stops.max())
        ended = bool((sizes[is_of_row][stops == length] < full_payload).all())
    # Counters further ahead than these limits are those of damaged headers. Chosen: two rows of bytes, and as many
    # packets as four rows have.
    is_near = (
        (offsets < 2 * expected + 2 * full_payload)
        & (steps > 0)
        & (steps * full_payload < 4 * expected + 4 * full_payload)
        & ~is_early
    )
    is_beyond = is_near & counters_agree & (offsets >= expected)
    later = is_near & ~counters_agree & (offsets >= max(length, full_payload))
    ends_in_short = expected % full_payload > 0
    # A card that restarts counts again from byte 0 and packet 1. Its packets can be distinguished from the row's own
    # only if the row began far from there. They come after the row's first packet.
    after_restart = np.zeros_like(is_of_row)
    if start.byte_count > 2 * expected and is_of_row.any():
        counts_again = (log.byte_counts == full_payload * (log.sequences - 1)) & (log.byte_counts < expected)
        is_after_first = np.arange(log.count) > int(np.argmax(is_of_row))
        after_restart = counts_again & is_after_first & ~is_early & ~is_of_row
    return _Record(
        start=start,
        offsets=offsets,
        steps=steps,
        of_row=is_of_row,
        beyond=is_beyond,
        later=later & ~after_restart,
        early=is_early,
        too_early=is_early & counters_agree & (offsets < expected),
        after_restart=after_restart,
        full=full_payload,
        length=length,
        ended=ended,
        ends_as_planned=length == expected and ended is ends_in_short and not is_beyond.any(),
    )


def counter_differences(counters: Counts, origin: int, bits: int) -> Counts:
    """Return `counters - origin`, int64 [n], of counters that wrap after `bits` bits; nearest to zero."""
    spare = 64 - bits
    # Shifted to the left end of 64 bits, the difference wraps as the counter does, and its top bit becomes the sign.
    wrapped = (counters.astype(np.uint64) - np.uint64(origin)) << np.uint64(spare)
    return wrapped.view(np.int64) >> np.int64(spare)


def find_full_payload(log: PacketLog) -> int:
    """Return the payload of a full packet in bytes, as seen in the packets of a row.

    It is the card's default if a packet has that size, if the row fits into one packet, or if no size was seen in three
    or more packets. Otherwise it is the most frequent size, the largest of several.
    """
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
    """Why a record is not located, `text`; "" if it is. `frames_missing`: missing whole frames are the only cause."""

    text: str = ""
    frames_missing: bool = False


def _find_doubt(record: _Record, row: _Row, log: PacketLog, frame_bytes: int) -> _Doubt:
    """Return why the place of some bytes is not certain: the first reason that applies (docs/spec/placement.md)."""
    expected = log.expected
    if expected == 0:
        return _Doubt()
    if log.count == 0:
        return _Doubt("no packet came")
    if not record.of_row.any():
        return _Doubt("every packet belongs to another record or to a second card, or came before the first pulse")
    # A card that restarts within the row begins with its first counters again, and never counts to the row's end. If
    # the row began with them, too, the same counters come twice.
    counted_twice = bool(row.conflicts) or row.counts.late_by_bytes > _MOST_OVERTAKING_PACKETS * record.full
    counted_again = row.counts.restarted > 0 and not record.ends_as_planned
    if counted_again or (record.start == COUNTERS_AFTER_RESET and counted_twice):
        return _Doubt("the card restarted within it")
    # A second card may also send packets at places that are missing of the first, so no packet is certain.
    if row.counts.conflicting >= MIN_PACKETS_OF_A_RECORD:
        return _Doubt(
            f"{row.counts.conflicting} packets have other bytes than packets with equal counters: a second card has"
            " this address"
        )
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
            f"the end of the record is missing ({missing} bytes): without it, missed SYNC_IN pulses and data that "
            "the card dropped unnoticed cannot be detected"
        )
    if missing % frame_bytes or frame_bytes == 1:
        return _Doubt(f"the record ended {missing} bytes early: the card dropped data before numbering it")
    text = f"the record ended {missing // frame_bytes} frames early: missed SYNC_IN pulses"
    # Frames are moved by their arrival only in a record about which nothing else is unclear.
    is_undisturbed = row.counts.late == 0 and not row.conflicts and not record.later.any()
    return _Doubt(text, frames_missing=is_undisturbed)


def _continue_past(record: _Record, doubt: _Doubt) -> EarlierRecords:
    """Return the start of the next record; unknown if start or end of this one are not certain."""
    is_certain = not doubt.text or doubt.frames_missing
    if not is_certain or not record.of_row.any() or record.later.any():
        return EarlierRecords()
    # The last packet of a record may be short: the quotient is rounded up.
    packets = -(-record.length // record.full)
    return EarlierRecords(start=record.start.advance(record.length, packets))


def _count_packets(
    log: PacketLog, record: _Record, placed: Flags, duplicate: Flags, conflicting: Flags
) -> PacketCounts:
    """Count a row's packets, except `late` and `short`. The other arguments are bool [packet], disjoint."""
    is_unplaced = ~(placed | duplicate | conflicting)
    leftover = is_unplaced & (record.early | ((record.offsets < 0) & (record.steps < 0) & ~record.after_restart))
    restarted = is_unplaced & record.after_restart & ~leftover
    is_unplaced &= ~(leftover | restarted)
    is_after_row = (record.offsets >= log.expected) & (record.steps > 0) & (record.offsets < 2 * log.expected)
    is_outside = is_unplaced & (record.of_row | record.beyond | is_after_row)
    return PacketCounts(
        placed=int(placed.sum()),
        duplicates=int(duplicate.sum()),
        conflicting=int(conflicting.sum()),
        leftover=int(leftover.sum()),
        restarted=int(restarted.sum()),
        outside=int(is_outside.sum()),
        disagreeing=int((is_unplaced & ~is_outside).sum()),
        malformed=log.malformed,
        before_pulses=int((record.early & leftover).sum()),
    )


# ---- bytes --------------------------------------------------------------------------------------------------------


class _Row:
    """The packets of a record, put in place in the row."""

    def __init__(self, log: PacketLog, record: _Record) -> None:
        self._log = log
        self._record = record
        self._sizes = log.sizes
        # Offset of each packet's payload in the log.
        self._log_starts = np.cumsum(log.sizes) - log.sizes
        is_kept = np.arange(log.count) < log.kept
        self._of_row = record.of_row & is_kept
        self.offsets: Counts = np.full(log.count, -1, dtype=np.int64)
        # Byte ranges that are covered by packets: sorted and joined.
        self.covered: list[Gap] = []
        # Byte ranges in which packets at the same place have different bytes.
        self.conflicts: list[Gap] = []
        # Bytes covered, and the end of the furthest packet in place.
        self.received = 0
        self.extent = 0
        # End of each packet in the row, at most the row's last byte.
        self._stops = np.minimum(record.offsets + self._sizes, log.expected)
        self._placed, self._duplicate, self._conflicting = np.zeros((3, log.count), dtype=np.bool_)
        self._place()
        self.counts = _count_packets(log, record, self._placed, self._duplicate, self._conflicting)
        self._measure()

    def _measure(self) -> None:
        """Set `covered`, `received` and `extent`, and count the packets that came late or are short."""
        placed = np.flatnonzero(self._placed)
        if not placed.size:
            return
        starts = self._record.offsets[placed]
        stops = self._stops[placed]
        # In the order of their place, a packet that starts beyond the ends of all earlier ones begins a new range.
        order = np.argsort(starts, kind="stable")
        ordered_starts = starts[order]
        furthest_ends = np.maximum.accumulate(stops[order])
        first_of_range = np.flatnonzero(np.append(True, ordered_starts[1:] > furthest_ends[:-1]))
        last_of_range = np.append(first_of_range[1:] - 1, len(order) - 1)
        range_starts = ordered_starts[first_of_range].tolist()
        range_ends = furthest_ends[last_of_range].tolist()
        self.covered = list(zip(range_starts, range_ends, strict=True))
        self.extent = int(furthest_ends[-1])
        self.received = sum(stop - start for start, stop in self.covered)
        # In the order of arrival, a packet that starts before an earlier end came late.
        reached = np.maximum.accumulate(np.append(0, stops))[:-1]
        bytes_behind = reached - starts
        self.counts.late = int((bytes_behind > 0).sum())
        self.counts.late_by_bytes = max(0, int(bytes_behind.max()))
        self.counts.short = int((self._sizes[placed] < self._record.full).sum())

    def _place(self) -> None:
        """Mark the packets that are put in place: of several at one place, the first, and any that adds bytes to it."""
        packets = np.flatnonzero(self._of_row)
        offsets = self._record.offsets[packets]
        order = np.argsort(offsets, kind="stable")
        sorted_offsets = offsets[order]
        # The slice is for a row without packets.
        is_new_place = np.append(True, np.diff(sorted_offsets) != 0)[: order.size]
        self._placed[packets] = True
        self.offsets[packets] = offsets
        if is_new_place.all():
            return
        # In this order, the packets of one place are those from `first` to before `end`.
        firsts = np.flatnonzero(is_new_place).tolist()
        ends = [*firsts[1:], order.size]
        for first, end in zip(firsts, ends, strict=True):
            if end - first > 1:
                self._compare_overlap(packets[order[first:end]].tolist())

    def _compare_overlap(self, packets: list[int]) -> None:
        """Compare packets of one place, in order of arrival, with the longest so far.

        One that differs is not placed, and all of its bytes become a conflict; one that adds no bytes is a duplicate.
        """
        longest = packets[0]
        for k in packets[1:]:
            offset = int(self._record.offsets[k])
            overlap = min(int(self._stops[k]), int(self._stops[longest])) - offset
            if not np.array_equal(self._slice_payload(k)[:overlap], self._slice_payload(longest)[:overlap]):
                self.conflicts.append((offset, int(self._stops[k])))
                self._placed[k] = False
                self._conflicting[k] = True
                self.offsets[k] = -1
            elif self._stops[k] > self._stops[longest]:
                longest = k
            else:
                self._placed[k] = False
                self._duplicate[k] = True

    def _slice_payload(self, k: int) -> Bytes:
        return self._log.payload[self._log_starts[k] : self._log_starts[k] + self._sizes[k]]

    def arrivals(self) -> Counts:
        """Return pairs (arrival time, ns; end of the packet) of packets that reach further than all before, [n, 2]."""
        stops = np.where(self._placed, self._stops, 0)
        reached = np.maximum.accumulate(stops)
        is_new = np.diff(reached, prepend=0) > 0
        return np.column_stack([self._log.arrivals_ns[is_new], reached[is_new]])

    def fill_row(self, holes: list[Gap]) -> Bytes:
        """Return the row, zero at the `holes`: a view of the log if it came completely and in order, otherwise a copy.

        In a copy the holes are zeroed, never in the log's payload, which is stored as evidence.
        """
        log = self._log
        placed = np.flatnonzero(self._placed)
        payload = log.payload[: log.expected]
        is_whole = not holes and self.extent == log.expected
        if not is_whole or (self.offsets[placed] != self._log_starts[placed]).any():
            payload = np.zeros(log.expected, dtype=np.uint8)
            self._copy(placed, payload)
        payload[self.extent :] = 0
        for start, stop in holes:
            payload[start:stop] = 0
        return payload

    def _copy(self, placed: Counts, out: Bytes) -> None:
        """Copy runs of packets that are consecutive in the log and in the row."""
        if not placed.size:
            return
        offsets = self.offsets[placed]
        sizes = self._sizes[placed]
        log_starts = self._log_starts[placed]
        stops = self._stops[placed]
        is_joined = (log_starts[1:] == log_starts[:-1] + sizes[:-1]) & (offsets[1:] == offsets[:-1] + sizes[:-1])
        firsts = np.flatnonzero(np.append(True, ~is_joined))
        lasts = np.append(firsts[1:] - 1, len(placed) - 1)
        for first, last in zip(firsts.tolist(), lasts.tolist(), strict=True):
            start = int(offsets[first])
            stop = int(stops[last])
            log_start = log_starts[first]
            out[start:stop] = self._log.payload[log_start : log_start + stop - start]


def _count_losses(missing: list[Gap], extent: int, expected: int) -> Losses:
    """Sort missing ranges into head, gaps and tail; `extent`: end of the furthest packet, 0 if none came."""
    if not extent:
        return Losses(tail_bytes=expected)
    head = sum(stop - start for start, stop in missing if start == 0)
    inner = [min(stop, extent) - start for start, stop in missing if 0 < start < extent]
    return Losses(head_bytes=head, gaps=len(inner), gap_bytes=sum(inner), tail_bytes=expected - extent)


def _find_gaps(covered: list[Gap], extent: int) -> list[Gap]:
    """Return the ranges of [0, extent) that are not covered; `covered` is sorted and joined."""
    # A gap reaches from the end of a covered range to the start of the next one.
    starts = [0, *(stop for _, stop in covered)]
    stops = [*(start for start, _ in covered), extent]
    return [(start, stop) for start, stop in zip(starts, stops, strict=True) if stop > start]


def _merge(gaps: list[Gap]) -> list[Gap]:
    """Return the bytes as sorted ranges that do not touch."""
    merged: list[Gap] = []
    for start, stop in sorted(gap for gap in gaps if gap[0] < gap[1]):
        if merged and start <= merged[-1][1]:
            merged[-1] = (merged[-1][0], max(merged[-1][1], stop))
        else:
            merged.append((start, stop))
    return merged
