"""Simulated capture cards on a loopback subnet of their own."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest
import tomli_w
from tests.support.capture.cards import Cards, ScriptedCard
from tests.support.rigs import rig_with

from polysight.capture.card import CardClient
from polysight_shared.config import Board, Instrument
from polysight_shared.tables import to_builtins
from polysight_simulators.faults import Faults
from polysight_simulators.loopback import move_to_free_subnet


def small_rig() -> Instrument:
    """A free subnet, a grid whose rows are small, and little patience."""
    grid = {"columns": 12, "rows": 2}
    card = {"receive_buffer_bytes": 1 << 20}
    return move_to_free_subnet(rig_with(grid=grid, limits={"command_timeout_s": 1.5}, card=card))


@pytest.fixture
def rig(tmp_path: Path) -> Instrument:
    small = small_rig()
    (tmp_path / "instrument.toml").write_text(tomli_w.dumps(to_builtins(small)))
    return small


@pytest.fixture
def board(rig: Instrument) -> Board:
    """A receiving board whose card and host have addresses that nobody else uses."""
    return rig.by_role("receive_h")


@pytest.fixture
def cards(rig: Instrument) -> Iterator[Callable[..., Cards]]:
    """Starts cards of the named boards (or of other boards given whole)."""
    with ExitStack() as stack:

        def start(*names: str, streams: bool = False, more: tuple[Board, ...] = (), **faults: Faults) -> Cards:
            cards = Cards()
            stack.callback(cards.close)
            for board in (*(rig.by_name(n) for n in names), *more):
                cards.add(board.name, cards.card_network(board), faults.get(board.name, Faults()), streams=streams)
            cards.start()
            return cards

        yield start


@pytest.fixture
def scripted_card(rig: Instrument) -> Iterator[Callable[..., tuple[CardClient, ScriptedCard]]]:
    """Makes a client and a card with scripted answers, of board RV."""
    board = rig.by_name("RV")
    with ExitStack() as stack:

        def make(answers, timeout_s: float = 30.0, source_port: int = 1024) -> tuple[CardClient, ScriptedCard]:
            card = ScriptedCard(board, answers, source_port)
            stack.callback(card.close)
            return stack.enter_context(CardClient(board, timeout_s)), card

        yield make
