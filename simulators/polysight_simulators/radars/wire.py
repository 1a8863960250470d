"""Encode a simulated device's messages, after TI's interface control document ("ICD", revision 2.23) and received ones.

Independent of the host's codec.
"""

from __future__ import annotations

import binascii
import struct
import zlib

TO_DEVICE, READY, FROM_DEVICE = bytes.fromhex("34122143"), bytes.fromhex("78566587"), bytes.fromhex("badccdab")
RESPONSE, NACK, EVENT = 1, 2, 3

# Received from real devices (TI E2E forum, threads 670135, 752121, 1267477).
FAULT_DATA = bytes.fromhex("05000000800000fe") + bytes(16) + b"\xff" * 6 + bytes(2)
OLD_UP_EMPTY = bytes.fromhex("00000000ff7c0c000000000000000000")
OLD_UP_WRITTEN = bytes.fromhex("10aa0500") + bytes(16)


def ones_sum(head: bytes) -> int:
    """Compute the ones-complement sum of 16-bit words; 0xFFFF over a header with its checksum (ICD 2.3.2)."""
    total = sum(struct.unpack(f"<{len(head) // 2}H", head))
    while total > 0xFFFF:
        total = (total & 0xFFFF) + (total >> 16)
    return total


def frame(direction: int, kind: int, number: int, body: bytes, count: int, sequence: int, wide: bool) -> bytes:
    """Encode a message with a CRC of 32 (`wide`) or 16 bits (ICD 2.3); the latter has its acknowledgement bits set."""
    flags = sequence << 12 | (1 << 10 if wide else 0xC)
    head = struct.pack("<5H", direction | kind << 4 | number << 6, 12 + len(body) + (4 if wide else 2), flags, 0, count)
    head += struct.pack("<H", 0xFFFF - ones_sum(head))
    crc = zlib.crc32(head + body).to_bytes(4, "little")
    if not wide:
        crc = binascii.crc_hqx(head + body, 0xFFFF).to_bytes(2, "little")
    return FROM_DEVICE + head + body + crc
