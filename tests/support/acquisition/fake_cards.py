"""Fake capture cards, which answer commands and send made-up rows over UDP on the loopback network."""

import functools
import socket
import struct
import threading

import numpy as np

from polysight.capture.dca1000 import Code, Status
from polysight_shared.config import Board
from tests.support.capture.records import FULL, encode_packet

# Source port of the card's data, and the card's commands (docs/spec/dca1000.md).
CARD_PORT = 1024
HEADER = 0xA55A
FOOTER = 0xEEAA
# Version 2.8 of the card's FPGA: the major number in bits 0 to 6, the minor one in bits 7 to 13.
CARD_VERSION = 0x0402


@functools.cache
def make_payload(board: str, row: int, size: int) -> bytes:
    """Return the bytes that the card of this board sends in a row, the same in every take."""
    seed = sum(board.encode()) * 1000 + row
    return np.random.default_rng(seed).integers(0, 256, size, dtype=np.uint8).tobytes()


class FakeCard:
    """Answers commands from source port 1024 and sends a row on demand; its counters continue from record to record."""

    def __init__(self, board: Board, row_bytes: int) -> None:
        self.board = board
        self.row_bytes = row_bytes
        self.commands = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.commands.bind((board.card_address, board.command_port))
        self.commands.settimeout(0.05)
        self.out = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.out.bind((board.card_address, CARD_PORT))
        # Counters of the next packet: its number, and the bytes before it.
        self.sequence = 1
        self.count = 0
        self.recording = False
        # Set by tests: commands get no reply; rows send no data.
        self.mute = False
        self.silent_data = False
        # Codes of all commands.
        self.codes_received: list[int] = []
        # Faults by (row, take), set by tests. Numbers (from 0) of the packets that are lost:
        self.drop: dict[tuple[int, int], set[int]] = {}
        # Bytes that the record lacks at its end, as if the radar had missed triggers:
        self.missing_end_bytes: dict[tuple[int, int], int] = {}
        # Numbers of the pulses that the radar misses, in rows that are sent frame by frame:
        self.missed: dict[tuple[int, int], set[int]] = {}
        # Number of the pulse before which the radar takes a spurious edge for a pulse, so that all later frames come
        # one too early:
        self.extra: dict[tuple[int, int], int] = {}
        # In rows that are sent frame by frame: the time at which a packet would arrive, by the bytes of the record up
        # to its end.
        self.arrivals_ns: dict[int, int] = {}
        self._record_bytes = 0
        # Bytes that do not fill a packet yet
        self._rest = b""
        self._arrival_ns = 0
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._serve, daemon=True)
        self._thread.start()

    def _serve(self) -> None:
        while not self._stop.is_set():
            try:
                raw, sender = self.commands.recvfrom(2048)
            except TimeoutError:
                continue
            # The second of 16-bit words
            (code,) = struct.unpack_from("<H", raw, 2)
            self.codes_received.append(code)
            if not self.mute:
                self._command(code, sender)

    def _command(self, code: int, sender: tuple[str, int]) -> None:
        """Execute a command and reply with status 0, or with the version."""
        if code in (Code.RESET_FPGA, Code.RECORD_STOP):
            self.recording = False
        if code == Code.RECORD_START:
            self.recording = True
            self.arrivals_ns = {}
            self._record_bytes = 0
        # A reset starts the counters again.
        if code == Code.RESET_FPGA:
            self.sequence = 1
            self.count = 0
            self._rest = b""
        status = CARD_VERSION if code == Code.VERSION else 0
        self.out.sendto(struct.pack("<HHHH", HEADER, code, status, FOOTER), sender)

    def report_status(self, bits: int = Status.RECORD_COMPLETED) -> None:
        """Send an asynchronous status, by default that the record is completed."""
        status = struct.pack("<HHHH", HEADER, Code.STATUS, bits, FOOTER)
        self.out.sendto(status, (self.board.host_address, self.board.command_port))

    def send_frame(self, row: int, take: int, slot: int, frame_bytes: int, arrival_ns: int) -> None:
        """Send the frame of one pulse, unless the radar missed it; packets are sent when they are full.

        `slot` is the number of the pulse in the row. After a spurious edge the record is full before the last pulse,
        which gets no frame.
        """
        self._arrival_ns = arrival_ns
        slot_of_extra = self.extra.get((row, take))
        if slot == slot_of_extra:
            self._rest += bytes(frame_bytes)
        is_last = slot == self.row_bytes // frame_bytes - 1
        is_crowded_out = is_last and slot_of_extra is not None
        is_missed = slot in self.missed.get((row, take), ())
        if not is_missed and not is_crowded_out:
            data = make_payload(self.board.name, row, self.row_bytes)
            start = slot * frame_bytes
            self._rest += data[start : start + frame_bytes]
        while len(self._rest) >= FULL:
            self._send_packet(FULL)

    def end_frames(self) -> None:
        """Send the short last packet and the status."""
        self._send_packet(len(self._rest))
        self.report_status()

    def _send_packet(self, size: int) -> None:
        """Send up to `size` of the waiting bytes as a packet, and note when they would arrive."""
        body = self._rest[:size]
        self._rest = self._rest[size:]
        if body:
            packet = encode_packet(self.sequence, self.count, body)
            self.out.sendto(packet, (self.board.host_address, self.board.data_port))
            self.sequence += 1
            self.count += len(body)
            self._record_bytes += len(body)
            self.arrivals_ns[self._record_bytes] = self._arrival_ns

    def send_row(self, row: int, take: int) -> None:
        """Send all of a row with the faults of this take, then the status that the record is completed."""
        if not self.recording or self.silent_data:
            return
        data = make_payload(self.board.name, row, self.row_bytes)
        data = data[: len(data) - self.missing_end_bytes.get((row, take), 0)]
        destination = (self.board.host_address, self.board.data_port)
        for k, start in enumerate(range(0, len(data), FULL)):
            body = data[start : start + FULL]
            if k not in self.drop.get((row, take), ()):
                self.out.sendto(encode_packet(self.sequence, self.count, body), destination)
            self.sequence += 1
            self.count += len(body)
        self.report_status()

    def close(self) -> None:
        self._stop.set()
        self._thread.join()
        self.commands.close()
        self.out.close()
