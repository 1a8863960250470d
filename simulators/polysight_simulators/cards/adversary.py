"""A capture card and a network with every kind of trouble, for records of a few packets to thousands.

`KINDS` lists what a card or a network can do (docs/spec/simulated-rig.md marks what was seen): the card is reset, ends
a record early or starts one by itself; the network loses, duplicates, delays and reorders packets. Each packet's record
stays known: `Arrival.record`.
"""

from __future__ import annotations

import random
from dataclasses import dataclass, field

import numpy as np

from polysight_simulators.cards.dca1000 import DATA_HEADER_BYTES, Packetiser

KINDS = (
    "lose",  # packets
    "lose_tail",  # the last packets of a record
    "lose_head",
    "lose_all",
    "delay",  # packets, into the next record, before or after its first pulse
    "backlog",  # the last packets come after the stop, before the next record or in it
    "duplicate",
    "two_paths",  # every packet comes twice, the second path being later
    "reorder",
    "flows",  # a switch sends packets by turns over queues of different length
    "truncate",
    "turn_header_bit",
    "reset",  # the card restarts in mid-stream
    "reset_early",  # in the record's first packets
    "reset_between",  # before the record
    "miss_frames",  # triggers are missed: the record is shorter
    "end_early",  # the card ends the record and starts another: two short packets in one stream
    "clock",  # the clock of the arrivals jumps
)
_GAP_NS = 20_000  # between packets


@dataclass(frozen=True)
class Arrival:
    """One packet at the receiver: arrival time (ns), bytes, and the number of its record."""

    t_ns: int
    packet: bytes
    record: int


@dataclass
class Sent:
    """One record, and the packets that arrived while the host received it."""

    number: int
    data: bytes  # that the row should contain
    first_pulse_ns: int
    arrivals: list[Arrival] = field(default_factory=list)  # in this order
    whole: bool = True  # the card sent the complete record, with consecutive counters
    troubles: tuple[str, ...] = ()


class Adversary:
    """A card and network with troubles drawn from `chance`.

    `byte_count` and `sequence` are the counters at the first record, `payload_bytes` those of a full packet.
    """

    def __init__(
        self,
        chance: random.Random,
        frame_bytes: int,
        byte_count: int = 0,
        sequence: int = 1,
        payload_bytes: int = 1456,
    ) -> None:
        self._chance, self._frame, self._payload = chance, frame_bytes, payload_bytes
        self._card = Packetiser(payload_bytes, sequence, byte_count)
        self._now_ns, self._number = 1_000_000_000, 0
        self._late: list[Arrival] = []  # packets that arrive in a later record
        self.resets = 0

    def take_late(self, share: float) -> list[Arrival]:
        """Return delayed packets that arrive now, on average this share of them."""
        coming = [a for a in self._late if self._chance.random() < share]
        self._late = [a for a in self._late if not any(a is c for c in coming)]
        return coming

    def record(self, frames: int, troubles: tuple[str, ...] = (), data: bytes = b"") -> Sent:
        """Send one record with these troubles; delayed packets arrive with later records. Without `data`, draw it."""
        chance, self._number = self._chance, self._number + 1
        if not data:
            draw = np.random.default_rng(chance.getrandbits(32))
            data = draw.integers(1, 256, frames * self._frame, np.uint8).tobytes()
        pulse_ns = self._now_ns + 1_000_000
        sent = Sent(self._number, data, pulse_ns, troubles=troubles)
        packets = self._packets(sent, data)
        before, in_between = self.take_late(0.5), self.take_late(0.7)
        on_time = self._network(packets, sent)
        arriving = [Arrival(0, p, self._number) for p in on_time]
        for late in in_between:
            arriving.insert(chance.randint(0, min(len(arriving), 3) if chance.random() < 0.5 else len(arriving)), late)
        early_ns = [self._now_ns + k * 1000 for k in range(len(before))]
        times_ns = self._times(len(arriving), pulse_ns, troubles)
        sent.arrivals = [Arrival(t, a.packet, a.record) for t, a in zip(early_ns, before, strict=True)]
        sent.arrivals += [Arrival(t, a.packet, a.record) for t, a in zip(times_ns, arriving, strict=True)]
        self._now_ns = max([pulse_ns, *times_ns]) + 10_000_000
        return sent

    def _packets(self, sent: Sent, data: bytes) -> list[bytes]:
        """Return the packets of one record as the card sends them."""
        troubles, chance, frame = sent.troubles, self._chance, self._frame
        frames = len(data) // frame
        if "miss_frames" in troubles and frames > 1:
            sent.whole = False
            for at in sorted(chance.sample(range(frames), chance.randint(1, min(3, frames - 1))), reverse=True):
                data = data[: at * frame] + data[(at + 1) * frame :]
        if "reset_between" in troubles:
            self._reset()
        out: list[bytes] = []
        if "end_early" in troubles and frames > 2:
            sent.whole = False
            cut, lost = chance.randint(1, frames - 2) * frame, chance.randint(0, 1) * frame
            out += self._stream(data[:cut]) + self._end()
            data = data[cut + lost :]
        if "reset" in troubles or "reset_early" in troubles:
            sent.whole = False
            cut = chance.randrange(len(data) + 1)
            cut = min(cut, 3 * self._payload) if "reset_early" in troubles else cut
            out += self._stream(data[:cut])
            lost = chance.choice([0, 0, chance.randint(1, 4000)])
            self._reset()
            data = data[cut + lost :]
        return out + self._stream(data) + self._end()

    def forget_late(self) -> None:
        """Drop delayed packets: the host's program was restarted."""
        self._late.clear()

    def _reset(self) -> None:
        self._card, self.resets = Packetiser(self._payload), self.resets + 1

    def _stream(self, data: bytes) -> list[bytes]:
        return [bytes(row) for row in self._card.feed(np.frombuffer(data, dtype=np.uint8))]

    def _end(self) -> list[bytes]:
        return [bytes(row) for row in self._card.flush()]

    def _network(self, packets: list[bytes], sent: Sent) -> list[bytes]:
        """Return the packets that arrive in time, in order; keep the delayed ones."""
        t, chance, n = sent.troubles, self._chance, len(packets)
        gone: set[int] = set(range(n)) if "lose_all" in t else set()
        if "lose" in t:
            gone |= {k for k in range(n) if chance.random() < chance.choice([0.02, 0.2])}
        if "lose_head" in t:
            gone |= set(range(min(n, chance.randint(1, 4))))
        if "lose_tail" in t:
            gone |= set(range(max(0, n - chance.randint(1, 4)), n))
        late: set[int] = set()
        if "delay" in t and n:
            late |= {chance.randrange(n) for _ in range(chance.randint(1, 3))}
        if "backlog" in t:
            late |= set(range(max(0, n - chance.randint(1, 4)), n))
        self._late += [Arrival(0, packets[k], sent.number) for k in sorted(late - gone)]
        coming = [(float(k), self._damaged(packets[k], t)) for k in range(n) if k not in gone | late]
        if "duplicate" in t and coming:
            coming += [chance.choice(coming) for _ in range(chance.randint(1, 4))]
        if "two_paths" in t:
            coming += [(k + chance.choice([0.5, 30.0]), p) for k, p in coming]
            if chance.random() < 0.5 and n:
                self._late.append(Arrival(0, packets[-1], sent.number))
        if "reorder" in t:
            coming = [(k + chance.uniform(-3, 3) * (chance.random() < 0.2), p) for k, p in coming]
        if "flows" in t:
            coming = [(k + 5 * (int(k) % 3), p) for k, p in coming]
        return [p for _, p in sorted(coming, key=lambda kp: kp[0])]

    def _damaged(self, packet: bytes, troubles: tuple[str, ...]) -> bytes:
        if "truncate" in troubles and self._chance.random() < 0.05:
            return packet[: self._chance.randint(DATA_HEADER_BYTES, len(packet))]
        if "turn_header_bit" in troubles and self._chance.random() < 0.05:
            bit, turned = self._chance.randrange(8 * DATA_HEADER_BYTES), bytearray(packet)
            turned[bit // 8] ^= 1 << bit % 8
            return bytes(turned)
        return packet

    def _times(self, count: int, pulse_ns: int, troubles: tuple[str, ...]) -> list[int]:
        times = [pulse_ns + (k + 1) * _GAP_NS for k in range(count)]
        if "clock" in troubles and count > 2:
            at, jump = self._chance.randrange(1, count), self._chance.choice([-(10**12), 10**12, -5_000_000])
            times = times[:at] + [t + jump for t in times[at:]]
        return times
