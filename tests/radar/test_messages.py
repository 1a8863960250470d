"""mmWaveLink messages are decoded from their bytes, and every flipped bit is detected."""

import struct

import pytest
from hypothesis import given, strategies as st

from polysight.radar import messages as m
from polysight_shared.errors import ProtocolError


@st.composite
def draw_message(draw) -> m.Message:
    ident = draw(st.integers(0, 1023))
    numbers = st.integers(0, 31).map(lambda n: ident * 32 + n)
    sizes = st.binary(max_size=40).filter(lambda b: len(b) % 4 == 0)
    blocks = draw(st.lists(st.builds(m.SubBlock, numbers, sizes), max_size=5))
    return m.Message(
        direction=draw(st.sampled_from(m.Direction)),
        kind=draw(st.sampled_from(m.Kind)),
        message_id=ident,
        blocks=tuple(blocks),
        sequence=draw(st.integers(0, 15)),
        retry=draw(st.booleans()),
        remaining_chunks=draw(st.integers(0, 0xFFFF)),
    )


@given(draw_message())
def test_a_message_is_decoded_from_its_bytes(original: m.Message):
    raw = m.encode(original)
    assert len(raw) % 4 == 0
    assert m.decode(raw) == original
    assert m.decode_header(raw).length == len(raw) - 4


@given(draw_message(), st.data())
def test_any_flipped_bit_is_detected(original: m.Message, data):
    raw = bytearray(m.encode(original))
    bit = data.draw(st.integers(0, 8 * len(raw) - 1))
    raw[bit // 8] ^= 1 << bit % 8
    with pytest.raises(ProtocolError):
        m.decode(bytes(raw))


@given(st.binary(max_size=300))
def test_noise_after_a_sync_word_is_refused(noise: bytes):
    with pytest.raises(ProtocolError):
        m.decode(m.DEVICE_SYNC + noise[: len(noise) // 2] + b"\0")


def test_checksum_of_the_control_document():
    """Table 2.6 of TI's interface control document has the five words of a header and their checksum."""
    words = struct.pack("<5H", 0x0281, 0x0800, 0x040C, 0x0000, 0x0001)
    assert m.checksum(words) == 0xF171


def test_the_16_bit_crc_is_ccitt_false():
    """The published check value of a CRC is that of "123456789"; messages of real devices are in test_received.py."""
    assert m.crc(b"123456789", 2) == bytes.fromhex("b129")


@pytest.mark.parametrize(
    ("blocks", "sequence", "value"),
    [
        ((m.SubBlock(0x4080, bytes(240)),), 0, "256"),
        ((m.SubBlock(0x0100), m.SubBlock(0x4040)), 0, "message id"),
        ((m.SubBlock(0x0100),), 16, "sequence 16"),
    ],
)
def test_a_message_that_exceeds_its_limits_is_refused(blocks, sequence, value):
    with pytest.raises(ValueError, match=value):
        m.encode(m.command(blocks, sequence=sequence))


@pytest.mark.parametrize(
    ("message_id", "sequence", "fits"),
    [
        (0, 0, True),
        (1023, 15, True),
        (1024, 0, False),
        (1025, 0, False),
        (-1, 0, False),
        (1, 16, False),
        (1, 17, False),
    ],
)
def test_numbers_beyond_their_bits_are_refused(message_id, sequence, fits):
    message = m.Message(
        direction=m.Direction.HOST_TO_MAIN,
        kind=m.Kind.COMMAND,
        message_id=message_id,
        blocks=(m.SubBlock(1),),
        sequence=sequence,
    )
    if fits:
        assert m.encode(message)
        return
    with pytest.raises(ValueError, match=f"sequence {sequence} .* id {message_id} "):
        m.encode(message)
