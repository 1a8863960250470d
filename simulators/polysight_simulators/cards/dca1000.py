"""State machine of one DCA1000EVM capture card: commands in, replies and data packets out, without sockets or clocks.

docs/spec/simulated-rig.md lists the modelled behaviour: "seen" in a capture of a real card, "read" in documents,
or "inferred" where neither shows it. Times are in seconds of any one clock of the caller.
"""

from __future__ import annotations

import struct
from enum import IntEnum, IntFlag
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from polysight_shared.errors import ProtocolError

# First and last word of a request and of a reply (docs/spec/dca1000.md).
REQUEST_HEADER = 0xA55A
REQUEST_FOOTER = 0xEEAA
# Port from which replies and data come, as seen on a card.
SOURCE_PORT = 1024
# Header of a data packet: u32 sequence number, u48 byte count.
DATA_HEADER_BYTES = 10
# The size of a packet that command 0x0B sets is larger than the packet's payload: 1470 gives 1456 bytes (seen).
PACKET_OVERHEAD_BYTES = 14
# Time from the last LVDS data to the short last packet, as seen on a card.
TAIL_S = 2.0
# Version 2.8 (seen): the major number is in bits 0 to 6, the minor one in bits 7 to 13.
FPGA_VERSION = 2 + (8 << 7)
# Unit in which the card counts the delay between packets (command 0x0B).
DELAY_TICK_S = 8e-9
# Timeout after record start without data, until command 0x03 sets another.
TIMER_S = 30
# Smallest (inferred) and largest size of a packet, as command 0x0B counts it.
_MIN_PACKET = 48
_MAX_PACKET = 1470
# Bytes of command 0x03: five settings, whose smallest value is 1, and the timer in seconds.
_LARGEST_SETTINGS = (2, 2, 2, 2, 3)
# The settings that suit the radar: raw mode, four LVDS lanes, capture, Ethernet, 16 bits. A card that is set up for two
# lanes records nothing.
_SETTINGS_OF_RADAR = (1, 1, 1, 2, 3)

Bytes2D = NDArray[np.uint8]


class Code(IntEnum):
    """Command codes."""

    RESET_FPGA = 0x01
    RESET_RADAR = 0x02
    CONFIGURE_FPGA = 0x03
    EEPROM = 0x04
    RECORD_START = 0x05
    RECORD_STOP = 0x06
    ALIVE = 0x09
    STATUS = 0x0A
    CONFIGURE_PACKET = 0x0B
    FPGA_VERSION = 0x0E


class Status(IntFlag):
    """Bits of the asynchronous status 0x0A that this card sends."""

    NO_LVDS_DATA = 1 << 0
    RECORD_COMPLETED = 1 << 8
    LVDS_BUFFER_FULL = 1 << 9


class Network(NamedTuple):
    """Addresses in the card's EEPROM, active from the next power-up."""

    host_address: str
    card_address: str
    mac: bytes
    command_port: int
    data_port: int

    @staticmethod
    def decode(body: bytes) -> Network:
        """Parse the 18 bytes of command 0x04, with the last byte of each address first.

        Raises ProtocolError for other sizes.
        """
        if len(body) != 18:
            raise ProtocolError(f"EEPROM body of {len(body)} bytes, expected 18")
        host = body[0:4][::-1]
        card = body[4:8][::-1]
        mac = body[8:14][::-1]
        command_port, data_port = struct.unpack("<HH", body[14:])
        return Network(".".join(map(str, host)), ".".join(map(str, card)), mac, command_port, data_port)


class Message(NamedTuple):
    """Eight bytes from the card to the host's command port."""

    payload: bytes


class Packets(NamedTuple):
    """Data packets, uint8 [packet, header and payload], from the card to the host's data port."""

    rows: Bytes2D

    @property
    def payload_bytes(self) -> int:
        """Number of bytes of LVDS data."""
        return self.rows.size - DATA_HEADER_BYTES * len(self.rows)


Output = Message | Packets


def make_message(code: int, status: int) -> Message:
    """Return a reply, or with code 0x0A an asynchronous status."""
    return Message(struct.pack("<HHHH", REQUEST_HEADER, code, status, REQUEST_FOOTER))


def parse_request(datagram: bytes) -> tuple[int, bytes, bool] | None:
    """Return code, body, and True if size and footer are right; None if the header is not a request's."""
    if len(datagram) < 8:
        return None
    header, code, size = struct.unpack_from("<HHH", datagram)
    if header != REQUEST_HEADER:
        return None
    body = datagram[6:-2]
    return code, body, size == len(body) and datagram[-2:] == REQUEST_FOOTER.to_bytes(2, "little")


class Packetiser:
    """Cuts the LVDS byte stream into data packets with sequence number and byte count.

    Parameters
    ----------
    payload_bytes
        Payload of a full packet.
    sequence
        Sequence number of the first packet (a card fresh from reset starts at 1).
    byte_count
        Byte count of the first packet: payload bytes sent before it.
    """

    def __init__(
        self, payload_bytes: int = _MAX_PACKET - PACKET_OVERHEAD_BYTES, sequence: int = 1, byte_count: int = 0
    ):
        self.payload_bytes = payload_bytes
        self.sequence = sequence
        self.byte_count = byte_count
        self._rest = np.empty(0, np.uint8)

    def feed(self, lvds: NDArray[np.generic]) -> Bytes2D:
        """Return the packets that the stream now fills, uint8 [n, 10 + payload]; keep the rest."""
        fresh = np.ascontiguousarray(lvds).view(np.uint8).reshape(-1)
        stream = np.concatenate([self._rest, fresh])
        n = len(stream) // self.payload_bytes
        used_bytes = n * self.payload_bytes
        self._rest = stream[used_bytes:].copy()
        return self._pack(stream[:used_bytes].reshape(n, self.payload_bytes))

    def flush(self) -> Bytes2D:
        """Return the short last packet, [1, 10 + rest]; [0, 10] if nothing is left."""
        waiting_bytes = self._rest
        self._rest = np.empty(0, np.uint8)
        return self._pack(waiting_bytes.reshape(1 if len(waiting_bytes) else 0, len(waiting_bytes)))

    def _pack(self, payload: Bytes2D) -> Bytes2D:
        """Put headers before payloads, uint8 [n, size], and advance the counters."""
        n, size = payload.shape
        k = np.arange(n, dtype=np.uint64)
        rows = np.empty((n, DATA_HEADER_BYTES + size), np.uint8)
        sequence = (np.uint64(self.sequence) + k) & np.uint64(0xFFFF_FFFF)
        count = (np.uint64(self.byte_count) + k * np.uint64(size)) & np.uint64((1 << 48) - 1)
        rows[:, :4] = sequence.astype("<u4").view(np.uint8).reshape(n, 4)
        rows[:, 4:DATA_HEADER_BYTES] = count.astype("<u8").view(np.uint8).reshape(n, 8)[:, :6]
        rows[:, DATA_HEADER_BYTES:] = payload
        self.sequence = (self.sequence + n) % (1 << 32)
        self.byte_count = (self.byte_count + n * size) % (1 << 48)
        return rows


class Card:
    """One card, from power-up on.

    Parameters
    ----------
    network
        Content of its EEPROM.
    sequence, byte_count
        Counters at power-up.
    no_data_floor_s
        Shortest timeout after record start without LVDS data; the timer of command 0x03 applies if it is longer.
    """

    def __init__(
        self,
        network: Network,
        sequence: int = 1,
        byte_count: int = 0,
        no_data_floor_s: float = 0.0,
    ) -> None:
        self.network = network
        # Number of records begun.
        self.records = 0
        self._eeprom = network
        self._no_data_floor_s = no_data_floor_s
        self._power_up(sequence, byte_count)

    def _power_up(self, sequence: int, byte_count: int) -> None:
        """Reset to the state at power-up, with these counters."""
        self._packetiser = Packetiser(sequence=sequence, byte_count=byte_count)
        self._suits_radar = True
        self._timer_s = TIMER_S
        self._recording = False
        self._last_data_s: float | None = None
        self._started_s = 0.0
        self.packet_delay_s = 0.0

    def power_cycle(self) -> None:
        """Switch off and on: activate the EEPROM's addresses, reset everything else."""
        self.network = self._eeprom
        self._power_up(sequence=1, byte_count=0)

    def reset_fpga(self) -> None:
        """Reset everything but the addresses. A record ends without its last packet and without a status."""
        self._power_up(sequence=1, byte_count=0)

    @property
    def recording(self) -> bool:
        """True between record start and the end of the record."""
        return self._recording

    @property
    def packet_bytes(self) -> int:
        """Bytes of a full data packet as UDP payload, header included."""
        return DATA_HEADER_BYTES + self._packetiser.payload_bytes

    @property
    def deadline_s(self) -> float | None:
        """Time at which :meth:`tick` ends the record if no LVDS data comes; None without a record."""
        if not self._recording:
            return None
        if self._last_data_s is None:
            return self._started_s + max(float(self._timer_s), self._no_data_floor_s)
        return self._last_data_s + TAIL_S

    def command(self, datagram: bytes, now_s: float) -> list[Output]:
        """Execute one request and return the card's answers, in order; [] if it is not a request."""
        request = parse_request(datagram)
        if request is None:
            return []
        code, body, well_formed = request
        if code == Code.RECORD_START:
            if not self._recording:
                self._recording = True
                self._last_data_s = None
                self._started_s = now_s
                self.records += 1
            return [make_message(code, 0)]
        if code == Code.RECORD_STOP:
            if not self._recording:
                return [make_message(code, 0)]
            return [make_message(code, 0), *self._end(Status.RECORD_COMPLETED)]
        return [make_message(code, self._configure(code, body, well_formed))]

    def _configure(self, code: int, body: bytes, well_formed: bool) -> int:
        """Execute a request other than record start and stop; return the status of its reply.

        The status is 0 for done and 1 for refused, or it is the version that was asked for.
        """
        if code == Code.RESET_FPGA:
            self.reset_fpga()
        elif code == Code.CONFIGURE_FPGA:
            # The card also answers bodies of wrong length or content (seen).
            if well_formed and len(body) == 6:
                settings = tuple(body[:5])
                timer_s = body[5]
                if all(1 <= setting <= n for setting, n in zip(settings, _LARGEST_SETTINGS, strict=True)):
                    self._suits_radar = settings == _SETTINGS_OF_RADAR
                    self._timer_s = timer_s
        elif code == Code.CONFIGURE_PACKET:
            if well_formed and len(body) == 6:
                size, ticks, _ = struct.unpack("<HHH", body)
                if size < _MIN_PACKET:
                    return 1
                # mmWave Studio and most clients set 1472: the card replies "done" and sends 1456 bytes, the payload of
                # 1470 (read).
                self._packetiser.payload_bytes = min(size, _MAX_PACKET) - PACKET_OVERHEAD_BYTES
                self.packet_delay_s = ticks * DELAY_TICK_S
        elif code == Code.EEPROM:
            if not well_formed or len(body) != 18:
                return 1
            self._eeprom = Network.decode(body)
        elif code == Code.FPGA_VERSION:
            return FPGA_VERSION
        elif code not in (Code.RESET_RADAR, Code.ALIVE, Code.STATUS):
            return 1
        return 0

    def process_lvds(self, data: NDArray[np.generic], now_s: float) -> list[Output]:
        """Process LVDS data of the radar; return the packets it fills, [] without a record or if wrongly configured."""
        if not self._recording or not self._suits_radar:
            return []
        self._last_data_s = now_s
        rows = self._packetiser.feed(data)
        if not len(rows):
            return []
        return [Packets(rows)]

    def overflow(self) -> list[Output]:
        """Report LVDS data lost before packetising, which leaves no gap in the sequence numbers."""
        if not self._recording:
            return []
        return [make_message(Code.STATUS, Status.LVDS_BUFFER_FULL)]

    def tick(self, now_s: float) -> list[Output]:
        """End the record if :attr:`deadline_s` has passed: the short last packet, then the status."""
        deadline = self.deadline_s
        if deadline is None or now_s < deadline:
            return []
        return self._end(Status.NO_LVDS_DATA if self._last_data_s is None else Status.RECORD_COMPLETED)

    def _end(self, status: Status) -> list[Output]:
        """End the record; return the short last packet, if any, and the status."""
        self._recording = False
        tail = self._packetiser.flush()
        output: list[Output] = []
        if len(tail):
            output.append(Packets(tail))
        output.append(make_message(Code.STATUS, status))
        return output
