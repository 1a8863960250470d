"""The byte stream for the FT4232H, the USB chip of a board that makes its SPI signals.

Commands of the chip (FTDI AN 108): 80 VALUE DIRECTION sets pins; 11 and 20 write and read bytes, with their number less
one; 87 sends what was read; 8a, 97, 8d, 86 and 85 configure the clock and the connection.
"""

import pytest
from hypothesis import given, strategies as st
from tests.support.refusals import expect_refusal

from polysight.radar.usb import UsbWords, encode_reads, encode_spi_setup, encode_writes
from polysight_shared.errors import ErrorCode
from polysight_simulators.radars import UsbChip, board as simulated


@pytest.fixture
def chip(board) -> UsbChip:
    return UsbChip(board)


@pytest.fixture
def usb(chip, clock) -> UsbWords:
    return UsbWords(*(chip.channel(n) for n in "ABCD"), sleep=clock.sleep)


def test_a_word_is_sent_with_the_high_byte_first_and_its_own_chip_select():
    """Pin 3 is the chip select: low (c0, c2) for a word, high (c8) between words.

    Pins are set several times because one command holds them for two clocks, the least that TI's ICD allows.
    """
    assert encode_writes([0x1234]).hex(" ") == "80 c0 4b 80 c0 4b 11 01 00 12 34 80 c8 4b 80 c8 4b 80 c8 4b 87"
    assert encode_reads(1).hex(" ") == "80 c2 4b 80 c2 4b 20 01 00 80 c8 4b 80 c8 4b 80 c8 4b 87"


def test_the_clock_is_10_mhz_and_rests_low(chip, usb):
    assert chip.spi_hz == 10e6
    assert encode_spi_setup().hex(" ") == "8a 97 8d 86 02 00 80 c8 4b 85"
    assert chip.errors == []
    usb.close()


@given(st.lists(st.integers(0, 0xFFFF), max_size=130))
def test_words_arrive_unchanged(words):
    chip = UsbChip(simulated.RadarBoard(lambda: 0.0))
    usb = UsbWords(*(chip.channel(n) for n in "ABCD"), sleep=float)
    usb.write(words)
    assert chip.words_written == words
    assert chip.errors == []


@given(st.lists(st.integers(0, 0xFFFF), max_size=20), st.data())
def test_a_stream_may_be_split_anywhere(words, data):
    chip = UsbChip(simulated.RadarBoard(lambda: 0.0))
    stream = encode_writes(words)
    cut = data.draw(st.integers(0, len(stream)))
    chip.receive_from_host("A", stream[:cut])
    chip.receive_from_host("A", stream[cut:])
    assert chip.words_written == words


@pytest.mark.parametrize("byte", [0, 1, 3, 4, 8])
def test_an_invalid_stream_is_detected(chip, byte):
    """The tests above rely on the simulated chip to report violations of the SPI protocol."""
    stream = bytearray(encode_writes([0x1234, 0x5678]))
    stream[byte] ^= 0x09
    chip.receive_from_host("A", bytes(stream))
    assert chip.errors or chip.words_written != [0x1234, 0x5678]


def test_the_reset_is_released_in_functional_mode_only(board, chip):
    # Channel D selects the mode of the start, not the functional one here; channel C releases the reset.
    chip.receive_from_host("D", b"\x1c")
    for pins in (0x80, 0xC0):
        chip.receive_from_host("C", bytes((pins,)))
    assert not board.interrupt
    assert board.executed == []


def test_an_answer_with_too_few_bytes_is_an_error(chip, usb, monkeypatch):
    monkeypatch.setattr(chip, "send_to_host", lambda name, size: b"\0" * (size - 1))  # noqa: ARG005
    with expect_refusal(ErrorCode.NO_ANSWER, "3 of 4 bytes"):
        usb.read(2)
    with expect_refusal(ErrorCode.NO_ANSWER):
        usb.interrupt()
