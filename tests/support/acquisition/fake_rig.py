"""A fake Pi with fake capture cards on a loopback subnet of their own."""

from __future__ import annotations

from dataclasses import dataclass, field

from polysight.shared.config import Instrument
from polysight.simulators.loopback import on_free_subnet
from tests.support.acquisition.fake_cards import FakeCard
from tests.support.acquisition.fake_pi import FakePi
from tests.support.rigs import rig_with


@dataclass
class FakeRig:
    instrument: Instrument
    cards: dict[str, FakeCard] = field(default_factory=dict)
    pi: FakePi | None = None

    def start(self) -> None:
        for board in self.instrument.recorded:
            self.cards[board.name] = FakeCard(board, self.instrument.row_bytes)
        self.start_pi()

    def start_pi(self) -> None:
        journal = self.pi.journal if self.pi else {}
        self.pi = FakePi(self.instrument, list(self.cards.values()))
        self.pi.journal = journal

    def close(self) -> None:
        for card in self.cards.values():
            card.close()
        if self.pi is not None:
            self.pi.close()


def small_instrument(**limits: float) -> Instrument:
    """The published rig with a grid of 3 x 4 points and 3 pulses, on a loopback subnet that is free."""
    limits = {"end_of_record_s": 0.25, "command_timeout_s": 1.5, "free_disk_bytes": 0, **limits}
    card = {"receive_buffer_bytes": 1 << 20}
    return on_free_subnet(rig_with(grid={"columns": 3, "rows": 4}, burst={"pulses": 3}, limits=limits, card=card))
