"""Where a packet's payload belongs: placement of one record by 48-bit byte count, so that survivors are bit-exact.

The byte count of the card does not start at zero with each record, so everything is relative to a *base*, the count of
the record's first byte. The base is known when the previous record's end is known, or when the card's counters are
fresh; otherwise it is that of the earliest packet seen, and it is confirmed only by where the record ends. What cannot
be located for certain is masked as a whole: data is original or masked, never invented.
"""

from __future__ import annotations

import bisect
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from polysight.host.capture.dca1000 import (
    BYTE_COUNT_BITS,
    MAX_PAYLOAD_BYTES,
    PACKET_HEADER_BYTES,
    SEQUENCE_BITS,
    Counters,
    counter_difference,
)

Gap = tuple[int, int]
Bytes = NDArray[np.uint8]


@dataclass
class PacketCounts:
    """Packets of one record by what became of them: every packet is in exactly one of the first six.

    The last three say more about those that were placed.
    """

    placed: int = 0
    duplicates: int = 0  # every byte was there already
    leftover: int = 0  # of the record before this one
    outside: int = 0  # after the record's last expected byte, or too far from the others to be of one record
    disagreeing: int = 0  # byte count and sequence contradict each other
    malformed: int = 0  # no payload, or longer than the card's packets
    late: int = 0  # placed, after a packet that follows it
    late_by_bytes: int = 0  # how far the latest of them was behind
    short: int = 0  # placed, not full; a healthy record has one at most, its last


@dataclass(frozen=True)
class Losses:
    """Bytes that did not come, by where: before the first packet, in gaps between packets, after the last one."""

    head_bytes: int = 0
    gaps: int = 0
    gap_bytes: int = 0
    tail_bytes: int = 0


@dataclass(frozen=True)
class Placed:
    """What became of one record.

    Attributes
    ----------
    missing
        Byte ranges (start, stop) that are not in the buffer: sorted, not touching.
    losses
        The same by kind. Of a record that is not located it is only what the counters say.
    located
        Whether every byte's place is certain. When it is not, `missing` is the whole record and `reason` says why.
    next_start
        Counters with which the card's next record should start; None when no packet came.
    holes
        Byte ranges below the furthest byte that did not come, in the order in which the card sent the bytes.
    slipped
        Whether it is only not located because frames may be missing before any byte of it: missed triggers.
    """

    expected: int
    received: int
    missing: list[Gap]
    located: bool
    reason: str
    counts: PacketCounts
    losses: Losses
    next_start: Counters | None
    holes: list[Gap] = field(default_factory=list)
    slipped: bool = False

    @property
    def complete(self) -> bool:
        """Whether every byte is there and nothing more came."""
        return self.located and not self.missing


@dataclass
class Placement:
    """Places the packets of one record into `out`.

    Parameters
    ----------
    out
        uint8 [expected bytes], zero; the record's place in memory.
    frame_bytes
        Bytes of one frame: a record that ends a whole number of frames early has missed triggers, and where is not
        known. 1 when the record has no frames.
    start
        Where the record should start, from the previous record's end.
    """

    out: Bytes
    frame_bytes: int = 1
    start: Counters | None = None
    counts: PacketCounts = field(default_factory=PacketCounts)

    def __post_init__(self) -> None:
        self.expected = int(self.out.size)
        self.received = 0  # bytes placed
        self.extent = 0  # end of the furthest byte placed
        self._gaps: list[Gap] = []  # ranges missing below the extent
        self._base: int | None = None
        self._certain = False
        self._anchor_sequence = 0  # a packet whose two counters are taken to belong together ...
        self._anchor_offset = 0  # ... and its place
        self._excess = 0
        self._full = 0  # payload of the largest packet
        self._last_sequence = 0
        self._last_size = 0
        self.forgotten = False  # what came first was of the record before

    @property
    def complete(self) -> bool:
        """Whether every expected byte is there."""
        return self.received == self.expected

    @property
    def ended(self) -> bool:
        """Whether the furthest packet is a short one: only the last of a record is."""
        return 0 < self._last_size < self._full

    def place_packet(self, packet: bytes) -> None:
        """Place one packet, header included."""
        self.place(np.frombuffer(packet, dtype=np.uint8)[None, :], np.array([len(packet)]))

    def place(self, packets: Bytes, lengths: NDArray[np.integer]) -> None:
        """Place packets in the order of their arrival.

        Parameters
        ----------
        packets
            uint8 [n, at least the longest length]: header and payload.
        lengths
            integer [n]: bytes of each packet.
        """
        sizes = lengths.astype(np.int64) - PACKET_HEADER_BYTES
        good = (sizes > 0) & (sizes <= MAX_PAYLOAD_BYTES)
        if packets.shape[1] <= PACKET_HEADER_BYTES or not good.all():
            self.counts.malformed += int((~good).sum())
            if packets.shape[1] <= PACKET_HEADER_BYTES or not good.any():
                return
            packets, sizes = packets[good], sizes[good]
        head = np.ascontiguousarray(packets[:, :PACKET_HEADER_BYTES])
        sequences = head[:, 0:4].copy().view("<u4")[:, 0]
        byte_counts = head[:, 4:8].copy().view("<u4")[:, 0].astype(np.uint64)
        byte_counts |= head[:, 8:10].copy().view("<u2")[:, 0].astype(np.uint64) << np.uint64(32)
        if self._base is None and len(sizes) > 1:
            self.place(packets[:1], lengths[good][:1])  # by itself, for what follows it tells what it was
            return self.place(packets[1:], lengths[good][1:])
        self._drop_last_of_before(int(sequences[0]), int(byte_counts[0]), int(sizes[0]))
        base = self._base
        if base is None:
            base = self._find_base(int(sequences[0]), int(byte_counts[0]), int(sizes[0]))
        offsets = _differences(byte_counts, base, BYTE_COUNT_BITS)
        steps = _differences(sequences.astype(np.uint64), self._anchor_sequence, SEQUENCE_BITS)
        # Only the last packet of a record is not full, so k packets further on are k full payloads further on.
        self._full = max(self._full, int(sizes.max()))
        agree = offsets - self._anchor_offset == steps * self._full
        if self._certain:
            agree |= (offsets < 0) & (steps < 0)  # left over from the record before, which need not be proportional
        follows = np.empty(offsets.size, dtype=np.bool_)
        follows[0] = False
        follows[1:] = (offsets[1:] == offsets[:-1] + sizes[:-1]) & agree[1:] & agree[:-1]
        starts = np.flatnonzero(~follows)
        shift = 0  # the base may move while this batch is placed
        for i, j in zip(starts.tolist(), [*starts[1:].tolist(), offsets.size], strict=True):
            if not agree[i]:
                self.counts.disagreeing += j - i
                continue
            shift += self._run(packets[i:j], sequences[i:j], offsets[i:j] + shift, sizes[i:j])

    def _drop_last_of_before(self, sequence: int, byte_count: int, size: int) -> None:
        """Forget the only packet so far when a larger one follows right behind: it was the record's before.

        Only the last packet of a record is not full, and the card may send it long after the record was stopped.
        """
        if self._base is None or self.counts.placed != 1 or not 0 < self.extent == self._last_size < size:
            return
        behind = Counters(self._base, self._last_sequence).after(self.extent, 1)
        if behind == Counters(byte_count, sequence):
            self.out[: self.extent] = 0
            self.counts.placed, self.counts.leftover = 0, self.counts.leftover + 1
            self.start, self._base, self._certain, self._full = behind, None, False, 0
            self.received = self.extent = self._last_size = 0
            self.forgotten = True

    def _find_base(self, sequence: int, byte_count: int, size: int) -> int:
        """The base from the first packet seen, which need not be the first of the record."""
        self._anchor_sequence = sequence
        ahead = 0
        if self.start is not None:
            ahead = counter_difference(byte_count, self.start.byte_count, BYTE_COUNT_BITS)
            lost = counter_difference(sequence, self.start.sequence, SEQUENCE_BITS)
            full = ahead // lost if lost > 0 and ahead % lost == 0 else 0  # of the packets lost before this one
            head_lost = size <= full <= MAX_PAYLOAD_BYTES and 0 < ahead < self.expected
            self._full = full if head_lost else 0
            self._certain = ahead == 0 or head_lost
        if not self._certain:
            ahead = 0
            self._certain = byte_count == 0 and sequence == 1  # counters are fresh
        self._anchor_offset = ahead
        self._base = (byte_count - ahead) % (1 << BYTE_COUNT_BITS)
        return self._base

    def _run(
        self,
        packets: Bytes,
        sequences: NDArray[np.uint32],
        offsets: NDArray[np.int64],
        sizes: NDArray[np.int64],
    ) -> int:
        """Place packets that follow each other without a gap; returns how far the base moved back."""
        first, last, n = int(offsets[0]), int(offsets[-1] + sizes[-1]), len(sizes)
        if first >= self.extent and last <= self.expected and (sizes[:-1] == sizes[0]).all():
            if first > self.extent:
                self._gaps.append((self.extent, first))
            size = int(sizes[0])
            body = packets[:, PACKET_HEADER_BYTES:]
            whole = n if int(sizes[-1]) == size else n - 1
            target = self.out[first : first + whole * size].reshape(whole, size)
            target[:] = body[:whole, :size]
            if whole < n:
                self.out[first + whole * size : last] = body[-1, : int(sizes[-1])]
            self.counts.placed += n
            self.counts.short += int((sizes < self._full).sum())
            self.received += last - first
            self.extent = last
            self._last_sequence, self._last_size = int(sequences[-1]), int(sizes[-1])
            return 0
        moved = 0
        for k in range(n):
            moved += self._one(packets[k], int(sequences[k]), int(offsets[k]) + moved, int(sizes[k]))
        return moved

    def _one(self, packet: Bytes, sequence: int, start: int, size: int) -> int:
        """Place one packet anywhere; returns how far the base moved back."""
        moved, stop = 0, start + size
        if start < 0:
            if self._certain:
                self.counts.leftover += 1
                return 0
            if not self._move_base(-start):
                self.counts.outside += 1
                return 0
            moved, start, stop = -start, 0, size
            # Fresh counters are certain, whichever packet of the record came first.
            self._certain = self._base == 0 and sequence == 1
        if stop > self.expected:
            self._excess += stop - max(start, self.expected)
            if start >= self.expected:
                self.counts.outside += 1
                return moved
            stop = self.expected
        behind = self.extent - start
        pieces = self._absent(start, stop)
        if not pieces:
            self.counts.duplicates += 1
            return moved
        body = packet[PACKET_HEADER_BYTES:]
        for a, b in pieces:
            self.out[a:b] = body[a - start : b - start]
            self.received += b - a
        self._cover(start, stop)
        self.counts.placed += 1
        if behind > 0:
            self.counts.late += 1
            self.counts.late_by_bytes = max(self.counts.late_by_bytes, behind)
        self.counts.short += size < self._full
        if stop == self.extent:
            self._last_sequence, self._last_size = sequence, size
        return moved

    def _absent(self, start: int, stop: int) -> list[Gap]:
        """The parts of [start, stop) that hold no data yet."""
        pieces = []
        i = bisect.bisect_right(self._gaps, start, key=lambda gap: gap[1])
        while i < len(self._gaps) and self._gaps[i][0] < stop:
            pieces.append((max(start, self._gaps[i][0]), min(stop, self._gaps[i][1])))
            i += 1
        if stop > self.extent:
            pieces.append((max(start, self.extent), stop))
        return pieces

    def _cover(self, start: int, stop: int) -> None:
        """Mark [start, stop) as there."""
        if start > self.extent:
            self._gaps.append((self.extent, start))
        elif start < self.extent:
            i = bisect.bisect_right(self._gaps, start, key=lambda gap: gap[1])
            j = i
            left: list[Gap] = []
            while j < len(self._gaps) and self._gaps[j][0] < stop:
                a, b = self._gaps[j]
                left += [gap for gap in ((a, min(b, start)), (max(a, stop), b)) if gap[1] > gap[0]]
                j += 1
            self._gaps[i:j] = left
        self.extent = max(self.extent, stop)

    def _move_base(self, back: int) -> bool:
        """Move the base `back` bytes to an earlier one, if the record has room for it."""
        if self._base is None or self.extent + back > self.expected:
            return False
        self.out[back : back + self.extent] = self.out[: self.extent].copy()
        self.out[:back] = 0
        self._gaps = [(0, back), *((a + back, b + back) for a, b in self._gaps)]
        if len(self._gaps) > 1 and self._gaps[1][0] == back:
            self._gaps[:2] = [(0, self._gaps[1][1])]
        self.extent += back
        self._anchor_offset += back
        self._base = (self._base - back) % (1 << BYTE_COUNT_BITS)
        return True

    def finish(self, dropped_by_card: str = "") -> Placed:
        """End the record: decide whether its place is certain, and what is missing.

        `dropped_by_card` names the status bits by which the card said that it dropped data before it numbered the
        packets. Then bytes are gone without a gap in the counters, and no byte's place is certain.
        """
        located, reason = self._locate()
        if dropped_by_card:
            located, reason = False, f"the card dropped data before numbering it ({dropped_by_card})"
        slipped = not located and self._certain and self.extent > 0 and not (self._excess or dropped_by_card)
        missing = list(self._gaps)
        if self.extent < self.expected:
            missing.append((self.extent, self.expected))
        losses = self._losses(missing)
        if not located:
            missing = [(0, self.expected)] if self.expected else []
        next_start = None
        if self._base is not None and self.extent:
            lost = -(-(self.expected - self.extent) // self._full) if located else 0
            end = self.expected if located else self.extent
            next_start = Counters(self._base, self._last_sequence).after(end, 1 + lost)
        received, holes = self.received, list(self._gaps)
        return Placed(
            self.expected, received, missing, located, reason, self.counts, losses, next_start, holes, slipped
        )

    def _losses(self, missing: list[Gap]) -> Losses:
        if not self.extent:
            return Losses(tail_bytes=self.expected)
        head = sum(b - a for a, b in missing if a == 0)
        tail = self.expected - self.extent
        inner = [b - a for a, b in missing if a > 0 and a < self.extent]
        return Losses(head, len(inner), sum(inner), tail)

    def _locate(self) -> tuple[bool, str]:
        deficit = self.expected - self.extent
        whole_frames = deficit % self.frame_bytes == 0 and self.frame_bytes > 1
        if self.extent == 0:
            return self.expected == 0, "no packet came"
        if self._excess:
            return False, f"{self._excess} bytes more than the row has: triggers the radar should not have seen"
        if deficit == 0:
            return True, ""
        if not self._certain:
            if self.ended and deficit % self._full == 0 and not whole_frames and self._move_base(deficit):
                self._certain = True  # the end is where it should be only if whole packets are gone at the start
                return True, ""
            return False, f"{deficit} bytes short, and the record's first byte is not known"
        if self.ended:
            frames = f" ({deficit // self.frame_bytes} frames)" if whole_frames else ""
            return False, (
                f"the record ended {deficit} bytes{frames} early: missed SYNC_IN pulses, or the card dropped data"
                " before numbering it"
            )
        if deficit >= self.frame_bytes > 1:
            return False, f"the last {deficit} bytes did not come: whether frames are missing before them is not known"
        return True, ""


def _differences(counters: NDArray[np.uint64], origin: int, bits: int) -> NDArray[np.int64]:
    """:func:`counter_difference` of many counters, uint64 [n], from one origin."""
    spare = 64 - bits
    wrapped = (counters - np.uint64(origin)) << np.uint64(spare)  # the top bit of the counter becomes the sign
    return wrapped.view(np.int64) >> np.int64(spare)
