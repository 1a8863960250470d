"""A capture card that keeps a row's last short packet for a while, as the real one does, or until the record's stop."""

from __future__ import annotations

import struct
import threading
import time

from polysight.shared.config import Board

from .conftest import FULL, FakeCard, payload_of

TAIL_S = 0.6  # from the last data; 2 s of a real card


class LateCard(FakeCard):
    """Sends full packets at once; the rest and the status `TAIL_S` later, or `lag_s` after the reply to a stop."""

    def __init__(self, board: Board, row_bytes: int, lag_s: float) -> None:
        self._lag_s, self._record = lag_s, 0  # number of the record
        self._tail: tuple[int, bytes] | None = None  # of which record, and what
        self._lock = threading.Lock()
        self.cut: dict[tuple[int, int], int] = {}  # (row, take): so many bytes are all that come
        super().__init__(board, row_bytes)

    def send_row(self, row: int, take: int) -> None:
        if not self.recording:
            return
        data = payload_of(self.board.name, row, self.row_bytes)[: self.cut.get((row, take), self.row_bytes)]
        whole = len(data) // FULL * FULL
        for a in range(0, whole, FULL):
            self._rest = data[a : a + FULL]
            self._send_packet(FULL)
        self._tail = self._record, data[whole:]
        threading.Timer(TAIL_S, self._finish, [self._record]).start()

    def _finish(self, record: int) -> None:
        with self._lock:
            if self._tail is None or self._tail[0] != record:
                return
            self._rest, self._tail = self._tail[1], None
            self.recording = False
            self.end_frames()

    def _serve(self) -> None:
        while not self._stop.is_set():
            try:
                raw, sender = self.commands.recvfrom(2048)
            except TimeoutError:
                continue
            code = struct.unpack_from("<H", raw, 2)[0]
            if code == 5:
                self.recording, self._record = True, self._record + 1
            self.out.sendto(struct.pack("<HHHH", 0xA55A, code, 0x0402 if code == 0x0E else 0, 0xEEAA), sender)
            if code == 6 and self.recording:
                time.sleep(self._lag_s)
                self._finish(self._record)
                self.recording = False
