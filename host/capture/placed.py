"""What becomes of a record's packets: where it began, how many packets of each kind came, which bytes did not."""

from __future__ import annotations

from dataclasses import dataclass, field

Gap = tuple[int, int]


@dataclass(frozen=True)
class Counters:
    """The card's counters at the start of a record: byte count of its first byte, sequence of its first packet."""

    byte_count: int
    sequence: int


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
