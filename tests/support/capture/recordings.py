"""Made-up recordings: rows in both layouts of the radar's words, and packet captures (pcap files)."""

import struct
from pathlib import Path

import numpy as np

# IP addresses of the host and of two cards: 192.168.33.30, .180 and .181.
HOST = bytes([192, 168, 33, 30])
CARD = bytes([192, 168, 33, 180])
OTHER = bytes([192, 168, 33, 181])
# UDP port of the host
DATA_PORT = 4098


def draw_row(
    lanes: int,
    q_first: bool,
    chirps: int = 32,
    samples: int = 256,
    dead: int | None = None,
) -> np.ndarray:
    """Return a row's int16 words in the layout of 2 or 4 LVDS lanes. Each chirp has two tones and noise.

    The tones have positive frequencies. `q_first`: Q comes before I; `dead`: number of an RX without signal.
    """
    rng = np.random.default_rng(5)
    t = np.arange(samples)
    signals = np.zeros((4, chirps, samples), dtype=complex)
    for chirp in range(chirps):
        # Turns per sample
        frequency = rng.uniform(0.05, 0.4)
        first_tone = 300 * np.exp(2j * np.pi * frequency * t)
        second_tone = 200 * np.exp(2j * np.pi * (frequency + 0.014) * t + 1j)
        for rx in range(4):
            noise = rng.normal(scale=20, size=(2, samples))
            # Each RX has another phase.
            signals[rx, chirp] = (first_tone + second_tone) * np.exp(1j * rx) + noise[0] + 1j * noise[1]
    if dead is not None:
        signals[dead] = 0
    # [I or Q, RX, chirp, sample]
    parts = np.stack([signals.imag, signals.real] if q_first else [signals.real, signals.imag])
    if lanes == 4:
        words = parts.transpose(2, 3, 0, 1)
    else:
        words = parts.reshape(2, 4, chirps, samples // 2, 2).transpose(2, 1, 3, 0, 4)
    return np.round(words).astype("<i2").reshape(-1)


def encode_udp_frame(source_port: int, payload: bytes, card: bytes = CARD) -> bytes:
    """Return an Ethernet frame with an IPv4 UDP datagram from a card."""
    # A length includes its own header: 8 bytes of UDP, 20 of IPv4.
    udp = struct.pack(">HHHH", source_port, DATA_PORT, 8 + len(payload), 0) + payload
    # Version 4 with five words of header, no fragments (0x4000), 64 hops, protocol 17 (UDP), no checksum
    ip = struct.pack(">BBHHHBBH4s4s", 0x45, 0, 20 + len(udp), 0, 0x4000, 64, 17, 0, card, HOST)
    mac_addresses = bytes(12)
    ethernet_type_of_ipv4 = b"\x08\x00"
    return mac_addresses + ethernet_type_of_ipv4 + ip + udp


def write_pcap(
    path: Path, payloads: list[bytes], order: str = "<", magic: int = 0xA1B2C3D4, cards: tuple[bytes, ...] = (CARD,)
) -> None:
    """Write a pcap file of UDP payloads, which come from the cards in turn, one a second.

    `order` is the byte order of the file, and `magic` the number at its start, which shows the unit of times.
    """
    # Version 2.4, UTC, up to 65,535 bytes of a packet, and Ethernet (1)
    raw = struct.pack(order + "IHHiIII", magic, 2, 4, 0, 0, 65535, 1)
    for k, payload in enumerate(payloads):
        frame = encode_udp_frame(source_port=1024, payload=payload, card=cards[k % len(cards)])
        time_s = 100 + k
        fraction = 5
        raw += struct.pack(order + "IIII", time_s, fraction, len(frame), len(frame)) + frame
    path.write_bytes(raw)
