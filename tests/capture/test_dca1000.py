"""The card's bytes, against vectors seen from a real card and round trips."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from polysight.host.capture import dca1000 as d
from polysight.shared.errors import ProtocolError


def test_vectors_seen():
    assert d.configure_packet_data(1470, 25.0) == bytes.fromhex("be05350c0000")
    assert d.configure_fpga_data(4) == bytes.fromhex("01010102031e")
    assert d.configure_fpga_data(2) == bytes.fromhex("01020102031e")
    assert d.encode_request(d.Code.ALIVE) == bytes.fromhex("5aa509000000aaee")
    assert d.decode_reply(bytes.fromhex("5aa50e000204aaee")) == d.Reply(d.Code.VERSION, 0x0402)
    assert str(d.decode_version(0x0402)) == "2.8"
    assert d.decode_reply(bytes.fromhex("5aa50a000001aaee")) == d.Reply(d.Code.STATUS, d.Status.RECORD_COMPLETED)
    assert d.decode_packet_header(bytes.fromhex("02000000b00500000000") + b"x") == (2, 1456)


@given(st.integers(0, 0xFFFF), st.binary(max_size=504))
def test_request_round_trip(code, data):
    raw = d.encode_request(code, data)
    assert d.decode_request(raw) == (code, data)


@given(st.integers(0, 0xFFFF), st.integers(0, 0xFFFF))
def test_reply_round_trip(code, status):
    assert d.decode_reply(d.encode_reply(code, status)) == d.Reply(code, status)


@given(st.integers(0, 2**32 - 1), st.integers(0, 2**48 - 1), st.binary(min_size=1, max_size=1456))
def test_packet_round_trip(sequence, count, payload):
    packet = d.encode_packet(sequence, count, payload)
    assert d.decode_packet_header(packet) == (sequence, count)
    assert packet[d.PACKET_HEADER_BYTES :] == payload


def test_counters_wrap():
    assert d.decode_packet_header(d.encode_packet(2**32 + 5, 2**48 + 7, b"x")) == (5, 7)


@pytest.mark.parametrize("raw", [b"", b"12345678", bytes.fromhex("5aa509000000aaef"), bytes.fromhex("5aa509000000aa")])
def test_malformed_replies_are_refused(raw):
    with pytest.raises(ProtocolError):
        d.decode_reply(raw)


@pytest.mark.parametrize("raw", [b"", b"12345678", bytes.fromhex("5aa503000600aaee")])
def test_what_is_no_request_is_refused(raw):
    with pytest.raises(ProtocolError):
        d.decode_request(raw)


def test_out_of_range_is_refused():
    with pytest.raises(ProtocolError):
        d.encode_request(3, bytes(505))
    with pytest.raises(ProtocolError):
        d.configure_packet_data(1470, 600.0)
    with pytest.raises(ProtocolError):
        d.configure_fpga_data(3)
    with pytest.raises(ProtocolError):
        d.decode_packet_header(bytes(10))
