"""Requests, replies and samples of the DCA1000 card are encoded and decoded as in recordings of a real card."""

import numpy as np
import pytest
from hypothesis import given, strategies as st
from tests.support.refusals import expect_refusal

from polysight.capture import dca1000 as d
from polysight.capture.dca1000 import decode_row, decode_two_lane
from polysight_shared.errors import ErrorCode, ProtocolError


def test_requests_replies_and_headers_are_those_of_a_real_card():
    assert d.encode_packet_configuration(1470, 25.0) == bytes.fromhex("be05350c0000")
    assert d.encode_fpga_configuration(4) == bytes.fromhex("01010102031e")
    assert d.encode_fpga_configuration(2) == bytes.fromhex("01020102031e")
    assert d.encode_request(d.Code.ALIVE) == bytes.fromhex("5aa509000000aaee")
    assert d.decode_reply(bytes.fromhex("5aa50e000204aaee")) == d.Reply(d.Code.VERSION, 0x0402)
    assert str(d.decode_version(0x0402)) == "2.8"
    assert d.decode_reply(bytes.fromhex("5aa50a000001aaee")) == d.Reply(d.Code.STATUS, d.Status.RECORD_COMPLETED)
    assert d.decode_packet_header(bytes.fromhex("02000000b00500000000") + b"x") == (2, 1456)
    assert d.decode_packet_header(bytes.fromhex("ffffffff010000000080") + b"x") == (2**32 - 1, 2**47 + 1)


@pytest.mark.parametrize(
    "raw",
    [
        b"", b"12345678", bytes.fromhex("5aa509000000aaef"), bytes.fromhex("5ba509000000aaee"),
        bytes.fromhex("59a509000000aaee"), bytes.fromhex("5aa509000000a9ee"),
        bytes.fromhex("5aa509000000aa"), bytes.fromhex("5aa509000000aaee00"),
    ],
)  # fmt: skip
def test_malformed_replies_are_refused(raw):
    """The replies are empty, too short, with a wrong last, first or second byte, cut, and one byte too long."""
    with pytest.raises(ProtocolError):
        d.decode_reply(raw)


def test_values_that_a_card_cannot_take_are_refused():
    """More than 504 bytes of data, a delay of more than 524 us or below zero, 3 lanes, and a header without payload."""
    with pytest.raises(ProtocolError):
        d.encode_request(3, bytes(505))
    with pytest.raises(ProtocolError):
        d.encode_packet_configuration(1470, 600.0)
    with pytest.raises(ProtocolError):
        d.encode_fpga_configuration(3)
    with pytest.raises(ProtocolError):
        d.encode_packet_configuration(1470, -0.01)
    with pytest.raises(ProtocolError):
        d.decode_packet_header(bytes(10))


def test_the_largest_and_smallest_values_are_taken():
    assert d.encode_request(3, bytes(504))[4:6] == (504).to_bytes(2, "little")
    # The delay between packets has 16 bits of 8 ns: 65535 ticks.
    assert d.encode_packet_configuration(1470, 524.28)[2:4] == b"\xff\xff"
    assert d.encode_packet_configuration(1470, 0.0)[2:4] == b"\0\0"
    assert d.decode_packet_header(bytes(11)) == (0, 0)


@pytest.mark.parametrize(
    ("status", "version"),
    [(0x0402, "2.8"), (0x007F, "127.0"), (0x3F80, "0.127"), (0x4081, "1.1 (playback)"), (0x8000, "0.0")],
)
def test_a_version_is_seven_bits_each_and_one_for_playback(status, version):
    assert str(d.decode_version(status)) == version


def test_counters_wrap_at_48_and_32_bits():
    counters = d.Counters(2**48 - 1, 2**32 - 1)
    assert counters.advance(1, 1) == d.Counters(0, 0)
    assert counters.advance(1457, 2) == d.Counters(1456, 1)
    assert d.Counters(0, 0).advance(2**48 - 1, 2**32 - 1) == counters


def draw_cube(frames: int, samples: int, rx: int, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    parts = rng.integers(-32768, 32768, (2, rx, frames, samples))
    return (parts[0] + 1j * parts[1]).astype(np.complex64)


def encode_four_lane(x: np.ndarray) -> bytes:
    """Encode as a card with four lanes: of each sample the I of all antennas, then their Q (I0 I1 I2 I3 Q0 ... Q3)."""
    rx, frames, samples = x.shape
    words = []
    for f in range(frames):
        for n in range(samples):
            words += [x[r, f, n].real for r in range(rx)] + [x[r, f, n].imag for r in range(rx)]
    return np.array(words, dtype="<i2").tobytes()


def encode_two_lane(x: np.ndarray) -> bytes:
    """Encode as a card with two lanes: a chirp of RX1, then of RX2, each as I0 I1 Q0 Q1 I2 I3 Q2 Q3 of its samples."""
    rx, frames, samples = x.shape
    words = []
    for f in range(frames):
        for r in range(rx):
            for n in range(0, samples, 2):
                a = x[r, f, n]
                b = x[r, f, n + 1]
                words += [a.real, b.real, a.imag, b.imag]
    return np.array(words, dtype="<i2").tobytes()


@given(st.integers(1, 4), st.integers(1, 9), st.sampled_from([1, 2, 4]))
def test_samples_of_four_lanes_are_decoded(frames, samples, rx):
    x = draw_cube(frames, samples, rx)
    decoded, valid = decode_row(encode_four_lane(x), (), frames, samples, rx)
    assert decoded.dtype == np.complex64
    assert valid.all()
    assert np.array_equal(decoded, x)


@given(st.integers(1, 4), st.integers(1, 5), st.sampled_from([1, 2, 4]))
def test_samples_of_two_lanes_are_decoded(chirps, pairs, rx):
    x = draw_cube(chirps, 2 * pairs, rx)
    assert np.array_equal(decode_two_lane(encode_two_lane(x), chirps, 2 * pairs, rx), x)


def test_swapped_order_exchanges_i_and_q():
    x = draw_cube(2, 4, 4)
    swapped = x.imag + 1j * x.real
    assert np.array_equal(decode_row(encode_four_lane(x), (), 2, 4, 4, swap_iq=True)[0], swapped)
    assert np.array_equal(decode_two_lane(encode_two_lane(x), 2, 4, 4, swap_iq=True), swapped)


@given(st.lists(st.tuples(st.integers(0, 639), st.integers(1, 100)), max_size=4))
def test_frames_with_a_missing_byte_are_invalid_and_zero(cuts):
    # 5 frames of 8 samples of 4 antennas, each 16 bits of I and of Q.
    x = draw_cube(5, 8, 4)
    size = 5 * 8 * 16
    mask = np.zeros(size, dtype=bool)
    for a, n in cuts:
        mask[a : a + n] = True
    ranges = [(a, min(a + n, size)) for a, n in cuts]
    decoded, valid = decode_row(encode_four_lane(x), ranges, 5, 8)
    assert np.array_equal(valid, ~mask.reshape(5, -1).any(axis=1))
    assert not decoded[:, ~valid].any()
    assert np.array_equal(decoded[:, valid], x[:, valid])


@pytest.mark.parametrize(
    ("missing", "invalid"),
    [
        ([(99, 100)], [0]),
        ([(100, 101)], [1]),
        ([(99, 101)], [0, 1]),
        ([(100, 300)], [1, 2]),
        ([(100, 100), (150, 150)], []),
        ([], []),
    ],
)
def test_a_missing_byte_belongs_to_one_frame(missing, invalid):
    assert np.flatnonzero(~d.valid_frames(missing, 4, 100)).tolist() == invalid


def test_bytes_beyond_the_last_frame_are_ignored():
    x = draw_cube(2, 4, 4)
    assert np.array_equal(decode_row(encode_four_lane(x) + b"rest", (), 2, 4)[0], x)


def test_data_shorter_than_its_frames_is_refused():
    with expect_refusal(ErrorCode.NOT_ENOUGH_DATA, "127 bytes", "128 bytes"):
        decode_row(bytes(2 * 4 * 16 - 1), (), 2, 4)
    with expect_refusal(ErrorCode.VALUE_INVALID):
        decode_two_lane(bytes(1000), 1, 3)
