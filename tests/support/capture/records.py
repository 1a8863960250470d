"""Packets of a row as a capture card numbers them, and their placement in the row.

Placement finds the bytes of the row that a packet has, from the two counters in the packet: its number, and the number
of bytes before it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from polysight.capture.dca1000 import Counters, PacketLog
from polysight.capture.placement import EarlierRecords, PlacedRecord, place_record
from polysight_simulators.cards import SentRecord

# Bytes of samples in a full packet
FULL = 1456
# Bytes of both counters at the start of a packet
HEADER_BYTES = 10


def encode_packet(sequence: int, byte_count: int, payload: bytes) -> bytes:
    """Return a packet as the card sends it. After its largest value a counter continues with 0."""
    count = byte_count % 2**48
    return (sequence % 2**32).to_bytes(4, "little") + count.to_bytes(6, "little") + payload


def encode_packets(data: bytes, sequence: int, byte_count: int) -> list[bytes]:
    """Return all packets of a record whose first packet has these counters."""
    packets = []
    for k, start in enumerate(range(0, len(data), FULL)):
        packets.append(encode_packet(sequence + k, byte_count + start, data[start : start + FULL]))
    return packets


@dataclass
class Record:
    """What a card records of a row: its bytes, and the packets in which they are sent."""

    data: bytes
    packets: list[bytes]

    @staticmethod
    def make(size: int, count: int, sequence: int, seed: int = 0) -> Record:
        # No byte is 0, so that a byte that is set to 0 by mistake is noticed.
        data = np.random.default_rng(seed).integers(1, 256, size, dtype=np.uint8).tobytes()
        return Record(data, encode_packets(data, sequence, count))

    def byte_range(self, k: int) -> tuple[int, int]:
        """Return start and stop of the bytes in packet k of the record."""
        return k * FULL, min((k + 1) * FULL, len(self.data))


class Card:
    """Makes one record after another, of `size` bytes each. `count` and `sequence` are counters of the first packet."""

    def __init__(self, size: int, count: int = 0, sequence: int = 1) -> None:
        self._size = size
        self._count = count
        self._sequence = sequence
        self._seed = 0

    def reset(self) -> None:
        self._count = 0
        self._sequence = 1

    def record(self, resets: tuple[int, ...] = ()) -> Record:
        """Return the next record. Before each packet whose number is in `resets` the card is reset."""
        self._seed += 1
        full_record = Record.make(self._size, 0, 1, self._seed)
        packets = []
        for k in range(len(full_record.packets)):
            if k in resets:
                self.reset()
            payload = full_record.data[k * FULL : (k + 1) * FULL]
            packets.append(encode_packet(self._sequence, self._count, payload))
            self._sequence += 1
            self._count += len(payload)
        return Record(full_record.data, packets)


def make_log(size: int, packets: list[bytes], batch: int = 7, t_ns: int = 1) -> PacketLog:
    """Return the packets of a row as a receiver logs them, `batch` at a time, the k-th at `t_ns` + k nanoseconds."""
    log = PacketLog(size)
    for i in range(0, len(packets), batch):
        batch_of_packets = packets[i : i + batch]
        sizes = [len(packet) for packet in batch_of_packets]
        block = np.zeros((len(batch_of_packets), max(HEADER_BYTES, *sizes)), dtype=np.uint8)
        for row, packet in zip(block, batch_of_packets, strict=True):
            row[: len(packet)] = np.frombuffer(packet, dtype=np.uint8)
        log.add(block, np.array(sizes), t_ns + i)
    return log


def place(
    size: int, packets: list[bytes], start: Counters | EarlierRecords, frame: int = 1, batch: int = 7
) -> tuple[PlacedRecord, np.ndarray]:
    """Place the packets of a row that starts with these counters, or after known earlier records."""
    earlier_records = EarlierRecords(start) if isinstance(start, Counters) else start
    return place_record(make_log(size, packets, batch), frame, earlier_records)


def find_next_start(placed: PlacedRecord) -> Counters | None:
    """Return the counters with which the card's next record starts; None if they are uncertain."""
    return placed.past.start


def make_mask(size: int, gaps: list[tuple[int, int]]) -> np.ndarray:
    """Return bool [size], true in the gaps (start, stop)."""
    mask = np.zeros(size, dtype=bool)
    for start, stop in gaps:
        mask[start:stop] = True
    return mask


def is_original_or_masked(record: Record, placed: PlacedRecord, out: np.ndarray) -> bool:
    """True if every byte of the placed row is that of the record, or is masked as missing."""
    is_kept = ~make_mask(out.size, placed.missing)
    return bool((out[is_kept] == np.frombuffer(record.data, dtype=np.uint8)[is_kept]).all())


def log_packets(sent: SentRecord, expected: int, batch: int) -> PacketLog:
    """Return the packets as a receiver logs them, `batch` at a time, each with the time of its arrival."""
    log = PacketLog(expected)
    for k in range(0, len(sent.arrivals), batch):
        arrivals = sent.arrivals[k : k + batch]
        sizes = [len(arrival.packet) for arrival in arrivals]
        block = np.zeros((len(arrivals), max(HEADER_BYTES, *sizes)), dtype=np.uint8)
        for row, arrival in zip(block, arrivals, strict=True):
            row[: len(arrival.packet)] = np.frombuffer(arrival.packet, dtype=np.uint8)
        times_ns = [arrival.t_ns for arrival in arrivals]
        log.add(block, np.array(sizes), np.array(times_ns))
    return log
