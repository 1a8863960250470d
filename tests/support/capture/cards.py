"""Capture cards, simulated or with scripted answers, served by a thread of the test's process."""

import select
import socket
import struct
import threading
import time
from collections.abc import Callable, Iterable

import numpy as np

from polysight_shared.config import Board
from polysight_simulators.cards import MAC, CardEndpoint, Network
from polysight_simulators.faults import Faults
from tests.support.processes import HANG_S

LIMIT_S = 60.0
# Bytes that a streaming radar sends in each turn of the thread: about 5 MB/s.
FRAMES = np.arange(8192, dtype="<u4").view(np.uint8)
# A radar waits while its card has more unsent bytes than this.
MAX_QUEUED_BYTES = 1 << 20
# First and last word of a command's reply
HEADER = 0xA55A
FOOTER = 0xEEAA


class Cards:
    """Simulated cards, all served by one thread, with radars that send them data."""

    def __init__(self) -> None:
        self.endpoints: dict[str, CardEndpoint] = {}
        # Number of bytes that their radars stream, by card.
        self._streaming: dict[str, int] = {}
        self._tasks: list[Callable[[], None]] = []
        self._end = threading.Event()
        self._thread = threading.Thread(target=self._serve)

    def add(self, name: str, network: Network, faults: Faults, streamed_bytes: int) -> None:
        """Add a card before `start`. Its radar sends `streamed_bytes` while the card records."""
        self.endpoints[name] = CardEndpoint(
            name=name, network=network, faults=faults, seed=0, time_scale=1.0, clock_s=time.monotonic
        )
        self._streaming[name] = streamed_bytes

    @staticmethod
    def card_network(board: Board) -> Network:
        """Network settings that the card of a board has in its EEPROM."""
        return Network(board.host_address, board.card_address, MAC, board.command_port, board.data_port)

    def start(self) -> None:
        self._thread.start()

    def power_cycle(self, name: str) -> None:
        """Switch a card off and on; returns when it is done."""
        done = threading.Event()

        def switch_off_and_on() -> None:
            self.endpoints[name].power_cycle()
            done.set()

        self._tasks.append(switch_off_and_on)
        assert done.wait(HANG_S)

    def _serve(self) -> None:
        while not self._end.is_set():
            select.select(list(self.endpoints.values()), [], [], 0.005)
            while self._tasks:
                self._tasks.pop(0)()
            for name, endpoint in self.endpoints.items():
                endpoint.serve_commands()
                can_queue = endpoint.sender.queued_bytes < MAX_QUEUED_BYTES
                has_data = endpoint.counts["bytes_made"] < self._streaming[name]
                if has_data and endpoint.card.recording and can_queue:
                    endpoint.emit(endpoint.card.process_lvds(FRAMES, endpoint.wire_s()))
                endpoint.tick()
                endpoint.flush()

    def close(self) -> None:
        self._end.set()
        if self._thread.is_alive():
            self._thread.join()
        for endpoint in self.endpoints.values():
            endpoint.close()


class ScriptedCard:
    """A card that replies to each request what `answers(code, count)` returns.

    `count` is the number of requests with this code so far, 1 for the first one.
    """

    def __init__(self, board: Board, answers: Callable[[int, int], Iterable[bytes]], source_port: int = 1024) -> None:
        # Code and data of each request
        self.seen: list[tuple[int, bytes]] = []
        self._answers = answers
        self._in = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._in.bind((board.card_address, board.command_port))
        self._in.settimeout(0.02)
        self._out = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._out.bind((board.card_address, source_port))
        self.host = (board.host_address, board.command_port)
        self._end = threading.Event()
        self._thread = threading.Thread(target=self._serve, daemon=True)
        self._thread.start()

    def _serve(self) -> None:
        while not self._end.is_set():
            try:
                raw = self._in.recv(2048)
            except TimeoutError:
                continue
            # A request has the words header, code and length, its data, and the word footer.
            code = int.from_bytes(raw[2:4], "little")
            self.seen.append((code, raw[6:-2]))
            count = sum(seen_code == code for seen_code, _ in self.seen)
            for answer in self._answers(code, count):
                self._out.sendto(answer, self.host)

    def say(self, raw: bytes) -> None:
        """Send bytes to the host without a request."""
        self._out.sendto(raw, self.host)

    def close(self) -> None:
        self._end.set()
        self._thread.join()
        self._in.close()
        self._out.close()


def reply(code: int, status: int = 0) -> bytes:
    """Return a card's reply to a command."""
    return struct.pack("<4H", HEADER, code, status, FOOTER)
