"""Draw and count the faults of a simulated capture card, reproducibly from a seed.

Every board and every kind of fault has its own generator, so that one fault does not shift another; draws do not depend
on how packets, frames or pulses are grouped into calls.
"""

from __future__ import annotations

import zlib
from bisect import bisect_left
from collections import Counter
from enum import Enum
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from polysight_simulators.cards.dca1000 import DATA_HEADER_BYTES, Status
from polysight_simulators.cards.sync_in import Pulse
from polysight_simulators.faults import Faults

Rows = NDArray[np.uint8]


def fault_generator(seed: int, board_name: str, generator_name: str) -> np.random.Generator:
    """Return the generator of one kind of fault of one board."""
    return np.random.default_rng([seed, zlib.crc32(f"{board_name}/{generator_name}".encode())])


class NetworkFaults:
    """Faults of data packets between card and host, counted in `counts`."""

    def __init__(self, faults: Faults, seed: int, board_name: str, counts: Counter[str] | None = None) -> None:
        self._faults = faults
        self._counts: Counter[str]
        if counts is None:
            self._counts = Counter()
        else:
            self._counts = counts
        self._rng = fault_generator(seed, board_name, "network")
        self._corrupt_rng = fault_generator(seed, board_name, "corrupt")
        self._index = 0
        self._held: list[tuple[int, Rows]] = []
        self._lose = frozenset(faults.lose_packets)

    def carry(self, rows: Rows) -> list[Rows]:
        """Return packets [n, size] in the order of arrival, as arrays of packets of one size."""
        if not self._faults.disturbs_network:
            return [rows]
        arrived: list[Rows] = []
        rows = self._corrupt(rows)
        draws = self._rng.random((len(rows), 5))
        suffers = [int(i) for i in np.flatnonzero(self._suffers(draws))]
        first = 0
        while first < len(rows):
            next_one = len(rows)
            if suffers and suffers[-1] >= first:
                next_one = suffers[bisect_left(suffers, first)]
            if self._held or next_one == first:
                arrived += self._carry_one(rows[first : first + 1], draws[first], self._index)
                arrived += self._release(self._index)
                next_one = first + 1
            else:
                arrived.append(rows[first:next_one])
            self._index += next_one - first
            first = next_one
        return arrived

    def _suffers(self, draws: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Select the packets with a possible fault, bool [n]."""
        f = self._faults
        suffers = np.any(draws < (f.loss, f.reorder, f.late, f.truncate, f.duplicate), axis=1)
        numbers = self._index + np.arange(len(draws))
        if f.lose_packets:
            suffers |= np.isin(numbers, f.lose_packets)
        if f.stop_after_packets is not None:
            suffers |= numbers >= f.stop_after_packets
        return suffers

    def _carry_one(self, packet: Rows, draws: NDArray[np.float64], index: int) -> list[Rows]:
        """Return a packet with its faults, [n, size]; `draws` has a number for each kind of fault."""
        f = self._faults
        loss, reorder, late, truncate, duplicate = draws
        if f.stop_after_packets is not None and index >= f.stop_after_packets:
            self._count("not_sent", packet[0])
        elif loss < f.loss or index in self._lose:
            self._count("lost", packet[0])
        elif reorder < f.reorder:
            self._count("reordered")
            self._held.append((index + 1, packet))
        elif late < f.late:
            self._count("late")
            self._held.append((index + f.late_packets, packet))
        elif truncate < f.truncate:
            half = packet[:, : packet.shape[1] // 2]
            self._count("truncated")
            self._counts["truncated_bytes"] += packet.shape[1] - max(half.shape[1], DATA_HEADER_BYTES)
            return [half]
        elif duplicate < f.duplicate:
            self._count("duplicated")
            return [packet, packet]
        else:
            return [packet]
        return []

    def _corrupt(self, rows: Rows) -> Rows:
        f = self._faults
        if not f.corrupts:
            return rows
        rows = rows.copy()
        draws = self._corrupt_rng.random((len(rows), 3))
        for i in np.flatnonzero((draws[:, 0] < f.corrupt) | (draws[:, 1] < f.corrupt_header)):
            row = rows[i]
            draw = draws[i]
            if draw[0] < f.corrupt:
                payload_bits = 8 * (len(row) - DATA_HEADER_BYTES)
                _turn_bit(row, 8 * DATA_HEADER_BYTES + int(draw[2] * payload_bits))
                self._count("corrupted")
            else:
                _turn_bit(row, int(draw[2] * 8 * DATA_HEADER_BYTES))
                self._count("headers_corrupted")
        return rows

    def skip(self, rows: Rows) -> None:
        """Skip packets that never reached the network, so that later draws do not change."""
        if self._faults.disturbs_network:
            self._rng.random((len(rows), 5))
            if self._faults.corrupts:
                self._corrupt_rng.random((len(rows), 3))
            self._index += len(rows)

    def drain(self) -> list[Rows]:
        """Return the packets held back at the end of the record."""
        return self._release(None)

    def _release(self, index: int | None) -> list[Rows]:
        if not self._held:
            return []
        due = [p for release_index, p in self._held if index is None or release_index <= index]
        self._held = [
            (release_index, p) for release_index, p in self._held if index is not None and release_index > index
        ]
        return due

    def _count(self, kind: str, lost_packet: Rows | None = None) -> None:
        self._counts[kind] += 1
        if lost_packet is not None:
            self._counts[f"{kind}_bytes"] += len(lost_packet) - DATA_HEADER_BYTES


def _turn_bit(row: Rows, bit: int) -> None:
    row[bit // 8] ^= np.uint8(1 << (bit % 8))


class CommandFaults:
    """Faults of requests and replies, counted in `counts`."""

    def __init__(self, faults: Faults, seed: int, board_name: str, counts: Counter[str]) -> None:
        self._faults = faults
        self._counts = counts
        self._rng = fault_generator(seed, board_name, "commands")
        self._answers_left = 0 if faults.mute else faults.answers
        self._draw_reply = 1.0
        self._bits: dict[int, int] = {}
        for code, bit in faults.command_status:
            self._bits[code] = self._bits.get(code, 0) | 1 << bit

    def heard(self) -> bool:
        """True if the next request reaches the card and will be answered."""
        draw, self._draw_reply = self._rng.random(2)
        if self._answers_left == 0:
            self._counts["requests_unanswered"] += 1
            return False
        if draw < self._faults.request_loss:
            self._counts["requests_lost"] += 1
            return False
        return True

    def refuses(self, code: int) -> bool:
        """True if the card refuses this command."""
        return code in self._faults.refuse

    def status_after(self, code: int) -> int:
        """Return the status bits that follow the reply to this command; 0 for none."""
        return self._bits.get(code, 0)

    def reply_arrives(self) -> bool:
        """True if the reply to the request just heard reaches the host."""
        if self._answers_left is not None:
            self._answers_left -= 1
        if self._draw_reply < self._faults.reply_loss:
            self._counts["replies_lost"] += 1
            return False
        return True


class PulseFaults:
    """SYNC_IN pulses that one radar misses, and edges that nobody sent."""

    def __init__(self, faults: Faults, seed: int, board_name: str) -> None:
        self._probability = faults.missed_pulse
        self._miss = frozenset(faults.miss_pulses)
        self._spurious = dict(faults.spurious_edges)
        self._rng = fault_generator(seed, board_name, "pulses")
        self.missed = 0

    def select_seen(self, pulses: list[Pulse]) -> list[Pulse]:
        """Return the edges that the radar sees."""
        draws = self._rng.random(len(pulses))
        seen_pulses = [
            p for p, draw in zip(pulses, draws, strict=True) if p.number not in self._miss and draw >= self._probability
        ]
        self.missed += len(pulses) - len(seen_pulses)
        for pulse in pulses:
            if pulse.number in self._spurious:
                behind_ms = self._spurious[pulse.number]
                seen_pulses.append(pulse._replace(t_ns=pulse.t_ns + round(behind_ms * 1e6)))
        if self._spurious:
            return sorted(seen_pulses, key=lambda p: p.t_ns)
        return seen_pulses


class LvdsRun(NamedTuple):
    """LVDS data, int16, and the status that reports `lost_bytes` lost at its end (None: nothing was lost)."""

    data: NDArray[np.int16]
    status: Status | None
    lost_bytes: int


class OverflowFaults:
    """Frames that lose their second half in the card's memory, before packetising."""

    def __init__(self, faults: Faults, seed: int, board_name: str) -> None:
        self._kinds = [
            (probability, status, fault_generator(seed, board_name, generator_name))
            for probability, status, generator_name in (
                (faults.overflow, Status.LVDS_BUFFER_FULL, "overflow"),
                (faults.ddr_full, Status.DDR_FULL, "ddr_full"),
            )
            if probability
        ]

    def split(self, frames: NDArray[np.int16]) -> list[LvdsRun]:
        """Split frames, int16 [n, ...], into runs with a loss at their end."""
        status_by_frame: dict[int, Status] = {}
        for probability, status, rng in self._kinds:
            for i in np.flatnonzero(rng.random(len(frames)) < probability):
                status_by_frame.setdefault(int(i), status)
        runs = []
        first = 0
        for i in sorted(status_by_frame):
            whole_frames = frames[first:i].reshape(-1)
            frame = frames[i].reshape(-1)
            kept_samples = len(frame) // 2
            run = np.concatenate([whole_frames, frame[:kept_samples]])
            runs.append(LvdsRun(run, status_by_frame[i], (len(frame) - kept_samples) * frame.itemsize))
            first = i + 1
        if first < len(frames):
            return [*runs, LvdsRun(frames[first:], None, 0)]
        return runs


class EventKind(Enum):
    """Events of a card before a pulse."""

    LINK_DOWN = "link_down"
    STATUS = "pulse_status"
    END = "end_pulses"
    RESET = "reset_pulses"
    POWER_CYCLE = "power_cycle_pulses"


class PulseEvents:
    """Events of a card that happen just before given SYNC_IN pulses."""

    def __init__(self, faults: Faults) -> None:
        self._at: dict[int, list[tuple[EventKind, float]]] = {}
        for kind in EventKind:
            for entry in getattr(faults, kind.value):
                pulse = entry
                value = 0.0
                if isinstance(entry, tuple):
                    pulse, value = entry
                self._at.setdefault(pulse, []).append((kind, value))

    def parts(self, pulses: list[Pulse]) -> list[list[Pulse]]:
        """Split the pulses before each one with an event."""
        if not pulses:
            return []
        if not self._at:
            return [pulses]
        first = pulses[0].number
        end = pulses[0].number + len(pulses)
        cuts = sorted({0, len(pulses), *(n - first for n in self._at if first <= n < end)})
        return [pulses[a:b] for a, b in pairwise(cuts)]

    def before_pulse(self, pulse: Pulse) -> list[tuple[EventKind, float]]:
        """Return the events before this pulse: kind, and its seconds or status bit."""
        return self._at.get(pulse.number, [])
