"""Laws of the simulated DCA1000: packets carry the LVDS stream, counters count, replies are the real card's."""

import pytest
from hypothesis import given, strategies as st

from polysight_simulators.cards.dca1000 import Card, Message, Network, Output

HOME = Network("192.168.33.30", "192.168.33.180", bytes.fromhex("123456789012"), 4096, 4098)


def list_messages(outputs: list[Output]) -> list[bytes]:
    return [o.payload for o in outputs if isinstance(o, Message)]


@pytest.mark.parametrize(
    ("request_hex", "reply_hex"),
    [
        # Head 5aa5, code, number of bytes, data, tail aaee. A reply has a status in place of the number: 0 is success.
        ("5aa5 0100 0000 aaee", "5aa5 0100 0000 aaee"),
        ("5aa5 0200 0000 aaee", "5aa5 0200 0000 aaee"),
        ("5aa5 0300 0600 01010102031e aaee", "5aa5 0300 0000 aaee"),
        ("5aa5 0500 0000 aaee", "5aa5 0500 0000 aaee"),
        ("5aa5 0600 0000 aaee", "5aa5 0600 0000 aaee"),
        ("5aa5 0900 0000 aaee", "5aa5 0900 0000 aaee"),
        ("5aa5 0a00 0000 aaee", "5aa5 0a00 0000 aaee"),
        ("5aa5 0b00 0600 be05350c0000 aaee", "5aa5 0b00 0000 aaee"),
        ("5aa5 0e00 0000 aaee", "5aa5 0e00 0204 aaee"),
        ("5aa5 0400 1200 1e21a8c0 b421a8c0 129078563412 0010 0210 aaee", "5aa5 0400 0000 aaee"),
        # Settings of the EEPROM with a wrong length, and two malformed requests that a card answers all the same.
        ("5aa5 0400 0300 010203 aaee", "5aa5 0400 0100 aaee"),
        ("5aa5 0300 0200 0101 aaee", "5aa5 0300 0000 aaee"),
        ("5aa5 0b00 ff00 be05 aaee", "5aa5 0b00 0000 aaee"),
        # Packets of no bytes, and an unknown code.
        ("5aa5 0b00 0600 000035 0c0000 aaee", "5aa5 0b00 0100 aaee"),
        ("5aa5 7700 0000 aaee", "5aa5 7700 0100 aaee"),
    ],
)
def test_requests_get_the_replies_of_a_real_card(request_hex: str, reply_hex: str) -> None:
    assert list_messages(Card(HOME).command(bytes.fromhex(request_hex), 0.0)) == [bytes.fromhex(reply_hex)]


@pytest.mark.parametrize("junk", [b"", b"\x5a\xa5\x09\x00", bytes(8), bytes.fromhex("a55a 0900 0000 eeaa")])
def test_a_packet_that_is_not_a_request_gets_no_answer(junk: bytes) -> None:
    assert Card(HOME).command(junk, 0.0) == []


@given(st.binary(max_size=600))
def test_a_card_survives_any_bytes(junk: bytes) -> None:
    card = Card(HOME)
    for datagram in (junk, b"\x5a\xa5" + junk):
        # A reply, and a status if the command ended a record
        assert len(card.command(datagram, 0.0)) <= 2


def test_settings_in_the_eeprom_are_used_from_the_next_power_cycle_on() -> None:
    card = Card(HOME)
    # Addresses of host and card, MAC address, ports 4200 and 4201
    body = bytes.fromhex("1e21a8c0 b521a8c0 139078563412 6810 6910")
    request = bytes.fromhex("5aa5 0400 1200") + body + bytes.fromhex("aaee")
    success = bytes.fromhex("5aa5 0400 0000 aaee")
    assert list_messages(card.command(request, 0.0)) == [success]
    assert card.network == HOME
    card.power_cycle()
    assert card.network == Network("192.168.33.30", "192.168.33.181", bytes.fromhex("123456789013"), 4200, 4201)
