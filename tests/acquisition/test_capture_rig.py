"""A `CaptureRig` resets and stops its cards once, and waits for the end of their records no longer than its limit."""

from types import SimpleNamespace
from typing import Any

import msgspec
import pytest
from tests.support.acquisition.fake_rig import make_small_instrument

from polysight.acquisition import capture_rig
from polysight.acquisition.capture_rig import CaptureRig
from polysight.capture import Status
from polysight_shared.closing import Closing
from polysight_shared.config import CARD_TAIL_S


class Card(Closing):
    """A card that records its commands and the limits of its waits; each wait takes `waits_s`."""

    def __init__(self, board: Any, _: float) -> None:
        self.board = board
        self.mac = ""
        self.commands: list[str] = []
        self.limits_s: list[float] = []
        self.waits_s = 0.0

    def reset_fpga(self) -> None:
        self.commands.append("reset")

    def check_alive(self) -> None: ...

    def configure(self, _: Any) -> None:
        self.commands.append("configure")

    def read_version(self) -> tuple[int, int]:
        return (1, 0)

    def record_start(self) -> None:
        self.commands.append("start")

    def record_stop(self) -> None:
        self.commands.append("stop")

    def wait_completed(self, limit_s: float) -> None:
        self.limits_s.append(limit_s)
        CLOCK.now += self.waits_s

    def take_status(self) -> Status:
        no_bit_set = Status(0)
        return no_bit_set

    def close(self) -> None: ...


class Receiver(Closing):
    """A receiver of a row that is complete or not."""

    def __init__(self, *_: Any) -> None:
        self.warnings: list[str] = []
        self.granted_bytes = 1 << 30
        self.is_complete = False

    def begin_row(self, *_: Any, **__: Any) -> None: ...

    def poll(self) -> Any:
        return SimpleNamespace(complete=self.is_complete)

    def end_row(self, *_: Any) -> Any:
        return Row()

    def close(self) -> None: ...


class Row(msgspec.Struct):
    card_mac: str = ""
    start_lost: bool = False


class Clock:
    now = 100.0

    def monotonic(self) -> float:
        return self.now


CLOCK = Clock()


@pytest.fixture(autouse=True)
def cards(monkeypatch):
    """Replace cards and receivers by ones without sockets."""
    monkeypatch.setattr(capture_rig, "CardClient", Card)
    monkeypatch.setattr(capture_rig, "ReceiverProcess", Receiver)
    monkeypatch.setattr(capture_rig, "time", CLOCK)


def list_commands(rig: CaptureRig) -> list[list[str]]:
    cards: Any = rig.cards.values()
    return [card.commands for card in cards]


def test_a_rig_that_recorded_nothing_is_closed_without_a_command():
    with CaptureRig(make_small_instrument()) as rig:
        pass
    assert list_commands(rig) == [[], []]


def test_closing_within_a_row_stops_each_record_once(tmp_path):
    rig = CaptureRig(make_small_instrument())
    rig.begin_row(row=0, take=1, points=3, folder=tmp_path)
    assert [commands[-1] for commands in list_commands(rig)] == ["start", "start"]
    for _ in range(2):
        rig.close()
        # The set-up of a card has stopped a record, too.
        assert [commands.count("stop") for commands in list_commands(rig)] == [2, 2]
        assert [commands[-1] for commands in list_commands(rig)] == ["stop", "stop"]


def test_a_record_that_has_ended_is_not_stopped_again_by_closing(tmp_path):
    rig = CaptureRig(make_small_instrument())
    rig.begin_row(row=0, take=1, points=3, folder=tmp_path)
    rig.end_row()
    commands_before = [len(commands) for commands in list_commands(rig)]
    rig.close()
    assert [len(commands) for commands in list_commands(rig)] == commands_before


def test_cards_are_reset_until_a_row_has_ended_at_a_known_place(tmp_path):
    rig = CaptureRig(make_small_instrument())

    def begin_row_and_count_resets() -> list[int]:
        rig.begin_row(row=0, take=1, points=3, folder=tmp_path)
        return [commands.count("reset") for commands in list_commands(rig)]

    # The first row does not end, so that the cards are reset again before the second.
    assert begin_row_and_count_resets() == [1, 1]
    assert begin_row_and_count_resets() == [2, 2]
    rig.end_row()
    assert begin_row_and_count_resets() == [2, 2]
    rig.end_row()
    rig.reset_before_next_row("RV")
    assert begin_row_and_count_resets() == [2, 3]


LIMIT_S = capture_rig._COMPLETED_TIMEOUT_S


@pytest.mark.parametrize(
    ("complete", "limits_s"),
    [
        ((False, False), ([LIMIT_S], [LIMIT_S / 4])),
        ((True, False), ([], [LIMIT_S])),
    ],
    ids=["both rows incomplete", "second row incomplete"],
)
def test_the_waits_for_the_cards_of_incomplete_rows_have_one_limit_together(tmp_path, complete, limits_s):
    """Each card takes three quarters of the limit. The card of a complete row is not waited for.

    `complete`: whether the row of each card is; `limits_s`: the limits of the waits for each card.
    """
    rig = CaptureRig(make_small_instrument())
    cards: Any = list(rig.cards.values())
    receivers: Any = list(rig.receivers.values())
    for card, receiver, is_complete in zip(cards, receivers, complete, strict=True):
        card.waits_s = 0.75 * LIMIT_S
        receiver.is_complete = is_complete
    rig.begin_row(row=0, take=1, points=3, folder=tmp_path)
    rig.end_row()
    for card, limits_of_card_s in zip(cards, limits_s, strict=True):
        assert card.limits_s == pytest.approx(limits_of_card_s)


@pytest.mark.parametrize(("above_s", "is_warned"), [(-0.1, True), (0.0, True), (0.1, False)])
def test_a_limit_of_silence_that_is_not_above_that_of_the_cards_is_a_warning(above_s, is_warned):
    """A card itself is silent for `CARD_TAIL_S` before the last packet of a record."""
    with CaptureRig(make_small_instrument(end_of_record_s=CARD_TAIL_S + above_s)) as rig:
        assert any("end_of_record_s" in warning for warning in rig.warnings) == is_warned
