"""Model of the times at which a row's packets arrive at the host.

An edge at SYNC_IN starts a frame of the radar. The card packs its bytes into packets, which wait in a queue, may be
delayed by stalls of the card or the network, and may be lost.
"""

from dataclasses import dataclass

import numpy as np

# Nanoseconds
US = 1_000
MS = 1_000_000
S = 1_000_000_000
# Bytes of samples in a full packet
PAYLOAD = 1456
# Time in which the radar sends a frame's bytes to the card
FRAME_NS = 128 * US
# Time that a card waits before it sends a packet that is not full
LAST_PACKET_DELAY_NS = 2 * S
# Least time between two packets of a card
PACKET_INTERVAL_NS = 25 * US
# Time from the card to the host, and the mean of a random delay that is added to it
NETWORK_NS = 50 * US
MEAN_JITTER_NS = 20 * US


@dataclass(frozen=True)
class Load:
    """Number of stalls of the card or the network per second, and their mean length."""

    stalls_per_s: float = 0.0
    stall_ms: float = 0.0


def draw_pulse_times(bursts: int, pulses: int = 16, period_us: float = 1500.0, between_ms: float = 100.0) -> np.ndarray:
    """Return times of SYNC_IN pulses, int64 [burst, pulse], ns.

    The first is at 1 s. Bursts follow each other after `between_ms`, and the pulses of a burst after `period_us`.
    """
    first_pulses = 1 * S + np.arange(bursts) * round(between_ms * MS)
    return (first_pulses[:, None] + np.arange(pulses) * round(period_us * US)).astype(np.int64)


def receive(
    edges_ns: np.ndarray,
    pulses_ns: np.ndarray,
    frame_bytes: int,
    rng: np.random.Generator,
    load: Load = Load(),
    lost: frozenset[int] = frozenset(),
    drift: float = 0.0,
) -> tuple[np.ndarray, np.ndarray]:
    """Draw the arrivals of a row's packets, and of the Pi's events at the host.

    Parameters
    ----------
    edges_ns
        [frame], edges that the radar takes for pulses, in the Pi's clock.
    pulses_ns
        [burst, pulse], pulses that were sent.
    lost
        Numbers of the packets that do not arrive.
    drift
        Relative difference of the rates of the two clocks; their offset is drawn.

    Returns
    -------
    arrivals_ns, events_ns
        int64 [n, 2], time in the host's clock and number of the row's bytes up to the end of the packet; and int64
        [burst], the time at which the host reads the event of a burst.
    """
    offset_ns = int(rng.integers(10 * S, 10**5 * S))
    # From here on times are those of the host's clock.
    edges_ns = edges_ns * (1 + drift) + offset_ns
    event_delays_ns = rng.exponential(max(load.stall_ms, 1.0) * MS, len(pulses_ns))
    events_ns = pulses_ns[:, -1] * (1 + drift) + offset_ns + event_delays_ns
    row_bytes = len(edges_ns) * frame_bytes
    duration_ns = edges_ns[-1] - edges_ns[0]
    stall_count = rng.poisson(load.stalls_per_s * duration_ns * 1e-9)
    stall_starts = rng.uniform(edges_ns[0], edges_ns[-1], stall_count)
    stalls = [(start, start + rng.exponential(load.stall_ms * MS)) for start in stall_starts]
    arrivals: list[tuple[float, int]] = []
    sent_ns = 0.0
    for k, stop in enumerate([*range(PAYLOAD, row_bytes, PAYLOAD), row_bytes]):
        # The packet is full when its last byte has come from the radar: it is byte `bytes_of_frame` of `frame`.
        frame = (stop - 1) // frame_bytes
        bytes_of_frame = stop - frame * frame_bytes
        full_ns = edges_ns[frame] + FRAME_NS * bytes_of_frame / frame_bytes
        is_short = stop == row_bytes and row_bytes % PAYLOAD != 0
        if is_short:
            full_ns += LAST_PACKET_DELAY_NS
        stall_ends = [end for start, end in stalls if start <= full_ns < end]
        full_ns = max([full_ns, *stall_ends])
        sent_ns = max(full_ns, sent_ns + PACKET_INTERVAL_NS)
        if k not in lost:
            arrivals.append((sent_ns + NETWORK_NS + rng.exponential(MEAN_JITTER_NS), stop))
    arrivals.sort()
    times_ns = np.array([t for t, _ in arrivals])
    stops = np.array([stop for _, stop in arrivals], dtype=np.int64)
    # A packet that was overtaken adds nothing to the row's end.
    is_new = np.diff(np.maximum.accumulate(stops), prepend=0) > 0
    return np.column_stack([times_ns, stops])[is_new].astype(np.int64), events_ns.astype(np.int64)
