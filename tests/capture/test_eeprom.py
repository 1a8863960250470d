"""A card's addresses: the bytes of command 0x04, what is refused, and that nothing is written unconfirmed."""

from __future__ import annotations

import socket
import threading
from contextlib import ExitStack

import pytest
from hypothesis import given
from hypothesis import strategies as st

from polysight.host.capture.card import CardClient, EepromSettings, program_eeprom
from polysight.host.capture.dca1000 import Code, Status, decode_request, encode_reply
from polysight.shared.error_codes import ErrorCode
from polysight.simulators.cards import Network
from tests.support.refusals import refused


def test_the_bytes_are_reversed():
    body = EepromSettings("192.168.33.30", "192.168.33.181", "12:34:56:78:90:13", 4200, 4201).encode()
    assert body.hex(" ") == "1e 21 a8 c0 b5 21 a8 c0 13 90 78 56 34 12 68 10 69 10"


@given(
    net=st.tuples(st.integers(1, 223), st.integers(0, 255), st.integers(0, 255)),
    ends=st.lists(st.integers(1, 254), min_size=2, max_size=2, unique=True),
    mac=st.binary(min_size=5, max_size=5).filter(any),
    ports=st.lists(st.integers(1025, 65535), min_size=2, max_size=2, unique=True),
)
def test_the_card_reads_what_was_meant(net, ends, mac, ports):
    host, card = (".".join(map(str, (*net, end))) for end in ends)
    settings = EepromSettings(host, card, (b"\2" + mac).hex(":"), *ports)
    read = Network.decode(settings.encode())
    assert tuple(read) == (host, card, b"\2" + mac, *ports)
    assert card in settings.text()


@pytest.mark.parametrize(
    "given",
    [
        {"card_address": "192.168.33.30"},
        {"card_address": "192.168.34.180"},
        {"card_address": "192.168.33.255"},
        {"card_address": "192.168.33"},
        {"host_address": "224.0.0.1", "card_address": "224.0.0.2"},
        {"card_mac": "01:00:00:00:00:01"},
        {"card_mac": "00:00:00:00:00:00"},
        {"card_mac": "12:34"},
        {"card_mac": "wrong"},
        {"command_port": 1024},
        {"data_port": 70000},
        {"data_port": 4096},
    ],
)
def test_a_card_that_could_not_be_reached_is_refused(given):
    good = {"host_address": "192.168.33.30", "card_address": "192.168.33.180"}
    EepromSettings(**good)
    with refused(ErrorCode.VALUE_INVALID):
        EepromSettings(**(good | given))


@pytest.fixture
def card(board):
    """A client, and the requests its card has seen; `status` are the bits the card reports when it writes."""
    seen: list[tuple[int, bytes]] = []
    answers = {"status": Status(0), "reply": 0}
    with ExitStack() as stack:
        there = stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
        there.bind((board.card_address, board.command_port))
        end = threading.Event()

        def serve() -> None:
            while not end.is_set():
                raw = there.recv(2048)
                if not raw:
                    return
                code, data = decode_request(raw)
                seen.append((code, data))
                host = (board.host_address, board.command_port)
                if code == Code.CONFIGURE_EEPROM and answers["status"]:
                    there.sendto(encode_reply(Code.STATUS, answers["status"]), host)
                if answers["reply"] is not None or code == Code.ALIVE:
                    there.sendto(encode_reply(code, 0 if code == Code.ALIVE else answers["reply"]), host)

        thread = threading.Thread(target=serve)
        thread.start()
        client = stack.enter_context(CardClient(board, 3.0))
        yield client, seen, answers
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as s:
            s.sendto(b"", (board.card_address, board.command_port))
        thread.join()


def settings_of(client: CardClient) -> EepromSettings:
    return EepromSettings.of_board(client.board, "12:34:56:78:90:13")


def test_written_once_confirmed(card):
    client, seen, _ = card
    settings = settings_of(client)
    program_eeprom(client, settings, settings.confirmation)
    assert seen == [(Code.ALIVE, b""), (Code.CONFIGURE_EEPROM, settings.encode())]


@pytest.mark.parametrize("confirmed", ["", "yes", "192.168.33.180"])
def test_nothing_is_sent_unconfirmed(card, confirmed):
    client, seen, _ = card
    with refused(ErrorCode.VALUE_INVALID, client.board.card_address):
        program_eeprom(client, settings_of(client), confirmed)
    assert seen == []


@pytest.mark.parametrize(
    ("status", "reply", "code"),
    [
        (Status.EEPROM_FAILURE, 0, ErrorCode.REFUSED_BY_PEER),
        (0, 1, ErrorCode.REFUSED_BY_PEER),
        (0, None, ErrorCode.NO_ANSWER),
    ],
)
def test_a_card_that_could_not_write_it(card, status, reply, code):
    client, seen, answers = card
    answers["status"], answers["reply"] = status, reply
    settings = settings_of(client)
    with refused(code):
        program_eeprom(client, settings, settings.confirmation)
    assert [code for code, _ in seen].count(Code.CONFIGURE_EEPROM) == 1
