"""A block of radar data as a card sends it: a direct path and an echo in noise, whole bursts in whole packets."""

from __future__ import annotations

import struct

import numpy as np
from numpy.typing import NDArray

from polysight.capture.dca1000 import MAX_PAYLOAD_BYTES, PACKET_HEADER_BYTES
from polysight_shared.config import Instrument

PACKETS = 4096
"""4096 packets of 1456 bytes are 1456 frames of 4096 bytes, 91 bursts of 16: blocks join without a seam."""


def make_block(rig: Instrument, seed: int) -> bytes:
    """The block, `PACKETS` full payloads: int16 I0..I3 Q0..Q3 a sample."""
    rng = np.random.default_rng(seed)
    samples = rig.chirp.samples
    frames = PACKETS * MAX_PAYLOAD_BYTES // rig.frame_bytes
    t = np.arange(samples) / rig.chirp.sample_rate_hz
    phase = rng.uniform(0, 2 * np.pi, (frames, 1))
    tones: NDArray[np.complex128] = 800 * np.exp(1j * (2 * np.pi * 190e3 * t + phase)) + 60 * np.exp(
        1j * (2 * np.pi * 310e3 * t + phase)
    )
    noise = rng.normal(scale=15, size=(frames, samples, 2, 4))
    parts = np.stack([tones.real, tones.imag], axis=-1)[..., None] + noise
    return np.round(parts).astype("<i2").tobytes()


def make_packets(block: bytes) -> np.ndarray:
    """uint8 [PACKETS, header and payload]; the headers are for :func:`number`."""
    packets = np.zeros((PACKETS, PACKET_HEADER_BYTES + MAX_PAYLOAD_BYTES), dtype=np.uint8)
    packets[:, PACKET_HEADER_BYTES:] = np.frombuffer(block, dtype=np.uint8).reshape(PACKETS, MAX_PAYLOAD_BYTES)
    return packets


def number(packets: np.ndarray, first: int) -> None:
    """Give the packets the counters of packets `first`, `first + 1`... since power-up."""
    k = np.arange(first, first + len(packets), dtype=np.uint64)
    heads = np.empty(len(packets), dtype=[("sequence", "<u4"), ("low", "<u4"), ("high", "<u2")])
    count = k * np.uint64(MAX_PAYLOAD_BYTES)
    heads["sequence"] = (k + np.uint64(1)) & np.uint64(0xFFFFFFFF)
    heads["low"], heads["high"] = count & np.uint64(0xFFFFFFFF), count >> np.uint64(32)
    packets[:, :PACKET_HEADER_BYTES] = heads.view(np.uint8).reshape(len(packets), struct.calcsize("<IIH"))
