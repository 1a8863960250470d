"""Recordings made by formula: rows of both layouts, and packet captures."""

import struct
from pathlib import Path

import numpy as np

# IP addresses of two cards.
CARD = b"\xc0\xa8\x21\xb4"
OTHER = b"\xc0\xa8\x21\xb5"


def draw_row(
    lanes: int,
    q_first: bool,
    chirps: int = 32,
    samples: int = 256,
    dead: int | None = None,
) -> np.ndarray:
    """Return a row's int16 words in the layout of 2 or 4 lanes: two tones at positive frequencies a chirp, and noise.

    `q_first`: Q before I; `dead`: an RX without signal.
    """
    rng = np.random.default_rng(5)
    t = np.arange(samples)
    x = np.zeros((4, chirps, samples), dtype=complex)
    for c in range(chirps):
        f = rng.uniform(0.05, 0.4)
        tones = 300 * np.exp(2j * np.pi * f * t) + 200 * np.exp(2j * np.pi * (f + 0.014) * t + 1j)
        for r in range(4):
            noise = rng.normal(scale=20, size=(2, samples))
            x[r, c] = tones * np.exp(1j * r) + noise[0] + 1j * noise[1]
    if dead is not None:
        x[dead] = 0
    # [part, rx, chirp, sample]
    parts = np.stack([x.imag, x.real] if q_first else [x.real, x.imag])
    if lanes == 4:
        words = parts.transpose(2, 3, 0, 1)
    else:
        words = parts.reshape(2, 4, chirps, samples // 2, 2).transpose(2, 1, 3, 0, 4)
    return np.round(words).astype("<i2").reshape(-1)


def encode_udp_frame(source_port: int, payload: bytes, card: bytes = CARD) -> bytes:
    """Return an Ethernet frame with an IPv4 UDP datagram from a card."""
    udp = struct.pack(">HHHH", source_port, 4098, 8 + len(payload), 0) + payload
    ip = struct.pack(">BBHHHBBH4s4s", 0x45, 0, 20 + len(udp), 0, 0x4000, 64, 17, 0, card, b"\xc0\xa8!\x1e")
    return bytes(12) + b"\x08\x00" + ip + udp


def write_pcap(
    path: Path, payloads: list[bytes], order: str = "<", magic: int = 0xA1B2C3D4, cards: tuple[bytes, ...] = (CARD,)
) -> None:
    """Write a capture file of UDP payloads, which come from the cards in turn."""
    raw = struct.pack(order + "IHHiIII", magic, 2, 4, 0, 0, 65535, 1)
    for k, p in enumerate(payloads):
        frame = encode_udp_frame(1024, p, cards[k % len(cards)])
        raw += struct.pack(order + "IIII", 100 + k, 5, len(frame), len(frame)) + frame
    path.write_bytes(raw)
