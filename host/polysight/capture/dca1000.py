"""Formats of the DCA1000 (docs/spec/dca1000.md): commands, replies, data packets, and the samples in their payload.

`PacketLog` holds the packets of a row in the order of their arrival, with the times at which they came. Which of them
are the row is decided in `placement.py`.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum, IntFlag
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from polysight_shared.errors import DataError, ErrorCode, ProtocolError

# First and last word of a request and a reply.
REQUEST_MAGIC = 0xA55A
FOOTER = 0xEEAA
# Largest body of a request, bytes.
MAX_REQUEST_DATA = 504
# The card sends replies and data from this port, for any port that it listens on.
CARD_SOURCE_PORT = 1024
PACKET_HEADER_BYTES = 10
MAX_PAYLOAD_BYTES = 1456
# Time of a full packet beyond the configured delay: delays of 5, 10, 25, 50 us give 706, 545, 325, 193 Mbit/s (TI).
PACKET_TIME_US = 11.0
MAX_PACKET_BYTES = PACKET_HEADER_BYTES + MAX_PAYLOAD_BYTES
BYTE_COUNT_BITS = 48
SEQUENCE_BITS = 32
# The card counts 8 ns ticks.
DELAY_TICKS_PER_US = 125
# Magic, code, length of the body.
_HEAD = struct.Struct("<HHH")
# Magic, code, status, footer.
_REPLY = struct.Struct("<HHHH")
# Sequence (32 bits), lower 32 and upper 16 bits of the byte count.
_PACKET = struct.Struct("<IIH")
_FOOTER = struct.Struct("<H")


class Code(IntEnum):
    """Command codes."""

    RESET_FPGA = 0x01
    RESET_RADAR = 0x02
    CONFIGURE_FPGA = 0x03
    CONFIGURE_EEPROM = 0x04
    RECORD_START = 0x05
    RECORD_STOP = 0x06
    ALIVE = 0x09
    STATUS = 0x0A
    CONFIGURE_PACKET = 0x0B
    VERSION = 0x0E


class Status(IntFlag):
    """Bits of the asynchronous status (code 0x0A)."""

    NO_LVDS_DATA = 1 << 0
    NO_HEADER = 1 << 1
    EEPROM_FAILURE = 1 << 2
    SD_CARD_DETECTED = 1 << 3
    SD_CARD_REMOVED = 1 << 4
    SD_CARD_FULL = 1 << 5
    MODE_CONFIGURATION_FAILED = 1 << 6
    DDR_FULL = 1 << 7
    RECORD_COMPLETED = 1 << 8
    LVDS_BUFFER_FULL = 1 << 9
    PLAYBACK_COMPLETED = 1 << 10
    PLAYBACK_OUT_OF_SEQUENCE = 1 << 11


LOST_BEFORE_PACKETS = Status.DDR_FULL | Status.LVDS_BUFFER_FULL
"""Status bits that report data dropped before the packets were numbered: bytes are lost without a counter gap."""


@dataclass(frozen=True)
class Reply:
    """Eight bytes from the card: the reply to a command (status 0: done), or (code STATUS) an asynchronous status."""

    code: int
    status: int


@dataclass(frozen=True)
class Version:
    """FPGA version of a card; `playback` if the FPGA plays recordings back instead of capturing."""

    major: int
    minor: int
    playback: bool

    def __str__(self) -> str:
        version = f"{self.major}.{self.minor}"
        if self.playback:
            version += " (playback)"
        return version


@dataclass(frozen=True)
class Counters:
    """The card's counters at a packet: byte count of its first byte, and its sequence. Both wrap."""

    byte_count: int
    sequence: int

    def advance(self, size: int, packets: int) -> Counters:
        """Return the counters `size` bytes and `packets` packets later."""
        return Counters(
            (self.byte_count + size) % (1 << BYTE_COUNT_BITS), (self.sequence + packets) % (1 << SEQUENCE_BITS)
        )


def encode_request(code: int, data: bytes = b"") -> bytes:
    """Encode a request to the card. Raises ProtocolError if `data` is longer than the card takes."""
    if len(data) > MAX_REQUEST_DATA:
        problem = f"request data of {len(data)} bytes is longer than {MAX_REQUEST_DATA}"
        raise ProtocolError(problem, code=ErrorCode.VALUE_INVALID)
    return _HEAD.pack(REQUEST_MAGIC, code, len(data)) + data + _FOOTER.pack(FOOTER)


def decode_reply(raw: bytes) -> Reply:
    """Decode a reply or asynchronous status. Raises ProtocolError if the bytes are not one."""
    if len(raw) == _REPLY.size:
        magic, code, status, footer = _REPLY.unpack(raw)
        if magic == REQUEST_MAGIC and footer == FOOTER:
            return Reply(code, status)
    problem = f"not a DCA1000 reply of {_REPLY.size} bytes: {len(raw)} bytes, {raw[:16].hex(' ')}"
    raise ProtocolError(problem, code=ErrorCode.MESSAGE_INVALID)


def encode_fpga_configuration(lanes: int = 4) -> bytes:
    """Encode the body of 0x03: raw mode, LVDS lanes (4: AWR2243, 2: xWR16xx/18xx/68xx), Ethernet, 16 bit, timer.

    Raises ProtocolError for another number of lanes.
    """
    if lanes not in (2, 4):
        raise ProtocolError(f"the card captures 2 or 4 LVDS lanes, not {lanes}", code=ErrorCode.VALUE_INVALID)
    lane_mode = 1 if lanes == 4 else 2
    # Raw mode, lanes, capture (not playback) over Ethernet, 16 bits, and TI's default of an unexplained timer.
    return bytes([1, lane_mode, 1, 2, 3, 30])


def encode_packet_configuration(packet_bytes: int, delay_us: float) -> bytes:
    """Encode the body of 0x0B: packet size, delay in 8 ns ticks, zero. 1470 and 25 us gives `be 05 35 0c 00 00`.

    Raises ProtocolError for a size or delay that the card does not take.
    """
    ticks = round(delay_us * DELAY_TICKS_PER_US)
    if not 0 <= ticks <= 0xFFFF:
        problem = f"packet delay of {delay_us} us is {ticks} ticks of 8 ns, outside 0..65535"
        raise ProtocolError(problem, code=ErrorCode.VALUE_INVALID)
    return struct.pack("<HHH", packet_bytes, ticks, 0)


def decode_version(status: int) -> Version:
    """Decode the FPGA version in the status of the reply to 0x0E: bits 0-6 major, 7-13 minor, 14 playback."""
    return Version(status & 0x7F, (status >> 7) & 0x7F, bool(status >> 14 & 1))


def decode_packet_header(packet: bytes | memoryview) -> tuple[int, int]:
    """Decode (sequence, byte count); the byte count is the number of payload bytes before this packet.

    Raises ProtocolError if there is no payload.
    """
    if len(packet) <= PACKET_HEADER_BYTES:
        raise ProtocolError(f"data packet of {len(packet)} bytes has no payload", code=ErrorCode.MESSAGE_INVALID)
    sequence, low, high = _PACKET.unpack_from(packet)
    return sequence, low | high << 32


# Byte ranges of a recording: the first byte of each, and the one after its last.
Gaps = Sequence[tuple[int, int]]


def view_row_words(
    payload: bytes | memoryview | NDArray[np.uint8],
    missing: Gaps,
    frames: int,
    samples: int,
    rx: int,
) -> tuple[NDArray[np.int16], NDArray[np.bool_]]:
    """Return the 16-bit words of a 4-lane recording in recorded order, without a copy, for `polysight.sync`.

    Parameters, `valid` and errors as of :func:`decode_row`; the words are int16 [frame, sample, 2, rx], I before Q,
    undefined for invalid frames.
    """
    words = _split_words(payload, frames * samples * rx * 2).reshape(frames, samples, 2, rx)
    return words, valid_frames(missing, frames, samples * rx * 4)


def encode_row_words(frames: NDArray[np.complex64]) -> NDArray[np.int16]:
    """Encode complex frames [rx, frame, sample] in ADC counts as words: int16 [frame, sample, 2, rx], I before Q."""
    rx, count, samples = frames.shape
    words = np.empty((count, samples, 2, rx), np.int16)
    for part, values in enumerate((frames.real, frames.imag)):
        np.rint(values.transpose(1, 2, 0), out=words[:, :, part], casting="unsafe")
    return words


def decode_row(
    payload: bytes | memoryview | NDArray[np.uint8],
    missing: Gaps,
    frames: int,
    samples: int,
    rx: int = 4,
    swap_iq: bool = False,
) -> tuple[NDArray[np.complex64], NDArray[np.bool_]]:
    """Decode a 4-lane recording (AWR2243, xWR12xx/14xx): per sample I of every RX, then Q of every RX.

    Parameters
    ----------
    payload
        Bytes as sent, int16 little-endian, at least frames x samples x rx x 4; more are ignored.
    missing
        Byte ranges (start, stop) that are missing.
    frames, samples, rx
        Frames of one chirp, ADC samples of a chirp, RX antennas.
    swap_iq
        True if the recording has Q first.

    Returns
    -------
    samples
        complex64 [rx, frame, sample], ADC counts; zero for frames with a missing byte.
    valid
        bool [frame], False for frames with a missing byte.

    Raises
    ------
    DataError
        if the payload is shorter than the shape requires.
    """
    words, valid = view_row_words(payload, missing, frames, samples, rx)
    out = _join_iq(words.transpose(2, 3, 0, 1), swap_iq)
    out[:, ~valid] = 0
    return out, valid


def decode_two_lane(
    payload: bytes | memoryview | NDArray[np.uint8], chirps: int, samples: int, rx: int = 4, swap_iq: bool = False
) -> NDArray[np.complex64]:
    """Decode a 2-lane recording (xWR16xx/18xx/68xx): a whole chirp of RX1, then RX2..., as I0 I1 Q0 Q1 I2 I3 Q2 Q3.

    `samples` must be even. Returns complex64 [rx, chirp, sample], ADC counts. Raises DataError as :func:`decode_row`.
    """
    if samples % 2:
        problem = f"a 2-lane chirp has an even number of samples, not {samples}"
        cause = "a wrong number of samples was given"
        raise DataError(problem, cause, "correct the samples of a chirp", code=ErrorCode.VALUE_INVALID)
    words = _split_words(payload, chirps * samples * rx * 2).reshape(chirps, rx, samples // 2, 2, 2)
    return _join_iq(words.transpose(3, 1, 0, 2, 4).reshape(2, rx, chirps, samples), swap_iq)


def _join_iq(parts: NDArray[np.int16], swap_iq: bool = False) -> NDArray[np.complex64]:
    """Join I and Q, int16 [2, rx, chirp, sample] (with `swap_iq` Q and I)."""
    joined = np.empty(parts.shape[1:], dtype=np.complex64)
    if swap_iq:
        joined.real, joined.imag = parts[::-1]
    else:
        joined.real, joined.imag = parts
    return joined


def valid_frames(missing: Gaps, frames: int, frame_bytes: int) -> NDArray[np.bool_]:
    """Return bool [frame], True if no byte of the frame is missing. `missing` as in :func:`decode_row`."""
    valid = np.ones(frames, dtype=np.bool_)
    for start, stop in missing:
        if stop > start:
            valid[start // frame_bytes : (stop - 1) // frame_bytes + 1] = False
    return valid


def _split_words(payload: bytes | memoryview | NDArray[np.uint8], count: int) -> NDArray[np.int16]:
    """Return the first `count` 16-bit words, int16 [count], without a copy. Raises DataError if there are fewer."""
    raw = np.frombuffer(payload, dtype=np.uint8)
    if raw.size < count * 2:
        raise DataError(
            f"recording of {raw.size} bytes is shorter than the {count * 2} bytes its shape needs",
            "truncated file, or wrong numbers of frames, samples or RX",
            "check the chirp and burst of the rig file the recording was made with",
            code=ErrorCode.NOT_ENOUGH_DATA,
        )
    return raw[: count * 2].view("<i2")


# --- the packets of a row ---

Bytes = NDArray[np.uint8]
Counts = NDArray[np.int64]

# Room for packets of an earlier record that arrive late: their payload lies outside the row; chosen.
_SPARE_BYTES = 1 << 20
# Largest payload that is kept, in rows. Duplicates from two network paths already double a row's payload; chosen.
_MAX_ROWS = 4


class PacketLog:
    """The packets of one row of `expected` bytes in the order of their arrival.

    `memory`, uint8, is reused for the payload if it is large enough.

    Attributes
    ----------
    count
        Packets logged.
    malformed
        Packets without payload, or longer than the card's: counted, not logged.
    payload
        uint8: payload of the first `kept` packets, one after another.
    kept
        Packets with stored payload: all, unless far more came than the row has.
    payload_bytes
        Bytes of payload received.
    """

    def __init__(self, expected: int, memory: Bytes | None = None) -> None:
        self.expected = expected
        if memory is None or memory.size < expected + _SPARE_BYTES:
            memory = np.empty(expected + _SPARE_BYTES, dtype=np.uint8)
        # Allocate the pages before the first packet.
        memory[:expected].fill(0)
        self.payload = memory
        # The arrays of headers grow when needed; this many packets (chosen) need no growth while a row is received.
        packets = 2 * expected // MAX_PAYLOAD_BYTES + 256
        self._heads = np.zeros((packets, PACKET_HEADER_BYTES), dtype=np.uint8)
        self._sizes = np.zeros(packets, dtype=np.uint16)
        self._times = np.zeros(packets, dtype=np.int64)
        self.count = 0
        self.kept = 0
        self.malformed = 0
        self.payload_bytes = 0
        # Bytes of `payload` that are in use.
        self._filled = 0

    def add(self, packets: Bytes, lengths: NDArray[np.integer], times_ns: int | Counts) -> None:
        """Log packets in the order of their arrival.

        `packets` is uint8 [n, >= longest length] with header and payload, `lengths` integer [n] bytes, `times_ns` the
        time of each one's arrival, int64 [n], or that of all; monotonic clock.
        """
        sizes = lengths.astype(np.int64) - PACKET_HEADER_BYTES
        times = np.broadcast_to(np.asarray(times_ns, dtype=np.int64), sizes.shape)
        is_well_formed = (sizes > 0) & (sizes <= MAX_PAYLOAD_BYTES)
        if not is_well_formed.all():
            self.malformed += int((~is_well_formed).sum())
            packets = packets[is_well_formed]
            sizes = sizes[is_well_formed]
            times = times[is_well_formed]
        n = len(sizes)
        if n == 0:
            return
        if self.count + n > len(self._sizes):
            self._heads = _double_capacity(self._heads, n)
            self._sizes = _double_capacity(self._sizes, n)
            self._times = _double_capacity(self._times, n)
        new = slice(self.count, self.count + n)
        self._heads[new] = packets[:, :PACKET_HEADER_BYTES]
        self._sizes[new] = sizes
        self._times[new] = times
        total = int(sizes.sum())
        if self.kept == self.count and self._make_room(total):
            self._copy(packets, sizes)
            self.kept += n
        self.count += n
        self.payload_bytes += total

    def _copy(self, packets: Bytes, sizes: Counts) -> None:
        """Append the payload of packets, in runs of one size."""
        bounds = [0, *(np.flatnonzero(np.diff(sizes)) + 1).tolist(), len(sizes)]
        for first, end in pairwise(bounds):
            size = int(sizes[first])
            target = self.payload[self._filled : self._filled + (end - first) * size].reshape(end - first, size)
            target[:] = packets[first:end, PACKET_HEADER_BYTES : PACKET_HEADER_BYTES + size]
            self._filled += target.size

    def _make_room(self, added_bytes: int) -> bool:
        """Make room for `added_bytes` bytes of payload; False if that would be more than is kept."""
        if self._filled + added_bytes <= self.payload.size:
            return True
        size = min(2 * self.payload.size + added_bytes, self.max_kept_bytes(self.expected))
        if self._filled + added_bytes > size:
            return False
        grown = np.empty(size, dtype=np.uint8)
        grown[: self._filled] = self.payload[: self._filled]
        self.payload = grown
        return True

    @staticmethod
    def max_kept_bytes(expected: int) -> int:
        """Return the largest payload that is kept of a row of `expected` bytes."""
        return _MAX_ROWS * (expected + _SPARE_BYTES)

    @property
    def arrivals_ns(self) -> Counts:
        """int64 [packet]: arrival time of each, monotonic clock."""
        return self._times[: self.count]

    @property
    def sequences(self) -> Counts:
        """int64 [packet]: the card's sequence numbers, bytes 0 to 3 of a packet's header."""
        return self._heads[: self.count, 0:4].copy().view("<u4")[:, 0].astype(np.int64)

    @property
    def byte_counts(self) -> Counts:
        """int64 [packet]: the card's byte counts, bytes 4 to 9 of a packet's header."""
        # numpy has no integer of 48 bits, so two zero bytes are added.
        eight_bytes = np.zeros((self.count, 8), dtype=np.uint8)
        eight_bytes[:, :6] = self._heads[: self.count, 4:10]
        return eight_bytes.view("<i8")[:, 0]

    @property
    def sizes(self) -> Counts:
        """int64 [packet]: bytes of payload."""
        return self._sizes[: self.count].astype(np.int64)

    @property
    def last_is_short(self) -> bool:
        """True if the last packet is smaller than the one before it: a record may have ended."""
        return self.count > 1 and bool(self._sizes[self.count - 1] < self._sizes[self.count - 2])

    @property
    def last_arrival_ns(self) -> int:
        """Arrival time of the last packet; 0 before the first."""
        if not self.count:
            return 0
        return int(self._times[self.count - 1])

    @staticmethod
    def restore(
        expected: int, sequences: Counts, byte_counts: Counts, sizes: Counts, times_ns: Counts, payload: Bytes
    ) -> PacketLog:
        """Return a log of these packets, as read from a file; arrays as of the properties, `times_ns` as arrivals."""
        log = PacketLog(0)
        log.expected = expected
        log.count = len(sizes)
        log.kept = len(sizes)
        log._heads = np.zeros((len(sizes), PACKET_HEADER_BYTES), dtype=np.uint8)
        log._heads[:, 0:4] = (sequences % (1 << SEQUENCE_BITS)).astype("<u4")[:, None].view(np.uint8)
        log._heads[:, 4:10] = (byte_counts % (1 << BYTE_COUNT_BITS)).astype("<i8")[:, None].view(np.uint8)[:, :6]
        log._sizes = sizes.astype(np.uint16)
        log._times = times_ns
        log.payload = payload
        log.payload_bytes = int(sizes.sum())
        return log


def _double_capacity(array: NDArray[Any], added_entries: int) -> NDArray[Any]:
    """Return a copy of the array with room for twice its entries plus `added_entries`, filled with zeros."""
    return np.concatenate([array, np.zeros((len(array) + added_entries, *array.shape[1:]), dtype=array.dtype)])
