"""Laws of the simulated DCA1000: packets carry the LVDS stream, counters count, replies are the real card's."""

from __future__ import annotations

import struct

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from polysight_simulators.cards.dca1000 import Card, Message, Network, Output, Packets

HOME = Network("192.168.33.30", "192.168.33.180", bytes.fromhex("123456789012"), 4096, 4098)
CONFIGURE = bytes.fromhex("5aa5 0300 0600 01010102031e aaee")
PACKET = bytes.fromhex("5aa5 0b00 0600 be05350c0000 aaee")
START = bytes.fromhex("5aa5 0500 0000 aaee")
STOP = bytes.fromhex("5aa5 0600 0000 aaee")
COMPLETED = bytes.fromhex("5aa5 0a00 0001 aaee")


def parse(packet: bytes) -> tuple[int, int, bytes]:
    sequence, low, high = struct.unpack_from("<IIH", packet)
    return sequence, low | high << 32, packet[10:]


def packets(outputs: list[Output]) -> list[bytes]:
    return [row.tobytes() for o in outputs if isinstance(o, Packets) for row in o.rows]


def messages(outputs: list[Output]) -> list[bytes]:
    return [o.payload for o in outputs if isinstance(o, Message)]


def stream(n: int, seed: int = 0) -> NDArray[np.uint8]:
    return np.random.default_rng(seed).integers(0, 256, n, dtype=np.uint8)


def ready_card(sequence: int = 1, byte_count: int = 0) -> Card:
    card = Card(HOME, sequence, byte_count)
    card.command(CONFIGURE, 0.0)
    card.command(PACKET, 0.0)
    return card


def test_the_tail_comes_two_seconds_after_the_last_data_and_the_status_right_behind_it() -> None:
    card = ready_card()
    card.command(START, 10.0)
    card.lvds(stream(4096), 11.0)
    assert card.deadline_s == 13.0
    assert card.tick(12.999) == []
    tail, status = card.tick(13.0)
    assert isinstance(tail, Packets)
    assert tail.rows.shape == (1, 10 + 4096 - 2 * 1456)
    assert status == Message(COMPLETED)
    assert not card.recording
    assert card.tick(99.0) == []
    assert card.lvds(stream(4096), 100.0) == []


@pytest.mark.parametrize(
    ("request_hex", "reply_hex"),
    [
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
        ("5aa5 0400 0300 010203 aaee", "5aa5 0400 0100 aaee"),  # EEPROM of the wrong length
        ("5aa5 0300 0200 0101 aaee", "5aa5 0300 0000 aaee"),  # malformed, answered all the same
        ("5aa5 0b00 ff00 be05 aaee", "5aa5 0b00 0000 aaee"),
        ("5aa5 0b00 0600 000035 0c0000 aaee", "5aa5 0b00 0100 aaee"),  # packets of no size
        ("5aa5 7700 0000 aaee", "5aa5 7700 0100 aaee"),
    ],
)
def test_requests_and_replies_byte_for_byte(request_hex: str, reply_hex: str) -> None:
    assert messages(Card(HOME).command(bytes.fromhex(request_hex), 0.0)) == [bytes.fromhex(reply_hex)]


@pytest.mark.parametrize("junk", [b"", b"\x5a\xa5\x09\x00", bytes(8), bytes.fromhex("a55a 0900 0000 eeaa")])
def test_what_is_no_request_gets_no_answer(junk: bytes) -> None:
    assert Card(HOME).command(junk, 0.0) == []


@given(st.binary(max_size=600))
def test_no_bytes_break_the_card(junk: bytes) -> None:
    card = Card(HOME)
    for datagram in (junk, b"\x5a\xa5" + junk):
        assert len(card.command(datagram, 0.0)) <= 2


def test_packet_size_and_delay_are_taken_from_the_packet_configuration() -> None:
    card = ready_card()
    assert card.packet_bytes == 1466
    assert card.packet_delay_s == pytest.approx(25e-6)
    card.command(bytes.fromhex("5aa5 0b00 0600") + struct.pack("<HHH", 1014, 125 * 5, 0) + b"\xaa\xee", 0.0)
    assert card.packet_delay_s == pytest.approx(5e-6)
    card.command(START, 0.0)
    assert [len(p) for p in packets(card.lvds(stream(3000), 0.0))] == [1010] * 3


def test_the_usual_packet_size_gives_1456_bytes_and_malformed_requests_change_nothing() -> None:
    card = Card(HOME)
    for request in (
        "5aa5 0300 0600 c005350c0000 aaee",
        "5aa5 0b00 0600 c005350c0000 aaee",
        "5aa5 0b00 0400 35020000 aaee",
    ):
        (reply,) = messages(card.command(bytes.fromhex(request), 0.0))
        assert reply[4:6] == b"\0\0"
    assert card.packet_delay_s == pytest.approx(25e-6)
    card.command(START, 0.0)
    assert [len(p) for p in packets(card.lvds(stream(3000), 0.0))] == [1466] * 2


def test_a_wrong_lane_configuration_records_nothing_and_is_reported() -> None:
    card = Card(HOME)
    # 2-lane
    card.command(bytes.fromhex("5aa5 0300 0600 01020102031e aaee"), 0.0)
    card.command(START, 0.0)
    assert card.lvds(stream(5000), 1.0) == []
    assert card.tick(29.9) == []
    assert card.tick(30.0) == [Message(bytes.fromhex("5aa5 0a00 0100 aaee"))]
    assert not card.recording


def test_the_eeprom_is_taken_at_the_next_power_cycle() -> None:
    card = Card(HOME)
    body = bytes.fromhex("1e21a8c0 b521a8c0 139078563412 6810 6910")
    assert messages(card.command(bytes.fromhex("5aa5 0400 1200") + body + b"\xaa\xee", 0.0))[0][4] == 0
    assert card.network == HOME
    card.power_cycle()
    assert card.network == Network("192.168.33.30", "192.168.33.181", bytes.fromhex("123456789013"), 4200, 4201)


def test_an_overflow_is_reported_only_while_recording() -> None:
    card = ready_card()
    assert card.overflow() == []
    card.command(START, 0.0)
    assert card.overflow() == [Message(bytes.fromhex("5aa5 0a00 0002 aaee"))]
