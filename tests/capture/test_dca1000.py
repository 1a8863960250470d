"""The card's bytes, against vectors seen from a real card."""

from __future__ import annotations

import pytest

from polysight.capture import dca1000 as d
from polysight_shared.errors import ProtocolError


def test_vectors_seen():
    assert d.configure_packet_data(1470, 25.0) == bytes.fromhex("be05350c0000")
    assert d.configure_fpga_data(4) == bytes.fromhex("01010102031e")
    assert d.configure_fpga_data(2) == bytes.fromhex("01020102031e")
    assert d.encode_request(d.Code.ALIVE) == bytes.fromhex("5aa509000000aaee")
    assert d.decode_reply(bytes.fromhex("5aa50e000204aaee")) == d.Reply(d.Code.VERSION, 0x0402)
    assert str(d.decode_version(0x0402)) == "2.8"
    assert d.decode_reply(bytes.fromhex("5aa50a000001aaee")) == d.Reply(d.Code.STATUS, d.Status.RECORD_COMPLETED)
    assert d.decode_packet_header(bytes.fromhex("02000000b00500000000") + b"x") == (2, 1456)
    assert d.decode_packet_header(bytes.fromhex("ffffffff010000000080") + b"x") == (2**32 - 1, 2**47 + 1)


@pytest.mark.parametrize("raw", [b"", b"12345678", bytes.fromhex("5aa509000000aaef"), bytes.fromhex("5aa509000000aa")])
def test_malformed_replies_are_refused(raw):
    with pytest.raises(ProtocolError):
        d.decode_reply(raw)


def test_out_of_range_is_refused():
    with pytest.raises(ProtocolError):
        d.encode_request(3, bytes(505))
    with pytest.raises(ProtocolError):
        d.configure_packet_data(1470, 600.0)
    with pytest.raises(ProtocolError):
        d.configure_fpga_data(3)
    with pytest.raises(ProtocolError):
        d.decode_packet_header(bytes(10))
