"""Capture cards that only answer commands and send made-up rows, over UDP on loopback."""

import functools
import socket
import struct
import threading

import numpy as np

from polysight_shared.config import Board
from tests.support.capture.records import FULL, encode_packet


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
        self.out.bind((board.card_address, 1024))
        # Counters of the next packet: its number, and the bytes before it.
        self.sequence = 1
        self.count = 0
        self.recording = False
        # Set by tests: commands get no reply; rows send no data.
        self.mute = False
        self.silent_data = False
        # Codes of all commands.
        self.codes_received: list[int] = []
        # Faults by (row, take): numbers of the packets that are lost, and bytes that the record lacks at its end, as if
        # the radar had missed triggers.
        self.drop: dict[tuple[int, int], set[int]] = {}
        self.short: dict[tuple[int, int], int] = {}
        # Pulses that the radar missed, for rows that are sent frame by frame.
        self.missed: dict[tuple[int, int], set[int]] = {}
        # Before this pulse the radar takes a spurious edge for a pulse: all later frames come one too early.
        self.extra: dict[tuple[int, int], int] = {}
        # Of rows that are sent frame by frame: bytes of the record so far, and when they would arrive.
        self.arrivals_ns: dict[int, int] = {}
        self._record_bytes = 0
        # Bytes that do not fill a packet yet.
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
            code = struct.unpack_from("<H", raw, 2)[0]
            self.codes_received.append(code)
            if not self.mute:
                self._command(code, sender)

    def _command(self, code: int, sender: tuple[str, int]) -> None:
        """Execute a command and reply (docs/spec/dca1000.md: 1 reset, 5 record start, 6 record stop, 0x0E version)."""
        self.recording = {1: False, 5: True, 6: False}.get(code, self.recording)
        if code == 5:
            self.arrivals_ns = {}
            self._record_bytes = 0
        # A reset begins the counters again.
        if code == 1:
            self.sequence = 1
            self.count = 0
            self._rest = b""
        self.out.sendto(struct.pack("<HHHH", 0xA55A, code, 0x0402 if code == 0x0E else 0, 0xEEAA), sender)

    def report_status(self, bits: int = 0x0100) -> None:
        """Send an asynchronous status, by default that the record is completed."""
        status = struct.pack("<HHHH", 0xA55A, 0x0A, bits, 0xEEAA)
        self.out.sendto(status, (self.board.host_address, self.board.command_port))

    def send_frame(self, row: int, take: int, slot: int, frame_bytes: int, arrival_ns: int) -> None:
        """Send the frame of one pulse, unless the radar missed it; packets are sent when they are full."""
        self._arrival_ns = arrival_ns
        extra = self.extra.get((row, take))
        last = slot == self.row_bytes // frame_bytes - 1
        if slot == extra:
            self._rest += bytes(frame_bytes)
        if slot not in self.missed.get((row, take), ()) and not (last and extra is not None):
            data = make_payload(self.board.name, row, self.row_bytes)
            self._rest += data[slot * frame_bytes : (slot + 1) * frame_bytes]
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
        data = data[: len(data) - self.short.get((row, take), 0)]
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
