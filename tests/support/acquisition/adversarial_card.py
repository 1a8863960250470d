"""A card on loopback whose records go through the troubles of the simulators' adversary."""

from __future__ import annotations

import random
import time

from polysight.shared.config import Board
from polysight.simulators.cards import KINDS, Adversary, Arrival
from tests.support.acquisition.fake_cards import FakeCard, payload_of

NETWORK = tuple(kind for kind in KINDS if kind != "clock")  # the kernel's clock is its own


class AdversarialCard(FakeCard):
    """Sends rows through drawn troubles; what is late comes before, between or behind the packets of later rows."""

    def __init__(self, board: Board, row_bytes: int, frame_bytes: int, chance: random.Random) -> None:
        self._chance, self._frame = chance, frame_bytes
        self.rate = 0.5  # of records with troubles
        self.adversary = Adversary(chance, frame_bytes)
        self.sent: list[tuple[int, int, tuple[str, ...]]] = []
        super().__init__(board, row_bytes)

    def send_row(self, row: int, take: int) -> None:
        if not self.recording:
            return
        troubled = self._chance.random() < self.rate
        troubles = tuple(self._chance.sample(NETWORK, self._chance.randint(1, 3))) if troubled else ()
        sent = self.adversary.record(
            self.row_bytes // self._frame, troubles, payload_of(self.board.name, row, self.row_bytes)
        )
        self.sent.append((row, take, troubles))
        self._send(sent.arrivals)
        self.report_status()

    def _send(self, arrivals: list[Arrival]) -> None:
        for k, arrival in enumerate(arrivals):
            if k % 100 == 99:
                time.sleep(0.002)
            self.out.sendto(arrival.packet, (self.board.host_address, self.board.data_port))

    def _command(self, code: int, sender: tuple[str, int]) -> None:
        super()._command(code, sender)
        if code in (5, 6):  # before the row runs; after its stop
            self._send(self.adversary.take_late(0.3))
