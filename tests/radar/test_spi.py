"""Each command of the SPI link is executed once and answered, although messages are lost, damaged or overtaken."""

import itertools

import pytest
from hypothesis import given, settings, strategies as st
from tests.support.radar.boards import BoardWords, VirtualClock, make_native_rig
from tests.support.refusals import expect_refusal

from polysight.radar.board import RadarBoard
from polysight.radar.commands import (
    DEVICE_CONFIGURATION,
    GET_TEMPERATURES,
    LOW_POWER_OFF,
    RF_POWER_UP,
    Chirp,
    LdoBypass,
    make_program,
)
from polysight.radar.link import ATTEMPTS, Link
from polysight.radar.messages import CALIBRATION_REPORT, MAIN_POWER_UP, READY_TO_READ, RF_POWER_UP_DONE, decode
from polysight_shared.errors import ErrorCode
from polysight_simulators.radars import Fault, RadarBoard as Simulated, make_image


def ignore(_):
    """Discard an event."""


@pytest.fixture
def sent() -> list[bytes]:
    return []


@pytest.fixture
def link(words, clock, sent) -> Link:
    """A link to a board whose both cores are up."""
    connection = Link("RH", words, clock, sent.append)
    words.reset(held=True)
    words.reset(held=False)
    connection.wait_for((MAIN_POWER_UP,), 1.0, ignore)
    connection.call(DEVICE_CONFIGURATION)
    connection.call(RF_POWER_UP)
    connection.wait_for((RF_POWER_UP_DONE,), 1.0, ignore)
    sent.clear()
    return connection


def decode_commands(sent: list[bytes]):
    return [decode(raw) for raw in sent if raw != READY_TO_READ]


def test_sequence_numbers_count_up_and_begin_again_after_15(link, sent):
    """The link's first two commands, in its fixture, had the numbers 0 and 1."""
    for _ in range(20):
        link.call(GET_TEMPERATURES)
    assert [m.sequence for m in decode_commands(sent)] == [(2 + n) % 16 for n in range(20)]
    assert not any(m.retry for m in decode_commands(sent))
    assert link.warnings == []


def test_every_read_starts_with_the_ready_word(link, sent):
    link.call(GET_TEMPERATURES)
    assert [raw == READY_TO_READ for raw in sent] == [False, True]


@pytest.mark.parametrize("fault", [Fault.BAD_CRC, Fault.BAD_CHECKSUM, Fault.LOST_INTERRUPT, Fault.NO_ANSWER])
def test_a_lost_answer_is_retried_with_the_same_sequence_number(link, board, sent, fault):
    executed_before = list(board.executed)
    board.inject(fault)
    link.call(LOW_POWER_OFF)
    assert [(m.sequence, m.retry) for m in decode_commands(sent)] == [(2, False), (2, True)]
    # The board executed it once: it recognizes the retry by its number.
    assert board.executed == [*executed_before, LOW_POWER_OFF.ID]
    assert "sent 2 times" in link.warnings[-1]
    link.call(LOW_POWER_OFF)
    assert decode_commands(sent)[-1].sequence == 3


def test_a_command_that_was_received_damaged_is_sent_with_a_new_sequence_number(link, board, sent):
    board.inject(Fault.NACK)
    link.call(LOW_POWER_OFF)
    assert [(m.sequence, m.retry) for m in decode_commands(sent)] == [(2, False), (3, False)]
    assert board.executed[-1] == LOW_POWER_OFF.ID


def test_words_before_the_sync_word_are_skipped(link, board, sent):
    board.inject(Fault.BAD_SYNC)
    link.call(LOW_POWER_OFF)
    assert len(decode_commands(sent)) == 1


def test_an_event_between_command_and_answer_is_not_lost(link, board, sent):
    board.inject(Fault.EVENT_BETWEEN)
    link.call(LOW_POWER_OFF)
    assert len(decode_commands(sent)) == 1
    assert [e.id for e in link.poll()] == [CALIBRATION_REPORT]
    assert link.poll() == []


def test_events_come_in_order_and_once(link, board):
    for number in (0x100B, 0x100F, 0x1012):
        board.send_event(number, bytes(20))
    assert [e.id for e in link.poll()] == [0x100B, 0x100F, 0x1012]


def test_a_refusal_is_an_error_without_a_retry(link, board, sent):
    board.inject(Fault.REFUSE)
    with expect_refusal(ErrorCode.REFUSED_BY_PEER, "RH", "LowPower", "error 6"):
        link.call(LOW_POWER_OFF)
    assert len(decode_commands(sent)) == 1


def test_retries_are_limited(link, board, sent, clock):
    board.inject(*[Fault.NO_ANSWER] * ATTEMPTS)
    begun_s = clock.time
    with expect_refusal(ErrorCode.NO_ANSWER):
        link.call(LOW_POWER_OFF)
    assert [m.retry for m in decode_commands(sent)] == [False, True, True]
    # Each attempt waits for a second of virtual time; the transfers take a little of it, too.
    attempt_s = 1.0
    assert clock.time - begun_s == pytest.approx(ATTEMPTS * attempt_s, rel=0.05)


@pytest.mark.parametrize(
    "fault", [f for f in Fault if f not in (Fault.BAD_SYNC, Fault.EVENT_BETWEEN, Fault.REFUSE, Fault.REFUSE_BARE)]
)
def test_the_command_of_rf_power_up_is_never_sent_twice(words, clock, board, sent, fault):
    link = Link("RH", words, clock, sent.append)
    words.reset(held=True)
    words.reset(held=False)
    link.wait_for((MAIN_POWER_UP,), 1.0, ignore)
    board.inject(fault)
    with expect_refusal(ErrorCode.NO_ANSWER):
        link.call(RF_POWER_UP)
    assert len(decode_commands(sent)) == 1


def test_a_message_that_came_while_the_program_was_delayed_is_read_after_the_timeout(words, clock, sent, monkeypatch):
    """The host polls without result and is delayed for 100 s: after the RF power-up's request, before its event."""
    link = Link("RH", words, clock, sent.append)
    words.reset(held=True)
    words.reset(held=False)
    link.wait_for((MAIN_POWER_UP,), 1.0, ignore)
    link.call(DEVICE_CONFIGURATION)
    interrupt = words.interrupt

    def hold_once() -> bool:
        clock.sleep(100.0)
        monkeypatch.setattr(words, "interrupt", interrupt)
        return False

    monkeypatch.setattr(words, "interrupt", hold_once)
    link.call(RF_POWER_UP)
    monkeypatch.setattr(words, "interrupt", hold_once)
    link.wait_for((RF_POWER_UP_DONE,), 1.0, ignore)
    assert link.warnings == []


def test_an_unplugged_link_is_an_error_immediately(link, board):
    board.plugged = False
    with expect_refusal(ErrorCode.NO_ANSWER, "unplugged"):
        link.call(LOW_POWER_OFF)
    with expect_refusal(ErrorCode.NO_ANSWER, "unplugged"):
        link.poll()


def test_an_event_that_does_not_come_is_a_timeout_with_its_number(link):
    with expect_refusal(ErrorCode.NO_ANSWER, "0x100B", "2 s"):
        link.wait_for((0x100B,), 2.0, ignore)


# --- several commands, each disturbed --------------------------------------------------------------------------------

RIG = make_native_rig()
LOST = st.sampled_from([Fault.NACK, Fault.BAD_CRC, Fault.BAD_CHECKSUM, Fault.LOST_INTERRUPT, Fault.NO_ANSWER])
HARMLESS = st.sampled_from([Fault.EVENT_BETWEEN, Fault.BAD_SYNC])


def _draw_faults_of_one_command() -> st.SearchStrategy[list[Fault]]:
    """Up to two faults by which a message is lost, and perhaps a harmless one after them."""

    def append_last(parts: tuple[list[Fault], Fault]) -> list[Fault]:
        lost, harmless = parts
        return [*lost, harmless]

    lost_messages = st.lists(LOST, max_size=2)
    return st.one_of(lost_messages, st.tuples(lost_messages, HARMLESS).map(append_last))


@settings(deadline=None)
@given(st.lists(_draw_faults_of_one_command(), min_size=1, max_size=8))
def test_commands_are_executed_once_in_order_although_messages_are_lost(faults_of_each: list[list[Fault]]):
    """A command is executed twice only if its answer was lost and then its retry arrived damaged.

    The board then answers with a NACK, which requires a new sequence number, and so does not recognize the command.
    """
    clock = VirtualClock()
    board = Simulated(lambda: clock.time, flash=make_image())
    radar = RadarBoard("RH", BoardWords(board, clock), clock, make_program(RIG, RIG.by_name("RH")))
    radar.configure()
    board.executed.clear()
    link: Link = radar.link
    expected = []
    commands = itertools.cycle((LOW_POWER_OFF, LdoBypass(), Chirp(0)))
    for faults, command in zip(faults_of_each, commands, strict=False):
        board.inject(*faults)
        link.call(command)
        expected.append(command.ID)
        # With these faults the board has not executed the command.
        not_executed = (Fault.NACK, Fault.NO_ANSWER)
        if len(faults) > 1 and faults[0] not in not_executed and faults[1] is Fault.NACK:
            expected.append(command.ID)
    assert board.executed == expected
