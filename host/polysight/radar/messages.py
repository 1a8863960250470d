"""Encode and decode mmWaveLink messages (sync word, header, sub-blocks, CRC), and decode a radar's events.

Source of all numbers: TI, mmWave Radar Interface Control Document, revision 2.23 ("ICD"), sections 2.3 and 3; "ICD 337"
is its page 337, which lists the fatal events: they require a reset and a new configuration. For most tables of events
the page is given. Error numbers of refused commands are described as well. The format is described in
docs/spec/mmwavelink.md. The device raises its host interrupt line when it has a message. This code has not run on
hardware yet; messages that others received from devices are in its tests.
"""

from __future__ import annotations

import binascii
import struct
import zlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from enum import IntEnum
from typing import NamedTuple

from polysight_shared.errors import ProtocolError

# First bytes of a message from the host, and from the device.
HOST_SYNC = bytes.fromhex("34122143")
DEVICE_SYNC = bytes.fromhex("badccdab")
# Written by the host when the interrupt is high ("CNYS" in the ICD): the word, and filler to 16 bytes.
READY_TO_READ = bytes.fromhex("78566587") + b"\xff" * 12
SYNC_BYTES = 4
HEADER_BYTES = 12
CRC_BYTES = 4
# Bytes of a message with its sync word.
MESSAGE_LIMIT = 256
# Bytes of a file that one message carries, the data of one sub-block: the chunk size that TI recommends over SPI (ICD
# 20).
BODY_LIMIT = 232
BLOCKS_PER_MESSAGE_ID = 32
# Message and sub-block of a refusal (ICD section 4.4, table 5.1).
ERROR_MESSAGE = 0
ERROR_BLOCK = 0x0000
# Opcode (direction, type, message id), length, flags, remaining chunks, number of sub-blocks, checksum.
_HEADER = struct.Struct("<6H")
# Number and length of a sub-block; also error number and sub-block of a refusal.
_BLOCK = struct.Struct("<2H")
_PAD = b"\xff"
# Bits of the header's flags. The first two are fields of two bits, of which only both set means yes.
_RETRY = 0x0003
_NO_CRC = 0x0300
_CRC32 = 0x0400
# Cause and remedy of a message that cannot be decoded.
_DECODING_CAUSE = "noise on the SPI lines, or a device out of step"
_DECODING_REMEDY = "retried automatically; check the 60-pin connector and the USB cable if it happens again"

# Sub-block numbers of events; 0x10.. are those of the RF core, 0x50.. those of the main core.
RF_CPU_FAULT = 0x1002
RF_ESM_FAULT = 0x1003
RF_INIT_DONE = 0x1004
TRIGGER_READY = 0x100B
FRAME_END = 0x100F
ANALOG_FAULT = 0x1010
TIMING_FAILURE = 0x1011
CALIBRATION_REPORT = 0x1012
MAIN_POWER_UP = 0x5000
RF_POWER_UP_DONE = 0x5001
MAIN_CPU_FAULT = 0x5002
MAIN_ESM_FAULT = 0x5003
BOOT_STATUS = 0x5005
RF_ERROR = 0x5008


# Events of a start: if none is expected, the board has started by itself and lost its settings.
START_EVENTS = frozenset({MAIN_POWER_UP})


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
    # Number of the command, 0..15; its answer has the same.
    sequence: int = 0
    # True if the same command was sent before.
    retry: bool = False
    # Messages that follow with the rest of the content.
    remaining_chunks: int = 0

    @property
    def error(self) -> tuple[int | None, int | None] | None:
        """Error number and sub-block number of a refusal; None for any other message.

        A refusal has message id 0 (ICD section 4.4) and the sub-block of table 5.1. Both numbers are None in a refusal
        without a body, as first-generation devices send it.
        """
        if self.kind is not Kind.RESPONSE:
            return None
        for block in self.blocks:
            if block.id == ERROR_BLOCK and len(block.data) >= 4:
                number, block_number = _BLOCK.unpack(block.data[:4])
                return number, block_number
        if self.message_id != ERROR_MESSAGE:
            return None
        return None, None


@dataclass(frozen=True)
class Header:
    """A header whose checksum is right."""

    direction: int
    kind: Kind
    message_id: int
    # Bytes of header, body and CRC.
    length: int
    # Sequence number, length of the CRC, retry.
    flags: int
    # Messages that follow with the rest of the content.
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
            raise ProtocolError(
                f"a message with CRC length code {bits}; only 0 and 1 are known", _DECODING_CAUSE, _DECODING_REMEDY
            )
        return 2 << bits

    @property
    def sequence(self) -> int:
        """Sequence number, 0..15."""
        return self.flags >> 12

    @property
    def is_bare_refusal(self) -> bool:
        """True for an error response without any sub-block, as sent by an AWR1243."""
        refused = self.kind is Kind.RESPONSE and self.message_id == ERROR_MESSAGE
        return refused and self.length == HEADER_BYTES + self.crc_bytes


def command(blocks: tuple[SubBlock, ...], *, sequence: int = 0, retry: bool = False, remaining: int = 0) -> Message:
    """Create a command of sub-blocks with one message id, for the main core (0x200 and above) or the RF core."""
    ids = {b.message_id for b in blocks}
    if len(ids) != 1:
        raise ValueError(f"sub-blocks of one command share one message id, these have {sorted(ids)}")
    message_id = ids.pop()
    direction = Direction.HOST_TO_MAIN if message_id >= 0x200 else Direction.HOST_TO_RF
    return Message(
        direction=direction,
        kind=Kind.COMMAND,
        message_id=message_id,
        blocks=blocks,
        sequence=sequence,
        retry=retry,
        remaining_chunks=remaining,
    )


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
    flags = message.sequence << 12 | _CRC32
    if message.retry:
        flags |= _RETRY
    head = struct.pack("<5H", opcode, length, flags, message.remaining_chunks, len(message.blocks))
    head += checksum(head).to_bytes(2, "little")
    if message.direction in (Direction.HOST_TO_RF, Direction.HOST_TO_MAIN):
        sync = HOST_SYNC
    else:
        sync = DEVICE_SYNC
    return sync + head + body + zlib.crc32(head + body).to_bytes(4, "little")


def decode_header(raw: bytes) -> Header:
    """Decode the first 16 bytes of a message, sync word and header. Raises ProtocolError."""
    if len(raw) < SYNC_BYTES + HEADER_BYTES or raw[:SYNC_BYTES] not in (HOST_SYNC, DEVICE_SYNC):
        raise ProtocolError(f"no sync word in {raw[:16].hex()}", _DECODING_CAUSE, _DECODING_REMEDY)
    head = raw[SYNC_BYTES : SYNC_BYTES + HEADER_BYTES]
    opcode, length, flags, remaining, count, expected = _HEADER.unpack(head)
    if checksum(head[:-2]) != expected:
        raise ProtocolError(f"header {head.hex()}: checksum {expected:04x} is wrong", _DECODING_CAUSE, _DECODING_REMEDY)
    header = Header(
        direction=opcode & 0xF,
        kind=Kind(opcode >> 4 & 3),
        message_id=opcode >> 6,
        length=length,
        flags=flags,
        remaining_chunks=remaining,
        block_count=count,
    )
    if not HEADER_BYTES + header.crc_bytes <= length <= MESSAGE_LIMIT - SYNC_BYTES:
        raise ProtocolError(f"header {head.hex()}: invalid length of {length} bytes", _DECODING_CAUSE, _DECODING_REMEDY)
    return header


def decode(raw: bytes) -> Message:
    """Decode a message. Raises ProtocolError if sync word, checksum, CRC, length or sub-blocks are wrong."""
    header = decode_header(raw)
    inner = raw[SYNC_BYTES:]
    if len(inner) != header.length:
        raise ProtocolError(f"{len(inner)} bytes of a message of {header.length}", _DECODING_CAUSE, _DECODING_REMEDY)
    end = header.length - header.crc_bytes
    if crc(inner[:end], header.crc_bytes) != inner[end:]:
        raise ProtocolError(f"message {inner.hex()}: its CRC is wrong", _DECODING_CAUSE, _DECODING_REMEDY)
    try:
        direction = Direction(header.direction)
    except ValueError:
        raise ProtocolError(
            f"message {inner.hex()}: unknown direction {header.direction}", _DECODING_CAUSE, _DECODING_REMEDY
        ) from None
    block_count = header.block_count
    if header.is_bare_refusal:
        block_count = 0
    return Message(
        direction=direction,
        kind=header.kind,
        message_id=header.message_id,
        blocks=_split_blocks(inner[HEADER_BYTES:end], block_count),
        sequence=header.sequence,
        retry=header.flags & _RETRY == _RETRY,
        remaining_chunks=header.remaining_chunks,
    )


def crc(data: bytes, size: int) -> bytes:
    """Compute a CRC of 0, 2 or 4 bytes (ICD table 2.7): CCITT from 0xFFFF, or that of Ethernet; little-endian."""
    if size == 0:
        return b""
    if size == 4:
        value = zlib.crc32(data)
    else:
        value = binascii.crc_hqx(data, 0xFFFF)
    return value.to_bytes(size, "little")


def _split_blocks(body: bytes, count: int) -> tuple[SubBlock, ...]:
    """Return the sub-blocks of a body, which may end with up to three bytes of padding. Raises ProtocolError."""
    blocks = []
    start = 0
    for _ in range(count):
        if start + _BLOCK.size > len(body):
            raise ProtocolError(f"{count} sub-blocks announced, {len(blocks)} found", _DECODING_CAUSE, _DECODING_REMEDY)
        number, length = _BLOCK.unpack_from(body, start)
        if length < _BLOCK.size or start + length > len(body):
            raise ProtocolError(
                f"sub-block 0x{number:04X} with a length of {length} bytes", _DECODING_CAUSE, _DECODING_REMEDY
            )
        blocks.append(SubBlock(number, body[start + _BLOCK.size : start + length]))
        start += length
    if len(body) - start >= 4:
        raise ProtocolError(
            f"{len(body) - start} bytes after the last of {count} sub-blocks", _DECODING_CAUSE, _DECODING_REMEDY
        )
    return tuple(blocks)


class InitBit(NamedTuple):
    """A calibration of the RF init. `of_transmitter`: required only on a transmitting board."""

    name: str
    of_transmitter: bool = False


# ICD 217, where 0 is "fail"
INIT_BITS = {
    1: InitBit("clock PLL"),
    2: InitBit("synthesizer VCO1"),
    3: InitBit("synthesizer VCO2"),
    4: InitBit("LO distribution"),
    5: InitBit("ADC offset"),
    6: InitBit("high-pass filter"),
    7: InitBit("low-pass filter"),
    8: InitBit("peak detector", of_transmitter=True),
    9: InitBit("TX power", of_transmitter=True),
    10: InitBit("RX gain"),
    11: InitBit("TX phase", of_transmitter=True),
    12: InitBit("RX I/Q"),
}
_INIT_NAMES = {bit: calibration.name for bit, calibration in INIT_BITS.items()}


def list_failed_calibrations(event: Event, transmits: bool, run: int) -> list[str]:
    """Return the calibrations that failed in the RF init and that the board needs.

    `run` is the mask, by the bits of `INIT_BITS`, of requested calibrations besides clock and synthesizers (bits 1 to
    3), which run at every start.
    """
    passed = event.values.get("passed")
    if not isinstance(passed, int):
        return ["unreadable report"]
    requested = run | 0b1110
    failed = [c for bit, c in INIT_BITS.items() if requested >> bit & 1 and not passed >> bit & 1]
    return [calibration.name for calibration in failed if transmits or not calibration.of_transmitter]


# Texts by the number in an event, from 0. ICD 212, 317
_CPU_FAULTS = (
    "undefined instruction",
    "instruction fetch abort",
    "data access abort",
    "firmware fatal error",
    "chirp error",
    "register read-back error",
    "power save error",
)
# ICD 213
_RF_CODES = (
    "undefined",
    "the ramp generator was not triggered by a pulse",
    "burst starts and ends do not match",
    "chirp starts and ends do not match",
    "a calibration was not done before the burst",
    "event queue full: the host does not read",
    "sequencer copy error",
    "temperature data invalid",
    "test source not ready in time",
)
_RF_ERRORS = {1: "RF firmware assert", 2: "RF firmware abort", 3: "ESM group 1", 4: "ESM group 2", 7: "monitoring"}
# ICD 223
_ANALOG_NAMES = {0: "1.8 V supply", 1: "1.3 V / 1.0 V RF supply", 2: "VCO LDO shorted", 3: "PA LDO shorted"}
# Self-tests of the RF core in the event 0x5001: bits 0 to 26, each set if its test passed.
_RF_TESTS = 0x07FFFFFF
# Bits of group 1 that are fatal. RF core: the programmable filter's double bit error (ICD 216, which reserves the bit
# of its parity error). Main core: "FRC lockstep" (ICD 320). The others are not in the list of fatal events.
_RF_GROUP1_FATAL = 1 << 25
_MAIN_GROUP1_FATAL = 1 << 22

# Boot status (ICD table 7.3), bit: meaning. The first group means an empty flash or a damaged image.
_FLASH_BITS = {
    2: "image 1 not authentic",
    3: "image 2 not authentic",
    4: "image 3 not authentic",
    5: "no program header",
    6: "no image header",
    19: "image length wrong",
    20: "main core's image offset wrong",
    21: "RF core's image offset wrong",
    22: "DSP's image offset wrong",
    26: "error in the 2 kB image",
    28: "main core's image not found",
    29: "image header counts wrong",
    30: "image header damaged (CRC)",
    31: "image 4 not authentic",
    32: "configuration's offset wrong",
    39: "serial flash not found",
}
_HARDWARE_BITS = {
    8: "fuses damaged",
    48: "crystal not detected",
    50: "DSP does not start",
    51: "main core's logic self-test failed",
    52: "DSP's self-test failed",
    53: "memory self-test failed (single port)",
    54: "memory self-test failed (two ports)",
    55: "memory not initialised",
    56: "ROM self-test failed",
}
_OTHER_BITS = {
    0: "certificate not authentic",
    1: "certificate unreadable",
    7: "older software than allowed",
    27: "shared memory not allocated",
    49: "started on the crystal",
    57: "voltage monitor",
    63: "error signal module",
    **dict.fromkeys((*range(9, 19), *range(23, 26), *range(33, 39)), "certificate or key"),
}
_BOOT_BITS = _FLASH_BITS | _HARDWARE_BITS | _OTHER_BITS

# API error codes, ICD 338-349, of the commands sent here
REFUSALS = {
    1: "wrong message number",
    2: "no sub-block in the message",
    3: "wrong sub-block number",
    4: "wrong sub-block length",
    5: "wrong sub-block data",
    6: "error while processing the command",
    7: "file CRC mismatch",
    8: "file type mismatch",
    20: "frames are already started",
    21: "frames are already stopped",
    22: "no valid frame configuration",
    23: "start/stop word out of range",
    24: "RX mask out of range",
    25: "TX mask out of range",
    36: "start frequency outside 76..81 GHz",
    38: "idle time shorter than the filters' spill time",
    41: "ADC window does not end inside the ramp",
    46: "ramp ends outside 76..81 GHz",
    48: "number of samples out of range",
    49: "sample rate out of range",
    52: "RX gain out of range or odd",
    66: "sweep outside the VCO's range",
    69: "ADC window does not end inside the ramp",
    71: "chirp uses a TX that is not powered",
    75: "frame uses a chirp that is not configured",
    76: "frame uses a profile that is not configured",
    79: "frame period out of range",
    80: "chirps take longer than the frame period",
    81: "trigger select out of range",
    83: "frames are running",
    129: "stop 4 needs hardware triggers",
    1013: "data rate and clock edges do not go together",
    1023: "words per chirp outside 64..8192",
}
# Decoded data of an event: description, True if it is fatal, and numbers for the manifest.
_Read = tuple[str, bool, Mapping[str, object]]


@dataclass(frozen=True)
class Event:
    """One asynchronous event.

    Attributes
    ----------
    id, name, detail
        Number of its sub-block; description of the kind, and of this one.
    fatal
        True if the device must be reset.
    values
        Numbers for the manifest. In a boot status, `cure` is "firmware" if the flash is empty or damaged, which a
        download repairs, "hardware" if the device reports a defect, otherwise "".
    """

    id: int
    name: str
    detail: str = ""
    fatal: bool = False
    values: Mapping[str, object] = field(default_factory=dict)

    def __str__(self) -> str:
        if not self.detail:
            return self.name
        return f"{self.name}: {self.detail}"


def describe_refusal(number: int | None, block: int | None) -> str:
    """Describe error number and sub-block of a refused command."""
    if number is None or block is None:
        return "without a reason"
    return f"{REFUSALS.get(number, 'see the interface control document')} (error {number}, sub-block 0x{block:04X})"


def decode_event(block: SubBlock) -> Event:
    """Decode an event; an unknown or truncated one keeps its bytes. A truncated fault is fatal."""
    decoder = _EVENTS.get(block.id)
    if decoder is None:
        return Event(block.id, f"event 0x{block.id:04X}", block.data.hex())
    name, read = decoder
    try:
        detail, fatal, values = read(block.data)
    except (struct.error, IndexError):
        fatal = block.id in _FATAL_IF_TRUNCATED
        return Event(block.id, name, f"only {len(block.data)} bytes: {block.data.hex()}", fatal)
    return Event(block.id, name, detail, fatal, values)


def _read_nothing(data: bytes) -> _Read:
    """Read an event that is its own message."""
    del data
    return "", False, {}


def _format_word(words: Mapping[int, str] | tuple[str, ...], number: int, kind: str = "code") -> str:
    """Return the text of a number, `code 9` if it has none; `kind` stands before such a number."""
    try:
        return words[number]
    except (KeyError, IndexError):
        return f"{kind} {number}"


def _name_bits(names: Mapping[int, str], mask: int, kind: str = "code") -> str:
    """Join the texts of the bits that are set in a mask, each text once."""
    return ", ".join(dict.fromkeys(_format_word(names, b, kind) for b in range(mask.bit_length()) if mask >> b & 1))


def _read_cpu(codes: tuple[str, ...]) -> Callable[[bytes], _Read]:
    """Return the reader of a core's fault; `codes` are the texts of its firmware's fatal errors."""

    def read(data: bytes) -> _Read:
        kind, code, line = struct.unpack_from("<BBH", data)
        if kind == 0xFF:
            return "no fault", False, {}
        detail = ""
        # Only the firmware's own fatal error, the fourth of `_CPU_FAULTS`, has a code and a line.
        if kind == 3 and codes:
            detail = f", {_format_word(codes, code)}, firmware line {line}"
        return _format_word(_CPU_FAULTS, kind) + detail, True, {"type": kind, "code": code, "line": line}

    return read


def _read_esm(fatal_in_group1: int) -> Callable[[bytes], _Read]:
    """Return the reader of a core's error signals (error signalling module); all of group 2 are fatal."""

    def read(data: bytes) -> _Read:
        group1, group2 = struct.unpack_from("<II", data)
        fatal = bool(group2 or group1 & fatal_in_group1)
        return f"group 1 0x{group1:08X}, group 2 0x{group2:08X}", fatal, {"group1": group1, "group2": group2}

    return read


def _read_init_done(data: bytes) -> _Read:
    """Read the event of the RF init: calibrations that passed and were updated, by bit of `INIT_BITS`; temperature."""
    status, updated, temperature, _, stamp = struct.unpack_from("<IIhHI", data)
    failed = sum(1 << b for b in INIT_BITS if not status >> b & 1)
    values = {"passed": status, "updated": updated, "temperature_c": temperature, "device_ms": stamp}
    text = f"{temperature} C"
    if failed:
        text += f"; failed: {_name_bits(_INIT_NAMES, failed)}"
    return text, False, values


def _read_analog(data: bytes) -> _Read:
    """Read the supplies that failed; fatal unless the event's type is 0."""
    kind, _, _, signals = struct.unpack_from("<BBHI", data)
    return _name_bits(_ANALOG_NAMES, signals) or "no signal reported", bool(kind), {"signals": signals}


def _read_boot(data: bytes) -> _Read:
    """Decode power-up time and status: 20 bytes, or 16 from the ROM of a first-generation device with empty flash.

    The short form has status, time, tests, as in a message that was received (tests/radar/test_received.py).
    """
    if len(data) < 20:
        boot, ticks, tests = struct.unpack_from("<IIQ", data)
    else:
        ticks, boot, tests = struct.unpack_from("<IQQ", data)
    parts = []
    if boot:
        parts = [_name_bits(_BOOT_BITS, boot, "bit")]
    if tests:
        parts.append(f"self-tests failed 0x{tests:X}")
    if any(boot >> bit & 1 for bit in _HARDWARE_BITS):
        cure = "hardware"
    elif any(boot >> bit & 1 for bit in _FLASH_BITS):
        cure = "firmware"
    else:
        cure = ""
    # Ticks of 5 ns.
    values = {"power_up_us": ticks * 0.005, "boot_errors": boot, "tests_failed": tests, "cure": cure}
    return "; ".join(parts), False, values


def _read_rf_power_up(data: bytes) -> _Read:
    """Read the event of the RF power-up: failed self-tests, and the time it took in ticks of 5 ns."""
    passed, ticks = struct.unpack_from("<II", data)
    failed = _RF_TESTS & ~passed
    text = ""
    if failed:
        text = f"self-tests failed 0x{failed:07X}"
    if failed == _RF_TESTS:
        text += ", all of them"
    return text, False, {"tests_passed": passed, "power_up_us": ticks * 0.005}


def _read_rf_error(data: bytes) -> _Read:
    """Read the main core's report of an RF core in trouble; asserts, aborts and ESM group 2 are fatal."""
    (flag,) = struct.unpack_from("<I", data)
    return _format_word(_RF_ERRORS, flag), flag in (1, 2, 4), {"flag": flag}


_FATAL_IF_TRUNCATED = (RF_CPU_FAULT, RF_ESM_FAULT, ANALOG_FAULT, MAIN_CPU_FAULT, MAIN_ESM_FAULT, RF_ERROR)
_EVENTS: dict[int, tuple[str, Callable[[bytes], _Read]]] = {
    RF_CPU_FAULT: ("RF core fault", _read_cpu(_RF_CODES)),
    RF_ESM_FAULT: ("RF core error signal", _read_esm(_RF_GROUP1_FATAL)),
    RF_INIT_DONE: ("RF calibrated", _read_init_done),
    TRIGGER_READY: ("ready for triggers", _read_nothing),
    FRAME_END: ("frames ended", _read_nothing),
    ANALOG_FAULT: ("analog supply fault", _read_analog),
    TIMING_FAILURE: ("calibrations do not fit the frame", _read_nothing),
    CALIBRATION_REPORT: ("run-time calibration", _read_nothing),
    MAIN_POWER_UP: ("main core is up", _read_boot),
    RF_POWER_UP_DONE: ("RF core is up", _read_rf_power_up),
    MAIN_CPU_FAULT: ("main core fault", _read_cpu(())),
    MAIN_ESM_FAULT: ("main core error signal", _read_esm(_MAIN_GROUP1_FATAL)),
    BOOT_STATUS: ("booted over SPI", _read_boot),
    RF_ERROR: ("RF core error", _read_rf_error),
}
