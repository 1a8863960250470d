"""Records of packets as a card numbers them, and their placement."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from polysight.capture.dca1000 import Counters, PacketLog
from polysight.capture.placement import EarlierRecords, PlacedRecord, place_record
from polysight_simulators.cards import SentRecord

# Bytes of samples in a full packet.
FULL = 1456


def encode_packet(sequence: int, byte_count: int, payload: bytes) -> bytes:
    """Return a packet as the card sends it; both counters begin again at 0 after their last value."""
    count = byte_count % 2**48
    return (sequence % 2**32).to_bytes(4, "little") + count.to_bytes(6, "little") + payload


def encode_packets(data: bytes, sequence: int, byte_count: int) -> list[bytes]:
    """Return all packets of a record that starts with these counters."""
    starts = range(0, len(data), FULL)
    return [encode_packet(sequence + k, byte_count + a, data[a : a + FULL]) for k, a in enumerate(starts)]


@dataclass
class Record:
    """What a card records of a row: its bytes, and the packets in which they are sent."""

    data: bytes
    packets: list[bytes]

    @staticmethod
    def make(size: int, count: int, sequence: int, seed: int = 0) -> Record:
        # No byte is zero, so that one that is wrongly set to zero differs.
        data = np.random.default_rng(seed).integers(1, 256, size, dtype=np.uint8).tobytes()
        return Record(data, encode_packets(data, sequence, count))

    def byte_range(self, k: int) -> tuple[int, int]:
        """Return start and stop of the bytes in packet k."""
        return k * FULL, min((k + 1) * FULL, len(self.data))


class Card:
    """Makes consecutive records of `size` bytes; `count` and `sequence` are the counters of the first packet."""

    def __init__(self, size: int, count: int = 0, sequence: int = 1) -> None:
        self._size = size
        self._count = count
        self._sequence = sequence
        self._seed = 0

    def reset(self) -> None:
        self._count = 0
        self._sequence = 1

    def record(self, resets: tuple[int, ...] = ()) -> Record:
        """Return the next record; the counters restart before each of the packets `resets`."""
        self._seed += 1
        full_record = Record.make(self._size, 0, 1, self._seed)
        packets = []
        for k in range(len(full_record.packets)):
            if k in resets:
                self.reset()
            payload = full_record.data[k * FULL : (k + 1) * FULL]
            packets.append(encode_packet(self._sequence, self._count, payload))
            self._sequence = self._sequence + 1
            self._count = self._count + len(payload)
        return Record(full_record.data, packets)


def make_log(size: int, packets: list[bytes], batch: int = 7, t_ns: int = 1) -> PacketLog:
    """Return the packets of a row as a receiver logs them, `batch` at a time, the k-th at `t_ns` + k nanoseconds."""
    log = PacketLog(size)
    for i in range(0, len(packets), batch):
        batch_of_packets = packets[i : i + batch]
        block = np.zeros((len(batch_of_packets), max(10, *map(len, batch_of_packets))), dtype=np.uint8)
        for k, p in enumerate(batch_of_packets):
            block[k, : len(p)] = np.frombuffer(p, dtype=np.uint8)
        log.add(block, np.array([len(p) for p in batch_of_packets]), t_ns + i)
    return log


def place(
    size: int, packets: list[bytes], start: Counters | EarlierRecords, frame: int = 1, batch: int = 7
) -> tuple[PlacedRecord, np.ndarray]:
    """Place a row that starts at these counters, or after the known earlier records."""
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
    """True if every byte of the placed row is the record's or is masked: the law of placement."""
    is_kept = ~make_mask(out.size, placed.missing)
    return bool((out[is_kept] == np.frombuffer(record.data, dtype=np.uint8)[is_kept]).all())


def log_packets(sent: SentRecord, expected: int, batch: int) -> PacketLog:
    """Return the arrivals as a receiver logs them, `batch` together, each with the time of its arrival."""
    log = PacketLog(expected)
    for k in range(0, len(sent.arrivals), batch):
        batch_of_arrivals = sent.arrivals[k : k + batch]
        block = np.zeros((len(batch_of_arrivals), max(10, *(len(a.packet) for a in batch_of_arrivals))), dtype=np.uint8)
        for row, a in zip(block, batch_of_arrivals, strict=True):
            row[: len(a.packet)] = np.frombuffer(a.packet, dtype=np.uint8)
        log.add(
            block, np.array([len(a.packet) for a in batch_of_arrivals]), np.array([a.t_ns for a in batch_of_arrivals])
        )
    return log
