"""EEPROM of a card: bytes of command 0x04, refused settings, no write without confirmation."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.support.capture.cards import reply
from tests.support.refusals import refused

from polysight.capture.card import CardClient, EepromSettings, program_eeprom
from polysight.capture.dca1000 import Code, Status
from polysight_shared.error_codes import ErrorCode
from polysight_simulators.cards import Network


def test_the_bytes_are_reversed():
    body = EepromSettings("192.168.33.30", "192.168.33.181", "12:34:56:78:90:13", 4200, 4201).encode()
    assert body.hex(" ") == "1e 21 a8 c0 b5 21 a8 c0 13 90 78 56 34 12 68 10 69 10"


@given(
    net=st.tuples(st.integers(1, 223), st.integers(0, 255), st.integers(0, 255)),
    ends=st.lists(st.integers(1, 254), min_size=2, max_size=2, unique=True),
    mac=st.binary(min_size=5, max_size=5).filter(any),
    ports=st.lists(st.integers(1025, 65535), min_size=2, max_size=2, unique=True),
)
def test_the_card_decodes_the_settings_sent(net, ends, mac, ports):
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


def settings_of(client: CardClient) -> EepromSettings:
    return EepromSettings.of_board(client.board, "12:34:56:78:90:13")


def card_that(status: int = 0, answer: int | None = 0):
    """Answers of a card that reports `status` and replies `answer` when it is to write its EEPROM."""

    def answers(code: int, _: int) -> list[bytes]:
        if code != Code.CONFIGURE_EEPROM:
            return [reply(code)]
        return [reply(Code.STATUS, status)] * bool(status) + ([] if answer is None else [reply(code, answer)])

    return answers


def test_written_once_confirmed(scripted):
    client, card = scripted(card_that())
    settings = settings_of(client)
    program_eeprom(client, settings, settings.confirmation)
    assert card.seen == [(Code.ALIVE, b""), (Code.CONFIGURE_EEPROM, settings.encode())]


@pytest.mark.parametrize("confirmed", ["", "yes", "192.168.33.180"])
def test_nothing_is_sent_unconfirmed(scripted, confirmed):
    client, card = scripted(card_that())
    with refused(ErrorCode.VALUE_INVALID, client.board.card_address):
        program_eeprom(client, settings_of(client), confirmed)
    assert card.seen == []


@pytest.mark.parametrize(
    ("status", "answer", "code"),
    [
        (Status.EEPROM_FAILURE, 0, ErrorCode.REFUSED_BY_PEER),
        (0, 1, ErrorCode.REFUSED_BY_PEER),
        (0, None, ErrorCode.NO_ANSWER),
    ],
)
def test_a_card_that_could_not_write_it(scripted, status, answer, code):
    client, card = scripted(card_that(status, answer), timeout_s=3.0)
    settings = settings_of(client)
    with refused(code):
        program_eeprom(client, settings, settings.confirmation)
    assert [code for code, _ in card.seen].count(Code.CONFIGURE_EEPROM) == 1
