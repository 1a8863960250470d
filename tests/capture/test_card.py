"""The control client against a card that answers from another port, late, wrongly, or not at all."""

from __future__ import annotations

import select
import socket
import threading
import time
from contextlib import ExitStack

import pytest

from polysight.host.capture import dca1000
from polysight.host.capture.card import CardClient
from polysight.host.capture.dca1000 import Code, Status
from polysight.shared.config import Board, Card
from polysight.shared.error_codes import ErrorCode
from tests.support.refusals import refused


class Script:
    """A card that sends, for each request, what `answers` gives for its code and how often it was asked."""

    def __init__(self, board: Board, answers, source_port: int = 1024) -> None:
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
                code, data = dca1000.decode_request(self._in.recv(2048))
            except TimeoutError:
                continue
            self.seen.append((code, data))
            for raw in self._answers(code, sum(c == code for c, _ in self.seen)):
                self._out.sendto(raw, self.host)

    def say(self, raw: bytes) -> None:
        self._out.sendto(raw, self.host)

    def close(self) -> None:
        self._end.set()
        self._thread.join()
        self._in.close()
        self._out.close()


def reply(code: int, status: int = 0) -> bytes:
    return dca1000.encode_reply(code, status)


@pytest.fixture
def bench(rig):
    board = rig.by_name("RV")
    with ExitStack() as stack:

        def make(answers, timeout_s: float = 30.0, source_port: int = 1024) -> tuple[CardClient, Script]:
            script = Script(board, answers, source_port)
            stack.callback(script.close)
            return stack.enter_context(CardClient(board, timeout_s)), script

        yield make


def test_configures_as_seen_on_a_real_card(bench):
    client, card = bench(lambda code, _: [reply(code, 0x0402 if code == Code.VERSION else 0)])
    client.alive()
    client.configure(Card())
    assert str(client.version()) == "2.8"
    client.record_start()
    client.record_stop()
    client.reset_fpga()
    client.reset_radar()
    assert card.seen == [
        (Code.ALIVE, b""),
        (Code.CONFIGURE_FPGA, bytes.fromhex("01010102031e")),
        (Code.CONFIGURE_PACKET, bytes.fromhex("be05350c0000")),
        (Code.VERSION, b""),
        (Code.RECORD_START, b""),
        (Code.RECORD_STOP, b""),
        (Code.RESET_FPGA, b""),
        (Code.RESET_RADAR, b""),
    ]


@pytest.mark.parametrize("source_port", [1024, 4098, 0])
def test_replies_and_status_count_from_any_source_port(bench, source_port):
    """Only the address tells a card: the sockets have no peer."""
    client, _ = bench(
        lambda code, _: [reply(Code.STATUS, Status.NO_LVDS_DATA), reply(code, 0x0402)], source_port=source_port
    )
    assert str(client.version()) == "2.8"
    assert client.take_status() == Status.NO_LVDS_DATA
    assert client.strangers == 0
    with pytest.raises(OSError, match="not connected"):
        client._socket.getpeername()


def test_status_is_told_from_replies(bench):
    client, card = bench(
        lambda code, _: [reply(Code.STATUS, Status.LVDS_BUFFER_FULL), reply(Code.VERSION, 1), b"noise", reply(code)]
    )
    client.alive()
    assert client.take_status() == Status.LVDS_BUFFER_FULL
    client.record_start()
    card.say(reply(Code.STATUS, Status.RECORD_COMPLETED))
    deadline = time.monotonic() + 60.0
    while Status.RECORD_COMPLETED not in client.take_status() and time.monotonic() < deadline:
        time.sleep(0.01)
    assert client.take_status() == Status.LVDS_BUFFER_FULL | Status.RECORD_COMPLETED
    assert client.strangers == 2


def test_lost_reply_is_asked_for_again(bench):
    client, card = bench(lambda code, n: [] if n == 1 else [reply(code)], timeout_s=6.0)
    client.alive()
    assert [c for c, _ in card.seen] == [Code.ALIVE, Code.ALIVE]


def test_record_start_is_never_sent_twice_without_a_stop(bench):
    client, card = bench(lambda code, n: [] if code == Code.RECORD_START and n == 1 else [reply(code)], timeout_s=6.0)
    client.record_start()
    assert [c for c, _ in card.seen] == [Code.RECORD_START, Code.RECORD_STOP, Code.RECORD_START]


def test_refusal_is_an_error_but_not_for_stop(bench):
    client, _ = bench(lambda code, _: [reply(code, 1)])
    client.record_stop()
    with refused(ErrorCode.REFUSED_BY_PEER, "CONFIGURE_FPGA"):
        client.configure(Card())


def test_silent_card_is_named(bench):
    client, card = bench(lambda *_: [], timeout_s=0.15)
    with refused(ErrorCode.NO_ANSWER, "RV", ":4202", "ALIVE", "EEPROM"):
        client.alive()
    deadline = time.monotonic() + 60.0
    while len(card.seen) < 3 and time.monotonic() < deadline:
        time.sleep(0.01)
    assert len(card.seen) == 3


def test_command_port_in_use(bench):
    client, _ = bench(lambda *_: [])
    with refused(ErrorCode.BUSY, 4202, "ss -ulnp"):
        CardClient(client.board, 1.0)


@pytest.mark.parametrize("between", [True, False])
def test_end_of_the_record_before_is_not_that_of_this_one(bench, between):
    """It came after the stop: before the next start was sent, or between that and its reply."""
    late = [reply(Code.STATUS, Status.RECORD_COMPLETED)]
    client, card = bench(
        lambda code, n: [*(late if between and code == Code.RECORD_START and n == 2 else []), reply(code)]
    )
    client.record_start()
    client.record_stop()
    if not between:
        card.say(reply(Code.STATUS, Status.RECORD_COMPLETED | Status.DDR_FULL))
        assert select.select([client], [], [], 60.0)[0]
    client.record_start()
    assert client.take_status() == Status(0)


def test_completed_record_is_waited_for_but_not_for_ever(bench):
    def answers(code, _):
        yield reply(code)
        if code == Code.RECORD_STOP:
            time.sleep(0.1)
            yield reply(Code.STATUS, Status.RECORD_COMPLETED)

    client, _ = bench(answers)
    client.record_start()
    client.record_stop()
    client.wait_completed(60.0)
    assert client.take_status() == Status.RECORD_COMPLETED
    client.record_start()
    client.wait_completed(0.05)
    assert client.take_status() == Status(0)
