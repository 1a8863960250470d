"""Draw the faults of a simulated capture card, reproducibly from a seed.

Every board has its own generators: one for the network (loss, reordering, truncation and duplication draw
one number each for every packet), one for corrupt packets, one for pulses and one for overflows. So the rate of one
fault does not change the draws of another, and draws do not depend on how packets, frames or pulses are grouped into
calls.
"""

import zlib
from collections import Counter
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from polysight_simulators.cards.dca1000 import DATA_HEADER_BYTES
from polysight_simulators.cards.sync_in import Pulse
from polysight_simulators.faults import Faults

Rows = NDArray[np.uint8]


def fault_generator(seed: int, board_name: str, generator_name: str) -> np.random.Generator:
    """Return one board's random generator of that name."""
    return np.random.default_rng([seed, zlib.crc32(f"{board_name}/{generator_name}".encode())])


class NetworkFaults:
    """Faults of data packets between card and host, counted in `counts`.

    Of several faults drawn for a packet the first of these counts: loss, reordering, truncation, duplication. A flipped
    bit may come in addition.
    """

    def __init__(self, faults: Faults, seed: int, board_name: str, counts: Counter[str]) -> None:
        self._faults = faults
        self._counts = counts
        self._rng = fault_generator(seed, board_name, "network")
        self._corrupt_rng = fault_generator(seed, board_name, "corrupt")
        # Packets held back, [1, size] each, until the next packet has overtaken them.
        self._held: list[Rows] = []

    def transmit(self, rows: Rows) -> list[Rows]:
        """Return packets [n, size] in the order of arrival, as arrays of packets of one size."""
        faults = self._faults
        if not faults.disturbs_network or not len(rows):
            return [rows]
        rows = self._corrupt(rows)
        draws = self._rng.random((len(rows), 4))
        is_faulty = np.any(draws < (faults.loss, faults.reorder, faults.truncate, faults.duplicate), axis=1)
        # A packet with a fault is a part of its own, and so is the next one, which may overtake it.
        cuts = {0, len(rows)}
        if self._held:
            cuts.add(1)
        for number in np.flatnonzero(is_faulty):
            cuts |= {min(int(number) + k, len(rows)) for k in (0, 1, 2)}
        arrived: list[Rows] = []
        for first, end in pairwise(sorted(cuts)):
            overtaken = self.drain()
            part = rows[first:end]
            arrived += self._transmit_faulty(part, draws[first]) if is_faulty[first] else [part]
            arrived += overtaken
        return arrived

    def _transmit_faulty(self, packet: Rows, draws: NDArray[np.float64]) -> list[Rows]:
        """Return what arrives of one packet [1, size]; `draws` [4] are those for loss, reorder, truncate, duplicate."""
        faults = self._faults
        loss, reorder, truncate, _ = draws
        if loss < faults.loss:
            self._counts["lost"] += 1
            self._counts["lost_bytes"] += packet.size - DATA_HEADER_BYTES
            return []
        if reorder < faults.reorder:
            self._counts["reordered"] += 1
            self._held.append(packet)
            return []
        if truncate < faults.truncate:
            # Half of a short packet may be less than its header, of which no byte counts as lost.
            half = packet[:, : packet.shape[1] // 2]
            self._counts["truncated"] += 1
            self._counts["truncated_bytes"] += packet.shape[1] - max(half.shape[1], DATA_HEADER_BYTES)
            return [half]
        self._counts["duplicated"] += 1
        return [packet, packet]

    def _corrupt(self, rows: Rows) -> Rows:
        """Return the packets, some with one payload bit flipped."""
        if not self._faults.corrupt:
            return rows
        rows = rows.copy()
        draws = self._corrupt_rng.random((len(rows), 2))
        for number in np.flatnonzero(draws[:, 0] < self._faults.corrupt):
            row = rows[number]
            bit = 8 * DATA_HEADER_BYTES + int(draws[number, 1] * 8 * (len(row) - DATA_HEADER_BYTES))
            row[bit // 8] ^= np.uint8(1 << (bit % 8))
            self._counts["corrupted"] += 1
        return rows

    def drain(self) -> list[Rows]:
        """Return the packets held back, which arrive now: after the next packet, or at the end of a record."""
        held_packets = self._held
        self._held = []
        return held_packets


class PulseFaults:
    """SYNC_IN pulses that one radar misses (`missed`: their number), and spurious edges."""

    def __init__(self, faults: Faults, seed: int, board_name: str) -> None:
        self._probability = faults.missed_pulse
        self._miss = frozenset(faults.miss_pulses)
        self._spurious = dict(faults.spurious_edges)
        self._rng = fault_generator(seed, board_name, "pulses")
        self.missed = 0

    def select_seen(self, pulses: list[Pulse]) -> list[Pulse]:
        """Return the edges that the radar sees; a spurious one has the number of the pulse that it follows."""
        draws = self._rng.random(len(pulses))
        seen_pulses = [
            p for p, draw in zip(pulses, draws, strict=True) if p.number not in self._miss and draw >= self._probability
        ]
        self.missed += len(pulses) - len(seen_pulses)
        for pulse in pulses:
            if pulse.number in self._spurious:
                delay_ms = self._spurious[pulse.number]
                seen_pulses.append(pulse._replace(t_ns=pulse.t_ns + round(delay_ms * 1e6)))
        if self._spurious:
            return sorted(seen_pulses, key=lambda p: p.t_ns)
        return seen_pulses


class LvdsRun(NamedTuple):
    """LVDS data of the card's input (int16, in the order of sending), and the number of bytes lost after them."""

    data: NDArray[np.int16]
    lost_bytes: int


class OverflowFaults:
    """Frames that lose their second half in the card's memory, before packetising."""

    def __init__(self, faults: Faults, seed: int, board_name: str) -> None:
        self._probability = faults.overflow
        self._rng = fault_generator(seed, board_name, "overflow")

    def split(self, frames: NDArray[np.int16]) -> list[LvdsRun]:
        """Split frames, int16 [n, ...], into runs that each end with a loss; the last may end without one."""
        runs = []
        first = 0
        for i in np.flatnonzero(self._rng.random(len(frames)) < self._probability):
            whole_frames = frames[first:i].reshape(-1)
            frame = frames[i].reshape(-1)
            kept_samples = len(frame) // 2
            run = np.concatenate([whole_frames, frame[:kept_samples]])
            runs.append(LvdsRun(run, (len(frame) - kept_samples) * frame.itemsize))
            first = i + 1
        if first < len(frames):
            return [*runs, LvdsRun(frames[first:], 0)]
        return runs
