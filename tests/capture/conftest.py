"""Simulated capture cards on a loopback subnet of their own."""

from collections import Counter
from collections.abc import Callable, Collection, Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest
import tomli_w
from tests.support.capture.cards import Cards, ScriptedCard
from tests.support.processes import HANG_S
from tests.support.rigs import make_rig_with

from polysight.capture.card import CardClient
from polysight.capture.dca1000 import Code, Reply
from polysight_shared.config import Board, Instrument
from polysight_shared.tables import to_builtins
from polysight_simulators.faults import Faults
from polysight_simulators.loopback import move_to_free_subnet


def make_small_rig() -> Instrument:
    """Return a rig on a free subnet whose rows fit into the receive buffer, with a timeout that no test reaches."""
    grid = {"columns": 12, "rows": 2}
    card = {"receive_buffer_bytes": 1 << 20}
    return move_to_free_subnet(make_rig_with(grid=grid, limits={"command_timeout_s": HANG_S}, card=card))


@pytest.fixture
def rig(tmp_path: Path) -> Instrument:
    """A small rig; its file is `tmp_path / "instrument.toml"`."""
    small = make_small_rig()
    (tmp_path / "instrument.toml").write_text(tomli_w.dumps(to_builtins(small)))
    return small


@pytest.fixture
def board(rig: Instrument) -> Board:
    """A receiving board whose card and host have unused addresses."""
    return rig.by_role("receive_h")


@pytest.fixture
def cards(rig: Instrument) -> Iterator[Callable[..., Cards]]:
    """Function that starts cards of boards by name, and of the boards in `more`."""
    with ExitStack() as stack:

        def start(*names: str, streamed_bytes: int = 0, more: tuple[Board, ...] = (), **faults: Faults) -> Cards:
            cards = Cards()
            stack.callback(cards.close)
            for board in (*(rig.by_name(n) for n in names), *more):
                cards.add(board.name, cards.card_network(board), faults.get(board.name, Faults()), streamed_bytes)
            cards.start()
            return cards

        yield start


@pytest.fixture
def scripted_card(rig: Instrument) -> Iterator[Callable[..., tuple[CardClient, ScriptedCard]]]:
    """Function that makes a client of board RV and a card with scripted answers.

    An attempt times out only if it is in `unanswered` (code and count, as for the answers). Others never time out.
    """
    board = rig.by_name("RV")
    with ExitStack() as stack:

        def make(
            answers, source_port: int = 1024, unanswered: Collection[tuple[Code, int]] = ()
        ) -> tuple[CardClient, ScriptedCard]:
            sent: Counter[Code] = Counter()

            class Client(CardClient):
                """A client that does not wait for answers that do not come."""

                def _try(self, code: Code, data: bytes, limit_s: float) -> Reply | None:
                    sent[code] += 1
                    if (code, sent[code]) in unanswered:
                        limit_s = 0.0
                    return super()._try(code, data, limit_s)

            def answer_unless_lost(code: Code, n: int):
                if (code, n) in unanswered:
                    return []
                return answers(code, n)

            card = ScriptedCard(board, answer_unless_lost, source_port)
            stack.callback(card.close)
            return stack.enter_context(Client(board, 3 * HANG_S)), card

        yield make
