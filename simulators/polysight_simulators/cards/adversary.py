"""A capture card and a network with every kind of trouble, for records of a few packets to thousands.

`NETWORK_TROUBLES` lists the faults of a card or a network (docs/spec/simulated-rig.md marks what a real card was seen
to do): the card is reset, ends a record early or starts one by itself; the network loses, duplicates, delays and
reorders packets. Each packet's record stays known: `Arrival.record`. A record is what the card sends of one row of the
scan; its frames are the radar's, each started by a pulse on SYNC_IN. Probabilities, counts and pauses in here are
chosen.
"""

import random
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from polysight_shared.units import NS_PER_MS
from polysight_simulators.cards.dca1000 import DATA_HEADER_BYTES, Packetiser

NETWORK_TROUBLES = (
    # Packets are lost: anywhere, at the end or the beginning of a record, or all of them.
    "lose",
    "lose_tail",
    "lose_head",
    "lose_all",
    # Packets come into the next record, before or after its first pulse.
    "delay",
    # The last packets come after the stop, before the next record or in it.
    "backlog",
    "duplicate",
    # Every packet comes twice; the second path is slower.
    "two_paths",
    "reorder",
    # A switch distributes packets over queues of different length, one after another.
    "flows",
    # Packets are held until later ones have come, perhaps those of the next pulses.
    "held",
    "truncate",
    "turn_header_bit",
    # The card restarts: in mid-stream, in the record's first packets, or before the record.
    "reset",
    "reset_early",
    "reset_between",
    # Triggers are missed: the record is shorter.
    "miss_frames",
    # The card ends the record and starts another: two short packets in one stream.
    "end_early",
    # The card drops bytes before it numbers them, and its status message is lost.
    "drop_inside",
    # The dropped bytes are exactly one to three frames.
    "drop_frames",
    # Bytes are dropped at two places; together they are one or two frames.
    "two_drops",
    # A second card with the same address sends a record, too.
    "twin",
    # The record of the second card comes, and this card's own is lost.
    "twin_alone",
)
RADAR_TROUBLES = (
    # SYNC_IN pulses are missed.
    "missed",
    # Edges that are not pulses start frames; the radar counts its frames and ignores as many pulses at the end.
    "spurious",
    # A spurious edge replaces a pulse that the radar missed.
    "near",
    # The radar does not count its frames.
    "endless",
)
"""Troubles of a radar, for :meth:`Adversary.take`: only the times of its frames show them."""
# Time in which a radar sends a frame: the published chirp.
_FRAME_NS = 128_000
NEAREST_EDGE_NS = 350_000
"""An edge nearer to a missed pulse counts as that pulse: at 20 mm/s the stage moves less than 0.01 mm meanwhile."""
# Time between two packets where no pulses pace them: a full packet takes 12 us at 1 Gbit/s.
_GAP_NS = 20_000


@dataclass(frozen=True)
class Arrival:
    """One packet at the receiver: arrival time (ns), bytes, and the number of its record; -1: the second card's."""

    t_ns: int
    packet: bytes
    record: int


@dataclass
class SentRecord:
    """One record, and the packets that arrived while the host received it."""

    number: int
    # Data that the row should contain.
    data: bytes
    # Packets that arrive earlier are of an earlier record: a millisecond before the first frame.
    not_before_ns: int
    # Packets in the order of their arrival.
    arrivals: list[Arrival] = field(default_factory=list)
    # The card sent the complete record, with consecutive counters.
    is_complete: bool = True
    troubles: tuple[str, ...] = ()


class Adversary:
    """A card and network with troubles drawn from `rng`.

    `byte_count` and `sequence` are the card's counters at the first record, `payload_bytes` the data of a full packet
    (the card's default), without its header. `resets` counts the card's resets since the host's last.
    """

    def __init__(
        self,
        rng: random.Random,
        frame_bytes: int,
        byte_count: int = 0,
        sequence: int = 1,
        payload_bytes: int = 1456,
    ) -> None:
        self._rng = rng
        self._frame_bytes = frame_bytes
        self._payload_bytes = payload_bytes
        self._card = Packetiser(payload_bytes, sequence, byte_count)
        self._now_ns = 1_000_000_000
        self._number = 0
        self._twin = Packetiser(payload_bytes, rng.randrange(1 << 32), rng.randrange(1 << 48))
        # Packets that arrive in a later record.
        self._late: list[Arrival] = []
        # Data of the record that is being made.
        self._bytes = np.zeros(0, np.uint8)
        # Numbers of its bytes that are not in a packet yet.
        self._waiting = np.zeros(0, np.int64)
        # Number of the last data byte in each packet that was made.
        self._last_bytes: list[int] = []
        self.resets = 0

    def take_late(self, share: float) -> list[Arrival]:
        """Return delayed packets that arrive now, on average this share of them."""
        coming = [a for a in self._late if self._rng.random() < share]
        self._late = [a for a in self._late if not any(a is c for c in coming)]
        return coming

    def reset_by_host(self) -> None:
        """Reset the card between two rows: its memory is empty then, and the network, too, before the next pulse."""
        self._reset()
        self.resets = 0
        self.forget_late()

    def take(self, pulses_ns: NDArray[np.int64], troubles: tuple[str, ...] = ()) -> SentRecord:
        """Send the record of a row whose SYNC_IN pulses, int64 [pulse], start frames.

        Troubles may also be of `RADAR_TROUBLES`. The row's data (`SentRecord.data`) is what all pulses would have
        given; frames of other edges hold other bytes. Each packet arrives when its last frame fills it.
        """
        rng = self._rng
        byte_generator = np.random.default_rng(rng.getrandbits(32))
        frames = _draw_bytes(byte_generator, (pulses_ns.size, self._frame_bytes))
        edges = [(int(t), frames[k]) for k, t in enumerate(pulses_ns)]
        if "missed" in troubles:
            for _ in range(rng.randint(1, min(3, len(edges) - 1))):
                edges.pop(rng.randrange(len(edges)))
        if "near" in troubles:
            t, _ = edges.pop(rng.randrange(len(edges)))
            edge_near_pulse = t + rng.choice([-1, 1]) * rng.randint(NEAREST_EDGE_NS, 5 * _FRAME_NS)
            edges.append((edge_near_pulse, _draw_bytes(byte_generator, self._frame_bytes)))
        if "spurious" in troubles:
            for _ in range(rng.randint(1, 2)):
                t = rng.randint(int(pulses_ns[0]), int(pulses_ns[-1]))
                # An edge during a frame or just after it starts none; one near a missed pulse counts as that pulse.
                pulses_and_edges_ns = np.append(pulses_ns, [edge_ns for edge_ns, _ in edges])
                if np.abs(pulses_and_edges_ns - t).min() > 5 * _FRAME_NS:
                    edges.append((t, _draw_bytes(byte_generator, self._frame_bytes)))
        edges.sort(key=lambda edge: edge[0])
        if "endless" not in troubles:
            edges = edges[: pulses_ns.size]
        times = [t for t, _ in edges]
        self._now_ns = int(pulses_ns[0]) - 50 * NS_PER_MS
        sent = self.record(len(edges), troubles, b"".join(f.tobytes() for _, f in edges), times)
        sent.is_complete = sent.is_complete and len(edges) == pulses_ns.size
        sent.data = frames.tobytes()
        return sent

    def record(
        self, frames: int, troubles: tuple[str, ...] = (), data: bytes = b"", edges_ns: list[int] | None = None
    ) -> SentRecord:
        """Send one record with these troubles; delayed packets arrive with later records. Without `data`, draw it.

        `edges_ns` are the times of its frames; without them, the packets follow each other.
        """
        rng = self._rng
        self._number += 1
        if not data:
            byte_generator = np.random.default_rng(rng.getrandbits(32))
            data = _draw_bytes(byte_generator, frames * self._frame_bytes).tobytes()
        begin_ns = self._now_ns + NS_PER_MS
        if edges_ns is not None:
            begin_ns = edges_ns[0] - NS_PER_MS
        sent = SentRecord(self._number, data, begin_ns, troubles=troubles)
        packets, last_bytes = self._make_packets(sent, data)
        made_ns = [begin_ns + (k + 1) * _GAP_NS for k in range(len(packets))]
        if edges_ns is not None:
            made_ns = [self._find_time_made_ns(byte, edges_ns) for byte in last_bytes]
        # A card that was reset may send nothing.
        made_ns = made_ns or [begin_ns]
        # Delayed packets of earlier records: those that come before the first of this record, and those among its own.
        packets_before = self.take_late(0.5)
        packets_between = self.take_late(0.7)
        arriving = self._transmit(packets, made_ns, sent)
        if "twin" in troubles or "twin_alone" in troubles:
            sent.is_complete = False
            twin_data = _draw_bytes(np.random.default_rng(rng.getrandbits(32)), len(data))
            twin = [bytes(p) for p in [*self._twin.feed(twin_data), *self._twin.flush()]]
            arriving += [Arrival(made_ns[min(k, len(made_ns) - 1)], p, -1) for k, p in enumerate(twin)]
            arriving.sort(key=lambda a: a.t_ns)
        # About half of the delayed packets come among the first three packets.
        for late_packet in packets_between:
            latest_place = len(arriving)
            if rng.random() < 0.5:
                latest_place = min(latest_place, 3)
            place = rng.randint(0, latest_place)
            t_ns = made_ns[0]
            if place:
                t_ns = arriving[place - 1].t_ns
            arriving.insert(place, Arrival(t_ns, late_packet.packet, late_packet.record))
        arrivals_before = [Arrival(self._now_ns + k * 1000, a.packet, a.record) for k, a in enumerate(packets_before)]
        sent.arrivals = arrivals_before + arriving
        self._now_ns = max([begin_ns, *(a.t_ns for a in arriving)]) + 10 * NS_PER_MS
        return sent

    def _make_packets(self, sent: SentRecord, data: bytes) -> tuple[list[bytes], list[int]]:
        """Return the packets of one record as the card sends them, and the number of the last data byte in each."""
        self._bytes = np.frombuffer(data, dtype=np.uint8)
        self._waiting = np.zeros(0, np.int64)
        self._last_bytes = []
        out = self._send_record(sent, np.arange(len(data)))
        return out, self._last_bytes

    def _send_record(self, sent: SentRecord, byte_numbers: NDArray[np.int64]) -> list[bytes]:
        """Send bytes of the data, which are given by their numbers."""
        troubles = sent.troubles
        rng = self._rng
        frame = self._frame_bytes
        frames = len(byte_numbers) // frame
        if "miss_frames" in troubles and frames > 1:
            sent.is_complete = False
            for missed_frame in sorted(rng.sample(range(frames), rng.randint(1, min(3, frames - 1))), reverse=True):
                byte_numbers = np.delete(byte_numbers, slice(missed_frame * frame, (missed_frame + 1) * frame))
        if "drop_inside" in troubles or "drop_frames" in troubles:
            sent.is_complete = False
            if "drop_frames" in troubles:
                dropped_bytes = frame * rng.randint(1, 3)
            else:
                # Blocks of 16 bytes; chosen.
                dropped_bytes = 16 * rng.randint(1, 200)
            cut = rng.randrange(max(1, len(byte_numbers) - dropped_bytes))
            byte_numbers = np.delete(byte_numbers, slice(cut, cut + dropped_bytes))
        if "two_drops" in troubles:
            sent.is_complete = False
            dropped_bytes = frame * rng.randint(1, 2)
            first_part = 16 * rng.randint(1, dropped_bytes // 16 - 1)
            for size in (first_part, dropped_bytes - first_part):
                cut = rng.randrange(max(1, len(byte_numbers) - size))
                byte_numbers = np.delete(byte_numbers, slice(cut, cut + size))
        if "reset_between" in troubles:
            self._reset()
        out: list[bytes] = []
        if "end_early" in troubles and frames > 2:
            sent.is_complete = False
            cut = rng.randint(1, frames - 2) * frame
            lost_bytes = rng.randint(0, 1) * frame
            out += self._make_stream(byte_numbers[:cut]) + self._end()
            byte_numbers = byte_numbers[cut + lost_bytes :]
        if "reset" in troubles or "reset_early" in troubles:
            sent.is_complete = False
            cut = rng.randrange(len(byte_numbers) + 1)
            if "reset_early" in troubles:
                cut = min(cut, 3 * self._payload_bytes)
            out += self._make_stream(byte_numbers[:cut])
            lost_bytes = rng.choice([0, 0, rng.randint(1, 4000)])
            self._reset()
            byte_numbers = byte_numbers[cut + lost_bytes :]
        return out + self._make_stream(byte_numbers) + self._end()

    def forget_late(self) -> None:
        """Drop delayed packets: the host's program was restarted."""
        self._late.clear()

    def _reset(self) -> None:
        """Reset the card: counters start again, and bytes waiting for a full packet are lost."""
        self._card = Packetiser(self._payload_bytes)
        self.resets += 1
        self._waiting = np.zeros(0, np.int64)

    def _make_stream(self, byte_numbers: NDArray[np.int64]) -> list[bytes]:
        """Return the packets that these bytes of the data fill."""
        self._waiting = np.concatenate([self._waiting, byte_numbers])
        return self._note_last_bytes(self._card.feed(self._bytes[byte_numbers]))

    def _end(self) -> list[bytes]:
        """Return the short packet with the bytes that wait for a full one."""
        return self._note_last_bytes(self._card.flush())

    def _note_last_bytes(self, rows: NDArray[np.uint8]) -> list[bytes]:
        """Note the number of the last data byte in each packet (`_last_bytes`); return the packets as bytes."""
        for row in rows:
            size = len(row) - DATA_HEADER_BYTES
            last_byte = 0
            if self._waiting.size:
                last_byte = int(self._waiting[min(size, self._waiting.size) - 1])
            self._last_bytes.append(last_byte)
            self._waiting = self._waiting[size:]
        return [bytes(row) for row in rows]

    def _find_time_made_ns(self, byte: int, edges_ns: list[int]) -> int:
        """Time at which the card sends a byte of the data: 0.1 ms (chosen) after it leaves the radar."""
        frame, byte_in_frame = divmod(byte, self._frame_bytes)
        return edges_ns[frame] + _FRAME_NS * byte_in_frame // self._frame_bytes + 100_000

    def _transmit(self, packets: list[bytes], made_ns: list[int], sent: SentRecord) -> list[Arrival]:
        """Return the packets that arrive in time, in the order of arrival; keep the delayed ones.

        Each trouble delays a packet by at most 0.6 ms, and lets others overtake it; only "held" waits for later pulses.
        """
        troubles = sent.troubles
        rng = self._rng
        n = len(packets)
        lost_packets: set[int] = set()
        if "lose_all" in troubles or "twin_alone" in troubles:
            lost_packets = set(range(n))
        if "lose" in troubles:
            lost_packets |= {k for k in range(n) if rng.random() < rng.choice([0.02, 0.2])}
        if "lose_head" in troubles:
            lost_packets |= set(range(min(n, rng.randint(1, 4))))
        if "lose_tail" in troubles:
            lost_packets |= set(range(max(0, n - rng.randint(1, 4)), n))
        late_packets: set[int] = set()
        if "delay" in troubles and n:
            late_packets |= {rng.randrange(n) for _ in range(rng.randint(1, 3))}
        if "backlog" in troubles:
            late_packets |= set(range(max(0, n - rng.randint(1, 4)), n))
        self._late += [Arrival(0, packets[k], sent.number) for k in sorted(late_packets - lost_packets)]
        # Arrival time, number in the record, and bytes of each packet.
        coming = [
            (made_ns[k], k, self._damage(packets[k], troubles))
            for k in range(n)
            if k not in lost_packets | late_packets
        ]
        if "duplicate" in troubles and coming:
            coming += [rng.choice(coming) for _ in range(rng.randint(1, 4))]
        if "two_paths" in troubles:
            coming += [(t_ns + rng.choice([10_000, 600_000]), k, p) for t_ns, k, p in coming]
            if rng.random() < 0.5 and n:
                self._late.append(Arrival(0, packets[-1], sent.number))
        if "reorder" in troubles:
            # A fifth of the packets is late by up to 0.12 ms. Both numbers are drawn for each, so that a seed stays
            # valid.
            delays_ns = [rng.randint(0, 120_000) * (rng.random() < 0.2) for _ in coming]
            coming = [(t_ns + delay_ns, k, p) for delay_ns, (t_ns, k, p) in zip(delays_ns, coming, strict=True)]
        if "flows" in troubles:
            coming = [(t_ns + 100_000 * (k % 3), k, p) for t_ns, k, p in coming]
        if "held" in troubles:
            # Of three packets the first comes immediately, the second 1 ns after the fifth packet that follows it, and
            # the third 2 ns after the tenth.
            held_until = [min(k + 5 * (k % 3), n - 1) for _, k, _ in coming]
            coming = [(made_ns[last] + k % 3, k, p) for last, (_, k, p) in zip(held_until, coming, strict=True)]
        return [Arrival(t_ns, p, sent.number) for t_ns, _, p in sorted(coming, key=lambda c: c[0])]

    def _damage(self, packet: bytes, troubles: tuple[str, ...]) -> bytes:
        """Return a packet, perhaps truncated or with a flipped bit in its header."""
        if "truncate" in troubles and self._rng.random() < 0.05:
            return packet[: self._rng.randint(DATA_HEADER_BYTES, len(packet))]
        if "turn_header_bit" in troubles and self._rng.random() < 0.05:
            bit = self._rng.randrange(8 * DATA_HEADER_BYTES)
            damaged_packet = bytearray(packet)
            damaged_packet[bit // 8] ^= 1 << bit % 8
            return bytes(damaged_packet)
        return packet


def _draw_bytes(generator: np.random.Generator, shape: int | tuple[int, ...]) -> NDArray[np.uint8]:
    """Draw data bytes from 1 to 255; zeros stand for bytes that are missing."""
    return generator.integers(1, 256, shape, np.uint8)
