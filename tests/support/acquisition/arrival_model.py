"""Model of frames between radar and receiver: delays, stalls of either side, batches of packets."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

US, MS = 1_000, 1_000_000
PAYLOAD = 1456


@dataclass(frozen=True)
class Load:
    """Load of the machine: stalls per second and their mean length, for sender and receiver."""

    stalls_per_s: float = 0.0
    stall_ms: float = 0.0
    jitter_us: float = 30.0


def pulse_times(bursts: int, pulses: int = 16, period_us: float = 1500.0, between_ms: float = 100.0) -> np.ndarray:
    """int64 [burst, pulse] from 1 s on."""
    first = 1_000 * MS + np.arange(bursts) * round(between_ms * MS)
    return (first[:, None] + np.arange(pulses) * round(period_us * US)).astype(np.int64)


def _stalls(rng: np.random.Generator, load: Load, begin: int, end: int) -> np.ndarray:
    n = rng.poisson(load.stalls_per_s * (end - begin) * 1e-9)
    starts = rng.uniform(begin, end, n)
    return np.stack([starts, starts + rng.exponential(load.stall_ms * MS, n)], axis=1)


def _awake(t: float, stalls: np.ndarray) -> float:
    """Time at which something due at `t` happens: after the stall that covers it."""
    covering = stalls[(stalls[:, 0] <= t) & (t < stalls[:, 1])] if len(stalls) else stalls
    return float(covering[:, 1].max()) if len(covering) else t


def receive(
    pulses_ns: np.ndarray,
    missed: list[int],
    frame_bytes: int,
    rng: np.random.Generator,
    load: Load,
    drift: float = 0.0,
    lost: frozenset[int] = frozenset(),
) -> tuple[np.ndarray, np.ndarray]:
    """Return the arrivals that a receiver logs, int64 [n, 2], and when the host reads each event, int64 [burst].

    `lost` packets never come. The clocks' offset is drawn.
    """
    return receive_edges(np.delete(pulses_ns, missed), pulses_ns, frame_bytes, rng, load, lost, drift)


def receive_edges(
    edges_ns: np.ndarray,
    pulses_ns: np.ndarray,
    frame_bytes: int,
    rng: np.random.Generator,
    load: Load,
    lost: frozenset[int] = frozenset(),
    drift: float = 0.0,
) -> tuple[np.ndarray, np.ndarray]:
    """As :func:`receive`, of a radar that takes these edges, int64 [frame], for its pulses."""
    offset = int(rng.integers(10**10, 10**14))
    host = pulses_ns.reshape(-1) * (1 + drift) + offset
    sent = edges_ns * (1 + drift) + offset
    end = len(sent) * frame_bytes
    sender = _stalls(rng, load, int(host[0]), int(host[-1]))
    receiver = _stalls(rng, load, int(host[0]), int(host[-1]))
    packets, ready = [], 0.0
    for k, stop in enumerate([*range(PAYLOAD, end, PAYLOAD), end]):
        of = (stop - 1) // frame_bytes
        made = sent[of] + 128 * US * (stop - of * frame_bytes) / frame_bytes
        if stop == end and end % PAYLOAD:
            made += 2_000 * MS  # the card waits 2 s before it sends a packet that is not full
        ready = max(_awake(made, sender), ready + 25 * US)
        if k not in lost:
            packets.append((ready + 50 * US + rng.exponential(load.jitter_us * US), stop))
    packets.sort()
    pairs: list[tuple[int, int]] = []
    at, extent, now = 0, 0, 0.0
    quiet = 0.0
    while at < len(packets):
        # The receiver looks every millisecond while nothing comes.
        while packets[at][0] > now + MS // 5 and pairs:
            quiet = now
            if packets[at][0] <= now + MS:
                break
            now = _awake(now + MS, receiver)
        now = _awake(max(now, packets[at][0]) + rng.exponential(20 * US), receiver)
        while True:
            looked = now
            n = sum(1 for t, _ in packets[at : at + 256] if t <= now)
            if n == 0:
                quiet = looked
                break
            extent = max(extent, *(stop for _, stop in packets[at : at + n]))
            at += n
            if quiet and pairs:
                pairs.append((int(quiet), pairs[-1][1]))
            quiet = 0.0
            now = _awake(now + n * US + rng.exponential(10 * US), receiver)
            pairs.append((int(now), extent))
            now += 2 * US
        now = _awake(now + 1 * MS, receiver)
    answer = host.reshape(pulses_ns.shape)[:, -1] + rng.exponential(max(load.stall_ms, 1.0) * MS, len(pulses_ns))
    return np.array(pairs, dtype=np.int64).reshape(-1, 2), answer.astype(np.int64)
