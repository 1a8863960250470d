"""One simulated card and its host in one process, over real sockets, with a clock that the test moves."""

from __future__ import annotations

import socket
import struct
from contextlib import ExitStack
from typing import Any

from polysight_shared.config import Instrument
from polysight_simulators.cards import SimulatedCard, StageTrack, bound_udp
from polysight_simulators.faults import read_faults
from polysight_simulators.scene import PatternSource, pattern_frames

FRAME = 4096
PERIOD_NS = 1_500_000
ALIVE = (0x09, b"")
CONFIGURE = (0x03, bytes.fromhex("01010102031e"))
EEPROM = 0x04
START = (0x05, b"")


class Bench:
    """One card and its host, in one process, on one clock."""

    def __init__(self, rig: Instrument, sockets: ExitStack, seed: int = 1, **faults: Any) -> None:
        self.now = 0.0
        self.board = rig.by_name("RH")
        self.index = rig.boards.index(self.board)
        self.commands = sockets.enter_context(bound_udp(self.board.host_address, self.board.command_port))
        self.data = sockets.enter_context(bound_udp(self.board.host_address, self.board.data_port))
        self.data.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4 << 20)
        for s in (self.commands, self.data):
            s.setblocking(False)
        self.track = StageTrack(rig)
        settings = [f"{key}={value!r}" for key, value in faults.items()]  # as from the command line
        table = read_faults(None, settings, ("RH",))["RH"]
        self.card = SimulatedCard(
            rig=rig,
            board=self.board,
            source=PatternSource(rig),
            faults=table,
            seed=seed,
            time_scale=1.0,
            clock_s=lambda: self.now,
            wait_for_receiver=False,
        )
        sockets.callback(self.card.close)
        self.pulse = 0

    def request(self, code: int, body: bytes = b"") -> list[bytes]:
        """Send a request; return all replies."""
        datagram = struct.pack("<HHH", 0xA55A, code, len(body)) + body + b"\xaa\xee"
        network = self.card.card.network
        self.commands.sendto(datagram, (network.card_address, network.command_port))
        self.card.endpoint.serve_commands()
        return self.messages()

    def messages(self) -> list[bytes]:
        while self.card.endpoint.flush() is not None:
            if not self.card.endpoint.sender.queued_bytes:
                break
            self.now += 1e-3
        return [m[2:6] for m in self._all(self.commands)]

    def packets(self) -> list[bytes]:
        self.messages()
        return self._all(self.data)

    def _all(self, s: socket.socket) -> list[bytes]:
        got = []
        while True:
            try:
                got.append(s.recv(4096))
            except BlockingIOError:
                return got

    def pulses(self, n: int) -> None:
        """n pulses 1.5 ms apart, in calls of different sizes."""
        while n:
            some = min(n, 1 + self.pulse % 7)
            self.card.pulses([(self.pulse + i) * PERIOD_NS for i in range(some)], self.track)
            self.pulse = self.pulse + some
            n = n - some

    def record(self, pulses: int) -> None:
        """Start a record, send pulses and wait for its end."""
        self.request(*START)
        self.pulses(pulses)
        self.end()

    def end(self) -> None:
        self.now += 2.001
        self.card.tick(False)

    def pattern(self, first: int, n: int) -> bytes:
        return pattern_frames(self.index, first, n, 256).tobytes()

    @property
    def counts(self) -> dict[str, int | None]:
        return self.card.report()


def reply(code: int, status: int = 0) -> bytes:
    return struct.pack("<HH", code, status)


def payload(packets: list[bytes]) -> bytes:
    return b"".join(p[10:] for p in packets)
