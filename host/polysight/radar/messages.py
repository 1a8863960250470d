"""Encode and decode mmWaveLink messages: sync word, header, sub-blocks, CRC.

Source of all numbers: TI, mmWave Radar Interface Control Document, revision 2.23 ("ICD"), sections 2.3 and 3. The
format is described in docs/spec/mmwavelink.md. Not run on hardware yet.
"""

from __future__ import annotations

import binascii
import struct
import zlib
from dataclasses import dataclass
from enum import IntEnum

from polysight_shared.errors import ProtocolError

HOST_SYNC = bytes.fromhex("34122143")
DEVICE_SYNC = bytes.fromhex("badccdab")
READY_TO_READ = bytes.fromhex("78566587") + b"\xff" * 12  # "CNYS": written by the host when the interrupt is high
SYNC_BYTES = 4
HEADER_BYTES = 12
CRC_BYTES = 4
MESSAGE_LIMIT = 256  # with the sync word
BODY_LIMIT = 232  # of one sub-block; the chunk size that TI recommends over SPI (ICD 20)
BLOCKS_PER_MESSAGE_ID = 32
ERROR_MESSAGE = 0
ERROR_BLOCK = 0x0000
_HEADER = struct.Struct("<6H")
_BLOCK = struct.Struct("<2H")
_PAD = b"\xff"
_RETRY = 0x0003
_NO_CRC = 0x0300
_CRC32 = 0x0400
_WHY = "noise on the SPI lines, or a device out of step"
_DO = "retried automatically; check the 60-pin connector and the USB cable if it happens again"


class Direction(IntEnum):
    """Direction of a message (ICD table 2.2)."""

    HOST_TO_RF = 1
    RF_TO_HOST = 2
    HOST_TO_MAIN = 5
    MAIN_TO_HOST = 6


class Kind(IntEnum):
    """Type of a message."""

    COMMAND = 0
    RESPONSE = 1
    NACK = 2
    EVENT = 3


@dataclass(frozen=True)
class SubBlock:
    """A setting or a report: its number (message id x 32 + n) and its data without number and length."""

    id: int
    data: bytes = b""

    @property
    def message_id(self) -> int:
        """Id of the message that contains this sub-block."""
        return self.id // BLOCKS_PER_MESSAGE_ID


@dataclass(frozen=True)
class Message:
    """One message (one chunk) without length and checksums."""

    direction: Direction
    kind: Kind
    message_id: int
    blocks: tuple[SubBlock, ...] = ()
    sequence: int = 0
    retry: bool = False
    remaining_chunks: int = 0

    @property
    def error(self) -> tuple[int | None, int | None] | None:
        """Error number and sub-block number of a refusal; None for any other message.

        A refusal has message id 0 (ICD 4.4) and the sub-block of ICD table 5.1. Both numbers are None in a refusal
        without a body, as first-generation devices send it.
        """
        if self.kind is not Kind.RESPONSE:
            return None
        for block in self.blocks:
            if block.id == ERROR_BLOCK and len(block.data) >= 4:
                number, where = _BLOCK.unpack(block.data[:4])
                return number, where
        return (None, None) if self.message_id == ERROR_MESSAGE else None


@dataclass(frozen=True)
class Header:
    """A valid header."""

    direction: int
    kind: Kind
    message_id: int
    length: int
    flags: int
    remaining_chunks: int
    block_count: int

    @property
    def body_bytes(self) -> int:
        """Number of bytes after the header, with the CRC."""
        return self.length - HEADER_BYTES

    @property
    def crc_bytes(self) -> int:
        """Size of the CRC: 0, 2 or 4; the first event after power-up has 16 bits (ICD 293)."""
        if self.flags & _NO_CRC == _NO_CRC:
            return 0
        bits = self.flags >> 10 & 3
        if bits > 1:
            raise ProtocolError(f"a message with CRC length code {bits}; only 0 and 1 are known", _WHY, _DO)
        return 2 << bits

    @property
    def sequence(self) -> int:
        """Sequence number, 0..15."""
        return self.flags >> 12

    @property
    def is_bare_refusal(self) -> bool:
        """True for an error response that announces a sub-block but has none, as sent by an AWR1243."""
        refused = self.kind is Kind.RESPONSE and self.message_id == ERROR_MESSAGE
        return refused and self.length == HEADER_BYTES + self.crc_bytes


def command(blocks: tuple[SubBlock, ...], *, sequence: int = 0, retry: bool = False, remaining: int = 0) -> Message:
    """Create a command of sub-blocks with one message id, for the main core (0x200 and above) or the RF core."""
    ids = {b.message_id for b in blocks}
    if len(ids) != 1:
        raise ValueError(f"sub-blocks of one command share one message id, these have {sorted(ids)}")
    message_id = ids.pop()
    direction = Direction.HOST_TO_MAIN if message_id >= 0x200 else Direction.HOST_TO_RF
    return Message(direction, Kind.COMMAND, message_id, blocks, sequence, retry, remaining)


def checksum(words: bytes) -> int:
    """Compute the ones-complement of the ones-complement sum of little-endian 16-bit words (ICD 12; RFC 1071)."""
    total = sum(struct.unpack(f"<{len(words) // 2}H", words))
    while total >> 16:
        total = (total & 0xFFFF) + (total >> 16)
    return ~total & 0xFFFF


def encode(message: Message) -> bytes:
    """Encode a message: sync word, header, body, 32-bit CRC.

    The body is padded with 0xFF so that the length without CRC is a multiple of 4 (ICD 9). Raises ValueError if a field
    exceeds its bits or the message the size of a chunk.
    """
    body = b"".join(_BLOCK.pack(b.id, len(b.data) + _BLOCK.size) + b.data for b in message.blocks)
    body += _PAD * (-len(body) % 4)
    length = HEADER_BYTES + len(body) + CRC_BYTES
    if not 0 <= message.sequence < 16 or not 0 <= message.message_id < 1024:
        raise ValueError(f"sequence {message.sequence} must be 0..15, message id {message.message_id} 0..1023")
    if SYNC_BYTES + length > MESSAGE_LIMIT:
        raise ValueError(f"a message of {SYNC_BYTES + length} bytes; one chunk holds at most {MESSAGE_LIMIT}")
    opcode = message.direction | message.kind << 4 | message.message_id << 6
    flags = message.sequence << 12 | _CRC32 | (_RETRY if message.retry else 0)
    head = struct.pack("<5H", opcode, length, flags, message.remaining_chunks, len(message.blocks))
    head += checksum(head).to_bytes(2, "little")
    sync = HOST_SYNC if message.direction in (Direction.HOST_TO_RF, Direction.HOST_TO_MAIN) else DEVICE_SYNC
    return sync + head + body + zlib.crc32(head + body).to_bytes(4, "little")


def decode_header(raw: bytes) -> Header:
    """Decode the first 16 bytes of a message, sync word and header. Raises ProtocolError."""
    if len(raw) < SYNC_BYTES + HEADER_BYTES or raw[:SYNC_BYTES] not in (HOST_SYNC, DEVICE_SYNC):
        raise ProtocolError(f"no sync word in {raw[:16].hex()}", _WHY, _DO)
    head = raw[SYNC_BYTES : SYNC_BYTES + HEADER_BYTES]
    opcode, length, flags, remaining, count, expected = _HEADER.unpack(head)
    if checksum(head[:-2]) != expected:
        raise ProtocolError(f"header {head.hex()}: checksum {expected:04x} is wrong", _WHY, _DO)
    header = Header(opcode & 0xF, Kind(opcode >> 4 & 3), opcode >> 6, length, flags, remaining, count)
    if not HEADER_BYTES + header.crc_bytes <= length <= MESSAGE_LIMIT - SYNC_BYTES:
        raise ProtocolError(f"header {head.hex()}: invalid length of {length} bytes", _WHY, _DO)
    return header


def decode(raw: bytes) -> Message:
    """Decode a message. Raises ProtocolError if sync word, checksum, CRC, length or sub-blocks are wrong."""
    header = decode_header(raw)
    inner = raw[SYNC_BYTES:]
    if len(inner) != header.length:
        raise ProtocolError(f"{len(inner)} bytes of a message of {header.length}", _WHY, _DO)
    end = header.length - header.crc_bytes
    if crc(inner[:end], header.crc_bytes) != inner[end:]:
        raise ProtocolError(f"message {inner.hex()}: its CRC is wrong", _WHY, _DO)
    try:
        direction = Direction(header.direction)
    except ValueError:
        raise ProtocolError(f"message {inner.hex()}: unknown direction {header.direction}", _WHY, _DO) from None
    return Message(
        direction,
        header.kind,
        header.message_id,
        _blocks(inner[HEADER_BYTES:end], 0 if header.is_bare_refusal else header.block_count),
        header.sequence,
        header.flags & _RETRY == _RETRY,
        header.remaining_chunks,
    )


def crc(data: bytes, size: int) -> bytes:
    """Compute a CRC of 0, 2 or 4 bytes (ICD table 2.7): CCITT from 0xFFFF, or that of Ethernet; little-endian."""
    if size == 0:
        return b""
    value = zlib.crc32(data) if size == 4 else binascii.crc_hqx(data, 0xFFFF)
    return value.to_bytes(size, "little")


def _blocks(body: bytes, count: int) -> tuple[SubBlock, ...]:
    blocks = []
    start = 0
    for _ in range(count):
        if start + _BLOCK.size > len(body):
            raise ProtocolError(f"{count} sub-blocks announced, {len(blocks)} found", _WHY, _DO)
        number, length = _BLOCK.unpack_from(body, start)
        if length < _BLOCK.size or start + length > len(body):
            raise ProtocolError(f"sub-block 0x{number:04X} with a length of {length} bytes", _WHY, _DO)
        blocks.append(SubBlock(number, body[start + _BLOCK.size : start + length]))
        start += length
    if len(body) - start >= 4:
        raise ProtocolError(f"{len(body) - start} bytes after the last of {count} sub-blocks", _WHY, _DO)
    return tuple(blocks)
