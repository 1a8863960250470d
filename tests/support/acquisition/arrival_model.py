"""Model of a row from SYNC_IN edges to arrival times: frames, a card that queues, stalls, lost packets."""

from dataclasses import dataclass

import numpy as np

US = 1_000
MS = 1_000_000
# Bytes of samples in a full packet.
PAYLOAD = 1456
# Time in which a frame's bytes come from the radar.
FRAME_NS = 128 * US


@dataclass(frozen=True)
class Load:
    """Stalls of the card or the network per second, and their mean length."""

    stalls_per_s: float = 0.0
    stall_ms: float = 0.0


def draw_pulse_times(bursts: int, pulses: int = 16, period_us: float = 1500.0, between_ms: float = 100.0) -> np.ndarray:
    """Return times of SYNC_IN pulses, int64 [burst, pulse], ns; the first is at 1 s."""
    first = 1_000 * MS + np.arange(bursts) * round(between_ms * MS)
    return (first[:, None] + np.arange(pulses) * round(period_us * US)).astype(np.int64)


def receive(
    edges_ns: np.ndarray,
    pulses_ns: np.ndarray,
    frame_bytes: int,
    rng: np.random.Generator,
    load: Load = Load(),
    lost: frozenset[int] = frozenset(),
    drift: float = 0.0,
) -> tuple[np.ndarray, np.ndarray]:
    """Return the arrivals, int64 [n, 2] of time (ns) and bytes by then, and when the host reads each burst's event.

    `edges_ns` [frame] are the edges that the radar takes for pulses, `pulses_ns` [burst, pulse] those that were sent.
    `lost` are the numbers of packets that do not arrive. The clocks' offset is drawn; `drift` is their relative rate.
    """
    offset = int(rng.integers(10**10, 10**14))
    sent = edges_ns * (1 + drift) + offset
    answer = pulses_ns[:, -1] * (1 + drift) + offset + rng.exponential(max(load.stall_ms, 1.0) * MS, len(pulses_ns))
    end = len(sent) * frame_bytes
    span = sent[-1] - sent[0]
    starts = rng.uniform(sent[0], sent[-1], rng.poisson(load.stalls_per_s * span * 1e-9))
    stalls = [(t, t + rng.exponential(load.stall_ms * MS)) for t in starts]
    arrivals: list[tuple[float, int]] = []
    ready = 0.0
    for k, stop in enumerate([*range(PAYLOAD, end, PAYLOAD), end]):
        frame = (stop - 1) // frame_bytes
        sent_ns = sent[frame] + FRAME_NS * (stop - frame * frame_bytes) / frame_bytes
        if stop == end and end % PAYLOAD:
            # The card waits 2 s before it sends a packet that is not full.
            sent_ns += 2_000 * MS
        sent_ns = max([sent_ns, *(b for a, b in stalls if a <= sent_ns < b)])
        ready = max(sent_ns, ready + 25 * US)
        if k not in lost:
            arrivals.append((ready + 50 * US + rng.exponential(20 * US), stop))
    arrivals.sort()
    times = np.array([t for t, _ in arrivals])
    stops = np.array([stop for _, stop in arrivals], dtype=np.int64)
    is_new = np.diff(np.maximum.accumulate(stops), prepend=0) > 0
    return np.column_stack([times, stops])[is_new].astype(np.int64), answer.astype(np.int64)
